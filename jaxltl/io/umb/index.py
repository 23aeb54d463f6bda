"""Index of a UMB archive: counts, types and expected member sizes."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from jaxltl.core.validation import errors_in

_SIZES = {  # default size of each type in bits
    "bool": 1,
    "int": 64,
    "uint": 64,
    "int-interval": 128,
    "uint-interval": 128,
    "double": 64,
    "double-interval": 128,
    "rational": 128,
    "rational-interval": 256,
    "string": 64,
}
_REALS = ("double", "rational", "double-interval", "rational-interval")
PARTS = {"states": "state", "choices": "choice", "branches": "transition"}  # as Rewards names them
# Groups specific to jaxltl. A label reserved by other tools has its position as its id.
OTHER_LABELS = "other-aps"
INITIAL = "initial"  # an initial distribution that is not uniform
TEXTS = "texts"  # our parameter: names of the variables that are string indices
ACTIONS = "actions/choices"  # a folder
OBSERVATIONS = "observations/states/values.bin"
_MAX_STATES = 2**31 - 2  # states and choices are numbered with 32 bits
_MAX_STRING = 2**10  # average bytes of a string
_STRINGS_ALLOWED = 2**20
_MAX_RECORD = 2**16  # bytes of one state's valuation


@dataclass(frozen=True)
class Type:
    """A type of values with its size in bits."""

    name: str
    size: int

    @property
    def end(self) -> Type | None:
        """Type of the interval bounds; None for types other than intervals."""
        if not self.name.endswith("-interval"):
            return None
        return Type(self.name.removesuffix("-interval"), self.size // 2)


@dataclass(frozen=True)
class Annotation:
    """Annotation of states, choices or branches; `name` is the alias."""

    group: str
    id: str
    name: str
    applies_to: tuple[str, ...]
    type: Type

    def member(self, part: str) -> str:
        return f"annotations/{self.group}/{self.id}/{part}/values.bin"


@dataclass(frozen=True)
class RecordVariable:
    """A variable of a state's record."""

    name: str  # name, type: as in the file
    type: Type
    offset: int  # added to the encoded value
    start: int  # first bit in the record
    presence: int | None  # bit that is set if the value is present; None if it always is
    is_text: bool = False  # True if the value is a string index


@dataclass(frozen=True)
class Record:
    """Record layout of one class of states; `size` is in bytes."""

    variables: tuple[RecordVariable, ...]
    size: int


@dataclass(frozen=True)
class VariableLayout:
    """Variables of states or observations: a record layout for each class."""

    entity: str  # "states" or "observations"
    records: tuple[Record, ...]
    texts: int  # number of strings

    @property
    def folder(self) -> str:
        return f"valuations/{self.entity}"


@dataclass(frozen=True)
class Items:
    """VariableLayout of a member."""

    part: str  # "states", "choices" or "branches"
    bits: int  # bits per element
    more: int = 0  # additional elements

    def size(self, count: int) -> int:
        return bit_bytes(count) if self.bits == 1 else (count + self.more) * self.bits // 8

    def span(self, begin: int, end: int) -> tuple[int, int]:
        """Byte range of the elements begin..end."""
        return begin * self.bits // 8, -(-(end + self.more) * self.bits // 8)


@dataclass(frozen=True)
class Index:
    """Validated index of a model, or of a range of its states (which then starts at `begins`)."""

    players: int
    states: int
    choices: int
    branches: int
    actions: int
    probability: Type | None
    annotations: tuple[Annotation, ...]
    observations: int = 0
    layouts: tuple[VariableLayout, ...] = ()
    player_names: tuple[str, ...] = ()
    begins: tuple[int, int, int] = (0, 0, 0)

    @property
    def counts(self) -> dict[str, int]:
        return {"states": self.states, "choices": self.choices, "branches": self.branches}

    def of(self, *ranges: tuple[int, int]) -> Index:
        """Index of a range of states, with the ranges of its choices and branches."""
        first, row, entry = (begin for begin, _ in ranges)
        states, choices, branches = (end - begin for begin, end in ranges)
        return replace(
            self, states=states, choices=choices, branches=branches, begins=(first, row, entry)
        )

    def items(self) -> dict[str, Items]:
        """VariableLayout of each member with elements per state, choice or branch."""
        layouts = {
            "state-to-choices.bin": Items("states", 64, 1),
            "state-is-initial.bin": Items("states", 1),
            "choice-to-branches.bin": Items("choices", 64, 1),
            "branch-to-target.bin": Items("branches", 64),
        }
        if self.players:
            layouts["state-to-player.bin"] = Items("states", 32)
        if self.probability:
            layouts["branch-to-probability.bin"] = Items("branches", self.probability.size)
        if self.observations:
            layouts[OBSERVATIONS] = Items("states", 64)
        if self.actions:
            layouts[f"{ACTIONS}/values.bin"] = Items("choices", 32)
        for one in self.annotations:
            for part in one.applies_to:
                size = 1 if one.type.name == "bool" else one.type.size
                layouts[one.member(part)] = Items(part, size)
        return layouts

    def bounds(self) -> dict[str, tuple[int, int]]:
        """Minimal and maximal size in bytes of each known member."""
        counts = self.counts
        sizes = {name: x.size(counts[x.part]) for name, x in self.items().items()}
        bounds = {name: (size, size) for name, size in sizes.items()}
        folders = [(ACTIONS, self.actions)]
        for one in self.layouts:
            widths, size = [record.size for record in one.records], self.num_records(one)
            bounds[f"{one.folder}/valuations.bin"] = (size * min(widths), size * max(widths))
            bounds[f"{one.folder}/valuation-to-class.bin"] = (4 * size, 4 * size)
            folders.append((one.folder, one.texts))
        for folder, count in folders:
            if count:
                bounds[f"{folder}/string-mapping.bin"] = (8 * (count + 1), 8 * (count + 1))
                bounds[f"{folder}/strings.bin"] = (0, _STRINGS_ALLOWED + _MAX_STRING * count)
        return bounds

    def num_records(self, layout: VariableLayout) -> int:
        """Number of records of a layout."""
        return self.states if layout.entity == "states" else self.observations


def bit_bytes(count: int) -> int:
    """Bytes of a bit vector, padded to 64-bit words."""
    return -(-count // 64) * 8


def parse_index(content: bytes) -> Index:
    """Parses and validates the index."""
    try:
        data = json.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"this is not JSON: {error}.") from None
    index = _IndexTable(data, "the index")
    if (version := index.count("format-version")) != 1:
        raise ValueError(f"format-version is {version}; version 1 is read.")
    system = index.table("transition-system")
    kinds = ("players", "states", "choices", "branches", "choice-actions", "observations")
    counts = {name: system.count(f"#{name}") for name in kinds}
    names = system.get("player-names", "a list of texts", _are_texts, [])
    _check_kind(system, counts)
    probability = None
    if "branch-probability-type" in system.data:
        with errors_in("branch-probability-type: "):
            probability = system.type("branch-probability-type")
            _check_type(probability, _REALS)
    players, states, choices, branches, actions, observations = counts.values()
    return Index(
        players,
        states,
        choices,
        branches,
        actions,
        probability,
        _annotations(index.table("annotations", {})),
        observations,
        _layouts(index),
        tuple(names),
    )


class _IndexTable:
    """An object of the index."""

    def __init__(self, data: object, name: str) -> None:
        if not isinstance(data, dict):
            raise ValueError(f"{name} is {_shown(data)}; expected an object.")
        self.data: Mapping[str, object] = data

    def get(
        self, key: str, expected: str, valid: Callable[[Any], bool], default: object = None
    ) -> Any:
        """A value, which must be valid, or its default; None for a value that is required."""
        value = self.data.get(key, default)
        if value is None and key not in self.data:
            raise ValueError(f"{key!r} is missing.")
        if not valid(value):
            raise ValueError(f"{key} is {_shown(value)}; expected {expected}.")
        return value

    def table(self, key: str, default: object = None) -> _IndexTable:
        return _IndexTable(self.get(key, "", lambda _: True, default), key)

    def count(self, key: str, default: int | None = None, below: int = 2**64) -> int:
        expected = "a whole number from 0 to 2^64 - 1"
        value: int = self.get(key, expected, lambda x: type(x) is int and 0 <= x < 2**64, default)
        if value >= below:
            raise ValueError(f"{key} is {value}; at most {below - 1} are read.")
        return value

    def text(self, key: str, default: str | None = None) -> str:
        value: str = self.get(key, "a text", lambda x: isinstance(x, str), default)
        return value

    def type(self, key: str = "type") -> Type:
        """A type of values."""
        data = self.table(key)
        name = data.get(
            "type", f"one of {', '.join(_SIZES)}", lambda x: _are_texts([x]) and x in _SIZES
        )
        size = data.count("size", _SIZES[name])
        fixed = name in ("double", "double-interval", "string")
        if not 0 < size < 2**32 or (fixed and size != _SIZES[name]):
            raise ValueError(f"a {name} of {size} bits; expected {_SIZES[name]}.")
        if name == "rational" and size % 2:
            raise ValueError(f"a rational of {size} bits; expected an even number.")
        return Type(name, size)


def _are_texts(values: object) -> bool:
    return isinstance(values, list) and all(isinstance(x, str) for x in values)


def _check_type(kind: Type, names: Sequence[str]) -> None:
    """Raises ValueError unless a type has one of the names and whole words of the usual size."""
    usual = _SIZES[kind.name]
    fits = kind.size % usual == 0 if kind.name.startswith("rational") else kind.size == usual
    if kind.name not in names or not fits:
        raise ValueError(
            f"its type is {kind.name} of {kind.size} bits; expected {' or '.join(names)} of the "
            "usual size, or of a multiple of it for rationals."
        )


def _check_kind(system: _IndexTable, counts: Mapping[str, int]) -> None:
    system.get("time", "discrete, models with rates are not supported", lambda x: x == "discrete")
    if counts["observations"]:
        place = system.data.get("observations-apply-to", "states")
        if place != "states" or "observation-probability-type" in system.data:
            raise ValueError(
                f"the observations apply to {_shown(place)}, or are random; expected one observation for "
                "each state."
            )
        if counts["players"] != 1:
            raise ValueError(
                f"the model has observations and {counts['players']} players; expected one player."
            )
        system.count("#observations", below=_MAX_STATES + 1)
    if not counts["states"]:
        raise ValueError("#states is 0; a model needs at least one.")
    for name in ("states", "choices", "choice-actions"):
        system.count(f"#{name}", below=_MAX_STATES + 1)
    system.count("#branches", below=2**60)


def _annotations(groups: _IndexTable) -> tuple[Annotation, ...]:
    """Labels, rewards and annotations specific to jaxltl; other groups are ignored."""
    annotations: list[Annotation] = []
    for group in ("aps", OTHER_LABELS, "rewards", INITIAL):
        table = groups.table(group, {})
        annotations += [_annotation(group, key, data) for key, data in table.data.items()]
    named = [(x.group == "rewards", x.name) for x in annotations if x.group != INITIAL]
    if twice := [name for name, times in Counter(named).items() if times > 1]:
        raise ValueError(f"two annotations are named {twice[0][1]!r}; expected distinct names.")
    return tuple(annotations)


def _annotation(group: str, key: str, data: object) -> Annotation:
    path = f"annotations/{group}/{key}"
    if not re.fullmatch(r"[0-9a-z_-]{1,100}", key):
        raise ValueError(
            f"{_shown(path)}: expected an id of 0-9, a-z, _ and -, at most 100 of them."
        )
    parts = list(PARTS) if group == "rewards" else ["states"]
    types = {"rewards": (*_REALS, "int", "uint"), INITIAL: ("double",)}.get(group, ("bool",))
    with errors_in(f"{path}: "):
        table = _IndexTable(data, "it")
        name = table.text("alias", key)
        applies = table.get(
            "applies-to",
            f"a list of {', '.join(parts)}",
            lambda x: _are_texts(x) and set() < {*x} <= {*parts} and len({*x}) == len(x),
        )
        if "probability-type" in table.data:
            raise ValueError("random values are not supported; expected numbers.")
        kind = table.type()
        _check_type(kind, types)
    return Annotation(group, key, name, tuple(applies), kind)


def _layouts(index: _IndexTable) -> tuple[VariableLayout, ...]:
    """Record layouts of states and of observations."""
    valuations = index.table("valuations", {})
    # Integer variables that jaxltl uses as string indices; Storm refuses the type string.
    ours: object = index.data
    for key in ("file-data", "parameters", TEXTS):
        ours = ours.get(key, []) if isinstance(ours, dict) else []
    names, layouts = ours if isinstance(ours, list) else [], []
    for entity in ("states", "observations"):
        if entity in valuations.data:
            with errors_in(f"valuations/{entity}: "):
                table = valuations.table(entity)
                classes = table.get("classes", "a list", lambda x: isinstance(x, list) and bool(x))
                texts = table.count("#strings", 0, below=_MAX_STATES + 1)
                layouts.append(
                    VariableLayout(entity, tuple(_record(one, names) for one in classes), texts)
                )
    return tuple(layouts)


def _record(data: object, names_of_texts: Sequence[object]) -> Record:
    variables = _IndexTable(data, "a class").get(
        "variables", "a list", lambda x: isinstance(x, list)
    )
    variable_of_name: dict[str, RecordVariable] = {}
    start = 0
    for each in variables:
        one = _IndexTable(each, "a variable")
        if "padding" in one.data:
            start += one.count("padding")
        else:
            name = one.text("name")
            if name in variable_of_name:
                raise ValueError(f"a variable is named {name!r}; expected distinct texts.")
            with errors_in(f"the variable {name!r}: "):
                kind = one.type()
                offset = one.get("offset", "a whole number of 64 bits", _is_integer, 0)
                optional = one.get("is-optional", "true or false", lambda x: type(x) is bool, False)
            presence, start = (start, start + 1) if optional else (None, start)
            is_text = kind.name == "uint" and name in names_of_texts
            variable_of_name[name] = RecordVariable(name, kind, offset, start, presence, is_text)
            start += kind.size
        if start > 8 * _MAX_RECORD:
            raise ValueError(
                f"a state's variables take more than {8 * _MAX_RECORD} bits; no more are read."
            )
    if start % 8:
        raise ValueError(
            f"a state's variables take {start} bits; expected a multiple of 8, with padding."
        )
    return Record(tuple(variable_of_name.values()), start // 8)


def _is_integer(value: object) -> bool:
    return type(value) is int and -(2**63) <= value < 2**63


def _shown(value: object) -> str:
    """Abbreviated value for error messages."""
    if isinstance(value, dict):
        return "an object"
    if isinstance(value, list):
        return (
            f"a list of {len(value)}"
            if any(isinstance(x, list | dict) for x in value)
            else (f"{value[:9]!r:.60}")
        )
    if type(value) is int and abs(value) >= 10**30:
        return "a huge number"
    return f"{value!r:.60}"


# --- writing --------------------------------------------------------------------------------


def ids_for(names: Sequence[str], prefix: str) -> list[str]:
    """Distinct identifiers, equal to the names where these are valid."""
    ids: dict[str, None] = {}
    taken = set(names)
    for i, name in enumerate(names):
        one = name if re.fullmatch(r"[0-9a-z_-]{1,60}", name) else f"{prefix}{i}"
        while one in ids or (one != name and one in taken):
            one += "-"
        ids[one] = None
    return list(ids)
