"""Certified expected rewards of games that count only if a target is reached."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import offsets_from_counts
from jaxltl.core.sparse.solvers.game_reward import game_reward_forever, optimal_answer
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure

_FIRST_LEVELS = 16  # of collected reward, doubled until the bounds are narrow
_MAX_LEVELS = 512
_MAX_VALUES = 4_000_000  # of all levels together
_TINY = 1e-13  # relative tolerance of a level, as errors of levels add up
_MARGIN = 1e-6  # relative, of bounds for the rationals behind the doubles of a model
_EPS = float(np.finfo(np.float64).eps)


def reward_if_reached(
    mdp: HostMDP,
    units: Integers,
    target: Booleans,
    maximizing: Booleans,
    *,
    tolerance: float = 1e-6,
) -> Enclosure:
    """Value of the reward until a target, worth 0 in runs that never reach it.

    ``V(s, z) = opt_r sum_t p_t V(t, z + u_t)`` is the value once z units are collected, ``z`` in the
    target; the least solution, at ``z = 0`` (semantics F0 of Chen, Forejt, Kwiatkowska, Parker and
    Simaitis 2013). It is infinite where reward can be collected for ever with positive probability
    in states from which the target can be enforced with positive probability. From a number of
    units Z on, ``z p(s)`` is a lower bound, p the value of reachability, and an upper bound is the
    value of the game in which runs that miss the target keep their rewards; below Z the equation
    is solved level by level, from the largest one on. Z is doubled until the bounds are narrow.

    Args:
      units: ``int[T]``, the reward of each transition, at least 0.
      maximizing: ``bool[S]``, the states of the maximiser.

    Returns:
      The enclosure in units; the policy is that of no collected reward.
    """
    problem = _Problem.make(mdp, units, target, maximizing)
    levels, most = max(_FIRST_LEVELS, 2 * int(units.max(initial=0))), _MAX_LEVELS
    most = min(most, _MAX_VALUES // mdp.num_states)
    low, high, rounds = np.zeros(mdp.num_states), np.full(mdp.num_states, np.inf), 0
    while True:
        below, above, row = problem.by_levels(levels)
        low, high = np.maximum(low, below), np.minimum(high, above)
        rounds += levels
        with np.errstate(invalid="ignore"):
            narrow = (low == high) | (high - low <= tolerance * low)
        if narrow.all() or 2 * levels > most:
            break
        levels *= 2
    value = np.where(np.isfinite(high), (low + high) / 2, low)
    return Enclosure(value, low, high, row, rounds, 0.0, "levels of collected reward")


class LevelEnds(NamedTuple):
    """Bounds of the values of states in which a number of units is collected.

    With z units, at least `num_units`, they are ``z reach(s)`` and ``kept(s) + z - num_units``, or 0
    where `kept` is. They hold for all probabilities that round to those of the model.
    """

    num_units: int
    open_: Booleans  # bool[S], the states neither in the target nor of value 0 or infinity
    rows: Booleans  # bool[R], the rows that do not lead to states of infinite value
    infinite: Booleans  # bool[S]
    reach: Floats  # float64[S]
    kept: Floats  # float64[S]


def level_ends(
    mdp: HostMDP, units: Integers, target: Booleans, maximizing: Booleans, count: int
) -> LevelEnds | None:
    """Bounds once `count` units are collected; None if some are infinite or not decided."""
    problem = _Problem.make(mdp, units, target, maximizing)
    kept = problem.kept(count).upper
    if not problem.is_decided or not np.isfinite(kept).all():
        return None
    rows = np.zeros(mdp.num_rows, bool)
    rows[problem.origin[problem.origin >= 0]] = True
    low, high = problem.lower_reach * (1 - _MARGIN), kept * (1 + _MARGIN)
    return LevelEnds(count, problem.open_, rows, problem.infinite, low, high)


@dataclass(frozen=True)
class _Problem:
    """The transitions within one level of collected reward, and those that leave it."""

    level: HostMDP  # the states and a last one for all that leaves the level
    origin: Integers  # int[R'], original rows, -1 in the last state
    maximizing: Booleans  # bool[S + 1]
    open_: Booleans  # bool[S], states that are neither in the target nor of value 0 or infinity
    infinite: Booleans  # bool[S]
    is_decided: bool  # whether the graph decides where the target can be enforced
    row: Integers  # of leaving entries: the row of the level,
    successor: Integers
    probability: Floats
    units: Integers
    arrives: Booleans  # whether the successor is in the target
    lower_reach: Floats  # float64[S], bounds of the value of reachability
    mean_units: Floats  # float64[R'], expected units of a row
    arriving: Floats  # float64[R'], probability of entering the target
    whole: HostMDP  # the rows of `level` with all their transitions; other states are absorbing

    @staticmethod
    def make(mdp: HostMDP, units: Integers, target: Booleans, up: Booleans) -> _Problem:
        """Decides states of probability 0 and of infinite value, and splits the transitions."""
        rows, entry_row = np.arange(mdp.num_rows), mdp.row
        chance = mdp.probability
        entering = _sums(entry_row, chance * target[mdp.successor], mdp.num_rows)
        open_ = ~target
        whole, origin, _ = _part(mdp, open_, rows >= 0)
        reach = game_reward_forever(whole, _of(entering, origin, open_, mdp), up, tolerance=1e-9)
        open_ = open_ & (reach.upper > 0)
        mean = _sums(entry_row, chance * units, mdp.num_rows)
        whole, origin, _ = _part(mdp, open_, rows >= 0)
        total = game_reward_forever(whole, _of(mean, origin, open_, mdp), up, tolerance=1e-3)
        infinite = open_ & np.isinf(total.lower)
        while True:  # rows of the maximiser, or all of the minimiser, that lead there
            leads = np.logical_or.reduceat(infinite[mdp.successor], mdp.entry_start[:-1])
            some = mdp.over_choices(np.logical_or, leads)
            every = mdp.over_choices(np.logical_and, leads)
            more = infinite | (open_ & np.where(up, some, every))
            if (more == infinite).all():
                break
            infinite = more
        open_ &= ~infinite
        whole, origin, _ = _part(mdp, open_, ~leads)
        level, _, left = _part(mdp, open_, ~leads, leaving=(units > 0) | ~open_[mdp.successor])
        entry, row = left
        return _Problem(
            level=level,
            origin=origin,
            maximizing=np.append(up, False),
            open_=open_,
            infinite=infinite,
            is_decided=bool(((reach.lower > 0) | (reach.upper <= 0)).all()),
            row=row,
            successor=mdp.successor[entry],
            probability=mdp.probability[entry],
            units=units[entry],
            arrives=target[mdp.successor[entry]],
            lower_reach=np.where(open_, reach.lower, 0),
            mean_units=_of(mean, origin, open_, mdp),
            arriving=_of(entering, origin, open_, mdp),
            whole=whole,
        )

    def by_levels(self, count: int) -> tuple[Floats, Floats, Integers]:
        """Lower and upper bounds at no collected reward, and rows, from bounds at `count` units."""
        size, step = self.infinite.size, int(self.units.max(initial=0))
        above = np.arange(count, count + step)[:, None]
        low, high = np.zeros((count + step, size)), np.zeros((count + step, size))
        low[count:] = above * self.lower_reach * (1 - 4 * _EPS)
        kept = self.kept(count)
        most = np.where(np.isfinite(kept.upper), kept.upper, 0)  # infinite ends are used below
        high[count:] = np.where(most > 0, most + (above - count), 0)
        rounding, row = (8 + np.diff(self.whole.entry_start).max()) * _EPS, self.origin[:0]
        has_inner = bool(
            (self.level.successor[~self.level.is_self_loop[self.level.row]] < size).any()
        )
        for z in reversed(range(count)):
            less = self.leaving(z, low) * (1 - rounding)
            more = self.leaving(z, high) * (1 + rounding)
            if not has_inner:  # each row leaves the level, or its state for ever
                (low[z], row), (high[z], _) = self.one_step(less), self.one_step(more)
                continue
            below = game_reward_forever(self.level, less, self.maximizing, tolerance=_TINY)
            answer = optimal_answer(
                self.level, more, ~self.maximizing, below.row, maximize=True, tolerance=_TINY
            )
            low[z], high[z], row = below.lower[:-1], answer.upper[:-1], below.row[:-1]
        bounded = self.is_decided and bool(np.isfinite(kept.upper).all())
        lower = np.where(self.infinite, np.inf, low[0]) if self.is_decided else 0 * low[0]
        upper = np.where(self.infinite | (not bounded), np.inf, high[0])
        return lower, np.maximum(lower, upper), self.origin[row]

    def kept(self, count: int) -> Enclosure:
        """Values of the game in which runs that miss the target keep their rewards."""
        reward = self.mean_units + count * self.arriving
        return game_reward_forever(self.whole, reward, self.maximizing[:-1], tolerance=_TINY)

    def one_step(self, reward: Floats) -> tuple[Floats, Integers]:
        """Optimal rewards of rows in each state, and the rows."""
        signed = np.where(self.maximizing[self.level.state], reward, -reward)
        best = self.level.over_choices(np.maximum, signed)
        row = self.level.first_choice(signed == best[self.level.state])[1]
        return np.abs(best[:-1]), row[:-1]

    def leaving(self, z: int, value: Floats) -> Floats:
        """Expected values after the transitions that leave level z, ``float64[R']``."""
        ahead = np.where(self.arrives, z + self.units, value[z + self.units, self.successor])
        # Transitions without reward leave for states of value 0 or for the target.
        return _sums(self.row, self.probability * ahead, self.level.num_rows)


def _sums(row: Integers, quantity: Floats, num_rows: int) -> Floats:
    return np.bincount(row, quantity, num_rows).astype(np.float64)


def _of(quantity: Floats, origin: Integers, open_: Booleans, mdp: HostMDP) -> Floats:
    """A quantity of the original rows, 0 in absorbing states."""
    known = origin >= 0
    row = np.where(known, origin, 0)
    return np.where(known & open_[mdp.state[row]], quantity[row], 0)


def _part(
    mdp: HostMDP, open_: Booleans, rows: Booleans, leaving: Booleans | None = None
) -> tuple[HostMDP, Integers, tuple[Integers, Integers]]:
    """The rows of open states, other states being absorbing, and their original rows.

    Entries `leaving` ``bool[T]`` lead to one more state; those entries and their rows come last.
    """
    size = mdp.num_states
    index = np.flatnonzero(rows & open_[mdp.state])
    alone = np.flatnonzero(~open_)
    state = np.concatenate([mdp.state[index], alone])
    order = np.argsort(state, kind="stable")
    origin = np.concatenate([index, mdp.row_start[alone]])[order]
    number = np.full(mdp.num_rows, -1)
    inner = open_[state[order]]
    number[origin[inner]] = np.flatnonzero(inner)
    entry = np.flatnonzero(number[mdp.row] >= 0)
    row, after = number[mdp.row[entry]], mdp.successor[entry]
    chance = mdp.probability[entry]
    out = np.zeros(entry.size, bool) if leaving is None else leaving[entry]
    exit_mass = np.bincount(row[out], chance[out], origin.size)
    exits = np.flatnonzero(exit_mass)
    loops = np.flatnonzero(~inner)
    parts = [
        (row[~out], after[~out], chance[~out]),
        (exits, np.full(exits.size, size), exit_mass[exits]),
        (loops, state[order][loops], np.ones(loops.size)),
    ]
    count = np.bincount(state, minlength=size)
    if leaving is not None:
        parts.append((np.array([origin.size]), np.array([size]), np.ones(1)))
        count = np.append(count, 1)
    all_rows, successor, probability = (np.concatenate(x) for x in zip(*parts, strict=True))
    place = np.lexsort((successor, all_rows))
    width = np.bincount(all_rows, minlength=int(count.sum()))
    part = HostMDP(
        offsets_from_counts(count),
        offsets_from_counts(width),
        successor[place].astype(np.int32),
        probability[place],
    )
    if leaving is not None:
        origin = np.append(origin, -1)
    return part, origin, (entry[out], row[out])
