"""The robot's environment beside whole trajectories, and as a problem of a search."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.environments.episodes import run_episode
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.values.evaluation.evaluation import episode_evaluator, evaluate
from jaxltl.envs import navigation as nav
from jaxltl.envs.navigation_steps import as_environment
from jaxltl.envs.networks import network_agent

WORLD = nav.navigation(
    goal=[(-1, -1), (1, 0.5)],
    obstacle=[(-2.5, 0.7), (2, 1.5)],
    bounds=[(-3, -2), (3, 2)],
    initial=[(-2, -1.5), (2, 1.8)],
    speed=1.5,
    turn=0.9,
    horizon=8,
)
NETWORK = nav.policy_network(WORLD, (4,))
PARAMETERS = 0.7 * jax.random.normal(jax.random.key(5), (3, NETWORK.num_parameters))


@pytest.mark.slow
@pytest.mark.parametrize("task", nav.TASKS)
def test_episodes_are_trajectories(task):
    """The same places, J and Z as of the run that starts alike."""
    environment = as_environment(WORLD, task)
    agent = network_agent(NETWORK, environment)
    score = episode_evaluator(environment, agent, costs="cost", num_episodes=1)
    simulate = nav.evaluator(WORLD, task, NETWORK, num_trajectories=1)
    seen = []
    for seed in range(8):
        key, parameters = jax.random.key(seed), PARAMETERS[seed % 3]
        (own,) = jax.random.split(key, 1)  # the episode's, of which the first half starts it
        expected = simulate(parameters, jax.random.split(own)[0])
        found = score(parameters, key)
        np.testing.assert_allclose(found, expected, atol=1e-9)
        seen.append(tuple(map(float, found)))
    assert len(set(seen)) > 1
    episode = jax.jit(lambda: run_episode(own, environment, agent(parameters), num_steps=9))()
    assert episode.terminated and episode.valid.sum() == 8
    run = nav.simulate(
        jax.random.split(own)[0],
        WORLD,
        NETWORK,
        parameters,
        num_trajectories=1,
        absorbing=task == 1,
    )
    for x, y in zip(episode.world.state, run.state, strict=True):
        np.testing.assert_allclose(x[:8], y[0], atol=1e-9)
    np.testing.assert_allclose(episode.action[:8], run.action[0], atol=1e-9)
    np.testing.assert_array_equal(
        episode.label[:8], nav.labels(WORLD, jax.tree.map(lambda x: x[0], run.state))
    )


@pytest.mark.slow
def test_a_formula_is_judged_on_it():
    """Table 4's reading of task 4: reached, and the obstacle never met."""
    environment = as_environment(WORLD, 4)
    task = task_environment(environment, "F goal & G !obstacle", ending="repeat")
    agent = network_agent(NETWORK, environment)(PARAMETERS[0])

    def read_the_world(memory, observation, allowed, key):
        return agent.act(memory, observation.world, allowed, key)

    found = evaluate(
        jax.random.key(0), agent.replace(act=read_the_world), task, num_episodes=200, batch=200
    )
    runs = jax.jit(
        jax.vmap(
            lambda i: run_episode(
                jax.random.fold_in(jax.random.key(0), i), environment, agent, num_steps=8
            )
        )
    )(jnp.arange(200))
    goal, obstacle = np.moveaxis(np.asarray(runs.label), -1, 0)
    won = goal.any(1) & ~obstacle.any(1)
    assert found.success.mean == won.mean() and 0 < won.mean() < 1
    assert found.undecided.mean == 0


def test_unknown_tasks_are_refused():
    with pytest.raises(ValueError, match="task=5"):
        as_environment(WORLD, 5)
