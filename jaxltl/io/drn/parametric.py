"""Parametric models from DRN files and programs, with rational functions as probabilities."""

from __future__ import annotations

import operator
import os
import re
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import reduce
from typing import NoReturn, cast

import numpy as np

from jaxltl.core.array_types import Integers
from jaxltl.core.language.expressions import Expression, LanguageError
from jaxltl.core.language.parser import ExpressionParser
from jaxltl.core.programs.build import MAX_STATES, build_rows
from jaxltl.io.drn.body import Names, Numbers, names_of, read_body, read_header, rewards_of
from jaxltl.io.files import read_bytes
from jaxltl.io.parametric_model import (
    MAX_POWER,
    Malformed,
    ParametricModel,
    RationalFunction,
    number,
    parameter,
)
from jaxltl.io.prism.program import Constants, is_program, read_program
from jaxltl.io.tokens import TokenBlock, Text, as_fraction, numbered, refuse


def read_parametric(
    path: str | os.PathLike[str],
    *,
    constants: Constants = None,
    max_states: int | None = None,
) -> ParametricModel:
    """Parametric Markov chain or MDP from a DRN file or a program in the PRISM language.

    Functions of a DRN file consist of exact numbers, parameters, sums, products, quotients and integer
    powers, without blanks: ``(-1)*p+1``, ``p^2/(p+q)``. The parameters of a program (``.prism``,
    ``.pm``, ``.nm``, ``.sm``) are its constants of type double without a value; decimals are exact.

    Args:
      path: the file, plain or compressed with gzip or xz.
      constants: of a program, values of the other constants, as in ``read_model``.
      max_states: of a program, the largest number of states; default 10 million.

    Returns:
      :class:`ParametricModel`; :meth:`~ParametricModel.over` is differentiable in the parameters.

    Raises:
      ValueError: with file and line, as :func:`~jaxltl.io.drn.drn.read_drn`; a program without
        parameters, or one whose probabilities are no rational functions.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "coin.prism"
      >>> _ = path.write_text("dtmc const double p; module coin x : [0..1]; "
      ...     "[] x=0 -> p : (x'=1) + 1-p : true; [] x=1 -> true; endmodule")
      >>> coin = read_parametric(path)
      >>> coin.at({"p": 0.25}).probability.tolist()
      [0.75, 0.25, 1.0]
      >>> coin.over(0.01, 0.99).numbers(np.array([0.25]))[0].tolist()
      [0.75, 0.25, 1.0]
    """
    if is_program(path):
        return _of_program(path, constants, max_states)
    if constants is not None or max_states is not None:
        raise ValueError(f"{str(path)!r} is no program; constants and max_states are for programs.")
    name, data = str(path), read_bytes(path)
    header = read_header(Text(name, data, 0, len(data)))
    if header.kind == "POMDP":
        refuse(name, "it is a POMDP; expected a Markov chain or an MDP with parameters.")
    if len(set(header.parameters)) < len(header.parameters):
        refuse(name, "a parameter is named twice.")
    index_of_text = {b"0": 0}
    functions = [number(header.parameters, 0)]
    placeholders: dict[str, RationalFunction] = {}
    for place, text in header.placeholders.items():
        try:
            placeholders[place.decode()] = _parsed(text, header.parameters, placeholders)
        except Malformed as error:
            refuse(
                name,
                f"the placeholder {place.decode()} stands for {text[:60].decode()!r}, "
                f"which is {error}.",
            )

    def values(block: TokenBlock, token: Integers) -> Integers:
        texts = block.texts(token)
        indices = numbered(texts, index_of_text)
        for text in list(index_of_text)[len(functions) :]:
            try:
                functions.append(_parsed(text, header.parameters, placeholders))
            except Malformed as error:
                expected = f"a function of {', '.join(header.parameters) or 'no parameter'}"
                raise block.error(
                    int(token[texts.index(text)]), f"{expected} (it is {error})"
                ) from None
        return indices

    try:
        body = read_body(header, values, values)
        state, row = np.concatenate(body.state), np.concatenate(body.row)
        return ParametricModel(
            header.parameters,
            tuple(functions),
            _starts(state, body.num_states),
            _starts(row, body.num_rows),
            np.concatenate(body.successor),
            np.concatenate(body.value).astype(np.int32, copy=False),
            {
                key: (_numbers(of_state, body.num_states), _numbers(of_choice, body.num_rows))
                for key, of_state, of_choice in rewards_of(header, body)
            },
            names_of(header, body),
        )
    except MemoryError:
        refuse(name, "it is too large for the memory.")


def _numbers(values: Numbers | None, size: int) -> Integers:
    """Numbers of functions of a reward; 0, the zero function, where the reward is absent."""
    return (
        np.zeros(size, np.int32) if values is None or not values.size else values.astype(np.int32)
    )


def _starts(owner: Integers, size: int) -> Integers:
    return np.concatenate([[0], np.bincount(owner, minlength=size).cumsum()])


# --- functions ------------------------------------------------------------------------------


class _FunctionParser(ExpressionParser):
    """Parser of the functions of DRN files; ``-p^2`` is ``-(p^2)``, unlike in programs."""

    sign_level = 10
    pattern = re.compile(
        r"(?P<space>\s+)|(?P<number>(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?)"
        r"|(?P<word>[A-Za-z_][\w.\[\]]*)|(?P<sign>[-+*/^()])|(?P<unknown>.)"
    )

    def __init__(self, text: str) -> None:
        self.text = text.replace("**", "^")
        super().__init__(self.text)

    def fail(self, expected: str) -> NoReturn:
        after = self.text[self.place :][:20]
        raise Malformed(f"malformed at {after!r}" if after else "cut")

    def _node(self, operator: str, operands: tuple[Expression, ...], place: int) -> Expression:
        if operator == "-":  # as a + (-b), so that long sums are not deep
            first, second = operands
            terms = first.operands if first.operator == "+" else (first,)
            operator, operands = "+", (*terms, Expression("neg", (second,), place=place))
        return super()._node(operator, operands, place)

    def _prefix(self, level: int) -> Expression:
        while self.accept("+"):
            pass
        return super()._prefix(level)

    def _atom(self) -> Expression:
        kind, text = self.kinds[self.at], self.texts[self.at]
        if kind not in ("number", "word"):
            return super()._atom()
        if kind == "number" and as_fraction(text.encode()) is None:
            self.fail("a number")
        self.at += 1
        return Expression("literal" if kind == "number" else "name", value=text)


def _parsed(
    text: bytes, parameters: tuple[str, ...], placeholders: Mapping[str, RationalFunction]
) -> RationalFunction:
    try:
        string = text.decode()
        if not string.startswith("$"):
            return _RationalFunctions(parameters).function(_FunctionParser(string).whole())
    except UnicodeDecodeError:
        raise Malformed("not UTF-8") from None
    except LanguageError as error:
        raise Malformed(f"too large: {error.message}") from None
    if string not in placeholders:
        raise Malformed("no placeholder that is defined before")
    return placeholders[string]


# --- programs -------------------------------------------------------------------------------


def _of_program(
    path: str | os.PathLike[str], constants: Constants, max_states: int | None
) -> ParametricModel:
    """The model of a program, with its constants of type double without a value as parameters."""
    program = read_program(path, constants)
    name = repr(program.source.name)
    if not program.parameters:
        raise ValueError(f"{name}: every constant has a value, so there is no parameter.")
    if program.kind in ("pomdp", "smg") or program.has_intervals:
        raise ValueError(f"{name}: games, pomdps and intervals with parameters are not supported.")
    rows = build_rows(program, max_states=MAX_STATES if max_states is None else max_states)
    reader = _RationalFunctions(program.parameters)
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


def _power(base: RationalFunction, exponent: RationalFunction) -> RationalFunction:
    power = exponent.constant
    if power is None or power.denominator > 1 or abs(power) > MAX_POWER:
        raise Malformed(f"no power with an integer up to {MAX_POWER}")
    return base ** int(power)


_OPERATORS: dict[str, Callable[..., RationalFunction]] = {
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv, "pow": _power,
}  # fmt: skip


class _RationalFunctions:
    """Rational functions of expressions over some parameters."""

    def __init__(self, parameters: Sequence[str]) -> None:
        self.parameters = tuple(parameters)
        self.known: dict[Expression, RationalFunction] = {}

    def function(self, e: Expression) -> RationalFunction:
        if (known := self.known.get(e)) is None:
            known = self.known[e] = self._function(e)
        return known

    def _function(self, e: Expression) -> RationalFunction:
        if e.operator == "literal":
            return number(self.parameters, Fraction(str(e.value)))  # decimals as they are written
        if e.operator == "name":
            return parameter(self.parameters, str(e.value))
        if e.operator == "neg":
            return -self.function(e.operands[0])
        if e.operator not in _OPERATORS:
            raise Malformed(f"no rational function, because of {e.operator}")
        return reduce(_OPERATORS[e.operator], (self.function(x) for x in e.operands))
