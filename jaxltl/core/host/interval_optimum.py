"""Optimal sums where policy and nature want the same: ``x = opt_r (c_r + opt_p p x)``, bounded.

Policy iteration (Howard 1960) over rows and distributions together, each round one sparse system.
A step that leaves a state earns (or costs) a little more than it does, so that the solution
satisfies ``x >= c_r + p x`` for all rows and all distributions with room for rounding, and is a
bound by that alone. Differences of values are what is weighed: states that nature may hold on to
with almost all mass then lose no precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.host.elimination import Factors, factors
from jaxltl.core.host.interval import HostInterval
from jaxltl.core.host.levels import Edges, components_in_order
from jaxltl.core.host.rows import Booleans, Integers, starts_of
from jaxltl.core.host.sparse import Floats, HostMDP
from jaxltl.core.host.sparse_graph import towards
from jaxltl.core.host.transient import Enclosed

_EPS = float(np.finfo(np.float64).eps)
_TINY = 1e-290
_LEAST = 1e-270
_AIM = 0.1  # of the tolerance: how much of it the extra of all steps may take
_STARTS = 60  # improvements to begin with
_SWEEPS = 100  # of what each of them found
_SLOW = 1e-5  # change of a sweep, as a share of the values, at which they are improved
_NEARLY = 1e-3  # and change since the last improvement at which systems are solved
_ROUNDS = 200
_PATIENCE = 30  # rounds after which the extra grows


class Joint(NamedTuple):
    """A problem whose every policy that counts, with its nature, leaves all of its states.

    Attributes:
      model: the model.
      open: ``bool[S]``, the states to solve for.
      known: ``float64[S]``, at least 0 and finite: what is earned at the others.
      cost: ``float64[R]``, at least 0; rows that may not be taken have NaN.
      component: ``int[S]``, states of the same number move between each other at will.
      depth: how many roundings stand behind a number.
      wandering: whether some policies never leave, at a cost that has no end.
    """

    model: HostInterval
    open: Booleans
    known: Floats
    cost: Floats
    component: Integers
    depth: int = 0
    wandering: bool = False


class JointBound(NamedTuple):
    """A bound on the far side, and what attains almost that.

    Attributes:
      bound: ``float64[S]``: of a maximum no less, of a minimum no more than it.
      attained: ``float64[S]``, what the choices attain at least, or cost at most; None where that
        is not proven.
      value: ``float64[S]``, what they are worth, without bounds.
      row: ``int[S]``, the row that leaves the component of a state; a state's first elsewhere.
      probability: ``float64[T]``, nature's distributions of all rows.
      rounds: systems solved.
    """

    bound: Floats
    attained: Floats | None
    value: Floats
    row: Integers
    probability: Floats
    rounds: int

    def enclosed(self, maximize: bool, tolerance: float, relative: bool) -> Enclosed | None:
        """The optimum, if both bounds are proven and as near as asked."""
        if self.attained is None:
            return None
        low, high = (self.attained, self.bound) if maximize else (self.bound, self.attained)
        scale = high if relative else 1.0
        if not (np.isfinite(high) & (high - low <= tolerance * scale)).all():
            return None
        return Enclosed(np.clip(self.value, low, high), low, high, self.row, 0, 0.0, "")


def joint_bound(
    problem: Joint, *, maximize: bool, tolerance: float, relative: bool
) -> JointBound:
    """The optimum of a joint problem, bounded from its far side.

    Args:
      problem: what is asked.
      maximize: whether both make the sum large, else small.
      tolerance: how far the bound may be.
      relative: whether as a share of the value.
    """
    nodes = _nodes(problem, 1 if maximize else -1)
    chosen, p = nodes.nearer(worth=False) if problem.wandering else nodes.started()
    extra, rounds, proven, system = np.inf, 0, False, None
    value = np.zeros(nodes.size)
    while not proven and rounds < _ROUNDS:
        system = nodes.system(chosen, p, system)
        if system is None:
            break
        rounds += 1
        value = system.solve(nodes.earned(chosen, p, 0.0))
        steps = system.solve(np.ones(nodes.size))
        if rounds < _PATIENCE:
            # Never more again: else who goes round for it comes and goes with it.
            extra = min(extra, _extra(nodes, value, steps, tolerance, relative))
        elif rounds % _PATIENCE == 0:
            extra *= 8
        z = value + extra * steps
        if not np.isfinite(z).all():
            break
        proven = nodes.proves(z)
        if not proven:
            chosen, p = nodes.improved(z, chosen, p, extra)
    states = np.flatnonzero(problem.open)

    def everywhere(x: Floats) -> Floats:
        found = problem.known.copy()
        found[states] = np.maximum(nodes.sign * x, 0)[nodes.node[states]]
        return found

    near = None
    if proven and nodes.attains(value - extra * steps, chosen, p):
        near = everywhere(value - extra * steps)
    if not proven:
        z = np.full(nodes.size, np.inf if maximize else 0.0)
    row = problem.model.mdp.row_start[:-1].astype(np.int64)
    row[states] = nodes.row[chosen][nodes.node[states]]
    chance = problem.model.mdp.probability.copy()
    chance[nodes.entry] = p
    return JointBound(everywhere(z), near, everywhere(value), row, chance, rounds)


@dataclass(frozen=True)
class _Nodes:
    """Components as nodes; values carry a sign, so that all is to be made large.

    Attributes:
      part: the rows by node; successors are states.
      row: ``int[R']``, which row of the model each is; `entry`, ``int[T']``, likewise.
      node: ``int[S]``, -1 of what is known.
      sign: 1 or -1.
      known: ``float64[S]``, with the sign; `cost`, ``float64[R']``, likewise.
      depth: as of the problem.
    """

    part: HostInterval
    row: Integers
    entry: Integers
    node: Integers
    sign: int
    known: Floats
    cost: Floats
    depth: int

    @property
    def size(self) -> int:
        return self.part.mdp.num_states

    @cached_property
    def target(self) -> Integers:
        """The node that each entry leads to."""
        return self.node[self.part.mdp.successor]

    @cached_property
    def owner(self) -> Integers:
        """The node that each entry leaves."""
        return self.part.mdp.state[self.part.mdp.row]

    @cached_property
    def out(self) -> Booleans:
        return self.target != self.owner

    @cached_property
    def outside(self) -> Floats:
        """What each entry earns by what is known."""
        return np.where(self.target < 0, self.known[self.part.mdp.successor], 0)

    @cached_property
    def label(self) -> Integers:
        """Strongly connected components of the nodes, in order."""
        kept = self.out & (self.target >= 0)
        count = np.bincount(self.owner[kept], minlength=self.size)
        return components_in_order(Edges(starts_of(count), self.target[kept]))

    def difference(self, z: Floats) -> Floats:
        """How much more each entry leads to than where it comes from."""
        ahead = np.where(self.target < 0, self.outside, z[self.target])
        return np.where(self.out, ahead - z[self.owner], 0)

    def greedy(self, z: Floats, extra: float) -> tuple[Floats, Floats]:
        """Nature's distributions at some values, and what each row gains: ``[T']``, ``[R']``."""
        gain = self.difference(z) + extra * self.out
        p = self.part.nature(gain, maximize=True)
        return p, self.part.total(p * gain) + self.cost

    def best(self, gain: Floats) -> tuple[Floats, Integers]:
        """The largest gain of each node, and the first row that has it."""
        best = np.maximum.reduceat(gain, self.part.mdp.row_start[:-1])
        return best, self.part.mdp.first_choice(gain == best[self.part.mdp.state])[1]

    def started(self) -> tuple[Integers, Floats]:
        """Rows and distributions that leave, improved as values rise from zero by their sweeps."""
        p = self.part.nature(self.out.astype(np.float64), maximize=True)
        chosen = self.best(self.part.total(p * self.out))[1]
        if self.sign > 0 and (self.known > 0).any():
            chosen, p = self.nearer(worth=True)
        z = np.zeros(self.size)
        for _ in range(_STARTS):
            chosen, p = self.improved(z, chosen, p, 0.0)
            matrix, rest = self.chain(chosen, p), self.earned(chosen, p, 0.0)
            before = z
            for _ in range(_SWEEPS):
                last, z = z, matrix @ z + rest
                if np.abs(z - last).max() <= _SLOW * np.abs(z).max():
                    break
            if np.abs(z - before).max() <= _NEARLY * np.abs(z).max():
                break
        return self.improved(z, chosen, p, 0.0)

    def nearer(self, *, worth: bool) -> tuple[Integers, Floats]:
        """Rows and distributions by which all that is open is left, maybe for what is worth more.

        Args:
          worth: whether only what is known to be worth something counts.
        """
        mdp, end = self.part.mdp, self.size
        width = np.concatenate([np.diff(mdp.entry_start), [1, 1]])
        ends = np.where(self.outside > 0, end, end + 1) if worth else end
        target = np.concatenate([np.where(self.target < 0, ends, self.target), [end, end + 1]])
        row_start = np.concatenate([mdp.row_start, mdp.num_rows + np.array([1, 2])])
        graph = HostMDP(
            row_start, starts_of(width), target.astype(np.int32), np.ones(target.size))
        row = towards(graph, np.arange(end + 2) == end, np.ones(graph.num_rows, bool))
        every = np.ones(mdp.num_transitions, bool)
        return row[:-2].astype(np.int64), self.part.within(every)

    def improved(
        self, z: Floats, chosen: Integers, p: Floats, extra: float
    ) -> tuple[Integers, Floats]:
        """The same, where something better than what was solved stands."""
        other, gain = self.greedy(z, extra)
        best, row = self.best(gain)
        noise = 4 * _EPS * (np.abs(z) + self.part.rounding[row])
        better = best > noise
        fresh = np.zeros(self.part.mdp.num_rows, bool)
        fresh[row[better]] = True
        return np.where(better, row, chosen), np.where(fresh[self.part.mdp.row], other, p)

    def _leaving(self, p: Floats) -> Floats:
        return self.part.total(np.where(self.out, p, 0))

    def earned(self, chosen: Integers, p: Floats, extra: float) -> Floats:
        """The right side of the system: what is earned until the next node."""
        rest = self.part.total(p * self.outside) + self.cost
        return (rest[chosen] / self._leaving(p)[chosen]) + extra

    def system(self, chosen: Integers, p: Floats, before: Factors | None) -> Factors | None:
        """The system of rows and distributions; None where it is singular."""
        matrix = self.chain(chosen, p)
        every = np.arange(self.size)
        if before is None:
            return factors(matrix, self.label, every)
        return before._replace(rows=matrix).other(every)

    def chain(self, chosen: Integers, p: Floats) -> Any:
        """How rows and distributions lead from node to node: ``float64[M, M]``, SciPy's."""
        from scipy.sparse import csr_array

        taken = np.zeros(self.part.mdp.num_rows, bool)
        taken[chosen] = True
        kept = taken[self.part.mdp.row] & self.out & (self.target >= 0) & (p > 0)
        share = p[kept] / self._leaving(p)[self.part.mdp.row[kept]]
        place = self.owner[kept], self.target[kept]
        return csr_array((share, place), shape=(self.size, self.size))

    def proves(self, z: Floats) -> bool:
        """Whether no row and no distribution gains anything, rounding included."""
        gain = self.difference(z)
        p = self.part.nature(gain, maximize=True)
        most = self.part.total(p * gain) + self.cost + self._slack(gain, p)
        return bool((most <= 0).all())

    def attains(self, z: Floats, chosen: Integers, p: Floats) -> bool:
        """Whether choices gain in every node, rounding included: they leave then, and have that."""
        gain = self.difference(z)
        least = self.part.total(p * gain) + self.cost - self._slack(gain, p)
        return bool((least[chosen] > 0).all())

    def _slack(self, gain: Floats, p: Floats) -> Floats:
        """How much what rows gain may be off."""
        size = np.abs(gain)
        terms = 2 * np.diff(self.part.mdp.entry_start) + self.depth + 8
        # Who is given the rest of the mass may miss some of it, or have too much.
        partly = (self.part.lower < p) & (p < self.part.upper)
        if self.part.ball is not None:
            partly &= p != self.part.ball.center
        last = self.part.total(np.where(partly, size, 0)) * self.part.rounding
        slack = terms * _EPS * (self.part.total(p * size) + np.abs(self.cost)) + last
        return slack + terms * _TINY * (slack > 0)


def _nodes(problem: Joint, sign: int) -> _Nodes:
    mdp = problem.model.mdp
    states = np.flatnonzero(problem.open)
    heads, number = np.unique(problem.component[states], return_inverse=True)
    node = np.full(mdp.num_states, -1)
    node[states] = number
    row = np.flatnonzero(problem.open[mdp.state] & ~np.isnan(problem.cost))
    row = row[np.argsort(node[mdp.state[row]], kind="stable")]
    count = np.bincount(node[mdp.state[row]], minlength=heads.size)
    part, entry = problem.model.of_rows(starts_of(count), row)
    cost: Any = sign * problem.cost[row]
    return _Nodes(
        part, row, entry, node, sign, sign * problem.known, cost, problem.depth)


def _extra(
    nodes: _Nodes, value: Floats, steps: Floats, tolerance: float, relative: bool
) -> float:
    """How much more a step earns: little beside the tolerance, and more than rounding."""
    most = np.abs(steps).max(initial=1)
    size = max(np.abs(value).max(initial=0), np.abs(nodes.known).max(initial=0))
    scale = np.abs(value)[value != 0].min(initial=size) if relative else 1.0
    width = int(np.diff(nodes.part.mdp.entry_start).max()) + nodes.depth
    return float(max(_AIM * tolerance * scale / most, 64 * (width + 8) * _EPS * size, _LEAST))
