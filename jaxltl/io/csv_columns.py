"""Streaming reader of CSV tables with bounded memory."""

from __future__ import annotations

import csv
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from operator import itemgetter

from jaxltl.io.files import streamed

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
