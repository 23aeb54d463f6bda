"""Certified expected total rewards of uncertain MDPs until a target is reached."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import backward_reachable
from jaxltl.core.sparse.interval.policy_iteration import PathAccuracy, PathProblem
from jaxltl.core.sparse.interval.qualitative import (
    almost_sure_states,
    attracting_rows,
    joint_end_components,
    preventing_choices,
    zero_one_states,
)
from jaxltl.core.sparse.interval.reachability import (
    hull_of_readings,
    joint_optimum,
    without_absorbing,
)
from jaxltl.core.sparse.interval.robust_values import Query, RobustValues, distribution_depth
from jaxltl.core.sparse.interval.strategy_iteration import (
    MDPSolver,
    Subproblems,
    improve_strategies,
)
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import mask_of, offsets_from_counts
from jaxltl.core.sparse.solvers import reachability as mdp_reachability
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure


def total_reward(
    model: UncertainMDP, reward: Floats, target: Booleans, query: Query
) -> RobustValues:
    """Optimal expected reward until a target is reached; rewards ``float64[R]`` are at least 0.

    Infinite where the target is not reached almost surely: under every pair of choices of the sides
    that minimise, and some choice of those that maximise. The bounds enclose both readings of sums
    of ends that are one up to rounding.
    """
    return hull_of_readings(
        model,
        lambda x: _total_reward(x, reward, target, query),
        lambda x: finite_states(x.with_absorbing(target)[0], target, query)[:1],
    )


def finite_states(model: UncertainMDP, target: Booleans, query: Query) -> tuple[Booleans, Booleans]:
    """States with a finite reward ``bool[S]``, and rows that keep it finite ``bool[R]``."""
    if query.maximize and query.nature_maximizes:
        one = zero_one_states(model, target, query.opposite).one
        return one, one[model.mdp.state]
    return almost_sure_states(model, target, np.ones(target.size, bool), query.opposite)


def _total_reward(
    model: UncertainMDP, reward: Floats, target: Booleans, query: Query
) -> RobustValues:
    absorbing, row = model.with_absorbing(target)
    finite, kept = finite_states(absorbing, target, query)
    part, origin, entry = _restrict(absorbing, finite, kept)
    ends = target | ~finite
    cost = np.where(ends[part.mdp.state], 0, reward[row][origin])

    def fixed_nature(mdp: HostMDP, earned: Floats, maximize: bool) -> Enclosure:
        depth = query.depth + distribution_depth(mdp)
        return mdp_reachability.total_reward(
            mdp, earned, ends, maximize=maximize, tolerance=query.tolerance / 2, depth=depth
        )

    def joint(some: UncertainMDP, earned: Floats, maximize: bool) -> RobustValues:
        both = replace(query, maximize=maximize, nature_maximizes=maximize)
        return _joint(some, earned, ends, both, fixed_nature)

    solve = Subproblems(fixed_nature, joint, cost, PathAccuracy(query.tolerance, relative=True))
    if query.cooperative:
        values = joint(part, cost, query.maximize)
    else:
        p = part.interior_distributions(np.ones(part.mdp.num_transitions, bool))
        first = part.mdp.row_start[:-1] if query.maximize else _first_policy(part, ends, solve)
        pair = first.astype(np.int64), p
        values = improve_strategies(
            part, pair, solve, policy_leads=not query.maximize, maximize=False
        )
    value, lower, upper = (
        np.where(finite, x, np.inf) for x in (values.value, values.lower, values.upper)
    )
    # Nature's distributions are arbitrary in rows that are not taken.
    taken, open_ = np.zeros(absorbing.mdp.num_rows, bool), finite[part.mdp.state]
    taken[origin[open_]] = True
    chance = np.where(taken[absorbing.mdp.row], 0, absorbing.mdp.probability)
    chance[entry[open_[part.mdp.row]]] = values.probability[open_[part.mdp.row]]
    rows = origin[values.row]
    if not finite.all() and (query.maximize or query.nature_maximizes):
        away, entries = preventing_choices(absorbing, target, query.opposite)
        rows = np.where(finite, rows, away)
        infinite = ~finite[absorbing.mdp.state[absorbing.mdp.row]]
        chance = np.where(infinite, absorbing.interior_distributions(entries), chance)
    values = replace(values, value=value, lower=lower, upper=upper, row=rows, probability=chance)
    return without_absorbing(model, absorbing, row, target, values)


def _joint(
    model: UncertainMDP, cost: Floats, target: Booleans, query: Query, fixed_nature: MDPSolver
) -> RobustValues:
    """Optimal reward where policy and nature cooperate, in a model that ends almost surely."""
    mdp, up = model.mdp, query.maximize
    open_ = ~target & (backward_reachable(mdp, mdp.states_of(cost > 0)) if up else True)
    components = None if up else joint_end_components(model, open_, (cost == 0)[mdp.row])
    problem = PathProblem(
        model=model,
        interior=open_,
        known=np.zeros(mdp.num_states),
        cost=cost,
        component=np.arange(mdp.num_states) if components is None else components[0].component,
        maximize=up,
        depth=query.depth,
        may_stay=not up,
    )
    pair = mdp.row_start[:-1].astype(np.int64), mdp.probability
    accuracy = PathAccuracy(query.tolerance, relative=True)
    return joint_optimum(problem, accuracy, components, pair, fixed_nature)


def _first_policy(model: UncertainMDP, goal: Booleans, solve: Subproblems) -> Integers:
    """A policy that reaches a goal almost surely against nature, and cheaply where possible."""
    row = solve.fixed_nature(model.mdp, solve.cost, False).row
    chain, against = model.under_policy(row)[0], Query(maximize=True, nature_maximizes=False)
    sure, _ = almost_sure_states(chain, goal, np.ones(goal.size, bool), against)
    return np.where(sure, row, attracting_rows(model, goal | sure))


def _restrict(
    model: UncertainMDP, inside: Booleans, rows: Booleans
) -> tuple[UncertainMDP, Integers, Integers]:
    """The model of some rows in a set, others absorbing; and its original rows and entries."""
    mdp = model.mdp
    if inside.all() and rows.all():
        return model, np.arange(mdp.num_rows), np.arange(mdp.num_transitions)
    some, first = mdp.first_choice(rows & inside[mdp.state])
    taken = rows & inside[mdp.state]
    taken[first[~some]] = True
    row = np.flatnonzero(taken)
    starts = offsets_from_counts(np.bincount(mdp.state[row], minlength=mdp.num_states))
    part, entry = model.select_rows(starts, row)
    source = part.mdp.state[part.mdp.row]
    kept = inside[part.mdp.successor] & inside[source]
    lone = ~some[source]
    kept = np.where(lone, mask_of(part.mdp.entry_start[:-1], entry.size), kept)
    successor = np.where(lone, source, part.mdp.successor)[kept].astype(np.int32)
    chance = np.where(lone, 1, part.interior_distributions(kept))[kept]
    lower, upper = (np.where(lone, 1, x)[kept] for x in (part.lower, part.upper))
    ball = part.ball
    if ball is not None:
        ball = replace(ball, center=np.where(lone, 1, ball.center)[kept])
    width = np.add.reduceat(kept.astype(np.int64), part.mdp.entry_start[:-1])
    small = HostMDP(starts, offsets_from_counts(width), successor, chance)
    return UncertainMDP(small, lower, upper, ball), row, entry[kept]
