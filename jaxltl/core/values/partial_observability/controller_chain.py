"""The chain of states and memory states of a finite-state controller, as a linear system inside ``jit``."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxltl.core.values.engine.iterate import sequential_vmap
from jaxltl.core.values.engine.linear import inverse, solve_linear

# Pairs up to which a chain is factorised, once for both systems (benchmarks/learner_cases.py): a step takes
# 4e-4 s for 152 pairs and 4e-3 s for 462 in single precision; by BiCGSTAB 9e-4 s, and 2e-2 to 6e-2 s. The
# factors of a lane take 5 MB.
_DENSE_LIMIT = 768


class ControllerChain(NamedTuple):
    """``x - discount P x`` over pairs of M memory states and N states, for values ``[M, N]``."""

    successor: jax.Array  # ``int32[N, A, K]``
    probability: jax.Array  # ``float[N, A, K]``
    act: jax.Array  # ``float[M, N, A]``, of each state
    keep: jax.Array  # ``float[M, N, M]``, of the next memory state, by the state that is entered
    discount: jax.Array  # ``float[]``

    def onward(self, x: jax.Array) -> jax.Array:
        """``discount P x``."""
        entering = jnp.einsum("mnk,kn->mn", self.keep, x)
        after = jnp.sum(self.probability * entering[:, self.successor], -1)
        return self.discount * jnp.sum(self.act * after, -1)

    def matvec(self, x: jax.Array) -> jax.Array:
        """The system applied to ``[M, N]``."""
        return x - self.onward(x)

    def vecmat(self, y: jax.Array) -> jax.Array:
        """Its transpose applied to ``[M, N]``."""
        (back,) = jax.linear_transpose(self.onward, y)(y)
        result: jax.Array = y - back
        return result

    def matrix(self) -> jax.Array:
        """The system as ``float[M N, M N]``."""
        num_memory, num_states, _ = self.act.shape
        size = num_memory * num_states
        weight = self.act[..., None] * self.probability  # [M, N, A, K]
        row = jnp.broadcast_to(
            jnp.arange(num_states)[:, None], (num_states, self.successor[0].size)
        )
        step = jnp.zeros((num_memory, num_states, num_states), weight.dtype)
        step = step.at[:, row, self.successor.reshape(num_states, -1)].add(
            weight.reshape(num_memory, num_states, -1)
        )
        moved = step[:, :, None] * jnp.moveaxis(self.keep, 2, 1)[:, None]  # [M, N, M, N]
        return jnp.eye(size, dtype=weight.dtype) - self.discount * moved.reshape(size, size)


class ChainFactors(NamedTuple):
    """A matrix of 2 by 2 blocks ``[[A, B], [C, D]]``, factorised: half the cost of its inverse."""

    first: jax.Array  # the inverse of A
    right: jax.Array  # B
    below: jax.Array  # C A^-1
    second: jax.Array  # the inverse of the Schur complement D - C A^-1 B

    @classmethod
    def of(cls, matrix: jax.Array) -> ChainFactors:
        """The factors of ``float[N, N]``, stable as :func:`~jaxltl.core.values.engine.linear.inverse` is."""
        n = len(matrix) // 64 * 32  # half of the blocks of the inversion
        first = inverse(matrix[:n, :n]) if n else matrix[:0, :0]
        right, below = matrix[:n, n:], matrix[n:, :n] @ first
        return cls(first, right, below, inverse(matrix[n:, n:] - below @ right))

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution for ``[N]``."""
        n = len(self.first)
        end = self.second @ (b[n:] - self.below @ b[:n])
        return jnp.concatenate([self.first @ (b[:n] - self.right @ end), end])

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        n = len(self.first)
        start = b[:n] @ self.first
        end = (b[n:] - start @ self.right) @ self.second
        return jnp.concatenate([start - end @ self.below, end])


class ControllerSolver(NamedTuple):
    """Solutions of a controller's chain and of its transpose; lanes of a ``vmap`` one after the other."""

    # Batches of gathers are slow, and lanes of one loop would wait for the slowest.
    chain: ControllerChain
    factors: ChainFactors | None  # of small chains

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution for a right-hand side ``[M, N]``."""
        return sequential_vmap(_solution, self, b)

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        if self.factors is None:
            return sequential_vmap(partial(_krylov, transposed=True), self.chain, b)
        return self.factors.transpose_solve(b.ravel()).reshape(b.shape)


def controller_solver(chain: ControllerChain) -> ControllerSolver:
    """The solver of a chain: factorisation of small ones, else BiCGSTAB."""
    chain = jax.lax.stop_gradient(chain)
    size = chain.act.shape[0] * chain.act.shape[1]
    small = size <= _DENSE_LIMIT
    return ControllerSolver(
        chain, sequential_vmap(lambda x: ChainFactors.of(x.matrix()), chain) if small else None
    )


def _solution(solver: ControllerSolver, b: jax.Array) -> jax.Array:
    if solver.factors is None:
        return _krylov(solver.chain, b)
    x = solver.factors.solve(b.ravel()).reshape(b.shape)
    rest = b - solver.chain.matvec(x)  # refined once
    refined: jax.Array = x + solver.factors.solve(rest.ravel()).reshape(b.shape)
    return refined


def _krylov(chain: ControllerChain, b: jax.Array, *, transposed: bool = False) -> jax.Array:
    # Of a chain that seldom ends, restarts lose the progress; in single precision rounding does.
    patient = bool(b.dtype == jnp.float64)
    return solve_linear(chain.vecmat if transposed else chain.matvec, b, patient=patient)
