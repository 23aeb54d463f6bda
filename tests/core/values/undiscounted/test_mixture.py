"""Policies that are mixed until a probability is reached, against eliminations and grids."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.values.undiscounted import mixture
from tests.algos.test_guaranteed import A, Q, S, evaluate, random_automaton, random_world

KINDS = ("cosafe", "safety", "buchi", "parity")


def random_case(rng, kind):
    """A product, any policy, one of the moves that lose nothing, the best, and what each attains."""
    while True:
        model = jl.product(
            random_world(rng), random_automaton(rng, kind), label_on=rng.choice(["entry", "exit"])
        )
        sure = jl.optimal_actions(model)
        policy = np.asarray(model.available) * rng.dirichlet(np.ones(A), (S, Q))
        policy /= policy.sum(-1, keepdims=True)
        inside = np.asarray(sure.policy)
        if reached(model, inside, "worst") > reached(model, policy, "mean") + 0.05:
            return model, policy, inside, sure.best


def reached(model, policy, over):
    """What a policy attains, by elimination."""
    value, _ = evaluate(model, policy)
    weight = np.asarray(model.mdp.initial, float)
    each = value[np.arange(S), np.asarray(model.initial_memory)]
    return float(each @ weight if over == "mean" else each[weight > 0].min())


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("kind", "over"),
    [
        ("cosafe", "mean"),
        ("safety", "worst"),
        ("buchi", "mean"),
        ("parity", "worst"),
        *(
            pytest.param(*setting, marks=pytest.mark.exhaustive)
            for setting in (
                ("cosafe", "worst"),
                ("safety", "mean"),
                ("buchi", "worst"),
                ("parity", "mean"),
            )
        ),
    ],
)
def test_the_share_is_the_least_that_reaches_what_is_asked(kind, over):
    rng = np.random.default_rng([KINDS.index(kind), over == "mean"])
    shares = []
    for _ in range(2):
        model, policy, inside, best = random_case(rng, kind)
        low, high = reached(model, policy, over), reached(model, inside, over)
        asked = low + (high - low) * rng.uniform(0.1, 0.95)
        found = mixture.least_mixture(model, policy, inside, asked, over=over)
        np.testing.assert_allclose(
            found.policy, (1 - found.share) * policy + found.share * inside, rtol=0, atol=1e-15
        )
        value = reached(model, found.policy, over)
        assert found.attained == pytest.approx(value, abs=1e-9)
        assert value >= asked - 1e-12
        # Less of it reaches less, or the window is met: mixtures need not be monotone.
        assert found.attained <= asked + mixture.WINDOW or found.share > 1 - 1e-6
        shares.append(found.share)
        none = mixture.least_mixture(model, policy, inside, low * 0.9, over=over)
        assert (none.share, none.attained) == (0, pytest.approx(low, abs=1e-9))
        np.testing.assert_array_equal(none.policy, policy)
        # With the quickest of the best where any share of the others is too much.
        quick = mixture.reaching(model, policy, inside, best, asked, over=over)
        assert reached(model, quick.policy, over) >= asked - 1e-12
        assert quick.share <= found.share
    assert kind != "cosafe" or max(shares) < 1  # else any loss may be all there is


def corridor(slow):
    """To the goal, to a trap, or on the spot; `slow` is how seldom the slow policy goes on."""
    world = jl.make_mdp(
        [[[1], [2], [0]], [[1]] * 3, [[2]] * 3],
        np.ones((3, 3, 1)),
        label=[[0], [1], [0]],
        propositions=["g"],
        initial=[1, 0, 0],
    )
    model = jl.product(world, "F g")
    shape = (*model.state_shape, 3)
    return (
        model,
        np.broadcast_to([0.2, 0.7, 0.1], shape),
        np.broadcast_to([slow, 0, 1 - slow], shape),
    )


def test_where_what_loses_nothing_dawdles_the_quickest_is_mixed_in():
    model, policy, slow = corridor(1e-12)
    best = jl.optimal_satisfaction(model)
    alone = mixture.least_mixture(model, policy, slow, 0.9)
    assert alone.share > 1 - 1e-6
    found = mixture.reaching(model, policy, slow, best, 0.9)
    # (1 - x) 0.2 + x to the goal, (1 - x) 0.7 to the trap.
    x = (0.9 * 0.9 - 0.2) / (0.8 - 0.9 * 0.1)
    assert found.share == pytest.approx(x, abs=0.01) and 0.9 <= found.attained < 0.91


def test_what_no_policy_reaches_is_refused_with_what_is_possible():
    model, *_ = corridor(1.0)
    best = jl.optimal_satisfaction(model)
    mixture.require_attainable(model, best, 1.0, "mean", str)
    world = model.mdp.replace(initial=np.array([0.25, 0.0, 0.75]))
    model = model.replace(mdp=world)
    for over, words in (("mean", "0.25 on average over the"), ("worst", "0 from the worst")):
        with pytest.raises(ValueError, match=f"achieved is {words} initial .*least from cell 2"):
            mixture.require_attainable(model, best, 0.3, over, "cell {}".format)
    mixture.require_attainable(model, best, 0.25, "mean", str)
