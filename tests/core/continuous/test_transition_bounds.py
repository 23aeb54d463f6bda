"""Decoupled transition bounds against explicit joint intervals and simulated successors."""

import numpy as np
import pytest

from jaxltl.core.continuous import gaussian, triangular
from jaxltl.core.continuous.grid import make_grid
from jaxltl.core.continuous.images import Images, NoiseBox
from jaxltl.core.continuous.transition_bounds import transition_bounds

NOISES = {"gaussian": gaussian(0.3), "triangular": triangular(-1.0, 1.0)}


def factor_bounds(noise, edges, low, high, gain, clipped):
    """Probabilities of the intervals of one axis."""
    a, b = edges[:-1].copy(), edges[1:].copy()
    if clipped:
        a[0], b[-1] = -np.inf, np.inf
    if gain == 0:
        return ((low >= a) & (high < b)).astype(float), ((high >= a) & (low < b)).astype(float)
    return noise.probability_bounds(a, b, low, high, gain)


def least_joint(lower, upper, values):
    """Least expectation over probabilities between joint bounds."""
    p, free = lower.copy(), 1 - lower.sum()
    for j in np.argsort(values):
        step = min(free, upper[j] - lower[j])
        p[j], free = p[j] + step, free - step
    return (p * values).sum()


@pytest.mark.parametrize("name", NOISES)
@pytest.mark.parametrize("clipped", [False, True])
@pytest.mark.parametrize("shape", [(7,), (5, 6), (3, 4, 3)])
def test_least_expectations(shape, clipped, name):
    draw, n, count, noise = np.random.default_rng(len(shape)), len(shape), 8, NOISES[name]
    grid = make_grid(-np.ones(n), np.ones(n), shape)
    middle, radius = draw.uniform(-1, 1, (count, n)), draw.uniform(0, 0.3, (count, n))
    gain = np.where(draw.random(n) < 0.7, draw.uniform(0.2, 1, n), 0) * np.ones((count, 1))
    reach = np.full(n, 2.6 if name == "gaussian" else 1.0)
    box = NoiseBox(-reach, reach, np.ones(n, bool), np.ones(n, bool))
    images = Images(np.arange(count), middle - radius, middle + radius, gain, tuple(range(n)))
    bounds = transition_bounds(images, grid, [noise] * n, box, clipped)
    value = draw.random(shape)
    for outside in (0.0, 1.0):
        found = bounds.least(value, outside)
        for r in range(count):
            lower, upper = np.ones(1), np.ones(1)
            for i in range(n):
                part = factor_bounds(
                    noise, grid.edges[i], images.low[r, i], images.high[r, i], gain[r, i], clipped
                )
                lower, upper = np.outer(lower, part[0]).ravel(), np.outer(upper, part[1]).ravel()
            values = np.append(value.ravel(), outside)
            joint = least_joint(np.append(lower, 0), np.append(upper, 0 if clipped else 1), values)
            assert found[r] >= joint - 1e-9
            shift = draw.uniform(images.low[r], images.high[r])
            w = draw.normal(size=(4000, n)) * 0.3
            if name == "triangular":
                w = draw.triangular(-1, 0, 1, (4000, n))
            state = shift + gain[r] * w
            cell = grid.locate(np.clip(state, -1, 1) if clipped else state)
            seen = np.where(cell >= 0, value.ravel()[cell], outside)
            assert found[r] <= seen.mean() + 6 * seen.std() / np.sqrt(4000) + 1e-9
