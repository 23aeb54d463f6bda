"""JaxMARL's environments, against jaxmarl, step by step."""

import jax
import jax.numpy as jnp
import pytest

from jaxltl.core.environments.environment import Finite
from jaxltl.envs import from_jaxmarl
from tests.envs.adapters.harness import (  # noqa: F401
    both_ends,
    load,
    same_as_own,
    single_precision,
)


@pytest.fixture(scope="module")
def jaxmarl():
    return load("jaxmarl")


def somebody(observations, key):
    """Every agent's action depends on its own observation and on chance."""
    keys = jax.random.split(key, len(observations))
    return {
        name: (jax.random.randint(k, (), 0, 3) + (x.sum() > 0)).astype(jnp.int32) % 3
        for k, (name, x) in zip(keys, sorted(observations.items()), strict=True)
    }


def own_functions(own, agent):
    def reset(key):
        seen, state = own.reset(key)
        return (state, seen), seen[agent]

    def step(carry, action, key):
        state, seen = carry
        choose, go = jax.random.split(key)
        actions = (somebody(seen, choose) if len(own.agents) > 1 else {}) | {agent: action}
        seen, state, reward, done, _ = own.step_env(go, state, actions)
        over, late = done["__all__"], state.step >= own.max_steps
        return (state, seen), seen[agent], reward[agent], over & ~late, over & late

    return reset, step


@pytest.mark.parametrize(
    ("name", "agent"),
    [("MPE_simple_spread_v3", "agent_1"), ("MPE_simple_v3", "agent_0")],
)
def test_a_thousand_steps_are_those_of_jaxmarl(jaxmarl, name, agent):
    own = jaxmarl.make(name)
    others = somebody if len(own.agents) > 1 else None
    env = from_jaxmarl(own, others, agent)
    assert env.actions == Finite(5)
    found = same_as_own(env, *own_functions(own, agent))
    assert not found[3].any() and found[4].sum() > 30


def test_a_thousand_steps_with_ends_before_the_limit(jaxmarl):
    own = jaxmarl.make("switch_riddle", num_agents=3)
    env = from_jaxmarl(own, somebody, labels=lambda state: state.done[None], propositions=["end"])
    both_ends(same_as_own(env, *own_functions(own, "agent_0")))


def test_what_is_not_jaxmarls_is_named(jaxmarl):
    own = jaxmarl.make("MPE_simple_spread_v3")
    for call, text in (
        (lambda: from_jaxmarl(own), "has 3 agents; give others"),
        (lambda: from_jaxmarl(own, somebody, "x"), "agent='x'; choose one of agent_0, agent_1"),
        (lambda: from_jaxmarl(own.reset, somebody), "no environment of jaxmarl"),
        (lambda: from_jaxmarl(jaxmarl.make("MPE_simple_v3"), somebody), "has 1 agents"),
        (lambda: from_jaxmarl(own, lambda seen, key: {}), "no action of agent_1, agent_2"),
    ):
        with pytest.raises(ValueError, match=text):
            call()
