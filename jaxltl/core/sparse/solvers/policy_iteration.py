"""Stochastic shortest paths by policy iteration: certified solution of ``x = opt_r (c_r + P_r x)``.

States that reach no cycle are solved by backward induction, with an error that is known in advance;
so are, at the end, those that no cycle reaches. The core in between is solved by policy iteration
(Howard 1960) with sparse elimination, for a problem in which every step costs a small extra d, or
``d w_i`` with weights w near the values if the tolerance is relative:

- A value v with ``sign (T v - v) <= 0`` is an outer bound of the optimum. For the extra cost, the
  solution has ``sign (T v - v) = -d``, which leaves room for the rounding of one backup.
- A value v with ``sign (T_pi v - v) >= 0``, for the policy pi and its expected time t (or sum of
  weights), is attained by pi, as pi leaves; ``v - sign 1.5 d t`` is one, and is checked likewise.

Where episodes are so long that double precision decides neither, values in two floats or fractions
do (:mod:`jaxltl.core.sparse.linear.extended_precision`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.choice_order import choices_of
from jaxltl.core.sparse.graph.components import forward_search
from jaxltl.core.sparse.linear.elimination import Factors, elimination_order, factorize
from jaxltl.core.sparse.linear.extended_precision import (
    MAX_FRACTIONS,
    Solver,
    exact_optimum,
    gth_solver,
    perturbation_bound,
    refined_optimum,
)
from jaxltl.core.sparse.linear.optimality_equation import OptimalityEquation, propagate_improvements
from jaxltl.core.sparse.linear.ordered_sweeps import (
    CostRows,
    OrderedSweeps,
    short_policy,
    start_from_above,
)
from jaxltl.core.sparse.linear.topological_order import (
    Edges,
    Levels,
    ordered_components,
    topological_levels,
)
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts, positions, row_entries
from jaxltl.core.sparse.solvers.shortest_path_problem import (
    TINY,
    Enclosure,
    InteriorRows,
    ShortestPathProblem,
    interior_rows,
    solve_levels,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_EPS = float(np.finfo(np.float64).eps)
_SHARE = 0.1  # of the tolerance that the extra cost of the steps may take
_SHARE_CHAIN = 1e-5  # of a chain, where ties between choices do not matter
# The least extra cost, in rounding errors of a backup; of a chain, that is tried first.
_MARGIN, _MARGIN_CHAIN = 32, 4
# Sweeps of value iteration for a first policy; of small cores, where a policy costs little, half.
_FIRST_SWEEPS, _SMALL_CORE = 60, 5000
_SWEEPS = 12  # after each linear system, which propagate improvements
_SWEPT_ROUNDS = 12  # after which improvements are strict, so that policy iteration ends
_KEPT = 0.75  # of the extra cost: smaller gains are ignored, and the rest proves the bound
_MAX_ROUNDS = 300
# Unknowns from which value iteration is tried, its sweeps, and a change at its end, in tolerances;
# elimination takes longer in cores of zeroconf with 120,000 unknowns.
_LARGE_CORE, _MAX_SWEEPS, _CONVERGED = 20_000, 400, 0.01
_LONG = 1000  # tolerances that extra costs may have in sum before sweeps are tried
_PENALTIES = 1e-2, 1e-4, 1e-7  # costs of a step, in tolerances, for policies that do not wait
_EVALUATIONS = 4  # of a policy, between sweeps that converge slowly
_USEFUL = 0.1  # bounds of this width give a start policy for extended precision


def policy_iteration(
    problem: ShortestPathProblem, *, maximize: bool, tolerance: float, relative: bool
) -> Enclosure:
    """Certified optimum of a stochastic shortest path problem."""
    rows, sign = interior_rows(problem), 1 if maximize else -1
    n = rows.num_nodes
    # A product and a sum for each successor of a row, twice for its normalisation, and the bounds.
    unit = (4 * rows.widest + problem.depth + 16) * _EPS
    bounds: Floats = np.zeros((3, n))  # the bound that the policy attains, the other one, value
    policy: Integers = rows.row_start[:-1].copy()
    edges = rows.edges()
    back, among = edges.reverse(), np.ones(n, bool)
    below = topological_levels(back, np.diff(edges.start).astype(np.int32), among)
    solve_levels(rows, below, bounds, policy, sign)
    grown = (len(below.start) - 1) * unit
    _widen(bounds, below.node, sign, grown)
    rounds, method = 0, "levels"
    if among.any():
        before = np.concatenate([[0], np.cumsum(among[back.target])])
        in_degree = (before[back.start[1:]] - before[back.start[:-1]]).astype(np.int32)
        above = topological_levels(edges, in_degree, among)
        core = np.flatnonzero(among)
        if core.size:
            solver = _core_solver(problem, rows, core, bounds[2], sign)
            solver = replace(
                solver, unit=unit, outer_error=grown, tolerance=tolerance, relative=relative
            )
            solution = solver.solve()
            rounds, method, node = solution.rounds, solution.method, solver.node
            bounds[:, node], policy[node] = (
                (solution.attained, solution.outer, solution.value),
                solution.policy,
            )
            # Values are at least 0, as relative errors of the levels above assume.
            lowest = 0 if maximize else 1
            bounds[lowest, node] = np.maximum(bounds[lowest, node], 0)
        after = Levels(above.node[::-1], [above.start[-1] - x for x in above.start[::-1]])
        solve_levels(rows, after, bounds, policy, sign)
        _widen(bounds, above.node, sign, (len(above.start) - 1) * unit)
    attained, outer, value = bounds
    low, high = (attained, outer) if sign > 0 else (outer, attained)
    low = np.where(np.isfinite(low), np.maximum(low - TINY, 0), 0)
    high = np.where(np.isnan(high), np.inf, high + TINY)
    value = np.clip(value, low, high)
    residual = rows.residual(value, sign)
    row = problem.mdp.row_start[:-1].astype(np.int64)
    row[rows.node] = rows.row[policy]

    def everywhere(x: Floats) -> Floats:
        full = problem.terminal_value.copy()
        full[rows.node] = x
        return full

    return Enclosure(
        value=everywhere(value),
        lower=everywhere(low),
        upper=everywhere(high),
        row=row,
        rounds=rounds,
        residual=residual,
        method=method,
    )


def _widen(bounds: Floats, node: Integers, sign: int, share: float) -> None:
    bounds[0, node] *= 1 - sign * share
    bounds[1, node] *= 1 + sign * share


# --- the states on cycles, and between them -------------------------------------------------------


@dataclass(frozen=True)
class _CoreValues:
    """Bounds and policy of the core: the policy attains `attained`, and none exceeds `outer`."""

    attained: Floats
    outer: Floats
    value: Floats
    policy: Integers
    rounds: int
    method: str


def _core_solver(
    problem: ShortestPathProblem, rows: InteriorRows, core: Integers, value: Floats, sign: int
) -> _CoreSolver:
    """The optimality equation of the core; other nodes have known values."""
    from scipy import sparse

    count = np.diff(rows.row_start)[core]
    choices = choices_of(count)
    row = concatenated_ranges(rows.row_start[core], count)[choices.order]
    core = core[choices.states]
    entry, width = row_entries(rows.entry_start, row)
    number = positions(core, rows.num_nodes)
    target, weight = rows.target[entry], rows.weight[entry]
    inner = number[target] >= 0
    of = np.repeat(np.arange(row.size, dtype=np.int32), width)
    out = np.flatnonzero(~inner)
    terms = weight[out] * value[target[out]]
    cost: Floats = rows.known[row] + np.bincount(of[out], terms, row.size)
    leaving: Floats = rows.leaving[row] + np.bincount(of[out], weight[out], row.size)
    start = offsets_from_counts(np.bincount(of[inner], minlength=row.size))
    shape = (row.size, core.size)
    matrix = sparse.csr_array((weight[inner], number[target[inner]], start), shape=shape)
    matrix.sum_duplicates()
    source = np.repeat(choices.owner, np.diff(matrix.indptr))
    graph = sparse.coo_array(
        (np.ones(source.size, bool), (source, matrix.indices)), shape=(core.size, core.size)
    ).tocsr()
    proper = None
    if problem.proper_policy is not None and not choices.is_chain:
        wanted = problem.proper_policy[rows.node[core]]
        hit = np.flatnonzero(rows.row[row] == wanted[choices.owner])
        proper = np.arange(core.size)
        proper[choices.owner[hit]] = hit
    return _CoreSolver(
        equation=OptimalityEquation(matrix, cost, leaving, choices, sign),
        node=core,
        row=row,
        label=ordered_components(Edges(graph.indptr, graph.indices)),
        proper=proper,
    )


@dataclass(frozen=True)
class _CoreSolver:
    """Policy iteration on the core."""

    equation: OptimalityEquation  # its optimality equation
    node: Integers  # int[M], int[R], nodes and rows of the interior
    row: Integers
    label: Integers  # int[M], strongly connected components in topological order
    proper: Integers | None  # int[M], a policy that leaves almost surely, if some do not
    unit: float = 0.0  # the relative rounding of a backup
    outer_error: float = 0.0  # of the known values
    tolerance: float = 0.0  # the accuracy (tolerance, relative)
    relative: bool = False

    def solve(self) -> _CoreValues:
        """Bounds, by double precision if that suffices."""
        equation, rounds = self.equation, 0
        value, converged = self._value_iteration()
        first = self._made_proper(equation.greedy_policy(value, 1))
        best = self._by_sweeps(value, first) if converged else None
        if best is None or not self._is_narrow(best, self.tolerance):
            best, rounds = self._iterate(first, equation.size <= _SMALL_CORE)
        for method in (
            self._by_refinement,
            self._by_converged_sweeps,
            self._by_gth_refinement,
            self._by_fractions,
            self._by_ordered_sweeps,
        ):
            if best is not None and self._is_narrow(best, self.tolerance):
                break
            # A policy of the extra cost without a close bound may stay nearly for ever.
            useful = best is not None and self._is_narrow(best, _USEFUL)
            more = method(best.policy if best is not None and useful else first)
            if more is not None and (best is None or self._width(more) < self._width(best)):
                best = replace(more, rounds=rounds + more.rounds)
        assert best is not None  # the last method has some bounds
        return replace(best, policy=self.row[best.policy])

    def _value_iteration(self) -> tuple[Floats, bool]:
        """A value after a few sweeps, in large cores more while states converge; True if all do."""
        equation, large = self.equation, self.equation.size > _LARGE_CORE
        value, excess = np.zeros(equation.size), np.inf
        if equation.is_chain:  # one elimination suffices
            return value, False
        num_sweeps = _FIRST_SWEEPS // (2 if equation.size <= _SMALL_CORE else 1)
        for k in range(1, _MAX_SWEEPS):
            before, value = value, equation.best(equation.backup(value))
            if k < num_sweeps - large * _SWEEPS or k % _SWEEPS:
                continue
            if not large:
                break
            least = _CONVERGED * self.tolerance / k * self._weight(value)
            # Orders of magnitude by which a state changes too much, in the mean.
            last, excess = (
                excess,
                float(np.log(np.maximum(np.abs(value - before) / least, 1)).mean()),
            )
            if not excess:
                return value, True
            # The rate varies, so that it may predict more sweeps.
            if excess * _SWEEPS > (last - excess) * (2 * _MAX_SWEEPS):
                break
        return value, False

    def _by_sweeps(self, value: Floats, policy: Integers) -> _CoreValues | None:
        """Bounds from a converged value, by sweeps with the extra cost instead of linear systems."""
        equation, sign, weight = self.equation, self.equation.sign, self._weight(value)
        time = self._truncated_time(policy, weight)
        if time is None:
            return None
        extra = self._extra_cost(time, value, _MARGIN)
        value, rounds = value + sign * extra * time, 0
        while rounds < _MAX_SWEEPS:
            rounds += 1
            image = equation.backup(value)
            best = equation.best(image)
            before, value = value, best + sign * extra * weight
            if (8 * np.abs(value - before) <= extra * weight).all():
                break
        last, policy = policy, equation.choices.first(image, best)
        if (policy != last).any():
            time = self._truncated_time(policy, weight)
        attained = None if time is None else self._certified(policy, value, extra, weight, time)
        if attained is None or time is None:
            return None
        middle = value - sign * extra * time
        return _CoreValues(attained, value, middle, policy, rounds, "value iteration")

    def _truncated_time(self, policy: Integers, weight: Floats) -> Floats | None:
        """A policy's expected sum of weights but for an eighth of them; None if that takes long."""
        rows, stays, time = self.equation.matrix[policy], weight, np.zeros(policy.size)
        for _ in range(_MAX_SWEEPS):
            if (8 * stays <= weight).all():
                return time
            time, stays = time + stays, rows @ stays
        return None

    def _iterate(self, policy: Integers, patient: bool) -> tuple[_CoreValues | None, int]:
        """Policy iteration with an extra cost per step: the best bounds, and rounds.

        Unless patient, sweeps are tried as soon as the extra costs change the policy's value.
        """
        equation, sign = self.equation, self.equation.sign
        weight = np.ones(equation.size)
        solver: Factors | None = factorize(equation.matrix, self.label, policy)
        if not patient and solver is not None and any(x.factor is None for x in solver.blocks):
            patient, swept = True, self._by_converged_sweeps(policy)
            if swept is not None and self._is_narrow(swept, self.tolerance):
                return swept, 0
        extra, rounds, best = None, 0, None
        margin = _MARGIN_CHAIN if equation.is_chain else _MARGIN
        while rounds < _MAX_ROUNDS and solver is not None:
            rounds += 1
            if extra is None:
                costs = solver.solve(equation.cost[policy])
                weight = self._weight(costs)
                extra = self._extra_cost(solver.solve(weight), costs, margin)
            value = solver.solve(equation.cost[policy] + sign * extra * weight)
            if not np.isfinite(value).all():
                solver = solver.without_krylov(policy)
                extra = extra if np.isfinite(extra) else None
                continue
            if not patient and not rounds & (rounds - 1) and self._is_slow(solver, policy, value):
                patient, swept = True, self._by_converged_sweeps(policy)
                if swept is not None and self._is_narrow(swept, self.tolerance):
                    return swept, rounds
            late = rounds % (2 * _SWEPT_ROUNDS) == 0
            if late and not (solver.solve(weight) < weight / _EPS).all():
                break  # episodes so long that systems have no correct digit
            image = equation.backup(value)
            gain = sign * (equation.best(image) - value) + extra * weight
            if (gain > _KEPT * extra * weight).any():
                if margin < _MARGIN:
                    extra, margin = None, _MARGIN
                    continue
                before, strict = policy, rounds > _SWEPT_ROUNDS or equation.is_chain
                weight = self._weight(value)
                policy = self._improved(value, policy, extra * weight, strict)
                if strict and (policy == before).all():
                    break  # the gains are rounding
                solver = solver.refactorize(policy)
                continue
            time = solver.solve(weight)
            attained = self._certified(policy, value, extra, weight, time)
            if attained is not None:
                middle = value - sign * extra * time
                best = _CoreValues(attained, value, middle, policy, rounds, solver.method)
                if self._is_narrow(best, self.tolerance / 2):
                    break
            else:
                margin = _MARGIN
            old, weight = weight, self._weight(value)
            same = bool((np.abs(weight - old) <= old / 2).all())
            if not same:
                time = solver.solve(weight)
            other = self._extra_cost(time, value, margin)
            # The value of a better policy may need a larger extra for its rounding.
            if same and extra / 2 <= other <= (2 * extra if attained is None else np.inf):
                break
            extra = other
        return best, rounds

    def _is_slow(self, solver: Factors, policy: Integers, value: Floats) -> bool:
        """True if episodes are so long that their extra cost counts."""
        costs = solver.solve(self.equation.cost[policy])
        size = costs if self.relative else 1
        return not bool((np.abs(value - costs) <= _LONG * self.tolerance * size).all())

    def _weight(self, value: Floats) -> Floats:
        """The extra cost of each node, up to a factor: one, or in proportion to its value."""
        if not self.relative:
            return np.ones(value.size)
        return np.maximum(value, TINY * max(float(np.abs(value).max(initial=0)), 1))

    def _improved(self, value: Floats, policy: Integers, extra: Floats, strict: bool) -> Integers:
        equation = self.equation
        priced = replace(equation, cost=equation.cost + equation.sign * extra[equation.owner])
        if strict:
            return propagate_improvements(priced, value, policy, _KEPT * extra)
        return self._made_proper(priced.greedy_policy(value, _SWEEPS))

    def _made_proper(self, policy: Integers) -> Integers:
        """The policy, with rows of the proper one where it might never leave."""
        if self.proper is None:
            return policy
        rows = self.equation.matrix[policy]
        leaves = rows.sum(1) < 1 - 1e-9  # smaller probabilities of leaving need not be counted
        return np.where(_reaches(rows, leaves), policy, self.proper)

    def _extra_cost(self, time: Floats, value: Floats, margin: int) -> float:
        """A share of the tolerance, at least `margin` roundings; `time` is the sum of weights."""
        largest = 1.0 if self.relative else float(np.abs(value).max(initial=0))
        if self.relative:
            some = value > 0
            share = float((value[some] / time[some]).min(initial=np.inf)) if some.any() else 1.0
            share = share if np.isfinite(share) and share > 0 else 1.0
        else:
            share = 1 / max(float(time.max(initial=1)), 1)
        aim = (_SHARE_CHAIN if self.equation.is_chain else _SHARE) * self.tolerance
        return max(aim * share, margin * (self.unit + self.outer_error) * max(largest, 1e-300))

    def _certified(
        self, policy: Integers, value: Floats, extra: float, weight: Floats, time: Floats
    ) -> Floats | None:
        """The attained bound, if the value is the bound that is not exceeded; t is the time.

        Backups of a value that is not carried away from the optimum, or towards it by the policy
        alone, each with a slack for rounding; and ``t - P t >= w / 2`` shows that the policy leaves.
        """
        equation, sign = self.equation, self.equation.sign
        unit = self.unit + self.outer_error
        if not np.isfinite(time).all():
            return None
        slack = unit * (equation.cost + equation.matrix @ np.abs(value))
        if not (sign * equation.backup(value) + slack <= sign * value[equation.owner]).all():
            return None
        rows, cost = equation.matrix[policy], equation.cost[policy]
        if not ((time >= 0) & (time - rows @ time >= np.maximum(weight / 2, unit * time))).all():
            return None
        attained = value - sign * 1.5 * extra * time
        slack = unit * (cost + rows @ np.abs(attained))
        if not (sign * attained <= sign * (cost + rows @ attained) - slack).all():
            return None
        return attained

    def _is_narrow(self, values: _CoreValues, tolerance: float) -> bool:
        return self._width(values) <= tolerance

    def _width(self, values: _CoreValues) -> float:
        """The largest width of bounds, relative if the tolerance is."""
        sign = self.equation.sign
        width = sign * (values.outer - values.attained)
        if self.relative:
            size = np.abs(values.attained if sign > 0 else values.outer)
            with np.errstate(all="ignore"):
                width = np.where(width > 0, width / size, 0)
        return float(np.where(np.isnan(width), np.inf, width).max(initial=0))

    def _by_refinement(self, policy: Integers) -> _CoreValues | None:
        """Bounds of a core with very long episodes, from values in two floats."""

        def solver_of(rows: Integers) -> Solver | None:
            solver = factorize(self.equation.matrix, self.label, rows)
            return None if solver is None else (solver.without_krylov(rows) or solver).solve

        return self._refined(policy, solver_of)

    def _by_gth_refinement(self, policy: Integers) -> _CoreValues | None:
        """The same where pivots with subtractions have no correct digit."""
        matrix, leaving = self.equation.matrix, self.equation.leaving
        return self._refined(policy, lambda rows: gth_solver(matrix[rows], leaving[rows]))

    def _by_ordered_sweeps(self, policy: Integers) -> _CoreValues:
        """Bounds by Gauss-Seidel sweeps, which always end with some."""
        swept = self._swept(policy, required=True)
        assert swept is not None
        return swept

    def _by_converged_sweeps(self, policy: Integers) -> _CoreValues | None:
        """The same where sweeps converge and certify bounds; None otherwise."""
        return self._swept(policy, required=False)

    def _swept(self, policy: Integers, *, required: bool) -> _CoreValues | None:
        equation, sign, accuracy = self.equation, self.equation.sign, 0.01 * self.tolerance
        rows = CostRows(equation.matrix, equation.cost, equation.leaving, equation.owner)
        sweeps = OrderedSweeps(rows, sign, self.unit, self.relative)
        above = start_from_above(rows, self.unit, accuracy) if sign < 0 else None
        start = np.zeros(equation.size) if above is None else above
        value, error = sweeps.converge(start, accuracy)
        for _ in range(_EVALUATIONS):
            policy = self._made_proper(short_policy(sweeps, rows, value))
            if error <= accuracy:
                break
            solver = factorize(equation.matrix, self.label, policy)
            evaluated = None if solver is None else solver.solve(equation.cost[policy])
            if evaluated is None or not (evaluated >= 0).all():  # also NaN
                break
            value, error = sweeps.converge(evaluated, accuracy)
        if not required and not error <= self.tolerance:
            return None
        margins = 2 * error + self.tolerance / 64, self.tolerance / 4
        outer = sweeps.bound(value, sign, margins)
        if outer is None and not required:
            return None
        if required:
            outer = sweeps.tightened(outer, sign, sweeps.num_sweeps)
        assert outer is not None
        outer = outer * (1 + sign * self.outer_error)
        best: _CoreValues | None = None
        for penalty in (0.0, *_PENALTIES):
            if penalty:
                # Policies that wait for ever, as a minimum seems to be lower, cost their time.
                size = float(value.max(initial=0)) if self.relative else 1.0
                spent = rows._replace(cost=rows.cost + penalty * self.tolerance * max(size, TINY))
                timed = OrderedSweeps(spent, sign, self.unit, self.relative)
                policy = self._made_proper(timed.greedy(timed.converge(value, accuracy)[0]))
            chain = OrderedSweeps(rows.only(policy), -sign, self.unit, self.relative)
            start, error = chain.converge(value, accuracy)
            margins = 2 * error + self.tolerance / 64, self.tolerance / 4
            attained = chain.bound(start, -sign, margins)
            if attained is None and not required and sign > 0:
                return None
            if attained is None or required:
                attained = chain.tightened(attained, -sign, sweeps.num_sweeps)
            attained = attained * (1 - sign * self.outer_error)
            middle = np.clip(start, np.minimum(attained, outer), np.maximum(attained, outer))
            rounds = sweeps.num_sweeps + chain.num_sweeps
            swept = _CoreValues(attained, outer, middle, policy, rounds, "value iteration")
            if best is None or self._width(swept) < self._width(best):
                best = swept
            if sign > 0 or self._is_narrow(best, self.tolerance):
                break
        assert best is not None
        return best

    def _refined(
        self, policy: Integers, solver_of: Callable[[Integers], Solver | None]
    ) -> _CoreValues | None:
        optimum = refined_optimum(self.equation, self.unit, policy, solver_of, self.tolerance)
        if optimum is None:
            return None
        method = "policy iteration by elimination, refined"
        return self._within(
            optimum.value,
            optimum.share + self.outer_error,
            optimum.policy,
            optimum.num_policies,
            method,
        )

    def _by_fractions(self, policy: Integers) -> _CoreValues | None:
        """Bounds of a small core with extremely long episodes, from fractions."""
        if self.equation.size > MAX_FRACTIONS:
            return None
        order = elimination_order(self.equation.matrix[policy], self.label)
        optimum = None if order is None else exact_optimum(self.equation, policy, order)
        if optimum is None:
            return None
        share = perturbation_bound(self.unit + self.outer_error, self.equation.size)
        return self._within(optimum[0], share, optimum[1], 0, "policy iteration in fractions")

    def _within(
        self, value: Floats, share: float, policy: Integers, rounds: int, method: str
    ) -> _CoreValues:
        sign = self.equation.sign
        attained, outer = (value * (1 - side * sign * share) for side in (1, -1))
        return _CoreValues(attained, outer, value, policy, rounds, method)


def _reaches(rows: csr_array, goal: Booleans) -> Booleans:
    """The nodes of a chain from which a goal is reachable."""
    back = Edges(rows.indptr, rows.indices).reverse()
    return forward_search(back.start, back.target, goal)
