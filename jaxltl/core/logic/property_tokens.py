"""Tokens of properties, and the reading of signs, names and numbers."""

from __future__ import annotations

import re
from fractions import Fraction
from typing import NamedTuple

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
