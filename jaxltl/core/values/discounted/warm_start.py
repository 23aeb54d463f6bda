"""Warm-started discounted values of many models of one game.

For learners that solve a model repeatedly as it changes. Under ``vmap`` over models of one graph
the lanes become the last axis of every array, so that a gather reads whole rows of lanes.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.game import Game
from jaxltl.core.values.engine.iterate import side_by_side

_MAX_SWEEPS = 100_000
_FEWEST = 16  # lanes of the last sweeps
_WRITTEN_OUT = 16  # successors up to which a sum over them is written out


class _WarmStartGraph(NamedTuple):
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


class _Sweeps(NamedTuple):
    """Loop state; `change` is ``T v - v``, computed once for all uses."""

    value: jax.Array
    change: jax.Array
    error: jax.Array
    number: jax.Array


def span_iteration(
    game: Game, allowed: jax.Array, models: Models
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Value iteration of a discounted game from a first guess, with MacQueen bounds.

    Sweeps ``v <- T v + c`` with ``T v(s) = max_a gain(s, a) + discount * P v`` (min where the
    environment moves), where c is the middle of MacQueen's (1966) bounds ``discount / (1 -
    discount) * [min, max](T v - v)``. A constant changes no choice, so only their width matters.
    """
    dtype = game.dtype
    graph = _WarmStartGraph(
        game.mdp.successor, allowed, jnp.where(game.system, 1, -1).astype(dtype)
    )
    discount, enough = (jnp.asarray(x, dtype) for x in (models.discount, models.enough))
    active = jnp.asarray(models.active)
    models = models._replace(discount=discount, enough=enough, active=active)
    return side_by_side(_solved, graph, models)


def _solved(graph: _WarmStartGraph, models: Models) -> tuple[jax.Array, jax.Array, jax.Array]:
    lanes = models.active.shape
    # Most models need few sweeps and some need many, which then continue with a quarter of the lanes.
    few = lanes[0] // (4 * _FEWEST) * _FEWEST if lanes else 0
    change = _change(graph, models, models.value)
    start = _Sweeps(models.value, change, jnp.full_like(models.enough, jnp.inf), jnp.int32(0))
    sweeps = _swept(graph, models, start, few)
    if few:
        active = _is_active(models, sweeps)
        chosen = jnp.nonzero(active, size=few, fill_value=0)[0]
        fewer, rest = jax.tree.map(lambda x: x[..., chosen] if x.ndim else x, (models, sweeps))
        place = jnp.cumsum(active) - 1
        last = _swept(graph, fewer._replace(active=jnp.arange(few) <= place[-1]), rest, 0)
        place = jnp.maximum(place, 0)
        sweeps = jax.tree.map(
            lambda x, y: jnp.where(active, x[..., place], y) if y.ndim else x, last, sweeps
        )
    return sweeps.value, sweeps.error, jnp.stack(_quantities(graph, models, sweeps.value), axis=1)


def _is_active(models: Models, sweeps: _Sweeps) -> jax.Array:
    return models.active & (sweeps.error > models.enough) & (sweeps.number < _MAX_SWEEPS)


def _swept(graph: _WarmStartGraph, models: Models, start: _Sweeps, few: int) -> _Sweeps:
    """Sweeps until at most `few` lanes are active."""
    live = _beside(models, graph.allowed.any(-1))
    ahead = models.discount / (1 - models.discount)

    def sweep(now: _Sweeps) -> _Sweeps:
        active = _is_active(models, now)
        top = jnp.where(live, now.change, -jnp.inf).max(axis=0)
        bottom = jnp.where(live, now.change, jnp.inf).min(axis=0)
        moved = now.value + now.change + ahead * (top + bottom) / 2
        value = jnp.where(live & active, moved, now.value)
        error = jnp.where(active, ahead * (top - bottom) / 2, now.error)
        return _Sweeps(value, _change(graph, models, value), error, now.number + 1)

    return lax.while_loop(lambda now: jnp.sum(_is_active(models, now)) > few, sweep, start)


def _beside(models: Models, x: jax.Array) -> jax.Array:
    """Broadcasts shared data over the lanes."""
    return x.reshape(x.shape + (1,) * models.active.ndim)


def _change(graph: _WarmStartGraph, models: Models, value: jax.Array) -> jax.Array:
    """``T v - v``; zero where there is no move."""
    allowed, sign = _beside(models, graph.allowed), _beside(models, graph.sign)
    best = jnp.full_like(value, -jnp.inf)
    for a, column in enumerate(_quantities(graph, models, value)):
        best = jnp.maximum(best, jnp.where(allowed[:, a], sign * column, -jnp.inf))
    return jnp.where(_beside(models, graph.allowed.any(-1)), sign * best - value, 0)


def _quantities(graph: _WarmStartGraph, models: Models, value: jax.Array) -> list[jax.Array]:
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
