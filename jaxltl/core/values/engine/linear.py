"""Linear solvers of policy evaluation ``(I - c P_w) x = b`` and its transpose, inside ``jit``.

Small systems are inverted by elimination, so that the number of expected steps does not matter; not
by LAPACK, which serialises batches of small systems by its threads. Large systems are
solved by Richardson iteration and BiCGSTAB (van der Vorst 1992).
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
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.values.engine.iterate import sequential_vmap, iterate

Operator = Callable[[jax.Array], jax.Array]

DENSE_LIMIT = 512  # states up to which a system is inverted
_BLOCK = 32
_REFINEMENTS = 2
_KRYLOV_REFINEMENTS = 16
_INNER_TOLERANCE = 1e-2  # relative residual of one system of these
MOST_PRODUCTS = 20_000  # with the system, in one run of BiCGSTAB
_GOOD_RATE = 0.7  # a contraction at least this fast needs no Krylov method
_STRETCH = 64  # steps between two looks at the true residual


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

    def matrix(self) -> jax.Array:
        """The system as ``float[N, N]``."""
        n = self.num_states
        eye = jnp.eye(n, dtype=jax.tree.leaves(self.weight)[0].dtype)
        if not isinstance(self.table, SuccessorTable):
            if isinstance(self.table, ModelOperator):
                model = self.table.model
                policy = jnp.stack(self.weight, -1).reshape(*model.state_shape, -1)
                found = transition_matrix(model, policy)
            elif isinstance(self.table, RowEntries):
                found = self.table.matrix(self.weight)
            else:
                found = self.table.choices.mean(self.weight, self.table.expectation(eye))
            return eye - jnp.broadcast_to(self.scale, (n,))[:, None] * found
        rows = jnp.arange(n)
        target = jnp.asarray(self.table.successor)  # [A, K, N]
        weight = jnp.stack(self.weight)[:, None] * jnp.asarray(self.table.probability)
        return eye.at[jnp.broadcast_to(rows, target.shape), target].add(-self.scale * weight)


class Inverse(NamedTuple):
    """A system and its inverse ``float[N, N]``, by which it is solved with refinement."""

    system: System
    inverse: jax.Array

    def counted(self, b: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The result of :meth:`solve`, and the number of products with the system."""
        x = _refined(self.inverse, self.system.matvec, b.ravel())
        return x.reshape(b.shape), jnp.int32(_REFINEMENTS)

    def solve(self, b: jax.Array) -> jax.Array:
        """x with ``(I - c P_w) x = b``, for values of any shape with N entries."""
        return self.counted(b)[0]

    def transpose_counted(self, b: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The result of :meth:`transpose_solve`, and the number of products."""
        # Without refinement: the transposed product would be a scatter.
        return (b.ravel() @ self.inverse).reshape(b.shape), jnp.int32(0)

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        return self.transpose_counted(b)[0]


class Krylov(NamedTuple):
    """A system solved by :func:`solve_linear`, with the interface of :class:`Inverse`."""

    system: System  # the system
    # relative residual; default as of :func:`solve_linear`
    tolerance: jax.Array | float | None = None
    max_steps: jax.Array | int = 100_000  # maximal number of products with the system

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution of the system."""
        return self.counted(b)[0]

    def counted(self, b: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The solution of the system, and the number of products."""
        return self._counted(System.matvec, b)

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        return self.transpose_counted(b)[0]

    def transpose_counted(self, b: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The solution of the transposed system, and the number of products."""
        return self._counted(System.vecmat, b)

    def _counted(
        self, apply: Callable[[System, jax.Array], jax.Array], b: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        x, n = _krylov(
            lambda table, given, x: apply(System(table, *given), x),
            self.system.table,
            self.system[1:],
            b.ravel(),
            (self.tolerance, self.max_steps),
        )
        return x.reshape(b.shape), n


def solver(
    system: System, method: str = "auto", *, max_steps: jax.Array | int = 100_000
) -> Inverse | Krylov:
    """The solver of a system by method: direct (inversion), iterative, or auto by size."""
    if method not in ("auto", "direct", "iterative"):
        raise ValueError(f"method={method!r}; choose auto, direct or iterative.")
    system = lax.stop_gradient(system)
    small = is_small(system.table, system.num_states)
    if method == "iterative" or (method == "auto" and not small):
        return Krylov(system, max_steps=max_steps)
    return Inverse(system, sequential_vmap(inverse, system.matrix()))


def is_small(table: SweepOperator, num_states: int) -> bool:
    """True if systems of `num_states` are inverted; sharded ones are not."""
    spread = isinstance(table, ModelOperator | ShardedSuccessorTable) and is_sharded(table.model)
    return num_states <= DENSE_LIMIT and not spread


def _refined(inverse_: jax.Array, matvec: Operator, b: jax.Array) -> jax.Array:
    x = inverse_ @ b
    for _ in range(_REFINEMENTS):
        better = x + inverse_ @ (b - matvec(x))
        x = jnp.where(jnp.isfinite(better), better, x)
    return x


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


# --- large systems ---------------------------------------------------------------------------


class Bicgstab(NamedTuple):
    """State of BiCGSTAB in the notation of van der Vorst (1992), arrays ``[N]``."""

    # One iteration has two products with the system. `r` is the residual of x by recurrence.

    x: jax.Array
    r: jax.Array
    shadow: jax.Array
    p: jax.Array
    v: jax.Array
    rho: jax.Array
    alpha: jax.Array

    @property
    def size(self) -> jax.Array:
        """The norm of the residual."""
        return norm(self.r)

    def first(self, image: jax.Array) -> Bicgstab:
        """First half of an iteration, from the product with `p`; the next one is with `r`."""
        alpha = _ratio(self.rho, dot(self.shadow, image))
        return self._replace(
            x=self.x + alpha * self.p, r=self.r - alpha * image, v=image, alpha=alpha
        )

    def second(self, image: jax.Array) -> Bicgstab:
        """Second half of an iteration, from the product with `r`; the next one is with `p`."""
        omega = _ratio(dot(image, self.r), dot(image, image))
        x, r = self.x + omega * self.r, self.r - omega * image
        rho = dot(self.shadow, r)
        p = r + _ratio(rho * self.alpha, self.rho * omega) * (self.p - omega * self.v)
        return self._replace(x=x, r=r, p=p, rho=rho)


def start_bicgstab(x: jax.Array, r: jax.Array) -> Bicgstab:
    """The state for an x with residual r."""
    rho = dot(r, r)
    return Bicgstab(x, r, r, r, jnp.zeros_like(r), rho, jnp.ones_like(rho))


class _Search(NamedTuple):
    """State of :func:`solve_linear`."""

    phase: jax.Array
    z: jax.Array  # argument of the next product
    krylov: Bicgstab
    error: jax.Array  # norm of the residual
    steps: jax.Array  # in this phase
    forced: jax.Array  # whether the last phase was Richardson steps after a failure of BiCGSTAB
    returning: jax.Array  # whether this product only gives the residual of the best x
    best: jax.Array  # the x with the least true residual
    best_error: jax.Array
    num_steps: jax.Array


_RICHARDSON, _FIRST, _SECOND, _LOOK, _DONE = range(5)


class _Goal(NamedTuple):
    """Right-hand side, residual to reach, and maximal number of steps."""

    b: jax.Array
    target: jax.Array
    most: jax.Array


def solve_linear(
    matvec: Operator,
    b: jax.Array,
    *,
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 100_000,
) -> jax.Array:
    """Solves ``matvec(x) = b`` where matvec is the identity minus an operator."""
    # Richardson steps ``x + (b - matvec(x))`` while they contract well, then BiCGSTAB (van der
    # Vorst 1992), restarted from the true residual at regular intervals. If BiCGSTAB does not halve
    # it, Richardson steps follow, which converge whenever the operator is a contraction in some
    # norm; they end when their rate shows that `max_steps` would not be enough.

    def flat(table: None, given: tuple[()], x: jax.Array) -> jax.Array:
        return matvec(x.reshape(b.shape)).ravel()

    x, _ = _krylov(flat, None, (), b.ravel(), (tolerance, max_steps))
    return x.reshape(b.shape)


def _krylov(
    matvec: Callable[..., jax.Array], table: PyTree, given: PyTree, b: jax.Array, limits: PyTree
) -> tuple[jax.Array, jax.Array]:
    """The solution ``[N]`` of ``matvec(table, given, x) = b``, and the steps made.

    `limits` are the relative residual, or None, and the most steps.
    """
    tolerance, max_steps = limits
    if tolerance is None:
        tolerance = float(jnp.finfo(b.dtype).eps) ** 0.8
    size = norm(b)
    goal = _Goal(b, tolerance * size, jnp.asarray(max_steps, jnp.int32))

    def step(table: PyTree, k: _Search, given: PyTree) -> _Search:
        given, goal = given
        image = matvec(table, given, k.z)
        branches = [partial(f, goal) for f in (_richardson, _first, _second, _check_residual)]
        k = lax.switch(k.phase, branches, k, image)
        return k._replace(num_steps=k.num_steps + 1)

    zero, none, no = jnp.zeros_like(b), jnp.int32(0), jnp.bool_(False)
    start = _Search(
        phase=jnp.int32(_RICHARDSON),
        z=b,
        krylov=start_bicgstab(zero, b),
        error=size,
        steps=none,
        forced=no,
        returning=no,
        best=jnp.where(jnp.isfinite(size), zero, jnp.nan),
        best_error=size,
        num_steps=none,
    )
    last, n = iterate(
        step,
        lambda k, _: k.phase == _DONE,
        (table, start, (given, goal)),
        max_steps=max_steps,
        lanes="mapped" if table is None else "in turn",
    )
    return last.best, n


def _richardson(goal: _Goal, k: _Search, image: jax.Array) -> _Search:
    x, r = k.krylov.x + k.krylov.r, k.krylov.r - image
    error = norm(r)
    small = (error <= goal.target) | ~jnp.isfinite(error) | (k.forced & (k.steps >= _STRETCH))
    # Richardson steps while they contract well, then BiCGSTAB from their iterate.
    slow = ~k.forced & (error > _GOOD_RATE * k.error)
    look = small & ~slow
    after = jnp.where(look, _LOOK, jnp.where(slow, _FIRST, _RICHARDSON)).astype(jnp.int32)
    return k._replace(
        phase=after,
        krylov=start_bicgstab(x, r),
        error=error,
        z=jnp.where(look, x, r),
        steps=jnp.where(slow, 0, k.steps + 1),
    )


def _first(goal: _Goal, k: _Search, image: jax.Array) -> _Search:
    krylov = k.krylov.first(image)
    return k._replace(krylov=krylov, phase=jnp.full_like(k.phase, _SECOND), z=krylov.r)


def _second(goal: _Goal, k: _Search, image: jax.Array) -> _Search:
    krylov = k.krylov.second(image)
    error = krylov.size
    ended = (error <= goal.target / 2) | (k.steps >= _STRETCH) | ~jnp.isfinite(error)
    return k._replace(
        krylov=krylov,
        error=error,
        steps=k.steps + 1,
        phase=jnp.where(ended, _LOOK, _FIRST).astype(jnp.int32),
        z=jnp.where(ended, krylov.x, krylov.p),
    )


def _check_residual(goal: _Goal, k: _Search, image: jax.Array) -> _Search:
    """Computes the true residual of x, and returns to the best x after a failure."""
    r = goal.b - image
    error = norm(r)
    better = error < k.best_error  # false for NaN
    halved = error <= k.best_error / 2
    best = jnp.where(better, k.krylov.x, k.best)
    best_error = jnp.where(better, error, k.best_error)
    # The number of further phases at this rate, if they are forced.
    tiny = float(jnp.finfo(r.dtype).tiny)
    pace = jnp.log(k.best_error / best_error)
    stretches = jnp.log(best_error / jnp.maximum(goal.target, tiny)) / jnp.maximum(pace, tiny)
    # The rate means nothing before information has passed from every state.
    settled = k.num_steps > 4 * r.shape[0]
    hopeless = settled & (stretches * _STRETCH > goal.most - k.num_steps)
    stop = (best_error <= goal.target) | (k.forced & ~k.returning & (~better | hopeless))
    returning = ~(better | k.returning | stop)
    after = jnp.where(halved, _FIRST, jnp.where(returning, _LOOK, _RICHARDSON))
    return k._replace(
        phase=jnp.where(stop, _DONE, after).astype(jnp.int32),
        steps=jnp.zeros_like(k.steps),
        krylov=start_bicgstab(best, r),
        error=error,
        z=jnp.where(returning, best, r),
        best=best,
        best_error=best_error,
        forced=jnp.where(returning, k.forced, ~halved),
        returning=returning,
    )


def bicgstab(matvec: Operator, b: jax.Array, *, tolerance: float) -> tuple[jax.Array, jax.Array]:
    """x with ``matvec(x) = b`` up to a relative residual, if that converges, and the products."""

    def flat(x: jax.Array) -> jax.Array:
        return matvec(x.reshape(b.shape)).ravel()

    right = b.ravel()
    # In a chain that seldom returns, residuals soon become orthogonal to the first one, and then
    # the recurrence makes no progress; they do not become orthogonal to a random vector.
    shadow = jax.random.normal(jax.random.key(0), right.shape, right.dtype)
    start = start_bicgstab(jnp.zeros_like(right), right)._replace(
        shadow=shadow, rho=dot(shadow, right)
    )
    goal, most = tolerance * norm(right), min(MOST_PRODUCTS, 8 * right.size + 64)

    def body(carry: tuple[Bicgstab, jax.Array]) -> tuple[Bicgstab, jax.Array]:
        k, n = carry
        k = k.first(flat(k.p))
        return k.second(flat(k.r)), n + 2

    def unfinished(carry: tuple[Bicgstab, jax.Array]) -> jax.Array:
        k, n = carry
        return (k.size > goal) & jnp.isfinite(k.size) & (n < most)

    k, n = lax.while_loop(unfinished, body, (start, jnp.int32(0)))
    return k.x.reshape(b.shape), n


def krylov_refined(matvec: Operator, b: jax.Array) -> jax.Array:
    """x with ``matvec(x) = b`` as nearly as the dtype allows, by iterative refinement."""
    goal = float(jnp.finfo(b.dtype).eps) ** 0.8 * norm(b.ravel())

    def body(carry: PyTree) -> PyTree:
        x, residual, _, n = carry
        better = x + bicgstab(matvec, residual, tolerance=_INNER_TOLERANCE)[0]
        residual = b - matvec(better)
        return better, residual, norm(residual.ravel()), n + 1

    def unfinished(carry: PyTree) -> jax.Array:
        _, _, size, n = carry
        result: jax.Array = (size > goal) & (n < _KRYLOV_REFINEMENTS)
        return result

    start = jnp.zeros_like(b), b, norm(b.ravel()), jnp.int32(0)
    return lax.while_loop(unfinished, body, start)[0]


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
