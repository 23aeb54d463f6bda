"""Protocols of models: the attributes that operators, solvers and learners read.

=======================  ========================================================================
:class:`Model`           states and initial distribution: every model
:class:`LabelledModel`    and propositions: every model but a product
:class:`ActionModel`     and padded actions ``[S, A]``: MDP, DenseMDP, ShardedMDP, and products of
                         them; the attributes raise ValueError for models with sparse rows
:class:`SuccessorModel`  and padded successors ``[S, A, K]``: MDP, DenseMDP, and products of them
:class:`RowModel`        and sparse rows of choices ``[R]``: SparseMDP, IntervalMDP
=======================  ========================================================================

A game satisfies what its model does. Quantities on states have the shape ``state_shape``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

import numpy as np

from jaxltl.core.array_types import Key as Key, Numeric as Numeric, PyTree as PyTree

Array: TypeAlias = Any  # a NumPy array or a JAX array, which share their operators


class Model(Protocol):
    """States with an initial distribution; operators give the transition probabilities."""

    @property
    def num_states(self) -> int:
        """S, or S Q in a product."""

    @property
    def state_shape(self) -> tuple[int, ...]:
        """The shape of a value: ``(S,)``, or ``(S, Q)`` in a product."""

    @property
    def initial(self) -> Array:
        """``float[S]``, the initial distribution."""

    @property
    def dtype(self) -> np.dtype:
        """The dtype of the probabilities."""


class LabelledModel(Model, Protocol):
    """A model with atomic propositions as labels of its states."""

    @property
    def label(self) -> Array:
        """``bool[S, P]``, the propositions that hold in each state."""

    @property
    def propositions(self) -> tuple[str, ...]:
        """The P names."""


class ActionModel(Model, Protocol):
    """A model with the same number of actions in each state, some of them unavailable."""

    @property
    def num_actions(self) -> int:
        """A."""

    @property
    def available(self) -> Array:
        """``bool[S, A]``."""


class SuccessorModel(ActionModel, Protocol):
    """A model with padded lists of successors."""

    @property
    def num_successors(self) -> int:
        """K."""

    @property
    def successor_probability(self) -> Array:
        """``float[S, A, K]``, zero in padding and at unavailable actions."""


class RowModel(LabelledModel, Protocol):
    """A model with choices as rows without padding."""

    @property
    def row_start(self) -> Array:
        """``int32[S + 1]``, where the rows of each state begin."""

    @property
    def num_rows(self) -> int:
        """R."""

    @property
    def num_transitions(self) -> int:
        """T."""

    @property
    def is_chain(self) -> bool:
        """True for a Markov chain: one row in each state."""

    @property
    def rewards(self) -> Mapping[str, PyTree]:
        """Reward structures by name."""

    def states_with_label(self, proposition: str) -> Array:
        """``bool[S]``, the states in which a proposition holds."""


ModelT = TypeVar("ModelT", bound=Model)

if TYPE_CHECKING:
    from typing_extensions import TypeVar as DefaultTypeVar

    # The model of a product or of a game; of a plain Product or Game any model.
    World = DefaultTypeVar("World", bound=LabelledModel, default=Any)
    Arena = DefaultTypeVar("Arena", bound=Model, default=Any)
else:  # Python 3.13 has defaults
    World, Arena = TypeVar("World"), TypeVar("Arena")


def base_model(model: Model) -> Model:
    """The model below all products and games."""
    while hasattr(model, "mdp"):
        model = model.mdp
    return model
