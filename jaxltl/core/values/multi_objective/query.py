"""Multi-objective queries: which rewards are finite, and exact answers on small models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from functools import partial
from typing import NamedTuple

import numpy as np

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.exact_numbers import exact_numbers, exact_reward
from jaxltl.core.models.number_source import RationalNumbers
from jaxltl.core.models.protocols import Model
from jaxltl.core.models.sparse import SparseMDP, reward_structure
from jaxltl.core.sparse.exact.model import double_bounds
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.multi_objective.exact_program import (
    ExactAnswer,
    ExactModel,
    Goal,
    solve_exactly,
)
from jaxltl.core.sparse.multi_objective.weighted_sum import (
    FinalComponents,
    WeightedProblem,
    final_components,
)
from jaxltl.core.sparse.product import SparseProduct
from jaxltl.core.values.multi_objective.answers import Front
from jaxltl.core.values.multi_objective.objectives import Objective, ObjectivePart, weighted_problem

MAX_ROWS = 5000  # of models whose numbers are read as fractions, before it is known what is used


class ObjectivesQuery(NamedTuple):
    """Objectives of a model and its policies with finite minimised rewards."""

    model: SparseMDP
    objectives: Sequence[Objective]
    problem: WeightedProblem
    parts: list[ObjectivePart]
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
            f"the expected reward{which} under every policy: it is earned infinitely often, or a target "
            "is not reached almost surely."
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

        Probabilities and rewards are those of :func:`exact_numbers`. The value is that of objective
        `index`, infinity if None.
        """
        if self.ends is None:
            return ExactAnswer(False, None)
        if self.problem.mdp.num_rows > MAX_ROWS or self.model.num_rows > MAX_ROWS:
            return None
        numbers, goals = exact_numbers(self.model), []
        for part, limit in zip(self.parts, limits, strict=True):
            least = None
            if limit is not None:
                least = part.sign * Fraction(limit) + (part.kind == "sure" and part.sign < 0)
            pending = part.pending if part.kind == "gain" else None
            goals.append(Goal(self._rewards(part, numbers), part.place, pending, least))
        first = np.flatnonzero(self.problem.start)
        shares = [Fraction(x) for x in self.problem.start[first].tolist()]
        start = {s: p / sum(shares) for s, p in zip(first.tolist(), shares, strict=True)}
        model = ExactModel(self.problem.mdp, partial(self._distribution, numbers), start)
        answer = solve_exactly(model, self.ends, goals, index)
        if answer is None or index is None or answer.value is None:
            return answer
        part = self.parts[index]
        value = part.sign * answer.value + (part.kind == "sure" and part.sign < 0)
        return answer._replace(value=value)

    def _distribution(self, numbers: RationalNumbers, row: int) -> dict[int, Fraction]:
        """The successors of a row of the product, with their probabilities."""
        mdp, base = self.problem.mdp, numbers.mdp.rows[int(self.product.base_row[row])]
        s = int(mdp.state[row])
        if self.product.still[s]:
            return {s: Fraction(1)}
        successors = mdp.successor[mdp.entry_start[row] : mdp.entry_start[row + 1]].tolist()
        return {t: base[int(self.product.base_state[t])] for t in successors}

    def _rewards(self, part: ObjectivePart, numbers: RationalNumbers) -> list[Fraction] | None:
        """The rewards of the product's rows, negative if minimised; None of a probability."""
        if part.kind == "sure":
            return None
        reward_of = self.objectives[part.number].reward
        structure = reward_structure(self.model, reward_of)
        name = reward_of if isinstance(reward_of, str) else None
        reward = exact_reward(self.model, numbers, structure, name)
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
) -> ObjectivesQuery:
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
    return ObjectivesQuery(
        sparse, objectives, problem, parts, product, final_components(problem, rows)
    )


def bounds_of(value: Fraction | None) -> tuple[float, float]:
    """The doubles next to a fraction, below and above; infinity for None."""
    return double_bounds(math.inf if value is None else value)
