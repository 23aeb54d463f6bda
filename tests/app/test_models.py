"""Models of other tools in task and game files: what becomes of their states, actions and names."""

import json
from dataclasses import replace

import numpy as np
import pytest

from jaxltl.app.files.game import GameFile, load_game
from jaxltl.app.files.task_irl import MlirlFile
from jaxltl.app.files.worlds import load_world
from jaxltl.core.models.game import make_game
from jaxltl.core.models.product import product
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from jaxltl.io.model_files import write_model
from jaxltl.io.padded_models import read_padded
from tests.test_cli import failure, run

# Wait at 0, or go to 1, which is red, or by chance to 2, the goal; from 1 a way on to 2.
MODEL = make_sparse(
    [0, 2, 4, 5], [0, 1, 3, 4, 5, 6], [0, 1, 2, 2, 1, 2], [1, 0.25, 0.75, 1, 1, 1],
    initial=[1, 0, 0], label={"Red cell": [1], "goal": [2]},
    action=[0, 1, 1, 0, 2], action_names=["wait", "go", "stay"])  # fmt: skip
TASK = """
[world]
model = "MODEL"

[task]
formula = '!"Red cell" U goal'

[demonstrations]
synthetic = 2

[learner]
method = "mlirl"
discount = 0.9
"""
GAME = """
[game]
model = "MODEL"

[task]
TASK
"""


@pytest.fixture
def task(tmp_path):
    def write(name, text=TASK):
        path = tmp_path / "task.toml"
        path.write_text(text.replace("MODEL", name))
        return path

    return write


@pytest.mark.parametrize("name", ["m.umb", "m.umb.xz", "m.drn", "m.tra", "m.pexp", "m.npz"])
def test_a_model_in_any_format(tmp_path, task, name):
    write_model(tmp_path / name, MODEL)
    read = MlirlFile.read(task(name))
    world = load_world(read.path, read.world)
    assert sorted(world.actions) == ["go", "stay", "wait"]
    column = [world.actions.index(x) for x in ("wait", "go", "stay")]
    available = np.asarray(world.mdp.available)[:, column]
    assert available.tolist() == [[1, 1, 0], [1, 1, 0], [0, 0, 1]]
    assert np.asarray(world.mdp.initial).tolist() == [1, 0, 0]
    assert set(world.mdp.propositions) >= {"Red cell", "goal"}


def test_what_stands_beside_a_file_is_part_of_the_task(tmp_path, task):
    write_model(tmp_path / "m.tra", MODEL)
    before = MlirlFile.read(task("m.tra")).digest
    labels = tmp_path / "m.lab"
    labels.write_text(labels.read_text().replace("goal", "gaol"))
    assert MlirlFile.read(task("m.tra")).digest != before


def test_names_that_need_quotes(tmp_path, task):
    write_model(tmp_path / "m.umb", MODEL)
    text = TASK.replace("[task]", "initial = '!\"Red cell\" & !goal'\n[task]")
    read = MlirlFile.read(task("m.umb", text))
    world = load_world(read.path, read.world)
    assert np.asarray(world.mdp.initial).tolist() == [1, 0, 0]
    prod = product(world.mdp, read.formula)
    best = optimal_satisfaction(prod)
    np.testing.assert_allclose((np.asarray(prod.initial) * best.value).sum(), 0.75, atol=1e-6)


def test_the_command_checks_a_task(tmp_path, task):
    write_model(tmp_path / "m.umb", MODEL)
    result = run("check", task("m.umb"))
    assert result.exit_code == 0, result.output
    assert "ok: " in result.output and "3 states" in result.output


def test_choices_without_names_of_their_own_are_numbered(tmp_path):
    twice = replace(MODEL, action=np.array([0, 0, 1, 0, 2], np.int32))
    write_model(tmp_path / "m.umb", twice)
    found = read_padded(tmp_path / "m.umb")
    assert found.actions == ("choice 0", "choice 1")
    assert np.asarray(found.mdp.available).sum() == 5
    write_model(tmp_path / "m.npz", replace(MODEL, action=None, action_names=()))
    assert read_padded(tmp_path / "m.npz").actions == ("choice 0", "choice 1")
    names = [f"a{i}" for i in range(150)]
    wide = make_sparse(
        np.arange(0, 303, 2)[:152], np.arange(303), np.zeros(302, int), np.ones(302),
        action=np.arange(302) % 150, action_names=names)  # fmt: skip
    write_model(tmp_path / "w.umb", wide)
    assert read_padded(tmp_path / "w.umb").actions == ("choice 0", "choice 1")


def test_a_model_that_is_too_wide_is_refused_with_its_size(tmp_path, task):
    count = 60_000
    wide = make_sparse(None, np.append(0, count + np.arange(count)), np.append(
        np.arange(count), np.arange(1, count)),
        np.append(np.full(count, 1 / count), np.ones(count - 1)), label={"goal": [1]})  # fmt: skip
    write_model(tmp_path / "m.umb", wide)
    message = failure("check", task("m.umb"))
    assert "m.umb': padded to 1 actions of 60000 successors, 60000 states would take 40 GB" in (
        message.replace("\n", " ")
    )


def test_a_game_is_for_synthesis(tmp_path, task):
    write_model(tmp_path / "m.umb", make_game(MODEL, [True, False, True]))
    assert "m.umb' holds a game of two players, expected a model of one" in failure(
        "check", task("m.umb"))  # fmt: skip
    text = GAME.replace("TASK", "formula = '!\"Red cell\" U goal'")
    world = load_game(GameFile.read(task("m.umb", text)))
    assert np.asarray(world.game.system).tolist() == [True, False, True]
    result = run("synthesize", task("m.umb", text), "--out", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout.splitlines()[-1])["outcome"] == "unrealizable"
    write_model(tmp_path / "m.umb", MODEL)
    assert "m.umb' is no game" in failure("check", task("m.umb", text))
