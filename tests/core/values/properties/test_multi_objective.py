"""`multi(...)` is answered as Storm answers it, and thresholds mean the fractions written."""

from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.types import Status
from jaxltl.core.values.multi_objective.multi_objective import (
    Achievable,
    ConstrainedOptimum,
    Pareto,
)
from jaxltl.core.values.properties.solve_property import solve_property
from tests.core.values.properties.test_solve_property import random_rewarded
from tests.storm_oracle import storm_model, storm_values


def fork(chance=0.5):
    """To a, to b, or by a coin to either."""
    return make_sparse(
        [0, 3, 4, 5],
        [0, 1, 2, 4, 5, 6],
        [1, 2, 1, 2, 1, 2],
        [1, 1, chance, 1 - chance, 1, 1],
        initial=[1, 0, 0],
        label={"a": [1], "b": [2]},
    )


def delayed(model, steps):
    """The model after some steps, each of which is a state after its own ones."""
    mdp, size = model.host, model.num_states
    ahead = np.append(np.arange(size + 1, size + steps), 0)  # the initial state is the first one
    return make_sparse(
        np.append(mdp.row_start, mdp.num_rows + 1 + np.arange(steps)),
        np.append(mdp.entry_start, mdp.num_transitions + 1 + np.arange(steps)),
        np.append(mdp.successor, ahead),
        np.append(mdp.probability, np.ones(steps)),
        initial=np.arange(size + steps) == size,
        label={
            name: np.flatnonzero(np.asarray(column))
            for name, column in zip(model.propositions, np.asarray(model.label).T, strict=True)
        },
    )


@pytest.mark.parametrize(
    ("text", "verdict"),
    [
        ('multi(P>=0.5 [ F "a" ], P>=0.5 [ F "b" ])', True),
        ('multi(P>=0.5 [ F "a" ], P>=0.51 [ F "b" ])', False),
        ('multi(P>=1 [ F "a" ], P<=0 [ F "b" ])', True),
        ('multi(P>=1/3 [ F "a" ], P>=0.6 [ F "b" ], T<=1.01 [ F "a" | "b" ])', True),
        ('multi(P>=0.9 [ G !"b" ], P>=0.2 [ X "b" ])', False),
        ('multi(P>=0.3 [ F<=1 "a" ], P>=0.6 [ (G F "b") & (X "b") ])', True),
    ],
)
def test_what_can_be_met(text, verdict):
    found = solve_property(fork(), text)
    assert isinstance(found, Achievable)
    assert found.holds is verdict and found.status == Status.CONVERGED


def test_the_best_value_beside_thresholds():
    found = solve_property(fork(), 'multi(Pmax=? [ F "a" ], P>=0.25 [ F "b" ])')
    assert isinstance(found, ConstrainedOptimum) and found.holds
    assert found.lower <= 0.75 <= found.upper and found.upper - found.lower <= 1e-6
    third = solve_property(fork(), 'multi(Pmax=? [ F "a" ], P>=1/3 [ F "b" ])')
    assert third.lower <= 2 / 3 <= third.upper and third.status == Status.CONVERGED
    none = solve_property(fork(), 'multi(Pmax=? [ F "a" ], P>=0.5 [ F "b" ], P>=0.6 [ F "a" ])')
    assert none.holds is False and np.isnan(none.value)


def test_thresholds_on_the_curve_are_decided_in_fractions():
    found = solve_property(fork(), 'multi(P>=1/3 [ F "a" ], P>=2/3 [ F "b" ])')
    assert found.holds is True and found.status == Status.CONVERGED
    np.testing.assert_allclose(found.share @ found.front.points, [1 / 3, 2 / 3], rtol=1e-14)
    beyond = "0.66666666666666666667"
    found = solve_property(fork(), f'multi(P>=1/3 [ F "a" ], P>={beyond} [ F "b" ])')
    assert found.holds is False and found.status == Status.CONVERGED
    best = solve_property(fork(), 'multi(Pmin=? [ F "b" ], P>=1/3 [ F "a" ], P>=2/3 [ F "b" ])')
    assert best.holds and best.status == Status.CONVERGED
    assert Fraction(best.lower) <= Fraction(2, 3) <= Fraction(best.upper)
    assert best.upper - best.lower <= 2e-16


def test_a_threshold_that_no_double_is_is_not_guessed():
    # 1/3 and 2/3 can just be met, but no double says so, and the model is too large for fractions.
    model = delayed(fork(), 60)
    found = solve_property(model, 'multi(P>=1/3 [ F "a" ], P>=2/3 [ F "b" ])')
    assert found.holds is None and found.status == Status.PRECISION
    np.testing.assert_allclose(found.nearest.lower, [1 / 3, 2 / 3], rtol=1e-14)
    assert (found.nearest.gap <= 1e-14).all() and found.nearest.gap.any()
    best = solve_property(model, 'multi(Pmin=? [ F "b" ], P>=1/3 [ F "a" ], P>=2/3 [ F "b" ])')
    assert best.holds is None and (best.nearest.gap <= 1e-14).all()
    assert best.nearest.gap[0] == 0 and best.nearest.lower[0] <= 2 / 3 <= best.nearest.upper[0]


def test_the_curve():
    found = solve_property(fork(), 'multi(Pmax=? [ F "a" ], Pmax=? [ F "b" ])')
    assert isinstance(found, Pareto)
    np.testing.assert_allclose(found.points, [[0, 1], [1, 0]], atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('multi(P>0.5 [ F "a" ], P>=0.5 [ F "b" ])', "write >="),
        ('multi(Pmin>=0.5 [ F "a" ], P>=0.5 [ F "b" ])', "write P>="),
        ('multi(P=? [ F "a" ], P>=0.5 [ F "b" ])', "Pmax=\\?"),
        ('multi(LRAmax=? [ "a" ], P>=0.5 [ F "b" ])', "T are supported"),
        ('multi(Pmax=? [ F "c" ], P>=0.5 [ F "b" ])', "'c'"),
        ('multi(Pmax=? [ F{"x"}<=3 "a" ], P>=0.5 [ F "b" ])', "at most 100 steps"),
    ],
)
def test_what_is_not_solved_is_named(text, message):
    with pytest.raises(ValueError, match=message):
        solve_property(fork(), text)


def test_several_objectives_are_of_the_initial_distribution():
    with pytest.raises(ValueError, match="not supported from other than the initial states"):
        solve_property(fork(), 'multi(P>=0.5 [ F "a" ], P>=0.5 [ F "b" ])', states=[0])


@pytest.mark.parametrize("seed", (1, 3, 4))
def test_storm_agrees(seed):
    pytest.importorskip("stormpy")
    model = random_rewarded(seed)
    initial = np.zeros(model.num_states)
    initial[0] = 1
    model = model.replace(initial=initial)
    storm = storm_model(model)
    for text in (
        'multi(Pmax=? [ F "a" & "b" & "c" ], P>=0.3 [ G !("a" & "c") ])',
        'multi(Pmax=? [ X "a" ], P>=0.25 [ "c" U "b" ])',
        'multi(Pmin=? [ F "a" & "b" ], P>=0.5 [ F "c" ])',
    ):
        try:
            (wanted,) = storm_values(storm, text)
        except RuntimeError:  # what Storm does not take
            continue
        found = solve_property(model, text)
        if wanted is False or not found.holds:
            assert wanted is False and found.holds is False
        else:  # Storm's precision here is 1e-4
            assert found.lower - 2e-4 <= wanted <= found.upper + 2e-4, text
