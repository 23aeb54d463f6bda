"""Products of a grid with the deterministic automaton of a formula, with uncertain labels."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.automata.automaton import MAX_FREE_PROPOSITIONS, Automaton
from jaxltl.core.automata.runs import Verdict, lasso_verdicts, live_states, universal_states
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.ltl import Formula, parse_ltl
from jaxltl.core.pretty_print import brief

Number = TypeVar("Number", np.bool_, np.float64)


@brief
@dataclass(frozen=True, eq=False)
class TaskProduct:
    """Memory of a formula over the cells of a grid; its state-based acceptance is min-even parity.

    Memory state q is an automaton state with the priority of the transition into it. A cell whose
    labels are uncertain allows several letters, among which an adversary chooses.
    """

    label_class: Integers  # int[C], the set of letters that is possible in each cell
    moves: Booleans  # bool[Q, D, Q], memory states after entering a cell of each label class
    start: Booleans  # bool[D, Q], memory states after the initial cell
    priority: Integers  # int[Q]
    decided: Integers  # int[Q], 1 or 0 where every continuation is accepted or rejected, else -1
    # int[Q], 1 if the task is satisfied by a run that leaves the domain in this state, else 0
    outside: Integers
    automaton: Automaton  # of the formula
    # its states and the priorities of the transitions into them, one pair a memory state
    states: tuple[tuple[int, int], ...]

    @property
    def num_memory(self) -> int:
        """Q, the number of memory states."""
        return len(self.priority)

    def same_memory(self, other: TaskProduct) -> bool:
        """True if memory states mean the same in both products."""
        one, two = self.automaton.delta, other.automaton.delta
        decided = np.array_equal(self.decided, other.decided)
        return self.states == other.states and np.array_equal(one, two) and decided

    def complement(self) -> TaskProduct:
        """The product of the negated formula."""
        decided = np.where(self.decided < 0, -1, 1 - self.decided)
        return replace(self, priority=self.priority + 1, decided=decided, outside=1 - self.outside)

    def entered(self, value: NDArray[Number], memory: int) -> NDArray[Number]:
        """Least value ``[C]`` of entering each cell from a memory state, of values ``[Q, C]``."""
        return self._least(value, self.moves[memory])

    def initial(self, value: NDArray[Number]) -> NDArray[Number]:
        """Least value ``[C]`` of beginning in each cell."""
        return self._least(value, self.start)

    def _least(self, value: NDArray[Number], moves: Booleans) -> NDArray[Number]:
        greatest = True if value.dtype == bool else np.inf
        least = np.full(value.shape[1:], greatest, value.dtype)
        for q in np.flatnonzero(moves.any(0)):
            here = moves[:, q][self.label_class]
            least = np.where(here, np.minimum(least, value[q]), least)
        result: NDArray[Number] = least
        return result


def task_product(
    formula: str | Formula,
    propositions: Sequence[str],
    certain: Booleans,
    possible: Booleans,
    outside: str | None,
) -> TaskProduct:
    """The product of a grid with the automaton of a formula.

    Labels ``bool[C, P]`` are certain in all, and possible in some states of a cell. `outside` is that of
    the dynamics: the proposition that holds forever outside the domain; ``"clip"``, the domain is never
    left; ``"violates"`` or None, a run that leaves the domain is rejected, unless the labels that it has
    read satisfy the formula with every continuation, whichever labels the domain has. Raises ValueError
    for a proposition that is no label, and where too many letters decide that.
    """
    formula = parse_ltl(formula) if isinstance(formula, str) else formula
    missing = sorted(set(formula.propositions) - set(propositions))
    if missing:
        raise ValueError(
            f"{formula}: {missing[0]!r} is no label; the labels are {', '.join(propositions)}."
        )
    unknown = possible & ~certain
    pattern = certain.astype(np.int8) + 2 * unknown
    classes, label_class = np.unique(pattern, axis=0, return_inverse=True)
    letters = [_letters(row, propositions) for row in classes]
    inside = {letter for class_letters in letters for letter in class_letters}
    automaton, verdict, satisfied_outside = _translated(formula, inside, outside)
    index = _letter_index(automaton)
    names = set(automaton.propositions)
    of_class = [
        sorted({index[letter & names] for letter in class_letters}) for class_letters in letters
    ]
    states, moves, start = _memory(automaton, of_class, verdict)
    at = np.array([q for q, _ in states])
    priority = np.array([p for _, p in states])
    arrays = label_class.reshape(-1), moves, start, priority, verdict[at], satisfied_outside[at]
    return TaskProduct(*arrays, automaton, tuple(states))


def _translated(
    formula: Formula, inside: set[frozenset[str]], outside: str | None
) -> tuple[Automaton, Integers, Integers]:
    """The automaton; ``int[Q']`` twice, of its states: 1 or 0 where every continuation is accepted or
    rejected, else -1; and 1 if a run that leaves the domain there is accepted, else 0.

    The automaton reads the letters of the domain alone where that suffices, since it is smaller.
    """
    violates, beyond = outside in (None, "violates"), frozenset([str(outside)])
    label = not violates and outside != "clip"
    # A state that is NaN has no label: no formula is decided by staying in the domain alone.
    letters = inside | {beyond if label else frozenset()}
    automaton = to_automaton(formula, letters=sorted(letters, key=sorted))
    sure, live = universal_states(automaton), live_states(automaton)
    if violates and sure.any():
        # Of all letters, since those of the domain may satisfy a formula only while a run stays inside.
        if len(formula.propositions) > MAX_FREE_PROPOSITIONS:
            raise ValueError(
                f"{formula}: {len(formula.propositions)} propositions where leaving the domain "
                f"violates; give a formula of at most {MAX_FREE_PROPOSITIONS}, or dynamics with "
                'outside="clip" or the name of a label.'
            )
        automaton = to_automaton(formula)
        index, names = _letter_index(automaton), set(automaton.propositions)
        columns = sorted({index[letter & names] for letter in inside})
        tables = {x: getattr(automaton, x)[:, columns] for x in ("delta", "priority")}
        part = replace(automaton, letters=automaton.letters[columns], **tables)
        sure, live = universal_states(automaton), live_states(part)
    verdict = np.where(sure, 1, np.where(live, -1, 0))
    accepted: Booleans = sure
    if label:
        letter = _letter_index(automaton)[beyond & set(automaton.propositions)]
        accepted = lasso_verdicts(automaton)[:, letter] == Verdict.SATISFIED
    return automaton, verdict, accepted.astype(int)


def _letters(row: Integers, propositions: Sequence[str]) -> list[frozenset[str]]:
    """All letters of a label pattern: 0 false, 1 true, 2 unknown."""
    sure = [p for p, value in zip(propositions, row, strict=True) if value == 1]
    open_ = [p for p, value in zip(propositions, row, strict=True) if value == 2]
    sizes = range(len(open_) + 1)
    return [frozenset([*sure, *more]) for k in sizes for more in itertools.combinations(open_, k)]


def _letter_index(automaton: Automaton) -> dict[frozenset[str], int]:
    names = np.array(automaton.propositions, dtype=object)
    return {frozenset(names[row]): i for i, row in enumerate(automaton.letters)}


def _memory(
    automaton: Automaton, of_class: list[list[int]], verdict: Integers
) -> tuple[list[tuple[int, int]], Booleans, Booleans]:
    """Reachable pairs of state and priority of the last transition, and their moves."""
    delta, priority = automaton.delta, automaton.priority
    number: dict[tuple[int, int], int] = {}

    def visit(q: int, letter: int) -> int:
        to = int(delta[q, letter])
        # A decided state keeps one priority: the letters read before do not matter.
        decided = int(verdict[to])
        pair = (to, int(priority[q, letter]) if decided < 0 else 1 - decided)
        return number.setdefault(pair, len(number))

    start = [{visit(int(automaton.initial), x) for x in letters} for letters in of_class]
    moves: list[list[set[int]]] = []
    while len(moves) < len(number):
        q = list(number)[len(moves)][0]
        moves.append([{visit(q, x) for x in letters} for letters in of_class])
    rows = np.zeros((1 + len(number), len(of_class), len(number)), bool)
    for row, targets in zip(rows, [start, *moves], strict=True):
        for marks, entered in zip(row, targets, strict=True):
            marks[list(entered)] = True
    return list(number), rows[1:], rows[0]
