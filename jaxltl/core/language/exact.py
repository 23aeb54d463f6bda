"""Expressions in rational arithmetic: literals, quotients and constants as they are written."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from fractions import Fraction

from jaxltl.core.language.expressions import Expression, LanguageError, literal, substitute
from jaxltl.core.language.parser import ExpressionParser

_NUMBER = re.compile(r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_MAX_EXPONENT = 400  # of a decimal, as many digits as a double needs
_ONE = literal(Fraction(1))
_TOO_LARGE = 2**31  # of integers on arrays in single precision
_DENOMINATOR = 10**6  # of a double that is given for a constant


def exact_tree(expression: Expression, text: str = "") -> Expression:
    """An expression that is folded in rational arithmetic.

    Decimals are fractions, by their place in the text, and quotients are those of fractions. Values
    of other functions, such as logarithms, remain doubles.

    >>> from jaxltl.core.language.expressions import substitute
    >>> substitute(exact_tree(ExpressionParser("0.1 + 1/3").whole(), "0.1 + 1/3"), {}).value
    Fraction(13, 30)
    """
    return shared_exact_tree(expression, text, {})


def shared_exact_tree(e: Expression, text: str, memory: dict[int, Expression]) -> Expression:
    """The same with results by node, for trees that share nodes and stay alive."""
    if (result := memory.get(id(e))) is not None:
        return result
    result = e
    if isinstance(e.value, float) and e.is_literal:
        result = literal(_written(e.value, text, e.place), e.place)
    elif e.operands:
        operands = tuple([shared_exact_tree(x, text, memory) for x in e.operands])
        if e.operator == "/":
            operands = (Expression("*", (_ONE, operands[0]), place=e.place), operands[1])
        result = Expression(e.operator, operands, e.value, e.place)
    memory[id(e)] = result
    return result


def is_inexact(expression: Expression) -> bool:
    """True if doubles may differ from the rational value: it has quotients or decimals."""
    if expression.is_literal:
        return isinstance(expression.value, float | Fraction)
    return expression.operator in ("/", "pow", "log") or any(map(is_inexact, expression.operands))


def _written(value: float, text: str, place: int) -> Fraction | float:
    """The decimal at a place of a text, if it rounds to the value; else its shortest decimal.

    Infinite values, of a division by zero, remain doubles.
    """
    if not math.isfinite(value):
        return value
    match = _NUMBER.match(text, place) if place >= 0 else None
    if match is not None:
        exponent = re.split("[eE]", match[0])[1:] or ["0"]
        if abs(int(exponent[0])) <= _MAX_EXPONENT and float(match[0]) == value:
            return Fraction(match[0])
    return Fraction(repr(value))


def exact_value(expression: Expression, names: Mapping[str, Expression]) -> Fraction | None:
    """The rational value of a tree of :func:`exact_tree`; None if it has none."""
    try:
        e = substitute(expression, names)
    except LanguageError:
        return None
    value = e.value
    if not e.is_literal or isinstance(value, bool) or not isinstance(value, int | Fraction):
        return None
    return Fraction(value)


def exact_constant(value: object) -> bool | int | Fraction:
    """The rational value that is given for a constant: a number, a Boolean, or the text of one.

    Doubles are the fractions with denominators of at most 10^6 that round to them, else their
    shortest decimals. Raises ValueError if the text has no rational value.
    """
    if isinstance(value, str):
        e = substitute(exact_tree(ExpressionParser(value).whole(), value), {})
        value = e.value
    if hasattr(value, "item"):
        value = value.item()
    if isinstance(value, int | Fraction):
        return value
    if not isinstance(value, float):
        raise ValueError(
            f"{value!r} is not a rational number; give an integer, a decimal or a fraction."
        )
    simple = Fraction(value).limit_denominator(_DENOMINATOR)
    return simple if float(simple) == value else Fraction(repr(value))


Monomials = dict[tuple[str, ...], Fraction]  # coefficients by the variables that are multiplied


def exact_comparisons(e: Expression, largest: Mapping[str, int]) -> Expression:
    """The tree of :func:`exact_tree` with comparisons of polynomials in integers in place of fractions.

    Both sides are multiplied by a common denominator. `largest` has the largest absolute value of each
    integer variable; comparisons whose terms may exceed 2^31 are left as they are, in doubles.
    """
    left, right = None, None
    if e.operator in ("<", "<=", ">", ">=", "=", "!="):
        left, right = (_polynomial(x) for x in e.operands)
    if left is not None and right is not None:
        terms = dict(left)
        for key, c in right.items():
            terms[key] = terms.get(key, Fraction(0)) - c
        scale = math.lcm(*(c.denominator for c in terms.values()))
        whole: dict[tuple[str, ...], int] = {key: int(c * scale) for key, c in terms.items() if c}
        bounds = [
            abs(c) * math.prod(largest.get(n, _TOO_LARGE) for n in k) for k, c in whole.items()
        ]
        if sum(bounds) >= _TOO_LARGE:
            return e
        constant = -whole.pop((), 0)
        products = []
        for key, count in whole.items():
            factors = (literal(count), *(Expression("name", value=n, place=e.place) for n in key))
            products.append(Expression("*", factors, place=e.place))
        total = (
            products[0] if len(products) == 1 else Expression("+", tuple(products), place=e.place)
        )
        if not products:
            total = literal(0, e.place)
        return substitute(Expression(e.operator, (total, literal(constant)), place=e.place), {})
    if not e.operands or not is_inexact(e):
        return e
    operands = tuple(exact_comparisons(x, largest) for x in e.operands)
    return Expression(e.operator, operands, e.value, e.place)


def _polynomial(e: Expression) -> Monomials | None:
    """The coefficients of a polynomial in names; None for other expressions and for Booleans."""
    if e.is_literal:
        number = isinstance(e.value, int | Fraction) and not isinstance(e.value, bool)
        return {(): Fraction(e.value)} if number else None  # type: ignore[arg-type]
    if e.operator == "name":
        return {(str(e.value),): Fraction(1)}
    if e.operator not in ("+", "-", "neg", "*", "/"):
        return None
    parts = [_polynomial(x) for x in e.operands]
    total: Monomials = {}
    for i, part in enumerate(parts):
        if part is None:
            return None
        if e.operator in ("*", "/") and i:
            if e.operator == "/":
                if part.keys() != {()} or not part[()]:
                    return None
                part = {(): 1 / part[()]}
            pairs = [(j, k, c * d) for j, c in total.items() for k, d in part.items()]
            total = {}
            for j, k, c in pairs:
                key = tuple(sorted(j + k))
                total[key] = total.get(key, Fraction(0)) + c
            continue
        sign = -1 if e.operator == "neg" or (e.operator == "-" and i) else 1
        for key, c in part.items():
            total[key] = total.get(key, Fraction(0)) + sign * c
    return total
