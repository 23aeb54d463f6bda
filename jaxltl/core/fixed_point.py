"""Fixed points: linear systems, Newton's method, and implicit derivatives for all of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.linalg import lu_factor, lu_solve

Operator = Callable[[jax.Array], jax.Array]
LinearSolver = Callable[[Operator, jax.Array], jax.Array]

_GOOD_RATE = 0.7  # a contraction at least this fast needs no Krylov method
_KRYLOV_STEPS = 64  # BiCGSTAB steps between two looks at the true residual


def implicit(
    operator: Operator,
    fixed_point: jax.Array,
    *,
    solve: LinearSolver | None = None,
    transpose_solve: LinearSolver | None = None,
) -> jax.Array:
    """A fixed point ``v = operator(v)`` with its implicit derivative attached.

    However `fixed_point` was found, the result is differentiable, forward and reverse, in
    everything that `operator` closes over: ``dv = (I - J)^-1 d(operator)`` with J the
    Jacobian in v (implicit function theorem). No iteration is unrolled; one linear
    system is solved per derivative, with the operator itself or with its transpose.

    Args:
      operator: a differentiable map from values to values of the same shape.
      fixed_point: a value that satisfies the equation.
      solve, transpose_solve: solve ``matvec(x) = b`` where matvec is I - J, or its
        transpose; default :func:`solve_linear`.

    Returns:
      `fixed_point`.

    Example:
      >>> a = jnp.array(0.5)
      >>> jax.grad(lambda a: implicit(lambda v: 1 + a * v, jnp.array(2.0)))(a).item()
      4.0
    """
    solve = solve_linear if solve is None else solve
    transpose_solve = solve_linear if transpose_solve is None else transpose_solve

    def solve_tangent(jacobian: Operator, b: jax.Array) -> jax.Array:
        return lax.custom_linear_solve(jacobian, b, solve=solve, transpose_solve=transpose_solve)

    return lax.custom_root(
        lambda v: v - operator(v),
        lax.stop_gradient(fixed_point),
        solve=lambda _, start: start,
        tangent_solve=solve_tangent,
    )


class _Krylov(NamedTuple):
    """The vectors and scalars of BiCGSTAB, in the names of van der Vorst (1992)."""

    x: jax.Array
    r: jax.Array
    shadow: jax.Array
    p: jax.Array
    v: jax.Array
    rho: jax.Array
    alpha: jax.Array
    omega: jax.Array


def solve_linear(
    matvec: Operator,
    b: jax.Array,
    *,
    start: jax.Array | None = None,
    tolerance: jax.Array | float | None = None,
    max_rounds: jax.Array | int = 1000,
) -> jax.Array:
    """Solves ``matvec(x) = b`` where matvec is the identity minus an operator.

    Richardson steps ``x + (b - matvec(x))`` for as long as they contract well, then rounds
    of BiCGSTAB (van der Vorst 1992), each judged by its true residual. A round that
    did not halve it is followed by Richardson steps all the same, which converge
    whenever the operator is a contraction in some norm.

    Args:
      matvec: a linear map on arrays of the shape of `b`.
      b: the right-hand side.
      start: where to start; default `b`.
      tolerance: relative residual in the Euclidean norm; default ``eps ** 0.8``.
      max_rounds: rounds at most.

    Returns:
      x. Judge it by its residual: the best iterate is returned however it ended.
    """
    if tolerance is None:
        tolerance = float(jnp.finfo(b.dtype).eps) ** 0.8
    target = tolerance * _norm(b)
    tiny = jnp.finfo(b.dtype).tiny

    def richardson(x, r, error, forced):
        def body(carry):
            x, r, error, _, n = carry
            x = x + r
            r = b - matvec(x)
            new = _norm(r)
            return x, r, new, new <= _GOOD_RATE * error, n + 1

        def unfinished(carry):
            _, _, error, fast, n = carry
            return (error > target) & (fast | (n < forced)) & jnp.isfinite(error)

        first = (x, r, error, jnp.bool_(True), jnp.int32(0))
        return lax.while_loop(unfinished, body, first)[:3]

    def krylov_step(carry):
        k, n = carry
        rho = _dot(k.shadow, k.r)
        beta = _ratio(rho * k.alpha, k.rho * k.omega, tiny)
        p = k.r + beta * (k.p - k.omega * k.v)
        v = matvec(p)
        alpha = _ratio(rho, _dot(k.shadow, v), tiny)
        s = k.r - alpha * v
        t = matvec(s)
        omega = _ratio(_dot(t, s), _dot(t, t), tiny)
        x = k.x + alpha * p + omega * s
        return _Krylov(x, s - omega * t, k.shadow, p, v, rho, alpha, omega), n + 1

    def krylov_unfinished(carry):
        k, n = carry
        error = _norm(k.r)
        return (error > target / 2) & (n < _KRYLOV_STEPS) & jnp.isfinite(error)

    def round_(carry):
        x, r, error, forced, n, _ = carry
        x, r, middle = richardson(x, r, error, forced)
        one, zero = jnp.ones((), b.dtype), jnp.zeros_like(b)
        first = _Krylov(x, r, r, zero, zero, one, one, one)
        steps = jnp.where(middle > target, 0, _KRYLOV_STEPS).astype(jnp.int32)
        k, _ = lax.while_loop(krylov_unfinished, krylov_step, (first, steps))
        r_krylov = b - matvec(k.x)
        last = _norm(r_krylov)
        better = last < middle  # false for NaN
        x, r = jnp.where(better, k.x, x), jnp.where(better, r_krylov, r)
        end = jnp.where(better, last, middle)
        forced = jnp.where(end <= middle / 2, 0, _KRYLOV_STEPS).astype(jnp.int32)
        # Give up only when forced Richardson steps brought nothing either.
        return x, r, end, forced, n + 1, (carry[3] == 0) | (end < error)

    def unfinished(carry):
        _, _, error, _, n, progress = carry
        return (error > target) & (n < max_rounds) & progress

    x = b if start is None else start
    r = b - matvec(x)
    first = (x, r, _norm(r), jnp.int32(0), jnp.int32(0), jnp.bool_(True))
    return lax.while_loop(unfinished, round_, first)[0]


class DenseSolver(NamedTuple):
    """An LU factorisation that solves a system and its transpose."""

    factors: tuple[jax.Array, jax.Array]

    def solve(self, _: Operator, b: jax.Array) -> jax.Array:
        return lu_solve(self.factors, b.ravel()).reshape(b.shape)

    def transpose_solve(self, _: Operator, b: jax.Array) -> jax.Array:
        return lu_solve(self.factors, b.ravel(), trans=1).reshape(b.shape)


def factorize(matrix: jax.Array) -> DenseSolver:
    """Factors a small system once, for values of any shape with as many entries."""
    return DenseSolver(lu_factor(lax.stop_gradient(matrix)))


def newton_step(operator: Operator, v: jax.Array, image: jax.Array) -> jax.Array:
    """One inexact step of Newton's method on ``v - operator(v) = 0``; `image` is operator(v)."""
    _, tangent = jax.linearize(operator, v)
    step = solve_linear(lambda x: x - tangent(x), image - v, tolerance=1e-4, max_rounds=2)
    return v + step


def _dot(x: jax.Array, y: jax.Array) -> jax.Array:
    return jnp.sum(x * y)


def _norm(x: jax.Array) -> jax.Array:
    return jnp.sqrt(_dot(x, x))


def _ratio(x: jax.Array, y: jax.Array, tiny: jax.Array) -> jax.Array:
    """x / y, and zero where y has vanished, which restarts the recurrence."""
    safe = jnp.abs(y) > tiny
    return jnp.where(safe, x / jnp.where(safe, y, 1), 0)
