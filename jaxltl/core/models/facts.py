"""Summaries of models, environments and trajectories for their ``repr``."""

from __future__ import annotations

import numpy as np

from jaxltl.core.models.protocols import RowModel
from jaxltl.core.pretty_print import (
    count,
    batch_text,
    names_text,
    propositions_text,
    readable,
)


def sparse(model: RowModel) -> tuple[str, ...]:
    """Summary of a sparse model."""
    return (
        batch_text(model.row_start.shape[:-1]),
        count(model.num_states, "state"),
        "a chain" if model.is_chain else count(model.num_rows, "choice"),
        count(model.num_transitions, "transition"),
        propositions_text(model.propositions),
        *named_annotations(model),
        initial_states(model.initial),
        str(model.dtype),
    )


def named_annotations(model: object) -> list[str]:
    """Names of rewards, actions and variables."""
    parts = {"rewards": "rewards", "actions": "action_names", "variables": "valuation"}
    return [
        f"{noun} {names_text(names)}"
        for noun, field in parts.items()
        if (names := getattr(model, field, ()))
    ]


def initial_states(initial: object) -> str:
    """The initial states, unless all are."""
    read = readable(initial)
    if read is None or read.ndim != 1:
        return ""
    starts = np.flatnonzero(read > 0)
    if len(starts) == len(read):
        return ""
    return f"starts in {starts[0]}" if len(starts) == 1 else f"{len(starts):,} starts"
