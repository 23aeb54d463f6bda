"""What searches are given of episodes, beside the episodes; a search for a task."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from jaxltl.algos import cce
from jaxltl.algos.cce.exponential_family import diagonal_gaussian
from jaxltl.core.environments.environment import Timestep, make_box, make_environment
from jaxltl.core.environments.episodes import make_agent, run_episode
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.values.evaluation.evaluation import episode_evaluator

NUMBER = 6


def reset(key):
    return jax.random.uniform(key, (2,), minval=-1, maxval=1)


def step(place, action, key):
    place = place + jnp.clip(action, -1, 1) + 0.1 * jax.random.normal(key, (2,))
    return Timestep(place, -jnp.sum(place**2), jnp.abs(place).max() > 4, cost=jnp.sum(action**2))


def labels(place):
    return jnp.stack([place[0] > 2, place[1] > 2])


WORLD = make_environment(
    reset,
    step,
    lambda place: place,
    actions=make_box(-1, 1, (2,)),
    labels=labels,
    propositions=["right", "up"],
    horizon=8,
)
TASK = task_environment(WORLD, "!up U right", ending="undecided")


def towards(goal, observation, key):
    place = observation.world if hasattr(observation, "world") else observation
    return jnp.clip(goal - place, -1, 1) / 2


def agent(goal):
    return make_agent(Partial(towards, goal))


def above(totals):
    return totals.length > 5


@pytest.mark.slow
def test_scores_are_means_over_episodes():
    every = (
        "failure",
        "violation",
        "undecided",
        "visits",
        "cost",
        "length",
        "discounted_visits",
        "discounted_reward",
        above,
    )
    evaluate = episode_evaluator(
        TASK, agent, objective="success", costs=every, num_episodes=NUMBER, discount=0.9
    )
    own = episode_evaluator(WORLD, agent, num_episodes=NUMBER)
    run = jax.jit(
        lambda key, goal: jax.vmap(lambda k: run_episode(k, TASK, agent(goal), num_steps=8))(
            jax.random.split(key, NUMBER)
        )
    )
    seen = []
    for seed, goal in enumerate(np.array([[3.0, 0.5], [0.5, 3.0], [2.2, 2.2], [0.0, 0.0]])):
        key, goal = jax.random.key(seed), jnp.asarray(goal)
        objective, costs = evaluate(goal, key)
        runs = run(key, goal)
        verdict = runs.world.verdict[:, -1]
        success = (verdict == Verdict.SATISFIED).mean()
        length = runs.valid.sum(1)
        expected = (
            1 - success,
            (verdict == Verdict.VIOLATED).mean(),
            (verdict == Verdict.UNDECIDED).mean(),
            runs.world.visits[:, -1].mean(),
            runs.cost.sum(1).mean(),
            length.mean(),
        )
        np.testing.assert_allclose(objective, success, rtol=1e-6)
        np.testing.assert_allclose(costs[:6], expected, rtol=1e-6)
        np.testing.assert_allclose(costs[8], (length > 5).mean(), rtol=1e-6)
        assert costs[6] <= costs[3] and costs.shape == (9,)
        np.testing.assert_allclose(
            costs[7], (runs.reward * 0.9 ** np.arange(8)).sum(1).mean(), rtol=1e-9
        )
        plain = jax.vmap(lambda k, g=goal: run_episode(k, WORLD, agent(g), num_steps=8))(
            jax.random.split(key, NUMBER)
        )
        np.testing.assert_allclose(own(goal, key), plain.reward.sum(1).mean(), rtol=1e-9)
        seen.append(float(success))
    assert seen[0] > 0.6 and min(seen) == 0 and seen[2] not in (0, 1)
    # A population is its members.
    goals, keys = jnp.array([[3.0, 0.5], [0.5, 3.0]]), jax.random.split(jax.random.key(9), 2)
    together = jax.jit(jax.vmap(evaluate))(goals, keys)
    for i in range(2):
        alone = evaluate(goals[i], keys[i])
        jax.tree.map(
            lambda x, y, i=i: np.testing.assert_allclose(x[i], y, rtol=1e-9), together, alone
        )


@pytest.mark.slow
def test_a_search_keeps_a_task_and_saves_effort():
    """The least effort with which the task fails at most one time in five."""
    evaluate = episode_evaluator(
        TASK, agent, objective=lambda totals: -totals.cost, costs="failure", num_episodes=20
    )
    problem = cce.make_problem(evaluate, diagonal_gaussian(jnp.zeros(2), 2.0), limit=0.2)
    hparams = cce.Hparams(rate=0.5, population=60)
    key, fresh = jax.random.split(jax.random.key(0))
    state, _ = cce.train(key, problem, hparams, num_steps=12)
    found = cce.result(fresh, state, problem, hparams, num_evaluations=50)
    assert found.solution is not None and found.solution[0] > 1.5 > found.solution[1]
    assert found.violation <= 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"objective": "success"}, "'success' needs a task"),
        ({"costs": ["cost", "joy"]}, "'joy' is none; choose one of reward"),
        ({"num_episodes": 0}, "num_episodes=0"),
        ({"num_steps": 0}, "num_steps=0"),
    ],
)
def test_what_does_not_fit_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        episode_evaluator(WORLD, agent, **change)


def test_episodes_that_never_end_are_refused():
    with pytest.raises(ValueError, match="episodes that never end"):
        episode_evaluator(WORLD.replace(horizon=None), agent)


def test_new_worlds_do_not_recompile():
    def shifted(shift, place, action, key):
        return step(place + shift, action, key)

    traced = []

    def noted(goal):
        traced.append(None)
        return agent(goal)

    function = Partial(noted)
    for shift in (0.0, 0.5):
        world = WORLD.replace(step=Partial(shifted, jnp.asarray(shift)))
        episode_evaluator(world, function, num_episodes=2)(jnp.zeros(2), jax.random.key(0))
    assert len(traced) == 1
