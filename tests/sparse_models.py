"""Random sparse models, and the same models in Storm."""

from fractions import Fraction

import numpy as np

from jaxltl.core.models.sparse import Rewards, SparseMDP, make_sparse

BEST = {"max": np.maximum, "min": np.minimum}


def random_sparse(rng, num_states, *, chain=False, most=3, width=3, fractions=None, **parts):
    """A random model; with probabilities in multiples of ``1 / fractions`` where that is given."""
    count = np.ones(num_states, int) if chain else rng.integers(1, most + 1, num_states)
    widths = rng.integers(1, width + 1, count.sum())
    start = np.concatenate([[0], widths.cumsum()])
    successor = np.concatenate([rng.choice(num_states, w, replace=False) for w in widths])
    probability = rng.random(start[-1]) + 0.05
    if fractions:
        probability = (
            np.concatenate([rng.multinomial(fractions - w, np.ones(w) / w) + 1 for w in widths])
            / fractions
        )
    else:
        probability /= np.repeat(np.add.reduceat(probability, start[:-1]), widths)
    row_start = None if chain else np.concatenate([[0], count.cumsum()])
    return make_sparse(row_start, start, successor, probability, **parts)


def exact_matrix(model: SparseMDP) -> list[list[Fraction]]:
    """Transition probabilities as fractions, ``[R][S]``."""
    found = [[Fraction(0)] * model.num_states for _ in range(model.num_rows)]
    for r in range(model.num_rows):
        for e in range(*model.entry_start[r : r + 2]):
            found[r][model.successor[e]] = Fraction(float(model.probability[e]))
    return found


def exact_solve(matrix: list[list[Fraction]], b: list[Fraction]) -> list[Fraction]:
    """A regular system by elimination in fractions."""
    n = len(b)
    rows = [[*row, x] for row, x in zip(matrix, b, strict=True)]
    for i in range(n):
        pivot = next(j for j in range(i, n) if rows[j][i])
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for j in range(n):
            if j != i and rows[j][i]:
                factor = rows[j][i]
                rows[j] = [x - factor * y for x, y in zip(rows[j], rows[i], strict=True)]
    return [row[-1] for row in rows]


def storm_model(model: SparseMDP, labels=None, rewards=None):
    """The model in Storm, with labels ``bool[S]`` and rewards; runs begin in state 0."""
    from stormpy import datastructures, models

    builder = datastructures.SparseMatrixBuilder(
        rows=model.num_rows,
        columns=model.num_states,
        entries=0,
        force_dimensions=False,
        has_custom_row_grouping=not model.is_chain,
        row_groups=0,
    )
    for s in range(model.num_states):
        if not model.is_chain:
            builder.new_row_group(int(model.row_start[s]))
        for r in range(*model.row_start[s : s + 2]):
            for e in range(*model.entry_start[r : r + 2]):
                builder.add_next_value(r, int(model.successor[e]), float(model.probability[e]))
    labeling = models.StateLabeling(model.num_states)
    for name, region in {"init": np.arange(model.num_states) == 0, **(labels or {})}.items():
        labeling.add_label(name)
        chosen = [int(s) for s in np.flatnonzero(region)]
        labeling.set_states(name, datastructures.BitVector(model.num_states, chosen))
    parts = {
        "transition_matrix": builder.build(),
        "state_labeling": labeling,
        "reward_models": {name: _storm_reward(models, x) for name, x in (rewards or {}).items()},
    }
    kind = models.SparseDtmc if model.is_chain else models.SparseMdp
    return kind(models.SparseModelComponents(**parts))


def _storm_reward(models, reward: Rewards):
    parts = {
        "optional_state_reward_vector": reward.state,
        "optional_state_action_reward_vector": reward.choice,
    }
    return models.SparseRewardModel(
        **{name: np.asarray(x).tolist() for name, x in parts.items() if x is not None}
    )


def storm_values(storm, text: str, environment=None) -> np.ndarray:
    """What Storm says of a property, in every state."""
    import stormpy

    (question,) = stormpy.parse_properties(text)
    options = {} if environment is None else {"environment": environment}
    found = stormpy.model_checking(storm, question, only_initial_states=False, **options)
    return np.asarray(found.get_value_vector())
