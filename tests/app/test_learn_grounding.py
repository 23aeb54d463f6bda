"""Task files with a table [grounding]: their results, files, and refused input."""

import json
from functools import cache

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos.common.seeds import Training
from jaxltl.app import learn_grounding as job
from jaxltl.app.files.task_irl import GroundingFile
from jaxltl.app.run_job import job_of
from jaxltl.app.wording import took

TEXT = """
[world]
maps = ["a .\\n. b", "b .\\na .", "a .\\nb ."]
slip = 0.1

[task]
formula = "!trap U goal"

[grounding]
observations = "cells"

[demonstrations]
synthetic = 3
length = 8
meaning = { trap = "a", goal = "b" }

[test]
maps = ["b a\\n. ."]
"""
MAPS = TEXT.split("\n")[2]


@pytest.fixture
def write(tmp_path):
    def write(text=TEXT, *changes, **files):
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        for name, content in files.items():
            (tmp_path / name.replace("_", ".")).write_text(content)
        (tmp_path / "task.toml").write_text(text)
        return tmp_path / "task.toml"

    return write


def outcome_of(path, seed=0):
    return job.learn(job.prepare(GroundingFile.read(path), seed), Training(seed, 1))


@pytest.mark.slow
def test_a_task_file_has_a_table_policies_and_a_report(write, tmp_path):
    """Certified figures against the solver alone, in a world without demonstrations too."""
    path = write()
    assert job_of(path) is job
    outcome = outcome_of(path)
    result = job.summary(outcome)
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert [(row["symbol"], row["meaning"]) for row in result["grounding"]] == [
        ("goal", "b"),
        ("trap", "a"),
    ]
    assert len(result["worlds"]) == 4 and result["num_demonstrated"] == 3
    for world, found in zip(outcome.setup.worlds, result["worlds"], strict=True):
        named = world.mdp.replace(propositions=("trap", "goal"))
        model = jl.product(named, "!trap U goal")
        best = float((jl.optimal_satisfaction(model).value * model.initial).sum())
        np.testing.assert_allclose(found["attained"]["value"], best, atol=1e-7)
        assert found["attained"]["lower"] <= best + 1e-12 <= found["attained"]["upper"] + 1e-7
        if found["robust"] is not None:
            assert found["robust"]["worst"] <= best + 1e-9
    job.save(tmp_path, outcome)
    policy = jl.io.load_policy(tmp_path / "policy_4.npz")
    chance = np.asarray(policy.action)
    assert chance.shape[0] == 4 and np.allclose(chance.sum(-1), 1)
    text = job.report.table(result)
    assert "goal    b" in text and "symbol  meaning  weight" in text
    page = job.report.page(result | took(1.0), [], [], "text")
    assert "decisive step" in page and "Satisfaction probability" in page
    assert len(job.sections(outcome)) == 4 and len(job.task_pictures(outcome.setup)) == 1


@pytest.mark.slow
def test_undecided_symbols_have_a_robust_policy_and_a_query(write):
    """One demonstration leads to a cell of two kinds: both meanings have the same weight."""
    shown = json.dumps({"demonstrations": [{"states": [2, 3], "actions": ["right", "up"]}]})
    text = TEXT.replace(MAPS, 'maps = [". .\\n. x"]')
    text = text.replace("slip = 0.1", 'legend = { "." = [], x = ["a", "b"], a = ["a"] }')
    text = text.replace('"!trap U goal"', '"F goal"').partition("[demonstrations]")[0]
    text += '[demonstrations]\nfiles = ["shown.json"]\n[test]\nmaps = ["a .\\n. x"]'
    result = job.summary(outcome_of(write(text, shown_json=shown)))
    assert sorted(result["ambiguous"]["goal"]) == ["a", "b"]
    assert result["worlds"][1]["robust"]["worst"] > 0.999
    remarks = "\n".join(x for _, x in job.report.remarks(result))
    assert "do not decide what goal means: a or b" in remarks


@cache
def seen(num_rows, value="1"):
    return "kind, other\n" + "\n".join([f"0, {value}"] * num_rows)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"!trap U goal"', '"F goal & G !goal"', "task.toml: the task .* is unsatisfiable"),
        ('goal = "b"', 'goal = "z"', "meaning of goal is 'z'; it must be one of a, b"),
        ('meaning = { trap = "a", goal = "b" }', "", r"must have either .* meaning = \{...\}"),
        ('"cells"', '["x.csv"]', r"observations has 1 files for 4 maps"),
        ('"cells"', '["x.csv", "x.csv", "x.csv", "x.csv"]', r"shape \(3, 2\); expected \(4, 2\)"),
        ('"cells"', '["y.csv", "y.csv", "y.csv", "y.csv"]', "not all 0 or 1; give clusters = N"),
        ('"cells"', '["z.csv", "x.csv", "x.csv", "x.csv"]', "z.csv: could not convert string"),
        ("a .\\n. b", "a .\\n b", r"\[world\]"),
    ],
)
def test_bad_input_is_refused(write, old, new, message):
    files = {"x_csv": seen(3), "y_csv": seen(4, "0.5"), "z_csv": seen(4, "?")}
    path = write(TEXT, (old, new), **files)
    with pytest.raises(ValueError, match=message):
        job.prepare(GroundingFile.read(path), 0)


@pytest.mark.slow
def test_demonstrations_that_no_grounding_explains_are_named(write):
    """At the scale of the other demonstrations, random actions are likelier under each grounding."""
    left = {"states": [3, 2, 1], "actions": ["left"] * 3}
    walls = {"states": [2] * 40, "actions": ["up"] * 40}
    shown = json.dumps({"demonstrations": [left, left, walls, left, left]})
    text = TEXT.partition("[demonstrations]")[0] + '[demonstrations]\nfiles = ["shown.json"]\n'
    text = text.replace(MAPS, 'maps = ["a . . .\\n# # # #"]').replace("slip = 0.1", "")
    path = write(text, ('"!trap U goal"', '"F goal"'), shown_json=shown)
    with pytest.raises(ValueError, match=r"demonstration 2 is explained by no grounding.*step"):
        outcome_of(path)
