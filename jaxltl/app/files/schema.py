"""Schemas of TOML files, and errors that name the file, table, key, value and fix.

A table is a :class:`TomlTable`, whose keys are declared by :func:`key`: a type with a title that
states the requirement on values, one line of help and, where the type has none, an example in TOML.
A key whose type includes ``None`` may be left out; its help ends in "; default" and what holds then.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import hashlib
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    Self,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import attrs

from jaxltl.core.validation import errors_in

_Table = TypeVar("_Table", bound="TomlTable")
LARGEST_INT = 2**31 - 1  # int32 of compiled loops


class Meta(NamedTuple):
    """Requirement on a value beyond its type: in words, as a predicate, and an example in TOML."""

    title: str
    holds: Callable[[Any], bool] = lambda value: True
    example: str = ""  # default the one in the title, after "such as"


def _in(low: float, high: float = math.inf) -> Callable[[Any], bool]:
    return lambda value: low <= value <= high


Count = Annotated[
    int, Meta(f"a whole number of at least 1 and at most {LARGEST_INT}", _in(1, LARGEST_INT), "100")
]
WholeNumber = Annotated[int, Meta("a whole number of at least 0", _in(0, LARGEST_INT), "5")]
Number = Annotated[float, Meta("a finite number", example="1.5")]
NonNegative = Annotated[float, Meta("a finite number of at least 0", _in(0), "0.01")]
Positive = Annotated[float, Meta("a positive number", lambda v: v > 0, "60")]
Unit = Annotated[float, Meta("a finite number in [0, 1]", _in(0, 1), "0.1")]
Discount = Annotated[float, Meta("a finite number in [0, 1)", lambda v: 0 <= v < 1, "0.95")]
Confidence = Annotated[float, Meta("a number between 0 and 1, such as 0.95", lambda v: 0 < v < 1)]
LeastProbability = Annotated[float, Meta("a number above 0 and at most 1", lambda v: 0 < v <= 1)]
Text = Annotated[str, Meta("a text", lambda v: bool(v.strip()))]
Name = Annotated[
    str,
    Meta(
        "a plain name of letters, digits, spaces, -, _ and ., that begins with neither a dot nor "
        "a space",
        lambda v: re.fullmatch(r"[\w-][\w .-]*", v) is not None,
    ),
]
Propositions = Annotated[list[str], Meta('a list of propositions, such as ["r"]')]
StateNames = Annotated[list[str], Meta("a list of names of states", bool, '["pit"]')]
Widths = Annotated[list[Count], Meta("a list of the widths of the hidden layers, such as [64, 64]")]
Map = Annotated[
    Text | dict[str, str],
    Meta(
        'the rows as a text, or { file = "map.txt" }',
        lambda v: isinstance(v, str) or v.keys() == {"file"},
        '{ file = "map.txt" }',
    ),
]
Legend = Annotated[
    dict[str, list[str]],
    Meta('a table of cells and their propositions, such as { w = [], r = ["r"] }'),
]


def key_name(field: attrs.Attribute[Any]) -> str:
    """The key of a field in a file; that of a Python keyword ends in an underscore in Python."""
    return field.name.rstrip("_")


def key(text: str = "", example: str = "", **default: Any) -> Any:
    """A key of a table with its help, an example in TOML, and `default` or `factory`."""
    return attrs.field(metadata={"texts": (text, example)}, **default)


def _fields(schema: Any) -> tuple[attrs.Attribute[Any], ...]:
    """The keys of a table."""
    return tuple(field for field in attrs.fields(schema) if "texts" in field.metadata)


def is_required(field: attrs.Attribute[Any]) -> bool:
    """True if a file must have a key: one without default, or a table with a required key."""
    part = _table_of(field.type)
    missing = field.default is attrs.NOTHING
    return missing and (part is None or any(map(is_required, _fields(part))))


def _resolve(kind: type, fields: list[attrs.Attribute[Any]]) -> list[attrs.Attribute[Any]]:
    """Evaluates annotations, which are strings until then; None is a default of its types."""
    hints, resolved = get_type_hints(kind, include_extras=True), []
    for field in fields:
        hint = hints.get(field.name, field.type)
        default = field.default
        if default is attrs.NOTHING and get_origin(hint) in (Union, UnionType):
            default = None if type(None) in get_args(hint) else default
        resolved.append(field.evolve(type=hint, default=default))
    return resolved


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(key,))
def table(kind: type[Any]) -> Any:
    """Class decorator of a :class:`TomlTable`: a frozen attrs class with keyword arguments."""
    return attrs.frozen(kw_only=True, slots=False, field_transformer=_resolve)(kind)


@table
class TomlTable:
    """A table of a file; ``__attrs_post_init__`` checks what concerns several of its keys."""

    def specified(self) -> dict[str, Any]:
        """The keys that have a value."""
        pairs = ((key_name(x), getattr(self, x.name)) for x in _fields(type(self)))
        return {name: value for name, value in pairs if value is not None}

    def require(self, holds: bool, error: str) -> None:
        """Raises ValueError with a text unless a requirement on several keys holds."""
        if not holds:
            raise ValueError(error)

    def refuse(self, keys: Iterable[str], owner: str) -> None:
        """Raises ValueError for the first of some keys that has a value."""
        values = self.specified()
        wrong = next((key for key in keys if key in values), None)
        self.require(wrong is None, f"{wrong} belongs to {owner}.")

    def require_one(self, keys: Iterable[str], expected: str) -> None:
        """Raises ValueError unless exactly one of some keys has a value."""
        number = len(self.specified().keys() & set(keys))
        self.require(number == 1, f"must have either {expected}.")


@table
class File(TomlTable):
    """A checked file; a field that is a :class:`TomlTable` is a table, others are keys."""

    KIND: ClassVar[str] = "the task file"  # begins the error if it cannot be read
    path: Path = Path()
    raw: bytes = b""  # its content
    name: Name = key(
        "Name of the results' folder; default the file's own name.", '"two goals"', default=None
    )

    @classmethod
    def read(cls, path: str | Path, raw: bytes | None = None) -> Self:
        """Checked content of a file, or of `raw`; ValueError names the key and the fix."""
        path = Path(path)
        data, content = read_toml(path, cls.KIND, raw)
        file = convert(path, cls, data, raw=content)
        if raw is None:
            _ = file.digest  # raises errors of the files that it names
        return file

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of the file and of the files that it names, in its directory."""
        sha256 = hashlib.sha256(self.raw)
        for name in self.named_files():
            sha256.update(read_bytes(self.path.parent / name, f"{self.path} names a file that"))
        return sha256.hexdigest()

    def named_files(self) -> Sequence[str]:
        return ()


# --- reading --------------------------------------------------------------------------------


def read_toml(path: Path, kind: str, raw: bytes | None = None) -> tuple[dict[str, Any], bytes]:
    """The tables of a TOML file, and its bytes, which are read unless `raw` has them."""
    raw = read_bytes(path, kind) if raw is None else raw
    try:
        return tomllib.loads(raw.decode()), raw
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: this is not TOML: {error}") from None


def read_bytes(path: Path, kind: str) -> bytes:
    """The bytes of a file; an error begins with its kind."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{kind} cannot be read: {str(path)!r}: {error.strerror}.") from None


def read_map(path: Path, entry: str | Mapping[str, str]) -> str:
    """The text of a map in a task file, or in the file that it names."""
    if isinstance(entry, str):
        return entry
    return read_bytes(path.parent / entry["file"], "the map").decode()


# --- conversion -----------------------------------------------------------------------------


def convert(
    path: Path, schema: type[_Table], data: Mapping[str, Any], name: str = "", raw: bytes = b""
) -> _Table:
    """Table of a file as an instance of its schema; ValueError for invalid or missing keys."""
    where = f"{path}: [{name}]" if name else f"{path}:"
    fields = {key_name(field): field for field in _fields(schema)}
    for key in data:
        if key not in fields:
            guess = difflib.get_close_matches(key, fields, n=1, cutoff=0.5)
            hint = f"; did you mean {guess[0]!r}? " if guess else ". "
            raise ValueError(f"{where} has no key {key!r}{hint}Its keys are {', '.join(fields)}.")
    values = {}
    for key, value in data.items():
        kind = fields[key].type
        try:
            values[fields[key].name] = _converted(value, kind)
        except TypeError:
            raise ValueError(
                f"{where} {key} = {value!r}; it must be {requirement(kind)}."
            ) from None
    for key, field in fields.items():
        if is_required(field) and key not in data:
            missing = f"{key}, {requirement(field.type)}" if name else f"the table [{key}]"
            raise ValueError(f"{where} lacks {missing}.")
    for key, field in fields.items():
        part = _table_of(field.type)
        if part and (key in data or field.default is attrs.NOTHING):
            values[field.name] = convert(path, part, data.get(key, {}), key)
    if issubclass(schema, File):
        values |= {"path": path, "raw": raw, "name": values.get("name") or path.stem}
    with errors_in(f"{where} "):
        return schema(**values)


def _converted(value: Any, kind: Any) -> Any:
    """A value in the type of its key; a table's own keys are converted later."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        converted = _converted(value, parts[0])
        if all(x.holds(converted) for x in parts[1:] if isinstance(x, Meta)):
            return converted
    elif origin in (Union, UnionType):
        for part in parts:
            with contextlib.suppress(TypeError):
                return _converted(value, part)
    elif origin is Literal:
        if isinstance(value, str) and value in parts:
            return value
    elif origin is list and isinstance(value, list):
        return [_converted(x, parts[0]) for x in value]
    elif origin is tuple and isinstance(value, list) and len(value) == len(parts):
        return tuple(_converted(x, part) for x, part in zip(value, parts, strict=True))
    elif origin is dict and isinstance(value, dict):
        return {_converted(k, parts[0]): _converted(v, parts[1]) for k, v in value.items()}
    elif kind is float and type(value) in (int, float):
        with contextlib.suppress(OverflowError):  # integers of TOML are unbounded
            if math.isfinite(value):
                return float(value)
    elif kind is Any or type(value) is kind or (_table_of(kind) and isinstance(value, dict)):
        return value
    raise TypeError


def _parts(kind: object) -> Iterator[Any]:
    """A type and its arguments, outermost first."""
    yield kind
    for part in get_args(kind) if get_origin(kind) is not Literal else ():
        yield from _parts(part)


def _table_of(kind: object) -> type[TomlTable] | None:
    tables = (x for x in _parts(kind) if isinstance(x, type) and issubclass(x, TomlTable))
    return next(tables, None)


def requirement(kind: object) -> str:
    """Requirement on values of a type, as text.

    Example:
      >>> requirement(Discount | None), requirement(Literal["a", "b"]), requirement(bool)
      ('a finite number in [0, 1)', '"a" or "b"', 'true or false')
    """
    names = {bool: "true or false", str: "a text", dict: "a table"}
    if _table_of(kind):
        return "a table"
    for part in _parts(kind):
        if get_origin(part) is Annotated:
            title = next((x.title for x in part.__metadata__ if isinstance(x, Meta)), None)
            if title is not None:
                return title
        if get_origin(part) is Literal:
            return " or ".join(f'"{option}"' for option in get_args(part))
        if part in names or get_origin(part) in names:
            return names[part if part in names else get_origin(part)]
    return "left out"
