"""Bounds of satisfaction probabilities on a grid: sets first, then value iteration, then finer cells."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.continuous.dynamics import Dynamics
from jaxltl.core.continuous.grid import Grid
from jaxltl.core.continuous.images import Images, NoiseBox, image_boxes
from jaxltl.core.continuous.interval_iteration import iterate, reachable
from jaxltl.core.continuous.noise import Distribution
from jaxltl.core.continuous.noise_gains import Step
from jaxltl.core.continuous.task_product import TaskProduct, task_product
from jaxltl.core.continuous.transition_bounds import TransitionBounds, transition_bounds
from jaxltl.core.continuous.winning_cells import Successors, contained, winning_cells
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.pretty_print import brief

TAIL = 1e-15  # probability of unbounded noise outside its box, for which nothing is assumed
# Below this mean of the lower probabilities of successors value iteration gives hardly more than sets do
# (benchmarks/continuous.py, triple integrator), and is left to finer grids.
CERTAIN_SHARE = 0.01
_ROWS = 2**16  # handled at once, which bounds the memory
UNPROVEN, ITERATED, ALMOST_SURE, SURE = range(4)  # how the lower bound of a state was found


@brief
@dataclass(frozen=True)
class Control:
    """The choices in a cell: none for a policy, or a grid of actions.

    Attributes:
      step: the next state of state, row of `actions` and noise.
      actions: ``float[A, m]``; one row of any numbers for the step of a policy.
    """

    step: Step
    actions: Floats


@brief
@dataclass(frozen=True, eq=False)
class Bounds:
    """Bounds of the satisfaction probability of product states, after refinement.

    Attributes:
      grid, task: the cells and the memory.
      lower, upper: ``float[Q, C]``.
      how: ``int8[Q, C]``, how the lower bound was found.
      action: ``int[Q, C]``, which attains the lower bound.
      initial: ``bool[C]``, cells that meet the initial states.
      needed: ``bool[C]``, cells on whose bounds those of the initial cells may depend.
      seconds: wall time by stage.
    """

    grid: Grid
    task: TaskProduct
    lower: Floats
    upper: Floats
    how: Integers
    action: Integers
    initial: Booleans
    needed: Booleans
    seconds: dict[str, float] = field(default_factory=dict)

    def initial_bounds(self) -> tuple[Floats, Floats]:
        """Lower and upper bounds ``float[C]`` of beginning in each cell.

        An adversary chooses among uncertain labels: least lower and greatest upper bound.
        """
        upper: Floats = 1 - self.task.initial(1 - self.upper)
        return self.task.initial(self.lower), upper


@dataclass(frozen=True)
class Limits:
    """When refinement stops.

    Attributes:
      tolerance: the width of the bounds of initial states.
      threshold: stop when all initial states are proven above, or one below; or None.
      max_cells: of the finest grid.
      max_sweeps: of value iteration on one grid.
      upper: False to compute lower bounds alone.
    """

    tolerance: float = 1e-3
    threshold: float | None = None
    max_cells: int = 2**20
    max_sweeps: int = 1000
    upper: bool = True


Report = Callable[[str], None]


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
    missing = len(low) - len(random)
    return NoiseBox(
        np.array(low),
        np.array(high),
        np.array(random + [False] * missing, bool),
        np.array(symmetric + [False] * missing, bool),
        lost,
    )


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
            far = (end, np.inf) if sign > 0 else (-np.inf, end)
            tail = float(noise.probability_bounds(*far, 0.0, 0.0)[1])
            if tail <= TAIL or reach > 1e6 * noise.scale:
                break
            reach *= 1.1
        ends[side], lost = end, lost + tail
    return ends[0], ends[1], lost


def bound_satisfaction(
    dynamics: Dynamics,
    control: Control,
    formula: str | Formula,
    grid: Grid,
    limits: Limits,
    report: Report = lambda text: None,
) -> Bounds:
    """Bounds of the satisfaction probability of every cell, refined for the initial states.

    The policy of the lower bound maximises over the actions of `control`. An interrupt ends refinement;
    the bounds of the last finished grid are returned.
    """
    seconds: dict[str, float] = {}
    bounds = _first(dynamics, formula, grid)
    refined = bounds
    while True:
        try:
            bounds = _improve(dynamics, control, refined, limits, report, seconds)
        except KeyboardInterrupt:
            report("interrupted: the bounds proven so far are kept")
            return replace(bounds, seconds=seconds)
        lower, upper = (x[bounds.initial] for x in bounds.initial_bounds())
        report(
            f"{bounds.grid.num_cells:,} cells: initial states satisfy with probability at least "
            f"{lower.min():.6g}, at most {upper.min():.6g}"
        )
        finer = _finer(bounds.grid, bounds.needed, limits)
        if _finished(lower, upper, limits) or finer is None:
            return replace(bounds, seconds=seconds)
        refined = _refined(dynamics, formula, bounds, *finer)


def _finer(
    grid: Grid, needed: Booleans, limits: Limits
) -> tuple[Grid, tuple[Integers, ...]] | None:
    """The refined grid and the parents of its intervals, or None if it has too many cells."""
    finer, parents = grid.halve(needed)
    return (finer, parents) if grid.num_cells < finer.num_cells <= limits.max_cells else None


def _finished(lower: Floats, upper: Floats, limits: Limits) -> bool:
    if limits.threshold is not None:
        return bool((lower >= limits.threshold).all() or (upper < limits.threshold).any())
    return bool((upper - lower).max() <= limits.tolerance)


def _product(
    dynamics: Dynamics, formula: str | Formula, grid: Grid
) -> tuple[TaskProduct, Booleans]:
    low, high = grid.boxes()
    names = dynamics.propositions
    certain, possible = np.zeros((2, grid.num_cells, len(names)), bool)
    for i, name in enumerate(names):
        if name in dynamics.labels:
            certain[:, i], possible[:, i] = dynamics.labels[name].membership(low, high)
    outside = None if dynamics.outside in ("violates", "clip") else dynamics.outside
    task = task_product(formula, names, certain, possible, outside)
    # The initial boxes are closed: a cell that only touches the upper edge of one is initial too.
    closed = replace(dynamics.initial, high=np.nextafter(dynamics.initial.high, np.inf))
    return task, closed.membership(low, high)[1]


def _first(dynamics: Dynamics, formula: str | Formula, grid: Grid) -> Bounds:
    """Bounds 0 and 1."""
    task, initial = _product(dynamics, formula, grid)
    shape = (task.num_memory, grid.num_cells)
    decided = np.broadcast_to(task.decided[:, None], shape)
    return Bounds(
        grid,
        task,
        (decided == 1).astype(np.float64),
        (decided != 0).astype(np.float64),
        np.where(decided == 1, SURE, UNPROVEN).astype(np.int8),
        np.zeros(shape, np.int32),
        initial,
        np.ones(grid.num_cells, bool),
    )


def _refined(
    dynamics: Dynamics,
    formula: str | Formula,
    bounds: Bounds,
    grid: Grid,
    parents: tuple[Integers, ...],
) -> Bounds:
    """The same bounds on a finer grid with the parents of its intervals."""
    task, initial = _product(dynamics, formula, grid)
    cell = np.ravel_multi_index(np.ix_(*parents), bounds.grid.shape).reshape(-1)
    if not _same_memory(task, bounds.task):  # fewer labels are uncertain: other memory states occur
        fresh = _first(dynamics, formula, grid)
        return replace(fresh, seconds=bounds.seconds)
    return Bounds(
        grid,
        task,
        bounds.lower[:, cell],
        bounds.upper[:, cell],
        bounds.how[:, cell],
        bounds.action[:, cell],
        initial,
        bounds.needed[cell],
    )


def _same_memory(x: TaskProduct, y: TaskProduct) -> bool:
    same = x.states == y.states and x.automaton.delta.shape == y.automaton.delta.shape
    return same and bool((x.automaton.delta == y.automaton.delta).all())


def _improve(
    dynamics: Dynamics,
    control: Control,
    bounds: Bounds,
    limits: Limits,
    report: Report,
    seconds: dict[str, float],
) -> Bounds:
    """Better bounds on the same grid: lower ones, then upper ones as those of the negation."""
    clock = _Clock(seconds)
    box = noise_box(dynamics)
    open_cells = _open(bounds.lower, bounds.upper, bounds.task)
    cells = np.flatnonzero(open_cells.any(0) & bounds.needed)
    if not len(cells):
        return replace(bounds, needed=np.zeros(bounds.grid.num_cells, bool))
    report(f"{bounds.grid.num_cells:,} cells: images of {len(cells):,} cells")
    images = image_boxes(control.step, bounds.grid, cells, control.actions, box)
    rows = _successors(dynamics, bounds.grid, images, control, box)
    clock.stage("images")
    problem = _Problem(dynamics, bounds.grid, images, rows, box, limits, bounds.initial)
    before = _Lower(bounds.lower, bounds.how, bounds.action)
    lower = problem.lower_bounds(bounds.task, before, bounds.upper, True, clock)
    upper = bounds.upper
    goal = 1 - limits.tolerance if limits.threshold is None else limits.threshold
    if limits.upper and (bounds.task.initial(lower.value)[bounds.initial] < goal).any():
        how = np.where(upper <= 0, SURE, UNPROVEN).astype(np.int8)
        start = _Lower(1 - upper, how, lower.action)
        negated = bounds.task.complement()
        found = problem.lower_bounds(negated, start, 1 - lower.value, False, clock)
        upper = np.minimum(upper, 1 - found.value)
    # Each bound is sound; where rounding makes them cross, the probability is between both.
    upper = np.maximum(upper, lower.value)
    needed = problem.needed(problem.active(bounds.task, lower.value, upper))
    return replace(
        bounds, lower=lower.value, upper=upper, how=lower.how, action=lower.action, needed=needed
    )


def _open(lower: Floats, upper: Floats, task: TaskProduct) -> Booleans:
    """Product states without tight bounds."""
    return (lower < 1) & (upper > 0) & (lower < upper) & (task.decided < 0)[:, None]


def _successors(
    dynamics: Dynamics, grid: Grid, images: Images, control: Control, box: NoiseBox
) -> Successors:
    """The cells that each row may meet."""
    j = np.array(images.noise_of)
    least = np.append(box.low, 0.0)[j]
    most = np.append(box.high, 0.0)[j]
    unbounded = np.array([i >= 0 and not np.isfinite(dynamics.noise[i].support).all() for i in j])
    start = np.empty(images.low.shape, np.int32)
    stop, outside = np.empty_like(start), np.empty(len(start), bool)
    for begin in range(0, len(start), _ROWS):
        part = slice(begin, begin + _ROWS)
        gain = images.gain[part]
        low, high = images.low[part] + gain * least, images.high[part] + gain * most
        random = (unbounded & (gain > 0)) | (box.lost > 0)
        low, high = np.where(random, -np.inf, low), np.where(random, np.inf, high)
        if dynamics.outside == "clip":
            low, high = np.clip(low, *dynamics.domain), np.clip(high, *dynamics.domain)
        start[part], stop[part], outside[part] = grid.ranges(low, high)
    return Successors(images.cells, len(control.actions), start, stop, outside, None, grid.shape)


class _Clock:
    """Wall time by stage."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self.seconds, self.last = seconds, time.perf_counter()

    def stage(self, name: str) -> None:
        """Ends a stage."""
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self.last
        self.last = now


@dataclass(frozen=True)
class _Lower:
    value: Floats
    how: Integers
    action: Integers


@dataclass(frozen=True)
class _Problem:
    """One grid with its rows."""

    dynamics: Dynamics
    grid: Grid
    images: Images
    rows: Successors
    box: NoiseBox
    limits: Limits
    initial: Booleans

    def refinable(self, active: Integers) -> bool:
        """True if the grid refined at rows' positions has few enough cells."""
        return _finer(self.grid, self.needed(active), self.limits) is not None

    def needed(self, active: Integers) -> Booleans:
        """Cells ``bool[C]`` at rows' positions."""
        found = np.zeros(self.grid.num_cells, bool)
        found[self.rows.cells[active]] = True
        return found

    def lower_bounds(
        self, task: TaskProduct, before: _Lower, upper: Floats, maximize: bool, clock: _Clock
    ) -> _Lower:
        """Better lower bounds of a task, by sets and by value iteration."""
        value, how, action = before.value.copy(), before.how.copy(), before.action.copy()

        def prove(rows: Successors, kind: int) -> None:
            known = (value >= 1) & (how >= kind)  # "surely" rests on sure states alone
            won, choice = winning_cells(task, rows, known, maximize)
            new = won & (value < 1)
            value[new], how[new], action[new] = 1.0, kind, choice[new]

        if not self.rows.outside.all() or task.outside.any():
            prove(self.rows, SURE)
        clock.stage("sets")
        active = self.active(task, value, upper)
        if not len(active) or not any(j >= 0 for j in self.images.noise_of):
            return _Lower(value, how, action)
        rows, bounds = self._part(active)
        prove(replace(rows, certain=bounds.certain()), ALMOST_SURE)
        clock.stage("sets")
        active = self.active(task, value, upper)
        coarse = bounds.certain_share() < CERTAIN_SHARE and self.refinable(active)
        if len(active) and not coarse:
            if len(active) < len(rows.cells):
                rows, bounds = self._part(active)
            before_sweeps = value
            sweeps = self.limits.max_sweeps
            value, action = iterate(task, bounds, rows, (value, action), sweeps, maximize)
            how[value > before_sweeps] = ITERATED
        clock.stage("value iteration")
        return _Lower(value, how, action)

    def active(self, task: TaskProduct, value: Floats, upper: Floats) -> Integers:
        """Rows' positions of cells that matter for initial states and are not decided."""
        finished = (value >= 1) | (upper <= 0)
        met = reachable(task, self.rows, self.initial, finished)
        needed = met & ~finished & (task.decided < 0)[:, None]
        return np.flatnonzero(np.logical_or.reduce(needed, axis=0)[self.rows.cells])

    def _part(self, active: Integers) -> tuple[Successors, TransitionBounds]:
        """The rows of some cells, with their transition probabilities."""
        clipped, rows, index = self.dynamics.outside == "clip", self.rows, None
        if len(active) < len(rows.cells):
            index = (active[:, None] * rows.num_actions + np.arange(rows.num_actions)).reshape(-1)
            arrays = {x: getattr(rows, x)[index] for x in ("start", "stop", "outside")}
            rows = replace(rows, cells=rows.cells[active], **arrays)
        noise = self.dynamics.noise
        return rows, transition_bounds(self.images, self.grid, noise, self.box, clipped, index)


def safe_actions(dynamics: Dynamics, control: Control, bounds: Bounds) -> Booleans:
    """Actions ``bool[Q, C, A]`` that lead only to states of lower bound 1.

    In states that are satisfied surely or with probability 1, at least the policy's action is one.
    """
    won = bounds.lower >= 1
    found = np.zeros((*won.shape, len(control.actions)), bool)
    cells = np.flatnonzero((won & (bounds.task.decided < 0)[:, None]).any(0))
    if len(cells):
        box = noise_box(dynamics)
        images = image_boxes(control.step, bounds.grid, cells, control.actions, box)
        rows = _successors(dynamics, bounds.grid, images, control, box)
        for q in np.flatnonzero(bounds.task.decided < 0):
            inside = contained(bounds.task, rows, won, int(q)).reshape(len(cells), -1)
            found[q, cells] = inside & won[q, cells, None]
    found[bounds.task.decided == 1] = True
    return found
