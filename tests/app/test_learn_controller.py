"""Task files of maps that are seen in part: results, files, reports, and refused input."""

import json

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos.common.seeds import Training
from jaxltl.app import learn_controller as job
from jaxltl.app.files.task_rl import ControllerFile
from jaxltl.app.run_job import job_of
from jaxltl.plot.explorer import Explorer

TEXT = """
[world]
map = \"\"\"
# # # # # # # # # #
# g . x # x . g # #
# # . # # # . # # #
# # a # # # b # # #
# # # # # # # # # #
\"\"\"
initial = "a | b"
observations = 3
hidden = ["g", "x"]

[task]
formula = "!x U g"

[learner]
method = "controller"
steps = 2
starts = 2

[controller]
num_memory = 2
"""


@pytest.fixture
def write(tmp_path):
    def write(*changes):
        text = TEXT
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "task.toml").write_text(text)
        return tmp_path / "task.toml"

    return write


@pytest.fixture(scope="module")
def outcome(tmp_path_factory):
    path = tmp_path_factory.mktemp("task") / "task.toml"
    path.write_text(TEXT)
    assert job_of(path) is job
    return job.learn(job.prepare(ControllerFile.read(path), 0), Training(0, 1))


def test_two_rooms_need_two_memory_states_and_have_a_certified_controller(outcome, tmp_path):
    result = job.summary(outcome)
    assert result["num_memory"] == 2 and result["start"] in ("explored", "beliefs")
    assert result["satisfaction"]["lower"] > 1 - 1e-6 <= result["bounds"]["upper"]
    assert result["fully_observable"]["value"] == pytest.approx(1)
    json.dumps(result, allow_nan=False)
    job.save(tmp_path, outcome)
    policy = jl.io.load_policy(tmp_path / "policy.npz")
    value = jl.values.controlled_chain(outcome.setup.pomdp, policy)
    at = jl.optimal_satisfaction(value, "!x U g").at_initial
    assert float(at.lower) == pytest.approx(result["satisfaction"]["lower"], abs=1e-9)
    assert policy.actions == ("up", "down", "left", "right")


def test_the_certificate_is_of_the_controller(outcome, tmp_path):
    from jaxltl.io.certificate.results import write_certificates

    (record,) = write_certificates(tmp_path, job.certifiable(outcome))
    assert record["file"] == "certificate.umb"
    claim = record["claims"][0]
    assert "policies see observations" in claim and float(claim.rpartition(" ")[2]) > 1 - 1e-6


def test_trajectories_have_beliefs_that_contain_the_robot(outcome):
    explorer = next(x for x in job.sections(outcome) if isinstance(x, Explorer))
    observation = np.asarray(outcome.setup.pomdp.observation)
    edges = {(s, o): t for s, t, o, _ in explorer.machine}
    for run in explorer.runs:
        memory = 0
        for t, ((state, after, action), seen) in enumerate(
            zip(run.steps, run.observations, strict=True)
        ):
            assert observation[state] == seen and run.beliefs[t, state] > 0
            assert set(np.flatnonzero(run.beliefs[t])) <= set(np.flatnonzero(observation == seen))
            if action is None:  # the formula is decided, which the machine leaves out
                break
            assert edges.get((memory, seen), edges.get((-1, seen))) == after
            memory = after
        assert outcome.setup.cells.ravel()[run.steps[-1][0]] == "g"
    assert set(explorer.layers) == {"0", "1"}
    assert explorer.drawings["automaton"].function == "live_controller"


def test_the_report_shows_the_machine_beliefs_and_bounds(outcome):
    from jaxltl.plot.drawing import Picture, draw

    result = {
        **job.summary(outcome),
        "seconds": 1.0,
        "versions": {"jaxltl": "0", "jax": "0"},
        "certificates": [],
    }
    parts = [
        (x, {k: draw(d).decode() for k, d in x.drawings.items()})
        for x in job.sections(outcome)
        if not isinstance(x, Picture)
    ]
    page = job.report.page(result, parts, [], TEXT)
    for text in ("Controller (memory of the policy)", 'class="belief"', '"beliefs"', "observation"):
        assert text in page
    assert "optimum with full observation" in job.report.table(result)
    drawn = {p.name for p in job.task_pictures(outcome.setup) + job.sections(outcome)}
    assert {"controller.svg", "observations.svg", "learning.svg"} <= drawn


@pytest.mark.slow
def test_a_patrol_has_a_certified_controller(write):
    """A formula without explored bounds: the learned controller remembers the landmark for ever."""
    path = write(('"!x U g"', '"G F g & G F (a | b) & G !x"'), ("num_memory = 2", "num_memory = 3"))
    outcome = job.learn(job.prepare(ControllerFile.read(path), 0), Training(0, 1))
    result = job.summary(outcome)
    assert result["satisfaction"]["lower"] > 1 - 1e-6 <= result["bounds"]["upper"]
    assert result["fully_observable"]["value"] == pytest.approx(1)
    alone = job.learn(
        job.prepare(
            ControllerFile.read(
                write(
                    ('"!x U g"', '"G F g & G F (a | b) & G !x"'),
                    ("num_memory = 2", "num_memory = 1"),
                )
            ),
            0,
        ),
        Training(0, 1),
    )
    assert 0 <= job.summary(alone)["satisfaction"]["upper"] <= 0.5 + 1e-9


@pytest.mark.parametrize(
    ("change", "name"),
    [
        (("observations = 3", "observations = 2"), "observations"),
        (("observations = 3", 'observations = ["wall"]'), "hidden"),
        (('"!x U g"', '"F q"'), "q"),
        (("num_memory = 2", "num_memory = 0"), "num_memory"),
        (('method = "controller"', 'method = "mlirl"'), "controller"),
        (("observations = 3\n", ""), "observations"),
    ],
)
def test_wrong_files_are_refused_with_the_key(write, change, name):
    path = write(change)
    with pytest.raises(ValueError, match=name):
        job_of(path).prepare(job_of(path).FILE.read(path), 0)
