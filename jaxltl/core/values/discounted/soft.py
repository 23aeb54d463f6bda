"""Values of softmax policies: soft (maximum-entropy) values, and Boltzmann values."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import ArrayLike

from jaxltl.core.models.compiled import compiled_form, reshape_solution
from jaxltl.core.models.ops.array_namespace import jit
from jaxltl.core.models.ops.choices import Layout, Quantity, choices
from jaxltl.core.models.ops.operators import expectation, pushforward
from jaxltl.core.models.ops.successor_tables import PredecessorTable, sweep_operator
from jaxltl.core.models.protocols import Array, Model, PyTree
from jaxltl.core.types import Solution, require_shape, status_code
from jaxltl.core.values.discounted.compiled import (
    action_value,
    expected_reward,
    gains,
    judge,
    parameters,
    reward_size,
    solution_of,
)
from jaxltl.core.values.engine import newton
from jaxltl.core.values.engine.certificates import backup_error, most_choices, rounding_unit
from jaxltl.core.values.engine.implicit_diff import implicit
from jaxltl.core.values.engine.iterate import iterate
from jaxltl.core.values.engine.linear import System
from jaxltl.core.values.engine.validated import validated


_LEAST = 0.95  # of the logarithm of the least normal number, to which probabilities may fall
_SWEEPS_BETWEEN = 4  # sweeps between two tests of the remainder


@validated(method=("newton", "value_iteration"))
def soft_value(
    model: Model,
    reward: jax.Array,
    discount: jax.Array | float,
    *,
    guess: jax.Array | None = None,
    method: str = "newton",
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 100_000,
) -> Solution:
    """Soft (maximum-entropy) value, ``V = log sum_a exp(R + discount * P V)`` (3.4).

    Args:
      model, reward, discount, tolerance: as in
        :func:`~jaxltl.core.values.discounted.discounted.optimal_value`.
      guess: ``float[S]``, the first iterate; default zero.
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
    form, reward = compiled_form(model, reward)
    return reshape_solution(
        model, _soft_value(form, reward, discount, guess, (tolerance, max_steps), method=method)
    )


@jit("method")
def _soft_value(
    model: Model,
    reward: jax.Array,
    discount: jax.Array | float,
    guess: jax.Array | None,
    limits: tuple[jax.Array | float | None, jax.Array | int],
    *,
    method: str,
) -> Solution:
    tolerance, max_steps = limits
    problem = parameters(model, reward, discount, tolerance)
    reward, over = expected_reward(model, reward), choices(model)
    start = first_iterate(model, guess)
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

    policy = over.softmax(policy_logits(model, reward, problem.discount, solution.value))
    system = System(sweep_operator(model), over.columns(policy), problem.discount)
    value = implicit(backup, solution.value, system)
    return with_softmax(model, reward, problem.discount, replace(solution, value=value))


def soft_maximum(over: Layout, q: Quantity, parameters: PyTree) -> tuple[jax.Array, Quantity]:
    """``log sum_a exp q_a`` of columns, and its derivative, the softmax."""
    # Elementwise over columns: reductions over a short last axis take several times as long.
    top = over.max(q)
    raised = jax.tree.map(lambda x, t: jnp.exp(x - t), q, over.broadcast(top, q))
    total = over.sum(raised)
    return top + jnp.log(total), jax.tree.map(jnp.divide, raised, over.broadcast(total, q))


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
    best = over.broadcast(lax.stop_gradient(over.top(q)))
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
    g = cotangent - policy * over.broadcast(over.sum(cotangent))
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
            before, discount, jax.tree.map(jnp.multiply, weight, over.layout.broadcast(r, weight))
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
    return g + policy * over.broadcast((x + r).reshape(model.state_shape))


def boltzmann_expansion(num_actions: ArrayLike) -> Array:
    """Largest row sum of the Jacobian of ``sum_a softmax(q)_a q_a`` over all q.

    The Boltzmann operator contracts for discounts below its inverse. The supremum is ``g / 2``,
    attained where one action exceeds the equal others by g: ``g tanh((g - log(n - 1)) / 2) = 2``.

    >>> [round(boltzmann_expansion(n), 2) for n in (1, 2, 3, 4)]
    [1.0, 1.2, 1.33, 1.42]
    """
    xp = jnp if isinstance(num_actions, jax.Array) else np
    n = xp.asarray(num_actions, float)
    others = xp.log(xp.maximum(n - 1, 1))

    def halved(_: object, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = (low + high) / 2
        above = middle * xp.tanh((middle - others) / 2) >= 2
        return xp.where(above, low, middle), xp.where(above, middle, high)

    ends = (others, others + 4)  # from one to the other the left side goes from 0 to more than 2
    if xp is jnp:
        high = lax.fori_loop(0, 30, halved, ends)[1]
    else:
        high = reduce(lambda ends, i: halved(i, ends), range(30), ends)[1]
    # Errors of the bisection and of rounding.
    expansion = xp.where(n > 1, high / 2 * (1 + 64 * float(jnp.finfo(high.dtype).eps)) + 1e-7, 1.0)
    return expansion if xp is jnp else float(expansion)


def first_iterate(model: Model, guess: jax.Array | None) -> jax.Array:
    """The first iterate of a value, ``float[N]``, from one in the model's shape; zero for None."""
    if guess is None:
        return jnp.zeros(model.num_states, model.dtype)
    if np.shape(guess) != (model.num_states,):
        require_shape("guess", guess, model.state_shape)
    return jnp.asarray(guess, model.dtype).ravel()


@validated(adjoint=("exact", "approximate"), method=("damped", "newton"))
def boltzmann_value(
    model: Model,
    reward: jax.Array,
    discount: jax.Array | float,
    *,
    guess: jax.Array | None = None,
    method: str = "damped",
    tolerance: jax.Array | float | None = None,
    adjoint: str = "exact",
    max_steps: jax.Array | int = 5_000,
) -> Solution:
    """Boltzmann value: the value of a policy that is the softmax of its action values (2.1)-(2.3).

    ``V = sum_a softmax(Q)_a Q_a`` with ``Q = R + discount * P V``. This operator contracts only
    while ``discount * boltzmann_expansion(A) < 1``. Beyond, it can have several fixed points, one
    for each region of `guess`: damped steps of one half are polished by Newton's method, the
    enclosure is infinite, and the status is not UNCERTIFIED if no fixed point was reached.

    Args:
      model, reward, discount: as in :func:`~jaxltl.core.values.discounted.discounted.optimal_value`.
      guess: ``float[S]``, the first iterate; default zero.
      method: ``"damped"``, or ``"newton"`` for Newton steps only, which may also find repelling
        fixed points.
      tolerance: width of the enclosure where the operator contracts, of the residual elsewhere;
        default: what the dtype allows.
      max_steps: damped steps at most; default 5,000.
      adjoint: ``"exact"``, or ``"approximate"``: the sensitivity (2.7), with the policy constant.

    Returns:
      :class:`Solution`; `policy` is ``float[S, A]``, of a sparse model ``float[R]``, the softmax.
      Value and policy are differentiable in the reward, the discount and the probabilities.

    Raises:
      ValueError: the reward has the wrong shape, or an unknown method or adjoint.

    Example:
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[1.0], [1.0]]])
      >>> round(boltzmann_value(mdp, jnp.ones((1, 2)), 0.5).value.item(), 4)
      2.0
    """
    form, reward = compiled_form(model, reward)
    return reshape_solution(
        model,
        _boltzmann_value(
            form, reward, discount, guess, (tolerance, max_steps), options=(adjoint, method)
        ),
    )


@jit("options")
def _boltzmann_value(
    model: Model,
    reward: jax.Array,
    discount: jax.Array | float,
    guess: jax.Array | None,
    limits: tuple[jax.Array | float | None, jax.Array | int],
    *,
    options: tuple[str, str],
) -> Solution:
    (tolerance, max_steps), (adjoint, method) = limits, options
    discount = jnp.asarray(discount, model.dtype)
    criterion = _criterion(model, reward, discount, tolerance)
    reward, over = expected_reward(model, reward), choices(model)
    start = first_iterate(model, guess)
    damping = jnp.where(criterion.contracts | (method == "newton"), 0.0, 0.5).astype(model.dtype)
    value, image, n, _ = newton.solve(
        sweep_operator(model),
        newton.Method(softmax_mean, _judge, monotone=False),
        newton.Backup(gains(model, reward), discount, damping, criterion),
        start,
        first_sweeps=4 if method == "damped" else 0,
        max_steps=max_steps,
    )
    bound = _error(value, image, criterion)
    converged = bound <= criterion.goal
    half = jnp.where(converged & criterion.contracts, bound, jnp.inf)
    value, image = (x.reshape(model.state_shape) for x in (value, image))
    solution = jax.tree.map(
        lax.stop_gradient,
        Solution(
            value=value,
            policy=value,
            lower=value - half,
            upper=value + half,
            residual=jnp.max(jnp.abs(image - value)),
            num_steps=n,
            status=status_code(
                converged,
                jnp.isfinite(bound),
                bound <= criterion.enough,
                certified=criterion.contracts,
            ),
        ),
    )

    def backup(v: jax.Array) -> jax.Array:
        policy = over.softmax(policy_logits(model, reward, discount, v))
        if adjoint == "approximate":
            policy = lax.stop_gradient(policy)
        return over.mean(policy, action_value(model, reward, discount, v))

    policy = over.softmax(policy_logits(model, reward, discount, solution.value))
    if adjoint == "exact":
        q = action_value(model, reward, discount, solution.value)
        policy *= 1 + q - over.broadcast(over.mean(policy, q))
    system = System(sweep_operator(model), over.columns(policy), discount)
    solution = replace(solution, value=implicit(backup, solution.value, system))
    return with_softmax(model, reward, discount, solution)


class _Criterion(NamedTuple):
    """Stopping criterion of Boltzmann values."""

    contracts: jax.Array
    gap: jax.Array
    rounding: jax.Array
    goal: jax.Array
    enough: jax.Array  # the error below which there is little but rounding


def _criterion(
    model: Model, reward: jax.Array, discount: jax.Array, tolerance: jax.Array | float | None
) -> _Criterion:
    expansion = discount * boltzmann_expansion(most_choices(model))
    contracts = expansion < 1
    gap = jnp.where(contracts, 1 - expansion, 1)
    size = reward_size(model, reward)
    rounding = backup_error(rounding_unit(model), size, size / (1 - discount)) / gap
    goal = 4 * rounding
    if tolerance is not None:
        tolerance = jnp.asarray(tolerance, model.dtype)
        # Of the enclosure's width, less its own rounding; elsewhere of the residual.
        goal = jnp.where(contracts, tolerance / 2 - rounding / 4, tolerance)
    return _Criterion(contracts, gap, rounding, goal, jnp.maximum(goal, 2 * rounding))


def _error(value: jax.Array, image: jax.Array, criterion: _Criterion) -> jax.Array:
    """Certified where the operator contracts; elsewhere the residual."""
    return jnp.max(jnp.abs(image - value), axis=0) / criterion.gap + criterion.rounding


def _judge(
    value: jax.Array, image: jax.Array, criterion: _Criterion
) -> tuple[jax.Array, jax.Array]:
    error = _error(value, image, criterion)
    return (error <= criterion.enough) | ~jnp.isfinite(error), error


def softmax_mean(over: Layout, q: Quantity, parameters: _Criterion) -> tuple[jax.Array, Quantity]:
    """``sum_a softmax(q)_a q_a`` of columns, and its derivative."""
    _, policy = soft_maximum(over, q, parameters)
    finite = jax.tree.map(lambda x: jnp.where(jnp.isneginf(x), 0, x), q)
    value = over.mean(policy, finite)
    return value, jax.tree.map(
        lambda p, x, v: p * (1 + x - v), policy, finite, over.broadcast(value, finite)
    )
