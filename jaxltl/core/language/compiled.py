"""Evaluation of expressions on arrays, of NumPy or JAX, as one list of instructions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from typing import Any

import numpy as np

from jaxltl.core.language.expressions import Expression, names_in

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

    @np.errstate(all="ignore")
    def __call__(self, values: Mapping[str, Any] | Callable[[str], Any], xp: Any = np) -> list[Any]:
        """Values of the expressions.

        Args:
          values: an array, or a scalar, of each variable: integers, or Booleans.
          xp: the array namespace, ``numpy`` or ``jax.numpy``.

        Returns:
          An array for each expression; those without variables are scalars. Division by zero is
          infinite or NaN, and a modulus by a number that is not positive is -2^30.
        """
        slots: list[Any] = list(map(values if callable(values) else values.__getitem__, self.names))
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
    names = sorted(set[str]().union(*map(names_in, expressions)))
    # Equal nodes have one slot, and shared ones are visited once.
    slots: dict[Any, int] = {("name", (), str, name): i for i, name in enumerate(names)}
    code: list[tuple[str, tuple[int, ...], Any]] = []
    visited: dict[int, int] = {}

    def slot(e: Expression) -> int:
        if id(e) not in visited:
            operands = tuple([slot(x) for x in e.operands])
            key = (e.operator, operands, type(e.value), e.value)
            if key not in slots:
                slots[key] = len(slots)
                code.append((e.operator, operands, e.value))
            visited[id(e)] = slots[key]
        return visited[id(e)]

    outputs = tuple([slot(e) for e in expressions])
    return Compiled(tuple(names), tuple(code), outputs)


@cache
def _operations(xp: Any) -> dict[str, Callable[..., Any]]:
    """Operators on arrays of a namespace."""

    def modulo(a: Any, b: Any) -> Any:
        return xp.where(xp.asarray(b) > 0, xp.mod(a, xp.maximum(b, 1)), _UNDEFINED)

    def power(a: Any, b: Any) -> Any:
        if xp.result_type(a, b).kind in "iu":
            return xp.power(xp.asarray(a), xp.maximum(b, 0))
        return xp.power(xp.asarray(a) * 1.0, b)

    def divide(a: Any, b: Any) -> Any:
        quotient = xp.true_divide(a, b)
        if xp is np or xp.result_type(a, b).kind not in "iu":
            return quotient
        # XLA multiplies by the reciprocal of a constant, and floor(41 / 41) would be 0.
        divisor = xp.where(xp.equal(b, 0), 1, b)
        whole_part = xp.floor_divide(a, divisor)
        exact = whole_part + xp.true_divide(a - whole_part * divisor, divisor)
        return xp.where(xp.equal(b, 0), quotient, exact)

    def whole(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
        """Whole doubles as integers; others become a number beyond every range."""
        dtype = np.int64 if xp is np else xp.asarray(0).dtype

        def rounded(a: Any) -> Any:
            a = xp.asarray(a)
            if a.dtype.kind in "iu":
                return a
            number = function(a)
            return xp.where(xp.abs(number) < 2**53, number, _UNDEFINED).astype(dtype)

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
        "/": divide,
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
