"""Declarations and expressions in the text of properties, written as in programs."""

from __future__ import annotations

import bisect
from fractions import Fraction

from jaxltl.core.language.expressions import Expression, literal, substitute
from jaxltl.core.language.parser import ADDITIVE, ExpressionParser
from jaxltl.core.language.source import LanguageError
from jaxltl.core.logic.comparisons import Comparison, Definitions
from jaxltl.core.logic.property_tokens import TokenStream


class ExpressionStream(TokenStream):
    """Tokens with the names that are defined so far."""

    def __init__(self, text: str, known: Definitions) -> None:
        super().__init__(text)
        self.known = known
        self.names = dict(known.names)
        self.labels: dict[str, Comparison] = {}  # that the text defines
        self.starts = [token.start for token in self.tokens]

    def declaration(self) -> None:
        """A constant, a formula or a label."""
        kind, type_ = self.take().text, None
        if kind == "const":
            type_ = self.accept("int", "double", "bool") or "int"
        start = self.token
        name = self.quoted() if kind == "label" else self.take().text
        if start.kind not in ("quoted", "word") or name in self.names:
            raise self.error("a name that is not declared yet", start)
        if kind == "const" and not self.accept("="):
            if name not in self.known.given:
                raise self.error(f"a value of {name}, here or as --const {name}=...", start)
            value = literal(self.known.given[name])
        else:
            if kind != "const":
                self.expect("=")
            value = self.expression(0)
            if kind == "const" and not value.is_literal:
                raise self.error("an expression of constants", start)
        if kind == "label":
            self.labels[name] = Comparison(f'"{name}"', value)
        else:
            if type_ == "double" and value.is_literal and isinstance(value.value, int):
                value = literal(float(value.value))
            self.names[name] = value
        self.expect(";", " at the end of a declaration")

    def expression(self, level: int) -> Expression:
        """An expression with constants and formulas substituted."""
        try:
            parser = ExpressionParser(self.text, self.token.start)
            found = parser.expression(level)
            meanings = {f'"{name}"': label.expression for name, label in self.labels.items()}
            found = substitute(found, {**self.names, **meanings})
        except LanguageError as error:
            place = bisect.bisect_left(self.starts, error.place)
            token = self.tokens[min(place, len(self.tokens) - 1)]
            raise self.error(_expected(error.message), token) from None
        self.place = bisect.bisect_left(self.starts, parser.end)
        return found

    def plain_number(self) -> Fraction:
        """A number, or an expression of constants."""
        follows = self.tokens[min(self.place + 1, len(self.tokens) - 1)].text
        if self.token.kind == "number" and follows not in ("+", "-", "*", "^"):
            return super().plain_number()
        start, before = self.token, self.place
        if start.kind in ("number", "word") or start.text == "(":
            value = self.expression(ADDITIVE)
            if value.is_literal and not isinstance(value.value, bool):
                return Fraction(str(value.value))
            self.place = before
        return super().plain_number()

    def reward_name(self) -> str:
        """A name in quotes, or the number of a reward structure from 1."""
        start = self.token
        if start.kind != "number" or not self.known.rewards:
            return self.quoted()
        number = self.steps()
        if not 1 <= number <= len(self.known.rewards):
            raise self.error(
                f"the number of a reward structure, 1 to {len(self.known.rewards)}", start
            )
        return self.known.rewards[number - 1]


def _expected(message: str) -> str:
    """The expected syntax, for an error in an expression."""
    return message.partition("expected ")[2].rstrip(".") or message.rstrip(".")
