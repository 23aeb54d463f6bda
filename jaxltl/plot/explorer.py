"""Interactive parts of a page: a policy on a map by memory state, trajectories, and curves.

:mod:`jaxltl.plot.live` draws them; reports write them as HTML.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxltl.plot.drawing import Drawing, drawing
from jaxltl.core.array_types import PyTree
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.text import edge_guards
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.policies.finite_memory import ARROWS, action_text
from jaxltl.core.models import Product, Trajectories
from jaxltl.envs.text_map import plain_kind
from jaxltl.io.demonstrations import position_text, state_position

MAX_CELLS = 20_000  # of all maps of a world together; a page of more takes seconds to load
MAX_STATES = 40  # of an automaton that is drawn
MAX_RUNS = 5  # of each kind
LONGEST_RUN = 200  # steps of a trajectory of the learned policy

_CURVE_ROWS = 12  # of a table of learning curves

START = "start"  # key of the layer of initial states


@dataclass(frozen=True)
class MapLayer:
    """A map: its name, values ``float[S]`` in [0, 1] or None, and policy ``float[S, A]`` or None."""

    name: str
    value: np.ndarray | None
    policy: np.ndarray | None


@dataclass(frozen=True)
class ReportTrajectory:
    """A trajectory: world states, memory states and actions, None in a last step without one.

    Of a world that is seen in part also the number of each observation, and beliefs ``float[T, S]``.
    """

    name: str
    steps: list[tuple[int, int, int | None]]
    observations: Sequence[int] = ()
    beliefs: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class Explorer:
    """A policy in a world, for a page."""

    name: str  # prefix of its HTML ids; pictures with this live are replaced by it
    title: str  # title, caption: for people
    caption: str
    size: int  # S, the number of states or cells
    automaton: Automaton | None  # the policy's memory, or None; see `machine`
    layers: Mapping[str, MapLayer]  # maps by memory state or :data:`START`
    runs: list[ReportTrajectory]  # trajectories
    place: Any = None  # cells of a text map, a coloured world, or None without a map
    actions: Sequence[str] = ()  # A names
    label: str = ""  # of values
    wall: str = "#"  # the kind of cell that cannot be entered
    goal: str = "the formula"  # what the automaton's verdicts are about
    # marked, marks: (state, memory state, action) that are highlighted, and their title
    marked: Sequence[tuple[int, int, int]] = ()
    marks: str = ""
    # cells of the pieces in some states; other states have one piece in their own cell
    cells: Mapping[int, Sequence[int]] = field(default_factory=dict)
    places: Mapping[int, str] = field(default_factory=dict)  # names of some states
    # transitions of a finite-state controller, in place of an automaton, for plot.live_controller
    machine: Sequence[tuple[int, int, int, Sequence[float]]] = ()
    window: int = 0  # side of the window of cells that the robot sees; 0 for none

    @property
    def shape(self) -> tuple[int, int] | None:
        """Rows and columns of the map, if there is one."""
        return None if self.place is None else (int(self.place.shape[0]), int(self.place.shape[1]))

    @property
    def too_large(self) -> str:
        """The remark in place of an explorer that is too large for a page, or no text."""
        count = 0 if self.automaton is None else len(self.automaton.delta)
        if self.size * len(self.layers) <= MAX_CELLS and count <= MAX_STATES:
            return ""
        return (
            f"{self.size} states by {len(self.layers)} maps and an automaton of {count} states are "
            f"too large for interactive maps (at most {MAX_CELLS} states over all maps, and "
            f"{MAX_STATES} automaton states); pictures replace them, and the files in this "
            "directory have the figures."
        )

    @property
    def names(self) -> list[str]:
        """The content of each cell ``[S]``."""
        if self.place is None:
            return [""] * self.size
        if isinstance(self.place, np.ndarray):
            plain = plain_kind(self.place)
            return ["" if kind == plain else str(kind) for kind in self.place.ravel()]
        propositions = np.array(self.place.mdp.propositions)
        return [", ".join(propositions[row]) for row in np.asarray(self.place.mdp.label)]

    @property
    def drawings(self) -> dict[str, Drawing]:
        """Drawings of the automaton and of the map, if there is one."""
        drawn: dict[str, Drawing] = {}
        if self.too_large:
            return drawn
        if self.automaton is not None:
            drawn["automaton"] = drawing("live_automaton", self.automaton, self.name)
        if self.machine:
            drawn["automaton"] = drawing("live_controller", self.machine, self.name, self.actions)
        if self.place is not None:
            drawn["map"] = drawing(
                "live_map",
                self.place,
                self.name,
                {key: (x.value, x.policy) for key, x in self.layers.items()},
                runs=[[self.cells.get(s, [s])[0] for s, _, _ in run.steps] for run in self.runs],
                marked=self.marked,
                actions=self.actions,
                wall=self.wall,
                window=self.window,
                num_pieces=max((len(each) for each in self.cells.values()), default=1),
            )
        return drawn


@dataclass(frozen=True)
class Curves:
    """Learning curves: metrics ``[T, N]`` by name, and their steps ``[T]``."""

    name: str
    title: str
    caption: str
    metrics: Mapping[str, np.ndarray]
    steps: np.ndarray

    @property
    def drawings(self) -> dict[str, Drawing]:
        """A drawing for each metric."""
        return {
            name: drawing("live_curve", name.replace("_", "-"), values, self.steps)
            for name, values in self.metrics.items()
        }


def curves(
    name: str, title: str, caption: str, history: Mapping[str, np.ndarray], show: Iterable[str]
) -> Curves:
    """The learning curves of some metrics, but of those without a finite value."""
    metrics = {k: history[k] for k in show if np.isfinite(history[k]).any()}
    return Curves(name, title, caption, metrics, history["step"])


class _WorldTransitions:
    """Transitions of a world and of a policy's memory, as NumPy arrays."""

    def __init__(self, model: Product) -> None:
        parts = (model.mdp.successor, model.mdp.probability, model.next_memory)
        self.successor, self.probability, self.next_memory = map(np.asarray, parts)
        self.initial_memory = np.asarray(model.initial_memory)
        self.on_entry = model.label_on == "entry"

    def reached(self, state: int, action: int) -> tuple[np.ndarray, np.ndarray]:
        """The successors of an action, and their probabilities."""
        chance = self.probability[state, action].astype(float)
        reached, place = np.unique(self.successor[state, action][chance > 0], return_inverse=True)
        likely = np.bincount(place, chance[chance > 0])
        return reached, likely / likely.sum()

    def remember(self, memory: int, here: int, there: int) -> int:
        return int(self.next_memory[there if self.on_entry else here, memory])


def demonstrated_runs(model: Product, demonstrations: Trajectories) -> list[ReportTrajectory]:
    """The first demonstrations with their memory states, and a deterministic last successor."""
    world, runs = _WorldTransitions(model), []
    states, actions = np.asarray(demonstrations.state), np.asarray(demonstrations.action)
    lengths = np.asarray(demonstrations.length)
    for number in np.flatnonzero(lengths > 0)[:MAX_RUNS].tolist():
        length = int(lengths[number])
        at, did = states[number, :length].tolist(), actions[number, :length].tolist()
        reached, _ = world.reached(at[-1], did[-1])
        if len(reached) == 1:
            at.append(int(reached[0]))
        memory = [int(world.initial_memory[at[0]])]
        for here, there in itertools.pairwise(at):
            memory.append(world.remember(memory[-1], here, there))
        steps = list(itertools.zip_longest(at, memory, did))
        runs.append(ReportTrajectory(f"demonstration {number + 1} of {len(lengths)}", steps))
    return runs


def learned_runs(
    model: Product, policy: np.ndarray, seed: int, count: int = 3
) -> list[ReportTrajectory]:
    """Rollouts of a policy until the formula is decided, or :data:`LONGEST_RUN` steps."""
    rng, world = np.random.default_rng(seed), _WorldTransitions(model)
    decided = verdicts(model.automaton) != Verdict.UNDECIDED
    initial = np.asarray(model.mdp.initial, float)
    longest = LONGEST_RUN if policy.ndim == 3 else min(len(policy), LONGEST_RUN)
    runs = []
    for number in range(count):
        here = int(rng.choice(len(initial), p=initial / initial.sum()))
        memory = int(world.initial_memory[here])
        steps: list[tuple[int, int, int | None]] = []
        while not decided[memory] and len(steps) < longest:
            now = policy if policy.ndim == 3 else policy[len(steps)]
            chances = now[here, memory].astype(float)
            if not (np.isfinite(chances).all() and chances.sum() > 0):
                break
            action = int(rng.choice(len(chances), p=chances / chances.sum()))
            steps.append((here, memory, action))
            reached, likely = world.reached(here, action)
            there = int(rng.choice(reached, p=likely))
            memory, here = world.remember(memory, here, there), there
        runs.append(
            ReportTrajectory(
                f"learned policy, trajectory {number + 1}", [*steps, (here, memory, None)]
            )
        )
    return runs


# --- data and tables of a page ------------------------------------------------------------------


def explorer_data(part: Explorer) -> dict[str, PyTree]:
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


def automaton_rows(automaton: Automaton, goal: str) -> list[dict[str, PyTree]]:
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


def probability(value: float | None) -> str:
    """A probability to four places; a small one with its exponent."""
    if value is None:
        return "unknown"
    return f"{value:.4f}" if value >= 0.00095 or value == 0 else f"{value:.1e}"


def number(value: float | None) -> str:
    """A number in four digits, or "unknown"."""
    if value is None:
        return "unknown"
    return f"{value:.1e}" if value != 0 and abs(value) < 1e-3 else f"{value:.4g}"
