"""Benchmark worlds in continuous spaces: published sizes, successors, and learning."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos import ppo
from jaxltl.core.continuous.abstraction import noise_box
from jaxltl.core.continuous.certificate import closed_loop
from jaxltl.core.continuous.grid import make_grid
from jaxltl.core.continuous.images import image_boxes
from jaxltl.core.continuous.regions import box
from jaxltl.core.environments.episodes import with_time_limit
from jaxltl.envs import continuous_worlds as worlds

MAX_PROGRAMS = 600  # that the default tests compile at most

CASES = {
    "linear": worlds.linear,
    "hard": lambda: worlds.linear("hard"),
    "pendulum": worlds.pendulum,
    "collision": worlds.collision,
    "triple": worlds.triple_integrator,
    "robot": worlds.robot,
    "vehicle": worlds.vehicle,
    "building": worlds.building,
    "building_safety": worlds.building_safety,
}


@pytest.mark.parametrize(
    ("make", "states", "actions"),
    [
        (worlds.robot, 41**2, 441),
        (worlds.vehicle, 21 * 21 * 18, 30),
        (worlds.building, 5 * 5 * 7 * 7, 4),
        (worlds.building_safety, 107_163, 1),
    ],
)
def test_grids_have_the_published_sizes(make, states, actions):
    world = make()
    low, high = world.dynamics.domain
    cells = (high - low) / np.array(world.cell_width)
    np.testing.assert_allclose(cells, cells.round(), atol=1e-9)
    assert cells.round().prod() == states
    assert (1 if world.dynamics.actions is None else len(world.dynamics.actions)) == actions


@pytest.mark.parametrize(
    ("name", "state", "action", "noise", "expected"),
    [
        ("linear", [0.5, -0.4], [2.0], [1, -1], [0.5 - 0.018 + 0.45 + 0.01, -0.36 + 0.5 - 0.005]),
        ("pendulum", [0.1, 0.2], [-0.1], [0, 0], [0.1 + 0.05 * -0.5451249, -0.5451249]),
        ("collision", [0.1, 0.9], [0.5, 0.5], [1, 0], [0.1 + 0.0942809 + 0.05, 1.0 + 0.0 * 1.0]),
        ("triple", [0.2, 0.4, 0.1], [0.5], [0, 0, 1], [0.393, 0.6295, 0.345]),
        ("robot", [1, 2], [0.5, np.pi / 2], [0.25, 0], [1.25, 3]),
        ("vehicle", [1, 2, 0], [4, 0.0], [0, 0, 0.5], [1.4, 2, 0.5]),
        (
            "building",
            [20, 20, 33, 33],
            [18],
            [0, 0, 0, 0],
            [20.04636, 19.80248, 33.014233, 33.0114],
        ),
    ],
)
def test_successors(name, state, action, noise, expected):
    found = CASES[name]().dynamics.step(*(jnp.array(x, float) for x in (state, action, noise)))
    if name == "collision":
        expected[1] = 0.9 + 0.2 * (np.sqrt(0.02) / 0.3 * 1 + 1 - np.sqrt(0.02) / 0.3)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.few(5)
@pytest.mark.parametrize("name", CASES)
def test_labels_and_initial_states_lie_in_the_domain(name):
    dynamics = CASES[name]().dynamics
    states = jax.vmap(dynamics.sample_initial)(jax.random.split(jax.random.key(0), 500))
    assert jax.vmap(dynamics.inside)(states).all()
    label = np.asarray(jax.vmap(dynamics.label)(states))
    assert label.shape == (500, len(dynamics.propositions))
    if dynamics.actions is not None and not isinstance(dynamics.actions, np.ndarray):
        assert not label[:, 1].any()  # unsafe


def random_network(dynamics, seed=0):
    """A network that controls the dynamics, with about half of its actions clipped."""
    draw, n, m = np.random.default_rng(seed), dynamics.num_states, dynamics.num_actions
    first, last = draw.normal(size=(n, 16)), draw.normal(size=(16, m)) / 2
    bias = draw.normal(size=16)
    return lambda x: jnp.tanh(x @ first + bias) @ last


def outside_of_images(world, policy, count, seed=0):
    """Number of sampled successors outside of the images of their cells, and samples."""
    draw, dynamics = np.random.default_rng(seed), world.dynamics
    low, high = dynamics.domain
    side = max(int(2000 ** (1 / len(low))), 2)
    grid, noise = make_grid(low, high, [side] * len(low)), noise_box(dynamics)
    step, actions = dynamics.step, dynamics.actions
    if isinstance(actions, np.ndarray):
        actions = actions[draw.permutation(len(actions))[:4]]
    else:
        step, actions = closed_loop(dynamics, policy), np.zeros((1, 1))
    images = image_boxes(step, grid, np.arange(grid.num_cells), actions, noise)
    cell, k = draw.integers(grid.num_cells, size=count), draw.integers(len(actions), size=count)
    first, last = grid.boxes(cell)
    share = draw.uniform(size=first.shape)
    share[: count // 4] = draw.integers(0, 2, share[: count // 4].shape)  # corners
    state = first + share * (last - first)
    w = draw.uniform(noise.low, noise.high, (count, len(noise.low)))
    w[::2] = np.where(draw.random(w[::2].shape) < 0.5, noise.low, noise.high)
    with jax.enable_x64(True):
        found = np.asarray(jax.jit(jax.vmap(step))(state, actions[k], w))
    row = cell * len(actions) + k
    own = images.gain[row] * np.append(w, np.zeros((count, 1)), 1)[:, list(images.noise_of)]
    bad = (found < images.low[row] + own) | (found > images.high[row] + own)
    return int(bad.any(1).sum())


@pytest.mark.parametrize("count", [4000, pytest.param(10**6, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("name", CASES)
def test_sampled_successors_lie_in_the_images_of_their_cells(name, count):
    world = CASES[name]()
    assert outside_of_images(world, random_network(world.dynamics), count) == 0


def trained(name, seed, num_steps):
    """PPO from all states of the domain; the agent, and the task from its own initial states."""
    world = worlds.linear(name)
    options = {"embedding": np.zeros((3, 1))}  # the automaton is decided by its first change
    wide = replace(world.dynamics, initial=box(*world.dynamics.domain))
    task = jl.task_environment(wide, world.formula, discount=0.95, **options)
    task = with_time_limit(task, 50)
    network = ppo.ActorCritic(shape=(1,), hidden=(32, 32), initial_deviation=0.7)
    problem = ppo.make_problem(task, network=network)
    hparams = ppo.Hparams(
        discount=1.0, learning_rate=1e-3, num_envs=256, num_steps=16, num_minibatches=8,
        entropy_weight=0.0,
    )  # fmt: skip
    state, _ = ppo.train(jax.random.key(seed), problem, hparams, num_steps=num_steps)
    own = jl.task_environment(world.dynamics, world.formula, **options)
    return ppo.greedy(state, problem, hparams), own


@pytest.mark.slow
def test_ppo_learns_reach_avoid_in_the_linear_world():
    agent, task = trained("easy", 0, 60)
    found = jl.evaluate(jax.random.key(1), agent, task, num_steps=100, num_episodes=2000)
    assert found.success.lower > 0.97
