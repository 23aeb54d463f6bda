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
      >>> slope = jax.grad(lambda a: implicit(lambda v: 1 + a * v, jnp.array(2.0)))(a)
      >>> round(slope.item(), 3)
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


class _Solve(NamedTuple):
    """The state of :func:`solve_linear`; BiCGSTAB in the names of van der Vorst (1992)."""

    phase: jax.Array
    z: jax.Array  # what the operator is applied to next
    x: jax.Array
    r: jax.Array  # the residual of x, by recurrence
    error: jax.Array  # the norm of r
    shadow: jax.Array
    p: jax.Array
    v: jax.Array
    rho: jax.Array
    alpha: jax.Array
    steps: jax.Array  # in this phase
    forced: jax.Array  # whether the last stretch was forced Richardson steps
    returning: jax.Array  # whether this look only fetches the residual of the best x
    best: jax.Array  # the best x whose true residual was looked at
    best_error: jax.Array
    num_steps: jax.Array


_RICHARDSON, _KRYLOV, _KRYLOV_HALF, _LOOK, _DONE = range(5)


def solve_linear(
    matvec: Operator,
    b: jax.Array,
    *,
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 100_000,
) -> jax.Array:
    """Solves ``matvec(x) = b`` where matvec is the identity minus an operator.

    Richardson steps ``x + (b - matvec(x))`` for as long as they contract well, then
    BiCGSTAB (van der Vorst 1992), with regular looks at the true residual. Where
    BiCGSTAB did not halve it, Richardson steps follow all the same, which converge
    whenever the operator is a contraction in some norm. After the first steps `matvec`
    occurs only once in the program, which keeps compilation short: what it is applied
    to depends on the phase.

    Args:
      matvec: a linear map on arrays of the shape of `b`.
      b: the right-hand side.
      tolerance: relative residual in the Euclidean norm; default ``eps ** 0.8``.
      max_steps: applications of `matvec` at most.

    Returns:
      x. Judge it by its residual: the best iterate is returned however it ended.
    """
    if tolerance is None:
        tolerance = float(jnp.finfo(b.dtype).eps) ** 0.8
    target = tolerance * _norm(b)
    tiny = float(jnp.finfo(b.dtype).tiny)

    def richardson(k: _Solve, image: jax.Array) -> _Solve:
        x, r = k.x + k.r, k.r - image
        error = _norm(r)
        finished = (error <= target) | ~jnp.isfinite(error) | (k.steps >= _KRYLOV_STEPS)
        return k._replace(
            phase=jnp.where(finished, _LOOK, _RICHARDSON).astype(jnp.int32), steps=k.steps + 1,
            x=x, r=r, error=error, z=jnp.where(finished, x, r),
        )

    def krylov(k: _Solve, image: jax.Array) -> _Solve:
        alpha = _ratio(k.rho, _dot(k.shadow, image), tiny)
        s = k.r - alpha * image
        k = k._replace(x=k.x + alpha * k.p, r=s, v=image, alpha=alpha)
        return k._replace(phase=jnp.int32(_KRYLOV_HALF), z=s)

    def krylov_half(k: _Solve, image: jax.Array) -> _Solve:
        omega = _ratio(_dot(image, k.r), _dot(image, image), tiny)
        x, r = k.x + omega * k.r, k.r - omega * image
        error, rho = _norm(r), _dot(k.shadow, r)
        p = r + _ratio(rho * k.alpha, k.rho * omega, tiny) * (k.p - omega * k.v)
        finished = (error <= target / 2) | (k.steps >= _KRYLOV_STEPS) | ~jnp.isfinite(error)
        k = k._replace(x=x, r=r, error=error, p=p, rho=rho, steps=k.steps + 1)
        after = jnp.where(finished, _LOOK, _KRYLOV).astype(jnp.int32)
        return k._replace(phase=after, z=jnp.where(finished, x, p))

    def look(k: _Solve, image: jax.Array) -> _Solve:
        """Judges x by its true residual; what failed is left for the best x so far."""
        r = b - image
        error = _norm(r)
        better = error < k.best_error  # false for NaN
        halved = error <= k.best_error / 2
        best = jnp.where(better, k.x, k.best)
        best_error = jnp.where(better, error, k.best_error)
        stop = (best_error <= target) | (k.forced & ~better & ~k.returning)
        returning = ~(better | k.returning | stop)
        after = jnp.where(halved, _KRYLOV, jnp.where(returning, _LOOK, _RICHARDSON))
        return k._replace(
            phase=jnp.where(stop, _DONE, after).astype(jnp.int32), steps=jnp.int32(0),
            x=best, r=r, error=error, p=r, shadow=r, rho=_dot(r, r),
            z=jnp.where(returning, best, r), best=best, best_error=best_error,
            forced=jnp.where(returning, k.forced, ~halved), returning=returning,
        )

    def step(k: _Solve) -> _Solve:
        branches = (richardson, krylov, krylov_half, look)
        k = lax.switch(k.phase, branches, k, matvec(k.z))
        return k._replace(num_steps=k.num_steps + 1)

    def contract(carry):
        x, r, error, _, n = carry
        x, r = x + r, r - matvec(r)
        new = _norm(r)
        return x, r, new, new <= _GOOD_RATE * error, n + 1

    def contracts(carry):
        _, _, error, fast, n = carry
        return fast & (error > target) & (n < max_steps)

    # Most systems are finished here, in a loop with nothing to decide.
    zero, none, no = jnp.zeros_like(b), jnp.int32(0), jnp.bool_(False)
    x, r, error, fast, n = lax.while_loop(
        contracts, contract, (zero, b, _norm(b), jnp.bool_(True), none)
    )
    first = _Solve(
        phase=jnp.where(fast, _LOOK, _KRYLOV).astype(jnp.int32), z=jnp.where(fast, x, r),
        x=x, r=r, error=error, shadow=r, p=r, v=zero, rho=_dot(r, r), alpha=jnp.ones((), b.dtype),
        steps=none, forced=no, returning=no, best=jnp.where(jnp.isfinite(target), zero, jnp.nan),
        best_error=_norm(b), num_steps=n,
    )
    last = lax.while_loop(lambda k: (k.phase != _DONE) & (k.num_steps < max_steps), step, first)
    return last.best


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


def _dot(x: jax.Array, y: jax.Array) -> jax.Array:
    return jnp.sum(x * y)


def _norm(x: jax.Array) -> jax.Array:
    return jnp.sqrt(_dot(x, x))


def _ratio(x: jax.Array, y: jax.Array, tiny: float) -> jax.Array:
    """x / y, and zero where y has vanished, which restarts the recurrence."""
    safe = jnp.abs(y) > tiny
    return jnp.where(safe, x / jnp.where(safe, y, 1), 0)
