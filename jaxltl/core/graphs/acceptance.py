"""Where a run of a product is accepted for ever after: accepting end and bottom components.

Almost every run stays in one end component from some point on and takes all of its transitions
infinitely often (de Alfaro 1997), so what it reads infinitely often is decided on the graph.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxltl.core.graphs.attractor import attract
from jaxltl.core.graphs.end_components import closed_components, components_within
from jaxltl.core.graphs.graph import graph_of, take
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.product import Product


class Accepting(NamedTuple):
    """A region where acceptance is almost sure, with a policy that stays in it.

    Attributes:
      region: ``bool[S, Q]``.
      action: ``int32[S, Q]``: in the region, the action of a policy by which almost every
        run is accepted.
      inside: ``bool[S, Q, A]``: in the region, the actions of the state's end component; who takes
        them all for ever reads its least priority, which is even, for ever. False elsewhere.
      least: ``int32[S, Q]``: in the region, that priority; -1 elsewhere.
    """

    region: jax.Array
    action: jax.Array
    inside: jax.Array
    least: jax.Array


def accepting_end_components(model: Product) -> Accepting:
    """The states of end components in which the least priority can be even for ever.

    For each even p: the maximal end components of the actions that read no priority
    below p, with an action that reads p (Baier and Katoen 2008, section 10.6.4, for Rabin
    pairs). The policy goes round by that action.

    Args:
      model: the product.

    Returns:
      :class:`Accepting`. A run is accepted with the largest probability of reaching its
      region. Its end components do not overlap: those of a greater p lie within those of a lesser
      one or outside of them all, and then the largest counts.
    """
    graph = graph_of(model)
    xp, available = graph.xp, graph.available
    priority = take(graph, model.automaton.priority)
    everywhere = xp.ones(graph.state_shape, bool)

    def body(half: Any, found: Accepting) -> Accepting:
        least = 2 * half
        allowed = available & ~graph.reads(priority < least)
        components = components_within(graph, everywhere, allowed)
        hits = components.inside & graph.reads(priority == least)
        hit, action = graph.first(hits)
        wins = graph.anywhere(hit, components.component) & graph.first(components.inside)[0]
        towards = attract(graph, hit, components.inside).action
        action = xp.where(hit, action, towards)
        new = wins & ~found.region
        return Accepting(
            found.region | new,
            xp.where(new, action, found.action),
            found.inside | (components.inside & new[..., None]),
            xp.where(new, least, found.least).astype(np.int32),
        )

    nothing = xp.zeros(graph.state_shape, np.int32)
    start = Accepting(
        ~everywhere, graph.first(available)[1], xp.zeros(available.shape, bool), nothing - 1
    )
    return to_jax(graph.times(priority.max() // 2 + 1, body, start))


def accepting_bottom_components(model: Product, policy: jax.Array) -> jax.Array:
    """The states of closed components, under a policy, whose least priority is even.

    Args:
      model: the product.
      policy: ``float[S, Q, A]``.

    Returns:
      ``bool[S, Q]``. A run is accepted with the probability of reaching this region.
    """
    graph = graph_of(model, policy)
    xp = graph.xp
    priority, policy = take(graph, (model.automaton.priority, policy))
    bottom = closed_components(graph, policy > 0)
    inside = bottom.inside.any(-1)

    def body(i: Any, least: Any) -> Any:
        # From the greatest down, so that the least stands last.
        p = priority.max() - i
        met = (bottom.inside & graph.reads(priority == p)).any(-1)
        return xp.where(graph.anywhere(met, bottom.component) & inside, p, least)

    # Nothing met is no acceptance.
    start = xp.full(graph.state_shape, 1, priority.dtype)
    least = graph.times(priority.max() + 1, body, start)
    return to_jax(inside & (least % 2 == 0))
