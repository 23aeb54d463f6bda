"""Sources of the rational numbers behind the doubles of a model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import compress
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans

from jaxltl.core.models.protocols import PyTree
from jaxltl.core.sparse.exact.model import ExactMDP

Part = Sequence[Fraction] | None  # of states, of choices or of transitions


class RationalNumbers(NamedTuple):
    """Rational numbers of a model."""

    mdp: ExactMDP
    rewards: dict[str, tuple[Part, Part, Part]]  # of states, choices and transitions, by name

    def select(self, rows: Booleans) -> RationalNumbers:
        """The numbers of some choices ``bool[R]``."""
        of_row = rows.tolist()
        of_entry = np.repeat(rows, [len(row) for row in self.mdp.rows]).tolist()
        counts = np.add.reduceat(rows.astype(np.int64), self.mdp.row_start[:-1])
        starts = [0, *np.cumsum(counts).tolist()]

        def kept(part: Part, marks: list[bool]) -> Part:
            return None if part is None else list(compress(part, marks))

        rewards = {
            name: (state, kept(choice, of_row), kept(transition, of_entry))
            for name, (state, choice, transition) in self.rewards.items()
        }
        return RationalNumbers(ExactMDP(starts, list(compress(self.mdp.rows, of_row))), rewards)


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
