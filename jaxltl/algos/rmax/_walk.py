"""The moves of R-max between two updates of its model.

A walk is what changes from move to move, one entry of each array at a time, so that a loop under
``vmap`` need not copy the arrays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxltl.algos.common import splitmix
from jaxltl.algos.common.play import (
    draw,
    observed_reward,
    successor_slot,
    take,
)
from jaxltl.core.models.ops.operators import sample_successor

_BEST, _KNOWN = 1, 2


class Rules(NamedTuple):
    """What the moves of one step need; `marks` of :func:`marks`."""

    problem: Any
    marks: jax.Array
    key: jax.Array
    stream: tuple[jax.Array, jax.Array]
    explore: jax.Array
    enough: jax.Array
    bound: jax.Array
    restart: jax.Array
    every: jax.Array


class Seen(NamedTuple):
    """A transition and its reward."""

    state: jax.Array
    action: jax.Array
    successor: jax.Array
    reward: jax.Array


class Walk(NamedTuple):
    """What changes from move to move; `left` moves remain, none once there is something new.

    `pair` is of the last move, `seen` its reward, `known` whether
    the pair has become known by it, and `fresh` whether a known pair has shown a transition
    for the first time.
    """

    moves: jax.Array
    left: jax.Array
    position: jax.Array
    counts: jax.Array
    reward: jax.Array
    pair: jax.Array
    seen: jax.Array
    known: jax.Array
    fresh: jax.Array
    fault: jax.Array


def marks(best: jax.Array, known_at: jax.Array) -> jax.Array:
    """Which pairs are preferred and which are known, in one byte: ``uint8[S, A]``.

    A move looks at both, of another lane each time, and waits for memory twice if they lie apart.
    """
    return best * jnp.uint8(_BEST) + (known_at >= 0) * jnp.uint8(_KNOWN)


def walk_from(state: Any, moves: jax.Array) -> Walk:
    """A walk that starts where the learner stands."""
    zero, false = jnp.int32(0), jnp.bool_(False)
    return Walk(
        state.moves,
        moves,
        state.position,
        state.counts,
        state.reward,
        zero,
        jnp.zeros((), state.reward.dtype),
        false,
        false,
        state.fault,
    )


def move(walk: Walk, rules: Rules) -> Walk:
    """One move, if any are left. It writes one entry of each array, so that they stay in place."""
    active, game = walk.left > 0, rules.problem.game
    dtype = game.dtype
    count = walk.moves.astype(jnp.uint32)
    words = [splitmix.words(rules.stream, 4 * count + i) for i in range(4)]
    anew = splitmix.uniform(words[0], dtype) < rules.restart
    s = jnp.where(anew, draw(rules.problem.start_table, words[1]), walk.position)
    mine = jnp.where(
        splitmix.uniform(words[2], dtype) < rules.explore,
        take(rules.problem.allowed, s),
        (take(rules.marks, s) & _BEST) > 0,
    )
    weight = jnp.where(take(game.system, s), mine, take(rules.problem.environment, s))
    action = _draw_action(weight, splitmix.uniform(words[3], dtype))
    # Where chance plays no part the key is not worth making.
    key = rules.key if game.num_successors == 1 else jax.random.fold_in(rules.key, walk.moves)
    successor = sample_successor(game, key, s, action)
    reward = observed_reward(game, rules.problem.reward, s, action, successor)
    return record(walk, Seen(s, action, successor, reward), rules, active)


def _draw_action(weight: jax.Array, uniform: jax.Array) -> jax.Array:
    """An action with the probability of its weight; never one without any."""
    total = jnp.cumsum(weight)
    # The largest weight that rounding lets be drawn stays below the total.
    drawn = jnp.minimum(uniform, 1 - jnp.finfo(weight.dtype).eps) * total[-1]
    return jnp.argmax(total > drawn).astype(jnp.int32)


def record(walk: Walk, seen: Seen, rules: Rules, active: jax.Array) -> Walk:
    """What a transition adds to the counts and rewards, and whether the model changes."""
    game = rules.problem.game
    pair = seen.state * game.num_actions + seen.action
    # Not flat: arrays that are reshaped in a loop are copied in every pass.
    place = (seen.state, seen.action)
    was_known = take(rules.marks, place) >= _KNOWN
    if game.num_successors == 1:
        # Without chance a pair is known after one move, the last of a walk, noted after it.
        counts, reward = walk.counts, walk.reward
        known, fresh = active & ~was_known, jnp.bool_(False)
    else:
        entry = (*place, successor_slot(game, seen.state, seen.action, seen.successor))
        # Written before it is read: the other way round whole arrays would be copied.
        counts = _counted(walk.counts, entry, active)
        row = take(counts, place)
        first = row[entry[-1]] == 1
        alone = jnp.sum(take(game.mdp.probability, place) > 0) == 1
        enough = alone | (jnp.sum(row).astype(game.dtype) >= rules.enough)
        known, fresh = active & ~was_known & enough, active & was_known & first & rules.every
        noted = active & jnp.where(rules.every, first, known)
        reward = _rewarded(walk.reward, entry, seen.reward, noted)
    wrong = active & ~((seen.reward >= 0) & (seen.reward <= rules.bound))
    return Walk(
        moves=walk.moves + active,
        left=jnp.where(active, jnp.where(known | fresh, 0, walk.left - 1), walk.left),
        position=jnp.where(active, seen.successor, walk.position),
        counts=counts,
        reward=reward,
        pair=jnp.where(active, pair, walk.pair),
        seen=jnp.where(active, seen.reward, walk.seen),
        known=known | (~active & walk.known),
        fresh=fresh | (~active & walk.fresh),
        fault=jnp.where(wrong & (walk.fault < 0), pair, walk.fault),
    )


def note_last(walk: Walk, problem: Any) -> Walk:
    """In a game without chance, the last move of a walk if it made its pair known."""
    if problem.game.num_successors > 1:
        return walk
    entry = (*jnp.divmod(walk.pair, problem.game.num_actions), 0)
    return walk._replace(
        counts=_counted(walk.counts, entry, walk.known),
        reward=_rewarded(walk.reward, entry, walk.seen, walk.known),
    )


def _counted(counts: jax.Array, entry: Any, once: jax.Array) -> jax.Array:
    return counts.at[entry].add(once.astype(counts.dtype), mode="promise_in_bounds")


def _rewarded(reward, entry, seen, noted) -> jax.Array:
    """A reward where none was noted, for which a larger number stands."""
    least = jnp.where(noted, seen, jnp.inf).astype(reward.dtype)
    return reward.at[entry].min(least, mode="promise_in_bounds")
