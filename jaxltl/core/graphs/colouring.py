"""Strongly connected components by sweeps, for models that no host holds.

Orzan's (2004) colouring: every state takes the least number that it reaches. A state that keeps its
own is the root of a component, and those of its colour that it reaches are the rest. What is left
is coloured again, with numbers that count the other way, so that neither order of the states along
a path is a bad one. Sweeps go on while news spreads, so paths cost as many as they are long.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.ops import operators


def components_by_sweeps(
    graph: Any, core: jax.Array, allowed: jax.Array, closed: bool
) -> tuple[jax.Array, jax.Array]:
    """Components among some states, and the actions that stay in them, as of a HostGraph.

    Args:
      graph: a :class:`~jaxltl.core.graphs.graph.TracedGraph`.
      core: ``bool[S]``.
      allowed: ``bool[S, A]``; unless `closed`, they surely stay in `core`.
      closed: whether only components count that no allowed action leaves.

    Returns:
      ``int32[S]``, the smallest number of a state of the same component, and ``bool[S, A]``.
    """
    stay = allowed & graph.available & core[..., None]

    def prune(carry: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[Any, ...]:
        stay, _, _ = carry
        label = strong_components(graph, core, stay)
        inside = (graph.least(label) == label[..., None]) & (
            -graph.least(-label) == label[..., None]
        )
        kept = stay & inside
        return kept, label, jnp.any(kept != stay)

    start = stay, jnp.zeros(core.shape, jnp.int32), jnp.bool_(True)
    if closed:
        kept, label, _ = prune(start)
        left = graph.anywhere(jnp.any(kept != stay, axis=-1), label)
        kept = stay & ~left[..., None]
    else:
        kept, label, _ = lax.while_loop(lambda carry: carry[2], prune, start)
    alive = jnp.any(kept, axis=-1)
    return jnp.where(alive, label, _numbers(core.shape)), kept


def strong_components(graph: Any, states: jax.Array, moves: jax.Array) -> jax.Array:
    """The smallest number in each state's component under some moves: ``int32[S]``.

    Args:
      graph: a :class:`~jaxltl.core.graphs.graph.TracedGraph`.
      states: ``bool[S]``, those that count; each other is alone.
      moves: ``bool[S, A]``, their actions, all successors of which can follow.
    """
    number = _numbers(states.shape)
    none = jnp.int32(number.size)

    def colour(rank: jax.Array, left: jax.Array) -> jax.Array:
        def spread(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            colour, _ = carry
            ahead = jnp.min(jnp.where(moves, graph.least(colour), none), axis=-1)
            new = jnp.where(left, jnp.minimum(colour, ahead), none)
            return new, jnp.any(new != colour)

        start = jnp.where(left, rank, none), jnp.bool_(True)
        return lax.while_loop(lambda carry: carry[1], spread, start)[0]

    def reached(colours: jax.Array, root: jax.Array, left: jax.Array) -> jax.Array:
        def spread(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            found, _ = carry
            sent = jnp.where(moves & found[..., None], (colours + 1)[..., None], 0)
            # Colours do not fall along moves, so the greatest that arrives is the state's own, if
            # any is.
            new = found | (
                left & (operators.greatest_predecessor(graph.model, sent) == colours + 1)
            )
            return new, jnp.any(new != found)

        return lax.while_loop(lambda carry: carry[1], spread, (root, jnp.bool_(True)))[0]

    def body(carry: Any) -> Any:
        label, left, forward = carry
        rank = jnp.where(forward, number, none - 1 - number)
        colours = colour(rank, left)
        found = reached(colours, left & (colours == rank), left)
        root = jnp.where(forward, colours, none - 1 - colours)
        return jnp.where(found, root, label), left & ~found, ~forward

    label, _, _ = lax.while_loop(
        lambda carry: jnp.any(carry[1]), body, (number, states, jnp.bool_(True))
    )
    flat = label.ravel()
    least = jnp.full(flat.shape, none).at[flat].min(number.ravel())
    return least[flat].reshape(states.shape)


def _numbers(shape: tuple[int, ...]) -> jax.Array:
    size = 1
    for n in shape:
        size *= n
    return jnp.arange(size, dtype=jnp.int32).reshape(shape)
