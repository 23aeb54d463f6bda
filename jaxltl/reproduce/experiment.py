"""Parts that several experiments of Wen (2019) share."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any, TypeVar

import jax

from jaxltl.app.wording import plain
from jaxltl.app.wording import Record
from jaxltl.io.templates import render

ResultT = TypeVar("ResultT")


def experiment(measure: Callable[..., Record]) -> Callable[..., Any]:
    """Decorator of ``measure(progress, ...)``: values of JSON, with the seconds of everything."""

    @functools.wraps(measure)
    def run(progress: Callable[[str], None] = lambda text: None, **options: Any) -> Any:
        begin = time.perf_counter()
        result = measure(progress, **options)
        return plain({**result, "total_seconds": round(time.perf_counter() - begin, 2)})

    return run


def run_seconds(job: Callable[[], ResultT]) -> tuple[ResultT, float]:
    """The result of a job and the seconds of its second run; the first run compiles."""
    jax.block_until_ready(job())
    begin = time.perf_counter()
    return jax.block_until_ready(job()), round(time.perf_counter() - begin, 4)


def render_table(template: str, **values: object) -> str:
    """A report by a template, without blanks at the ends of lines."""
    lines = render("jaxltl.reproduce", template, **values).splitlines()
    return "\n".join(line.rstrip() for line in lines)
