"""Drawing of grid cells: fill, frames, numbers, arrows and robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle, Polygon, Rectangle
from numpy.typing import ArrayLike, NDArray

from jaxltl.envs.text_map import parse_map
from jaxltl.plot.style import FAINT, INK, MUTED, PAPER, SCALE, blank, write

STEPS = {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}
DIRECTIONS = {**STEPS, "stay": (0, 0)}

ROBOT, LOSES, WALL = "#c2571a", "#ead0cb", "#55606c"


class Board(NamedTuple):
    """The cells of a game's map, and the positions of its C places."""

    cells: NDArray[np.str_]
    places: NDArray[np.int_]  # [C, 2], row and column from 0 at the top left
    wall: str


def board_of(board: int | str | Board, wall: str) -> Board:
    """A board from a text map, a number of cells per side, or a board."""
    if isinstance(board, Board):
        return board
    if isinstance(board, str):
        cells = parse_map(board)
        return Board(cells, np.argwhere(cells != wall), wall)
    row, column = np.divmod(np.arange(board * board), board)  # numbered from the lower left
    places = np.stack([board - 1 - row, column], axis=-1)
    return Board(np.full((board, board), "."), places, wall)


def fill_cells(axes: Axes, world: Board, colors: Sequence[str], lines: str = PAPER) -> None:
    """Fills each place with its colour and writes names of cells into corners."""
    for (row, column), color in zip(world.places, colors, strict=True):
        axes.add_patch(Rectangle((column, row), 1, 1, facecolor=color, lw=0))
        kind = world.cells[row, column]
        if kind not in (".", world.wall):
            style = {"ha": "left", "va": "top", "weight": "bold", "zorder": 5}
            write(axes, (column + 0.07, row + 0.07), short_name(kind), 6.5, MUTED, **style)
    frame_cells(axes, world, lines)


def short_name(kind: str) -> str:
    """The name of a cell, cut to five characters."""
    return kind if len(kind) <= 5 else f"{kind[:4]}…"


def frame_cells(axes: Axes, world: Board, color: str = PAPER) -> None:
    """Draws walls and cell borders, and sets the limits of the axes."""
    rows, columns = world.cells.shape
    for row, column in np.argwhere(world.cells == world.wall):
        axes.add_patch(Rectangle((column, row), 1, 1, facecolor=WALL, lw=0))
    rule_cells(axes, rows, columns, color, zorder=2)
    axes.set(xlim=(0, columns), ylim=(rows, 0), aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color=FAINT, lw=0.8)


def rule_cells(
    axes: Axes, rows: int, columns: int, color: str, width: float = 0.6, **options: Any
) -> None:
    """Draws the borders of cells."""
    lines = [((0, r), (columns, r)) for r in range(rows + 1)]
    lines += [((c, 0), (c, rows)) for c in range(columns + 1)]
    axes.add_collection(LineCollection(lines, colors=color, linewidths=width, **options))


def draw_robot(axes: Axes, world: Board, place: int) -> None:
    """Draws the environment's robot in its place."""
    row, column = world.places[place]
    axes.add_patch(Circle((column + 0.5, row + 0.5), 0.3, facecolor=ROBOT, lw=0, zorder=5))


def draw_moves(
    axes: Axes,
    world: Board,
    mask: NDArray[np.bool_],
    actions: Sequence[str],
    colors: Sequence[str] | None = None,
    scale: float = 1.0,
) -> None:
    """Draws an action mask, in colours of places ("none": hollow marks); a dot is staying."""
    for place, a in np.argwhere(mask):
        # Drawn over the environment's robot, which may be in the same cell.
        face = INK if colors is None else colors[place]
        edge = MUTED if face == "none" else "none"
        row, column = world.places[place]
        center, step = np.array([column + 0.5, row + 0.5]), np.array(DIRECTIONS[actions[a]], float)
        if not step.any():
            axes.add_patch(Circle(tuple(center), 0.09 * scale, fc=face, ec=edge, lw=0.7, zorder=6))
            continue
        corners = triangle(center, step, 0.18, 0.18 + 0.24 * scale, 0.12 * scale)
        axes.add_patch(Polygon(corners, facecolor=face, edgecolor=edge, lw=0.7, zorder=6))


def number_cells(axes: Axes, rows: int, columns: int) -> None:
    """Numbers rows and columns from 1."""
    for axis, count in ((axes.xaxis, columns), (axes.yaxis, rows)):
        stride = max(1, count // 10)
        axis.set_ticks(
            np.arange(0, count, stride) + 0.5, labels=[str(i + 1) for i in range(0, count, stride)]
        )
    axes.xaxis.tick_top()
    axes.tick_params(length=0, labelsize=6.5, labelcolor=MUTED, pad=2)
    for spine in axes.spines.values():
        spine.set_visible(False)


def draw_arrows(
    axes: Axes,
    shape: tuple[int, int],
    policy: NDArray[np.float64],
    values: NDArray[np.float64] | None,
    limits: tuple[float, float],
    actions: Sequence[str],
) -> None:
    """Draws a policy: triangles with lengths proportional to the probabilities of the actions."""
    shapes: list[list[NDArray[np.float64]]] = []
    colors: list[str] = []
    for state, chances in enumerate(policy):
        row, column = divmod(state, shape[1])
        dark = values is not None and values[state] < sum(limits) / 2
        for a, chance in enumerate(chances):
            if not chance > 0.04:
                continue
            center, step = np.array([column + 0.5, row + 0.5]), np.array(STEPS[actions[a]], float)
            tip, width = 0.1 + 0.34 * chance, 0.045 + 0.075 * chance
            shapes.append(triangle(center, step, 0.03, tip, width))
            colors.append(PAPER if dark else INK)
    axes.add_collection(PolyCollection(shapes, facecolors=colors, lw=0, alpha=0.92, zorder=4))


def shade_cells(axes: Axes, values: NDArray[np.float64], limits: tuple[float, float]) -> AxesImage:
    """Draws values ``[rows, columns]`` as colours; NaN is blank."""
    return axes.imshow(
        np.ma.masked_invalid(values),
        cmap=SCALE,
        vmin=limits[0],
        vmax=limits[1],
        extent=(0, values.shape[1], values.shape[0], 0),
        interpolation="nearest",
    )


def triangle(
    center: NDArray[np.float64], step: NDArray[np.float64], base: float, tip: float, width: float
) -> list[NDArray[np.float64]]:
    """Corners of an arrow head; `base` and `tip` are distances from the centre."""
    side = step[::-1] * width
    return [center + step * base + side, center + step * tip, center + step * base - side]


def cell_size(shape: tuple[int, ...]) -> float:
    """The size of a cell with arrows, in inches."""
    return float(np.clip(5.2 / max(shape), 0.3, 0.6))


def rows_of_maps(shape: tuple[int, ...], count: int, across: int) -> tuple[Figure, np.ndarray]:
    """A figure with `count` axes for maps, `across` per row."""
    (rows, columns), size = shape, cell_size(shape)
    down = -(-count // across)
    figure = blank(
        max(across * (columns * size + 0.4), 3.4), down * (rows * size + 0.55) + 0.6, padded=True
    )
    every = figure.subplots(down, across, squeeze=False).ravel()
    for axes in every[count:]:
        axes.axis("off")
    return figure, every[:count]


def keep_out_of_layout(axes: Axes) -> None:
    """Excludes artists inside cells from the layout, which saves measuring them."""
    for artist in (*axes.texts, *axes.patches, *axes.collections, *axes.images, *axes.lines):
        artist.set_in_layout(False)


def require_directions(
    actions: Sequence[str], known: Mapping[str, tuple[int, int]] = DIRECTIONS
) -> None:
    """Raises a ValueError for an action without a direction."""
    for name in actions:
        if name not in known:
            raise ValueError(f"action {name!r} has no direction; use {', '.join(known)}.")


def as_mask(policy: ArrayLike, num_actions: int) -> NDArray[np.bool_]:
    """Actions of a policy, or a mask of them, as ``bool[S, A]``."""
    actions = np.asarray(policy)
    if actions.dtype.kind in "iu":
        return np.asarray(actions[:, None] == np.arange(num_actions))
    return actions.astype(bool)
