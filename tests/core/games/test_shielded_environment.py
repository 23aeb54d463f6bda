"""Shields of simulated worlds: whoever keeps to the mask satisfies the formula, for certain."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import jaxltl as jl
from jaxltl.core.environments.environment import Timestep, make_box, make_environment
from jaxltl.core.environments.episodes import Agent, run_episode
from jaxltl.core.environments.model_environment import model_environment
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.environments.tabulate import tabulate
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.games.permissive import permissive_strategy
from jaxltl.core.games.shielded_environment import ShieldedWorld, shield_environment
from jaxltl.core.games.winning import winning_region
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.mdp import from_dense
from jaxltl.core.models.product import product
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from jaxltl.envs.robots import grid_game
from tests import reference
from tests.support import as_mdp, random_action

MAX_PROGRAMS = 350  # that the default tests compile at most

SAFE = "G !collision"
OFTEN = "G !collision & G F (system_a | system_b)"


@cache
def game():
    return grid_game("a..\n..b", system_start="a", environment_start=(1, 2))


def careful(memory, seen, allowed, key):
    """Draws among what is allowed."""
    return random_action(key, model_environment(game()).actions, allowed), memory


@partial(jax.jit, static_argnames="num_steps")
def episodes(keys, environment, num_steps):
    agent = Agent(Partial(careful))
    return jax.vmap(lambda key: run_episode(key, environment, agent, num_steps=num_steps))(keys)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("formula", "options"),
    [
        (SAFE, {"method": "stay"}),
        (OFTEN, {"method": "rank"}),
        (OFTEN, {"method": "counter", "bound": 9}),
    ],
)
def test_whatever_is_allowed_satisfies_the_formula(formula, options):
    strategy = permissive_strategy(game(), formula, **options)
    table = tabulate(shield_environment(model_environment(game()), strategy))
    assert (np.asarray(table.world.state) >= 0).all()
    for model, least in ((table.model, 1), (to_sparse(game().mdp), 0)):
        joint = product(model, formula)
        value = optimal_satisfaction(joint, objective="min").value
        assert float((np.asarray(joint.initial) * value).sum()) == pytest.approx(least, abs=1e-9)


@pytest.mark.slow
def test_a_random_walk_inside_a_shield_never_collides():
    inner = task_environment(model_environment(game()), SAFE)
    strategy = permissive_strategy(game(), SAFE)
    keys = jax.random.split(jax.random.key(0), 100)
    violated = []
    for environment in (inner, shield_environment(inner, strategy, lambda world: world.world)):
        found = episodes(keys, environment, 100)
        world = found.world.world if isinstance(found.world, ShieldedWorld) else found.world
        violated.append(np.mean(world.verdict[:, -1] == Verdict.VIOLATED))
    assert violated[0] > 0.5 and violated[1] == 0


def test_a_mask_follows_what_the_strategy_remembers():
    """With a bound on the system's moves between two visits, which takes a counter."""
    bound = 9
    strategy = permissive_strategy(game(), OFTEN, method="counter", bound=bound)
    environment = shield_environment(model_environment(game()), strategy)
    found = episodes(jax.random.split(jax.random.key(1), 40), environment, 100)
    names = list(game().propositions)
    label = np.asarray(found.label)
    at = label[..., [names.index("system_a"), names.index("system_b")]].any(-1)
    turn = label[..., names.index("system_turn")]
    longest = 0
    for visits, moves in zip(at, turn, strict=True):
        since = 0
        for here, move in zip(visits, moves, strict=True):
            since = 0 if here else since + int(move)
            longest = max(longest, since)
    assert 3 < longest <= bound + 1
    state = np.asarray(found.world.state)
    assert (state >= 0).all() and len(np.unique(state)) > np.unique(found.world.world).size


def test_a_winning_region_is_not_left():
    strategy = permissive_strategy(game(), SAFE)
    won = shield_environment(model_environment(game()), winning_region(game(), SAFE))
    stay = shield_environment(model_environment(game()), strategy)
    keys = jax.random.split(jax.random.key(2), 10)
    one, other = episodes(keys, won, 30), episodes(keys, stay, 30)
    np.testing.assert_array_equal(one.world.world, other.world.world)


def cliff():
    """From 0 by action 1 to the cliff 1, or by action 0 to 2; all stay there."""
    return from_dense(
        [[[0, 0, 1.0], [0, 0.5, 0.5]], [[0, 1.0, 0], [0, 1, 0]], [[0, 0, 1.0], [1, 0, 0]]],
        label=[[0], [1], [0]],
        propositions=["fall"],
        initial=[0.5, 0.5, 0],
    )


def test_where_nothing_is_sure_the_world_decides():
    environment = shield_environment(
        model_environment(cliff()), permissive_strategy(cliff(), "G !fall")
    )
    masks = {}
    for seed in range(8):
        world = environment.reset(jax.random.key(seed))
        masks[int(world.world)] = world.state, environment.allowed(world)
    assert masks[0][0] >= 0 and masks[0][1].tolist() == [True, False]
    assert masks[1][0] == -1 and masks[1][1].tolist() == [True, True]
    world = ShieldedWorld(jnp.int32(0), masks[0][0])
    left = environment.step(world, 0, jax.random.key(0)).world
    assert left.world == 2 and left.state >= 0
    # What is not allowed may lead where the strategy has no state, once and for all.
    fallen = [environment.step(world, 1, jax.random.key(i)).world for i in range(8)]
    assert {int(w.state) for w in fallen if int(w.world) == 1} == {-1}
    after = environment.step(next(w for w in fallen if int(w.world) == 1), 0, jax.random.key(0))
    assert after.world.state == -1


def test_a_mask_is_looked_up():
    rng = np.random.default_rng(0)
    model = reference.random_model(rng, 5, 2, 2, certainty=0)
    inner = model_environment(as_mdp(model, label=rng.random((5, 1)) < 0.5, propositions=["a"]))
    task = task_environment(inner, "F (a & X a)")
    table = rng.random((5, 3, 2)) < 0.6
    environment = shield_environment(task, table, lambda world: (world.world, world.memory))
    for world in range(5):
        for memory in range(3):
            at = task.reset(jax.random.key(0))._replace(
                world=jnp.int32(world), memory=jnp.int32(memory)
            )
            sure = table[world, memory] & model.available[world]
            expected = sure if sure.any() else model.available[world]
            assert environment.allowed(at).tolist() == expected.tolist()
    assert shield_environment(inner, table[:, 0]).allowed(jnp.int32(2)).shape == (2,)
    bare = make_environment(
        lambda key: jnp.int32(0),
        lambda s, a, k: Timestep(s, 0.0, False),
        lambda s: s[None],
        actions=2,
    )
    assert shield_environment(bare, np.array([[False, True]])).allowed(0).tolist() == [False, True]


def test_outcomes_are_those_of_the_steps():
    environment = shield_environment(
        model_environment(cliff()), permissive_strategy(cliff(), "G !fall")
    )
    worlds, chance = environment.starts()
    assert worlds.world.tolist() == [0, 1, 2] and chance.tolist() == [0.5, 0.5, 0]
    assert (worlds.state >= 0).tolist() == [True, False, False]
    told, chance = environment.outcomes(jax.tree.map(lambda x: x[0], worlds), 1)
    assert dict(zip(told.world.world.tolist(), chance.tolist(), strict=True))[1] == 0.5
    assert told.world.state.tolist()[told.world.world.tolist().index(1)] == -1


@pytest.mark.parametrize(
    ("make", "options", "text"),
    [
        (lambda: np.ones((3, 3), bool), {}, "of 3 actions, and the world has 2"),
        (lambda: np.ones((3, 2)), {}, r"float64\[3, 2\]; give bool"),
        (lambda: np.ones(3, bool), {}, "give bool"),
        (lambda: np.ones((3, 4, 2), bool), {}, "a tuple of 2 integers"),
        (
            lambda: np.ones((3, 2), bool),
            {"state_of": lambda world: world * 1.0},
            "return an integer",
        ),
        (lambda: permissive_strategy(game(), SAFE), {}, "of 5 actions, and the world has 2"),
        (
            lambda: permissive_strategy(cliff(), "G !fall"),
            {"state_of": lambda world: (world, 0)},
            "return an integer",
        ),
    ],
)
def test_bad_shields_are_named(make, options, text):
    with pytest.raises(ValueError, match=text):
        shield_environment(model_environment(cliff()), make(), **options)


def test_a_box_of_actions_has_no_mask():
    world = make_environment(
        lambda key: jnp.zeros(()),
        lambda at, by, key: Timestep(at + by, 0.0, False),
        lambda at: at[None],
        actions=make_box(-1, 1),
    )
    with pytest.raises(ValueError, match="finitely many actions"):
        shield_environment(world, np.ones((1, 2), bool))


@pytest.mark.few(2)
@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("tasked", [True, False])
def test_a_world_below_a_clock_or_a_task_is_shielded(timed, tasked):
    """As if the shield were put on first: masks on all paths are equal."""
    model = jl.gridworld("a b .\n. . .", initial="a")
    strategy = jl.permissive_strategy(model, "G !b")
    world = jl.environments.model_environment(model)
    wrap = [lambda x: jl.environments.with_time_limit(x, 9)] if timed else []
    wrap += [lambda x: jl.task_environment(x, "G !b")] if tasked else []
    late, early = world, jl.games.shield_environment(world, strategy)
    for layer in wrap:
        late, early = layer(late), layer(early)
    late = jl.games.shield_environment(late, strategy)
    key = jax.random.key(0)
    one, other = late.reset(key), early.reset(key)
    for i in range(6):
        mask = np.asarray(late.allowed(one))
        np.testing.assert_array_equal(mask, early.allowed(other))
        assert i or not mask.all()
        action = int(np.flatnonzero(mask)[-1])
        one, other = (
            x.step(w, action, jax.random.fold_in(key, i)).world
            for x, w in ((late, one), (early, other))
        )


def test_worlds_that_are_no_states_ask_for_state_of():
    model = jl.gridworld("a . b", initial="a")
    strategy = jl.permissive_strategy(model, "G !b")
    world = jl.environments.model_environment(model)
    twice = world.replace(
        reset=lambda key: (world.reset(key), world.reset(key)),
        step=lambda at, action, key: world.step(at[0], action, key),
    )
    with pytest.raises(ValueError, match=r"worlds of the environment are .*; give state_of"):
        jl.games.shield_environment(twice, strategy)
    with pytest.raises(ValueError, match="state_of returns"):
        jl.games.shield_environment(world, strategy, lambda at: at / 2)
