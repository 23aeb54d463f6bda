"""Candidate meanings from clusters of noisy observations, and networks that start from a grounding.

Example: noisy observations of two kinds of states.
  >>> import jax
  >>> import jax.numpy as jnp
  >>> import numpy as np
  >>> import jaxltl as jl
  >>> from jaxltl.algos import grounding
  >>> world = jl.from_dense([[[0, 1.0], [1.0, 0]], [[0, 1.0], [1.0, 0]]])
  >>> shown = jl.make_trajectories(world, [[(0, 0), (1, 0)], [(0, 0)]])
  >>> seen = np.array([[0.1, 2.9], [3.2, 0.0]])
  >>> problem = grounding.make_problem(world, seen, shown, "G !trap")
  >>> meaning = grounding.cluster_meanings(problem, 2)
  >>> meaning.shape, meaning.sum(0).tolist()  # [M, W, S]: each state is in one cluster
  ((2, 1, 2), [[1, 1]])
  >>> found = grounding.posterior(problem, grounding.Hparams(), meanings=meaning)
  >>> state = grounding.init(jax.random.key(0), problem, grounding.Hparams())
  >>> state = grounding.fit_labels(state, problem, found.labels(0), num_steps=200)
  >>> grounding.network_labels(state, problem, jnp.asarray(seen)).tolist()
  [[True], [False]]
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.typing import ArrayLike
from scipy.cluster.vq import kmeans2

from jaxltl.algos.common.settings import applied
from jaxltl.algos.grounding.learner import State
from jaxltl.algos.grounding.problem import Problem
from jaxltl.core.array_types import PyTree

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
    most = len(np.unique(rows, axis=0))
    if not 2 <= num_clusters <= most:
        raise ValueError(
            f"num_clusters={num_clusters}; it must be at least 2 and at most {most}, the number of "
            "distinct observations."
        )
    best = np.inf
    far = [int(((rows - rows.mean(0)) ** 2).sum(1).argmin())]  # rare kinds: the farthest first
    nearest = np.full(len(rows), np.inf)
    for _ in range(num_clusters - 1):
        nearest = np.minimum(nearest, ((rows - rows[far[-1]]) ** 2).sum(1))
        far.append(int(nearest.argmax()))
    starts = [(rows[far], "matrix"), *[(num_clusters, "++")] * _STARTS]
    for start, (first, minit) in enumerate(starts):
        centers, index = kmeans2(rows, first, minit=minit, seed=seed + start, missing="warn")
        distortion = float(((rows - centers[index]) ** 2).sum())
        if distortion < best and len(np.unique(index)) == num_clusters:
            best, kept = distortion, index
    order = np.argsort(-np.bincount(kept, minlength=num_clusters), kind="stable")
    return np.stack([(kept == k).reshape(table.shape[:2]) for k in order])


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
    expected = (*problem.observation.shape[:2], len(problem.symbols))
    if target.shape != expected:
        raise ValueError(f"labels has shape {target.shape}; expected {expected}.")
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
