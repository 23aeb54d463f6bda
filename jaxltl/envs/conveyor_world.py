"""ConveyorWorld: two corridors behind conveyor belts, and a choice between them (Abate et al. 2026).

Both corridors have the same items in the same order but for the last one, and belts do not let the agent
return, so that the first moves decide which of two tasks can be satisfied. Sizes and layout are those of
"Semantically labelled automata for multi-task reinforcement learning with LTL instructions" and of
Jackermeier, Cloete and Abate (2026), "Jaxolotl".
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

from jaxltl.core import validation
from jaxltl.core.environments import (
    Environment,
    Timestep,
    make_box,
    make_environment,
    with_time_limit,
)
from jaxltl.core.models.protocols import Array, Key

ACTIONS = ("up", "down", "left", "right")
_MOVES = ((0, 1), (0, -1), (-1, 0), (1, 0))  # of x and y
_OPPOSITE = (1, 0, 3, 2)
_LETTERS = "abcdefghijklmnopqrstuvwxyz"


def conveyor_world(
    chain: int = 2, *, simple: bool = False, horizon: int | None = 50
) -> Environment:
    """ConveyorWorld with `chain` items in each of its two corridors; deterministic and finite.

    Actions are up, down, left and right; a move into a wall, off the map, or against the belt below the
    agent has no effect. There is no reward. Propositions are ``chain + 1`` letters, a, b, ..., z, aa,
    ab, ...: the first ``chain - 1`` hold at items of both corridors, the last but one at the end of the
    lower corridor, and the last one at the end of the upper corridor. The tasks are the chains
    ``F(a & F(b & ... F last))`` with either last letter.

    Args:
      chain: the number of items in a corridor, 1 to 64.
      simple: a single column with a belt up and a belt down, whose every cell has an item: the first
        move decides. Its published time limit is 4 `chain`, if that is more than 50.
      horizon: the time limit, or None.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment` with states ``int32[]``, the cell
      ``y * width + x`` counted from the lower left. Observations are ``float32[2]``, x and y.

    Raises:
      ValueError: a chain that is not 1 to 64, or an invalid time limit.

    >>> world = conveyor_world(3)
    >>> world.propositions, world.horizon, world.observations.high.tolist()
    (('a', 'b', 'c', 'd'), 50, [9.0, 8.0])
    """
    chain = validation.integer("chain", chain, least=1, limit=64)
    simple = validation.boolean("simple", simple)
    free, flow, items, start = _column(chain) if simple else _corridors(chain)
    height, width = free.shape
    successor = _successor(free, flow)
    label = np.zeros((free.size, chain + 1), bool)
    for (column, row), number in items.items():
        label[row * width + column, number] = True
    y, x = np.divmod(np.arange(free.size), width)
    world = make_environment(
        Partial(_begin, np.int32(start[1] * width + start[0])),
        Partial(_move, successor),
        Partial(_look_up, np.stack([x, y], axis=1).astype(np.float32)),
        actions=4,
        labels=Partial(_look_up, label),
        propositions=[_name(i) for i in range(chain + 1)],
        observations=make_box(0, [width - 1, height - 1], (2,), np.float32),
    )
    return world if horizon is None else with_time_limit(world, horizon)


def _name(i: int) -> str:
    first, last = divmod(i, len(_LETTERS))
    return (_LETTERS[first - 1] if first else "") + _LETTERS[last]


Layout = tuple[np.ndarray, np.ndarray, dict[tuple[int, int], int], tuple[int, int]]


def _corridors(chain: int) -> Layout:
    """Cells without a wall, the action along the belt or -1, items by place, and the first cell."""
    free, flow = np.ones((9, 7 + chain), bool), np.full((9, 7 + chain), -1)
    free[[0, 8], :5] = False  # left of the corridors
    free[3:6, 4:] = False  # between them
    free[2:7, 3] = False
    free[[2, 6], 3:6] = False
    flow[[1, 7], 3:6] = ACTIONS.index("right")
    items = {(7 + i, y): i for y in (1, 7) for i in range(chain)}
    items[6 + chain, 7] = chain
    return free, flow, items, (0, 4)


def _column(chain: int) -> Layout:
    free, flow = np.zeros((2 * chain + 3, 3), bool), np.full((2 * chain + 3, 3), -1)
    free[1:-1, 1] = True
    flow[1 : chain + 1, 1] = ACTIONS.index("down")
    flow[chain + 2 : -1, 1] = ACTIONS.index("up")
    items = {(1, chain + 1 + d * (i + 1)): i for d in (-1, 1) for i in range(chain)}
    items[1, 2 * chain + 1] = chain
    return free, flow, items, (1, chain + 1)


def _successor(free: np.ndarray, flow: np.ndarray) -> np.ndarray:
    """``int32[C, 4]``, the cell after each action."""
    height, width = free.shape
    y, x = np.divmod(np.arange(free.size), width)
    moved = np.empty((free.size, len(ACTIONS)), np.int32)
    for action, (right, up) in enumerate(_MOVES):
        i, j = np.clip(x + right, 0, width - 1), np.clip(y + up, 0, height - 1)
        blocked = ~free[j, i] | (flow[y, x] == _OPPOSITE[action])
        moved[:, action] = np.where(blocked, y * width + x, j * width + i)
    return moved


def _begin(cell: Array, key: Key) -> jax.Array:
    return jnp.asarray(cell)


def _move(successor: Array, cell: jax.Array, action: jax.Array, key: Key) -> Timestep:
    return Timestep(jnp.asarray(successor)[cell, action], reward=0.0, terminated=False)


def _look_up(table: Array, cell: jax.Array) -> jax.Array:
    return jnp.asarray(table)[cell]
