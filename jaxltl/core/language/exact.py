"""Programs in rational arithmetic: literals, quotients and constants as they are written."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction

from jaxltl.core.language.expressions import Expression, LanguageError, literal, substitute
from jaxltl.core.language.parser import ExpressionParser
from jaxltl.core.language.resolve import changed, resolved
from jaxltl.core.language.syntax import Program, Syntax

_NUMBER = re.compile(r"(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
_MAX_EXPONENT = 400  # of a decimal, as many digits as a double needs
_ONE = literal(Fraction(1))
_DENOMINATOR = 10**6  # of a double that is given for a constant


def exact_tree(expression: Expression, text: str = "") -> Expression:
    """An expression that is folded in rational arithmetic.

    Decimals are fractions, by their place in the text, and quotients are those of fractions. Values
    of other functions, such as logarithms, remain doubles.

    >>> from jaxltl.core.language.expressions import substitute
    >>> substitute(exact_tree(ExpressionParser("0.1 + 1/3").whole(), "0.1 + 1/3"), {}).value
    Fraction(13, 30)
    """
    return _exact_tree(expression, text, {})


def _exact_tree(e: Expression, text: str, memory: dict[int, Expression]) -> Expression:
    if (result := memory.get(id(e))) is not None:
        return result
    result = e
    if isinstance(e.value, float) and e.is_literal:
        result = literal(_written(e.value, text, e.place), e.place)
    elif e.operands:
        operands = tuple([_exact_tree(x, text, memory) for x in e.operands])
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


def _written(value: float, text: str, place: int) -> Fraction:
    """The decimal at a place of a text, if it rounds to the value; else its shortest decimal."""
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


def exact_program(program: Program) -> Program | None:
    """The program with its probabilities and rewards folded in rational arithmetic.

    Guards and updates are those of the program, so that both have the same states. None if the
    program has no syntax tree, or is not resolved in fractions.
    """
    if program.syntax is None:
        return None
    try:
        values = {name: exact_constant(x) for name, x in program.arguments.items()}
        exact = resolved(_exact_syntax(program.syntax), values, real=Fraction)
        modules = []
        for m, other in zip(program.modules, exact.modules, strict=True):
            commands = []
            for c, d in zip(m.commands, other.commands, strict=True):
                outcomes = [
                    replace(o, probability=p.probability)
                    for o, p in zip(c.outcomes, d.outcomes, strict=True)
                ]
                commands.append(replace(c, outcomes=tuple(outcomes)))
            modules.append(replace(m, commands=tuple(commands)))
        rewards = []
        for r, s in zip(program.rewards, exact.rewards, strict=True):
            items = [replace(i, value=j.value) for i, j in zip(r.items, s.items, strict=True)]
            rewards.append(replace(r, items=tuple(items)))
    except (ValueError, ArithmeticError, TypeError):
        return None
    return replace(
        program,
        modules=tuple(modules),
        rewards=tuple(rewards),
        constants=exact.constants,
        formulas=exact.formulas,
    )


def _exact_syntax(syntax: Syntax) -> Syntax:
    memory: dict[int, Expression] = {}
    text = syntax.source.text

    def change(e: Expression) -> Expression:
        return _exact_tree(e, text, memory)

    return replace(
        syntax,
        constants=list(changed(tuple(syntax.constants), change)),
        formulas=list(changed(tuple(syntax.formulas), change)),
        variables=list(changed(tuple(syntax.variables), change)),
        modules=list(changed(tuple(syntax.modules), change)),
        labels=list(changed(tuple(syntax.labels), change)),
        rewards=list(changed(tuple(syntax.rewards), change)),
        initial=None if syntax.initial is None else change(syntax.initial),
    )
