"""Several objectives at once: what can be had together, and the curve of what cannot be bettered.

All is solved on the host, in double precision. A point is what some policy attains, proven by its
own chain; a half-space is what no policy exceeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.values.engine.validated import validated
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.multi_objective import pareto_front as frontier
from jaxltl.core.sparse.multi_objective.weighted_sum import (
    FinalComponents,
    WeightedProblem,
    final_components,
    weighted_optimum,
)
from jaxltl.core.sparse.product import SparseProduct
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.types import Status
from jaxltl.core import validation
from jaxltl.core.values.engine.host_solution import induced_chain
from jaxltl.core.values.multi_objective.objectives import Objective, Part, weighted_problem
from jaxltl.core.values.undiscounted.sparse_satisfaction import sparse_mdp_of_product
from jaxltl.core.values.undiscounted.step_bounded import TOLERANCE

__all__ = [
    "Achievable",
    "ConstrainedOptimum",
    "Front",
    "NearestMixture",
    "Objective",
    "Pareto",
    "achievable",
    "multi_objective",
    "pareto",
]

_SHARPEST = 1e-12  # to which sums are solved where the border is near


@brief
class Front(NamedTuple):
    """What is known of n objectives.

    Attributes:
      points: ``float64[N, n]``, values that policies attain, from the initial distribution.
      lower, upper: ``float64[N, n]``, certified bounds on these.
      normals, bounds: ``float64[K, n]``, ``[K]``: for every policy, ``normals @ value <= bounds``
        (an objective to be made small has a negative normal).
      policies: for each point ``float64[R']``, the weights of the product's rows.
      product: the model beside what the objectives remember; rows are the model's `base_row`.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> front = pareto(model, [Objective(target="a"), Objective(target="b")]).front
      >>> front.points.tolist(), len(front.policies)
      ([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]], 3)
      >>> bool((front.normals @ front.points.T <= front.bounds[:, None]).all())
      True
    """

    points: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    normals: np.ndarray
    bounds: np.ndarray
    policies: tuple[np.ndarray, ...]
    product: SparseProduct


@brief
class NearestMixture(NamedTuple):
    """What is attained nearest to thresholds of which it is not known whether they can be met.

    Attributes:
      share: the probabilities with which the front's policies are drawn at the start.
      lower, upper: ``float64[n]``, certified bounds on what that attains.
      gap: ``float64[n]``, how far it may miss each threshold at most.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> both = [Objective(target="a"), Objective(target="b")]
      >>> open_yet = achievable(model, both, [0.5, 0.6], max_points=2)  # two sums do not tell
      >>> open_yet.holds, open_yet.nearest.lower.round(6).tolist()
      (None, [0.45, 0.55])
    """

    share: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    gap: np.ndarray


@brief
class Achievable(NamedTuple):
    """Whether thresholds can be met together.

    Attributes:
      holds: True, False, or None where the bounds do not tell.
      share: of True, the probabilities with which the front's policies are drawn at the start.
      normal: of False, a half-space of the front that leaves the thresholds out; its number.
      front: the evidence.
      status: CONVERGED if it is known.
      nearest: of None, the mixture of policies that comes nearest to the thresholds.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> both = [Objective(target="a"), Objective(target="b")]
      >>> found = achievable(model, both, [0.5, 0.5])
      >>> found.holds, found.share.round(6).tolist()  # of the front's two policies
      (True, [0.5, 0.5])
      >>> refused = achievable(model, both, [0.5, 0.6])
      >>> refused.holds, refused.front.normals[refused.normal].tolist()  # a + b is 1 at most
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
    """The best value of one objective when others meet thresholds.

    Attributes:
      value, lower, upper: the value and its certified bounds; NaN where thresholds cannot be met.
        Where that is not known they are what the value is if they can be; one bound is infinite.
      holds: whether the thresholds can be met; None where the bounds do not tell.
      share: the probabilities with which the front's policies are drawn at the start, by which the
        bound on the safe side is attained; None where there is none.
      front: the evidence.
      status: CONVERGED if the bounds are narrow, or the thresholds are known not to be met.
      nearest: where it is not known whether thresholds can be met, the best mixture of policies
        among those that come nearest to them.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> both = [Objective(target="a"), Objective(target="b", threshold=0.25)]
      >>> best = multi_objective(model, both)
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
    """The curve of values of which none can be bettered without another one's loss.

    Attributes:
      points: ``float64[V, n]``, the attained points of the curve; their mixtures are attained too.
      front: all that is known, with bounds.
      gap: how far beyond the mixtures a value can be at most, in each objective, as a share of
        its largest size (absolute for probabilities).
      status: CONVERGED if the gap is as small as asked.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> curve = pareto(model, [Objective(target="a"), Objective(target="b")])
      >>> curve.points.tolist(), curve.gap < 1e-4
      ([[0.0, 1.0], [1.0, 0.0]], True)
    """

    points: np.ndarray
    front: Front
    gap: float
    status: Status


@validated()
def achievable(
    model: Any,
    objectives: Sequence[Objective],
    thresholds: Sequence[float] | None = None,
    *,
    tolerance: float = TOLERANCE,
    max_points: int = 200,
) -> Achievable:
    """Whether one policy can meet thresholds on several objectives at once.

    A policy may remember and may draw lots. Weighted sums are solved in turn: each attains a point,
    and bounds a half-space that no policy leaves (Forejt, Kwiatkowska and Parker 2012). Thresholds
    are met if a mixture of points meets them, and not if a half-space leaves them out. Near to the
    border sums are solved again, more exactly, down to rounding.

    Args:
      model: a SparseMDP, or any concrete model that :func:`to_sparse` takes.
      objectives: two or more, as of :class:`Objective`.
      thresholds: at least that for ``"max"``, at most that for ``"min"``; default the objectives'.
      tolerance: how exactly sums are solved at first.
      max_points: weighted sums at most.

    Returns:
      :class:`Achievable`, with the front that shows it.

    Raises:
      ValueError: an objective's name, reward or shape, or an expected reward that is infinite.

    Concrete arrays only, on the host; not differentiable.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label=[[0, 0], [1, 0], [0, 1]],
      ...                     propositions=["a", "b"])
      >>> both = [Objective(target="a"), Objective(target="b")]
      >>> achievable(model, both, [0.5, 0.5]).holds, achievable(model, both, [0.5, 0.6]).holds
      (True, False)
    """
    _require(model, objectives)
    if thresholds is None:
        thresholds = [np.nan if o.threshold is None else o.threshold for o in objectives]
    if len(thresholds) != len(objectives) or not np.isfinite(np.asarray(thresholds, float)).all():
        raise ValueError(
            f"thresholds={list(thresholds)}; give one finite number for each of the "
            f"{len(objectives)} objectives."
        )
    search = _Search(model, objectives, tolerance)
    wanted = search.signs * np.asarray(thresholds, np.float64)
    holds, share, normal = search.decide(wanted, max_points)
    if holds is None:
        return Achievable(
            None, None, None, search.front(), Status.PRECISION, search.nearest(wanted)
        )
    return Achievable(holds, share, normal, search.front(), Status.CONVERGED)


@validated()
def pareto(
    model: Any, objectives: Sequence[Objective], *, tolerance: float = 1e-4, max_points: int = 200
) -> Pareto:
    """The Pareto curve of two or more objectives, up to a tolerance.

    Args:
      model, objectives: as for :func:`achievable`.
      tolerance: how far the curve may be beyond the mixtures of points.
      max_points: weighted sums at most.

    Returns:
      :class:`Pareto`; CONVERGED if nothing lies farther beyond its points' mixtures than
      `tolerance`.

    Raises:
      ValueError: as for :func:`achievable`.

    Concrete arrays only, on the host; not differentiable.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label=[[0, 0], [1, 0], [0, 1]],
      ...                     propositions=["a", "b"])
      >>> pareto(model, [Objective(target="a"), Objective(target="b")]).points.tolist()
      [[0.0, 1.0], [1.0, 0.0]]
    """
    _require(model, objectives)
    search = _Search(model, objectives, tolerance / 8)
    gap = search.close(tolerance, max_points)
    front = search.front()
    lower, near = np.stack(search.lower), search.tolerance * search.scale
    kept = [
        i
        for i, x in enumerate(lower)
        if not any(
            (y >= x - near).all() and ((y > x + near).any() or j < i) for j, y in enumerate(lower)
        )
    ]
    points = front.points[kept]
    status = Status.CONVERGED if gap <= tolerance else Status.MAX_STEPS
    return Pareto(points[np.lexsort(points.T[::-1])], front, gap, status)


def _require(model: Any, objectives: Sequence[Objective]) -> None:
    if hasattr(model, "nominal"):
        raise ValueError(
            "several objectives at once are not solved for where probabilities are "
            "intervals; ask for one at a time, by robust_satisfaction or "
            "total_reward, or give model.nominal, which is one choice of "
            "nature."
        )
    for i, each in enumerate(validation.sequence("objectives", objectives)):
        if not isinstance(each, Objective):
            raise ValueError(f"objectives[{i}] is {validation.shorten(each)}; give an Objective.")


@validated()
def multi_objective(
    model: Any,
    objectives: Sequence[Objective],
    *,
    tolerance: float = TOLERANCE,
    max_points: int = 200,
) -> Achievable | ConstrainedOptimum | Pareto:
    """Several objectives, some with thresholds, as in ``multi(...)`` of PRISM and Storm.

    Args:
      model, objectives: as for :func:`achievable`. Those with a threshold must meet it. If one
        has none it is optimised; if two or more have none, none may have one.
      tolerance: width asked for, as a share of the value where that exceeds one.
      max_points: weighted sums at most.

    Returns:
      :class:`Achievable` where all have thresholds, :class:`ConstrainedOptimum` where one has
      none, and :class:`Pareto` where none has.

    Raises:
      ValueError: some but not all of several objectives without a threshold; or as for
        :func:`achievable`.

    Concrete arrays only, on the host; not differentiable.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                     initial=[1, 0, 0], label={"a": [1], "b": [2]})
      >>> one, other = Objective(target="a"), Objective(target="b", threshold=0.4)
      >>> best = multi_objective(model, [one, other])  # as often a as b has at least 0.4
      >>> round(best.value, 6), best.holds
      (0.6, True)
      >>> multi_objective(model, [one, Objective(target="b")]).points.tolist()
      [[0.0, 1.0], [1.0, 0.0]]
    """
    _require(model, objectives)
    free = [i for i, o in enumerate(objectives) if o.threshold is None]
    if not free:
        return achievable(model, objectives, tolerance=tolerance, max_points=max_points)
    if len(free) > 1:
        if len(free) < len(objectives):
            raise ValueError(
                f"{len(free)} of {len(objectives)} objectives have no threshold; give one to all "
                "but one of them (the best value), to all (achievability) or to none (the curve)."
            )
        return pareto(model, objectives, tolerance=max(tolerance, 1e-6), max_points=max_points)
    search = _Search(model, objectives, tolerance)
    wanted = np.array(
        [
            -np.inf if o.threshold is None else s * o.threshold
            for o, s in zip(objectives, search.signs, strict=True)
        ]
    )
    return search.best(free[0], wanted, max_points)


def nearest_mixture(
    front: Front, share: np.ndarray, thresholds: np.ndarray, signs: np.ndarray
) -> NearestMixture:
    """What a mixture of a front's policies attains, and misses of thresholds.

    Args:
      front: the front.
      share: ``float64[N]``, the mixture.
      thresholds: ``float64[n]``, infinite where nothing is asked.
      signs: ``int[n]``, 1 of objectives to be made large, -1 of others.
    """
    used = share > 0
    lower = frontier.mixture(front.lower[used], share[used])
    upper = -frontier.mixture(-front.upper[used], share[used])
    missed = signs * (thresholds - np.where(signs > 0, lower, upper))
    return NearestMixture(share, lower, upper, np.maximum(missed, 0))


class _Search:
    """Points and half-spaces that are known, and what asks for more of them.

    Inside, every objective is to be made large: `signs` are -1 for those to be made small.
    """

    def __init__(self, model: Any, objectives: Sequence[Objective], tolerance: float) -> None:
        self.model: SparseMDP = to_sparse(model)
        if not objectives:
            raise ValueError("there is no objective; give at least one.")
        self.parts: list[Part]
        self.sums: WeightedProblem
        self.sums, self.parts, self.product = weighted_problem(self.model, objectives)
        where = final_components(self.sums)
        if where is None:
            names = " and ".join(str(p.number + 1) for p in self.parts if p.kind == "cost")
            raise ValueError(
                f"the expected reward of objective {names or 1} is infinite under every policy: "
                "what it counts goes on for ever, or its target is not reached almost surely."
            )
        self.where: FinalComponents = where
        self._require_finite()
        self.signs = np.array([p.sign for p in self.parts])
        self.tolerance = tolerance
        self.values: list[np.ndarray] = []
        self.lower: list[np.ndarray] = []
        self.upper: list[np.ndarray] = []
        self.normals: list[np.ndarray] = []
        self.bounds: list[float] = []
        self.exactness: list[float] = []  # the tolerance by which each sum was solved
        self.policies: list[np.ndarray] = []
        size = len(self.parts)
        self.scale = np.ones(size)
        for i in range(size):
            self.ask(np.eye(size)[i])
        self._rescale()

    def _require_finite(self) -> None:
        mdp = self.sums.mdp
        circles = end_components(mdp, rows=self.where.rows).inside
        everywhere = end_components(mdp).inside
        for part in self.parts:
            if part.kind != "gain":
                continue
            earns = (circles & (self.sums.gain[part.place] > 0)).any()
            if earns or (part.open is not None and (everywhere & part.open[mdp.state]).any()):
                why = (
                    "reward is earned for ever in an end component"
                    if earns
                    else "some policy does not reach its target"
                )
                raise ValueError(
                    f"the largest expected reward of objective {part.number + 1} is infinite: "
                    f"{why}; make it small, or take that end component out of the model."
                )

    def _rescale(self) -> None:
        reach = np.abs(np.stack(self.lower)).max(0)
        self.scale = np.array(
            [
                1.0 if p.kind == "sure" or not x > 0 else x
                for p, x in zip(self.parts, reach, strict=True)
            ]
        )

    def ask(self, normal: np.ndarray) -> None:
        """Solves a weighted sum, and adds its point and its half-space."""
        weights: dict[str, np.ndarray] = {
            "sure": np.zeros(len(self.sums.priority)),
            "gain": np.zeros(len(self.sums.gain)),
            "cost": np.zeros(len(self.sums.cost)),
        }
        for part, w in zip(self.parts, normal, strict=True):
            weights[part.kind][part.place] = w
        found = weighted_optimum(
            self.sums,
            self.where,
            weights["sure"],
            weights["gain"],
            weights["cost"],
            self.tolerance / 4 * float((normal * self.scale).sum()),
        )
        # A probability to be made small is one minus the one that was made large.
        shift = sum(
            w for p, w in zip(self.parts, normal, strict=True) if p.kind == "sure" and p.sign < 0
        )
        value, lower, upper = self.evaluate(found.weight, found.home)
        self.values.append(value)
        self.lower.append(lower)
        self.upper.append(upper)
        self.policies.append(found.weight)
        self.normals.append(np.array(normal))
        self.exactness.append(self.tolerance)
        self.bounds.append(found.bound - shift + 1e-15 * (abs(found.bound) + shift))

    def evaluate(
        self, weight: np.ndarray, home: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What a policy attains, with bounds, all to be made large."""
        sums, sparse = self.sums, sparse_mdp_of_product(self.product)
        chain = induced_chain(sparse, sparse, weight)
        inside = (weight > 0) & home[sums.mdp.state]
        component = end_components(sums.mdp, rows=inside).component
        found = []
        for part in self.parts:
            if part.kind == "sure":
                level, leader = sums.priority[part.place], component[sums.mdp.state[inside]]
                least = np.full(home.size, np.iinfo(np.int64).max)
                np.minimum.at(least, leader, level[inside])
                good = home & (least[component] % 2 == 0)
                x = optimal.reachability(
                    chain.mdp, good, maximize=True, tolerance=self.tolerance / 8, depth=chain.depth
                )
            else:
                rows = (sums.gain if part.kind == "gain" else sums.cost)[part.place]
                earned = chain.mean(rows, sums.mdp.row_start)
                x = optimal.total_reward(
                    chain.mdp,
                    earned,
                    home,
                    maximize=False,
                    tolerance=self.tolerance / 8,
                    depth=chain.depth,
                )
            found.append(self._expected(part, x))
        return tuple(np.array(x) for x in zip(*found, strict=True))  # type: ignore[return-value]

    def _expected(self, part: Part, found: Any) -> tuple[float, float, float]:
        """Of the initial distribution: value, lower and upper bound."""
        first = np.flatnonzero(self.sums.start)
        share = self.sums.start[first]
        slack = 1e-15 * (first.size + 2)
        value, low, high = (
            float(share @ x[first]) for x in (found.value, found.lower, found.upper)
        )
        exact = low == high and (first.size == 1 or (part.kind == "sure" and low in (0, 1)))
        if not exact:
            low, high = low - slack * abs(low), high + slack * abs(high)
        if part.kind == "sure":
            low, high = max(low, 0.0), min(high, 1.0)
        if part.sign > 0:
            return value, low, high
        if part.kind == "cost":
            return -value, -high, -low
        # The policy made the opposite event's probability large.
        return (value - 1, *((low - 1, high - 1) if exact else (low - 1 - 1e-16, high - 1 + 1e-16)))

    def front(self) -> Front:
        values, lower, upper = (
            np.stack(x) * self.signs for x in (self.values, self.lower, self.upper)
        )
        lower, upper = np.minimum(lower, upper), np.maximum(lower, upper)
        values, lower, upper = (x + 0.0 for x in (values, lower, upper))
        return Front(
            values,
            lower,
            upper,
            np.stack(self.normals) * self.signs,
            np.array(self.bounds),
            tuple(self.policies),
            self.product,
        )

    def decide(
        self, wanted: np.ndarray, max_points: int
    ) -> tuple[bool | None, np.ndarray | None, int | None]:
        """Whether a vector is attained, by which mixture, or which half-space leaves it out."""
        looked = 0
        while True:
            for k in range(looked, len(self.normals)):
                if frontier.exceeds(self.normals[k], self.bounds[k], wanted):
                    return False, None, k
            looked = len(self.normals)
            lower = np.stack(self.lower)
            for i in np.flatnonzero((lower >= wanted).all(1)):
                return True, np.eye(len(lower))[int(i)], None
            apart = frontier.separation(lower, wanted, self.scale)
            for share in (apart.share, frontier.plain(apart.share)):
                if frontier.meets(lower, share, wanted):
                    return True, share, None
            if looked >= max_points or not self.ask_anew(apart.normal):
                return None, None, None

    def ask_anew(self, normal: np.ndarray) -> bool:
        """Solves a weighted sum, more exactly where it was solved; False where that cannot be."""
        while self._known(normal):
            if self.tolerance <= _SHARPEST:
                return False
            self.tolerance = max(self.tolerance / 1000, _SHARPEST)
        self.ask(normal)
        return True

    def _known(self, normal: np.ndarray) -> bool:
        """Whether a weighted sum was solved as exactly already, but for rounding."""
        size = normal * self.scale
        return any(
            np.abs(size / size.sum() - x * self.scale / (x * self.scale).sum()).max() < 1e-12
            for x, exactness in zip(self.normals, self.exactness, strict=True)
            if exactness <= self.tolerance
        )

    def nearest(self, wanted: np.ndarray, index: int | None = None) -> NearestMixture:
        """The mixture that comes nearest to thresholds, with the best of an objective if asked."""
        lower, asked = np.stack(self.lower), np.isfinite(wanted)
        apart = frontier.separation(lower[:, asked], wanted[asked], self.scale[asked])
        share = apart.share
        if index is not None:
            enough = wanted - (apart.distance + 1e-15) * self.scale
            found = frontier.largest(
                lower, np.stack(self.normals), np.array(self.bounds), index, enough, self.scale
            )
            share = found.share if np.isfinite(found.lower) else share
        return nearest_mixture(self.front(), share, self.signs * wanted, self.signs)

    def best(self, index: int, wanted: np.ndarray, max_points: int) -> ConstrainedOptimum:
        """The best value of one objective, the others being at least something."""
        sign, tolerance = self.signs[index], self.tolerance
        enough = wanted.copy()
        enough[index] = min(x[index] for x in self.lower) - self.scale[index]
        holds, share, _ = self.decide(enough, max_points)
        if holds is False:
            nan = float("nan")
            return ConstrainedOptimum(nan, nan, nan, False, None, self.front(), Status.CONVERGED)
        while True:
            lower = np.stack(self.lower)
            known = frontier.largest(
                lower,
                np.stack(self.normals),
                np.array(self.bounds),
                index,
                wanted,
                self.scale,
                share,
            )
            size = max(1.0 if self.parts[index].kind == "sure" else abs(known.upper), 1e-300)
            narrow = known.upper - known.lower <= tolerance * size
            if narrow or known.vector is None or len(lower) >= max_points:
                break
            if not self.ask_anew(frontier.separation(lower, known.vector, self.scale).normal):
                break
        met = np.isfinite(known.lower)
        low, high = sorted((float(sign * known.lower), float(sign * known.upper)))
        if self.parts[index].kind == "sure":
            low, high = max(low, 0.0), min(high, 1.0)
        if met:
            status = Status.CONVERGED if narrow else Status.PRECISION
            return ConstrainedOptimum(
                (low + high) / 2, low, high, True, known.share, self.front(), status
            )
        near = self.nearest(wanted, index)
        value = float(np.clip((near.lower[index] + near.upper[index]) / 2, low, high))
        return ConstrainedOptimum(
            value, low, high, holds, None, self.front(), Status.PRECISION, near
        )

    def close(self, tolerance: float, max_points: int) -> float:
        """Asks until no value is farther beyond the mixtures than the tolerance; how far it is."""
        if len(self.parts) > 1:
            self.ask(1 / self.scale / len(self.parts))
        held: dict[bytes, frontier.Separation] = {}
        while True:
            lower, before = np.stack(self.lower), self.scale
            self._rescale()
            if not np.array_equal(before, self.scale):
                held.clear()
            floor = lower.min(0) - self.scale
            far = frontier.corners(np.stack(self.normals), np.array(self.bounds), floor)
            if not len(far):
                return float("inf")
            worst = self._farthest(np.maximum(far, lower.min(0)), held)
            gap = max(worst.distance, 0.0)
            if gap <= tolerance or len(lower) >= max_points or not self.ask_anew(worst.normal):
                return gap

    def _farthest(
        self, corners: np.ndarray, held: dict[bytes, frontier.Separation]
    ) -> frontier.Separation:
        """Of the corner farthest beyond the mixtures. Those of fewer points were not nearer."""
        lower, names, fresh = np.stack(self.lower), [x.tobytes() for x in corners], set()
        far = np.array([held[x].distance if x in held else np.inf for x in names])
        while (i := int(far.argmax())) not in fresh:
            held[names[i]] = frontier.separation(lower, corners[i], self.scale)
            far[i] = held[names[i]].distance
            fresh.add(i)
        return held[names[i]]
