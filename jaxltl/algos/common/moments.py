"""Mean and spread of numbers that come in batches, by which networks' inputs are scaled."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from jaxltl.core.pretty_print import brief


@brief
@struct.dataclass
class Moments:
    """Of the numbers so far: how many, their mean, and summed squares around it.

    Attributes:
      count: ``float[]``.
      mean, squares: of the shape of one of them.
    """

    count: jax.Array
    mean: jax.Array
    squares: jax.Array


def no_moments(shape: tuple[int, ...], dtype: jax.typing.DTypeLike | None = None) -> Moments:
    """Those of nothing.

    Args:
      shape: of one of the numbers to come.
      dtype: default a float of the default precision.
    """
    zeros = jnp.zeros(shape, jnp.result_type(float) if dtype is None else dtype)
    return Moments(jnp.zeros_like(zeros, shape=()), zeros, zeros)


def updated_moments(
    moments: Moments, numbers: jax.Array, valid: jax.Array | None = None
) -> Moments:
    """With a batch taken in (Chan, Golub & LeVeque 1979).

    Args:
      moments: so far.
      numbers: ``[..., *shape]``.
      valid: ``bool[...]``, which of them count; default all.

    Example:
      >>> now = updated_moments(no_moments(()), jnp.array([1.0, 5.0]))
      >>> now = updated_moments(now, jnp.array([3.0]))
      >>> float(now.mean), float(now.squares)
      (3.0, 8.0)
    """
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
    """The standard deviation; 1 where nothing has varied."""
    spread = jnp.sqrt(moments.squares / jnp.maximum(moments.count, 1))
    noise = 8 * jnp.finfo(spread.dtype).eps * jnp.abs(moments.mean)
    return jnp.where(spread > noise, spread, 1)


def standardized(moments: Moments, numbers: jax.Array) -> jax.Array:
    """Numbers, centred and divided by their standard deviation."""
    return (numbers - moments.mean) / scale_of(moments)


def normalized(moments: Any, observation: Any) -> Any:
    """A tree whose floats are :func:`standardized` and clipped to ten deviations.

    Args:
      moments: a tree of :class:`Moments`, as the observation; None: it is returned as it is.
      observation: leaves that are no floats stay as they are.
    """
    if moments is None:
        return observation

    def one(x: jax.Array, m: Moments) -> jax.Array:
        if not jnp.issubdtype(jnp.asarray(x).dtype, jnp.floating):
            return x
        return jnp.clip(standardized(m, x), -10, 10).astype(x.dtype)

    return jax.tree.map(one, observation, moments)
