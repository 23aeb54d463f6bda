"""Models in which some policies hardly ever end: bounds by sweeps, whatever other methods do."""

import itertools
from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.sparse.linear.ordered_sweeps import CostRows, OrderedSweeps
from jaxltl.core.sparse.solvers import policy_iteration as module
from jaxltl.core.sparse.solvers.reachability import reachability, total_reward
from tests.reference_fractions import optimum, solve

METHODS = ["_by_refinement", "_by_converged_sweeps", "_by_gth_refinement", "_by_fractions"]


def robot(size, battery, slip, *, charges=True, choices=True):
    """A robot that fetches a load from one corner of a grid for another one; its battery runs down.

    Moves fail with a probability, and the battery is charged in the start cell. Without choices,
    each move is a random one. The states before the last two are triples (cell, charge, loaded).
    """
    row_start, entry_start, successor, probability = [0], [0], [], []
    done, dead = 2 * size * size * (battery + 1), 2 * size * size * (battery + 1) + 1

    def number(x, y, b, loaded):
        return ((b * size + y) * size + x) * 2 + loaded

    def row(*entries):
        successor.extend(s for s, _ in entries)
        probability.extend(p for _, p in entries)
        entry_start.append(len(successor))

    for b in range(battery + 1):
        for y in range(size):
            for x in range(size):
                for loaded in (0, 1):
                    moves = [(x + 1, y), (x - 1, y), (x, y + 1), (x, y - 1)]
                    moves = [(i, j) for i, j in moves if 0 <= i < size and 0 <= j < size]
                    if loaded and (x, y) == (0, size - 1):
                        row((done, 1.0))
                    elif (x, y) == (0, 0) and b < battery and charges and not choices:
                        row((number(0, 0, battery, loaded), 1.0))
                    elif b == 0 and not ((x, y) == (0, 0) and charges):
                        row((dead, 1.0))
                    else:
                        rows = []
                        for i, j in moves if b else []:
                            after = loaded or (i, j) == (size - 1, 0)
                            stays, goes = (
                                number(x, y, b - 1, loaded),
                                number(i, j, b - 1, int(after)),
                            )
                            rows.append([(goes, 1 - slip), (stays, slip)])
                        if not choices:
                            each = [(s, p / len(rows)) for r in rows for s, p in r]
                            total = {}
                            for s, p in each:
                                total[s] = total.get(s, 0.0) + p
                            rows = [list(total.items())]
                        elif (x, y) == (0, 0) and b < battery and charges:
                            rows.append([(number(0, 0, battery, loaded), 1.0)])
                        for one in rows:
                            row(*one)
                    row_start.append(len(entry_start) - 1)
    for end in (done, dead):
        row((end, 1.0))
        row_start.append(len(entry_start) - 1)
    return make_sparse(row_start, entry_start, successor, probability).host, number(
        0, 0, battery, 0
    )


def ends(host):
    """The two last states: delivered, and run down."""
    done, dead = (np.zeros(host.num_states, bool) for _ in range(2))
    done[-2], dead[-1] = True, True
    return done, dead


def exact_optimum(host, target, cost, maximize):
    """Probabilities of the target, or costs until it, by policy iteration in fractions."""
    rows = [
        {
            int(t): Fraction(float(p))
            for t, p in zip(host.successor[a:b], host.probability[a:b], strict=True)
        }
        for a, b in itertools.pairwise(host.entry_start.tolist())
    ]
    choices = [
        [(r, rows[r]) for r in range(a, b)] for a, b in itertools.pairwise(host.row_start.tolist())
    ]
    goal = {
        s: Fraction(int(cost is None and target[s])) for s in (len(choices) - 2, len(choices) - 1)
    }
    return optimum(choices, goal, cost, maximize)


def value_iteration(host, target, *, maximize, sweeps=4000):
    """Probabilities within some steps."""
    value = target.astype(float)
    optimum_ = np.maximum if maximize else np.minimum
    for _ in range(sweeps):
        image = np.add.reduceat(host.probability * value[host.successor], host.entry_start[:-1])
        before, value = value, np.where(target, 1, optimum_.reduceat(image, host.row_start[:-1]))
        if np.abs(value - before).max() < 1e-13:
            break
    return value


@pytest.mark.parametrize("choices", [True, False])
def test_a_small_robot_against_fractions(choices):
    host, start = robot(2, 4, 0.25, choices=choices)
    done, dead = ends(host)
    cost = np.ones(host.num_rows)
    for maximize in (True, False):
        for target in (done, dead, done | dead):
            reward = None if (target != (done | dead)).any() else cost
            best = exact_optimum(host, target, reward, maximize)
            if reward is None:
                found = reachability(host, target, maximize=maximize)
            else:
                found = total_reward(host, reward, target, maximize=maximize)
            for low, exact, high in zip(found.lower, best, found.upper, strict=True):
                assert Fraction(float(low)) <= exact <= Fraction(float(high))
            assert found.upper[start] - found.lower[start] <= 1e-6 * max(1, found.upper[start])


@pytest.mark.parametrize("disabled", [None, "_iterate", *METHODS])
def test_bounds_are_narrow_without_any_one_method(disabled, monkeypatch):
    if disabled == "_iterate":
        monkeypatch.setattr(module._CoreSolver, "_iterate", lambda *_: (None, 0))
    elif disabled is not None:
        monkeypatch.setattr(module._CoreSolver, disabled, lambda *_: None)
    host, start = robot(2, 12, 0.25)
    done, dead = ends(host)
    for target in (done, dead):
        for maximize in (True, False):
            found = reachability(host, target, maximize=maximize)
            value = value_iteration(host, target, maximize=maximize)
            assert (found.lower <= found.upper).all()
            assert (value <= found.upper + 1e-12).all()  # values within some steps are lower bounds
            assert (found.upper - found.lower <= 1e-6).all()
            assert found.lower[start] <= found.value[start] <= found.upper[start]


@pytest.mark.few(1)
@pytest.mark.parametrize(
    "size, battery", [(12, 24), (10, 35), pytest.param(20, 60, marks=pytest.mark.exhaustive)]
)
def test_a_battery_that_is_charged_again_and_again(size, battery):
    """A policy that waits near the charger lasts for 1e15 steps and more."""
    host, start = robot(size, battery, 0.05)
    done, dead = ends(host)
    value = value_iteration(host, done, maximize=True)
    found = reachability(host, done, maximize=True)
    assert (found.upper - found.lower <= 1e-6).all()
    assert (np.abs(found.value - value) <= 1e-6).all() and 0.9 < value[start] < 1
    # The complement, whose least value waiting seems to attain.
    lost = reachability(host, dead, maximize=False)
    assert (lost.upper - lost.lower <= 1e-6).all()
    assert (lost.lower <= 1 - value + 1e-9).all() and (1 - value - 1e-9 <= lost.upper).all()


def random_rows(rng, size, rare):
    """Rows with choices whose probabilities of leaving are rare, and costs."""
    from scipy import sparse

    owner = np.sort(np.concatenate([np.arange(size), rng.integers(0, size, size)]))
    matrix = np.zeros((owner.size, size))
    for r, i in enumerate(owner):
        targets = rng.choice(np.delete(np.arange(size), i), min(size - 1, 2), replace=False)
        matrix[r, targets] = rng.random(targets.size)
    leaving = np.where(rng.random(owner.size) < 0.3, rare * rng.random(owner.size), 0)
    leaving[0] = rare
    matrix *= ((1 - leaving) / matrix.sum(1))[:, None]
    cost = leaving * rng.random(owner.size)
    return CostRows(sparse.csr_array(matrix), cost, leaving, owner)


@pytest.mark.few(2)
@pytest.mark.parametrize("rare", [0.5, 1e-3, 1e-8, 1e-15])
def test_bounds_of_rows_that_rarely_leave(rare):
    """Bounds from any values enclose each policy's, however few runs end; from good ones, closely."""
    rng, narrow = np.random.default_rng(3), 0
    for _ in range(25 if rare > 0.1 else 6):
        rows = random_rows(rng, int(rng.integers(2, 7)), rare)
        policy = np.array(
            [rng.choice(np.flatnonzero(rows.owner == i)) for i in range(rows.matrix.shape[1])]
        )
        chain = rows.only(policy)
        sweeps = OrderedSweeps(chain, 1, 64 * 2.0**-52, relative=False)
        if sweeps.stuck:
            continue
        weights = chain.matrix.toarray()
        size = policy.size
        system = [
            [
                (Fraction(chain.leaving[i]) + sum(Fraction(w) for w in weights[i]) if i == j else 0)
                - Fraction(weights[i, j])
                for j in range(size)
            ]
            for i in range(size)
        ]
        exact = solve(system, [Fraction(c) for c in chain.cost])
        for start in (np.array([float(x) for x in exact]), rng.random(size)):
            low = sweeps.bound(start, -1, (1e-9,))
            high = sweeps.bound(start, 1, (1e-9,))
            for bound, direction in ((low, -1), (high, 1)):
                if bound is not None:
                    assert all(
                        direction * (Fraction(b) - x) >= 0
                        for b, x in zip(bound, exact, strict=True)
                    )
            if start[0] == float(exact[0]):
                narrow += low is not None and high is not None and (high - low).max() < 1e-6
        for direction in (-1, 1):
            bound = sweeps.monotone_bound(direction, 50)
            assert all(
                direction * (Fraction(b) - x) >= 0 for b, x in zip(bound, exact, strict=True)
            )
    assert narrow >= 2


@pytest.mark.slow
def test_rewards_beyond_all_methods_have_the_bounds_of_the_sweeps():
    """The longest time is above 1e40 steps, so that only the lower bound says something."""
    host, start = robot(8, 35, 0.05)
    done, dead = ends(host)
    found = total_reward(host, np.ones(host.num_rows), done | dead, maximize=True)
    assert found.lower[start] > 35 and found.lower[start] <= found.upper[start]
