"""Actor-critic networks for finitely many actions or a box, with or without memory.

>>> import jax, jax.numpy as jnp
>>> import jaxltl as jl
>>> from jaxltl.algos.common import actor_critic as networks
>>> seen = jax.ShapeDtypeStruct((3,), float)
>>> few = networks.default_network(jl.environments.Finite(4))
>>> shapes = jax.eval_shape(lambda x: few.init_with_output(jax.random.key(0), x)[0], seen)
>>> shapes[0].shape, shapes[1].shape  # logits, and a value
((4,), ())
>>> box = networks.ActorCritic(shape=(2,), hidden=(8,))
>>> (mean, log_deviation), value = jax.eval_shape(
...     lambda x: box.init_with_output(jax.random.key(0), x)[0], seen)
>>> mean.shape, log_deviation.shape
((2,), (2,))
>>> recurrent = networks.RecurrentActorCritic(num_actions=4, memory=5)
>>> memory = networks.initial_memory(recurrent)
>>> memory.shape
(5,)
>>> parameters = jax.eval_shape(
...     lambda x: networks.fresh_parameters(jax.random.key(0), recurrent, memory, x), seen)
>>> "actor" in parameters and "critic" in parameters
True
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, Protocol

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import DTypeLike

from jaxltl.algos.common.networks import NetworkLike
from jaxltl.algos.common.settings import applied
from jaxltl.core import validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import Box, Finite, flat_observation
from jaxltl.core.pretty_print import brief


class HasNetwork(Protocol):
    """A problem with a network and its initial memory, ``()`` without."""

    @property
    def network(self) -> NetworkLike:
        """The network."""

    @property
    def memory(self) -> PyTree:
        """Its initial memory."""


@brief
class Output(NamedTuple):
    """Output of an actor-critic network for one observation.

    Attributes:
      memory: the next one; ``()`` without memory.
      action: parameters of the distribution of actions: logits ``float[A]``, or for a box mean and
        log standard deviation, both of an action's shape.
      value: ``float[]``.
    """

    memory: PyTree
    action: PyTree
    value: jax.Array


def orthogonal(scale: float) -> Callable[..., jax.Array]:
    """An initialiser ``(key, shape, dtype) -> float[shape]`` of orthogonal matrices of a `scale`.

    By Gram-Schmidt twice over instead of LAPACK as in ``flax``: on few processors several batched
    LAPACK calls in one program may deadlock (jaxlib 0.10.1).

    >>> jax.eval_shape(lambda key: orthogonal(1.0)(key, (3, 2)), jax.random.key(0)).shape
    (3, 2)
    """

    def start(key: Key, shape: Sequence[int], dtype: DTypeLike | None = None) -> jax.Array:
        rows, columns = shape
        length, least = max(rows, columns), min(rows, columns)
        drawn = jax.random.normal(key, (least, length), dtype)

        def add(i: jax.Array, basis: jax.Array) -> jax.Array:
            row = drawn[i]
            for _ in range(2):
                row = row - (basis @ row) @ basis
            return basis.at[i].set(row / jnp.linalg.norm(row))

        basis = lax.fori_loop(0, least, add, jnp.zeros_like(drawn))
        return scale * (basis.T if rows == length else basis)

    return start


def dense(width: int, scale: float, name: str) -> nn.Dense:
    """A dense layer of `width` outputs with an orthogonal matrix of a `scale`, and its `name`.

    >>> dense(4, 1.0, "hidden").features
    4
    """
    return nn.Dense(
        width, kernel_init=orthogonal(scale), param_dtype=jnp.result_type(float), name=name
    )


class _HiddenLayers(nn.Module):
    """Hidden layers and a linear layer, orthogonal at initialisation."""

    hidden: Sequence[int]
    outputs: int
    last_scale: float
    activation: str

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        for i, width in enumerate(self.hidden):
            x = getattr(nn, self.activation)(dense(width, np.sqrt(2), f"hidden_{i}")(x))
        return dense(self.outputs, self.last_scale, "out")(x)


def summed_layers(
    module: nn.Module, inputs: Sequence[jax.Array], widths: Sequence[int]
) -> jax.Array:
    """A perceptron with ReLU, in a `module`, of the concatenation of `inputs` that broadcast.

    Layers have the given `widths`; the first one is a sum of one for each input, so that no input is
    repeated for each combination with the others.

    >>> class Sum(nn.Module):
    ...     @nn.compact
    ...     def __call__(self, x, y):
    ...         return summed_layers(self, (x, y), (4, 1))
    >>> read = jnp.zeros((5, 1, 3)), jnp.zeros((2, 6))
    >>> jax.eval_shape(Sum().init_with_output, jax.random.key(0), *read)[0].shape
    (5, 2, 1)
    """
    sizes = [x.shape[-1] for x in inputs]
    kernel = module.param("kernel", nn.initializers.lecun_normal(), (sum(sizes), widths[0]))
    bias = module.param("bias", nn.initializers.zeros_init(), (widths[0],))
    parts = jnp.split(kernel, np.cumsum(sizes)[:-1])
    first, *others = (x @ part for x, part in zip(inputs, parts, strict=True))
    x = first + sum(others, bias)
    rows = x.shape[:-1]
    x = x.reshape(-1, widths[0])  # matrix products are faster than batched ones
    for width in widths[1:]:
        x = nn.Dense(width)(nn.relu(x))
    return x.reshape(*rows, widths[-1])


def action_parameters(module: nn.Module, layer: Callable[[int], jax.Array]) -> PyTree:
    """The logits of a network `module`, or mean and log standard deviation, by a `layer` of outputs.

    >>> from types import SimpleNamespace
    >>> action_parameters(SimpleNamespace(num_actions=3), jnp.zeros).shape
    (3,)
    """
    if module.num_actions:
        return layer(module.num_actions)
    start = nn.initializers.constant(np.log(module.initial_deviation))
    log_deviation = module.param(
        "log_deviation", start, tuple(module.shape), jnp.result_type(float)
    )
    return layer(int(np.prod(module.shape))).reshape(module.shape), log_deviation


def _heads(module: nn.Module, x: jax.Array) -> tuple[PyTree, jax.Array]:
    """Action parameters and value, by two networks that share nothing."""
    layers = partial(_HiddenLayers, tuple(module.hidden), activation=module.activation)
    actor = action_parameters(module, lambda n: layers(n, 0.01, name="actor")(x))
    return actor, layers(1, 1.0, name="critic")(x)[0]


class ActorCritic(nn.Module):
    """Two multilayer perceptrons of the flattened observation: an actor and a critic.

    Orthogonal initialisation has scale sqrt(2) in hidden layers, .01 for the actor's output, so that
    all actions are alike at first, and 1 for the critic's (Huang et al. 2022, details 2 and 3).

    Attributes:
      num_actions: A, or 0 for a box.
      shape: of an action of a box; its log standard deviation is a parameter.
      hidden: widths of the hidden layers of each.
      activation: its name in ``flax.linen``.
      initial_deviation: of a box's actions, in units of half its width where it has bounds.
    """

    num_actions: int = 0
    shape: Sequence[int] = ()
    hidden: Sequence[int] = (64, 64)
    activation: str = "tanh"
    initial_deviation: float = 1.0

    @nn.compact
    def __call__(self, observation: PyTree) -> tuple[PyTree, jax.Array]:
        return _heads(self, flat_observation(observation))


class RecurrentActorCritic(nn.Module):
    """A dense layer and a gated recurrent unit, with the heads of :class:`ActorCritic` on its memory.

    Attributes:
      num_actions, shape, hidden, activation, initial_deviation: as there.
      memory: size of the memory.
    """

    num_actions: int = 0
    shape: Sequence[int] = ()
    hidden: Sequence[int] = (64,)
    memory: int = 64
    activation: str = "tanh"
    initial_deviation: float = 1.0

    def initial_memory(self) -> jax.Array:
        """``float[memory]``, zeros."""
        return jnp.zeros(self.memory, jnp.result_type(float))

    @nn.compact
    def __call__(self, memory: jax.Array, observation: PyTree) -> tuple[jax.Array, PyTree]:
        x = dense(self.memory, np.sqrt(2), "input")(flat_observation(observation))
        x = getattr(nn, self.activation)(x)
        cell = nn.GRUCell(
            self.memory,
            recurrent_kernel_init=orthogonal(1.0),
            param_dtype=jnp.result_type(float),
            name="cell",
        )
        memory, x = cell(memory, x)
        return memory, _heads(self, x)


def default_network(actions: Finite | Box) -> ActorCritic:
    """The :class:`ActorCritic` with its defaults for `actions`, finitely many or a box."""
    if isinstance(actions, Finite):
        return ActorCritic(num_actions=actions.num)
    return ActorCritic(shape=actions.shape)


def initial_memory(network: NetworkLike, memory: PyTree = None) -> PyTree:
    """The initial memory of a `network`, a tree of arrays; ``()`` without memory.

    A `memory` replaces that of the network's ``initial_memory()``.

    Raises:
      ValueError: not numbers, or shapes other than those of the network's own.
    """
    begin = getattr(network, "initial_memory", tuple)
    if memory is None:
        return jax.tree.map(jnp.asarray, begin())
    try:
        arrays = jax.tree.map(jnp.asarray, memory)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"memory is {validation.shorten(memory)}; give a tree of arrays of numbers."
        ) from None
    own = begin() if jax.tree.leaves(begin()) else arrays
    if jax.tree.map(jnp.shape, arrays) != jax.tree.map(jnp.shape, own):
        raise ValueError(
            f"memory has the shapes {jax.tree.map(jnp.shape, arrays)}, and that of the network "
            f"{jax.tree.map(jnp.shape, own)}; give one of those shapes, or none."
        )
    return arrays


def has_memory(problem: HasNetwork) -> bool:
    """``True`` if the network of a `problem` is recurrent: the problem's ``memory`` has arrays.

    >>> from types import SimpleNamespace
    >>> has_memory(SimpleNamespace(memory=())), has_memory(SimpleNamespace(memory=np.zeros(2)))
    (False, True)
    """
    return bool(jax.tree.leaves(problem.memory))


def evaluated(
    problem: HasNetwork, parameters: PyTree, memory: PyTree, observation: PyTree
) -> Output:
    """The :class:`Output` of the network of a `problem` for one `observation`.

    With its `parameters`, in which it is differentiable, and the `memory` before the observation.

    >>> from types import SimpleNamespace
    >>> problem = SimpleNamespace(network=ActorCritic(num_actions=2, hidden=()), memory=())
    >>> jax.eval_shape(lambda key, seen: evaluated(problem, fresh_parameters(
    ...     key, problem.network, (), seen), (), seen), jax.random.key(0), jnp.zeros(3)).action.shape
    (2,)
    """
    if has_memory(problem):
        memory, (action, value) = applied(problem.network, parameters, memory, observation)
    else:
        action, value = applied(problem.network, parameters, observation)
    return Output(memory, action, value)


def fresh_parameters(key: Key, network: NetworkLike, memory: PyTree, observation: PyTree) -> PyTree:
    """The random initial parameters of a `network`, of a `key`, a dict of dicts of arrays.

    Of the initial `memory`, ``()`` without, and one `observation` only the shapes matter.
    """
    read = (memory, observation) if jax.tree.leaves(memory) else (observation,)
    return network.init(key, *read).get("params", {})


def require_network(
    network: NetworkLike,
    memory: PyTree,
    observation: PyTree,
    space: jax.ShapeDtypeStruct,
    finite: bool,
) -> None:
    """Validation of a `network` by the shapes that it returns for `memory` and `observation`.

    `space` is the shape and type of one action, or if there are `finite` many, of the logits.

    Raises:
      ValueError: with the shapes returned and expected.

    >>> seen, logits = jax.ShapeDtypeStruct((3,), float), jax.ShapeDtypeStruct((2,), float)
    >>> require_network(ActorCritic(num_actions=2), (), seen, logits, True)
    """
    recurrent = bool(jax.tree.leaves(memory))
    read = (memory, observation) if recurrent else (observation,)
    wanted = "logits float[A]" if finite else "(mean, log_deviation)"
    form = f"(memory, ({wanted}, value))" if recurrent else f"({wanted}, value)"
    try:
        output, variables = jax.eval_shape(
            lambda *x: network.init_with_output(jax.random.key(0), *x), *read
        )
    except TypeError as problem:  # what a function says that is called with other arguments
        remembers = "; for one that remembers, give memory, or let initial_memory() return it"
        raise ValueError(
            f"network cannot be called as network({'memory, ' * recurrent}observation): {problem}. "
            f"Let it return {form}{'' if recurrent else remembers}."
        ) from problem
    if set(variables) - {"params"}:
        raise ValueError(
            f"network keeps {sorted(set(variables) - {'params'})} besides its parameters; remove "
            "collections that are not learned by gradients."
        )

    def shapes(tree: PyTree) -> PyTree:
        return jax.tree.map(lambda x: x.shape, tree)

    expected: PyTree = (space.shape if finite else (space.shape, space.shape), ())
    expected = (shapes(memory), expected) if recurrent else expected
    if shapes(output) != expected:
        raise ValueError(
            f"network returns shapes {shapes(output)} for one observation; expected {expected}, "
            f"{form}. It reads a single observation: many are a vmap."
        )
