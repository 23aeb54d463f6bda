"""Running mean and standard deviation, which standardise the inputs of networks."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxltl.core import struct
from jaxltl.core.array_types import PyTree


@struct.dataclass
class Moments:
    """Number ``float[]``, mean and sum of squared deviations of a stream of arrays of one shape."""

    count: jax.Array
    mean: jax.Array
    squares: jax.Array


def no_moments(shape: tuple[int, ...], dtype: jax.typing.DTypeLike | None = None) -> Moments:
    """The moments of an empty stream of arrays of a `shape`; `dtype` defaults to float."""
    zeros = jnp.zeros(shape, jnp.result_type(float) if dtype is None else dtype)
    return Moments(jnp.zeros_like(zeros, shape=()), zeros, zeros)


def updated_moments(
    moments: Moments, numbers: jax.Array, valid: jax.Array | None = None
) -> Moments:
    """The moments with a batch ``[..., *shape]``, or its `valid` entries, added (Chan et al. 1979)."""
    numbers = numbers.astype(moments.mean.dtype)
    axes = tuple(range(numbers.ndim - moments.mean.ndim))
    if valid is None:
        weight = jnp.ones(numbers.shape[: len(axes)], numbers.dtype)
    else:
        weight = valid.astype(numbers.dtype)
    count = weight.sum()
    weight = weight.reshape(*weight.shape, *[1] * moments.mean.ndim)
    mean = jnp.sum(weight * numbers, axes) / jnp.maximum(count, 1)
    squares = jnp.sum(weight * (numbers - mean) ** 2, axes)
    total = jnp.maximum(moments.count + count, 1)
    shift = mean - moments.mean
    return Moments(
        count=moments.count + count,
        mean=moments.mean + shift * count / total,
        squares=moments.squares + squares + shift**2 * moments.count * count / total,
    )


def scale_of(moments: Moments) -> jax.Array:
    """The standard deviation; 1 where it is zero."""
    deviation = jnp.sqrt(moments.squares / jnp.maximum(moments.count, 1))
    return jnp.where(
        deviation > 8 * jnp.finfo(deviation.dtype).eps * jnp.abs(moments.mean), deviation, 1
    )


def standardized(moments: Moments, numbers: jax.Array) -> jax.Array:
    """Numbers minus their mean, divided by their standard deviation."""
    return (numbers - moments.mean) / scale_of(moments)


def normalized(moments: PyTree, observation: PyTree) -> PyTree:
    """A tree of observations with floats :func:`standardized` and clipped to ten deviations."""
    if moments is None:
        return observation

    def one(x: jax.Array, m: Moments) -> jax.Array:
        if not jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating):
            return x
        return jnp.clip(standardized(m, x), -10, 10).astype(x.dtype)

    return jax.tree.map(one, observation, moments)
