"""Small fully connected networks on flat parameter vectors, for populations of policies.

A policy is a vector ``float[D]``. :func:`apply` evaluates one policy on many inputs;
:func:`apply_lanes` has policies (*lanes*) as last axes, which is far faster for a few nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jaxltl.core import struct, validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import (
    Box,
    Environment,
    Finite,
    clipped_action,
    flat_observation,
)
from jaxltl.core.environments.episodes import Agent

ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "relu": lambda x: jnp.maximum(x, 0),
    "tanh": jnp.tanh,
    "identity": lambda x: x,
}


@struct.dataclass
class Network:
    """A network without parameters, see :func:`make_network`.

    `sizes` are the inputs, the nodes of each hidden layer, and the outputs; `hidden` and `output` name
    :data:`ACTIVATIONS`; `biases` is True if the layers have biases.
    """

    sizes: tuple[int, ...] = struct.field(pytree_node=False)
    hidden: str = struct.field(pytree_node=False, default="relu")
    output: str = struct.field(pytree_node=False, default="identity")
    biases: bool = struct.field(pytree_node=False, default=True)

    @property
    def num_parameters(self) -> int:
        """D, the length of a parameter vector."""
        return num_parameters(self.sizes, self.biases)


def make_network(
    sizes: str | Sequence[int],
    *,
    hidden: str = "relu",
    output: str = "identity",
    biases: bool = True,
) -> Network:
    """A validated network.

    Args:
      sizes: such as ``"2-10-10-1"`` or ``(2, 10, 10, 1)``: inputs, hidden layers, outputs.
      hidden, output, biases: the activations, see :data:`ACTIVATIONS`, and biases of all nodes.

    Raises:
      ValueError: fewer than two sizes, a size below 1, or an unknown activation.

    >>> make_network("2-2-1").num_parameters, make_network("2-2-1", biases=False).num_parameters
    (9, 6)
    """
    try:
        numbers = tuple(int(n) for n in (sizes.split("-") if isinstance(sizes, str) else sizes))
    except ValueError:
        numbers = ()
    if len(numbers) < 2 or min(numbers) < 1:
        raise ValueError(
            f"sizes={sizes!r}; give the inputs, the hidden layers and the outputs, at least 1 "
            "each, such as '2-10-1'."
        )
    names = list(ACTIVATIONS)
    return Network(
        numbers,
        validation.choice("hidden", hidden, names),
        validation.choice("output", output, names),
        validation.boolean("biases", biases),
    )


def num_parameters(sizes: Sequence[int], biases: bool = True) -> int:
    """The number of parameters of layers of `sizes`, ``sum_l (n_l + [biases]) * n_(l+1)``.

    >>> num_parameters((62, 30, 30, 2))
    2882
    """
    return sum((n + bool(biases)) * m for n, m in pairwise(sizes))


Layers = list[tuple[jax.Array, jax.Array | None]]


def layers(network: Network, parameters: jax.Array) -> Layers:
    """The weights ``[inputs, outputs, lanes]`` and biases ``[outputs, lanes]`` of each layer.

    Args:
      network: from :func:`make_network`; a network without biases has None instead.
      parameters: ``float[D, lanes]``, with any number of axes of lanes: layer by layer, the weights row
        by row (a row for each input) and then the biases.

    Raises:
      ValueError: another number of parameters than the network has.

    >>> (weight, bias), = layers(make_network("2-1"), jnp.array([3.0, 4.0, 5.0]))
    >>> weight.tolist(), bias.tolist()
    ([[3.0], [4.0]], [5.0])
    """
    if parameters.ndim == 0 or len(parameters) != network.num_parameters:
        raise ValueError(
            f"parameters have shape {parameters.shape}; the network "
            f"{'-'.join(map(str, network.sizes))} with{'' if network.biases else 'out'} biases has "
            f"{network.num_parameters} parameters, on the first axis."
        )
    parts, place, lanes = [], 0, parameters.shape[1:]
    for n, m in pairwise(network.sizes):
        weight = parameters[place : place + n * m].reshape(n, m, *lanes)
        place += n * m
        bias = parameters[place : place + m] if network.biases else None
        place += m if network.biases else 0
        parts.append((weight, bias))
    return parts


def apply(network: Network, parameters: jax.Array, inputs: jax.Array) -> jax.Array:
    """The output of one `network`, ``a(h(x W_1 + b_1) ... W_n + b_n)``: ``float[..., O]``.

    `parameters` are ``float[D]``, see :func:`layers`, and `inputs` ``float[..., I]``; differentiable in
    both.

    >>> clip = make_network("1-2-1")  # relu(x + 1) - relu(x - 1) - 1
    >>> parameters = jnp.array([1.0, 1.0, 1.0, -1.0, 1.0, -1.0, -1.0])
    >>> apply(clip, parameters, jnp.array([[-3.0], [-0.5], [0.5], [3.0]])).ravel().tolist()
    [-1.0, -0.5, 0.5, 1.0]
    """
    return apply_layers(network, layers(network, parameters), inputs)


def apply_layers(network: Network, parts: Layers, inputs: jax.Array) -> jax.Array:
    """The :func:`apply` of a `network` to `inputs`, with parameters split by :func:`layers` into `parts`.

    For loops: inside of one, the parameters of many policies would be copied in every pass.

    Raises:
      ValueError: inputs or parts of another shape.

    >>> double = make_network("1-1", biases=False)
    >>> apply_layers(double, layers(double, jnp.array([2.0])), jnp.array([3.0])).tolist()
    [6.0]
    """
    if inputs.shape[-1:] != network.sizes[:1] or parts[0][0].ndim != 2:
        raise ValueError(
            f"inputs have shape {list(inputs.shape)} and the first weights "
            f"{list(parts[0][0].shape)}; give [..., {network.sizes[0]}] and "
            f"{list(network.sizes[:2])}."
        )
    for (weight, bias), activation in zip(parts, _activations(network), strict=True):
        inputs = inputs @ weight
        inputs = activation(inputs if bias is None else inputs + bias)
    return inputs


def padded(parts: Layers, multiple: int = 16) -> Layers:
    """The network of `parts` with hidden layers padded to a `multiple` of the vector width.

    The new nodes are zero and have no effect, for activations that are 0 at 0. For loops over small
    products of matrices.

    >>> parts = layers(make_network("3-5-1"), jnp.ones(26))
    >>> [weight.shape for weight, _ in padded(parts)]
    [(3, 16), (16, 1)]
    """
    wide_layers, inputs = [], parts[0][0].shape[0]
    for i, (weight, bias) in enumerate(parts):
        more = 0 if i == len(parts) - 1 else -weight.shape[1] % multiple
        weight = jnp.pad(weight, ((0, inputs - weight.shape[0]), (0, more)))
        wide_layers.append((weight, None if bias is None else jnp.pad(bias, (0, more))))
        inputs = weight.shape[1]
    return wide_layers


def apply_lanes(network: Network, parameters: jax.Array, inputs: jax.Array) -> jax.Array:
    """The :func:`apply` of a `network` with the axis of inputs first, and any axes of lanes last.

    Args:
      parameters: ``float[D, lanes]``, see :func:`layers`.
      inputs: ``float[I, ..., lanes]``: each lane's policy reads all inputs of its lane.

    Returns:
      ``float[O, ..., lanes]``.

    Raises:
      ValueError: incompatible shapes.

    >>> doubles_and_negates = jnp.array([[2.0, -1.0], [0.0, 0.0]])
    >>> apply_lanes(make_network("1-1"), doubles_and_negates, jnp.array([[3.0, 4.0]])).tolist()
    [[6.0, -4.0]]
    """
    lanes = parameters.shape[1:]
    outer = inputs.ndim - len(lanes)
    if outer < 1 or len(inputs) != network.sizes[0] or inputs.shape[outer:] != lanes:
        raise ValueError(
            f"inputs have shape {list(inputs.shape)}; give [{network.sizes[0]}, ...] that ends in "
            f"the lanes {list(lanes)} of the parameters {list(parameters.shape)}."
        )
    middle = (1,) * (outer - 1)
    for (weight, bias), activation in zip(
        layers(network, parameters), _activations(network), strict=True
    ):
        inputs = weighted(weight.reshape(*weight.shape[:2], *middle, *lanes), inputs)
        inputs = activation(
            inputs if bias is None else inputs + bias.reshape(len(bias), *middle, *lanes)
        )
    return inputs


def _activations(network: Network) -> list[Callable[[jax.Array], jax.Array]]:
    hidden = [ACTIVATIONS[network.hidden]] * (len(network.sizes) - 2)
    return [*hidden, ACTIVATIONS[network.output]]


def weighted(weight: jax.Array, inputs: jax.Array) -> jax.Array:
    """The sums ``sum_i w(i, o) x(i)`` in each lane, unrolled over i.

    A reduction would be a loop with strided memory access. `weight` is ``float[I, O, lanes]``, with the
    lanes of the `inputs` ``float[I, lanes]`` or 1.

    >>> weighted(jnp.array([[1.0, 2.0], [3.0, 4.0]]), jnp.array([1.0, 10.0])).tolist()
    [31.0, 42.0]
    """
    terms = [weight[i] * inputs[i] for i in range(len(inputs))]
    while len(terms) > 1:  # pairwise, which is also more exact
        terms = [sum(terms[i + 1 : i + 2], start=terms[i]) for i in range(0, len(terms), 2)]
    return terms[0]


# --- as agents ------------------------------------------------------------------------------------


def network_agent(network: Network, environment: Environment) -> Partial:
    """The policies of a `network` in an `environment`: ``parameters float[D] -> Agent``, a pytree.

    From the flattened observation, the outputs are the action, clipped to the box, or one number for
    each action, with a choice of the largest allowed one.

    Raises:
      ValueError: sizes that do not fit the observations or the actions.

    >>> from jaxltl import make_environment
    >>> from jaxltl.core.environments import Timestep
    >>> world = make_environment(
    ...     lambda key: jnp.ones(2), lambda x, a, key: Timestep(x, 0.0, False), lambda x: x,
    ...     actions=3)
    >>> agent = network_agent(make_network("2-3", biases=False), world)
    >>> act = agent(jnp.array([1.0, 2.0, 0.0, 0.0, 1.0, 0.0])).act
    >>> act((), jnp.ones(2), None, None)[0].tolist()
    1
    """
    actions, observations = environment.actions, environment.observations
    inputs = sum(
        math.prod(x.shape)
        for x in jax.tree.leaves(observations, is_leaf=lambda x: isinstance(x, Box))
    )
    outputs = actions.num if isinstance(actions, Finite) else math.prod(actions.shape)
    if (network.sizes[0], network.sizes[-1]) != (inputs, outputs):
        raise ValueError(
            f"the network has the sizes {network.sizes}; the environment has {inputs} "
            f"observations, its inputs, and its actions take {outputs} outputs."
        )
    return Partial(_agent, network, actions)


def _agent(network: Network, actions: Finite | Box, parameters: jax.Array) -> Agent:
    # Taken apart here, for inside of a loop over steps it would be in every pass.
    return Agent(Partial(_act, (network, actions, padded(layers(network, parameters)))))


def _act(
    policy: tuple[Network, Finite | Box, Layers],
    memory: PyTree,
    observation: PyTree,
    allowed: jax.Array | None,
    key: Key,
) -> tuple[jax.Array, PyTree]:
    network, actions, parts = policy
    said = apply_layers(network, parts, flat_observation(observation).astype(parts[0][0].dtype))
    if isinstance(actions, Box):
        return clipped_action(actions, said.reshape(actions.shape).astype(actions.dtype)), memory
    best = jnp.argmax(said if allowed is None else jnp.where(allowed, said, -jnp.inf))
    return best.astype(jnp.int32), memory
