"""Reader of POSIX tar archives by name and size of each member, and a writer.

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
