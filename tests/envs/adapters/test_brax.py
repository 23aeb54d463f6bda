"""Brax's environments, against brax."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.environments.episodes import make_agent, run_episode, with_time_limit
from jaxltl.envs import from_brax
from tests.envs.adapters.harness import (  # noqa: F401
    both_ends,
    load,
    same_as_own,
    single_precision,
)

pytestmark = pytest.mark.filterwarnings(
    "ignore:Brax System:UserWarning", "ignore:Accessing .* directly from `Data`:DeprecationWarning"
)


@pytest.fixture(scope="module")
def envs():
    return load("brax.envs")


def fast(state):
    return (state.obs[1] > 0.1)[None]


@pytest.mark.exhaustive
def test_a_thousand_steps_are_braxs_own(envs):
    """Its wrapper tells truncation."""
    pendulum = envs.get_environment("inverted_pendulum")
    limited = envs.training.EpisodeWrapper(pendulum, 5, 1)
    env = from_brax(limited)
    assert env.horizon == 5 and from_brax(pendulum).horizon is None

    def reset(key):
        start = limited.reset(key)
        return start.replace(info={**start.info}), start.obs

    def step(state, action, key):
        after = limited.step(state, action)
        cut = after.info["truncation"] == 1
        after = after.replace(reward=jnp.asarray(after.reward, jnp.float32))
        return after, after.obs, after.reward, (after.done == 1) & ~cut, cut

    found = same_as_own(env, reset, step)
    both_ends(found)
    _, action, _, terminated, truncated, last = found
    assert not (terminated & truncated).any()
    assert ((np.abs(last[:, 1]) > 0.2) == terminated).all() and (np.abs(action) <= 1).all()


def test_a_limit_of_ours_and_labels(envs):
    env = with_time_limit(
        from_brax(envs.get_environment("fast"), labels=fast, propositions=["fast"]), 10
    )
    episode = run_episode(
        jax.random.key(0), env, make_agent(lambda seen, key: jnp.ones(1)), num_steps=12
    )
    assert episode.valid.sum() == 10 and episode.truncated and not episode.terminated
    speed = 0.02 * np.arange(13).clip(max=10)
    np.testing.assert_allclose(episode.world[0].obs[:, 1], speed, rtol=1e-5)
    assert episode.label[:, 0].tolist() == (speed > 0.1001).tolist()


def test_what_is_not_braxs_is_named(envs):
    own = envs.get_environment("fast")
    for kind in (envs.training.AutoResetWrapper, envs.training.VmapWrapper):
        wrapped = envs.training.EpisodeWrapper(kind(own), 10, 1)
        with pytest.raises(ValueError, match=f"wrapped in {kind.__name__}; give brax.envs.get_env"):
            from_brax(wrapped)

    class Old(type(own)):
        """One that this JAX does not have a function for."""

        def step(self, state, action):
            return jnp.clip(state, a_minimum=0)

    with pytest.raises(ValueError, match=r"Old cannot be traced .*: TypeError: .*a_minimum"):
        from_brax(Old())
    with pytest.raises(ValueError, match="no environment of brax"):
        from_brax(envs)
