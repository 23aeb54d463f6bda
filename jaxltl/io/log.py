"""Transition logs and state labels in CSV tables, read with bounded memory."""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from jaxltl.core import validation
from jaxltl.core.models import MDP, DenseMDP, SparseMDP, TransitionCounts, make_counts, to_sparse
from jaxltl.core.models.construct.counts import Places, in_order, listed, merged, place_of, places
from jaxltl.io.files import streamed

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


# --- tables ----------------------------------------------------------------------------------


_STEP = 2**13  # bytes per batch; larger batches are slower
_LONGEST = 2**16  # bytes of a line
_JUNK = re.compile(rb"[\x00-\x08\x0b-\x1f\x7f]")  # of no text; a tab may stand in one
_BOM = b"\xef\xbb\xbf"


@dataclass(frozen=True)
class Lines:
    """Consecutive lines of a CSV table, restricted to the requested columns."""

    name: str  # file name
    first: int  # number of the first line
    fields: list[tuple[str, ...]]  # requested fields of each line
    times: Counter[tuple[str, ...]]  # number of lines with the same fields

    def error(self, fields: tuple[str, ...], message: str) -> ValueError:
        return _error(self.name, self.first + self.fields.index(fields), message)


def read_columns(
    path: str | os.PathLike[str], columns: Sequence[str], optional: Sequence[str] = ()
) -> Iterator[Lines]:
    """Requested columns of a UTF-8 CSV table with a header, in batches of lines.

    Fields may be quoted; blanks around them are removed. Yields the fields of `columns`, then those
    of `optional` that exist; an empty field is an error.
    """
    name, empty = str(path), 0
    place: tuple[int, ...] = ()
    for first, data in _whole_lines(name, streamed(path)):
        rows = _rows(name, first, data)
        if not place:
            header, rows, first = _stripped(rows[0]), rows[1:], first + 1
            place = _places(name, header, columns, optional)
        number = first + len(rows)
        while rows and _is_empty(rows[-1]):
            rows.pop()
        if rows:
            if empty:
                raise _error(name, empty, "is empty; remove it.")
            _check_widths(name, first, rows, len(header))
            lines = _picked(name, first, rows, place)
            _check_fields(lines, [header[i] for i in place])
            yield lines
        if first + len(rows) < number:
            empty = empty or first + len(rows)
    if not place:
        raise _error(name, 1, f"the file is empty; it should begin with {','.join(columns)}.")


def _error(name: str, line: int, message: str) -> ValueError:
    return ValueError(f"{name!r}, line {line}: {message}")


def _whole_lines(name: str, parts: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
    """Splits the byte stream at line ends; yields the first line number and the bytes."""
    line, held = 1, b""
    for part in (x[i : i + _STEP] for x in parts for i in range(0, len(x), _STEP)):
        data = held + part
        cut = data.rfind(b"\n") + 1
        count, held = data.count(b"\n"), data[cut:]
        if len(held) > _LONGEST:
            raise _error(name, line + count, f"is longer than {_LONGEST} bytes.")
        if cut:
            yield line, data[:cut]
        line += count
    if held:
        yield line, held


def _rows(name: str, first: int, data: bytes) -> list[list[str]]:
    if first == 1:
        data = data.removeprefix(_BOM)
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n")
    if junk := _JUNK.search(data):
        line = first + data.count(b"\n", 0, junk.start())
        raise _error(name, line, f"byte {data[junk.start()]:#x} is not text; expected a table.")
    try:
        lines = data.decode().split("\n")
    except UnicodeDecodeError as error:
        line = first + data.count(b"\n", 0, error.start)
        message = f"byte {data[error.start]:#x} is not UTF-8 text; expected a table."
        raise _error(name, line, message) from None
    if not lines[-1]:
        lines.pop()
    reader = csv.reader(lines, strict=True, skipinitialspace=True)
    try:
        rows = list(reader)
    except csv.Error as error:
        raise _error(name, first + max(reader.line_num, 1) - 1, f"{error}.") from None
    if len(rows) < len(lines):  # a quoted field contains a line end
        reader = csv.reader(lines, strict=True, skipinitialspace=True)
        whole = next(i for i, _ in enumerate(reader) if reader.line_num > i + 1)
        raise _error(name, first + whole, "a quote is not closed on its line.")
    return rows


def _stripped(fields: Iterable[str]) -> tuple[str, ...]:
    return tuple(map(str.strip, fields))


def _is_empty(row: list[str]) -> bool:
    return not row or (len(row) == 1 and not row[0].strip())


def _places(
    name: str, header: Sequence[str], columns: Sequence[str], optional: Sequence[str]
) -> tuple[int, ...]:
    """Indices of the requested columns in the header."""
    twice = [x for i, x in enumerate(header) if x and x in header[:i]]
    if twice:
        raise _error(name, 1, f"the header has the column {twice[0]!r} twice; rename one.")
    missing = [x for x in columns if x not in header]
    if missing:
        listed = ", ".join(map(repr, header))[:200] or "nothing"
        raise _error(
            name,
            1,
            f"the header has no column {missing[0]!r}; it must name {', '.join(columns)}, "
            f"separated by commas, and has {listed}.",
        )
    return tuple(header.index(x) for x in (*columns, *optional) if x in header)


def _check_widths(name: str, first: int, rows: list[list[str]], width: int) -> None:
    if set(map(len, rows)) == {width}:
        return
    i = next(i for i, row in enumerate(rows) if len(row) != width)
    if _is_empty(rows[i]):
        raise _error(name, first + i, "is empty; remove it.")
    raise _error(name, first + i, f"has {len(rows[i])} fields, and the header {width}.")


def _picked(name: str, first: int, rows: list[list[str]], place: tuple[int, ...]) -> Lines:
    fields = list(map(itemgetter(*place), rows))
    times = Counter(fields)
    texts = list(chain.from_iterable(times))
    if list(map(str.strip, texts)) != texts:
        fields = list(map(_stripped, fields))
        times = Counter(fields)
    return Lines(name, first, fields, times)


def _check_fields(lines: Lines, columns: Sequence[str]) -> None:
    header = tuple(columns)
    if header in lines.times:
        raise lines.error(header, "this line repeats the header; remove it.")
    if "" in chain.from_iterable(lines.times):
        fields = next(x for x in lines.times if "" in x)
        raise lines.error(fields, f"the field of column {columns[fields.index('')]!r} is empty.")
