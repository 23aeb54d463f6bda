"""Q-learning for two-player games with unknown rewards (Wen 2019, section 5.4.2).

The system maximises and the environment minimises the discounted reward; both choose among the
actions that a mask allows, such as a permissive strategy's. Parallel chains share one table.

Generalized Q-learning for alternating Markov games (Littman and Szepesvari 1996), the default,
has an entry for each state and action of either player::

    Q(s, a) <- (1 - alpha) Q(s, a) + alpha (r + g(s) V(t)),    s -a-> t,
    V(t) = max_a Q(t, a) where the system moves, min_a Q(t, a) where the environment moves,

with ``g(s) = discount`` at the system's states, and 1 at the environment's unless every move is
discounted. Maximin Q-learning, a variant of minimax-Q (Littman 1994) for strictly alternating
turns, has an entry for each action of the system and each answer::

    Q(s, a, o) <- (1 - alpha) Q(s, a, o) + alpha (r + g(s) (r' + g(e) V(t))),  s -a-> e -o-> t,
    V(s) = max_a min_o Q(s, a, o).

Both converge to the minimax value if every allowed action is taken infinitely often and either the
game is deterministic and ``alpha = 1``, or ``alpha`` decays as usual in stochastic approximation.

Example: in one state the system may stay or move to the other state, where it is paid.
  >>> import jax
  >>> import jaxltl as jl
  >>> from jaxltl.algos import maximin_q
  >>> game = jl.make_game(jl.from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 1.0]]]), [True, True])
  >>> problem = maximin_q.make_problem(game, [[0.0, 0.0], [1.0, 1.0]])
  >>> maximin_q.recurrent_states(problem).tolist()
  [False, True]
  >>> problem = maximin_q.with_exact_value(problem, [1.0, 2.0])
  >>> hparams = maximin_q.Hparams(discount=0.5, restart=0.5, num_chains=4, moves_per_step=8)
  >>> learned = maximin_q.train_until(jax.random.key(0), problem, hparams, num_steps=100,
  ...                                 until=maximin_q.value_is_stable(1e-6))
  >>> [round(v, 3) for v in learned.state.value.tolist()], learned.metrics.violations.item()
  ([1.0, 2.0], 0)
  >>> maximin_q.policy(learned.state, problem, hparams).tolist()
  [1, 0]
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial
from numpy.typing import ArrayLike, NDArray

from jaxltl.algos.common import learner, loops, splitmix
from jaxltl.algos.common.explicit_games import (
    check_reward,
    cumulative,
    draw,
    draw_from_rows,
    environment_policy,
    explicit_game,
    observed_reward,
    initial_distribution,
    take,
    uniform_rows,
)
from jaxltl.algos.common.settings import COUNT, Number, RunState, static, traced
from jaxltl.core import struct
from jaxltl.core.graphs.end_components import bottom_components
from jaxltl.core.models import Game, restrict
from jaxltl.core.models.ops.operators import action_argmax, sample_successor
from jaxltl.core.models.protocols import Array, Key, Model, Numeric
from jaxltl.core.types import require_shape
from jaxltl.core.validation import Range, choice


@struct.dataclass
class Problem:
    """A game with rewards that the learner observes only along its transitions.

    Attributes:
      game: on an explicit MDP, such as ``restrict`` returns.
      reward: ``float[S, A]`` or ``float[S, A, K]``.
      allowed: ``bool[S, A]``: the mask at the system's states, all actions at the environment's.
      behavior: ``float[S, A]``, the exploring policy of both players.
      initial: ``float[S]``, distribution over the chains' initial states.
      exact: ``float[S]``, the minimax value, to measure the error; or None.
      measured: ``bool[S]``, the states over which the error is measured; None with `exact`.
      behavior_table: ``uint32[S, A]``, `behavior` as cumulative weights.
      initial_table: ``uint32[S]``, `initial` as cumulative weights.
      method: ``"generalized"`` or ``"maximin"``; static.
    """

    game: Game
    reward: jax.Array
    allowed: jax.Array
    behavior: jax.Array
    initial: jax.Array
    exact: Array
    measured: Array
    behavior_table: jax.Array
    initial_table: jax.Array
    method: str = struct.field(pytree_node=False, default="generalized")

    @property
    def is_maximin(self) -> bool:
        """True if the table has an entry for each answer of the environment."""
        return self.method == "maximin"


def make_problem(
    game: Model,
    reward: ArrayLike,
    *,
    allowed: ArrayLike | None = None,
    environment: ArrayLike | None = None,
    initial: ArrayLike | None = None,
    method: Literal["generalized", "maximin"] = "generalized",
) -> Problem:
    """A checked :class:`Problem`.

    Args:
      game: a Game on an explicit MDP, or an MDP, in which the system always moves.
      reward: ``float[S, A]`` or ``float[S, A, K]``, of the actions of both players.
      allowed: ``bool[S, A]``, such as a permissive strategy's mask; default the available
        actions. Read at the system's states only.
      environment: ``float[S, A]``, exploring policy of the environment; default uniform. It should
        try every action, because the learned value is a minimum over all of them.
      initial: ``float[S]``, distribution of the chains' initial states; default the game's.
      method: ``"generalized"`` or ``"maximin"``.

    Raises:
      ValueError: a wrong shape, a reward that is not finite, a mask that allows an unavailable
        action or none in a reachable state, rows or an initial distribution that are no distributions, or a game
        that does not fit the method.
    """
    choice("method", method, ("generalized", "maximin"))
    game = explicit_game(game)
    system, mask = np.asarray(game.system), _mask(game, allowed)
    initial = initial_distribution(game, initial)
    reachable = np.asarray(restrict(game, initial, allowed=mask).base_state)
    if method == "maximin":
        _check_alternating(game, reachable)
    behavior = (
        uniform_rows(mask) if environment is None else environment_policy(mask, system, environment)
    )
    return Problem(
        game=game,
        reward=check_reward(game, reward),
        allowed=jnp.asarray(mask),
        behavior=jnp.asarray(behavior, game.dtype),
        initial=jnp.asarray(initial, game.dtype),
        exact=None,
        measured=None,
        behavior_table=jnp.asarray(cumulative(behavior)),
        initial_table=jnp.asarray(cumulative(initial)),
        method=method,
    )


def with_exact_value(
    problem: Problem, exact: ArrayLike, measured: ArrayLike | None = None
) -> Problem:
    """The `problem` with its known value `exact`, ``float[S]``, for ``Metrics.error``.

    `measured`, ``bool[S]``, are the states of the error, such as :func:`recurrent_states`; default all
    with an allowed action (with maximin: of the system).
    """
    exact = jnp.asarray(exact, problem.game.dtype)
    if measured is None:
        measured = problem.allowed.any(-1) & (problem.game.system | (not problem.is_maximin))
    measured = jnp.asarray(measured, bool)
    for name, array in (("exact", exact), ("measured", measured)):
        require_shape(name, array, problem.initial.shape)
    return replace(problem, exact=exact, measured=measured)


def recurrent_states(problem: Problem) -> jax.Array:
    """The states of bottom strongly connected components under the exploring policy: ``bool[S]``.

    Chains of the `problem` without restarts and greedy moves visit exactly these infinitely often.
    """
    part = restrict(problem.game, problem.initial, allowed=problem.behavior > 0)
    inside = bottom_components(part.model, part.model.available).inside.any(-1)
    recurrent = np.zeros(problem.game.num_states, bool)
    recurrent[np.asarray(part.base_state)[np.asarray(inside)]] = True
    return jnp.asarray(recurrent)


def _mask(game: Game, allowed: ArrayLike | None) -> NDArray[np.bool_]:
    """Actions of both players: allowed ones of the system, available ones of the environment."""
    system, available = np.asarray(game.system)[:, None], np.asarray(game.available)
    if allowed is None:
        return available
    mask = np.asarray(allowed)
    require_shape("allowed", mask, available.shape)
    if mask.dtype != bool:
        raise ValueError(f"allowed has dtype {mask.dtype}; it must be bool.")
    wrong = np.argwhere(mask & ~available & system)
    if wrong.size:
        s, a = wrong[0]
        raise ValueError(f"allowed: state {s} has no action {a}; allow available actions only.")
    return np.where(system, mask, available)


def _check_alternating(game: Game, reachable: NDArray[np.integer]) -> None:
    """Raises ValueError unless turns alternate and the system's actions are deterministic."""
    system = np.asarray(game.system)
    used = np.asarray(game.mdp.probability) > 0
    same = used & (system[np.asarray(game.mdp.successor)] == system[:, None, None])
    random = (used.sum(-1) > 1) & system[:, None]
    for wrong, requirement, reason in (
        (same, "strictly alternating turns", "leads to a state of the same player"),
        (random, "system actions with one successor", "has several"),
    ):
        place = np.argwhere(wrong[reachable])
        if place.size:
            raise ValueError(
                f"method='maximin' needs {requirement}, but in state {reachable[place[0][0]]} "
                f"action {place[0][1]} {reason}; use method='generalized'."
            )


MAX_VISITS = 2**30  # counted; a step adds at most as many again
_UNROLLED = 16  # actions up to which a maximum over them is unrolled, several times faster


@struct.dataclass
class Hparams:
    """Settings; numbers are traced, None is static.

    Attributes:
      discount: in [0, 1).
      step_size: alpha in (0, 1]; None: 1, for deterministic games; default None.
      step_power: omega in (1/2, 1]: the n-th visit of an entry has the step size
        ``alpha / n ** omega`` (Even-Dar and Mansour 2003). None: constant alpha; default None.
      epsilon, environment_epsilon: the system, or an adversarial environment, is greedy with probability
        ``1 - epsilon``; None: never; default None.
      epsilon_decay, epsilon_min: factor per step and lower bound of both; default 1.0 and 0.0.
      restart: probability that a chain restarts at the beginning of a step; default 0.0.
      initial_value: of every entry. Untried answers of the environment count. Default 0.0.
      per: discounted moves, ``"system_move"`` or ``"move"``; static; default ``"system_move"``.
      num_chains, moves_per_step: parallel chains, and moves of each in a step; static;
        default 1024 and 64.
    """

    discount: Number = traced("discount")
    step_size: Number | None = traced(Range(0, 1, open_below=True), default=None)
    step_power: Number | None = traced(Range(0.5, 1, open_below=True), default=None)
    epsilon: Number | None = traced(Range(0, 1), default=None)
    environment_epsilon: Number | None = traced(Range(0, 1), default=None)
    epsilon_decay: Number = traced(Range(0, 1), default=1.0)
    epsilon_min: Number = traced(Range(0, 1), default=0.0)
    restart: Number = traced(Range(0, 1), default=0.0)
    initial_value: Number = traced(Range(open_below=True, open_above=True), default=0.0)
    per: str = static(("system_move", "move"), default="system_move")
    num_chains: int = static(COUNT, default=1024)
    moves_per_step: int = static(COUNT, default=64)


@struct.dataclass
class State(RunState):
    """The table, and the chains that update it.

    Attributes:
      q: ``float[S, A]``, or ``float[S, A, A]`` over the system's states, actions and answers;
        minus infinity where the system and plus infinity where the environment has no allowed
        action, the neutral elements of maxima and minima.
      visits: ``int32`` like `q`, updates of each entry, counted up to 2^30.
      value: ``float[S]``, of `q`.
      residual: ``float[]``, largest change of `value` in the last step.
      violations: ``int32[]``, actions outside of the mask that were taken: zero.
      position: ``int32[num_chains]``, states of the chains.
      pending: ``int32[num_chains]``, the system's pair ``s * A + a`` that awaits its answer, or
        -1; None unless the method is maximin.
      pending_reward: ``float[num_chains]``, the reward of that pair; None likewise.
    """

    q: jax.Array
    visits: jax.Array
    value: jax.Array
    residual: jax.Array
    violations: jax.Array
    position: jax.Array
    pending: Array
    pending_reward: Array


@struct.dataclass
class Metrics:
    """Figures after a step; scalars, of a run ``[T]``.

    Attributes:
      residual: largest change of the value in the step.
      moves, visited: of all chains since the beginning, as a float; distinct updated entries.
      violations: actions outside of the mask that were taken.
      error: largest error over the measured states; NaN if the value is unknown.
      status: NONFINITE if a value is not finite, else COMPLETED, which does not certify the value;
        see :func:`value_is_stable`.
    """

    residual: jax.Array
    moves: jax.Array
    visited: jax.Array
    violations: jax.Array
    error: jax.Array
    status: jax.Array


# --- the learner ----------------------------------------------------------------------------


@jax.jit
def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """A table of ``hparams.initial_value``, and chains at initial states."""
    _check(problem, hparams)
    dtype, is_system, num_chains = problem.game.dtype, problem.game.system, hparams.num_chains
    legal, neutral = problem.allowed, jnp.where(is_system, -jnp.inf, jnp.inf)[:, None]
    if problem.is_maximin:
        legal = _answers(problem)
        neutral = jnp.where(problem.allowed & is_system[:, None], jnp.inf, -jnp.inf)[..., None]
    q = jnp.where(legal, jnp.asarray(hparams.initial_value, dtype), neutral.astype(dtype))
    words = jax.random.bits(learner.init_key(key), (num_chains,), jnp.uint32)
    return State(
        key=key,
        step=jnp.int32(0),
        q=q,
        visits=jnp.zeros(q.shape, jnp.int32),
        value=value(q, problem),
        residual=jnp.asarray(jnp.inf, dtype),
        violations=jnp.int32(0),
        position=draw(problem.initial_table, words),
        pending=jnp.full(num_chains, -1, jnp.int32) if problem.is_maximin else None,
        pending_reward=jnp.zeros(num_chains, dtype) if problem.is_maximin else None,
    )


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """``moves_per_step`` moves of every chain, each followed by an update of the table.

    All chains read the table, then all write. If m of them update one entry, they share the step
    size a of its next visit, which equals m updates in sequence with the mean of their targets:
    ``Q <- (1 - a)^m Q + (1 - (1 - a)^m) mean``.
    """
    _check(problem, hparams)
    restart_key, action_key, successor_key = (
        jax.random.fold_in(learner.step_key(state), i) for i in range(3)
    )
    state = _restart(restart_key, state, problem, hparams)
    stream = splitmix.streams(action_key, (hparams.num_chains,))

    def move(chains: State, i: jax.Array) -> tuple[State, None]:
        key = jax.random.fold_in(successor_key, i)
        return _move(chains, i, problem, hparams, (stream, key)), None

    flat = replace(state, q=state.q.ravel(), visits=state.visits.ravel())
    count = jnp.arange(hparams.moves_per_step, dtype=jnp.uint32)
    flat, _ = lax.scan(move, flat, count)
    q = flat.q.reshape(state.q.shape)
    updated = value(q, problem)
    after = replace(
        flat,
        step=state.step + 1,
        q=q,
        visits=jnp.minimum(flat.visits, MAX_VISITS).reshape(q.shape),
        value=updated,
        residual=jnp.max(jnp.abs(updated - state.value)),
        violations=jnp.minimum(flat.violations, MAX_VISITS),
    )
    return after, measure(after, problem, hparams)


init, step, run, train, run_until, train_until = learner.bind(_init, _step)


def measure(state: State, problem: Problem, hparams: Hparams) -> Metrics:
    """The :class:`Metrics` of a `state`."""
    dtype = problem.game.dtype
    error, known = jnp.asarray(jnp.nan, dtype), state.visits > 0  # entries of others are infinite
    finite = jnp.all(jnp.isfinite(state.value)) & jnp.all(jnp.isfinite(state.q) | ~known)
    if problem.exact is not None:
        error = jnp.max(jnp.where(problem.measured, jnp.abs(state.value - problem.exact), 0))
    return Metrics(
        residual=state.residual,
        moves=state.step.astype(dtype) * (hparams.num_chains * hparams.moves_per_step),
        visited=jnp.sum(state.visits > 0, dtype=jnp.int32),
        violations=state.violations,
        error=error,
        status=learner.completion_status(finite, finite),
    )


def value_is_stable(tolerance: Numeric) -> loops.Until:
    """A condition for ``run_until``: no value changed by more than `tolerance`, no entry is new.

    Evidence of convergence, not a proof; a longer window ``check_every`` gives better evidence.
    """
    return Partial(_value_is_stable, tolerance)


def _value_is_stable(
    tolerance: Numeric, before: State, after: State, metrics: Metrics
) -> jax.Array:
    change = jnp.max(jnp.abs(after.value - before.value))
    new = jnp.any((before.visits == 0) & (after.visits > 0))
    return ((change <= tolerance) & ~new) | jnp.isnan(change)  # a run of NaN ends: NONFINITE


def value(q: jax.Array, problem: Problem) -> jax.Array:
    """The value ``float[S]`` by a table `q` of a `problem`.

    Zero where no action is allowed, and with maximin at the environment's states.
    """
    return _state_values(q, problem.game.system)


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The greedy action of each player, ``int32[S]``; 0 where no action is allowed.

    With maximin, action 0 of the environment's states stands for no answer: the best one, the
    minimum of ``state.q[s, a]``, depends on the system's action.
    """
    sign = jnp.where(problem.game.system, 1, -1)[:, None]
    return action_argmax(sign * _action_values(state.q), problem.allowed)[1]


# --- one move of all chains -------------------------------------------------------------------


def _move(
    state: State,
    i: jax.Array,
    problem: Problem,
    hparams: Hparams,
    chance: tuple[splitmix.Stream, Key],
) -> State:
    """The i-th move of every chain, and the update of the table, which is flat here."""
    game, source, num_actions = problem.game, state.position, problem.game.num_actions
    stream, key = chance
    is_system = take(game.system, source)
    action = _choose(state, is_system, i, problem, hparams, stream)
    pair = source * num_actions + action
    target = _sample(game, key, source, action)
    reward = observed_reward(game, problem.reward, source, action, target)
    discount = jnp.asarray(hparams.discount, state.q.dtype)
    environment_discount = discount if hparams.per == "move" else jnp.ones_like(discount)
    tail = (num_actions, num_actions) if problem.is_maximin else (num_actions,)
    ahead = _state_values(take(state.q.reshape(-1, *tail), target), take(game.system, target))
    entry, pending, pending_reward = pair, None, None
    if problem.is_maximin:
        answered = ~is_system & (state.pending >= 0)
        # Only an answer completes an entry; others are out of bounds and dropped.
        entry = jnp.where(answered, state.pending * num_actions + action, state.q.size)
        goal = state.pending_reward + discount * (reward + environment_discount * ahead)
        pending, pending_reward = jnp.where(is_system, pair, -1), jnp.where(is_system, reward, 0)
    else:
        goal = reward + jnp.where(is_system, discount, environment_discount) * ahead
    q, visits = _update(state, entry, goal, hparams)
    forbidden = jnp.sum(~take(problem.allowed.ravel(), pair), dtype=jnp.int32)
    return replace(
        state,
        q=q,
        visits=visits,
        violations=state.violations + forbidden,
        position=target,
        pending=pending,
        pending_reward=pending_reward,
    )


def _update(
    state: State, entry: jax.Array, goal: jax.Array, hparams: Hparams
) -> tuple[jax.Array, jax.Array]:
    """The flat table and its visits after all chains have written."""
    q, visits = state.q, state.visits
    if hparams.step_size is None:
        # In a deterministic game all chains at one entry have the same target.
        return q.at[entry].set(goal, mode="drop"), visits.at[entry].add(1, mode="drop")
    inside = jnp.minimum(entry, q.size - 1)
    before, old = take(visits, inside), take(q, inside)
    visits = visits.at[entry].add(1, mode="drop")
    together = (take(visits, inside) - before).astype(q.dtype)
    size = jnp.asarray(hparams.step_size, q.dtype)
    if hparams.step_power is not None:
        size = size * (1 + before.astype(q.dtype)) ** -jnp.asarray(hparams.step_power, q.dtype)
    share = (1 - (1 - size) ** together) / together
    return q.at[entry].add(share * (goal - old), mode="drop"), visits


def _choose(
    state: State,
    is_system: jax.Array,
    i: jax.Array,
    problem: Problem,
    hparams: Hparams,
    stream: splitmix.Stream,
) -> jax.Array:
    """Each chain's action: greedy with the probability of its player, else by behavior."""
    words = splitmix.words(stream, 2 * i)
    action = draw_from_rows(problem.behavior_table, state.position, words)
    epsilons = [hparams.epsilon, hparams.environment_epsilon]
    if epsilons == [None, None]:
        return action
    best, known = _greedy(state, is_system, problem)
    drawn = splitmix.uniform(splitmix.words(stream, 2 * i + 1), state.q.dtype)
    decay = jnp.asarray(hparams.epsilon_decay) ** state.step
    mine, theirs = (
        jnp.inf if e is None else jnp.maximum(e * decay, hparams.epsilon_min) for e in epsilons
    )
    return jnp.where(known & (drawn >= jnp.where(is_system, mine, theirs)), best, action)


def _greedy(state: State, is_system: jax.Array, problem: Problem) -> tuple[jax.Array, jax.Array]:
    """Each chain's greedy action, and whether the table determines one."""
    num_actions = problem.game.num_actions
    rows, known = state.q.reshape(-1, num_actions), jnp.ones(is_system.shape, bool)
    if problem.is_maximin:
        mine = take(state.q.reshape(-1, num_actions, num_actions), state.position).min(-1)
        row = jnp.where(is_system[:, None], mine, take(rows, jnp.maximum(state.pending, 0)))
        known = is_system | (state.pending >= 0)
    else:
        row = take(rows, state.position)
    return action_argmax(jnp.where(is_system[:, None], row, -row), jnp.bool_(True))[1], known


def _state_values(rows: jax.Array, is_system: jax.Array) -> jax.Array:
    """Values of states with rows ``[..., A]`` or ``[..., A, A]``; signs are faster than two reductions."""
    sign = 2 * is_system.astype(rows.dtype) - 1
    value = sign * _reduce(jnp.maximum, sign[..., None] * _action_values(rows))
    return jnp.where(jnp.isinf(value), 0, value)


def _action_values(q: jax.Array) -> jax.Array:
    """Values ``float[S, A]`` of actions: with maximin, by the worst answer."""
    return _reduce(jnp.minimum, q) if q.ndim == 3 else q


def _reduce(function: Any, x: jax.Array) -> jax.Array:
    """A reduction over the last axis, unrolled if that is short."""
    if x.shape[-1] > _UNROLLED:
        return function.reduce(x, axis=-1)
    result = x[..., 0]
    for i in range(1, x.shape[-1]):
        result = function(result, x[..., i])
    return result


def _sample(game: Game, key: jax.Array, state: jax.Array, action: jax.Array) -> jax.Array:
    """Successors of all chains; a deterministic game needs no keys."""
    if game.num_successors == 1:
        return jax.vmap(sample_successor, (None, None, 0, 0))(game, key, state, action)
    keys = jax.random.split(key, state.shape[0])
    return jax.vmap(sample_successor, (None, 0, 0, 0))(game, keys, state, action)


def _restart(key: jax.Array, state: State, problem: Problem, hparams: Hparams) -> State:
    """Chains restart with probability ``restart``, and drop their pending action."""
    words = jax.random.bits(key, (2, hparams.num_chains), jnp.uint32)
    anew = splitmix.uniform(words[0], state.value.dtype) < hparams.restart
    position = jnp.where(anew, draw(problem.initial_table, words[1]), state.position)
    pending = None if state.pending is None else jnp.where(anew, -1, state.pending)
    return replace(state, position=position, pending=pending)


def _answers(problem: Problem) -> jax.Array:
    """The environment's answers to each action of the system: ``bool[S, A, A]``."""
    mdp = problem.game.mdp
    k = jnp.argmax(mdp.probability, axis=-1)[..., None]
    between = jnp.take_along_axis(mdp.successor, k, axis=-1)[..., 0]
    return (problem.allowed & problem.game.system[:, None])[..., None] & problem.allowed[between]


def _check(problem: Problem, hparams: Hparams) -> None:
    """Raises ValueError for static settings that are out of range or do not fit the game."""
    chains, moves = hparams.num_chains, hparams.moves_per_step
    if chains * moves > MAX_VISITS:
        raise ValueError(
            f"num_chains={chains} times moves_per_step={moves} is more than {MAX_VISITS} moves; "
            "make them in several steps."
        )
    if hparams.step_size is None and problem.game.num_successors > 1:
        raise ValueError(
            "step_size=None is for deterministic games (one successor for each action); give a "
            "number, and a step_power to converge."
        )
    if hparams.step_size is None and hparams.step_power is not None:
        raise ValueError("step_power needs a step_size to start from; give step_size=1.0.")
