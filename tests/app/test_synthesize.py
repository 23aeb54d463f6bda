"""Synthesis by the command line: answers, evidence, files, and mistakes as one plain line."""

import itertools
import json

import numpy as np
import pytest

from jaxltl import plot
from jaxltl.app.files.game import GameFile, load_game, solve_game
from jaxltl.app.reports import synthesize as report
from jaxltl.app.reports.synthesize import play_explorer
from jaxltl.core.games import synthesis
from jaxltl.io.policies import load_policy
from tests.support import replaced
from tests.test_cli import failure, run

MAX_PROGRAMS = 350  # that the default tests compile at most

SQUARE = """
[game]
map = '''
a.
.b
'''

[task]
formula = "G !collision"
"""
CORRIDOR = """
[game]
map = "..."

[task]
safe = "!collision"
"""
# The system decides in state 0, the environment in 1 and 2; only 2 can be avoided for ever.
ARRAYS = {
    "successor": [[[1], [2]], [[0], [0]], [[2], [2]]],
    "probability": [[[1.0], [1.0]], [[1.0], [0.0]], [[1.0], [0.0]]],
    "system": [True, False, False],
    "initial": [1.0, 0, 0],
    "label": [[False], [False], [True]],
    "propositions": ["bad"],
    "actions": ["left", "right"],
}


@pytest.fixture
def write(tmp_path):
    """Writes a game file after replacing parts of it."""

    def write(*replacements, text=SQUARE):
        (tmp_path / "game.toml").write_text(replaced(text, *replacements))
        return tmp_path / "game.toml"

    return write


@pytest.fixture
def arrays(tmp_path):
    """Writes a game from arrays, some of them changed."""

    def write(formula="G !bad", **changed):
        kept = {k: v for k, v in (ARRAYS | changed).items() if v is not None}
        np.savez(tmp_path / "game.npz", **kept)
        path = tmp_path / "game.toml"
        path.write_text(f'[game]\nmodel = "game.npz"\n[task]\nformula = "{formula}"\n')
        return path

    return write


def finished(folder, text, *options):
    """Runs the command: what it printed, its JSON line, and where its files lie."""
    folder.mkdir(exist_ok=True)
    (folder / "game.toml").write_text(text)
    result = run("synthesize", folder / "game.toml", "--out", folder / "out", "--json", *options)
    assert result.exit_code == 0, result.output
    return result.stdout, json.loads(result.stdout.splitlines()[-1]), folder / "out"


@pytest.fixture(scope="module")
def won(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("won"), SQUARE)


@pytest.fixture(scope="module")
def lost(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("lost"), CORRIDOR)


# --- a game that the system wins ------------------------------------------------------------


def test_a_maximal_strategy_and_its_evidence(won):
    printed, result, _ = won
    assert "realizable: the system wins surely from 12 of 12 initial states" in printed
    assert "permissive strategy, maximal: every run that stays in the winning region" in printed
    assert "independent check: confirmed, both players' strategies and the permissive" in printed
    assert result["outcome"] == "realizable" and result["play"] is None
    strategy = result["strategy"]
    assert strategy["maximal"] and strategy["confirmed"] and strategy["num_memory"] == 1
    # 12 pairs of different cells, and the 4 diagonal ones where the environment moves.
    assert strategy["num_system_states"] == 12 and strategy["num_states"] == 16
    assert result["region"]["states"] == 16


def test_the_files_of_a_strategy(won):
    _, result, out = won
    assert {path.name for path in out.iterdir()} == {
        "game.toml",
        "certificate.umb",
        "strategy.npz",
        "result.json",
        "report.html",
        "automaton.svg",
        "region.svg",
        "moves.svg",
    }
    assert json.loads((out / "result.json").read_text()) == result
    with np.load(out / "strategy.npz") as file:
        found = dict(file)
    assert found["region"].shape == (32,) and found["region"].sum() == 16
    assert found["mask"].shape == (16, 5) and found["mask"].any(1).all()
    assert found["memory"].tolist() == found["automaton_state"].tolist() == [0] * 16


def test_the_written_strategy_plays_alone(won):
    """Random allowed moves against a random environment, by the rules of the world alone."""
    _, _, out = won
    with np.load(out / "strategy.npz") as file:
        game = dict(file)
    rng = np.random.default_rng(0)
    places = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
    moves = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1), "stay": (0, 0)}
    node, met = int(np.argmax(game["initial"])), set()
    for _ in range(300):
        environment, system, turn = np.unravel_index(game["world_state"][node], (4, 4, 2))
        assert environment != system and bool(turn) == game["system"][node]
        action = int(rng.choice(np.flatnonzero(game["mask"][node])))
        mover = system if turn else environment
        target = places[mover] + moves[str(game["actions"][action])]
        number = int(np.flatnonzero((places == target).all(1))[0])
        pair = (environment, number) if turn else (number, system)
        expected = int(np.ravel_multi_index((*pair, 1 - turn), (4, 4, 2)))
        nexts = game["successor"][node, action][game["probability"][node, action] > 0]
        node = int(nexts[game["world_state"][nexts] == expected][0])
        met.add(node)
    # All that is met later: 4 diagonal pairs where the environment moves, 8 others where not.
    assert len(met) == 12


def test_the_written_strategies_are_policies(won, lost):
    """Both players' files, loaded and played in the world alone."""
    rng = np.random.default_rng(2)
    for (_, _, out), name, mover in ((won, "strategy", 1), (lost, "counter_strategy", 0)):
        world = load_game(GameFile.read(out / "game.toml")).game
        collides = np.asarray(world.label)[:, world.propositions.index("collision")]
        robot = load_policy(out / f"{name}.npz").controller()
        assert robot.policy.num_states == world.num_states and robot.policy.actions[0] == "up"
        state = int(np.argmax(np.asarray(world.initial)))
        robot.start(state)
        for _ in range(200):
            moves = np.flatnonzero(np.asarray(world.available)[state])
            own = bool(np.asarray(world.system)[state]) == bool(mover)
            action = robot.act() if own else int(rng.choice(moves))
            assert action in moves
            state = int(world.mdp.successor[state, action, 0])
            robot.update(state)
            if collides[state]:
                break
        assert collides[state] == (name != "strategy")
    assert robot.policy.automaton is None and robot.policy.next_memory.shape[1] == 1
    with np.load(won[2] / "strategy.npz") as file:
        assert str(file["kind"]) == "table" and "automaton" in file


def test_the_environments_place_in_the_picture(won, tmp_path):
    _, _, out = won
    _, _, other = finished(tmp_path, SQUARE, "--environment", 2, 2)
    assert (other / "moves.svg").read_bytes() != (out / "moves.svg").read_bytes()
    message = failure("synthesize", tmp_path / "game.toml", "--environment", 3, 1)
    assert "--environment 3 1 is a wall or off the map, which has rows 1 to 2" in message


# --- a game that the environment wins -------------------------------------------------------


def test_an_unrealizable_task_is_an_answer(lost):
    printed, result, out = lost
    assert "unrealizable: the system wins surely from 0 of 6 initial states" in printed
    assert "for example: system in row 1, column 2, environment in row 1, column 1" in printed
    assert result["strategy"] is None and result["region"]["initial_states"] == 0
    assert len(result["region"]["lost_initial_states"]) == 6
    assert {path.name for path in out.iterdir()} == {
        "game.toml",
        "certificate.umb",
        "counter_strategy.npz",
        "result.json",
        "report.html",
        "region.svg",
    }
    claims = result["certificates"][0]["claims"]
    assert [" is >= 0 in" in claims[0], " is <= 0 in" in claims[1]] == [True, True]


def test_the_play_obeys_the_rules_and_ends_in_failure(lost):
    printed, result, _ = lost
    steps = result["play"]["steps"]
    assert result["play"]["failed"] and f"violated in step {len(steps) - 1}" in printed
    moves = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1), "stay": (0, 0)}
    for before, after in itertools.pairwise(steps):
        other = "system" if after["mover"] == "environment" else "environment"
        assert after[other] == before[other]
        old, new = before[after["mover"]], after[after["mover"]]
        assert (new["row"] - old["row"], new["column"] - old["column"]) == moves[after["move"]]
    assert [s["system"] == s["environment"] for s in steps] == [False] * (len(steps) - 1) + [True]


def test_the_counter_strategy_beats_every_system(lost):
    _, _, out = lost
    with np.load(out / "counter_strategy.npz") as file:
        game = dict(file)
    rng = np.random.default_rng(1)
    for node in np.flatnonzero(game["initial"]):
        for _ in range(20):
            environment, system, _ = np.unravel_index(game["world_state"][node], (3, 3, 2))
            if environment == system:
                break
            if game["system"][node]:
                action = rng.choice(np.flatnonzero(game["available"][node]))
            else:
                action = game["counter_action"][node]
            node = int(game["successor"][node, action, 0])
        assert environment == system


def test_a_repeating_play_names_the_guarantee_that_is_missed(tmp_path):
    text = SQUARE.replace(
        'formula = "G !collision"', 'guarantees = ["system_a", "system_b"]\nsafe = "!collision"'
    )
    printed, result, out = finished(tmp_path, text)
    assert result["task"] == "G (!collision) & G F (system_a) & G F (system_b)"
    assert "repeat for ever, and never satisfy system_a" in printed
    play = result["play"]
    first, last = play["steps"][play["repeats_from"]], play["steps"][-1]
    assert [first[k] for k in ("system", "environment")] == [
        last[k] for k in ("system", "environment")
    ]
    with np.load(out / "counter_strategy.npz") as file:
        assert file["counter_action"].shape[1:] == (1,) and file["assumptions"].shape[0] == 1


def test_some_initial_states_are_won_and_others_lost(arrays, tmp_path):
    path = arrays(initial=[0.5, 0, 0.5])
    result = run("synthesize", path, "--out", tmp_path / "out", "--json")
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout.splitlines()[-1])
    assert found["outcome"] == "partly realizable"
    assert "the environment wins from 1, for example: state 2" in result.stdout
    assert found["play"] == {
        "steps": [{"mover": "start", "move": "", "state": 2}],
        "repeats_from": None,
        "failed": True,
        "by_chance": False,
    }
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "game.toml",
        "certificate.umb",
        "strategy.npz",
        "counter_strategy.npz",
        "result.json",
        "report.html",
        "automaton.svg",
    }
    with np.load(tmp_path / "out" / "strategy.npz") as file:
        assert file["world_state"].tolist() == [0, 1]
        assert file["mask"].tolist() == [[True, False], [True, False]]
    assert "the game has no map" in failure(
        "synthesize", path, "--out", tmp_path / "out", "--environment", 1, 1
    )


def test_chance_may_be_an_adversary(arrays, tmp_path):
    # The system's only move reaches the goal at last, unless chance is malign.
    path = arrays(
        "F bad",
        successor=[[[0, 2]], [[0, 0]], [[2, 0]]],
        probability=[[[0.5, 0.5]], [[1.0, 0.0]], [[1.0, 0.0]]],
        actions=["try"],
    )
    found = solve_game(GameFile.read(path))
    result = report.summary(found, 0.0)
    assert result["outcome"] == "realizable" and result["strategy"]["confirmed"]
    assert "wins almost surely from 1 of 1" in report.report_of(found).table(result)
    path.write_text(path.read_text() + 'chance = "adversarial"\n')
    found = solve_game(GameFile.read(path))
    result = report.summary(found, 0.0)
    assert result["outcome"] == "unrealizable" and report.is_confirmed(result)
    printed = report.report_of(found).table(result)
    assert "wins surely from 0 of 1" in printed and "2     chance" in printed
    assert "steps 0 to 2 repeat for ever, and violate the objective" in printed


def test_a_refuted_result_is_never_passed_off(arrays, tmp_path, monkeypatch):
    right = synthesis.winning_region

    def wrong(*arguments):
        found = right(*arguments)
        return found.replace(region=found.region | True)

    monkeypatch.setattr(synthesis, "winning_region", wrong)
    result = run("synthesize", arrays(), "--out", tmp_path / "out")
    assert result.exit_code == 2 and "independent check: REFUTED: state" in result.stdout
    assert "the independent check refutes the result" in result.stderr


# --- the page -------------------------------------------------------------------------------


def test_the_page_says_and_plays_what_was_found(won, lost):
    text = (won[2] / "report.html").read_text()
    assert "http" not in text and "<b>Warning:</b>" not in text
    assert "The task is realizable." in text and "independent check: confirmed" in text
    assert 'class="token piece-1"' in text and "Game file" in text
    assert text.count("data:image") == 2  # region and moves; the automaton is live
    text = (lost[2] / "report.html").read_text()
    assert "A play that the environment wins" in text and text.count("data:image") == 1


def test_a_play_of_the_strategy_is_one(tmp_path):
    (tmp_path / "game.toml").write_text(SQUARE)
    found = solve_game(GameFile.read(tmp_path / "game.toml"))
    part = play_explorer(found)
    (run,), game = part.runs, found.world.game
    successor = np.asarray(game.mdp.successor)
    collides = np.asarray(game.label)[:, game.propositions.index("collision")]
    count = len(found.world.actions)
    for (here, _, action), (there, _, _) in itertools.pairwise(run.steps):
        assert not collides[here] and there in successor[here, action % count]
        assert part.actions[action].endswith(
            "(system)" if bool(np.asarray(game.system)[here]) else "(environment)"
        )
        assert found.world.describe(here) == part.places[here] and len(part.cells[here]) == 2


# --- the examples ---------------------------------------------------------------------------


def test_the_examples_are_sound():
    robots = solve_game(GameFile.read("examples/robots.toml"))
    result = report.summary(robots, 0.0)
    # The dissertation's table 5 for N = 4.
    strategy = result["strategy"]
    assert strategy["maximal"] and strategy["confirmed"] and result["outcome"] == "realizable"
    assert (strategy["num_states"], strategy["num_system_moves"]) == (432, 760)
    patrol = load_game(GameFile.read("examples/patrol.toml"))
    assert patrol.game.num_states == 512
    assert {"system_b", "environment_a"} <= set(patrol.game.propositions)


def test_a_picture_for_each_memory_of_a_strategy(tmp_path):
    text = SQUARE.replace(
        'formula = "G !collision"',
        'guarantees = ["system_a", "system_b"]\n'
        'assumptions = ["environment_a & !system_b", "environment_b"]',
    )
    (tmp_path / "game.toml").write_text(text)
    found = solve_game(GameFile.read(tmp_path / "game.toml"))
    assert found.strategy is not None and not found.strategy.maximal
    goals, text = ("system_a", "system_b"), found.world.text
    moves = plot.strategy_moves(found, text, actions=found.world.actions, goals=goals)
    titles = [axes.get_title(loc="left") for axes in moves.axes]
    assert titles == ["towards system_a", "towards system_b"]
    names = [picture.name for picture in report.pictures(found)]
    assert names == ["region.svg", "moves.svg"]


def test_large_maps_show_some_places(monkeypatch, tmp_path):
    (tmp_path / "game.toml").write_text(CORRIDOR)
    monkeypatch.setattr(report, "MAX_MAPS", 2)
    shown = []
    real = plot.game_region
    monkeypatch.setattr(
        plot, "game_region", lambda *a, **k: shown.append(k["environment"]) or real(*a, **k)
    )
    report.pictures(solve_game(GameFile.read(tmp_path / "game.toml")))
    assert shown == [[0, 1, 2]]


# --- mistakes -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("replacement", "message"),
    [
        (("[task]", "[task"), r"this is not TOML: "),
        (("[task]", "[tasc]"), r"game.toml: has no key 'tasc'; did you mean 'task'?"),
        (("map =", "mapp ="), r"[game] has no key 'mapp'; did you mean 'map'?"),
        (("formula", "formul"), r"[task] has no key 'formul'; did you mean 'formula'?"),
        (("[task]", "[strategy]\nbond = 3\n[task]"), r"has no key 'bond'; did you mean 'bound'?"),
        (("[task]", "[strategy]\nbound = 0\n[task]"), r"bound = 0; it must be a whole number"),
        (
            ("[task]", '[strategy]\nmethod = "all"\n[task]'),
            r"it must be "
            '"auto" or "stay" or "rank" or "counter" or "parity"',
        ),
        (("[task]", "slip = 2\n[task]"), r"slip = 2; it must be a finite number in [0, 1]"),
        (("[task]", "system_stays = 1\n[task]"), r"system_stays = 1; it must be true or false"),
        (("[task]", 'model = "m.npz"\n[task]'), r"[game] must have either a map or a model"),
        (("[task]", 'initial = "a"\n[task]'), r"[game] initial belongs to a model"),
        (
            ("[task]", "system_start = [3, 1]\n[task]"),
            r"[game] system_start = [3, 1] is off the map, which has rows 1 to 2 and columns 1 to 2",
        ),
        (("[task]", "system_start = [1]\n[task]"), r"or a cell as [row, column], from 1"),
        (("a.\n.b", "a#\n#b"), r"[game] the environment has no move from the cell"),
        (("a.\n.b", "ab\nb"), r"[game] map row 2 has 1 cells, row 1 has 2"),
        (('formula = "G !collision"', ""), r"[task] lacks what the system is to achieve"),
        (('formula = "G !collision"', 'assumptions = ["system_a"]'), r"lacks what the system"),
        (
            ('formula = "G !collision"', 'safe = "true"\nassumptions = ["system_a"]'),
            r"[task] has assumptions but no guarantees",
        ),
        (('formula = "G !collision"', 'guarantees = "system_a"'), r"it must be a list of Boolean"),
        (("formula", 'safe = "true"\nformula'), r"[task] has both formula and safe"),
        (
            ("!collision", "!colision"),
            r"[task] the formula mentions the proposition 'colision', which",
        ),
        (("!collision", "!colision"), r"Did you mean 'collision'?"),
        (("G !collision", "G (!collision"), r"[task] "),
        (
            ('formula = "G !collision"', 'guarantees = ["system_a", "F system_b"]'),
            r"[task] guarantees[1]: 'F system_b' is not Boolean",
        ),
        (
            ('formula = "G !collision"', 'guarantees = ["system_a"]\nassumptions = ["system_c"]'),
            r"[task] assumptions[0]: 'system_c' mentions the proposition 'system_c'",
        ),
    ],
)
def test_mistakes_in_the_file(write, tmp_path, replacement, message):
    assert message in failure("synthesize", write(replacement), "--out", tmp_path / "out")


def test_a_start_in_a_wall(write, tmp_path):
    path = write(("a.\n.b", "a.\n.b\n.#"), ("[task]", "environment_start = [3, 2]\n[task]"))
    message = failure("synthesize", path, "--out", tmp_path / "out")
    assert "[game] environment_start = [3, 2] is a wall of the map" in message


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"system": [True, False]}, "State 2 has no owner."),
        ({"system": [1.0, 0.0, np.nan]}, "state 2 has no owner: system is nan there"),
        ({"system": np.array([True, False, None])}, "array 'system' holds Python objects"),
        ({"system": None}, "lacks the array system: for each state True where the system moves"),
        (
            {"probability": [[[1.0], [1.0]], [[1.0], [0.0]], [[0.0], [0.0]]]},
            "state 2 has no available action; give it one",
        ),
        ({"available": np.zeros((3, 2), bool)}, "state 0 has no available action; give it one"),
        (
            {"probability": [[[0.7], [1.0]], [[1.0], [0.0]], [[1.0], [0.0]]]},
            "state 0, action 0: the probabilities sum to 0.7",
        ),
        ({"owner": [1, 0, 0]}, "holds an array 'owner'; it may hold "),
        ({"label": [[0], [0]]}, "label has shape"),
    ],
)
def test_mistakes_in_arrays(arrays, tmp_path, changed, message):
    found = failure("synthesize", arrays(**changed), "--out", tmp_path / "out")
    assert "game.npz'" in found and message in found


def test_files_that_are_missing_or_malformed(arrays, tmp_path):
    assert "the game file cannot be read" in failure("synthesize", tmp_path / "none.toml")
    path, out = arrays(), tmp_path / "out"
    (tmp_path / "game.npz").write_bytes(b"nonsense")
    assert "is not an .npz of plain arrays" in failure("synthesize", path, "--out", out)
    with open(tmp_path / "game.npz", "wb") as file:
        np.save(file, np.zeros(3))
    assert "it holds a single array" in failure("synthesize", path, "--out", out)
    (tmp_path / "game.npz").unlink()
    assert "game.npz': No such file" in failure("synthesize", path, "--out", out)
    assert "cannot write into" in failure("synthesize", path, "--out", path / "below")


def test_a_strategy_that_is_demanded_and_does_not_exist(tmp_path):
    (tmp_path / "game.toml").write_text(CORRIDOR + "[strategy]\n")
    result = run("synthesize", tmp_path / "game.toml", "--out", tmp_path / "out")
    assert result.exit_code == 2 and "a play that the environment wins" in result.stdout
    assert (
        "game.toml: [strategy] demands a strategy, but the task is unrealizable: the "
        "environment wins from every initial state, for example: system in row 1, column 2"
    ) in result.stderr
    assert (tmp_path / "out" / "counter_strategy.npz").exists()


def test_methods_that_do_not_fit(arrays, tmp_path):
    out = tmp_path / "out"

    def message(formula, strategy, **changed):
        path = arrays(formula, **changed)
        path.write_text(path.read_text() + f"[strategy]\n{strategy}\n")
        return failure("synthesize", path, "--out", out)

    assert '[strategy] method="counter" is for Buchi' in message("G !bad", 'method = "counter"')
    back = {"successor": [[[1], [2]], [[0], [0]], [[0], [0]]]}
    assert '[strategy] method="stay": some run' in message("G F bad", 'method = "stay"', **back)
    assert '[strategy] method="counter" needs bound=m' in message(
        "G F bad", 'method = "counter"', **back
    )
    far = {
        "successor": [[[1], [1]], [[2], [2]], [[3], [3]], [[0], [0]]],
        "probability": np.ones((4, 2, 1)),
        "system": [True] * 4,
        "initial": [1, 0, 0, 0],
        "label": [[0], [0], [0], [1]],
    }
    assert "[strategy] bound=2 is too small: the system wins, but not surely within it" in message(
        "G F bad", 'method = "counter"\nbound = 2', **far
    )


def test_the_expected_moves_until_acceptance_are_certified(arrays):
    """One move to the label, and one that reads it."""
    found = solve_game(GameFile.read(arrays("F bad")))
    result = report.summary(found, 1.0)
    for upper in result["expected_moves"].values():
        assert 2 <= upper <= 2 + 1e-5
    text = report.report_of(found).table(result)
    assert "until acceptance at most 2 if drawn uniformly, 2 for any choice, certified" in text


def test_expected_moves_are_those_of_the_worst_choice(arrays):
    """Both moves lead to the label, one of them only with probability 1/4."""
    probability = [[[0.25, 0.75], [1.0, 0]], [[1.0, 0], [0, 0]], [[1.0, 0], [0, 0]]]
    successor = [[[2, 0], [2, 0]], [[0, 0], [0, 0]], [[2, 0], [0, 0]]]
    found = solve_game(GameFile.read(arrays("F bad", probability=probability, successor=successor)))
    assert found.moves == pytest.approx((1 / 0.625 + 1, 5), rel=1e-5)


def test_safety_has_no_expected_moves(arrays):
    found = solve_game(GameFile.read(arrays("G !bad")))
    assert report.summary(found, 1.0)["expected_moves"] is None
