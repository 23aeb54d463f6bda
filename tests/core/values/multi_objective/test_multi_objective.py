"""Several objectives: sweeps over an explicit unfolding, laws with one objective, and Storm."""

import numpy as np
import pytest

from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.types import Status
from jaxltl.core.values.multi_objective.multi_objective import (
    Objective,
    achievable,
    constrained_optimum,
    pareto,
)
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from tests.sparse_models import random_sparse, storm_model, storm_values


def start_at(size, state=0):
    return np.eye(size)[state]


def leaking(model, rate=0.2):
    """The model with an end, which every step enters with some probability."""
    mdp, end = model.host, model.num_states
    last = mdp.entry_start[1:]
    successor = np.insert(mdp.successor, last, end)
    probability = np.insert(mdp.probability * (1 - rate), last, rate)
    start = np.append(mdp.entry_start + np.arange(model.num_rows + 1), successor.size + 1)
    return make_sparse(
        np.append(mdp.row_start, mdp.num_rows + 1),
        start,
        np.append(successor, end),
        np.append(probability, 1.0),
        initial=start_at(end + 1),
    )


def by_sweeps(model, events, rewards, weights, sweeps):
    """The largest weighted sum, by sweeps over states and what they have met.

    Args:
      events: ``(target, stay)`` each, whose probabilities count.
      rewards: ``float[R]`` each.
      weights: of the events and of the rewards, of either sign.
    """
    count = len(events)

    def entered(s, met):
        """What is met, and what that earns: 0 open, 1 met, 2 missed."""
        after, earned = list(met), 0.0
        for i, (target, stay) in enumerate(events):
            if met[i] == 0 and target[s]:
                after[i], earned = 1, earned + weights[i]
            elif met[i] == 0 and not stay[s]:
                after[i] = 2
        return tuple(after), earned

    step = sum(
        (w * r for w, r in zip(weights[count:], rewards, strict=True)), np.zeros(model.num_rows)
    )
    moves, todo = {}, [(0, entered(0, (0,) * count)[0])]
    while todo:
        state = todo.pop()
        if state in moves:
            continue
        s, met = state
        moves[state] = []
        for r in range(*model.row_start[s : s + 2]):
            ahead = []
            for e in range(*model.entry_start[r : r + 2]):
                after, earned = entered(model.successor[e], met)
                ahead.append((model.probability[e], (model.successor[e], after), earned))
                todo.append((model.successor[e], after))
            moves[state].append((step[r], ahead))
    number = {state: i for i, state in enumerate(moves)}
    rows = [
        (number[state], c + sum(p * x for p, _, x in ahead), {number[t]: p for p, t, _ in ahead})
        for state, rows in moves.items()
        for c, ahead in rows
    ]
    matrix = np.zeros((len(rows), len(number)))
    for i, (_, _, ahead) in enumerate(rows):
        for t, p in ahead.items():
            matrix[i, t] += p
    starts = np.searchsorted([s for s, _, _ in rows], range(len(number)))
    cost, value = np.array([c for _, c, _ in rows]), np.zeros(len(number))
    for _ in range(sweeps):
        value = np.maximum.reduceat(cost + matrix @ value, starts)
    return value[0] + entered(0, (0,) * count)[1]


def check_front(front, model, events, rewards, sweeps=4000, tolerance=1e-4):
    """Every point is below every half-space, and each of these is touched."""
    assert (front.lower <= front.upper).all()
    assert (front.points @ front.normals.T <= front.bounds + 1e-9).all()
    for normal, bound in zip(front.normals, front.bounds, strict=True):
        best = by_sweeps(model, events, rewards, normal, sweeps)
        assert best - 1e-9 <= bound <= best + tolerance * (1 + abs(best))


@pytest.mark.parametrize("seed", range(6))
def test_half_spaces_are_what_sweeps_find(seed):
    rng = np.random.default_rng(seed)
    model = random_sparse(rng, 6, most=2, width=2, initial=start_at(6))
    first, second, stay = (rng.random(6) < p for p in (0.3, 0.3, 0.8))
    every = np.ones(6, bool)
    found = pareto(
        model,
        [
            Objective(target=first, stay=stay),
            Objective(target=second, direction="max" if seed % 2 else "min"),
        ],
        tolerance=1e-3,
    )
    assert found.status == Status.CONVERGED and found.gap <= 1e-3
    check_front(found.front, model, [(first, stay), (second, every)], [])
    # Points of the curve do not beat one another.
    sign = np.array([1, 1 if seed % 2 else -1])
    for x in found.points:
        assert not ((found.points - x) * sign > 1e-3).all(1).any()


@pytest.mark.parametrize("seed", range(6))
def test_rewards_of_both_signs_and_probabilities(seed):
    rng = np.random.default_rng(seed)
    model = leaking(random_sparse(rng, 5, most=2, width=2))
    end = np.arange(6) == 5
    target, every = rng.random(6) < 0.3, np.ones(6, bool)
    gain, cost = (np.where(end[model.host.state], 0, rng.random(model.num_rows)) for _ in range(2))
    objectives = [
        Objective(target=target & ~end),
        Objective(reward=Rewards(choice=gain)),
        Objective(reward=Rewards(choice=cost), target=end, direction="min"),
    ]
    chosen = [[0, 1], [0, 2], [1, 2], [0, 1, 2]][seed % 4]
    found = pareto(model, [objectives[i] for i in chosen], tolerance=1e-3)
    assert found.status == Status.CONVERGED
    events = [(target & ~end, every)] if 0 in chosen else []
    rewards = [x for i, x in ((1, gain), (2, cost)) if i in chosen]
    check_front(found.front, model, events, rewards, sweeps=300)


@pytest.mark.few(4)
@pytest.mark.parametrize("seed", range(8))
def test_one_objective_is_what_its_own_solver_finds(seed):
    rng = np.random.default_rng(seed)
    model = random_sparse(
        rng,
        7,
        most=2,
        width=2,
        initial=start_at(7),
        label=rng.random((7, 2)) < 0.4,
        propositions=["a", "b"],
    )
    for formula in ("G F a", "F G b", "a U b", "G (a -> F b)"):
        for direction in ("max", "min"):
            alone = constrained_optimum(model, [Objective(formula=formula, direction=direction)])
            expected = optimal_satisfaction(model, formula, objective=direction)
            assert alone.lower - 1e-6 <= expected.value[0] <= alone.upper + 1e-6
            assert alone.status == Status.CONVERGED
    both = achievable(model, [Objective(formula="G F a"), Objective(formula="G F !b")], [1.0, 1.0])
    most = optimal_satisfaction(model, "G F a & G F !b")
    assert both.holds == (most.lower[0] == 1)
    # How often both can be had is at least the sum less one, and one alone is no more.
    share = 0.5 * float(most.lower[0])
    assert achievable(
        model, [Objective(formula="G F a"), Objective(formula="G F !b")], [share, share]
    ).holds


def test_sets_of_recurrence_that_exclude_each_other():
    """Two circles, of which one must be left for good to enter the other."""
    model = make_sparse(
        [0, 2, 4, 5],
        [0, 1, 2, 3, 4, 5],
        [0, 1, 1, 2, 2],
        np.ones(5),
        initial=start_at(3),
        label=[[1, 0, 0], [0, 1, 0], [0, 0, 1]],
        propositions=["a", "b", "c"],
    )
    objectives = [
        Objective(formula="G F a"),
        Objective(formula="G F b"),
        Objective(formula="F G c"),
    ]
    assert achievable(model, objectives, [0.25, 0.25, 0.5]).holds is True
    assert achievable(model, objectives, [0.25, 0.25, 0.51]).holds is False
    found = pareto(model, objectives)
    assert sorted(found.points.tolist()) == [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
    assert (
        achievable(model, [Objective(formula="F b"), Objective(formula="G F b")], [1.0, 1.0]).holds
        is True
    )


def test_mixtures_and_half_spaces_are_the_evidence():
    model = make_sparse(
        [0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], np.ones(4), initial=start_at(3)
    )
    a, b = (np.arange(3) == i for i in (1, 2))
    yes = achievable(model, [Objective(target=a), Objective(target=b)], [0.3, 0.7])
    assert yes.holds and (yes.share @ yes.front.lower >= [0.3, 0.7]).all()
    no = achievable(model, [Objective(target=a), Objective(target=b)], [0.4, 0.7])
    assert no.holds is False
    assert no.front.normals[no.normal] @ [0.4, 0.7] > no.front.bounds[no.normal]
    best = constrained_optimum(model, [Objective(target=a), Objective(target=b, threshold=0.25)])
    assert best.holds and best.lower <= 0.75 <= best.upper
    assert best.upper - best.lower <= 1e-6
    impossible = constrained_optimum(
        model, [Objective(target=a), Objective(target=b, threshold=1.5)]
    )
    assert impossible.holds is False and np.isnan(impossible.value)


@pytest.mark.parametrize("seed", range(4))
def test_thresholds_of_what_is_best(seed):
    rng = np.random.default_rng(seed)
    model = random_sparse(rng, 7, initial=start_at(7))
    target, other = rng.random(7) < 0.25, rng.random(7) < 0.25
    target[0] = other[0] = False
    most = reachability_probability(model, target).value[0]
    least = reachability_probability(model, other, objective="min").value[0]
    alone = constrained_optimum(
        model, [Objective(target=target), Objective(target=other, threshold=0.0)]
    )
    assert alone.lower - 1e-6 <= most <= alone.upper + 1e-6
    spared = constrained_optimum(
        model, [Objective(avoid=other), Objective(target=target, threshold=0.0)]
    )
    assert spared.lower - 1e-6 <= 1 - least <= spared.upper + 1e-6


def acyclic(rng, size, ends=3):
    rows, count = [], []
    for s in range(size):
        ahead = np.arange(s + 1, size)
        count.append(1 if s >= size - ends else 3)
        for _ in range(count[-1]):
            rows.append(
                [s]
                if s >= size - ends
                else sorted(rng.choice(ahead, min(2, ahead.size), replace=False))
            )
    start = np.concatenate([[0], np.cumsum([len(row) for row in rows])])
    probability = rng.random(start[-1]) + 0.1
    probability /= np.repeat(np.add.reduceat(probability, start[:-1]), np.diff(start))
    return make_sparse(
        np.concatenate([[0], np.cumsum(count)]),
        start,
        np.concatenate(rows),
        probability,
        initial=start_at(size),
    )


@pytest.mark.parametrize("seed", range(8))
def test_storm_finds_the_same(seed):
    """On models without circles, on which it always ends."""
    stormpy = pytest.importorskip("stormpy")
    rng = np.random.default_rng(seed)
    model = acyclic(rng, 9)
    sets = {name: (rng.random(9) < 0.3) & (np.arange(9) > 0) for name in "abc"}
    reward = np.where(np.arange(9) < 6, rng.integers(0, 3, 9), 0).astype(float)
    storm = storm_model(model, sets, {"r": Rewards(state=reward)})
    least = float(np.round(rng.random(), 2))
    questions = {
        f'multi(Pmax=? [ F "a" ], P>={least} [ F "b" ], P<=0.7 [ F "c" ])': [
            Objective(target=sets["a"]),
            Objective(target=sets["b"], threshold=least),
            Objective(target=sets["c"], direction="min", threshold=0.7),
        ],
        f'multi(R{{"r"}}min=? [ C ], P>={least} [ G !"b" ])': [
            Objective(reward=Rewards(state=reward), direction="min"),
            Objective(avoid=sets["b"], threshold=least),
        ],
        f'multi(R{{"r"}}max=? [ C ], P>={least} [ G !"b" ])': [
            Objective(reward=Rewards(state=reward)),
            Objective(avoid=sets["b"], threshold=least),
        ],
    }
    for text, objectives in questions.items():
        (question,) = stormpy.parse_properties(text)
        theirs = str(stormpy.model_checking(storm, question))
        found = constrained_optimum(model, objectives)
        assert found.status == Status.CONVERGED
        assert ("false" in theirs) == (found.holds is False), text
        if found.holds:
            assert found.lower - 1e-3 <= float(theirs) <= found.upper + 1e-3, text
    (question,) = stormpy.parse_properties('Pmax=? [ F "a" ]')
    np.testing.assert_allclose(
        constrained_optimum(model, [Objective(target=sets["a"])]).value,
        storm_values(storm, 'Pmax=? [ F "a" ]')[0],
        atol=1e-6,
    )


def arc(corners, delay=0):
    """Choices whose rewards lie on a quarter of a circle; every one is a corner of the curve.

    The choice is made after some steps; each of them is a state.
    """
    angle = np.linspace(0, np.pi / 2, corners)
    x, y = f = np.cos(angle), np.sin(angle)
    rewards = (np.concatenate([np.zeros(delay), z, [0.0]]) for z in f)
    size = delay + corners + 1
    model = make_sparse(
        np.concatenate([np.arange(delay + 1), [size - 1, size]]),
        np.arange(size + 1),
        np.concatenate([np.arange(1, delay + 1), np.full(corners + 1, delay + 1)]),
        np.ones(size),
        initial=start_at(delay + 2),
        rewards={name: Rewards(choice=z) for name, z in zip("xy", rewards, strict=True)},
    )
    return model, x, y


@pytest.mark.few(1)
@pytest.mark.parametrize("corners", (20, 1000))
def test_a_border_of_many_corners(corners):
    model, x, y = arc(corners)
    for least in (0.28, 0.7, 0.99999):
        most = np.interp(least, y, x)  # mixtures of neighbours are the border
        best = constrained_optimum(
            model, [Objective(reward="x"), Objective(reward="y", threshold=least)]
        )
        assert best.status == Status.CONVERGED
        assert best.lower - 1e-12 <= most <= best.upper + 1e-12
        assert best.upper - best.lower <= 1e-6 * best.upper
        for beyond, holds in ((-1e-10, True), (1e-10, False)):
            found = achievable(
                model, [Objective(reward="x"), Objective(reward="y")], [most + beyond, least]
            )
            assert found.holds is holds and found.nearest is None
            if holds:
                assert (found.share @ found.front.lower >= [most + beyond, least]).all()


def test_what_is_attained_nearest_to_a_border_is_told():
    model, x, y = arc(200, delay=60)  # too large for fractions
    for k in (60, 150):
        thresholds = np.array([x[k], y[k]])
        found = achievable(model, [Objective(reward="x"), Objective(reward="y")], thresholds)
        near = found.nearest
        assert found.holds is None and found.status == Status.PRECISION
        assert (near.lower <= thresholds).all() and (thresholds <= near.upper).all()
        assert (near.lower + near.gap >= thresholds - 1e-15).all() and (near.gap <= 1e-13).all()
        assert (near.share @ found.front.points >= thresholds - 1e-12).all()
    # All that can be had of y, and the most of x beside it, which is none.
    best = constrained_optimum(model, [Objective(reward="x"), Objective(reward="y", threshold=1.0)])
    assert best.holds is None and best.status == Status.PRECISION
    assert best.upper <= 1e-6 and best.value <= best.upper
    assert best.nearest.gap.tolist() == [0, pytest.approx(0, abs=1e-13)]
    assert best.nearest.lower[1] <= 1 <= best.nearest.upper[1]


@pytest.mark.slow
def test_all_corners_are_found():
    model, x, y = arc(16)
    found = pareto(model, [Objective(reward="x"), Objective(reward="y")], tolerance=1e-6)
    assert found.status == Status.CONVERGED and found.gap <= 1e-6
    np.testing.assert_allclose(found.points, np.stack([x, y], 1)[::-1], atol=1e-9)
    few = pareto(
        model, [Objective(reward="x"), Objective(reward="y")], tolerance=1e-6, max_points=12
    )
    assert few.status == Status.MAX_STEPS and 1e-6 < few.gap < 0.01


def test_what_is_wrong_is_named():
    model = make_sparse(
        [0, 2, 3],
        [0, 1, 2, 3],
        [0, 1, 1],
        np.ones(3),
        initial=[1, 0],
        rewards={"r": Rewards(choice=[1.0, 0, 0])},
    )
    end = np.array([False, True])
    with pytest.raises(ValueError, match="objective 1: give one of"):
        pareto(model, [Objective()])
    with pytest.raises(ValueError, match="objective 1: give one of"):
        pareto(model, [Objective(formula="F a", avoid=end)])
    with pytest.raises(ValueError, match="direction='most'"):
        pareto(model, [Objective(target=end, direction="most")])
    with pytest.raises(ValueError, match="objective 2 is infinite"):
        pareto(model, [Objective(target=end), Objective(reward="r")])
    with pytest.raises(ValueError, match="under every policy"):
        pareto(model, [Objective(reward=[1.0, 1.0, 1.0], direction="min"), Objective(target=end)])
    with pytest.raises(ValueError, match="rewards of at least 0"):
        pareto(model, [Objective(reward=[-1.0, 0, 0]), Objective(target=end)])
    with pytest.raises(ValueError, match="give one finite number for each"):
        achievable(model, [Objective(target=end), Objective(avoid=end)])
    with pytest.raises(ValueError, match="to all but one"):
        constrained_optimum(
            model,
            [Objective(target=end), Objective(avoid=end), Objective(avoid=end, threshold=0.5)],
        )
    least = constrained_optimum(model, [Objective(reward="r", direction="min", target=end)])
    assert least.lower == least.upper == 0
