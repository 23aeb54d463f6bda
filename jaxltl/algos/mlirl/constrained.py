"""Maximum likelihood subject to a satisfaction probability, by sequential quadratic programming."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from jaxltl.core.models.protocols import Array

_MARGIN = 1e-8  # of the probability over the required one, for rounding and certified bounds
_PRECISION = 1e-10  # of the loss, at which SLSQP has converged


@dataclass(frozen=True)
class ConstrainedPoint:
    """Evaluated parameters ``float[F]``."""

    parameters: np.ndarray
    loss: float  # the negative log-likelihood with the prior
    probability: float  # of satisfaction
    gradient: np.ndarray  # float[F], of the loss
    slope: np.ndarray  # float[F], of the probability
    value: Array  # the fixed point of the policy's reward, from which the next one starts

    @property
    def is_finite(self) -> bool:
        """True if the loss, the probability and their derivatives are finite."""
        parts = (self.loss, self.probability, self.gradient, self.slope)
        return all(np.isfinite(x).all() for x in parts)

    @property
    def multiplier(self) -> float:
        """The weight mu of the probability, by least squares in the condition of optimality."""
        size = float(self.slope @ self.slope)
        return max(float(self.gradient @ self.slope) / size, 0.0) if size else 0.0

    @property
    def stationarity(self) -> float:
        """Norm of the gradient of the Lagrangian."""
        return float(np.linalg.norm(self.gradient - self.multiplier * self.slope))


class _BudgetSpent(Exception):
    pass


def constrained_points(
    evaluate: Callable[[np.ndarray], ConstrainedPoint],
    guesses: Sequence[np.ndarray],
    required: float,
    max_evaluations: int,
) -> list[ConstrainedPoint]:
    """Points of SLSQP (Kraft 1988) from several guesses, by at most `max_evaluations` evaluations.

    The last guess gets the evaluations that earlier ones leave.
    """
    points: list[ConstrainedPoint] = []
    for i, guess in enumerate(guesses):
        budget = max_evaluations * (i + 1) // len(guesses) - len(points)
        points += _search(evaluate, np.asarray(guess, float), required, budget)
    return [point for point in points if point.is_finite]


def _search(
    evaluate: Callable[[np.ndarray], ConstrainedPoint],
    guess: np.ndarray,
    required: float,
    budget: int,
) -> list[ConstrainedPoint]:
    """The points that SLSQP evaluates from one guess."""
    known: dict[bytes, ConstrainedPoint] = {}

    def at(x: np.ndarray) -> ConstrainedPoint:
        key = x.tobytes()
        if key not in known:
            if len(known) >= budget:
                raise _BudgetSpent
            known[key] = evaluate(x.copy())
        return known[key]

    # SLSQP shortens a step to a loss this large; it cannot use an infinite one.
    def loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        point = at(x)
        return (point.loss, point.gradient) if point.is_finite else (1e12, 0 * x)

    def excess(x: np.ndarray) -> float:
        point = at(x)
        return point.probability - required - _MARGIN if point.is_finite else -1.0

    def slope(x: np.ndarray) -> np.ndarray:
        point = at(x)
        return point.slope if point.is_finite else 0 * x

    constraint = {"type": "ineq", "fun": excess, "jac": slope}
    options = {"maxiter": max(budget, 1), "ftol": _PRECISION}
    with contextlib.suppress(_BudgetSpent):
        minimize(loss, guess, jac=True, method="SLSQP", constraints=constraint, options=options)
    return list(known.values())
