"""Frozen dataclasses that are pytrees, distinguished by their type; interface of ``flax.struct``.

``jax.tree_util.register_dataclass``, on which ``flax.struct`` relies, compares structures without
the type in JAX 0.10: two classes with as many arrays and equal static fields have equal structures
but different hashes. A jitted function that is called with both then runs the program of the wrong
one whenever the hashes share a slot of its cache. Nodes with custom flatten functions are compared
by type.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from functools import wraps
from types import MappingProxyType
from typing import Any, TypeVar, dataclass_transform

import jax
from flax.struct import field

from jaxltl.core.pretty_print import brief
from jaxltl.core.suggestions import unknown_keyword

__all__ = ["Static", "dataclass", "field", "register"]

ClassT = TypeVar("ClassT")


class _TextField:
    """Values of text fields, equal to all others, since programs are the same for all."""

    def __init__(self, values: tuple[object, ...]) -> None:
        self.values = values

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _TextField)

    def __hash__(self) -> int:
        return 0


def register(
    cls: type[ClassT],
    arrays: Iterable[str],
    static: Iterable[str] = (),
    text: Mapping[str, object] = MappingProxyType({}),
) -> type[ClassT]:
    """Registers a dataclass as a pytree of `arrays`, with the values of the fields `static` and `text`.

    Text, given by field with the value when traced, is equal to any other text in the pytree's
    structure and is dropped in traced arrays, so that formulas with automata of one shape share a
    compiled program.
    """
    arrays, static = tuple(arrays), tuple(static)
    names, first, last = (*arrays, *static, *text), len(arrays), len(arrays) + len(static)
    keys = tuple(jax.tree_util.GetAttrKey(name) for name in arrays)

    def flatten(tree: ClassT) -> tuple[tuple[object, ...], tuple[object, ...]]:
        fields = tuple([getattr(tree, name) for name in names])
        return fields[:first], (fields[first:last], _TextField(fields[last:]))

    def flatten_with_keys(
        tree: ClassT,
    ) -> tuple[tuple[tuple[object, object], ...], tuple[object, ...]]:
        leaves, rest = flatten(tree)
        return tuple(zip(keys, leaves, strict=True)), rest

    def unflatten(rest: tuple[Any, ...], leaves: Iterable[object]) -> ClassT:
        leaves, (values, texts) = tuple(leaves), rest
        private_values = (
            text.values() if any(isinstance(x, jax.core.Tracer) for x in leaves) else texts.values
        )
        return cls(**dict(zip(names, (*leaves, *values, *private_values), strict=True)))

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


@dataclass_transform(frozen_default=True, field_specifiers=(field, dataclasses.field))
def dataclass(cls: type[ClassT], **options: Any) -> type[ClassT]:
    """Decorator: a frozen dataclass with ``replace`` and a short ``repr``, a pytree of its fields.

    Fields made by ``field(pytree_node=False)`` are static: part of the structure, compared by value.
    """
    result: Any = brief(dataclasses.dataclass(frozen=True, **options)(cls))
    result.replace = _replace
    result.__init__ = _suggesting(result.__init__, result)
    static = [f.name for f in dataclasses.fields(result) if not f.metadata.get("pytree_node", True)]
    arrays = [f.name for f in dataclasses.fields(result) if f.name not in static]
    return register(result, arrays, static)


def _suggesting(init: Callable[..., None], cls: type) -> Callable[..., None]:
    """The constructor of a dataclass, with a suggestion in place of an unknown keyword."""

    @wraps(init)
    def wrapper(self: object, *args: object, **fields: object) -> None:
        try:
            init(self, *args, **fields)
        except TypeError:
            known = [f.name for f in dataclasses.fields(cls) if f.init]
            for name in fields.keys() - set(known):
                raise unknown_keyword(cls.__qualname__, name, known) from None
            raise

    return wrapper


def _replace(self: Any, **updates: Any) -> Any:
    """A copy with the given fields replaced."""
    return dataclasses.replace(self, **updates)


@dataclass
class Static:
    """A hashable `value` as a static part of a pytree."""

    value: Any = field(pytree_node=False)
