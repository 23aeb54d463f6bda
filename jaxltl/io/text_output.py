"""Shared parts of the writers of text formats: names, labels and probabilities."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.models.interval import IntervalMDP, refuse_ball
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
    labels = dict(zip(model.propositions, label.T, strict=True))
    if not np.array_equal(labels.pop("init", where), where):
        raise ValueError(
            "the label 'init' is that of the initial states, and the model has "
            "another of this name; rename it."
        )
    return {"init": where, **labels}


def check_name(kind: str, name: str, reserved: str) -> None:
    """Raises ValueError for a name with control characters or reserved characters."""
    if any(c in reserved or ord(c) < 32 for c in name):
        raise ValueError(
            f"the {kind} {name!r} cannot be written: its name must not hold control "
            f"characters or any of {' '.join(reserved)!r}."
        )


def exact_part(model: SparseMDP | IntervalMDP) -> SparseMDP:
    """The nominal sparse model, without interval bounds."""
    return model.nominal if isinstance(model, IntervalMDP) else model


def value_texts(model: SparseMDP | IntervalMDP, comma: str) -> Callable[[slice], list[str]]:
    """Function from a slice of entries to probability texts, ``0.5`` or ``[0.4,0.6]``."""
    if not isinstance(model, IntervalMDP):
        probability = model.host.probability
        return lambda part: list(map(repr, probability[part].tolist()))
    refuse_ball(model, "the format holds intervals")
    lower, upper, form = model.host.lower, model.host.upper, f"[%r{comma}%r]"
    return lambda part: [
        form % ends for ends in zip(lower[part].tolist(), upper[part].tolist(), strict=True)
    ]
