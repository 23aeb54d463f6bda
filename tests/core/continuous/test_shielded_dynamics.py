"""Learners inside the permissive strategies of synthesized policies."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.continuous import make_dynamics, shield_dynamics, synthesize_policy
from jaxltl.core.environments.episodes import Agent, run_episode
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.environments.task_environment import task_environment
from tests.support import random_action

SAFE = "G !pit"
CHOICES = np.array([[-1.0], [0.0], [1.0]])


def step(state, action, gust):
    return state + 0.2 * action + gust


def pushed(state, action, gust):
    """The worst gust in each step: towards the nearer side."""
    return step(state, action, 0.05 * jnp.sign(state - 0.1))


def world(actions):
    return make_dynamics(
        step,
        domain=([-1.0], [1.0]),
        labels={"pit": ([0.7], [1.0])},
        disturbance=([-0.05], [0.05]),
        actions=actions,
        initial=([-0.2], [0.3]),
    )


def shield(actions):
    """The shield against every gust, in a world with the worst gusts."""
    policy = synthesize_policy(world(actions), SAFE, CHOICES, cells=[40])
    assert policy.certificate.initial_bounds[0] == 1
    return shield_dynamics(replace(policy, dynamics=replace(policy.dynamics, step=pushed)))


@partial(jax.jit, static_argnames="num_steps")
def violations(keys, task, num_steps):
    def act(memory, seen, allowed, key):
        return random_action(key, task.actions, allowed), memory

    run = jax.vmap(lambda key: run_episode(key, task, Agent(act), num_steps=num_steps))
    return (run(keys).world.verdict[:, -1] == Verdict.VIOLATED).mean()


@pytest.mark.few(1)
@pytest.mark.parametrize("actions", [CHOICES, ([-1.0], [1.0])], ids=["grid", "box"])
def test_random_actions_inside_violate_nothing_under_the_worst_gusts(actions):
    keys = jax.random.split(jax.random.key(0), 200)
    free = replace(world(actions), step=pushed)
    assert violations(keys, task_environment(free, SAFE), 100) > 0.9
    assert violations(keys, task_environment(shield(actions), SAFE), 100) == 0


def test_allowed_actions_keep_a_cell_from_every_gust_and_others_do_not():
    policy = synthesize_policy(world(CHOICES), SAFE, cells=[40])
    won = policy.certificate.lower == 1
    low, high = (x[:, 0] for x in policy.certificate.grid.boxes())
    for cell in np.flatnonzero(won):
        after = np.stack([low[cell] + 0.2 * CHOICES - 0.05, high[cell] + 0.2 * CHOICES + 0.05])
        keeps = ((after > low[won].min() + 1e-9) & (after < high[won].max() - 1e-9)).all(0)[:, 0]
        edge = (np.abs(after - low[won].min()) < 1e-6) | (np.abs(after - high[won].max()) < 1e-6)
        sharp = ~edge.any(0)[:, 0]  # the end of an image on an edge may round to either side
        memory = policy.allowed[:, cell].any(-1).argmax()
        np.testing.assert_array_equal(policy.allowed[memory, cell][sharp], keeps[sharp])


def test_another_grid_of_actions_is_refused():
    policy = synthesize_policy(world(CHOICES), SAFE, CHOICES[:2], cells=[4], max_cells=4)
    with pytest.raises(ValueError, match="2 actions that are not the grid of the dynamics"):
        shield_dynamics(policy)
