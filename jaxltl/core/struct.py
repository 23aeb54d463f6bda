"""Frozen dataclasses that are pytrees, distinguished by their type; interface of ``flax.struct``.

``jax.tree_util.register_dataclass``, on which ``flax.struct`` relies, compares structures without
the type in JAX 0.10: two classes with as many arrays and equal static fields have equal structures
but different hashes. A jitted function that is called with both then runs the program of the wrong
one whenever the hashes share a slot of its cache. Nodes with custom flatten functions are compared
by type.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, TypeVar, dataclass_transform

import jax
from flax.struct import field

__all__ = ["dataclass", "field", "register"]

ClassT = TypeVar("ClassT")


def register(cls: type, array_fields: Iterable[str], static_fields: Iterable[str] = ()) -> None:
    """Registers a dataclass as a pytree of `array_fields`, with the values of `static_fields`."""
    arrays, static = tuple(array_fields), tuple(static_fields)
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in arrays)

    def flatten(x: object) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        return tuple(getattr(x, f) for f in arrays), tuple(getattr(x, f) for f in static)

    def flatten_with_keys(x: object) -> tuple[tuple[tuple[Any, Any], ...], tuple[Any, ...]]:
        children, aux = flatten(x)
        return tuple(zip(keys, children, strict=True)), aux

    def unflatten(aux: tuple[Any, ...], children: Iterable[Any]) -> Any:
        return cls(
            **dict(zip(arrays, children, strict=True)), **dict(zip(static, aux, strict=True))
        )

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)


@dataclass_transform(frozen_default=True, field_specifiers=(field, dataclasses.field))
def dataclass(cls: type[ClassT], **options: Any) -> type[ClassT]:
    """Decorator: a frozen dataclass with ``replace``, registered as a pytree of its fields.

    Fields made by ``field(pytree_node=False)`` are static: part of the structure, compared by value.
    """
    made: Any = dataclasses.dataclass(frozen=True, **options)(cls)
    made.replace = _replace
    static = [f.name for f in dataclasses.fields(made) if not f.metadata.get("pytree_node", True)]
    register(made, [f.name for f in dataclasses.fields(made) if f.name not in static], static)
    return made


def _replace(self: Any, **updates: Any) -> Any:
    """A copy with the given fields replaced."""
    return dataclasses.replace(self, **updates)
