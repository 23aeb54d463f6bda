"""Turn-based games of two robots on a grid, and a game with a reward that conflicts with its task.

State ``(environment * C + system) * 2 + turn``, where `environment` and `system` are the
robots' places, 0 to C - 1, and `turn` is 1 where the system moves: the inverse of
``np.unravel_index(state, (C, C, 2))``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core import validation
from jaxltl.core.games.objective import States, states_with_label
from jaxltl.core.logic.labels import satisfying
from jaxltl.core.models import MDP, Game, make_game, make_mdp
from jaxltl.core.models.ops import operators
from jaxltl.envs.gridworld import ACTIONS as MOVES, gridworld, parse_map

ACTIONS = (*MOVES, "stay")
CORNERS = ("lower_left", "lower_right", "upper_left", "upper_right")
_STAY = ACTIONS.index("stay")


_LIMIT = 181  # cells a side, so that 32 bits number the states


def robots(size: int) -> Game:
    """The game of two robots on a square grid, in turns (dissertation, section 5.5).

    The system's robot goes to an adjacent cell or stays; the environment's goes to an adjacent cell.
    Initial states are uniform over pairs of different cells, the system to move. Cells are numbered in
    rows from the lower left. Propositions: ``collision``; ``diagonal``, where the cells share a corner
    alone; ``system_turn``; and each robot in each corner, such as ``system_lower_left``. The game is
    deterministic, with ``2 * size**4`` states and the actions :data:`ACTIONS`.

    Raises:
      ValueError: `size` is not an integer of at least 2, or exceeds the range of 32 bits.

    >>> game = robots(3)
    >>> game.num_states, game.num_actions, game.num_successors
    (162, 5, 1)
    >>> state = (4 * 9 + 0) * 2 + 1  # environment in the middle, system in the lower left
    >>> [p for p, holds in zip(game.propositions, game.label[state]) if holds]
    ['diagonal', 'system_turn', 'system_lower_left']
    """
    if isinstance(size, bool) or not isinstance(size, int | np.integer) or not 2 <= size <= _LIMIT:
        raise ValueError(
            f"size={size!r}; give the cells along a side, an integer from 2 to {_LIMIT}."
        )
    size = int(size)
    world = gridworld("\n".join(["." * size] * size))
    cells = np.arange(size * size).reshape(size, size)[::-1].ravel()  # the map's first row is up
    walk = _moves(world, cells)
    mark = np.eye(size * size, dtype=bool)[:, [0, size - 1, size * (size - 1), size**2 - 1]]
    anywhere = np.ones(size * size, bool)
    return _in_turns(
        walk,
        _without_stay(walk),
        position=np.stack(np.divmod(np.arange(size * size), size), axis=-1),
        mark=mark,
        names=CORNERS,
        start=_different(anywhere, anywhere),
    )


def grid_game(
    text: str,
    *,
    system_start: str | Sequence[int] | None = None,
    environment_start: str | Sequence[int] | None = None,
    slip: float = 0.0,
    system_stays: bool = True,
    environment_stays: bool = False,
    legend: Mapping[str, Collection[str]] | None = None,
    wall: str = "#",
) -> Game:
    """The game of two robots on a text map, in turns.

    A robot moves up, down, left or right between :func:`places`, the cells that are not walls, or stays
    where that is permitted. With probability `slip` a move of the system goes to one of the two sides
    instead, half each, or stays if that is blocked. Propositions: those of :func:`robots` but corners,
    and ``system_p`` and ``environment_p`` for each proposition p of the map.

    Args:
      text: the map, see :func:`~jaxltl.envs.text_map.parse_map`.
      system_start, environment_start: a propositional formula over the map's propositions, or a cell's
        row and column, from 0 at the top left; default: any place. Initial states are as in
        :func:`robots`.
      slip, legend, wall: as for :func:`~jaxltl.envs.gridworld.gridworld`.
      system_stays, environment_stays: permit the robot to stay.

    Returns:
      A game with ``2 * C**2`` states and the actions :data:`ACTIONS`; deterministic without slip.

    Raises:
      ValueError: an invalid map, legend, probability or start, or a place without moves.

    >>> game = grid_game('''
    ... a.#
    ... ..b
    ... ''', system_start="a", environment_start=(1, 2))
    >>> game.num_states
    50
    """
    world = gridworld(text, slip=slip, legend=legend, wall=wall)
    system_stays = validation.boolean("system_stays", system_stays)
    environment_stays = validation.boolean("environment_stays", environment_stays)
    position = places(text, wall=wall)
    rows_columns = parse_map(text).shape
    cells = np.ravel_multi_index(tuple(position.T), rows_columns)
    if "turn" in world.propositions:
        raise ValueError(
            "'turn' is a proposition of the map, and system_turn says whose turn it is; "
            "give the cells another name by a legend."
        )
    straight = _moves(gridworld(text, legend=legend, wall=wall), cells)
    # Which ways are open is read off the world without slip: at slip 1 the cell ahead is padding.
    walk = _moves(world, cells)._replace(available=straight.available)
    system = walk if system_stays else _without_stay(walk)
    environment = straight if environment_stays else _without_stay(straight)
    _require_moves("system", system, position)
    _require_moves("environment", environment, position)
    label = np.asarray(world.label)[cells]
    start = [
        _start(where, argument, position, rows_columns, label, world.propositions)
        for argument, where in (
            ("environment_start", environment_start),
            ("system_start", system_start),
        )
    ]
    return _in_turns(
        system,
        environment,
        position=position,
        mark=label,
        names=world.propositions,
        start=_different(*start),
    )


def places(text: str, *, wall: str = "#") -> np.ndarray:
    """The row and column ``int[C, 2]`` of each place of the map `text`, all cells but `wall`.

    >>> places("a#\\n.b").tolist()
    [[0, 0], [1, 0], [1, 1]]
    """
    return np.argwhere(parse_map(text) != wall)


def arrival_reward(game: Game, condition: States) -> jax.Array:
    """The probability that a move of the system leads to a state of a set: ``float[S, A]``.

    ``R(s, a) = sum_t P(t | s, a) [t satisfies the condition]`` in the system's states of the `game`,
    else 0. The `condition` is ``bool[S]``, or a Boolean formula over the game's propositions.

    >>> game = robots(2)
    >>> state = (3 * 4 + 1) * 2 + 1  # the system in the lower right, below the environment
    >>> arrival_reward(game, "system_lower_left")[state].tolist()
    [0.0, 0.0, 1.0, 0.0, 0.0]
    """
    arrives = states_with_label(game, condition).astype(game.dtype)
    counts = game.system[..., None] & game.available
    return jnp.where(counts, operators.expectation(game, arrives), 0)


def diagonal_reward(game: Game) -> jax.Array:
    """The :func:`arrival_reward` of ``diagonal`` in a `game` of robots (dissertation, section 5.5).

    >>> game = robots(3)
    >>> state = (4 * 9 + 0) * 2 + 1  # the environment in the middle, the system in a corner
    >>> diagonal_reward(game)[state].tolist()  # up, down, left, right, stay
    [0.0, 0.0, 0.0, 0.0, 1.0]
    """
    return arrival_reward(game, "diagonal")


def reward_against_task() -> tuple[Game, jax.Array]:
    """A game and a reward with optimal policies that violate the task (dissertation, figure 12).

    The system alone moves. In state 0 the action 0 stays and the action 1 goes to state 1, each for a
    reward of 10; in state 1, where ``b2`` holds, the action 2 stays for nothing. The task ``F b2`` is
    satisfied by leaving after n moves, for every n; the values
    ``10 * (1 - discount**(n + 1)) / (1 - discount)`` have a supremum that none attains.

    >>> game, reward = reward_against_task()
    >>> reward.tolist()
    [[10.0, 10.0, 0.0], [0.0, 0.0, 0.0]]
    """
    available = np.array([[True, True, False], [False, False, True]])
    model = make_mdp(
        [[[0], [1], [0]], [[0], [0], [1]]],
        available[:, :, None].astype(float),
        available=available,
        label=[[False], [True]],
        propositions=["b2"],
    )
    reward = jnp.asarray([[10.0, 10.0, 0.0], [0.0, 0.0, 0.0]], model.dtype)
    return make_game(model, [True, True]), reward


# --- one robot's moves, and two robots in turns -----------------------------------------------


class _RobotMoves(NamedTuple):
    """One robot's moves among C places: ``[C, A, K]``, ``[C, A, K]`` and ``[C, A]``."""

    target: np.ndarray
    probability: np.ndarray
    available: np.ndarray


def _moves(world: MDP, cells: np.ndarray) -> _RobotMoves:
    """Moves of a robot in a gridworld with staying; places are ``cells[0], ...``."""
    count = cells.size
    number = np.zeros(world.num_states, np.int32)
    number[cells] = np.arange(count)
    own = np.arange(count, dtype=np.int32)[:, None]
    target = np.broadcast_to(own[:, :, None], (count, len(ACTIONS), world.num_successors)).copy()
    target[:, :_STAY] = number[np.asarray(world.successor)[cells]]
    probability = np.zeros(target.shape)
    probability[:, :_STAY] = np.asarray(world.probability)[cells]
    probability[:, _STAY, 0] = 1
    # Without slip the first successor is the cell ahead, the robot's own where that is blocked.
    available = target[:, :, 0] != own
    available[:, _STAY] = True
    return _RobotMoves(target, probability, available)


def _without_stay(moves: _RobotMoves) -> _RobotMoves:
    available = moves.available.copy()
    available[:, _STAY] = False
    return moves._replace(available=available)


def _require_moves(player: str, moves: _RobotMoves, position: np.ndarray) -> None:
    stuck = np.flatnonzero(~moves.available.any(axis=1))
    if stuck.size:
        row, column = position[stuck[0]]
        raise ValueError(
            f"the {player} has no move from the cell in row {row + 1}, column {column + 1}, "
            f"which walls enclose; open it, make it a wall, or set {player}_stays=True."
        )


def _start(
    where: str | Sequence[int] | None,
    argument: str,
    position: np.ndarray,
    rows_columns: tuple[int, ...],
    label: np.ndarray,
    propositions: tuple[str, ...],
) -> np.ndarray:
    """Initial places of a robot: ``bool[C]``."""
    if where is None:
        return np.ones(len(position), bool)
    if isinstance(where, str):
        holds = satisfying(label, propositions, where, argument)
        if not holds.any():
            raise ValueError(f"{argument}={where!r} holds in no cell of the map.")
        return holds
    cell = np.asarray(where)
    if cell.shape != (2,) or not np.issubdtype(cell.dtype, np.integer):
        raise ValueError(
            f"{argument}={where!r}; give a formula over the map's propositions, or a cell's "
            "row and column, from 0 at the top left."
        )
    row, column = (int(i) for i in cell)
    rows, columns = rows_columns
    if not (0 <= row < rows and 0 <= column < columns):
        raise ValueError(
            f"{argument}=({row}, {column}) is off the map, whose rows are 0 to {rows - 1} and "
            f"columns 0 to {columns - 1}."
        )
    here = (position == cell).all(axis=1)
    if not here.any():
        raise ValueError(
            f"{argument}=({row}, {column}) is a wall (row {row + 1}, column {column + 1} of the "
            "map); start in another cell."
        )
    return here


def _different(environment: np.ndarray, system: np.ndarray) -> np.ndarray:
    """Uniform distribution ``float[C, C]`` on pairs of distinct places."""
    pairs = environment[:, None] & system & ~np.eye(system.size, dtype=bool)
    if not pairs.any():
        raise ValueError("the robots can only start in one and the same cell; give them two.")
    return pairs / pairs.sum()


def _in_turns(
    system: _RobotMoves,
    environment: _RobotMoves,
    *,
    position: np.ndarray,
    mark: np.ndarray,
    names: Sequence[str],
    start: np.ndarray,
) -> Game:
    count, num_actions, width = system.target.shape
    shape = (count, count, 2, num_actions)
    here = np.arange(count, dtype=np.int32)
    successor = np.zeros((*shape, width), np.int32)
    probability = np.zeros((*shape, width))
    available = np.empty(shape, bool)
    first = slice(environment.target.shape[2])
    successor[:, :, 1] = (here[:, None, None, None] * count + system.target) * 2
    successor[:, :, 0, :, first] = (
        environment.target[:, None] * count + here[:, None, None]
    ) * 2 + 1
    probability[:, :, 1] = system.probability
    probability[:, :, 0, :, first] = environment.probability[:, None]
    available[:, :, 1] = system.available
    available[:, :, 0] = environment.available[:, None]
    initial = np.zeros(shape[:3])
    initial[:, :, 1] = start
    label, propositions = _labels(position, mark, names)
    num_states = 2 * count**2
    model = make_mdp(
        successor.reshape(num_states, num_actions, width),
        probability.reshape(num_states, num_actions, width),
        available=available.reshape(num_states, num_actions),
        initial=initial.ravel(),
        label=label.reshape(num_states, -1),
        propositions=propositions,
    )
    return make_game(model, np.tile([False, True], count**2))


def _labels(
    position: np.ndarray, mark: np.ndarray, names: Sequence[str]
) -> tuple[np.ndarray, tuple[str, ...]]:
    """``bool[C, C, 2, 3 + 2 P]``, and the names of its columns."""
    count, each = mark.shape
    label = np.zeros((count, count, 2, 3 + 2 * each), bool)
    apart = np.abs(position[:, None] - position).astype(np.int32)
    label[..., 0] = np.eye(count, dtype=bool)[..., None]
    label[..., 1] = (apart == 1).all(axis=-1)[..., None]
    label[..., 1, 2] = True
    label[..., 3 : 3 + each] = mark[:, None, None]
    label[..., 3 + each :] = mark[None, :, None]
    return label, (
        "collision",
        "diagonal",
        "system_turn",
        *(f"{robot}_{p}" for robot in ("environment", "system") for p in names),
    )
