"""Members of a UMB archive: labels, rewards, actions and probabilities of a range of states."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.validation import errors_in
from jaxltl.core.models.sparse import Annotations, Rewards
from jaxltl.io.umb.index import (
    ACTIONS,
    INITIAL,
    OTHER_LABELS,
    PARTS,
    Annotation,
    Index,
    parse_index,
)
from jaxltl.io.umb.tar import fill, members
from jaxltl.io.umb.values import (
    Bytes,
    read_bits,
    read_ends,
    read_numbers,
    read_points,
    read_starts,
    read_texts,
)

_LARGEST_INDEX = 2**26  # bytes
EXACT_INITIAL = f"annotations/{INITIAL}/probability/states/values.bin"


def read_index(file: BinaryIO) -> Index:
    """Index of an archive, from its start."""
    for member, size in members(file):
        if member == "index.json":
            if size > _LARGEST_INDEX:
                raise ValueError(f"index.json has {size} bytes; at most {_LARGEST_INDEX} are read.")
            content = bytearray(size)
            fill(file, content, member)
            with errors_in("index.json: "):
                return parse_index(bytes(content))
    raise ValueError("the archive has no index.json; it is no UMB file.")


def known_members(file: BinaryIO, index: Index) -> Iterator[tuple[str, int]]:
    """Names and sizes of the indexed members, checked for size and duplicates."""
    bounds, seen = index.bounds(), set()
    for member, size in members(file):
        if member in seen:
            raise ValueError(f"two members are named {member!r}.")
        if member not in bounds:
            continue
        least, largest = bounds[member]
        if not least <= size <= largest:
            expected = f"{largest}" if least == largest else f"{least} to {largest}"
            raise ValueError(
                f"{member} has {size} bytes; expected {expected}, by the counts and types of "
                "index.json."
            )
        seen.add(member)
        yield member, size


def check_memory(size: int) -> None:
    """Raises ValueError if twice the size exceeds the physical memory."""
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not available on all systems
        return
    if 2 * size > memory:
        raise ValueError(
            f"index.json describes a model of {size / 2**30:.3g} GB, which "
            f"takes twice that; there are {memory / 2**30:.3g} GB."
        )


def needed(contents: dict[str, Bytes], member: str) -> Bytes:
    """Bytes of a required member; ValueError if it is missing."""
    if member not in contents:
        raise ValueError(f"{member} is missing.")
    return contents[member]


def starts_of(contents: dict[str, Bytes], member: str, count: int, total: int) -> NDArray[np.int64]:
    """Offsets of the spans of a member; one element per span if the member is absent."""
    if member in contents:
        with errors_in(f"{member}: "):
            return read_starts(contents.pop(member), total)
    check_one_to_one(member, count, total)
    return np.arange(count + 1)


def check_one_to_one(member: str, count: int, total: int) -> None:
    """Raises ValueError if an absent member cannot map elements one to one."""
    if count != total:
        raise ValueError(
            f"{member} is missing, so that {count} are mapped to {total} one to one; expected the "
            "member, or equal counts."
        )


def check_chain(row_start: NDArray[np.int64], *, first: int = 0) -> None:
    """Raises ValueError unless each state has one choice; `first` is the first state's number."""
    count = np.diff(row_start)
    if (count != 1).any():
        state = int(np.flatnonzero(count != 1)[0])
        raise ValueError(
            f"state-to-choices.bin: state {first + state} has {count[state]} choices; expected "
            "one, as #players is 0."
        )


def label_annotations(index: Index) -> list[Annotation]:
    """Labels in order: the ids of reserved labels are their positions."""
    reserved = {x.id: x for x in index.annotations if x.group == OTHER_LABELS}
    others = iter([x for x in index.annotations if x.group == "aps"])
    labels = [
        reserved.pop(str(i), None) or next(others, None) for i in range(len(index.annotations))
    ]
    return [x for x in (*labels, *reserved.values()) if x is not None]


def annotations_of(contents: dict[str, Bytes], index: Index) -> Annotations:
    """Labels, rewards and actions, as arguments of ``make_sparse``."""
    labels = label_annotations(index)
    label = np.zeros((index.states, len(labels)), bool)
    for i, one in enumerate(labels):
        label[:, i] = read_bits(needed(contents, one.member("states")), index.states)
    annotations = Annotations(
        label=label,
        propositions=tuple(one.name for one in labels),
        rewards=_rewards(contents, index),
    )
    return annotations | _actions(contents, index) if index.actions else annotations


def _rewards(contents: dict[str, Bytes], index: Index) -> dict[str, Rewards]:
    rewards, begins = {}, dict(zip(PARTS, index.begins, strict=True))
    for one in index.annotations:
        if one.group == "rewards":
            parts = {}
            for part in one.applies_to:
                if (member := one.member(part)) in contents:
                    with errors_in(f"{member}: "):
                        parts[PARTS[part]] = read_points(
                            contents.pop(member), one.type, first=begins[part]
                        )
            rewards[one.name] = Rewards(**parts)
    return rewards


def exact_initial(contents: dict[str, Bytes]) -> NDArray[np.float64] | None:
    """Initial distribution that is not uniform over the initial states, if any."""
    content = contents.get(EXACT_INITIAL)
    return None if content is None else content.view("<f8").astype(np.float64, copy=False)


def _actions(contents: dict[str, Bytes], index: Index) -> Annotations:
    """Action numbers of choices, and action names."""
    member = f"{ACTIONS}/values.bin"
    action = np.zeros(index.choices, np.int32)
    if member in contents:
        action = contents.pop(member).view("<u4")
        if action.size and action.max() >= index.actions:
            raise ValueError(
                f"{member}: a choice has the action {action.max()}; expected 0 to "
                f"{index.actions - 1}."
            )
    return Annotations(action=action, action_names=texts_of(contents, ACTIONS))


def texts_of(contents: dict[str, Bytes], folder: str) -> tuple[str, ...]:
    """Strings of a folder; empty if it has none."""
    mapping, strings = f"{folder}/string-mapping.bin", f"{folder}/strings.bin"
    if mapping not in contents:
        return ()
    encoded = needed(contents, strings)
    with errors_in(f"{mapping}: "):
        start = read_starts(contents[mapping], encoded.size)
    with errors_in(f"{strings}: "):
        return read_texts(start, encoded)


def probability_of(
    contents: dict[str, Bytes], index: Index, entry_start: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Branch probabilities ``[T]``, or lower and upper bounds ``[T, 2]``."""
    member, kind = "branch-to-probability.bin", index.probability
    is_interval = kind is not None and kind.end is not None
    if is_interval and index.players > 1:
        raise ValueError(
            "the probabilities of this game are intervals; only chains and decision processes "
            "support them."
        )
    if kind is not None and member in contents:
        with errors_in(f"{member}: "):
            return (read_ends if is_interval else read_numbers)(contents.pop(member), kind)
    several = np.flatnonzero(np.diff(entry_start) > 1)
    if several.size:
        count = int(np.diff(entry_start)[several[0]])
        raise ValueError(
            f"{member} is missing, and choice {index.begins[1] + several[0]} has {count} "
            "branches; without probabilities each choice may have one."
        )
    return np.ones((index.branches, 2) if is_interval else index.branches)


def uniform(initial: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """Uniform distribution over the marked states; None if all or none are marked."""
    count = int(initial.sum())
    return None if count in (0, initial.size) else initial / count
