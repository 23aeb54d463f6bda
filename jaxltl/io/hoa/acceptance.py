"""HOA acceptance conditions as parity conditions where possible, else as colours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.io.hoa.grammar import FALSE, TRUE, Tree, error_at
from jaxltl.io.hoa.header import Header

MAX_COLORS = 62  # acceptance sets as bits of one int64


def acceptance_of(header: Header, delta: Integers, priority: Integers) -> str:
    """Acceptance type that the priorities allow and the `write_hoa` header names."""
    own = header.tool == "jaxltl"
    if priority.max() > 1 or (own and header.acceptance_name == "parity"):
        return "parity"
    final = priority[:, 0] == 0
    if own and "weak" in header.properties and (priority == priority[:, :1]).all():
        if header.properties & {"terminal", "cosafe"}:
            return "cosafe" if final[delta[final]].all() else "buchi"
        return "safety" if not final[delta[~final]].any() else "buchi"
    return "buchi"


def condition_given(condition: Tree, number: int, visited: bool) -> Tree:
    """Substitutes Inf(number) by `visited` and Fin(number) by its negation, and simplifies."""
    operator = condition[0]
    if operator in ("inf", "fin"):
        if condition[1] != number:
            return condition
        return TRUE if (operator == "inf") == visited else FALSE
    if operator not in ("and", "or"):
        return condition
    neutral, decisive = (TRUE, FALSE) if operator == "and" else (FALSE, TRUE)
    parts = []
    for operand in condition[1:]:
        part = condition_given(operand, number, visited)
        if part[0] == decisive[0]:
            return decisive
        if part[0] != neutral[0]:
            parts.append(part)
    if len(parts) > 1:
        return (operator, *parts)
    return parts[0] if parts else neutral


def _sets_of(condition: Tree) -> list[int]:
    sets: set[int] = set()
    stack = [condition]
    while stack:
        node = stack.pop()
        if node[0] in ("inf", "fin"):
            sets.add(node[1])
        else:
            stack += node[1:]
    return sorted(sets)


def decisive_sets(condition: Tree) -> tuple[list[tuple[int, bool]], bool] | None:
    """Order of acceptance sets by importance if the condition is a parity condition, else None.

    A set is decisive if visiting it infinitely often settles acceptance, given that the more
    important sets are not.
    """
    order = []
    while condition not in (TRUE, FALSE):
        sets = _sets_of(condition)
        for number in dict.fromkeys((sets[0], sets[-1], *sets)):  # min or max parity, mostly
            outcome = condition_given(condition, number, True)
            if outcome in (TRUE, FALSE):
                break
        else:
            return None
        order.append((number, outcome == TRUE))
        condition = condition_given(condition, number, False)
    return order, condition == TRUE


def edge_priority(
    marks: frozenset[int], sets: int, order: list[tuple[int, bool]], otherwise: bool
) -> int:
    """Min-even priority of an edge, from its most important acceptance set."""
    priority = 0
    for number, accepts in order:
        priority += (priority % 2 == 0) != accepts
        if _belongs(marks, number, sets):
            return priority
    return priority + ((priority % 2 == 0) != otherwise)


def _belongs(marks: frozenset[int], number: int, sets: int) -> bool:
    return number in marks if number < sets else number - sets not in marks


def colors_of(
    condition: Tree, marks: list[frozenset[int]], header: Header
) -> tuple[NDArray[np.int64], Tree]:
    """Acceptance sets of each edge as bit masks, and the condition over bit numbers."""
    sets = _sets_of(condition)
    if len(sets) > MAX_COLORS:
        raise error_at(
            header.line,
            f"the acceptance formula has {len(sets)} sets and is no parity condition; the limit "
            f"is {MAX_COLORS}. Let the tool that wrote it turn it into parity.",
        )

    def renumbered(node: Tree) -> Tree:
        if node[0] in ("inf", "fin"):
            return (node[0], sets.index(node[1]))
        return (node[0], *[renumbered(part) for part in node[1:]])

    colors = [
        sum(1 << i for i, number in enumerate(sets) if _belongs(edge, number, header.sets))
        for edge in marks
    ]
    return np.array(colors, np.int64), renumbered(condition)
