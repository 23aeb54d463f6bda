"""Warm-started discounted values of many models of one game.

For learners that solve a model repeatedly as it changes. Under ``vmap`` over models of one graph
the lanes become the last axis of every array, so that a gather reads whole rows of lanes. The loop
ends on the width of the bounds of the active lanes.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.game import Game
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.values.engine.iterate import fill_row

_MOST_SWEEPS = 100_000
_FEWEST = 16  # lanes from which a separate loop is faster, and which fill its rows
_WRITTEN_OUT = 16  # successors up to which a sum over them is written out


class _Graph(NamedTuple):
    """Data shared by all lanes."""

    successor: jax.Array  # [S, A, K]
    allowed: jax.Array  # [S, A]
    sign: jax.Array  # [S], 1 where the system moves and -1 elsewhere


class Models(NamedTuple):
    """Data of each lane, lanes on the last axis."""

    gain: jax.Array  # [S, A]
    probability: jax.Array  # [S, A, K]; with K = 1 not read
    value: jax.Array  # [S]
    discount: jax.Array
    enough: jax.Array
    active: jax.Array


def span_iteration(
    game: Game,
    allowed: jax.Array,
    models: Models,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Value iteration of a discounted game from a first guess, with MacQueen bounds.

    Sweeps ``v <- T v + c`` with ``T v(s) = max_a gain(s, a) + discount * P v`` (min where the
    environment moves), where c is the middle of MacQueen's (1966) bounds ``discount / (1 -
    discount) * [min, max](T v - v)``. A constant changes no choice, so only their width matters.
    """
    dtype = game.dtype
    graph = _Graph(game.mdp.successor, allowed, jnp.where(game.system, 1, -1).astype(dtype))
    discount, enough = (jnp.asarray(x, dtype) for x in (models.discount, models.enough))
    active = jnp.asarray(models.active)
    result: tuple[jax.Array, jax.Array, jax.Array] = _iterate(
        graph, models._replace(discount=discount, enough=enough, active=active)
    )
    return result


class _Sweeps(NamedTuple):
    """Loop state; `change` is ``T v - v``, computed once for all uses."""

    value: jax.Array
    change: jax.Array
    error: jax.Array
    number: jax.Array


def _plain(graph: _Graph, models: Models) -> tuple[jax.Array, jax.Array, jax.Array]:
    start = _Sweeps(
        models.value,
        _change(graph, models, models.value),
        jnp.full_like(models.enough, jnp.inf),
        jnp.int32(0),
    )
    lanes = models.active.shape
    few = lanes[0] // (4 * _FEWEST) * _FEWEST if lanes else 0
    found = _swept(graph, models, start, few)
    if few:
        found = _last_lanes(graph, models, found, few)
    return found.value, found.error, jnp.stack(_quantities(graph, models, found.value), axis=1)


def _unfinished(models: Models, now: _Sweeps) -> jax.Array:
    return models.active & (now.error > models.enough) & (now.number < _MOST_SWEEPS)


def _swept(graph: _Graph, models: Models, start: _Sweeps, few: int = 0) -> _Sweeps:
    """Sweeps until at most `few` lanes have not converged."""
    live = _beside(models, graph.allowed.any(-1))
    ahead = models.discount / (1 - models.discount)

    def sweep(now: _Sweeps) -> _Sweeps:
        top = jnp.where(live, now.change, -jnp.inf).max(axis=0)
        bottom = jnp.where(live, now.change, jnp.inf).min(axis=0)
        going = models.active & (now.error > models.enough)
        moved = now.value + now.change + ahead * (top + bottom) / 2
        value = jnp.where(live & going, moved, now.value)
        error = jnp.where(going, ahead * (top - bottom) / 2, now.error)
        return _Sweeps(value, _change(graph, models, value), error, now.number + 1)

    def left(now: _Sweeps) -> jax.Array:
        going = _unfinished(models, now)
        return jnp.sum(going) > few if few else jnp.any(going)

    return lax.while_loop(left, sweep, start)


def _last_lanes(graph: _Graph, models: Models, found: _Sweeps, few: int) -> _Sweeps:
    """Continues with the lanes that have not converged: most models need few sweeps, some many."""
    going = _unfinished(models, found)
    place = jnp.cumsum(going) - 1
    who = jnp.nonzero(going, size=few, fill_value=0)[0]
    narrow, rest = jax.tree.map(lambda x: x[..., who] if x.ndim else x, (models, found))
    narrow = narrow._replace(active=jnp.arange(few) <= place[-1])
    last = _swept(graph, narrow, rest)
    place = jnp.maximum(place, 0)
    result: _Sweeps = jax.tree.map(
        lambda x, y: jnp.where(going, x[..., place], y) if y.ndim else x, last, found
    )
    return result


def _beside(models: Models, x: jax.Array) -> jax.Array:
    """Broadcasts shared data over the lanes."""
    return x.reshape(x.shape + (1,) * models.active.ndim)


def _change(graph: _Graph, models: Models, value: jax.Array) -> jax.Array:
    """``T v - v``; zero where there is no move."""
    allowed, sign = _beside(models, graph.allowed), _beside(models, graph.sign)
    best = jnp.full_like(value, -jnp.inf)
    for a, column in enumerate(_quantities(graph, models, value)):
        best = jnp.maximum(best, jnp.where(allowed[:, a], sign * column, -jnp.inf))
    return jnp.where(_beside(models, graph.allowed.any(-1)), sign * best - value, 0)


def _quantities(graph: _Graph, models: Models, value: jax.Array) -> list[jax.Array]:
    """``gain + discount * P v``, one column per action for contiguous reads."""
    num_actions, width = graph.successor.shape[1:]

    def reached(*where: int | slice) -> jax.Array:
        return value.at[graph.successor[:, *where]].get(
            mode="promise_in_bounds", wrap_negative_indices=False
        )

    columns = []
    for a in range(num_actions):
        if width == 1:  # a certain successor needs no weight
            mean = reached(a, 0)
        elif width > _WRITTEN_OUT:
            mean = jnp.sum(models.probability[:, a] * reached(a), axis=1)
        else:
            terms = [models.probability[:, a, k] * reached(a, k) for k in range(width)]
            mean = sum(terms[1:], start=terms[0])
        columns.append(models.gain[:, a] + models.discount * mean)
    return columns


_iterate = jax.custom_batching.custom_vmap(_plain)


@_iterate.def_vmap
def _lanes_last(size: int, batched: PyTree, graph: _Graph, models: Models) -> PyTree:
    shared, own = batched
    if any(shared):
        axes = jax.tree.map(lambda b: 0 if b else None, (shared, own))
        return jax.vmap(_plain, axes)(graph, models), (True, True, True)
    lanes = models.value.ndim - own.value - 1
    number = size * (models.value.shape[-1] if lanes else 1)

    def last(x: jax.Array, is_batched: bool) -> jax.Array:
        x = x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
        x = jnp.moveaxis(x, 0, -1)
        return fill_row(x.reshape(*x.shape[:-2], -1) if lanes else x)

    def first(x: jax.Array) -> jax.Array:
        x = x[..., :number]
        return jnp.moveaxis(x.reshape(*x.shape[:-1], -1, size) if lanes else x, -1, 0)

    found = _iterate(graph, jax.tree.map(last, models, own))
    return jax.tree.map(first, found), (True, True, True)
