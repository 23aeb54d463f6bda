"""One part of the automaton after the other: the same bounds as of the whole product."""

import dataclasses

import jax
import numpy as np
import pytest

from jaxltl.core.models.construct.restrict import with_allowed
from jaxltl.core.models.ops.operators import transition_matrix
from jaxltl.core.sparse.solvers import layered_reachability as layers
from jaxltl.core.values.undiscounted import reaching
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from tests.support import random_product

MAX_PROGRAMS = 450  # that the default tests compile at most


def cases(count, seed, num_memory=4):
    rng = np.random.default_rng(seed)
    for i in range(count):
        model, _ = random_product(
            rng,
            num_states=(5, 14)[i % 2],
            num_actions=3,
            num_successors=3,
            num_memory=num_memory,
        )
        if i % 3:  # often all components are single states, as in tasks that end
            delta = np.maximum(np.asarray(model.automaton.delta), np.arange(num_memory)[:, None])
            model = dataclasses.replace(
                model, automaton=dataclasses.replace(model.automaton, delta=delta)
            )
        target = np.asarray(model.final)
        if i % 2:
            target = rng.random(target.shape) < 0.2
        if i % 5 == 4:
            available = np.asarray(model.available)
            allowed = available & (rng.random(available.shape) < 0.7)
            allowed = np.where(allowed.any(-1, keepdims=True), allowed, available)
            model = with_allowed(model, allowed)
        yield model, target


def attained(model, target, policy):
    """The probability of a policy, by squaring its chain."""
    weights = np.eye(3)[np.asarray(policy)]
    chain = np.asarray(transition_matrix(model, weights), float).reshape(target.size, -1)
    goal = target.ravel()
    chain = np.where(goal[:, None], np.eye(goal.size), chain)
    for _ in range(34):
        chain = chain @ chain
        chain /= chain.sum(1, keepdims=True)
    return (chain @ goal).reshape(target.shape)


def check(model, target, objective, monkeypatch, tolerance):
    other = reachability_probability(model, target, objective=objective)
    with monkeypatch.context() as patch:
        patch.setattr(reaching, "QUICK_LIMIT", 0)
        patch.setattr(layers, "_MET", 0)
        ours = reaching._by_layers(model, target, tolerance, objective)
    if ours is None:
        return False
    eps = np.finfo(np.asarray(ours.lower).dtype).eps
    assert ours.status == 0
    assert (ours.lower <= other.upper + 4 * eps).all()
    assert (other.lower <= ours.upper + 4 * eps).all()
    for bound in (0, 1):  # exact where the graph says so, and nowhere else
        np.testing.assert_array_equal(
            (np.asarray(ours.lower) == bound) & (np.asarray(ours.upper) == bound),
            (np.asarray(other.lower) == bound) & (np.asarray(other.upper) == bound),
        )
    goal = np.sqrt(eps) if tolerance is None else tolerance
    assert (np.asarray(ours.upper) - np.asarray(ours.lower)).max() <= 2 * goal
    assert ((ours.lower <= ours.value) & (ours.value <= ours.upper)).all()
    found = attained(model, target, ours.policy)
    slack = 1e-7 + 4 * eps
    if objective == "max":
        assert (found >= ours.lower - slack).all()
    else:
        assert (found <= ours.upper + slack).all()
    return True


@pytest.mark.few(1, 1)
@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("objective", ["max", "min"])
@pytest.mark.parametrize("count", [20, pytest.param(5000, marks=pytest.mark.exhaustive)])
def test_bounds_and_policies(objective, single, count, monkeypatch):
    with jax.enable_x64(not single):
        done = [
            check(*case, objective, monkeypatch, 1e-5 if single else 1e-8)
            for case in cases(count, 5)
        ]
    assert np.mean(done) > 0.8


def test_as_closely_as_the_numbers_allow(monkeypatch):
    with jax.enable_x64(True):
        done = [check(*case, "max", monkeypatch, None) for case in cases(30, 6)]
    assert np.mean(done) > 0.8
    model, target = next(cases(1, 6))
    with monkeypatch.context() as patch:
        patch.setattr(reaching, "QUICK_LIMIT", 0)
        assert reaching._by_layers(model, target, 1e-3, "max") is None  # so small a world
        patch.setattr(layers, "_MET", 0)
        assert reaching._by_layers(model, target, 0.0, "max") is None
