"""Reward structures of sparse models."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np

from jaxltl.core import struct
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.ops.kernels import gather
from jaxltl.core.models.protocols import Array
from jaxltl.core.pretty_print import brief


@brief
@struct.dataclass
class Rewards:
    """A reward structure, the sum of up to three parts; absent parts are zero.

    Attributes:
      state, choice, transition: ``float[S]``, ``float[R]`` and ``float[T]``, earned by each step from
        a state, by a choice and by a transition.

    Example:
      >>> import jaxltl as jl
      >>> steps = Rewards(state=[1, 1, 0])
      >>> model = jl.make_sparse(None, [0, 1, 2, 3], [1, 2, 2], [1, 1, 1], rewards={"steps": steps})
      >>> jl.total_reward(model, "steps", np.array([False, False, True])).value.tolist()
      [2.0, 1.0, 0.0]
    """

    state: Array | None = None
    choice: Array | None = None
    transition: Array | None = None

    def gathered(self, state: Array, choice: Array, transition: Array) -> Rewards:
        """The rewards at given indices of each part."""
        return Rewards(
            _taken(self.state, state),
            _taken(self.choice, choice),
            _taken(self.transition, transition),
        )


def _taken(x: Array | None, index: Array) -> Array | None:
    if x is None:
        return None
    return gather(x, index) if is_traced((x, index)) else np.asarray(x)[index]


Reward: TypeAlias = str | Rewards | Array | None


def default_reward(rewards: Mapping[str, object]) -> str:
    """The name of the reward that is meant without one: that without a name, or the only one."""
    if "" in rewards or len(rewards) == 1:
        return "" if "" in rewards else next(iter(rewards))
    raise ValueError(f"name the reward: the model has {listed_names(rewards)}.")


def listed_names(names: Mapping[str, object]) -> str:
    """Names for an error message, in quotes, or "none"."""
    return ", ".join(map(repr, names)) or "none"
