"""Properties in PRISM's syntax, from text and from files of properties."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from jaxltl.core.automata import Automaton
from jaxltl.core.language.resolve import constant_value, resolve
from jaxltl.core.language.syntax import Program
from jaxltl.core.logic import Definitions, Property, program_definitions
from jaxltl.core.logic.properties import parse_each
from jaxltl.io.files import raw_bytes
from jaxltl.io.hoa.hoa import read_hoa
from jaxltl.io.prism.program import constants_of, is_program, read_syntax

PROPERTY_FILES = (".props", ".prop", ".pctl")
MAX_FILE = 2**24  # bytes of a property file


@dataclass(frozen=True)
class PropertyQuery:
    """A property of a command or of a file.

    Attributes:
      text: as in the command or file.
      parsed: the property; None for a malformed one.
      error: why it is malformed, or None.
    """

    text: str
    parsed: Property | None = None
    error: str | None = None


def parse_queries(
    arguments: Sequence[str], definitions: Definitions | None = None, model: Path | None = None
) -> list[PropertyQuery]:
    """Properties, and those of files of properties; errors are kept by property.

    Args:
      arguments: properties in text, or names of files that end in .props, .prop or .pctl.
      definitions: names that they may use, such as the constants of a program; default none.
      model: the model file, in whose folder automata of ``$MODEL_DIR`` are read.

    Returns:
      A :class:`PropertyQuery` for each property, in order.

    Example:
      >>> right, wrong = parse_queries(['Pmax=? [ F "goal" ]', "Pmax=?"])
      >>> right.error, wrong.parsed
      (None, None)
    """
    queries = []
    for argument in arguments:
        place, text = "", argument
        known = replace(
            definitions or Definitions(), automaton=partial(_automaton, argument, model)
        )
        if argument.lower().endswith(PROPERTY_FILES):
            try:
                place, text = f"{argument}: ", _text_of(Path(argument))
            except ValueError as error:
                queries.append(PropertyQuery(argument, error=str(error)))
                continue
        for one in parse_each(text, known):
            if isinstance(one, Property):
                queries.append(PropertyQuery(one.text, one))
            else:
                queries.append(PropertyQuery(one.text, error=f"{place}{one.error}"))
    return queries


def _automaton(argument: str, model: Path | None, name: str) -> Automaton:
    """The automaton of a HOA file that a property names, beside the file of properties."""
    beside = Path(argument).parent if argument.lower().endswith(PROPERTY_FILES) else Path()
    folders = {"$PROPERTY_DIR/": beside, "$MODEL_DIR/": model.parent if model else beside}
    for start, folder in folders.items():
        if name.startswith(start):
            return read_hoa(_text_of(folder / name.removeprefix(start)))
    return read_hoa(_text_of(beside / name))


def _text_of(path: Path) -> str:
    data = raw_bytes(path, MAX_FILE)
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise ValueError(f"cannot read {str(path)!r}: byte {error.start} is not UTF-8.") from None


def read_queries(
    path: Path, constants: str | None, arguments: Sequence[str]
) -> tuple[Program | None, list[PropertyQuery]]:
    """The program of a model file, if it is one, and properties of it.

    Args:
      path: a model file, or a program in the PRISM language.
      constants: such as ``"N=64,MAX=4"``, of the program or of the properties; None for none.
      arguments: as for :func:`parse_queries`.

    Returns:
      The program, or None, and the properties.

    Raises:
      ValueError: a malformed program or constant, or no well-formed property.

    Example:
      >>> import tempfile
      >>> folder = Path(tempfile.mkdtemp())
      >>> text = "dtmc const int N; module m x : [0..N]; [] x<N -> (x'=x+1); endmodule"
      >>> _ = (folder / "count.prism").write_text(text)
      >>> program, (query,) = read_queries(folder / "count.prism", "N=3", ["P=? [ F x=N ]"])
      >>> program.kind, query.parsed.operator
      ('dtmc', 'P')
    """
    program, definitions = _read_source(path, constants, arguments)
    queries = parse_queries(arguments, definitions, path)
    if all(one.parsed is None for one in queries):
        raise ValueError("\n".join(str(one.error) for one in queries))
    return program, queries


def _read_source(
    path: Path, constants: str | None, arguments: Sequence[str]
) -> tuple[Program | None, Definitions | None]:
    """The program of a file in the PRISM language, and the names that properties may use.

    Constants that the program does not declare are those of the properties.
    """
    if not is_program(path):
        if constants is not None:
            raise ValueError(f"--const goes with programs in the PRISM language; {path} is none.")
        return None, None
    values, syntax = constants_of(constants), read_syntax(path)
    declared = {c.name for c in syntax.constants}
    program = resolve(syntax, {k: v for k, v in values.items() if k in declared})
    rest = {k: constant_value(k, v) for k, v in values.items() if k not in declared}
    texts = [_text_of(Path(x)) if x.lower().endswith(PROPERTY_FILES) else x for x in arguments]
    for name in rest:
        if not any(re.search(rf"\bconst\b[^;=]*\b{name}\b", text) for text in texts):
            listed = ", ".join(sorted(declared)) or "none"
            raise ValueError(f"--const: there is no constant {name}; {path} has {listed}.")
    return program, program_definitions(program, rest)
