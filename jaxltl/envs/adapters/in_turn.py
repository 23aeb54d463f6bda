"""Environment adapter that chooses the components of a factored action one at a time.

A step of the package's environment is N steps here, each with a choice of one component; the last
one moves the environment. For N components with too many combinations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.tree_util import Partial

from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import (
    Environment,
    Timestep,
    make_environment,
    of_world,
    optional,
)
from jaxltl.core.pretty_print import brief
from jaxltl.envs.adapters.common import Held, timestep


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


def in_turn(
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
        allowed=Partial(_allowed, held, inner.mask),
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


def _allowed(counts: Held, mask: Callable[..., jax.Array] | None, now: PartWorld) -> jax.Array:
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
