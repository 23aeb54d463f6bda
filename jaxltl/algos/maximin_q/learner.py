"""Q-learning in turn-based games with unknown rewards (dissertation, section 5.4.2).

The system maximises, the environment minimises, and both play only moves that a mask
allows, for example a permissive strategy's. Many chains play at once and share one table.
A reward is read only of a move that was made.

Two methods, chosen by ``make_problem(..., method=...)``. Generalized Q-learning for
alternating Markov games (Littman and Szepesvari 1996) keeps a value for each move of
either player::

    Q(s, a) <- (1 - alpha) Q(s, a) + alpha (r + g(s) V(t)),    s -a-> t,
    V(t) = max_a Q(t, a) where the system moves, min_a Q(t, a) where the environment does,

with ``g(s) = discount`` at the system's states, and at the environment's 1 if the discount
is paid per system move. Maximin Q-learning, a variation of minimax-Q (Littman 1994), keeps
a value for each system move and answer, where turns strictly alternate::

    Q(s, a, o) <- (1 - alpha) Q(s, a, o) + alpha (r + g(s) (r' + g(e) V(t))),  s -a-> e -o-> t,
    V(s) = max_a min_o Q(s, a, o).

Both converge to the minimax value if every allowed move is made infinitely often and
either the game is deterministic and ``alpha = 1``, or ``alpha`` decays as is usual.

Example: in one state the system may stay or go to the other, which pays.

  >>> import jax
  >>> import jaxltl as jl
  >>> from jaxltl.algos import maximin_q
  >>> game = jl.make_game(jl.from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 1.0]]]), [True, True])
  >>> problem = maximin_q.make_problem(game, [[0.0, 0.0], [1.0, 1.0]])
  >>> hparams = maximin_q.Hparams(discount=0.5, restart=0.5, num_chains=4, moves_per_step=8)
  >>> state, metrics = maximin_q.train(jax.random.key(0), problem, hparams, num_steps=10)
  >>> [round(v, 3) for v in state.value.tolist()], metrics.violations[-1].item()
  ([1.0, 2.0], 0)
  >>> maximin_q.policy(state, problem, hparams).tolist()
  [1, 0]
  >>> maximin_q.recurrent_states(problem).tolist()  # nobody leaves the second
  [False, True]

A run is made of steps, goes on from a state, and may end early:

  >>> state = maximin_q.init(jax.random.key(0), problem, hparams)  # train is init and run
  >>> state, metrics = maximin_q.run(state, problem, hparams, num_steps=10)  # step after step
  >>> until = maximin_q.value_rests(1e-6)  # for run_until and train_until
  >>> state.step.item()
  10
  >>> maximin_q.measure(state, problem, hparams).moves.item()  # of 4 chains, 8 a step
  320.0

Many seeds are ``jax.vmap(lambda key: train(key, problem, hparams, num_steps=...))(keys)``; so are
many settings, by ``vmap`` over the numbers of ``Hparams``. End when
the value rests by ``train_until(..., until=value_rests(1e-6), check_every=...)``.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos.common import learner, splitmix
from jaxltl.algos.common.play import (
    check_distributions,
    check_reward,
    cumulative,
    draw,
    take,
)
from jaxltl.algos.maximin_q._chains import Table, alias_table, finite, move, reduce_last
from jaxltl.core.graphs.end_components import bottom_components
from jaxltl.core.models.build.restrict import restrict
from jaxltl.core.models.game import Game, as_padded_game
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.ops.operators import action_argmax
from jaxltl.core.pretty_print import brief, history
from jaxltl.core.types import Status, require_shape, status_code

__all__ = [
    "Hparams",
    "Metrics",
    "Problem",
    "State",
    "init",
    "make_problem",
    "measure",
    "policy",
    "recurrent_states",
    "run",
    "run_until",
    "step",
    "train",
    "train_until",
    "value",
    "value_rests",
]


@brief
@struct.dataclass
class Problem:
    """A game to play, with what the learner may not see before it plays.

    Attributes:
      game: on an explicit MDP, such as ``restrict`` returns.
      reward: ``float[S, A]`` or ``float[S, A, K]``, read only along moves that are made.
      allowed: ``bool[S, A]``: the mask at the system's states, all moves at the environment's.
      behavior: ``float[S, A]``, how moves are drawn where they are not greedy.
      start: ``float[S]``, where chains begin and begin anew.
      exact: ``float[S]``, the true value if it is known, to measure the error; else None.
      measured: ``bool[S]``, the states over which the error is measured; None with `exact`.
      behavior_table: ``uint32[S, A]``, `behavior` as alias tables.
      start_table: ``uint32[S]``, `start` as cumulative thresholds.
      method: ``"generalized"`` or ``"maximin"``; static.
    """

    game: Game
    reward: jax.Array
    allowed: jax.Array
    behavior: jax.Array
    start: jax.Array
    exact: Any
    measured: Any
    behavior_table: jax.Array
    start_table: jax.Array
    method: str = struct.field(pytree_node=False, default="generalized")


@brief
@struct.dataclass
class Hparams:
    """How to learn. Numbers are traced, so new values do not recompile; None is static.

    Attributes:
      discount: in [0, 1).
      step_size: alpha; None is 1 for games without chance, where the new value replaces
        the old one, which is fastest; default None.
      step_power: with omega in (1/2, 1], the n-th visit of a pair has the step size
        ``alpha / n ** omega``; None: always alpha. Near 1 the old is forgotten very slowly
        (Even-Dar and Mansour 2003). Default None.
      epsilon: the system plays greedily with probability ``1 - epsilon``; None: never;
        default None.
      environment_epsilon: the same for the environment, which is then adversarial; default None.
      epsilon_decay: both epsilons are multiplied by ``epsilon_decay ** step``; default 1.0.
      epsilon_min: and are at least this; default 0.0.
      restart: the probability with which a chain starts anew at the beginning of a step;
        default 0.0.
      initial_value: of every entry of the table. The environment's untried moves count.
        Default 0.0.
      per: ``"system_move"`` or ``"move"``: which moves pay the discount; static;
        default ``"system_move"``.
      num_chains: static; default 1024.
      moves_per_step: of each chain; static. A step reports once, so few moves cost more each.
        Default 64.
    """

    discount: jax.Array | float
    step_size: jax.Array | float | None = None
    step_power: jax.Array | float | None = None
    epsilon: jax.Array | float | None = None
    environment_epsilon: jax.Array | float | None = None
    epsilon_decay: jax.Array | float = 1.0
    epsilon_min: jax.Array | float = 0.0
    restart: jax.Array | float = 0.0
    initial_value: jax.Array | float = 0.0
    per: str = struct.field(pytree_node=False, default="system_move")
    num_chains: int = struct.field(pytree_node=False, default=1024)
    moves_per_step: int = struct.field(pytree_node=False, default=64)


@brief
@struct.dataclass
class State:
    """A table on its way, and the chains that fill it.

    Attributes:
      key: of the whole run.
      step: ``int32[]``, steps made.
      q: ``float[S, A]``, or ``float[S, A, A]`` of a system state, its move and the answer;
        minus infinity at system moves that are not allowed, plus infinity at the
        environment's, so that maxima and minima pass over them.
      visits: ``int32`` like `q`, how often each entry was updated, counted up to 2^30.
      value: ``float[S]``, of `q`.
      residual: ``float[]``, the largest change of `value` in the last step.
      violations: ``int32[]``, moves made that were not allowed, of all chains. It stays zero.
      position: ``int32[num_chains]``, where the chains are.
      pending: ``int32[num_chains]``, the system's move ``s * A + a`` that waits for its
        answer, or -1; None unless the method is maximin.
      held: ``float[num_chains]``, the reward of that move; None likewise.
    """

    key: jax.Array
    step: jax.Array
    q: jax.Array
    visits: jax.Array
    value: jax.Array
    residual: jax.Array
    violations: jax.Array
    position: jax.Array
    pending: Any
    held: Any


@brief(facts=partial(history, codes={"status": Status}))
@struct.dataclass
class Metrics:
    """Figures after a step; scalars, of a run ``[T]``.

    Attributes:
      residual: the largest change of the value in the step.
      moves: made so far by all chains, as a float.
      visited: distinct entries of the table that were updated.
      violations: moves made so far that were not allowed.
      error: the largest error over the measured states; NaN where the value is not known.
      status: NONFINITE if a value is no number, else CONVERGED: that it is the game's value is
        not known; see :func:`value_rests`.
    """

    residual: jax.Array
    moves: jax.Array
    visited: jax.Array
    violations: jax.Array
    error: jax.Array
    status: jax.Array


# --- problems, on the host ------------------------------------------------------------------


def make_problem(
    game: Any,
    reward: chex.Array,
    *,
    allowed: chex.Array | None = None,
    environment: chex.Array | None = None,
    start: chex.Array | None = None,
    exact: chex.Array | None = None,
    measured: chex.Array | None = None,
    method: str = "generalized",
) -> Problem:
    """A checked :class:`Problem`, on the host.

    Args:
      game: a Game on an explicit MDP, or an MDP, in which the system always moves.
      reward: ``float[S, A]`` or ``float[S, A, K]``, of the moves of both players.
      allowed: ``bool[S, A]``, such as a permissive strategy's mask; default the available
        moves. Only the system's states count: the environment is free.
      environment: ``float[S, A]``, how the environment plays where it is not greedy;
        default uniformly. Only its own states count. The value that is learned is a
        minimum over all its moves, so it should try them all.
      start: ``float[S]``, a distribution over the states where chains begin; default the
        game's.
      exact: ``float[S]``, the true value, to measure the error.
      measured: ``bool[S]``, where to measure it, such as :func:`recurrent_states`; default
        wherever a move is allowed (with maximin: at the system's states).
      method: ``"generalized"`` or ``"maximin"``.

    Returns:
      :class:`Problem`.

    Raises:
      ValueError: a wrong shape, a reward that is not finite, a mask that allows a move
        that does not exist or none in a state that can be reached, rows or a start that
        are no distributions, or a game that does not fit the method.

    Example:
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 1.0]]])
      >>> problem = make_problem(mdp, [[0.0, 0.0], [1.0, 1.0]], allowed=[[False, True]] * 2)
      >>> problem.allowed.tolist(), problem.method
      ([[False, True], [False, True]], 'generalized')
    """
    if method not in ("generalized", "maximin"):
        raise ValueError(f'method={method!r}; choose "generalized" or "maximin".')
    game = as_padded_game(game)
    if not isinstance(game.mdp, MDP):
        raise ValueError(
            f"the game's model is a {type(game.mdp).__name__}; learning plays in an explicit MDP: "
            "pass restrict(game).model, or convert it."
        )
    shape, system = (game.num_states, game.num_actions), np.asarray(game.system)
    if shape[1] > 256:
        raise ValueError(f"the game has {shape[1]} actions; drawing moves works up to 256.")
    mask = _mask(game, system, allowed)
    start = np.asarray(game.initial if start is None else start, float)
    require_shape("start", start, shape[:1])
    check_distributions("start", start[None], np.ones((1, shape[0]), bool))
    reachable = np.asarray(restrict(game, start, allowed=mask).base_state)
    if method == "maximin":
        _check_alternating(game, system, reachable)
    behavior = _behavior(mask, system, environment)
    if exact is not None:
        exact = jnp.asarray(exact, game.dtype)
        require_shape("exact", exact, shape[:1])
        default = mask.any(-1) & (system if method == "maximin" else True)
        measured = jnp.asarray(default if measured is None else measured, bool)
        require_shape("measured", measured, shape[:1])
    return Problem(
        game=game,
        reward=check_reward(game, reward),
        allowed=jnp.asarray(mask),
        behavior=jnp.asarray(behavior, game.dtype),
        start=jnp.asarray(start, game.dtype),
        exact=exact,
        measured=None if exact is None else measured,
        behavior_table=jnp.asarray(alias_table(behavior)),
        start_table=jnp.asarray(cumulative(start)),
        method=method,
    )


def recurrent_states(problem: Problem) -> jax.Array:
    """States that chains without restarts visit infinitely often, if nobody plays greedily.

    They are the bottom components of the reachable part, ``bool[S]``; on the host.

    Args:
      problem: of :func:`make_problem`.

    Returns:
      ``bool[S]``, for ``make_problem(..., measured=...)``.
    """
    part = restrict(problem.game, problem.start, allowed=problem.behavior > 0)
    inside = bottom_components(part.model, part.model.available).inside.any(-1)
    found = np.zeros(problem.game.num_states, bool)
    found[np.asarray(part.base_state)[np.asarray(inside)]] = True
    return jnp.asarray(found)


def _mask(game: Game, system: np.ndarray, allowed: Any) -> np.ndarray:
    available = np.asarray(game.available)
    if allowed is None:
        return available
    allowed = np.asarray(allowed)
    require_shape("allowed", allowed, available.shape)
    if allowed.dtype != bool:
        raise ValueError(f"allowed has dtype {allowed.dtype}; it must be bool.")
    wrong = np.argwhere(allowed & ~available & system[:, None])
    if wrong.size:
        raise ValueError(
            f"allowed: state {wrong[0][0]} has no action {wrong[0][1]}; allow available "
            "actions only."
        )
    return np.where(system[:, None], allowed, available)


def _behavior(mask: np.ndarray, system: np.ndarray, environment: Any) -> np.ndarray:
    """Uniform over allowed moves, or the environment's rows where it moves."""
    evenly = mask / np.maximum(mask.sum(-1, keepdims=True), 1)
    if environment is None:
        return evenly
    environment = np.asarray(environment, float)
    require_shape("environment", environment, mask.shape)
    rows = np.where(system[:, None], evenly, environment)
    check_distributions("environment", rows, mask, system)
    return rows


def _check_alternating(game: Game, system: np.ndarray, reachable: np.ndarray) -> None:
    used = np.asarray(game.mdp.probability) > 0
    owner = system[np.asarray(game.mdp.successor)]
    again = np.argwhere((used & (owner == system[:, None, None]))[reachable])
    if again.size:
        raise ValueError(
            f"method='maximin' needs strictly alternating turns, but in state "
            f"{reachable[again[0][0]]} action {again[0][1]} leads to a state of the same player; "
            "use method='generalized'."
        )
    chance = np.argwhere(((used.sum(-1) > 1) & system[:, None])[reachable])
    if chance.size:
        raise ValueError(
            f"method='maximin' needs system moves with one successor, but in state "
            f"{reachable[chance[0][0]]} action {chance[0][1]} has several; use "
            "method='generalized'."
        )


_MOST_VISITS = 2**30  # counted; a step adds at most as many again


# --- the learner ----------------------------------------------------------------------------


@jax.jit
def init(key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
    """A table of ``hparams.initial_value``, and chains at states drawn from the start.

    Args:
      key: a PRNG key, which the state keeps; ``vmap`` over keys for many seeds.
      problem: of :func:`make_problem`.
      hparams: :class:`Hparams`.

    Returns:
      :class:`State`, no step made.

    Raises:
      ValueError: unknown `per`, no chain or move, or no step size for a game with chance.
    """
    _check(problem, hparams)
    dtype, system = problem.game.dtype, problem.game.system
    legal = problem.allowed
    if problem.method == "maximin":
        legal = _answers(problem)
        worst = jnp.where(problem.allowed & system[:, None], jnp.inf, -jnp.inf)[..., None]
    else:
        worst = jnp.where(system, -jnp.inf, jnp.inf)[:, None]
    q = jnp.where(legal, jnp.asarray(hparams.initial_value, dtype), worst.astype(dtype))
    words = jax.random.bits(learner.init_key(key), (hparams.num_chains,), jnp.uint32)
    waiting = problem.method == "maximin"
    return State(
        key=key,
        step=jnp.int32(0),
        q=q,
        visits=jnp.zeros(q.shape, jnp.int32),
        value=value(q, problem),
        residual=jnp.asarray(jnp.inf, dtype),
        violations=jnp.int32(0),
        position=draw(problem.start_table, words),
        pending=jnp.full(hparams.num_chains, -1, jnp.int32) if waiting else None,
        held=jnp.zeros(hparams.num_chains, dtype) if waiting else None,
    )


def step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """``moves_per_step`` moves of every chain.

    The chains move together: all read the table, then all write. Where m of them make the
    same move from one state, all m take the step size a of its next visit, and together
    do what m visits in turn would do with the mean of their targets::

        Q <- (1 - a)^m Q + (1 - (1 - a)^m) mean.

    Cost: a few nanoseconds for each move and allowed action, without arrays of their number.

    Args:
      state: of :func:`init` or of an earlier step; unchanged.
      problem, hparams: as of :func:`init`.

    Returns:
      The next :class:`State`, and :class:`Metrics`, figures after the step.
    """
    _check(problem, hparams)
    start_key, action_key, successor_key = (
        jax.random.fold_in(learner.step_key(state), i) for i in range(3)
    )
    state = _restart(start_key, state, problem, hparams)
    stream = splitmix.streams(action_key, (hparams.num_chains,))
    table = Table(
        state.q.ravel(),
        state.visits.ravel(),
        state.position,
        take(problem.game.system, state.position),
        state.pending,
        state.held,
        state.violations,
    )
    one = partial(move, problem, hparams, _epsilons(state.step, hparams), stream, successor_key)
    count = jnp.arange(hparams.moves_per_step, dtype=jnp.uint32)
    table, _ = lax.scan(lambda t, i: (one(t, i), None), table, count)
    q = table.q.reshape(state.q.shape)
    updated = value(q, problem)
    residual = jnp.max(jnp.abs(updated - state.value))
    state = State(
        key=state.key,
        step=state.step + 1,
        q=q,
        visits=jnp.minimum(table.visits, _MOST_VISITS).reshape(q.shape),
        value=updated,
        residual=residual,
        violations=jnp.minimum(table.violations, _MOST_VISITS),
        position=table.position,
        pending=table.pending,
        held=table.held,
    )
    return state, measure(state, problem, hparams)


run, train, run_until, train_until = learner.bind(init, step)


def measure(state: State, problem: Problem, hparams: Hparams) -> Metrics:
    """The :class:`Metrics` of a state.

    Args:
      state, problem, hparams: of a run.

    Returns:
      :class:`Metrics`, scalars.
    """
    dtype = problem.game.dtype
    error, finite = jnp.asarray(jnp.nan, dtype), jnp.all(jnp.isfinite(state.value))
    if problem.exact is not None:
        gap = jnp.abs(state.value - problem.exact)
        error = jnp.max(jnp.where(problem.measured, gap, 0))
    return Metrics(
        residual=state.residual,
        moves=state.step.astype(dtype) * (hparams.num_chains * hparams.moves_per_step),
        visited=jnp.sum(state.visits > 0, dtype=jnp.int32),
        violations=state.violations,
        error=error,
        status=status_code(finite, finite),
    )


def value_rests(tolerance: chex.Numeric) -> learner.Until:
    """A condition for :func:`run_until`: no state's value has changed by more than a tolerance.

    A move that was made for the first time counts as a change. That the value rests is evidence
    of convergence and no proof of it: the longer the window, ``check_every``, the better the
    evidence.

    Args:
      tolerance: in units of the value, at least 0; traced.

    Returns:
      A condition, for ``until``.
    """
    return Partial(_value_rests, tolerance)


def _value_rests(tolerance: Any, before: State, after: State, metrics: Metrics) -> jax.Array:
    change = jnp.max(jnp.abs(after.value - before.value))
    unseen = jnp.any((before.visits == 0) & (after.visits > 0))
    # A run whose values are no numbers ends too, with the status that says so.
    return ((change <= tolerance) & ~unseen) | jnp.isnan(change)


def value(q: jax.Array, problem: Problem) -> jax.Array:
    """The value of each state by a table: ``float[S]``.

    Zero where no move is allowed, and at the environment's states with maximin, whose
    table holds none for them.

    Args:
      q: ``float[S, A]``, or ``float[S, A, A]`` with maximin; ``state.q``.
      problem: of it.

    Returns:
      ``float[S]``, in units of the reward.
    """
    if problem.method == "maximin":
        return finite(reduce_last(jnp.maximum, reduce_last(jnp.minimum, q)))
    least, most = reduce_last(jnp.minimum, q), reduce_last(jnp.maximum, q)
    return finite(jnp.where(problem.game.system, most, least))


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """Each player's first best move by the table, ``int32[S]``.

    With maximin the environment's moves are its first ones: its best answer depends on the
    system's move, and is the minimum of ``state.q[s, a]``.

    Args:
      state: of one run; ``vmap`` over several.
      problem, hparams: of the run.

    Returns:
      ``int32[S]``; 0 where no move is allowed.
    """
    del hparams
    if problem.method == "maximin":
        worst = jnp.where(problem.game.system[:, None], state.q.min(-1), 0)
        return action_argmax(worst, problem.allowed)[1]
    sign = jnp.where(problem.game.system, 1, -1)[:, None]
    return action_argmax(sign * state.q, problem.allowed)[1]


def _restart(key, state: State, problem, hparams) -> State:
    """Some chains start anew, and forget a move that waits for its answer."""

    def redraw(position, pending):
        words = jax.random.bits(key, (2, hparams.num_chains), jnp.uint32)
        anew = splitmix.uniform(words[0], state.value.dtype) < hparams.restart
        pending = None if pending is None else jnp.where(anew, -1, pending)
        return jnp.where(anew, draw(problem.start_table, words[1]), position), pending

    position, pending = lax.cond(
        jnp.asarray(hparams.restart) > 0, redraw, lambda *x: x, state.position, state.pending
    )
    return replace(state, position=position, pending=pending)


def _epsilons(step, hparams) -> tuple[Any, Any]:
    """Both players' probabilities of not being greedy; None: never greedy."""

    def at(epsilon):
        if epsilon is None:
            return None
        decayed = epsilon * jnp.asarray(hparams.epsilon_decay) ** step
        return jnp.maximum(decayed, hparams.epsilon_min)

    return at(hparams.epsilon), at(hparams.environment_epsilon)


def _answers(problem: Problem) -> jax.Array:
    """Which answers each system move leaves to the environment: ``bool[S, A, A]``."""
    mdp = problem.game.mdp
    k = jnp.argmax(mdp.probability, axis=-1)[..., None]
    between = jnp.take_along_axis(mdp.successor, k, axis=-1)[..., 0]
    mine = problem.allowed & problem.game.system[:, None]
    return mine[..., None] & problem.allowed[between]


def _check(problem: Problem, hparams: Hparams) -> None:
    if hparams.per not in ("move", "system_move"):
        raise ValueError(f'per={hparams.per!r}; choose "move" or "system_move".')
    if hparams.num_chains < 1 or hparams.moves_per_step < 1:
        raise ValueError(
            f"num_chains={hparams.num_chains}, moves_per_step={hparams.moves_per_step}; both "
            "must be at least 1."
        )
    if hparams.num_chains * hparams.moves_per_step > _MOST_VISITS:
        raise ValueError(
            f"num_chains={hparams.num_chains} times moves_per_step={hparams.moves_per_step} is "
            f"more than {_MOST_VISITS} moves; make them in several steps."
        )
    if hparams.step_size is None and problem.game.num_successors > 1:
        raise ValueError(
            "step_size=None replaces old values, which is for games without chance (lists of "
            "one successor); give a number, and a step_power to converge."
        )
    if hparams.step_size is None and hparams.step_power is not None:
        raise ValueError("step_power needs a step_size to start from; give step_size=1.0.")
