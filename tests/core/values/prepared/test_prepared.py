"""Prepared solves against the host engine: other numbers, policies, lanes, precisions, slopes."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.sparse.prepared import block_schedule as schedule
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.types import Status
from jaxltl.core.values.engine.host_solution import induced_chain
from jaxltl.core.values.prepared.prepared import prepare, solve_prepared
from tests.sparse_models import random_sparse
from tests.support import lane

SIZE = 12


def forward_model(rng, size=SIZE, most=3, loops=True):
    """Every state leads on or loops; the last two are absorbing."""
    row_start, entry_start, successor, probability = [0], [0], [], []
    for s in range(size):
        for _ in range(int(rng.integers(1, most + 1)) if s < size - 2 else 1):
            pool = np.arange(s + 1, size) if s < size - 2 else np.array([s])
            targets = rng.choice(pool, min(pool.size, int(rng.integers(1, 6))), replace=False)
            if loops and s < size - 2 and rng.random() < 0.3:
                targets = np.append(targets, s)
            weights = rng.random(targets.size) + 0.1
            successor += targets.tolist()
            probability += (weights / weights.sum()).tolist()
            entry_start.append(len(successor))
        row_start.append(len(entry_start) - 1)
    return make_sparse(row_start, entry_start, successor, probability)


def escaping(model, among):
    """The same, but that some rows end in the last state with probability .1 or more."""
    host, p = model.host, np.asarray(model.probability)
    rows = []
    for r, (a, b) in enumerate(zip(host.entry_start[:-1], host.entry_start[1:], strict=True)):
        last, share = [SIZE - 1][: among[r]], 1 - 0.1 * among[r]
        tenth = [0.1][: among[r]]
        rows.append((np.append(host.successor[a:b], last), np.append(share * p[a:b], tenth)))
    return make_sparse(
        model.row_start,
        np.cumsum([0] + [x.size for x, _ in rows]),
        np.concatenate([x for x, _ in rows]).astype(int),
        np.concatenate([w for _, w in rows]),
    )


def random_case(seed, question="probability"):
    """A model with or without circles, a target, states that may be passed, and rewards or None."""
    rng = np.random.default_rng(seed)
    model = forward_model(rng) if seed % 2 else random_sparse(rng, SIZE, most=4, width=4)
    if question == "probability":
        return rng, model, np.arange(SIZE) == SIZE - 1, rng.random(SIZE) < 0.9, None
    target = np.arange(SIZE) >= SIZE - 2
    if seed % 2 == 0:  # some rows of most states lead to the target, those of state 1 do not
        ends = (rng.random(model.num_rows) < 0.8) & (model.host.state != 1)
        model = escaping(model, ends.astype(int))
    reward = rng.random(model.num_rows) * (rng.random(model.num_rows) < 0.7)
    return rng, model, target, None, reward


def by_host(model, target, stay, reward, maximize):
    if reward is None:
        return optimal.reachability(model.host, target, maximize=maximize, stay=stay)
    return optimal.total_reward(model.host, reward, target, maximize=maximize)


def of_policy(model, policy, target, stay, reward):
    chain = induced_chain(model, policy)
    if reward is None:
        return optimal.reachability(chain.mdp, target, maximize=True, stay=stay, depth=chain.depth)
    paid = chain.mean(reward, model.row_start)
    return optimal.total_reward(chain.mdp, paid, target, maximize=True, depth=chain.depth)


def agree(found, expected, tolerance=1e-6):
    """Both enclose the same numbers."""
    lower, value, upper = (np.asarray(x) for x in (found.lower, found.value, found.upper))
    assert int(found.status) == Status.CONVERGED
    assert ((lower <= value) & (value <= upper)).all()
    assert (lower <= expected.upper).all() and (expected.lower <= upper).all()
    finite = np.isfinite(upper)
    assert (finite == np.isfinite(expected.upper)).all()
    width = upper[finite] - lower[finite]
    assert (width <= tolerance * np.maximum(1, upper[finite]) * 1.001).all()
    sure = (expected.lower == expected.upper) & ((expected.lower == 0) | (expected.lower == 1))
    assert (value[sure] == expected.value[sure]).all()


def other_numbers(rng, model):
    """Other probabilities of the same transitions."""
    p = np.asarray(model.probability) * np.exp(rng.normal(size=model.num_transitions))
    return p / np.add.reduceat(p, model.entry_start[:-1])[model.host.row]


def cases(*some, seeds=24):
    """Some cases, and all of them where there is time."""
    kinds = [sorted(set(x)) for x in zip(*some, strict=True)][1:]
    every = itertools.product(range(seeds), *kinds)
    more = [pytest.param(*x, marks=pytest.mark.exhaustive) for x in every if x not in some]
    return [*some, *more]


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("seed", "question", "objective"),
    cases(
        (0, "probability", "max"),
        (0, "reward", "min"),
        (1, "probability", "min"),
        (1, "reward", "max"),
    ),
)
def test_optima_are_those_of_the_host_engine(seed, question, objective):
    rng, model, target, stay, reward = random_case(seed, question)
    maximize = objective == "max"
    prepared = prepare(model, target, stay=stay, reward=reward, objective=objective)
    found = solve_prepared(prepared)
    agree(found, by_host(model, target, stay, reward, maximize))
    # The policy attains the bound on the safe side.
    own = of_policy(model, np.asarray(found.policy), target, stay, reward)
    if maximize:
        assert (own.upper >= np.asarray(found.lower)).all()
    else:
        assert (own.lower <= np.asarray(found.upper)).all()
    # Other numbers go through without a new schedule.
    changed = model.replace(probability=other_numbers(rng, model))
    paid = None if reward is None else reward * (0.1 + rng.random(reward.size))
    found = solve_prepared(prepared, probability=changed.probability, reward=paid)
    agree(found, by_host(changed, target, stay, paid, maximize))


@pytest.mark.few(1)
@pytest.mark.parametrize(("seed", "question"), cases((1, "probability"), (0, "reward")))
def test_policies_are_evaluated_in_lanes(seed, question):
    rng, model, target, stay, reward = random_case(seed, question)
    prepared = prepare(model, target, stay=stay, reward=reward, objective="policy")
    count = np.diff(model.row_start)
    actions = rng.integers(0, count, (5, SIZE))
    solve = jax.jit(jax.vmap(lambda x: solve_prepared(prepared, policy=x)))
    found = jax.tree.map(np.asarray, solve(actions.astype(np.int32)))
    weights = rng.random((5, model.num_rows)) * (rng.random((5, model.num_rows)) < 0.6)
    weights[:, model.row_start[:-1]] += 0.1
    weights /= np.add.reduceat(weights, model.row_start[:-1], 1)[:, model.host.state]
    mixed = jax.tree.map(np.asarray, solve(weights))
    for i in range(5):
        for several, policy in ((found, actions[i]), (mixed, weights[i])):
            agree(lane(several, i), of_policy(model, policy, target, stay, reward))


def test_wide_rows_and_many_choices_are_split():
    rng = np.random.default_rng(5)
    size = 60
    row_start, entry_start, successor, probability = [0], [0], [], []
    for s in range(size - 2):
        for _ in range(11 if s == 3 else 1 + (s % 17 == 0)):
            wide = min(size - s - 1, 37 if s in (1, 3) else 2)
            successor += rng.choice(np.arange(s + 1, size), wide, replace=False).tolist()
            probability += [1 / wide] * wide
            entry_start.append(len(successor))
        row_start.append(len(entry_start) - 1)
    for s in (size - 2, size - 1):
        successor, probability = [*successor, s], [*probability, 1.0]
        entry_start.append(len(successor))
        row_start.append(len(entry_start) - 1)
    model = make_sparse(row_start, entry_start, successor, probability)
    target = np.arange(size) == size - 1
    for objective in ("max", "min"):
        prepared = prepare(model, target, objective=objective)
        shape = prepared.segments[0].target.shape
        assert shape[1] < 11 and shape[2] < 37
        found = solve_prepared(prepared)
        agree(found, by_host(model, target, None, None, objective == "max"), 1e-12)
        row = model.row_start[:-1] + np.asarray(found.policy)
        assert ((row >= model.row_start[:-1]) & (row < model.row_start[1:])).all()
        value = np.asarray(found.value)
        np.testing.assert_allclose((model.host.matrix @ value)[row], value, atol=1e-12)


def test_the_widest_shapes_are_split_into_trees():
    many = schedule.Nodes(
        1,
        np.zeros(9, int),
        np.arange(9),
        np.repeat(np.arange(9), 23),
        np.full(207, schedule.ONE),
        np.arange(207),
    )
    found = schedule.schedule(many, 207, 208)
    total = np.zeros(found.size + 3)
    total[found.size] = 1
    numbers = np.append(np.ones(207), [1, 0])
    numbers[3 * 23] = 5
    segment = found.segments[0]
    size = segment.target.shape[-1]
    for c in range(segment.target.shape[0]):
        image = (numbers[segment.source[c]] * total[segment.target[c]]).sum(1)
        total[c * size : (c + 1) * size] = image.max(0)
    assert total[found.place[0]] == 27


# --- slopes -------------------------------------------------------------------------------------


def fourth_order(f, x, along, h):
    return (
        8 * (f(x + h * along) - f(x - h * along)) - (f(x + 2 * h * along) - f(x - 2 * h * along))
    ) / (12 * h)


@pytest.mark.few(1)
@pytest.mark.parametrize(("seed", "objective"), cases((1, "max"), (0, "policy"), seeds=4))
def test_slopes_are_those_of_differences(seed, objective):
    rng, model, target, _, reward = random_case(seed, "reward")
    model, reward = escaping(model, np.ones(model.num_rows, int)), reward + 0.1
    prepared = prepare(model, target, reward=reward, objective=objective)
    row, state = jnp.asarray(model.host.row), jnp.asarray(model.host.state)
    weigh = rng.random(SIZE)

    def normal(x, of, count):
        x = jnp.exp(x)
        return x / jax.ops.segment_sum(x, of, count)[of]

    def value(x):
        a, b, c = jnp.split(x, np.cumsum([row.size, state.size]))
        given = {"policy": normal(c, state, SIZE)} if objective == "policy" else {}
        found = solve_prepared(
            prepared, probability=normal(a, row, state.size), reward=b, tolerance=1e-11, **given
        )
        return found.value @ weigh

    x = np.concatenate([np.log(model.probability), reward, rng.normal(size=state.size)])
    along = rng.normal(size=x.size)

    @jax.jit
    def derivatives(x):
        """The value, its change on the way and its slope, of one linear program."""
        found, forward = jax.linearize(value, x)
        return found, forward(along), *jax.linear_transpose(forward, x)(1.0)

    expected = fourth_order(lambda x: derivatives(x)[0], x, along, 1e-3)
    _, forward, slope = jax.tree.map(np.asarray, derivatives(x))
    backward = slope @ along
    np.testing.assert_allclose(forward, expected, rtol=1e-7)
    np.testing.assert_allclose(backward, forward, rtol=1e-9)
    if objective == "policy":
        slopes = np.asarray(jax.jit(jax.vmap(jax.grad(value)))(np.stack([x, x])))
        np.testing.assert_allclose(slopes[1] @ along, backward, rtol=1e-9)


# --- what is not as it must be ------------------------------------------------------------------


@pytest.fixture(scope="module")
def walk():
    """0 and 4 stay; the others go up or down, by chance."""
    start = [0, 1, 3, 5, 7, 8]
    model = make_sparse(None, start, [0, 0, 2, 1, 3, 2, 4, 4], [1, *[0.5] * 6, 1])
    return model, np.arange(5) == 4


@pytest.mark.slow
def test_other_numbers_are_judged(walk):
    model, target = walk
    prepared = prepare(model, target)
    lanes = np.tile(model.probability, (6, 1))
    lanes[1:, 1] = 0, -0.5, 0.6, np.nan, np.inf
    found = jax.vmap(lambda x: solve_prepared(prepared, probability=x))(lanes)
    assert found.status.tolist() == [
        Status.CONVERGED,
        *[Status.INVALID] * 3,
        *[Status.NONFINITE] * 2,
    ]
    assert np.isnan(found.value[1:]).all() and np.isinf(found.upper[1:]).all()
    np.testing.assert_allclose(found.value[0], np.arange(5) / 4, atol=1e-6)


@pytest.mark.slow
def test_other_rewards_are_judged(walk):
    model, target = walk
    prepared = prepare(model, target | (np.arange(5) == 0), reward=[0, 1, 0, 1, 0])
    lanes = np.tile([0, 2.0, 0, 3, 0], (5, 1))
    lanes[1, 2] = 1
    lanes[2:, 1] = -1, np.nan, np.inf
    found = jax.vmap(lambda x: solve_prepared(prepared, reward=x))(lanes)
    assert found.status.tolist() == [
        Status.CONVERGED,
        *[Status.INVALID] * 2,
        *[Status.NONFINITE] * 2,
    ]
    np.testing.assert_allclose(found.value[0], [0, 4.5, 5, 5.5, 0], atol=1e-5)
    endless = prepare(model, target, reward=[0, 1.0, 0, 1, 0])
    assert np.asarray(solve_prepared(endless).value).tolist() == [*[np.inf] * 4, 0]


def test_policies_are_judged():
    model = make_sparse([0, 2, 3], [0, 1, 2, 3], [0, 1, 1], [1, 1, 1])
    prepared = prepare(model, [False, True], objective="policy")
    actions = np.array([[0, 0], [1, 0], [2, 0]])
    weights = np.array([[0.5, 0.5, 1], [0.5, 0.6, 1], [-1, 2, 1], [np.nan, 0.5, 1]])
    for policies, statuses, values in (
        (actions, "CONVERGED CONVERGED INVALID", [0, 1, np.nan]),
        (weights, "CONVERGED INVALID INVALID NONFINITE", [1, np.nan, np.nan, np.nan]),
    ):
        found = jax.vmap(lambda x: solve_prepared(prepared, policy=x))(policies)
        assert found.status.tolist() == [Status[x] for x in statuses.split()]
        np.testing.assert_equal(np.asarray(found.value[:, 0]), values)


def test_what_takes_too_long_is_not_called_converged(walk):
    model, target = walk
    prepared = prepare(model, target)
    found = solve_prepared(prepared, max_steps=3)
    assert int(found.status) == Status.MAX_STEPS
    exact = np.arange(5) / 4
    assert (np.asarray(found.lower) <= exact).all() and (exact <= np.asarray(found.upper)).all()
    found = solve_prepared(prepared, tolerance=1e-17, max_steps=300)
    assert int(found.status) != Status.CONVERGED
    assert (np.asarray(found.lower) <= exact).all() and (exact <= np.asarray(found.upper)).all()


def test_wrong_arguments_are_named(walk):
    model, target = walk
    prepared = prepare(model, target)
    for text, run in (
        ("objective='least'", partial(prepare, model, target, objective="least")),
        ("target has shape", partial(prepare, model, target[:3])),
        ("stay has shape", partial(prepare, model, target, stay=target[:3])),
        ("leave stay out", partial(prepare, model, target, stay=target, reward=np.ones(5))),
        ("state 2, choice 0 is -1", partial(prepare, model, target, reward=[0, 0, -1, 0, 0])),
        ("state 1, choice 0 is inf", partial(prepare, model, target, reward=[0, np.inf, 0, 0, 0])),
        ("probability has shape", partial(solve_prepared, prepared, probability=np.ones(3))),
        ("prepare it with a reward", partial(solve_prepared, prepared, reward=np.ones(5))),
        ("not 'max'", partial(solve_prepared, prepared, policy=np.arange(5))),
        ("call it before jit", lambda: jax.jit(lambda x: prepare(model, x).place)(target)),
    ):
        with pytest.raises(ValueError, match=text):
            run()
    many = make_sparse([0, 2, 3], [0, 1, 2, 3], [0, 1, 1], [1, 1, 1])
    with pytest.raises(ValueError, match="give one"):
        solve_prepared(prepare(many, [False, True], objective="policy"))
    with pytest.raises(ValueError, match="policy has shape"):
        solve_prepared(prepare(many, [False, True], objective="policy"), policy=np.ones(5))


def test_single_precision_encloses_too():
    for seed, objective, question in ((0, "max", "probability"), (1, "min", "reward")):
        _, model, target, stay, reward = random_case(seed, question)
        with jax.enable_x64(False):
            prepared = prepare(model, target, stay=stay, reward=reward, objective=objective)
            found = solve_prepared(prepared)
            assert found.value.dtype == np.float32
        agree(found, by_host(model, target, stay, reward, objective == "max"), 1e-3)
