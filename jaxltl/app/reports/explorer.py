"""Interactive parts of a page: a policy on a map by memory state, trajectories, and curves.

:mod:`jaxltl.plot` draws them, :mod:`jaxltl.app.reports.page` writes them as HTML.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jaxltl.app.reports.drawing import Drawing, drawing
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models import Product, Trajectories
from jaxltl.envs.text_map import plain_kind

MOST_CELLS = 20_000  # of all maps of a world together; a page of more takes seconds to load
MOST_STATES = 40  # of an automaton that is drawn
MOST_RUNS = 5  # of each kind
LONGEST_RUN = 200  # steps of a trajectory of the learned policy

START = "start"  # key of the layer of initial states


@dataclass(frozen=True)
class Layer:
    """A map: its name, values ``float[S]`` in [0, 1] or None, and policy ``float[S, A]`` or None."""

    name: str
    value: np.ndarray | None
    policy: np.ndarray | None


@dataclass(frozen=True)
class Run:
    """A trajectory: world states, memory states and actions, None in a last step without one."""

    name: str
    steps: list[tuple[int, int, int | None]]


@dataclass(frozen=True, kw_only=True)
class View:
    """Text and layout of an explorer."""

    name: str  # prefix of its HTML ids; pictures with this live are replaced by it
    title: str  # title, caption: for people
    caption: str
    size: int  # S, the number of states or cells
    place: Any = None  # cells of a text map, a coloured world, or None without a map
    actions: Sequence[str] = ()  # A names
    label: str = ""  # of values
    # the kind of cell that cannot be entered
    wall: str = "#"
    goal: str = "the formula"  # what the automaton's verdicts are about
    # marked, marks: (state, memory state, action) that are highlighted, and their title
    marked: Iterable[tuple[int, int, int]] = ()
    marks: str = ""
    # cells of the pieces in some states; other states have one piece in their own cell
    cells: Mapping[int, Sequence[int]] = field(default_factory=dict)
    places: Mapping[int, str] = field(default_factory=dict)  # names of some states


@dataclass(frozen=True, kw_only=True)
class Explorer(View):
    """A policy in a world, for a page."""

    automaton: Automaton | None  # the policy's memory, or None
    shape: tuple[int, int] | None  # rows and columns of the map, or None
    names: list[str]  # S texts, the content of each cell
    layers: Mapping[str, Layer]  # maps by memory state or :data:`START`
    runs: list[Run]  # trajectories
    drawings: Mapping[str, Drawing]  # "automaton" and, if there is one, "map"


@dataclass(frozen=True)
class Curves:
    """Learning curves: figures ``[T, N]`` by name, and their steps ``[T]``."""

    name: str
    title: str
    caption: str
    figures: Mapping[str, np.ndarray]
    steps: np.ndarray
    drawings: Mapping[str, Drawing]


@dataclass(frozen=True)
class TooLarge:
    """Text in place of an :class:`Explorer` that is too large for a page."""

    name: str
    text: str
    drawings: Mapping[str, Drawing] = field(default_factory=dict)


def explorer(
    view: View, automaton: Automaton | None, layers: Mapping[str, Layer], runs: list[Run]
) -> Explorer | TooLarge:
    """The explorer of a policy, unless it is too large for a page."""
    count = 0 if automaton is None else len(automaton.delta)
    if view.size * len(layers) > MOST_CELLS or count > MOST_STATES:
        text = (
            f"{view.size} states by {len(layers)} maps and an automaton of {count} states are too "
            f"large for interactive maps (at most {MOST_CELLS} states over all maps, and "
            f"{MOST_STATES} automaton states); pictures replace them, and the files in this "
            "directory have the figures."
        )
        return TooLarge(view.name, text)
    marked = [(int(s), int(q), int(a)) for s, q, a in view.marked]
    place, cells = view.place, view.cells
    drawn = {}
    if automaton is not None:
        drawn["automaton"] = drawing("live_automaton", automaton, view.name)
    if place is not None:
        drawn["map"] = drawing(
            "live_map",
            place,
            view.name,
            {key: (x.value, x.policy) for key, x in layers.items()},
            runs=[[cells.get(s, [s])[0] for s, _, _ in run.steps] for run in runs],
            marked=marked,
            actions=view.actions,
            wall=view.wall,
            pieces=max((len(each) for each in cells.values()), default=1),
        )
    return Explorer(
        **{**vars(view), "marked": marked},
        automaton=automaton,
        shape=None if place is None else (int(place.shape[0]), int(place.shape[1])),
        names=_cell_names(place, view.size),
        layers=layers,
        runs=runs,
        drawings=drawn,
    )


def _cell_names(place: Any, size: int) -> list[str]:
    if place is None:
        return [""] * size
    if isinstance(place, np.ndarray):
        plain = plain_kind(place)
        return ["" if kind == plain else str(kind) for kind in place.ravel()]
    propositions = np.array(place.mdp.propositions)
    return [", ".join(propositions[row]) for row in np.asarray(place.mdp.label)]


def curves(
    name: str, title: str, caption: str, history: Mapping[str, np.ndarray], show: Iterable[str]
) -> Curves:
    """The learning curves of some figures, but of those without a finite value."""
    figures = {k: history[k] for k in show if np.isfinite(history[k]).any()}
    steps = history["step"]
    drawn = {k: drawing("live_curve", k.replace("_", "-"), v, steps) for k, v in figures.items()}
    return Curves(name, title, caption, figures, steps, drawn)


class _Dynamics:
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


def demonstrated_runs(model: Product, shown: Trajectories) -> list[Run]:
    """The first demonstrations with their memory states, and a deterministic last successor."""
    world, runs = _Dynamics(model), []
    states, actions = np.asarray(shown.state), np.asarray(shown.action)
    lengths = np.asarray(shown.length)
    for number in np.flatnonzero(lengths > 0)[:MOST_RUNS].tolist():
        length = int(lengths[number])
        at, did = states[number, :length].tolist(), actions[number, :length].tolist()
        reached, _ = world.reached(at[-1], did[-1])
        if len(reached) == 1:
            at.append(int(reached[0]))
        memory = [int(world.initial_memory[at[0]])]
        for here, there in itertools.pairwise(at):
            memory.append(world.remember(memory[-1], here, there))
        steps = list(itertools.zip_longest(at, memory, did))
        runs.append(Run(f"demonstration {number + 1} of {len(lengths)}", steps))
    return runs


def learned_runs(model: Product, policy: np.ndarray, seed: int, count: int = 3) -> list[Run]:
    """Rollouts of a policy until the formula is decided, or :data:`LONGEST_RUN` steps."""
    rng, world = np.random.default_rng(seed), _Dynamics(model)
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
        runs.append(Run(f"learned policy, trajectory {number + 1}", [*steps, (here, memory, None)]))
    return runs
