"""Environments of the package jumanji."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

from jaxltl.core import validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import (
    Box,
    Environment,
    Finite,
    Timestep,
    make_box,
    make_environment,
    of_world,
    optional,
)
from jaxltl.core.pretty_print import brief
from jaxltl.envs.adapters.common import (
    Foreign,
    Held,
    Seen,
    arrays,
    copied,
    labels_of_state,
    layers,
    observation_of,
    package,
    refuse_wrappers,
    require_environment,
    some_allowed,
    timestep,
)

# More are learned part by part, and a mask of all their combinations would fill the memory.
_MAX_ACTIONS = 2**20


def from_jumanji(
    env: Foreign,
    *,
    in_turn: bool = False,
    labels: Callable[..., jax.Array] | None = None,
    propositions: Sequence[str] = (),
) -> Environment:
    """A Jumanji environment.

    An episode is terminated if it would end (with a discount of 0) without the time limit
    `env.time_limit`, and truncated otherwise. States are pairs of Jumanji's ``state``, which contains
    its key, and ``observation``; the key of a step is not used.

    Args:
      env: as ``jumanji.make(name)`` returns it. An action of several components is numbered, with the
        last component fastest. An `action_mask` in the observation determines `allowed`.
      in_turn: choose one component in each step, the last of which moves the environment. For
        components with too many combinations.
      labels, propositions: ``state -> bool[P]``, of Jumanji's state, and its names.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`.

    Raises:
      ValueError: not a Jumanji environment, an auto-reset or batch wrapper, rewards of several agents,
        or actions that are neither finite nor in a box, or have too many combinations.
      ImportError: jumanji is not installed.

    >>> import jumanji
    >>> world = from_jumanji(jumanji.make("Snake-v1"))
    >>> world.actions.num, world.allowed is None
    (4, False)
    """
    jumanji, wrappers = package("jumanji"), package("jumanji.wrappers")
    require_environment("jumanji", env, jumanji.Environment, "jumanji.make(name)")
    refuse_wrappers(
        "jumanji",
        env,
        "_env",
        (wrappers.AutoResetWrapper, wrappers.VmapWrapper, wrappers.VmapAutoResetWrapper),
        "give what is in it",
    )
    if env.reward_spec.shape != ():
        raise ValueError(
            f"from_jumanji: {type(env).__name__} has rewards of shape {env.reward_spec.shape}, "
            "one for each agent; wrap it in jumanji.wrappers.MultiToSingleWrapper."
        )
    held, endless, parts = Held(env), Held(_without_limit(env)), _parts(env)
    limit = next((x.time_limit for x in layers(env, "_env") if "time_limit" in vars(x)), None)
    limit = None if limit is None else int(limit)
    if validation.boolean("in_turn", in_turn):
        if not parts:
            raise ValueError(
                f"from_jumanji: in_turn=True, but an action of {type(env).__name__} has no parts "
                "of finitely many values; leave it out."
            )
        return _part_by_part(
            parts,
            Inner(
                Partial(_reset, held),
                Partial(_moved, held, endless),
                Partial(observation_of),
                labels_of_state(labels),
                None if _mask(env, parts) is None else Partial(_mask_in),
            ),
            propositions=propositions,
            horizon=limit,
        )
    return make_environment(
        Partial(_reset, held),
        Partial(_step, held, endless, Held(parts)),
        Partial(observation_of),
        actions=_actions(env.action_spec, parts),
        labels=labels_of_state(labels),
        propositions=propositions,
        allowed=_mask(env, parts),
        horizon=limit,
    )


def _without_limit(env: Foreign) -> PyTree:
    """A copy of an environment without its time limit, in all layers."""
    endless = copy.copy(env)
    for name, value in vars(env).items():
        if name == "_env":
            setattr(endless, name, _without_limit(value))
        elif name == "time_limit":
            setattr(endless, name, np.iinfo(np.int32).max)
    return endless


def _parts(env: Foreign) -> tuple[int, ...] | None:
    """Numbers of values of the integer components of an action; () for a scalar action."""
    spec = env.action_spec
    if hasattr(spec, "num_values"):
        return tuple(np.ravel(spec.num_values).tolist()) if spec.shape else ()
    if not (spec.shape and hasattr(spec, "minimum") and jnp.issubdtype(spec.dtype, jnp.integer)):
        return None
    low, high = (np.broadcast_to(x, spec.shape).ravel() for x in (spec.minimum, spec.maximum))
    mask = _mask_of(env)
    width = mask.shape[1] if mask is not None and mask.ndim == 2 else np.inf
    return tuple(int(min(n, width)) for n in high.astype(int) - low + 1)


def _actions(spec: Foreign, parts: tuple[int, ...] | None) -> Finite | Box:
    if parts is not None:
        count = math.prod(parts) if spec.shape else int(spec.num_values)
        if count > _MAX_ACTIONS:
            raise ValueError(
                f"from_jumanji: parts of {list(parts)} values make {count} actions; at most "
                f"{_MAX_ACTIONS} are numbered. Choose the parts one after the other, "
                "in_turn=True, or take fewer agents or a smaller board."
            )
        return Finite(count)
    if not (hasattr(spec, "minimum") and jnp.issubdtype(spec.dtype, jnp.floating)):
        raise ValueError(f"from_jumanji: actions are {spec!r}; they must be finite or in a box.")
    return make_box(spec.minimum, spec.maximum, spec.shape, spec.dtype)


def _mask_of(env: Foreign) -> PyTree:
    seen = jax.eval_shape(lambda key: env.reset(key)[1].observation, jax.random.key(0))
    return getattr(seen, "action_mask", None)


def _mask(env: Foreign, parts: tuple[int, ...] | None) -> Partial | None:
    mask = None if parts is None else _mask_of(env)
    if parts is None or mask is None:
        return None
    together = tuple(mask.shape) == parts or (not parts and len(mask.shape) == 1)
    apart = len(mask.shape) == 2 and mask.shape[0] == len(parts) and mask.shape[1] >= max(parts)
    if not (together or apart):
        raise ValueError(
            f"from_jumanji: action_mask has the shape {list(mask.shape)}, for actions of "
            f"{list(parts)} values."
        )
    return Partial(_allowed_together) if together else Partial(_allowed_apart, Held(parts))


def _mask_in(world: Seen) -> jax.Array:
    return world.observation.action_mask


def _allowed_together(world: Seen) -> jax.Array:
    return some_allowed(world.observation.action_mask.ravel())


def _allowed_apart(parts: Held, world: Seen) -> jax.Array:
    mask, allowed = world.observation.action_mask, jnp.ones(1, bool)
    for row, count in enumerate(parts.it):
        allowed = (allowed[:, None] & mask[row, :count]).ravel()
    return some_allowed(allowed)


def _reset(held: Held, key: Key) -> Seen:
    state, first = held.it.reset(key)
    return arrays(Seen(state, first.observation))


def _step(
    held: Held, endless: Held, parts: Held, world: Seen, action: PyTree, key: Key
) -> Timestep:
    action = jnp.stack(jnp.unravel_index(action, parts.it)) if parts.it else action
    return _moved(held, endless, world, action, key)


def _moved(held: Held, endless: Held, world: Seen, action: PyTree, key: Key) -> Timestep:
    """A step with a scalar action, or with a vector of components."""
    spec = held.it.action_spec
    if spec.shape and jnp.issubdtype(spec.dtype, jnp.integer):
        action = (action.reshape(spec.shape) + getattr(spec, "minimum", 0)).astype(spec.dtype)
    state, after = held.it.step(copied(world.state), action)
    _, further = endless.it.step(copied(world.state), action)
    terminated = further.last() & (further.discount == 0)
    return timestep(
        Seen(state, after.observation), world, after.reward, terminated, after.last() & ~terminated
    )


# --- one component after the other -----------------------------------------------------------------

# A step of the package's environment is N steps here, each with a choice of one component; the last
# one moves the environment. For N components with too many combinations.


@brief
class PartWorld(NamedTuple):
    """The inner state, the components ``int32[N]`` chosen so far (else 0), and the current one."""

    world: PyTree
    parts: jax.Array
    turn: jax.Array


@brief
class PartObservation(NamedTuple):
    """The inner observation, the chosen components ``bool[N, M]``, and the current one ``bool[N]``."""

    world: PyTree
    parts: jax.Array
    turn: jax.Array


@dataclass(frozen=True)
class Inner:
    """Functions of an environment with vectors of components as actions."""

    reset: Callable[..., PyTree]
    step: Callable[..., Timestep]  # (world, int32[N], key)
    observe: Callable[..., PyTree]
    labels: Partial | None
    mask: Callable[..., jax.Array] | None  # world -> bool of all combinations, or bool[N, M]


def _part_by_part(
    counts: Sequence[int], inner: Inner, *, propositions: Sequence[str], horizon: int | None
) -> Environment:
    """Environment in which the N components of an action are chosen sequentially."""
    held = Held(tuple(counts))
    return make_environment(
        Partial(_begin, held, inner.reset),
        Partial(_choose, held, inner.step),
        Partial(_seen, held, inner.observe),
        actions=max(counts),
        labels=optional(of_world, inner.labels),
        propositions=propositions,
        allowed=Partial(_allowed_values, held, inner.mask),
        horizon=None if horizon is None else horizon * len(counts),
    )


def _nothing(counts: Held, world: PyTree) -> PartWorld:
    return PartWorld(world, jnp.zeros(len(counts.it), jnp.int32), jnp.int32(0))


def _begin(counts: Held, reset: Callable[..., PyTree], key: Key) -> PartWorld:
    return _nothing(counts, reset(key))


def _choose(
    counts: Held, step: Callable[..., Timestep], now: PartWorld, action: jax.Array, key: Key
) -> Timestep:
    last = now.turn == len(counts.it) - 1
    parts = now.parts.at[now.turn].set(action)

    def wait() -> Timestep:
        return timestep(now.world, now.world, 0.0, False, False)

    after = lax.cond(last, lambda: step(now.world, parts, key), wait)
    fresh, going = _nothing(counts, after.world), PartWorld(after.world, parts, now.turn + 1)
    return after._replace(world=jax.tree.map(lambda x, y: jnp.where(last, x, y), fresh, going))


def _seen(counts: Held, observe: Callable[..., PyTree], now: PartWorld) -> PartObservation:
    number = jnp.arange(len(counts.it))
    chosen = jax.nn.one_hot(now.parts, max(counts.it), dtype=bool)
    return PartObservation(
        observe(now.world), chosen & (number < now.turn)[:, None], number == now.turn
    )


def _allowed_values(
    counts: Held, mask: Callable[..., jax.Array] | None, now: PartWorld
) -> jax.Array:
    """Mask of values of the current component that extend the components chosen so far."""
    width = max(counts.it)
    inside = (jnp.arange(width) < jnp.array(counts.it)[:, None])[now.turn]
    if mask is None:
        return inside
    allowed = mask(now.world)
    if allowed.shape == counts.it:
        for part, count in enumerate(counts.it):
            own = jnp.arange(count) == now.parts[part]
            shape = [count if i == part else 1 for i in range(allowed.ndim)]
            allowed &= ((part >= now.turn) | own).reshape(shape)
        rows = [
            jnp.pad(allowed.any([i for i in range(allowed.ndim) if i != part]), (0, width - count))
            for part, count in enumerate(counts.it)
        ]
        allowed = jnp.stack(rows)
    row = allowed[now.turn, :width] & inside
    return jnp.where(row.any(), row, inside)
