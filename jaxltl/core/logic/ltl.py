"""Linear temporal logic: formulas, their syntax, normal form, fragments and truth on lassos.

Every pass over a formula is a loop over `subformulas`, operands first, so deep formulas cost
no recursion and shared subformulas are visited once.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from types import SimpleNamespace
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from lark import Lark
    from lark.exceptions import UnexpectedInput

Fragment = Literal["cosafe", "safety"]

# The least and the greatest number of operands of each operator.
_ARITY: dict[str, tuple[int, float]] = {
    **dict.fromkeys(("true", "false", "ap"), (0, 0)),
    **dict.fromkeys(("!", "X", "F", "G"), (1, 1)),
    **dict.fromkeys(("->", "<->", "xor", "U", "R", "W", "M"), (2, 2)),
    **dict.fromkeys(("&", "|"), (2, float("inf"))),
}
_TEMPORAL = {"cosafe": frozenset("XFUM"), "safety": frozenset("XGRW")}
_BOOLEAN = frozenset({"true", "false", "ap", "!", "&", "|"})


@dataclass(frozen=True, eq=False, repr=False, slots=True)
class Formula:
    """A formula of linear temporal logic.

    Two formulas are equal when they have the same structure, up to the grouping of `&` and `|`,
    which are associative and kept flat. Equality and hashing compare a digest of the structure.
    Python's `~ & | ^ >>` build `! & | xor ->`.

    Attributes:
      operator: `true false ap ! & | -> <-> xor X F G U R W M`; `ap` is a proposition.
      operands: the formulas under the operator.
      proposition: the name, for `ap` only.

    Raises:
      ValueError: for an unknown operator or a wrong number of operands.

    Example:
      >>> a = Formula("ap", proposition="a")
      >>> print(~a | Formula("X", (a,)))
      !a | X a
    """

    operator: str
    operands: tuple[Formula, ...] = ()
    proposition: str = ""
    _digest: bytes = field(init=False)

    def __post_init__(self) -> None:
        operands: list[Formula] = []
        for operand in self.operands:
            same = operand.operator == self.operator and self.operator in ("&", "|")
            operands.extend(operand.operands if same else (operand,))
        low, high = _ARITY.get(self.operator, (1, 0))
        if low > high:
            known = " ".join(_ARITY)
            raise ValueError(f"Formula: unknown operator {self.operator!r}. Use one of: {known}.")
        if not low <= len(operands) <= high:
            wanted = f"{low}" if low == high else f"at least {low}"
            raise ValueError(
                f"Formula: operator {self.operator!r} got {len(operands)} operands. Pass {wanted}."
            )
        if (self.operator == "ap") != bool(self.proposition):
            raise ValueError(
                f"Formula: operator {self.operator!r} with proposition {self.proposition!r}. "
                "Give a non-empty name to 'ap', and to no other operator."
            )
        digest = blake2b(f"{self.operator} {self.proposition}".encode(), digest_size=16)
        for operand in operands:
            digest.update(operand._digest)
        object.__setattr__(self, "operands", tuple(operands))
        object.__setattr__(self, "_digest", digest.digest())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Formula) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)

    @property
    def propositions(self) -> tuple[str, ...]:
        """The names of the propositions in the formula, sorted."""
        return tuple(sorted({f.proposition for f in subformulas(self) if f.operator == "ap"}))

    def __str__(self) -> str:
        # Piece by piece: texts of all subformulas take quadratic memory where formulas are deep.
        written: list[str] = []
        waiting: list[str | Formula] = [self]
        while waiting:
            piece = waiting.pop()
            if isinstance(piece, str):
                written.append(piece)
            else:
                waiting.extend(reversed(_pieces(piece)))
        return "".join(written)

    def __repr__(self) -> str:
        text = repr(str(self))
        return f"parse_ltl({text})" if len(text) < 900 else f"parse_ltl({text[:800]}...)"

    def __invert__(self) -> Formula:
        return Formula("!", (self,))

    def __and__(self, other: Formula) -> Formula:
        return Formula("&", (self, other))

    def __or__(self, other: Formula) -> Formula:
        return Formula("|", (self, other))

    def __xor__(self, other: Formula) -> Formula:
        return Formula("xor", (self, other))

    def __rshift__(self, other: Formula) -> Formula:
        return Formula("->", (self, other))


TRUE = Formula("true")
FALSE = Formula("false")


def subformulas(formula: Formula) -> tuple[Formula, ...]:
    """The distinct subformulas, each after its operands; the formula itself is last."""
    done: dict[Formula, None] = {}
    stack = [(formula, False)]
    while stack:
        node, operands_done = stack.pop()
        if node in done:
            continue
        if operands_done:
            done[node] = None
        else:
            stack.append((node, True))
            stack.extend((operand, False) for operand in reversed(node.operands))
    return tuple(done)


# --- Syntax ----------------------------------------------------------------------------------

_NAME = r"(?!(?:[URVWM]|xor|[tT][rR][uU][eE]|[fF][aA][lL][sS][eE])(?![\w.]))" \
        r"(?:[A-EH-WYZa-z_.]|[FGX](?=[0-9]))[A-Za-z0-9_.]*"  # fmt: skip

# "always" before a binary operator, ")" or the end is a name, as it is to Spot.
_BINARY_FOLLOWS = r"\s*(?:$|[)&|^=∧∨⊕→⇒↔⇔]|->|<->|<=>|\x2f\\|\\\x2f|" \
                  r"(?:[URVWM]|xor|and|or|implies|iff|until|release|weakuntil)(?![\w.]))"  # fmt: skip

# The lexer is contextual: where an operand is due `Ub` is a name, and after one it is `U b`.
_GRAMMAR = rf"""
?start: implication
?implication: disjunction | disjunction IMPLICATION implication -> infix
?disjunction: exclusive | exclusive (_OR exclusive)+ -> disjunction
?exclusive: conjunction | exclusive XOR conjunction -> infix
?conjunction: until | until (_AND until)+ -> conjunction
?until: unary | unary TEMPORAL until -> infix
?unary: (PREFIX | WORD) unary -> prefix | NAME -> name | QUOTED -> quoted | CONSTANT -> constant
      | _OPEN implication _CLOSE
IMPLICATION: "->" | "=>" | "<->" | "<=>" | /[→⇒↔⇔]/ | /(implies|iff)(?![\w.])/
_OR: "||" | "|" | "\\/" | "∨" | /or(?![\w.])/
XOR: "^" | "⊕" | /xor(?![\w.])/
_AND: "&&" | "&" | "/\\" | "∧" | /and(?![\w.])/
TEMPORAL: /[URVWM]/ | /(until|release|weakuntil)(?![\w.])/
PREFIX: "!" | "~" | "X" | "F" | "<>" | "G" | "[]" | /[¬○◯◇◊⋄□◻]/
WORD.3: /(not|next|eventually|always)(?![\w.])(?!{_BINARY_FOLLOWS})/
CONSTANT.2: /[01⊤⊥]|(true|false)(?![\w.])/i
NAME.1: /{_NAME}/
QUOTED: /"(\\.|[^"\\])*"/s
_OPEN: "("
_CLOSE: ")"
%ignore /\s+/
"""
_SPELLING = {
    "~": "!",
    "<>": "F",
    "[]": "G",
    "V": "R",
    "^": "xor",
    "=>": "->",
    "<=>": "<->",
    "1": "true",
    "0": "false",
    **dict.fromkeys(("¬", "not"), "!"),
    **dict.fromkeys(("○", "◯", "next"), "X"),
    **dict.fromkeys(("◇", "◊", "⋄", "eventually"), "F"),
    **dict.fromkeys(("□", "◻", "always"), "G"),
    **dict.fromkeys(("→", "⇒", "implies"), "->"),
    **dict.fromkeys(("↔", "⇔", "iff"), "<->"),
    "⊕": "xor",
    "⊤": "true",
    "⊥": "false",
    "until": "U",
    "release": "R",
    "weakuntil": "W",
}


def parse_ltl(formula: str) -> Formula:
    """The formula written in `formula`, in the syntax of Spot.

    From loosest to tightest: `->` `<->` (right), `|`, `xor`, `&` (left), `U R W M` (right), then
    the prefixes `! X F G`. Also read: `&& /\\ || \\/ ^ ~ => <=> [] <> V true false 1 0`, the signs
    `¬ ∧ ∨ ⊕ → ↔ ○ ◇ □ ⊤ ⊥` and, where an operator is due, the words `not and or implies iff next
    eventually always until release weakuntil`. The
    precedences are those of Spot's parser, `spot/parsetl/parsetl.yy`, and the names those of its
    scanner, `scantl.ll` (Duret-Lutz et al. 2022, "From Spot 2.0 to Spot 2.10"):

    - A name has letters, digits, `_` and `.`, and does not start with a digit: `y`, `g1`,
      `red_cell`, `goal` and `aUb` are names.
    - It does not start with a prefix operator either, unless a digit follows: `GFa` is `G F a`,
      `Foo` is `F oo`, `GXd` is `G X d`; but `X0` and `F1` are names.
    - A single `U R V W M`, `xor`, and `true` and `false` in any case are not names.
    - Any other name is quoted, with `\\` before a quote or backslash in it: `F "Goal 1"`.

    Args:
      formula: the formula.

    Returns:
      The `Formula`; its ``str`` is text that is read as the same formula.

    Raises:
      ValueError: with the column of the first error and the expected tokens.

    Example:
      >>> print(parse_ltl("GFa -> b U c && d"))
      G F a -> ((b U c) & d)
    """
    if not isinstance(formula, str) or not formula.strip():
        raise ValueError(
            f"parse_ltl: expected the text of a formula, got {type(formula).__name__} {formula!r}. "
            "Pass a string such as 'F goal & G !crash'."
        )
    from lark.exceptions import UnexpectedInput

    try:
        return _parser().parse(formula)  # type: ignore[return-value]
    except UnexpectedInput as error:
        raise ValueError(_syntax_error(formula, error)) from None


@functools.cache
def _parser() -> Lark:
    from lark import Lark  # Lark takes 0.1 s to import, which a program without text need not pay.

    actions = SimpleNamespace(
        infix=lambda c: Formula(_SPELLING.get(c[1], str(c[1])), (c[0], c[2])),
        prefix=lambda c: Formula(_SPELLING.get(c[0], str(c[0])), (c[1],)),
        conjunction=lambda c: Formula("&", tuple(c)),
        disjunction=lambda c: Formula("|", tuple(c)),
        name=lambda c: Formula("ap", proposition=str(c[0])),
        quoted=lambda c: Formula("ap", proposition=re.sub(r"(?s)\\(.)", r"\1", c[0][1:-1])),
        constant=lambda c: Formula(_SPELLING.get(c[0], c[0].lower())),
    )
    return Lark(_GRAMMAR, parser="lalr", transformer=actions)


def _syntax_error(text: str, error: UnexpectedInput) -> str:
    token = getattr(error, "token", None)
    expected = getattr(error, "accepts", None) or getattr(error, "allowed", None) or set()
    position = error.pos_in_stream if token is None or token.type != "$END" else len(text.rstrip())
    assert position is not None
    if "NAME" in expected:
        wanted = "a proposition, a constant, '(' or a prefix operator (! X F G)"
    else:
        is_open = text.count("(", 0, position) > text.count(")", 0, position)
        wanted = "a binary operator (& | xor -> <-> U R W M) or "
        wanted += "')'" if is_open else "the end of the formula"
    if token is None:
        actual = f"{text[position]!r}"
        wanted += (
            ". The quote is never closed"
            if text[position] == '"'
            else ". Put names with other characters in double quotes"
        )
    else:
        actual = "the end of the formula" if token.type == "$END" else repr(str(token))
    return pointed("parse_ltl", text, position, actual, wanted)


def pointed(place: str, text: str, position: int, actual: str, wanted: str) -> str:
    """Error message for a position of a text, with a caret under it."""
    line_start = text.rfind("\n", 0, position) + 1
    line = text[line_start:].split("\n")[0]
    column = position - line_start
    # A window of the line keeps the caret in sight under a long formula.
    begin = max(0, column - 60)
    row = f"line {text.count(chr(10), 0, position) + 1}, " if "\n" in text else ""
    return (
        f"{place}: {row}column {column + 1}: found {actual}, expected {wanted}.\n"
        f"  {line[begin : begin + 78]}\n  {' ' * (column - begin)}^"
    )


def as_formula(formula: Formula | str) -> Formula:
    """The formula itself, or the one that a text writes (see `parse_ltl`)."""
    return formula if isinstance(formula, Formula) else parse_ltl(formula)


def proposition_text(name: str) -> str:
    """The name as `parse_ltl` reads it: plain where it can be, else quoted."""
    if re.fullmatch(_NAME, name, re.ASCII):
        return name
    return '"' + re.sub(r'(["\\])', r"\\\1", name) + '"'


def _pieces(formula: Formula) -> list[str | Formula]:
    """The text of a formula as literal pieces and operands, from left to right."""
    if not formula.operands:
        atom = formula.operator == "ap"
        return [proposition_text(formula.proposition) if atom else formula.operator]
    single = len(formula.operands) == 1
    pieces: list[str | Formula] = []
    for operand in formula.operands:
        if pieces:
            pieces.append(f" {formula.operator} ")
        pieces += ["(", operand, ")"] if len(operand.operands) > 1 else [operand]
    prefix = formula.operator + ("" if formula.operator == "!" else " ")
    return [prefix, *pieces] if single else pieces


def render(formula: Formula, operand_texts: Sequence[str]) -> str:
    """The text of a formula, given the texts of its operands."""
    texts = dict(zip(formula.operands, operand_texts, strict=True))
    return "".join(x if isinstance(x, str) else texts[x] for x in _pieces(formula))


# --- Normal form and fragments ---------------------------------------------------------------

_DUALITIES = ("X X", "true false", "& |", "F G", "U R", "W M")
_DUAL = dict(pair.split() for pair in _DUALITIES)
_DUAL |= {dual: operator for operator, dual in _DUAL.items()}


def negation_normal_form(formula: Formula) -> Formula:
    """Negation normal form, `!` on propositions only (Baier & Katoen 2008, section 5.1.5)."""
    forms: dict[Formula, tuple[Formula, Formula]] = {}  # the normal forms of f and of !f
    for node in subformulas(formula):
        positive = tuple(forms[operand][0] for operand in node.operands)
        negative = tuple(forms[operand][1] for operand in node.operands)
        match node.operator:
            case "ap":
                forms[node] = (node, ~node)
            case "!":
                forms[node] = (negative[0], positive[0])
            case "->":
                forms[node] = (negative[0] | positive[1], positive[0] & negative[1])
            case "<->" | "xor":
                same = (positive[0] & positive[1]) | (negative[0] & negative[1])
                different = (positive[0] & negative[1]) | (negative[0] & positive[1])
                forms[node] = (same, different) if node.operator == "<->" else (different, same)
            case operator:
                forms[node] = (Formula(operator, positive), Formula(_DUAL[operator], negative))
    return forms[formula][0]


def offending_subformula(formula: Formula, fragment: Fragment) -> Formula | None:
    """The outermost subformula of the normal form that leaves a fragment, or None."""
    allowed = _BOOLEAN | _TEMPORAL[fragment]
    nodes = reversed(subformulas(negation_normal_form(formula)))
    return next((node for node in nodes if node.operator not in allowed), None)


def is_syntactically_cosafe(formula: Formula) -> bool:
    """True if the normal form uses only `X F U M`, so a finite prefix proves the formula."""
    return offending_subformula(formula, "cosafe") is None


def is_syntactically_safe(formula: Formula) -> bool:
    """True if the normal form uses only `X G R W`, so a finite prefix refutes the formula."""
    return offending_subformula(formula, "safety") is None


# --- Truth -----------------------------------------------------------------------------------

Letter = Collection[str]


def as_letters(letters: Iterable[Letter], place: str) -> list[frozenset[str]]:
    """The letters as sets of proposition names."""
    result = []
    for index, letter in enumerate(letters):
        if isinstance(letter, str) or not all(isinstance(name, str) for name in letter):
            raise ValueError(
                f"{place}: letter {index} is {letter!r}. "
                "A letter is a collection of proposition names, such as {'goal'} or set()."
            )
        result.append(frozenset(letter))
    return result


def holds_on_lasso(
    formula: Formula | str, prefix: Iterable[Letter], cycle: Iterable[Letter]
) -> bool:
    """True if the infinite word prefix·cycle^ω satisfies the formula.

    Subformulas are evaluated at every position of the lasso, `U F M` as least and `R G W` as
    greatest solutions of their expansion laws (Baier & Katoen 2008, section 5.1.4).

    Args:
      formula: a formula or its text.
      prefix: `[n]` letters, each the collection of the propositions true there; may be empty.
      cycle: `[m]` letters, at least one.

    Returns:
      True if the word satisfies the formula.

    Raises:
      ValueError: for an empty cycle or a letter that is a bare string.

    Example:
      >>> holds_on_lasso("G F a", prefix=[], cycle=[{"a"}, set()])
      True
    """
    return truth_on_lasso(formula, prefix, cycle)[0]


def truth_on_lasso(
    formula: Formula | str, prefix: Iterable[Letter], cycle: Iterable[Letter]
) -> list[bool]:
    """Truth of the formula at each of the `n + m` positions, see `holds_on_lasso`."""
    formula = as_formula(formula)
    stem = as_letters(prefix, "holds_on_lasso: prefix")
    word = stem + as_letters(cycle, "holds_on_lasso: cycle")
    if len(word) == len(stem):
        raise ValueError("holds_on_lasso: the cycle is empty. Pass at least one letter.")
    truth: dict[Formula, list[bool]] = {}
    for node in subformulas(formula):
        operands = [truth[operand] for operand in node.operands]
        truth[node] = _truth(node, operands, word, loop=len(stem))
    return truth[formula]


_POINTWISE: dict[str, Callable[..., bool]] = {
    "!": lambda f: not f,
    "&": lambda *f: all(f),
    "|": lambda *f: any(f),
    "->": lambda f, g: not f or g,
    "<->": lambda f, g: f == g,
    "xor": lambda f, g: f != g,
}
# (f, g, truth one step later) -> truth; F and G have their operand in both places.
_EXPANSION: dict[str, Callable[[bool, bool, bool], bool]] = {
    **dict.fromkeys(("U", "W"), lambda f, g, later: g or (f and later)),
    **dict.fromkeys(("R", "M"), lambda f, g, later: g and (f or later)),
    "F": lambda f, g, later: g or later,
    "G": lambda f, g, later: g and later,
}


def _truth(
    node: Formula, operands: list[list[bool]], word: list[frozenset[str]], loop: int
) -> list[bool]:
    operator = node.operator
    if operator in ("true", "false"):
        return [operator == "true"] * len(word)
    if operator == "ap":
        return [node.proposition in letter for letter in word]
    if operator in _POINTWISE:
        return [_POINTWISE[operator](*values) for values in zip(*operands, strict=True)]
    if operator == "X":
        return [*operands[0][1:], operands[0][loop]]
    expand = _EXPANSION[operator]
    truth = [operator in "GRW"] * len(word)
    for _ in range(2):  # the first lap settles the truth where the cycle starts, the second all
        later = truth[loop]
        for i in reversed(range(len(word))):
            truth[i] = later = expand(operands[0][i], operands[-1][i], later)
    return truth
