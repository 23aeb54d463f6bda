"""Simultaneous confidence sets of transition probabilities from counts.

A row (state and action) has an interval for each outcome, or an L1 ball around the frequencies of
its samples. A union bound makes all of them hold together.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.pretty_print import brief
from jaxltl.core.statistics.binomial import (
    Ends,
    anytime,
    around,
    clopper_pearson,
    frequency,
    hoeffding,
)
from jaxltl.core.validation import Range

Method = Literal["clopper-pearson", "hoeffding", "weissman", "anytime"]

_ENDS: dict[str, Callable[[Integers, Integers, float], Ends]] = {
    "clopper-pearson": clopper_pearson,
    "hoeffding": hoeffding,
    "anytime": anytime,
}
_EPS = float(np.finfo(np.float64).eps)
_LIMIT = 2**53  # throws of a row, up to which doubles count


@brief
@dataclass(frozen=True)
class ConfidenceSets:
    """Confidence sets of all rows, simultaneously valid with probability `confidence`.

    Attributes:
      lower, upper: ``float64[T]`` or ``float64[..., K]`` as the counts, ends of intervals; 0 at
        entries that are no successors. Of a ball, the smallest intervals around it.
      center: of the same shape, the frequencies; equal in a row without samples.
      radius: ``float64[R]`` or ``float64[...]``, the ball ``sum_t |p_t - center_t| <= radius`` of
        the method of Weissman et al.; None for the others.
      rest: of each row, an upper bound of the probability of unlisted outcomes.
      num_samples: of each row, ``int64``.
      num_claims: M, the number of claims that share the failure probability ``1 - confidence``.
      confidence, method: the arguments.

    >>> import jaxltl as jl
    >>> found = jl.statistics.intervals_from_counts([[90, 10]], confidence=0.95)
    >>> found.num_samples.tolist(), bool((found.lower[0] < [0.9, 0.1]).all())
    ([100], True)
    """

    lower: Floats
    upper: Floats
    center: Floats
    radius: Floats | None
    rest: Floats
    num_samples: Integers
    num_claims: int
    confidence: float
    method: Method


def intervals_from_counts(
    counts: ArrayLike,
    confidence: float,
    *,
    method: Method = "clopper-pearson",
    entry_start: ArrayLike | None = None,
    used: ArrayLike | None = None,
    rows: ArrayLike | None = None,
    num_outcomes: ArrayLike | None = None,
    num_claims: int | None = None,
) -> ConfidenceSets:
    """Confidence sets of the probabilities of all rows, simultaneously valid.

    The failure probability ``1 - confidence`` is shared equally by M claims (union bound). A row
    of J possible outcomes makes none if J is 1, one if J is 2 or for ``"weissman"``, and else J.
    ``"weissman"`` is the ball ``sum_t |p_t - k_t / n| <= sqrt(2 / n log((2^J - 2) M / (1 -
    confidence)))`` (Weissman et al. 2003, theorem 2.1); the others are intervals of
    :mod:`~jaxltl.core.statistics.binomial`. All but ``"anytime"`` require that the number of samples
    of a row does not depend on outcomes, as with a simulator; in an agent's log it does.

    Args:
      counts: observed successors, integers: ``[..., K]``, or ``[T]`` by rows with `entry_start`.
      confidence: in (0, 1).
      method: of the intervals.
      entry_start: ``int[R + 1]``, the first entry of each row of ``counts[T]``.
      used: ``bool[..., K]``, entries of a padded table that are successors; default: all.
      rows: ``bool[R]`` or ``bool[...]``, rows that make claims; the others have [0, 1]. It must not
        depend on outcomes: for a policy learned from the same data, it must be all rows.
      num_outcomes: J, an integer or one for each row: possible outcomes, listed or not; all S
        states for an unknown graph. Default: those listed. Unlisted ones share `rest`.
      num_claims: M, at least as many as these rows make (the default). Where data decided which
        rows there are, it must have been fixed before, for example ``S * A * S``.

    Returns:
      The sets, rounded outwards.

    Raises:
      ValueError: naming the argument, the row and the entry: `confidence` is not in (0, 1), counts
        are not nonnegative integers at successors, shapes do not fit, or a row lists more than
        `num_outcomes`.

    >>> sets = intervals_from_counts([[8, 2, 0], [5, 5, 0]], 0.9,
    ...                              used=[[True, True, True], [True, True, False]])
    >>> sets.num_claims, sets.lower.round(3).tolist(), sets.upper.round(3).tolist()
    (4, [[0.401, 0.017, 0.0], [0.159, 0.159, 0.0]], [[0.983, 0.599, 0.355], [0.841, 0.841, 0.0]])
    """
    validation.choice("method", method, get_args(Method))
    check_confidence(confidence)
    count, listed, is_entry = _entries(counts, entry_start, used)
    row = np.repeat(np.arange(listed.size), listed)
    shape = (listed.size,) if entry_start is not None else is_entry.shape[:-1]
    outcomes = _outcomes(num_outcomes, listed, shape)
    claimed = _claimed(rows, shape)
    total = np.bincount(row, count, listed.size).astype(np.int64)
    if (total >= _LIMIT).any():
        raise ValueError(
            f"{_name(int(np.argmax(total)), shape)} was thrown {total.max()} times; at most 2^53 "
            "are counted."
        )
    by_row = method == "weissman"
    claims = np.where((outcomes > 2) & ~np.array(by_row), outcomes, outcomes > 1)
    num_claims = _claims(num_claims, int(claims[claimed].sum()))
    failure = (1 - confidence) / max(num_claims, 1)
    center = np.where(total[row] > 0, frequency(count, total[row]), 1 / np.maximum(listed, 1)[row])
    radius = None
    if by_row:
        radius = np.where(claimed, l1_radius(total, outcomes, failure), 2.0 * (outcomes > 1))
        lower, upper = around(center, (radius / 2)[row])
        rest = radius / 2
    else:
        lower, upper = _ENDS[method](count, total[row], failure)
        rest = _ENDS[method](np.zeros_like(total), total, failure)[1] * (outcomes - listed)
    known = (outcomes == 1)[row]
    unknown = (~claimed & (outcomes > 1))[row]
    lower = np.where(known, 1.0, np.where(unknown, 0.0, lower))
    upper = np.where(known | unknown, 1.0, upper)
    remaining = 1 - np.bincount(row, lower, listed.size) + (listed + 2) * _EPS
    rest = np.minimum(np.where(claimed, rest * (1 + 4 * _EPS), 1), np.clip(remaining, 0, 1))
    return ConfidenceSets(
        lower=_as_given(lower, is_entry),
        upper=_as_given(upper, is_entry),
        center=_as_given(center, is_entry),
        radius=None if radius is None else radius.reshape(shape),
        rest=np.where(outcomes > listed, rest, 0.0).reshape(shape),
        num_samples=total.reshape(shape),
        num_claims=num_claims,
        confidence=float(confidence),
        method=method,
    )


def l1_radius(total: Integers, num_outcomes: Integers, failure: float) -> Floats:
    """L1 radius ``sqrt(2 / n log((2^J - 2) / failure))`` (Weissman et al. 2003), at most 2."""
    many = np.maximum(num_outcomes, 2)
    with np.errstate(divide="ignore"):
        log_events = many * np.log(2) + np.log1p(-np.exp2(1.0 - many))
        radius = np.sqrt(2 * (log_events - np.log(failure)) / np.asarray(total))
    radius = np.minimum(radius * (1 + 32 * _EPS) + 8 * _EPS, 2)
    return np.where(np.asarray(num_outcomes) > 1, radius, 0.0)


def samples_needed(
    width: float,
    confidence: float,
    *,
    method: Method = "clopper-pearson",
    num_claims: int = 1,
    num_outcomes: int = 2,
) -> int:
    """Number of samples of a row after which even the widest interval has at most a given width."""
    validation.choice("method", method, get_args(Method))
    check_confidence(confidence)
    if not 0 < validation.finite_number("width", width) < 1:
        raise ValueError(f"width={width}; it must lie strictly between 0 and 1.")
    num_claims = validation.integer("num_claims", num_claims, least=1)
    num_outcomes = validation.integer("num_outcomes", num_outcomes, least=2)
    failure = (1 - confidence) / num_claims

    def widest(total: int) -> float:
        half, whole = np.array([total // 2]), np.array([total])
        if method == "weissman":
            radius = l1_radius(whole, np.asarray(num_outcomes), failure)
            lower, upper = around(frequency(half, whole), radius / 2)
        else:
            lower, upper = _ENDS[method](half, whole, failure)
        return float(upper[0] - lower[0])

    low, high = 0, 1
    while widest(high) > width:
        low, high = high, 2 * high
        if high >= _LIMIT:
            raise ValueError(f"width={width} takes more than 2^53 throws of a row; ask for less.")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if widest(middle) > width else (low, middle)
    return high


# --- arguments --------------------------------------------------------------------------------


def check_confidence(confidence: float) -> None:
    """Raises a ValueError unless a confidence is a number strictly between 0 and 1."""
    array = np.asarray(confidence)
    if array.ndim or array.dtype.kind not in "fiu" or not 0 < array < 1:  # NaN is not
        raise ValueError(
            f"confidence={confidence!r}; it must lie strictly between 0 and 1, such as 0.95."
        )


def _entries(
    counts: ArrayLike, entry_start: ArrayLike | None, used: ArrayLike | None
) -> tuple[Integers, Integers, Booleans]:
    """Counts of listed successors, their number per row, and their mask."""
    counts = np.asarray(counts)
    if entry_start is not None:
        start: Any = np.asarray(entry_start)
        if used is not None:
            raise ValueError(
                "entry_start and used are both given; counts are either by rows, with "
                "entry_start, or padded, with used."
            )
        if (
            counts.ndim != 1
            or start.ndim != 1
            or not start.size
            or start[0] != 0
            or (start[-1] != counts.size)
            or (start[1:] < start[:-1]).any()
        ):
            raise ValueError(
                f"counts has shape {counts.shape}; entry_start must ascend from 0 to "
                "the number of its entries."
            )
        is_entry = np.ones(counts.size, bool)
        listed = np.diff(start.astype(np.int64))
    else:
        if not counts.ndim:
            raise ValueError("counts is a number; give [..., K], or [T] with entry_start.")
        is_entry = np.ones(counts.shape, bool) if used is None else np.asarray(used, bool)
        if is_entry.shape != counts.shape:
            raise ValueError(
                f"used has shape {is_entry.shape}, and counts {counts.shape}; they must agree."
            )
        listed = is_entry.sum(-1).reshape(-1)
    whole = counts
    if not np.issubdtype(counts.dtype, np.integer):
        with np.errstate(invalid="ignore"):
            whole = counts.astype(np.int64)
    bad = (whole != counts) | (counts < 0) | (counts >= _LIMIT) | (~is_entry & (counts != 0))
    if bad.any():
        place = tuple(int(i) for i in np.argwhere(bad)[0])
        if not is_entry[place]:
            raise ValueError(
                f"counts{list(place)} is {counts[place]}, at an entry that is no "
                "successor; correct the count, or the graph."
            )
        raise ValueError(
            f"counts{list(place)} is {counts[place]}; counts are integers from 0 to 2^53."
        )
    return whole[is_entry].astype(np.int64), listed, is_entry


def _outcomes(num_outcomes: ArrayLike | None, listed: Integers, shape: tuple[int, ...]) -> Integers:
    if num_outcomes is None:
        return listed
    counts = np.asarray(num_outcomes)
    if counts.shape not in ((), shape) or not np.issubdtype(counts.dtype, np.integer):
        raise ValueError(
            f"num_outcomes is {counts.dtype}{list(counts.shape)}; expected an integer, "
            f"or integers {list(shape)}."
        )
    outcomes = np.broadcast_to(counts, shape).reshape(-1).astype(np.int64)
    if (outcomes < listed).any():
        row = int(np.argmax(outcomes < listed))
        raise ValueError(
            f"{_name(row, shape)} lists {listed[row]} successors, more than its "
            f"num_outcomes, {outcomes[row]}."
        )
    return outcomes


def _claims(num_claims: int | None, required: int) -> int:
    if num_claims is None:
        return required
    number = validation.integer("num_claims", num_claims)
    if number < required:
        raise ValueError(
            f"num_claims={num_claims}; the rows make {required}, and no fewer can be counted."
        )
    return number


def _name(row: int, shape: tuple[int, ...]) -> str:
    """A row, for messages."""
    place = [int(i) for i in np.unravel_index(row, shape)]
    return f"state {place[0]}, action {place[1]}" if len(place) == 2 else f"row {place}"


def _claimed(rows: ArrayLike | None, shape: tuple[int, ...]) -> Booleans:
    if rows is None:
        return np.ones(int(np.prod(shape)), bool)
    rows = np.asarray(rows)
    if rows.shape != shape or rows.dtype != bool:
        raise ValueError(
            f"rows is {rows.dtype}{list(rows.shape)}; expected bool{list(shape)}, "
            "which rows matter."
        )
    return rows.reshape(-1)


def _as_given(entries: Floats, is_entry: Booleans) -> Floats:
    entries_table = np.zeros(is_entry.shape)
    entries_table[is_entry] = entries
    return entries_table


# --- assumptions on the graph ------------------------------------------------------------------


@brief
@dataclass(frozen=True)
class LeastProbability:
    """The assumption that no possible transition is less likely than a given probability.

    At most ``1 / value`` transitions leave a choice. Each of them is unobserved in n samples with
    probability at most ``(1 - value) ** n``, so that with enough samples all are observed, except
    with probability `failure` for all choices together.

    Attributes:
      value: the least probability of a possible transition, in (0, 1].
      failure: the probability that the graph is wrong in spite of the assumption.

    >>> LeastProbability(0.05, failure=0.01).sufficient_samples(num_choices=10)
    195
    """

    value: float
    failure: float = 0.005

    def __post_init__(self) -> None:
        validation.require_in_range("value", self.value, Range(0, 1, open_below=True))
        validation.require_in_range(
            "failure", self.failure, Range(0, 1, open_below=True, open_above=True)
        )

    def sufficient_samples(self, num_choices: int) -> int:
        """Number of samples of a choice by which all its transitions have been observed."""
        if self.value > 0.5:  # at most one transition
            return 1
        share = self.failure * self.value / max(num_choices, 1)
        return math.ceil(math.log(share) / math.log1p(-self.value)) + 1


Graph: TypeAlias = Literal["given", "seen", "complete"] | LeastProbability
_STATES = "there are no states but those that the log names"
_DESCRIPTION = {
    "given": "only transitions of the given model are possible",
    "seen": "only transitions that the log contains are possible",
    "complete": _STATES,
}


def require_graph(graph: object, known: tuple[str, ...] = ("given", "seen", "complete")) -> None:
    """Raises ValueError unless `graph` is a :class:`LeastProbability` or one of some words."""
    if not isinstance(graph, LeastProbability):
        validation.choice("graph", graph, known)


def describe_graph(graph: Graph) -> str:
    """The assumption in words, to be printed with every guarantee."""
    if isinstance(graph, LeastProbability):
        return f"no possible transition is less likely than {graph.value:g}, and {_STATES}"
    return _DESCRIPTION[graph]
