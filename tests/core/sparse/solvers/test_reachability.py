"""Certified optima on sparse rows against all memoryless policies, by exact fractions."""

import itertools
from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.sparse import contraction as contract
from jaxltl.core.sparse.linear import elimination
from jaxltl.core.sparse.linear import topological_order as levels
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers import policy_iteration as transient
from jaxltl.core.sparse.solvers.reachability import reachability, total_reward
from jaxltl.core.sparse.solvers.shortest_path_problem import RelativeTolerance


def random_model(rng, num_states, most_choices=3):
    """Probabilities that are eighths, so that fractions are exact; chains, loops and components."""
    row_start, entry_start, successor, probability = [0], [0], [], []
    sink = num_states - 1 if rng.random() < 0.7 else -1
    for s in range(num_states):
        for _ in range(int(rng.integers(1, most_choices + 1)) if s != sink else 1):
            width = int(rng.integers(1, 4)) if rng.random() < 0.6 else 1
            near = rng.random() < 0.7
            pool = range(max(0, s - 2), min(num_states, s + 3)) if near else range(num_states)
            pool, width = ([s], 1) if s == sink else (pool, width)
            targets = rng.choice(list(pool), size=min(width, len(list(pool))), replace=False)
            weights = {1: [8], 2: [3, 5], 3: [1, 2, 5]}[len(targets)]
            successor += targets.tolist()
            probability += [w / 8 for w in weights]
            entry_start.append(len(successor))
        row_start.append(len(entry_start) - 1)
    return make_sparse(row_start, entry_start, successor, probability)


def solved(host: HostMDP, row, fixed, known, cost):
    """``x = c + P x`` of a policy by exact elimination; infinite where it may never get out."""
    size = host.num_states
    edges = [set() for _ in range(size)]
    for s in range(size):
        if not fixed[s]:
            r = row[s]
            edges[s] = set(host.successor[host.entry_start[r] : host.entry_start[r + 1]].tolist())
    gets_out = set(np.flatnonzero(fixed).tolist())
    while True:
        more = {s for s in range(size) if s not in gets_out and edges[s] & gets_out}
        if not more:
            break
        gets_out |= more
    stuck = {s for s in range(size) if s not in gets_out}
    while True:  # who may get stuck
        more = {s for s in range(size) if s not in stuck and not fixed[s] and edges[s] & stuck}
        if not more:
            break
        stuck |= more
    open_ = [s for s in range(size) if not fixed[s] and s not in stuck]
    place = {s: i for i, s in enumerate(open_)}
    rows = []
    for s in open_:
        line = [Fraction(0)] * (len(open_) + 1)
        line[place[s]] += 1
        line[-1] += Fraction(float(cost[row[s]]))
        for e in range(host.entry_start[row[s]], host.entry_start[row[s] + 1]):
            t, p = int(host.successor[e]), Fraction(float(host.probability[e]))
            if fixed[t]:
                line[-1] += p * Fraction(float(known[t]))
            else:
                line[place[t]] -= p
        total = sum(Fraction(float(p)) for p in host.probability[host.row == row[s]])
        if total != 1:
            line = [x + (total - 1) * (i == place[s]) for i, x in enumerate(line)]
        rows.append(line)
    for i in range(len(rows)):
        j = next(j for j in range(i, len(rows)) if rows[j][i])
        rows[i], rows[j] = rows[j], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for k in range(len(rows)):
            if k != i and rows[k][i]:
                rows[k] = [a - rows[k][i] * b for a, b in zip(rows[k], rows[i], strict=True)]
    value = [Fraction(float(known[s])) if fixed[s] else None for s in range(size)]
    for s in open_:
        value[s] = rows[place[s]][-1]
    return value


def policies(host):
    spans = [range(host.row_start[s], host.row_start[s + 1]) for s in range(host.num_states)]
    return itertools.product(*spans)


def probability_of(host, row, target, stay):
    """Of reaching the target: states that cannot get there are taken out first."""
    size = host.num_states
    fixed = target | ~stay
    can = target.copy()
    for _ in range(size):
        for s in range(size):
            r = row[s]
            after = host.successor[host.entry_start[r] : host.entry_start[r + 1]]
            can[s] |= not fixed[s] and can[after].any()
    return solved(host, row, fixed | ~can, target.astype(float), np.zeros(host.num_rows))


def encloses(found, best, *, maximize):
    for s, exact in enumerate(best):
        if exact is None:
            assert found.lower[s] == found.upper[s] == np.inf
            continue
        assert Fraction(float(found.lower[s])) <= exact <= Fraction(float(found.upper[s]))
        if exact in (0, 1) and not (found.upper > 1).any():
            assert found.lower[s] == found.upper[s] == exact


def best_of(values, *, maximize):
    """State by state; None is infinite."""
    columns = zip(*values, strict=True)
    if maximize:
        return [None if any(x is None for x in c) else max(c) for c in columns]
    return [min((x for x in c if x is not None), default=None) for c in columns]


WAYS = [
    "as it is",
    "in the core",
    "by value iteration",
    "by sweeps",
    "contracted",
    "refined",
    "eliminated at last",
    "by ordered sweeps",
]


@pytest.fixture(params=WAYS)
def way(request, monkeypatch):
    """Each way through the solver, which size and shape choose."""
    if request.param != "as it is":
        monkeypatch.setattr(contract, "_WORTH", 10**6)
    if request.param not in ("as it is", "contracted"):
        monkeypatch.setattr(levels, "_ROUNDS", 0)
        monkeypatch.setattr(levels, "_NODES", 10**9)
    if request.param in ("by sweeps", "eliminated at last"):
        monkeypatch.setattr(elimination, "_SMALL", 0)
        monkeypatch.setattr(elimination, "_MIN_STATES_PER_BANDWIDTH", 10**9)
    if request.param == "by value iteration":
        monkeypatch.setattr(transient, "_LARGE_CORE", 0)
    if request.param == "eliminated at last":
        monkeypatch.setattr(
            elimination, "_iterative_solution", lambda _, b: np.full(b.size, np.nan)
        )
    if request.param == "by ordered sweeps":
        monkeypatch.setattr(transient._CoreSolver, "_iterate", lambda *_: (None, 0))
        for name in (
            "_by_refinement",
            "_by_converged_sweeps",
            "_by_gth_refinement",
            "_by_fractions",
        ):
            monkeypatch.setattr(transient._CoreSolver, name, lambda *_: None)
    if request.param == "refined":
        monkeypatch.setattr(transient._CoreSolver, "_certified", lambda *_: None)
    return request.param


def cases(count, seed=0, most_choices=3):
    rng = np.random.default_rng(seed)
    made = 0
    while made < count:
        model = random_model(rng, int(rng.integers(3, 17 - 3 * most_choices)), most_choices)
        host = model.host
        if np.diff(host.row_start).prod() > 60:
            continue
        made += 1
        target = np.zeros(host.num_states, bool)
        target[rng.integers(host.num_states)] = True
        stay = rng.random(host.num_states) < 0.9
        yield rng, host, target, stay


def probabilities(host, target, stay):
    return [probability_of(host, row, target, stay) for row in policies(host)]


def rewards(host, target, cost):
    nothing = np.zeros(host.num_states)
    return [solved(host, row, target, nothing, cost) for row in policies(host)]


def attained(found, values, *, maximize):
    """The policy's own value is no worse than the bound on the safe side."""
    for s, exact in enumerate(values):
        if maximize:
            assert exact is None or exact >= Fraction(float(found.lower[s]))
        elif np.isfinite(found.upper[s]):
            assert exact is not None and exact <= Fraction(float(found.upper[s]))


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("maximize", [True, False])
def test_probabilities(maximize):
    hard = 0
    for _, host, target, stay in cases(18):
        found = reachability(host, target, maximize=maximize, stay=stay)
        best = best_of(probabilities(host, target, stay), maximize=maximize)
        encloses(found, best, maximize=maximize)
        assert worst_width(found, relative=False) <= 1e-6
        attained(found, probability_of(host, found.row, target, stay), maximize=maximize)
        hard += any(0 < x < 1 for x in best)
    assert hard >= 3


@pytest.mark.parametrize("maximize", [True, False])
def test_small_probabilities_to_a_relative_width(way, maximize):
    """Among them episodes that are all but endless; products from 1e-300 to 1."""
    small = 0
    for rng, host, target, stay in cases(20, seed=3, most_choices=2):
        stay[rng.integers(host.num_states, size=2)] = False
        scale = rng.choice([0, 8, 40, 80, 250], host.num_transitions, p=[0.3, 0.2, 0.2, 0.2, 0.1])
        weight, first = np.ldexp(host.probability, -scale), host.entry_start[:-1]
        likely = first + rng.integers(6, size=host.num_rows) % np.diff(host.entry_start)
        weight[likely] += 1 - np.add.reduceat(weight, first)
        host = HostMDP(host.row_start, host.entry_start, host.successor, weight)
        found = reachability(
            host, target, maximize=maximize, stay=stay, tolerance=RelativeTolerance(1e-6)
        )
        best = best_of(probabilities(host, target, stay), maximize=maximize)
        encloses(found, best, maximize=maximize)
        certain = found.lower > 1e-280
        if way == "eliminated at last":
            certain &= found.upper - found.lower < 0.1  # without fractions, some are not solved
        else:
            assert certain[[x > 1e-279 for x in best]].all()
        assert (found.upper - found.lower <= 1e-6 * found.lower)[certain].all()
        attained(found, probability_of(host, found.row, target, stay), maximize=maximize)
        small += sum(0 < x < 1e-9 for x in best)
    assert small >= 2


@pytest.mark.usefixtures("way")
@pytest.mark.parametrize("maximize", [True, False])
def test_total_rewards(maximize):
    hard = 0
    for rng, host, target, _ in cases(15, seed=1):
        target[-1] = True  # so that more of it is finite
        cost = rng.integers(0, 4, host.num_rows) * (rng.random(host.num_rows) < 0.7) / 4
        found = total_reward(host, cost, target, maximize=maximize)
        best = best_of(rewards(host, target, cost), maximize=maximize)
        encloses(found, best, maximize=maximize)
        assert worst_width(found, relative=True) <= 1e-6
        nothing = np.zeros(host.num_states)
        attained(found, solved(host, found.row, target, nothing, cost), maximize=maximize)
        hard += any(x is not None and x > 0 for x in best)
    assert hard > 5


def tug(length, chance):
    """A run is thrown back to the middle by every other step (Haddad and Monmege 2018)."""
    row_start, entry_start, successor, probability = [0], [0], [], []

    def choice(*entries):
        for target, p in entries:
            successor.append(target)
            probability.append(p)
        entry_start.append(len(successor))

    for x in range(2 * length + 1):
        if x in (0, 2 * length):
            choice((x, 1.0))
        elif x == length:
            choice((x - 1, chance), (x + 1, 1 - chance))
            choice((x - 1, chance / 2), (x + 1, 1 - chance / 2))
        else:
            choice((x - 1 if x < length else x + 1, 0.5), (length, 0.5))
        row_start.append(len(entry_start) - 1)
    return make_sparse(row_start, entry_start, successor, probability).host


@pytest.mark.few(3)
@pytest.mark.parametrize("length", [4, 20, 40, 120])
def test_runs_that_hardly_ever_end(length):
    """The probability is the chance, whatever the length; runs take 2^length steps."""
    host = tug(length, 0.75)
    goal = np.zeros(host.num_states, bool)
    goal[0] = True
    for maximize, value in ((True, Fraction(3, 4)), (False, Fraction(3, 8))):
        found = reachability(host, goal, maximize=maximize)
        assert found.lower[length] <= value <= found.upper[length]
        assert worst_width(found, relative=False) <= 1e-6
    goal[-1] = True
    found = total_reward(host, np.ones(host.num_rows), goal, maximize=True)
    steps = 3 * 2 ** (length - 1) - 2
    assert Fraction(found.lower[length]) <= steps <= Fraction(found.upper[length])
    assert worst_width(found, relative=True) <= 1e-6


def chain_of_rows(rows):
    """A chain from lists of successors and probabilities."""
    starts = np.concatenate([[0], np.cumsum([len(t) for t, _ in rows])])
    return make_sparse(
        None, starts, np.concatenate([t for t, _ in rows]), np.concatenate([p for _, p in rows])
    ).host


@pytest.mark.parametrize("back", [None, 0, 1], ids=["straight on", "with a loop", "by a circle"])
def test_sums_of_many_terms_are_rounded_outwards(back):
    """The enclosure is of the numbers as they stand, though a sum of floats loses most of them."""
    width = 20_000
    ends = np.arange(2, 4 + width)
    share = np.full(ends.size, 2.5e-17)  # less than half of what can be added to a half
    share[0], share[-1] = 0.5, 0.5
    if back is not None:
        ends, share = np.append(back, ends), np.append(0.5, share / 2)
    rows = [(ends, share), ([0], [1.0]), *(([t], [1.0]) for t in range(2, 4 + width))]
    host = chain_of_rows(rows)
    target = np.zeros(host.num_states, bool)
    target[2:-1] = True
    found = reachability(host, target, maximize=True)
    weight = [Fraction(float(p)) for p in host.probability[host.row == 0]]
    goes = list(zip(weight, host.successor[host.row == 0].tolist(), strict=True))
    hit, left = (sum(w for w, t in goes if t >= 2 and (target[t] or which)) for which in (0, 1))
    assert Fraction(float(found.lower[0])) <= hit / left <= Fraction(float(found.upper[0]))
    assert found.upper[0] - found.lower[0] <= 1e-6


def worst_width(found, *, relative):
    """The width of the widest enclosure, relative to the value if `relative`."""
    low, high = found.lower, found.upper
    finite = np.isfinite(high)
    width = np.where(finite, high - np.where(finite, low, 0), np.where(low == high, 0, np.inf))
    if relative:
        width = np.where(width > 0, width / np.maximum(np.where(finite, high, 1), 1e-300), 0)
    return float(width.max(initial=0))
