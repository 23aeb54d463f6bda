"""Nature within a ball beside ends: against linear programs, and all vertices by brute force."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog

from jaxltl.core.models.interval import interval_rows
from jaxltl.core.sparse.bounded.row_game import RowGame
from jaxltl.core.sparse.bounded.step_bounded import until
from jaxltl.core.sparse.graph.accepting import accepting_region
from jaxltl.core.sparse.interval import reachability as interval_values
from jaxltl.core.sparse.interval.discounted import DiscountedModel, discounted_value
from jaxltl.core.sparse.interval.parity import optimal_face, parity_against_nature
from jaxltl.core.sparse.interval.qualitative import zero_one_states
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.total_reward import total_reward
from jaxltl.core.sparse.solvers.reachability import reachability
from jaxltl.core.values.interval.satisfaction import _largest
from tests.core.sparse.interval.test_reachability import enclosed
from tests.reference_intervals import (
    ball_vertices,
    chains,
    optima,
    parity,
    random_model,
    reach,
    reward,
    with_ball,
)

COUNTS = [10, pytest.param(1000, marks=pytest.mark.exhaustive)]
DIRECTIONS = list(itertools.product((True, False), repeat=2))


def free_model(rng):
    """With up to four successors, and ends 0 and 1: the ball alone decides."""
    found = random_model(rng, width=4)
    return replace(found, lower=0 * found.lower, upper=0 * found.upper + 1)


def some_model(rng, i):
    """Now and then with four successors, of which a ball leaves less than its intervals do."""
    return random_model(rng, most_rows=1, width=4) if i % 20 == 0 else random_model(rng)


def within_ball(model, p):
    """These are distributions of the model."""
    center, most = model.ball.center, model.ball.gain
    np.testing.assert_allclose(model.sum_rows(p), 1, rtol=1e-13)
    assert ((model.lower - 1e-13 <= p) & (p <= model.upper + 1e-13)).all()
    assert (model.sum_rows(np.abs(p - center)) <= 2 * most + 1e-13).all()


def wide(rng, most):
    """Rows of up to so many successors in one state each, with loose and tight ends and radii."""
    width = rng.integers(1, most + 1, 12)
    start = np.concatenate([[0], width.cumsum()])
    successor = np.concatenate([np.sort(rng.choice(most, k, replace=False)) for k in width])
    center = np.concatenate([rng.dirichlet(np.full(k, 0.3)) for k in width])
    low, high = (rng.uniform(0, 0.3, start[-1]) * (rng.random(start[-1]) < 0.7) for _ in range(2))
    states = max(most, 12)
    row_start = np.concatenate([np.arange(12), np.full(states - 12, 12) + np.arange(states - 12)])
    more = np.arange(12, states)
    return interval_rows(
        np.append(row_start, states),
        np.append(start, start[-1] + 1 + np.arange(more.size)),
        np.append(successor, more),
        np.append(np.maximum(center - low, 0), more > 0),
        np.append(np.minimum(center + high, 1), more > 0),
        center=np.append(center, more > 0),
        radius=np.append(rng.choice([0, 0.05, 0.2, 0.6, 2.0], 12), np.zeros(more.size)),
    ).host


@pytest.mark.parametrize("most", [3, 8, 60])
def test_nature_is_extreme(most):
    """Against the linear program of a ball between ends."""
    rng = np.random.default_rng(most)
    model = wide(rng, most)
    quantity = np.round(rng.normal(size=model.lower.size), 1)  # with ties
    for maximize, sign in ((True, -1), (False, 1)):
        p = model.extreme_distributions(quantity, maximize=maximize)
        within_ball(model, p)
        for r in range(12):
            of = slice(model.mdp.entry_start[r], model.mdp.entry_start[r + 1])
            center, k = model.ball.center[of], of.stop - of.start
            one, none = np.eye(k), np.zeros(k)
            best = linprog(
                sign * np.append(quantity[of], none),
                A_ub=np.block([[one, -one], [-one, -one], [none[None], none[None] + 1]]),
                b_ub=np.concatenate([center, -center, [2 * model.ball.gain[r]]]),
                A_eq=np.append(none + 1, none)[None],
                b_eq=[1],
                bounds=[*zip(model.lower[of], model.upper[of], strict=True), *[(0, None)] * k],
            )
            assert best.status == 0
            assert abs(sign * best.fun - (p * quantity)[of].sum()) < 1e-7


@pytest.mark.parametrize("count", COUNTS)
def test_supports(count):
    """To which successors nature may keep, with all of them, and what must be entered."""
    rng = np.random.default_rng(0)
    for _ in range(count):
        model = with_ball(rng, free_model(rng))
        mdp = model.mdp
        entries = rng.random(mdp.num_transitions) < 0.6
        region = rng.random(4) < 0.5
        may, p = model.can_stay_on(entries), model.interior_distributions(entries)
        must = model.must_enter(np.arange(mdp.num_rows), region)
        within_ball(model, p)
        for r in range(mdp.num_rows):
            of = slice(mdp.entry_start[r], mdp.entry_start[r + 1])
            corners = np.array(
                ball_vertices(
                    model.lower[of], model.upper[of], model.ball.center[of], 2 * model.ball.gain[r]
                )
            )
            keeps = (corners[:, ~entries[of]] == 0).all(1)
            assert may[r] == keeps.any()
            if may[r]:
                np.testing.assert_array_equal(p[of] > 0, entries[of])
            enters = (corners * region[mdp.successor[of]]).sum(1) > 0
            assert must[r] == enters.all()


@pytest.mark.parametrize("count", COUNTS)
def test_faces(count):
    """All best distributions by rank, by what they may keep to."""
    rng = np.random.default_rng(1)
    for _ in range(2 * count):
        model = with_ball(rng, free_model(rng))
        mdp = model.mdp
        rank, entries = rng.integers(0, 2 + rng.integers(2), (2, mdp.num_transitions))
        face = optimal_face(model, rank)
        entries = entries > 0
        may, p = face.can_stay_on(entries), face.interior_distributions(entries)
        within_ball(model, p)
        best = model.sum_rows(model.extreme_distributions(rank * 1.0, maximize=False) * rank)
        np.testing.assert_allclose(model.sum_rows(p * rank), best, atol=1e-12)
        for r in range(mdp.num_rows):
            of = slice(mdp.entry_start[r], mdp.entry_start[r + 1])
            corners = np.array(
                ball_vertices(
                    model.lower[of], model.upper[of], model.ball.center[of], 2 * model.ball.gain[r]
                )
            )
            corners = corners[np.abs(corners @ rank[of] - best[r]) < 1e-9]
            keeps = (corners[:, ~entries[of]] == 0).all(1)
            assert may[r] == keeps.any()
            if may[r]:
                some = (corners[keeps] > 0).any(0)
                np.testing.assert_array_equal(p[of] > 0, some)


@pytest.mark.parametrize("count", COUNTS)
def test_probabilities_and_rewards(count):
    rng = np.random.default_rng(2)
    for i in range(count):
        model = with_ball(rng, some_model(rng, i))
        goal = np.arange(4) == rng.integers(4)
        cost = rng.integers(0, 3, model.mdp.num_rows).astype(float)
        every = list(chains(model, goal))
        earned = optima([reward(p, goal, cost[list(rows)]) for rows, p in every])
        for (maximize, large), value in optima([reach(p, goal) for _, p in every]).items():
            found = interval_values.reachability(model, goal, Query(maximize, large))
            enclosed(found, value)
            p = found.probability
            within_ball(model, p)
            part, entry = model.under_policy(found.row)
            alone = (
                reachability(part.resolve(p[entry]), goal, maximize=True)
                if maximize == large
                else reachability(model.resolve(p), goal, maximize=maximize)
            )
            np.testing.assert_allclose(alone.value, value, atol=1e-6)
            halted, _ = model.with_absorbing(goal)
            sure = zero_one_states(halted, goal, Query(maximize, large))
            np.testing.assert_array_equal(sure.zero, value < 1e-12)
            np.testing.assert_array_equal(sure.one, value > 1 - 1e-12)
            found = total_reward(model, cost, goal, Query(maximize, large))
            enclosed(found, earned[maximize, large])
            within_ball(model, found.probability)


@pytest.mark.slow
@pytest.mark.parametrize("count", COUNTS)
def test_parity(count):
    rng = np.random.default_rng(3)
    for i in range(count):
        model = with_ball(rng, some_model(rng, i))
        priority = rng.integers(0, rng.integers(2, 5), 4)
        values = optima([parity(p, priority) for _, p in chains(model, np.zeros(4, bool))])
        for (maximize, helpful), value in values.items():
            if maximize:
                found = _largest(model, priority, Query(True, helpful, 1e-6))
                enclosed(found, value)
            else:
                found = _largest(model, priority + 1, Query(True, not helpful, 1e-6))
                enclosed(found, 1 - value)
            within_ball(model, found.probability)
        found = parity_against_nature(model, priority)
        mdp = model.resolve(found.probability)
        region = accepting_region(mdp, priority[mdp.state[mdp.row]]).region
        best = reachability(mdp, region, maximize=True)
        np.testing.assert_allclose(best.value, found.value, atol=1e-6)


@pytest.mark.slow
def test_discounted_and_steps():
    """Values satisfy their equation over all vertices."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        model = with_ball(rng, random_model(rng))
        mdp = model.mdp
        goal = np.arange(4) == rng.integers(4)
        gain = rng.normal(size=mdp.num_transitions)
        rate = np.full(mdp.num_rows, 0.9)
        for maximize, large in DIRECTIONS:
            found = discounted_value(
                DiscountedModel(model, gain, rate), Query(maximize, large, tolerance=1e-9)
            )
            assert (found.upper - found.lower <= 1e-9).all()
            ahead = gain + 0.9 * found.value[mdp.successor]
            np.testing.assert_allclose(
                backup(model, ahead, maximize, large), found.value, atol=1e-8
            )
            value = goal * 1.0
            for _ in range(3):
                value = np.where(goal, 1, backup(model, value[mdp.successor], maximize, large))
            rows = RowGame(mdp, np.full(4, maximize), model, large)
            steps = until(rows, goal, ~goal, 3)
            assert (np.abs(steps.value - value) <= steps.error + 1e-15).all()
            np.testing.assert_array_equal(steps.value > 0, value > 0)


def backup(model, ahead, maximize, large):
    """One step to the best vertices."""
    mdp, worth = model.mdp, []
    for r in range(mdp.num_rows):
        of = slice(mdp.entry_start[r], mdp.entry_start[r + 1])
        each = np.array(
            ball_vertices(
                model.lower[of], model.upper[of], model.ball.center[of], 2 * model.ball.gain[r]
            )
        )
        worth.append((max if large else min)(each @ ahead[of]))
    return mdp.over_choices(np.maximum if maximize else np.minimum, np.array(worth))
