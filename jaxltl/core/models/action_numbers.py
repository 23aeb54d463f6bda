"""Actions of sparse models by number: a policy has the same form for every kind of model."""

from __future__ import annotations

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Integers
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.types import describe_row
from jaxltl.core.validation import first_true


def row_actions(model: SparseMDP) -> Integers:
    """The action number of each row, ``int[R]``: :attr:`SparseMDP.action_number`."""
    if not isinstance(model, SparseMDP):
        raise ValueError(validation.unsupported_model(model))
    return model.action_number


def named_actions(model: SparseMDP) -> tuple[Integers, tuple[str, ...]]:
    """The number ``int[R]`` of each row's action in a :class:`FiniteMemoryPolicy`, and the names by number.

    The numbers of the names where these tell the choices of every state apart, or else those of
    :attr:`SparseMDP.action_number`, without names.
    """
    named = model.rank if model.action is None else np.asarray(model.action, np.int64)
    place = model.host.state * np.int64(named.max(initial=0) + 1) + named
    if np.unique(place).size < place.size:
        return row_actions(model), ()
    return named, model.action_names


def rows_of_policy(
    model: SparseMDP, policy: Array, where: Array = True, shape: tuple[int, ...] | None = None
) -> Integers:
    """The rows ``int[S]`` of a policy of action numbers; first rows where `where` is False.

    Errors name states in `shape`, which is that of a product.

    Raises:
      ValueError: another shape, or an action that a state does not have.
    """
    host, policy = model.host, np.asarray(policy)
    if policy.shape != (host.num_states,):
        raise ValueError(
            f"policy has shape {policy.shape}; expected ({host.num_states},), an action for each "
            "state, or the weights of actions with one more axis."
        )
    number, start = row_actions(model), host.row_start[:-1]
    ranks = (policy >= 0) & (policy < np.diff(host.row_start))
    if ranks.all() and (number[start + policy] == policy).all():  # as in most models
        rows: Integers = start + policy
        return rows
    some, row = host.first_choice(number == policy[host.state])
    for s in first_true(~some & where):
        known = number[host.row_start[s] : host.row_start[s + 1]].tolist()
        raise ValueError(
            f"the policy takes action {policy[s]} in state {_named(s, shape)}, which is not available; "
            f"choose one of {known}."
        )
    return row


def weights_of_policy(
    model: SparseMDP, policy: Array, shape: tuple[int, ...] | None = None
) -> Array:
    """The weights of rows ``float[R]`` of those of actions ``float[S, A]``, or of rows as they are.

    Raises:
      ValueError: another shape, or a weight of an action that a state does not have.
    """
    host, policy = model.host, np.asarray(policy)
    if policy.shape == (host.num_rows,):
        return policy
    number = row_actions(model)
    count = int(number.max()) + 1
    if policy.ndim != 2 or policy.shape[0] != host.num_states or policy.shape[1] < count:
        raise ValueError(
            f"policy has shape {policy.shape}; expected ({host.num_states}, {count}), the weights of "
            f"actions, or ({host.num_states},), an action for each state."
        )
    none = np.ones(policy.shape, bool)
    none[host.state, number] = False
    wrong = none & (policy != 0)
    for state in np.flatnonzero(wrong.any(1))[:1].tolist():
        place = (state,) if shape is None else np.unravel_index(state, shape)
        raise ValueError(f"{describe_row(np.where(wrong, np.nan, policy)[state], place)}.")
    return policy[host.state, number]


def _named(state: int, shape: tuple[int, ...] | None) -> str:
    if shape is None or len(shape) == 1:
        return str(state)
    return str(tuple(int(i) for i in np.unravel_index(state, shape)))


def with_action_numbers(model: SparseMDP, policy: FiniteMemoryPolicy) -> FiniteMemoryPolicy:
    """The policy with the action numbers of the model in place of those of the actions' names.

    Raises:
      ValueError: an action that its state does not have.
    """
    policy, state, number = policy.on_host(), model.host.state, row_actions(model)
    named, names = named_actions(model)
    table, width = np.asarray(policy.action), int(named.max(initial=0)) + 1
    if policy.is_random:
        weight = np.moveaxis(table, (-3, -1), (0, 1))  # [S, W, ..., Q]
        if weight.shape[1] < width:
            raise ValueError(
                f"policy has {weight.shape[1]} actions and the model {width}; give the model that "
                "the policy was projected to."
            )
        moved = np.zeros((len(weight), int(number.max(initial=0)) + 1, *weight.shape[2:]))
        moved[state, number] = weight[state, named]
        wrong = (moved.sum(1) < weight.sum(1) - 1e-5).reshape(len(weight), -1).any(1)
        moved = np.moveaxis(moved, (0, 1), (-3, -1)).astype(table.dtype)
    else:
        row = np.full((policy.num_states, width), -1)
        row[state, named] = number
        place = np.arange(policy.num_states)[:, None]
        known = (table >= 0) & (table < width)
        moved = np.where(known, row[place, np.where(known, table, 0)], -1)
        wrong = (moved < 0).any(axis=tuple(i for i in range(moved.ndim) if i != moved.ndim - 2))
        moved = moved.astype(np.int32)
    for at in np.flatnonzero(wrong)[:1].tolist():
        own = named[state == at].tolist()
        raise ValueError(
            f"policy: an action of state {at} is not one of its choices, "
            f"{[names[x] for x in own] if names else own}."
        )
    return policy.replace(action=moved)
