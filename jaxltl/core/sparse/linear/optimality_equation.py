"""Optimality equation of a total-cost problem without self-loops, on sparse rows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Floats, Integers, SparseMatrix
from jaxltl.core.sparse.choice_order import ChoiceOrder
from jaxltl.core.sparse.rows import concatenated_ranges, group_starts

# Rounds of improvements: their overhead in entries, the work allowed relative to the entries of the
# equation, and the gain, relative to the largest, that is still propagated. Measured on chains and
# grids of 10^3 to 10^5 states, where one linear system costs as much as some 40 backups.
_ROUND_OVERHEAD, _RELATIVE_WORK, _MIN_ROUNDS = 3000, 40, 100
_RELATIVE_GAIN = 0.01


@dataclass(frozen=True)
class OptimalityEquation:
    """``x_i = opt_r (c_r + sum_j P_rj x_j)`` over the rows r of unknown i."""

    matrix: SparseMatrix  # SciPy's float64[R, M], without self-loops
    cost: Floats  # float64[R], at least 0, with the share of terminal states
    leaving: Floats  # float64[R], the probability of leaving the unknowns
    choices: ChoiceOrder  # the order of the unknowns and of their rows
    sign: int  # 1 to maximise, -1 to minimise

    @property
    def size(self) -> int:
        return self.choices.states.size

    @property
    def owner(self) -> Integers:
        """The unknown of each row, ``int[R]``."""
        return self.choices.owner

    @property
    def is_chain(self) -> bool:
        return self.choices.is_chain

    def backup(self, value: Floats) -> Floats:
        """``c + P x`` of each row."""
        result: Floats = self.cost + self.matrix @ value
        return result

    def best(self, image: Floats) -> Floats:
        """The optimum over the rows of each unknown."""
        return self.choices.best(image, np.maximum if self.sign > 0 else np.minimum)

    def greedy_policy(self, value: Floats, num_sweeps: int) -> Integers:
        """The greedy policy after some sweeps of value iteration."""
        if self.is_chain:
            return np.arange(self.size)
        for _ in range(num_sweeps):
            image = self.backup(value)
            value = self.best(image)
        return self.choices.first(image, value)


def propagate_improvements(
    equation: OptimalityEquation, value: Floats, policy: Integers, least: Floats
) -> Integers:
    """Improves a policy by gains above the least ones, and propagates them, as ``int[M]``.

    Asynchronous value iteration of predecessors of improved states (Bertsekas and Tsitsiklis 1989,
    section 2.6). Values improve monotonically, so no row that was chosen gets worse, and the new
    policy is better than the old one wherever it differs.
    """
    matrix, owner, sign = equation.matrix, equation.owner, equation.sign
    back = matrix.tocsc()
    in_degree = np.diff(back.indptr)
    value, policy, threshold = value.copy(), policy.copy(), 1.0
    rows: Integers = np.arange(owner.size)
    image = equation.backup(value)
    budget = _RELATIVE_WORK * matrix.nnz + _ROUND_OVERHEAD * _MIN_ROUNDS
    while True:
        state = owner[rows]
        gain = sign * (image - value[state]) / least[state]
        better = np.flatnonzero(gain > threshold)
        if not better.size:
            return policy
        better = better[np.lexsort((-gain[better], state[better]))]
        better = better[group_starts(state[better])]
        improved = state[better]
        value[improved], policy[improved] = image[better], rows[better]
        threshold = max(threshold, _RELATIVE_GAIN * float(gain[better].max()))
        rows = np.unique(
            back.indices[concatenated_ranges(back.indptr[improved], in_degree[improved])]
        )
        count = matrix.indptr[rows + 1] - matrix.indptr[rows]
        budget -= int(count.sum()) + _ROUND_OVERHEAD
        if budget < 0 or not rows.size:
            return policy
        entry = concatenated_ranges(matrix.indptr[rows], count)
        terms = matrix.data[entry] * value[matrix.indices[entry]]
        sums = np.bincount(np.repeat(np.arange(rows.size), count), terms, rows.size)
        image = equation.cost[rows] + sums
