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
from typing import Any

import click
import jinja2
import numpy as np
from markupsafe import Markup

from jaxltl.app.reports.certificate import certificate_lines
from jaxltl.app.reports.drawing import Picture
from jaxltl.app.reports.explorer import START, Curves, Explorer, ReportTrajectory
from jaxltl.app.wording import Record, Result, counted
from jaxltl.io.demonstrations import position_text, state_position
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.text import edge_guards
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.policies.finite_memory import ARROWS, action_text
from jaxltl.io import templates

Part = tuple[Explorer | Curves, Mapping[str, str]]  # with its drawings as SVG
Remark = tuple[str, str]  # kind, "warning" (red), "note" or "good", and text

_CURVE_ROWS = 12  # of a table of learning curves


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
        return "\n".join(lines + remark_lines(remarks) + ([""] if proofs else []) + proofs)

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
    data = [explorer_data(part) for part, _ in explorers]
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


@functools.cache
def _environment() -> jinja2.Environment:
    environment = templates.environment("jaxltl.app.reports")
    formats = (number, probability, certified, mean_deviation, rounded_down, position_text, counted)
    environment.filters |= {function.__name__: function for function in formats}
    parts = (position, layer_table, run_rows, machine_rows, automaton_rows, curve_table)
    environment.globals |= {function.__name__: function for function in parts}
    return environment


def _static(name: str) -> Markup:
    loader = _environment().loader
    assert loader is not None
    return Markup(loader.get_source(_environment(), name)[0])


# --- explorers ------------------------------------------------------------------------------


def explorer_data(part: Explorer) -> Record:
    """The data of an explorer that the page's script reads."""

    def listed(array: np.ndarray | None) -> Any:
        if array is None:
            return None
        return [_finite(x) for x in array] if array.ndim == 1 else [listed(x) for x in array]

    return {
        "name": part.name,
        "label": part.label,
        "actions": part.actions,
        "rows": part.shape and part.shape[0],
        "columns": part.shape and part.shape[1],
        "first": next(iter(part.layers), None),
        "memories": _memory_texts(part),
        "cells": part.cells,
        "places": part.places,
        "layers": {
            key: {"value": listed(layer.value), "policy": listed(layer.policy)}
            for key, layer in part.layers.items()
        },
        "window": part.window,
        "runs": [
            {
                "name": run.name,
                "steps": run.steps,
                "observations": run.observations,
                "beliefs": None if run.beliefs is None else _sparse_rows(run.beliefs),
            }
            for run in part.runs
        ],
    }


def _sparse_rows(rows: np.ndarray) -> list[list[tuple[int, float]]]:
    """Columns and entries of each row, largest first."""
    return [
        [
            (int(s), round(float(row[s]), 4))
            for s in np.argsort(-row, kind="stable")
            if row[s] >= 5e-5
        ]
        for row in rows
    ]


def _finite(value: float) -> float | None:
    return round(float(value), 6) if np.isfinite(value) else None


def _verdict(verdict: int, goal: str) -> str:
    words = {Verdict.SATISFIED: f"{goal} is satisfied", Verdict.VIOLATED: f"{goal} is violated"}
    return words.get(Verdict(int(verdict)), "")


def _memory_texts(part: Explorer) -> dict[str, str]:
    """Meaning of each memory state, and of the layer of initial states."""
    meanings: dict[str, str] = {}
    if part.machine:
        count = 1 + max(target for _, target, _, _ in part.machine)
        return {str(q): f"Memory state {q}" for q in range(count)}
    if part.automaton is None:
        return meanings
    names = part.automaton.state_names or ("",) * len(part.automaton.delta)
    for q, (name, verdict) in enumerate(zip(names, verdicts(part.automaton), strict=True)):
        texts = [_verdict(verdict, part.goal), name and f"remaining formula {name}"]
        if part.layers and str(q) not in part.layers and verdict == Verdict.UNDECIDED:
            texts[0] = "no values: no policy reaches this memory state"
        meanings[str(q)] = f"Memory state {q}: " + "; ".join(text for text in texts if text)
    return {**meanings, START: f"Initial states: {part.label} from there"}


def position(part: Explorer, state: int) -> str:
    """The text of a state's position."""
    return part.places.get(state) or position_text(state_position(state, part.shape))


def layer_table(part: Explorer, key: str) -> tuple[tuple[object, ...], list[Any], str]:
    """Header, rows and caption of the values and likeliest actions of a layer."""
    layer, texts = part.layers[key], []
    for state, name in enumerate(part.names):
        value = None if layer.value is None else _finite(layer.value[state])
        chances = None if layer.policy is None else layer.policy[state]
        text = [name] if name else []
        if value is not None:
            text.append(probability(value))
        if chances is not None and np.isfinite(chances).all():
            best = part.actions[int(np.argmax(chances))]
            text.append(ARROWS.get(best, best))
        texts.append(" ".join(text))
    caption = f"{layer.name}: {part.label if layer.policy is None else 'the likeliest action'}"
    if part.shape is None:
        return ("state", "values"), list(enumerate(texts)), caption
    down, across = part.shape
    rows = [(r + 1, *texts[r * across : (r + 1) * across]) for r in range(down)]
    return ("row", *range(1, across + 1)), rows, caption


def run_rows(part: Explorer, run: ReportTrajectory) -> list[tuple[object, ...]]:
    """Step, position, memory state and action of a trajectory; with beliefs, what it sees and believes."""
    rows: list[tuple[object, ...]] = [
        (t, position(part, s), q, "" if a is None else part.actions[a])
        for t, (s, q, a) in enumerate(run.steps)
    ]
    if run.beliefs is None:
        return rows
    likely = [
        "; ".join(f"{position(part, s)} {probability(p)}" for s, p in row[:3])
        + ("; …" if len(row) > 3 else "")
        for row in _sparse_rows(run.beliefs)
    ]
    return [(*row, o, text) for row, o, text in zip(rows, run.observations, likely, strict=True)]


def machine_rows(part: Explorer) -> list[tuple[object, ...]]:
    """Memory state, entered observation, next memory state and action of a controller."""
    return [
        ("start" if source < 0 else source, observation, target, action_text(action, part.actions))
        for source, target, observation, action in part.machine
    ]


def automaton_rows(automaton: Automaton, goal: str) -> list[Record]:
    """The states of an automaton with their verdicts and transitions."""
    names = automaton.state_names or ("",) * len(automaton.delta)
    moves: dict[int, list[tuple[str, int]]] = {}
    for (q, target, _), guard in edge_guards(automaton).items():
        moves.setdefault(q, []).append((guard, target))
    initial = int(automaton.initial)
    return [
        {
            "number": q,
            "verdict": "; ".join(
                filter(None, ("initial" if q == initial else "", _verdict(verdict, goal)))
            ),
            "name": names[q],
            "transitions": moves.get(q, []),
        }
        for q, verdict in enumerate(verdicts(automaton))
    ]


def curve_table(part: Curves) -> tuple[tuple[str, ...], list[tuple[object, ...]]]:
    """Header and rows of the medians of metrics over seeds."""
    count = len(part.steps)
    rows = sorted({int(t) for t in np.linspace(0, count - 1, min(count, _CURVE_ROWS))})
    header = ("step", *(name.replace("_", " ") for name in part.metrics))
    medians = ((number(_median(x[t])) for x in part.metrics.values()) for t in rows)
    return header, [(int(part.steps[t]), *row) for t, row in zip(rows, medians, strict=True)]


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


# --- formats ---------------------------------------------------------------------------------


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
