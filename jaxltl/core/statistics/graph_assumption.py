"""Assumptions on the graph of a model that is estimated from counted transitions.

Counts do not show that a transition without observations is impossible, so every guarantee names
its assumption on the graph.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

from jaxltl.core.pretty_print import brief
from jaxltl.core import validation
from jaxltl.core.validation import Range


@brief
@dataclass(frozen=True)
class LeastProbability:
    """The assumption that no possible transition is less likely than a given probability.

    At most ``1 / value`` transitions leave a choice. Each of them is unobserved in n samples with
    probability at most ``(1 - value) ** n``, so that with enough samples all are observed, except
    with probability `failure` for all choices together.

    Attributes:
      value: the least probability of a possible transition, in (0, 1].
      failure: the probability that the graph is wrong in spite of the assumption.

    Example:
      >>> LeastProbability(0.05, failure=0.01).sufficient_samples(num_choices=10)
      195
    """

    value: float
    failure: float = 0.005

    def __post_init__(self) -> None:
        validation.require_in_range("value", self.value, Range(0, 1, open_below=True))
        validation.require_in_range(
            "failure", self.failure, Range(0, 1, open_below=True, open_above=True)
        )

    def sufficient_samples(self, num_choices: int) -> int:
        """Number of samples of a choice by which all its transitions have been observed."""
        if self.value > 0.5:  # at most one transition
            return 1
        share = self.failure * self.value / max(num_choices, 1)
        return math.ceil(math.log(share) / math.log1p(-self.value)) + 1


Graph: TypeAlias = Literal["given", "seen", "complete"] | LeastProbability
_STATES = "there are no states but those that the log names"
_DESCRIPTION = {
    "given": "only transitions of the given model are possible",
    "seen": "only transitions that the log contains are possible",
    "complete": _STATES,
}


def require_graph(graph: object, known: tuple[str, ...] = ("given", "seen", "complete")) -> None:
    """Raises ValueError unless `graph` is a :class:`LeastProbability` or one of some words."""
    if not isinstance(graph, LeastProbability):
        validation.choice("graph", graph, known)


def describe_graph(graph: Graph) -> str:
    """The assumption in words, to be printed with every guarantee."""
    if isinstance(graph, LeastProbability):
        return f"no possible transition is less likely than {graph.value:g}, and {_STATES}"
    return _DESCRIPTION[graph]
