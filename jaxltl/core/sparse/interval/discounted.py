"""Discounted values of interval models, by policy iteration of both who choose."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.sparse.interval.reachability import Robust
from jaxltl.core.sparse.interval.uncertainty_set import HostInterval
from jaxltl.core.sparse.linear.elimination import factorize
from jaxltl.core.sparse.linear.topological_order import Edges, ordered_components

_EPS = float(np.finfo(np.float64).eps)
_ROUNDS = 300


def discounted(
    model: HostInterval,
    reward: Floats,
    discount: Floats,
    *,
    maximize: bool,
    large: bool,
    tolerance: float,
) -> Robust:
    """``V = opt_r opt_p sum_t p_t (reward_t + discount_r V_t)``, enclosed.

    Args:
      model: the model.
      reward: ``float64[T]``, what each entry earns, of any sign.
      discount: ``float64[R]``, below 1 in every second step at least.
      maximize: whether the policy makes the value large.
      large: whether nature does.
      tolerance: the width at which to stop.
    """
    mdp = model.mdp
    label = ordered_components(Edges(mdp.entry_start[mdp.row_start], mdp.successor))
    rate = float(discount[discount < 1].max(initial=0))
    # A step that is not discounted comes at most after each one that is.
    steps = (2 if (discount == 1).any() else 1) / (1 - rate)
    best, sign = (np.maximum, 1) if maximize else (np.minimum, -1)
    value = np.zeros(mdp.num_states)
    row: Integers = mdp.row_start[:-1].astype(np.int64)
    p = model.nature(reward, maximize=large)
    low, high = np.full(value.size, -np.inf), np.full(value.size, np.inf)
    rounds, residual = 0, np.inf
    while rounds < _ROUNDS:
        rounds += 1
        solved = _solved(model, reward, discount, row, p, label)
        if solved is None or not np.isfinite(solved).all():
            break
        value = solved
        q, image, noise = _backup(model, reward, discount, value, large)
        now = model.total(p * _ahead(model, reward, discount, value))
        # Nature answers first; only then does the policy improve.
        answers = (image - now) * (1 if large else -1) > noise
        answers &= np.isin(np.arange(mdp.num_rows), row)
        found = mdp.over_choices(best, image)
        residual = float(np.abs(found - value).max())
        error = (residual + float(noise.max())) * steps
        if error < (high - low).max() / 2:
            low, high = value - error, value + error
        if 2 * error <= tolerance:
            break
        better = sign * (found - image[row]) > noise[row]
        if not answers.any() and not better.any():
            break
        p = np.where((answers | ~np.isin(np.arange(mdp.num_rows), row))[mdp.row], q, p)
        if not answers.any():
            row = np.where(better, mdp.first_choice(image == found[mdp.state])[1], row)
    return Robust(
        np.clip(value, low, high),
        low,
        high,
        row,
        p,
        rounds,
        residual,
        "policy iteration with nature",
    )


def _backup(
    model: HostInterval, reward: Floats, discount: Floats, value: Floats, large: bool
) -> tuple[Floats, Floats, Floats]:
    """Nature's distributions, the value of each row, and how much rounding may change it."""
    ahead = _ahead(model, reward, discount, value)
    q = model.nature(ahead, maximize=large)
    size = np.abs(reward).max(initial=0) + np.abs(value).max(initial=0)
    return q, model.total(q * ahead), 4 * model.rounding * size


def _ahead(model: HostInterval, reward: Floats, discount: Floats, value: Floats) -> Floats:
    """What each entry earns and leads to."""
    return reward + discount[model.mdp.row] * value[model.mdp.successor]


def _solved(
    model: HostInterval,
    reward: Floats,
    discount: Floats,
    row: Integers,
    p: Floats,
    label: Integers,
) -> Any:
    """The value of a policy and nature; None where the system is singular."""
    chain, entry = model.chain(row)
    earned = chain.total(p[entry] * reward[entry])
    mdp = chain.fixed(p[entry])
    matrix = mdp.matrix.copy()
    matrix.data = matrix.data * discount[row][mdp.row]
    system = factorize(matrix, label, np.arange(mdp.num_states))
    return None if system is None else system.solve(earned)
