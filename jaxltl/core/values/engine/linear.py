"""Linear solvers of policy evaluation ``(I - c P_w) x = b`` and its transpose, inside ``jit``.

Small systems are inverted by elimination, so that the number of expected steps does not matter; not
by LAPACK, which serialises batches of small systems by its threads. Large systems are
solved by BiCGSTAB (van der Vorst 1992) and Richardson iteration.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.mesh.sharded import is_sharded
from jaxltl.core.models.ops.choices import Quantity, RowEntries, SweepOperator
from jaxltl.core.models.ops.operators import transition_matrix
from jaxltl.core.models.ops.successor_tables import (
    ModelOperator,
    ShardedSuccessorTable,
    SuccessorTable,
)
from jaxltl.core.values.engine.iterate import sequential_vmap

Operator = Callable[[jax.Array], jax.Array]

DENSE_LIMIT = 512  # states up to which a system is inverted
_BLOCK = 32
_REFINEMENTS = 2
MAX_PRODUCTS = 100_000
_STRETCH = 128  # products between two looks at the true residual


class System(NamedTuple):
    """``x - scale * sum_a w(s, a) (P x)(s, a)`` over numbered states."""

    # the model's successors, see :func:`~jaxltl.core.models.ops.successor_tables.sweep_operator`
    table: SweepOperator
    # ``float[N]`` for each action, such as a policy's columns; of a sparse model ``float[R]``
    weight: Quantity
    scale: jax.Array  # ``float[N]`` or a scalar, such as the discount; zero where a value is fixed

    @property
    def num_states(self) -> int:
        return self.table.choices.size(self.weight)

    def onward(self, x: jax.Array) -> jax.Array:
        """``scale * P_w x`` for ``[N, ...]``."""
        return self.scale * self.table.choices.mean(self.weight, self.table.expectation(x))

    def matvec(self, x: jax.Array) -> jax.Array:
        """The system applied to ``[N]``."""
        return x - self.onward(x)

    def vecmat(self, y: jax.Array) -> jax.Array:
        """Its transpose applied to ``[N]``."""
        shape = jax.ShapeDtypeStruct(y.shape, y.dtype)
        (back,) = jax.linear_transpose(self.onward, shape)(y)
        result: jax.Array = y - back
        return result

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution for a right-hand side, by the method for the size of the system."""
        return solver(self).solve(b)

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        return solver(self).transpose_solve(b)

    def matrix(self) -> jax.Array:
        """The system as ``float[N, N]``."""
        n = self.num_states
        eye = jnp.eye(n, dtype=jax.tree.leaves(self.weight)[0].dtype)
        if not isinstance(self.table, SuccessorTable):
            if isinstance(self.table, ModelOperator):
                model = self.table.model
                policy = jnp.stack(self.weight, -1).reshape(*model.state_shape, -1)
                matrix = transition_matrix(model, policy)
            elif isinstance(self.table, RowEntries):
                matrix = self.table.matrix(self.weight)
            else:
                matrix = self.table.choices.mean(self.weight, self.table.expectation(eye))
            return eye - jnp.broadcast_to(self.scale, (n,))[:, None] * matrix
        rows = jnp.arange(n)
        target = jnp.asarray(self.table.successor)  # [A, K, N]
        weight = jnp.stack(self.weight)[:, None] * jnp.asarray(self.table.probability)
        return eye.at[jnp.broadcast_to(rows, target.shape), target].add(-self.scale * weight)


class LinearSolver(NamedTuple):
    """Solutions of a system and of its transpose, for values of any shape with N entries."""

    system: System
    inverse: jax.Array | None  # ``float[N, N]``; None for the Krylov method
    max_steps: jax.Array | int  # of the Krylov method, products with the system

    def counted(self, b: jax.Array, *, transposed: bool = False) -> tuple[jax.Array, jax.Array]:
        """The solution, and the number of products with the system."""
        flat, n = b.ravel(), jnp.int32(0)
        if self.inverse is None:
            x, n = sequential_vmap(partial(_krylov, transposed), self.system, flat, self.max_steps)
        elif transposed:  # without refinement: the transposed product would be a scatter
            x = flat @ self.inverse
        else:
            x, n = self.inverse @ flat, n + _REFINEMENTS
            for _ in range(_REFINEMENTS):
                better = x + self.inverse @ (flat - self.system.matvec(x))
                x = jnp.where(jnp.isfinite(better), better, x)
        return x.reshape(b.shape), n

    def solve(self, b: jax.Array) -> jax.Array:
        """x with ``(I - c P_w) x = b``."""
        return self.counted(b)[0]

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        return self.counted(b, transposed=True)[0]


class Transposed(NamedTuple):
    """The transpose of a system with its solutions."""

    linear: LinearSolver

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        return self.linear.transpose_solve(b)

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the system itself."""
        return self.linear.solve(b)


def _krylov(
    transposed: bool, system: System, b: jax.Array, max_steps: jax.Array
) -> tuple[jax.Array, jax.Array]:
    return counted_solution(system.vecmat if transposed else system.matvec, b, None, max_steps)


def solver(
    system: System, method: str = "auto", *, max_steps: jax.Array | int = MAX_PRODUCTS
) -> LinearSolver:
    """The solver of a system by method: direct (inversion), iterative, or auto by size."""
    if method not in ("auto", "direct", "iterative"):
        raise ValueError(f"method={method!r}; choose auto, direct or iterative.")
    system = lax.stop_gradient(system)
    small = is_small(system.table, system.num_states)
    if method == "iterative" or (method == "auto" and not small):
        return LinearSolver(system, None, max_steps)
    return LinearSolver(system, sequential_vmap(inverse, system.matrix()), max_steps)


def is_small(table: SweepOperator, num_states: int) -> bool:
    """True if systems of `num_states` are inverted; sharded ones are not."""
    sharded = isinstance(table, ModelOperator | ShardedSuccessorTable) and is_sharded(table.model)
    return num_states <= DENSE_LIMIT and not sharded


def inverse(matrix: jax.Array) -> jax.Array:
    """The inverse of ``float[N, N]`` by Gauss-Jordan elimination without pivoting, in blocks."""
    # Stable for ``I - c P`` with a stochastic P and ``c <= 1``: elimination without pivoting does
    # not let the entries of a diagonally dominant matrix grow (Higham 2002, section 9.5). A
    # singular matrix gives NaN or infinity.
    n = matrix.shape[-1]
    block = min(_BLOCK, n)
    padded = -(-n // block) * block
    work = jnp.eye(padded, dtype=matrix.dtype).at[:n, :n].set(matrix)
    number = jnp.arange(padded) // block
    smallest = float(jnp.finfo(matrix.dtype).tiny) ** 0.5

    def step(i: jax.Array, a: jax.Array) -> jax.Array:
        start = i * block
        inside = number == i
        rows = lax.dynamic_slice(a, (start, 0), (block, padded))
        columns = jnp.where(inside[:, None], 0, lax.dynamic_slice(a, (0, start), (padded, block)))
        pivot = _small_inverse(lax.dynamic_slice(rows, (0, start), (block, block)))
        rows = pivot @ jnp.where(inside, 0, rows)
        a = jnp.where(inside, 0, a) - columns @ rows
        # Products of numbers this small are subnormal, which is slow, and do not matter.
        a = jnp.where(jnp.abs(a) < smallest, 0, a)
        a = lax.dynamic_update_slice(a, -columns @ pivot, (0, start))
        rows = lax.dynamic_update_slice(rows, pivot, (0, start))
        return lax.dynamic_update_slice(a, rows, (start, 0))

    result: jax.Array = lax.fori_loop(0, padded // block, step, work)[:n, :n]
    return result


def _small_inverse(matrix: jax.Array) -> jax.Array:
    def step(k: jax.Array, x: jax.Array) -> jax.Array:
        pivot, column = x[k, k], x[:, k]
        row = (x[k] / pivot).at[k].set(1 / pivot)
        x = (x - column[:, None] * row).at[:, k].set(-column / pivot)
        return x.at[k].set(row)

    result: jax.Array = lax.fori_loop(0, matrix.shape[0], step, matrix)
    return result


class RowSystem(NamedTuple):
    """``mass * (x - sum_w weight * x[place])`` of padded rows, with its inverse if it is small."""

    place: jax.Array  # ``int32[N, W]``
    weight: jax.Array  # ``float[N, W]``
    mass: jax.Array | float  # ``float[N]`` or 1
    inverse: jax.Array | None  # ``float[N, N]``, of the rows without their mass

    def matvec(self, x: jax.Array) -> jax.Array:
        """The rows without their mass, applied to ``[N]``."""
        return x - jnp.sum(self.weight * x[self.place], axis=1)

    def vecmat(self, y: jax.Array) -> jax.Array:
        """Their transpose applied to ``[N]``."""
        return y - jnp.zeros_like(y).at[self.place].add(self.weight * y[:, None])

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution for a right-hand side, refined once."""
        b = b / self.mass
        if self.inverse is None:
            return solve_linear(self.matvec, b)
        x = self.inverse @ b
        return x + self.inverse @ (b - self.matvec(x))

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        if self.inverse is None:
            return solve_linear(self.vecmat, b) / self.mass
        y = b @ self.inverse
        return (y + (b - self.vecmat(y)) @ self.inverse) / self.mass


def row_system(target: jax.Array, weight: jax.Array, mass: jax.Array | float = 1.0) -> RowSystem:
    """The system of rows ``[N, W]``; targets from N on have the value 0."""
    size = target.shape[0]
    weight, place = jnp.where(target < size, weight, 0), jnp.minimum(target, size - 1)
    if size > DENSE_LIMIT:
        return RowSystem(place, weight, mass, None)
    matrix = jnp.eye(size, dtype=weight.dtype).at[jnp.arange(size)[:, None], place].add(-weight)
    return RowSystem(place, weight, mass, inverse(matrix))


# --- large systems ---------------------------------------------------------------------------


class Bicgstab(NamedTuple):
    """State of BiCGSTAB in the notation of van der Vorst (1992), arrays ``[N]``."""

    # Each half of an iteration has one product with the system, of p and then of r. Plain steps
    # are those of Richardson iteration: alpha and omega are 1, and p is r.

    x: jax.Array
    r: jax.Array  # the residual of x by recurrence
    shadow: jax.Array
    p: jax.Array
    v: jax.Array
    rho: jax.Array
    alpha: jax.Array
    plain: jax.Array

    @property
    def size(self) -> jax.Array:
        """The norm of the residual."""
        return norm(self.r)

    def first(self, image: jax.Array) -> Bicgstab:
        """First half of an iteration, from the product with p."""
        alpha = jnp.where(self.plain, 1, _ratio(self.rho, dot(self.shadow, image)))
        return self._replace(
            x=self.x + alpha * self.p, r=self.r - alpha * image, v=image, alpha=alpha
        )

    def second(self, image: jax.Array) -> Bicgstab:
        """Second half of an iteration, from the product with r."""
        omega = jnp.where(self.plain, 1, _ratio(dot(image, self.r), dot(image, image)))
        x, r = self.x + omega * self.r, self.r - omega * image
        rho = dot(self.shadow, r)
        beta = jnp.where(self.plain, 0, _ratio(rho * self.alpha, self.rho * omega))
        return self._replace(x=x, r=r, p=r + beta * (self.p - omega * self.v), rho=rho)


def bicgstab(
    matvec: Operator,
    b: jax.Array,
    *,
    tolerance: jax.Array | float,
    max_steps: jax.Array | int,
    plain: jax.Array | bool = False,
    shadow: jax.Array | None = None,
) -> tuple[Bicgstab, jax.Array]:
    """BiCGSTAB for ``matvec(x) = b`` until the residual's norm is at most `tolerance`."""
    shadow = b if shadow is None else shadow
    zero, one = jnp.zeros_like(b), jnp.ones((), b.dtype)
    start = Bicgstab(zero, b, shadow, b, zero, dot(shadow, b), one, jnp.asarray(plain))

    def body(carry: tuple[Bicgstab, jax.Array]) -> tuple[Bicgstab, jax.Array]:
        # One product in the program serves both halves.
        k, n = carry
        second = (n & 1) == 1
        image = matvec(jnp.where(second, k.r, k.p))
        return lax.cond(second, Bicgstab.second, Bicgstab.first, k, image), n + 1

    def unfinished(carry: tuple[Bicgstab, jax.Array]) -> jax.Array:
        k, n = carry
        return (k.size > tolerance) & jnp.isfinite(k.size) & (n < max_steps)

    return lax.while_loop(unfinished, body, (start, jnp.int32(0)))


def random_shadow(b: jax.Array) -> jax.Array:
    """A random vector for the recurrence of BiCGSTAB."""
    # In a chain that seldom returns, residuals soon become orthogonal to the first one, and then
    # the recurrence makes no progress; they do not become orthogonal to a random vector.
    return jax.random.normal(jax.random.key(0), b.shape, b.dtype)


class _CountedSearch(NamedTuple):
    """State of :func:`counted_solution`."""

    x: jax.Array
    r: jax.Array  # the true residual of x
    error: jax.Array  # its norm
    plain: jax.Array  # whether BiCGSTAB did not halve it
    num_steps: jax.Array
    ended: jax.Array


def solve_linear(
    matvec: Operator,
    b: jax.Array,
    *,
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = MAX_PRODUCTS,
    patient: bool = False,
) -> jax.Array:
    """Solves ``matvec(x) = b`` where matvec is the identity minus an operator."""

    def flat(x: jax.Array) -> jax.Array:
        return matvec(x.reshape(b.shape)).ravel()

    return counted_solution(flat, b.ravel(), tolerance, max_steps, patient)[0].reshape(b.shape)


def counted_solution(
    matvec: Operator,
    b: jax.Array,
    tolerance: jax.Array | float | None,
    max_steps: jax.Array | int,
    patient: bool = False,
) -> tuple[jax.Array, jax.Array]:
    """:func:`solve_linear` for arrays ``[N]``, and the number of products."""
    # BiCGSTAB (van der Vorst 1992), restarted from the true residual at regular intervals; late if
    # `patient`, for chains with very many expected steps. If it does not halve the residual,
    # Richardson steps follow, which converge whenever the operator is a contraction in some norm;
    # they end when their rate shows that `max_steps` would not be enough.
    stretch = most_products(b.size) if patient else _STRETCH
    shadow = random_shadow(b) if patient else None
    tiny = float(jnp.finfo(b.dtype).tiny)
    size = norm(b)
    target = size * (float(jnp.finfo(b.dtype).eps) ** 0.8 if tolerance is None else tolerance)

    def body(k: _CountedSearch) -> _CountedSearch:
        products = jnp.minimum(stretch, max_steps - k.num_steps)
        inner, n = bicgstab(
            matvec, k.r, tolerance=target / 2, max_steps=products, plain=k.plain, shadow=shadow
        )
        x, n = k.x + inner.x, k.num_steps + n + 1
        r = b - matvec(x)
        error = norm(r)
        better = error < k.error  # false for NaN
        x, r, error = (jnp.where(better, *pair) for pair in ((x, k.x), (r, k.r), (error, k.error)))
        # The number of further stretches at this rate.
        pace = jnp.log(k.error / error)
        rest = jnp.log(error / jnp.maximum(target, tiny)) / jnp.maximum(pace, tiny)
        # The rate means nothing before information has passed from every state.
        hopeless = (n > 4 * b.size) & (rest * stretch > max_steps - n)
        ended = (error <= target) | (k.plain & (~better | hopeless)) | (n >= max_steps)
        return _CountedSearch(x, r, error, ~(error <= k.error / 2), n, ended)

    zero = jnp.where(jnp.isfinite(size), jnp.zeros_like(b), jnp.nan)
    no = jnp.bool_(False)
    last = lax.while_loop(
        lambda k: ~k.ended, body, _CountedSearch(zero, b, size, no, jnp.int32(0), ~(size > 0))
    )
    return last.x, last.num_steps


def most_products(size: int) -> int:
    """Products with a system of N states in one run of BiCGSTAB."""
    return min(20_000, 8 * size + 64)


def dot(x: jax.Array, y: jax.Array) -> jax.Array:
    """Inner product over the states."""
    return jnp.sum(x * y, axis=0)


def norm(x: jax.Array) -> jax.Array:
    """Euclidean norm over the states."""
    return jnp.sqrt(dot(x, x))


def _ratio(x: jax.Array, y: jax.Array) -> jax.Array:
    """x / y, and 0 where y vanishes, which restarts the recurrence."""
    safe = jnp.abs(y) > float(jnp.finfo(y.dtype).tiny)
    return jnp.where(safe, x / jnp.where(safe, y, 1), 0)
