"""The primitives: every representation against loops, and the laws that tie them together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.ops import operators
from tests import reference
from tests.sparse_models import random_sparse
from tests.support import (
    REPRESENTATIONS,
    assert_gradients,
    counts,
    mass_preserving,
    random_representation,
)


def whole(function):
    """Compiled as a whole, which takes less long than operation by operation; for the host."""
    compiled = jax.jit(function)
    return lambda *arguments: jax.tree.map(np.asarray, compiled(*arguments))


expectation, pushforward, exists_successor, forall_successor = map(
    whole,
    (
        jl.models.expectation,
        jl.models.pushforward,
        jl.models.exists_successor,
        jl.models.forall_successor,
    ),
)
least_successor, transition_matrix, induced_chain, action_argmax, action_max = map(
    whole,
    (
        operators.least_successor,
        operators.transition_matrix,
        operators.induced_chain,
        operators.action_argmax,
        operators.action_max,
    ),
)
following = whole(lambda model, policy, value: operators.policy_operator(model, policy)(value))


@pytest.mark.few(4)
@pytest.mark.parametrize("kind", REPRESENTATIONS)
@pytest.mark.parametrize("num_successors", [1, 3, 20])  # short rows are summed term by term
def test_primitives_equal_loops(kind, num_successors):
    rng = np.random.default_rng(1)
    for _ in range(3):
        model, explicit = random_representation(rng, kind, num_successors=num_successors)
        size = explicit.num_states
        value = jnp.asarray(rng.normal(size=size))
        region = jnp.asarray(rng.random(size) < 0.5)
        mass = jnp.asarray(rng.random((size, explicit.num_actions)))
        shape, actions = model.state_shape, (*model.state_shape, model.num_actions)
        pairs = [
            (expectation(model, value.reshape(shape)), reference.expectation(explicit, value)),
            (pushforward(model, mass.reshape(actions)), reference.pushforward(explicit, mass)),
        ]
        for found, expected in pairs:
            np.testing.assert_allclose(np.ravel(found), expected.ravel(), rtol=0, atol=1e-14)
        region_ = region.reshape(shape)
        np.testing.assert_array_equal(
            exists_successor(model, region_).reshape(size, -1),
            reference.exists_successor(explicit, region),
        )
        np.testing.assert_array_equal(
            forall_successor(model, region_).reshape(size, -1),
            reference.forall_successor(explicit, region),
        )


@pytest.mark.parametrize("label_on", ["entry", "exit"])
@pytest.mark.parametrize("num_memory", [3, 20])  # many memory states are gathered, few selected
def test_products_with_few_and_many_memory_states(label_on, num_memory):
    rng = np.random.default_rng(2)
    model, explicit = random_representation(
        rng, "product", num_memory=num_memory, label_on=label_on
    )
    value = jnp.asarray(rng.normal(size=explicit.num_states))
    mass = jnp.asarray(rng.random((explicit.num_states, explicit.num_actions)))
    found = expectation(model, value.reshape(model.state_shape))
    np.testing.assert_allclose(
        found.reshape(mass.shape), reference.expectation(explicit, value), atol=1e-14
    )
    np.testing.assert_allclose(
        pushforward(model, mass.reshape(found.shape)).ravel(),
        reference.pushforward(explicit, mass),
        atol=1e-14,
    )


@pytest.mark.parametrize("kind", REPRESENTATIONS)
def test_padding_and_unavailable_actions(kind):
    model, _ = random_representation(np.random.default_rng(3), kind)
    nowhere, everywhere = np.zeros(model.state_shape, bool), np.ones(model.state_shape, bool)
    closed = ~np.asarray(model.available)
    assert closed.any(), "the example has an unavailable action"
    assert forall_successor(model, nowhere)[closed].all()
    assert not exists_successor(model, everywhere)[closed].any()
    assert not expectation(model, np.ones(model.state_shape))[closed].any()


@pytest.mark.parametrize("kind", REPRESENTATIONS)
def test_numpy_arrays_are_taken(kind):
    model, _ = random_representation(np.random.default_rng(3), kind)
    ones = np.ones(model.state_shape)
    expected = expectation(model, jnp.asarray(ones))
    np.testing.assert_array_equal(expectation(model, ones), expected)
    assert exists_successor(model, ones > 0).dtype == bool
    assert forall_successor(model, ones > 0).all()


@pytest.mark.parametrize("kind", REPRESENTATIONS)
def test_pushforward_is_the_transpose_of_expectation(kind):
    rng = np.random.default_rng(4)
    model, _ = random_representation(rng, kind)
    value = rng.normal(size=model.state_shape)
    mass = rng.normal(size=(*model.state_shape, model.num_actions))
    left = np.vdot(expectation(model, value), mass)
    right = np.vdot(value, pushforward(model, mass))
    np.testing.assert_allclose(left, right, rtol=1e-13)


@pytest.mark.parametrize("kind", REPRESENTATIONS)
def test_induced_chain_follows_the_policy(kind):
    rng = np.random.default_rng(5)
    model, explicit = random_representation(rng, kind)
    policy = explicit.available.argmax(axis=1)
    chain = induced_chain(model, policy.reshape(model.state_shape))
    value = rng.normal(size=explicit.num_states)
    expected = reference.expectation(explicit, value)[np.arange(policy.size), policy]
    np.testing.assert_allclose(expectation(chain, value)[:, 0], expected, atol=1e-14)
    np.testing.assert_array_equal(chain.initial, explicit.initial)


@pytest.mark.parametrize("kind", REPRESENTATIONS)
def test_samples_have_the_rows_frequencies(kind):
    model, explicit = random_representation(np.random.default_rng(6), kind, certainty=0.0)
    transition = explicit.transition
    s, a = np.argwhere((transition > 0).sum(-1) > 1)[0]
    keys = jax.random.split(jax.random.key(0), 20_000)
    draw = jax.jit(
        jax.vmap(lambda key: jl.models.sample_successor(model, key, jnp.int32(s), jnp.int32(a)))
    )
    frequency = np.bincount(draw(keys), minlength=explicit.num_states) / len(keys)
    # Five standard deviations of a frequency.
    assert np.abs(frequency - transition[s, a]).max() < 5 * np.sqrt(0.25 / len(keys))
    assert not frequency[transition[s, a] == 0].any()


@pytest.mark.parametrize("kind", REPRESENTATIONS)
def test_expectation_and_pushforward_are_differentiable(kind):
    rng = np.random.default_rng(7)
    model, _ = random_representation(rng, kind, certainty=0.0)
    value, mass = rng.normal(size=model.state_shape), rng.random(model.available.shape)
    world = getattr(model, "mdp", model)
    field = "transition" if kind == "dense" else "probability"
    probability = getattr(world, field)

    def both(x):
        changed = world.replace(**{field: x["probability"]})
        changed = model.replace(mdp=changed) if kind == "product" else changed
        return jl.models.expectation(changed, x["value"]), jl.models.pushforward(changed, x["mass"])

    assert_gradients(
        both,
        {"value": value, "mass": mass, "probability": probability},
        {
            "value": rng.normal(size=value.shape),
            "mass": rng.normal(size=mass.shape),
            "probability": mass_preserving(rng, probability),
        },
    )


def test_actions_maximum_for_few_and_many_actions():
    rng = np.random.default_rng(8)
    for num_actions in (1, 4, 30):
        quantity = rng.normal(size=(6, num_actions))
        quantity[3] = 1.0  # ties go to the first
        available = rng.random(quantity.shape) < 0.6
        available[:, -1] = True
        masked = np.where(available, quantity, -np.inf)
        best, action = action_argmax(quantity, available)
        np.testing.assert_array_equal(best, masked.max(axis=1))
        np.testing.assert_array_equal(action, masked.argmax(axis=1))
        np.testing.assert_array_equal(action_max(quantity, available), best)


def test_deterministic_and_stochastic_policies_mean_the_same():
    rng = np.random.default_rng(9)
    model, _ = random_representation(rng, "sparse")
    policy = jnp.asarray(rng.integers(model.num_actions, size=model.num_states))
    quantity = jnp.asarray(rng.normal(size=model.available.shape))
    distribution = operators.policy_distribution(model, policy)
    np.testing.assert_array_equal(
        operators.action_mean(policy, quantity), operators.action_mean(distribution, quantity)
    )


def test_errors_name_the_argument():
    model, _ = random_representation(np.random.default_rng(10), "sparse")
    with pytest.raises(ValueError, match=r"policy has shape \(3,\); a deterministic .* \(4,\)"):
        operators.policy_distribution(model, jnp.zeros(3, int))
    with pytest.raises(ValueError, match=r"policy has shape \(4,\); a stochastic .* \(4, 3\)"):
        operators.policy_distribution(model, jnp.zeros(4))
    for function in (jl.models.expectation, jl.models.exists_successor, jl.models.forall_successor):
        with pytest.raises(TypeError, match="dict is not a model"):
            function({}, jnp.zeros(3))
    with pytest.raises(TypeError, match="dict is not a model"):
        jl.models.sample_successor({}, jax.random.key(0), 0, 0)
    with pytest.raises(TypeError, match="dict is not a model"):
        operators.induced_chain({}, jnp.zeros(3, int))


# --- sparse models ---------------------------------------------------------------------------


@counts(1, 3)  # each of another shape
def test_primitives_of_rows_equal_those_of_the_padded_model(count):
    rng = np.random.default_rng(20)
    for _ in range(count):
        model = random_sparse(rng, 9, most=5, width=9)
        padded = jl.to_padded(model)
        place = model.host.state, np.arange(model.num_rows) - model.row_start[model.host.state]
        value, region = rng.normal(size=9), rng.random(9) < 0.5
        np.testing.assert_allclose(
            expectation(model, value), expectation(padded, value)[place], rtol=0, atol=1e-14
        )
        mass = rng.random(model.num_rows)
        wide = np.zeros((9, padded.num_actions))
        wide[place] = mass
        np.testing.assert_allclose(
            pushforward(model, mass), pushforward(padded, wide), rtol=0, atol=1e-14
        )
        np.testing.assert_allclose(
            transition_matrix(model, mass), transition_matrix(padded, wide), rtol=0, atol=1e-14
        )
        for primitive, x in (
            (exists_successor, region),
            (forall_successor, region),
            (least_successor, value),
        ):
            np.testing.assert_array_equal(primitive(model, x), primitive(padded, x)[place])
        assert not exists_successor(model.replace(probability=0 * model.probability), region).any()
        rows = np.asarray(model.row_start[1:] - 1)
        np.testing.assert_allclose(following(model, rows, value), expectation(model, value)[rows])


def test_expectation_of_rows_is_differentiable():
    rng = np.random.default_rng(21)
    model = random_sparse(rng, 5, most=3, width=4)
    point = {"probability": model.probability, "value": rng.normal(size=5)}
    assert_gradients(
        lambda x: jl.models.expectation(model.replace(probability=x["probability"]), x["value"]),
        point,
        {name: rng.normal(size=x.shape) for name, x in point.items()},
    )


def test_draws_from_a_row_follow_its_probabilities():
    rng = np.random.default_rng(22)
    model = random_sparse(rng, 6, most=2, width=6)
    row = int(np.argmax(np.diff(model.entry_start)))
    entries = slice(*model.entry_start[row : row + 2])
    none = np.asarray(model.probability).copy()
    none[entries.stop - 1] = 0  # of a row that then sums to less than one
    count = 20_000
    keys = jax.random.split(jax.random.key(0), count)
    draw = jax.jit(jax.vmap(jl.models.sample_successor, (None, 0, None, None)))
    drawn = np.asarray(draw(model, keys, 0, row))
    found = np.bincount(drawn, minlength=6)[model.successor[entries]] / count
    assert found.sum() == 1
    np.testing.assert_allclose(found, model.probability[entries], atol=5 / np.sqrt(count) / 2)
    drawn = np.asarray(draw(model.replace(probability=none), keys, 0, row))
    assert model.successor[entries.stop - 1] not in drawn, "what cannot happen is not drawn"


def test_policies_of_rows():
    rng = np.random.default_rng(23)
    model = random_sparse(rng, 4, most=3, width=2)
    assert model.num_rows > 4
    rows = np.asarray(model.row_start[1:] - 1)
    weight = np.asarray(operators.policy_distribution(model, rows))
    np.testing.assert_array_equal(np.flatnonzero(weight), rows)
    valid = jax.jit(lambda policy, where: operators.valid_policy(model, policy, where).valid)
    everywhere, wrong = np.ones(4, bool), rows.copy()
    wrong[0] = rows[1]
    for policy, good in (
        (rows, True),
        (weight, True),
        (wrong, False),
        (2 * weight, False),
        (weight - 1, False),
        (np.where(weight > 0, np.nan, 0), False),
    ):
        assert bool(valid(policy, everywhere)) == good
    assert valid(wrong, everywhere[:4] & (np.arange(4) > 0))
    last = np.diff(model.row_start) - 1
    operators.require_policy(model, last)
    operators.require_policy(model, weight)
    for policy in (last + 1, 2 * weight, weight - 1, np.where(weight > 0, np.nan, 0)):
        with pytest.raises(ValueError, match="state 0"):
            operators.require_policy(model, policy)
    operators.require_policy(model, last + (np.arange(4) == 0), np.arange(4) > 0)
    for shape in (model.num_rows + 1, 3):
        with pytest.raises(ValueError, match="policy has shape"):
            operators.policy_distribution(model, np.zeros(shape))
    with pytest.raises(ValueError, match="a deterministic policy"):
        operators.policy_distribution(model, np.zeros(3, int))


def test_products_of_dense_matrices_are_in_full_precision():
    """GPUs multiply matrices of float32 in 10 bits by default, which no bound includes."""
    model = jl.models.to_dense(jl.gridworld("a . b\n. . c"))
    policy = jnp.ones((model.num_states, model.num_actions)) / model.num_actions
    for function, argument in (
        (jl.models.expectation, jnp.ones(model.num_states)),
        (jl.models.pushforward, policy),
        (operators.transition_matrix, policy),
    ):
        program = str(jax.make_jaxpr(function)(model, argument))
        assert "precision=(Precision.HIGHEST, Precision.HIGHEST)" in program, function
        assert "precision=None" not in program, function
