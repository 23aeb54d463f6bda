"""Arrays that the host can read, and NumPy in JAX's place for them.

An operation of ``jax.numpy`` outside of ``jit`` compiles a program for every shape. What is done
to concrete arrays once, NumPy does without compiling anything.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def is_traced(tree: Any) -> bool:
    """Whether the host does not read a tree: an array is abstract, or lies on several devices."""
    return any(
        isinstance(x, jax.core.Tracer) or (isinstance(x, jax.Array) and not x.is_fully_replicated)
        for x in jax.tree.leaves(tree)
    )


def namespace(*trees: Any) -> tuple[Any, ...]:
    """``numpy`` and the trees as NumPy arrays; with traced ones, ``jax.numpy`` and JAX arrays.

    Example:
      >>> xp, one = namespace(jnp.array([True, False]))
      >>> xp.__name__, type(one).__name__
      ('numpy', 'ndarray')
    """
    xp = jnp if is_traced(trees) else np
    return (xp, *jax.tree.map(xp.asarray, trees))


def to_jax(tree: Any) -> Any:
    """A tree with JAX arrays; of NumPy's this compiles nothing, where ``jnp.asarray`` may."""

    def one(x: Any) -> jax.Array:
        # What is put on a device may share its memory with what it was made of.
        return x if isinstance(x, jax.Array) else jax.device_put(np.array(x))

    return jax.tree.map(one, tree)
