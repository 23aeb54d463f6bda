"""Arrays of the model of a program."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.language.expressions import Expression
from jaxltl.core.programs.explore import RewardParts
from jaxltl.core.programs.local_choices import Weight


@dataclass(frozen=True)
class ProgramRows:
    """Arrays of a model before its probabilities are numbers."""

    # as of `~jaxltl.core.models.sparse.make_sparse`; `weight` has probabilities, their
    # intervals [T, 2], or numbers of functions
    row_start: Integers
    entry_start: Integers
    successor: Integers
    weight: Weight
    annotations: dict[str, Any]  # keyword arguments of make_sparse other than rewards
    # by name the parts on states and choices, None where they are zero
    rewards: dict[str, RewardParts]
    functions: tuple[Expression, ...]  # of a program with parameters, expressions by number
    owner: Integers | None  # int32[S], the number of the player of each state of a game
    observables: dict[str, NDArray[Any]] = field(default_factory=dict)  # [S] each, of a pomdp
