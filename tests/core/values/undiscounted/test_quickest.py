"""The quickest optimal policies of random gridworlds, against fractions."""

from fractions import Fraction

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.types import Status
from jaxltl.core.values.undiscounted.satisfaction_steps import StepAnalysis
from tests import reference_fractions

FORMULAS = "!o U b", "F b & G !o", "F b"
SLIPS = 0.1, 0.2, 0.25, 0.5, 0.05


def random_world(seed, height=3, width=4):
    """A gridworld with holes `o`, walls, goals `b`, and ties."""
    rng = np.random.default_rng(seed)
    cells = rng.choice(list("..o#.b."), size=height * width, p=[0.3, 0.2, 0.1, 0.1, 0.1, 0.1, 0.1])
    places = rng.permutation(height * width)
    cells[places[:3]] = "s", "o", "b"
    text = "\n".join(" ".join(row) for row in cells.reshape(height, width))
    return jl.gridworld(text, slip=SLIPS[seed % len(SLIPS)], initial="s")


def exact_choices(sparse):
    """Of each state its rows with distributions, in the fractions that the world was made of."""
    host, found = sparse.host, []
    for s in range(host.num_states):
        found.append([])
        for r in range(*host.row_start[s : s + 2]):
            row = {
                int(host.successor[e]): Fraction(float(host.probability[e])).limit_denominator(4000)
                for e in range(*host.entry_start[r : r + 2])
            }
            assert sum(row.values()) == 1
            found[-1].append((r, row))
    return found


def exact_optimum(clock):
    """Maximal probabilities of the target, and least steps of the policies that attain them."""
    choices = exact_choices(clock.sparse)
    target = np.flatnonzero(np.asarray(clock.problem.target).ravel())
    value = reference_fractions.optimum(choices, {int(s): Fraction(1) for s in target}, None, True)
    ended = {s: Fraction(0) for s in range(len(choices)) if s in target or not value[s]}
    optimal = [
        [a for a in some if s in ended or sum(p * value[t] for t, p in a[1].items()) == value[s]]
        for s, some in enumerate(choices)
    ]
    cost = np.ones(clock.sparse.num_rows)
    return value, reference_fractions.optimum(optimal, ended, cost, False)


def mean(share, quantity):
    """The mean over the initial distribution."""
    share = [Fraction(float(x)) for x in np.asarray(share).ravel()]
    return float(sum(w * x for w, x in zip(share, quantity, strict=True) if w) / sum(share))


def require_quickest(world, formula):
    """The policy has the maximal probability, and the least steps of all policies with it."""
    model = jl.product(world, formula)
    clock = StepAnalysis(model)
    value, least = exact_optimum(clock)
    share, steps = mean(model.initial, value), mean(model.initial, least)
    if not share:
        return
    # In these worlds a round of acceptance takes one step.
    steps += clock.problem.accepting is not None
    # Probabilities in single precision differ from those of the fractions.
    digits = 1e-9 if model.dtype == np.float64 else 1e-5
    found = jl.values.quickest_policy(model)
    assert found.status == found.steps.status == Status.CONVERGED
    np.testing.assert_allclose(found.steps.value, steps, rtol=digits)
    np.testing.assert_allclose(clock.probability(found.policy)[0], share, rtol=digits)
    # The bounds enclose the steps of this policy, and of all others from below.
    assert found.steps.lower <= found.steps.value <= found.steps.upper
    assert found.least <= found.steps.upper
    # So does the default policy of optimal satisfaction, without its rounds.
    own = clock.steps(jl.optimal_satisfaction(model).policy)
    np.testing.assert_allclose(own.value, steps, rtol=digits)


@pytest.mark.few(1)
@pytest.mark.parametrize("double", [False, True])
def test_quickest_policies_take_the_least_steps_of_optimal_ones(double):
    with jax.enable_x64(double):
        for seed in range(10):
            require_quickest(random_world(seed), FORMULAS[seed % len(FORMULAS)])


@pytest.mark.parametrize(
    "last",
    [pytest.param(45, marks=pytest.mark.slow), pytest.param(160, marks=pytest.mark.exhaustive)],
)
@pytest.mark.parametrize("double", [False, True])
def test_quickest_policies_of_more_worlds(double, last):
    with jax.enable_x64(double):
        for seed in range(15, last):
            require_quickest(random_world(seed, 3 + seed % 2), FORMULAS[seed % len(FORMULAS)])


def test_ties_between_rooms_do_not_keep_the_robot():
    """Waiting at the side of a passage with risk conserves the probability, but takes 385 steps."""
    with jax.enable_x64(True):
        world = jl.gridworld(". o . .\ns . . .\n. o . .\n# # . b", slip=0.1, initial="s")
        require_quickest(world, "F b & G !o")
        require_quickest(world, "!o U b")


def test_a_tiny_probability_is_not_given_up_for_speed():
    """A policy that loses less than 1e-9, but all of the probability, is not optimal."""
    risky = 1e-10
    world = jl.from_dense(
        [
            [[0.5, 0.5 - risky, 0, risky], [0, 0, 1.0, 0]],
            [[0, 0, 1.0, 0]] * 2,
            [[0, 0, 1.0, 0]] * 2,
            [[0, 0, 0, 1.0]] * 2,
        ],
        initial=[1, 0, 0, 0],
        label=[[0], [0], [0], [1]],
        propositions=["b"],
    )
    model = jl.product(world, "F b")
    found = jl.values.quickest_policy(model)
    assert found.policy[0, 0] == 0 and found.status == Status.CONVERGED


@pytest.mark.slow
def test_bounds_that_do_not_meet_are_not_converged():
    """Two accepting components with different rates: Jensen's bound is not attained."""
    size = 6
    ahead = np.zeros((size, 1, size))
    ahead[0, 0, [1, 2]] = 0.5
    for s, t in ((1, 1), (2, 3), (3, 4), (4, 5), (5, 2)):
        ahead[s, 0, t] = 1
    label = np.zeros((size, 1), bool)
    label[[1, 2]] = True
    world = jl.from_dense(ahead, initial=np.eye(size)[0], label=label, propositions=["a"])
    found = jl.values.quickest_policy(jl.product(world, "G F a"))
    assert found.status == Status.PRECISION
    assert found.least < found.steps.lower and found.steps.status == Status.CONVERGED
