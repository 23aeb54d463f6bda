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
from jaxltl.core.sparse.interval.policy_iteration import PathAccuracy
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
    accuracy: PathAccuracy  # requested width


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


def improve_strategies(
    model: UncertainMDP,
    pair: tuple[Integers, Floats],
    solve: Subproblems,
    *,
    policy_leads: bool,
    maximize: bool,
) -> RobustValues:
    """Strategy iteration from the choices of the leader in `pair`; `maximize` is its direction."""
    (row, p), mdp, sign, rounds = pair, model.mdp, 1 if maximize else -1, 0

    def policy_fixed(row: Integers, maximize: bool) -> Enclosure:
        return solve.joint(model.under_policy(row)[0], solve.cost[row], maximize)

    def nature_fixed(p: Floats, maximize: bool) -> Enclosure:
        return under_nature(solve.fixed_nature, model, p, solve.cost, maximize)

    while True:
        rounds += 1
        answered = (
            policy_fixed(row, not maximize) if policy_leads else nature_fixed(p, not maximize)
        )
        gain, q = row_gains(
            model, answered.value, solve.cost, nature_maximizes=maximize != policy_leads
        )
        noise = gain_noise(answered.value)
        best = mdp.over_choices(np.maximum if policy_leads else np.minimum, sign * gain)
        first = mdp.first_choice(sign * gain == best[mdp.state])[1].astype(np.int64)
        if policy_leads:
            more, better, p = best, best > noise, q
        else:
            now = model.sum_rows(p * differences(model, answered.value)) + solve.cost
            more, row = sign * (gain - now), first
            better = more > noise[mdp.state]
        last = rounds == _ROUNDS or not better.any()
        if last or _tests_bounds(rounds):
            other = nature_fixed(p, maximize) if policy_leads else policy_fixed(row, maximize)
            below, above = (answered, other) if maximize else (other, answered)
            low, high = below.lower, above.upper
            if last or solve.accuracy.accepts(low, high):
                break
        if policy_leads:
            row = np.where(better, first, row)
        else:
            p = np.where(better[mdp.row], q, p)
    rounds, residual = rounds + other.rounds, float(more.max())
    return enclosed_values(answered.value, (low, high), row, p, rounds=rounds, residual=residual)


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
