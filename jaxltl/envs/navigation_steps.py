"""The navigation tasks as environments with a reward in every step.

Rewards and costs are the increments of J and Z of :mod:`~jaxltl.envs.navigation`. The state
includes the quantities on which increments depend (least distance, visits); observations do not.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core import struct, validation
from jaxltl.core.array_types import Key
from jaxltl.core.environments.environment import Environment, Timestep, make_box, make_environment
from jaxltl.envs import navigation as nav
from jaxltl.envs.navigation import Navigation, State


class Place(NamedTuple):
    """State of the environment: the `state` of the robot and `time`, the number of steps.

    `first` is True in the first state; `nearest` is the least distance from the obstacle before it, and
    `goal` and `obstacle` are True if visited before it.

    >>> task = as_environment(nav.navigation(), 1)
    >>> jax.eval_shape(task.reset, jax.random.key(0)).time.dtype.name
    'int32'
    """

    state: State
    first: jax.Array
    nearest: jax.Array
    goal: jax.Array
    obstacle: jax.Array
    time: jax.Array


@struct.dataclass
class _StepSettings:
    """Settings; the task is traced, so that one compiled program serves all four."""

    task: jax.Array
    absorbing: jax.Array
    dtype: np.dtype | type | None = struct.field(pytree_node=False)


def as_environment(
    world: Navigation,
    task: int,
    *,
    absorbing: bool | None = None,
    dtype: np.dtype | type | None = None,
) -> Environment:
    """An environment of one of the four tasks, with episodes of ``world.horizon`` steps.

    The reward of a step is that of the state before it, so that N steps have the sums of
    :func:`~jaxltl.envs.navigation.scores`; the last action has no effect. Observations are those of
    :func:`~jaxltl.envs.navigation.observe`.

    Args:
      world, task: the map, and 1 to 4; another task does not recompile.
      absorbing: make the goal absorbing; default: only in task 1.
      dtype: of all numbers; default: JAX's.

    Raises:
      ValueError: an unknown task.

    >>> task = as_environment(nav.navigation(initial=((2, 1.5), (2, 1.5))), 2)
    >>> place = task.reset(jax.random.key(0))
    >>> made = task.step(place, jnp.zeros(2), None)
    >>> float(made.reward), float(made.cost)
    (30.0, -1.0)
    """
    nav.check_task(task)
    stays = task == 1 if absorbing is None else validation.boolean("absorbing", absorbing)
    settings = _StepSettings(
        jnp.int32(task), jnp.bool_(stays), np.dtype(dtype or jnp.result_type(float))
    )
    reset, step, observe, labels = (
        jax.tree_util.Partial(f, settings, world) for f in (_reset, _step, _observe, _labels)
    )
    return make_environment(
        reset,
        step,
        observe,
        actions=make_box(-1, 1, (2,), settings.dtype),
        labels=labels,
        propositions=nav.PROPOSITIONS,
        horizon=world.horizon,
    )


def _reset(settings: _StepSettings, world: Navigation, key: Key) -> Place:
    state = nav.initial_states(key, world, dtype=settings.dtype)
    no = jnp.bool_(False)
    return Place(state, jnp.bool_(True), jnp.zeros((), settings.dtype), no, no, jnp.int32(0))


def _labels(settings: _StepSettings, world: Navigation, place: Place) -> jax.Array:
    return nav.labels(world, place.state)


def _observe(settings: _StepSettings, world: Navigation, place: Place) -> jax.Array:
    return nav.observe(world, place.state)


def _step(
    settings: _StepSettings, world: Navigation, place: Place, action: jax.Array, key: object
) -> Timestep:
    task, dtype = settings.task, settings.dtype
    in_goal, in_obstacle = nav.labels(world, place.state)
    goal, obstacle = place.goal | in_goal, place.obstacle | in_obstacle
    distance = nav.obstacle_distance(world, place.state)
    nearest = jnp.where(place.first, distance, jnp.minimum(place.nearest, distance))
    closer = nearest - place.nearest  # which is zero before the first state
    reward = jnp.where(
        (task == 1) | (task == 4),
        nav.reward(world, place.state),
        jnp.asarray(world.weight, dtype) * closer,
    )
    visit = goal.astype(dtype) - place.goal
    clean = (goal & ~obstacle).astype(dtype) - (place.goal & ~place.obstacle)
    cost = jnp.select([task == 3, task == 4], [in_goal.astype(dtype), clean], visit)
    following = nav.move(world, place.state, action.astype(dtype))
    stays = settings.absorbing & in_goal
    following = jax.tree.map(lambda x, y: jnp.where(stays, x, y), place.state, following)
    place = Place(following, jnp.bool_(False), nearest, goal, obstacle, place.time + 1)
    return Timestep(
        place, reward.astype(dtype), place.time >= world.horizon, cost=0 - cost.astype(dtype)
    )  # no -0
