"""The optimistic model of R-max, and rollouts between two of its updates.

A rollout changes one entry of each array at a time, so that a loop under ``vmap`` copies no arrays.
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxltl.algos.common import loops, pac, splitmix
from jaxltl.algos.common.play import draw, observed_reward, successor_slot, take
from jaxltl.algos.rmax.problem import Hparams, Problem, State
from jaxltl.core import struct
from jaxltl.core.models.ops.operators import sample_successor
from jaxltl.core.values.discounted.warm_start import Models, span_iteration

_BEST, _KNOWN = 1, 2


@struct.dataclass
class Rules:
    """Constants of one step; `every`: every reward enters the model."""

    problem: Problem
    flags: jax.Array
    key: jax.Array
    stream: splitmix.Stream
    explore: jax.Array
    enough: jax.Array
    bound: jax.Array
    restart: jax.Array
    every: jax.Array


@struct.dataclass
class Transition:
    """An observed transition and its reward."""

    state: jax.Array
    action: jax.Array
    successor: jax.Array
    reward: jax.Array


@struct.dataclass
class Rollout:
    """The variables of a rollout, which ends with a change of the model or after `remaining` moves."""

    moves: jax.Array
    remaining: jax.Array
    position: jax.Array
    counts: jax.Array
    reward: jax.Array
    pair: jax.Array
    last_reward: jax.Array
    known: jax.Array
    fresh: jax.Array
    fault: jax.Array


def pair_flags(best: jax.Array, known_at: jax.Array) -> jax.Array:
    """Near-optimal and known pairs as two bits of one byte, ``uint8[S, A]``: one cache miss a move."""
    return best * jnp.uint8(_BEST) + (known_at >= 0) * jnp.uint8(_KNOWN)


def start_rollout(state: State, moves: jax.Array) -> Rollout:
    """A rollout of at most some moves from the current position."""
    false = jnp.bool_(False)
    return Rollout(
        moves=state.moves,
        remaining=moves,
        position=state.position,
        counts=state.counts,
        reward=state.reward,
        pair=jnp.int32(0),
        last_reward=jnp.zeros((), state.reward.dtype),
        known=false,
        fresh=false,
        fault=state.fault,
    )


def move(rollout: Rollout, rules: Rules) -> Rollout:
    """One move, if any remain."""
    problem, game = rules.problem, rules.problem.game
    dtype = game.dtype
    count = rollout.moves.astype(jnp.uint32)
    words = [splitmix.words(rules.stream, 4 * count + i) for i in range(4)]
    restarts = splitmix.uniform(words[0], dtype) < rules.restart
    s = jnp.where(restarts, draw(problem.start_table, words[1]), rollout.position)
    mine = jnp.where(
        splitmix.uniform(words[2], dtype) < rules.explore,
        take(problem.allowed, s),
        (take(rules.flags, s) & _BEST) > 0,
    )
    weight = jnp.where(take(game.system, s), mine, take(problem.environment, s))
    action = _draw_action(weight, splitmix.uniform(words[3], dtype))
    # A deterministic game needs no key.
    key = rules.key if game.num_successors == 1 else jax.random.fold_in(rules.key, rollout.moves)
    successor = sample_successor(game, key, s, action)
    reward = observed_reward(game, problem.reward, s, action, successor)
    seen = Transition(state=s, action=action, successor=successor, reward=reward)
    return record(rollout, seen, rules, rollout.remaining > 0)


def _draw_action(weight: jax.Array, uniform: jax.Array) -> jax.Array:
    """An action with probability proportional to its weight, never one of weight zero."""
    total = jnp.cumsum(weight)
    # Stays below the total in spite of rounding.
    drawn = jnp.minimum(uniform, 1 - jnp.finfo(weight.dtype).eps) * total[-1]
    return jnp.argmax(total > drawn).astype(jnp.int32)


def record(rollout: Rollout, seen: Transition, rules: Rules, active: jax.Array) -> Rollout:
    """The rollout after an observed transition, or unchanged if it is not active."""
    game = rules.problem.game
    # Not flat: arrays that are reshaped in a loop are copied in every iteration.
    place = (seen.state, seen.action)
    was_known = take(rules.flags, place) >= _KNOWN
    if game.num_successors == 1:
        # In a deterministic game a new pair ends the rollout; record_last writes it.
        counts, reward = rollout.counts, rollout.reward
        known, fresh = active & ~was_known, jnp.bool_(False)
    else:
        entry = (*place, successor_slot(game, seen.state, seen.action, seen.successor))
        # Written before it is read, else the whole array would be copied.
        counts = _increment(rollout.counts, entry, active)
        row = take(counts, place)
        first = row[entry[-1]] == 1
        single = jnp.sum(take(game.mdp.probability, place) > 0) == 1
        enough = single | (jnp.sum(row).astype(game.dtype) >= rules.enough)
        known, fresh = active & ~was_known & enough, active & was_known & first & rules.every
        noted = active & jnp.where(rules.every, first, known)
        reward = _note_reward(rollout.reward, entry, seen.reward, noted)
    wrong = active & ~((seen.reward >= 0) & (seen.reward <= rules.bound))
    pair = seen.state * game.num_actions + seen.action
    rest = jnp.where(known | fresh, 0, rollout.remaining - 1)
    return Rollout(
        moves=rollout.moves + active,
        remaining=jnp.where(active, rest, rollout.remaining),
        position=jnp.where(active, seen.successor, rollout.position),
        counts=counts,
        reward=reward,
        pair=jnp.where(active, pair, rollout.pair),
        last_reward=jnp.where(active, seen.reward, rollout.last_reward),
        known=known | (~active & rollout.known),
        fresh=fresh | (~active & rollout.fresh),
        fault=jnp.where(wrong & (rollout.fault < 0), pair, rollout.fault),
    )


def record_last(rollout: Rollout, problem: Problem) -> Rollout:
    """In a deterministic game, counts and reward of the last move if it made its pair known."""
    if problem.game.num_successors > 1:
        return rollout
    entry = (*jnp.divmod(rollout.pair, problem.game.num_actions), 0)
    return replace(
        rollout,
        counts=_increment(rollout.counts, entry, rollout.known),
        reward=_note_reward(rollout.reward, entry, rollout.last_reward, rollout.known),
    )


_Entry = tuple[jax.Array, jax.Array, jax.Array | int]


def _increment(counts: jax.Array, entry: _Entry, once: jax.Array) -> jax.Array:
    return counts.at[entry].add(once.astype(counts.dtype), mode="promise_in_bounds")


def _note_reward(
    reward: jax.Array, entry: _Entry, observed: jax.Array, noted: jax.Array
) -> jax.Array:
    """The observed reward in place of the optimistic one, which is larger."""
    least = jnp.where(noted, observed, jnp.inf).astype(reward.dtype)
    return reward.at[entry].min(least, mode="promise_in_bounds")


# --- the optimistic model ----------------------------------------------------------------------


def update_model(state: State, rollout: Rollout, problem: Problem, hparams: Hparams) -> State:
    """The state after a rollout, with the model solved again if it changed."""
    game, changed = problem.game, rollout.known | rollout.fresh
    place = jnp.divmod(rollout.pair, game.num_actions)
    probability, row = state.probability, take(state.probability, place)
    if game.num_successors > 1:
        # Every listed successor counts as observed at least once, which keeps the graph.
        listed = take(game.mdp.probability, place) > 0
        count = jnp.where(listed, jnp.maximum(take(rollout.counts, place), 1), 0)
        row = jnp.where(rollout.known, count / jnp.sum(count).astype(game.dtype), row)
        probability = probability.at[place].set(row, mode="promise_in_bounds")
    gain = jnp.sum(row * take(rollout.reward, place))
    gain = jnp.where(changed, gain, take(state.gain, place))
    known_at = jnp.where(rollout.known, rollout.moves, take(state.known_at, place))
    state = replace(
        state,
        moves=rollout.moves,
        position=rollout.position,
        fault=rollout.fault,
        counts=rollout.counts,
        reward=rollout.reward,
        probability=probability,
        known_at=state.known_at.at[place].set(known_at, mode="promise_in_bounds"),
        gain=state.gain.at[place].set(gain, mode="promise_in_bounds"),
        num_known=state.num_known + rollout.known,
        last_update=jnp.where(changed, rollout.moves, state.last_update),
        num_updates=state.num_updates + changed,
    )
    # A loop of one iteration, which is skipped if no lane has changed.
    value, error, best, _ = loops.while_active(
        lambda carry, _: carry[-1],
        _solve,
        (state.value, state.error, state.best, changed),
        (state.gain, state.probability, problem, hparams),
    )
    # Every allowed action then has positive probability, unless that underflows.
    sure = state.always_almost_sure & (exploration(problem, hparams) / game.num_actions > 0)
    return replace(state, value=value, error=error, best=best, always_almost_sure=sure)


_Values = tuple[jax.Array, jax.Array, jax.Array, jax.Array]


def _solve(carry: _Values, model: tuple[jax.Array, jax.Array, Problem, Hparams]) -> _Values:
    """Value, error and near-optimal actions of a model that has changed."""
    value, error, best, changed = carry
    gain, probability, problem, hparams = model
    dtype = problem.game.dtype
    value, width, quantity = span_iteration(
        problem.game,
        problem.allowed,
        Models(
            gain,
            probability,
            value,
            jnp.asarray(hparams.discount, dtype),
            solver_tolerance(problem, hparams),
            changed,
        ),
    )
    # Within eps_1 minus twice the error by these values implies within eps_1 by the exact values.
    tolerance = pac.action_tolerance(hparams.epsilon, hparams.discount)
    strict = jnp.maximum(tolerance - 2 * width, 0).astype(dtype)
    near = pac.near_optimal(quantity, problem.allowed & problem.game.system[:, None], strict)
    error, best = jnp.where(changed, width, error), jnp.where(changed, near, best)
    return value, error, best, jnp.zeros_like(changed)


def unknown_reward(hparams: Hparams) -> jax.Array:
    """The optimistic reward ``R_max / (1 - discount)`` of an unknown pair."""
    return jnp.asarray(hparams.reward_bound) / (1 - jnp.asarray(hparams.discount))


def exploration(problem: Problem, hparams: Hparams) -> jax.Array:
    """The probability of drawing any allowed action instead of a near-optimal one."""
    p = pac.exploration(hparams.epsilon, hparams.discount, hparams.reward_bound)
    return jnp.asarray(p, problem.game.dtype)


def required_visits(problem: Problem, hparams: Hparams) -> jax.Array:
    """The visits after which a pair is known."""
    visits = hparams.known_after
    if visits is None:
        visits = pac.visits(
            hparams.epsilon,
            hparams.failure,
            hparams.discount,
            hparams.reward_bound,
            jnp.sum(problem.region),
            problem.game.num_actions,
        )
    return jnp.asarray(visits, problem.game.dtype)


def solver_tolerance(problem: Problem, hparams: Hparams) -> jax.Array:
    """The error of the optimistic value at which a solve stops."""
    dtype = problem.game.dtype
    tolerance = pac.action_tolerance(hparams.epsilon, hparams.discount) / 4
    rest = 1 - jnp.asarray(hparams.discount, dtype)
    rounding = 8 * jnp.finfo(dtype).eps * jnp.asarray(unknown_reward(hparams), dtype) / rest
    return jnp.maximum(tolerance, rounding).astype(dtype)
