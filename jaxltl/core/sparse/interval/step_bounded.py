"""Step-bounded probabilities and rewards of uncertain MDPs, with a bound of their rounding."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import backward_reachable
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP

_EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class StepBoundedValues:
    """Values after a number of steps."""

    value: Floats  # float64[S]
    error: Floats  # float64[S], bound of the rounding error
    row: Integers  # int64[S], the policy of the first step
    probability: Floats  # float64[T], nature's distributions in the first step
    num_steps: int  # backups until a fixed point


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
    open_ = stay & ~target
    value, done = target.astype(np.float64), 0
    row: Integers = model.mdp.row_start[:-1].astype(np.int64)
    chance = model.mdp.probability
    while done < num_steps:
        done += 1
        found, row, chance = _backup(model, value[model.mdp.successor], query)
        new = np.where(open_, np.clip(found, 0, 1), target)
        if np.array_equal(new, value):
            break
        value = new
    total = num_steps * backup_error(model)
    error = np.where(open_ & (num_steps > 0), min(total, 1.0), 0)
    # Supports decide which values are exactly 0 or 1.
    if num_steps:
        for surely in (False, True):
            region = _qualitative(model, (target, open_), num_steps, surely, query)
            known = open_ & (region if surely else ~region)
            value, error = np.where(known, surely, value), np.where(known, 0, error)
    return StepBoundedValues(value, error, row, chance, done)


def next_step(model: UncertainMDP, target: Booleans, query: Query) -> StepBoundedValues:
    """Probability that the next state is a target."""
    ahead = target.astype(np.float64)[model.mdp.successor]
    value, row, chance = _backup(model, ahead, query)
    value, error = np.clip(value, 0, 1), np.full(value.size, backup_error(model))
    for surely in (False, True):
        rows = _entering(model, target, surely, query.nature_maximizes)
        found = model.mdp.over_choices(_any_or_all(query), rows)
        known = found if surely else ~found
        value, error = np.where(known, surely, value), np.where(known, 0, error)
    return StepBoundedValues(value, error, row, chance, 1)


def total(
    model: UncertainMDP, earned: Floats, start: Floats, num_steps: int, query: Query
) -> StepBoundedValues:
    """Expected reward of `num_steps` steps plus a final reward."""
    mdp, one = model.mdp, backup_error(model)
    value, error, done = start, 0.0, 0
    row: Integers = mdp.row_start[:-1].astype(np.int64)
    chance = mdp.probability
    while done < num_steps:
        done += 1
        ahead = earned + value[mdp.successor]
        found, row, chance = _backup(model, ahead, query)
        still = np.array_equal(found, value)
        # At a fixed point the error of all further steps follows from e -> (1 + one) e + one size.
        size, repeated = float(np.abs(ahead).max(initial=0)), num_steps - done + 1 if still else 1
        growth = float(np.expm1(min(repeated * np.log1p(one), 500)))
        error = (
            1.01 * (error * (1 + growth) + growth * size)
            if still
            else (error + one * (size + error))
        )
        value = found
        if still:
            break
    some = start != 0
    some[mdp.state[mdp.row[earned != 0]]] = True
    off = np.where(backward_reachable(mdp, some), error if num_steps else 0, 0)
    return StepBoundedValues(value, off, row, chance, done)


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


def _qualitative(
    model: UncertainMDP,
    sets: tuple[Booleans, Booleans],
    num_steps: int,
    surely: bool,
    query: Query,
) -> Booleans:
    """States that reach a target through open ones in time with positive probability, or surely."""
    target, open_ = sets
    region = target
    for _ in range(num_steps):
        rows = _entering(model, region, surely, query.nature_maximizes)
        new = target | (open_ & model.mdp.over_choices(_any_or_all(query), rows))
        if (new == region).all():
            break
        region = new
    return region
