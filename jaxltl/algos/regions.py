"""Region verification of parametric Markov models by parameter lifting.

The interval model of the ranges of all probabilities over a box, with nature free at each step,
contains the model at every point of the box (Quatmann, Dehnert, Jansen, Junges and Katoen 2016), so
that its certified bounds enclose the values at all points. Undecided boxes are split.

Example: a coin with parameter p, and the threshold 1/2 for heads.

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
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core import validation
from jaxltl.core.models.interval import IntervalMDP, make_interval
from jaxltl.core.models.parametric import ParametricMDP, box_of
from jaxltl.core.models.protocols import Array
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.interval.reachability import reachability
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.total_reward import total_reward
from jaxltl.core.values.engine.state_quantities import safe_ends

ACCEPTED, REJECTED, OPEN = 1, -1, 0
Point = NDArray[np.float64]
Corner = float | Mapping[str, float] | ArrayLike | None


class Problem(Protocol):
    """A threshold question about a parametric model, as ``feasible.make_problem`` returns it.

    >>> from types import SimpleNamespace
    >>> question: Problem = SimpleNamespace(model=None, bound=">=", objective="max")
    """

    model: ParametricMDP
    target: NDArray[np.bool_]
    stay: NDArray[np.bool_] | None
    reward: str | None
    objective: str
    bound: str

    @property
    def highest(self) -> float:
        """The trivial upper bound of the value."""


@brief
@dataclass(frozen=True)
class Regions:
    """A partition of a box into accepted, rejected and open boxes.

    Attributes:
      low, high: ``float64[N, D]``, corners of the boxes.
      lower, upper: ``float64[N]``, certified bounds of the value over each box.
      verdict: ``int8[N]``: 1 if every point meets the threshold, -1 if none does, 0 if undecided.

    >>> Regions(np.zeros((1, 1)), np.ones((1, 1)), np.zeros(1), np.ones(1), np.ones(1)).share(1)
    1.0
    """

    low: np.ndarray
    high: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    verdict: np.ndarray

    def share(self, verdict: int) -> float:
        """The share of boxes with a verdict in the total volume."""
        volume = np.prod(self.high - self.low, axis=1)
        return float(volume[self.verdict == verdict].sum() / volume.sum())


def enclose(problem: Problem, low: Corner = None, high: Corner = None) -> tuple[float, float]:
    """The certified lower and upper bound of the values at all points of a box; on the host.

    Args:
      problem: of :func:`~jaxltl.algos.feasible.make_problem`, with a model read by
        :func:`~jaxltl.io.drn.parametric.read_parametric`.
      low, high: a number for all parameters, one for each name, or ``float[D]``; default the
        problem's box.

    Raises:
      ValueError: the box is empty or not contained in the problem's, or the ranges of the model's
        functions are unknown.
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
    least, largest = (_bounds(problem, interval, reward, large) for large in (False, True))
    return least[0], largest[1]


def _box(problem: Problem, low: Corner, high: Corner) -> tuple[Point, Point]:
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


def _bounds(
    problem: Problem, model: IntervalMDP, reward: Array, large: bool
) -> tuple[float, float]:
    """Bounds of the mean over the initial distribution with maximising or minimising nature."""
    query = Query(problem.objective == "max", large, depth=problem.model.roundings)
    if problem.reward is None:
        enclosure = reachability(model.host, problem.target, query, stay=problem.stay)
    else:
        earned = reward.upper if large else np.maximum(reward.lower, 0)
        enclosure = total_reward(model.host, earned, problem.target, query)
    return safe_ends(model, enclosure, highest=problem.highest)


def verdict_of(problem: Problem, threshold: float, lower: float, upper: float) -> int:
    """The verdict of a `problem` for values between `lower` and `upper` bounds.

    ``ACCEPTED`` (1) if all of them meet the `threshold`, ``REJECTED`` (-1) if none does, else
    ``OPEN`` (0).

    >>> from types import SimpleNamespace
    >>> verdict_of(SimpleNamespace(bound=">="), 0.5, 0.6, 0.7)
    1
    """
    if problem.bound == ">=":
        return ACCEPTED if lower >= threshold else REJECTED if upper < threshold else OPEN
    return ACCEPTED if upper <= threshold else REJECTED if lower > threshold else OPEN


def prove_regions(
    problem: Problem,
    threshold: float,
    *,
    low: Corner = None,
    high: Corner = None,
    max_boxes: int = 1000,
) -> Regions:
    """The :class:`Regions` of a box by iterated bisection of the largest open box; on the host.

    The longest side, relative to the whole box, is bisected, until `max_boxes` are examined. `problem`,
    `low` and `high` are as for :func:`enclose`, and `threshold` is on the side of ``problem.bound``.

    Raises:
      ValueError: as :func:`enclose`, the threshold is NaN, or `max_boxes` below 1.
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


def _require_problem(problem: object) -> None:
    if not all(hasattr(problem, name) for name in ("model", "objective", "bound")):
        raise ValueError(
            f"problem is {validation.shorten(problem)}; give what feasible.make_problem returns."
        )


def _limit(threshold: ArrayLike) -> float:
    """A threshold, which may be infinite."""
    number = validation.float_array("threshold", threshold)
    if number.ndim or np.isnan(number):
        place = (
            f"threshold={validation.shorten(threshold)}" if number.ndim else "the threshold is NaN"
        )
        raise ValueError(f"{place}; give a number.")
    return float(number)


def prove_around(
    problem: Problem, threshold: float, point: ArrayLike, *, num_halvings: int = 12
) -> tuple[Point, Point] | None:
    """The corners ``float64[D]`` of the largest accepted box around a `point`; on the host.

    By `num_halvings` bisections of its size; None if the smallest examined box is not accepted. All
    sides are the same share of the problem's box, clipped to it. `problem` and `threshold` are as for
    :func:`prove_regions`, and `point` is ``float[D]``, such as a feasible one.

    Raises:
      ValueError: as :func:`prove_regions`, or the point is not in the box.
    """
    _require_problem(problem)
    threshold, num_halvings = (
        _limit(threshold),
        validation.integer("num_halvings", num_halvings, limit=1000),
    )
    model = problem.model
    (point,) = model.valid_points("point", validation.float_array("point", point)[None])
    sides = model.high - model.low
    box, share, move = None, 1.0, 0.5
    for _ in range(num_halvings):
        low = np.maximum(point - share * sides, model.low)
        high = np.minimum(point + share * sides, model.high)
        if verdict_of(problem, threshold, *enclose(problem, low, high)) == ACCEPTED:
            box = low, high
            if share == 1.0:
                break
            share += move
        else:
            share -= move
        move /= 2
    return box
