"""Behavioral cloning conditioned on the automaton state (Wen 2019, section 3.5).

A network classifies the demonstrated action by a local observation and the state of the task's
automaton. It uses no model of the world.

Example: a policy of the state and the automaton state.
  >>> import jax, jax.numpy as jnp
  >>> import jaxltl as jl
  >>> from jaxltl.algos import behavioral_cloning as cloning
  >>> world = jl.make_mdp(  # an initial state, a goal and a trap
  ...     [[[1, 2], [0, 1]], [[1, 0], [0, 0]], [[2, 0], [0, 0]]],
  ...     [[[0.8, 0.2], [0.5, 0.5]], [[1, 0], [0, 0]], [[1, 0], [0, 0]]],
  ...     available=[[True, True], [True, False], [True, False]], initial=[1, 0, 0],
  ...     label=[[0, 0], [1, 0], [0, 1]], propositions=["g", "r"])
  >>> shown = jl.make_trajectories(world, [[(0, 1), (0, 0), (1, 0)], [(0, 0), (1, 0)]])
  >>> model = jl.product(world, "!r U g")
  >>> network = cloning.DensePolicy(num_actions=2, hidden=(4,))
  >>> problem = cloning.make_problem(model, jnp.eye(3), shown, network=network, held_out=0.5)
  >>> hparams = cloning.Hparams(batch=5)
  >>> state, metrics = cloning.train(jax.random.key(0), problem, hparams, num_steps=2)
  >>> metrics.loss.shape, jax.eval_shape(cloning.policy, state, problem, hparams).shape
  ((2,), (1, 3, 3, 2))
  >>> jax.eval_shape(lambda other: cloning.policy_in_world(
  ...     network, state.best.parameters, other, jnp.eye(3)), model).shape
  (3, 3, 2)
  >>> jax.eval_shape(cloning.neg_log_likelihood, state.parameters, problem, problem.counts).shape
  ()
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from jaxltl.algos.common import learner, optimizers, trees
from jaxltl.algos.common.actor_critic import summed_layers
from jaxltl.algos.common.learner import Best, stop_early
from jaxltl.algos.common.networks import NetworkLike, as_network
from jaxltl.algos.common.settings import COUNT, Number, RunState, require_output, static, traced
from jaxltl.core import struct
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.models import Product, Trajectories
from jaxltl.core.models.construct.batch import stack_models, stack_observations, training_counts
from jaxltl.core.validation import Range

# --- policy networks -----------------------------------------------------------------------------


class ConvolutionalPolicy(nn.Module):
    """The network of section 3.5: two convolutions and two dense layers with ReLU.

    Maps an observation ``float[..., O]``, an image, and a memory ``float[..., Q]``, which enters at
    the first dense layer, to scores ``float[..., A]``.

    Attributes:
      observation_shape: height, width and channels; section 3.5 has (3, 3, 5).
      num_actions: number of scores.
      kernels: number of kernels of each convolution, 2 x 2 with stride 1 and no padding.
      hidden: widths of the dense layers.

    >>> read = jnp.zeros((7, 45)), jnp.zeros((7, 2))
    >>> jax.eval_shape(
    ...     ConvolutionalPolicy().init_with_output, jax.random.key(0), *read)[0].shape
    (7, 4)
    """

    observation_shape: Sequence[int] = (3, 3, 5)
    num_actions: int = 4
    kernels: Sequence[int] = (12, 24)
    hidden: Sequence[int] = (100, 100)

    @nn.compact
    def __call__(self, observation: jax.Array, memory: jax.Array) -> jax.Array:
        rows = observation.shape[:-1]
        x = observation.reshape(-1, *self.observation_shape)
        for features in self.kernels:
            x = nn.relu(nn.Conv(features, (2, 2), padding="VALID")(x))
        return summed_layers(self, (x.reshape(*rows, -1), memory), (*self.hidden, self.num_actions))


class DensePolicy(nn.Module):
    """A multilayer perceptron with ReLU: ``float[..., O]`` and ``float[..., Q]`` to scores.

    `num_actions` is the number of scores, and `hidden` the widths of the hidden layers.
    """

    num_actions: int = 4
    hidden: Sequence[int] = (100, 100)

    @nn.compact
    def __call__(self, observation: jax.Array, memory: jax.Array) -> jax.Array:
        return summed_layers(self, (observation, memory), (*self.hidden, self.num_actions))


# --- the learner's data --------------------------------------------------------------------------


@struct.dataclass
class Problem:
    """Observations in worlds, and demonstrations.

    Attributes:
      observation: ``float[W, S, O]``, of each world state.
      available: ``bool[W, S, A]``.
      counts: ``float[W, S, Q, A]``, demonstrated state-action counts.
      held_out: counts of the held-out demonstrations for early stopping; may be zero.
      network: called as ``network(observation [..., O], memory [..., Q]) -> float[..., A]``,
        memory one-hot, scores (logits) of the actions; static.
    """

    observation: jax.Array
    available: jax.Array
    counts: jax.Array
    held_out: jax.Array
    network: NetworkLike = struct.field(pytree_node=False, default=ConvolutionalPolicy())


@struct.dataclass
class Hparams:
    """Settings; numbers are traced.

    Attributes:
      learning_rate: of Adam; default 3e-3.
      l2: at least 0; precision of the Gaussian prior, divided by the number of pairs; default 0.0.
      patience: steps without a better held-out likelihood after which learning stops; default 500.
      batch: pairs in a minibatch; static; default 128.
    """

    learning_rate: Number = traced(Range(0, open_above=True), default=3e-3)
    l2: Number = traced(Range(0, open_above=True), default=0.0)
    patience: Number = traced(Range(1), default=500)
    batch: int = static(COUNT, default=128)


@struct.dataclass
class State(RunState):
    """Parameters; once `stopped`, only the step counter changes.

    Attributes:
      parameters: of the network, a pytree.
      optimizer: optax's state.
      best: the best held-out parameters, :class:`~jaxltl.algos.common.learner.Best`.
      stopped: ``bool[]``, whether patience is exhausted.
    """

    parameters: PyTree
    optimizer: PyTree
    best: Best
    stopped: jax.Array


@struct.dataclass
class Metrics:
    """Figures of the parameters before a step; scalars, of a run ``[T]``.

    Attributes:
      loss: of the minibatch, in nats a pair, with the prior.
      held_out: negative log-likelihood of the average held-out pair; NaN without any.
      gradient_norm: Euclidean.
      status: NONFINITE if the loss or its gradient is no number, else COMPLETED.
    """

    loss: jax.Array
    held_out: jax.Array
    gradient_norm: jax.Array
    status: jax.Array


def make_problem(
    models: Product | Sequence[Product],
    observation: PyTree,
    demonstrations: Trajectories | Sequence[Trajectories],
    *,
    held_out: float | Trajectories | Sequence[Trajectories] | None = 0.2,
    network: NetworkLike | Callable[..., PyTree] | None = None,
) -> Problem:
    """A checked :class:`Problem` with arrays stacked over W worlds, on the host.

    Args:
      models: a product, several, or products stacked along a first axis of W worlds.
      observation: ``float[S, O]`` or ``float[W, S, O]``, or one for each world.
      demonstrations: in the world (not in the product), or one for each world.
      held_out: share of each world's trajectories, the last ones, or other trajectories, for early
        stopping; None or 0: no early stopping.
      network: the policy, of :func:`~jaxltl.algos.common.networks.as_network`; default
        :class:`ConvolutionalPolicy` with the models' number of actions.

    Raises:
      ValueError: worlds of different shapes, observations or scores of a wrong shape, or
        demonstrations that do not fit their world, or no counted pair.
    """
    models = stack_models(models)
    observation = stack_observations(models, observation)
    network = ConvolutionalPolicy(num_actions=models.num_actions) if network is None else network
    counts, other = training_counts(models, demonstrations, held_out)
    problem = Problem(
        observation=observation,
        available=jnp.asarray(models.mdp.available),
        counts=counts,
        held_out=other,
        network=as_network(network),
    )
    height_width_channels = getattr(problem.network, "observation_shape", None)
    size = problem.observation.shape[-1]
    if height_width_channels is not None and int(np.prod(height_width_channels)) != size:
        raise ValueError(
            f"an observation has {size} numbers, which do not fit the shape "
            f"{tuple(height_width_channels)}; set ConvolutionalPolicy(observation_shape=...)."
        )
    require_output(
        "the network's scores have",
        problem.network,
        _inputs(problem),
        counts.shape[1:],
        "one number for each state, memory and action.",
    )
    return problem


def _inputs(problem: Problem) -> tuple[jax.Array, jax.Array]:
    """Observation ``[S, 1, O]`` of the first world and memory ``[1, Q, Q]``."""
    memory = jnp.eye(problem.counts.shape[2], dtype=problem.observation.dtype)
    return problem.observation[0, :, None], memory[None]


def policy_in_world(
    network: NetworkLike, parameters: PyTree, model: Product, observation: jax.Array
) -> jax.Array:
    """The policy ``float[S, Q, A]`` in any world, zero at unavailable actions.

    Of a `network` with `parameters` in a `model`, the product of the world and the task, by the
    `observation` ``float[S, O]``. Differentiable in the parameters.
    """
    memory = jnp.eye(model.num_memory, dtype=observation.dtype)[None]
    scores: PyTree = as_network(network).apply(parameters, observation[:, None], memory)
    return jax.nn.softmax(jnp.where(model.available, scores, -jnp.inf), axis=-1)


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The best policy so far in the problem's worlds: ``float[W, S, Q, A]``; see :func:`policy_in_world`."""
    scores = _scores(state.best.parameters, problem)
    return jax.nn.softmax(jnp.where(problem.available[:, :, None], scores, -jnp.inf), axis=-1)


def _scores(parameters: PyTree, problem: Problem) -> jax.Array:
    memory = jnp.eye(problem.counts.shape[2], dtype=problem.observation.dtype)[None, None]
    return jnp.asarray(problem.network.apply(parameters, problem.observation[:, :, None], memory))


# --- learning -------------------------------------------------------------------------------------


def neg_log_likelihood(parameters: PyTree, problem: Problem, counts: jax.Array) -> jax.Array:
    """The negative log-likelihood (3.10) of the average pair in `counts`, in nats; NaN without any.

    Differentiable in the `parameters` of the network of the `problem`.
    """
    log_policy = _log_policy(_scores(parameters, problem), problem.available[:, :, None])
    return -jnp.sum(counts * log_policy) / jnp.sum(counts)


def _log_policy(scores: jax.Array, available: jax.Array) -> jax.Array:
    log_policy = jax.nn.log_softmax(jnp.where(available, scores, -jnp.inf), axis=-1)
    return jnp.where(available, log_policy, 0)


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """A state at the network's own random start; the key is kept."""
    dtype = problem.observation.dtype
    drawn = problem.network.init(learner.init_key(key), *_inputs(problem))
    parameters = jax.tree.map(lambda x: jnp.asarray(x, dtype), drawn)
    return State(
        key=key,
        step=jnp.int32(0),
        parameters=parameters,
        optimizer=optimizers.start(hparams, parameters),
        best=Best(parameters, jnp.asarray(jnp.inf, dtype), jnp.int32(0)),
        stopped=jnp.bool_(False),
    )


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """One step of Adam on a minibatch, drawn with replacement from the demonstrated pairs."""
    pairs = _draw(learner.step_key(state), problem.counts, hparams.batch)

    def objective(parameters: PyTree) -> tuple[jax.Array, None]:
        w, s, q, a = pairs
        memory = jax.nn.one_hot(q, problem.counts.shape[2], dtype=problem.observation.dtype)
        scores: PyTree = problem.network.apply(parameters, problem.observation[w, s], memory)
        log_policy = _log_policy(scores, problem.available[w, s])
        fit = -jnp.mean(jnp.take_along_axis(log_policy, a[:, None], axis=-1))
        squares = sum(jnp.sum(x * x) for x in jax.tree.leaves(parameters))
        return fit + hparams.l2 / 2 * squares / jnp.sum(problem.counts), None

    loss, _, norm, *new = optimizers.descend(objective, state, hparams)
    held_out = neg_log_likelihood(state.parameters, problem, problem.held_out)
    best, stopped = stop_early(
        state, new[0], held_out, jnp.any(problem.held_out > 0), hparams.patience
    )
    parameters, optimizer = trees.choose(stopped, [state.parameters, state.optimizer], new)
    finite = jnp.isfinite(loss) & jnp.isfinite(norm)
    metrics = Metrics(
        loss=loss,
        held_out=held_out,
        gradient_norm=norm,
        status=learner.completion_status(finite, finite),
    )
    return State(
        key=state.key,
        step=state.step + 1,
        parameters=parameters,
        optimizer=optimizer,
        best=best,
        stopped=stopped,
    ), metrics


def _draw(key: Key, counts: jax.Array, num: int) -> tuple[jax.Array, ...]:
    """Indices ``int32[num]`` on each axis of `counts`, with probabilities proportional to them."""
    total = jnp.cumsum(counts.ravel())
    point = jax.random.uniform(key, (num,), total.dtype) * total[-1]
    # Rounding must not lead beyond the last counted pair.
    last = jnp.searchsorted(total, total[-1])
    index = jnp.minimum(jnp.searchsorted(total, point, side="right"), last)
    return jnp.unravel_index(index, counts.shape)


init, step, run, train, run_until, train_until = learner.bind(_init, _step)
