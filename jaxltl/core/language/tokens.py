"""Tokens of texts in the PRISM language."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import islice
from typing import NoReturn, TypeVar

from jaxltl.core.language.expressions import LanguageError

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
  | (?P<unknown>.)
""",
    re.VERBOSE,
)


class TokenReader:
    """The tokens of a text from an offset on, and a place in them; the last one has the kind "end"."""

    pattern = _TOKEN

    def __init__(self, text: str, start: int = 0) -> None:
        tokens = (
            match for match in self.pattern.finditer(text, start) if match.lastgroup != "space"
        )
        matches = list(islice(tokens, MAX_TOKENS + 1))
        if len(matches) > MAX_TOKENS:
            raise LanguageError(
                matches[-1].start(), f"the text has more than {MAX_TOKENS} words and signs."
            )
        self.kinds = [*(str(token.lastgroup) for token in matches), "end"]
        self.texts = [*(token[0] for token in matches), ""]
        self.starts = [*(token.start() for token in matches), len(text)]
        self.at = 0

    @property
    def place(self) -> int:
        """Offset of the next token."""
        return self.starts[self.at]

    @property
    def end(self) -> int:
        """Offset of the end of the last token that was taken."""
        return self.starts[self.at - 1] + len(self.texts[self.at - 1])

    def fail(self, expected: str) -> NoReturn:
        """Raises LanguageError: another token is expected."""
        actual = "the end" if self.kinds[self.at] == "end" else repr(self.texts[self.at])
        raise LanguageError(self.place, f"found {actual}, expected {expected}.")

    def accept(self, text: str) -> bool:
        """Takes the next token if it is this sign or word."""
        accepted = self.texts[self.at] == text
        self.at += accepted
        return accepted

    def expect(self, text: str, after: str = "") -> None:
        """Takes the next token, which must be this sign or word."""
        if not self.accept(text):
            self.fail(f"{text!r}{after}")

    def separated(self, item: Callable[[], Item], sign: str = ",") -> list[Item]:
        """Takes items with a sign between each two."""
        items = [item()]
        while self.accept(sign):
            items.append(item())
        return items

    def word(self, expected: str, kind: str = "word") -> str:
        """Takes a name."""
        if self.kinds[self.at] != kind:
            self.fail(expected)
        self.at += 1
        return self.texts[self.at - 1]

    def quoted(self, expected: str) -> str:
        """Takes a name in double quotes."""
        return self.word(expected, "quoted")[1:-1]
