"""Optimal weighted sums of probabilities and total rewards, as optimal stopping.

A run ends in an end component with even least priorities for the probability objectives that it
satisfies. A weighted sum is therefore an optimal stopping problem: rewards until stopping, and on
stopping in a component the weight of the best set of objectives that can be satisfied together in
it (Etessami, Kwiatkowska, Vardi and Yannakakis 2008; Forejt, Kwiatkowska, Norman, Parker and Qu
2011).
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.contraction import with_stops
from jaxltl.core.sparse.graph.qualitative import (
    SparseEndComponents,
    end_components,
    almost_sure_reachability,
    shortest_path_rows,
)
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import first_hits, mask_of
from jaxltl.core.sparse.solvers.policy_iteration import policy_iteration
from jaxltl.core.sparse.solvers.shortest_path_problem import ShortestPathProblem

_EPS = float(np.finfo(np.float64).eps)
_ROUNDS = 100


class WeightedProblem(NamedTuple):
    """A model with several objectives, all to be maximised."""

    mdp: HostMDP  # the model, N reachable states
    start: Floats  # float64[N], the initial distribution
    # int[B, R], for each probability objective the least priority that a row reads; it is satisfied
    # where the least recurring one is even
    priority: Integers
    gain: Floats  # float64[K, R], at least 0: rewards to maximise
    cost: Floats  # float64[C, R], at least 0: rewards to minimise
    ended: Booleans  # bool[N], where all costs with a target have reached it


class FinalComponents(NamedTuple):
    """End components without cost in which runs may end, by sets of satisfied objectives."""

    rows: Booleans  # bool[R], the rows that may be taken
    sets: Booleans  # bool[M, B], sets of objectives
    inside: list[Booleans]  # for each set, the rows of end components in which it can be satisfied


def final_components(sums: WeightedProblem, rows: Booleans | None = None) -> FinalComponents | None:
    """Final components among `rows`; None if some initial state does not reach them almost surely."""
    mdp = sums.mdp
    free = (sums.cost == 0).all(0) & sums.ended[mdp.state]
    homes = end_components(mdp, rows=free if rows is None else free & rows)
    inside, rows = almost_sure_reachability(mdp, homes.region(mdp), rows)
    if (sums.start > 0)[~inside].any():
        return None
    count = len(sums.priority)
    sets, inside_of_set = [], []
    for size in range(count, -1, -1):
        for chosen in itertools.combinations(range(count), size):
            wanted = mask_of(np.array(chosen, np.int64), count)
            region = _satisfying(mdp, sums.priority[wanted], homes.inside & rows)
            if region.any():
                sets.append(wanted)
                inside_of_set.append(region)
    return FinalComponents(rows, np.array(sets, bool).reshape(len(sets), count), inside_of_set)


def _satisfying(mdp: HostMDP, priority: Integers, rows: Booleans) -> Booleans:
    """Rows of end components with even least priorities; others are searched without odd rows."""
    while True:
        components = end_components(mdp, rows=rows)
        leader = components.component[mdp.state]
        bad = np.zeros(mdp.num_rows, bool)
        for level in priority:
            least = np.full(mdp.num_states, np.iinfo(np.int64).max)
            np.minimum.at(least, leader[components.inside], level[components.inside])
            bad |= components.inside & (least[leader] % 2 == 1) & (level == least[leader])
        if not bad.any():
            return components.inside
        rows = components.inside & ~bad


class WeightedOptimum(NamedTuple):
    """The optimum of a weighted sum."""

    bound: float  # not exceeded by any policy
    weight: Floats  # float64[R], a policy: the weights of each state's rows, one or uniform ones
    home: Booleans  # bool[N], the states in which it ends


def weighted_optimum(
    sums: WeightedProblem,
    where: FinalComponents,
    sure: Floats,
    gain: Floats,
    cost: Floats,
    tolerance: float,
) -> WeightedOptimum:
    """The largest weighted sum over all policies that end almost surely."""
    mdp = sums.mdp
    earned, spent = gain @ sums.gain, cost @ sums.cost
    worth = where.sets @ sure
    # The best end of each state, of which a later one does not take the place.
    best = np.full(mdp.num_states, -1)
    for i in np.argsort(-worth, kind="stable"):
        best = np.where(mdp.states_of(where.inside[i]) & (best < 0), i, best)
    free = end_components(mdp, rows=where.rows & (spent == 0) & (earned == 0))
    quotient = _quotient(mdp, where.rows, free, best, worth)
    bound, row = _solved(quotient, earned, spent, tolerance)
    first = np.flatnonzero(sums.start)
    share, high = sums.start[first], bound[quotient.node[first]]
    total = float(share @ high)
    # Final values and costs may cancel; their rounding stays.
    size = float(share @ np.abs(high)) + float(np.abs(worth).max(initial=0))
    total += 4 * _EPS * size * (1 + first.size)
    weight, home = _policy(mdp, where, free, best, quotient, row)
    return WeightedOptimum(total, weight, home)


class _Quotient(NamedTuple):
    """End components as one node each, and a last node where runs stop."""

    mdp: HostMDP
    node: Integers  # int[N], the node of each state
    row: Integers  # int[R'], the row of each row; -1 for stopping
    known: Floats  # float64[R'], the value of stopping
    stop: Integers  # int[nodes], the state in which a node stops, or -1


def _quotient(
    mdp: HostMDP, rows: Booleans, free: SparseEndComponents, best: Integers, worth: Floats
) -> _Quotient:
    used = mdp.states_of(rows)
    heads = np.unique(free.component[used])
    node = np.where(used, np.searchsorted(heads, free.component), 0)
    # A component stops in the state with the largest stopping reward.
    candidates = np.flatnonzero(used & (best >= 0))
    order = candidates[np.argsort(-worth[best[candidates]], kind="stable")]
    stop = np.full(heads.size, -1)
    stop[node[order[::-1]]] = order[::-1]
    stops = np.flatnonzero(stop >= 0)
    row = np.flatnonzero(rows & ~free.inside)
    end = heads.size
    ends = np.append(stops, end), np.full(stops.size + 1, end)
    small, place = with_stops(mdp, row, node, ends, end + 1)
    known = np.concatenate([np.zeros(row.size), worth[best[stop[stops]]], [0.0]])
    origin = np.concatenate([row, np.full(stops.size + 1, -1)])
    return _Quotient(small, node, origin[place], known[place], stop)


def _solved(
    quotient: _Quotient, earned: Floats, spent: Floats, tolerance: float
) -> tuple[Floats, Integers]:
    """An upper bound for each node, and the rows of a policy close to it."""
    mdp, moves = quotient.mdp, quotient.row >= 0
    own = np.where(moves, quotient.row, 0)
    gain = np.where(moves, earned[own], quotient.known)
    loss = np.where(moves, spent[own], 0)
    end = np.arange(mdp.num_states) == mdp.num_states - 1
    first = shortest_path_rows(mdp, end, np.ones(mdp.num_rows, bool)).astype(np.int64)
    costs = loss.any()
    if costs and (gain[moves] > 0).any():
        return _signed(mdp, end, gain - loss, np.abs(gain) + loss, first, tolerance)
    highest = quotient.known.max() if costs else 0.0
    amount = np.where(moves, loss, highest - quotient.known) if costs else gain
    amount[-1] = 0
    if not amount.any():  # without the rounding of a solver
        return np.full(end.size, highest if costs else 0.0), first
    problem = ShortestPathProblem(mdp, ~end, np.zeros(end.size), amount, proper_policy=first)
    enclosure = policy_iteration(problem, maximize=not costs, tolerance=tolerance, relative=False)
    return (highest - enclosure.lower if costs else enclosure.upper), enclosure.row


def _signed(
    mdp: HostMDP,
    end: Booleans,
    reward: Floats,
    magnitude: Floats,
    first: Integers,
    tolerance: float,
) -> tuple[Floats, Integers]:
    """Upper bound for rewards of both signs: policy iteration (Howard 1960) with a small extra."""
    from jaxltl.core.sparse.linear.elimination import factorize
    from jaxltl.core.sparse.linear.topological_order import Edges, ordered_components

    inner = np.flatnonzero(~end)
    rows = np.flatnonzero(~end[mdp.state])
    matrix = mdp.matrix[rows][:, inner]
    owner, reward, magnitude = mdp.state[rows], reward[rows], magnitude[rows]
    starts = mdp.row_start[:-1][inner]
    unit = (2 * int(np.diff(mdp.entry_start).max()) + 8) * _EPS
    chosen, policy = first[inner], first
    begins = matrix.indptr[np.append(starts, rows.size)]
    solver = factorize(matrix, ordered_components(Edges(begins, matrix.indices)), chosen)
    extra = 0.0
    for _ in range(_ROUNDS):
        if solver is None:
            break
        if not extra:
            time = solver.solve(np.ones(inner.size))
            size = np.abs(solver.solve(magnitude[chosen])).max(initial=0)
            extra = max(1e-3 * tolerance / max(time.max(initial=1), 1), 32 * unit * size)
        value = solver.solve(reward[chosen] + extra)
        if not np.isfinite(value).all():
            break
        image = reward + matrix @ value
        gain = image - value[owner]
        slack = unit * (magnitude + matrix @ np.abs(value) + np.abs(value)[owner])
        policy = first.copy()
        policy[inner] = rows[chosen]
        if (gain + slack <= 0).all():
            return np.append(value, 0.0), policy
        best = np.maximum.reduceat(gain, starts)
        better = (gain == best[owner]) & (best > -extra / 2)[owner]
        chosen = first_hits(better, owner, chosen)
        solver = solver.refactorize(chosen)
    return np.full(mdp.num_states, np.inf), policy


def _policy(
    mdp: HostMDP,
    where: FinalComponents,
    free: SparseEndComponents,
    best: Integers,
    quotient: _Quotient,
    row: Integers,
) -> tuple[Floats, Booleans]:
    """The weights of rows of a policy on nodes, and the states where it ends."""
    region = free.region(mdp)
    own = quotient.row[row[quotient.node]]
    stops = (own < 0) & (quotient.stop[quotient.node] >= 0)
    # Where a component stops: all of the end component of that state.
    home, inside = np.zeros(mdp.num_states, bool), np.zeros(mdp.num_rows, bool)
    ending = np.unique(quotient.stop[quotient.node[stops]])
    for i in np.unique(best[ending]):
        part = end_components(mdp, rows=where.inside[i])
        wanted = mask_of(part.component[ending[best[ending] == i]], mdp.num_states)
        new = part.inside & wanted[part.component][mdp.state] & ~home[mdp.state]
        inside |= new
        home[mdp.state[new]] = True
    goal = home.copy()
    moving = np.flatnonzero(~stops & (own >= 0))
    goal[mdp.state[own[moving]]] = True
    policy = shortest_path_rows(mdp, goal, free.inside & region[mdp.state])
    at = (
        mdp.states_of(own[moving])
        & (own >= 0)
        & (mdp.state[np.maximum(own, 0)] == np.arange(mdp.num_states))
    )
    policy = np.where(at, own, policy)
    weight = np.zeros(mdp.num_rows)
    weight[policy] = 1
    weight[home[mdp.state]] = 0
    count = np.bincount(mdp.state[inside], minlength=mdp.num_states)
    weight[inside] = 1 / count[mdp.state[inside]]
    return weight, home
