"""Step-bounded probabilities and rewards by backward induction, with bounds of their rounding.

Sums of nonnegative terms have small relative errors: each product and sum adds less than one unit
of rounding, so that the error of n backups is known in advance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol, TYPE_CHECKING

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.choice_order import ChoiceOrder, choices_of
from jaxltl.core.sparse.graph.qualitative import positive_under_all_policies, backward_reachable
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import concatenated_ranges, row_entries, sorted_unique
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure
from jaxltl.core.sparse.solvers.reachability import reachability, reward_forever, total_reward

if TYPE_CHECKING:
    from scipy.sparse import csr_array

UNDERFLOW = 1e-300  # bounds the loss by underflow
_HUGE = 1e150
_LARGEST = 8.0 * 2**30  # bytes of the choices of all steps
_LONG = 4096  # backups after which the effect of all further ones is bounded, then at each doubling
_CLOSE = 1e-9  # effect of all further backups, relative, at which the iteration stops
_POWER_STATES = 200  # states up to which long horizons of a chain are solved by matrix powers
_WORK = 2.0**38  # multiplications of one iteration; beyond these, the rest is bounded
_OVERHEAD = 10_000  # multiplications in the time that NumPy's calls of one backup take
_MANY = 32  # steps from which states that cannot reach the target in time are left out


class StepBoundedValues(NamedTuple):
    """Result of backward induction."""

    value: Floats  # float64[S]
    error: Floats  # float64[S], a bound
    row: Integers  # int32[S], the first choices; int32[n, S] if all are returned
    num_steps: int  # the number of backups
    probability: Floats | None = None  # float64[T], nature's distributions in the first step


def backup_unit(mdp: HostMDP) -> float:
    """The relative rounding of one backup, including that of row sums."""
    width = int(np.diff(mdp.entry_start).max(initial=1))
    return (2 * width + 6) * float(np.finfo(np.float64).eps)


def relative_error(unit: float, num_steps: int) -> float:
    """The relative error of n backups of nonnegative values; huge if there are too many."""
    total = unit * num_steps
    return total / (1 - total) if total < 0.5 else _HUGE


class RowBackup(NamedTuple):
    """``x -> opt (cost + P x)`` over the choices of N states, with zero on all other states."""

    matrix: csr_array  # SciPy's float64[R', N]
    taken: csr_array  # the same with the columns of all states, float64[R', S]
    choices: ChoiceOrder  # the order of the states and of their choices
    row: Integers  # int[R'], the model's rows, in that order
    places: Integers  # int[N], the states
    operation: np.ufunc  # np.maximum or np.minimum

    @property
    def small_chain(self) -> bool:
        """True if matrix powers are cheaper than many backups."""
        return self.choices.is_chain and self.places.size <= _POWER_STATES

    def best(self, quantity: Floats) -> Floats:
        """The optimum over each state's choices, ``float64[N]``."""
        return self.choices.best(quantity, self.operation)

    def first(self, quantity: Floats, best: Floats) -> Integers:
        """The model's row of each state's first best choice, ``int32[N]``."""
        return self.row[self.choices.first(quantity, best)].astype(np.int32)

    def iterate(
        self,
        cost: Floats,
        value: Floats,
        num_steps: int,
        enough: Callable[[Iterate], bool],
        every: list[Integers] | None = None,
    ) -> Iterate:
        """Backups from a start: all of them, or up to a fixed point or a bounded remainder."""
        max_backups = _LONG if self.small_chain else int(_WORK / (self.matrix.nnz + _OVERHEAD))
        last, done, check = (
            num_steps if every is not None else min(num_steps, max_backups),
            0,
            _LONG,
        )
        before = value
        while done < last:
            done += 1
            image = self.matrix @ value
            image += cost
            before, value = value, self.best(image)
            if every is not None:
                every.append(self.first(image, value))
            if np.array_equal(before, value):
                return Iterate(before, value, done, True)
            if done == check and every is None and done < num_steps:
                check *= 2
                if enough(Iterate(before, value, done, False)):
                    return Iterate(before, value, done, False)
        if done < num_steps and self.small_chain:
            matrix: Floats = self.matrix.toarray()
            value = _power(matrix, cost, value, num_steps - done)
            return Iterate(before, value, num_steps, False)
        return Iterate(before, value, done, False)

    def greedy(self, cost: Floats, value: Floats) -> Integers:
        """The model's row of each state's best choice before a value: ``int32[N]``."""
        image = self.matrix @ value
        image += cost
        return self.first(image, self.best(image))


@dataclass(frozen=True)
class Iterate:
    """Last two values ``float64[N]``, and number of backups; `is_fixed` if more change nothing."""

    before: Floats
    value: Floats
    num_steps: int
    is_fixed: bool


def _power(matrix: Floats, cost: Floats, value: Floats, num_steps: int) -> Floats:
    """``x -> cost + P x`` applied n times, by repeated squaring of that affine map.

    The relative error e of a power at most doubles with its exponent, ``e_2m <= 2 e_m + unit``, so
    that it is at most that of n backups with rows of N entries.
    """
    matrix, cost = matrix.copy(), cost.copy()
    while num_steps:
        if num_steps % 2:
            value = cost + matrix @ value
        num_steps //= 2
        if num_steps:
            cost = cost + matrix @ cost
            matrix = matrix @ matrix
    return value


def backup_on(mdp: HostMDP, places: Integers, operation: np.ufunc) -> RowBackup:
    """The :class:`RowBackup` of some states, ascending."""
    count = np.diff(mdp.row_start)[places]
    choices = choices_of(count)
    row = concatenated_ranges(mdp.row_start[places], count)[choices.order]
    whole = places.size == mdp.num_states and choices.is_chain
    taken = mdp.matrix if whole else mdp.matrix[row]
    places = places[choices.states]
    matrix = taken if whole else taken[:, places]
    return RowBackup(matrix, taken, choices, row, places, operation)


def _policy(mdp: HostMDP, backup: RowBackup, row: Integers) -> Integers:
    """The choices of some states, and the first rows of the others: ``int32[S]``."""
    policy = mdp.row_start[:-1].astype(np.int32)
    policy[backup.places] = row
    return policy


def _policies(mdp: HostMDP, backup: RowBackup, every: list[Integers], num_steps: int) -> Integers:
    """The choices of all steps, the first step first: ``int32[n, S]``; constant after a fixed point."""
    policies = np.tile(mdp.row_start[:-1].astype(np.int32), (num_steps, 1))
    for i in range(num_steps):
        policies[num_steps - 1 - i, backup.places] = every[min(i, len(every) - 1)]
    return policies


def until(
    mdp: HostMDP,
    target: Booleans,
    stay: Booleans,
    num_steps: int,
    operation: np.ufunc,
    by_step: bool = False,
) -> StepBoundedValues:
    """Optimal probability of a target within n steps, through states where one may stay."""
    _require_memory(mdp, num_steps, by_step)
    open_ = stay & ~target
    if num_steps >= _MANY:
        open_ &= _near(mdp, target, open_, num_steps)
    backup = backup_on(mdp, np.flatnonzero(open_), operation)
    cost = backup.taken @ target.astype(np.float64)
    maximize = operation is np.maximum
    every: list[Integers] | None = [] if by_step else None
    places, limit = backup.places, UnboundedLimit(mdp, target, open_, num_steps, maximize)

    def enough(x: Iterate) -> bool:
        low = np.maximum(limit.lower[places], x.value)
        return bool((limit.upper[places] - low <= _CLOSE).all())

    iterate = backup.iterate(cost, np.zeros(places.size), num_steps, enough, every)
    value = target.astype(np.float64)
    value[places] = iterate.value
    complete = iterate.is_fixed or iterate.num_steps == num_steps
    relative = relative_error(
        _unit(mdp, backup, num_steps), num_steps if complete else iterate.num_steps
    )
    error = np.where(open_ & (num_steps > 0), np.minimum(value * relative + UNDERFLOW, 1), 0)
    if places.size and (not complete or relative > _CLOSE):
        value, error = narrowed(limit, value, error, open_, complete)
    # The graph decides which values are exactly zero or one.
    leads, choose = mdp.support.some_successor_in, np.logical_or if maximize else np.logical_and
    sets = target, open_
    if num_steps and (open_ & (value - error <= 0)).any():
        zero = open_ & ~reached_within(mdp, sets, num_steps, choose, leads)
        value[zero] = error[zero] = 0
    if num_steps and (open_ & (value + error >= 1)).any():
        one = open_ & reached_within(mdp, sets, num_steps, choose, lambda x: ~leads(~x))
        value[one], error[one] = 1, 0
    if every is not None:
        return StepBoundedValues(
            value, error, _policies(mdp, backup, every, num_steps), iterate.num_steps
        )
    row = backup.greedy(cost, iterate.before)
    return StepBoundedValues(value, error, _policy(mdp, backup, row), iterate.num_steps)


def avoidance(
    mdp: HostMDP, target: Booleans, stay: Booleans, num_steps: int, operation: np.ufunc
) -> StepBoundedValues | None:
    """Optimal complement of :func:`until`, with small relative errors; None for many steps."""
    if num_steps > _LONG:
        return None
    open_ = stay & ~target
    if num_steps >= _MANY:
        open_ &= _near(mdp, target, open_, num_steps)
    backup = backup_on(mdp, np.flatnonzero(open_), operation)
    places, value = backup.places, (~target).astype(np.float64)
    cost = backup.taken @ np.where(open_, 0, value)
    iterate = backup.iterate(cost, np.ones(places.size), num_steps, lambda _: False)
    if not (iterate.is_fixed or iterate.num_steps == num_steps):
        return None
    value[places] = iterate.value
    relative = relative_error(backup_unit(mdp), num_steps)
    error = np.where(open_ & (num_steps > 0), np.minimum(value * relative + UNDERFLOW, 1), 0)
    # The graph decides which values are exactly zero or one.
    leads = mdp.support.some_successor_in
    choose = np.logical_and if operation is np.maximum else np.logical_or
    if num_steps and open_.any():
        sets = target, open_
        one = open_ & ~reached_within(mdp, sets, num_steps, choose, leads)
        zero = open_ & reached_within(mdp, sets, num_steps, choose, lambda x: ~leads(~x))
        value, error = np.where(one, 1, np.where(zero, 0, value)), np.where(one | zero, 0, error)
    row = backup.greedy(cost, iterate.before)
    return StepBoundedValues(value, error, _policy(mdp, backup, row), iterate.num_steps)


class LimitBounds(Protocol):
    """Bounds ``float64[S]`` of a step-bounded probability that hold for many steps."""

    @property
    def lower(self) -> Floats: ...

    @property
    def upper(self) -> Floats: ...


@dataclass(frozen=True)
class UnboundedLimit:
    """Bounds of a step-bounded probability by the unbounded one, for many steps n.

    With T a bound on the expected time until the target or a state of value zero is met, from every
    state, a run has met neither after 2 T steps with probability at most 1/2 (Markov's inequality),
    and after n steps with at most ``2 ** -floor(n / ceil(2 T))``. The bounded probability is at
    most the unbounded one, and lower by no more than that: of a maximum for T of an optimal policy,
    of a minimum for T of every policy.
    """

    mdp: HostMDP
    target: Booleans
    undecided: Booleans
    num_steps: int
    maximize: bool
    depth: int = 0  # roundings behind each number of the model

    @cached_property
    def unbounded(self) -> Enclosure:
        """The unbounded probability."""
        return reachability(
            self.mdp,
            self.target,
            maximize=self.maximize,
            stay=self.undecided | self.target,
            tolerance=_CLOSE / 4,
            depth=self.depth,
        )

    @property
    def upper(self) -> Floats:
        return self.unbounded.upper

    @cached_property
    def lower(self) -> Floats:
        mdp = self.mdp
        if self.maximize and not mdp.is_chain:
            mdp = mdp.chain(self.unbounded.row)
        ended = ~self.undecided | ~positive_under_all_policies(
            mdp, self.target, among=self.undecided
        )
        one = np.ones(mdp.num_rows)
        time = total_reward(mdp, one, ended, maximize=True, tolerance=0.1, depth=self.depth)
        return self.unbounded.lower - unfinished(time.upper, self.num_steps)


def unfinished(time: Floats, num_steps: int) -> float:
    """Bound of the probability that a run lasts n steps, from bounds of its expected time."""
    twice = max(2 * float(time.max()), 1)
    halvings = num_steps // math.ceil(twice) if twice < num_steps else 0
    return 2.0 ** -min(halvings, 1000)


def narrowed(
    limit: LimitBounds, value: Floats, error: Floats, open_: Booleans, complete: bool
) -> tuple[Floats, Floats]:
    """Values of open states within their limit; of incomplete backups they are a lower bound."""
    low, high = np.maximum(limit.lower, value - error), limit.upper
    high = np.minimum(high, value + error) if complete else high
    return (
        np.where(open_, (low + high) / 2, value),
        np.where(open_, np.maximum(high - low, 0) / 2 + UNDERFLOW, error),
    )


def _unit(mdp: HostMDP, backup: RowBackup, num_steps: int) -> float:
    """The relative rounding of a backup, also where powers of the matrix fill its rows."""
    if backup.small_chain and num_steps > _LONG:
        return max(backup_unit(mdp), (2 * backup.places.size + 6) * float(np.finfo(float).eps))
    return backup_unit(mdp)


def _require_memory(mdp: HostMDP, num_steps: int, by_step: bool) -> None:
    if by_step and 8.0 * num_steps * mdp.num_states > _LARGEST:
        raise ValueError(
            f"the choices of {num_steps} steps in {mdp.num_states} states would take "
            f"{8 * num_steps * mdp.num_states / 2**30:.3g} GB; leave out by_step, or ask for "
            "fewer steps."
        )


def _near(mdp: HostMDP, target: Booleans, open_: Booleans, num_steps: int) -> Booleans:
    """The states from which a target is reachable in n steps."""
    start, pred = mdp.predecessors
    seen = target.copy()
    frontier: Integers = np.flatnonzero(target)
    for _ in range(num_steps):
        state = mdp.state[pred[row_entries(start, frontier)[0]]]
        state = sorted_unique(state, mdp.num_states)
        frontier = state[open_[state] & ~seen[state]]
        if not frontier.size:
            break
        seen[frontier] = True
    return seen


def reached_within(
    mdp: HostMDP,
    sets: tuple[Booleans, Booleans],
    num_steps: int,
    choose: np.ufunc,
    entering: Callable[[Booleans], Booleans],
) -> Booleans:
    """States that reach a target through open ones in n steps; `entering` gives the rows."""
    target, open_ = sets
    region = target
    for _ in range(num_steps):
        new = target | (open_ & mdp.over_choices(choose, entering(region)))
        if (new == region).all():
            break
        region = new
    return region


def total(
    mdp: HostMDP,
    rewards: tuple[Floats, Floats, Floats],
    num_steps: int,
    operation: np.ufunc,
    by_step: bool = False,
) -> StepBoundedValues:
    """Optimal expected reward of n steps; `rewards` are of rows, their magnitudes, and terminal."""
    reward, magnitude, start = rewards
    _require_memory(mdp, num_steps, by_step)
    backup = backup_on(mdp, np.arange(mdp.num_states), operation)
    every: list[Integers] | None = [] if by_step else None
    places, cost, unit = backup.places, reward[backup.row], _unit(mdp, backup, num_steps)
    signed = bool((start < 0).any() or (magnitude != reward).any())
    largest_reward, largest = float(magnitude.max(initial=0)), float(np.abs(start).max(initial=0))

    def rest(x: Iterate) -> tuple[Floats, Floats]:
        """Bounds after all steps: ``T v - v`` is at least, and at most, what each further one adds.

        T is monotone and ``T (v + c) = T v + c`` for constants c (Puterman 1994, section 8.5).
        """
        size = x.num_steps * largest_reward + largest
        step = x.value - x.before
        remaining = num_steps - x.num_steps + 1
        slack = size * (relative_error(unit, 2 * x.num_steps + 1) + unit * remaining)
        low = x.before + remaining * step.min() - slack
        high = x.before + remaining * step.max() + slack
        if not largest_reward:
            slack = size * relative_error(unit, 2 * x.num_steps + 1)
            low, high = (
                np.maximum(low, x.value.min() - slack),
                np.minimum(high, x.value.max() + slack),
            )
        if not signed and not largest and num_steps > _LONG:
            forever = reward_forever(
                mdp, reward, maximize=operation is np.maximum, tolerance=_CLOSE / 4
            )
            low = np.maximum(low, x.value * (1 - relative_error(unit, 2 * x.num_steps + 1)))
            high = np.minimum(high, forever.upper[places])
        return low, high

    def enough(x: Iterate) -> bool:
        low, high = rest(x)
        return bool((high - low <= _CLOSE * np.maximum(np.abs(low), 1)).all())

    iterate = backup.iterate(cost, start[places], num_steps, enough, every)
    complete = iterate.is_fixed or iterate.num_steps == num_steps
    size: Floats = iterate.value
    if signed:
        # Rounding is relative to the largest sum of absolute values.
        size = _largest_sum(mdp, magnitude, np.abs(start), num_steps)[places]
    relative = relative_error(unit, 2 * num_steps + 1)
    error = size * relative + UNDERFLOW
    value, off = np.zeros(mdp.num_states), np.zeros(mdp.num_states)
    value[places], off[places] = iterate.value, error
    if not complete or (num_steps > _LONG and relative > _CLOSE and every is None):
        low, high = rest(iterate)
        if complete:
            low, high = (
                np.maximum(low, iterate.value - error),
                np.minimum(high, iterate.value + error),
            )
        value[places], off[places] = (low + high) / 2, np.maximum(high - low, 0) / 2 + UNDERFLOW
    some = start != 0
    some[mdp.state[magnitude > 0]] = True
    # Without a reward ahead the value is exactly 0, also where the remaining steps are bounded.
    some = backward_reachable(mdp, some)
    value, off = np.where(some, value, 0), np.where(some & (num_steps > 0), off, 0)
    if not signed and num_steps <= _LONG and (some & (value <= off) & (off > 0)).any():
        zero = ~_earning(mdp, reward > 0, start > 0, num_steps, operation is np.maximum)
        value[zero] = off[zero] = 0
    if every is not None:
        return StepBoundedValues(
            value, off, _policies(mdp, backup, every, num_steps), iterate.num_steps
        )
    row = backup.greedy(cost, iterate.before)
    return StepBoundedValues(value, off, _policy(mdp, backup, row), iterate.num_steps)


def _earning(
    mdp: HostMDP, rows: Booleans, start: Booleans, num_steps: int, maximize: bool
) -> Booleans:
    """States in which some (all) policies earn something in n steps or after them."""
    region, choose = start, np.logical_or if maximize else np.logical_and
    for _ in range(num_steps):
        new = mdp.over_choices(choose, rows | mdp.support.some_successor_in(region))
        if (new == region).all():
            break
        region = new
    return region


def _largest_sum(mdp: HostMDP, magnitude: Floats, start: Floats, num_steps: int) -> Floats:
    """Largest expected sum of absolute values, ``float64[S]``."""
    backup = backup_on(mdp, np.arange(mdp.num_states), np.maximum)
    places = backup.places
    iterate = backup.iterate(magnitude[backup.row], start[places], num_steps, lambda _: True)
    value = np.zeros(mdp.num_states)
    value[places] = iterate.value
    if not iterate.is_fixed and iterate.num_steps < num_steps:
        value[:] = num_steps * magnitude.max() + start.max()
    return value
