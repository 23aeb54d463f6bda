"""Callbacks from compiled programs to NumPy."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.models.protocols import Array, PyTree


def host_callback(function: Callable[..., PyTree], result: PyTree, *arguments: PyTree) -> PyTree:
    """``function(*arguments)`` on NumPy arrays, inside ``jit``; sequential under ``vmap``."""
    # JAX rounds the arrays of a callback to single precision if double precision is enabled for the
    # calling thread only. 64-bit numbers are therefore passed as pairs of 32-bit words.
    arguments = jax.tree.map(jnp.asarray, arguments)
    given = jax.tree.map(lambda x: np.dtype(x.dtype), arguments)
    kinds = jax.tree.map(lambda x: np.dtype(jax.dtypes.canonicalize_dtype(x.dtype)), result)

    def on_host(*words: PyTree) -> PyTree:
        found = function(*jax.tree.map(_from_words, words, given))
        return jax.tree.map(lambda kind, x: _to_words(np.asarray(x, kind)), kinds, found)

    def words_of(x: jax.Array, kind: np.dtype) -> jax.ShapeDtypeStruct:
        wide = kind.itemsize == 8
        return jax.ShapeDtypeStruct(
            (*x.shape, 2) if wide else x.shape, jnp.uint32 if wide else kind
        )

    words = jax.pure_callback(
        on_host,
        jax.tree.map(words_of, result, kinds),
        *jax.tree.map(_words, arguments),
        vmap_method="sequential",
    )
    return jax.tree.map(_number, words, kinds)


def _words(x: jax.Array) -> jax.Array:
    return lax.bitcast_convert_type(x, jnp.uint32) if x.dtype.itemsize == 8 else x


def _number(words: jax.Array, kind: np.dtype) -> jax.Array:
    return lax.bitcast_convert_type(words, kind) if kind.itemsize == 8 else words


def _to_words(x: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(x[..., None]).view(np.uint32) if x.itemsize == 8 else x


def _from_words(words: Array, kind: np.dtype) -> np.ndarray:
    x = np.asarray(words)
    return np.ascontiguousarray(x).view(kind)[..., 0] if kind.itemsize == 8 else x
