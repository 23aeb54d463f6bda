"""Transition logs and state labels in CSV tables, read with bounded memory."""

from __future__ import annotations

import csv
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from jaxltl.core import validation
from jaxltl.core.models import MDP, DenseMDP, SparseMDP, TransitionCounts, make_counts, to_sparse
from jaxltl.core.models.construct.counts import in_order, listed, place_of, places
from jaxltl.io.files import streamed

_COUNT = re.compile(r"[0-9]{1,16}")
_MAX_COUNT = 2**53  # transitions
_MAX_BYTES = 2**16  # bytes of a line
_JUNK = re.compile(rb"[\x00-\x08\x0b-\x1f\x7f]")  # of no text; a tab may stand in one
_BOM = b"\xef\xbb\xbf"

Fields = tuple[str, ...]


@dataclass(slots=True)
class _LogRecord:
    """Equal lines of a log: the first one, its count, and how often it occurs."""

    line: int
    count: int
    repeats: int = 0


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
    name, total = str(path), 0
    record_of: dict[Fields, _LogRecord] = {}
    for line, fields in read_columns(path, columns, count):
        if (record := record_of.get(fields)) is None:
            digits = fields[-1]
            if not _COUNT.fullmatch(digits) or int(digits) > _MAX_COUNT:
                message = f"the count is {digits[:60]!r}; expected an integer from 0 to 2^53."
                raise _error(name, line, message)
            record = record_of[fields] = _LogRecord(line, int(digits))
        record.repeats += 1
        total += record.count
        if total > _MAX_COUNT:
            raise _error(name, line, "counts add up to more than 2^53 up to here.")
    times: dict[Fields, int] = {}
    line_of: dict[Fields, int] = {}  # the first line of each transition, in order
    for (*transition, _), record in record_of.items():
        key = tuple(transition)
        times[key] = times.get(key, 0) + record.count * record.repeats
        line_of.setdefault(key, record.line)
    if not times:
        raise _error(name, 2, "there is no transition after the header.")
    columns_of_names = list(zip(*times, strict=True))
    state_names = _names("states", states, columns_of_names[0] + columns_of_names[2])
    action_names = _names("actions", actions, columns_of_names[1])
    kinds = ("state", state_names), ("action", action_names), ("state", state_names)
    table = []
    for (kind, names), column in zip(kinds, columns_of_names, strict=True):
        index = {x: i for i, x in enumerate(names)}
        for x, line in zip(column, line_of.values(), strict=True):
            if x not in index:
                raise _error(name, line, _unknown(kind, x, names))
        table.append(np.array([index[x] for x in column]))
    if support is not None and (wrong := place_of(support, *table)[1]):
        line = list(line_of.values())[wrong[0]]
        raise _error(name, line, f"the model does not have it: {wrong[1]}.")
    state, action, successor = table
    counts = np.array(list(times.values()))
    return make_counts(state, action, successor, counts, states=state_names, actions=action_names)


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
    name = str(path)
    allowed = None if states is None else _names("states", states, ())
    states_of_label: dict[str, dict[str, bool]] = {}
    for line, (state, label) in read_columns(path, columns):
        if allowed is not None and state not in allowed:
            raise _error(name, line, _unknown("state", state, list(allowed)))
        states_of_label.setdefault(label, {})[state] = True
    if not states_of_label:
        raise _error(name, 2, "there is no label after the header.")
    return {label: tuple(some) for label, some in states_of_label.items()}


def _check_columns(columns: Sequence[str], number: int) -> None:
    names = validation.sequence("columns", columns)
    different = all(isinstance(x, str) for x in names) and len(set(names)) == number
    if isinstance(columns, str) or len(names) != number or not different:
        raise ValueError(
            f"columns={validation.shorten(columns)}; give {number} names, all different."
        )


def _names(kind: str, names: Sequence[str] | None, used: Sequence[str]) -> Fields:
    """The given names, or those that are used, in order."""
    if names is None:
        return in_order(set(used))
    return tuple(map(str, validation.sequence(kind, names)))


def _unknown(kind: str, name: str, names: Sequence[str]) -> str:
    return f"there is no {kind} {name!r}; there are {listed(names)}."


def _error(name: str, line: int, message: str) -> ValueError:
    return ValueError(f"{name!r}, line {line}: {message}")


def read_columns(
    path: str | os.PathLike[str], columns: Sequence[str], count: str | None = None
) -> Iterator[tuple[int, Fields]]:
    """Line numbers and fields of the requested columns of a UTF-8 CSV table with a header.

    Fields may be quoted, and blanks around them are removed, but not those inside quotes. A column of
    counts is appended, of ones if the table has none. Lines of equal fields are checked once, and
    share a tuple.
    """
    name, number, empty = str(path), 0, 0
    distinct: dict[Fields, Fields] = {}
    header: Fields = ()
    text = ""

    def lines() -> Iterator[str]:
        nonlocal text
        for text in _lines(path):  # noqa: UP028
            yield text  # while `text` is the line that is read

    reader = csv.reader(lines(), strict=True, skipinitialspace=True)
    try:
        for number, row in enumerate(reader, 1):
            if reader.line_num > number:
                raise _error(name, number, "a quote is not closed on its line.")
            has_quotes = '"' in text
            if has_quotes:
                row = _stripped(text, row)
            if number == 1:
                header = tuple(row) if has_quotes else tuple(map(str.strip, row))
                _check_header(name, header, columns)
                wanted = (*columns, count) if count in header else tuple(columns)
                picked = itemgetter(*(header.index(x) for x in wanted))
                suffix = ("1",) if count and count not in header else ()
            elif len(row) < 2 and not "".join(row).strip():
                empty = empty or number
            elif empty:
                raise _error(name, empty, "is empty; remove it.")
            elif len(row) != len(header):
                message = f"has {len(row)} fields, and the header {len(header)}."
                raise _error(name, number, message)
            elif (
                fields := distinct.get(key := (*picked(row), '"') if has_quotes else picked(row))
            ) is None:
                fields = key[:-1] if has_quotes else tuple(map(str.strip, key))
                if fields == wanted:
                    raise _error(name, number, "this line repeats the header; remove it.")
                if "" in fields:
                    column = wanted[fields.index("")]
                    raise _error(name, number, f"the field of column {column!r} is empty.")
                distinct[key] = fields = fields + suffix
                yield number, fields
            else:
                yield number, fields
    except csv.Error as error:
        raise _error(name, number + 1, f"{error}.") from None
    if not number:
        raise _error(name, 1, f"the file is empty; it should begin with {','.join(columns)}.")


_FIELD = re.compile(r'(?:^|,) *("(?:[^"]|"")*"|[^,]*)')


def _stripped(line: str, row: list[str]) -> list[str]:
    """The fields of a line without the blanks around them; those inside quotes are kept."""
    fields = _FIELD.findall(line)
    return [x if y.startswith('"') else x.strip() for x, y in zip(row, fields, strict=True)]


def _check_header(name: str, header: Fields, columns: Sequence[str]) -> None:
    if twice := [x for i, x in enumerate(header) if x and x in header[:i]]:
        raise _error(name, 1, f"the header has the column {twice[0]!r} twice; rename one.")
    if missing := [x for x in columns if x not in header]:
        present = ", ".join(map(repr, header))[:200] or "nothing"
        raise _error(
            name,
            1,
            f"the header has no column {missing[0]!r}; it must name {', '.join(columns)}, "
            f"separated by commas, and has {present}.",
        )


def _lines(path: str | os.PathLike[str]) -> Iterator[str]:
    """Lines of a text file without their ends, checked for length and encoding."""
    name, number, held = str(path), 1, b""
    for part in streamed(path):
        data = (held + part).replace(b"\r\n", b"\n")
        *whole, held = data.split(b"\n")
        yield from _decoded(name, number, whole)
        number += len(whole)
        if len(held) > _MAX_BYTES:
            break
    yield from _decoded(name, number, [held] if held else [])


def _decoded(name: str, first: int, lines: list[bytes]) -> Iterator[str]:
    data = b"\n".join(lines)
    if first == 1:
        data = data.removeprefix(_BOM)

    def error(place: int, message: str) -> ValueError:
        return _error(name, first + data.count(b"\n", 0, place), message)

    if max(map(len, lines), default=0) > _MAX_BYTES:
        long = next(i for i, line in enumerate(lines) if len(line) > _MAX_BYTES)
        raise _error(name, first + long, f"is longer than {_MAX_BYTES} bytes.")
    if junk := _JUNK.search(data):
        raise error(junk.start(), f"byte {junk[0][0]:#x} is not text; expected a table.")
    try:
        return iter(data.decode().split("\n") if lines else [])
    except UnicodeDecodeError as problem:
        byte = data[problem.start]
        raise error(problem.start, f"byte {byte:#x} is not UTF-8 text; expected a table.") from None
