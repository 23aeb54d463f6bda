"""`jaxltl solve`: files and properties in, certified values out, as text and as JSON."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

import jaxltl
from jaxltl.app import solve as module
from jaxltl.checker import verdict
from jaxltl.cli import main
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.io.model_files import read_model, write_model
from jaxltl.io.prism.properties import parse_queries


def gambler():
    """Bold play loses or wins all at once; timid play goes one step. States 0 to 4, from 2."""
    return make_sparse(
        [0, 1, 3, 5, 7, 8],
        [0, 1, 3, 5, 7, 9, 11, 13, 14],
        [0, 0, 2, 0, 2, 1, 3, 0, 4, 2, 4, 2, 4, 4],
        [1] + 6 * [0.6, 0.4] + [1],
        initial=[0, 0, 1, 0, 0],
        label={"ruin": [0], "rich": [4], "a b": [1, 3]},
        rewards={
            "steps": Rewards(state=[0, 1, 1, 1, 0]),
            "stake": Rewards(choice=[0, 1, 1, 1, 2, 1, 1, 0]),
        },
        action=[0, 0, 1, 0, 1, 0, 1, 0],
        action_names=["timid", "bold"],
    )


@pytest.fixture
def model_file(tmp_path):
    path = tmp_path / "gambler.umb"
    write_model(path, gambler())
    return path


def run(*arguments):
    return CliRunner().invoke(main, ["solve", *map(str, arguments)])


def results(*arguments):
    done = run(*arguments, "--json")
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout.splitlines()[-1])


def test_the_object_is_as_promised(model_file):
    found = results(
        model_file,
        'Pmax=? [ F "rich" ]',
        'R{"steps"}min=? [ F "rich" ]',
        'P>=0.2 [ F "rich" ]',
        'Pmax>0.3 [ F "rich" ]',
        'Pmax=? [ F<=1 "rich" ]',
    )
    assert {k: v for k, v in found["model"].items() if k != "seconds"} == {
        "kind": "mdp",
        "states": 5,
        "choices": 8,
        "transitions": 14,
    }
    assert found["model"]["seconds"] > 0
    keys = {"property", "value", "lower", "upper", "status", "seconds"}
    assert all(keys <= set(one) for one in found["results"])
    values = [one["value"] for one in found["results"]]
    assert values[0] == pytest.approx(0.4, abs=1e-6) and values[1] == "inf"
    assert values[2:4] == [True, True] and values[4] == pytest.approx(0.4)
    assert found["results"][0]["property"] == 'Pmax=? [ F "rich" ]'
    assert {one["status"] for one in found["results"]} == {"CONVERGED"}
    first = found["results"][0]
    assert first["lower"] <= 0.4 <= first["upper"] and first["upper"] - first["lower"] <= 1e-6
    assert found["results"][1]["lower"] == found["results"][1]["upper"] == "inf"


def test_certificates_of_properties(model_file, tmp_path):
    properties = ['Pmax=? [ F "rich" ]', 'LRAmax=? [ "rich" ]', 'Pmin=? [ G F "rich" ]']
    done = run(model_file, *properties, "--certificate", tmp_path / "proof.umb", "--json")
    assert done.exit_code == 0, done.output
    one, two, three = json.loads(done.stdout.splitlines()[-1])["certificates"]
    assert "reason" in two and 'no certificate: LRAmax=? [ "rich" ]' in done.stdout
    for record in (one, three):
        path = tmp_path / record["file"]
        assert verdict(str(path))[0] == 0 and f"jaxltl verify {path}" in done.stdout


def test_what_people_see(model_file):
    done = run(model_file, '"p1": Pmax=? [ F "rich" ]', 'Pmin>=1 [ F "rich" | "ruin" ]')
    assert done.exit_code == 0
    assert done.stderr.startswith(f"jaxltl {jaxltl.__version__}: solving")
    lines = done.stdout.splitlines()
    assert lines[0].startswith("mdp of 5 states, 8 choices, 14 transitions, read in")
    assert lines[2] == '"p1": Pmax=? [ F "rich" ]' and " in [0.4" in lines[3].replace(
        "in [0.39999", "in [0.4"
    )
    assert "true: the value is exactly 1.0" in done.stdout


def test_files_of_properties(model_file, tmp_path):
    path = tmp_path / "all.props"
    path.write_text(
        '// what is asked\n"win": Pmax=? [ F "rich" ];\nPmin=? [ F "rich" ]\n\n'
        'Pmax=? [\n  (G F "a b") | "ruin" ]; // the last\n'
    )
    found = results(model_file, path, 'Pmax=? [ X "a b" ]')["results"]
    assert [one["property"] for one in found] == [
        'Pmax=? [ F "rich" ]',
        'Pmin=? [ F "rich" ]',
        'Pmax=? [\n  (G F "a b") | "ruin" ]',
        'Pmax=? [ X "a b" ]',
    ]
    assert found[0]["name"] == "win" and "name" not in found[1]
    assert found[1]["value"] == pytest.approx(0.4 * 0.4 / (1 - 2 * 0.24), abs=1e-6)
    assert found[2]["value"] == 0 and found[3]["value"] == 1
    done = run(model_file, tmp_path / "none.props")
    assert done.exit_code == 2 and "none.props" in done.output


def test_mistakes_do_not_stop_the_others(model_file):
    done = run(
        model_file,
        'Pmax=? [ F "ritch" ]',
        'Pmax=? [ F "rich" ]',
        "Pmax=? [ F rich ]",
        'P=? [ F "rich" ]',
        'R{"x"}max=? [ C<=3 ]',
        'Pmin=? [ X "ruin" ]',
        "--json",
    )
    assert done.exit_code == 2 and "Traceback" not in done.output
    found = json.loads(done.stdout.splitlines()[-1])["results"]
    assert [one["status"] for one in found] == [
        "INVALID",
        "CONVERGED",
        "INVALID",
        "INVALID",
        "INVALID",
        "CONVERGED",
    ]
    assert [one["value"] is None for one in found] == [True, False, True, True, True, False]
    assert "ruin, rich, a b" in found[0]["error"] and "Did you mean 'rich'?" in found[0]["error"]
    assert "double quotes" in found[2]["error"] and "Pmax=?" in found[3]["error"]
    assert "'steps', 'stake'" in found[4]["error"]


def test_a_line_for_each_property_stands_at_the_end(tmp_path):
    model, path = tmp_path / "coin.prism", tmp_path / "all.props"
    model.write_text(
        """dtmc module m x : [0..2]; [] x=0 -> 0.1:(x'=0) + 0.3:(x'=1) + 0.6:(x'=2);
        [] x>0 -> true; endmodule"""
    )
    path.write_text(
        '"win": P=? [ F x=1 ]\nP=? [ Y x=1 ]\n"sum": "win" + 1/3\nP>=1/3 [ F\n  x=1 ]\nE [ F x=2 ]'
    )
    done = run(model, path, "--exact", "--json")
    assert done.exit_code == 2 and "\n  exactly 1/3\n" in done.stdout
    assert json.loads(done.stdout.splitlines()[-1])["results"][2]["exact"] == "2/3"
    done = run(model, path, "--exact")
    assert done.exit_code == 2
    assert [line.rsplit(": ", 1) for line in done.stdout.splitlines()[-5:]] == [
        ['"win": P=? [ F x=1 ]', "1/3"],
        ["P=? [ Y x=1 ]", "refused"],
        ['"sum": "win" + 1/3', "2/3"],
        ["P>=1/3 [ F x=1 ]", "true"],
        ["E [ F x=2 ]", "true"],
    ]


def test_nothing_to_solve_is_said_before_the_model_is_read(tmp_path):
    done = run(tmp_path / "absent.umb", "P=? [ F ")
    assert done.exit_code == 2 and "expected a label" in done.output
    done = run(tmp_path / "absent.umb", 'P=? [ F "a" ]')
    assert done.exit_code == 2 and "absent.umb" in done.output
    assert "Traceback" not in done.output


def test_undecided_thresholds_are_not_guessed(tmp_path):
    path = tmp_path / "third.umb"
    write_model(
        path,
        make_sparse(
            None,
            [0, 3, *range(4, 1004)],  # more states than are solved in fractions
            [0, 1, 2, *range(1, 1001)],
            [0.1, 0.3, 0.6, *[1.0] * 1000],
            initial=[1, *[0] * 1000],
            label={"a": [1]},
        ),
    )
    done = run(path, 'P>=1/3 [ F "a" ]', 'P>0.3 [ F "a" ]', "--json")
    assert done.exit_code == 1
    found = json.loads(done.stdout.splitlines()[-1])["results"]
    assert found[0]["value"] is None and found[0]["status"] != "CONVERGED"
    assert found[0]["lower"] <= 1 / 3 <= found[0]["upper"]
    assert found[1]["value"] is True and found[1]["status"] == "CONVERGED"
    assert "not decided" in done.stdout


def test_chains_and_several_initial_states(tmp_path):
    path = tmp_path / "chain.umb"
    write_model(
        path,
        make_sparse(
            None,
            [0, 2, 3, 4],
            [1, 2, 1, 2],
            [0.25, 0.75, 1, 1],
            initial=[0.5, 0, 0.5],
            label={"a": [1]},
        ),
    )
    found = results(path, 'P=? [ F "a" ]', 'P>0.1 [ G F "a" ]')
    assert found["model"]["kind"] == "chain"
    first = found["results"][0]
    assert first["value"] == pytest.approx([0.25, 0]) and first["states"] == [0, 2]
    assert found["results"][1]["value"] == [True, False]
    assert "state 2: " in run(path, 'P=? [ F "a" ]').stdout


def test_several_objectives(model_file):
    one = make_sparse(
        [0, 2, 3, 4],
        [0, 1, 2, 3, 4],
        [1, 2, 1, 2],
        [1, 1, 1, 1],
        initial=[1, 0, 0],
        label={"a": [1], "b": [2]},
    )
    write_model(model_file, one)
    done = run(
        model_file,
        'multi(P>=0.5 [ F "a" ], P>=0.25 [ F "b" ])',
        'multi(Pmax=? [ F "a" ], P>=0.25 [ F "b" ])',
        '"c": multi(Pmax=? [ F "a" ], Pmax=? [ F "b" ])',
        'multi(Pmax=? [ F "a" ], P>0.25 [ F "b" ])',
        'multi(Pmax=? [ F "a" ], P>=1 [ F "a" ], P>=0.25 [ F "b" ])',
        'multi(P>=1/3 [ F "a" ], P>=2/3 [ F "b" ])',
        "--json",
    )
    assert done.exit_code == 2 and "thresholds can be met: true" in done.stdout
    met, best, curve, wrong, never, border = json.loads(done.stdout.splitlines()[-1])["results"]
    assert met["value"] is True and met["status"] == "CONVERGED"
    assert best["lower"] <= 0.75 <= best["upper"] and best["achievable"] is True
    assert curve["value"] == [[0, 1], [1, 0]] and curve["name"] == "c" and curve["gap"] <= 1e-4
    assert "write >=" in wrong["error"] and wrong["status"] == "INVALID"
    assert never["value"] is None and never["achievable"] is False
    assert border["value"] is True and border["status"] == "CONVERGED"  # exactly on the curve


# --- strategies -------------------------------------------------------------------------------


def test_strategies_attain_the_values(model_file, tmp_path):
    out = tmp_path / "strategy.json"
    done = run(
        model_file,
        'Pmin=? [ F "rich" ]',
        '"x": Pmax=? [ (F "a b") & (F "rich") ]',
        'Pmax=? [ F "none" ]',
        'Pmax=? [ F<=3 "rich" ]',
        "--strategy",
        out,
    )
    assert done.exit_code == 2  # for the third
    table = json.loads(out.read_text())
    model = read_model(model_file)
    assert table["model"] == "gambler.umb" and table["states"] == 5
    timid, patient, steps = table["strategies"]
    assert timid["kind"] == "memoryless" and timid["property"] == 'Pmin=? [ F "rich" ]'
    assert timid["choice"][2] == 0 and timid["action"][2] == "timid"
    assert steps["kind"].startswith("first choice")
    # The strategy with a memory, walked: all probability that is rich after enough steps.
    assert patient["kind"] == "memory"
    choice = {
        pair: c
        for *pair_, c in zip(patient["state"], patient["memory"], patient["choice"], strict=True)
        for pair in [tuple(pair_)]
    }
    (start,) = map(tuple, patient["initial"])
    mass = {start: 1.0}
    for _ in range(200):
        moved: dict = {}
        for (s, q), p in mass.items():
            row = model.row_start[s] + choice[s, q]
            for e in range(model.entry_start[row], model.entry_start[row + 1]):
                t = int(model.successor[e])
                after = (t, patient["update"][q][patient["letter"][t]])
                moved[after] = moved.get(after, 0) + p * float(model.probability[e])
        mass = moved
    best = 0.4 * 0.4 / (1 - 2 * 0.24)  # with a visit of 1 or 3 on the way
    rich = sum(p for (s, _), p in mass.items() if s == 4)
    assert rich >= best - 1e-6
    assert patient["letters"] == [sorted(x) for x in patient["letters"]]


def test_a_strategy_that_cannot_be_written_is_said_first(model_file, tmp_path):
    done = run(model_file, 'Pmax=? [ F "rich" ]', "--strategy", tmp_path / "no" / "s.json")
    assert done.exit_code == 2 and "cannot write" in done.output and "mdp of" not in done.stdout
    assert not list(tmp_path.glob("*.json"))


# --- ways and limits --------------------------------------------------------------------------


def test_a_failure_of_ours_does_not_lose_the_other_answers(model_file, monkeypatch):
    original = module.solve_property

    def failing(model, prop, **options):
        if "ruin" in prop.text:
            raise ZeroDivisionError("for the test")
        return original(model, prop, **options)

    monkeypatch.setattr(module, "solve_property", failing)
    done = run(model_file, 'Pmax=? [ F "ruin" ]', 'Pmax=? [ F "rich" ]', "--json")
    found = json.loads(done.stdout.splitlines()[-1])["results"]
    assert done.exit_code == 1
    assert found[0]["value"] is None and "ZeroDivisionError" in found[0]["error"]
    assert found[0]["status"] != "CONVERGED" and found[1]["status"] == "CONVERGED"


def test_games_are_solved_for_a_coalition(tmp_path):
    from jaxltl.core.models.game import make_game

    path = tmp_path / "game.umb"
    write_model(path, make_game(gambler(), system=np.array([1, 1, 0, 1, 1], bool)))
    done = run(path, 'Pmax=? [ F "rich" ]')
    assert done.exit_code == 2 and "<<system>> Pmax=?" in done.output
    found = results(path, '<<system>> Pmax=? [ F "rich" ]')["results"][0]
    assert found["status"] == "CONVERGED" and 0 < found["value"] < 1
    program = tmp_path / "game.prism"
    program.write_text(
        "smg player a m endplayer player b [x], [y] endplayer module m s : [0..3]; [] s=0 -> (s'=1);"
        "[x] s=1 -> 1/4 : (s'=2) + 3/4 : (s'=3); [y] s=1 -> (s'=3); [] s>1 -> true; endmodule"
    )
    for coalition, value in {"a": 0, "b": 0.25, "1,2": 0.25, "": 0}.items():
        found = results(program, f"<<{coalition}>> Pmax=? [ F s=2 ]")["results"][0]
        assert found["value"] == value


def test_nothing_is_compiled(model_file):
    program = (
        "import sys, jax\n"
        "def fail(*a, **k): raise AssertionError('compiled')\n"
        "jax._src.compiler.compile_or_get_cached = fail\n"
        "from jaxltl.cli import main\n"
        f"main(['solve', {str(model_file)!r}, 'Pmax=? [ F \"rich\" ]', "
        '\'R{"steps"}max=? [ F "rich" | "ruin" ]\', \'Pmin=? [ G F "a b" ]\'], '
        "standalone_mode=False)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("text", ['Pmax=? [ F "rich" ]', 'Pmax=? [ G F "rich" ]'])
def test_at_most_six_files_pass_the_tolerance_on(model_file, text):
    """From the command to the innermost solver, each file once on the stack."""
    tolerance, package = 1.234e-5, Path(jaxltl.__file__).parent
    paths = set()

    def note(frame, event, arg):
        if event != "call" or "sparse/solvers" not in frame.f_code.co_filename:
            return
        files = []
        while frame is not None:
            code = frame.f_code
            names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount] + code.co_freevars
            if tolerance in [x for n in names if type(x := frame.f_locals.get(n)) is float]:
                files.append(code.co_filename)
            frame = frame.f_back
        if files and files[0].endswith("sparse/solvers/reachability.py"):
            paths.add(tuple(str(Path(x).relative_to(package)) for x in dict.fromkeys(files)))

    sys.setprofile(note)
    try:
        results(model_file, text, "--tolerance", tolerance)
    finally:
        sys.setprofile(None)
    assert paths and all(len(path) <= 6 for path in paths), paths
    # The command passes it on in its options.
    assert all(path[-1] == "app/solve.py" for path in paths)


@pytest.mark.parametrize("low, high", [(0.0, 1.0), (0.0, np.inf), (3.0, np.inf)])
def test_no_number_is_given_where_the_bounds_exclude_nothing(low, high):
    query = parse_queries(['Pmax=? [ F "a" ]'])[0]
    bounds = (np.array([x]) for x in (0.25, low, high))
    answer = module.Answer(
        np.zeros(1, int), *bounds, None, jaxltl.Status.PRECISION, "value iteration", None
    )
    result = module.PropertyResult(query, answer, 0.0)
    text = module.text(result)
    assert "0.25" not in text and f"in [{low}, {high}]" in text and "PRECISION" in text
    assert module.result_entry(result)["value"] is None
    assert f"lower=[{low:g}], upper=[{high:g}]" in repr(answer) and "PRECISION" in repr(answer)


def test_fair_strategies_leave_a_loop(tmp_path):
    model = tmp_path / "wait.prism"
    model.write_text(
        """mdp module m s : [0..2]; [wait] s=0 -> true; [go] s=0 -> 0.5:(s'=1) + 0.5:(s'=2);
        [] s>0 -> true; endmodule"""
    )
    question = "Pmin=? [ F s=1 ]"
    for options, value in (((), 0.0), (("--fair",), 0.5)):
        done = run(model, question, *options, "--json")
        assert done.exit_code == 0, done.output
        (found,) = json.loads(done.stdout.splitlines()[-1])["results"]
        assert abs(found["value"] - value) < 1e-6
    assert run(model, "Rmin=? [ F s=1 ]", "--fair").exit_code == 2
