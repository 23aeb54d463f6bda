"""Cell kinds of coloured worlds: objects and obstacles, defined by colours around a cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core import validation

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
    num = validation.integer("num", num, limit=len(pairs))
    return {f"o{i + 1}": {a: 5, b: 4} for i, (a, b) in enumerate(pairs[:num])}


def make_kinds(objects: Counts, obstacles: Counts) -> Kinds:
    """Validated cell kinds: names with colour counts."""
    kinds: dict[str, tuple[int, ...]] = {}
    for name, counts in [*objects.items(), *obstacles.items()]:
        if name in kinds:
            raise ValueError(f"{name!r} is both an object and an obstacle; rename one of them.")
        for color, count in counts.items():
            validation.choice(f"{name}: color", color, COLORS)
            validation.integer(f"{name}: {color}", count)
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


def check_colors(colors: ArrayLike, margin: int) -> NDArray[np.int32]:
    """Validated colours ``int32[rows, columns]`` with at least one cell inside the margin."""
    array = np.asarray(colors)
    validation.integer("margin", margin, least=1)
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


# --- planned kinds -----------------------------------------------------------------------------


_ROUNDS = 10_000


def plan_map(
    plan: Mapping[str, Sequence[tuple[int, int]]], kinds: Kinds, shape: tuple[int, int]
) -> NDArray[np.int32]:
    """Kind of each cell from a plan with cells numbered from 1; -1 for none."""
    names = [name for name, _ in kinds]
    kind = np.full(shape, -1, np.int32)
    for name, cells in plan.items():
        if name not in names:
            raise ValueError(f"plan: {name!r} is no kind of cell; there are {', '.join(names)}.")
        for row, column in cells:
            if not (1 <= row <= shape[0] and 1 <= column <= shape[1]):
                raise ValueError(
                    f"plan: {name} in cell {(row, column)} is outside the grid; rows are 1 to "
                    f"{shape[0]}, columns 1 to {shape[1]}."
                )
            if kind[row - 1, column - 1] >= 0:
                raise ValueError(f"plan: cell {(row, column)} is used twice.")
            kind[row - 1, column - 1] = names.index(name)
    return kind


def stamps_of(kinds: Kinds) -> list[NDArray[np.int64]]:
    """One 3 x 3 patch per kind."""
    order = np.array([4, 0, 2, 6, 8, 1, 3, 5, 7])  # centre, corners, and the rest
    stamps = []
    for _, counts in kinds:
        frequent = sorted(range(len(counts)), key=lambda c: -counts[c])
        patch = np.empty(9, np.int64)
        patch[order] = np.repeat(frequent, [counts[c] for c in frequent])
        stamps.append(patch.reshape(3, 3))
    return stamps


def planned(kind: NDArray[np.int32], kinds: Kinds) -> NDArray[np.int64]:
    """Colours of a map of kinds: patches, and free cells elsewhere; ValueError if patches conflict."""
    patches = stamps_of(kinds)
    colors = np.full((kind.shape[0] + 2, kind.shape[1] + 2), FREE)
    for row, column in np.argwhere(kind >= 0).tolist():
        if not _stamp(colors, patches[kind[row, column]], row, column):
            raise ValueError(
                f"the patch of {kinds[kind[row, column]][0]} in cell {(row + 1, column + 1)} "
                "overlaps with another that wants other colours; plan them 3 cells apart."
            )
    actual = find_kinds(colors, codes_of(kinds))
    for row, column in np.argwhere(actual != kind)[:1]:
        raise ValueError(
            f"cell {(int(row) + 1, int(column) + 1)} would be {kinds[actual[row, column]][0]}, "
            "which the plan does not say: the patches around it leave no choice. Add it, or "
            "move them."
        )
    return colors


def _stamp(colors: NDArray[np.int64], stamp: NDArray[np.int64], row: int, column: int) -> bool:
    """Writes a patch around a cell, unless a cell there has another colour already."""
    patch = colors[row : row + 3, column : column + 3]
    if ((patch != FREE) & (patch != stamp)).any():
        return False
    patch[:] = stamp
    return True


def filled(
    random: np.random.Generator,
    colors: NDArray[np.int64],
    kind: NDArray[np.int32],
    codes: NDArray[np.int64],
    margin: int,
) -> NDArray[np.int64]:
    """Random colours for free cells and the margin that create no unplanned kind."""
    free = colors == FREE
    again = free
    for _ in range(_ROUNDS):
        colors[again] = random.integers(len(COLORS), size=int(again.sum()))
        wrong = np.argwhere(find_kinds(colors, codes) != kind)
        if not len(wrong):
            break
        again = np.zeros_like(free)
        for row, column in wrong:
            again[row : row + 3, column : column + 3] = True
        again &= free
    else:
        raise ValueError(
            f"no colours were found in {_ROUNDS} rounds that make only what is planned; plan "
            "fewer objects and obstacles, or give them rarer colours."
        )
    for _ in range(margin - 1):
        ring = random.integers(len(COLORS), size=(colors.shape[0] + 2, colors.shape[1] + 2))
        ring[1:-1, 1:-1] = colors
        colors = ring
    return colors


@dataclass(frozen=True)
class Placement:
    """Kinds to place on a map: objects first, then obstacles."""

    shape: tuple[int, int]
    counts: Sequence[int]  # the number of cells of each kind
    distances: Sequence[int]  # of each kind from objects
    num_objects: int
    stamps: list[NDArray[np.int64]]
    codes: NDArray[np.int64]


def placed(
    random: np.random.Generator, placement: Placement
) -> tuple[NDArray[np.int64], NDArray[np.int32]] | None:
    """Patches in random cells with their kinds, or None if they do not fit."""
    rows, columns = placement.shape
    colors = np.full((rows + 2, columns + 2), FREE)
    kind = np.full(placement.shape, -1, np.int32)
    objects: list[tuple[int, int]] = []
    for i, (count, distance) in enumerate(zip(placement.counts, placement.distances, strict=True)):
        open_ = kind < 0
        for row, column in objects:
            rows_around = slice(max(row - distance + 1, 0), row + distance)
            open_[rows_around, max(column - distance + 1, 0) : column + distance] = False
        for cell in random.permutation(np.flatnonzero(open_)):
            if not count:
                break
            place = divmod(int(cell), columns)
            if _adds(colors, kind, i, place, placement):
                count -= 1
                if i < placement.num_objects:
                    objects.append(place)
        if count:
            return None
    return colors, kind


def _adds(
    colors: NDArray[np.int64],
    kind: NDArray[np.int32],
    number: int,
    place: tuple[int, int],
    placement: Placement,
) -> bool:
    """Stamps a kind around a cell if that creates no other kind."""
    row, column = place
    patch = colors[row : row + 3, column : column + 3]
    before = patch.copy()
    if not _stamp(colors, placement.stamps[number], row, column):
        return False
    kind[row, column] = number
    # Only cells up to two away see the patch.
    top, first_column = max(row - 2, 0), max(column - 2, 0)
    planned = kind[top : row + 3, first_column : column + 3]
    if np.array_equal(
        find_kinds(colors[top : row + 5, first_column : column + 5], placement.codes), planned
    ):
        return True
    patch[:], kind[row, column] = before, -1
    return False
