"""Runs of automata: lassos through joint cycles, and verdicts on finite words."""

from __future__ import annotations

import enum
from collections.abc import Iterator, Sequence, Iterable
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers, SparseMatrix
from jaxltl.core.automata.automaton import Automaton, run
from jaxltl.core.logic.ltl import Letter
from jaxltl.core.sparse.graph.components import forward_reachable, strong_components


Lasso = tuple[list[frozenset[str]], list[frozenset[str]]]

MAX_JOINT_LETTERS = 2**12

EVEN, ODD = 0, 1


def live_states(automaton: Automaton) -> NDArray[np.bool_]:
    """bool `[Q]`, the states from which some word is accepted."""
    return _states_that_may(automaton, EVEN)


def universal_states(automaton: Automaton) -> NDArray[np.bool_]:
    """bool `[Q]`, the states from which every word is accepted."""
    return ~_states_that_may(automaton, ODD)


def align(a: Automaton, b: Automaton) -> tuple[Automaton, Automaton]:
    """Two automata over the same propositions, sorted, and the same letters, by binary number.

    The letters combine a letter of `a` and one of `b` that agree on the shared propositions.
    """
    shared = [name for name in a.propositions if name in b.propositions]
    read_by_a, read_by_b = _agreeing(_columns(a, shared), _columns(b, shared))
    names = tuple(sorted({*a.propositions, *b.propositions}))
    said_by_a = _columns(a, [name for name in names if name in a.propositions])[read_by_a]
    said_by_b = _columns(b, [name for name in names if name in b.propositions])[read_by_b]
    rows = np.zeros((len(read_by_a), len(names)), bool)
    rows[:, [name in a.propositions for name in names]] = said_by_a
    rows[:, [name in b.propositions for name in names]] = said_by_b
    order = np.lexsort(rows.T) if names else np.arange(len(rows))
    return (
        _reading(a, read_by_a[order], rows[order], names),
        _reading(b, read_by_b[order], rows[order], names),
    )


def _columns(automaton: Automaton, names: Sequence[str]) -> NDArray[np.bool_]:
    """bool `[L, len(names)]`, what each letter says of the given propositions."""
    places = [automaton.propositions.index(name) for name in names]
    return np.asarray(automaton.letters)[:, places]


def _agreeing(
    left: NDArray[np.bool_], right: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All pairs of equal rows, as two columns of row numbers."""
    where: dict[bytes, list[int]] = {}
    for number, row in enumerate(right):
        where.setdefault(row.tobytes(), []).append(number)
    partners = [where.get(row.tobytes(), []) for row in left]
    count = sum(map(len, partners))
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
    first = np.repeat(np.arange(len(left)), [len(numbers) for numbers in partners])
    return first, np.array([number for numbers in partners for number in numbers])


def _reading(
    automaton: Automaton, letter: NDArray[np.int64], rows: NDArray[np.bool_], names: tuple[str, ...]
) -> Automaton:
    """The automaton that reads its own `letter[l]` where the new letter l occurs."""
    return replace(
        automaton,
        delta=np.asarray(automaton.delta)[:, letter],
        priority=np.asarray(automaton.priority)[:, letter],
        letters=rows,
        propositions=names,
    )


class Runs(NamedTuple):
    """K automata that read the same word, as one graph that starts in node 0."""

    # [N, L], the node after reading a letter; nodes are numbered breadth first
    delta: NDArray[np.int32]
    priorities: tuple[NDArray[np.int32], ...]  # K tables [N, L], of each automaton
    states: NDArray[np.int64]  # [N, K], the state of each automaton


_Loops = tuple[NDArray[np.bool_], list[NDArray[np.bool_]]]


def joint_runs(automata: Sequence[Automaton]) -> Runs:
    """The reachable tuples of states of automata over the same letters."""
    sizes = [len(automaton.delta) for automaton in automata]
    tables = [np.asarray(automaton.delta) for automaton in automata]

    def successors(tuples: NDArray[Any]) -> NDArray[Any]:
        states = np.unravel_index(tuples, sizes)
        ends = [table[state] for table, state in zip(tables, states, strict=True)]
        return np.ravel_multi_index(tuple(ends), sizes)

    start = np.ravel_multi_index(tuple(int(x.initial) for x in automata), sizes)
    number = np.full(int(np.prod(sizes)), -1, np.int32)
    frontier = np.array([start])
    found, count = [], 0
    while frontier.size:
        number[frontier] = np.arange(count, count + frontier.size)
        count += frontier.size
        found.append(frontier)
        ends = successors(frontier)
        frontier = np.unique(ends[number[ends] < 0])
    tuples = np.concatenate(found)
    states = np.stack(np.unravel_index(tuples, sizes), axis=1)
    priorities = tuple(
        np.asarray(automaton.priority)[states[:, k]] for k, automaton in enumerate(automata)
    )
    return Runs(number[successors(tuples)], priorities, states)


def find_lasso(automata: Sequence[Automaton], wanted: Sequence[tuple[int, ...]]) -> Lasso | None:
    """A word on which the least recurring priorities have one of the wanted parities."""
    runs = joint_runs(automata)

    def distance(loops: _Loops) -> int:  # in the breadth-first order of the nodes
        return min(int(np.argmax(mark.any(axis=1))) for mark in loops[1])

    candidates = (loops for parities in wanted for loops in _loops(runs, parities))
    nearest = min(candidates, key=distance, default=None)
    if nearest is None:
        return None
    prefix, cycle = _shortened(*_through(runs.delta, *nearest, entry=distance(nearest)))
    names, rows = automata[0].propositions, np.asarray(automata[0].letters)
    said = [frozenset(n for n, holds in zip(names, row, strict=True) if holds) for row in rows]
    return [said[letter] for letter in prefix], [said[letter] for letter in cycle]


def some_loop(runs: Runs, wanted: Sequence[tuple[int, ...]]) -> bool:
    """True if some loop has one of the wanted parities."""
    return any(True for parities in wanted for _ in _loops(runs, parities))


def _loops(runs: Runs, parities: tuple[int, ...]) -> Iterator[_Loops]:
    """The loops on which the least priority of automaton k has parity `parities[k]`."""
    choices = [
        [value for value in np.unique(priority) if value % 2 == parity]
        for priority, parity in zip(runs.priorities, parities, strict=True)
    ]
    for least in product(*choices):
        pairs = list(zip(runs.priorities, least, strict=True))
        inside = np.logical_and.reduce([priority >= value for priority, value in pairs])
        component = _components(runs.delta, inside)
        inside &= component[:, None] == component[runs.delta]
        good = np.ones(len(component), bool)
        for priority, value in pairs:
            hit = np.zeros(len(component), bool)
            hit[component[(inside & (priority == value)).any(axis=1)]] = True
            good &= hit
        inside &= good[component][:, None]
        if inside.any():
            yield inside, [inside & (priority == value) for priority, value in pairs]


def _through(
    delta: NDArray[np.int32], inside: NDArray[np.bool_], marks: list[NDArray[np.bool_]], entry: int
) -> tuple[list[int], list[int]]:
    """The letters to node `entry`, and of a loop inside through a transition of each mark."""
    everywhere = np.ones_like(inside)
    home = np.zeros(len(delta), bool)
    home[entry] = True
    prefix, _ = _path(delta, everywhere, 0, home)
    letter = int(np.argmax(np.sum(marks, axis=0)[entry]))
    cycle, node = [letter], int(delta[entry, letter])
    for mark in marks:
        if not mark[entry, letter]:
            path, node = _path(delta, inside, node, np.any(mark, axis=1))
            step = int(np.argmax(mark[node]))
            cycle += [*path, step]
            node = int(delta[node, step])
    back, _ = _path(delta, inside, node, home)
    return prefix, cycle + back


def _shortened(prefix: list[int], cycle: list[int]) -> tuple[list[int], list[int]]:
    """The shortest lasso of the same infinite word."""
    length = len(cycle)
    periods = (n for n in range(1, length + 1) if length % n == 0)
    cycle = next(cycle[:n] for n in periods if cycle == cycle[:n] * (length // n))
    turns = 0  # letters at the end of the prefix that the cycle ends with, too
    while turns < len(prefix) and prefix[-1 - turns] == cycle[-1 - turns % len(cycle)]:
        turns += 1
    split = len(cycle) - turns % len(cycle)
    return prefix[: len(prefix) - turns], cycle[split:] + cycle[:split]


def _states_that_may(automaton: Automaton, parity: int) -> NDArray[np.bool_]:
    """bool `[Q]`, from where some word has a least recurring priority of the given parity."""
    delta = np.asarray(automaton.delta)
    every = np.arange(len(delta))[:, None]
    runs = Runs(delta, (np.asarray(automaton.priority),), every)
    good = np.zeros(len(delta), bool)
    for inside, _ in _loops(runs, (parity,)):
        good |= inside.any(axis=1)
    return _reaching(delta, good)


def _graph(delta: NDArray[np.int32], allowed: NDArray[np.bool_]) -> SparseMatrix:
    """The allowed transitions as a sparse matrix."""
    from scipy.sparse import csr_array

    rows = np.repeat(np.arange(len(delta), dtype=np.int32), allowed.sum(axis=1))
    graph = csr_array((np.ones(len(rows)), (rows, delta[allowed])), shape=2 * (len(delta),))
    graph.sum_duplicates()  # scipy's search for components need not end when an entry repeats
    return graph


def _components(delta: NDArray[np.int32], allowed: NDArray[np.bool_]) -> Integers:
    """int `[N]`, the strongly connected component of each node by allowed transitions."""
    source = np.repeat(np.arange(len(delta)), allowed.sum(axis=1))
    return strong_components(source, delta[allowed], len(delta))


def _path(
    delta: NDArray[np.int32], allowed: NDArray[np.bool_], start: int, goal: NDArray[np.bool_]
) -> tuple[list[int], int]:
    """The letters of a shortest path to a goal, which must be reachable, and its end."""
    from scipy.sparse.csgraph import breadth_first_order

    order, before = breadth_first_order(_graph(delta, allowed), start)
    end = node = int(order[np.argmax(goal[order])])
    letters = []
    while node != start:
        source = int(before[node])
        letters.append(int(np.argmax(allowed[source] & (delta[source] == node))))
        node = source
    return letters[::-1], end


def _reaching(delta: NDArray[np.int32], goal: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """bool `[N]`, the nodes that have a path to a goal."""
    sources = np.repeat(np.arange(len(delta)), delta.shape[1])
    return forward_reachable(delta.ravel(), sources, goal)


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
