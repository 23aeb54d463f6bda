"""Soft planning with a learned reward."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import lax

from jaxltl.algos.todirl.problem import Hparams, network_inputs
from jaxltl.core.array_types import PyTree
from jaxltl.core.models.construct.restrict import with_allowed
from jaxltl.core.models.product import Product
from jaxltl.core.types import Solution, status_code
from jaxltl.core.values.discounted.soft import policy_logits, soft_value


def reward(
    network: nn.Module, parameters: PyTree, model: Product, observation: jax.Array
) -> jax.Array:
    """The reward ``float[S, Q, A]`` of a `network` with `parameters` in a `model`, a product.

    By the `observation` ``float[S, O]``; differentiable in it and in the parameters.

    >>> from jaxltl import from_dense, product
    >>> world = from_dense([[[0, 1.0]], [[0, 1.0]]], label=[[0], [1]], propositions=["g"])
    >>> class Late(nn.Module):  # a reward of 1 in the final automaton state
    ...     def __call__(self, observation, memory, action):
    ...         return 0 * observation[..., 0] + memory[..., 1] + 0 * action[..., 0]
    >>> reward(Late(), {}, product(world, "F g"), jnp.eye(2)).shape
    (2, 2, 1)
    """
    return jnp.asarray(network.apply(parameters, *network_inputs(model, observation)))


def plan(
    network: nn.Module,
    parameters: PyTree,
    model: Product,
    observation: jax.Array,
    hparams: Hparams,
    *,
    allowed: jax.Array | None = None,
) -> Solution:
    """The soft value and policy (3.4), (3.5) of a learned reward in any world.

    Args:
      network, parameters: the reward.
      model: the product; its automaton has as many states as that of the training worlds.
      observation: ``float[S, O]``.
      hparams: discount, tolerance, method and horizon are read.
      allowed: ``bool[S, Q, A]``, action mask in this world; default all. Inside the optimal actions
        of its task the policy attains the optimal satisfaction probability.

    Returns:
      :class:`~jaxltl.core.types.Solution`, differentiable in the parameters; with a
      horizon, value and policy have a first axis of time. Batches of worlds by ``vmap``.

    Raises:
      ValueError: unknown method, or a mask that does not fit.
    """
    model = model if allowed is None else with_allowed(model, allowed)
    return soft_plan(reward(network, parameters, model, observation), model, hparams)


def soft_plan(
    rewards: jax.Array, model: Product, hparams: Hparams, initial: jax.Array | None = None
) -> Solution:
    """The soft value and policy of `rewards` in a `model`, by `hparams`, started at `initial`."""
    if hparams.horizon is not None:
        return backward_induction(rewards, model, hparams)
    return soft_value(
        model,
        rewards,
        hparams.discount,
        initial=initial,
        method=hparams.method,
        tolerance=hparams.tolerance,
    )


def backward_induction(rewards: jax.Array, model: Product, hparams: Hparams) -> Solution:
    """Soft values of a finite horizon, ``V_T = 0``, by backward induction; exact up to rounding."""
    rewards = jnp.asarray(rewards, model.dtype)
    discount = jnp.asarray(hparams.discount, model.dtype)

    def backup(value: jax.Array, _: None) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        logits = policy_logits(model, rewards, discount, value)
        value = jax.nn.logsumexp(logits, axis=-1)
        return value, (value, jax.nn.softmax(logits, axis=-1))

    horizon = int(hparams.horizon or 0)
    last = jnp.zeros(model.state_shape, model.dtype)
    _, (value, policy) = lax.scan(backup, last, None, length=horizon, reverse=True)
    exact = lax.stop_gradient(value)
    terms = model.num_successors + model.num_actions + 4
    size = jnp.max(jnp.abs(rewards)) + jnp.max(jnp.abs(exact))
    half = lax.stop_gradient(horizon * terms * jnp.finfo(model.dtype).eps * size)
    finite = jnp.all(jnp.isfinite(exact))
    return Solution(
        value=value,
        policy=policy,
        lower=exact - half,
        upper=exact + half,
        residual=jnp.zeros((), model.dtype),
        num_steps=jnp.int32(horizon),
        status=status_code(finite, finite),
    )
