"""Actor-critic collection and update: transitions, generalised advantages, minibatch epochs."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos.common import action_distributions as actions_of
from jaxltl.algos.common.actor_critic import Output
from jaxltl.core import struct
from jaxltl.core.array_types import Key, Numeric, PyTree
from jaxltl.core.environments.environment import Environment, Timestep, allowed_in
from jaxltl.core.environments.episodes import Agent

CarryT = TypeVar("CarryT")
FiguresT = TypeVar("FiguresT")
Evaluate = Callable[[PyTree, PyTree], Output]


class Transition(NamedTuple):
    """Record of a transition: observation, network's memory and action mask before it.

    `raw` is the sampled action before squashing, `log_density` its density under the collecting policy,
    and `last` the observation after it.
    """

    observation: PyTree
    memory: PyTree
    allowed: jax.Array | None
    raw: jax.Array
    log_density: jax.Array
    reward: jax.Array
    cost: jax.Array
    discount: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    last: PyTree


def transition(
    key: Key,
    environment: Environment,
    evaluate: Evaluate,
    squash: str | None,
    before: tuple[PyTree, PyTree],
    noise: jax.Array | None,
) -> tuple[PyTree, PyTree, Transition]:
    """World and memory after one transition of one environment, and its record."""
    world, memory = before
    observation, allowed = environment.observe(world), allowed_in(environment, world)
    output, actions = evaluate(memory, observation), environment.actions
    raw = actions_of.drawn(actions, output.action, allowed, noise)
    density = actions_of.log_density(actions, output.action, allowed, raw)
    after = Timestep(*environment.step(world, actions_of.as_action(actions, raw, squash), key))
    return (
        after.world,
        output.memory,
        Transition(
            observation=observation,
            memory=memory,
            allowed=allowed,
            raw=raw,
            log_density=density,
            reward=jnp.asarray(after.reward),
            cost=jnp.asarray(after.cost),
            discount=jnp.asarray(after.discount),
            terminated=jnp.asarray(after.terminated, bool),
            truncated=jnp.asarray(after.truncated, bool),
            last=environment.observe(after.world),
        ),
    )


def acting(
    evaluate: Partial,
    actions: actions_of.Actions,
    how: tuple[bool, str | None],
    memory: PyTree = (),
) -> Agent:
    """The agent of an actor `evaluate`; `how`: whether actions are sampled, and their squash."""
    finite = isinstance(actions, actions_of.Finite)
    act = Partial(_act, struct.Static(how), (actions, evaluate))
    return Agent(act, memory, _probabilities if finite else None)


def _probabilities(
    act: Partial, memory: PyTree, observation: PyTree, allowed: jax.Array | None
) -> jax.Array:
    """Probabilities ``float[A]`` of the actions of :func:`acting`."""
    how, (actions, evaluate) = act.args
    logits = evaluate(memory, observation).action
    if how.value[0]:
        return actions_of.probabilities(logits, allowed)
    action = actions_of.drawn(actions, logits, allowed, None)
    return jax.nn.one_hot(action, logits.shape[-1], dtype=logits.dtype)


def _act(
    how: struct.Static,
    actor: tuple[actions_of.Actions, Evaluate],
    memory: PyTree,
    observation: PyTree,
    allowed: jax.Array | None,
    key: Key,
) -> tuple[jax.Array, PyTree]:
    """An action; a sampled one fails without a key, by which proofs refuse it."""
    (sampled, squash), (actions, evaluate) = how.value, actor
    output = evaluate(memory, observation)
    action = actions_of.chosen(key, actions, output.action, allowed, sampled=sampled, squash=squash)
    return action, output.memory


def generalized_advantages(
    reward: jax.Array,
    value: jax.Array,
    following: jax.Array,
    discount: Numeric,
    gae_lambda: Numeric,
    ended: Numeric = False,
) -> jax.Array:
    """Generalised advantages (Schulman et al. 2016, equation 16) of consecutive episodes.

    ``A_t = d_t + discount_t lambda A_{t+1}`` with ``d_t = r_t + discount_t V'_t - V_t``, V' the value
    after each step, and A = 0 after the last step and after the end of an episode.
    """
    error = reward + discount * following - value
    decay = jnp.broadcast_to(jnp.where(ended, 0, discount * gae_lambda), error.shape)

    def back(later: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        error, decay = row
        now = error + decay * later
        return now, now

    return lax.scan(back, jnp.zeros_like(error[0]), (error, decay), reverse=True)[1]


def masked_advantages(
    signal: jax.Array,
    value: jax.Array,
    valid: jax.Array,
    discount: Numeric,
    gae_lambda: Numeric,
    last: Numeric = 0.0,
) -> jax.Array:
    """Generalised advantages, a trajectory for each column; zero where `valid` is false."""
    value = jnp.where(valid, value, 0)
    following = jnp.concatenate([value[1:], jnp.zeros_like(value[:1])])
    continues = jnp.concatenate([valid[1:], jnp.zeros_like(valid[:1])])
    following = jnp.where(valid, jnp.where(continues, following, last), 0)
    signal = jnp.where(valid, signal, 0)
    return generalized_advantages(signal, value, following, discount, gae_lambda)


def minibatch_epochs(
    key: Key,
    update: Callable[[CarryT, jax.Array], tuple[CarryT, FiguresT]],
    carry: CarryT,
    size: int,
    *,
    num_epochs: int,
    num_minibatches: int,
) -> tuple[CarryT, FiguresT]:
    """The carry after epochs of updates on shuffled minibatches of `size` indices, and figures."""
    used = size - size % num_minibatches

    def epoch(carry: CarryT, key: Key) -> tuple[CarryT, FiguresT]:
        order = jax.random.permutation(key, size)[:used]
        return lax.scan(update, carry, order.reshape(num_minibatches, -1))

    return lax.scan(epoch, carry, jax.random.split(key, num_epochs))
