"""MuJoCo Playground's environments, against mujoco_playground."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.environments.episodes import make_agent, run_episode, with_time_limit
from jaxltl.envs import from_playground
from tests.envs.adapters.harness import (  # noqa: F401
    both_ends,
    load,
    same_as_own,
    single_precision,
)

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(scope="module")
def cartpole():
    return load("mujoco_playground").registry.load(
        "CartpoleBalance", config_overrides={"impl": "jax"}
    )


@pytest.fixture(scope="module")
def training():
    return load("brax.envs.wrappers.training")


@pytest.fixture(scope="module")
def fallible(cartpole):
    """The same, ending where the pole moves fast; the control suite's own end for NaN only."""

    class Fallible(type(cartpole)):
        def __init__(self):
            self.__dict__.update(vars(cartpole))

        def step(self, state, action):
            after = super().step(state, action)
            return after.replace(done=1.0 * (jnp.abs(after.data.qvel[1]) > 0.5))

    return Fallible()


@pytest.mark.exhaustive
def test_a_thousand_steps_are_playgrounds_own(fallible, training):
    limited = training.EpisodeWrapper(fallible, 7, 1)
    env = from_playground(limited)
    assert env.horizon == 7 and from_playground(fallible).horizon is None

    def reset(key):
        start = limited.reset(key)
        return start.replace(info={**start.info}), start.obs

    def step(state, action, key):
        after = limited.step(state.replace(info={**state.info}), action)
        cut = after.info["truncation"] == 1
        return after, after.obs, after.reward, (after.done == 1) & ~cut, cut

    found = same_as_own(env, reset, step)
    both_ends(found)
    _, action, _, terminated, truncated, last = found
    assert not (terminated & truncated).any()
    assert (np.abs(action) <= 1).all() and np.ptp(action) > 1
    assert ((np.abs(last[:, -1]) > 0.5) == terminated).all()


@pytest.mark.slow
def test_a_limit_of_ours_and_labels(cartpole):
    def away(state):
        return (state.data.qpos[0] > 0)[None]

    env = with_time_limit(from_playground(cartpole, labels=away, propositions=["right"]), 5)
    agent = make_agent(lambda seen, key: jnp.ones(1))
    episode = run_episode(jax.random.key(0), env, agent, num_steps=6)
    assert episode.valid.sum() == 5 and episode.truncated and not episode.terminated
    place = np.asarray(episode.world[0].obs[:, 0])
    assert episode.label[:, 0].tolist() == (place > 0).tolist()


def test_what_is_not_playgrounds_is_named(cartpole, training):
    own = load("mujoco_playground").wrapper
    for kind in (own.BraxAutoResetWrapper, training.AutoResetWrapper, training.VmapWrapper):
        wrapped = training.EpisodeWrapper(kind(cartpole), 10, 1)
        with pytest.raises(ValueError, match=f"wrapped in {kind.__name__}; give mujoco_play"):
            from_playground(wrapped)
    with pytest.raises(ValueError, match="no environment of playground"):
        from_playground(training)
