"""Parsing of interval probabilities ``[0.4, 0.6]`` and point rewards ``[1, 1]`` in text formats."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from jaxltl.core.models.interval import ROW_SUM_TOLERANCE
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.io.tokens import TokenBlock, Text, as_double, edges

EXPECTED = "a probability or an interval [l, u] with 0 <= l <= u <= 1"
_TO_BLANKS = bytes.maketrans(b"[,]", b"   ")
_NUMBER = rb"[\x00-\x09\x0b-\x20]*[^][,\x00-\x20]+[\x00-\x09\x0b-\x20]*"  # tokens end at any blank
_LINES = re.compile(rb"(?:(?:\[%b,%b\]|[^][,\x00-\x20]+)\n)*+" % (_NUMBER, _NUMBER))
# Line of a state or an action with bracketed rewards.
_REWARDS = re.compile(
    rb"^([ \t]*(?:state|action)[ \t]+\S+[ \t]*\[)"
    rb"((?:[^\"\n\[\]]*\[[^\"\n\[\]]*\])+[^\"\n\[\]]*)(\])",
    re.MULTILINE,
)
_POINT = re.compile(rb"\[([^\[\],]*),([^\[\],]*)\]")


def has_bracket(block: TokenBlock, token: Integers) -> bool:
    """True if any of the tokens starts with a bracket."""
    return bool((block.data[block.start[token]] == ord("[")).any())


def joined_brackets(block: TokenBlock, column: int, lines: Booleans | None = None) -> TokenBlock:
    """Merges the tokens of each bracketed interval in a column; `lines` restricts the lines."""
    looked_at = block.count > column
    if lines is not None:
        looked_at &= lines
    at = block.first[:-1][looked_at] + column
    at = at[block.data[block.start[at]] == ord("[")]
    closing = np.flatnonzero(block.data[block.end - 1] == ord("]"))
    if not at.size or not closing.size:
        return block
    place = np.searchsorted(closing, at)
    last = closing[np.minimum(place, closing.size - 1)]
    line = np.searchsorted(block.first, at, "right") - 1
    closes = (place < closing.size) & (last < block.first[line + 1])
    at, last, line = at[closes], last[closes], line[closes]
    end, first = block.end.copy(), block.first.copy()
    end[at] = block.end[last]
    inner = np.zeros(end.size + 1, np.int64)  # 1 on the second to last token of a bracket
    np.add.at(inner, at + 1, 1)
    np.add.at(inner, last + 1, -1)
    outer = inner.cumsum()[:-1] == 0
    count = block.count
    count[line] -= last - at
    first[1:] = count.cumsum()
    return replace(block, start=block.start[outer], end=end[outer], first=first)


def intervals(block: TokenBlock, token: Integers) -> tuple[Floats, Floats]:
    """Lower and upper bounds of tokens ``p`` or ``[l, u]``: ``float64[...]`` twice."""
    joined = block.joined(token)
    ends = (block.end[token] - block.start[token] + 1).cumsum()
    joined[ends - 1] = ord("\n")
    text = joined.tobytes()
    if _LINES.fullmatch(text) is None:
        tokens = text.split(b"\n")
        bad = next(i for i, x in enumerate(tokens) if not _LINES.fullmatch(x + b"\n"))
        raise block.error(int(token[bad]), EXPECTED)
    data = np.frombuffer(text.translate(_TO_BLANKS), np.uint8)
    is_pair = joined[np.append(0, ends[:-1])] == ord("[")
    first = np.concatenate([[0], (1 + is_pair).cumsum()])
    line = block.line[np.searchsorted(block.first, token, "right") - 1]
    numbers = TokenBlock(block.text, data, *edges(data), first, line)
    lower = numbers.floats(first[:-1], EXPECTED)
    upper = numbers.floats(first[1:] - 1, EXPECTED) if is_pair.any() else lower
    block.require(
        (lower >= 0) & (lower <= upper) & (upper <= 1 + ROW_SUM_TOLERANCE), token, EXPECTED
    )
    return lower, upper


def point_rewards(text: Text) -> Text:
    """Replaces point intervals in rewards, ``[[1, 1], 0]``, by numbers, ``[1, 0]``."""

    def changed(match: re.Match[bytes]) -> bytes:
        return match[1] + _POINT.sub(lambda point: _point(text, match, point), match[2]) + match[3]

    data = _REWARDS.sub(changed, text.data[text.begin : text.stop])
    return Text(text.name, data, 0, len(data), text.line)


def _point(text: Text, match: re.Match[bytes], point: re.Match[bytes]) -> bytes:
    lower, upper = point[1].strip(), point[2].strip()
    if lower == upper or (as_double(lower) == as_double(upper) and as_double(lower) is not None):
        return lower
    line = text.line + match.string.count(b"\n", 0, match.start())
    raise text.error(
        line,
        f"the reward {point[0][:60].decode(errors='replace')} is an interval; single numbers, or "
        "intervals of one point, are read.",
    )


def first_invalid_sum(total: Floats) -> tuple[int, str, str] | None:
    """First choice with an infeasible sum ``[R]`` or ``[R, 2]``, subject and problem; or None."""
    ends = total.reshape(len(total), -1)
    above, below = ends[:, 0] > 1 + ROW_SUM_TOLERANCE, ends[:, -1] < 1 - ROW_SUM_TOLERANCE
    if not (above | below).any():
        return None
    row = int((above | below).argmax())
    if total.ndim == 1:
        return row, "the probabilities", f"sum to {total[row]:.9g}; expected 1"
    bound, side, place = ("lower", "most", 0) if above[row] else ("upper", "least", 1)
    return row, f"the {bound} ends", f"sum to {ends[row, place]:.9g}; expected at {side} 1"
