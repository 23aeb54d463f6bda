"""The shape of a gamma distribution from the gap ``log E x - E log x``, without cancellation."""

from __future__ import annotations


import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import digamma


def convex_part(z: jax.Array) -> jax.Array:
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


def log_digamma_gap(shape: jax.Array) -> jax.Array:
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


def shape_of_gap(gap: jax.Array) -> jax.Array:
    """The shape k with ``log k - digamma(k) = gap``, by Newton's method on logarithms.

    ``log gap`` is nearly linear in ``log k``, of slope -1 at both ends, so that a few steps
    from Minka's (2002) approximation suffice everywhere.
    """
    gap = jnp.maximum(gap, jnp.finfo(gap.dtype).tiny * 16)
    start = (3 - gap + jnp.sqrt(jnp.square(gap - 3) + 24 * gap)) / (12 * gap)

    def newton(_: object, log_shape: jax.Array) -> jax.Array:
        def log_gap(x: jax.Array) -> jax.Array:
            return jnp.log(log_digamma_gap(jnp.exp(x)))

        value, slope = jax.jvp(log_gap, (log_shape,), (jnp.ones_like(log_shape),))
        return log_shape - (value - jnp.log(gap)) / slope

    return jnp.exp(lax.fori_loop(0, 5, newton, jnp.log(start)))
