"""Policies of learners as functions of the state, and counterexamples."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.algos import cce, ppo, trust_region
from jaxltl.algos.cce.exponential_family import diagonal_gaussian
from jaxltl.algos.common.actor_critic import ActorCritic
from jaxltl.core.continuous import (
    certify_policy,
    counterexample,
    make_dynamics,
    state_policy,
    triangular,
)
from jaxltl.core.environments import make_agent, task_environment
from jaxltl.core.environments.episodes import with_time_limit
from jaxltl.core.environments.task_environment import TaskObservation
from jaxltl.core.values.evaluation.evaluation import episode_evaluator
from jaxltl.envs.networks import make_network, network_agent

MAX_PROGRAMS = 600  # that the default tests compile at most

FORMULA = "!pit U goal"


def shuttle():
    return make_dynamics(
        lambda x, u, w: x + u + 0.02 * w,
        domain=([-1.0], [1.0]),
        noise=triangular(),
        actions=([-0.3], [0.3]),
        labels={"goal": ([-0.2], [0.2]), "pit": ([0.9], [1.0])},
        initial=([0.4], [0.6]),
    )


WORLD = shuttle()
TASK = task_environment(with_time_limit(WORLD.environment, 20), FORMULA)


def ppo_agent(environment):
    network = ActorCritic(shape=(1,), hidden=(4,))
    problem = ppo.make_problem(environment, network=network)
    hparams = ppo.Hparams(discount=0.9, num_envs=4, num_steps=8, num_minibatches=1)
    return ppo, (ppo.init(jax.random.key(0), problem, hparams), problem, hparams)


def trust_region_agent(environment):
    problem = trust_region.make_problem(environment, horizon=20, limit=1.0)
    hparams = trust_region.Hparams(discount=0.9, hidden=(4,), value_hidden=(4,), num_trajectories=4)
    return trust_region, (trust_region.init(jax.random.key(0), problem, hparams), problem, hparams)


def cce_agent(environment):
    sizes = (1 + 3 * (environment is TASK), 4, 1)
    network = make_network(sizes, hidden="tanh")
    make = network_agent(network, environment)
    score = episode_evaluator(environment, make, objective="reward", num_episodes=2, num_steps=5)
    first = diagonal_gaussian(0.1 * jnp.arange(network.num_parameters, dtype=jnp.float32), 1.0)
    problem = cce.make_problem(score, first)
    hparams = cce.Hparams(population=10)
    state = cce.init(jax.random.key(0), problem, hparams)
    return make(cce.policy(state, problem, hparams))


def learned(name, environment):
    if name == "cce":
        return cce_agent(environment)
    module, run = {"ppo": ppo_agent, "trust_region": trust_region_agent}[name](environment)
    return module.greedy(*run)


@pytest.mark.few(2)
@pytest.mark.parametrize("name", ["ppo", "trust_region", "cce"])
@pytest.mark.parametrize("task", [False, True])
def test_the_function_of_a_learned_policy_has_its_actions_and_a_certificate(name, task):
    environment = TASK if task else with_time_limit(WORLD.environment, 20)
    agent = learned(name, environment)
    act = state_policy(agent, environment)
    memory = task_memory()
    for x in np.linspace(-0.9, 0.9, 5, dtype=np.float32):
        seen = TaskObservation(jnp.array([x]), memory) if task else jnp.array([x])
        expected, _ = agent.act((), seen, None, None)
        np.testing.assert_array_equal(act(jnp.array([x])), expected)
    limits = {"cells": [20], "max_cells": 20}
    of_agent = certify_policy(WORLD, agent, FORMULA, **limits)
    of_function = certify_policy(WORLD, lambda x: act(x), FORMULA, **limits)
    np.testing.assert_array_equal(of_agent.lower, of_function.lower)
    np.testing.assert_array_equal(of_agent.upper, of_function.upper)


def task_memory():
    world = TASK.reset(jax.random.key(0))  # outside of goal and pit: undecided
    return TASK.observe(world).memory


def test_a_flax_module_with_its_parameters():
    class Linear(nn.Module):
        @nn.compact
        def __call__(self, x):
            return nn.Dense(1)(x)

    variables = {"params": {"Dense_0": {"kernel": jnp.full((1, 1), -0.5), "bias": jnp.zeros(1)}}}
    for given in (variables, variables["params"]):
        proof = certify_policy(WORLD, (Linear(), given), FORMULA, cells=[100])
        assert proof.initial_bounds == (1.0, 1.0)


@pytest.mark.parametrize("name", ["ppo", "trust_region"])
def test_random_actions_are_refused(name):
    make = {"ppo": ppo_agent, "trust_region": trust_region_agent}[name]
    module, run = make(TASK)
    with pytest.raises(ValueError, match="give a deterministic one"):
        certify_policy(WORLD, module.policy(*run), FORMULA)


def test_a_policy_that_observes_several_undecided_automaton_states_is_refused():
    formula = "G F goal & G F pit"
    task = task_environment(WORLD.environment, formula)
    reads = make_agent(lambda seen, key: seen.world * seen.memory[0])
    with pytest.raises(ValueError, match="observes 2 undecided automaton states"):
        certify_policy(WORLD, reads, formula)
    num_states = len(task.observe(task.reset(jax.random.key(0))).memory)
    hidden = task_environment(WORLD.environment, formula, embedding=np.ones((num_states, 1)))
    act = state_policy(reads, hidden)
    assert float(act(jnp.array([0.5]))[0]) == 0.5


def test_a_counterexample_violates_the_formula_from_the_worst_initial_cell():
    def policy(x):
        return jnp.where(x > 0.52, 0.1, -0.1)

    key = jax.random.key(0)
    proof = certify_policy(WORLD, policy, FORMULA, cells=[40], max_cells=40)
    assert proof.initial_bounds[1] == 0.0
    run = counterexample(key, WORLD, policy, FORMULA, proof)
    assert 0.55 <= run[0, 0] <= 0.6 and run[-1, 0] >= 0.9
    assert ((run[:-1, 0] < 0.9) & (run[:-1, 0] > 0.2)).all()
    np.testing.assert_allclose(np.diff(run[:, 0]), 0.1, atol=0.021)
    assert counterexample(key, WORLD, lambda x: -0.1 * jnp.sign(x), FORMULA) is None
