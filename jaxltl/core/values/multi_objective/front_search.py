"""Search of the Pareto front by weighted sums (Forejt, Kwiatkowska and Parker 2012).

Each weighted sum that is solved adds a point, which its policy attains, and a half-space, which no
policy leaves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.protocols import Model
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.multi_objective import pareto_front as frontier
from jaxltl.core.sparse.multi_objective.weighted_sum import (
    FinalComponents,
    final_components,
    weighted_optimum,
)
from jaxltl.core.sparse.product import SparseProduct
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure
from jaxltl.core.types import Status
from jaxltl.core.values.engine.host_solution import induced_chain
from jaxltl.core.values.multi_objective.objectives import Objective, Part, weighted_problem
from jaxltl.core.values.undiscounted.sparse_satisfaction import sparse_mdp_of_product


@brief
class Front(NamedTuple):
    """Points that policies attain and half-spaces that none leaves, for n objectives.

    Attributes:
      points: ``float64[N, n]``, values of policies from the initial distribution.
      lower, upper: ``float64[N, n]``, their certified bounds.
      normals, bounds: ``float64[K, n]``, ``[K]``: every policy has ``normals @ value <= bounds``
        (a minimised objective has a negative normal).
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
      share: if True, the probabilities with which the front's policies are drawn initially.
      normal: if False, the number of a half-space of the front that excludes the thresholds.
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
      value, lower, upper: the value and its certified bounds; NaN if the thresholds cannot be met.
        If that is unknown, they hold provided that they can; one bound is infinite.
      holds: True if the thresholds can be met; None if unknown.
      share: initial probabilities of the front's policies that attain the safe bound, or None.
      front: the evidence.
      status: CONVERGED if the bounds are narrow, or the thresholds cannot be met.
      nearest: if `holds` is unknown, the best of the mixtures nearest to the thresholds.

    Example:
      >>> from jaxltl.core.values.multi_objective.multi_objective import Objective, multi_objective
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


_SHARPEST = 1e-12  # to which sums are solved where the border is near


class Thresholds(NamedTuple):
    """Lower thresholds ``float64[n]``, as doubles that are not easier, and not harder, to meet."""

    hard: np.ndarray
    easy: np.ndarray


class _Sum(NamedTuple):
    """A weighted sum that was solved: the values of its policy, and a half-space."""

    policy: np.ndarray
    value: np.ndarray  # float64[n], with bounds
    lower: np.ndarray
    upper: np.ndarray
    normal: np.ndarray
    bound: float
    exactness: float  # the tolerance


class FrontSearch:
    """Known points and half-spaces, all objectives maximised: `signs` is -1 for minimised ones."""

    def __init__(self, model: Model, objectives: Sequence[Objective], tolerance: float) -> None:
        if not objectives:
            raise ValueError("there is no objective; give at least one.")
        problem = weighted_problem(to_sparse(model), objectives)
        self.problem, self.parts, self.product = problem
        ends = final_components(self.problem)
        if ends is None:
            names = " and ".join(str(p.number + 1) for p in self.parts if p.kind == "cost")
            raise ValueError(
                f"the expected reward of objective {names or 1} is infinite under every policy: "
                "what it counts goes on for ever, or its target is not reached almost surely."
            )
        self.ends: FinalComponents = ends
        self._require_finite()
        self.signs = np.array([p.sign for p in self.parts])
        self.tolerance = tolerance
        self.solved: list[_Sum] = []
        self.scale = np.ones(len(self.parts))
        for normal in np.eye(len(self.parts)):
            self.ask(normal)
        self._rescale()

    @property
    def lower(self) -> np.ndarray:
        """Lower bounds of the points, ``float64[N, n]``."""
        return np.stack([x.lower for x in self.solved])

    @property
    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Normals and bounds, ``float64[K, n]`` and ``float64[K]``."""
        return np.stack([x.normal for x in self.solved]), np.array([x.bound for x in self.solved])

    def _require_finite(self) -> None:
        mdp = self.problem.mdp
        cyclic = end_components(mdp, rows=self.ends.rows).inside
        everywhere = end_components(mdp).inside
        for part in self.parts:
            if part.kind != "gain":
                continue
            earns = (cyclic & (self.problem.gain[part.place] > 0)).any()
            if earns or (part.pending is not None and (everywhere & part.pending[mdp.state]).any()):
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
        reach = np.abs(self.lower).max(0)
        is_reward = np.array([p.kind != "sure" for p in self.parts])
        self.scale = np.where(is_reward & (reach > 0), reach, 1.0)

    def ask(self, normal: np.ndarray) -> None:
        """Solves a weighted sum, and adds its point and its half-space."""
        rows = {"sure": self.problem.priority, "gain": self.problem.gain, "cost": self.problem.cost}
        weights = {kind: np.zeros(len(x)) for kind, x in rows.items()}
        shift = 0.0  # a probability to be minimised is one minus the maximised one
        for part, w in zip(self.parts, normal, strict=True):
            weights[part.kind][part.place] = w
            shift += w if part.kind == "sure" and part.sign < 0 else 0
        tolerance = self.tolerance / 4 * float((normal * self.scale).sum())
        optimum = weighted_optimum(self.problem, self.ends, **weights, tolerance=tolerance)
        bound = optimum.bound - shift + 1e-15 * (abs(optimum.bound) + shift)
        value, lower, upper = self._evaluate(optimum.weight, optimum.home)
        known = _Sum(optimum.weight, value, lower, upper, normal, bound, self.tolerance)
        self.solved.append(known)

    def _evaluate(self, weight: np.ndarray, home: np.ndarray) -> np.ndarray:
        """Values of a policy and their bounds, all maximised: ``float64[3, n]``."""
        problem, sparse = self.problem, sparse_mdp_of_product(self.product)
        chain = induced_chain(sparse, sparse, weight)
        inside = (weight > 0) & home[problem.mdp.state]
        component = end_components(problem.mdp, rows=inside).component
        leader = component[problem.mdp.state[inside]]
        tolerance, depth = self.tolerance / 8, chain.depth
        values = []
        for part in self.parts:
            if part.kind == "sure":
                least = np.full(home.size, np.iinfo(np.int64).max)
                np.minimum.at(least, leader, problem.priority[part.place][inside])
                good = home & (least[component] % 2 == 0)
                x = optimal.reachability(
                    chain.mdp, good, maximize=True, tolerance=tolerance, depth=depth
                )
            else:
                rows = (problem.gain if part.kind == "gain" else problem.cost)[part.place]
                earned = chain.mean(rows, problem.mdp.row_start)
                x = optimal.total_reward(
                    chain.mdp, earned, home, maximize=False, tolerance=tolerance, depth=depth
                )
            values.append(self._expected(part, x))
        return np.array(values).T

    def _expected(self, part: Part, enclosure: Enclosure) -> tuple[float, float, float]:
        """Value, lower and upper bound from the initial distribution."""
        first = np.flatnonzero(self.problem.start)
        share = self.problem.start[first]
        slack = 1e-15 * (first.size + 2)
        value, low, high = (
            float(share @ x[first]) for x in (enclosure.value, enclosure.lower, enclosure.upper)
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
        """The points and half-spaces with the signs of the objectives."""
        points = np.array([(x.value, x.lower, x.upper) for x in self.solved]) * self.signs + 0.0
        value, one, other = points.swapaxes(0, 1)
        normals, bounds = self.half_spaces
        return Front(
            value,
            np.minimum(one, other),
            np.maximum(one, other),
            normals * self.signs,
            bounds,
            tuple(x.policy for x in self.solved),
            self.product,
        )

    def thresholds(self, limits: Sequence[float | Fraction | None]) -> Thresholds:
        """Thresholds with the signs of the objectives, minus infinity without one."""
        doubles = np.full((2, len(limits)), -np.inf)
        for i, (threshold, sign) in enumerate(zip(limits, self.signs.tolist(), strict=True)):
            if threshold is None:
                continue
            if not math.isfinite(threshold):
                raise ValueError(
                    f"the threshold of objective {i + 1} is {threshold}; give a finite number."
                )
            exact = sign * Fraction(threshold)
            rounded = float(exact)
            doubles[0, i] = rounded if rounded >= exact else math.nextafter(rounded, math.inf)
            doubles[1, i] = rounded if rounded <= exact else math.nextafter(rounded, -math.inf)
        return Thresholds(*doubles)

    def decide(
        self, wanted: Thresholds, max_points: int
    ) -> tuple[bool | None, np.ndarray | None, int | None]:
        """Decides whether a vector is attained, with a mixture or a half-space as evidence."""
        looked, hard = 0, wanted.hard
        while True:
            for k, known in enumerate(self.solved[looked:], looked):
                if frontier.exceeds(known.normal, known.bound, wanted.easy):
                    return False, None, k
            lower, looked = self.lower, len(self.solved)
            for i in np.flatnonzero((lower >= hard).all(1)):
                return True, np.eye(looked)[int(i)], None
            apart = frontier.separation(lower, hard, self.scale)
            for share in (apart.share, frontier.plain(apart.share)):
                if frontier.meets(lower, share, hard):
                    return True, share, None
            if looked >= max_points or not self.ask_anew(apart.normal):
                return None, None, None

    def ask_anew(self, normal: np.ndarray) -> bool:
        """Solves a weighted sum, more accurately if it was solved before; False if impossible."""
        while self._known(normal):
            if self.tolerance <= _SHARPEST:
                return False
            self.tolerance = max(self.tolerance / 1000, _SHARPEST)
        self.ask(normal)
        return True

    def _known(self, normal: np.ndarray) -> bool:
        """True if a weighted sum was solved as accurately already, up to rounding."""
        normals = np.stack([normal, *(x.normal for x in self.solved)]) * self.scale
        normals /= normals.sum(1, keepdims=True)
        exact = np.array([x.exactness <= self.tolerance for x in self.solved])
        return bool((exact & (np.abs(normals[1:] - normals[0]).max(1) < 1e-12)).any())

    def nearest(self, wanted: np.ndarray, index: int | None = None) -> NearestMixture:
        """The mixture nearest to thresholds, with the best value of one objective if given."""
        lower, constrained = self.lower, np.isfinite(wanted)
        apart = frontier.separation(
            lower[:, constrained], wanted[constrained], self.scale[constrained]
        )
        share = apart.share
        if index is not None:
            enough = wanted - (apart.distance + 1e-15) * self.scale
            optimum = frontier.largest(lower, self.half_spaces, index, (enough, enough), self.scale)
            share = optimum.share if np.isfinite(optimum.lower) else share
        front, used = self.front(), share > 0
        low = frontier.mixture(front.lower[used], share[used])
        high = -frontier.mixture(-front.upper[used], share[used])
        missed = wanted - self.signs * np.where(self.signs > 0, low, high)
        return NearestMixture(share, low, high, np.maximum(missed, 0))

    def best(self, index: int, wanted: Thresholds, max_points: int) -> ConstrainedOptimum:
        """The optimal value of one objective under thresholds on the others."""
        sign, tolerance = self.signs[index], self.tolerance
        enough = np.array(wanted)
        enough[:, index] = self.lower[:, index].min() - self.scale[index]
        holds, share, _ = self.decide(Thresholds(*enough), max_points)
        if holds is False:
            nan = float("nan")
            return ConstrainedOptimum(nan, nan, nan, False, None, self.front(), Status.CONVERGED)
        while True:
            lower = self.lower
            known = frontier.largest(lower, self.half_spaces, index, wanted, self.scale, share)
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
        nearest = self.nearest(wanted.hard, index)
        value = float(np.clip((nearest.lower[index] + nearest.upper[index]) / 2, low, high))
        return ConstrainedOptimum(
            value, low, high, holds, None, self.front(), Status.PRECISION, nearest
        )

    def close(self, tolerance: float, max_points: int) -> float:
        """Adds points until no value is farther beyond the mixtures than the tolerance; the distance."""
        if len(self.parts) > 1:
            self.ask(1 / self.scale / len(self.parts))
        held: dict[bytes, frontier.Separation] = {}
        while True:
            lower, before = self.lower, self.scale
            self._rescale()
            if not np.array_equal(before, self.scale):
                held.clear()
            floor = lower.min(0) - self.scale
            corners = frontier.corners(*self.half_spaces, floor)
            if not len(corners):
                return float("inf")
            worst = self._farthest(np.maximum(corners, lower.min(0)), held)
            gap = max(worst.distance, 0.0)
            if gap <= tolerance or len(lower) >= max_points or not self.ask_anew(worst.normal):
                return gap

    def _farthest(
        self, corners: np.ndarray, held: dict[bytes, frontier.Separation]
    ) -> frontier.Separation:
        """The corner farthest beyond the mixtures; distances only shrink as points are added."""
        lower, names, fresh = self.lower, [x.tobytes() for x in corners], set()
        distance = np.array([held[x].distance if x in held else np.inf for x in names])
        while (i := int(distance.argmax())) not in fresh:
            held[names[i]] = frontier.separation(lower, corners[i], self.scale)
            distance[i] = held[names[i]].distance
            fresh.add(i)
        return held[names[i]]
