"""Implicit derivatives of fixed points."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
from jax import lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jaxltl.core.values.engine.linear import solve_linear

Operator = Callable[[jax.Array], jax.Array]
LinearSolver = Callable[[jax.Array], jax.Array]


def implicit(
    operator: Operator,
    fixed_point: jax.Array,
    *,
    solve: LinearSolver | None = None,
    transpose_solve: LinearSolver | None = None,
    linear: Callable[[Operator, jax.Array], jax.Array] = solve_linear,
) -> jax.Array:
    """A fixed point ``v = operator(v)`` with its implicit derivative attached.

    However `fixed_point` was found, the result is differentiable, forward and reverse, in
    everything that `operator` closes over: ``dv = (I - J)^-1 d(operator)`` with J the
    Jacobian in v (implicit function theorem). No iteration is unrolled; one linear
    system is solved per derivative, with the operator itself or with its transpose.

    Args:
      operator: a differentiable map from values to values of the same shape.
      fixed_point: a value that satisfies the equation.
      solve, transpose_solve: x with ``(I - J) x = b``, or of the transpose; default `linear`.
      linear: x with ``A(x) = b`` from A and b.

    Returns:
      `fixed_point`.

    Example:
      >>> slope = jax.grad(lambda a: implicit(lambda v: 1 + a * v, jax.numpy.array(2.0)))(0.5)
      >>> round(slope.item(), 3)
      4.0
    """
    if solve is None and transpose_solve is None:
        return _seldom_differentiated(operator, lax.stop_gradient(fixed_point), linear)

    def forward(jacobian: Operator, b: jax.Array) -> jax.Array:
        return linear(jacobian, b) if solve is None else solve(b)

    def backward(jacobian: Operator, b: jax.Array) -> jax.Array:
        return linear(jacobian, b) if transpose_solve is None else transpose_solve(b)

    def solve_tangent(jacobian: Operator, b: jax.Array) -> jax.Array:
        return lax.custom_linear_solve(jacobian, b, solve=forward, transpose_solve=backward)

    return lax.custom_root(
        lambda v: v - operator(v),
        lax.stop_gradient(fixed_point),
        solve=lambda _, start: start,
        tangent_solve=solve_tangent,
    )


def _seldom_differentiated(
    operator: Operator, fixed_point: jax.Array, linear: Callable[[Operator, jax.Array], jax.Array]
) -> jax.Array:
    """The same with a linear solver for the system and its transpose.

    It is traced only where a derivative is taken, which ``lax.custom_root`` does in any case:
    half of a solver's trace.
    """
    closed = jax.make_jaxpr(operator)(fixed_point)

    def image(constants: list[Any], v: jax.Array) -> jax.Array:
        return jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, constants))(v)[0]

    @jax.custom_jvp
    def root(constants: list[Any], v: jax.Array) -> jax.Array:
        return v

    @root.defjvp
    def _(primals: Any, tangents: Any) -> tuple[jax.Array, jax.Array]:
        constants, v = primals
        v = root(constants, v)
        _, change = jax.jvp(lambda c: image(c, v), (constants,), (tangents[0],))
        _, jacobian = jax.linearize(lambda x: image(constants, x), v)
        return v, lax.custom_linear_solve(
            lambda x: x - jacobian(x), change, solve=linear, transpose_solve=linear
        )

    return root(closed.consts, fixed_point)
