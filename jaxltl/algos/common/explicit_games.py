"""Explicit games for learners: validated inputs, and sampling inside ``jit``."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import ArrayLike, NDArray

from jaxltl.algos.common import splitmix
from jaxltl.core.models.game import Game, as_padded_game
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.protocols import Model
from jaxltl.core.types import require_shape

# --- on the host ----------------------------------------------------------------------------


def explicit_game(game: Model) -> Game:
    """A game on a padded MDP; raises ValueError if its model is of another kind."""
    game = as_padded_game(game)
    if not isinstance(game.mdp, MDP):
        raise ValueError(
            f"the game's model is a {type(game.mdp).__name__}; learners sample an explicit MDP: "
            "pass restrict(game).model, or convert it."
        )
    return game


def initial_distribution(game: Game, initial: ArrayLike | None) -> NDArray[np.float64]:
    """The checked distribution over initial states, ``float64[S]``; default the game's."""
    distribution = np.asarray(game.initial if initial is None else initial, float)
    require_shape("initial", distribution, (game.num_states,))
    check_distributions("initial", distribution[None], np.ones((1, game.num_states), bool))
    return distribution


def uniform_rows(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """The uniform distribution over the actions of each row; zero for rows without any."""
    return mask / np.maximum(mask.sum(-1, keepdims=True), 1)


def check_reward(game: Game, reward: ArrayLike) -> jax.Array:
    """The checked reward; zero where there is no action, averaged over equal successors."""
    reward = np.asarray(reward, float)
    used = np.asarray(game.available) if reward.ndim == 2 else np.asarray(game.mdp.probability) > 0
    require_shape("reward", reward, used.shape)
    wrong = np.argwhere(used & ~np.isfinite(reward))
    if wrong.size:
        raise ValueError(
            f"the reward of state {wrong[0][0]}, action {wrong[0][1]} is "
            f"{reward[tuple(wrong[0])]}; it must be finite."
        )
    reward = np.where(used, reward, 0)
    if reward.ndim == 3:
        # Only the successor is observed, not its place in the list.
        successor, weight = np.asarray(game.mdp.successor), np.asarray(game.mdp.probability)
        same = (successor[..., :, None] == successor[..., None, :]) * weight[..., None, :]
        total = same.sum(-1)
        mean = (same * reward[..., None, :]).sum(-1) / np.where(total > 0, total, 1)
        reward = np.where(used, mean, 0)
    return jnp.asarray(reward, game.dtype)


def check_distributions(
    name: str,
    rows: NDArray[np.float64],
    support: NDArray[np.bool_],
    skip: NDArray[np.bool_] | bool = False,
) -> None:
    """Raises ValueError unless each row, but for those skipped, is a distribution on its support."""
    bad = ~np.isfinite(rows).all(-1) | (rows < 0).any(-1) | ((rows > 0) & ~support).any(-1)
    bad |= np.abs(rows.sum(-1) - 1) > 1e-6
    bad &= ~np.asarray(skip)
    if bad.any():
        raise ValueError(
            f"{name}: the row of state {int(np.argmax(bad))} is not a distribution over available "
            "actions: entries must be at least 0, zero at other actions, and sum to 1."
            if len(rows) > 1
            else f"{name} is not a distribution: entries must be at least 0 and sum to 1."
        )


def environment_policy(
    mask: NDArray[np.bool_], system: NDArray[np.bool_], environment: ArrayLike
) -> NDArray[np.float64]:
    """A checked policy ``float64[S, A]`` of the environment; rows of the system are uniform."""
    environment = np.asarray(environment, float)
    require_shape("environment", environment, mask.shape)
    rows = np.where(system[:, None], uniform_rows(mask), environment)
    check_distributions("environment", rows, mask, system)
    return rows


def cumulative(distribution: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Cumulative weights over the last axis in units of ``2 ** -31``, for draws by 32 random bits."""
    total, some = np.rint(np.cumsum(distribution, -1) * 2.0**31), distribution > 0
    # The number of positive weights after each one.
    after: NDArray[np.int64] = np.cumsum(some[..., ::-1], -1)[..., ::-1] - some
    return np.where(after > 0, np.minimum(total, 2.0**31), 2.0**31).astype(np.uint32)


# --- inside jit -----------------------------------------------------------------------------


def draw(table: jax.Array, words: jax.Array) -> jax.Array:
    """States drawn from a table of :func:`cumulative` weights by 32 random bits each.

    ``searchsorted`` to the right by bisection; the last entry, ``2 ** 31``, exceeds every word's
    upper half. Two bisections an iteration: the loop costs more than they do, and if it were
    unrolled, XLA would recompute them in each consumer of the state.
    """
    point, size = words >> 1, len(table)

    def bisect_twice(i: jax.Array, first: jax.Array) -> jax.Array:
        for step in (2 * i, 2 * i + 1):
            half = ((size - 1 >> step) + 1) // 2  # of the remaining candidates
            beyond = take(table, first + jnp.maximum(half, 1) - 1) <= point
            first = jnp.where(beyond, first + half, first)
        return first

    passes = -(-(size - 1).bit_length() // 2)
    return lax.fori_loop(0, passes, bisect_twice, jnp.zeros(point.shape, jnp.int32))


def draw_from_rows(table: jax.Array, row: jax.Array, words: jax.Array) -> jax.Array:
    """Actions ``int32[N]`` drawn from given rows of :func:`cumulative` weights ``uint32[S, A]``."""
    return jnp.sum(take(table, row) <= (words >> 1)[:, None], -1, dtype=jnp.int32)


def draw_weighted(weight: jax.Array, words: jax.Array) -> jax.Array:
    """Actions with probabilities proportional to weights ``[..., A]``, never one of weight zero."""
    total = jnp.cumsum(weight, axis=-1)
    # Stays below the total in spite of rounding.
    uniform = jnp.minimum(splitmix.uniform(words, weight.dtype), 1 - jnp.finfo(weight.dtype).eps)
    return jnp.argmax(total > (uniform * total[..., -1])[..., None], axis=-1).astype(jnp.int32)


def observed_reward(
    game: Game, reward: jax.Array, state: jax.Array, action: jax.Array, successor: jax.Array
) -> jax.Array:
    """Rewards of observed transitions, one for each chain."""
    pair = state * game.num_actions + action
    if reward.ndim == 2:
        return take(reward.ravel(), pair)
    slot = successor_slot(game, state, action, successor)
    return take(reward.ravel(), pair * game.num_successors + slot)


def successor_slot(
    game: Game, state: jax.Array, action: jax.Array, successor: jax.Array
) -> jax.Array:
    """The first place of each successor in its list; 0 if it is not there."""
    mdp = game.mdp
    listed = mdp.successor[state, action] == successor[..., None]
    return jnp.argmax(listed & (mdp.probability[state, action] > 0), axis=-1).astype(jnp.int32)


def take(x: jax.Array, index: jax.Array | tuple[jax.Array, ...]) -> jax.Array:
    """Entries at indices known to be in bounds, without checks."""
    return x.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)
