"""Two post offices and a signal light: a game with a reward that conflicts with its task.

The example of the dissertation's section 6.7. State ``(cell * 2 + light) * 2 + turn``: cells
are numbered in rows from the upper left, 0 to 8; `light` is 1 where the light is on, and
`turn` 1 where the system moves: the inverse of ``np.unravel_index(state, (9, 2, 2))``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.automata.automaton import Automaton, make_automaton
from jaxltl.core.models import MDP, Game, make_game, make_mdp, restrict
from jaxltl.core.models.product import product
from jaxltl.core.models.protocols import base_model
from jaxltl.core.pretty_print import brief
from jaxltl.envs.gridworld import ACTIONS as MOVES, gridworld

ACTIONS = (*MOVES, "off", "on")
_CELLS, _WORLD_STATES = 9, 36
_MAP = """
.  . p1
.  . .
p2 . .
"""
# The four cells of the dangerous block in the order in which going round it is rewarded, by the
# light: off, the lower right block clockwise; on, the upper left block counterclockwise.
_ROUND = ((4, 5, 8, 7), (0, 3, 4, 1))


def post_offices() -> Game:
    """A game of a robot on a 3 by 3 grid against a light, in turns (dissertation, section 6.7).

    The system moves to an adjacent cell; the environment then switches the light off or on. Where the
    light is on, the upper left block of four cells is dangerous, else the lower right one, see
    :func:`patrol_reward`. Initial states are uniform, the system to move. Propositions: ``p1`` in the
    upper right cell and ``p2`` in the lower left, at both turns. The game is deterministic.

    >>> game = post_offices()
    >>> game.num_states, game.num_actions, game.num_successors
    (36, 6, 1)
    >>> state = (2 * 2 + 1) * 2 + 1  # in the upper right, the light on, the system to move
    >>> [p for p, holds in zip(game.propositions, game.label[state]) if holds]
    ['p1']
    """
    world = gridworld(_MAP)
    cell, light, turn = np.unravel_index(np.arange(_WORLD_STATES), (_CELLS, 2, 2))
    system = turn == 1
    walk = np.asarray(world.successor)[cell, :, 0]  # [36, 4]; off the grid, the cell itself
    moves = len(MOVES)
    successor = np.zeros((_WORLD_STATES, len(ACTIONS), 1), np.int32)
    successor[:, :moves, 0] = (walk * 2 + light[:, None]) * 2
    successor[:, moves:, 0] = (cell[:, None] * 2 + np.arange(2)) * 2 + 1
    available = np.zeros((_WORLD_STATES, len(ACTIONS)), bool)
    available[:, :moves] = system[:, None] & (walk != cell[:, None])
    available[:, moves:] = ~system[:, None]
    mdp = make_mdp(
        successor,
        available[:, :, None].astype(float),
        available=available,
        initial=system / system.sum(),
        label=np.asarray(world.label)[cell],
        propositions=world.propositions,
    )
    return make_game(mdp, system)


def surveillance() -> Automaton:
    """The deterministic Buchi automaton of ``G F p1 & G F p2`` in figure 17a of the dissertation.

    ``q1`` waits for either visit, ``q2`` has seen p1, ``q3`` has seen p2, and ``q4``, in which both have
    been seen, is accepting and continues like ``q1``. Unlike the translation of the formula, it takes
    the visits in either order.

    >>> automaton = surveillance()
    >>> automaton.delta.tolist()  # reading neither, p1, p2, both
    [[0, 1, 2, 3], [1, 1, 3, 3], [2, 3, 2, 3], [0, 1, 2, 3]]
    """
    return make_automaton(
        [[0, 1, 2, 3], [1, 1, 3, 3], [2, 3, 2, 3], [0, 1, 2, 3]],
        0,
        [[False, False], [True, False], [False, True], [True, True]],
        ["p1", "p2"],
        accepting=[False, False, False, True],
        state_names=["q1", "q2", "q3", "q4"],
    )


def patrol_reward(game: Game) -> jax.Array:
    """The reward of the system for patrolling the dangerous block, ``float[S, A]``.

    1 for a move into the dangerous block, and for a move inside it that goes round it counterclockwise
    where the light is on, clockwise where it is off; else 0, also for the moves inside in the other
    sense, which the dissertation does not define. `game` is :func:`post_offices`, or a product of it, for
    which the reward is ``[S, Q, A]``; of ``restrict(game)`` take the rows at ``base_state``.

    Raises:
      ValueError: the game has other states.

    >>> reward = patrol_reward(post_offices())
    >>> state = (4 * 2 + 1) * 2 + 1  # in the middle, the light on, the system to move
    >>> reward[state].tolist()  # up, down, left, right, off, on
    [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    """
    shape = (*game.state_shape, game.num_actions)
    if shape[0] != _WORLD_STATES or shape[-1] != len(ACTIONS):
        raise ValueError(
            f"the game has states and actions {shape}; give post_offices() or a product of it, "
            "and of a restricted game take the rows at its base_state."
        )
    world = cast(MDP, base_model(game))
    cell, light, turn = np.unravel_index(np.arange(_WORLD_STATES), (_CELLS, 2, 2))
    paid = _paid_moves()[light[:, None], cell[:, None], np.asarray(world.successor)[:, :, 0] // 4]
    paid &= np.asarray(world.available) & (turn == 1)[:, None]
    reward = jnp.asarray(paid, game.dtype)
    return jnp.broadcast_to(jnp.expand_dims(reward, tuple(range(1, len(shape) - 1))), shape)


def _paid_moves() -> np.ndarray:
    """Rewarded moves by light, cell and next cell: ``bool[2, 9, 9]``."""
    paid = np.zeros((2, _CELLS, _CELLS), bool)
    for light, block in enumerate(_ROUND):
        inside = np.isin(np.arange(_CELLS), block)
        paid[light] = ~inside[:, None] & inside
        paid[light, block, np.roll(block, -1)] = True
    return paid


@brief
class Patrol(NamedTuple):
    """The product of the game with its task; states are ``world * 4 + memory``.

    Attributes:
      game: an explicit game of all 144 states; initially any cell and light, the system to move, and
        the memory in q1. 108 states are reachable.
      accepting, reward: ``bool[144]`` (the memory is in q4, infinitely often), and ``float[144, 6]``.
      cell, light, memory: ``int32[144]``, see this module and :func:`surveillance`.
    """

    game: Game
    accepting: jax.Array
    reward: jax.Array
    cell: jax.Array
    light: jax.Array
    memory: jax.Array


def patrol() -> Patrol:
    """The product of the post office game with the automaton of its task (dissertation, 6.7).

    The automaton reads the label of the state before each move, at both turns. The task is winning from
    every state; the reward-optimal patrol visits neither post office.

    >>> model = patrol()
    >>> moves = model.game.available.sum(axis=1)
    >>> int(moves[model.game.system].sum()), int(moves.sum())
    (192, 336)
    """
    world = post_offices()
    joint = product(world, surveillance(), label_on="exit")
    everywhere = np.full(joint.num_states, 1 / joint.num_states)
    whole = restrict(joint, everywhere)  # reachable states, here all, in order
    game = replace(whole.model, mdp=replace(whole.model.mdp, initial=joint.initial.ravel()))
    cell, light, _ = jnp.unravel_index(whole.base_state, (_CELLS, 2, 2))
    return Patrol(
        game=game,
        accepting=whole.memory == 3,
        reward=patrol_reward(world)[whole.base_state],
        cell=cell.astype(jnp.int32),
        light=light.astype(jnp.int32),
        memory=whole.memory,
    )
