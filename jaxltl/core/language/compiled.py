"""Evaluation of expressions on arrays, of NumPy or JAX, as one list of instructions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from typing import Any

import numpy as np

from jaxltl.core.language.expressions import Expression

_UNDEFINED = -(2**30)  # a value beyond the ranges of variables, which updates refuse


@dataclass(frozen=True)
class Compiled:
    """Expressions as instructions without repeated subexpressions; :func:`compile_expressions`.

    Attributes:
      names: the variables that are read, of the first slots.
      code: operator, slots of the operands, and the value of a literal, of each further slot.
      outputs: the slot of each expression.
    """

    names: tuple[str, ...]
    code: tuple[tuple[str, tuple[int, ...], Any], ...]
    outputs: tuple[int, ...]

    def __call__(
        self, values: Mapping[str, Any] | Callable[[str], Any], xp: object = np
    ) -> list[Any]:
        """Values of the expressions.

        Args:
          values: an array, or a scalar, of each variable: integers, or Booleans.
          xp: the array namespace, ``numpy`` or ``jax.numpy``.

        Returns:
          An array for each expression; those without variables are scalars. Division by zero is
          infinite or NaN, and a modulus by a number that is not positive is -2^30.
        """
        with np.errstate(all="ignore"):
            return self.evaluate(values if callable(values) else values.__getitem__, xp)

    def evaluate(self, read: Callable[[str], Any], xp: Any = np) -> list[Any]:
        """The values, with the caller's treatment of floating-point errors."""
        slots: list[Any] = [read(name) for name in self.names]
        table = _operations(xp)
        for operator, operands, value in self.code:
            if operator == "literal":
                slots.append(value)
            else:
                slots.append(table[operator](*[slots[i] for i in operands]))
        return [slots[i] for i in self.outputs]


def compile_expressions(expressions: Sequence[Expression]) -> Compiled:
    """Instructions that evaluate expressions over variables; labels must have been substituted.

    Example:
      >>> from jaxltl.core.language.parser import parse_expression
      >>> both = compile_expressions([parse_expression("x + 1"), parse_expression("x + 1 > y")])
      >>> [v.tolist() for v in both({"x": np.array([0, 1]), "y": np.array([1, 1])})]
      [[1, 2], [False, True]]
    """
    names: dict[str, int] = {}
    for e in expressions:
        _collect(e, names, set())
    builder = _Builder(names)
    outputs = tuple(builder.slot(e) for e in expressions)
    return Compiled(tuple(names), tuple(builder.code), outputs)


def _collect(e: Expression, names: dict[str, int], seen: set[int]) -> None:
    if id(e) in seen:
        return
    seen.add(id(e))
    if e.operator == "name":
        names.setdefault(str(e.value), len(names))
    for operand in e.operands:
        _collect(operand, names, seen)


class _Builder:
    """Numbers equal nodes equally."""

    def __init__(self, names: dict[str, int]) -> None:
        self.names = names
        self.code: list[tuple[str, tuple[int, ...], Any]] = []
        self.known: dict[Any, int] = {}
        self.of_node: dict[int, tuple[int, Expression]] = {}  # the node keeps its id in use

    def slot(self, e: Expression) -> int:
        if (found := self.of_node.get(id(e))) is not None:
            return found[0]
        if e.operator == "name":
            number = self.names[str(e.value)]
        else:
            key = (e.operator, tuple([self.slot(x) for x in e.operands]), type(e.value), e.value)
            if key not in self.known:
                self.known[key] = len(self.names) + len(self.code)
                self.code.append((e.operator, key[1], e.value))
            number = self.known[key]
        self.of_node[id(e)] = number, e
        return number


@cache
def _operations(xp: Any) -> dict[str, Callable[..., Any]]:
    """Operators on arrays of a namespace."""

    def modulo(a: Any, b: Any) -> Any:
        return xp.where(xp.asarray(b) > 0, xp.mod(a, xp.maximum(b, 1)), _UNDEFINED)

    def power(a: Any, b: Any) -> Any:
        if xp.result_type(a, b).kind in "iu":
            return xp.power(xp.asarray(a), xp.maximum(b, 0))
        return xp.power(xp.asarray(a) * 1.0, b)

    def whole(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def rounded(a: Any) -> Any:
            a = xp.asarray(a)
            return a if a.dtype.kind in "iu" else _integers(xp, function(a))

        return rounded

    def folded(operation: Callable[[Any, Any], Any]) -> Callable[..., Any]:
        return lambda *x: reduce(operation, x)

    return {
        "!": xp.logical_not,
        "neg": xp.negative,
        "&": folded(xp.logical_and),
        "|": folded(xp.logical_or),
        "=>": lambda a, b: xp.logical_or(xp.logical_not(a), b),
        "<=>": xp.equal,
        "=": xp.equal,
        "!=": xp.not_equal,
        "<": xp.less,
        "<=": xp.less_equal,
        ">": xp.greater,
        ">=": xp.greater_equal,
        "+": folded(xp.add),
        "-": xp.subtract,
        "*": folded(xp.multiply),
        "/": lambda a, b: xp.true_divide(a, b),
        "?:": xp.where,
        "min": folded(xp.minimum),
        "max": folded(xp.maximum),
        "floor": whole(xp.floor),
        "ceil": whole(xp.ceil),
        "round": whole(lambda a: xp.floor(a + 0.5)),
        "pow": power,
        "mod": modulo,
        "log": lambda a, b: xp.log(a * 1.0) / xp.log(b * 1.0),
    }


def _integers(xp: Any, a: Any) -> Any:
    """Whole doubles as integers; others become a number beyond every range."""
    dtype = np.int64 if xp is np else xp.asarray(0).dtype
    return xp.where(xp.abs(a) < 2**53, a, _UNDEFINED).astype(dtype)
