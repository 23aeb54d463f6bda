"""Validated header of a HOA automaton, with its acceptance condition as parity or colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.automaton import condition_of
from jaxltl.core.automata.emerson_lei import MAX_COLORS, members, polarities, residual
from jaxltl.io.hoa.grammar import FALSE, KNOWN_HEADERS, TRUE, Item, Tree, error_at, unquoted

if TYPE_CHECKING:
    from lark import Token

MAX_PRIORITIES = 256  # nesting depth of the acceptance formula


@dataclass(frozen=True)
class HoaHeader:
    """Header fields; `states` may be None, for a header without ``States:``."""

    states: int | None
    start: Token
    propositions: tuple[str, ...]
    aliases: list[tuple[Token, Tree]]
    sets: int
    condition: Tree
    properties: frozenset[str]
    tool: str
    acceptance_name: str
    others: list[Item]  # that the format does not define
    line: int


def read_header(version: Token, items: list[Item]) -> HoaHeader:
    """Validates the header items and their consistency."""
    if version not in ("v1", "v1.1"):
        raise error_at(version.line, f"version {version} is unknown. Write the automaton as v1.")
    headers: dict[str, Item] = {}
    properties: list[str] = []
    aliases: list[tuple[Token, Tree]] = []
    others: list[Item] = []
    for key, *values in items:
        if key.type == "HEADERNAME" and key[0].isupper():  # capital: may change the semantics
            raise error_at(
                key.line,
                f"the header {key} is unknown and, by its capital, changes what the automaton "
                "means. Write the automaton without it.",
            )
        if key.type == "HEADERNAME":
            others.append([key, *values])
        elif key.type == "PROPERTIES":
            properties += values
        elif key.type == "ALIAS":
            aliases.append((values[0], values[1]))
        elif key.type in headers and key.type == "START":
            raise error_at(
                key.line,
                "there are several initial states. Only deterministic automata are read; "
                "determinise it first.",
            )
        elif key.type in headers:
            raise error_at(key.line, f"the header {key} is given twice. Keep one of them.")
        else:
            headers[key.type] = [key, *values]
    for missing, fix in (("Acceptance:", "Acceptance: 0 t"), ("Start:", "Start: 0")):
        if KNOWN_HEADERS[missing] not in headers:
            raise error_at(
                version.line, f"the header {missing} is missing. Add it, such as '{fix}'."
            )
    _, sets, condition = headers["ACCEPTANCE"]
    return HoaHeader(
        states=int(headers["STATES"][1]) if "STATES" in headers else None,
        start=only_target(headers["START"][1], "Start:"),
        propositions=_proposition_names(headers.get("AP")),
        aliases=aliases,
        sets=int(sets),
        condition=_condition(condition, int(sets)),
        properties=frozenset(properties),
        tool=unquoted(headers["TOOL"][1]) if "TOOL" in headers else "",
        acceptance_name=str(headers["ACC_NAME"][1]) if "ACC_NAME" in headers else "",
        others=others,
        line=version.line or 1,
    )


def _proposition_names(item: Item | None) -> tuple[str, ...]:
    if item is None:
        return ()
    key, count, *texts = item
    names = tuple(map(unquoted, texts))
    if len(names) != int(count):
        raise error_at(key.line, f"AP: counts {count} propositions and names {len(names)}. "
                               "Correct the number.")  # fmt: skip
    for i, name in enumerate(names):
        if name in names[:i]:
            raise error_at(key.line, f"AP: names {name!r} twice. Keep one of them.")
    return names


def only_target(targets: Sequence[Token], place: str) -> Token:
    """The single state of a conjunction; ValueError for universal branching."""
    if len(targets) > 1:
        raise error_at(
            targets[0].line,
            f"{place} {' & '.join(targets)} branches universally. Alternating automata are not "
            "read; turn it into a deterministic one first.",
        )
    return targets[0]


def _condition(tree: Tree, sets: int) -> Tree:
    """Acceptance formula over set indices, with `sets + x` for the complement of x."""
    if tree[0] in ("and", "or"):
        return (tree[0], *[_condition(part, sets) for part in tree[1:]])
    if tree[0] != "atom":
        return tree
    _, name, complemented, number = tree
    if name not in ("Fin", "Inf"):
        raise error_at(name.line, f"Acceptance: has {name}({number}). Only Fin and Inf are known.")
    return (name.lower(), set_number(number, sets) + (sets if complemented else 0))


def set_number(number: Token, sets: int) -> int:
    """Index of an acceptance set, checked against the declared count."""
    if int(number) >= sets:
        raise error_at(
            number.line,
            f"acceptance set {number} is out of range, since Acceptance: counts {sets}. "
            "Correct the one or the other.",
        )
    return int(number)


# --- acceptance ------------------------------------------------------------------------------


def acceptance_of(header: HoaHeader, delta: Integers, priority: Integers) -> str:
    """Acceptance type that the priorities allow and the `write_hoa` header names."""
    own = header.tool == "jaxltl"
    if own and header.acceptance_name == "parity":
        return "parity"
    kind, final = condition_of(priority), priority[:, 0] == 0
    weak = kind == "buchi" and (priority == priority[:, :1]).all()
    if own and weak and "weak" in header.properties:
        if header.properties & {"terminal", "cosafe"}:
            return "cosafe" if final[delta[final]].all() else kind
        return "safety" if not final[delta[~final]].any() else kind
    return kind


def decisive_sets(condition: Tree) -> tuple[list[tuple[int, bool]], bool] | None:
    """Order of acceptance sets by importance if the condition is a parity condition, else None.

    A set is decisive if visiting it infinitely often settles acceptance, given that the more
    important sets are not.
    """
    condition = residual(condition, 0, 0)
    order = []
    while condition not in (TRUE, FALSE):
        sets = _sets_of(condition)
        for number in dict.fromkeys((sets[0], sets[-1], *sets)):  # min or max parity, mostly
            outcome = residual(condition, 0, 1 << number)
            if outcome in (TRUE, FALSE):
                break
        else:
            return None
        order.append((number, outcome == TRUE))
        condition = residual(condition, 1 << number, 0)
    return order, condition == TRUE


def _sets_of(condition: Tree) -> list[int]:
    return members(reduce(or_, polarities(condition)))


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
    condition: Tree, marks: list[frozenset[int]], header: HoaHeader
) -> tuple[NDArray[np.int64], Tree]:
    """Acceptance sets of each edge as bit masks, and the condition over bit numbers."""
    condition = residual(condition, 0, 0)
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
