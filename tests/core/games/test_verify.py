"""The checker of winning strategies: against brute force on claims both right and wrong."""

from types import SimpleNamespace

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.games.objective import (
    GR1,
    Parity,
    buchi,
    gr1,
    parity,
    reach,
    safety,
)
from jaxltl.core.games.verify import verify
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.mdp import to_dense
from tests import reference, reference_games
from tests.support import as_mdp, random_product

SYSTEM, ENVIRONMENT = True, False


def claim(game, objective, region, action, counter_action=None):
    counter_action = action if counter_action is None else counter_action
    return SimpleNamespace(
        game=game,
        objective=objective,
        region=np.asarray(region, bool),
        action=np.asarray(action),
        counter_action=np.asarray(counter_action),
    )


def deterministic(moves, system, **labels):
    """A game without chance: the successors of each state's moves."""
    width = max(len(row) for row in moves)
    successor = np.array([[*row, *[0] * (width - len(row))] for row in moves])[:, :, None]
    available = np.array([[i < len(row) for i in range(width)] for row in moves])
    mdp = jl.make_mdp(successor, available[:, :, None] * 1.0, available=available, **labels)
    return make_game(mdp, system)


def random_claim(rng, num_states):
    """A random game and objective, with a region and strategies that are often nearly right."""
    game = reference_games.random_game(rng, num_states)
    priority = rng.integers(rng.integers(1, 5), size=num_states)
    won, lost = rng.random((2, num_states)) < 0.15
    won = won & ~lost
    fixed = np.where(won, 0, np.where(lost, 1, priority))
    model = game.model
    successor = np.where(
        (won | lost)[:, None, None], np.arange(num_states)[:, None, None], model.successor
    )
    decided = reference_games.Play(
        reference.Model(successor, model.probability, model.available, model.initial), game.system
    )
    region = reference_games.parity(decided, fixed, np.ones(num_states, bool))
    chosen = reference_games.policies(game)
    flip = rng.random(num_states) < rng.choice([0, 0.15])
    return game, priority, won, lost, region ^ flip, *chosen[rng.integers(len(chosen), size=2)]


def test_verdicts_equal_brute_force():
    rng = np.random.default_rng(0)
    seen = set()
    for _ in range(400):
        game, priority, won, lost, *rest = random_claim(rng, int(rng.integers(1, 6)))
        expected = reference_games.claims(game, priority, won, lost, *rest)
        library = Game(as_mdp(game.model), game.system)
        verdict = verify(claim(library, Parity(priority, won, lost, 5), *rest))
        assert verdict[:2] == expected, verdict.reason
        assert bool(verdict) == all(expected) == (verdict.reason == "")
        seen.add(expected)
    assert seen == {(a, b) for a in (True, False) for b in (True, False)}


def random_memory_claim(rng):
    """A random game of generalised reactivity with strategies that have memory."""
    num_states, sets = 3, rng.random((2, 2, 3)) < rng.choice([0.3, 0.6])
    game = reference_games.random_game(rng, num_states)
    region = reference_games.gr1(game, *sets, np.ones(num_states, bool))
    chosen = reference_games.policies(game)
    action, counter = (chosen[rng.integers(len(chosen), size=2)].T for _ in range(2))
    return game, sets, region ^ (rng.random(num_states) < rng.choice([0, 0.15])), action, counter


@pytest.mark.slow
def test_verdicts_with_memory_equal_brute_force():
    """The strategies are written into the states, where they have no memory."""
    rng = np.random.default_rng(1)
    seen = set()
    for _ in range(150):
        game, sets, region, action, counter = random_memory_claim(rng)
        larger, priority, _ = reference_games.gr1_as_parity(game, *sets)
        # The larger game's states are (s, i, j): the system knows j, the environment i.
        none = np.zeros(12, bool)
        expected = reference_games.claims(
            larger,
            priority,
            none,
            none,
            np.repeat(region, 4),
            np.tile(action[:, None, :], (1, 2, 1)).ravel(),
            np.tile(counter[:, :, None], (1, 1, 2)).ravel(),
        )
        library = Game(as_mdp(game.model), game.system)
        verdict = verify(claim(library, GR1(*sets, none[:3]), region, action, counter))
        assert verdict[:2] == expected, verdict.reason
        seen.add(expected)
    assert seen == {(a, b) for a in (True, False) for b in (True, False)}


def test_representations_agree():
    """A product, its explicit copy and a dense world get one verdict."""
    rng = np.random.default_rng(2)
    seen = set()
    for i in range(100):
        label_on = ("entry", "exit")[i % 2]
        lazy, explicit = random_product(rng, label_on=label_on)
        size = explicit.num_states
        system = np.repeat(rng.random(3) < 0.5, 3)
        priority = rng.integers(3, size=size)
        play = reference_games.Play(explicit, system)
        region = reference_games.parity(play, priority, np.ones(size, bool))
        chosen = reference_games.policies(play)
        action, counter = chosen[rng.integers(len(chosen), size=2)]
        none = np.zeros(size, bool)
        copy = as_mdp(explicit)
        verdicts = []
        for model in (lazy, copy, to_dense(copy)):
            shape = model.state_shape
            game = Game(model, system.reshape(shape))
            objective = Parity(*(x.reshape(shape) for x in (priority, none, none)), 3)
            one = claim(game, objective, *(x.reshape(shape) for x in (region, action, counter)))
            verdicts.append(verify(one))
        assert verdicts[1] == verdicts[2]
        assert verdicts[0][:2] == verdicts[1][:2]
        seen.add(verdicts[0][:2])
    assert len(seen) >= 3


# A game by hand. The system can go from 0 to 1 or 2; from 1 the environment goes back to 0 or
# to the trap 3; 2 goes back to 0.
MOVES, OWNERS = [[1, 2], [0, 3], [0], [3]], [SYSTEM, ENVIRONMENT, SYSTEM, ENVIRONMENT]


def by_hand(priorities=(1, 0, 0, 1)):
    game = deterministic(MOVES, OWNERS)
    return game, parity(game, np.array(priorities), num_priorities=3)


def test_a_right_claim_is_accepted():
    game, objective = by_hand()
    verdict = verify(claim(game, objective, [1, 0, 1, 0], [1, 1, 0, 0]))
    assert verdict == (True, True, "")
    assert verdict


@pytest.mark.parametrize(
    ("change", "holds", "reason"),
    [
        (
            {"action": [0, 1, 0, 0]},
            (False, True),
            "from state 0 the strategy's action 0 leaves the region",
        ),
        (
            {"action": [1, 1, 1, 0]},
            (False, True),
            "the system's strategy has no valid action: 1 is not available in state 2",
        ),
        (
            {"action": [7, 1, 0, 0]},
            (False, True),
            "the system's strategy has no valid action: 7 is not available in state 0",
        ),
        (
            {"region": [1, 1, 1, 0]},
            (False, True),
            "from state 1 the environment's action 1 leaves the region",
        ),
        (
            {"region": [1, 0, 1, 1]},
            (False, False),
            "around state 3 the run can stay for ever with least priority 1, which is odd",
        ),
        (
            {"region": [0, 0, 0, 0]},
            (True, False),
            "around state 0, outside the region, the system can stay for ever with least priority 0, "
            "which is even",
        ),
        (
            {"counter_action": [0, 2, 0, 0]},
            (True, False),
            "the environment's strategy has no valid action: 2 is not available in state 1",
        ),
        (
            {"counter_action": [0, -1, 0, 0]},
            (True, False),
            "the environment's strategy has no valid action: -1 is not available in state 1",
        ),
        (
            {"counter_action": [0, 0, 0, 0]},
            (True, False),
            "from state 1, outside the region, the system can enter the region almost surely",
        ),
        ({"won": [0, 1, 0, 0]}, (True, False), "state 1 is already won but outside the region"),
        ({"lost": [0, 0, 1, 0]}, (False, True), "state 2 is in the region but already lost"),
    ],
)
def test_each_reason_names_a_state(change, holds, reason):
    game, objective = by_hand()
    for name in ("won", "lost"):
        if name in change:
            objective = objective.replace(**{name: np.array(change[name], bool)})
    start = {"region": [1, 0, 1, 0], "action": [1, 1, 0, 0], "counter_action": [0, 1, 0, 0]}
    verdict = verify(claim(game, objective, **{k: change.get(k, x) for k, x in start.items()}))
    assert not verdict
    assert verdict[:2] == holds
    assert verdict.reason.startswith(reason)
    assert holds == (False, False) or verdict.reason == reason


def test_both_claims_can_fail_at_once():
    game, objective = by_hand()
    verdict = verify(claim(game, objective, [1, 0, 1, 0], [0, 0, 0, 0]))
    assert verdict[:2] == (False, False)
    assert verdict.reason == (
        "from state 0 the strategy's action 0 leaves the region; "
        "from state 1, outside the region, the system can enter the region almost surely"
    )


def test_reasons_with_memory():
    """Two goals: the system moves between the states 0 and 1, or stays in either."""
    game = deterministic([[0, 1], [0, 1]], [SYSTEM, SYSTEM])
    both = gr1(game, (), [np.array([True, False]), np.array([False, True])])
    right = claim(game, both, [1, 1], [[0, 1], [0, 1]], [[0], [0]])
    assert verify(right)
    right.action = np.array([[0, 0], [0, 1]])
    assert verify(right).reason == (
        "around state 0 with memory 1 the run can meet every assumption for ever and never "
        "guarantee 1"
    )
    right.action = np.array([[0, 5], [0, 1]])
    assert verify(right).reason == (
        "the system's strategy has no valid action: 5 is not available in state 0 with memory 1"
    )
    none = claim(game, both, [0, 0], [[0, 1], [0, 1]], [[0], [0]])
    assert verify(none).reason == (
        "around state 0, outside the region, the system can meet every guarantee for ever"
    )


def test_the_environment_has_to_meet_its_assumptions():
    """The environment moves between 0 and 1; it has to visit both, and no guarantee ever holds."""
    game = deterministic([[0, 1], [0, 1]], [ENVIRONMENT, ENVIRONMENT])
    first = np.array([True, False])
    objective = gr1(game, [first, ~first], [np.zeros(2, bool)])
    right = claim(game, objective, [0, 0], [[0], [0]], [[0, 1], [0, 1]])
    assert verify(right)
    right.counter_action = np.array([[0, 0], [0, 1]])
    assert verify(right).reason == (
        "around state 0 with memory 1, outside the region, the system can stay for ever without "
        "assumption 1"
    )


def test_what_follows_a_decided_state_does_not_matter():
    """State 1 leads to the trap 2, but whoever enters it has won already."""
    game = deterministic([[1], [2], [2]], [SYSTEM] * 3)
    goal = np.array([False, True, False])
    assert verify(claim(game, reach(game, goal), [1, 1, 0], [0, 0, 0]))
    unsafe = safety(game, ~goal)
    verdict = verify(claim(game, unsafe, [0, 0, 1], [0, 0, 0]))
    assert verdict, "state 2 is safe although it is only entered through an unsafe one"


def test_chance_is_fair_but_not_sure():
    """From 1 a coin leads to 0 or back; from 2 it leads to 0 or to the trap 3."""
    mdp = jl.from_dense(
        [[[1.0, 0, 0, 0]], [[0.5, 0.5, 0, 0]], [[0.5, 0, 0, 0.5]], [[0, 0, 0, 1.0]]]
    )
    objective = buchi(mdp, np.arange(4) == 0)
    assert verify(claim(mdp, objective, [1, 1, 0, 0], [0] * 4))
    assert not verify(claim(mdp, objective, [1, 0, 0, 0], [0] * 4)).environment
    assert not verify(claim(mdp, objective, [1, 1, 1, 0], [0] * 4)).system


def test_a_deep_game_of_chance():
    """A random walk on 30,000 states that falls off one end: nothing holds it for ever"""
    size = 30_000
    states = np.arange(size)
    successor = np.stack([np.maximum(states - 1, 0), np.minimum(states + 1, size - 1)], 1)
    successor[-1] = size - 1
    mdp = jl.make_mdp(successor[:, None], np.full((size, 1, 2), 0.5))
    top = buchi(mdp, states == size - 1)
    assert verify(claim(mdp, top, np.ones(size), np.zeros(size, int)))
    bottom = buchi(mdp, states == 0)
    assert verify(claim(mdp, bottom, np.zeros(size), np.zeros(size, int)))
    assert not verify(claim(mdp, bottom, np.ones(size), np.zeros(size, int))).system
    assert not verify(claim(mdp, top, np.zeros(size), np.zeros(size, int))).environment


def test_many_moves_to_one_state():
    """More parallel moves than a byte counts."""
    game = deterministic([[1] * 256, [0]], [ENVIRONMENT, SYSTEM])
    objective = buchi(game, np.array([False, True]))
    assert verify(claim(game, objective, [1, 1], [0, 0]))
    assert not verify(claim(game, objective, [0, 0], [0, 0])).environment


def test_product_states_are_named_by_both_parts():
    rng = np.random.default_rng(3)
    lazy, _ = random_product(rng)
    shape = lazy.state_shape
    objective = Parity(np.ones(shape, int), np.zeros(shape, bool), np.zeros(shape, bool), 2)
    verdict = verify(claim(lazy, objective, np.ones(shape), np.full(shape, -1)))
    assert verdict.reason == (
        "the system's strategy has no valid action: -1 is not available in state (0, 0)"
    )


def test_wrong_shapes_and_objectives():
    game, objective = by_hand()
    with pytest.raises(ValueError, match=r"region has shape \(2, 4\); expected \(4,\)"):
        verify(claim(game, objective, np.ones((2, 4)), np.zeros(4, int)))
    with pytest.raises(ValueError, match=r"action has shape \(4, 1\); expected \(4,\)"):
        verify(claim(game, objective, np.ones(4), np.zeros((4, 1), int)))
    one = gr1(game, (), [np.ones(4, bool)])
    with pytest.raises(ValueError, match=r"action has shape \(4,\); expected \(4, 1\)"):
        verify(claim(game, one, np.ones(4), np.zeros(4, int)))
    with pytest.raises(ValueError, match="objective is a str; give a Parity or a GR1"):
        verify(claim(game, "G a", np.ones(4), np.zeros(4, int)))
