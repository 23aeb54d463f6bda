"""Markov decision processes as sparse rows of NumPy arrays, and reductions over choices."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Floats, Integers, SparseMatrix
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.rows import (
    Rows,
    concatenated_ranges,
    mask_of,
    offsets_from_counts,
    row_entries,
)

_SMALL = 2000  # entries up to which NumPy alone is as fast, and SciPy need not be imported


@dataclass(frozen=True)
class HostGraph:
    """Successors of the choices of a Markov decision process, without padding.

    The choices of state s are the rows ``row_start[s]`` to ``row_start[s + 1] - 1``, and the
    successors of row r the entries ``entry_start[r]`` to ``entry_start[r + 1] - 1``. An unavailable
    action of a padded model is a row without entries.
    """

    row_start: Integers  # int32[S + 1], strictly ascending: every state has a choice
    entry_start: Integers  # int[R + 1]
    successor: Integers  # int32[T]

    @property
    def num_states(self) -> int:
        return self.row_start.size - 1

    @property
    def num_rows(self) -> int:
        return self.entry_start.size - 1

    @property
    def num_transitions(self) -> int:
        return self.successor.size

    @property
    def is_chain(self) -> bool:
        """True if every state has one choice."""
        return self.num_rows == self.num_states

    @cached_property
    def state(self) -> Integers:
        """The state of each row, ``int32[R]``."""
        if self.is_chain:
            return np.arange(self.num_states, dtype=np.int32)
        return np.repeat(np.arange(self.num_states, dtype=np.int32), np.diff(self.row_start))

    @cached_property
    def row(self) -> Integers:
        """The row of each entry, ``int32[T]``."""
        return np.repeat(np.arange(self.num_rows, dtype=np.int32), np.diff(self.entry_start))

    @cached_property
    def is_self_loop(self) -> NDArray[np.bool_]:
        """Rows with their own state as the only successor, ``bool[R]``."""
        count = np.diff(self.entry_start)
        loops: NDArray[np.bool_] = count > 0
        loops[loops] = self.successor[self.entry_start[:-1][loops]] == self.state[loops]
        several = np.flatnonzero(loops & (count > 1))
        entry = concatenated_ranges(self.entry_start[several], count[several])
        of = several.repeat(count[several])
        loops[of[self.successor[entry] != self.state[of]]] = False
        return loops

    @cached_property
    def predecessors(self) -> tuple[Integers, Integers]:
        """The rows with successor t, one per entry: ``row[start[t] : start[t + 1]]``."""
        return self.support.predecessors

    @cached_property
    def support(self) -> Rows:
        """The successors of each row."""
        return Rows(self.entry_start, self.successor, self.num_states)

    def states_of(self, rows: Booleans | Integers) -> Booleans:
        """The states of some rows, ``bool[S]``."""
        return mask_of(self.state[rows], self.num_states)

    def first_choice(self, mask: Booleans) -> tuple[Booleans, Integers]:
        """States with a marked row, and the first marked row of each (or its first row)."""
        row = np.flatnonzero(mask)
        first = self.row_start[:-1].astype(np.int32)
        some = np.zeros(self.num_states, bool)
        state = self.state[row]
        some[state] = True
        first[state[::-1]] = row[::-1]  # the first one is written last
        return some, first


@brief
@dataclass(frozen=True)
class HostMDP(HostGraph):
    """Transitions of a Markov decision process: a graph without empty rows, and probabilities.

    Successors are ascending and without repetition within a row.
    """

    probability: Floats  # float64[T], positive; a row sums to one up to rounding

    @cached_property
    def matrix(self) -> SparseMatrix:
        """The transition matrix, SciPy's sparse ``float64[R, S]``."""
        from scipy import sparse  # slow to import; only products need it

        arrays = self.probability, self.successor, self.entry_start
        return sparse.csr_array(arrays, shape=(self.num_rows, self.num_states))

    @cached_property
    def backup_unit(self) -> float:
        """Relative rounding of one backup of nonnegative values, including that of row sums."""
        # Each product and each sum adds less than one unit of rounding.
        width = int(np.diff(self.entry_start).max(initial=1))
        return (2 * width + 6) * float(np.finfo(np.float64).eps)

    def expectation(self, value: Floats) -> Floats:
        """The expected value of the next state, ``float64[R]``."""
        if self.successor.size <= _SMALL:
            weighted = self.probability * value[self.successor]
            return np.add.reduceat(weighted, self.entry_start[:-1])
        result: Floats = self.matrix @ value
        return result

    def over_choices(self, operation: np.ufunc, quantity: np.ndarray) -> np.ndarray:
        """A reduction, such as ``np.maximum``, over the choices of each state: ``[R]`` to ``[S]``."""
        if self.is_chain:
            return quantity
        return operation.reduceat(quantity, self.row_start[:-1])

    def chain(self, row: Integers) -> HostMDP:
        """The Markov chain of a policy, from the row of each state."""
        return self.select(np.arange(self.num_states + 1), row)[0]

    def select(
        self, row_start: Integers, row: Integers, node: Integers | None = None
    ) -> tuple[HostMDP, Integers]:
        """The model of some rows, with successors renamed by `node`, and the entries of the rows."""
        entry, width = row_entries(self.entry_start, row)
        after = self.successor[entry] if node is None else node[self.successor[entry]]
        start = offsets_from_counts(width)
        return HostMDP(row_start, start, after, self.probability[entry]), entry
