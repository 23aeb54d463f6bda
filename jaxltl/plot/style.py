"""Colours, files and axes that all pictures share."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from jaxltl.core.models.protocols import PyTree

INK, MUTED, FAINT = "#1f2a37", "#6b7785", "#d5dae0"
ACCENT, GOOD, PAPER = "#1f6f8b", "#e4f1ea", "#ffffff"
KINDS = ("#dfd0ea", "#f5d6b3", "#d3e6e8", "#e3ddd0", "#f0d3df", "#dbe3b8")
SERIES = ("#1f6f8b", "#c2571a", "#5b7f2b", "#7a4f9a", "#a23b5b", "#4a5a6a")

# High values are light, so that low ones stand out.
SCALE = LinearSegmentedColormap.from_list(
    "probability", ["#2f2b57", "#4a5a92", "#7f9cc0", "#bfd3df", "#f6f8f4"]
)

Point: TypeAlias = Sequence[float] | NDArray[np.float64]


def blank(width: float, height: float, *, padded: bool = False) -> Figure:
    """An empty figure with a constrained layout, with more space between rows if padded."""
    layout = ConstrainedLayoutEngine(h_pad=0.1 if padded else None)
    return Figure(figsize=(width, height), layout=layout, facecolor=PAPER)


def write(axes: Axes, place: Point, text: str, size: float, color: str, **style: PyTree) -> None:
    """Writes text as it is, without formulas, centred at a place unless `style` aligns it."""
    style = {"ha": "center", "va": "center", **style}
    axes.text(place[0], place[1], text, fontsize=size, color=color, parse_math=False, **style)


def to_bytes(figure: Figure, kind: str = "svg", dpi: int = 150) -> bytes:
    """The bytes of a figure's file; the same figure gives the same bytes.

    Args:
      figure, kind, dpi: the figure, ``"svg"``, ``"png"`` or ``"pdf"``, and dots per inch of a PNG.

    Raises:
      ValueError: a kind that matplotlib does not write.

    Example:
      >>> from matplotlib.figure import Figure
      >>> to_bytes(Figure())[:5], to_bytes(Figure(), "pdf")[:5]
      (b'<?xml', b'%PDF-')
    """
    buffer = io.BytesIO()
    engine = figure.get_layout_engine()
    if kind != "svg" or engine is None:
        # Without a date, the same figure gives the same bytes.
        metadata = {"Date": None} if kind == "svg" else None
        figure.savefig(buffer, format=kind, dpi=dpi, metadata=metadata, facecolor=PAPER)
        return buffer.getvalue()
    # As savefig does it, but that draws everything twice, the first time for the layout alone.
    canvas, before = FigureCanvasSVG(figure), (figure.dpi, figure.get_facecolor())
    try:
        figure.set_facecolor(PAPER)
        engine.execute(figure)
        figure.set_layout_engine("none")
        figure.dpi = dpi  # of images inside the figure
        canvas.print_svg(buffer, metadata={"Date": None})
    finally:
        figure.set_layout_engine(engine)
        figure.dpi, facecolor = before
        figure.set_facecolor(facecolor)
    return buffer.getvalue()


def settle(figure: Figure) -> None:
    """Runs the layout once more, since titles get their height after the maps."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)


def note(figure: Figure, marks: Sequence[tuple[Any, ...]], title: str = "") -> None:
    """Draws a legend below the maps: (colour, text, marker[, size])."""
    handles = [
        Line2D(
            [],
            [],
            ls="",
            marker=marker,
            color=color,
            markersize=size[0] if size else 7,
            label=text,
            markeredgecolor=MUTED if color == PAPER else "none",
        )
        for color, text, marker, *size in marks
    ]
    if not handles:
        return
    legend = figure.legend(
        handles=handles,
        loc="outside lower left",
        ncols=max(1, min(len(handles), int(figure.get_figwidth() / 1.6))),
        frameon=False,
        fontsize=8,
        labelcolor=INK,
        handletextpad=0.1,
        columnspacing=1.2,
        title=title,
        alignment="left",
    )
    legend.get_title().set(fontsize=8, color=MUTED)


def value_limits(
    values: NDArray[np.float64], limits: tuple[float, float] | None
) -> tuple[float, float]:
    """The limits of a colour scale; default the range of the finite values."""
    if limits is not None:
        return limits
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    return (low, high) if low < high else (low - 1, high)


def scale_bar(
    figure: Figure,
    image: Any,
    axes: Sequence[Axes],
    label: str,
    shrink: float = 0.6,
    aspect: float = 24,
) -> None:
    """Draws the colour scale of values."""
    # As many ticks at any height, so that the layout, which comes first, finds labels as they are.
    bar = figure.colorbar(
        image, ax=list(axes), shrink=shrink, pad=0.015, aspect=aspect, ticks=MaxNLocator(5)
    )
    bar.set_label(label, fontsize=9, color=INK)
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=8, color=MUTED, labelcolor=INK, length=2)


def head(axes: Axes, text: str, size: float = 9.5) -> None:
    """The title of a map."""
    axes.set_title(text, fontsize=size, color=INK, pad=5, loc="left", parse_math=False)


def plain_axes(axes: Axes) -> None:
    """Removes spines and ticks from axes."""
    axes.tick_params(labelsize=8, color=FAINT, labelcolor=INK, length=3)
    axes.grid(color=FAINT, lw=0.5)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(FAINT)


# --- text alternatives --------------------------------------------------------------------


_DPI, _SCREEN = 144, 96  # of saved images, and of widths in pages


class Described(NamedTuple):
    """A figure with a text alternative, as a notebook displays it."""

    figure: Figure  # the figure
    text: str  # a description in one or two sentences
    # HTML that shows the same and moves, or None. Notebooks show it in a frame where they run;
    # where it was not saved, or is not trusted, the picture stands in its place
    page: str | None = None

    def __repr__(self) -> str:
        return self.text

    def _repr_mimebundle_(
        self, include: Collection[str] | None = None, exclude: Collection[str] | None = None
    ) -> tuple[dict[str, str], dict[str, Any]]:
        png = to_bytes(self.figure, "png", dpi=_DPI)
        data = {"text/plain": self.text, "image/png": base64.b64encode(png).decode("ascii")}
        if self.page is not None:
            data["text/html"] = (
                f'<iframe title="{html.escape(self.text)}" srcdoc="{html.escape(self.page)}" '
                'sandbox="allow-scripts" width="100%" height="640" style="border:0"></iframe>'
            )
        width, height = (round(x * _SCREEN) for x in self.figure.get_size_inches())
        return data, {"image/png": {"alt": self.text, "width": width, "height": height}}


def described(figure: Figure, text: str, *, page: str | None = None) -> Described:
    """A figure with a text alternative, shown as a picture by notebooks.

    Args:
      figure: the figure.
      text: the text alternative: the objects in the figure and its main result.
      page: HTML of an animation, such as that of :func:`~jaxltl.plot.episodes.play_episode`.

    Raises:
      ValueError: the text is empty or has brackets or line breaks.

    >>> from matplotlib.figure import Figure
    >>> described(Figure(), "Nothing yet: white paper.")
    Nothing yet: white paper.
    """
    if not text.strip() or any(x in text for x in "[]\n"):
        raise ValueError(
            f"text: {text!r}; say in one line, without square brackets, what the figure shows."
        )
    return Described(figure, text.strip(), page)
