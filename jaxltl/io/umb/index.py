"""Index of a UMB archive: counts, types and expected member sizes."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

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
PARTS = {"states": "state", "choices": "choice", "branches": "transition"}  # as Rewards names them
# Groups specific to jaxltl. A label reserved by other tools has its position as its id.
OTHER_LABELS = "other-aps"
INITIAL = "initial"  # an initial distribution that is not uniform
TEXTS = "texts"  # our parameter: names of the variables that are string indices
ACTIONS, VALUATIONS = "actions/choices", "valuations/states"  # folders
_MOST_STATES = 2**31 - 2  # states and choices are numbered with 32 bits
_MOST_STRING = 2**10  # average bytes of a string
_STRINGS_ALLOWED = 2**20
_MOST_RECORD = 2**16  # bytes of one state's valuation


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
class Variable:
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

    variables: tuple[Variable, ...]
    size: int


@dataclass(frozen=True)
class Items:
    """Layout of a member."""

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
    records: tuple[Record, ...]
    texts: int  # number of strings of the variables
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
        """Layout of each member with elements per state, choice or branch."""
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
        if self.records:
            widths = [record.size for record in self.records]
            largest = self.states * max(widths)
            bounds[f"{VALUATIONS}/valuations.bin"] = (self.states * min(widths), largest)
            bounds[f"{VALUATIONS}/valuation-to-class.bin"] = (4 * self.states, 4 * self.states)
        for folder, count in ((ACTIONS, self.actions), (VALUATIONS, self.texts)):
            if count:
                bounds[f"{folder}/string-mapping.bin"] = (8 * (count + 1), 8 * (count + 1))
                bounds[f"{folder}/strings.bin"] = (0, _STRINGS_ALLOWED + _MOST_STRING * count)
        return bounds


def bit_bytes(count: int) -> int:
    """Bytes of a bit vector, padded to 64-bit words."""
    return -(-count // 64) * 8


def parse_index(content: bytes, place: str) -> Index:
    """Parses and validates the index; errors start with `place`."""
    try:
        data = json.loads(content.decode())
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{place}this is not JSON: {error}.") from None
    index = _Table(data, "the index", place)
    if (version := index.count("format-version")) != 1:
        raise ValueError(f"{place}format-version is {version}; version 1 is read.")
    system = index.table("transition-system")
    kinds = ("players", "states", "choices", "branches", "choice-actions", "observations")
    counts = {name: system.count(f"#{name}") for name in kinds}
    names = system.data.get("player-names", [])
    if not isinstance(names, list) or not all(isinstance(x, str) for x in names):
        raise ValueError(f"{place}player-names is {_shown(names)}; expected a list of texts.")
    _check_kind(system, counts)
    probability = None
    if "branch-probability-type" in system.data:
        probability = system.type("branch-probability-type", "branch-probability-type", place)
        _check_number(probability, "branch-probability-type", place)
    annotations = _annotations(index)
    for one in annotations:
        if one.type.name not in ("bool", "int", "uint"):
            _check_number(one.type, f"the annotation {one.name!r}", place)
    players, states, choices, branches, actions, _ = counts.values()
    return Index(
        players,
        states,
        choices,
        branches,
        actions,
        probability,
        annotations,
        *_records(index),
        tuple(names),
    )


class _Table:
    """An object of the index, with the place that errors name."""

    def __init__(self, data: object, subject: str, place: str) -> None:
        if not isinstance(data, dict):
            raise ValueError(f"{place}{subject} is {_shown(data)}; expected an object.")
        self.data: Mapping[str, object] = data
        self.place = place

    def get(self, key: str) -> object:
        if key not in self.data:
            raise ValueError(f"{self.place}{key!r} is missing.")
        return self.data[key]

    def table(self, key: str, subject: str = "", default: object = None) -> _Table:
        """A table in this one, required unless it has a default."""
        data = self.get(key) if default is None else self.data.get(key, default)
        return _Table(data, subject or key, self.place)

    def within(self, subject: str) -> _Table:
        """The same table, with a subject in its place."""
        return _Table(self.data, subject, f"{self.place}{subject}: ")

    def count(self, key: str) -> int:
        value = self.get(key)
        if type(value) is not int or not 0 <= value < 2**64:
            raise ValueError(
                f"{self.place}{key} is {_shown(value)}; expected a whole number from 0 to 2^64 - 1."
            )
        return value

    def type(self, key: str, subject: str, place: str) -> Type:
        """The type of values of a subject."""
        data = _Table(self.get(key), f"the type of {subject}", place).within(subject)
        name, place = data.get("type"), data.place
        if not isinstance(name, str) or name not in _SIZES:
            raise ValueError(
                f"{place}the type is {_shown(name)}; expected one of {', '.join(_SIZES)}."
            )
        size = data.count("size") if "size" in data.data else _SIZES[name]
        fixed = name in ("double", "double-interval", "string")
        if not 0 < size < 2**32 or (fixed and size != _SIZES[name]):
            raise ValueError(f"{place}a {name} of {size} bits; expected {_SIZES[name]}.")
        if name == "rational" and size % 2:
            raise ValueError(f"{place}a rational of {size} bits; expected an even number.")
        return Type(name, size)


def _check_kind(system: _Table, counts: Mapping[str, int]) -> None:
    place, time = system.place, system.get("time")
    if time != "discrete":
        raise ValueError(
            f"{place}time is {_shown(time)}; expected discrete, models with rates are not supported."
        )
    if counts["observations"]:
        raise ValueError(
            f"{place}the model has {counts['observations']} observations; POMDPs are not supported."
        )
    if not counts["states"]:
        raise ValueError(f"{place}#states is 0; a model needs at least one.")
    for name in ("states", "choices", "choice-actions"):
        if counts[name] > _MOST_STATES:
            raise ValueError(f"{place}#{name} is {counts[name]}; at most {_MOST_STATES} are read.")
    if counts["branches"] >= 2**60:
        raise ValueError(f"{place}#branches is {counts['branches']}; expected less than 2^60.")


def _annotations(index: _Table) -> tuple[Annotation, ...]:
    """Labels, rewards and annotations specific to jaxltl; other groups are ignored."""
    groups = index.table("annotations", default={})
    annotations: list[Annotation] = []
    for group in ("aps", OTHER_LABELS, "rewards", INITIAL):
        table = groups.table(group, f"the group {group}", {})
        annotations += [_annotation(group, key, table) for key in table.data]
    named = [(x.group == "rewards", x.name) for x in annotations if x.group != INITIAL]
    if twice := [name for name, times in Counter(named).items() if times > 1]:
        raise ValueError(
            f"{index.place}two annotations are named {twice[0][1]!r}; expected distinct names."
        )
    return tuple(annotations)


def _annotation(group: str, key: str, table: _Table) -> Annotation:
    path = f"annotations/{group}/{key}"
    if not re.fullmatch(r"[0-9a-z_-]{1,100}", key):
        raise ValueError(
            f"{table.place}{_shown(path)}: expected an id of 0-9, a-z, _ and -, at most 100 of them."
        )
    value = table.table(key, path).within(path)
    place, name = value.place, value.data.get("alias", key)
    if not isinstance(name, str):
        raise ValueError(f"{place}alias is {_shown(name)}; expected a text.")
    applies = value.get("applies-to")
    parts = ["states"] if group != "rewards" else list(PARTS)
    if (
        not isinstance(applies, list)
        or not applies
        or any(x not in parts for x in applies)
        or len(set(applies)) < len(applies)
    ):
        raise ValueError(
            f"{place}applies-to is {_shown(applies)}; expected a list of {', '.join(parts)}."
        )
    if "probability-type" in value.data:
        raise ValueError(f"{place}random values are not supported; expected numbers.")
    kind = value.type("type", path, table.place)
    numbers = ("double", "rational", "int", "uint", "double-interval", "rational-interval")
    types = {"rewards": numbers, INITIAL: ("double",)}.get(group, ("bool",))
    longer = kind.name.startswith("rational")  # than usual, it may be
    if kind.name not in types or (not longer and kind.size != _SIZES[kind.name]):
        raise ValueError(
            f"{place}its type is {kind.name} of {kind.size} bits; expected "
            f"{' or '.join(types)} of the usual size."
        )
    return Annotation(group, key, name, tuple(applies), kind)


def _records(index: _Table) -> tuple[tuple[Record, ...], int]:
    """Record layouts of the classes of states, and the number of strings."""
    valuations = index.table("valuations", default={})
    if "states" not in valuations.data:
        return (), 0
    states = valuations.table("states", VALUATIONS).within(VALUATIONS)
    classes = states.get("classes")
    if not isinstance(classes, list) or not classes:
        raise ValueError(f"{states.place}classes is {_shown(classes)}; expected a list.")
    texts = states.count("#strings") if "#strings" in states.data else 0
    if texts > _MOST_STATES:
        raise ValueError(f"{states.place}#strings is {texts}; at most {_MOST_STATES} are read.")
    # Integer variables that jaxltl uses as string indices; Storm refuses the type string.
    ours: object = index.data
    for key in ("file-data", "parameters", TEXTS):
        ours = ours.get(key, {}) if isinstance(ours, dict) else {}
    names = [name for name in ours if isinstance(name, str)] if isinstance(ours, list) else []
    return tuple(_record(one, names, states.place) for one in classes), texts


def _record(data: object, names_of_texts: Sequence[str], place: str) -> Record:
    variables = _Table(data, "a class", place).get("variables")
    if not isinstance(variables, list):
        raise ValueError(f"{place}variables is {_shown(variables)}; expected a list.")
    variable_of_name: dict[str, Variable] = {}
    start = 0
    for each in variables:
        one = _Table(each, "a variable", place)
        if "padding" in one.data:
            start += one.count("padding")
        else:
            name = one.get("name")
            if not isinstance(name, str) or name in variable_of_name:
                raise ValueError(
                    f"{place}a variable is named {_shown(name)}; expected distinct texts."
                )
            kind = one.type("type", f"the variable {name!r}", place)
            offset, optional = one.data.get("offset", 0), one.data.get("is-optional", False)
            if type(offset) is not int or not -(2**63) <= offset < 2**63:
                raise ValueError(
                    f"{place}the offset of {name!r} is {_shown(offset)}; expected a "
                    "whole number of 64 bits."
                )
            if not isinstance(optional, bool):
                raise ValueError(
                    f"{place}is-optional of {name!r} is {_shown(optional)}; expected true or false."
                )
            presence, start = (start, start + 1) if optional else (None, start)
            is_text = kind.name == "uint" and name in names_of_texts
            variable_of_name[name] = Variable(name, kind, offset, start, presence, is_text)
            start += kind.size
        if start > 8 * _MOST_RECORD:
            raise ValueError(
                f"{place}a state's variables take more than {8 * _MOST_RECORD} bits; "
                "no more are read."
            )
    if start % 8:
        raise ValueError(
            f"{place}a state's variables take {start} bits; expected a multiple of 8, with padding."
        )
    return Record(tuple(variable_of_name.values()), start // 8)


def _check_number(kind: Type, subject: str, place: str) -> None:
    """Raises ValueError unless the type is numeric, with a size in whole words."""
    types = ("double", "rational", "double-interval", "rational-interval")
    if kind.name not in types or kind.size % _SIZES[kind.name]:
        raise ValueError(
            f"{place}{subject} is {kind.name} of {kind.size} bits; expected double of 64, rational of "
            "a multiple of 128, double-interval of 128 or rational-interval of a multiple of 256."
        )


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
