"""Strategy improvement of policy against nature (Hoffman and Karp 1966), with certified bounds.

The leader is the side that makes a probability large, or a sum small, which must reach its target.
It improves its choices as long as it gains, while the other side answers optimally. At the end the
value is bounded from each side by fixing one player and optimising the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.sparse.interval.policy_iteration import Accuracy
from jaxltl.core.sparse.interval.robust_values import (
    RobustValues,
    differences,
    gain_noise,
    row_gains,
)
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure

_ROUNDS = 100

MDPSolver = Callable[[HostMDP, Floats, bool], Enclosure]
JointSolver = Callable[[UncertainMDP, Floats, bool], RobustValues]


@dataclass(frozen=True)
class Subproblems:
    """Solvers of the problems in which one side is fixed."""

    fixed_nature: MDPSolver  # the optimum of an MDP, from rewards of rows and whether it is maximal
    joint: JointSolver  # the joint optimum of an uncertain MDP
    cost: Floats  # float64[R], rewards of the rows
    accuracy: Accuracy  # requested width


def under_nature(
    solve: MDPSolver, model: UncertainMDP, p: Floats, cost: Floats, maximize: bool
) -> Enclosure:
    """The policy's optimum where nature picks distributions next to p."""
    exact, able = model.nearest_distributions(p)
    optimum = solve(model.resolve(exact), cost, maximize)
    if able:
        return optimum
    return replace(
        optimum, lower=np.zeros_like(optimum.lower), upper=np.full_like(optimum.upper, np.inf)
    )


def improve_policy(
    model: UncertainMDP, row: Integers, solve: Subproblems, *, maximize: bool
) -> RobustValues:
    """Strategy iteration led by the policy."""
    mdp, sign, rounds = model.mdp, 1 if maximize else -1, 0
    while True:
        rounds += 1
        inner = solve.joint(model.under_policy(row)[0], solve.cost[row], not maximize)
        gain, p = row_gains(model, inner.value, solve.cost, nature_maximizes=not maximize)
        best = mdp.over_choices(np.maximum, sign * gain)
        better = best > gain_noise(inner.value)
        last = rounds == _ROUNDS or not better.any()
        if last or _tests_bounds(rounds):
            other = under_nature(solve.fixed_nature, model, p, solve.cost, maximize)
            low, high = (inner.lower, other.upper) if maximize else (other.lower, inner.upper)
            if last or solve.accuracy.accepts(low, high):
                break
        new = mdp.first_choice(sign * gain == best[mdp.state])[1]
        row = np.where(better, new, row)
    return enclosed_values(
        inner.value, (low, high), row, p, rounds=rounds + other.rounds, residual=float(best.max())
    )


def improve_nature(
    model: UncertainMDP, p: Floats, solve: Subproblems, *, nature_maximizes: bool
) -> RobustValues:
    """Strategy iteration led by nature."""
    mdp, up, rounds = model.mdp, nature_maximizes, 0
    sign = 1 if up else -1
    while True:
        rounds += 1
        outer = under_nature(solve.fixed_nature, model, p, solve.cost, not up)
        gain, q = row_gains(model, outer.value, solve.cost, nature_maximizes=up)
        now = model.sum_rows(p * differences(model, outer.value)) + solve.cost
        more = sign * (gain - now)
        better = more > gain_noise(outer.value)[mdp.state]
        last = rounds == _ROUNDS or not better.any()
        if last or _tests_bounds(rounds):
            best = mdp.over_choices(np.minimum, sign * gain)
            row = mdp.first_choice(sign * gain == best[mdp.state])[1].astype(np.int64)
            inner = solve.joint(model.under_policy(row)[0], solve.cost[row], up)
            low, high = (outer.lower, inner.upper) if up else (inner.lower, outer.upper)
            if last or solve.accuracy.accepts(low, high):
                break
        p = np.where(better[mdp.row], q, p)
    return enclosed_values(
        outer.value, (low, high), row, p, rounds=rounds + inner.rounds, residual=float(more.max())
    )


def _tests_bounds(rounds: int) -> bool:
    """True if bounds are computed before the last round: after 4, 8, 16, ... rounds."""
    return rounds >= 4 and rounds & (rounds - 1) == 0


def enclosed_values(
    value: Floats,
    bounds: tuple[Floats, Floats],
    row: Integers,
    p: Floats,
    *,
    rounds: int,
    residual: float,
) -> RobustValues:
    """Values clipped to their bounds."""
    low, high = bounds[0], np.maximum(*bounds)
    return RobustValues(
        value=np.clip(value, low, high),
        lower=low,
        upper=high,
        row=row,
        probability=p,
        rounds=rounds,
        residual=abs(residual),
        method="strategy improvement against nature",
    )
