"""Where runs beside an automaton are accepted almost surely: end components of sparse rows."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.host.rows import Booleans, Integers
from jaxltl.core.host.sparse import HostMDP
from jaxltl.core.host.sparse_graph import end_components


class AcceptingRegion(NamedTuple):
    """The states of end components whose least priority can be even for ever.

    Attributes:
      region: ``bool[S]``.
      row: ``int32[S]``, in the region the row of a policy by which almost every run is accepted;
        elsewhere a state's first.
    """

    region: Booleans
    row: Integers


def accepting_region(mdp: HostMDP, priority: Integers) -> AcceptingRegion:
    """Where the least priority that is read for ever can be even.

    For each even p: the maximal end components of the rows that read no priority below p, with a
    row that reads p (Baier and Katoen 2008, section 10.6.4, for Rabin pairs). A run is accepted
    with the largest probability of reaching them.

    Args:
      mdp: the product.
      priority: ``int[T]``, what each entry reads.

    Example:
      >>> from jaxltl.core.models.sparse import make_sparse
      >>> ring = make_sparse(None, [0, 1, 2, 3], [1, 0, 2], [1.0, 1.0, 1.0]).host
      >>> accepting_region(ring, np.array([1, 0, 1])).region.tolist()
      [True, True, False]
    """
    least = np.minimum.reduceat(priority, mdp.entry_start[:-1])
    region = np.zeros(mdp.num_states, bool)
    row = mdp.row_start[:-1].astype(np.int32)
    for p in np.unique(least[least % 2 == 0]):
        allowed = (least >= p) & ~region[mdp.state]
        components = end_components(mdp, rows=allowed)
        hit = components.inside & (least == p)
        wins = np.zeros(mdp.num_states, bool)
        wins[components.component[mdp.state[hit]]] = True
        new = wins[components.component] & components.region(mdp)
        inside = components.inside & new[mdp.state]
        some, first = mdp.first_choice(hit)
        taken = np.where(some, first, towards(mdp, some, inside))
        region |= new
        row = np.where(new, taken, row)
    return AcceptingRegion(region, row.astype(np.int32))


def towards(mdp: HostMDP, goal: Booleans, rows: Booleans) -> Integers:
    """A row by which each state may come nearer to a goal, among some rows: ``int32[S]``.

    The first row of states at the goal, and of those that cannot get there.
    """
    first = mdp.row_start[:-1].astype(np.int32)
    if not (rows & ~goal[mdp.state]).any():
        return first
    nearer = _next_on_the_way(mdp, goal, rows)
    entry = np.flatnonzero(rows[mdp.row] & (nearer[mdp.state[mdp.row]] == mdp.successor))
    row = mdp.row[entry][::-1]
    first[mdp.state[row]] = row  # the first one is written last
    return first


def _next_on_the_way(mdp: HostMDP, goal: Booleans, rows: Booleans) -> Integers:
    """The next state on a shortest path to a goal, ``int[S]``; -1 at it and where there is none."""
    from scipy.sparse import csgraph, csr_array

    start, row = mdp.predecessors
    kept = rows[row]
    last = np.flatnonzero(goal)
    # One search backwards, from a node of its own that leads to every goal.
    index = np.concatenate([[0], kept.cumsum()])[start]
    edges = np.concatenate([mdp.state[row[kept]], last])
    size = mdp.num_states + 1
    graph: Any = csr_array(
        (np.ones(edges.size), edges, np.append(index, edges.size)), shape=(size, size))
    _, before = csgraph.breadth_first_order(graph, size - 1, return_predecessors=True)
    before = before[:-1]
    return np.where((before < 0) | (before == size - 1), -1, before)
