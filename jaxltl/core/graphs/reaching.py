"""Where the probability of reaching a set is exactly 0 or 1: of a policy, largest and smallest."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.graphs.attractor import attract, avoid, surely
from jaxltl.core.graphs.graph import Graph


class Sets(NamedTuple):
    """What the graph decides: probability one, probability zero, and witnessing actions."""

    one: Any
    zero: Any
    action: Any


def policy_sets(graph: Graph, target: Any, policy: Any) -> Sets:
    """What a policy's support decides."""
    allowed = graph.available & (policy > 0)
    zero = ~attract(graph, target, allowed).region
    doomed = attract(graph, zero, allowed, among=~target).region
    return Sets(~doomed, zero, graph.xp.zeros(target.shape, np.int32))


def max_sets(graph: Graph, target: Any) -> Sets:
    """Where the largest probability is 1 or 0, with actions that attain it."""
    some = attract(graph, target)
    sure = surely(graph, target, reaching=some)
    action = graph.xp.where(sure.region, sure.action, some.action)
    return Sets(sure.region, ~some.region, action)


def min_sets(graph: Graph, target: Any) -> Sets:
    """Where the smallest probability is 1 or 0, with actions that attain it."""
    zero = avoid(graph, target)
    doomed = attract(graph, zero, among=~target).region
    stays, action = graph.first(graph.available & graph.forall(zero))
    first = graph.first(graph.available)[1]
    return Sets(~doomed, zero, graph.xp.where(stays, action, first))
