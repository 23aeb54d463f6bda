"""Uncertified values of prepared Markov chains, for searches that certify their result."""

from __future__ import annotations

from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.types import status_code
from jaxltl.core.values.engine.block_sweeps import Chosen
from jaxltl.core.values.engine.implicit_diff import implicit
from jaxltl.core.values.engine.linear import inverse
from jaxltl.core.values.prepared.prepared import (
    Prepared,
    checked_numbers,
    chosen_rows,
    given_numbers,
    refilled,
)

ELIMINATED = 256  # nodes up to which cycles are solved by elimination


def is_direct(prepared: Prepared) -> bool:
    """Whether the work of :func:`evaluate_prepared` is independent of the numbers."""
    return not prepared.cyclic or prepared.nodes.shape[0] <= ELIMINATED


def evaluate_prepared(
    prepared: Prepared,
    *,
    probability: chex.Array | None = None,
    reward: chex.Array | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Uncertified values of a prepared Markov chain.

    One linear system ``x = r + P x``: a pass where there are no cycles, elimination up to
    `ELIMINATED` nodes, and Krylov steps on passes beyond.

    Raises:
      ValueError: a shape is wrong, or the question is of another kind.

    Differentiable, forward and reverse, as there.

    Example:
      >>> from jaxltl import make_sparse, prepare
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> prepared = prepare(coin, [False, True, False])
      >>> value = lambda p: evaluate_prepared(prepared, probability=jnp.array([p, 1 - p, 1, 1]))[0]
      >>> jax.grad(lambda p: value(p)[0])(0.25).item()
      1.0
    """
    if prepared.num_rows != prepared.num_states or prepared.objective == "policy":
        raise ValueError(
            "evaluate_prepared takes Markov chains, not prepared for policies: use solve_prepared."
        )
    return _evaluate(prepared, *given_numbers(prepared, probability, reward))


@jax.jit
def _evaluate(prepared: Prepared, probability: Any, reward: Any) -> tuple[jax.Array, jax.Array]:
    size, dtype = prepared.size, prepared.probability.dtype
    finite, valid = checked_numbers(prepared, probability, reward, None)
    if probability is not None or reward is not None:
        prepared = refilled(prepared, probability, reward, None)
    value = jnp.zeros(0, dtype)
    if size:
        system = chosen_rows(prepared, None)
        fixed = lax.stop_gradient(system)
        solve, transpose = fixed.solve, fixed.transpose_solve
        if prepared.cyclic and is_direct(prepared):
            solve, transpose = _eliminated(fixed, prepared.nodes)

        def operator(x: jax.Array) -> jax.Array:
            return system.image(jnp.concatenate([x, jnp.asarray([1, 0, 0], dtype)]))

        constant = lax.stop_gradient(operator(jnp.zeros(size, dtype)))
        value = implicit(operator, solve(constant), solve=solve, transpose_solve=transpose)
    finite &= jnp.all(jnp.isfinite(lax.stop_gradient(value)))
    status = status_code(True, finite, certified=False, valid=valid | ~finite)
    ends = jnp.asarray([0, 0, jnp.inf] if prepared.question == "reward" else [1, 0, 0], dtype)
    value = jnp.concatenate([value, ends]).at[prepared.place].get(mode="promise_in_bounds")
    return value, status


def _eliminated(system: Chosen, nodes: jax.Array) -> tuple[Any, Any]:
    """Solvers of a system and of its transpose by a dense inverse on its nodes."""
    count, _, block = system.target.shape
    size, most = count * block, nodes.shape[0]
    number = jnp.full(size + 3, most, jnp.int32).at[nodes].set(jnp.arange(most, dtype=jnp.int32))
    target, weight = (
        jnp.moveaxis(x, 1, 2).reshape(size, -1)[nodes] for x in (system.target, system.weight)
    )
    rows = jnp.arange(most, dtype=jnp.int32)[:, None]
    matrix = jnp.eye(most, most + 1, dtype=weight.dtype)
    matrix = matrix.at[rows, number[target]].add(-weight)[:, :most]
    found = inverse(matrix)

    def solve(b: jax.Array) -> jax.Array:
        c = b[nodes]
        x = found @ c
        return b.at[nodes].set(x + found @ (c - matrix @ x))

    def transpose(b: jax.Array) -> jax.Array:
        c = b[nodes]
        x = c @ found
        return b.at[nodes].set(x + (c - x @ matrix) @ found)

    return solve, transpose
