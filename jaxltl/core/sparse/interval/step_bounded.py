"""What can be had in so many steps when probabilities lie in intervals, with its rounding."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import backward_reachable
from jaxltl.core.sparse.interval.uncertainty_set import HostInterval

_EPS = float(np.finfo(np.float64).eps)


class RobustSteps(NamedTuple):
    """What some sweeps found.

    Attributes:
      value: ``float64[S]``.
      error: ``float64[S]``, how far that may be off.
      row: ``int64[S]``, the first choices.
      probability: ``float64[T]``, nature's distributions in the first step.
      num_steps: sweeps that were done until nothing changed.
    """

    value: Floats
    error: Floats
    row: Integers
    probability: Floats
    num_steps: int


def backup_error(model: HostInterval) -> float:
    """How far one backup of numbers in [-1, 1] may be off.

    A greedy distribution of n entries misses an extreme one by at most (3 n + 3) u of mass that is
    placed wrongly, by n u that is lost in the sum, and by the slack of :attr:`rounding
    <jaxltl.core.sparse.interval.uncertainty_set.HostInterval.rounding>`, 8 (n + 1) u, which counts as none; the
    product and its sum lose (n + 1) u. Backups are not expansive, so errors of several add up.
    """
    width = int(np.diff(model.mdp.entry_start).max(initial=1))
    return 16 * (width + 1) * _EPS


def until(
    model: HostInterval,
    target: Booleans,
    stay: Booleans,
    num_steps: int,
    *,
    maximize: bool,
    helpful: bool,
) -> RobustSteps:
    """Probability of a target within so many steps, through states where one may stay.

    Args:
      model: the model.
      target, stay: ``bool[S]``.
      num_steps: n.
      maximize: whether the policy makes it large.
      helpful: whether nature does.
    """
    open_ = stay & ~target
    value, done = target.astype(np.float64), 0
    row: Integers = model.mdp.row_start[:-1].astype(np.int64)
    chance = model.mdp.probability
    while done < num_steps:
        done += 1
        ahead = value[model.mdp.successor]
        found, row, chance = _backup(model, ahead, maximize=maximize, helpful=helpful)
        new = np.where(open_, np.clip(found, 0, 1), target)
        if np.array_equal(new, value):
            break
        value = new
    total = num_steps * backup_error(model)
    error = np.where(open_ & (num_steps > 0), min(total, 1.0), 0)
    # What is exactly zero or one, supports tell.
    if num_steps:
        for surely in (False, True):
            within = _within(model, target, open_, num_steps, surely, maximize, helpful)
            known = open_ & (within if surely else ~within)
            value, error = np.where(known, surely, value), np.where(known, 0, error)
    return RobustSteps(value, error, row, chance, done)


def next_step(
    model: HostInterval, target: Booleans, *, maximize: bool, helpful: bool
) -> RobustSteps:
    """Probability that the next state is in a set.

    Args:
      model, target, maximize, helpful: as of :func:`until`.
    """
    ahead = target.astype(np.float64)[model.mdp.successor]
    value, row, chance = _backup(model, ahead, maximize=maximize, helpful=helpful)
    value, error = np.clip(value, 0, 1), np.full(value.size, backup_error(model))
    for surely in (False, True):
        rows = _entering(model, target, surely, helpful)
        found = model.mdp.over_choices(_some(maximize), rows)
        known = found if surely else ~found
        value, error = np.where(known, surely, value), np.where(known, 0, error)
    return RobustSteps(value, error, row, chance, 1)


def total(
    model: HostInterval,
    earned: Floats,
    start: Floats,
    num_steps: int,
    *,
    maximize: bool,
    helpful: bool,
) -> RobustSteps:
    """Expected reward of so many steps, and then of the state where one is.

    Args:
      model: the model.
      earned: ``float64[T]``, what each entry earns.
      start: ``float64[S]``, of the last state.
      num_steps, maximize, helpful: as of :func:`until`; what the policy or nature make large.
    """
    mdp, one = model.mdp, backup_error(model)
    value, error, done = start, 0.0, 0
    row: Integers = mdp.row_start[:-1].astype(np.int64)
    chance = mdp.probability
    while done < num_steps:
        done += 1
        ahead = earned + value[mdp.successor]
        found, row, chance = _backup(model, ahead, maximize=maximize, helpful=helpful)
        still = np.array_equal(found, value)
        # The same again and again, if nothing changes any more: e -> (1 + one) e + one * size.
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
    return RobustSteps(value, off, row, chance, done)


def _backup(
    model: HostInterval, ahead: Floats, *, maximize: bool, helpful: bool
) -> tuple[Floats, Integers, Floats]:
    """One step to what each entry has ahead: the value, the best rows, nature's distributions."""
    mdp = model.mdp
    chance = model.nature(ahead, maximize=helpful)
    image = model.total(chance * ahead)
    best = mdp.over_choices(np.maximum if maximize else np.minimum, image)
    row = mdp.first_choice(image == best[mdp.state])[1].astype(np.int64)
    return best, row, chance


def _some(maximize: bool) -> Any:
    """How what is true of rows is true of states: of some for who maximizes, else of all."""
    return np.logical_or if maximize else np.logical_and


def _entering(model: HostInterval, region: Booleans, surely: bool, helpful: bool) -> Booleans:
    """The rows by which a region is entered possibly, or surely, with nature for or against it."""
    if surely:
        return model.may_stay(region) if helpful else ~model.mdp.support.some_successor_in(~region)
    return model.mdp.support.some_successor_in(region) if helpful else ~model.may_stay(~region)


def _within(
    model: HostInterval,
    target: Booleans,
    open_: Booleans,
    num_steps: int,
    surely: bool,
    maximize: bool,
    helpful: bool,
) -> Booleans:
    """Whether a target is met in so many steps with positive probability, or surely."""
    region = target
    for _ in range(num_steps):
        rows = _entering(model, region, surely, helpful)
        new = target | (open_ & model.mdp.over_choices(_some(maximize), rows))
        if (new == region).all():
            break
        region = new
    return region
