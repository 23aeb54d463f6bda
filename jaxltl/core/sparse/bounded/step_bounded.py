"""Step-bounded probabilities and rewards by backward induction, with bounds of their rounding."""

from __future__ import annotations

from functools import cache, partial
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.bounded import backup as iteration
from jaxltl.core.sparse.bounded.backup import (
    Iterate,
    RowBackup,
    StepReward,
    backup_on,
    relative_error,
)
from jaxltl.core.sparse.bounded.limit import unbounded_limit
from jaxltl.core.sparse.bounded.row_game import RowGame
from jaxltl.core.sparse.graph.qualitative import backward_reachable
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import row_entries, sorted_unique
from jaxltl.core.sparse.solvers.reachability import reward_forever

UNDERFLOW = 1e-300  # bounds the loss by underflow
_LARGEST = 8.0 * 2**30  # bytes of the choices of all steps
_MANY = 32  # steps from which states that cannot reach the target in time are left out


class StepBoundedValues(NamedTuple):
    """Result of backward induction."""

    value: Floats  # float64[S]
    error: Floats  # float64[S], a bound
    row: Integers  # int32[S], the first choices; int32[n, S] if all are returned
    num_steps: int  # the number of backups
    probability: Floats | None = None  # float64[T], nature's distributions in the first step


def until(
    game: RowGame, target: Booleans, stay: Booleans, num_steps: int, by_step: bool = False
) -> StepBoundedValues:
    """Probability of a target within n steps, through states where one may stay."""
    undecided = _undecided(game.mdp, target, stay, num_steps)
    return _probability(game, target, undecided, num_steps, by_step=by_step, has_limit=True)


def avoidance(
    game: RowGame, target: Booleans, stay: Booleans, num_steps: int
) -> StepBoundedValues | None:
    """Complement of the event of :func:`until`, with small relative errors; None for many steps."""
    if num_steps > iteration.LONG:
        return None
    return _probability(game, ~target, _undecided(game.mdp, target, stay, num_steps), num_steps)


def next_step(game: RowGame, target: Booleans) -> StepBoundedValues:
    """Probability that the next state is a target."""
    return _probability(game, target, np.ones_like(target), 1)


def _probability(
    game: RowGame,
    known: Booleans,
    undecided: Booleans,
    num_steps: int,
    *,
    by_step: bool = False,
    has_limit: bool = False,
) -> StepBoundedValues:
    """``x_{k+1} = opt P x_k`` in undecided states, from ``x_0 = known``, the value of all others.

    With a limit no undecided state is known, and the value grows with the number of steps.
    """
    _require_memory(game.mdp, num_steps, by_step)
    backup = backup_on(game, np.flatnonzero(undecided), known.astype(np.float64), ceiling=1.0)
    every: list[Integers] | None = [] if by_step else None
    places = backup.places
    limit = cache(partial(unbounded_limit, game, known, undecided, num_steps))

    def enough(x: Iterate) -> bool:
        low, high = limit()
        return bool((high[places] - np.maximum(low[places], x.value) <= iteration.CLOSE).all())

    start = known[places].astype(np.float64)
    iterate = backup.iterate(start, num_steps, enough if has_limit else None, every)
    value = known.astype(np.float64)
    value[places] = iterate.value
    complete = iterate.is_fixed or iterate.num_steps == num_steps
    relative = relative_error(backup.unit(num_steps), num_steps if complete else iterate.num_steps)
    size = value if game.sets is None else 1.0
    error = np.where(undecided & (num_steps > 0), np.minimum(size * relative + UNDERFLOW, 1), 0)
    if has_limit and places.size and (not complete or relative > iteration.CLOSE):
        low, high = limit()
        low = np.maximum(low, value - error)
        # Of fewer backups the value is a lower bound, as a target is reached once.
        high = np.minimum(high, value + error) if complete else high
        value = np.where(undecided, (low + high) / 2, value)
        error = np.where(undecided, np.maximum(high - low, 0) / 2 + UNDERFLOW, error)
    # The graph decides which values are exactly zero or one.
    for surely, close in ((False, value - error <= 0), (True, value + error >= 1)):
        if num_steps and (undecided & close).any():
            region = _region(game, (known, undecided), num_steps, surely)
            exact = undecided & (region if surely else ~region)
            value, error = np.where(exact, surely, value), np.where(exact, 0, error)
    return _result(backup, iterate, num_steps, (value, error), every)


def _region(
    game: RowGame, sets: tuple[Booleans, Booleans], num_steps: int, surely: bool
) -> Booleans:
    """States of a positive probability, or surely of probability one."""
    known, undecided = sets
    region = known
    for _ in range(num_steps):
        rows = game.entering(region, surely=surely)
        new = np.where(undecided, game.holds(rows, surely=surely), known)
        if (new == region).all():
            break
        region = new
    return region


def _undecided(mdp: HostMDP, target: Booleans, stay: Booleans, num_steps: int) -> Booleans:
    """States in which one may stay and, for many steps, from which n steps may reach the target."""
    undecided = stay & ~target
    if num_steps < _MANY:
        return undecided
    start, pred = mdp.predecessors
    seen = target.copy()
    frontier: Integers = np.flatnonzero(target)
    for _ in range(num_steps):
        state = mdp.state[pred[row_entries(start, frontier)[0]]]
        state = sorted_unique(state, mdp.num_states)
        frontier = state[undecided[state] & ~seen[state]]
        if not frontier.size:
            break
        seen[frontier] = True
    return undecided & seen


def total(
    game: RowGame, reward: StepReward, start: Floats, num_steps: int, by_step: bool = False
) -> StepBoundedValues:
    """Expected reward of n steps, plus a terminal reward."""
    mdp, magnitude = game.mdp, reward.magnitude
    _require_memory(mdp, num_steps, by_step)
    backup = backup_on(game, np.arange(mdp.num_states), reward=reward)
    every: list[Integers] | None = [] if by_step else None
    places, unit = backup.places, backup.unit(num_steps)
    signed = bool((start < 0).any() or (magnitude != reward.row).any())
    largest_reward, largest = float(magnitude.max(initial=0)), float(np.abs(start).max(initial=0))

    def bounds(x: Iterate) -> tuple[Floats, Floats]:
        """Bounds after all steps: ``T v - v`` is at least, and at most, what each further one adds.

        T is monotone and ``T (v + c) = T v + c`` for constants c (Puterman 1994, section 8.5).
        """
        size = x.num_steps * largest_reward + largest
        relative = relative_error(unit, 2 * x.num_steps + 1)
        step, remaining = x.value - x.before, num_steps - x.num_steps + 1
        slack = size * (relative + unit * remaining)
        low = x.before + remaining * step.min() - slack
        high = x.before + remaining * step.max() + slack
        if not largest_reward:
            slack = size * relative
            low = np.maximum(low, x.value.min() - slack)
            high = np.minimum(high, x.value.max() + slack)
        if game.sets is None and not signed and not largest and num_steps > iteration.LONG:
            most = game.mixed is not None or game.sole_direction is not False
            forever = reward_forever(mdp, reward.row, maximize=most, tolerance=iteration.CLOSE / 4)
            low = np.maximum(low, x.value * (1 - relative))
            high = np.minimum(high, forever.upper[places])
        return low, high

    def enough(x: Iterate) -> bool:
        low, high = bounds(x)
        return bool((high - low <= iteration.CLOSE * np.maximum(np.abs(low), 1)).all())

    iterate = backup.iterate(start[places], num_steps, enough, every)
    complete = iterate.is_fixed or iterate.num_steps == num_steps
    # Rounding is relative to the largest sum of absolute values.
    size: Floats | float = iterate.value
    if game.sets is not None:
        size = largest_reward + iterate.largest
    elif signed:
        size = _largest_sum(game, magnitude, np.abs(start), num_steps)[places]
    relative = relative_error(unit, 2 * num_steps + 1)
    value, off = np.zeros(mdp.num_states), np.zeros(mdp.num_states)
    value[places], off[places] = iterate.value, size * relative + UNDERFLOW
    if not complete or (
        num_steps > iteration.LONG and relative > iteration.CLOSE and every is None
    ):
        low, high = bounds(iterate)
        if complete:
            low = np.maximum(low, iterate.value - off[places])
            high = np.minimum(high, iterate.value + off[places])
        value[places], off[places] = (low + high) / 2, np.maximum(high - low, 0) / 2 + UNDERFLOW
    some = start != 0
    some[mdp.state[magnitude > 0]] = True
    # Without a reward ahead the value is exactly 0, also where the remaining steps are bounded.
    some = backward_reachable(mdp, some)
    value, off = np.where(some, value, 0), np.where(some & (num_steps > 0), off, 0)
    unclear = some & (value <= off) & (off > 0)
    if not signed and game.sets is None and num_steps <= iteration.LONG and unclear.any():
        zero = ~_earning(game, reward.row > 0, start > 0, num_steps)
        value[zero] = off[zero] = 0
    return _result(backup, iterate, num_steps, (value, off), every)


def _earning(game: RowGame, rows: Booleans, start: Booleans, num_steps: int) -> Booleans:
    """States in which the players' choices earn something in n steps or after them."""
    region = start
    for _ in range(num_steps):
        new = game.holds(rows | game.entering(region, surely=False), surely=False)
        if (new == region).all():
            break
        region = new
    return region


def _largest_sum(game: RowGame, magnitude: Floats, start: Floats, num_steps: int) -> Floats:
    """Largest expected sum of absolute values, ``float64[S]``, under any choices."""
    free = RowGame(game.mdp, np.ones(start.size, bool))
    backup = backup_on(free, np.arange(start.size), reward=StepReward(magnitude, magnitude))
    iterate = backup.iterate(start[backup.places], num_steps, lambda _: True)
    value = np.zeros(start.size)
    value[backup.places] = iterate.value
    if not iterate.is_fixed and iterate.num_steps < num_steps:
        value[:] = num_steps * magnitude.max() + start.max()
    return value


def _require_memory(mdp: HostMDP, num_steps: int, by_step: bool) -> None:
    if by_step and 8.0 * num_steps * mdp.num_states > _LARGEST:
        raise ValueError(
            f"the choices of {num_steps} steps in {mdp.num_states} states would take "
            f"{8 * num_steps * mdp.num_states / 2**30:.3g} GB; leave out by_step, or ask for "
            "fewer steps."
        )


def _result(
    backup: RowBackup,
    iterate: Iterate,
    num_steps: int,
    enclosure: tuple[Floats, Floats],
    every: list[Integers] | None,
) -> StepBoundedValues:
    """Values with their errors, and the choices of the first step, or of every step."""
    row, probability = backup.strategy(iterate.before)
    if every is not None:
        row = backup.strategies(every, num_steps)
    return StepBoundedValues(*enclosure, row, iterate.num_steps, probability)
