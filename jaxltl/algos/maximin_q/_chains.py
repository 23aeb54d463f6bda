"""One move of all chains of a Q-learner, and what it teaches."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.common import splitmix
from jaxltl.algos.common.play import (
    observed_reward,
    take,
)
from jaxltl.core.models.game import Game
from jaxltl.core.models.ops.operators import action_argmax, sample_successor

# An alias table (Walker 1977) draws from any row with one look-up: 24 bits of a threshold
# and 8 of the action to take above it.
_BITS = 24

_WRITTEN_OUT = 16  # actions up to which a maximum over them is written out


def alias_table(rows: np.ndarray) -> np.ndarray:
    """``uint32[S, A]`` alias tables of distributions ``float[S, A]``."""
    num_states, num_actions = rows.shape
    left = rows * num_actions
    share, alias = np.ones(rows.shape), np.tile(np.arange(num_actions), (num_states, 1))
    unfilled, s = np.ones(rows.shape, bool), np.arange(num_states)
    for _ in range(num_actions - 1):
        least = np.where(unfilled, left, np.inf).argmin(-1)
        most = np.where(unfilled, left, -np.inf).argmax(-1)
        share[s, least], alias[s, least] = left[s, least], most
        left[s, most] -= 1 - left[s, least]
        unfilled[s, least] = False
    # Rounding must not give weight to a move without any.
    threshold = np.where(rows > 0, np.rint(np.clip(share, 0, 1) * 2**_BITS), 0).astype(np.int64)
    heaviest = rows.argmax(-1)[:, None]
    alias = np.where(np.take_along_axis(rows, alias, -1) > 0, alias, heaviest)
    full = threshold == 2**_BITS
    alias = np.where(full, np.arange(num_actions), alias)
    threshold = np.where(full, 0, threshold)
    return (threshold << 8 | alias).astype(np.uint32)


class Table(NamedTuple):
    """What a move changes: flat tables, and the chains."""

    q: jax.Array
    visits: jax.Array
    position: jax.Array
    system: jax.Array
    pending: Any
    held: Any
    violations: jax.Array


def move(problem, hparams, epsilons, stream, key, table: Table, i: jax.Array) -> Table:
    """The i-th move of every chain in a step, and what it teaches."""
    game, num_actions = problem.game, problem.game.num_actions
    source, system = table.position, table.system
    action = _choose(problem, epsilons, stream, table, i)
    pair = source * num_actions + action
    violations = table.violations + jnp.sum(~take(problem.allowed.ravel(), pair), dtype=jnp.int32)
    target = _sample(game, jax.random.fold_in(key, i), source, action)
    reward = observed_reward(game, problem.reward, source, action, target)
    discount = jnp.asarray(hparams.discount, table.q.dtype)
    after = discount if hparams.per == "move" else jnp.ones_like(discount)
    whose = take(game.system, target)
    ahead = _value_at(problem, table.q, target, whose)
    if problem.method == "generalized":
        mine = system.astype(discount.dtype)
        aim = reward + (mine * discount + (1 - mine) * after) * ahead
        q, visits = _learn(hparams, table.q, table.visits, pair, aim, "promise_in_bounds")
        return Table(q, visits, target, whose, None, None, violations)
    answered = ~system & (table.pending >= 0)
    # A system move teaches nothing yet: its entry lies outside and is dropped.
    entry = jnp.where(answered, table.pending * num_actions + action, table.q.size)
    aim = table.held + discount * (reward + after * ahead)
    q, visits = _learn(hparams, table.q, table.visits, entry, aim, "drop")
    pending = jnp.where(system, pair, -1)
    return Table(q, visits, target, whose, pending, jnp.where(system, reward, 0), violations)


def _learn(hparams, q, visits, entry, aim, mode) -> tuple[jax.Array, jax.Array]:
    """The table after all chains have moved, and its counts."""
    if hparams.step_size is None:
        # Without chance all chains at one entry aim at the same number.
        return q.at[entry].set(aim, mode=mode), visits.at[entry].add(1, mode=mode)
    before = take(visits, jnp.minimum(entry, q.size - 1))
    old = take(q, jnp.minimum(entry, q.size - 1))
    visits = visits.at[entry].add(1, mode=mode)
    together = (take(visits, jnp.minimum(entry, q.size - 1)) - before).astype(q.dtype)
    size = jnp.asarray(hparams.step_size, q.dtype)
    if hparams.step_power is not None:
        size = size * (1 + before.astype(q.dtype)) ** -jnp.asarray(hparams.step_power, q.dtype)
    share = (1 - (1 - size) ** together) / together
    return q.at[entry].add(share * (aim - old), mode=mode), visits


def _choose(problem, epsilons, stream, table: Table, i) -> jax.Array:
    """Each chain's action: greedy with the probability of its player, else by behaviour."""
    num_actions = problem.game.num_actions
    word = (splitmix.words(stream, 2 * i) >> 8) * jnp.uint32(num_actions)
    slot = (word >> _BITS).astype(jnp.int32)
    entry = take(problem.behavior_table.ravel(), table.position * num_actions + slot)
    alias = (entry & 0xFF).astype(jnp.int32)
    action = jnp.where((word & (2**_BITS - 1)) < entry >> 8, slot, alias)
    if epsilons == (None, None):
        return action
    best, known = _best(problem, table)
    drawn = splitmix.uniform(splitmix.words(stream, 2 * i + 1), table.q.dtype)
    mine, theirs = (jnp.inf if e is None else e for e in epsilons)
    return jnp.where(known & (drawn >= jnp.where(table.system, mine, theirs)), best, action)


def _best(problem, table: Table) -> tuple[jax.Array, jax.Array]:
    """Each chain's greedy action, and whether the table knows one there."""
    num_actions, system = problem.game.num_actions, table.system[:, None]
    if problem.method == "generalized":
        row = take(table.q.reshape(-1, num_actions), table.position)
        known = jnp.ones(table.position.shape, bool)
    else:
        q = table.q.reshape(-1, num_actions, num_actions)
        answers = take(q.reshape(-1, num_actions), jnp.maximum(table.pending, 0))
        row = jnp.where(system, take(q, table.position).min(-1), answers)
        known = table.system | (table.pending >= 0)
    return action_argmax(jnp.where(system, row, -row), jnp.bool_(True))[1], known


def _value_at(problem, q, state, system) -> jax.Array:
    """Values of chains' states by a flat table, without those of all states.

    Whose turn it is changes from chain to chain at random: signs are faster than a choice.
    """
    num_actions = problem.game.num_actions
    if problem.method == "maximin":
        block = take(q.reshape(-1, num_actions, num_actions), state)
        return finite(reduce_last(jnp.maximum, reduce_last(jnp.minimum, block)))
    sign = 2 * system.astype(q.dtype) - 1
    if num_actions > _WRITTEN_OUT:
        return sign * jnp.max(sign[:, None] * take(q.reshape(-1, num_actions), state), axis=-1)
    best = sign * take(q, state * num_actions)
    for a in range(1, num_actions):
        best = jnp.maximum(best, sign * take(q, state * num_actions + a))
    return sign * best


def _sample(game: Game, key, state, action) -> jax.Array:
    """The chains' successors. Where chance plays no part, keys are not worth drawing."""
    if game.num_successors == 1:
        return jax.vmap(sample_successor, (None, None, 0, 0))(game, key, state, action)
    keys = jax.random.split(key, state.shape[0])
    return jax.vmap(sample_successor, (None, 0, 0, 0))(game, keys, state, action)


def finite(x: jax.Array) -> jax.Array:
    """Numbers as they are, zero for infinity."""
    return jnp.where(jnp.isinf(x), 0, x)


def reduce_last(function, x: jax.Array) -> jax.Array:
    """A reduction over a last axis; written out over a short one, which is several times faster."""
    if x.shape[-1] > _WRITTEN_OUT:
        return function.reduce(x, axis=-1)
    result = x[..., 0]
    for i in range(1, x.shape[-1]):
        result = function(result, x[..., i])
    return result
