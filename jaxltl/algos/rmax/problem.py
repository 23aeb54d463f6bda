"""Problems of R-max (a game, its product with the task, the winning region), settings and state."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.algos.common.explicit_games import (
    check_reward,
    cumulative,
    environment_policy,
    explicit_game,
    initial_distribution,
    uniform_rows,
)
from jaxltl.algos.common.settings import COUNT, Number, RunState, static, traced
from jaxltl.core import struct
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.games.objective import Parity, buchi
from jaxltl.core.games.winning import objective_at, solve, task_game
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.models import Game, forall_successor, restrict
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.protocols import Model
from jaxltl.core.types import require_shape
from jaxltl.core.validation import Range
from jaxltl.core.values.discounted.minimax import minimax_value


@struct.dataclass
class Problem:
    """A game with a Buchi objective and a reward; made by :func:`make_problem`.

    Attributes:
      game: explicit, each successor of an action listed once.
      reward: ``float[S, A]`` or ``[S, A, K]``, observed one transition at a time.
      accepting: ``bool[S]``, to be visited infinitely often.
      region: ``bool[S]``, the almost-sure winning region.
      allowed: ``bool[S, A]``, the actions that surely stay in the region; none outside of it.
      environment: ``float[S, A]``, the policy of the environment.
      initial: ``float[S]``, initial distribution; `initial_table` its cumulative weights.
      base_state, memory: ``int32[S]``, the state of the given game and of the task's automaton.
    """

    game: Game
    reward: jax.Array
    accepting: jax.Array
    region: jax.Array
    allowed: jax.Array
    environment: jax.Array
    initial: jax.Array
    initial_table: jax.Array
    base_state: jax.Array
    memory: jax.Array


def make_problem(
    game: Model,
    formula: ArrayLike | Parity | Automaton | Formula | str,
    reward: ArrayLike,
    *,
    environment: ArrayLike | str = "random",
    discount: float | None = None,
    initial: ArrayLike | None = None,
) -> Problem:
    """A checked :class:`Problem`: the reachable product with the task's automaton, and its winning region.

    Args:
      game: a Game, or an MDP, in which the system always moves.
      formula: accepting states ``bool[S]``, an objective, or a formula or automaton; its product with
        the game reads labels on exit. A deterministic Buchi condition or weaker.
      reward: ``float[S, A]`` or ``float[S, A, K]`` on the given game, for actions of both players.
      environment: ``"random"``; ``"adversarial"``: optimal against an optimal system, by the
        `discount`; or a policy ``int32[S]`` or ``float[S, A]`` on the given game.
      discount: of the adversarial environment only.
      initial: ``float[S]``, on the given game; default its initial distribution.

    Raises:
      ValueError: a wrong shape, a policy or initial distribution that is no distribution, a reward that is not
        finite, a task that is no Buchi condition, or an initial state outside of the region.
    """
    game = explicit_game(game)
    reward = np.asarray(reward, float)
    shape = game.mdp.probability.shape
    require_shape("reward", reward, shape if reward.ndim == 3 else shape[:2])
    joint, accepting, base_state, memory = _joint_game(
        game, formula, initial_distribution(game, initial)
    )
    played = _merge_successors(joint)
    observed = check_reward(joint, reward[base_state])
    accepting = to_jax(accepting)
    region = solve(played, buchi(played, accepting)).region
    _require_start_in(region, joint, base_state, memory)
    problem = Problem(
        game=played,
        reward=observed,
        accepting=accepting,
        region=region,
        allowed=_safe_actions(played, region),
        environment=jnp.zeros(()),
        initial=played.initial,
        initial_table=to_jax(cumulative(np.asarray(played.initial, float))),
        base_state=to_jax(base_state.astype(np.int32)),
        memory=to_jax(memory.astype(np.int32)),
    )
    rows = _environment_rows(problem, game, environment, discount)
    return replace(problem, environment=to_jax(np.asarray(rows, played.dtype)))


def _joint_game(
    game: Game,
    formula: ArrayLike | Parity | Automaton | Formula | str,
    initial: NDArray[np.float64],
) -> tuple[Game, NDArray[np.bool_], NDArray[np.integer], NDArray[np.integer]]:
    """The given game, or the reachable part of its product with an automaton.

    With the accepting states, and the game's and the automaton's state of each state.
    """
    game = Game(game.mdp.replace(initial=jnp.asarray(initial, game.dtype)), game.system)
    if isinstance(formula, Automaton | Formula | str):
        joint, objective = task_game(game, formula)
        part = restrict(joint)
        base, memory = np.asarray(part.base_state), np.asarray(part.memory)
        number = jnp.asarray(base * joint.state_shape[1] + memory)
        return part.model, _accepting(objective_at(objective, number)), base, memory
    if isinstance(formula, Parity):
        accepting = _accepting(formula)
    else:
        accepting = np.asarray(formula)
        require_shape("formula", accepting, (game.num_states,))
    base = np.arange(game.num_states)
    return game, accepting.astype(bool), base, np.zeros_like(base)


def _accepting(objective: Parity) -> NDArray[np.bool_]:
    """The accepting states of a Buchi condition: priority 0, or won already."""
    if objective.num_priorities > 2:
        raise ValueError(
            f"the task needs {objective.num_priorities} priorities, and only conditions met by "
            "visiting states infinitely often can be learned; strengthen it, for example to G F."
        )
    won = np.asarray(objective.won)
    return ((np.asarray(objective.priority) == 0) | won) & ~np.asarray(objective.lost)


def _merge_successors(game: Game) -> Game:
    """The game with each successor of an action listed once, as only successors are observed."""
    successor, weight = np.asarray(game.mdp.successor), np.asarray(game.mdp.probability)
    same = (successor[..., :, None] == successor[..., None, :]) & (weight[..., None, :] > 0)
    first = same.argmax(-1) == np.arange(successor.shape[-1])
    merged = np.where(first & (weight > 0), (same * weight[..., None, :]).sum(-1), 0)
    mdp = game.mdp.replace(
        successor=jnp.asarray(np.where(merged > 0, successor, 0), jnp.int32),
        probability=jnp.asarray(merged, game.dtype),
    )
    return Game(mdp, game.system)


@jax.jit
def _safe_actions(game: Game, region: jax.Array) -> jax.Array:
    """Actions inside the region; the system's must surely stay in it."""
    inside = game.available & region[:, None]
    return inside & (~game.system[:, None] | forall_successor(game, region))


def _require_start_in(
    region: jax.Array, joint: Game, base_state: NDArray[np.integer], memory: NDArray[np.integer]
) -> None:
    """Raises ValueError naming initial states outside of the winning region."""
    outside = np.flatnonzero((np.asarray(joint.initial) > 0) & ~np.asarray(region))
    if outside.size == 0:
        return
    named = ", ".join(
        f"{base_state[i]}" + (f" (automaton state {memory[i]})" if memory.any() else "")
        for i in outside[:5]
    ) + (", ..." if outside.size > 5 else "")
    raise ValueError(
        f"{outside.size} of the initial states lie outside of the almost-surely winning region: "
        f"{named}. From there no strategy satisfies the task almost surely "
        "(winning_region(...).counter_action shows why); start elsewhere, or weaken the task."
    )


def _environment_rows(
    problem: Problem, game: Game, environment: ArrayLike | str, discount: float | None
) -> NDArray[np.floating]:
    """The environment's policy in the joint game; zero at the system's states."""
    mask, system = np.asarray(problem.game.available), np.asarray(problem.game.system)
    if isinstance(environment, str) and environment == "random":
        rows = uniform_rows(mask)
    elif isinstance(environment, str) and environment == "adversarial" and discount is not None:
        optimal = minimax_value(problem.game, problem.reward, discount, allowed=problem.allowed)
        rows = np.eye(mask.shape[1])[np.asarray(optimal.policy)]
    elif isinstance(environment, str):
        raise ValueError(
            f"environment={environment!r}; choose random, adversarial (with discount=), or give a "
            "policy."
        )
    else:
        rows = np.asarray(environment)
        if rows.ndim == 1:
            require_shape("environment", rows, (game.num_states,))
            rows = np.eye(mask.shape[1])[rows]
        require_shape("environment", rows, game.available.shape)
        rows = environment_policy(mask, system, rows[np.asarray(problem.base_state)])
    return np.where(system[:, None], 0, rows)


# --- settings, state and metrics ---------------------------------------------------------------


UPDATES = ("every", "printed")


@struct.dataclass
class Hparams:
    """Settings of algorithm 5; numbers are traced, None is static.

    Attributes:
      discount: in (0, 1), of every move.
      reward_bound: R_max, positive; rewards lie in [0, R_max].
      epsilon: positive; the loss of value that the final strategy may have.
      failure: delta_c in (0, 1), probability of a larger loss; default 0.1.
      known_after: visits after which a pair with several successors is known. None: K of theorem
        6, out of reach for all but toys; a number voids the theorem, and :func:`evidence` remains.
        Default None.
      restart: probability of restarting before a move; default 0.0.
      update: ``"every"`` observed reward enters the model; ``"printed"``: only that of a pair's
        last successor before it is known (algorithm 5, line 16), which is wrong for actions with
        several successors; static; default ``"every"``.
      moves_per_step: a step ends with a change of the model, or after this many moves; static;
        default 128.
    """

    discount: Number = traced("positive_discount")
    reward_bound: Number = traced(Range(0, open_below=True, open_above=True))
    epsilon: Number = traced(Range(0, open_below=True, open_above=True))
    failure: Number = traced(Range(0, 1, open_below=True, open_above=True), default=0.1)
    known_after: Number | None = traced(Range(1), default=None)
    restart: Number = traced(Range(0, 1), default=0.0)
    update: str = static(UPDATES, default="every")
    moves_per_step: int = static(COUNT, default=128)


@struct.dataclass
class State(RunState):
    """Observations, the optimistic model, and its near-optimal actions.

    Attributes:
      moves: ``int32[]``, moves made, at most 2^31 - 1; further steps make none.
      position: ``int32[]``, the current state of the game.
      counts: ``int32[S, A, K]``, observations of each transition.
      reward: ``float[S, A, K]``, observed rewards; ``R_max / (1 - discount)`` elsewhere.
      known_at: ``int32[S, A]``, moves after which a pair became known; -1 before.
      num_known: ``int32[]``, known pairs.
      probability, gain: ``float[S, A, K]`` and ``[S, A]``, transition probabilities and expected
        rewards of the optimistic model.
      value, best: ``float[S]`` and ``bool[S, A]``, its value and near-optimal actions.
      error: ``float[]``, bound on the error of `value` up to a constant.
      last_update, num_updates: ``int32[]``, moves at the last computation of the strategy, and the
        number of these.
      always_almost_sure: ``bool[]``, True if every strategy so far had positive probability on every
        allowed action, so that it wins almost surely (lemma 6).
      fault: ``int32[]``, the first pair ``s * A + a`` with a reward outside of [0, R_max], or -1.
    """

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


@struct.dataclass
class Metrics:
    """Figures after a step; scalars, of a run ``[T]``.

    Attributes:
      moves, num_known, last_update, num_updates, always_almost_sure, fault: of :class:`State`.
      value: of the optimistic model, mean over the initial distribution.
      residual: ``state.error``.
      status: of the last solve of the optimistic model; MAX_STEPS if it missed its tolerance, or
        if all moves that can be counted were made.
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


def reward_error(state: int, action: int, reward: float, hparams: Hparams) -> ValueError:
    """The ValueError for an observed reward outside of [0, R_max]."""
    return ValueError(
        f"state {state}, action {action}: a reward of {reward:g} was observed, outside of [0, "
        f"reward_bound={float(hparams.reward_bound):g}]. The guarantee rests on that bound: give a "
        "larger reward_bound and learn anew."
    )
