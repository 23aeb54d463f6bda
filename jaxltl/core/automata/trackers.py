"""Deterministic runs that follow the parts of a combination, side by side.

A Sigma-2 formula holds iff from some point on its residual holds by its safety part alone,
with every `F U M` taken as false (Esparza, Kretinsky & Sickert 2020, the master theorem). Its
tracker guesses that this point has come, follows that safety formula, and guesses again when it
is refuted: the formula holds iff it guesses finitely often. Pi-2 formulas are negations.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.emerson_lei import (
    MAX_COLORS,
    Condition,
    polarities,
    residual,
    to_parity,
    ZielonkaTree,
)
from jaxltl.core.automata.table import ParityTable, explore
from jaxltl.core.logic.diagram import FALSE, TRUE
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.logic.normal_form import Combination, Part, is_pure, limit_parts
from jaxltl.core.logic.progression import Progression
from jaxltl.core.logic.simplify import GREATEST, LEAST, negated


Alphabet: TypeAlias = tuple[NDArray[np.bool_], tuple[str, ...]]  # letters [L, P], propositions
States: TypeAlias = tuple[int, ...]  # of each tracker

_State: TypeAlias = tuple[int, int, int]  # the residual formula, the guess, the turn
_Followed: TypeAlias = tuple[
    Formula | None, tuple[Formula, ...]
]  # Sigma-2, or limits one after another
_PROVEN, _REFUTED, IDLE = -1, -2, -3
_ASLEEP = -1  # in place of a guess


class Tracker:
    """The run for one Sigma-2 formula, or for some F G f, that marks each refuted guess."""

    def __init__(self, followed: _Followed, alphabet: Alphabet, max_nodes: int) -> None:
        self.whole, limits = followed
        # Limits are tracked round-robin: all of some G F f hold iff every turn ends.
        turns = [limit.operands[0] for limit in limits]
        formulas = turns if self.whole is None else [self.whole]
        self.progression = Progression(formulas, *alphabet, max_nodes)
        self.guesses = [self.progression.diagram_of[f] for f in turns]
        whole = TRUE if self.whole is None else self.progression.diagram_of[self.whole]
        # A co-safe formula has no safety part to guess on: it holds once nothing is left of it.
        reaches = self.whole is not None and is_pure(self.whole, GREATEST)
        safe = self.progression.restricted(lambda variable: is_pure(variable, LEAST))
        self.restrict = (lambda _: FALSE) if reaches else safe
        self.index: dict[_State, int] = {}
        self.states: list[_State] = []
        self.rows: list[tuple[list[int], list[bool]]] = []
        self.start = self._number((whole, self._guess(whole, 0), 0))

    def _guess(self, whole: int, turn: int) -> int:
        return self.guesses[turn] if self.guesses else self.restrict(whole)

    def _number(self, state: _State) -> int:
        whole, _, _ = state
        if not self.guesses and whole in (TRUE, FALSE):
            return _PROVEN if whole == TRUE else _REFUTED
        number = self.index.setdefault(state, len(self.states))
        if number == len(self.states):
            self.states.append(state)
        return number

    def awake(self, state: int, needed: bool) -> int:
        """The state with a guess if one is needed, and without one otherwise."""
        if state < 0:
            return state
        whole, guess, _ = self.states[state]
        if not needed:
            return self._number((whole, _ASLEEP, 0))
        return state if guess != _ASLEEP else self._number((whole, self._guess(whole, 0), 0))

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
            left, following = after(whole), turn
            guessed = guess if guess == _ASLEEP else after(guess)
            refuted = guessed == FALSE
            if refuted:
                following = (turn + 1) % max(len(self.guesses), 1)
                guessed = self._guess(left, following)
            marks.append(refuted and following == 0)
            states.append(self._number((left, guessed, following)))
        return states, marks


class Trackers:
    """The trackers of a combination, one for a part and its negation, and the condition on them."""

    def __init__(self, parts: Combination, alphabet: Alphabet, max_nodes: int) -> None:
        number: dict[_Followed, int] = {}
        self.condition = _condition(parts, number)
        if len(number) > MAX_COLORS:
            raise ValueError(
                f"to_automaton: the formula falls into {len(number)} parts, and at most "
                f"{MAX_COLORS} can be tracked together. Split it into formulas that are tracked "
                "side by side."
            )
        self.trackers = [Tracker(followed, alphabet, max_nodes) for followed in number]
        self.start = tuple(tracker.start for tracker in self.trackers)
        classes = np.stack([t.progression.class_of for t in self.trackers])
        # The letters that the trackers tell apart, and each letter's place among them.
        self.letters, place = np.unique(classes, axis=1, return_inverse=True)
        self.class_of = place.ravel()
        self._remaining = cache(self._residual)
        self.heard = cache(self._heard)

    def remaining(self, states: States, condition: Condition) -> tuple[Condition, int]:
        """A condition restricted to some states, and the trackers that it depends on."""
        return self._remaining(condition, tuple(min(q, 0) for q in states))

    def _residual(self, condition: Condition, status: States) -> tuple[Condition, int]:
        proven, refuted = (
            sum(1 << i for i, q in enumerate(status) if q == kind) for kind in (_PROVEN, _REFUTED)
        )
        condition = residual(condition, proven, refuted)
        inf, fin = polarities(condition)
        return condition, inf | fin

    def _heard(self, chosen: int) -> tuple[list[list[int]], NDArray[np.intp]]:
        """The letters that some trackers tell apart, and each letter's place among them."""
        letters = self.letters.copy()
        letters[[not chosen >> i & 1 for i in range(len(letters))]] = 0
        distinct, place = np.unique(letters, axis=1, return_inverse=True)
        return distinct.tolist(), place.ravel()

    def successors(self, states: States, chosen: int) -> list[tuple[States, int]]:
        """For each letter that some trackers tell apart, the next states and the marks."""
        targets, marks = [], []
        letters, _ = self.heard(chosen)
        for i, (tracker, state, classes) in enumerate(
            zip(self.trackers, states, letters, strict=True)
        ):
            following, marked = tracker.row(state)
            targets.append([following[k] for k in classes])
            marks.append([marked[k] << i for k in classes])
        every = zip(*targets, strict=True), map(sum, zip(*marks, strict=True))
        return list(zip(*every, strict=True))


def _followed(part: Part) -> tuple[str, _Followed]:
    """The polarity of the marks of a part's tracker, and the formulas that it follows."""
    limits = limit_parts(part.formula) if part.kind == "limit" else ()
    often = limits[0].operator == "G" if limits else part.kind == "pi2"
    sign = negated if often else lambda f: f
    return "inf" if often else "fin", (
        None if limits else sign(part.formula),
        tuple(sign(limit) for limit in limits),
    )


def _condition(parts: Combination, number: dict[_Followed, int]) -> Condition:
    if isinstance(parts, Part):
        polarity, followed = _followed(parts)
        return polarity, number.setdefault(followed, len(number))
    operator = {"&": "and", "|": "or"}[parts[0]]
    return (operator, *(_condition(part, number) for part in parts[1:]))


def track_together(run: Trackers, max_states: int) -> ParityTable:
    """A parity automaton of all trackers, whose product has an Emerson-Lei condition."""
    decided: dict[Condition, States] = {}
    every = (1 << len(run.start)) - 1

    @cache
    def canonical(states: States) -> States:
        """The state with idle trackers set aside; decided states are one state each."""
        condition, live = run.remaining(states, run.condition)
        small = tuple(
            q if q in (_PROVEN, _REFUTED) or live >> i & 1 else IDLE for i, q in enumerate(states)
        )
        return small if live else decided.setdefault(condition, small)

    def step(states: States) -> list[tuple[States, int]]:
        return [(canonical(end), colors) for end, colors in run.successors(states, every)]

    _, rows, marks = explore(canonical(run.start), step, max_states)
    delta, priority, initial, _ = to_parity(
        np.stack(rows), np.stack(marks), 0, run.condition, max_states
    )
    return ParityTable(delta, priority, initial)


# Of the trackers; the condition that remains; the leaf of its Zielonka tree.
_Node: TypeAlias = tuple[States, Condition, int]


def track_on_demand(run: Trackers, max_states: int) -> ParityTable:
    """A parity automaton of trackers.

    Trackers follow a formula only where the Zielonka tree of their condition needs its marks: a
    leaf of the tree waits for colors outside of its label, so that marks inside of it need not be
    seen. A guess may be made anew at any time, hence a tracker can sleep in these leaves. For
    limits with memory this takes a sum over the leaves, in place of the product of all trackers.
    """
    tree_of = cache(lambda condition: ZielonkaTree(condition, max_states))
    places: list[Integers] = []

    def settled(states: States, condition: Condition, live: int, leaf: int) -> _Node:
        needed = tree_of(condition).missing[leaf]
        is_kept = (
            tracker.awake(q, bool(needed >> i & 1)) if live >> i & 1 else IDLE
            for i, (tracker, q) in enumerate(zip(run.trackers, states, strict=True))
        )
        return tuple(is_kept), condition, leaf

    def entered(states: States, condition: Condition, live: int) -> _Node:
        return settled(states, condition, live, tree_of(condition).leaf_below(0))

    def step(node: _Node) -> Iterator[tuple[_Node, int]]:
        states, condition, leaf = node
        awake = tree_of(condition).missing[leaf]
        heard = sum(
            1 << i
            for i, (t, q) in enumerate(zip(run.trackers, states, strict=True))
            if q >= 0 and (awake >> i & 1 or t.whole is not None)
        )
        places.append(run.heard(heard)[1])
        for target, colors in run.successors(states, heard):
            remaining, live = run.remaining(target, condition)
            if remaining == condition:
                after, priority = tree_of(condition).step(leaf, colors & awake)
                yield settled(target, condition, live, after), priority
            else:
                yield entered(target, remaining, live), 1

    start = entered(run.start, *run.remaining(run.start, run.condition))
    _, *tables = explore(start, step, max_states)
    delta, priority = (
        np.stack([row[place] for row, place in zip(rows, places, strict=True)]) for rows in tables
    )
    return ParityTable(delta, priority, 0)
