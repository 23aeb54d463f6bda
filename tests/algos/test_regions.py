"""Boxes of parameters are accepted or rejected right, and enclose what is sampled in them."""

from fractions import Fraction

import jax
import numpy as np
import pytest

from jaxltl.algos.feasible import make_problem
from jaxltl.algos.regions import enclose, prove_around, prove_regions
from jaxltl.core.models.parametric import make_parametric, make_rationals, ranges
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.total_reward import total_reward
from jaxltl.io.drn.parametric import read_parametric

ONE = Fraction(1)
TWICE = """@type: DTMC
@parameters
p q
@reward_models
steps
@nr_states
4
@model
state 0 [1] init
\taction 0
\t\t1 : p
\t\t3 : 1-p
state 1 [q]
\taction 0
\t\t0 : 1/4
\t\t2 : 3/4*q
\t\t3 : 3/4*(1-q)
state 2 [0] goal done
\taction 0
\t\t2 : 1
state 3 [0] done
\taction 0
\t\t3 : 1
"""


@pytest.fixture
def twice(tmp_path):
    path = tmp_path / "twice.drn"
    path.write_text(TWICE)
    return read_parametric(path).over(0.05, 0.95)


def value(p, q):
    return 0.75 * p * q / (1 - 0.25 * p)


def test_ranges_hold_what_functions_are():
    """At corners, term by term, and as quotients."""
    rng = np.random.default_rng(0)
    functions = []
    for _ in range(40):
        powers = rng.integers(0, rng.integers(2, 4), (4, 3)).tolist()
        terms = {tuple(x): Fraction(float(rng.normal())) for x in powers}
        below = {(0, 0, 0): Fraction(4)} | ({(1, 0, 1): ONE} if rng.random() < 0.3 else {})
        functions.append((terms, below))
    of = make_rationals(functions, 3)
    values = jax.jit(jax.vmap(of))
    for _ in range(20):
        low = rng.random(3)
        high = low + rng.random(3)
        found = ranges(of, low, high)
        sampled = np.array(values(low + rng.random((30, 3)).round() * (high - low)))
        assert (found.lower <= sampled.min(0) + 1e-6).all()
        assert (sampled.max(0) <= found.upper + 1e-6).all()
    with pytest.raises(ValueError, match=r"down to -1 in parameter 1"):
        ranges(of, np.array([0, -1.0, 0]), np.ones(3))


def test_polynomials_of_degree_one_have_exact_ranges():
    """``x + y - 2 x y`` has its extremes at corners, and terms do not tell."""
    terms = {(1, 0): ONE, (0, 1): ONE, (1, 1): Fraction(-2)}
    of = make_rationals([(terms, {(0, 0): ONE})], 2)
    found = ranges(of, np.array([0.2, 0.4]), np.array([0.3, 0.9]))
    assert found.lower[0] == pytest.approx(0.2 + 0.4 - 0.16)
    assert found.upper[0] == pytest.approx(0.2 + 0.9 - 0.36)


@pytest.mark.slow
def test_bounds_hold_in_the_whole_box(twice):
    rng = np.random.default_rng(1)
    chance = make_problem(twice, "goal", bound=">=")
    steps = make_problem(twice, "done", bound="<=", reward="steps")
    for _ in range(20):
        low = rng.uniform(0.05, 0.8, 2)
        high = low + rng.uniform(0, 0.95 - low)
        some = low + rng.random((10, 2)) * (high - low)
        bounds = enclose(chance, low, high)
        for point in some:
            model = twice.at(point)
            assert bounds[0] <= value(*point) <= bounds[1]
            assert reachability_probability(model, chance.target).value[0] == pytest.approx(
                value(*point)
            )
        bounds = enclose(steps, low, high)
        for point in some:
            of = total_reward(twice.at(point), "steps", steps.target)
            assert bounds[0] <= of.upper[0]
            assert of.lower[0] <= bounds[1]


@pytest.mark.slow
@pytest.mark.parametrize("bound", [">=", "<="])
def test_boxes_cover_and_are_decided_right(twice, bound):
    problem = make_problem(twice, "goal", bound=bound)
    found = prove_regions(problem, 0.3, max_boxes=150)
    assert found.share(1) + found.share(-1) > 0.75
    assert found.share(1) + found.share(-1) + found.share(0) == pytest.approx(1)
    volume = np.prod(found.high - found.low, axis=1).sum()
    assert volume == pytest.approx(0.9**2)
    rng = np.random.default_rng(2)
    for low, high, verdict in zip(found.low, found.high, found.verdict, strict=True):
        worth = value(*(low + rng.random((10, 2)) * (high - low)).T)
        past = worth >= 0.3 if bound == ">=" else worth <= 0.3
        assert verdict == 0 or (past == (verdict == 1)).all()


def test_a_box_around_a_point(twice):
    problem = make_problem(twice, "goal", bound=">=")
    low, high = prove_around(problem, 0.3, [0.8, 0.8])
    assert (low < 0.7).all()
    assert value(*low) >= 0.3
    assert prove_around(problem, 0.3, [0.2, 0.2]) is None
    low, high = prove_around(problem, 0.0, [0.5, 0.5])
    assert (low == 0.05).all()
    assert (high == 0.95).all()


def test_what_cannot_be_asked(twice):
    problem = make_problem(twice, "goal", bound=">=")
    with pytest.raises(ValueError, match=r"of q reaches out of the problem's, \[0.05, 0.95\]"):
        enclose(problem, 0.1, {"p": 0.9, "q": 0.96})
    with pytest.raises(ValueError, match="threshold is NaN"):
        prove_regions(problem, float("nan"))
    with pytest.raises(ValueError, match="max_boxes=0"):
        prove_regions(problem, 0.3, max_boxes=0)
    chain = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
    written = make_parametric(
        chain,
        lambda x: np.array([1, 0, 1, 1]) + np.array([-1, 1, 0, 0]) * x[0],
        low=0.1,
        high=0.9,
        parameters=["p"],
    )
    problem = make_problem(written, np.array([False, True, False]), bound=">=")
    with pytest.raises(ValueError, match="ranges of this model's functions"):
        enclose(problem)
