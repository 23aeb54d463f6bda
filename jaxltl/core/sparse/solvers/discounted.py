"""Discounted values on sparse rows: a run ends with what the discount leaves out of each step."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.core.array_types import Floats
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers.mixing import optimum
from jaxltl.core.sparse.solvers.policy_iteration import Enclosure, ShortestPathProblem

_EPS = float(np.finfo(np.float64).eps)


def discounted_value(
    mdp: HostMDP,
    reward: Floats,
    magnitude: Floats,
    discount: float,
    *,
    maximize: bool,
    tolerance: float,
    depth: int = 0,
) -> Enclosure:
    """``V = opt_r (reward_r + discount * P_r V)``, enclosed.

    Args:
      mdp: the model.
      reward: ``float64[R]``, of any sign.
      magnitude: ``float64[R]``, the sum of the absolute values of what a reward is made of.
      discount: in ``[0, 1)``.
      maximize: which optimum.
      tolerance: the width of the enclosure asked for.
      depth: how many roundings stand behind each number of the model.
    """
    least = float(reward.min())
    ending = _ending(mdp, discount)
    open_ = np.ones(ending.num_states, bool)
    open_[-1] = False
    # What every step earns at least is earned for ever, and the rest is at least 0.
    cost = np.append(reward - least, 0)
    problem = ShortestPathProblem(ending, open_, np.zeros(open_.size), cost, depth=depth)
    found = optimum(problem, maximize=maximize, tolerance=tolerance, relative=False)
    always = least / (1 - discount)
    value, lower, upper = (x[:-1] + always for x in (found.value, found.lower, found.upper))
    # Terms of a reward may cancel, and their rounding stays.
    terms = int(np.diff(mdp.entry_start).max()) + depth + 4
    lost = terms * float(magnitude.max()) / (1 - discount)
    slack = 4 * _EPS * (np.abs(found.value[:-1]) + abs(always) + lost)
    return Enclosure(
        value,
        lower - slack,
        upper + slack,
        found.row[:-1],
        found.rounds,
        found.residual,
        found.method,
    )


def _ending(mdp: HostMDP, discount: float) -> HostMDP:
    """The model that ends, in one more state, with the rest of the discount."""
    end, rows = mdp.num_states, mdp.num_rows
    entry_start = np.append(mdp.entry_start + np.arange(rows + 1), 0)
    entry_start[-1] = entry_start[-2] + 1
    last = entry_start[1:-1] - 1
    place: Any = np.ones(int(entry_start[-1]), bool)
    place[last] = place[-1] = False
    successor = np.full(place.size, end, np.int32)
    probability = np.full(place.size, 1 - discount)
    probability[-1] = 1
    successor[place] = mdp.successor
    probability[place] = mdp.probability * discount
    return HostMDP(
        np.append(mdp.row_start, rows + 1).astype(np.int32), entry_start, successor, probability
    )
