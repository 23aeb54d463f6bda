"""Label and Boolean state formulas on sparse models."""

from __future__ import annotations

from typing import cast

from collections.abc import Collection

import numpy as np

from jaxltl.core.logic.labels import distinct_rows, require_known, satisfying
from jaxltl.core.logic.ltl import Formula, as_formula
from jaxltl.core.models.sparse import SparseMDP

BUILT_IN = ("init", "deadlock")  # what every model of PRISM and Storm has


def label_columns(model: SparseMDP, names: Collection[str], place: str) -> np.ndarray:
    """Masks ``bool[S, n]`` of n labels, with the built-in ``init`` and ``deadlock`` (certain self-loops)."""
    known = (*model.propositions, *(x for x in BUILT_IN if x not in model.propositions))
    require_known(names, known, place)
    columns = np.zeros((model.num_states, len(names)), bool)
    for i, name in enumerate(names):
        if name in model.propositions:
            columns[:, i] = np.asarray(model.label)[:, model.propositions.index(name)]
        elif name == "init":
            columns[:, i] = np.asarray(model.initial) > 0
        else:
            columns[:, i] = _deadlocks(model)
    return columns


def _deadlocks(model: SparseMDP) -> np.ndarray:
    host = model.host
    row = host.row_start[:-1]
    entry = host.entry_start[row]
    alone = (np.diff(host.row_start) == 1) & (host.entry_start[row + 1] - entry == 1)
    return cast(np.ndarray, alone & (host.successor[entry] == np.arange(host.num_states)))


def states_satisfying(
    model: SparseMDP, condition: Formula | str, place: str = "the condition"
) -> np.ndarray:
    """States ``bool[S]`` that satisfy a Boolean formula of labels; ValueError for other formulas."""
    condition = as_formula(condition)
    names = condition.propositions
    if condition.operator == "ap":
        return label_columns(model, names, place)[:, 0]
    return satisfying(label_columns(model, names, place), names, condition, place)


def state_letters(
    model: SparseMDP, names: Collection[str], place: str = "the formula"
) -> tuple[list[frozenset[str]], np.ndarray]:
    """The letters over some labels that occur, and the letter number of each state, ``int[S]``."""
    rows, number = distinct_rows(label_columns(model, names, place))
    return [
        frozenset(n for n, holds in zip(names, row, strict=True) if holds) for row in rows
    ], number
