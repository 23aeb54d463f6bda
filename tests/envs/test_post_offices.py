"""Two post offices: every move against a plain reading, and what the dissertation's example has."""

from itertools import product as pairs

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos.common import pac
from jaxltl.core.games.objective import buchi
from jaxltl.core.games.winning import solve
from jaxltl.core.models.game import is_deterministic
from jaxltl.core.models.ops.operators import expectation
from jaxltl.envs.post_offices import ACTIONS, patrol, patrol_reward, post_offices, surveillance

MAX_PROGRAMS = 350  # that the default tests compile at most

DISCOUNT = 0.6
STEPS = {"up": (-1, 0), "down": (1, 0), "left": (0, -1), "right": (0, 1)}
DANGER = {  # by the light: the block, and the moves round it that are paid
    1: (
        {(0, 0), (0, 1), (1, 0), (1, 1)},
        {(0, 0): "down", (1, 0): "right", (1, 1): "up", (0, 1): "left"},
    ),
    0: (
        {(1, 1), (1, 2), (2, 1), (2, 2)},
        {(1, 1): "right", (1, 2): "down", (2, 2): "left", (2, 1): "up"},
    ),
}
P1, P2 = (0, 2), (2, 0)


def plain_moves(cell, light, turn):
    """``{action: (cell, light, turn, reward)}`` of a state of the world."""
    if not turn:
        return {"off": (cell, 0, 1, 0), "on": (cell, 1, 1, 0)}
    block, way = DANGER[light]
    moves = {}
    for action, (down, right) in STEPS.items():
        target = (cell[0] + down, cell[1] + right)
        if target in pairs(range(3), repeat=2):
            paid = target in block and (cell not in block or way[cell] == action)
            moves[action] = (target, light, 0, int(paid))
    return moves


def plain_memory(memory, cell):
    """The next of q1 to q4, numbered from 0, when a cell is left."""
    if cell == P1:
        return {0: 1, 1: 1, 2: 3, 3: 1}[memory]
    if cell == P2:
        return {0: 2, 1: 3, 2: 2, 3: 2}[memory]
    return 0 if memory == 3 else memory


def number(cell, light, turn, memory=0, num_memory=1):
    return (((3 * cell[0] + cell[1]) * 2 + light) * 2 + turn) * num_memory + memory


STATES = list(pairs(pairs(range(3), repeat=2), (0, 1), (0, 1)))


def assert_moves(game, reward, state, expected):
    """A state has exactly the expected moves: ``{action: (successor, reward)}``."""
    found = {
        ACTIONS[a]: (int(game.mdp.successor[state, a, 0]), float(reward[state, a]))
        for a in np.flatnonzero(game.available[state])
    }
    assert found == expected
    assert not np.asarray(reward[state])[~np.asarray(game.available[state])].any()


def test_the_world_by_a_plain_reading():
    game = jax.tree.map(np.asarray, post_offices())
    reward = np.asarray(patrol_reward(game))
    assert game.num_states == len(STATES) == 36
    assert is_deterministic(game)
    assert game.propositions == ("p1", "p2")
    for cell, light, turn in STATES:
        state = number(cell, light, turn)
        assert bool(game.system[state]) == bool(turn)
        assert game.label[state].tolist() == [cell == P1, cell == P2]
        assert game.initial[state] == pytest.approx(turn / 18)
        assert_moves(
            game,
            reward,
            state,
            {
                action: (number(*target), paid)
                for action, (*target, paid) in plain_moves(cell, light, turn).items()
            },
        )


def test_what_is_learned_by_a_plain_reading():
    model = jax.tree.map(np.asarray, patrol())
    game = model.game
    assert game.num_states == 144
    for (cell, light, turn), memory in pairs(STATES, range(4)):
        state = number(cell, light, turn, memory, 4)
        assert (model.cell[state], model.light[state], model.memory[state]) == (
            3 * cell[0] + cell[1],
            light,
            memory,
        )
        assert bool(model.accepting[state]) == (memory == 3)
        assert bool(game.system[state]) == bool(turn)
        assert game.initial[state] == pytest.approx((turn and memory == 0) / 18)
        then = plain_memory(memory, cell)
        assert_moves(
            game,
            model.reward,
            state,
            {
                action: (number(*target, then, 4), paid)
                for action, (*target, paid) in plain_moves(cell, light, turn).items()
            },
        )


def test_the_automaton_says_what_the_formula_says():
    automaton = surveillance()
    formula = jl.to_automaton("G F p1 & G F p2")
    assert jl.automata.is_equivalent(automaton, formula)
    assert not jl.automata.is_equivalent(automaton, jl.to_automaton("G F p1"))
    assert automaton.acceptance == "buchi"
    assert automaton.state_names[int(automaton.initial)] == "q1"
    np.testing.assert_array_equal(automaton.delta[3], automaton.delta[0])


def test_the_reward_of_a_product_is_that_of_the_world():
    game = post_offices()
    reward = patrol_reward(game)
    assert reward.sum() > 0
    task = jl.product(game, "G F p1 & G F p2")
    lifted = patrol_reward(task)
    assert lifted.shape == (*task.state_shape, game.num_actions)
    np.testing.assert_array_equal(lifted, np.repeat(reward[:, None], task.state_shape[1], axis=1))


def test_the_reward_of_another_game():
    with pytest.raises(ValueError, match=r"states and actions \(144, 6\); give post_offices\(\)"):
        patrol_reward(patrol().game)


# --- the published example -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def model():
    return patrol()


@pytest.fixture(scope="module")
def optimal(model):
    return jl.check(jl.minimax_value(model.game, model.reward, DISCOUNT))


@pytest.fixture(scope="module")
def quantity(model, optimal):
    return model.reward + DISCOUNT * expectation(model.game, optimal.value)


def worst(model, strategy):
    return jl.check(jl.values.strategy_value(model.game, strategy, model.reward, DISCOUNT))


def test_sizes(model):
    game = model.game
    assert (game.num_states, int(game.system.sum())) == (144, 72)
    moves = np.asarray(game.available.sum(axis=1))
    assert moves[game.system].sum() == 192
    assert moves[~game.system].sum() == 144
    reachable = jl.restrict(game).model
    assert (reachable.num_states, int(reachable.system.sum())) == (108, 54)
    assert not np.asarray(model.memory)[np.asarray(game.initial) > 0].any()


def test_the_task_can_be_done_from_everywhere(model):
    assert jl.games.almost_sure_buchi(model.game, model.accepting).region.all()
    whole = jl.winning_region(post_offices(), "G F p1 & G F p2")
    assert whole.region.all()
    assert jl.verify(whole)


@pytest.mark.slow
def test_optimal_values(model, optimal):
    value = np.asarray(optimal.value)[np.asarray(model.game.system)]
    values, counts = np.unique(value.round(6), return_counts=True)
    assert values.tolist() == [0.545417, 1.196350, 1.430686, 1.515047, 1.545417]
    assert counts.tolist() == [8, 8, 16, 24, 16]


def test_the_uniform_strategy(model):
    available = model.game.available
    value = worst(model, available / available.sum(axis=1, keepdims=True)).value[model.game.system]
    found = [value.min(), value.max(), value.mean()]
    np.testing.assert_allclose(found, [0.175092, 0.675092, 0.507881], atol=5e-7)


def test_the_best_patrol_visits_no_post_office(model, quantity):
    game = model.game
    best = pac.near_optimal(quantity, game.available, 1e-9)
    moves = jnp.where(game.system[:, None], best, game.available)
    objective = buchi(game, model.accepting)
    assert solve(game, objective, game.available).region.all()
    assert not solve(game, objective, moves).region.any()


def test_the_hat_strategy_is_nearly_optimal_everywhere(model, optimal, quantity):
    epsilon, game = 1e-4, model.game
    tolerance = pac.action_tolerance(epsilon, DISCOUNT)
    p = pac.exploration(epsilon, DISCOUNT, 1.0)
    np.testing.assert_allclose([tolerance, p], [3.33333e-6, 5.33333e-7], rtol=2e-6)
    near = pac.near_optimal(quantity, game.available, tolerance)
    value = worst(model, pac.hat_strategy(near, game.available, p))
    assert pac.epsilon_optimal_states(optimal, value, epsilon).all()
    gap = float(jnp.max(optimal.value - value.value))
    assert gap == pytest.approx(5.8777e-7, abs=1e-11)
    assert float(jnp.max(optimal.upper - value.lower)) <= epsilon / 6
    assert pac.epsilon_optimal_states(optimal, value, 1e-6).all()
    assert not pac.epsilon_optimal_states(optimal, value, 1e-7).any()


def test_a_winning_strategy_of_the_hat_game_is_nearly_optimal_too(model, optimal, quantity):
    epsilon, game = 1e-4, model.game
    near = pac.near_optimal(quantity, game.available, pac.action_tolerance(epsilon, DISCOUNT))
    p = pac.exploration(epsilon, DISCOUNT, 1.0)
    hat = pac.hat_game(game, near, p)
    # The states' copies are not accepting, as in the dissertation.
    accepting = jnp.pad(model.accepting, (0, 2 * game.num_states))
    found = jl.games.almost_sure_buchi(hat, accepting)
    assert found.region.all()
    chosen = jax.nn.one_hot(found.action, hat.num_actions)
    value = worst(model, pac.recover_hat_strategy(hat, chosen))
    assert pac.epsilon_optimal_states(optimal, value, epsilon).all()
    gap = float(jnp.max(optimal.value - value.value))
    # Which of several winning moves is taken matters a little.
    assert gap == pytest.approx(9.494e-7, rel=1e-4)
    assert gap <= float(pac.mixing_gap(p, 0.0, DISCOUNT, 1.0)) <= epsilon / 6


def test_visits_of_the_example(model):
    game = model.game
    visits = pac.visits(1e-4, 0.1, DISCOUNT, 1.0, game.num_states, game.num_actions)
    assert float(visits) == pytest.approx(1.4193e19, rel=1e-7)
