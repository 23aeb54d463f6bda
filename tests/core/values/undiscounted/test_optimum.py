"""Traced undiscounted values: bounds where products underflow, and derivatives on long walks."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.mesh.shard import from_mesh, shard, to_mesh
from tests.core.models.mesh.test_sharded import mesh_of


def two_steps(rare, num_states=4):
    """State 0 leads to 1 and 1 to the target 2 with a small probability each, else to the sink 3.

    A second action does the same. Further states lead to 0.
    """
    successor = np.zeros((num_states, 2, 2), int)
    weight = np.zeros((num_states, 2, 2))
    weight[..., 0] = 1
    successor[:4] = np.array([[1, 3], [2, 3], [2, 3], [3, 3]])[:, None]
    weight[:2] = [rare, 1 - rare]
    return jl.make_mdp(successor, weight), np.arange(num_states) == 2


def solve(model, target, objective):
    if objective == "policy":
        policy = jnp.full((*model.state_shape, 2), 0.5, model.dtype)
        return jl.reachability_probability(model, target, policy=policy)
    return jl.reachability_probability(model, target, objective=objective)


@pytest.mark.few(1, 2)
@pytest.mark.parametrize("objective", ["max", "min", "policy"])
@pytest.mark.parametrize(("double", "rare"), [(False, 1e-20), (True, 1e-200)])
def test_no_upper_bound_of_a_positive_probability_is_zero(objective, double, rare):
    with jax.enable_x64(double):
        mdp, target = two_steps(rare)
        sharded = shard(mdp, mesh_of(2))
        many, far = two_steps(rare, 5000)
        answers = {
            "host": solve(mdp, target, objective),
            "jit": jax.jit(solve, static_argnames="objective")(mdp, target, objective),
            "many": solve(many, far, objective),
            "mesh": solve(sharded, to_mesh(sharded, target), objective),
        }
        for name, found in answers.items():
            upper = found.upper
            if name == "mesh":
                upper = from_mesh(sharded, upper)
            # XLA takes subnormal numbers for zero.
            assert bool(jnp.asarray(upper)[0] > 0), name
            assert bool((jnp.asarray(found.lower)[:2] <= rare).all()), name


def walk(size):
    """A walk with a reward of 1 a step; one action, or one of two in each state."""
    states = np.arange(size)
    successor = np.stack([(states - 1).clip(0), (states + 1).clip(0, size - 1)], -1)
    weight = np.tile([0.5, 0.5], (size, 2, 1))
    weight[:, 1] = [0.6, 0.4]
    weight[[0, -1]] = [1, 0]
    successor[[0, -1]] = states[[0, -1], None]
    return np.repeat(successor[:, None], 2, 1), weight


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        ("policy", 200),
        pytest.param("max", 60, marks=pytest.mark.slow),
        pytest.param("reward", 200, marks=pytest.mark.slow),
        pytest.param("policy", 3000, marks=pytest.mark.exhaustive),
        pytest.param("reward", 3000, marks=pytest.mark.exhaustive),
    ],
)
def test_derivatives_of_long_walks(kind, size):
    """Up by one in one state: the derivative is known from the gambler's ruin.

    ``dy = N dP y`` with the fundamental matrix N, whose entry is ``2 i (n - j) / n`` for i <= j.
    """
    successor, weight = walk(size)
    model = jl.make_mdp(successor, weight)
    target = np.arange(size) == size - 1
    ends = target | (np.arange(size) == 0)
    n, i, j = size - 1, size // 4, size // 2
    policy = jnp.asarray(np.eye(2)[np.zeros(size, int)])

    def value(shift):
        change = jnp.zeros_like(model.probability).at[j, 0].set(jnp.array([-shift, shift]))
        moved = model.replace(probability=model.probability + change)
        if kind == "reward":
            reward = jnp.ones((size, 2))
            return jl.total_reward(moved, reward, ends, policy=policy).value[i]
        if kind == "policy":
            return jl.reachability_probability(moved, target, policy=policy).value[i]
        return jl.reachability_probability(moved, target).value[i]

    visits = 2 * i * (n - j) / n
    gain = {"reward": 2.0 * (n - 2 * j)}.get(kind, 2 / n)  # y(j + 1) - y(j - 1)
    for slope in (jax.grad(value)(0.0), jax.jvp(value, (0.0,), (1.0,))[1]):
        np.testing.assert_allclose(slope, visits * gain, rtol=1e-5)
