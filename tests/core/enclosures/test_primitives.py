"""Primitives of the installed JAX: each has an enclosure that contains values, NaN included."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxltl.core.enclosures import primitives, program
from jaxltl.core.enclosures.linear_bounds import enclose, linear_bounds, over_boxes

MAX_PROGRAMS = 600  # that the default tests compile at most


def unpacked(x):
    p, v = x
    return jnp.stack([p * v, v - p])


def while_loop(x):
    return lax.while_loop(lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * 0.5 + x), (0, x))[1]


def reverse_scan(x):
    return lax.scan(
        lambda c, y: (c * 0.5 + y * x, c), x, jnp.arange(3.0, dtype=x.dtype), reverse=True
    )


MODULE = nn.Sequential([nn.Dense(4), nn.tanh, nn.Dense(3), nn.gelu, nn.LayerNorm()])


@functools.cache
def parameters():
    return MODULE.init(jax.random.key(0), np.zeros(2, np.float32))


def network(x):
    return MODULE.apply(jax.tree.map(np.asarray, parameters()), x)


# Functions of two numbers, of every kind that the documentation names.
ELEMENTARY = {
    name: getattr(jnp, name) for name in (
        "sin", "cos", "tan", "arcsin", "arccos", "arctan", "sinh", "cosh", "tanh", "arcsinh", "arccosh",
        "arctanh", "exp", "exp2", "expm1", "log", "log2", "log10", "log1p", "sqrt", "cbrt", "square",
        "abs", "sign", "floor", "ceil", "round", "reciprocal", "negative", "isfinite", "isnan",
        "nan_to_num")
} | {
    name: getattr(jax.nn, name) for name in (
        "relu", "relu6", "sigmoid", "softplus", "silu", "gelu", "elu", "selu", "celu", "softmax",
        "log_softmax", "leaky_relu", "hard_tanh", "hard_sigmoid", "soft_sign", "log_sigmoid", "mish",
        "logsumexp")
} | {
    "rsqrt": lax.rsqrt, "erf": lax.erf, "logistic": lax.logistic, "round_away": lax.round,
    "integer_pow": lambda x: x**-3, "power": lambda x: x**1.5, "inverse_power": lambda x: x**-0.5,
    "even_power": lambda x: x**2.0, "base": lambda x: 2.0**x, "varying_power": lambda x: x ** x[::-1],
    "maximum": lambda x: jnp.maximum(x, x[::-1]), "minimum": lambda x: jnp.minimum(x, 0.25),
    "clip": lambda x: jnp.clip(x, -0.5, 0.5), "where": lambda x: jnp.where(x > 0, x, -2 * x),
    "add": lambda x: x + x[::-1], "sub": lambda x: x - x[::-1], "mul": lambda x: x * x[::-1],
    "div": lambda x: x / x[::-1], "itself": lambda x: x / x, "atan2": lambda x: jnp.arctan2(x, x[::-1]),
    "nan_of_negative": lambda x: jnp.where(x < 0, jnp.nan, x), "nan": lambda x: x * jnp.nan,
    "infinity": lambda x: x * jnp.inf, "not_both": lambda x: jnp.logical_not((x > 0) & (x < 1)) * 1.0,
}  # fmt: skip
STRUCTURAL = {
    "unpacked": unpacked, "while": while_loop, "scan": reverse_scan, "network": network,
    "fori": lambda x: lax.fori_loop(0, 3, lambda i, y: y * 0.5 + i * x, x),
    "cond": lambda x: lax.cond(x[0] > 0.1, lambda y: y * 2, lambda y: -y, x),
    "switch": lambda x: lax.switch((x[0] > 0) * 1 + 1, [lambda y: y, lambda y: -y, lambda y: 2 * y], x),
    "known_cond": lambda x: lax.cond(True, lambda y: y * 2, lambda y: -y, x),
    "indexed": lambda x: x[jnp.array([1, 0, 1])] + x[-1], "take": lambda x: jnp.take(x, 1),
    "filled": lambda x: x.at[jnp.array([1, 7])].get(mode="fill", fill_value=0.5),
    "set": lambda x: x.at[1].set(x[0] * 2), "padded": lambda x: jnp.pad(x, 1, constant_values=3.0),
    "rolled": lambda x: jnp.roll(x, 1), "split": lambda x: jnp.split(x, 2)[1],
    "stacked": lambda x: jnp.stack([x, x]).T.reshape(-1), "tiled": lambda x: jnp.tile(x, 2),
    "joined": lambda x: jnp.concatenate([x, x[:1]]), "flipped": lambda x: jnp.flip(x),
    "sliced": lambda x: lax.dynamic_slice(x, (jnp.int32(1),), (1,)), "sum": jnp.sum, "mean": jnp.mean,
    "extremes": lambda x: jnp.max(x) - jnp.min(x), "prod": jnp.prod, "cumsum": jnp.cumsum,
    "norm": jnp.linalg.norm, "dot": lambda x: x @ np.array([[1.0, -2], [0, 3]], np.float32),
    "outer": lambda x: jnp.outer(x, x), "vmapped": lambda x: jax.vmap(lambda y: jnp.sin(y) * x)(x),
    "gradient": jax.grad(lambda x: jnp.sum(jnp.tanh(x) * jnp.exp(-x) + jax.nn.sigmoid(x) * x)),
    "custom": jax.checkpoint(lambda x: jnp.sin(x) * x), "jitted": jax.jit(lambda x: x - jnp.cos(x)),
    "polynomial": lambda x: jnp.polyval(jnp.array([1.0, -2.0, 0.5]), x),
    "any": lambda x: jnp.where((x > 0).any(), x, -x), "converted": lambda x: (x > 0).astype(x.dtype),
}  # fmt: skip
FUNCTIONS = ELEMENTARY | STRUCTURAL


def boxes(dtype):
    """Boxes that cross the edges of domains, points, and boxes with infinite ends."""
    rng = np.random.default_rng(3)
    centre, radius = rng.uniform(-3, 3, (24, 2)), 10.0 ** rng.uniform(-3, 0.5, (24, 1))
    low, high = centre - radius, centre + radius
    edges = [(0, 0), (0, 1), (-1, 1), (1, 1), (-1, -1), (0, np.inf), (-np.inf, 0), (-np.inf, np.inf),
             (-0.5, 0.9), (1, 2), (0.5, 0.5), (1.5, 2.5), (300, 400), (-1000, 1000)]  # fmt: skip
    low, high = (
        np.concatenate([side, [[edge[i], other[i]] for edge in edges for other in edges]])
        for i, side in enumerate((low, high))
    )
    return low.astype(dtype), high.astype(dtype)


def samples(low, high, count=9):
    """Points of the boxes with their corners; large ones in place of infinity."""
    rng = np.random.default_rng(4)
    low, high = (np.clip(x.astype(np.float64), -1e30, 1e30) for x in (low, high))
    share = rng.uniform(size=(count, *low.shape))
    share[:4] = [[[0, 0]], [[0, 1]], [[1, 0]], [[1, 1]]]
    return np.clip(low + share * (high - low), low, high)


@pytest.mark.parametrize("dtype", [np.float64, pytest.param(np.float32, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_values_lie_inside_or_nothing_is_known(name, dtype):
    """Bounds are infinite on both sides at points with a sample that is NaN."""
    function, (low, high) = FUNCTIONS[name], boxes(dtype)
    parameters()
    if name not in ELEMENTARY:
        low, high = low[::5], high[::5]
    points = samples(low, high)
    with jax.enable_x64(True), np.errstate(all="ignore"):
        found = jax.tree.leaves(jax.jit(jax.vmap(jax.vmap(function)))(points))
        outputs = over_boxes(function, low, high).outputs(True)
    for bounds, value in zip(outputs, found, strict=True):
        value = np.asarray(value, np.float64).reshape(*points.shape[:2], -1)
        lower, upper = bounds.low.astype(np.float64), bounds.high.astype(np.float64)
        # Samples round too, and overflow.
        slack = 1e-12 * (1 + np.abs(np.where(np.isfinite(value), value, 0)))
        missing = np.isnan(value)
        inside = (lower <= value + slack) & (value - slack <= upper)
        unknown = (lower == -np.inf) & (upper == np.inf)
        # Real values are finite where those of large arguments overflow in the program.
        overflow = np.broadcast_to((np.abs(points) > 250).any(-1, keepdims=True), value.shape)
        if name in ("isnan", "nan_to_num", "isfinite"):
            assert (inside | missing).all()
            continue
        wrong = np.where(missing, ~unknown & ~overflow, ~inside & ~(overflow & ~np.isfinite(value)))
        assert not wrong.any(), [
            (points[tuple(i[:2])], value[tuple(i)]) for i in np.argwhere(wrong)[:3]
        ]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_small_boxes_have_finite_bounds(name):
    """The functions are known: within their domain, no bound is infinite."""
    if name in ("nan", "infinity", "nan_to_num", "isnan", "isfinite"):
        pytest.skip("not a number")
    low = np.array([1.1, 1.2] if name == "arccosh" else [0.31, 0.42])
    for bounds in over_boxes(FUNCTIONS[name], low[None], low[None] + 1e-3).outputs(True):
        assert np.isfinite(bounds.high - bounds.low).all()
        assert (bounds.high - bounds.low).max() < 0.5 or name in ("floor", "ceil", "network")


def test_all_primitives_are_in_the_tables():
    """No primitive of these functions in the installed version of JAX is unknown."""
    known = program.ELEMENTWISE | set(program._SELECTIONS) | set(program._REDUCTIONS)
    known |= set(program._RENAMED) | set(program._CALLS)
    known |= {"scan", "while", "cond", "reduce_sum", "cumsum", "dot_general", "clamp", "polynomial"}
    known |= {"iota"}  # of known numbers

    def names(jaxpr):
        for equation in program._needed(jaxpr):
            yield str(equation.primitive)
            for value in jax.tree.leaves(list(equation.params.values())):
                if hasattr(value, "jaxpr"):
                    yield from names(value.jaxpr)

    found = {
        name
        for function in FUNCTIONS.values()
        for name in names(jax.make_jaxpr(function)(np.zeros(2)).jaxpr)
    }
    assert found <= known, found - known
    assert "no enclosure" in primitives.refusal("sort")


def random_function(rng, depth=4):
    """A composition of functions of the table, which may be NaN anywhere."""
    names = [x for x in ELEMENTARY if x not in ("isnan", "isfinite", "nan_to_num")]
    chosen = [ELEMENTARY[names[i]] for i in rng.integers(len(names), size=depth)]

    def composed(x):
        for function in chosen:
            y = function(x)
            x = jnp.broadcast_to(y, x.shape).astype(x.dtype) * 0.5 + 0.25 * x
        return x

    return composed


@pytest.mark.parametrize("seed", range(24))
def test_random_compositions(seed):
    rng = np.random.default_rng(seed)
    function, dtype = random_function(rng), (np.float64, np.float32)[seed % 2]
    centre, radius = rng.uniform(-2, 2, (60, 2)), 10.0 ** rng.uniform(-3, 0, (60, 1))
    low, high = ((centre + sign * radius).astype(dtype) for sign in (-1, 1))
    points = samples(low, high, 30)
    with jax.enable_x64(True), np.errstate(all="ignore"):
        value = np.asarray(jax.vmap(jax.vmap(function))(points), np.float64)
        for linear in (False, True):
            (bounds,) = over_boxes(function, low, high, linear).outputs(linear)
            slack = 1e-9 * (1 + np.abs(np.where(np.isfinite(value), value, 0)))
            inside = (bounds.low <= value + slack) & (value - slack <= bounds.high)
            unknown = (bounds.low == -np.inf) & (bounds.high == np.inf)
            # Infinite samples are of poles, or of overflow.
            assert np.where(np.isnan(value), unknown, inside | np.isinf(value)).all()


NOT_A_NUMBER = {
    "constant": lambda x: x * 0 + jnp.nan,
    "hidden by a clip": lambda x: jnp.clip(jnp.log(x), 0, 1),
    "hidden by tanh": lambda x: jnp.tanh(jnp.sqrt(x)),
    "hidden by a maximum": lambda x: jnp.maximum(jnp.nan, x),
    "a matrix": lambda x: jnp.tanh(x @ np.array([[np.nan, np.nan], [1, 1]])),
    "a product with 0": lambda x: jnp.clip(0 * (1 / x), -1, 1),
    "infinities that cancel": lambda x: jnp.tanh(1 / x - 1 / x),
    "the sine of infinity": lambda x: jnp.sin(1 / x),
    "an entry out of range": lambda x: jnp.tanh(jnp.take(x, jnp.array([5, 6]))),
    "a branch": lambda x: lax.cond(x[0] > 0, lambda y: y, lambda y: jnp.arcsin(y + 9), x),
    "a power": lambda x: jnp.tanh(x**0.5),
    "a varying power": lambda x: jnp.tanh(x ** (x + 1)),
}  # fmt: skip


@pytest.mark.parametrize("name", NOT_A_NUMBER)
def test_nan_has_infinite_bounds(name):
    low, high = np.full(2, -0.5, np.float32), np.full(2, 0.9, np.float32)
    function = NOT_A_NUMBER[name]
    for method in ("linear", "interval"):
        lower, upper = enclose(function, method)(low, high)
        assert (lower == -np.inf).all() and (upper == np.inf).all()
    form = linear_bounds(function)(low[None], high[None])
    assert (form.lower == -np.inf).all() and (form.upper == np.inf).all()


def test_nan_has_infinite_bounds_in_jit():
    low, high = jnp.full(2, -0.5), jnp.full(2, 0.9)
    lower, upper = jax.jit(enclose(NOT_A_NUMBER["hidden by a clip"]))(low, high)
    assert (lower == -jnp.inf).all() and (upper == jnp.inf).all()
    function = jax.jit(lambda p: enclose(lambda x: jnp.tanh(p * x), "interval")(low, high))
    lower, upper = function(jnp.nan)
    assert (lower == -jnp.inf).all() and (upper == jnp.inf).all()


def test_comparisons_with_nan_are_unknown():
    for test in (lambda x: x * jnp.nan > 0, lambda x: x * jnp.nan != 1, lambda x: jnp.sqrt(x) < 9):
        lower, upper = enclose(lambda x, test=test: jnp.where(test(x), 2.0, 1.0))(
            np.float64(-1), np.float64(1)
        )
        assert (lower, upper) == (1, 2)


def test_boxes_with_nan_have_infinite_bounds():
    for low, high in ((np.nan, 1.0), (0.0, np.nan), (np.nan, np.nan)):
        lower, upper = enclose(jnp.tanh)(np.float64(low), np.float64(high))
        assert (lower, upper) == (-np.inf, np.inf)


@pytest.mark.parametrize("width", [1e-3, 1.0, 50.0, 500.0])
def test_ranges_are_kept(width):
    """Shares in [0, 1], and their logarithms at most 0, also where exponentials overflow."""
    low = np.array([-1.0, 0.5, 2.0])
    for function, least, most in (
        (jax.nn.softmax, 0, 1), (jax.nn.log_softmax, -np.inf, 0), (jax.nn.sigmoid, 0, 1),
        (jnp.tanh, -1, 1), (lambda x: jax.nn.softmax(jnp.stack([x, 2 * x]), -1), 0, 1),
        (lambda x: jax.nn.softmax(jnp.stack([x, 2 * x]), 0), 0, 1),
    ):  # fmt: skip
        for dtype in (np.float64, np.float32):
            lower, upper = enclose(function)(
                (low - width).astype(dtype), (low + width).astype(dtype)
            )
            assert (least <= lower).all() and (upper <= most).all()


def test_batches_of_boxes():
    """Each box has the bounds that it has alone."""
    low = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    high = low + 0.1

    def function(x):
        return jnp.sum(x) * x[0], jnp.float32(1)

    found = enclose(function, batched=True)(low, high)
    for i in range(5):
        alone = enclose(function)(low[i], high[i])
        for side in (0, 1):
            assert found[side][0][i] == alone[side][0] and found[side][1].shape == (5,)
    with pytest.raises(ValueError, match="one leading axis"):
        enclose(lambda t: t[0], batched=True)((low, low[:3]), (high, high[:3]))
    with pytest.raises(ValueError, match="leading axis"):
        enclose(jnp.sin, batched=True)(np.float64(0), np.float64(1))
    with pytest.raises(ValueError, match=r"low=2 exceeds high=1 in box 0 at \[1\]"):
        enclose(jnp.sin)(np.array([0.0, 2.0]), np.array([1.0, 1.0]))
