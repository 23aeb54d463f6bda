"""Tokens of properties, and the declarations and expressions in their text."""

from __future__ import annotations

import bisect
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple, TypeVar, cast

from jaxltl.core.language.exact import exact_tree, exact_value, is_inexact
from jaxltl.core.language.expressions import (
    RELATIONS,
    TRUE,
    Expression,
    LanguageError,
    literal,
    names_in,
    substitute,
)
from jaxltl.core.language.parser import ADDITIVE, ExpressionParser
from jaxltl.core.logic.comparisons import Comparison, Definitions
from jaxltl.core.logic.ltl import pointed
from jaxltl.core.logic.property import Property

_Definitions = tuple[tuple[str, Comparison | Property], ...]
_Content = TypeVar("_Content")


_RELATIONS = (*RELATIONS, "=", "!=")
_CONNECTIVES = ("!", "&", "|", "=>", "<=>")
_OPERATORS = ("+", "-", "*", "/", "^")  # that continue a number as an expression
AFTER_OPERAND = ("=", "!=", "<", "<=", ">", ">=", "+", "-", "*", "/", "^", "?")
BOUNDS = ("<=", "<", ">=", ">", "=", "[", "{", "^")  # what follows a bounded operator
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
  | (?P<sign><=>|<<|>>|\[\[|=>|<=|>=|!=|&&|\|\||[-<>=&|!()\[\]{},;:?/+*%^'])
  | (?P<unknown>.)
""",
    re.VERBOSE,
)


def _tokens(text: str) -> list[Token]:
    tokens, place = [], 0
    while place < len(text):
        match = _TOKEN.match(text, place)
        assert match is not None
        kind = str(match.lastgroup)
        # GF"a" is G F "a".
        pieces = match[0] if re.fullmatch("[XFG]{2,}", match[0]) else [match[0]]
        for piece in pieces if kind != "space" else ():
            tokens.append(Token(kind, piece, place, place + len(piece)))
            place += len(piece)
        place = match.end()
    end = len(text.rstrip())
    return [*tokens, Token("end", "", end, end)]


class TokenStream:
    """The tokens of a text, the place in them, and the names that are defined so far."""

    def __init__(self, text: str, known: Definitions) -> None:
        self.text, self.known = text, known
        self.tokens, self.place = _tokens(text), 0
        self.starts = [token.start for token in self.tokens]
        self.names = dict(known.names)
        self.labels: dict[str, Comparison] = {}  # that the text defines
        self.rational: dict[str, Expression] = {}  # constants of the text, in exact arithmetic
        self.definitions: dict[str, Comparison | Property] = {}  # of the property being read
        self.tree = TRUE  # the last expression, before substitution

    @property
    def token(self) -> Token:
        return self.tokens[self.place]

    def error(self, wanted: str, token: Token | None = None) -> ValueError:
        token = token or self.token
        if token.kind == "unknown":
            hint = ". The quote is never closed" if token.text == '"' else ""
            wanted = f"a property's signs and names{hint}"
        actual = "the end" if token.kind == "end" else repr(token.text)
        return ValueError(pointed("property", self.text, token.start, actual, wanted))

    def require(self, holds: bool, wanted: str, token: Token | None = None) -> None:
        if not holds:
            raise self.error(wanted, token)

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
        self.one_of((sign,), f"{sign!r}{after}")

    def one_of(self, texts: Sequence[str], wanted: str) -> str:
        word = self.accept(*texts)
        if word is None:
            raise self.error(wanted)
        return word

    @property
    def last(self) -> Token:
        return self.tokens[self.place - 1]

    # --- numbers and names ---

    def quoted(self) -> str:
        self.require(self.token.kind == "quoted", "a name in double quotes")
        return re.sub(r'\\(["\\])', r"\1", self.take().text[1:-1])

    def number(self, signed: bool = False) -> Fraction:
        """A number, a fraction of two, or an expression of constants, in exact arithmetic."""
        start, before = self.token, self.place
        sign = -1 if signed and self.accept("-") else 1
        is_plain = self.token.kind == "number"
        if is_plain:
            value = self.plain_number()
            if self.token.text == "/" and self.tokens[self.place + 1].kind == "number":
                self.take()
                place = self.token
                divisor = self.plain_number()
                self.require(divisor != 0, "a divisor other than 0", place)
                value /= divisor
            if self.token.text not in _OPERATORS:
                return sign * value
        self.place = before
        begins = is_plain or sign < 0 or start.kind == "word" or start.text == "("
        self.require(begins, "a number")
        tree = self.expression(ADDITIVE)
        is_number = tree.is_literal and not isinstance(tree.value, bool)
        self.require(is_number, "a number", start)
        exact = exact_value(*self.rational_tree())
        if exact is None:
            self.require(math.isfinite(cast(float, tree.value)), "a finite number", start)
            exact = Fraction(str(tree.value))
        return exact

    def plain_number(self) -> Fraction:
        """A decimal."""
        start = self.token
        self.require(start.kind == "number", "a number")
        exponent = re.split("[eE]", start.text)[1:] or ["0"]
        short = len(start.text) <= _MAX_DIGITS and abs(int(exponent[0])) <= _MAX_DIGITS
        self.require(short, f"a number of at most {_MAX_DIGITS} digits")
        return Fraction(self.take().text)

    def rational_tree(self) -> tuple[Expression, dict[str, Expression]]:
        """The last expression and the names in it, both in exact arithmetic."""
        used = names_in(self.tree)
        names = {name: exact_tree(e) for name, e in self.names.items() if name in used}
        if not used <= self.rational.keys():
            names |= self.known.rational_names[0]
        return exact_tree(self.tree, self.text), names | self.rational

    def steps(self) -> int:
        start = self.token
        value = self.number()
        self.require(value.denominator == 1, "a whole number of steps", start)
        return int(value)

    # --- declarations and expressions ---

    def declaration(self) -> None:
        """A constant, a formula or a label."""
        kind = self.take().text
        type_ = (self.accept("int", "double", "bool") or "int") if kind == "const" else None
        start = self.token
        name = self.quoted() if kind == "label" else self.take().text
        exact: Fraction | None
        fresh = start.kind in ("quoted", "word") and name not in self.names
        self.require(fresh, "a name that is not declared yet", start)
        if kind == "const" and not self.accept("="):
            wanted = f"a value of {name}, here or as --const {name}=..."
            self.require(name in self.known.constant_values, wanted, start)
            value = literal(self.known.constant_values[name])
            number = self.known.rational_names[1].get(name)
            exact = None if number is None or isinstance(number, bool) else Fraction(number)
        else:
            if kind != "const":
                self.expect("=")
            begin = self.token
            comparison = self.state_expression(0)
            value = substitute(self.tree, self.names)
            plain = kind == "label" or not comparison.definitions
            self.require(plain, "an expression without properties", start)
            constant = kind != "const" or value.is_literal
            self.require(constant, "an expression of constants", start)
            exact = exact_value(*self.rational_tree()) if kind == "const" else None
            if kind == "const":
                is_truth = isinstance(value.value, bool)
                whole = type_ != "int" or (exact if exact is not None else value.value) == int(
                    cast(int, value.value)
                )
                wanted = {"bool": "true or false", "int": "an integer"}.get(str(type_), "a number")
                self.require(is_truth == (type_ == "bool") and whole, wanted, begin)
        if kind == "label":
            self.labels[name] = replace(comparison, text=f'"{name}"')
        else:
            if exact is not None:
                self.rational[name] = literal(exact if type_ == "double" else int(exact))
            if type_ == "double" and value.is_literal and isinstance(value.value, int):
                value = literal(float(value.value))
            self.names[name] = value
        self.expect(";", " at the end of a declaration")

    def operands(self) -> ExpressionParser:
        """The parser of an expression that begins here."""
        return ExpressionParser(self.text, self.token.start)

    def scoped(self, read: Callable[[], _Content]) -> tuple[_Content, _Definitions]:
        """The result of a method of the parser, and the definitions in its text."""
        outer, self.definitions = self.definitions, {}
        try:
            content = read()
            return content, tuple(self.definitions.items())
        finally:
            self.definitions = outer

    def state_expression(self, level: int) -> Comparison:
        """An expression over variables, labels, and results of properties."""
        start = self.token
        tree, defined = self.scoped(lambda: self.expression(level))
        return Comparison(self.written(start), self.in_fractions(tree), defined)

    def written(self, start: Token) -> str:
        """The text from a token up to here."""
        return self.text[start.start : self.last.end]

    @property
    def meanings(self) -> dict[str, Expression]:
        """The expressions of labels that the text defines without properties."""
        labels = {f'"{name}"': label for name, label in self.labels.items()}
        return {name: x.expression for name, x in labels.items() if not x.definitions}

    def in_fractions(self, tree: Expression) -> Expression:
        """The last expression in exact arithmetic, `tree`, if doubles may differ from it."""
        used = [self.names[name] for name in names_in(self.tree) & self.names.keys()]
        if not any(map(is_inexact, (self.tree, *used))):
            return tree
        tree_, names = self.rational_tree()
        try:
            return substitute(tree_, names | self.meanings)
        except LanguageError:
            return tree

    def expression(self, level: int) -> Expression:
        """An expression with constants and formulas substituted."""
        end: int | None = None
        try:
            self.require(self.token.kind != "unknown", "an expression")
            parser = self.operands()
            self.tree = tree = parser.expression(level)
            end = parser.end
            self.kind(tree)
            tree = substitute(tree, {**self.names, **self.meanings})
        except LanguageError as error:
            place = bisect.bisect_left(self.starts, error.place)
            token = self.tokens[min(place, len(self.tokens) - 1)]
            # An error of types or values comes after the expression, and before one of another reading.
            self.place = place if end is None else bisect.bisect_left(self.starts, end)
            self.place = min(self.place, len(self.tokens) - 1)
            raise self.error(_expected(error.message), token) from None
        self.place = bisect.bisect_left(self.starts, parser.end)
        return tree

    def kind(self, e: Expression) -> bool | None:
        """True for a truth value, False for a number, None if unknown; LanguageError for a wrong operand."""
        kinds = [self.kind(x) for x in e.operands]
        truths, is_choice = e.operator in _CONNECTIVES, e.operator == "?:"
        for operand, kind in zip(e.operands[: 1 if is_choice else None], kinds, strict=False):
            if kind is not None and kind != (truths or is_choice) and e.operator not in ("=", "!="):
                actual, wanted = (
                    ("a truth value", "a number") if kind else ("a number", "a truth value")
                )
                sign = "-" if e.operator == "neg" else e.operator
                raise LanguageError(
                    operand.place, f"expected {wanted}; {sign} is applied to {actual}."
                )
        cases = kinds[1:] if is_choice else kinds
        if e.operator in ("=", "!=", "?:") and {True, False} <= set(cases):
            raise LanguageError(
                e.place, "expected two numbers or two truth values, not one of each."
            )
        if e.operator == "name":
            name = str(e.value)
            if (meaning := self.definitions.get(name)) is not None:
                tree = meaning.expression  # of an expression a comparison, else None
                tree = tree.expression if isinstance(tree, Comparison) else tree
                is_known = (
                    meaning.is_number or tree is None or tree.operator in _RELATIONS + _CONNECTIVES
                )
                return not meaning.is_number if is_known else None
            if (value := self.names.get(name)) is not None and value.operator != "name":
                # Formulas may be large, and are checked where they are defined.
                is_truth = value.operator in _RELATIONS + _CONNECTIVES
                is_truth |= value.is_literal and isinstance(value.value, bool)
                return None if value.operator == "?:" else is_truth
            name = name if value is None else str(value.value)
            return True if name.startswith('"') else False if name in self.known.integers else None
        if e.operator == "literal":
            return isinstance(e.value, bool)
        return (
            next((x for x in cases if x is not None), None)
            if is_choice
            else truths or e.operator in _RELATIONS
        )

    def reward_name(self) -> str:
        """A name in quotes, or the number of a reward structure from 1."""
        start = self.token
        if start.kind != "number" or not self.known.rewards:
            return self.quoted()
        number, count = self.steps(), len(self.known.rewards)
        wanted = f"the number of a reward structure, 1 to {count}"
        self.require(1 <= number <= count, wanted, start)
        return self.known.rewards[number - 1]


def _expected(message: str) -> str:
    """The expected syntax, for an error in an expression."""
    return message.partition("expected ")[2].rstrip(".") or message.rstrip(".")


def instead_of(word: str) -> str:
    """The syntax expected in place of an unknown word, for error messages."""
    if word in ("Y", "Z", "O", "H", "S", "B", "T"):
        return "an operator of the future, X F G U W R; those of the past, such as Y O H S, are not read"
    if set(word) <= set("XFGUWRM"):
        return (
            "X, F or G, with blanks between operators; U, W and R stand between two formulas, and "
            "a M b is (b) U (a & b)"
        )
    return f'a label in double quotes, such as "{word}", or a comparison of variables, such as {word}=1'
