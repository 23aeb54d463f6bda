"""Values of games: against brute force in fractions, published numbers, and the solvers' laws."""

from fractions import Fraction
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl import Status, check, from_dense, policy_value, restrict
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models import to_dense
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.values.average.mean_payoff import mean_payoff
from jaxltl.core.values.discounted.minimax import minimax_value, strategy_value
from tests import reference
from tests import reference_game_value as brute
from tests.support import (
    as_mdp,
    assert_encloses,
    assert_gradients,
    assert_solutions_agree,
    counts,
    lane,
    mass_preserving,
    random_product,
    stack,
)

METHODS = ("policy_iteration", "value_iteration", "strategy_iteration")
PER = ("move", "system_move")
NUM_GAMES = 150
SINGLE = 60  # lanes that are repeated in single precision
SHAPE = (4, 2, 2)  # states, actions, successors
DISCOUNTS = (0.0, 0.5, 0.875, 0.96875)  # dyadic, so that floats hold them exactly


def random_game(rng, shape=SHAPE, returning=True):
    """A random game, by default one in which the environment has to return to the system."""
    while True:
        model = reference.random_model(rng, *shape)
        system = rng.random(shape[0]) < 0.5
        if not returning or brute.returns(model, system):
            return model, system


def as_game(model, system):
    return Game(as_mdp(model), jnp.asarray(system))


@pytest.fixture(scope="module")
def cases():
    rng = np.random.default_rng(0)
    return [
        (*random_game(rng), reference.random_reward(rng, *SHAPE[:2]), rng.choice(DISCOUNTS))
        for _ in range(NUM_GAMES)
    ]


@pytest.fixture(scope="module")
def exact(cases):
    return {per: np.stack([brute.minimax_value(*case, per) for case in cases]) for per in PER}


def batch_of(cases):
    models, systems, rewards, discounts = zip(*cases, strict=True)
    games = stack([as_game(m, s) for m, s in zip(models, systems, strict=True)])
    return games, stack(rewards), stack(discounts)


def assert_certified(solution, exact, tolerance=None):
    solution = jax.tree.map(np.asarray, solution)
    assert (solution.status == Status.CONVERGED).all()
    assert_encloses(solution, exact)
    width = np.asarray(solution.upper - solution.lower)
    scale = 1 + np.abs(exact.astype(float)).max(axis=-1, keepdims=True)
    eps = jnp.finfo(solution.value.dtype).eps
    allowed = 2 * tolerance + 8 * eps * scale if tolerance else 3e5 * eps * scale
    assert (width <= allowed).all()
    assert ((solution.lower <= solution.value) & (solution.value <= solution.upper)).all()


@cache  # compiling is what these tests spend their time on
def solver(method, per):
    """minimax_value of a batch, compiled once for all tests."""

    def solve(game, reward, discount, allowed, tolerance):
        return minimax_value(
            game, reward, discount, per=per, method=method, allowed=allowed, tolerance=tolerance
        )

    return jax.jit(jax.vmap(solve, (0, 0, 0, 0, None)))


@pytest.fixture(scope="module")
def batch(cases):
    return batch_of(cases)


# --- minimax values ------------------------------------------------------------------------


# Of the other methods the games below ask by the system's moves.
@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("method", "per"),
    [
        *((method, "move") for method in METHODS),
        (METHODS[0], "system_move"),
        *(
            pytest.param(method, "system_move", marks=pytest.mark.exhaustive)
            for method in METHODS[1:]
        ),
    ],
)
def test_minimax_values_are_those_of_all_strategy_pairs(batch, exact, method, per):
    games, rewards, discounts = batch
    solution = solver(method, per)(games, rewards, discounts, games.available, 1e-8)
    assert_certified(solution, exact[per], 1e-8)
    near = solver(method, per)(games, rewards, discounts, games.available, 1e-4)
    assert_certified(near, exact[per], 1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("double", [True, False])
def test_without_a_tolerance_the_enclosure_is_as_narrow_as_floats_allow(cases, exact, double):
    with jax.enable_x64(double):
        games, rewards, discounts = batch_of(cases[:SINGLE])
        solution = jax.jit(jax.vmap(lambda g, r, d: minimax_value(g, r, d, per="system_move")))(
            games, rewards, jnp.asarray(discounts)
        )
        assert solution.value.dtype == (jnp.float64 if double else jnp.float32)
        assert_certified(solution, exact["system_move"][:SINGLE])


@pytest.mark.parametrize("per", PER)
def test_both_players_policies_secure_the_bounds(cases, batch, per):
    games, rewards, discounts = batch
    solution = solver(METHODS[0], per)(games, rewards, discounts, games.available, 1e-4)
    for i, (model, system, reward, discount) in enumerate(cases[:60]):
        one = lane(solution, i)
        chosen = np.arange(SHAPE[1]) == np.asarray(one.policy)[:, None]
        for mine, bound, sign in ((system, one.lower, 1), (~system, one.upper, -1)):
            allowed = np.where(mine[:, None], chosen, model.available)
            secured = brute.minimax_value(model, system, reward, discount, per, allowed)
            assert (sign * (secured - np.asarray(bound)) >= 0).all()


def test_rewards_on_transitions_count_in_the_mean(cases):
    model, system, _, _ = cases[3]
    reward = np.random.default_rng(2).normal(size=SHAPE)
    one = minimax_value(as_game(model, system), reward, 0.9)
    mean = (model.probability * reward).sum(-1)
    assert_solutions_agree(one, minimax_value(as_game(model, system), mean, 0.9))


def test_long_stretches_of_the_environment_and_chance_that_only_probably_leaves():
    """Undiscounted moves in a row, one with a loop: all of it known in closed form."""
    stay = 0.875
    chain = np.zeros((5, 1, 5))
    chain[0, 0, 1] = chain[1, 0, 2] = chain[2, 0, 3] = chain[4, 0, 0] = 1
    chain[3, 0, 3], chain[3, 0, 4] = stay, 1 - stay
    game = make_game(from_dense(chain), [True, False, False, False, False])
    reward = jnp.array([[3.0], [1.0], [-1.0], [0.25], [0.0]])
    loop = 3 + 0.9 * (1 - 1 + 0.25 / (1 - stay))
    start = loop / (1 - 0.9)
    expected = [start, start + 2, start + 1, start + 2, start]
    found = check(minimax_value(game, reward, 0.9, per="system_move"))
    np.testing.assert_allclose(found.value, expected, rtol=1e-12)
    assert_encloses(found, np.array(expected))


def cycling_game():
    """Strategies that are greedy for the value of the last two come back after three steps."""
    successor = np.array([[3, 1], [1, 1], [0, 1], [2, 0]])
    reward = np.array([[-3.0, 2.0], [2.0, -3.0], [-2.0, -1.0], [-2.0, -3.0]])
    return successor, np.array([True, False, True, False]), reward


def test_evaluating_both_players_greedy_choices_in_full_goes_in_circles():
    """Why modified policy iteration has to look at its residual."""
    successor, system, reward = cycling_game()
    states, sign = np.arange(4), np.where(system, 1, -1)[:, None]
    policy, seen = (sign * reward).argmax(1), []
    while tuple(policy) not in seen:
        seen.append(tuple(policy))
        step = np.eye(4)[successor[states, policy]]
        value = np.linalg.solve(np.eye(4) - 0.99 * step, reward[states, policy])
        policy = (sign * (reward + 0.99 * value[successor])).argmax(1)
    assert tuple(policy) != seen[-1]

    both, sure = np.stack([successor] * 2, -1), np.broadcast_to([1.0, 0.0], (*successor.shape, 2))
    game = as_game(reference.Model(both, sure, np.ones(SHAPE[:2], bool), np.eye(4)[0]), system)
    full = {"tolerance": 1e-9, "max_steps": 5000}
    found = {
        method: check(minimax_value(game, reward, 0.99, method=method, **full))
        for method in METHODS
    }
    assert found["strategy_iteration"].num_steps < 20
    for method in METHODS:
        np.testing.assert_allclose(found[method].value, found[METHODS[1]].value, atol=2e-9)


# --- the mask ------------------------------------------------------------------------------


@pytest.mark.parametrize("per", PER)
def test_a_mask_restricts_and_getting_stuck_is_worth_minus_infinity(cases, batch, per):
    games, rewards, discounts = batch
    masks = np.random.default_rng(4).random((NUM_GAMES, *SHAPE[:2])) < 0.75
    found = solver(METHODS[0], per)(games, rewards, discounts, jnp.asarray(masks), 1e-8)
    assert (found.status == Status.CONVERGED).all()
    num_lost = 0
    for i, (model, system, reward, discount) in enumerate(cases[:80]):
        expected = brute.minimax_value(
            model, system, reward, discount, per, model.available & masks[i]
        )
        lost = expected.astype(float) == -np.inf
        num_lost += lost.sum()
        for field in ("value", "lower", "upper"):
            assert ((np.asarray(getattr(found, field)[i]) == -np.inf) == lost).all()
        assert_encloses(lane(found, i), np.where(lost, -np.inf, expected))
    assert 30 < num_lost < 80 * SHAPE[0] - 30


@pytest.mark.slow
def test_a_closed_mask_gives_the_values_of_the_restricted_game():
    game, reward, allowed = robots(3)
    inside = restrict(game, allowed=allowed)
    whole = minimax_value(game, reward, 0.9, per="system_move", allowed=allowed)
    part = minimax_value(inside.model, reward[inside.base_state], 0.9, per="system_move")
    np.testing.assert_allclose(whole.value[inside.base_state], part.value, atol=1e-10)


# --- published numbers ---------------------------------------------------------------------


def robots(size):
    """Two robots that move in turns on a grid: the game, its reward, and the safe moves.

    State ``(x * cells + y) * 2 + turn``: the environment's cell, the system's, and 1 where the
    system moves. It is paid for moves to a diagonal neighbour of the environment.
    """
    cells = size * size
    moves = [(-1, 0), (1, 0), (0, -1), (0, 1), (0, 0)]
    successor = np.zeros((cells, cells, 2, 5), int)
    available = np.zeros((cells, cells, 2, 5), bool)
    reward = np.zeros((cells, cells, 2, 5))
    for x, y, turn, a in np.ndindex(successor.shape):
        row, column = np.add(divmod(y if turn else x, size), moves[a])
        if (a == 4 and not turn) or not (0 <= row < size and 0 <= column < size):
            continue
        to = row * size + column
        available[x, y, turn, a] = True
        successor[x, y, turn, a] = (x * cells + to) * 2 if turn else (to * cells + y) * 2 + 1
        away = np.abs(np.subtract(divmod(to, size), divmod(x, size)))
        reward[x, y, turn, a] = turn == 1 and (away == 1).all()
    flat = (cells * cells * 2, 5)
    x, y, turn = (i.ravel() for i in np.indices((cells, cells, 2)))
    start = ((x != y) & (turn == 1)).astype(float)
    available = available.reshape(flat)
    world = make_mdp(
        successor.reshape(*flat, 1),
        available[..., None] * 1.0,
        available=available,
        initial=start / start.sum(),
    )
    game = make_game(world, turn == 1)
    lost = np.asarray(attractor(game, jnp.asarray(x == y), rule=~game.system).region)
    to_lost = lost[successor.reshape(flat)] & (turn == 1)[:, None]
    return game, jnp.asarray(reward.reshape(flat)), available & ~lost[:, None] & ~to_lost


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "method", "states", "counts"),
    [
        *((3, method, 120, {10.0: 56, 9.0: 16}) for method in METHODS),
        pytest.param(
            4,
            METHODS[0],
            432,
            {10.0: 132, 9.0: 44, 8.1: 48, 7.29: 16},
            marks=pytest.mark.exhaustive,
        ),
    ],
)
def test_robots_on_a_grid(size, method, states, counts):
    """The dissertation's Example 1 (section 5.5, figure 13 and table 5)."""
    game, reward, allowed = robots(size)
    inside = restrict(game, allowed=allowed)
    assert inside.model.num_states == states
    found = check(
        minimax_value(
            inside.model,
            reward[inside.base_state],
            0.9,
            per="system_move",
            method=method,
            tolerance=1e-6,
        )
    )
    value = np.asarray(found.value)[np.asarray(inside.model.system)]
    numbers, times = np.unique(value.round(4), return_counts=True)
    assert dict(zip(numbers.tolist(), times.tolist(), strict=True)) == counts


# --- values of strategies ------------------------------------------------------------------


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("method", "per"),
    [(METHODS[0], "system_move"), (METHODS[1], "move"), (METHODS[2], "system_move")],
)
def test_worst_cases_of_strategies(cases, method, per):
    rng = np.random.default_rng(5)
    drawn = [reference.random_policy(rng, case[0]) for case in cases[:150]]
    games, rewards, discounts = batch_of(cases[:150])
    mixed = jax.jit(
        jax.vmap(lambda g, p, r, d: strategy_value(g, p, r, d, per=per, method=method))
    )(games, stack(drawn), rewards, discounts)
    assert_certified(
        mixed,
        np.stack(
            [
                brute.strategy_value(model, system, policy, reward, discount, per)
                for (model, system, reward, discount), policy in zip(cases, drawn, strict=False)
            ]
        ),
    )
    assert mixed.policy.shape == (150, *SHAPE[:2])


@pytest.mark.parametrize(
    "kinds", [("int", "int"), ("int", "float"), ("float", "int"), ("float", "float")]
)
def test_against_a_given_environment_it_is_the_value_of_both(cases, kinds):
    rng = np.random.default_rng(6)
    for model, system, reward, discount in cases[:4]:
        given = [reference.random_policy(rng, model) for _ in kinds]
        given = [p.argmax(-1) if k == "int" else p for p, k in zip(given, kinds, strict=True)]
        rows = [np.eye(SHAPE[1])[p] if p.ndim == 1 else p for p in given]
        joint = np.where(system[:, None], *rows)
        found = strategy_value(
            as_game(model, system), given[0], reward, discount, environment=given[1]
        )
        expected = policy_value(as_mdp(model), jnp.asarray(joint), reward, discount)
        np.testing.assert_allclose(found.value, expected.value, atol=1e-9)
        assert_encloses(found, reference.exact_policy_value(model, joint, reward, discount))


def test_a_loop_that_a_given_environment_leaves_by_chance_has_a_value():
    """The environment could stay for ever, but its policy does not."""
    world = from_dense([[[0, 1.0], [0, 1.0]], [[0, 1.0], [1.0, 0]]])
    game = make_game(world, [True, False])
    reward = jnp.array([[1.0, 1.0], [1.0, 0.0]])
    policy = jnp.array([[0.5, 0.5], [0.75, 0.25]])
    with pytest.raises(ValueError, match="state 1"):
        strategy_value(game, jnp.array([0, 0]), reward, 0.5, per="system_move")
    found = check(
        strategy_value(game, jnp.array([0, 0]), reward, 0.5, per="system_move", environment=policy)
    )
    np.testing.assert_allclose(found.value, [5.0, 8.0], rtol=1e-12)


def test_rows_of_another_player_are_not_read_and_others_have_to_be_distributions():
    # 0 is the environment's and goes to 1 or 2; 3 stays apart.
    world = from_dense(np.eye(4)[[[1, 2], [0, 0], [0, 0], [3, 3]]])
    game = make_game(world, [False, True, True, True])
    reward = jnp.array([[0.0, 0], [1, 1], [2, 2], [1, 1]])
    found = strategy_value(game, np.array([7, 0, 0, 1]), reward, 0.5)
    np.testing.assert_allclose(found.value, [2 / 3, 4 / 3, 7 / 3, 2.0])
    kind = strategy_value(
        game, np.array([-1, 0, 0, 1]), reward, 0.5, environment=np.array([1, -1, 5, 2])
    )
    np.testing.assert_allclose(kind.value, [4 / 3, 5 / 3, 8 / 3, 2.0])
    with pytest.raises(ValueError, match="takes action -1 in state 2"):
        strategy_value(game, np.array([0, 0, -1, 1]), reward, 0.5)
    with pytest.raises(ValueError, match="takes action 2 in state 0"):
        strategy_value(game, np.zeros(4, int), reward, 0.5, environment=np.array([2, 0, 0, 0]))


def test_where_nobody_can_move_is_worth_minus_infinity_and_what_leads_there_too():
    # 0 is the environment's and goes to 1 or 2; 2 has no move; 3 stays apart.
    world = from_dense(np.eye(4)[[[1, 2], [0, 0], [0, 0], [3, 3]]])
    available = np.array([[1, 1], [1, 1], [0, 0], [1, 1]], bool)
    game = Game(world.replace(available=available), np.array([False, True, True, True]))
    strategy = np.array([0, 0, -1, 1])
    found = strategy_value(game, strategy, jnp.ones((4, 2)), 0.5)
    assert found.status == Status.CONVERGED
    np.testing.assert_allclose(found.value, [-np.inf, -np.inf, -np.inf, 2.0])
    kind = strategy_value(game, strategy, jnp.ones((4, 2)), 0.5, environment=np.zeros(4, int))
    np.testing.assert_allclose(kind.value, [2.0, 2.0, -np.inf, 2.0])


# --- representations, derivatives, laws ----------------------------------------------------


def test_derivatives():
    rng = np.random.default_rng(8)
    model, system = random_game(rng, (5, 2, 2))
    probability = np.where(model.probability > 0, rng.uniform(0.2, 1, model.probability.shape), 0)
    probability /= np.where(model.available, probability.sum(-1), 1)[..., None]
    mdp = as_mdp(model)
    point = {
        "reward": rng.normal(size=(5, 2)),
        "discount": 0.8,
        "probability": probability,
        "strategy": np.where(model.available, rng.uniform(0.2, 1, (5, 2)), 0),
    }
    point["strategy"] /= point["strategy"].sum(-1, keepdims=True)
    directions = {
        "reward": rng.normal(size=(5, 2)),
        "discount": 1.0,
        "probability": mass_preserving(rng, probability),
        "strategy": mass_preserving(rng, point["strategy"]),
    }

    def answer(x):
        game = Game(mdp.replace(probability=x["probability"]), jnp.asarray(system))
        best = minimax_value(game, x["reward"], x["discount"], per="system_move", tolerance=1e-12)
        worst = strategy_value(game, x["strategy"], x["reward"], x["discount"], tolerance=1e-12)
        return best.value, worst.value

    assert_gradients(answer, point, directions)


def test_lost_states_have_no_derivative_and_spoil_none():
    world = from_dense(np.eye(3)[[[0, 1], [1, 1], [2, 2]]])
    game = make_game(world, [True, True, False])
    allowed = jnp.array([[True, True], [False, False], [True, True]])

    def total(reward):
        value = minimax_value(game, reward, 0.5, allowed=allowed).value
        return jnp.sum(jnp.where(jnp.isfinite(value), value, 0))

    slope = jax.grad(total)(jnp.array([[1.0, 9.0], [1.0, 1.0], [1.0, 2.0]]))
    np.testing.assert_allclose(slope, [[2.0, 0], [0, 0], [2.0, 0]], atol=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_how_it_ends_when_it_cannot_converge(cases, method):
    model, system, reward, _ = cases[0]
    game = as_game(model, system)
    options = {"method": method, "max_steps": 1, "tolerance": 1e-9}  # one program for all
    short = minimax_value(game, reward, 0.9, **options)
    assert short.status == Status.MAX_STEPS
    assert short.num_steps == 1
    assert_encloses(short, brute.minimax_value(model, system, reward, 0.9, "move"))
    vain = minimax_value(game, reward, 0.9, method=method, tolerance=1e-20, max_steps=10_000)
    assert vain.status == Status.PRECISION
    assert vain.num_steps < 1000
    bad = minimax_value(game, np.full_like(reward, np.nan), 0.5, **options)
    assert bad.status == Status.NONFINITE
    assert (bad.lower == -np.inf).all()
    assert (bad.upper == np.inf).all()


# --- mean payoff ---------------------------------------------------------------------------


def deterministic(rng, num_states, num_actions):
    successor = rng.integers(num_states, size=(num_states, num_actions))
    available = rng.random(successor.shape) < 0.8
    available[np.arange(num_states), rng.integers(num_actions, size=num_states)] = True
    return successor, available, rng.random(num_states) < 0.5


def as_deterministic_game(successor, available, system):
    mdp = make_mdp(successor[..., None], available[..., None] * 1.0, available=available)
    return Game(mdp, jnp.asarray(system))


def assert_mean_payoff(rng, num_states, num_actions, reward):
    assert_solved(*deterministic(rng, num_states, num_actions), reward)


def assert_solved(successor, available, system, reward):
    """The exact value, and strategies of both players that secure it."""
    found = mean_payoff(as_deterministic_game(successor, available, system), jnp.asarray(reward))
    assert found.status == Status.CONVERGED
    exact = brute.mean_payoff(successor, available, system, reward)
    assert_encloses(found, exact)
    np.testing.assert_array_equal(found.value, exact.astype(float))
    chosen = np.arange(available.shape[1]) == np.asarray(found.policy)[:, None]
    assert (chosen & available).any(axis=1).all()
    for mine in (system, ~system):
        fixed = np.where(mine[:, None], chosen, available)
        np.testing.assert_array_equal(brute.mean_payoff(successor, fixed, system, reward), exact)


@counts(40, 300)
def test_mean_payoffs_are_those_of_all_strategy_pairs(count):
    """Small whole rewards make ties, and so games in which improvements do not show in gains."""
    rng = np.random.default_rng(9)
    for i in range(count):
        num_states, num_actions = ((5, 2), (4, 3))[i % 2]
        shape = (num_states, num_actions)
        reward = rng.integers(-1 - i % 3, 2 + i % 3, shape).astype(float)
        assert_mean_payoff(rng, num_states, num_actions, reward)


def test_an_answer_that_is_best_only_before_biases_are_taken_over_is_not_kept():
    successor = np.array([[1, 4], [3, 0], [4, 4], [4, 0], [3, 3]])
    reward = np.array([[1.0, -1], [1, -1], [0, -1], [1, 0], [-1, 1]])
    system = np.array([True, False, False, True, False])
    assert_solved(successor, np.ones((5, 2), bool), system, reward)


def test_mean_payoffs_of_any_floats_are_exact():
    rng = np.random.default_rng(10)
    for i in range(40):
        reward = rng.normal(size=(4, 2)) * 10.0 ** rng.integers(-12, 12, (4, 2))
        if i % 2:
            reward = rng.choice([0.1, 0.2, 0.3, 1e300], (4, 2))
        assert_mean_payoff(rng, 4, 2, reward)


def test_a_large_mean_payoff_game_satisfies_its_equations():
    """The strategies of both players are best answers to each other, by Karp's theorem."""
    rng = np.random.default_rng(12)
    size = 150
    successor, available, system = deterministic(rng, size, 3)
    reward = rng.integers(-9, 10, (size, 3)).astype(float)
    found = check(mean_payoff(as_deterministic_game(successor, available, system), reward))
    chosen = np.arange(3) == np.asarray(found.policy)[:, None]
    for mine, sign in ((system, 1), (~system, -1)):
        moves = np.where(mine[:, None], chosen, available)
        np.testing.assert_allclose(
            sign * least_cycle_mean(successor, moves, sign * reward), found.value, atol=1e-12
        )


def least_cycle_mean(successor, moves, weight):
    """Least mean of a cycle from each state (Karp 1978, from each state separately)."""
    size = len(successor)
    cost = np.full((size + 1, size, size), np.inf)  # steps, start, now
    cost[0] = np.where(np.eye(size, dtype=bool), 0, np.inf)
    for n in range(size):
        for s, a in np.argwhere(moves):
            t = successor[s, a]
            cost[n + 1, :, t] = np.minimum(cost[n + 1, :, t], cost[n, :, s] + weight[s, a])
    steps = (size - np.arange(size))[:, None, None]
    with np.errstate(invalid="ignore"):
        mean = (cost[size] - cost[:size]) / steps
    mean = np.where(np.isfinite(cost[:size]), mean, -np.inf).max(axis=0)
    return np.where(np.isfinite(cost[size]), mean, np.inf).min(axis=1)


def test_mean_payoffs_in_products_and_dense_games():
    rng = np.random.default_rng(13)
    lazy, model = random_product(rng, num_successors=1, certainty=1.0)
    system = rng.random(lazy.state_shape) < 0.5
    reward = rng.integers(-3, 4, (*lazy.state_shape, 2)).astype(float)
    found = mean_payoff(Game(lazy, jnp.asarray(system)), reward)
    flat = as_game(model, system.ravel())
    other = mean_payoff(flat, reward.reshape(-1, 2))
    on_transitions = np.repeat(reward.reshape(-1, 2, 1), model.num_states, axis=2)
    dense = mean_payoff(Game(to_dense(flat.mdp), flat.system), on_transitions)
    np.testing.assert_array_equal(found.value.ravel(), other.value)
    np.testing.assert_array_equal(dense.value, other.value)


def test_mean_payoff_in_single_precision_encloses_a_third():
    with jax.enable_x64(False):
        game = make_game(from_dense(np.eye(3)[[[1], [2], [0]]]), [True, True, False])
        found = mean_payoff(game, jnp.array([[1.0], [0], [0]]))
        assert found.value.dtype == jnp.float32
        assert_encloses(found, np.full(3, Fraction(1, 3)))
    short = mean_payoff(game, jnp.array([[1.0], [0], [0]]), max_steps=0)
    assert short.status == Status.MAX_STEPS
    assert (short.upper == np.inf).all()


# --- what is refused -----------------------------------------------------------------------


def small_game():
    return make_game(from_dense(np.eye(2)[[[1, 1], [0, 1]]]), [True, False])


@pytest.mark.parametrize(
    ("words", "call"),
    [
        ("method='newton'", lambda g: minimax_value(g, jnp.zeros((2, 2)), 0.5, method="newton")),
        ("per='turn'", lambda g: minimax_value(g, jnp.zeros((2, 2)), 0.5, per="turn")),
        ("reward has shape", lambda g: minimax_value(g, jnp.zeros(3), 0.5)),
        (
            "allowed has shape",
            lambda g: minimax_value(g, jnp.zeros((2, 2)), 0.5, allowed=[True] * 2),
        ),
        (
            "state 1 the environment can move for ever",
            lambda g: minimax_value(g, jnp.zeros((2, 2)), 0.5, per="system_move"),
        ),
        (
            "strategy .of integers. has shape",
            lambda g: strategy_value(g, jnp.zeros(3, int), jnp.zeros((2, 2)), 0.5),
        ),
        (
            "environment .stochastic. has shape",
            lambda g: strategy_value(
                g, jnp.zeros(2, int), jnp.zeros((2, 2)), 0.5, environment=jnp.ones((2, 3))
            ),
        ),
        (
            "environment='fair'",
            lambda g: strategy_value(
                g, jnp.zeros(2, int), jnp.zeros((2, 2)), 0.5, environment="fair"
            ),
        ),
        (
            "state 1, action 0 is inf",
            lambda g: mean_payoff(g, jnp.array([[0.0, 0.0], [jnp.inf, 0.0]])),
        ),
        ("outside jit", lambda g: jax.jit(mean_payoff)(g, jnp.zeros((2, 2)))),
    ],
)
def test_misuse_is_named(words, call):
    with pytest.raises(ValueError, match=words):
        call(small_game())


def test_mean_payoff_refuses_chance():
    game = make_game(from_dense([[[0.5, 0.5]], [[1.0, 0]]]), [True, False])
    with pytest.raises(ValueError, match="several successors"):
        mean_payoff(game, jnp.zeros((2, 1)))


def test_under_jit_an_environment_that_never_returns_is_a_status():
    solve = jax.jit(lambda g, r: minimax_value(g, r, 0.5, per="system_move"))
    found = solve(small_game(), jnp.ones((2, 2)))
    assert found.status == Status.NONFINITE
    assert (found.upper == np.inf).all()
    # A mask that keeps it from looping gives the game a value.
    allowed = jnp.array([[True, True], [True, False]])
    kept = minimax_value(small_game(), jnp.ones((2, 2)), 0.5, per="system_move", allowed=allowed)
    np.testing.assert_allclose(kept.value, [3.0, 4.0])
