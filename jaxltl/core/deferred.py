"""Arrays of results that are computed when they are first read."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import DTypeLike


class Deferred:
    """An array that is computed once, when it is first read; it has an array's items and attributes."""

    def __init__(self, compute: Callable[[], np.ndarray]) -> None:
        self._compute: Callable[[], np.ndarray] | None = compute
        self._value: np.ndarray | None = None

    def read(self) -> np.ndarray:
        """The array."""
        if self._compute is not None:
            self._value, self._compute = np.asarray(self._compute()), None
        assert self._value is not None
        return self._value

    def __getattr__(self, name: str) -> object:
        if name.startswith("_"):
            raise AttributeError(name)
        value: object = getattr(self.read(), name)
        return value

    def __getitem__(self, place: int | slice | np.ndarray) -> object:
        return self.read()[place]

    def __len__(self) -> int:
        return len(self.read())

    def __iter__(self) -> Iterator[object]:
        return iter(self.read())

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        return self.read() if dtype is None else self.read().astype(dtype)

    def __reduce__(self) -> tuple[object, tuple[np.ndarray]]:
        return np.asarray, (self.read(),)


def deferred_field(place: int, text: str) -> property:
    """A field of a NamedTuple that may be :class:`Deferred`, read as an array."""

    def read(self: tuple[object, ...]) -> object:
        value = self[place]
        return value.read() if isinstance(value, Deferred) else value

    read.__doc__ = text
    return property(read)
