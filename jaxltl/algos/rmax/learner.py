"""PAC learning inside the almost-sure winning region (dissertation, chapter 6, algorithm 5).

The graph of a stochastic game is known, its probabilities and rewards are not. The learner
stays in the almost-surely winning region and at every moment plays a strategy that wins
almost surely: with a small probability any move of the region, else a move that is near-optimal
in an optimistic model (Brafman and Tennenholtz 2002). A pair of a state and a move becomes
known after enough visits; then its frequencies and observed rewards enter the model, and the
model is solved anew, from the last values.

The true game is touched through ``sample_successor`` and the rewards of the transitions made
only. Shapes are written for the S states of ``problem.game``; states outside the region stay
where they are and are never entered.

Example: to come home again and again, and to be paid for staying away.

  >>> import jax
  >>> import jaxltl as jl
  >>> from jaxltl.algos import rmax
  >>> world = jl.from_dense([[[1.0, 0], [0, 1.0]], [[1.0, 0], [1.0, 0]]],
  ...                       label=[[0], [1]], propositions=["home"], initial=[1, 0])
  >>> problem = rmax.make_problem(world, "G F home", [[1.0, 0.0], [0.0, 0.0]])
  >>> hparams = rmax.Hparams(discount=0.5, reward_bound=1.0, epsilon=0.1)
  >>> learned = rmax.train_until(jax.random.key(0), problem, hparams, num_steps=10_000,
  ...                            until=rmax.strategy_rests(1000))
  >>> learned.metrics.num_known.item(), rmax.policy(learned.state, problem, hparams).shape
  (4, (2, 2))
  >>> sure = rmax.evidence(learned.state, problem, hparams)
  >>> bool(sure.almost_sure), sure.epsilon_optimal.all().tolist()
  (True, True)
  >>> rmax.wins_almost_surely(problem, sure.strategy).item()
  True

A run is made of steps, goes on from a state, and may take its moves from elsewhere:

  >>> state = rmax.init(jax.random.key(0), problem, hparams)  # rmax.train goes on with rmax.run
  >>> seen = rmax.observe(  # a step of one's own; run_until goes on from any state
  ...     state, problem, hparams, action=1, successor=1, reward=0.0)
  >>> seen.position.item(), rmax.measure(seen, problem, hparams).moves.item()
  (1, 1)

Many seeds are ``jax.vmap(lambda key: train(key, problem, hparams, num_steps=...))(keys)``.
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
from jax.tree_util import Partial

from jaxltl.algos.common import learner, pac, splitmix
from jaxltl.algos.common.play import (
    check_distributions,
    cumulative,
    draw,
)
from jaxltl.algos.rmax._data_evidence import DataEvidence, data_evidence
from jaxltl.algos.rmax._joint_game import (
    environment_rows,
    joint_game,
    merge_successors,
    require_start,
    shaped_reward,
)
from jaxltl.algos.rmax._optimistic_model import (
    enough,
    exploration,
    solver_tolerance,
    unknown_reward,
    updated,
)
from jaxltl.algos.rmax._walk import Rules, Seen, marks, move, note_last, record, walk_from
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.games.objective import Parity, buchi
from jaxltl.core.games.winning import solve
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.models.construct.restrict import restrict
from jaxltl.core.models.game import Game, as_padded_game
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.ops.operators import forall_successor
from jaxltl.core.pretty_print import brief, history
from jaxltl.core.types import Solution, Status, require_shape, status_code
from jaxltl.core.values.discounted.minimax import minimax_value, strategy_value

__all__ = [
    "UPDATES",
    "Evidence",
    "Hparams",
    "Metrics",
    "Problem",
    "State",
    "evidence",
    "init",
    "make_problem",
    "measure",
    "observe",
    "policy",
    "run",
    "run_until",
    "step",
    "strategy_rests",
    "train",
    "train_until",
    "wins_almost_surely",
]

UPDATES = ("every", "printed")


@brief
@struct.dataclass
class Problem:
    """A game with a task and a reward; made by :func:`make_problem`.

    Attributes:
      game: the explicit game that is played; equal successors of a move are merged.
      reward: ``float[S, A]`` or ``[S, A, K]``, seen one transition at a time.
      accepting: ``bool[S]``, to be met infinitely often.
      region: ``bool[S]``, from where the system wins almost surely.
      allowed: ``bool[S, A]``, the moves that surely stay in the region; none outside.
      environment: ``float[S, A]``, how the environment plays.
      start: ``float[S]``, where runs start; `start_table` the same for drawing.
      base_state, memory: ``int32[S]``, which state of the given game with which state of the
        task's automaton each state is.
    """

    game: Game
    reward: jax.Array
    accepting: jax.Array
    region: jax.Array
    allowed: jax.Array
    environment: jax.Array
    start: jax.Array
    start_table: jax.Array
    base_state: jax.Array
    memory: jax.Array


@brief
@struct.dataclass
class Hparams:
    """What is asked for, and how to learn. Numbers are traced; None is static.

    Attributes:
      discount: in (0, 1), paid by every move.
      reward_bound: R_max; rewards lie in [0, R_max].
      epsilon: how far from optimal the strategy may end.
      failure: delta_c, the probability with which it may end further; default 0.1.
      known_after: visits after which a pair of several successors is known. None: the K of
        the theorem, which is out of reach for all but toys; with a number the theorem's
        guarantee is void, and what remains is the evidence of :func:`evidence`. Default None.
      restart: the probability with which a run starts anew before a move; default 0.0.
      update: ``"every"`` observed reward enters the model; ``"printed"``: as algorithm 5 has it
        in line 16, only that of a pair's last successor before it is known, which is wrong
        where a move has several successors; static; default ``"every"``.
      moves_per_step: a step ends when something new is known, or after this many moves; static;
        default 128.
    """

    discount: jax.Array | float
    reward_bound: jax.Array | float
    epsilon: jax.Array | float
    failure: jax.Array | float = 0.1
    known_after: jax.Array | int | None = None
    restart: jax.Array | float = 0.0
    update: str = struct.field(pytree_node=False, default="every")
    moves_per_step: int = struct.field(pytree_node=False, default=128)


@brief
@struct.dataclass
class State:
    """What has been seen, and what is made of it.

    Attributes:
      key: of the whole run.
      step: ``int32[]``, steps made.
      moves: ``int32[]``, moves made; with 2^31 - 1 of them a run is over, and steps make no more.
      position: ``int32[]``, the state of the game.
      counts: ``int32[S, A, K]``, how often each transition was seen; in a game without chance,
        whether it was.
      reward: ``float[S, A, K]``, the rewards seen; ``R_max / (1 - discount)`` at others.
      known_at: ``int32[S, A]``, the number of moves after which a pair was known; -1 before.
      num_known: ``int32[]``, the pairs that are.
      probability, gain: ``float[S, A, K]`` and ``[S, A]``, transitions and expected rewards of
        the optimistic model.
      value: ``float[S]``, its value.
      best: ``bool[S, A]``, the moves that the strategy prefers.
      error: ``float[]``, how far `value` may be from the model's, up to a constant.
      last_update: ``int32[]``, the number of moves after which the strategy was last computed.
      num_updates: ``int32[]``, how often it was.
      always_almost_sure: ``bool[]``, whether every strategy so far made each move of the region
        with positive probability, so that it wins almost surely (lemma 6).
      fault: ``int32[]``, the first pair ``s * A + a`` with a reward outside [0, R_max]; -1 if there
        is none.
    """

    key: jax.Array
    step: jax.Array
    moves: jax.Array
    position: jax.Array
    counts: jax.Array
    reward: jax.Array
    known_at: jax.Array
    num_known: jax.Array
    probability: jax.Array
    gain: jax.Array
    value: jax.Array
    best: jax.Array
    error: jax.Array
    last_update: jax.Array
    num_updates: jax.Array
    always_almost_sure: jax.Array
    fault: jax.Array


@brief(facts=partial(history, codes={"status": Status}))
@struct.dataclass
class Metrics:
    """Figures after a step; scalars, of a run ``[T]``.

    Attributes:
      moves, num_known, last_update, num_updates: so far.
      value: of the optimistic model at the start.
      always_almost_sure, fault: see :class:`State`.
      residual: ``state.error``.
      status: of the last solve of the optimistic model; MAX_STEPS if it could not be solved, or if
        all moves that can be counted have been made.
    """

    moves: jax.Array
    num_known: jax.Array
    last_update: jax.Array
    num_updates: jax.Array
    value: jax.Array
    always_almost_sure: jax.Array
    fault: jax.Array
    residual: jax.Array
    status: jax.Array


@brief(codes={"status": Status})
@struct.dataclass
class Evidence:
    """What is known of a learned strategy in the true game; made by :func:`evidence`.

    Attributes:
      strategy: ``float[S, A]``, of the system.
      almost_sure: ``bool[]``, whether it wins almost surely from every state of the region, by the
        graph.
      optimal: the best that any strategy in the region secures.
      worst: what this one secures against every environment.
      met: its value against the environment that was played.
      epsilon_optimal: ``bool[S]``, where `worst` is certified to be within epsilon of `optimal`.
      epsilon_optimal_met: the same for `met`, which is what theorem 6 promises: moves that the
        environment never makes stay unknown, so that `worst` can stay low.
      reachable: ``bool[S]``, the states of the region that can be reached from the start.
      known_at: ``int32[S, A]``, see :class:`State`.
      data: what the counts guarantee of the strategy, by themselves, if that was asked for.
    """

    strategy: jax.Array
    almost_sure: jax.Array
    optimal: Solution
    worst: Solution
    met: Solution
    epsilon_optimal: jax.Array
    epsilon_optimal_met: jax.Array
    reachable: jax.Array
    known_at: jax.Array
    data: DataEvidence | None = None


# --- problems, on the host ------------------------------------------------------------------


def make_problem(
    game: Any,
    spec: chex.Array | Parity | Automaton | Formula | str,
    reward: chex.Array,
    *,
    environment: chex.Array | str = "random",
    discount: float | None = None,
    start: chex.Array | None = None,
) -> Problem:
    """A checked :class:`Problem`: the task's automaton beside the game, and the region.

    Args:
      game: a Game, or an MDP, in which the system always moves.
      spec: states ``bool[S]`` or an objective to be met infinitely often; or a formula or an
        automaton, which is put beside the game (read when a state is left). It has to be
        a deterministic Buchi condition, or weaker.
      reward: ``float[S, A]`` or ``float[S, A, K]`` on the given game; both players' moves count.
      environment: ``"random"``; ``"adversarial"``: optimal against an optimal system, which
        takes the `discount`; or a policy ``int32[S]`` or ``float[S, A]`` on the given game.
      discount: for the adversarial environment only.
      start: ``float[S]``, on the given game; default its initial distribution.

    Returns:
      The problem. Of a game with an automaton beside it only states that can be reached are kept.

    Raises:
      ValueError: a wrong shape; an environment or a start that is no distribution; a reward
        that is not finite; a task that is no Buchi condition; or a start outside the region.

    Example:
      >>> from jaxltl import from_dense
      >>> world = from_dense([[[1.0, 0], [0, 1.0]], [[1.0, 0], [1.0, 0]]],
      ...                    label=[[0], [1]], propositions=["home"], initial=[1, 0])
      >>> problem = make_problem(world, "G F home", [[1.0, 0.0], [0.0, 0.0]])
      >>> problem.region.tolist()
      [True, True]
    """
    game = as_padded_game(game)
    reward = shaped_reward(game, reward)
    start = np.asarray(game.initial if start is None else start, float)
    require_shape("start", start, (game.num_states,))
    check_distributions("start", start[None], np.ones((1, game.num_states), bool))
    played, accepting, origin = joint_game(game, spec, start)
    base, memory = origin
    played, reward = merge_successors(played, reward[base])
    accepting = to_jax(np.asarray(accepting))
    objective = buchi(played, accepting)
    region = solve(played, objective).region
    require_start(played, region, base, memory)
    allowed = _allowed(played, region)
    rows = environment_rows(game, base, played, reward, allowed, environment, discount)
    return Problem(
        game=played,
        reward=reward,
        accepting=accepting,
        region=region,
        allowed=allowed,
        environment=to_jax(np.asarray(rows, played.dtype)),
        start=played.initial,
        start_table=to_jax(np.asarray(cumulative(np.asarray(played.initial, float)))),
        base_state=to_jax(np.asarray(base, np.int32)),
        memory=to_jax(np.asarray(memory, np.int32)),
    )


@jax.jit
def _allowed(game: Game, region: jax.Array) -> jax.Array:
    """Moves that stay in the region: of the system those that do for sure."""
    closed = game.available & region[:, None]
    return closed & (~game.system[:, None] | forall_successor(game, region))


# --- the learner ----------------------------------------------------------------------------


@jax.jit
def init(key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
    """Nothing known: every unknown move is taken to pay ``R_max / (1 - discount)`` for ever.

    Args:
      key: a PRNG key, which the state keeps; ``vmap`` over keys for many seeds.
      problem: of :func:`make_problem`.
      hparams: :class:`Hparams`.

    Returns:
      :class:`State`, no step made.

    Raises:
      ValueError: an unknown `update`, or steps without moves.
    """
    _check(hparams)
    game, shape = problem.game, problem.game.mdp.probability.shape
    listed = game.mdp.probability > 0
    bound = jnp.asarray(unknown_reward(hparams), game.dtype)
    gain = jnp.where(problem.allowed, bound, 0)
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
        gain=gain,
        value=value.astype(game.dtype),
        best=problem.allowed & game.system[:, None],
        error=jnp.zeros((), game.dtype),
        last_update=jnp.int32(0),
        num_updates=jnp.int32(0),
        always_almost_sure=jnp.bool_(True),
        fault=jnp.int32(-1),
    )


def step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """Moves until something new is known, at most ``moves_per_step``, and then the new strategy.

    Under ``vmap`` every lane goes on to its next update, and then one solve serves all.

    Args:
      state: of :func:`init` or of an earlier step; unchanged.
      problem, hparams: as of :func:`init`.

    Returns:
      The next :class:`State`, and :class:`Metrics`, figures after the step.
    """
    return _step_if(state, problem, hparams, jnp.bool_(True))


def _step_if(
    state: State, problem: Problem, hparams: Hparams, active: jax.Array
) -> tuple[State, Metrics]:
    """A step, or the same state: its arrays are not copied, which would take longer."""
    _check(hparams)
    moves = jnp.where(active, hparams.moves_per_step, 0)
    moves = jnp.minimum(moves, learner.MOST - state.moves).astype(jnp.int32)
    state = _advance(state, problem, hparams, moves)
    state = replace(state, step=state.step + active)
    return state, measure(state, problem, hparams)


run, train, run_until, train_until = learner.bind(init, step, step_if=_step_if)


def measure(state: State, problem: Problem, hparams: Hparams) -> Metrics:
    """The :class:`Metrics` of a state.

    Args:
      state, problem, hparams: of a run.

    Returns:
      :class:`Metrics`, scalars.
    """
    solved = state.error <= solver_tolerance(problem, hparams)
    status = status_code(solved & (state.moves < learner.MOST), jnp.isfinite(state.error))
    return Metrics(
        moves=state.moves,
        num_known=state.num_known,
        last_update=state.last_update,
        num_updates=state.num_updates,
        value=jnp.sum(problem.start * state.value),
        always_almost_sure=state.always_almost_sure,
        fault=state.fault,
        residual=state.error,
        status=status,
    )


def strategy_rests(moves: chex.Numeric) -> learner.Until:
    """A condition for :func:`run_until`: no update of the strategy for so many moves.

    Args:
      moves: at least 1; traced.

    Returns:
      A condition, for ``until``.
    """
    return Partial(_strategy_rests, moves)


def _strategy_rests(moves: Any, before: State, after: State, metrics: Metrics) -> jax.Array:
    return after.moves - after.last_update >= moves


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The system's strategy, ``float[S, A]``: Remark 4 of section 6.5.2; zero elsewhere.

    Args:
      state: of one run; ``vmap`` over several.
      problem, hparams: of the run.

    Returns:
      ``float[S, A]``, rows that sum to one where the system moves inside the region.
    """
    allowed = problem.allowed & problem.game.system[:, None]
    return pac.hat_strategy(state.best, allowed, exploration(problem, hparams))


def observe(
    state: State,
    problem: Problem,
    hparams: Hparams,
    action: int,
    successor: int,
    reward: float,
) -> State:
    """One move of a world outside, seen by the learner; on the host.

    Whoever moves at ``state.position`` has made it; the system's moves are drawn from
    ``policy(state, problem, hparams)[state.position]``. Where a run starts anew, give the
    place first: ``state.replace(position=jnp.int32(s))``.

    Args:
      state, problem, hparams: of a learner.
      action, successor: what was done, and the state of ``problem.game`` that came.
      reward: what it paid.

    Returns:
      The next :class:`State`.

    Raises:
      ValueError: the move is not allowed there, the successor is not in the graph, or the
        reward lies outside [0, R_max]. The state is then unchanged.
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
        raise ValueError(_outside(s, action, hparams, f"{reward:g}"))
    return _observe(state, problem, hparams, action, successor, reward)


@jax.jit
def _observe(state, problem, hparams, action, successor, reward) -> State:
    walk = walk_from(state, jnp.int32(1))
    seen = Seen(
        state.position,
        jnp.int32(action),
        jnp.int32(successor),
        jnp.asarray(reward, problem.game.dtype),
    )
    rules = _rules(state, problem, hparams)
    walk = note_last(record(walk, seen, rules, jnp.bool_(True)), problem)
    return updated(state, walk, problem, hparams)


def evidence(
    state: State, problem: Problem, hparams: Hparams, *, confidence: float | None = None
) -> Evidence:
    """What the strategy of a state is worth in the true game, certified; on the host.

    One state at a time: of vmapped seeds, ``jax.tree.map(itemgetter(i), states)``. With a
    `confidence` in (0, 1) also what the counts alone guarantee, however few they are.

    Args:
      state, problem, hparams: of one run.
      confidence: of ``Evidence.data``; None leaves it out.

    Returns:
      :class:`Evidence`, with certified bounds.

    Raises:
      ValueError: a reward outside [0, R_max] was observed, which voids every guarantee.
    """
    fault = int(state.fault)
    if fault >= 0:
        s, a = divmod(fault, problem.game.num_actions)
        raise ValueError(_outside(s, a, hparams, f"{float(jnp.max(problem.reward[s, a])):g}"))
    play, game = policy(state, problem, hparams), problem.game
    value = partial(strategy_value, _inside(problem), play, problem.reward, hparams.discount)
    worst, met = value(), value(environment=problem.environment)
    optimal = minimax_value(game, problem.reward, hparams.discount, allowed=problem.allowed)
    near = partial(pac.epsilon_optimal_states, optimal, epsilon=hparams.epsilon)
    reached = restrict(game, problem.start, allowed=problem.allowed).base_state
    return Evidence(
        strategy=play,
        almost_sure=wins_almost_surely(problem, play),
        optimal=optimal,
        worst=worst,
        met=met,
        epsilon_optimal=near(worst) & problem.region,
        epsilon_optimal_met=near(met) & problem.region,
        reachable=jnp.zeros(game.num_states, bool).at[reached].set(True),
        known_at=state.known_at,
        data=None
        if confidence is None
        else data_evidence(
            game,
            problem.allowed,
            problem.region,
            problem.reward,
            state.counts,
            play,
            float(hparams.discount),
            confidence,
        ),
    )


@jax.jit
def wins_almost_surely(problem: Problem, play: jax.Array) -> jax.Array:
    """Whether a memoryless strategy wins almost surely from every state of the region.

    On the graph: it never leaves the region, and from each of its states an accepting one is
    met with positive probability whatever the environment does, and so almost surely again
    and again.

    Args:
      problem: the problem.
      play: ``float[S, A]``; only what is positive counts.

    Returns:
      ``bool[]``.
    """
    game = problem.game
    used = jnp.where(game.system[:, None], play > 0, problem.allowed)
    moves = problem.region & used.any(-1)
    kept = jnp.all(~used | problem.allowed)
    met = attractor(
        game,
        problem.accepting & problem.region,
        used & problem.allowed,
        rule=game.system,
        chance="some",
    ).region
    return kept & jnp.all(moves | ~problem.region) & jnp.all(met | ~problem.region)


def _rules(state: State, problem: Problem, hparams: Hparams) -> Rules:
    dtype, key = problem.game.dtype, learner.step_key(state)
    return Rules(
        problem,
        marks(state.best, state.known_at),
        jax.random.fold_in(key, 1),
        splitmix.streams(jax.random.fold_in(key, 0)),
        exploration(problem, hparams),
        enough(problem, hparams),
        jnp.asarray(hparams.reward_bound, dtype),
        jnp.asarray(hparams.restart, dtype),
        jnp.bool_(hparams.update == "every"),
    )


def _advance(state: State, problem: Problem, hparams: Hparams, moves: jax.Array) -> State:
    """At most so many moves, and the update that they lead to; none of them if that is zero."""
    rules = _rules(state, problem, hparams)
    walk = learner.while_active(lambda w, _: w.left > 0, move, walk_from(state, moves), rules)
    return updated(state, note_last(walk, problem), problem, hparams)


def _inside(problem: Problem) -> Game:
    """The game in which only moves that stay in the region exist."""
    game = problem.game
    return Game(game.mdp.replace(available=problem.allowed), game.system)


def _outside(s: int, a: int, hparams: Hparams, reward: str) -> str:
    return (
        f"state {s}, action {a}: a reward of {reward} was observed, outside of [0, "
        f"reward_bound={float(hparams.reward_bound):g}]. The guarantee rests on that bound: "
        "give a larger reward_bound and learn anew."
    )


def _check(hparams: Hparams) -> None:
    if hparams.update not in UPDATES:
        raise ValueError(f'update={hparams.update!r}; choose "every" or "printed".')
    if hparams.moves_per_step < 1:
        raise ValueError(f"moves_per_step={hparams.moves_per_step}; it must be at least 1.")
