"""Linear bounds on their own: of elementwise functions, and of chains where only rounding matters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.enclosures import elementwise
from jaxltl.core.enclosures.interval import Interval
from jaxltl.core.enclosures.linear_bounds import linear_bounds, over_boxes
from jaxltl.core.enclosures.program import Elementwise

UNARY = {
    "abs": np.abs, "square": np.square, "exp": np.exp, "tanh": np.tanh, "sin": np.sin,
    "cos": np.cos, "atan": np.arctan, "erf": elementwise.INCREASING["erf"], "expm1": np.expm1,
    "logistic": elementwise.INCREASING["logistic"], "tan": lambda x: np.tan(x),
    "sqrt": lambda x: np.sqrt(x), "log": lambda x: np.log(x), "log1p": lambda x: np.log1p(x),
}  # fmt: skip
BINARY = {"max": np.maximum, "min": np.minimum, "mul": np.multiply, "div": np.divide,
          "atan2": np.arctan2}  # fmt: skip


def lines(name, *inputs):
    """Linear bounds of an elementwise function over boxes."""
    operation = Elementwise(name, {}, tuple(range(len(inputs))), len(inputs), "here")
    with np.errstate(all="ignore"):
        return elementwise.relax(
            operation, list(inputs), elementwise.bounds(operation, list(inputs))
        )


def check(bounds, value, *points):
    low = bounds.lower + sum(s * x for s, x in zip(bounds.lower_slope, points, strict=True))
    high = bounds.upper + sum(s * x for s, x in zip(bounds.upper_slope, points, strict=True))
    slack = 1e-13 * (1 + np.abs(value))
    assert (low <= value + slack).all() and (value - slack <= high).all()


@pytest.mark.parametrize("name", UNARY)
def test_lines_enclose_functions(name):
    rng = np.random.default_rng(0)
    positive = name in ("sqrt", "log", "log1p")
    centre = rng.uniform(0.02, 3, 400) if positive else rng.uniform(-1.2, 1.2, 400)
    radius = 10.0 ** rng.uniform(-6, -0.8, 400)
    low = np.maximum(centre - radius, 0) if positive else centre - radius
    high = centre + radius
    bounds = lines(name, Interval(low, high))
    for share in np.linspace(0, 1, 41):
        x = np.clip(low + share * (high - low), low, high)
        with np.errstate(all="ignore"):
            check(bounds, UNARY[name](x), x)
    gap = bounds.upper - bounds.lower
    assert np.isfinite(gap).mean() > 0.9  # two lines of one slope, at distance O(radius^2)


def test_lines_at_a_kink_are_tight():
    bounds = lines("abs", Interval(np.array([-1.0]), np.array([3.0])))
    np.testing.assert_allclose(bounds.lower_slope[0], [0.5])
    # |x| - x / 2 lies between 0 and 1.5 on [-1, 3].
    assert abs(bounds.lower[0]) < 1e-12 and abs(bounds.upper[0] - 1.5) < 1.5 + 1e-12
    at_zero = bounds.lower[0]
    assert at_zero <= 0  # the line passes below the kink, where the bound is attained


@pytest.mark.parametrize("name", BINARY)
def test_planes_enclose_functions(name):
    rng = np.random.default_rng(1)
    centre, radius = rng.uniform(-1.5, 1.5, (2, 400)), 10.0 ** rng.uniform(-6, 0, (2, 400))
    low, high = centre - radius, centre + radius
    if name == "div":
        low[1] = np.abs(centre[1]) + 0.01
        high[1] = low[1] + radius[1]
    bounds = lines(name, *(Interval(a, b) for a, b in zip(low, high, strict=True)))
    for _ in range(60):
        share = np.where(rng.uniform(size=low.shape) < 0.4, rng.integers(0, 2, low.shape),
                         rng.uniform(size=low.shape))  # fmt: skip
        x = np.clip(low + share * (high - low), low, high)
        check(bounds, BINARY[name](*x), *x)


def affine(x):
    """Chain of sums with large terms that cancel: linear, so that bounds differ by rounding alone."""
    for matrix in MATRICES:
        x = x @ matrix
    scaled = [x * np.float32(c) for c in (1e3, -999.75, 3.5)]
    return sum(scaled) - x[::-1] + x.sum() * np.float32(0.3)


MATRICES = [
    (np.random.default_rng(i).normal(size=shape) * 20).astype(np.float32)
    for i, shape in enumerate(((3, 30), (30, 30), (30, 4)))
]


def exact(points):
    """The affine function in extended precision."""
    x = points.astype(np.longdouble)
    for matrix in MATRICES:
        x = x @ matrix.astype(np.longdouble)
    scaled = sum(x * np.longdouble(np.float32(c)) for c in (1e3, -999.75, 3.5))
    return scaled - x[..., ::-1] + x.sum(-1, keepdims=True) * np.longdouble(np.float32(0.3))


def corners(known, count=200):
    """Corners e of the box, and the points m + r e."""
    sign = np.random.default_rng(3).choice([-1.0, 1.0], (count, 1, known.middle.shape[-1]))
    radius = (known.intervals[known.program.inputs[0]].high - known.middle).astype(np.longdouble)
    return sign, known.middle.astype(np.longdouble) + radius * sign


def test_rounding_of_affine_chains_is_enclosed():
    rng = np.random.default_rng(2)
    low = rng.normal(size=(50, 3)).astype(np.float32)
    high = low + np.float32(1e-3)
    known = over_boxes(affine, low, high)
    y = known.program.outputs[0]
    forward = known.intervals[y]
    backward = linear_bounds(affine)(low, high)
    sign, points = corners(known)
    value = exact(points)
    assert ((forward.low <= value) & (value <= forward.high)).all()
    form_low = backward.lower + np.einsum("ncj,cjm->ncm", sign, backward.lower_slope.astype(float))
    form_high = backward.upper + np.einsum("ncj,cjm->ncm", sign, backward.upper_slope.astype(float))
    assert ((form_low <= value) & (value <= form_high)).all()


@pytest.mark.parametrize("part", ["product", "elementwise", "backward"])
def test_each_part_of_the_rounding_matters(part):
    """Points of width 0, where bounds are the errors' bounds: they contain the exact value."""
    functions = {
        "product": (lambda x: x @ MATRICES[0] @ MATRICES[1],
                    lambda x: x @ MATRICES[0].astype(np.longdouble) @ MATRICES[1].astype(np.longdouble)),
        "elementwise": (lambda x: (x * 1024.125 - x * 1023.875) * 0.3125 + x / 3,
                        lambda x: (x * 1024.125 - x * 1023.875) * 0.3125 + x / 3),
        "backward": (lambda x: jnp.sum(x * MATRICES[0].T, -1),
                     lambda x: (x[..., None, :] * MATRICES[0].T.astype(np.longdouble)).sum(-1)),
    }  # fmt: skip
    function, reference = functions[part]
    low = np.random.default_rng(4).normal(size=(300, 3)).astype(np.float32)
    value = reference(low.astype(np.longdouble))
    for linear in (False, True):
        found = over_boxes(function, low, low.copy(), linear).outputs(linear)[0]
        assert ((found.low <= value) & (value <= found.high)).all()
    form = linear_bounds(function)(low, low.copy())
    assert ((form.lower <= value) & (value <= form.upper)).all()


def test_sums_that_cancel():
    matrix = np.array([[1e4], [-1e4], [1.0]], np.float32)
    rng = np.random.default_rng(5)
    low = rng.normal(size=(300, 3)).astype(np.float32)
    low[:, 1] = low[:, 0] * np.float32(1 + 1e-4)
    value = low.astype(np.longdouble) @ matrix.astype(np.longdouble)
    known = over_boxes(lambda x: x @ matrix, low, low.copy())
    bounds = known.intervals[known.program.outputs[0]]
    assert ((bounds.low <= value) & (value <= bounds.high)).all()


def test_offsets_that_cancel():
    """Far from 0 the line of the sine is a difference of large numbers."""
    low = np.random.default_rng(6).uniform(1000, 4000, (300, 1)).astype(np.float32)
    high = np.nextafter(np.nextafter(low, np.float32(1e9)), np.float32(1e9))
    known = over_boxes(jnp.sin, low, high)
    y = known.program.outputs[0]
    form = linear_bounds(jnp.sin)(low, high)
    for x in (low, high):
        value = np.sin(x.astype(np.longdouble))
        for bounds in (known.intervals[y], form.interval()):
            assert ((bounds.low <= value) & (value <= bounds.high)).all()


def test_constant_outputs_have_no_slopes():
    low = np.zeros((2, 3), np.float32)
    form = jax.tree.map(lambda x: x, linear_bounds(lambda x: jnp.full(2, 0.5) * 3)(low, low + 1))
    assert (form.lower_slope == 0).all() and form.lower_slope.shape[1:] == (3, 2)
    assert (form.lower <= 1.5).all() and (form.upper >= 1.5).all()
