"""Optimal and given policies for Buchi and parity tasks against enumeration of policies."""

from dataclasses import replace
from itertools import product as every

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.automata.automaton import make_automaton
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.graphs.end_components import accepting_bottom_components, accepting_end_components
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.models.product import product
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)

S, A, K, Q, L = 3, 2, 2, 2, 4
LETTERS = [[bool(n & 1), bool(n >> 1)] for n in range(L)]


def random_case(seed, label_on):
    """Sparse supports, two of the actions staying where they are, and up to four priorities."""
    rng = np.random.default_rng(seed)
    successor = rng.integers(0, S, (S, A, K))
    successor[rng.integers(S), 0] = rng.integers(S)
    weight = rng.random((S, A, K)) * (rng.random((S, A, K)) < 0.5)
    weight[..., 0] += 0.1
    world = make_mdp(
        successor,
        weight / weight.sum(-1, keepdims=True),
        initial=np.full(S, 1 / S),
        label=rng.random((S, 2)) < 0.5,
        propositions=["a", "b"],
    )
    automaton = make_automaton(
        rng.integers(0, Q, (Q, L)),
        0,
        LETTERS,
        ["a", "b"],
        priority=rng.integers(0, rng.integers(2, 5), (Q, L)),
    )
    return product(world, automaton, label_on=label_on)


def chain(model, policy):
    """Transitions `[N, N]` of a distribution over actions, and the least priority of each."""
    world, task = model.mdp, model.automaton
    letter = np.asarray(model.letter)
    matrix = np.zeros((S * Q, S * Q))
    priority = np.full((S * Q, S * Q), 99)
    for s, q, a, k in every(range(S), range(Q), range(A), range(K)):
        p = float(world.probability[s, a, k]) * policy[s, q, a]
        if p > 0:
            t = int(world.successor[s, a, k])
            read = letter[t] if model.label_on == "entry" else letter[s]
            row, column = s * Q + q, t * Q + int(task.delta[q, read])
            matrix[row, column] += p
            priority[row, column] = min(priority[row, column], int(task.priority[q, read]))
    return matrix, priority


def satisfied(model, policy):
    """The probability of acceptance from each state, by components and a linear system."""
    matrix, priority = chain(model, policy)
    n = len(matrix)
    reach = np.linalg.matrix_power((matrix > 0) + np.eye(n), n) > 0
    target = np.zeros(n, bool)
    for x in range(n):
        inside = reach[x]
        if all(reach[y, x] for y in np.flatnonzero(inside)):
            edges = priority[np.ix_(inside, inside)]
            target[x] = edges.min() % 2 == 0
    maybe = (reach @ target > 0) & ~target
    value = target.astype(float)
    rows = np.flatnonzero(maybe)
    value[rows] = np.linalg.solve(
        np.eye(len(rows)) - matrix[np.ix_(rows, rows)], matrix[rows] @ target
    )
    return value.reshape(S, Q)


def all_values(model):
    choices = every(range(A), repeat=S * Q)
    return np.stack([satisfied(model, np.eye(A)[list(c)].reshape(S, Q, A)) for c in choices])


@pytest.mark.few(2)
@pytest.mark.parametrize("label_on", ["entry", "exit"])
@pytest.mark.parametrize(
    "seed",
    [pytest.param(seed, marks=[] if seed < 5 else pytest.mark.exhaustive) for seed in range(12)],
)
def test_optima_are_those_of_the_best_memoryless_policy(seed, label_on):
    model = random_case(seed, label_on)
    values = all_values(model)
    for objective, exact in (("max", values.max(0)), ("min", values.min(0))):
        found = optimal_satisfaction(model, objective=objective, tolerance=1e-9)
        assert (found.lower <= exact + 1e-12).all() and (exact <= found.upper + 1e-12).all()
        np.testing.assert_allclose(found.value, exact, atol=2e-9)
        attained = satisfied(model, np.eye(A)[np.asarray(found.policy)])
        np.testing.assert_allclose(attained, exact, atol=2e-9)


@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_a_random_policy_is_evaluated(label_on):
    rng = np.random.default_rng(5)
    for seed in range(15):
        model = random_case(seed, label_on)
        policy = rng.random((S, Q, A)) * (rng.random((S, Q, A)) < 0.7)
        policy[..., 0] += 1e-2
        policy /= policy.sum(-1, keepdims=True)
        found = satisfaction_probability(model, policy)
        exact = satisfied(model, policy)
        np.testing.assert_allclose(found.value, exact, atol=1e-9)
        assert (found.lower <= exact + 1e-12).all() and (exact <= found.upper + 1e-12).all()
        inside = accepting_bottom_components(model, jnp.asarray(policy))
        assert (exact[np.asarray(inside)] == 1).all()


@pytest.mark.slow
def test_the_gradient_is_that_of_finite_differences():
    # From state 0 a run is caught in 1, where a holds for ever, or in 2, where it never does.
    stay = [[1, 1], [1, 1]]
    world = make_mdp(
        [[[0, 1], [0, 2]], stay, [[2, 2], [2, 2]]],
        [[[0.7, 0.3], [0.4, 0.6]], [[0.5, 0.5]] * 2, [[0.5, 0.5]] * 2],
        initial=[1, 0, 0],
        label=[[False], [True], [False]],
        propositions=["a"],
    )
    model = product(world, to_automaton("G F a"))
    logits = jnp.array([0.2, -0.4])

    def probability(logits):
        policy = jnp.broadcast_to(jax.nn.softmax(logits), (*model.state_shape, 2))
        solution = satisfaction_probability(model, policy)
        return jnp.sum(model.initial * solution.value)

    chance = jax.nn.softmax(logits) * jnp.array([0.3, 0.6])
    assert probability(logits) == pytest.approx(float(chance[0] / chance.sum()), abs=1e-12)
    forward, reverse = jax.jacfwd(probability)(logits), jax.grad(probability)(logits)
    for i in range(2):
        step = jnp.zeros(2).at[i].set(1e-5)
        difference = (probability(logits + step) - probability(logits - step)) / 2e-5
        np.testing.assert_allclose([forward[i], reverse[i]], difference, rtol=1e-6)


@pytest.mark.slow
def test_inside_jit_and_vmap():
    models = [random_case(seed, "entry") for seed in range(3)]
    plain = [replace(model.automaton, acceptance="parity", state_names=()) for model in models]
    models = [model.replace(automaton=a) for model, a in zip(models, plain, strict=True)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *models)
    solve = jax.jit(jax.vmap(lambda model: optimal_satisfaction(model, tolerance=1e-8).value))
    together = solve(stacked)
    for model, value in zip(models, together, strict=True):
        np.testing.assert_allclose(
            value, optimal_satisfaction(model, tolerance=1e-8).value, atol=2e-8
        )


def test_the_policy_visits_for_ever():
    # Two rooms, each action goes to one of them: visiting both for ever takes memory.
    world = make_mdp(
        [[[0], [1]], [[0], [1]]],
        np.ones((2, 2, 1)),
        initial=[1, 0],
        label=[[True, False], [False, True]],
        propositions=["a", "b"],
    )
    model = product(world, to_automaton("G F a & G F b", [{"a"}, {"b"}]))
    best = optimal_satisfaction(model)
    assert (best.value == 1).all() and (best.lower == 1).all()
    region = np.asarray(accepting_end_components(model).region)
    assert region.any(axis=1).all()
    rooms, state, memory = [], 0, int(model.initial_memory[0])
    for _ in range(12):
        state = int(best.policy[state, memory])
        memory = int(model.next_memory[state, memory])
        rooms.append(state)
    assert set(rooms[-6:]) == {0, 1}
    assert (optimal_satisfaction(model, objective="min").value == 0).all()


def test_an_unknown_objective_is_refused():
    with pytest.raises(ValueError, match=r"objective=.best.; choose"):
        optimal_satisfaction(random_case(0, "entry"), objective="best")
