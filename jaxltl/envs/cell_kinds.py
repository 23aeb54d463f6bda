"""Cell kinds of coloured worlds: objects and obstacles, defined by colours around a cell."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

COLORS = ("red", "yellow", "white", "purple", "black")
OBJECTS: Mapping[str, Mapping[str, int]] = {
    "o1": {"red": 5, "black": 4},
    "o2": {"yellow": 5, "black": 4},
    "o3": {"white": 5, "black": 4},
}
OBSTACLES: Mapping[str, Mapping[str, int]] = {"ob": {"black": 9}}

Counts = Mapping[str, Mapping[str, int]]
Kinds = tuple[tuple[str, tuple[int, ...]], ...]

FREE = -1  # a cell without a colour yet


def many_objects(num: int) -> dict[str, dict[str, int]]:
    """Distinct colour counts for `num` objects ``o1``, ``o2``, ..., at most 16."""
    pairs = [
        (inside, around)
        for around in reversed(COLORS)
        for inside in COLORS
        if inside not in (around, "black")
    ]
    if not 0 <= num <= len(pairs):
        raise ValueError(f"num={num}; there are colours for 0 to {len(pairs)} objects.")
    return {f"o{i + 1}": {a: 5, b: 4} for i, (a, b) in enumerate(pairs[:num])}


def make_kinds(objects: Counts, obstacles: Counts) -> Kinds:
    """Validated cell kinds: names with colour counts."""
    kinds: dict[str, tuple[int, ...]] = {}
    for name, counts in [*objects.items(), *obstacles.items()]:
        if name in kinds:
            raise ValueError(f"{name!r} is both an object and an obstacle; rename one of them.")
        for color, count in counts.items():
            if color not in COLORS:
                raise ValueError(f"{name}: {color!r} is no colour; use {', '.join(COLORS)}.")
            if count < 0:
                raise ValueError(f"{name}: {count} cells of {color}; give 0 or more.")
        row = tuple(int(counts.get(color, 0)) for color in COLORS)
        if sum(row) != 9:
            raise ValueError(f"{name}: {dict(counts)} are {sum(row)} cells; a patch has 9.")
        for other, same in kinds.items():
            if same == row:
                raise ValueError(f"{other} and {name} have the same colours; change one of them.")
        kinds[name] = row
    return tuple(kinds.items())


def _code(counts: ArrayLike) -> NDArray[np.int64]:
    """Colour counts (at most 9 each) as the digits of one number."""
    return np.asarray(counts, np.int64) @ 10 ** np.arange(len(COLORS))


_DIGIT = np.append(10 ** np.arange(len(COLORS)), 10 ** len(COLORS))  # the last: a free cell


def find_kinds(colors: np.ndarray, codes: NDArray[np.int64]) -> NDArray[np.int32]:
    """Kind of each cell by its 3 x 3 patch, -1 for none; undrawn cells have no colour."""
    digit = _DIGIT[colors]
    across = digit[:, :-2] + digit[:, 1:-1] + digit[:, 2:]
    total = across[:-2] + across[1:-1] + across[2:]
    kind = np.full(total.shape, -1, np.int32)
    for i, code in enumerate(codes):
        kind[total == code] = i
    return kind


def categories(
    colors: ArrayLike, *, objects: Counts = OBJECTS, obstacles: Counts = OBSTACLES, margin: int = 1
) -> NDArray[np.int32]:
    """Category ``int32[rows, columns]`` of each cell by the colours of its 3 x 3 patch.

    The index among the objects and then the obstacles, -1 for a distractor. `colors` is
    ``int[rows + 2 * margin, columns + 2 * margin]``, indices into ``COLORS``.
    """
    kinds = make_kinds(objects, obstacles)
    colors = check_colors(colors, margin)
    rows, columns = (slice(margin - 1, n - margin + 1) for n in colors.shape[:2])
    return find_kinds(colors[rows, columns], codes_of(kinds))


def codes_of(kinds: Kinds) -> NDArray[np.int64]:
    """Code of each kind from its colour counts."""
    return _code(np.array([row for _, row in kinds]).reshape(-1, len(COLORS)))


def check_margin(margin: int) -> None:
    """Raises ValueError unless a margin is at least 1."""
    if margin < 1:
        raise ValueError(f"margin={margin}; cells at the border need a ring of at least 1.")


def check_colors(colors: ArrayLike, margin: int) -> NDArray[np.int32]:
    """Validated colours ``int32[rows, columns]`` with at least one cell inside the margin."""
    array = np.asarray(colors)
    check_margin(margin)
    if array.ndim != 2 or min(array.shape) < 2 * margin + 1 or array.dtype.kind not in "iu":
        raise ValueError(
            f"colors have shape {array.shape} and type {array.dtype}; pass integers [rows, "
            f"columns] with a margin of {margin} on each side and a cell inside."
        )
    for row, column in np.argwhere((array < 0) | (array >= len(COLORS)))[:1]:
        raise ValueError(
            f"colors[{row}, {column}] = {array[row, column]}; colours are 0 to {len(COLORS) - 1}."
        )
    return array.astype(np.int32)
