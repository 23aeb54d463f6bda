"""Sources of the rational numbers behind the doubles of a model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import NamedTuple

from jaxltl.core.models.protocols import PyTree
from jaxltl.core.sparse.exact.model import ExactMDP

Part = Sequence[Fraction] | None  # of states, of choices or of transitions


class RationalNumbers(NamedTuple):
    """Rational numbers of a model."""

    mdp: ExactMDP
    rewards: dict[str, tuple[Part, Part, Part]]  # of states, choices and transitions, by name


@dataclass(frozen=True, eq=False)
class NumberSource:
    """The rational numbers behind the doubles of a model, found on demand.

    All sources are equal, so that models share compiled programs.
    """

    read: Callable[[PyTree], RationalNumbers | None] | None = None  # None: doubles mean themselves
    # The last model's arrays of successors and probabilities, and their numbers.
    known: list[tuple[object, object, RationalNumbers]] = field(default_factory=list, repr=False)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, NumberSource)

    def __hash__(self) -> int:
        return 0
