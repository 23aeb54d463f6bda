"""Animated trajectories: one SVG without scripts."""

from __future__ import annotations

from typing import TypedDict, Unpack

import html
import re
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core import validation
from jaxltl.core.automata.automaton import Automaton
from jaxltl.envs.text_map import parse_map
from jaxltl.plot.live import CELL, live_automaton, live_map
from jaxltl.plot.style import ACCENT, FAINT, GOOD, INK, MUTED, PAPER

_RUN, _GAP, _REST = "#c2571a", 24.0, 2.0


class _Playing(TypedDict, total=False):
    """Rarely needed options of :func:`playback`, described there."""

    wait: float
    times: int
    wall: str


def playback(
    cells: str | NDArray[np.str_],
    states: ArrayLike,
    *,
    automaton: Automaton | None = None,
    memory: ArrayLike | None = None,
    label: str = "",
    **playing: Unpack[_Playing],
) -> str:
    """An animated SVG of a trajectory on a map, next to the state of the task's automaton.

    It plays `times` times and then shows the whole way; at once if reduced motion is preferred.

    Args:
      cells: a text map (see :func:`jaxltl.envs.text_map.parse_map`) or its cells.
      states: ``int[T]``, the cells of the run, in order.
      automaton, memory: an automaton and ``int[T]``, its state at each of the steps; or neither.
      label: the text alternative; default the number of steps.
      wait, times, wall: seconds for each step (default 0.4), the number of repetitions (3), and the
        kind of walls.

    Raises:
      ValueError: the run is empty or leaves the map, or the automaton and its states do not fit.

    Example:
      >>> "from a to b" in playback("a . b", [0, 1, 2], label="from a to b")
      True
    """
    wait, times, wall = validation.options("playback", playing, wait=0.4, times=3, wall="#")
    kinds = parse_map(cells) if isinstance(cells, str) else np.asarray(cells)
    run = _whole("states", states, kinds.size, "cells")
    panes = [_plain(live_map(kinds, "run", {}, runs=[run], wall=wall))]
    styles = [_moves(run, kinds.shape[1], wait, times)]
    if automaton is not None:
        states_of_it = _whole("memory", memory, len(automaton.delta), "states of the automaton")
        if len(states_of_it) != len(run):
            raise ValueError(
                f"memory has {len(states_of_it)} steps and the run {len(run)}; give "
                "the automaton's state at each step of the run."
            )
        panes.append(_plain(live_automaton(automaton, "task")))
        styles.append(_memories(states_of_it, wait, times))
    elif memory is not None:
        raise ValueError(
            "memory is given without automaton; give the automaton whose states "
            "these are, or neither."
        )
    told = html.escape(label or f"A run of {len(run) - 1} steps on a map", quote=True)
    return _beside(panes, _LOOK + "".join(styles), told)


def _whole(name: str, given: ArrayLike | None, count: int, what: str) -> list[int]:
    found = np.asarray(() if given is None else given)
    if found.ndim != 1 or not found.size or found.dtype.kind not in "iu":
        raise ValueError(
            f"{name} has shape {found.shape} and type {found.dtype}; give int[T], "
            "one number for each step, at least one."
        )
    if found.min() < 0 or found.max() >= count:
        raise ValueError(
            f"{name} has numbers from {found.min()} to {found.max()}; there are "
            f"{count} {what}, so give 0 to {count - 1}."
        )
    return [int(x) for x in found]


def _plain(text: str) -> str:
    """A live picture without its interactive attributes."""
    return re.sub(r' (?:role|tabindex|aria-pressed|aria-label)="[^"]*"', "", text)


def _timed(name: str, frames: Sequence[str], wait: float) -> str:
    """Keyframes of an attribute: one per change, and a pause at the end."""
    total = (len(frames) - 1) * wait + _REST
    kept = [
        t
        for t, now in enumerate(frames)
        if t in (0, len(frames) - 1) or not frames[t - 1] == now == frames[t + 1]
    ]
    parts = [f"{100 * t * wait / total:.2f}%{{{frames[t]}}}" for t in kept]
    return f"@keyframes {name}{{{''.join(parts)}100%{{{frames[-1]}}}}}"


def _plays(name: str, steps: int, wait: float, times: int, how: str = "linear") -> str:
    return f"animation:{name} {(steps - 1) * wait + _REST:g}s {how} {times}"


def _moves(run: list[int], columns: int, wait: float, times: int) -> str:
    """Animation of the token and its line."""
    place = [divmod(s, columns) for s in run]
    at = [
        f"transform:translate({c * CELL + CELL // 2}px,{r * CELL + CELL // 2}px)" for r, c in place
    ]
    done = np.cumsum(
        [0.0, *(CELL * float(np.hypot(r - q, c - b)) for (q, b), (r, c) in pairwise(place))]
    )
    left = [f"stroke-dashoffset:{done[-1] - d:.0f}" for d in done]
    count = len(run)
    return (
        f"{_timed('go', at, wait)}{_timed('draw', left, wait)}"
        f".token{{{at[-1]}}}.track polyline{{stroke-dasharray:{max(done[-1], 1):.0f}}}"
        f"@media (prefers-reduced-motion:no-preference){{.token{{{_plays('go', count, wait, times)}"
        f"}}.track polyline{{{_plays('draw', count, wait, times)}}}}}"
    )


def _memories(memory: list[int], wait: float, times: int) -> str:
    """Animation of the automaton: the current state is filled."""
    parts = []
    for q in sorted(set(memory)):
        for tag, on, off in (
            ("circle", f"fill:{_RUN}", "fill:var(--off)"),
            ("text", f"fill:{PAPER}", f"fill:{INK}"),
        ):
            place, name = f"#task-q{q} {tag}", f"{tag}{q}"
            if memory[-1] == q:
                parts.append(f"{place}{{{on}}}")
            parts.append(_timed(name, [on if now == q else off for now in memory], wait))
            parts.append(
                f"@media (prefers-reduced-motion:no-preference){{{place}{{"
                f"{_plays(name, len(memory), wait, times, 'step-end')}}}}}"
            )
    return "".join(parts)


_LOOK = (
    f"text{{font-family:system-ui,sans-serif;fill:{INK};dominant-baseline:central;"
    "text-anchor:middle}"
    f".cell,.ring{{stroke:{FAINT}}}.cell:not([fill]){{fill:{PAPER}}}.wall{{fill:#55606c}}"
    ".cursor{display:none}"
    ".name{font-size:11px;font-weight:700;text-anchor:start}"
    f".number{{font-size:11px;fill:{MUTED}}}"
    f".track{{display:inline!important}}.track polyline{{fill:none;stroke:{_RUN};"
    f"stroke-width:3;opacity:.55;stroke-linejoin:round}}.track circle{{fill:{_RUN}}}"
    f".token{{fill:{_RUN};stroke:#fff;stroke-width:3}}"
    f".line{{fill:none;stroke:{INK};stroke-width:1.6}}.edge path:not(.line){{fill:{INK}}}"
    f".edge.doomed .line{{stroke:{MUTED}}}.edge.doomed path:not(.line),.edge.doomed text"
    f"{{fill:{MUTED}}}.edge.accepting .line{{stroke:{ACCENT}}}"
    f".edge text{{font-size:13px;paint-order:stroke;stroke:{PAPER};stroke-width:5px}}"
    f".mark{{fill:{ACCENT};font-weight:700}}"
    f".state circle{{--off:{PAPER};fill:var(--off);stroke:{INK};stroke-width:2}}"
    f".state text{{font-size:16px}}.state.final circle{{--off:{GOOD}}}"
    f".state.doomed circle{{--off:#eceef0;stroke:{MUTED}}}"
)


def _beside(panes: Sequence[str], style: str, told: str) -> str:
    """Pictures side by side on a card with a background."""
    sizes = [
        [float(x) for x in re.findall(r'viewBox="\S+ \S+ (\S+) (\S+)"', pane)[0]] for pane in panes
    ]
    high = max(h for _, h in sizes) + 2 * _GAP
    parts, x = [], _GAP
    for pane, (w, h) in zip(panes, sizes, strict=True):
        parts.append(pane.replace("<svg ", f'<svg x="{x:.0f}" y="{(high - h) / 2:.0f}" ', 1))
        x += w + _GAP
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {x:.0f} {high:.0f}" '
        f'width="{x:.0f}" height="{high:.0f}" role="img" aria-label="{told}">'
        f"<title>{told}</title><style>{style}</style>"
        f'<rect width="100%" height="100%" rx="10" fill="{PAPER}"/>{"".join(parts)}</svg>'
    )
