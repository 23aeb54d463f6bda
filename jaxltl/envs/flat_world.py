"""FlatWorld: a point among coloured discs on a square (Voloshin, Verma and Yue 2023).

As in the authors' program and in Jackermeier and Abate (2025): nine discs of seven colours in
``[-2, 2]^2``, which may overlap; a velocity in ``[-1, 1]^2`` moves the point by .08 of it; leaving
the square ends the episode with a reward of -1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.core import struct, validation
from jaxltl.core.environments.environment import Environment, Timestep, make_box, make_environment
from jaxltl.core.environments.episodes import with_time_limit, without_time_limit
from jaxltl.core.models.protocols import Array, Key, PyTree
from jaxltl.core.pretty_print import brief

# Colour, place and radius of each disc.
DISCS = (
    ("red", -1.4, 0.55, 0.4),
    ("magenta", -1.1, 1.1, 0.5),
    ("yellow", -1.0, -1.2, 0.3),
    ("orange", -1.53, -0.5, 0.32),
    ("blue", 0.1, 0.0, 0.8),
    ("red", 0.5, -1.3, 0.35),
    ("green", 0.7, 0.7, 0.5),
    ("green", 1.5, -0.75, 0.4),
    ("aqua", 0.8, 0.2, 0.3),
)
_R = 0.5**0.5
_MOVES = ((0, 1), (1, 0), (0, -1), (-1, 0), (_R, _R), (_R, -_R), (-_R, _R), (-_R, -_R), (0, 0))


@brief
class FlatState(NamedTuple):
    """State of a flat world: `place` is ``float32[2]``."""

    place: Array


@struct.dataclass
class Discs:
    """Centres, radii and one-hot colours of D discs in a square of half a side `extent`."""

    center: Array
    radius: Array
    color: Array
    extent: Array


def flat_world(
    *,
    discs: Sequence[tuple[str, float, float, float]] = DISCS,
    extent: float = 2.0,
    time_step: float = 0.08,
    horizon: int | None = 500,
    discrete: bool = False,
    initial: Sequence[float] | None = None,
    num_starts: int = 2**16,
    seed: int = 0,
) -> Environment:
    """FlatWorld as an environment.

    Args:
      discs: ``(colour, x, y, radius)``; the propositions are the sorted colours.
      extent: half a side of the square.
      time_step: distance of a step at velocity one.
      horizon: the time limit, or None.
      discrete: nine actions (up, right, down, left, the four diagonals, each with velocity one, and
        rest) instead of a box.
      initial: the initial position; default: uniform outside of all discs.
      num_starts, seed: size and seed of the table of initial positions.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment` with states :class:`FlatState`.

    Raises:
      ValueError: no disc, a number that is not positive, an initial position outside of the square, or discs that
        leave hardly any initial position.

    >>> world = flat_world()
    >>> world.propositions
    ('aqua', 'blue', 'green', 'magenta', 'orange', 'red', 'yellow')
    """
    rows = [tuple(validation.sequence("discs", row)) for row in validation.sequence("discs", discs)]
    if not all(len(row) == 4 and isinstance(row[0], str) for row in rows):
        raise ValueError(
            f"discs is {validation.shorten(discs)}; give (colour, x, y, radius) of each."
        )
    names = tuple(sorted({name for name, *_ in rows}))
    table = validation.float_array("discs", [row[1:] for row in rows])
    numbers = table.astype(np.float32).reshape(-1, 3)
    if not len(numbers) or not np.isfinite(numbers).all() or not (numbers[:, 2] > 0).all():
        raise ValueError(
            "flat_world: discs are (colour, x, y, radius), at least one, with radii above zero."
        )
    extent = validation.finite_number("extent", extent)
    time_step = validation.finite_number("time_step", time_step)
    num_starts = validation.integer("num_starts", num_starts, least=1, limit=2**26)
    seed, discrete = validation.integer("seed", seed), validation.boolean("discrete", discrete)
    if not (0 < extent < 1e6 and 0 < time_step < 1e6):
        raise ValueError(
            f"extent={extent}, time_step={time_step}; both must be positive, and below a million."
        )
    if initial is not None and not (
        np.shape(place := validation.float_array("initial", initial)) == (2,)
        and np.abs(place).max() <= extent
    ):
        raise ValueError(f"initial={initial!r}; give a place (x, y) within {extent} of the middle.")
    color = np.array([[name == one for one in names] for name, *_ in rows])
    scene = Discs(numbers[:, :2], numbers[:, 2], color, np.float32(extent))
    number = np.array([extent, time_step], np.float32)
    if initial is not None:
        reset = Partial(_begin_at, np.asarray(initial, np.float32))
    else:
        reset = Partial(_begin, _free_places(scene, extent, num_starts, seed))
    bound = extent + time_step  # of the step that leaves the square the place outside is seen
    world = make_environment(
        reset,
        Partial(_move, number, np.array(_MOVES, np.float32) if discrete else None),
        _see,
        actions=9 if discrete else make_box(-1, 1, (2,), np.float32),
        labels=Partial(_labels, scene),
        propositions=names,
        observations=make_box(-bound, bound, (2,), np.float32),
    )
    return world if horizon is None else with_time_limit(world, horizon)


def discs_of(environment: Environment) -> Discs:
    """The discs of an environment made by :func:`flat_world`."""
    return without_time_limit(environment)[0].labels.args[0]  # type: ignore[attr-defined]


@brief
@dataclass(frozen=True)
class EventsAround:
    """Observation encoder by events around the agent; made by :func:`events_around`."""

    events: tuple[tuple[bool, ...], ...]
    discs: tuple[tuple[float, float, float, int], ...]
    extent: float
    radii: tuple[float, ...]
    num_directions: int

    def __call__(self, observation: jax.Array) -> jax.Array:
        """``float[1 + R K, E]``: events at the agent's place and at R distances in K directions."""
        turn = np.arange(self.num_directions) * (2 * np.pi / self.num_directions)
        ways = np.stack([np.cos(turn), np.sin(turn)], -1)
        there = np.concatenate([[[0.0, 0.0]], *(ways * r for r in self.radii)]).astype(np.float32)
        place = observation + there
        rows = np.array([row[:3] for row in self.discs], np.float32)
        events = np.array(self.events, np.float32)
        color = np.eye(events.shape[1], dtype=np.float32)[[row[3] for row in self.discs]]
        apart = ((place[:, None] - rows[:, :2]) ** 2).sum(-1)
        held = ((apart < rows[:, 2] ** 2).astype(jnp.float32) @ color > 0).astype(jnp.float32)
        # A label is an event where all of the event's propositions hold, and none besides.
        same = held @ (2 * events - 1).T > events.sum(-1) - 0.5
        return (same & (jnp.abs(place) <= self.extent).all(-1, keepdims=True)).astype(jnp.float32)


def events_around(
    environment: Environment,
    events: ArrayLike,
    *,
    radii: Sequence[float] = (0.08, 0.16, 0.28, 0.45, 0.7, 1.0, 1.4, 1.9, 2.5),
    num_directions: int = 16,
) -> EventsAround:
    """Egocentric event encoding from known discs, ``observation -> float[X, E]``.

    The `events` ``bool[E, P]``, one-hot, at the position and at distances `radii` in
    `num_directions` evenly spaced directions; outside of the square none holds. For
    :class:`~jaxltl.algos.many_tasks.SequenceNetwork`'s `events_seen`.

    Raises:
      ValueError: events of another shape, distances that are not positive, or no direction.

    >>> world = flat_world()
    >>> look = events_around(world, np.eye(7, dtype=bool), radii=[0.5], num_directions=4)
    >>> look(jnp.array([-1.0, -1.2])).astype(int).sum(0).tolist()  # in the yellow disc
    [0, 0, 0, 0, 0, 0, 1]
    """
    scene, rows = discs_of(environment), validation.float_array("events", events).astype(bool)
    if rows.ndim != 2 or not len(rows) or rows.shape[1] != len(environment.propositions):
        raise ValueError(
            f"events has shape {list(rows.shape)}; give Booleans "
            f"[E, {len(environment.propositions)}], a column for each colour."
        )
    distances = validation.float_array("radii", radii)
    if distances.ndim != 1 or not ((distances > 0) & np.isfinite(distances)).all():
        raise ValueError(f"radii={distances.tolist()}; give distances, all positive.")
    discs = [
        (*center, radius, color)
        for center, radius, color in zip(
            np.asarray(scene.center).tolist(),
            np.asarray(scene.radius).tolist(),
            np.argmax(scene.color, -1).tolist(),
            strict=True,
        )
    ]
    return EventsAround(
        tuple(map(tuple, rows.tolist())),
        tuple(discs),
        float(scene.extent),
        tuple(distances.tolist()),
        validation.integer("num_directions", num_directions, least=1, limit=2**10),
    )


def _free_places(scene: Discs, extent: float, count: int, seed: int) -> np.ndarray:
    """``float32[count, 2]``, uniform outside of all discs."""
    random, free, rounds = np.random.default_rng(seed), [np.zeros((0, 2), np.float32)], 0
    while (have := sum(map(len, free))) < count:
        if (rounds := rounds + 1) > 20 and have < 0.01 * rounds * count:
            raise ValueError("flat_world: the discs hardly leave a place to begin; give initial.")
        places = random.uniform(-extent, extent, (count, 2)).astype(np.float32)
        apart = ((places[:, None] - scene.center) ** 2).sum(axis=-1)
        free.append(places[(apart >= scene.radius**2).all(axis=1)])
    return np.concatenate(free)[:count]


def _begin(places: Array, key: Key) -> FlatState:
    drawn = jax.random.bits(key, (), jnp.uint32) % np.uint32(places.shape[0])
    return FlatState(jnp.asarray(places)[drawn])


def _begin_at(place: Array, key: Key) -> FlatState:
    return FlatState(jnp.asarray(place))


def _move(
    number: Array, moves: Array | None, world: FlatState, action: PyTree, key: Key
) -> Timestep:
    velocity = jnp.clip(action, -1, 1) if moves is None else jnp.asarray(moves)[action]
    place = (world.place + number[1] * velocity).astype(jnp.float32)
    outside = (jnp.abs(place) > number[0]).any()
    return Timestep(FlatState(place), jnp.where(outside, -1.0, 0.0), outside)


def _see(world: FlatState) -> jax.Array:
    return world.place


def _labels(scene: Discs, world: FlatState) -> jax.Array:
    inside = jnp.sum((world.place - scene.center) ** 2, axis=-1) < scene.radius**2
    return (scene.color & inside[:, None]).any(axis=0)
