"""The label "init", which marks the initial states in several formats."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.models.sparse import SparseMDP


def labels_with_init(model: SparseMDP) -> dict[str, NDArray[np.bool_]]:
    """Label masks ``bool[S]`` by name, with the initial states as "init" first."""
    initial, label = np.asarray(model.initial), np.asarray(model.label, bool)
    where = initial > 0
    if np.ptp(initial[where]) > 1e-12:
        raise ValueError(
            "the initial states are not equally likely, and the format has a set of "
            "them; add a state whose one choice leads to them."
        )
    found = dict(zip(model.propositions, label.T, strict=True))
    if not np.array_equal(found.pop("init", where), where):
        raise ValueError(
            "the label 'init' is that of the initial states, and the model has "
            "another of this name; rename it."
        )
    return {"init": where, **found}
