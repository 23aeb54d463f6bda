"""Expected times against exact fractions, and what is never reached."""

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.values.undiscounted.total_reward import hitting_time
from tests import reference
from tests.support import REPRESENTATIONS, random_representation


@pytest.mark.parametrize("kind", REPRESENTATIONS)
@pytest.mark.parametrize("seed", range(4))
def test_times_against_fractions(kind, seed):
    rng = np.random.default_rng(seed)
    model, explicit = random_representation(rng, kind)
    policy = reference.random_policy(rng, explicit)
    target = reference.random_target(rng, explicit.num_states)
    found = hitting_time(
        model, policy.reshape(*model.state_shape, -1), target.reshape(model.state_shape)
    ).ravel()
    chain = reference.chain(explicit.transition, policy)
    # Rows of floats sum to one but for rounding.
    sure = reference.exact_reachability(chain, target).astype(float) > 1 - 1e-9
    np.testing.assert_array_equal(np.isinf(found), ~sure)
    open_ = np.flatnonzero(sure & ~target)
    matrix = np.eye(len(open_), dtype=int) - chain[np.ix_(open_, open_)]
    exact = reference.exact_solve(matrix, np.ones(len(open_), int))
    np.testing.assert_allclose(found[open_], exact.astype(float), rtol=1e-9)
    assert (found[target] == 0).all()


def test_one_step_in_1e20_leaves():
    mdp = jl.from_dense([[[1.0, 0.0], [0.0, 1.0]], [[0.0, 1.0], [0.0, 1.0]]])
    policy = np.array([[1.0, 1e-20], [1.0, 0.0]])
    time = hitting_time(mdp, policy, np.array([False, True]))
    np.testing.assert_allclose(time, [1e20, 0], rtol=1e-6)


def test_it_works_on_the_host():
    mdp = jl.from_dense([[[1.0]]])
    with pytest.raises(ValueError, match="works on the host"):
        jax.jit(lambda t: hitting_time(mdp, np.array([0]), t))(np.array([True]))
