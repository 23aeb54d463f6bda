"""Steps against nature, beside exact fractions over the vertices of each row."""

from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from jaxltl.core.models.interval import interval_rows
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.step_bounded import next_step, total, until


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
            found = until(model.host, target, stay, steps, Query(maximize, helpful))
            assert_holds(found, value)
            ahead = exact_backup(model, value, policy, nature)
            value = [
                Fraction(1) if t else a if ok else Fraction(0)
                for t, ok, a in zip(target, stay, ahead, strict=True)
            ]
        found = next_step(model.host, target, Query(maximize, helpful))
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
            found = total(
                model.host,
                earned.astype(float),
                start.astype(float),
                steps,
                Query(maximize, helpful),
            )
            for approximate, error, true in zip(found.value, found.error, value, strict=True):
                assert abs(Fraction(float(approximate)) - true) <= Fraction(float(error)) <= 1e-10
            value = exact_backup(model, value, policy, nature, earned)


def test_a_reward_that_changes_no_more_keeps_its_rounding():
    model = interval_rows(None, [0, 2, 3], [0, 1, 1], [0.25, 0.5, 1], [0.5, 0.75, 1])
    few, many = (
        total(model.host, np.zeros(3), np.array([0, 1.0]), n, Query(True, False))
        for n in (2000, 10**9)
    )
    assert few.value.tolist() == many.value.tolist() and many.num_steps < 200
    assert 0 < few.error[0] < many.error[0] < 1e-3
    nothing = total(model.host, np.zeros(3), np.zeros(2), 10**9, Query(True, False))
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
        found = until(model.host, target, np.ones(5, bool), 1, Query(True, False))
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
    found = until(model.host, target, stay, 10**9, Query(True, False))
    assert found.num_steps < 10**4
    assert ((found.error >= 0) & (found.error <= 1)).all()
