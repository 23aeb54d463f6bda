"""Topological block schedule of a sparse system, with blocks padded to equal shape.

Nodes stand in an order in which most lead to earlier ones. The value of a node is the optimum of
at most A rows of at most W entries; wider ones are split among auxiliary nodes. Blocks of B nodes
are evaluated one after the other. Where nodes lie on cycles, layers nearer to the exits of a
strongly connected component come first, and entries that lead on read the previous values.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.linear.topological_order import (
    Edges,
    ordered_components,
    topological_levels,
)
from jaxltl.core.sparse.rows import offsets_from_counts

# Targets of entries besides nodes: the value one, the goal, and the losing states.
ONE, GOAL, LOST = -1, -2, -3
_WIDTHS = (1, 2, 3, 4, 6, 8, 12, 16)
_BLOCKS = (16, 32, 64, 128, 256, 512, 1024)
_BLOCK_COST = 2000.0  # a block, in parts of what an entry costs times
_ENTRY_COST = 1.5


class Nodes(NamedTuple):
    """Optimality equations: a node is the optimum of its rows, a row a weighted sum of entries."""

    number: int  # how many nodes there are
    owner: Integers  # int[R], the node of each row, ascending
    name: Integers  # int[R], what a row is called, at least 0
    row: Integers  # int[T], the row of each entry, ascending
    target: Integers  # int[T], a node, ONE, GOAL or LOST
    source: Integers  # int[T], which number weighs the entry


class Segment(NamedTuple):
    """Consecutive blocks of a schedule."""

    target: Integers  # int32[C, A, W, B], places of nodes, or N, N + 1, N + 2 for ONE, GOAL, LOST
    source: Integers  # int32[C, A, W, B]
    name: Integers  # int32[C, A, B], of rows; -1 - p of those that are what node p chose


class Schedule(NamedTuple):
    """Three segments: nodes before, on (or between) and after cycles."""

    segments: tuple[Segment, Segment, Segment]  # three of them, maybe empty
    place: Integers  # int[M], where each of the M nodes stands among the N
    size: int  # N
    levels: int  # depth of dependencies, where there are no cycles
    choices: int  # how often a choice may be split


def schedule(nodes: Nodes, one: int, nothing: int) -> Schedule:
    """The block schedule of a system."""
    count, depth, width = nodes.number, *_shape(nodes)
    nodes, _ = _split(nodes, width, one, of_rows=False)
    nodes, choices = _split(nodes, depth, one, of_rows=True)
    parts = [[level for level in part if level.size] for part in _ordered(nodes)]
    size = _block_size([x.size for part in parts for x in part], depth * width)
    place: Integers = np.zeros(nodes.number, np.int32)
    blocks, start = [], 0
    for part in parts:
        blocks.append(start // size)
        for level in part:
            place[level] = start + np.arange(level.size)
            start += -(-level.size // size) * size
    blocks.append(start // size)
    target, source, name = _filled(nodes, place, start, (depth, width, size), nothing)
    segments = [Segment(target[a:b], source[a:b], name[a:b]) for a, b in pairwise(blocks)]
    levels = sum(map(len, parts))
    return Schedule((segments[0], segments[1], segments[2]), place[:count], start, levels, choices)


def _ranks(group: Integers, count: int) -> Integers:
    """The rank of each element within its group; groups ascend."""
    size = np.bincount(group, minlength=count)
    return np.arange(group.size) - np.repeat(size.cumsum() - size, size)


def _shape(nodes: Nodes) -> tuple[int, int]:
    """Block shape (rows per node, entries per row) of least padding."""
    rows = np.bincount(nodes.owner, minlength=nodes.number)
    widths = np.bincount(nodes.row, minlength=nodes.owner.size)
    cost = {
        (a, w): (nodes.number + _num_auxiliary(rows, a) + _num_auxiliary(widths, w)) * (a * w + 1)
        for a in _limits(rows)
        for w in _limits(widths)
    }
    return min(cost, key=cost.__getitem__)


def _limits(size: Integers) -> list[int]:
    """Limits of the sizes of groups; groups of one element cannot be nested."""
    largest = size.max(initial=1)
    return [1] if largest == 1 else [x for x in _WIDTHS if 1 < x < 2 * (largest + 1)]


def _num_auxiliary(size: Integers, limit: int) -> int:
    """Number of auxiliary nodes that split groups of more than `limit` elements."""
    large = size[size > limit]
    return int((-(-(large - 1) // max(limit - 1, 1)) - 1).sum())


def _split(nodes: Nodes, limit: int, one: int, *, of_rows: bool) -> tuple[Nodes, int]:
    """The system with large groups, of rows or of entries, split; and the number of rounds."""
    rounds = 0
    while True:
        group = nodes.owner if of_rows else nodes.row
        size = np.bincount(group, minlength=1)
        if not (size > limit).any():
            return nodes, rounds
        rank = _ranks(group, size.size)
        alone = (rank % limit == 0) & (rank == size[group] - 1)  # would be a group alone
        moved = np.flatnonzero((size[group] > limit) & ~alone)
        new = rank[moved] % limit == 0
        head = group[moved[new]]
        node = nodes.number + np.arange(head.size)
        more = nodes.owner.size + np.arange(head.size)
        owner, row = nodes.owner.copy(), nodes.row.copy()
        if of_rows:  # the old node gets a row that leads to the new one
            owner[moved] = node[np.cumsum(new) - 1]
            owners, names, rows = head, -1 - node, more
        else:  # the new node gets a row, and the old row an entry that leads to it
            row[moved] = more[np.cumsum(new) - 1]
            owners, names, rows = node, np.zeros_like(node), head
        nodes = _in_order(
            Nodes(
                nodes.number + head.size,
                np.append(owner, owners),
                np.append(nodes.name, names),
                np.append(row, rows),
                np.append(nodes.target, node),
                np.append(nodes.source, np.full(head.size, one)),
            )
        )
        rounds += 1


def _in_order(nodes: Nodes) -> Nodes:
    """The same system with ascending owners and rows."""
    order = np.argsort(nodes.owner, kind="stable")
    row = np.argsort(order)[nodes.row]
    entries = np.argsort(row, kind="stable")
    return Nodes(
        nodes.number,
        nodes.owner[order],
        nodes.name[order],
        row[entries],
        nodes.target[entries],
        nodes.source[entries],
    )


# --- the order ----------------------------------------------------------------------------------


def _ordered(nodes: Nodes) -> list[list[Integers]]:
    """Topological levels before, on and after cycles."""
    inner = nodes.target >= 0
    source, target = nodes.owner[nodes.row[inner]], nodes.target[inner].astype(np.int64)
    edges = _graph(source, target, nodes.number)
    back, cyclic = edges.reverse(), np.ones(nodes.number, bool)
    below = _peeled(back, np.diff(edges.start), cyclic)
    core = np.flatnonzero(cyclic)
    if not core.size:
        return [below, [], []]
    before = cyclic[np.repeat(np.arange(nodes.number), np.diff(back.start))] & cyclic[back.target]
    degree = np.diff(np.append(0, before.cumsum())[back.start])
    above = _peeled(edges, degree, cyclic)
    core = np.flatnonzero(cyclic)
    number = np.full(nodes.number, -1)
    number[core] = np.arange(core.size)
    kept = cyclic[source]
    layers = _layers(number[source[kept]], number[target[kept]], core.size)
    return [below, [core[x] for x in layers], above[::-1]]


def _graph(source: Integers, target: Integers, size: int) -> Edges:
    """The graph of edges by ascending source."""
    return Edges(offsets_from_counts(np.bincount(source, minlength=size)), target)


def _peeled(back: Edges, degree: Integers, among: Booleans) -> list[Integers]:
    """All levels of the nodes that reach no cycle; removes them from a set."""
    levels: list[Integers] = []
    number = degree.astype(np.int32)
    while True:
        more = topological_levels(back, number, among)
        if not more.node.size:
            return levels
        levels += [more.node[a:b] for a, b in pairwise(more.start)]


def _layers(source: Integers, target: Integers, size: int) -> list[Integers]:
    """Nodes on cycles, by their distance from the exits of their component to nodes elsewhere (-1)."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    inner = target >= 0
    label = ordered_components(_graph(source[inner], target[inner], size))
    same = inner & (label[source] == label[target])
    back = csr_array((np.ones(same.sum()), (target[same], source[same])), shape=(size, size))
    exits = np.unique(source[~same])
    _, first = np.unique(label, return_index=True)
    closed = first[np.bincount(label[exits], minlength=first.size) == 0]
    seeds = np.append(exits, closed)
    layer = dijkstra(back, indices=seeds, unweighted=True, min_only=True)
    onward = (label[target] < label[source]) | (same & (layer[target] < layer[source]))
    onward &= inner
    graph = _graph(source[onward], target[onward], size)
    return _peeled(graph.reverse(), np.diff(graph.start), np.ones(size, bool))


# --- the blocks ---------------------------------------------------------------------------------


def _block_size(widths: list[int], entries: int) -> int:
    level = np.asarray(widths or [1])
    costs = []
    for size in _BLOCKS:
        blocks = int((-(-level // size)).sum())
        costs.append(blocks * (_BLOCK_COST + size * entries * _ENTRY_COST))
    return _BLOCKS[int(np.argmin(costs))]


def _filled(
    nodes: Nodes, place: Integers, total: int, shape: tuple[int, int, int], nothing: int
) -> tuple[Integers, Integers, Integers]:
    """Padded arrays of all blocks."""
    depth, width, size = shape
    blocks = total // size
    if total * depth * width >= 2**31:
        raise ValueError(f"the model has {nodes.row.size} entries; a schedule has room for 2^31.")
    target: Integers = np.full((blocks, depth, width, size), total + 1, np.int32)
    source: Integers = np.full((blocks, depth, width, size), nothing, np.int32)
    name: Integers = np.zeros((blocks, depth, size), np.int32)
    at = place[nodes.owner].astype(np.int64)
    rank = _ranks(nodes.owner, nodes.number)
    link = nodes.name < 0
    name[at // size, rank, at % size] = np.where(
        link, -1 - place[np.where(link, -1 - nodes.name, 0)], nodes.name
    )
    slot = ((at // size * depth + rank) * width) * size + at % size
    flat = slot[nodes.row] + _ranks(nodes.row, nodes.owner.size) * size
    inner = nodes.target >= 0
    target.reshape(-1)[flat] = np.where(
        inner, place[np.where(inner, nodes.target, 0)], total - 1 - nodes.target
    )
    source.reshape(-1)[flat] = nodes.source
    # Rows that a node has not got are its first one again.
    count: Integers = np.full(total, depth)
    count[place] = np.bincount(nodes.owner, minlength=nodes.number)
    count = count.reshape(blocks, size)
    for a in range(1, depth):
        c, b = np.nonzero(count <= a)
        target[c, a, :, b], source[c, a, :, b] = target[c, 0, :, b], source[c, 0, :, b]
        name[c, a, b] = name[c, 0, b]
    return target, source, name
