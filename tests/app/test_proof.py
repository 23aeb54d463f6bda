"""`jaxltl learn` and `jaxltl certify` in continuous worlds."""

import json
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

from jaxltl.app import learn_environment as job
from jaxltl.app.files.task_rl import EnvironmentFile
from jaxltl.app.reports import learn_environment as report
from jaxltl.cli import main
from jaxltl.core.environments import make_agent

EXAMPLE = Path(__file__).parents[2] / "examples" / "shuttle.toml"


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


@pytest.mark.slow
def test_a_task_file_learns_and_proves_and_certify_proves_the_saved_policy(tmp_path):
    out = tmp_path / "out"
    told = run("learn", EXAMPLE, "--out", out)
    assert told.exit_code == 0, told.output
    found = json.loads((out / "result.json").read_text())["proof"]
    assert found["status"] == "CONVERGED" and found["lower"] >= 0.999
    assert "proven: probability at least" in told.stdout and "cells: images" in told.stderr
    assert (out / "certificate.svg").exists()
    assert "Certified lower bounds" in (out / "report.html").read_text()
    again = run("certify", out / "policy.npz", "G !rock", "--json")
    assert again.exit_code == 0, again.output
    safety = json.loads(again.stdout.splitlines()[-1])
    assert safety["formula"] == "G !rock" and 0 <= safety["lower"] <= safety["upper"] <= 1
    refused = run("certify", out / "policy.npz", "--confidence", "0.9")
    assert refused.exit_code == 2 and "takes no options of logs" in refused.stderr


@pytest.mark.slow
def test_a_refuted_policy_comes_with_a_run():
    setup = job.prepare(EnvironmentFile.read(EXAMPLE), 0)
    upwards = make_agent(lambda seen, key: jnp.array([0.0, 1.0]) + 0 * seen.world)
    lines = []
    found = job.prove(setup, upwards, "G !rock", lines.append)
    result = report.proof_entry(found)
    assert result["upper"] < 0.999 and result["status"] == "CONVERGED"
    run = np.array(result["counterexample"])
    start, end = setup.dynamics.initial.contains(run[:1]), run[-1]
    rock = setup.dynamics.labels["rock"].contains(end)
    assert start.all() and (rock or (np.abs(end) > 1).any())
    assert f"a run violates it after {len(run) - 1} steps: from " in report.proof_sentence(result)
    drawn = report.proof_picture(found, setup.dynamics, [])
    assert "a run that violates it" in drawn.caption and b"<svg" in drawn.drawing


def test_bounds_are_printed_rounded_outward():
    entry = {"lower": 0.99999996, "upper": 0.99999996, "status": "CONVERGED", "cells": 4}
    entry |= {"initial_cells": 1, "how": {"surely": 1}, "seconds": {}, "counterexample": None}
    assert "at least 0.9999999 from" in report.proof_sentence(entry)
    assert "at most 1 from" in report.proof_sentence(entry)
    assert report.proof_bounds(entry) == ["0.9999999", "1"]


def test_the_policy_of_a_continuous_world_acts_without_randomness_by_default():
    setup = job.prepare(EnvironmentFile.read(EXAMPLE), 0)
    assert setup.dynamics is not None and setup.acts == "likeliest"


def test_a_proof_needs_dynamics(tmp_path):
    text = EXAMPLE.with_name("flat_world.toml").read_text() + "\n[proof]\nthreshold = 0.9\n"
    (tmp_path / "task.toml").write_text(text)
    with pytest.raises(ValueError, match=r"\[proof\] is for dynamics"):
        EnvironmentFile.read(tmp_path / "task.toml")


WORLD = 'dynamics = "shuttle.py:make"'


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((WORLD, 'environment = "shuttle.py:make"\n'), r"\[proof\] is for dynamics"),
        ((WORLD, f'{WORLD}\nenvironment = "flat_world"'), "must have either environment ="),
        ((WORLD, f'{WORLD}\nlabels = "a.py:b"'), "labels belongs to an environment"),
        ((WORLD, 'dynamics = "shuttle.py:box"'), "does not take"),
        (
            (
                f"{WORLD}\nhorizon = 40\n\n[world.arguments]\ngust = 0.02",
                'dynamics = "shuttle.py:triangular"',
            ),
            "no dynamics; let it return",
        ),
        (("gust = 0.02", "wind = 1"), "unexpected keyword argument 'wind'"),
        (
            ('formula = "', 'ending = "repeat"\nformula = "'),
            "dynamics define by outside= what leaving",
        ),
        (("[80, 80]", "[]"), "it must be a list of numbers of cells"),
    ],
)
def test_refused_task_files(tmp_path, change, message):
    (tmp_path / "shuttle.py").write_text(EXAMPLE.with_suffix(".py").read_text())
    (tmp_path / "task.toml").write_text(EXAMPLE.read_text().replace(*change))
    with pytest.raises(ValueError, match=message):
        job.prepare(EnvironmentFile.read(tmp_path / "task.toml"), 0)


def test_an_environment_that_is_dynamics_is_refused(tmp_path):
    text = EXAMPLE.read_text().replace("dynamics =", "environment =").partition("[proof]")[0]
    (tmp_path / "shuttle.py").write_text(EXAMPLE.with_suffix(".py").read_text())
    (tmp_path / "task.toml").write_text(text)
    with pytest.raises(ValueError, match="returns dynamics; write dynamics = "):
        job.prepare(EnvironmentFile.read(tmp_path / "task.toml"), 0)
