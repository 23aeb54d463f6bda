"""Selection between pytrees of arrays, and removal of weak types."""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

TreeT = TypeVar("TreeT")


def _is_key(x: jax.Array) -> bool:
    return bool(jnp.issubdtype(x.dtype, jax.dtypes.prng_key))


def strong(tree: TreeT) -> TreeT:
    """The same arrays without weak types, so that all chunks of a run share one program."""
    return jax.tree.map(lambda x: x if _is_key(x) else lax.convert_element_type(x, x.dtype), tree)


def either(condition: jax.Array, one: TreeT, other: TreeT) -> TreeT:
    """:func:`choose` as one branch, which compiles faster than a choice for each array."""
    return lax.cond(condition, lambda: one, lambda: other)


def choose(condition: jax.Array, one: TreeT, other: TreeT) -> TreeT:
    """``jnp.where`` on trees; random keys, which steps do not change, are those of `one`."""
    return jax.tree.map(lambda x, y: x if _is_key(x) else jnp.where(condition, x, y), one, other)
