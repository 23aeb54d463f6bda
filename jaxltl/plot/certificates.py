"""Maps of certificates in continuous worlds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.array_types import Floats
from jaxltl.core.continuous import Certificate, Dynamics, Region
from jaxltl.plot.style import (
    ACCENT,
    INK,
    MUTED,
    PAPER,
    SCALE,
    SERIES,
    blank,
    head,
    note,
    plain_axes,
    scale_bar,
    write,
)

_INITIAL = "#d99a00"


def certificate(
    certificate: Certificate,
    dynamics: Dynamics,
    axes: tuple[int, int] = (0, 1),
    runs: Sequence[ArrayLike] | None = None,
) -> Figure:
    """Map of the certified lower bounds over two coordinates of the state.

    The colour of a point is the least lower bound over the other coordinates. Boxes of labels are
    outlined with their names, and boxes of initial states dashed; half-spaces and functions are not
    drawn. In worlds of one coordinate, the lower and the upper bound are curves.

    Args:
      certificate: of ``certify_policy`` or ``synthesize_policy(...).certificate``.
      dynamics: the world.
      axes: the horizontal and the vertical coordinate.
      runs: trajectories ``float[T, n]``, such as those of ``run_episode``, drawn as lines from a
        circle to a square.

    Returns:
      Matplotlib figure of the map and its scale.

    Raises:
      ValueError: axes that are no two coordinates of the state.

    Example:
      >>> from jaxltl.core.continuous import certify_policy, make_dynamics
      >>> world = make_dynamics(
      ...     lambda x, u, w: x / 2, domain=([-1, -1], [1, 1]), labels={"in": ([-0.1] * 2, [0.1] * 2)})
      >>> proof = certify_policy(world, lambda x: x[:0], "F in", cells=[10, 10])
      >>> len(certificate(proof, world, runs=[[[0.8, 0.8], [0.4, 0.4]]]).axes)  # map and scale
      2
    """
    grid, n = certificate.grid, certificate.grid.num_axes
    figure = blank(6.0, 4.6)
    panel = figure.subplots()
    plain_axes(panel)
    head(panel, f"{certificate.formula}: lower bound of the probability")
    tracks = [np.asarray(run, float) for run in runs or ()]
    if n == 1:
        for bound, color in ((certificate.upper, MUTED), (certificate.lower, ACCENT)):
            panel.stairs(bound, grid.edges[0], color=color, baseline=None)
        panel.set(xlabel="coordinate 0", ylabel="satisfaction probability", ylim=(-0.03, 1.03))
        note(figure, [(ACCENT, "lower bound", "s"), (MUTED, "upper bound", "s")])
        return figure
    across, up = (validation.integer("axes", i, least=0, limit=n - 1) for i in axes)
    if across == up:
        raise ValueError(f"axes={tuple(axes)}: give two distinct coordinates of 0 to {n - 1}.")
    others = tuple(i for i in range(n) if i not in (across, up))
    least = certificate.lower.reshape(grid.shape).min(axis=others)
    image = panel.pcolormesh(
        grid.edges[across],
        grid.edges[up],
        least.T if across < up else least,
        cmap=SCALE,
        vmin=0,
        vmax=1,
        rasterized=True,  # one image in an SVG, not a path for each cell
    )
    low, high = dynamics.domain
    window = (low[[across, up]], high[[across, up]])
    for i, (name, region) in enumerate(dynamics.labels.items()):
        _outline(panel, region, (across, up), window, name, SERIES[i % len(SERIES)])
    _outline(panel, dynamics.initial, (across, up), window, "", _INITIAL)
    halo = [withStroke(linewidth=2.4, foreground=PAPER, alpha=0.8)]
    for track in tracks:
        x, y = track[:, across], track[:, up]
        panel.plot(x, y, color=INK, lw=1.0, path_effects=halo)
        panel.plot(x[0], y[0], "o", x[-1], y[-1], "s", color=INK, ms=4, mec=PAPER, mew=0.7)
    panel.set(xlabel=f"coordinate {across}", ylabel=f"coordinate {up}")
    panel.set(xlim=(low[across], high[across]), ylim=(low[up], high[up]))
    scale_bar(figure, image, [panel], "least over the other coordinates" if others else "")
    run_marks = [(INK, "run begins", "o"), (INK, "run ends", "s")] if tracks else []
    note(figure, [(_INITIAL, "initial states (dashed)", "s"), *run_marks])
    return figure


def _outline(
    panel: Axes,
    region: Region,
    axes: tuple[int, int],
    window: tuple[Floats, Floats],
    name: str,
    color: str,
) -> None:
    """Outlines of the boxes of a region, projected on two coordinates and cut at a window."""
    for low, high in zip(region.low[:, axes], region.high[:, axes], strict=True):
        low, high = np.clip(low, *window), np.clip(high, *window)
        box, dashes = Rectangle(tuple(low), *(high - low), ec=color), "-" if name else "--"
        panel.add_patch(box).set(lw=1.6, ls=dashes, fill=False, clip_on=False)
        halo = [withStroke(linewidth=2.0, foreground=PAPER)]
        write(panel, (low + high) / 2, name, 8, color, path_effects=halo, zorder=6)
