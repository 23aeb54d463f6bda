"""Solutions, their status, and the gate on the host."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.types import Status, require_shape, status_code
from tests import reference
from tests.support import as_mdp, lane, stack


def batch_with_one_failure():
    rng = np.random.default_rng(0)
    mdps = stack([as_mdp(reference.random_model(rng, 4, 2, 2)) for _ in range(3)])
    rewards = jnp.asarray(rng.normal(size=(3, 4, 2))).at[1].set(jnp.nan)
    return jax.vmap(jl.optimal_value, (0, 0, None))(mdps, rewards, 0.9)


def test_check_names_the_lane():
    batch = batch_with_one_failure()
    assert batch.status.tolist() == [jl.Status.CONVERGED, jl.Status.NONFINITE, jl.Status.CONVERGED]
    with pytest.raises(jl.NotConverged, match=r"NONFINITE in lane 1 \(1 of 3 lanes\)"):
        jl.check(batch)


def test_check_passes_a_good_solution_through():
    good = lane(batch_with_one_failure(), 0)
    assert jl.check(good) is good


def test_check_is_for_the_host():
    good = lane(batch_with_one_failure(), 0)
    with pytest.raises(ValueError, match="works on the host only"):
        jax.jit(lambda x: jl.check(x).value)(good)


def test_status_codes():
    flags, yes = np.array([True, False]), np.array([True, True])
    assert status_code(flags, yes).tolist() == [Status.CONVERGED, Status.MAX_STEPS]
    assert status_code(flags, ~yes).tolist() == [Status.NONFINITE] * 2


def test_shapes_are_named():
    require_shape("target", np.zeros(3), (3,))
    with pytest.raises(ValueError, match=r"target has shape \(3,\); expected \(2, 2\)"):
        require_shape("target", np.zeros(3), (2, 2))


@pytest.mark.parametrize(
    "given, message",
    [
        ([3], r"target has shape \(1,\); expected \(4,\).*np.isin\(np.arange\(4\), \[3\]\)"),
        ({1, 3}, r"np.isin\(np.arange\(4\), \[1, 3\]\)"),
        ([0, 1, 2, 3], r"target is \[0, 1, 2, 3\]; give bool\[4\].*np.isin"),
        (np.array([0.5, 0, 0, 1]), r"target is \[0.5, 0.0, 0.0, 1.0\]; give bool\[4\]"),
    ],
)
def test_sets_of_states_are_masks(given, message):
    world = jl.gridworld("home . . goal")
    solvers = [
        lambda: jl.reachability_probability(world, given),
        lambda: jl.total_reward(world, np.ones((4, 4)), given),
        lambda: jl.values.hitting_time(world, np.zeros(4, int), given),
        lambda: jl.prepare(jl.to_sparse(world), given),
        lambda: jl.values.bounded_reachability(world, given, 3),
    ]
    for solve in solvers:
        with pytest.raises(ValueError, match=message):
            solve()
    mask = np.isin(np.arange(4), [3])
    for same in (mask, mask.astype(int), mask.tolist()):
        assert jl.reachability_probability(world, same).value.tolist() == [1, 1, 1, 1]


def test_check_takes_solutions():
    for given in (jnp.ones(3), 1.0, None):
        with pytest.raises(ValueError, match=r"has no status.*check\(solution\).value"):
            jl.check(given)
