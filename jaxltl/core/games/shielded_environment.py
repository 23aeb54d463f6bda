"""Shielded environments: the action mask of a permissive strategy of a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.core.environments.episodes import with_time_limit, without_time_limit
from jaxltl.core.environments.task_environment import with_tables, without_task
from jaxltl.core.environments.environment import (
    Environment,
    Finite,
    Timestep,
    as_partial,
    make_environment,
    require_environment,
)
from jaxltl.core.games.permissive import Permissive, apply_strategy, concrete_graph, staying
from jaxltl.core.games.winning import Winning
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.protocols import Array, PyTree
from jaxltl.core.pretty_print import brief


@brief
class ShieldedWorld(NamedTuple):
    """State of an environment and of its shielding strategy.

    Attributes:
      world: the state of the environment.
      state: ``int32[]``, the state of the strategy; -1 after a start outside of the winning region or
        after an action that the strategy does not allow.

    Example:
      >>> ShieldedWorld(world=3, state=-1).world
      3
    """

    world: PyTree
    state: jax.Array


@struct.dataclass
class _Guide:
    """A permissive strategy as tables over its G reachable states."""

    base: Array  # int32[G], the state of the world's model
    initial: Array  # bool[G]
    after: Array  # int32[G, N], the possible successors; -1 is padding
    allowed: Array  # bool[G, A]


def shield_environment(
    environment: Environment,
    strategy: Permissive | Winning | ArrayLike,
    state_of: Callable[..., PyTree] | None = None,
) -> Environment:
    """Environment with the action mask of a strategy of its model, ``allowed(world)``.

    With a :class:`~jaxltl.core.games.permissive.Permissive` strategy its worlds are
    :class:`ShieldedWorld`, with the memory of the strategy. A
    :class:`~jaxltl.core.games.winning.Winning` region allows the moves that surely stay in it, which
    suffices for safety. Where the strategy allows nothing (outside of its winning region) all
    actions of the environment are allowed, and the state is -1.

    Args:
      environment: the world, with finitely many actions, those of the model.
      strategy: of a model or a game with one move for each step of the world; or a mask
        ``bool[S, A]``, or ``bool[S, Q, A]``.
      state_of: ``world -> int``, the model's state of a world; of a mask with more axes a tuple of
        them. Default: the world itself; with a time limit or a task, the world inside of it is
        shielded.

    Returns:
      The environment.

    Raises:
      ValueError: actions of a box, another number of actions, a mask that is not Boolean, a
        strategy on a world without successor lists, or `state_of` that does not return integers.

    Example:
      >>> from jaxltl import from_dense, permissive_strategy
      >>> from jaxltl.core.environments import model_environment
      >>> model = from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 0]]],
      ...                    label={"crash": [1]}, initial=[1, 0])
      >>> safe = shield_environment(model_environment(model), permissive_strategy(model, "G !crash"))
      >>> safe.allowed(safe.reset(jax.random.key(0))).tolist()
      [True, False]
    """
    environment = require_environment(environment)
    if not isinstance(environment.actions, Finite):
        raise ValueError("a shield is for finitely many actions; this world's are of a box.")
    if state_of is None:  # the model's states are those of the world below a clock or a task
        inner, limit = without_time_limit(environment)
        if limit is not None:
            return with_time_limit(shield_environment(inner, strategy), limit)
        inner, tables = without_task(environment)
        if tables is not None:
            return with_tables(shield_environment(inner, strategy), tables)
    place = Partial(_itself) if state_of is None else as_partial(state_of, "state_of")
    if isinstance(strategy, Permissive | Winning):
        guide = _guide(strategy)
        _require_actions(guide.allowed, environment.actions.num)
        _require_places(environment, place, 1)
        shielded = replace(
            environment,
            reset=Partial(_reset, guide, place, environment.reset),
            step=Partial(_step, guide, place, environment.step),
            observe=Partial(of_world, environment.observe),
            labels=Partial(of_world, environment.labels),
            allowed=Partial(_allowed, guide, environment.allowed),
            starts=None
            if environment.starts is None
            else Partial(_starts, guide, place, environment.starts),
            outcomes=None
            if environment.outcomes is None
            else Partial(_outcomes, guide, place, environment.outcomes),
        )
    else:
        mask = np.asarray(strategy)
        if mask.dtype != bool or mask.ndim < 2:
            raise ValueError(
                f"the mask is {mask.dtype}{list(mask.shape)}; give bool[S, A], or bool[S, Q, A]."
            )
        _require_actions(mask, environment.actions.num)
        _require_places(environment, place, mask.ndim - 1)
        shielded = replace(
            environment, allowed=Partial(_looked_up, mask, place, environment.allowed)
        )
    return make_environment(
        **{field.name: getattr(shielded, field.name) for field in fields(shielded)}
    )


def _require_actions(mask: Array, num_actions: int) -> None:
    if mask.shape[-1] != num_actions:
        raise ValueError(
            f"the shield is of {mask.shape[-1]} actions, and the world has "
            f"{num_actions}; they must be the same ones."
        )


def _require_places(environment: Environment, place: Callable[..., PyTree], count: int) -> None:
    states = jax.eval_shape(lambda key: place(environment.reset(key)), jax.random.key(0))
    parts = states if isinstance(states, tuple) else (states,)
    if len(parts) != count or any(
        not hasattr(x, "dtype") or x.shape != () or x.dtype.kind not in "iu" for x in parts
    ):
        is_default = getattr(place, "func", None) is _itself
        subject = "the worlds of the environment are" if is_default else "state_of returns"
        wanted = "an integer" if count == 1 else f"a tuple of {count} integers"
        raise ValueError(
            f"{subject} {states}; {'give state_of, which returns' if is_default else 'return'} "
            f"{wanted}, the state of the model that a world is."
        )


def _guide(strategy: Permissive | Winning) -> _Guide:
    """The strategy on its reachable states, with all moves of both players."""
    if isinstance(strategy, Winning):
        graph = concrete_graph(strategy.game)
        region = np.asarray(strategy.region)
        every: Array = np.arange(strategy.game.state_shape[0], dtype=np.int32)
        allowed: Array = staying(graph, region)
        strategy = Permissive(
            strategy.game, strategy.region, allowed, every, every, False, "what stays"
        )
    restriction = apply_strategy(strategy)
    game = restriction.model
    if not isinstance(game.mdp, MDP):
        raise ValueError("a shield needs successor lists; convert the world by to_padded.")
    used = np.asarray(game.mdp.successor_probability) > 0
    successor = np.asarray(game.mdp.successor)
    base = np.asarray(strategy.base_state)[np.asarray(restriction.base_state)]
    after = np.where(used, successor, -1).reshape(len(base), -1)
    after = -np.sort(-after, axis=1)  # padding to the end
    return _Guide(
        base=base.astype(np.int32),
        initial=np.asarray(game.initial) > 0,
        after=after[:, : max(int((after >= 0).sum(1).max()), 1)].astype(np.int32),
        allowed=np.asarray(game.available),
    )


def _itself(world: PyTree) -> PyTree:
    return world


def _reset(
    guide: _Guide, place: Callable[..., PyTree], reset: Callable[..., PyTree], key: chex.PRNGKey
) -> ShieldedWorld:
    return _begin(guide, place, reset(key))


def _starts(
    guide: _Guide, place: Callable[..., PyTree], starts: Callable[..., PyTree]
) -> tuple[ShieldedWorld, jax.Array]:
    worlds, probability = starts()
    return jax.vmap(lambda world: _begin(guide, place, world))(worlds), probability


def _begin(guide: _Guide, place: Callable[..., PyTree], world: PyTree) -> ShieldedWorld:
    fits = jnp.asarray(guide.initial) & (jnp.asarray(guide.base) == place(world))
    return ShieldedWorld(world, _some(fits, jnp.arange(len(guide.base))))


def _step(
    guide: _Guide,
    place: Callable[..., PyTree],
    step: Callable[..., Timestep],
    before: ShieldedWorld,
    action: PyTree,
    key: chex.PRNGKey,
) -> Timestep:
    timestep = Timestep(*step(before.world, action, key))
    return timestep._replace(world=_follow(guide, place, before.state, timestep.world))


def _outcomes(
    guide: _Guide,
    place: Callable[..., PyTree],
    outcomes: Callable[..., PyTree],
    before: ShieldedWorld,
    action: PyTree,
) -> tuple[Timestep, jax.Array]:
    timesteps, probability = outcomes(before.world, action)
    worlds = jax.vmap(lambda world: _follow(guide, place, before.state, world))(timesteps[0])
    return Timestep(*timesteps)._replace(world=worlds), probability


def _follow(
    guide: _Guide, place: Callable[..., PyTree], state: jax.Array, world: PyTree
) -> ShieldedWorld:
    # The previous state and the new state of the world determine the memory: all moves between them
    # lead to the same memory state.
    after = jnp.asarray(guide.after)[jnp.maximum(state, 0)]
    fits = (after >= 0) & (jnp.asarray(guide.base)[after] == place(world)) & (state >= 0)
    return ShieldedWorld(world, _some(fits, after))


def _some(fits: jax.Array, states: jax.Array) -> jax.Array:
    return jnp.where(fits.any(), states[jnp.argmax(fits)], -1).astype(jnp.int32)


def _allowed(guide: _Guide, inner: Callable[..., PyTree] | None, shielded: ShieldedWorld) -> PyTree:
    sure = jnp.asarray(guide.allowed)[jnp.maximum(shielded.state, 0)] & (shielded.state >= 0)
    return _within(sure, inner, shielded.world)


def _looked_up(
    mask: jax.Array,
    place: Callable[..., PyTree],
    inner: Callable[..., PyTree] | None,
    world: PyTree,
) -> PyTree:
    return _within(jnp.asarray(mask)[place(world)], inner, world)


def _within(sure: jax.Array, inner: Callable[..., PyTree] | None, world: PyTree) -> jax.Array:
    every = jnp.ones_like(sure) if inner is None else inner(world)
    return jnp.where((sure & every).any(), sure & every, every)


def of_world(function: Callable[..., PyTree], shielded: ShieldedWorld) -> PyTree:
    """A function of the world's state, for a shielded state."""
    return function(shielded.world)
