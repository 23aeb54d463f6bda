"""Soft (maximum-entropy) values and the derivative of their policies."""

from __future__ import annotations

from dataclasses import replace
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp

from jaxltl.core.models.kernels import Predecessors, successors
from jaxltl.core.models.operators import (
    expectation,
    pushforward,
)
from jaxltl.core.types import Solution
from jaxltl.core.values.evidence import _attach, _certified, _Jacobian, _solution, expected_reward

_SWEEPS_BETWEEN = 4  # sweeps between two looks at what is left


@partial(jax.jit, static_argnames=("method",))
def soft_value(
    model: Any,
    reward: jax.Array,
    discount: jax.Array | float,
    *,
    initial: jax.Array | None = None,
    method: str = "newton",
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 100_000,
) -> Solution:
    """Soft (maximum-entropy) value, ``V = log sum_a exp(R + discount * P V)`` (3.4).

    Args:
      model: the model.
      reward: ``float[S, A]`` or ``float[S, A, K]``.
      discount: scalar in [0, 1).
      initial: ``float[S]``, where to start; default zero. It changes the number of steps only.
      method: ``"newton"`` (soft policy iteration, few linear solves, for any discount)
        or ``"value_iteration"`` (cheap sweeps).
      tolerance: certified absolute error asked for; default: what the dtype allows.
      max_steps: steps of the method at most.

    Returns:
      :class:`Solution`; `policy` is ``float[S, A]``, ``exp(Q - V)``.

    Raises:
      ValueError: the reward has the wrong shape, or an unknown method.

    Value and policy are differentiable in the reward, the discount and the
    probabilities. The bounds are certified: the soft operator is monotone and commutes
    with constants up to the discount, as MacQueen's bounds need.

    Example:
      >>> from jaxltl.core.models.mdp import from_dense
      >>> mdp = from_dense([[[1.0], [1.0]]])
      >>> round(soft_value(mdp, jnp.zeros((1, 2)), 0.5).value.item(), 4)  # 2 log 2
      1.3863
    """
    if method not in ("newton", "value_iteration"):
        raise ValueError(f"method={method!r}; choose newton or value_iteration.")
    reward = expected_reward(model, reward)
    discount = jnp.asarray(discount, model.dtype)

    def backup(v: jax.Array) -> jax.Array:
        return logsumexp(policy_logits(model, reward, discount, v), axis=-1)

    def jacobian(v: jax.Array) -> _Jacobian:
        policy = jax.nn.softmax(policy_logits(model, reward, discount, v), axis=-1)
        return lax.stop_gradient(_Jacobian(model, discount, policy))

    def body(carry):
        value, image, n, _ = carry
        value = jacobian(value).newton(value, image) if method == "newton" else image
        image = backup(value)
        *_, done, exhausted = _certified(model, reward, discount, tolerance, value, image)
        return value, image, n + 1, done | exhausted | ~jnp.isfinite(image.ravel()[0])

    def unfinished(carry):
        *_, n, done = carry
        return ~done & (n < max_steps)

    guess = jnp.zeros(model.state_shape, model.dtype) if initial is None else initial
    table = successors(model) if method == "value_iteration" else None
    if table is None:
        start = (guess, backup(guess), jnp.int32(1), jnp.bool_(False))
        value, image, n, _ = lax.stop_gradient(lax.while_loop(unfinished, body, start))
    else:
        value, image, n = _soft_iteration(
            model, table, reward, discount, tolerance, max_steps, guess)
    solution = _solution(model, reward, discount, tolerance, value, image, value, n)
    solution = _attach(solution, backup, jacobian(solution.value))
    return _with_softmax(model, reward, discount, solution)


def _soft_iteration(model, table, reward, discount, tolerance, max_steps, guess):
    """Sweeps of the soft backup on numbered states, action by action.

    The maximum and the sum over actions are then elementwise; as reductions over a short
    last axis they take several times as long. Certified every few sweeps.

    Returns:
      The last value but one, the last one, and the number of sweeps.
    """
    gains = _action_columns(
        model.num_actions, jnp.where(model.available, reward, -jnp.inf))
    size = jnp.max(jnp.abs(reward))[None]  # all that certifying reads of the reward

    def loop(table, gains, size, discount, tolerance, max_steps, value):
        def sweep(value):
            q = [g + discount * x for g, x in zip(gains, table.expectation(value), strict=True)]
            top = reduce(jnp.maximum, q)
            return top + jnp.log(reduce(jnp.add, [jnp.exp(x - top) for x in q]))

        def judged(carry):
            value, image, n, active = carry
            *_, done, exhausted = _certified(
                model, size, discount, tolerance, value, image, axis=0)
            ended = (done | exhausted | ~jnp.isfinite(image[0])) & (n > 0)
            return value, image, n, active & ~ended & (n < max_steps)

        def body(carry):
            value, image, n, active = judged(carry)

            def one(_, carry):
                value, image, n = carry
                goes = active & (n < jnp.maximum(max_steps, 1))
                keep = partial(jnp.where, goes)
                return keep(image, value), keep(sweep(image), image), n + goes

            return *lax.fori_loop(0, _SWEEPS_BETWEEN, one, (value, image, n)), active

        def unfinished(carry):
            # Judged where XLA does not compute the sweep again for every reduction.
            return jnp.any(judged(carry)[-1] | (carry[2] == 0))

        n = jnp.zeros(jnp.shape(value)[1:], jnp.int32)
        start = (value, value, n, jnp.ones(n.shape, bool))
        return lax.while_loop(unfinished, body, start)[:3]

    arguments = (gains, size, discount, tolerance, jnp.asarray(max_steps), guess.ravel())
    value, image, n = _lanes_last(loop, table, lax.stop_gradient(arguments))
    return value.reshape(guess.shape), image.reshape(guess.shape), n


def _lanes_last(loop, table: Any, arguments: tuple[Any, ...]) -> Any:
    """``loop(table, *arguments)``, whose lanes under ``vmap`` become a last axis.

    With the states first and the lanes side by side a gather moves whole rows, and what is
    computed of them is vectorised. `loop` takes arrays with or without that axis.
    """
    @jax.custom_batching.custom_vmap
    def one(table: Any, arguments: tuple[Any, ...]) -> Any:
        return loop(table, *arguments)

    @one.def_vmap
    def _(size: int, batched: Any, table: Any, arguments: tuple[Any, ...]) -> Any:
        of_table, of_arguments = batched
        if any(jax.tree.leaves(of_table)):
            axes = jax.tree.map(lambda b: 0 if b else None, (of_table, of_arguments))
            found = jax.vmap(lambda t, x: loop(t, *x), axes)(table, arguments)
        else:
            def last(x: jax.Array, b: bool) -> jax.Array:
                if b:
                    return jnp.moveaxis(x, 0, -1)
                return jnp.broadcast_to(x[..., None], (*x.shape, size))

            found = loop(table, *jax.tree.map(last, arguments, of_arguments))
            found = jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), found)
        return found, jax.tree.map(lambda _: True, found)

    return one(lax.stop_gradient(table), jax.tree.map(jnp.asarray, arguments))


def soft_policy_adjoint(
    model: Any,
    policy: jax.Array,
    discount: jax.Array | float,
    cotangent: jax.Array,
    *,
    predecessors: Predecessors | None = None,
    max_steps: jax.Array | int = 100_000,
) -> jax.Array:
    """The derivative of ``sum c log pi`` in the reward, for the soft policy pi of that reward.

    With ``g = c - pi sum_a c`` and x the solution of ``x = discount * P'(g + pi x)``, it is
    ``g + pi x``: the transpose of the sensitivity (3.6), one linear system for any number of
    parameters. Solved by sweeps, as the series ``sum_k (discount * P_pi')^k b``: what is left
    is known exactly and shrinks at the rate of the discount or faster.

    Args:
      model: the model.
      policy: ``float[S, A]``, of :func:`soft_value`.
      discount: scalar in [0, 1).
      cotangent: ``float[S, A]``, the weights c; zero at unavailable actions.
      predecessors: of the model (without their leading axis), which make it faster.
      max_steps: sweeps at most.

    Returns:
      ``float[S, A]``.
    """
    shape = policy.shape[:-1]
    discount = jnp.asarray(discount, policy.dtype)
    columns = partial(_action_columns, model.num_actions)
    g = cotangent - policy * jnp.sum(cotangent, axis=-1, keepdims=True)

    def loop(before, weights, g, discount, max_steps):
        def push(mass):
            """The discounted flow ``[N]`` of masses ``[N]`` of the actions."""
            if before is not None:
                return discount * before.pushforward(jnp.concatenate(mass))
            return discount * pushforward(model, jnp.stack(mass, -1).reshape(policy.shape)).ravel()

        def sweep(_, carry):
            x, r, n, active = carry
            x = x + jnp.where(active, r, 0)
            return x, jnp.where(active, push([w * r for w in weights]), r), n + active, active

        def judged(carry):
            x, r, n, active = carry
            return x, r, n, active & (jnp.sum(jnp.abs(r), 0) > target) & (n < max_steps)

        b = push(g)
        target = float(jnp.finfo(b.dtype).eps) ** 0.8 * jnp.sum(jnp.abs(b), 0)
        n = jnp.zeros(b.shape[1:], jnp.int32)
        x, r, *_ = lax.while_loop(
            lambda carry: jnp.any(judged(carry)[-1]),
            lambda carry: lax.fori_loop(0, _SWEEPS_BETWEEN, sweep, judged(carry)),
            (jnp.zeros_like(b), b, n, jnp.ones(n.shape, bool)),
        )
        return x + r

    arguments = lax.stop_gradient((columns(policy), columns(g), discount, jnp.asarray(max_steps)))
    if predecessors is None:
        x = loop(None, *arguments)
    else:
        x = _lanes_last(loop, predecessors, arguments)
    return g + policy * x.reshape(shape)[..., None]


def _action_columns(num_actions: int, table: jax.Array) -> list[jax.Array]:
    """``[S, A]`` as arrays ``[S]``, which lie side by side in memory."""
    rows = table.reshape(-1, num_actions)
    return [rows[:, a] for a in range(num_actions)]


def policy_logits(
    model: Any, reward: jax.Array, discount: jax.Array | float, value: jax.Array
) -> jax.Array:
    """Action values with minus infinity at unavailable actions, whose softmax is the policy."""
    q = reward + discount * expectation(model, value)
    return jnp.where(model.available, q, -jnp.inf)


def _with_softmax(model, reward, discount, solution: Solution) -> Solution:
    q = policy_logits(model, reward, discount, solution.value)
    return replace(solution, policy=jax.nn.softmax(q, axis=-1))
