"""Actions of sparse models by number: a policy has the same form for every kind of model."""

from __future__ import annotations

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Integers
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.types import describe_row
from jaxltl.core.validation import first_true


def row_actions(model: SparseMDP) -> Integers:
    """The action number of each row, ``int[R]``: :attr:`SparseMDP.action_number`."""
    if not isinstance(model, SparseMDP):
        raise ValueError(validation.unsupported_model(model))
    return model.action_number


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
