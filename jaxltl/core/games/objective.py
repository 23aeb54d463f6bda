"""Objectives of games: parity and GR(1) conditions on states.

Sets of states are Boolean arrays, or Boolean formulas over the propositions of the game.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias, cast

import chex
import jax
import numpy as np
from jaxltl.core import struct

from jaxltl.core.pretty_print import brief
from jaxltl.core.logic.labels import satisfying
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.models.ops.array_namespace import jax_array, is_traced, namespace, to_jax
from jaxltl.core.models.product import distinct_labels, letters_by_state
from jaxltl.core.models.protocols import Array, LabelledModel, Model, base_model

States: TypeAlias = chex.Array | Formula | str  # a set of states


@brief
@struct.dataclass
class Parity:
    """Parity objective: the least priority met infinitely often is even.

    Attributes:
      priority: ``int32[S]``, at least 0.
      won, lost: ``bool[S]``: the objective is achieved, or failed, on entering.
      num_priorities: a strict upper bound on the priorities; static.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.from_dense(np.roll(np.eye(3), 1, 1)[:, None], label={"a": [0], "b": [1, 2]})
      >>> safety(path, "b").lost.tolist()
      [True, False, False]
    """

    priority: jax.Array | np.ndarray
    won: jax.Array | np.ndarray
    lost: jax.Array | np.ndarray
    num_priorities: int = struct.field(pytree_node=False)


@brief
@struct.dataclass
class GR1:
    """Generalised reactivity of rank one (Piterman, Pnueli and Sa'ar 2006).

    If every assumption is met infinitely often then so is every guarantee; and no state
    of `lost` is ever entered.

    Attributes:
      assumptions, guarantees: ``bool[M, S]`` and ``bool[J, S]``, at least one of each.
      lost: ``bool[S]``.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.from_dense(np.roll(np.eye(3), 1, 1)[:, None], label={"a": [0], "b": [1, 2]})
      >>> gr1(path, ["a"], ["b"]).guarantees.tolist()
      [[False, True, True]]
    """

    assumptions: jax.Array | np.ndarray
    guarantees: jax.Array | np.ndarray
    lost: jax.Array | np.ndarray


def states_with_label(model: Model, condition: States, place: str = "condition") -> jax.Array:
    """A set of states as ``bool[S]``: of an array, or of a Boolean formula over propositions.

    Args:
      model: an MDP, a DenseMDP, a Product or a Game.
      condition: ``bool[S]``, or a formula without temporal operators, in a product on the states of
        the world.
      place: beginning of the error message.

    Returns:
      ``bool[S]``, or ``bool[S, Q]`` in a product. Boolean: there is no derivative.

    Raises:
      ValueError: wrong shape or dtype, an unknown proposition, or a temporal operator.

    Example:
      >>> from jaxltl import from_dense
      >>> states_with_label(from_dense([[[1.0, 0]], [[0, 1.0]]], label={"a": [1]}), "!a").tolist()
      [True, False]
    """
    if isinstance(condition, str) and condition in ("true", "false"):
        # Of traced games too.
        return jax_array(np.full(model.state_shape, condition == "true"))
    if isinstance(condition, str | Formula):
        world = cast(LabelledModel, base_model(model))
        holds = satisfying(distinct_labels(world), world.propositions, condition, place)
        xp, holds = namespace(letters_by_state(world, np.asarray(holds)))
        extra = len(model.state_shape) - 1
        return jax_array(xp.broadcast_to(holds.reshape(-1, *(1,) * extra), model.state_shape))
    _, condition = namespace(condition if is_traced(condition) else np.asarray(condition))
    if condition.shape != model.state_shape or condition.dtype != bool:
        raise ValueError(
            f"{place} is {condition.dtype}{list(condition.shape)}; give "
            f"bool{list(model.state_shape)}, or a Boolean formula over propositions."
        )
    return jax_array(condition)


def safety(game: Model, safe: States) -> Parity:
    """Safety objective: stay in `safe` for ever, ``G safe``.

    Args:
      game: the game.
      safe: ``bool[S]`` or a Boolean formula over propositions.

    Returns:
      :class:`Parity`.

    Raises:
      ValueError: see :func:`states_with_label`.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.from_dense(np.roll(np.eye(3), 1, 1)[:, None], label={"a": [0], "b": [1, 2]})
      >>> jl.winning_region(path, safety(path, "a | b")).region.tolist()
      [True, True, True]
    """
    return _parity(game, 0, 1, safe)


def reach(game: Model, goal: States, *, safe: States = "true") -> Parity:
    """Reachability objective: reach `goal` through `safe` states, ``safe U goal``.

    Args:
      game: the game.
      goal, safe: ``bool[S]`` or a Boolean formula over propositions.

    Returns:
      :class:`Parity`.

    Raises:
      ValueError: see :func:`states_with_label`.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.from_dense(np.roll(np.eye(3), 1, 1)[:, None], label={"a": [0], "b": [1, 2]})
      >>> jl.winning_region(path, reach(path, np.arange(3) == 1, safe="b")).region.tolist()
      [False, True, False]
    """
    return _parity(game, 1, 2, safe, won=states_with_label(game, goal, "goal"))


def buchi(game: Model, accepting: States, *, safe: States = "true") -> Parity:
    """Buchi objective: meet `accepting` infinitely often, ``G F accepting & G safe``.

    Args:
      game: the game.
      accepting, safe: ``bool[S]`` or a Boolean formula over propositions.

    Returns:
      :class:`Parity`.

    Raises:
      ValueError: see :func:`states_with_label`.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.from_dense(np.roll(np.eye(3), 1, 1)[:, None], label={"a": [0], "b": [1, 2]})
      >>> jl.winning_region(path, buchi(path, "a")).region.tolist()
      [True, True, True]
    """
    xp, accepting = namespace(states_with_label(game, accepting, "accepting"))
    return _parity(game, xp.where(accepting, 0, 1), 2, safe)


def cobuchi(game: Model, persistent: States, *, safe: States = "true") -> Parity:
    """Co-Buchi objective: eventually stay in `persistent`, ``F G persistent & G safe``.

    Args:
      game: the game.
      persistent, safe: ``bool[S]`` or a Boolean formula over propositions.

    Returns:
      :class:`Parity`.

    Raises:
      ValueError: see :func:`states_with_label`.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.from_dense(np.roll(np.eye(3), 1, 1)[:, None], label={"a": [0], "b": [1, 2]})
      >>> jl.winning_region(path, cobuchi(path, "b")).region.tolist()
      [False, False, False]
    """
    xp, persistent = namespace(states_with_label(game, persistent, "persistent"))
    return _parity(game, xp.where(persistent, 2, 1), 3, safe)


def parity(
    game: Model, priority: chex.Array, *, safe: States = "true", num_priorities: int | None = None
) -> Parity:
    """Parity objective: the least priority met infinitely often is even, and ``G safe``.

    Args:
      game: the game.
      priority: ``int[S]``, at least 0.
      safe: states never to leave.
      num_priorities: an upper bound on ``1 + priority``; needed only for traced priorities.

    Returns:
      :class:`Parity`.

    Raises:
      ValueError: negative or non-integer priorities, or a wrong shape.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.from_dense(np.roll(np.eye(3), 1, 1)[:, None], label={"a": [0], "b": [1, 2]})
      >>> jl.winning_region(path, parity(path, np.array([3, 2, 3]))).region.tolist()
      [True, True, True]
    """
    if num_priorities is None:
        values = np.asarray(priority)
        if not np.issubdtype(values.dtype, np.integer) or values.shape != game.state_shape:
            raise ValueError(
                f"priority is {values.dtype}{list(values.shape)}; give int{list(game.state_shape)}."
            )
        if values.min(initial=0) < 0:
            state = np.argwhere(values < 0)[0]
            raise ValueError(
                f"state {state.tolist()} has priority {values.min()}; priorities start at 0."
            )
        if values.max(initial=0) > 2 * values.size:  # most of them are not in use
            priority = values = fewest_priorities(values)
        num_priorities = int(values.max(initial=0)) + 1
    return _parity(game, priority, num_priorities, safe)


def fewest_priorities(priority: np.ndarray) -> np.ndarray:
    """The least nonnegative priorities with the same order of even and odd ones, ``int32``."""
    values, place = np.unique(priority, return_inverse=True)
    parity = values % 2
    number = np.cumsum([*parity[:1], *(parity[1:] != parity[:-1])])
    return number[place.reshape(priority.shape)].astype(np.int32)


def _parity(
    game: Model, priority: Array, num_priorities: int, safe: States, won: Array = None
) -> Parity:
    """A parity objective with unsafe states lost, except for won ones."""
    priority = priority if is_traced(priority) else np.asarray(priority)
    won = np.zeros(game.state_shape, bool) if won is None else won
    xp, priority, won, safe = namespace(priority, won, states_with_label(game, safe, "safe"))
    return Parity(
        priority=to_jax(xp.broadcast_to(priority.astype(np.int32), game.state_shape)),
        won=to_jax(won),
        lost=to_jax(~safe & ~won),
        num_priorities=num_priorities,
    )


def gr1(
    game: Model,
    assumptions: Sequence[States],
    guarantees: Sequence[States],
    *,
    safe: States = "true",
) -> GR1:
    """GR(1) objective ``G safe & ((G F A_1 & ... & G F A_M) -> (G F G_1 & ... & G F G_J))``.

    Args:
      game: the game.
      assumptions, guarantees: sets of states, arrays or Boolean formulas, without G and F.
      safe: states never to leave.

    Returns:
      :class:`GR1`.

    Raises:
      ValueError: an entry is not Boolean or mentions an unknown proposition.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.from_dense(np.roll(np.eye(3), 1, 1)[:, None], label={"a": [0], "b": [1, 2]})
      >>> jl.winning_region(path, gr1(path, ["a"], ["b", "!b"])).region.tolist()
      [True, True, True]
    """

    def rows(sets: Sequence[States], name: str) -> jax.Array:
        if isinstance(sets, str | Formula):
            raise ValueError(f"{name} is {str(sets)!r}; give a list of sets of states.")
        masks: list[Array] = [
            states_with_label(game, x, f"{name}[{i}]") for i, x in enumerate(sets)
        ]
        xp, *masks = namespace(*masks or [np.ones(game.state_shape, bool)])
        return jax_array(xp.stack(masks))

    _, inside = namespace(states_with_label(game, safe, "safe"))
    return GR1(
        assumptions=rows(assumptions, "assumptions"),
        guarantees=rows(guarantees, "guarantees"),
        lost=to_jax(~inside),
    )
