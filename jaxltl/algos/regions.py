"""Boxes of parameters in which a model has a property, or does not: proven, not sampled.

Over a box every probability has a range. The interval model of these ranges, in which nature picks
anew at each step, contains the model at every point of the box (parameter lifting, Quatmann,
Dehnert, Jansen, Junges and Katoen 2016), so that its certified values enclose all of theirs. Where
they do not decide, the box is split.

Example: a coin that shows heads with a probability p, of which at least half is asked for.

  >>> import pathlib, tempfile
  >>> import jaxltl as jl
  >>> from jaxltl.algos import feasible
  >>> from jaxltl.algos.regions import enclose, prove_around, prove_regions
  >>> path = pathlib.Path(tempfile.mkdtemp()) / "coin.drn"
  >>> _ = path.write_text("@type: DTMC\\n@parameters\\np\\n@nr_states\\n3\\n@model\\n"
  ...     "state 0 init\\n\\taction 0\\n\\t\\t1 : p\\n\\t\\t2 : 1-p\\n"
  ...     "state 1 goal\\n\\taction 0\\n\\t\\t1 : 1\\nstate 2\\n\\taction 0\\n\\t\\t2 : 1\\n")
  >>> coin = feasible.make_problem(jl.io.read_parametric(path).over(0.01, 0.99), "goal", bound=">=")
  >>> [round(x, 6) for x in enclose(coin, 0.25, 0.75)]
  [0.25, 0.75]
  >>> found = prove_regions(coin, 0.5, max_boxes=31)
  >>> found.share(1) > 0.45, found.share(-1) > 0.45, found.share(0) < 0.1
  (True, True, True)
  >>> low, high = prove_around(coin, 0.5, [0.75])
  >>> low.shape, 0.5 <= low.item() < 0.55 and 0.95 < high.item() <= 0.99
  ((1,), True)
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxltl.core.models.interval import IntervalMDP, make_interval
from jaxltl.core.models.parametric.parametric import box_of
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.interval import reachability as interval_values
from jaxltl.core import validation
from jaxltl.core.values.undiscounted.mixture import safe_ends

ACCEPTED, REJECTED, OPEN = 1, -1, 0
Problem = Any  # as jaxltl.algos.feasible.make_problem makes it


@brief
@dataclass(frozen=True)
class Regions:
    """Boxes that cover a box.

    Attributes:
      low, high: ``float64[N, D]``.
      lower, upper: ``float64[N]``, what encloses the value in each of them.
      verdict: ``int8[N]``: 1 where it is past the threshold at every point, -1 where it is at none,
        0 where nothing was decided.

    Example:
      >>> halves = Regions(np.array([[0.0], [0.5]]), np.array([[0.5], [1.0]]), np.array([0.0, 0.5]),
      ...                  np.array([0.5, 1.0]), np.array([-1, 1], np.int8))
      >>> halves.share(1)
      0.5
    """

    low: np.ndarray
    high: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    verdict: np.ndarray

    def share(self, verdict: int) -> float:
        """The share of the whole volume that boxes of a verdict take."""
        volume = np.prod(self.high - self.low, axis=1)
        return float(volume[self.verdict == verdict].sum() / volume.sum())


def enclose(problem: Problem, low: Any = None, high: Any = None) -> tuple[float, float]:
    """Bounds of the value at every point of a box.

    Args:
      problem: made by :func:`~jaxltl.algos.feasible.make_problem`, of a model that was read by
        :func:`~jaxltl.io.parametric.read_parametric`.
      low, high: a number for all parameters, one for each name, or ``float[D]``; default the
        problem's box.

    Returns:
      No point of the box has a value below the first or above the second number.

    Raises:
      ValueError: the box is none, or reaches out of the problem's or below 0; the model is of
        functions whose ranges are not known.

    Concrete arrays only, on the host; not differentiable.
    """
    low, high = _box(problem, low, high)
    model = problem.model
    if not hasattr(model.numbers, "ranges"):
        raise ValueError(
            "the ranges of this model's functions over a box are not known; regions "
            "are proven for models that read_parametric reads."
        )
    ends, rewards = model.numbers.ranges(low, high)
    interval = make_interval(model.model, ends.lower, ends.upper)
    reward = None if problem.reward is None else rewards[problem.reward]
    least, most = (_value(problem, interval, reward, large) for large in (False, True))
    return least[0], most[1]


def _box(problem: Problem, low: Any, high: Any) -> tuple[np.ndarray, np.ndarray]:
    _require_problem(problem)
    model = problem.model
    low, high = (whole if x is None else x for x, whole in ((low, model.low), (high, model.high)))
    low, high = box_of(low, high, model.parameters)
    out = (low < model.low) | (high > model.high)
    if out.any():
        d = int(np.flatnonzero(out)[0])
        raise ValueError(
            f"the box [{low[d]:.6g}, {high[d]:.6g}] of {model.parameters[d]} reaches out of the "
            f"problem's, [{model.low[d]:.6g}, {model.high[d]:.6g}]."
        )
    return low, high


def _value(problem: Problem, model: IntervalMDP, reward: Any, large: bool) -> tuple[float, float]:
    """Bounds of the mean over the initial distribution, with nature making it large or small."""
    maximize = problem.objective == "max"
    depth = problem.model.roundings
    if problem.reward is None:
        found = interval_values.reachability(
            model.host,
            problem.target,
            maximize=maximize,
            helpful=large,
            stay=problem.stay,
            depth=depth,
        )
    else:
        earned = reward.upper if large else np.maximum(reward.lower, 0)
        found = interval_values.total_reward(
            model.host, earned, problem.target, maximize=maximize, large=large, depth=depth
        )
    return safe_ends(model, found, highest=1.0 if problem.reward is None else np.inf)


def verdict_of(problem: Problem, threshold: float, lower: float, upper: float) -> int:
    """Whether all values between bounds are past a threshold (1), or none (-1), or neither (0).

    Args:
      problem: which side of the threshold is asked for.
      threshold: the number.
      lower, upper: bounds on all values.

    Returns:
      1, -1 or 0.

    Example:
      >>> from types import SimpleNamespace
      >>> asked = SimpleNamespace(bound=">=")
      >>> [verdict_of(asked, 0.5, *bounds) for bounds in ((0.6, 0.7), (0.1, 0.2), (0.4, 0.6))]
      [1, -1, 0]
    """
    if problem.bound == ">=":
        return ACCEPTED if lower >= threshold else REJECTED if upper < threshold else OPEN
    return ACCEPTED if upper <= threshold else REJECTED if lower > threshold else OPEN


def prove_regions(
    problem: Problem,
    threshold: float,
    *,
    low: Any = None,
    high: Any = None,
    max_boxes: int = 1000,
) -> Regions:
    """A box split into boxes that are accepted, rejected, or left open.

    The largest open box is split next, across its side that is the longest as a share of the whole.

    Args:
      problem, low, high: as of :func:`enclose`.
      threshold: the value shall be past it, on the side that the problem says.
      max_boxes: how many boxes to look at.

    Returns:
      :class:`Regions`.

    Raises:
      ValueError: as :func:`enclose`; the threshold is NaN, or `max_boxes` below 1.

    Concrete arrays only, on the host; not differentiable.
    """
    threshold, max_boxes = _limit(threshold), validation.integer("max_boxes", max_boxes, least=1)
    low, high = _box(problem, low, high)
    size = np.where(high > low, high - low, 1.0)
    todo, done, looked = deque([(low, high)]), [], 0
    while todo and looked < max_boxes:
        box = todo.popleft()
        looked += 1
        bounds = enclose(problem, *box)
        verdict = verdict_of(problem, threshold, *bounds)
        widths = (box[1] - box[0]) / size
        if verdict != OPEN or looked + len(todo) + 2 > max_boxes or not widths.any():
            done.append((*box, *bounds, verdict))
            continue
        d = int(widths.argmax())
        middle = (box[0][d] + box[1][d]) / 2
        for side in (0, 1):
            half = [x.copy() for x in box]
            half[1 - side][d] = middle
            todo.append((half[0], half[1]))
    lows, highs, lower, upper, verdicts = (np.array(x) for x in zip(*done, strict=True))
    return Regions(lows, highs, lower, upper, verdicts.astype(np.int8))


def _require_problem(problem: Any) -> None:
    if not all(hasattr(problem, name) for name in ("model", "objective", "bound")):
        raise ValueError(
            f"problem is {validation.shorten(problem)}; give what feasible.make_problem returns."
        )


def _limit(threshold: Any) -> float:
    """A number, which may be infinite."""
    found = validation.float_array("threshold", threshold)
    if found.ndim or np.isnan(found):
        what = (
            "the threshold is NaN"
            if not found.ndim
            else f"threshold={validation.shorten(threshold)}"
        )
        raise ValueError(f"{what}; give a number.")
    return float(found)


def prove_around(
    problem: Problem, threshold: float, point: Any, *, num_halvings: int = 12
) -> tuple[np.ndarray, np.ndarray] | None:
    """A box around a point, as large as bisection finds, that is accepted as a whole.

    Its sides are the same share of the problem's box, as far as that reaches.

    Args:
      problem, threshold: as of :func:`prove_regions`.
      point: ``float[D]`` in the problem's box, such as a feasible one.
      num_halvings: of the share.

    Returns:
      Its ends, ``float64[D]`` both; None if not even the smallest one that was tried is accepted.

    Raises:
      ValueError: as :func:`prove_regions`; the point is not in the box.

    Concrete arrays only, on the host; not differentiable.
    """
    _require_problem(problem)
    threshold, num_halvings = (
        _limit(threshold),
        validation.integer("num_halvings", num_halvings, most=1000),
    )
    model = problem.model
    (point,) = model.inside_of("point", validation.float_array("point", point)[None])
    sides = model.high - model.low
    found, share, move = None, 1.0, 0.5
    for _ in range(num_halvings):
        low = np.maximum(point - share * sides, model.low)
        high = np.minimum(point + share * sides, model.high)
        if verdict_of(problem, threshold, *enclose(problem, low, high)) == ACCEPTED:
            found = low, high
            if share == 1.0:
                break
            share += move
        else:
            share -= move
        move /= 2
    return found
