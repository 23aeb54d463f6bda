"""What learners that play share: checked rewards and distributions, and draws from them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.models.game import Game
from jaxltl.core.types import require_shape

# --- on the host ----------------------------------------------------------------------------


def check_reward(game: Game, reward: Any) -> jax.Array:
    """The checked reward, zero where there is no move; equal successors share one reward."""
    reward = np.asarray(reward, float)
    used = np.asarray(game.mdp.probability) > 0
    if reward.ndim == 2:
        require_shape("reward", reward, used.shape[:2])
        used = np.asarray(game.available)
    else:
        require_shape("reward", reward, used.shape)
    wrong = np.argwhere(used & ~np.isfinite(reward))
    if wrong.size:
        raise ValueError(
            f"the reward of state {wrong[0][0]}, action {wrong[0][1]} is "
            f"{reward[tuple(wrong[0])]}; it must be finite."
        )
    reward = np.where(used, reward, 0)
    if reward.ndim == 3:
        # Only the successor is seen, not which entry of the list it came from.
        successor, weight = np.asarray(game.mdp.successor), np.asarray(game.mdp.probability)
        same = (successor[..., :, None] == successor[..., None, :]) * weight[..., None, :]
        total = same.sum(-1)
        mean = (same * reward[..., None, :]).sum(-1) / np.where(total > 0, total, 1)
        reward = np.where(used, mean, 0)
    return jnp.asarray(reward, game.dtype)


def check_distributions(
    name: str, rows: np.ndarray, support: np.ndarray, skip: np.ndarray | bool = False
) -> None:
    """Raises unless rows are distributions over a support, but for some rows."""
    bad = ~np.isfinite(rows).all(-1) | (rows < 0).any(-1) | ((rows > 0) & ~support).any(-1)
    bad |= np.abs(rows.sum(-1) - 1) > 1e-6
    bad &= ~np.asarray(skip)
    if bad.any():
        where = f" of state {int(np.argmax(bad))}" if len(rows) > 1 else ""
        raise ValueError(
            f"{name}: the row{where} is no distribution over available moves: entries must be "
            "at least 0, zero at others, and sum to 1."
            if len(rows) > 1
            else f"{name} is no distribution: entries must be at least 0 and sum to 1."
        )


def cumulative(distribution: np.ndarray) -> np.ndarray:
    """``uint32[S]`` for :func:`draw`: cumulative weights in units of ``2 ** -31``."""
    total = np.rint(np.cumsum(distribution) * 2.0**31)
    last = np.flatnonzero(distribution > 0)[-1]
    total[last:] = 2.0**31
    return np.minimum(total, 2.0**31).astype(np.uint32)


# --- for chains, compiled -------------------------------------------------------------------


def draw(table: jax.Array, words: jax.Array) -> jax.Array:
    """States drawn from a table of :func:`cumulative` weights by 32 random bits each.

    The first entry above half of the word, by halving: ``searchsorted`` to the right, which the
    last entry, ``2 ** 31``, is never passed by. Two halvings a pass: a pass costs more than they
    do, and more of them would be computed anew by whatever reads the state.
    """
    point, size = words >> 1, len(table)

    def halve_twice(i: jax.Array, first: jax.Array) -> jax.Array:
        for step in (2 * i, 2 * i + 1):
            half = ((size - 1 >> step) + 1) // 2  # of those that it may be, from the first
            beyond = take(table, first + jnp.maximum(half, 1) - 1) <= point
            first = jnp.where(beyond, first + half, first)
        return first

    passes = -(-(size - 1).bit_length() // 2)
    return lax.fori_loop(0, passes, halve_twice, jnp.zeros(point.shape, jnp.int32))


def observed_reward(
    game: Game, reward: jax.Array, state: jax.Array, action: jax.Array, successor: jax.Array
) -> jax.Array:
    """The rewards of the transitions made, and of no others: one for each chain."""
    pair = state * game.num_actions + action
    if reward.ndim == 2:
        return take(reward.ravel(), pair)
    slot = successor_slot(game, state, action, successor)
    return take(reward.ravel(), pair * game.num_successors + slot)


def successor_slot(
    game: Game, state: jax.Array, action: jax.Array, successor: jax.Array
) -> jax.Array:
    """Where each successor stands in its list: the first place, or 0 if it is not there."""
    mdp = game.mdp
    listed = mdp.successor[state, action] == successor[..., None]
    found = listed & (mdp.probability[state, action] > 0)
    return jnp.argmax(found, axis=-1).astype(jnp.int32)


def take(x: jax.Array, index: Any) -> jax.Array:
    """Entries at places that are known to exist, without checks of bounds."""
    return x.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)
