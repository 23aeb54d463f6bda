"""Constants and bounds of learning against plain arithmetic, and the lemmas on random games."""

import math
from dataclasses import replace
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos.common import pac
from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import MDP, from_dense, to_dense
from jaxltl.core.models.ops import operators
from jaxltl.core.models.ops.operators import expectation
from tests.reference_games import buchi, random_game
from tests.support import as_mdp, counted_traces

MAX_PROGRAMS = 450  # that the default tests compile at most

SINGLE, DOUBLE = np.float32, np.float64

# Compiled as wholes, which takes less long than operation by operation.
forall_successor, hat_game, hat_strategy, recover_hat_strategy = map(
    jax.jit, (operators.forall_successor, pac.hat_game, pac.hat_strategy, pac.recover_hat_strategy)
)


# --- constants -----------------------------------------------------------------------------------


def plain(epsilon, failure, discount, bound, states, actions):
    """Line 8 of algorithm 5, as it stands there, and the horizon of its proof."""
    log = math.log(epsilon * (1 - discount) ** 2 / (6 * bound))
    delta = epsilon * (1 - discount) ** 2 * math.log(discount) / (6 * bound * states * log)
    return {
        "horizon": log / math.log(discount),
        "accuracy": delta,
        "visits": math.log(4 * actions * states**2 / failure) / (2 * delta**2),
        "action_tolerance": (1 - discount) * epsilon / 12,
        "exploration": epsilon * (1 - discount) ** 3 / (12 * bound),
    }


def constants(epsilon, failure, discount, bound, states, actions):
    return {
        "horizon": pac.horizon(epsilon, discount, bound),
        "accuracy": pac.accuracy(epsilon, discount, bound, states),
        "visits": pac.visits(epsilon, failure, discount, bound, states, actions),
        "action_tolerance": pac.action_tolerance(epsilon, discount),
        "exploration": pac.exploration(epsilon, discount, bound),
    }


def random_arguments(rng, count):
    """Log-uniform epsilon, failure, bound and sizes; discounts down to 0.1 and up to 0.999."""
    return [
        (
            10 ** rng.uniform(-6, -1),
            10 ** rng.uniform(-9, -0.1),
            1 - 10 ** rng.uniform(-3, math.log10(0.9)),
            10 ** rng.uniform(-1, 2),
            int(10 ** rng.uniform(0, 4)),
            int(10 ** rng.uniform(0, 2)),
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize(("dtype", "tolerance"), [(DOUBLE, 1e-12), (SINGLE, 3e-5)])
def test_constants_are_those_of_plain_arithmetic(dtype, tolerance):
    with jax.enable_x64(dtype is DOUBLE):
        for arguments in random_arguments(np.random.default_rng(0), 60):
            # The discount as the dtype holds it: single precision says little of 1 - 0.999.
            rounded = [dtype(x) if isinstance(x, float) else x for x in arguments]
            expected = plain(*(float(x) if isinstance(x, dtype) else x for x in rounded))
            found = constants(*rounded)
            for name, value in expected.items():
                assert found[name].dtype == dtype
                assert float(found[name]) == pytest.approx(value, rel=tolerance), name


def test_the_example_of_the_dissertation():
    arguments = (1e-4, 0.1, 0.6, 1.0, 144)
    assert float(pac.visits(*arguments, 6)) == pytest.approx(1.4193e19, rel=1e-7)
    assert float(pac.visits(*arguments, 4)) < 1.382e19
    assert float(pac.action_tolerance(1e-4, 0.6)) == pytest.approx(1e-5 / 3, rel=1e-14)
    assert float(pac.exploration(1e-4, 0.6, 1.0)) == pytest.approx(1.6e-6 / 3, rel=1e-14)


def test_nothing_overflows_on_the_way():
    with jax.enable_x64(False):
        # Squares and products of these leave single precision; the constants do not.
        tiny = constants(1e-30, 0.1, 0.9, 1e-30, 10, 2)
        usual = plain(1.0, 0.1, float(SINGLE(0.9)), 1.0, 10, 2)
        for name in ("horizon", "accuracy", "visits", "exploration"):
            assert float(tiny[name]) == pytest.approx(usual[name], rel=3e-5), name
        found = pac.hoeffding_visits(1e-3, 1e-30, jnp.int32(10**9), jnp.int32(10**9))
        assert float(found) == pytest.approx((math.log(2e27) + 30 * math.log(10)) / 2e-6, rel=1e-5)
        # About 1e30, far beyond the integers.
        large = float(pac.visits(1e-6, 0.1, 0.9, 1.0, 10_000, 4))
        assert 1e30 < large < 1e33
        assert np.isinf(pac.visits(1e-12, 0.1, 0.99, 1.0, 10_000, 4))
    large = float(pac.visits(1e-12, 0.1, 0.99, 1.0, 10_000, 4))
    assert large == pytest.approx(plain(1e-12, 0.1, 0.99, 1.0, 10_000, 4)["visits"], rel=1e-11)


def test_an_epsilon_that_everything_attains():
    # 6 R / (1 - g)^2 is more than any value, and the published logarithm would turn negative.
    assert float(pac.horizon(100.0, 0.5, 1.0)) == 1
    assert float(pac.accuracy(100.0, 0.5, 1.0, 4)) > 0
    assert np.isfinite(pac.visits(24.0, 0.1, 0.5, 1.0, 4, 2))  # where that logarithm is zero
    assert float(pac.exploration(1000.0, 0.5, 1.0)) == 1


def test_constants_of_traced_arguments():
    many = [np.array(x) for x in zip(*random_arguments(np.random.default_rng(1), 8), strict=True)]
    compiled = jax.jit(jax.vmap(constants))
    found = compiled(*many)
    for i in range(8):
        one = constants(*(x[i] for x in many))
        for name, value in one.items():
            np.testing.assert_allclose(found[name][i], value, rtol=1e-12)
    with counted_traces() as traced:
        compiled(*(x + 0 * x if x.dtype != float else x / 2 for x in many))
    assert not traced


def test_the_constants_make_the_bounds_sixths_of_epsilon():
    for epsilon, _, discount, bound, states, _ in random_arguments(np.random.default_rng(2), 50):
        steps = pac.horizon(epsilon, discount, bound)
        delta = pac.accuracy(epsilon, discount, bound, states)
        p = pac.exploration(epsilon, discount, bound)
        parts = [
            pac.approximation_gap(delta, states, steps, discount, bound),
            pac.hat_gap(p, pac.action_tolerance(epsilon, discount), discount, bound),
            bound * discount**steps / (1 - discount) ** 2,
        ]
        np.testing.assert_allclose(parts, epsilon / 6, rtol=1e-9)


def test_bounds_are_those_of_exact_arithmetic():
    rng = np.random.default_rng(3)
    for _ in range(50):
        p, tolerance, discount, bound = rng.random(4) * [1, 2, 0.99, 10]
        states, steps = (int(n) for n in rng.integers(1, 1000, size=2))
        exact_p, exact_tolerance, g, r = map(Fraction, (p, tolerance, discount, bound))
        mixing = exact_p * r / (1 - g) ** 2 + exact_tolerance / (1 - g)
        hat = exact_p * r / (1 - g) ** 3 + exact_tolerance / (1 - g)
        near = r * states * steps * exact_p / (1 - g) ** 2
        for found, exact in (
            (pac.mixing_gap(p, tolerance, discount, bound), mixing),
            (pac.hat_gap(p, tolerance, discount, bound), hat),
            (pac.approximation_gap(p, states, steps, discount, bound), near),
        ):
            assert float(found) == pytest.approx(float(exact), rel=1e-13)


@pytest.mark.parametrize(("deviation", "failure"), [(0.1, 0.1), (0.05, 0.3), (0.2, 0.01)])
def test_frequencies_after_so_many_visits(deviation, failure):
    visits = math.ceil(float(pac.hoeffding_visits(deviation, failure, 1, 1)))
    share = 2 * math.exp(-2 * deviation**2 * visits)
    assert failure / 1.1 < share <= failure
    for p in (0.03, 0.2, 0.5, 0.9):
        wrong = sum(
            math.comb(visits, n) * p**n * (1 - p) ** (visits - n)
            for n in range(visits + 1)
            if abs(n / visits - p) > deviation
        )
        assert wrong <= failure


def test_a_union_over_all_transitions():
    one = float(pac.hoeffding_visits(0.01, 0.1 / (7 * 7 * 3), 1, 1))
    assert float(pac.hoeffding_visits(0.01, 0.1, 7, 3)) == pytest.approx(one, rel=1e-12)
    delta = pac.accuracy(0.01, 0.9, 1.0, 7)
    half = float(pac.hoeffding_visits(delta, 0.05, 7, 3))
    assert float(pac.visits(0.01, 0.1, 0.9, 1.0, 7, 3)) == pytest.approx(half, rel=1e-12)


# --- near-optimal moves and the strategy ---------------------------------------------------------


def test_near_optimal_moves_by_a_plain_loop():
    rng = np.random.default_rng(4)
    q = rng.integers(0, 8, size=(200, 5)) / 8  # sums and differences of these are exact
    allowed = rng.random(q.shape) < 0.6
    q[~allowed] = rng.choice([np.inf, -np.inf, np.nan, 9.0], size=(~allowed).sum())
    for tolerance in (0.0, 0.125, 0.3, 5.0):
        found = np.asarray(pac.near_optimal(q, allowed, tolerance))
        for s in range(len(q)):
            moves = np.flatnonzero(allowed[s])
            best = max(q[s, moves], default=0)
            expected = [a for a in moves if best - q[s, a] <= tolerance]
            assert np.flatnonzero(found[s]).tolist() == expected
            assert bool(expected) == bool(len(moves))


def test_where_every_move_is_lost_all_are_best():
    q = jnp.array([[-jnp.inf, -jnp.inf], [-jnp.inf, 0.0]])
    near = pac.near_optimal(q, jnp.ones((2, 2), bool), 1e-3)
    assert near.tolist() == [[True, True], [False, True]]


def test_the_hat_strategy_by_a_plain_loop():
    rng = np.random.default_rng(5)
    allowed = rng.random((100, 4)) < 0.6
    near = allowed & (rng.random(allowed.shape) < 0.6)
    near |= allowed & ~near.any(axis=1, keepdims=True)
    for p in (1e-12, 0.1, 1.0):
        found = np.asarray(pac.hat_strategy(near, allowed, p))
        for s in range(len(allowed)):
            for a in range(4):
                exact = Fraction(0)
                if allowed[s, a]:
                    exact += Fraction(p) / int(allowed[s].sum())
                if near[s, a]:
                    exact += (1 - Fraction(p)) / int(near[s].sum())
                assert found[s, a] == pytest.approx(float(exact), rel=1e-14)
        assert ((found > 0) == allowed).all()
        np.testing.assert_allclose(found.sum(axis=1), allowed.any(axis=1), atol=1e-15)
    with jax.enable_x64(False):
        assert ((np.asarray(pac.hat_strategy(near, allowed, 1e-12)) > 0) == allowed).all()


def test_states_that_are_proved_to_be_epsilon_optimal():
    def solution(lower, upper):
        return jl.Solution(None, None, jnp.array(lower), jnp.array(upper), None, None, None)

    optimal = solution([1.0, 1.0, 1.0, 1.0], [1.125, 1.125, 1.125, 1.125])
    value = solution([1.0, 0.625, 0.5, -jnp.inf], [1.1, 0.9, 1.0, 1.0])
    found = pac.epsilon_optimal_states(optimal, value, 0.5)
    assert found.tolist() == [True, True, False, False]


# --- the hat game --------------------------------------------------------------------------------


def some_near(rng, game):
    """A random choice of moves, at least one of those available in each state."""
    available = np.asarray(game.available)
    near = available & (rng.random(available.shape) < 0.5)
    return near | (available & ~near.any(axis=1, keepdims=True))


def library(play):
    return Game(as_mdp(play.model), jnp.asarray(play.system))


def test_the_hat_game_by_a_plain_reading():
    rng = np.random.default_rng(6)
    for _ in range(6):
        game = library(random_game(rng, 4, num_actions=3))
        near, p = some_near(rng, game), rng.random()
        hat = jax.tree.map(np.asarray, hat_game(game, near, p))
        game = jax.tree.map(np.asarray, game)
        count, old = game.num_states, np.asarray(to_dense(game.mdp).transition)
        new = np.asarray(to_dense(hat.mdp).transition)
        assert hat.num_states == 3 * count
        assert hat.num_actions == 4
        np.testing.assert_array_equal(hat.system, np.tile(game.system, 3))
        for s in range(count):
            moves = np.asarray(game.available[s])
            expected = {s: moves, count + s: moves, 2 * count + s: moves}
            if game.system[s]:
                expected[s] = moves & False
                expected[2 * count + s] = moves & near[s]
                row = np.zeros(3 * count)
                row[[count + s, 2 * count + s]] = p, 1 - p
                np.testing.assert_allclose(new[s, 3], row, rtol=1e-15)
            assert bool(hat.available[s, 3]) == bool(game.system[s])
            for copy, kept in expected.items():
                assert hat.available[copy, :3].tolist() == kept.tolist()
                np.testing.assert_array_equal(
                    new[copy, :3, :count], np.where(kept[:, None], old[s], 0)
                )
                assert not new[copy, :3, count:].any()
        assert not hat.available[count:, 3].any()
        np.testing.assert_array_equal(hat.initial[:count], game.initial)
        assert not hat.initial[count:].any()


def test_the_hat_game_is_one_that_may_be_built_and_compiled():
    rng = np.random.default_rng(7)
    world = as_mdp(
        random_game(rng, 4, num_successors=1).model, label=[[0], [1], [0], [1]], propositions="a"
    )
    game = Game(world, jnp.array([True, False, True, False]))
    near = some_near(rng, game)
    hat = pac.hat_game(game, near, 0.25)
    assert hat.num_successors == 2  # of one
    checked = jl.make_mdp(
        hat.mdp.successor,
        hat.mdp.probability,
        available=hat.available,
        initial=hat.initial,
        label=hat.label,
        propositions=hat.propositions,
    )
    assert checked.label[:, 0].tolist() == [False, True] * 6
    for left, right in zip(jax.tree.leaves(checked), jax.tree.leaves(hat.mdp), strict=True):
        np.testing.assert_array_equal(left, right)
    compiled = jax.jit(pac.hat_game)
    for left, right in zip(
        jax.tree.leaves(compiled(game, near, 0.25)), jax.tree.leaves(hat), strict=True
    ):
        np.testing.assert_array_equal(left, right)
    with counted_traces() as traced:
        compiled(game, some_near(rng, game), 0.75)
    assert not traced


def uniform(moves):
    moves = np.asarray(moves)
    return moves / moves.sum(axis=1, keepdims=True)


def test_the_uniform_strategy_of_the_hat_game():
    rng = np.random.default_rng(8)
    for _ in range(20):
        game = library(random_game(rng, 5, num_actions=4))
        near, p = some_near(rng, game), rng.random()
        hat = hat_game(game, near, p)
        found = np.asarray(recover_hat_strategy(hat, uniform(hat.available)))
        expected = np.asarray(hat_strategy(near, game.available, p))
        system = np.asarray(game.system)
        np.testing.assert_allclose(found[system], expected[system], rtol=1e-14)
        np.testing.assert_allclose(found[~system], uniform(game.available)[~system])


@jax.jit
def played(game, strategy):
    """The game in which the system's moves are drawn by a strategy, as its single move."""
    dense = to_dense(game.mdp)
    row = jnp.einsum("sa,sat->st", strategy, dense.transition)
    only = jnp.arange(game.num_actions) == 0
    drawn = only[:, None] * row[:, None]
    system = game.system[:, None]
    model = replace(
        dense,
        transition=jnp.where(system[..., None], drawn, dense.transition),
        available=jnp.where(system, only, dense.available),
    )
    return Game(model, game.system)


def wins(game, accepting):
    return np.asarray(jl.games.almost_sure_buchi(game, jnp.asarray(accepting)).region)


@pytest.mark.exhaustive
def test_a_strategy_wins_in_both_games_or_in_neither():  # lemma 9
    rng = np.random.default_rng(9)
    seen = set()
    for _ in range(40):
        game = library(random_game(rng, 4))
        accepting = rng.random(4) < 0.4
        hat = pac.hat_game(game, some_near(rng, game), 0.1 + 0.8 * rng.random())
        moves = np.asarray(hat.available) & (rng.random(hat.available.shape) < 0.5)
        moves |= np.asarray(hat.available) & ~moves.any(axis=1, keepdims=True)
        strategy = uniform(moves * (0.1 + rng.random(moves.shape)))
        recovered = pac.recover_hat_strategy(hat, jnp.asarray(strategy))
        in_hat = wins(played(hat, strategy), np.concatenate([accepting, np.zeros(8, bool)]))
        in_game = wins(played(game, recovered), accepting)
        np.testing.assert_array_equal(in_hat[:4], in_game)
        seen |= set(in_game.tolist())
    assert seen == {True, False}


def staying(play, accepting):
    """A game without the moves that leave where the system wins, and that region."""
    region = buchi(play, accepting, np.ones(len(accepting), bool))
    game = library(play)
    leaves = region[:, None] & ~np.asarray(forall_successor(game, region))
    available = np.asarray(game.available) & ~leaves
    probability = np.asarray(game.mdp.probability) * available[..., None]
    model = replace(game.mdp, available=available, probability=probability)
    # Whether something was cut, where the system wins in some places and not in others.
    cut = 0 < region.sum() < region.size and (np.asarray(game.available) & leaves).any()
    return replace(game, mdp=model), region, bool(cut)


def test_the_hat_game_is_won_where_the_game_is():  # lemma 9
    rng = np.random.default_rng(10)
    cuts = 0
    for _ in range(50):
        accepting = rng.random(5) < 0.4
        game, region, cut = staying(random_game(rng, 5), accepting)
        np.testing.assert_array_equal(wins(game, accepting), region)
        hat = hat_game(game, some_near(rng, game), 0.3)
        none = np.zeros(5, bool)
        found = wins(hat, np.concatenate([accepting, none, none]))
        # Whatever moves count as nearly best: those that win need not be among them.
        np.testing.assert_array_equal(found[:5], region)
        system = np.asarray(game.system)
        assert found.reshape(3, 5)[:, region & system].all()
        # Copies may count as accepting along with their states.
        np.testing.assert_array_equal(wins(hat, np.tile(accepting, 3))[:5], region)
        cuts += cut
    assert cuts > 3


def test_every_move_that_stays_in_the_region_is_enough():  # lemma 6
    rng = np.random.default_rng(11)
    cuts = 0
    for _ in range(50):
        accepting = rng.random(5) < 0.4
        game, region, cut = staying(random_game(rng, 5), accepting)
        strategy = hat_strategy(some_near(rng, game), game.available, 0.01)
        # Nowhere else can any strategy win, so this one wins where the system can.
        np.testing.assert_array_equal(wins(played(game, strategy), accepting), region)
        cuts += cut
    assert cuts > 3


def test_errors_of_the_hat_game():
    game = Game(from_dense([[[0.5, 0.5], [1, 0]], [[1, 0], [0, 1]]]), jnp.array([True, False]))
    with pytest.raises(ValueError, match=r"near_optimal has shape \(2, 3\); expected \(2, 2\)"):
        pac.hat_game(game, jnp.ones((2, 3), bool), 0.1)
    with pytest.raises(ValueError, match="on a DenseMDP; of a product pass restrict"):
        pac.hat_game(replace(game, mdp=to_dense(game.mdp)), game.available, 0.1)
    hat = pac.hat_game(game, game.available, 0.1)
    with pytest.raises(ValueError, match=r"strategy has shape \(2, 2\); expected \(6, 3\)"):
        pac.recover_hat_strategy(hat, jnp.ones((2, 2)))


# --- the lemmas on random games ------------------------------------------------------------------

TRIALS, STATES, ACTIONS, WIDTH = 3000, 4, 3, 2


def random_games(rng, count):
    """Many games at once, with rewards in [0, 1] of the moves and successors."""
    shape = (count, STATES, ACTIONS, WIDTH)
    weight = rng.random(shape) * (rng.random(shape) < 0.7) + 1e-9
    available = rng.random(shape[:-1]) < 0.7
    available[..., 0] |= ~available.any(axis=-1)
    probability = np.where(available[..., None], weight / weight.sum(-1, keepdims=True), 0)
    model = MDP(
        successor=jnp.asarray(rng.integers(STATES, size=shape, dtype=np.int32)),
        probability=jnp.asarray(probability),
        available=jnp.asarray(available),
        initial=jnp.full((count, STATES), 1 / STATES),
        label=jnp.zeros((count, STATES, 0), bool),
    )
    return Game(model, jnp.asarray(rng.random((count, STATES)) < 0.6)), rng.random(shape)


def action_values(game, reward, discount, value):
    paid = jnp.sum(game.mdp.probability * reward, axis=-1)
    return paid + discount * expectation(game, value)


def random_rows(rng, moves):
    """Random distributions on the marked moves, some of them on one alone."""
    weight = np.where(moves, rng.random(moves.shape) ** 6 + 1e-12, 0)
    return weight / np.maximum(weight.sum(axis=-1, keepdims=True), 1e-300)


@jax.jit
@jax.vmap
def best_value(game, reward, discount):
    return jl.minimax_value(game, reward, discount)


@jax.jit
@jax.vmap
def worst_value(game, strategy, reward, discount):
    return jl.values.strategy_value(game, strategy, reward, discount)


def certain_gap(optimal, value):
    """The largest loss in each game, from bounds that are proved: a little too large."""
    assert not np.asarray(optimal.status).any()
    assert not np.asarray(value.status).any()
    return np.asarray(jnp.max(optimal.upper - value.lower, axis=-1))


@pytest.mark.slow
def test_what_rare_bad_moves_cost():  # lemma 7
    rng = np.random.default_rng(12)
    game, reward = random_games(rng, TRIALS)
    discount = 1 - 10 ** rng.uniform(-1.3, -0.1, TRIALS)
    p = 10 ** rng.uniform(-4, -0.05, TRIALS)
    tolerance = rng.choice([0, 0.01, 0.3], TRIALS) * rng.random(TRIALS)
    bound = 10 ** rng.uniform(-1, 2, TRIALS)
    reward, tolerance = reward * bound[:, None, None, None], tolerance * bound
    optimal = best_value(game, reward, discount)
    q = jax.jit(jax.vmap(action_values))(game, reward, discount, optimal.value)
    near = np.asarray(jax.jit(jax.vmap(pac.near_optimal))(q, game.available, tolerance))
    bad = np.asarray(game.available) & ~near
    share = np.where(bad.any(-1), p[:, None] * rng.choice([0.5, 1.0], (TRIALS, STATES)), 0)
    strategy = (1 - share)[..., None] * random_rows(rng, near)
    strategy += share[..., None] * random_rows(rng, bad)
    gap = certain_gap(optimal, worst_value(game, strategy, reward, discount))
    limit = np.asarray(pac.mixing_gap(p, tolerance, discount, bound))
    assert (gap <= limit * (1 + 1e-9) + 1e-9 * bound).all()
    # Most of these trials lose something, and most of the bounds say something.
    assert (gap > 1e-6 * bound).mean() > 0.5
    assert (limit < bound / (1 - discount)).mean() > 0.5


def one_loop(paid):
    """In state 0 the system is paid to stay; the rest of ten moves end in state 1, unpaid."""
    transition = np.zeros((2, 10, 2))
    transition[0, :, 1] = 1
    transition[0, : len(paid)] = [1, 0]
    transition[1, :, 1] = 1
    reward = np.zeros((2, 10))
    reward[0, : len(paid)] = paid
    return Game(from_dense(transition), jnp.ones(2, bool)), jnp.asarray(reward)


@pytest.mark.slow
@pytest.mark.parametrize("discount", [0.05, 0.6, 0.99])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_bound_is_nearly_attained(discount, share):
    # A bad move loses everything; a nearly best one, with `share` of the tolerance.
    bound = 2.0
    p = 0.1 * (1 - discount)
    tolerance = share * 0.5
    game, reward = one_loop([bound, bound - tolerance])
    optimal = jl.check(jl.minimax_value(game, reward, discount))
    q = reward + discount * expectation(game, optimal.value)
    near = pac.near_optimal(q, game.available, tolerance + 1e-9)
    assert near[0].tolist() == [True, True] + [False] * 8
    strategy = jnp.zeros((2, 10)).at[:, 1].set(1 - p).at[:, 5].set(p)
    value = jl.check(jl.values.strategy_value(game, strategy, reward, discount))
    gap = float(optimal.value[0] - value.value[0])
    exact = bound / (1 - discount) - (1 - p) * (bound - tolerance) / (1 - discount * (1 - p))
    assert gap == pytest.approx(exact, rel=1e-9)
    limit = float(pac.mixing_gap(p, tolerance, discount, bound))
    assert limit / 1.2 < gap <= limit * (1 + 1e-9)


@pytest.mark.slow
def test_what_the_hat_strategy_costs():  # lemma 8
    rng = np.random.default_rng(13)
    game, reward = random_games(rng, TRIALS)
    discount = 1 - 10 ** rng.uniform(-1.3, -0.1, TRIALS)
    p = 10 ** rng.uniform(-4, -0.3, TRIALS)
    tolerance = rng.choice([0, 0.01, 0.3], TRIALS) * rng.random(TRIALS)
    reward = reward / (1 - discount)[:, None, None, None]
    optimal = best_value(game, reward, discount)
    q = jax.jit(jax.vmap(action_values))(game, reward, discount, optimal.value)
    near = jax.jit(jax.vmap(pac.near_optimal))(q, game.available, tolerance)
    strategy = jax.jit(jax.vmap(pac.hat_strategy))(near, game.available, p)
    gap = certain_gap(optimal, worst_value(game, strategy, reward, discount))
    limit = np.asarray(pac.hat_gap(p, tolerance, discount, 1.0))
    assert (gap <= limit * (1 + 1e-9) + 1e-9).all()
    assert (gap > 1e-6).mean() > 0.5
    assert (limit < 1 / (1 - discount) ** 2).mean() > 0.3


@pytest.mark.parametrize("discount", [0.05, 0.6, 0.99])
def test_the_bound_of_the_hat_strategy_is_nearly_attained(discount):
    p, paid = 0.02 * (1 - discount), 1 / (1 - discount)
    game, reward = one_loop([paid])
    optimal = jl.check(jl.minimax_value(game, reward, discount))
    q = reward + discount * expectation(game, optimal.value)
    near = pac.near_optimal(q, game.available, 0.0)
    strategy = pac.hat_strategy(near, game.available, p)
    value = jl.check(jl.values.strategy_value(game, strategy, reward, discount))
    limit = float(pac.hat_gap(p, 0.0, discount, 1.0))
    assert limit / 1.2 < float(optimal.value[0] - value.value[0]) <= limit


def test_what_inexact_probabilities_change():  # lemma 12
    rng = np.random.default_rng(14)
    changed = 0
    for _ in range(400):
        states, actions = (int(n) for n in rng.integers(2, 6, size=2))
        discount, bound = 1 - 10 ** rng.uniform(-1.5, -0.05), 10 ** rng.uniform(-1, 1)
        steps = int(rng.integers(1, 40))
        one, other = rng.dirichlet(np.full(states, 0.5), size=(2, states, actions))
        mix = 10 ** rng.uniform(-4, 0)
        two = (1 - mix) * one + mix * other
        # One strategy for both players, and what each state's mover is paid, the same in both.
        play = rng.dirichlet(np.full(actions, 0.3), size=states)
        reward = rng.random((states, actions, states)) * bound / (1 - discount)
        value = []
        for transition in (one, two):
            v = np.zeros(states)
            for _ in range(steps):
                v = (play * (transition * (reward + discount * v)).sum(-1)).sum(-1)
            value.append(v)
        gap = np.abs(value[0] - value[1]).max()
        deviation = np.abs(one - two).max()
        limit = float(pac.approximation_gap(deviation, states, steps, discount, bound))
        assert gap <= limit * (1 + 1e-12)
        changed += gap > 1e-3 * limit
    assert changed > 200
