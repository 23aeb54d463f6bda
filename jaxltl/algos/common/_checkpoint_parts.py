"""Arrays distributed over the devices of several processes, as files with one part for each process.

A part has a new name each time it is written. One process writes the file that names the parts last,
when all processes have written theirs, and the previous parts stay until then. So whenever a process
dies, that file and the parts that it names are complete.
"""

from __future__ import annotations

import contextlib
import glob
import os
import secrets
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import jax
import numpy as np

from jaxltl.core.array_types import PyTree

Write = Callable[[Path], contextlib.AbstractContextManager[BinaryIO]]


def is_shared(x: object) -> bool:
    """True if an array lies on the devices of several processes."""
    return isinstance(x, jax.Array) and not x.is_fully_addressable


def is_apart(x: object) -> bool:
    """True if an array lies on the devices of several processes and is not replicated."""
    return isinstance(x, jax.Array) and is_shared(x) and not x.is_fully_replicated


class Stored(NamedTuple):
    """An array in parts: bounds, file and name in the file of each of its `pieces`."""

    shape: list[int]
    dtype: str
    pieces: list[tuple[list[int], list[int], str, str]]


def write(path: Path, arrays: Mapping[str, PyTree], create: Write) -> dict[str, Stored]:
    """Writes this process's part of arrays, and waits until the others have written theirs."""
    from jax.experimental.multihost_utils import process_allgather

    token = np.frombuffer(secrets.token_bytes(8), np.uint32)
    mine = {
        _name(array, shard.index): np.asarray(shard.data)
        for array, x in enumerate(arrays.values())
        for shard in x.addressable_shards
        if shard.replica_id == 0
    }
    if mine:
        with create(_part(path, jax.process_index(), token)) as file:
            np.savez(file, allow_pickle=False, **mine)
    tokens = np.asarray(process_allgather(token))  # when it is back all have written
    names = [_part(path, process, x).name for process, x in enumerate(tokens)]
    return {
        name: Stored(
            list(x.shape),
            str(x.dtype),
            [
                (
                    *_ends(shard.index, x.shape),
                    names[shard.device.process_index],
                    _name(array, shard.index),
                )
                for shard in x.global_shards
                if shard.replica_id == 0
            ],
        )
        for array, (name, x) in enumerate(arrays.items())
    }


def _part(path: Path, process: int, token: np.ndarray) -> Path:
    return path.with_name(f"{path.name}.part-{process}-{token.tobytes().hex()}")


def parts_of(path: Path) -> list[Path]:
    """All parts in the directory of a file, named by it or not."""
    return sorted(path.parent.glob(f"{glob.escape(path.name)}.part-*"))


def unfinished(path: Path) -> list[Path]:
    """Temporary files that killed processes left of a file and of its parts."""
    return sorted(path.parent.glob(f".{glob.escape(path.name)}.*"))


def remove(paths: list[Path]) -> None:
    """Removes files, those that are there."""
    for path in paths:
        path.unlink(missing_ok=True)


class Parts(contextlib.ExitStack):
    """The parts of a file, read on demand, each piece once, and closed in the end."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__()
        self._beside = Path(path)
        self._files, self._pieces = dict[str, Any](), dict[tuple[str, str], np.ndarray]()

    def read(self, stored: Stored, index: tuple[slice, ...] | None = None) -> np.ndarray:
        """A block of an array, or all of it, from its pieces; ValueError if a part is missing or damaged."""
        begin, end = _ends(index or (), stored.shape)
        found = np.zeros([b - a for a, b in zip(begin, end, strict=True)], stored.dtype)
        for first, last, file, name in stored.pieces:
            low, high = np.maximum(begin, first), np.minimum(end, last)
            if (low < high).all():
                found[_block(low, high, begin)] = self._piece(file, name)[_block(low, high, first)]
        return found

    def _piece(self, file: str, name: str) -> np.ndarray:
        if (file, name) not in self._pieces:
            try:
                if file not in self._files:
                    opened = self.enter_context(self._beside.with_name(file).open("rb"))
                    self._files[file] = np.load(opened, allow_pickle=False)
                self._pieces[file, name] = self._files[file][name]
            except Exception as error:  # damaged bytes make numpy and zipfile raise almost anything
                what = "missing" if isinstance(error, FileNotFoundError) else "damaged"
                raise ValueError(f"its part {file!r} is {what}.") from None
        return self._pieces[file, name]


def _ends(index: tuple[slice, ...], shape: Sequence[int]) -> tuple[list[int], list[int]]:
    """First and last indices of a block; axes that are not named are whole."""
    index = (*index, *(slice(None),) * (len(shape) - len(index)))
    each = [x.indices(int(n)) for x, n in zip(index, shape, strict=True)]
    return [x[0] for x in each], [x[1] for x in each]


def _block(low: Iterable[int], high: Iterable[int], first: Iterable[int]) -> tuple[slice, ...]:
    return tuple(slice(int(a - c), int(b - c)) for a, b, c in zip(low, high, first, strict=True))


def _name(array: int, index: tuple[slice, ...]) -> str:
    return f"{array}-" + "-".join(str(x.start or 0) for x in index)
