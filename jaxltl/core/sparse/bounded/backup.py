"""Backups ``x -> opt (c + P x)`` of some states of a :class:`RowGame`, iterated with bounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Floats, Integers, SparseMatrix
from jaxltl.core.sparse.bounded.row_game import RowGame
from jaxltl.core.sparse.choice_order import ChoiceOrder, choices_of
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.rows import concatenated_ranges, positions, row_entries

HUGE = 1e150
LONG = 4096  # backups after which the effect of all further ones is bounded, then at each doubling
CLOSE = 1e-9  # effect of all further backups, relative, at which the iteration stops
_POWER_STATES = 200  # states up to which long horizons of a chain are solved by matrix powers
_WORK = 2.0**38  # multiplications of one iteration; beyond these, the rest is bounded
_OVERHEAD = 10_000  # multiplications in the time that NumPy's calls of one backup take
_SORTED = 16  # multiplications in the time that nature takes for an entry
_EPS = float(np.finfo(np.float64).eps)


def relative_error(unit: float, num_steps: int) -> float:
    """The relative error of n backups of nonnegative values; huge if there are too many."""
    total = unit * num_steps
    return total / (1 - total) if total < 0.5 else HUGE


class StepReward(NamedTuple):
    """Reward of a step: expected in each row, its absolute values, and those of entries."""

    row: Floats  # float64[R]
    magnitude: Floats  # float64[R]; of uncertainty sets the largest absolute value of an entry
    entry: Floats | None = None  # float64[T], of uncertainty sets


@dataclass(frozen=True)
class Iterate:
    """Last two values ``float64[N]``, and number of backups; `is_fixed` if more change nothing."""

    before: Floats
    value: Floats
    num_steps: int
    is_fixed: bool
    largest: float  # the largest absolute value that was met


class _PointRows(NamedTuple):
    """Rows of one distribution each."""

    matrix: SparseMatrix  # float64[R', N]
    cost: Floats  # float64[R'], reward of a step and known values of successors
    effort: int

    def image(self, value: Floats) -> Floats:
        image: Floats = self.matrix @ value
        image += self.cost
        return image


class _SetRows(NamedTuple):
    """Rows of uncertainty sets."""

    sets: UncertainMDP  # the rows of the backup
    entry: Integers  # int[T'], the original entries
    earned: Floats  # float64[T'], reward of a step and known values of successors
    place: Integers  # int[T'], the number of a successor among the N states, or N
    nature_maximizes: bool
    effort: int

    def ahead(self, value: Floats) -> Floats:
        ahead: Floats = self.earned + np.append(value, 0.0)[self.place]
        return ahead

    def distributions(self, ahead: Floats) -> Floats:
        return self.sets.extreme_distributions(ahead, maximize=self.nature_maximizes)

    def image(self, value: Floats) -> Floats:
        ahead = self.ahead(value)
        image: Floats = self.sets.sum_rows(self.distributions(ahead) * ahead)
        return image


@dataclass(frozen=True)
class RowBackup:
    """``x -> opt (cost + P x)`` over the choices of N states; values of all others are known."""

    game: RowGame
    places: Integers  # int[N], the states
    choices: ChoiceOrder  # the order of the states and of their choices
    row: Integers  # int[R'], the model's rows, in that order
    rows: _PointRows | _SetRows = field(repr=False)
    ceiling: float = np.inf  # bound of all values

    @property
    def has_powers(self) -> bool:
        """True if matrix powers are cheaper than many backups."""
        is_small = self.choices.is_chain and self.places.size <= _POWER_STATES
        return is_small and isinstance(self.rows, _PointRows)

    def unit(self, num_steps: int) -> float:
        """The relative rounding of a backup, also where powers of the matrix fill its rows."""
        if self.has_powers and num_steps > LONG:
            return max(self.game.unit, (2 * self.places.size + 6) * _EPS)
        return self.game.unit

    @cached_property
    def _sign(self) -> Floats | None:
        """1 for states that maximise, and else -1, ``float64[N]``; None if all states agree."""
        if self.game.sole_direction is not None:
            return None
        return np.where(self.game.maximizes[self.places], 1.0, -1.0)

    def _optimum(self, image: Floats) -> tuple[Floats, Floats]:
        """Values of rows with the owner's sign, and the optimum of each state."""
        choices, sign = self.choices, self._sign
        if sign is None:
            operation = np.maximum if self.game.sole_direction else np.minimum
            return image, choices.best(image, operation)
        image = sign[choices.owner] * image
        return image, choices.best(image, np.maximum)

    def best(self, image: Floats) -> Floats:
        """The value of each state's choice, ``float64[N]``, from those of the rows."""
        best, sign, mixed = self._optimum(image)[1], self._sign, self.game.mixed
        best = best if sign is None else sign * best
        if mixed is not None and self.game.weight is not None:
            taken = self.game.weight[self.row] * image
            mean = np.bincount(self.choices.owner, taken, self.places.size)
            best = np.where(mixed[self.places], mean, best)
        return np.minimum(best, self.ceiling) if self.ceiling < np.inf else best

    def first(self, image: Floats) -> Integers:
        """The model's row of each state's first best choice, ``int32[N]``."""
        return self.row[self.choices.first(*self._optimum(image))].astype(np.int32)

    def iterate(
        self,
        value: Floats,
        num_steps: int,
        enough: Callable[[Iterate], bool] | None,
        every: list[Integers] | None = None,
    ) -> Iterate:
        """Backups from a start: all of them, or up to a fixed point or a bounded remainder.

        Without `enough`, or with a list of `every` choice, there are as many as needed.
        """
        last, done, check, rows = num_steps, 0, LONG, self.rows
        if every is None and enough is not None:
            most = LONG if self.has_powers else max(int(_WORK / (rows.effort + _OVERHEAD)), 1)
            last = min(num_steps, most)
        before, sizes = value, isinstance(rows, _SetRows)
        largest = float(np.abs(value).max(initial=0)) if sizes else 0.0
        while done < last:
            done += 1
            image = rows.image(value)
            before, value = value, self.best(image)
            if sizes:
                largest = max(largest, float(np.abs(value).max(initial=0)))
            if every is not None:
                every.append(self.first(image))
            if np.array_equal(before, value):
                return Iterate(before, value, done, True, largest)
            if done == check and every is None and enough is not None and done < num_steps:
                check *= 2
                if enough(Iterate(before, value, done, False, largest)):
                    return Iterate(before, value, done, False, largest)
        if done < num_steps and self.has_powers and isinstance(rows, _PointRows):
            matrix: Floats = rows.matrix.toarray()
            value, done = _power(matrix, rows.cost, value, num_steps - done), num_steps
        return Iterate(before, value, done, False, largest)

    def strategy(self, before: Floats) -> tuple[Integers, Floats | None]:
        """The first step's rows ``int[S]`` and nature's distributions ``float64[T]``, before values."""
        mdp, rows = self.game.mdp, self.rows
        policy = mdp.row_start[:-1].astype(np.int32)
        policy[self.places] = self.first(rows.image(before))
        if isinstance(rows, _PointRows):
            return policy, None
        probability = mdp.probability.copy()
        probability[rows.entry] = rows.distributions(rows.ahead(before))
        return policy, probability

    def strategies(self, every: list[Integers], num_steps: int) -> Integers:
        """The rows of all steps, the first step first: ``int32[n, S]``; constant after a fixed point."""
        policies = np.tile(self.game.mdp.row_start[:-1].astype(np.int32), (num_steps, 1))
        for i in range(num_steps):
            policies[num_steps - 1 - i, self.places] = every[min(i, len(every) - 1)]
        return policies


def backup_on(
    game: RowGame,
    places: Integers,
    known: Floats | None = None,
    reward: StepReward | None = None,
    ceiling: float = np.inf,
) -> RowBackup:
    """The :class:`RowBackup` of some states, ascending, with the values of all others."""
    mdp = game.mdp
    count = np.diff(mdp.row_start)[places]
    choices = choices_of(count)
    row = concatenated_ranges(mdp.row_start[places], count)[choices.order]
    whole = places.size == mdp.num_states and choices.is_chain
    places = places[choices.states]
    outside: Floats = np.zeros(mdp.num_states) if known is None else known.copy()
    outside[places] = 0
    rows: _PointRows | _SetRows
    if game.sets is None:
        taken = mdp.matrix if whole else mdp.matrix[row]
        matrix = taken if whole else taken[:, places]
        cost = taken @ outside if reward is None else reward.row[row] + taken @ outside
        rows = _PointRows(matrix, cost, matrix.nnz)
    else:
        sets, _ = game.sets.select_rows(np.arange(row.size + 1), row)
        entry = row_entries(mdp.entry_start, row)[0]
        place = positions(places, mdp.num_states)[mdp.successor[entry]]
        earned = outside[mdp.successor[entry]]
        if reward is not None and reward.entry is not None:
            earned += reward.entry[entry]
        place = np.where(place < 0, places.size, place)
        effort = _SORTED * (entry.size + _OVERHEAD)
        rows = _SetRows(sets, entry, earned, place, game.nature_maximizes, effort)
    return RowBackup(game, places, choices, row, rows, ceiling)


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
