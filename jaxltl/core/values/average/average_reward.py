"""Long-run average rewards of every kind of model."""

from __future__ import annotations

from dataclasses import replace
from typing import Unpack

import numpy as np

from jaxltl.core import validation
from jaxltl.core.models.game import Game
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Reward, Rewards, SparseMDP
from jaxltl.core.sparse.interval.average_reward import AverageGame, AverageGoal, optimal_average
from jaxltl.core.sparse.interval.robust_values import RobustValues
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP

from jaxltl.core.sparse.solvers.average_reward import RewardRange, Scale, average, within_range
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure
from jaxltl.core.types import Solution
from jaxltl.core.values.engine.host_solution import induced_chain
from jaxltl.core.values.engine.model_rows import ModelRows, model_rows
from jaxltl.core.values.engine.state_quantities import (
    finite_reward,
    reward_span,
    solution_from_error,
    transition_reward,
)
from jaxltl.core.values.engine.validated import SolverOptions, validated


@validated(games=True, host=True)
def average_reward(
    model: Model,
    reward: Reward,
    *,
    objective: str = "max",
    nature: str | None = None,
    policy: Array | None = None,
    tolerance: float = 1e-6,
    **options: Unpack[SolverOptions],
) -> Solution:
    """Expected long-run average reward per step, ``lim 1/n E[r_1 + ... + r_n]``: optimal, or of a policy.

    For multichain models too (Puterman 1994, chapter 9): the best expected gain of the end
    component in which a trajectory ends. Gains are enclosed by the span of ``T v - v`` and are the
    terminal rewards of an optimal stopping problem. In games and interval models the optimum of each
    side against a strategy of the other one is such a problem, and bounds the value; strategies are
    those for discounts near 1 (Blackwell 1962). :func:`mean_payoff` is exact, for deterministic games.

    Args:
      model: any concrete model. In a game the environment has the opposite objective.
      reward: of states, choices or transitions, as for
        :func:`~jaxltl.core.models.sparse.choice_reward`; finite.
      objective: ``"max"`` or ``"min"``, of the system; irrelevant for chains.
      nature: of interval models: ``"adversarial"`` (default), against the objective, or
        ``"cooperative"``.
      policy: evaluate this policy, of a game the system's: actions ``int32[S]`` or ``float[S, A]``;
        rows or ``float[R]`` for sparse rows. Default: optimise.
      tolerance: width of the enclosure, relative to the value; for small values relative to a
        millionth of the largest reward (a thousandth, if some are negative).
      max_steps: sweeps of value iteration at most; default 10^6.

    Returns:
      :class:`Solution`; `value` is ``float64`` in the shape of the states. `policy` attains the bound on
      the safe side (`lower` of a maximum), for both players of a game and with `nature` of interval
      models: actions ``int32[S]``, or rows for sparse rows. `residual` is half the width of the gain's
      widest enclosure. PRECISION where bounds are valid and wider than the tolerance. Concrete arrays
      only; not differentiable.

    Raises:
      ValueError: the reward, the objective, the policy, or `nature` of a model without intervals.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 2, 3, 4, 5], [1, 2, 0, 1, 2],
      ...                     [0.25, 0.75, 1, 1, 1])
      >>> found = average_reward(model, [3.0, 8.0, 4.0])
      >>> found.value.round(9).tolist(), found.policy.tolist()
      ([5.0, 8.0, 4.0], [0, 2, 3])
    """
    (max_steps,) = validation.options("average_reward", options, max_steps=1_000_000)
    world = model_rows(model, objective, nature)
    sparse, sets, rewards = world.sparse, world.sets, world.rewards(reward)
    earned, magnitude = finite_reward(sparse, rewards)
    goal = AverageGoal(_range(rewards), tolerance, max_steps)
    if sets is None and not isinstance(model, Game):
        enclosure = _of_one_player(model, sparse, (earned, magnitude), objective, policy, goal)
    else:
        game, row = _game(world, rewards, policy)
        values = optimal_average(game, goal)
        enclosure = _original(values, row, sparse.num_states)
    small = 1e-6 if (earned >= 0).all() else 1e-3
    error = np.maximum(enclosure.upper - enclosure.value, enclosure.value - enclosure.lower)
    least = small * float(magnitude.max())
    solution = solution_from_error(
        enclosure.value,
        error,
        enclosure.row,
        enclosure.rounds,
        enough=tolerance / 2 * np.maximum(np.abs(enclosure.value), least),
        span=(goal.ends.least, goal.ends.largest),
    )
    nature_choice: Array | None = None
    if sets is not None and policy is None:
        nature_choice = values.probability
    residual: Array = np.float64(enclosure.residual)
    solution = replace(solution, residual=residual, nature=nature_choice, method=enclosure.method)
    return world.shaped(solution, policy)


def _range(rewards: Rewards) -> RewardRange:
    """The range of a step's reward; ends are exact if nothing is added, or nothing but zeros."""
    least, largest = reward_span(rewards)
    parts = [x for x in (rewards.state, rewards.choice, rewards.transition) if x is not None]
    alone = rewards.transition is None and len(parts) <= 1
    least_zero = not any(np.min(x) for x in parts)
    largest_zero = not any(np.max(x) for x in parts)
    return RewardRange(least, largest, (alone or least_zero, alone or largest_zero))


def _of_one_player(
    model: Model,
    sparse: SparseMDP,
    rewards: tuple[Array, Array],
    objective: str,
    policy: Array | None,
    goal: AverageGoal,
) -> Enclosure:
    """The average of an MDP, or of the chain of a policy."""
    host, ends, sign, depth = sparse.host, goal.ends, 1 if objective == "max" else -1, 0
    if policy is not None:
        chain = induced_chain(model, sparse, policy)
        rewards = chain.mean(rewards[0], host.row_start), chain.mean(rewards[1], host.row_start)
        host, depth = chain.mdp, chain.depth
        if chain.depth:  # means of equal rewards may differ by their rounding
            ends = ends._replace(is_exact=(False, False))
    earned = sign * rewards[0]
    enclosure = average(
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


def _game(world: ModelRows, rewards: Rewards, policy: Array | None) -> tuple[AverageGame, Array]:
    """The game of a model, under a policy of the system, and the original row of each row."""
    sparse, host, is_system = world.sparse, world.sparse.host, world.is_system
    game = AverageGame(
        UncertainMDP(host, host.probability, host.probability)
        if world.sets is None
        else world.sets,
        transition_reward(sparse, rewards),
        world.maximizes,
        None if world.nature is None else world.nature == "max",
    )
    if policy is None:
        return game, np.arange(sparse.num_rows)
    weight = world.weights(policy)
    if np.isin(weight[is_system[host.state]], (0, 1)).all():
        small, row, _ = game.restricted(~is_system[host.state] | (weight > 0))
        return small, row
    weight = weight / np.where(is_system, host.over_choices(np.add, weight), 1)[host.state]
    return game.with_half_steps(is_system, weight)


def _original(values: RobustValues, row: Array, num_states: int) -> Enclosure:
    """Values and rows of the original states."""
    value, lower, upper = (x[:num_states] for x in (values.value, values.lower, values.upper))
    rows = row[values.row[:num_states]]
    return Enclosure(value, lower, upper, rows, values.rounds, values.residual, values.method)
