"""Programs in the PRISM language as files: models, properties, task and game files, the command."""

import gzip
import json

import numpy as np
import pytest
from click.testing import CliRunner

import jaxltl as jl
from jaxltl.app import solve as solving
from jaxltl.app.files.game import GameFile, load_game
from jaxltl.cli import main
from jaxltl.core.logic.comparisons import program_definitions
from jaxltl.core.logic.properties import parse_property
from jaxltl.io.prism.program import constants_of

WALK = """// a walk with two kinds of steps
mdp
const int N; const double p = 0.5;
formula far = x = N;
module walk
  x : [0..N] init 1; tired : bool;
  [slow] x>0 & x<N -> p : (x'=x+1) + 1-p : (x'=x-1);
  [fast] x>0 & x<N-1 & !tired -> p : (x'=x+2) & (tired'=true) + 1-p : (x'=0);
  [] x=0 | far -> true;
endmodule
label "lost" = x=0;
rewards "time" [slow] true : 2; [fast] true : 1; endrewards
"""
RELAY = """// a token passed on through copies of a module, with losses
dtmc
const int N; const double loss = 1 / (2 * N); global lost : [0..N];
formula all = t1 + t2;
module m1
  t1 : [0..1] init 1;
  [pass] t1=1 -> (t1'=0);
  [] t1=0 & lost<N & t2=0 -> loss : (t1'=1) & (lost'=min(lost+1, N)) + 1-loss : (t1'=1);
endmodule
module m2 = m1 [t1=t2, t2=t1, pass=back] endmodule
module ticks c : [0..3]; [pass] true -> (c'=mod(c+1, 4)); [back] c!=2 -> true; endmodule
rewards all>1 : 2; [pass] true : lost/N; endrewards
label "late" = lost=N & !(c=3);
"""
GAME = """smg
const int N; player a m endplayer player b n endplayer
global turn : [0..1];
module m x : [0..N]; [] turn=0 & x<N -> [0.4,0.6] : (x'=x+1) & (turn'=1) + [0.4,0.6] : (turn'=1);
  [] turn=0 -> (turn'=1); endmodule
module n y : [0..1]; [] turn=1 -> (turn'=0) & (y'=1-y); endmodule
label "goal" = x=N;
"""
PROGRAMS = (WALK, RELAY, GAME)
PROPERTIES = """const int k; // given from outside
const double half = 1/2; label "there" = far;
"win": Pmax=? [ F "there" ]; "time": R{"time"}min=? [ F far | "lost" ];
"soon": Pmax>=half [ F<=k far ]; "tired": Pmax=? [ F tired & x=N-k ];
filter(count, x>=2)
"""


@pytest.fixture
def walk(tmp_path):
    path = tmp_path / "walk.prism"
    path.write_text(WALK)
    return path


def test_a_program_is_read_as_a_model(walk):
    model = jl.read_model(walk, constants={"N": 3})
    assert (model.num_states, model.propositions) == (5, ("lost", "deadlock"))
    x, tired = model.valuation["x"], model.valuation["tired"]
    assert model.states_where("x=3 | tired & x<1").tolist() == ((x == 3) | tired & (x < 1)).tolist()
    assert jl.solve_property(model, "Pmax=? [ F x=3 ]").value.tolist() == pytest.approx([0.5])
    assert jl.solve_property(model, "Pmax=? [ F tired & x>2 ]").value.tolist() == pytest.approx(
        [0.5]
    )
    assert model.states_where("tired=1 & x=3").sum() == 1
    with pytest.raises(ValueError, match="mentions y, which is no variable"):
        model.states_where("y=1")
    with pytest.raises(ValueError, match="is a number; write a comparison"):
        model.states_where("x+1")


def test_constants_are_given_in_a_dict_or_a_text(walk, tmp_path):
    first = jl.read_model(walk, constants={"N": 4})
    packed = tmp_path / "walk.nm.gz"
    packed.write_bytes(gzip.compress(WALK.encode()))
    second = jl.read_model(packed, constants="N = 2 * 2")
    np.testing.assert_array_equal(first.probability, second.probability)
    assert constants_of("a=max(1,2), b=true") == {"a": "max(1,2)", "b": "true"}
    for wrong in ("N", "N=", "=3", "N=1,N=2", "N=1:3"):
        with pytest.raises(ValueError, match="constants: "):
            jl.read_model(walk, constants=wrong)
    with pytest.raises(ValueError, match=r"walk\.prism', line 6, column 11: the constant N has no"):
        jl.read_model(walk)
    with pytest.raises(ValueError, match="more than 3 states"):
        jl.read_model(walk, constants="N=9", max_states=3)
    with pytest.raises(ValueError, match="is no program; constants, max_states"):
        jl.read_model(tmp_path / "walk.umb", constants="N=9")
    with pytest.raises(ValueError, match="programs are read, not written"):
        jl.write_model(walk, first)


def test_the_command_answers_the_properties_of_a_file(walk, tmp_path):
    asked = tmp_path / "walk.props"
    asked.write_text(PROPERTIES)
    run = CliRunner().invoke(main, ["solve", str(walk), str(asked), "--const", "N=3,k=1", "--json"])
    assert run.exit_code == 0, run.output
    record = json.loads(run.output.splitlines()[-1])
    assert record["model"]["states"] == 5
    found = {r.get("name", "count"): r["value"] for r in record["results"]}
    # From 1: fast reaches 3 with 1/2; slow reaches 2 or 0, and again from 2 reaches 3 or 1.
    assert found["win"] == pytest.approx(0.5)
    assert found["time"] == pytest.approx(1.0)
    assert found["soon"] is True
    assert found["tired"] == 0.0
    assert found["count"] == 3


def test_the_command_explores_a_part_of_a_program(walk):
    options = ["--const", "N=3", "--method", "partial", "--json"]
    run = CliRunner().invoke(main, ["solve", str(walk), "Pmax=? [ F x=N ]", *options])
    assert run.exit_code == 0, run.output
    record = json.loads(run.output.splitlines()[-1])
    assert record["results"][0]["value"] == pytest.approx(0.5)
    assert record["results"][0]["method"].startswith("partial exploration")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--const", "N=3"], "a value of k, here or as --const k"),
        (["--const", "N=3,k=1,q=2"], "there is no constant q"),
        (["--const", "N=3,k=x"], "give a number, true or false"),
        (["--const", "N=3,k=1", "--max-states", "2"], "more than 2 states"),
    ],
)
def test_the_command_names_mistakes(walk, tmp_path, options, says):
    asked = tmp_path / "walk.props"
    asked.write_text(PROPERTIES)
    run = CliRunner().invoke(main, ["solve", str(walk), str(asked), *options])
    assert run.exit_code != 0
    assert says in run.output


def test_deadlocks_are_reported_by_the_command(tmp_path, capsys):
    path = tmp_path / "stop.prism"
    path.write_text("dtmc module m x : [0..1]; [] x=0 -> (x'=1); endmodule")
    program, queries = solving.read_queries(path, None, ["P=? [ F x=1 ]"])
    solving.load(path, program)
    assert "warning: " in capsys.readouterr().err
    assert queries[0].parsed is not None


def test_game_files_take_programs(tmp_path):
    game = GAME.replace("[0.4,0.6] : (turn", "0.5 : (turn").replace("[0.4,0.6]", "0.5")
    (tmp_path / "g.prism").write_text(game)
    path = tmp_path / "g.toml"
    path.write_text('[game]\nmodel = "g.prism"\nconstants = "N=2"\n[task]\nformula = "F goal"\n')
    world = load_game(GameFile.read(path))
    system = np.asarray(world.game.system)
    assert (system.size, system.sum()) == (12, 6)  # x in 0, 1, 2 and y in 0, 1, at each turn


@pytest.mark.parametrize("players", [2, 3, 4])
def test_players_are_merged_where_the_coalition_is_given(tmp_path, players):
    modules = "".join(
        f"module m{i} x{i} : [0..1]; [] t={i} -> (t'=(t+1 > last ? 0 : t+1)); endmodule "
        f"player p{i} m{i} endplayer "
        for i in range(players)
    )
    path = tmp_path / "game.smg"
    path.write_text(f"smg const int last = {players - 1}; global t : [0..last]; {modules}")
    names = [f"p{i}" for i in range(players)]
    smg = jl.read_model(path)
    assert smg.players == tuple(names)
    assert smg.owner.tolist()[:players] == list(range(players))
    with pytest.raises(ValueError, match=r"write model.game\("):
        jl.io.write_model(tmp_path / "game.umb", smg)
    game = jl.read_model(path, coalition=names[1:])
    assert np.asarray(game.system)[:players].tolist() == [False] + [True] * (players - 1)
    for wrong in ("p0", ["p9"]):
        with pytest.raises(ValueError, match="player"):
            jl.read_model(path, coalition=wrong)


def test_rewards_without_names_are_called_by_position(tmp_path):
    path = tmp_path / "walk.prism"
    path.write_text(
        "dtmc module m x : [0..2]; [] x<2 -> (x'=x+1); [] x=2 -> true; endmodule "
        'rewards x<2 : 1; endrewards rewards "b" x<2 : 5; endrewards rewards x<2 : 7; endrewards'
    )
    model = jl.read_model(path)
    assert list(model.rewards) == ["1", "b", "3"]
    program = jl.io.read_program(path)
    for text, value in {
        "R{1}=? [ F x=2 ]": 2,
        "R{3}=? [ F x=2 ]": 14,
        'R{"3"}=? [ F x=2 ]': 14,
    }.items():
        prop = parse_property(text, program_definitions(program))
        assert jl.solve_property(model, prop).value.tolist() == [value]
    with pytest.raises(ValueError, match="'1', 'b', '3'"):
        jl.solve_property(model, "R=? [ F x=2 ]")
