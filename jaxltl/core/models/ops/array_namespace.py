"""NumPy or jax.numpy, by the kind of the arrays; conversion to JAX, and typed compilation.

Operations of ``jax.numpy`` outside of ``jit`` compile a program for each shape; NumPy does not.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxltl.core.array_types import PyTree

FunctionT = TypeVar("FunctionT", bound=Callable[..., PyTree])


def is_traced(tree: PyTree) -> bool:
    """True if the host cannot read a tree: an array is a tracer, or lies on several devices."""
    return any(
        isinstance(x, jax.core.Tracer) or (isinstance(x, jax.Array) and not x.is_fully_replicated)
        for x in jax.tree.leaves(tree)
    )


def namespace(*trees: PyTree) -> tuple[PyTree, ...]:
    """``numpy`` and the trees as NumPy arrays; with traced ones, ``jax.numpy`` and JAX arrays."""
    xp = jnp if is_traced(trees) else np
    return (xp, *jax.tree.map(xp.asarray, trees))


def to_jax(tree: PyTree) -> PyTree:
    """A tree with JAX arrays, without compilation."""
    return jax.tree.map(jax_array, tree)


def jax_array(array: ArrayLike) -> jax.Array:
    """A JAX array, without compilation."""
    # device_put may share memory with its argument, hence the copy.
    return array if isinstance(array, jax.Array) else jax.device_put(np.array(array))


def jit(*static: str) -> Callable[[FunctionT], FunctionT]:
    """Decorator: ``jax.jit`` with static arguments by name, which keeps the function's type."""

    def compiled(function: FunctionT) -> FunctionT:
        return cast(FunctionT, jax.jit(function, static_argnames=static))

    return compiled
