"""Binary file access: transparent decompression, bounded size and atomic writes."""

from __future__ import annotations

import contextlib
import gzip
import itertools
import lzma
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Literal

from jaxltl.core.files import atomic_write
from jaxltl.core import validation

Compression = Literal["gzip", "xz"]

MAX_BYTES = 2**34  # of a file, after decompression
MAX_RATIO = 300  # maximal compression ratio beyond ALWAYS_ALLOWED bytes
ALWAYS_ALLOWED = 2**28
_XZ_MEMORY = 2**28  # memory limit of the decoder; `xz -9` requires 65 MB
_STEP = 2**20  # output bytes per step
_FED = 2**14  # input bytes per step

_BEGINS: dict[Compression, bytes] = {"gzip": b"\x1f\x8b", "xz": b"\xfd7zXZ\x00"}
_SUFFIX: dict[str, Compression] = {".gz": "gzip", ".xz": "xz"}


def read_bytes(path: str | os.PathLike[str], limit: int = MAX_BYTES) -> bytes:
    """Contents of a file, decompressed if it starts with the magic number of gzip or xz.

    The size is bounded by `limit` and, for compressed files, by 256 MiB plus 300 times the file
    size.
    """
    data = raw_bytes(path, limit)
    return b"".join(pieces(data, str(path), limit)) if compression_of(data) else data


def _check_path(path: object) -> None:
    if not isinstance(path, str | os.PathLike):  # integers would be file descriptors
        raise ValueError(f"path is {validation.shorten(path)}; give the name of a file.")


def raw_bytes(path: str | os.PathLike[str], limit: int = MAX_BYTES) -> bytes:
    """Contents of a file without decompression, at most `limit` bytes."""
    parts = list(_parts(path, limit, 2**24))
    try:
        return parts[0] if len(parts) == 1 else b"".join(parts)
    except MemoryError as error:
        raise _unreadable(str(path), error) from None


def _parts(path: str | os.PathLike[str], limit: int, step: int) -> Iterator[bytes]:
    """Contents of a file in parts, without decompression; ValueError beyond `limit` bytes."""
    _check_path(path)
    size = 0
    try:
        with open(path, "rb") as file:
            while part := file.read(step):
                size += len(part)
                if size > limit:
                    break
                yield part
    except (OSError, ValueError, MemoryError) as error:
        raise _unreadable(str(path), error) from None
    if size > limit:
        raise ValueError(f"{str(path)!r} has more than {limit} bytes, the most that are read.")


class FileBytes:
    """Lazy read-only view of an open file: ``file[a:b]`` reads these bytes."""

    def __init__(self, file: BinaryIO):
        self._file, self._size = file, os.fstat(file.fileno()).st_size

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, place: slice) -> bytes:
        start, stop, _ = place.indices(self._size)
        self._file.seek(start)
        return self._file.read(max(stop - start, 0))


@contextlib.contextmanager
def opened(path: str | os.PathLike[str]) -> Iterator[FileBytes]:
    """Opens a file of any size without reading it; I/O errors become ValueErrors."""
    _check_path(path)
    try:
        file = open(path, "rb")  # noqa: SIM115 - a null byte in the name is a ValueError here only
    except (OSError, ValueError) as error:
        raise _unreadable(str(path), error) from None
    try:
        with file:
            yield FileBytes(file)
    except OSError as error:
        raise _unreadable(str(path), error) from None


def pieces(data: bytes | FileBytes, name: str, limit: int = MAX_BYTES) -> Iterator[bytes]:
    """Decompressed contents of a file in pieces, with the size bounds of :func:`read_bytes`."""
    kind = compression_of(data)
    if kind is None:
        yield from (data[i : i + _STEP] for i in range(0, len(data), _STEP))
        return
    allowed = min(limit, ALWAYS_ALLOWED + MAX_RATIO * len(data))
    try:
        yield from _decompressed(data, kind, allowed, name)
    except (zlib.error, lzma.LZMAError, EOFError, MemoryError) as error:
        raise ValueError(
            f"{name!r} has the header of {kind} and is damaged: {error or 'out of memory'}."
        ) from None


def streamed(path: str | os.PathLike[str], limit: int = MAX_BYTES) -> Iterator[bytes]:
    """Decompressed contents of a file in pieces; only compressed input is held in memory."""
    parts = _parts(path, limit, _STEP)
    first = next(parts, b"")
    if compression_of(first):
        yield from pieces(b"".join([first, *parts]), str(path), limit)
    else:
        yield from itertools.chain([first] if first else [], parts)


def _unreadable(name: str, error: Exception) -> ValueError:
    # A null byte in the name makes a ValueError.
    reason = getattr(error, "strerror", None) or str(error) or "too large for the memory"
    return ValueError(f"cannot read {name!r}: {reason}.")


def read_text(path: str | os.PathLike[str], expected: str) -> str:
    """Decoded UTF-8 contents of a file, decompressed as by :func:`read_bytes`."""
    data = read_bytes(path)
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ValueError(
            f"{path}, line {line}: byte {data[error.start]:#x} is not UTF-8 text; {expected} is "
            "expected."
        ) from None


def compression_of(data: bytes | FileBytes) -> Compression | None:
    """Compression of a file by its first bytes, or None."""
    return next((kind for kind in _BEGINS if _begins(data, 0, kind)), None)


def _begins(data: bytes | FileBytes, place: int, kind: Compression) -> bool:
    return data[place : place + len(_BEGINS[kind])] == _BEGINS[kind]


def compression_by_name(path: str | os.PathLike[str]) -> Compression | None:
    """Compression of a file by its suffix, or None."""
    return _SUFFIX.get(Path(path).suffix.lower())


def _decompressed(
    data: bytes | FileBytes, kind: Compression, allowed: int, name: str
) -> Iterator[bytes]:
    size = place = 0
    while place < len(data):  # concatenated streams with zero padding
        if not _begins(data, place, kind):
            rest = data[place:]
            if rest.count(0) == len(rest):
                break
            raise ValueError(f"{name!r}: {len(rest)} bytes follow the {kind} data; remove them.")
        for part, place in _stream(data, place, kind):  # noqa: B007, B020 - the place moves on
            size += len(part)
            if size > allowed:
                raise ValueError(
                    f"{name!r}, {len(data)} bytes of {kind}, holds more than {allowed} bytes; decompress "
                    "it first if this size is intended."
                )
            yield part


def _stream(data: bytes | FileBytes, place: int, kind: Compression) -> Iterator[tuple[bytes, int]]:
    """Decompresses one stream; yields each piece with the input offset after it."""
    unpack: zlib._Decompress | lzma.LZMADecompressor
    if kind == "gzip":
        unpack = zlib.decompressobj(wbits=31)
    else:
        unpack = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY)
    held = b""
    while not unpack.eof:
        chunk = held
        if not held and getattr(unpack, "needs_input", True):  # lzma's holds its input itself
            chunk = data[place : place + _FED]
            place += len(chunk)
            if not chunk:
                raise EOFError("it ends before its end is marked")
        part = unpack.decompress(chunk, _STEP)
        held = getattr(unpack, "unconsumed_tail", b"")
        yield part, place - len(unpack.unused_data)


@contextlib.contextmanager
def write_bytes(
    path: str | os.PathLike[str], compression: Compression | Literal["by name"] | None = "by name"
) -> Iterator[BinaryIO]:
    """Context manager of an atomic binary output file; equal bytes give equal files."""
    if compression == "by name":
        compression = compression_by_name(path)
    with atomic_write(path) as file:
        if compression == "gzip":
            with gzip.GzipFile("", "wb", 6, fileobj=file, mtime=0) as packed:
                yield packed  # type: ignore[misc]
        elif compression == "xz":
            with lzma.LZMAFile(file, "wb", preset=3) as packed:
                yield packed  # type: ignore[misc]
        else:
            yield file


def suffix_of(path: str | os.PathLike[str]) -> str:
    """The suffix, without that of a compression."""
    _check_path(path)
    suffixes = [x.lower() for x in Path(path).suffixes]
    if suffixes and suffixes[-1] in (".gz", ".xz"):
        del suffixes[-1]
    return suffixes[-1] if suffixes else ""
