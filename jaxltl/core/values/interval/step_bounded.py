"""Certified step-bounded values of interval MDPs."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxltl.core.models.interval import IntervalMDP, require_interval
from jaxltl.core.models.refusals import on_host
from jaxltl.core.sparse.interval import step_bounded as interval_bounded
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.solvers.step_bounded import StepBoundedValues
from jaxltl.core.types import Solution
from jaxltl.core import validation
from jaxltl.core.array_types import Floats
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import Reward, reward_structure
from jaxltl.core.values.interval.robust import nature_direction
from jaxltl.core.values.engine.state_quantities import (
    PROBABILITY,
    Span,
    reward_span,
    solution_from_error,
    state_mask,
    state_reward,
    transition_reward,
)


@on_host
def robust_next_probability(
    model: IntervalMDP, target: Array | str, *, objective: str = "max", nature: str | None = None
) -> Solution:
    """Robust probability that the next state is in a set.

    ``opt_a opt_p sum_t p_t [t in target]``, p among the distributions of row a.

    Args:
      model: the model.
      target: ``bool[S]``, or the name of a label.
      objective: ``"max"`` or ``"min"``, the direction of the policy.
      nature: ``"adversarial"`` (default), against the objective, or ``"cooperative"``.

    Returns:
      :class:`~jaxltl.core.types.Solution`, exactly 0 or 1 where the graph decides. Concrete arrays
      only; not differentiable.

    Raises:
      ValueError: an invalid target or direction.

    Example:
      >>> from jaxltl.core.models import interval_rows
      >>> coin = interval_rows(None, [0, 2, 3], [0, 1, 1], [0.25, 0.5, 1], [0.5, 0.75, 1])
      >>> robust_next_probability(coin, [False, True]).value.tolist()
      [0.5, 1.0]
    """
    direction = nature_direction(nature, objective)
    chosen = state_mask(require_interval(model).nominal, target, "target")
    return _solution(
        interval_bounded.next_step(
            model.host, chosen, Query(objective == "max", direction == "max")
        )
    )


@on_host
def robust_bounded_reachability(
    model: IntervalMDP,
    target: Array | str,
    num_steps: int,
    *,
    stay: Array | str | None = None,
    objective: str = "max",
    nature: str | None = None,
) -> Solution:
    """Robust step-bounded reachability probability.

    ``x_0 = [s in target]``, and ``x_{k+1}(s) = 1`` on the target, ``opt_a opt_p sum_t p_t x_k(t)``
    in `stay`, else 0; nature picks anew in each step (Givan, Leach and Dean 2000).

    Args:
      model, target, objective, nature: as of :func:`robust_next_probability`.
      num_steps: maximal number of steps.
      stay: ``bool[S]`` or a label that must hold before the target is reached; default everywhere.

    Returns:
      :class:`~jaxltl.core.types.Solution`; `policy` and `nature` are of the first step. Concrete
      arrays only; not differentiable.

    Raises:
      ValueError: a wrong shape or direction, or a negative number of steps.

    Example:
      >>> from jaxltl.core.models import interval_rows
      >>> coin = interval_rows(None, [0, 2, 3], [0, 1, 1], [0.25, 0.5, 1], [0.5, 0.75, 1])
      >>> robust_bounded_reachability(coin, [False, True], 2, nature="cooperative").value.tolist()
      [0.9375, 1.0]
    """
    direction, steps = (
        nature_direction(nature, objective),
        validation.integer("num_steps", num_steps),
    )
    goal = state_mask(require_interval(model).nominal, target, "target")
    free = np.ones_like(goal) if stay is None else state_mask(model.nominal, stay, "stay")
    return _solution(
        interval_bounded.until(
            model.host, goal, free, steps, Query(objective == "max", direction == "max")
        )
    )


@on_host
def robust_cumulative_reward(
    model: IntervalMDP,
    reward: Reward,
    num_steps: int,
    *,
    objective: str = "max",
    nature: str | None = None,
) -> Solution:
    """Robust expected reward of the next n steps.

    ``x_{k+1}(s) = opt_a opt_p sum_t p_t (r(s, a, t) + x_k(t))`` from ``x_0 = 0``; nature picks anew
    in each step.

    Args:
      model, objective, nature: as of :func:`robust_next_probability`.
      reward: as for :func:`~jaxltl.core.models.sparse.choice_reward`; finite, of any sign.
      num_steps: n.

    Returns:
      :class:`~jaxltl.core.types.Solution`, as of :func:`robust_bounded_reachability`. Concrete
      arrays only; not differentiable.

    Raises:
      ValueError: the reward, a direction, or a negative number of steps.

    Example:
      >>> from jaxltl.core.models import interval_rows
      >>> coin = interval_rows(None, [0, 2, 3], [0, 1, 1], [0.25, 0.5, 1], [0.5, 0.75, 1])
      >>> robust_cumulative_reward(coin, [1.0, 0.0], 2, nature="cooperative").value.tolist()
      [1.5, 0.0]
    """
    world = require_interval(model).nominal
    rewards = reward_structure(world, reward)
    count = validation.integer("num_steps", num_steps)
    earned = transition_reward(world, rewards)
    steps = _StepSpan(count, reward_span(rewards, count))
    return _earned(model, earned, np.zeros(world.num_states), steps, objective, nature)


@on_host
def robust_instantaneous_reward(
    model: IntervalMDP,
    reward: Reward,
    num_step: int,
    *,
    objective: str = "max",
    nature: str | None = None,
) -> Solution:
    """Robust expected reward of the state after n steps.

    ``x_{k+1}(s) = opt_a opt_p sum_t p_t x_k(t)`` from the rewards of states ``x_0 = r``.

    Args:
      model, objective, nature: as of :func:`robust_next_probability`.
      reward: as for :func:`~jaxltl.core.values.undiscounted.step_bounded.instantaneous_reward`.
      num_step: n.

    Returns:
      :class:`~jaxltl.core.types.Solution`, as of :func:`robust_bounded_reachability`. Concrete
      arrays only; not differentiable.

    Raises:
      ValueError: the reward has no part on states, or as for :func:`robust_cumulative_reward`.

    Example:
      >>> from jaxltl.core.models import interval_rows
      >>> coin = interval_rows(None, [0, 2, 3], [0, 1, 1], [0.25, 0.5, 1], [0.5, 0.75, 1])
      >>> robust_instantaneous_reward(coin, [1.0, 0.0], 2, nature="cooperative").value.tolist()
      [0.25, 0.0]
    """
    start = state_reward(require_interval(model).nominal, reward)
    zero = np.zeros(model.num_transitions)
    span = float(start.min()), float(start.max())
    steps = _StepSpan(validation.integer("num_steps", num_step), span)
    return _earned(model, zero, start, steps, objective, nature)


class _StepSpan(NamedTuple):
    """A number of steps, and the span of what they earn."""

    number: int
    span: Span


def _earned(
    model: IntervalMDP,
    earned: Floats,
    start: Floats,
    steps: _StepSpan,
    objective: str,
    nature: str | None,
) -> Solution:
    query = Query(objective == "max", nature_direction(nature, objective) == "max")
    values = interval_bounded.total(model.host, earned, start, steps.number, query)
    return _solution(values, steps.span)


def _solution(values: StepBoundedValues, span: Span = PROBABILITY) -> Solution:
    """The :class:`Solution` of step-bounded values."""
    nature: Array | None = values.probability
    solution = solution_from_error(
        values.value, values.error, values.row.astype(np.int32), values.num_steps, span=span
    )
    return replace(solution, nature=nature, method="step by step")
