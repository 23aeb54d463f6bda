"""The states of an interval model as nodes, with choices of rows and distributions among them.

Values carry a sign, so that the policy makes all large. Differences of values are what is weighed:
states that nature may hold on to with almost all mass then lose no precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import shortest_path_rows
from jaxltl.core.sparse.interval.row_table import Table
from jaxltl.core.sparse.interval.uncertainty_set import HostInterval
from jaxltl.core.sparse.linear.topological_order import Edges, ordered_components
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts
from jaxltl.core.sparse.solvers.reachability import expands_fast

_EPS = float(np.finfo(np.float64).eps)
_TINY = 1e-290
_FEW = 300  # nodes up to which no model mixes
_MET = 4096  # of larger ones, how many a few steps lead to

Answers = list[Floats]  # nature's distributions, a table each


class Choice(NamedTuple):
    """Choices with what they are worth.

    Attributes:
      chosen: ``int[M]``, the row of each node; `p`, nature's distributions by table.
      value: ``float64[M]``, about what is earned.
      steps: ``float64[M]``, about how many steps it takes.
      z: ``float64[M]``, a bound.
    """

    chosen: Integers
    p: Answers
    value: Floats
    steps: Floats
    z: Floats = np.zeros(0)


class Chain(NamedTuple):
    """How choices lead from node to node.

    Attributes:
      matrix: ``float64[M, M]``, SciPy's.
      earned: ``float64[M]``, what is earned until the next node.
    """

    matrix: Any
    earned: Floats


class Block(NamedTuple):
    """A table of rows with where its entries lead.

    Attributes:
      table: the rows.
      leads: ``int[W, N]``, to which node; of what is known, M more than the state.
      owner: ``int[N]``, the node of each row.
      out: ``bool[W, N]``, the entries that leave the node; None: all.
    """

    table: Table
    leads: Integers
    owner: Integers
    out: Booleans | None

    def gain(self, values: Floats, extra: float) -> Floats:
        """How much more each entry leads to than where it comes from: ``float64[W, N]``."""
        found = values[self.leads]
        found -= values[self.owner]
        if extra:
            found += extra if self.out is None else extra * self.out
        return found


@dataclass(frozen=True)
class Nodes:
    """Components as nodes; values carry a sign, so that the policy makes all large.

    Attributes:
      part: the rows by node; successors are states.
      row: ``int[R']``, which row of the model each is; `entry`, ``int[T']``, likewise.
      node: ``int[S]``, -1 of what is known.
      sign: 1 or -1.
      known: ``float64[S]``, with the sign; `cost`, ``float64[R']``, likewise.
      depth, wandering: as of the problem.
      against: whether nature makes all small.
    """

    part: HostInterval
    row: Integers
    entry: Integers
    node: Integers
    sign: int
    known: Floats
    cost: Floats
    depth: int
    wandering: bool
    against: bool

    @property
    def size(self) -> int:
        return self.part.mdp.num_states

    @cached_property
    def ceiling(self) -> float:
        """What nothing exceeds, if that is known."""
        return np.inf if self.cost.any() else max(float(self.known.max()), 0.0)

    @cached_property
    def widest(self) -> int:
        """The most entries of a row, and roundings behind each."""
        return int(np.diff(self.part.mdp.entry_start).max()) + self.depth

    @cached_property
    def blocks(self) -> list[Block]:
        mdp, found = self.part.mdp, []
        target = self.node[mdp.successor]
        index = np.where(target < 0, self.size + mdp.successor, target).astype(np.int32)
        for table in self.part.tables:
            owner, to = mdp.state[table.row], index[table.entry]
            if table.used is not None:
                to = np.where(table.used, to, owner)
            out = to != owner
            found.append(Block(table, to, owner, None if out.all() else out))
        return found

    @cached_property
    def label(self) -> Integers:
        """Strongly connected components of the nodes, in order."""
        mdp = self.part.mdp
        owner, target = mdp.state[mdp.row], self.node[mdp.successor]
        kept = (target != owner) & (target >= 0)
        count = np.bincount(owner[kept], minlength=self.size)
        return ordered_components(Edges(offsets_from_counts(count), target[kept]))

    @cached_property
    def mixes(self) -> bool:
        """Whether few steps lead to many nodes."""
        if self.size < _FEW:
            return False
        first, to = self.part.mdp.entry_start[self.part.mdp.row_start], self.part.mdp.successor

        def follow(nodes: Any) -> Any:
            after = self.node[
                to[concatenated_ranges(first[nodes], first[nodes + 1] - first[nodes])]
            ]
            return after[after >= 0]

        return expands_fast(
            follow, np.array([self.size // 2]), self.size, min(_MET, self.size // 2)
        )

    def values(self, z: Floats) -> Floats:
        """What entries lead to."""
        return np.concatenate([z, self.known])

    def answer(self, block: Block, gain: Floats) -> Floats:
        """Nature's distributions."""
        return block.table.best(gain if self.against else -gain)

    def anything(self) -> Answers:
        """Distributions that lead to all successors."""
        p = self.part.within(np.ones(self.part.mdp.num_transitions, bool))
        return [self._of(block, p) for block in self.blocks]

    @staticmethod
    def _of(block: Block, p: Floats) -> Floats:
        table = block.table
        return p[table.entry] if table.used is None else np.where(table.used, p[table.entry], 0)

    def by_entry(self, p: Answers) -> Floats:
        """Distributions of all rows, ``float64[T']``."""
        found = np.empty(self.part.mdp.num_transitions)
        for block, mass in zip(self.blocks, p, strict=True):
            table = block.table
            if table.used is None:
                found[table.entry] = mass
            else:
                found[table.entry[table.used]] = mass[table.used]
        return found

    def rows_of(self, row: Integers) -> Integers:
        """The rows of states, ``int[S]``, as rows of nodes."""
        number = np.full(int(max(self.row.max(), row.max())) + 1, -1)
        number[self.row] = np.arange(self.row.size)
        found = np.zeros(self.size, np.int64)
        states = np.flatnonzero(self.node >= 0)
        found[self.node[states]] = number[row[states]]
        return found

    def nearer(self, *, worth: bool) -> tuple[Integers, Answers]:
        """Rows and distributions by which all that is open is left, maybe for what is worth more.

        Args:
          worth: whether only what is known to be worth something counts.
        """
        mdp, end = self.part.mdp, self.size
        target = self.node[mdp.successor]
        width = np.concatenate([np.diff(mdp.entry_start), [1, 1]])
        ends = np.where(self.known[mdp.successor] > 0, end, end + 1) if worth else end
        target = np.concatenate([np.where(target < 0, ends, target), [end, end + 1]])
        row_start = np.concatenate([mdp.row_start, mdp.num_rows + np.array([1, 2])])
        graph = HostMDP(
            row_start, offsets_from_counts(width), target.astype(np.int32), np.ones(target.size)
        )
        row = shortest_path_rows(graph, np.arange(end + 2) == end, np.ones(graph.num_rows, bool))
        return row[:-2].astype(np.int64), self.anything()

    def improved(
        self,
        found: Choice,
        z: Floats,
        extra: float,
        least: float = 0.0,
        *,
        everywhere: bool = False,
    ) -> tuple[Choice, float]:
        """The choices that are better at some values, and by how much they are.

        Args:
          found, z, extra: the choices, the values, and what a step earns besides.
          least: what others must gain, for values that are only about those of the choices: who
            takes their noise for gain may go round for ever.
          everywhere: whether all rows are judged by what they gain, however little that is.
        """
        values, chosen, p = self.values(z), found.chosen, []
        gain, now, noise = (np.empty(self.row.size) for _ in range(3))
        for block, before in zip(self.blocks, found.p, strict=True):
            ahead = block.gain(values, extra)
            mass, row = self.answer(block, ahead), block.table.row
            gain[row] = np.einsum("wn,wn->n", mass, ahead)
            now[row] = np.einsum("wn,wn->n", before, ahead)
            noise[row] = 4 * _EPS * (np.abs(z[block.owner]) + block.table.rounding) + least
            fine = np.arange(row.size) if everywhere else block.table.fine
            if fine.size:  # what hardly leaves gains little
                noise[row[fine]] = (
                    np.einsum("wn,wn->n", (mass + before)[:, fine], np.abs(ahead[:, fine]))
                    * block.table.rounding[fine]
                )
            p.append(np.where(np.abs(gain[row] - now[row]) > noise[row], mass, before))
        more = gain + self.cost
        first = self.part.mdp.row_start[:-1]
        best = np.maximum.reduceat(more, first)
        mine = np.abs(more[chosen] - (now + self.cost)[chosen])
        # Against nature the row itself is worth what nature leaves of it.
        own = (more if self.against else now + self.cost)[chosen]
        row = self.part.mdp.first_choice(more == best[self.part.mdp.state])[1]
        better = best - own > np.maximum(noise[row], noise[chosen])
        change = np.maximum(best - own, mine if self.against else 0)
        return (
            found._replace(chosen=np.where(better, row, chosen), p=p),
            float(change.max(initial=0)),
        )

    def chain(self, choice: Choice) -> Chain | None:
        """The system of choices; None where some never leave their node."""
        from scipy.sparse import csr_array

        taken = np.zeros(self.row.size, bool)
        taken[choice.chosen] = True
        earned, values, parts = np.zeros(self.size), self.values(np.zeros(self.size)), []
        for block, p in zip(self.blocks, choice.p, strict=True):
            mine = np.flatnonzero(taken[block.table.row])
            index, owner, share = block.leads.take(mine, 1), block.owner[mine], p.take(mine, 1)
            if block.out is not None:
                share *= block.out.take(mine, 1)
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
        return Chain(csr_array((share, (source, target)), shape=shape), earned)

    def proves(self, z: Floats) -> Answers | None:
        """Nature's answers if no row gains anything by what policy and nature make of it.

        Rounding is counted. Against nature a row must lose something, so that all leave. Nodes at
        the ceiling need no proof.
        """
        values, p = self.values(z), []
        for block in self.blocks:
            gain = block.gain(values, 0.0)
            mass = self.answer(block, gain)
            most = self._sums(block, gain, mass, 1, every=not self.against)
            less = (most < 0) if self.against else (most <= 0)
            if not (less | (z[block.owner] >= self.ceiling)).all():
                return None
            p.append(mass)
        return p

    def attains(self, z: Floats, choice: Choice) -> bool:
        """Whether choices gain in every node, rounding included: they leave then, and have that.

        Against nature, whatever that makes of their rows.
        """
        values = self.values(z)
        taken = np.zeros(self.row.size, bool)
        taken[choice.chosen] = True
        for block, p in zip(self.blocks, choice.p, strict=True):
            gain = block.gain(values, 0.0)
            mass = self.answer(block, gain) if self.against else p
            least = self._sums(block, gain, mass, -1, every=self.against)
            if not (least > 0)[taken[block.table.row]].all():
                return False
        return True

    def _sums(self, block: Block, gain: Floats, p: Floats, sign: int, *, every: bool) -> Floats:
        """What rows gain, at most (sign 1) or at least (-1).

        Args:
          block, gain: rows, and what each entry gains.
          p: distributions up to rounding: the extreme ones on that side where `every`.
          every: whether of all distributions of a row, else of one that is next to p.
        """
        table, size, cost = block.table, np.abs(gain), self.cost[block.table.row]
        terms = 3 * (np.diff(self.part.mdp.entry_start)[table.row]) + self.depth + 12
        slack = terms * _EPS * (np.einsum("wn,wn->n", p, size) + np.abs(cost))
        slack += terms * _TINY * (slack > 0)
        slack += table.more(p, sign * gain, every=every)
        return np.einsum("wn,wn->n", p, gain) + cost + sign * slack
