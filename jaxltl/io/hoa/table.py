"""Transition tables of HOA automata over explicit letters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.automaton import letter_text
from jaxltl.io.hoa.grammar import ParsedEdge, ParsedState, Tree, error_at, parse_tokens, split_texts
from jaxltl.io.hoa.header import HoaHeader, only_target, read_header, set_number

if TYPE_CHECKING:
    from lark import Token

LetterSet = TypeVar("LetterSet")
Made = TypeVar("Made")


def only_text(text: str, hint: str = "") -> list[Token]:
    """The tokens of the one automaton of a text."""
    automata = split_texts(text)
    if len(automata) != 1:
        raise ValueError(
            f"read_hoa: the text holds {len(automata)} automata, expected exactly one.{hint}"
        )
    return automata[0]


def parsed(tokens: list[Token], make: Callable[[HoaHeader, list[ParsedState]], Made]) -> Made:
    """Table of an automaton in the Hanoi format, from its header and states."""
    try:
        (version, items), states = parse_tokens(tokens)
        header = read_header(version, items)
        return make(header, _by_number(header, states))
    except RecursionError:  # evaluation recurses into labels and conditions
        raise error_at(
            tokens[0].line,
            "a label or the acceptance formula nests hundreds of levels deep, or there are "
            "hundreds of propositions. Write it flatter.",
        ) from None


def _by_number(header: HoaHeader, states: list[ParsedState]) -> list[ParsedState]:
    """States sorted by number; validates unique definitions, the initial state and all targets."""
    defined: dict[int, ParsedState] = {}
    for state in states:
        number = int(state.number)
        if header.states is not None and number >= header.states:
            raise error_at(
                state.line,
                f"state {number} is out of range, since States: counts {header.states}. "
                "Correct the one or the other.",
            )
        if number in defined:
            raise error_at(
                state.line,
                f"state {number} is defined twice, first in line {defined[number].line}. "
                "Keep one of them.",
            )
        for edge in state.edges:
            only_target(edge.targets, f"the edge of state {number} to")
        defined[number] = state
    mentioned = [header.start, *[state.number for state in states]]
    mentioned += [edge.targets[0] for state in states for edge in state.edges]
    for token in mentioned:
        if int(token) not in defined:
            raise error_at(
                token.line, f"state {token} is not defined. Add 'State: {token}' to the body."
            )
    count = max(defined) + 1 if header.states is None else header.states
    if len(defined) < count:
        number = next(q for q in range(count) if q not in defined)
        raise error_at(
            header.line,
            f"state {number} of {count} is not defined. Add 'State: {number}' to the body, or "
            "correct States:.",
        )
    return [defined[q] for q in range(count)]


@dataclass(frozen=True)
class EdgeTable:
    """Edge index of each state and letter, `[Q, L]`, and the edges; `sink` is added."""

    edge_of: NDArray[np.int64]
    target: NDArray[np.int64]
    marks: list[frozenset[int]]
    names: tuple[str, ...]
    sink: int | None


class Algebra(Protocol[LetterSet]):
    """Boolean algebra of sets of letters, with `LetterSet` as their representation."""

    def constant(self, value: bool) -> LetterSet:
        """All letters, or none."""

    def proposition(self, number: int) -> LetterSet:
        """Letters in which a proposition is true."""

    def letter(self, number: int) -> LetterSet:
        """A single letter, with proposition p as bit p."""

    def negation(self, guard: LetterSet) -> LetterSet: ...

    def both(self, left: LetterSet, right: LetterSet) -> LetterSet: ...

    def either(self, left: LetterSet, right: LetterSet) -> LetterSet: ...


@dataclass(frozen=True)
class _Letters:
    """Sets of rows of a letter table `[L, P]`, as ``bool[L]``."""

    columns: NDArray[np.bool_]
    negation = staticmethod(np.logical_not)
    both = staticmethod(np.logical_and)
    either = staticmethod(np.logical_or)

    def constant(self, value: bool) -> NDArray[np.bool_]:
        return np.full(len(self.columns), value)

    def proposition(self, number: int) -> NDArray[np.bool_]:
        return self.columns[:, number]

    @cached_property
    def _numbers(self) -> Integers:
        return self.columns @ (1 << np.arange(self.columns.shape[1]))

    def letter(self, number: int) -> NDArray[np.bool_]:
        return self._numbers == number


def read_table(
    header: HoaHeader, states: list[ParsedState], columns: NDArray[np.bool_]
) -> EdgeTable:
    """Transition table of the body over explicit letters."""
    algebra = _Letters(columns)
    truth = label_reader(header, algebra)
    edge_of = np.full((len(states), len(columns)), -1, np.int64)
    edges: list[ParsedEdge] = []
    marks: list[frozenset[int]] = []
    for q, state in enumerate(states):
        for edge, taken in guarded_edges(header, state, algebra, truth):
            for letter in np.flatnonzero(taken & (edge_of[q] >= 0))[:1]:
                raise nondeterminism(header, q, edge, edges[edge_of[q, letter]], columns[letter])
            edge_of[q, taken] = len(edges)
            edges.append(edge)
            marks.append(marks_of(header, state, edge))
    target = [int(edge.targets[0]) for edge in edges]
    names = [state.name or "" for state in states]
    sink = None
    if (edge_of < 0).any():
        sink = len(states)
        edge_of = np.vstack([edge_of, np.full(len(columns), -1)])
        edge_of[edge_of < 0] = len(edges)
        target.append(sink)
        marks.append(frozenset())
        names.append("false")
    named = any(state.name is not None for state in states)
    return EdgeTable(
        edge_of, np.array(target, np.int64), marks, tuple(names) if named else (), sink
    )


def marks_of(header: HoaHeader, state: ParsedState, edge: ParsedEdge) -> frozenset[int]:
    """Acceptance sets of an edge and its source state."""
    return frozenset(set_number(number, header.sets) for number in [*state.marks, *edge.marks])


def nondeterminism(
    header: HoaHeader, q: int, edge: ParsedEdge, other: ParsedEdge, letter: NDArray[np.bool_]
) -> ValueError:
    """ValueError for two edges that share a letter."""
    return error_at(
        edge.line,
        f"state {q} has two edges for the letter {letter_text(header.propositions, letter)}, to "
        f"state {other.targets[0]} and to state {edge.targets[0]}. Only deterministic automata are "
        "read; determinise it first, in Spot with the options -D -G.",
    )


def guarded_edges(
    header: HoaHeader,
    state: ParsedState,
    algebra: Algebra[LetterSet],
    truth: Callable[[Tree], LetterSet],
) -> Iterator[tuple[ParsedEdge, LetterSet]]:
    """Edges of a state, each with its set of letters."""
    labelled = sum(edge.label is not None for edge in state.edges)
    if state.label is not None:
        if labelled:
            raise error_at(
                state.line,
                f"state {state.number} has a label and so have its edges. Label only the state "
                "or only the edges.",
            )
        common = truth(state.label)
        yield from ((edge, common) for edge in state.edges)
    elif labelled:
        for edge in state.edges:
            if edge.label is None:
                raise error_at(
                    edge.line,
                    f"state {state.number} has edges with a label and edges without. "
                    "Label all of them, or none.",
                )
            yield edge, truth(edge.label)
    elif state.edges:
        width = len(header.propositions)
        if len(state.edges) != 2**width:
            raise error_at(
                state.line,
                f"the number of edges without a label of state {state.number} is "
                f"{len(state.edges)}, expected 2^{width}, one for each set of propositions "
                f"(AP: counts {width}). Correct them, or label them.",
            )
        yield from ((edge, algebra.letter(i)) for i, edge in enumerate(state.edges))


def label_reader(header: HoaHeader, algebra: Algebra[LetterSet]) -> Callable[[Tree], LetterSet]:
    """Evaluator of labels: maps a parse tree to its set of letters."""
    aliases: dict[str, LetterSet] = {}
    width = len(header.propositions)

    def truth(label: Tree) -> LetterSet:
        operator, *operands = label
        if operator in ("true", "false"):
            return algebra.constant(operator == "true")
        if operator == "alias":
            if operands[0] not in aliases:
                raise error_at(
                    operands[0].line,
                    f"the alias {operands[0]} is not defined up to here. Define it by Alias:, "
                    "before other aliases use it.",
                )
            return aliases[operands[0]]
        if operator == "proposition":
            if int(operands[0]) >= width:
                raise error_at(
                    operands[0].line,
                    f"proposition {operands[0]} is out of range, since AP: counts "
                    f"{width}. Correct the one or the other.",
                )
            return algebra.proposition(int(operands[0]))
        if operator == "not":
            return algebra.negation(truth(operands[0]))
        combine = algebra.both if operator == "and" else algebra.either
        return reduce(combine, map(truth, operands))

    for name, label in header.aliases:
        if name in aliases:
            raise error_at(name.line, f"the alias {name} is defined twice. Keep one of them.")
        aliases[str(name)] = truth(label)
    return truth
