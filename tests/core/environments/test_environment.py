"""The protocol of simulated worlds: what is checked, how episodes run and end."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from jaxltl.core.environments.environment import (
    Box,
    Environment,
    Finite,
    Timestep,
    allowed_in,
    make_box,
    make_environment,
    some_action,
)
from jaxltl.core.environments.episodes import (
    Agent,
    auto_reset_step,
    make_agent,
    run_episode,
    with_time_limit,
)
from tests.support import random_action


def reset(length, key):
    return jax.random.randint(key, (), 0, length // 2, jnp.int32)


def step(length, place, action, key):
    slip = jax.random.bernoulli(key, 0.25)
    after = jnp.clip(place + jnp.where(slip, 0, 2 * action - 1), 0, length)
    return Timestep(
        after,
        reward=after / length,
        terminated=after == length,
        truncated=after == 0,
        cost=jnp.where(slip, 1.0, 0.0),
        discount=jnp.where(slip, 1.0, 0.5),
    )


def observe(length, place):
    return {"share": (place / length)[None], "place": place}


def labels(length, place):
    return jnp.array([place == 0, place == length])


def allowed(length, place):
    return jnp.array([place > 1, True])


def corridor(length=6, **changes):
    parts = {
        name: Partial(f, jnp.int32(length))
        for name, f in (
            ("reset", reset),
            ("step", step),
            ("observe", observe),
            ("labels", labels),
            ("allowed", allowed),
        )
    }
    return make_environment(**{**parts, "actions": 2, "propositions": ["home", "goal"], **changes})


def plain_step(place, action, key):
    return Timestep(place + action, 0.0, False)


WORLD = {
    "reset": lambda key: jnp.int32(0),
    "step": plain_step,
    "observe": lambda place: place[None],
    "actions": 2,
}


def made(**changes):
    return make_environment(**{**WORLD, **changes})


def test_what_is_made():
    world = corridor()
    assert world.actions == Finite(2) and world.propositions == ("home", "goal")
    assert world.observations["share"].shape == (1,)
    assert world.observations["place"].dtype == "int32"
    assert float(world.observations["share"].low) == -np.inf
    bare = made()
    assert bare.labels(jnp.int32(0)).shape == (0,) and allowed_in(bare, 0) is None
    assert made(
        actions=make_box(-1, 1, [2]),
        step=lambda place, action, key: Timestep(
            place + action.sum().astype(jnp.int32), 0.0, False
        ),
    ).actions.shape == (2,)


# --- bad input ------------------------------------------------------------------------------------

SEEN = []


def remembers(place, action, key):
    SEEN.append(place)
    return Timestep(place, 0.0, False)


def draws_by_itself(place, action, key):
    return Timestep(place + np.random.default_rng().integers(1 << 30), 0.0, False)


def branches(place, action, key):
    return Timestep(place + 1 if action == 0 else place, 0.0, False)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"propositions": ["a"]}, "no labels"),
        ({"propositions": ["a", "a"], "labels": lambda place: jnp.zeros(2, bool)}, "occurs twice"),
        ({"propositions": [3]}, "3 is not a string"),
        ({"labels": lambda place: jnp.zeros(2, bool), "propositions": ["a"]}, r"return bool\[1\]"),
        ({"labels": lambda place: jnp.zeros(1), "propositions": ["a"]}, r"float64\[1\]"),
        (
            {"labels": lambda place: place == 0, "propositions": ["a"]},
            r"bool\[\]; return bool\[1\]",
        ),
        ({"horizon": 0}, "horizon=0"),
        ({"actions": 0}, r"Finite\(0\)"),
        ({"actions": "two"}, "give Finite"),
        ({"actions": True}, None),
        ({"observe": lambda place: ()}, "observe returns no array"),
        ({"observations": make_box(0, 1, [3])}, r"observations is of float64\[3\]"),
        ({"step": lambda place, action, key: (place, 0.0)}, "step must return Timestep"),
        (
            {"step": lambda place, action, key: Timestep(place, jnp.zeros(3), False)},
            r"reward of shape \[3\]",
        ),
        ({"step": lambda place, action, key: Timestep(place, 0.0, 1.0)}, "return a Boolean"),
        (
            {"step": lambda place, action, key: Timestep(place * 1.0, 0.0, False)},
            "the same structure",
        ),
        ({"allowed": lambda place: jnp.ones(3, bool)}, "allowed"),
        ({"allowed": lambda place: jnp.ones(2)}, "return Booleans"),
        (
            {
                "allowed": lambda place: jnp.ones(2, bool),
                "actions": make_box(0, 1),
                "step": lambda place, action, key: Timestep(place, action, False),
            },
            "clip those of a box",
        ),
        pytest.param({"step": remembers}, "step is not pure: it keeps", marks=pytest.mark.slow),
        ({"step": draws_by_itself}, "step is not pure: called twice"),
        ({"step": branches}, "step cannot be traced"),
    ],
)
def test_bad_worlds_are_named(changes, text):
    if text is None:  # a number in disguise
        assert made(**changes).actions == Finite(1)
        return
    with pytest.raises(ValueError, match=text):
        made(**changes)


def test_a_step_may_leave_out_what_has_a_default():
    def short(place, action, key):
        return place, 1.0, place == 3

    episode = run_episode(
        jax.random.key(0), made(step=short), make_agent(lambda seen, key: 0), num_steps=2
    )
    assert episode.discount.tolist() == [1, 1] and episode.cost.tolist() == [0, 0]


def test_worlds_are_made_of_traced_arrays_too():
    @jax.jit
    def length(n):
        return corridor(n).reset(jax.random.key(0)) < n

    assert bool(length(jnp.int32(4)))


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((1, 0), "low is above high"),
        ((0, [1, np.nan]), "give numbers"),
        (([0, 0], [1, 1, 1]), "do not fit"),
        ((0, [1, 1], [3]), r"the shape \[3\]"),
        (("a", 1), "give numbers"),
        (([0, 2], [1, 1]), r"at \[1\]"),
    ],
)
def test_bad_boxes_are_named(arguments, text):
    with pytest.raises(ValueError, match=text):
        make_box(*arguments)


def test_a_box_of_integers_has_their_bounds():
    found = make_box(-np.inf, np.inf, (2,), jnp.int32)
    assert found.low == jnp.iinfo(jnp.int32).min and found.high.dtype == np.int32
    assert make_box(-np.inf, np.inf, (), jnp.int64).high == jnp.iinfo(jnp.int64).max
    assert make_box([0, -5], 7, dtype=jnp.int64).low.tolist() == [0, -5]
    assert isinstance(found, Box) and some_action(found).shape == (2,)


# --- actions --------------------------------------------------------------------------------------


def test_random_actions_are_those_that_may_be_taken():
    keys = jax.random.split(jax.random.key(1), 200)
    drawn = jax.vmap(lambda key: random_action(key, Finite(3), jnp.array([1, 0, 1], bool)))(keys)
    assert np.bincount(drawn, minlength=3)[[0, 2]].min() > 60 and 1 not in drawn
    assert set(jax.vmap(lambda key: random_action(key, Finite(3)))(keys).tolist()) == {0, 1, 2}
    space = make_box([-1, 0, -np.inf], [1, np.inf, np.inf])
    some = np.asarray(jax.vmap(lambda key: random_action(key, space))(keys))
    assert some.shape == (200, 3) and (some >= space.low).all() and (some[:, 0] <= 1).all()
    assert some[:, 2].min() < 0 and np.abs(some[:, 0].mean()) < 0.2


# --- episodes -------------------------------------------------------------------------------------


def seeks(share, memory, observation, allowed, key):
    """Goes right so often, left where it may; it counts its steps."""
    right = jax.random.bernoulli(key, share) | ~allowed[0]
    return right.astype(jnp.int32), memory + 1


def by_hand(key, environment, agent, num_steps):
    """An episode, one call after the other."""
    start, path = jax.random.split(key)
    world, memory, rows = environment.reset(start), agent.memory, []
    for time in range(num_steps):
        act, move = jax.random.split(jax.random.fold_in(path, time))
        mask = allowed_in(environment, world)
        action, memory = agent.act(memory, environment.observe(world), mask, act)
        found = environment.step(world, action, move)
        rows.append(
            (
                int(world),
                int(action),
                *map(float, (found.reward, found.cost, found.discount)),
                *map(bool, found[2:4]),
            )
        )
        world = found.world
        if rows[-1][-1] or rows[-1][-2]:
            break
    return rows, int(world)


def test_an_episode_is_its_steps_one_by_one():
    environment, agent = corridor(), Agent(Partial(seeks, 0.7), jnp.int32(0))
    ends = set()
    episodes = jax.jit(jax.vmap(partial(run_episode, num_steps=8), (0, None, None)))
    keys = jax.random.split(jax.random.key(3), 24)
    found = jax.tree.map(np.asarray, episodes(keys, environment, agent))
    for i, key in enumerate(keys):
        rows, last = by_hand(key, environment, agent, 8)
        count = len(rows)
        lane = jax.tree.map(lambda x, i=i: x[i], found)
        world, action, reward, cost, discount, terminated, truncated = zip(*rows, strict=True)
        assert lane.valid.tolist() == [t < count for t in range(8)]
        assert lane.world.tolist() == [*world, *[last] * (9 - count)]
        assert lane.action[:count].tolist() == list(action)
        for name, values, rest in (
            ("reward", reward, 0),
            ("cost", cost, 0),
            ("discount", discount, 1),
        ):
            row = getattr(lane, name)
            np.testing.assert_allclose(row, [*values, *[rest] * (8 - count)], err_msg=name)
        assert (bool(lane.terminated), bool(lane.truncated)) == (terminated[-1], truncated[-1])
        assert lane.label.tolist() == [[w == 0, w == 6] for w in lane.world]
        np.testing.assert_allclose(lane.observation["share"][:, 0], lane.world[:-1] / 6)
        ends.add((terminated[-1], truncated[-1]))
    assert ends == {(True, False), (False, True), (False, False)}


def test_episodes_need_a_step():
    for run in (
        partial(run_episode, jax.random.key(0), corridor(), make_agent(lambda o, k: 0)),
        partial(with_time_limit, corridor()),
    ):
        with pytest.raises(ValueError, match="num_steps=0"):
            run(num_steps=0)


def test_new_numbers_do_not_recompile():
    count = 0

    @jax.jit
    def total(environment, key):
        nonlocal count
        count += 1
        agent = Agent(Partial(seeks, 0.7), jnp.int32(0))
        return run_episode(key, environment, agent, num_steps=4).reward.sum()

    values = [float(total(corridor(n), jax.random.key(0))) for n in (6, 8)]
    assert count == 1 and values[0] != values[1]


def test_a_step_or_a_fresh_start():
    environment = corridor()

    @jax.vmap
    def both(place, action, key):
        world, found = auto_reset_step(key, environment, place, action)
        step_key, reset_key = jax.random.split(key)
        return world, found, environment.step(place, action, step_key), environment.reset(reset_key)

    keys = jax.random.split(jax.random.key(5), 40)
    world, found, expected, fresh = jax.tree.map(
        np.asarray, both(jnp.arange(40) % 5 + 1, jnp.arange(40) % 2, keys)
    )
    for x, y in zip(found, expected, strict=True):
        np.testing.assert_array_equal(x, y)
    over = expected.terminated | expected.truncated
    assert expected.terminated.any() and expected.truncated.any() and not over.all()
    np.testing.assert_array_equal(world, np.where(over, fresh, expected.world))


def test_a_time_limit_truncates():
    environment = with_time_limit(corridor(), 3)
    assert environment.horizon == 3 and with_time_limit(environment, 5).horizon == 3
    assert isinstance(environment, Environment)
    world, terminated = (jnp.int32(4), jnp.int32(0)), False
    for time, key in enumerate(jax.random.split(jax.random.key(0), 3), 1):
        inner = corridor().step(world[0], jnp.int32(1), key)
        assert environment.allowed(world).tolist() == [True, True]
        assert environment.labels(world).tolist() == corridor().labels(world[0]).tolist()
        found = environment.step(world, jnp.int32(1), key)
        assert bool(found.truncated) == (time == 3) and found.world[1] == time
        assert found.terminated == inner.terminated and found.world[0] == inner.world
        assert found.discount == inner.discount
        world = found.world
        terminated |= bool(found.terminated)
    assert terminated, "both may hold"


def test_agents_of_functions_obey_masks():
    """Actions that are not available become the first available one; or the function reads the mask."""
    mask = jnp.array([False, True, True])

    def reads(seen, key, allowed=None):
        return 0 if allowed is None else jnp.argmin(allowed) + 2

    cases = [(lambda seen, key: 0, 1), (lambda seen, key: jnp.int32(2), 2), (reads, 2)]
    for function, chosen in cases:
        agent = make_agent(function)
        action, _ = jax.jit(agent.act)((), jnp.zeros(2), mask, jax.random.key(0))
        assert int(action) == chosen
    assert make_agent(reads).act((), None, None, None)[0] == 0
    never = jnp.zeros(3, bool)
    assert int(make_agent(lambda seen, key: 2).act((), None, never, None)[0]) == 2
    outside = make_agent(lambda seen, key: 7)  # which the environment reports
    assert int(outside.act((), None, mask, None)[0]) == 7
