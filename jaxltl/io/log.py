"""Transition logs and state labels in CSV tables."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaxltl.core import validation
from jaxltl.core.models.construct.counts import Places, in_order, listed, merged, place_of, places
from jaxltl.core.models import MDP, DenseMDP, SparseMDP, TransitionCounts, make_counts, to_sparse
from jaxltl.io.csv_columns import Lines, read_columns

_COUNT = re.compile(r"[0-9]{1,16}")
_MOST = 2**53  # transitions
_HELD = 2**16  # distinct lines buffered before equal ones are merged


def read_log(
    path: str | os.PathLike[str],
    model: MDP | DenseMDP | SparseMDP | None = None,
    *,
    columns: tuple[str, str, str] = ("state", "action", "next"),
    count: str = "count",
    states: Sequence[str] | None = None,
    actions: Sequence[str] | None = None,
) -> TransitionCounts:
    """Transition counts of a CSV log.

    A log is UTF-8 text (RFC 4180), plain or compressed by gzip or xz. Its header names the columns,
    in any order and among others. In the column of counts, 0 marks a possible transition that was
    not observed. Memory is proportional to the number of names and distinct transitions.

    Args:
      path: the file.
      model: a model that must contain every transition; its names are the variable `state` or the
        state numbers, and the names or numbers of actions.
      columns: names of the columns of state, action and next state.
      count: name of the optional column of counts.
      states, actions: all names, in order. Default: those of the log, sorted (as numbers if all
        are).

    Returns:
      TransitionCounts, for :func:`~jaxltl.core.models.construct.counts.model_from_counts`.

    Raises:
      ValueError: with file and line, for malformed tables, invalid counts, and unknown names or
        transitions.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "log.csv"
      >>> _ = path.write_text("state,action,next\\nhall,left,kitchen\\nhall,left,hall\\n")
      >>> counts = read_log(path)
      >>> counts.states, counts.successor.tolist(), counts.count.tolist()
      (('hall', 'kitchen'), [0, 1], [1, 1])
    """
    _check_columns(columns, 3)
    support = None
    if model is not None:
        if states is not None or actions is not None:
            raise ValueError("model and names are both given; pass one of them.")
        # Duplicate successors of a row are merged.
        support = places(to_sparse(model) if isinstance(model, MDP | DenseMDP) else model)
        states, actions = support.states, support.actions
    if not isinstance(count, str):
        raise ValueError(f"count={validation.shorten(count)}; give the name of a column.")
    numbers = _names("states", states), _names("actions", actions)
    name, total, size = str(path), 0, 0
    held = [np.zeros((4, 0), np.int64)]
    for lines in read_columns(path, columns, (count,)):
        part = _numbered(lines, *numbers, support)
        total += sum(part[3].tolist())
        if total > _MOST:
            raise ValueError(
                f"{name!r}, line {lines.first + len(lines.fields) - 1}: counts add up to more than "
                "2^53 up to here."
            )
        held.append(part)
        size += part.shape[1]
        if size > _HELD + 2 * held[0].shape[1]:
            held = [merged(np.concatenate(held, 1))]
            size = held[0].shape[1]
    every = np.concatenate(held, 1)
    if not every.size:
        raise ValueError(f"{name!r}, line 2: there is no transition after the header.")
    return _by_name(every, *numbers)


def read_labels(
    path: str | os.PathLike[str],
    states: Sequence[str] | None = None,
    *,
    columns: tuple[str, str] = ("state", "label"),
) -> dict[str, tuple[str, ...]]:
    """States of each label, from a CSV table with a state and one of its labels in each line.

    Args:
      path: the file, as of :func:`read_log`.
      states: all states. Default: any.
      columns: names of the columns.

    Returns:
      The states of each label, in the order of the file.

    Raises:
      ValueError: with file and line, as :func:`read_log`.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "labels.csv"
      >>> _ = path.write_text("state,label\\nbay,goal\\nhall,goal\\nbay,warm\\n")
      >>> read_labels(path)
      {'goal': ('bay', 'hall'), 'warm': ('bay',)}
    """
    _check_columns(columns, 2)
    allowed = set() if states is None else set(map(str, validation.sequence("states", states)))
    states_of_label: dict[str, dict[str, bool]] = {}
    for lines in read_columns(path, columns):
        for fields in lines.times:
            state, label = fields
            if states is not None and state not in allowed:
                raise lines.error(fields, _unknown("state", state, list(states)))
            states_of_label.setdefault(label, {})[state] = True
    if not states_of_label:
        raise ValueError(f"{str(path)!r}, line 2: there is no label after the header.")
    return {label: tuple(some) for label, some in states_of_label.items()}


def _check_columns(columns: Sequence[str], number: int) -> None:
    names = validation.sequence("columns", columns)
    different = all(isinstance(x, str) for x in names) and len(set(names)) == number
    if isinstance(columns, str) or len(names) != number or not different:
        raise ValueError(
            f"columns={validation.shorten(columns)}; give {number} names, all different."
        )


@dataclass
class _Names:
    """Name-to-index map; unless complete, new names are appended."""

    number: dict[str, int]
    complete: bool


def _names(kind: str, names: Sequence[str] | None) -> _Names:
    every = [] if names is None else list(map(str, validation.sequence(kind, names)))
    number = {x: i for i, x in enumerate(every)}
    if len(number) < len(every):
        twice = next(x for i, x in enumerate(every) if number[x] != i)
        raise ValueError(f"the name {twice!r} stands twice; names must be distinct.")
    return _Names(number, names is not None)


def _unknown(kind: str, name: str, names: Sequence[str]) -> str:
    return f"there is no {kind} {name!r}; there are {listed(names)}."


def _numbered(
    lines: Lines, states: _Names, actions: _Names, support: Places | None
) -> NDArray[np.int64]:
    """Distinct lines as state, action and next-state indices and counts, ``[4, N]``."""
    distinct = list(lines.times)
    texts, times = list(zip(*distinct, strict=True)), list(lines.times.values())
    if len(texts) > 3:
        times = [n * _count(lines, fields) for n, fields in zip(times, distinct, strict=True)]
    table = np.array([*_numbers(lines, distinct, texts, states, actions), times], np.int64)
    if support is not None:
        _, wrong = place_of(support, *table[:3])
        if wrong:
            message = f"the model does not have it: {wrong[1]}."
            raise lines.error(distinct[wrong[0]], message)
    return table


def _numbers(
    lines: Lines,
    distinct: list[tuple[str, ...]],
    texts: list[tuple[str, ...]],
    states: _Names,
    actions: _Names,
) -> list[list[int]]:
    columns = []
    for kind, names, column in zip(
        ("state", "action", "state"), (states, actions, states), texts, strict=False
    ):
        new = set(column).difference(names.number)
        if new and names.complete:
            i = next(i for i, text in enumerate(column) if text in new)
            raise lines.error(distinct[i], _unknown(kind, column[i], list(names.number)))
        for text in new:  # in any order; sorted at the end
            names.number[text] = len(names.number)
        columns.append([names.number[text] for text in column])
    return columns


def _count(lines: Lines, fields: tuple[str, ...]) -> int:
    if _COUNT.fullmatch(fields[3]) and (count := int(fields[3])) <= _MOST:
        return count
    raise lines.error(
        fields, f"the count is {fields[3][:60]!r}; expected an integer from 0 to 2^53."
    )


def _by_name(table: NDArray[np.int64], states: _Names, actions: _Names) -> TransitionCounts:
    """Counts renumbered by the order of names."""
    orders = []
    for names in (states, actions):
        order = tuple(names.number) if names.complete else in_order(names.number)
        place = {name: i for i, name in enumerate(order)}
        orders.append((order, np.array([place[name] for name in names.number], np.int64)))
    (state_names, s), (action_names, a) = orders
    return make_counts(
        s[table[0]], a[table[1]], s[table[2]], table[3], states=state_names, actions=action_names
    )
