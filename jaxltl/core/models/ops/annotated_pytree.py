"""Pytrees annotated with text that compiled programs do not depend on.

Text is equal to any other text in the pytree's structure and is dropped in traced arrays, so that
formulas with automata of one shape share a compiled program.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeVar

import jax

ClassT = TypeVar("ClassT")


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
    """Registers a dataclass as a pytree with text, given by field with the value when traced."""
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
