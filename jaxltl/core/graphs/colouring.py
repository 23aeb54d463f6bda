"""Strongly connected components by sweeps, for models over a mesh.

Colouring (Orzan 2004): each state takes the least number that it can reach. A state with its own
number is the root of a component: the states of its colour that it can reach. The other states are
coloured again with numbers in the reverse order, so that no order of the states along a path is
always bad. The number of sweeps is at most the length of a longest shortest path.
"""

from __future__ import annotations

import math


import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.ops import operators
from jaxltl.core.models.protocols import PyTree


def components_by_sweeps(
    graph: PyTree, core: jax.Array, allowed: jax.Array, closed: bool
) -> tuple[jax.Array, jax.Array]:
    """Components ``int32[S]`` and inner actions ``bool[S, A]``, as ``RowGraph.components``."""
    stay = allowed & graph.available & core[..., None]

    def prune(
        carry: tuple[jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        stay, _, _ = carry
        label = strong_components(graph, core, stay)
        inside = (graph.least(label) == label[..., None]) & (
            -graph.least(-label) == label[..., None]
        )
        moves = stay & inside
        return moves, label, jnp.any(moves != stay)

    start = stay, jnp.zeros(core.shape, jnp.int32), jnp.bool_(True)
    if closed:
        moves, label, _ = prune(start)
        removed = graph.anywhere(jnp.any(moves != stay, axis=-1), label)
        moves = stay & ~removed[..., None]
    else:
        moves, label, _ = lax.while_loop(lambda carry: carry[2], prune, start)
    alive = jnp.any(moves, axis=-1)
    return jnp.where(alive, label, state_numbers(core.shape)), moves


def strong_components(graph: PyTree, states: jax.Array, moves: jax.Array) -> jax.Array:
    """The least state of the component of each state under some actions; itself outside of `states`."""
    number = state_numbers(states.shape)
    none = jnp.int32(number.size)

    def colour(rank: jax.Array, undecided: jax.Array) -> jax.Array:
        def grow(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            colour, _ = carry
            ahead = jnp.min(jnp.where(moves, graph.least(colour), none), axis=-1)
            new = jnp.where(undecided, jnp.minimum(colour, ahead), none)
            return new, jnp.any(new != colour)

        start = jnp.where(undecided, rank, none), jnp.bool_(True)
        return lax.while_loop(lambda carry: carry[1], grow, start)[0]

    def reached(colours: jax.Array, root: jax.Array, undecided: jax.Array) -> jax.Array:
        def grow(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            region, _ = carry
            sent = jnp.where(moves & region[..., None], (colours + 1)[..., None], 0)
            # Colours do not decrease along edges, so the greatest one that arrives is the state's
            # own, if that one arrives.
            new = region | (
                undecided & (operators.greatest_predecessor(graph.model, sent) == colours + 1)
            )
            return new, jnp.any(new != region)

        return lax.while_loop(lambda carry: carry[1], grow, (root, jnp.bool_(True)))[0]

    def body(carry: PyTree) -> PyTree:
        label, undecided, forward = carry
        rank = jnp.where(forward, number, none - 1 - number)
        colours = colour(rank, undecided)
        region = reached(colours, undecided & (colours == rank), undecided)
        root = jnp.where(forward, colours, none - 1 - colours)
        return jnp.where(region, root, label), undecided & ~region, ~forward

    label, _, _ = lax.while_loop(
        lambda carry: jnp.any(carry[1]), body, (number, states, jnp.bool_(True))
    )
    flat = label.ravel()
    least = jnp.full(flat.shape, none).at[flat].min(number.ravel())
    return least[flat].reshape(states.shape)


def state_numbers(shape: tuple[int, ...]) -> jax.Array:
    """The number of each state, ``int32[S]``."""
    return jnp.arange(math.prod(shape), dtype=jnp.int32).reshape(shape)
