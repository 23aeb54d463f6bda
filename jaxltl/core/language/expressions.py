"""Expressions of the PRISM language: syntax trees, types, and folding of constants."""

from __future__ import annotations

import math
import operator as op
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cache, reduce
from typing import Any, Literal

import numpy as np


Type = Literal["bool", "int", "double"]
Value = bool | int | float | Fraction  # fractions in exact arithmetic alone

MAX_DEPTH = 150  # of a tree, also after formulas are substituted: traversals are recursive
MAX_SIZE = 200_000  # nodes, counted as if nothing were shared
MAX_INTEGER = 2**53  # integers up to which every operation on arrays is exact
_MAX_BITS = 20_000  # of powers of fractions
FUNCTIONS = {  # the least and the most numbers of arguments
    **dict.fromkeys(("min", "max"), (1, MAX_SIZE)),
    **dict.fromkeys(("floor", "ceil", "round"), (1, 1)),
    **dict.fromkeys(("pow", "mod", "log"), (2, 2)),
}
RELATIONS = ("<", "<=", ">", ">=")


class LanguageError(ValueError):
    """An error at an offset of a text; :meth:`Source.located` adds file, line and column."""

    def __init__(self, place: int, message: str) -> None:
        super().__init__(message)
        self.place, self.message = place, message


class _UndefinedValue(LanguageError):
    """An operation on values for which it is not defined."""


@dataclass(frozen=True)
class Source:
    """A text and the name under which errors mention it."""

    text: str
    name: str = "model"

    def located(self, error: LanguageError) -> ValueError:
        """The error with file, line and column."""
        place = max(error.place, 0)
        line = self.text.count("\n", 0, place) + 1
        column = place - self.text.rfind("\n", 0, place)
        return ValueError(f"{self.name!r}, line {line}, column {column}: {error.message}")


@dataclass(frozen=True, slots=True)
class Expression:
    """A node of a syntax tree.

    Attributes:
      operator: ``"literal"``, ``"name"``, an operator (``! neg & | => <=> = != < <= > >= + - * /
        ?:``), or a function (``min max floor ceil round pow mod log``). ``& | +`` and
        ``* min max`` take two operands or more.
      operands: the operands, from left to right.
      value: of a literal its value, of a name the name; those of labels have quotes.
      place: offset in the source text, for errors; trees are compared without it.
      depth, size: of the tree, where shared nodes count as often as they occur.

    Example:
      >>> x = Expression("name", value="x")
      >>> str(Expression("+", (x, literal(1))))
      '(x + 1)'
    """

    operator: str
    operands: tuple[Expression, ...] = ()
    value: Value | str | None = None
    place: int = field(default=-1, compare=False, repr=False)
    depth: int = field(init=False, compare=False, repr=False)
    size: int = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        depth, size = 0, 1
        for operand in self.operands:
            depth = max(depth, operand.depth)
            size += operand.size
        object.__setattr__(self, "depth", depth + 1)
        object.__setattr__(self, "size", size)
        if depth >= MAX_DEPTH or size > MAX_SIZE:
            fault = f"deeper than {MAX_DEPTH}" if depth >= MAX_DEPTH else f"larger than {MAX_SIZE}"
            raise LanguageError(
                self.place, f"the expression is {fault} with its formulas; simplify it."
            )

    @property
    def is_literal(self) -> bool:
        """True for a value."""
        return self.operator == "literal"

    def __str__(self) -> str:
        if self.operator == "literal":
            return str(self.value).lower() if isinstance(self.value, bool) else str(self.value)
        if self.operator == "name":
            return str(self.value)
        parts = [str(x) for x in self.operands]
        if self.operator in FUNCTIONS:
            return f"{self.operator}({', '.join(parts)})"
        if self.operator == "?:":
            return f"({parts[0]} ? {parts[1]} : {parts[2]})"
        if len(parts) == 1:
            return ("-" if self.operator == "neg" else "!") + parts[0]
        return f"({f' {self.operator} '.join(parts)})"


def literal(value: Value, place: int = -1) -> Expression:
    """A constant as an expression."""
    return Expression("literal", (), value, place)


TRUE, FALSE = literal(True), literal(False)


def value_type(value: object) -> Type:
    """The type of a value."""
    return "bool" if isinstance(value, bool) else "int" if isinstance(value, int) else "double"


# --- types ------------------------------------------------------------------------------------


def type_of(expression: Expression, types: Mapping[str, Type]) -> Type:
    """The type of an expression; LanguageError for an unknown name or an operand of a wrong type.

    >>> type_of(Expression("/", (literal(4), literal(2))), {})
    'double'
    """
    return _type(expression, types, {})


_SIGNATURES: dict[str, tuple[Type, Type | None]] = {  # of operands and values, "double" any number
    **dict.fromkeys(("!", "&", "|", "=>", "<=>"), ("bool", "bool")),
    **dict.fromkeys(RELATIONS, ("double", "bool")),
    **dict.fromkeys(("floor", "ceil", "round"), ("double", "int")),
    **dict.fromkeys(("/", "log"), ("double", "double")),
    **dict.fromkeys(("neg", "+", "-", "*", "min", "max", "pow"), ("double", None)),  # as operands
    "mod": ("int", "int"),
}


def _type(e: Expression, types: Mapping[str, Type], known: dict[int, Type]) -> Type:
    if (type_ := known.get(id(e))) is None:
        parts = [_type(x, types, known) for x in e.operands]
        type_ = known[id(e)] = _node_type(e, parts, types)
    return type_


def _node_type(e: Expression, parts: list[Type], types: Mapping[str, Type]) -> Type:
    if e.operator == "literal":
        return value_type(e.value)
    if e.operator == "name":
        if str(e.value) not in types:
            raise LanguageError(
                e.place,
                f"{e.value} is not declared; it is no constant, variable, formula or label.",
            )
        return types[str(e.value)]
    result: Type | None
    if e.operator in ("=", "!=", "?:"):
        conditional = e.operator == "?:"
        _require(e, parts[:conditional], "bool")
        parts, result = parts[conditional:], None if conditional else "bool"
        if "bool" in parts and parts[0] != parts[1]:
            cases = "is a Boolean in one case and a number in the other"
            fault = cases if conditional else "compares a Boolean with a number"
            raise LanguageError(e.place, f"{e} {fault}.")
    else:
        operand, result = _SIGNATURES[e.operator]
        _require(e, parts, operand)
    return result or ("double" if "double" in parts else parts[0])


def _require(e: Expression, parts: list[Type], wanted: Type) -> None:
    names = {"bool": "a Boolean", "int": "an integer", "double": "a double"}
    for operand, actual in zip(e.operands, parts, strict=False):
        if actual != wanted and (wanted != "double" or actual == "bool"):
            place = operand.place if operand.place >= 0 else e.place
            expected = "a number" if wanted == "double" else names[wanted]
            raise LanguageError(
                place, f"{operand} is {names[actual]}; {e.operator} takes {expected} as operand."
            )


# --- substitution and folding -----------------------------------------------------------------


def substitute(
    expression: Expression,
    names: Mapping[str, Expression],
    memory: dict[int, Expression] | None = None,
) -> Expression:
    """Replaces names by expressions, and folds operators of literals.

    `memory` has results by node, for calls with the same names and trees that stay alive. Raises
    LanguageError for an operation on literals that is ill-typed, undefined or too large.

    >>> e = Expression("+", (Expression("name", value="N"), literal(1)))
    >>> str(substitute(e, {"N": literal(2)}))
    '3'
    """
    memory = {} if memory is None else memory
    if (result := memory.get(id(expression))) is not None:
        return result
    if expression.operator == "name":
        result = names.get(str(expression.value), expression)
    elif not expression.operands:
        result = expression
    else:
        result = _folded_node(expression, lambda x: substitute(x, names, memory))
    memory[id(expression)] = result
    return result


DECIDING = {"&": False, "|": True, "=>": False}  # what follows such an operand may be undefined


def _folded_node(e: Expression, fold: Callable[[Expression], Expression]) -> Expression:
    """The node after its operands are folded; those that do not count may be undefined."""
    parts: list[Expression] = []
    truth: Value | str | None = None  # of the first operand that decides, or of a condition
    for i, x in enumerate(e.operands):
        chosen = e.operator == "?:" and i > 0 and truth is (i == 1)
        try:
            parts.append(fold(x))
        except _UndefinedValue:
            if truth is None or chosen:
                raise
            continue
        is_first = i == 0 and e.operator in ("?:", "=>")
        if parts[-1].is_literal and (is_first or e.operator in ("&", "|")):
            value = parts[-1].value
            truth = value if value is DECIDING.get(e.operator, value) else truth
    if len(parts) < len(e.operands):
        return parts[1] if e.operator == "?:" else literal(e.operator != "&", e.place)
    return _simplified(e, tuple(parts))


def _simplified(e: Expression, parts: tuple[Expression, ...]) -> Expression:
    """The node with new operands, folded where these decide it."""
    operator = e.operator
    if operator in ("&", "|"):
        _require(e, [value_type(x.value) if x.is_literal else "bool" for x in parts], "bool")
        neutral = operator == "&"
        rest = []
        for part in parts:
            if part.is_literal and part.value is neutral:
                continue
            if part.is_literal and part.value is (not neutral):
                return literal(not neutral, e.place)
            rest.append(part)
        if len(rest) < 2:
            return rest[0] if rest else literal(neutral, e.place)
        parts = tuple(rest)
    elif (
        operator == "?:"
        and isinstance(parts[0].value, bool)
        and not all(x.is_literal for x in parts)
    ):
        return parts[1] if parts[0].value else parts[2]
    elif all(x.is_literal for x in parts):
        _node_type(e, [value_type(x.value) for x in parts], {})
        return literal(apply(operator, [x.value for x in parts], e.place), e.place)
    if len(parts) == len(e.operands) and all(map(op.is_, parts, e.operands)):
        return e
    return Expression(operator, parts, e.value, e.place)


def names_in(expression: Expression, names: set[str] | None = None) -> set[str]:
    """The names that occur in an expression."""
    names = set() if names is None else names
    stack, seen = [expression], set()
    while stack:
        e = stack.pop()
        if id(e) in seen:
            continue
        seen.add(id(e))
        if e.operator == "name":
            names.add(str(e.value))
        stack.extend(e.operands)
    return names


def conjuncts(expression: Expression) -> list[Expression]:
    """The operands of nested conjunctions."""
    if expression.operator != "&":
        return [expression]
    return [x for operand in expression.operands for x in conjuncts(operand)]


# --- operators on Python's numbers ------------------------------------------------------------


def apply(operator: str, values: list[Any], place: int = -1) -> Value:
    """An operator on Python's numbers; LanguageError where it is undefined or too large.

    >>> apply("mod", [-1, 3]), apply("/", [1, 4]), apply("round", [2.5])
    (2, 0.25, 3)
    """
    try:
        result: Value = SCALAR[operator](*values)
    except (TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
        arguments = ", ".join(str(x) for x in values)
        raise _UndefinedValue(
            place, f"{operator} of {arguments} is not defined: {error}."
        ) from None
    if isinstance(result, int) and not isinstance(result, bool) and abs(result) > MAX_INTEGER:
        raise LanguageError(place, f"an integer of {operator} is larger than 2^53.")
    return result


def _divide(a: float, b: float) -> float:
    if b == 0:
        return math.nan if a == 0 or a != a else math.copysign(math.inf, a)
    return a / b


def _power(a: Any, b: Any) -> Any:
    if isinstance(a, int) and isinstance(b, int):
        if b < 0:
            raise ValueError("the exponent of an integer is negative; write pow(1.0 * x, y)")
        if abs(a) > 1 and b * math.log2(abs(a)) > 54:
            raise ValueError("it is larger than 2^53")
        return a**b
    if isinstance(a, Fraction) and not isinstance(b, float) and b == math.floor(b):
        exponent = int(b)
        size = max(a.numerator.bit_length(), a.denominator.bit_length())
        if abs(exponent) * size <= _MAX_BITS:
            return a**exponent
    return math.pow(a, b)


def _modulo(a: int, b: int) -> int:
    if b <= 0:
        raise ValueError("the divisor must be positive")
    return a % b


def _logarithm(x: float, base: float) -> float:
    if x == 0:
        return -math.inf
    return math.log(x) / math.log(base)


def _numbers(*values: Any) -> tuple[Any, ...]:
    """Numbers of one type."""
    return tuple(float(x) for x in values) if float in map(type, values) else values


def _folded(operation: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    return lambda *x: reduce(operation, x)


_COMMON: dict[str, Callable[..., Any]] = {  # of Python's numbers and of arrays
    "!": lambda a: a ^ True,
    "neg": op.neg,
    "&": _folded(op.and_),
    "|": _folded(op.or_),
    "=>": op.le,  # of Booleans
    "<=>": op.eq,
    "=": op.eq,
    "!=": op.ne,
    "<": op.lt,
    "<=": op.le,
    ">": op.gt,
    ">=": op.ge,
    "+": _folded(op.add),
    "-": op.sub,
    "*": _folded(op.mul),
}
SCALAR: dict[str, Callable[..., Any]] = {
    **_COMMON,
    "/": _divide,
    "?:": lambda a, b, c: _numbers(b, c)[0 if a else 1],
    "min": lambda *x: min(_numbers(*x)),
    "max": lambda *x: max(_numbers(*x)),
    "floor": math.floor,
    "ceil": math.ceil,
    "round": lambda a: math.floor(a + 0.5) if abs(a) < 2**52 else int(a),
    "pow": _power,
    "mod": _modulo,
    "log": _logarithm,
}


_UNDEFINED = -(2**30)  # a value beyond the ranges of variables, which updates refuse


@dataclass(frozen=True)
class Compiled:
    """Expressions as instructions without repeated subexpressions; :func:`compile_expressions`."""

    names: tuple[str, ...]  # the variables that are read, of the first slots
    # operator, slots of the operands, and the value of a literal, of each further slot
    code: tuple[tuple[str, tuple[int, ...], Any], ...]
    outputs: tuple[int, ...]  # the slot of each expression

    @np.errstate(all="ignore")
    def __call__(self, values: Mapping[str, Any] | Callable[[str], Any], xp: Any = np) -> list[Any]:
        """Values of the expressions, from an array or a scalar of each variable.

        Those without variables are scalars. Division by zero is infinite or NaN, and a modulus by a
        number that is not positive is -2^30.
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

    return {
        **_COMMON,
        "/": divide,
        "?:": xp.where,
        "min": _folded(xp.minimum),
        "max": _folded(xp.maximum),
        "floor": whole(xp.floor),
        "ceil": whole(xp.ceil),
        "round": whole(lambda a: xp.floor(a + 0.5)),
        "pow": power,
        "mod": modulo,
        "log": lambda a, b: xp.log(a * 1.0) / xp.log(b * 1.0),
    }
