"""Synthesis on small grids against explicit interval models, written out cell by cell."""

import numpy as np
import pytest
from scipy.special import ndtr

from jaxltl.core.continuous import synthesize_policy
from jaxltl.envs import continuous_worlds as worlds


def cosine(low, high):
    """Range of the cosine over an interval."""
    inside = np.concatenate([[low, high], np.pi * np.arange(-9, 10)])
    values = np.cos(inside[(inside >= low) & (inside <= high)])
    return np.array([values.min(), values.max()])


def robot(low, high, action):
    shift = 2 * action[0] * np.array([np.cos(action[1]), np.sin(action[1])])
    return low + shift, high + shift


def vehicle(low, high, action):
    speed, slip = 0.1 * action[0], np.arctan(np.tan(action[1]) / 2)
    first, last = slip + low[2], slip + high[2]
    turns = [cosine(first, last), cosine(first - np.pi / 2, last - np.pi / 2), np.ones(2)]
    rates = speed * np.array([1 / np.cos(slip), 1 / np.cos(slip), np.tan(action[1])])
    moved = np.sort(rates[:, None] * np.array(turns), 1)
    return low + moved[:, 0], high + moved[:, 1]


def building(low, high, action):
    world = worlds.building().dynamics
    step = lambda x: np.asarray(world.step(x, action, np.zeros(4)), float)  # noqa: E731
    middle, matrix = step(np.zeros(4)), np.stack([step(e) for e in np.eye(4)], 1)
    matrix = matrix - middle[:, None]
    up, down = np.maximum(matrix, 0), np.minimum(matrix, 0)
    return middle + up @ low + down @ high, middle + up @ high + down @ low


def interval_model(dynamics, grid, actions, image):
    """Joint probabilities ``[2, C, A, C + 1]``: lower and upper ones of the products of coordinates, the
    last of leaving the grid."""
    low, high = grid.boxes()
    ends = (np.append(x, [end], 0) for x, end in zip((low, high), dynamics.domain, strict=True))
    (low, high), count = ends, len(low)
    scale = np.array([noise.scale for noise in dynamics.noise])
    bounds = np.ones((2, count, len(actions), count + 1))
    for c, a in np.ndindex(count, len(actions)):
        first, last = image(low[c], high[c], actions[a])
        best = np.clip((low + high) / 2, first, last)
        p = [ndtr((high - m) / scale) - ndtr((low - m) / scale) for m in (first, last, best)]
        bounds[0, c, a] = np.minimum(p[0], p[1]).prod(1)
        bounds[1, c, a] = p[2].prod(1)
    bounds[..., -1] = 1 - bounds[::-1, ..., -1]
    return bounds


def least_expectation(bounds, value):
    """``[C, A]``; leaving the grid has the value 0."""
    value = np.append(value, 0.0)
    order = np.argsort(value)
    lower, gap = bounds[0][..., order], (bounds[1] - bounds[0])[..., order]
    free = 1 - lower.sum(-1, keepdims=True)
    taken = np.clip(free - (np.cumsum(gap, -1) - gap), 0, gap)
    return ((lower + taken) * value[order]).sum(-1)


CASES = {
    "robot": (worlds.robot, robot, [8, 8], slice(0, 441, 60)),
    "vehicle": (worlds.vehicle, vehicle, [4, 4, 3], slice(0, 30, 6)),
    "building": (worlds.building, building, [2, 2, 3, 3], slice(None)),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("name", CASES)
def test_lower_bounds_are_at_least_those_of_the_explicit_interval_model(name):
    make, image, cells, chosen = CASES[name]
    world, steps = make(), 3
    actions = np.asarray(world.dynamics.actions)[chosen]
    formula = world.formula
    if world.num_steps is not None:
        formula = " & ".join("X " * k + "!outside" for k in range(steps + 1))
    found = synthesize_policy(
        world.dynamics, formula, actions, cells=cells, max_cells=200, upper=False
    ).certificate
    bounds = interval_model(world.dynamics, found.grid, actions, image)
    low, high = found.grid.boxes()
    middle = (low + high) / 2
    if world.num_steps is None:
        target, unsafe = (world.dynamics.labels[x].contains(middle) for x in ("target", "unsafe"))
        value = target & ~unsafe
        for _ in range(300):
            new = np.where(target, 1.0, least_expectation(bounds, value).max(1))
            value = np.where(unsafe, 0.0, new)
    else:
        value = np.ones(len(low))
        for _ in range(steps):
            value = least_expectation(bounds, value).max(1)
    assert (found.lower >= value - 1e-6).all()
    assert value.max() > 0.1 and (found.lower - value).max() < 0.5
