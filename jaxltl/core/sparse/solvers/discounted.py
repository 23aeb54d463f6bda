"""Optimal discounted values of sparse MDPs, by reduction to a stochastic shortest path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxltl.core.array_types import Booleans, Floats
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers.reachability import solve_shortest_path
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure, ShortestPathProblem

_EPS = float(np.finfo(np.float64).eps)


def discounted_value(
    mdp: HostMDP,
    reward: Floats,
    magnitude: Floats,
    discount: float,
    *,
    tolerance: float,
    depth: int = 0,
) -> Enclosure:
    """Certified largest solution of ``V = max_r (reward_r + discount * P_r V)``."""
    least = float(reward.min())
    ending = _with_final_state(mdp, discount)
    interior = np.ones(ending.num_states, bool)
    interior[-1] = False
    # The least reward is earned forever, and the rest is at least 0.
    cost = np.append(reward - least, 0)
    problem = ShortestPathProblem(ending, interior, np.zeros(interior.size), cost, depth=depth)
    enclosure = solve_shortest_path(problem, maximize=True, tolerance=tolerance, relative=False)
    baseline = least / (1 - discount)
    value, lower, upper = (
        x[:-1] + baseline for x in (enclosure.value, enclosure.lower, enclosure.upper)
    )
    # Terms of a reward may cancel; their rounding stays.
    terms = int(np.diff(mdp.entry_start).max()) + depth + 4
    cancellation = terms * float(magnitude.max()) / (1 - discount)
    slack = 4 * _EPS * (np.abs(enclosure.value[:-1]) + abs(baseline) + cancellation)
    return replace(
        enclosure, value=value, lower=lower - slack, upper=upper + slack, row=enclosure.row[:-1]
    )


def _with_final_state(mdp: HostMDP, discount: float) -> HostMDP:
    """The model with a final state, which every row enters with probability 1 - discount."""
    end, rows = mdp.num_states, mdp.num_rows
    entry_start = np.append(mdp.entry_start + np.arange(rows + 1), 0)
    entry_start[-1] = entry_start[-2] + 1
    last = entry_start[1:-1] - 1
    place: Booleans = np.ones(int(entry_start[-1]), bool)
    place[last] = place[-1] = False
    successor = np.full(place.size, end, np.int32)
    probability = np.full(place.size, 1 - discount)
    probability[-1] = 1
    successor[place] = mdp.successor
    probability[place] = mdp.probability * discount
    return HostMDP(
        np.append(mdp.row_start, rows + 1).astype(np.int32), entry_start, successor, probability
    )
