"""Products of automata that read the same word: cycles by their verdicts, and words through them."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.automata.table import ParityTable
from jaxltl.core.sparse.graph.components import forward_reachable, strong_components

EVEN, ODD = 0, 1

Parities = tuple[int, ...]  # of the least recurring priority of each automaton
Word = tuple[Integers, Integers]  # the letters of a prefix and of a cycle


class ProductEdges(NamedTuple):
    """E transitions, by their sources; `priority` is ``[K, E]`` for K automata.

    Of those with equal ends and priorities, the one with the first letter.
    """

    source: Integers
    target: Integers
    letter: Integers
    priority: Integers

    def chosen(self, mask: Booleans) -> ProductEdges:
        return ProductEdges(*(column[..., mask] for column in self))


class AutomataProduct(NamedTuple):
    """K automata as one graph of N nodes, numbered breadth first from the first ones."""

    states: Integers  # [N, K]
    delta: Integers  # [N, L]
    edges: ProductEdges
    number: Integers  # of each tuple of states in row-major order, -1 where it is not reached


def product(
    tables: Sequence[ParityTable], starts: Integers | None = None, max_size: float = math.inf
) -> AutomataProduct | None:
    """The product from the initial states, or some tuples; None beyond a number of transitions."""
    sizes = [len(table.delta) for table in tables]
    width = tables[0].delta.shape[1]
    if math.prod(sizes) > max_size:
        return None

    def successors(codes: Integers) -> Integers:
        states = np.unravel_index(codes, sizes)
        ends = [table.delta[state] for table, state in zip(tables, states, strict=True)]
        return np.ravel_multi_index(tuple(ends), sizes)

    if starts is None:
        starts = np.array([np.ravel_multi_index([table.initial for table in tables], sizes)])
    number = np.full(math.prod(sizes), -1)
    frontier, levels, count = starts, [], 0
    while frontier.size:
        number[frontier] = np.arange(count, count + frontier.size)
        levels.append(frontier)
        count += frontier.size
        if count * width > max_size:
            return None
        ends = successors(frontier)
        frontier = np.unique(ends[number[ends] < 0])
    codes = np.concatenate(levels)
    states, delta = np.unravel_index(codes, sizes), number[successors(codes)]
    priority = np.stack([t.priority[state] for t, state in zip(tables, states, strict=True)])
    code = delta  # of a transition's end and priorities, then its letter
    for table, state in zip(tables, states, strict=True):
        _, rank = np.unique(table.priority, return_inverse=True)
        code = code * (rank.max() + 1) + rank.reshape(table.priority.shape)[state]
    code = np.sort(code * width + np.arange(width), axis=1)
    first = np.diff(code // width, axis=1, prepend=-1) != 0
    source, letter = np.nonzero(first)[0], code[first] % width
    edges = ProductEdges(source, delta[source, letter], letter, priority[:, source, letter])
    return AutomataProduct(np.stack(states, axis=1), delta, edges, number)


def loops(
    edges: ProductEdges, num_nodes: int, wanted: Collection[Parities]
) -> Iterator[tuple[ProductEdges, Booleans]]:
    """Components whose least priorities have wanted parities, and where these are: ``bool[K, E]``.

    A transition with the least priority of its component is on no cycle of another parity, so
    that it is removed if this parity is not wanted.
    """
    waiting = [(edges, wanted)]
    while waiting:
        edges, wanted = waiting.pop()
        component = strong_components(edges.source, edges.target, num_nodes)
        edges = edges.chosen(component[edges.source] == component[edges.target])
        of = component[edges.source]
        least = np.full((len(edges.priority), num_nodes), np.iinfo(np.int64).max)
        for values, priority in zip(least, edges.priority, strict=True):
            np.minimum.at(values, of, priority)
        marks = edges.priority == least[:, of]
        wrong = [(least % 2 != np.array(parities)[:, None])[:, of] for parities in wanted]
        good = ~np.all([some.any(axis=0) for some in wrong], axis=0)
        if good.any():
            yield edges.chosen(good), marks[:, good]
        for parities, some in zip(wanted, wrong, strict=True):
            rest = ~good & ~(marks & some).any(axis=0)
            if rest.any():
                waiting.append((edges.chosen(rest), [parities]))


def may(edges: ProductEdges, num_nodes: int, wanted: Collection[Parities]) -> Booleans:
    """Nodes from which some word gives wanted parities: ``bool[N]``."""
    sources = np.zeros(num_nodes, bool)
    for inside, _ in loops(edges, num_nodes, wanted):
        sources[inside.source] = True
    return forward_reachable(edges.target, edges.source, sources)


def states_that_may(table: ParityTable, parity: int) -> Booleans:
    """bool `[Q]`, from where some word has a least recurring priority of the given parity."""
    every = product([table], np.arange(len(table.delta)))
    assert every is not None
    return may(every.edges, len(table.delta), [(parity,)])


def word_through(
    edges: ProductEdges, num_nodes: int, inside: ProductEdges, marks: Booleans
) -> Word:
    """A word from node 0 around a cycle through all marks, in the nearest of some components."""
    marked = np.flatnonzero(marks.any(axis=0))
    first = marked[np.lexsort((-marks[:, marked].sum(axis=0), inside.source[marked]))[0]]
    home = np.arange(num_nodes) == inside.source[first]
    prefix, _ = _walk(edges, 0, home)
    cycle, node = [int(inside.letter[first])], int(inside.target[first])
    for mark in marks[~marks[:, first]]:
        goal = np.zeros(num_nodes, bool)
        goal[inside.source[mark]] = True
        path, node = _walk(inside, node, goal)
        step = np.flatnonzero(mark & (inside.source == node))[0]
        cycle += [*path, int(inside.letter[step])]
        node = int(inside.target[step])
    back, _ = _walk(inside, node, home)
    return np.array(prefix, int), np.array(cycle + back, int)


def _walk(edges: ProductEdges, start: int, goal: Booleans) -> tuple[list[int], int]:
    """The letters of a shortest path to a goal, which must be reachable, and its end."""
    reached = np.zeros(goal.size, bool)
    reached[start] = True
    last = np.full(goal.size, -1)  # the edge to each node on a shortest path
    while not (reached & goal).any():
        fresh = np.flatnonzero(reached[edges.source] & ~reached[edges.target])[::-1]
        last[edges.target[fresh]] = fresh
        reached[edges.target[fresh]] = True
    end = node = int(np.argmax(reached & goal))
    letters = []
    while node != start:
        letters.append(int(edges.letter[last[node]]))
        node = int(edges.source[last[node]])
    return letters[::-1], end
