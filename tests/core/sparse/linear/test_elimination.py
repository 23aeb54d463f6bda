"""Systems of policies against dense solves, whichever way they are taken apart."""

from fractions import Fraction

import numpy as np
import pytest
from scipy import sparse

from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.sparse.linear import elimination
from jaxltl.core.sparse.linear import extended_precision as exact
from jaxltl.core.sparse.linear import topological_order as levels
from jaxltl.core.sparse.linear.elimination import factorize
from jaxltl.core.sparse.linear.topological_order import Edges, ordered_components
from jaxltl.core.sparse.solvers.reachability import reachability
from tests.sparse_models import exact_solve


def random_rows(rng, size, components):
    """Two rows for each state, that lead to components before; a tenth of each leaves."""
    group = np.sort(rng.integers(0, components, size))
    rows = np.zeros((2 * size, size))
    for r in range(2 * size):
        ahead = np.flatnonzero(group <= group[r // 2])
        for t in rng.choice(ahead, min(3, ahead.size), replace=False):
            rows[r, t] = rng.random()
    matrix = sparse.csr_array(0.9 * rows / np.maximum(rows.sum(1), 1)[:, None])
    every = sparse.csr_array(matrix[::2] + matrix[1::2])
    return matrix, ordered_components(Edges(every.indptr, every.indices))


@pytest.mark.parametrize("way", ("together", "by degree", "apart", "swept", "some swept"))
def test_solutions(way, monkeypatch):
    if way == "by degree":
        monkeypatch.setattr(elimination, "_LARGE", 0)
        monkeypatch.setattr(elimination, "_SEVERAL", 0)
        monkeypatch.setattr(elimination, "_NARROW", -1)
    if way == "apart":
        monkeypatch.setattr(elimination, "_MAX_FILL_TOGETHER", -1)
        monkeypatch.setattr(elimination, "_MIN_STATES_ALONE", 2)
    if way in ("swept", "some swept"):
        monkeypatch.setattr(elimination, "_MAX_FILL", 0 if way == "swept" else 20)
        monkeypatch.setattr(elimination, "_MIN_STATES_ALONE", 2)
    rng, seen = np.random.default_rng(0), set()
    for _ in range(20):
        size = int(rng.integers(1, 30))
        rows, label = random_rows(rng, size, int(rng.integers(1, 5)))
        found = None
        for _ in range(3):
            chosen = 2 * np.arange(size) + rng.integers(0, 2, size)
            found = factorize(rows, label, chosen) if found is None else found.refactorize(chosen)
            b = rng.random(size)
            expected = np.linalg.solve(np.eye(size) - rows[chosen].toarray(), b)
            np.testing.assert_allclose(found.solve(b), expected, rtol=1e-10)
            seen.add((found.method.removeprefix("policy iteration by "), len(found.blocks) > 1))
    methods, several = zip(*seen, strict=True)
    assert any(several) == (way not in ("together", "by degree"))
    swept = {"swept": "sweeps", "some swept": "elimination and sweeps"}
    assert swept.get(way, "elimination") in methods


def filled(pattern):
    """The entries of both factors of a pattern, eliminated one by one."""
    full = pattern | np.eye(len(pattern), dtype=bool)
    for k in range(len(full)):
        full[k + 1 :, k + 1 :] |= np.outer(full[k + 1 :, k], full[k, k + 1 :])
    return int(full.sum())


def test_what_fills_is_counted(monkeypatch):
    rng = np.random.default_rng(0)
    for _ in range(30):
        size = int(rng.integers(2, 40))
        pattern = rng.random((size, size)) < 0.08
        source, target = np.nonzero(pattern)
        both = filled(pattern | pattern.T)
        assert size + 2 * elimination._counted(source, target, size) == pytest.approx(both)
        matrix, label = sparse.csr_array(pattern * 1.0), np.zeros(size, int)
        for most, too_much in ((filled(pattern) - 1, True), (both, False)):
            monkeypatch.setattr(elimination, "_MAX_FILL", most)
            assert elimination._too_much(matrix, label) == too_much


def rings(size, rng):
    """Two rings, on which a walk goes either way; from each state of one it may fall to the other.

    The last state is the goal, to which the second ring leads.
    """
    i = np.arange(2 * size)
    base = i // size * size
    right, left = base + (i + 1) % size, base + (i - 1) % size
    down = np.where(i < size, size + rng.integers(0, size, 2 * size), 2 * size)
    entry = np.append(3 * np.arange(2 * size + 1), 6 * size + 1)
    return make_sparse(
        np.append(np.arange(2 * size + 1), 2 * size + 1),
        entry,
        np.append(np.stack([right, left, down], 1).ravel(), 2 * size),
        np.append(np.tile([0.55, 0.44, 0.01], 2 * size), 1.0),
    ).host


def test_nothing_fills_between_large_components():
    """With all that leads from one to the other it would be half of 4000 x 4000 entries."""
    host = rings(4000, np.random.default_rng(0))
    matrix = host.matrix[:-1][:, :-1]
    label = (np.arange(8000) < 4000).astype(int)
    found = factorize(matrix, label, np.arange(8000))
    assert found.method == "policy iteration by elimination" and len(found.blocks) == 2
    assert found.fill < 10 * 8000
    b = np.random.default_rng(1).random(8000)
    x = found.solve(b)
    np.testing.assert_allclose(x - matrix @ x, b, atol=1e-9)


@pytest.mark.parametrize("converges", (True, False))
def test_what_would_fill_is_swept(converges, monkeypatch):
    """And where these sweeps do not come to an end either, those of the values do."""
    monkeypatch.setattr(levels, "_ROUNDS", 0)
    monkeypatch.setattr(elimination, "_MAX_FILL", 100)
    if not converges:
        monkeypatch.setattr(elimination, "_KRYLOV_STEPS", 1)
        monkeypatch.setattr(elimination, "_SWEEPS", 10)
        monkeypatch.setattr(exact, "_MAX_BAND", 0)
        monkeypatch.setattr(exact, "_OPERATIONS", 0)
    host = rings(30, np.random.default_rng(0))
    host.probability[2:90:3] -= 0.005  # the first ring may end in the goal's rival
    host.probability[0:90:3] += 0.005
    goal = np.arange(61) == 60
    stay = np.arange(61) != 45
    found = reachability(host, goal, maximize=True, stay=stay)
    open_ = stay & ~goal
    dense = host.matrix.toarray()
    expected = np.linalg.solve(
        np.eye(60)[open_[:60]][:, open_[:60]] - dense[open_][:, open_], dense[open_][:, 60]
    )
    assert (found.lower[open_] <= expected + 1e-12).all()
    assert (found.upper[open_] >= expected - 1e-12).all()
    width = (found.upper - found.lower).max()
    assert width <= 1e-6
    assert found.method == ("policy iteration by sweeps" if converges else "value iteration")


def test_sweeps_end_where_the_solution_is_far_larger_than_the_right_side():
    rng = np.random.default_rng(0)
    size = 1000
    target = (np.arange(size)[:, None] + rng.integers(-size, size + 1, (size, 3))) % size
    weight = rng.dirichlet(np.ones(3), size)
    weight[0] /= 2  # the only way out
    matrix = sparse.csr_array(
        (weight.ravel(), target.ravel(), np.arange(0, 3 * size + 1, 3)), shape=(size, size)
    )
    found = elimination._iterative_solution(matrix, np.ones(size))
    exact = np.linalg.solve(np.eye(size) - matrix.toarray(), np.ones(size))
    assert exact.max() > 1e5
    np.testing.assert_allclose(found, exact, rtol=1e-10)


def test_elimination_without_subtractions_has_the_digits_of_its_weights():
    """Random weights down to 2^-100, so that episodes take up to 10^80 steps, against fractions."""
    rng = np.random.default_rng(3)
    for size in (1, 2, 12):
        weight = 2.0 ** -rng.integers(1, 100, (size, size)) * (rng.random((size, size)) < 0.5)
        np.fill_diagonal(weight, 0)
        leaving = np.where(rng.random(size) < 0.5, 2.0 ** -rng.integers(40, 100, size), 0)
        leaving[0], weight[1:, 0] = 2.0**-60, np.maximum(weight[1:, 0], 2.0**-100)
        b = rng.random(size)
        rows = [[Fraction(-w) for w in row] for row in weight.tolist()]
        for i, out in enumerate(leaving.tolist()):
            rows[i][i] = Fraction(out) - sum(rows[i])
        expected = exact_solve(rows, [Fraction(x) for x in b.tolist()])
        solve = exact.gth_solver(sparse.csr_array(weight), leaving)
        for x, y in zip(solve(b).tolist(), expected, strict=True):
            assert abs(Fraction(x) - y) <= Fraction(1e-13) * y
    assert exact.gth_solver(sparse.csr_array(weight), 0 * leaving) is None
