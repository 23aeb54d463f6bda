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
