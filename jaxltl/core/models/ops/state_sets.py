"""Sets of states as arguments: masks, labels and Boolean formulas of labels, concrete or traced."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxltl.core.logic.labels import require_known, satisfying
from jaxltl.core.logic.ltl import as_formula
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.ops.choices import state_mask
from jaxltl.core.models.ops.operators import unpadded_states
from jaxltl.core.models.protocols import Array, Model, PyTree, base_model


def state_set(model: Model, name: str, states: Array | str) -> Array:
    """A set of states ``bool[S]`` in the model's shape; ValueError for an unknown label or another shape."""
    if not isinstance(states, str) or not hasattr(model, "state_shape"):
        return state_mask(model, name, states)
    inner = base_model(model)
    world: PyTree = getattr(inner, "nominal", inner)
    shape, lazy_axes = model.state_shape, (1,) * (len(model.state_shape) - 1)
    if hasattr(world, "row_start") and not is_traced(world):
        inside: Array = states_satisfying(world, states, name)
        return np.broadcast_to(inside.reshape(-1, *lazy_axes), shape)
    formula, labels = as_formula(states), getattr(world, "propositions", ())
    used = formula.propositions
    require_known(used, (*labels, "init"), name)
    # The truth of the formula for each combination of its labels.
    place = np.arange(2 ** len(used))
    combinations = (place[:, None] >> np.arange(len(used))) & 1 > 0
    truth = satisfying(combinations, used, formula, name)
    xp = jnp if is_traced(world) or unpadded_states(world) is not True else np
    combination: Array = xp.zeros(world.num_states, xp.int32)
    for i, label in enumerate(used):
        column = world.label[:, labels.index(label)] if label in labels else world.initial > 0
        combination = combination + xp.where(column, 2**i, 0)
    inside = xp.asarray(truth)[combination] & unpadded_states(world)
    return xp.broadcast_to(inside.reshape(-1, *lazy_axes), shape)
