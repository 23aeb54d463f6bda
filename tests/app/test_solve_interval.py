"""`jaxltl solve` on interval models: kinds, values, what nature picks, and mistakes."""

import json
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner

from jaxltl.cli import main
from jaxltl.core.models.interval import interval_rows
from jaxltl.core.models.sparse import Rewards
from jaxltl.io.model_files import write_model


def rover(chain=False):
    """From the base a direct way that may fail, or a detour; past the first state one choice."""
    rows, starts = (
        ([0, 1, 2, 3, 4], [0, 3, 5, 6, 7]) if chain else ([0, 2, 3, 4, 5], [0, 3, 5, 7, 8, 9])
    )
    target = [1, 2, 3, 0, 2, 2, 3] if chain else [1, 2, 3, 0, 1, 0, 2, 2, 3]
    lower = [0.2, 0.3, 0, 0.1, 0.7, 1, 1] if chain else [0.2, 0.3, 0, 0.4, 0.5, 0.1, 0.7, 1, 1]
    upper = [0.6, 0.6, 0.3, 0.3, 0.9, 1, 1] if chain else [0.6, 0.6, 0.3, 0.5, 0.6, 0.3, 0.9, 1, 1]
    size = len(starts) - 1
    return interval_rows(
        rows,
        starts,
        target,
        lower,
        upper,
        initial=[1, 0, 0, 0],
        label={"goal": [2], "lost": [3], "half": [1]},
        rewards={"time": Rewards(choice=np.arange(1, size + 1.0))},
        action=None if chain else [0, 1, 0, 0, 0],
        action_names=() if chain else ["go", "round"],
    )


def results(*arguments):
    done = CliRunner().invoke(main, ["solve", *map(str, arguments), "--json"])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("name", ["m.umb", "m.drn", "m.tra", "m.pexp", "m.npz"])
def test_any_file_is_solved(name, tmp_path):
    write_model(tmp_path / name, rover())
    found = results(
        tmp_path / name,
        'Pmaxmin=? [ F "goal" ]',
        'P<=0.5 [ X "half" ]',
        'Pmaxmin=? [ !"half" U<=3 "goal" ]',
        'R{"time"}minmax=? [ F "goal"|"lost" ]',
    )
    assert {k: v for k, v in found["model"].items() if k != "seconds"} == {
        "kind": "imdp",
        "states": 4,
        "choices": 5,
        "transitions": 9,
    }
    values = found["results"]
    # Round about, again and again, nothing is lost.
    assert values[0]["lower"] == values[0]["upper"] == 1
    assert values[1]["value"] is False
    assert values[2]["value"] == pytest.approx(0.3)
    assert all(one["status"] == "CONVERGED" for one in values)


def test_chains_have_one_direction(tmp_path):
    write_model(tmp_path / "m.drn", rover(chain=True))
    found = results(
        tmp_path / "m.drn", 'Pmin=? [ F "goal" ]', 'Pmax=? [ F "goal" ]', 'P>=0.6 [ F "goal" ]'
    )
    assert found["model"]["kind"] == "idtmc"
    low, high, holds = found["results"]
    # From half-way one is back with .1 to .3, else at the goal: x = .4 (.7 + .3 x) + .3 at worst.
    assert low["lower"] <= 0.58 / 0.88 <= low["upper"] and high["value"] == pytest.approx(1)
    assert holds["value"] is True


def test_mistakes_are_named(tmp_path):
    path = tmp_path / "m.drn"
    write_model(path, rover())
    done = CliRunner().invoke(main, ["solve", str(path), 'P=? [ F "goal" ]', "--json"])
    assert done.exit_code == 2 and "ask for Pmaxmin=?, Pmaxmax=?" in done.output
    done = CliRunner().invoke(
        main, ["solve", str(path), 'multi(Pmax=? [ F "goal" ], P>=0.5 [ F "half" ])']
    )
    assert done.exit_code == 2 and "multi(...) is not supported with intervals" in done.output
    text = path.read_text().replace("[0.2, 0.6]", "[0.6, 0.2]")
    path.write_text(text)
    line = 1 + text.split("\n").index("\t\t1 : [0.6, 0.2]")
    done = CliRunner().invoke(main, ["solve", str(path), 'Pmaxmin=? [ F "goal" ]'])
    assert done.exit_code == 2 and f"line {line}: '[0.6, 0.2]' stands where" in done.output


def written(path, model, prop):
    write_model(path / "m.umb", model)
    found = results(path / "m.umb", prop, "--strategy", path / "s.json")["results"][0]
    (strategy,) = json.loads((path / "s.json").read_text())["strategies"]
    return found, strategy


def assert_within(model, nature):
    host = model.host.mdp
    for s, choices in enumerate(nature):
        assert len(choices) == host.row_start[s + 1] - host.row_start[s]
        for r, given in enumerate(choices, host.row_start[s]):
            assert sum(given.values()) == pytest.approx(1)
            for e in range(host.entry_start[r], host.entry_start[r + 1]):
                p = given.get(str(host.successor[e]), 0)
                assert model.lower[e] - 1e-15 <= p <= model.upper[e] + 1e-15


@pytest.mark.parametrize("chain", [False, True])
@pytest.mark.parametrize(("policy", "nature"), [("max", "min"), ("max", "max"), ("min", "max")])
def test_choices_and_what_nature_picks_attain_the_value(policy, nature, chain, tmp_path):
    model = rover(chain)
    found, strategy = written(tmp_path, model, f'P{policy}{nature}=? [ !"half" U "goal" ]')
    assert strategy["kind"] == "memoryless"
    assert_within(model, strategy["nature"])
    goal, stay = (np.asarray(model.states_with_label(x)) for x in ("goal", "half"))
    value = goal.astype(float)
    for _ in range(2000):
        value = np.array(
            [
                1.0
                if goal[s]
                else 0.0
                if stay[s]
                else sum(p * value[int(t)] for t, p in choices[strategy["choice"][s]].items())
                for s, choices in enumerate(strategy["nature"])
            ]
        )
    assert value[0] == pytest.approx(found["value"], abs=1e-6)


def test_with_a_memory_both_are_told_by_pairs(tmp_path):
    model = rover()
    prop = 'Pmaxmin=? [ (!"half" U "goal") | F ("half" & X "goal") ]'
    found, strategy = written(tmp_path, model, prop)
    assert strategy["kind"] == "memory" and strategy["letter_of"] == "the state that is left"
    pairs = {
        (s, q): i
        for i, (s, q) in enumerate(zip(strategy["state"], strategy["memory"], strict=True))
    }
    mass, start = {}, strategy["initial"][0]
    mass[tuple(start)] = 1.0
    for _ in range(200):
        after: dict = {}
        for (s, q), p in mass.items():
            i = pairs[s, q]
            if not strategy["nature"][i]:  # its verdict is known
                after[s, q] = after.get((s, q), 0) + p
                continue
            to = strategy["update"][q][strategy["letter"][s]]
            for t, chance in strategy["nature"][i][strategy["choice"][i]].items():
                pair = int(t), to
                after[pair] = after.get(pair, 0) + p * chance
        mass = after
    still = {pair: p for pair, p in mass.items() if not strategy["nature"][pairs[pair]]}
    assert sum(still.values()) == pytest.approx(1)
    # What is accepted goes on to be: of all that stands still, one memory is "yes".
    by_memory: dict = {}
    for (_, q), p in still.items():
        by_memory[q] = by_memory.get(q, 0) + p
    assert any(p == pytest.approx(found["value"], abs=1e-6) for p in by_memory.values())


def test_nothing_is_compiled(tmp_path):
    write_model(tmp_path / "m.umb", rover())
    asked = [
        'Pmaxmin=? [ F "goal" ]',
        'Pminmax=? [ G F "half" ]',
        'Pmaxmin=? [ G !"lost" ]',
        'R{"time"}minmax=? [ F "goal"|"lost" ]',
        'Pmaxmin=? [ F<=7 "goal" ]',
    ]
    program = (
        "import jax\n"
        "def fail(*a, **k): raise AssertionError('compiled')\n"
        "jax._src.compiler.compile_or_get_cached = fail\n"
        "from jaxltl.cli import main\n"
        f"main({['solve', str(tmp_path / 'm.umb'), *asked]!r}, standalone_mode=False)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
