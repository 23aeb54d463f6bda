"""Streaming reader of POSIX tar archives (ustar, long names, large sizes), and a writer.

Member sizes are not trusted beyond the available bytes, and nothing is extracted to disk.
"""

from __future__ import annotations

import re
import tarfile
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from jaxltl.io.files import FileBytes

_BLOCK = 512
_LONGEST_NAME = 2**16  # bytes of an extended header
_REGULAR = b"0\x007"
_RECORD = re.compile(rb"([0-9]{1,6}) ([^=\n]{1,200})=")
_NO_DATA = b"123456"  # links, devices and directories

_STEP = 2**20  # bytes of a file that are read at a time


class Stream:
    """Sequential reader of a file or of byte pieces; skipped bytes of a file are not read."""

    def __init__(self, source: Iterator[bytes] | FileBytes, place: str):
        self._source, self._held, self.place, self.position = source, memoryview(b""), place, 0

    def _some(self, limit: int) -> memoryview:
        """Between 1 and `most` bytes; empty at the end."""
        while not self._held:
            if isinstance(self._source, FileBytes):
                piece = self._source[self.position : self.position + _STEP] or None
            else:
                piece = next(self._source, None)
            if piece is None:
                return self._held
            self._held = memoryview(piece)
        some, self._held = self._held[:limit], self._held[limit:]
        self.position += len(some)
        return some

    def fill(self, target: bytearray | NDArray[np.uint8], subject: str) -> None:
        """Fills a uint8 array or bytearray; ValueError at a premature end."""
        view, done = memoryview(target), 0  # type: ignore[arg-type]  # a Buffer since Python 3.12
        while done < len(view):
            some = self._some(len(view) - done)
            if not some:
                raise ValueError(
                    f"{self.place}{subject}: the archive ends after {done} of "
                    f"{len(view)} bytes; it is cut off."
                )
            view[done : done + len(some)] = some
            done += len(some)

    def skip(self, count: int, subject: str) -> None:
        """Skips bytes; ValueError at a premature end."""
        end = self.position + count
        if isinstance(self._source, FileBytes) and count > len(self._held):
            self._held, self.position = memoryview(b""), min(end, len(self._source))
        while self.position < end:
            if not self._some(end - self.position):
                raise ValueError(
                    f"{self.place}{subject}: the archive ends within it; it is cut off."
                )

    def drain(self) -> None:
        """Reads to the end, which verifies the checksum of a compressed stream."""
        while self._some(2**20):
            pass


def members(stream: Stream) -> Iterator[tuple[str, int]]:
    """Names and sizes of regular files; after each, the stream is at the start of its contents."""
    long_name: str | None = None
    long_size: int | None = None
    first = True
    while True:
        header = bytearray(_BLOCK)
        stream.fill(header, "its first header" if first else "the header of a member")
        if not any(header):
            break
        kind, name, size = _read_header(bytes(header), stream.place, first)
        first = False
        if kind in b"xL":
            content = _extension(stream, name, size)
            if kind == b"L":
                long_name = _text(content.split(b"\0")[0], stream.place)
            else:
                long_name, long_size = _extended(content, stream.place, long_name)
            continue
        if kind in b"gK":
            _extension(stream, name, size)
            continue
        if kind in _NO_DATA:
            size = 0
        elif long_size is not None:
            size = long_size
        name = _checked_name(name if long_name is None else long_name, stream.place)
        long_name = long_size = None
        end = stream.position + size + -size % _BLOCK
        if kind in _REGULAR and not name.endswith("/"):
            yield name, size
        stream.skip(end - stream.position, f"{name!r}")
    stream.drain()


def _read_header(header: bytes, place: str, first: bool) -> tuple[bytes, str, int]:
    """Type, name and size of a member header."""
    if header[257:262] != b"ustar":
        if first:
            raise ValueError(f"{place}this is no tar archive: 'ustar' is missing at byte 257.")
        raise ValueError(f"{place}the header of a member lacks 'ustar'; the archive is damaged.")
    name = header[:100].split(b"\0")[0]
    if header[257:263] == b"ustar\0" and header[345]:
        name = header[345:500].split(b"\0")[0] + b"/" + name
    decoded = _text(name, place)
    stored = _number(header[148:156], f"{place}{decoded!r}: its checksum")
    checksum = sum(header) - sum(header[148:156]) + 8 * 32
    if stored != checksum:
        raise ValueError(
            f"{place}{decoded!r}: the checksum of its header is {stored}, expected "
            f"{checksum}; the archive is damaged."
        )
    return header[156:157], decoded, _number(header[124:136], f"{place}{decoded!r}: its size")


def _number(field: bytes, subject: str) -> int:
    """Octal field, or binary if the first bit is set (GNU)."""
    if field[0] == 0x80:
        return int.from_bytes(field[1:], "big")
    digits = field.split(b"\0")[0].strip(b" ")
    if not re.fullmatch(rb"[0-7]*", digits):
        raise ValueError(f"{subject} is {digits!r}; expected octal digits.")
    return int(digits or b"0", 8)


def _text(name: bytes, place: str) -> str:
    try:
        return name.decode()
    except UnicodeDecodeError:
        raise ValueError(f"{place}a member is named {name[:60]!r}, which is not UTF-8.") from None


def _extension(stream: Stream, name: str, size: int) -> bytes:
    """Contents of an extended header."""
    if size > _LONGEST_NAME:
        raise ValueError(
            f"{stream.place}{name!r}: an extended header of {size} bytes; at most "
            f"{_LONGEST_NAME} are read."
        )
    content = bytearray(size)
    stream.fill(content, f"{name!r}")
    stream.skip(-size % _BLOCK, f"{name!r}")
    return bytes(content)


def _extended(content: bytes, place: str, name: str | None) -> tuple[str | None, int | None]:
    """Name and size overrides of a POSIX extended header."""
    size, place_in = None, 0
    while place_in < len(content):
        record = _RECORD.match(content, place_in)
        end = place_in + int(record[1]) if record else 0
        if not record or not record.end() < end <= len(content):
            raise ValueError(
                f"{place}an extended header reads {content[place_in : place_in + 40]!r}; expected "
                "records of a length, a key and a value."
            )
        value, place_in = content[record.end() : end - 1], end
        if record[2] == b"path":
            name = _text(value, place)
        elif record[2] == b"size":
            if not re.fullmatch(rb"[0-9]{1,19}", value):
                raise ValueError(
                    f"{place}an extended header gives the size {value[:40]!r}; expected digits."
                )
            size = int(value)
    return name, size


def _checked_name(name: str, place: str) -> str:
    """Member name without leading ./; ValueError for paths outside the archive."""
    parts = name.split("/")
    while parts[0] == ".":
        del parts[0]
        if not parts:
            return "/"
    inner = parts[:-1] if parts[-1] == "" else parts
    if any(part in ("", "..") for part in inner) or re.search(r"[\0-\x1f\x7f\\:]", name):
        raise ValueError(
            f"{place}a member is named {name[:100]!r}; expected a path within the "
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


_GZIP_BLOCK = 2**20
_PROBED = 2**15


def write_gzip(file: BinaryIO, pieces: Iterator[memoryview], threads: int = 4) -> None:
    """Writes a gzip stream, compressed by threads in fixed blocks: the output is deterministic."""
    file.write(b"\x1f\x8b\x08\0\0\0\0\0\0\xff")
    checksum = size = 0
    with ThreadPoolExecutor(threads) as pool:
        waiting: list[Future[bytes]] = []
        for block in _blocks(pieces):
            waiting.append(pool.submit(_deflated, block))
            checksum, size = zlib.crc32(block, checksum), size + len(block)
            if len(waiting) > 2 * threads:
                file.write(waiting.pop(0).result())
        for done in waiting:
            file.write(done.result())
    file.write(b"\x03\x00")  # an empty last block
    file.write(checksum.to_bytes(4, "little") + (size % 2**32).to_bytes(4, "little"))


def _blocks(pieces: Iterator[memoryview]) -> Iterator[bytes | memoryview]:
    """Splits large pieces into blocks and merges small ones."""
    held = bytearray()
    for piece in pieces:
        if len(piece) < _GZIP_BLOCK:
            held += piece
        else:
            if held:
                yield bytes(held)
                held.clear()
            yield from (piece[i : i + _GZIP_BLOCK] for i in range(0, len(piece), _GZIP_BLOCK))
        if len(held) >= _GZIP_BLOCK:
            yield bytes(held)
            held.clear()
    if held:
        yield bytes(held)


def _deflated(block: bytes | memoryview) -> bytes:
    """Deflate block flushed to a byte boundary, so that blocks can be concatenated."""

    def deflate(data: bytes | memoryview, strategy: int) -> bytes:
        packer = zlib.compressobj(1, zlib.DEFLATED, -15, 9, strategy)
        return packer.compress(data) + packer.flush(zlib.Z_SYNC_FLUSH)

    # Matching is slow on incompressible data such as random probabilities: use run lengths there.
    middle = (len(block) - _PROBED) // 2
    probe = block[max(middle, 0) : max(middle, 0) + _PROBED]
    repeats = len(deflate(probe, zlib.Z_DEFAULT_STRATEGY)) < 0.7 * len(probe)
    return deflate(block, zlib.Z_DEFAULT_STRATEGY if repeats or middle <= 0 else zlib.Z_RLE)
