"""Maximal and accepting end components, and bottom strongly connected components."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.graphs.attractor import avoid, attract
from jaxltl.core.graphs.graph import (
    Graph,
    TracedGraph,
    graph_of,
    on_graph,
    state_numbers,
    take,
)
from jaxltl.core.models.ops.array_namespace import jax_array, to_jax
from jaxltl.core.models.ops.choices import choice_mask
from jaxltl.core.models.ops.state_sets import state_set
from jaxltl.core.models.ops.operators import pushforward
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Model, Array
from jaxltl.core.pretty_print import brief


@brief
class EndComponents(NamedTuple):
    """Maximal end components within a region.

    Attributes:
      component: ``int32[S]``: the smallest (flat) state number of the state's component; the
        state's own number outside of all components.
      inside: ``bool[S, A]``: the actions with all successors in the state's component.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.from_dense([[[0, 0.5, 0.5], [1, 0, 0]], [[0, 1, 0], [0, 0, 0]],
      ...                       [[0, 1, 0], [0, 0, 0]]])
      >>> jl.graphs.end_components(fork, np.array([True, False, True])).component.tolist()
      [0, 1, 2]
    """

    component: jax.Array
    inside: jax.Array


def end_components(
    model: Model, region: Array | str, allowed: jax.Array | None = None
) -> EndComponents:
    """Maximal end components that lie within a region (de Alfaro 1997).

    An end component is a set of states with actions that never leave it and connect it. Computed on
    the host; under ``jit`` by a callback.

    Args:
      model: the model.
      region: ``bool[S]``, a label's name, or a Boolean formula of labels.
      allowed: ``bool[S, A]``, of a sparse model ``bool[R]``; default: the available actions.

    Returns:
      :class:`EndComponents`. Boolean: there is no derivative.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.from_dense([[[0, 0.5, 0.5], [1, 0, 0]], [[0, 1, 0], [0, 0, 0]],
      ...                       [[0, 1, 0], [0, 0, 0]]])
      >>> end_components(fork, np.ones(3, bool)).inside.tolist()
      [[False, True], [True, False], [False, False]]
    """
    region, allowed = state_set(model, "region", region), choice_mask(model, "allowed", allowed)
    return on_graph(components_within, model, region, allowed)


def components_within(graph: Graph, region: Array, allowed: Array | None = None) -> EndComponents:
    """:func:`end_components` of a graph."""
    allowed = graph.available if allowed is None else allowed & graph.available
    if graph.xp is np:
        return EndComponents(*graph.components(region, allowed, closed=False))
    # Few states can stay in the region, as a rule.
    core = region & avoid(graph, ~region, allowed)
    allowed = allowed & graph.forall(core) & graph.on_choices(core)
    return EndComponents(*graph.components(core, allowed, closed=False))


def bottom_components(model: Model, allowed: jax.Array) -> EndComponents:
    """Bottom strongly connected components of the chain that takes all allowed actions."""
    return on_graph(closed_components, model, choice_mask(model, "allowed", allowed))


def closed_components(graph: Graph, allowed: Array) -> EndComponents:
    """:func:`bottom_components` of a graph."""
    everywhere = graph.xp.ones(graph.state_shape, bool)
    return EndComponents(*graph.components(everywhere, allowed & graph.available, closed=True))


def recurrent_states(graph: TracedGraph, region: jax.Array, moves: jax.Array) -> jax.Array:
    """Recurrent states in a closed region of the chain that takes all `moves` ``bool[S, A]``."""

    def least(number: jax.Array) -> jax.Array:
        ahead = jnp.where(moves, graph.least(number), jnp.iinfo(jnp.int32).max)
        return jnp.min(ahead, axis=-1)

    def reached(states: jax.Array) -> jax.Array:
        sent = (moves & states[..., None]).astype(graph.model.dtype)
        return pushforward(graph.model, sent) > 0

    return recurrent(region, least, reached)


def recurrent(
    region: jax.Array,
    least: Callable[[jax.Array], jax.Array],
    reached: Callable[[jax.Array], jax.Array],
) -> jax.Array:
    """Recurrent states in a region that is left to other classes at most, by sweeps in any order.

    `least` is the least of ``int32[S]`` among the successors, `reached` the successors of a set.
    """
    # The first sweeps give the least number of a state that is reachable. If it is the same for all
    # states that are reachable from the state with that number, all of them lead back to it, and
    # its class is what it reaches.

    def least_reachable(number: jax.Array) -> jax.Array:
        def grow(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            number, _ = carry
            new = jnp.where(region, jnp.minimum(number, least(number)), number)
            return new, jnp.any(new != number)

        result: jax.Array = lax.while_loop(lambda c: c[1], grow, (number, jnp.any(region)))[0]
        return result

    def spread(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        states, _ = carry
        new = states | (region & reached(states))
        return new, jnp.any(new != states)

    number = state_numbers(region.shape)
    lowest = least_reachable(number)
    root = region & (lowest == number) & (-least_reachable(-lowest) == lowest)
    result: jax.Array = lax.while_loop(lambda c: c[1], spread, (root, jnp.any(root)))[0]
    return result


class Accepting(NamedTuple):
    """A region where acceptance is almost sure, with a policy that stays in it."""

    region: jax.Array  # bool[S, Q]
    action: jax.Array  # int32[S, Q], in the region a policy that is accepted almost surely
    inside: jax.Array  # bool[S, Q, A], the actions of the state's end component; False elsewhere
    least: jax.Array  # int32[S, Q], the least priority of the component, even; -1 elsewhere


def accepting_end_components(model: Product) -> Accepting:
    """The union of accepting end components of a product, with a policy that is accepted there."""
    # For each even p: the maximal end components of the actions that read no priority below p, with
    # an action that reads p (Baier and Katoen 2008, section 10.6.4, for Rabin pairs), which the
    # policy takes infinitely often. Almost every trajectory ends in one end component and takes all
    # of its transitions infinitely often (de Alfaro 1997). The first p of a state counts.
    graph = graph_of(model)
    xp, available = graph.xp, graph.available
    priority = take(graph, model.automaton.priority)
    everywhere = xp.ones(graph.state_shape, bool)

    def body(half: Array, accepting: Accepting) -> Accepting:
        least = 2 * half
        allowed = available & ~graph.reads(priority < least)
        components = components_within(graph, everywhere, allowed)
        hits = components.inside & graph.reads(priority == least)
        hit, action = graph.first(hits)
        wins = graph.anywhere(hit, components.component) & graph.first(components.inside)[0]
        towards = attract(graph, hit, components.inside).action
        action = xp.where(hit, action, towards)
        new = wins & ~accepting.region
        return Accepting(
            accepting.region | new,
            xp.where(new, action, accepting.action),
            accepting.inside | (components.inside & new[..., None]),
            xp.where(new, least, accepting.least).astype(np.int32),
        )

    nothing = xp.zeros(graph.state_shape, np.int32)
    start = Accepting(
        ~everywhere, graph.first(available)[1], xp.zeros(available.shape, bool), nothing - 1
    )
    result: Accepting = to_jax(graph.times(priority.max() // 2 + 1, body, start))
    return result


def accepting_bottom_components(model: Product, policy: jax.Array) -> jax.Array:
    """States ``bool[S, Q]`` of accepting bottom strongly connected components of a policy."""
    graph = graph_of(model, policy)
    xp = graph.xp
    priority, policy = take(graph, (model.automaton.priority, policy))
    bottom = closed_components(graph, policy > 0)
    inside = bottom.inside.any(-1)

    def body(i: Array, least: Array) -> Array:
        # In descending order, so that the least is written last.
        p = priority.max() - i
        met = (bottom.inside & graph.reads(priority == p)).any(-1)
        return xp.where(graph.anywhere(met, bottom.component) & inside, p, least)

    # A component that reads no priority is not accepting.
    start = xp.full(graph.state_shape, 1, priority.dtype)
    least = graph.times(priority.max() + 1, body, start)
    return jax_array(inside & (least % 2 == 0))
