"""The models that are measured on."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxltl.core.models.mdp import MDP
from jaxltl.envs.gridworld import gridworld


def random_mdp(
    num_states: int, num_actions: int = 4, num_successors: int = 4, seed: int = 0
) -> MDP:
    """Uniform successors with uniform weights, in JAX's current float."""
    rng = np.random.default_rng(seed)
    shape = (num_states, num_actions, num_successors)
    probability = rng.random(shape)
    probability /= probability.sum(-1, keepdims=True)
    return MDP(
        successor=jnp.asarray(rng.integers(0, num_states, shape, dtype=np.int32)),
        probability=jnp.asarray(probability, jnp.result_type(float)),
        available=jnp.ones((num_states, num_actions), bool),
        initial=jnp.full(num_states, 1 / num_states),
        label=jnp.zeros((num_states, 0), bool),
    )


def risky_mdp(num_states: int, seed: int = 0) -> tuple[MDP, np.ndarray]:
    """A random model in which half of all actions risk a trap, and its goal states.

    One state in a thousand is a goal, three are traps, both absorbing: the
    maximal probability of the goal lies strictly between 0 and 1 nearly everywhere.
    """
    model = random_mdp(num_states, seed=seed)
    rng = np.random.default_rng(seed + 1)
    successor = np.array(model.successor)
    ends = num_states * 4 // 1000
    goal = np.arange(num_states) < num_states // 1000
    risky = rng.random(successor.shape[:2]) < 0.5
    risky[: num_states // 2] = True  # half of the states have no safe action
    trap = rng.integers(num_states // 1000, ends, successor.shape[:2])
    successor[:, :, 0] = np.where(risky, trap, successor[:, :, 0])
    successor[:ends] = np.arange(ends)[:, None, None]
    return model.replace(successor=jnp.asarray(successor)), goal


def slippery_grid(side: int, seed: int = 0) -> MDP:
    """A grid with a tenth of walls, slip .2, and one absorbing cell: mixes slowly."""
    rng = np.random.default_rng(seed)
    cells = np.where(rng.random((side, side)) < 0.1, "#", ".")
    cells[side // 2, side // 2] = "y"
    return gridworld("\n".join(map("".join, cells)), slip=0.2, absorbing=["y"])
