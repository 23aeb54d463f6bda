"""The command from a log to a guarantee: what it prints, writes and refuses."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner

import jaxltl as jl
from jaxltl.checker import verdict
from jaxltl.cli import main
from jaxltl.core.models.construct.counts import model_from_counts
from jaxltl.core.values.evaluation.data_guarantee import learn_guarantee
from jaxltl.io.log import read_labels, read_log

LINES = [
    ("hall", "left", "kitchen", 900),
    ("hall", "left", "pit", 100),
    ("hall", "right", "kitchen", 40),
    ("hall", "right", "pit", 10),
    ("kitchen", "rest", "kitchen", 5),
    ("pit", "rest", "pit", 5),
]


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(
        "state,action,next,count\n" + "".join(",".join(map(str, x)) + "\n" for x in LINES)
    )
    (tmp_path / "labels.csv").write_text("state,label\nkitchen,safe\npit,lost\n")
    return path


def run(*arguments):
    return CliRunner().invoke(main, ["certify", *map(str, arguments)])


def certified(log, *more):
    return run(
        log,
        "F safe",
        "--confidence",
        0.95,
        "--initial",
        "hall",
        "--labels",
        log.parent / "labels.csv",
        *more,
    )


def certified_as_seen(log, *more):
    return certified(log, "--graph", "seen", *more)


def told(printed):
    """The two bounds, as people read them."""
    found = re.match(r"P [<>]= (\S+) with .*\n.* than (\S+)\n", printed)
    return float(found[1]), float(found[2])


def test_what_is_guaranteed_is_printed_and_written(log):
    out = log.parent / "policy.npz"
    proof = log.parent / "proof.umb"
    found = certified_as_seen(log, "--json", "--policy", out, "--certificate", proof)
    assert found.exit_code == 0, found.output
    status, lines = verdict(str(proof))
    assert status == 0 and "with confidence 0.95" in lines[0] and lines[0][9:] in found.stdout
    model, counts = model_from_counts(
        read_log(log), initial="hall", graph="seen", labels=read_labels(log.parent / "labels.csv")
    )
    expected = learn_guarantee(model, counts, "F safe", 0.95, graph="seen")
    result = json.loads(found.stdout.splitlines()[-1])
    assert result["bound"] == expected.bound
    assert 0.8 < result["bound"] < 0.9 < result["optimistic"]
    assert result["samples"] == int(counts.sum())
    assert result["sample_next"][0]["action"] == "left"
    assert "\n  assuming that only transitions that the log contains are possible\n" in found.stdout
    assert result["assumption"] == expected.assumption
    printed, limit = told(found.stdout)
    assert expected.bound - 1e-5 < printed <= expected.bound
    assert expected.optimistic <= limit < expected.optimistic + 1e-5
    with np.load(out) as file:
        assert json.loads(str(file["result"]))["assumption"] == expected.assumption
    robot = jl.io.load_policy(out).controller()
    robot.start("hall")
    assert robot.policy.actions[robot.act()] == "left"
    policy = robot.policy
    letter = policy.automaton.letters[policy.letter[policy.states.index("kitchen")]]
    assert policy.label_on == "exit" and letter.tolist() == [True]


def test_the_other_direction_and_methods(log):
    for method in ("clopper-pearson", "hoeffding", "weissman"):
        found = certified_as_seen(log, "--method", method, "--json", "--min")
        result = json.loads(found.stdout.splitlines()[-1])
        assert result["optimistic"] <= 0.8 <= result["bound"]
        assert "P <= " in found.stdout
        printed, limit = told(found.stdout)
        assert result["bound"] <= printed and limit <= result["optimistic"]


def test_a_curve_is_drawn(log):
    picture = log.parent / "curve.svg"
    found = certified_as_seen(log, "--curve", picture, "--json")
    result = json.loads(found.stdout.splitlines()[-1])
    assert picture.read_bytes().startswith(b"<?xml")
    assert (np.diff(result["curve"]["samples"]) > 0).all()
    assert result["curve"]["bound"][-1] == result["bound"]


def test_a_model_file_has_the_graph(log, tmp_path):
    place = tmp_path / "world.tra"
    place.write_text(
        "3 4 6\n0 0 1 0.5 left\n0 0 2 0.5 left\n0 1 1 0.5 right\n0 1 2 0.5 right\n"
        "1 0 1 1 rest\n2 0 2 1 rest\n"
    )
    (tmp_path / "world.lab").write_text('0="init" 1="safe"\n0: 0\n1: 1\n')
    numbers = tmp_path / "numbers.csv"
    numbers.write_text("state,action,next\n" + "0,left,1\n" * 9 + "0,left,2\n")
    found = run(numbers, "F safe", "--confidence", 0.9, "--model", place, "--json")
    assert found.exit_code == 0, found.output
    assert 0.4 < json.loads(found.stdout.splitlines()[-1])["bound"] < 0.9


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--confidence", 1.5], "confidence"),
        (["--initial", "cellar"], "initial: there is no state 'cellar'; there are "),
        (["--terminal", "hall"], "terminal state 'hall' was left"),
        (["--curve", "curve.txt"], "--curve curve.txt: the name must end in .svg"),
    ],
)
def test_mistakes(log, more, message):
    found = certified_as_seen(log, *more)
    assert found.exit_code == 2
    assert message in found.stderr
    assert found.stderr.count("\n") == 2  # the first line, and the mistake


def test_mistakes_in_files(log):
    missing = run(log, "F safe", "--confidence", 0.9).stderr
    assert "add --initial STATE; there are 3: 'hall', " in missing
    place = log.parent / "labels.csv"
    place.write_text("state,label\nkitchen,safe\nattic,safe\n")
    assert "line 3" in certified_as_seen(log).stderr
    place.write_text("state,label\nkitchen,sure\n")
    assert "safe" in certified_as_seen(log).stderr
    log.write_text("state,action\nhall,left\n")
    assert "next" in certified_as_seen(log).stderr


def test_nothing_is_assumed_of_the_graph_unless_it_is_said(log):
    """A choice may lead where the log does not show it to lead."""
    found = certified(log, "--json")
    free = json.loads(found.stdout.splitlines()[-1])
    assert "assuming that there are no states but those that the log names" in found.stdout
    assert "--least-probability P or --graph seen assume more" in found.stdout
    least = json.loads(
        certified(log, "--json", "--least-probability", 0.05).stdout.splitlines()[-1]
    )
    assert least["assumption"].startswith("no possible transition is less likely than 0.05")
    seen = json.loads(certified_as_seen(log, "--json").stdout.splitlines()[-1])
    assert 0 < free["bound"] <= least["bound"] < seen["bound"]
    assert {x["confidence"] for x in (free, least, seen)} == {0.95}
    for more, message in (
        (["--least-probability", 0.02], "give one of them"),
        (["--model", "world.tra"], "world.tra"),
    ):
        wrong = certified_as_seen(log, *more)
        assert wrong.exit_code == 2 and message in wrong.stderr
    assert (
        "least probability=1.5; it must be above 0"
        in certified(log, "--least-probability", 1.5).stderr
    )
