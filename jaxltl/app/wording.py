"""Result types of jobs: JSON records of bounds, and their text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Result = Mapping[str, Any]  # contents of result.json
Record = dict[str, Any]  # values by name: JSON objects, keyword arguments


def enclosure(*numbers: object) -> Record:
    """A number with its lower and upper bound."""
    return dict(zip(("value", "lower", "upper"), numbers, strict=True))


def counted(number: int, noun: str) -> str:
    """Number with its noun, in the plural unless the number is 1."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
