"""A finite model as a world that is simulated: its states are the worlds."""

from __future__ import annotations

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.core.models.convert import to_padded
from jaxltl.core.models.environment import Environment, Timestep, box, make_environment
from jaxltl.core.models.mdp import MDP, DenseMDP
from jaxltl.core.models.operators import sample_successor
from jaxltl.core.models.sparse import SparseMDP


def environment_of(
    model: MDP | DenseMDP | SparseMDP,
    *,
    reward: ArrayLike | None = None,
    observe: Any = None,
) -> Environment:
    """The world that a finite Markov decision process is.

    Worlds are states, ``int32[]``; labels are the model's; the actions that may be taken are the
    available ones. Nothing ends an episode.

    Args:
      model: an MDP, a DenseMDP, or a SparseMDP, which is padded.
      reward: ``float[S]``, of the state that a step enters, or ``float[S, A]``, of an action;
        default zero.
      observe: ``state -> observation``; default one-hot, ``float[S]``.

    Returns:
      An :class:`~jaxltl.core.models.environment.Environment`.

    Raises:
      ValueError: rewards of another shape.

    Example:
      >>> from jaxltl.core.models.mdp import from_dense
      >>> coin = environment_of(from_dense(
      ...     [[[.5, .5]], [[0, 1]]], label=[[0], [1]], propositions=["heads"]))
      >>> coin.actions.num, coin.observations.shape, coin.labels(1).tolist()
      (1, (2,), [True])
    """
    if isinstance(model, SparseMDP):
        model = to_padded(model)
    size, num_actions = model.num_states, model.num_actions
    table = np.zeros(size) if reward is None else np.asarray(reward)
    if table.shape not in ((size,), (size, num_actions)) or table.dtype.kind not in "biuf":
        raise ValueError(
            f"reward has shape {list(table.shape)} and type {table.dtype}; give numbers [{size}], "
            f"of states, or [{size}, {num_actions}], of their actions.")
    table = table.astype(jnp.result_type(float))
    spaces = box(0, 1, (size,)) if observe is None else None
    return make_environment(
        Partial(_reset, model.initial), Partial(_step, model, table),
        Partial(_one_hot, model.initial) if observe is None else observe,
        actions=num_actions, labels=Partial(_labels, model.label), propositions=model.propositions,
        allowed=Partial(_available, model.available), observations=spaces)


def _reset(initial: jax.Array, key: chex.PRNGKey) -> jax.Array:
    return jax.random.choice(key, len(initial), p=jnp.asarray(initial)).astype(jnp.int32)


def _step(
    model: MDP | DenseMDP, reward: jax.Array, state: jax.Array, action: jax.Array,
    key: chex.PRNGKey,
) -> Timestep:
    after = sample_successor(model, key, state, action).astype(jnp.int32)
    table = jnp.asarray(reward)
    earned = table[after] if table.ndim == 1 else table[state, action]
    return Timestep(after, earned, terminated=jnp.bool_(False))


def _one_hot(initial: jax.Array, state: jax.Array) -> jax.Array:
    return jax.nn.one_hot(state, len(initial))


def _labels(label: jax.Array, state: jax.Array) -> jax.Array:
    return jnp.asarray(label)[state]


def _available(available: jax.Array, state: jax.Array) -> jax.Array:
    return jnp.asarray(available)[state]
