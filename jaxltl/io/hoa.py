"""Deterministic automata in the Hanoi Omega-Automata format, version 1.

The format is described at https://adl.github.io/hoaf/ (Babiak et al. 2015, "The Hanoi
omega-automata format"). Spot, Owl and the tools around them write and read it.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.automata.automaton import Automaton, letter_text, make_automaton
from jaxltl.core.automata.text import prime_cover
from jaxltl.core.logic.diagram import Cube
from jaxltl.core.logic.ltl import Letter, as_letters

if TYPE_CHECKING:
    from lark import Lark, Token
    from lark.exceptions import UnexpectedToken

MAX_FREE_PROPOSITIONS = 12  # 2^12 letters
MAX_PRIORITIES = 256  # the formula of a parity condition nests once for each
MAX_COLORS = 62  # acceptance sets as bits of one int64

# A label or an acceptance formula: an operator and its operands.
_Tree: TypeAlias = tuple[Any, ...]
_TRUE: _Tree = ("true",)
_FALSE: _Tree = ("false",)


def read_hoa(text: str, letters: Iterable[Letter] | None = None) -> Automaton:
    """The one deterministic automaton that a text in the Hanoi format holds.

    Read are labels on edges, on states and implicit ones, aliases, acceptance marks on edges and
    on states, and any acceptance formula; `acc-name:` is not relied on. Buchi, co-Buchi and
    parity conditions of all four styles, and whatever else is decided by the most important set
    that is met infinitely often, keep their states; other conditions are turned into parity.
    Where an edge is missing, a rejecting state is added. Propositions are sorted.

    Args:
        text: The automaton, from `HOA:` to `--END--`.
        letters: The letters that occur, each a collection of proposition names; names that are
            not in the automaton are ignored. None stands for all 2^P subsets.

    Returns:
        An automaton with Buchi acceptance if its priorities are 0 and 1, else with parity
        acceptance. What `write_hoa` wrote has the acceptance it was written from. Letters are in
        the order of the binary numbers with proposition p as bit p.

    Raises:
        ValueError: With the line, for text that breaks the format, and for an automaton that is
            not deterministic; for a text that holds no automaton or several; for more than 12
            propositions without `letters`.

    >>> infinitely_often_a = read_hoa('''
    ... HOA: v1 States: 1 Start: 0 AP: 1 "a" Acceptance: 1 Inf(0)
    ... --BODY-- State: 0 [0] 0 {0} [!0] 0 --END--''')
    >>> infinitely_often_a.acceptance, infinitely_often_a.priority.tolist()
    ('buchi', [[1, 0]])
    """
    found = _texts(text)
    if len(found) != 1:
        raise ValueError(
            f"read_hoa: the text holds {len(found)} automata, expected exactly one. "
            "Read several with read_hoa_stream."
        )
    return _read(found[0], letters)


def read_hoa_stream(text: str, letters: Iterable[Letter] | None = None) -> list[Automaton]:
    """The automata that a text in the Hanoi format holds, one after the other.

    An automaton that ends with `--ABORT--` is left out.

    Args:
        text: The automata, each from `HOA:` to `--END--`.
        letters: As in `read_hoa`, for all of them.

    Raises:
        ValueError: As `read_hoa`.

    >>> always = 'HOA: v1 Start: 0 Acceptance: 0 t --BODY-- State: 0 [t] 0 --END--'
    >>> len(read_hoa_stream(always + always))
    2
    """
    known = None if letters is None else as_letters(letters, "read_hoa: letters")
    return [_read(tokens, known) for tokens in _texts(text)]


def write_hoa(automaton: Automaton, name: str = "") -> str:
    """The automaton in the Hanoi format, version 1.

    Co-safe and safety automata are written as Buchi automata with marks on states, Buchi and
    parity (min even) automata with marks on transitions. If the letters are all subsets of the
    propositions, edges have short labels. Otherwise each letter has its own edge, nothing is
    said of the other subsets, and `letters` is needed to read the same automaton again.

    Args:
        automaton: The automaton.
        name: Of the automaton, such as its formula.

    Returns:
        A text from which `read_hoa` makes the same tables, provided that propositions and
        letters are in the order that it gives them, as those of `to_automaton` are.

    Raises:
        ValueError: For priorities above 255, whose acceptance formula no reader would bear.

    >>> from jaxltl.core.automata.translate import to_automaton
    >>> print(write_hoa(to_automaton("F a")))
    HOA: v1
    tool: "jaxltl"
    States: 2
    Start: 0
    AP: 1 "a"
    acc-name: Buchi
    Acceptance: 1 Inf(0)
    properties: trans-labels explicit-labels state-acc complete deterministic weak terminal
    --BODY--
    State: 0 "F a"
    [!0] 0
    [0] 1
    State: 1 "true" {0}
    [t] 1
    --END--
    <BLANKLINE>
    """
    names = automaton.propositions
    lines = ["HOA: v1", 'tool: "jaxltl"']
    if name:
        lines.append(f"name: {_quoted(name)}")
    lines += [f"States: {len(automaton.delta)}", f"Start: {int(automaton.initial)}"]
    lines.append(" ".join([f"AP: {len(names)}", *map(_quoted, names)]))
    if automaton.acceptance == "parity":
        count = int(automaton.priority.max()) + 1
        lines += [f"acc-name: parity min even {count}", f"Acceptance: {count} {_min_even(count)}"]
    else:
        lines += ["acc-name: Buchi", "Acceptance: 1 Inf(0)"]
    lines.append("properties: " + " ".join(_properties(automaton)))
    lines.append("--BODY--")
    for q in range(len(automaton.delta)):
        lines += _written_state(automaton, q)
    return "\n".join([*lines, "--END--", ""])


# ---------------------------------------------------------------------------------------------
# Writing
# ---------------------------------------------------------------------------------------------


def _is_full(automaton: Automaton) -> bool:
    return len(automaton.letters) == 2 ** len(automaton.propositions)


def _properties(automaton: Automaton) -> list[str]:
    """What is true of the file; `terminal` or `cosafe`, or `weak` alone, is read back."""
    full, kind = _is_full(automaton), automaton.acceptance
    words = ["trans-labels", "explicit-labels"]
    words.append("state-acc" if kind in ("cosafe", "safety") else "trans-acc")
    words += ["complete", "deterministic"] if full else ["deterministic"]
    if kind == "parity":
        words.append("colored")
    if kind in ("cosafe", "safety"):
        words.append("weak")
    if kind == "cosafe":  # a terminal automaton is complete where it accepts
        words.append("terminal" if full else "cosafe")
    return words


def _min_even(count: int) -> str:
    """The formula of min-even parity with sets 0..count-1, as Spot and Owl write it."""
    if count > MAX_PRIORITIES:
        raise ValueError(
            f"write_hoa: priority {count - 1} takes an acceptance formula of {count} sets; the "
            f"limit is {MAX_PRIORITIES}. Renumber the priorities, keeping their order and parity."
        )
    text = ""
    for i in reversed(range(count)):
        atom, operator = (f"Inf({i})", "|") if i % 2 == 0 else (f"Fin({i})", "&")
        inner = f"({text})" if " " in text else text
        text = f"{atom} {operator} {inner}" if text else atom
    return text


def _written_state(automaton: Automaton, q: int) -> Iterator[str]:
    """The lines of state q and its edges."""
    on_state = automaton.acceptance in ("cosafe", "safety")
    priorities = automaton.priority[q]
    head = f"State: {q}"
    if automaton.state_names:
        head += f" {_quoted(automaton.state_names[q])}"
    if on_state and priorities[0] == 0:
        head += " {0}"
    yield head
    for successor, priority, chosen in _edges(automaton, q):
        label = " | ".join(
            "&".join(f"{p}" if value else f"!{p}" for p, value in cube) for cube in chosen
        )
        marked = not on_state and (automaton.acceptance == "parity" or priority == 0)
        yield f"[{label or 't'}] {successor}" + (f" {{{priority}}}" if marked else "")


def _edges(automaton: Automaton, q: int) -> Iterator[tuple[int, int, list[Cube]]]:
    """Successor, priority and cubes of each edge of state q, with disjoint labels."""
    pairs = list(zip(automaton.delta[q].tolist(), automaton.priority[q].tolist(), strict=True))
    if not _is_full(automaton):
        for row, (successor, priority) in zip(automaton.letters.tolist(), pairs, strict=True):
            yield successor, priority, [tuple(enumerate(row))]
        return
    width = len(automaton.propositions)
    numbers = (automaton.letters @ (1 << np.arange(width))).tolist()
    letters_of: dict[tuple[int, int], set[int]] = {}
    for number, pair in zip(numbers, pairs, strict=True):
        letters_of.setdefault(pair, set()).add(number)
    for pair, chosen in letters_of.items():
        yield *pair, prime_cover(chosen, set(numbers) - chosen, width)


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _unquoted(token: str) -> str:
    return re.sub(r"(?s)\\(.)", r"\1", token[1:-1])


# ---------------------------------------------------------------------------------------------
# Tokens
# ---------------------------------------------------------------------------------------------

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
_KNOWN_HEADERS = {
    "HOA:": "HOA",
    "States:": "STATES",
    "Start:": "START",
    "AP:": "AP",
    "Alias:": "ALIAS",
    "Acceptance:": "ACCEPTANCE",
    "acc-name:": "ACC_NAME",
    "tool:": "TOOL",
    "name:": "NAME",
    "properties:": "PROPERTIES",
    "State:": "STATE",
}
# Terminals whose name starts with an underscore carry nothing, and are left out of the trees.
_TERMINAL = {
    **_KNOWN_HEADERS,
    "t": "BOOLEAN",
    "f": "BOOLEAN",
    "--BODY--": "_BODY",
    "--END--": "_END",
    "--ABORT--": "ABORT",
    "[": "_LEFT",
    "]": "_RIGHT",
    "(": "_OPEN",
    ")": "_CLOSE",
    "{": "_BEGIN",
    "}": "_FINISH",
    "&": "_AND",
    "|": "_OR",
    "!": "NOT",
}


def _error(line: int | None, message: str) -> ValueError:
    return ValueError(f"read_hoa: line {line}: {message}")


def _texts(text: str) -> list[list[Token]]:
    """The tokens of each automaton, up to `--END--`; aborted ones are left out."""
    if not isinstance(text, str):
        raise ValueError(
            f"read_hoa: expected text in the Hanoi format, got {type(text).__name__}. "
            "Pass the contents of the file."
        )
    found: list[list[Token]] = []
    current: list[Token] = []
    for token in _tokens(text):
        current.append(token)
        if token.type == "_END":
            found.append(current)
        if token.type in ("_END", "ABORT"):
            current = []
    return [*found, current] if current else found


def _tokens(text: str) -> Iterator[Token]:
    from lark import Token  # see _parser

    position, line, line_start = 0, 1, 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None or match.lastgroup is None:
            problem = f"column {position - line_start + 1}: found {text[position]!r}"
            if text[position] == '"':
                raise _error(line, f"{problem}, a quote that is never closed. Close it.")
            raise _error(line, f"{problem}, which starts nothing in this format. Delete it.")
        kind, value, end = match.lastgroup, match[0], match.end()
        if kind == "COMMENT":
            end = _comment_end(text, position, line)
        elif kind != "SPACE":
            # At most ten digits are converted; Python refuses thousands of them.
            if kind == "INT" and (value != str(int(value[:10])) or int(value) >= 2**31):
                raise _error(
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
    """Where the comment that starts at `start` ends; comments nest."""
    depth = 0
    for match in re.compile(r"/\*|\*/").finditer(text, start):
        depth += 1 if match[0] == "/*" else -1
        if depth == 0:
            return match.end()
    raise _error(line, "the comment that starts here is never closed. Close it with */.")


# ---------------------------------------------------------------------------------------------
# Syntax
# ---------------------------------------------------------------------------------------------

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
class _Edge:
    label: _Tree | None
    targets: list[Token]
    marks: list[Token]
    line: int


@dataclass(frozen=True)
class _State:
    label: _Tree | None
    number: Token
    name: str | None
    marks: list[Token]
    edges: list[_Edge]
    line: int


@functools.cache
def _parser() -> Lark:
    from lark import Lark  # Lark takes 0.1 s to import, which a program without files need not pay.
    from lark.lexer import Lexer

    class Ready(Lexer):
        """Passes on tokens that are already made; comments nest, which no terminal of Lark can."""

        def __init__(self, _: Any) -> None: ...

        def lex(self, tokens: Any) -> Iterator[Token]:  # type: ignore[override]
            return iter(tokens)

    actions = SimpleNamespace(
        start=tuple,
        header=lambda c: (c[1], c[2:]),
        item=list,
        property=lambda c: "".join(filter(None, c)),
        body=list,
        state=lambda c: _State(c[1], c[2], c[3] and _unquoted(c[3]), c[4] or [], c[5:], c[0].line),
        edge=lambda c: _Edge(c[0], c[1], c[2] or [], c[1][0].line),
        guard=lambda c: c[0],
        targets=list,
        marks=list,
        disjunction=lambda c: ("or", *c),
        conjunction=lambda c: ("and", *c),
        negation=lambda c: ("not", c[1]),
        proposition=lambda c: ("proposition", c[0]),
        alias=lambda c: ("alias", c[0]),
        constant=lambda c: _TRUE if c[0] == "t" else _FALSE,
        atom=lambda c: ("atom", *c),
    )
    return Lark(_GRAMMAR, parser="lalr", lexer=Ready, transformer=actions)


def _parse(tokens: list[Token]) -> tuple[tuple[Token, list[Any]], list[_State]]:
    """The version and items of the header, and the states."""
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
    **dict.fromkeys(set(_KNOWN_HEADERS.values()) - {"HOA", "STATE"}, "a header"),
}


def _syntax_error(tokens: list[Token], error: UnexpectedToken) -> ValueError:
    token = error.token
    ended = token.type == "$END"
    place = tokens[-1] if ended else token
    accepted = error.accepts or error.expected
    expected = sorted({_READABLE.get(terminal, terminal) for terminal in accepted})
    wanted = " or ".join([", ".join(expected[:-1]), expected[-1]] if expected[1:] else expected)
    found = "the end of the text" if ended else repr(str(token))
    hint = " Each automaton ends with --END--." if ended or token.type == "HOA" else ""
    return _error(place.line, f"column {place.column}: found {found}, expected {wanted}.{hint}")


# ---------------------------------------------------------------------------------------------
# The header
# ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Header:
    """What the header says; `states` is None if it does not count them."""

    states: int | None
    start: Token
    propositions: tuple[str, ...]
    aliases: list[tuple[Token, _Tree]]
    sets: int
    condition: _Tree
    properties: frozenset[str]
    tool: str
    acceptance_name: str
    line: int


def _header(version: Token, items: list[list[Any]]) -> _Header:
    if version not in ("v1", "v1.1"):
        raise _error(version.line, f"version {version} is unknown. Write the automaton as v1.")
    given: dict[str, list[Any]] = {}
    properties: list[str] = []
    aliases: list[tuple[Token, _Tree]] = []
    for key, *values in items:
        if key.type == "HEADERNAME":
            if key[0].isupper():  # by the format's rule it may change what the automaton means
                raise _error(
                    key.line,
                    f"the header {key} is unknown and, by its capital, changes what the automaton "
                    "means. Write the automaton without it.",
                )
        elif key.type == "PROPERTIES":
            properties += values
        elif key.type == "ALIAS":
            aliases.append((values[0], values[1]))
        elif key.type in given and key.type == "START":
            raise _error(
                key.line,
                "there are several initial states. Only deterministic automata are read; "
                "determinise it first.",
            )
        elif key.type in given:
            raise _error(key.line, f"the header {key} is given twice. Keep one of them.")
        else:
            given[key.type] = [key, *values]
    return _checked_header(version, given, aliases, frozenset(properties))


def _checked_header(
    version: Token,
    given: dict[str, list[Any]],
    aliases: list[tuple[Token, _Tree]],
    properties: frozenset[str],
) -> _Header:
    for missing, fix in (("Acceptance:", "Acceptance: 0 t"), ("Start:", "Start: 0")):
        if _KNOWN_HEADERS[missing] not in given:
            raise _error(version.line, f"the header {missing} is missing. Add it, such as '{fix}'.")
    _, sets, condition = given["ACCEPTANCE"]
    return _Header(
        states=int(given["STATES"][1]) if "STATES" in given else None,
        start=_only(given["START"][1], "Start:"),
        propositions=_proposition_names(given.get("AP")),
        aliases=aliases,
        sets=int(sets),
        condition=_condition(condition, int(sets)),
        properties=properties,
        tool=_unquoted(given["TOOL"][1]) if "TOOL" in given else "",
        acceptance_name=str(given["ACC_NAME"][1]) if "ACC_NAME" in given else "",
        line=version.line or 1,
    )


def _proposition_names(item: list[Any] | None) -> tuple[str, ...]:
    if item is None:
        return ()
    key, count, *texts = item
    names = tuple(map(_unquoted, texts))
    if len(names) != int(count):
        raise _error(key.line, f"AP: counts {count} propositions and names {len(names)}. "
                               "Correct the number.")  # fmt: skip
    for i, name in enumerate(names):
        if name in names[:i]:
            raise _error(key.line, f"AP: names {name!r} twice. Keep one of them.")
    return names


def _only(targets: Sequence[Token], place: str) -> Token:
    """The state, where a conjunction of states may be written."""
    if len(targets) > 1:
        raise _error(
            targets[0].line,
            f"{place} {' & '.join(targets)} branches universally. Alternating automata are not "
            "read; turn it into a deterministic one first.",
        )
    return targets[0]


def _condition(tree: _Tree, sets: int) -> _Tree:
    """The acceptance formula over numbers, where `sets + x` stands for the complement of x.

    It has the operators `true`, `false`, `and`, `or`, and `inf` and `fin` with a number.
    """
    if tree[0] in ("and", "or"):
        return (tree[0], *[_condition(part, sets) for part in tree[1:]])
    if tree[0] != "atom":
        return tree
    _, name, complemented, number = tree
    if name not in ("Fin", "Inf"):
        raise _error(name.line, f"Acceptance: has {name}({number}). Only Fin and Inf are known.")
    return (name.lower(), _set(number, sets) + (sets if complemented else 0))


def _set(number: Token, sets: int) -> int:
    if int(number) >= sets:
        raise _error(
            number.line,
            f"acceptance set {number} is out of range, since Acceptance: counts {sets}. "
            "Correct the one or the other.",
        )
    return int(number)


# ---------------------------------------------------------------------------------------------
# The automaton
# ---------------------------------------------------------------------------------------------


def _read(tokens: list[Token], letters: Iterable[Letter] | None) -> Automaton:
    try:
        (version, items), states = _parse(tokens)
        header = _header(version, items)
        names = tuple(sorted(header.propositions))
        alphabet = _alphabet(names, letters, header.line)
        # The column of the letters that each AP index means.
        columns = alphabet[:, [names.index(name) for name in header.propositions]]
        table = _table(header, _by_number(header, states), columns)
        return _automaton(header, table, alphabet, names)
    except RecursionError:  # labels and conditions are walked as deep as they nest
        raise _error(
            tokens[0].line,
            "a label or the acceptance formula nests hundreds of levels deep. Write it flatter.",
        ) from None


def _alphabet(
    names: tuple[str, ...], letters: Iterable[Letter] | None, line: int
) -> NDArray[np.bool_]:
    """The letters `[L, P]`, by the binary number with proposition p as bit p."""
    if letters is None:
        if len(names) > MAX_FREE_PROPOSITIONS:
            raise _error(
                line,
                f"the automaton has {len(names)} propositions, so 2^{len(names)} letters; the "
                f"limit is 2^{MAX_FREE_PROPOSITIONS}. Pass letters=, the sets of propositions "
                "that can hold at once.",
            )
        numbers = list(range(2 ** len(names)))
    else:
        bit = {name: 1 << p for p, name in enumerate(names)}
        given = as_letters(letters, "read_hoa: letters")
        numbers = sorted({sum(bit[name] for name in bit if name in letter) for letter in given})
    if not numbers:
        raise ValueError(
            "read_hoa: letters is empty. Pass at least one letter, such as set(), or None for "
            "all of them."
        )
    rows = [[bool(number >> p & 1) for p in range(len(names))] for number in numbers]
    return np.array(rows, bool).reshape(len(rows), len(names))


def _by_number(header: _Header, states: list[_State]) -> list[_State]:
    """The states in the order of their numbers, each defined once; start and targets exist."""
    defined: dict[int, _State] = {}
    for state in states:
        number = int(state.number)
        if header.states is not None and number >= header.states:
            raise _error(
                state.line,
                f"state {number} is out of range, since States: counts {header.states}. "
                "Correct the one or the other.",
            )
        if number in defined:
            raise _error(
                state.line,
                f"state {number} is defined twice, first in line {defined[number].line}. "
                "Keep one of them.",
            )
        for edge in state.edges:
            _only(edge.targets, f"the edge of state {number} to")
        defined[number] = state
    mentioned = [header.start, *[state.number for state in states]]
    mentioned += [edge.targets[0] for state in states for edge in state.edges]
    for token in mentioned:
        if int(token) not in defined:
            raise _error(
                token.line, f"state {token} is not defined. Add 'State: {token}' to the body."
            )
    count = max(defined) + 1 if header.states is None else header.states
    if len(defined) < count:
        number = next(q for q in range(count) if q not in defined)
        raise _error(
            header.line,
            f"state {number} of {count} is not defined. Add 'State: {number}' to the body, or "
            "correct States:.",
        )
    return [defined[q] for q in range(count)]


@dataclass(frozen=True)
class _Table:
    """The edge that each state takes by each letter, `[Q, L]`, and all edges, by their number.

    The last state is a rejecting one, added for missing edges, if `sink` is its number.
    """

    edge_of: NDArray[np.int64]
    target: NDArray[np.int64]
    marks: list[frozenset[int]]
    names: tuple[str, ...]
    sink: int | None


def _table(header: _Header, states: list[_State], columns: NDArray[np.bool_]) -> _Table:
    truth = _label_truth(header, columns)
    edge_of = np.full((len(states), len(columns)), -1, np.int64)
    edges: list[_Edge] = []
    marks: list[frozenset[int]] = []
    for q, state in enumerate(states):
        on_state = {_set(number, header.sets) for number in state.marks}
        for edge, taken in _guarded(state, columns, truth):
            for letter in np.flatnonzero(taken & (edge_of[q] >= 0))[:1]:
                raise _nondeterminism(header, q, edge, edges[edge_of[q, letter]], columns[letter])
            edge_of[q, taken] = len(edges)
            edges.append(edge)
            marks.append(frozenset(on_state | {_set(number, header.sets) for number in edge.marks}))
    target = [int(edge.targets[0]) for edge in edges]
    names = [state.name or "" for state in states]
    sink = None
    if (edge_of < 0).any():
        sink = len(states)
        edge_of = np.vstack([edge_of, np.full(len(columns), -1)])
        edge_of[edge_of < 0] = len(edges)
        target.append(sink)
        marks.append(frozenset())
        names.append("false")
    named = any(state.name is not None for state in states)
    return _Table(edge_of, np.array(target, np.int64), marks, tuple(names) if named else (), sink)


def _nondeterminism(
    header: _Header, q: int, edge: _Edge, other: _Edge, letter: NDArray[np.bool_]
) -> ValueError:
    return _error(
        edge.line,
        f"state {q} has two edges for the letter {letter_text(header.propositions, letter)}, to "
        f"state {other.targets[0]} and to state {edge.targets[0]}. Only deterministic automata are "
        "read; determinise it first, in Spot with the options -D -G.",
    )


def _guarded(
    state: _State, columns: NDArray[np.bool_], truth: Callable[[_Tree], NDArray[np.bool_]]
) -> Iterator[tuple[_Edge, NDArray[np.bool_]]]:
    """Each edge of a state, and the letters `[L]` that take it."""
    labelled = sum(edge.label is not None for edge in state.edges)
    if state.label is not None:
        if labelled:
            raise _error(
                state.line,
                f"state {state.number} has a label and so have its edges. Label only the state "
                "or only the edges.",
            )
        common = truth(state.label)
        yield from ((edge, common) for edge in state.edges)
    elif labelled:
        for edge in state.edges:
            if edge.label is None:
                raise _error(
                    edge.line,
                    f"state {state.number} has edges with a label and edges without. "
                    "Label all of them, or none.",
                )
            yield edge, truth(edge.label)
    elif state.edges:
        width = columns.shape[1]
        if len(state.edges) != 2**width:
            raise _error(
                state.line,
                f"the number of edges without a label of state {state.number} is "
                f"{len(state.edges)}, expected 2^{width}, one for each set of propositions "
                f"(AP: counts {width}). Correct them, or label them.",
            )
        numbers = columns @ (1 << np.arange(width))
        yield from ((edge, numbers == i) for i, edge in enumerate(state.edges))


def _label_truth(
    header: _Header, columns: NDArray[np.bool_]
) -> Callable[[_Tree], NDArray[np.bool_]]:
    """The function from a label to the letters `[L]` in which it holds."""
    aliases: dict[str, NDArray[np.bool_]] = {}

    def truth(label: _Tree) -> NDArray[np.bool_]:
        operator, *operands = label
        if operator in ("true", "false"):
            return np.full(len(columns), operator == "true")
        if operator == "alias":
            if operands[0] not in aliases:
                raise _error(
                    operands[0].line,
                    f"the alias {operands[0]} is not defined up to here. Define it by Alias:, "
                    "before other aliases use it.",
                )
            return aliases[operands[0]]
        if operator == "proposition":
            if int(operands[0]) >= columns.shape[1]:
                raise _error(
                    operands[0].line,
                    f"proposition {operands[0]} is out of range, since AP: counts "
                    f"{columns.shape[1]}. Correct the one or the other.",
                )
            return columns[:, int(operands[0])]
        if operator == "not":
            return ~truth(operands[0])
        combine = np.logical_and if operator == "and" else np.logical_or
        result = truth(operands[0])
        for operand in operands[1:]:
            result = combine(result, truth(operand))
        return result

    for name, label in header.aliases:
        if name in aliases:
            raise _error(name.line, f"the alias {name} is defined twice. Keep one of them.")
        aliases[str(name)] = truth(label)
    return truth


# ---------------------------------------------------------------------------------------------
# Acceptance
# ---------------------------------------------------------------------------------------------


def _automaton(
    header: _Header, table: _Table, alphabet: NDArray[np.bool_], names: tuple[str, ...]
) -> Automaton:
    """The automaton with min-even priorities."""
    delta: NDArray[Any] = table.target[table.edge_of]
    initial = int(header.start)
    base: NDArray[Any] = np.arange(len(delta))
    condition = _given(header.condition, -1, True)
    order = _decisive_sets(condition)
    priority: NDArray[Any]
    if order is not None:
        edge_priority = [_edge_priority(marks, header.sets, *order) for marks in table.marks]
        priority = np.array(edge_priority, np.int64)[table.edge_of]
    else:
        from jaxltl.core.automata.emerson_lei import to_parity

        colors, compact = _colors(condition, table.marks, header)
        colors = colors[table.edge_of]
        delta, priority, initial, base = to_parity(delta, colors, initial, compact)
    # The added state rejects, whatever the condition says of runs without marks.
    priority[base == (-1 if table.sink is None else table.sink)] = 1
    kind = _acceptance(header, delta, priority)
    given: dict[str, Any] = {"final": priority[:, 0] == 0, "acceptance": kind}
    if kind in ("buchi", "parity"):
        given = {"accepting": priority == 0} if kind == "buchi" else {"priority": priority}
    return make_automaton(
        delta,
        initial,
        alphabet,
        names,
        state_names=[table.names[q] for q in base] if table.names else (),
        **given,
    )


def _acceptance(header: _Header, delta: NDArray[Any], priority: NDArray[Any]) -> str:
    """The acceptance that the priorities allow, and that `write_hoa` noted in the header."""
    own = header.tool == "jaxltl"
    if priority.max() > 1 or (own and header.acceptance_name == "parity"):
        return "parity"
    final = priority[:, 0] == 0
    if own and "weak" in header.properties and (priority == priority[:, :1]).all():
        if header.properties & {"terminal", "cosafe"}:
            return "cosafe" if final[delta[final]].all() else "buchi"
        return "safety" if not final[delta[~final]].any() else "buchi"
    return "buchi"


def _given(condition: _Tree, number: int, visited: bool) -> _Tree:
    """The condition once it is known whether a set is visited infinitely often, simplified."""
    operator = condition[0]
    if operator in ("inf", "fin"):
        if condition[1] != number:
            return condition
        return _TRUE if (operator == "inf") == visited else _FALSE
    if operator not in ("and", "or"):
        return condition
    neutral, decisive = (_TRUE, _FALSE) if operator == "and" else (_FALSE, _TRUE)
    parts = []
    for operand in condition[1:]:
        part = _given(operand, number, visited)
        if part[0] == decisive[0]:
            return decisive
        if part[0] != neutral[0]:
            parts.append(part)
    if len(parts) > 1:
        return (operator, *parts)
    return parts[0] if parts else neutral


def _sets_of(condition: _Tree) -> list[int]:
    """The sets that a condition mentions, sorted."""
    found: set[int] = set()
    stack = [condition]
    while stack:
        node = stack.pop()
        if node[0] in ("inf", "fin"):
            found.add(node[1])
        else:
            stack += node[1:]
    return sorted(found)


def _decisive_sets(condition: _Tree) -> tuple[list[tuple[int, bool]], bool] | None:
    """The sets from the most important one on, if a condition has such an order.

    A set is decisive if visiting it infinitely often settles acceptance, given that the more
    important sets are not. Buchi, co-Buchi and all styles of parity have such an order.

    Returns:
        Each set with what it decides, and what holds if none is visited; None without an order.
    """
    order = []
    while condition not in (_TRUE, _FALSE):
        sets = _sets_of(condition)
        for number in dict.fromkeys((sets[0], sets[-1], *sets)):  # min or max parity, mostly
            outcome = _given(condition, number, True)
            if outcome in (_TRUE, _FALSE):
                break
        else:
            return None
        order.append((number, outcome == _TRUE))
        condition = _given(condition, number, False)
    return order, condition == _TRUE


def _edge_priority(
    marks: frozenset[int], sets: int, order: list[tuple[int, bool]], otherwise: bool
) -> int:
    """The min-even priority of an edge, from its most important set."""
    priority = 0
    for number, accepts in order:
        priority += (priority % 2 == 0) != accepts
        if _belongs(marks, number, sets):
            return priority
    return priority + ((priority % 2 == 0) != otherwise)


def _belongs(marks: frozenset[int], number: int, sets: int) -> bool:
    return number in marks if number < sets else number - sets not in marks


def _colors(
    condition: _Tree, marks: list[frozenset[int]], header: _Header
) -> tuple[NDArray[np.int64], _Tree]:
    """The sets of each edge as bits, and the condition over the numbers of these bits."""
    sets = _sets_of(condition)
    if len(sets) > MAX_COLORS:
        raise _error(
            header.line,
            f"the acceptance formula has {len(sets)} sets and is no parity condition; the limit "
            f"is {MAX_COLORS}. Let the tool that wrote it turn it into parity.",
        )

    def renumbered(node: _Tree) -> _Tree:
        if node[0] in ("inf", "fin"):
            return (node[0], sets.index(node[1]))
        return (node[0], *[renumbered(part) for part in node[1:]])

    colors = [
        sum(1 << i for i, number in enumerate(sets) if _belongs(edge, number, header.sets))
        for edge in marks
    ]
    return np.array(colors, np.int64), renumbered(condition)
