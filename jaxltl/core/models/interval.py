"""Interval MDPs: uncertainty sets of intervals and L1 balls."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxltl.core import struct, validation

from jaxltl.core.models import facts
from jaxltl.core.pretty_print import brief, number, readable, value_range
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.protocols import Model
from jaxltl.core.models.sparse import (
    Array,
    Rewards,
    SparseMDP,
    check_entries,
    checked_starts,
    make_sparse,
    placed,
)
from jaxltl.core.sparse.interval.l1_ball import Ball
from jaxltl.core.sparse.interval.row_table import row_sums
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP, uncertainty_sets
from jaxltl.core.sparse.rows import offsets_from_counts

NEAR = 1e-6  # how far a row may miss a distribution and still be scaled to one
# Names under which numbers of entries travel with the entries, and radii with the rows.
_ENTRIES = {"lower": "\0lower", "upper": "\0upper", "center": "\0center"}
_RADIUS = "\0radius"


def _facts(model: IntervalMDP) -> Iterator[str]:
    yield from facts.sparse(model.nominal)
    low, high = readable(model.lower), readable(model.upper)
    if low is not None and high is not None and low.size:
        yield f"intervals at most {number(float((high - low).max()))} wide"
    if model.radius is not None:
        yield f"radius {value_range(model.radius)}"


@brief(facts=_facts)
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

    @property
    def num_rows(self) -> int:
        """R, the choices of all states."""
        return self.nominal.num_rows

    @property
    def num_transitions(self) -> int:
        """T, the entries of all choices."""
        return self.nominal.num_transitions

    @property
    def is_chain(self) -> bool:
        """True if every state has one choice."""
        return self.nominal.is_chain

    @property
    def state_shape(self) -> tuple[int, ...]:
        """The shape of a value: ``(S,)``."""
        return self.nominal.state_shape

    @property
    def dtype(self) -> np.dtype:
        """The dtype of the nominal probabilities."""
        return self.nominal.dtype

    @property
    def initial(self) -> Array:
        """``float[S]``, the initial distribution."""
        return self.nominal.initial

    @property
    def label(self) -> Array:
        """``bool[S, P]``, the propositions that hold in each state."""
        return self.nominal.label

    @property
    def propositions(self) -> tuple[str, ...]:
        """The P names."""
        return self.nominal.propositions

    @property
    def rewards(self) -> dict[str, Rewards]:
        """Named :class:`~jaxltl.core.models.sparse.Rewards`."""
        return self.nominal.rewards

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
        ends = _travelling(self.lower, self.upper, self.center, self.radius)
        return _taken_apart(change(self.nominal.replace(rewards=self.rewards | ends)))  # type: ignore[attr-defined]


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
            "(reachability_probability, total_reward, robust_discounted_value, "
            "optimal_satisfaction)."
        )


def _travelling(lower: Array, upper: Array, center: Array, radius: Array) -> dict[str, Rewards]:
    found = {
        _ENTRIES["lower"]: Rewards(transition=lower),
        _ENTRIES["upper"]: Rewards(transition=upper),
    }
    if radius is None:
        return found
    return found | {_ENTRIES["center"]: Rewards(transition=center), _RADIUS: Rewards(choice=radius)}


def _taken_apart(model: SparseMDP) -> IntervalMDP:
    rewards, ball = dict(model.rewards), {}
    if _RADIUS in rewards:
        ball = {"radius": np.asarray(rewards.pop(_RADIUS).choice)}
    ends = {
        name: np.asarray(rewards.pop(key).transition)
        for name, key in _ENTRIES.items()
        if key in rewards
    }
    nominal = model.replace(rewards=rewards)  # type: ignore[attr-defined]
    return IntervalMDP(nominal=nominal, **ends, **ball)


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
    entry_start, successor = np.asarray(entry_start), np.asarray(successor)
    lower, upper = validation.float_array("lower", lower), validation.float_array("upper", upper)
    ball = _ball(center, radius, successor.shape, entry_start.size - 1)
    if not lower.shape == upper.shape == successor.shape:
        raise ValueError(
            f"successor has shape {successor.shape}, lower {lower.shape} and upper "
            f"{upper.shape}; all must be [transitions]."
        )
    entry_start = checked_starts("entry_start", entry_start, successor.size, "transitions")
    num_rows = entry_start.size - 1
    starts = checked_starts(
        "row_start",
        np.arange(num_rows + 1) if row_start is None else row_start,
        num_rows,
        "choices",
    )
    if starts.size < 2:
        raise ValueError("the model has no state; it needs at least one.")
    check_entries(starts, entry_start, successor, np.ones(successor.size))
    row = np.repeat(np.arange(num_rows), np.diff(entry_start))
    _check_ends(starts, row, successor, lower, upper)
    if rewards is not None and not isinstance(rewards, Mapping):
        raise ValueError(
            f"rewards is {validation.shorten(rewards)}; give a dict of Rewards by name."
        )
    rewards = {} if rewards is None else dict(rewards)
    place = row * np.int64(starts.size) + successor.astype(np.int64)
    if not (place[1:] > place[:-1]).all() and np.unique(place).size < place.size:
        every = [lower, upper] if ball is None else [lower, upper, ball[0]]
        row, successor, every, rewards = _merged(row, successor, every, rewards)
        entry_start = offsets_from_counts(np.bincount(row, minlength=entry_start.size - 1))
        lower, upper = every[:2]
        ball = None if ball is None else (every[2], ball[1])
    lower, upper = _scaled(starts, entry_start, row, lower, upper)
    if ball is not None:
        _check_ball(_Intervals(starts, entry_start, row, lower, upper), *ball)
        lower, upper, ball = _around(entry_start, row, lower, upper, *ball)
    lower, upper = _pointed(entry_start, row, lower, upper, ball)
    ends = uncertainty_sets(
        entry_start, lower, upper, None if ball is None else Ball(ball[0], ball[1] / 2)
    )
    # Nature has nothing left to give where lower ends add up to one.
    possible = (upper > 0) & ((lower > 0) | (ends.free_mass > 0)[row])
    nominal = np.where(possible, ends.interior_distributions(possible), 0)
    extra = _travelling(lower, upper, *(ball or (None, None)))
    return _taken_apart(
        make_sparse(row_start, entry_start, successor, nominal, rewards=rewards | extra, **rest)
    )


def _ball(
    center: Array, radius: Array, entries: tuple[int, ...], num_rows: int
) -> tuple[np.ndarray, np.ndarray] | None:
    """Center and radius with checked shapes, or None."""
    if center is None and radius is None:
        return None
    if center is None or radius is None:
        given = "radius" if center is None else "center"
        raise ValueError(f"{given} is given alone; a ball has a center and a radius.")
    center, radius = (
        validation.float_array("center", center),
        validation.float_array("radius", radius),
    )
    if center.shape != entries or radius.shape != (num_rows,):
        raise ValueError(
            f"center has shape {center.shape} and radius {radius.shape}; expected "
            f"{entries} and ({num_rows},), one for each transition and each choice."
        )
    return center, radius


@dataclass(frozen=True)
class _Intervals:
    row_start: np.ndarray
    entry_start: np.ndarray
    row: np.ndarray  # of each entry
    lower: np.ndarray
    upper: np.ndarray


def _check_ball(intervals: _Intervals, center: np.ndarray, radius: np.ndarray) -> None:
    row_start, entry_start, row = intervals.row_start, intervals.entry_start, intervals.row
    lower, upper = intervals.lower, intervals.upper
    total = np.add.reduceat(center, entry_start[:-1])
    bad = ~((radius >= 0) & (radius < np.inf))
    if bad.any():
        r = int(np.argmax(bad))
        raise ValueError(
            f"{placed(row_start, r)}: the radius is {radius[r]}; it must be a number of at least 0."
        )
    bad = ~(np.abs(total - 1) <= NEAR)
    if bad.any():
        r = int(np.argmax(bad))
        raise ValueError(
            f"{placed(row_start, r)}: the center sums to {total[r]:.9g}; it must be a distribution."
        )
    bad = ~((lower - NEAR <= center) & (center <= upper + NEAR) & (center >= 0))
    if bad.any():
        e = int(np.argmax(bad))
        raise ValueError(
            f"{placed(row_start, int(row[e]))}: the center has {center[e]:.9g} where the interval "
            f"is [{lower[e]:.9g}, {upper[e]:.9g}]; the center must lie between the ends."
        )


def _around(
    entry_start: np.ndarray,
    row: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    center: np.ndarray,
    radius: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Intervals tightened by the L1 ball, and the ball."""
    total = np.add.reduceat(center, entry_start[:-1])
    rounding = (np.diff(entry_start) + 2) * np.finfo(np.float64).eps
    center = np.where((np.abs(total - 1) > rounding)[row], center / total[row], center)
    lower, upper = np.minimum(lower, center), np.maximum(upper, center)
    radius = np.minimum(radius, 2)
    half = (radius / 2)[row]
    least, most = (_outwards(center, side * half, side) for side in (-1, 1))
    least = np.where((half > 0) & (least <= 4 * rounding[row]), 0, least)
    return np.maximum(lower, least), np.minimum(upper, most), (center, radius)


def _outwards(x: np.ndarray, y: np.ndarray, side: int) -> np.ndarray:
    """``x + y``, rounded down (-1) or up (1)."""
    total = x + y
    part = total - x
    off = (x - (total - part)) + (y - part)
    result: np.ndarray = np.where(side * off > 0, np.nextafter(total, side * np.inf), total)
    return result


def _pointed(
    entry_start: np.ndarray,
    row: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
    ball: tuple[np.ndarray, np.ndarray] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Ends made equal in rows that hold no distribution because of rounding."""
    # To the upper ends where these sum to less than one, to the lower ones where these sum to more,
    # and to the center of a ball that is farther from all distributions than its radius.
    one = np.ones(entry_start.size - 1)
    short = row_sums(upper, entry_start, -one) < 0
    full = row_sums(lower, entry_start, -one) > 0
    lower, upper = np.where(short[row], upper, lower), np.where(full[row], lower, upper)
    if ball is not None:
        center, radius = ball
        apart = row_sums(-center, entry_start, one, -radius / 2) > 0
        lower, upper = (np.where(apart[row], center, x) for x in (lower, upper))
    return lower, upper


def _check_ends(
    row_start: np.ndarray,
    row: np.ndarray,
    successor: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> None:
    bad = ~((lower >= 0) & (lower <= upper) & (upper <= 1 + NEAR))
    if bad.any():
        e = int(np.flatnonzero(bad)[0])
        raise ValueError(
            f"{placed(row_start, int(row[e]))}: the interval of successor {successor[e]} is "
            f"[{lower[e]:.9g}, {upper[e]:.9g}]; ends must satisfy 0 <= lower <= upper <= 1."
        )


def _scaled(
    row_start: np.ndarray,
    entry_start: np.ndarray,
    row: np.ndarray,
    lower: np.ndarray,
    upper: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    low, high = (np.add.reduceat(x, entry_start[:-1]) for x in (lower, upper))
    rounding = (np.diff(entry_start) + 2) * np.finfo(np.float64).eps  # of a row sum
    bad = (low > 1 + NEAR) | (high < 1 - NEAR)
    if bad.any():
        r = int(np.flatnonzero(bad)[0])
        what = f"the upper ends sum to {high[r]:.9g}, which is below 1"
        if low[r] > 1:
            what = f"the lower ends sum to {low[r]:.9g}, which is above 1"
        raise ValueError(f"{placed(row_start, r)}: {what}; no distribution lies between them.")
    lower = np.where((low > 1 + rounding)[row], lower / np.maximum(low, 1)[row], lower)
    upper = np.where((high < 1 - rounding)[row], upper / np.minimum(high, 1)[row], upper)
    return lower, np.clip(np.maximum(upper, lower), 0, 1)


def _merged(
    row: np.ndarray, successor: np.ndarray, numbers: list[np.ndarray], rewards: dict[str, Rewards]
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], dict[str, Rewards]]:
    """Merges repeated successors of a row by summing their ends."""
    order = np.lexsort((successor, row))
    row, successor = row[order], successor[order]
    new = np.append(True, (row[1:] != row[:-1]) | (successor[1:] != successor[:-1]))
    start = np.flatnonzero(new)
    for name, reward in rewards.items():
        if reward.transition is None:
            continue
        earned = np.asarray(reward.transition)
        if earned.shape != order.shape:
            raise ValueError(
                f"reward {name!r} has shape {earned.shape} on its transition part; "
                f"expected {order.shape}."
            )
        earned = earned[order]
        if (np.maximum.reduceat(earned, start) != np.minimum.reduceat(earned, start)).any():
            raise ValueError(
                f"reward {name!r} differs between entries of one row that lead to one state; give "
                "one entry for each state."
            )
        rewards = rewards | {
            name: reward.replace(  # type: ignore[attr-defined]
                transition=earned[start]
            )
        }
    lower, upper, *rest = (np.add.reduceat(x[order], start) for x in numbers)
    return row[start], successor[start], [lower, np.minimum(upper, 1), *rest], rewards
