"""Components and searches against the closure of the edges, in plain Python and by SciPy."""

import numpy as np
import pytest

from jaxltl.core.sparse.graph import components
from jaxltl.core.sparse.graph.components import forward_reachable, strong_components


@pytest.mark.parametrize("large", [-1, 10**9])
def test_components_and_searches_equal_the_closure(large, monkeypatch):
    monkeypatch.setattr(components, "SCIPY_SIZE", large)
    monkeypatch.setattr(components, "_READY", large)
    rng = np.random.default_rng(0)
    sizes = set()
    for _ in range(200):
        num_nodes = int(rng.integers(1, 9))
        source, target = rng.integers(num_nodes, size=(2, int(rng.integers(0, 2 * num_nodes))))
        source, target = (np.concatenate([x, x[:3]]) for x in (source, target))  # some twice
        reach = np.eye(num_nodes, dtype=bool)
        reach[source, target] = True
        for _ in range(num_nodes):
            reach = reach @ reach
        both = reach & reach.T
        found = strong_components(source, target, num_nodes)
        np.testing.assert_array_equal(found, both.argmax(1))
        sizes |= set(both.sum(1).tolist())
        start = rng.random(num_nodes) < 0.3
        np.testing.assert_array_equal(forward_reachable(source, target, start), reach[start].any(0))
    assert sizes >= {1, 2, 3, 4}


def test_no_nodes():
    none = np.zeros(0, int)
    assert strong_components(none, none, 0).tolist() == []


def test_a_long_circle_needs_no_recursion():
    node = np.arange(20_000)
    assert not strong_components(node, np.roll(node, 1), node.size).any()
    assert strong_components(node[:-1], node[1:], node.size).tolist() == node.tolist()
