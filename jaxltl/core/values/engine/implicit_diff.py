"""Implicit derivatives of fixed points, and linear systems of absorbing chains for them.

The condition of ``(I - P_pi) x = b`` grows with the expected number of steps, so a Krylov method
alone stagnates. Small systems are inverted; large ones are eliminated on the host, where sparse
elimination loses no more digits than the number of steps costs; those over a mesh are solved by
refined BiCGSTAB.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol, TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.mesh.sharded import is_sharded
from jaxltl.core.models.ops.array_namespace import host_callback
from jaxltl.core.models.ops.operators import action_mean, expectation
from jaxltl.core.models.protocols import ActionModel, PyTree
from jaxltl.core.sparse.linear.elimination import factorize
from jaxltl.core.sparse.linear.topological_order import Edges, ordered_components
from jaxltl.core.values.engine.iterate import sequential_vmap
from jaxltl.core.values.engine.linear import (
    DENSE_LIMIT,
    LinearSolver,
    Operator,
    inverse,
    norm,
    solve_linear,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_FAST_STEPS = 256  # of a Krylov method, which suffice for chains that mix well


class LinearSystem(Protocol):
    """Solvers of a linear system and of its transpose; a tree of arrays."""

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution for a right-hand side."""

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""


def implicit(
    operator: Operator, fixed_point: jax.Array, system: LinearSystem | None = None
) -> jax.Array:
    """A fixed point ``v = operator(v)`` with its implicit derivative."""
    # The result is differentiable, forward and reverse, in everything that `operator` closes over:
    # ``dv = (I - J)^-1 d(operator)`` with J the Jacobian in v (implicit function theorem). No
    # iteration is unrolled; each derivative solves one linear system ``I - J``, or its transpose,
    # by a Krylov method if none is given.
    fixed_point, system = lax.stop_gradient((fixed_point, system))

    if system is not None and not isinstance(system, ChainSystem):
        # Only arguments with a derivative count, which is cheaper in lanes than the rule below.
        result: jax.Array = lax.custom_root(
            lambda v: v - operator(v), fixed_point, lambda _, start: start, partial(_solved, system)
        )
        return result
    # A system that is expensive to trace is traced only where a derivative is taken;
    # ``lax.custom_root`` traces it in any case, which is half of a solver's trace.
    closed = jax.make_jaxpr(operator)(fixed_point)

    def image(constants: list[jax.Array], v: jax.Array) -> jax.Array:
        result: jax.Array = jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, constants))(v)[0]
        return result

    @jax.custom_jvp
    def root(constants: list[jax.Array], system: LinearSystem | None, v: jax.Array) -> jax.Array:
        return v

    @root.defjvp
    def _(primals: PyTree, tangents: PyTree) -> tuple[jax.Array, jax.Array]:
        constants, system, v = primals
        v = root(constants, system, v)
        _, change = jax.jvp(lambda c: image(c, v), (constants,), (tangents[0],))
        _, jacobian = jax.linearize(lambda x: image(constants, x), v)
        return v, _solved(system, lambda x: x - jacobian(x), change)

    return root(closed.consts, system, fixed_point)


def _solved(system: LinearSystem | None, matvec: Operator, b: jax.Array) -> jax.Array:
    result: jax.Array = lax.custom_linear_solve(
        matvec,
        b,
        solve=solve_linear if system is None else lambda _, b: system.solve(b),
        transpose_solve=(
            solve_linear if system is None else lambda _, b: system.transpose_solve(b)
        ),
    )
    return result


class ChainSystem(NamedTuple):
    """The system ``x - mask * (P_pi x)[row_of]``."""

    model: ActionModel  # a padded model or a product of one
    policy: jax.Array  # ``float[S, A]`` or ``int32[S]``
    mask: jax.Array  # ``bool[S]``, the transient states
    # ``int32[S]``, the flat state from which a state takes its row; None for its own
    row_of: jax.Array | None = None

    def image(
        self, x: jax.Array, reward: jax.Array | float = 0, outside: jax.Array | float = 0
    ) -> jax.Array:
        """``(r + P x)_pi`` in the transient states, `outside` elsewhere."""
        ahead = action_mean(self.policy, reward + expectation(self.model, x))
        if self.row_of is not None:
            ahead = ahead.ravel()[self.row_of]
        return jnp.where(self.mask, ahead, outside)

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution of the system."""
        return self._solve(lambda x: x - self.image(x), b, False)

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        back = jax.vjp(self.image, jnp.zeros_like(b))[1]
        return self._solve(lambda y: y - back(y)[0], b, True)

    def _solve(self, matvec: Operator, b: jax.Array, transposed: bool) -> jax.Array:
        if is_sharded(self.model):
            return solve_linear(matvec, b, patient=True)
        x = solve_linear(matvec, b, max_steps=_FAST_STEPS)
        size = norm(b.ravel())
        # The norm of the inverse, and so the relative error, is at least that of x over that of b.
        error = norm((b - matvec(x)).ravel()) * jnp.maximum(norm(x.ravel()), size)
        accurate = error <= float(jnp.finfo(b.dtype).eps) ** 0.7 * size**2  # false for NaN
        return _unless(accurate, x, lambda: self._direct(matvec, b, transposed))

    def _direct(self, matvec: Operator, b: jax.Array, transposed: bool) -> jax.Array:
        """The solution by inversion if the system is small, else by elimination on the host."""
        if b.size <= DENSE_LIMIT:
            eye = jnp.eye(b.size, dtype=b.dtype).reshape(b.size, *b.shape)
            matrix = lax.map(matvec, eye, batch_size=min(b.size, 32)).reshape(b.size, b.size).T
            inverted, right = sequential_vmap(inverse, matrix), b.ravel()
            x: jax.Array = inverted @ right
            x += inverted @ (right - matrix @ x)
            return x.reshape(b.shape)
        result = jax.ShapeDtypeStruct(b.shape, b.dtype)
        x = host_callback(_eliminated(transposed), result, self, b)
        return _unless(jnp.all(jnp.isfinite(x)), x, lambda: solve_linear(matvec, b, patient=True))


def with_derivative(
    value: jax.Array,
    chain: ChainSystem,
    *,
    reward: jax.Array | float = 0,
    outside: jax.Array | float = 0,
    inverse: LinearSolver | None = None,
) -> jax.Array:
    """The value of a policy, ``x = (r + P x)_pi`` in transient states, with its derivative."""
    # That of an optimum is the derivative of the policy that attains it (Danskin).
    image = partial(chain.image, reward=reward, outside=outside)
    return implicit(image, value, lax.stop_gradient(chain) if inverse is None else inverse)


def _unless(done: jax.Array, x: jax.Array, otherwise: Callable[[], jax.Array]) -> jax.Array:
    """x if `done`, else ``otherwise()``, which a batch evaluates only if some lane needs it."""
    # A loop of at most one step: ``lax.cond`` with a batched predicate evaluates both branches, and
    # batches all that they close over.

    def body(_: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        return jnp.ones_like(done), otherwise()

    return lax.while_loop(lambda state: ~state[0], body, (done, x))[1]


def _eliminated(transposed: bool) -> Callable[..., np.ndarray]:
    def solve(system: ChainSystem, b: np.ndarray) -> np.ndarray:
        x = _solution(_transitions(system), b.astype(np.float64).ravel(), transposed)
        return x.reshape(b.shape)

    return solve


def _transitions(system: ChainSystem) -> csr_array | None:
    """``float64[N, N]``, the chain on transient states, SciPy's; None if rows are invalid."""
    from scipy.sparse import csr_array, diags_array

    try:
        sparse = to_sparse(system.model)
    except ValueError:
        return None
    host, policy = sparse.host, system.policy
    if policy.ndim == system.mask.ndim:
        weight = policy.ravel()[host.state] == np.asarray(sparse.action)
    else:
        weight = policy.reshape(host.num_states, -1)[host.state, np.asarray(sparse.action)]
    rows = np.arange(host.num_rows)
    mix = csr_array(
        (weight.astype(np.float64), rows, host.row_start), shape=(host.num_states, host.num_rows)
    )
    chain = (mix @ host.matrix).tocsr()
    if system.row_of is not None:
        chain = chain[system.row_of.ravel()]
    transient = (diags_array(system.mask.ravel().astype(np.float64)) @ chain).tocsr()
    transient.eliminate_zeros()
    return transient


def _solution(chain: csr_array | None, b: np.ndarray, transposed: bool) -> np.ndarray:
    """The solution by sparse elimination, refined once; NaN where that failed."""
    failed = np.full(b.size, np.nan)
    if chain is None:
        return failed
    matrix = chain.T.tocsr() if transposed else chain
    matrix.sort_indices()
    label = ordered_components(Edges(matrix.indptr, matrix.indices))
    solver = factorize(matrix, label, np.arange(b.size))
    if solver is None:
        return failed
    x = solver.solve(b)
    return x + solver.solve(b + matrix @ x - x)
