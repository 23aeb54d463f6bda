"""Certified reachability probabilities and total expected rewards of sparse MDPs.

Qualitative preprocessing comes first: chains of single successors are contracted, states with
probability 0 or 1, or with infinite reward, are found in the graph, and end components become
single states of a quotient. The remaining stochastic shortest path problem has one solution, which
Gauss-Seidel sweeps enclose if the model mixes well, and policy iteration otherwise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.contraction import Contraction, contract_chains, identity, quotient
from jaxltl.core.sparse.graph.qualitative import (
    SparseEndComponents,
    almost_sure_reachability,
    backward_reachable,
    end_components,
    positive_under_all_policies,
    shortest_path_rows,
)
from jaxltl.core.sparse.linear.gauss_seidel import (
    BlockProblem,
    SweepSettings,
    row_blocks,
    solve_by_sweeps,
)
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import group_starts, mask_of, row_entries
from jaxltl.core.sparse.solvers.policy_iteration import policy_iteration
from jaxltl.core.sparse.solvers.shortest_path_problem import (
    TINY,
    Enclosure,
    RelativeTolerance,
    ShortestPathProblem,
)

_EPS = float(np.finfo(np.float64).eps)
_TINY = 1e-200  # upper bounds below which the graph decides whether a total reward is 0
# A model mixes well, so that sweeps beat elimination, if a search meets many states in few steps.
_LARGE, _MET, _STEPS = 20_000, 4096, 10  # of as many interior states: that many, in that many steps
_SOME, _FEW = 400, 5  # of fewer states: half of them


@dataclass(frozen=True)
class ReducedProblem:
    """Residual problem after qualitative preprocessing."""

    known_value: Floats  # float64[N], of the nodes outside the problem's interior
    known_row: Integers  # int[N], their policy
    mdp: HostMDP
    # on the nodes of `quotient`, or else of `contraction`; None if nothing is left
    problem: ShortestPathProblem | None = None
    # of `contraction.mdp`, the model with end components as states; None without any
    quotient: Contraction | None = None
    components: SparseEndComponents | None = None
    # nodes of `contraction` with rows known in advance (fixed, fixed_row)
    fixed: Booleans | None = None
    fixed_row: Integers | None = None
    without_chains: Contraction | None = None
    highest: float = 1.0  # a bound on all values
    maximize: bool = False  # whether to maximise

    @property
    def contraction(self) -> Contraction:
        """The model without chains."""
        assert self.without_chains is not None
        return self.without_chains


def reachability(
    mdp: HostMDP,
    target: Booleans,
    *,
    maximize: bool,
    stay: Booleans | None = None,
    tolerance: float = 1e-6,
    depth: int = 0,
) -> Enclosure:
    """Optimal probability of reaching a target through states where one may stay."""
    reduced = reduce_reachability(mdp, target, maximize=maximize, stay=stay, depth=depth)
    return _solve(reduced, tolerance)


def avoidance(
    mdp: HostMDP,
    target: Booleans,
    *,
    maximize: bool,
    stay: Booleans | None = None,
    tolerance: float = 1e-6,
    depth: int = 0,
) -> Enclosure:
    """Optimal probability of the complement of :func:`reachability`, with small relative errors.

    The residual problem is the same, with 1 where the target is never reached and 0 where it is
    reached almost surely, so that no probability is subtracted from 1.
    """
    reduced = reduce_reachability(mdp, target, maximize=not maximize, stay=stay, depth=depth)
    known, problem = 1 - reduced.known_value, reduced.problem
    if problem is not None:
        end = np.where(problem.interior, 0.0, 1 - problem.terminal_value)
        problem = replace(problem, terminal_value=end)
    reduced = replace(reduced, known_value=known, problem=problem, maximize=maximize)
    return _solve(reduced, tolerance)


def total_reward(
    mdp: HostMDP,
    reward: Floats,
    target: Booleans,
    *,
    maximize: bool,
    tolerance: float = 1e-6,
    depth: int = 0,
) -> Enclosure:
    """Optimal expected reward until a target, to a tolerance relative to the value.

    Infinite where the target is not reached almost surely: for a maximum under some policy, for a
    minimum under every policy. Rewards ``float64[R]`` are at least 0, and infinite for rows that
    must not be taken; `depth` is the number of roundings behind each number of the model.
    """
    reduced = reduce_total_reward(mdp, reward, target, maximize=maximize, depth=depth)
    return _with_zeros(mdp, reward, target, maximize, _solve(reduced, tolerance))


def _with_zeros(
    mdp: HostMDP, reward: Floats, target: Booleans, maximize: bool, enclosure: Enclosure
) -> Enclosure:
    """The enclosure of a total reward, exactly 0 where the graph decides that it is.

    Only where the upper bound is tiny: errors of values that are 0 are.
    """
    tiny = (enclosure.lower <= 0) & (enclosure.upper > 0) & (enclosure.upper < _TINY)
    if not tiny.any():
        return enclosure
    if maximize:
        inner = ~target[mdp.state]
        zero = ~backward_reachable(mdp, mdp.states_of(inner & (reward > 0)), inner)
    else:
        zero = almost_sure_reachability(mdp, target, reward == 0)[0]
    parts = (np.where(tiny & zero, 0, x) for x in (enclosure.value, enclosure.upper))
    value, upper = parts
    return replace(enclosure, value=value, upper=upper)


def reward_forever(
    mdp: HostMDP, reward: Floats, *, maximize: bool, tolerance: float = 1e-6, depth: int = 0
) -> Enclosure:
    """Optimal expected reward over the infinite horizon; arguments as of :func:`total_reward`.

    The maximum is infinite where an end component with positive reward is reachable. The minimum
    is the reward until a state from which some policy earns nothing more, infinite where that is
    not reached almost surely.
    """
    if not maximize or mdp.is_chain:
        earning = reward > 0
        nothing = np.zeros(mdp.num_states, bool)
        never = ~positive_under_all_policies(mdp, nothing, ~earning)
        enclosure = total_reward(
            mdp, reward, never, maximize=False, tolerance=tolerance, depth=depth
        )
        quiet = never[mdp.state] & ~earning & ~mdp.support.some_successor_in(~never)
        return replace(enclosure, row=np.where(never, mdp.first_choice(quiet)[1], enclosure.row))
    components = end_components(mdp)
    earns = np.zeros(mdp.num_states, bool)
    paid = components.inside & (reward > 0)
    earns[components.component[mdp.state[paid]]] = True
    rich = earns[components.component]
    infinite = backward_reachable(mdp, rich)
    part = quotient(mdp, components.component, components.inside, reward)
    small = part.mdp
    finished = np.ones(small.num_states, bool)  # nodes that no row leaves
    finished[small.state[~components.inside[part.row]]] = False
    row = small.row_start[:-1].astype(np.int64)
    reduced = _finite_part(small, part.cost, finished, part.region(infinite), depth)
    reduced = replace(reduced, known_row=row, highest=np.inf, maximize=True)
    enclosure = _solve_nodes(reduced, tolerance)
    leaving = quotient_policy(mdp, components, part.row[enclosure.row][part.node])
    # Where it is infinite: to components with positive reward, and earning there forever.
    some, first = mdp.first_choice(paid)
    inner = shortest_path_rows(mdp, some, components.inside)
    outer = shortest_path_rows(mdp, rich, np.ones(mdp.num_rows, bool))
    endless = np.where(some, first, np.where(rich, inner, outer))
    whole = _at(enclosure, part.node, np.where(infinite, endless, leaving))
    return _with_zeros(mdp, reward, np.zeros(mdp.num_states, bool), True, whole)


# --- qualitative preprocessing --------------------------------------------------------------------


def reduce_reachability(
    mdp: HostMDP, target: Booleans, *, maximize: bool, stay: Booleans | None = None, depth: int = 0
) -> ReducedProblem:
    """Residual problem of :func:`reachability`, with the same arguments."""
    blocked = np.zeros(mdp.num_states, bool) if stay is None else ~stay & ~target
    contraction = contract_chains(mdp, target | blocked, None) or identity(mdp)
    small, depth = contraction.mdp, contraction.depth + depth
    goal, dead = contraction.region(target), contraction.region(blocked)
    maximize = maximize and not small.is_chain
    reduced = (_largest if maximize else _smallest)(small, goal, dead, depth)
    return replace(reduced, mdp=mdp, without_chains=contraction, maximize=maximize)


def _smallest(mdp: HostMDP, goal: Booleans, dead: Booleans, depth: int) -> ReducedProblem:
    """The minimum: zero where some policy avoids the goal, one where none reaches such states."""
    zero = dead | ~positive_under_all_policies(mdp, goal, among=~dead)
    one = goal | ~backward_reachable(mdp, zero, ~(goal | dead)[mdp.state])
    stays = ~mdp.support.some_successor_in(~zero) & zero[mdp.state]
    return _between(mdp, zero, one, mdp.first_choice(stays)[1], depth)


def _largest(mdp: HostMDP, goal: Booleans, dead: Booleans, depth: int) -> ReducedProblem:
    """The maximum, on the quotient by end components, which every policy leaves."""
    inner = ~(goal | dead)
    zero = ~backward_reachable(mdp, goal, inner[mdp.state])
    components = end_components(mdp, inner & ~zero)
    if not components.inside.any():
        return _largest_without_components(mdp, goal, zero, depth)
    part = quotient(mdp, components.component, components.inside, np.zeros(mdp.num_rows))
    reduced = _largest_without_components(part.mdp, part.region(goal), part.region(zero), depth)
    return replace(reduced, quotient=part, components=components)


def _largest_without_components(
    mdp: HostMDP, goal: Booleans, zero: Booleans, depth: int
) -> ReducedProblem:
    one = ~positive_under_all_policies(mdp, zero, among=~goal)
    stays = ~mdp.support.some_successor_in(~one) & one[mdp.state]
    return _between(mdp, zero, one, mdp.first_choice(stays)[1], depth)


def _between(
    mdp: HostMDP, zero: Booleans, one: Booleans, row: Integers, depth: int
) -> ReducedProblem:
    """The problem of the probabilities that are neither zero nor one."""
    interior, known = ~(zero | one), one.astype(np.float64)
    problem = None
    if interior.any():
        cost = np.zeros(mdp.num_rows)
        problem = ShortestPathProblem(mdp, interior, known, cost, depth=depth)
    return ReducedProblem(known, row.astype(np.int64), mdp, problem)


def reduce_total_reward(
    mdp: HostMDP,
    reward: Floats,
    target: Booleans,
    *,
    maximize: bool,
    kept: Booleans | None = None,
    depth: int = 0,
) -> ReducedProblem:
    """Residual problem of :func:`total_reward`; states in `kept` are not contracted."""
    fixed = target if kept is None else target | kept
    contraction = contract_chains(mdp, fixed, reward) or identity(mdp, reward)
    contraction = replace(contraction, depth=contraction.depth + depth)
    small, cost = contraction.mdp, contraction.cost
    maximize = maximize and not small.is_chain
    reduce = _largest_reward if maximize else _smallest_reward
    reduced = reduce(small, cost, contraction.region(target), contraction.depth)
    return replace(reduced, mdp=mdp, without_chains=contraction, highest=np.inf, maximize=maximize)


def _largest_reward(mdp: HostMDP, cost: Floats, goal: Booleans, depth: int) -> ReducedProblem:
    """The maximum: infinite where states are reachable from which the goal can be avoided."""
    never = ~positive_under_all_policies(mdp, goal)
    before = ~goal[mdp.state]
    infinite = backward_reachable(mdp, never, before)
    avoids = ~mdp.support.some_successor_in(~never) & never[mdp.state]
    reduced = _finite_part(mdp, cost, _without_reward(mdp, cost, goal, infinite), infinite, depth)
    if not infinite.any():
        return reduced
    onward = shortest_path_rows(mdp, never, before)
    return replace(reduced, known_row=np.where(never, mdp.first_choice(avoids)[1], onward))


def _without_reward(mdp: HostMDP, cost: Floats, goal: Booleans, infinite: Booleans) -> Booleans:
    """The goal, and the states from which no reward is reachable before it."""
    earning = (cost > 0) & ~goal[mdp.state]
    if earning.all():
        return goal
    return ~(backward_reachable(mdp, mdp.states_of(earning), ~goal[mdp.state]) | infinite)


def _finite_part(
    mdp: HostMDP, cost: Floats, zero: Booleans, infinite: Booleans, depth: int
) -> ReducedProblem:
    """The problem of the rewards that are neither zero nor infinite."""
    interior, known = ~(zero | infinite), np.where(infinite, np.inf, 0.0)
    problem = None
    if interior.any():
        end = np.zeros(mdp.num_states)
        problem = ShortestPathProblem(mdp, interior, end, cost, depth=depth)
    return ReducedProblem(known, mdp.row_start[:-1].astype(np.int64), mdp, problem)


def _restricted(
    reduced: ReducedProblem, allowed: Booleans, proper_policy: Integers | None
) -> ReducedProblem:
    if reduced.problem is None:
        return reduced
    problem = replace(reduced.problem, allowed=allowed, proper_policy=proper_policy)
    return replace(reduced, problem=problem)


def _smallest_reward(mdp: HostMDP, cost: Floats, goal: Booleans, depth: int) -> ReducedProblem:
    """The minimum over policies that reach the goal almost surely."""
    finite, rows = almost_sure_reachability(mdp, goal, np.isfinite(cost) | goal[mdp.state])
    rows &= ~goal[mdp.state]
    if mdp.is_chain:
        zero = _without_reward(mdp, cost, goal, ~finite)
        return _restricted(_finite_part(mdp, cost, zero, ~finite, depth), rows, None)
    free = rows & (cost == 0)
    zero, stays = almost_sure_reachability(mdp, goal, free | goal[mdp.state])
    row = shortest_path_rows(mdp, goal, stays)
    components = end_components(mdp, finite & ~zero, free)
    if not components.inside.any():
        proper = shortest_path_rows(mdp, zero, rows)
        reduced = _finite_part(mdp, cost, zero, ~finite, depth)
        return replace(_restricted(reduced, rows, proper), known_row=row)
    # End components without cost become single states.
    part = quotient(mdp, components.component, components.inside, cost)
    goal, kept = part.region(zero), rows[part.row] & ~components.inside[part.row]
    reduced = _finite_part(part.mdp, part.cost, goal, ~part.region(finite), depth)
    reduced = _restricted(reduced, kept, shortest_path_rows(part.mdp, goal, kept))
    return replace(reduced, quotient=part, components=components, fixed=zero, fixed_row=row)


# --- solution -------------------------------------------------------------------------------------


def _solve(reduced: ReducedProblem, tolerance: float) -> Enclosure:
    """The solution, mapped back to the states of the model."""
    enclosure = _solve_nodes(reduced, tolerance)
    mdp, contraction = reduced.mdp, reduced.contraction
    if reduced.quotient is not None and reduced.components is not None:
        node = reduced.quotient.node
        taken = reduced.quotient.row[enclosure.row][node]
        row = quotient_policy(contraction.mdp, reduced.components, taken)
        if reduced.fixed is not None and reduced.fixed_row is not None:
            row = np.where(reduced.fixed, reduced.fixed_row, row)
        enclosure = _at(enclosure, node, row)
    if contraction.node.size == contraction.mdp.num_states:
        return enclosure
    row = mdp.row_start[:-1].astype(np.int64)
    # A node is the only state with its rows; all others have one row.
    own = mdp.state[contraction.row[contraction.mdp.row_start[:-1]]]
    row[own] = contraction.row[enclosure.row]
    enclosure, earned = _at(enclosure, contraction.node, row), contraction.earned
    if not earned.any():
        return enclosure
    share = contraction.depth * _EPS
    return replace(
        enclosure,
        value=enclosure.value + earned,
        lower=(enclosure.lower + earned * (1 - share)) * (1 - _EPS),
        upper=(enclosure.upper + earned * (1 + share)) * (1 + _EPS),
    )


def _at(enclosure: Enclosure, node: Integers, row: Integers) -> Enclosure:
    """The bounds of the nodes of some states, with their rows."""
    value, lower, upper = enclosure.value[node], enclosure.lower[node], enclosure.upper[node]
    return replace(enclosure, value=value, lower=lower, upper=upper, row=row)


def _solve_nodes(reduced: ReducedProblem, tolerance: float) -> Enclosure:
    known, highest, problem = reduced.known_value, reduced.highest, reduced.problem
    if problem is None:
        return Enclosure(known, known, known, reduced.known_row, 0, 0.0, "the graph")
    relative = isinstance(tolerance, RelativeTolerance) or not np.isfinite(highest)
    enclosure = solve_shortest_path(
        problem, maximize=reduced.maximize, tolerance=float(tolerance), relative=relative
    )
    infinite = np.isinf(known)
    value, lower, upper = (
        np.where(infinite, np.inf, np.clip(x, 0, highest))
        for x in (enclosure.value, enclosure.lower, enclosure.upper)
    )
    row = np.where(problem.interior, enclosure.row, reduced.known_row)
    return replace(enclosure, value=value, lower=lower, upper=upper, row=row)


def quotient_policy(
    mdp: HostMDP, components: SparseEndComponents, row: Integers, otherwise: Integers | None = None
) -> Integers:
    """The policy that leaves end components by some rows; `otherwise` where `row` is -1."""
    policy: Integers = mdp.row_start[:-1].astype(np.int64) if otherwise is None else otherwise
    moves = row >= 0
    own = moves & (mdp.state[np.maximum(row, 0)] == np.arange(mdp.num_states))
    inner = moves & components.region(mdp) & ~own
    if inner.any():
        policy = np.where(inner, shortest_path_rows(mdp, own, components.inside), policy)
    return np.where(own, row, policy)


def solve_shortest_path(
    problem: ShortestPathProblem, *, maximize: bool, tolerance: float, relative: bool
) -> Enclosure:
    """Certified optimum by sweeps where the model mixes well, by policy iteration otherwise."""
    size = int(np.count_nonzero(problem.interior))
    if size >= _SOME and mixes(problem, size):
        enclosure = sweep_shortest_path(
            problem, maximize=maximize, tolerance=tolerance, relative=relative
        )
        if enclosure is not None:
            return enclosure
    return policy_iteration(problem, maximize=maximize, tolerance=tolerance, relative=relative)


def mixes(problem: ShortestPathProblem, size: int) -> bool:
    """True if few steps from a state lead to many others."""
    mdp, interior = problem.mdp, problem.interior
    first = mdp.entry_start[mdp.row_start]

    def follow(states: Integers) -> Integers:
        after = mdp.successor[row_entries(first, states)[0]]
        return after[interior[after]]

    middle = np.flatnonzero(interior)[size // 2 : size // 2 + 1]
    if size >= _LARGE:
        return expands_fast(follow, middle, mdp.num_states)
    return expands_fast(follow, middle, mdp.num_states, min(_MET, size // 2), _FEW)


def expands_fast(
    follow: Callable[[Integers], Integers],
    start: Integers,
    num_states: int,
    met: int | None = None,
    steps: int = _STEPS,
) -> bool:
    """True if few steps from a state lead to many others."""
    remaining = (_MET if met is None else met) - 1
    seen = mask_of(start, num_states)
    for _ in range(steps):
        if remaining <= 0:
            return True
        after = follow(start)
        start = np.unique(after[~seen[after]])
        seen[start] = True
        remaining -= start.size
    return remaining <= 0


def sweep_shortest_path(
    problem: ShortestPathProblem, *, maximize: bool, tolerance: float, relative: bool
) -> Enclosure | None:
    """The optimum by certified Gauss-Seidel sweeps; None where these take too long."""
    mdp, sign, known = problem.mdp, 1 if maximize else -1, problem.terminal_value
    weight, allowed = _stochastic_loops(problem)
    widest = int(np.diff(mdp.entry_start).max())
    unit = (4 * widest + problem.depth + 16) * _EPS
    cost = problem.cost if allowed is None else np.where(allowed, problem.cost, 0)
    blocks = row_blocks(mdp.row_start, mdp.entry_start, mdp.successor, weight, mdp.num_states)
    bounds = solve_by_sweeps(
        BlockProblem(
            blocks=blocks,
            interior=problem.interior,
            live=problem.interior,
            attained=known,
            outer=known,
            cost=cost if cost.any() else None,
            allowed=allowed,
        ),
        SweepSettings(sign=sign, tolerance=tolerance, relative=relative, unit=unit),
    )
    if bounds is None:
        return None
    low, high = (bounds.attained, bounds.outer) if sign > 0 else (bounds.outer, bounds.attained)
    low = np.where(problem.interior, np.maximum(low - TINY, 0), known)
    high = np.where(problem.interior, high + TINY, known)
    value = low + (high - low) / 2
    # The operator carries the bounds towards each other, so the value by at most half the width.
    residual = float(((high - value) / np.maximum(value, 1))[problem.interior].max(initial=0))
    row = np.where(problem.interior, bounds.row, mdp.row_start[:-1])
    return Enclosure(value, low, high, row, bounds.sweeps, residual, "sweeps in place")


def _stochastic_loops(problem: ShortestPathProblem) -> tuple[Floats, Booleans | None]:
    """Weights with self-loops such that rows sum to one, and the rows that are not only a loop."""
    mdp = problem.mdp
    loop = np.flatnonzero(mdp.successor == mdp.state[mdp.row])
    if not loop.size:
        return mdp.probability, problem.allowed
    weight = mdp.probability.copy()
    weight[loop] = 0
    first = loop[group_starts(mdp.row[loop])]  # a row may repeat its successors
    row = mdp.row[first]
    entry, width = row_entries(mdp.entry_start, row)
    rest = np.add.reduceat(weight[entry], width.cumsum() - width)
    weight[first] = np.maximum(1 - rest, 0)
    allowed = np.ones(mdp.num_rows, bool) if problem.allowed is None else problem.allowed.copy()
    allowed[row[rest == 0]] = False
    return weight, allowed
