"""Reachable states of a program, by levels of packed states."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.language.expressions import Expression, LanguageError, SCALAR
from jaxltl.core.language.syntax import Command, Module, Program
from jaxltl.core.programs.local_choices import (
    EnabledCommands,
    LocalTable,
    ModuleCode,
    Numbers,
    Weight,
    fixed_probabilities,
    may_leave,
)
from jaxltl.core.programs.packed_states import HashTable, Layout, Words
from jaxltl.core.programs.symmetry import Orbit
from jaxltl.core.sparse.rows import concatenated_ranges
from jaxltl.core.validation import ROW_SUM_TOLERANCE


# Joint updates of a state as (difference of the packed state, probability).
Updates = tuple[tuple[int, float], ...]
Local = Callable[[int], tuple[list[Updates], ...]]  # of a packed state, for each action

_MAX_SIZE = 20_000  # nodes of a module's expressions; compilation takes a microsecond for each
_INFIX = {
    "&": " and ",
    "|": " or ",
    "=": " == ",
    "<=>": " == ",
    "!=": " != ",
    **{x: f" {x} " for x in ("<", "<=", ">", ">=", "+", "-", "*")},
}


class Unsupported(Exception):
    """A state or a program that is left to the vectorised search, which also names errors."""


def generate(module: Module, actions: tuple[str, ...], layout: Layout) -> Local:
    """A function of packed states to the enabled commands of a module, for each of its actions;
    raises Unsupported for a module that is too large or too deep for Python's compiler."""
    if sum(e.size for c in module.commands for e in c.expressions) > _MAX_SIZE:
        raise Unsupported
    local = {name: f"v{i}" for i, name in enumerate(sorted(module.names))}
    lines = ["def local(s):"]
    for name, code in local.items():
        field = layout.fields[name]
        v, shift = field.variable, field.shift + 64 * field.word
        lines.append(f"    {code} = ((s >> {shift}) & {(1 << v.bits) - 1}) + {v.low}")
    lines += [f"    a{i} = []" for i in range(len(actions))]
    for c in module.commands:
        lines.append(f"    if {_source(c.guard, local)}:")
        lines += [f"        {x}" for x in _command(c, actions.index(c.action), layout, local)]
    lines.append(f"    return {', '.join(f'a{i}' for i in range(len(actions)))},")
    space: dict[str, Any] = {"apply": SCALAR, "check": _check, "Unsupported": Unsupported}
    try:
        exec(compile("\n".join(lines), "<generated>", "exec"), space)
    except (SyntaxError, RecursionError, MemoryError):
        raise Unsupported from None
    local_function: Local = space["local"]
    return local_function


def _command(c: Command, column: int, layout: Layout, local: dict[str, str]) -> list[str]:
    """Lines that append the updates of an enabled command."""
    lines, pairs = [], []
    for k, o in enumerate(c.outcomes):
        change = ["0"]
        for i, a in enumerate(o.assignments):
            field = layout.fields[a.variable]
            v, new = field.variable, f"n{k}_{i}"
            lines.append(f"{new} = {_source(a.expression, local)}")
            if may_leave(v, a.expression):
                lines.append(f"if {new} < {v.low} or {new} > {v.high}: raise Unsupported")
            change.append(f"(({new} - {local[a.variable]}) << {field.shift + 64 * field.word})")
        pairs.append(f"({' + '.join(change)}, {_source(o.probability, local)})")
    updates = f"({', '.join(pairs)},)"
    if fixed_probabilities(c) is None:
        updates = f"check({updates})"
    return [*lines, f"a{column}.append({updates})"]


def _check(updates: Any) -> Updates:
    """Updates with positive probabilities, which must sum to one."""
    total = sum([p for _, p in updates])
    if not abs(total - 1) <= ROW_SUM_TOLERANCE or min([p for _, p in updates]) < 0:
        raise Unsupported
    return tuple([(d, float(p)) for d, p in updates if p])


def _source(e: Expression, local: dict[str, str]) -> str:
    """An expression as Python code."""
    if e.operator == "literal":
        if isinstance(e.value, float) and not math.isfinite(e.value):
            raise Unsupported
        return f"({e.value!r})"
    if e.operator == "name":
        return local[str(e.value)]
    parts = [_source(x, local) for x in e.operands]
    if e.operator in _INFIX:
        return f"({_INFIX[e.operator].join(parts)})"
    if e.operator == "?:":
        return f"({parts[1]} if {parts[0]} else {parts[2]})"
    if e.operator in ("!", "neg"):
        return f"({'not ' if e.operator == '!' else '-'}{parts[0]})"
    if e.operator in ("min", "max") and len(parts) > 1:
        return f"{e.operator}({', '.join(parts)})"
    return f"apply[{e.operator!r}]({', '.join(parts)})"


# States of a level from which arrays are faster, by command and in all (benchmarks/programs.py).
PER_COMMAND, LEVEL = 8, 400
_MAX_UPDATES = 2**12  # of a state
_WORD = 2**64 - 1

# Of a module: choices without synchronisation, with their columns, and joint ones by column.
_Choices = tuple[list[tuple[int, Updates]], dict[int, list[Updates]]]


@dataclass
class Narrow:
    """States that were expanded one by one, and their choices; lists of Python's numbers."""

    keys: list[int]
    known: dict[int, int]  # the number of each state
    row_count: list[int] = field(default_factory=list)  # of states that are expanded
    column: list[int] = field(default_factory=list)
    entry_count: list[int] = field(default_factory=list)
    successor: list[int] = field(default_factory=list)
    weight: list[float] = field(default_factory=list)

    def words(self, layout: Layout) -> Words:
        """The states as packed words."""
        return tuple(
            np.array([k >> (64 * w) & _WORD for k in self.keys], np.uint64)
            for w in range(layout.num_words)
        )


def search_narrow(
    program: Program,
    codes: Sequence[ModuleCode],
    parts: Sequence[tuple[tuple[int, int], ...]],
    layout: Layout,
    initial: Words,
    max_states: int,
) -> Narrow:
    """Expands levels of few states, up to the first larger one.

    The search ends before a level with a state for the vectorised search: one with very many
    successors or an invalid update. `parts` are the modules of each synchronisation, and their columns.
    """
    keys = [0] * initial[0].size
    for w, word in enumerate(initial):
        keys = [k | x << (64 * w) for k, x in zip(keys, word.tolist(), strict=True)]
    narrow = Narrow(keys, {k: i for i, k in enumerate(keys)})
    try:
        modules = [
            _ModuleChoices(generate(m, code.actions, layout), i, code, parts)
            for i, (m, code) in enumerate(zip(program.modules, codes, strict=True))
        ]
    except Unsupported:
        return narrow
    limit = min(LEVEL, PER_COMMAND * sum(len(m.commands) for m in program.modules))
    lists: list[list[Any]] = [keys, narrow.row_count, narrow.column, narrow.entry_count]
    lists += [narrow.successor, narrow.weight]
    while 0 < len(level := keys[len(narrow.row_count) :]) < limit and len(keys) <= max_states:
        marks = list(map(len, lists))
        try:
            for key in level:
                _expand(key, modules, parts, narrow)
        except (Unsupported, ArithmeticError, ValueError):
            for key in keys[marks[0] :]:
                del narrow.known[key]
            for items, mark in zip(lists, marks, strict=True):
                del items[mark:]
            break
    return narrow


class _ModuleChoices:
    """Choices of a module by the bits of the variables that it uses."""

    def __init__(
        self,
        local: Local,
        number: int,
        code: ModuleCode,
        parts: Sequence[tuple[tuple[int, int], ...]],
    ) -> None:
        self.local = local
        self.mask = sum(m << (64 * w) for w, m in enumerate(code.support))
        self.known: dict[int, _Choices] = {}
        mine = [
            (i, dict(part)[number], len(part))
            for i, part in enumerate(parts)
            if number in dict(part)
        ]
        self.alone = [(i, c) for i, c, size in mine if size == 1]  # column, and the module's own
        self.joint = [(i, c) for i, c, size in mine if size > 1]

    def choices(self, key: int) -> _Choices:
        choices = self.known.get(key & self.mask)
        if choices is None:
            rows = self.local(key)
            own = [(i, updates) for i, c in self.alone for updates in rows[c]]
            joint = {i: rows[c] for i, c in self.joint if rows[c]}
            choices = self.known[key & self.mask] = own, joint
        return choices


def _expand(
    key: int,
    modules: list[_ModuleChoices],
    parts: Sequence[tuple[tuple[int, int], ...]],
    narrow: Narrow,
) -> None:
    """Adds the choices and the new successors of a state."""
    local = [m.choices(key) for m in modules]
    before = len(narrow.column)
    for m, (own, joint) in enumerate(local):
        for column, updates in own:
            _add(key, column, updates, narrow)
        for column, rows in joint.items():
            first, *others = parts[column]
            if first[0] != m:
                continue
            together = [rows]
            for other, _ in others:  # ends early, since most labels are blocked in most states
                more = local[other][1].get(column)
                if more is None:
                    break
                together.append(more)
            else:
                for updates in _joint(together):
                    _add(key, column, updates, narrow)
    narrow.row_count.append(len(narrow.column) - before)


def _joint(together: list[list[Updates]]) -> list[Updates]:
    """The joint updates of every combination of commands."""
    if prod([sum(map(len, rows)) for rows in together]) > _MAX_UPDATES:
        raise Unsupported
    updates = together[0]
    for rows in together[1:]:
        updates = [
            tuple([(d + e, p * q) for d, p in one for e, q in other])
            for one, other in product(updates, rows)
        ]
    return updates


def _add(key: int, column: int, updates: Updates, narrow: Narrow) -> None:
    known = narrow.known
    for change, probability in updates:
        target = key + change
        number = known.get(target)
        if number is None:
            number = known[target] = len(narrow.keys)
            narrow.keys.append(target)
        narrow.successor.append(number)
        narrow.weight.append(probability)
    narrow.column.append(column)
    narrow.entry_count.append(len(updates))


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
class _ActionColumn:
    """A synchronisation: an action, or the commands without an action of a module."""

    action: int
    owner: int  # the module, or -1 for an action of several
    parts: tuple[tuple[int, int], ...]  # modules, and the column of the action in each


class BreadthFirstSearch:
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
        rows = _JointChoices(state[cells], cell[cells], place, [None] * len(self.tables))
        self._choose(rows, local, counts)
        self._add(
            row_count=total.sum(1),
            action=self.action_of[rows.column],
            owner=self.owner_of[rows.column],
        )
        self._expand_rows(rows, [table for table, _ in local], words)

    def _choose(
        self,
        rows: _JointChoices,
        local: list[tuple[EnabledCommands, Integers]],
        counts: Sequence[Integers],
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

    def _expand_rows(
        self, rows: _JointChoices, tables: list[EnabledCommands], words: Words
    ) -> None:
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
        self,
        rows: _JointChoices,
        tables: list[EnabledCommands],
        words: Words,
        begin: int,
        stop: int,
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
class _JointChoices:
    """Joint choices of some states."""

    state: Integers  # of each choice, ascending
    column: Integers
    place: Integers  # number among those of the state and the column
    # for each module the rows in which it takes part, and its row in them
    chosen: list[tuple[Integers, Integers] | None]


def _columns(codes: list[ModuleCode], actions: tuple[str, ...]) -> list[_ActionColumn]:
    """The synchronisations of a program."""
    columns = [
        _ActionColumn(0, m, ((m, code.actions.index("")),))
        for m, code in enumerate(codes)
        if "" in code.actions
    ]
    for i, action in enumerate(actions[1:], 1):
        users = [(m, code) for m, code in enumerate(codes) if action in code.actions]
        parts = tuple((m, code.actions.index(action)) for m, code in users)
        columns.append(_ActionColumn(i, -1, parts))
    return columns
