"""Bounds of satisfaction probabilities on a grid: sets first, then value iteration, then finer cells."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.continuous.dynamics import Dynamics
from jaxltl.core.continuous.grid import Grid, count_in, covered, cumulative, volume
from jaxltl.core.continuous.images import Images, NoiseBox, Step, image_boxes
from jaxltl.core.continuous.noise import Distribution
from jaxltl.core.continuous.regions import UndefinedError
from jaxltl.core.continuous.task_product import TaskProduct, task_product
from jaxltl.core.continuous.transition_bounds import (
    TooManyProbabilitiesError,
    TransitionBounds,
    transition_bounds,
)
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.pretty_print import brief


@brief
@dataclass(frozen=True)
class Successors:
    """Boxes of cells that rows may and must meet; rows are pairs of cells and actions."""

    cells: Integers  # int[M], the cells of the rows
    num_actions: int  # A
    start: Integers  # int[M A, n], the cells that are possible
    stop: Integers
    outside: Booleans  # bool[M A], True if the domain may be left
    # int[M A, n] twice, boxes of cells of positive probability, and bool[M A], True if leaving
    # the domain has one; None: noise is an adversary
    certain: tuple[Integers, Integers, Booleans] | None
    shape: tuple[int, ...]  # of the grid


def winning_cells(
    task: TaskProduct, rows: Successors, known: Booleans, maximize: bool = True
) -> tuple[Booleans, Integers]:
    """Product states ``bool[Q, C]`` from which the parity condition holds, against every successor in
    the boxes, and actions ``int[Q, C]`` of a winning strategy, 0 elsewhere.

    Cells without rows are winning if ``known bool[Q, C]``. Without `maximize`, the controller is an
    adversary too. Noise is an adversary among the possible successors; cells of positive probability
    for every state of a cell are met almost surely if they can be met again and again. Priorities 0..d
    are solved by `nu X_0 mu X_1 nu X_2 ...` over predecessors (Emerson and Jutla 1991); at odd ones the
    predecessor takes the next set with positive probability while staying in the outer one, the fixed
    point of games with strongly fair edges (Banerjee, Majumdar, Mallik, Schmuck and Soudjani 2023,
    Theorem 3).
    """
    solver = _Solver(task, rows, known | (task.decided == 1)[:, None], maximize)
    top = int(task.priority.max())
    states = solver.solve(0, max(top, 1), [])
    return states, solver.action


class _Solver:
    """State of the nested fixed point: the sets, and the actions by which states entered them."""

    def __init__(
        self, task: TaskProduct, rows: Successors, known: Booleans, maximize: bool
    ) -> None:
        self.task, self.rows, self.known, self.maximize = task, rows, known, maximize
        self.action = np.zeros(known.shape, np.int32)
        self.undecided: list[int] = np.flatnonzero(task.decided < 0).tolist()

    def solve(self, priority: int, top: int, outer: list[Booleans]) -> Booleans:
        """The fixed point of the variables from `priority` on, for values of the outer ones."""
        greatest = priority % 2 == 0
        current = self.known | np.ones_like(self.known) if greatest else self.known.copy()
        current[self.task.decided == 0] = False
        while True:
            sets, before = [*outer, current], self.action.copy()
            new = self.solve(priority + 1, top, sets) if priority < top else self.step(sets)
            if not greatest:  # states that entered earlier keep the actions by which they did
                self.action = np.where(current, before, self.action)
            if (new == current).all():
                return new
            current = new

    def step(self, sets: list[Booleans]) -> Booleans:
        """One application of the predecessors of all priorities."""
        won_states = self.known.copy()
        for q in self.undecided:
            priority = int(self.task.priority[q])
            inner = sets[priority]
            good = self.all_inside(inner, q)
            if priority % 2 and self.rows.certain is not None:
                good |= self.all_inside(sets[priority - 1], q) & self.some_inside(inner, q)
            grid = good.reshape(-1, self.rows.num_actions)
            won = grid.any(1) if self.maximize else grid.all(1)
            cells = self.rows.cells
            new = won & ~won_states[q, cells]
            self.action[q, cells[new]] = grid[new].argmax(1)
            won_states[q, cells[new]] = True
        return won_states

    def all_inside(self, states: Booleans, q: int) -> Booleans:
        """Rows with all successors in a set."""
        return contained(self.task, self.rows, states, q)

    def some_inside(self, states: Booleans, q: int) -> Booleans:
        """Rows with positive probability of a set."""
        assert self.rows.certain is not None
        table = cumulative(self.task.entered(states, q).reshape(self.rows.shape))
        start, stop, leaves = self.rows.certain
        return (count_in(table, start, stop) > 0) | (leaves & bool(self.task.outside[q]))


def contained(task: TaskProduct, rows: Successors, states: Booleans, memory: int) -> Booleans:
    """Rows ``bool[R]`` with all possible successors, entered from a memory state, in a set."""
    table = cumulative(task.entered(states, memory).reshape(rows.shape))
    cells = volume(rows.start, rows.stop)
    inside = count_in(table, rows.start, rows.stop) == cells
    if not task.outside[memory]:
        inside &= ~rows.outside
    result: Booleans = inside & ((cells > 0) | rows.outside)
    return result


_TOLERANCE = 1e-7  # largest change of the last sweep
_EVALUATION_SWEEPS = 200  # of a policy between two sweeps over all actions


def iterate(
    task: TaskProduct,
    bounds: TransitionBounds,
    rows: Successors,
    start: tuple[Floats, Integers],
    max_sweeps: int,
    maximize: bool = True,
) -> tuple[Floats, Integers]:
    """Values `V <- max(V, opt_a min_P P V)` and actions that attain them, both ``[Q, C]``.

    Each iterate is a lower bound if the first one is; it is 1 in winning states.
    """
    value, action = start[0].copy(), start[1].copy()
    change = np.inf
    for _ in range(max_sweeps):
        if change <= _TOLERANCE:
            break
        change = 0.0
        for q in reversed(np.flatnonzero(task.decided < 0)):
            expected = _expected(task, bounds, value, q, rows.shape).reshape(-1, rows.num_actions)
            best = expected.argmax(1) if maximize else expected.argmin(1)
            new = np.take_along_axis(expected, best[:, None], 1)[:, 0]
            better = new > value[q, rows.cells]
            action[q, rows.cells[better]] = best[better]
            change = max(change, _raise(value, q, rows.cells, new))
        if maximize and rows.num_actions > 1:
            _evaluate(task, bounds, rows, value, action, max(change / 10, _TOLERANCE))
    return value, action


def _expected(
    task: TaskProduct, bounds: TransitionBounds, value: Floats, memory: int, shape: tuple[int, ...]
) -> Floats:
    """Least expected values ``[R]`` of the rows from a memory state."""
    return bounds.least(task.entered(value, memory).reshape(shape), float(task.outside[memory]))


def _raise(value: Floats, memory: int, cells: Integers, new: Floats) -> float:
    """Raises values to new ones; returns the largest change."""
    before = value[memory, cells]
    value[memory, cells] = np.maximum(before, new)
    return float((new - before).max(initial=0))


def _evaluate(
    task: TaskProduct,
    bounds: TransitionBounds,
    rows: Successors,
    value: Floats,
    action: Integers,
    tolerance: float,
) -> None:
    """Sweeps with the chosen actions alone, which cost a fraction of those over all actions."""
    undecided = np.flatnonzero(task.decided < 0)
    first = np.arange(len(rows.cells)) * rows.num_actions
    parts = {q: bounds.part(first + action[q, rows.cells]) for q in undecided}
    for _ in range(_EVALUATION_SWEEPS):
        change = 0.0
        for q in reversed(undecided):
            expected = _expected(task, parts[q], value, q, rows.shape)
            change = max(change, _raise(value, q, rows.cells, expected))
        if change <= tolerance:
            return


def reachable(
    task: TaskProduct, rows: Successors, initial: Booleans, finished: Booleans
) -> Booleans:
    """Product states ``bool[Q, C]`` that may be reached from initial cells ``bool[C]``, through states
    that are not finished.
    """
    row_of_cell = np.full(initial.shape, -1)
    row_of_cell[rows.cells] = np.arange(len(rows.cells))
    reached = (task.start[task.label_class].T) & initial
    todo = reached & ~finished & (task.decided < 0)[:, None]
    while todo.any():
        new = np.zeros_like(reached)
        for q in np.flatnonzero(todo.any(1)):
            at = row_of_cell[np.flatnonzero(todo[q])]
            at = at[at >= 0]
            index = (at[:, None] * rows.num_actions + np.arange(rows.num_actions)).reshape(-1)
            met = covered(rows.start[index], rows.stop[index], rows.shape).reshape(-1)
            new |= task.moves[q][task.label_class].T & met
        todo = new & ~reached & ~finished & (task.decided < 0)[:, None]
        reached |= new
    return reached


TAIL = 1e-15  # probability of unbounded noise outside its box, for which nothing is assumed
# Below this mean of the lower probabilities of successors value iteration gives hardly more than sets do
# (benchmarks/continuous.py, triple integrator), and is left to finer grids.
CERTAIN_SHARE = 0.01
_ROWS = 2**16  # handled at once, which bounds the memory
UNPROVEN, ITERATED, ALMOST_SURE, SURE = range(4)  # how the lower bound of a state was found


Report = Callable[[str], None]


@dataclass(frozen=True)
class RefinementLimits:
    """When refinement stops; see :func:`~jaxltl.core.continuous.certificate.certify_policy`."""

    tolerance: float = 1e-3
    threshold: float | None = None
    max_cells: int = 2**20
    max_sweeps: int = 1000
    upper: bool = True
    report: Report | None = None

    def log(self, text: str) -> None:
        """Calls `report` with a line of progress."""
        if self.report is not None:
            self.report(text)

    def decides(self, lower: Floats, upper: Floats) -> bool:
        """True if bounds of initial states are all above the threshold, or one is below."""
        if self.threshold is None:
            return False
        return bool((lower >= self.threshold).all() or (upper < self.threshold).any())


@brief
@dataclass(frozen=True, eq=False)
class CellBounds:
    """Bounds of the satisfaction probability of product states, after refinement."""

    grid: Grid  # the cells and the memory
    task: TaskProduct
    lower: Floats  # float[Q, C]
    upper: Floats
    how: Integers  # int8[Q, C], how the lower bound was found
    action: Integers  # int[Q, C], which attains the lower bound
    initial: Booleans  # bool[C], cells that meet the initial states
    needed: Booleans  # bool[C], cells on whose bounds those of the initial cells may depend

    def initial_bounds(self) -> tuple[Floats, Floats]:
        """Lower and upper bounds ``float[C]`` of beginning in each cell.

        An adversary chooses among uncertain labels: least lower and greatest upper bound.
        """
        upper: Floats = 1 - self.task.initial(1 - self.upper)
        return self.task.initial(self.lower), upper

    @property
    def undecided(self) -> Booleans:
        """``bool[Q, C]``: product states without tight bounds."""
        undecided = (self.task.decided < 0)[:, None]
        return undecided & (self.lower < 1) & (self.upper > 0) & (self.lower < self.upper)

    def complement(self) -> CellBounds:
        """The bounds of the negated formula."""
        how = np.where(self.upper <= 0, SURE, UNPROVEN).astype(np.int8)
        lower, upper, task = 1 - self.upper, 1 - self.lower, self.task.complement()
        return replace(self, task=task, lower=lower, upper=upper, how=how)


def noise_box(dynamics: Dynamics) -> NoiseBox:
    """A box of the noise and the disturbance; unbounded noise is cut where `TAIL` is left."""
    low, high, lost = [], [], 0.0
    for noise in dynamics.noise:
        a, b, tail = _finite_support(noise)
        low.append(a)
        high.append(b)
        lost += tail
    random = [True] * len(low)
    symmetric = [noise.symmetric for noise in dynamics.noise]
    if dynamics.disturbance is not None:
        low.extend(dynamics.disturbance[0])
        high.extend(dynamics.disturbance[1])
    missing = [False] * (len(low) - len(random))
    marks = np.array([random + missing, symmetric + missing], bool)
    return NoiseBox(np.array(low), np.array(high), marks[0], marks[1], lost)


def _finite_support(noise: Distribution) -> tuple[float, float, float]:
    """Ends of an interval, and the probability outside of it."""
    low, high = noise.support
    lost, ends = 0.0, [low, high]
    for side, sign in ((0, -1.0), (1, 1.0)):
        if np.isfinite(ends[side]):
            continue
        reach = noise.scale
        while True:
            end = noise.mean + sign * reach
            outer = (end, np.inf) if sign > 0 else (-np.inf, end)
            tail = float(noise.probability_bounds(*outer, 0.0, 0.0)[1])
            if tail <= TAIL or reach > 1e6 * noise.scale:
                break
            reach *= 1.1
        ends[side], lost = end, lost + tail
    return ends[0], ends[1], lost


@dataclass(frozen=True, eq=False)
class Abstraction:
    """Bounds of the satisfaction probability of the cells of a grid, refined for the initial states."""

    dynamics: Dynamics  # the world and its task
    formula: str | Formula
    step: Step  # the next state of state, row of `actions` and noise
    # float[A, m], over which lower bounds are maximised; one row of any numbers for the step
    # of a policy
    actions: Floats
    limits: RefinementLimits  # when refinement stops
    seconds: dict[str, float] = field(default_factory=dict)  # wall time by stage

    def bounds(self, grid: Grid) -> CellBounds:
        """Bounds after refinement; an interrupt leaves those of the last finished grid, and so does
        a finer one with more transition probabilities than memory should hold."""
        bounds = refined = first = self._first(grid)
        limits = self.limits
        while True:
            try:
                bounds = self._improved(refined)
            except KeyboardInterrupt:
                limits.log("interrupted: the bounds proven so far are kept")
                return bounds
            except TooManyProbabilitiesError as reason:
                if refined is first:
                    raise
                limits.log(f"the bounds proven so far are kept: {reason}")
                return bounds
            lower, upper = (x[bounds.initial] for x in bounds.initial_bounds())
            limits.log(
                f"{bounds.grid.num_cells:,} cells: initial states satisfy with probability at least "
                f"{lower.min():.6g}, at most {upper.min():.6g}"
            )
            narrow = limits.threshold is None and (upper - lower).max() <= limits.tolerance
            finer = _finer(bounds.grid, bounds.needed, limits)
            if narrow or limits.decides(lower, upper) or finer is None:
                return bounds
            refined = self._refined(bounds, *finer)

    def vacuous(self, grid: Grid) -> CellBounds:
        """Bounds 0 and 1 in all states, where a value may be NaN."""
        try:
            bounds = self._first(grid)
        except UndefinedError:  # in the function of a label
            bounds = self._first(grid, labelled=False)
        shape = bounds.lower.shape
        unproven = np.full(shape, UNPROVEN, np.int8)
        return replace(bounds, lower=np.zeros(shape), upper=np.ones(shape), how=unproven)

    def safe_actions(self, bounds: CellBounds) -> Booleans:
        """Actions ``bool[Q, C, A]`` that lead only to states of lower bound 1.

        In states that are satisfied surely or with probability 1, at least the policy's action is one.
        """
        won, task = bounds.lower >= 1, bounds.task
        safe = np.zeros((*won.shape, len(self.actions)), bool)
        cells = np.flatnonzero((won & (task.decided < 0)[:, None]).any(0))
        if len(cells):
            rows = self._rows(bounds.grid, cells, noise_box(self.dynamics))[1]
            for q in np.flatnonzero(task.decided < 0):
                inside = contained(task, rows, won, int(q)).reshape(len(cells), -1)
                safe[q, cells] = inside & won[q, cells, None]
        safe[task.decided == 1] = True
        return safe

    def _first(self, grid: Grid, labelled: bool = True) -> CellBounds:
        """Bounds 0 and 1."""
        dynamics, names = self.dynamics, self.dynamics.propositions
        low, high = grid.boxes()
        certain, possible = np.zeros((2, grid.num_cells, len(names)), bool)
        for i, name in enumerate(names):
            if labelled and name in dynamics.labels:
                certain[:, i], possible[:, i] = dynamics.labels[name].membership(low, high)
        task = task_product(self.formula, names, certain, possible, dynamics.outside)
        # The initial boxes are closed: a cell that only touches the upper edge of one is initial too.
        closed = replace(dynamics.initial, high=np.nextafter(dynamics.initial.high, np.inf))
        shape = (task.num_memory, grid.num_cells)
        decided = np.broadcast_to(task.decided[:, None], shape)
        return CellBounds(
            grid,
            task,
            (decided == 1).astype(np.float64),
            (decided != 0).astype(np.float64),
            np.where(decided == 1, SURE, UNPROVEN).astype(np.int8),
            np.zeros(shape, np.int32),
            closed.membership(low, high)[1],
            np.ones(grid.num_cells, bool),
        )

    def _refined(self, bounds: CellBounds, grid: Grid, parents: tuple[Integers, ...]) -> CellBounds:
        """The same bounds on a finer grid with the parents of its intervals."""
        fresh = self._first(grid)
        if not fresh.task.same_memory(
            bounds.task
        ):  # fewer labels are uncertain: other memory states
            return fresh
        cell = np.ravel_multi_index(np.ix_(*parents), bounds.grid.shape).reshape(-1)
        arrays = {x: getattr(bounds, x)[:, cell] for x in ("lower", "upper", "how", "action")}
        return replace(fresh, needed=bounds.needed[cell], **arrays)

    def _rows(self, grid: Grid, cells: Integers, box: NoiseBox) -> tuple[Images, Successors]:
        """The images of cells under each action, and the cells that they may meet."""
        images = image_boxes(self.step, grid, cells, self.actions, box)
        j, noise = np.array(images.noise_of), self.dynamics.noise
        lower, upper = np.append(box.low, 0.0)[j], np.append(box.high, 0.0)[j]
        unbounded = np.array([i >= 0 and not np.isfinite(noise[i].support).all() for i in j])
        start = np.empty(images.low.shape, np.int32)
        stop, outside = np.empty_like(start), np.empty(len(start), bool)
        for begin in range(0, len(start), _ROWS):
            part = slice(begin, begin + _ROWS)
            gain = images.gain[part]
            low, high = images.low[part] + gain * lower, images.high[part] + gain * upper
            random = (unbounded & (gain > 0)) | (box.lost > 0)
            low, high = np.where(random, -np.inf, low), np.where(random, np.inf, high)
            if self.dynamics.outside == "clip":
                low, high = (np.clip(x, *self.dynamics.domain) for x in (low, high))
            start[part], stop[part], outside[part] = grid.ranges(low, high)
        count = len(self.actions)
        return images, Successors(images.cells, count, start, stop, outside, None, grid.shape)

    def _improved(self, bounds: CellBounds) -> CellBounds:
        """Better bounds on the same grid: lower ones, then upper ones as those of the negation."""
        grid, limits = bounds.grid, self.limits
        cells = np.flatnonzero(bounds.undecided.any(0) & bounds.needed)
        if not len(cells):
            return replace(bounds, needed=np.zeros(grid.num_cells, bool))
        limits.log(f"{grid.num_cells:,} cells: images of {len(cells):,} cells")
        box = noise_box(self.dynamics)
        with self.stage("images"):
            problem = _AbstractionProblem(self, *self._rows(grid, cells, box), box)
        bounds = problem.improved(bounds, True)
        upper = bounds.upper
        goal = 1 - limits.tolerance if limits.threshold is None else limits.threshold
        if limits.upper and (bounds.task.initial(bounds.lower)[bounds.initial] < goal).any():
            upper = np.minimum(upper, 1 - problem.improved(bounds.complement(), False).lower)
        # Each bound is sound; where rounding makes them cross, the probability is between both.
        bounds = replace(bounds, upper=np.maximum(upper, bounds.lower))
        return replace(bounds, needed=problem.needed(bounds, problem.active(bounds)))

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the wall time of a block to a stage."""
        begin = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin


def _finer(
    grid: Grid, needed: Booleans, limits: RefinementLimits
) -> tuple[Grid, tuple[Integers, ...]] | None:
    """The refined grid and the parents of its intervals, or None if it has too many cells."""
    finer, parents = grid.halve(needed)
    return (finer, parents) if grid.num_cells < finer.num_cells <= limits.max_cells else None


@dataclass(frozen=True)
class _AbstractionProblem:
    """The rows of one grid."""

    abstraction: Abstraction
    images: Images
    rows: Successors
    box: NoiseBox

    def needed(self, bounds: CellBounds, active: Integers) -> Booleans:
        """Cells ``bool[C]`` at rows' positions."""
        needed = np.zeros(bounds.grid.num_cells, bool)
        needed[self.rows.cells[active]] = True
        return needed

    def improved(self, bounds: CellBounds, maximize: bool) -> CellBounds:
        """Better lower bounds, by sets and by value iteration."""
        task, stage, limits = bounds.task, self.abstraction.stage, self.abstraction.limits
        value, how, action = bounds.lower.copy(), bounds.how.copy(), bounds.action.copy()
        bounds = replace(bounds, lower=value, how=how, action=action)

        def prove(rows: Successors, kind: int) -> None:
            known = (value >= 1) & (how >= kind)  # "surely" rests on sure states alone
            won, choice = winning_cells(task, rows, known, maximize)
            new = won & (value < 1)
            value[new], how[new], action[new] = 1.0, kind, choice[new]

        with stage("sets"):
            if not self.rows.outside.all() or task.outside.any():
                prove(self.rows, SURE)
            active = self.active(bounds)
        if not len(active) or not any(j >= 0 for j in self.images.noise_of):
            return bounds
        with stage("sets"):
            rows, probabilities = self._part(bounds.grid, active)
            prove(replace(rows, certain=probabilities.certain()), ALMOST_SURE)
        with stage("value iteration"):
            active = self.active(bounds)
            share, finer = probabilities.certain_share(), self.needed(bounds, active)
            if not len(active) or (
                share < CERTAIN_SHARE and _finer(bounds.grid, finer, limits) is not None
            ):
                return bounds
            if len(active) < len(rows.cells):
                rows, probabilities = self._part(bounds.grid, active)
            start = value, action
            lower, best = iterate(task, probabilities, rows, start, limits.max_sweeps, maximize)
            how[lower > value] = ITERATED
        return replace(bounds, lower=lower, action=best)

    def active(self, bounds: CellBounds) -> Integers:
        """Rows' positions of cells that matter for initial states and are not decided."""
        finished = (bounds.lower >= 1) | (bounds.upper <= 0)
        met = reachable(bounds.task, self.rows, bounds.initial, finished)
        needed = met & ~finished & (bounds.task.decided < 0)[:, None]
        return np.flatnonzero(np.logical_or.reduce(needed, axis=0)[self.rows.cells])

    def _part(self, grid: Grid, active: Integers) -> tuple[Successors, TransitionBounds]:
        """The rows of some cells, with their transition probabilities."""
        dynamics, rows, index = self.abstraction.dynamics, self.rows, None
        if len(active) < len(rows.cells):
            index = (active[:, None] * rows.num_actions + np.arange(rows.num_actions)).reshape(-1)
            arrays = {x: getattr(rows, x)[index] for x in ("start", "stop", "outside")}
            rows = replace(rows, cells=rows.cells[active], **arrays)
        clipped = dynamics.outside == "clip"
        return rows, transition_bounds(self.images, grid, dynamics.noise, self.box, clipped, index)
