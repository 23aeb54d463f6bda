"""NumPy or jax.numpy, by the kind of the arrays; compilation, and callbacks to NumPy.

Operations of ``jax.numpy`` outside of ``jit`` compile a program for each shape; NumPy does not.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from contextvars import ContextVar
from typing import TypeVar, cast

import jax
import jax.experimental
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from jaxltl.core.array_types import PyTree
from jaxltl.core.models.protocols import Array


FunctionT = TypeVar("FunctionT", bound=Callable[..., PyTree])

# True inside a callback, where JAX must not run: its threads may all wait for callbacks.
_inside_callback: ContextVar[bool] = ContextVar("inside_callback", default=False)


def is_traced(tree: PyTree) -> bool:
    """True if the host cannot read a tree: an array is a tracer, or lies on several devices."""
    for x in jax.tree.leaves(tree):
        if isinstance(x, jax.core.Tracer) or (
            isinstance(x, jax.Array) and not x.is_fully_replicated
        ):
            return True
    return False


def namespace(*trees: PyTree) -> tuple[PyTree, ...]:
    """``numpy`` and the trees as NumPy arrays; with traced ones, ``jax.numpy`` and JAX arrays."""
    xp = jnp if is_traced(trees) else np
    return (xp, *jax.tree.map(xp.asarray, trees))


def to_jax(tree: PyTree) -> PyTree:
    """A tree with JAX arrays, without compilation; inside a callback with NumPy arrays."""
    return jax.tree.map(jax_array, tree)


def jax_array(array: ArrayLike) -> jax.Array:
    """A JAX array, without compilation; inside a callback a NumPy array."""
    if _inside_callback.get():
        return cast(jax.Array, np.asarray(array))
    # device_put may share memory with its argument, hence the copy.
    return array if isinstance(array, jax.Array) else jax.device_put(np.array(array))


def enable_x64(enabled: bool) -> AbstractContextManager[None]:
    """Context in which JAX of this thread has double precision, or not, in every version of JAX."""
    module = jax if hasattr(jax, "enable_x64") else jax.experimental  # up to JAX 0.7
    context: AbstractContextManager[None] = vars(module)["enable_x64"](enabled)
    return context


def jit(*static: str) -> Callable[[FunctionT], FunctionT]:
    """Decorator: ``jax.jit`` with static arguments by name, which keeps the function's type."""

    def compiled(function: FunctionT) -> FunctionT:
        return cast(FunctionT, jax.jit(function, static_argnames=static))

    return compiled


def host_callback(function: Callable[..., PyTree], result: PyTree, *arguments: PyTree) -> PyTree:
    """``function(*arguments)`` on NumPy arrays, inside ``jit``; sequential under ``vmap``."""
    # JAX rounds the arrays of a callback to single precision if double precision is enabled for the
    # calling thread only. 64-bit numbers are therefore passed as pairs of 32-bit words. Concrete
    # arrays are not passed, as each array of a call costs time.
    leaves, form = jax.tree.flatten(arguments)
    traced = {i: x for i, x in enumerate(leaves) if isinstance(x, jax.core.Tracer)}
    known = [None if i in traced else np.asarray(x) for i, x in enumerate(leaves)]
    dtypes = {i: np.dtype(x.dtype) for i, x in traced.items()}
    kinds = jax.tree.map(lambda x: np.dtype(jax.dtypes.canonicalize_dtype(x.dtype)), result)

    def on_host(words: dict[int, Array]) -> PyTree:
        passed = {i: _from_words(x, dtypes[i]) for i, x in words.items()}
        full = [passed.get(i, x) for i, x in enumerate(known)]
        token = _inside_callback.set(True)
        try:
            results = function(*jax.tree.unflatten(form, full))
        finally:
            _inside_callback.reset(token)
        return jax.tree.map(lambda kind, x: _to_words(np.asarray(x, kind)), kinds, results)

    def words_of(x: jax.Array, kind: np.dtype) -> jax.ShapeDtypeStruct:
        wide = kind.itemsize == 8
        return jax.ShapeDtypeStruct(
            (*x.shape, 2) if wide else x.shape, jnp.uint32 if wide else kind
        )

    words = jax.pure_callback(
        on_host,
        jax.tree.map(words_of, result, kinds),
        {i: _words(x) for i, x in traced.items()},
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
