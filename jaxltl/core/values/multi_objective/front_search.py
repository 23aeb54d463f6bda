"""Search of the Pareto front by weighted sums (Forejt, Kwiatkowska and Parker 2012).

Each weighted sum that is solved adds a point, which its policy attains, and a half-space, which no
policy leaves.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.protocols import Model
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.multi_objective import pareto_front as frontier
from jaxltl.core.sparse.multi_objective.weighted_sum import (
    FinalComponents,
    WeightedProblem,
    final_components,
    weighted_optimum,
)
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.sparse.solvers.total_cost import Enclosure
from jaxltl.core.types import Status
from jaxltl.core.values.engine.host_solution import induced_chain
from jaxltl.core.values.multi_objective.objectives import Objective, Part, weighted_problem
from jaxltl.core.values.undiscounted.sparse_satisfaction import sparse_mdp_of_product
from jaxltl.core.values.multi_objective.results import ConstrainedOptimum, Front, NearestMixture

_SHARPEST = 1e-12  # to which sums are solved where the border is near


class FrontSearch:
    """Known points and half-spaces, all objectives maximised: `signs` is -1 for minimised ones."""

    def __init__(self, model: Model, objectives: Sequence[Objective], tolerance: float) -> None:
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
        """Values of a policy with bounds, all maximised."""
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

    def _expected(self, part: Part, found: Enclosure) -> tuple[float, float, float]:
        """Value, lower and upper bound from the initial distribution."""
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

    @property
    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Normals and bounds, ``float64[K, n]`` and ``float64[K]``."""
        return np.stack(self.normals), np.array(self.bounds)

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
        """Decides whether a vector is attained, with a mixture or a half-space as evidence."""
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
        """Solves a weighted sum, more accurately if it was solved before; False if impossible."""
        while self._known(normal):
            if self.tolerance <= _SHARPEST:
                return False
            self.tolerance = max(self.tolerance / 1000, _SHARPEST)
        self.ask(normal)
        return True

    def _known(self, normal: np.ndarray) -> bool:
        """True if a weighted sum was solved as accurately already, up to rounding."""
        size = normal * self.scale
        return any(
            np.abs(size / size.sum() - x * self.scale / (x * self.scale).sum()).max() < 1e-12
            for x, exactness in zip(self.normals, self.exactness, strict=True)
            if exactness <= self.tolerance
        )

    def nearest(self, wanted: np.ndarray, index: int | None = None) -> NearestMixture:
        """The mixture nearest to thresholds, with the best value of one objective if given."""
        lower, asked = np.stack(self.lower), np.isfinite(wanted)
        apart = frontier.separation(lower[:, asked], wanted[asked], self.scale[asked])
        share = apart.share
        if index is not None:
            enough = wanted - (apart.distance + 1e-15) * self.scale
            found = frontier.largest(lower, self.half_spaces, index, enough, self.scale)
            share = found.share if np.isfinite(found.lower) else share
        return nearest_mixture(self.front(), share, self.signs * wanted, self.signs)

    def best(self, index: int, wanted: np.ndarray, max_points: int) -> ConstrainedOptimum:
        """The optimal value of one objective under thresholds on the others."""
        sign, tolerance = self.signs[index], self.tolerance
        enough = wanted.copy()
        enough[index] = min(x[index] for x in self.lower) - self.scale[index]
        holds, share, _ = self.decide(enough, max_points)
        if holds is False:
            nan = float("nan")
            return ConstrainedOptimum(nan, nan, nan, False, None, self.front(), Status.CONVERGED)
        while True:
            lower = np.stack(self.lower)
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
        near = self.nearest(wanted, index)
        value = float(np.clip((near.lower[index] + near.upper[index]) / 2, low, high))
        return ConstrainedOptimum(
            value, low, high, holds, None, self.front(), Status.PRECISION, near
        )

    def close(self, tolerance: float, max_points: int) -> float:
        """Adds points until no value is farther beyond the mixtures than the tolerance; the distance."""
        if len(self.parts) > 1:
            self.ask(1 / self.scale / len(self.parts))
        held: dict[bytes, frontier.Separation] = {}
        while True:
            lower, before = np.stack(self.lower), self.scale
            self._rescale()
            if not np.array_equal(before, self.scale):
                held.clear()
            floor = lower.min(0) - self.scale
            far = frontier.corners(*self.half_spaces, floor)
            if not len(far):
                return float("inf")
            worst = self._farthest(np.maximum(far, lower.min(0)), held)
            gap = max(worst.distance, 0.0)
            if gap <= tolerance or len(lower) >= max_points or not self.ask_anew(worst.normal):
                return gap

    def _farthest(
        self, corners: np.ndarray, held: dict[bytes, frontier.Separation]
    ) -> frontier.Separation:
        """The corner farthest beyond the mixtures; distances only shrink as points are added."""
        lower, names, fresh = np.stack(self.lower), [x.tobytes() for x in corners], set()
        far = np.array([held[x].distance if x in held else np.inf for x in names])
        while (i := int(far.argmax())) not in fresh:
            held[names[i]] = frontier.separation(lower, corners[i], self.scale)
            far[i] = held[names[i]].distance
            fresh.add(i)
        return held[names[i]]


def nearest_mixture(
    front: Front, share: np.ndarray, thresholds: np.ndarray, signs: np.ndarray
) -> NearestMixture:
    """Bounds of a mixture of a front's policies, and of its misses of thresholds."""
    used = share > 0
    lower = frontier.mixture(front.lower[used], share[used])
    upper = -frontier.mixture(-front.upper[used], share[used])
    missed = signs * (thresholds - np.where(signs > 0, lower, upper))
    return NearestMixture(share, lower, upper, np.maximum(missed, 0))
