"""Values of small games by brute force over pairs of memoryless strategies, in fractions."""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from tests import reference

LOST = -float("inf")


def rates(system: np.ndarray, discount: float, per: str) -> list[Fraction]:
    """What each state's moves are discounted by."""
    free = ~system & (per == "system_move")
    return [Fraction(1) if f else Fraction(discount) for f in free]


def chain_value(transition, reward, rate, stuck) -> np.ndarray:
    """Value of a chain; minus infinity where it can reach a state that is stuck.

    `transition` is ``[S, S]`` and `reward` ``[S]``, of fractions; stuck rows are not read.
    """
    step = np.array(transition, float) > 0
    step[stuck] = False
    lost = (reference.closure(step) & stuck).any(axis=1)
    value = np.full(len(reward), LOST, object)
    kept = np.flatnonzero(~lost)
    if kept.size:
        discounted = np.array(rate, object)[kept, None] * transition[np.ix_(kept, kept)]
        matrix = np.eye(kept.size, dtype=int) - discounted
        value[kept] = reference.exact_solve(matrix, reward[kept])
    return value


def joint_values(model, system, reward, rate, allowed, mixture=None) -> Iterator[tuple]:
    """``(policy, value)`` for each memoryless choice among the allowed moves.

    With a `mixture` ``[S, A]`` the system's moves are drawn, and only the environment chooses.
    """
    transition, reward = reference.FRACTION(model.transition), reference.FRACTION(reward)
    states = np.arange(model.num_states)
    stuck = ~allowed.any(axis=1)
    choices = allowed | stuck[:, None]
    if mixture is not None:
        choices = choices & (~system[:, None] | (np.arange(model.num_actions) == 0))
        choices[system, 0] = True
        drawn = reference.FRACTION(mixture)
        mean_row, mean_reward = reference.chain(transition, drawn), (drawn * reward).sum(axis=1)
    for policy in reference.memoryless_policies(choices):
        rows, paid = transition[states, list(policy)], reward[states, list(policy)]
        if mixture is not None:
            rows = np.where(system[:, None], mean_row, rows)
            paid = np.where(system, mean_reward, paid)
        yield policy, chain_value(rows, paid, rate, stuck)


def maximin(pairs, system: np.ndarray) -> np.ndarray:
    """``max`` over the system's choices of ``min`` over the environment's, state by state."""
    worst: dict[tuple, np.ndarray] = {}
    for policy, value in pairs:
        mine = tuple(a for a, s in zip(policy, system, strict=True) if s)
        worst[mine] = np.minimum(worst.get(mine, value), value)
    return np.maximum.reduce(list(worst.values()))


def minimax_value(model, system, reward, discount, per, allowed=None) -> np.ndarray:
    allowed = model.available if allowed is None else allowed
    pairs = joint_values(model, system, reward, rates(system, discount, per), allowed)
    return maximin(pairs, system)


def strategy_value(model, system, strategy, reward, discount, per) -> np.ndarray:
    """Worst case of a stochastic strategy ``[S, A]``."""
    rate = rates(system, discount, per)
    pairs = joint_values(model, system, reward, rate, model.available, strategy)
    return np.minimum.reduce([value for _, value in pairs])


def returns(model, system: np.ndarray) -> bool:
    """Whether the environment has to come back to the system, whatever it does."""
    return not reference.avoidable(model, system).any()


# --- mean payoff ---------------------------------------------------------------------------


def cycle_mean(successor, reward, start: int) -> Fraction:
    """The mean of the cycle in which the path from `start` ends."""
    seen: dict[int, int] = {}
    paid: list[Fraction] = []
    state = start
    while state not in seen:
        seen[state] = len(paid)
        paid.append(Fraction(reward[state]))
        state = int(successor[state])
    cycle = paid[seen[state] :]
    return sum(cycle, Fraction(0)) / len(cycle)


def mean_payoffs(successor, available, reward) -> Iterator[tuple]:
    states = np.arange(len(available))
    for policy in reference.memoryless_policies(available):
        chosen = list(policy)
        step, paid = successor[states, chosen], reward[states, chosen].tolist()
        yield policy, np.array([cycle_mean(step, paid, s) for s in states], object)


def mean_payoff(successor, available, system, reward) -> np.ndarray:
    return maximin(mean_payoffs(successor, available, reward), system)
