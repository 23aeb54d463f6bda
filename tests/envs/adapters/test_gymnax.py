"""Gymnax's environments, against gymnax."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.environments.environment import Box, Finite
from jaxltl.core.environments.episodes import make_agent, run_episode
from jaxltl.envs import from_gymnax
from tests.envs.adapters.harness import (  # noqa: F401
    both_ends,
    load,
    same_as_own,
    single_precision,
    walk,
)


@pytest.fixture(scope="module")
def gymnax():
    return load("gymnax")


def upright(state):
    return jnp.array([jnp.abs(state.theta) < 0.05, state.x > 0])


def test_a_thousand_steps_are_gymnaxs_own(gymnax):
    cartpole, params = gymnax.make("CartPole-v1")
    params = params.replace(max_steps_in_episode=20)
    env = from_gymnax(cartpole, params)
    assert env.actions == Finite(2) and env.horizon == 20

    def step(state, action, key):
        # Its own step, which starts anew by itself, and hands over what was seen last.
        _, after, reward, terminated, truncated, info = cartpole.step(key, state, action, params)
        seen = info["final_observation"]
        return after, seen, jnp.asarray(reward, float), terminated, truncated

    found = same_as_own(env, lambda key: cartpole.reset(key, params)[::-1], step)
    both_ends(found)
    assert (np.abs(found[5][found[3]][:, [0, 2]]) > [2.4, 12 * np.pi / 180]).any(1).all()


def test_its_own_autoreset_is_that_of_episodes(gymnax):
    """The keys are split in the same way, so that whole walks over many episodes are equal."""
    cartpole, params = gymnax.make("CartPole-v1")
    key = jax.random.key(3)
    seen, action, *_ = jax.jit(lambda key: walk(from_gymnax(cartpole), key, 100))(key)
    first, rest = jax.random.split(key)
    observation, state = cartpole.reset(first, params)
    for row, k in enumerate(jax.random.split(rest, 100)):
        np.testing.assert_allclose(seen[row], observation, rtol=2e-5, atol=2e-6)
        observation, state, *_ = cartpole.step(jax.random.split(k)[1], state, action[row], params)


def test_boxes_labels_and_params(gymnax):
    pendulum, params = gymnax.make("Pendulum-v1")
    env = from_gymnax(pendulum, params)
    assert isinstance(env.actions, Box) and env.actions.shape == (1,) and env.horizon == 200
    cartpole, params = gymnax.make("CartPole-v1")
    gravity = params.replace(gravity=jnp.array([1.0, 20.0]))
    always = make_agent(lambda seen, key: jnp.int32(1))

    def fall(gravity):
        env = from_gymnax(
            cartpole,
            params.replace(gravity=gravity),
            labels=upright,
            propositions=["upright", "right"],
        )
        return run_episode(jax.random.key(0), env, always, num_steps=10)

    episode = jax.jit(jax.vmap(fall))(gravity.gravity)
    assert episode.label.shape == (2, 11, 2) and episode.cost.sum() == 0
    state = episode.world.state
    assert (episode.label[..., 0] == (np.abs(state.theta) < 0.05)).all()
    assert (episode.label[..., 1] == (state.x > 0)).all()
    assert (state.theta[0, 5] != state.theta[1, 5]) and episode.label[:, 0, 0].all()


def test_what_is_not_gymnaxs_is_named(gymnax):
    from gymnax.wrappers.purerl import LogWrapper

    cartpole, params = gymnax.make("CartPole-v1")
    with pytest.raises(ValueError, match=r"from_gymnax: env is a .*LogWrapper, no environment of"):
        from_gymnax(LogWrapper(cartpole), params)
    with pytest.raises(ValueError, match=r"give gymnax.make\(name\)\[0\]"):
        from_gymnax(gymnax.make("CartPole-v1"))
    with pytest.raises(ValueError, match=r"labels returns bool\[2\]; return bool\[1\]"):
        from_gymnax(cartpole, labels=upright, propositions=["upright"])
