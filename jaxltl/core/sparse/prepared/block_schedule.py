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
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts, row_entries

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
    count, most, width = nodes.number, *_shape(nodes)
    nodes = _narrow_rows(nodes, width, one)
    nodes, choices = _narrow_nodes(nodes, most, one)
    parts = [[level for level in part if level.size] for part in _ordered(nodes)]
    size = _block_size([x.size for part in parts for x in part], most * width)
    place: Integers = np.zeros(nodes.number, np.int32)
    blocks, start = [], 0
    for part in parts:
        blocks.append(start // size)
        for level in part:
            place[level] = start + np.arange(level.size)
            start += -(-level.size // size) * size
    total = start
    blocks.append(total // size)
    target, source, name = _filled(nodes, place, total, (most, width, size), nothing)
    segments = [Segment(target[a:b], source[a:b], name[a:b]) for a, b in pairwise(blocks)]
    levels = sum(map(len, parts))
    return Schedule((segments[0], segments[1], segments[2]), place[:count], total, levels, choices)


def _ranks(group: Integers, count: int) -> Integers:
    """The rank of each element within its group; groups ascend."""
    size = np.bincount(group, minlength=count)
    return np.arange(group.size) - np.repeat(size.cumsum() - size, size)


def _shape(nodes: Nodes) -> tuple[int, int]:
    """Block shape (rows per node, entries per row) of least padding."""
    rows = np.bincount(np.bincount(nodes.owner, minlength=nodes.number))
    widths = np.bincount(np.bincount(nodes.row, minlength=nodes.owner.size))
    mosts = [a for a in _WIDTHS if a > 1 and a < 2 * rows.size] if rows.size > 2 else [1]
    best: tuple[float, int, int] | None = None
    for w in (w for w in _WIDTHS if w == 1 or w < 2 * widths.size):
        if w == 1 and widths.size > 2:
            continue
        more = _split(widths, w)
        for a in mosts:
            cost = (nodes.number + more + _split(rows, a)) * (a * w + 1)
            if best is None or cost < best[0]:
                best = cost, a, w
    assert best is not None
    return best[1], best[2]


def _split(histogram: Integers, most: int) -> int:
    """Number of auxiliary nodes that split groups of more than `most` elements."""
    total = 0
    for size in range(most + 1, histogram.size):
        left = size
        while histogram[size] and left > most:
            whole, rest = divmod(left, most)
            total += int(histogram[size]) * (whole + (rest > 1))
            left = whole + (rest > 0)
    return total


def _narrow_rows(nodes: Nodes, width: int, one: int) -> Nodes:
    """The system with wide rows split among auxiliary nodes."""
    count, owner, name, row, target, source = nodes
    while True:
        size = np.bincount(row, minlength=owner.size)
        if not (size > width).any():
            return Nodes(count, owner, name, row, target, source)
        moved, group, first, group_of = _groups(row, size, width)
        fresh = np.arange(first.size)
        heads = row[first]  # the rows that lead to the new nodes
        row = row.copy()
        row[moved] = owner.size + group_of
        row = np.concatenate([row, heads])
        target = np.concatenate([target, count + fresh])
        source = np.concatenate([source, np.full(group, one)])
        order = np.argsort(row, kind="stable")
        row, target, source = row[order], target[order], source[order]
        owner = np.concatenate([owner, count + fresh])
        name = np.concatenate([name, np.zeros(group, name.dtype)])
        count += group


def _groups(of: Integers, size: Integers, most: int) -> tuple[Integers, int, Integers, Integers]:
    """Elements to move out of large groups, with the number, heads and ids of the new groups."""
    rank = _ranks(of, size.size)
    alone = (rank % most == 0) & (rank == size[of] - 1)  # one that would be a group alone
    moved = np.flatnonzero((size[of] > most) & ~alone)
    new = rank[moved] % most == 0
    group_of = np.cumsum(new) - 1
    first = moved[new]
    return moved, first.size, first, group_of


def _narrow_nodes(nodes: Nodes, most: int, one: int) -> tuple[Nodes, int]:
    """The system with nodes of many rows split, and the number of rounds."""
    count, owner, name, row, target, source = nodes
    rounds = 0
    while True:
        size = np.bincount(owner, minlength=count)
        if not (size > most).any():
            return Nodes(count, owner, name, row, target, source), rounds
        rounds += 1
        moved, group, first, group_of = _groups(owner, size, most)
        fresh = np.arange(group)
        heads = owner[first]
        owner = owner.copy()
        owner[moved] = count + group_of
        row = np.concatenate([row, owner.size + fresh])
        target = np.concatenate([target, count + fresh])
        source = np.concatenate([source, np.full(group, one)])
        owner = np.concatenate([owner, heads])
        name = np.concatenate([name, -1 - (count + fresh)])
        order = np.argsort(owner, kind="stable")
        number = np.empty(order.size, np.int64)
        number[order] = np.arange(order.size)
        row = number[row]
        entries = np.argsort(row, kind="stable")
        row, target, source = row[entries], target[entries], source[entries]
        owner, name = owner[order], name[order]
        count += group


# --- the order ----------------------------------------------------------------------------------


def _ordered(nodes: Nodes) -> list[list[Integers]]:
    """Topological levels before, on and after cycles."""
    edges = _edges(nodes)
    back, among = edges.reverse(), np.ones(nodes.number, bool)
    below = _peeled(back, np.diff(edges.start).astype(np.int32), among)
    if not among.any():
        return [below, [], []]
    inner = among[np.repeat(np.arange(nodes.number), np.diff(back.start))] & among[back.target]
    left = np.concatenate([[0], inner.cumsum()])[back.start]
    above = _peeled(edges, np.diff(left).astype(np.int32), among)
    return [below, _layers(edges, np.flatnonzero(among)), above[::-1]]


def _edges(nodes: Nodes) -> Edges:
    kept = nodes.target >= 0
    source = nodes.owner[nodes.row[kept]]
    return _graph(source, nodes.target[kept].astype(np.int64), nodes.number)


def _graph(source: Integers, target: Integers, size: int) -> Edges:
    """The graph of edges by ascending source."""
    return Edges(offsets_from_counts(np.bincount(source, minlength=size)), target)


def _peeled(back: Edges, number: Integers, among: Booleans) -> list[Integers]:
    found: list[Integers] = []
    while True:
        more = topological_levels(back, number, among)
        if not more.node.size:
            return found
        found += [more.node[a:b] for a, b in pairwise(more.start)]


def _layers(edges: Edges, core: Integers) -> list[Integers]:
    """Nodes on cycles, by their distance from the exits of their component."""
    number: Integers = np.full(edges.num_nodes, -1, np.int64)
    number[core] = np.arange(core.size)
    width = edges.start[core + 1] - edges.start[core]
    target = number[edges.target[concatenated_ranges(edges.start[core], width)]]
    source = np.repeat(np.arange(core.size), width)
    leaves = np.zeros(core.size, bool)
    leaves[source[target < 0]] = True
    source, target = source[target >= 0], target[target >= 0]
    label = ordered_components(_graph(source, target, core.size))
    same = label[source] == label[target]
    leaves[source[~same]] = True
    layer = _distances(source[same], target[same], leaves, label)
    kept = (label[target] < label[source]) | (same & (layer[target] < layer[source]))
    onward = _graph(source[kept], target[kept], core.size)
    degree = np.diff(onward.start).astype(np.int32)
    levels = _peeled(onward.reverse(), degree, np.ones(core.size, bool))
    return [core[x] for x in levels]


def _distances(source: Integers, target: Integers, leaves: Booleans, label: Integers) -> Integers:
    """Distance from the exits of each strongly connected component."""
    size = leaves.size
    start = offsets_from_counts(np.bincount(target, minlength=size))
    before = source[np.argsort(target, kind="stable")]
    stuck = ~np.isin(label, np.unique(label[leaves]))
    first: Integers = np.full(int(label.max()) + 1, -1, np.int64)
    first[label[stuck][::-1]] = np.flatnonzero(stuck)[::-1]
    frontier = np.concatenate([np.flatnonzero(leaves), first[first >= 0]])
    layer: Integers = np.full(size, -1, np.int64)
    layer[frontier], steps = 0, 0
    while frontier.size:
        steps += 1
        found = before[row_entries(start, frontier)[0]]
        found = found[layer[found] < 0]
        layer[found] = steps
        frontier = np.unique(found)
    return layer


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
    most, width, size = shape
    blocks = total // size
    if total * most * width >= 2**31:
        raise ValueError(f"the model has {nodes.row.size} entries; a schedule has room for 2^31.")
    target: Integers = np.full((blocks, most, width, size), total + 1, np.int32)
    source: Integers = np.full((blocks, most, width, size), nothing, np.int32)
    name: Integers = np.zeros((blocks, most, size), np.int32)
    at = place[nodes.owner].astype(np.int64)
    rank = _ranks(nodes.owner, nodes.number)
    link = nodes.name < 0
    name[at // size, rank, at % size] = np.where(
        link, -1 - place[np.where(link, -1 - nodes.name, 0)], nodes.name
    )
    slot = ((at // size * most + rank) * width) * size + at % size
    flat = slot[nodes.row] + _ranks(nodes.row, nodes.owner.size) * size
    inner = nodes.target >= 0
    target.reshape(-1)[flat] = np.where(
        inner, place[np.where(inner, nodes.target, 0)], total - 1 - nodes.target
    )
    source.reshape(-1)[flat] = nodes.source
    # Rows that a node has not got are its first one again.
    count: Integers = np.full(total, most)
    count[place] = np.bincount(nodes.owner, minlength=nodes.number)
    count = count.reshape(blocks, size)
    for a in range(1, most):
        c, b = np.nonzero(count <= a)
        target[c, a, :, b], source[c, a, :, b] = target[c, 0, :, b], source[c, 0, :, b]
        name[c, a, b] = name[c, 0, b]
    return target, source, name
