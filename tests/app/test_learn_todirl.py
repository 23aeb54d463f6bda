"""`jaxltl learn` for a reward that carries over: the task file, the run, what it writes."""

import json
import re

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.app import learn_todirl
from jaxltl.app.files.scenes import cell_observations, load_automata, load_scenes
from jaxltl.app.files.task import kind_of
from jaxltl.app.files.task_irl import TodirlFile
from jaxltl.app.learn_todirl import report as report_todirl
from jaxltl.envs import temporal_gridworld
from jaxltl.io.colored_world import write_world
from jaxltl.io.learned_reward import load_reward, plan_in
from tests.support import replaced
from tests.test_cli import failure, interrupt_soon, run

TASK = """
[world]
maps = ["world.txt", "other.txt"]
objects = { o1 = { red = 5, black = 4 }, o2 = { yellow = 5, black = 4 } }

[task]
formula = "(!o2 & !ob) U (o1 & (!ob U o2))"

[demonstrations]
synthetic = 40
discount = 0.9
length = 30

[learner]
method = "todirl"
discount = 0.9
hidden = [12]
steps = 60
learning_rate = 0.02
patience = 15

[test]
generate = 2
obstacles = 1
shape = [6, 6]
"""
MAPS_LINE = 'maps = ["world.txt", "other.txt"]'
KINDS = "objects = { o1 = { red = 5, black = 4 }, o2 = { yellow = 5, black = 4 } }"
OBJECTS = {name: temporal_gridworld.OBJECTS[name] for name in ("o1", "o2")}
WORLD = temporal_gridworld.make_world(
    {"o1": [(1, 2)], "o2": [(6, 5)], "ob": [(3, 5)]}, 0, shape=(6, 6), objects=OBJECTS
)
OTHER = temporal_gridworld.make_world(
    {"o1": [(6, 6)], "o2": [(1, 4)], "ob": [(5, 2)]}, 1, shape=(6, 6), objects=OBJECTS
)

PLAIN = '''
[world]
maps = ["""
. . a
. r .
b . .
""", { file = "second.txt" }, "third.txt"]
legend = { "." = [], a = ["a"], b = ["b"], r = ["r"] }
initial = "!r"
slip = 0.1

[task]
formula = "!r U (a & (!r U b))"
label_on = "entry"

[demonstrations]
files = ["first.json", "second.json", "second.json"]

[learner]
method = "todirl"
discount = 1.0
hidden = []
held_out = 0.0
steps = 20
horizon = 9
learning_rate = 0.1
memory = "F (a & F b)"

[test]
maps = ["open.txt", "walled.txt", "walled_too.txt"]
leave_out = ["walled.txt"]
'''
MAPS = {
    "second.txt": ". b\n. r\na .\n",
    "third.txt": ". b\n. .\na .\n",
    "open.txt": "b . a\n. . .\n",
    "walled.txt": "b # a\n. # .\n",
    "walled_too.txt": "b # a\n. # .\n",
}
SHOWN = {
    "first.json": [
        {
            "cells": [[1, 1], [1, 2], [1, 3], [1, 2], [1, 1], [2, 1], [3, 1]],
            "actions": ["right", "right", "left", "left", "down", "down"],
        }
    ],
    "second.json": [
        {
            "cells": [[3, 2], [3, 1], [2, 1], [1, 1], [1, 2]],
            "actions": ["left", "up", "up", "right"],
        }
    ],
}


@pytest.fixture
def write(tmp_path):
    """Writes a task, after replacing parts of it, and its world."""

    def write(*replacements, text=TASK):
        (tmp_path / "task.toml").write_text(replaced(text, *replacements))
        write_files(tmp_path)
        return tmp_path / "task.toml"

    return write


def write_files(place):
    (place / "world.txt").write_text(write_world(WORLD))
    (place / "other.txt").write_text(write_world(OTHER))
    for name, text in MAPS.items():
        (place / name).write_text(text)
    for name, shown in SHOWN.items():
        (place / name).write_text(json.dumps({"demonstrations": shown}))


# --- the task file --------------------------------------------------------------------------


def test_a_task_is_read(write):
    path = write()
    task = TodirlFile.read(path)
    assert kind_of(path) == "todirl"
    assert task.label_on == "exit" and task.memory == task.formula and task.is_colored
    judge, memory = load_automata(task)
    assert memory is judge and judge.delta.shape[0] == 4
    training, test = load_scenes(task, judge)
    assert [scene.name for scene in test] == ["seed 0", "seed 1"]
    assert np.array_equal(training[0].colored.colors, WORLD.colors)
    assert training[0].observation.shape == (36, 45)
    assert training[0].position(8) == {"state": 8, "row": 2, "column": 3}
    assert test[0].mdp.label.sum(axis=0).tolist() == [1, 1, 1]


def test_kinds_slip_and_maps_in_the_task_file(write):
    rows = "\n".join(write_world(WORLD).split("\n\n")[1].split())
    path = write(
        (KINDS, ""),
        (
            MAPS_LINE,
            f'maps = ["""\n{rows}\n"""]\nslip = 0.2\n'
            "objects = { x = { red = 5, black = 4 }, y = { yellow = 5, black = 4 } }\n"
            "obstacles = { z = { black = 9 } }",
        ),
        ("(!o2 & !ob) U (o1 & (!ob U o2))", "!z U (x & (!z U y))"),
    )
    task = TodirlFile.read(path)
    training, test = load_scenes(task, load_automata(task)[0])
    assert training[0].name == "map 1" and training[0].mdp.propositions == ("x", "y", "z")
    assert training[0].mdp.num_successors == test[0].mdp.num_successors == 3
    assert float(test[0].mdp.probability[0, 0, 0]) == pytest.approx(0.8)


def test_the_digest_covers_named_files(write, tmp_path):
    first = TodirlFile.read(write()).digest
    (tmp_path / "world.txt").write_text("margin: 1\nwwww\nwbbw\nwwww\n")
    assert TodirlFile.read(tmp_path / "task.toml").digest != first
    assert TodirlFile.read(write()).digest == first


def test_what_is_seen_on_a_text_map():
    cells = np.array([["b", "a"], ["#", "b"]])
    seen = cell_observations(cells, ["b", "a", "#"], 1).reshape(4, 9, 4).argmax(-1)
    assert seen[1].tolist() == [3, 3, 3, 0, 1, 3, 2, 0, 3]


@pytest.mark.parametrize(
    ("replacement", "message"),
    [
        ((MAPS_LINE, "map = 3"), r"\[world\] has no key 'map'; did you mean 'maps'\?"),
        ((MAPS_LINE, "maps = []"), r"with at least one of them"),
        (('"world.txt"', '"gone.txt"'), r"gone\.txt': No such file"),
        (("[world]", '[world]\nwall = "#"'), r"\[world\] wall belongs to maps with a legend"),
        ((KINDS, "objects = { o1 = 5 }"), r"a table of kinds and their colours"),
        (("synthetic = 40", ""), r"either files = \[\.\.\.\] or synthetic = N"),
        (
            ("discount = 0.9\nlength", "progress = 5\nlength"),
            r"\[demonstrations\] progress belongs to a demonstrator who maximises a reward; give its",
        ),
        (
            ("synthetic = 40\ndiscount = 0.9\nlength = 30", 'files = ["a", "b", "c"]'),
            r"\[demonstrations\] files has 3 files for 2 maps; give one for each",
        ),
        (("hidden = [12]", "hidden = [0]"), r"widths of the hidden layers"),
        (("discount = 0.9\nhidden", "discount = 1\nhidden"), r"discount = 1 needs a horizon"),
        (("patience = 15", "patience = 15\nheld_out = 0"), r"needs a held_out above 0"),
        (("patience = 15", 'optimizer = "lbfgs"'), r"learning_rate does not belong"),
        (('"todirl"', '"todirl"\nmu = 0.1'), r"\[learner\] has no key 'mu'"),
        (("generate = 2", ""), r"\[test\] must have maps = \[\.\.\.\] or generate = N"),
        (("generate = 2", 'maps = ["world.txt"]'), r"\[test\] obstacles belongs to generate = N"),
        (("shape = [6, 6]", "shape = [6]"), r"shape = \[6\]; it must be \[rows, columns\]"),
    ],
)
def test_mistakes_in_the_task_file(write, replacement, message):
    with pytest.raises(ValueError, match=message):
        TodirlFile.read(write(replacement))


@pytest.mark.parametrize(
    ("replacement", "message"),
    [
        (
            (MAPS_LINE, 'maps = ["""\nrrr\nrxr\nrrr"""]'),
            r"\[world\] map 1: map row 2, column 2: 'x' is no colour",
        ),
        (("patience = 15", "radius = 2"), r"world\.txt: the learner sees 2 cells .* margin of 1"),
        (("!ob U o2", "!ob U o7"), r"\[task\] formula: .*'o7'"),
        (
            ("(!o2 & !ob) U (o1 & (!ob U o2))", 'G F o1"\nguarantee = "none'),
            r"\[demonstrations\] discount is that of the reward for satisfying the formula",
        ),
        (
            ("(!o2 & !ob) U (o1 & (!ob U o2))", "F (o1 & ob)"),
            r"\[task\] formula: nothing satisfies",
        ),
        (("patience = 15", 'memory = "F o9"'), r"\[learner\] memory: .*'o9'"),
        (("shape = [6, 6]", "shape = [2, 2]"), r"\[test\] generate: seed 0: in 1000 placements"),
        (
            ("obstacles = 1", 'leave_out = ["seed 7"]'),
            r"leave_out names 'seed 7', which is no test world; there are seed 0",
        ),
        (
            ("[world]", "[world]\nobstacles = { ob = { red = 9 } }"),
            r"the map says o1, o2, ob by lines of its own, which differ from objects",
        ),
        ((KINDS, ""), r"which kinds of cells are objects"),
        (
            (f'other.txt"]\n{KINDS}', 'another.txt"]'),
            r"another\.txt has other objects and obstacles than world\.txt",
        ),
    ],
)
def test_mistakes_in_the_worlds(write, tmp_path, replacement, message):
    (tmp_path / "another.txt").write_text("o1: 9 white\nwwww\nwbbw\nwwww\n")
    task = TodirlFile.read(write(replacement))
    with pytest.raises(ValueError, match=message):
        learn_todirl.prepare(task, 0)


def test_mistakes_come_as_one_line(write):
    assert "did you mean 'learner'?" in failure("check", write(("[learner]", "[leaner]")))
    path = write(('["first.json", "second.json"', '["first.json", "first.json"'), text=PLAIN)
    assert "first.json: demonstration 1, step 3" in failure("check", path)


# --- a run ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A finished run: its directory, what it printed, and its last line."""
    place = tmp_path_factory.mktemp("todirl")
    (place / "task.toml").write_text(TASK)
    write_files(place)
    result = run("learn", place / "task.toml", "--out", place / "out", "--json")
    assert result.exit_code == 0, result.output
    return place, result.stdout, json.loads(result.stdout.splitlines()[-1])


@pytest.mark.slow
def test_the_reward_carries_over(learned):
    _, printed, result = learned
    for key in ("training", "test"):
        about = result[key]
        means = {who: about[who]["mean"] for who in ("learned", "expert", "random")}
        assert means["random"]["upper"] < 0.3 < 0.9 < means["learned"]["lower"]
        assert means["expert"]["value"] > 0.99
        for mean in means.values():
            assert mean["lower"] <= mean["value"] <= mean["upper"] < mean["lower"] + 1e-6
        assert about["infeasible"] == about["left_out"] == []
    worst = min(result["test"]["worlds"], key=lambda world: world["mean"]["value"])
    assert worst["name"] == result["test"]["learned"]["worst_world"]["name"]
    assert worst["minimum"]["value"] <= worst["mean"]["value"]
    for words in ("in 2 test worlds", "certified", "expert, who knows", "random actions", "worst"):
        assert words in printed


@pytest.mark.slow
def test_learning_is_on_record(learned):
    _, _, result = learned
    history, learning = result["history"], result["learning"]
    assert history["held_out"][-1] < history["held_out"][0]
    least = int(np.argmin(history["held_out"]))
    assert history["step"][least] - 1 == learning["best_step"]
    assert learning["held_out"] == history["held_out"][least]
    assert learning["solver"] == "CONVERGED" and result["network"]["hidden"] == [12]


@pytest.mark.slow
def test_what_is_written(learned):
    place, _, result = learned
    names = {path.name for path in (place / "out").iterdir()}
    assert names >= {
        "network.npz",
        "policy_1.npz",
        "result.json",
        "report.html",
        "task.toml",
        "automaton.svg",
        "learning.svg",
        "training_2.svg",
        "training_2_runs.svg",
        "test_1.svg",
        "test_2_runs.svg",
    }
    assert not [name for name in names if name.startswith("checkpoint")]
    assert json.loads((place / "out" / "result.json").read_text()) == result
    page = (place / "out" / "report.html").read_text()
    # What has a live part is not shown twice: map and automaton of four worlds, three curves.
    # The front of probability and steps has no live part.
    assert page.count("data:image") == 1 and page.count("<svg") == 4 * 2 + 3
    assert "http" not in page and "Test worlds" in page


@pytest.mark.slow
def test_the_written_network_plans_the_written_policy(learned):
    place, _, result = learned
    found = load_reward(place / "out" / "network.npz")
    assert (found.radius, found.label_on, found.kinds[0]) == (1, "exit", "red")
    seen = temporal_gridworld.observations(WORLD, found.radius)
    model, solution = plan_in(found, WORLD.mdp, seen)
    with np.load(place / "out" / "policy_1.npz") as file:
        np.testing.assert_allclose(file["policy"], solution.policy, atol=1e-7)
        assert np.array_equal(file["next_memory"], model.next_memory)
        mean = result["training"]["worlds"][0]["mean"]
        start = np.asarray(WORLD.mdp.initial)
        assert mean["lower"] <= file["satisfaction"] @ start <= mean["upper"]
    with pytest.raises(ValueError, match=r"the network reads 45 numbers"):
        plan_in(found, WORLD.mdp, seen[:, :9])


@pytest.mark.slow
def test_a_file_that_is_no_network(tmp_path, learned):
    with pytest.raises(ValueError, match="No such file"):
        load_reward(tmp_path / "none.npz")
    (tmp_path / "nonsense.npz").write_bytes(b"nonsense")
    for path in (tmp_path / "nonsense.npz", learned[0] / "out" / "policy_1.npz"):
        with pytest.raises(ValueError, match="is no learned reward"):
            load_reward(path)


@pytest.mark.slow
def test_an_interrupted_run_goes_on_bitwise(learned, monkeypatch):
    place, _, _ = learned
    interrupt_soon(monkeypatch)
    command = ("learn", place / "task.toml", "--out", place / "again")
    result = run(*command)
    assert result.exit_code == 130 and "goes on from the last checkpoint" in result.stderr
    monkeypatch.undo()
    # What comes after learning is the same; pictures take long.
    for name in ("task_pictures", "sections"):
        monkeypatch.setattr(learn_todirl, name, lambda outcome: [])
    result = run(*command)
    assert result.exit_code == 0 and "going on from" in result.stderr
    for name in ("network.npz", "policy_1.npz"):
        with np.load(place / "again" / name) as a, np.load(place / "out" / name) as b:
            assert all(a[key].tobytes() == b[key].tobytes() for key in b.files)


@pytest.mark.slow
def test_what_must_be_known_before_trusting_the_figures(learned):
    result = json.loads(json.dumps(learned[2]))
    assert all(kind != "warning" for kind, _ in report_todirl.remarks(result))
    test, learning = result["test"], result["learning"]
    test["infeasible"], test["left_out"] = ["seed 0", "seed 1"], ["seed 1"]
    test["worlds"][0]["infeasible_starts"] = 3
    test["expert"]["uncertain"] = ["seed 1"]
    learning.update(stopped_early=False, best_step=learning["steps"] - 1, solver="MAX_STEPS")
    told = " ".join(text for kind, text in report_todirl.remarks(result) if kind == "warning")
    starts = test["worlds"][0]["num_starts"]
    for words in (
        f"from 3 of {starts} initial states of the test world seed 0; it counts in the mean "
        "unless [test] leave_out names it",
        "seed 1; it is left out.",
        "(expert, who knows the formula) is known only within its bounds in seed 1",
        "soft values ended with MAX_STEPS",
        "still improving",
    ):
        assert words in told


def test_text_maps_are_checked(write):
    assert run("check", write(text=PLAIN)).stdout == (
        "ok: 3 training and 3 test worlds, 3 memory states, 3 demonstrations of 14 pairs\n"
    )


@pytest.mark.exhaustive
def test_text_maps_files_horizon_and_another_memory(tmp_path):
    (tmp_path / "task.toml").write_text(PLAIN)
    write_files(tmp_path)
    result = run("learn", tmp_path / "task.toml", "--out", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    for words in (
        "within 9 steps",
        "in 2 of 3 test worlds",
        "warning: No policy can satisfy the formula from 4 of 4 initial states of the "
        "test world walled.txt; it is left out.",
        "walled_too.txt; it counts in the mean unless [test] leave_out names it.",
    ):
        assert words in result.stdout
    found = json.loads(result.stdout.splitlines()[-1])
    assert found["test"]["infeasible"] == ["walled.txt", "walled_too.txt"]
    values = {w["name"]: w["mean"]["value"] for w in found["test"]["worlds"]}
    assert values["walled.txt"] == 0 < values["open.txt"]
    mean = found["test"]["learned"]["mean"]["value"]
    assert mean == pytest.approx((values["open.txt"] + values["walled_too.txt"]) / 2)
    assert [w["name"] for w in found["training"]["worlds"]] == ["map 1", "second.txt", "third.txt"]
    assert found["num_memory"] == 3 and found["learning"]["held_out"] is None
    learned = load_reward(tmp_path / "out" / "network.npz")
    assert learned.horizon == 9 and learned.kinds == (".", "a", "b", "r", "#", "off the map")
    with np.load(tmp_path / "out" / "policy_2.npz") as file:
        assert file["policy"].shape == (9, 6, 3, 4)
        np.testing.assert_allclose(file["policy"].sum(axis=-1), 1)
    policy = jl.io.load_policy(tmp_path / "out" / "policy_2.npz")
    assert policy.has_horizon and policy.num_states == 6 and len(policy.actions) == 4
    assert {"memory.svg", "training_3.svg", "test_2.svg"} <= {
        path.name for path in (tmp_path / "out").iterdir()
    }
    page = (tmp_path / "out" / "report.html").read_text()
    data = json.loads(re.search(r'id="data">(.*?)</script>', page)[1])
    # The task decides when a run ends, the learner's memory what is shown.
    for world in data:
        for played in world["runs"]:
            assert {q for _, q, _ in played["steps"]} <= {0, 1, 2} and len(played["steps"]) <= 10
    assert max(len(played["steps"]) for played in data[0]["runs"][1:]) > 2


def test_the_example_is_sound():
    task = TodirlFile.read("examples/in_order.toml")
    training, test = load_scenes(task, load_automata(task)[0])
    world = temporal_gridworld.training_world(0)
    assert np.array_equal(training[0].colored.colors, world.colors) and len(test) == 20
    assert training[0].mdp.propositions == world.mdp.propositions


# --- the guarantee -----------------------------------------------------------------------------


@pytest.mark.slow
def test_the_best_is_attained_in_every_world_also_in_new_ones(learned):
    place, printed, result = learned
    assert result["guarantee"]["asked"] == "best" and "By construction" in printed
    for key in ("training", "test"):
        for world in result[key]["worlds"]:
            assert world["infeasible_starts"] > 0 or world["minimum"]["lower"] == 1
            assert world["minimum"]["value"] == 1 or world["infeasible_starts"] > 0
    found = load_reward(place / "out" / "network.npz")
    assert found.guarantee == "best"
