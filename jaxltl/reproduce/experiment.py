"""Parts that several experiments of the dissertation share."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import jax

from jaxltl.io.templates import render

ResultT = TypeVar("ResultT")
Figures = dict[str, Any]  # numbers, texts, and lists and dicts of them, as in JSON


def run_seconds(job: Callable[[], ResultT]) -> tuple[ResultT, float]:
    """The result of a job and the seconds of its second run; the first run compiles."""
    jax.block_until_ready(job())
    begin = time.perf_counter()
    return jax.block_until_ready(job()), round(time.perf_counter() - begin, 4)


def render_table(template: str, **values: object) -> str:
    """A report by a template, without blanks at the ends of lines."""
    lines = render("jaxltl.reproduce", template, **values).splitlines()
    return "\n".join(line.rstrip() for line in lines)


def svg_files(drawn: Mapping[str, Any]) -> list[tuple[str, bytes]]:
    """SVG files of drawn figures by name."""
    from jaxltl import plot

    return [(f"{name}.svg", plot.to_bytes(figure)) for name, figure in drawn.items()]
