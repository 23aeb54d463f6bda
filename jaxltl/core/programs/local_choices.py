"""Choices of single modules: enabled commands, and their updates as differences of packed states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.language.compiled import Compiled, compile_expressions
from jaxltl.core.language.expressions import names_in
from jaxltl.core.language.source import LanguageError
from jaxltl.core.language.syntax import Command, Module, Program
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
    targets: tuple[tuple[Field, ...], ...]  # assigned variables by update


class ModuleCode:
    """Evaluates the commands of a module in many states."""

    def __init__(self, program: Program, module: Module, layout: Layout, weights: Numbers) -> None:
        self.program, self.layout, self.weights = program, layout, weights
        self.actions = tuple(dict.fromkeys(c.action for c in module.commands))
        self.guards = compile_expressions([c.guard for c in module.commands])
        self.codes = [self._code(c) for c in module.commands]
        self.support = _support(module, layout)

    def _code(self, c: Command) -> _Code:
        assigned = [a for o in c.outcomes for a in o.assignments]
        return _Code(
            c,
            self.actions.index(c.action),
            self.weights.compiled(c),
            compile_expressions([a.expression for a in assigned]),
            tuple(tuple(self.layout.fields[a.variable] for a in o.assignments) for o in c.outcomes),
        )

    def choices(self, words: Words) -> Choices:
        """Choices of the module in N states; raises LanguageError for an invalid update."""
        size, width = words[0].size, len(self.actions)
        read = Reader(self.layout, words)
        count = np.zeros(size * width, np.int32)
        enabled: list[tuple[_Code, Integers]] = []
        for code, guard in zip(self.codes, self.guards(read), strict=True):
            holds = np.flatnonzero(np.broadcast_to(guard, (size,)))
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
        weights = self.weights.of(code.weights, read, size)
        possible = [self.weights.possible(w) for w in weights]
        self._check_weights(code.command, weights, read)
        values = iter(code.right(read))
        outcomes = len(weights)
        change = [np.zeros((size, outcomes), np.uint64) for _ in range(self.layout.num_words)]
        for k, fields in enumerate(code.targets):
            for field in fields:
                new = np.broadcast_to(np.asarray(next(values), np.int64), (size,))
                name, low = field.variable.name, field.variable.low
                outside = ((new < low) | (new > field.variable.high)) & possible[k]
                if outside.any():
                    self._refuse_range(code.command, field, new, int(np.argmax(outside)), read)
                moved = (new - read(name)).astype(np.uint64)
                change[field.word][:, k] += moved << np.uint64(field.shift)
        table = np.stack(weights, 1)
        kept = np.stack(possible, 1)
        number = kept.sum(1)
        if number.sum() == kept.size:
            return (
                number,
                tuple(x.reshape(-1) for x in change),
                table.reshape(-1, *table.shape[2:]),
            )
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
            bad |= ~((lower >= 0) & (lower <= upper) & np.isfinite(upper))
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

    def _refuse_range(
        self, command: Command, field: Field, new: Integers, i: int, read: Reader
    ) -> None:
        v = field.variable
        raise LanguageError(
            command.place,
            f"{_shown(command)} sets {v.name} to {new[i]} in the state {state_text(read, i)}; its "
            f"range is [{v.low}..{v.high}].",
        )


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


def _support(module: Module, layout: Layout) -> tuple[int, ...]:
    """The bits of the variables that a module reads or assigns."""
    names: set[str] = set()
    for c in module.commands:
        names_in(c.guard, names)
        for o in c.outcomes:
            for e in (o.probability, o.upper, *(a.expression for a in o.assignments)):
                if e is not None:
                    names_in(e, names)
            names.update(a.variable for a in o.assignments)
    return layout.masks(names & layout.fields.keys())


_DENSE_BITS = 20  # of a module's variables, up to which choices are kept in a table


class LocalTable:
    """Choices of a module, evaluated once for each combination of the variables that it uses."""

    def __init__(self, code: ModuleCode) -> None:
        self.code = code
        self.pieces = _runs(code.support)
        bits = sum(width for *_, width in self.pieces)
        self.number = np.full(1 << bits, -1, np.int32) if bits <= _DENSE_BITS else None
        self.size = 0
        self.table: Choices | None = None

    def choices(self, words: Words) -> tuple[Choices, Integers | None]:
        """Choices, and the index of each state among those that they are of; None for all in order."""
        if self.number is None:
            return self.code.choices(words), None
        key = np.zeros(words[0].size, np.int64)
        place = 0
        for word, shift, width in self.pieces:
            part = (words[word] >> np.uint64(shift)) & np.uint64((1 << width) - 1)
            key |= part.astype(np.int64) << place
            place += width
        index = self.number[key]
        if index.min(initial=0) < 0:
            new = np.flatnonzero(index < 0)
            _, first = np.unique(key[new], return_index=True)
            some = new[first]
            self.number[key[some]] = np.arange(self.size, self.size + some.size)
            self.size += some.size
            self._extend(self.code.choices(tuple(w[some] for w in words)))
            index = self.number[key]
        assert self.table is not None
        return self.table, index

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
    found = []
    for word, mask in enumerate(masks):
        bit = 0
        while mask >> bit:
            if mask >> bit & 1:
                width = 1
                while mask >> (bit + width) & 1:
                    width += 1
                found.append((word, bit, width))
                bit += width
            else:
                bit += 1
    return found
