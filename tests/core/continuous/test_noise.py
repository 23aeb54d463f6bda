"""Distributions of the noise against mpmath, dense grids of shifts, and samples."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from jaxltl.core.continuous import noise


def smooth(x):
    """A distribution function on [0, 1] without symmetry."""
    return x * x * (3 - 2 * x) * 0.5 + 0.5 * x * x


def normal(z):
    return mpmath.ncdf(z)


def exact_uniform(x, low=-0.3, high=0.7):
    x, low, high = (mpmath.mpf(y) for y in (x, low, high))
    return min(max((x - low) / (high - low), mpmath.mpf(0)), mpmath.mpf(1))


def exact_triangular(x):
    t = exact_uniform(x, -1.0, 1.0)
    return 2 * t * t if t <= 0.5 else 1 - 2 * (1 - t) ** 2


def exact_truncated(low, high, mean):
    def cdf(x):
        x = min(max(mpmath.mpf(x), mpmath.mpf(low)), mpmath.mpf(high))
        first, here, last = (normal(mpmath.mpf(y) - mpmath.mpf(mean)) for y in (low, x, high))
        return (here - first) / (last - first)

    return cdf


def exact_smooth(x):
    x = min(max(mpmath.mpf(x), mpmath.mpf(0)), mpmath.mpf(1))
    return x * x * (3 - 2 * x) / 2 + x * x / 2


CASES = {
    "uniform": (noise.uniform(-0.3, 0.7), exact_uniform),
    "triangular": (noise.triangular(), exact_triangular),
    "gaussian": (
        noise.gaussian(0.7, 0.1),
        lambda x: normal((mpmath.mpf(x) - mpmath.mpf(0.1)) / mpmath.mpf(0.7)),
    ),
    "truncated": (noise.truncated_gaussian(1.0, -1.5, 1.5), exact_truncated(-1.5, 1.5, 0.0)),
    "one-sided": (noise.truncated_gaussian(1.0, 0.5, 3.0, 0.2), exact_truncated(0.5, 3.0, 0.2)),
    "logistic": (
        noise.from_cdf(jax.nn.sigmoid, -np.inf, np.inf),
        lambda x: 1 / (1 + mpmath.exp(-mpmath.mpf(x))),
    ),
    "smooth": (noise.from_cdf(smooth, 0.0, 1.0), exact_smooth),
}


@pytest.fixture(autouse=True)
def digits():
    with mpmath.workdps(250):
        yield


@pytest.mark.parametrize("name", CASES)
def test_the_distribution_function_is_within_its_error(name):
    made, exact = CASES[name]
    low, high = np.clip(made.support, -9, 9)
    x = np.concatenate([np.random.default_rng(0).uniform(low, high, 300), made.support])
    for y, found in zip(x, made.cdf(x), strict=True):
        if np.isfinite(y):
            assert abs(mpmath.mpf(found) - exact(float(y))) <= noise.CDF_ERROR


@pytest.mark.parametrize("name", CASES)
def test_samples_have_the_distribution(name):
    made, _ = CASES[name]
    x = np.sort(np.asarray(jax.jit(made.sample, static_argnums=1)(jax.random.key(1), (20_000,))))
    assert x.shape == (20_000,) and (x >= made.support[0] - 1e-6).all()
    assert (x <= made.support[1] + 1e-6).all()
    distance = np.abs(made.cdf(x) - (np.arange(len(x)) + 0.5) / len(x)).max()
    assert distance < 2.2 / np.sqrt(len(x))  # Kolmogorov: exceeded with probability 1e-4


def intervals(made, count, seed):
    """Random intervals, shifts and gains; ends are infinite or on the support's edge at times."""
    draw = np.random.default_rng(seed)
    a = draw.normal(size=count) * draw.choice([0.3, 1, 3], count)
    b = a + draw.exponential(size=count) * draw.choice([1e-3, 0.5, 2], count)
    low = draw.normal(size=count)
    high = low + draw.exponential(size=count) * draw.choice([0, 0.1, 1], count)
    scale = draw.choice([0.01, 0.5, 1.0, 2.0], count)
    kind = draw.integers(0, 8, count)
    a = np.where(kind == 0, -np.inf, a)
    b = np.where(kind == 1, np.inf, b)
    for end, edge in ((2, 0), (3, 1)):
        if np.isfinite(made.support[edge]):  # the image's support meets an end of the interval
            a = np.where(kind == end, low + scale * made.support[edge], a)
            b = np.where(kind == end, a + 0.5, b)
    return a, b, low, high, scale


def exact_probability(exact, support, a, b, m, s):
    def at(x):
        if np.isinf(x):
            return mpmath.mpf(0 if x < 0 else 1)
        z = (mpmath.mpf(x) - mpmath.mpf(m)) / mpmath.mpf(s)
        if np.isfinite(support[0]) and z <= mpmath.mpf(support[0]):
            return mpmath.mpf(0)
        if np.isfinite(support[1]) and z >= mpmath.mpf(support[1]):
            return mpmath.mpf(1)
        return exact(z)

    return at(b) - at(a)


@pytest.mark.parametrize("name", CASES)
def test_probability_bounds_hold_in_extended_precision(name):
    made, exact = CASES[name]
    given = intervals(made, 120, 2)
    lower, upper = made.probability_bounds(*given)
    for a, b, low, high, scale, least, most in zip(*given, lower, upper, strict=True):
        middle = 0.5 * (a + b) - scale * made.mean
        shifts = [low, high, *np.linspace(low, high, 4), np.clip(middle, low, high)]
        for m in (x for x in shifts if np.isfinite(x)):
            p = exact_probability(exact, made.support, a, b, float(m), scale)
            assert mpmath.mpf(least) <= p <= mpmath.mpf(most)


@pytest.mark.few(4)
@pytest.mark.parametrize("name", CASES)
def test_probability_bounds_hold_and_are_attained_on_dense_grids_of_shifts(name):
    made, _ = CASES[name]
    a, b, low, high, scale = intervals(made, 500, 3)
    lower, upper = made.probability_bounds(a, b, low, high, scale)
    shifts = np.linspace(low, high, 2001)
    p = made.cdf((b - shifts) / scale) - made.cdf((a - shifts) / scale)
    slack = 2e-12
    assert (lower <= p.min(axis=0) + slack).all() and (p.max(axis=0) <= upper + slack).all()
    if made.kind != "cdf":
        np.testing.assert_allclose(lower, p.min(axis=0), atol=2e-10)
    if made.symmetric:  # the grid of shifts misses the maximum by half a step
        step = (high - low) / 2000 / scale
        assert (upper - p.max(axis=0) <= 2 * step / made.scale + 1e-10).all()
    still = low == high
    np.testing.assert_allclose(upper[still], p[0, still], atol=2e-12)


def test_bounded_noise_inside_an_interval_has_probability_one():
    for made in (noise.uniform(-1, 1), noise.triangular(), noise.truncated_gaussian(1, -1, 1)):
        lower, upper = made.probability_bounds([-1.0, 1.2], [1.0, 2.0], -0.1, 0.1, 0.5)
        assert lower.tolist() == [1.0, 0.0] and upper.tolist() == [1.0, 0.0]


def test_tails_of_gaussians_keep_a_relative_error():
    lower, upper = noise.gaussian(1.0).probability_bounds([-31.0, 30.0], [-30.0, 31.0], 0.0, 0.0)
    exact = float(normal(-30) - normal(-31))
    np.testing.assert_allclose([lower, upper], exact, rtol=1e-10)
    assert (lower <= exact).all() and (exact <= upper).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: noise.uniform(1, 1), "low < high"),
        (lambda: noise.uniform(0, np.inf), "finite"),
        (lambda: noise.gaussian(0), "scale=0; it must be positive"),
        (lambda: noise.gaussian(1, np.nan), "mean=nan"),
        (lambda: noise.truncated_gaussian(1, 5, 6), "probability"),
        (lambda: noise.from_cdf(lambda x: 1 - x, 0, 1), "cdf decreases"),
        (lambda: noise.from_cdf(lambda x: 0.5 * x, 0, 1), "near 1; give the support"),
        (lambda: noise.from_cdf(lambda x: jnp.sqrt(x - 2), 0, 1), "not a number"),
        (lambda: noise.from_cdf(3, 0, 1), "give a function"),
    ],
)
def test_bad_distributions_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
