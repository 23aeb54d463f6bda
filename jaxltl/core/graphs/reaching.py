"""Qualitative reachability: prob0 and prob1 states of a policy, a maximum and a minimum."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Array
from jaxltl.core.graphs.attractor import attract, avoid, surely
from jaxltl.core.graphs.graph import Graph


class Sets(NamedTuple):
    """Prob1 states, prob0 states, and a policy that attains these probabilities."""

    one: Any  # arrays of the graph's namespace
    zero: Any
    action: Any


def policy_sets(graph: Graph, target: Array, policy: Array) -> Sets:
    """Prob0 and prob1 states of a policy, from its support."""
    allowed = graph.available & (policy > 0)
    zero = ~attract(graph, target, allowed).region
    doomed = attract(graph, zero, allowed, among=~target).region
    return Sets(~doomed, zero, graph.xp.zeros(target.shape, np.int32))


def max_sets(graph: Graph, target: Array) -> Sets:
    """Prob0 and prob1 states of the maximal probability, with a policy that attains it."""
    some = attract(graph, target)
    sure = surely(graph, target, reaching=some)
    action = graph.xp.where(sure.region, sure.action, some.action)
    return Sets(sure.region, ~some.region, action)


def min_sets(graph: Graph, target: Array) -> Sets:
    """Prob0 and prob1 states of the minimal probability, with a policy that attains it."""
    zero = avoid(graph, target)
    doomed = attract(graph, zero, among=~target).region
    stays, action = graph.first(graph.available & graph.forall(zero))
    first = graph.first(graph.available)[1]
    return Sets(~doomed, zero, graph.xp.where(stays, action, first))
