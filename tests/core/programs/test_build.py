"""Models of programs: each construct of the language on models worked out by hand."""

import numpy as np
import pytest

from jaxltl.core.language.expressions import literal, substitute
from jaxltl.core.language.parser import parse_expression
from jaxltl.core.language.resolve import read_program
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.multiplayer import MultiplayerGame
from jaxltl.core.programs import explore, local_choices, packed_states
from jaxltl.core.programs.build import build_model
from jaxltl.core.values.properties.solve_property import solve_property


@pytest.fixture(autouse=True, params=["single states", "arrays", "both"])
def search(request, monkeypatch):
    """Levels are expanded state by state, as arrays, or first in one way and then in the other."""
    level = {"single states": 10**9, "arrays": 0, "both": 3}[request.param]
    for name in ("LEVEL", "PER_COMMAND"):
        monkeypatch.setattr(explore, name, level)
    return request.param


def built(text, constants=None, **options):
    return build_model(read_program(text, constants), **options)


def rows(model):
    """By state: the sorted choices, each as successors with probabilities, in terms of variables."""
    names = list(model.valuation)
    state = [tuple(int(model.valuation[n][s]) for n in names) for s in range(model.num_states)]
    found = {s: [] for s in state}
    for r in range(model.num_rows):
        entries = range(model.entry_start[r], model.entry_start[r + 1])
        name = model.action_names[model.action[r]]
        successors = {
            state[model.successor[e]]: round(float(model.probability[e]), 9) for e in entries
        }
        found[state[model.host.state[r]]].append((name, successors))
    return {s: sorted(choices, key=str) for s, choices in found.items()}


def test_updates_read_old_values():
    model = built("""dtmc module m x : [0..3] init 1; y : [0..3] init 2;
    [] x=1 -> (x'=y) & (y'=x); [] x!=1 -> true; endmodule""")
    assert rows(model) == {(1, 2): [("", {(2, 1): 1.0})], (2, 1): [("", {(2, 1): 1.0})]}


def test_synchronisation_multiplies_choices_and_probabilities():
    model = built("""mdp
    module a x : [0..1]; [go] x=0 -> 0.25 : (x'=1) + 0.75 : true; [go] x=0 -> (x'=1); endmodule
    module b y : [0..1]; [go] y=0 -> 0.5 : (y'=1) + 0.5 : true; [] y=1 -> (y'=0); endmodule
    module c z : [0..1]; [go] z=0 & x=0 -> (z'=1); [] z=1 -> true; endmodule""")
    start = rows(model)[(0, 0, 0)]
    assert start == [
        ("go", {(1, 0, 1): 0.125, (1, 1, 1): 0.125, (0, 0, 1): 0.375, (0, 1, 1): 0.375})
        if len(choice) == 4
        else ("go", {(1, 0, 1): 0.5, (1, 1, 1): 0.5})
        for _, choice in start
    ]
    assert len(start) == 2
    assert rows(model)[(1, 1, 1)] == [("", {(1, 0, 1): 1.0}), ("", {(1, 1, 1): 1.0})]


def test_an_action_of_a_module_that_is_not_ready_blocks_the_others():
    with pytest.warns(UserWarning, match="1 of 1 states are deadlocks"):
        model = built("""mdp module a x : [0..1]; [go] x=0 -> (x'=1); endmodule
        module b y : [0..1]; [go] y=1 -> true; endmodule""")
    assert rows(model) == {(0, 0): [("", {(0, 0): 1.0})]}


def test_renamed_actions_synchronise_under_their_new_names():
    model = built("""mdp module a x : [0..1]; [go] x=0 -> (x'=1); [] x=1 -> true; endmodule
    module b = a [x=y, go=start] endmodule
    module c z : [0..1]; [start] z=0 -> (z'=1); endmodule""")
    assert rows(model)[(0, 0, 0)] == [("go", {(1, 0, 0): 1.0}), ("start", {(0, 1, 1): 1.0})]


def test_overlapping_commands_of_a_chain_are_equally_likely():
    text = """dtmc module m x : [0..3]; [a] x=0 -> 0.5 : (x'=1) + 0.5 : (x'=2); [] x<1 -> (x'=2);
    [b] x=0 -> (x'=3); [] x>0 -> true; endmodule
    rewards "r" [a] true : 3; [b] true : 6; x=0 : 1; endrewards"""
    with pytest.warns(UserWarning, match="several commands are enabled in 1 states"):
        model = built(text)
    assert model.is_chain
    third = round(1 / 3, 9)
    (choice,) = rows(model)[(0,)]
    assert choice[1] == {(1,): round(1 / 6, 9), (2,): 0.5, (3,): third}
    assert model.rewards["r"].choice[0] == pytest.approx(3)  # (3 + 0 + 6) / 3
    assert model.rewards["r"].state.tolist() == [1.0, 0.0, 0.0, 0.0]


def test_rewards_of_states_and_of_actions():
    model = built("""mdp module m x : [0..2]; [a] x<2 -> (x'=x+1); [] x=1 -> true; [b] x=2 -> true;
    [off] x>5 -> true; endmodule
    rewards "r" x>0 : 2*x; [off] true : 1; true : 1; [a] x=0 : 5; [] true : 7; [b] x=0 : 9; [c] true : 4;
    endrewards rewards true : 1; endrewards""")
    assert set(model.rewards) == {"r", ""}
    assert model.rewards["r"].state.tolist() == [1, 3, 5]
    of = {
        (int(s), model.action_names[a]): r
        for s, a, r in zip(model.host.state, model.action, model.rewards["r"].choice, strict=True)
    }
    assert of == {(0, "a"): 5, (1, "a"): 0, (1, ""): 7, (2, "b"): 0}
    assert model.rewards[""].choice is None


def test_several_initial_states():
    model = built("""dtmc module m x : [0..9]; b : bool; [] true -> true; endmodule
    init x>2 & (b => x=5) & x<7 & !(x=4) endinit""")
    assert model.num_states == 4
    assert sorted(
        zip(model.valuation["x"].tolist(), model.valuation["b"].tolist(), strict=True)
    ) == [
        (3, False),
        (5, False),
        (5, True),
        (6, False),
    ]
    assert model.initial.tolist() == [0.25] * 4


def test_an_initial_block_of_many_variables_is_not_enumerated_blindly():
    names = [f"x{i}" for i in range(40)]
    text = "mdp module m " + "".join(f"{n} : [0..9];" for n in names) + "[] true -> true; endmodule"
    model = built(
        text + " init " + " & ".join(f"{n}={i % 9}" for i, n in enumerate(names)) + " endinit"
    )
    assert model.num_states == 1
    assert model.valuation["x13"].tolist() == [4]
    with pytest.raises(ValueError, match="init block has more than"):
        built(text + " init true endinit")
    with pytest.raises(ValueError, match="no state satisfies"):
        built(text + " init x0>9 endinit")


def test_labels_and_deadlocks():
    text = """mdp module m x : [0..2]; [] x=0 -> (x'=1); [] x=0 -> (x'=2); [] x=1 -> true; endmodule
    label "one" = x=1; label "both" = "one" | x=0;"""
    with pytest.warns(UserWarning, match="1 of 3 states are deadlocks"):
        model = built(text)
    assert model.propositions == ("one", "both", "deadlock")
    order = np.argsort(model.valuation["x"])
    assert np.asarray(model.label)[order].tolist() == [
        [False, True, False],
        [True, True, False],
        [False, False, True],
    ]
    assert solve_property(model, 'Pmax=? [ F "deadlock" ]').value.tolist() == [1.0]
    assert solve_property(model, 'Pmin=? [ F "deadlock" ]').value.tolist() == [0.0]


def test_outcomes_of_probability_zero_lead_nowhere():
    model = built(
        "dtmc const double p; module m x : [0..1]; [] true -> p : (x'=5) + 1-p : true; endmodule",
        {"p": 0},
    )
    assert model.num_states == 1


def test_intervals():
    model = built("""dtmc module m x : [0..2];
    [] x=0 -> [0.2,0.4] : (x'=1) + [0.6,0.8] : (x'=2); [] x>0 -> true; endmodule""")
    assert isinstance(model, IntervalMDP)
    assert (model.lower.tolist(), model.upper.tolist()) == ([0.2, 0.6, 1, 1], [0.4, 0.8, 1, 1])
    found = solve_property(model, "Pmax=? [ F x=1 ]")
    assert found.value.tolist() == pytest.approx([0.4])


GAME = """smg player one m, [a] endplayer player two n, [b] endplayer
global turn : [0..2] init 0;
module m x : [0..1]; [a] turn=0 -> 0.5 : (x'=1) + 0.5 : true; endmodule
module n [a] true -> true; [] turn=1 -> (turn'=2); [b] turn=2 -> true; endmodule
module o [b] true -> true; [] turn=0 & x=1 -> (turn'=1); endmodule"""


def test_games_have_an_owner_for_each_state():
    """As in PRISM-games: a choice without a player is made by the state's player, or it is the only one."""
    smg = built(GAME)
    assert smg.owner.tolist() == [0, 0, 1, 1]  # turn, x: 0, 0; 0, 1; 1, 1; 2, 1
    alone = built(GAME.replace("player two n, [b]", "player two n"))
    assert alone.owner.tolist() == [0, 0, 1, 0]
    with pytest.raises(
        ValueError, match=r"command of module n in the state \(turn=1,x=1\) belongs to no player"
    ):
        built(
            GAME.replace("player two n, [b]", "player two [b]").replace(
                "[] turn=1 ->", "[] turn=1 -> true; [] turn=1 ->"
            )
        )
    with pytest.raises(ValueError, match=r"\(turn=0,x=1\) belong to several players"):
        built(GAME.replace("player two n", "player two n, o"))
    smg = built(
        GAME.replace("player two n", "player two n, o").replace("turn=0 -> ", "turn=0&x=0 -> ")
    )
    assert isinstance(smg, MultiplayerGame)
    assert smg.players == ("one", "two")
    game = smg.game(["one"])
    order = np.argsort(np.asarray(game.mdp.valuation["turn"]) * 2 + game.mdp.valuation["x"])
    assert np.asarray(game.system)[order].tolist() == [True, False, False, False]
    other = built(
        GAME.replace("player two n", "player two n, o").replace("turn=0 -> ", "turn=0&x=0 -> "),
        coalition=["two"],
    )
    assert (np.asarray(other.system) != np.asarray(game.system)).all()


@pytest.mark.parametrize(
    ("command", "says"),
    [
        (
            "[a] x>=1 -> (x'=x+1);",
            r"line 2, column 1: \[a\] .x >= 1. sets x to 4 in the state \(x=3,",
        ),
        ("[] x=1 -> 0.5 : true + 0.4 : (x'=2);", r"are 0.5 \+ 0.4 in the state \(x=1,.*sum to 1"),
        ("[] x=1 -> 1.5 : true + x-1.5 : (x'=2);", r"are 1.5 \+ -0.5 in the state"),
        ("[] x=1 -> 1/(x-1) : true;", r"are inf in the state"),
    ],
)
def test_invalid_updates_name_command_and_state(command, says):
    text = f"mdp module m x : [0..3]; y : bool; [] x<3 -> (x'=x+1);\n{command} endmodule"
    with pytest.raises(ValueError, match=says):
        built(text)


def test_the_number_of_states_is_bounded():
    text = "mdp module m x : [0..1000000]; [] x<1000000 -> (x'=x+1); [] true -> (x'=0); endmodule"
    with pytest.raises(ValueError, match="more than 500 states"):
        built(text, max_states=500)
    wide = "".join(
        f"module m{i} x{i} : [0..1]; {'[a] true -> true;' * 9} endmodule " for i in range(30)
    )
    with pytest.raises(ValueError, match="more than"):
        built("mdp " + wide)


def counter(bits):
    """A binary counter of some single-bit variables, more than one word of them if there are many."""
    digits = "".join(f"b{i} : bool;" for i in range(bits))
    steps = "".join(
        f"[] !b{i} {''.join(f'& b{j}' for j in range(i))} -> (b{i}'=true) "
        f"{''.join(f'& (b{j}{chr(39)}=false)' for j in range(i))};"
        for i in range(min(bits, 10))
    )
    return f"dtmc module m {digits} {steps} [] {' & '.join(f'b{j}' for j in range(10))} -> true; endmodule"


@pytest.mark.parametrize("bits", [10, 70, 130])
def test_states_of_several_words(bits):
    model = built(counter(bits))
    assert model.num_states == 1024
    code = sum(model.valuation[f"b{i}"].astype(int) << i for i in range(10))
    assert code.tolist() == list(range(1024))
    assert model.successor.tolist() == [*range(1, 1024), 1023]


def test_variables_of_one_value_and_negative_ranges():
    model = built("""mdp const int K = 4; module m one : [K..K]; x : [-3..2] init -1;
    [] x>-3 -> (x'=x-one+3); [] x=-3 -> (x'=2); endmodule""")
    assert sorted(model.valuation["x"].tolist()) == [-3, -2, -1, 0, 1, 2]
    assert set(model.valuation["one"].tolist()) == {4}


@pytest.mark.parametrize("trial", [1, 2**13])
def test_many_wide_levels_need_parts_and_a_larger_table(trial, monkeypatch):
    monkeypatch.setattr(local_choices, "_DENSE_BITS", 3)
    monkeypatch.setattr(local_choices, "_TRIAL", trial)  # 1: choices are soon evaluated directly
    monkeypatch.setattr(packed_states, "_FIRST", 16)
    monkeypatch.setattr(packed_states, "_PART", 7)
    model = built("""mdp module m x : [0..20]; [] x<20 -> (x'=x+1); [s] x=20 -> true; endmodule
    module n = m [x=y] endmodule module k = m [x=z] endmodule""")
    assert model.num_states == 21**3
    assert model.num_rows == 3 * 20 * 21**2 + 1


EXPRESSIONS = [
    "mod(x, 3) = 1 | mod(y - x, 2) = 0",
    "x / 4 > y / 5 & floor(x / 2) <= ceil(y / 2)",
    "(b ? x : y) >= min(3, x, y + 1)",
    "max(x) != round(y / 2) => b",
    "b <=> (x > y)",
    "pow(x, 2) - 2 * y < log(y + 1, 2) * 3",
    "!(x + 1 = y) & -x < -1",
    "pow(2, x / 2) > y",
]


@pytest.mark.parametrize("guard", EXPRESSIONS)
def test_guards_and_updates_are_those_of_folded_literals(guard):
    """Every combination of values is an initial state, and a self-loop where the guard holds."""
    update = "(x'=min(4, mod(x * 3 + y, 7))) & (b'=(x > 2) = b)"
    text = f"""mdp module m x : [0..4]; y : [0..5]; b : bool; go : bool;
    [yes] !go & {guard.join("()")} -> x/8 : {update} & (go'=true) + 1-x/8 : (go'=true);
    [no] !go & !({guard}) -> (go'=true); [] go -> true; endmodule init !go endinit"""
    model, tree = built(text), parse_expression(guard)
    for (x, y, b, go), choices in rows(model).items():
        if go:
            continue
        values = {"x": literal(x), "y": literal(y), "b": literal(bool(b))}
        holds = substitute(tree, values).value
        ((action, successors),) = choices
        assert action == ("yes" if holds else "no")
        if holds and x:
            target = min(4, (x * 3 + y) % 7), y, int((x > 2) == bool(b)), 1
            assert successors[target] == pytest.approx(x / 8 if target != (x, y, b, 1) else 1)


def test_progress_is_reported():
    calls = []
    built(
        "mdp module m x : [0..9]; [] x<9 -> (x'=x+1); [] x=9 -> true; endmodule",
        progress=lambda *x: calls.append(x),
    )
    assert calls[-1] == (10, 10)
