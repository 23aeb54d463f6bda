"""The constrained cross-entropy method: its statistics, its guarantees, and a problem solved."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.algos import cce
from jaxltl.algos.cce import Hparams, Polynomial
from jaxltl.algos.cce import exponential_family as ef
from jaxltl.algos.cce import state as elites_of
from jaxltl.algos.common.schedules import theorem_conditions
from jaxltl.core.types import Status
from tests.algos.cases import LearnerCase
from tests.support import counted_traces, lane

TARGET = jnp.array([2.0, 1.0])


def quadratic(x, key):
    """The nearest point to (2, 1) in the half-plane x + y <= 1, which is (1, 0)."""
    del key
    return -jnp.sum((x - TARGET) ** 2), jnp.sum(x)


def noisy(x, key):
    """The same, seen through noise of standard deviation 1/2."""
    objective, cost = quadratic(x, key)
    a, b = 0.5 * jax.random.normal(key, (2,))
    return objective + a, cost + b


def impossible(x, key):
    return x[0], 3.0 + x[0] ** 2


def start(std=1.0, dimensions=2):
    return ef.diagonal_gaussian(jnp.zeros(dimensions), std)


def problem(evaluate=quadratic, **options):
    return cce.make_problem(evaluate, start(), **{"limit": 1.0, **options})


# Compiling is what costs here, so what is run a few times is hardly optimised.
QUICK = {"xla_backend_optimization_level": 0}
quick_run = jax.jit(cce.run, static_argnames="num_steps", compiler_options=QUICK)
quick_step = jax.jit(cce.step, compiler_options=QUICK)


def searched(given, hparams, num_steps=60, seed=0):
    state = cce.init(jax.random.key(seed), given, hparams)
    return quick_run(state, given, hparams, num_steps=num_steps)


def found(given, hparams=None, num_steps=60, seed=0, **options):
    hparams = Hparams() if hparams is None else hparams
    state, _ = searched(given, hparams, num_steps, seed)
    return cce.result(jax.random.key(99), state, given, hparams, **options)


# --- elites and weights -----------------------------------------------------------------------

select = jax.jit(elites_of.select, static_argnames="num")
elite_weights = jax.jit(elites_of.elite_weights, static_argnames="weighting")


def slow_elites(objective, cost, limit, k, scale=1.0):
    """Algorithm 2, steps 7 to 10, by stable sorting; and whether the objective decided."""
    usable = ~(np.isnan(objective) | (objective == np.inf) | np.isnan(cost).any(1))
    excess = ((cost - limit) / scale).max(1)
    feasible = [i for i in range(len(cost)) if usable[i] and (cost[i] <= limit).all()]
    if len(feasible) >= k:
        return sorted(feasible, key=lambda i: -objective[i])[:k], True
    return sorted(np.flatnonzero(usable), key=lambda i: excess[i])[:k], False


def test_elites_are_those_of_the_algorithm():
    """Many ties, NaN and infinite numbers, one constraint and several."""
    rng = np.random.default_rng(0)
    choices = np.array([-np.inf, -1.0, -0.0, 0.0, 1.0, np.nan, np.inf])
    likely = [0.05, 0.25, 0.15, 0.15, 0.3, 0.05, 0.05]
    cases = set()
    for num_costs in (1, 3):
        choose = jax.jit(partial(elites_of.select, num=5))
        limit, scale = np.zeros(num_costs), np.arange(1.0, num_costs + 1)
        for _ in range(150):
            objective = rng.choice(choices, 12, p=likely)
            cost = rng.choice(choices, (12, num_costs), p=likely) + (rng.random() < 0.4)
            cost = np.where(cost == -np.inf, 0.5, cost)
            objective[rng.random(12) < rng.choice([0.0, 0.8])] = np.nan
            k = int(rng.integers(1, 6))
            expected, enough = slow_elites(objective, cost, limit, k, scale)
            chosen = choose(objective, cost, limit, count=k, scale=scale)
            taken = np.asarray(chosen.index)[np.asarray(chosen.taken)]
            assert taken.tolist() == [int(i) for i in expected]
            assert bool(chosen.enough_feasible) == enough
            cases.add((num_costs, enough, len(expected) == k))
    assert len(cases) >= 5, "both cases, and too few that can be used"


def test_fewer_than_k_feasible_are_ranked_by_their_violation():
    cost = np.array([[0.5], [0.0], [3.0], [0.2], [-1.0]])
    objective = np.array([9.0, 0.0, 99.0, 5.0, -9.0])
    chosen = select(objective, cost, np.zeros(1), num=3)
    assert chosen.index.tolist() == [4, 1, 3]
    assert not chosen.enough_feasible
    assert chosen.feasible.tolist() == [False, True, False, False, True]


def test_several_constraints_count_by_the_largest_normalised_violation():
    cost = np.array([[12.0, 0.0], [0.0, 1.5], [30.0, -5.0]])
    chosen = select(np.zeros(3), cost, np.array([10.0, 1.0]), num=3, scale=np.array([10.0, 1.0]))
    np.testing.assert_allclose(chosen.excess, [0.2, 0.5, 2.0])
    assert chosen.index.tolist() == [0, 1, 2]
    given = cce.make_problem(lambda x, key: (x[0], x), start(), limit=[10.0, 0.0])
    assert given.scale.tolist() == [10.0, 1.0]


def test_of_equals_the_earlier_is_taken():
    chosen = select(np.ones(6), np.zeros((6, 1)), np.zeros(1), num=2)
    assert chosen.index.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("weighting", "enough", "expected"),
    [
        ("until_feasible", False, [1, 1, 1, 0]),
        ("until_feasible", True, [4, 2, 1, 0]),
        ("literal", False, [4, 2, 1, 0]),
        ("literal", True, [4, 2, 1, 0]),
        ("uniform", True, [1, 1, 1, 0]),
    ],
)
@pytest.mark.parametrize("shift", [0.0, 1e5, -1e5])
def test_weights(weighting, enough, expected, shift):
    """exp(objective / temperature) of numbers that would overflow."""
    objective = 3.0 * np.log(np.array([4.0, 2.0, 1.0, 16.0])) + shift
    weights = elite_weights(
        objective,
        np.array([True, True, True, False]),
        np.bool_(enough),
        weighting=weighting,
        temperature=3.0,
    )
    np.testing.assert_allclose(weights, np.array(expected) / sum(expected), rtol=1e-9)


def test_weights_of_none_and_of_infinite_objectives():
    none = elite_weights(np.zeros(2), np.zeros(2, bool), np.bool_(True))
    assert none.tolist() == [0, 0]
    all_lost = elite_weights(np.full(2, -np.inf), np.ones(2, bool), np.bool_(True))
    assert all_lost.tolist() == [0.5, 0.5]
    one = elite_weights(np.array([-np.inf, 0.0]), np.ones(2, bool), np.bool_(True))
    assert one.tolist() == [0, 1]


def test_the_number_of_elites_is_not_off_by_one():
    for percent in range(1, 100):
        for n in range(1, 200):
            assert elites_of.num_elites(percent / 100, n) == -(-percent * n // 100)


@pytest.mark.parametrize("share", [None, 0.4])
def test_a_step_is_4_14(share):
    """The mean parameter after a step, from the same samples in NumPy."""
    given = problem(limit=0.0)
    hparams = Hparams(
        rate=0.3, sample_share=share, population=15, rho=0.3, weighting="literal", temperature=2.0
    )
    state = cce.init(jax.random.key(5), given, hparams)
    draw_key, _ = jax.random.split(jax.random.fold_in(state.key, 0))
    x = np.asarray(ef.sample(start(), draw_key, 15))
    objective, cost = map(np.asarray, jax.jit(jax.vmap(lambda v: quadratic(v, None)))(x))
    elites, _ = slow_elites(objective, cost[:, None], 0.0, 5)
    weights = np.exp(objective[elites] / 2)
    weights /= weights.sum()
    new, metrics = quick_step(state, given, hparams)
    old = ef.mean_parameter(start())
    own = share or 0.0
    for statistic, eta, moved in zip((x, x**2), old, ef.mean_parameter(new.family), strict=True):
        expected = 0.3 * weights @ statistic[elites] + 0.7 * (
            own * statistic.mean(0) + (1 - own) * np.asarray(eta)
        )
        np.testing.assert_allclose(moved, expected, rtol=1e-9)
    assert metrics.num_feasible == (cost <= 0).sum()
    np.testing.assert_allclose(metrics.objective, objective.mean())
    np.testing.assert_allclose(metrics.cost, [cost.mean()])


@pytest.mark.slow
def test_later_samples_are_masked():
    """n_l = 5 l of 20, k_l = ceil(.3 n_l)."""
    hparams = Hparams(num_samples=Polynomial(5.0, 1.0), population=20, rho=0.3)
    _, metrics = searched(problem(), hparams, num_steps=6)
    assert np.diff(metrics.num_evaluated, prepend=0).tolist() == [5, 10, 15, 20, 20, 20]

    def growing(num):  # what comes after the first num samples makes no difference
        state = cce.init(jax.random.key(1), problem(), hparams)
        few = hparams.replace(num_samples=num)
        return quick_step(state, problem(), few)[0].family.mean

    x = ef.sample(start(), jax.random.split(jax.random.fold_in(jax.random.key(1), 0))[0], 20)
    objective, cost = map(np.asarray, jax.jit(jax.vmap(lambda v: quadratic(v, None)))(x))
    for num in (7, 12):
        elites, enough = slow_elites(
            objective[:num], cost[:num, None], 1.0, elites_of.num_elites(0.3, num)
        )
        weight = np.exp(objective[elites]) if enough else np.ones(len(elites))
        expected = 0.1 * weight @ np.asarray(x)[elites] / weight.sum()
        np.testing.assert_allclose(growing(num), expected, rtol=1e-9)


# --- problems solved --------------------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "family",
    [
        start(),
        ef.full_gaussian(jnp.zeros(2), jnp.eye(2)),
        ef.diagonal_gaussian(jnp.zeros(2, jnp.float32), 1.0),
    ],
    ids=["diagonal", "full", "float32"],
)
def test_a_constrained_quadratic_is_solved(family):
    given = cce.make_problem(quadratic, family, limit=1.0)
    solved = found(given, Hparams(rate=0.4), num_evaluations=2)
    assert solved.solution is not None
    assert solved.solution.dtype == ef.center(family).dtype
    assert quadratic(solved.solution, None)[1] <= 1.0
    np.testing.assert_allclose(solved.solution, [1.0, 0.0], atol=2e-2)
    assert -2 - 1e-2 < solved.best.objective <= -2 + 1e-6
    assert solved.violation <= 0
    assert "feasible on 2 fresh evaluations" in solved.message


@pytest.mark.slow
def test_a_gamma_family_searches_positive_numbers():
    given = cce.make_problem(
        lambda x, key: (-jnp.sum(jnp.log(x / jnp.array([0.2, 3.0])) ** 2), x[1]),
        ef.gamma(jnp.full(2, 2.0), 2.0),
        limit=2.5,
    )
    solved = found(given, Hparams(rate=0.4), num_steps=60, num_evaluations=2)
    np.testing.assert_allclose(solved.solution, [0.2, 2.5], rtol=0.03)


def test_without_a_constraint_the_objective_alone_is_returned_or_the_cost_is_free():
    for given in (
        cce.make_problem(lambda x, key: quadratic(x, key)[0], start()),
        cce.make_problem(quadratic, start()),
        cce.make_problem(quadratic, start(), limit=math.inf),
    ):
        solved = found(given, Hparams(rate=0.4), num_evaluations=2)
        np.testing.assert_allclose(solved.solution, TARGET, atol=1e-2)
        assert solved.mean.feasible
        assert solved.mean.confident


@pytest.mark.slow
def test_uniform_weights_until_feasible_keep_the_search_alive():
    """Where G falls steeply towards feasibility, G-weights collapse onto the infeasible."""

    def steep(x, key):
        return -50.0 * x[0], 6.0 - x[0]

    given = cce.make_problem(steep, start(1.0, 1), limit=0.0)
    default, literal = (
        found(given, Hparams(rate=0.5, weighting=w), 40, num_evaluations=2)
        for w in ("until_feasible", "literal")
    )
    assert default.solution is not None
    assert literal.violation > default.violation
    assert literal.solution is None


OPTIONS = [
    {"elite_reuse": True, "sample_share": Polynomial(0.5, -1.0), "variance_floor": 1e-6},
    {
        "antithetic": True,
        "noise": Polynomial(0.01, -2.0),
        "rate": Polynomial(0.9, -0.3),
        "num_samples": Polynomial(20.0, 0.5),
    },
]
ONE_BY_ONE = [
    {"restart_below": 1e-5},
    {"rate": jax.tree_util.Partial(lambda n: 0.9 / n**0.3)},
    *({name: value} for options in OPTIONS for name, value in options.items()),
]


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "options",
    [*OPTIONS, *(pytest.param(o, marks=pytest.mark.exhaustive) for o in ONE_BY_ONE)],
    ids=", ".join,
)
def test_options_solve_it_too(options):
    solved = found(problem(), Hparams(**{"rate": 0.3, **options}), 80, num_evaluations=2)
    np.testing.assert_allclose(solved.best.parameters, [1.0, 0.0], atol=5e-2)
    assert solved.solution is not None


@pytest.mark.exhaustive
def test_variance_floors_noise_and_restarts_do_what_they_say():
    floored, _ = searched(problem(), Hparams(rate=0.9, variance_floor=1e-2))
    assert (floored.family.variance >= 1e-2).all()
    noisier, _ = quick_step(floored, problem(), Hparams(rate=0.9, noise=3.0))
    assert (noisier.family.variance >= 3.0).all()
    again, metrics = searched(problem(), Hparams(rate=0.9, restart_below=1e-2))
    assert again.num_restarts >= 2
    assert metrics.max_deviation.max() == 1.0, "back at the first distribution"
    assert (np.diff(metrics.best_objective) >= 0).all(), "what was found is kept"
    assert metrics.best_objective[-1] > -2.01


def test_reused_elites_compete_again():
    """With a step that draws only bad samples the old elites stay, in their order."""
    hparams = Hparams(population=10, rho=0.3, elite_reuse=True)
    state = cce.init(jax.random.key(0), problem(), hparams)
    state, _ = quick_step(state, problem(), hparams)
    far = state.replace(family=ef.diagonal_gaussian(jnp.full(2, 100.0), 1.0))
    later, _ = quick_step(far, problem(), hparams)
    np.testing.assert_array_equal(later.elites.parameters, state.elites.parameters)


# --- what is told -----------------------------------------------------------------------------


def test_an_infeasible_problem_is_told_with_the_least_violation():
    given = cce.make_problem(impossible, start(), limit=1.0)
    solved = found(given, Hparams(rate=0.3), num_steps=40, num_evaluations=2)
    assert solved.solution is None
    assert solved.solution_name is None
    np.testing.assert_allclose(solved.violation, 2.0, atol=1e-3)
    assert "No feasible policy" in solved.message
    assert "no sample was" in solved.message
    assert "2;" not in solved.message
    assert not solved.mean.feasible
    assert not solved.best.feasible


def test_an_infeasible_mean_is_never_the_solution():
    """Feasible only near a ring, whose middle the mean is."""

    def ring(x, key):
        radius = jnp.sqrt(jnp.sum(x**2))
        return jnp.zeros(()), jnp.abs(radius - 1.0)

    given = cce.make_problem(ring, start(0.7), limit=0.1)
    solved = found(given, num_steps=3, num_evaluations=2)
    assert not solved.mean.feasible
    assert solved.solution_name == "best"
    assert solved.best.feasible


@pytest.mark.slow
def test_a_lucky_sample_is_not_presented_as_a_solution():
    """Costs of 1 on average that are at times seen below the limit of 0."""

    def lucky(x, key):
        return x[0], 1.0 + jax.random.normal(key)

    solved = found(cce.make_problem(lucky, start(), limit=0.0), num_steps=10)
    assert solved.solution is None
    assert solved.best.lower[0] < 1.0 < solved.best.upper[0]
    assert 0.8 < solved.violation < 1.2
    assert "no sample was" not in solved.message, "one was seen"


@pytest.mark.slow
def test_noise_and_its_margin():
    given = problem(noisy)
    hparams = Hparams(rate=0.3, margin=0.8)
    solved = found(given, hparams, num_steps=60, num_evaluations=400)
    assert solved.solution is not None
    assert solved.mean.feasible
    assert solved.mean.confident
    assert quadratic(solved.mean.parameters, None)[1] < 1.0
    width = solved.mean.upper - solved.mean.lower
    np.testing.assert_allclose(width, 2 * 1.966 * 0.5 / math.sqrt(400), rtol=0.15)


def test_intervals_cover_as_often_as_they_say():
    given = problem(noisy)
    point = jnp.array([0.3, 0.7])
    look = jax.jit(jax.vmap(lambda k: cce.assess(k, given, point, num_evaluations=5)))
    seen = look(jax.random.split(jax.random.key(3), 2000))
    inside = (seen.lower[:, 0] <= 1.0) & (seen.upper[:, 0] >= 1.0)
    assert abs(inside.mean() - 0.95) < 0.02, "Student's interval of five"


def test_costs_at_the_limit_are_feasible_to_the_bit():
    given = cce.make_problem(
        lambda x, key: (x[0], 0.1 + 0 * x[0]),
        ef.diagonal_gaussian(jnp.zeros(1, jnp.float32), 1.0),
        limit=0.1,
    )
    seen = cce.assess(jax.random.key(0), given, jnp.ones(1, jnp.float32), num_evaluations=999)
    assert seen.feasible
    assert seen.confident


def test_samples_without_a_number_are_counted_and_never_elites():
    def holes(x, key):
        objective, cost = quadratic(x, key)
        objective = jnp.where(x[0] > 1.5, jnp.nan, objective)
        return objective, jnp.where(x[1] > 1.5, jnp.nan, cost)

    given = cce.make_problem(holes, start(), limit=10.0)
    state, metrics = searched(given, Hparams(rate=0.3))
    assert state.num_invalid == metrics.num_invalid.sum() > 20
    assert jnp.isfinite(state.family.mean).all()
    assert (metrics.status == Status.COMPLETED).all()
    solved = cce.result(jax.random.key(0), state, given, Hparams(), num_evaluations=2)
    assert (np.asarray(solved.solution) <= [1.5, 1.5]).all()
    np.testing.assert_allclose(solved.best.parameters, [1.5, 1.0], atol=0.05)


def test_all_samples_without_a_number_are_an_error():
    given = cce.make_problem(lambda x, key: (jnp.nan * x[0], x[1]), start(), limit=0.0)
    state, metrics = searched(given, Hparams(population=10), num_steps=3)
    assert state.status == Status.NONFINITE
    assert metrics.status.tolist() == [Status.NONFINITE] * 3
    assert (state.family.mean == 0).all(), "nothing moved"
    with pytest.raises(ValueError, match=r"step 2: evaluate returned NaN for all samples \(30 of "):
        cce.result(jax.random.key(0), state, given, Hparams(population=10))


@pytest.mark.slow
def test_a_batch_of_runs_is_refused_by_result_and_its_lanes_are_not():
    given, hparams = problem(), Hparams(rate=0.3)
    keys = jax.random.split(jax.random.key(0), 3)
    start = jax.jit(jax.vmap(lambda k: cce.init(k, given, hparams)))(keys)
    many = jax.jit(jax.vmap(partial(cce.run, num_steps=3), (0, None, None)))
    states, _ = jax.jit(many, compiler_options=QUICK)(start, given, hparams)
    with pytest.raises(ValueError, match=r"a batch of \(3,\) runs; take one"):
        cce.result(keys[0], states, given, hparams)
    one = cce.result(keys[0], lane(states, 1), given, hparams, num_evaluations=2)
    alone, _ = quick_run(lane(start, 1), given, hparams, num_steps=3)
    np.testing.assert_allclose(one.mean.parameters, alone.family.mean, rtol=1e-9)


def test_worlds_travel_as_arguments():
    def shifted(world, x, key):
        return -jnp.sum((x - world) ** 2), x[0]

    def at_world(world):
        evaluate = jax.tree_util.Partial(shifted, jnp.asarray(world))
        return cce.make_problem(evaluate, start(), limit=5.0)

    run = partial(quick_run, hparams=Hparams(), num_steps=3)
    one, other = at_world([1.0, 0.0]), at_world([-1.0, 0.0])
    state = cce.init(jax.random.key(0), one, Hparams())
    first, _ = run(state, one)
    with counted_traces() as traced:
        second, _ = run(state, other)
    assert not traced
    assert second.family.mean[0] < first.family.mean[0]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: cce.make_problem(lambda x, k: (x, 0.0), start(), limit=0),
            r"an objective of shape \(2,\); it is called with one policy",
        ),
        (
            lambda: cce.make_problem(lambda x, k: (x[0], x[None]), start(), limit=0),
            r"a cost of shape \(1, 2\)",
        ),
        (
            lambda: cce.make_problem(lambda x, k: (0.0, 0.0, x), start(), limit=0),
            "returned 3 things",
        ),
        (lambda: cce.make_problem(lambda x, k: x[0], start(), limit=0.0), "returns no cost"),
        (
            lambda: cce.make_problem(lambda x, k: (x[0], x), start(), limit=0.5),
            r"limit=0\.5, but evaluate returns 2 costs; give one limit for each, float\[2\]",
        ),
        (lambda: problem(limit=[0.0, 1.0]), r"limit has shape \(2,\); expected \(1,\)"),
        (lambda: problem(limit=math.nan), r"limit=\[nan\]"),
        (lambda: problem(limit=-math.inf), r"limit=\[-inf\]; no cost is at most"),
        (lambda: problem(scale=0.0), r"scale=\[0\.0\]; it must be positive"),
        (
            lambda: searched(problem(), Hparams(rho=0.005)),
            r"rho=0\.005 of population=100 leaves no",
        ),
        (lambda: searched(problem(), Hparams(rho=1.0)), "rho=1.0; it must be above 0 and below 1"),
        (
            lambda: searched(problem(), Hparams(weighting="G")),
            "weighting='G'; choose one of until_feasible",
        ),
        (
            lambda: searched(problem(), Hparams(rate=1.5)),
            r"rate=1\.5; it must be above 0 and at most 1",
        ),
        (
            lambda: searched(problem(), Hparams(sample_share=-1)),
            r"sample_share=-1; it must be at least 0",
        ),
        (
            lambda: searched(problem(), Hparams(temperature=0)),
            r"temperature=0; it must be above 0",
        ),
        (lambda: searched(problem(), Hparams(margin=jnp.zeros(3))), r"margin has shape \(3,\)"),
        (lambda: searched(problem(), Hparams(sharding="cpu")), "sharding is a str"),
        (
            lambda: searched(
                cce.make_problem(quadratic, ef.gamma([1.0, 1.0], 1.0)), Hparams(antithetic=True)
            ),
            "Gamma has no mirrored samples",
        ),
        (
            lambda: cce.assess(jax.random.key(0), problem(), jnp.zeros(2), num_evaluations=1),
            "num_evaluations=1; a confidence interval needs",
        ),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# --- the theorem's conditions -----------------------------------------------------------------


COMPLIANT = Hparams(
    rate=Polynomial(0.5, -0.7),
    sample_share=Polynomial(1.0, -0.5),
    num_samples=Polynomial(10.0, 0.5),
    population=1000,
    weighting="literal",
)


def test_compliant_settings_meet_the_theorem():
    report = theorem_conditions(COMPLIANT, num_steps=10_000)
    assert report.holds is True
    assert not report.failing
    assert len(report.assumed) == 6
    assert "(2e) G is bounded" in " ".join(report.assumed)
    no_share = COMPLIANT.replace(sample_share=None)  # lambda_l = 0 is of any order
    assert theorem_conditions(no_share, num_steps=10_000).holds


@pytest.mark.parametrize(
    ("change", "failing"),
    [
        ({"rate": 0.1}, {"rate decreases", "rate vanishes"}),
        ({"rate": Polynomial(0.5, -1.2)}, {"rate has an infinite sum"}),
        ({"rate": Polynomial(1.5, -0.5)}, {"rate in (0, 1]"}),
        ({"rate": Polynomial(0.5, 0.1)}, {"rate in (0, 1]", "rate decreases", "rate vanishes"}),
        ({"num_samples": None}, {"samples grow", "beta + 2 lambda > 1"}),
        ({"num_samples": 100}, {"samples grow", "beta + 2 lambda > 1"}),
        ({"num_samples": None, "sample_share": None}, {"samples grow"}),
        ({"population": 999}, {"samples grow"}),
        ({"sample_share": Polynomial(1.0, -0.25)}, {"beta + 2 lambda > 1"}),
        ({"sample_share": 0.5}, {"sample share decays", "beta + 2 lambda > 1"}),
        ({"weighting": "uniform"}, {"weights are G"}),
        ({"weighting": "until_feasible"}, {"weights are G"}),
        ({"elite_reuse": True}, {"no elite_reuse"}),
        ({"antithetic": True}, {"no antithetic"}),
        ({"variance_floor": 0.1}, {"no variance_floor"}),
        ({"noise": 0.1}, {"no noise"}),
        ({"restart_below": 0.1}, {"no restart_below"}),
    ],
)
def test_settings_outside_the_theorem_are_named(change, failing):
    report = theorem_conditions(COMPLIANT.replace(**change), num_steps=10_000)
    assert report.holds is False
    assert set(report.failing) == failing


def test_a_population_bounds_the_samples_for_ever():
    assert theorem_conditions(COMPLIANT).failing == ("samples grow",)
    assert theorem_conditions(COMPLIANT, num_steps=10_001).failing == ("samples grow",)


def test_what_a_function_does_cannot_be_told():
    hparams = COMPLIANT.replace(rate=jax.tree_util.Partial(lambda n: 1 / n))
    report = theorem_conditions(hparams, num_steps=100)
    assert report.holds is None
    assert next(c.name for c in report.conditions if c.holds is None) == "rate in (0, 1]"
    assert theorem_conditions(hparams.replace(noise=1.0), num_steps=100).holds is False


# --- several devices --------------------------------------------------------------------------


SHARDED = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import NamedSharding, PartitionSpec
from jaxltl.algos import cce
from jaxltl.algos.cce import exponential_family as ef

jax.config.update("jax_enable_x64", True)
mesh = jax.make_mesh((2,), ("population",), axis_types=(jax.sharding.AxisType.Auto,))
over = NamedSharding(mesh, PartitionSpec("population"))
quick = {"xla_backend_optimization_level": 0}
seen = []

def evaluate(x, key):
    a, b = 0.1 * jax.random.normal(key, (2,))
    return a - jnp.sum((x - 1.0) ** 2), b + jnp.sum(jnp.sin(x))

problem = cce.make_problem(evaluate, ef.diagonal_gaussian(jnp.zeros(3), 1.0), limit=1.0)
states = []
for sharding in (None, over):
    hparams = cce.Hparams(population=20, sharding=sharding)
    given = (jax.random.key(0), problem, hparams)
    train = jax.jit(lambda k, p, h: cce.train(k, p, h, num_steps=25)).lower(*given).compile(quick)
    states.append(train(*given)[0])
    text = train.as_text()
    seen.append("[10,3]" in text or "[3,10]" in text)
assert seen == [False, True], seen
one, two = states
for x, y in zip(jax.tree.leaves(one.family), jax.tree.leaves(two.family), strict=True):
    np.testing.assert_allclose(x, y, rtol=1e-12)
np.testing.assert_allclose(one.best.parameters, two.best.parameters, rtol=1e-12)
assert int(one.num_evaluated) == int(two.num_evaluated) == 500
keys = jnp.stack([jax.random.key(0), jax.random.key(1)])
many = jax.jit(jax.vmap(lambda k: cce.train(k, problem, hparams, num_steps=25)[0]),
               compiler_options=quick)(keys)
np.testing.assert_allclose(many.family.mean[0], one.family.mean, rtol=1e-9)
print("equal on", len(jax.devices()))
"""


@pytest.mark.exhaustive
def test_a_population_over_two_devices_is_the_population():
    done = subprocess.run(
        [sys.executable, "-c", SHARDED],
        capture_output=True,
        text=True,
        check=False,
        env={
            **os.environ,
            "XLA_FLAGS": "--xla_force_host_platform_device_count=2",
            "JAX_PLATFORMS": "cpu",
        },
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.strip() == "equal on 2"


# --- the laws of all learners ------------------------------------------------------------------


def noisy_quadratic(x, key):
    return jax.random.normal(key) - jnp.sum((x - 1.0) ** 2), jnp.sum(x)


def cross_entropy():
    problem = cce.make_problem(noisy_quadratic, ef.diagonal_gaussian(jnp.zeros(2), 1.0), limit=1.0)
    setting = partial(cce.Hparams, population=10, elite_reuse=True)
    return LearnerCase(
        cce,
        problem,
        setting(rate=cce.Polynomial(0.5, -0.5)),
        setting(rate=cce.Polynomial(0.9, -0.2), temperature=2.0),
    )


CASES = {
    "cce": cross_entropy,
}
