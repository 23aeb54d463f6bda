"""Certified probabilities of reaching states, and rewards until they are reached, on sparse rows.

The graph decides first: chains are contracted, then who reaches the target with probability 0 or 1
or may earn for ever; end components become one state. What is left has one solution, and
:mod:`jaxltl.core.host.transient` encloses it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.host.contract import Contraction, merged, without_chains
from jaxltl.core.host.rows import Booleans, Integers, spans
from jaxltl.core.host.sparse import Floats, HostMDP
from jaxltl.core.host.sparse_graph import (
    Components,
    end_components,
    forced,
    reaching,
    surely_reaching,
)
from jaxltl.core.host.transient import Transient, optimum

_EPS = float(np.finfo(np.float64).eps)


class Enclosed(NamedTuple):
    """Certified values.

    Attributes:
      value, lower, upper: ``float64[S]``.
      row: ``int64[S]``, a policy; of an optimum it attains the bound on the safe side.
      rounds: systems solved.
      residual: how far the value is from satisfying its equation.
      method: how it was found, in words.
    """

    value: Floats
    lower: Floats
    upper: Floats
    row: Integers
    rounds: int
    residual: float
    method: str


def reachability(
    mdp: HostMDP, target: Booleans, *, maximize: bool, stay: Booleans | None = None,
    tolerance: float = 1e-6,
) -> Enclosed:
    """The largest or smallest probability of reaching a target through states where one may stay.

    Args:
      mdp: the model.
      target: ``bool[S]``.
      maximize: which of the two; the same for a Markov chain.
      stay: ``bool[S]``, the states that may be passed; default all.
      tolerance: the width of the enclosure asked for.
    """
    blocked = np.zeros(mdp.num_states, bool) if stay is None else ~stay & ~target
    fixed = target | blocked
    whole = without_chains(mdp, fixed, None) or _identity(mdp)
    small = whole.mdp
    kept = np.zeros(small.num_states, bool)
    goal, dead = kept.copy(), kept.copy()
    goal[whole.node[target]], dead[whole.node[blocked]] = True, True
    solve = _largest if maximize and not small.is_chain else _smallest
    found = solve(small, goal, dead, whole.depth, tolerance)
    return _expanded(mdp, whole, found)


def _identity(mdp: HostMDP) -> Contraction:
    return Contraction(
        mdp, np.arange(mdp.num_states), np.arange(mdp.num_rows), np.zeros(mdp.num_states),
        np.zeros(mdp.num_rows), 0)


def _expanded(mdp: HostMDP, whole: Contraction, found: Enclosed) -> Enclosed:
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
    return Enclosed(value, lower, upper, row, found.rounds, found.residual, found.method)


def _decided(
    mdp: HostMDP, one: Booleans, open_: Booleans, row: Integers
) -> Enclosed:
    value = one.astype(np.float64)
    return Enclosed(value, value, value, row, 0, 0.0, "the graph")


def _smallest(
    mdp: HostMDP, goal: Booleans, dead: Booleans, depth: int, tolerance: float
) -> Enclosed:
    """The least probability of reaching a goal before anything dead."""
    outside = goal | dead
    zero = dead | ~forced(mdp, goal, among=~dead)
    one = goal | ~reaching(mdp, zero, _rows_of(mdp, ~outside))
    open_ = ~(zero | one)
    stays = ~mdp.support.lead_to(~zero) & zero[mdp.state]
    row = mdp.first_choice(stays)[1].astype(np.int64)
    if not open_.any():
        return _decided(mdp, one, open_, row)
    problem = Transient(mdp, open_, one.astype(np.float64), np.zeros(mdp.num_rows), depth=depth)
    return _enclosed(problem, row, maximize=False, tolerance=tolerance, most=1.0)


def _enclosed(
    problem: Transient, row: Integers, *, maximize: bool, tolerance: float, most: float
) -> Enclosed:
    found = optimum(problem, maximize=maximize, tolerance=tolerance, relative=not np.isfinite(most))
    row = np.where(problem.open, found.row, row)
    return Enclosed(
        np.minimum(found.value, most), np.clip(found.lower, 0, most),
        np.minimum(found.upper, most), row, found.rounds, found.residual, found.method)


def _rows_of(mdp: HostMDP, states: Booleans) -> Booleans:
    return states[mdp.state]


def _largest(
    mdp: HostMDP, goal: Booleans, dead: Booleans, depth: int, tolerance: float
) -> Enclosed:
    """The largest probability of reaching a goal before anything dead."""
    outside = goal | dead
    open_ = ~outside
    zero = ~reaching(mdp, goal, _rows_of(mdp, open_))
    open_ &= ~zero
    components = end_components(mdp, open_)
    if components.inside.any():
        return _merged(mdp, goal, zero, components, depth, tolerance)
    return _largest_apart(mdp, goal, zero, depth, tolerance)


def _merged(
    mdp: HostMDP, goal: Booleans, zero: Booleans, components: Components, depth: int,
    tolerance: float,
) -> Enclosed:
    """The same with end components as one state each, from which the best row leaves."""
    part = merged(mdp, components.component, components.inside, np.zeros(mdp.num_rows))
    small = part.mdp
    goal_, zero_ = (np.zeros(small.num_states, bool) for _ in range(2))
    goal_[part.node[goal]], zero_[part.node[zero]] = True, True
    found = _largest_apart(small, goal_, zero_, depth, tolerance)
    row = _towards(mdp, components, part.row[found.row][part.node])
    return found._replace(
        value=found.value[part.node], lower=found.lower[part.node], upper=found.upper[part.node],
        row=row)


def _towards(mdp: HostMDP, components: Components, row: Integers) -> Integers:
    """A policy that goes round in an end component until it is where the given row leaves."""
    states = np.flatnonzero(components.region(mdp))
    exits = np.zeros(mdp.num_states, bool)
    exits[mdp.state[row[states]]] = True
    found: Any = mdp.row_start[:-1].astype(np.int64)
    own = mdp.state[row] == np.arange(mdp.num_states)
    found[own] = row[own]
    ranked = _nearer(mdp, exits, components.inside)
    inner = np.zeros(mdp.num_states, bool)
    inner[states] = True
    inner &= ~exits
    found[inner] = ranked[inner]
    return found


def _nearer(mdp: HostMDP, goal: Booleans, rows: Booleans) -> Integers:
    """For each state the first row, of some, that may lead nearer to a goal, ``int64[S]``."""
    found: Any = mdp.row_start[:-1].astype(np.int64)
    seen, frontier = goal.copy(), np.flatnonzero(goal)
    start, pred = mdp.predecessors
    while frontier.size:
        row: Any = pred[spans(start[frontier], start[frontier + 1] - start[frontier])]
        row = row[rows[row]]
        row = row[~seen[mdp.state[row]]]
        row.sort()
        state = mdp.state[row]
        new = np.diff(state, prepend=-1) > 0
        found[state[new]] = row[new]
        frontier = state[new]
        seen[frontier] = True
    return found


def _largest_apart(
    mdp: HostMDP, goal: Booleans, zero: Booleans, depth: int, tolerance: float
) -> Enclosed:
    """The same where every policy leaves the open states almost surely."""
    one = ~forced(mdp, zero, among=~goal)
    open_ = ~(zero | one)
    # From where the probability is one, rows that keep it so.
    stays = ~mdp.support.lead_to(~one) & one[mdp.state]
    row = mdp.first_choice(stays)[1].astype(np.int64)
    if not open_.any():
        return _decided(mdp, one, open_, row)
    problem = Transient(mdp, open_, one.astype(np.float64), np.zeros(mdp.num_rows), depth=depth)
    return _enclosed(problem, row, maximize=True, tolerance=tolerance, most=1.0)


def total_reward(
    mdp: HostMDP, reward: Floats, target: Booleans, *, maximize: bool, tolerance: float = 1e-6
) -> Enclosed:
    """The largest or smallest expected reward until a target is reached.

    Infinite where the target is not reached almost surely: for the largest, under some policy;
    for the smallest, under every one.

    Args:
      mdp: the model.
      reward: ``float64[R]``, at least 0; infinity where a row must not be taken.
      target: ``bool[S]``.
      maximize: which of the two.
      tolerance: the width of the enclosure asked for, as a share of the value.
    """
    whole = without_chains(mdp, target, reward) or _identity(mdp)._replace(cost=reward)
    small = whole.mdp
    goal = np.zeros(small.num_states, bool)
    goal[whole.node[target]] = True
    solve = _most if maximize and not small.is_chain else _least
    return _expanded(mdp, whole, solve(small, whole.cost, goal, whole.depth, tolerance))


def _most(
    mdp: HostMDP, cost: Floats, goal: Booleans, depth: int, tolerance: float
) -> Enclosed:
    never = ~forced(mdp, goal)
    before = _rows_of(mdp, ~goal)
    infinite = reaching(mdp, never, before)
    goal = _nothing(mdp, cost, goal, infinite)
    # Where it is infinite: rows to where the target can be avoided, and there rows that avoid it.
    avoids = ~mdp.support.lead_to(~never) & never[mdp.state]
    row = np.where(never, mdp.first_choice(avoids)[1], _nearer(mdp, never, before))
    return _finite(mdp, cost, goal, infinite, row, depth, tolerance, maximize=True)


def _nothing(mdp: HostMDP, cost: Floats, goal: Booleans, infinite: Booleans) -> Booleans:
    """The goal, and the states from which nothing can be earned before it."""
    earning = (cost > 0) & ~goal[mdp.state]
    if earning.all():
        return goal
    some = np.zeros(mdp.num_states, bool)
    some[mdp.state[earning]] = True
    return ~(reaching(mdp, some, ~goal[mdp.state]) | infinite)


def _finite(
    mdp: HostMDP, cost: Floats, goal: Booleans, infinite: Booleans, row: Integers, depth: int,
    tolerance: float, *, maximize: bool, rows: Booleans | None = None,
    first: Integers | None = None,
) -> Enclosed:
    """The finite ones, which never meet the others."""
    open_ = ~(goal | infinite)
    known = np.where(infinite, np.inf, 0.0)
    if not open_.any():
        return Enclosed(known, known, known, row, 0, 0.0, "the graph")
    problem = Transient(mdp, open_, np.zeros(mdp.num_states), cost, rows, first, depth)
    found = _enclosed(problem, row, maximize=maximize, tolerance=tolerance, most=np.inf)
    value, lower, upper = (
        np.where(infinite, np.inf, x) for x in (found.value, found.lower, found.upper))
    return found._replace(value=value, lower=lower, upper=upper)


def _least(
    mdp: HostMDP, cost: Floats, goal: Booleans, depth: int, tolerance: float
) -> Enclosed:
    finite, rows = surely_reaching(mdp, goal, np.isfinite(cost) | goal[mdp.state])
    rows &= ~goal[mdp.state]
    if mdp.is_chain:
        row: Any = mdp.row_start[:-1].astype(np.int64)
        goal = _nothing(mdp, cost, goal, ~finite)
        return _finite(mdp, cost, goal, ~finite, row, depth, tolerance, maximize=False, rows=rows)
    # What can surely be done for nothing is worth nothing.
    free = rows & (cost == 0)
    nothing, stays = surely_reaching(mdp, goal, free | goal[mdp.state])
    row = _nearer(mdp, goal, stays)
    circles = end_components(mdp, finite & ~nothing, free)
    if not circles.inside.any():
        first = _nearer(mdp, nothing, rows)
        return _finite(mdp, cost, nothing, ~finite, row, depth, tolerance, maximize=False,
                       rows=rows, first=first)
    # Where going round costs nothing, states are one.
    part = merged(mdp, circles.component, circles.inside, cost)
    small = part.mdp
    goal_, finite_ = (np.zeros(small.num_states, bool) for _ in range(2))
    goal_[part.node[nothing]], finite_[part.node[finite]] = True, True
    kept = rows[part.row] & ~circles.inside[part.row]
    first = _nearer(small, goal_, kept)
    found = _finite(small, part.cost, goal_, ~finite_, small.row_start[:-1].astype(np.int64),
                    depth, tolerance, maximize=False, rows=kept, first=first)
    towards = _towards(mdp, circles, part.row[found.row][part.node])
    return found._replace(
        value=found.value[part.node], lower=found.lower[part.node], upper=found.upper[part.node],
        row=np.where(nothing, row, towards))


def reward_forever(
    mdp: HostMDP, reward: Floats, *, maximize: bool, tolerance: float = 1e-6
) -> Enclosed:
    """The largest or smallest expected reward in all.

    The largest is infinite where an end component that earns can be reached; other end components
    earn nothing and are left at most once. The smallest is what is earned until nothing more need
    be, and infinite where that is not so almost surely.

    Args:
      mdp: the model.
      reward: ``float[R]``, at least 0.
      maximize: which of the two.
      tolerance: the width of the enclosure asked for, as a share of the value.
    """
    if not maximize or mdp.is_chain:
        earning = reward > 0
        never = ~_kept_away(mdp, earning)
        found = total_reward(mdp, reward, never, maximize=False, tolerance=tolerance)
        quiet = never[mdp.state] & ~earning & ~mdp.support.lead_to(~never)
        return found._replace(row=np.where(never, mdp.first_choice(quiet)[1], found.row))
    components = end_components(mdp)
    earns = np.zeros(mdp.num_states, bool)
    earns[components.component[mdp.state[components.inside & (reward > 0)]]] = True
    rich = earns[components.component]
    infinite = reaching(mdp, rich)
    part = merged(mdp, components.component, components.inside, reward)
    small = part.mdp
    left = np.zeros(small.num_states, bool)  # nodes that some row leaves
    left[small.state[~components.inside[part.row]]] = True
    infinite_ = np.zeros(small.num_states, bool)
    infinite_[part.node[infinite]] = True
    row = small.row_start[:-1].astype(np.int64)
    found = _finite(small, part.cost, ~left, infinite_, row, 0, tolerance, maximize=True)
    towards = _towards(mdp, components, part.row[found.row][part.node])
    endless = _earning(mdp, components, rich, reward)
    return found._replace(
        value=found.value[part.node], lower=found.lower[part.node], upper=found.upper[part.node],
        row=np.where(infinite, endless, towards))


def _kept_away(mdp: HostMDP, rows: Booleans) -> Booleans:
    """The states from which no policy surely avoids some rows for ever: ``bool[S]``."""
    nothing = np.zeros(mdp.num_states, bool)
    return forced(mdp, nothing, ~rows)


def _earning(
    mdp: HostMDP, components: Components, rich: Booleans, reward: Floats
) -> Integers:
    """A policy that gets to components that earn, and earns there for ever."""
    paid = components.inside & (reward > 0)
    some, first = mdp.first_choice(paid)
    inner = _nearer(mdp, some, components.inside)
    outer = _nearer(mdp, rich, np.ones(mdp.num_rows, bool))
    return np.where(some, first, np.where(rich, inner, outer))


def worst_width(found: Enclosed, *, relative: bool) -> float:
    """The widest enclosure, as a share of the value where that is asked for."""
    low, high = found.lower, found.upper
    finite = np.isfinite(high)
    width: Any = np.where(finite, high - np.where(finite, low, 0), np.where(low == high, 0, np.inf))
    if relative:
        width = np.where(width > 0, width / np.maximum(np.where(finite, high, 1), 1e-300), 0)
    return float(width.max(initial=0))
