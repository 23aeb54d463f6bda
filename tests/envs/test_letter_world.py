"""LetterWorld against a slow world of its own, and its maps against a search."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.letter_world import finite_task
from jaxltl.core.automata.automaton import letter_index
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.episodes import auto_reset_step
from jaxltl.envs.letter_world import ACTIONS, connected_cells, is_connected, letter_world

MAX_PROGRAMS = 450  # that the default tests compile at most

MOVES = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}
NAMES = ("a", "d", "e", "i", "k", "l", "other")
MAP = """
a . b
. . .
c . a
"""


@functools.cache
def world():
    return letter_world()


def reached(used, start):
    """Cells that a walk across empty cells comes to, by a queue."""
    size, seen, queue = len(used), {start}, [start]
    while queue:
        row, column = queue.pop()
        if used[row, column]:
            continue
        for i, j in MOVES.values():
            if (cell := ((row + i) % size, (column + j) % size)) not in seen:
                seen.add(cell)
                queue.append(cell)
    return seen


def slow_view(letters, place, count):
    """The planes of a map whose agent is in the middle."""
    size = len(letters)
    planes = np.zeros((size, size, count + 1), np.float32)
    for i in range(size):
        for j in range(size):
            seen = letters[(place[0] + i - size // 2) % size, (place[1] + j - size // 2) % size]
            if seen < count:
                planes[i, j, seen] = 1
    planes[size // 2, size // 2, count] = 1
    return planes


def test_maps_are_drawn_with_each_letter_twice_and_all_cells_within_reach():
    states, time = jax.jit(jax.vmap(world().reset))(jax.random.split(jax.random.key(0), 300))
    letters = np.asarray(states.letter).reshape(-1, 7, 7)
    assert (time == 0).all()
    for some, place in zip(letters, np.asarray(states.place), strict=True):
        assert np.bincount(some.ravel()).tolist() == [2] * 12 + [25]
        assert some.flat[place] == 12
        assert len(reached(some < 12, tuple(divmod(int(place), 7)))) == 49
    assert len({x.tobytes() for x in letters}) == 300
    # Any letter may stand anywhere, and the agent too.
    assert ((letters == 0).sum(axis=0) > 0).all()
    assert len(np.unique(states.place)) == 49


def test_connected_cells_are_those_of_a_search():
    random = np.random.default_rng(1)
    for size, used in ((3, 4), (4, 7), (7, 24)):
        some = random.permuted(np.tile(np.arange(size * size) < used, (300, 1)), axis=1)
        some = some.reshape(-1, size, size)
        starts = [tuple(np.argwhere(~x)[-1]) for x in some]
        expected = [len(reached(x, s)) == size * size for x, s in zip(some, starts, strict=True)]
        assert is_connected(some).tolist() == expected
        assert sum(expected) > 0 or size == 7
    assert connected_cells(7, 24, 100).sum(axis=1).tolist() == [24] * 100


def test_steps_and_what_is_seen_are_the_slow_worlds():
    keys = jax.random.split(jax.random.key(2), 20)
    actions = np.random.default_rng(3).integers(4, size=(30, 20))
    states = jax.vmap(world().reset)(keys)
    step = jax.jit(jax.vmap(world().step))
    look = jax.jit(jax.vmap(lambda x: (world().observe(x), world().labels(x))))
    letters = np.asarray(states[0].letter).reshape(-1, 7, 7)
    places = [divmod(int(x), 7) for x in states[0].place]
    for row in actions:
        found = step(states, row, keys)
        states = found.world
        moves = [MOVES[ACTIONS[a]] for a in row]
        places = [((r + i) % 7, (c + j) % 7) for (r, c), (i, j) in zip(places, moves, strict=True)]
        seen, label = look(states)
        for n, place in enumerate(places):
            assert (seen[n] == slow_view(letters[n], place, 12)).all()
            assert label[n].tolist() == [letters[n][place] == k for k in range(12)]
        assert not found.terminated.any()
    assert (np.asarray(states[0].letter).reshape(-1, 7, 7) == letters).all()


def test_an_episode_is_truncated_after_75_steps():
    def move(state, key):
        _, found = auto_reset_step(key, world(), state, 0)
        return found.world, found

    _, found = jax.lax.scan(
        move, world().reset(jax.random.key(4)), jax.random.split(jax.random.key(5), 75)
    )
    assert found.truncated.tolist() == [False] * 74 + [True]


def test_a_given_map_and_where_it_is_begun():
    text = letter_world(layout=MAP, letters=3, horizon=None, flat=True)
    array = letter_world(
        layout=[[0, -1, 1], [-1, -1, -1], [2, -1, 0]],
        letters=["a", "b", "c"],
        horizon=None,
        initial=3,
    )
    assert text.observations.shape == (36,) and array.observations.shape == (3, 3, 4)
    keys = jax.random.split(jax.random.key(0), 200)
    drawn = jax.vmap(text.reset)(keys)
    assert np.unique(drawn.place).tolist() == [1, 3, 4, 5, 7]
    assert (drawn.letter == array.reset(keys[0]).letter).all()
    assert array.reset(keys[0]).place == 3
    end = array.step(array.reset(keys[0]), 0, keys[0]).world
    assert array.labels(end).tolist() == [True, False, False]
    assert (text.observe(end).reshape(3, 3, 4) == array.observe(end)).all()
    assert (array.observe(end)[..., 0] == np.array([[1, 0, 0], [0, 1, 0], [0, 0, 0]])).all()


@pytest.mark.slow
def test_maps_without_ways_are_uniform():
    free = letter_world(size=3, letters=2, num_copies=2, connected=False, horizon=None)
    drawn = jax.vmap(free.reset)(jax.random.split(jax.random.key(0), 9000))
    assert (jnp.bincount(drawn.letter.ravel()) == 9000 * jnp.array([2, 2, 5])).all()
    share = (np.asarray(drawn.letter) == 1).mean(axis=0)
    assert np.abs(share - 2 / 9).max() < 5 * np.sqrt(2 / 9 * 7 / 9 / 9000)
    share = np.bincount(drawn.place, minlength=9) / 9000
    assert np.abs(share - 1 / 9).max() < 5 * np.sqrt(1 / 9 * 8 / 9 / 9000)
    assert (jax.vmap(free.labels)(drawn) == False).all()  # noqa: E712


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"size": 3}, "do not fit on 3 x 3 cells"),
        ({"letters": 0}, "letters=0; it must be 1 to 26"),
        ({"size": 4, "letters": 5, "num_copies": 3}, "too rare"),
        ({"layout": "a b c"}, "1 x 3 cells; it must be square"),
        ({"layout": "a z\nb .", "letters": 3}, "'z' is none of the letters"),
        ({"layout": [[0, 9], [0, 0]], "letters": 3}, "integers .* from -1 to 2"),
        ({"layout": "a a\na a"}, "no cell is empty"),
        ({"layout": "a a\na .", "initial": 4}, "initial=4; it must be at most 3"),
        ({"initial": 4}, "for a given layout"),
    ],
)
def test_what_does_not_fit_is_named(options, said):
    with pytest.raises(ValueError, match=said):
        letter_world(**options)


def test_tasks_of_the_benchmark_end_with_the_reach_part():
    """``G !x`` holds up to the end, as in a formula with until in its place."""
    avoid = "!(k | l)"
    inner = f"{avoid} U d"
    for name in "iea":
        inner = f"{avoid} U ({name} & ({inner}))"
    ours = finite_task("G !(k | l) & F(a & F(e & F(i & F d)))")
    theirs = to_automaton(inner)
    assert ours.is_cosafe
    pairs = {(int(ours.initial), int(theirs.initial))}
    queue = list(pairs)
    letters = [[letter_index(x, {n} & set(x.propositions)) for n in NAMES] for x in (ours, theirs)]
    while queue:
        q, r = queue.pop()
        assert ours.final[q] == theirs.final[r]
        for i, j in zip(*letters, strict=True):
            if (pair := (int(ours.delta[q, i]), int(theirs.delta[r, j]))) not in pairs:
                pairs.add(pair)
                queue.append(pair)
    assert any(ours.final[q] for q, _ in pairs) and len(pairs) > 5
