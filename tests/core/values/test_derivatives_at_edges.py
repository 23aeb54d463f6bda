"""Derivatives of values against exact one-sided differences, also where a probability is 0 or 1."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.automata.automaton import make_automaton
from jaxltl.core.models.mdp import MDP, DenseMDP
from jaxltl.core.models.ops.operators import flat_transitions
from jaxltl.core.models.product import Product, product
from tests.support import bit_labels

SIZE, ACTIONS, WIDTH, GRAIN = 6, 2, 3, 16
STEP = Fraction(1, 2**70)


# --- the oracle: values of a chain in fractions ---------------------------------------------------


def reaching(matrix, target):
    """The states that may reach a target."""
    region = np.array(target)
    while True:
        grown = region | ((matrix > 0) & region).any(-1)
        if (grown == region).all():
            return region
        region = grown


def solved(matrix, right):
    """The solution of ``x = right + matrix x`` in fractions."""
    size = len(right)
    rows = [
        [Fraction(int(i == j)) - matrix[i, j] for j in range(size)] + [right[i]]
        for i in range(size)
    ]
    for i in range(size):
        pivot = next(k for k in range(i, size) if rows[k][i] != 0)
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for k in range(size):
            if k != i and rows[k][i] != 0:
                factor = rows[k][i]
                rows[k] = [x - factor * y for x, y in zip(rows[k], rows[i], strict=True)]
    return np.array([row[-1] for row in rows], object)


def exact(matrix, target, reward=None):
    """Reachability probabilities, or total rewards until the target; None where infinite."""
    some = reaching(matrix, target)
    # States that are left with a positive probability for states without a way to the target.
    within = np.where(target[:, None], 0, matrix)
    lost = reaching(within, ~some)
    among = np.flatnonzero((some if reward is None else ~lost) & ~target)
    value = np.array([Fraction(int(t and reward is None)) for t in target], object)
    gain = np.zeros(len(target), object) if reward is None else reward
    right = gain[among] + (matrix[among][:, target].sum(-1) if reward is None else 0)
    if among.size:
        value[among] = solved(matrix[np.ix_(among, among)], right)
    if reward is not None:
        value[lost] = None
    return value


def opens_class(matrices, target):
    """True if the second chain leaves a closed class of the first that has no target."""
    states = np.eye(len(target), dtype=bool)
    before, after = (np.array([reaching(m, s) for s in states]).T for m in matrices)  # [from, to]
    closed = (~before | before.T).all(-1) & ~target
    return (after & ~before)[closed].any()


def one_sided(values):
    """First and second differences of a function of the step; None if it jumps anywhere."""
    start, one, two = (values(k * STEP) for k in range(3))
    for x, y in zip(start, one, strict=True):
        if (x is None) != (y is None) or (x is not None and abs(x - y) > Fraction(1, 2**40)):
            return None
    finite = np.array([x is not None for x in start])
    start, one, two = (np.where(finite, x, 0) for x in (start, one, two))
    first = ((one - start) / STEP).astype(float)
    second = ((two - 2 * one + start) / STEP**2).astype(float)
    return finite, first, second


# --- random cases ---------------------------------------------------------------------------------


def shares(rng, count, room, total=GRAIN):
    """A distribution over `count` entries in parts of a `total`, of which at most `room` are used."""
    used = rng.permutation(count)[: rng.integers(1, room + 1)]
    table = np.zeros(count, int)
    np.add.at(table, rng.choice(used, total), 1)
    return table


def change(rng, table):
    """A direction that keeps sums and leads from 0 upwards, in some rows."""
    to = np.zeros_like(table)
    for row in np.ndindex(table.shape[:-1]):
        if rng.random() < 0.5:
            continue
        source = rng.choice(np.flatnonzero(table[row]))
        to[(*row, rng.integers(table.shape[-1]))] += 1
        to[(*row, source)] -= 1
    return to


def random_case(rng):
    """A model, a policy and rewards with directions, as whole numbers; few entries are positive."""
    successor = np.stack(
        [[rng.permutation(SIZE)[:WIDTH] for _ in range(ACTIONS)] for _ in range(SIZE)]
    )
    probability = np.stack([[shares(rng, WIDTH, 2) for _ in range(ACTIONS)] for _ in range(SIZE)])
    # The last state is absorbing, so that most values do not jump.
    successor[-1], probability[-1] = SIZE - 1, [GRAIN, 0, 0]
    policy = np.stack([shares(rng, ACTIONS, 2, total=2) for _ in range(SIZE)])
    reward = rng.integers(0, 2, (SIZE, ACTIONS))
    at = {"probability": probability, "policy": policy, "reward": reward}
    along = {
        "probability": change(rng, probability),
        "policy": change(rng, policy),
        "reward": rng.integers(0, 2, reward.shape),
    }
    return successor, at, along


def chain(successor, x):
    """Transition matrix and rewards under a policy, in fractions."""
    matrix = np.full((SIZE, SIZE), Fraction(0), object)
    for s, a, k in np.ndindex(successor.shape):
        matrix[s, successor[s, a, k]] += x["policy"][s, a] * x["probability"][s, a, k]
    return matrix, (x["policy"] * x["reward"]).sum(-1)


SCALE = {"probability": GRAIN, "policy": 2, "reward": 1}


def moved(at, along, step):
    fractions = np.vectorize(Fraction, otypes=[object])
    return {
        name: (fractions(at[name]) + step * fractions(along[name])) / SCALE[name] for name in at
    }


def floats(tree):
    return {name: jnp.asarray(x / SCALE[name], float) for name, x in tree.items()}


# --- derivatives ----------------------------------------------------------------------------------


def derivatives(value):
    """First and second derivatives along a direction, forward and reverse, in one program."""

    def first(x, along):
        return jax.jvp(value, (x,), (along,))[1]

    def dot(x, y):
        return sum(jnp.vdot(x[name], y[name]) for name in x)

    @jax.jit
    def run(x, along, weight):
        def slope(x):
            return jax.grad(lambda x: weight @ value(x))(x)

        forward, second = jax.jvp(lambda x: first(x, along), (x,), (along,))
        gradient, bend = jax.jvp(slope, (x,), (along,))
        return forward, second, dot(gradient, along), dot(bend, along)

    return run


def world(successor, probability):
    return MDP(
        successor=jnp.asarray(successor, jnp.int32),
        probability=jnp.asarray(probability, float),
        available=jnp.ones((len(successor), ACTIONS), bool),
        initial=jnp.full(len(successor), 1 / len(successor)),
        label=jnp.zeros((len(successor), 0), bool),
    )


def with_numbers(model, probability):
    """The model with other probabilities of its transitions."""
    if isinstance(model, Product):
        return model.replace(mdp=model.mdp.replace(probability=probability))
    return model.replace(probability=probability)


def dense(model):
    rows, choices = np.arange(SIZE)[:, None, None], np.arange(ACTIONS)[:, None]
    table = jnp.zeros((SIZE, ACTIONS, SIZE)).at[rows, choices, model.successor]
    return DenseMDP(table.add(model.probability), model.available, model.initial, model.label)


def finite(value):
    return jnp.where(jnp.isfinite(value), value, 0)


def solution_of(kind):
    """The solution of ``(model, x, target)``."""

    def run(model, x, target):
        model = dense(model) if kind == "dense" else model
        if kind in ("policy", "dense"):
            return jl.reachability_probability(model, target, policy=x["policy"])
        if kind in ("max", "min", "sweeps"):
            steps = 10_000 if kind == "sweeps" else None
            objective = "max" if kind == "sweeps" else kind
            return jl.reachability_probability(model, target, objective=objective, max_steps=steps)
        if kind == "reward":
            return jl.total_reward(model, x["reward"], target, policy=x["policy"])
        objective = kind.removeprefix("reward_")
        return jl.total_reward(model, x["reward"], target, objective=objective)

    return run


def compiled(solve):
    """The derivatives of the value of solutions of ``(model, x, target)``, and their policies."""

    @jax.jit
    def run(model, x, along, target, weight):
        def of(x):
            return solve(with_numbers(model, x["probability"]), x, target)

        found = derivatives(lambda x: finite(of(x).value.ravel()))(x, along, weight)
        return found, of(x).policy

    return run


def assert_exact(found, expected, weight, name):
    """Derivatives along a direction as of :func:`derivatives`, against exact differences."""
    known, first, second = expected
    forward, bent, gradient, bend = (np.asarray(x) for x in found)
    size = 1 + np.abs(first).max() + np.abs(second).max()
    np.testing.assert_allclose(forward[known], first[known], atol=1e-9 * size, err_msg=name)
    np.testing.assert_allclose(bent[known], second[known], atol=1e-7 * size, err_msg=name)
    total = np.abs(weight).sum() * size
    assert abs(gradient - (weight * known) @ first) <= 1e-9 * total, name
    assert abs(bend - (weight * known) @ second) <= 1e-7 * total, name


def check(kind, count, seed):
    """Compares cases of which no value jumps with exact differences; some are at the edge."""
    rng, run, earns = np.random.default_rng(seed), compiled(solution_of(kind)), "reward" in kind
    optimal = kind not in ("policy", "dense", "reward")
    edges, done, tried = 0, 0, 0
    target = np.arange(SIZE) == SIZE - 2
    target[-1] = earns
    weight = np.linspace(1, 2, SIZE)
    while done < count:
        successor, at, along = random_case(rng)
        tried += 1
        model = world(successor, at["probability"])
        if optimal:
            policy = run(model, floats(at), floats(along), target, weight)[1]
            at["policy"] = SCALE["policy"] * np.eye(ACTIONS, dtype=int)[np.asarray(policy)]
            along["policy"] = np.zeros_like(at["policy"])

        def values(step, numbers=(successor, at, along)):
            matrix, gain = chain(numbers[0], moved(*numbers[1:], step))
            return exact(matrix, target, gain if earns else None)

        ends = (chain(successor, moved(at, along, k * STEP))[0] for k in range(2))
        expected = None if opens_class(tuple(ends), target) else one_sided(values)
        if expected is None:
            continue
        found = run(model, floats(at), floats(along), target, weight)[0]
        assert_exact(found, expected, weight, f"case {tried}")
        start = values(Fraction(0))
        edges += sum(x in (0, 1) and d != 0 for x, d in zip(start, expected[1], strict=True))
        done += 1
    assert edges >= count / 8


def random_product(rng, acceptance):
    """A product of 3 states and 2 memory states with numbers and directions of its world."""
    successor, at, along = random_case(rng)
    table, change = (x["probability"][: SIZE // 2] for x in (at, along))
    successor = np.stack(
        [[rng.permutation(SIZE // 2) for _ in range(ACTIONS)] for _ in range(SIZE // 2)]
    )
    labelled = world(successor, table / GRAIN).replace(
        label=bit_labels(rng.integers(2, size=SIZE // 2), 1), propositions=("a",)
    )
    delta = np.array([[0, 1], [1, 1]])  # an absorbing memory state
    automaton = make_automaton(
        delta,
        0,
        bit_labels(np.arange(2), 1),
        ("a",),
        final=np.arange(2) != (acceptance == "safety"),
        acceptance=acceptance,
    )
    shape = (SIZE // 2, 2, ACTIONS)
    at, along = (
        {**x, "probability": p, "policy": x["policy"].reshape(shape)}
        for x, p in ((at, table), (along, change))
    )
    return product(labelled, automaton, label_on="entry"), at, along


def flattened(x):
    """The numbers of a product's states."""
    probability = np.repeat(x["probability"], 2, axis=0)
    return {**x, "probability": probability, "policy": x["policy"].reshape(SIZE, ACTIONS)}


# --- the laws -------------------------------------------------------------------------------------

OTHERS = ["dense", "max", "min", "sweeps", "reward_max", "reward_min"]


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        ("policy", 30),
        *(pytest.param(kind, 30, marks=pytest.mark.slow) for kind in ("reward", *OTHERS[1:3])),
        *(pytest.param(kind, 100, marks=pytest.mark.exhaustive) for kind in OTHERS),
        *(pytest.param(kind, 400, marks=pytest.mark.exhaustive) for kind in ("policy", "reward")),
    ],
)
def test_derivatives_are_those_of_the_exact_value(kind, count):
    """First and second, forward and reverse, where the graph decides a value too."""
    check(kind, count, seed=len(kind))


@pytest.mark.few(0, 3)
@pytest.mark.parametrize(
    ("kind", "acceptance"),
    [
        *(("policy", "cosafe"), ("optimum", "safety"), ("blocks", "cosafe")),
        *(("policy", "safety"), ("optimum", "cosafe"), ("blocks", "safety")),
    ],
)
def test_derivatives_of_satisfaction_probabilities(kind, acceptance):
    def solve(model, x, target):
        if kind == "optimum":
            return jl.optimal_satisfaction(model)
        solution = jl.satisfaction_probability(model, x["policy"])
        if kind == "blocks":
            start = jl.task_performance(model, x["policy"], method="blocks").value
            place = jnp.arange(SIZE // 2), model.initial_memory
            return solution.replace(value=solution.value.at[place].set(start))
        return solution

    rng, run, done = np.random.default_rng(7), compiled(solve), 0
    weight, safety = np.linspace(1, 2, SIZE), acceptance == "safety"
    while done < 60:
        model, at, along = random_product(rng, acceptance)
        if kind == "optimum":
            policy = run(model, floats(at), floats(along), None, weight)[1]
            at["policy"] = SCALE["policy"] * np.eye(ACTIONS, dtype=int)[np.asarray(policy)]
            along["policy"] = np.zeros_like(at["policy"])
        successor = np.asarray(flat_transitions(model)[0])
        target = np.asarray(model.final).ravel() != safety

        def matrix(step, numbers=(successor, at, along)):
            return chain(numbers[0], moved(*map(flattened, numbers[1:]), step))[0]

        def values(step, matrix=matrix, target=target):
            value = exact(matrix(step), target)
            return 1 - value if safety else value

        jumps = opens_class((matrix(0), matrix(STEP)), target)
        expected = None if jumps else one_sided(values)
        if expected is None:
            continue
        found = run(model, floats(at), floats(along), None, weight)[0]
        assert_exact(found, expected, weight, f"case {done}")
        done += 1


@pytest.mark.few(0, 1)
@pytest.mark.parametrize("earns", [False, True])
def test_derivatives_of_prepared_policies(earns):
    """One graph and many policies, which leave out choices."""
    rng = np.random.default_rng(3)
    done, edges, weight = 0, 0, np.linspace(1, 2, SIZE)
    for _ in range(3):
        successor, at, _ = random_case(rng)
        target = np.arange(SIZE) == SIZE - 2
        target[-1] = earns
        model = world(successor, at["probability"] / GRAIN)
        reward = np.ravel(at["reward"]).astype(float) if earns else None
        question = jl.prepare(model, target, reward=reward, objective="policy")

        @jax.jit
        def run(x, along, question=question):
            def value(x):
                policy = x["policy"].ravel()
                return finite(jl.solve_prepared(question, policy=policy, tolerance=1e-12).value)

            return derivatives(value)(x, along, weight)

        for _ in range(60):
            policy = np.stack([shares(rng, ACTIONS, 2, total=2) for _ in range(SIZE)])
            now = {**at, "policy": policy}
            along = {name: np.zeros_like(x) for name, x in now.items()}
            along["policy"] = change(rng, policy)

            def values(step, numbers=(successor, now, along), target=target):
                matrix, gain = chain(numbers[0], moved(*numbers[1:], step))
                return exact(matrix, target, gain if earns else None)

            ends = (chain(successor, moved(now, along, k * STEP))[0] for k in range(2))
            expected = None if opens_class(tuple(ends), target) else one_sided(values)
            if expected is None:
                continue
            only = {"policy": floats(now)["policy"]}, {"policy": floats(along)["policy"]}
            assert_exact(run(*only), expected, weight, f"case {done}")
            start = values(Fraction(0))
            edges += sum(x in (0, 1) and d != 0 for x, d in zip(start, expected[1], strict=True))
            done += 1
    assert done >= 30
    assert edges >= 5


def test_rewards_of_transitions_count_in_derivatives_at_probability_zero():
    def value(shift):
        table = jnp.array([[[1 - shift, shift]], [[1.0, 0.0]]])
        model = world(np.array([[[0, 1]], [[1, 1]]]), table).replace(
            available=jnp.ones((2, 1), bool)
        )
        reward = jnp.array([[[0.0, 8.0]], [[0.0, jnp.inf]]])  # the last one is never earned
        return jl.policy_value(model, jnp.zeros(2, jnp.int32), reward, 0.5).value[0]

    # x = shift 8 + (1 - shift) x / 2
    np.testing.assert_allclose(jax.jit(jax.grad(value))(0.0), 16.0, rtol=1e-9)


@pytest.mark.slow
def test_lanes_have_their_own_derivatives():
    """Gradients in lanes, some at the edge, equal those of single solves."""
    rng = np.random.default_rng(5)
    cases = [random_case(rng) for _ in range(12)]
    target, weight = np.arange(SIZE) == SIZE - 2, np.linspace(1, 2, SIZE)

    def slope(successor, x):
        def value(x):
            model = world(successor, x["probability"])
            return weight @ jl.reachability_probability(model, target, policy=x["policy"]).value

        return jax.grad(value)(x)

    successor = np.stack([case[0] for case in cases])
    numbers = [floats(case[1]) for case in cases]
    together = jax.tree.map(lambda *x: jnp.stack(x), *numbers)
    found = jax.jit(jax.vmap(slope))(successor, together)
    one = jax.jit(slope)
    for i, x in enumerate(numbers):
        for name, alone in one(successor[i], x).items():
            np.testing.assert_allclose(found[name][i], alone, rtol=1e-9, atol=1e-9)
