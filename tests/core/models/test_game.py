"""Games: whose turn it is, what is refused, and restriction and products of games."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.game import Game, as_game, is_deterministic, make_game
from jaxltl.core.models.product import Product, product
from tests import reference, reference_games
from tests.support import as_mdp, bit_labels, random_product


def small_world(**labels):
    return jl.from_dense([[[0, 1.0]], [[1.0, 0]]], **labels)


# --- construction -----------------------------------------------------------------------------


@pytest.mark.parametrize("system", [[True, False], [1, 0], [1.0, 0.0], np.array([True, False])])
def test_owners(system):
    game = make_game(small_world(), system)
    assert game.system.tolist() == [True, False]
    assert game.system.dtype == bool


@pytest.mark.parametrize(
    ("system", "message"),
    [
        ([True, None], "state 1 has no owner: system is None there"),
        ([1.0, np.nan], "state 1 has no owner: system is nan there"),
        ([-1, 0], "state 0 has no owner: system is -1 there"),
        ([0, 2], "state 1 has no owner: system is 2 there"),
        (["system", "environment"], "state 0 has no owner: system is 'system' there"),
        ([True], r"system has shape \(1,\); expected \(2,\).*State 1 has no owner"),
        ([], r"system has shape \(0,\); expected \(2,\).*State 0 has no owner"),
        ([True] * 3, r"system has shape \(3,\); expected \(2,\)"),
        (True, r"system has shape \(\); expected \(2,\)"),
        ([[True, False]], r"system has shape \(1, 2\); expected \(2,\)"),
    ],
)
def test_wrong_owners(system, message):
    with pytest.raises(ValueError, match=message):
        make_game(small_world(), system)


def test_an_owner_is_missing_in_a_product():
    lazy, _ = random_product(np.random.default_rng(0), num_states=2, num_memory=2)
    with pytest.raises(ValueError, match=r"state \(1, 0\) has no owner: system is -1"):
        make_game(lazy, [[0, 1], [-1, 0]])


@pytest.mark.parametrize(("owner", "name"), [(True, "system"), (False, "environment")])
def test_a_state_without_moves(owner, name):
    world = small_world()
    stuck = world.replace(available=world.available.at[1].set(False))
    with pytest.raises(ValueError, match=f"state 1 is the {name}'s and has no move; give it one"):
        make_game(stuck, [True, owner])


def test_a_game_shows_its_model():
    rng = np.random.default_rng(1)
    lazy, _ = random_product(rng)
    mdp = as_mdp(reference.random_model(rng, 3, 2, 2), label=np.eye(3, 1), propositions=["a"])
    for model in (mdp, jl.models.to_dense(mdp), lazy):
        game = as_game(model)
        assert game.system.shape == game.state_shape == model.state_shape
        assert game.system.all()
        assert as_game(game) is game
        for name in ("num_states", "num_actions", "num_successors", "dtype"):
            assert getattr(game, name) == getattr(model, name)
        for name in ("available", "initial", "successor_probability"):
            np.testing.assert_array_equal(getattr(game, name), getattr(model, name))
    game = as_game(mdp)
    assert game.propositions == ("a",)
    np.testing.assert_array_equal(game.label, mdp.label)


def test_primitives_are_those_of_the_model():
    rng = np.random.default_rng(2)
    model = reference.random_model(rng, 5, 2, 2)
    mdp = as_mdp(model)
    game = make_game(mdp, rng.random(5) < 0.5)
    value, region = jnp.asarray(rng.normal(size=5)), jnp.asarray(rng.random(5) < 0.5)
    np.testing.assert_array_equal(
        jl.models.expectation(game, value), jl.models.expectation(mdp, value)
    )
    np.testing.assert_array_equal(
        jl.models.exists_successor(game, region),
        reference.exists_successor(model, np.asarray(region)),
    )
    np.testing.assert_array_equal(
        jl.models.forall_successor(game, region), jl.models.forall_successor(mdp, region)
    )
    key = jax.random.key(0)
    for state in range(5):
        one, other = (jl.models.sample_successor(x, key, state, 0) for x in (game, mdp))
        assert one == other


def test_a_game_is_deterministic_if_every_move_has_one_successor():
    rng = np.random.default_rng(3)
    assert is_deterministic(make_game(small_world(), [True, False]))
    for _ in range(10):
        game = reference_games.random_game(rng, 4, kind="deterministic")
        assert is_deterministic(as_mdp(game.model))
    fair = jl.from_dense([[[0.5, 0.5]], [[1.0, 0]]])
    assert not is_deterministic(fair)
    assert not is_deterministic(make_game(jl.models.to_dense(fair), [True, True]))


# --- restriction ------------------------------------------------------------------------------


def reachable(model, initial, allowed):
    """States reached from initial ones by allowed actions, one at a time."""
    found = set(np.flatnonzero(initial > 0).tolist())
    waiting = list(found)
    while waiting:
        s = waiting.pop()
        for a in np.flatnonzero(allowed[s]):
            new = reference.successors(model, s, a) - found
            found |= new
            waiting += new
    return sorted(found)


def check_restriction(found, model, system, states, allowed):
    """The part on some states, with their owners, moves and probabilities."""
    np.testing.assert_array_equal(found.model.system, system[states])
    np.testing.assert_array_equal(found.model.available, allowed[states])
    dense = np.asarray(jl.models.to_dense(found.model.mdp).transition)
    expected = model.transition[np.ix_(states, range(model.num_actions), states)]
    np.testing.assert_array_equal(dense, np.where(allowed[states][:, :, None], expected, 0))


def test_restriction_of_a_game_by_a_mask():
    rng = np.random.default_rng(4)
    sizes = set()
    for _ in range(60):
        play = reference_games.random_game(rng, 6)
        model = play.model
        mask = rng.random(model.available.shape) < 0.5
        allowed = model.available & mask
        none = ~allowed.any(1)
        mask[none] = True
        allowed[none] = model.available[none]
        start = np.eye(6)[rng.integers(6)]
        game = Game(as_mdp(model), jnp.asarray(play.system))
        found = jl.restrict(game, start, allowed=mask)
        states = reachable(model, start, allowed)
        assert found.base_state.tolist() == states
        assert not found.memory.any()
        check_restriction(found, model, play.system, states, allowed)
        np.testing.assert_array_equal(found.model.initial, start[states])
        sizes.add(len(states))
    assert len(sizes) >= 4


@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_restriction_of_a_game_on_a_product(label_on):
    """Masks and owners are of product states: the memory counts."""
    rng = np.random.default_rng(5)
    for _ in range(10):
        lazy, explicit = random_product(rng, label_on=label_on)
        shape, size = lazy.state_shape, explicit.num_states
        system = rng.random(size) < 0.5
        allowed = explicit.available & (rng.random(explicit.available.shape) < 0.6)
        none = ~allowed.any(1)
        allowed[none] = explicit.available[none]
        found = jl.restrict(
            Game(lazy, jnp.asarray(system.reshape(shape))), allowed=allowed.reshape(*shape, -1)
        )
        states = reachable(explicit, explicit.initial, allowed)
        np.testing.assert_array_equal(found.base_state * shape[1] + found.memory, states)
        check_restriction(found, explicit, system, states, allowed)


def test_without_a_mask_a_game_keeps_its_moves():
    game = make_game(small_world(), [True, False])
    found = jl.restrict(game)
    assert isinstance(found.model, Game)
    assert found.model.system.tolist() == [True, False]
    plain = jl.restrict(small_world())
    assert isinstance(plain.model, jl.MDP)


def test_an_empty_mask_is_an_error_only_where_it_is_reached():
    world = jl.from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 1.0]]], initial=[1.0, 0])
    game = make_game(world, [True, False])
    mask = np.array([[True, False], [False, False]])
    assert jl.restrict(game, allowed=mask).base_state.tolist() == [0]
    mask[0] = True
    with pytest.raises(ValueError, match="no action is allowed in state 1, which is reachable"):
        jl.restrict(game, allowed=mask)
    with pytest.raises(ValueError, match="no action is allowed in state 0"):
        jl.restrict(world, allowed=np.zeros((2, 2), bool))


def test_an_empty_mask_in_a_product_names_the_memory():
    lazy, _ = random_product(np.random.default_rng(6))
    start = np.zeros(lazy.state_shape)
    start[1, 2] = 1
    with pytest.raises(ValueError, match="state 1 with memory 2, which is reachable"):
        jl.restrict(lazy, start, allowed=np.zeros((*lazy.state_shape, 2), bool))


def test_restriction_needs_somewhere_to_start():
    with pytest.raises(ValueError, match="initial distribution is zero"):
        jl.restrict(small_world(), np.zeros(2))


# --- products of games ------------------------------------------------------------------------


@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_the_product_of_a_game_keeps_its_owners(label_on):
    rng = np.random.default_rng(7)
    for _ in range(5):
        play = reference_games.random_game(rng, 4)
        labels = bit_labels(rng.integers(4, size=4), 2)
        world = as_mdp(play.model, label=labels, propositions=("a", "b"))
        joint = product(Game(world, jnp.asarray(play.system)), "G (a -> F b)", label_on=label_on)
        assert isinstance(joint, Game)
        assert isinstance(joint.mdp, Product)
        alone = product(world, "G (a -> F b)", label_on=label_on)
        assert joint.state_shape == alone.state_shape
        for q in range(joint.state_shape[1]):
            np.testing.assert_array_equal(joint.system[:, q], play.system)
        value = jnp.asarray(rng.normal(size=joint.state_shape))
        np.testing.assert_array_equal(
            jl.models.expectation(joint, value), jl.models.expectation(alone, value)
        )
        np.testing.assert_array_equal(joint.initial, alone.initial)


def test_the_product_with_an_automaton():
    """Owners are repeated whatever the task is given as."""
    world = small_world(label=[[0], [1]], propositions=["a"])
    game = make_game(world, [True, False])
    automaton = product(world, "F a").automaton
    for task in ("F a", automaton):
        joint = product(game, task)
        assert joint.system.shape == joint.state_shape
        assert joint.system.all(1).tolist() == [True, False]
        assert not joint.system[1].any()
