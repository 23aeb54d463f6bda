"""Step-bounded probabilities and rewards of uncertain MDPs, with a bound of their rounding."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import backward_reachable
from jaxltl.core.sparse.interval.qualitative import zero_one_states
from jaxltl.core.sparse.interval.reachability import reachability
from jaxltl.core.sparse.interval.robust_values import Query, RobustValues, distribution_depth
from jaxltl.core.sparse.interval.total_reward import total_reward
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.solvers.step_bounded import (
    StepBoundedValues,
    UnboundedLimit,
    narrowed,
    reached_within,
    unfinished,
)

_EPS = float(np.finfo(np.float64).eps)
_LONG = 4096  # backups after which the effect of all further ones is bounded, then at each doubling
_CLOSE = 1e-9  # effect of all further backups, relative, at which the iteration stops
_WORK = 2.0**34  # entries of one iteration; beyond these, the rest is bounded
_OVERHEAD = 20_000  # entries in the time that NumPy's calls of one backup take


def backup_error(model: UncertainMDP) -> float:
    """Rounding error of one backup of numbers in [-1, 1].

    A greedy distribution of n entries misses an extreme one by at most (3 n + 3) u of mass that is
    placed wrongly, by n u that is lost in the sum, and by the slack of
    :attr:`UncertainMDP.rounding`, 8 (n + 1) u, which counts as none; the product and its sum lose
    (n + 1) u. Backups are not expansive, so errors of several add up.
    """
    width = int(np.diff(model.mdp.entry_start).max(initial=1))
    return 16 * (width + 1) * _EPS


def until(
    model: UncertainMDP, target: Booleans, stay: Booleans, num_steps: int, query: Query
) -> StepBoundedValues:
    """Probability of reaching a target within `num_steps` through states of `stay`."""
    mdp, open_, one = model.mdp, stay & ~target, backup_error(model)
    value, done, is_fixed, check = target.astype(np.float64), 0, False, _LONG
    row: Integers = mdp.row_start[:-1].astype(np.int64)
    chance, limit = mdp.probability, _Limit(model, target, open_, num_steps, query)
    while done < min(num_steps, _most_backups(model)) and not is_fixed:
        done += 1
        best, row, chance = _backup(model, value[mdp.successor], query)
        new = np.where(open_, np.clip(best, 0, 1), target)
        is_fixed, value = np.array_equal(new, value), new
        if done == check and not is_fixed:
            check *= 2
            if (limit.upper - np.maximum(limit.lower, value) <= _CLOSE)[open_].all():
                break
    complete = is_fixed or done == num_steps
    # Of fewer backups the value is a lower bound, as a target is reached once.
    size = min((num_steps if complete else done) * one, 1.0)
    error = np.where(open_ & (num_steps > 0), size, 0)
    if not complete or (num_steps > _LONG and size > _CLOSE):
        value, error = narrowed(limit, value, error, open_, complete)
    # Supports decide which values are exactly 0 or 1.
    if num_steps:
        for surely in (False, True):
            entering = partial(
                _entering, model, surely=surely, nature_maximizes=query.nature_maximizes
            )
            region = reached_within(mdp, (target, open_), num_steps, _any_or_all(query), entering)
            known = open_ & (region if surely else ~region)
            value, error = np.where(known, surely, value), np.where(known, 0, error)
    return StepBoundedValues(value, error, row, done, chance)


def _most_backups(model: UncertainMDP) -> int:
    return int(_WORK / (model.mdp.num_transitions + _OVERHEAD))


@dataclass(frozen=True)
class _Limit:
    """Bounds of a step-bounded probability by the unbounded one, for many steps n.

    Players that maximise keep to nearly optimal choices of the unbounded problem, which bounds the
    probability from below. Against them, the players that minimise cannot do better than avoid the
    target for ever from a state of value zero, once it is met: the probability within n steps is
    at least the unbounded one less that of a run that lasts n steps without such a state
    (:class:`~jaxltl.core.sparse.solvers.step_bounded.UnboundedLimit`).
    """

    model: UncertainMDP
    target: Booleans
    undecided: Booleans
    num_steps: int
    query: Query

    @cached_property
    def unbounded(self) -> RobustValues:
        """The unbounded probability."""
        query = replace(self.query, tolerance=_CLOSE / 4)
        return reachability(self.model, self.target, query, stay=self.undecided | self.target)

    @property
    def upper(self) -> Floats:
        return self.unbounded.upper

    @cached_property
    def lower(self) -> Floats:
        part, chance = self.model, self.unbounded.probability
        if self.query.maximize:
            part, entry = part.under_policy(self.unbounded.row)
            chance = chance[entry]
        depth = self.query.depth + distribution_depth(part.mdp)
        if self.query.nature_maximizes:
            chance, able = part.nearest_distributions(chance)
            if not able:
                return np.zeros(self.target.size)
            fixed = part.resolve(chance)
            return UnboundedLimit(
                fixed, self.target, self.undecided, self.num_steps, maximize=False, depth=depth
            ).lower
        least = Query(False, False, tolerance=_CLOSE / 4, depth=self.query.depth)
        value = reachability(part, self.target, least, stay=self.undecided | self.target).lower
        absorbing = part.with_absorbing(~self.undecided)[0]
        ended = ~self.undecided | zero_one_states(absorbing, self.target, least).zero
        longest = Query(True, True, tolerance=0.1, depth=self.query.depth)
        time = total_reward(part, np.ones(part.mdp.num_rows), ended, longest).upper
        return value - unfinished(time, self.num_steps)


def next_step(model: UncertainMDP, target: Booleans, query: Query) -> StepBoundedValues:
    """Probability that the next state is a target."""
    ahead = target.astype(np.float64)[model.mdp.successor]
    value, row, chance = _backup(model, ahead, query)
    value, error = np.clip(value, 0, 1), np.full(value.size, backup_error(model))
    for surely in (False, True):
        rows = _entering(model, target, surely, query.nature_maximizes)
        states = model.mdp.over_choices(_any_or_all(query), rows)
        known = states if surely else ~states
        value, error = np.where(known, surely, value), np.where(known, 0, error)
    return StepBoundedValues(value, error, row, 1, chance)


def total(
    model: UncertainMDP, earned: Floats, start: Floats, num_steps: int, query: Query
) -> StepBoundedValues:
    """Expected reward of `num_steps` steps plus a final reward."""
    mdp, one = model.mdp, backup_error(model)
    value, error, done, check = start, 0.0, 0, _LONG
    row: Integers = mdp.row_start[:-1].astype(np.int64)
    chance, max_backups = mdp.probability, min(num_steps, _most_backups(model))
    width: Floats = np.zeros(value.size)
    while done < max_backups:
        done += 1
        ahead = earned + value[mdp.successor]
        best, row, chance = _backup(model, ahead, query)
        remaining, size = num_steps - done + 1, float(np.abs(ahead).max(initial=0))
        if np.array_equal(best, value):
            # At a fixed point the error of all further steps follows from e -> (1 + u) e + u size.
            growth = float(np.expm1(min(remaining * np.log1p(one), 500)))
            error = 1.01 * (error * (1 + growth) + growth * size)
            break
        if remaining > 1 and done in (check, max_backups):
            check *= 2
            # T is monotone and T (v + c) = T v + c: each further step adds at least the least, and
            # at most the largest, of T v - v (Puterman 1994, section 8.5).
            step, slack = best - value, error + 2 * remaining * one * size
            low, high = (value + remaining * x for x in (step.min(), step.max()))
            if not earned.any():
                low, high = np.maximum(low, best.min()), np.minimum(high, best.max())
            if done == max_backups or (high - low <= _CLOSE * np.maximum(np.abs(low), 1)).all():
                value, width, error = (low + high) / 2, (high - low) / 2, 1.01 * slack
                break
        value, error = best, error + one * (size + error)
    some = start != 0
    some[mdp.state[mdp.row[earned != 0]]] = True
    # Without a reward ahead the value is exactly 0, also where the remaining steps are bounded.
    some = backward_reachable(mdp, some)
    value, off = np.where(some, value, 0), np.where(some & (num_steps > 0), width + error, 0)
    return StepBoundedValues(value, off, row, done, chance)


def _backup(model: UncertainMDP, ahead: Floats, query: Query) -> tuple[Floats, Integers, Floats]:
    """The optimal mean of ``float64[T]``, the best rows, and nature's distributions."""
    mdp = model.mdp
    chance = model.extreme_distributions(ahead, maximize=query.nature_maximizes)
    image = model.sum_rows(chance * ahead)
    best = mdp.over_choices(np.maximum if query.maximize else np.minimum, image)
    row = mdp.first_choice(image == best[mdp.state])[1].astype(np.int64)
    return best, row, chance


def _any_or_all(query: Query) -> np.ufunc:
    return np.logical_or if query.maximize else np.logical_and


def _entering(
    model: UncertainMDP, region: Booleans, surely: bool, nature_maximizes: bool
) -> Booleans:
    """Rows that enter a region with positive probability, or surely, under nature's best choice."""
    leads = model.mdp.support.some_successor_in
    if surely:
        return model.can_stay_in(region) if nature_maximizes else ~leads(~region)
    return leads(region) if nature_maximizes else ~model.can_stay_in(~region)
