"""Reuse of the conversion of the latest model."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from functools import wraps
from typing import TypeVar

import jax

M = TypeVar("M")
R = TypeVar("R")


def keep_latest(convert: Callable[[M], R]) -> Callable[[M], R]:
    """Keeps the result for the latest model while that is alive and none of its arrays can change."""
    kept: dict[str, tuple[weakref.ref[M], R]] = {}

    @wraps(convert)
    def wrapper(model: M) -> R:
        latest = kept.get("latest")
        if latest is not None and latest[0]() is model:
            return latest[1]
        found = convert(model)
        if all(isinstance(x, jax.Array) for x in jax.tree.leaves(model)):
            kept["latest"] = weakref.ref(model, forget), found
        return found

    def forget(reference: weakref.ref[M]) -> None:
        latest = kept.get("latest")
        if latest is not None and latest[0] is reference:
            del kept["latest"]

    return wrapper
