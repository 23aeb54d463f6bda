"""FlatWorld against a slow world of its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.envs.flat_world import DISCS, discs_of, events_around, flat_world

NAMES = ("aqua", "blue", "green", "magenta", "orange", "red", "yellow")


def colors_at(place):
    return [
        any(
            name == color and np.hypot(place[0] - x, place[1] - y) < radius
            for color, x, y, radius in DISCS
        )
        for name in NAMES
    ]


def test_steps_and_colours_are_the_slow_worlds():
    world = flat_world(horizon=40)
    keys = jax.random.split(jax.random.key(0), 60)
    states = jax.vmap(world.reset)(keys)
    actions = np.random.default_rng(1).uniform(-1.5, 1.5, (40, 60, 2)).astype(np.float32)
    actions += np.random.default_rng(2).uniform(-1, 1, (60, 2)).astype(np.float32)
    step, labels = (jax.jit(jax.vmap(f)) for f in (world.step, world.labels))
    places, met, ended = np.array(states[0].place, float), set(), 0
    assert not np.asarray(labels(states)).any()
    for number, row in enumerate(actions):
        found = step(states, row, keys)
        places = places + 0.08 * np.clip(row, -1, 1)
        np.testing.assert_allclose(found.world[0].place, places, atol=1e-5)
        out = (np.abs(places) > 2).any(axis=1)
        assert (np.asarray(found.terminated) == out).all()
        assert (np.asarray(found.reward) == -out.astype(float)).all()
        assert (np.asarray(found.truncated) == (number == 39)).all()
        shown = np.asarray(labels(found.world))
        edge = np.min([np.abs(np.hypot(*(places - [x, y]).T) - r) for _, x, y, r in DISCS], axis=0)
        for place, label, near in zip(places, shown, edge, strict=True):
            if near > 1e-4:
                assert label.tolist() == colors_at(place)
            met.add(tuple(label.tolist()))
        ended += out.sum()
        states, places = found.world, np.array(found.world[0].place, float)
    assert ended and any(sum(x) > 1 for x in met)
    assert world.propositions == NAMES
    assert np.asarray(discs_of(world).color).sum(axis=0).tolist() == [1, 1, 2, 1, 1, 2, 1]


@pytest.mark.slow
def test_episodes_begin_anywhere_outside_of_the_discs():
    world = flat_world()
    places = np.asarray(jax.vmap(world.reset)(jax.random.split(jax.random.key(3), 4000))[0].place)
    assert (np.abs(places) <= 2).all() and not any(any(colors_at(x)) for x in places)
    random = np.random.default_rng(4).uniform(-2, 2, (20_000, 2))
    free = random[[not any(colors_at(x)) for x in random]]
    for one, other in zip(
        np.histogram2d(*places.T, bins=4, range=[(-2, 2)] * 2)[0].ravel(),
        np.histogram2d(*free.T, bins=4, range=[(-2, 2)] * 2)[0].ravel(),
        strict=True,
    ):
        expected = other * 4000 / len(free)
        assert abs(one - expected) < 6 * np.sqrt(expected + 4)
    at = flat_world(initial=(0.5, 0.7), horizon=None)
    assert at.labels(at.reset(jax.random.key(0))).tolist() == [
        False,
        False,
        True,
        False,
        False,
        False,
        False,
    ]


def test_nine_directions():
    world = flat_world(discrete=True, horizon=None, initial=(0, -1.9))
    here = world.reset(jax.random.key(0))
    after = jax.vmap(lambda a: world.step(here, a, jax.random.key(0)).world.place)(jnp.arange(9))
    moves = (np.asarray(after) - [0, -1.9]) / 0.08
    np.testing.assert_allclose(np.linalg.norm(moves, axis=1), [1] * 8 + [0], atol=1e-4)
    assert len(np.unique(moves.round(2), axis=0)) == 9


def test_events_around_a_place_are_those_of_the_slow_world():
    world, radii = flat_world(), (0.3, 1.1)
    events = np.unique(
        [colors_at(x) for x in np.random.default_rng(5).uniform(-2, 2, (5000, 2))], axis=0
    )
    look = events_around(world, events, radii=radii, num_directions=6)
    assert look == events_around(world, events, radii=radii, num_directions=6) and hash(look)
    places = np.random.default_rng(6).uniform(-2, 2, (40, 2)).astype(np.float32)
    found, met = np.asarray(jax.jit(jax.vmap(look))(places)), 0
    assert found.shape == (40, 13, len(events))
    turn = np.arange(6) * np.pi / 3
    for place, seen in zip(places, found, strict=True):
        there = [
            place,
            *(place + r * np.array([np.cos(t), np.sin(t)]) for r in radii for t in turn),
        ]
        for x, row in zip(there, seen, strict=True):
            if (np.abs(x) > 2).any():
                assert not row.any()
            else:
                met += row[1:].any()
                assert events[row.astype(bool)].tolist() == [colors_at(x)]
    assert met > 50


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"discs": []}, "at least one"),
        ({"discs": [("red", 0, 0, 0)]}, "radii above zero"),
        ({"time_step": 0}, "must be positive"),
        ({"initial": (3, 0)}, "within 2.0 of the middle"),
        ({"discs": [("red", 0, 0, 9)]}, "hardly leave a place"),
        ({"num_starts": 0}, "num_starts=0"),
    ],
)
def test_what_does_not_fit_is_named(options, said):
    with pytest.raises(ValueError, match=said):
        flat_world(**options)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"events": [[True]]}, "a column for each colour"),
        ({"radii": [0.1, -1]}, "all positive"),
        ({"num_directions": 0}, "num_directions=0"),
    ],
)
def test_what_cannot_be_seen_around_is_named(options, said):
    with pytest.raises(ValueError, match=said):
        events_around(flat_world(), **{"events": np.eye(7, dtype=bool), **options})
