"""Answers to properties, and their strategies."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxltl.core.models.protocols import Array
from jaxltl.core.pretty_print import bounds_text, brief, count, truncate, value_range
from jaxltl.core.types import Status
from jaxltl.core.values.undiscounted.sparse_satisfaction import Satisfaction


@brief
class PropertyStrategy(NamedTuple):
    """An optimal strategy of a property.

    Attributes:
      row: chosen rows ``int32[S]`` of the model; with a memory, ``int32[N]`` of the product.
      by: ``"steps"`` or ``"reward"`` if the strategy also depends on the remaining steps or
        reward, and `row` is its first choice; else empty.
      memory: the product and its automaton, or None.
      nature: of an interval model, nature's distributions ``float64[T]`` of the model or product.

    Example:
      >>> import jaxltl as jl
      >>> safe_or_not = jl.make_sparse([0, 2, 3, 4], [0, 1, 3, 4, 5], [1, 1, 2, 1, 2],
      ...                           [1, 0.5, 0.5, 1, 1], initial=[1, 0, 0], label={"a": [1]})
      >>> jl.solve_property(safe_or_not, 'Pmin=? [ F "a" ]').strategy.row.tolist()  # in each state
      [1, 2, 3]
    """

    row: np.ndarray
    by: str = ""
    memory: Satisfaction | None = None
    nature: Array | None = None


def _facts(value: Answer) -> Iterator[str]:
    yield value.status.name
    yield count(len(value.states), "state")
    yield f"value {value_range(value.value)}"
    yield bounds_text(value.lower, value.upper)
    if value.holds is not None:
        yield f"holds {truncate(str(value.holds))}"
    yield f"by {value.method}"


@brief(facts=_facts)
class Answer(NamedTuple):
    """The result of a property.

    Attributes:
      states: ``int[I]``; ``[-1]`` for a filter of no single state, such as a sum.
      value, lower, upper: ``float64[I]``, with certified bounds.
      holds: truth of a threshold in each state; None where the bounds do not decide it.
      status: CONVERGED if all bounds are within the tolerance, or decide the threshold.
      method: the algorithm and the proof.
      strategy: an optimal strategy; None in chains.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                    initial=[1, 0, 0], label={"a": [1]})
      >>> found = jl.solve_property(coin, 'P>=0.4 [ F "a" ]')
      >>> found.states.tolist(), found.value.tolist(), found.holds, found.status.name
      ([0], [0.5], [True], 'CONVERGED')
    """

    states: np.ndarray
    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    holds: list[bool | None] | None
    status: Status
    method: str
    strategy: PropertyStrategy | None
