"""Maximal end components, and bottom strongly connected components."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxltl.core.array_types import Array
from jaxltl.core.graphs.attractor import avoid
from jaxltl.core.graphs.graph import Graph, graph_of, take
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.protocols import Model
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
    model: Model, region: jax.Array, allowed: jax.Array | None = None
) -> EndComponents:
    """Maximal end components that lie within a region (de Alfaro 1997).

    An end component is a set of states with actions that never leave it and connect it. Computed on
    the host; under ``jit`` by a callback.

    Args:
      model: the model.
      region: ``bool[S]``.
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
    graph = graph_of(model, region, allowed)
    return to_jax(components_within(graph, *take(graph, (region, allowed))))


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
    graph = graph_of(model, allowed)
    return to_jax(closed_components(graph, take(graph, allowed)))


def closed_components(graph: Graph, allowed: Array) -> EndComponents:
    """:func:`bottom_components` of a graph."""
    everywhere = graph.xp.ones(graph.state_shape, bool)
    return EndComponents(*graph.components(everywhere, allowed & graph.available, closed=True))
