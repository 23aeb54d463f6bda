"""Grid worlds: every cell's moves by hand, slipping, legends, and bad maps."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.envs.gridworld import ACTIONS
from jaxltl.envs.text_map import parse_map

UP, DOWN, LEFT, RIGHT = range(4)


def test_moves_walls_and_absorbing_cells():
    world = jl.gridworld(
        """
        b . #
        . y g
    """,
        absorbing=["y"],
    )
    assert ACTIONS == ("up", "down", "left", "right")
    assert world.successor[:, :, 0].tolist() == [
        [0, 3, 0, 1],  # b
        [1, 4, 0, 1],  # right is a wall
        [2, 2, 2, 2],  # the wall, which nobody enters
        [0, 3, 3, 4],
        [4, 4, 4, 4],  # y absorbs
        [5, 5, 4, 5],
    ]
    assert world.propositions == ("b", "g", "y")
    assert world.label.tolist() == [
        [True, False, False],
        [False] * 3,
        [False] * 3,
        [False] * 3,
        [False, False, True],
        [False, True, False],
    ]
    np.testing.assert_allclose(world.initial, [0.2, 0.2, 0, 0.2, 0.2, 0.2])


def test_slipping_goes_to_both_sides():
    world = jl.gridworld("...\n...\n...", slip=0.2)
    dense = jl.models.to_dense(world).transition
    expected = {UP: (1, 3, 5), DOWN: (7, 3, 5), LEFT: (3, 1, 7), RIGHT: (5, 1, 7)}
    for action, (ahead, one, other) in expected.items():
        row = np.zeros(9)
        row[ahead], row[one], row[other] = 0.8, 0.1, 0.1
        np.testing.assert_allclose(dense[4, action], row, atol=1e-15)
    # In the corner, up and the slip to the left stay.
    np.testing.assert_allclose(dense[0, UP], [0.9, 0.1] + [0] * 7, atol=1e-15)


def test_certain_slipping():
    dense = jl.models.to_dense(jl.gridworld("...", slip=1.0)).transition
    np.testing.assert_allclose(dense[1], [[0.5, 0, 0.5]] * 2 + [[0, 1, 0]] * 2, atol=1e-15)


def test_a_legend_names_propositions():
    world = jl.gridworld("s#x", legend={"s": ["start", "safe"], "x": []}, initial="start & safe")
    assert world.propositions == ("safe", "start")
    assert world.label.tolist() == [[True, True], [False, False], [False, False]]
    assert world.initial.tolist() == [1, 0, 0]


def test_another_wall():
    world = jl.gridworld("aXb", wall="X")
    assert world.successor[0, RIGHT, 0] == 0
    assert world.propositions == ("a", "b")


@pytest.mark.parametrize(
    ("initial", "expected"),
    [
        ("b", [1, 0, 0, 0]),
        ("!b & !y", [0, 0.5, 0.5, 0]),
        ("true", [0.25] * 4),
        ([0, 0, 0, 1], [0, 0, 0, 1]),
    ],
)
def test_initial_cells(initial, expected):
    assert jl.gridworld("b..y", initial=initial).initial.tolist() == expected


def test_maps_of_words_and_of_characters():
    assert parse_map("ab\ncd").tolist() == [["a", "b"], ["c", "d"]]
    assert parse_map("\n  ab  c \n\n d   e\n").tolist() == [["ab", "c"], ["d", "e"]]


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        ("", {}, "the map is empty"),
        (" \n ", {}, "the map is empty"),
        ("ab\nabc", {}, "map row 2 has 3 cells, row 1 has 2: 'abc'"),
        ("a b\na", {}, "map row 2 has 1 cells, row 1 has 2"),
        ("ab", {"slip": 1.5}, "slip=1.5; it must be at least 0 and at most 1"),
        ("ab", {"slip": -0.1}, "slip=-0.1"),
        ("ab", {"slip": float("nan")}, "slip=nan"),
        ("ab\naz", {"legend": {"a": [], "b": []}}, r"cell 'z' \(row 2, column 2\) is not in"),
        ("ab", {"legend": {"a": "goal", "b": []}}, r"legend\['a'\] is a string; give a list"),
        ("ab", {"absorbing": ["z"]}, "absorbing: 'z' is not a proposition of the map; it has a, b"),
        ("..", {"absorbing": ["z"]}, r"absorbing: 'z' .* it has \(none\)"),
        ("ab", {"initial": "z"}, "mentions the proposition 'z'"),
        ("ab", {"initial": "a & b"}, "initial='a & b' holds in no cell"),
        ("##", {}, "all cells of the map are walls"),
        ("ab", {"initial": [0.5, 0.4]}, "the initial distribution sums to 0.9"),
    ],
)
def test_bad_maps_are_refused_at_their_place(text, arguments, message):
    with pytest.raises(ValueError, match=message):
        jl.gridworld(text, **arguments)


def test_a_task_on_a_map():
    world = jl.gridworld("b . r\n. . g", slip=0.0)
    lazy = jl.product(world, "!r U g")
    best = jl.check(jl.optimal_satisfaction(lazy))
    start = np.asarray(best.value)[np.arange(6), np.asarray(lazy.initial_memory)]
    assert start.tolist() == [1, 1, 0, 1, 1, 1]
