"""One small case as models of every kind, with quantities in the shapes that each kind has."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

import jaxltl as jl
from tests import reference_matrix as reference
from tests.reference_matrix import Aims, Case


def padded(case: Case) -> jl.MDP:
    return jl.make_mdp(
        case.successor,
        case.probability,
        available=case.available,
        label=case.label,
        propositions=["a", "b"],
    )


def parametric(case: Case) -> jl.SparseMDP:
    """The instance of a model with one parameter."""
    rows = jl.to_sparse(padded(case))
    numbers = np.asarray(rows.probability)
    model = jl.make_parametric(rows, lambda x: numbers + 0 * x[0], [0.25], [0.75])
    return model.at([0.5])


def interval_rows(case: Case) -> jl.IntervalMDP:
    """The intervals on sparse rows, whose successors are in order."""
    rows = jl.to_sparse(padded(case))
    row, host = rows.host.row, rows.host
    state, action = host.state[row], np.asarray(rows.action)[row]
    same = case.successor[state, action] == host.successor[:, None]
    k = (same & (case.upper[state, action] > 0)).argmax(1)
    return jl.make_interval(rows, case.lower[state, action, k], case.upper[state, action, k])


BASES: dict[str, Callable[[Case], Any]] = {
    "chain": lambda case: jl.to_sparse(padded(case)),
    "MDP": padded,
    "dense": lambda case: jl.models.to_dense(padded(case)),
    "sparse": lambda case: jl.to_sparse(padded(case)),
    "instance": parametric,
    "interval": lambda case: jl.make_interval(padded(case), case.lower, case.upper),
    "rows": interval_rows,
}
ROWS = ("chain", "sparse", "instance", "interval", "rows")
KINDS = [(base, game, lazy) for lazy in (0, 1) for game in (0, 1) for base in BASES]


class Subject:
    """A model of some kind, and quantities in the shapes that its kind has."""

    def __init__(self, kind: tuple[str, int, int], case: Case, formula: str = "F b"):
        self.base, self.is_game, self.is_product = kind
        self.case, self.by_rows = case, self.base in ROWS
        self.has_intervals = self.base in ("interval", "rows")
        model = BASES[self.base](case)
        if self.is_game:
            model = jl.make_game(model, case.system)
        self.model = jl.product(model, formula) if self.is_product else model

    @cached_property
    def lazy(self):
        return self.model.mdp if self.is_game else self.model

    @property
    def memory(self) -> int:
        return self.lazy.num_memory if self.is_product else 1

    def mask(self, states: np.ndarray) -> np.ndarray:
        return np.repeat(states[:, None], self.memory, 1) if self.is_product else states

    @property
    def reward(self) -> np.ndarray:
        """Of actions, ``[S, A]`` or ``[S, Q, A]``."""
        return self.of_actions(self.case.reward)

    def of_actions(self, table: np.ndarray) -> np.ndarray:
        """A quantity of the actions of the world, ``[S, A]``."""
        table = np.repeat(table[:, None], self.memory, 1)  # [S, Q, A]
        return table if self.is_product else table[:, 0]

    @property
    def policy(self) -> np.ndarray:
        """Actions in the states of the model."""
        return self.mask(self.case.policy.astype(np.int32))

    def aims(self, objective: str, nature: str | None = None) -> Aims:
        system = 1 if objective == "max" else -1
        towards = system if nature == "cooperative" else -system
        return Aims(system, -system * self.is_game, towards * self.has_intervals)

    def optimum(self, value, objective="max", nature=None, policy=None) -> np.ndarray:
        return reference.optimum(self.case, self.aims(objective, nature), value, policy)
