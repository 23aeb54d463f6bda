"""Interval MDPs: construction and validation of intervals and L1 balls around rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from operator import attrgetter
from typing import Any

import numpy as np
from jaxltl.core import struct, validation
from jaxltl.core.validation import first_true

from jaxltl.core.pretty_print import brief
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.protocols import Model
from jaxltl.core.models.sparse import (
    Array,
    Rewards,
    SparseMDP,
    check_entries,
    checked_rows,
    make_sparse,
    placed,
)
from jaxltl.core.sparse.interval.l1_ball import Ball
from jaxltl.core.sparse.interval.row_table import row_sums
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP, uncertainty_sets
from jaxltl.core.sparse.linear.extended_precision import two_sum
from jaxltl.core.sparse.rows import offsets_from_counts

ROW_SUM_TOLERANCE = 1e-6  # how far a row may miss a distribution and still be scaled to one
_ENDS = ("lower", "upper", "center", "radius")
_PREFIX = "\0"  # of the names of rewards that are ends, centers or radii


@brief
@struct.dataclass
class IntervalMDP:
    """Labelled MDP with uncertain transition probabilities: intervals, and optional L1 balls.

    A row stands for all distributions p with ``lower <= p <= upper`` and, where there is a radius,
    ``sum_t |p_t - center_t| <= radius``. In each step nature picks one of them, against the policy
    (`nature="adversarial"`) or with it (`"cooperative"`).

    Attributes:
      nominal: the graph, labels, rewards and names; its probabilities are one distribution of
        each row, positive wherever nature may put any mass.
      lower, upper: ``float64[T]``, one for each entry of `nominal`.
      center: ``float64[T]``, a distribution between them in each row; None without a radius.
      radius: ``float64[R]``, the largest L1 distance from it; None: bounded by the intervals only.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> rough = jl.make_interval(coin, [0.4, 0.3, 1, 1], [0.7, 0.6, 1, 1])
      >>> rough.num_transitions, rough.lower.tolist(), rough.is_chain
      (4, [0.4, 0.3, 1.0, 1.0], True)
    """

    nominal: SparseMDP
    lower: Array
    upper: Array
    center: Array | None = None
    radius: Array | None = None

    @property
    def num_states(self) -> int:
        """S."""
        return self.nominal.num_states

    num_rows = property(attrgetter("nominal.num_rows"), doc="R, the choices of all states.")
    num_transitions = property(
        attrgetter("nominal.num_transitions"), doc="T, the entries of all choices."
    )
    is_chain = property(attrgetter("nominal.is_chain"), doc="True if every state has one choice.")
    state_shape = property(attrgetter("nominal.state_shape"), doc="The shape of a value: ``(S,)``.")
    dtype = property(attrgetter("nominal.dtype"), doc="The dtype of the nominal probabilities.")
    initial = property(attrgetter("nominal.initial"), doc="``float[S]``, the initial distribution.")
    label = property(
        attrgetter("nominal.label"), doc="``bool[S, P]``, the propositions that hold in each state."
    )
    propositions = property(attrgetter("nominal.propositions"), doc="The P names.")
    rewards = property(
        attrgetter("nominal.rewards"), doc="Named :class:`~jaxltl.core.models.sparse.Rewards`."
    )

    @cached_property
    def host(self) -> UncertainMDP:
        """The transitions for the sparse engine."""
        lower, upper = (np.asarray(x, np.float64) for x in (self.lower, self.upper))
        ball = None
        if self.radius is not None and self.center is not None:
            ball = Ball(
                np.asarray(self.center, np.float64), np.asarray(self.radius, np.float64) / 2
            )
        return UncertainMDP(self.nominal.host, lower, upper, ball)

    @property
    def box(self) -> IntervalMDP:
        """The model without balls: the smallest intervals that contain them."""
        return replace(self, center=None, radius=None)

    def states_with_label(self, proposition: str) -> Array:
        """``bool[S]``, the states in which a proposition holds; ValueError for an unknown one."""
        return self.nominal.states_with_label(proposition)

    def states_where(self, condition: str) -> np.ndarray:
        """``bool[S]``, the states that satisfy a Boolean expression of variables, ``"x=3 & y>1"``."""
        return self.nominal.states_where(condition)

    def changed(self, change: Callable[[SparseMDP], SparseMDP]) -> IntervalMDP:
        """The model after a change that drops, repeats or moves entries, but merges none."""
        ends = {name: getattr(self, name) for name in _ENDS}
        return _rewards_to_bounds(
            change(replace(self.nominal, rewards=self.rewards | _bounds_to_rewards(**ends)))
        )


def require_interval(model: Model) -> IntervalMDP:
    """The model; ValueError for one of another kind."""
    if not isinstance(model, IntervalMDP):
        raise ValueError(
            f"{type(model).__name__} has no intervals; give an IntervalMDP, as "
            "make_interval makes it."
        )
    return model


def refuse_ball(model: IntervalMDP, why: str) -> None:
    """Raises ValueError for a model with L1 balls, where only intervals are supported."""
    if model.radius is not None:
        raise ValueError(
            f"the model has a radius, and {why}; give its smallest intervals, "
            "model.box, or ask the solvers that take a radius "
            "(reachability_probability, total_reward, optimal_value, "
            "optimal_satisfaction)."
        )


def _bounds_to_rewards(**ends: Array) -> dict[str, Rewards]:
    """Numbers of entries and rows as rewards, which travel with these."""
    return {
        _PREFIX + name: Rewards(**{"choice" if name == "radius" else "transition": x})
        for name, x in ends.items()
        if x is not None
    }


def _rewards_to_bounds(model: SparseMDP) -> IntervalMDP:
    """The inverse of :func:`_bounds_to_rewards`."""
    own = {name: x for name, x in model.rewards.items() if not name.startswith(_PREFIX)}
    ends = {
        name.removeprefix(_PREFIX): np.asarray(x.choice if x.transition is None else x.transition)
        for name, x in model.rewards.items()
        if name not in own
    }
    return IntervalMDP(replace(model, rewards=own), **ends)


def make_interval(
    model: MDP | SparseMDP,
    lower: Array,
    upper: Array,
    *,
    center: Array | None = None,
    radius: Array | None = None,
) -> IntervalMDP:
    """Interval MDP on the graph of a model, with optional L1 balls.

    Args:
      model: its graph, labels, rewards, names and initial distribution are used, its probabilities
        are not. A successor in the padding of an MDP, with an upper end above 0, counts.
      lower, upper: shaped as ``model.probability``: ``float[T]``, or ``float[S, A, K]``.
      center: of the same shape, a distribution between them in each row.
      radius: ``float[R]`` or ``float[S, A]``, at most 2: the largest L1 distance
        ``sum_t |p_t - center_t|``; default: bounded by the intervals only. For a ball alone give the
        ends 0 and 1.

    Returns:
      :class:`IntervalMDP`, without entries that have probability 0 up to rounding (4e-16 times the
      successors of the row). Row i of a padded state is the i-th of its available actions.

    Raises:
      ValueError: naming the state and the choice: ends that are crossed, negative or above 1, or
        without a distribution between them; an invalid center or radius; only one of both.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> make_interval(coin, [0] * 4, [1] * 4, center=[0.5, 0.5, 1, 1], radius=[0.5, 0, 0]).lower.tolist()
      [0.25, 0.25, 1.0, 1.0]
    """
    if not isinstance(model, MDP | SparseMDP):
        raise ValueError(
            f"{type(model).__name__} takes no intervals; give an MDP or a SparseMDP "
            "(of an interval model, its nominal one)."
        )
    lower, upper = validation.float_array("lower", lower), validation.float_array("upper", upper)
    shape = np.shape(model.probability)
    for name, ends in (("lower", lower), ("upper", upper), ("center", center)):
        if ends is not None and np.shape(ends) != shape:
            raise ValueError(
                f"{name} has shape {np.shape(ends)}; expected {shape}, one for each "
                "probability of the model."
            )
    if isinstance(model, SparseMDP):
        return interval_rows(
            model.row_start,
            model.entry_start,
            model.successor,
            lower,
            upper,
            center=center,
            radius=radius,
            initial=model.initial,
            label=model.label,
            propositions=model.propositions,
            rewards=model.rewards,
            action=model.action,
            action_names=model.action_names,
            valuation=model.valuation,
        )
    available = np.asarray(model.available)
    if radius is not None and np.shape(radius) != available.shape:
        raise ValueError(
            f"radius has shape {np.shape(radius)}; expected {available.shape}, one "
            "for each action of a state."
        )
    used = available[..., None] & ~((lower == 0) & (upper == 0))
    state, action = np.nonzero(available)
    initial = np.asarray(model.initial, np.float64)
    return interval_rows(
        offsets_from_counts(available.sum(-1)),
        offsets_from_counts(used.sum(-1)[state, action]),
        np.asarray(model.successor)[used],
        lower[used],
        upper[used],
        center=None if center is None else np.asarray(center)[used],
        radius=None if radius is None else np.asarray(radius)[available],
        initial=initial / initial.sum(),
        label=np.asarray(model.label),
        propositions=model.propositions,
        action=action,
    )


def interval_rows(
    row_start: Array | None,
    entry_start: Array,
    successor: Array,
    lower: Array,
    upper: Array,
    *,
    center: Array | None = None,
    radius: Array | None = None,
    rewards: Mapping[str, Rewards] | None = None,
    **rest: Any,
) -> IntervalMDP:
    """Validated interval MDP from arrays of sparse rows.

    Repeated successors of a row are merged by summing their ends. Ends that miss a distribution by less
    than 1e-6 are scaled.

    Args:
      row_start, entry_start, successor, rest: as of :func:`~jaxltl.core.models.sparse.make_sparse`.
      lower, upper, center, radius: as of :func:`make_interval`, ``float[T]`` and ``float[R]``.
      rewards: named structures.

    Returns:
      :class:`IntervalMDP`.

    Raises:
      ValueError: as of :func:`make_interval` and :func:`~jaxltl.core.models.sparse.make_sparse`.

    Example:
      >>> rough = interval_rows(
      ...     None, [0, 2, 3, 4], [1, 2, 1, 2], [0.4, 0.3, 1, 1], [0.7, 0.6, 1, 1])
      >>> rough.num_states, rough.upper.tolist()
      (3, [0.7, 0.6, 1.0, 1.0])
    """
    successor = np.asarray(successor)
    lower, upper = validation.float_array("lower", lower), validation.float_array("upper", upper)
    if not lower.shape == upper.shape == successor.shape:
        raise ValueError(
            f"successor has shape {successor.shape}, lower {lower.shape} and upper "
            f"{upper.shape}; all must be [transitions]."
        )
    starts, entry_start = checked_rows(row_start, entry_start, successor.size)
    ball_rows = _ball(center, radius, successor.shape, entry_start.size - 1)
    check_entries(starts, entry_start, successor, np.ones(successor.size))
    if rewards is not None and not isinstance(rewards, Mapping):
        raise ValueError(
            f"rewards is {validation.shorten(rewards)}; give a dict of Rewards by name."
        )
    rows, rewards = _merged(
        _IntervalRows(starts, entry_start, successor, lower, upper, *ball_rows), dict(rewards or {})
    )
    rows = _collapse_empty_rows(_tightened_by_balls(_scaled(rows)))
    ball = None if rows.center is None else Ball(rows.center, rows.radius / 2)
    sets = uncertainty_sets(rows.entry_start, rows.lower, rows.upper, ball)
    # Nature has nothing left to give where lower ends add up to one.
    possible = (rows.upper > 0) & ((rows.lower > 0) | (sets.free_mass > 0)[rows.row])
    nominal = np.where(possible, sets.interior_distributions(possible), 0)
    rewards |= _bounds_to_rewards(**rows.ends)
    return _rewards_to_bounds(
        make_sparse(row_start, rows.entry_start, rows.successor, nominal, rewards=rewards, **rest)
    )


@dataclass(frozen=True)
class _IntervalRows:
    """Rows of interval models under construction."""

    row_start: np.ndarray
    entry_start: np.ndarray
    successor: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    center: Array  # or None, as the radius
    radius: Array

    @cached_property
    def row(self) -> np.ndarray:
        """The row of each entry."""
        return np.repeat(np.arange(self.entry_start.size - 1), np.diff(self.entry_start))

    @property
    def ends(self) -> dict[str, Array]:
        return {name: getattr(self, name) for name in _ENDS}

    @property
    def rounding(self) -> np.ndarray:
        """Bounds on the relative rounding errors of sums over the rows."""
        return (np.diff(self.entry_start) + 2) * np.finfo(np.float64).eps

    def sums(self, x: np.ndarray) -> np.ndarray:
        return np.add.reduceat(x, self.entry_start[:-1])

    def require(self, good: np.ndarray, text: Callable[[int], str], *, entries: bool) -> None:
        """Raises ValueError, naming the choice, unless all rows or entries are good."""
        for i in first_true(~good):
            row = int(self.row[i] if entries else i)
            raise ValueError(f"{placed(self.row_start, row)}: {text(i)}")


def _ball(
    center: Array, radius: Array, entries: tuple[int, ...], num_rows: int
) -> tuple[Array, Array]:
    """Center and radius with checked shapes, or both None."""
    if center is None and radius is None:
        return None, None
    if center is None or radius is None:
        missing = "radius" if center is None else "center"
        raise ValueError(f"{missing} is given alone; a ball has a center and a radius.")
    center = validation.float_array("center", center)
    radius = validation.float_array("radius", radius)
    if center.shape != entries or radius.shape != (num_rows,):
        raise ValueError(
            f"center has shape {center.shape} and radius {radius.shape}; expected "
            f"{entries} and ({num_rows},), one for each transition and each choice."
        )
    return center, radius


def _merged(
    rows: _IntervalRows, rewards: dict[str, Rewards]
) -> tuple[_IntervalRows, dict[str, Rewards]]:
    """Checked ends, with those of repeated successors of a row added up."""
    rows.require(
        (rows.lower >= 0) & (rows.lower <= rows.upper) & (rows.upper <= 1 + ROW_SUM_TOLERANCE),
        lambda e: (
            f"the interval of successor {rows.successor[e]} is [{rows.lower[e]:.9g}, "
            f"{rows.upper[e]:.9g}]; ends must satisfy 0 <= lower <= upper <= 1."
        ),
        entries=True,
    )
    place = rows.row * np.int64(rows.row_start.size) + rows.successor
    if (place[1:] > place[:-1]).all():
        return rows, rewards
    _, first, group = np.unique(place, return_index=True, return_inverse=True)
    for name, reward in rewards.items():
        earned = None if reward.transition is None else np.asarray(reward.transition)
        if earned is None:
            continue
        if earned.shape != place.shape:
            raise ValueError(
                f"reward {name!r} has shape {earned.shape} on its transition part; "
                f"expected {place.shape}."
            )
        if (earned != earned[first][group]).any():
            raise ValueError(
                f"reward {name!r} differs between entries of one row that lead to one state; give "
                "one entry for each state."
            )
        rewards = rewards | {name: replace(reward, transition=earned[first])}
    lower, upper = np.bincount(group, rows.lower), np.bincount(group, rows.upper)
    count = np.bincount(rows.row[first], minlength=rows.entry_start.size - 1)
    merged = _IntervalRows(
        rows.row_start,
        offsets_from_counts(count),
        rows.successor[first],
        lower,
        np.minimum(upper, 1),
        None if rows.center is None else np.bincount(group, rows.center),
        rows.radius,
    )
    return merged, rewards


def _scaled(rows: _IntervalRows) -> _IntervalRows:
    """Ends scaled where they miss a distribution by little."""
    low, high = rows.sums(rows.lower), rows.sums(rows.upper)
    rows.require(
        low <= 1 + ROW_SUM_TOLERANCE,
        lambda r: (
            f"the lower ends sum to {low[r]:.9g}, which is above 1; no distribution lies between them."
        ),
        entries=False,
    )
    rows.require(
        high >= 1 - ROW_SUM_TOLERANCE,
        lambda r: (
            f"the upper ends sum to {high[r]:.9g}, which is below 1; no distribution lies between them."
        ),
        entries=False,
    )
    row, lower, upper = rows.row, rows.lower, rows.upper
    lower = np.where((low > 1 + rows.rounding)[row], lower / np.maximum(low, 1)[row], lower)
    upper = np.where((high < 1 - rows.rounding)[row], upper / np.minimum(high, 1)[row], upper)
    return replace(rows, lower=lower, upper=np.clip(np.maximum(upper, lower), 0, 1))


def _tightened_by_balls(rows: _IntervalRows) -> _IntervalRows:
    """Checked L1 balls, and intervals tightened by them."""
    lower, upper, center, radius = rows.ends.values()
    if center is None:
        return rows
    total, row = rows.sums(center), rows.row
    rows.require(
        (radius >= 0) & (radius < np.inf),
        lambda r: f"the radius is {radius[r]}; it must be a number of at least 0.",
        entries=False,
    )
    rows.require(
        np.abs(total - 1) <= ROW_SUM_TOLERANCE,
        lambda r: f"the center sums to {total[r]:.9g}; it must be a distribution.",
        entries=False,
    )
    rows.require(
        (lower - ROW_SUM_TOLERANCE <= center)
        & (center <= upper + ROW_SUM_TOLERANCE)
        & (center >= 0),
        lambda e: (
            f"the center has {center[e]:.9g} where the interval is [{lower[e]:.9g}, "
            f"{upper[e]:.9g}]; the center must lie between the ends."
        ),
        entries=True,
    )
    center = np.where((np.abs(total - 1) > rows.rounding)[row], center / total[row], center)
    lower, upper, radius = (
        np.minimum(lower, center),
        np.maximum(upper, center),
        np.minimum(radius, 2),
    )
    half = (radius / 2)[row]
    least, greatest = (_outwards(center, side * half, side) for side in (-1, 1))
    least = np.where((half > 0) & (least <= 4 * rows.rounding[row]), 0, least)
    return replace(
        rows,
        lower=np.maximum(lower, least),
        upper=np.minimum(upper, greatest),
        center=center,
        radius=radius,
    )


def _outwards(x: np.ndarray, y: np.ndarray, side: int) -> np.ndarray:
    """``x + y``, rounded down (-1) or up (1)."""
    total, rest = two_sum(x, y)
    return np.where(side * rest > 0, np.nextafter(total, side * np.inf), total)


def _collapse_empty_rows(rows: _IntervalRows) -> _IntervalRows:
    """Ends made equal in rows that hold no distribution because of rounding."""
    # To the upper ends where these sum to less than one, to the lower ones where these sum to more,
    # and to the center of a ball that is farther from all distributions than its radius.
    row, one = rows.row, np.ones(rows.entry_start.size - 1)
    short = row_sums(rows.upper, rows.entry_start, -one) < 0
    full = row_sums(rows.lower, rows.entry_start, -one) > 0
    lower = np.where(short[row], rows.upper, rows.lower)
    upper = np.where(full[row], rows.lower, rows.upper)
    if rows.center is not None and rows.radius is not None:
        apart = row_sums(-rows.center, rows.entry_start, one, -rows.radius / 2) > 0
        lower, upper = (np.where(apart[row], rows.center, x) for x in (lower, upper))
    return replace(rows, lower=lower, upper=upper)
