"""What pages and texts about learned policies share: tables, and how figures are written."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import click

Remark = tuple[str, str]  # its kind, "warning" (shown in red), "note" or "good", and its text


def told(remarks: Iterable[Remark]) -> list[str]:
    """Remarks as paragraphs for the terminal, warnings in red."""
    return [
        "\n" + (click.style(f"warning: {text}", fg="red") if kind == "warning" else text)
        for kind, text in remarks
    ]


def rows(
    header: Iterable[str], lines: Iterable[Iterable[str]], caption: str = "", more: str = ""
) -> str:
    """A table of texts, which are HTML; the first of each line is its head.

    Args:
      header, lines: the texts.
      caption: as HTML.
      more: attributes of the table.
    """
    head = "".join(f'<th scope="col">{text}</th>' for text in header)
    head = head and f"<thead><tr>{head}</tr></thead>"
    body = "".join(
        f'<tr><th scope="row">{first}</th>' + "".join(f"<td>{x}</td>" for x in rest) + "</tr>"
        for first, *rest in lines
    )
    return f'<div class="scroll"><table {more}>{caption}{head}<tbody>{body}</tbody></table></div>'


def tiles(figures: Iterable[tuple[str, str]]) -> str:
    """Figures to see first, each with its text, which is HTML."""
    return (
        "<div class=tiles>"
        + "".join(
            f"<div class=tile><b>{value}</b><small>{text}</small></div>" for value, text in figures
        )
        + "</div>"
    )


def spread(values: Iterable[float | None]) -> str:
    """Mean, and standard deviation over seeds, of the finite values."""
    known = [v for v in values if v is not None]
    if not known:
        return "unknown"
    mean = sum(known) / len(known)
    deviation = (sum((v - mean) ** 2 for v in known) / max(1, len(known) - 1)) ** 0.5
    return f"{number(mean)} ± {deviation:.2g}"


def probability(value: float | None) -> str:
    """A probability to four places; a small one with its exponent."""
    if value is None:
        return "unknown"
    return f"{value:.4f}" if value >= 0.00095 or value == 0 else f"{value:.1e}"


def certified(entry: Mapping[str, Any]) -> str:
    """What the bounds of a value say: exact, within so much, or the interval if it is wide."""
    value, lower, upper = entry["value"], entry["lower"], entry["upper"]
    if value is None or lower is None or upper is None:
        return "no bounds"
    width = max(value - lower, upper - value)
    if width <= 0:
        return "exact"
    if width < 5e-4:
        return f"within {width:.1e}"
    return f"in [{math.floor(lower * 1e4) / 1e4:.4f}, {math.ceil(upper * 1e4) / 1e4:.4f}]"


def number(value: float | None) -> str:
    """A figure to four digits."""
    if value is None:
        return "unknown"
    return f"{value:.1e}" if value != 0 and abs(value) < 1e-3 else f"{value:.4g}"
