"""Path formulas of properties: a recursive-descent parser."""

from __future__ import annotations

import bisect
import contextlib
import functools
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

from jaxltl.core.language.expressions import Expression
from jaxltl.core.language.parser import SIMPLE, ExpressionParser
from jaxltl.core.logic.bounded import Bounded, Conditional, unfolded
from jaxltl.core.logic.comparisons import Comparison, Definitions
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import FALSE, TRUE, Formula
from jaxltl.core.logic.property import MAX_UNFOLDED_STEPS, Property
from jaxltl.core.logic.property_tokens import AFTER_OPERAND
from jaxltl.core.logic.property_tokens import Token, TokenStream, instead_of

COALITION = {"<<": ">>", "[[": "]"}  # signs before its players, and after them
OPERATOR = re.compile(r"(P|R|T|LRA|S)(max|min)?(max|min)?")
_BRACKETS = {"E": "[", "A": "[", "filter": "(", "multi": "("}  # after other operators
Path = Formula | Bounded


class _OperandParser(ExpressionParser):
    """Expressions in which properties and names of properties are operands."""

    def __init__(self, stream: PathParser) -> None:
        super().__init__(stream.text, stream.token.start)
        self.stream = stream

    def _atom(self) -> Expression:
        stream, place = self.stream, self.place
        stream.place = min(bisect.bisect_left(stream.starts, place), len(stream.tokens) - 1)
        label = stream.labels.get(self.texts[self.at].strip('"'))
        if self.kinds[self.at] == "quoted" and label is not None and label.definitions:
            stream.take()
            name = stream.define(label)
        elif stream.token.start == place and stream.begins_property():
            name = stream.define(stream.nested())
        else:
            return super()._atom()
        self.at = bisect.bisect_left(self.starts, stream.last.end)
        return Expression("name", value=name, place=place)


class PathParser(TokenStream, ABC):
    """Paths, from loosest to tightest; each method reads the construct of its name."""

    def __init__(self, text: str, known: Definitions) -> None:
        super().__init__(text, known)
        self.places = _names_of_properties(self.tokens)
        self.named: dict[str, Property | None] = {}  # None while it is read

    @abstractmethod
    def property_(self) -> Property:
        """A nested property."""

    @abstractmethod
    def outermost(self) -> Property:
        """A property or an expression of states."""

    def operands(self) -> ExpressionParser:
        return _OperandParser(self)

    def begins_property(self) -> bool:
        """True if the next token begins a property, or is the name of one."""
        token = self.token
        if token.kind == "quoted":
            return token.text in self.places
        if token.kind != "word" or token.text in self.known.known | self.names.keys():
            return token.text in COALITION
        following = self.tokens[min(self.place + 1, len(self.tokens) - 1)].text
        return following == _BRACKETS.get(token.text) or bool(OPERATOR.fullmatch(token.text))

    def nested(self) -> Property:
        """The property that begins here, or that is mentioned by its name."""
        token = self.token
        if token.kind != "quoted":
            return self.property_()
        if token.text not in self.named:
            self.named[token.text], before = None, self.place
            self.place = self.places[token.text]
            self.named[token.text], _ = self.scoped(self.outermost)
            self.place = before
        meaning = self.named[token.text]
        if meaning is None:
            raise self.error("another name; this property depends on itself")
        self.take()
        return meaning

    def condition(self, inside: bool = False) -> Path | Conditional:
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

    def path(self, inside: bool = False) -> Path:
        path = self.condition(inside)
        if not isinstance(path, Conditional):
            return path
        raise self.error("one path; a condition, ||, stands outermost in P", self.last)

    def conjunction(self) -> Path:
        return self.chain("&&", "&", self.until)

    def until(self) -> Path:
        left = self.prefixed()
        operator = self.accept("U", "W", "R")
        if operator is None:
            return left
        bound = self.bound()
        right = self.prefixed()
        again = self.token.text in ("U", "W", "R") and self.token.kind == "word"
        self.require(not again, "parentheses around one of two U, W or R in a row")
        return self.bounded(operator, (self.plain(left), self.plain(right)), bound)

    def prefixed(self) -> Path:
        operator = self.accept("X", "F", "G")
        if operator is None:
            return self.implication()
        start = self.token
        bound = self.bound()
        self.require(bound is None or operator != "X", "a formula; X takes no bound", start)
        return self.bounded(operator, (self.plain(self.prefixed()),), bound)

    def implication(self) -> Path:
        left = self.equivalence()
        if not self.accept("=>"):
            return left
        right = self.equivalence()
        self.require(self.token.text != "=>", "parentheses around one of two => in a row")
        return Formula("->", (self.plain(left), self.plain(right)))

    def equivalence(self) -> Path:
        return self.chain("<=>", "<->", self.disjunction)

    def disjunction(self) -> Path:
        return self.chain("|", "|", lambda: self.chain("&", "&", self.atom))

    def chain(self, sign: str, operator: str, operand: Callable[[], Path]) -> Path:
        first = operand()
        if self.token.text != sign or self.token.kind != "sign":
            return first
        operands = [self.plain(first)]
        while self.accept(sign):
            operands.append(self.plain(operand()))
        if operator == "<->":
            return functools.reduce(lambda f, g: Formula("<->", (f, g)), operands)
        return Formula(operator, tuple(operands))

    def atom(self) -> Path:
        token, before, known = self.token, self.place, dict(self.definitions)
        path = self.simple_atom()
        if self.token.text not in AFTER_OPERAND or token.text in ("!", "X", "F", "G"):
            return path
        # It begins a comparison.
        self.place, self.definitions = before, known
        return self.comparison_of_variables()

    def simple_atom(self) -> Path:
        token = self.token
        if self.accept("!"):
            return ~self.plain(self.atom())
        if token.text == "(" and token.kind == "sign":
            return self.parentheses()
        if self.begins_property():
            nested = self.nested()
            is_number = nested.is_number and self.token.text not in AFTER_OPERAND
            self.require(not is_number, "a nested property with a threshold, such as P>=0.5", token)
            return Formula("ap", proposition=self.define(nested))
        if token.kind == "quoted":
            name = self.quoted()
            self.require(bool(name), "a label's name between the quotes", token)
            if name in self.labels:
                return Formula("ap", proposition=self.define(self.labels[name]))
            return Formula("ap", proposition=name)
        if constant := self.accept("true", "false"):
            return Formula(constant)
        is_name = token.text in self.known.known | self.names.keys()
        if token.kind == "word" and token.text in "XFG" and not is_name:
            return self.prefixed()
        begins = token.kind in ("word", "number") or token.text == "-"
        self.require(begins, "a label in quotes, true, false, '(', '!' or one of X F G")
        return self.comparison_of_variables()

    def define(self, meaning: Comparison | Property) -> str:
        """The name of a proposition that stands for a comparison or a nested property."""
        name = f"[{meaning.text}]"
        self.definitions[name] = meaning
        return name

    def parentheses(self) -> Path:
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
        start, before = self.token, self.place
        comparison = self.state_expression(SIMPLE)
        tree = comparison.expression
        if tree.is_literal and isinstance(tree.value, bool):
            return TRUE if tree.value else FALSE
        is_variable = tree.operator != "name" or tree.value in self.known.variables
        is_defined = is_variable or str(tree.value)[:1] in ('"', "[")
        self.require(is_defined, instead_of(start.text), start)
        self.require(not comparison.is_number, "a comparison, such as x+1<=3")
        if tree.operator == "name" and tree.value in self.known.integers:
            self.place = before  # which an error further on is preferred to
            raise self.error(f"a comparison, such as {tree.value}>0; {tree.value} is a number")
        return Formula("ap", proposition=self.define(comparison))

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

    def bounded(self, operator: str, operands: tuple[Formula, ...], bound: Bounded | None) -> Path:
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

    def plain(self, path: Path) -> Formula:
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


def _names_of_properties(tokens: Sequence[Token]) -> dict[str, int]:
    """The place of each property with a name, by the name in quotes."""
    places: dict[str, int] = {}
    for i, token in enumerate(tokens[1:]):  # i is the place before it
        before = tokens[i - 1] if i else None
        ends = before is None or before.kind != "sign" or before.text in (";", "]", ")")
        if token.text == ":" and tokens[i].kind == "quoted" and ends:
            places.setdefault(tokens[i].text, i + 2)
    return places
