"""Natural exponential families for the cross-entropy method.

A family is a frozen dataclass of ordinary parameters (such as mean and standard deviation) with
density ``f_v(x) = exp(v . Gamma(x) - K(v))`` (dissertation, definition 2) and *mean parameter*
``m(v) = E_v[Gamma(x)] = grad K(v)``. The functions dispatch on the type
(``functools.singledispatch``): a new family registers ``sufficient_statistics``,
``mean_parameter``, ``from_mean_parameter``, ``log_density``, ``sample``, ``project``, ``center`` and
``standard_deviation``; options of the method need ``sample_antithetic``, ``widen``, ``at_least``.

``project`` moves the mean parameter without forming it. As ``E x^2 - (E x)^2`` the variance of a
Gaussian with mean 3 and standard deviation 1e-3 is negative in single precision; here every
variance is a sum of squares.

>>> import jax, jax.numpy as jnp
>>> from jaxltl.algos.cce import exponential_family as families
>>> start = families.diagonal_gaussian(jnp.zeros(2), 1.0)
>>> def moved(key):  # halfway to eight of its samples
...     samples = families.sample(start, key, 8)
...     family = families.project(start, samples, jnp.ones(8), rate=0.5)
...     return family, families.log_density(family, samples)
>>> family, density = jax.eval_shape(moved, jax.random.key(0))
>>> family.mean.shape, density.shape
((2,), (8,))
>>> families.standard_deviation(families.widen(start, 3.0)).tolist()
[2.0, 2.0]
>>> families.at_least(start, 4.0).variance.tolist()
[4.0, 4.0]
>>> first, second = families.mean_parameter(start)  # E x and E x^2
>>> second.tolist(), families.center(start).tolist()
([1.0, 1.0], [0.0, 0.0])
>>> shapes = jax.eval_shape(lambda key: families.sufficient_statistics(
...     start, families.sample_antithetic(start, key, 8)), jax.random.key(0))
>>> shapes[1].shape  # of mirrored pairs
(8, 2)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import singledispatch

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import digamma, gammaln
from numpy.typing import ArrayLike

from jaxltl.algos.common import splitmix
from jaxltl.core import struct
from jaxltl.core.models.protocols import Array, Key, PyTree
from jaxltl.core.types import require_shape


@struct.dataclass
class DiagonalGaussian:
    """Independent normal entries, `mean` and `variance` ``float[D]``; ``Gamma(x) = (x, x^2)``."""

    mean: jax.Array
    variance: jax.Array


@struct.dataclass
class FullGaussian:
    """Normal vectors with any covariance; ``Gamma(x) = (x, x x')``.

    `mean` is ``float[D]``, and `factor` ``float[D, D]`` lower triangular with covariance
    ``factor @ factor.T``, which rounding cannot make indefinite.
    """

    mean: jax.Array
    factor: jax.Array


@struct.dataclass
class Gamma:
    """Independent gamma entries, mean `shape` / `rate`, ``float[D]``; ``Gamma(x) = (x, log x)``."""

    shape: jax.Array
    rate: jax.Array


def diagonal_gaussian(mean: Array, std: Array | float) -> DiagonalGaussian:
    """A :class:`DiagonalGaussian` of a `mean` ``float[D]`` and positive `std`, ``float[D]`` or a number.

    Raises:
      ValueError: `mean` is not a vector, `std` does not fit it, or is not positive.

    >>> diagonal_gaussian([0.0, 1.0], 0.5).variance.tolist()
    [0.25, 0.25]
    """
    mean = _vector("mean", mean)
    std = _like("std", std, mean)
    _require_positive("std", std)
    return DiagonalGaussian(mean, jnp.square(std))


def full_gaussian(mean: Array, covariance: Array) -> FullGaussian:
    """A :class:`FullGaussian` of a `mean` ``float[D]`` and positive definite `covariance`.

    Raises:
      ValueError: a wrong shape, or a covariance that is not symmetric and positive definite.

    >>> full_gaussian([0.0, 0.0], [[4.0, 2.0], [2.0, 2.0]]).factor.tolist()
    [[2.0, 0.0], [1.0, 1.0]]
    """
    mean = _vector("mean", mean)
    covariance = jnp.asarray(covariance, mean.dtype)
    require_shape("covariance", covariance, 2 * mean.shape)
    if not isinstance(covariance, jax.core.Tracer):
        symmetric = bool(jnp.allclose(covariance, covariance.T))
        if not symmetric or not bool(jnp.isfinite(jnp.linalg.cholesky(covariance)).all()):
            raise ValueError("covariance is not symmetric and positive definite.")
    return FullGaussian(mean, jnp.linalg.cholesky(covariance))


def gamma(shape: Array, rate: Array | float) -> Gamma:
    """A :class:`Gamma` of positive `shape` ``float[D]`` and `rate`, ``float[D]`` or a number.

    Raises:
      ValueError: a wrong shape, or a number that is not positive.

    >>> center(gamma([2.0, 3.0], 2.0)).tolist()
    [1.0, 1.5]
    """
    shape = _vector("shape", shape)
    rate = _like("rate", rate, shape)
    _require_positive("shape", shape)
    _require_positive("rate", rate)
    return Gamma(shape, rate)


def _vector(name: str, x: ArrayLike) -> jax.Array:
    x = jnp.asarray(x)
    x = x.astype(jnp.promote_types(x.dtype, jnp.float32))
    if x.ndim != 1:
        raise ValueError(f"{name} has shape {x.shape}; expected one axis, [D].")
    return x


def _like(name: str, x: ArrayLike, model: jax.Array) -> jax.Array:
    x = jnp.asarray(x, model.dtype)
    if x.shape not in ((), model.shape):
        raise ValueError(f"{name} has shape {x.shape}; expected () or {model.shape}.")
    return jnp.broadcast_to(x, model.shape)


def _require_positive(name: str, x: jax.Array) -> None:
    if isinstance(x, jax.core.Tracer):
        return
    numbers = np.asarray(x)
    wrong = np.flatnonzero(~((numbers > 0) & np.isfinite(numbers)))
    if wrong.size:
        raise ValueError(
            f"{name}[{wrong[0]}] = {float(numbers[wrong[0]])!r}; it must be positive and finite."
        )


# --- the protocol ---------------------------------------------------------------------------


@singledispatch
def sufficient_statistics(family: PyTree, samples: jax.Array) -> tuple[jax.Array, jax.Array]:
    """``Gamma(x)`` of samples ``float[..., D]`` of a `family`, a pair of arrays.

    The second is ``float[..., D, D]`` for a full Gaussian, else ``float[..., D]``. Here and below a type
    that is not registered raises TypeError; differentiable in `samples`.
    """
    raise TypeError(_unknown(family))


@singledispatch
def mean_parameter(family: PyTree) -> tuple[jax.Array, jax.Array]:
    """``m(v) = E_v[Gamma(x)]`` of a `family`, a pair of arrays; differentiable in its parameters."""
    raise TypeError(_unknown(family))


@singledispatch
def from_mean_parameter(family: PyTree, eta: tuple[jax.Array, jax.Array]) -> PyTree:
    """The member of the type of `family` with mean parameter `eta`, ``m^{-1}(eta)``.

    Variances are differences here; :func:`project` moves a family without cancellation.

    >>> start = diagonal_gaussian([1.0, 2.0], 0.5)
    >>> from_mean_parameter(start, mean_parameter(start)).variance.tolist()
    [0.25, 0.25]
    """
    raise TypeError(_unknown(family))


@singledispatch
def log_density(family: PyTree, samples: jax.Array) -> jax.Array:
    """``log f_v(x)`` in nats, ``float[...]`` of `samples` ``float[..., D]``; differentiable in both.

    Here v is the natural parameter of `family`.
    """
    raise TypeError(_unknown(family))


@singledispatch
def sample(family: PyTree, key: Key, num_samples: int) -> jax.Array:
    """``float[num_samples, D]``, independent samples of a `family` by a `key`; `num_samples` is static."""
    raise TypeError(_unknown(family))


@singledispatch
def sample_antithetic(family: PyTree, key: Key, num_samples: int) -> jax.Array:
    """``float[num_samples, D]``: samples 2 i and 2 i + 1 of `family` by `key` are mirrored at the mean.

    Raises:
      ValueError: the family is not symmetric.
    """
    raise ValueError(f"a {type(family).__name__} has no mirrored samples; set antithetic=False.")


@singledispatch
def project(
    family: PyTree, samples: jax.Array, weights: jax.Array, rate: jax.Array | float
) -> PyTree:
    """The family with its mean parameter moved to that of weighted samples (dissertation, (4.11)).

    ``m(v') = rate * sum_i w_i Gamma(x_i) / sum_i w_i + (1 - rate) * m(v)`` gives the member closest in
    cross entropy to the mixture of the weighted samples ``float[n, D]`` and ``f_v``. Variances are sums
    of squares. Weights have a positive sum; at rate 0 the family is unchanged, bit for bit except for a
    full Gaussian.

    >>> start = diagonal_gaussian([0.0], 1.0)
    >>> moved = project(start, jnp.array([[1.0], [3.0]]), jnp.array([1.0, 1.0]), 0.5)
    >>> moved.mean.tolist(), moved.variance.tolist()
    ([1.0], [2.0])
    """
    raise TypeError(_unknown(family))


@singledispatch
def center(family: PyTree) -> jax.Array:
    """``E_v[x]``, ``float[D]``, of a `family`."""
    raise TypeError(_unknown(family))


@singledispatch
def standard_deviation(family: PyTree) -> jax.Array:
    """``float[D]``, standard deviations of the entries under a `family`."""
    raise TypeError(_unknown(family))


@singledispatch
def widen(family: PyTree, variance: jax.Array | float) -> PyTree:
    """A `family` with the same mean and a `variance` (a number or ``float[D]``) added to that of entries."""
    raise TypeError(_unknown(family))


@singledispatch
def at_least(family: PyTree, variance: jax.Array | float) -> PyTree:
    """A `family` with the same mean and at least a `variance` in every direction."""
    raise TypeError(_unknown(family))


def _unknown(family: PyTree) -> str:
    return (
        f"{type(family).__name__} is not a family: pass a DiagonalGaussian, a FullGaussian "
        "or a Gamma."
    )


def _normal(key: Key, num_samples: int, like: jax.Array) -> jax.Array:
    """Standard normal numbers ``float[num_samples, D]``.

    Only D streams are drawn from the key: one keyed hash for each number would cost more than the
    evaluation of small policies.
    """
    stream = splitmix.streams(key, (*like.shape, 1))
    word = splitmix.words(stream, jnp.arange(num_samples, dtype=jnp.uint32))
    # The middles of equal intervals of (-1, 1), as many as are exact.
    num_bits = 32 if jnp.finfo(like.dtype).nmant >= 32 else jnp.finfo(like.dtype).nmant
    middle = (word >> (32 - num_bits)).astype(like.dtype) + 0.5
    noise = math.sqrt(2) * lax.erf_inv(middle * 2.0 ** (1 - num_bits) - 1)
    return noise.T  # computed with the samples last, the longer axis where policies are small


def _mirrored(family: PyTree, key: Key, num_samples: int) -> jax.Array:
    half = sample(family, key, -(-num_samples // 2))
    pairs = jnp.stack([half, 2 * center(family) - half], axis=1)
    return pairs.reshape(-1, half.shape[-1])[:num_samples]


def _register(kind: type, methods: dict[Callable[..., PyTree], Callable[..., PyTree]]) -> None:
    """Registers the methods of a family with the generic functions."""
    for function, method in methods.items():
        function.register(kind, method)  # type: ignore[attr-defined]


def _shares(weights: jax.Array) -> jax.Array:
    return weights / jnp.sum(weights)


# --- diagonal Gaussians ---------------------------------------------------------------------


@log_density.register
def _(family: DiagonalGaussian, samples: jax.Array) -> jax.Array:
    square = jnp.square(samples - family.mean) / family.variance
    return -0.5 * jnp.sum(square + jnp.log(2 * math.pi * family.variance), axis=-1)


@project.register
def _(
    family: DiagonalGaussian, samples: jax.Array, weights: jax.Array, rate: jax.Array | float
) -> DiagonalGaussian:
    weights = _shares(weights)
    offset = samples - family.mean
    shift = weights @ offset
    own = weights @ jnp.square(offset - shift)
    # The variance of a mixture: the mean of the variances and the variance of the means.
    variance = rate * own + (1 - rate) * family.variance + rate * (1 - rate) * jnp.square(shift)
    return DiagonalGaussian(family.mean + rate * shift, variance)


_register(
    DiagonalGaussian,
    {
        sufficient_statistics: lambda f, samples: (samples, jnp.square(samples)),
        mean_parameter: lambda f: (f.mean, jnp.square(f.mean) + f.variance),
        from_mean_parameter: lambda f, eta: DiagonalGaussian(eta[0], eta[1] - jnp.square(eta[0])),
        sample: lambda f, key, num: f.mean + jnp.sqrt(f.variance) * _normal(key, num, f.mean),
        sample_antithetic: _mirrored,
        center: lambda f: f.mean,
        standard_deviation: lambda f: jnp.sqrt(f.variance),
        widen: lambda f, variance: replace(f, variance=f.variance + variance),
        at_least: lambda f, variance: replace(f, variance=jnp.maximum(f.variance, variance)),
    },
)


# --- full Gaussians -------------------------------------------------------------------------


@log_density.register
def _(family: FullGaussian, samples: jax.Array) -> jax.Array:
    offset = samples - family.mean
    solve = jax.scipy.linalg.solve_triangular
    white = solve(family.factor, offset.reshape(-1, offset.shape[-1]).T, lower=True)
    square = jnp.sum(jnp.square(white), axis=0).reshape(offset.shape[:-1])
    volume = jnp.sum(jnp.log(jnp.abs(jnp.diagonal(family.factor))))
    return -0.5 * (square + offset.shape[-1] * math.log(2 * math.pi)) - volume


@project.register
def _(
    family: FullGaussian, samples: jax.Array, weights: jax.Array, rate: jax.Array | float
) -> FullGaussian:
    weights = _shares(weights)
    rate = jnp.asarray(rate, family.mean.dtype)
    offset = samples - family.mean
    shift = weights @ offset
    rows = [
        jnp.sqrt(rate * weights)[:, None] * (offset - shift),
        jnp.sqrt(1 - rate) * family.factor.T,
        (jnp.sqrt(rate * (1 - rate)) * shift)[None],
    ]
    return FullGaussian(family.mean + rate * shift, _factor(jnp.concatenate(rows)))


def _factor(rows: jax.Array) -> jax.Array:
    """The lower factor of ``rows.T @ rows`` with a nonnegative diagonal."""
    upper = jnp.linalg.qr(rows, mode="r")
    return (jnp.where(jnp.diagonal(upper) < 0, -1, 1)[:, None] * upper).T


_register(
    FullGaussian,
    {
        sufficient_statistics: lambda f, x: (x, x[..., :, None] * x[..., None, :]),
        mean_parameter: lambda f: (f.mean, jnp.outer(f.mean, f.mean) + f.factor @ f.factor.T),
        from_mean_parameter: lambda f, eta: FullGaussian(
            eta[0], jnp.linalg.cholesky(eta[1] - jnp.outer(eta[0], eta[0]))
        ),
        sample: lambda f, key, num: f.mean + _normal(key, num, f.mean) @ f.factor.T,
        sample_antithetic: _mirrored,
        center: lambda f: f.mean,
        standard_deviation: lambda f: jnp.sqrt(jnp.sum(jnp.square(f.factor), axis=-1)),
    },
)


@widen.register
def _(family: FullGaussian, variance: jax.Array | float) -> FullGaussian:
    more = jnp.broadcast_to(jnp.sqrt(jnp.asarray(variance, family.mean.dtype)), family.mean.shape)
    return replace(family, factor=_factor(jnp.concatenate([family.factor.T, jnp.diag(more)])))


@at_least.register
def _(family: FullGaussian, variance: jax.Array | float) -> FullGaussian:
    _, length, axes = jnp.linalg.svd(family.factor.T, full_matrices=False)
    length = jnp.maximum(length, jnp.sqrt(jnp.asarray(variance, length.dtype)))
    return replace(family, factor=_factor(length[:, None] * axes))


# --- gamma distributions --------------------------------------------------------------------


def _convex_part(z: jax.Array) -> jax.Array:
    """``z - log(1 + z)``, accurate near zero, for z > -1."""
    small = jnp.abs(z) < 0.05
    safe = jnp.where(small, z, 0)
    series = jnp.zeros_like(z)
    for n in range(13, 1, -1):
        series = (-1) ** n / n + safe * series
    least = -1 + jnp.finfo(z.dtype).epsneg
    return jnp.where(small, safe * safe * series, z - jnp.log1p(jnp.maximum(z, least)))


# Coefficients of 1/k^2, 1/k^4, ... in the asymptotic series of log k - digamma(k) - 1/(2k).
_SERIES = (1 / 12, -1 / 120, 1 / 252, -1 / 240, 1 / 132, -691 / 32760, 1 / 12)


def _log_digamma_gap(shape: jax.Array) -> jax.Array:
    """``log k - digamma(k)``, positive and decreasing, without cancellation."""
    bound = 4.0 if jnp.finfo(shape.dtype).bits < 64 else 10.0  # the series is exact above
    large = shape > bound
    inverse = 1 / jnp.where(large, shape, bound)
    square = jnp.square(inverse)
    series = jnp.zeros_like(shape)
    for c in reversed(_SERIES):
        series = square * (c + series)
    small = jnp.where(large, bound, shape)
    return jnp.where(large, inverse / 2 + series, jnp.log(small) - digamma(small))


def _shape_of_gap(gap: jax.Array) -> jax.Array:
    """The shape k with ``log k - digamma(k) = gap``, by Newton's method on logarithms.

    ``log gap`` is nearly linear in ``log k``, of slope -1 at both ends, so that a few steps
    from Minka's (2002) approximation suffice everywhere.
    """
    gap = jnp.maximum(gap, jnp.finfo(gap.dtype).tiny * 16)
    start = (3 - gap + jnp.sqrt(jnp.square(gap - 3) + 24 * gap)) / (12 * gap)

    def newton(_: object, log_shape: jax.Array) -> jax.Array:
        def log_gap(x: jax.Array) -> jax.Array:
            return jnp.log(_log_digamma_gap(jnp.exp(x)))

        value, slope = jax.jvp(log_gap, (log_shape,), (jnp.ones_like(log_shape),))
        return log_shape - (value - jnp.log(gap)) / slope

    return jnp.exp(lax.fori_loop(0, 5, newton, jnp.log(start)))


@from_mean_parameter.register
def _(family: Gamma, eta: tuple[jax.Array, jax.Array]) -> Gamma:
    shape = _shape_of_gap(jnp.log(eta[0]) - eta[1])
    return Gamma(shape, shape / eta[0])


@log_density.register
def _(family: Gamma, samples: jax.Array) -> jax.Array:
    shape, rate = family.shape, family.rate
    terms = shape * jnp.log(rate) - gammaln(shape) + (shape - 1) * jnp.log(samples)
    return jnp.sum(terms - rate * samples, axis=-1)


@sample.register
def _(family: Gamma, key: Key, num_samples: int) -> jax.Array:
    dtype = family.shape.dtype
    draws = jax.random.gamma(key, family.shape, (num_samples, *family.shape.shape), dtype)
    # Tiny shapes draw numbers that round to zero; their logarithm is not finite.
    return jnp.maximum(draws / family.rate, jnp.finfo(dtype).tiny)


@project.register
def _(family: Gamma, samples: jax.Array, weights: jax.Array, rate: jax.Array | float) -> Gamma:
    weights = _shares(weights)
    old = family.shape / family.rate
    mean = old + rate * (weights @ (samples - old))
    # log E x - E log x of the mixture. The linear terms, which sum to zero, are taken out of
    # the logarithms, so that only numbers that are not negative are added.
    own = weights @ _convex_part((samples - mean) / mean)
    rest = _log_digamma_gap(family.shape) + _convex_part((old - mean) / mean)
    shape = _shape_of_gap(rate * own + (1 - rate) * rest)
    shape = jnp.where(rate > 0, shape, family.shape)
    return Gamma(shape, jnp.where(rate > 0, shape / mean, family.rate))


def _with_variance(family: Gamma, variance: jax.Array) -> Gamma:
    mean = center(family)
    return Gamma(jnp.square(mean) / variance, mean / variance)


_register(
    Gamma,
    {
        sufficient_statistics: lambda f, samples: (samples, jnp.log(samples)),
        mean_parameter: lambda f: (f.shape / f.rate, digamma(f.shape) - jnp.log(f.rate)),
        center: lambda f: f.shape / f.rate,
        standard_deviation: lambda f: jnp.sqrt(f.shape) / f.rate,
        widen: lambda f, variance: _with_variance(f, jnp.square(standard_deviation(f)) + variance),
    },
)


@at_least.register
def _(family: Gamma, variance: jax.Array | float) -> Gamma:
    own = jnp.square(standard_deviation(family))
    wider = _with_variance(family, jnp.maximum(own, variance))
    return jax.tree.map(lambda x, y: jnp.where(own < variance, x, y), wider, family)
