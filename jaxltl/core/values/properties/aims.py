"""Who chooses in a property, and in which direction: of any model that can be checked."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple, TypedDict

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans
from jaxltl.core.logic.properties import Property
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.multiplayer import MultiplayerGame
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.protocols import Model
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.values.engine.row_form import row_form

CheckableModel = SparseMDP | IntervalMDP | Game
SourceModel = CheckableModel | MultiplayerGame  # before a coalition is chosen

_Direction = Literal["max", "min"]
_OTHER: dict[str, _Direction] = {"max": "min", "min": "max"}


def checkable(model: Model | MultiplayerGame | POMDP) -> SourceModel:
    """Any concrete model with flat states, as sparse rows or intervals or a game on these."""
    if isinstance(model, SparseMDP | IntervalMDP):
        return model
    if isinstance(model, MultiplayerGame):
        owner = to_jax(np.asarray(model.owner).ravel())
        return MultiplayerGame(checkable(model.mdp), owner, model.players)
    if isinstance(model, POMDP):
        raise ValueError(validation.unsupported_model(model))
    form = row_form(model)
    inner = form.sparse if form.interval is None else form.interval
    return inner if form.system is None else Game(inner, to_jax(form.system))


def graph_of_model(model: SourceModel) -> SparseMDP:
    """All of a model but its players and intervals."""
    inner = model.mdp if isinstance(model, Game | MultiplayerGame) else model
    return inner.nominal if isinstance(inner, IntervalMDP) else inner


def of_coalition(model: SourceModel, prop: Property) -> tuple[CheckableModel, Property]:
    """The model of one or two players in which a property of a multi-player game is asked.

    A coalition whose players, or whose opponents, have no choices leaves a decision process; without
    a coalition all players are one. Two directions, as in ``Pmaxmin=?``, are those of two players.
    """
    if prop.coalition is not None and isinstance(model, SparseMDP):
        # All players are one, whose strategies a coalition without players may not choose.
        exists = prop.universal != bool(prop.coalition)
        alone = replace(prop, coalition=() if exists else None, universal=False)
        return model, replace(alone, coalition=None, objective=alone.direction)
    if prop.universal and prop.relation is None:
        ask = f"<<{', '.join(prop.coalition or ())}>>"
        raise ValueError(f"{prop.text}: [[...]] is for thresholds; ask for the number of {ask}.")
    if prop.universal and isinstance(model, Game):
        raise ValueError(f"{prop.text}: ask whether the other player can meet it, <<environment>>.")
    if not isinstance(model, MultiplayerGame):
        return model, prop
    if prop.universal:  # determined: the coalition cannot prevent what its opponents can enforce
        members = model.members(prop.coalition or ())
        others = (x for i, x in enumerate(model.players) if i not in members)
        prop = replace(prop, coalition=tuple(others), universal=False)
    two_players = len(model.players) == 2 and not isinstance(model.mdp, IntervalMDP)
    if prop.coalition is None and prop.nature is not None and two_players:
        together = prop.nature == prop.objective
        prop = replace(prop, nature=None, coalition=None if together else model.players[:1])
    if prop.coalition is None or prop.direction is None:
        if prop.coalition is not None:
            ask = f"<<{', '.join(prop.coalition)}>> {prop.operator}max=?"
            raise ValueError(f"{prop.text}: say what the coalition wants, as in {ask}.")
        return model.mdp, prop
    graph, direction = graph_of_model(model), prop.direction
    member = np.isin(model.owner, model.members(prop.coalition))
    choosing = np.diff(graph.host.row_start) > 1
    alone = replace(prop, coalition=None)
    if not (choosing & ~member).any():
        return model.mdp, replace(alone, objective=direction)
    if not (choosing & member).any():
        return model.mdp, replace(alone, objective=_OTHER[direction])
    two = replace(prop, objective=direction, coalition=("system",))
    return Game(model.mdp, to_jax(member)), two


class Directions(TypedDict, total=False):
    """Directions of the policy and of nature, as arguments of the solvers."""

    objective: str
    nature: str
    environment: str


class PropertyAim(NamedTuple):
    """Directions of the policy and of nature: ``"max"`` or ``"min"``."""

    policy: str
    nature: str | None = None
    environment: str | None = None  # of a game: "adversarial" or "cooperative"

    @property
    def opposite(self) -> PropertyAim:
        nature = None if self.nature is None else _OTHER[self.nature]
        return PropertyAim(_OTHER[self.policy], nature, self.environment)

    @property
    def directions(self) -> Directions:
        """Keyword arguments of the solvers."""
        aims: Directions = {"objective": self.policy}
        if self.nature is not None:
            aims["nature"] = "cooperative" if self.nature == self.policy else "adversarial"
        if self.environment is not None:
            aims["environment"] = self.environment
        return aims


def maximizers(model: CheckableModel, aim: PropertyAim) -> bool | Booleans:
    """Whether the value is maximised; in a game the states ``bool[S]`` in which it is."""
    up = aim.policy == "max"
    if not isinstance(model, Game):
        return up
    system = np.asarray(model.system, bool)
    return np.where(system, up, up == (aim.environment == "cooperative"))


def aim_of(model: CheckableModel, prop: Property) -> PropertyAim:
    """Directions of the system, nature and the environment; ValueError if the text lacks one of them."""
    sign = prop.operator + (f'{{"{prop.reward}"}}' if prop.reward else "")
    if isinstance(model, Game):
        return _game_aim(model, prop, sign)
    if prop.coalition is not None:
        raise ValueError(
            f"{prop.text}: the model is no game; leave out the coalition, <<...>>, or make one by "
            "make_game(model, system) or make_multiplayer_game(model, owner, players)."
        )
    if isinstance(model, IntervalMDP):
        return _robust_aim(model, prop, sign)
    if prop.nature is not None:
        raise ValueError(
            f"{prop.text}: the model has no intervals from which nature could pick; ask for "
            f"{sign}{prop.objective}=?."
        )
    if prop.direction is not None:
        return PropertyAim(prop.direction)
    if not model.is_chain:
        raise ValueError(
            f"{prop.text}: the model has states with several choices, so the value depends on a "
            f"strategy; ask for {sign}max=? or {sign}min=?."
        )
    return PropertyAim("max")


def _game_aim(model: Game, prop: Property, sign: str) -> PropertyAim:
    """The directions of the system, of its environment by the coalition, and of nature."""
    ask = f"<<system>> {sign}max=?"
    if prop.coalition is None:
        raise ValueError(
            f"{prop.text}: the model is a game, so the value depends on who chooses for it; ask for "
            f"{ask}, or for <<environment>>."
        )
    for player in prop.coalition:
        validation.choice("player", player, ("system", "environment"))
    if prop.direction is None:
        raise ValueError(f"{prop.text}: say what the coalition wants, as in {ask}.")
    members = set(prop.coalition)
    policy = prop.direction if not members or "system" in members else _OTHER[prop.direction]
    if not members:
        policy = _OTHER[policy]
    environment = "adversarial" if len(members) == 1 else "cooperative"
    if not isinstance(model.mdp, IntervalMDP):
        if prop.nature is not None:
            raise ValueError(f"{prop.text}: the model has no intervals; ask for {ask}.")
        return PropertyAim(policy, None, environment)
    if prop.nature is None:
        raise ValueError(
            f"{prop.text}: probabilities are intervals, so the value depends on what nature picks; give "
            f"its direction second, as in <<system>> {sign}maxmin=?."
        )
    return PropertyAim(policy, prop.nature, environment)


def _robust_aim(model: IntervalMDP, prop: Property, sign: str) -> PropertyAim:
    """Both directions; a threshold without them is over all strategies and choices of nature."""
    if prop.nature is not None:
        assert prop.objective is not None
        return PropertyAim(prop.objective, prop.nature)
    if prop.direction is not None and (model.is_chain or prop.objective is None):
        return PropertyAim(prop.direction, prop.direction)
    if model.is_chain:
        raise ValueError(
            f"{prop.text}: the probabilities of this chain are intervals, so the value depends on "
            f"what nature picks from them; ask for {sign}min=? or {sign}max=?."
        )
    firsts = ("max", "min") if prop.objective is None else (prop.objective,)
    listed = [f"{sign}{first}{second}=?" for first in firsts for second in ("min", "max")]
    raise ValueError(
        f"{prop.text}: probabilities are intervals, so the value depends on a strategy and on what "
        f"nature picks; ask for {', '.join(listed[:-1])} or {listed[-1]}, the strategy's direction "
        "first and nature's second."
    )
