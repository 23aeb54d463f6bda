"""Any model as sparse rows: exact or uncertain, of one player or two, under a policy or not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.models.compiled import is_sparse
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Reward, Rewards, SparseMDP, reward_structure
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.types import Solution
from jaxltl.core.values.engine.host_solution import policy_weights, with_given_policy
from jaxltl.core.values.engine.state_quantities import reduction_for, row_reward
from jaxltl.core.values.interval.robust import nature_direction, refuse_nature


@dataclass(frozen=True)
class ModelRows:
    """Rows of a model with the owners of its states; see :func:`model_rows`."""

    shape: tuple[int, ...]  # of the states
    lazy: Model  # the model without its players
    sparse: SparseMDP
    sets: UncertainMDP | None  # of models with intervals
    is_system: Booleans  # bool[S]
    maximizes: Booleans  # bool[S], the states of the maximising player
    nature: str | None  # its direction, "max" or "min"

    @property
    def _by_rows(self) -> bool:
        return is_sparse(self.lazy) or self.sets is not None

    def rewards(self, reward: Reward) -> Rewards:
        """A reward of the model, on its rows."""
        if not isinstance(reward, str | Rewards | None) and np.shape(reward) == self.shape:
            reward = Rewards(state=np.ravel(reward))
        if self.sets is None:
            reward = row_reward(self.lazy, self.sparse, reward)
        return reward_structure(self.sparse, reward)

    def weights(self, policy: Array) -> Array:
        """The system's policy as checked weights of rows, ``float64[R]``."""
        return policy_weights(
            self.lazy, self.sparse, policy, by_rows=self._by_rows, where=self.is_system
        )

    def shaped(self, solution: Solution, policy: Array | None) -> Solution:
        """A solution of the rows in the model's shape, with the policy if one was given."""
        row: Integers = np.asarray(solution.policy)
        choice = row if self._by_rows else np.asarray(self.sparse.action)[row]
        parts: dict[str, Array] = {
            name: getattr(solution, name).reshape(self.shape)
            for name in ("value", "lower", "upper")
        }
        parts["policy"] = choice.astype(np.int32).reshape(*row.shape[:-1], *self.shape)
        solution = replace(solution, **parts)
        return solution if policy is None else with_given_policy(solution, policy)


def model_rows(model: Model, objective: str, nature: str | None) -> ModelRows:
    """Rows of any model, with the directions of its players.

    Raises:
      ValueError: the objective, or `nature` of a model without intervals.
    """
    reduction_for(objective)
    lazy = model.mdp if isinstance(model, Game) else model
    world = lazy.mdp if isinstance(lazy, Product) else lazy
    sets = None
    if isinstance(world, IntervalMDP):
        nature = nature_direction(nature, objective)
        if isinstance(lazy, Product):
            product = lazy
            world = world.changed(lambda nominal: to_sparse(replace(product, mdp=nominal)))
        sparse, sets = world.nominal, world.host
    else:
        refuse_nature(nature)
        sparse = to_sparse(lazy)
    is_system = np.ones(sparse.num_states, bool)
    if isinstance(model, Game):
        is_system = np.asarray(model.system, bool).ravel()
    maximizes = is_system == (objective == "max")
    return ModelRows(model.state_shape, lazy, sparse, sets, is_system, maximizes, nature)
