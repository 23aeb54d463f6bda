"""PRISM-language files: programs, values of constants, and sparse, interval or game models."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

from jaxltl.core.language.parser import parse_program
from jaxltl.core.language.resolve import resolve
from jaxltl.core.language.syntax import Program, Syntax
from jaxltl.core.models import POMDP, Game, IntervalMDP, MultiplayerGame, SparseMDP
from jaxltl.core.programs.build import MAX_STATES, build_model as build_model
from jaxltl.core.programs.partial import solve_program as solve_program
from jaxltl.core.programs.simulation import (
    program_actions as program_actions,
    program_environment as program_environment,
)
from jaxltl.io.files import read_text, suffix_of

SUFFIXES = (".prism", ".pm", ".nm", ".sm", ".smg")
MAX_BYTES = 2**24  # of a program

Constants = Mapping[str, object] | str | None


def constants_of(constants: Constants) -> dict[str, object]:
    """Values of constants from a mapping, or from a text such as ``"N=64,MAX=4"``.

    >>> constants_of("N=64, p = min(1, 2)")
    {'N': '64', 'p': 'min(1, 2)'}
    """
    if constants is None:
        return {}
    if isinstance(constants, Mapping):
        return dict(constants)
    if not isinstance(constants, str):
        raise ValueError(
            f"constants is {constants!r}; give a dict, or a text such as 'N=64,MAX=4'."
        )
    values: dict[str, object] = {}
    parts = [""]
    for character in constants:
        if character == "," and parts[-1].count("(") == parts[-1].count(")"):
            parts.append("")
        else:
            parts[-1] += character
    for part in parts:
        name, equals, value = (x.strip() for x in part.partition("="))
        if not part.strip():
            continue
        if not (name.isidentifier() and equals and value):
            raise ValueError(f"constants: {part.strip()!r}; write NAME=VALUE, as in N=64,MAX=4.")
        if name in values:
            raise ValueError(f"constants: {name} is given twice.")
        if ":" in value and "?" not in value:
            raise ValueError(f"constants: {name}={value} is a range; give one value.")
        values[name] = value
    return values


def read_program(path: str | os.PathLike[str], constants: Constants = None) -> Program:
    """The program of a file in the PRISM language, with constants and formulas substituted.

    Args:
      path: the file, plain or compressed with gzip or xz.
      constants: values of constants, in a dict or as a text such as ``"N=64,MAX=4"``.

    Returns:
      :class:`~jaxltl.core.language.syntax.Program`, for ``jaxltl.io.build_model`` and
      ``jaxltl.io.program_environment``.

    Raises:
      ValueError: with file, line and column, as
        :func:`~jaxltl.core.language.resolve.read_program`.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "walk.prism"
      >>> _ = path.write_text("dtmc const int N; module m x : [0..N]; [] true -> (x'=N); endmodule")
      >>> read_program(path, "N=3").variables[0].high
      3
    """
    return resolve(read_syntax(path), constants_of(constants))


def is_program(path: str | os.PathLike[str]) -> bool:
    """True if the suffix is one of programs in the PRISM language."""
    return suffix_of(path) in SUFFIXES


def read_syntax(path: str | os.PathLike[str]) -> Syntax:
    """The syntax tree of a program in a file."""
    text = read_text(path, "a program in the PRISM language")
    if len(text) > MAX_BYTES:
        raise ValueError(f"{str(path)!r} has more than {MAX_BYTES} characters.")
    return parse_program(text, str(path))


def read_program_model(
    path: str | os.PathLike[str],
    constants: Constants = None,
    max_states: int | None = None,
    coalition: Sequence[str] | None = None,
) -> SparseMDP | IntervalMDP | Game | MultiplayerGame | POMDP:
    """The model of a program in a file; see :func:`~jaxltl.core.programs.build.build_model`."""
    program = read_program(path, constants)
    max_states = MAX_STATES if max_states is None else max_states
    return build_model(program, max_states=max_states, coalition=coalition)
