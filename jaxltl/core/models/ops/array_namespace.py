"""NumPy or jax.numpy, by the kind of the arrays.

Operations of ``jax.numpy`` outside of ``jit`` compile a program for each shape; NumPy does not.
"""

from __future__ import annotations


import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxltl.core.array_types import PyTree


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

    def one(x: ArrayLike) -> jax.Array:
        # device_put may share memory with its argument, hence the copy.
        return x if isinstance(x, jax.Array) else jax.device_put(np.array(x))

    return jax.tree.map(one, tree)
