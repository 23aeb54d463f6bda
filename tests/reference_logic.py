"""Slow and obvious references for logic and automata, and random formulas to try them on."""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, combinations, product

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.table import ParityTable, quotient
from jaxltl.core.logic.ltl import Formula

Word = Sequence[frozenset[str]]


def holds_by_definition(formula: Formula, prefix: Word, cycle: Word) -> bool:
    """Truth on prefix·cycle^ω by the textbook clauses, quantifying over explicit positions.

    Every suffix of the word occurs among those at positions 0..n-1, n = |prefix| + |cycle|, and
    all suffixes that occur at or after position i occur at one of i..i+n-1, so the quantifiers
    over all later positions range over n of them.
    """
    n = len(prefix) + len(cycle)
    known: dict[tuple[Formula, int], bool] = {}

    def sat(f: Formula, i: int) -> bool:
        if i >= len(prefix):
            i = len(prefix) + (i - len(prefix)) % len(cycle)
        if (f, i) not in known:
            known[f, i] = clause(f, i)
        return known[f, i]

    def clause(f: Formula, i: int) -> bool:
        later = range(i, i + n)
        a, b = f.operands[0] if f.operands else f, f.operands[-1] if f.operands else f
        match f.operator:
            case "true" | "false":
                return f.operator == "true"
            case "ap":
                letter = prefix[i] if i < len(prefix) else cycle[i - len(prefix)]
                return f.proposition in letter
            case "!":
                return not sat(a, i)
            case "&":
                return all(sat(g, i) for g in f.operands)
            case "|":
                return any(sat(g, i) for g in f.operands)
            case "->":
                return not sat(a, i) or sat(b, i)
            case "<->":
                return sat(a, i) == sat(b, i)
            case "xor":
                return sat(a, i) != sat(b, i)
            case "X":
                return sat(a, i + 1)
            case "F":
                return any(sat(a, j) for j in later)
            case "G":
                return all(sat(a, j) for j in later)
            case "U":
                return any(sat(b, j) and all(sat(a, k) for k in range(i, j)) for j in later)
            case "W":
                until = any(sat(b, j) and all(sat(a, k) for k in range(i, j)) for j in later)
                return until or all(sat(a, j) for j in later)
            case "R":
                return all(sat(b, j) or any(sat(a, k) for k in range(i, j)) for j in later)
            case "M":
                return any(sat(a, j) and all(sat(b, k) for k in range(i, j + 1)) for j in later)
        raise AssertionError(f.operator)

    return sat(formula, 0)


def subsets(names: Sequence[str]) -> list[frozenset[str]]:
    sizes = range(len(names) + 1)
    return [frozenset(s) for s in chain.from_iterable(combinations(names, k) for k in sizes)]


def words(letters: Word, shortest: int, longest: int) -> Iterator[tuple[frozenset[str], ...]]:
    for length in range(shortest, longest + 1):
        yield from product(letters, repeat=length)


def residual_count(formula: Formula, letters: Word, stem: int, tail: int, cycle: int) -> int:
    """The number of Myhill-Nerode classes that words up to the given lengths tell apart.

    Two finite words are told apart by an infinite continuation that makes the formula true after
    one of them and false after the other.
    """
    continuations = list(product(words(letters, 0, tail), words(letters, 1, cycle)))
    return len(
        {
            tuple(holds_by_definition(formula, (*u, *v), w) for v, w in continuations)
            for u in words(letters, 0, stem)
        }
    )


def minimize(automaton: Automaton) -> Automaton:
    """The minimal automaton with the same priorities along every run."""
    table = ParityTable(automaton.delta, automaton.priority, int(automaton.initial))
    small, base = quotient(table)
    names = automaton.state_names
    return replace(
        automaton,
        delta=small.delta,
        priority=small.priority,
        initial=small.initial,
        state_names=tuple(names[q] for q in base) if names else (),
    )


def unmergeable(automaton: Automaton) -> bool:
    """Whether all states are reachable and every two are told apart by a word, by pair search."""
    delta, final = automaton.delta.tolist(), automaton.final.tolist()
    reached = {int(automaton.initial)}
    for _ in delta:
        reached |= {successor for q in reached for successor in delta[q]}
    states = range(len(delta))
    apart = {(p, q) for p in states for q in states if final[p] != final[q]}
    while True:
        more = {
            (p, q)
            for p in states
            for q in states
            if any((a, b) in apart for a, b in zip(delta[p], delta[q], strict=True))
        }
        if more <= apart:
            break
        apart |= more
    return len(reached) == len(delta) and len(apart) == len(delta) * (len(delta) - 1)


FRAGMENT_OPERATORS = {"cosafe": ("XF", "UM"), "safety": ("XG", "RW"), "all": ("XFG", "URWM")}
OPPOSITE = {"cosafe": "safety", "safety": "cosafe", "all": "all"}


def random_formula(
    rng: random.Random, size: int, names: Sequence[str], fragment: str = "all"
) -> Formula:
    """A formula of about `size` operators and atoms that is syntactically in the fragment.

    Negations and implications switch to the opposite fragment below them, and `<->` and `xor`
    to formulas with no temporal operator but X, which are in both.
    """
    if size <= 1:
        if rng.random() < 0.04:
            return Formula(rng.choice(["true", "false"]))
        return Formula("ap", proposition=rng.choice(names))
    bounded = fragment == "bounded"
    unary, binary = ("X", "") if bounded else FRAGMENT_OPERATORS[fragment]
    opposite = OPPOSITE.get(fragment, "bounded")
    within = fragment if fragment == "all" else "bounded"
    if size == 2 or rng.random() < 0.3:
        operator = rng.choice([*unary, "!"])
        below = opposite if operator == "!" else fragment
        return Formula(operator, (random_formula(rng, size - 1, names, below),))
    operator = rng.choice([*binary, *binary, *"&&||", "->", "<->", "xor"])
    left = rng.randint(1, size - 2)
    fragments = {"->": (opposite, fragment), "<->": (within, within), "xor": (within, within)}
    below_left, below_right = fragments.get(operator, (fragment, fragment))
    return Formula(
        operator,
        (
            random_formula(rng, left, names, below_left),
            random_formula(rng, size - 1 - left, names, below_right),
        ),
    )


def random_lasso(rng: random.Random, letters: Word) -> tuple[Word, Word]:
    prefix = [rng.choice(letters) for _ in range(rng.randint(0, 5))]
    return prefix, [rng.choice(letters) for _ in range(rng.randint(1, 4))]
