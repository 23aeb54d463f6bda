"""Environments of the packages brax and MuJoCo Playground, which share the form of their states."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import Environment, Timestep, make_box, make_environment
from jaxltl.envs.adapters.common import (
    Foreign,
    Held,
    copied,
    layers,
    own_errors,
    package,
    refuse_wrappers,
    require_environment,
    reset_to_arrays,
    timestep,
)


def from_brax(
    env: Foreign,
    *,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] = (),
) -> Environment:
    """A Brax environment without its auto-reset and batch wrappers.

    Its ``done`` terminates. Limit episodes by ``with_time_limit(from_brax(env), 1000)``, or by Brax's
    ``EpisodeWrapper``, which truncates by ``info["truncation"]``.

    Args:
      env: as ``brax.envs.get_environment(name)`` returns it. Actions are in [-1, 1].
      labels, propositions: ``state -> bool[P]``, of Brax's ``State`` (`obs`, `pipeline_state`), and
        its names.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment` with Brax's states.

    Raises:
      ValueError: not a Brax environment, or an auto-reset or batch wrapper.
      ImportError: brax is not installed.

    >>> import brax.envs
    >>> world = from_brax(brax.envs.get_environment("inverted_pendulum"))
    >>> world.actions.shape, world.observations.shape
    ((1,), (4,))
    """
    training = package("brax.envs.wrappers.training")
    require_environment("brax", env, package("brax.envs").Env, "brax.envs.get_environment(name)")
    refuse_wrappers(
        "brax",
        env,
        "env",
        (training.AutoResetWrapper, training.VmapWrapper, training.DomainRandomizationVmapWrapper),
        "give brax.envs.get_environment(name), and limit its episodes by with_time_limit",
    )
    return _adapted("brax", env, labels, propositions)


def from_playground(
    env: Foreign,
    *,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] = (),
) -> Environment:
    """A MuJoCo Playground environment without its auto-reset and batch wrappers.

    Its ``done`` terminates. Playground limits episodes only in training: limit them by
    ``with_time_limit(from_playground(env), config.episode_length)``, or by Brax's ``EpisodeWrapper``,
    which truncates by ``info["truncation"]``.

    Args:
      env: as ``mujoco_playground.registry.load(name)`` returns it. Actions are in [-1, 1], as in
        Playground's training. Its default implementation of the physics, Warp, is for GPUs; on a
        processor give ``load(name, config_overrides={"impl": "jax"})``.
      labels, propositions: ``state -> bool[P]``, of Playground's ``State`` (`obs`, `data`), and its
        names.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment` with Playground's states.

    Raises:
      ValueError: not a Playground environment, or an auto-reset or batch wrapper.
      ImportError: playground is not installed.

    >>> from mujoco_playground import registry
    >>> env = registry.load("CartpoleBalance", config_overrides={"impl": "jax"})
    >>> world = from_playground(env)
    >>> world.actions.shape, world.observations.shape
    ((1,), (5,))
    """
    root = package("mujoco_playground", "playground")
    training = package("brax.envs.wrappers.training")
    inner = [*layers(env, "env")][-1]
    make = "mujoco_playground.registry.load(name)"
    require_environment("playground", inner, root.MjxEnv, make)
    refuse_wrappers(
        "playground",
        env,
        "env",
        (
            root.wrapper.BraxAutoResetWrapper,
            root.wrapper.BraxDomainRandomizationVmapWrapper,
            training.AutoResetWrapper,
            training.VmapWrapper,
            training.DomainRandomizationVmapWrapper,
        ),
        f"give {make}, and limit its episodes by with_time_limit",
    )
    return _adapted("playground", env, labels, propositions)


def _adapted(
    root: str,
    env: Foreign,
    labels: Callable[..., jax.Array] | None,
    propositions: Sequence[str],
) -> Environment:
    """The environment of a checked argument."""
    held, size = Held(env), int(env.action_size)
    length, repeat = getattr(env, "episode_length", None), getattr(env, "action_repeat", 1)
    with own_errors(root, env):
        return make_environment(
            Partial(reset_to_arrays, held),
            Partial(_step, held),
            Partial(_observe),
            actions=make_box(-1.0, 1.0, (size,), np.float32),
            labels=labels,
            propositions=propositions,
            horizon=None if length is None else -(-int(length) // int(repeat)),
        )


def _step(held: Held, world: PyTree, action: PyTree, key: Key) -> Timestep:
    after = held.it.step(copied(world), action)
    done = after.done > 0
    truncated = after.info.get("truncation", jnp.zeros_like(after.done)) > 0
    return timestep(after, world, after.reward, done & ~truncated, truncated)


def _observe(world: PyTree) -> PyTree:
    return world.obs
