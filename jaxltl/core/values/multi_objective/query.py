"""Multi-objective queries: which rewards are finite, and exact answers on small models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import SparseMDP, reward_structure
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.linear.rationals import rational, rational_distribution
from jaxltl.core.sparse.multi_objective.exact_program import ExactAnswer, Goal, solve_exactly
from jaxltl.core.sparse.multi_objective.weighted_sum import (
    FinalComponents,
    WeightedProblem,
    final_components,
)
from jaxltl.core.sparse.product import SparseProduct
from jaxltl.core.values.multi_objective.answers import Front
from jaxltl.core.values.multi_objective.objectives import Objective, Part, weighted_problem


class Query(NamedTuple):
    """Objectives of a model and its policies with finite minimised rewards."""

    model: SparseMDP
    objectives: Sequence[Objective]
    problem: WeightedProblem
    parts: list[Part]
    product: SparseProduct
    ends: FinalComponents | None  # None if no policy has finite minimised rewards

    @property
    def signs(self) -> np.ndarray:
        """1 for maximised objectives, -1 for minimised ones."""
        return np.array([p.sign for p in self.parts])

    def empty_front(self) -> Front:
        """A front without points and half-spaces."""
        none = np.zeros((0, len(self.parts)))
        return Front(none, none, none, none, np.zeros(0), (), self.product)

    def infinite_costs(self) -> str:
        """The objectives whose rewards no policy makes finite."""
        names = " and ".join(str(p.number + 1) for p in self.parts if p.kind == "cost")
        which = (
            f"s of objectives {names} are not finite together"
            if " " in names
            else f" of objective {names} is infinite"
        )
        return (
            f"the expected reward{which} under every policy: what is counted goes on for ever, or "
            "a target is not reached almost surely."
        )

    def infinite_reward(self) -> str | None:
        """The reason if the largest reward of some objective is infinite."""
        if self.ends is None:
            return None
        mdp, rows = self.problem.mdp, self.ends.rows
        cyclic = end_components(mdp, rows=rows).inside
        final = end_components(mdp, rows=rows & (self.problem.cost == 0).all(0)).inside
        for part in self.parts:
            if part.kind != "gain":
                continue
            earns = (cyclic & (self.problem.gain[part.place] > 0)).any()
            if earns or (part.pending is not None and (final & part.pending[mdp.state]).any()):
                why = (
                    "reward is earned for ever in an end component"
                    if earns
                    else "some policy does not reach its target"
                )
                return (
                    f"the largest expected reward of objective {part.number + 1} is infinite: "
                    f"{why}; make it small, or take that end component out of the model."
                )
        return None

    def exact(
        self, limits: Sequence[float | Fraction | None], index: int | None = None
    ) -> ExactAnswer | None:
        """The answer in rational arithmetic; None if the model is large.

        Probabilities, rewards and thresholds are the fractions that their doubles stand for. The
        value is that of objective `index`, infinity if None.
        """
        if self.ends is None:
            return ExactAnswer(False, None)
        goals = []
        for part, limit in zip(self.parts, limits, strict=True):
            least = None
            if limit is not None:
                exact = rational(limit) if isinstance(limit, float) else Fraction(limit)
                least = part.sign * exact + (part.kind == "sure" and part.sign < 0)
            pending = part.pending if part.kind == "gain" else None
            goals.append(Goal(self._rewards(part), part.place, pending, least))
        mdp, start = self.problem.mdp, np.flatnonzero(self.problem.start)
        shares = rational_distribution(self.problem.start[start].tolist())
        initial = dict(zip(start.tolist(), shares, strict=True))
        answer = solve_exactly(mdp, initial, self.ends, goals, index)
        if answer is None or index is None or answer.value is None:
            return answer
        part = self.parts[index]
        value = part.sign * answer.value + (part.kind == "sure" and part.sign < 0)
        return answer._replace(value=value)

    def _rewards(self, part: Part) -> list[Fraction] | None:
        """The rewards of the product's rows, negative if minimised; None of a probability."""
        if part.kind == "sure":
            return None
        reward = _exact_reward(self.model, self.objectives[part.number].reward)
        state = self.problem.mdp.state
        counted = np.ones(state.size, bool) if part.pending is None else part.pending[state]
        return [
            part.sign * reward[r] if c else Fraction(0)
            for r, c in zip(self.product.base_row.tolist(), counted.tolist(), strict=True)
        ]


def multi_objective_query(
    model: Model,
    objectives: Sequence[Objective],
    limits: Sequence[float | Fraction | None] | None = None,
) -> Query:
    """The query for objectives of a model; rewards of at most zero remove the rows that earn them."""
    if not objectives:
        raise ValueError("there is no objective; give at least one.")
    sparse = to_sparse(model)
    problem, parts, product = weighted_problem(sparse, objectives)
    rows = None
    for part, limit in zip(parts, [None] * len(parts) if limits is None else limits, strict=True):
        if part.kind == "cost" and limit is not None and limit <= 0:
            unpaid = problem.cost[part.place] == 0
            rows = unpaid if rows is None else rows & unpaid
    return Query(sparse, objectives, problem, parts, product, final_components(problem, rows))


def bounds_of(value: Fraction | None) -> tuple[float, float]:
    """The doubles next to a fraction, below and above; infinity for None."""
    if value is None:
        return math.inf, math.inf
    nearest = float(value)
    low = nearest if Fraction(nearest) <= value else math.nextafter(nearest, -math.inf)
    return low, nearest if Fraction(nearest) >= value else math.nextafter(nearest, math.inf)


def _exact_reward(model: SparseMDP, reward: Array | str | None) -> list[Fraction]:
    """The expected reward of each row, of the fractions that doubles stand for."""
    parts, mdp = reward_structure(model, reward), model.host
    total = [Fraction(0)] * mdp.num_rows
    for part, owner in ((parts.state, mdp.state), (parts.choice, np.arange(mdp.num_rows))):
        if part is not None:
            numbers = [rational(x) for x in np.asarray(part, np.float64).tolist()]
            total = [x + numbers[i] for x, i in zip(total, owner.tolist(), strict=True)]
    if parts.transition is not None:
        earned = np.asarray(parts.transition, np.float64).tolist()
        for r in range(mdp.num_rows):
            span = range(*mdp.entry_start[r : r + 2].tolist())
            shares = rational_distribution(mdp.probability[span.start : span.stop].tolist())
            total[r] += sum(
                (p * rational(earned[e]) for p, e in zip(shares, span, strict=True)), Fraction(0)
            )
    return total
