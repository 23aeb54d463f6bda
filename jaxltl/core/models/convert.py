"""One model written in several ways: sparse, padded, and products written out."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.core.host.rows import spans
from jaxltl.core.models.mdp import MDP, DenseMDP, make_mdp, support
from jaxltl.core.models.product import Product, flat_successor
from jaxltl.core.models.sparse import Rewards, SparseMDP, make_sparse

_LARGEST_PADDED = 8 * 2**30  # bytes of the largest model that is padded


def to_sparse(model: Any) -> SparseMDP:
    """Any concrete MDP, DenseMDP, product of one, or sparse model, as a :class:`SparseMDP`.

    Unavailable actions and padding are left out. Row i of a state takes the i-th of its available
    actions, whose number is ``action[i]``. A product's states are numbered ``s * Q + q``, and
    labels are the world's.

    Raises:
      ValueError: the model is none of these.

    Example:
      >>> from jaxltl.core.models.mdp import make_mdp
      >>> mdp = make_mdp([[[0, 1], [1, 0]], [[1, 0], [0, 0]]],
      ...                [[[0.5, 0.5], [1, 0]], [[1, 0], [0, 0]]])
      >>> sparse = to_sparse(mdp)
      >>> sparse.row_start.tolist(), sparse.action.tolist(), sparse.successor.tolist()
      ([0, 2, 3], [0, 1, 0], [0, 1, 1, 1])
    """
    if isinstance(model, SparseMDP):
        return model
    if isinstance(model, Product):
        return _product(model)
    if not isinstance(model, MDP | DenseMDP):
        raise ValueError(f"{type(model).__name__} has no transitions to write out; give an MDP, a "
                         "DenseMDP, a product of one or a SparseMDP.")
    used, available = support(model), np.asarray(model.available)
    s, a, k = np.nonzero(used)
    if isinstance(model, DenseMDP):
        weight, target = np.asarray(model.transition), k
    else:
        weight, target = np.asarray(model.probability), np.asarray(model.successor)[s, a, k]
    state, action = np.nonzero(available)
    count = used.sum(-1)[state, action]
    return make_sparse(
        _from_counts(available.sum(-1)), _from_counts(count), target,
        weight[s, a, k].astype(np.float64), initial=_distribution(model.initial),
        label=np.asarray(model.label), propositions=model.propositions, action=action)


def _from_counts(count: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], count.cumsum()])


def _distribution(initial: Any) -> np.ndarray:
    initial = np.asarray(initial, np.float64)
    return initial / initial.sum()


def _product(model: Product) -> SparseMDP:
    world = to_sparse(model.mdp)
    host, step = world.host, np.asarray(model.next_memory)
    num_memory = step.shape[1]
    shape = (host.num_states, num_memory)
    kept = np.ones((host.num_rows, num_memory), bool)
    if model.allowed is not None:
        action = world.action
        if action is None:
            action = np.arange(host.num_rows) - host.row_start[host.state]
        kept = np.asarray(model.allowed)[host.state, :, action]
    # Rows of (s, q) are those of s, in order: state first, memory next, choice last.
    state, memory = np.divmod(np.arange(shape[0] * shape[1]), num_memory)
    choices = np.diff(host.row_start)[state]
    row = spans(host.row_start[state], choices)
    q = np.repeat(memory, choices)
    chosen = kept[row, q]
    per_state = np.bincount(np.repeat(state * num_memory + memory, choices)[chosen],
                            minlength=state.size)
    row, q = row[chosen], q[chosen]
    width = np.diff(host.entry_start)[row]
    entry = spans(host.entry_start[row], width)
    s_of, q_of = np.repeat(host.state[row], width), np.repeat(q, width)
    target = flat_successor(host.successor[entry], step, s_of, q_of, model.label_on)
    rewards = {name: Rewards(
        None if x.state is None else np.asarray(x.state)[state],
        None if x.choice is None else np.asarray(x.choice)[row],
        None if x.transition is None else np.asarray(x.transition)[entry])
        for name, x in world.rewards.items()}
    return make_sparse(
        _from_counts(per_state), _from_counts(width), target, host.probability[entry],
        initial=_distribution(model.initial).ravel(),
        label=np.asarray(world.label)[state], propositions=world.propositions, rewards=rewards,
        action=None if world.action is None else np.asarray(world.action)[row],
        action_names=world.action_names)


def to_padded(model: SparseMDP) -> MDP:
    """The same process with padded successor lists, for batches and the compiled solvers.

    An action of the padded model is the number of a choice's action where actions have numbers
    without names, as :func:`to_sparse` gives them, else its rank among the choices of its state.

    Raises:
      ValueError: padding would take more than 8 GB, with the size; or two choices of a state have
        one number.
    """
    host = model.host
    column = np.arange(host.num_rows) - host.row_start[host.state]
    if model.action is not None and not model.action_names:
        column = np.asarray(model.action)
    width = int(np.diff(host.entry_start).max())
    num_actions = int(column.max()) + 1
    shape = (host.num_states, num_actions, width)
    if 12 * np.prod(shape, dtype=float) > _LARGEST_PADDED:
        raise ValueError(
            f"padded to {shape[1]} actions of {width} successors, {shape[0]} states would take "
            f"{12 * np.prod(shape, dtype=float) / 2**30:.0f} GB; solve the sparse model instead.")
    available = np.zeros(shape[:2], bool)
    available[host.state, column] = True
    if available.sum() != host.num_rows:
        raise ValueError("two choices of a state have the same action; number them apart.")
    successor, probability = np.zeros(shape, np.int32), np.zeros(shape)
    rank = np.arange(host.num_transitions) - host.entry_start[host.row]
    place = host.state[host.row], column[host.row], rank
    successor[place], probability[place] = host.successor, host.probability
    return make_mdp(
        successor, probability, available=available, initial=np.asarray(model.initial),
        label=np.asarray(model.label), propositions=model.propositions)
