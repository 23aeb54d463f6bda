"""Interchangeable modules and variables of a program, and states up to their order."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from jaxltl.core.language.expressions import FALSE, Expression, conjuncts, names_in
from jaxltl.core.language.syntax import Command, Program
from jaxltl.core.programs.packed_states import Layout, Words

_WORK = 2_000_000  # nodes of expressions that are compared at most; about two seconds
_COMMUTATIVE = frozenset(("&", "|", "+", "*", "=", "!=", "<=>", "min", "max"))


@dataclass(frozen=True)
class Orbit:
    """Slots, groups of variables whose order does not matter, and variables that name a slot."""

    slots: tuple[tuple[str, ...], ...]  # the variables of each slot
    selectors: dict[str, tuple[int, ...]]  # by variable the value that names each slot

    def sort(self, layout: Layout, words: Words) -> None:
        """Sorts the slots of some states, in place."""
        bits = len(self.selectors) + sum(layout.fields[n].variable.bits for n in self.slots[0])
        if bits > 64:
            return
        key = np.zeros((words[0].size, len(self.slots)), np.uint64)
        for name, values in self.selectors.items():
            key = key << np.uint64(1) | (layout.values(words, name)[:, None] == np.array(values))
        parts = [(layout.fields[n], i) for i, slot in enumerate(self.slots) for n in slot]
        for f, i in parts:
            raw = (words[f.word] & np.uint64(f.mask)) >> np.uint64(f.shift)
            key[:, i] = key[:, i] << np.uint64(f.variable.bits) | raw
        key.sort(axis=1)
        for f, i in reversed(parts):
            raw = key[:, i] & np.uint64((1 << f.variable.bits) - 1)
            key[:, i] >>= np.uint64(f.variable.bits)
            words[f.word][:] = words[f.word] & ~np.uint64(f.mask) | raw << np.uint64(f.shift)
        for name, values in reversed(self.selectors.items()):
            f = layout.fields[name]
            for i, value in enumerate(values):
                named = (key[:, i] & np.uint64(1)).nonzero()[0]
                shifted = np.uint64(value - f.variable.low << f.shift)
                words[f.word][named] = words[f.word][named] & ~np.uint64(f.mask) | shifted
            key >>= np.uint64(1)


def find_orbits(program: Program, conditions: Sequence[Expression]) -> tuple[Orbit, ...]:
    """The interchangeable modules and variables that keep a program and some conditions as they are.

    The exchange of two slots, with their actions and the values of selectors, is an automorphism
    of the transition system, as the text is the same up to the order of modules, commands, updates
    and operands (Kwiatkowska et al. 2006, "Symmetry reduction for probabilistic model checking").
    Events over the conditions have equal probabilities in states that differ by exchanges.

    Example:
      >>> from jaxltl.core.language.resolve import read_program
      >>> program = read_program('''mdp module a x : [0..2]; [] x<2 -> (x'=x+1); endmodule
      ...     module b = a [x=y] endmodule''')
      >>> find_orbits(program, [])[0].slots
      (('x',), ('y',))
    """
    live = [[c for c in m.commands if c.guard != FALSE] for m in program.modules]
    work = sum(e.size for commands in live for c in commands for e in c.expressions)
    if work * (len(live) + len(program.variables)) > _WORK:
        return ()
    before = _Exchange().form(live, conditions)
    orbits: list[Orbit] = []
    for chain in _chains(program, live):
        runs = [[chain[0]]]
        for slot in chain[1:]:
            exchange = _exchange(runs[-1][-1], slot)
            if exchange is not None and exchange.form(live, conditions) == before:
                runs[-1].append(slot)
            else:
                runs.append([slot])
        orbits += [orbit for run in runs if len(run) > 1 for orbit in _orbit(run)]
    slots = [n for o in orbits for slot in o.slots for n in slot]
    selectors = {n for o in orbits for n in o.selectors}
    # Exchanges of different orbits commute if no selector is in a slot.
    separate = len(set(slots)) == len(slots) and not selectors & set(slots)
    return tuple(orbits) if separate else ()


@dataclass(frozen=True)
class _Slot:
    """Variables, actions of the commands, and values of variables that select the commands."""

    names: tuple[str, ...]
    actions: tuple[str, ...]
    selected: dict[str, int]

    def differing(self, other: _Slot) -> list[str]:
        """The selectors of both slots that have another value."""
        both = self.selected.keys() & other.selected.keys()
        return [v for v in both if self.selected[v] != other.selected[v]]


def _slot(names: tuple[str, ...], commands: Sequence[Command], actions: tuple[str, ...]) -> _Slot:
    values: dict[str, set[int]] = {}
    for e in (e for c in commands for e in conjuncts(c.guard)):
        if e.operator == "=" and e.operands[0].operator == "name" and e.operands[1].is_literal:
            values.setdefault(str(e.operands[0].value), set()).add(int(e.operands[1].value or 0))
    single = {v: min(x) for v, x in values.items() if len(x) == 1 and v not in names}
    return _Slot(names, actions, single)


def _chains(program: Program, live: Sequence[Sequence[Command]]) -> Iterator[list[_Slot]]:
    """Candidates: modules of equal shape, then variables of equal range in one module."""
    modules: dict[object, list[_Slot]] = {}
    for i, commands in enumerate(live):
        own = [v for v in program.variables if v.module == i]
        slot = _slot(tuple(v.name for v in own), commands, tuple(c.action for c in commands))
        shape = len(commands), *((v.type, v.low, v.high) for v in own)
        modules.setdefault(shape if own else i, []).append(slot)
    copies = [chain for chain in modules.values() if len(chain) > 1]
    taken = {n for chain in copies for slot in chain for n in slot.names}
    single: dict[object, list[_Slot]] = {}
    for v in program.variables:
        if v.name not in taken:
            using = [c for x in live for c in x if v.name in c.assigned | names_in(c.guard)]
            key = v.type, v.low, v.high, v.module, len(using)
            single.setdefault(key, []).append(_slot((v.name,), using, ()))
    yield from (*copies, *single.values())


def _orbit(run: Sequence[_Slot]) -> list[Orbit]:
    """The orbit of some slots; none if a selector does not name each of them."""
    selectors = {v for a, b in pairwise(run) for v in a.differing(b)}
    values = {v: tuple(s.selected[v] for s in run if v in s.selected) for v in sorted(selectors)}
    named = all(len(set(x)) == len(x) == len(run) for x in values.values())
    return [Orbit(tuple(s.names for s in run), values)] if named else []


def _exchange(a: _Slot, b: _Slot) -> _Exchange | None:
    names: dict[str, str] = {}
    pairs = [*zip(a.names, b.names, strict=True)]
    pairs += [(f"[{x}]", f"[{y}]") for x, y in zip(a.actions, b.actions, strict=True)]
    for one, other in pairs:
        if names.setdefault(one, other) != other or names.setdefault(other, one) != one:
            return None
    ends = [(v, a.selected[v], b.selected[v]) for v in a.differing(b)]
    values = {v: {first: last, last: first} for v, first, last in ends}
    return _Exchange(names, values)


class _Asymmetric(Exception):
    """A selector that is used other than by comparison with constants."""


@dataclass
class _Exchange:
    """New names of variables and actions, and new values of selectors; canonical forms of texts."""

    names: Mapping[str, str] = field(default_factory=dict)
    values: Mapping[str, Mapping[int, int]] = field(default_factory=dict)
    memory: dict[int, str] = field(default_factory=dict)

    def form(
        self, modules: Sequence[Sequence[Command]], conditions: Sequence[Expression]
    ) -> object:
        """The changed text without its order; None for a selector that is used otherwise."""
        try:
            whole = sorted(sorted(map(self._command, commands)) for commands in modules)
            return whole, [self._expression(e) for e in conditions]
        except _Asymmetric:
            return None

    def _name(self, name: str) -> str:
        return self.names.get(name, name)

    def _command(self, c: Command) -> str:
        outcomes = []
        for o in c.outcomes:
            changes = [
                f"{self._name(a.variable)}'={self._value(a.variable, a.expression)}"
                for a in o.assignments
            ]
            outcomes.append(f"{self._expression(o.probability)}:{sorted(changes)}")
        return f"{self._name(f'[{c.action}]')} {self._expression(c.guard)} -> {sorted(outcomes)}"

    def _value(self, name: str, e: Expression) -> str:
        """An expression that is compared with, or assigned to, a variable."""
        if name not in self.values:
            return self._expression(e)
        if not e.is_literal:
            raise _Asymmetric
        value = int(e.value or 0)
        return str(self.values[name].get(value, value))

    def _expression(self, e: Expression) -> str:
        if id(e) not in self.memory:
            self.memory[id(e)] = self._node(e)
        return self.memory[id(e)]

    def _node(self, e: Expression) -> str:
        if e.operator == "name":
            if e.value in self.values:
                raise _Asymmetric
            return self._name(str(e.value))
        if not e.operands:
            return repr(e.value)
        name = str(e.operands[0].value)
        if e.operator in ("=", "!=") and e.operands[0].operator == "name" and name in self.values:
            parts = [name, self._value(name, e.operands[1])]
        else:
            parts = [self._expression(x) for x in e.operands]
        return f"{e.operator}({sorted(parts) if e.operator in _COMMUTATIVE else parts})"
