"""Navix's environments, against navix."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.environments.environment import Finite
from jaxltl.envs import from_navix
from tests.envs.adapters.harness import (  # noqa: F401
    both_ends,
    load,
    same_as_own,
    single_precision,
)


@pytest.fixture(scope="module")
def navix():
    return load("navix")


def events(state):
    player = state.get_player()
    return jnp.array([state.events.goal_reached.happened, player.position[0] == 1])


def test_a_thousand_steps_are_navixs_own(navix):
    own = navix.make("Navix-Dynamic-Obstacles-5x5-v0", max_steps=12)
    env = from_navix(own, labels=events, propositions=["goal", "top"])
    assert env.actions == Finite(len(own.action_set)) and env.horizon == 12

    def step(state, action, key):
        after = own.step(state, action)
        return after, after.observation, after.reward, after.is_termination(), after.is_truncation()

    def reset(key):
        start = own.reset(key)
        zero = start.action.astype(jnp.int32)
        return start.replace(action=zero, reward=start.reward.astype(float)), start.observation

    both_ends(same_as_own(env, reset, step))


def test_it_goes_on_after_an_end_only_when_it_is_told_to(navix):
    own = navix.make("Navix-Empty-5x5-v0", max_steps=2)
    env = from_navix(own, labels=events, propositions=["goal", "top"])
    step = jax.jit(env.step)
    world = before = env.reset(jax.random.PRNGKey(0))
    seen = []
    for _ in range(3):  # forward
        found = step(world, jnp.int32(2), jax.random.key(1))
        world = found.world
        seen.append((int(world.t), bool(found.truncated), bool(found.terminated)))
    assert seen == [(1, False, False), (2, True, False), (3, True, False)]
    # What was passed to a step is as it was.
    again = env.reset(jax.random.PRNGKey(0))
    for x, y in zip(jax.tree.leaves(before), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(x, y)
    assert env.labels(before).tolist() == [False, True]


def test_what_is_not_navixs_is_named(navix):
    with pytest.raises(ValueError, match=r"env is a builtins.str.*give navix.make\(name\)"):
        from_navix("Navix-Empty-5x5-v0")
