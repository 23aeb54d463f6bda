"""Certified reachability probabilities of uncertain MDPs.

A policy and a cooperative nature are one player: policy iteration on the quotient by joint end
components. An adversarial nature adds strategy improvement where these bounds are too wide.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from jaxltl.core.sparse.rows import mask_of
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import SparseEndComponents, shortest_path_rows
from jaxltl.core.sparse.interval.policy_iteration import PathAccuracy, PathProblem, enclose_paths
from jaxltl.core.sparse.interval.qualitative import (
    attracting_rows,
    certain_choices,
    joint_end_components,
    zero_one_states,
)
from jaxltl.core.sparse.interval.robust_values import (
    Query,
    RobustValues,
    distribution_depth,
    gain_noise,
)
from jaxltl.core.sparse.interval.strategy_iteration import (
    MDPSolver,
    Subproblems,
    enclosed_values,
    improve_strategies,
    under_nature,
)
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers import reachability as mdp_reachability
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure

METHOD = "policy iteration with nature"
_STARTS = 60  # improvements by value iteration before strategy iteration
_SWEEPS = 100  # sweeps of each
_SLOW = 1e-7  # change of a sweep at which choices are improved
_SMALL_CHANGE = 1e-5  # change since the last improvement at which value iteration ends


def reachability(
    model: UncertainMDP, target: Booleans, query: Query, *, stay: Booleans | None = None
) -> RobustValues:
    """Optimal probability of reaching a target through states of `stay` (default all).

    The bounds enclose both readings of sums of ends that are one up to rounding.
    """
    stop = target if stay is None else target | ~stay
    return hull_of_readings(
        model,
        lambda x: _reachability(x, target, stop, query),
        lambda x: zero_one_states(x.with_absorbing(stop)[0], target, query),
    )


def hull_of_readings(
    model: UncertainMDP,
    solve: Callable[[UncertainMDP], RobustValues],
    decided: Callable[[UncertainMDP], tuple[Booleans, ...]],
) -> RobustValues:
    """Bounds for both readings of sums of ends, if these decide states differently."""
    values, wide = solve(model), model.enlarged
    if wide is None or all(map(np.array_equal, decided(model), decided(wide))):
        return values
    return values.hull(solve(wide))


def _reachability(
    model: UncertainMDP, target: Booleans, stop: Booleans, query: Query
) -> RobustValues:
    absorbing, row = model.with_absorbing(stop)

    def fixed_nature(mdp: HostMDP, _: Floats, maximize: bool) -> Enclosure:
        depth = query.depth + distribution_depth(mdp)
        return mdp_reachability.reachability(
            mdp, target, maximize=maximize, tolerance=query.tolerance / 2, depth=depth
        )

    def joint(part: UncertainMDP, _: Floats, maximize: bool) -> RobustValues:
        both = replace(query, maximize=maximize, nature_maximizes=maximize)
        return _joint(part, target, both, fixed_nature)

    cost, accuracy = np.zeros(absorbing.mdp.num_rows), PathAccuracy(query.tolerance)
    solve = Subproblems(fixed_nature, joint, cost, accuracy)
    if query.cooperative:
        values = joint(absorbing, cost, query.maximize)
    elif (both := _opposed(absorbing, target, query)) is not None:
        values = both
    else:
        first = _first_choices(absorbing, target, maximize=query.maximize)
        values = improve_strategies(
            absorbing, first, solve, policy_leads=query.maximize, maximize=True
        )
    return without_absorbing(model, absorbing, row, stop, values)


def _joint(
    model: UncertainMDP, target: Booleans, query: Query, fixed_nature: MDPSolver
) -> RobustValues:
    """Optimal probability where policy and nature cooperate."""
    mdp, up = model.mdp, query.maximize
    zero, one = zero_one_states(model, target, query)
    open_ = ~(zero | one)
    # Choices that keep the value where it is decided.
    keep = one if up else zero
    rows = model.can_stay_in(keep) & keep[mdp.state]
    kept = model.interior_distributions(keep[mdp.successor] & rows[mdp.row])
    chance = np.where(rows[mdp.row], kept, mdp.probability)
    row = (
        shortest_path_rows(model.resolve(chance), target, rows) if up else mdp.first_choice(rows)[1]
    )
    components = joint_end_components(model, open_) if up else None
    problem = PathProblem(
        model=model,
        interior=open_,
        known=one.astype(np.float64),
        cost=np.zeros(mdp.num_rows),
        component=np.arange(mdp.num_states) if components is None else components[0].component,
        maximize=up,
        depth=query.depth,
    )
    pair = np.where(keep, row, mdp.row_start[:-1]).astype(np.int64), chance
    return joint_optimum(problem, PathAccuracy(query.tolerance), components, pair, fixed_nature)


def joint_optimum(
    problem: PathProblem,
    accuracy: PathAccuracy,
    components: tuple[SparseEndComponents, Booleans] | None,
    pair: tuple[Integers, Floats],
    fixed_nature: MDPSolver,
) -> RobustValues:
    """The optimum of policy and nature together; `pair` are their choices in decided states."""
    model, up, (row, chance) = problem.model, problem.maximize, pair
    bound, rounds, highest = problem.known, 0, np.inf if accuracy.relative else 1.0
    best: Enclosure | None = Enclosure(bound, bound, bound, row, 0, 0.0, "")
    if problem.interior.any():
        bounds = enclose_paths(problem, accuracy)
        bound, rounds = np.clip(bounds.beyond, 0, highest), bounds.rounds
        best = bounds.enclosed(problem, accuracy)
        row = np.where(problem.interior, bounds.row, row)
        chance = np.where(
            problem.interior[model.mdp.state][model.mdp.row], bounds.probability, chance
        )
        if components is not None and components[0].inside.any():
            inside, used = components[0].inside, components[1]
            row, chance = move_to_exits(model, (row, chance), problem.component, inside, used)
    if best is None:
        chain, entry = model.under_policy(row)
        best = under_nature(fixed_nature, chain, chance[entry], problem.cost[row], up)
    low, high = best.lower, np.maximum(bound, best.lower)
    if not up:
        low, high = np.minimum(bound, best.upper), np.minimum(best.upper, highest)
    return RobustValues(
        best.value, low, high, row, rounds + best.rounds, best.residual, METHOD, chance
    )


def _opposed(model: UncertainMDP, target: Booleans, query: Query) -> RobustValues | None:
    """The optimum against an adversarial nature, if policy iteration encloses it."""
    mdp, up = model.mdp, query.maximize
    known = zero_one_states(model, target, query)
    row, within = certain_choices(model, target, known, maximize=up)
    chance = mdp.probability if within.all() else model.interior_distributions(within)
    open_, value = ~(known.zero | known.one), known.one.astype(np.float64)
    low = high = value
    rounds = 0
    if open_.any():
        problem = PathProblem(
            model=model,
            interior=open_,
            known=value,
            cost=np.zeros(mdp.num_rows),
            component=np.arange(mdp.num_states),
            maximize=up,
            adversarial=True,
            first=attracting_rows(model, known.one) if up else row,
            depth=query.depth,
        )
        bounds = enclose_paths(problem, PathAccuracy(query.tolerance))
        if bounds.attained is None:
            return None
        low, high = (bounds.attained, bounds.beyond) if up else (bounds.beyond, bounds.attained)
        low, high = np.clip(low, 0, 1), np.clip(high, 0, 1)
        value, rounds = bounds.value, bounds.rounds
        row = np.where(open_, bounds.row, row)
        chance = np.where(open_[mdp.state][mdp.row], bounds.probability, chance)
        if (high - low).max() > query.tolerance:
            return None
    width = float((high - low).max())
    return enclosed_values(value, (low, high), row, chance, rounds=rounds, residual=width)


def move_to_exits(
    model: UncertainMDP,
    pair: tuple[Integers, Floats],
    component: Integers,
    inside: Booleans,
    used: Booleans,
) -> tuple[Integers, Floats]:
    """A pair that moves inside each end component to the state of the row that leaves it."""
    (row, chance), mdp = pair, model.mdp
    exits = mdp.state[row] == np.arange(mdp.num_states)
    inner = mdp.states_of(inside)
    moving = inner & ~exits
    taken = inside & moving[mdp.state]
    kept = model.interior_distributions(used & taken[mdp.row])
    chance = np.where(taken[mdp.row], kept, chance)
    goal = exits | ~inner
    return np.where(moving, shortest_path_rows(model.resolve(chance), goal, taken), row), chance


def _first_choices(
    model: UncertainMDP, target: Booleans, *, maximize: bool
) -> tuple[Integers, Floats]:
    """A policy and an adversarial nature, improved as values rise from zero by value iteration."""
    from scipy.sparse import csr_array

    mdp, value = model.mdp, target.astype(np.float64)
    row = attracting_rows(model, target)
    opt = np.maximum if maximize else np.minimum
    shape = (mdp.num_states, mdp.num_states)
    for _ in range(_STARTS):
        ahead = value[mdp.successor]
        p = model.extreme_distributions(ahead, maximize=not maximize)
        image = model.sum_rows(p * ahead)
        best = mdp.over_choices(opt, image)
        better = np.abs(best - image[row]) > gain_noise(value)
        row = np.where(better, mdp.first_choice(image == best[mdp.state])[1], row)
        kept = mask_of(row, mdp.num_rows)[mdp.row]
        start = np.concatenate([[0], np.diff(mdp.entry_start)[row].cumsum()])
        chain = csr_array((p[kept], mdp.successor[kept], start), shape=shape)
        before = value
        for _ in range(_SWEEPS):
            last, value = value, chain @ value
            if np.abs(value - last).max() <= _SLOW:
                break
        if np.abs(value - before).max() <= _SMALL_CHANGE:
            break
    return row, model.extreme_distributions(value[mdp.successor], maximize=not maximize)


def without_absorbing(
    model: UncertainMDP,
    absorbing: UncertainMDP,
    row: Integers,
    states: Booleans,
    values: RobustValues,
) -> RobustValues:
    """Values of the model with some absorbing states, in the rows and entries of the model."""
    if absorbing is model:
        return values
    chance = model.mdp.probability.copy()
    moves, moved = (~states[x.state[x.row]] for x in (model.mdp, absorbing.mdp))
    chance[moves] = values.probability[moved]
    return replace(values, row=row[values.row], probability=chance)
