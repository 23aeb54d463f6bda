"""Enclosures of JAX functions: sound, tight where terms cancel, differentiable, and clear refusals."""

import itertools

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from jaxltl.core.enclosures.linear_bounds import enclose, over_boxes

MAX_PROGRAMS = 450  # that the default tests compile at most

# Constants are equal in single and double precision, so that all tests are of one function.
MATRIX = np.random.default_rng(0).normal(size=(2, 5)).astype(np.float32).astype(float)


def loop(x):
    return jax.lax.fori_loop(
        0, 4, lambda i, y: y + 0.125 * jnp.sin(y[::-1]) + jnp.array([1.0, 2, 3, 4])[i], x
    )


def scan(x):
    carry, values = jax.lax.scan(lambda c, y: (0.875 * c + y, c * y), x, jnp.arange(3.0))
    return carry, values


def pendulum(z):
    (p, v), w = z[:2], z[2:] if z.shape[0] > 2 else z
    u = 2 * jnp.clip(jnp.tanh(z[:2] @ MATRIX).sum(), -1, 1)
    v = jnp.clip(v * 7 / 8 + (-15 * jnp.sin(p + 3.125) + 80 * u) / 16 + w[0] / 64, -5, 5)
    return jnp.clip(jnp.stack([p + v / 16 + w[1] / 128, v]), -0.75, 0.75)


FUNCTIONS = {
    "norm": lambda x: jnp.clip(jnp.linalg.norm(jnp.array([0, 1.0]) - x) / 0.375, 0, 1),
    "softplus": jax.nn.softplus,
    "polynomial": lambda x: x**3 - 2 * x**2 + x,
    "power": lambda x: jnp.where(x > 0, jnp.abs(x) ** 2.5, 0.0),
    "gelu": jax.nn.gelu,
    "elu": jax.nn.elu,
    "silu": jax.nn.silu,
    "leaky_relu": jax.nn.leaky_relu,
    "network": lambda x: jax.nn.relu(jax.nn.relu(x @ MATRIX) @ MATRIX.T + 0.125) @ MATRIX,
    "angle": lambda x: jnp.arctan2(x[0], x[1] + 3) - x[0] / 3,
    "tan": lambda x: jnp.tan(x / 4) - x,
    "sqrt": lambda x: jnp.sqrt(x + 2) * x,
    "quotient": lambda x: jnp.log(x + 2) / (x + 3),
    "two_varying_matrices": lambda x: jnp.outer(x, x) @ x,
    "extremes": lambda x: jnp.max(x) - jnp.min(x) + jnp.prod(x),
    "cancelling": lambda x: jnp.tanh(x) - x,
    "sine": lambda x: jnp.sin(3 * x) * x + jnp.cos(x),
    "cumulative": lambda x: jnp.cumsum(x) * x - jnp.mean(x),
    "erf": jax.scipy.special.erf,
    "exponential": lambda x: jnp.exp(-x) - jnp.expm1(x) + jax.nn.sigmoid(x),
    "softmax": jax.nn.softmax,
    "indexed": lambda x: x[jnp.array([1, 0, 1])] * x[0] + x[::-1][1],
    "joined": lambda x: jnp.concatenate([x, jnp.stack([x[1] - x[0], x.sum()])]).reshape(2, 2).T,
    "choice": lambda x: jnp.where(x[0] > x[1], x - x[::-1], -x),
    "loop": loop,
    "scan": scan,
    "pendulum": pendulum,
    "constant": lambda x: (jnp.full(2, 0.125) * 3, x),
}  # fmt: skip
RADII = (0.3, 0.01, 0.0)


def boxes(dtype, count=90):
    rng = np.random.default_rng(5)
    centre = rng.uniform(-1, 1, (count, 2)).astype(dtype)
    radius = np.resize(RADII, count).astype(dtype)[:, None]
    return centre - radius, centre + radius, np.resize(RADII, count)


def values(function, low, high, count=200):
    """Values in float64 at random points of the boxes, corners included."""
    rng = np.random.default_rng(6)
    share = rng.uniform(size=(count, *low.shape))
    share[: count // 4] = rng.integers(0, 2, share[: count // 4].shape)
    points = low.astype(float) + share * (high.astype(float) - low.astype(float))
    with jax.enable_x64(True):
        found = jax.tree.leaves(jax.jit(jax.vmap(jax.vmap(function)))(points))
    return [np.asarray(x).reshape(count, len(low), -1) for x in found]


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_lie_inside(name, linear):
    function = FUNCTIONS[name]
    for dtype in (np.float64, np.float32):
        low, high, _ = boxes(dtype)
        with jax.enable_x64(dtype == np.float64):
            outputs = over_boxes(function, low, high, linear).outputs(linear)
        for bounds, found in zip(outputs, values(function, low, high), strict=True):
            # The samples round too: in double precision, by far less than the bounds of float32.
            slack = 1e-14 * (1 + np.abs(found))
            assert ((bounds.low <= found + slack) & (found - slack <= bounds.high)).all()


def composed(x, xp, matrix):
    """Networks, sines and differences of large numbers; NumPy, JAX or arrays of mpmath numbers."""
    tanh, sin = (np.vectorize(f, otypes=[object]) for f in (mpmath.tanh, mpmath.sin))
    tanh, sin = (tanh, sin) if xp is mpmath else (xp.tanh, xp.sin)
    hidden = tanh(x @ matrix)
    return hidden @ matrix.T - sin(15 * x) + (x * 1024 + 0.5) ** 3 - (x * 1024) ** 3 - x / 3


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("linear", [False, True])
def test_corners_of_tiny_boxes_in_extended_precision(dtype, linear):
    """Boxes of a few units in the last place, where bounds are little but rounding."""
    matrix = np.random.default_rng(0).normal(size=(2, 5)).astype(dtype)
    centre = np.random.default_rng(7).uniform(-1, 1, (25, 2)).astype(dtype)
    low, high = centre, centre + 4 * np.finfo(dtype).eps
    with jax.enable_x64(dtype == np.float64):
        (bounds,) = over_boxes(
            lambda x: composed(x, jnp, matrix), low, high, linear
        ).outputs(linear)  # fmt: skip
    exact_matrix = np.vectorize(mpmath.mpf, otypes=[object])(matrix.astype(float))
    with mpmath.workdps(50):
        for i, corner in itertools.product(range(len(low)), itertools.product((0, 1), repeat=2)):
            x = np.where(corner, high[i], low[i]).astype(float)
            exact = composed(np.array([mpmath.mpf(v) for v in x]), mpmath, exact_matrix)
            assert (bounds.low[i] <= exact).all() and (exact <= bounds.high[i]).all()


def test_linear_bounds_see_cancellation():
    low, high, radius = boxes(np.float64)
    small = radius == RADII[1]
    for name in ("cancelling", "network", "polynomial", "quotient", "sine"):
        width = {}
        for linear in (False, True):
            bounds = over_boxes(FUNCTIONS[name], low, high, linear).outputs(linear)[0]
            width[linear] = (bounds.high - bounds.low)[small].mean()
        found = values(FUNCTIONS[name], low, high)[0]
        true = (found.max(0) - found.min(0))[small].mean()
        assert width[True] < 1.15 * true and width[True] < width[False]


def test_points_have_almost_no_width():
    low, high, radius = boxes(np.float64)
    with jax.enable_x64(True):
        for function in FUNCTIONS.values():
            for bounds in over_boxes(function, low, high).outputs(True):
                rows = bounds.low.shape[0] > 1
                here = radius == 0 if rows else slice(None)
                assert (bounds.high - bounds.low)[here].max() < 1e-11


def test_jit_and_vmap_give_the_same_bounds():
    low, high, _ = boxes(np.float32, 6)
    function = FUNCTIONS["choice"]
    expected = [enclose(function)(a, b) for a, b in zip(low, high, strict=True)]
    found = jax.jit(jax.vmap(enclose(function)))(jnp.asarray(low), jnp.asarray(high))
    for side in (0, 1):
        np.testing.assert_allclose(found[side], [x[side] for x in expected], atol=2e-6)


def test_bounds_are_differentiable():
    def upper(a, b):
        return enclose(lambda x: x * x[0])(a, b)[1].sum()

    with jax.enable_x64(True):
        a, b = jnp.array([0.1, 0.2]), jnp.array([0.3, 0.5])
        gradient = jax.grad(upper, (0, 1))(a, b)
        for side in (0, 1):
            for i in range(2):
                step = jnp.zeros(2).at[i].set(1e-6)
                up, down = ([x + s * step if j == side else x for j, x in enumerate((a, b))]
                            for s in (1, -1))  # fmt: skip
                difference = (upper(*up) - upper(*down)) / 2e-6
                assert abs(gradient[side][i] - difference) < 1e-6


def test_products_with_empty_arrays_are_zero():
    low, high = enclose(lambda x: x + np.zeros((2, 0)) @ x[:0])(np.zeros(2), np.ones(2))
    assert (low <= 0).all() and (low > -1e-9).all() and (high >= 1).all()


def test_trees_in_and_out():
    low = {"x": np.zeros(2, np.float32), "y": np.float32(1)}
    high = {"x": np.ones(2, np.float32), "y": np.float32(2)}
    found = enclose(lambda t: {"sum": t["x"] + t["y"]})(low, high)
    assert found[0]["sum"].shape == (2,) and (found[1]["sum"] >= 3).all()


def test_other_precision_of_parameters():
    kernel = np.full((2, 2), 0.1, np.float32)
    low, high = np.zeros(2), np.ones(2)
    with jax.enable_x64(True):
        found = enclose(lambda x: x @ kernel)(low, high)
    assert found[1].dtype == np.float64
    assert 0 <= found[1][0] - 2 * float(np.float32(0.1)) < 1e-12


@pytest.mark.parametrize(
    ("function", "words"),
    [
        (lambda x: x if x[0] > 0 else -x, "reads the value"),
        (lambda x: np.sin(x), "cannot be traced"),
        (lambda x: jax.lax.while_loop(lambda y: y[0] > 0, lambda y: y - 1, x), "fixed length"),
        (lambda x: jnp.sort(x), "primitive `sort`"),
        (lambda x: x[(x[0] > 0).astype(int)], "index depends"),
        (lambda x: x.astype(jnp.int32), "keep it a float"),
    ],
)
def test_unsupported_functions_are_refused(function, words):
    with pytest.raises(ValueError, match=words) as error:
        enclose(function)(np.zeros(2, np.float32), np.ones(2, np.float32))
    assert "test_enclose.py:" in str(error.value) or "traced" in str(error.value)


def test_boxes_are_checked():
    with pytest.raises(ValueError, match="differ in structure"):
        enclose(jnp.sin)([np.zeros(2)], np.ones(2))
    with pytest.raises(ValueError, match="equal shapes"):
        enclose(jnp.sin)(np.zeros(2), np.ones(3))
    with pytest.raises(ValueError, match="floats of one dtype"):
        enclose(jnp.sin)(np.zeros(2, int), np.ones(2, int))
    with pytest.raises(ValueError, match="method='exact'"):
        enclose(jnp.sin, "exact")


def test_operations_that_no_output_needs_are_left_out():
    def function(x):
        jax.random.uniform(jax.random.fold_in(jax.random.key(0), 1))  # has no enclosure
        return 2 * x

    low, high = enclose(function)(np.float32(0), np.float32(1))
    assert low <= 0 and 2 <= high < 2.001


def test_single_precision_parameters_over_double_precision_boxes():
    one = jnp.ones(2, jnp.float32)
    low, high = np.array([-0.71, -0.01]), np.array([-0.69, 0.01])
    for function in (lambda x: jnp.minimum(3 + x, one), lambda x: jnp.clip(3 + x, -one, one)):
        least, most = enclose(function)(low, high)
        assert (least <= 1).all() and (most >= 1).all() and (most - least < 1e-6).all()
