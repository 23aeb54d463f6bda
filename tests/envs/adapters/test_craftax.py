"""Craftax, against craftax."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.environments.environment import Finite
from jaxltl.envs import from_craftax
from tests.envs.adapters.harness import load, single_precision, walk  # noqa: F401


@pytest.fixture(scope="module")
def craftax():
    return load("craftax.craftax_env")


def has_wood(state):
    return (state.inventory.wood > 0)[None]


@pytest.mark.exhaustive
def test_a_thousand_steps_are_craftaxs_own(craftax):
    """The keys are split as its own autoreset splits them, so that walks of episodes are equal."""
    name = "Craftax-Classic-Symbolic-v1"
    own = craftax.make_craftax_env_from_name(name, auto_reset=True)
    plain = craftax.make_craftax_env_from_name(name, auto_reset=False)
    params = plain.default_params.replace(max_timesteps=40)
    env = from_craftax(plain, params, labels=has_wood, propositions=["wood"])
    assert env.actions == Finite(17) and env.horizon == 40
    keys = jax.random.split(jax.random.key(2), 4)
    seen, action, reward, terminated, truncated, last = jax.jit(
        jax.vmap(lambda key: walk(env, key, 250))
    )(keys)

    def theirs(key, actions):
        first, rest = jax.random.split(key)

        def go(carry, given):
            observation, state = carry
            key, action = given
            after, state, reward, done, _ = own.step(
                jax.random.split(key)[1], state, action, params
            )
            return (after, state), (observation, reward, done)

        return jax.lax.scan(go, own.reset(first, params), (jax.random.split(rest, 250), actions))[1]

    theirs = jax.jit(theirs)
    for row, key in enumerate(keys):
        observation, earned, done = theirs(key, action[row])
        np.testing.assert_allclose(seen[row], observation, rtol=2e-5, atol=2e-6)
        np.testing.assert_allclose(reward[row], earned, rtol=2e-5, atol=2e-6)
        np.testing.assert_array_equal(terminated[row] | truncated[row], done)
        goes_on = ~np.asarray(done)[:-1]
        np.testing.assert_allclose(
            last[row][:-1][goes_on], observation[1:][goes_on], rtol=2e-5, atol=2e-6
        )
    assert truncated.sum() >= 20
    # One that dies, in the middle and at the limit.
    world = jax.jit(env.reset)(keys[0])
    assert not env.labels(world)[0]
    step = jax.jit(env.step)
    for time in (0, 39):
        dead = step(world.replace(player_health=0, timestep=time), jnp.int32(0), keys[1])
        alive = step(world.replace(timestep=time), jnp.int32(0), keys[1])
        assert dead.terminated and not alive.terminated
        assert dead.truncated == alive.truncated == (time == 39)


def test_what_is_not_craftaxs_is_named(craftax):
    own = craftax.make_craftax_env_from_name("Craftax-Classic-Symbolic-v1", auto_reset=True)
    with pytest.raises(ValueError, match=r"CraftaxClassicSymbolicEnv starts anew .*auto_reset=F"):
        from_craftax(own)
    with pytest.raises(ValueError, match=r"env is a builtins.int, no environment of craftax"):
        from_craftax(3)
