"""Supports: the host's regions against brute force, sweeps against worklists, and witnesses."""

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.sparse.graph import attractor as host_attract
from tests import reference
from tests.support import as_mdp, random_representation

NUM_MODELS = 300


def random_case(rng):
    model = reference.random_model(rng, 5, 2, 2)
    goal = reference.random_target(rng, 5)
    allowed = model.available & (rng.random(model.available.shape) < 0.8)
    region = rng.random(5) < 0.8
    return model, goal, allowed, region


@pytest.fixture(scope="module")
def cases():
    rng = np.random.default_rng(0)
    return [random_case(rng) for _ in range(NUM_MODELS)]


@pytest.fixture(scope="module")
def mdps(cases):
    return [as_mdp(model) for model, *_ in cases]


def check_progress(model, goal, allowed, found):
    """In the region outside the goal, following the action surely can reach the goal."""
    action = np.asarray(found.action)
    region = np.asarray(found.region)
    assert allowed[np.arange(len(goal)), action][region & ~goal].all()
    step = (model.transition > 0)[np.arange(len(goal)), action]
    step[goal] = False
    reaches = (reference.closure(step) & goal).any(axis=1)
    assert reaches[region].all()


@pytest.mark.few(1)
@pytest.mark.parametrize("rule", ["exists", "forall"])
def test_attractors_equal_naive_sweeps(cases, mdps, rule):
    for mdp, (model, goal, allowed, _) in zip(mdps, cases, strict=True):
        found = jl.graphs.attractor(mdp, goal, allowed, rule=rule)
        expected = reference.attractor(model, goal, allowed, rule)
        np.testing.assert_array_equal(found.region, expected)
        if rule == "exists":
            check_progress(model, goal, allowed, found)


def test_avoidable_sets_equal_memoryless_policies(cases, mdps):
    for mdp, (model, goal, *_) in zip(mdps, cases, strict=True):
        found = jl.graphs.avoidable(mdp, goal)
        support = model.transition > 0
        expected = np.zeros(5, bool)
        for policy in reference.memoryless_policies(model.available):
            step = support[np.arange(5), list(policy)]
            expected |= ~(reference.closure(step) & goal).any(axis=1)
        np.testing.assert_array_equal(found, expected)
        np.testing.assert_array_equal(reference.avoidable(model, goal), expected)


def test_almost_sure_sets_equal_memoryless_policies(cases, mdps):
    for mdp, (model, goal, allowed, _) in zip(mdps, cases, strict=True):
        found = jl.graphs.almost_surely_reaching(mdp, goal, allowed)
        region = np.asarray(found.region)
        np.testing.assert_array_equal(
            region, reference.almost_surely_reaching(model, goal, allowed)
        )
        # The witness stays in the region and makes progress, so it wins almost surely.
        check_progress(model, goal, allowed, found)
        action = np.asarray(found.action)
        for s in np.flatnonzero(region & ~goal):
            assert all(region[t] for t in reference.successors(model, s, action[s]))


def test_end_components_equal_all_subsets(cases, mdps):
    sizes = set()
    for mdp, (model, _, _, region) in zip(mdps, cases, strict=True):
        found = jl.graphs.end_components(mdp, region)
        number, actions = reference.end_components(model, region)
        np.testing.assert_array_equal(found.inside, actions)
        np.testing.assert_array_equal(found.component, number)
        sizes |= set(np.bincount(number[actions.any(axis=1)]).tolist())
    assert sizes >= {1, 2, 3}, "the examples have components of several sizes"


@pytest.mark.parametrize(
    ("kind", "label_on"),
    [("sparse", None), ("dense", None), ("product", "entry"), ("product", "exit")],
)
def test_representations_agree(kind, label_on, monkeypatch):
    """Plain loops and array operations give one answer on any model."""
    rng = np.random.default_rng(1)
    options = {"num_memory": 4, "label_on": label_on} if kind == "product" else {"num_states": 6}
    for _ in range(6):
        model, explicit = random_representation(rng, kind, **options)
        shape = model.state_shape
        goal = reference.random_target(rng, explicit.num_states)
        allowed = explicit.available & (rng.random(explicit.available.shape) < 0.9)
        goal_, allowed_ = goal.reshape(shape), allowed.reshape(*shape, -1)
        for rule in ("exists", "forall"):
            expected = reference.attractor(explicit, goal, allowed, rule)
            for few in (24, 0):
                monkeypatch.setattr(host_attract, "FEW", few)
                found = jl.graphs.attractor(model, goal_, allowed_, rule=rule)
                np.testing.assert_array_equal(found.region.ravel(), expected)
                if rule == "exists":
                    flat = jax.tree.map(np.ravel, found)
                    check_progress(explicit, goal, allowed, flat)
        small = kind != "product"  # brute force tries every policy and every set of states
        expected = reference.almost_surely_reaching(explicit, goal, allowed) if small else None
        for few in (24, 0):
            monkeypatch.setattr(host_attract, "FEW", few)
            found = jl.graphs.almost_surely_reaching(model, goal_, allowed_)
            if small:
                np.testing.assert_array_equal(found.region, expected)
            check_progress(explicit, goal, allowed, jax.tree.map(np.ravel, found))
            region = rng.random(shape) < 0.9
            eager = jl.graphs.end_components(model, region)
            if small:
                number, actions = reference.end_components(explicit, np.ravel(region))
                np.testing.assert_array_equal(eager.component.ravel(), number)
                np.testing.assert_array_equal(eager.inside.reshape(actions.shape), actions)


def long_chain(length):
    """A corridor whose states move on or stay; deeper than the sweeps reach."""
    states = np.arange(length)
    successor = np.stack([np.minimum(states + 1, length - 1), states], axis=1)[:, :, None]
    return jl.make_mdp(successor, np.ones((length, 2, 1)))


@pytest.mark.parametrize("rule", ["exists", "forall"])
def test_a_long_chain_is_finished_on_the_host(rule):
    length = 1024
    mdp = long_chain(length)
    goal = np.arange(length) == length - 1
    allowed = np.array([True, False]) & np.ones((length, 2), bool) if rule == "forall" else None
    found = jl.graphs.attractor(mdp, goal, allowed, rule=rule)
    assert found.region.all()
    assert not found.action[:-1].any(), "moving on makes progress, staying does not"
    assert found.rank.tolist() == list(range(length - 1, -1, -1))
    assert jl.graphs.avoidable(mdp, goal).tolist() == [True] * (length - 1) + [False]
    assert jl.graphs.almost_surely_reaching(mdp, goal).region.all()


def test_end_components_of_a_whole_chain_of_loops():
    mdp = long_chain(5)
    found = jl.graphs.end_components(mdp, np.ones(5, bool))
    assert found.component.tolist() == [0, 1, 2, 3, 4]
    assert found.inside.tolist() == [[False, True]] * 4 + [[True, True]]


def test_a_state_without_allowed_actions():
    mdp = long_chain(3)
    goal, none = np.array([False, False, True]), np.zeros((3, 2), bool)
    assert jl.graphs.attractor(mdp, goal, none).region.tolist() == [False, False, True]
    assert jl.graphs.attractor(mdp, goal, none, rule="forall").region.all(), "vacuously attracted"


def test_unknown_rule():
    with pytest.raises(ValueError, match="rule='some'; choose"):
        jl.graphs.attractor(long_chain(2), np.zeros(2, bool), rule="some")
