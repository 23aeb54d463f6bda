"""Pictures of coloured gridworlds with policies, trajectories and values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Unpack

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike, NDArray

from jaxltl.core import validation
from jaxltl.plot.board import (
    STEPS,
    draw_arrows,
    keep_out_of_layout,
    number_cells,
    require_directions,
    rule_cells,
    shade_cells,
)
from jaxltl.plot.maps import TINY, kind_marks
from jaxltl.plot.style import (
    ACCENT,
    INK,
    PAPER,
    SERIES,
    MapOptions,
    blank,
    head,
    note,
    scale_bar,
    value_limits,
    write,
)

if TYPE_CHECKING:
    from jaxltl.core.models.trajectories import Trajectories
    from jaxltl.envs.temporal_gridworld import World

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
    **look: Unpack[MapOptions],
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
    label, limits, actions = validation.options(
        "temporal_gridworld", look, label="value", limits=None, actions=tuple(STEPS)
    )
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
