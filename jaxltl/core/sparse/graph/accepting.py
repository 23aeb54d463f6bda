"""Almost-sure acceptance on a product with an automaton: accepting end components."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxltl.core.sparse.rows import mask_of
from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.graph.qualitative import end_components, shortest_path_rows
from jaxltl.core.sparse.mdp import HostMDP


class AcceptingRegion(NamedTuple):
    """States of end components in which the least recurring priority can be even."""

    region: Booleans  # bool[S]
    row: Integers  # int32[S], an almost surely accepted policy; elsewhere the first row


def accepting_region(mdp: HostMDP, priority: Integers) -> AcceptingRegion:
    """Accepting end components under the min-even parity condition.

    For each even p: the maximal end components of the rows that read no priority below p, with a
    row that reads p (Baier and Katoen 2008, section 10.6.4, for Rabin pairs).
    """
    least = np.minimum.reduceat(priority, mdp.entry_start[:-1])
    region = np.zeros(mdp.num_states, bool)
    row = mdp.row_start[:-1].astype(np.int32)
    for p in np.unique(least[least % 2 == 0]):
        allowed = (least >= p) & ~region[mdp.state]
        components = end_components(mdp, rows=allowed)
        hit = components.inside & (least == p)
        wins = mask_of(components.component[mdp.state[hit]], mdp.num_states)
        new = wins[components.component] & components.region(mdp)
        inside = components.inside & new[mdp.state]
        some, first = mdp.first_choice(hit)
        taken = np.where(some, first, shortest_path_rows(mdp, some, inside))
        region |= new
        row = np.where(new, taken, row)
    return AcceptingRegion(region, row.astype(np.int32))
