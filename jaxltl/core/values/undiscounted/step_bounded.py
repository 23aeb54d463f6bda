"""Step-bounded and reward-bounded probabilities and rewards, of concrete models.

Solved in double precision; bounds include all rounding.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.sparse import Rewards, SparseMDP, reward_structure, choice_reward
from jaxltl.core.sparse.solvers import step_bounded as host
from jaxltl.core.sparse.solvers.reward_bounded import bounded_cost, in_units
from jaxltl.core.types import Solution, Status
from jaxltl.core import validation

TOLERANCE = 1e-6  # half the width of an enclosure up to which it counts as narrow, relative


def next_probability(model: Any, target: Any, *, objective: str = "max") -> Solution:
    """Probability that the next state is in a set: ``opt_a P(target | s, a)``.

    (Baier and Katoen 2008, section 10.6.1.)

    Args:
      model: a SparseMDP, or any concrete model that :func:`to_sparse` takes.
      target: ``bool[S]``, or the name of a label.
      objective: ``"max"`` or ``"min"``; irrelevant for chains.

    Returns:
      :class:`Solution`; `value` is ``float64[S]``, `policy` the row of each state ``int32[S]``.

    Raises:
      ValueError: the shape of the target or the objective.

    Concrete arrays only, on the host; not differentiable.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3], [0, 2, 3, 4], [0, 1, 0, 1], [0.75, 0.25, 1, 1])
      >>> found = next_probability(model, [False, True])
      >>> found.value.tolist(), found.policy.tolist()
      ([0.25, 1.0], [0, 2])
    """
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
    return solution_from_error(value, np.where(sure | ~positive, 0, error), row, 1, highest=1)


def bounded_reachability(
    model: Any,
    target: Any,
    num_steps: int,
    *,
    stay: Any = None,
    objective: str = "max",
    by_step: bool = False,
) -> Solution:
    """Probability of reaching a set within n steps through states where one may stay.

    ``x_0 = [s in target]``, and ``x_{k+1}(s) = 1`` in the target, ``opt_a (P x_k)(s, a)`` where one may
    stay, else 0 (Baier and Katoen 2008, section 10.1.1). Where n is large, what further steps change is
    bounded, so that they need not be taken.

    Args:
      model: a SparseMDP, or any concrete model that :func:`to_sparse` takes.
      target: ``bool[S]``, or the name of a label.
      num_steps: n.
      stay: ``bool[S]`` or a label that must hold before the target is reached; default everywhere.
      objective: ``"max"`` or ``"min"``; irrelevant for chains.
      by_step: return the choices of all steps.

    Returns:
      :class:`Solution`; `value` is ``float64[S]``, exactly 0 or 1 where the graph decides. `policy` is
      the first choice, as a row, ``int32[S]``; with `by_step` the choices of all steps, the first
      step's first, ``int32[n, S]``. `num_steps` is the number of steps that were taken.

    Raises:
      ValueError: a shape, the objective, or a negative number of steps.

    Concrete arrays only, on the host; not differentiable.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> bounded_reachability(model, [False, True], 3).value.tolist()
      [0.875, 1.0]
    """
    model, operation = _problem(model, objective, num_steps)
    target = state_mask(model, target, "target")
    stay = np.ones_like(target) if stay is None else state_mask(model, stay, "stay")
    found = host.until(model.host, target, stay, num_steps, operation, by_step)
    return solution_from_error(found.value, found.error, found.row, found.num_steps, highest=1)


def cumulative_reward(
    model: Any, reward: Any, num_steps: int, *, objective: str = "max", by_step: bool = False
) -> Solution:
    """Expected reward of the next n steps.

    ``x_{k+1}(s) = opt_a r(s, a) + (P x_k)(s, a)`` from ``x_0 = 0`` (Puterman 1994, section 4.3).

    Args:
      model, num_steps, objective, by_step: as for :func:`bounded_reachability`.
      reward: as for :func:`~jaxltl.core.models.sparse.row_reward`; finite.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`.

    Raises:
      ValueError: the reward, the objective, or a negative number of steps.

    Concrete arrays only, on the host; not differentiable.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> cumulative_reward(model, [1.0, 0.0], 3).value.tolist()
      [1.75, 0.0]
    """
    model, operation = _problem(model, objective, num_steps)
    earned, magnitude = finite_reward(model, reward)
    zero = np.zeros(model.num_states)
    found = host.total(model.host, earned, magnitude, zero, num_steps, operation, by_step)
    return solution_from_error(found.value, found.error, found.row, found.num_steps)


def instantaneous_reward(
    model: Any, reward: Any, num_step: int, *, objective: str = "max", by_step: bool = False
) -> Solution:
    """Expected reward of the state after n steps.

    ``x_{k+1}(s) = opt_a (P x_k)(s, a)`` from the rewards of states ``x_0 = r``.

    Args:
      model, objective, by_step: as for :func:`bounded_reachability`.
      reward: the name of a reward, a structure, or an array ``[S]``; of a structure only the rewards of
        states count. None is the only reward of the model.
      num_step: n.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`.

    Raises:
      ValueError: the reward has no part on states, or as for :func:`cumulative_reward`.

    Concrete arrays only, on the host; not differentiable.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> instantaneous_reward(model, [1.0, 0.0], 3).value.tolist()
      [0.125, 0.0]
    """
    model, operation = _problem(model, objective, num_step)
    start = state_reward(model, reward)
    zero = np.zeros(model.num_rows)
    found = host.total(model.host, zero, zero, start, num_step, operation, by_step)
    return solution_from_error(found.value, found.error, found.row, found.num_steps)


def reward_bounded_reachability(
    model: Any,
    target: Any,
    reward: Any,
    bound: float,
    *,
    stay: Any = None,
    objective: str = "max",
    by_level: bool = False,
) -> Solution:
    """Probability of reaching a set before more than a bound of reward is earned.

    With l units left, ``x_l(s) = 1`` in the target, and the least solution of
    ``x_l(s) = opt_a sum_t P(t | s, a) x_{l - c(s, a, t)}(t)`` elsewhere, zero below level 0 (Andova,
    Hermanns and Katoen 2003). Rewards in the target do not count.

    Args:
      model, target, stay, objective: as for :func:`bounded_reachability`.
      reward: as for :func:`~jaxltl.core.models.sparse.row_reward`, not negative, multiples of one
        unit; numbers are read as the simplest fractions that round to them.
      bound: the largest reward.
      by_level: return the choices for all amounts left.

    Returns:
      :class:`Solution`; `value` is ``float64[S]``. `policy` is the first choice, ``int32[S]``; with
      `by_level`, row l has the choices with l units left, ``int32[L + 1, S]``. `num_steps` is the
      number of levels, L + 1.

    Raises:
      ValueError: a shape, the objective, a negative reward, or rewards without a common unit of which
        the bound has at most 10^7.

    Concrete arrays only, on the host; not differentiable.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> reward_bounded_reachability(model, [False, True], [0.1, 0], 0.3).value.tolist()
      [0.875, 1.0]
    """
    model, operation = _problem(model, objective)
    mdp, target = model.host, state_mask(model, target, "target")
    stay = np.ones_like(target) if stay is None else state_mask(model, stay, "stay")
    if not 0 <= bound < math.inf:
        raise ValueError(f"bound={bound}; it must be finite and not negative.")
    cost = _entry_reward(model, reward_structure(model, reward))
    if (cost < 0).any():
        e = int(np.flatnonzero(cost < 0)[0])
        raise ValueError(
            f"the reward is {cost[e]:.9g} from state {mdp.state[mdp.row[e]]} to "
            f"{mdp.successor[e]}; a bound on rewards needs rewards of at least 0."
        )
    units, most = in_units(np.where((stay & ~target)[mdp.state[mdp.row]], cost, 0), bound)
    found = bounded_cost(mdp, target, stay, units, most, operation is np.maximum, by_level)
    error = np.where(found.open, found.error, 0)
    return solution_from_error(found.value, error, found.row, most + 1, highest=1)


# --- what these and other host solvers share -----------------------------------------------------


def _problem(model: Any, objective: str, num_steps: int = 0) -> tuple[SparseMDP, Any]:
    validation.integer("num_steps", num_steps)
    return to_sparse(model), reduction_for(objective)


def reduction_for(objective: str) -> Any:
    """``np.maximum`` or ``np.minimum``; ValueError if the objective is neither "max" nor "min"."""
    if not isinstance(objective, str) or objective not in ("max", "min"):
        raise ValueError(f'objective={validation.shorten(objective)}; it must be "max" or "min".')
    return np.maximum if objective == "max" else np.minimum


def state_mask(model: SparseMDP, given: Any, name: str) -> np.ndarray:
    """A set of states as ``bool[S]``, from one in the model's shape or a label."""
    if isinstance(given, str):
        return np.asarray(model.states_with_label(given), bool)
    given = np.asarray(given).reshape(-1)
    if given.shape != (model.num_states,) or given.dtype != bool:
        raise ValueError(
            f"{name} is {given.dtype}{list(given.shape)}; give one bool for each of "
            f"the {model.num_states} states, or a label."
        )
    return given


def state_reward(model: SparseMDP, reward: Any) -> np.ndarray:
    """The rewards of states, ``float64[S]``; ValueError without any, or if some are not finite."""
    given = reward_structure(model, reward)
    if given.state is None:
        raise ValueError(
            "the reward of a state after so many steps needs a reward on states, and "
            "this one has none; give an array of one number a state."
        )
    return finite_reward(model, Rewards(state=given.state))[0][model.host.row_start[:-1]]


def finite_reward(model: SparseMDP, reward: Any) -> tuple[np.ndarray, np.ndarray]:
    """Expected rewards of rows, and those of absolute values: ``float64[R]``; ValueError if not finite."""
    given = reward_structure(model, reward)
    earned = choice_reward(model, given)
    if not np.isfinite(earned).all():
        row = int(np.flatnonzero(~np.isfinite(earned))[0])
        state = int(model.host.state[row])
        raise ValueError(
            f"the reward of state {state}, choice {row - int(model.row_start[state])} "
            f"is {earned[row]}; make it finite."
        )
    if all(
        x is None or (np.asarray(x) >= 0).all()
        for x in (given.state, given.choice, given.transition)
    ):
        return earned, earned
    sizes = {
        name: None if x is None else np.abs(np.asarray(x))
        for name, x in (
            ("state", given.state),
            ("choice", given.choice),
            ("transition", given.transition),
        )
    }
    return earned, choice_reward(model, Rewards(**sizes))


def _entry_reward(model: SparseMDP, given: Rewards) -> np.ndarray:
    """The reward of each entry, ``float64[T]``."""
    mdp = model.host
    found = np.zeros(mdp.num_transitions)
    if given.transition is not None:
        found += np.asarray(given.transition, np.float64)
    if given.choice is not None:
        found += np.asarray(given.choice, np.float64)[mdp.row]
    if given.state is not None:
        found += np.asarray(given.state, np.float64)[mdp.state[mdp.row]]
    if not np.isfinite(found).all():
        e = int(np.flatnonzero(~np.isfinite(found))[0])
        raise ValueError(
            f"the reward is {found[e]} from state {mdp.state[mdp.row[e]]} to "
            f"{mdp.successor[e]}; make it finite."
        )
    return found


def solution_from_error(
    value: np.ndarray,
    error: Any,
    policy: Any,
    num_steps: int,
    *,
    highest: float = math.inf,
    tolerance: float = TOLERANCE,
    least: float = 1.0,
    residual: float = 0.0,
) -> Solution:
    """A :class:`Solution` from a value and its error.

    Args:
      value: ``float64[S]``.
      error: broadcastable to it.
      policy: rows.
      num_steps: steps taken.
      highest: 1 for probabilities.
      tolerance: the error up to which it has converged, relative to the value,
      least: or to this, if that is larger.
      residual: of the solution.
    """
    error = np.broadcast_to(np.asarray(error, np.float64), value.shape)
    out = error > 0
    lower = np.where(out, np.nextafter(value - error, -np.inf), value)
    upper = np.where(out, np.nextafter(value + error, np.inf), value)
    if highest == 1:
        lower, upper, value = (np.clip(x, 0, 1) for x in (lower, upper, value))
    finite = bool(np.isfinite(value).all())
    narrow = bool((error <= tolerance * np.maximum(np.abs(value), least)).all())
    status = Status.CONVERGED if narrow else Status.PRECISION if finite else Status.NONFINITE
    found: Any = {
        "value": value + 0.0,
        "policy": policy,
        "lower": lower,
        "upper": upper,
        "residual": np.float64(residual),
        "num_steps": np.int32(min(num_steps, 2**31 - 1)),
        "status": np.int32(status),
    }
    return Solution(**found)
