"""Sequential quadratic programming finds constrained maxima, and stops after its evaluations."""

import numpy as np
import pytest

from jaxltl.algos.mlirl.constrained import ConstrainedPoint, constrained_points


def circle(x, *, broken=False):
    """The squared distance to (2, 0), and a probability that is greatest at the origin."""
    goal = np.array([2.0, 0.0])
    probability = np.exp(-x @ x)
    nan = np.nan if broken else 1.0
    return ConstrainedPoint(
        x,
        float((x - goal) @ (x - goal)) * nan,
        probability,
        2 * (x - goal),
        -2 * x * probability,
        0,
    )


def test_the_least_loss_with_the_probability_is_found():
    points = constrained_points(circle, [np.array([2.0, 0.5]), np.zeros(2)], 0.5, 80)
    good = min((x for x in points if x.probability > 0.5), key=lambda x: x.loss)
    np.testing.assert_allclose(good.parameters, [np.sqrt(np.log(2)), 0], atol=1e-4)
    # The multiplier: 2 (2 - x) = mu 2 x / 2.
    edge = np.sqrt(np.log(2))
    assert good.multiplier == pytest.approx(2 * (2 - edge) / edge, rel=1e-3)
    assert good.stationarity < 1e-3


def test_evaluations_are_bounded_and_broken_ones_left_out():
    asked = []

    def evaluate(x):
        asked.append(x)
        return circle(x, broken=len(asked) == 3)

    points = constrained_points(evaluate, [np.array([2.0, 1.0]), np.ones(2)], 1.5, 7)
    assert len(asked) <= 7 and len(points) == len(asked) - 1
