"""Every concrete model as rows over flat states, and what a caller gives in the form of these rows.

A model, a product and a game of them become one :class:`RowForm`: sparse rows, the uncertainty sets of
interval models, and in a game the states of the system. Sets of states, rewards and policies of the
model are translated to it, and solutions back.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.models.action_numbers import row_actions
from jaxltl.core.models.construct.convert import keep_with_model, to_sparse
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP, make_interval
from jaxltl.core.models.ops.operators import is_deterministic, row_weights
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import ActionModel, Array, Model
from jaxltl.core.models.sparse import Reward, Rewards, SparseMDP, reward_structure
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.types import require_states
from jaxltl.core.values.engine.state_quantities import row_reward


@dataclass(frozen=True)
class RowForm:
    """A concrete model as rows over flat states ``s * Q + q``."""

    lazy: Model  # the model below a game: a product, or the world itself
    sparse: SparseMDP  # rows; of an interval model one distribution of each
    interval: IntervalMDP | None  # the same rows with intervals
    system: Booleans | None  # bool[S Q], in a game the states of the system

    @property
    def host(self) -> HostMDP:
        return self.sparse.host

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of a value."""
        return self.lazy.state_shape

    @property
    def world(self) -> Model:
        """The model below a product."""
        world: Model = self.lazy.mdp if isinstance(self.lazy, Product) else self.lazy
        return world

    @property
    def is_padded(self) -> bool:
        """True if solutions are in the dtype of the model; of rows and intervals they are float64."""
        return not isinstance(self.world, SparseMDP | IntervalMDP)

    @cached_property
    def uncertain(self) -> IntervalMDP:
        """The rows with intervals, which are points where probabilities are known."""
        if self.interval is not None:
            return self.interval
        probability = self.sparse.probability
        return make_interval(self.sparse, probability, probability)

    @cached_property
    def number(self) -> Integers:
        """The action number of each row, ``int[R]``."""
        return row_actions(self.sparse)

    def states(self, name: str, states: Array | str) -> Booleans:
        """A set of states ``bool[S Q]`` from a mask, a label's name or a Boolean formula of labels."""
        if isinstance(states, str):
            return states_satisfying(self.sparse, states, name)
        require_states(name, states, self.shape)
        return np.asarray(states, bool).ravel()

    def reward(self, reward: Reward) -> Rewards:
        """A reward of states, actions or transitions, or a name, on the rows."""
        return reward_structure(self.sparse, row_reward(self.lazy, self.sparse, reward))

    def weights(self, policy: Array) -> Floats:
        """A policy, in a game the system's, as checked weights of rows ``float64[R]``."""
        policy = np.asarray(policy)
        where = True if self.system is None else self.system
        if is_deterministic(policy):
            if policy.shape == self.shape:
                policy = policy.ravel()
        elif policy.shape[:-1] == self.shape:
            policy = policy.reshape(self.sparse.num_states, -1)
        elif isinstance(self.lazy, Product) and not self.is_padded:
            policy = self._of_world_rows(policy)
        return row_weights(self.sparse, policy, where, self.shape)

    def _of_world_rows(self, policy: Array) -> Array:
        """Weights ``float[R, Q]`` of a world's rows as those of the product's."""
        world = self.world
        if isinstance(world, IntervalMDP):
            world = world.nominal
        assert isinstance(world, SparseMDP)
        host = self.host
        count = self.shape[-1]
        if policy.shape != (world.num_rows, count):
            return policy
        state, memory = np.divmod(host.state, count)
        return policy[world.host.row_start[state] + self.sparse.rank, memory]

    def actions(self, row: Integers) -> Integers:
        """Rows ``int[S Q]`` as action numbers in the shape of the states."""
        return self.number[row].astype(np.int32).reshape(self.shape)


def row_form(model: Model) -> RowForm:
    """The rows of a concrete model, product, game or interval model."""
    if not hasattr(model, "state_shape"):
        raise ValueError(validation.unsupported_model(model))
    system, lazy = None, model
    if isinstance(model, Game):
        system, lazy = np.asarray(model.system, bool).ravel(), model.mdp
    world = lazy.mdp if isinstance(lazy, Product) else lazy
    if not isinstance(world, IntervalMDP):
        return RowForm(lazy, rows_of(lazy), None, system)
    if isinstance(lazy, Product):
        world = world.changed(lambda nominal: to_sparse(_product_of(lazy, nominal)))
    return RowForm(lazy, world.nominal, world, system)


def _product_of(product: Product, world: SparseMDP) -> Product:
    return Product(world, product.automaton, product.letter, product.label_on, product.allowed)


rows_of = keep_with_model(to_sparse)
"""The sparse rows of a concrete model, kept with it; a float32 model means its normalised rows."""


def on_rows(sparse: SparseMDP, quantity: Array) -> Array:
    """A quantity on actions ``[S, A]`` as one on rows ``[R]``."""
    flat = np.asarray(quantity).reshape(sparse.num_states, -1)
    return flat[sparse.host.state, row_actions(sparse)]


def on_actions(sparse: SparseMDP, quantity: Array, model: ActionModel) -> Array:
    """A quantity on rows ``[R]`` as one on actions ``[S, A]``, 0 at unavailable ones."""
    table = np.zeros((sparse.num_states, model.num_actions), quantity.dtype)
    table[sparse.host.state, row_actions(sparse)] = quantity
    return table.reshape(*model.state_shape, -1)


def row_of_action(sparse: SparseMDP, action: Array) -> Integers:
    """The rows ``int[S]`` of a policy of actions ``int[S]``; first rows where it has none."""
    chosen = np.asarray(action).ravel()[sparse.host.state] == row_actions(sparse)
    return sparse.host.first_choice(chosen)[1]
