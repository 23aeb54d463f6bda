"""Deterministic runs that follow the parts of a combination, side by side.

A Sigma-2 formula holds iff from some point on its residual holds by its safety part alone,
with every `F U M` taken as false (Esparza, Kretinsky & Sickert 2020, the master theorem). Its
tracker guesses that this point has come, follows that safety formula, and guesses again when it
is refuted: the formula holds iff it guesses finitely often. Pi-2 formulas are negations.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.automata.emerson_lei import MAX_COLORS, Condition
from jaxltl.core.logic.diagram import FALSE, TRUE
from jaxltl.core.logic.normal_form import Combination, Part, is_pure, limit_parts
from jaxltl.core.logic.progression import Progression
from jaxltl.core.logic.simplify import GREATEST, LEAST, negated

_State: TypeAlias = tuple[int, int, int]  # the residual formula, the guess, the turn
_PROVEN, _REFUTED, _IDLE = -1, -2, -3


class Tracker:
    """The run for one formula, or for its negation: `often` if it must mark infinitely often."""

    def __init__(self, part: Part) -> None:
        limits = limit_parts(part.formula) if part.kind == "limit" else ()
        self.often = limits[0].operator == "G" if limits else part.kind == "pi2"
        # Limits are tracked round-robin: all of some G F f hold iff every turn ends.
        self.whole = None if limits else negated(part.formula) if self.often else part.formula
        self.turns = [negated(f) if self.often else f for f in limits]
        self.turns = [f.operands[0] for f in self.turns]
        self.followed = self.turns if self.whole is None else [self.whole]

    def bind(self, progression: Progression) -> None:
        """Takes the diagrams once all formulas are known."""
        self.progression = progression
        self.guesses = [progression.diagram_of[f] for f in self.turns]
        whole = TRUE if self.whole is None else progression.diagram_of[self.whole]
        # A co-safe formula has no safety part to guess on: it holds once nothing is left of it.
        reaches = self.whole is not None and is_pure(self.whole, GREATEST)
        safe = progression.restricted(lambda variable: is_pure(variable, LEAST))
        self.restrict = (lambda _: FALSE) if reaches else safe
        self.index: dict[_State, int] = {}
        self.states: list[_State] = []
        self.rows: list[tuple[list[int], list[bool]]] = []
        self.start = self._number((whole, self._guess(whole, 0), 0))

    def _guess(self, whole: int, turn: int) -> int:
        return self.guesses[turn] if self.turns else self.restrict(whole)

    def _number(self, state: _State) -> int:
        whole, _, _ = state
        if not self.turns and whole in (TRUE, FALSE):
            return _PROVEN if whole == TRUE else _REFUTED
        found = self.index.setdefault(state, len(self.states))
        if found == len(self.states):
            self.states.append(state)
        return found

    def row(self, state: int) -> tuple[list[int], list[bool]]:
        """For each class of letters, the next state and whether the tracker marks the step."""
        width = len(self.progression.after)
        if state < 0:
            return [state] * width, [state == _REFUTED] * width
        while len(self.rows) <= state:
            self.rows.append(self._row(self.states[len(self.rows)]))
        return self.rows[state]

    def _row(self, state: _State) -> tuple[list[int], list[bool]]:
        whole, guess, turn = state
        states, marks = [], []
        for after in self.progression.after:
            left, kept, following = after(whole), after(guess), turn
            refuted = kept == FALSE
            if refuted:
                following = (turn + 1) % max(len(self.turns), 1)
                kept = self._guess(left, following)
            marks.append(refuted and following == 0)
            states.append(self._number((left, kept, following)))
        return states, marks


def track(
    parts: Combination,
    letters: NDArray[np.bool_],
    propositions: tuple[str, ...],
    max_states: int,
    max_nodes: int,
) -> tuple[NDArray[np.int32], NDArray[np.int64], Condition, NDArray[np.intp]]:
    """The trackers of a combination as one automaton with an Emerson-Lei condition."""
    trackers: dict[Part, Tracker] = {}
    for part in _leaves(parts):
        trackers.setdefault(part, Tracker(part))
    if len(trackers) > MAX_COLORS:
        raise ValueError(
            f"to_automaton: the formula falls into {len(trackers)} parts, and at most {MAX_COLORS} "
            "can be tracked together. Split it into formulas that are tracked side by side."
        )
    number = {part: i for i, part in enumerate(trackers)}
    progression = Progression(
        [f for t in trackers.values() for f in t.followed], letters, propositions, max_nodes
    )
    every = list(trackers.values())
    for tracker in every:
        tracker.bind(progression)
    run = _Product(every, _numbered(parts, number))
    delta, colors = run.explore(max_states)
    condition = _condition(_numbered(parts, number), every)
    return delta, colors, condition, progression.class_of


def _leaves(parts: Combination) -> list[Part]:
    if isinstance(parts, Part):
        return [parts]
    return [leaf for part in parts[1:] for leaf in _leaves(part)]


def _numbered(parts: Combination, number: dict[Part, int]) -> Any:
    if isinstance(parts, Part):
        return number[parts]
    return (parts[0], *(_numbered(part, number) for part in parts[1:]))


def _condition(tree: Any, trackers: list[Tracker]) -> Condition:
    if isinstance(tree, int):
        return ("inf" if trackers[tree].often else "fin", tree)
    operator = {"&": "and", "|": "or"}[tree[0]]
    return (operator, *(_condition(part, trackers) for part in tree[1:]))


class _Product:
    """Trackers side by side; those that no longer matter stand idle."""

    def __init__(self, trackers: list[Tracker], tree: Any) -> None:
        self.trackers = trackers
        self.tree = tree
        self.canonical: dict[tuple[int, ...], tuple[int, ...]] = {}
        self.needed: dict[tuple[int, ...], tuple[bool | None, frozenset[int]]] = {}
        self.decided: dict[bool, tuple[int, ...]] = {}

    def _simplified(self, tree: Any, status: tuple[int, ...]) -> tuple[bool | None, frozenset[int]]:
        """The truth of a combination if it is decided, else the trackers that it depends on."""
        if isinstance(tree, int):
            state = status[tree]
            if state in (_PROVEN, _REFUTED):
                return (state == _PROVEN) != self.trackers[tree].often, frozenset()
            return None, frozenset([tree])
        absorbing = tree[0] == "|"
        open_: frozenset[int] = frozenset()
        undecided = False
        for part in tree[1:]:
            truth, live = self._simplified(part, status)
            if truth == absorbing:
                return absorbing, frozenset()
            undecided |= truth is None
            open_ |= live
        return (None if undecided else not absorbing), open_

    def canonical_state(self, state: tuple[int, ...]) -> tuple[int, ...]:
        """The state with idle trackers set aside; decided states are one state each."""
        if state not in self.canonical:
            status = tuple(min(q, 0) for q in state)
            if status not in self.needed:
                self.needed[status] = self._simplified(self.tree, status)
            truth, live = self.needed[status]
            if truth is None:
                small = tuple(q if q < 0 or i in live else _IDLE for i, q in enumerate(state))
                # A proven part that nothing depends on is equivalent to a refuted one.
            else:
                small = tuple(q if q in (_PROVEN, _REFUTED) else _IDLE for q in state)
                small = self.decided.setdefault(truth, small)
            self.canonical[state] = small
        return self.canonical[state]

    def explore(self, max_states: int) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
        start = self.canonical_state(tuple(t.start for t in self.trackers))
        index = {start: 0}
        order = [start]
        table, marks = [], []
        for state in order:
            rows = [t.row(q) for t, q in zip(self.trackers, state, strict=True)]
            successors = []
            for target in zip(*(row[0] for row in rows), strict=True):
                small = self.canonical_state(target)
                if small not in index:
                    index[small] = len(order)
                    order.append(small)
                successors.append(index[small])
            table.append(successors)
            colors = np.zeros(len(successors), np.int64)
            for i, row in enumerate(rows):
                colors |= np.array(row[1], np.int64) << i
            marks.append(colors)
            if len(order) > max_states:
                raise ValueError(
                    f"to_automaton: more than {max_states} states. Pass fewer letters=, split "
                    "the formula into parts that are tracked side by side, or raise max_states."
                )
        return np.array(table, np.int32), np.stack(marks)
