"""R-max in the almost-sure winning region of a stochastic game (Wen 2019, chapter 6).

Algorithm 5: PAC learning of an epsilon-optimal strategy among those that satisfy a Buchi objective
almost surely, in a turn-based game with a known graph and unknown probabilities and rewards
(after Brafman and Tennenholtz 2002). At every moment the strategy wins almost surely: with a small
probability it draws any action that stays in the winning region, else one that is near-optimal in
an optimistic model. A state-action pair becomes known after enough visits; then its frequencies and
rewards enter the model, which is solved again from the last values.

The true game is read through ``sample_successor`` and the rewards of observed transitions only.
Arrays cover the S states of ``problem.game``; states outside of the region are never entered.

Example: to come home again and again, with a reward for staying away.
  >>> import jax
  >>> import jaxltl as jl
  >>> from jaxltl.algos import rmax
  >>> world = jl.from_dense([[[1.0, 0], [0, 1.0]], [[1.0, 0], [1.0, 0]]],
  ...                       label=[[0], [1]], propositions=["home"], initial=[1, 0])
  >>> problem = rmax.make_problem(world, "G F home", [[1.0, 0.0], [0.0, 0.0]])
  >>> problem.region.tolist()
  [True, True]
  >>> hparams = rmax.Hparams(discount=0.5, reward_bound=1.0, epsilon=0.1)
  >>> learned = rmax.train_until(jax.random.key(0), problem, hparams, num_steps=10_000,
  ...                            until=rmax.strategy_is_stable(1000))
  >>> learned.metrics.num_known.item(), rmax.policy(learned.state, problem, hparams).shape
  (4, (2, 2))
  >>> found = rmax.evidence(learned.state, problem, hparams)
  >>> bool(found.almost_sure), found.epsilon_optimal.all().tolist()
  (True, True)
  >>> rmax.wins_almost_surely(problem, found.strategy).item()
  True
  >>> data = rmax.data_evidence(problem, learned.state.counts, found.strategy, 0.5, confidence=0.9)
  >>> bool((data.secured <= found.worst_case.upper).all())
  True

Transitions may come from elsewhere:

  >>> state = rmax.init(jax.random.key(0), problem, hparams)
  >>> state = rmax.observe(state, problem, hparams, action=1, successor=1, reward=0.0)
  >>> state.position.item(), state.moves.item()
  (1, 1)
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxltl.algos.common import learner, loops, pac, splitmix
from jaxltl.algos.common.explicit_games import (
    draw,
    draw_weighted,
    observed_reward,
    successor_slot,
    take,
)
from jaxltl.algos.rmax.problem import Hparams, Metrics, Problem, State, reward_error
from jaxltl.core import struct
from jaxltl.core.array_types import Key, Numeric
from jaxltl.core.models.ops.operators import sample_successor
from jaxltl.core.values.discounted.warm_start import Models, span_iteration


@jax.jit
def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """No pair known: each is assumed to pay ``R_max / (1 - discount)`` for ever."""
    game, shape = problem.game, problem.game.mdp.probability.shape
    listed = game.mdp.probability > 0
    bound = jnp.asarray(unknown_reward(hparams), game.dtype)
    value = jnp.where(problem.region, bound / (1 - hparams.discount), 0)
    word = jax.random.bits(learner.init_key(key), (), jnp.uint32)
    return State(
        key=key,
        step=jnp.int32(0),
        moves=jnp.int32(0),
        position=draw(problem.initial_table, word),
        counts=jnp.zeros(shape, jnp.int32),
        reward=jnp.full(shape, bound, game.dtype),
        known_at=jnp.full(shape[:2], -1, jnp.int32),
        num_known=jnp.int32(0),
        probability=listed / jnp.maximum(listed.sum(-1, keepdims=True), 1).astype(game.dtype),
        gain=jnp.where(problem.allowed, bound, 0),
        value=value.astype(game.dtype),
        best=problem.allowed & game.system[:, None],
        error=jnp.zeros((), game.dtype),
        last_update=jnp.int32(0),
        num_updates=jnp.int32(0),
        always_almost_sure=jnp.bool_(True),
        fault=jnp.int32(-1),
    )


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """At most ``moves_per_step`` moves, until the model changes, and the new strategy."""
    return _step_if(state, problem, hparams, jnp.bool_(True))


def _step_if(
    state: State, problem: Problem, hparams: Hparams, active: jax.Array
) -> tuple[State, Metrics]:
    """A step, or the same state without copying its arrays."""
    moves = jnp.where(active, hparams.moves_per_step, 0)
    moves = jnp.minimum(moves, loops.MAX_STEPS - state.moves).astype(jnp.int32)
    begin, rules = _start_rollout(state, moves), _rules(state, problem, hparams)
    rollout = loops.while_active(lambda r, _: r.remaining > 0, _move, begin, rules)
    state = _update_model(rollout, problem, hparams)
    state = replace(state, step=state.step + active)
    return state, measure(state, problem, hparams)


init, step, run, train, run_until, train_until = learner.bind(_init, _step, step_if=_step_if)


def measure(state: State, problem: Problem, hparams: Hparams) -> Metrics:
    """The :class:`Metrics` of a state."""
    solved = state.error <= solver_tolerance(problem, hparams)
    return Metrics(
        moves=state.moves,
        num_known=state.num_known,
        last_update=state.last_update,
        num_updates=state.num_updates,
        value=jnp.sum(problem.initial * state.value),
        always_almost_sure=state.always_almost_sure,
        fault=state.fault,
        residual=state.error,
        status=learner.completion_status(
            solved & (state.moves < loops.MAX_STEPS), jnp.isfinite(state.error)
        ),
    )


def strategy_is_stable(moves: Numeric) -> loops.Until:
    """A condition for ``run_until``: the strategy has not changed for a number of `moves`."""
    return Partial(_strategy_is_stable, moves)


def _strategy_is_stable(
    moves: jax.Array, before: State, after: State, metrics: Metrics
) -> jax.Array:
    return after.moves - after.last_update >= moves


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The system's strategy ``float[S, A]`` (remark 4); zero elsewhere."""
    allowed = problem.allowed & problem.game.system[:, None]
    return pac.hat_strategy(state.best, allowed, exploration(problem, hparams))


def observe(
    state: State, problem: Problem, hparams: Hparams, action: int, successor: int, reward: float
) -> State:
    """The next state of the learner after a transition of an external world; on the host.

    Of its `state`, `problem` and `hparams`: the `action` at ``state.position``, the `successor` in
    ``problem.game``, and the `reward`. The system's actions are to be drawn from
    ``policy(state, problem, hparams)[state.position]``. To restart, set the position first:
    ``state.replace(position=jnp.int32(s))``.

    Raises:
      ValueError: the action is not allowed, the successor is not in the graph, or the reward lies
        outside of [0, R_max].
    """
    game, s = problem.game, int(state.position)
    if not 0 <= action < game.num_actions or not bool(problem.allowed[s, action]):
        moves = np.flatnonzero(np.asarray(problem.allowed[s])).tolist()
        raise ValueError(f"state {s}: action {action} leaves the region; choose one of {moves}.")
    used = np.asarray(game.mdp.probability[s, action]) > 0
    listed = np.asarray(game.mdp.successor[s, action])[used]
    if successor not in listed:
        raise ValueError(
            f"state {s}, action {action}: successor {successor} is not in the given graph, which "
            f"has {listed.tolist()}. Without the true graph nothing is guaranteed: mend the model."
        )
    if not 0 <= reward <= float(hparams.reward_bound):
        raise reward_error(s, action, reward, hparams)
    seen = (state.position, *map(jnp.int32, (action, successor)), jnp.asarray(reward, game.dtype))
    return _observe(state, problem, hparams, seen)


_Transition = tuple[jax.Array, ...]  # state, action, successor and reward


@jax.jit
def _observe(state: State, problem: Problem, hparams: Hparams, seen: _Transition) -> State:
    rules = _rules(state, problem, hparams)
    rollout = _record(_start_rollout(state, jnp.int32(1)), seen, rules, jnp.bool_(True))
    return _update_model(rollout, problem, hparams)


# --- rollouts between two updates of the model ---------------------------------------------------

# A rollout changes one entry of each array at a time, so that a loop under `vmap` copies no arrays.


@struct.dataclass
class _Rules:
    """Constants of one step."""

    problem: Problem
    hparams: Hparams
    key: jax.Array
    stream: splitmix.Stream
    explore: jax.Array
    enough: jax.Array


def _rules(state: State, problem: Problem, hparams: Hparams) -> _Rules:
    key = learner.step_key(state)
    return _Rules(
        problem=problem,
        hparams=hparams,
        key=jax.random.fold_in(key, 1),
        stream=splitmix.streams(jax.random.fold_in(key, 0)),
        explore=exploration(problem, hparams),
        enough=required_visits(problem, hparams),
    )


@struct.dataclass
class _Rollout:
    """A rollout, which ends with a change of the model or after `remaining` moves.

    Its last move was of a `pair`, which became `known`, or had a `fresh` successor.
    """

    state: State
    remaining: jax.Array
    pair: jax.Array
    observed: jax.Array  # reward of the last move
    known: jax.Array
    fresh: jax.Array


def _start_rollout(state: State, moves: jax.Array) -> _Rollout:
    """A rollout of at most some moves from the current position."""
    no, zero = jnp.bool_(False), jnp.zeros((), state.reward.dtype)
    return _Rollout(state, moves, jnp.int32(0), zero, no, no)


def _move(rollout: _Rollout, rules: _Rules) -> _Rollout:
    """One move, if any remain."""
    state, problem, game = rollout.state, rules.problem, rules.problem.game
    dtype = game.dtype
    count = state.moves.astype(jnp.uint32)
    words = [splitmix.words(rules.stream, 4 * count + i) for i in range(4)]
    restarts = splitmix.uniform(words[0], dtype) < jnp.asarray(rules.hparams.restart, dtype)
    s = jnp.where(restarts, draw(problem.initial_table, words[1]), state.position)
    explores = splitmix.uniform(words[2], dtype) < rules.explore
    mine = jnp.where(explores, take(problem.allowed, s), take(state.best, s))
    weight = jnp.where(take(game.system, s), mine, take(problem.environment, s))
    action = draw_weighted(weight, words[3])
    # A deterministic game needs no key.
    key = rules.key if game.num_successors == 1 else jax.random.fold_in(rules.key, state.moves)
    successor = sample_successor(game, key, s, action)
    reward = observed_reward(game, problem.reward, s, action, successor)
    return _record(rollout, (s, action, successor, reward), rules, rollout.remaining > 0)


def _record(rollout: _Rollout, seen: _Transition, rules: _Rules, active: jax.Array) -> _Rollout:
    """The rollout after an observed transition, or unchanged if it is not active."""
    (s, action, successor, observed), state = seen, rollout.state
    game, every = rules.problem.game, rules.hparams.update == "every"
    # Not flat: arrays that are reshaped in a loop are copied in every iteration.
    place = (s, action)
    was_known = take(state.known_at, place) >= 0
    counts, reward = state.counts, state.reward
    if game.num_successors == 1:
        # A new pair ends the rollout, so that `_update_model` writes what is known of it.
        known, fresh = active & ~was_known, jnp.bool_(False)
    else:
        entry = (*place, successor_slot(game, s, action, successor))
        # Written before it is read, else the whole array would be copied.
        counts = counts.at[entry].add(active.astype(jnp.int32), mode="promise_in_bounds")
        row = take(counts, place)
        single = jnp.sum(take(game.mdp.probability, place) > 0) == 1
        enough = single | (jnp.sum(row).astype(game.dtype) >= rules.enough)
        first = active & (row[entry[-1]] == 1)
        known, fresh = active & ~was_known & enough, first & was_known & every
        reward = _note_reward(reward, entry, observed, first if every else known)
    wrong = active & ~((observed >= 0) & (observed <= rules.hparams.reward_bound))
    pair = s * game.num_actions + action
    after = replace(
        state,
        moves=state.moves + active,
        position=jnp.where(active, successor, state.position),
        counts=counts,
        reward=reward,
        fault=jnp.where(wrong & (state.fault < 0), pair, state.fault),
    )
    rest = jnp.where(known | fresh, 0, rollout.remaining - 1)
    return _Rollout(
        state=after,
        remaining=jnp.where(active, rest, rollout.remaining),
        pair=jnp.where(active, pair, rollout.pair),
        observed=jnp.where(active, observed, rollout.observed),
        known=known | (~active & rollout.known),
        fresh=fresh | (~active & rollout.fresh),
    )


def _note_reward(
    reward: jax.Array, entry: tuple[jax.Array | int, ...], observed: jax.Array, noted: jax.Array
) -> jax.Array:
    """Writes an observed reward in place of the optimistic one, which is larger."""
    least = jnp.where(noted, observed, jnp.inf).astype(reward.dtype)
    return reward.at[entry].min(least, mode="promise_in_bounds")


# --- the optimistic model ----------------------------------------------------------------------


def _update_model(rollout: _Rollout, problem: Problem, hparams: Hparams) -> State:
    """The state after a rollout, with the model solved again if it changed."""
    state, game, changed = rollout.state, problem.game, rollout.known | rollout.fresh
    place = jnp.divmod(rollout.pair, game.num_actions)
    if game.num_successors == 1:
        counts = state.counts.at[(*place, 0)].add(rollout.known, mode="promise_in_bounds")
        reward = _note_reward(state.reward, (*place, 0), rollout.observed, rollout.known)
        state = replace(state, counts=counts, reward=reward)
    # Every listed successor counts as observed at least once, which keeps the graph.
    listed = take(game.mdp.probability, place) > 0
    count = jnp.where(listed, jnp.maximum(take(state.counts, place), 1), 0)
    row = take(state.probability, place)
    row = jnp.where(rollout.known, count / jnp.sum(count).astype(game.dtype), row)
    gain = jnp.sum(row * take(state.reward, place))
    gain = jnp.where(changed, gain, take(state.gain, place))
    known_at = jnp.where(rollout.known, state.moves, take(state.known_at, place))
    state = replace(
        state,
        probability=state.probability.at[place].set(row, mode="promise_in_bounds"),
        known_at=state.known_at.at[place].set(known_at, mode="promise_in_bounds"),
        gain=state.gain.at[place].set(gain, mode="promise_in_bounds"),
        num_known=state.num_known + rollout.known,
        last_update=jnp.where(changed, state.moves, state.last_update),
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
    near_optimal = pac.near_optimal(
        quantity, problem.allowed & problem.game.system[:, None], strict
    )
    error, best = jnp.where(changed, width, error), jnp.where(changed, near_optimal, best)
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
