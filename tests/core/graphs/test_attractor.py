"""Supports: fast regions against brute force, sweeps against worklists, and witnesses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.host import attract as host_attract
from tests import reference
from tests.support import as_mdp, lane, random_representation, stack

NUM_MODELS = 1000


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
def batch(cases):
    models, goals, allowed, regions = zip(*cases, strict=True)
    return stack([as_mdp(m) for m in models]), stack(goals), stack(allowed), stack(regions)


def check_progress(model, goal, allowed, found):
    """In the region outside the goal, following the action surely can reach the goal."""
    action = np.asarray(found.action)
    region = np.asarray(found.region)
    assert allowed[np.arange(len(goal)), action][region & ~goal].all()
    step = (model.transition > 0)[np.arange(len(goal)), action]
    step[goal] = False
    reaches = (reference.closure(step) & goal).any(axis=1)
    assert reaches[region].all()


@pytest.mark.parametrize("rule", ["exists", "forall"])
def test_attractors_equal_naive_sweeps(cases, batch, rule):
    mdps, goals, allowed, _ = batch
    found = jax.jit(jax.vmap(lambda m, g, a: jl.attractor(m, g, a, rule=rule)))(
        mdps, goals, allowed
    )
    for i, (model, goal, allowed_, _) in enumerate(cases):
        expected = reference.attractor(model, goal, allowed_, rule)
        np.testing.assert_array_equal(found.region[i], expected)
        if rule == "exists":
            check_progress(model, goal, allowed_, lane(found, i))


def test_avoidable_sets_equal_memoryless_policies(cases, batch):
    mdps, goals, *_ = batch
    found = jax.jit(jax.vmap(jl.avoidable))(mdps, goals)
    for i, (model, goal, *_) in enumerate(cases):
        support = model.transition > 0
        expected = np.zeros(5, bool)
        for policy in reference.memoryless_policies(model.available):
            step = support[np.arange(5), list(policy)]
            expected |= ~(reference.closure(step) & goal).any(axis=1)
        np.testing.assert_array_equal(found[i], expected)
        np.testing.assert_array_equal(reference.avoidable(model, goal), expected)


def test_almost_sure_sets_equal_memoryless_policies(cases, batch):
    mdps, goals, allowed, _ = batch
    found = jax.jit(jax.vmap(jl.almost_surely_reaching))(mdps, goals, allowed)
    for i, (model, goal, allowed_, _) in enumerate(cases):
        region = np.asarray(found.region[i])
        np.testing.assert_array_equal(
            region, reference.almost_surely_reaching(model, goal, allowed_)
        )
        # The witness stays in the region and makes progress, so it wins almost surely.
        check_progress(model, goal, allowed_, lane(found, i))
        action = np.asarray(found.action[i])
        for s in np.flatnonzero(region & ~goal):
            assert all(region[t] for t in reference.successors(model, s, action[s]))


def test_end_components_equal_all_subsets(cases, batch):
    mdps, _, _, regions = batch
    found = jax.jit(jax.vmap(jl.end_components))(mdps, regions)
    sizes = set()
    for i, (model, _, _, region) in enumerate(cases):
        number, actions = reference.end_components(model, region)
        np.testing.assert_array_equal(found.inside[i], actions)
        np.testing.assert_array_equal(found.component[i], number)
        sizes |= set(np.bincount(number[actions.any(axis=1)]).tolist())
    assert sizes >= {1, 2, 3}, "the examples have components of several sizes"


@pytest.mark.parametrize(
    ("kind", "label_on"),
    [("sparse", None), ("dense", None), ("product", "entry"), ("product", "exit")],
)
def test_representations_hosts_and_traces_agree(kind, label_on, monkeypatch):
    """Eager sweeps, eager worklists and compiled sweeps give one answer on any model."""
    rng = np.random.default_rng(1)
    options = {"num_memory": 4, "label_on": label_on} if kind == "product" else {"num_states": 6}
    compiled = {
        rule: jax.jit(lambda m, g, a, rule=rule: jl.attractor(m, g, a, rule=rule))
        for rule in ("exists", "forall")
    }
    sure, components = jax.jit(jl.almost_surely_reaching), jax.jit(jl.end_components)
    for _ in range(6):
        model, explicit = random_representation(rng, kind, **options)
        shape = model.state_shape
        goal = reference.random_target(rng, explicit.num_states)
        allowed = explicit.available & (rng.random(explicit.available.shape) < 0.9)
        goal_, allowed_ = goal.reshape(shape), allowed.reshape(*shape, -1)
        goal_, allowed_ = jnp.asarray(goal_), jnp.asarray(allowed_)
        for rule in ("exists", "forall"):
            expected = reference.attractor(explicit, goal, allowed, rule)
            for sweeps in (48, 0):
                monkeypatch.setattr(host_attract, "SWEEPS", sweeps)
                found = jl.attractor(model, goal_, allowed_, rule=rule)
                np.testing.assert_array_equal(found.region.ravel(), expected)
                if rule == "exists":
                    flat = jax.tree.map(np.ravel, found)
                    check_progress(explicit, goal, allowed, flat)
            traced = compiled[rule](model, goal_, allowed_)
            np.testing.assert_array_equal(traced.region, found.region)
        small = kind != "product"  # brute force tries every policy and every set of states
        expected = reference.almost_surely_reaching(explicit, goal, allowed) if small else None
        for sweeps in (48, 0):
            monkeypatch.setattr(host_attract, "SWEEPS", sweeps)
            found = jl.almost_surely_reaching(model, goal_, allowed_)
            if small:
                np.testing.assert_array_equal(found.region, expected)
            check_progress(explicit, goal, allowed, jax.tree.map(np.ravel, found))
            np.testing.assert_array_equal(sure(model, goal_, allowed_).region, found.region)
            region = jnp.asarray(rng.random(shape) < 0.9)
            eager = jl.end_components(model, region)
            for field, one in zip(eager._fields, components(model, region), strict=True):
                np.testing.assert_array_equal(getattr(eager, field), one)
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
    goal = jnp.arange(length) == length - 1
    allowed = mdp.available.at[:, 1].set(False) if rule == "forall" else None
    found = jl.attractor(mdp, goal, allowed, rule=rule)
    assert found.region.all()
    assert not found.action[:-1].any(), "moving on makes progress, staying does not"
    compiled = jax.jit(lambda m, g, a: jl.attractor(m, g, a, rule=rule))(mdp, goal, allowed)
    np.testing.assert_array_equal(compiled.region, found.region)
    assert jl.avoidable(mdp, goal).tolist() == [True] * (length - 1) + [False]
    assert jl.almost_surely_reaching(mdp, goal).region.all()


def test_end_components_of_a_whole_chain_of_loops():
    mdp = long_chain(5)
    found = jl.end_components(mdp, jnp.ones(5, bool))
    assert found.component.tolist() == [0, 1, 2, 3, 4]
    assert found.inside.tolist() == [[False, True]] * 4 + [[True, True]]


def test_a_state_without_allowed_actions():
    mdp = long_chain(3)
    goal, none = jnp.array([False, False, True]), jnp.zeros((3, 2), bool)
    assert jl.attractor(mdp, goal, none).region.tolist() == [False, False, True]
    assert jl.attractor(mdp, goal, none, rule="forall").region.all(), "vacuously attracted"


def test_unknown_rule():
    with pytest.raises(ValueError, match="rule='some'; choose exists or forall"):
        jl.attractor(long_chain(2), jnp.zeros(2, bool), rule="some")
