"""Topological levels and strongly connected components of the graph of a linear system."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.rows import Rows, concatenated_ranges, decrement, sorted_unique

# Levels at most, and nodes for each further one: narrower levels are eliminated faster.
_ROUNDS, _NODES = 16, 64


class Edges(NamedTuple):
    """A graph: node i has successors ``target[start[i] : start[i + 1]]``, possibly repeated."""

    start: Integers
    target: Integers

    @property
    def num_nodes(self) -> int:
        return self.start.size - 1

    def reverse(self) -> Edges:
        """The graph with reversed edges."""
        return Edges(*Rows(self.start, self.target, self.num_nodes).predecessors)


class Levels(NamedTuple):
    """Nodes in an order in which each has only earlier successors."""

    node: Integers  # int[M]
    start: list[int]  # starts of levels in it, and M; nodes of a level are not connected


def topological_levels(back: Edges, number: Integers, among: Booleans) -> Levels:
    """Levels of the nodes that reach no cycle, by Kahn's algorithm (1962)."""
    levels: list[Integers] = []
    start = [0]
    frontier: Integers = np.flatnonzero(among & (number == 0))
    max_levels = _ROUNDS + number.size // _NODES
    while frontier.size and len(levels) < max_levels:
        levels.append(frontier)
        start.append(start[-1] + frontier.size)
        among[frontier] = False
        first = back.start[frontier]
        source = back.target[concatenated_ranges(first, back.start[frontier + 1] - first)]
        decrement(number, source)
        frontier = sorted_unique(source[(number[source] == 0) & among[source]], number.size)
    none: Integers = np.zeros(0, np.int64)
    return Levels(np.concatenate(levels) if levels else none, start)


def ordered_components(edges: Edges) -> Integers:
    """Strongly connected components in topological order, ``int[N]``: no edge leads to a greater number."""
    from scipy import sparse
    from scipy.sparse import csgraph

    size = edges.num_nodes
    ones = np.ones(edges.target.size)
    graph = sparse.csr_array((ones, edges.target.copy(), edges.start.copy()), shape=(size, size))
    graph.sum_duplicates()  # with repeated edges SciPy may not end
    _, label = csgraph.connected_components(graph, connection="strong")
    source = np.repeat(np.arange(size), np.diff(graph.indptr))
    if (label[source] >= label[graph.indices]).all():
        result: Integers = label
        return result
    return _sorted(label, label[source], label[graph.indices])


def _sorted(label: Integers, source: Integers, target: Integers) -> Integers:
    """The same components in topological order (Kahn 1962)."""
    between = source != target
    count = int(label.max()) + 1
    pairs = np.unique(np.stack([source[between], target[between]], -1), axis=0)
    start = np.concatenate([[0], np.bincount(pairs[:, 0], minlength=count).cumsum()])
    after = Edges(start, pairs[:, 1])
    number = np.diff(start)
    back, order = after.reverse(), np.zeros(count, np.int64)
    todo, place = np.flatnonzero(number == 0).tolist(), 0
    while todo:
        one = todo.pop()
        order[one] = place
        place += 1
        for source_ in back.target[back.start[one] : back.start[one + 1]].tolist():
            number[source_] -= 1
            if not number[source_]:
                todo.append(source_)
    return order[label]
