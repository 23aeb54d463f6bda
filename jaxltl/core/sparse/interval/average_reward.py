"""Certified long-run average rewards of stochastic games and uncertain MDPs.

Two players own the states, and one of them is nature, where rows are uncertainty sets. Both have
optimal positional strategies, whose choices of nature are extreme distributions: the game is a finite
one (Gillette 1957; Liggett and Lippman 1969; Chatterjee and Henzinger 2012). Strategies that are
optimal for a discount near 1 are optimal for the average (Blackwell 1962). They prove themselves: the
optimum of each player against the fixed strategy of the other one bounds the value of the game.

That optimum is the one of an MDP (:mod:`jaxltl.core.sparse.solvers.average_reward`) if the nature of
the free player, or all rows, are fixed. If nature and the free player are one, its gain g in a joint
end component is bounded by every v, ``g <= max_r max_p (c_r + p v) - v``, and what remains is the
probability of stopping, with chances in proportion to these gains: a reachability problem.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple


import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.discounted import DiscountedModel, discounted_value
from jaxltl.core.sparse.interval.game_encoding import choices_as_nature
from jaxltl.core.sparse.interval.l1_ball import Ball
from jaxltl.core.sparse.interval.qualitative import joint_end_components
from jaxltl.core.sparse.interval.reachability import reachability
from jaxltl.core.sparse.interval.robust_values import Query, RobustValues, distribution_depth
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import (
    mask_of,
    offsets_from_counts,
    positions,
    row_entries,
)
from jaxltl.core.sparse.solvers.average_reward import (
    Gains,
    RewardRange,
    Scale,
    Submodel,
    Unsettled,
    average,
    component_gains,
    evaluated,
    within_range,
)

_EPS = float(np.finfo(np.float64).eps)
_METHOD = "discounts near 1, and the optimum against each strategy"
_DISCOUNTS = (1 - 1e-6, 1 - 1e-4, 1 - 1e-8, 1 - 1e-10)  # tried until bounds meet
_SEARCH = 1e-3  # width of the discounted values, as a share of the largest reward
_ROUNDS = 30  # policies in an end component
_SHARE = 0.25  # of the tolerance, for each optimum
_FLOOR = 1e-6  # share of the largest reward below which values are not resolved relatively,
_MIXED_FLOOR = 1e-3  # and where rewards of both signs may cancel
_FINEST = 1e-13  # width of probabilities of stopping


@dataclass(frozen=True)
class AverageGame:
    """A game in which players collect rewards, or pay them, as of :func:`optimal_average`."""

    model: UncertainMDP
    reward: Floats  # float64[T], of entries
    maximizes: Booleans  # bool[S], the states of the player who maximises
    nature_maximizes: bool | None  # None where all rows are points

    @cached_property
    def magnitude(self) -> Floats:
        """The largest absolute reward of each row, ``float64[R]``."""
        return np.maximum.reduceat(np.abs(self.reward), self.model.mdp.entry_start[:-1])

    def restricted(self, rows: Booleans) -> tuple[AverageGame, Integers, Integers]:
        """The game without some rows, and the original rows and entries."""
        mdp, row = self.model.mdp, np.flatnonzero(rows)
        count = np.bincount(mdp.state[row], minlength=mdp.num_states)
        part, entry = self.model.select_rows(offsets_from_counts(count), row)
        return replace(self, model=part, reward=self.reward[entry]), row, entry

    def with_half_steps(self, fixed: Booleans, weight: Floats) -> tuple[AverageGame, Integers]:
        """Each row as a state of its own; a mixed policy ``float64[R]`` chooses among some of them.

        Every step becomes two, one to the row and one from it, with twice its reward: averages are
        those of the game. The second result is the original row of each row.
        """
        model, mdp = self.model, self.model.mdp
        row = np.flatnonzero(~fixed[mdp.state] | (weight > 0))
        entry, width = row_entries(mdp.entry_start, row)
        many = np.bincount(mdp.state[row], minlength=mdp.num_states)
        count = np.where(fixed, 1, many)
        first = np.repeat(np.where(fixed, many, 1), count)  # the widths of the first steps
        chance = np.where(fixed[mdp.state[row]], weight[row], 1.0)

        def both(inner: Floats) -> Floats:
            return np.concatenate([chance, inner[entry]])

        after = np.concatenate([mdp.num_states + np.arange(row.size), mdp.successor[entry]])
        sets = HostMDP(
            offsets_from_counts(np.append(count, np.ones(row.size, np.int64))),
            offsets_from_counts(np.append(first, width)),
            after.astype(np.int32),
            both(mdp.probability),
        )
        ball = model.ball
        if ball is not None:
            ball = Ball(both(ball.center), np.append(np.zeros(first.size), ball.gain[row]))
        game = AverageGame(
            UncertainMDP(sets, both(model.lower), both(model.upper), ball),
            np.append(np.zeros(row.size), 2 * self.reward[entry]),
            np.append(self.maximizes, np.zeros(row.size, bool)),
            self.nature_maximizes,
        )
        begins = offsets_from_counts(first)[:-1]
        return game, np.append(row[begins], row)


class AverageGoal(NamedTuple):
    """The range of the rewards, the width of bounds, and the effort."""

    ends: RewardRange
    tolerance: float  # relative to the value, or to the floor's share of the largest reward
    max_steps: int  # sweeps of value iteration

    @property
    def is_mixed(self) -> bool:
        """True if rewards of both signs may cancel."""
        return self.ends.least < 0 < self.ends.largest

    @property
    def floor(self) -> float:
        """The share of the largest reward below which values are not resolved relatively."""
        return _MIXED_FLOOR if self.is_mixed else _FLOOR

    @property
    def share(self) -> float:
        """The width of an optimum, so that values that cancel are as narrow as others."""
        return self.tolerance * _SHARE * (_MIXED_FLOOR if self.is_mixed else 1)


def optimal_average(game: AverageGame, goal: AverageGoal) -> RobustValues:
    """Long-run average reward per step under optimal play of both players, with certified bounds."""
    best: RobustValues | None = None
    scale, ends = goal.floor * float(game.magnitude.max()), goal.ends
    for discount in _DISCOUNTS:
        row, p, rounds = _discounted_strategies(game, discount)
        low, high = (
            np.clip(_bound(game, row, p, side, goal), ends.least, ends.largest) for side in (-1, 1)
        )
        high = np.maximum(low, high)
        if best is not None:
            rounds += best.rounds
            if (low < best.lower).any():  # one strategy attains all of a bound
                low, row, p = best.lower, best.row, best.probability
            high = np.minimum(high, best.upper)
        value, width = (low + high) / 2, high - low
        best = RobustValues(value, low, high, row, rounds, float(width.max()), _METHOD, p)
        if (width <= goal.tolerance * np.maximum(np.abs(value), scale)).all():
            break
    assert best is not None
    return best


def _discounted_strategies(game: AverageGame, discount: float) -> tuple[Integers, Floats, int]:
    """Rows ``int[S]`` and distributions ``float64[T]``, optimal for a discount, and the rounds."""
    model, mdp, helps = game.model, game.model.mdp, bool(game.nature_maximizes)
    own, rows = game.maximizes == helps, np.ones(game.model.mdp.num_rows)
    # The player with nature's direction becomes nature, unless it is alone.
    encoded = choices_as_nature(model, own & ~own.all(), 0 * rows, rows)
    problem = DiscountedModel(
        encoded.model,
        np.where(encoded.entry < 0, 0, game.reward[encoded.entry]),
        np.where(encoded.row < 0, 1.0, discount),
    )
    width = _SEARCH * float(game.magnitude.max())
    values = discounted_value(problem, Query(helps == bool(own.all()), helps, width))
    # Nature answers the rows that are not chosen, too: another policy may choose them.
    answers = problem.backup(values.value, helps)[0]
    chosen = mask_of(values.row, encoded.model.mdp.num_rows)[encoded.model.mdp.row]
    p = encoded.nature(np.where(chosen, values.probability, answers), mdp.probability)
    return encoded.policy(values.row, values.probability), p, values.rounds


def _bound(game: AverageGame, row: Integers, p: Floats, side: int, goal: AverageGoal) -> Floats:
    """Upper bound of the game by fixing the minimiser (side 1), or lower bound (-1)."""
    mdp = game.model.mdp
    free = game.maximizes == (side > 0)
    part, _, entry = game.restricted(free[mdp.state] | mask_of(row, mdp.num_rows))
    model, reward, depth = part.model, side * part.reward, 0
    chance = model.mdp.probability
    if part.nature_maximizes is not None:
        if part.nature_maximizes == (side > 0):
            return side * _joint_upper_bound(model, reward, goal)
        chance, able = model.nearest_distributions(p[entry])
        if not able:
            return np.full(mdp.num_states, side * np.inf)
        depth = distribution_depth(model.mdp)
    start = model.mdp.entry_start[:-1]
    least, most = np.minimum.reduceat(reward, start), np.maximum.reduceat(reward, start)
    earned = np.where(least == most, most, model.sum_rows(chance * reward))
    world = model.resolve(chance)
    enclosure = average(
        world,
        earned,
        part.magnitude,
        tolerance=goal.share,
        max_steps=goal.max_steps,
        scale=Scale(side, depth, goal.floor),
    )
    enclosure = within_range(world, earned, enclosure, goal.ends if side > 0 else goal.ends.negated)
    return side * enclosure.upper


# --- the optimum of a player and nature together ------------------------------------------------------


def _joint_upper_bound(model: UncertainMDP, reward: Floats, goal: AverageGoal) -> Floats:
    """Upper bound of the average that the choices and nature attain together, ``float64[S]``."""
    # A larger set for nature: sums of ends that are one up to rounding are read as one.
    model = model if model.enlarged is None else model.enlarged
    mdp = model.mdp
    components, used = joint_end_components(model)
    inside = components.region(mdp)
    states = np.flatnonzero(inside)
    states = states[np.argsort(components.component[states], kind="stable")]
    _, start, which = np.unique(
        components.component[states], return_index=True, return_inverse=True
    )
    part = _uncertain_submodel(model, reward, (components.inside, used), states, start)
    part = replace(part, scale=Scale(floor=goal.floor))
    gain = component_gains(part, goal.share, goal.max_steps).upper
    least, span = float(gain.min()), float(np.ptp(gain))
    if span == 0 or not np.isfinite(span):
        return np.full(mdp.num_states, gain.max())
    # Between 1/4 and 3/4 in proportion to the gain: a multiple of 2 ** -50, so that sums are exact.
    chance = np.ceil((0.25 + (gain - least) / (2 * span)) * 2.0**50) / 2.0**50
    stop = np.empty(mdp.num_states)
    stop[states] = chance[which]
    stopping = _with_stops(model, inside, stop)
    smallest = max(float(np.abs(gain).min()), goal.floor * float(np.abs(reward).max()))
    width = max(goal.share * smallest / (8 * span), _FINEST)
    target = np.arange(stopping.mdp.num_states) == mdp.num_states
    chances = reachability(stopping, target, Query(True, True, width))
    slack = 32 * _EPS * (abs(least) + span)
    upper = least + (chances.upper[: mdp.num_states] - 0.25) * (2 * span) + slack
    bound: Floats = np.minimum(upper, gain.max())
    return bound


def _with_stops(model: UncertainMDP, states: Booleans, chance: Floats) -> UncertainMDP:
    """The model with a row in some states to a target, by a chance, and to a sink otherwise."""
    # The target and the sink are the last two states.
    mdp, size = model.mdp, model.mdp.num_states
    last = mdp.row_start[1:][states]
    place = np.repeat(mdp.entry_start[last], 2)
    pair = np.stack([chance[states], 1 - chance[states]], -1).ravel()

    def entries(inner: Floats) -> Floats:
        return np.append(np.insert(inner, place, pair), [1.0, 1.0])

    after = np.insert(mdp.successor, place, np.tile([size, size + 1], last.size))
    width = np.append(np.insert(np.diff(mdp.entry_start), last, 2), [1, 1])
    sets = HostMDP(
        offsets_from_counts(np.append(np.diff(mdp.row_start) + states, [1, 1])),
        offsets_from_counts(width),
        np.append(after, [size, size + 1]).astype(np.int32),
        entries(mdp.probability),
    )
    ball = model.ball
    if ball is not None:
        ball = Ball(entries(ball.center), np.append(np.insert(ball.gain, last, 0.0), [0.0, 0.0]))
    return UncertainMDP(sets, entries(model.lower), entries(model.upper), ball)


@dataclass(frozen=True)
class _UncertainSubmodel(Submodel):
    """Joint end components as a separate model, with the entries that stay inside."""

    sets: UncertainMDP
    earned: Floats  # float64[T'], rewards of entries

    def ahead(self, v: Floats) -> Floats:
        """``r_t + v_t - v_s`` of each entry."""
        mdp = self.mdp
        return self.earned + (v[mdp.successor] - v[mdp.state[mdp.row]])

    def change(self, v: Floats) -> Floats:
        """``T v - v``."""
        ahead = self.ahead(v)
        p = self.sets.extreme_distributions(ahead, maximize=True)
        return self.mdp.over_choices(np.maximum, self.sets.sum_rows(p * ahead))

    def gain(self, v: Floats, low: Floats | None = None) -> tuple[Floats, Floats]:
        """``max_p p (r + v) - v`` of each row, and its error."""
        sets, ahead = self.sets, self.ahead(v)
        p = sets.extreme_distributions(ahead, maximize=True)
        largest = np.maximum.reduceat(np.abs(ahead), self.mdp.entry_start[:-1])
        error = 2 * self.unit * (largest + self.magnitude)
        for table in sets.tables:
            mass, each = (
                x[table.entry] if table.used is None else np.where(table.used, x[table.entry], 0)
                for x in (p, ahead)
            )
            error[table.row] += np.maximum(table.mean_error(mass, each, over_all=True), 0)
            error[table.row] += np.maximum(table.mean_error(mass, -each, over_all=False), 0)
        return sets.sum_rows(p * ahead), error

    def restricted(self, states: Integers, start: Integers) -> Submodel:
        """The submodel of some components."""
        every = np.ones(self.mdp.num_rows, bool), np.ones(self.mdp.num_transitions, bool)
        small = _uncertain_submodel(self.sets, self.earned, every, states, start)
        return replace(small, row=self.row[small.row], scale=self.scale)

    def policy_iteration(self, known: Gains, rest: Unsettled, tolerance: float) -> Floats | None:
        """Policy iteration of rows and distributions; None at its end, else the last bias."""
        v = rest.v
        for _ in range(_ROUNDS):
            known.rounds += 1
            solved = evaluated(self._under_nature(v), 2 * self.first_best(self.gain(v)[0]))
            if solved is None:
                break
            v = solved[0].high
            known.update(replace(rest, v=v))
            if not known.too_wide(rest, tolerance).any():
                return None
        return v

    def _under_nature(self, v: Floats) -> Submodel:
        """The MDP with two rows for each: the extreme distribution, and one of full support.

        The second ones connect the component where extreme distributions do not.
        """
        sets, count = self.sets, self.mdp.num_rows
        full, entry = sets.select_rows(2 * self.mdp.row_start, np.repeat(np.arange(count), 2))
        extreme = sets.extreme_distributions(self.ahead(v), maximize=True)
        interior = sets.interior_distributions(np.ones(self.mdp.num_transitions, bool))
        p = np.where(full.mdp.row % 2 == 0, extreme[entry], interior[entry])
        return Submodel(
            full.resolve(p),
            self.start,
            self.size,
            np.repeat(self.row, 2),
            full.sum_rows(p * self.earned[entry]),
            np.repeat(self.magnitude, 2),
            self.scale,
        )


def _uncertain_submodel(
    model: UncertainMDP,
    reward: Floats,
    kept: tuple[Booleans, Booleans],
    states: Integers,
    start: Integers,
) -> _UncertainSubmodel:
    """Some components of a model, with the rows and entries that stay inside."""
    mdp, (rows, entries) = model.mdp, kept
    number = positions(states, mdp.num_states)
    row = np.flatnonzero(rows & (number[mdp.state] >= 0))
    row = row[np.argsort(number[mdp.state[row]], kind="stable")]
    count = np.bincount(number[mdp.state[row]], minlength=states.size)
    entry, width = row_entries(mdp.entry_start, row)
    stays = entries[entry]
    width = np.add.reduceat(stays.astype(np.int64), offsets_from_counts(width)[:-1])
    entry = entry[stays]
    sets = HostMDP(
        offsets_from_counts(count),
        offsets_from_counts(width),
        number[mdp.successor[entry]],
        mdp.probability[entry],
    )
    ball = None if model.ball is None else model.ball.select(entry, row)
    part = UncertainMDP(sets, model.lower[entry], model.upper[entry], ball)
    earned = reward[entry]
    largest = np.maximum.reduceat(np.abs(earned), sets.entry_start[:-1])
    size = np.diff(start, append=states.size)
    return _UncertainSubmodel(sets, start, size, row, largest, largest, Scale(), part, earned)
