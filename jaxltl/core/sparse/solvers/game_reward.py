"""Certified total rewards of two-player games over the infinite horizon."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.robust_values import gain_noise
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import offsets_from_counts
from jaxltl.core.sparse.solvers.reachability import reward_forever
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure

_ROUNDS = 100


def game_reward_forever(
    mdp: HostMDP, reward: Floats, maximizing: Booleans, *, tolerance: float = 1e-6, depth: int = 0
) -> Enclosure:
    """Value of the total reward of a game, by strategy improvement (Hoffman and Karp 1966).

    The least nonnegative solution of ``x(s) = opt_r (c_r + P_r x)``, a maximum in the states
    `maximizing` ``bool[S]`` and a minimum elsewhere; rewards ``float64[R]`` are at least 0. The
    minimiser's optimal answer to a strategy of the maximiser bounds the value from below, and the
    maximiser's answer to one of the minimiser from above; both are values of decision processes. A
    strategy of the maximiser without a strict improvement has a value that solves the equation, so
    it is at least the least solution, and any optimal answer to it is optimal for the minimiser.
    """
    joint = reward_forever(mdp, reward, maximize=True, tolerance=tolerance, depth=depth)
    if maximizing.all():
        return joint
    row, half = joint.row, tolerance / 2
    low, high, rounds = np.zeros(mdp.num_states), np.full(mdp.num_states, np.inf), 0
    while True:
        rounds += 1
        below = optimal_answer(
            mdp, reward, maximizing, row, maximize=False, tolerance=half, depth=depth
        )
        low = np.maximum(low, below.lower)
        value = below.value
        with np.errstate(invalid="ignore"):
            gain = reward + mdp.expectation(value) - value[mdp.state]
        gain = np.where(np.isinf(value)[mdp.state], 0, gain)
        best = mdp.over_choices(np.maximum, gain)
        noise = gain_noise(np.where(np.isfinite(value), value, 0))
        better = maximizing & (best > noise)
        last = rounds == _ROUNDS or not better.any()
        # The bound from above costs a decision process more: after 1, 2, 4, 8, ... rounds.
        if last or rounds & (rounds - 1) == 0:
            answer = np.where(maximizing, row, below.row)
            above = optimal_answer(
                mdp, reward, ~maximizing, answer, maximize=True, tolerance=half, depth=depth
            )
            high = np.minimum(high, above.upper)
            with np.errstate(invalid="ignore"):
                narrow = (low == high) | (high - low <= tolerance * low)
            if last or narrow.all():
                break
        first = mdp.first_choice(gain == best[mdp.state])[1]
        row = np.where(better, first, row)
    high = np.maximum(low, high)
    return replace(
        below,
        value=np.clip(value, low, high),
        lower=low,
        upper=high,
        row=np.where(maximizing, row, below.row),
        rounds=rounds,
        residual=float(np.where(maximizing & np.isfinite(best), best, 0).max(initial=0)),
        method="strategy improvement of two players",
    )


def optimal_answer(
    mdp: HostMDP,
    reward: Floats,
    fixed: Booleans,
    row: Integers,
    *,
    maximize: bool,
    tolerance: float,
    depth: int = 0,
) -> Enclosure:
    """The optimum of one player, where the states `fixed` of the other one have the rows `row`."""
    kept = ~fixed[mdp.state]
    kept[row[fixed]] = True
    index = np.flatnonzero(kept)
    starts = offsets_from_counts(np.bincount(mdp.state[index], minlength=mdp.num_states))
    part = mdp.select(starts, index)[0]
    optimum = reward_forever(
        part, reward[index], maximize=maximize, tolerance=tolerance, depth=depth
    )
    return replace(optimum, row=index[optimum.row])
