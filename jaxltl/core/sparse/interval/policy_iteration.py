"""Certified stochastic shortest paths of policy and nature: ``x = max_r opt_p (c_r + p x)``.

Policy iteration (Howard 1960) over rows and distributions together, each round one sparse system.
The bounds rest on one application of the operator. With a small extra reward for every step that
leaves a node, the solution satisfies ``x >= c_r + p x`` for all rows and distributions with room
for rounding, so it is an upper bound; with a small extra cost it is attained. Where runs take so
long that these extras cost more than the tolerance, values are refined beyond double precision:

A value in one float satisfies no optimality equation more accurately than its own rounding
``u |x|``, so a proof by one application of the operator needs an extra of at least ``u |x|`` in
each step, which costs ``u |x| T`` in a run of T steps. Refined values are kept in two floats (as in
:mod:`jaxltl.core.sparse.linear.extended_precision`), found by iterative refinement (Wilkinson 1963).
Their differences are right to two roundings, so the operator errs only by a share of the flows
``p_t |x_t - x_s|``, and these are small wherever a run lingers. The extra of a step is a multiple of
that error, plus a tiny share of the distance from the largest possible value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.row_operator import PolicyPair, RowOperator
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.linear.elimination import SystemSequence
from jaxltl.core.sparse.linear.extended_precision import Solver, TwoFloats, refine, two_sum
from jaxltl.core.sparse.rows import offsets_from_counts
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure

_EPS = float(np.finfo(np.float64).eps)
_LEAST = 1e-270
_AIM = 0.25  # share of the tolerance that the extras of all steps may take
_RESIDUAL = 0.1  # of systems with an extra, as a share of it
_SMALL_CHANGE = 1e-4  # change of values, as a share of the tolerance, at which extras are added
_ROUGH = 0.1  # residual of systems before that, as a share of the last change
_DOUBT = 0.2  # gain to exceed then, as a share of that residual
_LARGE = 500  # nodes from which value iteration comes first, where elimination fills little:
_STARTS = 40  # improvements,
_SWEEPS = 40  # sweeps of each,
_LOOKS = 4  # sweeps between two tests
_SLOW = 1e-5  # of the change of a sweep, as a share of the values,
_STILL = 1e-2  # and of the change since the last improvement
_ROUNDS = 200
_ATTEMPTS = 20  # improvements for the attained bound
_PATIENCE = 30  # rounds after which the extra grows
_REFINED_ROUNDS = 30  # policies with refined values
_SHARE = 0.05  # of the tolerance that the proportional extras of all steps take
_MAX_SHARE = 0.3  # and that they may take before their share is reduced
_MIN_SHARE = 2.0**-80  # smallest share of a proportional extra
_ERRORS = 4  # extra of a refined step, in rounding errors of its row
_NARROW = 0.4  # share of the tolerance that a refined bound may be from the value
_FLOOR = 1e-8  # of the distance from the ceiling, as a share of the largest value
_KILLED = 1e-6  # probability that a step is the last one, for policies that leave soon


@dataclass(frozen=True)
class PathAccuracy:
    """Requested width of an enclosure, absolute or relative to the value."""

    tolerance: float
    relative: bool = False

    def accepts(self, low: Floats, high: Floats) -> bool:
        scale = high if self.relative else 1.0
        return bool((np.isfinite(high) & (high - low <= self.tolerance * scale)).all())


@dataclass(frozen=True)
class PathProblem:
    """Sums until a set of states is left, by every pair of policy and nature that counts."""

    model: UncertainMDP
    interior: Booleans  # bool[S], the states to solve for
    known: Floats  # float64[S], finite and at least 0, the values of the others
    cost: Floats  # float64[R], at least 0; NaN in rows that must not be taken
    component: Integers  # int[S], number of the end component that is one node
    maximize: bool  # whether the policy maximises
    # whether nature optimises the opposite; then no two states are in one component
    adversarial: bool = False
    first: Integers | None = None  # int[S], rows to begin with, by which all open states are left
    depth: int = 0  # roundings behind each number
    may_stay: bool = False  # whether some pairs never leave, at infinite cost

    def operator(self) -> RowOperator:
        """The optimality operator on the open components."""
        mdp, sign = self.model.mdp, 1 if self.maximize else -1
        states = np.flatnonzero(self.interior)
        heads, number = np.unique(self.component[states], return_inverse=True)
        node = np.full(mdp.num_states, -1)
        node[states] = number
        row = np.flatnonzero(self.interior[mdp.state] & ~np.isnan(self.cost))
        row = row[np.argsort(node[mdp.state[row]], kind="stable")]
        count = np.bincount(node[mdp.state[row]], minlength=heads.size)
        part, entry = self.model.select_rows(offsets_from_counts(count), row)
        return RowOperator(
            part=part,
            row=row,
            entry=entry,
            node=node,
            sign=sign,
            known=sign * self.known,
            cost=sign * self.cost[row],
            depth=self.depth,
            adversarial=self.adversarial,
        )


@dataclass(frozen=True)
class PathBounds:
    """Bounds of the optimum, and a pair that nearly attains it."""

    beyond: Floats  # float64[S], the bound that no pair exceeds: above a maximum, below a minimum
    attained: Floats | None  # float64[S], proven for `row` (and nature), or None
    value: Floats  # float64[S], of the pair, not proven
    row: Integers  # int[S], the row by which a component is left; a state's first one elsewhere
    probability: Floats  # float64[T], nature's distributions
    rounds: int  # systems solved

    def enclosed(self, problem: PathProblem, accuracy: PathAccuracy) -> Enclosure | None:
        """The optimum, if it is enclosed as narrowly as requested."""
        if self.attained is None:
            return None
        ends = self.attained, self.beyond
        low, high = ends if problem.maximize else ends[::-1]
        if not accuracy.accepts(low, high):
            return None
        return Enclosure(np.clip(self.value, low, high), low, high, self.row, 0, 0.0, "")


def enclose_paths(problem: PathProblem, accuracy: PathAccuracy) -> PathBounds:
    """Bounds of a :class:`PathProblem` from both sides."""
    search = _PolicySearch(problem.operator(), accuracy, problem.may_stay)
    operator = search.operator
    if problem.first is not None:
        chosen = operator.rows_of_nodes(problem.first)
    else:
        chosen = operator.exit_rows(
            positive=not problem.may_stay and bool((operator.known > 0).any())
        )
    zero = np.zeros(operator.size)
    begin = PolicyPair(chosen, operator.interior(), zero, zero + 1)
    beyond = search.upper_bound(search.approximate(begin) or begin)
    attained = None if beyond is None else search.attained_bound(beyond)
    if not search.is_narrow(beyond, attained):
        beyond, attained = search.long_runs(beyond, attained)
    return _path_bounds(problem, search, beyond, attained)


def _path_bounds(
    problem: PathProblem,
    search: _PolicySearch,
    beyond: PolicyPair | None,
    attained: PolicyPair | None,
) -> PathBounds:
    operator = search.operator
    states = np.flatnonzero(problem.interior)

    def of_states(x: Floats) -> Floats:
        values = problem.known.copy()
        values[states] = np.maximum(operator.sign * x, 0)[operator.node[states]]
        return values

    row = problem.model.mdp.row_start[:-1].astype(np.int64)
    probability = problem.model.mdp.probability.copy()
    last = beyond or search.last
    if last is not None:
        probability[operator.entry] = operator.by_entry(last.p)
        row[states] = operator.row[(attained or last).chosen][operator.node[states]]
    unknown = np.full(operator.size, np.inf if operator.sign > 0 else 0.0)
    return PathBounds(
        of_states(unknown if beyond is None or beyond.bound is None else beyond.bound),
        None if attained is None or attained.bound is None else of_states(attained.bound),
        of_states(unknown if last is None else last.value),
        row,
        probability,
        search.rounds,
    )


@dataclass
class _PolicySearch:
    """State of a policy iteration."""

    operator: RowOperator
    accuracy: PathAccuracy
    may_stay: bool
    # reward or cost of each step. It never grows for long: a pair that lingers for it would come
    # and go with it
    extra: float = np.inf
    rounds: int = 0  # systems solved
    last: PolicyPair | None = None  # the last pair evaluated

    @cached_property
    def systems(self) -> SystemSequence:
        return SystemSequence(lambda: self.operator.label, self.operator.mixes)

    @property
    def rounding(self) -> float:
        """Reward of a step, per unit of value, that exceeds rounding."""
        return 64 * (self.operator.widest + 8) * _EPS

    def scale(self, value: Floats) -> float:
        """The value that the tolerance is a share of."""
        size = np.abs(value)
        relative = self.accuracy.relative and size.any()
        return float(size[size > 0].min(initial=np.inf)) if relative else 1.0

    def step_extra(self, pair: PolicyPair) -> float:
        """Extra of a step: small compared with the tolerance, and more than rounding."""
        operator = self.operator
        longest = np.abs(pair.steps).max(initial=1)
        size = max(np.abs(pair.value).max(initial=0), np.abs(operator.known).max(initial=0))
        aim = _AIM * self.accuracy.tolerance * self.scale(pair.value) / longest
        return float(max(aim, self.rounding * size, _LEAST))

    def is_narrow(self, beyond: PolicyPair | None, attained: PolicyPair | None) -> bool:
        if beyond is None or attained is None or beyond.bound is None or attained.bound is None:
            return False
        width = self.accuracy.tolerance * self.scale(beyond.bound)
        return bool(((beyond.bound - attained.bound) <= width).all())

    def _is_near(self, pair: PolicyPair | None) -> bool:
        """True if a bound is near the value of its pair."""
        if pair is None or pair.bound is None:
            return False
        width = 0.5 * self.accuracy.tolerance * self.scale(pair.value)
        return bool((np.abs(pair.bound - pair.value) <= width).all())

    # --- evaluation ---------------------------------------------------------------------------

    def evaluate(self, pair: PolicyPair, residual: float) -> PolicyPair | None:
        """The pair with its values; None if it never leaves some node."""
        system = self.operator.system(pair)
        self.rounds += 1
        if system is None:
            return None
        value = self.systems.solve(system.matrix, system.earned, pair.value, residual)
        if value is None:
            return None
        self.last = replace(pair, value=value)
        return self.last

    def evaluate_with_steps(
        self, pair: PolicyPair, extra: float, full: Booleans | None = None
    ) -> tuple[PolicyPair, float] | None:
        """The pair with its values and steps, and the extra of a step; `full` is at the ceiling."""
        system = self.operator.system(pair)
        self.rounds += 1
        if system is None:
            return None
        (matrix, earned), each = system, np.ones(self.operator.size)
        if full is not None and full.any():
            matrix.data[np.repeat(full, np.diff(matrix.indptr))] = 0
            matrix.eliminate_zeros()
            earned, each = np.where(full, self.operator.ceiling, earned), np.where(full, 0.0, 1.0)
        steps = self.systems.solve(matrix, each, pair.steps, _RESIDUAL)
        if steps is None:
            return None
        pair = replace(pair, steps=steps)
        extra = min(extra, self.step_extra(pair))
        value = self.systems.solve(matrix, earned, pair.value, _RESIDUAL * extra)
        if value is None:
            return None
        self.last = replace(pair, value=value)
        return self.last, min(extra, self.step_extra(self.last))

    # --- improvement --------------------------------------------------------------------------

    def approximate(self, pair: PolicyPair) -> PolicyPair | None:
        """A nearly optimal pair, by policy iteration with systems solved as far as needed."""
        residual = 0.0
        if self.may_stay:
            return pair
        pair = self._value_iteration(pair)
        for _ in range(_ROUNDS):
            evaluated = self.evaluate(pair, residual)
            if evaluated is None:
                return None
            pair, change = self.operator.improve(evaluated, evaluated.value, 0.0, _DOUBT * residual)
            if change <= _SMALL_CHANGE * self.accuracy.tolerance * self.scale(evaluated.value):
                break
            residual = _ROUGH * change
        return pair

    def _value_iteration(self, pair: PolicyPair) -> PolicyPair:
        """The pair improved as values rise from zero by sweeps."""
        operator = self.operator
        if operator.size < _LARGE or operator.mixes:
            return pair
        z = np.zeros(operator.size)
        for _ in range(_STARTS):
            before, system = z, operator.system(pair)
            if system is None:
                break
            for i in range(_SWEEPS):
                last, z = z, system.matrix @ z
                z += system.earned
                if i % _LOOKS == 0 and np.abs(z - last).max() <= _SLOW * np.abs(z).max():
                    break
            pair, _ = operator.improve(pair, z, 0.0)
            if np.abs(z - before).max() <= _STILL * np.abs(z).max():
                break
        return replace(pair, value=z)

    # --- bounds -------------------------------------------------------------------------------

    def upper_bound(self, pair: PolicyPair) -> PolicyPair | None:
        """A pair with a bound that no pair exceeds.

        Nodes near the ceiling count as the ceiling: optimal pairs may linger there for the extra.
        """
        operator, factor = self.operator, 1.0
        full = np.zeros(operator.size, bool)
        if not self.accuracy.relative:
            full = pair.value >= operator.ceiling - self.accuracy.tolerance / 4
        for rounds in range(1, _ROUNDS):
            evaluated = self.evaluate_with_steps(pair, self.extra, full)
            if evaluated is None:
                return None
            pair, self.extra = evaluated
            factor *= 8 if rounds % _PATIENCE == 0 else 1
            z = np.minimum(pair.value + factor * self.extra * pair.steps, operator.ceiling)
            z[full] = operator.ceiling
            if not np.isfinite(z).all():
                return None
            p = operator.proves_upper_bound(z)
            if p is not None:
                self.extra *= factor
                return replace(pair, bound=z, p=p if operator.adversarial else pair.p)
            pair, _ = operator.improve(pair, z, factor * self.extra)
        return None

    def attained_bound(self, pair: PolicyPair) -> PolicyPair | None:
        """A pair with a bound that it attains; with an adversarial nature, its policy alone."""
        operator = self.operator
        for _ in range(_ATTEMPTS if operator.adversarial else 2):
            z = pair.value - self.extra * pair.steps
            if operator.proves_attained(z, pair):
                return replace(pair, bound=z)
            if not pair.steps.all() and (bounded := self.proportional_bound(pair)) is not None:
                return bounded
            if operator.adversarial:
                pair = operator.improve(pair, z, -self.extra)[0]
            evaluated = self.evaluate_with_steps(pair, self.extra)
            if evaluated is None:
                return None
            pair, self.extra = evaluated
        return None

    def proportional_bound(self, pair: PolicyPair) -> PolicyPair | None:
        """An attained bound by steps that cost a share of the distance from the ceiling.

        A pair that lingers where values are nearly the ceiling then pays nearly nothing.
        """
        operator, top = self.operator, self.operator.ceiling
        if self.accuracy.relative or operator.mixes or not np.isfinite(top):
            return None
        known = operator.known - top
        if top and not ((known == 0) | (operator.known == 0)).all():
            return None  # the distance would be rounded
        shifted = replace(operator, known=known)
        for _ in range(_ATTEMPTS if operator.adversarial else 1):
            system = shifted.system(pair)
            self.rounds += 1
            solve = self.systems.solve_directly
            value = None if system is None else solve(system.matrix, system.earned)
            if system is None or value is None:
                return None
            cost = solve(system.matrix, self.rounding * np.abs(value) + _LEAST)
            if cost is None or not np.isfinite(cost).all():
                return None
            z = value - cost
            holds = shifted.proves_attained(z, pair)
            if not holds and operator.adversarial:
                # Steps that cost next to nothing hide remaining gains of nature there.
                steps = solve(system.matrix, np.ones(operator.size))
                if steps is None:
                    return None
                cost += self.accuracy.tolerance / (8 * steps.max(initial=1)) * steps
                z = value - cost
                holds = shifted.proves_attained(z, pair)
            if holds:
                if cost.max(initial=0) > self.accuracy.tolerance / 4:
                    return None
                lower = np.nextafter(z + top, -np.inf) if top else z  # the sum is rounded
                self.last = replace(pair, value=value + top, bound=lower)
                return self.last
            pair = shifted.improve(pair, z, 0.0, all_fine=True)[0]
        return None

    def long_runs(
        self, beyond: PolicyPair | None, attained: PolicyPair | None
    ) -> tuple[PolicyPair | None, PolicyPair | None]:
        """Bounds of long runs: refinement in two floats, then a pair with a chance to stop."""
        last = attained or self.last
        tolerance = self.accuracy.tolerance * self.scale(
            np.zeros(0) if last is None else last.value
        )
        if last is not None and not self._is_near(beyond):
            beyond = self.refined_bound(last, 1, tolerance) or beyond
        if last is not None and not self._is_near(attained):
            attained = self.refined_bound(last, -1, tolerance) or attained
        if self.is_narrow(beyond, attained):
            return beyond, attained
        if beyond is None or self.accuracy.relative or self.operator.adversarial:
            return beyond, attained
        best, self.extra = self._leaving_soon(beyond), np.inf
        for _ in range(_ATTEMPTS):
            if best is None:
                break
            evaluated = self.evaluate_with_steps(best, self.extra)
            if evaluated is None:
                break
            best, self.extra = evaluated
            z = best.value - self.extra * best.steps
            if self.operator.proves_attained(z, best):
                attained = replace(best, bound=z)
                if self.is_narrow(beyond, attained):
                    break
            best = self.operator.improve(best, z, -self.extra)[0]
        return beyond, attained

    def _leaving_soon(self, pair: PolicyPair) -> PolicyPair | None:
        """A pair that is nearly optimal if each step is the last one with chance `_KILLED`."""
        operator = self.operator
        worst = -1.0 if operator.sign < 0 else 0.0
        for _ in range(_ROUNDS):
            system = operator.system(pair)
            self.rounds += 1
            if system is None:
                return None
            matrix = system.matrix
            matrix.data *= 1 - _KILLED
            earned = system.earned + _KILLED * worst
            value = self.systems.solve(matrix, earned, pair.value, 1e-6 * _KILLED)
            if value is None:
                return None
            pair, change = operator.improve(replace(pair, value=value), value, -_KILLED)
            if change <= 1e-3 * _KILLED:
                break
        return pair

    # --- bounds beyond double precision -------------------------------------------------------

    def refined_bound(self, pair: PolicyPair, side: int, tolerance: float) -> PolicyPair | None:
        """A pair with an upper bound of all pairs (side 1), or with one that it attains (-1).

        The bound is at most the tolerance from the other one.
        """
        operator, share = self.operator, np.inf

        def residual(x: TwoFloats) -> Floats:
            return operator.residual(pair, x)

        for _ in range(_REFINED_ROUNDS):
            system = operator.system(pair)
            if system is None:
                return None
            solve = partial(self.systems.solve_directly, system.matrix)
            value = refine(solve, system.earned, residual)
            extra = (
                None if value is None else self._refined_extra(pair, solve, value, share, tolerance)
            )
            if value is None or extra is None:
                return None
            share, step, cost = extra
            high, lost = two_sum(value.high, side * cost)
            z = TwoFloats(*two_sum(high, lost + value.low))
            proven = self._proven(pair, z, side)
            if proven is not None:
                narrow = cost.max(initial=0) <= _NARROW * tolerance
                return replace(proven, value=value.high) if narrow else None
            better, _ = operator.improve(pair, z, side * step)
            if (better.chosen == pair.chosen).all() and all(map(np.array_equal, better.p, pair.p)):
                return None
            pair = better
        return None

    def _refined_extra(
        self, pair: PolicyPair, solve: Solver, value: TwoFloats, share: float, tolerance: float
    ) -> tuple[float, Floats, Floats] | None:
        """Proportional extra of a step, its share, and extras of whole runs; None if unknown."""
        operator = self.operator
        size = max(np.abs(value.high).max(initial=0), np.abs(operator.known).max(initial=0))
        weight = np.full(operator.size, size)
        if np.isfinite(operator.ceiling):
            weight = np.maximum(operator.ceiling - value.high, _FLOOR * size)
        steps = solve(weight)
        if steps is None or not (steps >= 0).all():
            return None
        # A smaller extra lets the next pair linger longer, so it shrinks only where it has to.
        if share * steps.max() > _MAX_SHARE * tolerance:
            share = max(_SHARE * tolerance / steps.max(), _MIN_SHARE)
        errors, leaving = operator.row_errors(pair, value)
        cost = solve(share * weight + _ERRORS * errors / leaving)
        if cost is None or not (cost >= 0).all():
            return None
        return share, share * weight, cost

    def _proven(self, pair: PolicyPair, z: TwoFloats, side: int) -> PolicyPair | None:
        if side < 0:
            if not self.operator.proves_attained(z, pair):
                return None
        else:
            p = self.operator.proves_upper_bound(z)
            if p is None:
                return None
            if self.operator.adversarial:
                pair = replace(pair, p=p)
        return replace(pair, bound=np.nextafter(z.high + z.low, side * np.inf))
