"""Products of a grid with the deterministic automaton of a formula, with uncertain labels."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.automata.automaton import Automaton
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
    outside: Integers  # int[Q], 1 if the task is satisfied after leaving the domain, else 0
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
        return self.states == other.states and np.array_equal(one, two)

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

    Labels ``bool[C, P]`` are certain in all, and possible in some states of a cell. `outside` is the
    proposition that holds forever outside the domain; None: leaving violates. Raises ValueError for a
    proposition that is no label.
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
    everywhere = {letter for class_letters in letters for letter in class_letters}
    if outside is not None:
        everywhere.add(frozenset([outside]))
    automaton = to_automaton(formula, letters=sorted(everywhere, key=sorted))
    index = _letter_index(automaton)
    names = set(automaton.propositions)
    of_class = [
        sorted({index[letter & names] for letter in class_letters}) for class_letters in letters
    ]
    states, moves, start = _memory(automaton, of_class)
    decided = np.array([_decided(automaton, q) for q, _ in states])
    lasso = np.zeros(len(states), int)
    if outside is not None:
        letter = index[frozenset([outside]) & names]
        lasso = np.array([_accepts_forever(automaton, q, letter) for q, _ in states])
    lasso = np.where(decided == 1, 1, lasso)
    priority = np.array([p for _, p in states])
    return TaskProduct(
        label_class.reshape(-1), moves, start, priority, decided, lasso, automaton, tuple(states)
    )


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
    automaton: Automaton, of_class: list[list[int]]
) -> tuple[list[tuple[int, int]], Booleans, Booleans]:
    """Reachable pairs of state and priority of the last transition, and their moves."""
    delta, priority = automaton.delta, automaton.priority
    number: dict[tuple[int, int], int] = {}

    def visit(q: int, letter: int) -> int:
        to = int(delta[q, letter])
        # A decided state keeps one priority: the letters read before do not matter.
        decided = _decided(automaton, to)
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


def _decided(automaton: Automaton, q: int) -> int:
    """1 or 0 for a sink that accepts or rejects every continuation, else -1."""
    parity = automaton.priority[q] % 2
    if (automaton.delta[q] != q).any() or (parity != parity[0]).any():
        return -1
    return 1 - int(parity[0])


def _accepts_forever(automaton: Automaton, q: int, letter: int) -> bool:
    """True if the word of one letter is accepted from a state."""
    seen: dict[int, int] = {}
    priorities: list[int] = []
    while q not in seen:
        seen[q] = len(priorities)
        priorities.append(int(automaton.priority[q, letter]))
        q = int(automaton.delta[q, letter])
    return min(priorities[seen[q] :]) % 2 == 0
