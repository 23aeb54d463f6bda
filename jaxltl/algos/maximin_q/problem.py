"""Problems of Q-learning in games: the game, its exploring policy, and its known value."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.algos.common.play import (
    MOST_ACTIONS,
    alias_table,
    check_reward,
    cumulative,
    environment_policy,
    explicit_game,
    start_distribution,
    uniform_rows,
)
from jaxltl.core import struct
from jaxltl.core.graphs.end_components import bottom_components
from jaxltl.core.models import Game, restrict
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.types import require_shape


@struct.dataclass
class Problem:
    """A game with rewards that the learner observes only along its transitions.

    Attributes:
      game: on an explicit MDP, such as ``restrict`` returns.
      reward: ``float[S, A]`` or ``float[S, A, K]``.
      allowed: ``bool[S, A]``: the mask at the system's states, all actions at the environment's.
      behavior: ``float[S, A]``, the exploring policy of both players.
      start: ``float[S]``, distribution over the chains' initial states.
      exact: ``float[S]``, the minimax value, to measure the error; or None.
      measured: ``bool[S]``, the states over which the error is measured; None with `exact`.
      behavior_table: ``uint32[S, A]``, `behavior` as alias tables.
      start_table: ``uint32[S]``, `start` as cumulative weights.
      method: ``"generalized"`` or ``"maximin"``; static.
    """

    game: Game
    reward: jax.Array
    allowed: jax.Array
    behavior: jax.Array
    start: jax.Array
    exact: Array
    measured: Array
    behavior_table: jax.Array
    start_table: jax.Array
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
    start: ArrayLike | None = None,
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
      start: ``float[S]``, distribution of the chains' initial states; default the game's.
      method: ``"generalized"`` or ``"maximin"``.

    Raises:
      ValueError: a wrong shape, a reward that is not finite, a mask that allows an unavailable
        action or none in a reachable state, rows or a start that are no distributions, or a game
        that does not fit the method.
    """
    if method not in ("generalized", "maximin"):
        raise ValueError(f'method={method!r}; choose "generalized" or "maximin".')
    game = explicit_game(game)
    if game.num_actions > MOST_ACTIONS:
        raise ValueError(f"the game has {game.num_actions} actions; at most {MOST_ACTIONS} work.")
    system, mask = np.asarray(game.system), _mask(game, allowed)
    start = start_distribution(game, start)
    reachable = np.asarray(restrict(game, start, allowed=mask).base_state)
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
        start=jnp.asarray(start, game.dtype),
        exact=None,
        measured=None,
        behavior_table=jnp.asarray(alias_table(behavior)),
        start_table=jnp.asarray(cumulative(start)),
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
        require_shape(name, array, problem.start.shape)
    return replace(problem, exact=exact, measured=measured)


def recurrent_states(problem: Problem) -> jax.Array:
    """The states of bottom strongly connected components under the exploring policy: ``bool[S]``.

    Chains of the `problem` without restarts and greedy moves visit exactly these infinitely often.
    """
    part = restrict(problem.game, problem.start, allowed=problem.behavior > 0)
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
