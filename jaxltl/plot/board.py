"""The cells of a map as places that can be filled, framed and moved between."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Circle, Polygon, Rectangle
from numpy.typing import NDArray

from jaxltl.envs.gridworld import parse_map
from jaxltl.plot.style import (
    _STEPS,
    FAINT,
    INK,
    MUTED,
    PAPER,
)

_TURNS = {**_STEPS, "stay": (0, 0)}

_ROBOT, _LOSES, _WALL = "#c2571a", "#ead0cb", "#55606c"


class _Board(NamedTuple):
    """The cells of a game's map, and where its C places lie."""

    cells: NDArray[np.str_]
    places: NDArray[np.int_]  # [C, 2], row and column from 0 at the top left
    wall: str


def _board(board: int | str, wall: str) -> _Board:
    if isinstance(board, str):
        cells = parse_map(board)
        return _Board(cells, np.argwhere(cells != wall), wall)
    row, column = np.divmod(np.arange(board * board), board)  # numbered from the lower left
    places = np.stack([board - 1 - row, column], axis=-1)
    return _Board(np.full((board, board), "."), places, wall)


def _fill(axes: Axes, world: _Board, colors: Sequence[str], lines: str = PAPER) -> None:
    """A colour for each place, and the names of cells in their corners."""
    for (row, column), color in zip(world.places, colors, strict=True):
        axes.add_patch(Rectangle((column, row), 1, 1, facecolor=color, lw=0))
        kind = world.cells[row, column]
        if kind not in (".", world.wall) and max(world.cells.shape) <= 16:
            axes.text(column + 0.07, row + 0.07, kind, ha="left", va="top", fontsize=6.5,
                      color=MUTED, weight="bold", parse_math=False, zorder=5)
    _frame(axes, world, lines)


def _frame(axes: Axes, world: _Board, color: str = PAPER) -> None:
    rows, columns = world.cells.shape
    for row, column in np.argwhere(world.cells == world.wall):
        axes.add_patch(Rectangle((column, row), 1, 1, facecolor=_WALL, lw=0))
    lines = [((0, r), (columns, r)) for r in range(rows + 1)]
    lines += [((c, 0), (c, rows)) for c in range(columns + 1)]
    axes.add_collection(LineCollection(lines, colors=color, linewidths=0.6, zorder=2))
    axes.set(xlim=(0, columns), ylim=(rows, 0), aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color=FAINT, lw=0.8)


def _robot(axes: Axes, world: _Board, place: int) -> None:
    row, column = world.places[place]
    axes.add_patch(Circle((column + 0.5, row + 0.5), 0.3, facecolor=_ROBOT, lw=0, zorder=5))


def _moves(
    axes: Axes, world: _Board, mask: NDArray[np.bool_], actions: Sequence[str],
    dark: NDArray[np.bool_] | None = None, *, hollow: bool = False, scale: float = 1.0,
) -> None:
    """A triangle towards each neighbour that a mask allows, and a dot for staying."""
    for place, a in np.argwhere(mask):
        # Above the environment's robot, whose cell may be shared.
        color = PAPER if dark is not None and dark[place] else INK
        face, edge = ("none", MUTED) if hollow else (color, "none")
        row, column = world.places[place]
        center, step = np.array([column + 0.5, row + 0.5]), np.array(_TURNS[actions[a]], float)
        if not step.any():
            axes.add_patch(Circle(tuple(center), 0.09 * scale, facecolor=face, edgecolor=edge,
                                  lw=0.7, zorder=6))
            continue
        side = step[::-1] * 0.12 * scale
        base, tip = center + step * 0.18, center + step * (0.18 + 0.24 * scale)
        axes.add_patch(Polygon([base + side, tip, base - side], facecolor=face, edgecolor=edge,
                               lw=0.7, zorder=6))
