"""Winning regions against brute force, the host against compiled code; strategies checked."""

import itertools
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.games.objective import (
    buchi,
    cobuchi,
    gr1,
    parity,
    reach,
    safety,
)
from jaxltl.core.games.verify import verify
from jaxltl.core.games.winning import almost_sure_buchi, winning_region
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.mdp import to_dense
from jaxltl.core.models.product import product
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.sparse.graph import attractor as host_attract
from tests import reference, reference_games
from tests.support import as_mdp, bit_labels, counts, random_product

NUM_PRIORITIES = 5


def as_game(play, **labels):
    """The library's game of a reference game."""
    return Game(as_mdp(play.model, **labels), jnp.asarray(play.system))


# --- objectives: the library's and the reference's, from the same random sets -----------------


def draw(rng, num_states, count=()):
    """Sets and priorities for every kind of objective."""
    shape = (*count, num_states)
    return {
        "safe": rng.random(shape) < 0.9,
        "goal": rng.random(shape) < 0.35,
        "priority": rng.integers(NUM_PRIORITIES, size=shape),
        "assumptions": rng.random((*count, 2, num_states)) < 0.4,
        "guarantees": rng.random((*count, 2, num_states)) < 0.4,
    }


OBJECTIVES = {
    "safety": lambda game, x: safety(game, x["safe"]),
    "reach": lambda game, x: reach(game, x["goal"], safe=x["safe"]),
    "buchi": lambda game, x: buchi(game, x["goal"], safe=x["safe"]),
    "cobuchi": lambda game, x: cobuchi(game, x["goal"], safe=x["safe"]),
    "parity": lambda game, x: parity(
        game, x["priority"], safe=x["safe"], num_priorities=NUM_PRIORITIES
    ),
    "gr1": lambda game, x: gr1(game, list(x["assumptions"]), list(x["guarantees"]), safe=x["safe"]),
    "generalized": lambda game, x: gr1(game, (), list(x["guarantees"]), safe=x["safe"]),
}

REFERENCES = {
    "safety": lambda play, x: reference_games.safety(play, x["safe"]),
    "reach": lambda play, x: reference_games.reach(play, x["goal"], x["safe"]),
    "buchi": lambda play, x: reference_games.buchi(play, x["goal"], x["safe"]),
    "cobuchi": lambda play, x: reference_games.cobuchi(play, x["goal"], x["safe"]),
    "parity": lambda play, x: reference_games.parity(play, x["priority"], x["safe"]),
    "gr1": lambda play, x: reference_games.gr1(play, x["assumptions"], x["guarantees"], x["safe"]),
    "generalized": lambda play, x: reference_games.gr1(
        play, np.ones((1, len(x["safe"])), bool), x["guarantees"], x["safe"]
    ),
}

compiled = jax.jit(winning_region)


def check_batch(seed, kind, shape, count):
    """Random games: regions by brute force, strategies checked."""
    rng = np.random.default_rng(seed)
    total = 0
    for i in range(count):
        play, x = reference_games.random_game(rng, *shape), draw(rng, shape[0])
        game = as_game(play)
        found = winning_region(game, OBJECTIVES[kind](game, x))
        expected = REFERENCES[kind](play, x)
        np.testing.assert_array_equal(found.region, expected, err_msg=f"game {i}")
        verdict = verify(found)
        assert verdict, f"game {i}: {verdict.reason}"
        total += expected.mean()
    assert 0.05 < total / count < 0.95, "both players win somewhere"


PARITY_LIKE = ("safety", "reach", "buchi", "cobuchi", "parity")


@pytest.mark.few(3)
@counts(30, 200)
@pytest.mark.parametrize("kind", PARITY_LIKE)
def test_regions_equal_all_pairs_of_strategies(kind, count):
    check_batch(0, kind, (7, 2, 2), count)


@counts(20, 80)
@pytest.mark.parametrize("kind", ["gr1", "generalized"])
def test_regions_with_memory_equal_parity_written_out(kind, count):
    check_batch(1, kind, (3, 2, 2), count)


# --- the host, compiled code and representations ----------------------------------------------


def check_paths(rng, play, kind, monkeypatch):
    """Plain loops, array operations and compiled code agree, and their strategies win."""
    game = as_game(play)
    objective = OBJECTIVES[kind](game, draw(rng, play.model.num_states))
    monkeypatch.setattr(host_attract, "FEW", 24)
    found = winning_region(game, objective)
    verdict = verify(found)
    assert verdict, verdict.reason
    monkeypatch.setattr(host_attract, "FEW", 0)
    others = [winning_region(game, objective)]
    if kind in ("parity", "gr1"):  # the others are cases of these
        others.append(compiled(game, objective))
    for other in others:
        for name in ("region", "action", "counter_action"):
            np.testing.assert_array_equal(getattr(found, name), getattr(other, name))
    return np.asarray(found.region)


def larger_games(rng, count, shapes=((60, 2, 2), (120, 3, 2), (300, 2, 3))):
    """Games with up to 300 states; in half of them moves are local, so that they are deep."""
    for i in range(count):
        local = 2 if i % 2 else None
        yield reference_games.random_game(rng, *shapes[i // 2 % len(shapes)], local=local)


@pytest.mark.few(5)
@pytest.mark.parametrize("kind", OBJECTIVES)
def test_the_host_and_compiled_code_agree(kind, monkeypatch):
    rng = np.random.default_rng(2)
    games = larger_games(rng, 10, shapes=((90, 2, 2),))
    regions = [check_paths(rng, play, kind, monkeypatch) for play in games]
    assert any(0 < region.mean() < 1 for region in regions)


@pytest.mark.parametrize(
    ("kind", "count"),
    [
        *((kind, 12) for kind in OBJECTIVES if kind not in ("parity", "gr1")),
        *(pytest.param(kind, 72, marks=pytest.mark.exhaustive) for kind in OBJECTIVES),
    ],
)
def test_the_host_and_compiled_code_agree_on_hundreds_of_games(kind, count, monkeypatch):
    rng = np.random.default_rng(3)
    for play in larger_games(rng, count):
        check_paths(rng, play, kind, monkeypatch)


@pytest.mark.parametrize(("kind", "label_on"), [("parity", "entry"), ("gr1", "exit")])
def test_products_and_dense_worlds(kind, label_on, monkeypatch):
    """A lazy product, with its states in two axes, is solved as its explicit copy is."""
    rng = np.random.default_rng(4)
    for _ in range(3):
        lazy, explicit = random_product(rng, label_on=label_on)
        system = rng.random(explicit.num_states) < 0.5
        sets = draw(rng, explicit.num_states)
        copy = as_mdp(explicit)
        expected = None
        for model in (copy if kind == "gr1" else to_dense(copy), lazy):
            shape = model.state_shape
            game = Game(model, jnp.asarray(system.reshape(shape)))
            x = {k: v.reshape(*v.shape[:-1], *shape) for k, v in sets.items()}
            objective = OBJECTIVES[kind](game, x)
            monkeypatch.setattr(host_attract, "FEW", 0)
            found = winning_region(game, objective)
            assert found.region.shape == shape
            region = np.ravel(found.region)
            expected = region if expected is None else expected
            np.testing.assert_array_equal(region, expected)
            verdict = verify(found)
            assert verdict, verdict.reason
        if kind != "gr1":
            play = reference_games.Play(explicit, system)
            np.testing.assert_array_equal(expected, REFERENCES[kind](play, sets))


def test_a_model_without_owners_is_the_systems():
    rng = np.random.default_rng(5)
    for _ in range(20):
        play = reference_games.random_game(rng, 4, kind="system")
        mdp, sets = as_mdp(play.model), draw(rng, 4)
        found = winning_region(mdp, buchi(mdp, sets["goal"]))
        expected = reference_games.buchi(play, sets["goal"], np.ones(4, bool))
        np.testing.assert_array_equal(found.region, expected)
        assert found.game.system.all()


def test_new_values_do_not_retrace():
    rng = np.random.default_rng(6)
    traces = []

    @jax.jit
    def solve(game, objective):
        traces.append(None)
        return winning_region(game, objective).region

    for _ in range(3):
        play = reference_games.random_game(rng, 5)
        game = as_game(play)
        solve(game, parity(game, rng.integers(3, size=5), num_priorities=3))
    assert len(traces) == 1


def test_single_precision_has_the_same_regions():
    """Only whether a probability is positive matters."""
    rng = np.random.default_rng(7)
    for _ in range(5):
        play = reference_games.random_game(rng, 4)
        sets = draw(rng, 4)
        with jax.enable_x64(False):
            game = as_game(play)
            found = winning_region(game, buchi(game, sets["goal"]))
            assert found.game.dtype == jnp.float32
        expected = reference_games.buchi(play, sets["goal"], np.ones(4, bool))
        np.testing.assert_array_equal(found.region, expected)


# --- examples by hand -------------------------------------------------------------------------


def four_states():
    """From r half to f, half back; from g half to f, half to the trap d. The target is f."""
    return jl.from_dense(
        [[[1.0, 0, 0, 0]], [[0.5, 0.5, 0, 0]], [[0.5, 0, 0, 0.5]], [[0, 0, 0, 1.0]]],
        label=[[1], [0], [0], [0]],
        propositions=["f"],
    )


@pytest.mark.parametrize("owner", [True, False])
def test_sure_almost_sure_and_positive(owner):
    game = make_game(four_states(), [owner] * 4)
    target = jnp.arange(4) == 0
    goal = buchi(game, target)
    assert winning_region(game, goal).region.tolist() == [True, True, False, False]
    assert almost_sure_buchi(game, "f").region.tolist() == [True, True, False, False]
    sure = winning_region(game, goal, chance="adversarial")
    assert sure.region[:4].tolist() == [True, False, False, False]
    assert verify(sure)
    positive = attractor(game, target, rule=game.system)
    assert positive.region.tolist() == [True, True, True, False]


def test_who_moves_decides():
    """State 0 leads to itself or to the trap 1."""
    world = jl.from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 1.0]]])
    mine, yours = make_game(world, [True, True]), make_game(world, [False, True])
    stay = jnp.array([True, False])
    for objective in (safety, buchi, cobuchi):
        found = winning_region(mine, objective(mine, stay))
        assert found.region.tolist() == [True, False]
        assert found.action[0] == 0
        found = winning_region(yours, objective(yours, stay))
        assert found.region.tolist() == [False, False]
        assert found.counter_action[0] == 1


def test_memory_is_needed_and_given():
    """A state between two goals is left for each in turn."""
    world = jl.make_mdp(np.array([[1, 2], [0, 0], [0, 0]])[:, :, None], np.ones((3, 2, 1)))
    game = make_game(world, [True] * 3)
    found = winning_region(game, gr1(game, (), [jnp.arange(3) == 1, jnp.arange(3) == 2]))
    assert found.region.all()
    assert found.action[0].tolist() == [0, 1]
    assert verify(found)


def test_no_strategy_is_needed_when_an_assumption_cannot_hold():
    game = make_game(four_states(), [True] * 4)
    none, trap = jnp.zeros(4, bool), jnp.arange(4) == 3
    found = winning_region(game, gr1(game, [none], [none]))
    assert found.region.all()
    assert verify(found)
    found = winning_region(game, gr1(game, [trap], [none]))
    assert found.region.tolist() == [True, True, False, False]
    assert verify(found)


def test_realizable_asks_about_initial_states():
    game = make_game(four_states(), [True] * 4)
    found = winning_region(game, buchi(game, "f"))
    for state, expected in enumerate([True, True, False, False]):
        mdp = game.mdp.replace(initial=jnp.eye(4)[state])
        assert bool(found.replace(game=game.replace(mdp=mdp)).realizable) == expected


def test_exchanging_players_without_chance_exchanges_regions():
    rng = np.random.default_rng(8)
    for _ in range(30):
        game = as_game(reference_games.random_game(rng, 6, kind="deterministic"))
        sets = draw(rng, 6)
        one = winning_region(game, parity(game, sets["priority"], num_priorities=6))
        other = winning_region(
            game.replace(system=~game.system), parity(game, sets["priority"] + 1, num_priorities=6)
        )
        np.testing.assert_array_equal(one.region, np.logical_not(other.region))


# --- sure winning -----------------------------------------------------------------------------


def test_against_chance_every_run_counts():
    rng = np.random.default_rng(21)
    differ = 0
    for _ in range(6):
        play = reference_games.random_game(rng, 3, kind="mixed")
        game, sets = as_game(play), draw(rng, 3)
        objective = parity(game, sets["priority"], safe=sets["safe"])
        found = winning_region(game, objective, chance="adversarial")
        expected = reference_games.sure_parity(play, sets["priority"], sets["safe"])
        np.testing.assert_array_equal(found.region[:3], expected)
        assert verify(found)
        hit = winning_region(game, reach(game, sets["goal"]), chance="adversarial")
        np.testing.assert_array_equal(
            hit.region[:3], reference_games.sure_reach(play, sets["goal"])
        )
        almost = winning_region(game, objective).region
        assert (~found.region[:3] | almost).all()
        differ += bool((found.region[:3] != almost).any())
    assert differ


def test_unknown_chance():
    game = make_game(four_states(), [True] * 4)
    with pytest.raises(ValueError, match="chance='kind'; choose random or adversarial"):
        winning_region(game, buchi(game, "f"), chance="kind")


# --- formulas ---------------------------------------------------------------------------------

FORMULAS = (
    "a U b",
    "G a",
    "G F a & G b",
    "G (a -> F b)",
    "G F a -> G F b",
    "F (a & X b)",
    "(G F a) & (F G b)",
    "false",
)


@pytest.mark.parametrize("formula", FORMULAS)
def test_formulas_equal_the_explicit_product(formula):
    rng = np.random.default_rng(10)
    for _ in range(8):
        play = reference_games.random_game(rng, 3)
        # The same letters occur in every game, so that its product has the same shape.
        letter = rng.permutation([1, 2, 3])
        names = ("a", "b")
        game = as_game(play, label=bit_labels(letter, 2), propositions=names)
        found = winning_region(game, formula)
        automaton = found.game.mdp.automaton
        assert found.region.shape == (3, automaton.delta.shape[0])
        # Letters of the automaton are those that occur; each state's own is found by its label.
        rows = np.asarray(automaton.letters)
        columns = [names.index(p) for p in automaton.propositions]
        shown = [
            int(np.flatnonzero((rows == row).all(1))[0])
            for row in bit_labels(letter, 2)[:, columns]
        ]
        explicit = reference.explicit_product(
            play.model,
            np.asarray(automaton.delta),
            int(automaton.initial),
            np.array(shown),
            "exit",
        )
        num_memory = len(automaton.delta)
        larger = reference_games.Play(explicit, np.repeat(play.system, num_memory))
        priority = np.asarray(automaton.priority)[:, shown].T.ravel()
        expected = reference_games.parity(larger, priority, np.ones(len(priority), bool))
        np.testing.assert_array_equal(np.ravel(found.region), expected)
        verdict = verify(found)
        assert verdict, verdict.reason
        assert bool(found.realizable) == expected[np.ravel(explicit.initial) > 0].all()


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("formula", "objective"),
    [
        ("G a", lambda g: safety(g, "a")),
        ("G F a & G b", lambda g: buchi(g, "a", safe="b")),
        ("F G a & G b", lambda g: cobuchi(g, "a", safe="b")),
        ("b U a", lambda g: reach(g, "a", safe="b")),
        ("G F a & G F b", lambda g: gr1(g, (), ["a", "b"])),
        (
            "G !(a & b) & ((G F a & G F !b) -> (G F b & G F !a))",
            lambda g: gr1(g, ["a", "!b"], ["b", "!a"], safe="!(a & b)"),
        ),
    ],
)
def test_objectives_are_the_formulas_that_they_stand_for(formula, objective):
    rng = np.random.default_rng(11)
    seen = set()
    for _ in range(20):
        play = reference_games.random_game(rng, 3, kind="mixed")
        labels = bit_labels(rng.permutation([1, 2, 3]), 2)
        game = as_game(play, label=labels, propositions=("a", "b"))
        task = winning_region(game, formula)
        start = np.asarray(task.game.mdp.initial_memory)
        region = np.asarray(task.region)[np.arange(3), start]
        np.testing.assert_array_equal(winning_region(game, objective(game)).region, region)
        seen |= set(region.tolist())
    assert seen == {True, False}


def test_a_formula_an_automaton_and_a_product_are_the_same_task():
    rng = np.random.default_rng(12)
    play = reference_games.random_game(rng, 3)
    game = as_game(play, label=bit_labels(np.array([1, 2, 3]), 2), propositions=("a", "b"))
    text = "G F a & G F b"
    formula = jl.parse_ltl(text)
    automaton = product(game, text, label_on="exit").mdp.automaton
    regions = [winning_region(game, spec).region for spec in (text, formula, automaton)]
    for region in regions[1:]:
        np.testing.assert_array_equal(region, regions[0])


def test_unknown_propositions_are_named():
    game = make_game(four_states(), [True] * 4)
    with pytest.raises(ValueError, match="'x'"):
        winning_region(game, "G F x")


# --- corrupted answers ------------------------------------------------------------------------


def alternatives(found, game, states, name):
    """The answer with one of a player's actions at some states changed to another."""
    action = np.asarray(getattr(found, name))
    for s, a in itertools.product(np.flatnonzero(states), range(game.num_actions)):
        if bool((action[s] != a).any()):
            changed = action.copy()
            changed[s] = a
            yield s, found.replace(**{name: changed})


def test_corrupted_answers_are_refused():
    """Every change of one state's side is refused; some changes of an action win as well."""
    rng = np.random.default_rng(13)
    reasons = []
    refused = accepted = 0
    for _ in range(25):
        play = reference_games.random_game(rng, 5, kind="mixed")
        game, sets = as_game(play), draw(rng, 5)
        found = winning_region(game, OBJECTIVES["parity"](game, sets))
        found = jax.tree.map(np.asarray, found)
        for s in range(5):
            verdict = verify(found.replace(region=found.region ^ (np.arange(5) == s)))
            assert not verdict
            reasons.append(verdict.reason)
        for name, side in (
            ("action", found.region & play.system),
            ("counter_action", ~found.region & ~play.system),
        ):
            undecided = side & ~found.objective.lost
            for _, changed in alternatives(found, game, undecided, name):
                region, lost = found.region, found.objective.lost
                expected = reference_games.claims(
                    play,
                    found.objective.priority,
                    found.objective.won,
                    lost,
                    region,
                    changed.action,
                    changed.counter_action,
                )
                verdict = verify(changed)
                assert verdict[:2] == expected
                refused, accepted = refused + (not verdict), accepted + bool(verdict)
                reasons.append(verdict.reason)
    assert refused > 20
    assert accepted > 20
    for part in (
        "leaves the region",
        "which is odd",
        "which is even",
        "already lost",
        "not available",
        "enter the region almost surely",
    ):
        assert any(part in reason for reason in reasons), part


# --- depth ------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [30_000, pytest.param(1_000_000, marks=pytest.mark.exhaustive)])
def test_a_very_long_chain(length):
    """Every state leads on, the first may stay, and players take turns in moving."""
    states = np.arange(length)
    successor = np.stack([np.minimum(states + 1, length - 1), states], axis=1)[:, :, None]
    available = np.stack([states >= 0, states == 0], axis=1)
    mdp = jl.make_mdp(successor, available[:, :, None] * 1.0, available=available)
    last = states == length - 1
    mine, yours = (make_game(mdp, states % 2 == turn) for turn in (0, 1))
    assert winning_region(mine, safety(mine, ~last)).region.tolist() == (states == 0).tolist()
    assert not winning_region(yours, safety(yours, ~last)).region.any()
    for game, objective, region in (
        (mine, reach(mine, last), states >= 0),
        (yours, buchi(yours, last), states > 0),
    ):
        found = winning_region(game, objective)
        np.testing.assert_array_equal(found.region, region)
        verdict = verify(found)
        assert verdict, verdict.reason


def test_nested_depth_on_the_host(monkeypatch):
    """A chain of coins: each state falls back to the start or goes on, and the end is a trap."""
    monkeypatch.setattr(host_attract, "FEW", 0)
    length = 400
    states = np.arange(length)
    successor = np.stack([np.minimum(states + 1, length - 1), 0 * states], axis=1)
    successor[-1] = length - 1
    mdp = jl.make_mdp(successor[:, None], np.full((length, 1, 2), 0.5))
    game = make_game(mdp, states % 3 == 0)
    solve = partial(winning_region, game)
    end = states == length - 1
    for objective, region in (
        (buchi(game, end), states >= 0),
        (buchi(game, states == 0), states < 0),
        (cobuchi(game, end), states >= 0),
        (safety(game, ~end), states < 0),
        (parity(game, np.where(end, 3, states % 2 * 2)), states < 0),
        (parity(game, np.where(end, 4, 1)), states >= 0),
    ):
        found = solve(objective)
        np.testing.assert_array_equal(found.region, region)
        assert verify(found)


def test_many_priorities():
    """Priorities that are far apart, all different or beyond 2^31 stand for the same game."""
    rng = np.random.default_rng(7)
    for play in larger_games(rng, 12, shapes=((20, 2, 2), (40, 2, 2))):
        game, count = as_game(play), play.model.num_states
        priority = rng.integers(NUM_PRIORITIES, size=count)
        expected = winning_region(game, parity(game, priority)).region
        apart = priority * (2 * count + 1)
        for same in (apart, apart + 2 * rng.permutation(count), priority + 2**40):
            found = winning_region(game, parity(game, same))
            np.testing.assert_array_equal(found.region, expected)
            assert verify(found)


def test_hundreds_of_priorities_in_one_component():
    length = 700
    successor = np.roll(np.arange(length), -1)
    circle = make_sparse(None, np.arange(length + 1), successor, np.ones(length))
    game = make_game(circle, np.arange(length) % 3 == 0)
    for least in (0, 1):
        found = winning_region(game, parity(game, np.arange(length) + least))
        assert (np.asarray(found.region) == (least == 0)).all() and verify(found)
    with pytest.raises(ValueError, match="inside of jit at most"):
        compiled(game, parity(game, np.arange(length)))
