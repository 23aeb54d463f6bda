"""The peer for probabilities and discounted values: Storm, through stormpy."""

from __future__ import annotations

import numpy as np
import stormpy
from stormpy import datastructures, environments, models

from jaxltl.core.models.mdp import MDP

METHODS = {
    "value_iteration": environments.MinMaxMethod.VALUE_ITERATION,
    "interval_iteration": environments.MinMaxMethod.INTERVAL_ITERATION,
    "sound_value_iteration": environments.MinMaxMethod.SOUND_VALUE_ITERATION,
    "optimistic_value_iteration": environments.MinMaxMethod.OPTIMISTIC_VALUE_ITERATION,
}


def build(mdp: MDP, reward: np.ndarray, labels: dict[str, np.ndarray]):
    """The same model in Storm's sparse form, parallel transitions merged."""
    successor = np.asarray(mdp.successor)
    num_states, num_actions, width = successor.shape
    order = np.argsort(successor, axis=2, kind="stable")
    rows = np.take_along_axis(successor, order, 2).reshape(-1, width).tolist()
    weights = np.take_along_axis(np.asarray(mdp.probability, np.float64), order, 2)
    weights = weights.reshape(-1, width).tolist()
    builder = datastructures.SparseMatrixBuilder(
        rows=num_states * num_actions,
        columns=num_states,
        entries=0,
        force_dimensions=False,
        has_custom_row_grouping=True,
        row_groups=0,
    )
    for row, (targets, values) in enumerate(zip(rows, weights, strict=True)):
        if row % num_actions == 0:
            builder.new_row_group(row)
        merged: dict[int, float] = {}
        for target, value in zip(targets, values, strict=True):
            if value > 0:
                merged[target] = merged.get(target, 0.0) + value
        for target, value in merged.items():
            builder.add_next_value(row, target, value)
    labeling = models.StateLabeling(num_states)
    labels = {"init": np.arange(num_states) == 0, **labels}
    for name, region in labels.items():
        labeling.add_label(name)
        states = [int(s) for s in np.flatnonzero(region)]
        labeling.set_states(name, datastructures.BitVector(num_states, states))
    rewards = models.SparseRewardModel(
        optional_state_action_reward_vector=np.asarray(reward, np.float64).ravel().tolist()
    )
    return models.SparseMdp(
        models.SparseModelComponents(
            transition_matrix=builder.build(),
            state_labeling=labeling,
            reward_models={"r": rewards},
        )
    )


def check(model, formula: str, method: str, precision: float) -> np.ndarray:
    """Values of a formula at all states, by a named method to an absolute precision."""
    environment = environments.Environment()
    solver = environment.solver().min_max()
    solver.method = METHODS[method]
    solver.precision = stormpy.Rational(precision)
    solver.relative_termination_criterion = False
    (parsed,) = stormpy.parse_properties(formula)
    result = stormpy.model_checking(model, parsed, environment=environment)
    return np.asarray(result.get_value_vector())
