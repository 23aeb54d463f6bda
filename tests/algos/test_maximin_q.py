"""Q-learning in games: what is learned is the value, and only allowed moves are made."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.algos import maximin_q
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models.construct.restrict import restrict
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.mdp import make_mdp, to_dense
from jaxltl.core.models.ops.operators import forall_successor
from jaxltl.core.types import NotConverged, Status, check
from jaxltl.envs.robots import diagonal_reward, robots
from tests.algos.cases import LearnerCase, alternating_game
from tests.support import counted_traces


class Safe(NamedTuple):
    """The game of two robots, and the part of it in which the system can avoid collisions."""

    whole: Game
    region: np.ndarray
    mask: np.ndarray
    part: Game
    reward: np.ndarray


@cache
def safe_robots(size: int) -> Safe:
    game = robots(size)
    collision = np.asarray(game.label)[:, game.propositions.index("collision")]
    region = ~np.asarray(attractor(game, collision, rule=~np.asarray(game.system)).region)
    mask = np.asarray(game.available) & np.asarray(jax.jit(forall_successor)(game, region))
    start = np.where(region, game.initial, 0)
    part = restrict(game, start / start.sum(), allowed=mask).model
    return Safe(game, region, mask, part, np.asarray(diagonal_reward(part)))


def action_values(game: Game, reward, value, discount, per="system_move") -> np.ndarray:
    mdp, system = game.mdp, np.asarray(game.system)
    factor = np.where(system | (per == "move"), discount, 1.0)[:, None]
    probability = np.asarray(mdp.probability)
    if np.ndim(reward) == 3:
        reward = (probability * reward).sum(-1)
    return reward + factor * (probability * value[np.asarray(mdp.successor)]).sum(-1)


def minimax_value(game: Game, reward, discount, per="system_move", allowed=None) -> np.ndarray:
    """Plain sweeps, many of them."""
    allowed = np.asarray(game.available if allowed is None else allowed)
    value = np.zeros(game.num_states)
    for _ in range(2000):
        q = action_values(game, reward, value, discount, per)
        most, least = np.where(allowed, q, -np.inf).max(-1), np.where(allowed, q, np.inf).min(-1)
        image = np.where(np.asarray(game.system), most, least)
        if np.abs(image - value).max() < 1e-13:
            return image
        value = image
    raise AssertionError("the reference did not converge")


def random_game(seed: int, *, width: int = 1, alternating: bool = False) -> tuple[Game, np.ndarray]:
    """Eight states, three actions of which the first is always there, and a reward."""
    rng = np.random.default_rng(seed)
    system = np.arange(8) < 4
    low = np.where(system & alternating, 4, 0)[:, None, None]
    high = np.where(~system & alternating, 4, 8)[:, None, None]
    successor = rng.integers(low, high, size=(8, 3, width))
    available = rng.random((8, 3)) < 0.8
    available[:, 0] = True
    weight = rng.random((8, 3, width)) + 0.1
    if alternating and width > 1:  # chance belongs to the environment's moves
        weight[system, :, 1:] = 0
    weight = np.where(available[..., None], weight / weight.sum(-1, keepdims=True), 0)
    game = make_game(make_mdp(successor, weight, available=available), system)
    return game, rng.random((8, 3, width))


def train(problem, hparams, num_steps, seed=0):
    return maximin_q.train(jax.random.key(seed), problem, hparams, num_steps=num_steps)


# --- the published example ---------------------------------------------------------------------


def exact_problem(size: int, **options: Any) -> maximin_q.Problem:
    safe = safe_robots(size)
    problem = maximin_q.make_problem(safe.part, safe.reward, **options)
    exact = minimax_value(safe.part, safe.reward, 0.9)
    measured = maximin_q.recurrent_states(problem)
    if problem.method == "maximin":
        measured = measured & safe.part.system
    return maximin_q.with_exact_value(problem, exact, measured)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "counts"),
    [(3, {9.0: 16, 10.0: 56}), (4, {7.29: 16, 8.1: 48, 9.0: 44, 10.0: 132})],
)
def test_robots_learn_the_exact_value(size, counts):
    problem = exact_problem(size)
    hparams = maximin_q.Hparams(discount=0.9, num_chains=256)
    state, metrics = train(problem, hparams, 120)
    assert metrics.error[0] > 1
    assert metrics.error[-1] < 1e-6
    assert metrics.moves[-1] == 120 * 256 * 64
    recurrent = np.asarray(problem.measured)
    assert (~recurrent).sum() == 4, "states in corners without a predecessor"
    system = np.asarray(problem.game.system)
    exact = np.asarray(problem.exact)
    values, number = np.unique(np.round(exact[system], 8), return_counts=True)
    assert dict(zip(values.tolist(), number.tolist(), strict=True)) == counts
    # The greedy moves are optimal, not only their estimates.
    q = action_values(problem.game, np.asarray(problem.reward), exact, 0.9)
    chosen = q[np.arange(len(q)), np.asarray(maximin_q.policy(state, problem, hparams))]
    np.testing.assert_allclose(chosen[recurrent], exact[recurrent], atol=1e-9)


@pytest.mark.slow
def test_ten_million_moves_stay_in_the_region():
    """In the whole game under the mask, where other moves lead to collisions."""
    safe = safe_robots(4)
    start = np.where(safe.region, safe.whole.initial, 0)
    problem = maximin_q.make_problem(
        safe.whole, diagonal_reward(safe.whole), allowed=safe.mask, initial=start / start.sum()
    )
    hparams = maximin_q.Hparams(discount=0.9, num_chains=4096)
    state, metrics = train(problem, hparams, 40)
    visits, system = np.asarray(state.visits), np.asarray(safe.whole.system)
    assert visits.sum() == metrics.moves[-1] == 40 * 4096 * 64 > 1e7
    assert state.violations == 0 and not metrics.violations.any()
    assert visits[~safe.region].sum() == 0, "no state outside the region is ever entered"
    assert visits[system[:, None] & ~safe.mask].sum() == 0
    assert safe.region[np.asarray(state.position)].all()
    assert (np.asarray(safe.whole.available) & ~safe.mask & system[:, None]).sum() > 100
    assert (visits > 0).sum() == metrics.visited[-1]


def test_a_forbidden_move_is_counted():
    problem = exact_problem(3)
    shrunk = replace(problem, allowed=problem.allowed.at[:, 0].set(False))
    hparams = maximin_q.Hparams(discount=0.9, num_chains=256)
    state, metrics = train(shrunk, hparams, 120)
    assert state.violations == np.asarray(state.visits)[:, 0].sum() > 0
    assert metrics.violations[0] < metrics.violations[-1] == state.violations


def test_one_chain_takes_as_many_moves_as_a_plain_loop():
    """6.3e4 moves in the median of a sequential loop over this game."""
    problem = exact_problem(3)
    hparams = maximin_q.Hparams(discount=0.9, num_chains=1, moves_per_step=500)
    learn = partial(maximin_q.train, num_steps=250, max_rows=250)
    keys = jax.random.split(jax.random.key(0), 4)
    _, metrics = jax.jit(jax.vmap(learn, (0, None, None)))(keys, problem, hparams)
    needed = 500 * (1 + np.argmax(np.asarray(metrics.error) < 1e-3, axis=1))
    assert 4e4 < np.median(needed) < 1e5
    assert len(set(metrics.residual[:, 3].tolist())) > 1, "seeds differ"


def test_restarts_reach_states_without_predecessors():
    safe = safe_robots(3)
    everywhere = np.full(safe.part.num_states, 1 / safe.part.num_states)
    problem = maximin_q.make_problem(safe.part, safe.reward, initial=everywhere)
    problem = maximin_q.with_exact_value(problem, minimax_value(safe.part, safe.reward, 0.9))
    hparams = maximin_q.Hparams(discount=0.9, num_chains=256, restart=0.05)
    state, metrics = train(problem, hparams, 120)
    assert metrics.visited[-1] == safe.part.available.sum()
    assert metrics.error[-1] < 1e-6
    without, _ = train(problem, replace(hparams, restart=0.0), 120)
    lonely = ~np.asarray(maximin_q.recurrent_states(problem))
    # Only chains that began there ever were there, once each.
    assert 0 < np.asarray(without.visits)[lonely].sum() <= 256
    assert np.asarray(state.visits)[lonely].sum() > 1.5 * np.asarray(without.visits)[lonely].sum()


# --- both methods, with and without chance -------------------------------------------------------


@pytest.mark.few(2)
@pytest.mark.parametrize("per", ["move", "system_move"])
@pytest.mark.parametrize("method", ["generalized", "maximin"])
def test_methods_agree_on_alternating_games(method, per):
    game, reward = random_game(1, alternating=True)
    problem = maximin_q.make_problem(game, reward[..., 0], method=method)
    hparams = maximin_q.Hparams(discount=0.8, per=per, num_chains=64, moves_per_step=32)
    state, _ = train(problem, hparams, 40)
    exact = minimax_value(game, reward, 0.8, per)
    learned = np.asarray(game.system) if method == "maximin" else slice(None)
    reached = np.asarray(maximin_q.recurrent_states(problem))[learned]
    value = np.asarray(state.value)
    np.testing.assert_allclose(value[learned][reached], exact[learned][reached], atol=1e-9)
    assert reached.sum() >= 3
    assert state.violations == 0
    q = action_values(game, reward, exact, 0.8, per)
    best = q[np.arange(8), np.asarray(maximin_q.policy(state, problem, hparams))]
    np.testing.assert_allclose(best[learned][reached], exact[learned][reached], atol=1e-9)
    if method == "maximin":
        assert not np.isfinite(state.q[4:]).any(), "only the system's states have entries"
        assert not np.asarray(state.value)[4:].any()


@pytest.mark.slow
def test_maximin_is_generalized_on_the_robots():
    problem = exact_problem(3, method="maximin")
    hparams = maximin_q.Hparams(discount=0.9, num_chains=256)
    state, metrics = train(problem, hparams, 120)
    assert metrics.error[-1] < 1e-6
    assert state.violations == 0
    # A round is two moves, the second of which teaches; chains end between the two or not.
    assert np.asarray(state.visits).sum() * 2 == metrics.moves[-1]
    assert not np.asarray(state.visits)[~np.isfinite(state.q)].any()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["generalized", "maximin"])
def test_chance_is_averaged_out_by_decaying_steps(method):
    game, reward = random_game(2, width=3, alternating=method == "maximin")
    problem = maximin_q.make_problem(game, reward, method=method)
    hparams = maximin_q.Hparams(
        discount=0.7, step_size=1.0, step_power=0.65, num_chains=64, moves_per_step=32
    )
    state, _ = train(problem, hparams, 600)
    exact = minimax_value(game, reward, 0.7)
    learned = np.array(maximin_q.recurrent_states(problem))
    if method == "maximin":
        learned &= np.asarray(game.system)
    assert learned.sum() >= 3
    off = np.abs(np.asarray(state.value) - exact)[learned].max()
    assert off < 0.05
    # Steps of constant size do not settle.
    rough, metrics = train(problem, replace(hparams, step_size=0.5, step_power=None), 600)
    assert np.abs(np.asarray(rough.value) - exact)[learned].max() > 2 * off
    assert metrics.residual[-1] > 0.01


def test_rewards_depend_on_the_successor():
    """Equal successors in one list cannot be told apart: their mean is what is seen."""
    mdp = make_mdp([[[0, 1, 1]], [[0, 1, 0]]], [[[0.5, 0.25, 0.25]], [[0.5, 0.5, 0.0]]])
    reward = np.array([[[0.0, 1.0, 3.0]], [[-4.0, 8.0, np.nan]]])
    problem = maximin_q.make_problem(mdp, reward)
    np.testing.assert_allclose(problem.reward, [[[0, 2, 2]], [[-4, 8, 0]]])
    hparams = maximin_q.Hparams(discount=0.0, step_size=1.0, step_power=1.0, moves_per_step=8)
    state, _ = train(problem, hparams, 20)
    np.testing.assert_allclose(state.value, [1.0, 2.0], atol=0.1)


def test_visits_of_one_batch_count_one_by_one():
    mdp = make_mdp([[[0]]], [[[1.0]]])
    problem = maximin_q.make_problem(mdp, [[1.0]])
    hparams = maximin_q.Hparams(discount=0.0, step_size=0.3, num_chains=5, moves_per_step=2)
    state, _ = train(problem, hparams, 1)
    np.testing.assert_allclose(state.q, [[1 - 0.7**10]], rtol=1e-12)
    assert state.visits == 10
    alone = replace(hparams, num_chains=1, step_size=1.0, step_power=1.0)
    reward = replace(problem, reward=jnp.array([[4.0]]))
    state = maximin_q.init(jax.random.key(0), problem, alone)
    state, _ = maximin_q.run(state, problem, alone, num_steps=1)
    state, _ = maximin_q.run(state, reward, alone, num_steps=1)
    np.testing.assert_allclose(state.q, [[2.5]], rtol=1e-12, err_msg="the mean of 1, 1, 4, 4")


# --- who plays how -------------------------------------------------------------------------------


def shares(state) -> np.ndarray:
    visits = np.asarray(state.visits, float)
    return visits / np.maximum(visits.sum(-1, keepdims=True), 1)


def test_moves_are_drawn_uniformly_or_as_given():
    game, reward = random_game(3)
    available, system = np.asarray(game.available), np.asarray(game.system)
    given = np.where(available, [0.6, 0.3, 0.1], 0)
    given /= given.sum(-1, keepdims=True)
    uniform = available / available.sum(-1, keepdims=True)
    hparams = maximin_q.Hparams(discount=0.9, num_chains=64, moves_per_step=32)
    both = np.where(system[:, None], uniform, given)
    for environment, expected in ((None, uniform), (given, both)):
        problem = maximin_q.make_problem(game, reward[..., 0], environment=environment)
        state, _ = train(problem, hparams, 40)
        often = np.asarray(state.visits).sum(-1) > 3000
        assert often[system].any() and often[~system].any()
        np.testing.assert_allclose(shares(state)[often], expected[often], atol=0.05)
        assert not shares(state)[expected == 0].any()


def test_players_are_greedy_when_asked():
    game, reward = random_game(3)
    problem = maximin_q.make_problem(game, reward[..., 0])
    system = np.asarray(game.system)
    hparams = maximin_q.Hparams(
        discount=0.9, num_chains=64, moves_per_step=32, epsilon=1.0, environment_epsilon=1.0
    )
    state, _ = train(problem, hparams, 40)
    before, policy = np.asarray(state.visits), np.asarray(maximin_q.policy(state, problem, hparams))
    # The table has converged, so what is greedy stays so.
    everyone = np.ones(8, bool)
    for epsilons, greedy in (((0.0, 1.0), system), ((1.0, 0.0), ~system), ((0.2, 0.2), everyone)):
        mine, theirs = epsilons
        after, _ = maximin_q.run(
            state, problem, replace(hparams, epsilon=mine, environment_epsilon=theirs), num_steps=40
        )
        made = np.asarray(after.visits) - before
        chosen = made[np.arange(8), policy] / np.maximum(made.sum(-1), 1)
        often = made.sum(-1) > 2000
        share = 1 - min(epsilons) * (1 - 1 / np.asarray(game.available).sum(-1))
        assert (often & greedy).any()
        np.testing.assert_allclose(chosen[often & greedy], share[often & greedy], atol=0.05)
        other = often & ~greedy
        np.testing.assert_allclose(
            chosen[other], 1 / np.asarray(game.available).sum(-1)[other], atol=0.05
        )


def test_epsilon_decays_to_its_least():
    game, reward = random_game(3)
    problem = maximin_q.make_problem(game, reward[..., 0])
    hparams = maximin_q.Hparams(
        discount=0.9,
        num_chains=64,
        moves_per_step=32,
        epsilon=1.0,
        environment_epsilon=1.0,
        epsilon_decay=0.5,
        epsilon_min=0.0,
    )
    state, _ = train(problem, replace(hparams, epsilon_min=1.0), 40)
    policy = np.asarray(maximin_q.policy(state, problem, hparams))
    after, _ = maximin_q.run(state, problem, hparams, num_steps=40)
    made = np.asarray(after.visits - state.visits)
    assert made[np.arange(8), policy].sum() == made.sum(), "2 ** -40 is never"


def test_unknown_answers_may_count_or_not():
    """An environment that always makes one move leaves the others at the initial value."""
    mdp = make_mdp([[[1], [1]], [[0], [0]]], np.ones((2, 2, 1)))
    game, reward = make_game(mdp, [True, False]), np.array([[1.0, 0.0], [0.0, -5.0]])
    always = np.array([[0.5, 0.5], [1.0, 0.0]])
    problem = maximin_q.make_problem(game, reward, environment=always)
    hparams = maximin_q.Hparams(discount=0.5, num_chains=4, moves_per_step=32)
    low, _ = train(problem, hparams, 20)
    np.testing.assert_allclose(low.value, [1.0, 0.0], atol=1e-9)
    high, _ = train(problem, replace(hparams, initial_value=100.0), 20)
    np.testing.assert_allclose(high.value, [2.0, 2.0], atol=1e-9)


def test_starts_are_drawn_as_given():
    mdp = make_mdp([[[0]], [[1]], [[2]], [[3]]], np.ones((4, 1, 1)))
    problem = maximin_q.make_problem(mdp, np.zeros((4, 1)), initial=[0.0, 0.25, 0.75, 0.0])
    state = maximin_q.init(
        jax.random.key(0), problem, maximin_q.Hparams(discount=0.9, num_chains=10_000)
    )
    share = np.bincount(state.position, minlength=4) / 10_000
    np.testing.assert_allclose(share, [0, 0.25, 0.75, 0], atol=0.02)
    assert share[0] == share[3] == 0


# --- stopping ------------------------------------------------------------------------------------


def test_a_run_ends_when_the_value_is_stable():
    problem = exact_problem(3)
    hparams = maximin_q.Hparams(discount=0.9, num_chains=64, moves_per_step=64)

    def stop(tolerance, num_steps):
        return maximin_q.train_until(
            jax.random.key(0),
            problem,
            hparams,
            check_every=20,
            num_steps=num_steps,
            until=maximin_q.value_is_stable(tolerance),
        )

    done = check(stop(1e-5, 2000))
    assert done.status == Status.COMPLETED
    assert done.num_steps < 1000
    assert done.num_steps % 20 == 0
    assert done.residual <= 1e-5
    assert done.metrics.error < 1e-3
    with counted_traces() as traced:
        early = stop(1e-7, 30)
    assert "_run_until" not in traced, "tolerances and limits are arguments"
    assert early.status == Status.MAX_STEPS
    assert early.num_steps == 30 == early.state.step
    with pytest.raises(NotConverged, match="raise max_steps"):
        check(early)
    again = maximin_q.run_until(
        early.state,
        problem,
        hparams,
        until=maximin_q.value_is_stable(1e-5),
        num_steps=2000,
        check_every=20,
    )
    assert again.status == Status.COMPLETED
    assert again.state.step == again.num_steps + 30


def test_a_rest_before_all_is_seen_does_not_end_the_run():
    """A corridor whose only reward is at its end: the value rests at zero for long."""
    length = 40
    walk = np.minimum(np.arange(length) + 1, length - 1)
    mdp = make_mdp(walk[:, None, None], np.ones((length, 1, 1)), initial=np.eye(length)[0])
    reward = (np.arange(length) == length - 1)[:, None].astype(float)
    problem = maximin_q.make_problem(mdp, reward)
    hparams = maximin_q.Hparams(discount=0.5, num_chains=1, moves_per_step=4)
    done = maximin_q.train_until(
        jax.random.key(0), problem, hparams, until=maximin_q.value_is_stable(1e-6), num_steps=100
    )
    assert done.status == Status.COMPLETED
    assert done.num_steps >= length // 4
    assert done.state.value[-1] > 1.9


def test_values_that_are_not_numbers_are_told():
    mdp = make_mdp([[[0]]], [[[1.0]]])
    problem = maximin_q.make_problem(mdp, [[1e308]])  # values overflow
    hparams = maximin_q.Hparams(discount=0.9, num_chains=2, moves_per_step=2)
    done = maximin_q.train_until(
        jax.random.key(0), problem, hparams, until=maximin_q.value_is_stable(1e-3), num_steps=100
    )
    assert done.status == Status.NONFINITE
    assert done.num_steps < 100


def test_visits_are_counted_up_to_a_limit():
    """Step sizes stay numbers however often a move is made."""
    game, reward = random_game(1, alternating=True)
    problem = maximin_q.make_problem(game, reward)
    hparams = maximin_q.Hparams(
        discount=0.8, step_size=1.0, step_power=0.7, num_chains=8, moves_per_step=4
    )
    state = maximin_q.init(jax.random.key(0), problem, hparams)
    state = state.replace(visits=jnp.full_like(state.visits, 2**30 - 3))
    state, _ = maximin_q.run(state, problem, hparams, num_steps=4)
    assert state.visits.max() == 2**30 and state.visits.min() == 2**30 - 3
    assert jnp.isfinite(state.value).all()
    with pytest.raises(ValueError, match=r"num_chains=65536 times moves_per_step=32768"):
        maximin_q.init(
            jax.random.key(0), problem, hparams.replace(num_chains=2**16, moves_per_step=2**15)
        )


@pytest.mark.slow
def test_single_precision_learns_too():
    with jax.enable_x64(False):
        game, reward = random_game(1, alternating=True)
        problem = maximin_q.make_problem(game, reward[..., 0])
        hparams = maximin_q.Hparams(discount=0.8, num_chains=64, moves_per_step=32)
        state, metrics = train(problem, hparams, 40)
        exact = minimax_value(game, reward, 0.8)
        reached = np.asarray(maximin_q.recurrent_states(problem))
        assert state.q.dtype == metrics.residual.dtype == jnp.float32
        np.testing.assert_allclose(state.value[reached], exact[reached], rtol=1e-5)


# --- what is refused -----------------------------------------------------------------------------


TWO = make_mdp([[[1], [0]], [[0], [1]]], np.ones((2, 2, 1)))
SPLIT = make_mdp([[[1, 0]], [[0, 1]]], np.full((2, 1, 2), 0.5))
TURNS = make_game(TWO, [True, False])


def only(*rows):
    return np.array(rows, bool)


@pytest.mark.parametrize(
    ("model", "reward", "options", "message"),
    [
        (TWO, np.zeros((2, 3)), {}, r"reward has shape \(2, 3\); expected \(2, 2\)"),
        (TWO, np.zeros((2, 2, 2)), {}, r"reward has shape .* expected \(2, 2, 1\)"),
        (TWO, [[0, 1], [np.inf, 0]], {}, "reward of state 1, action 0 is inf"),
        (TWO, np.zeros((2, 2)), {"allowed": np.ones((2, 2))}, "allowed has dtype float64"),
        (TWO, np.zeros((2, 2)), {"allowed": np.ones((1, 2), bool)}, "allowed has shape"),
        (
            TWO,
            np.zeros((2, 2)),
            {"allowed": only([1, 0], [0, 0])},
            "no action is allowed in state 1",
        ),
        (SPLIT, np.zeros((2, 1)), {"initial": [1.0, 1.0]}, "initial is not a distribution"),
        (SPLIT, np.zeros((2, 1)), {"initial": [1.0]}, r"initial has shape \(1,\)"),
        (
            TURNS,
            np.zeros((2, 2)),
            {"environment": np.full((2, 2), 0.4)},
            "environment: the row of state 1",
        ),
        (TURNS, np.zeros((2, 2)), {"environment": np.ones((2, 1))}, "environment has shape"),
        (TURNS, np.zeros((2, 2)), {"method": "sarsa"}, "choose one of generalized, maximin"),
        (
            TURNS,
            np.zeros((2, 2)),
            {"method": "maximin"},
            "in state 0 action 1 leads to a state of the same player",
        ),
        (
            make_game(
                make_mdp(
                    [[[1, 2]], [[0, 0]], [[0, 0]]], [[[0.5, 0.5]], [[1.0, 0.0]], [[1.0, 0.0]]]
                ),
                [True, False, False],
            ),
            np.zeros((3, 1)),
            {"method": "maximin"},
            "in state 0 action 0 has several",
        ),
        (to_dense(TWO), np.zeros((2, 2)), {}, "model is a DenseMDP; learners sample an explicit"),
    ],
)
def test_bad_problems_are_refused(model, reward, options, message):
    with pytest.raises(ValueError, match=message):
        maximin_q.make_problem(model, reward, **options)


@pytest.mark.parametrize(
    ("given", "message"),
    [(([0.0],), "exact has shape"), (([0.0, 0.0], [True]), "measured has shape")],
)
def test_bad_exact_values_are_refused(given, message):
    problem = maximin_q.make_problem(TURNS, np.zeros((2, 2)))
    with pytest.raises(ValueError, match=message):
        maximin_q.with_exact_value(problem, *given)


def test_masks_allow_only_what_there_is():
    mdp = make_mdp([[[0], [0]], [[1], [1]]], np.ones((2, 2, 1)), available=only([1, 0], [1, 1]))
    with pytest.raises(ValueError, match="state 0 has no action 1"):
        maximin_q.make_problem(mdp, np.zeros((2, 2)), allowed=np.ones((2, 2), bool))
    # At the environment's states a mask says nothing.
    game = make_game(mdp, [False, True])
    problem = maximin_q.make_problem(game, np.zeros((2, 2)), allowed=only([0, 1], [0, 1]))
    assert problem.allowed.tolist() == [[True, False], [False, True]]


@pytest.mark.parametrize(
    ("model", "settings", "message"),
    [
        (TWO, {"per": "round"}, "per='round'; choose"),
        (TWO, {"num_chains": 0}, "num_chains=0"),
        (TWO, {"moves_per_step": 0}, "moves_per_step=0"),
        (SPLIT, {}, "step_size=None is for deterministic games"),
        (TWO, {"step_power": 1.0}, "step_power needs a step_size"),
    ],
)
def test_bad_settings_are_refused(model, settings, message):
    problem = maximin_q.make_problem(model, np.zeros((2, model.num_actions)))
    hparams = maximin_q.Hparams(discount=0.9, **settings)
    with pytest.raises(ValueError, match=message):
        maximin_q.train(jax.random.key(0), problem, hparams, num_steps=1)


# --- the laws of all learners ------------------------------------------------------------------


def q_learning(method):
    setting = partial(
        maximin_q.Hparams,
        step_size=1.0,
        step_power=0.7,
        epsilon=0.5,
        environment_epsilon=0.5,
        num_chains=3,
        moves_per_step=5,
    )
    return LearnerCase(
        maximin_q,
        maximin_q.make_problem(*alternating_game(), method=method),
        setting(discount=0.5),
        setting(discount=0.7, step_size=0.5, restart=0.2, epsilon=0.1),
        reward="reward",
    )


CASES = {
    "q-generalized": partial(q_learning, "generalized"),
    "q-maximin": partial(q_learning, "maximin"),
}
