"""Certified values of interval models: of a policy, or optimal, with nature for or against it."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.core.host import interval_values
from jaxltl.core.host.interval import HostInterval
from jaxltl.core.host.interval_values import Robust
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.sparse import row_reward
from jaxltl.core.types import Method, Solution, Status, require_shape
from jaxltl.core.values.bounded import structure

TOLERANCE = 1e-6


RobustSolution = Solution


def require_direction(nature: str | None, objective: str) -> str:
    """Nature's direction; against the objective where nothing is said.

    Raises:
      ValueError: it, or the objective, is none of ``"min"`` and ``"max"``.
    """
    if objective not in ("max", "min"):
        raise ValueError(f'objective={objective!r}; it must be "max" or "min".')
    if nature is None:
        return "min" if objective == "max" else "max"
    if nature not in ("max", "min"):
        raise ValueError(f'nature={nature!r}; it must be "min" (nature makes the value small) or '
                         '"max" (large).')
    return nature


def refuse_nature(nature: str | None) -> None:
    """Raises ValueError if a direction of nature is given where it has nothing to choose."""
    if nature is not None:
        raise ValueError(f"nature={nature!r} is for models with intervals (make_interval); the "
                         "probabilities of this one are given. Leave it out.")


def robust_reachability(
    model: IntervalMDP, target: Any, *, policy: Any = None, objective: str = "max",
    nature: str | None = None, stay: Any = None, tolerance: Any = None,
) -> Solution:
    """Probability of reaching a target when probabilities lie in intervals.

    ``x(s) = opt_a opt_p sum_t p_t x(t)`` outside of the target, p among the distributions of row a
    (Nilim and El Ghaoui 2005, Iyengar 2005); the least solution.

    Args:
      model: the model.
      target: ``bool[S]``, or the name of a label.
      policy: ``int32[S]``, rows to be evaluated; default: optimise.
      objective: ``"max"`` or ``"min"``, what the policy makes of the probability.
      nature: ``"min"`` or ``"max"``, what nature makes of it; default: the opposite of
        `objective` (for a given policy: ``"min"``).
      stay: ``bool[S]``, the states that may be passed; default all.
      tolerance: the width of the enclosure asked for, 1e-6.

    Returns:
      :class:`Solution`, with `nature`.

    Raises:
      ValueError: shapes, or a direction.

    Example:
      >>> from jaxltl.core.models.sparse import make_sparse
      >>> from jaxltl.core.models.interval import make_interval
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> model = make_interval(coin, [0.4, 0.3, 1, 1], [0.7, 0.6, 1, 1])
      >>> robust_reachability(model, [False, True, False]).value.tolist()
      [0.4, 1.0, 0.0]
    """
    nature = require_direction(nature, objective)
    target = _states(model, target, "target")
    stay = None if stay is None else _states(model, stay, "stay")
    asked = TOLERANCE if tolerance is None else float(tolerance)
    part, entry = _under(model, policy)
    found = interval_values.reachability(
        part, target, maximize=objective == "max", helpful=nature == "max", stay=stay,
        tolerance=asked)
    return robust_solution(model, found, asked, relative=False, policy=policy, entry=entry)


def robust_total_reward(
    model: IntervalMDP, reward: Any, target: Any, *, policy: Any = None, objective: str = "max",
    nature: str | None = None, tolerance: Any = None,
) -> Solution:
    """Expected reward until a target is reached when probabilities lie in intervals.

    ``x(s) = opt_a opt_p (r(s, a) + sum_t p_t x(t))`` outside of the target, infinite where the
    target is not surely reached.

    Args:
      model: the model.
      reward: as of :func:`~jaxltl.core.models.sparse.row_reward`; at least 0. On transitions it is
        taken of the successors with nature's distribution, so these must not differ within a row
        unless the interval is a point.
      target: ``bool[S]``, or the name of a label.
      policy, objective, nature: as of :func:`robust_reachability`.
      tolerance: the width of the enclosure asked for, as a share of the value, 1e-6.

    Returns:
      :class:`Solution`, with `nature`.

    Raises:
      ValueError: shapes, a direction, or a reward that is negative or depends on nature.
    """
    nature = require_direction(nature, objective)
    target = _states(model, target, "target")
    earned = interval_reward(model, reward)
    asked = TOLERANCE if tolerance is None else float(tolerance)
    part, entry = _under(model, policy)
    if policy is not None:
        earned = earned[np.asarray(policy)]
    found = interval_values.total_reward(
        part, earned, target, maximize=objective == "max", large=nature == "max",
        tolerance=asked)
    return robust_solution(model, found, asked, relative=True, policy=policy, entry=entry)


def interval_reward(model: IntervalMDP, reward: Any) -> np.ndarray:
    """The reward of each choice, ``float64[R]``.

    Raises:
      ValueError: it is negative or not finite, or depends on the successor that nature picks.
    """
    earned = row_reward(model.nominal, reward)
    bad = ~((earned >= 0) & np.isfinite(earned))
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        state = int(model.nominal.host.state[row])
        raise ValueError(f"the reward of state {state}, choice "
                         f"{row - int(model.nominal.row_start[state])} is {earned[row]}; it must "
                         "be finite and at least 0.")
    of = structure(model.nominal, reward).transition
    if of is not None:
        each = np.asarray(of)
        start = model.nominal.host.entry_start[:-1]
        differs = np.maximum.reduceat(each, start) != np.minimum.reduceat(each, start)
        loose = np.logical_or.reduceat(model.host.lower < model.host.upper, start)
        if (differs & loose).any():
            row = int(np.flatnonzero(differs & loose)[0])
            raise ValueError(
                f"the reward of row {row} differs between its successors, whose probabilities are "
                "intervals; put it on states that are entered, or on choices.")
    return earned


def robust_solution(
    model: IntervalMDP, found: Robust, tolerance: float, *, relative: bool, policy: Any = None,
    entry: Any = None,
) -> Solution:
    """What the host found, with its status."""
    finite = np.isfinite(found.upper)
    width = np.where(finite, found.upper, 0) - np.where(finite, found.lower, 0)
    scale = np.where(finite, found.upper, 1) if relative else 1.0
    narrow = (width <= tolerance * scale) & (finite | (found.lower == found.upper))
    status = Status.CONVERGED if narrow.all() else Status.PRECISION
    row, chance = found.row, found.probability
    if policy is not None:
        chance = np.asarray(model.nominal.probability).copy()
        chance[entry] = found.probability
        row = np.asarray(policy)
    parts: dict[str, Any] = {
        "value": found.value, "policy": row.astype(np.int32), "nature": chance,
        "lower": found.lower, "upper": found.upper, "residual": np.float64(found.residual),
        "num_steps": np.int32(found.rounds), "status": np.int32(status)}
    return Solution(**parts, method=Method(found.method))


def _under(model: IntervalMDP, policy: Any) -> tuple[HostInterval, Any]:
    """The model under a policy, and which entries are left."""
    if policy is None:
        return model.host, None
    policy = np.asarray(policy)
    require_shape("policy", policy, model.state_shape)
    start = model.nominal.host.row_start
    wrong = (policy < start[:-1]) | (policy >= start[1:])
    if wrong.any():
        s = int(np.flatnonzero(wrong)[0])
        raise ValueError(f"the policy takes row {policy[s]} in state {s}, whose rows are "
                         f"{start[s]} to {start[s + 1] - 1}.")
    chain, entry = model.host.chain(policy)
    return chain, entry


def _states(model: IntervalMDP, states: Any, name: str) -> np.ndarray:
    if isinstance(states, str):
        return np.asarray(model.states_where(states), bool)
    require_shape(name, states, model.state_shape)
    return np.asarray(states, bool)
