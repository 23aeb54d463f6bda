"""Soft (maximum-entropy) values and the derivative of their policies."""

from __future__ import annotations

from typing import Unpack

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.ops.array_namespace import jit
from jaxltl.core.values.engine.validated import SolverOptions, validated
from jaxltl.core import validation
from jaxltl.core.models.compiled import compiled_form, reshape_solution
from jaxltl.core.models.ops.choices import Layout, Quantity, choices
from jaxltl.core.models.ops.operators import expectation, pushforward
from jaxltl.core.models.ops.successor_tables import PredecessorTable, sweep_operator
from jaxltl.core.models.protocols import Model, PyTree
from jaxltl.core.types import Solution
from jaxltl.core.values.discounted.discounted import (
    differentiable,
    expected_reward,
    gains,
    judge,
    parameters,
    solution_of,
)
from jaxltl.core.values.engine import newton
from jaxltl.core.values.engine.iterate import iterate
from jaxltl.core.values.engine.linear import System

_LEAST = 0.95  # of the logarithm of the least normal number, to which probabilities may fall
_SWEEPS_BETWEEN = 4  # sweeps between two tests of the remainder


@validated(method=("newton", "value_iteration"))
def soft_value(
    model: Model,
    reward: jax.Array,
    discount: jax.Array | float,
    *,
    initial: jax.Array | None = None,
    method: str = "newton",
    tolerance: jax.Array | float | None = None,
    **options: Unpack[SolverOptions],
) -> Solution:
    """Soft (maximum-entropy) value, ``V = log sum_a exp(R + discount * P V)`` (3.4).

    Args:
      model, reward, discount, tolerance: as in
        :func:`~jaxltl.core.values.discounted.discounted.optimal_value`.
      initial: ``float[S]``, the first iterate; default zero.
      method: ``"newton"`` (soft policy iteration) or ``"value_iteration"``.
      max_steps: maximal number of steps of the method; default 100,000.

    Returns:
      :class:`Solution`; `policy` is ``float[S, A]``, ``exp(Q - V)``, of a sparse model
      ``float[R]``. Value and policy are differentiable in the reward, the discount and the
      probabilities.

    Raises:
      ValueError: the reward has the wrong shape, or an unknown method.

    Example:
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[1.0], [1.0]]])
      >>> round(soft_value(mdp, jnp.zeros((1, 2)), 0.5).value.item(), 4)  # 2 log 2
      1.3863
    """
    (max_steps,) = validation.options("soft_value", options, max_steps=100_000)
    form, reward = compiled_form(model, reward)
    return reshape_solution(
        model, _soft_value(form, reward, discount, initial, (tolerance, max_steps), method=method)
    )


@jit("method")
def _soft_value(
    model: Model,
    reward: jax.Array,
    discount: jax.Array | float,
    initial: jax.Array | None,
    limits: tuple[jax.Array | float | None, jax.Array | int],
    *,
    method: str,
) -> Solution:
    tolerance, max_steps = limits
    problem = parameters(model, reward, discount, tolerance)
    reward, over = expected_reward(model, reward), choices(model)
    start = jnp.zeros(model.num_states, model.dtype) if initial is None else initial.ravel()
    value, image, n, _ = newton.solve(
        sweep_operator(model),
        newton.Method(soft_maximum, judge, newton=method == "newton"),
        newton.Backup(
            gains(model, reward), problem.discount, jnp.zeros_like(problem.discount), problem
        ),
        start,
        max_steps=max_steps,
    )
    solution = solution_of(model, problem, value, image, value, n)

    def backup(v: jax.Array) -> jax.Array:
        return over.logsumexp(policy_logits(model, reward, problem.discount, v))

    def system() -> System:
        logits = policy_logits(model, reward, problem.discount, solution.value)
        return System(sweep_operator(model), over.columns(over.softmax(logits)), problem.discount)

    solution = differentiable(solution, backup, system)
    return with_softmax(model, reward, problem.discount, solution)


def soft_maximum(over: Layout, q: Quantity, parameters: PyTree) -> tuple[jax.Array, Quantity]:
    """``log sum_a exp q_a`` of columns, and its derivative, the softmax."""
    # Elementwise over columns: reductions over a short last axis take several times as long.
    top = over.max(q)
    raised = jax.tree.map(lambda x, t: jnp.exp(x - t), q, over.spread(top, q))
    total = over.sum(raised)
    return top + jnp.log(total), jax.tree.map(jnp.divide, raised, over.spread(total, q))


def policy_logits(
    model: Model, reward: jax.Array, discount: jax.Array | float, value: jax.Array
) -> jax.Array:
    """Logits of the soft policy: action values, minus infinity at unavailable actions."""
    q = reward + discount * expectation(model, value)
    return choices(model).logits(q)


def with_softmax(
    model: Model, reward: jax.Array, discount: jax.Array, solution: Solution
) -> Solution:
    """The solution with the softmax of its action values as its policy."""
    return replace(solution, policy=softmax_policy(model, reward, discount, solution.value))


def softmax_policy(
    model: Model, reward: jax.Array, discount: jax.Array | float, value: jax.Array
) -> jax.Array:
    """Softmax of action values; every available action has a positive normal probability."""
    q, over = policy_logits(model, reward, discount, value), choices(model)
    # As a constant: where the compiler rounds q otherwise elsewhere, no entry equals the maximum,
    # and its derivative is 0 / 0.
    best = over.spread(lax.stop_gradient(over.top(q)))
    least = best + _LEAST * math.log(jnp.finfo(q.dtype).tiny)
    q = jnp.where(over.available, jnp.maximum(q, least), q)
    return over.softmax(q)


@validated()
def soft_policy_adjoint(
    model: Model,
    policy: jax.Array,
    discount: jax.Array | float,
    cotangent: jax.Array,
    *,
    predecessors: PredecessorTable | None = None,
    max_steps: jax.Array | int = 100_000,
) -> jax.Array:
    """Derivative of ``sum c log pi`` in the reward, for the soft policy pi of that reward.

    With ``g = c - pi sum_a c`` and x the solution of ``x = discount * P'(g + pi x)``, it is
    ``g + pi x``: the transpose of the sensitivity (3.6), one linear system for any number of
    parameters. Solved by sweeps, as the series ``sum_k (discount * P_pi')^k b``: the remainder
    is known exactly and shrinks at the rate of the discount or faster.
    """
    over = choices(model)
    g = cotangent - policy * over.spread(over.sum(cotangent))
    weight, discount = over.columns(policy), jnp.asarray(discount, policy.dtype)

    def push(before: PyTree, discount: jax.Array, mass: PyTree) -> jax.Array:
        """The discounted flow ``[N]`` of masses ``[N]`` of the actions."""
        if before is not None:
            result: jax.Array = discount * before.pushforward(jnp.concatenate(mass))
            return result
        return discount * pushforward(model, over.whole(mass)).ravel()

    def step(before: PyTree, carry: PyTree, parameters: PyTree) -> PyTree:
        (x, r), (weight, discount, _) = carry, parameters
        return x + r, push(
            before, discount, jax.tree.map(jnp.multiply, weight, over.layout.spread(r, weight))
        )

    def finished(carry: PyTree, parameters: PyTree) -> jax.Array:
        result: jax.Array = jnp.sum(jnp.abs(carry[1]), 0) <= parameters[2]
        return result

    b = push(predecessors, discount, over.columns(g))
    target = float(jnp.finfo(b.dtype).eps) ** 0.8 * jnp.sum(jnp.abs(b), 0)
    start = lax.stop_gradient((jnp.zeros_like(b), b))
    (x, r), _ = iterate(
        step,
        finished,
        (predecessors, start, lax.stop_gradient((weight, discount, target))),
        max_steps=max_steps,
        every=_SWEEPS_BETWEEN,
        lanes="mapped" if predecessors is None else "side by side",
    )
    return g + policy * over.spread((x + r).reshape(model.state_shape))
