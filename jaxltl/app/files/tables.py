"""Tables of TOML files: reading one, and checking its keys against rules."""

from __future__ import annotations

import contextlib
import difflib
import hashlib
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple


class Rule(NamedTuple):
    """What a key's value must be, as a test and in words."""

    holds: Callable[[Any], bool]
    wanted: str


def is_number(value: Any) -> bool:
    """Whether a value is a finite number that a float can hold."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # TOML's whole numbers may have any number of digits
        return False


def number_in(low: float, high: float = math.inf, *, below: bool = False) -> Rule:
    """A finite number in ``[low, high]``, or below `high`."""

    def holds(value: Any) -> bool:
        return is_number(value) and low <= value <= high and not (below and value == high)

    if high == math.inf:
        return Rule(holds, f"a finite number of at least {low:g}")
    return Rule(holds, f"a finite number in [{low:g}, {high:g}{')' if below else ']'}")


def choice(*options: str) -> Rule:
    """One of some texts."""
    return Rule(lambda value: value in options, " or ".join(f'"{o}"' for o in options))


def is_list(value: Any, kind: type | tuple[type, ...]) -> bool:
    """Whether a value is a list of one kind of things; a truth value is no number."""
    return isinstance(value, list) and all(
        isinstance(x, kind) and not isinstance(x, bool) for x in value
    )


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= MOST


TEXT = Rule(lambda v: isinstance(v, str) and bool(v.strip()), "a text")
# Results go into a folder of this name.
NAME = Rule(
    lambda v: isinstance(v, str) and re.fullmatch(r"[\w-][\w .-]*", v) is not None,
    "a plain name of letters, digits, spaces, -, _ and ., that begins with neither a dot nor a "
    "space",
)
MOST = 2**31 - 1  # that a compiled program counts to
COUNT = Rule(_is_count, f"a whole number of at least 1 and at most {MOST}")
NUMBER = Rule(is_number, "a finite number")
TRUTH = Rule(lambda v: isinstance(v, bool), "true or false")
TABLE = Rule(lambda v: isinstance(v, dict), "a table")
NAMES = Rule(lambda v: is_list(v, str), 'a list of propositions, such as ["r"]')
MAP = Rule(
    lambda v: (
        isinstance(v, str)
        or (isinstance(v, dict) and set(v) == {"file"} and isinstance(v["file"], str))
    ),
    'the rows as a text, or { file = "map.txt" }',
)
LEGEND = Rule(
    lambda v: isinstance(v, dict) and all(is_list(x, str) for x in v.values()),
    'a table of cells and their propositions, such as { w = [], r = ["r"] }',
)


@contextlib.contextmanager
def errors_in(place: str) -> Iterator[None]:
    """Errors meant for people begin with the place that they come from."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{place}{error}") from None


def read_tables(
    path: Path,
    what: str,
    known: Mapping[str, Mapping[str, Rule]],
    required: Mapping[str, Sequence[str]],
    raw: bytes | None = None,
) -> tuple[dict[str, Any], bytes]:
    """The tables of a TOML file, all of known keys whose values obey their rules, and its bytes.

    Args:
      path: the file; `what` it is begins an error.
      known: keys and rules by table; a file may have a plain ``name`` beside its tables.
      required: keys that a table must have; by the empty name, the tables.
      raw: the file's bytes, if they are known already.

    Raises:
      ValueError: the file is missing or malformed, or a key is unknown, missing or wrong.
    """
    data, raw = read_toml(path, what, raw)
    check_table(path, "", data, {"name": NAME, **dict.fromkeys(known, TABLE)}, required[""])
    for table in known:
        if table in data:
            check_table(path, table, data[table], known[table], required.get(table, ()))
    return data, raw


def read_toml(path: Path, what: str, raw: bytes | None = None) -> tuple[dict[str, Any], bytes]:
    """The tables of a TOML file, and its bytes, which are read unless they are given.

    Raises:
      ValueError: the file cannot be read or is malformed.
    """
    raw = read_bytes(path, what) if raw is None else raw
    try:
        return tomllib.loads(raw.decode()), raw
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: this is not TOML: {error}") from None


def read_bytes(path: Path, what: str) -> bytes:
    """A file's bytes; `what` it is begins the error."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{what} cannot be read: {str(path)!r}: {error.strerror}.") from None


def digest(path: Path, raw: bytes, names: Iterable[str]) -> str:
    """A fingerprint of a file's bytes and of the files beside it that it names."""
    found = hashlib.sha256(raw)
    for name in names:
        found.update(read_bytes(path.parent / name, f"{path} names a file that"))
    return found.hexdigest()


def read_map(path: Path, given: str | Mapping[str, str]) -> str:
    """The text of a map that a file gives, or whose file it names."""
    if isinstance(given, str):
        return given
    return read_bytes(path.parent / given["file"], "the map").decode()


def off_map(shape: Sequence[int]) -> str:
    """What is said of a cell that is not on a map."""
    return f"off the map, which has rows 1 to {shape[0]} and columns 1 to {shape[1]}."


def require_one(
    path: Path, table: str, data: Mapping[str, Any], keys: Iterable[str], wanted: str
) -> None:
    """Raises a ValueError unless a table has exactly one of some keys."""
    reject(path, table, [(sum(key in data for key in keys) != 1, f"must have either {wanted}")])


def refuse(path: Path, table: str, data: Iterable[str], keys: Iterable[str], belong: str) -> None:
    """Raises a ValueError for the first key of a table that belongs elsewhere."""
    reject(path, table, [(key in data, f"{key} belongs to {belong}") for key in keys])


def reject(path: Path, table: str, faults: Iterable[tuple[bool, str]]) -> None:
    """Raises a ValueError for the first fault of a table that there is, with what is told of it."""
    for there, told in faults:
        if there:
            raise ValueError(f"{path}: [{table}] {told}.")


def check_source(
    path: Path,
    table: str,
    data: Mapping[str, Any],
    of_map: Iterable[str],
    of_log: Iterable[str] | None = None,
) -> None:
    """Raises a ValueError unless there is a map, a model, or a log where one is taken.

    Keys of a map do not fit a model, and those of a log fit nothing else.
    """
    sources, wanted = ["map", "model"], "a map or a model (a file)"
    if of_log is not None:
        sources.append("transitions")
        wanted = "a map, a model (a file) or transitions (a log)"
    require_one(path, table, data, sources, wanted)
    if "model" in data:
        refuse(path, table, data, of_map, "a map; a model has it in its arrays")
    if "transitions" in data:
        refuse(path, table, data, of_map, "a map; of a log, labels name states in a file")
    else:
        refuse(path, table, data, of_log or (), "transitions, a log")


def check_demonstrations(
    path: Path, shown: Mapping[str, Any], file: str, wanted: str, of_synthetic: Iterable[str]
) -> None:
    """Raises a ValueError unless there are files or runs to be made."""
    table = "demonstrations"
    require_one(path, table, shown, (file, "synthetic"), f"{wanted} or synthetic = N")
    if file in shown:
        refuse(path, table, shown, of_synthetic, "synthetic = N")


def check_table(
    path: Path,
    table: str,
    data: Mapping[str, Any],
    known: Mapping[str, Rule],
    required: Sequence[str] = (),
) -> None:
    """Raises a ValueError for the first key of a table that is unknown, wrong or missing.

    Args:
      path: the file.
      table: the table's name; empty for the whole file.
      data: its keys and values.
      known: its keys and their rules.
      required: the keys that it must have.
    """
    where = f"{path}: [{table}]" if table else f"{path}:"
    for key, value in data.items():
        if key not in known:
            guess = difflib.get_close_matches(key, known, n=1, cutoff=0.5)
            raise ValueError(
                f"{where} has no key {key!r}"
                + (f"; did you mean {guess[0]!r}? " if guess else ". ")
                + f"Its keys are {', '.join(known)}."
            )
        if not known[key].holds(value):
            raise ValueError(f"{where} {key} = {value!r}; it must be {known[key].wanted}.")
    for key in required:
        if key not in data:
            kind = f"the table [{key}]" if not table else f"{key}, {known[key].wanted}"
            raise ValueError(f"{where} lacks {kind}.")
