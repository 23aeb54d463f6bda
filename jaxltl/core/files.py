"""Files: atomic writes, and archives of named arrays. This module does not import JAX."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """A binary file that appears under its name, `path`, when it is complete.

    Raises:
      ValueError: the directory cannot be written to, or the disk is full.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "note"
      >>> with atomic_write(path) as file:
      ...     path.exists()
      False
    """
    path = Path(path)
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise ValueError(
            f"cannot write {str(path)!r}: {error.strerror}; choose a directory that exists and is "
            "writable."
        ) from error
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        if isinstance(error, OSError) and error.errno in _FULL:
            raise ValueError(
                f"cannot write {str(path)!r}: {error.strerror}; free some space, or choose "
                "another directory."
            ) from error
        raise


def read_arrays(file: BinaryIO) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz`` `file`, by name; nothing in it is executed.

    Raises:
      ValueError: another format, or damaged; the message omits the file's name.

    Example:
      >>> import io
      >>> np.savez(file := io.BytesIO(), x=np.arange(3))
      >>> _ = file.seek(0)
      >>> read_arrays(file)["x"].tolist()
      [0, 1, 2]
    """
    start = file.read(6)
    file.seek(0)
    if start == np.lib.format.MAGIC_PREFIX:
        raise ValueError(
            "it holds a single array; numpy.savez(path, name=array) writes named ones."
        )
    arrays, place = {}, "it"
    try:
        if not start.startswith(b"PK"):
            raise zipfile.BadZipFile
        with np.load(file, allow_pickle=False) as archive:
            for name in archive.files:
                place = f"its array {name!r}"
                arrays[name] = archive[name]
                if not isinstance(arrays[name], np.ndarray):  # raw bytes, where it is no array
                    raise zipfile.BadZipFile
    except Exception as error:  # damaged bytes make numpy and zipfile raise almost anything
        if "Object arrays" in str(error):
            raise ValueError(
                f"{place} holds Python objects, such as None; save numbers, truth values or texts."
            ) from None
        raise ValueError(
            f"{place} is damaged, or not written by numpy.savez(path, name=array)."
        ) from None
    return arrays


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
