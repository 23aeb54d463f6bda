"""Optimality operator of policy and nature: ``max_r opt_p (c_r + sum_t p_t x_t)`` on nodes.

A node is a state, or an end component collapsed into one state. Values carry a sign such that the
policy maximises. Rows are weighed by differences of values, ``sum_t p_t (x_t - x_s)``, so that a
state that nature may hold with almost all mass loses no precision.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import shortest_path_rows
from jaxltl.core.sparse.interval.row_table import RowTable
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP, scatter
from jaxltl.core.sparse.linear.extended_precision import TwoFloats, two_float_difference
from jaxltl.core.sparse.linear.topological_order import Edges, ordered_components
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import mask_of, offsets_from_counts, row_entries
from jaxltl.core.sparse.solvers.reachability import expands_fast

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_EPS = float(np.finfo(np.float64).eps)
_TINY = 1e-290
_FEW = 300  # nodes up to which systems are eliminated
_REACHED = 4096  # nodes that a few steps must reach for Krylov steps to come first

Distributions = list[Floats]  # one array for each block


@dataclass(frozen=True)
class PolicyPair:
    """A policy and nature's distributions, with approximate values."""

    chosen: Integers  # int[M], the row of each node
    p: Distributions  # nature's distributions
    value: Floats  # float64[M], of the pair
    steps: Floats  # float64[M], expected number of steps
    bound: Floats | None = None  # float64[M], a proven bound of the optimum


class PairSystem(NamedTuple):
    """``x = matrix x + earned``, the values of a pair, self-loops eliminated."""

    matrix: csr_array
    earned: Floats


class TargetValues(NamedTuple):
    """Values of the nodes and of the known states, in one or two floats."""

    high: Floats
    low: Floats | None


@dataclass(frozen=True)
class TableBlock:
    """A table of rows."""

    table: RowTable
    target: Integers  # int[W, N], successors: nodes, and M plus the state where the value is known
    owner: Integers  # int[N], the node of each row
    leaves: Booleans | None  # bool[W, N], entries that leave their node; None if all do

    def differences(self, values: TargetValues, step_reward: float | Floats = 0.0) -> Floats:
        """``x_t - x_s`` of each entry, plus a reward for leaving the node, ``float64[W, N]``."""
        high, low, target, owner = values.high, values.low, self.target, self.owner
        if low is None:
            ahead = high[target]
            ahead -= high[owner]
        else:
            ahead = two_float_difference(high[target], low[target], high[owner], low[owner])
        if isinstance(step_reward, np.ndarray):
            step_reward = step_reward[self.owner]
        elif not step_reward:
            return ahead
        ahead += step_reward if self.leaves is None else step_reward * self.leaves
        return ahead

    def leaving(self, p: Floats) -> Floats:
        """Mass that leaves the node of each row, ``float64[N]``."""
        mass: Floats = (p if self.leaves is None else p * self.leaves).sum(0)
        return mass


@dataclass(frozen=True)
class RowOperator:
    """The operator on M nodes."""

    part: UncertainMDP  # the rows by node; successors are states
    row: Integers  # int[R'], int[T'], the rows and entries of the original model
    entry: Integers
    node: Integers  # int[S], -1 where the value is known
    sign: int  # 1 if the policy maximises, -1 if it minimises the values without sign
    known: Floats  # float64[S], with sign
    cost: Floats  # float64[R'], reward of each row, with sign
    depth: int  # roundings behind each number of the model
    adversarial: bool  # whether nature minimises

    @property
    def size(self) -> int:
        return self.part.mdp.num_states

    @cached_property
    def ceiling(self) -> float:
        """An upper bound of all values, if one is known."""
        return np.inf if self.cost.any() else max(float(self.known.max()), 0.0)

    @cached_property
    def widest(self) -> int:
        """The largest number of entries of a row, plus the depth."""
        return int(np.diff(self.part.mdp.entry_start).max()) + self.depth

    @cached_property
    def blocks(self) -> list[TableBlock]:
        mdp, blocks = self.part.mdp, []
        target = self.node[mdp.successor]
        index = np.where(target < 0, self.size + mdp.successor, target).astype(np.int32)
        for table in self.part.tables:
            owner, to = mdp.state[table.row], index[table.entry]
            if table.used is not None:
                to = np.where(table.used, to, owner)
            leaves = to != owner
            blocks.append(TableBlock(table, to, owner, None if leaves.all() else leaves))
        return blocks

    @cached_property
    def label(self) -> Integers:
        """Strongly connected components of the nodes in topological order."""
        mdp = self.part.mdp
        owner, target = mdp.state[mdp.row], self.node[mdp.successor]
        kept = (target != owner) & (target >= 0)
        count = np.bincount(owner[kept], minlength=self.size)
        return ordered_components(Edges(offsets_from_counts(count), target[kept]))

    @cached_property
    def mixes(self) -> bool:
        """True if few steps lead to many nodes."""
        if self.size < _FEW:
            return False
        first, to = self.part.mdp.entry_start[self.part.mdp.row_start], self.part.mdp.successor

        def follow(nodes: Integers) -> Integers:
            after = self.node[to[row_entries(first, nodes)[0]]]
            return after[after >= 0]

        middle, reached = self.size // 2, min(_REACHED, self.size // 2)
        return expands_fast(follow, np.array([middle]), self.size, reached)

    def values(self, z: Floats | TwoFloats) -> TargetValues:
        """Values at the targets of entries."""
        if not isinstance(z, TwoFloats):
            return TargetValues(np.concatenate([z, self.known]), None)
        low = np.concatenate([z.low, np.zeros(self.known.size)])
        return TargetValues(np.concatenate([z.high, self.known]), low)

    def answer(self, block: TableBlock, gain: Floats) -> Floats:
        """Nature's optimal distributions for the gains of entries."""
        return block.table.extreme(gain if self.adversarial else -gain)

    # --- pairs --------------------------------------------------------------------------------

    def interior(self) -> Distributions:
        """Distributions with full support."""
        p = self.part.interior_distributions(np.ones(self.part.mdp.num_transitions, bool))
        return [
            p[b.table.entry]
            if b.table.used is None
            else np.where(b.table.used, p[b.table.entry], 0)
            for b in self.blocks
        ]

    def by_entry(self, p: Distributions) -> Floats:
        """Distributions of all rows, ``float64[T']``."""
        probability = np.empty(self.part.mdp.num_transitions)
        for block, mass in zip(self.blocks, p, strict=True):
            scatter(block.table, mass, probability)
        return probability

    def rows_of_nodes(self, row: Integers) -> Integers:
        """The rows of states, ``int[S]``, as rows of nodes."""
        number = np.full(int(max(self.row.max(), row.max())) + 1, -1)
        number[self.row] = np.arange(self.row.size)
        rows = np.zeros(self.size, np.int64)
        states = np.flatnonzero(self.node >= 0)
        rows[self.node[states]] = number[row[states]]
        return rows

    def exit_rows(self, *, positive: bool) -> Integers:
        """Rows on shortest paths out of the nodes; if `positive`, to known values above 0."""
        mdp, end = self.part.mdp, self.size
        target = self.node[mdp.successor]
        width = np.concatenate([np.diff(mdp.entry_start), [1, 1]])
        ends = np.where(self.known[mdp.successor] > 0, end, end + 1) if positive else end
        target = np.concatenate([np.where(target < 0, ends, target), [end, end + 1]])
        row_start = np.concatenate([mdp.row_start, mdp.num_rows + np.array([1, 2])])
        graph = HostMDP(
            row_start, offsets_from_counts(width), target.astype(np.int32), np.ones(target.size)
        )
        row = shortest_path_rows(graph, np.arange(end + 2) == end, np.ones(graph.num_rows, bool))
        return row[:-2].astype(np.int64)

    def improve(
        self,
        pair: PolicyPair,
        z: Floats | TwoFloats,
        step_reward: float | Floats,
        least: float = 0.0,
        *,
        all_fine: bool = False,
    ) -> tuple[PolicyPair, float]:
        """The pair improved at some values, and the largest gain."""
        values, chosen, p = self.values(z), pair.chosen, []
        all_fine |= isinstance(z, TwoFloats)
        gain, now, noise = (np.empty(self.row.size) for _ in range(3))
        for block, before in zip(self.blocks, pair.p, strict=True):
            ahead = block.differences(values, step_reward)
            mass, row = self.answer(block, ahead), block.table.row
            gain[row] = np.einsum("wn,wn->n", mass, ahead)
            now[row] = np.einsum("wn,wn->n", before, ahead)
            noise[row] = (
                4 * _EPS * (np.abs(values.high[block.owner]) + block.table.rounding) + least
            )
            fine = np.arange(row.size) if all_fine else block.table.fine
            if fine.size:  # a row that hardly leaves gains little
                size = np.einsum("wn,wn->n", (mass + before)[:, fine], np.abs(ahead[:, fine]))
                noise[row[fine]] = size * block.table.rounding[fine]
            p.append(np.where(np.abs(gain[row] - now[row]) > noise[row], mass, before))
        more, mdp = gain + self.cost, self.part.mdp
        best = np.maximum.reduceat(more, mdp.row_start[:-1])
        answered = np.abs(more[chosen] - (now + self.cost)[chosen])
        # An adversarial nature leaves the chosen row its answer, a cooperative one its own p.
        own = (more if self.adversarial else now + self.cost)[chosen]
        row = mdp.first_choice(more == best[mdp.state])[1]
        better = best - own > np.maximum(noise[row], noise[chosen])
        change = np.maximum(best - own, answered if self.adversarial else 0)
        improved = replace(pair, chosen=np.where(better, row, chosen), p=p)
        return improved, float(change.max(initial=0))

    def system(self, pair: PolicyPair) -> PairSystem | None:
        """The linear system of a pair; None if some node is never left."""
        from scipy.sparse import csr_array

        taken = mask_of(pair.chosen, self.row.size)
        earned, parts = np.zeros(self.size), []
        values = self.values(earned).high
        for block, p in zip(self.blocks, pair.p, strict=True):
            mine = np.flatnonzero(taken[block.table.row])
            index, owner, share = block.target.take(mine, 1), block.owner[mine], p.take(mine, 1)
            if block.leaves is not None:
                share *= block.leaves.take(mine, 1)
            leaving = share.sum(0)
            if not leaving.all():
                return None
            share /= leaving
            earned[owner] = np.einsum("wn,wn->n", share, values.take(index)) + (
                self.cost[block.table.row[mine]] / leaving
            )
            kept = (index < self.size) & (share > 0)
            parts.append((np.broadcast_to(owner, kept.shape)[kept], index[kept], share[kept]))
        source, target, share = (np.concatenate(x) for x in zip(*parts, strict=True))
        shape = (self.size, self.size)
        return PairSystem(csr_array((share, (source, target)), shape=shape), earned)

    def residual(self, pair: PolicyPair, z: TwoFloats) -> Floats:
        """By how much a pair's values violate its :class:`PairSystem`, ``float64[M]``."""
        gain, leaving = np.empty(self.row.size), np.empty(self.row.size)
        values = self.values(z)
        for block, p in zip(self.blocks, pair.p, strict=True):
            row = block.table.row
            gain[row] = np.einsum("wn,wn->n", p, block.differences(values)) + self.cost[row]
            leaving[row] = block.leaving(p)
        return (gain / np.where(leaving > 0, leaving, 1))[pair.chosen]

    def row_errors(self, pair: PolicyPair, z: TwoFloats) -> tuple[Floats, Floats]:
        """Rounding errors of the chosen rows' gains, and the mass that leaves, ``float64[M]``."""
        error, leaving = np.empty(self.row.size), np.empty(self.row.size)
        values = self.values(z)
        for block, p in zip(self.blocks, pair.p, strict=True):
            gain, row = block.differences(values), block.table.row
            mean = np.einsum("wn,wn->n", p, gain) + self.cost[row]
            bound = self.gain_bound(block, gain, p, 1, over_all=False)
            error[row], leaving[row] = np.abs(bound - mean), block.leaving(p)
        return error[pair.chosen], leaving[pair.chosen]

    # --- certificates -------------------------------------------------------------------------

    def proves_upper_bound(self, z: Floats | TwoFloats) -> Distributions | None:
        """Nature's answers if no row gains at z, rounding included: z is an upper bound; else None.

        With an adversarial nature every row must lose, so that all nodes are left. Nodes at the
        ceiling need no proof.
        """
        values, p = self.values(z), []
        for block in self.blocks:
            gain = block.differences(values)
            mass = self.answer(block, gain)
            upper = self.gain_bound(block, gain, mass, 1, over_all=not self.adversarial)
            holds = (upper < 0) if self.adversarial else (upper <= 0)
            if not (holds | (values.high[block.owner] >= self.ceiling)).all():
                return None
            p.append(mass)
        return p

    def proves_attained(self, z: Floats | TwoFloats, pair: PolicyPair) -> bool:
        """True if the chosen rows gain in every node, rounding included, so the pair attains z."""
        values = self.values(z)
        taken = mask_of(pair.chosen, self.row.size)
        for block, p in zip(self.blocks, pair.p, strict=True):
            gain = block.differences(values)
            mass = self.answer(block, gain) if self.adversarial else p
            least = self.gain_bound(block, gain, mass, -1, over_all=self.adversarial)
            if not (least > 0)[taken[block.table.row]].all():
                return False
        return True

    def gain_bound(
        self, block: TableBlock, gain: Floats, p: Floats, side: int, *, over_all: bool
    ) -> Floats:
        """Certified upper (side 1) or lower (-1) bound of the gains of rows, ``float64[N]``.

        With `over_all`, over all distributions, with p the computed extreme one; else near p.
        """
        table, size, cost = block.table, np.abs(gain), self.cost[block.table.row]
        terms = 3 * (np.diff(self.part.mdp.entry_start)[table.row]) + self.depth + 12
        slack = terms * _EPS * (np.einsum("wn,wn->n", p, size) + np.abs(cost))
        slack += terms * _TINY * (slack > 0)
        slack += table.mean_error(p, side * gain, over_all=over_all)
        bound: Floats = np.einsum("wn,wn->n", p, gain) + cost + side * slack
        return bound
