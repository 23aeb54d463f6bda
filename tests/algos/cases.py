"""Cases of the laws that every learner keeps, and worlds for them.

The tests of a learner have ``CASES``, functions by name that return a :class:`LearnerCase`;
``test_learner.py`` tests the laws on all of them.
"""

from __future__ import annotations

import importlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxltl as jl
from jaxltl import algos
from jaxltl.core.environments.environment import Timestep
from jaxltl.core.models.game import make_game

LEARNERS = {
    name: module
    for name in (*algos.__all__, "grounding.hidden_modes")
    if hasattr(module := importlib.import_module(f"jaxltl.algos.{name}"), "Hparams")
}


class LearnerCase(NamedTuple):
    """A learner, a problem for it, and two settings of the same kind."""

    module: Any
    problem: Any
    hparams: Any
    other: Any
    reward: str | None = None  # the problem's field with a number for each action


def world():
    """A start, a goal and a trap, which have one action; lists of successors with padding."""
    mdp = jl.make_mdp(
        [[[1, 2], [0, 1]], [[1, 0], [0, 0]], [[2, 0], [0, 0]]],
        [[[0.8, 0.2], [0.5, 0.5]], [[1, 0], [0, 0]], [[1, 0], [0, 0]]],
        available=[[True, True], [True, False], [True, False]],
        initial=[1, 0, 0],
        label=[[False, False], [True, False], [False, True]],
        propositions=["g", "r"],
    )
    runs = [[(0, 1), (0, 0), (1, 0)], [(0, 0), (1, 0)]]
    return mdp, jl.make_trajectories(mdp, runs)


def numbers(*shape):
    return np.random.default_rng(0).normal(size=shape)


def alternating_game():
    """Two of the system's states between two of the environment's, where chance plays."""
    successor = [[[2, 0], [3, 0]], [[3, 0], [0, 0]], [[0, 1], [1, 0]], [[1, 0], [0, 1]]]
    certain, fair = [[1, 0], [1, 0]], [[0.5, 0.5], [1, 0]]
    mdp = jl.make_mdp(
        successor,
        [certain, [[1, 0], [0, 0]], fair, fair],
        available=[[True, True], [True, False], [True, True], [True, True]],
    )
    reward = [[1.0, 0.0], [0.3, 0.0], [0.2, 0.0], [0.0, 0.3]]
    return make_game(mdp, [True, True, False, False]), reward


def choice_reset(key):
    return jax.random.uniform(key, (2,), minval=-1)


def choice_step(world, action, key):
    """A point pushed about; the reward is for being near, the cost is the push."""
    place = world + 0.3 * action
    return Timestep(place, -jnp.sum(place**2), jnp.abs(place).max() > 4, cost=jnp.sum(action**2))


def choice_observe(world):
    return world
