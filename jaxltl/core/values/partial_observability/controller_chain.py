"""The chain of states and memory states of a finite-state controller, as a linear system inside ``jit``."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxltl.core.values.engine.iterate import sequential_vmap
from jaxltl.core.values.engine.linear import inverse, solve_linear

# Pairs up to which a chain is inverted, once for both systems. Seconds of a step in single and double
# precision (benchmarks/learner_cases.py): 152 pairs 7e-4 and 1e-3, 462 pairs 1e-2 and 1.6e-2, 600 pairs
# 2e-2 and 3e-2; by BiCGSTAB 2e-3, 5e-3 to 6e-2, and 5e-2 to 1e-1. The inverse of a lane takes 5 MB.
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


class ControllerSolver(NamedTuple):
    """Solutions of a controller's chain and of its transpose; lanes of a ``vmap`` one after the other."""

    # Batches of gathers are slow, and lanes of one loop would wait for the slowest.
    chain: ControllerChain
    inverse: jax.Array | None  # ``float[M N, M N]``, of small chains

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution for a right-hand side ``[M, N]``."""
        return sequential_vmap(_solution, self, b)

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        if self.inverse is None:
            return sequential_vmap(partial(_krylov, transposed=True), self.chain, b)
        return (b.ravel() @ self.inverse).reshape(b.shape)


def controller_solver(chain: ControllerChain) -> ControllerSolver:
    """The solver of a chain: inversion of small ones, else BiCGSTAB."""
    chain = jax.lax.stop_gradient(chain)
    size = chain.act.shape[0] * chain.act.shape[1]
    small = size <= _DENSE_LIMIT
    return ControllerSolver(
        chain, sequential_vmap(lambda x: inverse(x.matrix()), chain) if small else None
    )


def _solution(solver: ControllerSolver, b: jax.Array) -> jax.Array:
    if solver.inverse is None:
        return _krylov(solver.chain, b)
    x = (solver.inverse @ b.ravel()).reshape(b.shape)
    rest = b - solver.chain.matvec(x)  # refined once
    refined: jax.Array = x + (solver.inverse @ rest.ravel()).reshape(b.shape)
    return refined


def _krylov(chain: ControllerChain, b: jax.Array, *, transposed: bool = False) -> jax.Array:
    # Of a chain that seldom ends, restarts lose the progress; in single precision rounding does.
    patient = bool(b.dtype == jnp.float64)
    return solve_linear(chain.vecmat if transposed else chain.matvec, b, patient=patient)
