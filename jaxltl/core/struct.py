"""Frozen dataclasses that are pytrees, distinguished by their type; interface of ``flax.struct``.

``jax.tree_util.register_dataclass``, on which ``flax.struct`` relies, compares structures without
the type in JAX 0.10: two classes with as many arrays and equal static fields have equal structures
but different hashes. A jitted function that is called with both then runs the program of the wrong
one whenever the hashes share a slot of its cache. Nodes with custom flatten functions are compared
by type.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any, TypeVar, dataclass_transform

import jax
from flax.struct import field

from jaxltl.core.pretty_print import brief, history
from jaxltl.core.status import Status

__all__ = ["Static", "dataclass", "field", "metrics", "register", "register_annotated_pytree"]

ClassT = TypeVar("ClassT")
_CODES = {"status": Status}


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
    """Decorator: a frozen dataclass with ``replace`` and a short ``repr``, a pytree of its fields.

    Fields made by ``field(pytree_node=False)`` are static: part of the structure, compared by value.
    """
    made: Any = brief(codes=_CODES)(dataclasses.dataclass(frozen=True, **options)(cls))
    made.replace = _replace
    static = [f.name for f in dataclasses.fields(made) if not f.metadata.get("pytree_node", True)]
    register(made, [f.name for f in dataclasses.fields(made) if f.name not in static], static)
    result: type[ClassT] = made
    return result


@dataclass_transform(frozen_default=True, field_specifiers=(field, dataclasses.field))
def metrics(cls: type[ClassT]) -> type[ClassT]:
    """Decorator: a :func:`dataclass` of a learner's metrics, whose ``repr`` shows the last row."""
    return brief(facts=partial(history, codes=_CODES))(dataclass(cls))


def _replace(self: Any, **updates: Any) -> Any:
    """A copy with the given fields replaced."""
    return dataclasses.replace(self, **updates)


@dataclass
class Static:
    """A hashable `value` as a static part of a pytree."""

    value: Any = field(pytree_node=False)


class _Text:
    """Values of text fields, equal to all others, since programs are the same for all."""

    def __init__(self, values: tuple[object, ...]) -> None:
        self.values = values

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Text)

    def __hash__(self) -> int:
        return 0


_Rest = tuple[tuple[object, ...], _Text]


def register_annotated_pytree(
    cls: type[ClassT], arrays: Iterable[str], static: Iterable[str], text: Mapping[str, object]
) -> type[ClassT]:
    """Registers a dataclass as a pytree with text, given by field with the value when traced.

    Text is equal to any other text in the pytree's structure and is dropped in traced arrays, so
    that formulas with automata of one shape share a compiled program.
    """
    arrays, static, names = tuple(arrays), tuple(static), tuple(text)

    def flatten(tree: ClassT) -> tuple[list[object], _Rest]:
        values = tuple(getattr(tree, name) for name in static)
        return [getattr(tree, name) for name in arrays], (
            values,
            _Text(tuple(getattr(tree, name) for name in names)),
        )

    def flatten_with_keys(tree: ClassT) -> tuple[list[tuple[object, object]], _Rest]:
        leaves, rest = flatten(tree)
        keys = map(jax.tree_util.GetAttrKey, arrays)
        return list(zip(keys, leaves, strict=True)), rest

    def unflatten(rest: _Rest, leaves: Iterable[object]) -> ClassT:
        values, shown = rest
        leaves = tuple(leaves)
        traced = any(isinstance(x, jax.core.Tracer) for x in leaves)
        return cls(
            **dict(zip(arrays, leaves, strict=True)),
            **dict(zip(static, values, strict=True)),
            **(text if traced else dict(zip(names, shown.values, strict=True))),
        )

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls
