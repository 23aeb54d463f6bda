"""Learning curves, bands over seeds, bounds over samples, and trajectories in the plane."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from matplotlib.ticker import NullFormatter
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.array_types import PyTree
from jaxltl.plot.style import (
    ACCENT,
    FAINT,
    INK,
    KINDS,
    MUTED,
    SERIES,
    blank,
    plain_axes,
    settle,
)


def curves(
    metrics: Mapping[str, ArrayLike] | object,
    *,
    steps: ArrayLike | None = None,
    show: Sequence[str] | None = None,
) -> Figure:
    """The learning curves of a run, one panel per figure: the median and range over seeds.

    Args:
      metrics: figures ``[T]`` or ``[..., T]`` by name, or a learner's ``Metrics``; all leading axes
        are seeds.
      steps: ``[T]``, the step of each figure; default 1, 2, ...
      show: names in order; default all that are not wholly NaN.

    Raises:
      ValueError: there is nothing to show.

    Example:
      >>> of_two_seeds = {"loss": [[3.0, 2.0, 1.0], [4.0, 3.0, 1.0]], "share": np.full((2, 3), 0.5)}
      >>> len(curves(of_two_seeds).axes)
      2
    """
    chosen_metrics = _shown("curves", metrics, show)
    series = {
        k: np.atleast_2d(v).reshape(-1, np.shape(v)[-1])
        for k, v in chosen_metrics.items()
        if v.ndim
    }
    if not series:
        raise ValueError(
            f"curves: {', '.join(chosen_metrics)} are single numbers; give a run's history, [T] or [N, T]."
        )
    chosen = list(series)
    figure = blank(3.1 * len(chosen) + 0.2, 2.5)
    for i, (name, axes) in enumerate(
        zip(chosen, figure.subplots(1, len(chosen), squeeze=False)[0], strict=True)
    ):
        _curve(axes, series[name], steps, name.replace("_", " "), SERIES[i % len(SERIES)])
    return figure


def _shown(
    function: str, metrics: Mapping[str, ArrayLike] | object, show: Sequence[str] | None
) -> dict[str, NDArray[np.float64]]:
    """The chosen metrics by name, without those that are NaN everywhere."""
    if not isinstance(metrics, Mapping):
        metrics = {
            name: getattr(metrics, name)
            for name in getattr(type(metrics), "__dataclass_fields__", {})
        }
    every = {k: np.asarray(v, float) for k, v in metrics.items()}
    chosen = {k: every[k] for k in (show or every) if k in every and np.isfinite(every[k]).any()}
    if not chosen:
        raise ValueError(f"{function}: nothing to show among {', '.join(every) or 'no figures'}.")
    return chosen


def _curve(
    axes: Axes, rows: NDArray[np.float64], steps: ArrayLike | None, name: str, color: str
) -> None:
    x = np.arange(1, rows.shape[1] + 1) if steps is None else np.asarray(steps)
    rows = np.where(np.isfinite(rows), rows, np.nan)
    _median_and_range(axes, x, rows, color, 0.18)
    positive = rows[rows > 0]
    if positive.size and np.nanmin(rows) > 0 and positive.max() > 100 * positive.min():
        axes.set_yscale("log")
    axes.set_title(name, fontsize=9.5, color=INK, loc="left")
    axes.set_xlabel("step", fontsize=8.5, color=MUTED)
    plain_axes(axes)


def bands(
    rows: Mapping[str, Mapping[str, Mapping[str, tuple[ArrayLike, ArrayLike, ArrayLike]]]],
    *,
    limits: Mapping[str, Mapping[str, float]] | None = None,
    label: str = "step",
) -> Figure:
    """The learning curves of several methods: a row of panels for each task.

    Args:
      rows: by the titles of row and column and the name of the series, the horizontal places
        ``[T]``, a mean ``[T]``, and the half-width of the band ``[T]``.
      limits: by the titles of row and column, a number at which a dashed line is drawn.
      label: of the horizontal axis.

    Raises:
      ValueError: there is nothing to show.

    Example:
      >>> band = ([1, 2], [0.5, 0.75], [0.1, 0.1])  # steps, means, half-widths
      >>> len(bands({"small": {"reward": {"PPO": band, "CPO": band}, "cost": {"CPO": band}}}).axes)
      2
    """
    columns = {column for row in rows.values() for column in row}
    figure, panels = _rows_of_panels(rows, "bands", (3.6, 1.9), [label] * len(columns))
    names = list(dict.fromkeys(n for row in rows.values() for cell in row.values() for n in cell))
    for (row, column), axes in panels.items():
        for name, (x, mean, half_width) in rows[row][column].items():
            color = SERIES[names.index(name) % len(SERIES)]
            place, middle, width = (np.asarray(v, float) for v in (x, mean, half_width))
            axes.fill_between(place, middle - width, middle + width, color=color, alpha=0.15, lw=0)
            axes.plot(place, middle, color=color, lw=1.4, label=name)
        if limits and column in limits.get(row, {}):
            axes.axhline(limits[row][column], color=INK, lw=1, ls="--")
    _legend_below(
        figure, [Line2D([], [], color=SERIES[i % len(SERIES)]) for i in range(len(names))], names
    )
    return figure


def sweep(
    metrics: Mapping[str, ArrayLike] | object,
    settings: Sequence[str] | None = None,
    *,
    steps: ArrayLike | None = None,
    show: Sequence[str] | None = None,
) -> Figure:
    """The learning curves of several settings: mean and standard deviation over seeds.

    Args:
      metrics: a :class:`~jaxltl.algos.training.Sweep`; or figures ``[H, N, T]`` of H settings and N
        seeds by name, or a learner's ``Metrics`` of a ``vmap`` over seeds within one over settings.
      settings: the names of the H settings; at most six, the number of distinct colours. Default:
        those of the sweep.
      steps, show: as for :func:`curves`; the steps of a sweep by default are its own.

    Returns:
      The figure, without seeds that are not finite at a step.

    Raises:
      ValueError: there is nothing to show, or figures of another number of axes or settings.

    Example:
      >>> len(sweep({"loss": np.ones((2, 3, 5))}, ["slow", "fast"]).axes)  # settings, seeds, steps
      1
    """
    runs: PyTree = metrics
    if hasattr(runs, "names") and hasattr(runs, "metrics"):  # a Sweep; importing it takes a second
        steps = runs.step if steps is None else steps
        settings, metrics = settings or runs.names, runs.metrics
    if settings is None:
        raise ValueError("sweep: settings is None; give the names of the settings.")
    series, count = _shown("sweep", metrics, show), len(settings)
    if count > len(SERIES):
        raise ValueError(
            f"sweep: {count} settings; show at most {len(SERIES)} at a time, whose colours differ."
        )
    panels = {}
    for name, values in series.items():
        if values.ndim != 3 or len(values) != count:
            raise ValueError(
                f"sweep: {name} has shape {list(values.shape)}; give [{count}, N, T]: settings, "
                "seeds, steps."
            )
        place = np.arange(1, values.shape[2] + 1) if steps is None else steps
        held = np.ma.masked_invalid(values)
        mean, deviation = (x.filled(np.nan) for x in (held.mean(axis=1), held.std(axis=1)))
        panels[name.replace("_", " ")] = {
            str(setting): (place, mean[i], deviation[i]) for i, setting in enumerate(settings)
        }
    return bands({"": panels})


def lines(
    rows: Mapping[str, Mapping[str, tuple[ArrayLike, ArrayLike | None]]],
    *,
    labels: Sequence[str] = (),
    names: tuple[str, str] = ("found", "reference"),
) -> Figure:
    """The runs of each setting over time, with a reference run: a row of panels for each setting.

    Args:
      rows: by the titles of row and column, runs ``[K, T]`` and a reference ``[T]`` or None.
      labels: of the horizontal axes, one for each column.
      names: of the runs and of the reference.

    Raises:
      ValueError: there is nothing to show.

    Example:
      >>> runs = np.zeros((4, 10))
      >>> len(lines({"one": {"value": (runs, np.ones(10)), "cost": (runs, None)}}).axes)
      2
    """
    figure, panels = _rows_of_panels(rows, "lines", (2.1, 1.5), labels)
    for (row, column), axes in panels.items():
        runs, reference = rows[row][column]
        several = np.asarray(runs, float)
        axes.plot(
            several.T,
            color=ACCENT,
            lw=1.4 if len(several) == 1 else 0.7,
            alpha=1 if len(several) == 1 else 0.35,
        )
        if reference is not None:
            axes.plot(np.asarray(reference, float), color=SERIES[1], lw=1.3, ls="--")
    _legend_below(
        figure, [Line2D([], [], color=ACCENT), Line2D([], [], color=SERIES[1], ls="--")], names
    )
    return figure


def guarantees(
    samples: ArrayLike,
    bounds: Mapping[str, ArrayLike],
    *,
    reference: float | None = None,
    names: tuple[str, str] = ("transitions", "probability"),
) -> Figure:
    """The bounds over the number of samples, on a logarithmic axis.

    Args:
      samples: ``[T]``, positive.
      bounds: by name ``[T]``, or ``[N, T]`` for N runs, drawn as median and range.
      reference: the exact value, drawn as a line.
      names: of the axes.

    Raises:
      ValueError: there is nothing to show.

    Example:
      >>> figure = guarantees([10, 100, 1000], {"at least": [0.2, 0.6, 0.7]}, reference=0.75)
      >>> figure.axes[0].get_xscale(), len(figure.axes[0].lines)
      ('log', 2)
    """
    if not bounds:
        raise ValueError("guarantees: nothing to show; give a bound.")
    figure = blank(4.6, 2.9)
    axes = figure.subplots()
    plain_axes(axes)
    count = np.asarray(samples, float)
    for i, (name, bound) in enumerate(bounds.items()):
        runs, color = np.atleast_2d(np.asarray(bound, float)), SERIES[i % len(SERIES)]
        _median_and_range(axes, count, runs, color, 0.15, marker="o", ms=3, label=name)
    if reference is not None:
        axes.axhline(reference, color=MUTED, lw=1, ls="--", label="no policy has more")
    axes.set_xscale("log")
    if count.max() > 10 * count.min():  # otherwise the axis may have no major tick
        axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_ylim(0, 1.02)
    axes.set_xlabel(names[0], color=INK, fontsize=8.5)
    axes.set_ylabel(names[1], color=INK, fontsize=8.5)
    axes.legend(frameon=False, fontsize=8, labelcolor=INK, loc="best")
    return figure


def paths(
    maps: Mapping[str, tuple[ArrayLike, ArrayLike]],
    boxes: Mapping[str, ArrayLike],
    *,
    bounds: ArrayLike,
    num_columns: int = 4,
) -> Figure:
    """The trajectories in the plane, a map for each title.

    Args:
      maps: by title, coordinates x and y of M trajectories, ``[M, T]`` each.
      boxes: by name, regions ``((x, y), (x, y))``, the lower left corner first; drawn in all maps.
      bounds, num_columns: the box that is shown, and the number of maps in a row.

    Raises:
      ValueError: there is nothing to show.

    Example:
      >>> figure = paths({"before": ([[0, 1]], [[0, 2]]), "after": ([[0, 2]], [[0, 2]])},
      ...                {"goal": ((1.5, 1.5), (2, 2))}, bounds=((0, 0), (2, 2)))
      >>> len(figure.axes)
      2
    """
    if not maps:
        raise ValueError("paths: nothing to show; give at least one map.")
    num_columns = min(num_columns, len(maps))
    count = -(-len(maps) // num_columns)
    figure = blank(2.3 * num_columns, 2.4 * count + 0.3)
    every = figure.subplots(count, num_columns, squeeze=False).ravel()
    low, high = np.asarray(bounds, float)
    handles: list[Artist] = []
    for i, axes in enumerate(every):
        axes.set_axis_off()
        if i >= len(maps):
            continue
        title, (x, y) = list(maps.items())[i]
        handles = []
        for j, (corner, end) in enumerate(np.asarray(list(boxes.values()), float)):
            box = Rectangle(tuple(corner), *(end - corner), lw=0, color=KINDS[(j + 2) % 6])
            handles.append(axes.add_patch(box))
        axes.add_patch(Rectangle(tuple(low), *(high - low), fill=False, color=FAINT, lw=1.5))
        xs, ys = np.asarray(x, float), np.asarray(y, float)
        axes.plot(xs.T, ys.T, color=ACCENT, lw=0.9, alpha=0.75)
        axes.plot(xs[:, 0], ys[:, 0], "o", color=INK, ms=2.2)
        axes.plot(xs[:, -1], ys[:, -1], "s", color=SERIES[1], ms=2.6)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set_title(title, fontsize=8.5, color=INK, loc="left", parse_math=False)
    ends = [
        Line2D([], [], ls="", marker=m, color=c, ms=4) for m, c in (("o", INK), ("s", SERIES[1]))
    ]
    _legend_below(figure, [*handles, *ends], [*boxes, "first", "last"])
    settle(figure)
    return figure


# --- shared parts ---------------------------------------------------------------------------


def _rows_of_panels(
    rows: Mapping[str, Mapping[str, object]],
    name: str,
    size: tuple[float, float],
    labels: Sequence[str],
) -> tuple[Figure, dict[tuple[str, str], Axes]]:
    """Empty panels by the titles of row and column, with a label below each column."""
    columns = list(dict.fromkeys(column for row in rows.values() for column in row))
    if not columns:
        raise ValueError(f"{name}: nothing to show; give at least one row with a panel.")
    figure = blank(size[0] * len(columns), size[1] * len(rows) + 0.5)
    grid = figure.subplots(len(rows), len(columns), squeeze=False)
    panels = {}
    for (i, j), axes in np.ndenumerate(grid):
        row, column = list(rows)[i], columns[j]
        plain_axes(axes)
        if i == 0:
            axes.set_title(column, fontsize=9.5, color=INK, loc="left")
        if j == 0:
            axes.set_ylabel(row, fontsize=9.5, color=INK)
        if i == len(rows) - 1 and j < len(labels):
            axes.set_xlabel(labels[j], fontsize=8.5, color=MUTED)
        axes.set_visible(column in rows[row])
        if column in rows[row]:
            panels[row, column] = axes
    return figure, panels


def _median_and_range(
    axes: Axes,
    x: NDArray[np.float64],
    rows: NDArray[np.float64],
    color: str,
    alpha: float,
    **style: Any,
) -> None:
    if len(rows) > 1:
        low, high = np.nanmin(rows, axis=0), np.nanmax(rows, axis=0)
        axes.fill_between(x, low, high, color=color, alpha=alpha, lw=0)
    middle = np.nanmedian(rows, axis=0) if len(rows) > 1 else rows[0]
    axes.plot(x, middle, color=color, lw=1.6, **style)


def _legend_below(figure: Figure, handles: Sequence[Artist], names: Sequence[str]) -> None:
    """Draws a legend in one row below the axes."""
    figure.legend(
        handles,
        names,
        loc="outside lower center",
        ncols=len(names),
        frameon=False,
        fontsize=8.5,
        labelcolor=INK,
    )
