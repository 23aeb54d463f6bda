"""Binary file access: transparent decompression, bounded size and atomic writes."""

from __future__ import annotations

import contextlib
import gzip
import io
import lzma
import os
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, Literal

from jaxltl.core.files import atomic_write
from jaxltl.core import validation
from jaxltl.core.validation import errors_in

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
    if compression_of(data) is None:
        return data
    with errors_in(f"{str(path)!r}: "):
        return b"".join(pieces(io.BytesIO(data), limit))


def raw_bytes(path: str | os.PathLike[str], limit: int = MAX_BYTES) -> bytes:
    """Contents of a file without decompression, at most `limit` bytes."""
    with opened(path) as file:
        return b"".join(_parts(file, limit))


def streamed(path: str | os.PathLike[str], limit: int = MAX_BYTES) -> Iterator[bytes]:
    """Decompressed contents of a file in pieces."""
    with opened(path) as file:
        yield from pieces(file, limit)


@contextlib.contextmanager
def opened(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Opens a file for reading; errors become ValueErrors with its name."""
    _check_path(path)
    try:
        file = open(path, "rb")  # noqa: SIM115 - a null byte in the name is a ValueError here only
    except (OSError, ValueError) as error:
        raise _unreadable(path, error) from None
    try:
        with file, errors_in(f"{str(path)!r}: "):
            yield file
    except (OSError, MemoryError) as error:
        raise _unreadable(path, error) from None


def _check_path(path: object) -> None:
    if not isinstance(path, str | os.PathLike):  # integers would be file descriptors
        raise ValueError(f"path is {validation.shorten(path)}; give the name of a file.")


def _unreadable(path: str | os.PathLike[str], error: Exception) -> ValueError:
    # A null byte in the name makes a ValueError.
    reason = getattr(error, "strerror", None) or str(error) or "too large for the memory"
    return ValueError(f"cannot read {str(path)!r}: {reason}.")


def _parts(file: BinaryIO, limit: int) -> Iterator[bytes]:
    """Contents of a file as they are; ValueError beyond `limit` bytes."""
    size = 0
    while part := file.read(_STEP):
        size += len(part)
        if size > limit:
            raise ValueError(f"it has more than {limit} bytes, the most that are read.")
        yield part


def pieces(file: BinaryIO, limit: int = MAX_BYTES) -> Iterator[bytes]:
    """Decompressed contents of an open file, with the size bounds of :func:`read_bytes`."""
    parts = _parts(file, limit)
    first = next(parts, b"")
    kind = compression_of(first)
    if kind is None:
        yield first
        yield from parts
        return
    if not file.seekable():
        file = io.BytesIO(b"".join([first, *parts]))
    packed, size = file.seek(0, io.SEEK_END), 0
    file.seek(0)
    allowed = min(limit, ALWAYS_ALLOWED + MAX_RATIO * packed)
    try:
        for part in _decompressed(file, kind):
            size += len(part)
            if size > allowed:
                raise ValueError(
                    f"it is {packed} bytes of {kind} and holds more than {allowed} bytes; decompress "
                    "it first if this size is intended."
                )
            yield part
    except (zlib.error, lzma.LZMAError, EOFError, MemoryError) as error:
        reason = error or "out of memory"
        raise ValueError(f"it has the header of {kind} and is damaged: {reason}.") from None


def _decompressed(file: BinaryIO, kind: Compression) -> Iterator[bytes]:
    unpack: zlib._Decompress | lzma.LZMADecompressor
    while data := file.read(_FED):  # streams one after another, and zeros as padding
        if not data.startswith(_BEGINS[kind]):
            data += file.read()
            if any(data):
                raise ValueError(f"{len(data)} bytes follow the {kind} data; remove them.")
            return
        if kind == "gzip":
            unpack = zlib.decompressobj(wbits=31)
        else:
            unpack = lzma.LZMADecompressor(lzma.FORMAT_XZ, memlimit=_XZ_MEMORY)
        while not unpack.eof:
            yield unpack.decompress(data, _STEP)
            data = getattr(unpack, "unconsumed_tail", b"")
            if not data and not unpack.eof and getattr(unpack, "needs_input", True):
                data = file.read(_FED)  # lzma's decompressor holds its input itself
                if not data:
                    raise EOFError("it ends before its end is marked")
        file.seek(-len(unpack.unused_data), io.SEEK_CUR)


class _Forward(io.RawIOBase):
    """Pieces of bytes as a file that is read forwards."""

    def __init__(self, parts: Iterator[bytes]) -> None:
        self._parts, self._held, self._position = parts, memoryview(b""), 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def readinto(self, target: memoryview) -> int:  # type: ignore[override]
        while not self._held and (part := next(self._parts, None)) is not None:
            self._held = memoryview(part)
        count = min(len(target), len(self._held))
        target[:count] = self._held[:count]
        self._held = self._held[count:]
        self._position += count
        return count

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        while whence == io.SEEK_SET and self._position < offset:
            if not self.read(min(offset - self._position, _STEP)):
                break
        return self._position


def decompressed(file: BinaryIO, limit: int = MAX_BYTES) -> BinaryIO:
    """A file with the decompressed contents of another, to be read forwards."""
    return io.BufferedReader(_Forward(pieces(file, limit)), _STEP)


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


def compression_of(data: bytes) -> Compression | None:
    """Compression of a file by its first bytes, or None."""
    return next((kind for kind, begin in _BEGINS.items() if data.startswith(begin)), None)


def compression_by_name(path: str | os.PathLike[str]) -> Compression | None:
    """Compression of a file by its suffix, or None."""
    return _SUFFIX.get(Path(path).suffix.lower())


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
