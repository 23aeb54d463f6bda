"""Symbol grounding by gradients: maximum likelihood over soft groundings and a hidden memory.

The demonstrator follows the soft policy of the event reward in the soft product of the world and the task.
Parameters are those of the grounding ``g(symbol | observation)``, the logarithm of the
reward's scale, and the weights of features. The likelihood is differentiated implicitly through
:func:`~jaxltl.core.values.discounted.soft.soft_value`. Many random starts are a ``vmap`` over keys.

Example: the goal is not labelled, but what is seen there differs.
  >>> import jax, jax.numpy as jnp
  >>> import jaxltl as jl
  >>> from jaxltl.algos import grounding
  >>> world = jl.from_dense([[[0, 1.0], [1.0, 0]], [[0, 1.0], [1.0, 0]]])
  >>> shown = jl.make_trajectories(world, [[(0, 0), (1, 1)]])
  >>> problem = grounding.make_problem(world, jnp.eye(2), shown, "F goal")
  >>> hparams = grounding.Hparams(discount=0.5)
  >>> state, metrics = grounding.train(jax.random.key(0), problem, hparams, num_steps=2)
  >>> metrics.loss.shape, bool(metrics.loss[1] < metrics.loss[0])
  ((2,), True)
  >>> grounding.policy(state, problem, hparams).shape  # [W, S, Q, A]
  (1, 2, 2, 2)
  >>> loss, parts = grounding.objective(state.parameters, problem, hparams)
  >>> parts.log_likelihood.shape  # [N]
  (1,)

Example: meanings from clusters of noisy observations, and a network that starts from a grounding.
  >>> seen = jnp.array([[0.1, 2.9], [3.2, 0.0]])
  >>> problem = grounding.make_problem(world, seen, shown, "F goal")
  >>> meaning = grounding.cluster_meanings(problem, 2)
  >>> meaning.shape, meaning.sum(0).tolist()  # [M, W, S]: each state is in one cluster
  ((2, 1, 2), [[1, 1]])
  >>> found = grounding.posterior(problem, hparams, meanings=meaning)
  >>> state = grounding.init(jax.random.key(0), problem, hparams)
  >>> state = grounding.fit_labels(state, problem, found.labels(0), learning_rate=0.1)
  >>> bool((grounding.network_labels(state, problem, seen) == found.labels(0)[0]).all())
  True
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.typing import ArrayLike
from scipy.cluster.vq import kmeans2

from jaxltl.algos.common import learner, optimizers, trees
from jaxltl.algos.common.settings import RunState, applied
from jaxltl.algos.grounding.problem import (
    Hparams,
    Problem,
    forward,
    letter_log_probability,
    memory_log_moves,
    mean_event_reward,
    soft_product,
)
from jaxltl.core import struct
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.models.product import Product
from jaxltl.core.types import require_shape
from jaxltl.core.values.discounted.soft import policy_logits, soft_value


@struct.dataclass
class State(RunState):
    """Parameters of a run.

    Attributes:
      parameters: ``{"grounding": of the network, "log_scale": float[], "weights": float[F]}``.
      optimizer: optax's state.
    """

    parameters: PyTree
    optimizer: PyTree


@struct.dataclass
class Metrics:
    """Figures of the parameters before a step; scalars, of a run ``[T]``.

    Attributes:
      loss: the objective, with the prior and the entropy.
      neg_log_likelihood: in nats, over all demonstrations.
      entropy: mean entropy of the letters in all states, in nats.
      gradient_norm: Euclidean.
      status: of the solver, the worst over the worlds.
    """

    loss: jax.Array
    neg_log_likelihood: jax.Array
    entropy: jax.Array
    gradient_norm: jax.Array
    status: jax.Array


@struct.dataclass
class GroundingObjective:
    """Terms of the loss.

    Attributes:
      log_likelihood: ``float[N]``, of each demonstration, in nats.
      entropy: ``float[]``, mean entropy of the letters.
      policy: ``float[W, S, Q, A]``, the soft policy.
      letter: ``float[W, S, L]``, probabilities of the letters.
      status: ``int32[]``, of the solvers.
    """

    log_likelihood: jax.Array
    entropy: jax.Array
    policy: jax.Array
    letter: jax.Array
    status: jax.Array


def objective(
    parameters: PyTree, problem: Problem, hparams: Hparams
) -> tuple[jax.Array, GroundingObjective]:
    """``-sum_n log sum_q prod_t pi(a_t | s_t, q_t) M(s_t, q_{t-1}, q_t) + penalties``.

    The loss ``float[]`` adds ``l2 / 2`` times the squared parameters of grounding and features and
    ``entropy_weight`` times the number of demonstrated steps times the mean entropy of the letters.
    Differentiable in the `parameters` of a `problem` with `hparams`, implicitly through the soft value.
    """
    log_policy, log_moves, letter, status = trees.each_world(
        partial(_lane, problem, hparams, parameters),
        problem.model,
        problem.observation,
        problem.features,
    )
    initial = jnp.asarray(problem.model.automaton.initial)[0]

    def one(world: jax.Array, state: jax.Array, action: jax.Array, length: jax.Array) -> jax.Array:
        moves = log_moves[world, state]  # [T, Q, Q]
        return forward(moves[0, initial], log_policy[world, state, :, action], moves[1:], length)

    log_likelihoods = jax.vmap(one)(problem.world, problem.state, problem.action, problem.length)
    entropy = -jnp.mean(jnp.sum(jax.scipy.special.xlogy(letter, letter), axis=-1))
    penalized = (parameters["grounding"], parameters["weights"])
    squares = sum(jnp.sum(x * x) for x in jax.tree.leaves(penalized))
    loss = -jnp.sum(log_likelihoods) + hparams.l2 / 2 * squares
    loss += hparams.entropy_weight * jnp.sum(problem.length) * entropy
    parts = GroundingObjective(
        log_likelihood=log_likelihoods,
        entropy=entropy,
        policy=jnp.exp(log_policy),
        letter=letter,
        status=jnp.max(status),
    )
    return loss, parts


def _lane(
    problem: Problem,
    hparams: Hparams,
    parameters: PyTree,
    model: Product,
    observation: jax.Array,
    features: jax.Array,
) -> tuple[jax.Array, ...]:
    """Policy and moves of the memory in log space, letters and the solver's status, in a world."""
    log_letter = letter_log_probability(
        problem.network, parameters["grounding"], observation, jnp.asarray(model.automaton.letters)
    )
    log_moves = memory_log_moves(log_letter, jnp.asarray(model.automaton.delta))
    letter = jnp.exp(log_letter)
    world = soft_product(model.mdp, jnp.exp(log_moves))
    reward = jnp.exp(parameters["log_scale"]) * mean_event_reward(model.mdp, letter, problem.event)
    reward += features @ parameters["weights"]
    flat = reward.reshape(world.num_states, -1)
    solution = soft_value(world, flat, hparams.discount)
    logits = policy_logits(world, flat, hparams.discount, solution.value)
    log_policy = jnp.where(world.available, jax.nn.log_softmax(logits, axis=-1), -jnp.inf)
    return log_policy.reshape(reward.shape), log_moves, letter, solution.status


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """A state at the network's own random start; the key is kept."""
    dtype = problem.model.dtype
    drawn = problem.network.init(learner.init_key(key), problem.observation)["params"]
    parameters = {
        "grounding": jax.tree.map(lambda x: jnp.asarray(x, dtype), drawn),
        "log_scale": jnp.log(jnp.asarray(hparams.scale, dtype)),
        "weights": jnp.zeros(problem.features.shape[-1], dtype),
    }
    parameters = trees.strong(parameters)
    return State(key, jnp.int32(0), parameters, optimizers.start(hparams, parameters))


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """One step of the optimiser on :func:`objective`; deterministic given the state."""
    loss_of = partial(objective, problem=problem, hparams=hparams)
    loss, parts, norm, *new = optimizers.descend(loss_of, state, hparams)
    metrics = Metrics(
        loss=loss,
        neg_log_likelihood=-jnp.sum(parts.log_likelihood),
        entropy=parts.entropy,
        gradient_norm=norm,
        status=parts.status,
    )
    return State(state.key, state.step + 1, *new), metrics


# Metrics describe the state before a step.
init, step, run, train, run_until, train_until = learner.bind(_init, _step)


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The soft policy in the soft products of all worlds: ``float[W, S, Q, A]``.

    Zero at unavailable actions.
    """
    return objective(state.parameters, problem, hparams)[1].policy


_STARTS = 20  # of k-means, of which the one with the least distortion is kept


def cluster_meanings(problem: Problem, num_clusters: int, *, seed: int = 0) -> np.ndarray:
    """The candidate meanings ``bool[M, W, S]`` of a `problem`, clusters of the observations of all states.

    For the argument ``meanings`` of :func:`~jaxltl.algos.grounding.hypotheses.posterior`, the largest one
    first. By k-means from the farthest-first traversal and 20 random starts (k-means++) of a `seed`, of
    which the least distortion is kept; M is `num_clusters`, states without an object included.

    Raises:
      ValueError: fewer than 2 clusters, or more than distinct observations.
    """
    table = np.asarray(problem.observation, float)
    rows = table.reshape(-1, table.shape[-1])
    num_distinct = len(np.unique(rows, axis=0))
    if not 2 <= num_clusters <= num_distinct:
        raise ValueError(
            f"num_clusters={num_clusters}; it must be at least 2 and at most {num_distinct}, the number of "
            "distinct observations."
        )
    best = np.inf
    farthest = [int(((rows - rows.mean(0)) ** 2).sum(1).argmin())]  # rare kinds: the farthest first
    nearest = np.full(len(rows), np.inf)
    for _ in range(num_clusters - 1):
        nearest = np.minimum(nearest, ((rows - rows[farthest[-1]]) ** 2).sum(1))
        farthest.append(int(nearest.argmax()))
    starts = [(rows[farthest], "matrix"), *[(num_clusters, "++")] * _STARTS]
    for start, (first, minit) in enumerate(starts):
        centers, index = kmeans2(rows, first, minit=minit, seed=seed + start, missing="warn")
        distortion = float(((rows - centers[index]) ** 2).sum())
        if distortion < best and len(np.unique(index)) == num_clusters:
            best, cluster = distortion, index
    order = np.argsort(-np.bincount(cluster, minlength=num_clusters), kind="stable")
    return np.stack([(cluster == k).reshape(table.shape[:2]) for k in order])


def fit_labels(
    state: State,
    problem: Problem,
    labels: ArrayLike,
    *,
    num_steps: int = 500,
    learning_rate: float = 0.01,
) -> State:
    """A `state` with the network of a `problem` fitted to labels, from which training goes on.

    To the `labels` ``bool[W, S, P]``, such as ``Posterior.labels`` of a grounding, by cross-entropy and
    `num_steps` full-batch steps of Adam at a `learning_rate`.

    Raises:
      ValueError: labels of another shape.
    """
    target = jnp.asarray(np.asarray(labels), problem.model.dtype)
    require_shape("labels", target, (*problem.observation.shape[:2], len(problem.symbols)))
    optimizer = optax.adam(learning_rate)

    def loss(parameters: PyTree) -> jax.Array:
        logits = applied(problem.network, parameters, problem.observation)
        return jnp.mean(optax.sigmoid_binary_cross_entropy(logits, target))

    def step(_: int, carry: tuple[PyTree, PyTree]) -> tuple[PyTree, PyTree]:
        parameters, memory = carry
        updates, memory = optimizer.update(jax.grad(loss)(parameters), memory)
        return optax.apply_updates(parameters, updates), memory

    own = state.parameters["grounding"]
    fitted, _ = jax.lax.fori_loop(0, num_steps, step, (own, optimizer.init(own)))
    return replace(state, parameters={**state.parameters, "grounding": fitted})


def network_labels(state: State, problem: Problem, observation: jax.Array) -> np.ndarray:
    """The labels ``bool[..., P]`` by the network of a `problem`: symbols of probability above a half.

    In a `state` of a run, or of :func:`fit_labels`, at an `observation` ``float[..., O]``, such as that of
    a new world; for :func:`~jaxltl.algos.grounding.answer.with_labels`.
    """
    return np.asarray(applied(problem.network, state.parameters["grounding"], observation)) > 0
