"""Images of cells do not depend on the number of blocks and rows that are handled at once."""

import jax.numpy as jnp
import numpy as np

from jaxltl.core.continuous import images, transition_bounds
from jaxltl.core.continuous.grid import make_grid

BOX = images.NoiseBox(-np.ones(2), np.ones(2), np.ones(2, bool), np.ones(2, bool))


def bent(x, u, w):
    turned = jnp.stack([jnp.sin(3 * x[1]), x[0] * x[1]]) + u
    return turned + jnp.array([0.1, 0.2]) * w


def test_chunks_of_rows_change_nothing(monkeypatch):
    grid, actions = make_grid(-np.ones(2), np.ones(2), [33, 20]), np.array([[0.1, 0.2], [0, -0.3]])
    cells = np.flatnonzero(np.random.default_rng(0).random(grid.num_cells) < 0.7)
    whole = images.image_boxes(bent, grid, cells, actions, BOX)
    monkeypatch.setattr(images, "_ROWS", 6)
    parts = images.image_boxes(bent, grid, cells, actions, BOX)
    assert whole.order == parts.order and whole.noise_of == parts.noise_of == (0, 1)
    for name in ("low", "high", "gain", "varying"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))
    assert whole.gain.strides[0] == 0  # equal rows take the memory of one
    states = np.random.default_rng(1).uniform(*grid.boxes(cells), (50, len(cells), 2))
    for k, action in enumerate(actions):
        found = np.stack(
            [np.sin(3 * states[..., 1]), states[..., 0] * states[..., 1]], -1
        ) + action  # fmt: skip
        assert (whole.low[k::2] <= found).all() and (found <= whole.high[k::2]).all()


def test_distinct_rows_are_those_of_unique():
    draw = np.random.default_rng(0)
    rows = draw.choice([-np.inf, -1.5, 0.0, 2.0], (60, 3))
    rows[:, 1] = 0.5
    found, number = transition_bounds._distinct(list(rows.T))
    expected, inverse = np.unique(rows, axis=0, return_inverse=True)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(number, inverse.reshape(-1))
