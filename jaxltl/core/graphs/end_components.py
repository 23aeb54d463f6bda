"""Maximal end components, and the components that no action leaves."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.graphs.attractor import avoidable
from jaxltl.core.graphs.support import _label_on, _support, is_traced
from jaxltl.core.models.operators import forall_successor


class EndComponents(NamedTuple):
    """Maximal end components within a region.

    Attributes:
      component: ``int32[S]``: the smallest (flat) state number of the state's component;
        outside of all components, the state's own number.
      inside: ``bool[S, A]``: actions that surely stay in the state's component.
    """

    component: jax.Array
    inside: jax.Array


def end_components(
    model: Any, region: jax.Array, allowed: jax.Array | None = None
) -> EndComponents:
    """Maximal end components that lie within a region (de Alfaro 1997).

    An end component is a set of states with actions that never leave it and
    connect it. Computed on the host by strongly connected components, and only
    among the states that can stay in the region for ever; under ``jit`` by a callback.

    Args:
      model: the model.
      region: ``bool[S]``.
      allowed: ``bool[S, A]``, the actions that count; default the available ones.
    """
    # Only states that can remain in the region matter; usually there are few.
    core = region & avoidable(model, ~region, allowed)
    allowed = model.available if allowed is None else allowed
    allowed = allowed & forall_successor(model, core) & core[..., None]
    return _components(model, core, allowed, closed=False)


def bottom_components(model: Any, allowed: jax.Array) -> EndComponents:
    """Strongly connected components that no allowed action leaves.

    Args:
      model: the model.
      allowed: ``bool[S, A]``, the actions that are all taken, such as a policy's support.
    """
    return _components(model, jnp.ones(model.state_shape, bool), allowed, closed=True)


def _components(model: Any, core: jax.Array, allowed: jax.Array, closed: bool) -> EndComponents:
    flat = int(np.prod(model.state_shape))
    shapes = (
        jax.ShapeDtypeStruct(model.state_shape, jnp.int32),
        jax.ShapeDtypeStruct((*model.state_shape, model.num_actions), jnp.bool_),
    )

    def trivial():
        number = jnp.arange(flat, dtype=jnp.int32).reshape(model.state_shape)
        return number, jnp.zeros(shapes[1].shape, bool)

    arguments = (*_support(model), core, allowed)
    host = partial(_end_components, _label_on(model), closed)
    if is_traced(arguments):
        def callback():
            return jax.pure_callback(host, shapes, *arguments, vmap_method="sequential")
        return EndComponents(*lax.cond(core.any(), callback, trivial))
    if not bool(core.any()):
        return EndComponents(*trivial())
    found = host(*(np.asarray(x) for x in arguments))
    return EndComponents(*(jnp.asarray(x) for x in found))


def _end_components(label_on, closed, successor, used, next_memory, core, allowed):
    """Refines strongly connected components until no action leaves its own.

    Or, if only closed components are asked for, keeps those that no action leaves.
    """
    from scipy import sparse
    from scipy.sparse import csgraph

    successor, used, next_memory = (np.asarray(x) for x in (successor, used, next_memory))
    shape, num_memory = np.shape(core), next_memory.shape[1]
    total = next_memory.size
    states = np.flatnonzero(core)
    s, q = np.divmod(states, num_memory)
    read = successor[s] if label_on == "entry" else s[:, None, None]
    flat = successor[s].astype(np.int64) * num_memory + next_memory[read, q[:, None, None]]
    local = np.full(total, -1)
    local[states] = np.arange(states.size)
    target, real = local[flat], used[s]  # [N, A, K]
    stay = np.asarray(allowed).reshape(total, -1)[states]
    source = np.broadcast_to(np.arange(states.size)[:, None, None], target.shape)
    while True:
        edge = real & stay[:, :, None]
        graph = sparse.csr_array(
            (np.ones(edge.sum(), np.int8), (source[edge], target[edge])),
            shape=(states.size, states.size),
        )
        _, label = csgraph.connected_components(graph, connection="strong")
        leaves = edge & (label[target] != label[:, None, None])
        kept = stay & ~leaves.any(-1)
        if closed:
            open_ = np.unique(label[(leaves.any(-1) & stay).any(-1)])
            stay = stay & ~np.isin(label, open_)[:, None]
            break
        if (kept == stay).all():
            break
        stay = kept
    component = np.arange(total, dtype=np.int32)
    alive = stay.any(-1)
    smallest = np.full(label.max(initial=0) + 1, total)
    np.minimum.at(smallest, label, states)
    component[states[alive]] = smallest[label[alive]]
    inside = np.zeros((total, stay.shape[1]), bool)
    inside[states] = stay
    return component.reshape(shape), inside.reshape(*shape, -1)
