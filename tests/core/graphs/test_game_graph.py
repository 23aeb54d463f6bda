"""Attractors of a player in a game: rules by state and both meanings of chance, by naive sweeps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import to_dense
from jaxltl.core.sparse.graph import attractor as host_attract
from tests import reference, reference_games
from tests.support import as_mdp, random_product

CHANCE = ("some", "all")


def random_case(rng, model):
    """A rule for each state, and often a goal, actions and states that may join."""
    size = model.num_states
    goal = reference.random_target(rng, size)
    allowed = model.available & (rng.random(model.available.shape) < 0.85)
    rule = rng.random(size) < 0.5
    among = rng.random(size) < rng.choice([0.8, 1.0])
    return goal, allowed, rule, among


def expected_attractor(model, goal, allowed, rule, among, chance):
    return reference_games.attractor(model, goal, allowed, rule, chance, among)


def check_moves(model, case, found, chance):
    """Following the action, the player comes nearer: the region is attracted by it alone."""
    goal, allowed, rule, among = case
    region, action = np.asarray(found.region), np.asarray(found.action)
    mine = region & rule & ~goal
    states = np.arange(model.num_states)
    assert allowed[states, action][mine].all()
    only = allowed.copy()
    only[mine] = False
    only[states[mine], action[mine]] = True
    again = expected_attractor(model, goal, only, rule, among, chance)
    np.testing.assert_array_equal(again, region)


@pytest.mark.few(1)
@pytest.mark.parametrize("chance", CHANCE)
def test_rules_by_state_equal_naive_sweeps(chance):
    rng = np.random.default_rng(0)
    models = [reference.random_model(rng, 6, 2, 2) for _ in range(250)]
    cases = [random_case(rng, model) for model in models]
    sizes = set()
    for model, case in zip(models, cases, strict=True):
        goal, allowed, rule, among = case
        found = attractor(as_mdp(model), goal, allowed, rule=rule, chance=chance, among=among)
        expected = expected_attractor(model, *case, chance)
        np.testing.assert_array_equal(found.region, expected)
        check_moves(model, case, found, chance)
        sizes.add(int(expected.sum()))
    assert sizes >= set(range(7))


@pytest.mark.parametrize("kind", ["sparse", "dense", "entry", "exit"])
@pytest.mark.parametrize("chance", CHANCE)
def test_plain_loops_and_array_operations_agree(kind, chance, monkeypatch):
    """On every representation, products with their states in two axes among them."""
    rng = np.random.default_rng(1)
    deeper = 0
    for _ in range(15):
        if kind in ("entry", "exit"):
            model, explicit = random_product(rng, num_states=4, num_memory=4, label_on=kind)
        else:
            explicit = reference_games.random_game(rng, 16, local=2).model
            model = as_mdp(explicit) if kind == "sparse" else to_dense(as_mdp(explicit))
        case = random_case(rng, explicit)
        shape = model.state_shape
        goal, allowed, rule, among = (x.reshape(*shape, *x.shape[1:]) for x in case)
        expected = expected_attractor(explicit, *case, chance)
        answers = []
        # A game is seen through to its model.
        for world, few in ((model, 24), (Game(model, rule), 0)):
            monkeypatch.setattr(host_attract, "FEW", few)
            answers.append(attractor(world, goal, allowed, rule=rule, chance=chance, among=among))
        for found in answers:
            np.testing.assert_array_equal(np.ravel(found.region), expected)
            check_moves(explicit, case, jax.tree.map(np.ravel, found), chance)
        deeper += not answers[0].region.all() and (expected & ~case[0]).sum() > 2
    assert deeper, "some attractors take several sweeps"


def test_wide_frontiers_of_a_worklist(monkeypatch):
    """Frontiers both above and below the size up to which plain loops are used."""
    rng = np.random.default_rng(2)
    for limit in (0, 24, 10_000):
        monkeypatch.setattr(host_attract, "FEW", limit)
        for chance in CHANCE:
            for _ in range(5):
                model = reference_games.random_game(rng, 40, 2, 3, local=6).model
                case = random_case(rng, model)
                goal, allowed, rule, among = (jnp.asarray(x) for x in case)
                found = attractor(
                    as_mdp(model), goal, allowed, rule=rule, chance=chance, among=among
                )
                expected = expected_attractor(model, *case, chance)
                np.testing.assert_array_equal(found.region, expected)
                check_moves(model, case, found, chance)


@pytest.mark.parametrize("few", [0, 24])
def test_parallel_edges_count_once_each(few, monkeypatch):
    """A move with two entries for one successor surely leads there when that one joins."""
    monkeypatch.setattr(host_attract, "FEW", few)
    model = reference.Model(
        np.array([[[1, 1]], [[2, 2]], [[2, 2]], [[2, 3]]]),
        np.full((4, 1, 2), 0.5),
        np.ones((4, 1), bool),
        np.full(4, 0.25),
    )
    goal = jnp.arange(4) == 2
    found = attractor(as_mdp(model), goal, chance="all")
    assert found.region.tolist() == [True, True, True, False]
    assert attractor(as_mdp(model), goal).region.all()


def test_attractors_are_what_strategies_can_force():
    """Chance that helps gives the positive set, chance that does not the sure one."""
    rng = np.random.default_rng(3)
    for _ in range(100):
        play = reference_games.random_game(rng, 5)
        goal = reference.random_target(rng, 5)
        game = Game(as_mdp(play.model), jnp.asarray(play.system))
        some = attractor(game, jnp.asarray(goal), rule=game.system)
        np.testing.assert_array_equal(some.region, reference_games.positive_reach(play, goal))
        sure = attractor(game, jnp.asarray(goal), rule=game.system, chance="all")
        np.testing.assert_array_equal(sure.region, reference_games.sure_reach(play, goal))


def test_one_rule_for_all_states_is_an_array_of_it():
    rng = np.random.default_rng(4)
    model = as_mdp(reference.random_model(rng, 8, 2, 2))
    goal = jnp.arange(8) == 3
    for rule, value in (("exists", True), ("forall", False)):
        one, other = (attractor(model, goal, rule=r) for r in (rule, jnp.full(8, value)))
        np.testing.assert_array_equal(one.region, other.region)
        np.testing.assert_array_equal(one.action, other.action)


def test_unknown_chance():
    mdp = as_mdp(reference.random_model(np.random.default_rng(5), 2, 1, 1))
    with pytest.raises(ValueError, match="chance='none'; choose"):
        attractor(mdp, jnp.zeros(2, bool), chance="none")
