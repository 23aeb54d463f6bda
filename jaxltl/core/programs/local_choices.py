"""Choices of single modules: enabled commands, and their updates as differences of packed states."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.language.expressions import (
    Compiled,
    Expression,
    LanguageError,
    compile_expressions,
    conjuncts,
    literal,
    names_in,
    substitute,
)
from jaxltl.core.language.syntax import Command, Module, Program, Variable
from jaxltl.core.programs.packed_states import Field, HashTable, Layout, StateReader, Words
from jaxltl.core.validation import ROW_SUM_TOLERANCE


Weight = NDArray[Any]  # float64[N]; float64[N, 2] of intervals; int64[N], numbers of functions


class Numbers:
    """Probabilities as doubles."""

    shape: tuple[int, ...] = ()
    dtype: Any = np.float64

    def compiled(self, command: Command) -> Any:
        """The probabilities of a command as an argument of :meth:`of`."""
        return compile_expressions([o.probability for o in command.outcomes])

    def of(self, compiled: Any, read: StateReader, size: int) -> list[Weight]:
        """The weight of each outcome of a command in N states."""
        return [np.broadcast_to(np.asarray(w, np.float64), (size,)) for w in compiled(read)]

    def possible(self, weight: Weight) -> NDArray[np.bool_]:
        """Marks weights that are not zero."""
        result: NDArray[np.bool_] = weight != 0
        return result

    def ends(self, weight: Weight) -> tuple[Weight, Weight]:
        """Lower and upper ends."""
        return weight, weight

    def product(self, left: Weight, right: Weight) -> Weight:
        """Weights of independent updates that happen together."""
        return left * right

    def divided(self, weight: Weight, numbers: Integers) -> Weight:
        """Weights divided by positive integers."""
        return (weight.T / numbers).T


class Intervals(Numbers):
    """Probabilities as intervals, ``float64[N, 2]``."""

    shape = (2,)

    def compiled(self, command: Command) -> Any:
        return compile_expressions(
            [e for o in command.outcomes for e in (o.probability, o.upper or o.probability)]
        )

    def of(self, compiled: object, read: StateReader, size: int) -> list[Weight]:
        ends = super().of(compiled, read, size)
        return [np.stack(pair, 1) for pair in zip(ends[::2], ends[1::2], strict=True)]

    def possible(self, weight: Weight) -> NDArray[np.bool_]:
        result: NDArray[np.bool_] = weight[:, 1] != 0
        return result

    def ends(self, weight: Weight) -> tuple[Weight, Weight]:
        return weight[:, 0], weight[:, 1]


class Functions(Numbers):
    """Probabilities as numbers of expressions over parameters; number 0 is zero and 1 is one."""

    dtype = np.int64

    def __init__(self) -> None:
        self.expressions: list[Expression] = [literal(0), literal(1)]
        self.number: dict[Expression, int] = {literal(0): 0, literal(1): 1}
        self.products: dict[tuple[int, int], int] = {}

    def compiled(self, command: Command) -> Any:
        return command.outcomes

    def of(self, compiled: Any, read: StateReader, size: int) -> list[Weight]:
        return [self.numbers(o.probability, read, size) for o in compiled]

    def numbers(self, e: Expression, read: StateReader, size: int) -> NDArray[np.int64]:
        """The number of the function that an expression is in each of N states."""
        fields = read.layout.fields
        names = sorted(names_in(e) & fields.keys())
        if not names:
            return np.full(size, self._number(substitute(e, {})))
        table = np.stack([read(name).astype(np.int64) for name in names], 1)
        rows, inverse = np.unique(table, axis=0, return_inverse=True)
        numbers = []
        for row in rows.tolist():
            values = {
                n: literal(bool(v) if fields[n].variable.type == "bool" else v)
                for n, v in zip(names, row, strict=True)
            }
            numbers.append(self._number(substitute(e, values)))
        return np.array(numbers, np.int64)[inverse.ravel()]

    def _number(self, e: Expression) -> int:
        if e.is_literal and e.value in (0, 1):
            e = literal(int(e.value))
        number = self.number.setdefault(e, len(self.expressions))
        if number == len(self.expressions):
            self.expressions.append(e)
        return number

    def product(self, left: Weight, right: Weight) -> Weight:
        pairs, inverse = np.unique(np.stack([left, right], 1), axis=0, return_inverse=True)
        numbers = []
        for a, b in pairs.tolist():
            if (a, b) not in self.products:
                both = (self.expressions[a], self.expressions[b])
                one = b if a == 1 else a if b == 1 else self._number(Expression("*", both))
                self.products[a, b] = one
            numbers.append(self.products[a, b])
        return np.array(numbers, np.int64)[inverse.ravel()]

    def divided(self, weight: Weight, numbers: Integers) -> Weight:
        one = literal(1)
        shares = [
            self._number(Expression("/", (one, literal(n))) if n > 1 else one)
            for n in range(1, int(numbers.max()) + 1)
        ]
        return self.product(weight, np.array(shares)[numbers - 1])


@dataclass(frozen=True)
class EnabledCommands:
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
                tuple(
                    (fields[a.variable], may_leave(fields[a.variable].variable, a.expression))
                    for a in o.assignments
                )
                for o in c.outcomes
            ),
            fixed_probabilities(c) if type(self.weights) is Numbers else None,
        )

    @np.errstate(all="ignore")
    def choices(self, words: Words) -> EnabledCommands:
        """Choices of the module in N states; raises LanguageError for an invalid update."""
        size, width = words[0].size, len(self.actions)
        read = StateReader(self.layout, words)
        count = np.zeros(size * width, np.int32)
        enabled: list[tuple[_Code, Integers]] = []
        met = self.conditions(read)
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
        first: Integers = np.cumsum(count, dtype=np.int64) - count
        fill = np.array(first)
        start, widths = np.empty((2, int(count.sum())), np.int64)
        changes = [[np.zeros(0, np.uint64)] for _ in words]
        weights: list[Weight] = [np.zeros((0, *self.weights.shape), self.weights.dtype)]
        end = 0
        for code, states in enabled:
            cell: Integers = states * width + code.column
            row = fill[cell]
            fill[cell] += 1
            part = read
            if states.size < size:
                part = StateReader(self.layout, tuple(w[states] for w in words))
            number, change, weight = self._updates(code, part, states.size)
            start[row] = end + np.cumsum(number) - number
            widths[row] = number
            end += len(weight)
            weights.append(weight)
            for parts, one in zip(changes, change, strict=True):
                parts.append(one)
        return EnabledCommands(
            count.reshape(size, width),
            first.reshape(size, width),
            start,
            widths,
            tuple(map(np.concatenate, changes)),
            np.concatenate(weights),
        )

    def _updates(
        self, code: _Code, read: StateReader, size: int
    ) -> tuple[Integers, tuple[NDArray[np.uint64], ...], Weight]:
        """Number of updates of each row, and changes and weights of all, row by row."""
        outcomes = len(code.targets)
        if code.fixed is None:
            weights = self.weights.of(code.weights, read, size)
            possible = np.stack([self.weights.possible(w) for w in weights], 1)
            table = np.stack(weights, 1)
            self._check_weights(code.command, weights, read)
        else:
            table = np.ones((size, 1)) * code.fixed
            possible = table > 0
        values = iter(code.right(read))
        change = [np.zeros((size, outcomes), np.uint64) for _ in range(self.layout.num_words)]
        for k, fields in enumerate(code.targets):
            for field, checked in fields:
                new = np.asarray(next(values), np.int64)
                if checked:
                    self._check_range(code.command, field, new, possible[:, k], read)
                moved = (new - read(field.variable.name)).view(np.uint64)
                change[field.word][:, k] += moved << np.uint64(field.shift)
        if possible.all():
            flat = tuple(x.reshape(-1) for x in change)
            return np.full(size, outcomes), flat, table.reshape(-1, *table.shape[2:])
        return possible.sum(1), tuple(x[possible] for x in change), table[possible]

    def _check_weights(self, command: Command, weights: list[Weight], read: StateReader) -> None:
        """Raises LanguageError if some probabilities are negative or do not sum to one."""
        if self.weights.dtype is np.int64:
            return
        low, high = np.array([self.weights.ends(w) for w in weights]).swapaxes(0, 1)
        lower, upper = 1 - ROW_SUM_TOLERANCE, 1 + ROW_SUM_TOLERANCE
        valid = ((low >= 0) & (low <= high) & (high <= upper)).all(0)
        bad = ~(valid & (low.sum(0) <= upper) & (high.sum(0) >= lower))
        if bad.any():
            i = int(np.argmax(bad))
            sum_text = " + ".join(
                f"{a:.9g}" if a == b else f"[{a:.9g}, {b:.9g}]"
                for a, b in zip(low[:, i], high[:, i], strict=True)
            )
            raise LanguageError(
                command.place,
                f"the probabilities of {_shown(command)} are {sum_text} in the state "
                f"{state_text(read, i)}; they must be at least 0 and sum to 1.",
            )

    def _check_range(
        self, command: Command, field: Field, new: Integers, possible: Booleans, read: StateReader
    ) -> None:
        """Raises LanguageError if an update that is possible leaves the range of a variable."""
        v = field.variable
        outside = ((new < v.low) | (new > v.high)) & possible
        if outside.any():
            i = int(np.argmax(outside))
            value = np.broadcast_to(new, possible.shape)[i]
            raise LanguageError(
                command.place,
                f"{_shown(command)} sets {v.name} to {value} in the state {state_text(read, i)}; its "
                f"range is [{v.low}..{v.high}].",
            )


def fixed_probabilities(c: Command) -> NDArray[np.float64] | None:
    """The probabilities of a command, if they are positive literals with the sum one."""
    values = [o.probability.value for o in c.outcomes if o.probability.is_literal]
    probabilities = np.array(values, np.float64)
    valid = probabilities.size == len(c.outcomes) and (probabilities > 0).all()
    return probabilities if valid and abs(probabilities.sum() - 1) <= ROW_SUM_TOLERANCE else None


def may_leave(v: Variable, e: Expression) -> bool:
    """False for values that are in the range of a variable."""
    return v.type == "int" and not (isinstance(e.value, int) and v.low <= e.value <= v.high)


def _shown(command: Command) -> str:
    guard = str(command.guard)
    return f"[{command.action}] {guard if len(guard) < 60 else guard[:57] + '...'}"


def state_text(read: StateReader, i: int) -> str:
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
_LIMIT = 2**17  # combinations of which numbers are looked up by hash; tables grow by copies


class LocalTable:
    """Choices of a module, evaluated once for each combination of the variables that it uses."""

    def __init__(self, code: ModuleCode) -> None:
        self.code = code
        self.pieces = [
            (w, run.start(), len(run[0]))
            for w, mask in enumerate(code.support)
            for run in re.finditer("1+", f"{mask:b}"[::-1])
        ]  # runs of bits of the variables: word, first bit and number of bits
        bits = sum(width for *_, width in self.pieces)
        self.number = np.full(1 << bits, -1, np.int32) if bits <= _DENSE_BITS else None
        self.known = HashTable(len(code.support))
        self.num_requested = self.size = 0
        self.table: EnabledCommands | None = None

    def choices(self, words: Words) -> tuple[EnabledCommands, Integers]:
        """Choices, and the index of each state among those that they are of."""
        self.num_requested += words[0].size
        if self.number is not None:
            index = self._dense(self.number, words)
        elif self.size < max(_TRIAL, min(_LIMIT, self.num_requested // _GAIN)):
            support = map(np.uint64, self.code.support)
            index = self.known.insert(tuple(map(np.bitwise_and, words, support)))
        else:
            return self.code.choices(words), np.arange(words[0].size)
        new = (index >= self.size).nonzero()[0]
        if new.size:
            some = np.empty(int(index.max()) + 1 - self.size, np.int64)
            some[index[new] - self.size] = new  # a state of each combination
            self.size += some.size
            more = self.code.choices(tuple(w[some] for w in words))
            self.table = more if self.table is None else _joined(self.table, more)
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


def _joined(old: EnabledCommands, more: EnabledCommands) -> EnabledCommands:
    """The choices of two sets of states."""
    return EnabledCommands(
        np.concatenate([old.count, more.count]),
        np.concatenate([old.first, more.first + old.start.size]),
        np.concatenate([old.start, more.start + len(old.weight)]),
        np.concatenate([old.width, more.width]),
        tuple(map(np.concatenate, zip(old.change, more.change, strict=True))),
        np.concatenate([old.weight, more.weight]),
    )
