"""Reach-avoid sequences of an automaton: letters to reach, and letters to avoid until then.

A continuation of a finite word satisfies the task along a path into acceptance. Each move reads a
letter to reach, and none to avoid before it. An agent that follows such sequences generalises to
unseen formulas (Jackermeier and Abate 2025, "DeepLTL").
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core import validation
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.runs import live_states, universal_states
from jaxltl.core.logic.labels import require_known
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.graph.components import strong_components

_MAX_PATHS = 20_000  # looked at from each state


@brief
@dataclass(frozen=True)
class Sequences:
    """For each state of an automaton at most M sequences of at most D steps, shortest first.

    Attributes:
      reach: bool `[Q, M, D, E]`, alternative events to reach in a step.
      avoid: bool `[Q, M, D, E]`, those that set back the task before it.
      length: int32 `[Q, M]`, how many steps there are in all, also beyond D; for an infinite
        task, up to and with the first accepting round. 0: there is no such sequence.

    Example:
      >>> import jaxltl as jl
      >>> task = jl.to_automaton("F b", letters=[{}, {"b"}])
      >>> found = jl.automata.reach_avoid_sequences(task, [[0], [1]], ("b",), depth=1, max_sequences=1)
      >>> found.reach[0, 0].tolist(), found.length.tolist()
      ([[False, True]], [[1], [0]])
    """

    reach: NDArray[np.bool_]
    avoid: NDArray[np.bool_]
    length: NDArray[np.int32]


class _Move(NamedTuple):
    """The events that lead from one state to another with one priority."""

    target: int
    priority: int
    events: tuple[int, ...]


_Path = tuple[tuple[int, _Move], ...]  # states, and the moves that leave them


def reach_avoid_sequences(
    automaton: Automaton,
    events: ArrayLike,
    propositions: tuple[str, ...],
    *,
    depth: int = 6,
    max_sequences: int = 16,
) -> Sequences:
    """Reach-avoid sequences that lead from each state of an automaton to acceptance.

    A step from state q to state r reaches events that lead from q to r. It avoids those that lead to
    a state from which nothing is accepted, or from which acceptance is no nearer than from q,
    counted in moves. The path of an infinite task ends in a cycle with an even least priority,
    repeated up to the depth, and avoids smaller odd priorities on it. States where every word is
    accepted, or none is, have no sequence.

    Args:
      automaton: the task, with any acceptance.
      events: bool `[E, P]`, the labels that occur in the world.
      propositions: names of the P columns; the automaton need not use all.
      depth: D, the number of steps that are kept.
      max_sequences: M, the number of sequences that are kept; they differ within D steps, or in length.

    Returns:
      `Sequences` of arrays on the host.

    Raises:
      ValueError: an event that the automaton cannot read, an unknown proposition, or a size
        below 1.

    Example:
      >>> from jaxltl import to_automaton
      >>> task = to_automaton("!a U (b & F c)", letters=[{}, {"a"}, {"b"}, {"c"}])
      >>> events = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
      >>> found = reach_avoid_sequences(task, events, ("a", "b", "c"), depth=2, max_sequences=1)
      >>> found.length[0].tolist(), found.reach[0, 0].astype(int).tolist()
      ([2], [[0, 0, 1, 0], [0, 0, 0, 1]])
      >>> found.avoid[0, 0].astype(int).tolist()
      [[0, 1, 0, 0], [0, 0, 0, 0]]
    """
    depth, max_sequences = (
        validation.integer(name, number, least=1, limit=2**16)
        for name, number in (("depth", depth), ("max_sequences", max_sequences))
    )
    validation.instance("automaton", automaton, Automaton, "one of to_automaton")
    propositions = validation.distinct_names("propositions", propositions)
    delta, priority = _on_events(automaton, events, propositions)
    live, done = live_states(automaton), universal_states(automaton)
    tables = _Tables(delta, priority, live, _distances(delta, priority, live, done))
    moves = [_moves(*rows) for rows in zip(delta, priority, strict=True)]
    count, width = delta.shape
    reach = np.zeros((count, max_sequences, depth, width), bool)
    avoid, length = reach.copy(), np.zeros((count, max_sequences), np.int32)
    for q in np.flatnonzero(live & ~done):
        keys: set[tuple[int, bytes, bytes]] = set()
        for stem, cycle in _paths(int(q), moves, live, done):
            size, (wanted, shunned) = len(stem) + len(cycle), _steps(tables, stem, cycle, depth)
            key = (size, wanted.tobytes(), shunned.tobytes())
            if key in keys:
                continue
            row = len(keys)
            keys.add(key)
            reach[q, row], avoid[q, row], length[q, row] = wanted, shunned, size
            if len(keys) == max_sequences:
                break
    return Sequences(reach, avoid, length)


class _Tables(NamedTuple):
    """An automaton on events, from where words are accepted, and how far acceptance is."""

    delta: NDArray[np.int32]
    priority: NDArray[np.int32]
    live: NDArray[np.bool_]
    distance: NDArray[np.float64]


def _steps(tables: _Tables, stem: _Path, cycle: _Path, depth: int) -> NDArray[np.bool_]:
    """Letters to reach and to avoid along the moves of a path: bool `[2, D, E]`."""
    delta, priority, live, distance = tables
    least = min((m.priority for _, m in cycle), default=0)
    turns = -(-max(depth - len(stem), 0) // len(cycle)) if cycle else 0
    wanted, shunned = letters = np.zeros((2, depth, delta.shape[1]), bool)
    for i, (state, move) in enumerate((stem + cycle * turns)[:depth]):
        wanted[i, list(move.events)] = True
        after = delta[state]
        shunned[i] = ~live[after] | ((distance[after] >= distance[state]) & (after != state))
        if i >= len(stem):
            shunned[i] |= (priority[state] < least) & (priority[state] % 2 == 1)
        shunned[i] &= ~wanted[i]
    return letters


def _on_events(
    automaton: Automaton, events: ArrayLike, propositions: tuple[str, ...]
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The automaton's tables with a column for each event: int32 `[Q, E]`, twice."""
    rows = validation.float_array("events", events).astype(bool)
    if rows.ndim != 2 or rows.shape[1] != len(propositions) or not len(rows):
        raise ValueError(
            f"events has shape {list(rows.shape)}; give Booleans [E, {len(propositions)}], a "
            f"column for each of the propositions {list(propositions)}."
        )
    require_known(automaton.propositions, propositions, "the automaton")
    seen = rows[:, [list(propositions).index(p) for p in automaton.propositions]]
    same = (seen[:, None] == np.asarray(automaton.letters)[None]).all(-1)
    for e in np.flatnonzero(~same.any(1))[:1]:
        holds = [p for p, h in zip(propositions, rows[e], strict=True) if h]
        raise ValueError(
            f"the automaton does not read the event {{{', '.join(holds)}}}. Make it with all "
            "letters that occur, as to_automaton does by default."
        )
    letter = same.argmax(1)
    return np.asarray(automaton.delta)[:, letter], np.asarray(automaton.priority)[:, letter]


def _moves(delta: NDArray[np.int32], priority: NDArray[np.int32]) -> list[_Move]:
    groups: dict[tuple[int, int], list[int]] = {}
    for event, (target, number) in enumerate(zip(delta.tolist(), priority.tolist(), strict=True)):
        groups.setdefault((target, number), []).append(event)
    return [_Move(target, number, tuple(group)) for (target, number), group in groups.items()]


def _distances(
    delta: NDArray[np.int32],
    priority: NDArray[np.int32],
    live: NDArray[np.bool_],
    done: NDArray[np.bool_],
) -> NDArray[np.float64]:
    """The moves from each state up to one that accepts: into `done`, or on an accepting cycle."""
    count, width = delta.shape
    source = np.repeat(np.arange(count), width)
    target, number = delta.ravel(), priority.ravel()
    accepts = done[target]
    for even in np.unique(number[number % 2 == 0]):
        used = (number >= even) & live[source] & live[target]
        part = strong_components(source[used], target[used], count)
        accepts |= used & (number == even) & (part[source] == part[target])
    distance = np.where(done, 0.0, np.inf)
    np.minimum.at(distance, source[accepts], np.where(done[source[accepts]], 0.0, 1.0))
    for _ in range(count):
        nearer = distance.copy()
        np.minimum.at(nearer, source, distance[target] + 1)
        if (nearer == distance).all():
            break
        distance = nearer
    return distance


def _paths(
    start: int, moves: list[list[_Move]], live: NDArray[np.bool_], done: NDArray[np.bool_]
) -> Iterator[tuple[_Path, _Path]]:
    """Stems, and cycles with an even least priority that follow them, shortest first."""
    queue: deque[_Path] = deque([()])
    for _ in range(_MAX_PATHS):
        if not queue:
            return
        path = queue.popleft()
        state = path[-1][1].target if path else start
        visited = [s for s, _ in path]
        for move in moves[state]:
            longer = (*path, (state, move))
            if done[move.target]:
                yield longer, ()
            elif move.target == state or move.target in visited:
                begin = (*visited, state).index(move.target)
                cycle = longer[begin:]
                if min(m.priority for _, m in cycle) % 2 == 0:
                    yield longer[:begin], cycle
            elif live[move.target]:
                queue.append(longer)
