"""Long-run averages of games and interval models against all positional strategies and vertices."""

import itertools

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.interval import interval_rows
from jaxltl.core.models.sparse import Rewards
from jaxltl.core.sparse.interval.average_reward import AverageGame, AverageGoal, optimal_average
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.solvers.average_reward import RewardRange
from jaxltl.core.types import Status
from tests import reference_matrix as reference

UNIT = 16


class Row:
    """One choice: successors, ends and a center in multiples of 1 / 16, and a reward."""

    def __init__(self, rng, size, has_ball):
        width = int(rng.integers(1, min(3, size) + 1))
        self.successor = np.sort(rng.choice(size, width, replace=False))
        cut = np.sort(rng.integers(0, UNIT + 1, width - 1))
        self.center = np.diff(cut, prepend=0, append=UNIT)
        slack = 0 if rng.random() < 0.3 else rng.integers(1, 9, width)
        self.lower = np.maximum(self.center - slack, 0)
        self.upper = np.minimum(self.center + slack, UNIT)
        self.budget = int(rng.integers(0, 5)) if has_ball else UNIT
        self.reward = rng.integers(-2, 3) / 2

    def vertices(self, size):
        """Extreme distributions: mass moves from the worst successors to the best ones."""
        found = set()
        for order in itertools.permutations(range(len(self.successor))):
            p, budget = self.center.copy(), self.budget
            for good, bad in itertools.product(order, reversed(order)):
                if order.index(good) < order.index(bad):
                    moved = min(self.upper[good] - p[good], p[bad] - self.lower[bad], budget)
                    p[good], p[bad], budget = p[good] + moved, p[bad] - moved, budget - moved
            found.add(tuple(p))
        rows = np.zeros((len(found), size))
        rows[:, self.successor] = np.array(sorted(found)) / UNIT
        return list(rows)


def random_game(rng, size, has_ball=False):
    rows = [[Row(rng, size, has_ball) for _ in range(rng.integers(1, 3))] for _ in range(size)]
    flat = [row for state in rows for row in state]
    start = np.cumsum([0, *(len(row.successor) for row in flat)])
    lower, upper, center, after = (
        np.concatenate([getattr(row, name) for row in flat])
        for name in ("lower", "upper", "center", "successor")
    )
    ball = {}
    if has_ball:
        ball = {
            "center": center / UNIT,
            "radius": np.array([2 * row.budget / UNIT for row in flat]),
        }
    row_start = np.cumsum([0, *map(len, rows)])
    # Entries with the upper end 0 are dropped by the constructor.
    model = interval_rows(row_start, start, after, lower / UNIT, upper / UNIT, **ball)
    return rows, model, np.array([row.reward for row in flat])


def brute_force(rows, system, objective, nature, mix=None):
    """The value by all strategies; `mix` are weights of the rows of each of the system's states."""
    direction = 1 if objective == "max" else -1
    towards = direction if nature == "cooperative" else -direction
    tables, size = [], len(rows)
    for s, choices in enumerate(rows):
        owner = direction if system[s] else -direction
        points = [[(p, row.reward) for p in row.vertices(size)] for row in choices]
        if mix is not None and system[s]:
            mean = [
                tuple(sum(w * x[i] for w, x in zip(mix[s], each, strict=True)) for i in (0, 1))
                for each in itertools.product(*points)
            ]
            points = [mean]
        flat = [x for point in points for x in point]
        if owner == towards or len(points) == 1:
            tables.append([[x] for x in flat] if towards > 0 else [flat])
            continue
        answers = list(itertools.product(*points))
        table = [[answer[i] for answer in answers] for i in range(len(points))]
        tables.append(table if owner > 0 else [list(column) for column in zip(*table, strict=True)])
    count = np.prod([len(t) * len(t[0]) for t in tables])
    return reference.minimax(tables, reference.average) if count <= 30_000 else None


def assert_right(found, exact, largest=1.0):
    assert (found.lower - 1e-9 <= exact).all(), (found.lower - exact, found)
    assert (exact <= found.upper + 1e-9).all(), (found.upper - exact, found)
    assert int(found.status) == Status.CONVERGED, found
    assert (found.upper - found.lower <= 1e-6 * np.maximum(np.abs(exact), 1.1e-3 * largest)).all()


def ask(rng, size, has_ball):
    rows, model, reward = random_game(rng, size, has_ball)
    system = rng.random(size) < rng.choice([0.5, 1.0])
    objective, nature = rng.choice(["max", "min"]), rng.choice(["adversarial", "cooperative"])
    mix = None
    weight = np.ones(len(reward))
    if rng.random() < 0.3:
        mix = [rng.multinomial(4, np.ones(len(r)) / len(r)) / 4 for r in rows]
        weight = np.concatenate(mix)
    exact = brute_force(rows, system, objective, nature, mix)
    if exact is None:
        return False
    game = model if system.all() else jl.make_game(model, system)
    found = jl.average_reward(
        game,
        Rewards(choice=reward),
        objective=objective,
        nature=nature,
        policy=None if mix is None else weight,
    )
    assert_right(found, exact)
    return True


@pytest.mark.parametrize("seed", range(6))
def test_bounds_enclose_the_value_of_random_games(seed):
    rng = np.random.default_rng(seed)
    for _ in range(3):
        ask(rng, int(rng.integers(1, 4)), has_ball=seed % 2 == 1)


@pytest.mark.few(0, 6)
@pytest.mark.parametrize("seed", range(20))
def test_bounds_enclose_the_value_of_many_random_games(seed):
    rng = np.random.default_rng([1, seed])
    asked = sum(ask(rng, int(rng.integers(2, 5)), has_ball=seed % 2 == 1) for _ in range(25))
    assert asked >= 10


def test_nature_can_disconnect_a_component():
    """A state that nature leaves, or never leaves: its gain is the one or the other."""
    model = interval_rows(None, [0, 2, 3], [0, 1, 0], [0.5, 0, 1], [1, 0.5, 1])
    reward = [1.0, 0.0]
    helped = jl.average_reward(model, reward, nature="cooperative")
    np.testing.assert_array_equal(helped.value, [1, 1])
    against = jl.average_reward(model, reward)
    np.testing.assert_allclose(against.value, 2 / 3)
    assert_right(against, np.full(2, 2 / 3))
    model = interval_rows(None, [0, 2, 3], [0, 1, 1], [0, 0, 1], [1, 1, 1])
    for nature, value in (("adversarial", 0), ("cooperative", 1)):
        found = jl.average_reward(model, reward, nature=nature)
        assert_right(found, np.array([value, 0]))
    # Where it must leave in the end, however late.
    model = interval_rows(None, [0, 2, 3], [0, 1, 1], [0, 0.001, 1], [0.999, 1, 1])
    found = jl.average_reward(model, reward, nature="cooperative")
    assert_right(found, np.zeros(2))


@pytest.mark.parametrize("reward", [0.0, -3.0, 0.1, 1e-9, -1e9])
def test_one_reward_is_the_average(reward):
    rng = np.random.default_rng(5)
    for has_ball in (False, True):
        _, model, rewards = random_game(rng, 3, has_ball)
        for system in ([True] * 3, [True, False, True]):
            game = jl.make_game(model, np.array(system))
            found = jl.average_reward(game, Rewards(choice=np.full_like(rewards, reward)))
            for x in (found.lower, found.value, found.upper):
                np.testing.assert_array_equal(x, reward)


def test_games_in_which_the_components_are_left():
    """The environment moves in a circle of the system's, with ways out on both sides."""
    model = jl.make_sparse([0, 2, 4, 5, 6], np.arange(7), [1, 2, 0, 3, 2, 3], np.ones(6))
    game = jl.make_game(model, [True, False, True, True])
    for reward, value in (
        ([3.0, 1.0, 1.5, 1.8], [1.8, 1.8, 1.5, 1.8]),
        ([3.0, 1.0, 2.5, 2.4], [2.5, 2.4, 2.5, 2.4]),
        ([3.0, 1.0, -1.0, 5.0], [2.0, 2.0, -1.0, 5.0]),
    ):
        found = jl.average_reward(game, reward)
        assert_right(found, np.array(value), 5)
        paid = np.repeat(reward, np.diff(model.row_start))
        exact = jl.values.mean_payoff(game, Rewards(choice=paid))
        np.testing.assert_array_equal(exact.value, value)
        own = jl.average_reward(game, reward, policy=found.policy)
        assert_right(own, np.array(value), 5)


def test_periodic_and_rare_transitions():
    size = 40
    after = (np.arange(size) + 1) % size
    circle = interval_rows(None, np.arange(size + 1), after, np.ones(size), np.ones(size))
    found = jl.average_reward(circle, np.arange(size, dtype=float))
    assert_right(found, np.full(size, (size - 1) / 2), size)
    low, high = 1e-7, 1e-5
    rare = interval_rows(
        None,
        [0, 2, 4],
        [0, 1, 0, 1],
        [1 - high, low, low, 1 - high],
        [1 - low, high, high, 1 - low],
    )
    for objective, value in (("max", 1 / 101), ("min", 100 / 101)):
        found = jl.average_reward(rare, [0.0, 1.0], objective=objective)
        assert_right(found, np.full(2, value))


def test_rewards_of_transitions_count_as_nature_chooses():
    model = interval_rows(None, [0, 2, 3], [0, 1, 0], [0.25, 0.25, 1], [0.75, 0.75, 1])
    reward = Rewards(transition=np.array([0.0, 4.0, 0.0]))
    for objective, p in (("max", 0.25), ("min", 0.75)):
        found = jl.average_reward(model, reward, objective=objective)
        assert_right(found, np.full(2, 4 * p / (1 + p)), 4)


def test_wide_rows_need_no_list_of_vertices():
    rng = np.random.default_rng(0)
    size = 40
    center = rng.dirichlet(np.ones(size), size)
    model = interval_rows(
        None,
        np.arange(size + 1) * size,
        np.tile(np.arange(size), size),
        np.maximum(center - 0.01, 0).ravel(),
        (center + 0.01).ravel(),
    )
    reward = rng.random(size)
    width = {}
    for nature in ("adversarial", "cooperative"):
        found = jl.check(jl.average_reward(model, reward, nature=nature))
        chain = (
            jl.make_sparse(None, np.arange(size + 1) * size, model.nominal.successor, found.nature)
            if (found.nature > 0).all()
            else None
        )
        if chain is not None:
            np.testing.assert_allclose(jl.average_reward(chain, reward).value, found.value)
        width[nature] = found.value[0]
    nominal = jl.average_reward(
        jl.make_sparse(
            None, np.arange(size + 1) * size, np.tile(np.arange(size), size), center.ravel()
        ),
        reward,
    ).value[0]
    assert width["adversarial"] < nominal < width["cooperative"]


def test_the_engine_takes_nature_of_either_player():
    """Nature of the minimiser, where the rewards are negated, is nature of the maximiser."""
    rng = np.random.default_rng(3)
    for _ in range(5):
        _, model, reward = random_game(rng, 3)
        owner = rng.random(3) < 0.5
        paid = np.repeat(reward, np.diff(model.nominal.host.entry_start))
        host: UncertainMDP = model.host
        ends = RewardRange(-1.0, 1.0, (True, True))
        one, two = (
            optimal_average(
                AverageGame(host, sign * paid, owner == (sign > 0), sign > 0),
                AverageGoal(ends, 1e-6, 10_000),
            )
            for sign in (1, -1)
        )
        np.testing.assert_allclose(one.value, -two.value, atol=1e-8)


def test_what_is_wrong_with_the_policy_or_nature_is_named():
    world = jl.from_dense([[[1.0, 0], [0, 1.0]], [[1.0, 0], [0, 1.0]]])
    game = jl.make_game(world, [True, False])
    with pytest.raises(ValueError, match="policy has shape"):
        jl.average_reward(game, np.ones((2, 2)), policy=np.zeros(3, int))
    with pytest.raises(ValueError, match="nature"):
        jl.average_reward(game, np.ones((2, 2)), nature="cooperative")
    assert jl.average_reward(game, np.eye(2)).value.shape == (2,)
