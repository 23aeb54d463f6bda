"""Reachable states of a program, by levels of packed states."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.language.expressions import LanguageError
from jaxltl.core.language.syntax import Program
from jaxltl.core.programs.packed_states import HashTable, Layout, Words
from jaxltl.core.programs.local_choices import Choices, LocalTable, ModuleCode, Numbers, Weight
from jaxltl.core.programs.scalar_search import search_narrow
from jaxltl.core.programs.symmetry import Orbit
from jaxltl.core.sparse.rows import concatenated_ranges

Progress = Callable[[int, int], None]  # of the numbers of states found and expanded
RewardParts = tuple[NDArray[Any] | None, NDArray[Any] | None]  # of states and of choices

_CHUNK = 2**15  # states that are expanded together
_ENTRIES = 2**19  # transitions that are numbered together; bounds the temporary memory
_MAX_BRANCHING = 2**26  # transitions of a single state
_TRANSITIONS = 100  # the most transitions per allowed state


@dataclass(frozen=True)
class Explored:
    """The reachable part of a program."""

    layout: Layout  # the states as packed words
    words: Words
    actions: tuple[str, ...]  # names of actions, the first of which is ""
    num_initial: int  # the initial states are the first ones
    row_count: NDArray[np.int32]  # int32[S], choices of each state; 0 of a deadlock
    action: NDArray[np.int32]  # int32[R], index in `actions`
    owner: NDArray[np.int32]  # int32[R], the module of a choice without synchronisation, else -1
    entry_count: Integers  # int64[R]
    successor: NDArray[np.int32]  # int32[T]
    weight: Weight  # [T], see :mod:`~jaxltl.core.programs.local_choices`
    # by name the parts on states and choices
    rewards: dict[str, RewardParts] = field(default_factory=dict)

    @property
    def initial(self) -> Floats:
        """``float[S]``: the initial states are equally likely."""
        distribution = np.zeros(self.row_count.size)
        distribution[: self.num_initial] = 1 / self.num_initial
        return distribution


@dataclass(frozen=True)
class _Column:
    """A synchronisation: an action, or the commands without an action of a module."""

    action: int
    owner: int  # the module, or -1 for an action of several
    parts: tuple[tuple[int, int], ...]  # modules, and the column of the action in each


class Search:
    """Breadth-first search from the initial states.

    Its methods raise LanguageError: more than `max_states` states, or an update that is no
    distribution or leaves the range of a variable, with the command and the state.
    """

    def __init__(self, program: Program, layout: Layout, weights: Numbers, max_states: int) -> None:
        self.program, self.layout, self.weights = program, layout, weights
        self.max_states = max_states
        codes = [ModuleCode(program, m, layout, weights) for m in program.modules]
        self.tables = [LocalTable(code) for code in codes]
        self.actions = ("", *sorted({a for code in codes for a in code.actions if a}))
        self.columns = _columns(codes, self.actions)
        self.action_of = np.array([c.action for c in self.columns], np.int32)
        self.owner_of = np.array([c.owner for c in self.columns], np.int32)
        self.known = HashTable(layout.num_words)
        self.orbits: tuple[Orbit, ...] = ()  # successors are found up to these symmetries
        self.num_transitions = 0
        # Arrays of :class:`Explored`, in parts, of which the first ones are empty.
        types: dict[str, Any] = {"row_count": np.int32, "action": np.int32, "owner": np.int32}
        types |= {"entry_count": np.int64, "successor": np.int32}
        self.output = {name: [np.zeros(0, dtype)] for name, dtype in types.items()}
        self.output["weight"] = [np.zeros((0, *weights.shape), weights.dtype)]

    def run(self, initial: Words, progress: Progress | None) -> Explored:
        self.known.fill(initial)
        done = self._narrow(initial) if type(self.weights) is Numbers else 0
        while True:
            if progress is not None:
                progress(len(self.known), done)
            if done == len(self.known):
                return self.explored(initial[0].size)
            stop = min(len(self.known), done + _CHUNK)
            self.expand(self.known.words(done, stop))
            done = stop

    def explored(self, num_initial: int) -> Explored:
        """The result; rows are in the order of expansion."""
        arrays: dict[str, Any] = {name: np.concatenate(x) for name, x in self.output.items()}
        words = self.known.words(0, len(self.known))
        return Explored(self.layout, words, self.actions, num_initial, **arrays)

    def _narrow(self, initial: Words) -> int:
        """Expands small levels state by state; returns the number of states that are done."""
        codes, parts = [t.code for t in self.tables], [column.parts for column in self.columns]
        narrow = search_narrow(self.program, codes, parts, self.layout, initial, self.max_states)
        self.known.fill(narrow.words(self.layout))
        self._check_size()
        self.num_transitions = len(narrow.successor)
        column = np.array(narrow.column, np.int64)
        self._add(
            row_count=narrow.row_count,
            action=self.action_of[column],
            owner=self.owner_of[column],
            entry_count=narrow.entry_count,
            successor=narrow.successor,
            weight=narrow.weight,
        )
        return len(narrow.row_count)

    def _add(self, **parts: ArrayLike) -> None:
        for name, part in parts.items():
            self.output[name].append(np.asarray(part, self.output[name][0].dtype))

    def _check_size(self) -> None:
        if len(self.known) > self.max_states:
            raise LanguageError(
                0,
                f"more than {self.max_states} states are reachable; give a larger max_states, or "
                "smaller constants.",
            )

    def expand(self, words: Words) -> None:
        """Adds the choices and successors of some states."""
        size = words[0].size
        local = [table.choices(words) for table in self.tables]
        counts = [table.count[index] for table, index in local]
        total = np.ones((size, len(self.columns)))  # doubles do not wrap around
        for i, column in enumerate(self.columns):
            for m, c in column.parts:
                total[:, i] *= counts[m][:, c]
        if total.size and total.max() > _MAX_BRANCHING:
            raise LanguageError(
                0, f"a state has {total.max():.3g} choices, more than {_MAX_BRANCHING}."
            )
        state, cell = np.nonzero(total)
        total_of = total[state, cell].astype(np.int64)
        place = concatenated_ranges(np.zeros(total_of.size, np.int64), total_of)
        cells = np.arange(state.size).repeat(total_of)
        rows = _Rows(state[cells], cell[cells], place, [None] * len(self.tables))
        self._choose(rows, local, counts)
        self._add(
            row_count=total.sum(1),
            action=self.action_of[rows.column],
            owner=self.owner_of[rows.column],
        )
        self._expand_rows(rows, [table for table, _ in local], words)

    def _choose(
        self, rows: _Rows, local: list[tuple[Choices, Integers]], counts: Sequence[Integers]
    ) -> None:
        """The command of each module in each joint choice: digits of its number in mixed radix."""
        rest = rows.place
        for m, (table, index) in enumerate(local):
            column_of = np.full(len(self.columns), -1)
            for i, column in enumerate(self.columns):
                column_of[i] = dict(column.parts).get(m, -1)
            chosen = column_of[rows.column]
            part = (chosen >= 0).nonzero()[0]
            if part.size:
                state, chosen = rows.state[part], chosen[part]
                number = counts[m][state, chosen]
                digit = rest[part] % number
                rest[part] //= number
                rows.chosen[m] = part, table.first[index[state], chosen] + digit

    def _expand_rows(self, rows: _Rows, tables: list[Choices], words: Words) -> None:
        """Joint updates of the choices: sums of changes and products of probabilities."""
        count = np.ones(rows.state.size)
        for table, chosen in zip(tables, rows.chosen, strict=True):
            if chosen is not None:
                count[chosen[0]] *= table.width[chosen[1]]
        if count.size and count.max() > _MAX_BRANCHING:
            raise LanguageError(
                0, f"a choice has {count.max():.3g} successors, more than {_MAX_BRANCHING}."
            )
        number = count.astype(np.int64)
        self._add(entry_count=number)
        end = np.cumsum(number)
        self.num_transitions += int(end[-1]) if end.size else 0
        if self.num_transitions > _TRANSITIONS * self.max_states:
            raise LanguageError(
                0,
                f"more than {_TRANSITIONS * self.max_states} transitions from {len(self.known)} "
                "states; the model is too large, or give a larger max_states.",
            )
        begin = 0
        while begin < number.size:
            limit = (end[begin - 1] if begin else 0) + _ENTRIES
            stop = max(int(np.searchsorted(end, limit, "right")), begin + 1)
            self._entries(rows, tables, words, begin, stop)
            begin = stop

    def _entries(
        self, rows: _Rows, tables: list[Choices], words: Words, begin: int, stop: int
    ) -> None:
        """Successors of the rows from `begin` to `stop`: products of one module after the other."""
        size = stop - begin
        row, state = np.arange(size), rows.state[begin:stop]
        target = [w[state] for w in words]
        weight: Weight | None = None
        for table, chosen in zip(tables, rows.chosen, strict=True):
            low, high = np.searchsorted(chosen[0], (begin, stop)) if chosen else (0, 0)
            if chosen is None or low == high:
                continue
            local = np.full(size, -1)
            local[chosen[0][low:high] - begin] = chosen[1][low:high]
            width = np.where(local < 0, 1, table.width[local])
            entry = table.start[local[row]]
            if width.max() > 1:
                width = width[row]
                entry = concatenated_ranges(entry, width)
                again = np.arange(row.size).repeat(width)
                row, target = row[again], [one[again] for one in target]
                weight = None if weight is None else weight[again]
            everywhere = high - low == size
            part = slice(None) if everywhere else (local[row] >= 0).nonzero()[0]
            entry = entry[part]
            for one, change in zip(target, table.change, strict=True):
                one[part] += change[entry]
            more = table.weight[entry]
            if weight is None:
                weight = np.ones((row.size, *self.weights.shape), self.weights.dtype)
                weight[part] = more
            else:
                weight[part] = self.weights.product(weight[part], more)
        assert weight is not None
        for orbit in self.orbits:
            orbit.sort(self.layout, tuple(target))
        self._add(successor=self.known.insert(tuple(target)), weight=weight)
        self._check_size()


@dataclass
class _Rows:
    """Joint choices of some states."""

    state: Integers  # of each choice, ascending
    column: Integers
    place: Integers  # number among those of the state and the column
    # for each module the rows in which it takes part, and its row in them
    chosen: list[tuple[Integers, Integers] | None]


def _columns(codes: list[ModuleCode], actions: tuple[str, ...]) -> list[_Column]:
    """The synchronisations of a program."""
    columns = [
        _Column(0, m, ((m, code.actions.index("")),))
        for m, code in enumerate(codes)
        if "" in code.actions
    ]
    for i, action in enumerate(actions[1:], 1):
        users = [(m, code) for m, code in enumerate(codes) if action in code.actions]
        parts = tuple((m, code.actions.index(action)) for m, code in users)
        columns.append(_Column(i, -1, parts))
    return columns
