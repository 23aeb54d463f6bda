"""Properties over a mesh: the answers of the host, from bounds that are left and gone on from."""

import jax
import numpy as np
import pytest

from jaxltl.core.logic.properties import parse_property
from jaxltl.core.models.mesh.shard import shard
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.types import Status
from jaxltl.core.values.properties.solve_on_mesh import first_bounds, question_on_mesh
from jaxltl.core.values.properties.solve_property import solve_property

S = 13
PROPERTIES = (
    'Pmax=? [ F "win" ]',
    'Pmin=? [ !"mid" U "win" ]',
    'Pmax=? [ G !"lose" ]',
    'R{"games"}max=? [ F "over" ]',
    'Tmin=? [ F "over" ]',
    'P>=0.2 [ F "win" ]',
)


def gambler():
    """Two stakes to play for, from two starts, with a reward for each game."""
    rows = [
        [({s: 1.0})]
        if s in (0, S - 1)
        else [{s - 1: 0.5, s + 1: 0.5}, {max(s - 2, 0): 0.6, min(s + 3, S - 1): 0.4}]
        for s in range(S)
    ]
    flat = [row for state in rows for row in state]
    return make_sparse(
        np.cumsum([0] + [len(x) for x in rows]),
        np.cumsum([0] + [len(x) for x in flat]),
        [t for row in flat for t in row],
        [p for row in flat for p in row.values()],
        initial=np.eye(S)[5] / 2 + np.eye(S)[3] / 2,
        label={"win": [S - 1], "lose": [0], "over": [0, S - 1], "mid": [7]},
        rewards={"games": Rewards(state=np.r_[0, np.ones(S - 2), 0])},
    )


@pytest.fixture(scope="module")
def model():
    return gambler()


@pytest.fixture(scope="module")
def sharded(model):
    return shard(model, jax.make_mesh((2,), ("devices",), devices=jax.devices()[:2]))


def asked(sharded, text, steps=1000):
    """The answer, made in so many steps at a time, and how often it was gone on."""
    question = question_on_mesh(sharded, parse_property(text))
    bounds, times = first_bounds(sharded, question), 0
    while True:
        found = question.advance(bounds, question.tolerance(1e-6), steps)
        assert (found.lower <= found.upper).all()
        if not question.goes_on or int(found.num_steps) < steps:
            return question.answer(found, 1e-6), times
        assert (found.lower >= bounds[0]).all() and (found.upper <= bounds[1]).all()
        bounds, times = (found.lower, found.upper), times + 1


@pytest.mark.few(1)
@pytest.mark.parametrize("text", PROPERTIES)
def test_the_answers_are_those_of_the_host(model, sharded, text):
    there, _ = asked(sharded, text)
    here = solve_property(model, text)
    np.testing.assert_array_equal(there.states, here.states)
    np.testing.assert_allclose(there.value, here.value, rtol=1e-5)
    assert (there.lower <= here.upper).all() and (there.upper >= here.lower).all()
    assert there.status == here.status == Status.CONVERGED and there.holds == here.holds


@pytest.mark.few(1)
@pytest.mark.parametrize("text", ['Pmax=? [ F "win" ]', 'Pmax=? [ G !"lose" ]'])
def test_bounds_are_gone_on_from(model, sharded, text):
    """Also of a task that is the opposite of what is reached."""
    there, times = asked(sharded, text, steps=3)
    assert times > 1
    here = solve_property(model, text)
    np.testing.assert_allclose(there.value, here.value, rtol=1e-5)
    assert (there.lower <= here.upper).all() and (there.upper >= here.lower).all()
    assert there.status == Status.CONVERGED


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('R{"r"}max=? [ "a" U "b" ]', "rewards"),
        ('E [ F "a" ]', "quantifiers over paths"),
        ("1 + 2", "expressions"),
        ('Pmax=? [ F<=3 "win" ]', "bounds on steps or rewards are not solved for over a mesh"),
        ('R{"games"}max=? [ C<=3 ]', r"rewards \[ C<=3 \] are not solved for over a mesh"),
        ('LRAmax=? [ "win" ]', "averages in the long run are not solved for over a mesh"),
        ('R{"coins"}max=? [ F "over" ]', "there is no reward 'coins'; the model has 'games'"),
        ('P=? [ F "win" ]', r"ask for Pmax=\? or Pmin=\?"),
        ('Pmax=? [ F "gold" ]', "gold"),
        ('Pmaxmin=? [ F "win" ]', "no intervals"),
    ],
)
def test_what_is_not_answered_is_named(sharded, text, message):
    with pytest.raises(ValueError, match=message):
        question_on_mesh(sharded, parse_property(text))
