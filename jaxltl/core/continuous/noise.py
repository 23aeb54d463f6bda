"""Distributions of one coordinate of the noise, with bounds of interval probabilities.

For noise w with distribution function F, gain s > 0 and a shift m, the probability of an interval is
``P(a <= m + s w < b) = F((b - m) / s) - F((a - m) / s)``. Its extrema over an interval of shifts are
the factors of interval transition probabilities. All rounding errors are added outward.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from jaxltl.core import validation
from jaxltl.core.enclosures.linear_bounds import enclose
from jaxltl.core.models.ops.array_namespace import enable_x64
from jaxltl.core.pretty_print import brief

Floats = NDArray[np.float64]
Function = Callable[[jax.Array], jax.Array]

# Largest absolute error of `Distribution.cdf` (tests/core/continuous/test_noise.py, against mpmath):
# functions of bounded slope in a standardised argument with a relative error of a few 2^-53, of a
# few operations, and for truncated Gaussians divided by a mass of at least MIN_MASS.
CDF_ERROR = 2e-14
MIN_MASS = 0.1  # of a truncated Gaussian before truncation
_EPS = float(np.finfo(np.float64).eps)
_TAIL_ERROR = 4e-15  # relative error of a lower tail at a standardised z, per 1 + z^2
_TINY = 1e-300  # covers underflow of tails of infinite support
_BISECTIONS = 60


@brief
@dataclass(frozen=True, eq=False)
class Distribution:
    """Distribution of one coordinate of the noise; see :func:`uniform`, :func:`gaussian`, ...

    Attributes:
      kind: ``"uniform"``, ``"triangular"``, ``"gaussian"``, ``"truncated_gaussian"`` or ``"cdf"``.
      support: ``(low, high)``, possibly infinite.
      mean, scale: of the Gaussian before truncation; the centre and half-width of the others.
      symmetric: True if the density is symmetric about `mean`.
      function: the user's distribution function of ``"cdf"``, else None.

    Example:
      >>> noise = triangular(-1.0, 1.0)
      >>> noise.support, noise.cdf(np.array([-1.0, 0.0, 0.5])).tolist()
      ((-1.0, 1.0), [0.0, 0.5, 0.875])
    """

    kind: str
    support: tuple[float, float]
    mean: float
    scale: float
    symmetric: bool
    function: Function | None = None

    def cdf(self, x: ArrayLike) -> Floats:
        """``float64[...]``: F(x), with an absolute error of at most `CDF_ERROR` (not for ``"cdf"``)."""
        x = np.asarray(x, np.float64)
        if self.function is not None:
            return np.asarray(np.mean(self._user_bounds(x), axis=0))
        return self._distribution(x)

    def sample(self, key: chex.PRNGKey, shape: Sequence[int] = ()) -> jax.Array:
        """``float[shape]``: independent samples; runs inside ``jit`` and ``vmap``."""
        low, high = self.support
        if self.kind == "uniform":
            return jax.random.uniform(key, shape, minval=low, maxval=high)
        if self.kind == "triangular":
            pair = jax.random.uniform(key, (2, *shape))
            return low + (high - low) * pair.mean(axis=0)
        if self.kind == "gaussian":
            return self.mean + self.scale * jax.random.normal(key, shape)
        if self.kind == "truncated_gaussian":
            first, last = (low - self.mean) / self.scale, (high - self.mean) / self.scale
            drawn = jax.random.truncated_normal(key, first, last, shape)
            return jnp.clip(self.mean + self.scale * drawn, low, high)
        return self._inverse(jax.random.uniform(key, shape))

    def probability_bounds(
        self,
        a: ArrayLike,
        b: ArrayLike,
        low: ArrayLike,
        high: ArrayLike,
        scale: ArrayLike = 1.0,
    ) -> tuple[Floats, Floats]:
        """Bounds of ``P(a <= m + scale w < b)`` over all shifts m in [low, high].

        The probability of an interval is unimodal in the shift if the density of w is unimodal (its
        convolution with a uniform density, Ibragimov 1956): its minimum is at an end of [low, high].
        For symmetric densities, the maximum is at the shift nearest to ``(a + b) / 2 - scale mean``.
        Otherwise the bounds are ``F(b - high) - F(a - low)`` below, for a distribution function of
        the user, and ``F(b - low) - F(a - high)`` above. Ends ``a <= b`` may be infinite; gains
        `scale` are positive; all broadcast. 0 and 1 are exact for bounded support.

        Example:
          >>> lower, upper = uniform(0.0, 1.0).probability_bounds(0.0, 1.0, 0.0, 0.25)
          >>> float(lower.round(6)), float(upper.round(6))
          (0.75, 1.0)
        """
        a, b, low, high, scale = (np.asarray(x, np.float64) for x in (a, b, low, high, scale))
        shift = scale * self.mean if self.symmetric else np.zeros(())
        # Rounding of the differences and of the quotient, and of the shift that attains the maximum.
        size = sum(np.where(np.isfinite(x), np.abs(x), 0.0) for x in (a, b, low, high, shift))
        error = 4 * _EPS * size / scale + _TINY

        def between(first: Floats, second: Floats, outward: int) -> Floats:
            start, end = (a - first) / scale, (b - second) / scale
            start = start * (1 - outward * 2 * _EPS * np.sign(start)) - outward * error
            end = end * (1 + outward * 2 * _EPS * np.sign(end)) + outward * error
            return self._mass(start, end, outward)

        if self.kind == "cdf":
            lower = between(low, high, -1)
        else:
            lower = np.minimum(between(low, low, -1), between(high, high, -1))
        best = high, low
        if self.symmetric:
            with np.errstate(invalid="ignore"):  # -inf + inf: every shift has probability 1
                middle = 0.5 * a + 0.5 * b - shift
            best = (np.clip(np.where(np.isnan(middle), low, middle), low, high),) * 2
        upper = between(*best, 1)
        return np.clip(lower, 0, 1), np.clip(upper, 0, 1)

    # --- distribution functions -------------------------------------------------------------------

    def _reflected(self, x: Floats) -> Floats:
        """The reflection of x at the mean."""
        low, high = self.support
        if self.kind in ("uniform", "triangular"):  # exact at the ends of the support
            return np.where(x >= high, low, low + (high - x))
        return np.asarray(self.mean - (x - self.mean))

    def _distribution(self, x: Floats) -> Floats:
        """F(x); of small relative error at or below the mean, except for truncated Gaussians."""
        low, high = self.support
        if self.kind == "gaussian":
            return np.asarray(ndtr((x - self.mean) / self.scale))
        share = np.clip((x - low) / (high - low), 0, 1)
        if self.kind == "uniform":
            return np.asarray(share)
        if self.kind == "triangular":
            rest = np.clip((high - x) / (high - low), 0, 1)
            return np.where(share <= 0.5, 2 * share * share, 1 - 2 * rest * rest)
        flip = -1.0 if low + high > 2 * self.mean else 1.0  # towards the accurate lower tail
        ends, z = (flip * (np.asarray(y) - self.mean) / self.scale for y in ((low, high), x))
        first, last = np.sort(ndtr(ends))
        part = np.clip((ndtr(z) - first) / (last - first), 0, 1)
        part = part if flip > 0 else 1 - part
        return np.where(x <= low, 0.0, np.where(x >= high, 1.0, part))

    def _mass(self, start: Floats, end: Floats, outward: int) -> Floats:
        """Lower (-1) or upper (1) bound of F(end) - F(start), also if start > end."""
        relative = self.symmetric and self.kind != "truncated_gaussian"
        if not relative:
            below, above = self._absolute(start, -outward), self._absolute(end, outward)
            exact = np.isin(below, (0, 1)) & np.isin(above, (0, 1))
            return above - below + np.where(exact, 0.0, outward * _EPS)
        left, right = start < self.mean, end < self.mean
        # Tails of the sides on which the two ends lie; differences of lower or of upper tails.
        first = self._tail(np.where(left, start, self._reflected(start)))
        second = self._tail(np.where(right, end, self._reflected(end)))
        side = (outward + 1) // 2
        missing = first[1 - side] + second[1 - side]
        middle = 1 - missing * (1 - outward * 2 * _EPS)
        middle = np.where(missing > 0, middle + outward * _EPS, middle)
        lower, upper = second[side] - first[1 - side], first[side] - second[1 - side]
        mass = np.where(right, lower, np.where(left, middle, upper))
        return np.where(right & ~left, 0.0, mass)

    def _tail(self, x: Floats) -> tuple[Floats, Floats]:
        """Bounds of F(x) for x at or below the mean: relative error, exact 0 outside the support."""
        tail = self._distribution(x)
        z = np.where(np.isfinite(x), (x - self.mean) / self.scale, 0.0)
        error = tail * _TAIL_ERROR * (1 + np.minimum(np.abs(z), 40.0) ** 2) + _TINY
        outside = x <= self.support[0]
        lower = np.where(outside, 0.0, np.maximum(tail - error, 0.0))
        return lower, np.where(outside, 0.0, tail + error)

    def _absolute(self, x: Floats, outward: int) -> Floats:
        """Bound of F(x) by its absolute error; exact outside the support."""
        if self.function is not None:
            bound = self._user_bounds(x)[(outward + 1) // 2]
        else:
            bound = self.cdf(x) + outward * CDF_ERROR
        low, high = self.support
        bound = np.where(x <= low, 0.0, np.where(x >= high, 1.0, np.clip(bound, 0, 1)))
        return np.asarray(bound)

    def _user_bounds(self, x: Floats) -> tuple[Floats, Floats]:
        """Enclosure of the user's distribution function, evaluated by interval arithmetic."""
        assert self.function is not None
        low, high = self.support
        inside = (x > low) & (x < high)
        some = low if np.isfinite(low) else high - 1.0 if np.isfinite(high) else 0.0
        safe = np.where(inside, x, np.nextafter(some, np.inf)).reshape(-1)
        with enable_x64(True):  # constants of the function in double precision
            sides = enclose(self.function, "interval")(safe, safe)
        unknown = inside & ~np.isfinite(sides[1] - sides[0]).reshape(x.shape)
        if unknown.any():
            raise ValueError(
                f"cdf may be infinite or not a number at {x[unknown][0]:g}; define it on the whole support."
            )
        lower, upper = (np.clip(np.asarray(y, np.float64).reshape(x.shape), 0, 1) for y in sides)
        outside = np.where(x >= high, 1.0, 0.0)
        return np.where(inside, lower, outside), np.where(inside, upper, outside)

    def _inverse(self, level: jax.Array) -> jax.Array:
        """Quantiles by bisection, in a bounded coordinate t of the support."""
        low, high = self.support

        def point(t: jax.Array) -> jax.Array:
            if np.isfinite(low) and np.isfinite(high):
                return low + (high - low) * t
            if np.isfinite(low):
                return low + t / (1 - t)
            if np.isfinite(high):
                return high - (1 - t) / t
            return (2 * t - 1) / (4 * t * (1 - t))

        def halve(_: int, bracket: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            first, last = bracket
            middle = 0.5 * (first + last)
            assert self.function is not None
            below = self.function(point(middle)) < level
            return jnp.where(below, middle, first), jnp.where(below, last, middle)

        bracket = (jnp.zeros_like(level), jnp.ones_like(level))
        first, last = jax.lax.fori_loop(0, _BISECTIONS, halve, bracket)
        return point(0.5 * (first + last))


def uniform(low: float, high: float) -> Distribution:
    """Uniform distribution on [low, high].

    Args:
      low, high: the support.

    Returns:
      :class:`Distribution`.

    Example:
      >>> uniform(0.0, 2.0).cdf(0.5).item()
      0.25
    """
    return _on_interval("uniform", low, high)


def triangular(low: float = -1.0, high: float = 1.0) -> Distribution:
    """Symmetric triangular distribution on [low, high]; the default has the density ``1 - |w|``.

    Args:
      low, high: the support.

    Returns:
      :class:`Distribution`.

    Example:
      >>> triangular().cdf(-0.5).item()
      0.125
    """
    return _on_interval("triangular", low, high)


def gaussian(scale: float, mean: float = 0.0) -> Distribution:
    """Gaussian distribution.

    Args:
      scale, mean: standard deviation and mean.

    Returns:
      :class:`Distribution`.

    Example:
      >>> gaussian(2.0, mean=1.0).cdf(1.0).item()
      0.5
    """
    scale, mean = _positive("scale", scale), validation.finite_number("mean", mean)
    return Distribution("gaussian", (-np.inf, np.inf), mean, scale, True)


def truncated_gaussian(scale: float, low: float, high: float, mean: float = 0.0) -> Distribution:
    """Gaussian distribution conditioned on [low, high].

    Args:
      scale, mean: standard deviation and mean before truncation.
      low, high: finite bounds, of a mass of at least .1 before truncation.

    Returns:
      :class:`Distribution`.

    Raises:
      ValueError: a scale that is not positive, bounds that cross, or a smaller mass.

    Example:
      >>> truncated_gaussian(1.0, -2.0, 2.0).cdf(0.0).item()
      0.5
    """
    low, high = _ordered(low, high)
    scale, mean = _positive("scale", scale), validation.finite_number("mean", mean)
    first, last = (np.array([low, high]) - mean) / scale
    mass = ndtr(last) - ndtr(first)
    if mass < MIN_MASS:
        raise ValueError(
            f"truncated_gaussian: [{low:g}, {high:g}] has probability {mass:.3g} before truncation, "
            f"below {MIN_MASS:g}; use uniform(low, high) or from_cdf."
        )
    symmetric = bool(low - mean == mean - high)
    return Distribution("truncated_gaussian", (low, high), mean, scale, symmetric)


def from_cdf(cdf: Function, low: float, high: float) -> Distribution:
    """Distribution of a user's distribution function.

    Bounds enclose the function by interval arithmetic (:func:`jaxltl.enclose`), and samples are
    quantiles by bisection.

    Args:
      cdf: JAX function ``float[...] -> float[...]``, elementwise and nondecreasing.
      low, high: its support; infinite for none.

    Returns:
      :class:`Distribution`.

    Raises:
      ValueError: bounds that cross, a function that decreases, is not a number, or is not 0 and 1 at
        the ends, or a primitive without an enclosure.

    Example:
      >>> logistic = from_cdf(jax.nn.sigmoid, -np.inf, np.inf)
      >>> logistic.cdf(np.array([0.0])).tolist()
      [0.5]
    """
    validation.function("cdf", cdf)
    low, high = _ordered(low, high, finite=False)
    distribution = Distribution("cdf", (low, high), 0.0, 1.0, False, cdf)
    share = np.linspace(0, 1, 1002)[1:-1]
    first = low if np.isfinite(low) else (high if np.isfinite(high) else 0.0) - 1e4
    last = high if np.isfinite(high) else (low if np.isfinite(low) else 0.0) + 1e4
    points = first + (last - first) * share
    lower, upper = distribution._user_bounds(points)
    missing = np.isnan(np.asarray(cdf(jnp.asarray(points)))).any()
    if missing or not (np.maximum.accumulate(lower) <= upper + CDF_ERROR).all():
        raise ValueError("cdf decreases, or is not a number; give a distribution function.")
    ends = np.array([first, last]) + np.array([1, -1]) * 1e-9 * (last - first)
    bottom, top = distribution._user_bounds(ends)
    if not (bottom[0] < 0.01 and top[1] > 0.99):
        raise ValueError(
            f"cdf is {bottom[0]:.3g} near {first:g} and {top[1]:.3g} near {last:g}; give the support, "
            "with a cdf of 0 at low and 1 at high."
        )
    return distribution


def _on_interval(kind: str, low: float, high: float) -> Distribution:
    low, high = _ordered(low, high)
    return Distribution(kind, (low, high), 0.5 * low + 0.5 * high, 0.5 * (high - low), True)


def _positive(name: str, value: float) -> float:
    number = validation.finite_number(name, value)
    if number <= 0:
        raise ValueError(f"{name}={number:g}; it must be positive.")
    return number


def _ordered(low: float, high: float, finite: bool = True) -> tuple[float, float]:
    """Bounds as floats, with low < high."""
    first, last = (validation.float_array(n, x) for n, x in (("low", low), ("high", high)))
    if first.ndim or last.ndim or not first < last:
        raise ValueError(f"low={low!r}, high={high!r}; give two numbers with low < high.")
    if finite and not (np.isfinite(first) and np.isfinite(last)):
        raise ValueError(f"low={low!r}, high={high!r}; give finite bounds.")
    return float(first), float(last)
