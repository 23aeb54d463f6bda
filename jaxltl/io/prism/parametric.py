"""Parametric Markov models of programs in the PRISM language."""

from __future__ import annotations

import os
from collections.abc import Sequence
from fractions import Fraction
from functools import reduce
from typing import cast

import numpy as np

from jaxltl.core.array_types import Integers
from jaxltl.core.language.expressions import Expression
from jaxltl.core.programs.build import MAX_STATES, build_rows
from jaxltl.io.drn.body import Names
from jaxltl.io.parametric_model import (
    MOST_POWER,
    Malformed,
    ParametricModel,
    RationalFunction,
    add,
    constant,
    divide,
    multiply,
)
from jaxltl.io.prism.program import Constants, read_program


def parametric_program(
    path: str | os.PathLike[str], constants: Constants = None, max_states: int | None = None
) -> ParametricModel:
    """The model of a program, with its constants of type double without a value as parameters."""
    program = read_program(path, constants)
    name = repr(program.source.name)
    if not program.parameters:
        raise ValueError(f"{name}: every constant has a value, so there is no parameter.")
    if program.kind == "smg" or program.has_intervals:
        raise ValueError(f"{name}: games and intervals with parameters are not supported.")
    rows = build_rows(program, max_states=MAX_STATES if max_states is None else max_states)
    reader = _Functions(program.parameters)
    functions = []
    for e in rows.functions:
        try:
            functions.append(reader.function(e))
        except Malformed as error:
            raise ValueError(
                f"{name}: {e} is {error}; probabilities and rewards with parameters are quotients "
                "of polynomials in them."
            ) from None
    num_states, num_choices = rows.row_start.size - 1, rows.entry_start.size - 1
    return ParametricModel(
        program.parameters,
        tuple(functions),
        rows.row_start,
        rows.entry_start,
        rows.successor,
        rows.weight.astype(np.int32),
        {
            key: (_numbers(state, num_states), _numbers(choice, num_choices))
            for key, (state, choice) in rows.rewards.items()
        },
        cast(Names, rows.annotations),
    )


def _numbers(given: Integers | None, size: int) -> Integers:
    """Numbers of functions; 0 is the zero function."""
    return np.zeros(size, np.int32) if given is None else given.astype(np.int32)


class _Functions:
    """Rational functions of expressions over some parameters."""

    def __init__(self, parameters: Sequence[str]) -> None:
        self.parameters = tuple(parameters)
        self.one = constant(self.parameters, 1)
        self.known: dict[Expression, RationalFunction] = {}

    def function(self, e: Expression) -> RationalFunction:
        if (found := self.known.get(e)) is None:
            found = self.known[e] = self._function(e)
        return found

    def number(self, value: Fraction | int) -> RationalFunction:
        return RationalFunction(constant(self.parameters, value), self.one)

    def _function(self, e: Expression) -> RationalFunction:
        if e.operator == "literal":
            return self.number(Fraction(str(e.value)))  # decimals as they are written
        if e.operator == "name":
            powers = tuple(int(name == e.value) for name in self.parameters)
            return RationalFunction({powers: Fraction(1)}, self.one)
        if e.operator not in ("+", "-", "*", "/", "neg", "pow"):
            raise Malformed(f"no rational function, because of {e.operator}")
        if e.operator == "pow":
            return self._power(*e.operands)
        parts = [self.function(x) for x in e.operands]
        minus = self.number(-1)
        match e.operator:
            case "+":
                return reduce(add, parts)
            case "-":
                return add(parts[0], multiply(minus, parts[1]))
            case "neg":
                return multiply(minus, parts[0])
            case "*":
                return reduce(multiply, parts)
        return divide(*parts)

    def _power(self, base: Expression, exponent: Expression) -> RationalFunction:
        value = exponent.value
        if not (exponent.is_literal and isinstance(value, int) and abs(value) <= MOST_POWER):
            raise Malformed(f"no power with an integer up to {MOST_POWER}")
        found = self.number(1)
        for _ in range(abs(value)):
            found = multiply(found, self.function(base))
        return found if value >= 0 else divide(self.number(1), found)
