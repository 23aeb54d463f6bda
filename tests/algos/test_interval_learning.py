"""Learning by intervals: what the graph decides, what the intervals say, and what it comes to."""

from functools import cache, partial

import jax
import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

import jaxltl as jl
from jaxltl.algos import interval_learning as learning
from jaxltl.algos.common import loops
from jaxltl.core.models.game import make_game
from jaxltl.core.models.interval import make_interval
from jaxltl.core.statistics.confidence_sets import intervals_from_counts
from jaxltl.core.types import Status
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)
from tests import reference
from tests.algos.cases import LearnerCase, world
from tests.support import as_mdp, counted_traces, lane, nature_word

S, A, K = 6, 2, 3
TASKS = ("F a & G !b", "G F a & G F b", "F G a | G F b")


def random_world(rng):
    return as_mdp(
        reference.random_model(rng, S, A, K),
        label=rng.random((S, 2)) < 0.4,
        propositions=["a", "b"],
    )


@cache
def worlds(number):
    """Worlds of all four letters, for one program; none decides all tasks by its graph."""
    rng, found = np.random.default_rng(0), []
    while len(found) < number:
        world = random_world(rng)
        if len(np.unique(np.asarray(world.label), axis=0)) < 4:
            continue
        open_ = [~(p.winning | p.losing) for p in (learning.make_problem(world, t) for t in TASKS)]
        if sum(bool(x.any()) for x in open_) >= 2:
            found.append(world)
    return found


def settings(kind="linear", **changed):
    return learning.Hparams(intervals=kind, **{"num_runs": 4, "length": 16, **changed})


@cache
def on_the_way(task, kind, i, sweeps=20):
    """A problem, its settings and the states after each of some steps."""
    problem, hparams = learning.make_problem(worlds(3)[i], task), settings(kind, sweeps=sweeps)
    return problem, hparams, _states(jax.random.key(i), problem, hparams)


@jax.jit
def _states(key, problem, hparams):
    def body(state, _):
        state, metrics = learning.step(state, problem, hparams)
        return state, (state, metrics)

    return jax.lax.scan(body, learning.init(key, problem, hparams), length=40)[1]


# --- what the graph decides ---------------------------------------------------------------------


def wins(problem, play):
    """Whether all strong components without a way out, where the task is won, are accepted."""
    model = problem.model
    world, step = model.mdp, np.asarray(model.next_memory)
    size, width = step.size, step.shape[1]
    edge = np.zeros((size, size), bool)
    used = np.asarray(play) > 0
    for s, q, a in np.argwhere(used):
        for t, p in zip(
            np.asarray(world.successor)[s, a], np.asarray(world.probability)[s, a], strict=True
        ):
            if p > 0:
                edge[s * width + q, t * width + step[s, q]] = True
    won = np.asarray(problem.winning).ravel()
    if not used.reshape(size, -1).any(-1)[won].all() or edge[won][:, ~won].any():
        return False
    priority = np.asarray(model.automaton.priority)[:, np.asarray(model.letter)].T.ravel()
    _, label = connected_components(edge, directed=True, connection="strong")
    for i in np.unique(label[won]):
        inside = label == i
        if not edge[inside][:, ~inside].any() and priority[inside].min() % 2:
            return False
    return True


@pytest.mark.few(1)
@pytest.mark.parametrize("task", TASKS)
def test_every_policy_on_the_way_wins_almost_surely(task):
    """Where that is possible: those that are sampled, and those that are learned."""
    rng, refused = np.random.default_rng(1), 0
    for i in range(3):
        problem, hparams, (states, _) = on_the_way(task, "linear", i)
        sure = np.asarray(optimal_satisfaction(problem.model).lower) == 1
        np.testing.assert_array_equal(problem.winning, sure)
        allowed = np.asarray(problem.allowed)
        for number in (0, 1, 2, 5, 39):
            state = lane(states, number)
            for play in (
                np.asarray(learning.behavior(state, problem, hparams)),
                np.asarray(learning.policy(state, problem, hparams)),
            ):
                np.testing.assert_allclose(play.sum(-1), 1, rtol=1e-6)
                assert (~(play > 0) | allowed).all()
                assert wins(problem, play)
                assert learning.wins_almost_surely(problem, play)
            assert (np.asarray(learning.behavior(state, problem, hparams)) > 0)[allowed].all()
        for _ in range(10):
            some = np.asarray(problem.model.available) & (rng.random(problem.allowed.shape) < 0.7)
            refused += not wins(problem, some)
            assert learning.wins_almost_surely(problem, some.astype(float)) == wins(problem, some)
    assert refused > 3


def test_a_risk_is_not_taken_where_there_is_a_sure_way():
    world = jl.make_mdp(
        [[[1, 2], [0, 1]], [[1, 0], [1, 0]], [[2, 0], [2, 0]]],
        [[[0.9, 0.1], [0.9, 0.1]], [[1, 0], [1, 0]], [[1, 0], [1, 0]]],
        initial=[1, 0, 0],
        label=[[0], [1], [0]],
        propositions=["home"],
    )
    problem = learning.make_problem(world, "F home")
    state, metrics = learning.train(
        jax.random.key(0), problem, settings(exploration=1.0), num_steps=5
    )
    counts, metrics = np.asarray(state.counts), jax.tree.map(np.asarray, metrics)
    assert counts[0, 0].tolist() == [0, 0]
    assert counts[0, 1].sum() > 20 and counts.sum() == 5 * 4 * 16
    assert metrics.lower[-1] == metrics.upper[-1] == 1
    assert not learning.wins_almost_surely(problem, np.full(problem.allowed.shape, 0.5))


def test_where_a_task_is_won_only_what_may_be_done_for_ever_is_done():
    """Each of two states can be left for the other, but for ever only one may be kept to."""
    world = jl.make_mdp(
        [[[0], [1]], [[0], [1]]],
        np.ones((2, 2, 1)),
        initial=[0.5, 0.5],
        label=[[1, 0], [0, 0]],
        propositions=["a", "b"],
    )
    problem = learning.make_problem(world, "F G a | G F b")
    assert np.asarray(problem.winning).all()
    state = learning.init(jax.random.key(0), problem, settings())
    for play in (
        learning.behavior(state, problem, settings()),
        learning.policy(state, problem, settings()),
    ):
        assert wins(problem, play) and learning.wins_almost_surely(problem, play)
    assert not wins(problem, np.ones(problem.allowed.shape))
    assert not learning.wins_almost_surely(problem, np.full(problem.allowed.shape, 0.5))


@pytest.mark.slow
def test_who_may_stay_has_the_value_of_the_best_way_out():
    """Two states in a circle, one of which has a risky way home; and values once too high."""
    world = jl.make_mdp(
        [[[1, 0], [1, 0]], [[0, 0], [2, 3]], [[2, 0], [2, 0]], [[3, 0], [3, 0]]],
        [[[1, 0], [1, 0]], [[1, 0], [0.7, 0.3]], [[1, 0], [1, 0]], [[1, 0], [1, 0]]],
        initial=[1, 0, 0, 0],
        label=[[0], [0], [1], [0]],
        propositions=["home"],
    )
    problem, hparams = learning.make_problem(world, "F home"), settings()
    state, metrics = learning.train(jax.random.key(0), problem, hparams, num_steps=60)
    q = int(problem.model.automaton.initial)
    for value, end in ((state.pessimistic, state.lower), (state.optimistic, state.upper)):
        np.testing.assert_allclose(np.asarray(value)[:2, q], np.asarray(end)[1, 1, 0], rtol=1e-6)
    metrics = jax.tree.map(np.asarray, metrics)
    assert 0.6 < metrics.lower[-1] < metrics.upper[-1] < 0.8
    play = learning.policy(state, problem, hparams)
    reached = np.asarray(satisfaction_probability(problem.model, play).value)
    np.testing.assert_allclose(reached[0, q], 0.7, rtol=1e-6)


# --- samples ------------------------------------------------------------------------------------


def test_samples_are_of_the_world():
    problem, _, (states, _) = on_the_way(TASKS[0], "linear", 0)
    counts = np.asarray(lane(states, 39).counts)
    np.testing.assert_array_equal(np.asarray(states.samples), 64 * np.arange(1, 41))
    assert counts.sum() == 40 * 64
    probability = np.asarray(problem.model.mdp.probability)
    assert (counts[probability == 0] == 0).all()
    total = counts.sum(-1)
    assert (total > 30).sum() >= 4
    spread = np.sqrt(probability * (1 - probability) / np.maximum(total, 1)[..., None])
    off = np.abs(counts / np.maximum(total, 1)[..., None] - probability)
    assert (off <= 4.5 * spread + 1e-9)[total > 0].all()


def test_counters_end_before_they_are_full():
    problem, hparams, (states, _) = on_the_way(TASKS[0], "linear", 0)
    last = lane(states, 39).replace(samples=np.int32(loops.MAX_STEPS - 70))
    step = jax.jit(learning.step)
    state, metrics = step(last, problem, hparams)
    assert state.samples == loops.MAX_STEPS - 6 and metrics.status == Status.MAX_STEPS
    after, metrics = step(state, problem, hparams)
    assert after.samples == state.samples and metrics.status == Status.MAX_STEPS
    np.testing.assert_array_equal(after.counts, state.counts)
    np.testing.assert_array_equal(after.lower, state.lower)


# --- intervals ----------------------------------------------------------------------------------


def test_linear_intervals_follow_their_rule():
    problem, hparams, (states, _) = on_the_way(TASKS[0], "linear", 0)
    used = np.asarray(problem.model.mdp.probability) > 0
    start = learning.init(jax.random.key(0), problem, hparams)
    lower, upper = (np.array(x, float) for x in (start.lower, start.upper))
    weak, strong = (np.full(used.shape[:2], x) for x in (5.0, 10.0))
    agreed, denied = 0, 0
    for n in range(40):
        before = 0 if n == 0 else np.asarray(lane(states, n - 1).counts)
        new = np.asarray(lane(states, n).counts) - before
        for s, a in np.argwhere(new.sum(-1) > 0):
            k = used[s, a]
            if k.sum() < 2:
                continue
            count = new[s, a, k]
            total, share = count.sum(), count / count.sum()
            for ends, good in ((lower, share >= lower[s, a, k]), (upper, share <= upper[s, a, k])):
                strength = strong[s, a] if good.all() else weak[s, a]
                ends[s, a, k] = (strength * ends[s, a, k] + count) / (strength + total)
                agreed, denied = agreed + good.all(), denied + (not good.all())
            weak[s, a] += total
            strong[s, a] += total
        np.testing.assert_allclose(lane(states, n).lower, lower, atol=1e-9)
        np.testing.assert_allclose(lane(states, n).upper, upper, atol=1e-9)
    assert min(agreed, denied) > 20


def test_intervals_with_a_confidence_hold_those_of_any_time_and_only_shrink():
    problem, _, (states, _) = on_the_way(TASKS[0], "confidence", 0)
    used = np.asarray(problem.model.mdp.probability) > 0
    low, high = np.zeros(used.shape), np.ones(used.shape)
    for n in range(40):
        state = lane(states, n)
        sets = intervals_from_counts(np.asarray(state.counts), 0.9, method="anytime", used=used)
        assert sets.num_claims == problem.num_claims
        low, high = np.maximum(low, sets.lower), np.minimum(high, sets.upper)
        assert (np.asarray(state.lower) <= np.maximum(low, 1e-4) + 1e-9)[used].all()
        assert (np.asarray(state.upper) >= high - 1e-4 - 1e-9)[used].all()
    seen = (np.asarray(state.counts).sum(-1) > 100)[..., None] & used
    assert seen.any()
    width = (np.asarray(state.upper) - np.asarray(state.lower))[seen]
    best = (sets.upper - sets.lower)[seen]
    assert np.mean(width) < 1.6 * np.mean(best)


def test_frequencies_that_are_rounded_beyond_one_make_no_nan():
    shares = np.array([-3e-16, 0.0, 0.5, 1.0, 1 + 3e-16])
    ends = np.asarray(jax.jit(learning._kl_lower_end)(shares, 0.01))
    assert (ends[:2] == 0).all() and (ends[3:] > 0.9).all() and 0.4 < ends[2] < 0.45


# --- values -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_settled_values_are_the_robust_values_of_the_intervals(task):
    """By another solver, from all states; from values of other intervals, 40 steps on end."""
    for i in range(3):
        problem, _, (states, metrics) = on_the_way(task, "linear", i, sweeps=1000)
        model = problem.model
        assert np.asarray(metrics.status)[39] == Status.COMPLETED
        for number in (0, 39):
            state = lane(states, number)
            intervals = make_interval(model.mdp, state.lower, state.upper)
            for nature, value in (("min", state.pessimistic), ("max", state.optimistic)):
                exact = optimal_satisfaction(
                    intervals,
                    model.automaton,
                    nature=nature_word("max", nature),
                    states=np.arange(S),
                )
                np.testing.assert_allclose(
                    np.asarray(value)[:, int(model.automaton.initial)],
                    exact.value,
                    atol=2e-3,
                )


@pytest.mark.slow
@pytest.mark.parametrize("kind", learning.INTERVALS)
def test_values_come_near_the_optimum(kind):
    for i in range(3):
        problem, hparams, (states, metrics) = on_the_way(TASKS[0], kind, i)
        start = np.asarray(problem.model.initial)
        best = np.sum(start * np.asarray(optimal_satisfaction(problem.model).value))
        lower, upper = np.asarray(metrics.lower), np.asarray(metrics.upper)
        if kind == "confidence":
            assert (lower <= best + 1e-9).all() and (upper >= best - 1e-9).all()
            assert (np.diff(lower) >= -1e-9).all() and (np.diff(upper) <= 1e-9).all()
        long, metrics = learning.run(lane(states, 39), problem, hparams, num_steps=2000, max_rows=1)
        (lower,), (upper,) = np.asarray(metrics.lower), np.asarray(metrics.upper)
        assert upper - lower < 0.08
        assert abs(lower - best) < 0.08
        play = learning.policy(long, problem, hparams)
        reached = np.sum(start * np.asarray(satisfaction_probability(problem.model, play).value))
        assert reached > best - 0.02


@pytest.mark.slow
def test_guarantees_hold_and_come_near():
    """Data that were drawn by what they said; at most one in ten may fail."""
    failed, gaps = 0, []
    for i in range(3):
        for task in TASKS:
            problem, _, (states, _) = on_the_way(task, "linear", i)
            start = np.asarray(problem.model.initial)
            best = np.sum(start * np.asarray(optimal_satisfaction(problem.model).value))
            bounds = []
            for number in (0, 9, 39):
                state = lane(states, number)
                found = learning.guarantee(state, problem, 0.9)
                assert found.sets.num_samples.sum() == state.samples
                failed += found.bound > best + 1e-6 or found.optimistic < best - 1e-6
                bounds.append(best - found.bound)
            gaps.append(bounds)
    assert failed <= 2
    assert np.mean(gaps, 0)[2] < np.mean(gaps, 0)[0]


# --- how it is called ---------------------------------------------------------------------------


def test_a_run_ends_when_values_are_known_well_enough():
    problem, hparams, _ = on_the_way(TASKS[0], "linear", 0)
    run = partial(learning.train_until, jax.random.key(0), problem, hparams, num_steps=4000)
    found = jl.check(run(until=learning.bounds_within(0.2)))
    assert found.metrics.upper - found.metrics.lower <= 0.2
    assert found.num_steps < 4000
    with counted_traces() as traced:
        later = run(until=learning.bounds_within(0.1))
    assert not traced
    assert later.num_steps >= found.num_steps


@pytest.mark.slow
def test_a_successor_that_stands_twice_is_one():
    world = jl.make_mdp(
        [[[1, 2, 1]], [[1, 0, 0]], [[2, 0, 0]]],
        [[[0.25, 0.5, 0.25]], [[1, 0, 0]], [[1, 0, 0]]],
        initial=[1, 0, 0],
        label=[[0], [1], [0]],
        propositions=["home"],
    )
    problem = learning.make_problem(world, "F home")
    state, _ = learning.train(jax.random.key(0), problem, settings(), num_steps=20)
    assert state.counts.shape == (3, 1, 2) and problem.num_claims == 1
    counts = np.asarray(state.counts)[0, 0]
    assert min(counts) > 0.3 * max(counts)


def test_what_makes_no_sense_is_refused():
    world = worlds(3)[0]
    with pytest.raises(ValueError, match="interval_learning plays alone"):
        learning.make_problem(make_game(world, np.arange(S) < 3), "F a")
    problem = learning.make_problem(world, "F a")
    for changed, message in (
        ({"kind": "wide"}, "intervals='wide'; choose"),
        ({"length": 0}, "length=0; it must be"),
        ({"num_runs": 0}, "num_runs=0; it must be"),
    ):
        with pytest.raises(ValueError, match=message):
            learning.init(jax.random.key(0), problem, settings(**changed))


# --- the laws of all learners ------------------------------------------------------------------


def intervals():
    """Slips that lose, beside tries that may be repeated."""
    problem = learning.make_problem(world()[0], "!r U g")
    setting = partial(learning.Hparams, num_runs=2, length=5)
    return LearnerCase(learning, problem, setting(), setting(strength=1.0, exploration=0.5))


CASES = {
    "intervals": intervals,
}
