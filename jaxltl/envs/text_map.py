"""Text maps: one word or character per cell."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def parse_map(text: str) -> np.ndarray:
    """The cells of a text map, ``str[rows, columns]``; ValueError if it is empty or not rectangular.

    One line per row. If any line has spaces inside, cells are words between spaces;
    otherwise each character is a cell. Blank lines are ignored.

    >>> parse_map('''
    ... ..y
    ... b#.
    ... ''').shape
    (2, 3)
    """
    lines = [line.strip() for line in text.strip().splitlines() if line.strip()]
    if not lines:
        raise ValueError("the map is empty; give at least one row of cells.")
    words = any(len(line.split()) > 1 for line in lines)
    rows = [line.split() if words else list(line) for line in lines]
    for i, row in enumerate(rows):
        if len(row) != len(rows[0]):
            raise ValueError(
                f"map row {i + 1} has {len(row)} cells, row 1 has {len(rows[0])}: "
                f"{lines[i]!r}. All rows must have the same length."
            )
    return np.array(rows)


def plain_kind(cells: np.ndarray) -> str:
    """The plain cell kind: ``.``, or the most frequent one."""
    names, counts = np.unique(cells, return_counts=True)
    return "." if "." in names else str(names[np.argmax(counts)])


def cell_observations(cells: np.ndarray, kinds: Sequence[str], radius: int) -> np.ndarray:
    """One-hot kinds of the cells around each cell, ``float[S, (2 radius + 1)^2 (K + 1)]``.

    Observations of a reward network that transfers between maps.

    Args:
      cells: of :func:`parse_map`.
      kinds: the K kinds of cells; the last column of a cell is for places off the map.
      radius: cells around the own one.

    >>> cell_observations(parse_map("a b"), ["a", "b"], 0).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    number = np.full(tuple(n + 2 * radius for n in cells.shape), len(kinds))
    inside = tuple(slice(radius, radius + n) for n in cells.shape)
    number[inside] = np.searchsorted(sorted(kinds), cells)
    order = np.append(np.argsort(kinds), len(kinds))  # from sorted kinds to their places
    width = 2 * radius + 1
    around = np.lib.stride_tricks.sliding_window_view(order[number], (width, width))
    return np.eye(len(kinds) + 1)[around].reshape(cells.size, -1)
