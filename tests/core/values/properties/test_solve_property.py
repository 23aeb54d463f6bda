"""Properties of sparse models are answered by the right solver, as Storm answers them."""

from fractions import Fraction
from functools import partial

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.exact_numbers import exact_numbers
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.sparse.exact import total
from jaxltl.core.sparse.exact.bounded import until_within
from jaxltl.core.sparse.exact.model import Work, double_bounds
from jaxltl.core.types import Status
from jaxltl.core.values.properties import model_query as module
from jaxltl.core.values.properties.solve_property import meets, solve_property
from tests.core.values.undiscounted.test_sparse_satisfaction import random_sparse
from tests.storm_oracle import storm_model, storm_values

PATHS = (
    'F "a"',
    '"c" U "a"',
    'X "a"',
    'true U ("a" & "b")',
    'F<=4 "a" & "b"',
    '"c" U<=3 "b"',
    'F<1 "a"',
    'F{"step"}<=5 "a" & "b"',
    'F{"step"}<5 "a" & "b"',
    '"a" | "b"',
    '!"a" & "init"',
    '!(F "a" & "b")',
    '!("c" U "a")',
    'F[2,4] "a" & "b" & "c"',
    '(G F "a") & (G !"c")',
    'F G "a"',
    '(F "a") & (F "b")',
    'X X "a"',
    'G ("a" | X "b")',
    '(F "a" & "b") | (G !"c")',
    '(G F "a") & (F G !"b")',
    '!"a" & X !"a"',
    '"init" & F "b"',
)
REWARDS = ('F "a" & "b"', "C<=6", "C", "C<1", "C<=0", "I=3", "I=0", "LRA", "S")


def random_rewarded(seed: int, most_rows: int = 3):
    rng = np.random.default_rng(seed)
    model = random_sparse(seed, num_states=8, most_rows=most_rows)
    return model.replace(
        rewards={
            "step": Rewards(choice=rng.integers(0, 4, model.num_rows).astype(float)),
            "place": Rewards(state=rng.integers(0, 4, model.num_states).astype(float)),
        }
    )


def walk(length):
    """A walk that goes up with probability 1/10, from state 1, between absorbing ends."""
    inner = range(1, length)
    starts = [0, 1, *(1 + 2 * x for x in inner), 2 * length]
    ways = [y for x in inner for y in (x - 1, x + 1)]
    return make_sparse(
        None,
        starts,
        [0, *ways, length],
        [1.0, *([0.9, 0.1] * (length - 1)), 1.0],
        initial=np.eye(length + 1)[1],
        label={"low": [0], "high": [length]},
    )


PATHS_UP = ('F "high"', 'G !"low"', '(F "high") & (G !"low")', 'F<=60000 "high"')


def test_small_probabilities_have_a_relative_width():
    model, exact = walk(8), Fraction(8, 9**8 - 1)
    for path in PATHS_UP:
        found = solve_property(model, f"P=? [ {path} ]", relative=True)
        assert found.status == Status.CONVERGED
        # The weights of the model are not tenths, but doubles near them.
        slack = Fraction(1, 10**13) * exact
        lower, upper = Fraction(found.lower[0]), Fraction(found.upper[0])
        assert lower - slack <= exact <= upper + slack and upper - lower <= exact / 10**6
    most = solve_property(model, 'filter(max, P=? [ F "high" ], "init")', relative=True)
    assert most.upper[0] - most.lower[0] <= 1e-6 * most.lower[0]
    high = np.arange(41) == 40
    small = jl.reachability_probability(walk(40), high, relative=True)
    assert small.status == Status.CONVERGED and 1e-38 < small.lower[1] < 1e-37
    never_low = solve_property(walk(40), 'P=? [ G !"low" ]', relative=True)
    assert never_low.status == Status.CONVERGED and 1e-38 < never_low.lower[0] < 1e-37


def test_relative_widths_are_refused_where_they_are_not_supported():
    model = walk(3)
    for text in ('LRA=? [ "high" ]', 'multi(P>=0.1 [ F "high" ])'):
        with pytest.raises(ValueError, match="relative=True is for probabilities"):
            solve_property(model, text, relative=True)
    with pytest.raises(ValueError, match="relative=True is for a SparseMDP"):
        jl.reachability_probability(jl.to_padded(model), np.arange(4) == 3, relative=True)
    for solve in (partial(solve_property, prop='P=? [ F "high" ]'), jl.reachability_probability):
        given = {} if isinstance(solve, partial) else {"target": np.arange(4) == 3}
        with pytest.raises(ValueError, match="relative='yes'; give True or False"):
            solve(model, **given, relative="yes")


def close(found, wanted) -> bool:
    """Whether certified bounds hold a number of Storm's."""
    slack = 2e-6 * max(1, abs(wanted)) if np.isfinite(wanted) else 0
    return found[0] - slack <= wanted <= found[1] + slack


@pytest.mark.parametrize(
    "seed", [*range(4), *(pytest.param(i, marks=pytest.mark.exhaustive) for i in range(4, 30))]
)
def test_storm_agrees(seed):
    pytest.importorskip("stormpy")
    model = random_rewarded(seed, most_rows=1 if seed % 4 == 0 else 3)
    storm = storm_model(model)
    signs = ("",) if model.is_chain else ("max", "min")
    asked = [f"P{sign}=? [ {path} ]" for path in PATHS for sign in signs]
    asked += [f'R{{"place"}}{sign}=? [ {path} ]' for path in REWARDS for sign in signs]
    asked += [f'R{{"step"}}{sign}=? [ {path} ]' for path in REWARDS[:5] for sign in signs]
    asked += [f'T{sign}=? [ F "a" ]' for sign in signs]
    asked += [f'LRA{sign}=? [ "a" | "b" ]' for sign in signs]
    for text in asked:
        found = solve_property(model, text)
        assert found.status == Status.CONVERGED, text
        for low, high, wanted in zip(
            found.lower, found.upper, storm_values(storm, text), strict=True
        ):
            assert close((low, high), wanted), (text, low, high, wanted)
            assert low == high or high - low <= 1e-6 * max(1, abs(high)), text


@pytest.mark.parametrize("seed", range(2))
def test_storm_agrees_on_thresholds(seed):
    pytest.importorskip("stormpy")
    model = random_rewarded(seed, most_rows=2)
    storm = storm_model(model)
    for path in ('F "a" & "b"', 'X "a"', '"c" U "a"', '(G F "a") & (G !"c")'):
        for relation in (">=", ">", "<=", "<"):
            for threshold in ("0", "0.3", "0.7", "1"):
                for text in (
                    f"P{relation}{threshold} [ {path} ]",
                    f"Pmax{relation}{threshold} [ {path} ]",
                    f"Pmin{relation}{threshold} [ {path} ]",
                ):
                    found = solve_property(model, text)
                    assert found.holds == storm_values(storm, text), text


# --- what Storm does not take ------------------------------------------------------------------


def both(model, text, same):
    """The answers to two properties that mean the same."""
    found, wanted = solve_property(model, text), solve_property(model, same)
    np.testing.assert_allclose(found.value, wanted.value, atol=2e-6)
    assert (found.lower <= wanted.upper).all() and (wanted.lower <= found.upper).all()


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ('G<=4 "a" | "b"', '!(F<=4 !("a" | "b"))'),
        ('"a" W "b"', '("a" U "b") | G "a"'),
        ('"a" R "b"', '"b" W ("a" & "b")'),
        ('"a" R<=3 "b"', '!(!"a" U<=3 !"b")'),
        ('"a" W<=3 "b"', '("a" U<=3 "b") | (G<=3 "a")'),
        ('F>=2 "a"', 'X X F "a"'),
        ('F=2 "a"', 'X X "a"'),
        ('"a" U[1,2] "b"', '"a" && X ("b" || ("a" && X "b"))'),
        ('G "a" => X "b"', 'G (!"a" | X "b")'),
    ],
)
def test_what_means_the_same_has_the_same_value(text, same):
    model = random_rewarded(5)
    for sign in ("max", "min"):
        both(model, f"P{sign}=? [ {text} ]", f"P{sign}=? [ {same} ]")


def chance(p, more=0):
    """A state that goes to `a` with probability p, else away, and so many that stand still."""
    size = 3 + more
    loops = np.arange(1, size)
    return make_sparse(
        None,
        np.append([0, 2], 2 + np.arange(1, size)),
        np.append([1, 2], loops),
        np.append([p, 1 - p], np.ones(size - 1)),
        initial=[1] + [0] * (size - 1),
        label=np.arange(size)[:, None] == 1,
        propositions=["a"],
        rewards={"r": Rewards(state=np.ones(size))},
    )


def test_a_threshold_that_the_bounds_touch_is_not_guessed():
    third = chance(1 / 3)  # a double just below 1/3
    found = solve_property(third, 'P>=1/3 [ F "a" ]')
    assert found.holds in ([None], [False])
    found = solve_property(third, 'P>=0.333 [ F "a" ]')
    assert found.holds == [True] and found.status == Status.CONVERGED


def test_undecided_thresholds_are_tried_again_more_narrowly(monkeypatch):
    model, asked = chance(0.25), []
    original = module.reachability_probability

    def wide(*arguments, tolerance, **options):
        asked.append(tolerance)
        found = original(*arguments, tolerance=tolerance, **options)
        half = tolerance / 2
        return found.replace(lower=found.value - half, upper=found.value + half)

    monkeypatch.setattr(module, "reachability_probability", wide)
    found = solve_property(model, 'P>0.2499999 [ F "a" ]', tolerance=1e-3)
    assert found.holds == [True] and asked == [1e-3, 1e-6, 1e-9][: len(asked)] and len(asked) > 1
    found = solve_property(chance(0.25, more=1000), 'P>=0.25 [ F "a" ]')
    assert found.holds == [None] and found.status == Status.PRECISION
    assert found.lower < 0.25 < found.upper


def test_zero_and_one_are_exact():
    model = chance(0.25)
    for text, truth in (
        ('P>0 [ F "a" ]', True),
        ('P>=1 [ F ("a" | !"a") ]', True),
        ('P<1 [ F "deadlock" ]', False),
        ('P<=0 [ G F !"deadlock" ]', True),
        ('P>=1 [ F G "deadlock" ]', True),
    ):
        found = solve_property(model, text)
        assert found.holds == [truth] and found.status == Status.CONVERGED, text


def test_several_initial_states_have_a_value_each():
    model = random_rewarded(1)
    found = solve_property(model, 'Pmax=? [ F "a" & "b" ]')
    assert found.states.tolist() == [0, 1, 2] and found.value.shape == (3,)
    every = solve_property(model, 'Pmax=? [ F "a" & "b" ]', states=np.arange(model.num_states))
    np.testing.assert_array_equal(found.value, every.value[:3])
    later = solve_property(model, 'Pmax=? [ (G F "a") & (F "b") ]', states=[4, 2])
    assert later.value.shape == (2,)
    alone = solve_property(model, 'Pmax=? [ (G F "a") & (F "b") ]', states=[2])
    assert abs(later.value[1] - alone.value[0]) < 1e-6


def test_infinite_rewards_are_infinite():
    model = chance(0.25)
    found = solve_property(model, 'R=? [ F "a" ]')
    assert found.value == found.lower == found.upper == np.inf
    assert found.status == Status.CONVERGED
    assert solve_property(model, 'R{"r"}<=100 [ F "a" ]').holds == [False]
    assert abs(solve_property(model, 'T=? [ F "deadlock" ]').value - 1) < 1e-9


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('P=? [ F "a" ]', "ask for Pmax=\\? or Pmin=\\?"),
        ('R{"step"}=? [ C ]', 'ask for R{"step"}max=\\?'),
        ('Pmax=? [ F "gaol" ]', "'gaol'.*a, b, c, init, deadlock"),
        ('Pmax=? [ G F "gaol" ]', "'gaol'.*a, b, c, init, deadlock"),
        ('R{"stpe"}max=? [ C<=3 ]', "'stpe'.*'step', 'place'"),
        ("Rmax=? [ C<=3 ]", "'step', 'place'"),
        ('Pmax=? [ F[3,200] "a" ]', "up to 100 steps"),
    ],
)
def test_mistakes_are_named(text, message):
    with pytest.raises(ValueError, match=message):
        solve_property(random_rewarded(1), text)


def test_models_of_every_kind_have_properties():
    world = jl.make_mdp([[[1, 2], [1, 2]], [[1, 1]] * 2, [[2, 2]] * 2],
                        [[[0.5, 0.5], [0.25, 0.75]], [[1.0, 0]] * 2, [[1.0, 0]] * 2],
                        label={"a": [1]}, initial=[1, 0, 0])  # fmt: skip
    for model in (world, jl.models.to_dense(world), jl.to_sparse(world), jl.product(world, "F a")):
        assert solve_property(model, 'Pmax=? [ F "a" ]').value.tolist() == [0.5]
        assert solve_property(model, 'P>=0.25 [ F "a" ]').holds == [True]
    # All players are one where there is no game.
    assert solve_property(world, '<<system>> Pmax=? [ F "a" ]').value.tolist() == [0.5]
    with pytest.raises(ValueError, match="give a property or its text"):
        solve_property(chance(0.5), 0.5)


@pytest.mark.parametrize("seed", range(20))
def test_conditional_probabilities_are_quotients(seed):
    """Against the chain with the memory of which of the two labels were seen."""
    rng = np.random.default_rng(seed)
    size = 6
    matrix = rng.dirichlet(np.ones(size) / 2, size) * (rng.random((size, size)) < 0.5)
    matrix[np.arange(size), rng.integers(size, size=size)] += 0.1
    matrix /= matrix.sum(1, keepdims=True)
    marks = rng.random((size, 2)) < 0.25
    model = jl.to_sparse(jl.from_dense(matrix[:, None], label=marks, propositions=["a", "b"]))
    seen = np.zeros((2, 2, size, 2, 2, size))
    for a, b, s, t in np.ndindex(2, 2, size, size):
        seen[a, b, s, a | int(marks[t, 0]), b | int(marks[t, 1]), t] = matrix[s, t]
    limit = np.linalg.matrix_power(seen.reshape(4 * size, -1), 2**20).reshape(
        2, 2, size, 2, 2, size
    )
    start = [limit[int(marks[s, 0]), int(marks[s, 1]), s].sum(-1) for s in range(size)]
    for s, mass in enumerate(start):
        text = 'P=? [ F "a" || F "b" ]'
        if mass[:, 1].sum() < 1e-12:
            with pytest.raises(ValueError, match=rf"has probability 0 in state {s}"):
                solve_property(model, text, states=[s])
            continue
        found = solve_property(model, text, states=[s])
        exact = mass[1, 1] / mass[:, 1].sum()
        assert found.status == Status.CONVERGED
        assert found.lower[0] - 1e-9 <= exact <= found.upper[0] + 1e-9
        assert found.upper[0] - found.lower[0] <= 1e-6
        less = solve_property(model, 'P>=0.5 [ F "a" || F "b" ]', states=[s]).holds[0]
        assert less == (exact >= 0.5) or abs(exact - 0.5) < 1e-9
    negated = solve_property(model, 'P=? [ G !"a" || true ]', states=[0]).value[0]
    assert negated == pytest.approx(start[0][0].sum(), abs=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('Pmax=? [ F "a" || F "b" ]', "Markov chains"),
        ('Pmax=? [ F "a" || F "b" || F "a" ]', "one condition"),
        ('Rmax=? [ F "a" || F "b" ]', "\\|\\|"),
        ('multi(Pmax=? [ F "a" || F "b" ])', "no conditional probabilities"),
    ],
)
def test_conditions_that_are_not_solved_for(text, message):
    with pytest.raises(ValueError, match=message):
        solve_property(random_rewarded(1), text)


def test_coalitions_of_the_players_of_a_game():
    """The system may stay away from a, and the environment takes the worse of two coins."""
    world = jl.make_mdp([[[1, 2], [2, 2]], [[2, 3], [2, 3]], [[2, 2]] * 2, [[3, 3]] * 2],
                        [[[0.5, 0.5], [1.0, 0]], [[0.5, 0.5], [0.25, 0.75]], [[1.0, 0]] * 2, [[1.0, 0]] * 2],
                        label={"a": [3]}, initial=[1, 0, 0, 0])  # fmt: skip
    game = jl.make_game(world, [True, False, True, True])

    def ask(text, model=game):
        return solve_property(model, text)

    for coalition, direction, value in (
        ("system", "max", 0.25), ("system", "min", 0), ("environment", "max", 0),
        ("environment", "min", 0.25), ("system, environment", "max", 0.375),
        ("system, environment", "min", 0), ("", "max", 0), ("", "min", 0.375),
    ):  # fmt: skip
        prop = f'<<{coalition}>> P{direction}=? [ F "a" ]'
        assert ask(prop).value.tolist() == [value], prop
        assert ask(f'<<{coalition}>> P{direction}=? [ F G "a" ]').value[0] == pytest.approx(value)
        assert ask(prop, jl.product(game, "F a")).value.tolist() == [value]
    assert ask('<<system>> P>=0.24 [ F "a" ]').holds == [True]  # by some strategy
    assert ask('<<system>> P>=0.3 [ F "a" ]').holds == [False]
    assert ask('<<environment>> P<=0.3 [ F "a" ]').holds == [True]
    assert ask('<<system>> P>=1 [ F (<<environment>> P>=0.5 [ X "a" ]) ]').holds == [False]
    assert ask('<<system>> Pmax=? [ F<=1 "a" ]').value.tolist() == [0]
    assert ask('filter(max, <<system>> Pmax=? [ F "a" ])').value.tolist() == [1]
    for text, message in (
        ('Pmax=? [ F "a" ]', "who chooses for it; ask for <<system>> Pmax="),
        ('<<me>> Pmax=? [ F "a" ]', "player='me'; choose one of system, environment"),
        ('<<system>> P=? [ F "a" ]', "say what the coalition wants"),
        ('<<system>> Pmaxmin=? [ F "a" ]', "no intervals"),
        ('<<system>> multi(Pmax=? [ F "a" ])', "after a coalition"),
        ('<<system Pmax=? [ F "a" ]', ">>"),
    ):
        with pytest.raises(ValueError, match=message):
            ask(text)


@pytest.mark.parametrize(
    ("relation", "lower", "upper", "verdict"),
    [
        (">=", 0.5, 0.6, True),
        (">=", 0.4, 0.49, False),
        (">=", 0.4, 0.5, None),
        (">", 0.5, 0.6, None),
        (">", 0.51, 0.6, True),
        (">", 0.4, 0.5, False),
        ("<=", 0.4, 0.5, True),
        ("<=", 0.4, 0.6, None),
        ("<=", 0.51, 0.6, False),
        ("<", 0.4, 0.5, None),
        ("<", 0.4, 0.49, True),
        ("<", 0.5, 0.6, False),
        (">=", np.inf, np.inf, True),
        ("<", np.inf, np.inf, False),
        (">=", np.nan, np.nan, None),
        (">=", -np.inf, np.inf, None),
    ],
)
def test_bounds_decide_thresholds(relation, lower, upper, verdict):
    assert meets(relation, Fraction(1, 2), lower, upper) is verdict


@pytest.mark.parametrize(
    "text",
    ['LRAmax=? [ "a" ]', "Rmax=? [ LRA ]", "Rmin=? [ C ]", "Rmax=? [ C<=3 ]", 'Pmax=? [ F "a" ]'],
)
def test_it_is_told_how(text):
    model = make_sparse(
        [0, 2, 3],
        [0, 2, 3, 4],
        [0, 1, 0, 1],
        [0.75, 0.25, 1, 1],
        initial=[1, 0],
        label={"a": [1]},
        rewards={"r": Rewards(state=np.array([1.0, 0]))},
    )
    assert solve_property(model, text).method


def test_thresholds_that_are_met_with_equality_are_decided_in_small_chains():
    coin = jl.make_sparse(
        None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1], initial=[1, 0, 0], label={"a": [1]}
    )
    for relation, holds in ((">=", True), (">", False), ("<=", True), ("<", False)):
        for path in ('F "a"', 'G !"a"', '(!"a") U "a"'):
            found = jl.solve_property(coin, f"P{relation}0.5 [ {path} ]")
            assert found.holds == [holds] and found.status == jl.Status.CONVERGED, path
    # 1/3 is not a double: bounds stay apart, and the model is solved in fractions.
    retry = jl.make_sparse(
        None,
        [0, 3, 4, 5],
        [0, 1, 2, 1, 2],
        [0.25, 0.25, 0.5, 1, 1],
        initial=[1, 0, 0],
        label={"a": [1]},
    )
    third = jl.solve_property(retry, 'P>=1/3 [ F "a" ]')
    assert third.holds == [True] and third.status == 0
    assert third.lower < Fraction(1, 3) < third.upper == np.nextafter(third.lower, 1)


@pytest.mark.parametrize(
    ("path", "least", "most"),
    [
        ('F "a"', 0.25, 0.5),
        ('(!"b") U "a"', 0.25, 0.5),
        ('X "a"', 0.125, 0.25),
        ('F<=3 "a"', 0.21875, 0.4375),
        ('(!"b") U<=3 "a"', 0.21875, 0.4375),
        ('G !"a"', 0.5, 0.75),
        ('G<=2 !"a"', 0.625, 0.8125),
    ],
)
def test_thresholds_of_small_mdps_are_decided(path, least, most):
    retry = jl.make_sparse(  # two ways to try again with probability 1/2
        [0, 2, 3, 4],
        [0, 3, 6, 7, 8],
        [0, 1, 2, 0, 1, 2, 1, 2],
        [0.5, 0.125, 0.375, 0.5, 0.25, 0.25, 1, 1],
        initial=[1, 0, 0],
        label={"a": [1], "b": [2]},
    )
    thresholds = ((">=", least, True), (">", least, False), ("<=", most, True), ("<", most, False))
    for relation, threshold, holds in thresholds:
        found = jl.solve_property(retry, f"P{relation}{threshold} [ {path} ]")
        assert found.holds == [holds] and found.status == jl.Status.CONVERGED, relation
        assert found.lower == found.upper == threshold


def exact_bounds(values):
    return np.array([double_bounds(x) for x in values]).T


def test_a_minimum_is_that_of_a_policy_that_may_wait_for_ever():
    """State 0 may wait for ever, so that 1 solves the equation of the minimum, which is 0."""
    wait = jl.make_sparse([0, 2, 3], [0, 1, 2, 3], [0, 1, 1], [1.0] * 3)
    target, mdp = np.array([False, True]), exact_numbers(wait).mdp
    assert total.reachability(mdp, target, None, True, Work()) == [1, 1]
    assert total.reachability(mdp, target, None, False, Work()) == [0, 1]


@pytest.mark.parametrize("seed", range(10))
def test_exact_bounds_of_random_mdps_agree_with_the_solvers(seed):
    rng = np.random.default_rng(seed)
    count = rng.integers(1, 4, 8)
    rows = [rng.choice(8, rng.integers(1, 4), replace=False) for _ in range(count.sum())]
    chance = np.concatenate([rng.dirichlet(np.ones(len(row))) for row in rows])
    entry = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    model = jl.make_sparse(
        np.concatenate([[0], count.cumsum()]), entry, np.concatenate(rows), chance
    )
    target, stay = rng.random(8) < 0.3, rng.random(8) < 0.8
    for objective in ("max", "min"):
        until = jl.reachability_probability(model, target, stay=stay, objective=objective)
        steps = jl.values.bounded_reachability(model, target, 4, stay=stay, objective=objective)
        once = jl.values.next_probability(model, target, objective=objective)
        mdp, largest = exact_numbers(model).mdp, objective == "max"
        free, entered = [Fraction(0)] * len(mdp.rows), [Fraction(int(x)) for x in target]
        for solution, values in (
            (until, total.reachability(mdp, target, stay, largest, Work())),
            (steps, until_within(mdp, target, stay, 4, largest, Work())),
            (once, mdp.backup(free, entered, largest, Work())),
        ):
            bounds = exact_bounds(values)
            assert (solution.lower <= bounds[1]).all() and (bounds[0] <= solution.upper).all()
            assert (np.nextafter(bounds[0], 2) >= bounds[1]).all()


@pytest.mark.parametrize("seed", range(20))
def test_rational_arithmetic_agrees_with_the_solver(seed):
    rng = np.random.default_rng(seed)
    size = int(rng.integers(3, 20))
    width = rng.integers(1, 4, size)
    start = np.concatenate([[0], width.cumsum()])
    successor = np.concatenate([rng.choice(size, min(w, size), replace=False) for w in width])
    chance = rng.random(start[-1]) + 0.05
    chance /= np.repeat(np.add.reduceat(chance, start[:-1]), width)
    chain = jl.make_sparse(None, start, successor, chance)
    target, stay = rng.random(size) < 0.2, rng.random(size) < 0.9
    for within in (None, stay):
        mdp = exact_numbers(chain).mdp
        lower, upper = exact_bounds(total.reachability(mdp, target, within, True, Work()))
        found = jl.reachability_probability(chain, target, stay=within)
        assert (np.nextafter(lower, 2) >= upper).all()
        assert (found.lower <= upper).all() and (lower <= found.upper).all()
