"""Result types of jobs: JSON records of bounds and state positions, and their text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

Result = Mapping[str, Any]  # contents of result.json
Record = dict[str, Any]  # values by name: JSON objects, keyword arguments


def state_position(state: int, shape: Sequence[int] | None) -> Record:
    """A state's number from 0 and, on a map of a shape, its row and column from 1."""
    if shape is None:
        return {"state": int(state)}
    row, column = divmod(int(state), shape[1])
    return {"state": int(state), "row": row + 1, "column": column + 1}


def enclosure(*numbers: object) -> Record:
    """A number with its lower and upper bound."""
    return dict(zip(("value", "lower", "upper"), numbers, strict=True))


def position_text(where: Result) -> str:
    """Text of a position: row and column on a map, else the state's name or number."""
    if "row" in where:
        return f"row {where['row']}, column {where['column']}"
    return f"state {where.get('name', where['state'])}"


def counted(number: int, noun: str) -> str:
    """Number with its noun, in the plural unless the number is 1."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
