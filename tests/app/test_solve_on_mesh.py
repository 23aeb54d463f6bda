"""Solving over a mesh, left and gone on from: to the same bits there, to as good bounds elsewhere."""

import json

import jax
import numpy as np
import pytest
from click.testing import CliRunner

from jaxltl.algos.common import checkpoint
from jaxltl.app import solve_on_mesh
from jaxltl.app.processes import ProcessGroup
from jaxltl.cli import main
from jaxltl.core.types import Status
from jaxltl.io.model_files import write_model
from jaxltl.io.prism.properties import parse_queries
from tests.several import walk

PROPERTY = 'Pmax=? [ F "win" ]'


def group_of(devices):
    mesh = jax.make_mesh((devices,), ("devices",), devices=jax.devices()[:devices])
    return ProcessGroup(mesh=mesh)


def solved(devices, directory, text=PROPERTY):
    group = group_of(devices)
    model = solve_on_mesh.on_mesh(walk(16), group)
    solver = solve_on_mesh.MeshSolver(group, model, {}, 1e-6, directory)
    solver.agree([text])
    (result,) = solver.solve(parse_queries([text]))
    return result


@pytest.fixture
def often(monkeypatch):
    monkeypatch.setattr(solve_on_mesh, "steps_between", lambda model: 40)


class Left(Exception):
    """In place of a death."""


@pytest.mark.slow
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
    assert made == [40, 80, 120] and len(list(tmp_path.iterdir())) == 1
    found = solved(other, tmp_path).answer
    assert made[3] == 160 and not list(tmp_path.iterdir())
    assert found.status == Status.CONVERGED
    if other == 2:
        np.testing.assert_array_equal(found.lower, whole.lower)
        np.testing.assert_array_equal(found.upper, whole.upper)
    assert (found.lower <= whole.upper).all() and (found.upper >= whole.lower).all()
    np.testing.assert_allclose(found.value, 0.4, atol=1e-6)


def test_bounds_of_another_question_are_left_alone(often, tmp_path, monkeypatch):
    monkeypatch.setattr(solve_on_mesh, "MAX_STEPS", 80)
    left = solved(2, tmp_path)
    assert left.answer.status == Status.MAX_STEPS and left.exit_status == 1
    assert left.answer.lower < 0.4 < left.answer.upper
    refused = solved(2, tmp_path, 'Pmax=? [ F<=3 "win" ]')
    assert refused.answer is None and "not solved for over a mesh" in refused.error


@pytest.mark.slow
def test_from_the_command_line(tmp_path):
    assert len(jax.devices()) == 4  # made before, so that no other test has fewer
    write_model(tmp_path / "walk.umb", walk(16))
    model = str(tmp_path / "walk.umb")
    bounds = ["--checkpoint", str(tmp_path / "bounds")]
    done = CliRunner().invoke(main, ["solve", model, PROPERTY, "--json", *bounds, "--mesh", "2"])
    assert done.exit_code == 0 and "on 2 CPU devices\n" in done.stderr, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    del told["model"]["seconds"]
    assert told["model"] == {"kind": "chain", "states": 16, "choices": 16, "transitions": 30}
    (result,) = told["results"]
    assert result["lower"] <= 0.4 <= result["upper"] <= result["lower"] + 1e-6
    assert result["method"] == "interval iteration on the mesh"
    for options, message in (
        (["--mesh", "99"], "--mesh 99: there are 4 (cpu); give fewer, or --mesh alone for all"),
        (["--mesh", "--strategy", "x.json"], "--strategy goes without --mesh alone"),
        (["--mesh", "--relative"], "--relative goes without --mesh alone"),
        (bounds, "--checkpoint goes with --mesh alone"),
        (["--mesh", "two"], "--mesh two: give a number of devices, or all"),
        (["--process", "1"], "--process needs --mesh"),
    ):
        wrong = CliRunner().invoke(main, ["solve", model, PROPERTY, *options])
        assert wrong.exit_code == 2 and f"error: {message}" in wrong.stderr
