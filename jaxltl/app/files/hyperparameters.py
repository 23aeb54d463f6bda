"""Tables of hyperparameters of task files, derived from the declarations of learners.

The declarations are read from the source of a learner's ``Hparams``, so that a mistake in a file is
reported before JAX is imported.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import attrs

import jaxltl
from jaxltl.app.files.schema import LARGEST_INT, Meta, TomlTable, Widths
from jaxltl.core.validation import RANGES, Range

_ROOT = Path(jaxltl.__file__).parent
_NAMES = {  # of the expressions in declarations
    "Range": Range,
    "COUNT": Range(1, LARGEST_INT, integer=True),
    "MAX_INT": LARGEST_INT,
    "bool": bool,
}


class Hyperparameter(NamedTuple):
    """A field of a learner's ``Hparams``.

    >>> [x.name for x in declarations("mlirl")][:3]
    ['discount', 'mu', 'l2']
    """

    name: str
    values: Range | tuple[str, ...] | type[bool]
    default: object
    may_be_schedule: bool
    is_tuple: bool


def declarations(learner: str) -> Iterator[Hyperparameter]:
    """The hyperparameters of a learner that have a declared range or set of values."""
    place = _ROOT.joinpath("algos", *learner.split("."))
    files = sorted(place.glob("*.py"), key=lambda x: x.stem != "learner")
    files = files or [place.with_suffix(".py")]
    for file in files:
        tree = ast.parse(file.read_text())
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and node.name == "Hparams":
                names = _constants(tree) | _NAMES | {"traced": _traced, "static": _static}
                yield from filter(None, (_declaration(x, names) for x in node.body))
                return


def _declaration(node: ast.stmt, names: dict[str, object]) -> Hyperparameter | None:
    if not (
        isinstance(node, ast.AnnAssign)
        and isinstance(node.target, ast.Name)
        and isinstance(node.value, ast.Call)
        and getattr(node.value.func, "id", "") in ("traced", "static")
    ):
        return None
    code = compile(ast.Expression(node.value), "Hparams", "eval")
    values, default, schedule = eval(code, {"__builtins__": {}}, dict(names))  # of our own source
    return Hyperparameter(
        node.target.id, values, default, schedule, "tuple" in ast.unparse(node.annotation)
    )


def _traced(
    values: Range | str, *, default: object = None, schedule: bool = False
) -> tuple[object, object, bool]:
    return RANGES[values] if isinstance(values, str) else values, default, schedule


def _static(values: object, *, default: object) -> tuple[object, object, bool]:
    return values, default, False


def _constants(tree: ast.Module) -> dict[str, object]:
    """Constants of a module, and names of the modules that it imports, of which constants are read."""
    constants: dict[str, object] = {}
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            try:
                constants[node.targets[0].id] = ast.literal_eval(node.value)
            except ValueError:
                continue
        elif isinstance(node, ast.ImportFrom) and str(node.module).startswith("jaxltl.algos"):
            for alias in node.names:
                constants[alias.asname or alias.name] = _SourceModule(f"{node.module}.{alias.name}")
    return constants


class _SourceModule:
    """A module whose constants are read from its source."""

    def __init__(self, name: str) -> None:
        self.file = _ROOT.parent.joinpath(*name.split(".")).with_suffix(".py")

    def __getattr__(self, name: str) -> object:
        constants = _constants(ast.parse(self.file.read_text()))
        # Those that are computed are checked by the learner.
        return constants.get(name, ())


def hparams_table(learner: str, *omit: str, base: type[TomlTable] = TomlTable) -> Any:
    """A base class of a table with a learner's hyperparameters, documented and defaulted there."""
    fields = {}
    for one in declarations(learner):
        if one.name not in omit:
            fields[one.name] = attrs.field(
                default=None, type=_type_of(one) | None, metadata={"texts": ("", "")}
            )
    return attrs.make_class(
        f"{base.__name__}Of{learner}", fields, bases=(base,), frozen=True, kw_only=True, slots=False
    )


def _type_of(declared: Hyperparameter) -> Any:
    """The type of a hyperparameter in a file, from its declared values."""
    values, first = declared.values, declared.default
    if values is bool:
        return bool
    if isinstance(values, tuple):
        return Literal[values]
    assert isinstance(values, Range)
    if values.integer:
        whole = Annotated[
            int, Meta(str(values), values.contains, "16" if first is None else str(first))
        ]
        return Widths if declared.is_tuple else whole
    example = "0.05" if first is None else str(first)
    number = Annotated[float, Meta(f"a number, {values}", values.contains, example)]
    if not declared.may_be_schedule:
        return number
    title = f"a number, {values}; or [first, last], linear over all steps"
    return Annotated[number | tuple[number, number], Meta(title, example=f"[{example}, 0]")]
