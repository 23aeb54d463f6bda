"""Deterministic automata of the informative prefixes of co-safe formulas."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import Formula

_MAX_STATES = 10_000
_Cube = frozenset[Formula]  # formulas that must all hold
_Cubes = frozenset[_Cube]  # of which one must hold
_Memory = dict[Formula, _Cubes]


class PrefixAutomaton(NamedTuple):
    """States that follow each letter; state 0 is initial, and state 1 final and absorbing."""

    delta: Integers  # int64[Q, L]
    propositions: tuple[Formula, ...]  # the state formulas of which letters are truth values


def state_formulas(formula: Formula) -> tuple[Formula, ...]:
    """The maximal subformulas without temporal operators, of a negation normal form."""
    outermost: dict[Formula, None] = {}
    waiting = [formula]
    while waiting:
        node = waiting.pop()
        if is_boolean(node):
            outermost.setdefault(node)
        else:
            waiting.extend(node.operands)
    return tuple(outermost)


def prefix_automaton(formula: Formula, letters: Booleans) -> PrefixAutomaton:
    """Automaton of the prefixes that prove a co-safe formula, operator by operator.

    The states are disjunctions of the obligations that remain. Nothing else is simplified, so that
    ``X true`` needs a second letter: the informative prefixes of Kupferman and Vardi (2001), as in PRISM.

    Args:
      formula: in negation normal form, with the temporal operators ``X F U M``.
      letters: ``bool[L, P]``, truth of its :func:`state_formulas` in each letter.
    """
    propositions = state_formulas(formula)
    truth = [dict(zip(propositions, row, strict=True)) for row in letters.tolist()]
    done: _Cubes = frozenset([frozenset()])
    number: dict[_Cubes, int] = {frozenset([frozenset([formula])]): 0, done: 1}
    states, delta = list(number), []
    for state in states:
        row = []
        for letter in truth:
            memory: _Memory = {}
            after = _smallest([x for cube in state for x in _all(cube, letter, memory)])
            if after not in number:
                number[after] = len(states)
                states.append(after)
                if len(states) > _MAX_STATES:
                    raise ValueError(f"the automaton of {formula} has over {_MAX_STATES} states.")
            row.append(number[after])
        delta.append(row)
    return PrefixAutomaton(np.array(delta, np.int64), propositions)


def _all(cube: Sequence[Formula] | _Cube, letter: dict[Formula, bool], memory: _Memory) -> _Cubes:
    """The obligations after a letter of formulas that must all hold."""
    result: _Cubes = frozenset([frozenset()])
    for f in cube:
        after = _after(f, letter, memory)
        result = _smallest([a | b for a in result for b in after])
    return result


def _after(f: Formula, letter: dict[Formula, bool], memory: _Memory) -> _Cubes:
    """The obligations after a letter of one formula."""
    if f in memory:
        return memory[f]
    first, right = (f.operands[0], f.operands[-1]) if f.operands else (f, f)
    result: _Cubes
    if f in letter:
        result = frozenset([frozenset()] if letter[f] else [])
    elif f.operator == "&":
        result = _all(f.operands, letter, memory)
    elif f.operator == "|":
        result = _smallest([x for g in f.operands for x in _after(g, letter, memory)])
    elif f.operator == "X":
        result = frozenset([frozenset([first])])
    else:
        later = frozenset([frozenset([f])])
        held = _after(first, letter, memory) if f.operator == "U" else None
        waits = later if held is None else _smallest([a | b for a in held for b in later])
        if f.operator == "M":  # a M b: b until both
            waits = _smallest([a | b for a in _after(right, letter, memory) for b in later])
            right = first & right
            ends = _all(right.operands, letter, memory)
        else:
            ends = _after(right, letter, memory)
        result = _smallest([*ends, *waits])
    memory[f] = result
    return result


def _smallest(cubes: Sequence[_Cube]) -> _Cubes:
    """The cubes that no other one implies."""
    distinct = set(cubes)
    return frozenset(x for x in distinct if not any(y < x for y in distinct))


def is_plain_reachability(formula: Formula) -> bool:
    """True for ``F`` of a state formula, whose reward needs no automaton."""
    return formula.operator == "F" and is_boolean(formula.operands[0])
