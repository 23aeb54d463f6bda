"""Breadth-first search state by state, while levels are too small for arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import prod
from typing import Any

import numpy as np

from jaxltl.core.language.expressions import Expression, SCALAR
from jaxltl.core.language.syntax import Command, Module, Program
from jaxltl.core.programs.packed_states import Layout, Words
from jaxltl.core.programs.local_choices import ModuleCode, fixed_probabilities, may_leave
from jaxltl.core.validation import ROW_SUM_TOLERANCE


# Joint updates of a state as (difference of the packed state, probability).
Updates = tuple[tuple[int, float], ...]
Local = Callable[[int], tuple[list[Updates], ...]]  # of a packed state, for each action

_MAX_SIZE = 20_000  # nodes of a module's expressions; compilation takes a microsecond for each
_INFIX = {
    "&": " and ",
    "|": " or ",
    "=": " == ",
    "<=>": " == ",
    "!=": " != ",
    **{x: f" {x} " for x in ("<", "<=", ">", ">=", "+", "-", "*")},
}


class Unsupported(Exception):
    """A state or a program that is left to the vectorised search, which also names errors."""


def generate(module: Module, actions: tuple[str, ...], layout: Layout) -> Local:
    """A function of packed states to the enabled commands of a module, for each of its actions;
    raises Unsupported for a module that is too large or too deep for Python's compiler."""
    if sum(e.size for c in module.commands for e in c.expressions) > _MAX_SIZE:
        raise Unsupported
    local = {name: f"v{i}" for i, name in enumerate(sorted(module.names))}
    lines = ["def local(s):"]
    for name, code in local.items():
        field = layout.fields[name]
        v, shift = field.variable, field.shift + 64 * field.word
        lines.append(f"    {code} = ((s >> {shift}) & {(1 << v.bits) - 1}) + {v.low}")
    lines += [f"    a{i} = []" for i in range(len(actions))]
    for c in module.commands:
        lines.append(f"    if {_source(c.guard, local)}:")
        lines += [f"        {x}" for x in _command(c, actions.index(c.action), layout, local)]
    lines.append(f"    return {', '.join(f'a{i}' for i in range(len(actions)))},")
    space: dict[str, Any] = {"apply": SCALAR, "check": _check, "Unsupported": Unsupported}
    try:
        exec(compile("\n".join(lines), "<generated>", "exec"), space)
    except (SyntaxError, RecursionError, MemoryError):
        raise Unsupported from None
    local_function: Local = space["local"]
    return local_function


def _command(c: Command, column: int, layout: Layout, local: dict[str, str]) -> list[str]:
    """Lines that append the updates of an enabled command."""
    lines, pairs = [], []
    for k, o in enumerate(c.outcomes):
        change = ["0"]
        for i, a in enumerate(o.assignments):
            field = layout.fields[a.variable]
            v, new = field.variable, f"n{k}_{i}"
            lines.append(f"{new} = {_source(a.expression, local)}")
            if may_leave(v, a.expression):
                lines.append(f"if {new} < {v.low} or {new} > {v.high}: raise Unsupported")
            change.append(f"(({new} - {local[a.variable]}) << {field.shift + 64 * field.word})")
        pairs.append(f"({' + '.join(change)}, {_source(o.probability, local)})")
    updates = f"({', '.join(pairs)},)"
    if fixed_probabilities(c) is None:
        updates = f"check({updates})"
    return [*lines, f"a{column}.append({updates})"]


def _check(updates: Any) -> Updates:
    """Updates with positive probabilities, which must sum to one."""
    total = sum([p for _, p in updates])
    if not abs(total - 1) <= ROW_SUM_TOLERANCE or min([p for _, p in updates]) < 0:
        raise Unsupported
    return tuple([(d, float(p)) for d, p in updates if p])


def _source(e: Expression, local: dict[str, str]) -> str:
    """An expression as Python code."""
    if e.operator == "literal":
        if isinstance(e.value, float) and not math.isfinite(e.value):
            raise Unsupported
        return f"({e.value!r})"
    if e.operator == "name":
        return local[str(e.value)]
    parts = [_source(x, local) for x in e.operands]
    if e.operator in _INFIX:
        return f"({_INFIX[e.operator].join(parts)})"
    if e.operator == "?:":
        return f"({parts[1]} if {parts[0]} else {parts[2]})"
    if e.operator in ("!", "neg"):
        return f"({'not ' if e.operator == '!' else '-'}{parts[0]})"
    if e.operator in ("min", "max") and len(parts) > 1:
        return f"{e.operator}({', '.join(parts)})"
    return f"apply[{e.operator!r}]({', '.join(parts)})"


# States of a level from which arrays are faster, by command and in all (benchmarks/programs.py).
PER_COMMAND, LEVEL = 8, 400
_MAX_UPDATES = 2**12  # of a state
_WORD = 2**64 - 1

# Of a module: choices without synchronisation, with their columns, and joint ones by column.
_Choices = tuple[list[tuple[int, Updates]], dict[int, list[Updates]]]


@dataclass
class Narrow:
    """States that were expanded one by one, and their choices; lists of Python's numbers."""

    keys: list[int]
    known: dict[int, int]  # the number of each state
    row_count: list[int] = field(default_factory=list)  # of states that are expanded
    column: list[int] = field(default_factory=list)
    entry_count: list[int] = field(default_factory=list)
    successor: list[int] = field(default_factory=list)
    weight: list[float] = field(default_factory=list)

    def words(self, layout: Layout) -> Words:
        """The states as packed words."""
        return tuple(
            np.array([k >> (64 * w) & _WORD for k in self.keys], np.uint64)
            for w in range(layout.num_words)
        )


def search_narrow(
    program: Program,
    codes: Sequence[ModuleCode],
    parts: Sequence[tuple[tuple[int, int], ...]],
    layout: Layout,
    initial: Words,
    max_states: int,
) -> Narrow:
    """Expands levels of few states, up to the first larger one.

    The search ends before a level with a state for the vectorised search: one with very many
    successors or an invalid update. `parts` are the modules of each synchronisation, and their columns.
    """
    keys = [0] * initial[0].size
    for w, word in enumerate(initial):
        keys = [k | x << (64 * w) for k, x in zip(keys, word.tolist(), strict=True)]
    narrow = Narrow(keys, {k: i for i, k in enumerate(keys)})
    try:
        modules = [
            _Module(generate(m, code.actions, layout), i, code, parts)
            for i, (m, code) in enumerate(zip(program.modules, codes, strict=True))
        ]
    except Unsupported:
        return narrow
    limit = min(LEVEL, PER_COMMAND * sum(len(m.commands) for m in program.modules))
    lists: list[list[Any]] = [keys, narrow.row_count, narrow.column, narrow.entry_count]
    lists += [narrow.successor, narrow.weight]
    while 0 < len(level := keys[len(narrow.row_count) :]) < limit and len(keys) <= max_states:
        marks = list(map(len, lists))
        try:
            for key in level:
                _expand(key, modules, parts, narrow)
        except (Unsupported, ArithmeticError, ValueError):
            for key in keys[marks[0] :]:
                del narrow.known[key]
            for items, mark in zip(lists, marks, strict=True):
                del items[mark:]
            break
    return narrow


class _Module:
    """Choices of a module by the bits of the variables that it uses."""

    def __init__(
        self,
        local: Local,
        number: int,
        code: ModuleCode,
        parts: Sequence[tuple[tuple[int, int], ...]],
    ) -> None:
        self.local = local
        self.mask = sum(m << (64 * w) for w, m in enumerate(code.support))
        self.known: dict[int, _Choices] = {}
        mine = [
            (i, dict(part)[number], len(part))
            for i, part in enumerate(parts)
            if number in dict(part)
        ]
        self.alone = [(i, c) for i, c, size in mine if size == 1]  # column, and the module's own
        self.joint = [(i, c) for i, c, size in mine if size > 1]

    def choices(self, key: int) -> _Choices:
        choices = self.known.get(key & self.mask)
        if choices is None:
            rows = self.local(key)
            own = [(i, updates) for i, c in self.alone for updates in rows[c]]
            joint = {i: rows[c] for i, c in self.joint if rows[c]}
            choices = self.known[key & self.mask] = own, joint
        return choices


def _expand(
    key: int, modules: list[_Module], parts: Sequence[tuple[tuple[int, int], ...]], narrow: Narrow
) -> None:
    """Adds the choices and the new successors of a state."""
    local = [m.choices(key) for m in modules]
    before = len(narrow.column)
    for m, (own, joint) in enumerate(local):
        for column, updates in own:
            _add(key, column, updates, narrow)
        for column in joint:
            if parts[column][0][0] != m:
                continue
            others = [local[other][1].get(column) for other, _ in parts[column]]
            together = [rows for rows in others if rows is not None]
            if len(together) == len(others):
                for updates in _joint(together):
                    _add(key, column, updates, narrow)
    narrow.row_count.append(len(narrow.column) - before)


def _joint(together: list[list[Updates]]) -> list[Updates]:
    """The joint updates of every combination of commands."""
    if prod(sum(map(len, rows)) for rows in together) > _MAX_UPDATES:
        raise Unsupported
    updates = together[0]
    for rows in together[1:]:
        updates = [
            tuple([(d + e, p * q) for d, p in one for e, q in other])
            for one, other in product(updates, rows)
        ]
    return updates


def _add(key: int, column: int, updates: Updates, narrow: Narrow) -> None:
    known = narrow.known
    for change, probability in updates:
        target = key + change
        number = known.get(target)
        if number is None:
            number = known[target] = len(narrow.keys)
            narrow.keys.append(target)
        narrow.successor.append(number)
        narrow.weight.append(probability)
    narrow.column.append(column)
    narrow.entry_count.append(len(updates))
