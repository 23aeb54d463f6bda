"""Parity games in PGSolver's format: what is read, who wins it, what is written and refused."""

import itertools
import re

import numpy as np
import pytest

from jaxltl.core.games.objective import buchi, reach
from jaxltl.core.games.permissive import permissive_strategy
from jaxltl.core.games.verify import verify
from jaxltl.core.games.winning import winning_region
from jaxltl.core.models.game import make_game
from jaxltl.core.models.mdp import from_dense, make_mdp
from jaxltl.io.pgsolver import min_even, read_pgsolver, write_pgsolver

EXAMPLE = """parity 4;
start 2;
0 6 1 4,2 "Africa";
4 5 1 0 "Antarctica; it's cold";
1 8 1 2,4,3 "America";
3 6 0 4,2 "Australia";
2 7 0 3,1,0,4;
"""


def read(tmp_path, text, name="game.pg"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_pgsolver(path)


def winners(vertices):
    """Where player 0 wins, by all of its positional strategies.

    Args:
        vertices: priority, owner and successors of each.
    """
    own = [v for v, (_, owner, _) in enumerate(vertices) if owner == 0]
    won = np.zeros(len(vertices), bool)
    for chosen in itertools.product(*[vertices[v][2] for v in own]):
        step = np.zeros((len(vertices),) * 2, bool)
        for v, (_, _, successors) in enumerate(vertices):
            step[v, list(successors)] = True
        for v, w in zip(own, chosen, strict=True):
            step[v] = np.arange(len(vertices)) == w
        # A vertex of odd priority on a cycle through none larger is bad.
        bad = np.zeros(len(vertices), bool)
        for v, (priority, _, _) in enumerate(vertices):
            small = np.array([p <= priority for p, _, _ in vertices])
            bad[v] = priority % 2 == 1 and closure(step & small & small[:, None])[v, v]
        won |= ~((closure(step) | np.eye(len(vertices), dtype=bool)) & bad).any(1)
    return won


def closure(step):
    for k in range(len(step)):
        step = step | (step[:, k : k + 1] & step[k])
    return step


def random_vertices(rng, count):
    return [
        (
            int(rng.integers(7)),
            int(rng.integers(2)),
            [int(x) for x in rng.choice(count, rng.integers(1, 4), replace=False)],
        )
        for _ in range(count)
    ]


def text_of(vertices):
    return f"parity {len(vertices) - 1};\n" + "".join(
        f"{v} {p} {owner} {','.join(map(str, to))};\n" for v, (p, owner, to) in enumerate(vertices)
    )


def test_it_reads_what_the_file_says(tmp_path):
    game, objective = read(tmp_path, EXAMPLE)
    model = game.mdp
    assert model.valuation["vertex"].tolist() == [0, 4, 1, 3, 2]
    assert model.valuation["priority"].tolist() == [6, 5, 8, 6, 7]
    assert model.valuation["name"].tolist() == [
        "Africa", "Antarctica; it's cold", "America", "Australia", ""]  # fmt: skip
    assert np.asarray(game.system).tolist() == [False, False, False, True, True]
    assert np.asarray(model.initial).tolist() == [0, 0, 0, 0, 1]
    # In the order of the file.
    row = slice(*model.row_start[[2, 3]])
    assert model.successor[row].tolist() == [4, 1, 3]
    assert np.asarray(objective.priority).tolist() == [2, 3, 0, 2, 1]
    assert objective.num_priorities == 4


def test_the_example_is_solved(tmp_path):
    found = winning_region(*read(tmp_path, EXAMPLE))
    assert verify(found)
    by_vertex = sorted(
        zip([0, 4, 1, 3, 2], np.asarray(found.region).tolist(), strict=True), key=lambda x: x[0]
    )
    expected = winners(
        [(6, 1, [4, 2]), (8, 1, [2, 4, 3]), (7, 0, [3, 1, 0, 4]), (6, 0, [4, 2]), (5, 1, [0])]
    )
    assert [won for _, won in by_vertex] == expected.tolist()


def test_the_solver_agrees_with_all_strategies(tmp_path):
    rng = np.random.default_rng(1)
    some = np.zeros(2, int)
    for _ in range(60):
        vertices = random_vertices(rng, 5)
        found = winning_region(*read(tmp_path, text_of(vertices)))
        expected = winners(vertices)
        assert np.asarray(found.region).tolist() == expected.tolist(), vertices
        assert verify(found)
        some += [expected.sum(), (~expected).sum()]
    assert some.min() > 40


def test_what_was_read_is_written_back(tmp_path):
    game, objective = read(tmp_path, EXAMPLE)
    out = tmp_path / "out.pg"
    for given in (None, objective):
        write_pgsolver(out, game, given)
        assert out.read_text() == EXAMPLE
    write_pgsolver(tmp_path / "out.pg.gz", game)
    assert (tmp_path / "out.pg.gz").read_bytes()[:2] == b"\x1f\x8b"
    again, _ = read_pgsolver(tmp_path / "out.pg.gz")
    for name, value in game.mdp.valuation.items():
        assert again.mdp.valuation[name].tolist() == value.tolist()
    rng = np.random.default_rng(2)
    for _ in range(30):
        text = text_of(random_vertices(rng, 6))
        write_pgsolver(out, *read(tmp_path, text))
        assert out.read_text() == text


def test_any_deterministic_game_is_written(tmp_path):
    rng = np.random.default_rng(3)
    for i in range(30):
        table = np.zeros((5, 2, 5))
        for s, a in itertools.product(range(5), range(2)):
            table[s, a, rng.integers(5)] = 1
        game = make_game(from_dense(table), rng.random(5) < 0.5)
        states = rng.random(5) < 0.4
        objective = [buchi(game, states), reach(game, states, safe=rng.random(5) < 0.8)][i % 2]
        write_pgsolver(tmp_path / "game.pg", game, objective)
        found = winning_region(*read_pgsolver(tmp_path / "game.pg"))
        expected = winning_region(game, objective)
        assert np.asarray(found.region).tolist() == np.asarray(expected.region).tolist()


def test_the_other_solvers_take_a_sparse_game(tmp_path):
    game, objective = read(tmp_path, "0 2 0 0,1; 1 1 1 1;")
    shield = permissive_strategy(game, objective)
    assert np.asarray(shield.allowed)[0].ravel().tolist() == [True, False]


def test_a_wide_game_is_decided_without_padding(tmp_path):
    """One state with as many moves as there are states; a table of all would have 40 GB."""
    count = 60_000
    rows = [f"0 0 0 {','.join(map(str, range(count)))};"]
    rows += [f"{v} 0 0 {v};" for v in range(1, count)]
    game, objective = read(tmp_path, "\n".join(rows))
    assert game.mdp.num_rows == 2 * count - 1
    assert np.asarray(winning_region(game, objective).region).all()


def test_chance_and_missing_objectives_are_refused(tmp_path):
    model = make_mdp([[[0, 1]], [[1, 0]]], [[[0.5, 0.5]], [[1, 0]]])
    game = make_game(model, [True, True])
    with pytest.raises(ValueError, match="state 0 has a move that leads to several states"):
        write_pgsolver(tmp_path / "x", game, buchi(game, np.array([True, False])))
    plain = make_game(make_mdp([[[0]]], [[[1.0]]]), [True])
    with pytest.raises(ValueError, match="the game has no stored objective"):
        write_pgsolver(tmp_path / "x", plain)


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("", 1, "no vertex"),
        ("parity 3;\n", 2, "no vertex"),
        ("0 1 0 0;\n1 1 2 0;", 2, "found '2 0;'; expected its owner, 0 or 1"),
        ("0 1 0 0;\n1 -1 1 0;", 2, "its priority, a number of at least 0"),
        ("0 1 0 0;\n\n1 1 1 ;", 3, "its successors"),
        ("0 1 0 0;\n1 1 1 0,;", 2, "its successors"),
        ("0 1 0 0;\n1 1 1 0", 2, 'found the end of the file; expected a name in double quotes, or '
         '";"'),
        ('0 1 0 0 "a;\n', 1, "name in double quotes"),
        ("parity x;\n0 1 0 0;", 1, "'parity MAX;'"),
        ("0 1 0 0;\nstart 0;", 2, "number of a vertex"),
        ("start 4;\n0 1 0 0;", 1, "the start, vertex 4, is not defined"),
        ("0 1 0 0;\n1 1 0 0;\n0 1 0 0;", 3, "vertex 0 is defined a second time, first in line 1"),
        ("0 1 0 0;\n1 1 0 0,7;", 2, "vertex 1 leads to vertex 7, which is not defined"),
        ("0 99999999999 0 0;", 1, "priority 99999999999 is beyond"),
        ("99999999999 0 0 0;", 1, "vertex 99999999999 is beyond"),
        ("0 0 0 " + "9" * 5000 + ";", 1, "a successor: 999999999999999999999999999999 is beyond"),
        ("0 " + "9" * 5000 + " 0 0;", 1, "priority 999999999999999999999999999999 is beyond"),
        (b"0 0 0 0;\n\xff", 2, "byte 0xff is not UTF-8"),
    ],
)  # fmt: skip
def test_malformed_files_are_refused(tmp_path, text, line, message):
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        read(tmp_path, text)
    assert f"game.pg, line {line}: " in str(error.value)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(ValueError, match="nowhere"):
        read_pgsolver(tmp_path / "nowhere.pg")


def test_comments_and_free_layout(tmp_path):
    game, _ = read(tmp_path, "// a\nparity 1 ; // b\n0 0 0 0 , 1\n; // c\n 1 1 1 1;// end")
    assert game.mdp.successor.tolist() == [0, 1, 1]


def test_min_even_keeps_who_wins():
    rng = np.random.default_rng(4)
    for _ in range(200):
        priority = rng.integers(9, size=6)
        cycle = rng.random(6) < 0.5
        found = min_even(priority)
        if cycle.any():
            largest = priority[cycle].max()
            assert found[cycle].min() % 2 == largest % 2
        assert len(np.unique(found)) == found.max() + 1 - found.min()
        assert found.min() <= 1
