"""Evaluations: sums beside whole episodes, coverage exactly and simulated, decisions, refusals."""

from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jax.sharding import NamedSharding, PartitionSpec
from jax.tree_util import Partial

from jaxltl.core.environments.environment import Timestep, make_environment
from jaxltl.core.environments.episodes import make_agent, run_episode, with_time_limit
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.statistics.binomial import anytime, clopper_pearson
from jaxltl.core.types import Status
from jaxltl.core.values.evaluation import evaluation
from jaxltl.core.values.evaluation.evaluation import episode_totals, evaluate

# --- a line with two ends, on which episodes end in all ways --------------------------------------

STEPS, DISCOUNT, NUMBER = 13, 0.8, 60


def line_reset(key):
    return jax.random.randint(key, (), 1, 4)


def line_step(place, action, key):
    noise, luck = jax.random.split(key)
    drift = jax.random.randint(noise, (), -1, 2)
    chance = jax.random.uniform(luck)
    return Timestep(
        jnp.clip(place + action - 1 + drift, 0, 4),
        place + 0.5,
        chance < 0.05,
        (chance < 0.1) | (chance > 0.97),
        action * 1.0,
        0.9,
    )


def line_observe(place):
    return place[None] / 4


def line_labels(place):
    return jnp.stack([place == 0, place == 4])


LINE = make_environment(
    line_reset,
    line_step,
    line_observe,
    actions=3,
    labels=line_labels,
    propositions=["home", "goal"],
)


def choose(observation, key):
    return jax.random.randint(key, (), 0, 3)


WANDERER = make_agent(choose)
ENVIRONMENTS = {
    "plain": LINE,
    "finite": task_environment(LINE, "!home U goal", ending="violated"),
    "infinite": with_time_limit(task_environment(LINE, "G F goal", ending="undecided"), 9),
}


@partial(jax.jit, static_argnames="num_steps")
def episodes(key, environment, agent, num_steps):
    keys = jax.vmap(partial(jax.random.fold_in, key))(jnp.arange(NUMBER))
    return jax.vmap(lambda k: run_episode(k, environment, agent, num_steps=num_steps))(keys)


def check_mean(estimate, x):
    np.testing.assert_allclose(estimate.mean, x.mean(), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        estimate.error, x.std(ddof=1) / np.sqrt(len(x)), rtol=1e-5, atol=1e-9
    )
    assert estimate.lower <= estimate.mean <= estimate.upper


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_figures_are_those_of_the_episodes(name):
    environment, key = ENVIRONMENTS[name], jax.random.key(3)
    found = evaluate(
        key,
        WANDERER,
        environment,
        num_episodes=NUMBER,
        num_steps=STEPS,
        discount=DISCOUNT,
        batch=16,
    )
    runs = jax.device_get(episodes(key, environment, WANDERER, STEPS))
    length = runs.valid.sum(1)
    check_mean(found.length, length)
    check_mean(found.reward, runs.reward.sum(1))
    check_mean(found.cost, runs.cost.sum(1))
    weight = np.cumprod(DISCOUNT * runs.discount, 1) / (DISCOUNT * runs.discount)
    check_mean(found.discounted_reward, (runs.reward * weight).sum(1))
    over = runs.terminated, runs.truncated & ~runs.terminated
    assert (found.terminated, found.truncated) == tuple(x.sum() for x in over)
    assert found.cut_off == NUMBER - sum(x.sum() for x in over)
    assert found.terminated > 3 and found.truncated > 2
    assert (found.num_episodes, found.num_steps) == (NUMBER, STEPS)
    assert found.status == Status.CONVERGED and found.decision is None
    if name == "plain":
        assert found.success is found.violation is found.undecided is found.visits is None
        assert found.discounted_visits is None and "success" not in str(found)
        return
    goal, home = runs.label[..., 1], runs.label[..., 0]
    read = np.arange(STEPS + 1) <= length[:, None]
    if name == "finite":
        at = {n: np.where(x.any(1), x.argmax(1), STEPS + 1) for n, x in (("g", goal), ("h", home))}
        won, lost = at["g"] < at["h"], (at["h"] < at["g"]) | runs.terminated
        shares = won, lost & ~won, ~won & ~lost
    else:
        shares = np.zeros(NUMBER, bool), np.zeros(NUMBER, bool), np.ones(NUMBER, bool)
        visits = goal & read
        check_mean(found.visits, visits.sum(1))
        check_mean(found.discounted_visits, visits @ DISCOUNT ** np.arange(STEPS + 1))
        assert found.visits.mean > 0.3
    for estimate, share in zip(
        (found.success, found.violation, found.undecided), shares, strict=True
    ):
        assert estimate.mean == share.mean() and estimate.method == "Clopper-Pearson"
        ends = clopper_pearson(np.array([share.sum()]), np.array([NUMBER]), 0.05)
        np.testing.assert_allclose((estimate.lower, estimate.upper), np.ravel(ends), atol=1e-12)
    if name == "finite":
        assert found.cut_off and min(x.sum() for x in shares)
    # Whatever the batch, even if it is larger than what is asked for.
    for batch in (7, 1000):
        assert found == evaluate(
            key,
            WANDERER,
            environment,
            num_episodes=NUMBER,
            num_steps=STEPS,
            discount=DISCOUNT,
            batch=batch,
        )


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, pytest.param(4, marks=pytest.mark.exhaustive)])
def test_episodes_over_devices_are_the_episodes(number):
    """Also where the devices do not divide a batch."""
    mesh = jax.make_mesh((number,), ("episodes",), devices=jax.devices()[:number])
    run = partial(
        evaluate,
        jax.random.key(3),
        WANDERER,
        ENVIRONMENTS["finite"],
        num_episodes=NUMBER,
        num_steps=STEPS,
        discount=DISCOUNT,
    )
    size, over = NUMBER // 2 + 1, NamedSharding(mesh, PartitionSpec("episodes"))
    assert run(batch=evaluation.Batch(size, over)) == run(batch=size)


def test_worlds_are_not_kept():
    """No array has an axis of the steps, so that memory does not grow with them."""
    shown = str(
        jax.make_jaxpr(
            lambda key: evaluation._batch(
                key,
                (ENVIRONMENTS["finite"], WANDERER),
                0,
                1.0,
                num_steps=977,
                batch=evaluation.Batch(16),
            )
        )(jax.random.key(0))
    )
    assert "[16]" in shown and "[977" not in shown and ",977" not in shown


def test_new_numbers_do_not_recompile():
    before = evaluation._batch._cache_size()
    for p in (0.2, 0.7):
        evaluate(jax.random.key(0), IDLE, coin(p), num_episodes=50, batch=50)
    evaluate(jax.random.key(1), IDLE, coin(0.4), num_episodes=50, batch=50, discount=0.5)
    assert evaluation._batch._cache_size() == before + 1


# --- a coin ---------------------------------------------------------------------------------------


class CoinWorld(NamedTuple):
    verdict: jax.Array
    accepted: jax.Array


def coin_reset(key):
    return CoinWorld(jnp.int32(Verdict.UNDECIDED), jnp.bool_(False))


def coin_step(chance, world, action, key):
    heads = jax.random.uniform(key) < chance
    verdict = jnp.where(heads, Verdict.SATISFIED, Verdict.VIOLATED)
    return Timestep(CoinWorld(verdict.astype(jnp.int32), heads), heads * 1.0, True)


def nothing(world):
    return jnp.zeros(1)


def stay(observation, key):
    return jnp.int32(0)


IDLE = make_agent(stay)
COIN = make_environment(
    coin_reset, Partial(coin_step, jnp.asarray(0.5)), nothing, actions=1, horizon=1
)


def coin(chance):
    """An episode of one step, and a success with a chance."""
    return replace(COIN, step=Partial(coin_step, jnp.asarray(chance)))


CHANCES = (0.001, 0.03, 0.5, 0.9, 0.999)


@pytest.mark.parametrize("chance", CHANCES)
@pytest.mark.parametrize("confidence", [0.8, 0.95])
def test_exact_intervals_cover(chance, confidence):
    """The chance of all counts whose interval holds the true chance, summed up."""
    for total in (1, 10, 137):
        count = np.arange(total + 1)
        mass = scipy.stats.binom(total, chance).pmf(count)
        ends = [evaluation.frequency_estimate(k, total, 1 - confidence) for k in count.tolist()]
        held = [x.lower <= chance <= x.upper for x in ends]
        assert mass @ held >= confidence - 1e-12
        assert held[round(total * chance)]


@pytest.mark.parametrize("chance", CHANCES)
@pytest.mark.parametrize("threshold", [0.1, 0.5, 0.95])
def test_intervals_where_the_simulation_stops_cover(chance, threshold):
    """All ways in which an evaluation can go, batch by batch, by the counts' exact chances."""
    batch, most, confidence = 16, 320, 0.8
    count, mass = np.arange(1), np.ones(1)
    covered = wrong = 0.0
    step = scipy.stats.binom(batch, chance).pmf(np.arange(batch + 1))
    for total in range(batch, most + 1, batch):
        count = np.arange(total + 1)
        mass = np.convolve(mass, step)
        lower, upper = anytime(count, np.full(total + 1, total), 1 - confidence)
        decided = np.where(lower >= threshold, 1, np.where(upper < threshold, -1, 0))
        for k in (0, total // 3, total):  # the rule that is used
            said = evaluation._decided(int(k), total, threshold, 1 - confidence)
            assert said is {1: True, -1: False, 0: None}[int(decided[k])]
        ends = (decided != 0) | (total == most)
        covered += mass[ends & (lower <= chance) & (chance <= upper)].sum()
        wrong += mass[ends & (decided == (1 if chance < threshold else -1))].sum()
        mass = np.where(ends, 0, mass)
    assert mass.sum() == 0
    assert covered >= confidence and wrong <= 1 - confidence


@pytest.mark.few(1, 3)
@pytest.mark.parametrize("number", [200, pytest.param(10_000, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("chance", CHANCES)
@pytest.mark.parametrize("threshold", [None, 0.9])
def test_simulated_evaluations_cover(number, chance, threshold, monkeypatch):
    """At least the nominal share; of few evaluations but for chance.

    All episodes of all evaluations are simulated at once, and then handed out batch by batch.
    """
    environment, batch, most = coin(chance), 64, 192
    run = jax.jit(
        lambda first: jax.vmap(
            lambda seed: evaluation._batch(
                jax.random.key(seed),
                (environment, IDLE),
                0,
                1.0,
                num_steps=1,
                batch=evaluation.Batch(most),
            )
        )(first + jnp.arange(200))
    )
    parts = [jax.device_get(run(first)) for first in range(0, number, 200)]
    every = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    plain = evaluate(
        jax.random.key(1), IDLE, environment, num_episodes=most, batch=batch, threshold=threshold
    )

    def handed(key, players, first, discount, *, num_steps, batch):
        begin = int(first)
        return jax.tree.map(lambda x: x[seed, begin : begin + batch.size], every)

    monkeypatch.setattr(evaluation, "_batch", handed)
    for name in ("frequency_estimate", "_decided"):  # of few counts, many times
        monkeypatch.setattr(evaluation, name, cache(getattr(evaluation, name)))
    covered = wrong = decided = spent = 0
    for seed in range(number):
        found = evaluate(
            jax.random.key(0),
            IDLE,
            environment,
            num_episodes=most,
            batch=batch,
            threshold=threshold,
        )
        covered += found.success.lower <= chance <= found.success.upper
        decided += found.decision is not None
        wrong += found.decision is not None and found.decision != (chance >= 0.9)
        spent += found.num_episodes
        if seed == 1:
            assert found == plain
    slack = 0 if number > 1000 else 3 * np.sqrt(0.05 * 0.95 / number)
    assert covered >= (0.95 - slack) * number
    assert wrong <= (0.05 + slack) * number
    if threshold is not None and chance < 0.6:
        assert spent == batch * number and decided == number  # one batch tells
    print(
        f"{chance=} {threshold=} covered={covered / number} decided={decided / number} "
        f"wrong={wrong / number} episodes={spent / number}"
    )


# --- thresholds -----------------------------------------------------------------------------------


def test_a_threshold_ends_the_simulation_when_it_is_decided():
    above, below, between = (
        evaluate(jax.random.key(0), IDLE, coin(chance), threshold=0.9, num_episodes=2000, batch=100)
        for chance in (0.99, 0.5, 0.9)
    )
    assert above.decision is True and above.success.lower >= 0.9
    assert 100 <= above.num_episodes < 500
    assert below.decision is False and below.success.upper < 0.9 and below.num_episodes == 100
    assert between.decision is None and between.num_episodes == 2000
    assert [x.status for x in (above, below, between)] == [
        Status.CONVERGED,
        Status.CONVERGED,
        Status.MAX_STEPS,
    ]
    for found, text in ((above, "success is at"), (below, "is not at"), (between, "open whether")):
        assert text in str(found) and "at any time" in found.success.method
        assert "at any time" in found.visits.method


def test_a_table_tells_it_all():
    found = evaluate(jax.random.key(0), IDLE, coin(0.5), num_episodes=50, batch=50, discount=0.5)
    rows = str(found).splitlines()
    assert rows[0].startswith("50 episodes of at most 1 steps")
    assert [row.split()[0] for row in rows[1:]] == [
        "success",
        "violation",
        "undecided",
        "reward",
        "discounted",
        "cost",
        "length",
        "visits",
        "discounted",
        "ended:",
    ]
    # Columns begin at the same place, behind two spaces at least.
    assert len({row.index(" [") for row in rows[1:-1]}) == 1
    assert all(row[row.index("]") + 1 :].startswith("  ") for row in rows[1:-1])
    assert found.length.lower == found.length.upper == 1
    # A visit is one after the first reading.
    assert found.discounted_visits.mean == 0.5 * found.visits.mean == 0.5 * found.success.mean


def test_sums_that_are_not_finite_are_told():
    def step(world, action, key):
        return Timestep(world, jnp.where(jax.random.uniform(key) < 0.2, jnp.inf, 1.0), True)

    world = make_environment(lambda key: jnp.zeros(1), step, lambda w: w, actions=1, horizon=1)
    found = evaluate(jax.random.key(0), IDLE, world, num_episodes=50)
    assert found.status == Status.NONFINITE and not np.isfinite(found.reward.mean)
    assert "not finite" in str(found)


# --- refusals -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_steps": None}, "episodes that never end: .* with_time_limit"),
        ({"num_steps": 0}, "num_steps=0; it must be at least 1"),
        ({"num_episodes": 0}, "num_episodes=0"),
        ({"batch": 0}, "batch=0"),
        ({"confidence": 1.0}, "confidence=1.0; it must be above 0 and below 1"),
        ({"threshold": 0.9}, "threshold=0.9, but the environment has no task"),
        ({"discount": 1.5}, "discount=1.5"),
        ({"agent": choose}, "agent is function; give an Agent"),
        ({"agent": make_agent(lambda seen, key: seen)}, r"the agent's action is .*1"),
    ],
)
def test_what_does_not_fit_is_refused(change, message):
    given = {"agent": WANDERER, "num_steps": 3, "num_episodes": 5} | change
    with pytest.raises(ValueError, match=message):
        evaluate(jax.random.key(0), environment=LINE, **given)


def test_an_agent_may_be_of_a_plain_function():
    agent = replace(WANDERER, act=lambda memory, seen, allowed, key: (jnp.int32(1), memory))
    found = evaluate(jax.random.key(0), agent, LINE, num_episodes=9, num_steps=2)
    assert found.num_episodes == 9


def test_totals_of_one_episode_under_jit():
    totals = jax.jit(partial(episode_totals, num_steps=4))(jax.random.key(0), LINE, WANDERER)
    assert totals.verdict is None and 1 <= totals.length <= 4
