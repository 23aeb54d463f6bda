"""Two robots in turns: published sizes, every move against a plain reading, and bad maps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models.construct.restrict import restrict
from jaxltl.core.models.game import is_deterministic
from jaxltl.core.models.ops import operators
from jaxltl.envs.robots import (
    ACTIONS,
    CORNERS,
    arrival_reward,
    diagonal_reward,
    grid_game,
    places,
    reward_against_task,
    robots,
)
from jaxltl.envs.text_map import parse_map

STEPS = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1), "stay": (0, 0)}
SIDES = {
    "up": ("left", "right"),
    "down": ("left", "right"),
    "left": ("up", "down"),
    "right": ("up", "down"),
}
UNAVAILABLE = {}


def safe_part(game):
    """What is reachable where the system keeps from colliding for ever, all its safe moves free."""
    collision = np.asarray(game.label)[:, game.propositions.index("collision")]
    region = ~np.asarray(attractor(game, collision, rule=~np.asarray(game.system)).region)
    stays = jax.jit(operators.forall_successor)(game, region)
    allowed = np.asarray(game.available) & np.asarray(stays) & region[:, None]
    return restrict(game, allowed=allowed).model


def number(environment, system, turn, count):
    return (environment * count + system) * 2 + turn


def moves(world, state, action):
    """The positive probabilities of the successors, by state."""
    if not world.available[state, action]:
        return UNAVAILABLE
    found = {}
    weights = world.successor_probability[state, action]
    for t, p in zip(world.mdp.successor[state, action].tolist(), weights.tolist(), strict=True):
        if p > 0:
            found[t] = found.get(t, 0) + p
    return found


def host(game):
    """The game with NumPy's arrays, which Python's loops read faster."""
    return jax.tree.map(np.asarray, game)


def plain_moves(place, cell, *, stays, slip):
    """Where a robot's moves lead: for each action, a probability for each cell."""

    def ahead(move):
        target = (cell[0] + STEPS[move][0], cell[1] + STEPS[move][1])
        return target if target in place else cell

    result = []
    for action in ACTIONS:
        if action == "stay":
            result.append({cell: 1.0} if stays else UNAVAILABLE)
        elif ahead(action) == cell:
            result.append(UNAVAILABLE)
        else:
            one = {}
            for move, p in [(action, 1 - slip), *((m, slip / 2) for m in SIDES[action])]:
                if p:
                    one[ahead(move)] = one.get(ahead(move), 0) + p
            result.append(one)
    return result


def assert_is(game, place, *, system_stays=True, environment_stays=False, slip=0.0):
    """Every state's moves are those of a plain reading; `place` lists the cells in order."""
    game, count = host(game), len(place)
    index = {cell: i for i, cell in enumerate(place)}
    assert game.num_states == 2 * count**2
    assert game.num_actions == len(ACTIONS)
    for e, environment in enumerate(place):
        to_move = plain_moves(index, environment, stays=environment_stays, slip=0.0)
        for y, system in enumerate(place):
            own = plain_moves(index, system, stays=system_stays, slip=slip)
            first, second = (number(e, y, turn, count) for turn in (0, 1))
            assert not game.system[first]
            assert game.system[second]
            for a in range(len(ACTIONS)):
                assert moves(game, first, a) == {
                    number(index[c], y, 1, count): p for c, p in to_move[a].items()
                }
                assert moves(game, second, a) == pytest.approx(
                    {number(e, index[c], 0, count): p for c, p in own[a].items()}
                )


# --- robots --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "states", "system_states"),
    [
        (3, 120, 72),
        (4, 432, 240),
        (5, 1120, 600),
        (6, 2400, 1260),
        (8, 7840, 4032),
        (10, 19440, 9900),
    ],
)
def test_the_safe_part_has_the_published_size(size, states, system_states):
    game = safe_part(robots(size))
    cells = size**2
    assert states == 2 * cells * (cells - 1) - 4 * size * (size - 1)
    assert game.num_states == states
    assert int(game.system.sum()) == system_states == cells * (cells - 1)


@pytest.mark.parametrize(("size", "pairs"), [(3, 172), (4, 760)])
def test_the_safe_part_has_the_published_number_of_system_moves(size, pairs):
    game = safe_part(robots(size))
    assert int((game.available & game.system[:, None]).sum()) == pairs


def test_the_safe_part_never_collides_nor_can_be_run_into():
    game = host(safe_part(robots(4)))
    collision = game.label[:, 0]
    assert not collision.any()
    assert game.available.any(axis=1).all()
    # The environment keeps all of its moves.
    label = dict(zip(game.propositions, game.label.T, strict=True))
    in_corner = label["environment_lower_left"] & ~game.system
    assert (game.available[in_corner].sum(axis=1) == 2).all()


@pytest.mark.parametrize("size", [2, 3, 4])
def test_robots_move_as_a_plain_reading_says(size):
    # Upwards is towards larger numbers, so the first row of cells is the last of a map.
    cells = [(size - 1 - row, column) for row in range(size) for column in range(size)]
    assert_is(robots(size), cells)


def test_labels_and_starts_of_robots():
    size, count = 4, 16
    game = host(robots(size))
    assert is_deterministic(game)
    corner = dict(zip(CORNERS, (0, size - 1, count - size, count - 1), strict=True))
    for e in range(count):
        for y in range(count):
            gap = sorted(abs(i - j) for i, j in zip(divmod(e, size), divmod(y, size), strict=True))
            expected = {"collision"} if e == y else {"diagonal"} if gap == [1, 1] else set()
            for name, cell in corner.items():
                expected |= {f"environment_{name}"} if e == cell else set()
                expected |= {f"system_{name}"} if y == cell else set()
            for turn in (0, 1):
                state = number(e, y, turn, count)
                shown = {
                    p
                    for p, holds in zip(game.propositions, game.label[state], strict=True)
                    if holds
                }
                assert shown == expected | ({"system_turn"} if turn else set())
                start = 1 / (count * (count - 1)) if turn and e != y else 0
                assert game.initial[state] == pytest.approx(start)


def test_propositions_do_not_grow_with_the_grid():
    assert robots(3).propositions == robots(7).propositions
    assert len(robots(3).propositions) == 3 + 2 * len(CORNERS)


@pytest.mark.parametrize("size", [1, 0, -3, 2.0, True, "3"])
def test_sizes_that_are_none(size):
    with pytest.raises(ValueError, match=r"size=.*an integer from 2 to 181"):
        robots(size)


# --- rewards -------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [robots, lambda size: safe_part(robots(size))])
def test_the_reward_is_for_the_systems_moves_to_a_diagonal(make):
    game = host(make(3))
    reward = np.asarray(diagonal_reward(game))
    diagonal = game.label[:, game.propositions.index("diagonal")]
    expected = np.zeros(reward.shape)
    for s, a in np.argwhere(game.available & game.system[:, None]):
        expected[s, a] = diagonal[game.mdp.successor[s, a, 0]]
    assert reward.tolist() == expected.tolist()
    assert 0 < reward.sum() < expected.size


def test_the_reward_of_a_slipping_robot_is_a_chance():
    game = grid_game(
        """
        . . .
        . . .
        . . .
    """,
        slip=0.2,
    )
    reward = diagonal_reward(game)
    # The environment above the middle; the system, left of it, is diagonal in the middle's left
    # cell (1, 0) and in (1, 2). Downwards from (0, 0) it arrives in (1, 0), or slips to stay or
    # to the right.
    state = number(1, 0, 1, 9)
    np.testing.assert_allclose(reward[state], [0, 0.8, 0, 0.1, 0], atol=1e-15)
    assert not reward[~np.asarray(game.system)].any()


def test_rewards_of_conditions_masks_and_products():
    game = robots(3)
    corner = arrival_reward(game, "system_upper_left & !collision")
    mask = game.label[:, game.propositions.index("system_upper_left")] & ~game.label[:, 0]
    np.testing.assert_array_equal(jax.jit(arrival_reward)(game, mask), corner)
    assert corner.sum() > 0
    task = jl.product(game, "G !collision")
    lifted = arrival_reward(task, "system_upper_left & !collision")
    assert lifted.shape == (*task.state_shape, game.num_actions)
    np.testing.assert_array_equal(lifted, np.repeat(corner[:, None], task.mdp.num_memory, axis=1))
    with pytest.raises(ValueError, match="mentions the proposition 'corner'"):
        arrival_reward(game, "corner")


@pytest.mark.slow
def test_the_reward_that_opposes_the_task_is_never_attained():
    game, reward = reward_against_task()
    assert game.system.all()
    assert game.available.tolist() == [[True, True, False], [False, False, True]]
    assert moves(game, 0, 0) == {0: 1.0}
    assert moves(game, 0, 1) == moves(game, 1, 2) == {1: 1.0}
    assert game.label.tolist() == [[False], [True]]
    assert game.initial.tolist() == [0.5, 0.5]
    discount = 0.9
    best = jl.check(jl.optimal_value(game.mdp, reward, discount))
    np.testing.assert_allclose(best.value, [10 / (1 - discount), 0], atol=1e-6)
    # That value is had by staying alone, and whoever stays for ever fails the task.
    task = jl.product(game.mdp, "F b2")
    leaves, stays = jnp.array([1, 2]), jnp.array([0, 2])
    start = (0, task.initial_memory[0])
    probability = [
        jl.check(jl.satisfaction_probability(task, jl.lift_policy(task, policy))).value[start]
        for policy in (leaves, stays)
    ]
    np.testing.assert_allclose(probability, [1, 0], atol=1e-12)
    value = jl.check(jl.policy_value(game.mdp, leaves, reward, discount)).value
    np.testing.assert_allclose(value, [10, 0], atol=1e-6)


# --- maps ----------------------------------------------------------------------------------------

MAP = """
    a . # .
    . . b .
    # . . a
"""


@pytest.mark.parametrize("slip", [0.0, 0.3, 1.0])
@pytest.mark.parametrize(("system_stays", "environment_stays"), [(True, False), (False, True)])
def test_maps_move_as_a_plain_reading_says(slip, system_stays, environment_stays):
    stays = {"system_stays": system_stays, "environment_stays": environment_stays}
    game = grid_game(MAP, slip=slip, **stays)
    place = [
        (r, c)
        for r, row in enumerate(parse_map(MAP).tolist())
        for c, kind in enumerate(row)
        if kind != "#"
    ]
    assert places(MAP).tolist() == [list(cell) for cell in place]
    assert_is(game, place, slip=slip, **stays)
    assert is_deterministic(game) == (slip == 0)
    assert game.num_successors == (3 if slip else 1)


def test_a_map_without_walls_is_the_game_of_robots_upside_down():
    size = 3
    flipped = np.arange(size**2).reshape(size, size)[::-1].ravel()
    state = np.arange(2 * size**4)
    e, y, turn = np.unravel_index(state, (size**2, size**2, 2))
    same = number(flipped[e], flipped[y], turn, size**2)
    one, other = host(grid_game("...\n...\n...")), host(robots(size))
    np.testing.assert_array_equal(one.available, other.available[same])
    successor = np.where(one.available[..., None], same[one.mdp.successor], 0)
    np.testing.assert_array_equal(successor, other.mdp.successor[same])
    np.testing.assert_array_equal(one.label, other.label[same][:, :3])
    np.testing.assert_allclose(one.initial, other.initial[same])


def test_labels_of_a_map():
    game = host(grid_game("s#x\nxx.", legend={"s": ["home", "base"], "x": ["goal"], ".": []}))
    assert game.propositions == (
        "collision",
        "diagonal",
        "system_turn",
        "environment_base",
        "environment_goal",
        "environment_home",
        "system_base",
        "system_goal",
        "system_home",
    )
    shown = [["base", "home"], ["goal"], ["goal"], ["goal"], []]  # in reading order, no wall
    where = places("s#x\nxx.")
    for e in range(5):
        for y in range(5):
            expected = {f"environment_{p}" for p in shown[e]} | {f"system_{p}" for p in shown[y]}
            expected |= {"collision"} if e == y else set()
            expected |= {"diagonal"} if (abs(where[e] - where[y]) == 1).all() else set()
            for turn in (0, 1):
                row = game.label[number(e, y, turn, 5)]
                found = {p for p, holds in zip(game.propositions, row, strict=True) if holds}
                assert found == expected | ({"system_turn"} if turn else set())


@pytest.mark.parametrize(
    ("arguments", "pairs"),
    [
        ({"system_start": "a", "environment_start": (1, 1)}, [(2, 0)]),
        ({"system_start": "a | b"}, [(1, 0), (2, 0), (0, 1), (2, 1)]),
        ({"system_start": [1, 1], "environment_start": "!a"}, [(1, 2)]),
        ({"environment_start": np.array([0, 0])}, [(0, 1), (0, 2)]),
    ],
)
def test_starts(arguments, pairs):
    game = grid_game("a#\nb.", **arguments)
    expected = np.zeros(game.num_states)
    expected[[number(e, y, 1, 3) for e, y in pairs]] = 1 / len(pairs)
    np.testing.assert_allclose(game.initial, expected)


def test_another_wall():
    game = grid_game("#X\n..", wall="X")
    assert game.num_states == 18
    assert "system_#" in game.propositions


@pytest.mark.parametrize(
    ("text", "arguments", "message"),
    [
        ("", {}, "the map is empty"),
        ("..\n...", {}, "map row 2 has 3 cells"),
        ("##", {}, "all cells of the map are walls"),
        ("a?", {"legend": {"a": []}}, r"cell '\?' \(row 1, column 2\) is not in the legend"),
        ("..", {"slip": 1.5}, "slip=1.5; it must be at least 0 and at most 1"),
        (
            ".#\n..",
            {"system_start": (0, 1)},
            r"system_start=\(0, 1\) is a wall \(row 1, column 2 of the map\)",
        ),
        (
            "..",
            {"environment_start": (1, 0)},
            r"environment_start=\(1, 0\) is off the map, whose rows are 0 to 0 and columns 0 to 1",
        ),
        ("..", {"environment_start": (0, -1)}, r"environment_start=\(0, -1\) is off the map"),
        ("..", {"system_start": (0, 1, 2)}, "give a formula .* or a cell's row and column"),
        ("..", {"system_start": (0.0, 1.0)}, "give a formula .* or a cell's row and column"),
        ("ab", {"system_start": "c"}, "system_start: 'c' mentions the proposition 'c'"),
        ("ab", {"system_start": "a & b"}, "system_start='a & b' holds in no cell"),
        ("ab", {"system_start": "F a"}, "system_start: 'F a' is not Boolean"),
        ("ab", {"system_start": "a", "environment_start": "a"}, "one and the same cell"),
        (
            "..#.",
            {},
            "the environment has no move from the cell in row 1, column 4, which walls "
            "enclose; .* set environment_stays=True",
        ),
        (
            "..#.",
            {"environment_stays": True, "system_stays": False},
            "the system has no move from the cell in row 1, column 4",
        ),
        ("ab", {"legend": {"a": ["turn"], "b": []}}, "'turn' is a proposition of the map"),
    ],
)
def test_bad_maps_are_refused_at_their_place(text, arguments, message):
    with pytest.raises(ValueError, match=message):
        grid_game(text, **arguments)


def test_a_robot_that_walls_enclose_may_stay():
    game = grid_game("..#.", environment_stays=True)
    state = number(2, 0, 0, 3)
    assert game.available[state].tolist() == [False] * 4 + [True]


def test_a_system_that_slips_may_be_driven_into_the_other():
    text = "...\n...\n..."
    lost = []
    for slip in (0.0, 0.2):
        game = grid_game(text, slip=slip, system_stays=False)
        found = attractor(game, game.label[:, 0], rule=~game.system).region
        lost.append(np.asarray(found & (game.initial > 0)))
    assert lost[1][lost[0]].all()
    assert lost[1].sum() > lost[0].sum()
