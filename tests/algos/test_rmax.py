"""R-max inside the almost-sure winning region: bookkeeping, proofs, promises and mistakes."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos import rmax
from jaxltl.algos.common import pac
from jaxltl.algos.rmax.learner import exploration, required_visits
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.types import Status
from jaxltl.core.values.discounted.minimax import minimax_value
from jaxltl.envs.post_offices import patrol, post_offices
from tests import reference_games
from tests.algos.cases import LearnerCase, alternating_game
from tests.support import as_mdp, lane, stack

MAX_PROGRAMS = 350  # that the default tests compile at most


@cache
def example():
    found = patrol()
    return rmax.make_problem(found.game, found.accepting, found.reward)


def settings(**changed):
    return rmax.Hparams(
        **{"discount": 0.6, "reward_bound": 1.0, "epsilon": 1e-4, "restart": 1 / 50, **changed}
    )


def learn(key, problem, hparams, moves, num_steps=100_000):
    """Until the strategy has rested for so many moves."""
    return rmax.train_until(
        key, problem, hparams, until=rmax.strategy_is_stable(moves), num_steps=num_steps
    )


def random_problem(seed, num_states=7, least=2):
    """A random stochastic game whose almost-sure region is neither empty nor all of it."""
    rng = np.random.default_rng(seed)
    while True:
        play = reference_games.random_game(rng, num_states, kind="mixed")
        game = make_game(as_mdp(play.model), play.system)
        accepting = rng.random(num_states) < 0.4
        region = np.asarray(jl.games.almost_sure_buchi(game, jnp.asarray(accepting)).region)
        if least <= region.sum() < num_states:
            break
    reward = rng.random(game.mdp.probability.shape)
    return rmax.make_problem(game, accepting, reward, initial=region / region.sum()), rng


def gamble():
    """A fair bet that pays nothing either way, beside a sure move that pays a half."""
    mdp = jl.make_mdp(
        [[[0, 1], [0, 0]], [[0, 0], [0, 0]]],
        [[[0.5, 0.5], [1, 0]], [[1, 0], [0, 0]]],
        available=[[True, True], [True, False]],
        initial=[1, 0],
    )
    return mdp, np.array([[0.0, 0.5], [0.0, 0.0]])


# --- the bookkeeping, against a plain one -----------------------------------------------------


class Plain:
    """Algorithm 5 with dictionaries, fed with transitions."""

    def __init__(self, problem, hparams, update):
        self.game, self.hparams, self.update = problem.game, hparams, update
        self.allowed = np.asarray(problem.allowed)
        self.system = np.asarray(problem.game.system)
        successor = np.asarray(problem.game.mdp.successor)
        used = np.asarray(problem.game.mdp.probability) > 0
        self.edges = {
            (s, a): successor[s, a][used[s, a]].tolist() for s, a in np.argwhere(self.allowed)
        }
        bound = hparams.reward_bound / (1 - hparams.discount)
        self.count = {(*pair, t): 0 for pair, ts in self.edges.items() for t in ts}
        self.paid = dict.fromkeys(self.count, bound)
        self.model = {
            pair: {t: (1 / len(ts), bound) for t in ts} for pair, ts in self.edges.items()
        }
        self.known = {}
        self.best = self.allowed & self.system[:, None]
        self.moves = 0

    def see(self, s, a, t, r):
        self.moves += 1
        pair, first = (s, a), self.count[s, a, t] == 0
        self.count[s, a, t] += 1
        if self.update == "every" and first:
            self.paid[s, a, t] = r
        total = sum(self.count[s, a, x] for x in self.edges[pair])
        news = False
        if pair not in self.known and (
            total >= self.hparams.known_after or len(self.edges[pair]) == 1
        ):
            self.known[pair] = self.moves
            if self.update == "printed":
                self.paid[s, a, t] = r
            shares = {x: max(self.count[s, a, x], 1) for x in self.edges[pair]}
            self.shares = {
                **getattr(self, "shares", {}),
                pair: {x: n / sum(shares.values()) for x, n in shares.items()},
            }
            news = True
        if pair in self.known and (news or (first and self.update == "every")):
            self.model[pair] = {x: (p, self.paid[s, a, x]) for x, p in self.shares[pair].items()}
            self.solve()

    def solve(self):
        discount, value = self.hparams.discount, np.zeros(len(self.system))
        q = np.where(self.allowed, 0.0, -np.inf)
        for _ in range(400):
            for (s, a), row in self.model.items():
                q[s, a] = sum(p * (r + discount * value[t]) for t, (p, r) in row.items())
            live = self.allowed.any(1)
            most = q.max(1, where=self.allowed, initial=-np.inf)
            least = q.min(1, where=self.allowed, initial=np.inf)
            value = np.where(live, np.where(self.system, most, least), 0)
        self.value = value
        slack = self.hparams.epsilon * (1 - discount) / 12
        self.best = self.allowed & self.system[:, None] & (q >= most[:, None] - slack)


@pytest.mark.few(1)
@pytest.mark.parametrize("update", rmax.UPDATES)
def test_observed_moves_are_kept_as_by_plain_bookkeeping(update):
    problem, rng = random_problem(1, num_states=9, least=7)
    hparams = settings(known_after=3, update=update, epsilon=0.01)
    plain, state = Plain(problem, hparams, update), rmax.init(jax.random.key(0), problem, hparams)
    rewards = rng.random((9, 2, 9))
    live = np.flatnonzero(plain.allowed.any(1))
    for n in range(150):
        if n % 10 == 0:  # a new start, or some places would never be seen
            state = state.replace(position=jnp.int32(rng.choice(live)))
        s = int(state.position)
        play = np.asarray(rmax.policy(state, problem, hparams))[s]
        if not plain.system[s]:
            play = np.asarray(problem.environment)[s]
        a = int(rng.choice(len(play), p=play / play.sum()))
        t = int(rng.choice(plain.edges[s, a]))
        r = float(rewards[s, a, t])
        plain.see(s, a, t, r)
        state = rmax.observe(state, problem, hparams, a, t, r)
        np.testing.assert_array_equal(state.best, plain.best)
    assert plain.known and state.num_updates > 5
    known = np.full(problem.allowed.shape, -1)
    for (s, a), when in plain.known.items():
        known[s, a] = when
    np.testing.assert_array_equal(state.known_at, known)
    for (s, a), row in plain.model.items():
        where = np.asarray(problem.game.mdp.successor)[s, a]
        for t, (p, r) in row.items():
            k = int(np.flatnonzero(where == t)[0])
            np.testing.assert_allclose(state.probability[s, a, k], p)
            assert state.counts[s, a, k] == plain.count[s, a, t]
            if (s, a) in plain.known:
                np.testing.assert_allclose(state.reward[s, a, k], r)
    live = plain.allowed.any(1)
    np.testing.assert_allclose(state.value[live], plain.value[live], atol=1e-3)


@pytest.mark.slow
def test_a_walk_and_the_same_moves_observed_come_to_the_same():
    """The loop's own records, against its counts by a second way: sums of what was seen."""
    problem, _ = random_problem(5)
    hparams = settings(known_after=4, moves_per_step=16, epsilon=0.05)
    state, metrics = rmax.train(jax.random.key(1), problem, hparams, num_steps=120)
    assert state.counts.sum() == state.moves > 500
    assert not state.counts[~problem.allowed].any()
    used = np.asarray(problem.game.mdp.probability) > 0
    assert not state.counts[~used].any()
    seen = np.asarray(state.counts) > 0
    np.testing.assert_allclose(state.reward[seen], problem.reward[seen], rtol=1e-12)
    assert (state.reward[~seen] == 1 / (1 - 0.6)).all()
    single = used.sum(-1) == 1
    visits = np.asarray(state.counts).sum(-1)
    known = np.asarray(state.known_at) >= 0
    np.testing.assert_array_equal(known, (visits >= 4) | (single & (visits >= 1)))
    assert (np.diff(metrics.num_known) >= 0).all() and (np.diff(metrics.moves) > 0).all()


# --- always almost-surely winning -------------------------------------------------------------


@partial(jax.jit, static_argnames="num_steps")
def followed(key, problem, hparams, num_steps):
    """Whether every strategy of a run passes the graph check, and how many there were."""

    def body(carry, _):
        state, won = carry
        state, _ = rmax.step(state, problem, hparams)
        play = rmax.policy(state, problem, hparams)
        return (state, won & rmax.wins_almost_surely(problem, play)), None

    state = rmax.init(key, problem, hparams)
    won = rmax.wins_almost_surely(problem, rmax.policy(state, problem, hparams))
    (state, won), _ = jax.lax.scan(body, (state, won), None, length=num_steps)
    return state, won


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [8, pytest.param(100, marks=pytest.mark.exhaustive)])
def test_every_strategy_on_the_example_wins_almost_surely(seeds):
    keys = jax.random.split(jax.random.key(0), seeds)
    problem, hparams = example(), settings()
    run = jax.jit(jax.vmap(lambda k: followed(k, problem, hparams, 300)))
    states, won = run(keys)
    assert won.all() and states.always_almost_sure.all()
    assert (states.num_updates > 200).all()


@pytest.mark.parametrize("games", [12, pytest.param(120, marks=pytest.mark.exhaustive)])
def test_every_strategy_in_random_games_wins_almost_surely(games):
    problems = [random_problem(seed)[0] for seed in range(games)]
    keys = jax.random.split(jax.random.key(1), games)
    hparams = settings(known_after=5, moves_per_step=20)
    run = jax.jit(jax.vmap(lambda k, p: followed(k, p, hparams, 150)))
    states, won = run(keys, stack(problems))
    assert won.all() and states.always_almost_sure.all()
    assert (states.num_updates >= 2).all()
    for i, problem in enumerate(problems):
        moved = np.asarray(states.counts[i]).sum(-1) > 0
        assert not moved[~np.asarray(problem.allowed)].any(), "left the region"


def test_the_graph_check_refuses_what_does_not_win():
    problem = example()
    found = minimax_value(problem.game, problem.reward, 0.6, allowed=problem.allowed)
    mine = problem.allowed & problem.game.system[:, None]
    greedy = jax.nn.one_hot(found.policy, 6) * problem.game.system[:, None]
    assert not rmax.wins_almost_surely(problem, greedy), "the best moves alone never visit both"
    uniform = pac.hat_strategy(mine, mine, 0.5)
    assert rmax.wins_almost_surely(problem, uniform)
    first = int(problem.game.system.argmax())
    assert not rmax.wins_almost_surely(problem, uniform.at[first].set(0)), "a state without moves"
    stochastic, _ = random_problem(3)
    allowed = stochastic.allowed & stochastic.game.system[:, None]
    leaving = (
        stochastic.game.available
        & ~stochastic.allowed
        & (stochastic.region & stochastic.game.system)[:, None]
    )
    assert leaving.any()
    assert rmax.wins_almost_surely(stochastic, allowed * 1.0)
    assert not rmax.wins_almost_surely(stochastic, (allowed | leaving) * 1.0)


# --- what is promised -------------------------------------------------------------------------


@pytest.mark.slow
def test_with_restarts_nearly_all_states_become_optimal():
    problem, hparams = example(), settings()
    keys = jax.random.split(jax.random.key(7), 10)
    learned = jax.jit(jax.vmap(lambda k: learn(k, problem, hparams, 10_000)))(keys)
    jl.check(learned)
    for i in range(10):
        found = rmax.evidence(lane(learned.state, i), problem, hparams)
        mine = np.asarray(found.reachable & problem.game.system)
        assert mine.sum() == 54
        assert found.almost_sure
        assert np.asarray(found.epsilon_optimal)[mine].sum() >= 52
        assert np.asarray(found.epsilon_optimal_played)[mine].sum() >= 52
        np.testing.assert_array_equal(
            np.asarray(found.worst_case.lower) >= np.asarray(found.optimal.upper) - 1e-4,
            found.epsilon_optimal,
        )


@pytest.mark.slow
def test_without_restarts_what_recurs_becomes_optimal():
    problem, hparams = example(), settings(restart=0.0)
    learned = learn(jax.random.key(0), problem, hparams, 10_000)
    found = rmax.evidence(learned.state, problem, hparams)
    mine = np.asarray(found.reachable & problem.game.system)
    assert 15 <= np.asarray(found.epsilon_optimal)[mine].sum() <= 35


@pytest.mark.exhaustive
def test_the_printed_update_fails_where_the_corrected_one_does_not():
    mdp, reward = gamble()
    problem = rmax.make_problem(mdp, np.array([True, False]), reward)
    worth = {}
    for update in rmax.UPDATES:
        hparams = settings(known_after=50, update=update, restart=0.0)
        learned = learn(jax.random.key(0), problem, hparams, 20_000)
        found = rmax.evidence(learned.state, problem, hparams)
        worth[update] = float(found.worst_case.value[0])
        assert float(found.optimal.value[0]) == pytest.approx(1.25)
        assert bool(found.epsilon_optimal[0]) == (update == "every")
    assert worth["every"] == pytest.approx(1.25, abs=1e-4)
    assert worth["printed"] < 0.01, "the loss is thought to pay the bound for ever"


@pytest.mark.slow
def test_a_seldom_successor_seen_late_still_counts():
    """Known before all of its successors were seen: the reward of the last enters later."""
    mdp = jl.make_mdp([[[0, 1]], [[0, 0]]], [[[0.97, 0.03]], [[1, 0]]], initial=[1, 0])
    problem = rmax.make_problem(mdp, np.array([True, True]), np.array([[0.2], [0.6]]))
    hparams = settings(known_after=2, restart=0.0)
    learned = learn(jax.random.key(0), problem, hparams, 5000)
    assert learned.state.num_updates == 3
    assert (learned.state.reward[0, 0] == jnp.array([0.2, 0.2])).all()
    found = rmax.evidence(learned.state, problem, hparams)
    assert found.epsilon_optimal.all(), "there is nothing to choose"


@pytest.mark.slow
def test_the_adversary_plays_the_minimax_answer():
    found = patrol()
    problem = rmax.make_problem(
        found.game, found.accepting, found.reward, environment="adversarial", discount=0.6
    )
    optimal = minimax_value(found.game, found.reward, 0.6)
    theirs = ~np.asarray(found.game.system)
    np.testing.assert_array_equal(
        np.asarray(problem.environment).argmax(1)[theirs], np.asarray(optimal.policy)[theirs]
    )
    learned = learn(jax.random.key(0), problem, settings(), 5000)
    evidence = rmax.evidence(learned.state, problem, settings())
    mine = np.asarray(evidence.reachable & problem.game.system)
    assert np.asarray(evidence.epsilon_optimal_played)[mine].sum() >= 30
    never = theirs[:, None] & np.asarray(problem.allowed) & (np.asarray(problem.environment) == 0)
    assert (np.asarray(learned.state.known_at)[never] == -1).all()


def test_the_constants_of_the_theorem_are_used():
    hparams = settings()
    assert float(required_visits(example(), hparams)) == pytest.approx(1.4193e19, rel=1e-4)
    explore = float(exploration(example(), hparams))
    assert explore == pytest.approx(5.33333e-7, rel=1e-5)
    state = rmax.init(jax.random.key(0), example(), hparams)
    assert float(state.value.max()) == pytest.approx(1 / 0.4**2)
    first = rmax.policy(state, example(), hparams)
    number = np.asarray(example().allowed.sum(1))
    mine = np.asarray(example().game.system)
    np.testing.assert_allclose(np.asarray(first).max(1)[mine], 1 / number[mine])


# --- lanes, traces, precision -----------------------------------------------------------------


@pytest.mark.slow
def test_lanes_of_different_settings_are_as_if_alone():
    problem, _ = random_problem(5)
    hparams = settings(
        known_after=jnp.array([2, 8, 30]), epsilon=jnp.array([0.5, 0.1, 0.01]), moves_per_step=10
    )
    axes = rmax.Hparams(
        discount=None,
        reward_bound=None,
        epsilon=0,
        failure=None,
        known_after=0,
        restart=None,
        moves_per_step=10,
    )
    keys = jax.random.split(jax.random.key(0), 2)
    train = partial(rmax.train_until, until=rmax.strategy_is_stable(200), num_steps=2000)
    nested = jax.jit(jax.vmap(jax.vmap(train, (None, None, axes)), (0, None, None)))(
        keys, problem, hparams
    )
    for i in range(2):
        for j in range(3):
            own = hparams.replace(known_after=hparams.known_after[j], epsilon=hparams.epsilon[j])
            alone = train(keys[i], problem, own)
            here = lane(lane(nested.state, i), j)
            for name in ("moves", "counts", "known_at", "best", "num_updates", "step"):
                np.testing.assert_array_equal(getattr(here, name), getattr(alone.state, name))
            np.testing.assert_allclose(here.value, alone.state.value, rtol=1e-9)


def test_how_a_run_ends():
    done = learn(jax.random.key(0), example(), settings(), 500)
    assert done.status == Status.COMPLETED
    rested = done.state.moves - done.state.last_update
    assert 500 <= rested < 500 + settings().moves_per_step
    short = learn(jax.random.key(0), example(), settings(), 500, num_steps=3)
    assert short.status == Status.MAX_STEPS and short.num_steps == short.state.step == 3


def test_a_run_is_over_when_no_more_moves_can_be_counted():
    problem, hparams = example(), settings()
    most = np.iinfo(np.int32).max
    state = rmax.init(jax.random.key(0), problem, hparams)
    state, metrics = rmax.run(
        state.replace(moves=jnp.int32(most - 5)), problem, hparams, num_steps=9, max_rows=9
    )
    assert (np.diff(np.asarray(metrics.moves)) >= 0).all() and metrics.moves[-1] == most
    assert metrics.status[-1] == Status.MAX_STEPS and metrics.status[0] == Status.COMPLETED
    again, _ = rmax.run(state, problem, hparams, num_steps=9, max_rows=9)
    assert again.moves == most and (again.counts == state.counts).all()
    assert (state.known_at <= most).all() and (state.known_at >= -1).all()


# --- mistakes ---------------------------------------------------------------------------------


def test_a_start_outside_the_region_is_told():
    mdp = jl.make_mdp(
        [[[1], [2]], [[1], [1]], [[2], [2]]],
        np.ones((3, 2, 1)),
        initial=[0.5, 0, 0.5],
        label=[[0], [1], [0]],
        propositions=["goal"],
    )
    reward = np.zeros((3, 2))
    with pytest.raises(
        ValueError, match=r"1 of the initial states .* region: 2\. .*no strategy satisfies the task"
    ):
        rmax.make_problem(mdp, np.array([False, True, False]), reward)
    game = Game(mdp, jnp.array([False, True, True]))
    with pytest.raises(ValueError, match=r"2 of the initial states .* region: 0 .*, 2"):
        rmax.make_problem(game, "F goal", reward)
    rmax.make_problem(mdp, "F goal", reward, initial=[1, 0, 0])


def test_rewards_out_of_bounds_are_told():
    problem = rmax.make_problem(*patrol()[:2], np.asarray(patrol().reward) * 3)
    learned = learn(jax.random.key(0), problem, settings(), 100)
    s, a = divmod(int(learned.state.fault), 6)
    assert problem.reward[s, a] == 3
    with pytest.raises(ValueError, match=rf"state {s}, action {a}: a reward of 3 .*bound=1"):
        rmax.evidence(learned.state, problem, settings())
    fine = learn(jax.random.key(0), problem, settings(reward_bound=3.0), 100)
    assert fine.state.fault == -1
    for reward in (-0.1, 1.5, float("nan")):
        with pytest.raises(ValueError, match="was observed"):
            state = rmax.init(jax.random.key(0), problem, settings())
            move = int(np.asarray(problem.allowed)[int(state.position)].argmax())
            target = int(problem.game.mdp.successor[int(state.position), move, 0])
            rmax.observe(state, problem, settings(), move, target, reward)


def test_what_the_graph_does_not_have_is_told():
    problem = example()
    state = rmax.init(jax.random.key(0), problem, settings())
    s = int(state.position)
    moves = np.flatnonzero(np.asarray(problem.allowed)[s])
    with pytest.raises(ValueError, match=rf"state {s}, action {moves[0]}: successor 143 is not"):
        rmax.observe(state, problem, settings(), int(moves[0]), 143, 0.0)
    with pytest.raises(ValueError, match=rf"state {s}: action 5 leaves the region; choose one of"):
        rmax.observe(state, problem, settings(), 5, 0, 0.0)


def test_mistakes_in_the_problem():
    found = patrol()
    make = partial(rmax.make_problem, found.game)
    with pytest.raises(ValueError, match="formula has shape"):
        make(np.ones(3, bool), found.reward)
    with pytest.raises(ValueError, match="reward has shape"):
        make(found.accepting, np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"reward of state 2, action 0 is nan|reward of state"):
        make(found.accepting, np.full((144, 6), np.nan))
    with pytest.raises(ValueError, match="random, adversarial"):
        make(found.accepting, found.reward, environment="kind")
    with pytest.raises(ValueError, match="environment: the row of state"):
        make(found.accepting, found.reward, environment=np.zeros((144, 6)))
    with pytest.raises(ValueError, match="initial is not a distribution"):
        make(found.accepting, found.reward, initial=np.ones(144))
    with pytest.raises(ValueError, match="needs 3 priorities"):
        rmax.make_problem(post_offices(), "G F p1 -> G F p2", np.zeros((36, 6)))
    with pytest.raises(ValueError, match=r"proposition|unknown"):
        rmax.make_problem(post_offices(), "G F p9", np.zeros((36, 6)))
    lazy = jl.product(post_offices(), "G F p1")
    with pytest.raises(ValueError, match="explicit MDP"):
        rmax.make_problem(lazy, np.ones(36, bool), np.zeros((36, 6)))
    with pytest.raises(ValueError, match="update='some'"):
        rmax.init(jax.random.key(0), example(), settings(update="some"))
    with pytest.raises(ValueError, match="moves_per_step=0"):
        rmax.init(jax.random.key(0), example(), settings(moves_per_step=0))


def test_the_evidence_has_the_expected_moves_between_accepting_states():
    """With weight w of the bet, which wins every second time: 2 / w moves, and one more from there."""
    world, reward = gamble()
    problem = rmax.make_problem(world, [False, True], reward)
    hparams = settings()
    found = rmax.evidence(rmax.init(jax.random.key(0), problem, hparams), problem, hparams)
    first = 2 / float(found.strategy[0, 0])
    np.testing.assert_allclose(found.steps.value, [first, first + 1], rtol=1e-9)
    assert found.steps.lower[0] <= first <= found.steps.upper[0]


# --- the laws of all learners ------------------------------------------------------------------


def pac_learning():
    game, reward = alternating_game()
    setting = partial(rmax.Hparams, known_after=3, epsilon=0.1, reward_bound=1.0, moves_per_step=7)
    return LearnerCase(
        rmax,
        rmax.make_problem(game, np.arange(4) == 0, reward, initial=np.full(4, 0.25)),
        setting(discount=0.5, restart=0.1),
        setting(discount=0.6, restart=0.3),
        reward="reward",
    )


CASES = {
    "rmax": pac_learning,
}
