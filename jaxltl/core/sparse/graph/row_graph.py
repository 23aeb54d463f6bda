"""Graph of a model with sparse rows; masks of rows take the place of masks of actions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.graph.product_graph import HostGraph
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import group_starts, decrement, sorted_unique, concatenated_ranges


@dataclass(frozen=True)
class RowGraph:
    """The operations of a HostGraph for sparse rows: a mask is ``bool[R]``, an action is a row."""

    host: HostMDP

    xp = np

    @property
    def state_shape(self) -> tuple[int, ...]:
        return (self.host.num_states,)

    @cached_property
    def available(self) -> Booleans:
        """``bool[R]``."""
        return np.ones(self.host.num_rows, bool)

    def on_choices(self, states: Booleans) -> Booleans:
        """A set of states as a mask of rows: ``bool[R]``."""
        return states[self.host.state]

    def exists(self, region: Booleans) -> Booleans:
        """Whether some successor lies in a region: ``bool[R]``."""
        return self.host.support.some_successor_in(region)

    def forall(self, region: Booleans) -> Booleans:
        """Whether all successors lie in a region: ``bool[R]``."""
        return ~self.exists(~region)

    def first(self, mask: Booleans) -> tuple[Booleans, Integers]:
        """Whether a mask holds for some row of a state, and the first one (or its first row)."""
        return self.host.first_choice(mask)

    def attract(
        self, goal: Booleans, allowed: Booleans, rule: Booleans, among: Booleans, chance: str
    ) -> tuple[Booleans, Integers, Integers]:
        """Region, row and rank of an attractor."""
        host = self.host
        start, pred = host.predecessors
        lacking = np.ones(host.num_rows, np.int32)
        if chance == "all":
            lacking = np.diff(host.entry_start).astype(np.int32)
        waiting = allowed.copy()
        left = np.bincount(host.state[allowed], minlength=host.num_states).astype(np.int32)
        region, open_ = goal.copy(), among & ~goal
        rank = np.zeros(host.num_states, np.int32)
        row = self.first(self.available)[1]
        frontier: Integers = np.flatnonzero(goal)
        alone: Integers = np.flatnonzero(~rule & (left == 0) & open_)
        round_ = 0
        while frontier.size or (round_ == 0 and alone.size):
            round_ += 1
            hit = pred[concatenated_ranges(start[frontier], start[frontier + 1] - start[frontier])]
            decrement(lacking, hit)
            hit = sorted_unique(hit[waiting[hit] & (lacking[hit] <= 0)], host.num_rows)
            waiting[hit] = False
            state = host.state[hit]
            decrement(left, state)
            joins = (rule[state] | (left[state] == 0)) & open_[state]
            state, hit = state[joins], hit[joins]
            # Rows are in order, so those of one state are contiguous.
            first = group_starts(state)
            frontier = state[first]
            row[frontier] = hit[first]
            if round_ == 1:
                frontier = np.concatenate([frontier, alone])
            open_[frontier], region[frontier], rank[frontier] = False, True, round_
        forced = region & ~goal & ~rule
        row[forced] = self.first(allowed)[1][forced]
        return region, row, rank

    def components(
        self, core: Booleans, allowed: Booleans, closed: bool
    ) -> tuple[Integers, Booleans]:
        """The components of a HostGraph: ``int32[S]``, and the rows inside, ``bool[R]``."""
        host = self.host
        if not closed:
            found = end_components(host, core, allowed)
            return found.component.astype(np.int32), found.inside
        used = allowed[host.row]
        source, target = host.state[host.row[used]], host.successor[used]
        label = strong_components(source, target, host.num_states)
        crossing = label[source] != label[target]
        left = np.zeros(host.num_states, bool)
        left[label[source[crossing]]] = True
        inside = allowed & ~left[label][host.state]
        alive = np.zeros(host.num_states, bool)
        alive[host.state[inside]] = True
        own = np.arange(host.num_states)
        return np.where(alive, label, own).astype(np.int32), inside

    anywhere = HostGraph.anywhere
    repeat = HostGraph.repeat
    times = HostGraph.times
