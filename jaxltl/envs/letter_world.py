"""LetterWorld: letters on a torus of cells (Vaezipoor et al. 2021, section 5.1).

As used by Jackermeier and Abate (2025, appendix), but with any empty initial cell, which on a torus
seen from the agent is the same, and with cells of letters from a precomputed table with its
symmetries (the published drawing rejects 72 of 73 maps). Letters are drawn in each episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.environments import (
    Environment,
    Timestep,
    make_box,
    make_environment,
    with_time_limit,
)
from jaxltl.core.models.protocols import Array, Key
from jaxltl.core.pretty_print import brief
from jaxltl.envs.text_map import parse_map

ACTIONS = ("up", "down", "left", "right")
_MOVES = ((-1, 0), (1, 0), (0, -1), (0, 1))
_NAMES = "abcdefghijklmnopqrstuvwxyz"


@brief
class LetterState(NamedTuple):
    """State of a letter world.

    Attributes:
      letter: ``int8[C]``, the number of each cell's letter, or the number of letters for none; cells
        are counted row by row from the upper left.
      place: ``int32[]``, the agent's cell.
    """

    letter: Array
    place: Array


def letter_world(
    *,
    size: int = 7,
    letters: int | Sequence[str] = 12,
    num_copies: int = 2,
    horizon: int | None = 75,
    layout: str | ArrayLike | None = None,
    initial: int | None = None,
    connected: bool = True,
    num_maps: int = 1024,
    seed: int = 0,
    flat: bool = False,
) -> Environment:
    """LetterWorld with a random map per episode, or with a given map.

    Actions are up, down, left and right; there is no reward. Observations are ``float32[size, size,
    letters + 1]``: a plane for each letter, centred at the agent, and one for the agent.

    Args:
      size: cells along a side.
      letters: the number of letters a, b, c, ...; or their names.
      num_copies: the number of cells of each letter.
      horizon: the time limit, or None.
      layout: the map of every episode: a text (see :func:`~jaxltl.envs.text_map.parse_map`) with
        ``.`` for empty cells, or ``int[size, size]``, numbers of letters, -1 for none.
      initial: the initial cell in a given layout; default: any empty one.
      connected: draw maps in which all cells are reachable across empty ones.
      num_maps, seed: size, before symmetries, and seed of the table of such maps.
      flat: whether observations are vectors.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment` with states :class:`LetterState`.

    Raises:
      ValueError: letters that do not fit on the map, a malformed layout, an invalid initial cell, or too few
        connected maps of this size.

    >>> world = letter_world()
    >>> world.propositions[:3], world.observations.shape, world.horizon
    (('a', 'b', 'c'), (7, 7, 13), 75)
    """
    names, starts = _names(letters), None
    connected = validation.boolean("connected", connected)
    flat = validation.boolean("flat", flat)
    num_copies = validation.integer("num_copies", num_copies)
    num_maps = validation.integer("num_maps", num_maps, least=int(connected), limit=2**24)
    size = validation.integer("size", size, limit=2**10)
    seed = validation.integer("seed", seed)
    if layout is None:
        if initial is not None:
            raise ValueError(f"initial={initial} is for a given layout; leave it out.")
        used = len(names) * num_copies
        if size < 2 or num_copies < 1 or used >= size * size:
            raise ValueError(
                f"letter_world: {len(names)} letters on {num_copies} cells each do not fit on "
                f"{size} x {size} cells with one left for the agent."
            )
        if connected:
            cells = connected_cells(size, used, num_maps, seed)
            reset = Partial(
                _draw_connected, *_orders(cells, size), np.zeros((num_copies, len(names)))
            )
        else:
            reset = Partial(_draw_any, np.zeros((size, size)), np.zeros((num_copies, len(names))))
    else:
        letter, size, names = _given(layout, names, letters)
        empty = np.flatnonzero(letter == len(names))
        if initial is None and not len(empty):
            raise ValueError("layout: no cell is empty; say where to begin, initial=0.")
        if initial is not None:
            initial = validation.integer("initial", initial, limit=size * size - 1)
        places = (empty if initial is None else np.array([initial])).astype(np.int32)
        reset, starts = Partial(_begin, letter, places), Partial(_starts, letter, places)
    views, count = _views(size), len(names)
    shape = (size * size * (count + 1),) if flat else (size, size, count + 1)
    world = make_environment(
        reset,
        Partial(_move, _neighbors(size)),
        Partial(_see, views, np.zeros(shape, np.float32), np.arange(count + 1, dtype=np.int8)),
        actions=4,
        labels=Partial(_labels, np.arange(count, dtype=np.int8)),
        propositions=names,
        observations=make_box(0, 1, shape, np.float32),
        starts=starts,
    )
    return world if horizon is None else with_time_limit(world, horizon)


def _names(letters: int | Sequence[str]) -> tuple[str, ...]:
    if not isinstance(letters, int | np.integer):
        return validation.distinct_names("letters", letters)
    if not 1 <= letters <= len(_NAMES):
        raise ValueError(f"letters={letters}; it must be 1 to {len(_NAMES)}, or their names.")
    return tuple(_NAMES[:letters])


def _given(
    layout: str | ArrayLike, names: tuple[str, ...], letters: int | Sequence[str]
) -> tuple[np.ndarray, int, tuple[str, ...]]:
    """Letters of the cells of a given map, its size, and the names."""
    if isinstance(layout, str):
        cells = parse_map(layout)
        for name in [str(x) for x in np.unique(cells) if x != "."]:
            if name not in names:
                raise ValueError(
                    f"layout: {name!r} is none of the letters {list(names)}; name it in letters=."
                )
        number = {".": len(names)} | {name: i for i, name in enumerate(names)}
        table = np.array([[number[str(x)] for x in row] for row in cells])
    else:
        table = np.asarray(layout)
        if (
            table.dtype.kind not in "iu"
            or table.ndim != 2
            or (table.size and not -1 <= table.min() <= table.max() < len(names))
        ):
            raise ValueError(
                f"layout: give a text, or integers [size, size] from -1 to {len(names) - 1}."
            )
        table = np.where(table < 0, len(names), table)
    if len(set(table.shape)) != 1 or len(table) < 2:
        raise ValueError(
            f"layout has {' x '.join(map(str, table.shape))} cells; it must be square "
            "and have at least 2 x 2."
        )
    return table.ravel().astype(np.int8), len(table), names


# --- maps -----------------------------------------------------------------------------------------


def connected_cells(size: int, used: int, count: int, seed: int = 0) -> np.ndarray:
    """Uniform sets ``bool[count, C]`` of `used` cells of the torus, with a connected complement."""
    random, connected, tries = np.random.default_rng(seed), [np.zeros((0, size * size), bool)], 0
    while (have := sum(map(len, connected))) < count:
        if (tries := tries + 1) > 200 + 200 * have:
            raise ValueError(
                f"letter_world: connected maps of {size} x {size} cells, {used} of them with "
                "letters, are too rare; take fewer letters, or connected=False."
            )
        some = random.permuted(np.tile(np.arange(size * size) < used, (8192, 1)), axis=1)
        connected.append(some[is_connected(some.reshape(-1, size, size))])
    return np.concatenate(connected)[:count]


def is_connected(used: np.ndarray) -> np.ndarray:
    """``bool[N]``, the condition of :func:`connected_cells` for sets ``bool[N, size, size]``."""

    def beside(x: np.ndarray) -> np.ndarray:
        return np.roll(x, 1, 1) | np.roll(x, -1, 1) | np.roll(x, 1, 2) | np.roll(x, -1, 2)

    empty = ~used
    reached = np.zeros_like(empty)
    first = empty.reshape(len(empty), -1).argmax(axis=1)
    reached.reshape(len(empty), -1)[np.arange(len(empty)), first] = True
    reached &= empty
    while not np.array_equal(more := reached | (beside(reached) & empty), reached):
        reached = more
    return (reached | beside(reached)).all(axis=(1, 2))


def _orders(maps: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Letter slots of the cells (the last number: none) and empty cells, of all symmetric maps."""
    turned = [np.rot90(maps.reshape(-1, size, size), k, (1, 2)) for k in range(4)]
    every = np.concatenate(turned + [x.transpose(0, 2, 1) for x in turned]).reshape(-1, size * size)
    slot = np.where(every, np.cumsum(every, axis=1) - 1, maps[0].sum())
    return slot.astype(np.uint8), np.nonzero(~every)[1].reshape(len(every), -1).astype(np.uint8)


def _neighbors(size: int) -> np.ndarray:
    row, column = np.divmod(np.arange(size * size), size)
    return np.stack(
        [(row + i) % size * size + (column + j) % size for i, j in _MOVES], axis=1
    ).astype(np.int32)


def _views(size: int) -> np.ndarray:
    """Cell seen at each position of the view, by place, as ``uint8[C, C]`` or ``int32``."""
    row, column = np.divmod(np.arange(size * size), size)
    here = row[:, None] + row - size // 2, column[:, None] + column - size // 2
    return (here[0] % size * size + here[1] % size).astype(np.int32)


# --- of one trajectory ----------------------------------------------------------------------------


def _draw_connected(slot: Array, empty: Array, each: Array, key: Key) -> LetterState:
    num_copies, count = each.shape
    used = num_copies * count
    bits = jax.random.bits(key, used + 2, jnp.uint32)
    drawn, place = bits[0] % np.uint32(slot.shape[0]), bits[1] % np.uint32(empty.shape[1])
    # The rank of random numbers is a uniform permutation. Comparing all of them, and of slots and
    # cells too, is several times faster than sorting and looking up. Low bits make them distinct.
    low = np.uint32((1 << (used - 1).bit_length()) - 1)
    number = (bits[2:] & ~low) | np.arange(used, dtype=np.uint32)
    shuffled = (number[:, None] > number).sum(axis=1, dtype=jnp.int32) // num_copies - count
    taken = jnp.asarray(slot)[drawn][:, None] == np.arange(used, dtype=slot.dtype)
    letter = count + jnp.where(taken, shuffled.astype(jnp.int8), 0).sum(axis=1, dtype=jnp.int8)
    return LetterState(letter, jnp.asarray(empty)[drawn, place].astype(jnp.int32))


def _draw_any(cells: Array, each: Array, key: Key) -> LetterState:
    num_copies, count = each.shape
    order = jax.random.permutation(key, cells.size)
    letter = jnp.where(order < num_copies * count, order // num_copies, count).astype(jnp.int8)
    # Of a uniform permutation, the cell of the last number is a uniform empty one.
    return LetterState(letter, jnp.argmax(order).astype(jnp.int32))


def _begin(letter: Array, places: Array, key: Key) -> LetterState:
    return LetterState(jnp.asarray(letter), jax.random.choice(key, jnp.asarray(places)))


def _starts(letter: Array, places: Array) -> tuple[LetterState, jax.Array]:
    count = len(places)
    every = jnp.broadcast_to(jnp.asarray(letter), (count, *letter.shape))
    return LetterState(every, jnp.asarray(places)), jnp.full(count, 1 / count)


def _move(neighbors: Array, world: LetterState, action: jax.Array, key: Key) -> Timestep:
    place = jnp.asarray(neighbors)[world.place, action]
    return Timestep(world._replace(place=place), reward=0.0, terminated=False)


def _see(views: Array, shape: Array, numbers: Array, world: LetterState) -> jax.Array:
    seen = world.letter[jnp.asarray(views)[world.place]]
    cells, count = views.shape[0], numbers.shape[0] - 1
    planes = seen[:, None] == numbers
    size = round(cells**0.5)
    planes = planes.at[:, count].set(jnp.arange(cells) == size // 2 * (size + 1))
    return planes.astype(jnp.float32).reshape(shape.shape)


def _labels(numbers: Array, world: LetterState) -> jax.Array:
    return world.letter[world.place] == numbers


def events_seen(observation: jax.Array) -> jax.Array:
    """One-hot events of an observation, ``float32[size, size, letters + 1]``, the empty event first."""
    letters = observation[..., :-1]
    return jnp.concatenate([1 - letters.sum(-1, keepdims=True), letters], -1)
