"""Fewer actions: a narrowed model is the one whose other actions never were."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.graphs.attractor import almost_surely_reaching, attractor
from jaxltl.core.models.ops.operators import least_successor
from tests.support import REPRESENTATIONS, random_representation


def narrowed(seed, kind, **options):
    """A model with a mask, and a flat MDP that has the other actions made unavailable."""
    rng = np.random.default_rng(seed)
    model, explicit = random_representation(rng, kind, **options)
    allowed = rng.random(explicit.available.shape) < 0.6
    allowed &= explicit.available
    alone = np.argmax(explicit.available & (rng.random(allowed.shape) < 2), axis=1)
    allowed[np.arange(len(allowed)), alone] |= ~allowed.any(1)
    flat = jl.make_mdp(
        explicit.successor, explicit.probability, available=allowed, initial=explicit.initial
    )
    mask = allowed.reshape(*model.state_shape, -1)
    return rng, jl.with_allowed(model, mask), flat


def questions(model, region, value, reward, policy, *, compiled=True):
    """What is asked of a model, by primitives, on the graph and by solvers.

    Those that are compiled in any case need not be asked twice.
    """
    components = jl.graphs.end_components(model, jnp.ones(model.state_shape, bool))
    solved = (
        {
            "expectation": jl.models.expectation(model, value),
            "exists": jl.models.exists_successor(model, region),
            "forall": jl.models.forall_successor(model, region),
            "least": least_successor(model, jnp.arange(region.size).reshape(region.shape)),
            "pushforward": jl.models.pushforward(model, jnp.where(model.available, reward, 0)),
            "optimal": jl.optimal_value(model, reward, 0.9).value,
            "soft": jl.soft_value(model, reward, 0.9).policy,
            "boltzmann": jl.values.boltzmann_value(model, reward, 0.5).policy,
            "policy": jl.policy_value(model, policy, reward, 0.9).value,
            "occupancy": jl.occupancy_measure(model, policy, 0.9).value,
        }
        if compiled
        else {}
    )
    return {
        "available": model.available,
        "surely": almost_surely_reaching(model, region).region,
        "forced": attractor(model, region, rule="forall").region,
        "components": components.inside,
        "most": jl.reachability_probability(model, region).value,
        "least probability": jl.reachability_probability(model, region, objective="min").value,
        **solved,
    }


@pytest.mark.few(0, 1)
@pytest.mark.parametrize(
    "kind",
    [*sorted(REPRESENTATIONS), pytest.param("product on exit", marks=pytest.mark.exhaustive)],
)
def test_a_narrowed_model_has_no_other_actions(kind):
    options = {"label_on": "exit"} if "exit" in kind else {}
    if "product" not in kind:
        options["num_states"] = 12  # as many as products have, so that all are one program's
    rng, model, flat = narrowed(3, kind.split()[0], **options)
    shape = model.state_shape
    arrays = [
        rng.random(flat.num_states) < 0.3,
        rng.random(flat.num_states),
        rng.random((flat.num_states, flat.num_actions)),
    ]
    policy = np.where(flat.available, rng.random(flat.available.shape) + 0.1, 0)
    arrays.append(policy / policy.sum(1, keepdims=True))
    lazily = [x.reshape(*shape, *x.shape[1:]) for x in arrays]
    expected = questions(flat, *map(jnp.asarray, arrays))
    traced = jax.jit(questions)(model, *map(jnp.asarray, lazily))
    on_host = questions(model, *map(jnp.asarray, lazily), compiled=False)
    assert len(traced) == len(expected) == len(on_host) + 10
    for found in (on_host, traced):
        for name, one in found.items():
            other = np.asarray(one).reshape(np.shape(expected[name]))
            np.testing.assert_allclose(other, expected[name], atol=1e-9, err_msg=f"{kind}: {name}")


def test_the_best_of_a_narrowed_product():
    """For any task; the optimum may fall, and is that of the flat model's own."""
    _, model, _ = narrowed(11, "product", num_states=5, num_memory=2, acceptance="safety")
    whole = jl.optimal_satisfaction(model.replace(allowed=None))
    found = jl.optimal_satisfaction(model)
    assert (found.value <= whole.value + 1e-12).all() and (found.value < whole.value - 1e-3).any()
    chosen = np.take_along_axis(np.asarray(model.allowed), np.asarray(found.policy)[..., None], -1)
    assert chosen.all()
    attained = jl.satisfaction_probability(model, found.policy)
    np.testing.assert_allclose(attained.value, found.value, atol=1e-9)


def test_games_are_narrowed_too():
    _, model, flat = narrowed(7, "sparse")
    system = jnp.arange(flat.num_states) % 2 == 0
    reward = jnp.ones(flat.available.shape).at[:, 0].set(0.5)
    game = jl.with_allowed(
        jl.Game(model.replace(available=jnp.ones_like(model.available)), system), model.available
    )
    expected = jl.minimax_value(jl.Game(flat, system), reward, 0.9).value
    np.testing.assert_allclose(jl.minimax_value(game, reward, 0.9).value, expected, atol=1e-9)


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.ones((2, 2), int), r"allowed is int64\[2, 2\]; expected bool\[2, 2\]"),
        (np.ones((2, 3), bool), r"allowed is bool\[2, 3\]; expected bool\[2, 2\]"),
        (np.array([[True, True], [True, True]]), "action 1 is not available in state 1"),
        (np.array([[False, False], [True, False]]), "no action is left in state 0; allow one"),
    ],
)
def test_masks_that_fit_no_model_are_refused(mask, message):
    model = jl.from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 0]]])
    with pytest.raises(ValueError, match=message):
        jl.with_allowed(model, mask)


def test_a_refused_mask_names_the_memory():
    world = jl.from_dense([[[0.5, 0.5]]] * 2, label=[[0], [1]], propositions=["a"])
    model = jl.product(world, "F a")
    with pytest.raises(ValueError, match="no action is left in state 0 with memory 1"):
        jl.with_allowed(model, np.array([[[True], [False]]] * 2))


@pytest.mark.parametrize("intervals", [False, True])
def test_games_on_rows_are_narrowed_by_their_rows(intervals):
    world = jl.make_sparse([0, 2, 3], [0, 1, 2, 3], [0, 1, 1], [1.0, 1, 1], label={"a": [1]})
    base = jl.make_interval(world, [1.0, 1, 1], [1.0, 1, 1]) if intervals else world
    game, rows = jl.make_game(base, [True, True]), np.array([True, False, True])
    assert jl.reachability_probability(game, "a").value.tolist() == [1, 1]
    kept = jl.with_allowed(game, rows)
    assert jl.reachability_probability(kept, "a").value.tolist() == [0, 1]
    with pytest.raises(ValueError, match="restrict the world"):
        jl.with_allowed(jl.product(base, "F a"), np.ones((2, 2, 2), bool))
