"""Grid maps: values, policies and sets of moves."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike, NDArray

from jaxltl.envs.text_map import parse_map, plain_kind
from jaxltl.plot.board import (
    Board,
    draw_arrows,
    draw_moves,
    fill_cells,
    keep_out_of_layout,
    number_cells,
    require_directions,
    rows_of_maps,
    rule_cells,
    shade_cells,
    short_name,
    STEPS,
    WALL,
)
from jaxltl.plot.style import (
    ACCENT,
    blank,
    FAINT,
    head,
    INK,
    KINDS,
    note,
    PAPER,
    scale_bar,
    SERIES,
    settle,
    value_limits,
    write,
)

if TYPE_CHECKING:
    from jaxltl.core.models.trajectories import Trajectories
    from jaxltl.envs.temporal_gridworld import World

TINY = 16  # cells a side, beyond which they have no room for names and numbers
_HATCH = "#9aa5b1"

# Colours of cells that are named after one.
_NAMED = {"r": "#f0b9b1", "y": "#f7e08e", "g": "#bfe3c4", "b": "#bcd3f2"}


def grid(
    cells: str | NDArray[np.str_],
    values: ArrayLike | None = None,
    policy: ArrayLike | None = None,
    *,
    titles: Sequence[str] | str = "",
    label: str = "",
    limits: tuple[float, float] | None = (0.0, 1.0),
    actions: Sequence[str] = tuple(STEPS),
    wall: str = "#",
) -> Figure:
    """A map, with a value in each cell as a colour, and a policy as arrows.

    Args:
      cells: a text map (see :func:`jaxltl.envs.text_map.parse_map`) or its cells.
      values: ``float[S]``, or ``float[M, S]`` for M panels; NaN leaves a cell blank.
      policy: ``float[S, A]`` or ``int[S]``, or with M panels first; the length of an arrow is the
        probability of its action, and a row of NaN has none.
      titles: one per panel.
      label, limits: of the colour scale; limits None are those of the data.
      actions, wall: names of actions, of up, down, left and right; the kind of cell of walls.

    Raises:
      ValueError: values or policy do not fit the map, or an action has no direction.

    Example:
      >>> nan = float("nan")  # of the wall
      >>> figure = grid("a . #", [[0.1, 0.5, nan], [0.4, 1.0, nan]], titles=["first", "then"])
      >>> len(figure.axes)  # a map for each, and a scale
      3
    """
    kinds = parse_map(cells) if isinstance(cells, str) else np.asarray(cells)
    panels, arrows = _panels(kinds, values, policy, len(actions))
    if policy is not None:
        require_directions(actions, STEPS)
    count = next((len(x) for x in (panels, arrows) if x is not None), 1)
    titles = [titles] * count if isinstance(titles, str) else list(titles)
    rows, columns = kinds.shape
    across = 2 if count == 4 else min(count, 3)
    down = -(-count // across)
    longest = max(rows, columns)
    size = float(np.clip(5.2 / longest, max(0.16, min(0.24, 9 / longest)), 0.52))
    figure = blank(
        across * (columns * size + 0.35) + (0.75 if panels is not None else 0.1),
        down * (rows * size + 0.55),
    )
    all_axes = np.atleast_1d(figure.subplots(down, across, squeeze=False)).ravel()
    limits = value_limits(np.zeros(0) if panels is None else panels, limits)
    for axes in all_axes[count:]:
        axes.axis("off")
    # 130 / fontsize letters an inch, so that no title runs into that of the next map.
    fontsize = min(9.5, 130 * (columns * size + 0.35) / max(1, *map(len, titles)))
    for m, axes in enumerate(all_axes[:count]):
        panel = None if panels is None else panels[m]
        image = _cells(axes, kinds, panel, limits, wall, arrows is None)
        if arrows is not None:
            draw_arrows(axes, kinds.shape, arrows[m], panel, limits, actions)
        head(axes, titles[m], fontsize)
        keep_out_of_layout(axes)
    if panels is not None:
        scale_bar(figure, image, all_axes.tolist(), label)
    colors = kind_colors(kinds, wall)
    marks = _cell_texts(kinds, colors)
    note(figure, [(colors[k], f"{m}: {k}", "s") for k, m in marks.items() if len(k) > len(m)])
    if any(titles):
        settle(figure)
    return figure


def _panels(
    kinds: NDArray[np.str_], values: ArrayLike | None, policy: ArrayLike | None, num_actions: int
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """Values as ``[M, S]`` and policies as ``[M, S, A]``."""
    size = kinds.size
    panels = arrows = None
    if values is not None:
        panels = np.atleast_2d(np.asarray(values, float))
        if panels.ndim != 2 or panels.shape[1] != size:
            raise ValueError(
                f"values have shape {np.shape(values)}; the map has {size} cells, so pass "
                f"[{size}] or [panels, {size}]."
            )
    if policy is not None:
        chances = np.asarray(policy)
        if chances.dtype.kind in "iu":
            chances = np.eye(num_actions)[chances]
        arrows = chances[None] if chances.ndim == 2 else chances
        if arrows.shape[1:] != (size, num_actions):
            raise ValueError(
                f"policy has shape {np.shape(policy)}; the map has {size} cells and there are "
                f"{num_actions} actions, so pass [{size}, {num_actions}], or panels of that."
            )
    if panels is not None and arrows is not None and len(panels) != len(arrows):
        raise ValueError(f"values have {len(panels)} panels and the policy {len(arrows)}.")
    return panels, arrows


def _cells(
    axes: Axes,
    kinds: NDArray[np.str_],
    values: NDArray[np.float64] | None,
    limits: tuple[float, float],
    wall: str,
    numbers: bool,
) -> AxesImage:
    rows, columns = kinds.shape
    special = kind_colors(kinds, wall)
    marks = _cell_texts(kinds, special)
    numbers_of_cells: NDArray[np.float64] = np.full(kinds.shape, np.nan)
    if values is not None:
        numbers_of_cells = values.reshape(kinds.shape)
    image = shade_cells(axes, numbers_of_cells, limits)
    tiny = max(rows, columns) > TINY
    for (r, c), kind in np.ndenumerate(kinds):
        blank = np.isnan(numbers_of_cells[r, c]) or kind == wall
        if kind == wall:
            axes.add_patch(Rectangle((c, r), 1, 1, facecolor=WALL, lw=0))
            continue
        color = special.get(str(kind), PAPER)
        if blank and (values is not None or color != PAPER):
            # Hatched, since a plain colour could be taken for one of the scale.
            hatch = None if values is None else "/////"
            axes.add_patch(Rectangle((c, r), 1, 1, fc=color, ec=_HATCH, hatch=hatch, lw=0))
        if kind in special:
            _name_cell(axes, (c, r), marks[str(kind)], color, blank=bool(blank), tiny=tiny)
        if numbers and not blank and not tiny:
            tone = PAPER if numbers_of_cells[r, c] < sum(limits) / 2 else INK
            value = float(numbers_of_cells[r, c])  # to three digits, without a leading zero
            text = f"{value:.3f}".removeprefix("0") if 0 <= value < 1 else f"{value:.3g}"
            write(axes, (c + 0.5, r + 0.58), text, 7, tone)
    rule_cells(axes, rows, columns, FAINT)
    axes.set(xlim=(0, columns), ylim=(rows, 0), aspect="equal")
    number_cells(axes, rows, columns)
    return image


def _name_cell(
    axes: Axes, corner: tuple[int, int], text: str, color: str, *, blank: bool, tiny: bool
) -> None:
    """Writes the name of a cell: into the middle of a blank one, else into its corner."""
    inset = 0.5 if blank else 0.06
    style = {} if blank else {"ha": "left", "va": "top", "weight": "bold"}
    box = {"facecolor": color, "edgecolor": "none", "pad": 0.4 if tiny else 0.9}
    size, place = 9 if blank and not tiny else 6.5, (corner[0] + inset, corner[1] + inset)
    write(axes, place, text, size, INK, zorder=5, bbox=box, **style)


def _cell_texts(kinds: NDArray[np.str_], special: Iterable[str]) -> dict[str, str]:
    """The text in the cells of each kind: its name, or a mark where cells are small."""
    if max(kinds.shape) > TINY:
        return kind_marks(special)
    return {kind: short_name(kind) for kind in special}


def kind_marks(kinds: Iterable[str]) -> dict[str, str]:
    """Distinct marks of at most two characters: names that are as short, else one of their letters.

    Example:
      >>> kind_marks(["g", "goal", "lava"])
      {'g': 'g', 'goal': 'o', 'lava': 'l'}
    """
    names = sorted(kinds)
    marks = {kind: kind for kind in names if len(kind) <= 2}
    for kind in names:
        letters = [x for x in (*kind, *kind.upper(), *map(str, range(100))) if x.isalnum()]
        taken = set(marks.values())
        marks.setdefault(kind, next((x for x in letters if x not in taken), "?"))
    return {kind: marks[kind] for kind in names}


def kind_colors(kinds: NDArray[np.str_], wall: str) -> dict[str, str]:
    """The colour of each kind of cell that is neither plain nor a wall."""
    special = [str(k) for k in np.unique(kinds) if k not in (plain_kind(kinds), wall)]
    return {
        kind: _NAMED.get(
            re.sub(r"\d+$", "", kind).lower()[:1] if len(kind) < 3 else "", KINDS[i % len(KINDS)]
        )
        for i, kind in enumerate(special)
    }


def strategies(
    cells: str | NDArray[np.str_],
    play: ArrayLike,
    *,
    marked: ArrayLike | None = None,
    mark: str = "",
    num_columns: int = 4,
    seldom: float = 0.01,
    titles: Sequence[str] | str = "",
    actions: Sequence[str] = tuple(STEPS),
    wall: str = "#",
) -> Figure:
    """The mixed strategies on a map: large arrows for likely moves, small ones for rare moves.

    Args:
      cells: a text map (see :func:`jaxltl.envs.text_map.parse_map`) or its cells.
      play: ``float[S, A]``, or ``float[M, S, A]`` for M panels: the probability of each move;
        zero draws nothing, and a cell with a row of NaN is grey (never reached).
      marked, mark: cells ``bool[S]`` (or with M panels first) with a coloured background, and the
        legend of that colour.
      titles: one per panel.
      num_columns: the maximal number of panels in a row.
      seldom: moves of a smaller probability get a small arrow.
      actions, wall: as for :func:`grid`; an action may also be stay.

    Raises:
      ValueError: an array does not fit the map, or an action has no direction.

    Example:
      >>> play = np.array([[0.98, 0.0, 0.0, 0.02], [np.nan] * 4])
      >>> len(strategies(". .", play, seldom=0.05).axes)
      1
    """
    require_directions(actions)
    kinds = parse_map(cells) if isinstance(cells, str) else np.asarray(cells)
    world = Board(kinds, np.argwhere(np.ones(kinds.shape, bool)), wall)
    panels = np.asarray(play, float)
    panels = panels[None] if panels.ndim == 2 else panels
    if panels.ndim != 3 or panels.shape[1:] != (kinds.size, len(actions)):
        raise ValueError(
            f"play has shape {np.shape(play)}; the map has {kinds.size} cells and there are "
            f"{len(actions)} actions, so pass [{kinds.size}, {len(actions)}], or panels of that."
        )
    colored = np.zeros(panels.shape[:2], bool) if marked is None else np.asarray(marked, bool)
    if colored.shape not in (panels.shape[:2], panels.shape[1:2]):
        raise ValueError(
            f"marked has shape {colored.shape}; play has {len(panels)} panels of {kinds.size} "
            f"cells, so pass [{kinds.size}] or [{len(panels)}, {kinds.size}]."
        )
    colored = np.broadcast_to(colored, panels.shape[:2])
    titles = [titles] * len(panels) if isinstance(titles, str) else list(titles)
    figure, every = rows_of_maps(kinds.shape, len(panels), min(len(panels), num_columns))
    for axes, chance, here, title in zip(every, panels, colored, titles, strict=True):
        blank = np.isnan(chance).any(-1)
        fill_cells(
            axes,
            world,
            [
                NEVER if never else MARKED if good else PAPER
                for never, good in zip(blank, here, strict=True)
            ],
            FAINT,
        )
        number_cells(axes, *kinds.shape)
        draw_moves(axes, world, chance >= seldom, actions, scale=1.15)
        draw_moves(axes, world, (chance > 0) & (chance < seldom), actions, scale=0.5)
        head(axes, title)
        keep_out_of_layout(axes)
    rare = ((panels > 0) & (panels < seldom)).any()
    note(
        figure,
        [
            *([(MARKED, mark, "s")] if mark else []),
            *([(NEVER, "never reached", "s")] if np.isnan(panels).any() else []),
            *([(INK, "often", "^", 7), (INK, "seldom", "^", 4)] if rare else []),
        ],
    )
    return figure


MARKED, NEVER = "#f9e69a", "#e4e7eb"


# --- coloured worlds ----------------------------------------------------------------------


# Pale versions of cell_kinds.COLORS, for contrast with drawings on top.
TINTS = ("#e79a8c", "#f5db80", "#fdfcf8", "#c3add8", "#4a4f58")
_RARE = 3  # cells of a kind; above it the name is not written next to each
_IS_LIGHT = np.array([1.0, 1.0, 1.0, 1.0, 0.0])


def temporal_gridworld(
    world: World,
    policy: ArrayLike | None = None,
    memory: int | Sequence[int] = 0,
    trajectories: Trajectories | None = None,
    value: ArrayLike | None = None,
    *,
    title: str | Sequence[str] = "",
    actions: Sequence[str] = tuple(STEPS),
    label: str = "value",
    limits: tuple[float, float] | None = None,
) -> Figure:
    """The map of a coloured world and its objects, with a policy as arrows and trajectories as lines.

    Args:
      world: a :class:`jaxltl.envs.temporal_gridworld.World`.
      policy: ``float[S, A]``, or ``float[S, Q, A]`` by the task's memory.
      memory: the memory state to show, or several, with a panel for each.
      trajectories: of the world, drawn from a dot to a square, side by side where they overlap.
      value: ``float[S]`` or ``float[S, Q]``, as colours in a second row of panels.
      title, actions: a title per panel, and names of actions, of up, down, left and right.
      label, limits: of the colour scale; default limits are those of the data.

    Raises:
      ValueError: policy, value, memory or trajectories do not fit the world.

    Example:
      >>> from jaxltl.io.colored_world import read_world
      >>> world = read_world("rbrp\\nbrbp\\nrbry")
      >>> len(temporal_gridworld(world, np.full((2, 4), 0.25), value=[0.5, 1.0]).axes)
      3
    """
    chosen = [memory] if isinstance(memory, int | np.integer) else list(memory)
    size, shape = int(np.prod(world.shape)), world.shape
    moves = _of_memory(policy, chosen, size, (len(actions),), "policy")
    values = _of_memory(value, chosen, size, (), "value")
    if policy is not None:
        require_directions(actions, STEPS)
    titles = [title] * len(chosen) if isinstance(title, str) else list(title)
    lines = _walks(trajectories, world)
    wide = max(shape) + 2 * world.margin
    inches = float(np.clip(5.4 / wide, 0.06, 0.42)) * wide
    down = 1 if values is None else 2
    figure = blank(
        len(chosen) * (inches + 0.3) + (0.8 if down == 2 else 0.1),
        down * (inches * (shape[0] + 2 * world.margin) / wide + 0.55) + (0.3 if lines else 0),
        padded=True,
    )
    every = figure.subplots(down, len(chosen), squeeze=False)
    for i, (axes, name) in enumerate(zip(every[0], titles, strict=True)):
        light = _color_cells(axes, world)
        if moves is not None:
            draw_arrows(axes, shape, moves[i], light, (0.0, 1.0), actions)
        _draw_walks(axes, lines)
        _name_kinds(axes, world)
        head(axes, name)
        keep_out_of_layout(axes)
    if values is not None:
        limits = value_limits(values, limits)
        for i, axes in enumerate(every[1]):
            image = shade_cells(axes, values[i].reshape(shape), limits)
            if moves is not None:
                draw_arrows(axes, shape, moves[i], values[i], limits, actions)
            number_cells(axes, *shape)
            axes.set(xlim=(0, shape[1]), ylim=(shape[0], 0), aspect="equal")
            _name_kinds(axes, world)
            keep_out_of_layout(axes)
        scale_bar(figure, image, every[1], label, shrink=0.7)
    ends = [(ACCENT, "first cell", "o"), (ACCENT, "last cell", "s")] if lines else []
    marks = {name: mark for name, mark in _marks(world).items() if name != mark}
    note(figure, [*ends, *((SERIES[1], f"{mark}: {name}", "s") for name, mark in marks.items())])
    return figure


def _of_memory(
    array: ArrayLike | None, chosen: Sequence[int], size: int, rest: tuple[int, ...], name: str
) -> NDArray[np.float64] | None:
    """An array over states, or states and memory, as panels ``[M, S, ...]``."""
    if array is None:
        return None
    values = np.asarray(array, float)
    if values.shape == (size, *rest):
        return np.repeat(values[None], len(chosen), axis=0)
    if values.ndim != 2 + len(rest) or (values.shape[0], *values.shape[2:]) != (size, *rest):
        wanted = ", ".join(map(str, rest))
        raise ValueError(
            f"{name} has shape {values.shape}; the world has {size} cells, so pass "
            f"({size}, {wanted}) or ({size}, memory{', ' if rest else ''}{wanted})."
        )
    for q in chosen:
        if not 0 <= q < values.shape[1]:
            raise ValueError(f"memory {q} does not exist; {name} has 0 to {values.shape[1] - 1}.")
    return np.moveaxis(values[:, list(chosen)], 1, 0)


def _color_cells(axes: Axes, world: World) -> NDArray[np.float64]:
    """Colours a world and its margin; returns the mask of light cells, ``[S]``."""
    (rows, columns), margin = world.shape, world.margin
    colors = np.asarray(world.colors)
    axes.imshow(
        np.array([to_rgb(tint) for tint in TINTS])[colors],
        extent=(-margin, columns + margin, rows + margin, -margin),
        interpolation="nearest",
    )
    for corner, width, height in (
        ((-margin, -margin), columns + 2 * margin, margin),
        ((-margin, rows), columns + 2 * margin, margin),
        ((-margin, 0), margin, rows),
        ((columns, 0), margin, rows),
    ):
        axes.add_patch(Rectangle(corner, width, height, facecolor=PAPER, alpha=0.62, lw=0))
    if max(rows, columns) <= 32:
        rule_cells(axes, rows, columns, PAPER, 0.7)
    axes.add_patch(Rectangle((0, 0), columns, rows, fill=False, edgecolor=INK, lw=1.1))
    number_cells(axes, rows, columns)
    axes.set(xlim=(-margin, columns + margin), ylim=(rows + margin, -margin), aspect="equal")
    return _IS_LIGHT[colors[margin : margin + rows, margin : margin + columns].ravel()]


def _name_kinds(axes: Axes, world: World) -> None:
    """Frames objects and obstacles, and writes their names if they fit."""
    kinds = np.asarray(world.mdp.label)
    marks, tiny = _marks(world), max(world.shape) > TINY
    for state, number in np.argwhere(kinds):
        row, column = divmod(int(state), world.shape[1])
        name = world.mdp.propositions[number]
        inset = 0.05
        axes.add_patch(
            Rectangle(
                (column + inset, row + inset),
                1 - 2 * inset,
                1 - 2 * inset,
                fill=False,
                ec=SERIES[1],
                lw=0.9 if tiny else 1.6,
                zorder=5,
            )
        )
        # In small cells, names of rare kinds are written next to them, marks of others inside.
        corner = column + (1.2 if tiny and name not in marks else 0.04), row + 0.04
        style = {"ha": "left", "va": "top", "weight": "bold", "zorder": 7}
        write(
            axes,
            corner,
            marks.get(name, name),
            5 if name in marks else 6.5,
            PAPER,
            **style,
            bbox={"facecolor": SERIES[1], "edgecolor": "none", "pad": 0.3 if marks else 0.9},
        )


def _marks(world: World) -> dict[str, str]:
    """Marks of the kinds that are too frequent in small cells for their names."""
    if max(world.shape) <= TINY:
        return {}
    often = np.asarray(world.mdp.label).sum(0) > _RARE
    return kind_marks(np.array(world.mdp.propositions)[often].tolist())


def _walks(trajectories: Trajectories | None, world: World) -> list[NDArray[np.float64]]:
    """Points ``[T, 2]``, column and row, of each trajectory."""
    if trajectories is None:
        return []
    states, lengths = np.asarray(trajectories.state), np.asarray(trajectories.length)
    size = int(np.prod(world.shape))
    if states.size and not 0 <= states.min() <= states.max() < size:
        raise ValueError(
            f"trajectories have states {states.min()} to {states.max()}; the world's cells are 0 "
            f"to {size - 1}. Pass trajectories of the world, not of a product."
        )
    count = len(states)
    # Parallel lines, so that frequent paths look broad.
    offset = np.linspace(-0.22, 0.22, count) if count > 1 else np.zeros(1)
    points = []
    for row, length, shift in zip(states, lengths, offset, strict=True):
        down, across = np.divmod(row[:length], world.shape[1])
        points.append(np.stack([across, down], 1) + 0.5 + shift)
    return [p for p in points if len(p)]


def _draw_walks(axes: Axes, walks: Sequence[NDArray[np.float64]]) -> None:
    faint = float(np.clip(4 / max(len(walks), 1), 0.25, 1.0))
    halo = [withStroke(linewidth=2.6, foreground=PAPER, alpha=faint)]
    for walk in walks:
        axes.plot(*walk.T, color=ACCENT, lw=1.3, alpha=faint, zorder=5.5, path_effects=halo)
        for point, marker in ((walk[0], "o"), (walk[-1], "s")):
            axes.plot(
                *point,
                marker,
                color=ACCENT,
                ms=4.5,
                mec=PAPER,
                mew=0.8,
                zorder=6,
                alpha=max(faint, 0.6),
            )
