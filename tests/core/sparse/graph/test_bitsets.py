"""Words of bits decide what the graph of the whole product decides."""

import dataclasses

import numpy as np
import pytest

from jaxltl.core.graphs.attractor import avoid, max_sets, min_sets
from jaxltl.core.graphs.graph import host_graph
from jaxltl.core.models.mdp import support
from jaxltl.core.sparse.graph import bitsets as bits
from tests.support import random_product


def unpacked(words, num_memory):
    return (words[:, None] >> np.arange(num_memory, dtype=words.dtype) & 1).astype(bool)


def graph_of(model):
    world = model.mdp
    return bits.bit_graph(
        np.asarray(world.successor),
        support(world),
        np.asarray(world.available),
        np.asarray(model.automaton.delta),
        np.asarray(model.letter),
    )


def models(num_memory, count):
    rng = np.random.default_rng(num_memory)
    for i in range(count):
        model, _ = random_product(
            rng,
            num_states=int(rng.integers(2, 20)),
            num_actions=3,
            num_successors=2,
            num_memory=num_memory,
        )
        if i % 2:
            delta = np.maximum(np.asarray(model.automaton.delta), np.arange(num_memory)[:, None])
            model = dataclasses.replace(
                model, automaton=dataclasses.replace(model.automaton, delta=delta)
            )
        yield model, rng.random(model.state_shape) < 0.1


@pytest.mark.few(9)
@pytest.mark.parametrize("block", [3, 2**15])
@pytest.mark.parametrize("num_memory", [1, 5, 8, 9, 20, 40, 64])
def test_sets(num_memory, block, monkeypatch):
    monkeypatch.setattr(bits, "_BLOCK", block)
    for model, target in models(num_memory, 12):
        graph = host_graph(model)
        for maximize, reference in ((True, max_sets), (False, min_sets)):
            found = bits.decided(graph_of(model), bits.pack(target), num_memory, maximize=maximize)
            sets = reference(graph, target)
            one, zero = (unpacked(x, num_memory) for x in (found.one, found.zero))
            np.testing.assert_array_equal(one, sets.one)
            np.testing.assert_array_equal(zero, sets.zero)
            left = ~(one | zero)
            expected = left & avoid(graph, ~left) if maximize else np.zeros_like(left)
            np.testing.assert_array_equal(unpacked(found.stays, num_memory), expected)
            # A policy that avoids what can be avoided stays where it is.
            available = np.take_along_axis(graph.available, found.action[..., None], -1)[..., 0]
            assert available.all()
            if not maximize:
                stays = np.take_along_axis(graph.forall(zero), found.action[..., None], -1)[..., 0]
                assert stays[zero].all()


def test_deep_graphs_are_left_to_others(monkeypatch):
    monkeypatch.setattr(bits, "_SWEEPS", 0)
    model, target = next(models(5, 1))
    assert bits.decided(graph_of(model), bits.pack(target), 5, maximize=True) is None
