"""Networks on flat vectors against plain loops, with and without lanes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.environments.environment import Timestep, make_box, make_environment
from jaxltl.envs.networks import (
    ACTIVATIONS,
    apply,
    apply_lanes,
    apply_layers,
    layers,
    make_network,
    network_agent,
    num_parameters,
    weighted,
)

RNG = np.random.default_rng(0)
PLAIN = {"relu": lambda x: max(x, 0.0), "tanh": np.tanh, "identity": lambda x: x}


def slowly(network, parameters, inputs):
    """One policy, one input: the numbers are taken one by one in the order of the vector."""
    numbers = iter(parameters.tolist())
    for i, (n, m) in enumerate(zip(network.sizes, network.sizes[1:], strict=False)):
        weight = [[next(numbers) for _ in range(m)] for _ in range(n)]
        bias = [next(numbers) for _ in range(m)] if network.biases else [0.0] * m
        last = i == len(network.sizes) - 2
        activation = PLAIN[network.output if last else network.hidden]
        inputs = [
            activation(sum(weight[k][j] * inputs[k] for k in range(n)) + bias[j]) for j in range(m)
        ]
    assert next(numbers, None) is None
    return inputs


CASES = [
    make_network("2-2-1"),
    make_network("2-10-10-1", biases=False),
    make_network((3, 5, 4, 2), hidden="tanh", output="relu"),
    make_network((7, 3), output="tanh"),
    make_network((4, 1, 2), hidden="identity"),
]


@pytest.mark.parametrize("network", CASES, ids=str)
def test_networks_against_a_plain_loop(network):
    parameters = RNG.normal(size=(6, network.num_parameters))
    inputs = RNG.normal(size=(6, 3, network.sizes[0]))
    expected = [
        [slowly(network, p, x) for x in rows] for p, rows in zip(parameters, inputs, strict=True)
    ]
    one = jax.jit(apply)
    alone = [one(network, p, x) for p, x in zip(parameters, inputs, strict=True)]
    np.testing.assert_allclose(alone, expected, rtol=1e-12, atol=1e-12)
    mapped = jax.jit(jax.vmap(lambda p, x: apply_layers(network, layers(network, p), x)))
    np.testing.assert_allclose(mapped(parameters, inputs), expected, rtol=1e-12, atol=1e-12)
    lanes = jax.jit(apply_lanes)(network, parameters.T, inputs.transpose(2, 1, 0))
    np.testing.assert_allclose(lanes.transpose(2, 1, 0), expected, rtol=1e-12, atol=1e-12)


def test_lanes_may_have_several_axes_or_none():
    network = make_network("2-3-2")
    parameters, inputs = RNG.normal(size=(network.num_parameters, 2, 3)), RNG.normal(size=(2, 2, 3))
    found = apply_lanes(network, jnp.asarray(parameters), jnp.asarray(inputs))
    one = apply_lanes(network, jnp.asarray(parameters[:, 1, 2]), jnp.asarray(inputs[:, 1, 2]))
    assert found.shape == (2, 2, 3)
    np.testing.assert_allclose(found[:, 1, 2], one, rtol=1e-12)
    np.testing.assert_allclose(one, slowly(network, parameters[:, 1, 2], inputs[:, 1, 2]))


@pytest.mark.parametrize("count", [1, 2, 3, 7, 62])
def test_written_out_sums(count):
    weight, inputs = RNG.normal(size=(count, 4, 5)), RNG.normal(size=(count, 5))
    np.testing.assert_allclose(
        weighted(jnp.asarray(weight), jnp.asarray(inputs)),
        np.einsum("iol,il->ol", weight, inputs),
        rtol=1e-12,
        atol=1e-12,
    )


def test_the_numbers_of_parameters():
    published = {"2-50-1": 150, "2-10-10-1": 130}  # dissertation, section 4.5.1, without biases
    for text, count in published.items():
        assert make_network(text, biases=False).num_parameters == count
    assert num_parameters((62, 30, 30, 2)) == 2882
    assert make_network("2-2-1") == make_network([2, 2, 1])
    assert not jax.tree.leaves(make_network("2-2-1")), "a network is no data"


@pytest.mark.parametrize("sizes", ["", "2", "2-0-1", "2--1", "a-b", (3,), (2, -1)])
def test_bad_sizes_are_refused(sizes):
    with pytest.raises(ValueError, match=r"give the inputs, the hidden layers and the outputs"):
        make_network(sizes)


def test_unknown_activations_are_refused():
    for place in ("hidden", "output"):
        with pytest.raises(ValueError, match=f"{place}='swish'; choose one of relu"):
            make_network("2-1", **{place: "swish"})
    assert set(ACTIVATIONS) == set(PLAIN)


def test_shapes_that_do_not_fit_are_refused():
    network = make_network("2-2-1")
    with pytest.raises(ValueError, match="2-2-1 with biases has 9 parameters"):
        apply(network, jnp.zeros(8), jnp.zeros(2))
    with pytest.raises(ValueError, match=r"give \[\.\.\., 2\]"):
        apply(network, jnp.zeros(9), jnp.zeros(3))
    with pytest.raises(ValueError, match=r"and \[2, 2\]"):
        apply(network, jnp.zeros((9, 4)), jnp.zeros((4, 2)))
    for inputs in ((3, 4), (2,), (2, 5)):
        with pytest.raises(ValueError, match=r"ends in the lanes \[4\]"):
            apply_lanes(network, jnp.zeros((9, 4)), jnp.zeros(inputs))


def world_of(actions, **more):
    return make_environment(
        lambda key: jnp.zeros(2),
        lambda world, action, key: Timestep(world, 0.0, False),
        lambda world: {"a": world, "b": world > 0},
        actions=actions,
        **more,
    )


def test_networks_act():
    """The nearest action of a box, or the best that is allowed."""
    parameters = jnp.asarray(np.random.default_rng(0).normal(size=20))
    seen = {"a": jnp.array([0.4, -0.3]), "b": jnp.array([True, False])}
    said = np.array([0.4, -0.3, 1.0, 0.0]) @ np.asarray(parameters[:16]).reshape(4, 4)
    said += np.asarray(parameters[16:])
    network = make_network("4-4")
    agent = network_agent(network, world_of(make_box(-0.5, 0.5, (2, 2))))(parameters)
    action, memory = agent.act((), seen, None, None)
    np.testing.assert_allclose(action, np.clip(said, -0.5, 0.5).reshape(2, 2))
    assert memory == () and np.abs(action).max() == 0.5
    agent = network_agent(network, world_of(4))(parameters)
    assert agent.act((), seen, None, None)[0] == said.argmax()
    allowed = np.arange(4) != said.argmax()
    assert (
        agent.act((), seen, jnp.asarray(allowed), None)[0]
        == np.where(allowed, said, -np.inf).argmax()
    )
    with pytest.raises(ValueError, match="4 observations, its inputs, and its actions take 3"):
        network_agent(network, world_of(3))
