"""What a page needs to show a policy at work: maps by memory, runs step by step, and curves.

These are figures; :mod:`jaxltl.plot` draws them, :mod:`jaxltl.app.reports` makes a page of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxltl.app.drawing import Drawing, drawing
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models.product import Product
from jaxltl.core.models.trajectories import Trajectories
from jaxltl.envs.text_map import plain_kind

MOST_CELLS = 20_000  # of all maps of a world together, that a page holds
MOST_STATES = 40  # of an automaton
MOST_RUNS = 5  # of each kind
LONGEST_RUN = 200  # steps of a learned run

START = "start"  # the key of the layer of initial states


class Layer(NamedTuple):
    """What a map shows at once: for people, ``float[S]`` in [0, 1] and ``float[S, A]``, or None."""

    name: str
    value: np.ndarray | None
    policy: np.ndarray | None


class Run(NamedTuple):
    """A run with its memory: states, memories and actions, none in the last step if it ended."""

    name: str
    steps: list[tuple[int, int, int | None]]


class Explorer(NamedTuple):
    """A policy in a world, to be looked into.

    Attributes:
      name: what its ids begin with; a picture of this name says the same.
      title, caption, label: for people; the label is what values are.
      automaton, goal: the policy's memory, or None; and what it tells of, for people.
      shape: rows and columns of the map, or None.
      names: S texts, what is in each cell.
      actions: A names.
      layers: what there is to see, by the memory's number or :data:`START`.
      runs: what there is to play.
      marked, marks: (state, memory, action) that must be seen, and what they are, for people.
      cells, places: of some states, the cells of their pieces, and their names; of others, the
        cell of their own number.
      drawings: by ``"automaton"`` and, if there is one, ``"map"``.
    """

    name: str
    title: str
    caption: str
    label: str
    automaton: Automaton | None
    goal: str
    shape: tuple[int, int] | None
    names: list[str]
    actions: tuple[str, ...]
    layers: Mapping[str, Layer]
    runs: list[Run]
    marked: list[tuple[int, int, int]]
    marks: str
    cells: Mapping[int, Sequence[int]]
    places: Mapping[int, str]
    drawings: Mapping[str, Drawing]


class Curves(NamedTuple):
    """Learning curves: figures ``[T, N]`` by name, and the steps ``[T]`` that they are of."""

    name: str
    title: str
    caption: str
    figures: Mapping[str, np.ndarray]
    steps: np.ndarray
    drawings: Mapping[str, Drawing]


class TooLarge(NamedTuple):
    """What is said where there is no :class:`Explorer`."""

    name: str
    text: str
    drawings: Mapping[str, Drawing]


def explorer(
    name: str,
    title: str,
    caption: str,
    automaton: Automaton | None,
    layers: Mapping[str, Layer],
    runs: list[Run],
    *,
    size: int,
    place: Any = None,
    actions: Sequence[str] = (),
    label: str = "",
    wall: str = "#",
    goal: str = "the task",
    marked: Iterable[tuple[int, int, int]] = (),
    marks: str = "",
    cells: Mapping[int, Sequence[int]] | None = None,
    places: Mapping[int, str] | None = None,
) -> Explorer | TooLarge:
    """What there is to see of a policy; or why that is too much for a page.

    Args:
      size: S, how many states or cells there are.
      place: the cells of a text map, a coloured world, or None; else see :class:`Explorer`.
      wall: the kind of cell that is not a place.
    """
    count = 0 if automaton is None else len(automaton.delta)
    if size * len(layers) > MOST_CELLS or count > MOST_STATES:
        return TooLarge(
            name,
            (
                f"{size} states by {len(layers)} maps, and an automaton of {count} states, are more "
                f"than a page holds well (at most {MOST_CELLS} states over all maps, and {MOST_STATES} "
                "automaton states), so there are pictures in place of maps to look into; the files "
                "beside this page have the figures."
            ),
            {},
        )
    marked = [(int(s), int(q), int(a)) for s, q, a in marked]
    drawn = {} if automaton is None else {"automaton": drawing("live_automaton", automaton, name)}
    shape, names = None, [""] * size
    if isinstance(place, np.ndarray):
        plain = plain_kind(place)
        names = ["" if kind == plain else str(kind) for kind in place.ravel()]
    elif place is not None:
        propositions = np.array(place.mdp.propositions)
        names = [", ".join(propositions[row]) for row in np.asarray(place.mdp.label)]
    if place is not None:
        shape = (int(place.shape[0]), int(place.shape[1]))
        drawn["map"] = drawing(
            "live_map",
            place,
            name,
            {key: (x.value, x.policy) for key, x in layers.items()},
            runs=[[(cells or {}).get(s, [s])[0] for s, _, _ in run.steps] for run in runs],
            marked=marked,
            actions=actions,
            wall=wall,
            pieces=max((len(each) for each in (cells or {}).values()), default=1),
        )
    return Explorer(
        name,
        title,
        caption,
        label,
        automaton,
        goal,
        shape,
        names,
        tuple(actions),
        layers,
        runs,
        marked,
        marks,
        cells or {},
        places or {},
        drawn,
    )


def curves(
    name: str, title: str, caption: str, history: Mapping[str, np.ndarray], show: Iterable[str]
) -> Curves:
    """The learning curves of the figures that are known, in an order."""
    figures = {k: history[k] for k in show if np.isfinite(history[k]).any()}
    steps = history["step"]
    drawn = {k: drawing("live_curve", k.replace("_", "-"), v, steps) for k, v in figures.items()}
    return Curves(name, title, caption, figures, steps, drawn)


class _Steps(NamedTuple):
    """How a world and a policy's memory go on, on the host."""

    successor: np.ndarray
    probability: np.ndarray
    initial_memory: np.ndarray
    next_memory: np.ndarray
    on_entry: bool

    def reached(self, state: int, action: int) -> tuple[np.ndarray, np.ndarray]:
        """The states that a move leads to, and how likely."""
        chance = self.probability[state, action].astype(float)
        reached, place = np.unique(self.successor[state, action][chance > 0], return_inverse=True)
        likely = np.bincount(place, chance[chance > 0])
        return reached, likely / likely.sum()

    def remember(self, memory: int, here: int, there: int) -> int:
        return int(self.next_memory[there if self.on_entry else here, memory])


def _steps(model: Product) -> _Steps:
    mdp: Any = model.mdp
    return _Steps(
        np.asarray(mdp.successor),
        np.asarray(mdp.probability),
        np.asarray(model.initial_memory),
        np.asarray(model.next_memory),
        model.label_on == "entry",
    )


def demonstrated_runs(model: Product, shown: Trajectories) -> list[Run]:
    """The first demonstrations with the memory that they have, and where each ended, if sure."""
    world, runs = _steps(model), []
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
        ends: list[int | None] = [None] * (len(at) - length)
        steps = list(zip(at, memory, [*did, *ends], strict=True))
        runs.append(Run(f"demonstration {number + 1} of {len(lengths)}", steps))
    return runs


def learned_runs(model: Product, policy: np.ndarray, seed: int, count: int = 3) -> list[Run]:
    """Runs of a policy ``[S, Q, A]`` or ``[T, S, Q, A]`` until the task is decided, or for long.

    A run ends too where the policy is none, as after a solver that failed.
    """
    rng, world = np.random.default_rng(seed), _steps(model)
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
        runs.append(Run(f"learned policy, run {number + 1}", [*steps, (here, memory, None)]))
    return runs
