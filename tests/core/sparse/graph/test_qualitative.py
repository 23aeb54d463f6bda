"""Sparse graph questions give the answers of the padded ones, whatever the sizes."""

import jax
import numpy as np
import pytest

from jaxltl.core.graphs.attractor import (
    almost_surely_reaching,
    attract,
    attractor,
    avoid,
    avoidable,
    surely,
)
from jaxltl.core.graphs.end_components import (
    bottom_components,
    components_within,
    end_components,
)
from jaxltl.core.graphs.graph import host_graph
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.sparse import rows
from jaxltl.core.sparse.graph import attractor as host_attract
from jaxltl.core.sparse.graph import components
from jaxltl.core.sparse.graph import qualitative as sparse_graph
from jaxltl.core.sparse.mdp import HostMDP
from tests.core.models.test_sparse import random_padded


def models(count=60):
    rng = np.random.default_rng(0)
    for i in range(count):
        # Few successors make chains and components, many a graph that is one.
        padded = random_padded(rng, int(rng.integers(2, 40)), 1 + i % 3, 1 + i % 2)
        sparse = to_sparse(padded)
        yield rng, sparse, to_padded(sparse)


def on_rows(sparse, mask):
    """``bool[R]`` of a mask ``bool[S, A]``."""
    return np.asarray(mask)[sparse.host.state, sparse.action]


def on_host(tree):
    """In NumPy's arrays, of which a part is no program for each shape."""
    return jax.tree.map(np.asarray, tree)


@pytest.fixture(params=["python", "numpy", "scipy"])
def way(request, monkeypatch):
    """The same by each way of searching, which sizes choose."""
    monkeypatch.setattr(host_attract, "FEW", 0 if request.param == "numpy" else 1000)
    if request.param == "scipy":
        monkeypatch.setattr(rows, "SCIPY_SIZE", 0)
        monkeypatch.setattr(components, "SCIPY_SIZE", 0)


@pytest.mark.usefixtures("way")
def test_searches():
    for rng, sparse, padded in models():
        graph, host = host_graph(padded), sparse.host
        goal = rng.random(host.num_states) < 0.15
        allowed = graph.available & (rng.random(graph.available.shape) < 0.8)
        kept = on_rows(sparse, allowed)
        for mask, pairs in ((None, None), (kept, allowed)):
            found = sparse_graph.backward_reachable(host, goal, mask)
            np.testing.assert_array_equal(found, attract(graph, goal, pairs).region)
            found, stays = sparse_graph.almost_sure_reachability(host, goal, mask)
            np.testing.assert_array_equal(found, surely(graph, goal, pairs).region)
            inside = found[host.state] & ~host.support.some_successor_in(~found)
            np.testing.assert_array_equal(stays, inside if mask is None else inside & mask)
        np.testing.assert_array_equal(
            sparse_graph.positive_under_all_policies(host, goal), ~avoid(graph, goal)
        )
        among = rng.random(host.num_states) < 0.8
        for mask, joins in ((None, None), (kept, among)):
            slow = goal.copy()
            for _ in range(host.num_states):
                hit = host.support.some_successor_in(slow)
                hit = hit if mask is None else hit | ~mask
                more = host.over_choices(np.logical_and, hit)
                slow |= more if joins is None else more & joins
            np.testing.assert_array_equal(
                sparse_graph.positive_under_all_policies(host, goal, mask, joins), slow
            )


def naive_end_components(host, kept):
    """Rows are removed that leave the component of their state, until none does."""
    kept = kept.copy()
    while True:
        edge = np.eye(host.num_states, dtype=bool)
        used = kept[host.row]
        edge[host.state[host.row[used]], host.successor[used]] = True
        for _ in range(host.num_states.bit_length()):
            edge = edge @ edge
        label = (edge & edge.T).argmax(1)
        leaves = np.zeros(host.num_rows, bool)
        leaves[host.row[label[host.successor] != label[host.state[host.row]]]] = True
        if not (kept & leaves).any():
            return np.where(host.first_choice(kept)[0], label, np.arange(host.num_states)), kept
        kept &= ~leaves


@pytest.mark.usefixtures("way")
def test_end_components():
    some = 0
    for rng, sparse, padded in models():
        graph, host = host_graph(padded), sparse.host
        states = rng.random(host.num_states) < 0.9
        allowed = graph.available & (rng.random(graph.available.shape) < 0.8)
        theirs = components_within(graph, states, allowed)
        rows_ = on_rows(sparse, allowed)
        ours = sparse_graph.end_components(host, states, rows_)
        component, inside = naive_end_components(host, rows_ & states[host.state])
        np.testing.assert_array_equal(ours.component, component)
        np.testing.assert_array_equal(ours.inside, inside)
        np.testing.assert_array_equal(ours.component, theirs.component)
        np.testing.assert_array_equal(ours.inside, on_rows(sparse, theirs.inside))
        np.testing.assert_array_equal(ours.region(host), np.asarray(theirs.inside).any(-1))
        some += ours.inside.any()
    assert some > 10


def test_what_stands_still_holds_nothing_together(monkeypatch):
    """Along a walk that one may stop at any time, states are not taken away one round each."""
    size, rounds = 60, []
    entry, target = [0], []
    for s in range(size):
        moves = [[s]] if s in (0, size - 1) else [[s], [s - 1, s + 1]]
        for row in moves:
            target += row
            entry.append(len(target))
    row_start = np.concatenate([[0], 1 + 2 * np.arange(size - 1), [2 * size - 2]])
    host = HostMDP(
        row_start,
        np.array(entry),
        np.array(target, np.int32),
        np.where(np.repeat(np.diff(entry), np.diff(entry)) == 1, 1.0, 0.5),
    )
    labels = sparse_graph._labels
    monkeypatch.setattr(sparse_graph, "_labels", lambda *x: rounds.append(0) or labels(*x))
    inner = np.ones(size, bool)
    inner[[0, -1]] = False
    found = sparse_graph.end_components(host, inner)
    assert len(rounds) <= 1
    np.testing.assert_array_equal(found.component, np.arange(size))
    np.testing.assert_array_equal(
        found.inside, inner[host.state] & (np.diff(host.entry_start) == 1)
    )


def test_attractors_of_rows_are_those_of_actions():
    for rng, sparse, padded in models():
        host = sparse.host
        goal = rng.random(host.num_states) < 0.2
        among, rule = (rng.random(host.num_states) < 0.8 for _ in range(2))
        allowed = np.asarray(padded.available) & (rng.random(padded.available.shape) < 0.8)
        for chance in ("some", "all"):
            asked = {"rule": rule, "chance": chance, "among": among}
            ours = on_host(attractor(sparse, goal, on_rows(sparse, allowed), **asked))
            theirs = on_host(attractor(padded, goal, allowed, **asked))
            np.testing.assert_array_equal(ours.region, theirs.region)
            joined = ours.region
            np.testing.assert_array_equal(ours.rank[joined], theirs.rank[joined])
            moves = joined & ~goal & (rule | allowed.any(-1))
            np.testing.assert_array_equal(
                np.asarray(sparse.action)[ours.action][moves], theirs.action[moves]
            )
        np.testing.assert_array_equal(avoidable(sparse, goal), avoidable(padded, goal))
        np.testing.assert_array_equal(
            almost_surely_reaching(sparse, goal).region, almost_surely_reaching(padded, goal).region
        )
        mine, other = (on_host(end_components(m, goal)) for m in (sparse, padded))
        np.testing.assert_array_equal(mine.component, other.component)
        np.testing.assert_array_equal(mine.inside, on_rows(sparse, other.inside))
        mine, other = on_host(
            (
                bottom_components(sparse, on_rows(sparse, allowed)),
                bottom_components(padded, allowed),
            )
        )
        np.testing.assert_array_equal(mine.component, other.component)
        np.testing.assert_array_equal(mine.inside, on_rows(sparse, other.inside))
