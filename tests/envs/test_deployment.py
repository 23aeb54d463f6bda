"""Policies that are learned, saved, loaded in a fresh process, and run in packages' environments.

Each runs 2,000 episodes in the package's own environment, and succeeds as often as certified or
estimated. Tables run where JAX cannot be imported.
"""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos import ppo
from jaxltl.algos.common.actor_critic import ActorCritic
from jaxltl.core.policies.episode_statistics import frequency_estimate

EPISODES = 2000
pytestmark = pytest.mark.slow


@pytest.fixture
def single_precision():
    """JAX's own setting, for which these packages are written."""
    with jax.enable_x64(False):
        yield


IN_GYMNASIUM = """
import sys
for name in ("jax", "jaxlib", "flax", "optax", "chex"):
    sys.modules[name] = None
import gymnasium, json, jaxltl as jl
path, name, limit = sys.argv[1:]
env = gymnasium.make(name, max_episode_steps=int(limit))
policy = jl.io.load_policy(path)
found = jl.envs.run_policy(env, policy, num_episodes=2000, seed=7, confidence=0.999)
print(json.dumps([found.success.lower, found.success.upper, found.undecided.mean]))
"""


def run_fresh(program, *arguments):
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", program, *map(str, arguments)],
        capture_output=True, text=True, check=False, timeout=900,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_frozen_lake_learned_from_its_own_transitions(tmp_path):
    gymnasium = pytest.importorskip("gymnasium")
    name, limit, labels = "FrozenLake-v1", 3000, {"goal": [15], "hole": [5, 7, 11, 12]}
    env = gymnasium.make(name, max_episode_steps=limit)
    model = jl.envs.from_gymnasium(env, labels=labels)
    rng, counts = np.random.default_rng(0), np.zeros(model.num_transitions, np.int64)
    for r in range(model.num_rows):  # 2,000 samples of each choice, as the environment draws them
        entries = slice(model.entry_start[r], model.entry_start[r + 1])
        counts[entries] = rng.multinomial(2000, model.probability[entries])
    learned = jl.learn_guarantee(model, counts, "!hole U goal", 0.999, graph="given")
    path = tmp_path / "lake.npz"
    jl.io.save_policy(path, jl.project_policy(model, learned.satisfaction))
    lower, upper, undecided = run_fresh(IN_GYMNASIUM, path, name, limit)
    print(name, learned.bound, learned.optimistic, (lower, upper))
    assert learned.bound > 0.5 and undecided < 0.01
    assert learned.bound <= upper and lower <= learned.optimistic


def test_taxi(tmp_path):
    gymnasium = pytest.importorskip("gymnasium")
    name, limit, path = "Taxi-v4", 200, tmp_path / "taxi.npz"
    model = jl.envs.from_gymnasium(gymnasium.make(name))
    best = jl.optimal_satisfaction(model, "F terminated")
    jl.io.save_policy(path, jl.project_policy(model, best))
    lower, upper, undecided = run_fresh(IN_GYMNASIUM, path, name, limit)
    print(name, best.lower.min(), (lower, upper))
    assert best.lower.min() > 1 - 1e-6
    assert undecided == 0 and upper == 1 and lower > 0.99


NAVIX = """
import sys, json, jax, jax.numpy as jnp, numpy as np, navix, jaxltl as jl
env, policy = navix.make("Navix-Empty-5x5-v0"), jl.io.load_policy(sys.argv[1])
reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
program, delta = policy.exported, jnp.asarray(policy.automaton.delta)
now = reset(jax.random.split(jax.random.key(11), 2000))
reached = jnp.zeros(2000, bool)
act = jax.jit(lambda keys, q, seen: jax.lax.map(lambda x: program.call(x[0], x[1], [x[2]], None),
                                               (keys, q, seen)))
over = jnp.zeros(2000, bool)
for t in range(60):
    keys = jax.random.key_data(jax.random.split(jax.random.key(100 + t), 2000))
    now = step(now, act(keys, (reached * 1).astype(jnp.int32), now.observation))
    reached |= ~over & now.state.events.goal_reached.happened
    over |= reached | (now.step_type > 0)
print(json.dumps(int(reached.sum())))
"""


def reached_goal(state):
    return state.events.goal_reached.happened[None]


@pytest.mark.usefixtures("single_precision")
def test_navix(tmp_path):
    navix = pytest.importorskip("navix")
    world = jl.envs.from_navix(
        navix.make("Navix-Empty-5x5-v0"), labels=reached_goal, propositions=["goal"]
    )
    automaton = jl.to_automaton("F goal")
    task = jl.task_environment(jl.environments.with_time_limit(world, 60), automaton)
    agent = trained(task, ActorCritic(num_actions=7, hidden=(64,)), num_steps=100)
    compare(tmp_path, agent, task, automaton, NAVIX, "success")


BRAX = """
import sys, json, jax, jax.numpy as jnp, numpy as np, brax.envs, jaxltl as jl
env, policy = brax.envs.get_environment("inverted_pendulum", backend="positional"), jl.io.load_policy(sys.argv[1])
reset, step = jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))
program = policy.exported
act = jax.jit(lambda keys, q, seen: jax.lax.map(lambda x: program.call(x[0], x[1], [x[2]], None),
                                               (keys, q, seen)))
now = reset(jax.random.split(jax.random.key(11), 2000))
violated = jnp.zeros(2000, bool)
q = jnp.full(2000, int(policy.start(np.zeros(4), set()).memory), jnp.int32)
for t in range(60):
    keys = jax.random.key_data(jax.random.split(jax.random.key(100 + t), 2000))
    now = step(now, act(keys, q, now.obs))
    violated |= jnp.abs(now.obs[:, 1]) > 0.15
print(json.dumps(int(violated.sum())))
"""


def tilted(state):
    return jnp.abs(state.obs[1])[None] > 0.15


@pytest.mark.filterwarnings("ignore:Brax System", "ignore:Accessing .* directly from `Data`")
@pytest.mark.usefixtures("single_precision")
def test_brax(tmp_path):
    envs = pytest.importorskip("brax.envs")
    world = jl.envs.from_brax(
        envs.get_environment("inverted_pendulum", backend="positional"),
        labels=tilted,
        propositions=["tilted"],
    )
    automaton = jl.to_automaton("G !tilted")
    task = jl.task_environment(jl.environments.with_time_limit(world, 60), automaton)
    agent = trained(task, ActorCritic(shape=(1,), hidden=(32,)), num_steps=60, mean=True)
    compare(tmp_path, agent, task, automaton, BRAX, "violation")


def trained(task, network, num_steps, mean=False):
    problem = ppo.make_problem(task, network=network)
    hparams = ppo.Hparams(discount=0.99, num_envs=32, num_steps=64, learning_rate=1e-3)
    state, _ = ppo.train(jax.random.key(0), problem, hparams, num_steps=num_steps)
    return (ppo.greedy if mean else ppo.policy)(state, problem, hparams)


def compare(folder, agent, task, automaton, program, name):
    """The share in the package's environment and that of `evaluate`: their intervals overlap."""
    path = folder / "policy.npz"
    jl.io.save_network(path, agent, task, automaton=automaton)
    here = jl.evaluate(jax.random.key(1), agent, task, num_episodes=500, confidence=0.999)
    expected = getattr(here, name)
    count = run_fresh(program, path)
    found = frequency_estimate(count, EPISODES, 0.001)
    print(name, expected, found)
    assert expected.lower <= found.upper and found.lower <= expected.upper
    assert (found.mean > 0.9) if name == "success" else (found.mean < 0.1)
