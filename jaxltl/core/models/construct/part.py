"""Parts of sparse models: some of the states, and some of their choices."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from jaxltl.core.sparse.graph.components import forward_reachable
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts
from jaxltl.core.models.sparse import Rewards, SparseMDP


def submodel(model: SparseMDP, states: np.ndarray, rows: np.ndarray) -> SparseMDP:
    """The model of some states and rows, with what belongs to them.

    Args:
      model: the model.
      states: ``bool[S]``, the states to keep, in order.
      rows: ``bool[R]``, the choices to keep; those of states that are kept lead only to such.

    Raises:
      ValueError: a state that is kept keeps no choice, with its number.
    """
    host = model.host
    row = np.flatnonzero(rows & states[host.state])
    kept = np.flatnonzero(states)
    number = np.full(host.num_states, -1, np.int32)
    number[kept] = np.arange(kept.size)
    choices = np.bincount(number[host.state[row]], minlength=kept.size)
    if (choices == 0).any():
        raise ValueError(f"no choice is left in state {kept[int(np.argmin(choices))]}; allow one.")
    width = np.diff(host.entry_start)[row]
    entry = concatenated_ranges(host.entry_start[row], width)

    def taken(x: Any, index: np.ndarray) -> Any:
        return None if x is None else np.asarray(x)[index]

    rewards = {
        name: Rewards(taken(x.state, kept), taken(x.choice, row), taken(x.transition, entry))
        for name, x in model.rewards.items()
    }
    initial = np.asarray(model.initial)[kept]
    return replace(
        model,
        row_start=offsets_from_counts(choices),
        entry_start=offsets_from_counts(width),
        successor=number[host.successor[entry]],
        probability=host.probability[entry],
        initial=initial / initial.sum() if initial.sum() else initial,
        label=np.asarray(model.label)[kept],
        rewards=rewards,
        action=taken(model.action, row),
        valuation={name: taken(x, kept) for name, x in model.valuation.items()},
    )


def reachable_states(model: SparseMDP, start: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The states to which some rows lead from some states, these among them: ``bool[S]``."""
    host = model.host
    used = rows[host.row]
    return forward_reachable(host.state[host.row[used]], host.successor[used], start)
