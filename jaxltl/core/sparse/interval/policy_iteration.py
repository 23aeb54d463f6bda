"""Optimal sums where policy and nature want the same: ``x = opt_r (c_r + opt_p p x)``, bounded.

Policy iteration (Howard 1960) over rows and distributions together, each round one sparse system.
A step that leaves a state earns (or costs) a little more than it does, so that the solution
satisfies ``x >= c_r + p x`` for all rows and all distributions with room for rounding, and is a
bound by that alone. Differences of values are what is weighed: states that nature may hold on to
with almost all mass then lose no precision.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.nodes import Choice, Nodes
from jaxltl.core.sparse.interval.systems import Systems
from jaxltl.core.sparse.interval.uncertainty_set import HostInterval
from jaxltl.core.sparse.rows import offsets_from_counts
from jaxltl.core.sparse.solvers.total_cost import Enclosure

_EPS = float(np.finfo(np.float64).eps)
_LEAST = 1e-270
_AIM = 0.25  # of the tolerance: how much of it the extra of all steps may take
_ABOUT = 0.1  # residual of systems then, as a share of it
_NEARLY = 1e-4  # change up to which choices are improved without it, as a share of the tolerance
_ROUGH = 0.1  # residual of systems that are solved for these, as a share of what changed
_DOUBT = 0.2  # what others must gain, as a share of that residual
_LARGE = 500  # nodes from which choices of a model that does not mix are improved by sweeps first,
_STARTS = 40  # so many times,
_SWEEPS = 40  # after so many sweeps of each,
_SLOW = 1e-5  # or until one changes so little, as a share of the values,
_LOOKS = 4  # of which one in so many is looked at,
_STILL = 1e-2  # and as long as all of them together change more
_ROUNDS = 200
_NEAR = 20  # rounds for the other bound
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

    def enclosed(self, maximize: bool, tolerance: float, relative: bool) -> Enclosure | None:
        """The optimum, if both bounds are proven and as near as asked."""
        if self.attained is None:
            return None
        low, high = (self.attained, self.bound) if maximize else (self.bound, self.attained)
        scale = high if relative else 1.0
        if not (np.isfinite(high) & (high - low <= tolerance * scale)).all():
            return None
        return Enclosure(np.clip(self.value, low, high), low, high, self.row, 0, 0.0, "")


def joint_bound(
    problem: Joint,
    *,
    maximize: bool,
    tolerance: float,
    relative: bool,
    against: bool = False,
    first: Integers | None = None,
) -> JointBound:
    """The optimum of a joint problem, or of one against nature, bounded from both sides.

    Args:
      problem: what is asked.
      maximize: whether the policy makes the sum large, else small.
      tolerance: how far the bound may be.
      relative: whether as a share of the value.
      against: whether nature wants the opposite. Then no two states are in one component.
      first: ``int[S]``, rows by which open states are left, to begin with.
    """
    search = _Search(_nodes(problem, 1 if maximize else -1, against), tolerance, relative)
    nodes = search.nodes
    if first is not None:
        chosen, p = nodes.rows_of(first), nodes.anything()
    elif problem.wandering or not (nodes.known > 0).any():
        chosen, p = nodes.nearer(worth=False)
    else:
        chosen, p = nodes.nearer(worth=True)
    begin = Choice(chosen, p, np.zeros(nodes.size), np.ones(nodes.size))
    far = search.beyond(search.risen(begin) or begin)
    near = None if far is None else search.attained(far)
    return _found(problem, search, far, near)


def _found(problem: Joint, search: _Search, far: Choice | None, near: Choice | None) -> JointBound:
    """What was found, in the numbers of the model."""
    nodes = search.nodes
    states = np.flatnonzero(problem.open)
    lost = np.full(nodes.size, np.inf if nodes.sign > 0 else 0.0)

    def everywhere(x: Floats) -> Floats:
        found = problem.known.copy()
        found[states] = np.maximum(nodes.sign * x, 0)[nodes.node[states]]
        return found

    row = problem.model.mdp.row_start[:-1].astype(np.int64)
    chance = problem.model.mdp.probability.copy()
    last = far or search.last
    if last is not None:
        chance[nodes.entry] = nodes.by_entry(last.p)
        row[states] = nodes.row[(near or last).chosen][nodes.node[states]]
    return JointBound(
        everywhere(lost if far is None else far.z),
        None if near is None else everywhere(near.z),
        everywhere(lost if last is None else last.value),
        row,
        chance,
        search.rounds,
    )


@dataclass
class _Search:
    """Bounds of the nodes; systems solved are counted.

    Attributes:
      nodes: what is asked.
      tolerance, relative: how far bounds may be.
      extra: what a step earns besides. It never grows for long: else who goes round for it comes
        and goes with it.
      rounds: systems; last: what was solved last.
    """

    nodes: Nodes
    tolerance: float
    relative: bool
    extra: float = np.inf
    rounds: int = 0
    last: Choice | None = None

    @cached_property
    def systems(self) -> Systems:
        return Systems(lambda: self.nodes.label, self.nodes.mixes)

    def worth(self, choice: Choice, left: float) -> Choice | None:
        """What choices are worth; None where some never leave."""
        chain = self.nodes.chain(choice)
        self.rounds += 1
        value = (
            None
            if chain is None
            else self.systems.solve(chain.matrix, chain.earned, choice.value, left)
        )
        if value is None:
            return None
        self.last = choice._replace(value=value)
        return self.last

    def timed(
        self, choice: Choice, extra: float, full: Booleans | None = None
    ) -> tuple[Choice, float] | None:
        """The same with their steps, and what each of these earns besides: no more than that.

        Args:
          choice, extra: the choices, and what a step may earn.
          full: ``bool[M]``, nodes that are worth the ceiling as they are.
        """
        chain = self.nodes.chain(choice)
        self.rounds += 1
        if chain is None:
            return None
        matrix, earned, each = chain.matrix, chain.earned, np.ones(self.nodes.size)
        if full is not None and full.any():
            matrix.data[np.repeat(full, np.diff(matrix.indptr))] = 0
            matrix.eliminate_zeros()
            earned, each = np.where(full, self.nodes.ceiling, earned), np.where(full, 0.0, 1.0)
        steps = self.systems.solve(matrix, each, choice.steps, _ABOUT)
        if steps is None:
            return None
        choice = choice._replace(steps=steps)
        extra = min(extra, self.more(choice))
        value = self.systems.solve(matrix, earned, choice.value, _ABOUT * extra)
        if value is None:
            return None
        self.last = choice._replace(value=value)
        return self.last, min(extra, self.more(self.last))

    def risen(self, choice: Choice) -> Choice | None:
        """Choices that are good, by policy iteration whose systems are solved as far as needed."""
        left = 0.0
        if self.nodes.wandering:
            return choice
        choice = self.started(choice)
        for _ in range(_ROUNDS):
            found = self.worth(choice, left)
            if found is None:
                return None
            choice, change = self.nodes.improved(found, found.value, 0.0, _DOUBT * left)
            if change <= _NEARLY * self.tolerance * self.scale(found.value):
                break
            left = _ROUGH * change
        return choice

    def started(self, choice: Choice) -> Choice:
        """Choices that are improved as values rise from zero by their sweeps."""
        nodes = self.nodes
        if nodes.size < _LARGE or nodes.mixes:
            return choice
        z = np.zeros(nodes.size)
        for _ in range(_STARTS):
            before, chain = z, nodes.chain(choice)
            if chain is None:
                break
            for i in range(_SWEEPS):
                last, z = z, chain.matrix @ z
                z += chain.earned
                if i % _LOOKS == 0 and np.abs(z - last).max() <= _SLOW * np.abs(z).max():
                    break
            choice, _ = nodes.improved(choice, z, 0.0)
            if np.abs(z - before).max() <= _STILL * np.abs(z).max():
                break
        return choice._replace(value=z)

    def scale(self, value: Floats) -> float:
        """What a tolerance is a share of."""
        size = np.abs(value)
        return float(size[size > 0].min(initial=np.inf)) if self.relative and size.any() else 1.0

    def beyond(self, choice: Choice) -> Choice | None:
        """A bound on the far side.

        Nodes that are nearly worth the ceiling are worth that: else choices that are not worse go
        round among them for what steps earn.
        """
        nodes, factor = self.nodes, 1.0
        full = np.zeros(nodes.size, bool)
        if not self.relative:
            full = choice.value >= nodes.ceiling - self.tolerance / 4
        for rounds in range(1, _ROUNDS):
            found = self.timed(choice, self.extra, full)
            if found is None:
                return None
            choice, self.extra = found
            factor *= 8 if rounds % _PATIENCE == 0 else 1
            z = np.minimum(choice.value + factor * self.extra * choice.steps, nodes.ceiling)
            z[full] = nodes.ceiling
            if not np.isfinite(z).all():
                return None
            p = nodes.proves(z)
            if p is not None:
                self.extra *= factor
                return choice._replace(z=z, p=p if nodes.against else choice.p)
            choice, _ = nodes.improved(choice, z, factor * self.extra)
        return None

    def attained(self, choice: Choice) -> Choice | None:
        """A bound that choices attain; against nature they may have to be others."""
        for _ in range(_NEAR if self.nodes.against else 2):
            z = choice.value - self.extra * choice.steps
            if self.nodes.attains(z, choice):
                return choice._replace(z=z)
            if not choice.steps.all() and (near := self.finely(choice)) is not None:
                return near
            if self.nodes.against:
                choice = self.nodes.improved(choice, z, -self.extra)[0]
            found = self.timed(choice, self.extra)
            if found is None:
                return None
            choice, self.extra = found
        return None

    def finely(self, choice: Choice) -> Choice | None:
        """A bound that choices attain, of steps that cost a share of what is lacked where they are.

        Who goes round for long where hardly anything is lacking, and so need not leave for more,
        then pays hardly anything. What is lacked of the ceiling is what is computed.
        """
        top = self.nodes.ceiling
        if self.relative or self.nodes.mixes or not np.isfinite(top):
            return None
        known = self.nodes.known - top
        if top and not ((known == 0) | (self.nodes.known == 0)).all():
            return None  # what is lacked would be rounded
        nodes, share = replace(self.nodes, known=known), self.rounding
        for _ in range(_NEAR if nodes.against else 1):
            chain = nodes.chain(choice)
            self.rounds += 1
            value = None if chain is None else self.systems.direct(chain.matrix, chain.earned)
            if chain is None or value is None:
                return None
            cost = self.systems.direct(chain.matrix, share * np.abs(value) + _LEAST)
            if cost is None or not np.isfinite(cost).all():
                return None
            z = value - cost
            holds = nodes.attains(z, choice)
            if not holds and nodes.against:
                # Where next to nothing is lacking a step costs next to nothing, not less: that
                # hides what nature could still gain there.
                steps = self.systems.direct(chain.matrix, np.ones(nodes.size))
                if steps is None:
                    return None
                cost += self.tolerance / (8 * steps.max(initial=1)) * steps
                z = value - cost
                holds = nodes.attains(z, choice)
            if holds:
                if cost.max(initial=0) > self.tolerance / 4:
                    return None
                # The sum is rounded, and may be so upwards.
                lower = np.nextafter(z + top, -np.inf) if top else z
                self.last = choice._replace(value=value + top, z=lower)
                return self.last
            choice = nodes.improved(choice, z, 0.0, everywhere=True)[0]
        return None

    @property
    def rounding(self) -> float:
        """What a step must earn for each unit of value, so that rounding cannot hide it."""
        return 64 * (self.nodes.widest + 8) * _EPS

    def more(self, found: Choice) -> float:
        """How much more a step earns: little beside the tolerance, and more than rounding."""
        nodes = self.nodes
        most = np.abs(found.steps).max(initial=1)
        size = max(np.abs(found.value).max(initial=0), np.abs(nodes.known).max(initial=0))
        aim = _AIM * self.tolerance * self.scale(found.value) / most
        return float(max(aim, self.rounding * size, _LEAST))


def _nodes(problem: Joint, sign: int, against: bool) -> Nodes:
    mdp = problem.model.mdp
    states = np.flatnonzero(problem.open)
    heads, number = np.unique(problem.component[states], return_inverse=True)
    node = np.full(mdp.num_states, -1)
    node[states] = number
    row = np.flatnonzero(problem.open[mdp.state] & ~np.isnan(problem.cost))
    row = row[np.argsort(node[mdp.state[row]], kind="stable")]
    count = np.bincount(node[mdp.state[row]], minlength=heads.size)
    part, entry = problem.model.of_rows(offsets_from_counts(count), row)
    cost: Any = sign * problem.cost[row]
    return Nodes(
        part,
        row,
        entry,
        node,
        sign,
        sign * problem.known,
        cost,
        problem.depth,
        problem.wandering,
        against,
    )
