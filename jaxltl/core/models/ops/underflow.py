"""Probabilities that are zero or subnormal after conversion to a floating-point format.

NumPy computes with subnormal numbers and XLA flushes them to zero. Constructors and conversions
refuse such probabilities; inside ``jit`` solvers end with the status ``INVALID``.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax


def target_dtype(dtype: np.typing.DTypeLike) -> np.dtype:
    """The dtype of an array after JAX has taken it: float32 for float64 without ``x64``."""
    return np.dtype(jax.dtypes.canonicalize_dtype(dtype))


def underflows(probability: np.ndarray, dtype: np.typing.DTypeLike) -> np.ndarray | None:
    """Mask of the positive entries that are zero or subnormal in a dtype, or None."""
    tiny = jnp.finfo(dtype).tiny
    if probability.dtype == np.float64 and probability.size and probability.min() >= tiny:
        return None
    mask = (probability > 0) & (probability < tiny)
    return mask if mask.any() else None


def underflow_text(value: float, dtype: np.typing.DTypeLike) -> str:
    """Explanation of an underflow, for error messages."""
    name = np.dtype(dtype).name
    with np.errstate(under="ignore"):
        kind = "subnormal" if np.asarray(value, dtype) > 0 else "zero"
    remedy = "remove it" if name == "float64" else "remove it, or enable 64-bit precision"
    return f"{value:.4g} is {kind} in {name}, so that compiled programs would drop it; {remedy}"


def is_positive(weight: jax.Array) -> jax.Array:
    """``weight > 0`` by the bit pattern: True for subnormal numbers, which XLA flushes to zero."""
    weight = jnp.asarray(weight)
    if not jnp.issubdtype(weight.dtype, jnp.floating):
        return weight > 0
    return lax.bitcast_convert_type(weight, _bits(weight)) > 0


def is_subnormal(weight: jax.Array) -> jax.Array:
    """Entries strictly between zero and the least positive normal number, of either sign."""
    weight = jnp.asarray(weight)
    bits = lax.bitcast_convert_type(weight, _bits(weight)) & jnp.iinfo(_bits(weight)).max
    least = np.asarray(jnp.finfo(weight.dtype).tiny).view(f"i{weight.dtype.itemsize}")
    return (bits > 0) & (bits < least)


def _bits(weight: jax.Array) -> np.dtype:
    return np.dtype(f"i{weight.dtype.itemsize}")
