"""A property of a probabilistic model as it is parsed."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

from jaxltl.core.logic.bounded import Bounded, Conditional, Earned, Recognized
from jaxltl.core.logic.comparisons import Comparison
from jaxltl.core.logic.ltl import TRUE, Formula
from jaxltl.core.pretty_print import brief

Relation = Literal["<", "<=", ">", ">="]

# Kinds of filters: of truth values (True), of numbers (False), or of either.
FILTERS = {
    **dict.fromkeys(("min", "max", "argmin", "argmax", "avg", "sum", "range"), False),
    **dict.fromkeys(("forall", "exists", "count"), True),
    **dict.fromkeys(("first", "state", "print", "printall"), None),
}
MAX_UNFOLDED_STEPS = 100  # of a step bound inside a formula, which is unfolded into nested X


@brief(fields=("text",))
@dataclass(frozen=True)
class Property:
    """A question about a model: a number, or whether a number meets a threshold.

    Attributes:
      text: as it was written.
      operator: `"P"` (a probability), `"R"` (an expected reward), `"T"` (expected steps),
        `"LRA"` (the part of the time that a state formula holds in the long run), `"multi"`;
        `"E"`, `"A"` (some or all paths satisfy a formula), `"value"` (an expression of states).
      objective: `"max"`, `"min"`, or None where it is not said.
      nature: the second of two directions, `"max"` in `Pminmax`: the direction in which nature optimises the number
        within intervals; None where only one is said, or none.
      relation, threshold: the comparison, None for `=?`.
      reward: for `"R"`, the name, or None for the one without a name, or the only one of the model.
      path: for `"P"` a formula, a bounded or a conditional one, or a
        :class:`~jaxltl.core.logic.bounded.Recognized`, for `"T"` and `"R"` `F` of a state formula or
        an :class:`~jaxltl.core.logic.bounded.Earned`, for `"LRA"` a state formula.
      parts: of `"multi"`, its objectives.
      name: the name before the colon, or None.
      coalition: of a game, the players that choose for the objective, as in `<<system>> Pmax=?`, or None.
      universal: whether all strategies of the coalition are meant, `[[system]] P>=0.5`, and not one of them.
      unreached: of a reward until `F`, that of a run that never arrives: infinite (`F`), zero (`F0`) or the sum
        of its rewards (`Fc`).
      discount: of a reward `C{discount=d}` or `F{discount=d}`, the factor d of each step in [0, 1), or None; a run
        that never arrives is then worth the sum of its rewards.
      definitions: propositions of the formulas that are no labels: comparisons and nested properties.
      expression: of `"value"`, the expression.
      aggregate, among: of a filter, its kind, such as `"min"`, and the states that it is over.

    Example:
      >>> from jaxltl.core.logic.properties import parse_property
      >>> prop = parse_property('Pmax>=0.9 [ F "goal" ]')
      >>> prop.operator, prop.objective, prop.relation, str(prop.threshold), str(prop.path)
      ('P', 'max', '>=', '9/10', 'F goal')
    """

    text: str
    operator: Literal["P", "R", "T", "LRA", "multi", "E", "A", "value"]
    objective: Literal["max", "min"] | None = None
    relation: Relation | None = None
    threshold: Fraction | None = None
    reward: str | None = None
    path: Formula | Bounded | Conditional | Earned | Recognized = TRUE
    parts: tuple[Property, ...] = ()
    name: str | None = None
    nature: Literal["max", "min"] | None = None
    definitions: tuple[tuple[str, Comparison | Property], ...] = ()
    aggregate: str | None = None
    among: Formula = TRUE
    coalition: tuple[str, ...] | None = None
    universal: bool = False
    expression: Comparison | None = None
    unreached: Literal["infinite", "zero", "sum"] = "infinite"
    discount: Fraction | None = None

    @property
    def direction(self) -> Literal["max", "min"] | None:
        """The optimum that decides it: a lower threshold for all policies is one on the minimum.

        A coalition meets one with some policy, which is one on the maximum.
        """
        if self.objective is not None or self.relation is None:
            return self.objective
        exists = self.coalition is not None and not self.universal
        return "max" if (self.relation in (">", ">=")) == exists else "min"

    @property
    def is_number(self) -> bool:
        """True for a number, False for a truth value, as far as the text shows."""
        if self.aggregate in ("forall", "exists"):
            return False
        if self.aggregate == "count" or FILTERS.get(str(self.aggregate), True) is False:
            return True
        if self.expression is not None:
            return self.expression.is_number
        return self.relation is None

    def __str__(self) -> str:
        return self.text
