"""Reports as pages and texts: jinja2 templates, formats of numbers, and interactive parts."""

from __future__ import annotations

import base64
import functools
import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import click
import jinja2
import numpy as np
from markupsafe import Markup

from jaxltl.app.reports.drawing import Picture
from jaxltl.app.reports.explorer import START, Curves, Explorer, Layer, TooLarge
from jaxltl.app.wording import Record, Result, many, place, where
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.text import edge_guards
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.io import templates

Part = tuple[Explorer | Curves | TooLarge, Mapping[str, str]]  # with its drawings as SVG

_NARROW = 24  # columns of the widest map that is shown next to the automaton
_CURVE_ROWS = 12  # of a table of learning curves
_ARROWS = {"up": "↑", "down": "↓", "left": "←", "right": "→", "stay": "•"}
_MARKS = {
    "buchi": " Dots: transitions to be taken infinitely often.",
    "parity": " Numbers: the least one that occurs infinitely often must be even.",
}


def render_page(
    template: str,
    result: Result,
    parts: Sequence[Part],
    pictures: Iterable[tuple[Picture, bytes]],
    file_text: str,
    **context: object,
) -> str:
    """A page that needs no other file and no network."""
    explorers = [(part, drawn) for part, drawn in parts if isinstance(part, Explorer)]
    replaced = {part.name for part, _ in parts if not isinstance(part, TooLarge)}
    known = json.dumps(
        [explorer_data(part) for part, _ in explorers], separators=(",", ":"), allow_nan=False
    )
    values = {
        "title": result["task"],
        "formula": result["formula"],
        "versions": result["versions"],
        "seconds": result["seconds"],
        "result": result,
        "remarks": (),
        "file_title": "Task file",
        "file_text": file_text,
        "explorers": [_explorer_view(part, drawn) for part, drawn in explorers],
        "curves": [_curves_view(part, drawn) for part, drawn in parts if isinstance(part, Curves)],
        "too_large": [part.text for part, _ in parts if isinstance(part, TooLarge)],
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


def render_table(template: str, remarks: Iterable[Remark], **values: object) -> str:
    """A report for the terminal, with its remarks at the end."""
    return "\n".join([*render_text(template, **values), *remark_lines(remarks)])


def render_remarks(template: str, **values: object) -> list[Remark]:
    """Remarks of a template whose lines are ``kind: text``."""
    lines = (line.partition(": ") for line in render_text(template, **values) if line)
    return [(kind, text) for kind, _, text in lines]


@functools.cache
def _environment() -> jinja2.Environment:
    found = templates.environment("jaxltl.app.reports")
    functions = (number, probability, certified, mean_deviation, rounded_down, place, many)
    found.filters |= {function.__name__: function for function in functions}
    return found


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
        "runs": [{"name": run.name, "steps": run.steps} for run in part.runs],
    }


def _finite(value: float) -> float | None:
    return round(float(value), 6) if np.isfinite(value) else None


def _verdict(verdict: int, goal: str) -> str:
    words = {Verdict.SATISFIED: f"{goal} is satisfied", Verdict.VIOLATED: f"{goal} is violated"}
    return words.get(Verdict(int(verdict)), "")


def _memory_texts(part: Explorer) -> dict[str, str]:
    """Meaning of each memory state, and of the layer of initial states."""
    found: dict[str, str] = {}
    if part.automaton is None:
        return found
    names = part.automaton.state_names or ("",) * len(part.automaton.delta)
    for q, (name, verdict) in enumerate(zip(names, verdicts(part.automaton), strict=True)):
        texts = [_verdict(verdict, part.goal), name and f"remaining formula {name}"]
        if part.layers and str(q) not in part.layers and verdict == Verdict.UNDECIDED:
            texts[0] = "no values: no policy reaches this memory state"
        found[str(q)] = f"Memory state {q}: " + "; ".join(text for text in texts if text)
    return {**found, START: f"Initial states: {part.label} from there"}


def _explorer_view(part: Explorer, drawn: Mapping[str, str]) -> Record:
    """The values that the template of an explorer reads."""
    hint = "Choose a state of the automaton, or play a trajectory."
    if part.shape is not None:
        hint = "Point at a cell of the map, choose a state of the automaton, or play a trajectory."
    marked = (
        f"{_position(part, s)}, memory state {q}, {part.actions[a]}" for s, q, a in part.marked
    )
    automaton = part.automaton
    return {
        **{k: getattr(part, k) for k in ("name", "title", "caption", "label", "goal", "marks")},
        "layers": [(key, layer.name) for key, layer in part.layers.items()],
        "hint": hint,
        "marked": "; ".join(marked),
        "narrow": part.shape is not None and part.shape[1] <= _NARROW and automaton is not None,
        "map": Markup(drawn["map"]) if part.shape is not None else "",
        "colored": any(layer.value is not None for layer in part.layers.values()),
        "automaton": automaton
        and {
            "drawing": Markup(drawn["automaton"]),
            "marks": _MARKS.get(automaton.acceptance, ""),
            "states": _automaton_rows(automaton, part.goal),
        },
        "tables": [_layer_table(part, key, layer) for key, layer in part.layers.items()],
        "runs": [
            {
                "name": run.name,
                "rows": [
                    (t, _position(part, s), q, "" if a is None else part.actions[a])
                    for t, (s, q, a) in enumerate(run.steps)
                ],
            }
            for run in part.runs
        ],
    }


def _position(part: Explorer, state: int) -> str:
    return part.places.get(state) or place(where(state, part.shape))


def _layer_table(part: Explorer, key: str, layer: Layer) -> Record:
    """The values and likeliest actions of a layer, as a map or state by state."""
    texts = []
    for state, name in enumerate(part.names):
        value = None if layer.value is None else _finite(layer.value[state])
        chances = None if layer.policy is None else layer.policy[state]
        text = [name] if name else []
        if value is not None:
            text.append(probability(value))
        if chances is not None and np.isfinite(chances).all():
            best = part.actions[int(np.argmax(chances))]
            text.append(_ARROWS.get(best, best))
        texts.append(" ".join(text))
    meaning = "the likeliest action" if layer.policy is not None else part.label
    table: Record = {"key": key, "caption": f"{layer.name}: {meaning}"}
    if part.shape is None:
        return table | {"header": ("state", "values"), "rows": list(enumerate(texts))}
    down, across = part.shape
    return table | {
        "header": ("row", *range(1, across + 1)),
        "rows": [(r + 1, *texts[r * across : (r + 1) * across]) for r in range(down)],
    }


def _automaton_rows(automaton: Automaton, goal: str) -> list[Record]:
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


# --- curves ---------------------------------------------------------------------------------


def _curves_view(part: Curves, drawn: Mapping[str, str]) -> Record:
    """The values that the template of learning curves reads."""
    count = len(part.steps)
    shown = sorted({int(t) for t in np.linspace(0, count - 1, min(count, _CURVE_ROWS))})
    names = [name.replace("_", " ") for name in part.figures]
    return {
        **{k: getattr(part, k) for k in ("name", "title", "caption")},
        "plots": [(name.replace("_", " "), Markup(svg)) for name, svg in drawn.items()],
        "header": ("step", *names),
        "rows": [
            (int(part.steps[t]), *(number(_median(x[t])) for x in part.figures.values()))
            for t in shown
        ],
    }


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


# --- formats ---------------------------------------------------------------------------------


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
