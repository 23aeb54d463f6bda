"""Parametric models from DRN files: rational functions as probabilities and rewards."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from jaxltl.core.array_types import Integers
from jaxltl.io.drn.body import Numbers, names_of, read_body, read_header, rewards_of
from jaxltl.io.files import read_bytes
from jaxltl.io.parametric_model import (
    MOST_DEPTH,
    MOST_POWER,
    Malformed,
    ParametricModel,
    RationalFunction,
    add,
    constant,
    divide,
    multiply,
)
from jaxltl.io.prism.parametric import parametric_program
from jaxltl.io.prism.program import Constants, is_program
from jaxltl.io.tokens import Block, Text, as_fraction, numbered, refuse

_TOKEN = re.compile(
    r"\s*(?:(\d+(?:\.\d*)?(?:[eE][+-]?\d+)?|\.\d+(?:[eE][+-]?\d+)?)"
    r"|([A-Za-z_][\w.\[\]]*)|(\*\*|[-+*/^()]))"
)


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
        return parametric_program(path, constants, max_states)
    if constants is not None or max_states is not None:
        raise ValueError(f"{str(path)!r} is no program; constants and max_states are for programs.")
    name, data = str(path), read_bytes(path)
    header = read_header(Text(name, data, 0, len(data)))
    if len(set(header.parameters)) < len(header.parameters):
        refuse(name, "a parameter is named twice.")
    index_of_text = {b"0": 0}
    functions = [RationalFunction({}, constant(header.parameters, 1))]
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

    def values(block: Block, token: Integers) -> Integers:
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
                key: (_everywhere(of_state, body.num_states), _everywhere(of_choice, body.num_rows))
                for key, of_state, of_choice in rewards_of(header, body)
            },
            names_of(header, body),
        )
    except MemoryError:
        refuse(name, "it is too large for the memory.")


def _everywhere(function: Numbers, size: int) -> Integers:
    """Function numbers of a reward; all zero (the zero function) where the reward is absent."""
    return function.astype(np.int32, copy=False) if function.size else np.zeros(size, np.int32)


def _starts(owner: Integers, size: int) -> Integers:
    return np.concatenate([[0], np.bincount(owner, minlength=size).cumsum()])


# --- functions ------------------------------------------------------------------------------


def _parsed(
    text: bytes, parameters: tuple[str, ...], placeholders: Mapping[str, RationalFunction]
) -> RationalFunction:
    try:
        string = text.decode()
    except UnicodeDecodeError:
        raise Malformed("not UTF-8") from None
    if string.startswith("$"):
        if string not in placeholders:
            raise Malformed("no placeholder that is defined before")
        return placeholders[string]
    tokens, place = [], 0
    while place < len(string):
        match = _TOKEN.match(string, place)
        if match is None:
            raise Malformed(f"malformed at {string[place : place + 20]!r}")
        tokens.append(match[0].strip())
        place = match.end()
    reader = _Reader(tokens, parameters)
    result = reader.sum(0)
    if reader.place < len(tokens):
        raise Malformed(f"malformed at {tokens[reader.place][:20]!r}")
    return result


@dataclass
class _Reader:
    """Recursive-descent parser of rational functions."""

    tokens: list[str]
    parameters: tuple[str, ...]
    place: int = 0

    def next(self) -> str:
        return self.tokens[self.place] if self.place < len(self.tokens) else ""

    def take(self) -> str:
        self.place += 1
        return self.tokens[self.place - 1] if self.place <= len(self.tokens) else ""

    def number(self, value: Fraction | int) -> RationalFunction:
        return RationalFunction(constant(self.parameters, value), constant(self.parameters, 1))

    def sum(self, depth: int) -> RationalFunction:
        if depth > MOST_DEPTH:
            raise Malformed("nested too deeply")
        result = self.product(depth)
        while self.next() in ("+", "-"):
            sign = self.take()
            other = self.product(depth)
            result = add(result, other if sign == "+" else multiply(self.number(-1), other))
        return result

    def product(self, depth: int) -> RationalFunction:
        result = self.power(depth)
        while self.next() in ("*", "/"):
            combine: Callable[..., RationalFunction] = multiply if self.take() == "*" else divide
            result = combine(result, self.power(depth))
        return result

    def power(self, depth: int) -> RationalFunction:
        sign = 1
        while self.next() in ("+", "-"):
            sign = -sign if self.take() == "-" else sign
        result = self.atom(depth)
        if self.next() in ("^", "**"):
            self.take()
            exponent = self.take()
            if not re.fullmatch(r"[0-9]{1,4}", exponent) or int(exponent) > MOST_POWER:
                raise Malformed("no whole power up to 1000")
            base, result = result, self.number(1)
            if (max(len(base.numerator), len(base.denominator)) - 1) * int(exponent) > MOST_POWER:
                raise Malformed("too large")
            for _ in range(int(exponent)):
                result = multiply(result, base)
        return result if sign == 1 else multiply(self.number(-1), result)

    def atom(self, depth: int) -> RationalFunction:
        token = self.take()
        if token == "(":
            result = self.sum(depth + 1)
            if self.take() != ")":
                raise Malformed("without a closing bracket")
            return result
        if token in self.parameters:
            powers = tuple(int(name == token) for name in self.parameters)
            return RationalFunction({powers: Fraction(1)}, constant(self.parameters, 1))
        number = as_fraction(token.encode())
        if number is None:
            raise Malformed(f"malformed at {token[:20]!r}" if token else "cut")
        return self.number(number)
