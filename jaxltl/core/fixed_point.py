"""Fixed points: linear systems, Newton's method, and implicit derivatives for all of them."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.sparse.linalg import bicgstab

Operator = Callable[[jax.Array], jax.Array]
LinearSolver = Callable[[Operator, jax.Array], jax.Array]

_CHUNK = 32  # Krylov or Richardson steps between two looks at the true residual


def implicit(
    operator: Operator, fixed_point: jax.Array, *, solve: LinearSolver | None = None
) -> jax.Array:
    """A fixed point ``v = operator(v)`` with its implicit derivative attached.

    However `fixed_point` was found, the result is differentiable, forward and reverse, in
    everything that `operator` closes over: ``dv = (I - J)^-1 d(operator)`` with J the
    Jacobian in v (implicit function theorem). No iteration is unrolled; one linear
    system is solved per derivative, by :func:`solve_linear` on the operator itself
    or on its transpose.

    Args:
      operator: a differentiable map from values to values of the same shape.
      fixed_point: a value that satisfies the equation.
      solve: solves ``matvec(x) = b``; default :func:`solve_linear`.

    Returns:
      `fixed_point`.

    Example:
      >>> a = jnp.array(0.5)
      >>> jax.grad(lambda a: implicit(lambda v: 1 + a * v, jnp.array(2.0)))(a).item()
      4.0
    """

    solve = solve_linear if solve is None else solve

    def solve_tangent(jacobian: Operator, b: jax.Array) -> jax.Array:
        return lax.custom_linear_solve(jacobian, b, solve=solve, transpose_solve=solve)

    return lax.custom_root(
        lambda v: v - operator(v),
        lax.stop_gradient(fixed_point),
        solve=lambda _, start: start,
        tangent_solve=solve_tangent,
    )


def solve_linear(
    matvec: Operator,
    b: jax.Array,
    *,
    start: jax.Array | None = None,
    tolerance: jax.Array | float | None = None,
    max_rounds: jax.Array | int = 1000,
) -> jax.Array:
    """Solves ``matvec(x) = b`` where matvec is the identity minus an operator.

    Chunks of BiCGSTAB (van der Vorst 1992), each judged by its true residual; a chunk that
    did not halve it is replaced by Richardson steps ``x + (b - matvec(x))``, which
    converge whenever the operator is a contraction in some norm. Stops when neither
    makes progress.

    Args:
      matvec: a linear map on arrays of the shape of `b`.
      b: the right-hand side.
      start: where to start; default `b`.
      tolerance: relative residual in the Euclidean norm; default 16 roundings.
      max_rounds: chunks at most.

    Returns:
      x. Judge it by its residual: the best iterate is returned however it ended.
    """
    if tolerance is None:
        tolerance = 16 * jnp.finfo(b.dtype).eps
    target = tolerance * _norm(b)
    start = b if start is None else start

    def richardson(x: jax.Array) -> jax.Array:
        return lax.fori_loop(0, _CHUNK, lambda _, x: x + (b - matvec(x)), x)

    def residual(x: jax.Array) -> jax.Array:
        norm = _norm(b - matvec(x))
        return jnp.where(jnp.isfinite(norm), norm, jnp.inf)

    def round_(carry):
        x, error, n, _ = carry
        krylov, _ = bicgstab(matvec, b, x0=x, tol=0.0, atol=target / 2, maxiter=_CHUNK)
        krylov_error = residual(krylov)
        good = krylov_error <= error / 2
        other = lax.cond(good, lambda x: krylov, richardson, x)
        other_error = lax.cond(good, lambda x: krylov_error, residual, other)
        better = other_error < error
        x = jnp.where(better, other, x)
        return x, jnp.where(better, other_error, error), n + 1, better

    def unfinished(carry):
        _, error, n, progress = carry
        return (error > target) & (n < max_rounds) & progress

    x, _, _, _ = lax.while_loop(
        unfinished, round_, (start, residual(start), jnp.int32(0), jnp.bool_(True))
    )
    return x


def solve_dense(matvec: Operator, b: jax.Array) -> jax.Array:
    """Solves ``matvec(x) = b`` by elimination: for small systems, however ill-conditioned."""
    basis = jnp.eye(b.size, dtype=b.dtype).reshape(b.size, *b.shape)
    columns = jax.vmap(matvec)(basis).reshape(b.size, b.size)
    return jnp.linalg.solve(columns.T, b.ravel()).reshape(b.shape)


def newton_step(
    operator: Operator, v: jax.Array, *, tolerance: jax.Array | float = 1e-4
) -> jax.Array:
    """One step of Newton's method on ``v - operator(v) = 0``, solved to a relative `tolerance`."""
    image, tangent = jax.linearize(operator, v)
    step = solve_linear(
        lambda x: x - tangent(x), image - v, tolerance=tolerance, max_rounds=8
    )
    return v + step


def _norm(x: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.sum(x * x))
