"""Properties of probabilistic models, in the syntax that PRISM and Storm share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any, Literal, NamedTuple

from jaxltl.core.language.exact import is_inexact
from jaxltl.core.language.expressions import FUNCTIONS, Expression
from jaxltl.core.logic.bounded import Bounded, Conditional, Earned, Recognized
from jaxltl.core.logic.comparisons import Comparison, Definitions
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import TRUE, Formula, offending_subformula
from jaxltl.core.logic.property import FILTERS, Property as Property
from jaxltl.core.logic.property_paths import COALITION, OPERATOR, PathParser
from jaxltl.core.logic.property_tokens import AFTER_OPERAND, BOUNDS, Token


def parse_properties(text: str, definitions: Definitions | None = None) -> tuple[Property, ...]:
    """The properties that a text writes, one after the other; a `;` may end each.

    Of a probability: `Pmax=? [ PATH ]`, `Pmin=?`, `P=?`, or a threshold such as `P>=0.9` or
    `Pmax<1/3`. A path is any formula of linear temporal logic over labels in quotes, with
    `X F G U W R`; within `F G U W R` a bound on steps (`F<=10`, `U<10`, `F[2,5]`, `F=3`, `F>=4`)
    or, outermost, on a reward (`F{"time"}<=5 "goal"`); `F "a" || F "b"` is the first given the second.
    Of a reward: `R{"name"}max=? [ F "goal" ]`, or `F0` and `Fc`, with which a run that never arrives is worth 0
    and the sum of its rewards in place of infinity; `[ C ]`, `[ C<=10 ]`, `[ I=5 ]`, `[ S ]` or `[ LRA ]`; until
    any co-safe formula is proven, `[ X F "goal" ]`, infinite where that has a probability below one.
    Of the graph: `E [ PATH ]` and `A [ PATH ]`, of some and of all paths, nested as in CTL.
    `C{discount=0.9}`, `C{discount=0.9}<=10` and `F{discount=0.9} "goal"` discount each step; a run without a
    target then earns its sum.
    Expected steps: `Tmin=? [ F "goal" ]`. Time in the long run: `LRAmax=? [ "up" ]`. Several at once:
    `multi(P, P, ...)`.
    State formulas may also compare variables, `x + 1 < 2 * y`, and nest properties with thresholds,
    `P>=0.9 [ F P>0.5 [ X "a" ] ]`. A state formula is a property too, and so is an expression over variables,
    results and names of properties, `ceil(P=? [ F "a" ]) + 1` or `2 * "p1"`, in rational arithmetic on bounds.
    `filter(min, P=? [ F "a" ], x = 0)` is over the states of a formula, by default all: one of `min max argmin argmax
    avg sum count range first state forall exists print printall`; `P=? [ F "a" {x = 0}{min} ]` is the same.
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
    items = parse_each(text, definitions)
    for item in items:
        if isinstance(item, MalformedProperty):
            raise ValueError(item.error)
    return tuple(item for item in items if isinstance(item, Property))


class MalformedProperty(NamedTuple):
    """A part of a text that is no property."""

    text: str
    error: str  # with line and column


def parse_each(
    text: str, definitions: Definitions | None = None
) -> tuple[Property | MalformedProperty, ...]:
    """The properties in a text, and each malformed one with its error; as :func:`parse_properties`."""
    if not isinstance(text, str):
        raise ValueError(f"parse_properties: expected text, got {type(text).__name__} {text!r}.")
    try:
        return tuple(_Parser(text, definitions or Definitions()).items())
    except RecursionError:
        error = "property: parentheses or operators are nested too deeply; split the formula."
        return (MalformedProperty(text, error),)


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
_SIGNS = {"&": "forall", "|": "exists", "+": "sum"}  # of filters
_DECLARE = ("const", "label", "formula")
_ITEMS = (*_DECLARE, "E", "A", "filter", "multi")
_BEGINS = (*COALITION, "(", "!", "-")
_CONTINUES = (*AFTER_OPERAND, "&", "|", "=>", "<=>")
_STATE = "a state formula: labels in quotes, true, false, ! & | => <=>"


class _Parser(PathParser):
    """Properties; each method reads the construct of its name."""

    def __init__(self, text: str, known: Definitions) -> None:
        super().__init__(text, known)
        self.memory: dict[tuple[str, int], tuple[Property | ValueError, int]] = {}

    def items(self) -> list[Property | MalformedProperty]:
        """The properties, and the malformed parts."""
        items: list[Property | MalformedProperty] = []
        declared = self.declared()
        while self.token.kind != "end":
            if self.accept(";"):
                continue
            place, start, name = self.place, self.token, None
            try:
                if place in declared:
                    self.place, error = declared[place]
                    if error is not None:
                        raise error
                    continue
                if start.kind == "quoted" and self.tokens[place + 1].text == ":":
                    name, _ = self.quoted(), self.take()
                prop = self.outermost()
                follows = self.token.kind != "sign" or self.token.text in (";", *_BEGINS)
                self.require(follows, 'a property, such as Pmax=? [ F "goal" ]')
                items.append(replace(prop, name=name))
            except ValueError as error:
                self.place = self.next_item(place)
                items.append(MalformedProperty(self.written(start), str(error)))
        if not items:
            items.append(
                MalformedProperty(self.text, str(self.error('a property, such as P=? [ F "a" ]')))
            )
        return items

    def declared(self) -> dict[int, tuple[int, ValueError | None]]:
        """The end of each declaration by its place, or its error; they may stand in any order."""
        waiting = [
            i
            for i, token in enumerate(self.tokens[:-1])
            if token.kind == "word"
            and token.text in _DECLARE
            and self.tokens[i + 1].kind in ("word", "quoted")
        ]
        done: dict[int, tuple[int, ValueError | None]] = {}
        before = -1
        while len(done) > before:
            before = len([x for x in done.values() if x[1] is None])
            for place in [x for x in waiting if done.get(x, (0, ValueError))[1] is not None]:
                self.place = place
                try:
                    self.declaration()
                    done[place] = self.place, None
                except ValueError as error:
                    done[place] = self.next_item(place), error
            if len([x for x in done.values() if x[1] is None]) == before:
                break
        self.place = 0
        self.memory.clear()
        return done

    def next_item(self, place: int) -> int:
        """The place of the next property or declaration: after a semicolon, or on a line of its own."""
        for i in range(place + 1, len(self.tokens)):
            before, token = self.tokens[i - 1], self.tokens[i]
            if before.text == ";" and before.kind == "sign":
                return i
            starts = token.kind == "quoted" and self.tokens[min(i + 1, len(self.tokens) - 1)].text
            operator = token.kind == "word" and (
                OPERATOR.fullmatch(token.text) or token.text in _ITEMS
            )
            if "\n" in self.text[before.end : token.start] and (
                starts == ":" or operator or token.text in COALITION
            ):
                return i
        return len(self.tokens) - 1

    def remembered(self, read: Callable[[], Property]) -> Property:
        """The result of a method at this place, which is read once however often it is tried."""
        key = (read.__name__, self.place)
        if key not in self.memory:
            try:
                self.memory[key] = read(), self.place
            except ValueError as error:
                self.memory[key] = error, self.place
        result, self.place = self.memory[key]
        if isinstance(result, ValueError):
            raise result
        return result

    def outermost(self) -> Property:
        """A property, or an expression of states: a formula, which must hold, or a number."""
        return self.remembered(self.any_property)

    def property_(self) -> Property:
        """A property that is no expression of others."""
        return self.remembered(self.operator_property)

    def any_property(self) -> Property:
        before, errors = self.place, []
        begins = self.token.kind not in ("sign", "end") or self.token.text in _BEGINS
        self.require(begins, 'a property, such as Pmax=? [ F "goal" ]')
        if self.token.kind != "quoted" and (self.begins_property() or self.begins_unknown()):
            prop = self.property_()
            if self.token.text not in _CONTINUES:
                return prop
        for read in (self.state_property, self.state_value):
            self.place = before
            try:
                prop = read()
                if read == self.state_property and _is_expression(prop):
                    continue
                if self.token.text not in _CONTINUES:
                    return prop
                errors.append((self.place, self.error("';' or the end of the property")))
            except ValueError as error:
                errors.append((self.place, error))
        self.place, furthest = max(errors, key=lambda x: x[0])
        raise furthest

    def begins_unknown(self) -> bool:
        """True for a word that begins neither a formula nor an expression."""
        known = self.known.known | self.names.keys() | {"true", "false", "func", *FUNCTIONS}
        return self.token.kind == "word" and self.token.text not in known

    def state_value(self) -> Property:
        """An expression over variables, labels, and results of properties."""
        value = self.state_expression(0)
        return Property(value.text, "value", expression=value)

    def state_property(self) -> Property:
        """A state formula as a property: with probability one, which is 0 or 1."""
        start = self.token
        path, defined = self.scoped(self.state_content)
        return Property(
            self.written(start),
            "P",
            relation=">=",
            threshold=Fraction(1),
            path=path,
            definitions=defined,
        )

    def operator_property(self) -> Property:
        start = self.token
        if sign := self.accept(*COALITION):
            players, first = self.coalition(COALITION[sign]), self.token
            expected = "P, R, T or LRA after a coalition"
            self.require(
                first.text != "(",
                f"{expected}; several objectives of a game at once are not solved for",
                first,
            )
            inner = self.property_()
            is_one = inner.operator in _CONTENT and inner.coalition is None
            self.require(is_one and first.text != "filter", expected, start)
            text, universal = self.written(start), sign == "[["
            return replace(inner, text=text, coalition=players, universal=universal)
        if self.accept("multi"):
            return self.multi(start)
        if self.accept("filter"):
            return self.filter(start)
        if self.accept("E", "A"):
            return self.of_paths(start)
        match = OPERATOR.fullmatch(start.text) if start.kind == "word" else None
        if match is None:
            raise self.error("a property: P, Pmax, Pmin, R, Rmax, Rmin, T, LRA, E, A or multi(...)")
        self.take()
        fields: dict[str, Any] = {"operator": "LRA" if match[1] == "S" else match[1]}
        if match[1] == "R" and self.accept("{"):
            fields["reward"] = self.reward_name()
            self.expect("}")
            self.require(
                self.token.text != "/", "one reward; averages of a ratio of two are not solved for"
            )
        elif match[1] == "R" and len(self.known.rewards) > 1:
            fields["reward"] = self.known.rewards[0] or None  # as in PRISM
        # R{"name"}max has max after the name.
        both = start.text[len(match[1]) :] or self.accept(*_DIRECTIONS) or ""
        fields |= {"objective": both[:3] or None, "nature": both[3:] or None}
        fields["relation"], fields["threshold"] = self.comparison(match[1])
        self.expect("[")
        content = _CONTENT[fields["operator"]]
        if match[1] == "R" and (variant := self.accept("F0", "Fc")):
            fields["unreached"] = "zero" if variant == "F0" else "sum"
            content = _Parser.eventual_state
        following = [token.text for token in self.tokens[self.place + 1 :][:2]]
        if match[1] == "R" and following == ["{", "discount"] and self.token.text in ("C", "F"):
            content = _Parser.eventual_state if self.take().text == "F" else _Parser.collected
            if (factor := self.discount()) is not None:
                fields |= {"discount": factor, "unreached": "sum"}
        fields["path"], fields["definitions"] = self.scoped(lambda: content(self))
        if self.accept("{"):
            fields["aggregate"], fields["among"], more = self.state_filter()
            fields["definitions"] += more
        self.expect("]", " or an operator")
        return Property(self.written(start), **fields)

    def coalition(self, end: str) -> tuple[str, ...]:
        """The players of a coalition, and the sign after it."""
        players: list[str] = []
        while self.token.text != end and (not players or self.accept(",")):
            if self.accept("*"):
                self.require(not players, "no other players with *, which is all", self.last)
                players.append("*")
                break
            quoted = self.token.kind == "quoted"
            known = quoted or self.token.kind in ("word", "number")
            self.require(known, "a player, by its name or its number from 1")
            players.append(self.quoted() if quoted else self.take().text)
            self.require(
                self.token.text != ":", "one coalition; equilibria of several are not solved for"
            )
        self.expect(end, " or ','")
        if end == "]":
            self.expect(end, " twice")
        return tuple(players)

    def of_paths(self, start: Token) -> Property:
        """``E [ PATH ]`` or ``A [ PATH ]`` of computation tree logic."""
        self.expect("[")
        path, defined = self.scoped(lambda: self.recognized() or self.path())
        self.expect("]", " or an operator")
        some: Literal["E", "A"] = "E" if start.text == "E" else "A"
        return Property(
            self.written(start),
            some,
            relation=">=",
            threshold=Fraction(1),
            path=path,
            definitions=defined,
        )

    def state_filter(self) -> tuple[str, Formula, tuple[tuple[str, Comparison | Property], ...]]:
        """States and aggregates after a path, ``{states}{min}{max}``, and their filter."""
        among, defined = self.scoped(self.state_content)
        self.expect("}", " or an operator")
        kinds: list[str] = []
        while self.accept("{"):
            kinds.append(self.one_of(("min", "max"), "min or max"))
            self.expect("}")
        aggregate = "range" if len(set(kinds)) == 2 else kinds[0] if kinds else "state"
        return aggregate, among, defined

    def multi(self, start: Token) -> Property:
        self.expect("(")
        parts: list[Property] = []
        while not parts or self.accept(","):
            first = self.token
            part = self.property_()
            is_number = part.operator in ("P", "R", "T", "LRA") and part.aggregate is None
            self.require(is_number, "a property with P or R; multi stands outermost", first)
            self.require(
                part.nature is None,
                "one direction, max or min: several objectives are solved for without intervals",
                first,
            )
            parts.append(part)
        self.expect(")", " or ','")
        defined = tuple(one for part in parts for one in part.definitions)
        text = self.written(start)
        return Property(text, "multi", parts=tuple(parts), definitions=defined)

    def filter(self, start: Token) -> Property:
        self.expect("(")
        place, kind = self.token, self.take().text
        kind = _SIGNS.get(kind, kind)
        self.require(kind in FILTERS, f"the kind of the filter: {', '.join(FILTERS)}", place)
        self.expect(",")
        first = self.token
        inner = self.outermost()
        if inner.aggregate is not None:  # its result is the same in all states
            value = Expression("name", value=f"[{inner.text}]")
            inner = Property(
                inner.text,
                "value",
                expression=Comparison(inner.text, value, ((f"[{inner.text}]", inner),)),
            )
        wanted = "a threshold or a state formula" if FILTERS[kind] else "a number, =?"
        fits = FILTERS[kind] is None or inner.operator == "value"
        self.require(
            inner.operator != "multi" and (fits or FILTERS[kind] != inner.is_number),
            f"{wanted} in a filter of this kind",
            first,
        )
        among, defined = self.scoped(self.state_content) if self.accept(",") else (TRUE, ())
        self.expect(")", " or ','")
        return replace(
            inner,
            text=self.written(start),
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

    def event(self) -> Formula | Bounded | Conditional | Recognized:
        """A path, or the automaton of one."""
        return self.recognized() or self.condition()

    def recognized(self) -> Recognized | None:
        """`HOA: {"file.hoa", "a" <- x=1}`: a file and the meaning of its propositions; None for another path."""
        start, before = self.token, self.place
        negated = False
        while self.accept("!"):
            negated = not negated
        if not (self.accept("HOA") and self.accept(":")):
            self.place = before
            return None
        self.expect("{", " and the file of an automaton")
        place, read = self.token, self.known.automaton
        name = self.quoted()
        hint = "a formula; automata are read by `jaxltl solve`, or by Definitions(automaton=...)"
        if read is None:
            raise self.error(hint, place)
        try:
            automaton = read(name)
        except ValueError as error:
            raise self.error(f"an automaton: {str(error).rstrip('.')}", place) from None
        meanings = {x: x for x in automaton.propositions}
        while self.accept(","):
            place = self.token
            proposition = self.quoted()
            wanted = f"a proposition of the automaton: {', '.join(meanings)}"
            self.require(proposition in meanings, wanted, place)
            self.require(bool(self.accept("<") and self.accept("-")), "'<-' and a state formula")
            meaning = self.state_property()
            meanings[proposition] = f"[{proposition} <- {meaning.text}]"
            self.definitions[meanings[proposition]] = meaning
        for proposition in meanings.keys() & self.labels.keys():
            if meanings[proposition] == proposition:
                meanings[proposition] = self.define(self.labels[proposition])
        self.expect("}", " or ','")
        names = tuple(meanings[x] for x in automaton.propositions)
        return Recognized(replace(automaton, propositions=names), negated, self.written(start))

    def reward_content(self) -> Formula | Earned:
        if self.accept("S", "LRA"):
            return Earned("average")
        if self.accept("I"):
            self.expect("=", " and a number of steps after I")
            return Earned("instantaneous", self.steps())
        return self.collected() if self.accept("C") else self.reach_content()

    def discount(self) -> Fraction | None:
        """The factor in ``{discount=d}``; None for 1."""
        self.expect("{")
        self.take()
        self.expect("=", " after discount")
        start = self.token
        factor = self.number(signed=True)
        self.require(0 <= factor <= 1, "a discount in the range from 0 to 1", start)
        self.expect("}")
        return None if factor == 1 else factor

    def collected(self) -> Earned:
        """Rewards collected for ever or for some steps: the text after C."""
        relation = self.accept("<=", "<")
        if relation is None:
            following = [x.text for x in self.tokens[self.place + 2 : self.place + 4]]
            self.require(  # {s=2} after C is a filter
                self.token.text != "{" or following[:1] != ["}"] or following[1] not in ("<=", "<"),
                "<= and a number of steps after C; the steps are bounded, not a reward",
            )
            return Earned("total")
        place = self.token
        steps = self.steps() - (relation == "<")
        self.require(steps >= 0, "a bound that some number of steps meets", place)
        return Earned("cumulative", steps)

    def eventual_state(self) -> Formula:
        """The formula after a variant of F."""
        return Formula("F", (self.state_content(),))

    def reach_content(self) -> Formula:
        """A co-safe formula, until which the reward is earned."""
        start = self.token
        following = self.tokens[min(self.place + 1, len(self.tokens) - 1)]
        self.require(
            start.text != "F" or following.text not in BOUNDS,
            "F without a bound, since a reward until a bounded path is not solved for",
            following,
        )
        path = self.plain(self.path())
        rest = offending_subformula(path, "cosafe")
        self.require(
            rest is None,
            f"a path that a prefix satisfies, such as F and a state formula; {rest} is none",
            start,
        )
        return path


def _is_expression(prop: Property) -> bool:
    """True for a variable alone, which may be a number, and where operands may be undefined."""
    meanings = [x.expression for _, x in prop.definitions if isinstance(x, Comparison)]
    is_variable = len(prop.definitions) == 1 and any(x.operator == "name" for x in meanings)
    return is_variable or (len(prop.definitions) > 1 and any(map(is_inexact, meanings)))


_CONTENT: dict[str, Callable[[_Parser], Formula | Bounded | Conditional | Earned | Recognized]] = {
    "P": _Parser.event,
    "R": _Parser.reward_content,
    "T": _Parser.reach_content,
    "LRA": _Parser.state_content,
}
