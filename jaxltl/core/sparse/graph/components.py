"""Strongly connected components and searches of graphs given by their edges."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.rows import SCIPY_SIZE

_READY = 500  # edges from which SciPy's search is faster, once it is imported


def strong_components(source: Integers, target: Integers, num_nodes: int) -> Integers:
    """The smallest node of every node's strongly connected component: ``int[N]``."""
    if _is_quick(max(source.size, num_nodes)):
        from scipy.sparse import csgraph, csr_array

        # Repeated edges are merged (with them SciPy may not end); of Booleans they never add to zero.
        ones = np.ones(source.size, bool)
        graph = csr_array((ones, (source, target)), shape=(num_nodes, num_nodes))
        _, label = csgraph.connected_components(graph, connection="strong")
    else:
        label = _tarjan(source, target, num_nodes)
    node = np.arange(num_nodes)
    smallest = np.zeros(num_nodes, np.int64)
    smallest[label[::-1]] = node[::-1]  # of the nodes with one label the first is written last
    result: Integers = smallest[label]
    return result


def forward_reachable(source: Integers, target: Integers, start: Booleans) -> Booleans:
    """Nodes that are reachable from some nodes, these included: ``bool[N]``."""
    count = np.bincount(source, minlength=start.size)
    order = np.argsort(source, kind="stable")
    return forward_search(np.concatenate([[0], count.cumsum()]), target[order], start)


def forward_search(start: Integers, after: Integers, first: Booleans) -> Booleans:
    """Nodes that are reachable from some nodes; node i has successors ``after[start[i] : ...]``."""
    seen = first.copy()
    sources = np.flatnonzero(first)
    if _is_quick(after.size):
        from scipy import sparse
        from scipy.sparse import csgraph

        # One search from an additional node that leads to all starts.
        size = first.size + 1
        starts = np.append(start, start[-1] + sources.size)
        targets = np.concatenate([after, sources.astype(after.dtype)])
        graph = sparse.csr_array((np.ones(targets.size), targets, starts), shape=(size, size))
        order = csgraph.breadth_first_order(graph, first.size, return_predecessors=False)
        seen[order[1:]] = True
        return seen
    arrays: tuple[Any, ...] = start, after, seen
    begin, successor, mark = (memoryview(x) for x in arrays)
    todo = sources.tolist()
    while todo:
        node = todo.pop()
        for other in successor[begin[node] : begin[node + 1]]:
            if not mark[other]:
                mark[other] = True
                todo.append(other)
    return seen


def _is_quick(size: int) -> bool:
    """True if SciPy's searches are faster, its import included."""
    return size > SCIPY_SIZE // 4 or (size > _READY and "scipy.sparse.csgraph" in sys.modules)


def _tarjan(source: Integers, target: Integers, num_nodes: int) -> Integers:
    """Tarjan's algorithm (1972), with a stack of iterators instead of recursion."""
    targets = target[np.argsort(source, kind="stable")].tolist()
    ends = np.bincount(source, minlength=num_nodes).cumsum().tolist()
    after = [targets[a:b] for a, b in zip([0, *ends], ends, strict=False)]
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
