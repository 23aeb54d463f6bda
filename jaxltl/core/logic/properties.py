"""Properties of probabilistic models, in the syntax that PRISM and Storm share."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Literal, NamedTuple

from jaxltl.core.logic.bounded import Bounded, Earned, unfolded
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import FALSE, TRUE, Formula, pointed
from jaxltl.core.pretty_print import brief

Relation = Literal["<", "<=", ">", ">="]

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

    @property
    def direction(self) -> Literal["max", "min"] | None:
        """The optimum that decides it: a lower threshold for all policies is one on the minimum."""
        if self.objective is not None or self.relation is None:
            return self.objective
        return "min" if self.relation in (">", ">=") else "max"

    def __str__(self) -> str:
        return self.text


def parse_properties(text: str) -> tuple[Property, ...]:
    """The properties that a text writes, one after the other; a `;` may end each.

    Of a probability: `Pmax=? [ PATH ]`, `Pmin=?`, `P=?`, or a threshold such as `P>=0.9` or
    `Pmax<1/3`. A path is any formula of linear temporal logic over labels in quotes, with
    `X F G U W R`; within `F G U W R` a bound on steps (`F<=10`, `U<10`, `F[2,5]`, `F=3`, `F>=4`)
    or, outermost, on a reward (`F{"time"}<=5 "goal"`). Of a reward: `R{"name"}max=? [ F "goal" ]`,
    `[ C ]`, `[ C<=10 ]`, `[ I=5 ]`, `[ S ]` or `[ LRA ]`. Expected steps: `Tmin=? [ F "goal" ]`.
    Time in the long run: `LRAmax=? [ "up" ]`. Several at once: `multi(P, P, ...)`.
    Where probabilities are intervals, the direction of the policy comes first and that of nature
    does second: `Pmaxmin=?`, `R{"time"}minmax=?`.

    From tightest to loosest: `!`, `&`, `|`, `<=>`, `=>`, the prefixes `X F G`, then `U W R`, then
    `&&` and `||`. So temporal operators reach as far as they can, as in PRISM and Storm:
    `G F "a" & "b"` is `G F ("a" & "b")`. A property may have a name, `"p1": ...`, and `//`
    begins a comment.

    Args:
      text: one property or several.

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
        return _Parser(text).properties()
    except RecursionError:
        raise ValueError(
            "property: parentheses or operators are nested too deeply; split the formula."
        ) from None


def parse_property(text: str) -> Property:
    """The one property in a text; see :func:`parse_properties`.

    Args:
      text: one property.

    Returns:
      The property.

    Raises:
      ValueError: there is an error, or not exactly one property.

    Example:
      >>> print(parse_property('R{"steps"}min=? [ F "goal" ]').reward)
      steps
    """
    found = parse_properties(text)
    if len(found) != 1:
        raise ValueError(f"property: {text!r} holds {len(found)} properties; give one.")
    return found[0]


# --- tokens -----------------------------------------------------------------------------------


class _Token(NamedTuple):
    kind: str
    text: str
    start: int
    end: int


_TOKEN = re.compile(
    r"""
    (?P<space>(?:\s+|//[^\n]*)+)
  | (?P<quoted>"(?:\\["\\]|[^"])*+")
  | (?P<number>(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)
  | (?P<word>[A-Za-z_][A-Za-z0-9_]*)
  | (?P<sign><=>|=>|<=|>=|!=|&&|\|\||[-<>=&|!()\[\]{},;:?/+*])
""",
    re.VERBOSE,
)
_OPERATOR = re.compile(r"(P|R|T|LRA|S)(max|min)?(max|min)?")
_DIRECTIONS = ("max", "min", "maxmax", "maxmin", "minmax", "minmin")
_MAX_DIGITS = 400  # of a number and of its exponent's value, as none means more


def _tokens(text: str) -> list[_Token]:
    found, place = [], 0
    while place < len(text):
        match = _TOKEN.match(text, place)
        if match is None:
            hint = ". The quote is never closed" if text[place] == '"' else ""
            raise ValueError(
                pointed(
                    "property",
                    text,
                    place,
                    repr(text[place]),
                    f"a property's signs and names{hint}",
                )
            )
        kind = str(match.lastgroup)
        if kind == "word" and re.fullmatch("[XFG]{2,}", match[0]):  # GF"a"
            found += [
                _Token("word", letter, place + i, place + i + 1)
                for i, letter in enumerate(match[0])
            ]
        elif kind != "space":
            found.append(_Token(kind, match[0], place, match.end()))
        place = match.end()
    return [*found, _Token("end", "", len(text.rstrip()), len(text.rstrip()))]


# --- grammar ----------------------------------------------------------------------------------

_Path = Formula | Bounded
_STATE = "a state formula: labels in quotes, true, false, ! & | => <=>"


class _Parser:
    """Recursive-descent parser; each method reads the construct of its name."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens = _tokens(text)
        self.place = 0

    @property
    def token(self) -> _Token:
        return self.tokens[self.place]

    def error(self, wanted: str, token: _Token | None = None) -> ValueError:
        token = token or self.token
        found = "the end" if token.kind == "end" else repr(token.text)
        return ValueError(pointed("property", self.text, token.start, found, wanted))

    def take(self) -> _Token:
        token = self.token
        self.place += token.kind != "end"
        return token

    def accept(self, *texts: str) -> str | None:
        """The next token, if it is one of these signs or words."""
        if self.token.text in texts and self.token.kind in ("sign", "word"):
            return self.take().text
        return None

    def expect(self, sign: str, after: str = "") -> None:
        if not self.accept(sign):
            raise self.error(f"{sign!r}{after}")

    # --- properties ---

    def properties(self) -> tuple[Property, ...]:
        found = []
        while self.token.kind != "end":
            if self.accept(";"):
                continue
            if self.token.text in ("const", "label", "formula") and self.token.kind == "word":
                raise self.error(
                    "a property; constants, labels and formulas are not read from "
                    "property files: write numbers and the model's labels"
                )
            name = None
            if self.token.kind == "quoted":
                name = self.quoted()
                self.expect(":", " between a name and its property")
            found.append(self.property_(name))
        if not found:
            raise self.error('a property, such as Pmax=? [ F "goal" ]')
        return tuple(found)

    def property_(self, name: str | None = None) -> Property:
        start = self.token
        if self.accept("multi"):
            return self.multi(start, name)
        match = _OPERATOR.fullmatch(start.text) if start.kind == "word" else None
        if match is None:
            raise self.error("a property: P, Pmax, Pmin, R, Rmax, Rmin, T, LRA or multi(...)")
        self.take()
        operator, objective = ("LRA" if match[1] == "S" else match[1]), match[2]
        nature = match[3]
        reward = None
        if operator == "R" and self.accept("{"):
            reward = self.quoted()
            self.expect("}")
        if objective is None:  # R{"name"}max, with max after the name
            both = self.accept(*_DIRECTIONS) or ""
            objective, nature = both[:3] or None, both[3:] or None
        relation, threshold = self.comparison(operator)
        self.expect("[")
        path = _CONTENT[operator](self)
        self.expect("]", " or an operator")
        text = self.text[start.start : self.tokens[self.place - 1].end]
        fields: dict[str, Any] = {"operator": operator, "objective": objective}
        fields |= {"relation": relation, "threshold": threshold, "reward": reward, "path": path}
        fields["nature"] = nature
        return Property(text, **fields, name=name)

    def multi(self, start: _Token, name: str | None) -> Property:
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
        text = self.text[start.start : self.tokens[self.place - 1].end]
        return Property(text, "multi", parts=tuple(parts), name=name)

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

    # --- numbers and names ---

    def quoted(self) -> str:
        if self.token.kind != "quoted":
            raise self.error("a name in double quotes")
        return re.sub(r'\\(["\\])', r"\1", self.take().text[1:-1])

    def number(self, signed: bool = False) -> Fraction:
        sign = -1 if signed and self.accept("-") else 1
        value = self.plain_number()
        if self.accept("/"):
            start = self.token
            divisor = self.plain_number()
            if not divisor:
                raise self.error("a divisor other than 0", start)
            value /= divisor
        return sign * value

    def plain_number(self) -> Fraction:
        text = self.token.text
        if self.token.kind != "number":
            raise self.error("a number")
        exponent = re.split("[eE]", text)[1:] or ["0"]
        if len(text) > _MAX_DIGITS or abs(int(exponent[0])) > _MAX_DIGITS:
            raise self.error(f"a number of at most {_MAX_DIGITS} digits")
        return Fraction(self.take().text)

    def steps(self) -> int:
        start = self.token
        value = self.number()
        if value.denominator != 1:
            raise self.error("a whole number of steps", start)
        return int(value)

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
        if self.accept("("):
            found = self.path()
            self.expect(")", " or an operator")
            return found
        if token.kind == "quoted":
            name = self.quoted()
            if not name:
                raise self.error("a label's name between the quotes", token)
            return Formula("ap", proposition=name)
        if constant := self.accept("true", "false"):
            return Formula(constant)
        if token.kind == "word" and token.text in "XFG":
            return self.prefixed()
        if token.kind == "word" and _OPERATOR.fullmatch(token.text):
            raise self.error("a label in quotes or an operator; properties are not nested")
        if token.kind == "word":
            raise self.error(
                f'a label in double quotes, such as "{token.text}"; variables of a '
                "model are not read"
            )
        raise self.error("a label in quotes, true, false, '(', '!' or one of X F G")

    # --- bounds ---

    def bound(self) -> Bounded | None:
        """The bound after an operator, as one on nothing yet."""
        empty = Bounded("U", TRUE, TRUE)
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
        reward = self.quoted()
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
            raise self.error(
                "a bound on a reward outermost and on state formulas only",
                self.tokens[self.place - 1],
            )
        if max(path.lower, path.upper or 0) > MAX_UNFOLDED_STEPS:
            raise self.error(
                f"a bound of at most {MAX_UNFOLDED_STEPS} steps inside of a formula; outermost and "
                "on state formulas it may be any",
                self.tokens[self.place - 1],
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

    def reach_content(self, start: _Token, wanted: str) -> Formula:
        found = self.path()
        if isinstance(found, Bounded) or found.operator != "F" or not is_boolean(found.operands[0]):
            raise self.error(wanted, start)
        return found


_CONTENT: dict[str, Callable[[_Parser], Formula | Bounded | Earned]] = {
    "P": _Parser.path_content,
    "R": _Parser.reward_content,
    "T": _Parser.steps_content,
    "LRA": _Parser.state_content,
}
