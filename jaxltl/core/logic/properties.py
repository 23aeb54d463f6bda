"""Properties of probabilistic models, in the syntax that PRISM and Storm share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any, TypeVar

from jaxltl.core.logic.bounded import Bounded, Conditional, Earned
from jaxltl.core.logic.comparisons import Comparison, Definitions
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import TRUE, Formula
from jaxltl.core.logic.property import FILTERS, Property as Property
from jaxltl.core.logic.property_paths import OPERATOR, PathParser
from jaxltl.core.logic.property_tokens import BOUNDS, Token


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
    for the objective: `<<system>> Pmax=? [ PATH ]`, or, by names and numbers of a game of several
    players, `<<p1, 3>>`, `<<>>` and `<<*>>`; a threshold is met by some of its strategies.

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


_DIRECTIONS = ("max", "min", "maxmax", "maxmin", "minmax", "minmin")
_Content = TypeVar("_Content")
_STATE = "a state formula: labels in quotes, true, false, ! & | => <=>"


class _Parser(PathParser):
    """Properties; each method reads the construct of its name."""

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
            players = self.coalition()
            inner = self.property_(name)
            self.require(
                inner.operator != "multi" and inner.aggregate is None and inner.coalition is None,
                "P, R, T or LRA after a coalition",
                start,
            )
            return replace(inner, text=self.written(start), coalition=players)
        if self.accept("multi"):
            return self.multi(start, name)
        if self.accept("filter"):
            return self.filter(start, name)
        match = OPERATOR.fullmatch(start.text) if start.kind == "word" else None
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

    def coalition(self) -> tuple[str, ...]:
        """The players of a coalition, and the sign after it."""
        players: list[str] = []
        while self.token.text != ">>" and (not players or self.accept(",")):
            if self.accept("*"):
                self.require(not players, "no other players with *, which is all", self.last)
                players.append("*")
                break
            quoted = self.token.kind == "quoted"
            known = quoted or self.token.kind in ("word", "number")
            self.require(known, "a player, by its name or its number from 1")
            players.append(self.quoted() if quoted else self.take().text)
        self.expect(">>", " or ','")
        return tuple(players)

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
        if first.text == "<<" or (first.kind == "word" and OPERATOR.fullmatch(first.text)):
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
