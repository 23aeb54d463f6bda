"""Storm as an oracle: sparse models and properties given to it, bounds by its sound methods."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.core.models.sparse import SparseMDP


def storm_model(model: SparseMDP) -> Any:
    """The same model in Storm, with its labels and rewards of states and choices."""
    from stormpy import datastructures, models

    host, chain = model.host, model.is_chain
    builder = datastructures.SparseMatrixBuilder(
        rows=host.num_rows,
        columns=host.num_states,
        entries=host.num_transitions,
        force_dimensions=True,
        has_custom_row_grouping=not chain,
        row_groups=0,
    )
    for row in range(host.num_rows):
        if not chain and row == host.row_start[host.state[row]]:
            builder.new_row_group(row)
        for e in range(host.entry_start[row], host.entry_start[row + 1]):
            builder.add_next_value(row, int(host.successor[e]), float(host.probability[e]))
    labels = models.StateLabeling(host.num_states)
    shown = {
        "init": np.asarray(model.initial) > 0,
        **{name: model.states_with_label(name) for name in model.propositions},
    }
    for name, region in shown.items():
        labels.add_label(name)
        labels.set_states(
            name,
            datastructures.BitVector(host.num_states, [int(s) for s in np.flatnonzero(region)]),
        )
    rewards = {}
    for name, given in model.rewards.items():
        assert given.transition is None
        rewards[name] = models.SparseRewardModel(
            **{
                key: np.asarray(x).tolist()
                for key, x in (
                    ("optional_state_reward_vector", given.state),
                    ("optional_state_action_reward_vector", given.choice),
                )
                if x is not None
            }
        )
    parts = models.SparseModelComponents(
        transition_matrix=builder.build(), state_labeling=labels, reward_models=rewards
    )
    return (models.SparseDtmc if chain else models.SparseMdp)(parts)


def storm_values(model: Any, text: str) -> list[Any]:
    """What Storm finds for a property in the initial states: numbers, or truth of a threshold."""
    import stormpy
    from stormpy import environments

    (prop,) = stormpy.parse_properties(text)
    result = stormpy.model_checking(
        model, prop, only_initial_states=True, environment=environments.sound()
    )
    if hasattr(result, "get_truth_values_vector"):
        values = result.get_truth_values_vector()
        return [bool(values[state]) for state in model.initial_states]
    return [result.get_value(state) for state in model.initial_states]
