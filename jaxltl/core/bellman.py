"""Discounted values: of a policy, optimal, soft, and Boltzmann.

Every solver stops on a certified error, returns the enclosure that certifies it, and is
differentiable by the implicit function theorem in the reward, the discount and the
transition probabilities. A ``model`` is an MDP, a DenseMDP or a Product; shapes are
written for an MDP, and a product's values have ``[S, Q]`` for ``[S]``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial, reduce
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp

from jaxltl.core.fixed_point import implicit, solve_linear
from jaxltl.core.flat import Predecessors, successors
from jaxltl.core.operators import (
    action_argmax,
    action_max,
    action_mean,
    expectation,
    induced_chain,
    policy_distribution,
    pushforward,
)
from jaxltl.core.types import Solution, Status, status_code

_SWEEPS_BETWEEN = 4  # sweeps between two looks at what is left


def action_value(
    model: Any, reward: jax.Array, discount: jax.Array | float, value: jax.Array
) -> jax.Array:
    """``Q(s, a) = R(s, a) + discount * sum_t P(t | s, a) V(t)``; zero at unavailable actions.

    Args:
      model: the model.
      reward: ``float[S, A]``.
      discount: scalar.
      value: ``float[S]``.

    Returns:
      ``float[S, A]``.
    """
    q = reward + discount * expectation(model, value)
    return jnp.where(model.available, q, 0)


def expected_reward(model: Any, reward: jax.Array) -> jax.Array:
    """A reward on transitions, ``[S, A, K]``, as its expectation ``[S, A]``; ``[S, A]`` as it is.

    Raises:
      ValueError: the reward has another shape.
    """
    actions = (*model.state_shape, model.num_actions)
    transitions = (*actions, model.num_successors)
    reward = jnp.asarray(reward, model.dtype)
    if reward.shape == actions:
        return reward
    if reward.shape == transitions:
        return jnp.sum(model.successor_probability * reward, axis=-1)
    raise ValueError(f"reward has shape {reward.shape}; expected {actions} or {transitions}.")


def _rounding(
    model: Any, reward: jax.Array, value: jax.Array, gap: jax.Array, axis: int | None = None
) -> jax.Array:
    """What rounding in one backup can add to an error, amplified by ``1 / gap``.

    A backup sums at most as many products as a state has successors, over which rows may
    also miss one by a rounding each, and takes a maximum or a mean over the actions.
    """
    terms = model.num_successors + model.num_actions + 4
    magnitude = jnp.max(jnp.abs(reward), axis) + jnp.max(jnp.abs(value), axis)
    return terms * jnp.finfo(value.dtype).eps * magnitude / gap


def _macqueen(
    model: Any, reward: jax.Array, discount: jax.Array, value: jax.Array, image: jax.Array,
    axis: int | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Bounds on the fixed point of a monotone T with ``T(v + c) = T(v) + discount * c``.

    ``T v + discount / (1 - discount) * [min, max](T v - v)`` (MacQueen 1966).

    Returns:
      The shifts (down, up) of `image` that enclose the fixed point, the rounding error
      contained in them, and whether everything is finite.
    """
    change = image - value
    gap = jnp.where(discount < 1, 1 - discount, jnp.nan)
    rounding = _rounding(model, reward, image, gap, axis)
    down = discount / gap * jnp.min(change, axis) - rounding
    up = discount / gap * jnp.max(change, axis) + rounding
    finite = jnp.isfinite(down) & jnp.isfinite(up)
    return down, up, rounding, finite


def _certified(
    model: Any,
    reward: jax.Array,
    discount: jax.Array,
    tolerance: jax.Array | float | None,
    value: jax.Array,
    image: jax.Array,
    axis: int | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Midpoint shift of the enclosure, its half width, whether that meets the tolerance, and
    whether it is mostly rounding, so that further sweeps would not help."""
    down, up, rounding, finite = _macqueen(model, reward, discount, value, image, axis)
    half = (up - down) / 2
    goal = 4 * rounding if tolerance is None else tolerance
    half = jnp.where(finite, half, jnp.inf)
    return (up + down) / 2, half, half <= goal, half <= 2 * rounding


def _solution(model, reward, discount, tolerance, value, image, policy, num_steps) -> Solution:
    shift, half, converged, exhausted = _certified(
        model, reward, discount, tolerance, value, image
    )
    finite = jnp.all(jnp.isfinite(image)) & (discount < 1)
    # Without a certificate the shift is meaningless and the iterate itself is the answer.
    middle = image + jnp.where(jnp.isfinite(half), shift, 0)
    return Solution(
        value=middle,
        policy=policy,
        lower=middle - half,
        upper=middle + half,
        residual=jnp.max(jnp.abs(image - value)),
        num_steps=num_steps,
        status=status_code(converged, finite, exhausted),
    )


@jax.jit
def policy_value(
    model: Any,
    policy: jax.Array,
    reward: jax.Array,
    discount: jax.Array | float,
    *,
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 100_000,
) -> Solution:
    """Expected discounted reward of a policy.

    ``V = r_pi + discount * P_pi V`` (dissertation, section 2.2.1). Solved by BiCGSTAB with
    successive approximation where that stalls; the enclosure holds for any iterate.

    Args:
      model: the model.
      policy: ``float[S, A]`` or ``int32[S]``.
      reward: ``float[S, A]`` or ``float[S, A, K]``.
      discount: scalar in [0, 1).
      tolerance: certified absolute error asked for; default: what the dtype allows.
      max_steps: sweeps at most.

    Returns:
      :class:`Solution`; `value` is ``float[S]``.

    Raises:
      ValueError: policy or reward has the wrong shape.

    Differentiable in the policy, the reward, the discount and the probabilities.

    Example:
      >>> from jaxltl.core.mdp import from_dense
      >>> mdp = from_dense([[[1.0]]])
      >>> round(policy_value(mdp, jnp.array([0]), jnp.ones((1, 1)), 0.5).value.item(), 4)
      2.0
    """
    reward = expected_reward(model, reward)
    discount = jnp.asarray(discount, model.dtype)
    policy = policy_distribution(model, policy)
    reward = jnp.where(model.available, reward, 0)

    def backup(v: jax.Array) -> jax.Array:
        return action_mean(policy, action_value(model, reward, discount, v))

    constant = action_mean(policy, reward)
    scale = float(jnp.finfo(model.dtype).eps)
    relative = scale if tolerance is None else jnp.maximum(
        scale, tolerance * (1 - discount) / (4 * jnp.linalg.norm(constant.ravel()) + scale)
    )
    value = lax.stop_gradient(
        solve_linear(
            lambda v: v - (backup(v) - constant), constant,
            tolerance=relative, max_steps=max_steps,
        )
    )
    solution = _solution(
        model, reward, discount, tolerance, value, backup(value), policy, jnp.int32(1)
    )
    return _attach(solution, backup)


def _attach(solution: Solution, backup, jacobian: _Jacobian | None = None) -> Solution:
    """The solution with implicit derivatives on its value, and none on its evidence."""
    solution = jax.tree.map(lax.stop_gradient, solution)
    if jacobian is None:
        return replace(solution, value=implicit(backup, solution.value))
    value = implicit(
        backup, solution.value, solve=jacobian.solve, transpose_solve=jacobian.transpose_solve
    )
    return replace(solution, value=value)


class _Jacobian(NamedTuple):
    """A backup's derivative in the value, ``J x = discount * sum_a w(s, a) (P x)(s, a)``.

    Written out with its weights w, a product with it is far cheaper than what
    differentiating the backup gives. It only steers solvers: derivatives of any order
    are those of the backup itself.
    """

    model: Any
    discount: jax.Array
    weight: jax.Array

    def matvec(self, x: jax.Array) -> jax.Array:
        return x - self.discount * action_mean(self.weight, expectation(self.model, x))

    def solve(self, _, b: jax.Array) -> jax.Array:
        return solve_linear(self.matvec, b)

    def transpose_solve(self, _, b: jax.Array) -> jax.Array:
        def vecmat(x: jax.Array) -> jax.Array:
            return x - self.discount * pushforward(self.model, self.weight * x[..., None])

        return solve_linear(vecmat, b)

    def newton(self, value: jax.Array, image: jax.Array) -> jax.Array:
        """One inexact step of Newton's method from `value`, whose backup is `image`.

        A plain sweep where the linear solver gets nowhere, as it can in single precision.
        """
        change = image - value
        found = solve_linear(self.matvec, change, tolerance=1e-2, max_steps=48)
        left = self.matvec(found) - change
        solved = jnp.sum(left * left) <= jnp.sum(change * change) / 4
        return value + jnp.where(solved, found, change)


@partial(jax.jit, static_argnames=("method",))
def optimal_value(
    model: Any,
    reward: jax.Array,
    discount: jax.Array | float,
    *,
    method: str = "modified_policy_iteration",
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 100_000,
    evaluation_sweeps: jax.Array | int = 24,
) -> Solution:
    """Largest expected discounted reward, ``V = max_a R + discount * P V``.

    Modified policy iteration (Puterman and Shin 1978): after each sweep of the
    optimality operator, `evaluation_sweeps` cheap sweeps under the greedy policy.
    Stops on MacQueen's bounds, so a tolerance met is a certified error.

    Args:
      model: the model.
      reward: ``float[S, A]`` or ``float[S, A, K]``.
      discount: scalar in [0, 1).
      method: ``"modified_policy_iteration"`` or ``"value_iteration"``.
      tolerance: certified absolute error asked for; default: what the dtype allows.
      max_steps: sweeps of the optimality operator at most.
      evaluation_sweeps: sweeps between them under a fixed policy.

    Returns:
      :class:`Solution`; `value` is ``float[S]``, `policy` ``int32[S]`` is greedy and its
      own value is at least `lower`.

    Raises:
      ValueError: the reward has the wrong shape, or an unknown method.

    Differentiable in the reward, the discount and the probabilities, wherever the
    greedy policy is unique.

    Example:
      >>> from jaxltl.core.mdp import from_dense
      >>> mdp = from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 1.0]]])
      >>> best = optimal_value(mdp, jnp.array([[0.0, 0.0], [1.0, 1.0]]), 0.5)
      >>> [round(v, 4) for v in best.value.tolist()], best.policy.tolist()
      ([1.0, 2.0], [1, 0])
    """
    if method not in ("modified_policy_iteration", "value_iteration"):
        raise ValueError(f"method={method!r}; choose modified_policy_iteration or value_iteration.")
    reward = expected_reward(model, reward)
    discount = jnp.asarray(discount, model.dtype)

    def backup(v: jax.Array) -> jax.Array:
        q = reward + discount * expectation(model, v)
        return action_max(q, model.available)

    def greedy(v: jax.Array) -> tuple[jax.Array, jax.Array]:
        q = reward + discount * expectation(model, v)
        return action_argmax(q, model.available)

    def evaluate(v: jax.Array, policy: jax.Array) -> jax.Array:
        chain = induced_chain(model, policy)
        gain = action_mean(policy, reward)
        return lax.fori_loop(
            0, evaluation_sweeps,
            lambda _, v: gain + discount * expectation(chain, v.ravel())[:, 0].reshape(v.shape), v,
        )

    def body(carry):
        _, image, policy, n, _ = carry
        value = image if method == "value_iteration" else evaluate(image, policy)
        image, policy = greedy(value)
        *_, done, exhausted = _certified(model, reward, discount, tolerance, value, image)
        return value, image, policy, n + 1, done | exhausted | ~jnp.isfinite(image.ravel()[0])

    def unfinished(carry):
        *_, n, done = carry
        return ~done & (n < max_steps)

    zero = jnp.zeros(model.state_shape, model.dtype)
    start = (zero, *greedy(zero), jnp.int32(1), jnp.bool_(False))
    value, image, policy, n, _ = lax.stop_gradient(lax.while_loop(unfinished, body, start))
    solution = _solution(model, reward, discount, tolerance, value, image, policy, n)
    return _attach(solution, backup)


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
      >>> from jaxltl.core.mdp import from_dense
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


def boltzmann_expansion(num_actions: int) -> float:
    """Largest row sum of the Jacobian of ``sum_a softmax(q)_a q_a`` over all q.

    The Boltzmann operator contracts for discounts below its inverse. The supremum is
    attained where one action stands above the rest, which are equal.

    Example:
      >>> [round(boltzmann_expansion(n), 2) for n in (1, 2, 3, 4)]
      [1.0, 1.2, 1.33, 1.42]
    """
    if num_actions == 1:
        return 1.0
    gap = np.linspace(0.0, 40.0, 400_001)
    top = 1 / (1 + (num_actions - 1) * np.exp(-gap))
    mean = top * gap
    row_sum = np.abs(top * (1 + gap - mean)) + np.abs((1 - top) * (1 - mean))
    # The grid misses the maximum by less than its spacing squared.
    return float(row_sum.max() + 1e-7)


@partial(jax.jit, static_argnames=("adjoint", "method"))
def boltzmann_value(
    model: Any,
    reward: jax.Array,
    discount: jax.Array | float,
    *,
    initial: jax.Array | None = None,
    adjoint: str = "exact",
    method: str = "damped",
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 5_000,
) -> Solution:
    """Value of the softmax policy of its own action values (2.1)-(2.3).

    ``V = sum_a softmax(Q)_a Q_a`` with ``Q = R + discount * P V``. This operator
    contracts only while ``discount * boltzmann_expansion(A) < 1``. Beyond, it can cycle or
    have several fixed points: damped steps of one half are polished by Newton's method,
    the enclosure is infinite, and the status tells when no fixed point was reached. See
    :func:`boltzmann_fixed_points`.

    Args:
      model: the model.
      reward: ``float[S, A]`` or ``float[S, A, K]``.
      discount: scalar in [0, 1).
      initial: ``float[S]``, where to start; default zero.
      adjoint: ``"exact"``, or ``"approximate"`` for the sensitivity (2.7) that holds the
        policy constant.
      method: ``"damped"``, or ``"newton"`` for Newton steps from the start on, which may
        also find fixed points that repel.
      tolerance: on the certified error where the operator contracts, on the
        residual elsewhere; default: what the dtype allows.
      max_steps: damped steps at most.

    Returns:
      :class:`Solution`; `policy` is ``float[S, A]``, the softmax.

    Raises:
      ValueError: the reward has the wrong shape, or an unknown method or adjoint.

    Value and policy are differentiable in the reward, the discount and the probabilities.

    Example:
      >>> from jaxltl.core.mdp import from_dense
      >>> mdp = from_dense([[[1.0], [1.0]]])
      >>> round(boltzmann_value(mdp, jnp.ones((1, 2)), 0.5).value.item(), 4)
      2.0
    """
    if adjoint not in ("exact", "approximate"):
        raise ValueError(f"adjoint={adjoint!r}; choose exact or approximate.")
    if method not in ("damped", "newton"):
        raise ValueError(f"method={method!r}; choose damped or newton.")
    reward = expected_reward(model, reward)
    discount = jnp.asarray(discount, model.dtype)
    expansion = discount * boltzmann_expansion(model.num_actions)

    def backup(v: jax.Array, constant_policy: bool = False) -> jax.Array:
        policy = jax.nn.softmax(policy_logits(model, reward, discount, v), axis=-1)
        if constant_policy:
            policy = lax.stop_gradient(policy)
        return action_mean(policy, action_value(model, reward, discount, v))

    def jacobian(v: jax.Array, constant_policy: bool = False) -> _Jacobian:
        policy = jax.nn.softmax(policy_logits(model, reward, discount, v), axis=-1)
        if not constant_policy:
            q = action_value(model, reward, discount, v)
            policy *= 1 + q - action_mean(policy, q)[..., None]
        return lax.stop_gradient(_Jacobian(model, discount, policy))

    contracts = expansion < 1
    damping = jnp.where(contracts | (method == "newton"), 0.0, 0.5).astype(model.dtype)
    gap = jnp.where(contracts, 1 - expansion, 1)
    magnitude = jnp.max(jnp.abs(jnp.where(model.available, reward, 0))) / (1 - discount)
    rounding = _rounding(model, reward, magnitude, gap)
    goal = 4 * rounding if tolerance is None else jnp.asarray(tolerance, model.dtype)
    enough = jnp.maximum(goal, 2 * rounding)  # below which there is little but rounding

    def error(value: jax.Array, image: jax.Array) -> jax.Array:
        """Certified where the operator contracts; elsewhere the residual."""
        return jnp.max(jnp.abs(image - value)) / gap + rounding

    def damped(carry):
        value, image, _, better, n = carry
        value = value + (1 - damping) * (image - value)
        image = backup(value)
        return value, image, error(value, image), better, n + 1

    def newton(carry):
        value, image, before, _, n = carry
        trial = jacobian(value).newton(value, image)
        trial_image = backup(trial)
        now = error(trial, trial_image)
        better = now <= before / 2
        keep = partial(jnp.where, better)
        return keep(trial, value), keep(trial_image, image), keep(now, before), better, n + 1

    def polish(carry):
        value, image, bound, n = carry
        # Newton's method early, but ever more damped steps where it does not take hold.
        width = n + (0 if method == "newton" else 4 * (1 + n // 16))
        again = (value, image, bound, jnp.bool_(True), n)
        value, image, bound, _, n = lax.while_loop(
            lambda c: (c[2] > enough) & (c[4] < jnp.minimum(width, max_steps)), damped, again
        )
        again = (value, image, bound, jnp.bool_(True), n)
        value, image, bound, _, n = lax.while_loop(
            lambda c: (c[2] > enough) & c[3] & (c[4] < max_steps), newton, again
        )
        return value, image, bound, n

    def unfinished(carry):
        _, _, bound, n = carry
        return (bound > enough) & (n < max_steps) & jnp.isfinite(bound)

    start = jnp.zeros(model.state_shape, model.dtype) if initial is None else initial
    image = backup(start)
    first = (start, image, error(start, image), jnp.int32(1))
    value, image, bound, n = lax.stop_gradient(lax.while_loop(unfinished, polish, first))
    converged = bound <= goal
    half = jnp.where(converged & contracts, bound, jnp.inf)
    solution = Solution(
        value=value, policy=value, lower=value - half, upper=value + half,
        residual=jnp.max(jnp.abs(image - value)), num_steps=n,
        status=status_code(converged, jnp.isfinite(bound) & (discount < 1), bound <= enough),
    )
    constant = adjoint == "approximate"
    solution = _attach(
        solution, partial(backup, constant_policy=constant), jacobian(value, constant)
    )
    return _with_softmax(model, reward, discount, solution)


def boltzmann_fixed_points(
    model: Any,
    reward: jax.Array,
    discount: jax.Array | float,
    key: chex.PRNGKey,
    *,
    num_starts: int = 64,
    tolerance: float = 1e-6,
) -> list[Solution]:
    """Distinct fixed points of the Boltzmann operator that were found from many starts.

    Damped and Newton iterations from zero, from the optimal and the worst value, and from
    random values between. A search, not a proof that there are no others.

    Args:
      model, reward, discount: as in :func:`boltzmann_value`.
      key: a PRNG key, consumed.
      num_starts: starts for each of the two methods.
      tolerance: fixed points nearer than this (sup norm) are one; also the residual allowed.

    Returns:
      Converged solutions, ordered by the sum of their values. Works on the host.
    """
    best = optimal_value(model, reward, discount).value
    worst = -optimal_value(model, -jnp.asarray(reward), discount).value
    weight = jax.random.uniform(key, (num_starts, *(1 for _ in best.shape)), best.dtype)
    weight = weight.at[0].set(0).at[-1].set(1)
    starts = worst + weight * (best - worst)
    found: list[Solution] = []
    for method in ("damped", "newton"):
        run = jax.vmap(
            lambda v, method=method: boltzmann_value(
                model, reward, discount, initial=v, method=method)
        )
        batch = run(starts)
        for i in np.flatnonzero(np.asarray(batch.status) == Status.CONVERGED):
            one = jax.tree.map(lambda x, i=i: x[i], batch)
            if all(jnp.max(jnp.abs(one.value - f.value)) > tolerance for f in found):
                found.append(one)
    return sorted(found, key=lambda f: float(f.value.sum()))
