"""The probability of a parity condition that a policy can have whatever nature picks.

The policy improves while nature answers best: by rows that gain something at once, and, where none
does, in a class of states of equal value by choices that keep to the class for ever and win there
unless nature gives way (strategy improvement, Chatterjee and Henzinger 2006). When nothing is left,
nature has choices that leave each class or win in it, and both are bounded by what is known of one
player: nothing rests on how values were told apart.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.accepting import accepting_region
from jaxltl.core.sparse.interval import reachability as interval_values
from jaxltl.core.sparse.interval.optimal_face import face_of
from jaxltl.core.sparse.interval.qualitative import joint_accepting
from jaxltl.core.sparse.interval.reachability import Robust, gains, terms
from jaxltl.core.sparse.interval.uncertainty_set import HostInterval
from jaxltl.core.sparse.solvers import reachability as optimal

_CLASS = 1e-9  # values nearer than this are looked at together
_ROUNDS = 200


def parity_against_nature(
    model: HostInterval, priority: Integers, *, tolerance: float = 1e-6
) -> Robust:
    """The largest probability that the least priority met for ever is even, nature against it.

    Args:
      model: the product.
      priority: ``int[S]``, what each state reads as it is left.
      tolerance: the width of the enclosure asked for.

    Returns:
      Values, the policy, and nature's distributions against which no policy does better.
    """
    mdp = model.mdp
    row: Integers = mdp.row_start[:-1].astype(np.int64)
    zero = np.zeros(mdp.num_rows)
    rounds = 0
    while True:
        rounds += 1
        answer = _answered(model, row, priority, tolerance)
        value = 1 - answer.value
        gain, p = gains(model, value, zero, up=False)
        best = mdp.over_choices(np.maximum, gain)
        better = best > 1e-12
        if better.any():
            new = mdp.first_choice(gain == best[mdp.state])[1]
            row = np.where(better, new, row)
        else:
            game = _tight(model, value, gain)
            found = almost_surely(game, priority, leader="policy")
            better = found.region & (value < 1 - _CLASS)
            row = np.where(better, found.row, row)
        if not better.any() or rounds == _ROUNDS:
            break
    nature = almost_surely(_tight(model, value, gain), priority + 1, leader="nature")
    kept = nature.region[mdp.state] & (gain >= -_CLASS)
    p = np.where(kept[mdp.row], nature.probability, p)
    p, able = model.settled(p)
    mdp_ = model.fixed(p)
    region = accepting_region(mdp_, priority[mdp_.state[mdp_.row]]).region
    other = optimal.reachability(
        mdp_, region, maximize=True, tolerance=tolerance / 2, depth=terms(mdp_)
    )
    lower = np.clip(1 - answer.upper - 1e-16, 0, 1)
    lower = np.where(answer.upper == 0, 1, np.where(answer.upper >= 1, 0, lower))
    upper = np.maximum(other.upper if able else 1, lower)
    return Robust(
        np.clip(value, lower, upper),
        lower,
        upper,
        row,
        p,
        rounds,
        float(best.max(initial=0)),
        "strategy improvement against nature",
    )


def _answered(model: HostInterval, row: Integers, priority: Integers, tolerance: float) -> Robust:
    """What nature makes of a policy: the probability that it does not win."""
    part, _ = model.chain(row)
    lost = joint_accepting(part, priority[part.mdp.state[part.mdp.row]] + 1)
    return interval_values.reachability(
        part, lost.region, maximize=True, helpful=True, tolerance=tolerance / 2
    )


class _Game(NamedTuple):
    """What is left where nobody gives anything away.

    Attributes:
      model: nature's distributions that cost it nothing.
      rows: ``bool[R]``, the policy's rows that cost it nothing.
      inside: ``bool[T]``, the entries that stay in the class.
    """

    model: HostInterval
    rows: Booleans
    inside: Booleans


def _tight(model: HostInterval, value: Floats, gain: Floats) -> _Game:
    """The choices that keep the value, and the classes of equal values."""
    mdp = model.mdp
    order = np.argsort(value, kind="stable")
    jump = np.diff(value[order], prepend=-1.0) > _CLASS
    label = np.empty(value.size, np.int64)
    label[order] = jump.cumsum()
    ahead = label[mdp.successor]
    inside = ahead == label[mdp.state[mdp.row]]
    return _Game(face_of(model, ahead), gain >= -_CLASS, inside)


class Winning(NamedTuple):
    """Where one side wins almost surely.

    Attributes:
      region: ``bool[S]``.
      row: ``int[S]``, there the policy's rows.
      probability: ``float64[T]``, there nature's distributions.
    """

    region: Booleans
    row: Integers
    probability: Floats


def almost_surely(game: _Game, priority: Integers, *, leader: str) -> Winning:
    """Where the leader sees to it that the least priority met for ever is even almost surely.

    The nested fixpoint ``nu Y0 mu X0 nu Y1 mu X1 ...``: of a state of priority 2j or 2j + 1 either
    all that comes next is in Yi, and some of it in Xi, for some i < j (i <= j where the priority is
    odd), or, where it is even, all is in Yj (de Alfaro and Henzinger 2000, for one side that moves
    at a time). The policy loses where a class is left, nature wins.

    Args:
      game: the choices of both.
      priority: ``int[S]``.
      leader: ``"policy"`` or ``"nature"``.
    """
    model = game.model
    possible = (model.upper > 0) & (
        (model.lower > 0) | (model.rest > model.rounding)[model.mdp.row]
    )
    inside, outside = game.inside & possible, ~game.inside & possible
    by = _by_policy if leader == "policy" else _by_nature
    return _Fixpoint(game, priority, inside, outside, by).solved([], [])


def _by_policy(
    of: _Fixpoint, odd: bool, ys: list[Booleans], xs: list[Booleans]
) -> tuple[Booleans, Integers, Floats]:
    """The states with a row that is good whatever nature picks, and the row."""
    model, mdp = of.game.model, of.game.model.mdp
    possible = of.inside | of.outside
    bad = of.some(possible & ~(of.inside & ys[0][mdp.successor]))
    # Nature avoids what is near for the first levels, and leaves what must be kept for the next.
    apart = possible.copy()
    for y, x in zip(ys[1:], xs, strict=False):
        apart &= ~x[mdp.successor]
        bad |= model.may_keep(apart) & of.some(apart & ~y[mdp.successor])
    if odd:
        bad |= model.may_keep(apart & ~xs[-1][mdp.successor])
    some, row = mdp.first_choice(of.game.rows & ~bad)
    return some, row, mdp.probability


def _by_nature(
    of: _Fixpoint, odd: bool, ys: list[Booleans], xs: list[Booleans]
) -> tuple[Booleans, Integers, Floats]:
    """The states of whose every row nature makes something good, and what."""
    model, mdp = of.game.model, of.game.model.mdp
    good, p = np.zeros(mdp.num_rows, bool), mdp.probability
    for i, (y, x) in enumerate(zip(ys, xs, strict=True)):
        kept = of.outside | (of.inside & y[mdp.successor])
        able = model.may_keep(kept)
        if odd or i < len(ys) - 1:
            able &= of.some(kept & (of.outside | x[mdp.successor]))
        p = np.where((able & ~good)[mdp.row], model.within(kept), p)
        good |= able
    every = mdp.over_choices(np.logical_and, good | ~of.game.rows)
    return every, mdp.row_start[:-1], p


class _Fixpoint(NamedTuple):
    """The nested fixpoint over states of several priorities.

    Attributes:
      game, priority: the game.
      inside, outside: ``bool[T]``, the entries that stay in a class and those that leave it, where
        nature may give them any mass.
      by: the states that are good at the next step, by the sets of each level; with rows and
        distributions.
    """

    game: _Game
    priority: Integers
    inside: Booleans
    outside: Booleans
    by: Callable[..., tuple[Booleans, Integers, Floats]]

    def some(self, entries: Booleans) -> Booleans:
        """Whether a row has some of the entries: ``bool[R]`` from ``bool[T]``."""
        return np.logical_or.reduceat(entries, self.game.model.mdp.entry_start[:-1])

    def solved(self, ys: list[Booleans], xs: list[Booleans]) -> Winning:
        """The fixpoint of the inner variables, with the choices by which states came in first."""
        level = len(ys)
        if 2 * level > self.priority.max():
            return self.body(ys, xs)
        # What is deeper down counts on the progress that is made here.
        below = (self.priority >= 2 * level + 1).any()
        y = ys[-1] if ys else np.ones(self.priority.size, bool)
        while True:
            found = self.solved([*ys, y], [*xs, np.zeros_like(y)])
            while below:
                new = self.solved([*ys, y], [*xs, found.region])
                fresh = new.region & ~found.region
                if not fresh.any():
                    break
                found = self.joined(found, new, fresh)
            if (found.region == y).all():
                return found
            y = found.region

    def joined(self, found: Winning, new: Winning, fresh: Booleans) -> Winning:
        """What was found, and what is new of some states."""
        mdp = self.game.model.mdp
        source = fresh[mdp.state[mdp.row]]
        return Winning(
            found.region | fresh,
            np.where(fresh, new.row, found.row),
            np.where(source, new.probability, found.probability),
        )

    def body(self, ys: list[Booleans], xs: list[Booleans]) -> Winning:
        """One step from each state, by its priority."""
        mdp = self.game.model.mdp
        region = np.zeros(mdp.num_states, bool)
        found = Winning(region, mdp.row_start[:-1].astype(np.int64), mdp.probability)
        for p in np.unique(self.priority):
            up = p // 2 + 1
            some, row, chance = self.by(self, p % 2 == 1, ys[:up], xs[:up])
            found = self.joined(found, Winning(some, row, chance), some & (self.priority == p))
        return found
