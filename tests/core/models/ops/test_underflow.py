"""Probabilities that are zero or subnormal in the target precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.games.winning import almost_sure_buchi
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.construct.restrict import restrict, with_allowed
from jaxltl.core.models.game import make_game
from jaxltl.core.models.mdp import from_dense, make_mdp, to_dense
from jaxltl.core.models.mesh.shard import ModelPart, model_from_parts, shard, to_mesh
from jaxltl.core.models.ops.underflow import is_positive, is_subnormal
from jaxltl.core.models.product import product
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.types import Status
from jaxltl.core.values.discounted.discounted import policy_value
from jaxltl.core.values.prepared.prepared import prepare
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.total_reward import total_reward

TARGET = np.array([False, True, False])
STARTS, SUCCESSOR = [0, 3, 4, 5], [0, 1, 2, 1, 2]
SUBNORMAL = {np.dtype("float32"): 1e-40, np.dtype("float64"): 1e-310}


@pytest.fixture(autouse=True, params=[True, False], ids=["double", "single"])
def x64(request):
    with jax.enable_x64(request.param):
        yield


def precision():
    return np.dtype(jnp.result_type(float))


def tiny_values():
    """Values that the default precision cannot represent as normal numbers."""
    values = [SUBNORMAL[precision()]]
    return [*values, 1e-50] if precision() == np.float32 else values


def dense(p):
    return np.array([[[1 - 2 * p, p, p]], [[0, 1, 0]], [[0, 0, 1]]])


def raw(p):
    """The model of `dense` without the checks of the constructors."""
    model = from_dense(dense(0.25))
    return model.replace(probability=np.asarray(to_rows(p), precision()))


def to_rows(p):
    return [[[1 - 2 * p, p, p]], [[1, 0, 0]], [[1, 0, 0]]]


def sparse(p):
    return make_sparse(None, STARTS, SUCCESSOR, [1 - 2 * p, p, p, 1, 1])


@pytest.mark.parametrize("p", [1e-50, 1e-310])
def test_conversions_name_the_place_of_what_they_would_drop(p):
    if p >= jnp.finfo(precision()).tiny:
        pytest.skip("a normal number in this precision")
    place = "state 0, action 0: probability"
    with pytest.raises(ValueError, match=place):
        from_dense(dense(p))
    with pytest.raises(ValueError, match=place):
        make_mdp(np.tile(np.arange(3), (3, 1, 1)), dense(p))
    mesh = jax.make_mesh((1,), ("states",))
    if p > np.finfo(np.float64).tiny:
        with pytest.raises(ValueError, match=place):
            to_padded(sparse(p))
        with pytest.raises(ValueError, match="state 0, choice 0: probability"):
            shard(sparse(p), mesh)
        with pytest.raises(ValueError, match="state 0, choice 0: probability"):
            prepare(sparse(p), TARGET)
    else:
        with pytest.raises(ValueError, match="state 0, choice 0: probability"):
            sparse(p)
    part = ModelPart(np.array(STARTS), np.array(SUCCESSOR), np.array([1 - 2 * p, p, p, 1, 1]))
    with pytest.raises(ValueError, match="state 0, choice 0: probability"):
        model_from_parts(lambda start, stop: part, 3, mesh)
    with pytest.raises(ValueError, match="initial probability of state 1"):
        from_dense(dense(0.25), initial=[1 - p, p, 0])


@pytest.mark.parametrize(
    "use",
    [
        to_sparse,
        to_dense,
        lambda model: make_game(model, [True, True, True]),
        lambda model: shard(model, jax.make_mesh((1,), ("states",))),
        lambda model: restrict(model),
        lambda model: reachability_probability(model, TARGET),
        lambda model: attractor(model, TARGET),
        lambda model: almost_sure_buchi(make_game(raw(0.25), [1, 1, 1]).replace(mdp=model), TARGET),
    ],
)
def test_concrete_models_with_subnormal_probabilities_are_refused(use):
    model = raw(SUBNORMAL[precision()])
    with pytest.raises(ValueError, match="state 0, action 0: probability"):
        use(model)


@pytest.mark.few(1)
@pytest.mark.parametrize("objective", ["max", "min"])
def test_traced_models_with_subnormal_probabilities_are_invalid(objective):
    bad, good, away = raw(SUBNORMAL[precision()]), raw(0.25), np.array([False, True, True])

    @jax.jit
    def statuses(model):
        return (
            reachability_probability(model, TARGET, objective=objective).status,
            total_reward(model, jnp.ones((3, 1)), away, objective=objective).status,
            policy_value(model, jnp.zeros(3, int), jnp.ones((3, 1)), 0.5).status,
        )

    assert all(status == Status.CONVERGED for status in statuses(good))
    assert all(status == Status.INVALID for status in statuses(bad))


@pytest.mark.few(1)
def test_sparse_models_that_enter_jit_in_lower_precision_are_invalid():
    solve = jax.jit(lambda m: policy_value(m, jnp.zeros(3, int), jnp.ones(3), 0.5).status)
    assert int(solve(sparse(0.25))) == Status.CONVERGED
    expected = Status.INVALID if precision() == np.float32 else Status.CONVERGED
    assert int(solve(sparse(1e-50))) == expected


def test_the_support_is_the_same_on_the_host_and_inside_jit():
    for p in tiny_values():
        weight = np.array([0, p, -p, 1, np.inf], precision())
        found = jax.jit(is_positive)(weight)
        assert found.tolist() == (weight > 0).tolist()
    model = raw(SUBNORMAL[precision()])
    assert jax.jit(lambda m: attractor(m, TARGET).region)(model).tolist() == [True, True, False]


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64, jnp.bfloat16])
def test_subnormal_numbers_are_found_by_their_bits(dtype):
    info = jnp.finfo(dtype)
    x = np.array([0, info.tiny / 2, -info.tiny / 4, info.tiny, 1, np.inf, np.nan], dtype)
    if dtype == jnp.float64 and precision() == np.float32:
        pytest.skip("needs 64-bit precision")
    expected = [False, True, True, False, False, False, False]
    assert jax.jit(is_subnormal)(x).tolist() == expected


@pytest.mark.few(1)
def test_policies_with_subnormal_weights_are_refused():
    model = from_dense([[[0, 1.0], [1.0, 0]], [[0, 1.0], [0, 1.0]]])
    tiny, target = SUBNORMAL[precision()], np.array([False, True])
    policy = np.array([[tiny, 1 - tiny], [1, 0]], precision())
    with pytest.raises(ValueError, match="weight of action 0 in state 0"):
        reachability_probability(model, target, policy=policy)
    solve = jax.jit(lambda policy: reachability_probability(model, target, policy=policy).status)
    assert int(solve(policy)) == Status.INVALID_POLICY
    assert int(solve(np.array([[0.5, 0.5], [1, 0]], precision()))) == Status.CONVERGED
    weights = np.array([1e-310, 1, 1, 0])
    with pytest.raises(ValueError, match="weight of action 0 in state 0"):
        reachability_probability(to_sparse(model), target, policy=weights)
    mesh = jax.make_mesh((1,), ("states",))
    with pytest.raises(ValueError, match="weight at"):
        to_mesh(shard(model, mesh), policy)


@pytest.mark.parametrize("number", [1j, "a", [1, 2], object()])
def test_constructors_refuse_what_is_not_a_real_number(number):
    entry = np.array([[[number, 0.5]], [[0, 1]]], object)
    for build in (
        lambda: from_dense(entry),
        lambda: make_mdp([[[0, 1]], [[0, 1]]], entry),
        lambda: from_dense([[[1.0]]], initial=[number]),
        lambda: from_dense([[[1.0]]], available=[[number]]),
        lambda: from_dense([[[1.0]]], label=[[number]], propositions=["a"]),
        lambda: make_sparse(None, [0, 1], [0], [number]),
        lambda: make_sparse(None, [0, 1], [0], [1], rewards={"r": Rewards(state=[number])}),
    ):
        with pytest.raises(ValueError):
            build()
    with pytest.raises(ValueError):
        from_dense(np.array([[[1 + 0j]]]))
    with pytest.raises(ValueError):
        make_sparse(None, [0, 1], [0], np.array([1 + 0j]))


@pytest.mark.parametrize("mask", [[True], np.ones((2, 3), bool), np.ones((2, 1)), "x", None, True])
def test_masks_of_another_shape_or_type_are_refused(mask):
    model = from_dense([[[0.5, 0.5]], [[0, 1.0]]], label={"a": [1]})
    for one in (model, to_sparse(model), product(model, "F a"), make_game(model, [1, 0])):
        with pytest.raises(ValueError, match="expected bool"):
            with_allowed(one, mask)
