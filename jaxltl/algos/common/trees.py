"""Selection between pytrees of arrays, and removal of weak types."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.array_types import PyTree

TreeT = TypeVar("TreeT")


def _is_key(x: jax.Array) -> bool:
    return bool(jnp.issubdtype(x.dtype, jax.dtypes.prng_key))


def strong(tree: TreeT) -> TreeT:
    """The same arrays without weak types, which optax starts from, so that all chunks share one program."""
    return jax.tree.map(lambda x: x if _is_key(x) else lax.convert_element_type(x, x.dtype), tree)


def each_world(function: Callable[..., TreeT], *worlds: PyTree) -> TreeT:
    """``vmap`` over worlds, but for a single one, so that a vmap over seeds stays fast."""
    if jax.tree.leaves(worlds)[0].shape[0] == 1:
        one = function(*(jax.tree.map(lambda x: x[0], y) for y in worlds))
        return jax.tree.map(lambda x: x[None], one)
    return jax.vmap(function)(*worlds)


def either(condition: jax.Array, one: TreeT, other: TreeT) -> TreeT:
    """:func:`choose` as one branch, which compiles faster than a choice for each array."""
    return lax.cond(condition, lambda: one, lambda: other)


def choose(condition: jax.Array, one: TreeT, other: TreeT) -> TreeT:
    """``jnp.where`` on trees; random keys, which steps do not change, are those of `one`."""
    return jax.tree.map(lambda x, y: x if _is_key(x) else jnp.where(condition, x, y), one, other)
