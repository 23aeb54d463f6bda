"""Steps against nature, beside exact fractions over the vertices of each row."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from jaxltl.core.models.interval import interval_rows
from jaxltl.core.sparse.bounded import backup
from jaxltl.core.sparse.bounded.backup import StepReward
from jaxltl.core.sparse.bounded.row_game import RowGame
from jaxltl.core.sparse.bounded.step_bounded import next_step, total, until


def game(model, maximize, helpful):
    """The model of one player, with the directions of the policy and of nature."""
    sets = model.host
    return RowGame(sets.mdp, np.full(sets.mdp.num_states, bool(maximize)), sets, bool(helpful))


def paid(model, earned):
    largest = np.maximum.reduceat(np.abs(earned), model.host.mdp.entry_start[:-1])
    return StepReward(largest, largest, earned)


def vertices(lower, upper):
    """All vertices of ``{p : l <= p <= u, sum p = 1}``: all but one number are ends."""
    found = []
    for free in range(len(lower)):
        others = [i for i in range(len(lower)) if i != free]
        for ends in product(*((lower[i], upper[i]) for i in others)):
            rest = 1 - sum(ends)
            if lower[free] <= rest <= upper[free]:
                point = dict(zip(others, ends, strict=True)) | {free: rest}
                found.append([point[i] for i in range(len(lower))])
    return found


def random_interval(rng, num_states=5, chain=False):
    """Rows with up to three successors, and ends that are multiples of 1/64, some 0 or 1."""
    rows, starts, entries = [0], [0], ([], [], [])
    for _ in range(num_states):
        for _ in range(1 if chain else rng.integers(1, 3)):
            size = int(rng.integers(1, 4))
            p = rng.multinomial(64, np.ones(size) / size)
            kind = rng.integers(3, size=size)
            low = np.where(kind == 0, 0, np.where(kind == 1, p, p // 2))
            high = np.where(kind == 1, p, np.minimum(64, p + rng.integers(0, 40, size)))
            entries[0].extend(rng.choice(num_states, size, replace=False).tolist())
            entries[1].extend((low / 64).tolist())
            entries[2].extend((high / 64).tolist())
            starts.append(len(entries[0]))
        rows.append(len(starts) - 1)
    return interval_rows(rows, starts, *entries)


def exact_backup(model, value, policy, nature, earned=None):
    """One step of exact numbers."""
    earned = [0] * model.num_transitions if earned is None else [Fraction(int(x)) for x in earned]
    host = model.host.mdp
    found = []
    for s in range(host.num_states):
        images = []
        for r in range(host.row_start[s], host.row_start[s + 1]):
            entry = range(host.entry_start[r], host.entry_start[r + 1])
            points = vertices(
                *([Fraction(float(x[e])) for e in entry] for x in (model.lower, model.upper))
            )
            images.append(
                nature(
                    sum(
                        p * (earned[e] + value[host.successor[e]])
                        for p, e in zip(point, entry, strict=True)
                    )
                    for point in points
                )
            )
        found.append(policy(images))
    return found


@pytest.mark.parametrize("seed", range(12))
def test_bounds_hold_the_exact_value(seed):
    rng = np.random.default_rng(seed)
    model = random_interval(rng, chain=seed % 4 == 0)
    target = np.arange(5) == rng.integers(5)
    stay = rng.random(5) < 0.8
    for maximize, helpful in product((False, True), repeat=2):
        policy, nature = (max if x else min for x in (maximize, helpful))
        value = [Fraction(int(x)) for x in target]
        for steps in range(6):
            found = until(game(model, maximize, helpful), target, stay, steps)
            assert_holds(found, value)
            ahead = exact_backup(model, value, policy, nature)
            value = [
                Fraction(1) if t else a if ok else Fraction(0)
                for t, ok, a in zip(target, stay, ahead, strict=True)
            ]
        found = next_step(game(model, maximize, helpful), target)
        assert_holds(found, exact_backup(model, [Fraction(int(x)) for x in target], policy, nature))


@pytest.mark.parametrize("seed", range(6))
def test_bounds_hold_the_exact_reward(seed):
    rng = np.random.default_rng(seed)
    model = random_interval(rng, chain=seed % 3 == 0)
    earned = rng.integers(-3, 4, model.num_transitions) * (rng.random(model.num_transitions) < 0.5)
    start = rng.integers(-2, 3, 5) * (seed % 2)
    for maximize, helpful in product((False, True), repeat=2):
        policy, nature = (max if x else min for x in (maximize, helpful))
        value = [Fraction(int(x)) for x in start]
        for steps in range(5):
            reward = paid(model, earned.astype(float))
            found = total(game(model, maximize, helpful), reward, start.astype(float), steps)
            for approximate, error, true in zip(found.value, found.error, value, strict=True):
                assert abs(Fraction(float(approximate)) - true) <= Fraction(float(error)) <= 1e-10
            value = exact_backup(model, value, policy, nature, earned)


def test_a_reward_that_changes_no_more_keeps_its_rounding():
    model = interval_rows(None, [0, 2, 3], [0, 1, 1], [0.25, 0.5, 1], [0.5, 0.75, 1])
    few, many = (
        total(game(model, True, False), paid(model, np.zeros(3)), np.array([0, 1.0]), n)
        for n in (2000, 10**9)
    )
    assert few.value.tolist() == many.value.tolist() and many.num_steps < 200
    assert 0 < few.error[0] < 1e-9 and 0 < many.error[0] < 1e-3
    nothing = total(game(model, True, False), paid(model, np.zeros(3)), np.zeros(2), 10**9)
    assert nothing.error.tolist() == [0, 0]


def assert_holds(found, exact):
    for value, error, true in zip(found.value, found.error, exact, strict=True):
        assert abs(Fraction(float(value)) - true) <= Fraction(float(error))
        assert error <= 1e-12
        if true in (0, 1):
            assert error == 0
    assert (found.probability >= 0).all()


def test_what_nature_picks_lies_in_the_intervals_and_attains_the_value():
    rng = np.random.default_rng(7)
    for _ in range(20):
        model = random_interval(rng)
        target = np.arange(5) == 0
        found = until(game(model, True, False), target, np.ones(5, bool), 1)
        p = found.probability
        assert ((model.lower <= p) & (p <= model.upper)).all()
        image = model.host.sum_rows(p * target[model.host.mdp.successor])
        attained = np.where(target, 1, image[found.row])
        np.testing.assert_allclose(attained, found.value, atol=1e-15)
        assert (
            np.maximum.reduceat(image, model.host.mdp.row_start[:-1])[~target]
            <= found.value[~target] + 1e-15
        ).all()


def test_many_steps_are_as_few_that_changed_something():
    model = random_interval(np.random.default_rng(1))
    target, stay = np.arange(5) == 2, np.ones(5, bool)
    found = until(game(model, True, False), target, stay, 10**9)
    assert found.num_steps < 10**4
    assert ((found.error >= 0) & (found.error <= 1)).all()


@pytest.mark.few(1, 1)
@pytest.mark.parametrize("maximize, helpful", [(0, 0), (1, 1), (0, 1), (1, 0)])
def test_a_huge_number_of_steps_is_answered_by_the_limit(maximize, helpful):
    # State 0 leaves with probability 2e-7 at most, to a coin between the target and a sink.
    model = interval_rows(
        None,
        [0, 2, 4, 5, 6],
        [0, 1, 2, 3, 2, 3],
        [1 - 2e-7, 1e-7, 0.25, 0.5, 1, 1],
        [1 - 1e-7, 2e-7, 0.5, 0.75, 1, 1],
    )
    target, stay = np.arange(4) == 2, np.ones(4, bool)
    found = until(game(model, maximize, helpful), target, stay, 10**10)
    exact = 0.5 if helpful else 0.25
    assert abs(found.value[0] - exact) <= found.error[0] <= 1e-8
    assert found.num_steps < 10**5
    # Before the limit holds, backups or wide bounds enclose the closed form.
    rate = 2e-7 if helpful else 1e-7
    steps = 3 * 10**4
    found = until(game(model, maximize, helpful), target, stay, steps)
    assert abs(found.value[0] + exact * np.expm1((steps - 1) * np.log1p(-rate))) <= found.error[0]


def test_average_growth_bounds_a_huge_reward():
    model = interval_rows(
        None, [0, 2, 4], [0, 1, 0, 1], [0.25, 0.5, 0.5, 0.25], [0.5, 0.75, 0.75, 0.5]
    )
    earned = np.array([1.0, 1.0, 0.0, 0.0])
    for helpful, share in ((True, 0.6), (False, 0.4)):
        found = total(game(model, helpful, helpful), paid(model, earned), np.zeros(2), 10**11)
        assert np.allclose(found.value / 10**11, share, rtol=1e-9)
        assert (found.error <= 1e-2 * found.value).all() and found.num_steps < 10**5


@pytest.mark.few(5, 5)
@pytest.mark.parametrize("seed", range(24))
def test_bounds_of_remaining_steps_enclose_all_backups(seed, monkeypatch):
    rng = np.random.default_rng(seed)
    model = random_interval(rng, chain=seed % 4 == 0)
    size = model.num_transitions
    target, stay, num_steps = rng.random(5) < 0.3, rng.random(5) < 0.8, int(rng.integers(3, 300))
    earned = rng.random(size) * (rng.random(size) < 0.4) - 0.5 * (seed % 3 == 1)
    start = rng.random(5) - 0.5

    def answers():
        for rows in (game(model, *x) for x in product((False, True), repeat=2)):
            yield until(rows, target, stay, num_steps)
            yield total(rows, paid(model, earned), np.zeros(5), num_steps)
            yield total(rows, paid(model, np.zeros(size)), start, num_steps)

    whole = list(answers())
    for long, close, work in ((2, 1e-9, 2.0**38), (2, 1e-2, 2.0**38), (2, 0.0, 600_000.0)):
        for name, x in (("LONG", long), ("CLOSE", close), ("_WORK", work)):
            monkeypatch.setattr(backup, name, x)
        for exact, found in zip(whole, answers(), strict=True):
            width = exact.error + found.error + 1e-13
            assert (np.abs(exact.value - found.value) <= width).all()
