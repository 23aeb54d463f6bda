"""Turn-based stochastic games."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Generic

import chex
import jax
import numpy as np
from jaxltl.core import struct, validation

from jaxltl.core.pretty_print import brief
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.mdp import MDP, DenseMDP, support
from jaxltl.core.models.ops import operators
from jaxltl.core.models.ops.array_namespace import is_traced, to_jax
from jaxltl.core.models.ops.choices import choice_shape, choices
from jaxltl.core.models.protocols import (
    Arena,
    Array,
    Model,
    PyTree,
    base_model,
)
from jaxltl.core.models.sparse import SparseMDP


@brief(drawn=True)
@struct.dataclass
class Game(Generic[Arena]):
    """Turn-based stochastic game of the system against the environment; see :func:`make_game`.

    Attributes:
      mdp: an MDP, a DenseMDP, a SparseMDP, an IntervalMDP or a Product.
      system: ``bool[S]`` (``[S, Q]`` in a product), True in the states of the system, the maximiser.

    Example:
      >>> import jaxltl as jl
      >>> game = jl.make_game(jl.from_dense([[[0, 1.0]], [[1.0, 0]]]), [True, False])
      >>> game.num_states, game.system.tolist(), game.available.tolist()
      (2, [True, False], [[True], [True]])
    """

    mdp: Arena
    system: jax.Array

    num_states = property(attrgetter("mdp.num_states"), doc="S, or S times Q in a product.")
    num_actions = property(attrgetter("mdp.num_actions"), doc="A; ValueError for a sparse model.")
    num_successors = property(attrgetter("mdp.num_successors"), doc="K.")
    state_shape = property(
        attrgetter("mdp.state_shape"),
        doc="The shape of a value: ``(S,)``, or ``(S, Q)`` in a product.",
    )
    successor_probability = property(
        attrgetter("mdp.successor_probability"), doc="``float[S, A, K]``."
    )
    available = property(attrgetter("mdp.available"), doc="``bool[S, A]``.")
    initial = property(attrgetter("mdp.initial"), doc="``float[S]``, the initial distribution.")
    label = property(
        attrgetter("mdp.label"), doc="``bool[S, P]``, the propositions that hold in each state."
    )
    propositions = property(attrgetter("mdp.propositions"), doc="The P names.")
    dtype = property(attrgetter("mdp.dtype"), doc="The dtype of the probabilities.")


def make_game(model: Arena, system: Sequence[bool] | chex.Array) -> Game[Arena]:
    """Validated :class:`Game` on a model.

    Args:
      model, system: as the attributes of :class:`Game`.

    Returns:
      :class:`Game`.

    Raises:
      ValueError: a state without a player or an action, or a subnormal probability.

    Example:
      >>> from jaxltl import from_dense
      >>> make_game(from_dense([[[0, 1.0]], [[1.0, 0]]]), [True, False]).system.tolist()
      [True, False]
    """
    if not hasattr(model, "state_shape"):
        raise ValueError(validation.unsupported_model(model))
    owner = _owners(system, model.state_shape)
    if isinstance(base := base_model(model), MDP | DenseMDP) and not is_traced(base):
        support(base)  # refuses probabilities that underflow
    if not isinstance(model, SparseMDP | IntervalMDP):  # their states all have a choice
        check_moves(np.asarray(choices(model).available), owner)
    return Game(model, to_jax(owner))


def check_moves(available: np.ndarray, system: np.ndarray) -> None:
    """Raises ValueError, naming the state, if a player has no action."""
    stuck = np.argwhere(~available.any(-1))
    if stuck.size:
        state = tuple(int(i) for i in stuck[0])
        player = "system" if system[state] else "environment"
        raise ValueError(
            f"state {_name(state)} is the {player}'s and has no move; give it one, for "
            "example a loop to itself."
        )


def _name(state: tuple[int, ...]) -> str:
    return str(state[0]) if len(state) == 1 else str(state)


def _owners(system: Array, shape: tuple[int, ...]) -> np.ndarray:
    owner = np.asarray(system)
    if owner.shape != shape:
        least = min(owner.shape[0] if owner.ndim else 0, shape[0])
        missing = f" State {least} has no owner." if owner.ndim == 1 and least < shape[0] else ""
        raise ValueError(
            f"system has shape {owner.shape}; expected {shape}, the player of each state.{missing}"
        )
    if owner.dtype == bool:
        return owner
    flat = owner.ravel().tolist()
    for i, value in enumerate(flat):
        if value not in (0, 1):
            state = tuple(int(k) for k in np.unravel_index(i, shape))
            raise ValueError(
                f"state {_name(state)} has no owner: system is {value!r} there; give True (the "
                "system moves) or False (the environment moves)."
            )
    return owner.astype(bool)


def as_game(model: Model) -> Game:
    """The game itself, or a model as the game in which all states are the system's."""
    if not isinstance(model, Game):
        if not hasattr(model, "state_shape"):
            raise ValueError(validation.unsupported_model(model))
        model = Game(model, to_jax(np.ones(model.state_shape, bool)))
    return model


def as_padded_game(model: Model) -> Game:
    """The game of :func:`as_game`, with a sparse model padded, also that of a product."""
    game = as_game(model)
    arena, world = game.mdp, getattr(game.mdp, "mdp", None)
    if isinstance(arena, SparseMDP):
        game = replace(game, mdp=to_padded(arena))
    elif isinstance(world, SparseMDP):
        game = replace(game, mdp=replace(arena, mdp=to_padded(world)))
    return game


def is_deterministic(model: Model) -> bool:
    """True if each available action has one successor."""
    return not bool((support(base_model(model)).sum(-1) > 1).any())


# --- the primitives: those of the model -----------------------------------------------------


def _register_on_base(primitive: PyTree) -> None:
    primitive.register(Game, lambda game, *args, **options: primitive(game.mdp, *args, **options))


for _primitive in (
    choices,
    choice_shape,
    operators.combined,
    operators.expectation,
    operators.exists_successor,
    operators.forall_successor,
    operators.least_successor,
    operators.sample_successor,
    operators.induced_chain,
    operators.transition_matrix,
):
    _register_on_base(_primitive)
