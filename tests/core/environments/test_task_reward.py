"""Rewards of tasks: what is best by them is best by the formula, and shaping changes nothing."""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from jaxltl.core.automata.automaton import complement
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.environment import Timestep, make_environment
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.environments.task_environment import (
    TaskWorld,
    make_task_tables,
    stack_tables,
    task_environment,
    with_task_tables,
)
from jaxltl.core.environments.task_reward import make_task_reward
from jaxltl.core.models.product import product
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)
from tests import reference
from tests.support import as_mdp, lane

S, A, K = 4, 2, 2
NAMES = ("a", "b", "c")
FORMULAS = {
    "cosafe": ("F a", "!b U a", "F (a & F b)", "F (a & X b)", "F a & F (b & c)"),
    "safety": ("G !b", "G (a -> X !b)", "!a W b", "G a | b"),
    "buchi": ("G F a", "G F a & G F b", "G F a & G !b", "G F (a & X b)", "G F a & (!b U c)"),
    "parity": (
        "F G a",
        "G F a -> G F b",
        "F G a & G F b",
        "(F G a) | (G F b & F !b)",
        "(G F a & F G !b) | G F c",
    ),
}
KINDS = {formula: kind for kind, formulas in FORMULAS.items() for formula in formulas}
# Near enough to the limits for models in eighths.
EXACT = {
    "reach": {"discount": 1.0},
    "keep": {"discount": 1 - 1e-5},
    "eventual": {"discount": 1 - 1e-5},
    "two-discount": {"discount": 1 - 1e-4},
    "parity": {"discount": 1 - 1e-4, "ratio": 1e-3},
}
OF_KIND = {
    "cosafe": ("reach", "eventual", "two-discount", "parity"),
    "safety": ("keep", "eventual", "two-discount", "parity"),
    "buchi": ("eventual", "two-discount", "parity"),
    "parity": ("parity",),
}


class Steps(NamedTuple):
    """Every step of a task's environment, ``[S, Q, A, K]``."""

    reward: np.ndarray
    discount: np.ndarray
    terminated: np.ndarray
    memory: np.ndarray


def make_inner():
    """A world whose action ``a * K + k`` leads to successor k of action a, ends included."""

    def reset(successor, ends, label, key):
        return jnp.int32(0)

    def step(successor, ends, label, state, action, key):
        after = successor[state, action]
        return Timestep(after, 0.0, terminated=ends[after])

    def labels(label, state):
        return label[state]

    tables = jnp.zeros((S, A * K), jnp.int32), jnp.zeros(S, bool), jnp.zeros((S, 3), bool)
    return make_environment(
        Partial(reset, *tables),
        Partial(step, *tables),
        lambda state: state[None],
        actions=A * K,
        labels=Partial(labels, tables[2]),
        propositions=NAMES,
    )


@cache
def automaton_of(formula):
    return to_automaton(formula)


@cache
def some_environment():
    return task_environment(make_inner(), "F a")


def all_tables(options):
    """The tables of all formulas with some options, in one shape; by formula."""
    made = [make_task_tables(automaton_of(f), NAMES, **options(f)) for f in KINDS]
    padded = jax.tree.map(np.asarray, stack_tables(made))
    return {formula: lane(padded, i) for i, formula in enumerate(KINDS)}


@jax.jit
def every_step(tables, successor, ends, label):
    environment = with_task_tables(some_environment(), tables)
    _, labels, step = environment.step.args
    inner_labels = Partial(labels.func, label)
    inner_step = Partial(step.func, successor, ends, label)
    step = Partial(environment.step.func, tables, inner_labels, inner_step)

    def one(state, memory, action):
        world = TaskWorld(state, memory, tables.verdict[memory], jnp.bool_(False), jnp.int32(0))
        found = step(world, action, jax.random.key(0))
        return Steps(found.reward, found.discount, found.terminated, found.world.memory)

    count = tables.delta.shape[0]
    places = jnp.meshgrid(jnp.arange(S), jnp.arange(count), jnp.arange(A * K), indexing="ij")
    return jax.vmap(one)(*(x.ravel() for x in places))


class Problem(NamedTuple):
    """A random world, with the places where its simulation ends: absorbing states."""

    model: reference.Model
    ends: np.ndarray
    label: np.ndarray


def random_problem(seed):
    rng = np.random.default_rng(seed)
    model = reference.random_model(rng, S, A, K)
    ends = np.zeros(S, bool)
    if rng.random() < 0.5:
        end = rng.integers(S)
        ends[end] = True
        model.successor[end] = end
    return Problem(model, ends, rng.random((S, 3)) < 0.4)


def steps_of(problem, tables, num_memory):
    flat = problem.model.successor.reshape(S, A * K)
    found = every_step(tables, flat, problem.ends, problem.label)
    return Steps(*(np.asarray(x).reshape(S, -1, A, K)[:, :num_memory] for x in found))


def as_matrices(problem, steps, learner_discount):
    """The reward of each choice, ``[N, A]``, and what it hands on, ``[N, A, N]``."""
    num_memory = steps.reward.shape[1]
    model = problem.model
    reward = (model.probability[:, None] * steps.reward).sum(-1)
    onward = np.zeros((S, num_memory, A, S, num_memory))
    for s, q, a, k in np.ndindex(S, num_memory, A, K):
        if not steps.terminated[s, q, a, k]:
            to = model.successor[s, a, k], steps.memory[s, q, a, k]
            onward[s, q, a][to] += model.probability[s, a, k] * steps.discount[s, q, a, k]
    onward *= learner_discount
    size = S * num_memory
    return reward.reshape(size, A), onward.reshape(size, A, size)


def value_of(reward, onward, policy):
    """The least value of a policy: zero from where nothing is ever earned."""
    rows = np.arange(len(policy))
    earned, matrix = reward[rows, policy], onward[rows, policy]
    alive = earned != 0
    for _ in policy:
        alive |= (matrix > 0) @ alive > 0
    value = np.zeros(len(policy))
    inside = np.eye(alive.sum()) - matrix[np.ix_(alive, alive)]
    value[alive] = np.linalg.solve(inside, earned[alive])
    return value


def best(problem, steps, open_, learner_discount=1.0):
    """Howard's policy iteration, which changes an action for a better one alone."""
    reward, onward = as_matrices(problem, steps, learner_discount)
    available = np.repeat(problem.model.available, steps.reward.shape[1], axis=0)
    policy, rows = available.argmax(1), np.arange(len(available))
    while True:
        value = value_of(reward, onward, policy) * open_
        choices = np.where(available, reward + onward @ value, -np.inf)
        now = choices[rows, policy]
        better = (choices.max(1) > now + 1e-6 * abs(now) + 1e-13) & open_
        if not better.any():
            return policy, value, choices
        policy = np.where(better, choices.argmax(1), policy)


def attained(seed, formula, options):
    """The best probability in each state, and that of the reward's best policy, with its value."""
    automaton, problem = automaton_of(formula), random_problem(seed)
    open_ = np.tile(verdicts(automaton) == Verdict.UNDECIDED, S)
    steps = steps_of(problem, options[formula], len(automaton.delta))
    policy, value, _ = best(problem, steps, open_)
    model = as_mdp(problem.model, label=problem.label, propositions=NAMES)
    joint = product(model, automaton)
    optimum = optimal_satisfaction(joint).value
    shape = S, len(automaton.delta)
    reached = satisfaction_probability(joint, jnp.asarray(policy.reshape(shape))).value
    keep = open_.reshape(shape)
    return np.asarray(optimum)[keep], np.asarray(reached)[keep], value.reshape(shape)[keep]


def exact_tables(name):
    fits = {f: name in OF_KIND[kind] for f, kind in KINDS.items()}
    return all_tables(lambda f: dict(reward=name, **EXACT[name]) if fits[f] else {})


def check_optimal(name, count):
    tables = exact_tables(name)
    formulas = [f for f, kind in KINDS.items() if name in OF_KIND[kind]]
    undone = 0
    for seed in range(count):
        formula = formulas[seed % len(formulas)]
        optimum, reached, value = attained(seed, formula, tables)
        np.testing.assert_allclose(reached, optimum, atol=1e-6, err_msg=f"{seed}: {formula}")
        np.testing.assert_allclose(
            value + (name == "keep"), optimum, atol=5e-3, err_msg=f"{seed}: {formula}"
        )
        if name == "eventual":
            assert (value > optimum - 1e-9).all(), f"{seed}: {formula}"
        undone += ((optimum > 0.01) & (optimum < 0.99)).sum()
    assert undone > count / 8, "most problems are decided anyway"


@pytest.mark.few(2)
@pytest.mark.parametrize("name", EXACT)
def test_what_is_best_by_the_reward_is_best_by_the_formula(name):
    check_optimal(name, 60)


SHAPED = {
    "reach": {"discount": 0.9},
    "keep": {"discount": 0.9},
    "eventual": {"discount": 0.9, "learner_discount": 0.95},
    "two-discount": {"discount": 0.9, "ratio": 0.5},
    "parity": {"discount": 0.8, "ratio": 0.5, "learner_discount": 0.95},
}


def check_shaping(name, count):
    formulas = [f for f, kind in KINDS.items() if name in OF_KIND[kind]]
    rng = np.random.default_rng(1)
    learner = SHAPED[name].get("learner_discount", 1.0)
    potentials = {f: rng.normal(size=len(automaton_of(f).delta)) for f in formulas}

    def options(shaping):
        return lambda f: (
            dict(reward=name, shaping=shaping(f), **SHAPED[name]) if f in formulas else {}
        )

    plain = all_tables(options(lambda f: None))
    shaped = [all_tables(options(x)) for x in (lambda f: "distance", potentials.get)]
    for seed in range(count):
        formula = formulas[seed % len(formulas)]
        automaton, problem = automaton_of(formula), random_problem(seed)
        size = len(automaton.delta)
        open_ = np.tile(verdicts(automaton) == Verdict.UNDECIDED, S)
        *_, expected = best(problem, steps_of(problem, plain[formula], size), open_, learner)
        for tables in shaped:
            tables = tables[formula]
            *_, found = best(problem, steps_of(problem, tables, size), open_, learner)
            potential = np.tile(tables.potential[:size], S)[:, None]
            # Every action is worth less by the potential, hence each order of actions is kept.
            np.testing.assert_allclose(
                found[open_], (expected - potential)[open_], atol=1e-5, err_msg=f"{seed}: {formula}"
            )


@pytest.mark.few(3)
@pytest.mark.parametrize("name", SHAPED)
def test_shaping_changes_no_best_policy(name):
    check_shaping(name, 40)


def test_distances_in_the_automaton():
    def potential(formula, **options):
        automaton = automaton_of(formula)
        return make_task_reward(
            automaton, verdicts(automaton), shaping="distance", **options
        ).potential

    # A letter with both a and b is as long as one with a and one with b.
    assert potential("F (a & F b)").tolist() == [0, 0.5, 1]
    assert potential("F (a & F (b & F c))").tolist() == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert potential("!c U (a & (!c U b))").tolist() == [0, 0.5, 1, 0]
    assert potential("F (a & X b)").tolist() == [0, 0.5, 1]
    assert potential("G (a -> X !b)").tolist() == [1, 0.5, 0]
    assert potential("G F (a & X b)", reward="two-discount").tolist() == [0, 0.5]
    assert (potential("F a & F (b & c)") >= 0).all()


def test_parity_with_two_priorities_is_two_discount():
    automaton = automaton_of("G F a & G F b")
    first, second = (
        make_task_reward(automaton, verdicts(automaton), reward=name, discount=0.9, ratio=0.5)
        for name in ("parity", "two-discount")
    )
    np.testing.assert_array_equal(first.reward, second.reward)
    np.testing.assert_array_equal(first.discount, second.discount)


def test_priorities_of_one_parity_are_one():
    automaton = automaton_of("(G F a & F G !b) | G F c")
    decisions = verdicts(automaton)
    pay = make_task_reward(automaton, decisions, discount=0.5, ratio=0.5)
    assert set(pay.discount.ravel()) == {0.5, 0.75, 0.875, 0.9375}
    # Two more are one rank more, and those of the negation are as many but odd.
    other = make_task_reward(complement(complement(automaton)), decisions, discount=0.5, ratio=0.5)
    np.testing.assert_array_equal(pay.reward, other.reward)
    assert make_task_reward(complement(automaton), decisions).reward.max() < 1e-3


@pytest.mark.parametrize(
    ("formula", "options", "text"),
    [
        ("F a", {"reward": "gold"}, "choose one of auto, reach"),
        ("G a", {"reward": "reach"}, "'reach' is for cosafe tasks, and this one has safety"),
        ("G F a", {"reward": "keep"}, "'auto' takes it"),
        ("F G a", {"reward": "eventual"}, "take 'parity'"),
        ("F a", {"discount": 0}, "discount=0"),
        ("F a", {"discount": 1.5}, "at most 1"),
        ("G F a", {"discount": 1}, "below 1"),
        ("G F a", {"discount": float("nan")}, "discount=nan"),
        ("F a", {"ratio": 0.5}, "not of 'reach'"),
        ("F G a", {"ratio": 1}, "ratio=1;"),
        ("F a", {"learner_discount": 2}, "learner_discount=2"),
        ("F a", {"shaping": "far"}, "give None, 'distance' or an array"),
        ("F a", {"shaping": [1.0]}, r"numbers \[2\]"),
        ("F a", {"shaping": [1, np.inf]}, "finite"),
        ("F a", {"discount": 1, "shaping": "distance"}, "Give discount below 1"),
        ("G F a", {"shaping": "distance"}, "Give the reward 'two-discount'"),
        ("F G a & G F b", {"discount": 1 - 1e-9}, "float64 does not tell from none"),
    ],
)
def test_bad_rewards_are_named(formula, options, text):
    automaton = automaton_of(formula)
    with pytest.raises(ValueError, match=text):
        make_task_reward(automaton, verdicts(automaton), **options)


def test_in_single_precision_a_reward_that_would_never_stop_is_refused():
    automaton = automaton_of("(G F a & F G !b) | G F c")
    with jax.enable_x64(False), pytest.raises(ValueError, match="float32 does not tell"):
        make_task_reward(automaton, verdicts(automaton), discount=0.999)
