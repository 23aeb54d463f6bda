"""Formulas as Boolean combinations of parts that each have a simple deterministic automaton.

A formula in negation normal form is in Sigma-2 when no `G R W` has an `F U M` below it, and in
Pi-2 when no `F U M` has a `G R W` below it. Every formula is a positive combination of such
formulas and of limits, `G F f` and `F G f` (Manna & Pnueli 1990; Chang, Manna & Pnueli 1992);
here it is found by the rewriting of Esparza, Rubio & Sickert 2022, "A simple rewrite system for
the normalization of linear temporal logic".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache

from jaxltl.core.ltl import FALSE, TRUE, Formula, negation_normal_form, subformulas

LEAST, GREATEST = frozenset("FUM"), frozenset("GRW")
_TEMPORAL = LEAST | GREATEST | {"X"}
MAX_PARTS = 400  # leaves of a combination beyond which the rewriting is given up


def conjunction(parts: Iterable[Formula]) -> Formula:
    return _flat("&", parts, TRUE, FALSE)


def disjunction(parts: Iterable[Formula]) -> Formula:
    return _flat("|", parts, FALSE, TRUE)


def _flat(operator: str, parts: Iterable[Formula], unit: Formula, zero: Formula) -> Formula:
    kept: dict[Formula, None] = {}
    for part in parts:
        for piece in part.operands if part.operator == operator else (part,):
            if piece == zero or _opposite(piece) in kept:
                return zero
            if piece != unit:
                kept[piece] = None
    pieces = _without_implied(operator, list(kept))
    if pieces is None:
        return zero
    if not pieces:
        return unit
    return pieces[0] if len(pieces) == 1 else Formula(operator, tuple(pieces))


def _without_implied(operator: str, pieces: list[Formula]) -> list[Formula] | None:
    """The operands that no other makes superfluous; None if two of them decide the whole."""
    if not any(piece.operator in _TEMPORAL for piece in pieces):
        return pieces
    needed: list[Formula] = []
    for i, piece in enumerate(pieces):
        others = needed + pieces[i + 1 :]
        pairs = [(piece, f) if operator == "|" else (f, piece) for f in others]
        if any(implies(*pair) for pair in pairs):
            continue
        if any(
            implies(negated(f), piece) if operator == "|" else implies(f, negated(piece))
            for f in needed
        ):
            return None
        needed.append(piece)
    return needed


@lru_cache(maxsize=1 << 16)
def implies(one: Formula, two: Formula) -> bool:
    """Whether simple rules on normal forms show that every word of `one` satisfies `two`.

    The rules are those of Somenzi & Bloem 2000, "Efficient Buchi automata from LTL formulae".
    """
    if one in (two, FALSE) or two == TRUE:
        return True
    if one.operator == "|" or two.operator == "&":
        if one.operator == "|":
            return all(implies(f, two) for f in one.operands)
        return all(implies(one, f) for f in two.operands)
    if two.operator == "|" and any(implies(one, f) for f in two.operands):
        return True
    return _implies_by_left(one, two) or _implies_by_right(one, two)


def _implies_by_left(one: Formula, two: Formula) -> bool:
    match one.operator:
        case "&":
            return any(implies(f, two) for f in one.operands)
        case "X":
            return two.operator == "X" and implies(one.operands[0], two.operands[0])
        case "G":
            return implies(one.operands[0], two) or (
                two.operator == "G" and implies(one, two.operands[0])
            )
        case "F":
            return two.operator == "F" and implies(one.operands[0], two)
        case "U" | "W":
            if all(implies(f, two) for f in one.operands):
                return True
            if one.operator == "U" and two.operator == "F":
                return implies(one.operands[1], two)
            return two.operator in (one.operator, "W") and all(
                implies(f, g) for f, g in zip(one.operands, two.operands, strict=True)
            )
        case "R" | "M":
            if implies(one.operands[1], two):
                return True
            if one.operator == "M" and two.operator == "F":
                return implies(one.operands[0], two)
            return two.operator in (one.operator, "R") and all(
                implies(f, g) for f, g in zip(one.operands, two.operands, strict=True)
            )
    return False


def _implies_by_right(one: Formula, two: Formula) -> bool:
    match two.operator:
        case "F" | "U" | "W":
            if implies(one, two.operands[-1]):
                return True
            return two.operator == "W" and implies(one, Formula("G", two.operands[:1]))
        case "R" | "M":
            if all(implies(one, f) for f in two.operands):
                return True
            return two.operator == "R" and implies(one, Formula("G", two.operands[1:]))
    return False


def _opposite(formula: Formula) -> Formula | None:
    if formula.operator == "ap":
        return ~formula
    return formula.operands[0] if formula.operator == "!" else None


# ---------------------------------------------------------------------------------------------
# Simplification
# ---------------------------------------------------------------------------------------------


def is_limit(formula: Formula) -> bool:
    """Whether the formula is `G F f` or `F G f`, so that no finite prefix matters to it."""
    below = formula.operands[0].operator if formula.operands else ""
    return (formula.operator, below) in (("G", "F"), ("F", "G"))


@lru_cache(maxsize=1 << 14)
def is_invariant(formula: Formula) -> bool:
    """Whether the formula is a Boolean combination of limits: true now iff true later."""
    if formula.operator in ("&", "|"):
        return all(is_invariant(part) for part in formula.operands)
    return is_limit(formula) or formula in (TRUE, FALSE)


def simplify(formula: Formula) -> Formula:
    """An equivalent formula in negation normal form, with limits pulled outwards.

    >>> from jaxltl.core.ltl import parse_ltl
    >>> print(simplify(parse_ltl("G F (a | X F b) & F F c")))
    (G F a | G F b) & F c
    """
    form: dict[Formula, Formula] = {}
    for node in subformulas(negation_normal_form(formula)):
        if node.operator in ("true", "false", "ap", "!"):
            form[node] = node
            continue
        form[node] = _rebuild(node.operator, [form[f] for f in node.operands])
    return form[subformulas(negation_normal_form(formula))[-1]]


def _rebuild(operator: str, operands: list[Formula]) -> Formula:
    """The node over simplified operands, simplified."""
    if operator == "&":
        return conjunction(operands)
    if operator == "|":
        return disjunction(operands)
    left, right = operands[0], operands[-1]
    if operator == "X":
        return left if is_invariant(left) else _next(left)
    if operator == "F":
        return eventually(right)
    if operator == "G":
        return always(right)
    return _binary(operator, left, right)


def _next(operand: Formula) -> Formula:
    if is_invariant(operand):
        return operand
    if operand.operator in ("&", "|"):  # limits need no X
        fixed = [f for f in operand.operands if is_invariant(f)]
        if fixed:
            moved = [f if is_invariant(f) else _next(f) for f in operand.operands]
            return conjunction(moved) if operand.operator == "&" else disjunction(moved)
    return Formula("X", (operand,))


def eventually(operand: Formula) -> Formula:
    """`F f`."""
    if is_invariant(operand) or operand.operator == "F":
        return operand
    if operand.operator in ("U", "M"):  # F (f U g) = F g, F (f M g) = F (f & g)
        if operand.operator == "U":
            return eventually(operand.operands[1])
        return eventually(conjunction(operand.operands))
    if operand.operator == "X":
        return _next(eventually(operand.operands[0]))
    if operand.operator == "|":
        pulled = [f for f in operand.operands if is_invariant(f) or f.operator == "F"]
        if pulled:
            rest = disjunction(f for f in operand.operands if f not in pulled)
            return disjunction([eventually(rest), *pulled])
    if operand.operator == "&":
        fixed = [f for f in operand.operands if is_invariant(f)]
        if fixed:
            rest = conjunction(f for f in operand.operands if f not in fixed)
            return conjunction([eventually(rest), *fixed])
    if operand.operator == "G":
        return _limit("F", "G", operand.operands[0])
    return Formula("F", (operand,))


def always(operand: Formula) -> Formula:
    """`G f`."""
    return negated(eventually(negated(operand)))


@lru_cache(maxsize=1 << 14)
def negated(formula: Formula) -> Formula:
    """The negation of a formula in negation normal form, in that form."""
    return negation_normal_form(~formula)


def _limit(outer: str, inner: str, operand: Formula) -> Formula:
    """`F G f` or `G F f`, with what X and limits of the same kind allow."""
    while operand.operator == "X" or operand.operator == inner:
        operand = operand.operands[0]
    if operand in (TRUE, FALSE) or is_invariant(operand):
        return operand
    join, spread = ("&", conjunction) if outer == "F" else ("|", disjunction)
    if operand.operator == join:  # F G (f & g) = F G f & F G g
        return spread(_limit(outer, inner, f) for f in operand.operands)
    return Formula(outer, (Formula(inner, (operand,)),))


def _binary(operator: str, left: Formula, right: Formula) -> Formula:
    """`f U g` and the like, by the laws for constants and invariants."""
    if operator in ("R", "M"):
        dual = {"R": "U", "M": "W"}[operator]
        return negated(_binary(dual, negated(left), negated(right)))
    if right == TRUE or implies(left, right):
        return right
    if left == TRUE:
        return eventually(right) if operator == "U" else TRUE
    if right == FALSE:
        return FALSE if operator == "U" else always(left)
    if is_invariant(right):
        return right if operator == "U" else disjunction([right, always(left)])
    if is_invariant(left):
        if operator == "U":
            return disjunction([conjunction([left, eventually(right)]), right])
        return disjunction([left, right])
    if operator == "U" and right.operator == "F":
        return right
    if right.operator == operator and right.operands[0] == left:
        return right
    return Formula(operator, (left, right))


# ---------------------------------------------------------------------------------------------
# Classes
# ---------------------------------------------------------------------------------------------


@lru_cache(maxsize=1 << 14)
def operators_below(formula: Formula) -> frozenset[str]:
    """The operators that occur in a formula."""
    return frozenset(node.operator for node in subformulas(formula))


def is_pure(formula: Formula, absent: frozenset[str]) -> bool:
    """Whether none of some operators occurs."""
    return not operators_below(formula) & absent


@lru_cache(maxsize=1 << 14)
def is_sigma2(formula: Formula) -> bool:
    """Whether no `G R W` has an `F U M` below it."""
    return all(
        is_pure(node, LEAST) for node in subformulas(formula) if node.operator in GREATEST
    )


@lru_cache(maxsize=1 << 14)
def is_pi2(formula: Formula) -> bool:
    """Whether no `F U M` has a `G R W` below it."""
    return all(
        is_pure(node, GREATEST) for node in subformulas(formula) if node.operator in LEAST
    )


# ---------------------------------------------------------------------------------------------
# Normalisation
# ---------------------------------------------------------------------------------------------


def replace_all(formula: Formula, old: Formula, new: Formula) -> Formula:
    """The formula with every occurrence of a subformula replaced, simplified."""
    form: dict[Formula, Formula] = {}
    for node in subformulas(formula):
        if node == old:
            form[node] = new
        elif node.operator in ("true", "false", "ap", "!"):
            form[node] = node
        else:
            operands = [form[f] for f in node.operands]
            same = all(a is b for a, b in zip(operands, node.operands, strict=True))
            form[node] = node if same else _rebuild(node.operator, operands)
    return form[formula]


def _outermost(formula: Formula, chosen: Callable[[Formula], bool]) -> Formula | None:
    """A subformula that is chosen and under no other chosen one."""
    waiting, seen = [formula], set()
    while waiting:
        node = waiting.pop()
        if node in seen:
            continue
        seen.add(node)
        if chosen(node):
            return node
        waiting.extend(node.operands)
    return None


class Rewriter:
    """Rewrites formulas in at most so many steps, each a subformula looked at."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self.known: dict[Formula, Formula] = {}

    def limit_often(self, operand: Formula) -> Formula:
        """`G F f` as a combination of `G F` of co-safe and `F G` of safety formulas.

        `G F f[g W h] = G F f[g U h] | (F G g & G F f[true])`, and a limit or an `F` inside is
        decided once for all.
        """
        whole = always(eventually(operand))
        if not is_limit(whole):
            return self.map_limits(whole)
        if whole.operator == "F":
            return self.limit_ever(whole.operands[0].operands[0])
        operand = whole.operands[0].operands[0]
        self._spend(operand)
        fixed = _outermost(operand, is_limit)
        if fixed is not None:
            return self._split(fixed, operand, self.limit_often)
        least = _outermost(operand, lambda f: f.operator == "F")
        if least is not None:
            often = self.limit_often(least.operands[0])
            return disjunction([
                conjunction([often, self.limit_often(replace_all(operand, least, TRUE))]),
                self.limit_often(replace_all(operand, least, FALSE)),
            ])
        greatest = _outermost(operand, lambda f: f.operator in GREATEST)
        if greatest is None:
            return whole
        if greatest.operator == "G":
            kept, strong = greatest.operands[0], FALSE
        elif greatest.operator == "W":
            kept, strong = greatest.operands[0], _binary("U", *greatest.operands)
        else:
            kept, strong = greatest.operands[1], _binary("M", *greatest.operands)
        return disjunction([
            self.limit_often(replace_all(operand, greatest, strong)),
            conjunction([
                self.limit_ever(kept),
                self.limit_often(replace_all(operand, greatest, TRUE)),
            ]),
        ])

    def limit_ever(self, operand: Formula) -> Formula:
        """`F G f`, the dual of `limit_often`."""
        return negated(self.limit_often(negated(operand)))

    def map_limits(self, formula: Formula) -> Formula:
        """An invariant formula with each limit normalised."""
        if formula.operator in ("&", "|"):
            return _rebuild(formula.operator, [self.map_limits(f) for f in formula.operands])
        if not is_limit(formula):
            return formula
        operand = formula.operands[0].operands[0]
        if formula.operator == "G":
            return formula if is_pure(operand, GREATEST | {"F"}) else self.limit_often(operand)
        return formula if is_pure(operand, LEAST | {"G"}) else self.limit_ever(operand)

    def _split(
        self, fixed: Formula, operand: Formula, rebuild: Callable[[Formula], Formula]
    ) -> Formula:
        """`f[L] = (L & f[true]) | f[false]` for a limit L below an operator."""
        self._spend(operand)
        return disjunction([
            conjunction([self.map_limits(fixed), rebuild(replace_all(operand, fixed, TRUE))]),
            rebuild(replace_all(operand, fixed, FALSE)),
        ])

    def to_sigma2(self, formula: Formula) -> Formula:
        """A combination of Sigma-2 formulas and limits that is equivalent to a simplified formula.

        `f[g U h] W k = (G F h & f[g W h] W k) | f[g U h] U (k | G f[false])`.
        """
        if is_invariant(formula):
            return self.map_limits(formula)
        if formula not in self.known:
            self._spend(formula)
            self.known[formula] = self._to_sigma2(formula)
        return self.known[formula]

    def _spend(self, formula: Formula) -> None:
        self.steps -= len(subformulas(formula))
        if self.steps < 0:
            raise ValueError(
                "to_automaton: the normal form of the formula is too large. Split it into "
                "formulas that are tracked side by side."
            )

    def _to_sigma2(self, formula: Formula) -> Formula:
        if formula.operator in ("&", "|"):
            return _rebuild(formula.operator, [self.to_sigma2(f) for f in formula.operands])
        fixed = _outermost(formula, is_limit)
        if fixed is not None:
            return self._split(fixed, formula, self.to_sigma2)
        if is_sigma2(formula):
            return formula
        normal = _rebuild(formula.operator, [self.to_sigma2(f) for f in formula.operands])
        if normal != formula:
            return self.to_sigma2(normal)
        assert formula.operator in GREATEST
        left, right = formula.operands[0], formula.operands[-1]
        if formula.operator == "G":
            right = FALSE
        elif formula.operator == "R":  # f R g = g W (f & g)
            left, right = right, conjunction([left, right])
        if not is_pure(right, LEAST):
            return disjunction([_binary("U", left, right), self.to_sigma2(always(left))])
        if is_pure(left, LEAST):
            return self.to_sigma2(_binary("W", left, right))
        # The innermost, because its weak form must not bring an F U M below a G R W again.
        least = next(f for f in subformulas(left) if f.operator in LEAST)
        goal, weak = least.operands[-1], TRUE
        if least.operator == "U":
            weak = _binary("W", *least.operands)
        elif least.operator == "M":
            goal, weak = conjunction(least.operands), _binary("R", *least.operands)
        often = self.limit_often(goal)
        without = always(replace_all(left, least, FALSE))
        weaker = _binary("W", replace_all(left, least, weak), right)
        return disjunction([
            conjunction([often, self.to_sigma2(weaker)]),
            self.to_sigma2(_binary("U", left, disjunction([right, without]))),
        ])


# ---------------------------------------------------------------------------------------------
# The combination
# ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Part:
    """A leaf of a combination: `kind` is `"sigma2"`, `"pi2"` or `"limit"`.

    A limit is one `G F f` or `F G f`, or a conjunction of the former or disjunction of the latter.
    """

    kind: str
    formula: Formula


Combination = Part | tuple  # ("&" | "|", combination, ...)


def limit_parts(formula: Formula) -> tuple[Formula, ...]:
    """The limits that a limit part joins."""
    return (formula,) if is_limit(formula) else formula.operands


def combination(
    formula: Formula, grouped: bool = True, dual: bool = False, steps: int = 1_000_000
) -> Combination:
    """A positive combination of Sigma-2 and Pi-2 formulas and limits.

    Args:
        formula: A simplified formula.
        grouped: Leave conjuncts, and disjuncts, of one class together in one part.
        dual: Normalise negations, which gives Pi-2 where Sigma-2 comes else.
        steps: The work at which to give up.

    Raises:
        ValueError: For too many steps or parts.
    """
    parts = _combine(formula, grouped, dual, Rewriter(steps))
    if _size(parts) > MAX_PARTS:
        raise ValueError(
            f"to_automaton: the formula falls into more than {MAX_PARTS} parts. Split it into "
            "formulas that are tracked side by side."
        )
    return parts


def _size(parts: Combination) -> int:
    return 1 if isinstance(parts, Part) else sum(_size(part) for part in parts[1:])


def extent(parts: Combination) -> int:
    """The number of subformulas that a combination tracks, counted for each part."""
    seen: dict[Formula, int] = {}

    def collect(parts: Combination) -> None:
        if isinstance(parts, Part):
            seen[parts.formula] = len(subformulas(parts.formula))
        else:
            for part in parts[1:]:
                collect(part)

    collect(parts)
    return sum(seen.values())


def _combine(formula: Formula, grouped: bool, dual: bool, rewriter: Rewriter) -> Combination:
    if is_limit(formula):
        normal = rewriter.map_limits(formula)
        if is_limit(normal):
            return Part("limit", normal)
        return _combine(normal, grouped, dual, rewriter)
    if formula.operator in ("&", "|"):
        return _join(formula, grouped, dual, rewriter)
    kind = _kind(formula)
    if kind:
        return Part(kind, formula)
    if formula.operator == "X" and formula.operands[0].operator in ("&", "|"):
        below = formula.operands[0]
        spread = Formula(below.operator, tuple(_next(f) for f in below.operands))
        return _combine(spread, grouped, dual, rewriter)
    if dual:
        return _combine(negated(rewriter.to_sigma2(negated(formula))), grouped, dual, rewriter)
    return _combine(rewriter.to_sigma2(formula), grouped, dual, rewriter)


def _kind(formula: Formula) -> str:
    if _outermost(formula, is_limit) is not None:
        return ""
    return "sigma2" if is_sigma2(formula) else "pi2" if is_pi2(formula) else ""


def _join(formula: Formula, grouped: bool, dual: bool, rewriter: Rewriter) -> Combination:
    together: dict[str, list[Formula]] = {"sigma2": [], "pi2": []}
    either: list[Formula] = []
    parts: list[Combination] = []
    for operand in formula.operands:
        kind = _kind(operand)
        if not kind or not grouped:
            parts.append(_combine(operand, grouped, dual, rewriter))
        elif is_sigma2(operand) and is_pi2(operand):
            either.append(operand)
        else:
            together[kind].append(operand)
    if either:
        together["pi2" if together["pi2"] and not together["sigma2"] else "sigma2"] += either
    for kind, formulas in together.items():
        if formulas:
            whole = _rebuild(formula.operator, formulas)
            one = Part(kind, whole) if _kind(whole) else None
            parts.append(one or _combine(whole, grouped, dual, rewriter))
    flat = [p for part in parts for p in _same(formula.operator, part)]
    parts = _joined_limits(formula.operator, flat, grouped)
    return parts[0] if len(parts) == 1 else (formula.operator, *parts)


def _same(operator: str, parts: Combination) -> tuple[Combination, ...]:
    return parts[1:] if not isinstance(parts, Part) and parts[0] == operator else (parts,)


def _joined_limits(
    operator: str, parts: list[Combination], grouped: bool
) -> list[Combination]:
    """The parts, with limits joined that one tracker can follow.

    Those of propositional formulas need no state, so only `G F f | G F g = G F (f | g)` and its
    dual join them; others of the dual kinds are followed in turn.
    """
    outer, turning = ("F", "G") if operator == "&" else ("G", "F")
    inner = "G" if outer == "F" else "F"
    limits = [p.formula for p in parts if isinstance(p, Part) and p.kind == "limit"]
    single = [f for f in limits if is_limit(f)]
    plain = [f for f in single if f.operator == outer and _is_propositional_limit(f)]
    moving = [f for f in single if f.operator == turning]
    joined: list[Formula] = []
    if len(plain) > 1:
        below = _rebuild(operator, [f.operands[0].operands[0] for f in plain])
        joined.append(Formula(outer, (Formula(inner, (below,)),)))
        limits = [f for f in limits if f not in plain]
    if grouped and len(moving) > 1 and not all(map(_is_propositional_limit, moving)):
        joined.append(_flat(operator, moving, TRUE, FALSE))
        limits = [f for f in limits if f not in moving]
    others = [p for p in parts if not (isinstance(p, Part) and p.kind == "limit")]
    return others + [Part("limit", f) for f in limits + joined]


def _is_propositional_limit(formula: Formula) -> bool:
    return is_pure(formula.operands[0].operands[0], _TEMPORAL)
