"""Process-algebraic composition of modules, ``system (A ||| B) || C endsystem``, as one over renamed actions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from jaxltl.core.language.expressions import LanguageError
from jaxltl.core.language.syntax import Composition, Module, Player, RewardStructure
from jaxltl.core.language.tokens import TokenReader

# An action as it is seen outside, "" for a hidden one, and the action of each module that takes part.
_Move = tuple[str, dict[str, str]]


def read_composition(reader: TokenReader) -> Composition:
    """Modules in parallel: ``||`` binds least, then ``|||``, then ``|[a, b]|``, then ``/ {a}`` and ``{a <- b}``."""
    left = _interleaved(reader)
    while reader.texts[reader.at : reader.at + 2] == ["|", "|"]:
        reader.at += 2
        left = Composition("||", reader.place, parts=(left, _interleaved(reader)))
    return left


def _interleaved(reader: TokenReader) -> Composition:
    left = _synchronised(reader)
    while reader.texts[reader.at : reader.at + 3] == ["|", "|", "|"]:
        reader.at += 3
        left = Composition("|||", reader.place, parts=(left, _synchronised(reader)))
    return left


def _synchronised(reader: TokenReader) -> Composition:
    left = _hidden(reader)
    while reader.texts[reader.at : reader.at + 2] == ["|", "["]:
        reader.at += 2
        actions = tuple(reader.separated(lambda: _action(reader)))
        reader.expect("]", " or ','")
        reader.expect("|", " after ']'")
        left = Composition("|[]|", reader.place, actions, (left, _hidden(reader)))
    return left


def _hidden(reader: TokenReader) -> Composition:
    place = reader.place
    if reader.accept("("):
        inner = read_composition(reader)
        reader.expect(")", " or an operator")
    else:
        inner = Composition(_word(reader, "the name of a module or '('"), place)
    while reader.texts[reader.at] in ("/", "{"):
        hides = reader.accept("/")
        reader.expect("{")
        pairs = reader.separated(lambda: _action(reader) if hides else _renamed(reader))  # noqa: B023
        reader.expect("}", " or ','")
        inner = Composition("/" if hides else "<-", place, tuple(pairs), (inner,))
    return inner


def _word(reader: TokenReader, expected: str) -> str:
    if reader.kinds[reader.at] != "word" or reader.texts[reader.at] == "endsystem":
        reader.fail(expected)
    reader.at += 1
    return reader.texts[reader.at - 1]


def _action(reader: TokenReader) -> tuple[str, str]:
    return _word(reader, "the name of an action"), ""


def _renamed(reader: TokenReader) -> tuple[str, str]:
    old, _ = _action(reader)
    reader.expect("<", " and '-', as in a <- b")
    reader.expect("-", " and the new name, as in a <- b")
    return old, _action(reader)[0]


def composed(
    system: Composition,
    modules: Sequence[Module],
    rewards: Sequence[RewardStructure],
    players: Sequence[Player],
) -> tuple[list[Module], tuple[RewardStructure, ...], tuple[Player, ...]]:
    """Modules, rewards and players of which actions with one name are those that synchronise.

    Raises:
      LanguageError: a module that is unknown, or that does not occur exactly once.
    """
    counts = Counter(_names(system))
    for m in modules:
        if counts.pop(m.name, 0) != 1:
            raise LanguageError(
                system.place, f"the module {m.name} must occur exactly once in the system block."
            )
    for name in counts:
        raise LanguageError(system.place, f"system: there is no module {name}.")
    moves = _moves(system, {m.name: m for m in modules})
    many = Counter(name for name, _ in moves)
    labels = [  # an action keeps its name if one set of modules takes it
        name if (name and many[name] == 1) or (not name and len(parts) == 1) else f"{name}#{i}"
        for i, (name, parts) in enumerate(moves, 1)
    ]
    of_name: dict[str, list[str]] = {"": [""]}
    for (name, _), label in zip(moves, labels, strict=True):
        if label not in of_name.setdefault(name, []):
            of_name[name].append(label)

    def changed(m: Module) -> Module:
        mine = [
            (x, parts[m.name])
            for x, (_, parts) in zip(labels, moves, strict=True)
            if m.name in parts
        ]
        commands = [
            replace(c, action=label)
            for c in m.commands
            for label, action in ([("", "")] if not c.action else mine)
            if action == c.action
        ]
        return replace(m, commands=tuple(commands))

    earned = [
        replace(
            r,
            items=tuple(
                replace(item, action=label)
                for item in r.items
                for label in ([None] if item.action is None else of_name.get(item.action, []))
            ),
        )
        for r in rewards
    ]
    owners = [
        replace(p, actions=tuple(x for action in p.actions for x in of_name.get(action, [action])))
        for p in players
    ]
    return [changed(m) for m in modules], tuple(earned), tuple(owners)


def _names(system: Composition) -> list[str]:
    if not system.parts:
        return [system.operator]
    return [name for part in system.parts for name in _names(part)]


def _moves(system: Composition, modules: dict[str, Module]) -> list[_Move]:
    """The actions of a composition, with the modules that take part."""
    if not system.parts:
        module = modules[system.operator]
        actions = dict.fromkeys(c.action for c in module.commands if c.action)
        return [(a, {module.name: a}) for a in actions]
    sides = [_moves(part, modules) for part in system.parts]
    changes = dict(system.actions)
    if system.operator in ("/", "<-"):
        return [(changes.get(name, name), parts) for name, parts in sides[0]]
    left, right = sides
    shared = set(changes)
    if system.operator != "|[]|":
        both = {name for name, _ in left} & {name for name, _ in right}
        shared = both - {""} if system.operator == "||" else set()
    alone = [move for move in left + right if move[0] not in shared]
    joint = [(a, x | y) for a, x in left if a in shared for b, y in right if a == b]
    return alone + joint
