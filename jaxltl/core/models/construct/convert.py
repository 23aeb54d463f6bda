"""Conversions between sparse, padded and product models."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar, cast

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.models.mdp import MDP, DenseMDP, support
from jaxltl.core.models.product import Product, flat_successor
from jaxltl.core.models.ops.array_namespace import is_traced, namespace
from jaxltl.core.models.ops.kernels import segment_ids
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import SparseMDP, make_sparse
from jaxltl.core.sparse.rows import offsets_from_counts


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
        if is_traced(model):
            return _product(model)
        with jax.ensure_compile_time_eval():  # a concrete model stays so inside jit
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
    return cast(np.ndarray, initial / initial.sum())


def _product(model: Product) -> SparseMDP:
    world = to_sparse(model.mdp)
    allowed_rows = None
    if model.allowed is not None:
        action = world.rank if world.action is None else world.action
        allowed_rows = np.asarray(model.allowed)[world.host.state, :, action]
    written = product_rows(world, model, allowed_rows)
    return make_sparse(
        written.row_start,
        written.entry_start,
        written.successor,
        written.probability,
        initial=_distribution(model.initial).ravel(),
        label=written.label,
        propositions=world.propositions,
        rewards=written.rewards,
        action=written.action,
        action_names=world.action_names,
    )


def product_rows(
    world: SparseMDP, model: Product, allowed_rows: np.ndarray | None = None
) -> SparseMDP:
    """A product written out, inside ``jit`` too; only rows ``kept[r, q]`` of a sparse world."""
    # Rows of (s, q) are those of s, in order: state first, memory next, choice last.
    number = np.arange(model.num_states, dtype=np.int32)
    state, memory = np.divmod(number, model.num_memory)
    row_start, owner, row = _members(world.row_start, state, world.num_rows * model.num_memory)
    if allowed_rows is not None:
        chosen = allowed_rows[row, memory[owner]]
        owner, row = owner[chosen], row[chosen]
        row_start = offsets_from_counts(np.bincount(owner, minlength=state.size))
    total = world.num_transitions * model.num_memory if allowed_rows is None else None
    entry_start, of, entry = _members(world.entry_start, row, total)
    arrays = world.successor, world.probability, world.label, world.action
    xp, (successor, probability, label, action), owner, step, initial = namespace(
        arrays, owner[of], model.next_memory, model.initial
    )
    s, q = xp.asarray(state)[owner], xp.asarray(memory)[owner]
    return SparseMDP(
        row_start=row_start,
        entry_start=entry_start,
        successor=flat_successor(successor[entry], step, s, q, model.label_on).astype(np.int32),
        probability=probability[entry],
        initial=initial.ravel(),
        label=label[state],
        rewards={name: x.gathered(state, row, entry) for name, x in world.rewards.items()},
        action=None if action is None else action[row],
    )


def _members(start: Array, index: Array, total: int | None) -> tuple[Array, Array, Array]:
    """Members of the segments `index`: where each begins, the place of each member's, the members."""
    xp, start, index = namespace(start, index)
    first = start[index]
    begins = xp.append(xp.zeros(1, start.dtype), xp.cumsum(start[index + 1] - first))
    total = int(begins[-1]) if total is None else total
    owner: Array = xp.asarray(segment_ids(begins, total))
    return begins, owner, first[owner] + xp.arange(total, dtype=start.dtype) - begins[owner]


M = TypeVar("M")
R = TypeVar("R")


def keep_with_model(convert: Callable[[M], R]) -> Callable[[M], R]:
    """Keeps the result with the model if none of the model's arrays can change."""
    name = f"_{convert.__module__}.{convert.__name__}"

    @wraps(convert)
    def wrapper(model: M) -> R:
        if name in vars(model):
            return vars(model)[name]  # type: ignore[no-any-return]
        converted = convert(model)
        fixed = all(isinstance(x, jax.Array) for x in jax.tree.leaves(model))
        if fixed and converted is not model:
            vars(model)[name] = converted
        return converted

    return wrapper
