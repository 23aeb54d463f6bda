"""Conversions between sparse, padded and product models."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import wraps
from typing import TypeVar

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.models.mdp import MDP, DenseMDP, support
from jaxltl.core.models.product import Product, flat_successor
from jaxltl.core.models.protocols import Model
from jaxltl.core.models.sparse import SparseMDP, make_sparse
from jaxltl.core.sparse.rows import offsets_from_counts, row_entries


def to_sparse(model: Model) -> SparseMDP:
    """Any concrete MDP, DenseMDP, product or sparse model as a :class:`SparseMDP`.

    Row i of a state is the i-th of its available actions, with the number ``action[i]``. A product's
    states are numbered ``s * Q + q``, with the labels of the base model.

    Args:
      model: the model.

    Returns:
      :class:`SparseMDP`; a sparse model is returned unchanged.

    Raises:
      ValueError: a model of another kind.

    Example:
      >>> from jaxltl import from_dense
      >>> sparse = to_sparse(from_dense([[[0.5, 0.5], [1, 0]], [[1, 0], [0, 0]]]))
      >>> sparse.row_start.tolist(), sparse.action.tolist(), sparse.successor.tolist()
      ([0, 2, 3], [0, 1, 0], [0, 1, 0, 0])
    """
    if isinstance(model, SparseMDP):
        return model
    if isinstance(model, Product):
        return _product(model)
    if not isinstance(model, MDP | DenseMDP):
        raise ValueError(validation.unsupported_model(model))
    used, available = support(model), np.asarray(model.available)
    s, a, k = np.nonzero(used)
    if isinstance(model, DenseMDP):
        weight, target = np.asarray(model.transition), k
    else:
        weight, target = np.asarray(model.probability), np.asarray(model.successor)[s, a, k]
    state, action = np.nonzero(available)
    count = used.sum(-1)[state, action]
    return make_sparse(
        offsets_from_counts(available.sum(-1)),
        offsets_from_counts(count),
        target,
        weight[s, a, k].astype(np.float64),
        initial=_distribution(model.initial),
        label=np.asarray(model.label),
        propositions=model.propositions,
        action=action,
    )


def _distribution(initial: ArrayLike) -> np.ndarray:
    initial = np.asarray(initial, np.float64)
    result: np.ndarray = initial / initial.sum()
    return result


def _product(model: Product) -> SparseMDP:
    world = to_sparse(model.mdp)
    host, step = world.host, np.asarray(model.next_memory)
    num_memory = step.shape[1]
    shape = (host.num_states, num_memory)
    kept = np.ones((host.num_rows, num_memory), bool)
    if model.allowed is not None:
        action = world.rank if world.action is None else world.action
        kept = np.asarray(model.allowed)[host.state, :, action]
    # Rows of (s, q) are those of s, in order: state first, memory next, choice last.
    state, memory = np.divmod(np.arange(shape[0] * shape[1]), num_memory)
    row, choices = row_entries(host.row_start, state)
    q = np.repeat(memory, choices)
    chosen = kept[row, q]
    per_state = np.bincount(
        np.repeat(state * num_memory + memory, choices)[chosen], minlength=state.size
    )
    row, q = row[chosen], q[chosen]
    entry, width = row_entries(host.entry_start, row)
    s_of, q_of = np.repeat(host.state[row], width), np.repeat(q, width)
    target = flat_successor(host.successor[entry], step, s_of, q_of, model.label_on)
    return make_sparse(
        offsets_from_counts(per_state),
        offsets_from_counts(width),
        target,
        host.probability[entry],
        initial=_distribution(model.initial).ravel(),
        label=np.asarray(world.label)[state],
        propositions=world.propositions,
        rewards={name: x.gathered(state, row, entry) for name, x in world.rewards.items()},
        action=None if world.action is None else np.asarray(world.action)[row],
        action_names=world.action_names,
    )


M = TypeVar("M")
R = TypeVar("R")


def keep_latest(convert: Callable[[M], R]) -> Callable[[M], R]:
    """Keeps the result for the latest model while that is alive and none of its arrays can change."""
    kept: dict[str, tuple[weakref.ref[M], R]] = {}

    @wraps(convert)
    def wrapper(model: M) -> R:
        latest = kept.get("latest")
        if latest is not None and latest[0]() is model:
            return latest[1]
        found = convert(model)
        if all(isinstance(x, jax.Array) for x in jax.tree.leaves(model)):
            kept["latest"] = weakref.ref(model, forget), found
        return found

    def forget(reference: weakref.ref[M]) -> None:
        latest = kept.get("latest")
        if latest is not None and latest[0] is reference:
            del kept["latest"]

    return wrapper


_LARGEST = 8 * 2**30  # bytes of the largest model that is padded
