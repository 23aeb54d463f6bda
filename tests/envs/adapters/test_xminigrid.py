"""XLand-MiniGrid's environments, against xminigrid."""

import jax.numpy as jnp
import pytest

from jaxltl.core.environments.environment import Finite
from jaxltl.envs import from_xminigrid
from tests.envs.adapters.harness import (  # noqa: F401
    both_ends,
    load,
    same_as_own,
    single_precision,
)


@pytest.fixture(scope="module")
def xminigrid():
    return load("xminigrid")


def in_first_row(state):
    return (state.agent.position[0] == 1)[None]


def test_a_thousand_steps_are_its_own(xminigrid):
    own, params = xminigrid.make("MiniGrid-EmptyRandom-5x5", max_steps=15)
    env = from_xminigrid(own, params, labels=in_first_row, propositions=["first row"])
    assert env.actions == Finite(own.num_actions(params)) and env.horizon == 15

    def reset(key):
        start = own.reset(params, key)
        return start, start.observation

    def step(state, action, key):
        after = own.step(params, state, action)
        over = after.last() & (after.discount == 0)
        cut = after.last() & (after.discount == 1)
        return after, after.observation, after.reward, over, cut

    found = same_as_own(env, reset, step)
    both_ends(found)
    assert ((found[2] > 0) == found[3]).all()


def test_other_observations_and_bad_input(xminigrid):
    wrappers = load("xminigrid.wrappers")
    own, params = xminigrid.make("MiniGrid-Empty-5x5")
    seen = from_xminigrid(wrappers.DirectionObservationWrapper(own), params).observations
    assert seen["direction"].shape == (4,) and seen["img"].dtype == "uint8"
    for wrapper in (wrappers.GymAutoResetWrapper, wrappers.DmEnvAutoResetWrapper):
        layered = wrappers.DirectionObservationWrapper(wrapper(own))
        with pytest.raises(ValueError, match=f"wrapped in {wrapper.__name__}; give what is in it"):
            from_xminigrid(layered, params)
    with pytest.raises(ValueError, match=r"max_steps is None; give params.replace"):
        from_xminigrid(own, params.replace(max_steps=None))
    with pytest.raises(ValueError, match=r"no environment of xminigrid; give xminigrid.make"):
        from_xminigrid(jnp.zeros(3), params)
