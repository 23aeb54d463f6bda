"""Parameters that are claimed do what is claimed: closed forms, exact fractions, brute force."""

import itertools
import re
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.algos import feasible as search
from jaxltl.algos.common import loops
from jaxltl.algos.feasible import Budget, Hparams, certify, evaluate, feasible, make_problem, within
from jaxltl.core.models.parametric import make_parametric
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.types import Status
from jaxltl.io.drn.parametric import read_parametric
from tests.algos.cases import LearnerCase
from tests.sparse_models import exact_solve
from tests.support import counted_traces


def drn(tmp_path, parameters, states, kind="DTMC"):
    """A parametric model: of each state its reward and label, and of its choices the successors."""
    lines = [
        f"@type: {kind}",
        "@parameters",
        parameters,
        "@reward_models",
        "cost",
        "@nr_states",
        str(len(states)),
        "@model",
    ]
    for number, (reward, label, *choices) in enumerate(states):
        lines.append(f"state {number} [{reward}] {label}".rstrip())
        for a, successors in enumerate(choices):
            lines.append(f"\taction {a} [0]")
            lines += [f"\t\t{t} : {f}" for t, f in successors.items()]
    path = tmp_path / "model.drn"
    path.write_text("\n".join(lines) + "\n")
    return read_parametric(path)


def coins(tmp_path):
    """A head, then a tail: p (1 - p), at most a quarter. Each throw costs one."""
    return drn(
        tmp_path,
        "p",
        [
            ("1", "init", {1: "p", 3: "1-p"}),
            ("1", "", {3: "p", 2: "1-p"}),
            ("0", "goal", {2: "1"}),
            ("0", "lost", {3: "1"}),
        ],
    )


@cache
def ruin():
    """A walk between 0 and 6 from 3, up with p: won with odds (p / (1 - p)) ** 3."""
    size = 7
    start = np.concatenate([[0, 1], 1 + 2 * np.arange(1, size - 1), [2 * size - 2]])
    inner = np.stack([np.arange(size - 2), np.arange(2, size)], 1).ravel()
    probability = np.array([1, *[0.5] * (2 * size - 4), 1])
    walk = make_sparse(
        None,
        start,
        [0, *inner, size - 1],
        probability,
        initial=np.eye(size)[3],
        label={"won": [6], "over": [0, 6]},
        rewards={"steps": Rewards(state=np.ones(size))},
    )

    def numbers(x):
        pair = jnp.stack([1 - x[0], x[0]])
        return jnp.concatenate([jnp.ones(1), jnp.tile(pair, size - 2), jnp.ones(1)])

    return make_parametric(walk, numbers, {"p": 0.01}, {"p": 0.99})


@pytest.mark.slow
def test_a_quarter_is_the_most_that_a_head_and_a_tail_have(tmp_path):
    problem = make_problem(coins(tmp_path).over(1e-3, 1 - 1e-3), "goal", bound=">=")
    found = feasible(problem, 0.2499, num_starts=40)
    assert found.feasible.all() and (found.status == Status.CONVERGED).all()
    p = found.parameters[:, 0]
    assert (p * (1 - p) >= 0.2499).all() and (abs(p - 0.5) <= 0.01 + 1e-9).all()
    exact = [Fraction(x) * (1 - Fraction(x)) for x in p]
    assert all(
        low <= x <= high for low, x, high in zip(found.lower, exact, found.upper, strict=True)
    )
    assert found.valuation() == {"p": p[0]} and found.valuation(3) == {"p": p[3]}
    assert found.num_steps.max() < 60

    with counted_traces() as traced:
        none = feasible(problem, 0.25 + 1e-9, num_starts=40)
        easy = feasible(problem, 0.01, num_starts=40, budget=Budget(num_steps=3))
        other = feasible(within(problem, 0.1, 0.2), 0.1599, num_starts=40)
    assert not traced, "thresholds, boxes and numbers of steps are arguments"
    assert not none.feasible.any() and (none.num_steps == 200).all()
    assert (none.status != Status.CONVERGED).all() and (none.value > 0.249).all()
    with pytest.raises(ValueError, match="no parameters were proven"):
        none.valuation()
    assert easy.feasible.sum() > 30 and (easy.num_steps <= 3).all()
    assert other.feasible.all() and (other.parameters <= 0.2).all()


def test_at_most_and_expected_rewards(tmp_path):
    """Throws are 1 + p in the mean; at most 1.25 are for p up to a quarter."""
    model = coins(tmp_path).over(1e-3, 1 - 1e-3)
    ends = np.array([False, False, True, True])
    problem = make_problem(model, ends, reward="cost", bound="<=")
    found = feasible(problem, 1.25, num_starts=20)
    assert found.feasible.all() and (found.parameters <= 0.25).all()
    assert (found.lower <= 1 + found.parameters[:, 0]).all() and (found.upper <= 1.25).all()
    assert not feasible(problem, 1.0, num_starts=20).feasible.any(), "p is at least a thousandth"


@pytest.mark.slow
def test_walks_with_circles():
    model = ruin()
    problem = make_problem(model, "won", bound=">=")
    odds = 0.9 / 0.1
    least = odds ** (1 / 3) / (1 + odds ** (1 / 3))  # of p
    found = feasible(problem, 0.9, num_starts=20)
    assert found.feasible.all() and (found.parameters[:, 0] >= least).all()
    # From where the probability is 1e-6 too: steps are measured by the odds.
    low = feasible(problem, 0.999, guess=np.array([[0.01], [0.02]]), budget=Budget(num_steps=40))
    assert low.feasible.all()
    longest = make_problem(model, "over", reward="steps", bound=">=")
    found = feasible(longest, 8.999, num_starts=20)
    assert found.feasible.all() and (abs(found.parameters - 0.5) < 0.02).all()
    assert not feasible(longest, 9.001, num_starts=20).feasible.any()


@pytest.mark.slow
def test_what_may_be_passed_before(tmp_path):
    """Not through state 1, so by the other way: of probability (1 - p) p, not 1 - p^2."""
    model = drn(
        tmp_path,
        "p",
        [
            ("0", "init", {1: "p", 3: "1-p"}),
            ("0", "", {2: "1-p", 4: "p"}),
            ("0", "goal", {2: "1"}),
            ("0", "", {2: "p", 4: "1-p"}),
            ("0", "", {4: "1"}),
        ],
    ).over(0.01, 0.99)
    stay = [True, False, True, True, True]
    problem = make_problem(model, "goal", bound=">=", stay=stay)
    lower, upper = certify(problem, [0.25])
    assert lower <= 0.1875 <= upper and upper - lower < 1e-6
    assert feasible(problem, 0.2499, num_starts=4).feasible.all()
    assert not feasible(problem, 0.2501, num_starts=4).feasible.any()


def test_steps_are_measured_by_the_odds():
    """These are (p / (1 - p)) ** 3, whether the probability is 1e-6 or 1 - 1e-6."""
    problem = make_problem(ruin(), "won", bound=">=")
    step = jax.jit(search.step)
    for p in (0.01, 0.5, 0.99):
        state = search.start_at(jax.random.key(0), jnp.array([p]), problem, Hparams())
        _, metrics = step(state, problem, Hparams())
        np.testing.assert_allclose(metrics.gradient_norm, 3 * 0.98 / (p * (1 - p)), rtol=1e-8)


@pytest.mark.slow
def test_keys_and_starts_decide():
    problem = make_problem(ruin(), "won", bound=">=")
    one, same, other = (
        feasible(problem, 0.9, num_starts=20, key=jax.random.key(k)) for k in (1, 1, 2)
    )
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(same), strict=True):
        np.testing.assert_array_equal(x, y)
    assert (one.parameters != other.parameters).any()
    alone = feasible(problem, 0.9, guess=np.array([[0.3], [0.95]]), budget=Budget(num_steps=200))
    assert alone.num_steps[1] == 1 and alone.parameters[1] == 0.95, "it is there already"
    assert alone.num_steps[0] > 1


FUNCTIONS = (
    ("p", "1-p"),
    ("q^2", "1-q^2"),
    ("p*q", "1-p*q"),
    ("p/(p+q)", "q/(p+q)"),
    ("1/3", "2/3"),
    ("p/2", "1-p/2"),
    ("(1+q)/3", "(2-q)/3"),
)
COSTS = ("p+1", "2*q", "1/(1+p)", "0", "3/7")


def random_chain(tmp_path, seed):
    """Six states of which four lead anywhere; and by a third of it on to the end."""
    rng = np.random.default_rng(seed)
    states = []
    for s in range(4):
        f, g = FUNCTIONS[rng.integers(len(FUNCTIONS))]
        a, b = rng.choice(5, 2, replace=False)
        label = "init" if s == 0 else ""
        states.append(
            (
                COSTS[rng.integers(len(COSTS))],
                label,
                {int(a): f"({f})*2/3", int(b): f"({g})*2/3", 5: "1/3"},
            )
        )
    states += [("7", "", {4: "1/2", 5: "1/2"}), ("0", "goal", {5: "1"})]
    return drn(tmp_path, "p q", states)


def exact_cost(model, point):
    """The expected cost until the goal, in fractions."""
    value = [f.at(point) for f in model.functions]
    size = len(model.row_start) - 1
    matrix = [[Fraction(i == j) for j in range(size)] for i in range(size)]
    for s in range(size - 1):
        for e in range(model.entry_start[s], model.entry_start[s + 1]):
            matrix[s][model.successor[e]] -= value[model.probability[e]]
    cost = [value[i] for i in model.rewards["cost"][0]]
    return exact_solve([row[:-1] for row in matrix[:-1]], cost[:-1])[0]


@pytest.mark.parametrize("seed", range(12))
def test_certificates_hold_for_the_functions_at_exactly_the_point(tmp_path, seed):
    """Nothing is compiled: exact instances against exact elimination."""
    model = random_chain(tmp_path, seed)
    problem = make_problem(model.over(0.05, 0.95), "goal", reward="cost", bound="<=")
    rng = np.random.default_rng(seed)
    for point in rng.uniform(0.05, 0.95, (5, 2)):
        lower, upper = certify(problem, point)
        exact = exact_cost(model, tuple(map(Fraction, point)))
        assert Fraction(lower) <= exact <= Fraction(upper)
        assert upper - lower <= 1e-6 * upper


@pytest.mark.parametrize("seed", range(2))
def test_gradients_are_those_of_differences(tmp_path, seed):
    model = random_chain(tmp_path, seed)
    problem = make_problem(model.over(0.05, 0.95), "goal", reward="cost", bound="<=")
    look = jax.jit(jax.value_and_grad(lambda x: evaluate(x, problem, Hparams())[0]))
    step = Fraction(1, 10**6)
    for point in np.random.default_rng(seed).uniform(0.1, 0.9, (3, 2)):
        value, slope = look(jnp.array(point))
        exact = [Fraction(x) for x in point]
        np.testing.assert_allclose(value, float(exact_cost(model, tuple(exact))), rtol=1e-12)
        for d in range(2):
            ends = [
                exact_cost(model, tuple(x + s * step * (i == d) for i, x in enumerate(exact)))
                for s in (1, -1)
            ]
            np.testing.assert_allclose(
                slope[d], float((ends[0] - ends[1]) / (2 * step)), rtol=1e-8, atol=1e-9
            )


@pytest.mark.slow
def test_values_over_policies(tmp_path):
    """Two ways to the goal, of p and of q (1 - p): against the best and the worst of both."""
    model = drn(
        tmp_path,
        "p q",
        [
            ("1", "init", {1: "p", 2: "1-p"}, {3: "q", 2: "1-q"}),
            ("1", "goal", {1: "1"}),
            ("1", "", {2: "1"}),
            ("1", "", {1: "1-p", 2: "p"}),
        ],
        kind="MDP",
    ).over(0.01, 0.99)
    grid = np.array(list(itertools.product(np.linspace(0.01, 0.99, 99), repeat=2)))
    p, q = grid.T
    for objective, both in (("max", np.maximum), ("min", np.minimum)):
        value = both(p, q * (1 - p))
        for bound, best, sign in ((">=", value.max(), 1), ("<=", value.min(), -1)):
            problem = make_problem(model, "goal", bound=bound, objective=objective)
            found = feasible(problem, best - sign * 0.02, num_starts=6)
            assert found.feasible.any(), (objective, bound)
            at = found.parameters[found.feasible]
            own = both(at[:, 0], at[:, 1] * (1 - at[:, 0]))
            assert (sign * (own - best + sign * 0.02) >= 0).all()
            assert (found.lower[found.feasible] <= own * (1 + 1e-12)).all()
            assert (own * (1 - 1e-12) <= found.upper[found.feasible]).all()
            none = feasible(problem, best + sign * 0.02, num_starts=6)
            assert not none.feasible.any(), (objective, bound)


def simplex():
    """Three parts of a whole, each of which has to come: p q (1 - p - q), at most 1/27."""
    model = make_sparse(
        None,
        [0, 2, 4, 6, 7, 8],
        [1, 4, 2, 4, 3, 4, 3, 4],
        [0.5] * 6 + [1, 1],
        initial=[1, 0, 0, 0, 0],
    )

    def numbers(x):
        p, q = x
        return jnp.array([p, 1 - p, q, 1 - q, 1 - p - q, p + q, 1, 1])

    return make_parametric(model, numbers, [0.01, 0.01], [0.98, 0.98])


def test_points_without_a_model_are_left_again():
    """Half of the square is no simplex; who starts there comes back."""
    problem = make_problem(simplex(), np.arange(5) == 3, bound=">=")
    starts = np.array([[0.9, 0.9], [0.34, 0.32], [0.1, 0.1], [0.98, 0.98]])
    found = feasible(problem, 0.0369, guess=starts)
    assert found.feasible.all() and found.num_steps[1] == 1
    assert (abs(found.parameters - 1 / 3) < 0.04).all() and (found.upper <= 1 / 27 + 1e-9).all()
    stopped = feasible(problem, 0.0369, guess=starts, budget=Budget(num_steps=1))
    assert stopped.status.tolist() == [
        Status.INVALID,
        Status.CONVERGED,
        Status.MAX_STEPS,
        Status.INVALID,
    ]
    assert np.isnan(stopped.parameters[[0, 3]]).all() and not stopped.feasible[[0, 2, 3]].any()


@pytest.mark.few(1)
@pytest.mark.parametrize("optimizer", ["rmsprop", "sgd", "sign"])
def test_other_optimisers(optimizer):
    problem = make_problem(ruin(), "won", bound=">=")
    found = feasible(problem, 0.8, num_starts=4, hparams=Hparams(optimizer=optimizer))
    assert found.feasible.all()


def test_single_precision(tmp_path):
    with jax.enable_x64(False):
        model = coins(tmp_path).over(1e-9, 1 - 1e-9)
        problem = make_problem(model, "goal", bound=">=")
        assert problem.high.dtype == np.float32 and (problem.high < 1).all()
        found = feasible(problem, 0.2499, num_starts=8)
        assert found.feasible.all()
        assert (found.upper - found.lower <= 1e-12).all(), "the proof is in double precision"
        with pytest.raises(ValueError, match="interval of p has no two numbers in float32"):
            within(problem, 0.5, 0.5 + 1e-12)


@pytest.mark.slow
def test_the_script_of_the_page_runs(capsys):
    page = Path(__file__).parents[2] / "docs" / "parameters.md"
    script, *_ = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    names: dict = {}
    exec(compile(script, str(page), "exec"), names)
    assert names["found"].feasible.all()
    assert names["found"].upper.min() < 3.325, "3.3229 where p is 0"
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].startswith("100 ") and shown[2:] == ["False"]


# --- what is claimed is proven ----------------------------------------------------------------


def forged(problem, points, values):
    """What a search that is wrong would say."""
    states = jax.vmap(lambda x: search.start_at(jax.random.key(0), x, problem, Hparams()))(points)
    best = search.BestPoint(points, values)
    size = len(values)
    code = jnp.zeros(size, jnp.int32)
    metrics = search.Metrics(values, values, values, code)
    return loops.Learned(replace(states, best=best), metrics, code + 3, code)


def test_a_search_that_is_wrong_claims_nothing(tmp_path):
    problem = make_problem(coins(tmp_path).over(1e-3, 1 - 1e-3), "goal", bound=">=")
    points = jnp.array([[0.5], [0.1], [0.5], [0.4999]])
    said = forged(problem, points, jnp.array([0.25, 0.25, 0.1, jnp.nan]))
    found = search._prove(problem, 0.2, said, Budget())
    assert found.feasible.tolist() == [True, False, False, False]
    assert found.status.tolist() == [
        Status.CONVERGED,
        Status.MAX_STEPS,
        Status.MAX_STEPS,
        Status.NONFINITE,
    ]
    assert found.upper[1] < 0.2 and (found.lower[2:] == 0).all() and (found.upper[2:] == 1).all()
    # At the optimum itself bounds cannot tell, as a third and two are no floats.
    thirds = make_problem(
        drn(
            tmp_path,
            "p",
            [("0", "init", {1: "p/3", 2: "1-p/3"}), ("0", "goal", {1: "1"}), ("0", "", {2: "1"})],
        ).over(0.25, 1.0),
        "goal",
        bound=">=",
    )
    said = forged(thirds, jnp.array([[1.0]]), jnp.array([1 / 3]))
    found = search._prove(thirds, 1 / 3, said, Budget())
    assert found.status.tolist() == [Status.PRECISION] and not found.feasible.any()


def test_as_many_are_prove_as_are_enough():
    problem = make_problem(ruin(), "won", bound=">=")
    every = feasible(problem, 0.9, num_starts=20)
    some = feasible(problem, 0.9, num_starts=20, budget=Budget(num_proofs=3))
    best = np.argsort(-every.value, kind="stable")[:3]
    assert set(np.flatnonzero(some.feasible)) == set(best)
    np.testing.assert_array_equal(some.parameters, every.parameters)
    assert (some.status[~some.feasible] == Status.UNCERTIFIED).all()
    assert (some.upper[~some.feasible] == 1).all() and (some.lower[~some.feasible] == 0).all()
    assert some.valuation()["p"] == every.parameters[min(best), 0]


def test_points_that_are_no_model_after_all_are_told(tmp_path, monkeypatch):
    problem = make_problem(coins(tmp_path).over(1e-3, 1 - 1e-3), "goal", bound=">=")

    def refuse(*_, **__):
        raise ValueError("some transitions are gone")

    monkeypatch.setattr(search, "certify", refuse)
    found = search._prove(
        problem, 0.2, forged(problem, jnp.array([[0.5]]), jnp.array([0.25])), Budget()
    )
    assert found.status.tolist() == [Status.INVALID] and not found.feasible.any()


@pytest.mark.slow
def test_storm_finds_the_same_at_what_was_found(tmp_path):
    pytest.importorskip("stormpy")
    from tests.storm_oracle import storm_model, storm_values

    model = random_chain(tmp_path, 0).over(0.05, 0.95)
    problem = make_problem(model, "goal", reward="cost", bound="<=")
    least = min(certify(problem, x)[0] for x in itertools.product([0.05, 0.5, 0.95], repeat=2))
    found = feasible(problem, 1.05 * least, num_starts=6)
    assert found.feasible.any()
    for i in np.flatnonzero(found.feasible):
        at = model.at(found.parameters[i])
        (value,) = storm_values(storm_model(at), 'R{"cost"}=? [F "goal"]')
        assert value <= 1.05 * least * (1 + 1e-6)
        assert found.lower[i] * (1 - 1e-6) <= value <= found.upper[i] * (1 + 1e-6)


# --- what is refused --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"bound": ">"}, 'bound=\'>\'; it must be ">=" or "<="'),
        ({"objective": "best"}, "objective='best'"),
        ({"target": "gaol"}, "no label 'gaol'; the model has goal"),
        ({"target": np.zeros(3, bool)}, r"target has shape \(3,\); expected \(4,\)"),
        ({"reward": "price"}, "no reward 'price'; the model has 'cost'"),
        ({"reward": "cost"}, "infinite at every point"),
        ({"stay": np.ones(3, bool)}, r"stay has shape \(3,\)"),
    ],
)
def test_questions_that_are_none(tmp_path, changed, message):
    given = {"target": "goal", "bound": ">=", **changed}
    with pytest.raises(ValueError, match=message):
        make_problem(coins(tmp_path).over(0.1, 0.9), **given)


@pytest.mark.parametrize(
    ("threshold", "changed", "message"),
    [
        (np.nan, {}, "threshold=nan; give a finite number"),
        (np.inf, {}, "threshold=inf"),
        (0.2, {"num_starts": 0}, "num_starts=0; it must be at least 1"),
        (0.2, {"guess": np.array([0.5])}, r"guess has shape \(1,\); expected \(N, 1\)"),
        (
            0.2,
            {"guess": np.array([[0.5], [0.95]])},
            r"guess 1 has p = 0.95; its interval is \[0.1",
        ),
        (0.2, {"guess": np.array([[np.nan]])}, "guess 0 has p = nan"),
        (0.2, {"hparams": Hparams(optimizer="lbfgs")}, "choose one of adabelief, .*, sign"),
        (0.2, {"hparams": Hparams(optimizer="newton")}, "optimizer='newton'; choose one of"),
    ],
)
def test_bad_searches_are_refused(tmp_path, threshold, changed, message):
    problem = make_problem(coins(tmp_path).over(0.1, 0.9), "goal", bound=">=")
    with pytest.raises(ValueError, match=message):
        feasible(problem, threshold, **changed)


def test_a_model_without_a_box():
    with pytest.raises(ValueError, match="NoneType has no box of parameters"):
        make_problem(None, "goal", bound=">=")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"num_steps": 0}, "num_steps=0; it must be"),
        ({"num_proofs": 0}, "num_proofs=0; it must be"),
        ({"tolerance": -1.0}, "tolerance"),
    ],
)
def test_bad_budgets_are_refused(changed, message):
    with pytest.raises(ValueError, match=message):
        Budget(**changed)


# --- the laws of all learners ------------------------------------------------------------------


def two_throws(x):
    p, q = x
    return jnp.array([p, 1 - p, 1 - q, q, 1, 1])


def parameters():
    """A head, then a tail, of two coins."""
    chain = make_sparse(
        None, [0, 2, 4, 5, 6], [1, 3, 2, 3, 2, 3], [0.5] * 4 + [1, 1], initial=[1, 0, 0, 0]
    )
    model = make_parametric(chain, two_throws, [0.1, 0.2], [0.9, 0.8])
    problem = search.make_problem(model, np.arange(4) == 2, bound=">=")
    return LearnerCase(search, problem, search.Hparams(), search.Hparams(learning_rate=0.01))


CASES = {
    "feasible": parameters,
}
