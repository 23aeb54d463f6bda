"""NumPy or jax.numpy, by the kind of the arrays.

Operations of ``jax.numpy`` outside of ``jit`` compile a program for each shape; NumPy does not.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def is_traced(tree: Any) -> bool:
    """True if the host cannot read a tree: an array is a tracer, or lies on several devices."""
    return any(
        isinstance(x, jax.core.Tracer) or (isinstance(x, jax.Array) and not x.is_fully_replicated)
        for x in jax.tree.leaves(tree)
    )


def namespace(*trees: Any) -> tuple[Any, ...]:
    """``numpy`` and the trees as NumPy arrays; with traced ones, ``jax.numpy`` and JAX arrays."""
    xp = jnp if is_traced(trees) else np
    return (xp, *jax.tree.map(xp.asarray, trees))


def to_jax(tree: Any) -> Any:
    """A tree with JAX arrays, without compilation."""

    def one(x: Any) -> jax.Array:
        # device_put may share memory with its argument, hence the copy.
        return x if isinstance(x, jax.Array) else jax.device_put(np.array(x))

    return jax.tree.map(one, tree)
