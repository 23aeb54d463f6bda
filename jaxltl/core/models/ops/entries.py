"""The transitions of a sparse model as compiled sweeps read them."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxltl.core.models.ops import kernels
from jaxltl.core.models.ops.choices import Rows, row_choices
from jaxltl.core.models.sparse import SparseMDP


class RowEntries(NamedTuple):
    """The transitions of a sparse model as sweeps read them.

    Attributes:
      choices: what the rows are choices of.
      row: ``int32[T]``, of each entry.
      successor: ``int32[T]``.
      probability: ``float[T]``.
    """

    choices: Rows
    row: jax.Array
    successor: jax.Array
    probability: jax.Array

    def over_entries(self, operation: Any, quantity: jax.Array) -> jax.Array:
        """A reduction over the entries of each row: ``[R, ...]`` from ``[T, ...]``."""
        return kernels.segment_reduce(operation, quantity, self.row, self.choices.shape[0])

    def expectation(self, value: jax.Array) -> jax.Array:
        """Expected value of the next state, ``[R, ...]`` from ``[S, ...]``."""
        reached = kernels.gather(value, self.successor)
        weight = self.probability.reshape(-1, *(1,) * (reached.ndim - 1))
        return self.over_entries(jax.ops.segment_sum, weight * reached)

    def matrix(self, weight: jax.Array) -> jax.Array:
        """``float[S, S]`` under weights ``[R]`` of the rows."""
        size = self.choices.num_states
        entry = kernels.gather(weight, self.row) * self.probability
        state = kernels.gather(self.choices.state, self.row)
        return jnp.zeros((size, size), entry.dtype).at[state, self.successor].add(entry)


def row_entries(model: SparseMDP) -> RowEntries:
    """A sparse model's transitions, with the row of each entry and the state of each row."""
    return RowEntries(
        row_choices(model),
        kernels.segment_ids(model.entry_start, model.num_transitions),
        jnp.asarray(model.successor),
        jnp.asarray(model.probability),
    )
