"""Pgx's games, against pgx, ply by ply."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.environments.environment import Finite
from jaxltl.envs import from_pgx
from tests.envs.adapters.harness import load, same_as_own, single_precision, walk  # noqa: F401
from tests.support import random_action


@pytest.fixture(scope="module")
def pgx():
    return load("pgx")


def somebody(state, key):
    return random_action(key, Finite(state.legal_action_mask.shape[0]), state.legal_action_mask)


def first_free(state, key):
    return jnp.argmax(state.legal_action_mask)


def center(state):
    return (state._x.board[4] >= 0)[None]


@pytest.mark.parametrize("player", [0, 1])
def test_a_thousand_steps_are_plies_of_pgx(pgx, player):
    """A board is kept beside, of whose marks are where; the package moves the pieces."""
    own = pgx.make("tic_tac_toe")
    env = from_pgx(own, somebody, player, labels=center, propositions=["center"])
    assert env.actions == Finite(9) and env.observations.dtype == "bool"
    walks = jax.jit(jax.vmap(lambda key: walk(env, key, 500)))
    keys = jax.random.split(jax.random.key(player), 2)
    found = jax.tree.map(np.asarray, walks(keys))
    init, ply, choose = jax.jit(own.init), jax.jit(own.step), jax.jit(somebody)
    split, wins = jax.jit(jax.random.split, static_argnums=1), 0
    for row, key in enumerate(keys):
        seen, action, reward, terminated, truncated, last = (x[row] for x in found)

        def others(state, board, earned, key):
            while not state.terminated and state.current_player != player:
                key, pick, go = split(key, 3)
                place = int(choose(state, pick))
                board[place // 3, place % 3, 1] = True
                state = ply(state, place, go)
                earned += float(state.rewards[player])
            return state, board, earned

        def start(key):
            begin, rest = split(key, 2)
            return others(init(begin), np.zeros((3, 3, 2), bool), 0.0, rest)[:2]

        first, rest = split(key, 2)
        state, board = start(first)
        for t, k in enumerate(split(rest, 500)):
            np.testing.assert_array_equal(seen[t], board)
            assert not board[action[t] // 3, action[t] % 3].any(), "a move that is not legal"
            at, fresh = split(split(k, 2)[1], 2)
            go, wait = split(at, 2)
            board[action[t] // 3, action[t] % 3, 0] = True
            state = ply(state, action[t], go)
            state, board, earned = others(state, board, float(state.rewards[player]), wait)
            assert reward[t] == earned and terminated[t] == state.terminated and not truncated[t]
            np.testing.assert_array_equal(last[t], board)
            if terminated[t]:
                wins += earned == 1
                state, board = start(fresh)
    assert wins > 20


def test_what_is_not_legal_loses(pgx):
    env = from_pgx(pgx.make("tic_tac_toe"), first_free)
    step, world = jax.jit(env.step), jax.jit(env.reset)(jax.random.key(1))
    mine = step(world, jnp.int32(8), jax.random.key(0)).world
    assert not env.allowed(mine)[8] and env.allowed(mine).sum() in (6, 7)
    found = step(mine, jnp.int32(8), jax.random.key(0))
    assert found.reward == -1 and found.terminated and env.allowed(found.world).all()
    assert not env.reset(jax.random.key(1)).owed


def test_a_game_of_one_player(pgx):
    own = pgx.make("2048")
    env = from_pgx(own)

    def reset(key):
        state = own.init(jax.random.split(key)[0])
        return state, state.observation

    def step(state, action, key):
        after = own.step(state, action, jax.random.split(key)[0])
        return after, after.observation, after.rewards[0], after.terminated, after.truncated

    same_as_own(env, reset, step, num_walks=2, num_steps=500)


def test_what_is_not_pgxs_is_named(pgx):
    game = pgx.make("tic_tac_toe")
    for call, text in (
        (lambda: from_pgx(game), "for 2 players; give an opponent"),
        (lambda: from_pgx(game, somebody, 2), "player=2; tic_tac_toe has the players 0 to 1"),
        (lambda: from_pgx(game.step, somebody), "is a builtins.method, no environment of pgx"),
        (
            lambda: from_pgx(game, lambda state, key: state.legal_action_mask),
            r"opponent returns bool\[9\]; it must return the number",
        ),
        (lambda: from_pgx(pgx.make("2048"), somebody), "for 1 players.*None where there is"),
    ):
        with pytest.raises(ValueError, match=text):
            call()
