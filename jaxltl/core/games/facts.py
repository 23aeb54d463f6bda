"""Text representations of objectives, regions and strategies of games."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxltl.core.pretty_print import array_text, count, nested_repr, readable, value_range, describe

_INNER = 92


def parity(value: Any) -> Iterator[str]:
    """Facts of a parity objective."""
    yield f"priorities below {value.num_priorities}"
    yield count(value.priority.size, "state")
    for name in ("won", "lost"):
        yield f"{name} {value_range(getattr(value, name))}"


def gr1(value: Any) -> Iterator[str]:
    """Facts of a GR(1) objective."""
    yield count(value.assumptions.shape[-2], "assumption")
    yield count(value.guarantees.shape[-2], "guarantee")
    yield count(value.lost.shape[-1], "state")
    yield f"lost {value_range(value.lost)}"


def winning(value: Any) -> Iterator[str]:
    """Facts of winning regions."""
    region = readable(value.region)
    if region is None:
        yield f"region {array_text(value.region)}"
    else:
        wins = int(np.count_nonzero(region))
        yield f"the system wins from {wins:,} of {count(region.size, 'state')}"
        yield f"the environment from {region.size - wins:,}"
    initial = readable(value.game.initial)
    if region is not None and initial is not None and initial.shape == region.shape:
        yield "realizable" if (region | (initial <= 0)).all() else "not realizable"
    memories = value.action.shape[len(value.region.shape) :]
    if memories:
        yield f"strategies with {memories[0]} and {value.counter_action.shape[-1]} memories"
    yield nested_repr(value.objective, _INNER)
    yield nested_repr(value.game, _INNER)


def permissive(value: Any) -> Iterator[str]:
    """Facts of a permissive strategy."""
    region = readable(value.region)
    if region is None:
        yield f"region {array_text(value.region)}"
    else:
        yield f"wins from {np.count_nonzero(region):,} of {count(region.size, 'state')}"
    yield f"allowed {describe(value.allowed)}"
    yield value.reason
    yield nested_repr(value.game, _INNER)
