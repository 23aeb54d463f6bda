"""Simpler equivalents of formulas in negation normal form, by rules that look at their syntax.

Limits, `G F f` and `F G f`, are true now iff they are true later, so they are pulled outwards.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import lru_cache

from jaxltl.core.logic.ltl import FALSE, TRUE, Formula, negation_normal_form, subformulas

LEAST, GREATEST = frozenset("FUM"), frozenset("GRW")
TEMPORAL = LEAST | GREATEST | {"X"}


def conjunction(parts: Iterable[Formula]) -> Formula:
    """`f & g & ...`, simplified; true if empty."""
    return flattened("&", parts, TRUE, FALSE)


def disjunction(parts: Iterable[Formula]) -> Formula:
    """`f | g | ...`, simplified; false if empty."""
    return flattened("|", parts, FALSE, TRUE)


def flattened(operator: str, parts: Iterable[Formula], unit: Formula, zero: Formula) -> Formula:
    """Parts under `&` or `|`, flat and simplified: `unit` if none is left, or `zero`."""
    operands: dict[Formula, None] = {}
    for part in parts:
        for piece in part.operands if part.operator == operator else (part,):
            if piece == zero or _opposite(piece) in operands:
                return zero
            if piece != unit:
                operands[piece] = None
    pieces = _without_implied(operator, list(operands))
    if pieces is None:
        return zero
    if not pieces:
        return unit
    return pieces[0] if len(pieces) == 1 else Formula(operator, tuple(pieces))


def _without_implied(operator: str, pieces: list[Formula]) -> list[Formula] | None:
    """The operands that no other makes superfluous; None if two of them decide the whole."""
    if not any(piece.operator in TEMPORAL for piece in pieces):
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
    """True if rules (Somenzi & Bloem 2000) show that every word of `one` satisfies `two`."""
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


# --- Simplification --------------------------------------------------------------------------


def is_limit(formula: Formula) -> bool:
    """True if the formula is `G F f` or `F G f`, so that no finite prefix matters to it."""
    below = formula.operands[0].operator if formula.operands else ""
    return (formula.operator, below) in (("G", "F"), ("F", "G"))


@lru_cache(maxsize=1 << 14)
def is_invariant(formula: Formula) -> bool:
    """True if the formula is a Boolean combination of limits: true now iff true later."""
    if formula.operator in ("&", "|"):
        return all(is_invariant(part) for part in formula.operands)
    return is_limit(formula) or formula in (TRUE, FALSE)


def simplify(formula: Formula) -> Formula:
    """An equivalent formula in negation normal form, with limits pulled outwards."""
    return _rebuilt(negation_normal_form(formula), {}, lambda node: False)


def replace_all(formula: Formula, old: Formula, new: Formula) -> Formula:
    """The formula with every occurrence of a subformula replaced, where that occurs simplified."""
    occurs = {old}
    for node in subformulas(formula):
        if occurs.intersection(node.operands):
            occurs.add(node)
    return _rebuilt(formula, {old: new}, lambda node: node not in occurs)


def _rebuilt(
    formula: Formula, form: dict[Formula, Formula], is_kept: Callable[[Formula], bool]
) -> Formula:
    """The formula with the forms of some subformulas, simplified above those that are not kept."""
    for node in subformulas(formula):
        if node in form:
            continue
        if node.operator in ("true", "false", "ap", "!") or is_kept(node):
            form[node] = node
        else:
            form[node] = rebuild(node.operator, [form[f] for f in node.operands])
    return form[formula]


def rebuild(operator: str, operands: list[Formula]) -> Formula:
    """The node over simplified operands, simplified."""
    if operator == "&":
        return conjunction(operands)
    if operator == "|":
        return disjunction(operands)
    left, right = operands[0], operands[-1]
    if operator == "X":
        return left if is_invariant(left) else next_step(left)
    if operator == "F":
        return eventually(right)
    if operator == "G":
        return always(right)
    return binary(operator, left, right)


def next_step(operand: Formula) -> Formula:
    """`X f`, which a limit does not need."""
    if is_invariant(operand):
        return operand
    if operand.operator in ("&", "|"):
        fixed = [f for f in operand.operands if is_invariant(f)]
        if fixed:
            moved = [f if is_invariant(f) else next_step(f) for f in operand.operands]
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
        return next_step(eventually(operand.operands[0]))
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
    join, distribute = ("&", conjunction) if outer == "F" else ("|", disjunction)
    if operand.operator == join:  # F G (f & g) = F G f & F G g
        return distribute(_limit(outer, inner, f) for f in operand.operands)
    return Formula(outer, (Formula(inner, (operand,)),))


def binary(operator: str, left: Formula, right: Formula) -> Formula:
    """`f U g` and the like, by the laws for constants and invariants."""
    if operator in ("R", "M"):
        dual = {"R": "U", "M": "W"}[operator]
        return negated(binary(dual, negated(left), negated(right)))
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
