"""Tokens of properties, and the declarations and expressions in their text."""

from __future__ import annotations

import bisect
import re
from fractions import Fraction
from typing import NamedTuple

from jaxltl.core.language.expressions import Expression, literal, substitute
from jaxltl.core.language.parser import ADDITIVE, ExpressionParser
from jaxltl.core.language.source import LanguageError
from jaxltl.core.logic.comparisons import Comparison, Definitions
from jaxltl.core.logic.ltl import pointed


_MAX_DIGITS = 400  # of a number and of its exponent's value, as none means more


class Token(NamedTuple):
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
  | (?P<sign><=>|=>|<=|>=|!=|&&|\|\||[-<>=&|!()\[\]{},;:?/+*^'])
""",
    re.VERBOSE,
)


def _tokens(text: str) -> list[Token]:
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
                Token("word", letter, place + i, place + i + 1) for i, letter in enumerate(match[0])
            ]
        elif kind != "space":
            found.append(Token(kind, match[0], place, match.end()))
        place = match.end()
    return [*found, Token("end", "", len(text.rstrip()), len(text.rstrip()))]


class TokenStream:
    """The tokens of a text, and the place in them."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.tokens = _tokens(text)
        self.place = 0

    @property
    def token(self) -> Token:
        return self.tokens[self.place]

    def error(self, wanted: str, token: Token | None = None) -> ValueError:
        token = token or self.token
        found = "the end" if token.kind == "end" else repr(token.text)
        return ValueError(pointed("property", self.text, token.start, found, wanted))

    def take(self) -> Token:
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

    @property
    def last(self) -> Token:
        return self.tokens[self.place - 1]

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
