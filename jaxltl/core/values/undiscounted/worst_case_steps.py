"""Worst-case expected number of moves of a strategy until a goal, in stochastic games on the host."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxltl.core.models.game import Game
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.types import Solution, require_shape
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.values.interval.robust import robust_total_reward
from jaxltl.core.values.undiscounted.reachability import on_rows, rows_of_model


@validated()
def worst_case_steps(game: Game, goal: Array, strategy: Array) -> Solution:
    """Worst-case expected number of moves until a goal state ``bool[S]`` is entered next.

    ``x(s) = opt_a sum_t P(t | s, a) (1 + [t not in goal] x(t))``: the mean over the system's strategy
    ``float[S, A]``, which is normalised; elsewhere, also where that is 0, the maximum (the total
    reward of the environment's decision process, Puterman 1994, chapter 7).

    Returns a :class:`Solution`, infinite where some environment prevents the goal with positive
    probability. Concrete arrays only; not differentiable. Raises ValueError for a wrong shape.

    Example:
      >>> from jaxltl import from_dense, make_game
      >>> world = from_dense([[[0.5, 0.5], [0.75, 0.25]], [[0, 1.0], [0, 1.0]]])
      >>> game = make_game(world, [False, True])  # the environment moves in the first state
      >>> worst_case_steps(game, [False, True], np.full((2, 2), 0.5)).value.round(6).tolist()
      [4.0, 1.0]
    """
    goal, table, size = np.asarray(goal), np.asarray(strategy, float), game.num_states
    require_shape("goal", goal, (size,))
    require_shape("strategy", table, (size, game.num_actions))
    host = rows_of_model(game).host
    # Goal states are entered as a state of their own.
    target = np.append(np.where(goal[host.successor], size, host.successor), size)
    model = make_sparse(
        np.append(host.row_start, host.num_rows + 1),
        np.append(host.entry_start, target.size),
        target,
        np.append(host.probability, 1.0),
    )
    total = table.sum(-1, keepdims=True)
    moves = to_jax(np.append(np.asarray(game.system) & (total[:, 0] > 0), False))
    weight = np.append(on_rows(rows_of_model(game), table / np.where(total > 0, total, 1)), 1.0)
    cost, end = np.ones(weight.size), np.arange(size + 1) == size
    found = robust_total_reward(Game(model, moves), cost, end, policy=weight, objective="min")
    return replace(
        found,
        value=found.value[:size],
        lower=found.lower[:size],
        upper=found.upper[:size],
        policy=to_jax(table),
        nature=None,
    )
