"""Worlds whose task is a drawn sequence, against a slow reading of the same events."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.environments.environment import Timestep, make_environment
from jaxltl.core.environments.episodes import make_agent, run_episode
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.environments.sequence_task import (
    draw_sequence,
    make_events,
    nearest_event,
    proposition_sets,
    remaining,
    sequence_environment,
    sequence_sampler,
)

NAMES = ("a", "b", "c")
EVENTS = make_events(NAMES)
SAMPLER = sequence_sampler([1, 1, 1], [2, 1], [1, 1], [False, True, True, True])
STEPS = 12


def letters_at_random():
    """Every step shows one of the events at random."""

    def step(event, action, key):
        return Timestep(jax.random.randint(key, (), 0, 4), reward=7.0, terminated=False)

    return make_environment(
        lambda key: jax.random.randint(key, (), 0, 4),
        step,
        lambda event: event[None] * 1.0,
        actions=2,
        labels=lambda event: jnp.asarray(EVENTS)[event],
        propositions=NAMES,
    )


@pytest.fixture(scope="module")
def episodes():
    world = sequence_environment(
        letters_at_random(), EVENTS, SAMPLER, violation=-0.5, progress=0.25
    )

    def one(key):
        return run_episode(key, world, make_agent(lambda seen, key: 0), num_steps=STEPS)

    keys = jax.random.split(jax.random.key(3), 200)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(keys))


def test_episodes_are_what_a_slow_reading_says(episodes):
    world = episodes.world
    for n in range(200):
        reach, avoid = world.sequence.reach[n, 0], world.sequence.avoid[n, 0]
        length, index = int(world.sequence.length[n, 0]), int(world.stage[n, 0])
        verdict = Verdict.UNDECIDED
        for t in range(STEPS):
            over = verdict != Verdict.UNDECIDED
            assert episodes.valid[n, t] == (not over)
            if over:
                continue
            event, earned = world.world[n, t + 1], 0.0
            if avoid[index, event]:
                verdict, earned = Verdict.VIOLATED, -0.5
            elif reach[index, event]:
                index, earned = index + 1, 0.25 / length
                if index == length:
                    verdict, earned = Verdict.SATISFIED, earned + 1
            assert episodes.reward[n, t] == pytest.approx(earned)
            assert (world.stage[n, t + 1], world.verdict[n, t + 1]) == (index, verdict)
        assert episodes.terminated[n] == (verdict != Verdict.UNDECIDED)
    assert {0, 1, 2} == set(world.verdict[:, -1].tolist())


def test_what_is_observed_is_what_is_left(episodes):
    seen, world = episodes.observation.sequence, episodes.world
    for n, t in np.argwhere(episodes.valid):
        index = world.stage[n, t]
        assert (seen.reach[n, t, : 3 - index] == world.sequence.reach[n, 0, index:]).all()
        assert not seen.reach[n, t, 3 - index :].any()
        assert seen.length[n, t] == world.sequence.length[n, 0] - index
    drawn = draw_sequence(jax.random.key(0), SAMPLER)
    assert not np.asarray(remaining(drawn, drawn.length).reach).any()


@pytest.mark.slow
def test_what_is_drawn_has_the_weights_asked_for():
    drawn = jax.vmap(draw_sequence, (0, None))(jax.random.split(jax.random.key(1), 3000), SAMPLER)
    reach, avoid, length = map(np.asarray, drawn)
    assert not (reach & avoid).any() and not (reach | avoid)[..., 0].any()
    asked = np.arange(3) < length[:, None]
    assert (reach.any(-1) == asked).all() and not avoid[~asked].any()
    share = np.bincount(length, minlength=4)[1:] / 3000
    assert abs(share - 1 / 3).max() < 0.04
    assert abs((reach.sum(-1)[asked] == 2).mean() - 1 / 3) < 0.03
    assert abs((avoid[:, 0].sum(-1) == 1).mean() - 1 / 2) < 0.03
    assert not (avoid[:, 1:] & reach[:, :-1]).any()  # what has just happened is not avoided


@pytest.mark.slow
def test_sets_of_events_are_drawn_whole():
    events = make_events(NAMES, 2)
    sampler = sequence_sampler([1, 1], [1, 1], [0, 1], proposition_sets(events))
    drawn = jax.vmap(draw_sequence, (0, None))(jax.random.split(jax.random.key(2), 500), sampler)
    sets = proposition_sets(events)

    def union(parts, of):
        inside = [part for part in parts if not (part & ~of).any()]
        return np.any([*inside, np.zeros_like(of)], 0)

    for reach, avoid in zip(np.asarray(drawn.reach), np.asarray(drawn.avoid), strict=True):
        (before, wanted), shunned = reach, avoid[1]
        assert (union(sets, wanted) == wanted).all()
        free = [part & ~wanted for part in sets if not (part & before).any()]
        assert (union(free, shunned) == shunned).all()


def test_events_are_told_by_their_labels():
    assert [int(nearest_event(EVENTS, row)) for row in EVENTS] == [0, 1, 2, 3]
    assert make_events(NAMES, 3).shape == (8, 3)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"length": [0, 0]}, "length="),
        ({"reach": [-1]}, "reach="),
        ({"avoid": [np.nan]}, "avoid="),
        ({"sets": [1, 0]}, "sets has type"),
        ({"avoid": [0, 0, 0, 1]}, "up to 5 sets"),
        ({"sets": [[True], [False]]}, "row 1 has no event"),
    ],
)
def test_bad_samplers_are_named(given, said):
    weights = {"length": [1], "reach": [1, 1], "avoid": [1], "sets": [False, True, True, True]}
    with pytest.raises(ValueError, match=said):
        sequence_sampler(**{**weights, **given})


def test_events_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match="a column for each"):
        sequence_environment(letters_at_random(), EVENTS[:, :2], SAMPLER)
    with pytest.raises(ValueError, match="of 4 events, but 2"):
        sequence_environment(letters_at_random(), EVENTS[:2], SAMPLER)


def test_starts_of_the_inner_world_are_not_those_of_sequences_and_discounts_are_kept():
    inner = make_environment(
        lambda key: jnp.int32(0),
        lambda place, action, key: Timestep(place, 0.0, False, discount=0.5),
        lambda place: place[None],
        actions=2,
        labels=lambda place: place[None] > 0,
        propositions=["a"],
        starts=lambda: (jnp.zeros(1, jnp.int32), jnp.ones(1)),
    )
    events = make_events(["a"])
    sampler = sequence_sampler([1], [1], [1], [False, True])
    made = sequence_environment(inner, events, sampler)
    assert made.starts is None and made.outcomes is None
    world = made.reset(jax.random.key(0))
    assert float(made.step(world, 0, jax.random.key(0)).discount) == 0.5
