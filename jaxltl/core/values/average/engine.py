"""Engine of long-run average rewards, for concrete models of every kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Rewards
from jaxltl.core.sparse.interval.average_reward import AverageGame, AverageGoal, optimal_average
from jaxltl.core.sparse.interval.robust_values import RobustValues
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.solvers.average_reward import RewardRange, Scale, average as exact_average
from jaxltl.core.sparse.solvers.average_reward import within_range
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import Accuracy, AverageReward, Question
from jaxltl.core.values.engine.host_solution import policy_chain, with_given_policy
from jaxltl.core.values.engine.row_form import RowForm, row_form
from jaxltl.core.values.engine.state_quantities import (
    finite_reward,
    reward_span,
    solution_from_error,
    transition_reward,
)
from jaxltl.core.values.interval.sides import directions

_TOLERANCE, _MAX_STEPS = 1e-6, 1_000_000


def average(
    model: Model, question: Question, accuracy: Accuracy, *, max_steps: int = _MAX_STEPS
) -> Solution:
    """The average of an MDP by its gains, of a game or an interval model as that of two players."""
    path, form, policy = question.path, row_form(model), question.policy
    assert isinstance(path, AverageReward)
    rewards, tolerance = form.reward(path.reward), float(accuracy.width(_TOLERANCE))
    earned, magnitude = finite_reward(form.sparse, rewards)
    goal = AverageGoal(_range(rewards), tolerance, max_steps)
    has_sets, probability = form.interval is not None, None
    if not has_sets and form.system is None:
        enclosure = _of_one_player(form, (earned, magnitude), question, goal)
    else:
        game, row = _game(form, rewards, question)
        values = optimal_average(game, goal)
        enclosure = _original(values, row, form.sparse.num_states)
        probability = values.probability if has_sets and policy is None else None
    small = 1e-6 if (earned >= 0).all() else 1e-3
    error = np.maximum(enclosure.upper - enclosure.value, enclosure.value - enclosure.lower)
    least = small * float(magnitude.max())
    solution = solution_from_error(
        enclosure.value,
        error,
        form.actions(enclosure.row),
        enclosure.rounds,
        enough=tolerance / 2 * np.maximum(np.abs(enclosure.value), least),
        span=(goal.ends.least, goal.ends.largest),
    )
    parts: dict[str, Array] = {
        name: getattr(solution, name).reshape(form.shape) for name in ("value", "lower", "upper")
    }
    parts |= {"residual": np.float64(enclosure.residual), "nature": probability}
    return with_given_policy(replace(solution, **parts, method=enclosure.method), policy)


def _range(rewards: Rewards) -> RewardRange:
    """The range of a step's reward; ends are exact if nothing is added, or nothing but zeros."""
    least, largest = reward_span(rewards)
    parts = [x for x in (rewards.state, rewards.choice, rewards.transition) if x is not None]
    alone = rewards.transition is None and len(parts) <= 1
    least_zero = not any(np.min(x) for x in parts)
    largest_zero = not any(np.max(x) for x in parts)
    return RewardRange(least, largest, (alone or least_zero, alone or largest_zero))


def _of_one_player(
    form: RowForm, rewards: tuple[Floats, Floats], question: Question, goal: AverageGoal
) -> Enclosure:
    """The average of an MDP, or of the chain of a policy."""
    host, ends, depth = form.host, goal.ends, 0
    sign = 1 if question.objective == "max" else -1
    if question.policy is not None:
        chain = policy_chain(host, form.weights(question.policy))
        rewards = chain.mean(rewards[0], host.row_start), chain.mean(rewards[1], host.row_start)
        host, depth = chain.mdp, chain.depth
        if chain.depth:  # means of equal rewards may differ by their rounding
            ends = ends._replace(is_exact=(False, False))
    earned = sign * rewards[0]
    enclosure = exact_average(
        host,
        earned,
        rewards[1],
        tolerance=goal.tolerance,
        max_steps=goal.max_steps,
        scale=Scale(sign, depth),
    )
    enclosure = within_range(host, earned, enclosure, ends if sign > 0 else ends.negated)
    if sign > 0:
        return enclosure
    low, high = -enclosure.upper, -enclosure.lower
    return replace(enclosure, value=-enclosure.value, lower=low, upper=high)


def _game(form: RowForm, rewards: Rewards, question: Question) -> tuple[AverageGame, Integers]:
    """The game of a model, under a policy of the system, and the original row of each row."""
    host, points = form.host, form.host.probability
    aims = directions(question.objective, question.nature, question.environment)
    own = np.ones(host.num_states, bool) if form.system is None else form.system
    game = AverageGame(
        UncertainMDP(host, points, points) if form.interval is None else form.interval.host,
        transition_reward(form.sparse, rewards),
        np.where(own, aims.system, aims.environment),
        None if form.interval is None else aims.nature,
    )
    if question.policy is None:
        return game, np.arange(host.num_rows)
    weight = form.weights(question.policy)
    if np.isin(weight[own[host.state]], (0, 1)).all():
        small, row, _ = game.restricted(~own[host.state] | (weight > 0))
        return small, row
    weight = weight / np.where(own, host.over_choices(np.add, weight), 1)[host.state]
    return game.with_half_steps(own, weight)


def _original(values: RobustValues, row: Integers, num_states: int) -> Enclosure:
    """Values and rows of the original states."""
    value, lower, upper = (x[:num_states] for x in (values.value, values.lower, values.upper))
    rows = row[values.row[:num_states]]
    return Enclosure(value, lower, upper, rows, values.rounds, values.residual, values.method)
