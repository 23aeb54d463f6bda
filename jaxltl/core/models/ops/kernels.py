"""The one gather-and-sum over successors, behind every primitive of every model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.models.ops.array_namespace import is_traced, to_jax

# Transitions of a state up to which what is summed over them is written out, so that XLA fuses
# it into one pass and with what reads single actions; beyond, programs would grow too large.
WRITTEN_OUT = 64
# Transitions in all up to which they are gathered in one go: one pass over so few is as fast as
# many, and every pass that is written out takes the compiler some ten milliseconds.
FEW = 2**15
# Entries of a short last axis up to which a reduction over it is written out.
UNROLL = 16

Term = Callable[[jax.Array, jax.Array], jax.Array]


def gather(value: Any, index: Any) -> jax.Array:
    """Rows ``value[index]`` at places that are known to exist, without checks of bounds."""
    return jnp.asarray(value).at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def fold(
    successor: Sequence[jax.Array],
    weight: Sequence[jax.Array],
    value: jax.Array,
    term: Term = jnp.multiply,
    combine: Term = jnp.add,
) -> jax.Array:
    """Combines, over the successors of one action, terms of a weight and the value there.

    Args:
      successor: K arrays ``int32[N]``.
      weight: K arrays ``float[N]``.
      value: ``[N, ...]``; what stands behind the states is carried along.
      term, combine: for an expectation, the product and the sum.

    Returns:
      ``[N, ...]``.
    """
    terms = []
    for target, w in zip(successor, weight, strict=True):
        rows = gather(value, target)
        terms.append(term(w.reshape(w.shape + (1,) * (rows.ndim - w.ndim)), rows))
    return reduce(combine, terms)


def by_action(
    successor: jax.Array,
    weight: jax.Array,
    value: jax.Array,
    term: Term = jnp.multiply,
    combine: Term = jnp.add,
) -> list[jax.Array]:
    """:func:`fold` for each action, from tables ``[N, A, K]``: A arrays ``[N, ...]``.

    Where there are few transitions, or many in a state, all actions are combined at once.
    """
    num_actions, width = successor.shape[1:]
    if successor.size <= FEW:
        found = folded(successor, weight, value, term, combine, axis=2)
        return [found[:, a] for a in range(num_actions)]
    if num_actions * width <= WRITTEN_OUT:
        return [
            fold(
                [successor[:, a, k] for k in range(width)],
                [weight[:, a, k] for k in range(width)],
                value,
                term,
                combine,
            )
            for a in range(num_actions)
        ]
    if width <= UNROLL:
        found = fold(
            [successor[..., k] for k in range(width)],
            [weight[..., k] for k in range(width)],
            value,
            term,
            combine,
        )
    else:
        found = folded(successor, weight, value, term, combine, axis=2)
    return [found[:, a] for a in range(num_actions)]


def folded(
    successor: jax.Array,
    weight: jax.Array,
    value: jax.Array,
    term: Term = jnp.multiply,
    combine: Term = jnp.add,
    *,
    axis: int,
) -> jax.Array:
    """:func:`fold` along the axis of the successors of whole tables, in one pass."""
    rows = gather(value, successor)
    terms = term(weight.reshape(weight.shape + (1,) * (rows.ndim - weight.ndim)), rows)
    wholes: dict[Any, Any] = {jnp.add: jnp.sum, jnp.logical_or: jnp.any, jnp.minimum: jnp.min}
    return wholes[combine](terms, axis=axis)


def stacked(columns: Sequence[jax.Array]) -> jax.Array:
    """Arrays of the actions side by side, as the last axis."""
    return jnp.stack(columns, axis=-1)


def positive_hits(weight: jax.Array, inside: jax.Array) -> jax.Array:
    """Whether a successor of positive weight lies in a region."""
    return (weight > 0) & inside


def where_positive(weight: jax.Array, value: jax.Array) -> jax.Array:
    """The value where a successor has positive weight, else the largest of its dtype."""
    return jnp.where(weight > 0, value, dtype_max(value.dtype))


def dtype_max(dtype: Any) -> Any:
    """The largest value of a dtype."""
    is_float = jnp.issubdtype(dtype, jnp.floating)
    return jnp.inf if is_float else jnp.iinfo(dtype).max


# --- spans that stand one after another ------------------------------------------------------


def segment_ids(start: Any, total: int) -> jax.Array:
    """Whose span each of a number of things lies in, ``int32[total]``, from the spans' starts."""
    count = start.shape[-1] - 1
    if not is_traced(start):
        return to_jax(np.repeat(np.arange(count, dtype=np.int32), np.diff(np.asarray(start))))
    # Spans are not empty, so each begins one.
    begins = (
        jnp.zeros(total, jnp.int32)
        .at[start[1:-1]]
        .add(1, indices_are_sorted=True, mode="promise_in_bounds")
    )
    return jnp.cumsum(begins, dtype=jnp.int32)


def segment_reduce(operation: Any, quantity: jax.Array, owner: jax.Array, count: int) -> jax.Array:
    """A reduction such as ``jax.ops.segment_sum`` of what each of so many owners has."""
    return operation(quantity, owner, count, indices_are_sorted=True, mode="promise_in_bounds")
