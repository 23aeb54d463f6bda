"""Multi-objective model checking: achievability, constrained optima and Pareto curves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from jaxltl.core.values.engine.validated import validated
from jaxltl.core.models.protocols import Model
from jaxltl.core.types import Status
from jaxltl.core import validation
from jaxltl.core.values.multi_objective.objectives import Objective
from jaxltl.core.values.engine.state_quantities import TOLERANCE

from jaxltl.core.values.multi_objective.answers import (
    Achievable,
    ConstrainedOptimum,
    Front,
    NearestMixture,
    Pareto,
    impossible,
)
from jaxltl.core.values.multi_objective.front_search import FrontSearch
from jaxltl.core.values.multi_objective.query import bounds_of, multi_objective_query

__all__ = [
    "Achievable",
    "ConstrainedOptimum",
    "Front",
    "NearestMixture",
    "Objective",
    "Pareto",
    "achievable",
    "constrained_optimum",
    "pareto",
]


@validated(host=True)
def achievable(
    model: Model,
    objectives: Sequence[Objective],
    thresholds: Sequence[float | Fraction | None] | None = None,
    *,
    tolerance: float = TOLERANCE,
    max_points: int = 200,
) -> Achievable:
    """Achievability: does one policy, with memory and randomisation, meet all thresholds?

    Each weighted sum adds a point that its policy attains and a half-space that no policy leaves
    (Forejt, Kwiatkowska and Parker 2012). Thresholds are met if a mixture of points meets them, and
    not if a half-space excludes them. On the boundary, small models are decided by a linear program
    in rational arithmetic.

    Args:
      model: a SparseMDP, or any concrete model that :func:`to_sparse` takes.
      objectives: two or more, as of :class:`Objective`.
      thresholds: lower ones for ``"max"``, upper ones for ``"min"``; default the objectives'.
      tolerance: the accuracy of the first sums.
      max_points: maximal number of weighted sums.

    Returns:
      :class:`Achievable`, with the front as evidence. Concrete arrays only; not differentiable.

    Raises:
      ValueError: an invalid objective, or a maximal expected reward that is infinite in a model
        that is too large for fractions.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> both = [Objective(target="a"), Objective(target="b")]
      >>> achievable(model, both, [0.5, 0.5]).holds, achievable(model, both, [0.5, 0.6]).holds
      (True, False)
    """
    _require(model, objectives)
    if thresholds is None:
        thresholds = [o.threshold for o in objectives]
    if len(thresholds) != len(objectives) or not np.isfinite(np.asarray(thresholds, float)).all():
        raise ValueError(
            f"thresholds={list(thresholds)}; give one finite number for each of the "
            f"{len(objectives)} objectives."
        )
    return _achievable(model, objectives, thresholds, tolerance, max_points)


def _achievable(
    model: Model,
    objectives: Sequence[Objective],
    limits: Sequence[float | Fraction | None],
    tolerance: float,
    max_points: int,
) -> Achievable:
    query = multi_objective_query(model, objectives, limits)
    if query.ends is None:
        return Achievable(False, None, None, query.empty_front(), Status.CONVERGED)
    endless = query.infinite_reward()
    if endless is not None:
        answer = query.exact(limits)
        if answer is None:
            raise ValueError(endless)
        return Achievable(answer.holds, None, None, query.empty_front(), Status.CONVERGED)
    search = FrontSearch(query, tolerance)
    wanted = search.thresholds(limits)
    holds, share, normal = search.decide(wanted, max_points)
    if holds is not None:
        return Achievable(holds, share, normal, search.front(), Status.CONVERGED)
    nearest = search.nearest(wanted.hard)
    answer = query.exact(limits) if len(search.solved) < max_points else None
    if answer is None:
        return Achievable(None, None, None, search.front(), Status.PRECISION, nearest)
    share = nearest.share if answer.holds else None
    return Achievable(answer.holds, share, None, search.front(), Status.CONVERGED)


@validated(host=True)
def pareto(
    model: Model, objectives: Sequence[Objective], *, tolerance: float = 1e-4, max_points: int = 200
) -> Pareto:
    """Pareto curve of two or more objectives, up to a tolerance.

    It is that of the policies whose minimised rewards are finite.

    Args:
      model, objectives: as for :func:`achievable`.
      tolerance: the largest distance of a value beyond the mixtures of points.
      max_points: maximal number of weighted sums.

    Returns:
      :class:`Pareto`. Concrete arrays only; not differentiable.

    Raises:
      ValueError: as for :func:`achievable`, for models of any size, or no policy has finite
        minimised rewards.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> both = [Objective(target="a"), Objective(target="b")]
      >>> pareto(model, both).points.tolist()
      [[0.0, 1.0], [1.0, 0.0]]
    """
    _require(model, objectives)
    search = FrontSearch(multi_objective_query(model, objectives), tolerance / 8)
    gap = search.close(tolerance, max_points)
    front = search.front()
    lower, margin = search.lower, search.tolerance * search.scale
    efficient = [
        i
        for i, x in enumerate(lower)
        if not any(
            (y >= x - margin).all() and ((y > x + margin).any() or j < i)
            for j, y in enumerate(lower)
        )
    ]
    points = front.points[efficient]
    status = Status.CONVERGED if gap <= tolerance else Status.MAX_STEPS
    return Pareto(points[np.lexsort(points.T[::-1])], front, gap, status)


def _require(model: Model, objectives: Sequence[Objective]) -> None:
    if hasattr(model, "nominal"):
        raise ValueError(
            "several objectives at once are not solved for where probabilities are "
            "intervals; ask for one at a time, by optimal_satisfaction or "
            "total_reward, or give model.nominal, which is one choice of "
            "nature."
        )
    for i, each in enumerate(validation.sequence("objectives", objectives)):
        if not isinstance(each, Objective):
            raise ValueError(f"objectives[{i}] is {validation.shorten(each)}; give an Objective.")


@validated(host=True)
def constrained_optimum(
    model: Model,
    objectives: Sequence[Objective],
    *,
    tolerance: float = TOLERANCE,
    max_points: int = 200,
) -> ConstrainedOptimum:
    """The optimum of one objective among the policies that meet the thresholds of all others.

    Args:
      model, objectives, max_points: as for :func:`achievable`; one objective has no threshold.
      tolerance: the width of the bounds, relative where the value exceeds one.

    Returns:
      :class:`ConstrainedOptimum`, with the front as evidence. Concrete arrays only; not differentiable.

    Raises:
      ValueError: none or several objectives without a threshold; or as for :func:`achievable`.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> query = [Objective(target="a"), Objective(target="b", threshold=0.4)]
      >>> best = constrained_optimum(model, query)
      >>> round(best.value, 6), best.holds
      (0.6, True)
    """
    _require(model, objectives)
    free = [i for i, o in enumerate(objectives) if o.threshold is None]
    if len(free) != 1:
        raise ValueError(
            f"{len(free)} of {len(objectives)} objectives have no threshold; give one to all but one of "
            "them. With thresholds for all ask achievable, without any pareto."
        )
    return _optimum(model, objectives, free[0], tolerance, max_points)


def _optimum(
    model: Model, objectives: Sequence[Objective], index: int, tolerance: float, max_points: int
) -> ConstrainedOptimum:
    """The optimum of one objective, infinite if no policy with a finite value meets the thresholds."""
    limits = [o.threshold for o in objectives]
    query = multi_objective_query(model, objectives, limits)
    endless = query.infinite_reward()
    front = query.empty_front()
    if endless is not None:
        answer = query.exact(limits, index)
        if answer is None:
            raise ValueError(endless)
        if answer.holds:
            value = math.inf if answer.value is None else float(answer.value)
            bounds = bounds_of(answer.value)
            return ConstrainedOptimum(value, *bounds, True, None, front, Status.CONVERGED)
    elif query.ends is not None:
        optimum = FrontSearch(query, tolerance).best(index, limits, max_points)
        if optimum.holds is not False:
            return optimum
        front = optimum.front
    if query.parts[index].kind != "cost":
        return impossible(front)
    # Other policies may meet the thresholds, with an infinite value.
    kept = [i for i in range(len(objectives)) if i != index]
    if not kept:
        return ConstrainedOptimum(math.inf, math.inf, math.inf, True, None, front, Status.CONVERGED)
    rest = _achievable(
        model, [objectives[i] for i in kept], [limits[i] for i in kept], tolerance, max_points
    )
    if rest.holds is False:
        return impossible(front)
    front = rest.front.with_unknown(kept, len(objectives))
    return ConstrainedOptimum(
        math.inf, math.inf, math.inf, rest.holds, rest.share, front, rest.status
    )
