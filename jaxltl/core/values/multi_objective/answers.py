"""Answers to multi-objective queries, with their evidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.product import SparseProduct
from jaxltl.core.types import Status


@brief
class Front(NamedTuple):
    """Points that policies attain and half-spaces that none leaves, for n objectives.

    Attributes:
      points: ``float64[N, n]``, values of policies from the initial distribution.
      lower, upper: ``float64[N, n]``, their certified bounds.
      normals, bounds: ``float64[K, n]``, ``[K]``: every policy has ``normals @ value <= bounds``
        (a minimised objective has a negative normal). Rewards that were left out because they are
        infinite have points of infinity and normals of zero.
      policies: for each point the weights of the product's rows, ``float64[R']``.
      product: the model with the memory of the objectives; rows are the model's `base_row`.

    Example:
      >>> from jaxltl.core.values.multi_objective.multi_objective import Objective, pareto
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> both = [Objective(target="a"), Objective(target="b")]
      >>> front = pareto(model, both).front
      >>> front.points.tolist(), bool((front.normals @ front.points.T <= front.bounds[:, None]).all())
      ([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]], True)
    """

    points: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    normals: np.ndarray
    bounds: np.ndarray
    policies: tuple[np.ndarray, ...]
    product: SparseProduct

    def with_unknown(self, known: Sequence[int], size: int) -> Front:
        """The front among more objectives, of which all but the known ones have any value."""

        def column(array: np.ndarray, other: float) -> np.ndarray:
            wide = np.full((len(array), size), other)
            wide[:, known] = array
            return wide

        return self._replace(
            points=column(self.points, np.inf),
            lower=column(self.lower, 0.0),
            upper=column(self.upper, np.inf),
            normals=column(self.normals, 0.0),
        )


@brief
class NearestMixture(NamedTuple):
    """Mixture of policies nearest to thresholds that are neither met nor excluded.

    Attributes:
      share: the probabilities with which the front's policies are drawn initially.
      lower, upper: ``float64[n]``, certified bounds of its values.
      gap: ``float64[n]``, a bound on how far it misses each threshold.

    Example:
      >>> from jaxltl.core.values.multi_objective.multi_objective import Objective, achievable
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> both = [Objective(target="a"), Objective(target="b")]
      >>> unknown = achievable(model, both, [0.5, 0.6], max_points=2)
      >>> unknown.holds, unknown.nearest.lower.round(6).tolist()
      (None, [0.45, 0.55])
    """

    share: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    gap: np.ndarray


@brief
class Achievable(NamedTuple):
    """Answer to an achievability query.

    Attributes:
      holds: True, False, or None if unknown.
      share: if True, the probabilities with which the front's policies are drawn initially. On the
        boundary their mixture meets the thresholds up to rounding. None if a reward is infinite.
      normal: if False, the number of a half-space of the front that excludes the thresholds; None
        if the graph or rational arithmetic excludes them.
      front: the evidence.
      status: CONVERGED if known.
      nearest: if unknown, the mixture of policies nearest to the thresholds.

    Example:
      >>> from jaxltl.core.values.multi_objective.multi_objective import Objective, achievable
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> both = [Objective(target="a"), Objective(target="b")]
      >>> found = achievable(model, both, [0.5, 0.5])
      >>> found.holds, found.share.round(6).tolist()
      (True, [0.5, 0.5])
      >>> refused = achievable(model, both, [0.5, 0.6])
      >>> refused.holds, refused.front.normals[refused.normal].tolist()  # a + b is at most 1
      (False, [0.5, 0.5])
    """

    holds: bool | None
    share: np.ndarray | None
    normal: int | None
    front: Front
    status: Status
    nearest: NearestMixture | None = None


@brief
class ConstrainedOptimum(NamedTuple):
    """Optimal value of one objective under thresholds on the others.

    Attributes:
      value, lower, upper: the value and its certified bounds; NaN if the thresholds cannot be met,
        infinity if no policy that meets them has a finite minimised reward.
        If that is unknown, they hold provided that they can; one bound is infinite.
      holds: True if the thresholds can be met; None if unknown.
      share: initial probabilities of the front's policies that attain the safe bound, or None.
      front: the evidence.
      status: CONVERGED if the bounds are narrow, or the thresholds cannot be met.
      nearest: if `holds` is unknown, the best of the mixtures nearest to the thresholds.

    Example:
      >>> from jaxltl.core.values.multi_objective.multi_objective import Objective, constrained_optimum
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> both = [Objective(target="a"), Objective(target="b", threshold=0.25)]
      >>> best = constrained_optimum(model, both)
      >>> round(best.lower, 6), round(best.upper, 6), best.status.name
      (0.75, 0.75, 'CONVERGED')
    """

    value: float
    lower: float
    upper: float
    holds: bool | None
    share: np.ndarray | None
    front: Front
    status: Status
    nearest: NearestMixture | None = None


@brief
class Pareto(NamedTuple):
    """Pareto curve: values that no policy improves in one objective without loss in another.

    Attributes:
      points: ``float64[V, n]``, attained points of the curve; so are their mixtures.
      front: all points and half-spaces, with bounds.
      gap: a bound on the distance of values beyond the mixtures, in each objective relative to its
        largest size (absolute for probabilities).
      status: CONVERGED if the gap is at most the tolerance.

    Example:
      >>> from jaxltl.core.values.multi_objective.multi_objective import Objective, pareto
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> both = [Objective(target="a"), Objective(target="b")]
      >>> curve = pareto(model, both)
      >>> curve.points.tolist(), curve.gap < 1e-4
      ([[0.0, 1.0], [1.0, 0.0]], True)
    """

    points: np.ndarray
    front: Front
    gap: float
    status: Status


def impossible(front: Front) -> ConstrainedOptimum:
    """The answer if the thresholds cannot be met."""
    nan = float("nan")
    return ConstrainedOptimum(nan, nan, nan, False, None, front, Status.CONVERGED)
