"""Probabilities of reaching and satisfying, against exact rational solutions."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl import Status
from jaxltl.core.values.engine.certificates import rounding_unit
from tests import reference
from tests.support import (
    as_mdp,
    assert_encloses,
    random_product,
    stack,
)

NUM_MODELS = 150
DEFAULT = float(np.sqrt(np.finfo(float).eps))


def random_case(rng):
    """A model in which state 0 is a trap, several targets or none, and a policy."""
    model = reference.random_model(rng, 6, 2, 3, rng.choice([0.1, 0.5]))
    model.successor[0] = 0
    target = reference.random_target(rng, 6)
    target[0] = False
    return model, target, reference.random_policy(rng, model)


@pytest.fixture(scope="module")
def cases():
    rng = np.random.default_rng(0)
    return [random_case(rng) for _ in range(NUM_MODELS)]


@pytest.fixture(scope="module")
def exact(cases):
    """Exact values: maximal, minimal, and of the policy."""
    return {
        "max": [reference.exact_optimal_reachability(m, t, "max") for m, t, _ in cases],
        "min": [reference.exact_optimal_reachability(m, t, "min") for m, t, _ in cases],
        "policy": [reference.exact_policy_reachability(m, p, t) for m, t, p in cases],
    }


def batch_of(cases):
    models, targets, policies = zip(*cases, strict=True)
    return stack([as_mdp(m) for m in models]), stack(targets), stack(policies)


def assert_exact_where_the_graph_decides(solution, exact):
    """Zeros and ones are exact, and nothing else is called so."""
    decided = np.vectorize(lambda x: x in (0, 1))(exact)
    for field in ("value", "lower", "upper"):
        found = np.asarray(getattr(solution, field), float)
        np.testing.assert_array_equal(found[decided], exact[decided].astype(float))
    value = np.asarray(solution.value)
    assert ((value > 0) & (value < 1))[~decided].all()


def assert_certified(solution, exact, tolerance=DEFAULT):
    exact = np.stack(exact)
    assert (solution.status == Status.CONVERGED).all()
    assert_encloses(solution, exact)
    assert_exact_where_the_graph_decides(solution, exact)
    assert (solution.upper - solution.lower).max() <= 2 * tolerance


def assert_attained(cases, solution, objective, count):
    """The returned policy, evaluated exactly, is within the bound on its safe side."""
    for i in range(count):
        model, target, *_ = cases[i]
        policy = np.asarray(solution.policy[i]).ravel()
        assert model.available[np.arange(len(policy)), policy].all()
        value = reference.exact_policy_reachability(model, policy, target)
        if objective == "max":
            assert (value >= reference.FRACTION(np.ravel(solution.lower[i]))).all()
        else:
            assert (value <= reference.FRACTION(np.ravel(solution.upper[i]))).all()


def assert_finest(cases, exact, solution, unit):
    """Half as wide as a few roundings of each step that the policy is expected to make."""
    for i, ((model, *_), value) in enumerate(zip(cases, exact, strict=True)):
        undecided = np.array([0 < x < 1 for x in value])
        policy = np.asarray(solution.policy[i])
        moves = model.transition[np.arange(len(policy)), policy][np.ix_(undecided, undecided)]
        steps = np.linalg.solve(np.eye(len(moves)) - moves, np.ones(len(moves)))
        half = (solution.upper[i] - solution.lower[i]).max() / 2
        assert half <= 4 * unit * steps.max(initial=0)


def test_the_examples_are_not_trivial(cases, exact):
    inner = sum(any(0 < x < 1 for x in value) for value in exact["max"])
    collapsing = sum(
        reference.end_components(m, np.array([0 < x < 1 for x in value]))[1].any()
        for (m, _, _), value in zip(cases, exact["max"], strict=False)
    )
    several = sum(t.sum() > 1 for _, t, _ in cases)
    assert inner > 40
    assert collapsing > 4
    assert several > 40


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("objective", "tolerance"),
    [
        ("max", None),
        ("min", None),
        ("max", 1e-12),
        pytest.param("min", 1e-12, marks=pytest.mark.exhaustive),
    ],
)
def test_optima_are_enclosed_and_attained(cases, exact, objective, tolerance):
    mdps, targets, _ = batch_of(cases)
    solution = jax.jit(
        jax.vmap(
            lambda m, t: jl.reachability_probability(m, t, objective=objective, tolerance=tolerance)
        )
    )(mdps, targets)
    assert_certified(solution, exact[objective], tolerance or DEFAULT)
    assert_attained(cases, solution, objective, NUM_MODELS)
    if tolerance is None:
        assert_finest(cases, exact[objective], solution, rounding_unit(mdps))


@pytest.mark.parametrize("tolerance", [None, 1e-12])
def test_policies_are_enclosed(cases, exact, tolerance):
    solution = jax.jit(
        jax.vmap(lambda m, t, p: jl.reachability_probability(m, t, policy=p, tolerance=tolerance))
    )(*batch_of(cases))
    assert_certified(solution, exact["policy"], tolerance or DEFAULT)


@pytest.mark.slow
def test_enclosures_in_single_precision(cases, exact):
    few = cases
    tolerance = float(np.sqrt(np.finfo(np.float32).eps))
    with jax.enable_x64(False):
        mdps, targets, policies = batch_of(few)
        for objective in ("max", "min"):
            solution = jax.jit(
                jax.vmap(lambda m, t, o=objective: jl.reachability_probability(m, t, objective=o))
            )(mdps, targets)
            assert solution.value.dtype == jnp.float32
            assert_certified(solution, exact[objective], tolerance)
            assert_finest(few, exact[objective], solution, rounding_unit(mdps))
            assert_attained(few, solution, objective, NUM_MODELS)
        solution = jax.jit(jax.vmap(lambda m, t, p: jl.reachability_probability(m, t, policy=p)))(
            mdps, targets, policies
        )
        assert_certified(solution, exact["policy"], tolerance)


# --- satisfaction of a task --------------------------------------------------------------------


def exact_satisfaction(lazy, explicit, policy):
    """Exact values of a policy (None: the best one) by the definition of the acceptance."""
    final = np.asarray(lazy.final).ravel()
    cosafe = lazy.automaton.acceptance == "cosafe"
    target = final if cosafe else ~final
    if policy is None:
        value = reference.exact_optimal_reachability(explicit, target, "max" if cosafe else "min")
    else:
        value = reference.exact_policy_reachability(explicit, policy, target)
    return value if cosafe else 1 - value


@pytest.mark.slow
@pytest.mark.parametrize(
    ("acceptance", "label_on", "count"),
    [
        ("cosafe", "entry", 150),
        ("safety", "exit", 150),
        pytest.param("cosafe", "exit", 500, marks=pytest.mark.exhaustive),
        pytest.param("safety", "entry", 500, marks=pytest.mark.exhaustive),
    ],
)
def test_satisfaction_is_enclosed_and_attained(acceptance, label_on, count):
    rng = np.random.default_rng(1)
    some = [random_product(rng, acceptance=acceptance, label_on=label_on) for _ in range(count)]
    policies = [reference.random_policy(rng, explicit) for _, explicit in some]
    lazy = stack([p for p, _ in some])
    shape = (3, 3, 2)
    batch = jnp.asarray(np.stack(policies).reshape(-1, *shape))
    solution = jax.jit(jax.vmap(jl.satisfaction_probability))(lazy, batch)
    exact = [
        exact_satisfaction(*pair, p).reshape(3, 3) for pair, p in zip(some, policies, strict=True)
    ]
    assert_certified(solution, exact)

    solution = jax.jit(jax.vmap(jl.optimal_satisfaction))(lazy)
    assert_certified(solution, [exact_satisfaction(*pair, None).reshape(3, 3) for pair in some])
    for i, (one, explicit) in enumerate(some):
        policy = np.asarray(solution.policy[i]).ravel()
        attained = exact_satisfaction(one, explicit, policy)
        assert (attained >= reference.FRACTION(np.ravel(solution.lower[i]))).all()


# --- near-deterministic loops ------------------------------------------------------------------


def loops(length, escape):
    """A chain of states that stay with probability 1 - escape, else move on or fail, evenly."""
    goal, fail = length, length + 1
    states = np.arange(length)
    successor = np.zeros((length + 2, 1, 3), int)
    probability = np.zeros((length + 2, 1, 3))
    successor[:length, 0] = np.stack([states, states + 1, np.full(length, fail)], axis=1)
    probability[:length, 0] = [1 - escape, escape / 2, escape / 2]
    successor[length:, 0] = [[goal] * 3, [fail] * 3]
    probability[length:, 0] = [1.0, 0, 0]
    return jl.make_mdp(successor, probability), np.arange(length + 2) == goal


@pytest.mark.parametrize(
    ("escape", "dtype"), [(2.0**-30, "float64"), (1e-9, "float64"), (2.0**-18, "float32")]
)
@pytest.mark.parametrize("objective", ["max", "min", "policy"])
def test_loops_that_hardly_end_are_enclosed_or_refused(objective, escape, dtype):
    """The truth is a power of a half, whatever the escape; a wrong answer is never certified."""
    with jax.enable_x64(dtype == "float64"):
        mdp, target = loops(10, escape)
        if objective == "policy":
            solution = jl.reachability_probability(mdp, target, policy=jnp.zeros(12, int))
        else:
            solution = jl.reachability_probability(mdp, target, objective=objective, max_steps=2000)
        exact = [Fraction(1, 2 ** (10 - i)) for i in range(10)] + [Fraction(1), Fraction(0)]
        if escape != 1e-9:  # that row cannot be stored exactly, and then the truth is another
            assert_encloses(solution, np.array(exact, object))
        if solution.status == Status.CONVERGED:
            np.testing.assert_allclose(solution.value, [float(x) for x in exact], atol=1e-3)
            width = solution.upper - solution.lower
            assert width.max() <= 2 * np.sqrt(jnp.finfo(dtype).eps)
        else:
            limit = Status.PRECISION if objective == "policy" else Status.MAX_STEPS
            assert solution.status == limit


def test_a_slow_loop_is_solved_for_a_policy():
    mdp, target = loops(10, 2.0**-30)
    solution = jl.reachability_probability(mdp, target, policy=jnp.zeros(12, int), tolerance=1e-4)
    assert solution.status == Status.CONVERGED
    np.testing.assert_allclose(solution.value[:3], [2**-10, 2**-9, 2**-8], rtol=1e-4)


# --- the rest ----------------------------------------------------------------------------------


def test_end_components_do_not_feign_certainty():
    """Two states that may pass to each other for ever: staying is worth nothing."""
    successor = [[[1, 1], [2, 3]], [[0, 0], [1, 1]], [[2, 2], [2, 2]], [[3, 3], [3, 3]]]
    probability = [[[1.0, 0], [0.5, 0.5]], [[1.0, 0], [1.0, 0]], *[[[1.0, 0], [1.0, 0]]] * 2]
    mdp = jl.make_mdp(successor, probability)
    target = np.array([False, False, True, False])
    best = jl.check(jl.reachability_probability(mdp, target))
    np.testing.assert_allclose(best.value, [0.5, 0.5, 1, 0], atol=1e-7)
    assert best.policy[0] == 1
    assert best.policy[1] == 0
    worst = jl.check(jl.reachability_probability(mdp, target, objective="min"))
    assert worst.value.tolist() == [0, 0, 1, 0]


def test_empty_and_full_targets(cases):
    mdp = as_mdp(cases[0][0])
    for objective in ("max", "min"):
        for full in (False, True):
            solution = jl.reachability_probability(mdp, np.full(6, full), objective=objective)
            assert solution.value.tolist() == [float(full)] * 6
            assert solution.status == Status.CONVERGED


def test_a_world_too_large_for_elimination():
    """A walk down with probability 3/4 and up with 1/4, between 0 and a trap N at the top.

    From i the trap is reached first with probability ``(3^i - 1) / (3^N - 1)`` (gambler's ruin).
    """
    top = 1500
    states = np.arange(top + 1)
    successor = np.stack([np.maximum(states - 1, 0), states + 1], axis=-1)[:, None, :]
    successor[top] = top
    mdp = jl.make_mdp(successor, np.broadcast_to([0.75, 0.25], successor.shape))
    for target, flip in ((states == top, False), (states == 0, True)):
        # State 0 is left again on the way to the trap, unless it is the target.
        stopped = mdp.replace(successor=mdp.successor.at[0].set(0))
        solution = jl.reachability_probability(stopped, target, policy=jnp.zeros(top + 1, int))
        assert solution.status == Status.CONVERGED
        lower, upper = np.asarray(solution.lower), np.asarray(solution.upper)
        for i in range(0, top + 1, 50):
            exact = Fraction(3**i - 1, 3**top - 1)
            exact = 1 - exact if flip else exact
            assert Fraction(float(lower[i])) <= exact <= Fraction(float(upper[i]))


def test_errors_name_the_argument(cases):
    mdp = as_mdp(cases[0][0])
    with pytest.raises(ValueError, match=r"target has shape \(5,\); expected \(6,\)"):
        jl.reachability_probability(mdp, np.zeros(5, bool))
    with pytest.raises(ValueError, match=r"of state numbers, np.isin\(np.arange\(6\), \[3\]\)"):
        jl.reachability_probability(mdp, [3])
    with pytest.raises(ValueError, match="objective='best'; choose"):
        jl.reachability_probability(mdp, np.zeros(6, bool), objective="best")
    with pytest.raises(ValueError, match=r"policy has shape \(2,\)"):
        jl.reachability_probability(mdp, np.zeros(6, bool), policy=jnp.zeros(2, int))


@pytest.mark.parametrize("option", [{"max_steps": 3}, {"start": (0.0, 1.0)}])
def test_options_of_interval_iteration_are_refused_where_it_is_not_used(option):
    coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1], label={"heads": [1]})
    heads = coin.states_with_label("heads")
    padded = jl.to_padded(coin)
    for ask in (
        lambda: jl.reachability_probability(coin, heads, **option),
        lambda: jl.reachability_probability(padded, heads, stay=~heads, **option),
        lambda: jl.optimal_satisfaction(jl.product(coin, "F heads"), **option),
        lambda: jl.optimal_satisfaction(coin, "F heads", **option),
    ):
        with pytest.raises(ValueError, match=r"max_steps|start"):
            ask()
