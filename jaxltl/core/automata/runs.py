"""Runs of automata: lassos through joint cycles, and verdicts on finite words."""

from __future__ import annotations

import enum
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.automaton import Automaton, named_propositions, run
from jaxltl.core.automata.products import (
    EVEN,
    ODD,
    Parities,
    AutomataProduct,
    loops,
    product,
    states_that_may,
    word_through,
)
from jaxltl.core.automata.table import ParityTable
from jaxltl.core.logic.ltl import Letter
from jaxltl.core.pretty_print import CODES

Lasso = tuple[list[frozenset[str]], list[frozenset[str]]]

MAX_JOINT_LETTERS = 2**12


def live_states(automaton: Automaton) -> NDArray[np.bool_]:
    """bool `[Q]`, the states from which some word is accepted."""
    return states_that_may(_table(automaton), EVEN)


def universal_states(automaton: Automaton) -> NDArray[np.bool_]:
    """bool `[Q]`, the states from which every word is accepted."""
    return ~states_that_may(_table(automaton), ODD)


def align(a: Automaton, b: Automaton) -> tuple[Automaton, Automaton]:
    """Two automata over the same propositions, sorted, and the same letters, by binary number.

    The letters combine a letter of `a` and one of `b` that agree on the shared propositions.
    """
    names_of_a, names_of_b = named_propositions(a), named_propositions(b)
    shared = [name for name in names_of_a if name in names_of_b]
    read_by_a, read_by_b = _agreeing(_columns(a, shared), _columns(b, shared))
    names = tuple(sorted({*names_of_a, *names_of_b}))
    rows = np.zeros((len(read_by_a), len(names)), bool)
    for automaton, letter in ((a, read_by_a), (b, read_by_b)):
        own = [name for name in names if name in automaton.propositions]
        rows[:, [name in own for name in names]] = _columns(automaton, own)[letter]
    order = np.lexsort(rows.T) if names else np.arange(len(rows))
    return (
        _reading(a, read_by_a[order], rows[order], names),
        _reading(b, read_by_b[order], rows[order], names),
    )


def _columns(automaton: Automaton, names: Sequence[str]) -> NDArray[np.bool_]:
    """bool `[L, len(names)]`, what each letter says of the given propositions."""
    places = [automaton.propositions.index(name) for name in names]
    return np.asarray(automaton.letters)[:, places]


def _agreeing(left: NDArray[np.bool_], right: NDArray[np.bool_]) -> tuple[Integers, ...]:
    """All pairs of equal rows, as two columns of row numbers."""
    same = (left[:, None] == right).all(axis=2)
    count = np.count_nonzero(same)
    if count == 0:
        raise ValueError(
            "align: no letter of one automaton agrees with a letter of the other on the "
            "propositions that they share. Build both with the same letters=."
        )
    if count > MAX_JOINT_LETTERS:
        raise ValueError(
            f"align: the automata have {count} joint letters; the limit is {MAX_JOINT_LETTERS}. "
            "Build both with letters=, the sets of propositions that can hold at once."
        )
    return np.nonzero(same)


def _reading(
    automaton: Automaton, letter: Integers, rows: NDArray[np.bool_], names: tuple[str, ...]
) -> Automaton:
    """The automaton that reads its own `letter[l]` where the new letter l occurs."""
    return replace(
        automaton,
        delta=np.asarray(automaton.delta)[:, letter],
        priority=np.asarray(automaton.priority)[:, letter],
        letters=rows,
        propositions=names,
    )


def find_lasso(automata: Sequence[Automaton], wanted: Sequence[Parities]) -> Lasso | None:
    """A word on which the least recurring priorities have one of the wanted parities."""
    runs = joint_runs(automata)
    components = loops(runs.edges, len(runs.states), wanted)
    nearest = min(
        components, key=lambda loop: loop[0].source[loop[1].any(axis=0)].min(), default=None
    )
    if nearest is None:
        return None
    word = word_through(runs.edges, len(runs.states), *nearest)
    prefix, cycle = _shortened(*(part.tolist() for part in word))
    names, rows = automata[0].propositions, np.asarray(automata[0].letters)
    said = [frozenset(n for n, holds in zip(names, row, strict=True) if holds) for row in rows]
    return [said[letter] for letter in prefix], [said[letter] for letter in cycle]


def has_lasso(automata: Sequence[Automaton], wanted: Sequence[Parities]) -> bool:
    """True if on some word the least recurring priorities have one of the wanted parities."""
    runs = joint_runs(automata)
    return any(True for _ in loops(runs.edges, len(runs.states), wanted))


def _table(automaton: Automaton) -> ParityTable:
    delta, priority = np.asarray(automaton.delta), np.asarray(automaton.priority)
    return ParityTable(delta, priority, int(automaton.initial))


def joint_runs(automata: Sequence[Automaton]) -> AutomataProduct:
    """The reachable tuples of states of automata over the same letters."""
    runs = product([_table(automaton) for automaton in automata])
    assert runs is not None
    return runs


def _shortened(prefix: list[int], cycle: list[int]) -> tuple[list[int], list[int]]:
    """The shortest lasso of the same infinite word."""
    length = len(cycle)
    periods = (n for n in range(1, length + 1) if length % n == 0)
    cycle = next(cycle[:n] for n in periods if cycle == cycle[:n] * (length // n))
    while prefix and prefix[-1] == cycle[-1]:
        prefix, cycle = prefix[:-1], [cycle[-1], *cycle[:-1]]
    return prefix, cycle


class Verdict(enum.IntEnum):
    """The verdict of a finite word on its infinite continuations.

    - ``UNDECIDED``: some are accepted, and some are not.
    - ``SATISFIED``: all are accepted.
    - ``VIOLATED``: none is accepted.

    Example:
      >>> import jaxltl as jl
      >>> jl.environments.verdict(jl.automata.to_automaton("G a"), [{"a"}, set()]).name
      'VIOLATED'
    """

    UNDECIDED = 0
    SATISFIED = 1  # every continuation is accepted
    VIOLATED = 2  # none is


CODES["verdict"] = Verdict


def verdict(automaton: Automaton, word: Iterable[Letter]) -> Verdict:
    """The verdict after a finite word, on the host.

    Args:
      automaton: the task, with any acceptance.
      word: T letters, each the collection of the propositions that hold.

    Returns:
      :class:`Verdict`.

    Raises:
      ValueError: a letter is not among the automaton's.

    Example:
      >>> from jaxltl import to_automaton
      >>> verdict(to_automaton("F a"), [set(), {"a"}]).name, verdict(to_automaton("F a"), []).name
      ('SATISFIED', 'UNDECIDED')
    """
    return Verdict(int(verdicts(automaton)[run(automaton, word)[-1]]))


def verdicts(automaton: Automaton) -> NDArray[np.int32]:
    """``int32[Q]``: the verdict in each state of an automaton."""
    table = np.full(len(automaton.delta), Verdict.UNDECIDED, np.int32)
    table[universal_states(automaton)] = Verdict.SATISFIED
    table[~live_states(automaton)] = Verdict.VIOLATED
    return table


def lasso_verdicts(automaton: Automaton) -> NDArray[np.int32]:
    """``int32[Q, L]``: the verdict, never undecided, if a letter repeats for ever from a state on."""
    delta, least = np.asarray(automaton.delta), np.asarray(automaton.priority)
    # The state after 2^n readings of one letter, and the least priority among them. After as many
    # as there are states the run is on its cycle, and as many more read all of it.
    letter = np.arange(delta.shape[1])
    for _ in range(len(delta).bit_length()):
        least = np.minimum(least, least[delta, letter])
        delta = delta[delta, letter]
    even = least[delta, letter] % 2 == 0
    return np.where(even, Verdict.SATISFIED, Verdict.VIOLATED).astype(np.int32)
