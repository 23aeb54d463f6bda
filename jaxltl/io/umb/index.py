"""Index of a UMB archive: counts, types and expected member sizes."""

from __future__ import annotations

import json
import re
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
    data = _table(data, "the index", place)
    if (version := _count(data, "format-version", place)) != 1:
        raise ValueError(f"{place}format-version is {version}; version 1 is read.")
    system = _table(_get(data, "transition-system", place), "transition-system", place)
    counts = {
        name: _count(system, f"#{name}", place)
        for name in ("players", "states", "choices", "branches", "choice-actions", "observations")
    }
    names = system.get("player-names", [])
    if not isinstance(names, list) or not all(isinstance(x, str) for x in names):
        raise ValueError(f"{place}player-names is {_shown(names)}; expected a list of texts.")
    _check_kind(system, counts, place)
    probability = None
    if "branch-probability-type" in system:
        probability = _type(system["branch-probability-type"], "branch-probability-type", place)
        _check_number(probability, "branch-probability-type", place)
    annotations = _annotations(data.get("annotations", {}), place)
    for one in annotations:
        if one.type.name not in ("bool", "int", "uint"):
            _check_number(one.type, f"the annotation {one.name!r}", place)
    return Index(
        counts["players"],
        counts["states"],
        counts["choices"],
        counts["branches"],
        counts["choice-actions"],
        probability,
        annotations,
        *_records(data.get("valuations", {}), _texts_of_ours(data), place),
        tuple(names),
    )


def _check_kind(system: Mapping[str, object], counts: Mapping[str, int], place: str) -> None:
    time = _get(system, "time", place)
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
    for name in ("states", "choices"):
        if counts[name] > _MOST_STATES:
            raise ValueError(f"{place}#{name} is {counts[name]}; at most {_MOST_STATES} are read.")
    if counts["choice-actions"] > _MOST_STATES:
        raise ValueError(
            f"{place}#choice-actions is {counts['choice-actions']}; at most "
            f"{_MOST_STATES} are read."
        )
    if counts["branches"] >= 2**60:
        raise ValueError(f"{place}#branches is {counts['branches']}; expected less than 2^60.")


def _annotations(data: object, place: str) -> tuple[Annotation, ...]:
    """Labels, rewards and annotations specific to jaxltl; other groups are ignored."""
    annotations: list[Annotation] = []
    for group in ("aps", OTHER_LABELS, "rewards", INITIAL):
        table = _table(
            _table(data, "annotations", place).get(group, {}), f"the group {group}", place
        )
        annotations += [_annotation(group, key, value, place) for key, value in table.items()]
    seen: set[tuple[bool, str]] = set()
    for one in annotations:
        if one.group == INITIAL:
            continue
        key = (one.group == "rewards", one.name)
        if key in seen:
            raise ValueError(
                f"{place}two annotations are named {one.name!r}; expected distinct names."
            )
        seen.add(key)
    return tuple(annotations)


def _annotation(group: str, key: str, value: object, place: str) -> Annotation:
    path = f"annotations/{group}/{key}"
    if not re.fullmatch(r"[0-9a-z_-]{1,100}", key):
        raise ValueError(
            f"{place}{_shown(path)}: expected an id of 0-9, a-z, _ and -, at most 100 of them."
        )
    value = _table(value, path, place)
    name = value.get("alias", key)
    if not isinstance(name, str):
        raise ValueError(f"{place}{path}: alias is {_shown(name)}; expected a text.")
    applies = _get(value, "applies-to", f"{place}{path}: ")
    parts = ["states"] if group != "rewards" else list(PARTS)
    if (
        not isinstance(applies, list)
        or not applies
        or any(x not in parts for x in applies)
        or len(set(applies)) < len(applies)
    ):
        raise ValueError(
            f"{place}{path}: applies-to is {_shown(applies)}; expected a list of "
            f"{', '.join(parts)}."
        )
    if "probability-type" in value:
        raise ValueError(f"{place}{path}: random values are not supported; expected numbers.")
    kind = _type(_get(value, "type", f"{place}{path}: "), path, place)
    numbers = ("double", "rational", "int", "uint", "double-interval", "rational-interval")
    types = {"rewards": numbers, INITIAL: ("double",)}.get(group, ("bool",))
    longer = kind.name.startswith("rational")  # than usual, it may be
    if kind.name not in types or (not longer and kind.size != _SIZES[kind.name]):
        raise ValueError(
            f"{place}{path}: its type is {kind.name} of {kind.size} bits; expected "
            f"{' or '.join(types)} of the usual size."
        )
    return Annotation(group, key, name, tuple(applies), kind)


def _texts_of_ours(data: object) -> frozenset[str]:
    """Integer variables that jaxltl uses as string indices; Storm refuses the type string."""
    for key in ("file-data", "parameters", TEXTS):
        data = data.get(key, {}) if isinstance(data, dict) else {}
    names = data if isinstance(data, list) else []
    return frozenset(name for name in names if isinstance(name, str))


def _records(
    data: object, texts_of_ours: frozenset[str], place: str
) -> tuple[tuple[Record, ...], int]:
    """Record layouts of the classes of states, and the number of strings."""
    valuations = _table(data, "valuations", place)
    if "states" not in valuations:
        return (), 0
    states = _table(valuations["states"], VALUATIONS, place)
    classes = _get(states, "classes", f"{place}{VALUATIONS}: ")
    if not isinstance(classes, list) or not classes:
        raise ValueError(f"{place}{VALUATIONS}: classes is {_shown(classes)}; expected a list.")
    texts = _count(states, "#strings", f"{place}{VALUATIONS}: ") if "#strings" in states else 0
    if texts > _MOST_STATES:
        raise ValueError(
            f"{place}{VALUATIONS}: #strings is {texts}; at most {_MOST_STATES} are read."
        )
    return tuple(_record(one, texts_of_ours, f"{place}{VALUATIONS}: ") for one in classes), texts


def _record(data: object, texts_of_ours: frozenset[str], place: str) -> Record:
    variables = _get(_table(data, "a class", place), "variables", place)
    if not isinstance(variables, list):
        raise ValueError(f"{place}variables is {_shown(variables)}; expected a list.")
    variable_of_name: dict[str, Variable] = {}
    start = 0
    for one in variables:
        one = _table(one, "a variable", place)
        if "padding" in one:
            start += _count(one, "padding", place)
        else:
            name = _get(one, "name", place)
            if not isinstance(name, str) or name in variable_of_name:
                raise ValueError(
                    f"{place}a variable is named {_shown(name)}; expected distinct texts."
                )
            kind = _type(_get(one, "type", place), f"the variable {name!r}", place)
            offset, optional = one.get("offset", 0), one.get("is-optional", False)
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
            is_text = kind.name == "uint" and name in texts_of_ours
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


def _type(data: object, subject: str, place: str) -> Type:
    data = _table(data, f"the type of {subject}", place)
    name = _get(data, "type", f"{place}{subject}: ")
    if not isinstance(name, str) or name not in _SIZES:
        raise ValueError(
            f"{place}{subject}: the type is {_shown(name)}; expected one of {', '.join(_SIZES)}."
        )
    size = _count(data, "size", f"{place}{subject}: ") if "size" in data else _SIZES[name]
    if not 0 < size < 2**32 or (
        name in ("double", "double-interval", "string") and size != _SIZES[name]
    ):
        raise ValueError(f"{place}{subject}: a {name} of {size} bits; expected {_SIZES[name]}.")
    if name == "rational" and size % 2:
        raise ValueError(f"{place}{subject}: a rational of {size} bits; expected an even number.")
    return Type(name, size)


def _check_number(kind: Type, subject: str, place: str) -> None:
    """Raises ValueError unless the type is numeric, with a size in whole words."""
    types = ("double", "rational", "double-interval", "rational-interval")
    if kind.name not in types or kind.size % _SIZES[kind.name]:
        raise ValueError(
            f"{place}{subject} is {kind.name} of {kind.size} bits; expected double of 64, rational of "
            "a multiple of 128, double-interval of 128 or rational-interval of a multiple of 256."
        )


def _table(data: object, subject: str, place: str) -> Mapping[str, object]:
    if not isinstance(data, dict):
        raise ValueError(f"{place}{subject} is {_shown(data)}; expected an object.")
    return data


def _get(data: Mapping[str, object], key: str, place: str) -> object:
    if key not in data:
        raise ValueError(f"{place}{key!r} is missing.")
    return data[key]


def _count(data: Mapping[str, object], key: str, place: str) -> int:
    value = _get(data, key, place)
    if type(value) is not int or not 0 <= value < 2**64:
        raise ValueError(
            f"{place}{key} is {_shown(value)}; expected a whole number from 0 to 2^64 - 1."
        )
    return value


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
