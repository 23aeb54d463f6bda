"""Lexer, grammar and parse trees of the HOA format."""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from lark import Lark, Token
    from lark.exceptions import UnexpectedToken

# A label or an acceptance formula: an operator and its operands.
Tree: TypeAlias = tuple[Any, ...]
Item: TypeAlias = list[Any]  # of the header: its name and its values, tokens or trees
TRUE: Tree = ("true",)
FALSE: Tree = ("false",)


def unquoted(token: str) -> str:
    """A quoted token without quotes and escapes."""
    return re.sub(r"(?s)\\(.)", r"\1", token[1:-1])


_TOKEN = re.compile(
    r"""(?P<SPACE>[ \t\r\n]+)
      | (?P<COMMENT>/\*)
      | (?P<STRING>"(?:\\.|[^"\\])*")
      | (?P<MARK>--(?:BODY|END|ABORT)--)
      | (?P<HEADERNAME>[A-Za-z_][0-9A-Za-z_.-]*:)
      | (?P<IDENTIFIER>[A-Za-z_][0-9A-Za-z_.-]*)
      | (?P<ANAME>@[0-9A-Za-z_-]+)
      | (?P<INT>[0-9]+)
      | (?P<SIGN>[][(){}&|!])""",
    re.VERBOSE | re.DOTALL,
)

_HEADERS = "HOA States Start AP Alias Acceptance acc-name tool name properties State"
KNOWN_HEADERS = {f"{name}:": name.upper().replace("-", "_") for name in _HEADERS.split()}

# Lark omits terminals with a leading underscore from the trees.
_TERMINAL = {
    **KNOWN_HEADERS,
    "t": "BOOLEAN",
    "f": "BOOLEAN",
    "--BODY--": "_BODY",
    "--END--": "_END",
    "--ABORT--": "ABORT",
    **dict(zip("[](){}", ["_LEFT", "_RIGHT", "_OPEN", "_CLOSE", "_BEGIN", "_FINISH"], strict=True)),
    **dict(zip("&|!", ("_AND", "_OR", "NOT"), strict=True)),
}


def error_at(line: int | None, message: str) -> ValueError:
    """A ValueError that names the line."""
    return ValueError(f"read_hoa: line {line}: {message}")


def split_texts(text: str) -> list[list[Token]]:
    """Tokens of each automaton, up to `--END--`; automata with `--ABORT--` are skipped."""
    if not isinstance(text, str):
        raise ValueError(
            f"read_hoa: expected text in the Hanoi format, got {type(text).__name__}. "
            "Pass the contents of the file."
        )
    automata: list[list[Token]] = []
    current: list[Token] = []
    for token in _tokens(text):
        current.append(token)
        if token.type == "_END":
            automata.append(current)
        if token.type in ("_END", "ABORT"):
            current = []
    return [*automata, current] if current else automata


def _tokens(text: str) -> Iterator[Token]:
    from lark import Token  # see _parser

    position, line, line_start = 0, 1, 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None or match.lastgroup is None:
            problem = f"column {position - line_start + 1}: found {text[position]!r}"
            if text[position] == '"':
                raise error_at(line, f"{problem}, a quote that is never closed. Close it.")
            raise error_at(line, f"{problem}, which no token starts with. Delete it.")
        kind, value, end = match.lastgroup, match[0], match.end()
        if kind == "COMMENT":
            end = _comment_end(text, position, line)
        elif kind != "SPACE":
            # At most ten digits are converted; Python refuses thousands of them.
            if kind == "INT" and (value != str(int(value[:10])) or int(value) >= 2**31):
                raise error_at(
                    line,
                    f"{value[:20]} is not a number below 2^31 without leading zeros. Correct it.",
                )
            if kind != "STRING":
                kind = _TERMINAL.get(value, kind)
            yield Token(kind, value, position, line, position - line_start + 1)
        newlines = text.count("\n", position, end)
        if newlines:
            line, line_start = line + newlines, text.rindex("\n", position, end) + 1
        position = end


def _comment_end(text: str, start: int, line: int) -> int:
    """End of the (nested) comment that starts at `start`."""
    depth = 0
    for match in re.compile(r"/\*|\*/").finditer(text, start):
        depth += 1 if match[0] == "/*" else -1
        if depth == 0:
            return match.end()
    raise error_at(line, "the comment that starts here is never closed. Close it with */.")


_GRAMMAR = f"""
start: header body
header: HOA IDENTIFIER item* _BODY
item: STATES INT
    | START targets
    | AP INT STRING*
    | ALIAS ANAME label
    | ACCEPTANCE INT acceptance
    | ACC_NAME IDENTIFIER (BOOLEAN | INT | IDENTIFIER)*
    | TOOL STRING STRING?
    | NAME STRING
    | PROPERTIES property*
    | HEADERNAME (BOOLEAN | INT | STRING | IDENTIFIER)*
property: [NOT] IDENTIFIER
body: state* _END
state: STATE [guard] INT [STRING] [marks] edge*
edge: [guard] targets [marks]
guard: _LEFT label _RIGHT
targets: INT (_AND INT)*
marks: _BEGIN INT* _FINISH
?label: conjunction | conjunction (_OR conjunction)+ -> disjunction
?conjunction: literal | literal (_AND literal)+
?literal: NOT literal -> negation | _OPEN label _CLOSE
        | INT -> proposition | ANAME -> alias | BOOLEAN -> constant
?acceptance: accepted | accepted (_OR accepted)+ -> disjunction
?accepted: atom | atom (_AND atom)+ -> conjunction
?atom: IDENTIFIER _OPEN [NOT] INT _CLOSE | _OPEN acceptance _CLOSE | BOOLEAN -> constant
%declare {" ".join(sorted({*_TERMINAL.values()} - {"ABORT"}))}
%declare INT STRING IDENTIFIER ANAME HEADERNAME
"""


@dataclass(frozen=True)
class ParsedEdge:
    """An edge of an automaton, as parsed."""

    label: Tree | None
    targets: list[Token]
    marks: list[Token]
    line: int


@dataclass(frozen=True)
class ParsedState:
    """Parsed state with its edges."""

    label: Tree | None
    number: Token
    name: str | None
    marks: list[Token]
    edges: list[ParsedEdge]
    line: int


@functools.cache
def _parser() -> Lark:
    from lark import Lark  # deferred: importing Lark takes 0.1 s
    from lark.lexer import Lexer

    class Ready(Lexer):
        """Lexer that passes tokens through; Lark terminals cannot match nested comments."""

        def __init__(self, _: object) -> None: ...

        def lex(self, tokens: list[Token]) -> Iterator[Token]:  # type: ignore[override]
            return iter(tokens)

    actions = SimpleNamespace(
        start=tuple,
        header=lambda c: (c[1], c[2:]),
        item=list,
        property=lambda c: "".join(filter(None, c)),
        body=list,
        state=lambda c: ParsedState(
            c[1], c[2], c[3] and unquoted(c[3]), c[4] or [], c[5:], c[0].line
        ),
        edge=lambda c: ParsedEdge(c[0], c[1], c[2] or [], c[1][0].line),
        guard=lambda c: c[0],
        targets=list,
        marks=list,
        disjunction=lambda c: ("or", *c),
        conjunction=lambda c: ("and", *c),
        negation=lambda c: ("not", c[1]),
        proposition=lambda c: ("proposition", c[0]),
        alias=lambda c: ("alias", c[0]),
        constant=lambda c: TRUE if c[0] == "t" else FALSE,
        atom=lambda c: ("atom", *c),
    )
    return Lark(_GRAMMAR, parser="lalr", lexer=Ready, transformer=actions)


def parse_tokens(tokens: list[Token]) -> tuple[tuple[Token, list[Item]], list[ParsedState]]:
    """Parses version, header items and states."""
    from lark.exceptions import UnexpectedToken

    try:
        return _parser().parse(tokens)  # type: ignore[return-value]
    except UnexpectedToken as error:
        raise _syntax_error(tokens, error) from None


_READABLE = {terminal: repr(text) for text, terminal in _TERMINAL.items()} | {
    "BOOLEAN": "t or f",
    "INT": "a number",
    "STRING": "a text in double quotes",
    "IDENTIFIER": "a word",
    "ANAME": "an alias such as @a",
    "HEADERNAME": "a header",
    **dict.fromkeys(set(KNOWN_HEADERS.values()) - {"HOA", "STATE"}, "a header"),
}


def _syntax_error(tokens: list[Token], error: UnexpectedToken) -> ValueError:
    token = error.token
    ended = token.type == "$END"
    place = tokens[-1] if ended else token
    accepted = error.accepts or error.expected
    expected = sorted({_READABLE.get(terminal, terminal) for terminal in accepted})
    alternatives = " or ".join(
        [", ".join(expected[:-1]), expected[-1]] if expected[1:] else expected
    )
    actual = "the end of the text" if ended else repr(str(token))
    hint = " Each automaton ends with --END--." if ended or token.type == "HOA" else ""
    return error_at(
        place.line, f"column {place.column}: found {actual}, expected {alternatives}.{hint}"
    )
