"""ZoneWorld against the point's equations in small steps, and its sensors against slow ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.envs.zone_world import COLORS, ZoneState, draw_places, zone_world

MASS = 4 / 3 * np.pi * 0.1**3 + 0.1**3


def state(place, heading=0.0, velocity=(0, 0), zone=None):
    zone = np.full((4, 2, 2), 9.0) if zone is None else zone
    return ZoneState(
        *(jnp.asarray(x, jnp.float32) for x in (place, velocity, heading, (0, 0), 0, zone))
    )


def world():
    return zone_world(num_maps=64, horizon=None)


def integrated(place, velocity, heading, action, steps):
    """The point by 200 small steps for each of the world's."""
    place, velocity = np.array(place, float), np.array(velocity, float)
    thrust, turn = 0.3 * np.clip(action[0], -0.05, 0.05), np.clip(0.3 / 0.095 * action[1], -3, 3)
    for _ in range(200 * steps):
        ahead = np.array([np.cos(heading), np.sin(heading)])
        place = place + 1e-4 * velocity
        velocity = velocity + 1e-4 * (thrust * ahead - 0.01 * velocity) / MASS
        heading += 1e-4 * turn
    return place, velocity, heading


@pytest.mark.parametrize("action", [(1, 0), (0.02, 0.3), (-1, -1), (0, 0.5)])
def test_the_point_moves_by_its_equations(action):
    step = jax.jit(world().step)
    now, key = state((-1, 0.5), 1.0, (0.4, -0.2)), jax.random.key(0)
    for _ in range(50):
        now = step(now, jnp.array(action, jnp.float32), key).world
    place, velocity, heading = integrated((-1, 0.5), (0.4, -0.2), 1.0, action, 50)
    np.testing.assert_allclose(now.place, place, atol=2e-3)
    np.testing.assert_allclose(now.velocity, velocity, atol=2e-3)
    assert np.cos(float(now.heading) - heading) > 1 - 1e-6


def test_walls_stop_what_runs_into_them():
    step = jax.jit(world().step)
    now = state((2.0, 0), np.pi / 4)
    for _ in range(200):
        now = step(now, jnp.array([1, 0]), jax.random.key(0)).world
    assert now.place.tolist() == pytest.approx([2.4, 2.4]) and now.velocity.tolist() == [0, 0]


def slow_lidar(place, heading, zones):
    """Safety Gym's: by loops over what is there."""
    seen = np.zeros(16)
    for x, y in zones:
        z = (x - place[0] + 1j * (y - place[1])) * np.exp(-1j * heading)
        near, angle = np.exp(-abs(z) / 2), np.angle(z) % (2 * np.pi) / (2 * np.pi) * 16
        i = int(angle)
        share = angle - i
        for j, part in ((i, 1), ((i + 1) % 16, share), ((i - 1) % 16, 1 - share)):
            seen[j] = max(seen[j], part * near)
    return seen


def test_what_the_robot_sees():
    made = world()
    keys = jax.random.split(jax.random.key(1), 40)

    @jax.jit
    def moved(keys, push):
        found = jax.vmap(made.step)(jax.vmap(made.reset)(keys), push, keys).world
        return found, jax.vmap(made.observe)(found), jax.vmap(made.labels)(found)

    found, seen, labels = jax.tree.map(
        np.asarray, moved(keys, jax.random.uniform(keys[0], (40, 2), minval=-1))
    )
    for i in range(40):
        one = jax.tree.map(lambda x, i=i: np.asarray(x[i], float), found)
        lidar = [slow_lidar(one.place, one.heading, zones) for zones in one.zone]
        np.testing.assert_allclose(seen[i][:64].reshape(4, 16), lidar, atol=1e-4)
        back = np.array(
            [
                [np.cos(one.heading), np.sin(one.heading)],
                [-np.sin(one.heading), np.cos(one.heading)],
            ]
        )
        walls = np.exp(
            -0.5
            * np.array(
                [2.5 - one.place[0], 2.5 - one.place[1], 2.5 + one.place[0], 2.5 + one.place[1]]
            )
        )
        np.testing.assert_allclose(
            seen[i][64:],
            np.concatenate(
                [back @ one.acceleration, back @ one.velocity, [one.turning], back[0], walls]
            ),
            atol=1e-4,
        )
        apart = np.linalg.norm(one.zone - one.place, axis=-1)
        assert labels[i].tolist() == (apart <= 0.4).any(axis=1).tolist()
    inside = state((0, 0), zone=np.array([[[9, 9], [0.3, 0]], [[0.3, 0.3], [9, 9]]] * 2))
    assert made.labels(inside).tolist() == [True, False, True, False]


@pytest.mark.slow
def test_zones_and_robot_are_apart():
    places = draw_places(8, 2.5, 50)
    states = jax.vmap(world().reset)(jax.random.split(jax.random.key(2), 300))
    drawn = np.concatenate(
        [np.asarray(states.zone).reshape(300, 8, 2), np.asarray(states.place)[:, None]], axis=1
    )
    for some in (places, drawn):
        gaps = np.linalg.norm(some[:, :, None] - some[:, None], axis=-1)
        gaps += 9 * np.eye(9)
        assert gaps[:, :8, :8].min() >= 1.1 - 1e-5 and gaps[:, 8].min() >= 0.95 - 1e-5
        assert np.abs(some[:, :8]).max() <= 1.95 + 1e-5 and np.abs(some[:, 8]).max() <= 2.1 + 1e-5
    assert len(np.unique(drawn[:, 8].round(4), axis=0)) > 150
    # A colour's zones are anywhere, and headings too.
    assert (np.abs(np.asarray(states.zone).mean(axis=(0, 2))) < 0.3).all()
    assert np.histogram(states.heading, bins=4, range=(0, 2 * np.pi))[0].min() > 45
    assert world().propositions == COLORS


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"radius": 0}, "radius=0; it must be positive"),
        ({"colors": ()}, "colors=0"),
        ({"num_zones": 9}, "hardly fit"),
        ({"num_zones": 4}, "hardly fit"),
        ({"extent": 0.5}, "hardly fit"),
        ({"colors": ("red", "red")}, "'red' is not a string, or occurs twice"),
    ],
)
def test_what_does_not_fit_is_named(options, said):
    with pytest.raises(ValueError, match=said):
        zone_world(**{"num_maps": 8} | options)
