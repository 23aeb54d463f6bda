"""Problems and settings of task-oriented deep inverse RL."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from jaxltl.algos.common import optimizers
from jaxltl.algos.common.settings import COUNT, Number, require_output, static, traced
from jaxltl.core import struct
from jaxltl.core.array_types import PyTree
from jaxltl.core.models import Product, Trajectories
from jaxltl.core.models.construct.batch import (
    restrict_stacked_actions,
    stack_models,
    stack_observations,
    training_counts,
    unstack_product as lane,
)
from jaxltl.core.models.ops.successor_tables import PredecessorTable, predecessor_table
from jaxltl.core.validation import Range


class RewardNetwork(nn.Module):
    """A multilayer perceptron with ReLU on (observation, memory, action).

    Maps ``float[..., O]``, ``float[..., Q]`` and ``float[..., A]``, which broadcast, to
    ``float[...]``. The first layer is a sum of three, so that no input is repeated for each
    combination with the others.

    Attributes:
      hidden: widths of the hidden layers; section 3.5 has two of 80. Empty: a linear reward.
    """

    hidden: Sequence[int] = (80, 80)

    @nn.compact
    def __call__(self, observation: jax.Array, memory: jax.Array, action: jax.Array) -> jax.Array:
        widths = (*self.hidden, 1)
        inputs = (observation, memory, action)
        sizes = [x.shape[-1] for x in inputs]
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (sum(sizes), widths[0]))
        bias = self.param("bias", nn.initializers.zeros_init(), (widths[0],))
        parts = jnp.split(kernel, np.cumsum(sizes)[:-1])
        terms = [x @ part for x, part in zip(inputs, parts, strict=True)]
        x = terms[0] + (terms[1] + terms[2] + bias)
        rows = x.shape[:-1]
        x = x.reshape(-1, widths[0])  # matrix products are faster than batched ones
        for width in widths[1:]:
            x = nn.Dense(width)(nn.relu(x))
        return x.reshape(rows)


class Concatenated(nn.Module):
    """A reward network from one of concatenated inputs, ``[..., O + Q + A] -> [...]`` or ``[..., 1]``.

    Attributes:
      network: the flax module, of vectors ``float[N, O + Q + A]``, or of any leading axes.

    >>> import jax
    >>> read = jnp.zeros((5, 3)), jnp.zeros((5, 2)), jnp.zeros((5, 4))
    >>> jax.eval_shape(Concatenated(nn.Dense(1)).init_with_output, jax.random.key(0), *read)[0].shape
    (5,)
    """

    network: nn.Module

    @nn.compact
    def __call__(self, observation: jax.Array, memory: jax.Array, action: jax.Array) -> jax.Array:
        inputs = (observation, memory, action)
        rows = jnp.broadcast_shapes(*(x.shape[:-1] for x in inputs))
        wide = [jnp.broadcast_to(x, (*rows, x.shape[-1])) for x in inputs]
        result = self.network(jnp.concatenate(wide, axis=-1))
        return result[..., 0] if result.shape == (*rows, 1) else result


@struct.dataclass
class Problem:
    """Products of worlds with the task, observations, and demonstrations.

    Attributes:
      model: products stacked along a first axis of W worlds.
      observation: ``float[W, S, O]``, of each world state.
      counts: ``float[W, S, Q, A]``, demonstrated state-action counts; with a horizon
        ``float[W, T, S, Q, A]``.
      held_out: counts of the held-out demonstrations for early stopping; may be zero.
      weight: ``float[W]``, factors of the worlds' likelihoods.
      predecessors: of the product states, with a first axis of W, for a faster gradient; or None.
      network: called as ``network(observation [S, 1, 1, O], memory [1, Q, 1, Q],
        action [1, 1, A, A]) -> float[S, Q, A]``, memory and action one-hot; static.
    """

    model: Product
    observation: jax.Array
    counts: jax.Array
    held_out: jax.Array
    weight: jax.Array
    predecessors: PredecessorTable | None = None
    network: nn.Module = struct.field(pytree_node=False, default=RewardNetwork())

    @property
    def horizon(self) -> int | None:
        """The number T of time steps of the counts, or None."""
        return self.counts.shape[1] if self.counts.ndim == 5 else None


@struct.dataclass
class Hparams:
    """Settings; numbers are traced.

    Attributes:
      discount: in [0, 1); with a horizon also 1.
      l2: at least 0; precision of the Gaussian prior on the parameters; default 1e-3.
      learning_rate: of all optimizers but ``lbfgs``; default 3e-3.
      patience: steps without a better held-out likelihood (with `mu`, plus the weighted satisfaction
        probability) after which learning stops; default 50.
      mu: weight of the satisfaction probability (2.6) from the initial states, or None; default None.
      tolerance: certified error of the soft values; None: the precision of the dtype; default None.
      optimizer: ``"lbfgs"``, or the name of one of optax, such as ``"adamw"``; static; default
        ``"adam"``.
      method: of :func:`~jaxltl.core.values.discounted.soft.soft_value`; static;
        default ``"value_iteration"``.
      horizon: number of steps, for a time-dependent policy, or None; static; default None.
    """

    discount: Number = traced(Range(0, 1))
    l2: Number = traced(Range(0, open_above=True), default=1e-3)
    learning_rate: Number = traced(Range(0, open_above=True), default=3e-3)
    patience: Number = traced(Range(1), default=50)
    mu: Number | None = traced(Range(0, open_above=True), default=None)
    tolerance: Number | None = traced(Range(0, open_above=True), default=None)
    optimizer: str = static(("lbfgs", *optimizers.NAMES), default="adam")
    method: str = static(("newton", "value_iteration"), default="value_iteration")
    horizon: int | None = static(COUNT, default=None)


def make_problem(
    worlds: Product | Sequence[Product],
    observation: PyTree,
    demonstrations: Trajectories | Sequence[Trajectories],
    *,
    held_out: float | Trajectories | Sequence[Trajectories] | None = 0.2,
    network: nn.Module | None = None,
    weight: PyTree = None,
    horizon: int | None = None,
    allowed: PyTree = None,
) -> Problem:
    """A checked :class:`Problem` with arrays stacked over W worlds, on the host.

    Args:
      worlds: a product, several, or products stacked along a first axis of W worlds.
      observation: ``float[S, O]``, or one for each world.
      demonstrations: in the world (not in the product), or one for each world.
      held_out: share of each world's trajectories, the last ones, or other trajectories, for early
        stopping; None or 0: no early stopping.
      network: the reward; default :class:`RewardNetwork`.
      weight: ``float[W]``, factors of the worlds' likelihoods; default 1.
      horizon: count pairs by time, for ``Hparams.horizon``.
      allowed: ``bool[S, Q, A]``, or one for each world: action mask of the policies; default all.
        Demonstrated steps outside of it do not count.

    Raises:
      ValueError: arguments of different or wrong shapes, demonstrations that do not fit their world or
        exceed the horizon, or no counted pair.
    """
    model = stack_models(worlds)
    if allowed is not None:
        model = restrict_stacked_actions(model, allowed)
    num_worlds, dtype = model.letter.shape[0], model.dtype
    observation = stack_observations(model, observation)
    counts, other = training_counts(model, demonstrations, held_out, horizon=horizon)
    weight = jnp.ones(num_worlds, dtype) if weight is None else jnp.asarray(weight, dtype)
    if weight.shape != (num_worlds,):
        raise ValueError(f"weight has shape {weight.shape}; expected {(num_worlds,)}.")
    network = RewardNetwork() if network is None else network
    inputs = network_inputs(model, observation[0])
    require_output(
        "the network's reward has",
        network,
        inputs,
        (*observation.shape[1:2], *(x.shape[-1] for x in inputs[1:])),
        "one number for each state, memory and action. A module on one vector is wrapped as "
        "Concatenated(module).",
    )
    return Problem(
        model=model,
        observation=observation,
        counts=counts,
        held_out=other,
        weight=weight,
        predecessors=predecessor_table([lane(model, w) for w in range(num_worlds)]),
        network=network,
    )


def network_inputs(
    model: Product, observation: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The network's inputs: observation, memory and action on their own axes."""
    num_memory, num_actions = model.num_memory, model.mdp.available.shape[-1]
    memory = jnp.eye(num_memory, dtype=observation.dtype)[None, :, None]
    action = jnp.eye(num_actions, dtype=observation.dtype)[None, None]
    return observation[:, None, None], memory, action
