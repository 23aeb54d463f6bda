"""Padding of sparse models to successor lists of equal length."""

from __future__ import annotations

import numpy as np

from jaxltl.core.models.action_numbers import row_actions
from jaxltl.core.models.mdp import MDP, make_mdp
from jaxltl.core.models.sparse import SparseMDP

_LARGEST = 8 * 2**30  # bytes of the largest model that is padded


def to_padded(model: SparseMDP) -> MDP:
    """A sparse model with padded successor lists, for batches and the compiled solvers.

    The action of a row is its number where actions have numbers and no names, as :func:`to_sparse` gives
    them, else its rank among the choices of its state.

    Args:
      model: the sparse model.

    Returns:
      :class:`MDP`, with A the largest number of choices and K that of successors.

    Raises:
      ValueError: more than 8 GB, with the size; two choices of a state with one number; or a
        probability that is zero or subnormal in JAX's default precision.

    Example:
      >>> import jaxltl as jl
      >>> model = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> to_padded(model).successor.tolist()
      [[[1, 2]], [[1, 0]], [[2, 0]]]
    """
    column, host = row_actions(model), model.host
    width = int(np.diff(host.entry_start).max())
    num_actions = int(column.max()) + 1
    shape = (host.num_states, num_actions, width)
    if 12 * np.prod(shape, dtype=float) > _LARGEST:
        raise ValueError(
            f"padded to {shape[1]} actions of {width} successors, {shape[0]} states would take "
            f"{12 * np.prod(shape, dtype=float) / 2**30:.0f} GB; solve the sparse model instead."
        )
    available = np.zeros(shape[:2], bool)
    available[host.state, column] = True
    if available.sum() != host.num_rows:
        raise ValueError("two choices of a state have the same action; number them apart.")
    successor, probability = np.zeros(shape, np.int32), np.zeros(shape)
    rank = np.arange(host.num_transitions) - host.entry_start[host.row]
    place = host.state[host.row], column[host.row], rank
    successor[place], probability[place] = host.successor, host.probability
    return make_mdp(
        successor,
        probability,
        available=available,
        initial=np.asarray(model.initial),
        label=np.asarray(model.label),
        propositions=model.propositions,
    )


def pad_rows(model: SparseMDP, quantity: np.ndarray) -> np.ndarray:
    """A quantity ``[R]`` on rows as one of the padded model, ``[S, A]``; zero where unavailable."""
    action = row_actions(model)
    padded = np.zeros((model.num_states, int(action.max()) + 1), quantity.dtype)
    padded[model.host.state, action] = quantity
    return padded
