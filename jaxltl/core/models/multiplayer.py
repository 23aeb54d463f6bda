"""Turn-based stochastic multi-player games, and the two-player games of coalitions."""

from __future__ import annotations

from collections.abc import Sequence
from operator import attrgetter
from typing import Generic

import chex
import jax
import numpy as np

from jaxltl.core import struct
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.protocols import Arena
from jaxltl.core.pretty_print import brief


@brief
@struct.dataclass
class MultiplayerGame(Generic[Arena]):
    """Turn-based stochastic multi-player game (SMG); see :func:`make_multiplayer_game`.

    A coalition of players makes it a two-player game, :meth:`game`, in which all other players are
    the opponent (Chen, Forejt, Kwiatkowska, Parker and Simaitis 2013).

    Attributes:
      mdp: the model of all choices, as of :class:`~jaxltl.core.models.game.Game`.
      owner: ``int32[S]``, the number of the player of each state.
      players: the names of the players; static.

    Example:
      >>> import jaxltl as jl
      >>> world = jl.from_dense([[[0, 1.0]], [[1.0, 0]]])
      >>> smg = jl.models.make_multiplayer_game(world, [0, 1], players=["p1", "p2"])
      >>> smg.players, smg.game(["p2"]).system.tolist(), smg.game([1]).system.tolist()
      (('p1', 'p2'), [False, True], [True, False])
    """

    mdp: Arena
    owner: jax.Array
    players: tuple[str, ...] = struct.field(pytree_node=False, default=())

    num_states = property(attrgetter("mdp.num_states"), doc="S.")
    initial = property(attrgetter("mdp.initial"), doc="``float[S]``, the initial distribution.")

    def members(self, coalition: Sequence[str | int]) -> tuple[int, ...]:
        """The places of the players of a coalition: names, numbers from 1, or ``"*"`` for all.

        Raises:
          ValueError: an unknown player.
        """
        if isinstance(coalition, str):
            raise ValueError(
                f"coalition is {coalition!r}; give a list of players, such as [{coalition!r}]."
            )
        everyone = range(len(self.players))
        if list(coalition) == ["*"]:
            return tuple(everyone)
        place = {name: i for i, name in enumerate(self.players)}
        # A name of digits comes before the number.
        place = {str(i + 1): i for i in everyone} | place
        for player in coalition:
            if str(player) not in place:
                listed = ", ".join(f"{name} ({i + 1})" for i, name in enumerate(self.players))
                raise ValueError(f"there is no player {player!r}; the players are {listed}.")
        return tuple(sorted({place[str(player)] for player in coalition}))

    def game(self, coalition: Sequence[str | int]) -> Game[Arena]:
        """The two-player game of a coalition, the system, against all other players.

        Args:
          coalition: names of players, or their numbers from 1; ``["*"]`` for all.

        Returns:
          :class:`~jaxltl.core.models.game.Game`.

        Raises:
          ValueError: an unknown player.
        """
        return Game(self.mdp, to_jax(np.isin(self.owner, self.members(coalition))))


def make_multiplayer_game(
    model: Arena, owner: Sequence[int] | chex.Array, players: Sequence[str]
) -> MultiplayerGame[Arena]:
    """Validated :class:`MultiplayerGame` on a model.

    Args:
      model: as of :func:`~jaxltl.core.models.game.make_game`.
      owner: ``int[S]``, the player of each state, by its place in `players` from 0.
      players: distinct names.

    Returns:
      :class:`MultiplayerGame`.

    Raises:
      ValueError: a state without a player or an action, or names that are not distinct.

    Example:
      >>> from jaxltl import from_dense, models
      >>> models.make_multiplayer_game(from_dense([[[1.0]]]), [0], ["only"]).owner.tolist()
      [0]
    """
    names = tuple(players)
    if isinstance(players, str) or len(set(names)) < len(names) or not names:
        raise ValueError(f"players is {players!r}; give distinct names, such as ['p1', 'p2'].")
    number = np.asarray(owner)
    if number.shape != model.state_shape or not np.issubdtype(number.dtype, np.integer):
        raise ValueError(
            f"owner has shape {number.shape} and dtype {number.dtype}; expected integers of shape "
            f"{model.state_shape}, the player of each state."
        )
    wrong = np.argwhere((number < 0) | (number >= len(names)))
    if wrong.size:
        state = tuple(wrong[0].tolist())
        raise ValueError(
            f"owner is {number[state]} in state {', '.join(map(str, state))}; give the place of a player "
            f"in players, from 0 to {len(names) - 1}."
        )
    make_game(model, number == 0)  # each state has a choice
    return MultiplayerGame(model, to_jax(number.astype(np.int32)), names)
