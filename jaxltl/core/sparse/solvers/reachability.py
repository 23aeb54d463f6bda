"""Certified probabilities of reaching states, and rewards until they are reached, on sparse rows.

The graph decides first: chains are contracted, then who reaches the target with probability 0 or 1
or may earn for ever; end components become one state. What is left has one solution, and
:mod:`jaxltl.core.sparse.solvers.policy_iteration` encloses it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.contraction import Contraction, quotient, contract_chains
from jaxltl.core.sparse.graph.qualitative import (
    EndComponents,
    end_components,
    positive_under_all_policies,
    backward_reachable,
    almost_sure_reachability,
    shortest_path_rows,
)
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers.mixing import optimum
from jaxltl.core.sparse.solvers.policy_iteration import Enclosure, ShortestPathProblem

_EPS = float(np.finfo(np.float64).eps)


class ReducedProblem(NamedTuple):
    """What the graph leaves of a question.

    Attributes:
      mdp: the model.
      whole: the model without chains.
      part: of that, the model whose end components are states; None where there are none.
      components: these end components.
      problem: what is left, on the nodes of `part` or else of `whole`; None where nothing is.
      known: ``float64[N]``, what is known of the nodes that are not open.
      row: ``int[N]``, the rows of nodes that are not open.
      sure: ``bool``, the nodes of `whole` that take the rows of `sure_row` whatever is found.
      most: what no value exceeds.
      maximize: whether the largest value is asked for.
    """

    mdp: HostMDP
    whole: Contraction
    part: Contraction | None
    components: EndComponents | None
    problem: ShortestPathProblem | None
    known: Floats
    row: Integers
    sure: Booleans | None
    sure_row: Integers | None
    most: float
    maximize: bool


class _Left(NamedTuple):
    """The same without what came before: a problem or None, and what is known."""

    problem: ShortestPathProblem | None
    known: Floats
    row: Integers
    part: Contraction | None = None
    components: EndComponents | None = None
    sure: Booleans | None = None
    sure_row: Integers | None = None


def reachability(
    mdp: HostMDP,
    target: Booleans,
    *,
    maximize: bool,
    stay: Booleans | None = None,
    tolerance: float = 1e-6,
    depth: int = 0,
) -> Enclosure:
    """The largest or smallest probability of reaching a target through states where one may stay.

    Args:
      mdp: the model.
      target: ``bool[S]``.
      maximize: which of the two; the same for a Markov chain.
      stay: ``bool[S]``, the states that may be passed; default all.
      tolerance: the width of the enclosure asked for.
      depth: how many roundings stand behind each number of the model.
    """
    return _solved(
        reduce_reachability(mdp, target, maximize=maximize, stay=stay, depth=depth), tolerance
    )


def reduce_reachability(
    mdp: HostMDP,
    target: Booleans,
    *,
    maximize: bool,
    stay: Booleans | None = None,
    depth: int = 0,
) -> ReducedProblem:
    """What the graph leaves of :func:`reachability`, with the same arguments."""
    blocked = np.zeros(mdp.num_states, bool) if stay is None else ~stay & ~target
    whole = contract_chains(mdp, target | blocked, None) or _identity(mdp)
    small = whole.mdp
    goal, dead = (np.zeros(small.num_states, bool) for _ in range(2))
    goal[whole.node[target]], dead[whole.node[blocked]] = True, True
    reduce = _largest if maximize and not small.is_chain else _smallest
    left = reduce(small, goal, dead, whole.depth + depth)
    return _reduced(mdp, whole, left, 1.0, maximize and not small.is_chain)


def _identity(mdp: HostMDP) -> Contraction:
    return Contraction(
        mdp,
        np.arange(mdp.num_states),
        np.arange(mdp.num_rows),
        np.zeros(mdp.num_states),
        np.zeros(mdp.num_rows),
        0,
    )


def _reduced(
    mdp: HostMDP, whole: Contraction, left: _Left, most: float, maximize: bool
) -> ReducedProblem:
    return ReducedProblem(
        mdp,
        whole,
        left.part,
        left.components,
        left.problem,
        left.known,
        left.row,
        left.sure,
        left.sure_row,
        most,
        maximize,
    )


def _solved(reduced: ReducedProblem, tolerance: float) -> Enclosure:
    """What was asked, of the states of the model."""
    found = _enclosed(reduced, tolerance)
    part = reduced.part
    if part is not None and reduced.components is not None:
        row = quotient_policy(reduced.whole.mdp, reduced.components, part.row[found.row][part.node])
        if reduced.sure is not None and reduced.sure_row is not None:
            row = np.where(reduced.sure, reduced.sure_row, row)
        found = found._replace(
            value=found.value[part.node],
            lower=found.lower[part.node],
            upper=found.upper[part.node],
            row=row,
        )
    return _expanded(reduced.mdp, reduced.whole, found)


def _enclosed(reduced: ReducedProblem, tolerance: float) -> Enclosure:
    """What was asked, of the nodes."""
    known, most, problem = reduced.known, reduced.most, reduced.problem
    if problem is None:
        return Enclosure(known, known, known, reduced.row, 0, 0.0, "the graph")
    found = optimum(
        problem, maximize=reduced.maximize, tolerance=tolerance, relative=not np.isfinite(most)
    )
    row = np.where(problem.open, found.row, reduced.row)
    value, lower, upper = (
        np.where(np.isinf(known), np.inf, x)
        for x in (
            np.minimum(found.value, most),
            np.clip(found.lower, 0, most),
            np.minimum(found.upper, most),
        )
    )
    return Enclosure(value, lower, upper, row, found.rounds, found.residual, found.method)


def _expanded(mdp: HostMDP, whole: Contraction, found: Enclosure) -> Enclosure:
    """What was found for nodes, for states, with what these earn on the way."""
    if whole.node.size == whole.mdp.num_states:
        return found
    row = mdp.row_start[:-1].astype(np.int64)
    places = np.zeros(whole.mdp.num_states, np.int64)
    places[whole.node[::-1]] = np.arange(whole.node.size)[::-1]
    # A node is the only state with its rows; all others have one row.
    own = mdp.state[whole.row[whole.mdp.row_start[:-1]]]
    row[own] = whole.row[found.row]
    share = whole.depth * _EPS
    earned = whole.earned
    value, lower, upper = (x[whole.node] for x in (found.value, found.lower, found.upper))
    if earned.any():
        lower = (lower + earned * (1 - share)) * (1 - _EPS)
        upper = (upper + earned * (1 + share)) * (1 + _EPS)
        value = value + earned
    return Enclosure(value, lower, upper, row, found.rounds, found.residual, found.method)


def _smallest(mdp: HostMDP, goal: Booleans, dead: Booleans, depth: int) -> _Left:
    """The least probability of reaching a goal before anything dead."""
    outside = goal | dead
    zero = dead | ~positive_under_all_policies(mdp, goal, among=~dead)
    one = goal | ~backward_reachable(mdp, zero, _rows_of(mdp, ~outside))
    stays = ~mdp.support.some_successor_in(~zero) & zero[mdp.state]
    return _between(mdp, zero, one, mdp.first_choice(stays)[1].astype(np.int64), depth)


def _between(mdp: HostMDP, zero: Booleans, one: Booleans, row: Integers, depth: int) -> _Left:
    """The probabilities that are neither zero nor one."""
    open_, known = ~(zero | one), one.astype(np.float64)
    if not open_.any():
        return _Left(None, known, row)
    problem = ShortestPathProblem(mdp, open_, known, np.zeros(mdp.num_rows), depth=depth)
    return _Left(problem, known, row)


def _rows_of(mdp: HostMDP, states: Booleans) -> Booleans:
    return states[mdp.state]


def _largest(mdp: HostMDP, goal: Booleans, dead: Booleans, depth: int) -> _Left:
    """The largest probability of reaching a goal before anything dead."""
    outside = goal | dead
    open_ = ~outside
    zero = ~backward_reachable(mdp, goal, _rows_of(mdp, open_))
    open_ &= ~zero
    components = end_components(mdp, open_)
    if components.inside.any():
        return _merged(mdp, goal, zero, components, depth)
    return _largest_apart(mdp, goal, zero, depth)


def _merged(
    mdp: HostMDP, goal: Booleans, zero: Booleans, components: EndComponents, depth: int
) -> _Left:
    """The same with end components as one state each, from which the best row leaves."""
    part = quotient(mdp, components.component, components.inside, np.zeros(mdp.num_rows))
    small = part.mdp
    goal_, zero_ = (np.zeros(small.num_states, bool) for _ in range(2))
    goal_[part.node[goal]], zero_[part.node[zero]] = True, True
    left = _largest_apart(small, goal_, zero_, depth)
    return left._replace(part=part, components=components)


def quotient_policy(mdp: HostMDP, components: EndComponents, row: Integers) -> Integers:
    """A policy that goes round in an end component until it is where the given row leaves."""
    states = np.flatnonzero(components.region(mdp))
    exits = np.zeros(mdp.num_states, bool)
    exits[mdp.state[row[states]]] = True
    found: Any = mdp.row_start[:-1].astype(np.int64)
    own = mdp.state[row] == np.arange(mdp.num_states)
    found[own] = row[own]
    ranked = shortest_path_rows(mdp, exits, components.inside)
    inner = np.zeros(mdp.num_states, bool)
    inner[states] = True
    inner &= ~exits
    found[inner] = ranked[inner]
    return found


def _largest_apart(mdp: HostMDP, goal: Booleans, zero: Booleans, depth: int) -> _Left:
    """The same where every policy leaves the open states almost surely."""
    one = ~positive_under_all_policies(mdp, zero, among=~goal)
    # From where the probability is one, rows that keep it so.
    stays = ~mdp.support.some_successor_in(~one) & one[mdp.state]
    return _between(mdp, zero, one, mdp.first_choice(stays)[1].astype(np.int64), depth)


def total_reward(
    mdp: HostMDP,
    reward: Floats,
    target: Booleans,
    *,
    maximize: bool,
    tolerance: float = 1e-6,
    depth: int = 0,
) -> Enclosure:
    """The largest or smallest expected reward until a target is reached.

    Infinite where the target is not reached almost surely: for the largest, under some policy;
    for the smallest, under every one.

    Args:
      mdp: the model.
      reward: ``float64[R]``, at least 0; infinity where a row must not be taken.
      target: ``bool[S]``.
      maximize: which of the two.
      tolerance: the width of the enclosure asked for, as a share of the value.
      depth: how many roundings stand behind each number of the model.
    """
    return _solved(
        reduce_total_reward(mdp, reward, target, maximize=maximize, depth=depth), tolerance
    )


def reduce_total_reward(
    mdp: HostMDP,
    reward: Floats,
    target: Booleans,
    *,
    maximize: bool,
    kept: Booleans | None = None,
    depth: int = 0,
) -> ReducedProblem:
    """What the graph leaves of :func:`total_reward`, with the same arguments.

    Args:
      mdp, reward, target, maximize, depth: the question.
      kept: ``bool[S]``, states that are no part of a chain.
    """
    fixed = target if kept is None else target | kept
    whole = contract_chains(mdp, fixed, reward) or _identity(mdp)._replace(cost=reward)
    whole = whole._replace(depth=whole.depth + depth)
    small = whole.mdp
    goal = np.zeros(small.num_states, bool)
    goal[whole.node[target]] = True
    reduce = _most if maximize and not small.is_chain else _least
    left = reduce(small, whole.cost, goal, whole.depth)
    return _reduced(mdp, whole, left, np.inf, maximize and not small.is_chain)


def _most(mdp: HostMDP, cost: Floats, goal: Booleans, depth: int) -> _Left:
    never = ~positive_under_all_policies(mdp, goal)
    before = _rows_of(mdp, ~goal)
    infinite = backward_reachable(mdp, never, before)
    goal = _nothing(mdp, cost, goal, infinite)
    # Where it is infinite: rows to where the target can be avoided, and there rows that avoid it.
    avoids = ~mdp.support.some_successor_in(~never) & never[mdp.state]
    row = np.where(never, mdp.first_choice(avoids)[1], shortest_path_rows(mdp, never, before))
    return _finite(mdp, cost, goal, infinite, row, depth)


def _nothing(mdp: HostMDP, cost: Floats, goal: Booleans, infinite: Booleans) -> Booleans:
    """The goal, and the states from which nothing can be earned before it."""
    earning = (cost > 0) & ~goal[mdp.state]
    if earning.all():
        return goal
    some = np.zeros(mdp.num_states, bool)
    some[mdp.state[earning]] = True
    return ~(backward_reachable(mdp, some, ~goal[mdp.state]) | infinite)


def _finite(
    mdp: HostMDP,
    cost: Floats,
    goal: Booleans,
    infinite: Booleans,
    row: Integers,
    depth: int,
    rows: Booleans | None = None,
    first: Integers | None = None,
) -> _Left:
    """The finite ones, which never meet the others."""
    open_ = ~(goal | infinite)
    known = np.where(infinite, np.inf, 0.0)
    if not open_.any():
        return _Left(None, known, row)
    problem = ShortestPathProblem(mdp, open_, np.zeros(mdp.num_states), cost, rows, first, depth)
    return _Left(problem, known, row)


def _least(mdp: HostMDP, cost: Floats, goal: Booleans, depth: int) -> _Left:
    finite, rows = almost_sure_reachability(mdp, goal, np.isfinite(cost) | goal[mdp.state])
    rows &= ~goal[mdp.state]
    if mdp.is_chain:
        row: Any = mdp.row_start[:-1].astype(np.int64)
        goal = _nothing(mdp, cost, goal, ~finite)
        return _finite(mdp, cost, goal, ~finite, row, depth, rows)
    # What can surely be done for nothing is worth nothing.
    free = rows & (cost == 0)
    nothing, stays = almost_sure_reachability(mdp, goal, free | goal[mdp.state])
    row = shortest_path_rows(mdp, goal, stays)
    circles = end_components(mdp, finite & ~nothing, free)
    if not circles.inside.any():
        first = shortest_path_rows(mdp, nothing, rows)
        return _finite(mdp, cost, nothing, ~finite, row, depth, rows, first)
    # Where going round costs nothing, states are one.
    part = quotient(mdp, circles.component, circles.inside, cost)
    small = part.mdp
    goal_, finite_ = (np.zeros(small.num_states, bool) for _ in range(2))
    goal_[part.node[nothing]], finite_[part.node[finite]] = True, True
    kept = rows[part.row] & ~circles.inside[part.row]
    first = shortest_path_rows(small, goal_, kept)
    left = _finite(
        small, part.cost, goal_, ~finite_, small.row_start[:-1].astype(np.int64), depth, kept, first
    )
    return left._replace(part=part, components=circles, sure=nothing, sure_row=row)


def reward_forever(
    mdp: HostMDP, reward: Floats, *, maximize: bool, tolerance: float = 1e-6, depth: int = 0
) -> Enclosure:
    """The largest or smallest expected reward in all.

    The largest is infinite where an end component that earns can be reached; other end components
    earn nothing and are left at most once. The smallest is what is earned until nothing more need
    be, and infinite where that is not so almost surely.

    Args:
      mdp: the model.
      reward: ``float[R]``, at least 0.
      maximize: which of the two.
      tolerance: the width of the enclosure asked for, as a share of the value.
      depth: how many roundings stand behind each number of the model.
    """
    if not maximize or mdp.is_chain:
        earning = reward > 0
        never = ~_kept_away(mdp, earning)
        found = total_reward(mdp, reward, never, maximize=False, tolerance=tolerance, depth=depth)
        quiet = never[mdp.state] & ~earning & ~mdp.support.some_successor_in(~never)
        return found._replace(row=np.where(never, mdp.first_choice(quiet)[1], found.row))
    components = end_components(mdp)
    earns = np.zeros(mdp.num_states, bool)
    earns[components.component[mdp.state[components.inside & (reward > 0)]]] = True
    rich = earns[components.component]
    infinite = backward_reachable(mdp, rich)
    part = quotient(mdp, components.component, components.inside, reward)
    small = part.mdp
    left = np.zeros(small.num_states, bool)  # nodes that some row leaves
    left[small.state[~components.inside[part.row]]] = True
    infinite_ = np.zeros(small.num_states, bool)
    infinite_[part.node[infinite]] = True
    row = small.row_start[:-1].astype(np.int64)
    rest = _finite(small, part.cost, ~left, infinite_, row, depth)
    found = _enclosed(_reduced(mdp, part, rest, np.inf, True), tolerance)
    leaving = quotient_policy(mdp, components, part.row[found.row][part.node])
    endless = _earning(mdp, components, rich, reward)
    return found._replace(
        value=found.value[part.node],
        lower=found.lower[part.node],
        upper=found.upper[part.node],
        row=np.where(infinite, endless, leaving),
    )


def _kept_away(mdp: HostMDP, rows: Booleans) -> Booleans:
    """The states from which no policy surely avoids some rows for ever: ``bool[S]``."""
    nothing = np.zeros(mdp.num_states, bool)
    return positive_under_all_policies(mdp, nothing, ~rows)


def _earning(mdp: HostMDP, components: EndComponents, rich: Booleans, reward: Floats) -> Integers:
    """A policy that gets to components that earn, and earns there for ever."""
    paid = components.inside & (reward > 0)
    some, first = mdp.first_choice(paid)
    inner = shortest_path_rows(mdp, some, components.inside)
    outer = shortest_path_rows(mdp, rich, np.ones(mdp.num_rows, bool))
    return np.where(some, first, np.where(rich, inner, outer))


def worst_width(found: Enclosure, *, relative: bool) -> float:
    """The widest enclosure, as a share of the value where that is asked for."""
    low, high = found.lower, found.upper
    finite = np.isfinite(high)
    width: Any = np.where(finite, high - np.where(finite, low, 0), np.where(low == high, 0, np.inf))
    if relative:
        width = np.where(width > 0, width / np.maximum(np.where(finite, high, 1), 1e-300), 0)
    return float(width.max(initial=0))
