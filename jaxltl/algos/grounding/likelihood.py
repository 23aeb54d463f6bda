"""Soft products, in which the memory moves with the probability of the letters, and likelihoods.

With the letter distribution ``lambda(l | s)`` of a grounding, the memory moves from q to q' on entering
s with probability ``M(s, q, q') = sum_l lambda(l | s) [delta(q, l) = q']``. The memory along a
demonstration is hidden; its likelihood sums over all memory paths by the forward recursion of hidden
Markov models (Rabiner 1989), in log space.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn

from jaxltl.algos.common.settings import Number, applied
from jaxltl.algos.grounding.problem import event_reward
from jaxltl.core.array_types import PyTree
from jaxltl.core.models import MDP, Product, expectation
from jaxltl.core.values.discounted.soft import policy_logits, soft_value

_TOLERANCE = 1e-3  # of soft values: changes a log-likelihood by as much a step
NEVER = -1e30  # logarithm of probability 0: finite, so that derivatives stay finite


def letter_log_probability(
    network: nn.Module, parameters: PyTree, observation: jax.Array, letters: jax.Array
) -> jax.Array:
    """``log lambda(l | s)``, ``float[..., L]``: independent symbols, conditioned on an existing letter.

    The softmax over letters of the sum of their symbols' logits: with all ``2^P`` letters the product
    of Bernoulli distributions of the symbols.
    """
    logits = applied(network, parameters, observation)
    return jax.nn.log_softmax(logits @ jnp.asarray(letters).T.astype(logits.dtype), axis=-1)


def memory_log_moves(log_letter: jax.Array, delta: jax.Array) -> jax.Array:
    """``log M(s, q, q')``, ``float[..., Q, Q]``, of letters ``float[..., L]`` and ``int32[Q, L]``."""
    to = jnp.asarray(delta)[:, None, :] == jnp.arange(len(delta))[:, None]  # [Q, Q', L]
    return jax.nn.logsumexp(jnp.where(to, log_letter[..., None, None, :], NEVER), axis=-1)


def soft_product(world: MDP, moves: jax.Array) -> MDP:
    """The MDP on states ``s * Q + q`` in which the memory moves with ``M``, ``float[S, Q, Q]``.

    Differentiable in `moves`. The successors of ``(s, q)`` are ``(t, q')`` with probability
    ``P(t | s, a) M(t, q, q')``.
    """
    num_memory = moves.shape[-1]
    count, actions, width = world.successor.shape
    after = moves[world.successor]  # [S, A, K, Q, Q']
    probability = world.successor_probability[..., None, None] * after
    probability = jnp.moveaxis(probability, 3, 1)  # [S, Q, A, K, Q']
    successor = world.successor[..., None] * num_memory + jnp.arange(num_memory)
    rows = (count * num_memory, actions)
    successor = jnp.broadcast_to(successor[:, None], probability.shape)
    return MDP(
        successor=successor.reshape(*rows, width * num_memory),
        probability=probability.reshape(*rows, width * num_memory),
        available=jnp.repeat(world.available, num_memory, axis=0),
        initial=jnp.zeros(rows[0], probability.dtype),
        label=jnp.zeros((rows[0], 0), bool),
    )


def motive(world: MDP, letter: jax.Array, event: jax.Array) -> jax.Array:
    """Expected reward ``float[S, Q, A]`` of the next event ``float[Q, L]``, by letters ``float[S, L]``."""
    return jax.vmap(lambda row: expectation(world, letter @ row), out_axes=1)(event)


def motive_policy(model: Product, scale: Number, discount: Number) -> jax.Array:
    """The demonstrator's policy for a task with known labels, ``float[S, Q, A]``.

    The soft policy of the motive in a `model` with the task: the events of
    :func:`~jaxltl.algos.grounding.problem.event_reward` times `scale`, at a `discount`.

    >>> import jaxltl as jl
    >>> world = jl.from_dense([[[0, 1.0], [1.0, 0]], [[0, 1.0], [1.0, 0]]], label={"g": [1]})
    >>> policy = motive_policy(jl.product(world, "F g"), 5.0, 0.9)
    >>> round(policy[0, 0, 0].item(), 2)
    0.69
    """
    event = jnp.asarray(event_reward(model.automaton), model.dtype)
    return jnp.exp(motive_log_policy(model, event, scale, discount))


def motive_log_policy(
    model: Product, event: jax.Array, scale: Number, discount: Number
) -> jax.Array:
    """Logarithm of the soft policy of events ``float[Q, L]`` in a product, ``float[S, Q, A]``."""
    letter = jax.nn.one_hot(model.letter, event.shape[1], dtype=model.dtype)
    reward = scale * motive(model.mdp, letter, event)
    solution = soft_value(model, reward, discount, tolerance=_TOLERANCE)
    return jax.nn.log_softmax(policy_logits(model, reward, discount, solution.value), axis=-1)


def forward(start: jax.Array, emit: jax.Array, move: jax.Array, length: jax.Array) -> jax.Array:
    """Log-likelihood ``float[]`` of a sequence with a hidden memory, by the forward recursion.

    Args:
      start: ``float[Q]``, logarithms of the first memory's probabilities.
      emit: ``float[T, Q]``, log-likelihoods of the steps in each memory state.
      move: ``float[T - 1, Q, Q]``, ``log M`` between the steps.
      length: ``int32[]``, number of steps that count.
    """

    def step(alpha: jax.Array, data: tuple[jax.Array, ...]) -> tuple[jax.Array, None]:
        emitted, moved, inside = data
        after = jax.nn.logsumexp(alpha[:, None] + moved, axis=0) + emitted
        return jnp.where(inside, after, alpha), None

    inside = jnp.arange(1, len(emit)) < length
    alpha, _ = jax.lax.scan(step, start + emit[0], (emit[1:], move, inside))
    total = jax.nn.logsumexp(alpha)
    return jnp.where(total > NEVER / 2, total, -jnp.inf)


def certain_memory(model: Product, state: jax.Array) -> jax.Array:
    """Memory states ``int32[T]`` along states ``int32[T]`` of a product with known letters."""
    letter = model.letter[state]
    first = model.automaton.delta[model.automaton.initial, letter[0]]

    def read(memory: jax.Array, one: jax.Array) -> tuple[jax.Array, jax.Array]:
        after = model.automaton.delta[memory, one]
        return after, after

    _, rest = jax.lax.scan(read, first, letter[1:])
    return jnp.concatenate([first[None], rest])
