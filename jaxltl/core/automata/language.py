"""Emptiness, inclusion and equivalence of automata, with lassos as witnesses; products."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.automaton import Automaton, complement, make_automaton
from jaxltl.core.automata.emerson_lei import (
    MAX_COLORS,
    Condition,
    parity_condition,
    residual,
    to_parity,
)
from jaxltl.core.automata.parity import simplify
from jaxltl.core.automata.products import EVEN, ODD
from jaxltl.core.automata.runs import Lasso, align, find_lasso, has_lasso, joint_runs
from jaxltl.core.automata.translate import FormulaLike, as_automaton
from jaxltl.core.logic.ltl import Letter


def find_accepted(automaton: Automaton) -> Lasso | None:
    """A word that the automaton accepts, as a short lasso.

    For each even p: a strongly connected part of the transitions of priority p or more, with one of
    priority p (Baier & Katoen 2008, section 4.4, for one priority).
    """
    return find_lasso([automaton], [(EVEN,)])


def is_empty(automaton: Automaton) -> bool:
    """True if the automaton accepts no word."""
    return not has_lasso([automaton], [(EVEN,)])


def is_universal(automaton: Automaton) -> bool:
    """True if the automaton accepts every word over its letters."""
    return not has_lasso([automaton], [(ODD,)])


def find_difference(a: FormulaLike, b: FormulaLike) -> Lasso | None:
    """A word that exactly one of two automata accepts, as a short lasso.

    Args:
      a: an automaton, a formula or its text.
      b: another; both are aligned first, see `align`.

    Returns:
      `(prefix, cycle)`, or None if both accept the same words over their joint letters.

    Raises:
      ValueError: if there is no joint letter, or too many.

    Example:
      >>> from jaxltl import to_automaton
      >>> find_difference(to_automaton("F a"), to_automaton("X F a"))
      ([frozenset({'a'})], [frozenset()])
    """
    return find_lasso(_aligned(a, b), [(EVEN, ODD), (ODD, EVEN)])


def is_equivalent(a: FormulaLike, b: FormulaLike) -> bool:
    """True if two automata or formulas accept the same words over their joint letters; see `align`.

    Args:
      a, b: automata with any acceptance, formulas or their texts.

    Returns:
      True if they do; :func:`find_difference` returns a word in the symmetric difference.

    Raises:
      ValueError: if there is no joint letter, or too many.

    Example:
      >>> from jaxltl import to_automaton
      >>> is_equivalent(to_automaton("F a"), to_automaton("a | X F a"))
      True
      >>> is_equivalent("F (a | b)", "F a | F b")
      True
    """
    return not has_lasso(_aligned(a, b), [(EVEN, ODD), (ODD, EVEN)])


def find_not_included(a: FormulaLike, b: FormulaLike) -> Lasso | None:
    """A short lasso that the first automaton accepts and the second rejects."""
    return find_lasso(_aligned(a, b), [(EVEN, ODD)])


def is_included(a: FormulaLike, b: FormulaLike) -> bool:
    """True if the language of the first automaton is included in that of the second, over joint letters.

    Args:
      a: an automaton, a formula or its text.
      b: another; both are aligned first, see `align`.

    Returns:
      True if it is; :func:`find_not_included` gives a word that `a` accepts and `b` does not.

    Raises:
      ValueError: if there is no joint letter, or too many.

    Example:
      >>> from jaxltl import to_automaton
      >>> is_included(to_automaton("a U b"), to_automaton("F b"))
      True
    """
    return not has_lasso(_aligned(a, b), [(EVEN, ODD)])


def intersection(a: FormulaLike, b: FormulaLike) -> Automaton:
    """The automaton that accepts the words that both accept."""
    return _combine(a, b, "and")


def union(a: FormulaLike, b: FormulaLike) -> Automaton:
    """The automaton that accepts the words that at least one accepts."""
    return _combine(a, b, "or")


def difference(a: FormulaLike, b: FormulaLike) -> Automaton:
    """The automaton that accepts the words that `a` accepts and `b` rejects."""
    return _combine(a, complement(as_automaton(b)), "and")


def _aligned(a: FormulaLike, b: FormulaLike) -> tuple[Automaton, Automaton]:
    return align(as_automaton(a), as_automaton(b))


def _combine(a: FormulaLike, b: FormulaLike, connective: str) -> Automaton:
    """The automaton of the words for which `a` `connective` `b`."""
    a, b = _aligned(a, b)
    runs = joint_runs([a, b])
    priorities = [x.priority[state] for x, state in zip((a, b), runs.states.T, strict=True)]
    colors_of_a, accepted_by_a, used = _colored(priorities[0], 0)
    colors_of_b, accepted_by_b, used = _colored(priorities[1], used)
    if used > MAX_COLORS:
        raise ValueError(
            f"{used} priorities in the two automata matter; the limit is {MAX_COLORS}. "
            "Combine automata with fewer, such as simplified ones."
        )
    condition = (connective, accepted_by_a, accepted_by_b)
    delta, priority, initial, base = to_parity(runs.delta, colors_of_a | colors_of_b, 0, condition)
    names: list[str] = []
    if a.state_names and b.state_names:
        sign = {"and": "&", "or": "|"}[connective]
        pairs = runs.states[np.asarray(base)].tolist()
        names = [f"({a.state_names[p]}) {sign} ({b.state_names[q]})" for p, q in pairs]
    return simplify(
        make_automaton(
            delta, int(initial), a.letters, a.propositions, priority=priority, state_names=names
        )
    )


def _colored(priority: Integers, first: int) -> tuple[NDArray[np.int64], Condition, int]:
    """Priorities as sets of colours and a condition on the colours met infinitely often."""
    values, place = np.unique(priority, return_inverse=True)
    level_of = np.cumsum([values[0] % 2, *(np.diff(values) % 2)])
    last = int(level_of[-1])
    # Some priority recurs in every run: the last one, if none of the others does.
    condition = residual(parity_condition(last + 1, first), 0, 1 << first + last)
    bits = np.array([1 << (first + i) if first + i < 63 else 0 for i in range(last)] + [0])
    return bits[level_of[place].reshape(priority.shape)], condition, first + last


def synchronize(
    memory: FormulaLike, formula: FormulaLike, *, alphabet: Iterable[Letter] | None = None
) -> Automaton:
    """Synchronous product of two automata, with the acceptance of the second.

    A policy with the memory of one automaton is judged by the task of another: make the product
    with this automaton, and lift the policy by :func:`lift_memory_policy`. The pair of memory state
    q1 and task state q2 is the state ``q1 * Q2 + q2``.

    Args:
      memory: Q1 states; an automaton, a formula or its text.
      formula: Q2 states, likewise.
      alphabet: the letters for formulas, see `to_automaton`.

    Returns:
      An automaton of Q1 * Q2 states over the joint letters, see `align`.

    Raises:
      ValueError: there is no joint letter, or too many.

    Example:
      >>> both = synchronize("true", "F a")
      >>> both.delta.tolist(), both.final.tolist()
      ([[0, 1], [1, 1]], [False, True])
    """
    alphabet = None if alphabet is None else list(alphabet)
    first, second = align(as_automaton(memory, alphabet), as_automaton(formula, alphabet))
    delta1, delta2 = np.asarray(first.delta), np.asarray(second.delta)
    num1, num2 = len(delta1), len(delta2)
    delta = delta1[:, None] * num2 + delta2[None]
    delta = delta.reshape(num1 * num2, -1)
    initial = int(first.initial) * num2 + int(second.initial)
    titles = [x.state_names or tuple(map(str, range(len(x.delta)))) for x in (first, second)]
    state_names = [f"{a} | {b}" for a in titles[0] for b in titles[1]]
    return Automaton(
        delta=delta.astype(np.int32),
        initial=np.asarray(initial, np.int32),
        priority=np.tile(np.asarray(second.priority), (num1, 1)),
        letters=second.letters,
        propositions=second.propositions,
        acceptance=second.acceptance,
        state_names=tuple(state_names),
    )
