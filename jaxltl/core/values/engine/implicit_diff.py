"""Implicit derivatives of fixed points."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
from jax import lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jaxltl.core.models.protocols import PyTree
from jaxltl.core.values.engine.linear import solve_linear

Operator = Callable[[jax.Array], jax.Array]
LinearSolver = Callable[[jax.Array], jax.Array]


class LinearSystem(Protocol):
    """Solvers of ``A(x) = b`` for one operator A and for its transpose; a tree of arrays."""

    def solve(self, matvec: Operator, b: jax.Array) -> jax.Array:
        """x with ``A(x) = b`` for the operator."""

    def transpose_solve(self, matvec: Operator, b: jax.Array) -> jax.Array:
        """x with ``A(x) = b`` for the transpose, with products by `matvec`."""


class Krylov(NamedTuple):
    """The solvers of :func:`~jaxltl.core.values.engine.linear.solve_linear`."""

    def solve(self, matvec: Operator, b: jax.Array) -> jax.Array:
        """The solution of the system."""
        return solve_linear(matvec, b)

    def transpose_solve(self, matvec: Operator, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        return solve_linear(matvec, b)


def implicit(
    operator: Operator,
    fixed_point: jax.Array,
    *,
    solve: LinearSolver | None = None,
    transpose_solve: LinearSolver | None = None,
    system: LinearSystem = Krylov(),  # noqa: B008
) -> jax.Array:
    """A fixed point ``v = operator(v)`` with its implicit derivative."""
    # The result is differentiable, forward and reverse, in everything that `operator` closes over:
    # ``dv = (I - J)^-1 d(operator)`` with J the Jacobian in v (implicit function theorem). No
    # iteration is unrolled; each derivative solves one linear system, or its transpose.
    if solve is None or transpose_solve is None:
        return _traced_when_differentiated(operator, lax.stop_gradient(fixed_point), system)

    def solve_tangent(jacobian: Operator, b: jax.Array) -> jax.Array:
        result: jax.Array = lax.custom_linear_solve(
            jacobian,
            b,
            solve=lambda _, b: solve(b),
            transpose_solve=lambda _, b: transpose_solve(b),
        )
        return result

    result: jax.Array = lax.custom_root(
        lambda v: v - operator(v),
        lax.stop_gradient(fixed_point),
        solve=lambda _, start: start,
        tangent_solve=solve_tangent,
    )
    return result


def _traced_when_differentiated(
    operator: Operator, fixed_point: jax.Array, system: LinearSystem
) -> jax.Array:
    """The fixed point, with a linear system that is traced only where a derivative is taken."""
    # ``lax.custom_root`` traces it in any case, which is half of a solver's trace.
    closed = jax.make_jaxpr(operator)(fixed_point)

    def image(constants: list[jax.Array], v: jax.Array) -> jax.Array:
        result: jax.Array = jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, constants))(v)[0]
        return result

    @jax.custom_jvp
    def root(constants: list[jax.Array], system: LinearSystem, v: jax.Array) -> jax.Array:
        return v

    @root.defjvp
    def _(primals: PyTree, tangents: PyTree) -> tuple[jax.Array, jax.Array]:
        constants, system, v = primals
        v = root(constants, system, v)
        _, change = jax.jvp(lambda c: image(c, v), (constants,), (tangents[0],))
        _, jacobian = jax.linearize(lambda x: image(constants, x), v)
        return v, lax.custom_linear_solve(
            lambda x: x - jacobian(x),
            change,
            solve=system.solve,
            transpose_solve=system.transpose_solve,
        )

    return root(closed.consts, lax.stop_gradient(system), fixed_point)
