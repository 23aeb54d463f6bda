"""Games of the package pgx, for one player against a fixed policy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import Environment, Timestep, as_partial, make_environment
from jaxltl.core.pretty_print import brief
from jaxltl.envs.adapters.common import (
    Foreign,
    Held,
    arrays,
    copied,
    labels_of_state,
    package,
    require_environment,
    some_allowed,
    timestep,
)


@brief
class Turn(NamedTuple):
    """Pgx's state at a turn of the player or at the end, and the reward `owed` for earlier moves."""

    state: PyTree
    owed: jax.Array


def from_pgx(
    env: Foreign,
    opponent: Callable[..., jax.Array] | None = None,
    player: int = 0,
    *,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] = (),
) -> Environment:
    """A Pgx game as a single-agent environment; the other players follow a fixed policy.

    A step is a move of the player and those of the others until the player's next turn or the end; its
    reward is the sum over these moves. Legal actions are `allowed`; an illegal one ends the game with
    the package's penalty. The player's view is observed, also at the end of a game.

    Args:
      env: as ``pgx.make(name)`` returns it.
      opponent: ``(state, key) -> action``, of Pgx's state with the view of the current player; a
        function or a ``Partial``. None for games of one player.
      player: the index of the learning player. The first player may be random.
      labels, propositions: ``state -> bool[P]``, of Pgx's state at the player's turn, and its names.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`; its states are pairs of Pgx's
      ``state`` and the reward ``owed`` for moves before the player's first.

    Raises:
      ValueError: not a Pgx environment, no opponent, or no such player.
      ImportError: pgx is not installed.

    >>> import pgx
    >>> def anything(state, key):
    ...     return jax.random.categorical(key, jnp.log(state.legal_action_mask))
    >>> from_pgx(pgx.make("tic_tac_toe"), anything).actions.num
    9
    """
    require_environment("pgx", env, package("pgx").Env, "pgx.make(name)")
    if not (isinstance(player, int | np.integer) and 0 <= player < env.num_players):
        raise ValueError(
            f"from_pgx: player={player!r}; {env.id} has the players 0 to {env.num_players - 1}."
        )
    if (opponent is None) != (env.num_players == 1):
        raise ValueError(
            f"from_pgx: {env.id} is for {env.num_players} players; give an opponent, "
            "(state, key) -> action, where there are several, and None where there is one."
        )
    game = Held(env), int(player), None if opponent is None else as_partial(opponent)
    return make_environment(
        Partial(_reset, *game),
        Partial(_step, *game),
        Partial(_observe, *game[:2]),
        actions=int(env.num_actions),
        labels=labels_of_state(labels),
        propositions=propositions,
        allowed=Partial(_allowed),
    )


def _reset(held: Held, player: int, opponent: Partial | None, key: Key) -> Turn:
    start, others = jax.random.split(key)
    state = arrays(held.it.init(start))
    return Turn(*_await_turn(held, player, opponent, state, jnp.zeros(()), others))


def _step(
    held: Held, player: int, opponent: Partial | None, world: Turn, action: PyTree, key: Key
) -> Timestep:
    own, others = jax.random.split(key)
    state = arrays(held.it.step(copied(world.state), action, own), world.state)
    earned = world.owed + state.rewards[player]
    state, earned = _await_turn(held, player, opponent, state, earned, others)
    after = Turn(state, jnp.zeros_like(world.owed))
    return timestep(after, world, earned, state.terminated, state.truncated)


def _await_turn(
    held: Held, player: int, opponent: Partial | None, state: PyTree, earned: jax.Array, key: Key
) -> tuple[PyTree, jax.Array]:
    """Plays the others' moves until the player moves or the game ends; state and reward."""
    if opponent is None:
        return state, earned

    def waits(carry: PyTree) -> jax.Array:
        state = carry[0]
        return ~(state.terminated | state.truncated) & (state.current_player != player)

    def move(carry: PyTree) -> PyTree:
        state, earned, key = carry
        key, choose, go = jax.random.split(key, 3)
        action = jnp.asarray(opponent(copied(state), choose))
        if action.shape or action.dtype.kind not in "iu":
            raise ValueError(
                f"opponent returns {action.dtype}{list(action.shape)}; it must return the number "
                "of one action."
            )
        after = arrays(held.it.step(copied(state), action, go), state)
        return after, earned + after.rewards[player].astype(earned.dtype), key

    state, earned, _ = lax.while_loop(waits, move, (state, earned, key))
    return state, earned


def _observe(held: Held, player: int, world: Turn) -> PyTree:
    # The public attribute gives the next player, which differs at the end of a game.
    return lax.stop_gradient(held.it._observe(world.state, player))


def _allowed(world: Turn) -> jax.Array:
    return some_allowed(world.state.legal_action_mask)
