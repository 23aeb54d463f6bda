"""Listed worlds against the models that they are of, and against a search by a queue."""

import importlib
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from jaxltl.core.environments.environment import Timestep, make_box, make_environment, reads_key
from jaxltl.core.environments.episodes import with_time_limit, without_time_limit
from jaxltl.core.environments.tabulate import tabulate
from jaxltl.envs.letter_world import letter_world

S, A, K = 12, 3, 4


class Random(NamedTuple):
    """A random process: ``successor[S, A, K]`` with ``probability``, in which some states end."""

    successor: np.ndarray
    probability: np.ndarray
    reward: np.ndarray
    allowed: np.ndarray
    over: np.ndarray  # 1: terminates where it is entered, 2: truncates
    initial: np.ndarray


def random_process(seed):
    random = np.random.default_rng(seed)
    probability = random.dirichlet(np.ones(K), (S, A))
    probability[..., 1] = 0
    probability /= probability.sum(-1, keepdims=True)
    allowed = random.random((S, A)) < 0.7
    allowed[np.arange(S), random.integers(A, size=S)] = True
    initial = random.dirichlet(np.ones(S)) * (random.random(S) < 0.4)
    initial[0] += 0.1
    over = random.choice(3, size=S, p=[0.6, 0.2, 0.2])
    return Random(
        random.integers(S, size=(S, A, K)),
        probability,
        random.normal(size=(S, A, K)),
        allowed,
        over,
        initial / initial.sum(),
    )


def simulated(p, told=True, **changes):
    """The process as a world of a state and of minus zeros."""

    def world(state):
        return {"state": state, "rest": jnp.where(state % 2 == 0, 0.0, -0.0)}

    def finish(successor, reward):
        over = jnp.asarray(p.over)[successor]
        return Timestep(world(successor), reward, over == 1, over == 2, cost=reward**2)

    def step(x, action, key):
        k = jax.random.categorical(key, jnp.log(jnp.asarray(p.probability)[x["state"], action]))
        return finish(
            jnp.asarray(p.successor)[x["state"], action, k],
            jnp.asarray(p.reward)[x["state"], action, k],
        )

    def outcomes(x, action):
        at = x["state"], action
        return jax.vmap(finish)(jnp.asarray(p.successor)[at], jnp.asarray(p.reward)[at]), (
            jnp.asarray(p.probability)[at]
        )

    def starts():
        return jax.vmap(world)(jnp.arange(S)), jnp.asarray(p.initial)

    parts = {"starts": starts, "outcomes": outcomes} if told else {}
    return make_environment(
        lambda key: world(jax.random.categorical(key, jnp.log(jnp.asarray(p.initial)))),
        step,
        lambda x: x["state"] / S,
        actions=A,
        labels=lambda x: x["state"] % 3 == jnp.arange(2),
        propositions=["zero", "one"],
        allowed=lambda x: jnp.asarray(p.allowed)[x["state"]],
        **(parts | changes),
    )


def reference(p):
    """By a queue: pairs of a state and how it ended, with their rows."""
    queue = [(s, 0) for s in range(S) if p.initial[s] > 0]
    rows, seen = {}, set(queue)
    while queue:
        s, over = pair = queue.pop()
        if over:
            rows[pair, 0] = {pair: (1.0, 0.0)}
            continue
        for a in np.flatnonzero(p.allowed[s]):
            row = rows[pair, int(a)] = {}
            for t, w, r in zip(p.successor[s, a], p.probability[s, a], p.reward[s, a], strict=True):
                if w > 0:
                    after = int(t), int(p.over[t])
                    before, gained = row.get(after, (0.0, 0.0))
                    row[after] = before + w, gained + w * r
                    if after not in seen:
                        seen.add(after)
                        queue.append(after)
    return seen, rows


def as_pairs(table):
    over = np.where(table.terminated, 1, np.where(table.truncated, 2, 0))
    return list(zip(np.asarray(table.world["state"]).tolist(), over.tolist(), strict=True))


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", range(6))
def test_a_told_world_is_its_process(seed):
    p = random_process(seed)
    table = tabulate(simulated(p))
    model, pairs = table.model, as_pairs(table)
    seen, rows = reference(p)
    assert set(pairs) == seen and len(pairs) == len(seen) == model.num_states
    found = {}
    for s in range(model.num_states):
        for r in range(model.row_start[s], model.row_start[s + 1]):
            entries = range(model.entry_start[r], model.entry_start[r + 1])
            found[pairs[s], int(model.action[r])] = {
                pairs[model.successor[e]]: (
                    model.probability[e],
                    model.probability[e] * model.rewards["reward"].transition[e],
                )
                for e in entries
            }
    assert found.keys() == rows.keys()
    for name, row in rows.items():
        assert found[name].keys() == row.keys()
        for after, expected in row.items():
            np.testing.assert_allclose(found[name][after], expected, atol=1e-12)
    assert model.propositions == ("zero", "one")
    assert model.label.tolist() == [[s % 3 == 0, s % 3 == 1] for s, _ in pairs]
    initial = [p.initial[s] if over == 0 else 0 for s, over in pairs]
    np.testing.assert_allclose(model.initial, initial, atol=1e-12)
    assert table.evidence == "declared" and table.num_steps is None


@pytest.mark.slow
def test_a_map_of_letters_is_a_torus_whose_program_reads_no_key():
    cells = np.full((4, 4), -1)
    cells[0, 1], cells[2, 3], cells[3, 0] = 0, 1, 0
    world = letter_world(layout=cells, letters=2)
    table = tabulate(world)
    place = np.asarray(table.world.place)
    assert sorted(place) == list(range(16)) and table.num_steps == 75
    model = table.model
    assert np.diff(model.row_start).tolist() == [4] * 16
    assert np.diff(model.entry_start).tolist() == [1] * 64
    row, column = np.divmod(np.repeat(place, 4), 4)
    down, right = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])[model.action].T
    after = (row + down) % 4 * 4 + (column + right) % 4
    assert (place[model.successor] == after).all()
    assert (model.label == (cells.ravel()[place][:, None] == np.arange(2))).all()
    assert len(table.start) == 13 and table.evidence == "declared"
    one = tabulate(letter_world(layout=cells, letters=2, initial=0))
    assert one.model.initial[one.start].tolist() == [1]


@pytest.mark.slow
def test_maps_side_by_side():
    world = letter_world(size=5, letters=3)
    drawn = jax.vmap(world.reset)(jax.random.split(jax.random.key(0), 7))
    table = tabulate(world, worlds=drawn)
    assert table.model.num_states == 7 * 25 and table.evidence == "keyless"
    assert (np.asarray(table.world.letter)[table.start] == drawn[0].letter).all()
    np.testing.assert_allclose(table.model.initial[table.start], 1 / 7)
    again = tabulate(world, worlds=drawn[0])  # the clock may be left out
    assert (again.model.successor == table.model.successor).all()
    twice = tabulate(world, worlds=jax.tree.map(lambda x: x[jnp.array([0, 0, 1])], drawn))
    np.testing.assert_allclose(twice.model.initial[:2], [2 / 3, 1 / 3])


def test_time_limits_come_off_and_go_on():
    p = random_process(3)
    inner = simulated(p)
    timed = with_time_limit(inner, 9)
    found, limit = without_time_limit(timed)
    assert limit == 9 and without_time_limit(inner) == (inner, None)
    table, plain = tabulate(timed), tabulate(found)
    assert table.num_steps == 9 and plain.num_steps is None
    assert (table.model.successor == plain.model.successor).all()
    worlds, probability = timed.starts()
    assert worlds[1].tolist() == [0] * S and probability.shape == (S,)
    told, _ = timed.outcomes(jax.tree.map(lambda x: x[0], worlds), 0)
    assert told.world[1].tolist() == [1] * K
    last, _ = timed.outcomes(({"state": jnp.int64(0), "rest": jnp.float64(0)}, jnp.int32(8)), 0)
    assert last.truncated.all()


def counter(step, **options):
    return make_environment(lambda key: jnp.int32(0), step, lambda x: x / 2, actions=2, **options)


def test_what_depends_on_a_key():
    key = jax.random.key(0)
    jitted = jax.jit(lambda x, key: (x, x + jax.random.normal(key)))
    assert reads_key(lambda x, key: jitted(x, key)[1], 0.0, key)
    assert not reads_key(lambda x, key: jitted(x, key)[0], 0.0, key)
    assert not reads_key(lambda x, key: (jax.random.split(key), x)[1], 0.0, key)
    assert reads_key(
        lambda x, key: jax.lax.fori_loop(0, 2, lambda i, y: y + jax.random.normal(key), x), 0.0, key
    )
    reads = tabulate(
        counter(
            lambda x, a, key: Timestep(
                jnp.clip(x + a + (jax.random.uniform(key) > 2), 0, 3), 0.0, x == 2
            )
        )
    )
    assert reads.evidence == "keys" and reads.model.num_states == 5
    assert reads.terminated.sum() == 2  # from 2 one comes to 2 or 3, and it is over


def test_what_tells_worlds_apart():
    def step(world, action, key):
        place, seen, carried = world
        carried = jax.random.split(carried)[0]
        return Timestep(((place + action) % 3, seen + 1, carried), 0.0, False)

    world = make_environment(
        lambda key: (jnp.int32(0), jnp.int32(0), jax.random.key(5)),
        step,
        lambda x: x[0] / 2,
        actions=2,
        labels=lambda x: jnp.array([x[0] == 1]),
        propositions=["one"],
    )
    table = tabulate(world, distinct=lambda x: x[0])
    assert table.world[0].tolist() == [0, 1, 2] and table.evidence == "keyless"
    assert jax.dtypes.issubdtype(table.world[2].dtype, jax.dtypes.prng_key)
    assert table.model.label[:, 0].tolist() == [False, True, False]
    with pytest.raises(ValueError, match="more than max_states=50 worlds"):
        tabulate(world, max_states=50)


@pytest.mark.slow
def test_what_distinct_leaves_out_is_idle_or_the_callers_word():
    def drawn(world, action, key):
        place, carried = world
        now, carried = jax.random.split(carried)
        return Timestep(((place + jax.random.bernoulli(now)) % 3, carried), 0.0, False)

    def told(world, action):
        places = (world[0] + jnp.arange(2, dtype=jnp.int32)) % 3
        carried = jax.random.split(world[1])
        return Timestep((places, carried), jnp.zeros(2), jnp.zeros(2, bool)), jnp.full(2, 0.5)

    def start(key):
        return jnp.int32(0), jax.random.key(5)

    def evidence(step, reset=start, distinct=lambda x: x[0], **options):
        return tabulate(
            make_environment(reset, step, lambda x: jnp.float32(x[0]), actions=2, **options),
            distinct=distinct,
        ).evidence

    def idle(world, action, key):
        return Timestep(((world[0] + action) % 3, world[1]), 0.0, False)

    assert evidence(drawn) == "distinct"  # of 2^n draws one was listed, as if it were sure
    assert evidence(idle) == "keyless"
    assert evidence(idle, distinct=lambda x: x[0] * 2) == "distinct"  # may be, but is not shown
    assert (
        evidence(
            lambda x, a, key: idle(x, a, key)._replace(reward=1.0 * x[1]),
            lambda key: (jnp.int32(0), jnp.int32(1)),
        )
        == "distinct"
    )
    assert (
        evidence(
            idle,
            lambda key: (jnp.int32(0), jnp.int32(1)),
            labels=lambda x: x[1][None] == 1,
            propositions=["one"],
        )
        == "distinct"
    )
    by_key = jax.random.bernoulli
    assert (
        evidence(
            lambda x, a, key: told(x, a)[0]._replace(
                world=((x[0] + by_key(key)) % 3, x[1]), reward=0.0, terminated=False
            ),
            outcomes=told,
        )
        == "declared"
    )


def test_another_layout_is_not_compiled_anew():
    cells = np.full((3, 3), -1)
    cells[0, 1] = 0
    tabulate(letter_world(layout=cells, letters=1, initial=0))
    with jax.log_compiles(False):
        count = compiles(lambda: tabulate(letter_world(layout=cells.T, letters=1, initial=0)))
    assert count == 0


def compiles(run):
    module = importlib.import_module("jaxltl.core.environments.tabulate")

    functions = [module._followers, module._codes_of_batch, module._resets]
    before = [f._cache_size() for f in functions]
    run()
    return sum(f._cache_size() for f in functions) - sum(before)


P = random_process(0)


def without_one(p):
    """A world whose `outcomes` leave out what happens most often."""
    whole = simulated(p)

    def fewer(outcomes, x, action):
        found, probability = outcomes(x, action)
        kept = jnp.arange(K) != jnp.argmax(probability)
        return found, jnp.where(kept, probability, 0) / jnp.where(kept, probability, 0).sum()

    return replace(whole, outcomes=Partial(partial(fewer, whole.outcomes)))


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("world", "options", "said"),
    [
        (lambda: simulated(P, told=False), {}, "reset is random, .* make_environment"),
        (lambda: simulated(P, outcomes=None), {}, "step is random: action . in world"),
        (
            lambda: simulated(
                P, starts=lambda: ({"state": jnp.array([3]), "rest": jnp.zeros(1)}, jnp.ones(1))
            ),
            {},
            "starts does not tell",
        ),
        (
            lambda: simulated(
                P, starts=lambda: ({"state": jnp.arange(S), "rest": jnp.zeros(S)}, jnp.ones(S))
            ),
            {},
            "sum to 12",
        ),
        (lambda: without_one(P), {"num_keys": 40}, "leads to a world that they do not tell"),
        (
            lambda: simulated(P._replace(probability=P.probability * 2)),
            {},
            "must be a distribution",
        ),
        (lambda: simulated(P), {"max_states": 3}, "more than max_states=3"),
        (lambda: simulated(P._replace(allowed=np.zeros((S, A), bool))), {}, "no action is allowed"),
        (
            lambda: simulated(P),
            {"worlds": {"state": jnp.arange(3), "rest": jnp.zeros(2)}},
            "worlds: give worlds as reset",
        ),
        (lambda: replace(simulated(P), actions=make_box(0.0, 1.0)), {}, "the actions are a box"),
    ],
)
def test_what_cannot_be_listed_is_named(world, options, said):
    with pytest.raises(ValueError, match=said):
        tabulate(world(), **options)


def test_a_reward_that_is_drawn_is_refused():
    """One draw of it would stand in the model as if it were sure."""
    world = make_environment(
        lambda key: jnp.int32(0),
        lambda place, action, key: Timestep((place + action) % 2, jax.random.normal(key), False),
        lambda place: place[None],
        actions=2,
    )
    with pytest.raises(ValueError, match="step is random: action 0 in world 0 leads to 4 outcomes"):
        tabulate(world)
