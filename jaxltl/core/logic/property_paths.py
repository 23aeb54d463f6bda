"""Path formulas of properties: a recursive-descent parser."""

from __future__ import annotations

import contextlib
import functools
import re
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from jaxltl.core.language.parser import SIMPLE
from jaxltl.core.logic.bounded import Bounded, Conditional, unfolded
from jaxltl.core.logic.comparisons import Comparison, Definitions
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import FALSE, TRUE, Formula
from jaxltl.core.logic.property import MAX_UNFOLDED_STEPS, Property
from jaxltl.core.logic.property_tokens import AFTER_OPERAND, NUMBERS
from jaxltl.core.logic.property_tokens import Token, TokenStream, instead_of

OPERATOR = re.compile(r"(P|R|T|LRA|S)(max|min)?(max|min)?")
Path = Formula | Bounded


class PathParser(TokenStream, ABC):
    """Paths, from loosest to tightest; each method reads the construct of its name."""

    def __init__(self, text: str, known: Definitions) -> None:
        super().__init__(text, known)
        self.definitions: dict[str, Comparison | Property] = {}  # of the property being read

    @abstractmethod
    def property_(self, name: str | None = None) -> Property:
        """A nested property."""

    def written(self, start: Token) -> str:
        """The text from a token up to here."""
        return self.text[start.start : self.last.end]

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
            if token.text == "<<" or OPERATOR.fullmatch(token.text):
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
