"""Section 4.5 in little: what ``reproduce cce`` returns, prints and draws."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.algos import trust_region as tr
from jaxltl.envs import navigation as nav
from jaxltl.envs.navigation_steps import as_environment
from jaxltl.reproduce import cce


def measured(*methods):
    plan = cce.CceExperimentPlan(
        networks=("2-2-1",),
        tasks=(4,),
        methods=methods,
        feasible_starts=(),
        lqr_steps=30,
        steps=4,
        trust_steps=2,
        fresh=100,
    )
    return cce.measure(seeds=2, plan=plan)


def check_the_robots_rows(rows, methods):
    assert [(x["task"], x["method"]) for x in rows] == [(4, name) for name in methods]
    for x in rows:
        assert x["seeds"] == 2 == len(x["trajectories_to_feasible"])
        assert x["seeds_feasible"] == sum(z <= -0.5 for z in x["cost"])
        assert x["seeds_confident"] <= x["seeds_feasible"]
        assert -1 <= x["cost_mean"] <= 0 <= x["objective_mean"] <= 120
        np.testing.assert_allclose(np.mean(x["cost"]), x["cost_mean"], atol=1e-4)
        low, high = np.transpose(x["cost_interval"])
        assert (low <= x["cost"]).all() and (x["cost"] <= high).all()


@pytest.mark.slow
def test_section_4_5_in_little():
    """Keys, table and pictures of both parts, with the search alone."""
    result = measured("CCE")
    found = json.loads(json.dumps(result, allow_nan=False))
    assert found["lqr_optimum"] == pytest.approx(3.751060412278, abs=1e-9)
    (row,) = found["lqr"]
    assert (row["network"], row["seeds"], row["feasible"]) == ("2-2-1", 2, 2)
    assert 0 < row["gap_median"] <= row["gap_max"] < 2470
    check_the_robots_rows(found["navigation"], ["CCE"])
    assert found["navigation"][0]["trajectories"] == 4000
    assert found["total_seconds"] > 0
    assert "3.7510604123" in cce.table(result)
    assert list(cce.pictures(result)) == [
        "figure_8_regulator",
        "figure_10_robot",
        "maps",
    ]


@pytest.mark.exhaustive
def test_a_penalty_changes_what_is_learned():
    methods = ("TRPO", "CPO", "penalised TRPO")
    result = measured(*methods)
    check_the_robots_rows(result["navigation"], methods)
    plain, _, penalised = result["navigation"]
    assert plain["objective"] != penalised["objective"]
    assert [x["trajectories"] for x in result["navigation"]] == [600, 600, 600]
    assert "penalised TRPO" in cce.table(result)


@pytest.mark.slow
@pytest.mark.parametrize("task", nav.TASKS)
def test_steps_add_up_to_the_scores(task):
    """The rewards and costs of steps are those of whole trajectories, from the same robot."""
    world = nav.navigation(initial=((-1.5, 0.0), (2.0, 1.5)))
    steps = as_environment(world, task)
    key, noise = jax.random.split(jax.random.key(task))
    places = jax.jit(jax.vmap(steps.reset))(jax.random.split(key, 50))
    actions = jax.random.uniform(noise, (world.horizon, 50, 2), minval=-1, maxval=1)

    def move(places, action):
        found = jax.vmap(lambda p, a: steps.step(p, a, None))(places, action)
        return found.world, (places.state, found.reward, found.cost, found.terminated)

    _, (state, reward, cost, done) = jax.lax.scan(move, places, actions)
    objective, total = nav.scores(world, jax.tree.map(jnp.transpose, state), task)
    np.testing.assert_allclose(reward.sum(0), objective, atol=1e-9)
    np.testing.assert_allclose(cost.sum(0), total, atol=1e-12)
    assert len(np.unique(total)) > 1 and not done[:-1].any() and done[-1].all()
    if task == 1:  # once in the goal, never out of it
        inside = nav.labels(world, state)[..., 0]
        assert (inside[:-1] <= inside[1:]).all() and inside.any()
    with pytest.raises(ValueError, match="task=5"):
        as_environment(world, 5)


@pytest.mark.slow
def test_steps_fit_the_trust_region_learner_and_its_precision():
    problem = tr.make_problem(as_environment(nav.navigation(), 3, dtype=jnp.float32), limit=-5.0)
    batch = jax.eval_shape(
        lambda key: tr.rollout(
            key,
            tr.init(key, problem, tr.Hparams(discount=0.9)),
            problem,
            tr.Hparams(discount=0.9),
            num_trajectories=3,
        ),
        jax.random.key(0),
    )
    assert batch.observation.shape == (30, 3, 62)
    assert batch.reward.dtype == batch.observation.dtype == jnp.float32
