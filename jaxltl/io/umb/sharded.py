"""Reads UMB models onto a device mesh; each process reads the states of its own devices.

The choices of a range of states and their branches are known from offset members, so a compressed
archive is read again if these come later; of a plain archive only the ranges are read.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jax.sharding import Mesh
from numpy.typing import NDArray

from jaxltl.core.validation import errors_in
from jaxltl.core.models.construct.padded import row_actions
from jaxltl.core.models.mdp import refuse_negative
from jaxltl.core.models.mesh.shard import ModelPart, model_from_parts, ranges_of
from jaxltl.core.models.mesh.sharded import ShardedMDP
from jaxltl.core.models.sparse import choice_reward, sparse_part
from jaxltl.io.files import FileBytes, compression_of, opened, pieces
from jaxltl.io.umb.index import ACTIONS, Index, Items
from jaxltl.io.umb.members import (
    annotations_of,
    check_chain,
    check_memory,
    exact_initial,
    known_members,
    needed,
    probability_of,
    read_index,
    starts_of,
)
from jaxltl.io.umb.tar import Stream
from jaxltl.io.umb.values import Bytes, count_bits, read_bits, read_starts, write_bits

_UNLIMITED = 2**62  # bytes of an archive, which is streamed
_ROWS, _ENTRIES, _IS_INITIAL = (
    "state-to-choices.bin",
    "choice-to-branches.bin",
    "state-is-initial.bin",
)
_WHOLE = (_IS_INITIAL, f"{ACTIONS}/string-mapping.bin", f"{ACTIONS}/strings.bin")
_AHEAD = {"states": (_ROWS, "choices"), "choices": (_ENTRIES, "branches")}
_Span = tuple[int, int]


def read_sharded(
    path: str | os.PathLike[str], mesh: Mesh, *, axis: str | None = None
) -> ShardedMDP:
    """UMB model on a device mesh; each process reads only the states of its devices.

    Equals ``shard(read_model(path), mesh)`` up to the last bit of the initial distribution, without
    holding the model in one process. Compressed archives are read as a whole. Rewards become
    expected rewards of choices; state variables and action names are dropped.

    Args:
      path: the file of a Markov chain or MDP, plain or compressed by gzip or xz.
      mesh, axis: as for :func:`~jaxltl.core.models.mesh.shard.shard`.

    Returns:
      A ShardedMDP.

    Raises:
      ValueError: as ``shard`` and ``read_model``; for games and interval models.

    Example:
      >>> import tempfile, jax, jaxltl as jl
      >>> path = tempfile.mkdtemp() + "/coin.umb"
      >>> jl.write_model(path, jl.make_sparse(None, [0, 1], [0], [1.0]))
      >>> read_sharded(path, jax.make_mesh((1,), ("states",))).num_given
      1
    """
    name = str(path)
    place = f"{name!r}: "
    with opened(path) as data:
        archive = _Archive(data, name, place)
        index = read_index(archive.stream())
        _check_kind(index, place)
        ranges = ranges_of(index.states, mesh, axis)
        size = sum(x.size(index.counts[x.part]) for x in index.items().values())
        own = sum(stop - start for start, stop in ranges)
        check_memory(size * own // index.states, place)
        try:
            parts: dict[_Span, ModelPart] = {}
            # A plain archive is read range by range, a compressed one once for all ranges.
            groups = [[x] for x in ranges] if archive.is_plain else [ranges]
            names: tuple[str, ...] = ()
            for group in groups:
                for span, part, names in _parts(archive, index, group):  # noqa: B007
                    parts[span] = part
        except MemoryError:
            raise ValueError(f"{place}the model does not fit into the memory.") from None
    with errors_in(place):
        return model_from_parts(
            lambda start, stop: parts.pop((start, stop)),
            index.states,
            mesh,
            axis=axis,
            propositions=names,
        )


def _check_kind(index: Index, place: str) -> None:
    """Raises ValueError for games and interval models."""
    problem = None
    if index.players > 1:
        problem = f"the model is a game of {index.players} players"
    elif index.probability is not None and index.probability.end is not None:
        problem = "the probabilities are intervals"
    if problem is not None:
        raise ValueError(
            f"{place}{problem}; a mesh supports Markov chains and MDPs with point probabilities. "
            "Use read_model."
        )


@dataclass(frozen=True)
class _Archive:
    """Archive that can be read repeatedly."""

    data: FileBytes
    name: str
    place: str

    @property
    def is_plain(self) -> bool:
        return compression_of(self.data) is None

    def stream(self) -> Stream:
        if self.is_plain:
            return Stream(self.data, self.place)
        return Stream(pieces(self.data, self.name, _UNLIMITED), self.place)

    def whole(self, index: Index, name: str) -> Bytes:
        """Contents of a whole member."""
        stream = self.stream()
        for member, size in known_members(stream, index):
            if member == name:
                return _read_spans(stream, member, [(0, size)]).arrays[0]
        raise AssertionError(name)


@dataclass(frozen=True)
class _Runs:
    """Disjoint byte ranges of a member, in order."""

    spans: list[_Span]
    arrays: list[Bytes]

    def of(self, span: _Span) -> Bytes:
        """Bytes of a span contained in one of the ranges."""
        begin, end = span
        if begin == end:
            return np.empty(0, np.uint8)
        i = next(i for i, (a, b) in enumerate(self.spans) if a <= begin and end <= b)
        return self.arrays[i][begin - self.spans[i][0] : end - self.spans[i][0]]


def _read_spans(stream: Stream, member: str, spans: Sequence[_Span]) -> _Runs:
    """Reads byte ranges of the current member of a stream; adjacent ranges are merged."""
    runs: list[_Span] = []
    for begin, end in sorted(x for x in spans if x[0] < x[1]):
        if runs and begin <= runs[-1][1]:
            runs[-1] = runs[-1][0], max(end, runs[-1][1])
        else:
            runs.append((begin, end))
    arrays, at = [], 0
    for begin, end in runs:
        stream.skip(begin - at, repr(member))
        array = np.empty(end - begin, np.uint8)
        stream.fill(array, member if begin == 0 else f"{member} from byte {begin}")
        arrays.append(array)
        at = end
    return _Runs(runs, arrays)


# --- members in memory ----------------------------------------------------------------------


@dataclass(frozen=True)
class _ReadData:
    """Data read for ranges of states."""

    spans: dict[str, list[_Span]]  # ranges of states, choices and branches
    starts: dict[str, list[NDArray[np.int64]]]  # offsets of choices and branches for each range
    found: dict[str, _Runs]  # bytes of the other members


def _read(archive: _Archive, index: Index, ranges: list[_Span]) -> _ReadData:
    """Reads all members of some ranges of states, with as few passes as possible."""
    items, held = index.items(), _ReadData({"states": ranges}, {}, {})
    _infer_one_to_one(index, held)
    goes_on = True
    while goes_on or "branches" not in held.spans:
        goes_on, previous = False, set(held.spans)
        stream = archive.stream()
        for member, size in known_members(stream, index):
            if member in held.found:
                continue
            if member in _WHOLE:
                held.found[member] = _read_spans(stream, member, [(0, size)])
            elif member in items and items[member].part not in held.spans:
                goes_on = True
            elif member in items:
                ranges_of_bytes = [items[member].span(*x) for x in held.spans[items[member].part]]
                if items[member].more:
                    ranges_of_bytes += [(0, 8), (size - 8, size)]
                held.found[member] = _read_spans(stream, member, ranges_of_bytes)
                if items[member].more:
                    goes_on |= _set_child_ranges(archive, index, held, items, member)
        for part, (member, ahead) in _AHEAD.items():
            if (
                part in previous and member not in held.found
            ):  # an absent member must be a one-to-one map
                starts_of({}, member, index.counts[part], index.counts[ahead], archive.place)
    return held


def _infer_one_to_one(index: Index, held: _ReadData) -> None:
    for part, (_, ahead) in _AHEAD.items():
        if part in held.spans and index.counts[part] == index.counts[ahead]:
            held.spans.setdefault(ahead, held.spans[part])


def _set_child_ranges(
    archive: _Archive, index: Index, held: _ReadData, items: dict[str, Items], member: str
) -> bool:
    """Sets the ranges of the choices (branches) of a part; True if members must be read again."""
    part = items[member].part
    ahead, total = _AHEAD[part][1], index.counts[_AHEAD[part][1]]
    runs, size = held.found[member], items[member].size(index.counts[part])
    ends = [int(runs.of(x).view("<u8")[0]) for x in ((0, 8), (size - 8, size))]
    starts = [runs.of(items[member].span(*x)).view("<u8") for x in held.spans[part]]
    rises = all((x[1:] >= x[:-1]).all() and x[-1] <= total for x in starts)
    if ends != [0, total] or not rises:  # the error names the position
        read_starts(archive.whole(index, member), total, f"{archive.place}{member}: ")
    held.starts[part] = [x.view("<i8").astype(np.int64, copy=False) for x in starts]
    spans = [(int(x[0]), int(x[-1])) for x in starts]
    in_vain = held.spans.get(ahead, spans) != spans
    held.spans[ahead] = spans
    if in_vain:
        later = ("choices", "branches")[("choices", "branches").index(ahead) :]
        for other in [x for x in held.found if x in items and items[x].part in later]:
            del held.found[other]
        if ahead == "choices":
            held.spans.pop("branches", None)
    _infer_one_to_one(index, held)
    return in_vain


# --- what follows from it -------------------------------------------------------------------


def _parts(
    archive: _Archive, index: Index, ranges: list[_Span]
) -> Iterator[tuple[_Span, ModelPart, tuple[str, ...]]]:
    """Model parts of ranges of states, with the label names."""
    place = archive.place
    held, items = _read(archive, index, ranges), index.items()
    whole = {x: held.found[x].arrays[0] for x in _WHOLE if x in held.found and x != _IS_INITIAL}
    some = index.states  # initial states
    if _IS_INITIAL in held.found:
        some = count_bits(held.found[_IS_INITIAL].arrays[0], index.states)
    for i, span in enumerate(ranges):
        spans = {part: x[i] for part, x in held.spans.items()}
        here = index.of(*(spans[part] for part in index.counts))
        contents = {
            member: _of_range(runs, items[member], spans[items[member].part])
            for member, runs in held.found.items()
            if member in items and not items[member].more
        }
        starts = [
            held.starts[part][i] - spans[ahead][0]
            if part in held.starts
            else np.arange(spans[part][1] - spans[part][0] + 1)
            for part, (_, ahead) in _AHEAD.items()
        ]
        part, names = _part(contents | whole, here, starts, index.states, some, place)
        yield span, part, names


def _of_range(runs: _Runs, item: Items, span: _Span) -> Bytes:
    content = runs.of(item.span(*span))
    if item.bits > 1 or span[0] % 8 == 0:
        return content
    first = span[0] % 8
    return write_bits(read_bits(content, first + span[1] - span[0])[first:])


def _part(
    contents: dict[str, Bytes],
    index: Index,
    starts: list[NDArray[np.int64]],
    num_states: int,
    some: int,
    place: str,
) -> tuple[ModelPart, tuple[str, ...]]:
    """Model part of one range of states, and the label names."""
    row_start, entry_start = starts
    target = needed(contents, "branch-to-target.bin", place).view("<u8")
    if index.players == 0:
        check_chain(row_start, place, first=index.begins[0])
    annotations = annotations_of(contents, index, place)
    probability = probability_of(contents, index, entry_start, place)
    initial = exact_initial(contents)
    if initial is None:
        initial = np.full(index.states, 1 / num_states)
        if 0 < some < num_states:
            initial = read_bits(contents[_IS_INITIAL], index.states) / some
    with errors_in(place):
        model = sparse_part(
            row_start, entry_start, target, probability, index.begins, num_states, **annotations
        )
        refuse_negative(initial, first=index.begins[0])
    part = ModelPart(
        row_start=model.row_start,
        entry_start=model.entry_start,
        successor=model.successor,
        probability=model.probability,
        action=row_actions(model),
        initial=initial,
        label=np.asarray(model.label),
        rewards={name: choice_reward(model, name) for name in model.rewards},
        row=np.arange(index.choices) + index.begins[1],
    )
    return part, model.propositions
