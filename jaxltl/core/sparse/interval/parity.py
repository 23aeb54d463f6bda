"""Parity objectives against an adversarial nature, by strategy improvement.

The policy improves while nature answers optimally: by rows that gain at once, and, where none
does, in a class of states of equal value by choices that keep to the class for ever and win there
unless nature gives way (Chatterjee and Henzinger 2006). At the end nature has choices that leave
each class or win in it, and the value is bounded from each side by fixing one player: the
certificate does not depend on how values were grouped into classes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.accepting import accepting_region
from jaxltl.core.sparse.interval.l1_ball import Ball, share_of
from jaxltl.core.sparse.interval.qualitative import RobustRegion, joint_accepting_region
from jaxltl.core.sparse.interval.reachability import reachability
from jaxltl.core.sparse.interval.robust_values import (
    Query,
    RobustValues,
    distribution_depth,
    row_gains,
)
from jaxltl.core.sparse.interval.strategy_iteration import enclosed_values
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.solvers import reachability as mdp_reachability

_CLASS = 1e-9  # values nearer than this are in one class
_GAIN = 1e-12  # gain at which a row is better
_ROUNDS = 200


def parity_against_nature(
    model: UncertainMDP, priority: Integers, *, tolerance: float = 1e-6
) -> RobustValues:
    """Maximal probability that the least priority seen infinitely often is even, for any nature."""
    mdp = model.mdp
    row: Integers = mdp.row_start[:-1].astype(np.int64)
    zero = np.zeros(mdp.num_rows)
    rounds = 0
    while True:
        rounds += 1
        losing = _losing_probability(model, row, priority, tolerance)
        value = 1 - losing.value
        gain, p = row_gains(model, value, zero, nature_maximizes=False)
        best = mdp.over_choices(np.maximum, gain)
        better = best > _GAIN
        if better.any():
            row = np.where(better, mdp.first_choice(gain == best[mdp.state])[1], row)
        else:
            game = _class_game(model, value, gain)
            winning = almost_sure_parity(game, priority, leader="policy")
            better = winning.region & (value < 1 - _CLASS)
            row = np.where(better, winning.row, row)
        if not better.any() or rounds == _ROUNDS:
            break
    nature = almost_sure_parity(_class_game(model, value, gain), priority + 1, leader="nature")
    kept = nature.region[mdp.state] & (gain >= -_CLASS)
    p = np.where(kept[mdp.row], nature.probability, p)
    p, upper = _value_under_nature(model, p, priority, tolerance)
    lower = np.clip(1 - losing.upper - 1e-16, 0, 1)
    lower = np.where(losing.upper == 0, 1, np.where(losing.upper >= 1, 0, lower))
    residual = float(best.max(initial=0))
    return enclosed_values(value, (lower, upper), row, p, rounds=rounds, residual=residual)


def _value_under_nature(
    model: UncertainMDP, p: Floats, priority: Integers, tolerance: float
) -> tuple[Floats, Floats]:
    """Nature's distributions next to p, and an upper bound of the values under them."""
    p, able = model.nearest_distributions(p)
    mdp = model.resolve(p)
    region = accepting_region(mdp, priority[mdp.state[mdp.row]]).region
    depth = distribution_depth(mdp)
    enclosure = mdp_reachability.reachability(
        mdp, region, maximize=True, tolerance=tolerance / 2, depth=depth
    )
    return p, enclosure.upper if able else np.ones(mdp.num_states)


def _losing_probability(
    model: UncertainMDP, row: Integers, priority: Integers, tolerance: float
) -> RobustValues:
    """Probability that nature violates the condition under a policy."""
    part, _ = model.under_policy(row)
    lost = joint_accepting_region(part, priority[part.mdp.state[part.mdp.row]] + 1)
    query = Query(maximize=True, nature_maximizes=True, tolerance=tolerance / 2)
    return reachability(part, lost.region, query)


# --- the game inside classes of equal values ----------------------------------------------------


@dataclass(frozen=True)
class ClassGame:
    """Choices of both players that keep the value."""

    model: UncertainMDP  # nature's optimal distributions
    rows: Booleans  # bool[R], the policy's optimal rows
    inside: Booleans  # bool[T], entries that stay in their class


def _class_game(model: UncertainMDP, value: Floats, gain: Floats) -> ClassGame:
    mdp = model.mdp
    order = np.argsort(value, kind="stable")
    jump = np.diff(value[order], prepend=-1.0) > _CLASS
    label = np.empty(value.size, np.int64)
    label[order] = jump.cumsum()
    ahead = label[mdp.successor]
    inside = ahead == label[mdp.state[mdp.row]]
    return ClassGame(optimal_face(model, ahead), gain >= -_CLASS, inside)


def optimal_face(model: UncertainMDP, rank: Integers) -> UncertainMDP:
    """The face of distributions that minimise ``sum_t p_t rank_t`` in each row; ranks ``int[T]``.

    In intervals, mass is free within the last rank that gets any. In a ball that binds, it is free
    within the last rank that gains over the center and within the first that loses.
    """
    start, row = model.mdp.entry_start[:-1], model.mdp.row
    p = model.extreme_distributions(rank.astype(np.float64), maximize=False)
    loose = model.lower < model.upper
    last = np.maximum.reduceat(np.where(loose & (p > model.lower), rank, -1), start)
    free = loose & (rank == last[row])
    lower, upper = np.where(free, model.lower, p), np.where(free, model.upper, p)
    if model.ball is None:
        return UncertainMDP(model.mdp, lower, upper, tolerant=True)
    center, limit = model.ball.center, model.ball.gain
    off = p - center
    gainer = np.maximum.reduceat(np.where(off > 0, rank, -1), start)
    loser = np.minimum.reduceat(np.where(off < 0, rank, rank.max(initial=0) + 1), start)
    gained = model.sum_rows(np.maximum(off, 0))
    binds = ((gained >= limit - model.rounding) & (gainer < loser))[row]
    # A ball that does not bind between ranks still binds within the free one.
    spare = limit - model.sum_rows(np.where(free, 0, np.maximum(off, 0)))
    upper = np.where(free & (spare <= model.rounding)[row], center, upper)
    gains, loses = (binds & (rank == x[row]) for x in (gainer, loser))
    lower = np.where(gains, center, np.where(loses, model.lower, np.where(binds, p, lower)))
    upper = np.where(gains, model.upper, np.where(loses, center, np.where(binds, p, upper)))
    movable = model.sum_rows(np.where(loses, p - lower, 0))
    upper = np.where(loses & (movable <= model.rounding)[row], lower, upper)
    inner = np.where(binds, lower, np.where(free, center, p))
    limit = np.where(np.logical_or.reduceat(binds, start), 1, spare)
    return SplitMDP(
        model.mdp,
        lower,
        upper,
        Ball(inner, limit),
        tolerant=True,
        gains=gains,
        mass=model.sum_rows(np.where(gains, p, 0)),
    )


@dataclass(frozen=True, kw_only=True)
class SplitMDP(UncertainMDP):
    """Uncertainty sets in which some entries have a given total mass."""

    gains: Booleans  # bool[T], those entries
    mass: Floats  # float64[R]

    @property
    def _parts(self) -> tuple[tuple[Booleans, Floats], tuple[Booleans, Floats]]:
        return (self.gains, self.mass), (~self.gains, 1 - self.mass)

    def can_stay_on(self, entries: Booleans) -> Booleans:
        stays = UncertainMDP.can_stay_on(self, entries)
        for part, mass in self._parts:
            room = self.sum_rows(np.where(entries & part, self.upper, 0))
            stays &= room >= mass - self.rounding
        return stays

    def interior_distributions(self, entries: Booleans) -> Floats:
        row = self.mdp.row
        entries = entries | ~self.can_stay_on(entries)[row]
        distribution = UncertainMDP.interior_distributions(self, entries)
        split = np.logical_or.reduceat(self.gains, self.mdp.entry_start[:-1])[row]
        for part, mass in self._parts:
            free = np.where(entries & part, self.upper - self.lower, 0)
            rest = mass - self.sum_rows(np.where(part, self.lower, 0))
            share = share_of(rest, self.sum_rows(free))[row]
            inner = np.where(entries, self.lower + free * share, 0)
            distribution = np.where(part & split, inner, distribution)
        return distribution


def almost_sure_parity(game: ClassGame, priority: Integers, *, leader: str) -> RobustRegion:
    """Region in which the leader ensures almost surely that the least priority is even.

    The nested fixed point ``nu Y0 mu X0 nu Y1 mu X1 ...``: at a state of priority 2j or 2j + 1
    either all successors are in Yi and some in Xi, for some i < j (i <= j where the priority is
    odd), or, where it is even, all are in Yj (de Alfaro and Henzinger 2000, with sides that move
    one after the other). Leaving a class is lost for the policy and won for nature.
    """
    model = game.model
    possible = (model.upper > 0) & (
        (model.lower > 0) | (model.free_mass > model.rounding)[model.mdp.row]
    )
    inside, outside = game.inside & possible, ~game.inside & possible
    step = _policy_step if leader == "policy" else _nature_step
    return _Fixpoint(game, priority, inside, outside, step).solve([], [])


def _policy_step(
    fixpoint: _Fixpoint, odd: bool, ys: list[Booleans], xs: list[Booleans]
) -> tuple[Booleans, Integers, Floats]:
    """States with a row that satisfies the step for any nature, and the rows."""
    model, mdp = fixpoint.game.model, fixpoint.game.model.mdp
    possible = fixpoint.inside | fixpoint.outside
    bad = fixpoint.some(possible & ~(fixpoint.inside & ys[0][mdp.successor]))
    # Nature avoids the X of the first levels and leaves the Y of the next one.
    apart = possible.copy()
    for y, x in zip(ys[1:], xs, strict=False):
        apart &= ~x[mdp.successor]
        bad |= model.can_stay_on(apart) & fixpoint.some(apart & ~y[mdp.successor])
    if odd:
        bad |= model.can_stay_on(apart & ~xs[-1][mdp.successor])
    some, row = mdp.first_choice(fixpoint.game.rows & ~bad)
    return some, row, mdp.probability


def _nature_step(
    fixpoint: _Fixpoint, odd: bool, ys: list[Booleans], xs: list[Booleans]
) -> tuple[Booleans, Integers, Floats]:
    """States where nature satisfies the step in every row, and its distributions."""
    model, mdp = fixpoint.game.model, fixpoint.game.model.mdp
    able_rows, p = np.zeros(mdp.num_rows, bool), mdp.probability
    for i, (y, x) in enumerate(zip(ys, xs, strict=True)):
        kept = fixpoint.outside | (fixpoint.inside & y[mdp.successor])
        able = model.can_stay_on(kept)
        if odd or i < len(ys) - 1:
            able &= fixpoint.some(kept & (fixpoint.outside | x[mdp.successor]))
        p = np.where((able & ~able_rows)[mdp.row], model.interior_distributions(kept), p)
        able_rows |= able
    every = mdp.over_choices(np.logical_and, able_rows | ~fixpoint.game.rows)
    return every, mdp.row_start[:-1], p


@dataclass(frozen=True)
class _Fixpoint:
    """The nested fixed point."""

    game: ClassGame  # the game (game, priority)
    priority: Integers
    inside: Booleans  # bool[T], possible entries that stay in their class and that leave it
    outside: Booleans
    # one application of the controllable predecessor to the sets of all levels
    step: Callable[..., tuple[Booleans, Integers, Floats]]

    def some(self, entries: Booleans) -> Booleans:
        """Rows with one of the entries: ``bool[R]`` from ``bool[T]``."""
        return np.logical_or.reduceat(entries, self.game.model.mdp.entry_start[:-1])

    def solve(self, ys: list[Booleans], xs: list[Booleans]) -> RobustRegion:
        """The fixed point of the inner variables, with the choices by which states entered."""
        level = len(ys)
        if 2 * level > self.priority.max():
            return self.body(ys, xs)
        # Inner levels rely on progress at this one.
        below = (self.priority >= 2 * level + 1).any()
        y = ys[-1] if ys else np.ones(self.priority.size, bool)
        while True:
            winning = self.solve([*ys, y], [*xs, np.zeros_like(y)])
            while below:
                new = self.solve([*ys, y], [*xs, winning.region])
                fresh = new.region & ~winning.region
                if not fresh.any():
                    break
                winning = self.join(winning, new, fresh)
            if (winning.region == y).all():
                return winning
            y = winning.region

    def join(self, winning: RobustRegion, new: RobustRegion, fresh: Booleans) -> RobustRegion:
        """The region with new states."""
        mdp = self.game.model.mdp
        source = fresh[mdp.state[mdp.row]]
        return RobustRegion(
            winning.region | fresh,
            np.where(fresh, new.row, winning.row),
            np.where(source, new.probability, winning.probability),
        )

    def body(self, ys: list[Booleans], xs: list[Booleans]) -> RobustRegion:
        """One step from each state, by its priority."""
        mdp = self.game.model.mdp
        region = np.zeros(mdp.num_states, bool)
        winning = RobustRegion(region, mdp.row_start[:-1].astype(np.int64), mdp.probability)
        for p in np.unique(self.priority):
            up = p // 2 + 1
            some, row, chance = self.step(self, p % 2 == 1, ys[:up], xs[:up])
            winning = self.join(
                winning, RobustRegion(some, row, chance), some & (self.priority == p)
            )
        return winning
