"""Checks of questions by what is known while a program is traced: names, shapes, and constant numbers."""

from __future__ import annotations

import math
from typing import cast

import numpy as np

from jaxltl.core import validation
from jaxltl.core.logic.labels import require_known, satisfying
from jaxltl.core.logic.ltl import as_formula
from jaxltl.core.models.construct.state_formulas import BUILT_IN
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.ops.operators import is_deterministic
from jaxltl.core.models.protocols import Array, Model, SuccessorModel, base_model
from jaxltl.core.models.sparse import Reward, Rewards, SparseMDP, reward_structure
from jaxltl.core.types import require_states
from jaxltl.core.values.door.question import (
    Acceptance,
    NextStep,
    Question,
    Reach,
    ReachWithin,
    TotalReward,
    Until,
    require_infinite,
)


def require_known_parts(model: Model, question: Question) -> None:
    """Raises ValueError for what no numbers can make right: names, shapes, and constant numbers."""
    path, world = question.path, base_model(model)
    for name in ("target", "stay"):
        states = getattr(path, name, None)
        if isinstance(states, str):
            _require_formula(world, states, name)
        elif states is not None:
            require_states(name, states, model.state_shape)
    if isinstance(path, TotalReward) and isinstance(world, IntervalMDP):
        require_infinite(path)
    if not isinstance(path, Reach | Until | Acceptance | NextStep | ReachWithin):
        _require_reward(model, path.reward)
    steps, bound = getattr(path, "num_steps", None), getattr(path, "bound", None)
    if steps is not None and not is_traced(steps):
        validation.integer("num_steps", steps)
    if bound is not None and not is_traced(bound):
        limits = validation.Range(0, math.inf, open_above=True)
        validation.require_in_range("bound", bound, limits)
    if question.policy is not None:
        _require_policy(model, question.policy)


def _require_formula(world: Model, condition: str, name: str) -> None:
    formula = as_formula(condition)
    known = (*getattr(world, "propositions", ()), *BUILT_IN)
    require_known(formula.propositions, known, name)
    satisfying(np.zeros((0, len(known)), bool), known, formula, name)


def _rows(model: Model) -> tuple[SparseMDP | None, int]:
    """The sparse world of a model, if it has one, and the number of memory states."""
    world = base_model(model)
    nominal = world.nominal if isinstance(world, IntervalMDP) else world
    memory = model.num_states // cast(SuccessorModel, world).num_states
    return (nominal, memory) if isinstance(nominal, SparseMDP) else (None, memory)


def _require_reward(model: Model, reward: Reward) -> None:
    world, memory = _rows(model)
    if isinstance(reward, str | Rewards | None):
        if world is None:
            kind = type(base_model(model)).__name__
            raise ValueError(f"reward={reward!r}; {kind} has no named rewards; give an array.")
        if not isinstance(reward, Rewards):
            reward_structure(world, reward)
        return
    shape, states = np.shape(reward), model.state_shape
    if shape == states:
        return
    if world is not None:
        counts = world.num_states, world.num_rows, world.num_transitions
        if shape[:-1] == states or shape in [(memory * n,) for n in counts]:
            return
        raise ValueError(
            f"reward has shape {shape}; expected {states}, one number for each state, or one more axis "
            "for those of actions."
        )
    padded = cast(SuccessorModel, model)
    actions = (*states, padded.num_actions)
    if shape not in (actions, (*actions, padded.num_successors)):
        raise ValueError(f"reward has shape {shape}; expected {states} or {actions}.")


def _require_policy(model: Model, policy: Array) -> None:
    shape, states = np.shape(policy), model.state_shape
    flat = (states, (model.num_states,))
    if is_deterministic(policy):
        known = shape in flat
    else:
        world, memory = _rows(model)
        known = shape[:-1] in flat
        if world is not None:
            known |= shape in ((world.num_rows * memory,), (world.num_rows, memory))
    if not known:
        raise ValueError(
            f"policy has shape {shape}; expected {states}, an action for each state, or the weights of "
            "actions with one more axis."
        )
