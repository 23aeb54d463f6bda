"""Permissive strategies: all their runs win, what they include, and the numbers of chapter 5."""

import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.games import objective as goals
from jaxltl.core.games.permissive import apply_strategy, budgets, permissive_strategy, shield_policy
from jaxltl.core.games.verify import verify
from jaxltl.core.games.winning import objective_at, winning_region
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.mdp import make_mdp
from jaxltl.envs.robots import diagonal_reward, reward_against_task, robots
from tests import reference_games
from tests.support import as_mdp

MAX_PROGRAMS = 350  # that the default tests compile at most

CORNERS = "system_upper_left | system_lower_right"


def sweeps(game, discount=0.9):
    """Values of the game by plain value iteration, the discount paid at the system's moves."""
    reward = np.asarray(diagonal_reward(game))
    successor = np.asarray(game.mdp.successor)[..., 0]
    available, system = np.asarray(game.available), np.asarray(game.system)
    value = np.zeros(game.num_states)
    for _ in range(800):
        after = value[successor]
        best = np.where(available, reward + discount * after, -np.inf).max(1)
        value = np.where(system, best, np.where(available, after, np.inf).min(1))
    return value


def all_runs_win(strategy, objective):
    """Whether the hostile choice of every allowed move still achieves an objective of the game."""
    found = apply_strategy(strategy)
    states = found.model.num_states
    state = strategy.base_state[found.base_state]
    claim = SimpleNamespace(
        game=Game(found.model.mdp, jnp.zeros(states, bool)),
        objective=objective_at(objective, state),
        region=np.ones(states, bool),
        action=_zeros(objective, "guarantees", states),
        counter_action=_zeros(objective, "assumptions", states),
    )
    return verify(claim).system


def _zeros(objective, sets, states):
    memory = (len(getattr(objective, sets)),) if isinstance(objective, goals.GR1) else ()
    return np.zeros((states, *memory), int)


def random_case(rng, num_states=6, **options):
    play = reference_games.random_game(rng, num_states, **options)
    game = make_game(as_mdp(play.model), play.system)
    # Every state starts, so that the strategy is examined everywhere.
    return game.replace(mdp=game.mdp.replace(initial=jnp.full(num_states, 1 / num_states)))


# --- chapter 5 --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("size", "expected"), [(3, {10: 56, 9: 16}), (4, {10: 132, 9: 44, 8.1: 48, 7.29: 16})]
)
def test_safety_is_maximal_and_gives_the_values_of_example_1(size, expected):
    game = robots(size)
    strategy = permissive_strategy(game, goals.safety(game, "!collision"))
    assert strategy.maximal
    found = apply_strategy(strategy).model
    values = np.round(sweeps(found)[np.asarray(found.system)], 9)
    assert dict(zip(*np.unique(values, return_counts=True), strict=True)) == expected
    # As a formula, put beside the game, it is the same game.
    again = apply_strategy(permissive_strategy(game, "G !collision")).model
    np.testing.assert_array_equal(again.mdp.successor, found.mdp.successor)
    np.testing.assert_array_equal(again.available, found.available)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("bound", "size", "best"),
    [
        (4, 260, 8.092178),
        (10, 788, 9.464660),
        (20, 1668, 9.861597),
        *(
            pytest.param(*row, marks=pytest.mark.exhaustive)
            for row in ((6, 436, 8.865797), (8, 612, 9.244175), (14, 1140, 9.703373))
        ),
    ],
)
def test_counters_of_example_3(bound, size, best):
    game = robots(3)
    task = goals.buchi(game, CORNERS, safe="!collision")
    strategy = permissive_strategy(game, task, bound=bound)
    found = apply_strategy(strategy).model
    assert not strategy.maximal and f"within {bound}" in strategy.reason
    assert found.num_states == size
    assert sweeps(found).max() == pytest.approx(best, abs=5e-7)
    assert sweeps(found).max() == pytest.approx(10 - 0.9**bound / (1 - 0.9**bound), abs=1e-9)
    assert all_runs_win(strategy, task)


def test_the_memoryless_strategy_of_example_3():
    game = robots(3)
    task = goals.buchi(game, CORNERS, safe="!collision")
    strategy = permissive_strategy(game, task)
    assert sweeps(apply_strategy(strategy).model).max() == pytest.approx(5.736842, abs=5e-7)
    assert all_runs_win(strategy, task) and not strategy.maximal


def test_example_2():
    game = robots(4)
    assumed = ["environment_lower_left", "environment_upper_right"]
    wanted = ["system_lower_right", "system_upper_left"]
    task = goals.gr1(game, assumed, wanted, safe="!collision")
    safe = winning_region(game, goals.safety(game, "!collision")).region
    reactive = winning_region(game, task)
    np.testing.assert_array_equal(reactive.region, safe)
    assert verify(reactive)
    without = winning_region(game, goals.gr1(game, [], wanted, safe="!collision"))
    assert not without.region.any() and verify(without)
    strategy = permissive_strategy(game, task)
    assert not strategy.maximal
    found = apply_strategy(strategy).model
    value = sweeps(found)[np.asarray(found.initial) > 0]
    figures = value.max(), value.min(), value.mean()
    assert figures == pytest.approx((5.009985, 1.939487, 3.390568), abs=5e-7)
    assert all_runs_win(strategy, task)


@pytest.mark.exhaustive
def test_no_strategy_attains_the_supremum_of_figure_12():
    """The reward wants to stay and the task wants to leave: only longer and longer delays help."""
    game, reward = reward_against_task()
    for bound in (2, 3, 6):
        strategy = permissive_strategy(game, "F b2", method="parity", bound=bound)
        found = apply_strategy(strategy)
        state = strategy.base_state[found.base_state]
        value = jl.check(jl.optimal_value(found.model.mdp, reward[state], 0.9)).value
        start = value[np.asarray(found.model.initial) > 0].max()
        # Before the task is done bound states are met, the last of which is the goal itself.
        assert float(start) == pytest.approx(100 * (1 - 0.9 ** (bound - 1)), abs=1e-9)


# --- laws -------------------------------------------------------------------------------------


def test_safe_strategies_allow_exactly_what_some_winning_strategy_does():
    rng = np.random.default_rng(0)
    for _ in range(40):
        game = random_case(rng)
        safe = rng.random(6) < 0.8
        task = goals.safety(game, jnp.asarray(safe))
        if not np.asarray(winning_region(game, task).region).any():
            continue
        strategy = permissive_strategy(game, task)
        available = np.asarray(game.available)
        support = np.asarray(jl.models.to_dense(game.mdp).transition) > 0
        mine = np.flatnonzero(np.asarray(game.system))
        used = np.zeros_like(available)
        for choice in itertools.product(*(np.flatnonzero(available[s]) for s in mine)):
            kept = available.copy()
            kept[mine] = False
            kept[mine, list(choice)] = True
            inside = safe.copy()
            while True:  # what the fixed choice keeps safe
                smaller = inside & ~(kept[..., None] & support & ~inside).any((1, 2))
                if (smaller == inside).all():
                    break
                inside = smaller
            used |= kept & inside[:, None]
        np.testing.assert_array_equal(strategy.allowed, used)
        assert strategy.maximal


@pytest.mark.parametrize("method", ["auto", "rank", "counter", "parity"])
def test_every_run_of_a_buchi_strategy_wins(method):
    rng = np.random.default_rng(1)
    seen = 0
    for _ in range(14):
        game = random_case(rng, kind=None if method in ("auto", "rank") else "deterministic")
        task = goals.buchi(game, jnp.asarray(rng.random(6) < 0.4))
        bound = {"counter": 3, "parity": None}.get(method)
        if not np.asarray(winning_region(game, task).region).any():
            continue
        try:
            strategy = permissive_strategy(game, task, method=method, bound=bound)
        except ValueError:
            assert method == "counter"  # three moves may be too few
            continue
        seen += 1
        assert all_runs_win(strategy, task)
    assert seen > 5


def test_every_run_of_a_parity_or_reactive_strategy_wins():
    rng = np.random.default_rng(2)
    seen, maximal = 0, 0
    for i in range(24):
        game = random_case(rng, num_states=5, kind="deterministic" if i % 2 else "mixed")
        sets = [jnp.asarray(rng.random(5) < 0.5) for _ in range(4)]
        if i % 2:
            task = goals.parity(game, jnp.asarray(rng.integers(4, size=5)))
        else:
            task = goals.gr1(game, sets[:2], sets[2:])
        if not np.asarray(winning_region(game, task).region).any():
            continue
        strategy = permissive_strategy(game, task)
        seen += 1
        maximal += strategy.maximal
        assert all_runs_win(strategy, task)
    assert seen > 10 and 0 < maximal < seen


def test_the_parity_construction_includes_every_memoryless_winning_strategy():
    rng = np.random.default_rng(3)
    included = 0
    for _ in range(12):
        game = random_case(rng, num_states=5, kind="deterministic")
        priority = rng.integers(4, size=5)
        task = goals.parity(game, jnp.asarray(priority))
        region = np.asarray(winning_region(game, task).region)
        if not region.any():
            continue
        strategy = permissive_strategy(game, task, method="parity")
        memory = np.asarray(strategy.game.mdp.next_memory)
        mask, first = np.asarray(strategy.allowed), strategy.game.mdp.initial_memory
        available, system = np.asarray(game.available), np.asarray(game.system)
        successor = np.asarray(game.mdp.successor)[..., 0]
        for choice in itertools.product(*(np.flatnonzero(row) for row in available[system])):
            fixed = available.copy()
            fixed[system] = False
            fixed[np.flatnonzero(system), list(choice)] = True
            hostile = game.replace(
                mdp=game.mdp.replace(available=jnp.asarray(fixed)), system=jnp.zeros(5, bool)
            )
            wins = np.asarray(winning_region(hostile, task).region)
            todo = [(s, int(first[s])) for s in np.flatnonzero(wins)]
            met = set(todo)
            while todo:
                s, m = todo.pop()
                for a in np.flatnonzero(fixed[s]):
                    assert mask[s, m, a], (s, m, a)
                    included += 1
                    after = (int(successor[s, a]), int(memory[s, m]))
                    if after not in met:
                        met.add(after)
                        todo.append(after)
    assert included > 100


def test_budgets_count_lexicographically():
    """Against a plain count by digits: priorities 0 to 4, at most 2 of priority 1 and 1 of 3."""
    delta = budgets([2, 1], 5)
    order = list(itertools.product(range(3), range(2)))  # remaining counts, most significant first
    assert len(delta) == len(order) + 1 and order[len(delta) - 2] == (2, 1)
    spent = len(order)
    for n, (first, second) in enumerate(order):
        expected = [
            (2, 1),
            (first - 1, 1) if first else None,
            (first, 1),
            (first, second - 1) if second else ((first - 1, 1) if first else None),
            (first, second),
        ]
        assert delta[n].tolist() == [spent if x is None else order.index(x) for x in expected]
    assert (delta[spent] == spent).all()


def test_after_a_goal_is_reached_everything_is_allowed():
    """From 0 the goal 1 is reached; afterwards even the trap 2 is no failure."""
    world = jl.from_dense(
        [[[0, 1.0, 0], [0, 0, 1.0]], [[1.0, 0, 0], [0, 0, 1.0]], [[0, 0, 1.0], [0, 0, 0]]],
        initial=[1, 0, 0],
    )
    game = make_game(world, [True] * 3)
    strategy = permissive_strategy(game, goals.reach(game, jnp.array([False, True, False])))
    found = apply_strategy(strategy)
    states = np.asarray(strategy.base_state[found.base_state])
    assert sorted(states.tolist()) == [0, 0, 1, 1, 2]  # before and after, the trap only after
    start = int(np.flatnonzero(np.asarray(found.model.initial))[0])
    assert found.model.available[start].tolist() == [True, False]


# --- shields ----------------------------------------------------------------------------------


def test_a_shield_keeps_to_the_mask():
    rng = np.random.default_rng(4)
    mask = rng.random((50, 4)) < 0.5
    mask[:3] = False
    policy = rng.dirichlet(np.ones(4), size=50)
    policy[10] = [1, 0, 0, 0]
    mask[10] = [False, True, True, False]
    kept = np.asarray(shield_policy(jnp.asarray(policy), jnp.asarray(mask)))
    np.testing.assert_array_equal(kept[:3], policy[:3])
    some = mask.any(1)
    assert (kept[some][~mask[some]] == 0).all()
    np.testing.assert_allclose(kept.sum(1), 1)
    np.testing.assert_allclose(kept[10], [0, 0.5, 0.5, 0])
    inside = (policy * mask).sum(1) > 0
    rows = inside & some
    np.testing.assert_allclose(
        kept[rows], (policy * mask)[rows] / (policy * mask)[rows].sum(1, keepdims=True)
    )
    chosen = rng.integers(4, size=50)
    sure = np.asarray(shield_policy(jnp.asarray(chosen), jnp.asarray(mask)))
    assert mask[np.arange(50), sure][some].all()
    np.testing.assert_array_equal(sure[~some], chosen[~some])
    allowed = mask[np.arange(50), chosen]
    np.testing.assert_array_equal(sure[allowed], chosen[allowed])
    mask_ = jnp.asarray(mask)
    slope = jax.jit(jax.grad(lambda p: shield_policy(p, mask_)[5] @ jnp.arange(4.0)))(policy)
    assert np.isfinite(slope).all()


# --- mistakes ---------------------------------------------------------------------------------


def test_bad_requests_are_refused():
    game = robots(3)
    task = goals.buchi(game, CORNERS, safe="!collision")
    with pytest.raises(ValueError, match=r"unrealizable.*every initial state.*counter_action"):
        permissive_strategy(game, "F collision & G !collision")
    with pytest.raises(ValueError, match=r"bound=1 is too small.*raise it"):
        permissive_strategy(game, task, method="counter", bound=1)
    lucky = make_mdp([[[0, 1]], [[0, 0]]], [[[0.5, 0.5]], [[1, 0]]], initial=[1, 0])
    with pytest.raises(ValueError, match=r"chance can put it off.*choose rank"):
        permissive_strategy(lucky, goals.buchi(lucky, jnp.array([False, True])), method="parity")
    with pytest.raises(ValueError, match=r'method="stay".*does not win'):
        permissive_strategy(game, task, method="stay")
    with pytest.raises(ValueError, match="choose one of auto, stay"):
        permissive_strategy(game, task, method="best")
    with pytest.raises(ValueError, match=r"bound=0"):
        permissive_strategy(game, task, bound=0)
    with pytest.raises(ValueError, match="needs bound=m"):
        permissive_strategy(game, task, method="counter")
    with pytest.raises(ValueError, match=r"counter.* is for Buchi"):
        permissive_strategy(game, goals.cobuchi(game, "!collision"), method="counter", bound=3)
    with pytest.raises(ValueError, match=r"rank.* is for Buchi"):
        permissive_strategy(game, goals.parity(game, jnp.where(game.system, 3, 2)), method="rank")
    with pytest.raises(ValueError, match="memory states here; give a smaller bound"):
        budgets([2000, 2000], 4)
    with pytest.raises(ValueError, match="allows no move in any state"):
        shield_policy(jnp.ones((2, 2)) / 2, jnp.zeros((2, 2), bool))
    with pytest.raises(ValueError, match="policy has shape"):
        shield_policy(jnp.ones((3, 2)) / 2, jnp.ones((2, 2), bool))
