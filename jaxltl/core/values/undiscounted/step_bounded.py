"""Step-bounded and reward-bounded probabilities and rewards, of concrete models.

Solved in double precision; bounds include all rounding.
"""

from __future__ import annotations

import math
from typing import TypeGuard

import numpy as np

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import SparseMDP, reward_structure
from jaxltl.core.sparse.solvers import step_bounded as host
from jaxltl.core.sparse.solvers.reward_bounded import bounded_cost, in_units
from jaxltl.core.types import Solution
from jaxltl.core.values.interval import step_bounded as robust
from jaxltl.core.values.interval.robust import refuse_nature
from jaxltl.core.values.engine.state_quantities import (
    PROBABILITY,
    reduction_for,
    reward_span,
    state_mask,
    row_reward,
    state_reward,
    transition_reward,
    finite_reward,
    solution_from_error,
)
from jaxltl.core.values.engine.validated import validated
from jaxltl.core import validation


def _has_intervals(
    model: Model, nature: str | None, by_step: bool = False
) -> TypeGuard[IntervalMDP]:
    """True for a model with intervals; raises ValueError for an option that is not for the model."""
    if not isinstance(model, IntervalMDP):
        refuse_nature(nature)
        return False
    if by_step:
        raise ValueError(
            "by_step is not for models with intervals; solve for each number of steps."
        )
    return True


@validated(host=True)
def next_probability(
    model: Model, target: Array | str, *, objective: str = "max", nature: str | None = None
) -> Solution:
    """Probability that the next state is in a set: ``opt_a P(target | s, a)``.

    Args:
      model, target, objective, nature: as for :func:`bounded_reachability`.

    Returns:
      :class:`Solution`; `value` is ``float64[S]``, `policy` the row of each state ``int32[S]``.
      Concrete arrays only; not differentiable.

    Raises:
      ValueError: the shape of the target or the objective.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3], [0, 2, 3, 4], [0, 1, 0, 1], [0.75, 0.25, 1, 1])
      >>> found = next_probability(model, [False, True])
      >>> found.value.tolist(), found.policy.tolist()
      ([0.25, 1.0], [0, 2])
    """
    if _has_intervals(model, nature):
        return robust.robust_next_probability(model, target, objective=objective, nature=nature)
    model, operation = _problem(model, objective)
    mdp, target = model.host, state_mask(model, target, "target")
    # One step of "until" in which the target counts only once it is entered.
    image = mdp.expectation(target.astype(np.float64))
    value = mdp.over_choices(operation, image)
    choose = np.logical_or if operation is np.maximum else np.logical_and
    positive = mdp.over_choices(choose, mdp.support.some_successor_in(target))
    sure = mdp.over_choices(choose, ~mdp.support.some_successor_in(~target))
    error = value * host.relative_error(host.backup_unit(mdp), 1)
    value = np.where(sure, 1, np.where(positive, value, 0))
    _, row = mdp.first_choice(
        image == np.repeat(mdp.over_choices(operation, image), np.diff(mdp.row_start))
    )
    return solution_from_error(
        value, np.where(sure | ~positive, 0, error), row, 1, span=PROBABILITY
    )


@validated(host=True)
def bounded_reachability(
    model: Model,
    target: Array | str,
    num_steps: int,
    *,
    stay: Array | str | None = None,
    objective: str = "max",
    nature: str | None = None,
    by_step: bool = False,
) -> Solution:
    """Step-bounded reachability probability, within n steps through the states of `stay`.

    ``x_0 = [s in target]``, and ``x_{k+1}(s) = 1`` in the target, ``opt_a (P x_k)(s, a)`` in
    `stay`, else 0 (Baier and Katoen 2008, section 10.1.1). For large n the iteration ends once the
    effect of further steps is bounded.

    Args:
      model: a SparseMDP, or any concrete model that :func:`to_sparse` takes.
      target: ``bool[S]``, or the name of a label.
      num_steps: n.
      stay: ``bool[S]`` or a label that must hold before the target is reached; default everywhere.
      objective: ``"max"`` or ``"min"``; irrelevant for chains.
      nature: of an IntervalMDP, ``"adversarial"`` (default) or ``"cooperative"``.
      by_step: return the choices of all steps.

    Returns:
      :class:`Solution`; `value` is ``float64[S]``, exactly 0 or 1 where the graph decides. `policy`
      is the first choice, as a row, ``int32[S]``; with `by_step` the choices of all steps in order,
      ``int32[n, S]``. `num_steps` is the number of computed steps. Concrete arrays only; not
      differentiable.

    Raises:
      ValueError: a shape, the objective, or a negative number of steps.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> bounded_reachability(model, [False, True], 3).value.tolist()
      [0.875, 1.0]
    """
    if _has_intervals(model, nature, by_step):
        return robust.robust_bounded_reachability(
            model, target, num_steps, stay=stay, objective=objective, nature=nature
        )
    model, operation = _problem(model, objective, num_steps)
    target = state_mask(model, target, "target")
    stay = np.ones_like(target) if stay is None else state_mask(model, stay, "stay")
    values = host.until(model.host, target, stay, num_steps, operation, by_step)
    return solution_from_error(
        values.value, values.error, values.row, values.num_steps, span=PROBABILITY
    )


def bounded_avoidance(
    model: Model, target: Array, num_steps: int, *, stay: Array, objective: str = "max"
) -> Solution | None:
    """Complement of :func:`bounded_reachability`, relatively exact; None for many steps."""
    model, operation = _problem(model, objective, num_steps)
    values = host.avoidance(model.host, target, stay, num_steps, operation)
    if values is None:
        return None
    return solution_from_error(
        values.value, values.error, values.row, values.num_steps, span=PROBABILITY
    )


@validated(host=True)
def cumulative_reward(
    model: Model,
    reward: Array | str,
    num_steps: int,
    *,
    objective: str = "max",
    nature: str | None = None,
    by_step: bool = False,
) -> Solution:
    """Expected reward of the next n steps.

    ``x_{k+1}(s) = opt_a r(s, a) + (P x_k)(s, a)`` from ``x_0 = 0`` (Puterman 1994, section 4.3).

    Args:
      model, num_steps, objective, nature, by_step: as for :func:`bounded_reachability`.
      reward: as for :func:`~jaxltl.core.models.sparse.choice_reward`; finite.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`. Concrete arrays only; not
      differentiable.

    Raises:
      ValueError: the reward, the objective, or a negative number of steps.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> cumulative_reward(model, [1.0, 0.0], 3).value.tolist()
      [1.75, 0.0]
    """
    if _has_intervals(model, nature, by_step):
        return robust.robust_cumulative_reward(
            model, reward, num_steps, objective=objective, nature=nature
        )
    sparse, operation = _problem(model, objective, num_steps)
    structure = reward_structure(sparse, row_reward(model, sparse, reward))
    rewards = *finite_reward(sparse, structure), np.zeros(sparse.num_states)
    values = host.total(sparse.host, rewards, num_steps, operation, by_step)
    span = reward_span(structure, num_steps)
    return solution_from_error(values.value, values.error, values.row, values.num_steps, span=span)


@validated(host=True)
def instantaneous_reward(
    model: Model,
    reward: Array | str,
    num_step: int,
    *,
    objective: str = "max",
    nature: str | None = None,
    by_step: bool = False,
) -> Solution:
    """Expected reward of the state after n steps.

    ``x_{k+1}(s) = opt_a (P x_k)(s, a)`` from the rewards of states ``x_0 = r``.

    Args:
      model, objective, nature, by_step: as for :func:`bounded_reachability`.
      reward: the name of a reward, a structure, of which only the rewards of states count, or an
        array ``[S]``. None is the only reward of the model.
      num_step: n.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`. Concrete arrays only; not
      differentiable.

    Raises:
      ValueError: the reward has no part on states, or as for :func:`cumulative_reward`.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> instantaneous_reward(model, [1.0, 0.0], 3).value.tolist()
      [0.125, 0.0]
    """
    if _has_intervals(model, nature, by_step):
        return robust.robust_instantaneous_reward(
            model, reward, num_step, objective=objective, nature=nature
        )
    sparse, operation = _problem(model, objective, num_step)
    zero = np.zeros(sparse.num_rows)
    final = state_reward(sparse, row_reward(model, sparse, reward))
    values = host.total(sparse.host, (zero, zero, final), num_step, operation, by_step)
    span = float(final.min()), float(final.max())
    return solution_from_error(values.value, values.error, values.row, values.num_steps, span=span)


@validated(host=True)
def reward_bounded_reachability(
    model: Model,
    target: Array | str,
    reward: Array | str,
    bound: float,
    *,
    stay: Array | str | None = None,
    objective: str = "max",
    by_level: bool = False,
) -> Solution:
    """Probability of reaching a set before more than a bound of reward is earned.

    With l units left, ``x_l(s) = 1`` in the target, and the least solution of
    ``x_l(s) = opt_a sum_t P(t | s, a) x_{l - c(s, a, t)}(t)`` elsewhere, zero below level 0
    (Andova, Hermanns and Katoen 2003). Rewards in the target do not count.

    Args:
      model, target, stay, objective: as for :func:`bounded_reachability`.
      reward: as for :func:`~jaxltl.core.models.sparse.choice_reward`, not negative, multiples of one
        unit; numbers are read as the simplest fractions that round to them.
      bound: the largest reward.
      by_level: return the choices for all amounts left.

    Returns:
      :class:`Solution`; `value` is ``float64[S]``. `policy` is the first choice, ``int32[S]``; with
      `by_level`, row l has the choices with l units left, ``int32[L + 1, S]``. `num_steps` is the
      number of levels, L + 1. Concrete arrays only; not differentiable.

    Raises:
      ValueError: a shape, the objective, a negative reward, or rewards without a common unit of
        which the bound has at most 10^7.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> reward_bounded_reachability(model, [False, True], [0.1, 0], 0.3).value.tolist()
      [0.875, 1.0]
    """
    if np.ndim(reward) < 3:  # rewards of transitions are not their expectation here
        reward = row_reward(model, to_sparse(model), reward)
    model, operation = _problem(model, objective)
    mdp, target = model.host, state_mask(model, target, "target")
    stay = np.ones_like(target) if stay is None else state_mask(model, stay, "stay")
    validation.require_in_range("bound", bound, validation.Range(0, math.inf, open_above=True))
    cost = transition_reward(model, reward_structure(model, reward))
    if (cost < 0).any():
        e = int(np.flatnonzero(cost < 0)[0])
        raise ValueError(
            f"the reward is {cost[e]:.9g} from state {mdp.state[mdp.row[e]]} to "
            f"{mdp.successor[e]}; a bound on rewards needs rewards of at least 0."
        )
    budget = in_units(np.where((stay & ~target)[mdp.state[mdp.row]], cost, 0), bound)
    values = bounded_cost(mdp, target, stay, budget, operation is np.maximum, by_level)
    error = np.where(values.undecided, values.error, 0)
    return solution_from_error(values.value, error, values.row, budget[1] + 1, span=PROBABILITY)


# --- what these and other host solvers share -----------------------------------------------------


def _problem(model: Model, objective: str, num_steps: int = 0) -> tuple[SparseMDP, np.ufunc]:
    validation.integer("num_steps", num_steps)
    return to_sparse(model), reduction_for(objective)
