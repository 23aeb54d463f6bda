"""Networks of learners: modules of ``flax.linen``, and functions that make any callable with parameters.

A learner draws the parameters of each seed from its random key, and keeps them in its state. A module
of ``flax.linen`` has functions for that, ``init`` and ``apply``. Any other network is given as a
function of a random key that makes it: a module of ``flax.nnx``, or a callable pytree whose arrays are
the parameters, such as a ``jax.tree_util.Partial`` of a function and its parameters.

Example: a linear layer, as a function and its parameters.
  >>> import jax, jax.numpy as jnp
  >>> from jax.tree_util import Partial
  >>> from jaxltl.algos.common.networks import as_network
  >>> def layer(parameters, x):
  ...     return x @ parameters["weight"] + parameters["bias"]
  >>> def make(key):
  ...     return Partial(layer, {"weight": jax.random.normal(key, (3, 2)), "bias": jnp.zeros(2)})
  >>> network = as_network(make)
  >>> variables = network.init(jax.random.key(0), jnp.ones(3))
  >>> sorted(variables["params"]), network.apply(variables, jnp.ones(3)).shape
  (['0/0/bias', '0/0/weight'], (2,))
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple, Protocol

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Key, PyTree

_REMEDY = (
    "give a module of flax.linen, or a function of a random key that makes the network, such as "
    "lambda key: Net(rngs=nnx.Rngs(key))"
)


class NetworkLike(Protocol):
    """A network whose parameters lie outside of it, as modules of ``flax.linen`` are."""

    def init(self, key: Key, /, *read: PyTree) -> PyTree:
        """``{"params": parameters}``, random ones, for inputs like `read`."""

    def apply(self, variables: PyTree, /, *read: PyTree) -> PyTree:
        """The output for the inputs `read`."""

    def init_with_output(self, key: Key, /, *read: PyTree) -> PyTree:
        """The output, and what ``init`` returns."""


class _NetworkParts(NamedTuple):
    """What a made network consists of besides the values of its parameters."""

    structure: jax.tree_util.PyTreeDef
    shapes: Mapping[str, jax.Array | jax.ShapeDtypeStruct]
    others: dict[int, object]  # leaves that are no arrays, by their number
    graph: PyTree  # of a module of nnx


@dataclass(frozen=True)
class MadeNetwork:
    """The :class:`NetworkLike` of a function `make` of a random key; made by :func:`as_network`."""

    make: Callable[[Key], Callable[..., PyTree]]

    def init(self, key: Key, /, *read: PyTree) -> dict[str, dict[str, jax.Array]]:
        """``{"params": parameters}``, an array for each name."""
        return {"params": _split(self.make(key))[1]}

    def apply(self, variables: PyTree, /, *read: PyTree) -> PyTree:
        """The output for the inputs `read`."""
        parts, parameters = _parts_of(self.make), variables["params"]
        shapes = {name: jnp.shape(x) for name, x in parameters.items()}
        expected = {name: x.shape for name, x in parts.shapes.items()}
        if shapes != expected:
            raise ValueError(
                f"the parameters are not those of this network: {validation.shorten(shapes)}; "
                f"expected {validation.shorten(expected)}."
            )
        leaves = iter(parameters[name] for name in parts.shapes)
        number = len(parts.shapes) + len(parts.others)
        tree = jax.tree.unflatten(
            parts.structure,
            [parts.others[i] if i in parts.others else next(leaves) for i in range(number)],
        )
        if parts.graph is None:
            return tree(*read)
        return sys.modules["flax.nnx"].merge(parts.graph, tree)(*read)

    def init_with_output(self, key: Key, /, *read: PyTree) -> tuple[PyTree, PyTree]:
        """The output, and what :meth:`init` returns."""
        variables = self.init(key, *read)
        return self.apply(variables, *read), variables

    def initial_memory(self) -> PyTree:
        """That of the network, ``()`` without."""
        return getattr(self.make(jax.random.key(0)), "initial_memory", tuple)()


def as_network(network: PyTree) -> NetworkLike:
    """The :class:`NetworkLike` of a module of ``flax.linen``, or of a function of a random key.

    The function returns a callable with parameters: a module of ``flax.nnx``, whose ``nnx.Param`` they
    are, or a pytree, of whose leaves all arrays of floats are. Define it once: another function,
    even of the same text, compiles again.

    Raises:
      ValueError: no function of a key, or one that makes no callable, has no parameters, or keeps
        more than parameters.
    """
    if isinstance(network, nn.Module | MadeNetwork):
        return network
    if not callable(network) or isinstance(network, type) or _is_nnx(network):
        raise ValueError(f"network is {validation.shorten(network)}; {_REMEDY}.")
    try:
        hash(network)
        _parts_of(network)
    except TypeError as problem:
        raise ValueError(f"network cannot be called with a key: {problem}; {_REMEDY}.") from problem
    return MadeNetwork(network)


def _is_nnx(network: object) -> bool:
    nnx = sys.modules.get("flax.nnx")  # imported where a module is made
    return nnx is not None and isinstance(network, nnx.Module)


@cache
def _parts_of(make: Callable[[Key], Callable[..., PyTree]]) -> _NetworkParts:
    parts = []

    def trace(key: Key) -> PyTree:
        split, parameters = _split(make(key))
        parts.append(split)
        return parameters

    shapes = jax.eval_shape(trace, jax.random.key(0))
    # In the order of the leaves, which eval_shape sorts by name.
    return parts[0]._replace(shapes={name: shapes[name] for name in parts[0].shapes})


def _split(network: PyTree) -> tuple[_NetworkParts, dict[str, jax.Array]]:
    """A network's parts, and its parameters by name."""
    if not callable(network):
        raise ValueError(
            f"the function that makes the network returns {type(network).__name__}, which is not "
            "callable; let it return the network."
        )
    tree, graph = network, None
    if _is_nnx(network):
        nnx = sys.modules["flax.nnx"]
        graph, tree, more = nnx.split(network, nnx.Param, ...)
        if kept := sorted({type(x).__name__ for x in jax.tree.leaves(more, is_leaf=_is_variable)}):
            raise ValueError(
                f"network keeps {kept} besides its parameters, nnx.Param; remove what is not "
                "learned by gradients."
            )
    leaves, structure = jax.tree_util.tree_flatten_with_path(tree)
    parameters, others = dict[str, jax.Array](), dict[int, object]()
    for i, (path, leaf) in enumerate(leaves):
        name = jax.tree_util.keystr(path, simple=True, separator="/")
        name = name if graph is None else name.removesuffix("/value")
        if not isinstance(leaf, jax.Array | np.ndarray):
            others[i] = leaf
        elif jnp.issubdtype(leaf.dtype, jnp.floating):
            parameters[name] = jnp.asarray(leaf)
        else:
            raise ValueError(
                f"network keeps {name}, {leaf.dtype}, besides its parameters, which are arrays of "
                "floats; make it a static field."
            )
    if not parameters:
        raise ValueError(f"network is a {type(network).__name__} without parameters; {_REMEDY}.")
    return _NetworkParts(structure, parameters, others, graph), parameters


def _is_variable(leaf: object) -> bool:
    return isinstance(leaf, sys.modules["flax.nnx"].Variable)
