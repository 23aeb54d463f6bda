"""Source text of a program: tokens, and errors with line and column."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import NoReturn, TypeVar

Item = TypeVar("Item")
MAX_TOKENS = 2_000_000  # of a text, about 200 MB of memory
_TOKEN = re.compile(
    r"""
    (?P<space>(?:\s+|//[^\n]*)+)
  | (?P<quoted>"[^"\n]*")
  | (?P<real>[0-9]+\.[0-9]+(?:[eE][+-]?[0-9]+)?|[0-9]+[eE][+-]?[0-9]+|\.[0-9]+(?:[eE][+-]?[0-9]+)?)
  | (?P<integer>[0-9]+)
  | (?P<word>[A-Za-z_][A-Za-z0-9_]*)
  | (?P<sign><=>|=>|<=|>=|!=|->|\.\.|[-<>=&|!()\[\]{},;:?/+*^%'])
""",
    re.VERBOSE,
)


class LanguageError(ValueError):
    """An error at an offset of a text; :meth:`Source.located` adds file, line and column."""

    def __init__(self, place: int, message: str) -> None:
        super().__init__(message)
        self.place, self.message = place, message


@dataclass(frozen=True)
class Source:
    """A text and the name under which errors mention it."""

    text: str
    name: str = "model"

    def position(self, place: int) -> tuple[int, int]:
        """Line and column of an offset, both from 1."""
        before = self.text.rfind("\n", 0, place)
        return self.text.count("\n", 0, place) + 1, place - before

    def located(self, error: LanguageError) -> ValueError:
        """The error with file, line and column."""
        line, column = self.position(max(error.place, 0))
        return ValueError(f"{self.name!r}, line {line}, column {column}: {error.message}")


class TokenReader:
    """The tokens of a text from an offset on, and a place in them.

    The last token has the kind "end", or "unknown" at a character that begins no token: a reader
    that stops before it has no error.
    """

    def __init__(self, text: str, start: int = 0) -> None:
        self.kinds: list[str] = []
        self.texts: list[str] = []
        self.starts: list[int] = []
        self.at = 0
        place, match = start, _TOKEN.match
        while found := match(text, place):
            if found.lastgroup != "space":
                self._append(str(found.lastgroup), found[0], place)
            place = found.end()
            if len(self.kinds) > MAX_TOKENS:
                raise LanguageError(place, f"the text has more than {MAX_TOKENS} words and signs.")
        self._append("unknown" if place < len(text) else "end", text[place : place + 1], place)

    def _append(self, kind: str, text: str, start: int) -> None:
        self.kinds.append(kind)
        self.texts.append(text)
        self.starts.append(start)

    @property
    def place(self) -> int:
        """Offset of the next token."""
        return self.starts[self.at]

    @property
    def end(self) -> int:
        """Offset of the end of the last token that was taken."""
        return self.starts[self.at - 1] + len(self.texts[self.at - 1])

    def fail(self, expected: str, at: int | None = None) -> NoReturn:
        """Raises LanguageError: another token is expected."""
        at = self.at if at is None else at
        found = "the end" if self.kinds[at] == "end" else repr(self.texts[at])
        raise LanguageError(self.starts[at], f"found {found}, expected {expected}.")

    def accept(self, text: str) -> bool:
        """Takes the next token if it is this sign or word."""
        if self.texts[self.at] == text and self.kinds[self.at] != "end":
            self.at += 1
            return True
        return False

    def expect(self, text: str, after: str = "") -> None:
        """Takes the next token, which must be this sign or word."""
        if not self.accept(text):
            self.fail(f"{text!r}{after}")

    def separated(self, item: Callable[[], Item], sign: str = ",") -> list[Item]:
        """Takes items with a sign between each two."""
        found = [item()]
        while self.accept(sign):
            found.append(item())
        return found

    def word(self, expected: str, kind: str = "word") -> str:
        """Takes a name."""
        if self.kinds[self.at] != kind:
            self.fail(expected)
        self.at += 1
        return self.texts[self.at - 1]

    def quoted(self, expected: str) -> str:
        """Takes a name in double quotes."""
        return self.word(expected, "quoted")[1:-1]
