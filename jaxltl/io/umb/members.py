"""Members of a UMB archive: labels, rewards, actions and probabilities of a range of states."""

from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.models.sparse import Annotations, Rewards
from jaxltl.io.umb.index import ACTIONS, INITIAL, OTHER_LABELS, PARTS, Index, parse_index
from jaxltl.io.umb.tar import Stream, members
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


def read_index(stream: Stream) -> Index:
    """Index of an archive, from a stream at its start."""
    for member, size in members(stream):
        if member == "index.json":
            if size > _LARGEST_INDEX:
                raise ValueError(
                    f"{stream.place}index.json has {size} bytes; at most {_LARGEST_INDEX} are read."
                )
            content = bytearray(size)
            stream.fill(content, member)
            return parse_index(bytes(content), f"{stream.place}index.json: ")
    raise ValueError(f"{stream.place}the archive has no index.json; it is no UMB file.")


def known_members(stream: Stream, index: Index) -> Iterator[tuple[str, int]]:
    """Names and sizes of the indexed members, checked for size and duplicates."""
    bounds, seen = index.bounds(), set()
    for member, size in members(stream):
        if member in seen:
            raise ValueError(f"{stream.place}two members are named {member!r}.")
        if member not in bounds:
            continue
        least, largest = bounds[member]
        if not least <= size <= largest:
            expected = f"{largest}" if least == largest else f"{least} to {largest}"
            raise ValueError(
                f"{stream.place}{member} has {size} bytes; expected {expected}, by the counts "
                "and types of index.json."
            )
        seen.add(member)
        yield member, size


def check_memory(size: int, place: str) -> None:
    """Raises ValueError if twice the size exceeds the physical memory."""
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not available on all systems
        return
    if 2 * size > memory:
        raise ValueError(
            f"{place}index.json describes a model of {size / 2**30:.3g} GB, which "
            f"takes twice that; there are {memory / 2**30:.3g} GB."
        )


def needed(contents: dict[str, Bytes], member: str, place: str) -> Bytes:
    """Bytes of a required member; ValueError if it is missing."""
    if member not in contents:
        raise ValueError(f"{place}{member} is missing.")
    return contents[member]


def starts_of(
    contents: dict[str, Bytes], member: str, count: int, total: int, place: str
) -> NDArray[np.int64]:
    """Offsets of the spans of a member; one element per span if the member is absent."""
    if member in contents:
        return read_starts(contents.pop(member), total, f"{place}{member}: ")
    if count != total:
        raise ValueError(
            f"{place}{member} is missing, so that {count} are mapped to {total} one "
            "to one; expected the member, or equal counts."
        )
    return np.arange(count + 1)


def check_chain(row_start: NDArray[np.int64], place: str, *, first: int = 0) -> None:
    """Raises ValueError unless each state has one choice; `first` is the first state's number."""
    count = np.diff(row_start)
    if (count != 1).any():
        state = int(np.flatnonzero(count != 1)[0])
        raise ValueError(
            f"{place}state-to-choices.bin: state {first + state} has {count[state]} choices; "
            "expected one, as #players is 0."
        )


def labels_of(
    contents: dict[str, Bytes], index: Index, place: str
) -> tuple[NDArray[np.bool_], tuple[str, ...]]:
    """Label matrix ``bool[S, P]`` and label names."""
    ours = {x.id: x for x in index.annotations if x.group == OTHER_LABELS}
    others = iter([x for x in index.annotations if x.group == "aps"])
    all_of = []
    for i in range(len(index.annotations)):  # ids of reserved labels are their positions
        one = ours.pop(str(i), None) or next(others, None)
        if one is not None:
            all_of.append(one)
    all_of += ours.values()
    label = np.zeros((index.states, len(all_of)), bool)
    for i, one in enumerate(all_of):
        label[:, i] = read_bits(needed(contents, one.member("states"), place), index.states)
    return label, tuple(one.name for one in all_of)


def rewards_of(contents: dict[str, Bytes], index: Index, place: str) -> dict[str, Rewards]:
    """Reward structures by name."""
    rewards, begins = {}, dict(zip(PARTS, index.begins, strict=True))
    for one in index.annotations:
        if one.group == "rewards":
            parts = {
                PARTS[part]: read_points(
                    contents.pop(one.member(part)),
                    one.type,
                    f"{place}{one.member(part)}: ",
                    first=begins[part],
                )
                for part in one.applies_to
                if one.member(part) in contents
            }
            rewards[one.name] = Rewards(**parts)
    return rewards


def annotations_of(contents: dict[str, Bytes], index: Index, place: str) -> Annotations:
    """Labels, rewards and actions, as arguments of ``make_sparse``."""
    label, propositions = labels_of(contents, index, place)
    annotations = Annotations(
        label=label, propositions=propositions, rewards=rewards_of(contents, index, place)
    )
    return annotations | actions_of(contents, index, place) if index.actions else annotations


def exact_initial(contents: dict[str, Bytes]) -> NDArray[np.float64] | None:
    """Initial distribution that is not uniform over the initial states, if any."""
    content = contents.get(EXACT_INITIAL)
    return None if content is None else content.view("<f8").astype(np.float64, copy=False)


def actions_of(contents: dict[str, Bytes], index: Index, place: str) -> Annotations:
    """Action numbers of choices, and action names."""
    member = f"{ACTIONS}/values.bin"
    action = np.zeros(index.choices, np.int32)
    if member in contents:
        action = contents.pop(member).view("<u4")
        if action.size and action.max() >= index.actions:
            raise ValueError(
                f"{place}{member}: a choice has the action {action.max()}; expected 0 "
                f"to {index.actions - 1}."
            )
    return Annotations(action=action, action_names=texts_of(contents, ACTIONS, place))


def texts_of(contents: dict[str, Bytes], folder: str, place: str) -> tuple[str, ...]:
    """Strings of a folder; empty if it has none."""
    mapping, strings = f"{folder}/string-mapping.bin", f"{folder}/strings.bin"
    if mapping not in contents:
        return ()
    encoded = needed(contents, strings, place)
    start = read_starts(contents[mapping], encoded.size, f"{place}{mapping}: ")
    return read_texts(start, encoded, f"{place}{strings}: ")


def probability_of(
    contents: dict[str, Bytes], index: Index, entry_start: NDArray[np.int64], place: str
) -> NDArray[np.float64]:
    """Branch probabilities ``[T]``, or lower and upper bounds ``[T, 2]``."""
    member, kind = "branch-to-probability.bin", index.probability
    if kind is not None and kind.end is not None and index.players > 1:
        raise ValueError(
            f"{place}the probabilities of this game are intervals; only chains and decision "
            "processes support them."
        )
    if kind is not None and member in contents:
        read = read_numbers if kind.end is None else read_ends
        return read(contents.pop(member), kind, f"{place}{member}: ")
    several = np.flatnonzero(np.diff(entry_start) > 1)
    if several.size:
        count = int(np.diff(entry_start)[several[0]])
        raise ValueError(
            f"{place}{member} is missing, and choice {index.begins[1] + several[0]} has {count} "
            "branches; without probabilities each choice may have one."
        )
    return np.ones(index.branches if kind is None or kind.end is None else (index.branches, 2))


def uniform(initial: NDArray[np.bool_]) -> NDArray[np.float64] | None:
    """Uniform distribution over the marked states; None if all or none are marked."""
    count = int(initial.sum())
    return None if count in (0, initial.size) else initial / count
