"""Gather-and-reduce kernels over successors, the basis of the operators of all models."""

from __future__ import annotations

from typing import cast

from collections.abc import Callable, Sequence
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.array_types import Array
from jaxltl.core.models.ops.array_namespace import jax_array, is_traced
from jaxltl.core.models.ops.underflow import is_positive

# Transitions of a state up to which sums over them are unrolled, so that XLA fuses them into one
# pass; beyond, programs would grow too large.
WRITTEN_OUT = 64
# Transitions in all up to which one gather is as fast as an unrolled loop; the compiler takes
# some ten milliseconds for each of its passes.
FEW = 2**15
# Length of the last axis up to which a reduction over it is unrolled.
UNROLL = 16

Term = Callable[[jax.Array, jax.Array], jax.Array]


def gather(value: Array, index: Array) -> jax.Array:
    """Rows ``value[index]`` without bounds checks."""
    return jnp.asarray(value).at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def fold(
    successor: Sequence[jax.Array],
    weight: Sequence[jax.Array],
    value: jax.Array,
    term: Term = jnp.multiply,
    combine: Term = jnp.add,
) -> jax.Array:
    """Reduces terms ``[N, ...]`` of weights and values over K successors, given as K arrays ``[N]`` each."""
    terms = []
    for target, w in zip(successor, weight, strict=True):
        rows = gather(value, target)
        terms.append(term(w.reshape(w.shape + (1,) * (rows.ndim - w.ndim)), rows))
    return reduce(combine, terms)


def columns(table: jax.Array) -> list[jax.Array]:
    """The entries along the last axis, an array each."""
    return [table[..., k] for k in range(table.shape[-1])]


def by_action(
    successor: jax.Array,
    weight: jax.Array,
    value: jax.Array,
    term: Term = jnp.multiply,
    combine: Term = jnp.add,
) -> jax.Array:
    """The reduction :func:`fold` of each action, from tables ``[N, A, K]``: ``[N, ..., A]``."""
    num_actions, width = successor.shape[1:]
    large = successor.size > FEW
    if large and num_actions * width <= WRITTEN_OUT:
        each = [
            fold(columns(successor[:, a]), columns(weight[:, a]), value, term, combine)
            for a in range(num_actions)
        ]
        return jnp.stack(each, axis=-1)
    if large and width <= UNROLL:
        values = fold(columns(successor), columns(weight), value, term, combine)
    else:
        values = folded(successor, weight, value, term, combine, axis=2)
    return jnp.moveaxis(values, 1, -1)


def folded(
    successor: jax.Array,
    weight: jax.Array,
    value: jax.Array,
    term: Term = jnp.multiply,
    combine: Term = jnp.add,
    *,
    axis: int,
) -> jax.Array:
    """The reduction :func:`fold` along the successor axis of whole tables, in one pass."""
    rows = gather(value, successor)
    terms = term(weight.reshape(weight.shape + (1,) * (rows.ndim - weight.ndim)), rows)
    return reduced(combine, terms, axis)


_REDUCTIONS: dict[Term, Callable[..., jax.Array]] = {
    jnp.add: jnp.sum,
    jnp.logical_or: jnp.any,
    jnp.minimum: jnp.min,
}


def reduced(combine: Term, terms: jax.Array, axis: int) -> jax.Array:
    """Reduction along an axis by one of NumPy's operations, or one with the neutral element 0."""
    if combine in _REDUCTIONS:
        return _REDUCTIONS[combine](terms, axis=axis)
    return cast(
        jax.Array, lax.reduce(terms, np.zeros((), terms.dtype), combine, (axis % terms.ndim,))
    )


def positive_hits(weight: jax.Array, inside: jax.Array) -> jax.Array:
    """True where a successor of positive weight lies in a region."""
    return is_positive(weight) & inside


def where_positive(weight: jax.Array, value: jax.Array) -> jax.Array:
    """The value where the weight is positive, else the largest number of its dtype."""
    return jnp.where(is_positive(weight), value, dtype_max(value.dtype))


def dtype_max(dtype: jnp.dtype) -> float:
    """Largest value of a dtype, infinity for floats."""
    is_float = jnp.issubdtype(dtype, jnp.floating)
    return jnp.inf if is_float else jnp.iinfo(dtype).max


# --- segments ------------------------------------------------------------------------------------


def segment_ids(start: Array, total: int) -> jax.Array:
    """The segment of each position, ``int32[total]``, from the starts of nonempty segments."""
    count = start.shape[-1] - 1
    if not is_traced(start):
        return jax_array(np.repeat(np.arange(count, dtype=np.int32), np.diff(np.asarray(start))))
    # Segments are nonempty, so that each start begins one.
    begins = (
        jnp.zeros(total, jnp.int32)
        .at[start[1:-1]]
        .add(1, indices_are_sorted=True, mode="promise_in_bounds")
    )
    return jnp.cumsum(begins, dtype=jnp.int32)


_SEGMENTS: dict[Term, Callable[..., jax.Array]] = {
    jnp.add: jax.ops.segment_sum,
    jnp.maximum: jax.ops.segment_max,
    jnp.minimum: jax.ops.segment_min,
    jnp.logical_or: jax.ops.segment_max,
}


def segment_reduce(combine: Term, quantity: jax.Array, owner: jax.Array, count: int) -> jax.Array:
    """Reduction of ``[T, ...]`` over nonempty segments with ascending ids `owner`: ``[count, ...]``."""
    numbers = quantity.astype(jnp.int32) if quantity.dtype == bool else quantity
    reduced = _SEGMENTS[combine](
        numbers, owner, count, indices_are_sorted=True, mode="promise_in_bounds"
    )
    return reduced.astype(bool) if combine is jnp.logical_or else reduced
