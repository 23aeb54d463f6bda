"""Validated header of a HOA automaton."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jaxltl.io.hoa.grammar import KNOWN_HEADERS, Item, Tree, error_at, unquoted

if TYPE_CHECKING:
    from lark import Token

MAX_PRIORITIES = 256  # nesting depth of the acceptance formula


@dataclass(frozen=True)
class Header:
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
    line: int


def read_header(version: Token, items: list[Item]) -> Header:
    """Validates the header items and their consistency."""
    if version not in ("v1", "v1.1"):
        raise error_at(version.line, f"version {version} is unknown. Write the automaton as v1.")
    headers: dict[str, Item] = {}
    properties: list[str] = []
    aliases: list[tuple[Token, Tree]] = []
    for key, *values in items:
        if key.type == "HEADERNAME":
            if key[0].isupper():  # capital: may change the semantics
                raise error_at(
                    key.line,
                    f"the header {key} is unknown and, by its capital, changes what the automaton "
                    "means. Write the automaton without it.",
                )
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
    return _checked_header(version, headers, aliases, frozenset(properties))


def _checked_header(
    version: Token,
    headers: dict[str, Item],
    aliases: list[tuple[Token, Tree]],
    properties: frozenset[str],
) -> Header:
    for missing, fix in (("Acceptance:", "Acceptance: 0 t"), ("Start:", "Start: 0")):
        if KNOWN_HEADERS[missing] not in headers:
            raise error_at(
                version.line, f"the header {missing} is missing. Add it, such as '{fix}'."
            )
    _, sets, condition = headers["ACCEPTANCE"]
    return Header(
        states=int(headers["STATES"][1]) if "STATES" in headers else None,
        start=only_target(headers["START"][1], "Start:"),
        propositions=_proposition_names(headers.get("AP")),
        aliases=aliases,
        sets=int(sets),
        condition=_condition(condition, int(sets)),
        properties=properties,
        tool=unquoted(headers["TOOL"][1]) if "TOOL" in headers else "",
        acceptance_name=str(headers["ACC_NAME"][1]) if "ACC_NAME" in headers else "",
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
