"""Choices of all states of a program as one short list, without exploration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from math import prod

import numpy as np

from jaxltl.core.array_types import Booleans
from jaxltl.core.language.compiled import compile_expressions
from jaxltl.core.language.expressions import Expression, conjuncts, names_in
from jaxltl.core.language.source import LanguageError
from jaxltl.core.language.syntax import Command, Program, Variable

MAX_CHOICES = 4096
_GRID = 2**12  # values of the variables of a condition that are enumerated


@dataclass(frozen=True)
class Group:
    """Commands of a module with the same action, of which at most one is enabled in a state."""

    module: int
    action: str
    commands: tuple[Command, ...]
    draw: int  # number of the random draw, among those of a synchronised choice


@dataclass(frozen=True)
class Choice:
    """A group of each module that takes part in a synchronisation."""

    name: str
    action: str
    groups: tuple[int, ...]


def list_choices(program: Program) -> tuple[tuple[Group, ...], tuple[Choice, ...]]:
    """Groups of commands, and the choices that they form.

    Two commands are in one group if their guards exclude each other, by the values of at most a few
    variables. Choices without an action come first, by module, then those of each action.

    Raises:
      ValueError: more than 4096 choices.
    """
    groups: list[Group] = []
    choices: list[Choice] = []
    variables = {v.name: v for v in program.variables}
    actions = sorted({c.action for m in program.modules for c in m.commands if c.action})
    everywhere = range(len(program.modules))
    cells = [(m.name, "", range(i, i + 1)) for i, m in enumerate(program.modules)]
    cells += [(a, a, everywhere) for a in actions]
    for name, action, modules in cells:
        parts, draw = [], 0
        for m in modules:
            commands = [c for c in program.modules[m].commands if c.action == action]
            if not commands:
                continue
            slots: dict[int, list[Command]] = {}
            for c, slot in zip(commands, _colours(_overlap(commands, variables)), strict=True):
                slots.setdefault(slot, []).append(c)
            parts.append(range(len(groups), len(groups) + len(slots)))
            groups += [Group(m, action, tuple(slots[k]), draw) for k in sorted(slots)]
            draw += any(len(c.outcomes) > 1 for c in commands)
        number = prod(map(len, parts)) if parts else 0
        if len(choices) + number > MAX_CHOICES:
            raise program.source.located(
                LanguageError(
                    program.modules[modules[0]].place,
                    f"a state may have {len(choices) + number} choices, more than {MAX_CHOICES}, "
                    f"as the commands of [{action}] may be enabled together; make their guards "
                    "disjoint, or build the model.",
                )
            )
        for k, joint in enumerate(product(*parts) if parts else ()):
            choices.append(Choice(name if number == 1 else f"{name} {k + 1}", action, joint))
    if not choices:
        raise program.source.located(LanguageError(0, "the program has no commands to simulate."))
    return tuple(groups), tuple(choices)


def _overlap(commands: Sequence[Command], variables: dict[str, Variable]) -> Booleans:
    """``bool[C, C]``: False where two guards are known to exclude each other."""
    parts = [conjuncts(c.guard) for c in commands]
    supports = {frozenset(names_in(e) & variables.keys()) for some in parts for e in some}
    overlap = np.ones((len(commands), len(commands)), bool)
    for support in sorted(supports, key=sorted):
        ranges = [variables[n] for n in sorted(support)]
        if prod(v.high - v.low + 1 for v in ranges) > _GRID:
            continue
        held = np.stack([_holds(some, ranges) for some in parts]).astype(np.float32)
        overlap &= held @ held.T > 0
    return overlap


def _holds(conditions: Sequence[Expression], ranges: Sequence[Variable]) -> Booleans:
    """Values of the variables at which all conditions on no other ones hold."""
    axes = [np.arange(v.low, v.high + 1) for v in ranges]
    grid = np.meshgrid(*axes, indexing="ij") if axes else []
    values = {
        v.name: x.ravel() != 0 if v.type == "bool" else x.ravel()
        for v, x in zip(ranges, grid, strict=True)
    }
    truth = np.ones(prod(map(len, axes)), bool)
    for condition in compile_expressions([e for e in conditions if names_in(e) <= values.keys()])(
        values
    ):
        truth &= condition
    return truth


def _colours(overlap: Booleans) -> list[int]:
    """Greedy colouring: overlapping commands have different colours."""
    colour: list[int] = []
    for i in range(len(overlap)):
        taken = {c for j, c in enumerate(colour) if overlap[i, j]}
        colour.append(next(c for c in range(i + 1) if c not in taken))
    return colour
