"""Reads UMB models onto a device mesh; each process reads the states of its own devices."""

from __future__ import annotations

import os
import shutil
import tempfile
from typing import BinaryIO

import numpy as np
from jax.sharding import Mesh
from numpy.typing import NDArray

from jaxltl.core.models.action_numbers import row_actions
from jaxltl.core.models.mdp import refuse_negative
from jaxltl.core.models.mesh.shard import ModelPart, model_from_parts, ranges_of
from jaxltl.core.models.mesh.sharded import ShardedMDP
from jaxltl.core.models.sparse import choice_reward, sparse_part
from jaxltl.core.validation import errors_in
from jaxltl.io.files import compression_of, decompressed, opened
from jaxltl.io.umb.index import ACTIONS, Index, Items
from jaxltl.io.umb.members import (
    annotations_of,
    check_chain,
    check_memory,
    check_one_to_one,
    exact_initial,
    fill,
    known_members,
    label_annotations,
    needed,
    probability_of,
    read_index,
)
from jaxltl.io.umb.values import Bytes, read_bits, read_starts, write_bits

_UNLIMITED = 2**62  # bytes of an archive, which is not held in memory
_IS_INITIAL = "state-is-initial.bin"
_TEXTS = (f"{ACTIONS}/string-mapping.bin", f"{ACTIONS}/strings.bin")
# The member that maps each part of a model to the next one.
_MAPS = (
    ("states", "state-to-choices.bin", "choices"),
    ("choices", "choice-to-branches.bin", "branches"),
)
_Span = tuple[int, int]


def read_sharded(
    path: str | os.PathLike[str], mesh: Mesh, *, axis: str | None = None
) -> ShardedMDP:
    """UMB model on a device mesh; each process reads only the states of its devices.

    Equals ``shard(read_model(path), mesh)`` up to the last bit of the initial distribution, without
    holding the model in one process. Compressed archives are
    decompressed into a temporary file. Rewards become
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
      >>> read_sharded(path, jax.make_mesh((1,), ("states",))).num_unpadded
      1
    """
    with opened(path) as file:
        is_plain = compression_of(file.read(8)) is None
        file.seek(0)
        with tempfile.TemporaryFile() as temporary:
            if not is_plain:
                shutil.copyfileobj(decompressed(file, _UNLIMITED), temporary)
            archive = _Archive(file if is_plain else temporary)
            _check_kind(archive.index)
            ranges = ranges_of(archive.index.states, mesh, axis)
            try:
                parts = archive.parts(ranges)
            except MemoryError:
                raise ValueError("the model does not fit into the memory.") from None
        return model_from_parts(
            lambda start, stop: parts.pop((start, stop)),
            archive.index.states,
            mesh,
            axis=axis,
            propositions=tuple(x.name for x in label_annotations(archive.index)),
        )


def _check_kind(index: Index) -> None:
    """Raises ValueError for games, POMDPs and interval models."""
    problem = None
    if index.players > 1:
        problem = f"the model is a game of {index.players} players"
    elif index.observations:
        problem = "the model is a POMDP"
    elif index.probability is not None and index.probability.end is not None:
        problem = "the probabilities are intervals"
    if problem is not None:
        raise ValueError(
            f"{problem}; a mesh supports Markov chains and MDPs with point probabilities. "
            "Use read_model."
        )


class _Archive:
    """A plain archive, of which ranges of members are read."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        file.seek(0)
        self.index = read_index(file)
        self.places: dict[str, _Span] = {}  # offset and size of each member

    def parts(self, ranges: list[_Span]) -> dict[_Span, ModelPart]:
        """The parts of the model for ranges of states."""
        index, items = self.index, self.index.items().values()
        own = sum(stop - start for start, stop in ranges)
        size = sum(x.size(index.counts[x.part]) for x in items)
        check_memory(size * own // index.states)
        self.file.seek(0)
        for member, length in known_members(self.file, index):
            self.places[member] = self.file.tell(), length
        num_initial = index.states
        if _IS_INITIAL in self.places:
            num_initial = int(read_bits(self.whole(_IS_INITIAL), index.states).sum())
        return {span: self.part(span, num_initial) for span in ranges}

    def read(self, member: str, begin: int, end: int) -> Bytes:
        content = np.empty(end - begin, np.uint8)
        self.file.seek(self.places[member][0] + begin)
        fill(self.file, content, member)
        return content

    def whole(self, member: str) -> Bytes:
        return self.read(member, 0, self.places[member][1])

    def elements(self, member: str, item: Items, span: _Span) -> Bytes:
        """The elements of a member in a range; bits begin at the first one."""
        content = self.read(member, *item.span(*span))
        first = span[0] % 8
        if item.bits > 1 or first == 0:
            return content
        return write_bits(read_bits(content, first + span[1] - span[0])[first:])

    def starts(self, member: str, count: int, total: int, span: _Span) -> NDArray[np.int64]:
        """Offsets of the choices of a range of states, or of the branches of choices."""
        if member not in self.places:
            check_one_to_one(member, count, total)
            return np.arange(span[0], span[1] + 1)
        item, size = self.index.items()[member], self.places[member][1]
        start = self.elements(member, item, span).view("<u8")
        ends = [self.read(member, at, at + 8).view("<u8")[0] for at in (0, size - 8)]
        if ends != [0, total] or (start[1:] < start[:-1]).any() or start[-1] > total:
            with errors_in(f"{member}: "):
                read_starts(self.whole(member), total)  # the error names the position
        return start.view("<i8").astype(np.int64, copy=False)

    def part(self, span: _Span, num_initial: int) -> ModelPart:
        """The part of the model for one range of states."""
        index, spans = self.index, {"states": span}
        starts = {}
        for part, member, ahead in _MAPS:
            start = self.starts(member, index.counts[part], index.counts[ahead], spans[part])
            spans[ahead] = int(start[0]), int(start[-1])
            starts[part] = start - start[0]
        row_start, entry_start = starts["states"], starts["choices"]
        index = index.of(*spans.values())
        contents = {
            member: self.elements(member, item, spans[item.part])
            for member, item in self.index.items().items()
            if member in self.places and not item.more
        }
        contents |= {member: self.whole(member) for member in _TEXTS if member in self.places}
        target = needed(contents, "branch-to-target.bin").view("<u8")
        if index.players == 0:
            check_chain(row_start, first=span[0])
        annotations = annotations_of(contents, index)
        probability = probability_of(contents, index, entry_start)
        initial = exact_initial(contents)
        if initial is None:
            initial = np.full(index.states, 1 / self.index.states)
            if 0 < num_initial < self.index.states:
                initial = read_bits(contents[_IS_INITIAL], index.states) / num_initial
        num_states = self.index.states
        model = sparse_part(
            row_start, entry_start, target, probability, index.begins, num_states, **annotations
        )
        refuse_negative(initial, first=span[0])
        return ModelPart(
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
