"""Reports as pages and texts: jinja2 templates, formats of numbers, and interactive parts."""

from __future__ import annotations

import base64
import functools
import json
import math
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from dataclasses import dataclass
from typing import TYPE_CHECKING

import click
import jinja2
from markupsafe import Markup

from jaxltl.io.certificate.results import certificate_lines
from jaxltl.plot import explorer
from jaxltl.plot.drawing import Picture, learning_picture
from jaxltl.plot.explorer import Curves, Explorer, number as number, probability as probability
from jaxltl.app.wording import Record, Result, counted
from jaxltl.io.demonstrations import position_text
from jaxltl.io import templates

if TYPE_CHECKING:
    import numpy as np

Section = Picture | Explorer | Curves  # of a report
Part = tuple[Explorer | Curves, Mapping[str, str]]  # with its drawings as SVG
Remark = tuple[str, str]  # kind, "warning" (red), "note" or "good", and text


@dataclass(frozen=True)
class Report:
    """The report of a kind of job, by templates ``NAME.html``, ``NAME.txt``, ``NAME_remarks.txt``."""

    name: str
    values: Callable[[Result], Record]  # that the templates read besides the result
    has_remarks: bool = True  # whether the text ends with the remarks

    def page(
        self,
        result: Result,
        parts: Sequence[Part],
        pictures: Iterable[tuple[Picture, bytes]],
        file_text: str,
    ) -> str:
        """The report in HTML."""
        values = {"remarks": self.remarks(result), **self.values(result)}
        return render_page(f"{self.name}.html", result, parts, pictures, file_text, **values)

    def table(self, result: Result, out: Path = Path()) -> str:
        """The result, in a directory, as text for the terminal."""
        lines = render_text(f"{self.name}.txt", result=result, **self.values(result))
        remarks = self.remarks(result) if self.has_remarks else []
        proofs = certificate_lines(result.get("certificates", ()), out)
        lines += [  # as paragraphs, warnings in red
            "\n" + (click.style(f"warning: {text}", fg="red") if kind == "warning" else text)
            for kind, text in remarks
        ]
        return "\n".join(lines + ([""] if proofs else []) + proofs)

    def remarks(self, result: Result) -> list[Remark]:
        """Remarks on the result, by a template whose lines are ``kind: text``."""
        lines = render_text(f"{self.name}_remarks.txt", result=result, **self.values(result))
        split = (line.partition(": ") for line in lines if line)
        return [(kind, text) for kind, _, text in split]


def render_page(
    template: str,
    result: Result,
    parts: Sequence[Part],
    pictures: Iterable[tuple[Picture, bytes]],
    file_text: str,
    **context: object,
) -> str:
    """A page that needs no other file and no network."""
    large = [part.too_large for part, _ in parts if isinstance(part, Explorer) and part.too_large]
    explorers = [(x, drawn) for x, drawn in parts if isinstance(x, Explorer) and not x.too_large]
    curves = [(part, drawn) for part, drawn in parts if isinstance(part, Curves)]
    replaced = {x.name for x, _ in explorers} | {x.name for x, _ in curves}
    data = [explorer.explorer_data(part) for part, _ in explorers]
    known = json.dumps(data, separators=(",", ":"), allow_nan=False)
    values = {
        "title": result["task"],
        "formula": result.get("formula"),
        "versions": result["versions"],
        "seconds": result["seconds"],
        "result": result,
        "remarks": (),
        "proofs": certificate_lines(result.get("certificates", ())),
        "file_title": "Task file",
        "file_text": file_text,
        "explorers": explorers,
        "curves": curves,
        "too_large": large,
        "pictures": [
            (picture, base64.b64encode(svg).decode())
            for picture, svg in pictures
            if picture.live not in replaced
        ],
        "style": _static("page.css"),
        "script": _static("page.js"),
        # "<" is escaped, so that no text ends the script element.
        "data": Markup(known.replace("<", "\\u003c")),
    }
    return _environment().get_template(template).render(values | context)


def render_text(template: str, **values: object) -> list[str]:
    """The lines of a text."""
    text = _environment().get_template(template).render(values)
    return [line.rstrip() for line in text.splitlines()]


def learning_curves(
    history: Mapping[str, np.ndarray], names: Sequence[str], caption: str, num_seeds: int
) -> list[Section]:
    """Learning curves of some metrics, as a picture and as an interactive part."""
    band = "; the line is the median over seeds, the band their range" if num_seeds > 1 else ""
    text = f"{caption}{band}."
    return [
        learning_picture(history, text, names),
        explorer.curves("learning", "Learning", text, history, names),
    ]


@functools.cache
def _environment() -> jinja2.Environment:
    environment = templates.environment("jaxltl.app.reports")
    formats = (number, probability, certified, mean_deviation, rounded_down, position_text, counted)
    environment.filters |= {function.__name__: function for function in formats}
    parts = ("position", "layer_table", "run_rows", "machine_rows", "automaton_rows", "curve_table")
    environment.globals |= {name: getattr(explorer, name) for name in parts}
    return environment


def _static(name: str) -> Markup:
    loader = _environment().loader
    assert loader is not None
    return Markup(loader.get_source(_environment(), name)[0])


# --- formats ---------------------------------------------------------------------------------


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


def rounded_down(value: float) -> str:
    """A lower bound, rounded down to four places."""
    return f"{math.floor(value * 1e4) / 1e4:.4f}"


def cells(entry: Result) -> tuple[str, str]:
    """A probability and its certificate, as cells of a table."""
    return probability(entry["value"]), certified(entry)


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
