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

from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.multi_objective import pareto_front as frontier
from jaxltl.core.sparse.multi_objective.weighted_sum import weighted_optimum
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure
from jaxltl.core.types import Status
from jaxltl.core.values.engine.host_solution import induced_chain
from jaxltl.core.values.multi_objective.objectives import ObjectivePart
from jaxltl.core.values.multi_objective.answers import (
    ConstrainedOptimum,
    Front,
    NearestMixture,
    impossible,
)
from jaxltl.core.values.multi_objective.query import (
    ObjectivesQuery,
    bounds_of,
    multi_objective_query,
)
from jaxltl.core.values.undiscounted.sparse_satisfaction import sparse_mdp_of_product


_NEGLIGIBLE = 1e-12  # the width of the bounds of a reward that is narrow without being relative
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

    def __init__(self, query: ObjectivesQuery, tolerance: float) -> None:
        ends, endless = query.ends, query.infinite_reward()
        if ends is None:
            raise ValueError(query.infinite_costs())
        if endless is not None:
            raise ValueError(endless)
        self.problem, self.parts, self.product = query.problem, query.parts, query.product
        self.query, self.ends, self.signs = query, ends, query.signs
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
        chain = induced_chain(sparse, weight)
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

    def _expected(self, part: ObjectivePart, enclosure: Enclosure) -> tuple[float, float, float]:
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
        if not exact:
            low, high = max(low - 1e-16, 0.0), min(high + 1e-16, 1.0)
        return value - 1, low - 1, high - 1

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
        most = [1.0 if p.kind == "sure" else np.inf for p in self.parts]
        low, high = np.maximum(low, 0.0), np.minimum(high, most)
        missed = wanted - self.signs * np.where(self.signs > 0, low, high)
        return NearestMixture(share, low, high, np.maximum(missed, 0))

    def best(
        self, index: int, limits: Sequence[float | Fraction | None], max_points: int
    ) -> ConstrainedOptimum:
        """The optimal value of one objective under thresholds on the others."""
        wanted, sign, tolerance = self.thresholds(limits), self.signs[index], self.tolerance
        enough = np.array(wanted)
        enough[:, index] = self.lower[:, index].min() - self.scale[index]
        holds, share, _ = self.decide(Thresholds(*enough), max_points)
        if holds is False:
            return impossible(self.front())
        kind = self.parts[index].kind
        while True:
            lower = self.lower
            known = frontier.largest(lower, self.half_spaces, index, wanted, self.scale, share)
            size = 1.0 if kind == "sure" else max(abs(known.upper), _NEGLIGIBLE / tolerance)
            narrow = known.upper - known.lower <= tolerance * size
            if narrow or known.vector is None or len(lower) >= max_points:
                break
            if not self.ask_anew(frontier.separation(lower, known.vector, self.scale).normal):
                break
        low, high = sorted((float(sign * known.lower), float(sign * known.upper)))
        low, high = max(0.0, low), min(1.0, high) if kind == "sure" else max(0.0, high)
        if np.isfinite(known.lower):
            status = Status.CONVERGED if narrow else Status.PRECISION
            optimum = ConstrainedOptimum(
                (low + high) / 2, low, high, True, known.share, self.front(), status
            )
        else:
            nearest = self.nearest(wanted.hard, index)
            value = float(np.clip((nearest.lower[index] + nearest.upper[index]) / 2, low, high))
            optimum = ConstrainedOptimum(
                value, low, high, holds, None, self.front(), Status.PRECISION, nearest
            )
        ends = low == 0 or (kind == "sure" and high == 1)
        if (optimum.status == Status.CONVERGED and not (ends and low < high)) or (
            len(self.solved) >= max_points
        ):
            return optimum
        return self._exactly(optimum, index, limits)

    def _exactly(
        self, optimum: ConstrainedOptimum, index: int, limits: Sequence[float | Fraction | None]
    ) -> ConstrainedOptimum:
        """An optimum from rational arithmetic, or one of zero from the graph, where that is possible."""
        answer = self.query.exact(limits, index)
        if answer is not None and not answer.holds:
            return impossible(self.front())
        value = None if answer is None else answer.value
        if answer is None and self.parts[index].kind == "cost" and optimum.lower == 0:
            free = [0 if i == index else x for i, x in enumerate(limits)]
            query = multi_objective_query(self.query.model, self.query.objectives, free)
            if query.ends is not None and query.infinite_reward() is None:
                search = FrontSearch(query, self.tolerance)
                if search.decide(search.thresholds(limits), len(self.solved))[0]:
                    value = Fraction(0)
        if value is None:
            return optimum
        low, high = bounds_of(value)
        share = optimum.share if optimum.nearest is None else optimum.nearest.share
        return ConstrainedOptimum(
            float(value), low, high, True, share, self.front(), Status.CONVERGED
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
