"""Properties of probabilistic models, in the syntax that PRISM and Storm share."""

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Literal, TypeVar

from jaxltl.core.language.parser import SIMPLE
from jaxltl.core.logic.bounded import Bounded, Conditional, Earned, unfolded
from jaxltl.core.logic.comparisons import Comparison, Definitions
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import FALSE, TRUE, Formula
from jaxltl.core.logic.property_tokens import AFTER_OPERAND, BOUNDS, NUMBERS
from jaxltl.core.logic.property_tokens import Token, TokenStream, instead_of
from jaxltl.core.pretty_print import brief

Relation = Literal["<", "<=", ">", ">="]

# Kinds of filters: of truth values (True), of numbers (False), or of either.
FILTERS = {
    **dict.fromkeys(("min", "max", "avg", "sum", "range"), False),
    **dict.fromkeys(("forall", "exists", "count"), True),
    **dict.fromkeys(("first", "state", "print"), None),
}
MAX_UNFOLDED_STEPS = 100  # of a step bound inside a formula, which is unfolded into nested X


@brief(fields=("text",))
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
      reward: for `"R"`, the name, or None for the one without a name, or the only one of the model.
      path: for `"P"` a formula, a bounded or a conditional one, for `"T"` and `"R"` `F` of a state formula or
        an :class:`~jaxltl.core.logic.bounded.Earned`, for `"LRA"` a state formula.
      parts: of `"multi"`, its objectives.
      name: the name before the colon, or None.
      coalition: of a game, the players who choose for the objective, as in `<<system>> Pmax=?`, or None.
      definitions: propositions of the formulas that are no labels: comparisons and nested properties.
      aggregate, among: of a filter, its kind, such as `"min"`, and the states that it is over.

    Example:
      >>> prop = parse_property('Pmax>=0.9 [ F "goal" ]')
      >>> prop.operator, prop.objective, prop.relation, str(prop.threshold), str(prop.path)
      ('P', 'max', '>=', '9/10', 'F goal')
    """

    text: str
    operator: Literal["P", "R", "T", "LRA", "multi"]
    objective: Literal["max", "min"] | None = None
    relation: Relation | None = None
    threshold: Fraction | None = None
    reward: str | None = None
    path: Formula | Bounded | Conditional | Earned = TRUE
    parts: tuple[Property, ...] = ()
    name: str | None = None
    nature: Literal["max", "min"] | None = None
    definitions: tuple[tuple[str, Comparison | Property], ...] = ()
    aggregate: str | None = None
    among: Formula = TRUE
    coalition: tuple[str, ...] | None = None

    @property
    def direction(self) -> Literal["max", "min"] | None:
        """The optimum that decides it: a lower threshold for all policies is one on the minimum.

        A coalition meets one with some policy, which is one on the maximum.
        """
        if self.objective is not None or self.relation is None:
            return self.objective
        return "min" if (self.relation in (">", ">=")) == (self.coalition is None) else "max"

    def __str__(self) -> str:
        return self.text


def parse_properties(text: str, definitions: Definitions | None = None) -> tuple[Property, ...]:
    """The properties that a text writes, one after the other; a `;` may end each.

    Of a probability: `Pmax=? [ PATH ]`, `Pmin=?`, `P=?`, or a threshold such as `P>=0.9` or
    `Pmax<1/3`. A path is any formula of linear temporal logic over labels in quotes, with
    `X F G U W R`; within `F G U W R` a bound on steps (`F<=10`, `U<10`, `F[2,5]`, `F=3`, `F>=4`)
    or, outermost, on a reward (`F{"time"}<=5 "goal"`); `F "a" || F "b"` is the first given the second.
    Of a reward: `R{"name"}max=? [ F "goal" ]`, `[ C ]`, `[ C<=10 ]`, `[ I=5 ]`, `[ S ]` or `[ LRA ]`.
    Expected steps: `Tmin=? [ F "goal" ]`. Time in the long run: `LRAmax=? [ "up" ]`. Several at once:
    `multi(P, P, ...)`.
    State formulas may also compare variables, `x + 1 < 2 * y`, and nest properties with thresholds,
    `P>=0.9 [ F P>0.5 [ X "a" ] ]`. A state formula is a property too. `filter(min, P=? [ F "a" ],
    x = 0)` is over the states of a formula, by default all: one of `min max avg sum count range
    first state forall exists print`.
    Where probabilities are intervals, the direction of the policy comes first and that of nature
    second: `Pmaxmin=?`, `R{"time"}minmax=?`. In a game a coalition comes before that, whose players choose
    for the objective: `<<system>> Pmax=? [ PATH ]`; a threshold is met by some of its strategies.

    From tightest to loosest: `!`, `&`, `|`, `<=>`, `=>`, the prefixes `X F G`, then `U W R`, then
    `&&` and `||`, which is for state formulas only. So temporal operators reach as far as they can,
    as in PRISM and Storm:
    `G F "a" & "b"` is `G F ("a" & "b")`. A property may have a name, `"p1": ...`, and `//`
    begins a comment. A text may declare constants (``const int k = 3;``), formulas and labels as programs do, and
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
    properties = parse_properties(text, definitions)
    if len(properties) != 1:
        raise ValueError(f"property: {text!r} holds {len(properties)} properties; give one.")
    return properties[0]


_OPERATOR = re.compile(r"(P|R|T|LRA|S)(max|min)?(max|min)?")
_DIRECTIONS = ("max", "min", "maxmax", "maxmin", "minmax", "minmin")


# --- grammar ----------------------------------------------------------------------------------

_Path = Formula | Bounded
_Content = TypeVar("_Content")
_STATE = "a state formula: labels in quotes, true, false, ! & | => <=>"


class _Parser(TokenStream):
    """Recursive-descent parser; each method reads the construct of its name."""

    def __init__(self, text: str, known: Definitions) -> None:
        super().__init__(text, known)
        self.definitions: dict[str, Comparison | Property] = {}  # of the property being read

    # --- properties ---

    def properties(self) -> tuple[Property, ...]:
        properties = []
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
            properties.append(self.outermost(name))
        self.require(bool(properties), 'a property, such as Pmax=? [ F "goal" ]')
        return tuple(properties)

    def outermost(self, name: str | None) -> Property:
        """A property, or a state formula, which must hold in each initial state."""
        start, before = self.token, self.place
        begins_formula = start.kind == "quoted" or start.text in ("true", "false", "!", "(")
        if not begins_formula and start.text not in self.known.known | self.names.keys():
            prop = self.property_(name)
            if prop.relation is None or self.token.text not in ("&", "|", "=>", "<=>"):
                return prop
            self.place = before
        return self.state_property(name)

    def written(self, start: Token) -> str:
        """The text from a token up to here."""
        return self.text[start.start : self.last.end]

    def scoped(
        self, read: Callable[[], _Content]
    ) -> tuple[_Content, tuple[tuple[str, Comparison | Property], ...]]:
        """The result of a method of the parser, and the definitions in its text."""
        outer, self.definitions = self.definitions, {}
        content = read()
        defined, self.definitions = tuple(self.definitions.items()), outer
        return content, defined

    def state_property(self, name: str | None = None) -> Property:
        """A state formula as a property: with probability one, which is 0 or 1."""
        start = self.token
        path, defined = self.scoped(self.state_content)
        return Property(
            self.written(start),
            "P",
            relation=">=",
            threshold=Fraction(1),
            path=path,
            name=name,
            definitions=defined,
        )

    def property_(self, name: str | None = None) -> Property:
        start = self.token
        if self.accept("<<"):
            players: list[str] = []
            while self.token.text != ">>" and (not players or self.accept(",")):
                self.require(self.token.kind == "word", "a player: system or environment")
                players.append(self.take().text)
            self.expect(">>", " or ','")
            inner = self.property_(name)
            self.require(
                inner.operator != "multi" and inner.aggregate is None and inner.coalition is None,
                "P, R, T or LRA after a coalition",
                start,
            )
            return replace(inner, text=self.written(start), coalition=tuple(players))
        if self.accept("multi"):
            return self.multi(start, name)
        if self.accept("filter"):
            return self.filter(start, name)
        match = _OPERATOR.fullmatch(start.text) if start.kind == "word" else None
        if match is None:
            raise self.error("a property: P, Pmax, Pmin, R, Rmax, Rmin, T, LRA or multi(...)")
        self.take()
        fields: dict[str, Any] = {"operator": "LRA" if match[1] == "S" else match[1]}
        if match[1] == "R" and self.accept("{"):
            fields["reward"] = self.reward_name()
            self.expect("}")
        # R{"name"}max has max after the name.
        both = start.text[len(match[1]) :] or self.accept(*_DIRECTIONS) or ""
        fields |= {"objective": both[:3] or None, "nature": both[3:] or None}
        fields["relation"], fields["threshold"] = self.comparison(match[1])
        self.expect("[")
        content = _CONTENT[fields["operator"]]
        fields["path"], fields["definitions"] = self.scoped(lambda: content(self))
        self.expect("]", " or an operator")
        return Property(self.written(start), **fields, name=name)

    def multi(self, start: Token, name: str | None) -> Property:
        self.expect("(")
        parts: list[Property] = []
        while not parts or self.accept(","):
            first = self.token
            part = self.property_()
            self.require(
                part.operator != "multi", "a property with P or R; multi stands outermost", first
            )
            self.require(
                part.nature is None,
                "one direction, max or min: several objectives are solved for without intervals",
                first,
            )
            parts.append(part)
        self.expect(")", " or ','")
        defined = tuple(one for part in parts for one in part.definitions)
        text = self.written(start)
        return Property(text, "multi", parts=tuple(parts), name=name, definitions=defined)

    def filter(self, start: Token, name: str | None) -> Property:
        self.expect("(")
        place, kind = self.token, self.take().text
        self.require(kind in FILTERS, f"the kind of the filter: {', '.join(FILTERS)}", place)
        self.expect(",")
        first, before, inner = self.token, self.place, None
        if first.text == "<<" or (first.kind == "word" and _OPERATOR.fullmatch(first.text)):
            inner = self.property_()
        if inner is None or self.token.text not in (",", ")"):  # it begins a state formula
            self.place = before
            inner = self.state_property()
        wanted = "a threshold or a state formula" if FILTERS[kind] else "a number, =?"
        self.require(
            FILTERS[kind] in (None, inner.relation is not None),
            f"{wanted} in a filter of this kind",
            first,
        )
        among, defined = self.scoped(self.state_content) if self.accept(",") else (TRUE, ())
        self.expect(")", " or ','")
        return replace(
            inner,
            text=self.written(start),
            name=name,
            definitions=(*inner.definitions, *defined),
            aggregate=kind,
            among=among,
        )

    def comparison(self, operator: str) -> tuple[str | None, Fraction | None]:
        if self.accept("="):
            self.expect("?", " after '='; to compare, use >= > <= or <")
            return None, None
        relation = self.one_of(("<=", ">=", "<", ">"), "=? or a threshold, such as >=0.9")
        start = self.token
        threshold = self.number(signed=operator == "R")
        possible = operator in ("R", "T") or 0 <= threshold <= 1
        self.require(possible, "a probability between 0 and 1", start)
        return relation, threshold

    # --- paths, from loosest to tightest ---

    def condition(self, inside: bool = False) -> _Path | Conditional:
        """A path, or two, of which the second one is the condition of the first; not `inside` parentheses."""
        operands, sign = [self.conjunction()], self.token
        while self.accept("||"):
            operands.append(self.conjunction())
        if len(operands) == 1:
            return operands[0]
        plain = [self.plain(x) for x in operands]
        if inside or all(map(is_boolean, plain)):
            return Formula("|", tuple(plain))
        self.require(len(plain) == 2, "one condition; (PATH) | (PATH) is one of several", sign)
        return Conditional(*plain)

    def path(self, inside: bool = False) -> _Path:
        path = self.condition(inside)
        if not isinstance(path, Conditional):
            return path
        raise self.error("one path; a condition, ||, stands outermost in P", self.last)

    def conjunction(self) -> _Path:
        return self.chain("&&", "&", self.until)

    def until(self) -> _Path:
        left = self.prefixed()
        operator = self.accept("U", "W", "R")
        if operator is None:
            return left
        bound = self.bound()
        right = self.prefixed()
        again = self.token.text in ("U", "W", "R") and self.token.kind == "word"
        self.require(not again, "parentheses around one of two U, W or R in a row")
        return self.bounded(operator, (self.plain(left), self.plain(right)), bound)

    def prefixed(self) -> _Path:
        operator = self.accept("X", "F", "G")
        if operator is None:
            return self.implication()
        start = self.token
        bound = self.bound()
        self.require(bound is None or operator != "X", "a formula; X takes no bound", start)
        return self.bounded(operator, (self.plain(self.prefixed()),), bound)

    def implication(self) -> _Path:
        left = self.equivalence()
        if not self.accept("=>"):
            return left
        right = self.equivalence()
        self.require(self.token.text != "=>", "parentheses around one of two => in a row")
        return Formula("->", (self.plain(left), self.plain(right)))

    def equivalence(self) -> _Path:
        return self.chain("<=>", "<->", self.disjunction)

    def disjunction(self) -> _Path:
        return self.chain("|", "|", lambda: self.chain("&", "&", self.atom))

    def chain(self, sign: str, operator: str, operand: Callable[[], _Path]) -> _Path:
        first = operand()
        if self.token.text != sign or self.token.kind != "sign":
            return first
        operands = [self.plain(first)]
        while self.accept(sign):
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
            self.require(bool(name), "a label's name between the quotes", token)
            if name in self.labels:
                return self.defined(self.labels[name])
            return Formula("ap", proposition=name)
        if constant := self.accept("true", "false"):
            return Formula(constant)
        if token.text == "<<" or (
            token.kind == "word" and token.text not in self.known.known | self.names.keys()
        ):
            if token.text in "XFG":
                return self.prefixed()
            if token.text == "<<" or _OPERATOR.fullmatch(token.text):
                nested = self.property_()
                self.require(
                    nested.relation is not None,
                    "a nested property with a threshold, such as P>=0.5",
                    token,
                )
                return self.defined(nested)
        begins = token.kind in ("word", "number") or token.text == "-"
        self.require(begins, "a label in quotes, true, false, '(', '!' or one of X F G")
        return self.comparison_of_variables()

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
            path = self.path(inside=True)
            self.expect(")", " or an operator")
            self.require(self.token.text not in AFTER_OPERAND, "a Boolean operator")
            return path
        except ValueError:
            after, self.place, self.definitions = self.place, place, known
            with contextlib.suppress(ValueError):
                return self.comparison_of_variables()
            self.place = after
            raise

    def comparison_of_variables(self) -> Formula:
        start = self.token
        comparison = self.expression(SIMPLE)
        if comparison.is_literal and isinstance(comparison.value, bool):
            return TRUE if comparison.value else FALSE
        is_variable = comparison.operator != "name" or comparison.value in self.known.variables
        self.require(is_variable, instead_of(start.text), start)
        is_number = comparison.operator in NUMBERS or comparison.is_literal
        self.require(not is_number, "a comparison, such as x+1<=3")
        return self.defined(Comparison(self.written(start), comparison))

    # --- bounds ---

    def bound(self) -> Bounded | None:
        """The bound after an operator, as one on nothing yet."""
        empty = Bounded("U", TRUE, TRUE)
        if self.accept("^"):
            self.expect("{", " and a bound on a reward")
            self.expect("rew", " and the name of a reward")
            self.expect("{", " and the name of a reward")
            bound = self.reward_bound()
            self.expect("}")
            return bound
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
            self.require(upper >= lower, f"a number from {lower} up", start)
            return replace(empty, lower=lower, upper=upper)
        relation = self.accept("<=", "<", ">=", ">", "=")
        if relation is None:
            return None
        start = self.token
        steps = self.steps() + {"<": -1, ">": 1}.get(relation, 0)
        self.require(steps >= 0, "a bound that some number of steps meets", start)
        return replace(
            empty,
            lower=0 if "<" in relation else steps,
            upper=None if ">" in relation else steps,
        )

    def reward_bound(self) -> Bounded:
        reward = self.reward_name()
        self.expect("}")
        relation = self.one_of(("<=", "<"), "<= or <; only upper bounds on rewards are solved for")
        start = self.token
        limit = self.number()
        self.require(relation == "<=" or limit > 0, "a bound that some reward meets", start)
        self.require(
            self.token.text != ",",
            "a formula; one bound on a reward is solved for, not several",
        )
        return Bounded("U", TRUE, TRUE, reward=reward, limit=limit, strict=relation == "<")

    def bounded(self, operator: str, operands: tuple[Formula, ...], bound: Bounded | None) -> _Path:
        """An operator, perhaps under a bound; unfolded where it is not on state formulas."""
        if bound is None:
            return Formula(operator, operands)
        first, right = operands[0], operands[-1]
        kind: Literal["U", "R"] = "U" if operator in "FU" else "R"
        left = {"F": TRUE, "G": FALSE, "W": right}.get(operator, first)
        right = first | right if operator == "W" else right  # a W b is b R (a | b)
        path = replace(bound, operator=kind, left=left, right=right)
        boolean = is_boolean(path.left) and is_boolean(path.right)
        return path if boolean else self.plain(path)

    def plain(self, path: _Path) -> Formula:
        """A formula without bounds."""
        if isinstance(path, Formula):
            return path
        self.require(
            path.reward is None,
            "a bound on a reward outermost and on state formulas only",
            self.last,
        )
        self.require(
            max(path.lower, path.upper or 0) <= MAX_UNFOLDED_STEPS,
            f"a bound of at most {MAX_UNFOLDED_STEPS} steps inside of a formula; outermost and "
            "on state formulas it may be any",
            self.last,
        )
        return unfolded(path)

    # --- what stands in brackets ---

    def state_content(self) -> Formula:
        start = self.token
        path = self.path()
        if isinstance(path, Bounded) or not is_boolean(path):
            raise self.error(_STATE, start)
        return path

    def reward_content(self) -> Formula | Earned:
        if self.accept("S", "LRA"):
            return Earned("average")
        if self.accept("I"):
            self.expect("=", " and a number of steps after I")
            return Earned("instantaneous", self.steps())
        if not self.accept("C"):
            return self.reach_content("F and a state formula, C, C<=k, I=k, S or LRA")
        relation = self.accept("<=", "<")
        if relation is None:
            self.require(
                self.token.text != "{",
                "<= and a number of steps after C; the steps are bounded, not a reward",
            )
            return Earned("total")
        place = self.token
        steps = self.steps() - (relation == "<")
        self.require(steps >= 0, "a bound that some number of steps meets", place)
        return Earned("cumulative", steps)

    def reach_content(self, wanted: str = "F and a state formula") -> Formula:
        start = self.token
        following = self.tokens[min(self.place + 1, len(self.tokens) - 1)]
        is_bounded = start.text == "F" and following.text in BOUNDS
        self.require(
            not is_bounded,
            f"{wanted}; F without a bound, since a reward until a bounded path is not solved for",
            following,
        )
        path = self.path()
        if isinstance(path, Bounded) or path.operator != "F" or not is_boolean(path.operands[0]):
            if isinstance(path, Formula) and path.operator == "F":
                wanted += "; only labels and comparisons, not a path, under F"
            raise self.error(wanted, start)
        return path


_CONTENT: dict[str, Callable[[_Parser], Formula | Bounded | Conditional | Earned]] = {
    "P": _Parser.condition,
    "R": _Parser.reward_content,
    "T": _Parser.reach_content,
    "LRA": _Parser.state_content,
}
