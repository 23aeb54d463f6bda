"""Formats of numbers, probabilities and certificates in reports."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence

import click
from jaxltl.app.wording import Result

Remark = tuple[str, str]  # kind, "warning" (red), "note" or "good", and text


def remark_lines(remarks: Iterable[Remark]) -> list[str]:
    """Remarks as paragraphs for the terminal, warnings in red."""
    return [
        "\n" + (click.style(f"warning: {text}", fg="red") if kind == "warning" else text)
        for kind, text in remarks
    ]


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table of texts."""
    width = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(map(str.ljust, row, width)).rstrip() for row in rows]


def mean_deviation(values: Iterable[float | None]) -> str:
    """Mean and standard deviation of the finite values."""
    known = [v for v in values if v is not None]
    if not known:
        return "unknown"
    deviation = statistics.stdev(known) if len(known) > 1 else 0.0
    return f"{number(statistics.fmean(known))} ± {deviation:.2g}"


def probability(value: float | None) -> str:
    """A probability to four places; a small one with its exponent."""
    if value is None:
        return "unknown"
    return f"{value:.4f}" if value >= 0.00095 or value == 0 else f"{value:.1e}"


def rounded_down(value: float) -> str:
    """A lower bound, rounded down to four places."""
    return f"{math.floor(value * 1e4) / 1e4:.4f}"


def certified(entry: Result) -> str:
    """The certificate of a value: exact, an error bound, or the interval if it is wide."""
    value, lower, upper = entry["value"], entry["lower"], entry["upper"]
    if value is None or lower is None or upper is None:
        return "no bounds"
    width = max(value - lower, upper - value)
    if width <= 0:
        return "exact"
    if width < 5e-4:
        return f"within {width:.1e}"
    return f"in [{rounded_down(lower)}, {math.ceil(upper * 1e4) / 1e4:.4f}]"


def number(value: float | None) -> str:
    """A number in four digits, or "unknown"."""
    if value is None:
        return "unknown"
    return f"{value:.1e}" if value != 0 and abs(value) < 1e-3 else f"{value:.4g}"
