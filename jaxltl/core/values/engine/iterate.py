"""The loop of all solvers, and its batching under ``vmap``.

Loops with data-dependent branches are batched sequentially: each lane makes the same steps, bit for
bit, as alone. Sweeps are batched with the lanes as the last axis of every array, so that a gather
moves whole rows of lanes and arithmetic on them is vectorised.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax

Table = TypeVar("Table")  # trees of arrays
Carry = TypeVar("Carry")
Parameters = TypeVar("Parameters")
Result = TypeVar("Result")

_ROW = 16  # the floats of the widest vector unit


def iterate(
    step: Callable[[Table, Carry, Parameters], Carry],
    finished: Callable[[Carry, Parameters], jax.Array],
    start: tuple[Table, Carry, Parameters],
    *,
    max_steps: jax.Array | int,
    lanes: str = "in turn",
    every: int = 1,
) -> tuple[Carry, jax.Array]:
    """Repeats ``carry = step(table, carry, parameters)`` until ``finished(carry, parameters)``, at least once.

    `start` has the table, the first carry and parameters, trees of arrays.
    """

    def loop(
        table: Table, carry: Carry, parameters: Parameters, limit: jax.Array
    ) -> tuple[Carry, jax.Array]:
        def one(carry: Carry, n: jax.Array, active: jax.Array) -> tuple[Carry, jax.Array]:
            new = step(table, carry, parameters)
            if every == 1 and limit.ndim == 0:
                return new, n + 1  # the loop condition has tested it
            goes = active & (n < limit)
            return jax.tree.map(partial(jnp.where, goes), new, carry), n + goes

        def body(state: tuple[Carry, jax.Array, jax.Array]) -> tuple[Carry, jax.Array, jax.Array]:
            carry, n, active = state
            if every == 1:
                carry, n = one(carry, n, active)
            else:
                carry, n = lax.fori_loop(0, every, lambda _, c: one(c[0], c[1], active), (carry, n))
            return carry, n, active & ~finished(carry, parameters) & (n < limit)

        n = jnp.zeros(limit.shape, jnp.int32)
        first = (carry, n, jnp.ones(limit.shape, bool))
        return lax.while_loop(lambda state: jnp.any(state[2]), body, first)[:2]

    limit = jnp.maximum(jnp.asarray(max_steps, jnp.int32), 1)
    if lanes == "mapped":
        return loop(*start, limit)
    run = side_by_side if lanes == "side by side" else sequential_vmap
    return run(loop, *start, limit)


def sequential_vmap(function: Callable[..., Result], *arguments: object) -> Result:
    """``function(*arguments)``, batched sequentially under ``vmap``; not differentiable."""
    # For work that depends on the data, or is slower in a batch. The function takes
    # trees of arrays and closes over no batched array.

    one = jax.custom_batching.sequential_vmap(lambda arguments: function(*arguments))
    result: Result = one(lax.stop_gradient(jax.tree.map(jnp.asarray, arguments)))
    return result


def side_by_side(function: Callable[..., Result], table: Table, *arguments: object) -> Result:
    """``function(table, *arguments)``, batched under ``vmap`` with a last axis of lanes."""
    # The function takes arrays with and without that axis, and closes over no traced array. A
    # batched `table` is mapped as usual.

    @jax.custom_batching.custom_vmap
    def one(table: Table, arguments: tuple[object, ...]) -> Result:
        return function(table, *arguments)

    @one.def_vmap
    def _(
        size: int,
        batched: tuple[Table, tuple[object, ...]],
        table: Table,
        arguments: tuple[object, ...],
    ) -> tuple[Result, Result]:
        of_table, of_arguments = batched
        if any(jax.tree.leaves(of_table)):
            axes = jax.tree.map(lambda b: 0 if b else None, (of_table, of_arguments))
            result = jax.vmap(lambda t, x: function(t, *x), axes)(table, arguments)
        else:

            def last(x: jax.Array, b: bool) -> jax.Array:
                x = x if b else jnp.broadcast_to(x, (size, *x.shape))
                return fill_row(jnp.moveaxis(x, 0, -1))

            result = function(table, *jax.tree.map(last, arguments, of_arguments))
            result = jax.tree.map(lambda x: jnp.moveaxis(x[..., :size], -1, 0), result)
        return result, jax.tree.map(lambda _: True, result)

    table, arguments = lax.stop_gradient((table, arguments))
    result: Result = one(table, jax.tree.map(jnp.asarray, arguments))
    return result


def fill_row(x: jax.Array) -> jax.Array:
    """Pads the last axis to a multiple of the vector width by repeating the last lane."""
    # XLA vectorises rows of other lengths badly: 16 exponentials in a row take a quarter of the
    # time of 10. Fewer than half a vector is not padded.
    size = x.shape[-1]
    room = size if size < _ROW / 2 else -(-size // _ROW) * _ROW
    again = jnp.broadcast_to(x[..., -1:], (*x.shape[:-1], room - size))
    return jnp.concatenate([x, again], axis=-1)
