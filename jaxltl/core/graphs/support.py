"""Supports on the host, and loops that run there where arrays are concrete."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import DenseMDP

# --- the host side: an MDP is a product with one memory state -----------------------------


def is_traced(tree: Any) -> bool:
    """Whether any array in a tree is abstract, so that the host cannot read it."""
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree))


def repeat(body: Any, start: tuple[Any, ...], arguments: Any) -> tuple[Any, ...]:
    """Repeats while the last entry of what is carried is true.

    With concrete arguments the loop runs on the host, so that worklists can serve in it.
    """
    if is_traced(arguments):
        return lax.while_loop(lambda carry: carry[-1], body, start)
    carry = start
    while bool(carry[-1]):
        carry = body(carry)
    return carry


def _label_on(model: Any) -> str:
    return getattr(model.mdp if isinstance(model, Game) else model, "label_on", "entry")


def _support(model: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """``successor[S, A, K]``, whether it is one, and ``next_memory[S, Q]``."""
    model = model.mdp if isinstance(model, Game) else model
    world = getattr(model, "mdp", model)
    used = world.successor_probability > 0
    if isinstance(world, DenseMDP):
        successor = jnp.broadcast_to(jnp.arange(world.num_states, dtype=jnp.int32), used.shape)
    else:
        successor = world.successor
    if world is model:
        return successor, used, jnp.zeros((world.num_states, 1), jnp.int32)
    return successor, used, model.next_memory
