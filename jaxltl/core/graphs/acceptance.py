"""Where a run of a product is accepted for ever after: accepting end and bottom components.

Almost every run stays in one end component from some point on and takes all of its transitions
infinitely often (de Alfaro 1997), so what it reads infinitely often is decided on the graph.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.graphs.end_components import bottom_components, end_components
from jaxltl.core.graphs.support import is_traced
from jaxltl.core.models.operators import first_action
from jaxltl.core.models.product import Product, reads


class Accepting(NamedTuple):
    """A region where acceptance is almost sure, with a policy that stays in it.

    Attributes:
      region: ``bool[S, Q]``.
      action: ``int32[S, Q]``: in the region, the action of a policy by which almost every
        run is accepted.
    """

    region: jax.Array
    action: jax.Array


def accepting_end_components(model: Product) -> Accepting:
    """The states of end components in which the least priority can be even for ever.

    For each even p: the maximal end components of the actions that read no priority
    below p, with an action that reads p (Baier and Katoen 2008, section 10.6.4, for Rabin
    pairs). The policy goes round by that action.

    Args:
      model: the product.

    Returns:
      :class:`Accepting`. A run is accepted with the largest probability of reaching its
      region.
    """
    priority = jnp.asarray(model.automaton.priority)
    _, first = first_action(model.available)
    start = Accepting(jnp.zeros(model.state_shape, bool), first)

    def body(half: jax.Array | int, found: Accepting) -> Accepting:
        least = 2 * half
        allowed = model.available & ~reads(model, priority < least)
        components = end_components(model, jnp.ones(model.state_shape, bool), allowed)
        hits = components.inside & reads(model, priority == least)
        hit, action = first_action(hits)
        wins = _anywhere(hit, components.component) & first_action(components.inside)[0]
        towards = attractor(model, hit, components.inside).action
        action = jnp.where(hit, action, towards)
        new = wins & ~found.region
        return Accepting(found.region | new, jnp.where(new, action, found.action))

    return _repeat(priority.max() // 2 + 1, body, start, (model, priority))


def accepting_bottom_components(model: Product, policy: jax.Array) -> jax.Array:
    """The states of closed components, under a policy, whose least priority is even.

    Args:
      model: the product.
      policy: ``float[S, Q, A]``.

    Returns:
      ``bool[S, Q]``. A run is accepted with the probability of reaching this region.
    """
    allowed = model.available & (policy > 0)
    priority = jnp.asarray(model.automaton.priority)
    bottom = bottom_components(model, allowed)
    inside = bottom.inside.any(-1)
    start = jnp.full(model.state_shape, jnp.iinfo(jnp.int32).max)

    def body(i: jax.Array | int, least: jax.Array) -> jax.Array:
        # From the greatest down, so that the least stands last.
        p = priority.max() - i
        met = _anywhere((bottom.inside & reads(model, priority == p)).any(-1), bottom.component)
        return jnp.where(met & inside, p, least)

    least = _repeat(priority.max() + 1, body, start, (model, policy))
    return inside & (least % 2 == 0)


def _anywhere(mark: jax.Array, component: jax.Array) -> jax.Array:
    """Whether a state of the same component is marked."""
    label = component.ravel()
    found = jax.ops.segment_max(mark.ravel().astype(jnp.int32), label, num_segments=label.size)
    return (found[label] > 0).reshape(mark.shape)


def _repeat(count, body, start, arguments):
    """A loop, on the host where the arrays are concrete, so that the graph's host path serves."""
    if is_traced(arguments):
        return lax.fori_loop(0, count, body, start)
    for i in range(int(count)):
        start = body(i, start)
    return start
