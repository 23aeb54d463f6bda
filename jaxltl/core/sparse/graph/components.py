"""Strongly connected components and searches of graphs given by their edges."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.rows import SCIPY_SIZE


def strong_components(source: Integers, target: Integers, num_nodes: int) -> Integers:
    """The smallest node of every node's strongly connected component: ``int[N]``.

    >>> strong_components(np.array([0, 1, 1]), np.array([1, 0, 2]), 3).tolist()
    [0, 0, 2]
    """
    if max(source.size, num_nodes) <= SCIPY_SIZE // 4:
        label = _tarjan(source, target, num_nodes)
    else:
        from scipy.sparse import csgraph

        graph = _matrix(source, target, num_nodes)
        _, label = csgraph.connected_components(graph, connection="strong")
    node = np.arange(num_nodes)
    smallest = np.zeros(num_nodes, np.int64)
    smallest[label[::-1]] = node[::-1]  # of the nodes with one label the first is written last
    return smallest[label]


def forward_reachable(source: Integers, target: Integers, start: Booleans) -> Booleans:
    """Nodes that are reachable from some nodes, these included: ``bool[N]``."""
    seen = start.copy()
    if max(source.size, start.size) > SCIPY_SIZE // 4:
        from scipy.sparse import csgraph

        # One search from an additional node that leads to every start.
        first, num_nodes = np.flatnonzero(start), start.size
        graph = _matrix(
            np.concatenate([source, np.full(first.size, num_nodes)]),
            np.concatenate([target, first]),
            num_nodes + 1,
        )
        order = csgraph.breadth_first_order(graph, num_nodes, return_predecessors=False)
        seen[order[1:]] = True
        return seen
    after = _lists(source, target, start.size)
    todo = np.flatnonzero(start).tolist()
    while todo:
        for node in after[todo.pop()]:
            if not seen[node]:
                seen[node] = True
                todo.append(node)
    return seen


def _matrix(source: Integers, target: Integers, num_nodes: int) -> Any:
    from scipy.sparse import csr_array

    # Repeated edges are merged (with them SciPy may not end); of Booleans they never add to zero.
    ones = np.ones(source.size, bool)
    return csr_array((ones, (source, target)), shape=(num_nodes, num_nodes))


def _lists(source: Integers, target: Integers, num_nodes: int) -> list[list[int]]:
    after: list[list[int]] = [[] for _ in range(num_nodes)]
    for a, b in zip(source.tolist(), target.tolist(), strict=True):
        after[a].append(b)
    return after


def _tarjan(source: Integers, target: Integers, num_nodes: int) -> Integers:
    """Tarjan's algorithm (1972), with a stack of iterators instead of recursion."""
    after = _lists(source, target, num_nodes)
    label, number = [-1] * num_nodes, [-1] * num_nodes
    low = [0] * num_nodes
    visited = components = 0
    stack: list[int] = []
    for root in range(num_nodes):
        if number[root] >= 0:
            continue
        number[root] = low[root] = visited
        visited += 1
        stack.append(root)
        path = [(root, iter(after[root]))]
        while path:
            node, rest = path[-1]
            for child in rest:
                if number[child] < 0:
                    number[child] = low[child] = visited
                    visited += 1
                    stack.append(child)
                    path.append((child, iter(after[child])))
                    break
                if label[child] < 0 and number[child] < low[node]:
                    low[node] = number[child]
            else:
                path.pop()
                if path and low[node] < low[path[-1][0]]:
                    low[path[-1][0]] = low[node]
                if low[node] == number[node]:
                    while label[node] < 0:
                        label[stack.pop()] = components
                    components += 1
    return np.array(label, np.int64).reshape(num_nodes)
