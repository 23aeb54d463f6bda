"""Expected total rewards inside ``jit`` and over meshes, against the host and exact fractions."""

from fractions import Fraction
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.mesh.shard import from_mesh, shard, to_mesh
from jaxltl.core.types import Status
from tests import reference

S, A, K = 12, 2, 2


@cache
def mesh_of(devices):
    return jax.make_mesh((devices,), ("states",), devices=jax.devices()[:devices])


def some_model(rng, down, num_states=S):
    """Dyadic rows, with missing actions; `down`: the share of those that may lead down to 0."""
    successor = rng.integers(0, num_states, (num_states, A, K))
    below = rng.integers(0, np.maximum(np.arange(num_states), 1)[:, None], (num_states, A))
    falls = rng.random((num_states, A)) < down
    successor[..., 0] = np.where(falls, below, successor[..., 0])
    first = rng.integers(1, 9, (num_states, A)) / 8
    available = rng.random((num_states, A)) < 0.8
    available[:, 0] |= ~available.any(-1)
    probability = np.stack([first, 1 - first], -1) * available[..., None]
    return successor, probability, available


def some_problem(seed, num_states=S):
    rng = np.random.default_rng(seed)
    parts = some_model(rng, (1, 0.8, 0.3)[seed % 3], num_states)
    reward = rng.integers(0, 4, (num_states, A)) * (rng.random((num_states, A)) < 0.5)
    target = rng.random(num_states) < 0.1
    target[0] |= seed % 5 > 0
    policy = np.where(parts[2], rng.integers(1, 5, (num_states, A)), 0)
    if seed % 2:
        policy[np.arange(num_states), parts[2].argmax(-1)] += 4
    return parts, reward * 1.0, target, policy / policy.sum(-1, keepdims=True)


def made(parts):
    successor, probability, available = parts
    return jl.make_mdp(np.where(probability > 0, successor, 0), probability, available=available)


def agree(found, host, tolerance=1e-6, taken=np.asarray, status=Status.CONVERGED):
    """The enclosure meets that of the host; infinite and 0 at the same places."""
    value, lower, upper = (taken(x) for x in (found.value, found.lower, found.upper))
    finite = np.isfinite(host.upper)
    np.testing.assert_array_equal(np.isfinite(value), finite)
    np.testing.assert_array_equal(value == 0, np.asarray(host.value) == 0)
    for x in (lower, upper):
        assert np.isinf(x[~finite]).all()
    assert (lower <= value)[finite].all() and (value <= upper)[finite].all()
    assert (lower[finite] <= np.asarray(host.upper)[finite] * (1 + 1e-12)).all()
    assert (upper[finite] >= np.asarray(host.lower)[finite] * (1 - 1e-12)).all()
    assert found.status == status
    if status == Status.CONVERGED:
        assert (upper[finite] - lower[finite] <= tolerance * upper[finite]).all()


@partial(jax.jit, static_argnames=("objective",))
def inside(model, reward, target, policy=None, objective="max"):
    return jl.total_reward(model, reward, target, policy=policy, objective=objective)


def attains(model, reward, target, found, objective, taken=np.asarray):
    """The policy's own value is on the safe side of its bound."""
    own = jl.total_reward(model, reward, target, policy=taken(found.policy))
    lower, upper = taken(found.lower), taken(found.upper)
    if objective == "max":
        assert (np.asarray(own.upper) >= lower * (1 - 1e-9)).all()
    else:
        finite = np.isfinite(upper)
        assert (np.asarray(own.lower)[finite] <= upper[finite] * (1 + 1e-9)).all()


def host_agrees(seed):
    parts, reward, target, policy = some_problem(seed)
    model = made(parts)
    for objective in ("max", "min"):
        host = jl.total_reward(model, reward, target, objective=objective)
        found = inside(model, reward, target, objective=objective)
        agree(found, host)
        attains(model, reward, target, found, objective)
    agree(
        inside(model, reward, target, policy), jl.total_reward(model, reward, target, policy=policy)
    )


def test_inside_jit_it_is_that_of_the_host():
    for seed in range(10):
        host_agrees(seed)


def mesh_agrees(seed, devices, objectives=("max", "min", "policy")):
    parts, reward, target, policy = some_problem(seed)
    model = made(parts)
    world = shard(model, mesh_of(devices))
    put, taken = partial(to_mesh, world), partial(from_mesh, world)
    for objective in objectives:
        given = {"policy": policy} if objective == "policy" else {"objective": objective}
        host = jl.total_reward(model, reward, target, **given)
        if objective == "policy":
            given = {"policy": put(policy)}
        found = jl.total_reward(world, put(reward), put(target), **given)
        agree(found, host, taken=taken)
        if objective != "policy":
            attains(model, reward, target, found, objective, taken)


@pytest.mark.slow
def test_over_a_mesh_it_is_that_of_the_host():
    mesh_agrees(1, 4, ("min",))


# --- exact --------------------------------------------------------------------------------------


def exact_least(model, reward, target):
    """Over all memoryless policies, the least value of those that surely reach the target."""
    best = np.full(model.num_states, None)
    transition = reference.FRACTION(model.transition)
    for policy in reference.memoryless_policies(model.available):
        value = exact_value(
            transition[np.arange(S_TINY), list(policy)],
            reference.FRACTION(reward[np.arange(S_TINY), list(policy)]),
            target,
        )
        for s, v in enumerate(value):
            if v is not None and (best[s] is None or v < best[s]):
                best[s] = v
    return best


S_TINY = 5


def exact_value(matrix, reward, target):
    """Of a chain; None where the target is not reached almost surely."""
    moves = reference.closure((matrix > 0) & ~target[:, None])
    reaches = moves[:, target].any(-1) | target
    sure = ~(moves & ~reaches).any(-1) & reaches
    inner = sure & ~target
    value = np.full(len(matrix), None)
    value[target] = Fraction(0)
    where = np.flatnonzero(inner)
    if where.size:
        eye = reference.FRACTION(np.eye(where.size))
        value[where] = reference.exact_solve(eye - matrix[np.ix_(where, where)], reward[where])
    return value


def test_least_rewards_enclose_those_of_the_best_of_all_policies():
    for seed in range(60, 72):
        parts, reward, target, _ = some_problem(seed, S_TINY)
        reward = np.where(reward == 3, 0, reward)
        target[1:] = False
        exact = exact_least(reference.Model(*parts, np.ones(S_TINY)), reward, target)
        found = inside(made(parts), reward, target, objective="min")
        assert found.status == Status.CONVERGED
        for s, v in enumerate(exact):
            if v is None:
                assert np.isinf(found.value[s])
            else:
                assert Fraction(float(found.lower[s])) <= v <= Fraction(float(found.upper[s]))


def test_going_round_for_nothing_is_no_way_to_pay_less():
    """States 1 and 2 may circle for nothing for ever; leaving costs 5 from 1, and 3 from 2."""
    to = np.array([[0, 0], [2, 0], [1, 0], [0, 0], [0, 0]])
    model = jl.make_mdp(np.stack([to, 0 * to], -1), np.ones((S_TINY, A, 1)) * [1.0, 0.0])
    reward = np.array([[0.0, 0], [0, 5], [0, 3], [0, 0], [0, 0]])
    target = np.arange(S_TINY) == 0
    found = inside(model, reward, target, objective="min")
    np.testing.assert_allclose(found.value, [0, 3, 3, 0, 0], rtol=1e-6)
    assert found.policy[1:3].tolist() == [0, 1]
    assert np.isinf(inside(model, reward, target).value).tolist() == [0, 1, 1, 0, 0]


# --- hard ones -----------------------------------------------------------------------------------


def walk(num_states, *forward):
    """Steps one place up with some probability, else one down; an action for each probability."""
    s = np.arange(num_states)
    successor = np.stack([np.minimum(s + 1, num_states - 1), np.maximum(s - 1, 0)], -1)
    p = np.broadcast_to(np.array([[x, 1 - x] for x in forward]), (num_states, len(forward), 2))
    return jl.make_mdp(np.repeat(successor[:, None], len(forward), 1), p), s == num_states - 1


@pytest.mark.slow
@pytest.mark.parametrize("devices", [1, pytest.param(4, marks=pytest.mark.exhaustive)])
def test_slow_walks_are_solved(devices):
    model, target = walk(80, 0.5, 0.6)
    reward = np.array([[1.0, 3.0]] * 80)
    world = shard(model, mesh_of(devices))
    found = jl.total_reward(world, to_mesh(world, reward), to_mesh(world, target))
    agree(found, jl.total_reward(model, reward, target), taken=partial(from_mesh, world))


def test_what_rounding_forbids_is_not_claimed():
    """Some 10^9 steps are enclosed, but not beyond the dtype; and values underflow."""
    stay = 1 - 2.0**-30
    successor = np.zeros((S_TINY, A, K), int)
    successor[1, :, 0] = 1
    model = jl.make_mdp(successor, np.broadcast_to([stay, 1 - stay], successor.shape))
    target = np.arange(S_TINY) == 0
    found = inside(model, np.ones((S_TINY, A)), target)
    assert found.status == Status.CONVERGED
    assert found.lower[1] <= 2**30 <= found.upper[1] <= found.lower[1] * (1 + 1e-6)
    found = jax.jit(partial(jl.total_reward, tolerance=1e-16))(model, np.ones((S_TINY, A)), target)
    assert found.status == Status.PRECISION and found.lower[1] <= 2**30 <= found.upper[1]
    tiny = inside(model, np.full((S_TINY, A), 1e-310), target)
    assert tiny.status != Status.CONVERGED and tiny.upper[1] > 0


@pytest.mark.slow
def test_single_precision():
    with jax.enable_x64(False):
        for seed in range(8):
            parts, reward, target, policy = some_problem(seed)
            model = made(parts)
            for given in ({"objective": "max"}, {"objective": "min"}, {"policy": policy}):
                host = jl.total_reward(model, reward, target, tolerance=1e-7, **given)
                found = inside(model, reward, target, **given)
                assert found.value.dtype == jnp.float32
                agree(found, host, 1e-3, status=found.status)
                # Roundings of some hundred steps are a thousandth.
                finite = host.value[np.isfinite(host.value)]
                assert found.status == Status.CONVERGED or (
                    found.status == Status.PRECISION and finite.max() > 100
                )


# --- what else is asked of it --------------------------------------------------------------------


def sum_of_finite(model, reward, target, **given):
    found = jl.total_reward(model, reward, target, **given)
    return jnp.where(jnp.isfinite(found.value), found.value, 0).sum()


def slopes_agree(run, at, changes, step=1e-5):
    """Derivatives along changes are those of differences."""
    found = jax.jit(jax.grad(lambda x: run(*x)))(at)
    run = jax.jit(run)
    for i, change in enumerate(changes):
        up, down = (run(*at[:i], at[i] + s * change, *at[i + 1 :]) for s in (step, -step))
        np.testing.assert_allclose(
            (found[i] * change).sum(), (up - down) / (2 * step), rtol=1e-4, atol=1e-4
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    "objective", ["min", pytest.param("max", marks=pytest.mark.exhaustive), "policy"]
)
def test_derivatives_are_those_of_differences(objective):
    parts, reward, target, policy = some_problem(1)
    model, rng = made(parts), np.random.default_rng(0)
    reward = reward + rng.random(reward.shape)  # no ties
    both = np.where(parts[1].min(-1) > 0, rng.standard_normal((S, A)), 0)
    turn = np.where(parts[2].all(-1), rng.standard_normal(S), 0)
    at = [reward, model.probability]
    changes = [rng.standard_normal(reward.shape), np.stack([both, -both], -1)]
    if objective == "policy":
        at.append(policy)
        changes.append(np.stack([turn, -turn], -1))

    def run(reward, probability, policy=None):
        given = {"objective": objective} if policy is None else {"policy": policy}
        return sum_of_finite(model.replace(probability=probability), reward, target, **given)

    slopes_agree(run, at, changes)


@pytest.mark.slow
def test_lanes_are_what_they_are_alone():
    parts, reward, target, _ = some_problem(4)
    model = made(parts)
    rewards = reward * np.array([1.0, 2.0, 0.0])[:, None, None]
    many = jax.jit(jax.vmap(lambda r: jl.total_reward(model, r, target, objective="min")))(rewards)
    for i, r in enumerate(rewards):
        one = inside(model, r, target, objective="min")
        for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(many), strict=True):
            np.testing.assert_array_equal(x, y[i])


def test_rewards_by_name_and_of_states():
    """On a mesh of one device: a sparse model's names, and what a state earns."""
    sparse = jl.make_sparse(
        None,
        [0, 2, 3],
        [0, 1, 1],
        [0.5, 0.5, 1.0],
        rewards={"steps": jl.models.Rewards(state=[1, 1])},
    )
    world = shard(sparse, mesh_of(1))
    target = to_mesh(world, np.array([False, True]))
    for reward in ("steps", to_mesh(world, np.ones(2))):
        found = jl.total_reward(world, reward, target)
        np.testing.assert_allclose(from_mesh(world, found.value), [2, 0], rtol=1e-6)


def test_what_is_refused():
    parts, reward, target, policy = some_problem(1)
    model = made(parts)
    world = shard(model, mesh_of(1))
    put = partial(to_mesh, world)
    with pytest.raises(ValueError, match="state 3 is -1; expected total"):
        jl.total_reward(world, put(np.where(np.arange(S)[:, None] == 3, -1, reward)), put(target))
    with pytest.raises(ValueError, match="over a mesh do; give one"):
        jl.total_reward(world, put(reward))
    with pytest.raises(ValueError, match="'cost' is no reward of this ShardedMDP"):
        jl.total_reward(world, "cost", put(target))
    with pytest.raises(ValueError, match="target"):
        jl.total_reward(world, put(reward), put(target)[1:])
    bad = inside(model, np.where(np.arange(S)[:, None] == 3, -1.0, reward), target)
    assert bad.status == Status.NONFINITE and np.isnan(bad.value).all()
    none = inside(model, reward, target, policy * 2)
    assert none.status == Status.INVALID_POLICY and np.isnan(none.value).all()
