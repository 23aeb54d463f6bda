"""Certified values of explored beliefs, and the policies of their rows.

Explored beliefs and their rows become a Markov decision process for the certified engine, with two ends:
``goal``, whose value is one, and ``sink``, whose value is zero. Rows are rounded so that the values are
bounds of those of the beliefs. A minimum loses the share ``slack`` of each row to the sink, so that
``x <= B x`` for the exact operator B, and x is at most its least fixed point. For a maximum, values are
halved, and each row loses the share ``slack`` and gains ``3/4 slack`` of the goal. As halved values are at
most one half, ``x >= B x`` with a margin of ``slack / 4``, and x is at least the least fixed point. Within
end components this would add up to the largest value; there rows stay as they are if exact arithmetic shows
that they lead to stored beliefs alone. As the values of an end component are equal, ``x >= B x`` still holds.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers, SparseMatrix
from jaxltl.core.sparse.graph.components import forward_reachable
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import mask_of, offsets_from_counts
from jaxltl.core.sparse.solvers import reachability as solver
from jaxltl.core.values.partial_observability.beliefs import BeliefGraph
from jaxltl.core.values.partial_observability.problem import EPS, BeliefProblem

_SLACK = 1e-11  # relative rounding that is added to rows
_EXACT_ROWS = 20_000  # rows of end components that are checked in exact arithmetic, most


class NodeValues(NamedTuple):
    """Values of the nodes, and the row of a policy that attains them, -1 at leaves."""

    value: Floats  # float64[nodes]
    row: Integers  # int[nodes], of :meth:`BeliefGraph.rows`


@dataclass
class BeliefRows:
    """The rows of a graph, once for several solutions."""

    graph: BeliefGraph
    table: dict[str, np.ndarray]

    @property
    def problem(self) -> BeliefProblem:
        return self.graph.problem

    @cached_property
    def matrix(self) -> SparseMatrix:
        """``float64[rows, nodes]``, the weights of successors."""
        from scipy.sparse import csr_array

        table = self.table
        shape = table["node"].size, self.graph.size
        return csr_array((table["by"], table["to"], table["start"]), shape=shape)

    @property
    def slack(self) -> float:
        """Relative rounding of a row, with a margin."""
        return max(_SLACK, 32 * (self.problem.largest_class + 20) * EPS)

    def mdp(
        self, gain: Floats, leaf: Floats, scale: Floats, cost: Floats | None
    ) -> tuple[HostMDP, Floats, Booleans]:
        """The rows with leaves, as an MDP whose last states are the goal and the sink; costs; its leaves."""
        from scipy.sparse import csr_array

        table, size = self.table, self.graph.size
        leaves = np.flatnonzero(~self.graph.expanded)
        count = np.diff(table["start"])
        num = table["node"].size
        row = np.arange(num).repeat(count)
        by = table["by"] * scale[row]
        total = np.bincount(row, by, minlength=num) + gain
        rest = np.maximum(1 - total, 0)
        rest[rest < 1e-15] = 0
        # rows of nodes, then those of leaves, goal and sink
        end = np.arange(num)
        after = num + np.arange(leaves.size)
        last = num + leaves.size + np.arange(2)
        rows = np.concatenate([row, end, end, after, after, last])
        columns = np.concatenate(
            [
                table["to"],
                np.full(num, size),
                np.full(num, size + 1),
                np.full(leaves.size, size),
                np.full(leaves.size, size + 1),
                [size, size + 1],
            ]
        )
        value = leaf[leaves] if cost is None else np.zeros(leaves.size)
        data = np.concatenate([by, gain, rest, value, 1 - value, [1.0, 1.0]])
        state = np.concatenate([table["node"], leaves, [size, size + 1]])
        order = np.argsort(state, kind="stable")
        matrix = csr_array((data, (rows, columns)), shape=(num + leaves.size + 2, size + 2))
        matrix.eliminate_zeros()
        matrix = matrix[order]
        matrix.sort_indices()
        starts = offsets_from_counts(np.bincount(state, minlength=size + 2))
        costs = np.zeros(order.size)
        if cost is not None:
            costs = np.concatenate([cost, leaf[leaves], [0.0, 0.0]])[order]
        self._row = np.where(order < num, order, -1)
        return HostMDP(starts, matrix.indptr, matrix.indices, matrix.data), costs, order < num

    def solve(self, leaf: Floats, *, safe: bool, tolerance: float) -> NodeValues:
        """Values from those of leaves ``float64[nodes]``: bounds of the beliefs if `safe`, else estimates."""
        problem, table = self.problem, self.table
        num, size = table["node"].size, self.graph.size
        scale = np.ones(num)
        gain = table["gain"] + table["lost"] if safe else table["gain"].copy()
        slack = self.slack if safe else 0.0
        target = np.zeros(size + 2, bool)
        if problem.is_reward:
            target[size + 1] = True
            scale -= slack
            mdp, cost, _ = self.mdp(np.zeros(num), leaf, scale, gain * (1 - slack))
            bounds = solver.total_reward(
                mdp, cost, target, maximize=problem.maximize, tolerance=tolerance
            )
            value = bounds.lower if safe else bounds.value
            return NodeValues(value[:size], self._row[bounds.row[:size]])
        target[size] = True
        factor = 1.0
        if not safe:
            gain = np.minimum(gain, 1.0)
        elif problem.maximize:
            factor = 0.5
            loses = ~self._exact_rows(gain)
            scale = np.where(loses, 1 - slack, 1.0)
            gain = np.where(loses, gain / 2 + 0.75 * slack, 0.0)
        else:
            scale, gain = scale - slack, gain * (1 - slack)
        mdp, _, _ = self.mdp(gain, np.clip(leaf * factor, 0, 1), scale, None)
        bounds = solver.reachability(
            mdp, target, maximize=problem.maximize, tolerance=tolerance * factor
        )
        value = bounds.value if not safe else bounds.upper if problem.maximize else bounds.lower
        return NodeValues(value[:size] / factor, self._row[bounds.row[:size]])

    def reaches_leaves(self) -> bool:
        """True if unexpanded nodes are reachable from the initial measure."""
        table, graph = self.table, self.graph
        source = table["node"].repeat(np.diff(table["start"]))
        reached = forward_reachable(source, table["to"], mask_of(graph.root[0], graph.size))
        return bool((reached & ~graph.expanded).any())

    def at_root(self, value: Floats) -> float:
        """The bound of the initial measure."""
        node, weight, rest = self.graph.root
        total = float(weight @ value[node]) + rest + self.problem.initial_gain
        sign = 1 if self.problem.maximize else -1
        return total * (1 + sign * self.slack)

    # --- end components ---------------------------------------------------------------------------

    def _exact_rows(self, gain: Floats) -> Booleans:
        """Rows of end components that lead to stored beliefs alone, by exact arithmetic."""
        table = self.table
        num = table["node"].size
        row = np.arange(num).repeat(np.diff(table["start"]))
        whole = np.abs(np.bincount(row, table["by"], minlength=num) - 1) <= 1e-12
        candidate = whole & (gain <= 1e-11)
        if not candidate.any():
            return candidate
        mdp, _, is_row = self.mdp(np.zeros(num), np.zeros(self.graph.size), np.ones(num), None)
        checked = np.zeros(num, bool)
        while True:
            inside = end_components(
                mdp,
                rows=mask_of(np.flatnonzero(is_row), mdp.num_rows)
                & np.where(self._row >= 0, candidate[self._row], False),
            ).inside
            rows = self._row[inside]
            new = rows[~checked[rows]]
            if not new.size:
                return mask_of(rows, num)
            checked[new] = True
            wrong = new[_EXACT_ROWS:].tolist()
            wrong += [
                r
                for r in new[:_EXACT_ROWS].tolist()
                if not self.graph.exact.is_exact(
                    int(table["node"][r]),
                    int(table["action"][r]),
                    table["to"][table["start"][r] : table["start"][r + 1]].tolist(),
                    self.slack / 16,
                )
            ]
            if not wrong:
                return mask_of(rows, num)
            candidate[wrong] = False
