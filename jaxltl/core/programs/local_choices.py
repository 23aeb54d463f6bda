"""Choices of single modules: enabled commands, and their updates as differences of packed states."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.language.compiled import Compiled, compile_expressions
from jaxltl.core.language.expressions import conjuncts
from jaxltl.core.language.source import LanguageError
from jaxltl.core.language.syntax import Assignment, Command, Module, Program
from jaxltl.core.programs.hash_table import HashTable
from jaxltl.core.programs.layout import Field, Layout, Reader, Words
from jaxltl.core.programs.weights import Numbers, Weight
from jaxltl.core.validation import ROW_SUM_TOLERANCE


@dataclass(frozen=True)
class Choices:
    """Enabled commands of a module in N states, by state and action.

    A row is an enabled command. Rows of state s and action a are ``first[s, a]`` to
    ``first[s, a] + count[s, a] - 1``; the updates of row r are the entries ``start[r]`` to
    ``start[r] + width[r] - 1``, which add `change` to the words of the state.
    """

    count: NDArray[np.int32]  # [N, A]
    first: Integers  # [N, A]
    start: Integers  # [R]
    width: Integers  # [R]
    change: tuple[NDArray[np.uint64], ...]  # [E] each
    weight: Weight  # [E, ...]


@dataclass(frozen=True)
class _Code:
    """A command as instructions."""

    command: Command
    column: int  # of the action, among those of the module
    weights: Any
    right: Compiled  # right sides of the assignments of all updates
    targets: tuple[tuple[tuple[Field, bool], ...], ...]  # variables by update; may leave the range
    fixed: NDArray[np.float64] | None  # probabilities of all updates, if they are positive literals


class ModuleCode:
    """Evaluates the commands of a module in many states."""

    def __init__(self, program: Program, module: Module, layout: Layout, weights: Numbers) -> None:
        self.program, self.layout, self.weights = program, layout, weights
        self.actions = tuple(dict.fromkeys(c.action for c in module.commands))
        parts = [{str(e): e for e in conjuncts(c.guard)} for c in module.commands]
        conditions = {text: e for part in parts for text, e in part.items()}
        number = {text: i for i, text in enumerate(conditions)}
        self.guards = [[number[text] for text in part] for part in parts]
        self.conditions = compile_expressions(list(conditions.values()))
        self.codes = [self._code(c) for c in module.commands]
        self.support = layout.masks(module.names & layout.fields.keys())

    def _code(self, c: Command) -> _Code:
        assigned = [a for o in c.outcomes for a in o.assignments]
        fields = self.layout.fields
        return _Code(
            c,
            self.actions.index(c.action),
            self.weights.compiled(c),
            compile_expressions([a.expression for a in assigned]),
            tuple(
                tuple((fields[a.variable], _may_leave(a, fields)) for a in o.assignments)
                for o in c.outcomes
            ),
            _fixed(c) if type(self.weights) is Numbers else None,
        )

    @np.errstate(all="ignore")
    def choices(self, words: Words) -> Choices:
        """Choices of the module in N states; raises LanguageError for an invalid update."""
        size, width = words[0].size, len(self.actions)
        read = Reader(self.layout, words)
        count = np.zeros(size * width, np.int32)
        enabled: list[tuple[_Code, Integers]] = []
        met = self.conditions.evaluate(read)
        # Most commands fail in all states by a single condition.
        possible = [np.asarray(x).any() for x in met]
        for code, guard in zip(self.codes, self.guards, strict=True):
            if not all(map(possible.__getitem__, guard)):
                continue
            mask = reduce(np.logical_and, [met[i] for i in guard], True)
            holds = np.broadcast_to(mask, (size,)).nonzero()[0]
            if holds.size:
                enabled.append((code, holds))
                count[holds * width + code.column] += 1
        first: Integers = np.cumsum(count, dtype=np.int64)
        num_rows = int(first[-1]) if first.size else 0
        first = first - count
        fill = np.array(first)
        start, widths = np.empty(num_rows, np.int64), np.empty(num_rows, np.int64)
        changes: list[list[NDArray[np.uint64]]] = [[] for _ in words]
        weights: list[Weight] = []
        end = 0
        for code, states in enabled:
            cell: Integers = states * width + code.column
            row = fill[cell]
            fill[cell] += 1
            part = read
            if states.size < size:
                part = Reader(self.layout, tuple(w[states] for w in words))
            number, change, weight = self._updates(code, part, states.size)
            start[row] = end + np.cumsum(number) - number
            widths[row] = number
            end += weight.shape[0]
            weights.append(weight)
            for parts, one in zip(changes, change, strict=True):
                parts.append(one)
        return Choices(
            count.reshape(size, width),
            first.reshape(size, width),
            start,
            widths,
            tuple(np.concatenate(x) if x else np.zeros(0, np.uint64) for x in changes),
            np.concatenate(weights)
            if weights
            else np.zeros((0, *self.weights.shape), self.weights.dtype),
        )

    def _updates(
        self, code: _Code, read: Reader, size: int
    ) -> tuple[Integers, tuple[NDArray[np.uint64], ...], Weight]:
        """Number of updates of each row, and changes and weights of all, row by row."""
        outcomes = len(code.targets)
        weights: list[Weight] = []
        possible: list[NDArray[np.bool_]] = []
        if code.fixed is None:
            weights = self.weights.of(code.weights, read, size)
            possible = [self.weights.possible(w) for w in weights]
            self._check_weights(code.command, weights, read)
        values = iter(code.right.evaluate(read))
        change = [np.zeros((size, outcomes), np.uint64) for _ in range(self.layout.num_words)]
        for k, fields in enumerate(code.targets):
            for field, may_leave in fields:
                new = np.asarray(next(values), np.int64)
                if may_leave:
                    held = possible[k] if possible else np.True_
                    self._check_range(code.command, field, new, held, read)
                moved = (new - read(field.variable.name)).view(np.uint64)
                change[field.word][:, k] += moved << np.uint64(field.shift)
        flat = tuple(x.reshape(-1) for x in change)
        if code.fixed is not None:
            return np.full(size, outcomes), flat, np.tile(code.fixed, size)
        table, kept = np.stack(weights, 1), np.stack(possible, 1)
        number = kept.sum(1)
        if number.sum() == kept.size:
            return number, flat, table.reshape(-1, *table.shape[2:])
        return number, tuple(x[kept] for x in change), table[kept]

    def _check_weights(self, command: Command, weights: list[Weight], read: Reader) -> None:
        """Raises LanguageError if some probabilities are negative or do not sum to one."""
        if self.weights.dtype is np.int64:
            return
        ends = [self.weights.ends(w) for w in weights]
        low, high = (sum(x[i] for x in ends) for i in (0, 1))
        bad = ~(
            (np.asarray(low) <= 1 + ROW_SUM_TOLERANCE) & (np.asarray(high) >= 1 - ROW_SUM_TOLERANCE)
        )
        for lower, upper in ends:
            bad |= ~((lower >= 0) & (lower <= upper) & (upper <= 1 + ROW_SUM_TOLERANCE))
        if bad.any():
            i = int(np.argmax(bad))
            shown = " + ".join(
                f"{lower[i]:.9g}" if lower[i] == upper[i] else f"[{lower[i]:.9g}, {upper[i]:.9g}]"
                for lower, upper in ends
            )
            raise LanguageError(
                command.place,
                f"the probabilities of {_shown(command)} are {shown} in the state "
                f"{state_text(read, i)}; they must be at least 0 and sum to 1.",
            )

    def _check_range(
        self,
        command: Command,
        field: Field,
        new: Integers,
        possible: NDArray[np.bool_] | np.bool_,
        read: Reader,
    ) -> None:
        """Raises LanguageError if an update that is possible leaves the range of a variable."""
        v = field.variable
        outside = ((new < v.low) | (new > v.high)) & possible
        if outside.any():
            i = int(np.argmax(outside))
            shown = np.broadcast_to(new, read(v.name).shape)[i]
            raise LanguageError(
                command.place,
                f"{_shown(command)} sets {v.name} to {shown} in the state {state_text(read, i)}; its "
                f"range is [{v.low}..{v.high}].",
            )


def _may_leave(a: Assignment, fields: Mapping[str, Field]) -> bool:
    """False for values that are in the range of a variable."""
    v, e = fields[a.variable].variable, a.expression
    return v.type == "int" and not (isinstance(e.value, int) and v.low <= e.value <= v.high)


def _fixed(c: Command) -> NDArray[np.float64] | None:
    """The probabilities of a command, if they are positive literals with the sum one."""
    values = [o.probability.value for o in c.outcomes if o.probability.is_literal]
    found = np.array(values, np.float64)
    valid = found.size == len(c.outcomes) and (found > 0).all()
    return found if valid and abs(found.sum() - 1) <= ROW_SUM_TOLERANCE else None


def _shown(command: Command) -> str:
    guard = str(command.guard)
    return f"[{command.action}] {guard if len(guard) < 60 else guard[:57] + '...'}"


def state_text(read: Reader, i: int) -> str:
    """The values of all variables in a state, for messages."""
    parts = []
    for name in read.layout.fields:
        value = read(name)[i]
        parts.append(f"{name}={str(value).lower()}")
        if sum(map(len, parts)) > 200:
            return f"({','.join(parts)},...)"
    return f"({','.join(parts)})"


_DENSE_BITS = 20  # of a module's variables, up to which a table of numbers has all combinations
_TRIAL, _GAIN = 2**13, 4  # combinations after which they must be this much fewer than states
_MOST = 2**17  # combinations of which numbers are looked up by hash; tables grow by copies


class LocalTable:
    """Choices of a module, evaluated once for each combination of the variables that it uses."""

    def __init__(self, code: ModuleCode) -> None:
        self.code = code
        self.pieces = _runs(code.support)
        bits = sum(width for *_, width in self.pieces)
        self.number = np.full(1 << bits, -1, np.int32) if bits <= _DENSE_BITS else None
        self.known = HashTable(len(code.support)) if self.number is None else None
        self.asked = self.size = 0
        self.table: Choices | None = None

    def choices(self, words: Words) -> tuple[Choices, Integers | None]:
        """Choices, and the index of each state among those that they are of; None for all in order."""
        self.asked += words[0].size
        if self.number is not None:
            index = self._dense(self.number, words)
        elif self.known is not None and self.size < max(_TRIAL, min(_MOST, self.asked // _GAIN)):
            index = self.known.insert(
                tuple(w & np.uint64(m) for w, m in zip(words, self.code.support, strict=True))
            )
        else:
            self.known = None
            return self.code.choices(words), None
        new = (index >= self.size).nonzero()[0]
        if new.size:
            some = np.empty(int(index.max()) + 1 - self.size, np.int64)
            some[index[new] - self.size] = new  # a state of each combination
            self.size += some.size
            self._extend(self.code.choices(tuple(w[some] for w in words)))
        assert self.table is not None
        return self.table, index

    def _dense(self, number: NDArray[np.int32], words: Words) -> Integers:
        """Numbers of the combinations of a module's variables, from 0."""
        key = np.zeros(words[0].size, np.int64)
        place = 0
        for word, shift, width in self.pieces:
            part = (words[word] >> np.uint64(shift)) & np.uint64((1 << width) - 1)
            key |= part.astype(np.int64) << place
            place += width
        index: Integers = number[key]
        new = key[index < 0]
        if new.size:
            new = np.unique(new)
            number[new] = np.arange(self.size, self.size + new.size)
            index = number[key]
        return index

    def _extend(self, more: Choices) -> None:
        if self.table is None:
            self.table = more
            return
        old = self.table
        self.table = Choices(
            np.concatenate([old.count, more.count]),
            np.concatenate([old.first, more.first + old.start.size]),
            np.concatenate([old.start, more.start + len(old.weight)]),
            np.concatenate([old.width, more.width]),
            tuple(np.concatenate(x) for x in zip(old.change, more.change, strict=True)),
            np.concatenate([old.weight, more.weight]),
        )


def _runs(masks: Sequence[int]) -> list[tuple[int, int, int]]:
    """Runs of ones in some words: word, first bit and number of bits."""
    bits = (re.finditer("1+", f"{mask:b}"[::-1]) for mask in masks)
    return [(w, run.start(), len(run[0])) for w, runs in enumerate(bits) for run in runs]
