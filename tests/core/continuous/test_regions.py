"""Regions against random points, and the cells of grids that snap to their edges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.continuous import regions
from jaxltl.core.continuous.regions import box, half_space, union, where_positive

REGIONS = {
    "boxes": box([[-1.0, -0.5], [0.2, 0.1]], [[0.3, 0.5], [0.9, 1.3]]),
    "half-space": half_space([1.0, -0.5], 0.1),
    "disc": where_positive(lambda x: 0.8 - x[0] ** 2 - jnp.sin(x[1]) ** 2),
    "all": box([-1, -1], [0, 0])
    | half_space([0.3, 1], -0.9)
    | where_positive(lambda x: x[0] - 0.7),
}


def random_cells(count, seed):
    draw = np.random.default_rng(seed)
    low = draw.uniform(-1.5, 1.5, (count, 2))
    return low, low + draw.uniform(0.01, 0.6, (count, 2))


@pytest.mark.parametrize("name", REGIONS)
def test_membership_agrees_with_random_points(name):
    region = REGIONS[name]
    low, high = random_cells(2000, 0)
    certain, possible = region.membership(low, high)
    share = np.random.default_rng(1).uniform(0, 1, (200, 1, 2))
    share[0] = 0  # the lower corner belongs to a cell
    inside = region.contains(low + share * (high - low))
    assert inside[:, certain].all() and not inside[:, ~possible].any()
    assert 0.02 < certain.mean() < possible.mean() < 0.98
    undecided = possible & ~certain
    mixed = inside.any(axis=0) & ~inside.all(axis=0)
    assert (mixed | ~undecided).mean() > 0.95  # of few cells alone nothing is known


@pytest.mark.parametrize("name", REGIONS)
def test_states_in_jax_and_numpy_agree(name):
    x = np.random.default_rng(2).uniform(-1.5, 1.5, (50, 4, 2))
    found = REGIONS[name].contains(x)
    traced = jax.jit(REGIONS[name].contains)(jnp.asarray(x))
    assert found.shape == (50, 4) and isinstance(found, np.ndarray)
    assert (found != np.asarray(traced)).sum() <= 1
    assert jax.vmap(REGIONS[name].contains)(jnp.asarray(x[0])).shape == (4,)


def test_a_grid_with_a_boxs_edges_labels_all_cells_exactly():
    region = box([[-0.2, 0.1], [0.3, -1.0]], [[0.2, 0.7], [0.7, 0.1]])
    edges = [
        np.unique(np.concatenate([np.linspace(-1, 1, 14), region.breakpoints(i)])) for i in (0, 1)
    ]
    low = np.stack(np.meshgrid(*(e[:-1] for e in edges), indexing="ij"), -1).reshape(-1, 2)
    high = np.stack(np.meshgrid(*(e[1:] for e in edges), indexing="ij"), -1).reshape(-1, 2)
    certain, possible = region.membership(low, high)
    assert (certain == possible).all() and 0 < certain.sum() < len(certain)
    assert (region.contains(0.5 * (low + high)) == certain).all()
    assert (region.contains(low) == certain).all()


def test_breakpoints_are_the_finite_edges():
    region = box([[-np.inf, 0.0], [0.5, 0.0]], [[0.5, 1.0], [2.0, 3.0]]) | half_space([1, 1], 0)
    assert region.breakpoints(0).tolist() == [0.5, 2.0]
    assert region.breakpoints(1).tolist() == [0.0, 1.0, 3.0]
    assert len(REGIONS["disc"].breakpoints(0)) == 0


def test_half_spaces_round_outward_and_along_an_axis_are_boxes():
    normal = np.array([0.1, 0.2])
    certain, possible = half_space(normal, 0.3).membership([[0.0, 0.0]], [[1.0, 1.0]])
    # .1 + .2 rounds to a number above .3, and the exact sum is between the two
    assert not certain[0] and possible[0]
    region = half_space([0.0, -2.0], 1.0)
    assert len(region.low) == 1 and region.breakpoints(1).tolist() == [-0.5]
    assert region.contains(np.array([[9.0, -0.5], [9.0, -0.6]])).tolist() == [True, False]


def test_constants_of_functions_are_in_double_precision():
    region = where_positive(lambda x: x[0] - 0.7)  # .7 in single precision is less than .7
    certain, possible = region.membership([[0.69999999], [0.70000001]], [[0.699999999], [0.8]])
    assert certain.tolist() == [False, True] and possible.tolist() == [False, True]


def test_edges_at_the_domain_move_to_infinity():
    region = regions.extended(
        box([-2.0, 0.0], [0.5, 1.0]), np.array([-1, -1.0]), np.array([1, 1.0])
    )
    assert region.low.tolist() == [[-np.inf, 0.0]] and region.high.tolist() == [[0.5, np.inf]]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: box([0, 0], [1]), "shapes"),
        (lambda: box([0.0, 2.0], [1.0, 1.0]), r"low=2 and high=1 at \[0, 1\]"),
        (lambda: box([np.nan], [1]), "low must be below high"),
        (lambda: half_space([0, 0], 1), "not zero"),
        (lambda: half_space([1, np.nan], 1), "finite vector"),
        (lambda: where_positive(3), "give a function"),
        (lambda: box([0], [1]) | box([0, 0], [1, 1]), "one space"),
        (lambda: union(), "missing"),
    ],
)
def test_bad_regions_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
