"""Dynamics: successors, labels, environments of learners, and mistakes in their definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.continuous.dynamics import make_dynamics, to_environment
from jaxltl.core.continuous.noise import gaussian, triangular, uniform
from jaxltl.core.continuous.regions import box, where_positive
from jaxltl.core.environments.environment import Box, Finite

MAX_PROGRAMS = 450  # that the default tests compile at most

UNIT = {"domain": ([-1.0, -1.0], [1.0, 1.0])}


def drift(state, action, noise):
    return state + 0.5 * action + 0.1 * noise[:2] + noise[2:].sum()


def drifting(**options):
    given = {
        "noise": [triangular(), gaussian(1.0)],
        "disturbance": ([-0.1], [0.2]),
        "actions": ([-1.0, -1.0], [1.0, 1.0]),
        "labels": {"goal": ([0.5, -1.0], [1.0, 0.0])},
    }
    return make_dynamics(drift, **(UNIT | given | options))


def test_sizes_and_propositions():
    world = drifting(labels={"goal": ([0.5, -1.0], [1.0, 0.0]), "low": ([-1, -1], [0, 0])})
    assert (world.num_states, world.num_actions, world.num_noise) == (2, 2, 3)
    assert world.propositions == ("goal", "low")
    assert drifting(outside="gone").propositions == ("goal", "gone")
    assert drifting(outside="goal").propositions == ("goal",)


def test_samples_follow_the_noise_and_the_disturbance():
    world = drifting()
    keys = jax.random.split(jax.random.key(0), 20_000)
    given = jax.vmap(lambda key: world.sample_noise(key, [0.1]))(keys)
    assert np.allclose(given[:, 2], 0.1)
    drawn = np.asarray(jax.vmap(world.sample_noise)(keys))
    for column, one in zip(drawn.T, (triangular(), gaussian(1.0), uniform(-0.1, 0.2)), strict=True):
        x = np.sort(column)
        assert np.abs(one.cdf(x) - np.linspace(0, 1, len(x))).max() < 2.2 / np.sqrt(len(x))
    assert np.abs(np.corrcoef(drawn.T) - np.eye(3)).max() < 0.04
    assert np.allclose(world.sample_noise(keys[0], [7.0])[2], 0.2)  # within its bounds


def test_successors_are_clipped_or_leave():
    state, action = jnp.array([0.9, 0.0]), jnp.array([1.0, 0.0])
    key = jax.random.key(3)
    free = drifting().next_state(key, state, action)
    clipped = drifting(outside="clip").next_state(key, state, action)
    assert free[0] > 1 and clipped[0] == 1 and free[1] == clipped[1]
    assert jax.jacobian(drifting().next_state, 2)(key, state, action).tolist() == [
        [0.5, 0],
        [0, 0.5],
    ]


def test_labels_hold_at_the_domains_closed_boundary_and_not_outside():
    world = drifting(outside="gone")
    states = jnp.array([[1.0, -1.0], [1.0, 0.0], [0.4, -0.5], [1.1, -0.5]])
    found = jax.vmap(world.label)(states)
    assert found.tolist() == [[True, False], [False, False], [False, False], [False, True]]


@pytest.mark.parametrize("outside", ["violates", "clip", "gone", "goal"])
def test_an_environment_ends_outside_of_the_domain(outside):
    world = jl.task_environment(
        drifting(outside=outside), "G !goal | F gone" if outside == "gone" else "G !goal"
    )
    start = world.reset(jax.random.key(0))._replace(world=jnp.array([0.45, 0.9]))
    found = world.step(start, jnp.array([0.0, 3.0]), jax.random.key(1))  # clipped to 1
    assert bool(found.terminated) == (outside != "clip")
    verdict = jl.environments.Verdict(int(found.world.verdict)).name
    expected = {
        "violates": "VIOLATED",
        "clip": "UNDECIDED",
        "gone": "SATISFIED",
        "goal": "VIOLATED",
    }
    assert verdict == expected[outside]


def test_actions_of_environments():
    made = to_environment(drifting())
    assert isinstance(made.actions, Box) and made.actions.high.tolist() == [1, 1]
    grid = to_environment(
        drifting(
            actions=[[0.0, 0.0], [1.0, -1.0], [0.0, 1.0]],
            noise=gaussian(1e-6),
            disturbance=([0, 0.0], [1e-6, 1e-6]),
        )
    )
    assert grid.actions == Finite(3)
    moved = grid.step(jnp.zeros(2), jnp.int32(1), jax.random.key(0)).world
    assert np.allclose(moved, [0.5, -0.5], atol=1e-4)
    still = make_dynamics(lambda x, u, w: x, labels={}, **UNIT)
    assert to_environment(still).actions == Finite(1) and still.num_noise == 0


def test_initial_states_are_uniform_in_the_boxes():
    world = drifting(initial=box([[-1, -1], [0.5, 0.5]], [[-0.5, 0], [0.75, 3.0]]))
    states = np.asarray(jax.vmap(world.sample_initial)(jax.random.split(jax.random.key(0), 4000)))
    assert world.initial.contains(states).all()
    share = (states[:, 0] < 0).mean()
    assert abs(share - 0.5 / (0.5 + 0.125)) < 0.03


@pytest.mark.few(1)
@pytest.mark.parametrize("wide", [False, True])
def test_both_precisions(wide):
    with jax.enable_x64(wide):
        world = drifting()
        made = to_environment(world)
        state = made.reset(jax.random.key(0))
        found = made.step(state, jnp.zeros(2, state.dtype), jax.random.key(1)).world
        assert found.dtype == (jnp.float64 if wide else jnp.float32)


def branching(x, u, w):
    return x if x[0] > 0 else -x


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"step": branching}, "step cannot be traced.*jnp.where"),
        ({"step": lambda x, u, w: x[:1]}, r"step returns float32\[1\]; return float\[2\]"),
        ({"step": lambda x, u, w: (x, x)}, "step returns .*; return"),
        ({"step": lambda x, u, w: x + u @ w[:1]}, "step fails with state"),
        ({"step": lambda x, u, w: jnp.sqrt(x)}, "step returns .*nan.* in state"),
        ({"step": lambda x, u, w: x > 0}, r"return float\[2\]"),
        ({"step": 3}, "give a function"),
        ({"domain": ([0.0, 0.0], [1.0])}, "domain: low and high have shapes"),
        ({"domain": ([0.0, 1.0], [1.0, 1.0])}, "coordinate 1"),
        ({"domain": ([0.0, 0.0], [1.0, np.inf])}, "finite bounds"),
        ({"domain": ([0.0, np.nan], [1.0, 1.0])}, "low=nan"),
        ({"domain": 3}, "give .low, high"),
        ({"labels": {"far": ([2, 2], [3, 3])}}, "label 'far': no state of the domain"),
        ({"labels": {"far": where_positive(lambda x: x[0] - 5)}}, "no state of the domain"),
        ({"labels": {"wide": box([0], [1])}}, "label 'wide' has 1 coordinates"),
        ({"labels": {"odd": ([0, 0], [1])}}, "label 'odd': box"),
        ({"labels": {"clip": ([0, 0], [1, 1])}}, "choose another name"),
        ({"labels": {"odd": where_positive(lambda x: x)}}, "return a number"),
        ({"labels": 3}, "give a dictionary"),
        ({"noise": [0.1]}, r"noise\[0\] is float; give gaussian"),
        ({"disturbance": ([0.1], [-0.1])}, "disturbance: low=0.1 and high=-0.1"),
        ({"disturbance": ([-np.inf], [np.inf])}, "disturbance: low=-inf.*give finite bounds"),
        ({"disturbance": gaussian(1.0)}, r"disturbance is Distribution.*; give \(low, high\)"),
        ({"actions": [1.0, 2.0]}, r"actions is an array of shape \[2\]"),
        ({"actions": ([1.0], [0.0])}, "actions: low=1"),
        ({"outside": 3}, "outside is int"),
        ({"initial": ([2, 2], [3, 3])}, "initial: box 0.*outside"),
        ({"initial": where_positive(lambda x: x[0])}, "initial: give boxes"),
    ],
)
def test_mistakes_are_one_line_errors(options, message):
    step = options.pop("step", drift)
    given = (
        UNIT | {"labels": {}, "noise": [triangular()], "actions": ([-1, -1.0], [1, 1.0])} | options
    )
    with pytest.raises(ValueError, match=message) as caught:
        make_dynamics(step, **given)
    assert "\n" not in str(caught.value)
