"""Probabilities of updates: numbers, ends of intervals, or functions of parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.language.compiled import compile_expressions
from jaxltl.core.language.expressions import Expression, literal, names_in, substitute
from jaxltl.core.language.syntax import Command
from jaxltl.core.programs.bit_layout import Reader

Weight = NDArray[Any]  # float64[N]; float64[N, 2] of intervals; int64[N], numbers of functions


class Numbers:
    """Probabilities as doubles."""

    shape: tuple[int, ...] = ()
    dtype: Any = np.float64

    def compiled(self, command: Command) -> Any:
        """The probabilities of a command as an argument of :meth:`of`."""
        return compile_expressions([o.probability for o in command.outcomes])

    def of(self, compiled: Any, read: Reader, size: int) -> list[Weight]:
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

    def of(self, compiled: object, read: Reader, size: int) -> list[Weight]:
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

    def of(self, compiled: Any, read: Reader, size: int) -> list[Weight]:
        return [self.numbers(o.probability, read, size) for o in compiled]

    def numbers(self, e: Expression, read: Reader, size: int) -> NDArray[np.int64]:
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
        shares = [self._number(literal(1 / n)) for n in range(1, int(numbers.max()) + 1)]
        return self.product(weight, np.array(shares)[numbers - 1])
