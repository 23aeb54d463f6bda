"""Bounds on expressions of states: arithmetic over variables and results of properties."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import reduce
from typing import cast

import numpy as np

from jaxltl.core.language.exact import exact_tree
from jaxltl.core.language.expressions import (
    DECIDING,
    Expression,
    LanguageError,
    Value,
    names_in,
    substitute,
)
from jaxltl.core.logic.comparisons import Comparison
from jaxltl.core.models.construct.state_formulas import label_columns
from jaxltl.core.logic.property import Property
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.values.properties.answers import Answer


Bounds = tuple[Value, Value]  # fractions, integers, truth values, or infinite doubles
_CORNERS = frozenset(("neg", "+", "-", "*", "min", "max", "floor", "ceil", "round", "!", "=>"))
_CORNERS |= frozenset(("&", "|", "<=>", "<", "<=", ">", ">="))


def expression_bounds(
    model: SparseMDP,
    value: Comparison,
    states: np.ndarray,
    solve: Callable[[Property, np.ndarray], Answer],
) -> list[Bounds]:
    """Lower and upper bounds on an expression in some states; ``False, True`` is an open truth value.

    The operators are applied to bounds in rational arithmetic. ValueError for a wrong type.
    """
    tree = exact_tree(value.expression)
    results = dict(value.definitions)
    columns: dict[str, Sequence[Bounds]] = {}
    for name in sorted(names_in(tree)):
        if name in results:
            meaning = cast(Comparison | Property, results[name])
            columns[name] = (
                expression_bounds(model, meaning, states, solve)
                if isinstance(meaning, Comparison)
                else _results(meaning, solve(meaning, states), states.size)
            )
        elif name.startswith('"'):
            mask = label_columns(model, [name.strip('"')], value.text)[states, 0]
            columns[name] = [(x, x) for x in mask.tolist()]
        else:
            numbers = np.asarray(Comparison(value.text, tree).values_of(name, model.valuation))
            exact = [Fraction(x) if isinstance(x, float) else x for x in numbers[states].tolist()]
            columns[name] = [(x, x) for x in exact]
    known: dict[tuple[Bounds, ...], Bounds] = {}
    bounds = []
    for key in zip(*columns.values(), strict=True) if columns else [()] * states.size:
        if key not in known:
            try:
                known[key] = _bounds(tree, dict(zip(columns, key, strict=True)), {})
            except LanguageError as error:
                raise ValueError(f"{value.text}: {error.message}") from None
            if any(x != x for x in known[key]):
                raise ValueError(
                    f"{value.text}: the value is no number, such as 0/0; write a condition, A ? B : C, for "
                    "the states where it is undefined."
                )
        bounds.append(known[key])
    return bounds


def _results(prop: Property, answer: Answer, count: int) -> list[Bounds]:
    """The results of a property by state, or in all states that of a filter."""
    if answer.holds is not None:
        truth = {True: (True, True), False: (False, False), None: (False, True)}
        bounds: list[Bounds] = [truth[x] for x in answer.holds]
    elif answer.exact is not None:
        bounds = [(x, x) for x in answer.exact]
    else:
        ends = zip(answer.lower.tolist(), answer.upper.tolist(), strict=True)
        bounds = [(_exact(a), _exact(b)) for a, b in ends]
    if len(bounds) == count and prop.aggregate in (None, "print", "printall"):
        return bounds
    if len(bounds) != 1:
        raise ValueError(f"{prop.text} has several results; an expression needs one.")
    return bounds * count


def _exact(x: float) -> Value:
    return Fraction(x) if math.isfinite(x) else x


def _bounds(e: Expression, names: Mapping[str, Bounds], memory: dict[int, Bounds]) -> Bounds:
    """Bounds on a tree by interval arithmetic."""
    if (result := memory.get(id(e))) is not None:
        return result
    if e.operator == "name":
        result = names[str(e.value)]
    elif e.operator == "literal":
        assert e.value is not None and not isinstance(e.value, str)
        result = e.value, e.value
    else:
        parts: list[Bounds] = []
        for x in e.operands:
            parts.append(_bounds(x, names, memory))
            low, high = parts[-1]
            sure = low == high and isinstance(low, bool)
            if sure and e.operator == "?:" and len(parts) == 1:
                return _bounds(e.operands[1 if low else 2], names, memory)
            if sure and low is DECIDING.get(e.operator) and (e.operator != "=>" or len(parts) == 1):
                truth = e.operator != "&"
                return truth, truth
        result = _applied(e, parts)
    memory[id(e)] = result
    return result


def _applied(e: Expression, parts: list[Bounds]) -> Bounds:
    """Bounds on an operator."""
    if all(a == b or (a != a and b != b) for a, b in parts):
        value = _apply(e, [a for a, _ in parts])
        return value, value
    operator = e.operator
    if operator == "?:":
        return _hull([x for case in parts[1:] for x in case])
    if operator in ("=", "!="):
        (a, b), (c, d) = parts
        return (False, True) if a <= d and c <= b else (operator == "!=", operator == "!=")
    if operator in _CORNERS:
        # Monotone in each operand, so that corners attain the bounds.
        if len(parts) > 2:
            return reduce(lambda x, y: _applied(e, [x, y]), parts)
        return _hull([_apply(e, list(corner)) for corner in itertools.product(*parts)])
    (a, b), (c, d) = parts
    safe = {"/": c > 0 or d < 0, "pow": a >= 0, "log": a > 0 and c > 1}
    if not safe.get(operator, False):
        return (-math.inf, math.inf) if operator != "mod" else (0, d)
    return _hull([_apply(e, list(corner)) for corner in itertools.product(*parts)])


def _apply(e: Expression, values: list[Value]) -> Value:
    """An operator on numbers of which types are checked."""
    operands = tuple(Expression("literal", (), x, e.place) for x in values)
    value = substitute(Expression(e.operator, operands, e.value, e.place), {}).value
    assert value is not None and not isinstance(value, str)
    return value


def _hull(values: Sequence[Value]) -> Bounds:
    if any(x != x for x in values):  # infinity minus infinity
        return -math.inf, math.inf
    return min(values), max(values)
