"""How well a policy does a task, against exact rational solutions, alone and in batches."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl import Status
from jaxltl.core.automata.automaton import make_automaton
from jaxltl.core.models.construct.batch import stack_products, unstack_product
from jaxltl.core.types import Solution
from jaxltl.core.values.undiscounted import performance as tp
from tests import reference
from tests.algos.test_guaranteed import A, evaluate, random_automaton, random_world
from tests.support import as_mdp, assert_encloses, bit_labels, counted_traces, lane, stack

NUM_MODELS = 60


@cache
def cases(acceptance, label_on):
    """Products with two traps, policies, and the exact probability of the task from each start."""
    rng = np.random.default_rng(0)
    models, policies, exact = [], [], []
    while len(models) < NUM_MODELS:
        world_model = reference.random_model(rng, 4, 2, 3, 0.3)
        world_model.successor[:2] = np.arange(2)[:, None, None]
        letter = rng.permutation(4)
        delta, final = reference.random_acceptor(rng, 3, 4, acceptance)
        automaton = make_automaton(
            delta, 0, bit_labels(np.arange(4), 2), ("a", "b"), final=final, acceptance=acceptance
        )
        mdp = as_mdp(world_model, label=bit_labels(letter, 2), propositions=("a", "b"))
        lazy = jl.product(mdp, automaton, label_on=label_on)
        model = reference.explicit_product(world_model, delta, 0, letter, label_on)
        policy = reference.random_policy(rng, model)
        target = np.tile(final if acceptance == "cosafe" else ~final, 4)
        value = reference.exact_policy_reachability(model, policy, target)
        value = np.array(value if acceptance == "cosafe" else 1 - np.array(value))
        value = value[np.arange(4) * 3 + np.asarray(lazy.initial_memory)]
        if set(value.tolist()) <= {0, 1} and rng.random() < 0.8:
            continue
        models.append(lazy)
        policies.append(policy.reshape(4, 3, -1))
        exact.append(value)
    return stack(models), jnp.asarray(np.stack(policies)), exact


def enclosure(lower, upper):
    return Solution(*[None] * 2, lower, upper, *[None] * 3)


def assert_correct(found, models, exact):
    starts = np.asarray(models.mdp.initial)
    for i, value in enumerate(exact):
        np.testing.assert_allclose(found.value[i], value.astype(float), atol=1e-12)
        mean = sum(Fraction(float(p)) * v for p, v in zip(starts[i], value, strict=True))
        worst = min(v for p, v in zip(starts[i], value, strict=True) if p > 0)
        assert_encloses(enclosure(found.lower[i], found.upper[i]), np.array([mean]))
        assert_encloses(enclosure(found.worst_lower[i], found.worst_upper[i]), np.array([worst]))
        assert value[found.worst_state[i]] - worst <= 1e-12
        assert starts[i][found.worst_state[i]] > 0
        np.testing.assert_allclose(found.worst[i], float(worst), atol=1e-12)
    assert (found.status == Status.CONVERGED).all()
    assert float(jnp.max(found.upper - found.lower)) < 1e-10


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("acceptance", "label_on"),
    [
        ("cosafe", "exit"),
        ("cosafe", "entry"),
        ("safety", "exit"),
        pytest.param("safety", "entry", marks=pytest.mark.exhaustive),
    ],
)
def test_the_probability_is_enclosed_in_every_lane(acceptance, label_on):
    models, policies, exact = cases(acceptance, label_on)
    assert sum(any(0 < x < 1 for x in value) for value in exact) > NUM_MODELS // 2
    assert_correct(tp.task_performances(models, policies), models, exact)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("acceptance", "label_on"),
    [
        ("cosafe", "exit"),
        ("cosafe", "entry"),
        ("safety", "exit"),
        pytest.param("safety", "entry", marks=pytest.mark.exhaustive),
    ],
)
def test_elimination_agrees(acceptance, label_on, monkeypatch):
    """Worlds without a certificate are solved again by the sparse engine."""
    models, policies, exact = cases(acceptance, label_on)
    some, chosen = jax.tree.map(lambda x: x[::4], (models, policies))
    batched = tp._batched

    def unproven(*arguments, **options):
        performances = batched(*arguments, **options)
        zero, status = np.zeros_like(performances.value), performances.status
        return replace(performances, value=zero, status=np.full_like(status, Status.PRECISION))

    monkeypatch.setattr(tp, "_batched", unproven)
    assert_correct(tp.task_performances(some, chosen), some, exact[::4])


def test_new_numbers_do_not_retrace():
    models, policies, _ = cases("cosafe", "exit")
    tp.task_performances(models, policies)
    with counted_traces() as traced:
        tp.task_performances(jax.tree.map(lambda x: x[::-1], models), policies[::-1])
    assert not [name for name in traced if "performance" in name or name == "_batched"]


def test_unknown_methods_are_refused():
    model = jl.product(jl.gridworld(". g\n. b", absorbing=["b"]), "G F g")
    policy = jnp.full((*model.state_shape, 4), 0.25)
    with pytest.raises(ValueError, match='"blocks" is for co-safe'):
        tp.task_performance(model, policy, method="blocks")
    with pytest.raises(ValueError, match=r"method=.*auto"):
        tp.task_performance(model, policy, method="fast")


def reluctant(leaving, dtype):
    """Two cells that a policy hardly ever leaves, then for the goal or a trap, one time in four."""
    mdp = jl.make_mdp(
        [[[1], [2], [3]], [[0], [2], [3]], [[2]] * 3, [[3]] * 3],
        np.ones((4, 3, 1)),
        label=[[0], [0], [1], [0]],
        propositions=["g"],
        initial=[0.5, 0.5, 0, 0],
    )
    policy = np.array([1 - 4 * leaving, leaving, 3 * leaving])
    models = stack_products([mdp, mdp], "F g")
    models = jax.tree.map(lambda x: x.astype(dtype) if x.dtype == jnp.float64 else x, models)
    policies = np.broadcast_to(policy, (2, 4, models.num_memory, 3)).copy()
    policies[1] = 1 / 3
    return models, jnp.asarray(policies, dtype)


@pytest.mark.parametrize(
    ("leaving", "dtype"),
    [(1e-12, "float32"), pytest.param(1e-18, "float64", marks=pytest.mark.exhaustive)],
)
def test_what_is_hardly_ever_left_is_certified_all_the_same(leaving, dtype):
    models, policies = reluctant(leaving, dtype)
    inside = tp.task_performance(unstack_product(models, 0), policies[0])
    assert inside.status == Status.PRECISION
    assert (inside.lower, inside.upper) == (0, 1), "nothing is certain"
    found = tp.task_performances(models, policies)
    assert found.status.tolist() == [Status.CONVERGED] * 2
    assert found.mean.dtype == dtype
    np.testing.assert_allclose(found.mean, [0.25, 0.5], rtol=1e-5)
    assert (found.lower <= jnp.array([0.25, 0.5])).all()
    assert (found.upper >= jnp.array([0.25, 0.5])).all()


@pytest.mark.slow
def test_single_precision_encloses_too():
    models, policies, _ = cases("cosafe", "exit")
    single = jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, models)
    found = tp.task_performances(single, policies.astype(jnp.float32))
    double = jax.tree.map(lambda x: x.astype(jnp.float64) if x.dtype == jnp.float32 else x, single)
    exact = tp.task_performances(double, policies.astype(jnp.float32).astype(jnp.float64))
    assert (found.lower <= exact.mean).all() and (exact.mean <= found.upper).all()
    assert float(jnp.max(found.upper - found.lower)) < 1e-3


def test_policies_of_the_wrong_shape_are_refused():
    models, policies, _ = cases("cosafe", "exit")
    with pytest.raises(ValueError, match="policies has shape"):
        tp.task_performances(models, policies[:3])
    with pytest.raises(ValueError, match="models is a single product"):
        tp.task_performances(lane(models, 0), policies[0])
    same = stack([lane(models, 0)] * NUM_MODELS)
    one_for_all = tp.task_performances(same, np.asarray(lane(models, 0).available).argmax(-1))
    assert one_for_all.mean.shape == (NUM_MODELS,)


def test_what_is_no_policy_is_refused_in_its_lane_alone():
    models, policies, _ = cases("cosafe", "exit")
    bad = np.array(policies)
    bad[7, 2, 1] *= 2.5
    found = tp._together(models, jnp.asarray(bad), None)
    assert found.status[7] == Status.INVALID and np.isnan(found.mean[7])
    assert (found.lower[7], found.upper[7]) == (0, 1)
    assert (np.delete(np.asarray(found.status), 7) == Status.CONVERGED).all()
    for call in (
        lambda: tp.task_performances(models, jnp.asarray(bad)),
        lambda: tp.task_performance(lane(models, 7), jnp.asarray(bad[7])),
    ):
        with pytest.raises(ValueError, match=r"of state \(2, 1\) sums to 2.5"):
            call()


# --- over worlds ----------------------------------------------------------------------------------


@cache
def three_worlds():
    """The goal behind nothing, behind a wall, and behind an obstacle that may be walked into."""
    maps = [". . g", ". # g", ". b g"]
    models = stack_products(
        [jl.gridworld(m, initial="!g", legend={".": [], "g": ["g"], "b": ["b"]}) for m in maps],
        "!b U g",
    )
    return models, tp.task_performances(models, jnp.full((3, models.num_memory, 4), 0.25))


@pytest.mark.slow
def test_infeasible_starts_are_found():
    models, _ = three_worlds()
    found = jax.jit(jax.vmap(tp.infeasible_starts))(models)
    assert found.tolist() == [[False] * 3, [True, False, False], [True, True, False]]
    for w in range(3):  # as on the host
        assert tp.infeasible_starts(lane(models, w)).tolist() == found[w].tolist()


KINDS = ("cosafe", "safety", "buchi", "parity")


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", KINDS)
def test_starts_from_which_nothing_does_any_task_are_found(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    count = []
    for _ in range(20):
        model = jl.product(
            random_world(rng), random_automaton(rng, kind), label_on=rng.choice(["entry", "exit"])
        )
        starts = np.flatnonzero(np.asarray(model.mdp.initial) > 0)
        memory = np.asarray(model.initial_memory)[starts]
        never = np.asarray(tp.infeasible_starts(model))
        best, _ = evaluate(model, one_hot(jl.optimal_satisfaction(model).policy))
        np.testing.assert_array_equal(never[starts], best[starts, memory] == 0)
        for _ in range(5):
            value, _ = evaluate(model, one_hot(random_choice(rng, model)))
            assert not value[starts, memory][never[starts]].any()
        count.append(int(never.sum()))
    assert 0 in count and max(count) > 0


def one_hot(policy):
    return np.eye(A)[np.asarray(policy)]


def random_choice(rng, model):
    available = np.asarray(model.available)
    return (rng.random(available.shape) * available).argmax(-1)


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", ["buchi", "parity"])
def test_tasks_without_end_are_enclosed_in_every_world(kind):
    rng = np.random.default_rng(len(kind))
    between = 0
    for _ in range(8):
        automaton = random_automaton(rng, kind)
        worlds = [random_world(rng) for _ in range(4)]
        models = stack([jl.product(w, automaton, label_on="exit") for w in worlds])
        policies = np.stack(
            [
                np.asarray(m.available)
                * rng.dirichlet(np.ones(A), m.state_shape)
                * (rng.random((*m.state_shape, A)) < 0.6)
                + 1e-300 * one_hot(random_choice(rng, m))
                for m in (lane(models, w) for w in range(4))
            ]
        )
        policies /= policies.sum(-1, keepdims=True)
        found = tp.task_performances(models, jnp.asarray(policies))
        assert (found.status == Status.CONVERGED).all()
        for w in range(4):
            model = lane(models, w)
            value, _ = evaluate(model, policies[w])
            value = value[np.arange(len(value)), np.asarray(model.initial_memory)]
            np.testing.assert_allclose(found.value[w], value, atol=1e-12)
            mean = value @ np.asarray(model.mdp.initial)
            assert found.lower[w] - 1e-15 <= mean <= found.upper[w] + 1e-15
            assert found.upper[w] - found.lower[w] < 1e-9
            between += ((value > 0) & (value < 1)).any()
    assert between > 4


def test_tasks_without_end_of_policies_that_hardly_ever_get_out_are_certified_too():
    """As `reluctant`, for ever after."""
    leaving = 1e-18
    mdp = jl.make_mdp(
        [[[1], [2], [3]], [[0], [2], [3]], [[2]] * 3, [[3]] * 3],
        np.ones((4, 3, 1)),
        label=[[0], [0], [1], [0]],
        propositions=["g"],
        initial=[0.5, 0.5, 0, 0],
    )
    models = stack_products([mdp], "G F g")
    policy = np.array([1 - 4 * leaving, leaving, 3 * leaving])
    found = tp.task_performances(
        models, jnp.asarray(np.broadcast_to(policy, (1, 4, models.num_memory, 3)))
    )
    assert found.status.tolist() == [Status.CONVERGED]
    np.testing.assert_allclose(found.mean, [0.25], rtol=1e-12)
    assert found.lower[0] <= 0.25 <= found.upper[0]


def test_worlds_are_left_out_by_name_alone():
    models, performance = three_worlds()
    np.testing.assert_allclose(performance.mean, [1, 0, 0], atol=1e-9)
    every = tp.summarize(models, performance)
    assert every.infeasible == ("world 1", "world 2") and every.left_out == ()
    assert every.num_worlds == 3 and every.mean == pytest.approx(1 / 3)
    assert every.std == pytest.approx(np.std([1, 0, 0], ddof=1))
    assert every.lower <= 1 / 3 <= every.upper
    assert (every.worst_world, every.worst, every.worst_start) == ("world 1", 0, 0)
    names = ["open", "wall", "obstacle"]
    fair = tp.summarize(models, performance, names=names, leave_out=["wall", "obstacle"])
    assert (fair.mean, fair.std, fair.worst_world) == (pytest.approx(1), 0, "open")
    assert fair.infeasible == fair.left_out == ("wall", "obstacle")
    assert fair.uncertain == ()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"names": ["a", "b"]}, "2 entries; give 3"),
        ({"names": ["a", "b", "b"]}, "give 3 different"),
        ({"leave_out": ["x"]}, "no world 'x'"),
        ({"leave_out": ["world 0", "world 1", "world 2"]}, "at least one"),
    ],
)
def test_summaries_of_the_wrong_names_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        tp.summarize(*three_worlds(), **options)


# --- a number of steps ------------------------------------------------------------------------


@pytest.mark.parametrize(("formula", "reached"), [("F a", 1.0), ("G !a", 0.0)])
@pytest.mark.parametrize("seed", range(3))
def test_probabilities_within_a_number_of_steps(formula, reached, seed):
    rng = np.random.default_rng(seed)
    matrix = rng.dirichlet(np.ones(3), (3, 2))
    mdp = jl.from_dense(matrix, label=[[0], [1], [0]], propositions=["a"], initial=[0.5, 0, 0.5])
    policy = rng.dirichlet([1, 1], (1, 4, 3, 2))
    found = tp.step_bounded_performances(stack_products([mdp], formula), jnp.asarray(policy))
    value = np.full(3, 1 - reached)  # of not being at 1 before, on the way out of it
    for actions in policy[0, ::-1, :, 0]:
        after = np.einsum("sa,sat,t->s", actions, matrix, value)
        value = np.where([False, True, False], reached, after)
    np.testing.assert_allclose(found.value[0], value, atol=1e-14)
    mean, worst = (value[0] + value[2]) / 2, min(value[0], value[2])
    assert found.lower[0] <= mean <= found.upper[0] <= found.lower[0] + 1e-13
    assert found.worst_lower[0] <= worst <= found.worst_upper[0] <= found.worst_lower[0] + 1e-13
    assert found.status[0] == Status.CONVERGED
