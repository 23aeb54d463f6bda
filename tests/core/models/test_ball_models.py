"""Models in which nature stays near a center: built, changed, written, solved."""

import itertools

import numpy as np
import pytest

from jaxltl.core.models.construct.restrict import restrict, with_allowed
from jaxltl.core.models.game import make_game
from jaxltl.core.models.interval import interval_rows, make_interval
from jaxltl.core.models.mdp import from_dense
from jaxltl.core.models.product import product
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.statistics.confidence_sets import intervals_from_counts
from jaxltl.core.values.discounted.discounted import optimal_value
from jaxltl.core.values.evaluation.data_guarantee import learn_guarantee
from jaxltl.core.values.interval.robust import robust_expectation
from jaxltl.core.values.interval.sensitivity import robust_sensitivity
from jaxltl.core.values.prepared.preparation import prepare
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)
from jaxltl.io.model_files import read_model, write_model
from tests.core.sparse.interval.test_balls import within_ball
from tests.core.values.evaluation.test_data_guarantee import drawn, labelled
from tests.support import nature_word

TASKS = ["F a", "!b U a", "G F a", "F G a | F b", "G !b"]
DIRECTIONS = list(itertools.product(("max", "min"), repeat=2))


def three():
    """A choice among three ends, of which the last was hardly seen."""
    return make_sparse(
        None,
        [0, 3, 4, 5, 6],
        [1, 2, 3, 1, 2, 3],
        [0.5, 0.4, 0.1, 1, 1, 1],
        initial=[1, 0, 0, 0],
        label=[[0, 0], [1, 0], [0, 0], [0, 1]],
        propositions=["a", "b"],
    )


def around(model, radius):
    every = np.ones(model.num_transitions)
    return make_interval(
        model,
        0 * every,
        every,
        center=model.probability,
        radius=np.append(radius, np.zeros(model.num_rows - 1)),
    )


def test_half_of_the_radius_moves():
    """From the worst end to the best, and no more than is there."""
    for radius, least, most in ((0.0, 0.5, 0.5), (0.2, 0.4, 0.6), (1.2, 0.0, 1.0), (2.0, 0, 1)):
        model = around(three(), radius)
        for nature, value in (("min", least), ("max", most)):
            found = reachability_probability(model, "a", nature=nature_word("max", nature))
            assert found.value[0] == pytest.approx(value, abs=1e-15)
            assert found.lower[0] <= value <= found.upper[0]
            within_ball(model.host, found.nature)
    ahead = np.array([0.0, 1.0, 0.9, 0.0])
    model = around(three(), 0.4)
    assert robust_expectation(model, ahead, nature="adversarial")[0][0] == pytest.approx(0.86 - 0.2)
    model = make_interval(  # an end that may gain little leaves the rest to the next
        three(),
        np.zeros(6),
        [1, 1, 0.15, 1, 1, 1],
        center=three().probability,
        radius=[0.4, 0, 0, 0],
    )
    least = 0.86 - 0.05 * 1 - 0.15 * 0.1
    assert robust_expectation(model, ahead, nature="adversarial")[0][0] == pytest.approx(least)


def test_in_its_box_more_is_possible():
    """With four successors two may gain and two may lose as much as one of them may."""
    model = interval_rows(
        None,
        [0, 4, 5, 6, 7],
        [0, 1, 2, 3, 1, 2, 3],
        [0] * 4 + [1] * 3,
        np.ones(7),
        center=[0.25, 0.25, 0.25, 0.25, 1, 1, 1],
        radius=[0.2, 0, 0, 0],
    )
    ahead = np.array([1.0, 1.0, 0.0, 0.0])
    assert robust_expectation(model, ahead, nature="cooperative")[0][0] == pytest.approx(0.6)
    assert robust_expectation(model.box, ahead, nature="cooperative")[0][0] == pytest.approx(0.7)


def test_what_a_radius_removes():
    """An end may go only if the ball reaches so far."""
    for radius, zero in ((0.19, False), (0.2, True), (0.21, True)):
        model = around(three(), radius)
        found = reachability_probability(model, "b", nature="adversarial")
        assert (found.upper[0] == 0) == zero
        # Who is not known to be left out is entered sooner or later.
        again = interval_rows(
            None,
            [0, 3, 4, 5],
            [0, 1, 2, 1, 2],
            [0, 0, 0, 1, 1],
            np.ones(5),
            center=[0.5, 0.4, 0.1, 1, 1],
            radius=[radius + 0.8, 0, 0],
        )
        least = reachability_probability(again, [False, True, True], nature="adversarial")
        assert least.lower[0] == (0 if zero else 1)
    never = around(three().replace(probability=np.array([0.5, 0.5, 0, 1, 1, 1])), 0.0)
    assert never.num_transitions == 5  # what can get nothing is left out


def test_a_full_radius_is_a_box():
    rng = np.random.default_rng(0)
    for task in TASKS:
        model = labelled(rng)
        p = model.probability
        low, high = np.maximum(p - 0.2, 0), np.minimum(p + 0.1, 1)
        box = make_interval(model, low, high)
        ball = make_interval(model, low, high, center=p, radius=np.full(model.num_rows, 2.0))
        for objective, nature in DIRECTIONS:
            one, other = (
                optimal_satisfaction(
                    x, task, objective=objective, nature=nature_word(objective, nature)
                )
                for x in (box, ball)
            )
            np.testing.assert_allclose(one.value, other.value, atol=1e-9)


def test_products_policies_and_games():
    """What a product, a policy of weights and a game say is what the formula alone says."""
    rng = np.random.default_rng(1)
    for task in TASKS:
        model = labelled(rng)
        ball = intervals_from_counts(
            drawn(rng, model, 30), 0.9, method="weissman", entry_start=model.entry_start
        )
        world = make_interval(model, ball.lower, ball.upper, center=ball.center, radius=ball.radius)
        for nature in ("min", "max"):
            found = optimal_satisfaction(world, task, nature=nature_word("max", nature))
            assert found.status == 0
            both = product(world, found.product_policy.automaton)
            whole = optimal_satisfaction(both, nature=nature_word("max", nature))
            start = found.product_policy.product.start[0]
            place = (
                found.product_policy.product.base_state[start],
                found.product_policy.product.memory[start],
            )
            assert whole.value[place] == pytest.approx(found.value[start], abs=2e-6)
            assert whole.nature.shape == (world.num_transitions * both.num_memory,)
            own = satisfaction_probability(both, whole.policy, nature=nature_word("max", nature))
            np.testing.assert_allclose(own.value, whole.value, atol=3e-6)
            per = np.diff(world.nominal.row_start)[world.nominal.host.state]
            share = np.tile(1 / per[:, None], both.num_memory)
            mixed = satisfaction_probability(both, share, nature=nature_word("max", nature))
            assert (mixed.lower <= whole.upper).all()
        system = rng.random(world.num_states) < 0.5
        game = reachability_probability(make_game(world, system), "a")
        free = reachability_probability(world, "a", nature="adversarial")
        assert (game.lower <= free.upper).all()
        within_ball(world.host, game.nature)


def test_restricted_and_written(tmp_path):
    rng = np.random.default_rng(2)
    model = labelled(rng)
    sets = intervals_from_counts(
        drawn(rng, model, 30), 0.9, method="weissman", entry_start=model.entry_start
    )
    world = make_interval(model, sets.lower, sets.upper, center=sets.center, radius=sets.radius)
    write_model(tmp_path / "world.npz", world)
    same = read_model(tmp_path / "world.npz")
    for name in ("lower", "upper", "center", "radius"):
        np.testing.assert_array_equal(getattr(same, name), getattr(world, name))
    for name in ("world.umb", "world.drn", "world.tra"):
        with pytest.raises(ValueError, match=r"the model has a radius, .* model.box"):
            write_model(tmp_path / name, world)
    first = np.isin(np.arange(world.num_rows), np.asarray(world.nominal.row_start)[:-1])
    few = with_allowed(world, first)
    np.testing.assert_array_equal(few.radius, world.radius[first])
    policy = np.zeros(world.num_states, np.int32)
    alone = reachability_probability(world, "a", policy=policy, nature="adversarial")
    kept = reachability_probability(few, "a", nature="adversarial")
    np.testing.assert_allclose(kept.value, alone.value, atol=1e-9)
    part = restrict(world)
    near = reachability_probability(part.model, "a", nature="adversarial").value
    far = reachability_probability(world, "a", nature="adversarial").value
    np.testing.assert_allclose(near, far[np.asarray(part.base_state)], atol=1e-9)
    for solve in (
        lambda: prepare(world, "a"),
        lambda: robust_sensitivity(world, kept, "a", nature="adversarial"),
    ):
        with pytest.raises(ValueError, match=r"the model has a radius, .* model.box"):
            solve()


def test_padded_models_and_successors_that_repeat():
    mdp = from_dense([[[0.0, 0.6, 0.4]], [[0, 1, 0]], [[0, 0, 1]]])
    size = np.shape(mdp.probability)
    model = make_interval(
        mdp,
        np.zeros(size),
        np.asarray(mdp.probability) > 0,
        center=mdp.probability,
        radius=[[0.2], [0], [0]],
    )
    goal = [False, True, False]
    assert reachability_probability(model, goal, nature="adversarial").value[0] == pytest.approx(
        0.5
    )
    twice = interval_rows(
        None,
        [0, 3, 4, 5],
        [1, 1, 2, 1, 2],
        [0, 0, 0, 1, 1],
        [1, 1, 1, 1, 1],
        center=[0.2, 0.4, 0.4, 1, 1],
        radius=[0.2, 0, 0],
    )
    assert twice.num_transitions == 4
    assert reachability_probability(twice, goal, nature="adversarial").value[0] == pytest.approx(
        0.5
    )
    gain = optimal_value(twice, [0.0, 1.0, 0.0], 0.5)
    assert gain.value[0] == pytest.approx(0.5 * 0.5 * 2)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radius": None}, "center is given alone"),
        ({"center": None}, "radius is given alone"),
        ({"radius": [0.1]}, r"radius \(1,\); expected \(6,\) and \(4,\)"),
        ({"center": [0.5, 0.5]}, r"center has shape \(2,\); expected \(6,\)"),
        ({"radius": [0, 0, -0.1, 0]}, r"state 2, choice 0: the radius is -0.1"),
        ({"radius": [np.nan, 0, 0, 0]}, r"state 0, choice 0: the radius is nan"),
        ({"center": [0.5, 0.4, 0.2, 1, 1, 1]}, r"state 0, choice 0: the center sums to 1.1"),
        (
            {"center": [0.3, 0.6, 0.1, 1, 1, 1]},
            r"the center has 0.6 where the interval is \[0, 0.5\]",
        ),
    ],
)
def test_what_is_no_ball(change, message):
    given = {"center": three().probability, "radius": [0.1, 0, 0, 0]} | change
    upper = np.array([0.5, 0.5, 0.5, 1, 1, 1])
    with pytest.raises(ValueError, match=message):
        make_interval(three(), np.zeros(6), upper, **given)


def spreading(rng, num_states=8):
    """Rows with six successors each."""
    successor = [np.sort(rng.choice(num_states, 6, replace=False)) for _ in range(12)]
    return make_sparse(
        [0, 2, 4, 6, 8, 9, 10, 11, 12],
        np.arange(0, 73, 6),
        np.concatenate(successor),
        rng.dirichlet(np.ones(6), 12).ravel(),
        initial=np.eye(num_states)[0],
        label=rng.random((num_states, 2)) < 0.3,
        propositions=["a", "b"],
    )


def test_the_ball_guarantees_more_than_its_box():
    """Never less, and on the whole clearly more; both hold."""
    rng = np.random.default_rng(3)
    more = 0.0
    for i in range(20):
        model, task = spreading(rng), TASKS[i % len(TASKS)]
        found = learn_guarantee(
            model,
            drawn(rng, model, int(rng.integers(20, 500))),
            task,
            0.9,
            graph="given",
            method="weissman",
        )
        assert found.model.radius is not None
        box = optimal_satisfaction(found.model.box, task, nature="adversarial")
        assert box.lower[0] <= found.satisfaction.upper[0] + 1e-9
        more += found.bound - box.lower[0]
    assert more > 0.1
