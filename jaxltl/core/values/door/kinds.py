"""The kind of a model: its players, its container, and the place of its arrays."""

from __future__ import annotations

from typing import NamedTuple

from jaxltl.core import validation
from jaxltl.core.graphs.graph import is_table
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.mesh.sharded import is_sharded
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Model, PyTree, base_model
from jaxltl.core.models.sparse import SparseMDP


class ModelKind(NamedTuple):
    """The features of a model by which its engine is chosen."""

    is_game: bool  # whether there is a second player
    container: str  # "padded", "rows", "intervals", or "other" for models of users
    arrays: str  # "concrete", "traced" or "mesh"
    has_memory: bool  # whether it is a product
    is_partial: bool = False  # whether policies read observations

    @property
    def column(self) -> str:
        """The column of the table of engines."""
        place = "" if self.arrays == "concrete" else f"{self.arrays} "
        player = " game" if self.is_game else " pomdp" if self.is_partial else ""
        return f"{place}{self.container}{player}"

    def __str__(self) -> str:
        world = {"padded": "an MDP or a DenseMDP", "rows": "a SparseMDP", "other": "a user's model"}
        base = world.get(self.container, "an IntervalMDP")
        base = "a ShardedMDP" if self.arrays == "mesh" else base
        base = f"a game on {base}" if self.is_game else base
        base = "a POMDP" if self.is_partial else base
        base = f"a product of {base}" if self.has_memory else base
        return f"{base} with traced arrays" if self.arrays == "traced" else base


def kind_of(model: Model, question: PyTree = None) -> ModelKind:
    """The kind of a model that is asked with some arrays; ValueError for what is no model."""
    if isinstance(model, POMDP):
        arrays = "traced" if is_traced((model, question)) else "concrete"
        return ModelKind(False, "rows", arrays, False, is_partial=True)
    if not hasattr(model, "state_shape"):
        raise ValueError(validation.unsupported_model(model))
    is_game = has_memory = False
    lazy = model
    while isinstance(lazy, Game | Product):
        is_game |= isinstance(lazy, Game)
        has_memory |= isinstance(lazy, Product)
        lazy = lazy.mdp
    world = base_model(model)
    container = "padded" if is_table(world) else "other"
    if isinstance(world, SparseMDP | IntervalMDP):
        container = "rows" if isinstance(world, SparseMDP) else "intervals"
    if is_sharded(model):
        arrays, container = "mesh", "padded"
    else:
        arrays = "traced" if is_traced((model, question)) else "concrete"
    return ModelKind(is_game, container, arrays, has_memory)
