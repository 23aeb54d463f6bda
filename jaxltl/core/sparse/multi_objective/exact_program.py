"""Multi-objective queries of small models in rational arithmetic, by linear programming.

The unknowns are the expected visits of rows and the probabilities of stopping in a final component
(Etessami, Kwiatkowska, Vardi and Yannakakis 2008). A maximised reward may be infinite: the program
then has solutions with circulations in end components that their policy does not reach. Rows that
are positive only in such circulations are removed; a mixture of the other solutions visits all rows
that are left, so that a policy realises it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.graph.qualitative import end_components, shortest_path_rows
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.multi_objective.weighted_sum import FinalComponents

_MAX_CELLS = 10_000  # of the tableau: a pivot takes milliseconds
_MAX_WORK = 1_000_000  # cells of all pivots, in units of 256 bits: about half a second
_GREEDY = (
    60  # pivots by the largest gain; later ones follow the rule of Bland, which does not cycle
)


class Goal(NamedTuple):
    """An objective to be maximised."""

    reward: list[Fraction] | None  # of each row; negative for a minimised one
    place: int  # without a reward: the number of the probability
    pending: Booleans | None  # bool[N], where stopping is worth infinity: the target is missed
    least: Fraction | None  # the threshold


class ExactModel(NamedTuple):
    """A model with rational probabilities."""

    mdp: HostMDP
    distribution: Callable[[int], dict[int, Fraction]]  # of the successors of a row
    start: dict[int, Fraction]  # the initial distribution


class _ProgramTooLarge(Exception):
    """The work exceeds its limit."""


class ExactAnswer(NamedTuple):
    """Achievability of the thresholds, and the largest value of a goal: None if infinite."""

    holds: bool
    value: Fraction | None


class _Column(NamedTuple):
    """An unknown: its coefficients in the equations of states and in the goals."""

    owner: int  # the state that is visited
    flow: dict[int, Fraction]
    goals: list[Fraction]
    row: int = -1  # -1 for stopping
    parent: int = -1  # of an infinite reward, the column of stopping that must be positive too

    @property
    def stops(self) -> bool:
        return self.row < 0 and self.parent < 0


def solve_exactly(
    model: ExactModel,
    where: FinalComponents,
    goals: Sequence[Goal],
    index: int | None = None,
) -> ExactAnswer | None:
    """Decides the thresholds of goals, and maximises one under them; None if the model is large."""
    mdp = model.mdp
    rows = np.flatnonzero(where.rows)
    states = np.flatnonzero(mdp.states_of(where.rows))
    size = states.size + len(goals)
    if size * (rows.size + states.size + size) > _MAX_CELLS:
        return None
    columns = _columns(model, rows, where, goals)
    try:
        # Unless a reward is infinite, a circulation that is not reached is of no use.
        cyclic = end_components(mdp, rows=where.rows).inside
        endless = any(
            max(c.goals) > 0 and (c.parent >= 0 or (c.row >= 0 and cyclic[c.row])) for c in columns
        )
        constraints = [
            _Constraint([c.goals[i] for c in columns], goal.least)
            for i, goal in enumerate(goals)
            if goal.least is not None
        ]
        basis = _proper_columns(mdp, states, columns)
        simplex = _connected(_LinearProgram(columns, basis, model.start, constraints), endless)
        if simplex is None:
            return ExactAnswer(False, None)
        return ExactAnswer(True, None if index is None else simplex.largest_goal(index))
    except _ProgramTooLarge:
        return None


def _columns(
    model: ExactModel, rows: Integers, where: FinalComponents, goals: Sequence[Goal]
) -> list[_Column]:
    """The columns of rows, of stopping, and of infinite rewards."""
    mdp = model.mdp
    zero, one = Fraction(0), Fraction(1)
    columns = []
    for r in rows.tolist():
        s = int(mdp.state[r])
        flow = {s: one}
        for t, p in model.distribution(r).items():
            flow[t] = flow.get(t, zero) - p
        earned = [zero if g.reward is None else g.reward[r] for g in goals]
        columns.append(_Column(s, flow, earned, row=r))
    used = mdp.states_of(where.rows)
    inside = [mdp.states_of(region) for region in where.inside]
    for s in np.flatnonzero(used).tolist():
        sets = [where.sets[i] for i in range(len(inside)) if inside[i][s]]
        for chosen in sets:
            if any((chosen <= other).all() and (chosen != other).any() for other in sets):
                continue
            worth = [one * int(g.reward is None and bool(chosen[g.place])) for g in goals]
            columns.append(_Column(s, {s: one}, worth))
            endless = [one * int(g.pending is not None and bool(g.pending[s])) for g in goals]
            if any(endless):
                columns.append(_Column(s, {}, endless, parent=len(columns) - 1))
    return columns


class _Constraint(NamedTuple):
    """A sum of unknowns that is at least a number."""

    weights: list[Fraction]
    least: Fraction


class _LinearProgram(NamedTuple):
    """Flow equations of states, and constraints."""

    columns: list[_Column]
    basis: dict[int, int]  # for each state the column of a policy that stops almost surely
    start: dict[int, Fraction]
    constraints: list[_Constraint]


def _connected(program: _LinearProgram, endless: bool) -> _Simplex | None:
    """The program without circulations that no policy reaches; None if it has no solution."""
    count = len(program.columns)
    unreached: set[int] = set()
    while True:
        none = _Constraint([Fraction(-(i in unreached)) for i in range(count)], Fraction(0))
        simplex = _Simplex(program._replace(constraints=[*program.constraints, none]))
        if not simplex.is_feasible():
            return None
        if not endless:
            return simplex
        positive = simplex.support(unreached)
        disconnected = positive - _visited(program, positive)
        if not disconnected:
            return simplex
        unreached |= disconnected


def _proper_columns(mdp: HostMDP, states: Integers, columns: list[_Column]) -> dict[int, int]:
    """For each state the column of a policy that stops almost surely."""
    stops = {c.owner: i for i, c in enumerate(columns) if c.stops}
    number = {c.row: i for i, c in enumerate(columns) if c.row >= 0}
    ends = np.zeros(mdp.num_states, bool)
    ends[list(stops)] = True
    rows = np.zeros(mdp.num_rows, bool)
    rows[list(number)] = True
    policy = shortest_path_rows(mdp, ends, rows)
    return {s: stops[s] if s in stops else number[int(policy[s])] for s in states.tolist()}


def _visited(program: _LinearProgram, positive: set[int]) -> set[int]:
    """The positive columns whose states are reachable by positive columns."""
    columns = program.columns
    states = {s for s, p in program.start.items() if p}
    visited: set[int] = set()
    while more := {
        i
        for i in positive - visited
        if columns[i].owner in states and (columns[i].parent < 0 or columns[i].parent in visited)
    }:
        visited |= more
        states |= {t for i in more for t, p in columns[i].flow.items() if p < 0}
    return visited


class _Simplex:
    """Simplex method on an integer tableau, whose entries are multiples of one over `unit`.

    A pivot divides exactly by the one before (Edmonds 1967; Bareiss 1968).
    """

    def __init__(self, program: _LinearProgram) -> None:
        columns, basis, start, constraints = program
        self.columns = columns
        count, zero, one = len(columns), Fraction(0), Fraction(1)
        extra = len(constraints)
        rows = []
        for s in basis:
            row = [c.flow.get(s, zero) for c in columns] + [zero] * (extra + 1)
            rows.append([*row, start.get(s, zero)])
        for i, constraint in enumerate(constraints):
            surplus = [-one if i == j else zero for j in range(extra)]
            rows.append([*constraint.weights, *surplus, one, constraint.least])
        self.table = np.array([_integers(row) for row in rows], object)
        self.unit, self.work, self.ray = 1, 0, set[int]()
        self.basis = np.full(len(rows), -1)
        self.free = np.ones(count + extra + 1, bool)  # the columns that may enter
        for r, column in enumerate(basis.values()):
            self._pivot(r, column)
        # One violation of all constraints, which is minimised first.
        last = list(range(len(basis), len(rows)))
        missing = [Fraction(self.table[r, -1], self.table[r, -2]) for r in last]
        worst = last[missing.index(max(missing))]
        if max(missing) > 0:
            self._pivot(worst, -2 % self.table.shape[1])
        for i, r in enumerate(last):
            if self.basis[r] < 0:
                self._pivot(r, count + i)

    def is_feasible(self) -> bool:
        """True if all constraints can be met; their violation is zero from then on."""
        violation = self.table.shape[1] - 2
        if self._maximum({violation: Fraction(-1)}) != 0:
            return False
        self.free[violation] = False
        for r in np.flatnonzero(self.basis == violation):
            column = np.flatnonzero((self.table[r, :-1] != 0) & self.free)
            self._pivot(int(r), int(column[0]))
        return True

    def largest_goal(self, index: int) -> Fraction | None:
        """The largest value of a goal; None if it is infinite."""
        return self._maximum({i: c.goals[index] for i, c in enumerate(self.columns)})

    def support(self, without: set[int]) -> set[int]:
        """The columns that are positive in some solution."""
        positive = self._positive()
        for i in range(len(self.columns)):
            if i not in positive and i not in without:
                if self._maximum({i: Fraction(1)}) is None:
                    positive |= self.ray
                positive |= self._positive()
        return {i for i in positive if i < len(self.columns)}

    def _positive(self) -> set[int]:
        return set(self.basis[np.flatnonzero(self.table[:, -1] > 0)].tolist())

    def _maximum(self, weights: dict[int, Fraction]) -> Fraction | None:
        """The largest weighted sum of unknowns; None, with a ray, if it is infinite."""
        scale = math.lcm(*(w.denominator for w in weights.values()))
        weight = np.zeros(self.table.shape[1] - 1, object)
        for i, w in weights.items():
            weight[i] = int(w * scale)
        for step in range(10 * self.table.shape[1] ** 2):
            basic = weight[self.basis]
            gain = (weight * self.unit - basic @ self.table[:, :-1]) * self.free
            rising = np.flatnonzero(gain > 0)
            if not rising.size:
                return Fraction(int(basic @ self.table[:, -1]), self.unit * scale)
            c = int(gain.argmax() if step < _GREEDY else rising[0])
            falling = np.flatnonzero(self.table[:, c] > 0)
            if not falling.size:
                growing = np.flatnonzero(self.table[:, c] < 0)
                self.ray = {c, *self.basis[growing].tolist()}
                return None
            r = min(
                falling.tolist(),
                key=lambda i: (Fraction(self.table[i, -1], self.table[i, c]), self.basis[i]),
            )
            self._pivot(r, c)
        raise _ProgramTooLarge

    def _pivot(self, r: int, c: int) -> None:
        table = self.table
        self.work += table.size * (1 + int(self.unit).bit_length() // 256)
        if self.work > _MAX_WORK:
            raise _ProgramTooLarge
        if table[r, c] < 0:
            table[r] = -table[r]
        pivot, column, row = table[r, c], table[:, c].copy(), table[r].copy()
        column[r] = 0
        table = (table * pivot - np.outer(column, row)) // self.unit
        table[r] = row
        self.table, self.unit = table, pivot
        self.basis[r] = c


def _integers(row: list[Fraction]) -> list[int]:
    """A row of fractions times their common denominator."""
    scale = math.lcm(*(x.denominator for x in row))
    return [int(x * scale) for x in row]
