"""Conditions on a model's variables, such as ``x + y <= 3``, in properties."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.array_types import Booleans, PyTree
from jaxltl.core.language.expressions import (
    Expression,
    LanguageError,
    Type,
    Value,
    compile_expressions,
    literal,
    names_in,
    substitute,
    type_of,
)
from jaxltl.core.language.exact import exact_constant, exact_tree, is_inexact
from jaxltl.core.language.exact_program import exact_program
from jaxltl.core.language.resolve import constant_value
from jaxltl.core.language.syntax import Program
from jaxltl.core.pretty_print import brief


@brief(fields=("text",))
@dataclass(frozen=True)
class Comparison:
    """A Boolean expression over variables, such as a comparison.

    Attributes:
      text: as it was written.
      expression: the tree, over variables of a model, labels in quotes and definitions.
      definitions: properties whose results the expression uses, by name.

    Example:
      >>> from jaxltl.core.language.parser import parse_expression
      >>> both = Comparison("x < 2", parse_expression("x < 2"))
      >>> both.holds({"x": np.array([1, 2])}).tolist()
      [True, False]
    """

    text: str
    expression: Expression
    definitions: tuple[
        tuple[str, PyTree], ...
    ] = ()  # comparisons, and properties of a module above

    @property
    def is_number(self) -> bool:
        """True if it has a number as value, as far as its operators show."""
        tree, results = self.expression, dict(self.definitions)
        while tree.operator == "?:":
            tree = tree.operands[1]
        if tree.operator == "name" and (meaning := results.get(str(tree.value))) is not None:
            return bool(meaning.is_number)
        is_number = tree.is_literal and not isinstance(tree.value, bool)
        return is_number or tree.operator in _NUMBERS

    @property
    def needs_results(self) -> bool:
        """True if labels or results of properties occur."""
        return any(name[0] in '"[' for name in names_in(self.expression))

    def holds(self, valuation: Mapping[str, ArrayLike]) -> Booleans:
        """The states ``bool[S]`` in which it holds; ValueError for an unknown variable."""
        names = sorted(names_in(self.expression))
        values = {name: self.values_of(name, valuation) for name in names}
        try:
            kind = self._type(values)
        except LanguageError as error:
            # Files of other formats have Booleans as 0 and 1: ready=1.
            values = {n: x.astype(np.int64) if x.dtype == bool else x for n, x in values.items()}
            try:
                kind = self._type(values)
            except LanguageError:
                raise ValueError(f"{self.text}: {error.message}") from None
        if kind != "bool":
            raise ValueError(f"{self.text} is a number; write a comparison, such as x>0.")
        if is_inexact(self.expression):
            return self._exact(values)
        truth, *parts = compile_expressions([self.expression, *_undefined(self.expression)])(values)
        if not all(np.isfinite(x).all() for x in parts):
            raise ValueError(f"{self.text} divides by zero or overflows in some state.")
        size = max((np.size(x) for x in valuation.values()), default=0)
        holds: Booleans = np.broadcast_to(np.asarray(truth, bool), (size,))
        return holds

    def _exact(self, values: Mapping[str, NDArray[np.generic]]) -> Booleans:
        """The states in which it holds, in rational arithmetic for each distinct valuation."""
        tree = exact_tree(self.expression)
        rows = list(zip(*(x.tolist() for x in values.values()), strict=True))
        truth: dict[tuple[Value, ...], Value] = {}
        for row in set(rows):
            numbers = [Fraction(x) if isinstance(x, float) else x for x in row]
            names = {n: literal(x) for n, x in zip(values, numbers, strict=True)}
            try:
                value = substitute(tree, names).value
                parts = [substitute(e, names).value for e in _undefined(tree)]
            except LanguageError as error:
                raise ValueError(f"{self.text}: {error.message}") from None
            if not all(math.isfinite(cast(float, x)) for x in parts):
                raise ValueError(f"{self.text} divides by zero or overflows in some state.")
            truth[row] = cast(Value, value)
        return np.array([truth[row] for row in rows], bool)

    def _type(self, values: Mapping[str, NDArray[np.generic]]) -> Type:
        types: dict[str, Type] = {n: _TYPES[x.dtype.kind] for n, x in values.items()}
        return type_of(self.expression, types)

    def values_of(self, name: str, valuation: Mapping[str, ArrayLike]) -> NDArray[np.generic]:
        """The values of a variable in all states; ValueError if there is none."""
        if name not in valuation:
            raise ValueError(
                f"{self.text} mentions {name}, which is no variable of the model; it has "
                f"{', '.join(valuation) or 'none'}. Labels are written in double quotes."
            )
        values = np.asarray(valuation[name])
        if values.dtype.kind not in "biuf":
            raise ValueError(f"{self.text}: the variable {name} has no numbers as values.")
        if values.dtype.kind in "iu":
            return values.astype(np.int64)
        return values.astype(np.float64) if values.dtype.kind == "f" else values


def _undefined(expression: Expression) -> list[Expression]:
    """The operands that are not finite everywhere."""
    conditions = [x for operand in expression.operands for x in _undefined(operand)]
    return [*conditions, expression] if expression.operator in ("/", "log", "pow") else conditions


RationalNames = tuple[dict[str, Expression], dict[str, Value]]
_NUMBERS = ("+", "-", "*", "/", "neg", "min", "max", "floor", "ceil", "round", "pow", "mod", "log")
_TYPES: Mapping[str, Type] = {"b": "bool", "i": "int", "u": "int", "f": "double"}


def _no_rational_names() -> RationalNames:
    return {}, {}


@brief
@dataclass(frozen=True)
class Definitions:
    """Names that properties may use, other than labels of the model.

    Attributes:
      names: the value of each constant and the expression of each formula.
      variables: the variables of the model.
      integers: those of the variables that are known to be integers.
      rewards: the names of the reward structures in their order, for ``R{2}``.
      constant_values: values of constants that a property file declares without one.
      rational: the rational values of the names, and those of the constants of a property file.
      automaton: reads the file of an automaton, ``HOA: {"file.hoa"}``, in a path, as ``jaxltl solve`` does.

    Example:
      >>> sorted(Definitions(variables=("x", "y")).known)
      ['x', 'y']
    """

    names: Mapping[str, Expression] = field(default_factory=dict)
    variables: tuple[str, ...] = ()
    integers: frozenset[str] = frozenset()
    rewards: tuple[str, ...] = ()
    constant_values: Mapping[str, Value] = field(default_factory=dict)
    rational: Callable[[], RationalNames] = field(
        default_factory=lambda: _no_rational_names, repr=False
    )
    automaton: Callable[[str], PyTree] | None = field(default=None, repr=False)

    @cached_property
    def rational_names(self) -> RationalNames:
        """The result of `rational`."""
        return self.rational()

    @cached_property
    def known(self) -> frozenset[str]:
        """All names."""
        return frozenset(self.names) | frozenset(self.variables)


def program_definitions(
    program: Program, constant_values: Mapping[str, object] | None = None
) -> Definitions:
    """The constants, formulas, variables and rewards of a program, for ``parse_properties``.

    Args:
      program: of ``jaxltl.io.read_program``.
      constant_values: values of constants that the text of properties declares without one:
        numbers, Booleans or texts such as ``"1/3"``.

    Returns:
      :class:`Definitions`.

    Example:
      >>> from jaxltl.core.language.resolve import read_program
      >>> p = read_program("dtmc const int N=3; module m x : [0..N]; [] true -> true; endmodule")
      >>> sorted(program_definitions(p).known)
      ['N', 'x']
    """
    names = {name: literal(value) for name, value in program.constants.items()}
    values = {name: constant_value(name, x) for name, x in (constant_values or {}).items()}

    def rational() -> RationalNames:
        numbers = exact_program(program)
        exact: dict[str, Expression] = {}
        if numbers is not None:
            exact |= {name: literal(value) for name, value in numbers.constants.items()}
            exact |= numbers.formulas
        return exact, {name: exact_constant(x) for name, x in (constant_values or {}).items()}

    return Definitions(
        names | program.formulas,
        tuple(v.name for v in program.variables),
        frozenset(v.name for v in program.variables if v.type == "int"),
        tuple(r.name for r in program.rewards),
        values,
        rational,
    )
