"""Members of a UMB archive: labels, rewards, actions and probabilities of a range of states."""

from __future__ import annotations

import os
import re
import tarfile
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.models.sparse import Annotations, Rewards
from jaxltl.core.validation import errors_in
from jaxltl.io.umb.index import (
    ACTIONS,
    Annotation,
    INITIAL,
    Index,
    OTHER_LABELS,
    PARTS,
    parse_index,
)
from jaxltl.io.umb.values import (
    Bytes,
    read_bits,
    read_ends,
    read_numbers,
    read_points,
    read_starts,
    read_texts,
)


_BLOCK = 512
_LONGEST_NAME = 2**16  # bytes of an extended header
_GZIP_BLOCK = 2**20


class _Member(tarfile.TarInfo):
    """A header that must be valid; tarfile takes one that is not for the end of an archive."""

    @classmethod
    def frombuf(cls, buf: bytes, encoding: str, errors: str) -> _Member:  # type: ignore[override]
        if len(buf) == _BLOCK and not any(buf):
            return super().frombuf(buf, encoding, errors)  # raises the end of the archive
        try:
            info = super().frombuf(buf, encoding, errors)
            if buf[257:262] != b"ustar":
                raise tarfile.HeaderError("'ustar' is missing at byte 257")
        except (tarfile.HeaderError, UnicodeDecodeError) as error:
            raise ValueError(
                f"a header of the tar archive cannot be read, {error}: {buf[:40]!r}; is it a UMB file?"
            ) from None
        # What tarfile reads itself are extended headers.
        if info.size < 0 or (info.size > _LONGEST_NAME and info.type in b"xgLKX"):
            raise ValueError(
                f"{info.name!r}: a size of {info.size} bytes; expected none below 0, and at most "
                f"{_LONGEST_NAME} of an extended header."
            )
        return info


def members(file: BinaryIO) -> Iterator[tuple[str, int]]:
    """Names and sizes of regular files; at each, the file is at the start of its contents."""
    try:
        archive = tarfile.TarFile(fileobj=file, tarinfo=_Member, encoding="utf-8", errors="strict")
        for info in archive:
            name = _checked_name(info.name)
            if info.isreg() and not info.issparse():
                yield name, info.size
    except tarfile.TarError as error:
        raise ValueError(f"the archive is cut off or damaged: {error}.") from None
    while rest := file.read(2**20):  # which verifies the checksum of a compressed file
        if rest.strip(b"\0"):  # tarfile ends without an error at a damaged extended header
            raise ValueError("a header is damaged, or data follow the end of the tar archive.")


def fill(file: BinaryIO, target: bytearray | NDArray[np.uint8], subject: str) -> None:
    """Fills a uint8 array or bytearray; ValueError at a premature end."""
    count = file.readinto(target)  # type: ignore[attr-defined]
    if count < len(target):
        raise ValueError(
            f"{subject}: the archive ends after {count} of {len(target)} bytes; it is cut off."
        )


def _checked_name(name: str) -> str:
    """Member name without leading ./; ValueError for paths outside the archive."""
    parts = name.split("/")
    while parts[0] == ".":
        del parts[0]
        if not parts:
            return "/"
    inner = parts[:-1] if parts[-1] == "" else parts
    if any(part in ("", "..") for part in inner) or re.search(r"[\0-\x1f\x7f\\:]", name):
        raise ValueError(
            f"a member is named {name[:100]!r}; expected a path within the "
            "archive, of plain names and /."
        )
    return "/".join(parts)


# --- writing --------------------------------------------------------------------------------


def tar_pieces(contents: Sequence[tuple[str, NDArray[np.uint8] | bytes]]) -> Iterator[memoryview]:
    """Bytes of a tar archive of named contents, in pieces."""
    for name, content in contents:
        view = memoryview(content)  # type: ignore[arg-type]  # a Buffer since Python 3.12
        info = tarfile.TarInfo(name)
        info.size = len(view)
        small = info.size < 8**11
        yield memoryview(info.tobuf(tarfile.USTAR_FORMAT if small else tarfile.GNU_FORMAT))
        yield view
        yield memoryview(bytes(-len(view) % _BLOCK))
    yield memoryview(bytes(2 * _BLOCK))


def write_gzip(file: BinaryIO, pieces: Iterator[memoryview], threads: int = 4) -> None:
    """Writes a gzip stream, compressed by threads in fixed blocks: the output is deterministic."""
    file.write(b"\x1f\x8b\x08\0\0\0\0\0\0\xff")
    checksum = size = 0
    with ThreadPoolExecutor(threads) as pool:
        waiting: list[Future[bytes]] = []
        for piece in pieces:
            for block in (piece[i : i + _GZIP_BLOCK] for i in range(0, len(piece), _GZIP_BLOCK)):
                waiting.append(pool.submit(_deflated, block))
                checksum, size = zlib.crc32(block, checksum), size + len(block)
                if len(waiting) > 2 * threads:
                    file.write(waiting.pop(0).result())
        for done in waiting:
            file.write(done.result())
    file.write(b"\x03\x00")  # an empty last block
    file.write(checksum.to_bytes(4, "little") + (size % 2**32).to_bytes(4, "little"))


def _deflated(block: memoryview) -> bytes:
    """Deflate block flushed to a byte boundary, so that blocks can be concatenated."""
    packer = zlib.compressobj(1, zlib.DEFLATED, -15, 9)
    return packer.compress(block) + packer.flush(zlib.Z_SYNC_FLUSH)


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
