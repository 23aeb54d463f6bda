"""Several processes: who they are, what they agree on, and how a run ends and goes on."""

import contextlib
import json
import os
import random
import signal
import time

import jax
import numpy as np
import pytest

from jaxltl.algos.common import checkpoint
from jaxltl.app.distributed_errors import explain
from jaxltl.app.processes import DeviceOptions, Launch, ProcessGroup, launched
from jaxltl.core.values.discounted.discounted import optimal_value
from jaxltl.core.values.discounted.soft import soft_value
from jaxltl.core.values.properties.solve_property import solve_property
from tests import several
from tests.core.values.properties.test_solve_on_mesh import PROPERTIES, gambler

SLURM = {
    "SLURM_NTASKS": "3",
    "SLURM_PROCID": "2",
    "SLURM_JOB_ID": "5",
    "SLURM_STEP_NODELIST": "n[1-3]",
    "SLURM_LOCALID": "0",
}
MPI = {
    "OMPI_COMM_WORLD_SIZE": "2",
    "OMPI_COMM_WORLD_RANK": "1",
    "OMPI_MCA_orte_hnp_uri": "13.0;tcp://10.0.0.1:34911",
}
MPI_5 = {k: v for k, v in MPI.items() if "orte" not in k}
HERE = {"coordinator": "node1:77", "process": 1, "processes": 2}


@pytest.mark.parametrize(
    ("options", "environment", "expected"),
    [
        ({}, {}, Launch()),
        ({"mesh": None}, SLURM, Launch()),
        ({}, SLURM, Launch(2, 3)),
        ({}, MPI, Launch(1, 2)),
        ({}, {**SLURM, **MPI}, Launch(1, 2)),
        ({}, {**SLURM, "SLURM_NTASKS": "1", "SLURM_PROCID": "0"}, Launch()),
        ({"processes": 1}, SLURM, Launch()),
        (HERE, {}, Launch(1, 2, "node1:77")),
        (HERE, SLURM, Launch(1, 2, "node1:77")),
        ({"coordinator": "node1:77"}, MPI_5, Launch(1, 2, "node1:77")),
        ({}, {**MPI_5, "JAX_COORDINATOR_ADDRESS": "node2:8"}, Launch(1, 2, "node2:8")),
        ({"coordinator": "[::1]:77", "process": 0, "processes": 2}, {}, Launch(0, 2, "[::1]:77")),
    ],
)
def test_which_process_this_is(options, environment, expected):
    assert launched(DeviceOptions(**{"mesh": 0, **options}), environment) == expected


@pytest.mark.parametrize(
    ("options", "environment", "message"),
    [
        ({"mesh": None, "process": 1}, {}, "--process needs --mesh"),
        (
            {"process": 1, "processes": 2},
            {},
            "--coordinator is missing, and no launcher provides it",
        ),
        ({"process": 1, "coordinator": "a:1"}, {}, "--processes is missing"),
        ({"processes": 2, "coordinator": "a:1"}, {}, "--process is missing"),
        (
            {**HERE, "process": 2},
            {},
            "--process 2 is out of range for 2 processes; number them from 0 to 1",
        ),
        ({**HERE, "coordinator": "node1"}, {}, "'node1' must be HOST:PORT"),
        ({**HERE, "coordinator": ":70000"}, {}, "':70000' must be HOST:PORT"),
        ({}, MPI_5, "--coordinator is missing, and Open MPI does not provide it"),
    ],
)
def test_what_contradicts_itself_or_is_missing_is_named(options, environment, message):
    with pytest.raises(ValueError, match=message):
        launched(DeviceOptions(**{"mesh": 0, **options}), environment)


FATAL = (
    "F1122 16:30:07.588292   16822 client.h:80] Terminating process because the JAX "
    "distributed service detected fatal errors. This most likely indicates that another task "
    "died; see the other task logs for more details. absl::Status: "
)


@pytest.mark.parametrize(
    ("text", "start"),
    [
        (
            "UNAVAILABLE: The following tasks are unhealthy (stopped sending heartbeats):\n1\nThe tasks",
            "process 0 stops: process 1 does not respond. Checkpoints are kept",
        ),
        (
            "UNAVAILABLE: The following tasks are unhealthy (stopped sending heartbeats):\n1\n12\nThe",
            "process 0 stops: processes 1, 12 do not respond.",
        ),
        (
            "DEADLINE_EXCEEDED: Deadline Exceeded\n\nRPC: /xla.coordination.CoordinationService/Register"
            "Task\n*** Check",
            "process 0: not all processes have joined in time",
        ),
        (
            "ALREADY_EXISTS: Aborted connect attempt as there is a request from a newer incarnation\n\n"
            "RPC: /xla.coordination.CoordinationService/RegisterTask",
            "process 0: another process has",
        ),
        (
            "UNAVAILABLE: Failed to send RPC to coordination service. Either the leader task was "
            "preempted\n:UNKNOWN:Error received from peer\n\nRPC: /xla.coordination.CoordinationService/"
            "PollForError",
            "process 0 stops: process 0, which coordinates the others, has ended",
        ),
        (
            "INTERNAL: Barrier failed\njaxltl ends: process 0 stops, for reasons.\n    @ 0x7f22",
            "process 0 stops, for reasons.",
        ),
        (
            "INTERNAL: Shutdown barrier has failed.",
            "process 0 stops: another process has ended",
        ),
    ],
)
def test_the_last_words_of_the_runtime_in_a_line(text, start):
    line = explain(FATAL + text, 0)
    assert line.startswith(start) and "\n" not in line and line.endswith(".")


def test_alone_nothing_is_exchanged():
    place = ProcessGroup()
    assert place.is_first and place.exchanged("a") == ["a"] and place.sees("it", False) is False
    place.agree({"--seed": 3})
    with pytest.raises(ValueError, match="of mine"), place.together():
        int("x of mine")


@pytest.mark.parametrize(
    ("other", "mine", "error", "text"),
    [
        ("", "", None, ""),
        ("", "bad", ValueError, "process 1: bad"),
        ("bad", "bad", SystemExit, "2"),
        ("bad", "", SystemExit, "2"),
    ],
)
def test_an_error_of_one_process_ends_all(monkeypatch, other, mine, error, text):
    monkeypatch.setattr(ProcessGroup, "exchanged", lambda self, text: [other, text])
    group, raised = ProcessGroup(1, 2), contextlib.nullcontext()
    with pytest.raises(error, match=text) if error else raised, group.together():
        if mine:
            raise ValueError(mine)
    with pytest.raises(TypeError), group.together():  # a bug is not exchanged
        raise TypeError


# --- runs of two processes ----------------------------------------------------------------------


def at_once(tmp_path, number=2, what="learn"):
    return several.ended(several.start_run(number, tmp_path, what), 300)


def lines(found):
    return dict(line.split(": ") for line in found.out.splitlines() if ": " in line)


def is_whole(directory):
    """The saved run is read by a process alone, and is of the same steps in every lane."""
    path = directory / "run.npz"
    if not path.exists():
        return 0
    with np.load(path) as index:
        names = [name for name in index.files if name not in ("given", "parts")]
    assert names
    saved = checkpoint.load(path, *_like(path))
    assert len(set(np.asarray(saved[0].count).tolist())) == 1
    np.testing.assert_array_equal(saved[0].state.step, saved[0].count)
    assert len(saved[1][0]) and (saved[1][0][-1] == np.asarray(saved[0].count)).all()
    return int(saved[0].count[0])


def _like(path):
    """What the run saves, and what it is told apart by."""
    from jaxltl.algos.common import chunks

    with jax.enable_x64(False):  # as the program
        step, states, goal = several.problem_and_state()
        given = {}
        hparams = chunks._spread(0.01, states)
        now = chunks._begin(step, states, goal, hparams, several.LANES)
        rows = jax.tree.map(lambda x: np.zeros((0, *x.shape), x.dtype), (now.count, now.metrics))
        given = checkpoint.fingerprint(step=step, problem=goal, hparams=hparams)
    return (now, rows), given


def killed(tmp_path, number, victim, moment, what="learn"):
    """The other processes of a run, one of which is killed; how they ended, and how soon."""
    processes = several.start_run(number, tmp_path, what)
    moment(processes)
    os.killpg(processes[victim].pid, signal.SIGKILL)
    begin = time.monotonic()
    found = several.ended(processes, 120)
    return [x for i, x in enumerate(found) if i != victim], time.monotonic() - begin


def saved_once(directory):
    def wait(processes):
        end = time.monotonic() + 120
        while not list(directory.glob("*.npz")) and time.monotonic() < end:
            assert all(p.poll() is None for p in processes)
            time.sleep(0.01)

    return wait


def check_end(others, seconds):
    """Unless all were done, the others end in time, with a line."""
    for found in others:
        if found.status == 0:
            assert not found.errors
            continue
        assert len(found.errors) == 1 and "Traceback" not in found.err, found
        assert any(
            x in found.err
            for x in (
                "has ended. Checkpoints are kept",
                "not respond. Checkpoints are kept",
                "not all processes have joined",
                "has not reached process 0",
            )
        ), found
        assert seconds < 90


@pytest.mark.slow
def test_a_run_goes_on_when_a_process_has_died(tmp_path):
    """With as many processes and with one: to the same bits as a run that nothing befell."""
    others, seconds = killed(tmp_path, 2, 1, saved_once(tmp_path))
    assert others[0].status != 0
    check_end(others, seconds)
    made = is_whole(tmp_path)
    assert 0 < made < several.STEPS
    alone = at_once(tmp_path, 1)[0]
    assert alone.status == 0 and lines(alone)["went on"] == "True"
    assert int(lines(alone)["rows"]) == several.STEPS // 5
    whole = tmp_path / "whole"
    whole.mkdir()
    expected = lines(at_once(whole, 1)[0])
    assert expected["went on"] == "False" and lines(alone)["ended"] == expected["ended"]
    checkpoint.remove(tmp_path / "run.npz")
    assert list(tmp_path.iterdir()) == [whole]


@pytest.mark.exhaustive
def test_solvers_in_two_processes_find_what_the_host_finds(tmp_path):
    first, second = at_once(tmp_path, 2, "laws")
    assert first.status == second.status == 0 and not second.out, (first, second)
    told = [json.loads(line) for line in first.out.splitlines() if line.startswith("{")]
    model = gambler()
    for there, text in zip(told, PROPERTIES, strict=False):
        here = solve_property(model, text)
        assert there["property"] == text and there["status"] == here.status.name
        assert there["holds"] == here.holds
        assert (np.array(there["lower"]) <= here.upper).all()
        assert (np.array(there["upper"]) >= here.lower).all()
    for there, solve in zip(told[len(PROPERTIES) :], (optimal_value, soft_value), strict=True):
        here = solve(model, "games", 0.9)
        assert there["status"] == int(here.status)
        np.testing.assert_allclose(there["value"], here.value, rtol=1e-6, atol=1e-9)


@pytest.mark.exhaustive
def test_twenty_restarts_after_kills_at_random_end_alike(tmp_path):
    """At any time: while they meet, compute, save or end; restarted by two, three or one."""
    expected, draw, went_on = None, random.Random(7), 0
    for i in range(20):
        directory = tmp_path / str(i)
        directory.mkdir()

        def moment(processes, i=i, directory=directory):
            if i % 4 == 0:
                time.sleep(draw.uniform(0.5, 5))
            else:
                saved_once(directory)(processes)
                time.sleep(draw.expovariate(1.0))

        check_end(*killed(directory, 2, draw.randrange(2), moment))
        is_whole(directory)
        found = at_once(directory, (2, 2, 3, 1)[i % 4])
        assert [x.status for x in found] == [0] * len(found), found
        went_on += lines(found[0])["went on"] == "True"
        expected = expected or lines(found[0])["ended"]
        assert lines(found[0])["ended"] == expected
    assert went_on > 5


@pytest.mark.exhaustive
def test_six_solves_go_on_after_kills_at_random(tmp_path):
    """With as many processes to the same bits, with others to a certified answer."""
    (tmp_path / "whole").mkdir()
    expected, draw, went_on = (
        lines(at_once(tmp_path / "whole", what="solve")[0])["ended"],
        (random.Random(3)),
        0,
    )
    assert "CONVERGED" in expected
    for i in range(6):
        directory = tmp_path / str(i)
        directory.mkdir()

        def moment(processes, directory=directory):
            saved_once(directory)(processes)
            time.sleep(draw.expovariate(1.0))

        check_end(*killed(directory, 2, draw.randrange(2), moment, "solve"))
        found = lines(at_once(directory, (2, 1, 2, 3, 2, 2)[i], "solve")[0])
        went_on += found["went on"] == "True"
        lower, upper, status, _ = found["ended"].split(", ")
        if i in (0, 2, 4, 5):
            assert found["ended"] == expected
        low, high = (np.frombuffer(bytes.fromhex(x))[0] for x in (lower, upper))
        assert status == "CONVERGED" and low <= 0.4 <= high and high - low <= 1e-6
        assert not list(directory.iterdir())
    assert went_on > 2
