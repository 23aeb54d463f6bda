"""Solving over a mesh, left and gone on from: to the same bits there, to as good bounds elsewhere.
"""

import jax
import numpy as np
import pytest

from jaxltl.algos import checkpoint
from jaxltl.app import solve_on_mesh
from jaxltl.app.processes import Place
from jaxltl.app.solve import asked_for
from jaxltl.core.types import Status
from tests.several import walk

PROPERTY = 'Pmax=? [ F "win" ]'


def place_of(devices):
    mesh = jax.make_mesh((devices,), ("devices",), devices=jax.devices()[:devices])
    return Place(mesh=mesh)


def solved(devices, directory, text=PROPERTY):
    (result,) = solve_on_mesh.solve_in(
        place_of(devices), walk(16), asked_for([text]), 1e-6, directory, [text])
    return result


@pytest.fixture
def often(monkeypatch):
    monkeypatch.setattr(solve_on_mesh, "steps_between", lambda model: 2)


class Left(Exception):
    """In place of a death."""


@pytest.mark.parametrize("other", [2, 4])
def test_bounds_are_gone_on_from_there_and_elsewhere(often, tmp_path, monkeypatch, other):
    whole = solved(2, None).answer
    assert whole.status == Status.CONVERGED
    save, made = checkpoint.save, []

    def save_and_leave(path, state, given):
        save(path, state, given)
        made.append(int(state["made"]))
        if len(made) == 3:
            raise Left

    monkeypatch.setattr(solve_on_mesh.files, "save", save_and_leave)
    with pytest.raises(Left):
        solved(2, tmp_path)
    assert made == [2, 4, 6] and len(list(tmp_path.iterdir())) == 1
    found = solved(other, tmp_path).answer
    assert made[3] == 8 and not list(tmp_path.iterdir())
    assert found.status == Status.CONVERGED
    if other == 2:
        np.testing.assert_array_equal(found.lower, whole.lower)
        np.testing.assert_array_equal(found.upper, whole.upper)
    assert (found.lower <= whole.upper).all() and (found.upper >= whole.lower).all()
    np.testing.assert_allclose(found.value, 0.4, atol=1e-6)


def test_bounds_of_another_question_are_left_alone(often, tmp_path, monkeypatch):
    monkeypatch.setattr(solve_on_mesh, "MAX_STEPS", 4)
    left = solved(2, tmp_path)
    assert left.answer.status == Status.MAX_STEPS and left.exit_status == 1
    assert left.answer.lower < 0.4 < left.answer.upper
    refused = solved(2, tmp_path, 'Pmax=? [ F<=3 "win" ]')
    assert refused.answer is None and "not solved for over a mesh" in refused.error
