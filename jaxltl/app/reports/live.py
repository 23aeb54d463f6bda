"""A report as one page: what is said, the parts that move with the same in tables, and pictures.

A part that moves is HTML; the page's script finds the elements by class and data attributes, and
what it must know in one block of JSON.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from string import Template
from typing import Any, NamedTuple

import numpy as np

from jaxltl.app.drawing import Picture
from jaxltl.app.explorer import START, Curves, Explorer, TooLarge
from jaxltl.app.files.task import place, where
from jaxltl.app.reports.page import Remark, number, probability, rows
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.text import edge_guards
from jaxltl.core.environments.monitor import Verdict, verdicts

_NARROW = 24  # columns of a map that shares the width with the automaton
_MOST_ROWS = 12  # of a table of curves
_SIGNS = {"up": "↑", "down": "↓", "left": "←", "right": "→", "stay": "•"}
_MARKS = {
    "buchi": " Dots: arrows to be taken again and again.",
    "parity": " Numbers: the least that is met again and again must be even.",
}
Part = tuple[Explorer | Curves | TooLarge, Mapping[str, str]]  # with its pictures as SVG


class Said(NamedTuple):
    """What a page says of a result.

    Attributes:
      sentence: what was done, as HTML.
      remarks: what a reader must know first.
      tiles, told: HTML before and after the policies.
      file: what the file is called that was read.
    """

    sentence: str
    remarks: Sequence[Remark]
    tiles: str
    told: Sequence[str]
    file: str = "The task file"


def live_page(
    result: Mapping[str, Any],
    said: Said,
    parts: Sequence[Part],
    pictures: Iterable[tuple[Picture, bytes]],
    task_text: str,
) -> str:
    """A page that needs no other file and no network.

    First what matters, then policies to look into, tables, curves, pictures and the task.

    Args:
      result: what ``result.json`` holds; read are its task, formula, versions and seconds.
      said: what is said of it.
      parts: what moves.
      pictures: with their SVG; those that a part stands for are left out.
      task_text: the task file, shown at the end.
    """
    name, names = html.escape(result["task"]), {p.name for p, _ in parts}
    names -= {part.name for part, _ in parts if isinstance(part, TooLarge)}
    body = [
        f"<h1>{name}</h1><p class=muted>{said.sentence}</p>"
        f"<p class=formula><code>{html.escape(result['formula'])}</code></p>",
        _remarks(said.remarks),
        said.tiles,
        *(section(*part) for part in parts if not isinstance(part[0], Curves)),
        *said.told,
        *(section(*part) for part in parts if isinstance(part[0], Curves)),
        *(_picture(*one) for one in pictures if one[0].live not in names),
        f"<h2>{said.file}</h2><div class=scroll><pre><code>{html.escape(task_text)}</code></pre>"
        f"</div><p class=muted>jaxltl {result['versions']['jaxltl']}, "
        f"jax {result['versions']['jax']}, {result['seconds']:.1f} s</p>",
    ]
    moving = [data(part) for part, _ in parts if isinstance(part, Explorer)]
    known = json.dumps(moving, separators=(",", ":"), allow_nan=False)
    return Template(_file("page.html")).substitute(
        title=name,
        style=_file("page.css"),
        script=_file("page.js"),
        body="\n".join(body),
        # Nothing in it may end the script that it stands in.
        data=known.replace("<", "\\u003c"),
    )


def _file(name: str) -> str:
    return resources.files("jaxltl.app.reports").joinpath(name).read_text("utf-8")


def _remarks(told: Iterable[Remark]) -> str:
    said = {"warning": "<b>Warning:</b> "}
    items = [
        f'<li class="{kind}">{said.get(kind, "")}{html.escape(text)}</li>' for kind, text in told
    ]
    return f'<ul class="remarks">{"".join(items)}</ul>' if items else ""


def _picture(picture: Picture, svg: bytes) -> str:
    title, caption = html.escape(picture.title), html.escape(picture.caption)
    image = base64.b64encode(svg).decode()
    return (
        f'<h2>{title}</h2><figure><div class="paper"><img alt="{title}: {caption}" '
        f'src="data:image/svg+xml;base64,{image}"></div><figcaption>{caption}</figcaption></figure>'
    )


def section(part: Explorer | Curves | TooLarge, drawn: Mapping[str, str]) -> str:
    """A part of a page, with its pictures as SVG."""
    if isinstance(part, TooLarge):
        return _remarks([("note", part.text)])
    if isinstance(part, Curves):
        return _curves(part, drawn)
    return _explorer(part, drawn)


def data(part: Explorer) -> dict[str, Any]:
    """What the page's script must know of an explorer."""

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
        "told": _told(part),
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


def _told(part: Explorer) -> dict[str, str]:
    """What each memory stands for, and each other layer."""
    found: dict[str, str] = {}
    if part.automaton is None:
        return found
    names = part.automaton.state_names or ("",) * len(part.automaton.delta)
    for q, (name, verdict) in enumerate(zip(names, verdicts(part.automaton), strict=True)):
        told = [_verdict(verdict, part.goal), name and f"left to satisfy: {name}"]
        if part.layers and str(q) not in part.layers and verdict == Verdict.UNDECIDED:
            told[0] = "nothing is shown: no policy meets this memory"
        found[str(q)] = f"Memory {q}: " + "; ".join(text for text in told if text)
    return {**found, START: f"Where a run starts: {part.label} from there"}


def _verdict(verdict: int, goal: str) -> str:
    return {Verdict.SATISFIED: f"{goal} is done", Verdict.VIOLATED: f"{goal} has failed"}.get(
        Verdict(int(verdict)), ""
    )


def _explorer(part: Explorer, drawn: Mapping[str, str]) -> str:
    panes, tables = "", "".join(_layer_table(part, key) for key in part.layers)
    folds = [("What is shown, as a table", tables)]
    if part.automaton is not None:
        marks = _MARKS.get(part.automaton.acceptance, "")
        folds.append(("The automaton as a table", _automaton_table(part.automaton, part.goal)))
        panes = (
            '<div><h3>Its memory: the automaton</h3><div class="scroll">'
            f'{drawn["automaton"]}</div><p class="muted">Filled: the memory that is shown. Double '
            f"circle: {part.goal} is done, whatever follows. Grey: it has failed.{marks}</p></div>"
        )
    runs = [_run_table(part, i) for i in range(len(part.runs))]
    folds.append(("The run as a table", "".join(runs)))
    hint, narrow = "Choose a state of the automaton, or play a run.", False
    if part.shape is not None:
        narrow = part.shape[1] <= _NARROW and part.automaton is not None
        colored = any(layer.value is not None for layer in part.layers.values())
        scale = (
            (
                '<p class="scale"><span>0</span><i></i><span>1</span> '
                f"<span>{html.escape(part.label)}</span></p>"
            )
            if colored
            else ""
        )
        hint = "Point at a cell of the map, choose a state of the automaton, or play a run."
        panes = (
            '<div><h3>The map</h3><div class="scroll board" tabindex="0" role="group" '
            'aria-label="Map; the arrow keys go from cell to cell">'
            f"{drawn['map']}</div>{scale}</div>{panes}"
        )
    return (
        f'<section class="explorer" id="{part.name}"><h2>{html.escape(part.title)}</h2>'
        f'<p class="muted">{html.escape(part.caption)}</p><div class="card">{_choice(part)}'
        f'<p class="memory" aria-live="polite"></p>{_player(part)}'
        f'<p class="readout" role="status" aria-live="polite">{hint}</p>'
        f'{_marked(part)}<div class="panes{" two" if narrow else ""}">{panes}</div></div>'
        f"{''.join(folded(*fold) for fold in folds if fold[1])}</section>"
    )


def _marked(part: Explorer) -> str:
    """The steps that the map has in red, in words."""
    steps = [
        f"{part.places.get(s, place(where(s, part.shape)))}, memory {q}, {part.actions[a]}"
        for s, q, a in part.marked
    ]
    if not steps:
        return ""
    return f"<p class=bad><b>{html.escape(part.marks)}:</b> {html.escape('; '.join(steps))}</p>"


def folded(title: str, content: str) -> str:
    """What is opened when it is asked for."""
    return f"<details><summary>{title}</summary>{content}</details>"


def _choice(part: Explorer) -> str:
    """A button for each layer."""
    if not part.layers:
        return ""
    buttons = "".join(
        f'<button type="button" data-memory="{key}" aria-pressed="false" '
        f'title="{html.escape(layer.name)}">{"starts" if key == START else key}</button>'
        for key, layer in part.layers.items()
    )
    return (
        f'<div class="choose" role="group" aria-label="Memory that is shown">'
        f"<span>Memory</span>{buttons}</div>"
    )


def _player(part: Explorer) -> str:
    if not part.runs:
        return ""
    options = "".join(
        f'<option value="{i}">{html.escape(run.name)}</option>' for i, run in enumerate(part.runs)
    )
    return (
        f'<div class="player" role="group" aria-label="Runs"><select aria-label="Run">{options}'
        '</select><button type="button" class="back" aria-label="One step back">‹</button>'
        '<button type="button" class="play" aria-pressed="false">Play</button>'
        '<button type="button" class="on" aria-label="One step on">›</button>'
        '<input type="range" min="0" max="0" value="0" step="1" aria-label="Step of the run"></div>'
    )


def _layer_table(part: Explorer, key: str) -> str:
    """The numbers of a layer, as they lie on the map or state by state."""
    layer = part.layers[key]
    size = len(part.names)
    texts = []
    for state in range(size):
        value = None if layer.value is None else _finite(layer.value[state])
        chances = None if layer.policy is None else layer.policy[state]
        told = [html.escape(part.names[state])] if part.names[state] else []
        if value is not None:
            told.append(probability(value))
        if chances is not None and np.isfinite(chances).all():
            best = part.actions[int(np.argmax(chances))]
            told.append(_SIGNS.get(best, html.escape(best)))
        texts.append(" ".join(told))
    caption = f"<caption>{html.escape(layer.name)}: the likeliest action</caption>"
    if layer.policy is None:
        caption = f"<caption>{html.escape(layer.name)}: {html.escape(part.label)}</caption>"
    if part.shape is None:
        return rows(
            ("state", "figures"),
            [(str(s), text) for s, text in enumerate(texts)],
            caption,
            f'data-memory="{key}"',
        )
    down, across = part.shape
    lines = [(str(r + 1), *texts[r * across : (r + 1) * across]) for r in range(down)]
    header = ("row", *(str(c + 1) for c in range(across)))
    return rows(header, lines, caption, f'data-memory="{key}"')


def _automaton_table(automaton: Automaton, goal: str) -> str:
    names = automaton.state_names or ("",) * len(automaton.delta)
    moves: dict[int, list[str]] = {}
    for (q, target, _), guard in edge_guards(automaton).items():
        moves.setdefault(q, []).append(f"<code>{html.escape(guard)}</code> to {target}")
    lines = []
    for q, verdict in enumerate(verdicts(automaton)):
        kind = _verdict(verdict, goal)
        if q == int(automaton.initial):
            kind = "first" + (f"; {kind}" if kind else "")
        lines.append(
            (str(q), kind, f"<code>{html.escape(names[q])}</code>", "<br>".join(moves.get(q, ())))
        )
    return rows(("state", "verdict", "left to satisfy", "goes on"), lines, "", 'class="told"')


def _run_table(part: Explorer, number: int) -> str:
    run = part.runs[number]
    lines = [
        (
            str(t),
            html.escape(part.places.get(state, place(where(state, part.shape)))),
            str(memory),
            "" if action is None else html.escape(part.actions[action]),
        )
        for t, (state, memory, action) in enumerate(run.steps)
    ]
    return rows(
        ("step", "where", "memory", "action"),
        lines,
        f"<caption>{html.escape(run.name)}</caption>",
        f'class="told" data-run="{number}"',
    )


def _curves(part: Curves, drawn: Mapping[str, str]) -> str:
    plots = "".join(
        f"<figure><h3>{html.escape(name.replace('_', ' '))}</h3>{svg}</figure>"
        for name, svg in drawn.items()
    )
    chosen = _spread(len(part.steps))
    lines = [
        (str(int(part.steps[t])), *(number(_median(x[t])) for x in part.figures.values()))
        for t in chosen
    ]
    header = ("step", *(name.replace("_", " ") for name in part.figures))
    return (
        f'<section id="{part.name}"><h2>{html.escape(part.title)}</h2>'
        f'<p class="muted">{html.escape(part.caption)}</p><div class="curves">{plots}</div>'
        f"{folded('Learning as a table', rows(header, lines))}</section>"
    )


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def _spread(count: int) -> Sequence[int]:
    """Some of so many rows, the first and the last among them."""
    return sorted({int(t) for t in np.linspace(0, count - 1, min(count, _MOST_ROWS))})
