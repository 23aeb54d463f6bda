"""The command line: what it prints and writes, and that mistakes come as one plain line."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner

import jaxltl
from jaxltl import __main__ as entry
from jaxltl.app import run_job
from jaxltl.app.command_options import plain_errors
from jaxltl.app.compilation import FAST_COMPILATION, cache_directory, xla_flags
from jaxltl.cli import main
from jaxltl.core.automata.language import is_equivalent
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.models.mesh.cores import over_cores
from jaxltl.io.hoa.hoa import read_hoa_stream
from jaxltl.plot.drawing import artist, draw, drawing
from tests.app.test_task import SHOWN, TASK, write  # noqa: F401

QUICK = (
    "discount = 0.9",
    "discount = 0.9\nsteps = 40\ntolerance = 1e-6\n"
    'optimizer = "adam"\nlearning_rate = 0.3\navoid = ["r"]',
)


def run(*arguments, input=None):
    return CliRunner().invoke(main, [str(a) for a in arguments], input=input)


def failure(*arguments, input=None):
    """The message of a command that must fail plainly."""
    result = run(*arguments, input=input)
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    _, start, message = result.stderr.rpartition("error: ")  # after what told of the progress
    assert start
    return start + message


# --- automaton ------------------------------------------------------------------------------


def test_automata_in_order_and_from_standard_input():
    result = run("automaton", "F a", "G b")
    assert result.exit_code == 0
    assert result.output.index("cosafe automaton") < result.output.index("safety automaton")
    result = run("automaton", "-F", "-", "--to", "json", input="F a\n\nF b & F c\n")
    sizes = [len(json.loads(line)["delta"]) for line in result.output.splitlines()]
    assert sizes == [2, 4]


@pytest.mark.parametrize(
    ("form", "sign"), [("dot", "digraph"), ("svg", "<svg"), ("text", ">  0"), ("hoa", "HOA: v1")]
)
def test_forms_of_an_automaton(form, sign):
    for formula in ("F a", "G F a", "F G a"):
        result = run("automaton", formula, "--to", form)
        assert result.exit_code == 0 and sign in result.output


def test_a_stream_of_automata():
    formulas = ["F a", "G F a & G F b", 'F G "odd \\" name"']
    result = run("automaton", *formulas, "--to", "hoa")
    assert result.output.endswith("--END--\n")
    names = [line for line in result.output.splitlines() if line.startswith("name:")]
    assert names == ['name: "F a"', 'name: "G F a & G F b"', r'name: "F G \"odd \\\" name\""']
    read = read_hoa_stream(result.output)
    assert [x.acceptance for x in read] == ["cosafe", "buchi", "parity"]
    assert all(is_equivalent(x, to_automaton(f)) for x, f in zip(read, formulas, strict=True))


def test_the_acceptance_that_is_asked_for():
    for acceptance, found in (
        ("auto", "cosafe"),
        ("dfa", "cosafe"),
        ("buchi", "buchi"),
        ("parity", "parity"),
    ):
        result = run("automaton", "F a", "--acceptance", acceptance)
        assert result.output.startswith(f"{found} automaton: 2 states")
    assert "has no deterministic Buchi automaton" in failure(
        "automaton", "F G a", "--acceptance", "buchi"
    )
    message = failure("automaton", "-F", "-", "--acceptance", "dfa", input="F a\nG F a\n")
    assert message.startswith("error: standard input, line 2: ")
    assert "G F a has no finite acceptance" in message


def test_graphviz_draws_if_it_is_there(monkeypatch, tmp_path):
    program = tmp_path / "dot"
    program.write_text("#!/bin/sh\ncat > /dev/null\necho '<svg>by graphviz</svg>'\n")
    program.chmod(0o755)
    monkeypatch.setattr("shutil.which", lambda name: str(program))
    assert "by graphviz" in run("automaton", "F a", "--to", "svg").output
    program.write_text("#!/bin/sh\nexit 1\n")
    assert "matplotlib" in run("automaton", "F a", "--to", "svg").output


def test_mistakes_in_formulas(tmp_path):
    assert "column 5" in failure("automaton", "F (a")
    assert "standard input, line 2: " in failure("automaton", "-F", "-", input="F a\nF )\n")
    assert "No such file" in failure("automaton", "-F", tmp_path / "none")
    result = run("automaton")
    assert result.exit_code == 2 and "give at least one formula" in result.stderr


# --- learn ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A finished run with two seeds: its directory, and what it printed."""
    place = tmp_path_factory.mktemp("learned")
    (place / "task.toml").write_text(TASK.replace(*QUICK))
    (place / "shown.json").write_text(json.dumps(SHOWN))
    result = run("learn", place / "task.toml", "--out", place / "out", "--seeds", 2, "--json")
    assert result.exit_code == 0, result.output
    return place, result


def test_learn_prints_evidence(learned):
    _, result = learned
    for words in (
        "satisfaction probability",
        "certified",
        "optimum",
        "weights",
        "over 2 seeds",
    ):
        assert words in result.stdout
    last = json.loads(result.stdout.splitlines()[-1])
    learned_mean, best = last["satisfaction"]["mean"], last["best_achievable"]["mean"]
    assert learned_mean["lower"] <= learned_mean["value"] <= learned_mean["upper"]
    assert learned_mean["value"] <= best["upper"] + 1e-12 and best["value"] > 0.999
    assert last["satisfaction"]["minimum"].keys() >= {"row", "column", "value", "lower", "upper"}
    assert set(last["weights"]) == {"demonstrated", "goal", "progress", "avoid", "time", "nearer"}
    assert len(last["seeds"]["mean"]) == 2


def test_a_minimum_is_left_out_where_all_are_equal(learned):
    from jaxltl.app.learn import report

    found = json.loads(learned[1].stdout.splitlines()[-1])

    def texts(least):
        for key in ("satisfaction", "best_achievable"):
            found[key]["mean"]["value"], found[key]["minimum"]["value"] = 0.75, least
        rows = [x.split()[:3] for x in report.table(found).splitlines()]
        return ["policy", "minimum"] in [row[1:] for row in rows], report.page(found, [], [], "")

    for least, shown in ((0.75, False), (0.75 - 1e-9, False), (0.7, True)):
        row, page = texts(least)
        assert row == shown and ("minimum, from row" in page) == shown


def test_learn_says_that_it_did_not_converge(learned):
    _, result = learned
    assert not json.loads(result.stdout.splitlines()[-1])["training"]["converged"]
    assert "warning: Learning did not converge in 40 steps (gradient norm" in result.stdout


def test_learn_writes_its_results(learned):
    place, result = learned
    names = {path.name for path in (place / "out").iterdir()}
    assert names == {
        "policy.npz",
        "result.json",
        "report.html",
        "task.toml",
        "certificate.umb",
        "automaton.svg",
        "values.svg",
        "policy.svg",
        "learning.svg",
        "steps.svg",
    }
    written = json.loads((place / "out" / "result.json").read_text())
    assert written == json.loads(result.stdout.splitlines()[-1])
    page = (place / "out" / "report.html").read_text()
    (proof,) = written["certificates"]
    assert run("verify", place / "out" / proof["file"]).output.endswith("\nACCEPTED\n")
    assert f"jaxltl verify {place / 'out' / proof['file']}" in result.stdout
    assert len(proof["claims"]) == 2 and all("of a given policy" in x for x in proof["claims"])
    assert "on trust: that the model and policy are those meant" in page and "jaxltl verify" in page
    # What has a live part is not shown twice; the steps have none.
    assert page.count("data:image") == 1 and page.count("<svg") == 2 + 3
    assert "http" not in page and "prefers-color-scheme: dark" in page


def test_what_is_done_is_told_and_not_done_again(learned, monkeypatch):
    place, first = learned
    task, out = place / "task.toml", place / "out"

    def begun(*_):
        raise ValueError("begun anew")

    monkeypatch.setattr("jaxltl.app.learn.prepare", begun)
    result = run("learn", task, "--out", out, "--seeds", 2, "--json")
    assert result.exit_code == 0, result.output
    assert f"finished before: see {out}/report.html" in result.stdout
    assert "--again repeats it" in result.stdout and "compiling" not in result.stderr
    told, shown = (
        x.stdout.partition("\nwrote ")[0].partition("\nfinished before")[0] for x in (first, result)
    )
    assert told == shown
    assert json.loads(result.stdout.splitlines()[-1]) == json.loads(first.stdout.splitlines()[-1])
    for more in (["--again"], ["--seed", 1], ["--out", place / "empty"]):
        options = ["--out", out, "--seeds", 2, *more]
        assert failure("learn", task, *options) == "error: begun anew\n"
    task.write_text(task.read_text() + "\n# another\n")
    again = ["learn", task, "--out", out, "--seeds", 2, "--again"]
    assert failure(*again) == "error: begun anew\n"
    task.write_text(task.read_text().removesuffix("\n# another\n"))


def test_the_result_of_another_task_is_kept(learned):
    place, _ = learned
    other, out = place / "other.toml", place / "out"
    other.write_text((place / "task.toml").read_text().replace("0.3", "0.25"))
    before = (out / "result.json").read_bytes(), (out / "task.toml").read_bytes()
    message = failure("learn", other, "--out", out)
    assert "has the result of another file" in message and "--again" in message
    assert before == ((out / "result.json").read_bytes(), (out / "task.toml").read_bytes())
    assert not (out / ".lock").exists()


def test_two_runs_do_not_share_a_directory(learned):
    place, _ = learned
    claim = (place / "shared", "task.toml", b"", False)
    with run_job.claimed(*claim):
        message = failure("learn", place / "task.toml", "--out", place / "shared")
    assert "another run writes into" in message and "--out" in message
    with run_job.claimed(*claim):  # free again
        pass
    assert [path.name for path in (place / "shared").iterdir()] == ["task.toml"]


def test_progress_in_a_pipe_is_lines(learned):
    _, first = learned
    assert "\r" not in first.stderr
    stages = [line.partition(",")[0] for line in first.stderr.splitlines()]
    assert {"compiling", "learning", "drawing"} <= set(stages)


@pytest.mark.slow
def test_what_falls_short_is_told_in_red_with_what_helps(write, tmp_path):  # noqa: F811
    path = write(
        ("[task]", '[task]\nguarantee = "none"'),
        shown={
            "demonstrations": [
                {"cells": [[2, 1], [2, 2], [1, 2]], "actions": ["right", "up", "right"]}
            ]
        },
    )
    arguments = ["learn", str(path), "--out", str(tmp_path / "out"), "--json"]
    result = CliRunner().invoke(main, arguments, color=True)
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout.splitlines()[-1])
    value = found["satisfaction"]["mean"]["value"]
    assert value < 0.5 and found["guarantee"]["remedy"] == 1
    warning = (
        f"warning: The policy satisfies the formula with probability {value:.4f} where 1.0000 is possible."
        ' With guarantee = "best" in [task] at least 1.0000 is certified: tried.'
    )
    assert f"\033[31m{warning}\033[0m" in result.stdout
    assert "By the transition graph" not in result.stdout and "By construction" not in result.stdout
    page = (tmp_path / "out" / "report.html").read_text()
    assert warning.removeprefix("warning: ").partition(" With")[0] in page


def test_the_written_policy_runs_alone(learned):
    place, _ = learned
    with np.load(place / "out" / "policy.npz") as file:
        policy = dict(file)
    rng = np.random.default_rng(0)
    moves = {"up": -3, "down": 3, "left": -1, "right": 1}
    done = 0
    for _ in range(300):
        state = 3
        memory = policy["initial_memory"][state]
        for _ in range(60):
            chances = policy["policy"][state, memory]
            action = policy["actions"][rng.choice(4, p=chances / chances.sum())]
            row, column = divmod(state, 3)
            off = (
                (row == 0 and action == "up")
                or (row == 1 and action == "down")
                or (column == 0 and action == "left")
                or (column == 2 and action == "right")
            )
            state = state if off or state == 5 else state + moves[str(action)]
            memory = policy["next_memory"][state, memory]
        done += state == 5
    start = policy["satisfaction"][3, policy["initial_memory"][3]]
    assert abs(done / 300 - start) < 4 * np.sqrt(start * (1 - start) / 300) + 0.02


def interrupt_soon(monkeypatch):
    """A run is interrupted as it reports for the second time."""
    reports = []

    def interrupt(self, *_, **__):
        reports.append(self)
        if len(reports) == 2:
            raise KeyboardInterrupt

    monkeypatch.setattr("tqdm.tqdm.set_postfix", interrupt)


def test_an_interrupted_run_goes_on_bitwise(learned, monkeypatch):
    place, _ = learned
    task, out = place / "task.toml", place / "again"
    interrupt_soon(monkeypatch)
    result = run("learn", task, "--out", out, "--seeds", 2)
    assert result.exit_code == 130 and "goes on from the last checkpoint" in result.stderr
    assert len(list(out.glob("checkpoint-*.npz"))) == 1
    assert not (out / "result.json").exists()
    monkeypatch.undo()
    result = run("learn", task, "--out", out, "--seeds", 2)
    assert result.exit_code == 0 and "going on from" in result.stderr
    assert not list(out.glob("checkpoint-*.npz"))
    with np.load(out / "policy.npz") as a, np.load(place / "out" / "policy.npz") as b:
        for name in ("policy", "weights", "all_weights", "satisfaction"):
            assert a[name].tobytes() == b[name].tobytes()
    first, second = ((p / "learning.svg").read_text() for p in (out, place / "out"))
    assert len(first) == len(second)  # the history too is whole


SLOW = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.02)
except BaseException:
    raise AttributeError("half there")
"""


def test_an_interrupt_waits_for_what_is_imported(tmp_path, monkeypatch):
    (tmp_path / "imported_slowly.py").write_text(SLOW)
    monkeypatch.syspath_prepend(tmp_path)
    before = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGALRM)]
    signal.signal(signal.SIGINT, entry._interrupt)
    try:
        with pytest.raises(KeyboardInterrupt):
            import imported_slowly  # noqa: F401

            assert "imported_slowly" in sys.modules
            time.sleep(5)
    finally:
        for number, handler in before:
            signal.signal(number, handler)


def test_an_interrupted_command_says_so_in_a_line():
    program = """
import signal, jaxltl.cli
signal.signal(signal.SIGINT, signal.default_int_handler)  # which shells turn off behind an "&"
jaxltl.cli.main = lambda **_: signal.raise_signal(signal.SIGINT)
from jaxltl.__main__ import run
run()
"""
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (found.returncode, found.stdout, found.stderr) == (130, "", "interrupted\n")


def test_an_interrupted_program_says_so_in_a_line(monkeypatch, capsys):
    monkeypatch.setenv("NPROC", "2")

    def stop(x):
        raise KeyboardInterrupt

    def lane(x):
        return jax.pure_callback(stop, x, x, vmap_method="sequential")

    def command():
        jax.block_until_ready(jax.vmap(partial(over_cores, lane))(jnp.arange(2.0)))

    with pytest.raises(SystemExit) as ended:
        plain_errors(command)()
    assert ended.value.code == 130
    assert capsys.readouterr().err.splitlines()[-1] == "interrupted"


def test_another_task_does_not_go_on_from_a_checkpoint(learned, monkeypatch):
    place, _ = learned
    out = place / "other"
    (place / "b.toml").write_text((place / "task.toml").read_text().replace("0.3", "0.2"))

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("tqdm.tqdm.set_postfix", interrupt)
    run("learn", place / "task.toml", "--out", out, "--seeds", 2)
    result = run("learn", place / "b.toml", "--out", out, "--seeds", 2)
    assert "going on from" not in result.stderr
    assert len(list(out.glob("checkpoint-*.npz"))) == 2


def test_a_task_that_cannot_be_done_from_some_start(write, tmp_path):  # noqa: F811
    # Shapes and seeds are those of the run above, so nothing is compiled anew.
    path = write(
        (". . r\nb . y", "b # .\nr # y"),
        QUICK,
        shown={"demonstrations": [{"cells": [[1, 3]], "actions": ["down"]}]},
    )
    result = run("learn", path, "--out", tmp_path / "out", "--seeds", 2)
    assert result.exit_code == 0, result.output
    assert (
        "warning: No policy can satisfy the formula from 1 of 2 initial states: row 1, column 1."
    ) in result.stdout
    written = json.loads((tmp_path / "out" / "result.json").read_text())
    assert written["impossible_starts"] == [{"state": 0, "row": 1, "column": 1}]
    assert written["best_achievable"]["minimum"]["value"] == 0


@pytest.mark.parametrize(("starts", "others"), [("o", ""), ("o | w", " and the other 2 initial")])
def test_a_task_that_is_lost_from_every_start_is_an_error(tmp_path, starts, others):
    shown = {"demonstrations": [{"cells": [[1, 3], [2, 3]], "actions": ["down", "left"]}]}
    (tmp_path / "shown.json").write_text(json.dumps(shown))
    (tmp_path / "task.toml").write_text(
        f'''name = "lost"
[world]
map = """
s . o
w o g
"""
initial = "{starts}"
[task]
formula = "!o & !w & (!o U g)"
[demonstrations]
file = "shown.json"
[learner]
method = "mlirl"
discount = 0.5'''
    )
    for command in ("learn", "check"):
        out = () if command == "check" else ("--out", tmp_path / "out")
        result = run(command, tmp_path / "task.toml", *out)
        assert result.exit_code == 2
        assert f"from row 1, column 3{others}" in result.output, result.output


@pytest.mark.parametrize(
    ("replacement", "message"),
    [
        (("discount = 0.9", "discount = "), "line 18"),
        (("!r U y", "!r U U y"), "column 6"),
        (("!r U y", "!red U y"), "the formula mentions the proposition 'red'"),
        (("!r U y", "!r & r"), "[task] formula: nothing satisfies it"),
        (("discount = 0.9", "discount = 0.9\nguess = [1, 2]"), "guess has 2 numbers; there are 5"),
        (
            ("discount = 0.9", 'discount = 0.9\navoid = ["q"]'),
            "[learner] avoid: 'q' is not a propos",
        ),
        (("discount = 0.9", "discount = 0.9\nprogress = [9]"), "automaton state 9 does not exist"),
    ],
)
def test_mistakes_come_as_one_line(write, tmp_path, replacement, message):  # noqa: F811
    assert message in failure("learn", write(replacement), "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_places_that_cannot_be_used(write, tmp_path):  # noqa: F811
    assert "cannot be read" in failure("learn", tmp_path / "none.toml")
    path = write()
    assert "cannot write into" in failure("learn", path, "--out", path / "below")
    (tmp_path / "out" / "task.toml").mkdir(parents=True)
    assert "task.toml" in failure("learn", path, "--out", tmp_path / "out")


def test_check(write):  # noqa: F811
    result = run("check", write())
    assert result.stdout == "ok: 6 states, 3 memory states, 1 demonstration of 2 pairs\n"
    assert "demonstration 1, step 1" in failure(
        "check", write(shown={"demonstrations": [{"cells": [[9, 9]], "actions": ["up"]}]})
    )


@pytest.mark.parametrize(
    "name",
    [
        "two_goals",
        "log_patrol",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in (
                "slippery_delivery",
                "one_demonstration",
                "patrol_two",
                "patrol_anywhere",
                "two_rooms",
                "unlabelled_delivery",
            )
        ),
    ],
)
def test_the_examples_are_sound(name):
    assert run("check", f"examples/{name}.toml").stdout.startswith("ok: ")


def test_check_reads_games_too(tmp_path):
    sizes = {
        "robots": "512 states, 1024 in the product",
        "patrol": "512 states, 512 in the product",
    }
    for name, size in sizes.items():
        assert run("check", f"examples/{name}.toml").stdout == f"ok: {size}\n"
    text = Path("examples/robots.toml").read_text()
    (tmp_path / "wrong.toml").write_text(text.replace("G !collision", "G !colision"))
    assert "colision" in failure("check", tmp_path / "wrong.toml")
    assert not list(tmp_path.glob("out*"))


def alone(code, tmp_path, **environment):
    """What a fresh process prints, that has imported nothing yet."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XDG_", "TF_"))}
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**kept, "XDG_CACHE_HOME": str(tmp_path), **environment},
    )
    return done.stdout.strip()


def test_the_first_line_comes_before_anything_heavy(tmp_path):
    """When it is written, neither JAX nor NumPy has been imported; help needs neither, too."""
    heavy = "[m for m in ('jax', 'numpy', 'matplotlib', 'tqdm', 'scipy') if m in sys.modules]"
    code = f"""
import sys, click
from click.testing import CliRunner
import jaxltl
from jaxltl import __main__ as entry
from jaxltl.plot.drawing import artist, draw, drawing
from jaxltl.app.compilation import cache_directory
from jaxltl.cli import main
assert CliRunner().invoke(main, ["--help"]).exit_code == 0
def echo(text, **_):
    print(text, {heavy})
    raise SystemExit
click.echo = echo
main(["learn", "task.toml"])"""
    assert alone(code, tmp_path) == f"jaxltl {jaxltl.__version__}: learning from task.toml []"


@pytest.mark.slow
def test_the_command_keeps_compiled_programs_and_the_library_does_not(tmp_path):
    names = (
        "ENABLE_COMPILATION_CACHE",
        "COMPILATION_CACHE_DIR",
        "PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
        "PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES",
    )
    # What JAX reads of it takes a second to import, so two processes ask JAX itself.
    told = f"print(*(os.environ.get('JAX_' + name) for name in {names}))"
    read = f"import jax; print(*(getattr(jax.config, 'jax_' + n.lower()) for n in {names}))"

    def cached(*arguments, show=told, **environment):
        code = f"""
import os, sys
from jaxltl import cli
cli._begin = lambda *_: sys.exit()
try:
    cli.main({list(arguments)!r})
except SystemExit:
    {show}"""
        environment.setdefault("XLA_FLAGS", "")
        return alone(code, tmp_path, **environment)

    place = tmp_path / "jaxltl" / "programs"
    assert cached("learn", "a.toml", show=read) == f"True {place} 0.0 -1"
    assert place.is_dir()
    assert cached("learn", "a.toml", "--no-cache", show=read).startswith("False None")
    mine = {"JAX_COMPILATION_CACHE_DIR": "/mine", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "2"}
    assert cached("check", "a.toml", **mine) == "None /mine 2 -1"
    nowhere = tmp_path / "file"
    nowhere.write_text("")
    assert cached("learn", "a.toml", XDG_CACHE_HOME=str(nowhere)).startswith("None None")
    library = "import jaxltl, jax; jaxltl.MDP; print(jax.config.jax_compilation_cache_dir)"
    assert alone(library, tmp_path) == "None"


@pytest.mark.slow
def test_short_work_is_compiled_soon_and_published_figures_as_the_library_is(tmp_path):
    def flags(command, **environment):
        code = f"""
import os, sys
from jaxltl import cli
cli._begin = lambda *_: sys.exit()
try:
    cli.main({command!r})
except SystemExit:
    print(os.environ.get("XLA_FLAGS"))"""
        return alone(code, tmp_path, **environment)

    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("XLA_FLAGS", raising=False)
        found = flags(["learn", "a.toml"]).split()
        assert found and set(found) <= {
            f"--{name}={value}" for name, value in FAST_COMPILATION.items()
        }
        assert flags(["reproduce", "mlirl"]) == "None"
    assert flags(["learn", "a.toml"], XLA_FLAGS="--xla_dump_to=x") == "--xla_dump_to=x"
    for version in ("0.6.2", "0.11.0", "1.0"):
        assert xla_flags(FAST_COMPILATION, version) == "", "flags that no test has tried there"


def test_double_precision_holds_in_callbacks(tmp_path):
    """They run in other threads, where a precision of this thread alone would not hold."""
    code = """
import jax, numpy as np
from jaxltl.app.compilation import float64
with float64():
    shape = jax.ShapeDtypeStruct((), np.float64)
    third = jax.jit(lambda x: jax.pure_callback(lambda y: np.asarray(y) / 3, shape, x))
    print(float(third(np.float64(1))))
print(jax.config.jax_enable_x64)"""
    assert alone(code, tmp_path).split() == [str(1 / 3), "False"]


def test_short_work_solves_its_systems_in_one_thread(tmp_path):
    code = """
import os
from jaxltl.app import compilation
compilation.use_one_thread()
print(os.environ.get("OPENBLAS_NUM_THREADS"))
import numpy
del os.environ["OPENBLAS_NUM_THREADS"]
compilation.use_one_thread()
print(os.environ.get("OPENBLAS_NUM_THREADS"))"""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("OPENBLAS_NUM_THREADS", raising=False)
        assert alone(code, tmp_path).split() == ["1", "None"]  # too late beside NumPy
    assert alone(code, tmp_path, OPENBLAS_NUM_THREADS="3").split() == ["3", "None"]


@pytest.mark.parametrize(
    ("platform", "environment", "place"),
    [
        ("linux", {}, ".cache"),
        ("linux", {"XDG_CACHE_HOME": "relative"}, ".cache"),
        ("linux", {"XDG_CACHE_HOME": "/caches"}, "/caches"),
        ("darwin", {}, "Library/Caches"),
        ("win32", {}, "AppData/Local"),
        ("win32", {"LOCALAPPDATA": "/local"}, "/local"),
    ],
)
def test_where_programs_are_kept(monkeypatch, platform, environment, place):
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(sys, "platform", platform)
    assert cache_directory() == Path.home() / place / "jaxltl" / "programs"


def test_drawn_in_another_process_a_picture_is_the_same():
    task = drawing("automaton", to_automaton("F a"), layout="matplotlib")
    with artist(apart=True) as begin:
        first = begin(task)
        assert len(first()) == len(draw(task))  # the names in the file are drawn by lot
        wrong = begin(drawing("automaton", None))
        with pytest.raises(AttributeError):
            wrong()


def test_a_dead_process_draws_nothing_and_loses_nothing(monkeypatch):
    class Pool:
        def __init__(self, *_):
            pass

        def submit(self, *_):
            return self

        def shutdown(self, **_):
            pass

        def result(self):
            raise BrokenExecutor

    monkeypatch.setattr("jaxltl.plot.drawing.ProcessPoolExecutor", Pool)
    task = drawing("automaton", to_automaton("F a"), layout="matplotlib")
    with artist(apart=True) as begin:
        assert begin(task)().endswith(b"</svg>\n")


# --- reproduce ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def patrolled(tmp_path_factory):
    """What section 6.7 comes to with two seeds, and what was printed and written."""
    out = tmp_path_factory.mktemp("pac")
    result = run("reproduce", "pac", "--seeds", 2, "--json", "--out", out)
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout.splitlines()[-1]), result.stdout, out


@pytest.mark.slow
def test_the_game_of_section_6_7(patrolled):
    found, _, _ = patrolled
    sizes = [
        found[k]
        for k in (
            "states",
            "system_states",
            "system_transitions",
            "transitions",
            "reachable_system_states",
            "almost_sure_states",
        )
    ]
    assert sizes == [144, 72, 192, 336, 54, 144]
    assert found["values"] == {
        "0.545417": 8,
        "1.196350": 8,
        "1.430686": 16,
        "1.515047": 24,
        "1.545417": 16,
    }
    initial = [found["initial_strategy"][k] for k in ("min", "max", "mean")]
    np.testing.assert_allclose(initial, [0.175092, 0.675092, 0.507881], atol=1e-6)
    assert found["winning_strategy"]["min"] >= 0
    assert found["winning_strategy"]["mean"] < found["initial_strategy"]["mean"]
    assert found["hat_strategy_gap"] == pytest.approx(9.494e-7, rel=1e-3)
    assert found["uniform_hat_strategy_gap"] == pytest.approx(5.878e-7, rel=1e-3)


@pytest.mark.slow
def test_what_is_learned_in_section_6_7(patrolled):
    found, _, _ = patrolled
    for anew, straight in zip(found["learned"], found["learned_without_restarts"], strict=True):
        assert anew["seed"] == straight["seed"]
        assert (anew["restart"], straight["restart"]) == (0.02, 0.0)
        assert anew["always_almost_sure"] is True is straight["always_almost_sure"]
        assert 50 <= anew["eps_optimal_states"] <= anew["eps_optimal_states_played"] <= 54
        assert 10 <= straight["eps_optimal_states"] <= straight["eps_optimal_states_played"] < 45
        for row in (anew, straight):
            # Steps are of many moves; the one in which the rest is over is made whole.
            assert 0 <= row["moves"] - row["last_update_step"] - 20_000 < 1000
            assert 54 < row["updates"] <= 336
    assert [row["seed"] for row in found["learned"]] == [0, 1]
    shown = {k: np.array(v) for k, v in found["figure18"].items()}
    near = shown["optimal"] - shown["learned"] <= 1e-4
    assert np.sum(near & shown["reachable"]) >= found["learned"][0]["eps_optimal_states"]
    assert (shown["learned"] <= shown["optimal"] + 1e-9).all()
    marked = np.array(found["figure19"]["epsilon_optimal"])
    assert marked.shape == (2, 4, 9) and marked.sum() == found["learned"][0]["eps_optimal_states"]


@pytest.mark.slow
def test_the_best_moves_by_the_reward_alone(patrolled):
    found, _, _ = patrolled
    on, off = np.array(found["figure17"]["best"])  # for each cell: up, down, left, right
    # Round the block, counterclockwise in the upper left and clockwise in the lower right.
    assert [on[cell].argmax() for cell in (0, 3, 4, 1)] == [1, 3, 0, 2]
    assert [off[cell].argmax() for cell in (4, 5, 8, 7)] == [3, 1, 2, 0]
    assert on.sum(axis=1).tolist() == off.sum(axis=1).tolist() == [1] * 9


@pytest.mark.slow
def test_the_table_and_the_pictures_of_section_6_7(patrolled):
    found, printed, out = patrolled
    for words in (
        "published",
        "measured",
        "58.05",
        "29.77",
        "1.545417: 16",
        "4 of 4 runs won almost surely",
    ):
        assert words in printed
    row = found["learned"][1]
    assert re.search(rf"^ +1 +{row['last_update_step']} +{row['updates']} ", printed, re.MULTILINE)
    pictures = sorted(path.name for path in out.iterdir())
    assert pictures == [
        "figure_17_automaton.svg",
        "figure_17_best_moves.svg",
        "figure_18_values.svg",
        "figure_19_initial.svg",
        "figure_19_learned.svg",
    ]
    assert all((out / name).read_bytes().rstrip().endswith(b"</svg>") for name in pictures)


def test_seeds_are_for_experiments_that_repeat_themselves():
    assert "reproduce mlirl has no seeds" in failure("reproduce", "mlirl", "--seeds", 2)


def test_a_mistake_in_a_file_is_told_before_jax_is_imported(tmp_path):
    text = (Path(__file__).parent.parent / "examples" / "two_goals.toml").read_text()
    (tmp_path / "wrong.toml").write_text(text.replace("\nformula", "\nformla"))
    code = (
        "import sys\nfrom jaxltl.__main__ import run\nsys.argv = ['jaxltl', 'learn', 'wrong.toml']\n"
        "try:\n    run()\nexcept SystemExit as end:\n    print(end.code, 'jax' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True
    )
    assert "did you mean 'formula'" in done.stderr
    assert done.stdout.splitlines()[-1] == "2 False", done.stdout
