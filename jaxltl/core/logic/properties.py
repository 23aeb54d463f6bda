"""Properties of probabilistic models, in the syntax that PRISM and Storm share."""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Literal

from jaxltl.core.language.parser import SIMPLE
from jaxltl.core.logic.bounded import Bounded, Earned, unfolded
from jaxltl.core.logic.comparisons import Comparison, Definitions
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import FALSE, TRUE, Formula
from jaxltl.core.logic.property_tokens import ExpressionStream
from jaxltl.core.logic.property_tokens import Token
from jaxltl.core.pretty_print import brief

Relation = Literal["<", "<=", ">", ">="]

# Kinds of filters: of truth values (True), of numbers (False), or of either.
FILTERS = {
    **dict.fromkeys(("min", "max", "avg", "sum", "range"), False),
    **dict.fromkeys(("forall", "exists", "count"), True),
    **dict.fromkeys(("first", "state", "print"), None),
}
MAX_UNFOLDED_STEPS = 100  # of a step bound inside a formula, which is unfolded into nested X


@brief(facts=lambda self: [self.text])
@dataclass(frozen=True)
class Property:
    """A question about a model: a number, or whether a number meets a threshold.

    Attributes:
      text: as it was written.
      operator: `"P"` (a probability), `"R"` (an expected reward), `"T"` (expected steps),
        `"LRA"` (the part of the time that a state formula holds in the long run), `"multi"`.
      objective: `"max"`, `"min"`, or None where it is not said.
      nature: the second of two directions, `"max"` in `Pminmax`: the direction in which nature optimises the number
        within intervals; None where only one is said, or none.
      relation, threshold: the comparison, None for `=?`.
      reward: for `"R"`, the name, or None for the only one that the model has.
      path: for `"P"` a formula or a bounded one, for `"T"` and `"R"` `F` of a state formula or
        an :class:`~jaxltl.core.logic.bounded.Earned`, for `"LRA"` a state formula.
      parts: of `"multi"`, its objectives.
      name: the name before the colon, or None.
      definitions: propositions of the formulas that are no labels: comparisons and nested properties.
      aggregate, among: of a filter, its kind, such as `"min"`, and the states that it is over.

    Example:
      >>> asked = parse_property('Pmax>=0.9 [ F "goal" ]')
      >>> asked.operator, asked.objective, asked.relation, str(asked.threshold), str(asked.path)
      ('P', 'max', '>=', '9/10', 'F goal')
    """

    text: str
    operator: Literal["P", "R", "T", "LRA", "multi"]
    objective: Literal["max", "min"] | None = None
    relation: Relation | None = None
    threshold: Fraction | None = None
    reward: str | None = None
    path: Formula | Bounded | Earned = TRUE
    parts: tuple[Property, ...] = ()
    name: str | None = None
    nature: Literal["max", "min"] | None = None
    definitions: tuple[tuple[str, Comparison | Property], ...] = ()
    aggregate: str | None = None
    among: Formula = TRUE

    @property
    def direction(self) -> Literal["max", "min"] | None:
        """The optimum that decides it: a lower threshold for all policies is one on the minimum."""
        if self.objective is not None or self.relation is None:
            return self.objective
        return "min" if self.relation in (">", ">=") else "max"

    def __str__(self) -> str:
        return self.text


def parse_properties(text: str, definitions: Definitions | None = None) -> tuple[Property, ...]:
    """The properties that a text writes, one after the other; a `;` may end each.

    Of a probability: `Pmax=? [ PATH ]`, `Pmin=?`, `P=?`, or a threshold such as `P>=0.9` or
    `Pmax<1/3`. A path is any formula of linear temporal logic over labels in quotes, with
    `X F G U W R`; within `F G U W R` a bound on steps (`F<=10`, `U<10`, `F[2,5]`, `F=3`, `F>=4`)
    or, outermost, on a reward (`F{"time"}<=5 "goal"`). Of a reward: `R{"name"}max=? [ F "goal" ]`,
    `[ C ]`, `[ C<=10 ]`, `[ I=5 ]`, `[ S ]` or `[ LRA ]`. Expected steps: `Tmin=? [ F "goal" ]`.
    Time in the long run: `LRAmax=? [ "up" ]`. Several at once: `multi(P, P, ...)`.
    State formulas may also compare variables, `x + 1 < 2 * y`, and nest properties with thresholds,
    `P>=0.9 [ F P>0.5 [ X "a" ] ]`. A state formula is a property too. `filter(min, P=? [ F "a" ],
    x = 0)` is over the states of a formula, by default all: one of `min max avg sum count range
    first state forall exists print`.
    Where probabilities are intervals, the direction of the policy comes first and that of nature
    does second: `Pmaxmin=?`, `R{"time"}minmax=?`.

    From tightest to loosest: `!`, `&`, `|`, `<=>`, `=>`, the prefixes `X F G`, then `U W R`, then
    `&&` and `||`. So temporal operators reach as far as they can, as in PRISM and Storm:
    `G F "a" & "b"` is `G F ("a" & "b")`. A property may have a name, `"p1": ...`, and `//`
    begins a comment.

    A text may declare constants (``const int k = 3;``), formulas and labels as programs do, and
    write constants in place of numbers.

    Args:
      text: one property or several.
      definitions: names of a program that properties may use.

    Returns:
      The properties, in their order.

    Raises:
      ValueError: with the place of the first error and the expected tokens.

    Example:
      >>> (p,) = parse_properties('Pmax=? [ G F "a" & !"b" ]')
      >>> print(p.operator, p.objective, p.path)
      P max G F (a & !b)
      >>> print(*(q.direction for q in parse_properties('P>=0.9 [ X "a" ]; P<0.5 [ F<=3 "a" ]')))
      min max
    """
    if not isinstance(text, str):
        raise ValueError(f"parse_properties: expected text, got {type(text).__name__} {text!r}.")
    try:
        return _Parser(text, definitions or Definitions()).properties()
    except RecursionError:
        raise ValueError(
            "property: parentheses or operators are nested too deeply; split the formula."
        ) from None


def parse_property(text: str, definitions: Definitions | None = None) -> Property:
    """The one property in a text; see :func:`parse_properties`.

    Args:
      text: one property.
      definitions: names of a program that it may use.

    Returns:
      The property.

    Raises:
      ValueError: there is an error, or not exactly one property.

    Example:
      >>> print(parse_property('R{"steps"}min=? [ F "goal" ]').reward)
      steps
    """
    found = parse_properties(text, definitions)
    if len(found) != 1:
        raise ValueError(f"property: {text!r} holds {len(found)} properties; give one.")
    return found[0]


_OPERATOR = re.compile(r"(P|R|T|LRA|S)(max|min)?(max|min)?")
_DIRECTIONS = ("max", "min", "maxmax", "maxmin", "minmax", "minmin")


# --- grammar ----------------------------------------------------------------------------------

_Path = Formula | Bounded
_STATE = "a state formula: labels in quotes, true, false, ! & | => <=>"


class _Parser(ExpressionStream):
    """Recursive-descent parser; each method reads the construct of its name."""

    def __init__(self, text: str, known: Definitions) -> None:
        super().__init__(text, known)
        self.definitions: dict[str, Comparison | Property] = {}  # of the property being read

    # --- properties ---

    def properties(self) -> tuple[Property, ...]:
        found = []
        while self.token.kind != "end":
            if self.accept(";"):
                continue
            if self.token.text in ("const", "label", "formula") and self.token.kind == "word":
                self.declaration()
                continue
            name, before = None, self.place
            if self.token.kind == "quoted":
                name = self.quoted()
                if not self.accept(":"):  # it is a label
                    name, self.place = None, before
            found.append(self.outermost(name))
        if not found:
            raise self.error('a property, such as Pmax=? [ F "goal" ]')
        return tuple(found)

    def outermost(self, name: str | None) -> Property:
        """A property, or a state formula, which must hold in each initial state."""
        start, before = self.token, self.place
        begins_formula = start.kind == "quoted" or start.text in ("true", "false", "!", "(")
        if not begins_formula and start.text not in self.known.known | self.names.keys():
            found = self.property_(name)
            if found.relation is None or self.token.text not in ("&", "|", "=>", "<=>"):
                return found
            self.place = before
        return self.state_property(name)

    def state_property(self, name: str | None = None) -> Property:
        """A state formula as a property: with probability one, which is 0 or 1."""
        start, self.definitions = self.token, {}
        path = self.state_content()
        text = self.text[start.start : self.last.end]
        defined, self.definitions = tuple(self.definitions.items()), {}
        sure = Fraction(1)
        return Property(
            text, "P", relation=">=", threshold=sure, path=path, name=name, definitions=defined
        )

    def property_(self, name: str | None = None) -> Property:
        start, outer = self.token, self.definitions
        if self.accept("multi"):
            return self.multi(start, name)
        if self.accept("filter"):
            return self.filter(start, name)
        match = _OPERATOR.fullmatch(start.text) if start.kind == "word" else None
        if match is None:
            raise self.error("a property: P, Pmax, Pmin, R, Rmax, Rmin, T, LRA or multi(...)")
        self.take()
        operator, objective = ("LRA" if match[1] == "S" else match[1]), match[2]
        nature = match[3]
        reward = None
        if operator == "R":
            reward = self.known.rewards[0] if self.known.rewards else None
            if self.accept("{"):
                reward = self.reward_name()
                self.expect("}")
        if objective is None:  # R{"name"}max, with max after the name
            both = self.accept(*_DIRECTIONS) or ""
            objective, nature = both[:3] or None, both[3:] or None
        relation, threshold = self.comparison(operator)
        self.expect("[")
        self.definitions = {}
        path = _CONTENT[operator](self)
        defined, self.definitions = tuple(self.definitions.items()), outer
        self.expect("]", " or an operator")
        text = self.text[start.start : self.last.end]
        fields: dict[str, Any] = {"operator": operator, "objective": objective}
        fields |= {"relation": relation, "threshold": threshold, "reward": reward, "path": path}
        fields |= {"nature": nature, "definitions": defined}
        return Property(text, **fields, name=name)

    def multi(self, start: Token, name: str | None) -> Property:
        self.expect("(")
        parts = []
        while True:
            first = self.token
            parts.append(self.property_())
            if parts[-1].operator == "multi":
                raise self.error("a property with P or R; multi stands outermost", first)
            if parts[-1].nature is not None:
                raise self.error(
                    "one direction, max or min: several objectives are solved for "
                    "without intervals",
                    first,
                )
            if not self.accept(","):
                break
        self.expect(")", " or ','")
        text = self.text[start.start : self.last.end]
        defined = tuple(one for part in parts for one in part.definitions)
        return Property(text, "multi", parts=tuple(parts), name=name, definitions=defined)

    def filter(self, start: Token, name: str | None) -> Property:
        self.expect("(")
        place, kind = self.token, self.take().text
        if kind not in FILTERS:
            raise self.error(f"the kind of the filter: {', '.join(FILTERS)}", place)
        self.expect(",")
        first, self.definitions = self.token, {}
        asked, before = None, self.place
        if first.kind == "word" and _OPERATOR.fullmatch(first.text):
            asked = self.property_()
        if asked is None or self.token.text not in (",", ")"):  # it begins a state formula
            self.place = before
            asked = self.state_property()
        if FILTERS[kind] not in (None, asked.relation is not None):
            wanted = "a threshold or a state formula" if FILTERS[kind] else "a number, =?"
            raise self.error(f"{wanted} in a filter of this kind", first)
        among = self.state_content() if self.accept(",") else TRUE
        self.expect(")", " or ','")
        text = self.text[start.start : self.last.end]
        defined, self.definitions = (*asked.definitions, *self.definitions.items()), {}
        asked = replace(asked, text=text, name=name, definitions=defined)
        return replace(asked, aggregate=kind, among=among)

    def comparison(self, operator: str) -> tuple[str | None, Fraction | None]:
        if self.accept("="):
            self.expect("?", " after '='; to compare, use >= > <= or <")
            return None, None
        relation = self.accept("<=", ">=", "<", ">")
        if relation is None:
            raise self.error("=? or a threshold, such as >=0.9")
        start = self.token
        threshold = self.number(signed=operator == "R")
        if operator in ("P", "LRA") and not 0 <= threshold <= 1:
            raise self.error("a probability between 0 and 1", start)
        return relation, threshold

    # --- paths, from loosest to tightest ---

    def path(self) -> _Path:
        return self.chain(("||",), "|", self.path_conjunction)

    def path_conjunction(self) -> _Path:
        return self.chain(("&&",), "&", self.until)

    def until(self) -> _Path:
        left = self.prefixed()
        operator = self.accept("U", "W", "R")
        if operator is None:
            return left
        bound = self.bound()
        right = self.prefixed()
        if self.token.text in ("U", "W", "R") and self.token.kind == "word":
            raise self.error("parentheses around one of two U, W or R in a row")
        plain = self.plain(left), self.plain(right)
        return Formula(operator, plain) if bound is None else self.bounded(operator, plain, bound)

    def prefixed(self) -> _Path:
        operator = self.accept("X", "F", "G")
        if operator is None:
            return self.implication()
        start = self.token
        bound = self.bound()
        if bound is not None and operator == "X":
            raise self.error("a formula; X takes no bound", start)
        operand = self.plain(self.prefixed())
        if bound is None:
            return Formula(operator, (operand,))
        return self.bounded(operator, (operand,), bound)

    def implication(self) -> _Path:
        left = self.chain(("<=>",), "<->", self.disjunction)
        if not self.accept("=>"):
            return left
        right = self.chain(("<=>",), "<->", self.disjunction)
        if self.token.text == "=>":
            raise self.error("parentheses around one of two => in a row")
        return Formula("->", (self.plain(left), self.plain(right)))

    def disjunction(self) -> _Path:
        return self.chain(("|",), "|", self.conjunction)

    def conjunction(self) -> _Path:
        return self.chain(("&",), "&", self.atom)

    def chain(self, signs: tuple[str, ...], operator: str, operand: Callable[[], _Path]) -> _Path:
        first = operand()
        if self.token.text not in signs or self.token.kind != "sign":
            return first
        operands = [self.plain(first)]
        while self.accept(*signs):
            operands.append(self.plain(operand()))
        if operator == "<->":
            return functools.reduce(lambda f, g: Formula("<->", (f, g)), operands)
        return Formula(operator, tuple(operands))

    def atom(self) -> _Path:
        token = self.token
        if self.accept("!"):
            return ~self.plain(self.atom())
        if token.text == "(" and token.kind == "sign":
            return self.parentheses()
        if token.kind == "quoted":
            name = self.quoted()
            if not name:
                raise self.error("a label's name between the quotes", token)
            if name in self.labels:
                return self.defined(self.labels[name])
            return Formula("ap", proposition=name)
        if constant := self.accept("true", "false"):
            return Formula(constant)
        if token.kind == "word" and token.text in self.known.known | self.names.keys():
            return self.comparison_of_variables()
        if token.kind == "word" and token.text in "XFG":
            return self.prefixed()
        if token.kind == "word" and _OPERATOR.fullmatch(token.text):
            nested = self.property_()
            if nested.relation is None:
                raise self.error("a nested property with a threshold, such as P>=0.5", token)
            return self.defined(nested)
        if token.kind in ("word", "number") or token.text == "-":
            return self.comparison_of_variables()
        raise self.error("a label in quotes, true, false, '(', '!' or one of X F G")

    def defined(self, meaning: Comparison | Property) -> Formula:
        """A proposition that stands for a comparison or a nested property."""
        name = f"[{meaning.text}]"
        self.definitions[name] = meaning
        return Formula("ap", proposition=name)

    def parentheses(self) -> _Path:
        """A formula in parentheses, or a comparison that begins with one."""
        place, known = self.place, dict(self.definitions)
        try:
            self.expect("(")
            found = self.path()
            self.expect(")", " or an operator")
            if self.token.text in _AFTER_OPERAND:
                raise self.error("a Boolean operator")
            return found
        except ValueError:
            after, self.place, self.definitions = self.place, place, known
            with contextlib.suppress(ValueError):
                return self.comparison_of_variables()
            self.place = after
            raise

    def comparison_of_variables(self) -> Formula:
        start = self.token
        found = self.expression(SIMPLE)
        if found.is_literal and isinstance(found.value, bool):
            return TRUE if found.value else FALSE
        if found.operator == "name" and found.value not in self.known.variables:
            raise self.error(
                f'a label in double quotes, such as "{start.text}", or a comparison of variables, '
                f"such as {start.text}=1",
                start,
            )
        if found.operator in _NUMBERS or found.is_literal:
            raise self.error("a comparison, such as x+1<=3")
        return self.defined(Comparison(self.text[start.start : self.last.end], found))

    # --- bounds ---

    def bound(self) -> Bounded | None:
        """The bound after an operator, as one on nothing yet."""
        empty = Bounded("U", TRUE, TRUE)
        if self.accept("^"):
            self.expect("{", " and a bound on a reward")
            self.expect("rew", " and the name of a reward")
            self.expect("{", " and the name of a reward")
            found = self.reward_bound()
            self.expect("}")
            return found
        if self.accept("rew"):
            self.expect("{", " and the name of a reward")
            return self.reward_bound()
        if self.accept("{"):
            return self.reward_bound()
        if self.accept("["):
            lower = self.steps()
            self.expect(",")
            start = self.token
            upper = self.steps()
            self.expect("]")
            if upper < lower:
                raise self.error(f"a number from {lower} up", start)
            return replace(empty, lower=lower, upper=upper)
        relation = self.accept("<=", "<", ">=", ">", "=")
        if relation is None:
            return None
        start = self.token
        steps = self.steps()
        if relation == "<" and steps == 0:
            raise self.error("a bound that some number of steps meets", start)
        return replace(
            empty,
            lower=steps + (relation == ">") if relation in (">", ">=", "=") else 0,
            upper={"<=": steps, "<": steps - 1, "=": steps}.get(relation),
        )

    def reward_bound(self) -> Bounded:
        reward = self.reward_name()
        self.expect("}")
        relation = self.accept("<=", "<")
        if relation is None:
            raise self.error("<= or <; only upper bounds on rewards are solved for")
        start = self.token
        limit = self.number()
        if relation == "<" and not limit:
            raise self.error("a bound that some reward meets", start)
        if self.token.text == ",":
            raise self.error("a formula; one bound on a reward is solved for, not several")
        return Bounded("U", TRUE, TRUE, reward=reward, limit=limit, strict=relation == "<")

    def bounded(self, operator: str, operands: tuple[Formula, ...], bound: Bounded) -> _Path:
        """An operator under a bound; unfolded where it is not on state formulas."""
        right = operands[-1]
        if operator in "FU":
            left = operands[0] if operator == "U" else TRUE
            found = replace(bound, operator="U", left=left, right=right)
        elif operator in "GR":
            left = operands[0] if operator == "R" else FALSE
            found = replace(bound, operator="R", left=left, right=right)
        else:  # a W b is b R (a | b)
            found = replace(bound, operator="R", left=right, right=operands[0] | right)
        boolean = is_boolean(found.left) and is_boolean(found.right)
        return found if boolean else self.plain(found)

    def plain(self, path: _Path) -> Formula:
        """A formula without bounds."""
        if isinstance(path, Formula):
            return path
        if path.reward is not None:
            raise self.error("a bound on a reward outermost and on state formulas only", self.last)
        if max(path.lower, path.upper or 0) > MAX_UNFOLDED_STEPS:
            raise self.error(
                f"a bound of at most {MAX_UNFOLDED_STEPS} steps inside of a formula; outermost and "
                "on state formulas it may be any",
                self.last,
            )
        return unfolded(path)

    # --- what stands in brackets ---

    def path_content(self) -> _Path:
        return self.path()

    def state_content(self) -> Formula:
        start = self.token
        found = self.path()
        if isinstance(found, Bounded) or not is_boolean(found):
            raise self.error(_STATE, start)
        return found

    def reward_content(self) -> Formula | Earned:
        start = self.token
        if self.accept("S", "LRA"):
            return Earned("average")
        if self.accept("I"):
            self.expect("=", " and a number of steps after I")
            return Earned("instantaneous", self.steps())
        if self.accept("C"):
            relation = self.accept("<=", "<")
            if relation is None:
                if self.token.text == "{":
                    raise self.error(
                        "<= and a number of steps after C; the steps are bounded, not a reward"
                    )
                return Earned("total")
            place = self.token
            steps = self.steps() - (relation == "<")
            if steps < 0:
                raise self.error("a bound that some number of steps meets", place)
            return Earned("cumulative", steps)
        return self.reach_content(start, "F and a state formula, C, C<=k, I=k, S or LRA")

    def steps_content(self) -> Formula:
        return self.reach_content(self.token, "F and a state formula")

    def reach_content(self, start: Token, wanted: str) -> Formula:
        found = self.path()
        if isinstance(found, Bounded) or found.operator != "F" or not is_boolean(found.operands[0]):
            raise self.error(wanted, start)
        return found


_AFTER_OPERAND = ("=", "!=", "<", "<=", ">", ">=", "+", "-", "*", "/", "^", "?")
_NUMBERS = ("+", "-", "*", "/", "neg", "min", "max", "floor", "ceil", "round", "pow", "mod", "log")


_CONTENT: dict[str, Callable[[_Parser], Formula | Bounded | Earned]] = {
    "P": _Parser.path_content,
    "R": _Parser.reward_content,
    "T": _Parser.steps_content,
    "LRA": _Parser.state_content,
}
