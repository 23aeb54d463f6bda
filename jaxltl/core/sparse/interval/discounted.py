"""Discounted values of uncertain MDPs by policy iteration of both sides."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.sparse.interval.robust_values import Query, RobustValues
from jaxltl.core.sparse.interval.strategy_iteration import enclosed_values
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.linear.elimination import factorize
from jaxltl.core.sparse.linear.topological_order import Edges, ordered_components

_ROUNDS = 300


@dataclass(frozen=True)
class DiscountedModel:
    """``V = opt_r opt_p sum_t p_t (reward_t + discount_r V_t)``."""

    model: UncertainMDP
    reward: Floats  # float64[T], of any sign
    discount: Floats  # float64[R], below 1 in every second step at least

    def ahead(self, value: Floats) -> Floats:
        """``reward_t + discount_r V_t``, ``float64[T]``."""
        mdp = self.model.mdp
        return self.reward + self.discount[mdp.row] * value[mdp.successor]

    def backup(self, value: Floats, nature_maximizes: bool) -> tuple[Floats, Floats, Floats]:
        """Nature's distributions, the value of each row, and its rounding error."""
        model, ahead = self.model, self.ahead(value)
        q = model.extreme_distributions(ahead, maximize=nature_maximizes)
        size = np.abs(self.reward).max(initial=0) + np.abs(value).max(initial=0)
        return q, model.sum_rows(q * ahead), 4 * model.rounding * size

    def evaluate(self, row: Integers, p: Floats, label: Integers) -> Floats | None:
        """The value of a policy and nature; None where the system is singular."""
        chain, entry = self.model.under_policy(row)
        earned = chain.sum_rows(p[entry] * self.reward[entry])
        mdp = chain.resolve(p[entry])
        matrix = mdp.matrix.copy()
        matrix.data = matrix.data * self.discount[row][mdp.row]
        system = factorize(matrix, label, np.arange(mdp.num_states))
        value = None if system is None else system.solve(earned)
        return value if value is not None and np.isfinite(value).all() else None


def discounted_value(problem: DiscountedModel, query: Query) -> RobustValues:
    """Optimal discounted value, enclosed by ``V +- |Phi V - V| / (1 - discount)`` and rounding."""
    model, mdp, discount = problem.model, problem.model.mdp, problem.discount
    label = ordered_components(Edges(mdp.entry_start[mdp.row_start], mdp.successor))
    rate = float(discount[discount < 1].max(initial=0))
    steps = (2 if (discount == 1).any() else 1) / (1 - rate)
    best, sign = (np.maximum, 1) if query.maximize else (np.minimum, -1)
    nature = 1 if query.nature_maximizes else -1
    value = np.zeros(mdp.num_states)
    row: Integers = mdp.row_start[:-1].astype(np.int64)
    p = model.extreme_distributions(problem.reward, maximize=query.nature_maximizes)
    low, high = np.full(value.size, -np.inf), np.full(value.size, np.inf)
    rounds, residual = 0, np.inf
    while rounds < _ROUNDS:
        rounds += 1
        solved = problem.evaluate(row, p, label)
        if solved is None:
            break
        value = solved
        q, image, noise = problem.backup(value, query.nature_maximizes)
        now = model.sum_rows(p * problem.ahead(value))
        # Nature answers first; only then does the policy improve.
        taken = np.isin(np.arange(mdp.num_rows), row)
        answers = ((image - now) * nature > noise) & taken
        optimum = mdp.over_choices(best, image)
        residual = float(np.abs(optimum - value).max())
        error = (residual + float(noise.max())) * steps
        if error < (high - low).max() / 2:
            low, high = value - error, value + error
        if 2 * error <= query.tolerance:
            break
        better = sign * (optimum - image[row]) > noise[row]
        if not answers.any() and not better.any():
            break
        p = np.where((answers | ~taken)[mdp.row], q, p)
        if not answers.any():
            row = np.where(better, mdp.first_choice(image == optimum[mdp.state])[1], row)
    values = enclosed_values(value, (low, high), row, p, rounds=rounds, residual=residual)
    return replace(values, method="policy iteration with nature")
