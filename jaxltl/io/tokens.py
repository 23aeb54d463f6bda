"""Vectorised tokenizer of text files, in blocks of whole lines of a few megabytes.

Bytes up to the blank separate tokens; lines end with a line feed.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.rows import concatenated_ranges

_SIZE = 2**22  # bytes of a block
_LONGEST = 10_000  # bytes of a number
_DECIMAL = re.compile(rb"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?")
_RATIONAL = re.compile(rb"([+-]?\d+)/(\d+)")
_INFINITE = re.compile(rb"([+-]?)inf(?:inity)?", re.IGNORECASE)


@dataclass(frozen=True)
class Text:
    """Byte range ``[begin, stop)`` of a text file, starting at line number `line`."""

    name: str
    data: bytes
    begin: int
    stop: int
    line: int = 1

    def error(self, line: int, message: str) -> ValueError:
        return ValueError(f"{self.name!r}, line {line}: {message}")

    def first_line(self, comment: bytes) -> tuple[bytes, int, Text]:
        """First non-empty line without comments, its number, and the remaining text."""
        place, line = self.begin, self.line
        while place < self.stop:
            end = self.data.find(b"\n", place, self.stop) + 1 or self.stop
            content = self.data[place:end].strip()
            place, line = end, line + 1
            if content and not content.startswith(comment):
                return content, line - 1, Text(self.name, self.data, place, self.stop, line)
        return b"", line, Text(self.name, self.data, self.stop, self.stop, line)

    def blocks(self, comment: bytes) -> Iterator[TokenBlock]:
        """Blocks of lines, without empty lines and comment lines."""
        place, line = self.begin, self.line
        while place < self.stop:
            cut = self.stop
            if self.stop - place > _SIZE:
                cut = self.data.rfind(b"\n", place, place + _SIZE) + 1
                cut = cut or self.data.find(b"\n", place + _SIZE, self.stop) + 1 or self.stop
            block, count = _block(
                self, np.frombuffer(self.data, np.uint8, cut - place, place), line, comment
            )
            if block.num_lines:
                yield block
            place, line = cut, line + count


@dataclass(frozen=True)
class TokenBlock:
    """Tokens of consecutive lines."""

    text: Text  # their source
    data: NDArray[np.uint8]  # bytes, uint8[B], the last of which is blank
    start: Integers  # start, end: offsets of the tokens, int[N]
    end: Integers
    first: Integers  # first token of each line, int[L + 1]
    line: Integers  # line numbers in the file, int[L]

    @property
    def num_lines(self) -> int:
        return self.line.size

    @property
    def count(self) -> Integers:
        return np.diff(self.first)

    def error(self, token: int, expected: str) -> ValueError:
        actual = (
            self.data[self.start[token] : self.end[token]][:60].tobytes().decode(errors="replace")
        )
        if actual.startswith("[") and "[" not in expected:
            expected = f"{expected}, no interval,"
        line = int(np.searchsorted(self.first, token, "right")) - 1
        return self.text.error(
            int(self.line[line]), f"{actual!r} stands where {expected} is expected."
        )

    def whole(self, line: int) -> bytes:
        begin, end = self.start[self.first[line]], self.end[self.first[line + 1] - 1]
        return self.data[begin:end].tobytes()

    def joined(self, token: Integers) -> NDArray[np.uint8]:
        """Bytes of the tokens, each followed by a blank."""
        length = self.end[token] - self.start[token] + 1
        joined = self.data[concatenated_ranges(self.start[token], length)]
        joined[length.cumsum() - 1] = 32
        return joined

    def texts(self, token: Integers) -> list[bytes]:
        return self.joined(token).tobytes().split(b" ")[:-1]

    def integers(self, token: Integers, expected: str, below: int = 2**31 - 1) -> Integers:
        """Tokens as integers in ``[0, below)``, ``int32[...]``."""
        joined = self.joined(token)
        length = self.end[token] - self.start[token]
        texts = joined.tobytes().split(b" ")[:-1]
        if not _DIGIT[joined].all() or not length.all():
            bad = next(i for i, x in enumerate(texts) if not x.isdigit())
            raise self.error(int(token[bad]), expected)
        expected = f"{expected} below {below}"
        self.require(length <= 18, token, expected)
        values = np.fromiter(map(int, texts), np.int64, len(texts))
        self.require(values < below, token, expected)
        return values.astype(np.int32)

    def floats(
        self, token: Integers, expected: str, other: Callable[[bytes], float | None] | None = None
    ) -> Floats:
        """Tokens as doubles: decimals, fractions, infinity; `other` parses further forms."""
        joined = self.joined(token)
        longest = int((self.end[token] - self.start[token]).max(initial=0))
        if longest <= _LONGEST and _DECIMAL_BYTE[joined].all():
            texts = joined.tobytes().split(b" ")[:-1]
            try:
                values: Floats = np.fromiter(map(float, texts), np.float64, len(texts))
                if np.isfinite(values).all():
                    return values
            except ValueError:
                pass
        values, value_of_text = np.empty(token.size), {}
        for i, text in enumerate(self.texts(token)):
            if text not in value_of_text:
                number = as_double(text)
                if number is None and other is not None:
                    number = other(text)
                if number is None:
                    raise self.error(int(token[i]), expected)
                value_of_text[text] = number
            values[i] = value_of_text[text]
        return values

    def probabilities(
        self, token: Integers, other: Callable[[bytes], float | None] | None = None
    ) -> Floats:
        values = self.floats(token, "a probability", other)
        self.require((values >= 0) & (values <= 1 + 1e-6), token, "a probability from 0 to 1")
        return values

    def columns(self, width: int, more: int, form: str) -> Integers:
        """First tokens of the lines, each of which must have `width` to ``width + more`` tokens."""
        self.require_form((self.count >= width) & (self.count <= width + more), form)
        return self.first[:-1]

    def require(self, valid: Booleans, token: Integers, expected: str) -> None:
        """Raises ValueError for the first invalid token."""
        if not valid.all():
            raise self.error(int(token[int(valid.argmin())]), expected)

    def require_form(self, valid: Booleans, form: str, lines: Integers | None = None) -> None:
        """Raises ValueError for the first malformed line; `lines` are the checked ones."""
        if not valid.all():
            i = int(valid.argmin())
            raise self.malformed(i if lines is None else int(lines[i]), form)

    def malformed(self, line: int, form: str) -> ValueError:
        actual = self.whole(line)[:60].decode(errors="replace")
        return self.text.error(int(self.line[line]), f"{actual!r}; expected {form}.")


def as_double(text: bytes) -> float | None:
    """Nearest double of a decimal, fraction or infinity; None for other text."""
    if len(text) > _LONGEST:
        return None
    if _DECIMAL.fullmatch(text):
        number = float(text)
        return None if number in (np.inf, -np.inf) else number
    if match := _RATIONAL.fullmatch(text):
        try:
            return int(match[1]) / int(match[2])  # correctly rounded for integers of any length
        except (ZeroDivisionError, OverflowError, ValueError):
            return None
    if match := _INFINITE.fullmatch(text):
        return -np.inf if match[1] == b"-" else np.inf
    return None


def as_fraction(text: bytes) -> Fraction | None:
    """Exact value of a decimal; None for other text and for exponents beyond those of doubles."""
    match = _DECIMAL.fullmatch(text) if len(text) <= _LONGEST else None
    exponent = re.search(rb"[eE]([+-]?\d+)", text)
    if match is None or (exponent and (len(exponent[1]) > 4 or abs(int(exponent[1])) > 400)):
        return None
    try:
        return Fraction(text.decode())
    except ValueError:  # more digits than Python reads
        return None


def numbered(texts: list[bytes], index_of_name: dict[bytes, int]) -> Integers:
    """Indices of names, ``int32``; adds new names to `known`."""
    indices = (index_of_name.setdefault(text, len(index_of_name)) for text in texts)
    return np.fromiter(indices, np.int32, len(texts))


def decoded(text: Text, names: dict[bytes, int]) -> list[str]:
    """Names as text; ValueError for bytes that are not UTF-8."""
    try:
        return [name.decode() for name in names]
    except UnicodeDecodeError as error:
        line = text.data.count(b"\n", 0, max(text.data.find(error.object), 0)) + 1
        raise text.error(line, f"the name {error.object[:60]!r} is not UTF-8.") from None


def joined_lines(form: str, *columns: Iterable[object]) -> bytes:
    """Formats lines with one entry of each column."""
    return "".join(map(form.__mod__, zip(*columns, strict=True))).encode()


def bytes_of(allowed: bytes) -> Booleans:
    """Membership table ``bool[256]`` of some bytes."""
    table = np.zeros(256, bool)
    table[list(allowed)] = True
    return table


_DIGIT = bytes_of(b"0123456789 ")
_DECIMAL_BYTE = bytes_of(b"0123456789+-.eE ")


def edges(data: NDArray[np.uint8]) -> tuple[Integers, Integers]:
    """Start and end offsets of tokens; the last byte must be blank."""
    blank = np.ones(data.size + 1, bool)
    np.less_equal(data, 32, out=blank[1:])
    edge = np.flatnonzero(blank[1:] != blank[:-1])
    return edge[::2], edge[1::2]


def _block(
    text: Text, data: NDArray[np.uint8], line: int, comment: bytes
) -> tuple[TokenBlock, int]:
    """Tokenizes a block; also returns its number of lines in the file."""
    if data[-1] > 32:
        data = np.append(data, np.uint8(10))
    start, end = edges(data)
    is_end = data == 10
    of = np.cumsum(is_end, dtype=np.int32)[start]
    first = np.flatnonzero(np.diff(of, prepend=-1))
    skipped = np.ones(first.size, bool)
    for i, sign in enumerate(comment):
        skipped &= data[np.minimum(start[first] + i, data.size - 1)] == sign
    count = np.diff(first, append=start.size)
    if skipped.any():
        words = np.repeat(~skipped, count)
        start, end, count = start[words], end[words], count[~skipped]
    numbers = line + of[first][~skipped].astype(np.int64)
    starts = np.concatenate([[0], count.cumsum()])
    return TokenBlock(text, data, start, end, starts, numbers), int(is_end.sum())


def label_matrix(text: Text, num_states: int, num_labels: int) -> Booleans:
    """Zero label matrix ``bool[S, P]``; ValueError if it is out of proportion to the text."""
    if num_states * num_labels > 64 * (text.stop - text.begin) + 2**28:
        refuse(
            text.name,
            f"{num_labels} labels of {num_states} states would take "
            f"{num_states * num_labels / 2**30:.0f} GB.",
        )
    return np.zeros((num_states, num_labels), bool)


def split_init(
    text: Text, holds: Booleans, names: list[str]
) -> tuple[Booleans, tuple[str, ...], Floats]:
    """Separates the label "init": other labels, their names, and the initial distribution."""
    if "init" not in names:
        refuse(text.name, "no state has the label 'init'; expected at least one initial state.")
    column = names.index("init")
    initial = holds[:, column].astype(np.float64)
    if not initial.any():
        refuse(text.name, "no state has the label 'init'; expected at least one initial state.")
    rest = tuple(names[:column] + names[column + 1 :])
    return np.delete(holds, column, 1), rest, initial / initial.sum()


def truncated(announced: int, count: int, items: str) -> str:
    """Message for a wrong number of items."""
    return f"{announced} {items} are announced and {count} follow; the file is cut or changed."


def refuse(name: str, message: str) -> NoReturn:
    """Raises ValueError with the name of the file."""
    raise ValueError(f"{name!r}: {message}")
