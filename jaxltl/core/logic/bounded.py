"""Path formulas with bounds or conditions, and reward objectives of properties."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Literal

from jaxltl.core.array_types import PyTree
from jaxltl.core.logic.ltl import FALSE, TRUE, Formula


@dataclass(frozen=True)
class Bounded:
    """A temporal operator on state formulas that must be decided within a bound.

    Attributes:
      operator: `"U"` or `"R"`. `F<=k b` is `true U<=k b`, and `G<=k b` is `false R<=k b`.
      left, right: Boolean formulas.
      lower, upper: the steps between which `right` counts, both included; without an upper
        bound None.
      reward: the name of the reward that is bounded in place of steps, empty for the only one
        that the model has; None for steps.
      limit: how much reward may be earned, for a reward.
      strict: whether it must be less than the limit.
    """

    operator: Literal["U", "R"]
    left: Formula
    right: Formula
    lower: int = 0
    upper: int | None = None
    reward: str | None = None
    limit: Fraction | None = None
    strict: bool = False

    def __str__(self) -> str:
        if self.reward is not None:
            name = f'{{"{self.reward}"}}' if self.reward else "{}"
            bound = f"{name}{'<' if self.strict else '<='}{self.limit}"
        elif self.upper is None:
            bound = f">={self.lower}"
        else:
            bound = f"[{self.lower},{self.upper}]" if self.lower else f"<={self.upper}"
        left, right = (f"({f})" if len(f.operands) > 1 else str(f) for f in (self.left, self.right))
        if self.operator == "U" and self.left == TRUE:
            return f"F{bound} {right}"
        if self.operator == "R" and self.left == FALSE:
            return f"G{bound} {right}"
        return f"{left} {self.operator}{bound} {right}"


@dataclass(frozen=True)
class Conditional:
    """A path formula given another one, written `F "a" || F "b"` as in Storm."""

    event: Formula
    condition: Formula

    def __str__(self) -> str:
        return f"{self.event} || {self.condition}"


@dataclass(frozen=True)
class Recognized:
    """The paths that a deterministic automaton accepts, `HOA: {"file.hoa", "a" <- x=1}`.

    Attributes:
      automaton: an :class:`~jaxltl.core.automata.automaton.Automaton` over labels and definitions.
      negated: whether it must reject them.
      text: as it was written.
    """

    automaton: PyTree  # of a module above
    negated: bool
    text: str

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class Earned:
    """A reward objective other than the reward until a target is reached.

    Attributes:
      kind: `"total"` (`C`), `"cumulative"` (`C<=k`: in the first k steps), `"instantaneous"`
        (`I=k`: in the step after k steps) or `"average"` (`S`, `LRA`: in the long run).
      steps: k.
    """

    kind: Literal["total", "cumulative", "instantaneous", "average"]
    steps: int | None = None

    def __str__(self) -> str:
        return {
            "total": "C",
            "cumulative": f"C<={self.steps}",
            "instantaneous": f"I={self.steps}",
            "average": "LRA",
        }[self.kind]


def unfolded(path: Bounded) -> Formula:
    """Unfolds step bounds: `a U[l,u] b = a & X(a U[l-1,u-1] b)`; likewise `U<=u`, and `R` dually."""
    if path.operator == "R":
        left = TRUE if path.left == FALSE else ~path.left
        return ~unfolded(replace(path, operator="U", left=left, right=~path.right))
    left, right = path.left, path.right

    def step(rest: Formula) -> Formula:
        ahead = Formula("X", (rest,))
        return ahead if left == TRUE else left & ahead

    if path.upper is None:
        path_value = Formula("U", (left, right))
    else:
        path_value = right
        for _ in range(path.upper - path.lower):
            path_value = right | step(path_value)
    for _ in range(path.lower):
        path_value = step(path_value)
    return path_value
