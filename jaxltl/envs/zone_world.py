"""A point robot among coloured zones (Vaezipoor et al. 2021, section 5.1, "ZoneEnv").

Two zones of each of four colours lie in a walled square of 5 x 5; the robot accelerates and turns,
and observes the proximity of the zones in each of 16 directions. Zones and robot are placed anew for
each episode. Sizes, sensors and colours are those of Jackermeier and Abate (2025), with the point
of Safety Gym as the robot, simulated by MuJoCo.

The robot here is a formula for that point. Its thrust is limited to ``.3 * .05``, against a damping
of .01 and its mass, ``4/3 pi .1^3 + .1^3`` at density one: it tends to 1.5 units a second with a
time constant of .52 seconds. Its turning adapts within 6 milliseconds, here at once:
``3.16 * turn`` radians a second, at most 3. A step is .02 seconds, integrated exactly but for the
turn (midpoint rule). Readings: walls stop the robot without bouncing; their four sensors give
proximities; and constant sensors are omitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxltl.core import struct, validation
from jaxltl.core.environments import (
    Environment,
    Timestep,
    make_box,
    make_environment,
    with_time_limit,
)
from jaxltl.core.models.protocols import Array, Key
from jaxltl.core.pretty_print import brief

COLORS = ("green", "yellow", "blue", "magenta")
_MASS = 4 / 3 * np.pi * 0.1**3 + 0.1**3
_KEEPOUT = 0.55, 0.4  # of a zone and of the robot: how near others may come, together
_ROBOT = 0.1  # its radius
_BINS = 16


@brief
class ZoneState(NamedTuple):
    """State of a zone world: `place`, `velocity` and `zone` ``float32[P, N, 2]`` in the frame of the walls.

    `heading` is in radians, and `acceleration` and `turning` (radians a second) are of the last step.
    """

    place: jax.Array
    velocity: jax.Array
    heading: jax.Array
    acceleration: jax.Array
    turning: jax.Array
    zone: jax.Array


@struct.dataclass
class _ZoneParameters:
    radius: np.float32
    extent: np.float32
    time_step: np.float32
    thrust: np.float32  # the acceleration
    saturation: np.float32  # the action from which on it is that
    drag: np.float32  # a second scales a velocity by exp(-drag)
    turn: np.float32
    most_turn: np.float32
    gain: np.float32


def zone_world(
    *,
    colors: Sequence[str] = COLORS,
    num_zones: int = 2,
    radius: float = 0.4,
    extent: float = 2.5,
    horizon: int | None = 1000,
    saturation: float = 0.05,
    num_maps: int = 1024,
    seed: int = 0,
) -> Environment:
    """ZoneEnv as an environment.

    Actions are ``float32[2]`` in [-1, 1], thrust and turn. Observations are ``float32[16 P + 11]``: for
    each colour the proximity ``exp(-d / 2)`` of the nearest zone in each direction, counted from the
    robot's front and shared between neighbouring directions; then acceleration and velocity in the
    robot's frame, its turning, its heading as cosine and sine, and the proximity of the walls in the
    order east, north, west, south.

    Args:
      colors: the propositions, each true in the zones of its colour.
      num_zones: the number of zones of each colour.
      radius, extent: of a zone, and half a side of the square.
      horizon: the time limit, or None.
      saturation: the action from which on the thrust is full; as published, .05.
      num_maps, seed: size of the table of placements, before symmetries and colours, and its seed.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment` with states :class:`ZoneState`.

    Raises:
      ValueError: numbers that are not positive, a repeated colour, or zones that do not fit.

    >>> world = zone_world(num_maps=8)
    >>> world.propositions, world.observations.shape, world.actions.shape
    (('green', 'yellow', 'blue', 'magenta'), (75,), (2,))
    """
    names = validation.distinct_names("colors", colors)
    num_zones, seed = validation.integer("num_zones", num_zones), validation.integer("seed", seed)
    num_maps = validation.integer("num_maps", num_maps, limit=2**20)
    sizes = {"radius": radius, "extent": extent, "saturation": saturation}
    counts = {"num_zones": num_zones, "num_maps": num_maps, "colors": len(names)}
    for name, number in (sizes | counts).items():
        if not 0 < validation.finite_number(name, number) < 1e7:
            raise ValueError(
                f"zone_world: {name}={number}; it must be positive, and below ten million."
            )
    radius, extent, saturation = float(radius), float(extent), float(saturation)
    places = draw_places(len(names) * num_zones, extent, num_maps, seed)
    thrust, drag = 0.3 * 0.05 / _MASS, 0.01 / _MASS
    values = (radius, extent, 0.02, thrust, saturation, drag, 0.3 / 0.095, 3.0, 0.5)
    numbers = _ZoneParameters(*map(np.float32, values))
    count = len(names) * _BINS + 11
    world = make_environment(
        Partial(_begin, places.astype(np.float32), np.zeros((num_zones, len(names)))),
        Partial(_move, numbers),
        Partial(_see, numbers),
        actions=make_box(-1, 1, (2,), np.float32),
        labels=Partial(_labels, numbers),
        propositions=names,
        observations=make_box(-np.inf, np.inf, (count,), np.float32),
    )
    return world if horizon is None else with_time_limit(world, horizon)


def draw_places(count: int, extent: float, num_maps: int, seed: int = 0) -> np.ndarray:
    """Random places of zones, and of the robot last, ``float64[M, count + 1, 2]``.

    Uniform with a keepout of .55 of a zone and .4 of the robot; maps without a place for all are
    dropped.
    """
    random, batches, rounds = np.random.default_rng(seed), [np.zeros((0, count + 1, 2))], 0
    while (have := sum(map(len, batches))) < num_maps:
        rounds += 1
        too_many = count * _KEEPOUT[0] ** 2 * np.pi > 4 * extent**2
        if (rounds > 4 and have < 2 * rounds) or too_many or extent <= _KEEPOUT[0]:
            raise ValueError(
                f"zone_world: {count} zones hardly fit into a square of {2 * extent} "
                "a side, apart from one another; take fewer, or a larger extent."
            )
        maps, good = np.zeros((512, count + 1, 2)), np.ones(512, bool)
        for i in range(count + 1):
            own = _KEEPOUT[i == count]
            tries = random.uniform(own - extent, extent - own, (512, 100, 1, 2))
            apart = np.linalg.norm(tries - maps[:, None, :i], axis=-1)
            free = (apart >= own + _KEEPOUT[0]).all(axis=-1)
            maps[:, i] = tries[np.arange(512), free.argmax(axis=1), 0]
            good &= free.any(axis=1)
        batches.append(maps[good])
    return np.concatenate(batches)[:num_maps]


# --- of one trajectory ----------------------------------------------------------------------------


def _begin(places: Array, each: Array, key: Key) -> ZoneState:
    zones, colors = each.shape
    bits = jax.random.bits(key, zones * colors + 3, jnp.uint32)
    drawn = jnp.asarray(places)[bits[0] % np.uint32(places.shape[0])]
    flip = (bits[1] >> np.arange(3, dtype=np.uint32)) & 1
    drawn = drawn * jnp.where(flip[:2], -1, 1)
    drawn = jnp.where(flip[2], drawn[:, ::-1], drawn).astype(jnp.float32)
    rank = (bits[3:, None] > bits[3:]).sum(axis=1)
    rank += ((bits[3:, None] == bits[3:]) & np.tri(zones * colors, k=-1, dtype=bool)).sum(axis=1)
    zone = drawn[:-1][rank].reshape(colors, zones, 2)
    heading = bits[2].astype(jnp.float32) * np.float32(2 * np.pi / 2**32)
    zero = jnp.zeros(2, jnp.float32)
    return ZoneState(drawn[-1], zero, heading, zero, jnp.float32(0), zone)


def _ahead(heading: jax.Array) -> jax.Array:
    return jnp.stack([jnp.cos(heading), jnp.sin(heading)])


def _move(n: _ZoneParameters, world: ZoneState, action: jax.Array, key: Key) -> Timestep:
    action = jnp.clip(action, -1, 1).astype(jnp.float32)
    turning = jnp.clip(n.turn * action[1], -n.most_turn, n.most_turn)
    heading = world.heading + turning * n.time_step
    thrust = n.thrust * jnp.clip(action[0] / n.saturation, -1, 1)
    toward = thrust / n.drag * _ahead(world.heading + turning * n.time_step / 2)
    decay = jnp.exp(-n.drag * n.time_step)
    velocity = toward + decay * (world.velocity - toward)
    place = world.place + n.time_step * toward + ((1 - decay) / n.drag * (world.velocity - toward))
    bound = n.extent - _ROBOT
    velocity = jnp.where(jnp.abs(place) > bound, 0, velocity)
    place = jnp.clip(place, -bound, bound)
    acceleration = (velocity - world.velocity) / n.time_step
    heading = heading % np.float32(2 * np.pi)
    return Timestep(
        ZoneState(place, velocity, heading, acceleration, turning, world.zone),
        0.0,
        jnp.bool_(False),
    )


def _own_frame(heading: jax.Array, vector: jax.Array) -> jax.Array:
    """``float[..., 2]`` in the frame of the robot: ahead, to the left."""
    x, y = _ahead(heading)
    return jnp.stack(
        [vector[..., 0] * x + vector[..., 1] * y, vector[..., 1] * x - vector[..., 0] * y], axis=-1
    )


def _lidar(n: _ZoneParameters, world: ZoneState) -> jax.Array:
    """``float32[P, 16]``: lidar with bin i at the i-th sixteenth of a turn to the left."""
    seen = _own_frame(world.heading, world.zone - world.place)
    proximity = jnp.exp(-n.gain * jnp.linalg.norm(seen, axis=-1))
    turn = jnp.arctan2(seen[..., 1], seen[..., 0]) / (2 * np.pi) * _BINS % _BINS
    bin_, bins = jnp.floor(turn), jnp.arange(_BINS)
    rest = (turn - bin_)[..., None]
    at = (bins - bin_[..., None]) % _BINS
    share = jnp.where(at == 0, 1, jnp.where(at == 1, rest, jnp.where(at == _BINS - 1, 1 - rest, 0)))
    return (proximity[..., None] * share).max(axis=-2).astype(jnp.float32)


def _see(n: _ZoneParameters, world: ZoneState) -> jax.Array:
    return jnp.concatenate(
        [
            _lidar(n, world).ravel(),
            _own_frame(world.heading, world.acceleration),
            _own_frame(world.heading, world.velocity),
            world.turning[None],
            _ahead(world.heading),
            jnp.exp(-n.gain * jnp.concatenate([n.extent - world.place, n.extent + world.place])),
        ]
    ).astype(jnp.float32)


def _labels(n: _ZoneParameters, world: ZoneState) -> jax.Array:
    return (jnp.sum((world.zone - world.place) ** 2, axis=-1) <= n.radius**2).any(axis=-1)
