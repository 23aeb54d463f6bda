"""Maps that are read off moves, graphs of few states, and solutions on them."""

import numpy as np
import pytest
from matplotlib.patches import Rectangle

import jaxltl as jl
from jaxltl import plot
from jaxltl.envs.robots import places, robots
from jaxltl.envs.text_map import parse_map
from jaxltl.plot.models import board_of_robots, map_of

MAPS = ["b.#y", "a\nb\n.", "ab.\n.#c\n..d\n#..", "..\n..", ". goal_left\n. #"]


def solved(value, policy, **options):
    return jl.Solution(
        value, policy, value, value, np.float64(0), np.int32(1), np.int32(0), "", **options
    )


@pytest.mark.parametrize("slip", [0.0, 0.1, 0.6])
@pytest.mark.parametrize("text", MAPS)
def test_the_map_is_read_off_the_moves(text, slip):
    world = jl.gridworld(text, slip=slip)
    expected = parse_map(text)
    np.testing.assert_array_equal(map_of(world), expected)
    if slip < 0.5:  # else most of a move may go to the sides, where those are one cell
        np.testing.assert_array_equal(map_of(jl.models.to_dense(world)), expected)


def test_cells_that_are_never_left_are_no_walls_where_they_are_entered_or_labelled():
    world = jl.gridworld("a.b\n...", absorbing=["b"], initial="a")
    np.testing.assert_array_equal(map_of(world), parse_map("a.b\n..."))


def test_other_moves_lie_on_no_map():
    torus = np.stack([np.roll(np.arange(6), k) for k in (3, -3, 1, -1)], axis=1)[..., None]
    assert map_of(jl.make_mdp(torus, np.ones((6, 4, 1)))) is None
    around = np.arange(6)[:, None] + [0, 0, -1, 1]
    around = np.clip(around, 0, 5)
    around[:3, 1] += 3  # down; from the ends of rows one goes on to the next row
    assert map_of(jl.make_mdp(around[..., None], np.ones((6, 4, 1)))) is None
    stay = np.tile(np.arange(6)[:, None, None], (1, 4, 1))
    assert map_of(jl.make_mdp(stay, np.ones((6, 4, 1)))) is None
    rng = np.random.default_rng(0)
    for _ in range(20):
        any_moves = jl.make_mdp(rng.integers(12, size=(12, 4, 1)), np.ones((12, 4, 1)))
        assert map_of(any_moves) is None
    assert map_of(jl.to_sparse(jl.gridworld("..\n.."))) is None
    wide = jl.gridworld("." * 40 + ("\n" + "." * 40) * 39)
    assert map_of(wide) is None


@pytest.mark.parametrize("text", ["a.\n.b", ".#.\n...\n.#b", "...\n.a."])
def test_the_board_is_read_off_the_moves_of_the_robot(text):
    board = board_of_robots(jl.envs.grid_game(text, slip=0.1))
    np.testing.assert_array_equal(board.cells, parse_map(text))
    np.testing.assert_array_equal(board.places, places(text))


def test_the_board_of_robots_without_a_map():
    board = board_of_robots(robots(3))
    assert board.places[0].tolist() == [2, 0] and board.places[8].tolist() == [0, 2]
    assert board.cells[0, 0] == "upper_left" and board.cells[1, 1] == "."
    assert board_of_robots(jl.make_game(jl.gridworld("..\n.."), np.ones(4, bool))) is None


def test_a_solution_lies_on_the_map_of_its_model():
    world = jl.gridworld("a.\n#b")
    values = np.array([0.25, 0.5, 0.0, 1.0])
    figure = plot.solution(solved(values, np.array([3, 1, 0, 0])), world)
    shown = figure.axes[0].images[0].get_array()
    np.testing.assert_array_equal(shown.filled(-1), [[0.25, 0.5], [-1, 1.0]])
    product = jl.product(world, "F (a & F b)")
    table = np.linspace(0, 1, 4 * product.num_memory).reshape(4, -1)
    table[:, -1] = 1
    figure = plot.solution(solved(table, np.zeros(table.shape, np.int32)), product)
    titles = [axes.get_title(loc="left") for axes in figure.axes if axes.images]
    assert len(titles) == product.num_memory - 1 and titles[0] == "memory 0: F (a & F b)"
    one = plot.solution(solved(table, np.zeros(table.shape, np.int32)), product, memories=[1])
    np.testing.assert_allclose(
        one.axes[0].images[0].get_array().filled(-1).ravel()[[0, 1, 3]], table[[0, 1, 3], 1]
    )


def coin():
    return jl.make_sparse(
        [0, 2, 3, 4],
        [0, 2, 4, 5, 6],
        [0, 1, 0, 2, 1, 2],
        [0.5, 0.5, 0.9, 0.1, 1.0, 1.0],
        initial=[1, 0, 0],
        label={"done": [1, 2], "lost": [2]},
    )


def test_a_graph_has_its_choices_and_what_holds():
    figure = plot.model(coin())
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert {"0", "1", "2", "0: .5\n1: .9", "0: .5", "1: .1"} == {*texts}
    assert [text.get_text() for text in figure.texts] == ["1: done", "2: done, lost"]
    solution = solved(np.array([0.1, 0, 1]), np.array([1, 2, 3], np.int32))
    figure = plot.solution(solution, coin())
    assert figure.texts[0].get_text() == "0: 0.1"
    colors = {patch.get_edgecolor() for patch in figure.axes[0].patches}
    assert len(colors) > len({p.get_edgecolor() for p in plot.model(coin()).axes[0].patches})


def test_states_of_the_environment_are_square():
    game = jl.make_game(jl.to_padded(coin()), np.array([False, True, True]))
    boxes = [x for x in plot.model(game).axes[0].patches if type(x) is Rectangle]
    assert len(boxes) == 1


def test_values_alone_are_sorted_with_their_bounds():
    value = np.array([3.0, np.inf, 1.0, 2.0])
    strip = plot.solution(solved(value, np.zeros(4, np.int32)))
    line = strip.axes[0].patches[-1].get_data().values
    np.testing.assert_array_equal(line, [1, 2, 3, np.nan])


@pytest.mark.parametrize(
    "call, message",
    [
        (
            lambda: plot.model(jl.make_sparse(None, np.arange(18), np.zeros(17, int), np.ones(17))),
            "it has 17 states and its moves lie on no map; graphs have up to 16",
        ),
        (
            lambda: plot.solution(solved(np.zeros(5), np.zeros(5, int)), coin()),
            r"its value has shape \(5,\), the model's states \(3,\)",
        ),
        (
            lambda: plot.solution(
                solved(np.zeros((4, 2)), np.zeros((4, 2), int)),
                jl.product(jl.gridworld("..\n.a"), "F a"),
                memories=[2],
            ),
            r"memories=\[2\]; give some of 0 to 1",
        ),
    ],
)
def test_what_cannot_be_drawn_is_said(call, message):
    with pytest.raises(ValueError, match=message):
        call()
