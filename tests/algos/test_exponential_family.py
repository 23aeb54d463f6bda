"""Exponential families against SciPy's densities, and projections against a generic optimiser."""

from __future__ import annotations

import itertools
from fractions import Fraction
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize, stats

from jaxltl.algos.cce import exponential_family as ef

# Each compiled as a whole, which takes much less long than operation by operation.
whole = SimpleNamespace(
    **{
        name: jax.jit(getattr(ef, name))
        for name in (
            "log_density",
            "mean_parameter",
            "from_mean_parameter",
            "sufficient_statistics",
            "project",
            "center",
            "standard_deviation",
        )
    },
    **{
        name: jax.jit(getattr(ef, f"_{name}"))
        for name in ("log_digamma_gap", "shape_of_gap", "convex_part")
    },
    **{
        name: jax.jit(getattr(ef, name), static_argnums=2)
        for name in ("sample", "sample_antithetic")
    },
)
COVARIANCE = np.array([[1.0, 0.3], [0.3, 0.5]])
MEMBERS = {
    "diagonal": lambda: ef.diagonal_gaussian([0.5, -2.0], [1.5, 0.3]),
    "full": lambda: ef.full_gaussian([0.5, -2.0], COVARIANCE),
    "gamma": lambda: ef.gamma([0.7, 12.0], [2.0, 0.5]),
}
by_family = pytest.mark.parametrize("name", MEMBERS)


def scipy_log_density(name, vector, x):
    """The density of free numbers, which an optimiser may move anywhere."""
    if name == "diagonal":
        return stats.norm(vector[:2], np.exp(vector[2:])).logpdf(x).sum(-1)
    if name == "gamma":
        return stats.gamma(np.exp(vector[:2]), scale=np.exp(-vector[2:])).logpdf(x).sum(-1)
    lower = np.array([[np.exp(vector[2]), 0.0], [vector[3], np.exp(vector[4])]])
    return stats.multivariate_normal(vector[:2], lower @ lower.T).logpdf(x)


def free_numbers(name, family):
    if name == "diagonal":
        return np.concatenate([family.mean, np.log(family.variance) / 2])
    if name == "gamma":
        return np.log(np.concatenate([family.shape, family.rate]))
    f = np.asarray(family.factor)
    return np.concatenate([family.mean, [np.log(f[0, 0]), f[1, 0], np.log(f[1, 1])]])


def quadrature(name, family):
    """Points and weights that stand for a distribution of two entries."""
    if name == "gamma":
        t = np.linspace(-60.0, 8.0, 1500)
        grids = []
        for k, r in zip(np.asarray(family.shape), np.asarray(family.rate), strict=True):
            weight = stats.gamma(k, scale=1 / r).pdf(np.exp(t)) * np.exp(t)
            grids.append(weight / weight.sum())
        return np.exp(t), grids
    node, weight = np.polynomial.hermite_e.hermegauss(4)
    pairs = np.array(list(itertools.product(node, node)))
    weight = np.outer(weight, weight).ravel() / weight.sum() ** 2
    factor = np.diag(np.sqrt(family.variance)) if name == "diagonal" else np.asarray(family.factor)
    return np.asarray(family.mean) + pairs @ factor.T, weight


def mean_log_density(name, vector, family):
    """Of the density of `vector`, under `family`."""
    points, weight = quadrature(name, family)
    if name != "gamma":
        return weight @ scipy_log_density(name, vector, points)
    entries = stats.gamma(np.exp(vector[:2]), scale=np.exp(-vector[2:]))
    terms = entries.logpdf(points[:, None])
    return sum(weight[d] @ terms[:, d] for d in range(2))


@by_family
def test_log_densities_are_scipys(name):
    family = MEMBERS[name]()
    samples = np.abs(np.random.default_rng(0).normal(size=(3, 4, 2)))
    expected = scipy_log_density(name, free_numbers(name, family), samples)
    np.testing.assert_allclose(whole.log_density(family, samples), expected, rtol=1e-10)


@pytest.mark.few(2)
@by_family
def test_the_mean_map_is_the_mean_of_the_statistics_and_has_its_inverse(name):
    family = MEMBERS[name]()
    eta = whole.mean_parameter(family)
    samples = whole.sample(family, jax.random.key(0), 40_000)
    for expected, drawn in zip(eta, whole.sufficient_statistics(family, samples), strict=True):
        error = drawn.std(axis=0) / np.sqrt(len(samples))
        assert (np.abs(drawn.mean(axis=0) - expected) < 4.5 * error).all()
    back = whole.from_mean_parameter(family, eta)
    for x, y in zip(jax.tree.leaves(back), jax.tree.leaves(family), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9)
    np.testing.assert_allclose(whole.center(family), samples.mean(0), atol=0.15)
    np.testing.assert_allclose(whole.standard_deviation(family), samples.std(0), rtol=0.04)


@by_family
@pytest.mark.parametrize("rate", [1.0, 0.3])
def test_projections_maximise_the_likelihood(name, rate):
    """(4.6), with the mixture's old part integrated numerically."""
    rng = np.random.default_rng(1)
    family = MEMBERS[name]()
    samples = np.abs(rng.normal(size=(7, 2))) + 0.1
    weights = rng.dirichlet(np.ones(7))

    def loss(vector):
        own = weights @ scipy_log_density(name, vector, samples)
        return -rate * own - (1 - rate) * (rate < 1 and mean_log_density(name, vector, family))

    found = optimize.minimize(
        loss, free_numbers(name, family), method="BFGS", options={"gtol": 1e-7}
    )
    moved = whole.project(family, jnp.asarray(samples), jnp.asarray(5 * weights), rate)
    np.testing.assert_allclose(free_numbers(name, moved), found.x, rtol=1e-4, atol=2e-5)


@by_family
def test_projections_move_the_mean_parameter(name):
    """(4.11), to rounding."""
    rng = np.random.default_rng(2)
    family, rate = MEMBERS[name](), 0.37
    samples, weights = rng.gamma(2.0, size=(9, 2)), rng.random(9)
    moved = whole.mean_parameter(
        whole.project(family, jnp.asarray(samples), jnp.asarray(weights), rate)
    )
    parts = zip(
        moved,
        whole.sufficient_statistics(family, samples),
        whole.mean_parameter(family),
        strict=True,
    )
    for new, gathered, old in parts:
        target = np.tensordot(weights / weights.sum(), gathered, 1)
        np.testing.assert_allclose(new, rate * target + (1 - rate) * old, rtol=1e-11)


@by_family
def test_a_rate_of_zero_changes_nothing(name):
    family = MEMBERS[name]()
    same = whole.project(family, jnp.ones((3, 2)), jnp.ones(3), jnp.zeros(()))
    for x, y in zip(jax.tree.leaves(same), jax.tree.leaves(family), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-15, atol=1e-16)


def test_single_precision_keeps_small_variances():
    """Mean 3 and standard deviation 1e-3, where E x^2 - (E x)^2 is negative."""
    noise = np.random.default_rng(0).normal(size=(50, 1))
    samples = (3 + 1e-3 * noise).astype(np.float32)
    naive = np.mean(samples**2, dtype=np.float32) - np.mean(samples, dtype=np.float32) ** 2
    rate, own = 0.5, np.float64(samples)
    offset = own.mean() - 3
    expected = rate * own.var() + (1 - rate) * 1e-6 + rate * (1 - rate) * offset**2
    assert abs(naive / own.var() - 1) > 0.3, "the case is one in which the printed form fails"
    for start in (
        ef.diagonal_gaussian(jnp.full(1, 3, jnp.float32), 1e-3),
        ef.full_gaussian(jnp.full(1, 3, jnp.float32), np.full((1, 1), 1e-6)),
    ):
        moved = whole.project(start, jnp.asarray(samples), jnp.ones(50, jnp.float32), rate)
        assert moved.mean.dtype == jnp.float32
        np.testing.assert_allclose(whole.standard_deviation(moved) ** 2, expected, rtol=1e-4)


def test_single_precision_keeps_concentrated_gammas():
    """Shape 9e6: mean 3 and standard deviation 1e-3."""
    noise = np.random.default_rng(0).normal(size=(50, 1))
    samples = (3 + 1e-3 * noise).astype(np.float32)
    start = ef.gamma(jnp.full(1, 9e6, jnp.float32), 3e6)
    moved = whole.project(start, jnp.asarray(samples), jnp.ones(50, jnp.float32), 1.0)
    np.testing.assert_allclose(
        whole.standard_deviation(moved), np.float64(samples).std(), rtol=1e-3
    )


@pytest.mark.slow
def test_many_single_precision_steps_stay_positive():
    @jax.jit
    def run(family):
        def step(i, f):
            samples = whole.sample(f, jax.random.fold_in(jax.random.key(0), i), 5)
            return whole.project(f, samples, jnp.ones(5, jnp.float32), 0.5)

        return jax.lax.fori_loop(0, 60, step, family)

    mean = jnp.asarray([3.0, 1000.0, 1e-3], jnp.float32)
    for start in (
        ef.diagonal_gaussian(mean, 1.0),
        ef.full_gaussian(mean, np.eye(3)),
        ef.gamma(mean, 1.0),
    ):
        deviation = whole.standard_deviation(run(start))
        assert (deviation >= 0).all()
        assert (deviation < 0.2 * whole.standard_deviation(start)).all(), "it narrows"


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_the_gammas_shape_is_found_everywhere(dtype):
    shape = jnp.logspace(-3, 9, 49, dtype=dtype)
    spread = whole.log_digamma_gap(shape)
    assert (spread > 0).all()
    tolerance = 40 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(whole.shape_of_gap(spread), shape, rtol=tolerance)
    for k in (10**3, 10**6):
        exact = Fraction(1, 2 * k) + Fraction(1, 12 * k**2) - Fraction(1, 120 * k**4)
        np.testing.assert_allclose(
            whole.log_digamma_gap(jnp.asarray(float(k), dtype)), float(exact), rtol=tolerance
        )
    np.testing.assert_allclose(
        whole.log_digamma_gap(jnp.asarray(1.0, dtype)), np.euler_gamma, rtol=tolerance
    )


def test_the_convex_part_of_the_logarithm():
    for z in (1e-8, -3e-5, 0.049, -0.049, 0.051):
        x = Fraction(z)
        exact = sum(Fraction((-1) ** n, n) * x**n for n in range(2, 40))
        np.testing.assert_allclose(whole.convex_part(jnp.asarray(z)), float(exact), rtol=1e-13)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_normal_draws_are_normal_and_independent(dtype):
    family = ef.diagonal_gaussian(jnp.zeros(40, dtype), 1.0)
    z = np.asarray(whole.sample(family, jax.random.key(1), 4000), float)
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    for moment, expected, variance in ((1, 0, 1), (2, 1, 2), (3, 0, 15), (4, 3, 96)):
        assert abs((z**moment).mean() - expected) < 4 * np.sqrt(variance / z.size)
    between = np.corrcoef(z.T)[np.triu_indices(40, 1)] * np.sqrt(4000)
    later = np.array([(z[:-lag] * z[lag:]).sum() for lag in (1, 2, 3, 50, 1024)])
    assert np.abs(between).max() < 5
    assert (np.abs(later) < 4 * np.sqrt(z.size)).all()
    other = np.asarray(whole.sample(family, jax.random.key(2), 4000), float)
    assert abs((z * other).sum()) < 4 * np.sqrt(z.size)


def test_a_key_gives_the_same_draws_alone_and_in_a_batch():
    family = MEMBERS["diagonal"]()
    keys = jax.random.split(jax.random.key(0), 3)
    many = jax.jit(jax.vmap(lambda k: whole.sample(family, k, 5)))(keys)
    np.testing.assert_allclose(many[1], whole.sample(family, keys[1], 5), rtol=1e-12)


@pytest.mark.parametrize("name", ["diagonal", "full"])
@pytest.mark.parametrize("num", [6, 7])
def test_antithetic_draws_mirror(name, num):
    family = MEMBERS[name]()
    x = whole.sample_antithetic(family, jax.random.key(0), num)
    assert x.shape == (num, 2)
    pairs = x[: num // 2 * 2].reshape(-1, 2, 2)
    np.testing.assert_allclose(pairs.mean(1), np.tile(family.mean, (num // 2, 1)), atol=1e-12)


def test_antithetic_gammas_are_refused():
    with pytest.raises(ValueError, match="Gamma has no mirrored samples; set antithetic=False"):
        whole.sample_antithetic(MEMBERS["gamma"](), jax.random.key(0), 4)


@by_family
def test_widening_and_floors_keep_the_mean(name):
    family = MEMBERS[name]()
    wide, floor = ef.widen(family, 2.0), ef.at_least(family, 0.6)
    variance = np.asarray(whole.standard_deviation(family)) ** 2
    for other in (wide, floor):
        np.testing.assert_allclose(whole.center(other), whole.center(family), rtol=1e-12)
    np.testing.assert_allclose(whole.standard_deviation(wide) ** 2, variance + 2, rtol=1e-10)
    if name == "full":
        least = np.linalg.eigvalsh(np.asarray(floor.factor @ floor.factor.T))
        np.testing.assert_allclose(
            least, np.maximum(np.linalg.eigvalsh(COVARIANCE), 0.6), rtol=1e-10
        )
    else:
        np.testing.assert_allclose(
            whole.standard_deviation(floor) ** 2, np.maximum(variance, 0.6), rtol=1e-10
        )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ef.diagonal_gaussian([[0.0]], 1.0), r"mean has shape \(1, 1\); expected one axis"),
        (lambda: ef.diagonal_gaussian([0.0, 1.0], [1.0]), r"std has shape \(1,\)"),
        (
            lambda: ef.diagonal_gaussian([0.0, 1.0], [1.0, 0.0]),
            r"std\[1\] = 0\.0; it must be positive",
        ),
        (lambda: ef.full_gaussian([0.0], np.ones((2, 2))), r"covariance has shape \(2, 2\)"),
        (
            lambda: ef.full_gaussian([0.0, 0], np.ones((2, 2))),
            "not symmetric and positive definite",
        ),
        (lambda: ef.gamma([1.0, -1.0], 1.0), r"shape\[1\] = -1\.0"),
        (lambda: ef.gamma([1.0], float("nan")), r"rate\[0\] = nan"),
    ],
)
def test_bad_parameters_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_other_things_are_no_families():
    with pytest.raises(TypeError, match="dict is not a family"):
        ef.center({})
