"""Grids against counting cell by cell."""

import numpy as np
import pytest

from jaxltl.core.continuous.grid import count_in, covered, cumulative, make_grid, volume


def boxes(grid, draw, count):
    low = draw.uniform(-1.3, 1.2, (count, grid.num_axes))
    return low, low + draw.exponential(0.3, low.shape)


@pytest.mark.parametrize("shape", [(7,), (5, 4), (3, 4, 2)])
def test_ranges_are_the_cells_that_a_box_meets(shape):
    draw = np.random.default_rng(0)
    n = len(shape)
    grid = make_grid(-np.ones(n), np.ones(n), shape, [[0.15]] * n)
    low, high = boxes(grid, draw, 200)
    low[0], high[0] = 1.0, 1.0  # the upper corner belongs to the last cell
    first, last = grid.boxes()
    start, stop, outside = grid.ranges(low, high)
    met = ((first[None] <= high[:, None]) & (low[:, None] < last[None])).all(-1)
    met |= (grid.locate(np.clip(low, -1, 1))[:, None] == np.arange(grid.num_cells)) & ~outside[
        :, None
    ]
    sets = draw.random(grid.shape) < 0.7
    table = cumulative(sets)
    assert (volume(start, stop) == met.sum(1)).all()
    assert (count_in(table, start, stop) == (met & sets.reshape(-1)).sum(1)).all()
    assert (outside == ((low < -1) | (high > 1)).any(-1)).all()
    some = draw.integers(0, 200, 5)
    assert (covered(start[some], stop[some], grid.shape).reshape(-1) == met[some].any(0)).all()


def test_edges_are_moved_to_breakpoints_and_cells_are_halved():
    grid = make_grid(np.zeros(2), np.ones(2), (3, 4), [[0.3, 0.31], [0.25]])
    assert 0.3 in grid.edges[0] and 0.31 in grid.edges[0] and grid.shape == (4, 4)
    chosen = np.zeros(16, bool)
    chosen[[0, 12]] = True  # two intervals along the first axis, one along the second
    fine, parents = grid.halve(chosen)
    assert fine.shape == (6, 5) and set(grid.edges[0]) <= set(fine.edges[0])
    for e, finer, parent in zip(grid.edges, fine.edges, parents, strict=True):
        assert (e[parent] <= finer[:-1]).all() and (finer[1:] <= e[parent + 1]).all()
    states = np.random.default_rng(1).random((50, 2))
    low, high = fine.boxes(fine.locate(states))
    assert ((low <= states) & (states < high)).all()
    assert fine.locate(np.array([1.0, 1.0])) == 29 and fine.locate(np.array([1.0, 1.1])) == -1


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="one positive number for each"):
        make_grid(np.zeros(2), np.ones(2), (3,))
