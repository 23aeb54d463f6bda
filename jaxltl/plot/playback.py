"""Animated trajectories: one SVG without scripts."""

from __future__ import annotations

from typing import TypedDict, Unpack

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core import validation
from jaxltl.core.automata.automaton import Automaton
from jaxltl.envs.text_map import parse_map
from jaxltl.io.templates import render
from jaxltl.plot.live import CELL, live_automaton, live_map
from jaxltl.plot.style import ACCENT, FAINT, GOOD, INK, MUTED, PAPER

_RUN, _GAP, _REST = "#c2571a", 24.0, 2.0
_COLORS = {"run": _RUN, "ink": INK, "faint": FAINT, "paper": PAPER, "muted": MUTED}
_COLORS |= {"accent": ACCENT, "good": GOOD}


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
    place = np.stack(np.divmod(run, kinds.shape[1])[::-1], 1) * CELL + CELL // 2
    done = np.cumsum([0.0, *np.hypot(*np.diff(place, axis=0).T)])
    animations = [
        ("go", ".token", [f"transform:translate({x}px,{y}px)" for x, y in place], "linear"),
        (
            "draw",
            ".track polyline",
            [f"stroke-dashoffset:{done[-1] - d:.0f}" for d in done],
            "linear",
        ),
    ]
    if automaton is not None:
        states_of_it = _whole("memory", memory, len(automaton.delta), "states of the automaton")
        if len(states_of_it) != len(run):
            raise ValueError(
                f"memory has {len(states_of_it)} steps and the run {len(run)}; give "
                "the automaton's state at each step of the run."
            )
        panes.append(_plain(live_automaton(automaton, "task")))
        animations += [
            (
                f"{tag}{q}",
                f"#task-q{q} {tag}",
                [on if x == q else off for x in states_of_it],
                "step-end",
            )
            for q in sorted(set(states_of_it))
            for tag, on, off in (
                ("circle", f"fill:{_RUN}", "fill:var(--off)"),
                ("text", f"fill:{PAPER}", f"fill:{INK}"),
            )
        ]
    elif memory is not None:
        raise ValueError(
            "memory is given without automaton; give the automaton whose states "
            "these are, or neither."
        )
    sizes = [re.findall(r'viewBox="\S+ \S+ (\S+) (\S+)"', pane)[0] for pane in panes]
    wide, high = np.array(sizes, float).T
    begins, high_of_all = _GAP + np.cumsum([0.0, *wide + _GAP]), high.max() + 2 * _GAP
    return render(
        "jaxltl.plot",
        "playback.svg",
        panes=[
            pane.replace("<svg ", f'<svg x="{x:.0f}" y="{(high_of_all - h) / 2:.0f}" ', 1)
            for pane, x, h in zip(panes, begins, high, strict=False)
        ],
        wide=begins[-1],
        high=high_of_all,
        label=label or f"A run of {len(run) - 1} steps on a map",
        animations=[(n, p, _timed(f, wait), f[-1], how) for n, p, f, how in animations],
        seconds=(len(run) - 1) * wait + _REST,
        times=times,
        length=max(done[-1], 1),
        **_COLORS,
    )


def _whole(name: str, values: ArrayLike | None, count: int, noun: str) -> list[int]:
    array = np.asarray(() if values is None else values)
    if array.ndim != 1 or not array.size or array.dtype.kind not in "iu":
        raise ValueError(
            f"{name} has shape {array.shape} and type {array.dtype}; give int[T], "
            "one number for each step, at least one."
        )
    if array.min() < 0 or array.max() >= count:
        raise ValueError(
            f"{name} has numbers from {array.min()} to {array.max()}; there are "
            f"{count} {noun}, so give 0 to {count - 1}."
        )
    return [int(x) for x in array]


def _plain(text: str) -> str:
    """A live picture without its interactive attributes."""
    return re.sub(r' (?:role|tabindex|aria-pressed|aria-label)="[^"]*"', "", text)


def _timed(frames: Sequence[str], wait: float) -> str:
    """Keyframes of an attribute: one per change, and a pause at the end."""
    total = (len(frames) - 1) * wait + _REST
    keyframes = [
        f"{100 * t * wait / total:.2f}%{{{now}}}"
        for t, now in enumerate(frames)
        if t in (0, len(frames) - 1) or not frames[t - 1] == now == frames[t + 1]
    ]
    return f"{''.join(keyframes)}100%{{{frames[-1]}}}"
