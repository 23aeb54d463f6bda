"""Models over a mesh: the primitives of the model they came from, and what goes there and back."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.games.objective import safety
from jaxltl.core.games.permissive import permissive_strategy
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.mdp import from_dense, make_mdp, to_dense
from jaxltl.core.models.mesh.lanes import on_host
from jaxltl.core.models.mesh.shard import ModelPart, from_mesh, model_from_parts, shard, to_mesh
from jaxltl.core.models.ops import operators
from jaxltl.core.models.product import product
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.values.average.mean_payoff import mean_payoff
from jaxltl.core.values.discounted.discounted import optimal_value
from jaxltl.core.values.prepared.prepared import prepare
from jaxltl.core.values.undiscounted.optimal_actions import optimal_actions
from tests.sparse_models import random_sparse

S, A = 21, 2


def mesh_of(count):
    return jax.make_mesh((count,), ("states",), devices=jax.devices()[:count])


def world(seed, reach=None, ragged=True):
    """A model whose successors are at most so far away, with labels."""
    rng = np.random.default_rng(seed)
    wide = (S, A, 4 if ragged else 2)
    successor = (
        rng.integers(0, S, wide)
        if reach is None
        else (np.arange(S)[:, None, None] + rng.integers(-reach, reach + 1, wide)).clip(0, S - 1)
    )
    if not ragged:
        successor = np.broadcast_to((np.arange(S)[:, None, None] + np.arange(2)) % S, wide)
    probability = rng.dirichlet(np.ones(wide[-1]), (S, A))
    if ragged:
        keep = rng.random(wide) < 0.3
        keep[..., 0] = True
        probability = np.where(keep, probability, 0)
        probability /= probability.sum(-1, keepdims=True)
    available = rng.random((S, A)) < (0.6 if ragged else 2)
    available[:, 0] = True
    return make_mdp(
        successor,
        np.where(available[..., None], probability, 0),
        available=available,
        label=rng.random((S, 2)) < 0.3,
        propositions=["a", "b"],
    )


def _asked(model, given):
    value, region, rank, several, push, policy, mass = given
    return {
        "expectation": operators.expectation(model, value),
        "exists": operators.exists_successor(model, region),
        "forall": operators.forall_successor(model, region),
        "least": operators.least_successor(model, rank),
        "several": operators.combined(model, several, jnp.multiply, jnp.add),
        "greatest": operators.greatest_predecessor(model, push),
        "following": operators.policy_operator(model, policy)(value),
        "pushforward": operators.pushforward(model, mass),
    }


asked = jax.jit(_asked)
EMPTY = {"expectation": 0, "exists": False, "forall": True, "least": 2**31 - 1}


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("count", "reach", "ragged"),
    [
        (1, 2, True),
        (2, 2, True),
        (4, None, True),
        (4, 1, False),
        *(
            pytest.param(count, reach, ragged, marks=pytest.mark.exhaustive)
            for count in (1, 2, 3, 4)
            for reach, ragged in ((3, True), (None, True), (1, False))
        ),
    ],
)
def test_primitives(count, reach, ragged):
    mdp = world(count, reach, ragged)
    sharded = shard(mdp, mesh_of(count))
    assert (sharded.place is None) == (not ragged)
    assert (sharded.rounds is None) == (count > 1 and reach is None)
    available = np.asarray(mdp.available)
    rng = np.random.default_rng(0)
    given = (
        rng.random(S),
        rng.random(S) < 0.4,
        rng.integers(0, 50, S).astype(np.int32),
        rng.random((S, 3)),
        (rng.integers(0, 9, (S, A)) * available).astype(np.int32),
        np.where(available[:, 1], rng.integers(0, 2, S), 0).astype(np.int32),
        np.where(available, rng.random((S, A)), 0),
    )
    here = asked(mdp, given)
    there = asked(sharded, [to_mesh(sharded, x) for x in given])
    for name, x in here.items():
        if name in EMPTY:
            x = np.where(available, x, EMPTY[name])
        found = from_mesh(sharded, there[name])
        if name == "several":
            found, x = (np.where(available[:, None], y, 0) for y in (found, x))
        np.testing.assert_allclose(found, x, rtol=1e-13, err_msg=name)


@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_products(label_on):
    mdp = world(5, 2)
    sharded = shard(mdp, mesh_of(4))
    one, other = (product(x, "F (a & X F b)", label_on=label_on) for x in (mdp, sharded))
    shape = one.state_shape
    rng = np.random.default_rng(1)
    given = (
        rng.random(shape),
        rng.random(shape) < 0.4,
        (rng.integers(0, 9, (*shape, A)) * np.asarray(one.available)).astype(np.int32),
        np.zeros(shape, np.int32),
    )
    here = asked_of_product(one, given)
    there = asked_of_product(other, [to_mesh(sharded, x) for x in given])
    for name, x in here.items():
        x = np.where(one.available, x, 0) if np.ndim(x) == 3 else np.asarray(x).reshape(shape)
        found = from_mesh(sharded, there[name].reshape(other.num_states // 3, 3, *x.shape[2:]))
        np.testing.assert_allclose(found, x, rtol=1e-13, err_msg=name)


@jax.jit
def asked_of_product(model, given):
    value, region, push, policy = given
    return {
        "initial": model.initial,
        "expectation": operators.expectation(model, value),
        "exists": operators.exists_successor(model, region),
        "greatest": operators.greatest_predecessor(model, push),
        "following": operators.policy_operator(model, policy)(value.ravel()),
    }


def test_halos_are_what_is_needed():
    width = 8
    state = np.arange(width * 12)

    def walk(start, stop):  # on a grid whose rows are numbered one after another
        here = state[start:stop]
        ahead = np.stack([here, (here + width).clip(0, state.size - 1)], 1)
        return ModelPart(
            np.arange(0, 2 * here.size + 1, 2), ahead.ravel(), np.full(2 * here.size, 0.5)
        )

    model = model_from_parts(walk, state.size, mesh_of(4))
    assert model.num_exchanged == 3 * width  # what the first of the next range needs of it
    shuffled = np.random.default_rng(0).permutation(state.size)
    rows = np.argsort(shuffled)
    mixed = make_sparse(
        None,
        np.arange(0, 2 * state.size + 1, 2),
        rows[np.stack([shuffled, (shuffled + width).clip(0, state.size - 1)], 1)].ravel(),
        np.full(2 * state.size, 0.5),
    )
    near = shard(mixed, mesh_of(4), order="near")
    given = shard(mixed, mesh_of(4))
    assert near.num_exchanged <= 6 * width < given.num_exchanged
    value = np.random.default_rng(1).random(state.size)
    for sharded in (near, given):
        np.testing.assert_allclose(
            from_mesh(sharded, operators.expectation(sharded, to_mesh(sharded, value)))[:, 0],
            mixed.host.expectation(value),
            rtol=1e-14,
        )


def test_rows_of_sparse_models_and_their_rewards_keep_their_names():
    rng = np.random.default_rng(3)
    model = random_sparse(rng, 9, rewards={"cost": Rewards(state=rng.random(9))})
    sharded = shard(model, mesh_of(2))
    quantity = rng.random(model.num_rows)
    there = on_host(to_mesh(sharded, quantity, fill=-1.0))
    rows = on_host(sharded.row)
    np.testing.assert_array_equal(there[rows >= 0], quantity[rows[rows >= 0]])
    assert (there[rows < 0] == -1).all() and (rows >= 0).sum() == model.num_rows
    earned = on_host(sharded.rewards["cost"])
    state = model.host.state[rows[rows >= 0]]
    np.testing.assert_array_equal(earned[rows >= 0], np.asarray(model.rewards["cost"].state)[state])
    assert (earned[rows < 0] == 0).all()


def test_parts_equal_the_whole():
    model = to_sparse(world(7, 3))
    host = model.host
    assert model.action is not None

    def part(start, stop):
        row = slice(host.row_start[start], host.row_start[stop])
        entry = slice(host.entry_start[row.start], host.entry_start[row.stop])
        return ModelPart(
            host.entry_start[row.start : row.stop + 1] - entry.start,
            host.successor[entry],
            host.probability[entry],
            host.row_start[start : stop + 1] - row.start,
            np.asarray(model.action)[row],
            np.asarray(model.initial)[start:stop],
            np.asarray(model.label)[start:stop],
        )

    one = shard(model, mesh_of(4))
    other = model_from_parts(part, S, mesh_of(4), propositions=model.propositions)
    for name in ("tables", "place", "available", "sent", "initial", "kind", "label_rows"):
        for x, y in zip(*(jax.tree.leaves(getattr(m, name)) for m in (one, other)), strict=True):
            np.testing.assert_array_equal(x, y, err_msg=name)
    assert one.rounds == other.rounds


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: shard(world(0), "cpu"), r"mesh is str; give a jax"),
        (lambda: shard(world(0), mesh_of(2), axis="lanes"), r"axis='lanes'; the mesh has"),
        (
            lambda: shard(world(0), mesh_of(2), order="far"),
            r'order=.far.; it must be "given", "near"',
        ),
        (
            lambda: shard(world(0), mesh_of(2), order=np.zeros(S, int)),
            r"each of the 21 states once",
        ),
        (lambda: shard(3, mesh_of(2)), r"int has no transitions; give an MDP"),
        (lambda: to_mesh(shard(world(0), mesh_of(2)), np.ones(5)), r"\(5,\); expected \(21, ...\)"),
        (lambda: model_from_parts(None, 0, mesh_of(2)), r"num_states is 0"),
        *(
            (
                lambda ask=ask: ask(shard(world(0), mesh_of(2))),
                r"lies on a mesh of devices, which",
            )
            for ask in (
                to_dense,
                to_padded,
                to_sparse,
                lambda m: mean_payoff(m, None),
                lambda m: prepare(m, None),
                lambda m: permissive_strategy(m, safety(m, "a")),
                lambda m: optimal_actions(product(m, "F a")),
            )
        ),
        (lambda: model_from_parts(lambda a, b: 3, 3, mesh_of(4)), r"3 states cannot lie on 4"),
        (lambda: model_from_parts(lambda a, b: 3, 4, mesh_of(2)), r"part\(0, 2\) is 3"),
        (
            lambda: model_from_parts(
                lambda a, b: ModelPart(np.arange(3), np.array([0, a + 9]), np.ones(2)),
                4,
                mesh_of(2),
            ),
            r"state 1, choice 0: successor 9 is out of range; states are 0 to 3",
        ),
        (
            lambda: model_from_parts(
                lambda a, b: ModelPart(np.arange(3), np.array([0, 1]), np.array([1, 1 - a / 4])),
                4,
                mesh_of(2),
            ),
            r"state 3, choice 0: the probabilities sum to 0.5, not 1",
        ),
        (
            lambda: model_from_parts(
                lambda a, b: ModelPart(np.arange(2), np.array([0]), np.ones(1)), 4, mesh_of(2)
            ),
            r"part\(0, 2\) has 1 states; it must have 2",
        ),
        (
            lambda: model_from_parts(
                lambda a, b: ModelPart(
                    np.arange(3), np.zeros(2, int), np.ones(2), initial=np.ones(2)
                ),
                4,
                mesh_of(2),
            ),
            r"the initial distribution sums to 4",
        ),
        (
            lambda: model_from_parts(
                lambda a, b: ModelPart(
                    np.arange(3), np.zeros(2, int), np.ones(2), label=np.ones(2, bool)
                ),
                4,
                mesh_of(2),
            ),
            r"part\(0, 2\): label has shape \(2,\); expected \(2, 0\)",
        ),
    ],
)
def test_what_is_wrong_is_told(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("dense", [True, False])
def test_an_action_that_is_available_nowhere_keeps_its_column(dense):
    rng = np.random.default_rng(0)
    transition = rng.dirichlet(np.ones(3), (3, 4))
    transition[:, [1, 3]] = 0  # unavailable, the last action too
    world = from_dense(transition)
    world = to_dense(world) if dense else world
    sharded = shard(world, jax.make_mesh((2,), ("states",)))
    assert sharded.num_actions == world.num_actions == 4
    reward = rng.random((3, 4))
    expected = optimal_value(world, reward, 0.9).value
    found = optimal_value(sharded, to_mesh(sharded, reward), 0.9).value
    np.testing.assert_allclose(from_mesh(sharded, found), expected, rtol=1e-9)
