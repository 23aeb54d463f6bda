"""Summaries of models, environments and trajectories for their ``repr``."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from jaxltl.core.models.protocols import RowModel
from jaxltl.core.pretty_print import (
    count,
    batch_text,
    names_text,
    propositions_text,
    readable,
)


def sparse(model: RowModel) -> Iterator[str]:
    """Summary of a sparse model."""
    yield batch_text(model.row_start.shape[:-1])
    yield count(model.num_states, "state")
    yield "a chain" if model.is_chain else count(model.num_rows, "choice")
    yield count(model.num_transitions, "transition")
    yield propositions_text(model.propositions)
    yield from named_annotations(model)
    yield initial_states(model.initial)
    yield str(model.dtype)


def named_annotations(model: object) -> Iterator[str]:
    """Names of rewards, actions and variables."""
    for noun, field in (("rewards",) * 2, ("actions", "action_names"), ("variables", "valuation")):
        if names := getattr(model, field, ()):
            yield f"{noun} {names_text(names)}"


def initial_states(initial: object) -> str:
    """The initial states, unless all are."""
    read = readable(initial)
    if read is None or read.ndim != 1:
        return ""
    starts = np.flatnonzero(read > 0)
    if len(starts) == len(read):
        return ""
    return f"starts in {starts[0]}" if len(starts) == 1 else f"{len(starts):,} starts"
