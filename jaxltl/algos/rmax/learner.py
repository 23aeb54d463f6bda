"""R-max in the almost-sure winning region of a stochastic game (dissertation, chapter 6).

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
from jaxltl.algos.common.play import draw
from jaxltl.algos.rmax._rollout import (
    Rules,
    Transition,
    exploration,
    move,
    pair_flags,
    record,
    record_last,
    required_visits,
    solver_tolerance,
    start_rollout,
    unknown_reward,
    update_model,
)
from jaxltl.algos.rmax.problem import Hparams, Metrics, Problem, State, reward_error
from jaxltl.core.array_types import Key, Numeric


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
        position=draw(problem.start_table, word),
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
    rollout = loops.while_active(
        lambda r, _: r.remaining > 0,
        move,
        start_rollout(state, moves),
        _rules(state, problem, hparams),
    )
    state = update_model(state, record_last(rollout, problem), problem, hparams)
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
        value=jnp.sum(problem.start * state.value),
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
    seen = Transition(
        state=state.position,
        action=jnp.int32(action),
        successor=jnp.int32(successor),
        reward=jnp.asarray(reward, game.dtype),
    )
    return _observe(state, problem, hparams, seen)


@jax.jit
def _observe(state: State, problem: Problem, hparams: Hparams, seen: Transition) -> State:
    rollout = start_rollout(state, jnp.int32(1))
    rollout = record(rollout, seen, _rules(state, problem, hparams), jnp.bool_(True))
    return update_model(state, record_last(rollout, problem), problem, hparams)


def _rules(state: State, problem: Problem, hparams: Hparams) -> Rules:
    dtype, key = problem.game.dtype, learner.step_key(state)
    return Rules(
        problem=problem,
        flags=pair_flags(state.best, state.known_at),
        key=jax.random.fold_in(key, 1),
        stream=splitmix.streams(jax.random.fold_in(key, 0)),
        explore=exploration(problem, hparams),
        enough=required_visits(problem, hparams),
        bound=jnp.asarray(hparams.reward_bound, dtype),
        restart=jnp.asarray(hparams.restart, dtype),
        every=jnp.bool_(hparams.update == "every"),
    )
