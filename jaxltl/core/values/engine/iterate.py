"""The one loop of every solver, in which each lane goes at its own pace.

Under ``vmap``, loops that look at their data in every step are run lane after lane: each makes its
own steps and no others, bit for bit those that it makes alone. Sweeps, in which all lanes do the
same, run side by side, the lanes as the last axis of every array: a gather then moves whole rows of
lanes, and what is computed of them is vectorised.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

Step = Callable[[Any, Any, Any], Any]

_ROW = 16  # the floats of the widest vector unit


def iterate(
    step: Step,
    finished: Callable[[Any, Any], jax.Array],
    table: Any,
    carry: Any,
    given: Any,
    *,
    max_steps: jax.Array | int,
    lanes: str = "in turn",
    every: int = 1,
) -> tuple[Any, jax.Array]:
    """``carry = step(table, carry, given)`` until ``finished(carry, given)``, at least once.

    Nothing is differentiated through it: solvers attach implicit derivatives to what it finds.

    Args:
      step: one unit of work; it closes over nothing that differs from lane to lane, unless
        `lanes` is ``"mapped"``.
      finished: ``bool[]``, or ``bool[lanes]``.
      table: what lanes can share, such as a model's successors.
      carry: what changes.
      given: what does not, and may differ from lane to lane.
      max_steps: steps at most.
      lanes: what ``vmap`` makes of it: ``"in turn"``, lane after lane; ``"side by side"``, where
        arrays have an axis of lanes behind their own; or ``"mapped"`` as any other loop.
      every: steps between two looks at whether a lane is finished.

    Returns:
      The last carry, and how many steps were made, ``int32[]``.
    """

    def loop(table: Any, carry: Any, given: Any, most: jax.Array) -> tuple[Any, jax.Array]:
        def one(carry: Any, n: jax.Array, active: jax.Array) -> tuple[Any, jax.Array]:
            new = step(table, carry, given)
            if every == 1 and most.ndim == 0:
                return new, n + 1  # the loop itself has looked
            goes = active & (n < most)
            return jax.tree.map(partial(jnp.where, goes), new, carry), n + goes

        def body(state):
            carry, n, active = state
            if every == 1:
                carry, n = one(carry, n, active)
            else:
                carry, n = lax.fori_loop(0, every, lambda _, c: one(c[0], c[1], active), (carry, n))
            return carry, n, active & ~finished(carry, given) & (n < most)

        n = jnp.zeros(most.shape, jnp.int32)
        start = (carry, n, jnp.ones(most.shape, bool))
        return lax.while_loop(lambda state: jnp.any(state[2]), body, start)[:2]

    most = jnp.maximum(jnp.asarray(max_steps, jnp.int32), 1)
    run = {"in turn": in_turn, "side by side": side_by_side, "mapped": _mapped}[lanes]
    return run(loop, table, carry, given, most)


def _mapped(function: Callable[..., Any], *arguments: Any) -> Any:
    return function(*arguments)


def in_turn(function: Callable[..., Any], *arguments: Any) -> Any:
    """``function(*arguments)``, which ``vmap`` runs lane after lane.

    For work whose amount depends on the data, and for what is slower in a batch than alone: a
    lane's work is its own. It is not differentiated through.

    Args:
      function: of trees of arrays; it closes over nothing that differs from lane to lane.
      arguments: its arguments.
    """

    @jax.custom_batching.sequential_vmap
    def one(arguments: tuple[Any, ...]) -> Any:
        return function(*arguments)

    return one(lax.stop_gradient(jax.tree.map(jnp.asarray, arguments)))


def side_by_side(function: Callable[..., Any], table: Any, *arguments: Any) -> Any:
    """``function(table, *arguments)``, whose lanes under ``vmap`` become a last axis.

    Args:
      function: of arrays with or without that axis; it closes over nothing that is traced.
      table: shared by the lanes; if it is batched too, they are mapped as usual.
      arguments: trees of arrays.
    """

    @jax.custom_batching.custom_vmap
    def one(table: Any, arguments: tuple[Any, ...]) -> Any:
        return function(table, *arguments)

    @one.def_vmap
    def _(size: int, batched: Any, table: Any, arguments: tuple[Any, ...]) -> Any:
        of_table, of_arguments = batched
        if any(jax.tree.leaves(of_table)):
            axes = jax.tree.map(lambda b: 0 if b else None, (of_table, of_arguments))
            found = jax.vmap(lambda t, x: function(t, *x), axes)(table, arguments)
        else:

            def last(x: jax.Array, b: bool) -> jax.Array:
                x = x if b else jnp.broadcast_to(x, (size, *x.shape))
                return fill_row(jnp.moveaxis(x, 0, -1))

            found = function(table, *jax.tree.map(last, arguments, of_arguments))
            found = jax.tree.map(lambda x: jnp.moveaxis(x[..., :size], -1, 0), found)
        return found, jax.tree.map(lambda _: True, found)

    table, arguments = lax.stop_gradient((table, arguments))
    return one(table, jax.tree.map(jnp.asarray, arguments))


def fill_row(x: jax.Array) -> jax.Array:
    """Lanes on the last axis, of which the last is repeated until they fill vector units.

    XLA vectorises rows of any other length badly or not at all: 16 exponentials in a row take a
    quarter of the time of 10. Few lanes stay as they are.
    """
    size = x.shape[-1]
    room = size if size < _ROW / 2 else -(-size // _ROW) * _ROW
    again = jnp.broadcast_to(x[..., -1:], (*x.shape[:-1], room - size))
    return jnp.concatenate([x, again], axis=-1)
