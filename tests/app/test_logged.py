"""Worlds of task files that are known from a log: what is read, learned, guaranteed and refused."""

import html
import json

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.app.certify import guaranteed
from jaxltl.app.files.task_irl import MlirlFile
from jaxltl.app.files.worlds import load_demonstrations, load_world
from jaxltl.app.learn import report
from jaxltl.core.models.construct.counts import model_from_counts
from jaxltl.core.models.product import product
from jaxltl.core.values.evaluation.data_guarantee import learn_guarantee
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from jaxltl.io.log import read_labels, read_log
from tests.support import replaced
from tests.test_cli import failure, run

LOG = """state,action,next,count
dock,ledge,goal,40
dock,ledge,pit,10
dock,ramp,goal,900
dock,ramp,dock,50
dock,ramp,pit,100
goal,rest,goal,3
"""
LABELS = "state,label\ngoal,goal\npit,pit\n"
TASK = """
[world]
transitions = "log.csv"
confidence = 0.9
initial = "dock"
labels = "labels.csv"
terminal = ["pit"]
graph = "seen"

[task]
formula = "!pit U goal"

[demonstrations]
file = "shown.json"

[learner]
method = "mlirl"
discount = 0.9
"""
SHOWN = {"states": ["dock", "dock", "goal"], "actions": ["ramp", "ramp"]}


@pytest.fixture
def write(tmp_path):
    """Writes a task with its files, after replacing parts of it."""

    def write(*replacements, log=LOG, labels=LABELS, shown=SHOWN):
        (tmp_path / "log.csv").write_text(log)
        (tmp_path / "labels.csv").write_text(labels)
        (tmp_path / "shown.json").write_text(json.dumps({"demonstrations": [shown]}))
        (tmp_path / "task.toml").write_text(replaced(TASK, *replacements))
        return tmp_path / "task.toml"

    return write


def test_the_world_is_what_was_counted(write):
    task = MlirlFile.read(write())
    world = load_world(task.path, task.world)
    assert world.logged.states == ("dock", "goal", "pit")
    assert world.actions == ("any", "ledge", "ramp", "rest") or len(world.actions) == 4
    ramp = world.actions.index("ramp")
    row = dict(
        zip(
            np.asarray(world.mdp.successor[0, ramp]).tolist(),
            np.asarray(world.mdp.probability[0, ramp]).tolist(),
            strict=True,
        )
    )
    np.testing.assert_allclose([row[0], row[1], row[2]], np.array([50, 900, 100]) / 1050)
    assert world.position_text(2) == "state pit" and world.position(1) == {
        "state": 1,
        "name": "goal",
    }
    shown = load_demonstrations(task, world)
    assert shown.state.tolist() == [[0, 0]] and shown.action.tolist() == [[ramp, ramp]]


def test_names_that_are_numbers(write):
    """A state of a demonstration is the one of that name, not of that place."""
    task = MlirlFile.read(
        write(
            ("dock", "12"),
            ('"pit"]', '"5"]'),
            log="state,action,next\n12,3,7\n12,7,5\n7,3,7\n",
            labels="state,label\n7,goal\n5,pit\n",
            shown={"states": [12, "7"], "actions": [3]},
        )
    )
    world = load_world(task.path, task.world)
    shown = load_demonstrations(task, world)
    assert world.logged.states == ("5", "7", "12")
    assert shown.state.tolist() == [[2]]
    assert world.actions[int(shown.action[0, 0])] == "3"


@pytest.mark.parametrize("label_on", ["entry", "exit"])
@pytest.mark.parametrize("method", ["anytime", "weissman"])
def test_what_is_guaranteed_of_a_policy(write, label_on, method):
    """Of the best it is what is learned of the log, and of one more timid it is less."""
    task = MlirlFile.read(write(("[task]", f'method = "{method}"\n[task]')))
    world = load_world(task.path, task.world)
    prod = product(world.mdp, task.formula, label_on=label_on)
    best = optimal_satisfaction(prod)
    policy = np.eye(len(world.actions))[np.asarray(best.policy)]
    found = guaranteed(world.logged, prod, task.formula, policy)
    counts = read_log(task.path.parent / "log.csv")
    model, count = model_from_counts(
        counts,
        initial="dock",
        terminal=["pit"],
        graph="seen",
        labels=read_labels(task.path.parent / "labels.csv"),
    )
    expected = learn_guarantee(model, count, task.formula, 0.9, graph="seen", method=method)
    assert found["best_guaranteed"] == expected.bound
    assert found["optimistic"] == expected.optimistic
    np.testing.assert_allclose(found["guaranteed"], expected.bound, atol=2e-6)
    frequency = float(np.asarray(best.value)[0, int(prod.initial_memory[0])])
    assert found["guaranteed"] < frequency < found["optimistic"]
    assert found["assumption"] == "only transitions that the log contains are possible"
    assert found["samples"] == 1103 and found["status"] == "CONVERGED"
    assert found["sample_next"][0]["state"] == "dock"
    # By hand: the pit takes all that it may of both ways, the wait of none.
    half = policy.copy()
    half[0] = 0.5 * np.eye(len(world.actions))[
        [world.actions.index(x) for x in ("ledge", "ramp")]
    ].sum(0)
    less = guaranteed(world.logged, prod, task.formula, half)
    to, lower, upper = (
        model.host.successor,
        *(getattr(expected.sets, x) for x in ("lower", "upper")),
    )
    ledge, ramp = (slice(*model.entry_start[r : r + 2]) for r in (0, 1))
    ways = []
    for way in (ledge, ramp):
        row = dict(zip(to[way].tolist(), zip(lower[way], upper[way], strict=True), strict=True))
        pit = min(row[2][1], 1 - sum(low for s, (low, _) in row.items() if s != 2))
        goal = max(row[1][0], 1 - pit - row.get(0, (0, 0))[1])
        ways.append((goal, max(0.0, 1 - pit - goal)))
    (goal, _), (more, stay) = ways
    value = 0.5 * (goal + more) / (1 - 0.5 * stay)
    np.testing.assert_allclose(less["guaranteed"], value, atol=2e-6)
    assert less["guaranteed"] < found["guaranteed"] and less["best_guaranteed"] == expected.bound


@pytest.mark.parametrize(
    ("replacement", "message"),
    [
        (("confidence = 0.9", ""), r"[world] lacks confidence"),
        (
            ("confidence = 0.9", "confidence = 1"),
            "confidence = 1; it must be a number between 0 and 1",
        ),
        (('initial = "dock"', ""), "[world] lacks initial, the name of the initial state"),
        (
            ('"dock"', '["dock", "attic"]'),
            "[world] initial: there is no state 'attic'; there are",
        ),
        (('"dock"', "[]"), "initial = []; it must be"),
        (('["pit"]', '["cellar"]'), "[world] terminal: there is no state 'cellar'"),
        (('graph = "seen"', ""), "[world] must have either graph ="),
        (('graph = "seen"', 'graph = "seen"\nleast_probability = 0.1'), "must have either graph ="),
        (('graph = "seen"', "least_probability = 0"), "least_probability = 0; it must be"),
        (('["pit"]', '["dock"]'), "terminal state 'dock' was left to 'goal'"),
        (('"labels.csv"', '"gone.csv"'), "gone.csv"),
        (('"log.csv"', '"log.csv"\nslip = 0.1'), "slip belongs to a map"),
        (
            ('"log.csv"', '"log.csv"\nmap = "a"'),
            "must have either a map, a model (a file) or trans",
        ),
        (('transitions = "log.csv"', 'map = "a"'), "confidence belongs to transitions, a log"),
        (("!pit U goal", "!pit U home"), "'home'"),
        (('"mlirl"', '"todirl"'), "transitions"),
        (
            ('labels = "labels.csv"', 'method = "bayes"'),
            "method = 'bayes'; it must be \"anytime\" or",
        ),
    ],
)
def test_mistakes_in_the_task(write, replacement, message):
    assert message in failure("check", write(replacement)).replace("\n", " ")


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"log": LOG + "dock,ramp\n"}, "log.csv', line 8"),
        ({"log": LOG.replace("100", "many")}, "log.csv', line 6: the count is 'many'"),
        ({"labels": LABELS + "attic,goal\n"}, "labels.csv', line 4: there is no state 'attic'"),
        (
            {"shown": {"states": ["dock", "attic"], "actions": ["ramp"]}},
            "demonstration 1, step 2: the state 'attic' is not in the log",
        ),
        (
            {"shown": {"states": ["dock"], "actions": ["jump"]}},
            "demonstration 1, step 1: the action 'jump' is not in the log",
        ),
        (
            {"shown": {"states": ["dock", "dock"], "actions": ["ledge"]}},
            "step 1: 'ledge' in state dock cannot lead to state dock",
        ),
    ],
)
def test_mistakes_in_its_files(write, files, message):
    assert message in failure("check", write(**files)).replace("\n", " ")


@pytest.mark.slow
def test_what_is_learned_is_told_with_its_guarantee(write, tmp_path):
    path, out = write(), tmp_path / "out"
    result = run("learn", path, "--out", out, "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout.splitlines()[-1])
    data = found["data"]
    assert 0 < data["guaranteed"] < data["best_guaranteed"] + 1e-6
    assert data["best_guaranteed"] < found["satisfaction"]["mean"]["value"] < data["optimistic"]
    told = "with confidence 0.9, from 1103 logged transitions"
    page = html.unescape((out / "report.html").read_text())
    assert told in result.stdout and told in page
    for text in (result.stdout, page):
        assert "by the log's frequencies" in text and "By the transition graph:" not in text
    with np.load(out / "policy.npz") as arrays:
        assert arrays["states"].tolist() == ["dock", "goal", "pit"]
    robot = jl.io.load_policy(out / "policy.npz").controller()
    robot.start("dock")
    assert robot.policy.actions[robot.act()] in ("ramp", "ledge")
    before = MlirlFile.read(path).digest
    (tmp_path / "log.csv").write_text(LOG.replace("900", "901"))
    assert MlirlFile.read(path).digest != before
    # Where the graph is what was logged, the page says so.
    found["satisfaction"]["minimum"]["lower"] = 1
    ((kind, told),) = [x for x in report.remarks(found) if "transition graph" in x[1]]
    assert kind == "note" and told.startswith("By the log's transition graph: ")
    found["guarantee"] |= {"asked": 0.5, "attained": 0.6, "share": 0, "weight": 0}
    ((kind, told),) = [x for x in report.remarks(found) if "sked for" in x[1]]
    assert kind == "note" and told.startswith("If the log's frequencies were the truth: asked for")


def test_what_the_log_never_showed_is_taken_for_impossible_or_not(write):
    """By the graph that was seen the goal is sure; if anything is possible it is not."""
    for graph, low, high in (("seen", 1 - 1e-6, 1), ("complete", 0.9, 0.999)):
        task = MlirlFile.read(
            write(
                ('graph = "seen"', f'graph = "{graph}"'),
                log=LOG.replace("ramp,pit,100", "ramp,goal,1"),
            )
        )
        world = load_world(task.path, task.world)
        prod = product(world.mdp, task.formula)
        policy = np.eye(len(world.actions))[np.asarray(optimal_satisfaction(prod).policy)]
        assert low <= guaranteed(world.logged, prod, task.formula, policy)["guaranteed"] <= high
