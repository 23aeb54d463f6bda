"""Arrays of results that are computed when they are first read."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import DTypeLike

Array: TypeAlias = Any  # a NumPy array or a JAX array


class Deferred:
    """An array that is computed once, when it is first read; `like` has its shape and dtype."""

    def __init__(self, compute: Callable[[], Array], like: Array = None) -> None:
        self._compute: Callable[[], Array] | None = compute
        self._value: Array = None
        self.like = like

    def read(self) -> Array:
        """The array."""
        compute = self._compute
        if compute is not None:  # another thread may do the same
            self._value = compute()
            self._compute = None
        return self._value

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self.read(), dtype)

    def __reduce__(self) -> tuple[object, tuple[Array]]:
        return _same, (self.read(),)


def _same(value: Array) -> Array:
    return value


def mapped(array: Array, function: Callable[[Array], Array]) -> Array:
    """A function of an array, deferred if the array is."""
    if not isinstance(array, Deferred):
        return function(array)
    return Deferred(lambda: function(array.read()), function(array.like))


def deferred_field(place: int, text: str) -> property:
    """A field of a NamedTuple that may be :class:`Deferred`, read as an array."""

    def read(self: tuple[object, ...]) -> object:
        value = self[place]
        return value.read() if isinstance(value, Deferred) else value

    read.__doc__ = text
    return property(read)


class DeferredAttribute:
    """A field of a frozen dataclass that may be :class:`Deferred`, read as an array."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __get__(self, instance: object | None, owner: type | None = None) -> Array:
        if instance is None:
            return self
        value = stored(instance, self.name)
        return value.read() if isinstance(value, Deferred) else value

    def __set__(self, instance: object, value: object) -> None:
        vars(instance)[self.name] = value


def stored(instance: object, name: str) -> Array:
    """The field of a dataclass without reading it, perhaps :class:`Deferred`."""
    try:
        return vars(instance)[name]
    except KeyError:
        raise AttributeError(f"{type(instance).__name__} has no {name}.") from None
