"""Games in the extended Hanoi format: who wins, against all letters and known specifications."""

import itertools
import re

import numpy as np
import pytest

from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.games.objective import reach
from jaxltl.core.games.verify import verify
from jaxltl.core.games.winning import winning_region
from jaxltl.core.models.game import make_game
from jaxltl.core.models.mdp import from_dense, make_mdp
from jaxltl.io.hoa import game as hoa_game
from jaxltl.io.hoa.game import read_hoa_game, write_hoa_game
from jaxltl.io.hoa.hoa import write_hoa
from jaxltl.io.pgsolver import read_pgsolver, write_pgsolver
from tests.io.test_pgsolver import random_vertices, text_of, winners

ARBITER = """HOA: v1
name: "arbiter"
States: 2
Start: 0
AP: 3 "r" "g" "s"
controllable-AP: 1
acc-name: parity max even 3
Acceptance: 3 Inf(2) | (Fin(1) & Inf(0))
properties: trans-labels explicit-labels trans-acc colored complete deterministic
--BODY--
State: 0
[!0] 0 {2}
[0 & 1] 0 {2}
[0 & !1] 1 {1}
State: 1
[1 & !2] 0 {2}
[!1 | 2] 1 {1}
--END--
"""


def realizable(text):
    found = read_hoa_game(text)
    won = winning_region(found.game, found.objective)
    assert verify(won)
    return bool(won.realizable)


def specification(formula, outputs):
    """A formula as a game, through its automaton of min-even parity."""
    automaton = to_automaton(formula)
    chosen = [i for i, name in enumerate(automaton.propositions) if name in outputs]
    given = f"controllable-AP: {' '.join(map(str, chosen))}\n--BODY--"
    return write_hoa(automaton).replace("--BODY--", given)


@pytest.mark.parametrize(
    ("formula", "outputs", "expected"),
    [
        ("G (r -> F g)", "g", True),
        ("G (r <-> g)", "g", True),  # the environment chooses first
        ("G (g <-> X r)", "g", False),  # so the system knows no future
        ("G (r -> X g)", "g", True),
        ("F r", "g", False),
        ("G F r -> G F g", "g", True),
        ("G F g & G (r -> !g)", "g", False),
        ("G F !r -> (G F g & G (r -> !g))", "g", True),
        ("F G g <-> G F r", "g", False),
        ("G F g <-> G F r", "g", True),
        ("G (p -> F a) & G (q -> F b) & G !(a & b)", "ab", True),
        ("G (p -> a) & G (q -> b) & G !(a & b)", "ab", False),
    ],
)
def test_known_specifications(formula, outputs, expected):
    assert realizable(specification(formula, outputs)) is expected


def test_it_reads_what_the_file_says():
    found = read_hoa_game(ARBITER)
    model = found.game.mdp
    assert (found.inputs, found.outputs) == (("r", "s"), ("g",))
    # In state 0 the inputs are !r and r, in state 1 they are !s and s; s then wins.
    assert set(model.action_names) == {"!r", "r", "!s", "s", "g", "!g", "true"}
    assert model.valuation["state"].tolist() == [0, 0, 0, 1, 1, 1]
    assert np.asarray(found.game.system).tolist() == [False, True, True] * 2
    assert np.asarray(model.initial).tolist() == [1, 0, 0, 0, 0, 0]
    assert realizable(ARBITER)  # it grants at once, so that s is never asked for
    assert not realizable(ARBITER.replace("Start: 0", "Start: 1"))


def test_missing_edges_lose():
    text = ARBITER.replace("[!0] 0 {2}\n", "")
    found = read_hoa_game(text)
    assert -1 in found.game.mdp.valuation["state"]
    assert not realizable(text)
    # The system itself can avoid the missing letters.
    assert realizable(ARBITER.replace("[0 & !1] 1 {1}\n", ""))


def guard(rng, names, depth=2):
    """A random condition, as the format writes it, with Python's operators for the test."""
    if depth == 0:
        return f"{rng.integers(names)}"
    a, b = guard(rng, names, depth - 1), guard(rng, names, depth - 1)
    return [f"({a} & {b})", f"({a} | {b})", f"!({a})"][rng.integers(3)]


def holds(text, letter):
    values = {"t": "-1", **{str(p): str(-int(value)) for p, value in letter.items()}}
    return eval(re.sub(r"\d+|t", lambda m: values[m[0]], text).replace("!", "~")) != 0


def random_game(rng, states=3, names=4):
    """A random complete deterministic automaton: of each state, edges with guards."""
    body = []
    for _ in range(states):
        left, edges = "t", []
        for _ in range(rng.integers(1, 4)):
            cut = guard(rng, names)
            edges.append((f"({left}) & ({cut})", rng.integers(states), rng.integers(5)))
            left = f"({left}) & !({cut})"
        body.append([*edges, (left, rng.integers(states), rng.integers(5))])
    return body


def text_of_game(body, names, controllable):
    lines = ["HOA: v1", f"States: {len(body)}", "Start: 0"]
    lines.append(" ".join([f"AP: {names}", *[f'"p{i}"' for i in range(names)]]))
    lines.append("controllable-AP: " + " ".join(map(str, controllable)))
    lines.append("Acceptance: 5 Inf(4) | (Fin(3) & (Inf(2) | (Fin(1) & Inf(0))))")
    lines.append("--BODY--")
    for q, edges in enumerate(body):
        lines += [f"State: {q}", *[f"[{label}] {t} {{{c}}}" for label, t, c in edges]]
    return "\n".join([*lines, "--END--"])


def parts(text):
    return [sorted(part.split("\n")) for part in text.split("State: ")]


def letter_by_letter(body, names, controllable):
    """The game as vertices of one letter each: (state, colour), then with the inputs."""
    free = [p for p in range(names) if p not in controllable]
    place, vertices = {(0, 0): 0}, []
    queue = [(0, 0)]

    def reach_(vertex):
        if vertex not in place:
            place[vertex] = len(place)
            queue.append(vertex)
        return place[vertex]

    while queue:
        vertex = queue.pop(0)
        q, color, *given = vertex
        if not given:
            moves = list(itertools.product([False, True], repeat=len(free)))
            vertices.append((color, 1, [reach_((q, color, move)) for move in moves]))
            continue
        to = []
        for move in itertools.product([False, True], repeat=len(controllable)):
            letter = dict(zip([*free, *controllable], [*given[0], *move], strict=True))
            (edge,) = [(t, c) for label, t, c in body[q] if holds(label, letter)]
            to.append(reach_((int(edge[0]), int(edge[1]))))
        vertices.append((0, 0, sorted(set(to))))
    return vertices


@pytest.mark.slow
def test_classes_of_letters_agree_with_single_letters(tmp_path):
    rng = np.random.default_rng(0)
    count = np.zeros(2, int)
    for _ in range(60):
        controllable = sorted(rng.choice(4, rng.integers(5), replace=False).tolist())
        body = random_game(rng)
        (tmp_path / "game.pg").write_text(text_of(letter_by_letter(body, 4, controllable)))
        expected = bool(winning_region(*read_pgsolver(tmp_path / "game.pg")).region[0])
        text = text_of_game(body, 4, controllable)
        assert realizable(text) == expected
        found = read_hoa_game(text)
        again = write_hoa_game(*found)
        assert realizable(again) == expected
        # Colours of one meaning become one; then nothing changes but the order of edges.
        once = write_hoa_game(*read_hoa_game(again))
        assert parts(write_hoa_game(*read_hoa_game(once))) == parts(once)
        count[int(expected)] += 1
    assert count.min() > 10, count


def test_a_game_of_turns_is_written_as_it_was_read():
    found = read_hoa_game(ARBITER)
    again = write_hoa_game(*found, name="arbiter")
    assert "States: 2" in again
    assert "[r" not in again
    other = read_hoa_game(again)
    assert other.game.mdp.action_names == found.game.mdp.action_names
    for name, value in found.game.mdp.valuation.items():
        assert other.game.mdp.valuation[name].tolist() == value.tolist()
    assert other.game.mdp.successor.tolist() == found.game.mdp.successor.tolist()
    assert (other.inputs, other.outputs) == (found.inputs, found.outputs)


def test_any_deterministic_game_is_written(tmp_path):
    rng = np.random.default_rng(1)
    count = np.zeros(2, int)
    for _ in range(40):
        vertices = random_vertices(rng, 6)
        (tmp_path / "a.pg").write_text("start 0;\n" + text_of(vertices).split("\n", 1)[1])
        game, objective = read_pgsolver(tmp_path / "a.pg")
        expected = bool(winners(vertices)[0])
        text = write_hoa_game(game, objective)
        assert realizable(text) == expected
        write_pgsolver(tmp_path / "b.pg", *read_hoa_game(text)[:2])
        found = winning_region(*read_pgsolver(tmp_path / "b.pg"))
        assert bool(found.realizable) == expected
        count[int(expected)] += 1
    assert count.min() > 5, count


def test_decided_states_are_written():
    rng = np.random.default_rng(2)
    for _ in range(20):
        table = np.zeros((5, 3, 5))
        for s, a in itertools.product(range(5), range(3)):
            table[s, a, rng.integers(5)] = 1
        game = make_game(from_dense(table, initial=np.eye(5)[0]), rng.random(5) < 0.5)
        objective = reach(game, rng.random(5) < 0.3, safe=rng.random(5) < 0.8)
        expected = bool(winning_region(game, objective).realizable)
        assert realizable(write_hoa_game(game, objective)) == expected


def test_many_propositions_are_no_matter():
    names = 60
    body = [[(f"{' & '.join(map(str, range(30)))} & 59", 0, 1),
             (f"!({' & '.join(map(str, range(30)))} & 59)", 0, 2)]]  # fmt: skip
    found = read_hoa_game(text_of_game(body, names, range(30, 60)))
    assert found.game.num_states == 4
    assert bool(winning_region(found.game, found.objective).realizable)


def test_conditions_too_long_to_write_have_names():
    aliases = ["Alias: @x0 0"] + [
        f"Alias: @x{i} (@x{i - 1} & !{i}) | (!@x{i - 1} & {i})" for i in range(1, 40)
    ]
    for controllable in (range(40), range(1, 40)):
        text = text_of_game([[("@x39", 0, 1), ("!@x39", 0, 2)]], 40, controllable)
        found = read_hoa_game(text.replace("Acceptance", "\n".join([*aliases, "Acceptance"])))
        assert any(name.startswith("condition ") for name in found.game.mdp.action_names)
        assert bool(winning_region(found.game, found.objective).realizable)
        assert realizable(write_hoa_game(*found[:2]))


def test_too_many_classes_are_refused(monkeypatch):
    monkeypatch.setattr(hoa_game, "_MAX_NODES", 2**14)
    both = " | ".join(f"{i} & {i + 20}" for i in range(20))
    text = text_of_game([[(both, 0, 1), (f"!({both})", 0, 2)]], 40, range(20, 40))
    with pytest.raises(ValueError, match="read_hoa_game: line 1: the guards have too many classes"):
        read_hoa_game(text)


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("controllable-AP: 1\n", "", 1, "controllable-AP: is missing"),
        ("controllable-AP: 1\n", "controllable-AP: 1\ncontrollable-AP: 1\n", 7, "given twice"),
        ("controllable-AP: 1", "controllable-AP: 3", 6, "names 3, expected numbers"),
        ("controllable-AP: 1", "controllable-AP: g", 6, "names g, expected numbers"),
        ("Inf(2) |", "Inf(2) & Inf(0) |", 1, "no parity condition"),
        ("[0 & 1] 0", "[1] 0", 13, "state 0 has two edges for the letter {g}"),
        ("[1 & !2] 0", "[7] 0", 16, "proposition 7 is out of range"),
        ("State: 1", "State: 3", 15, "state 3 is out of range"),
        ("[1 & !2] 0 {2}", "[1 & ] 0 {2}", 16, "found ']'"),
    ],
)
def test_malformed_files_are_refused(tmp_path, old, new, line, message):
    assert old in ARBITER
    path = tmp_path / "game.hoa"
    path.write_text(ARBITER.replace(old, new))
    for source, place in ((path, str(path)), (path.read_text(), "read_hoa_game")):
        with pytest.raises(ValueError, match=re.escape(message)) as error:
            read_hoa_game(source)
        assert str(error.value).startswith(f"{place}: line {line}: "), error.value


def test_other_faults_name_the_file(tmp_path):
    path = tmp_path / "game.hoa"
    path.write_text(ARBITER + ARBITER)
    with pytest.raises(ValueError, match=r"game\.hoa: the text holds 2 automata"):
        read_hoa_game(path)
    path.write_bytes(b"HOA: v1\n\xff")
    with pytest.raises(ValueError, match=r"game\.hoa, line 2: byte 0xff"):
        read_hoa_game(path)
    with pytest.raises(ValueError, match="nowhere"):
        read_hoa_game(str(tmp_path / "nowhere"))
    path.write_text(ARBITER.replace("[!0]", f"[{'!(' * 5000}0{')' * 5000}]"))
    with pytest.raises(ValueError, match=r"game\.hoa: line 1: .*nests"):
        read_hoa_game(path)


def test_games_that_cannot_be_written_are_refused():
    model = make_mdp([[[0, 1]], [[1, 0]]], [[[0.5, 0.5]], [[1, 0]]], initial=[1, 0])
    game = make_game(model, [True, True])
    goal = reach(game, np.array([False, True]))
    with pytest.raises(ValueError, match="write_hoa_game: state 0 has a move"):
        write_hoa_game(game, goal)
    game = make_game(make_mdp([[[0]], [[1]]], [[[1.0]], [[1.0]]]), [True, True])
    with pytest.raises(ValueError, match="2 initial states, expected one"):
        write_hoa_game(game, reach(game, np.array([False, True])))
