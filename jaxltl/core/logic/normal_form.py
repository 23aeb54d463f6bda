"""Formulas as Boolean combinations of parts that each have a simple deterministic automaton.

A formula in negation normal form is in Sigma-2 when no `G R W` has an `F U M` below it, and in
Pi-2 when no `F U M` has a `G R W` below it. Every formula is a positive combination of such
formulas and of limits, `G F f` and `F G f` (Manna & Pnueli 1990; Chang, Manna & Pnueli 1992);
here it is found by the rewriting of Esparza, Rubio & Sickert 2022, "A simple rewrite system for
the normalization of linear temporal logic".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from jaxltl.core.logic.ltl import FALSE, TRUE, Formula, subformulas
from jaxltl.core.logic.simplify import (
    GREATEST,
    LEAST,
    TEMPORAL,
    always,
    binary,
    conjunction,
    disjunction,
    eventually,
    is_invariant,
    is_limit,
    negated,
    next_step,
    rebuild,
    replace_all,
)

MAX_PARTS = 400  # leaves of a combination beyond which the rewriting is given up


# --- Classes ---------------------------------------------------------------------------------


@lru_cache(maxsize=1 << 14)
def operators_below(formula: Formula) -> frozenset[str]:
    """The operators that occur in a formula."""
    return frozenset(node.operator for node in subformulas(formula))


def is_pure(formula: Formula, absent: frozenset[str]) -> bool:
    """True if none of some operators occurs."""
    return not operators_below(formula) & absent


@lru_cache(maxsize=1 << 14)
def is_sigma2(formula: Formula) -> bool:
    """True if no `G R W` has an `F U M` below it."""
    return all(is_pure(node, LEAST) for node in subformulas(formula) if node.operator in GREATEST)


@lru_cache(maxsize=1 << 14)
def is_pi2(formula: Formula) -> bool:
    """True if no `F U M` has a `G R W` below it."""
    return all(is_pure(node, GREATEST) for node in subformulas(formula) if node.operator in LEAST)


# --- Normalisation ---------------------------------------------------------------------------


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


def _choice(both: list[Formula], other: Formula) -> Formula:
    return disjunction([conjunction(both), other])


class Rewriter:
    """Rewrites formulas; `steps` bounds the number of subformulas that are visited."""

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
            return _choice(
                [
                    self.limit_often(least.operands[0]),
                    self.limit_often(replace_all(operand, least, TRUE)),
                ],
                self.limit_often(replace_all(operand, least, FALSE)),
            )
        greatest = _outermost(operand, lambda f: f.operator in GREATEST)
        if greatest is None:
            return whole
        weak, strong = greatest.operands[0], FALSE
        if greatest.operator == "W":
            strong = binary("U", *greatest.operands)
        elif greatest.operator == "R":
            weak, strong = greatest.operands[1], binary("M", *greatest.operands)
        return _choice(
            [self.limit_ever(weak), self.limit_often(replace_all(operand, greatest, TRUE))],
            self.limit_often(replace_all(operand, greatest, strong)),
        )

    def limit_ever(self, operand: Formula) -> Formula:
        """`F G f`, the dual of `limit_often`."""
        return negated(self.limit_often(negated(operand)))

    def map_limits(self, formula: Formula) -> Formula:
        """An invariant formula with each limit normalised."""
        if formula.operator in ("&", "|"):
            return rebuild(formula.operator, [self.map_limits(f) for f in formula.operands])
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
        return _choice(
            [self.map_limits(fixed), rebuild(replace_all(operand, fixed, TRUE))],
            rebuild(replace_all(operand, fixed, FALSE)),
        )

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
            return rebuild(formula.operator, [self.to_sigma2(f) for f in formula.operands])
        fixed = _outermost(formula, is_limit)
        if fixed is not None:
            return self._split(fixed, formula, self.to_sigma2)
        if is_sigma2(formula):
            return formula
        normal = rebuild(formula.operator, [self.to_sigma2(f) for f in formula.operands])
        if normal != formula:
            return self.to_sigma2(normal)
        assert formula.operator in GREATEST
        left, right = formula.operands[0], formula.operands[-1]
        if formula.operator == "G":
            right = FALSE
        elif formula.operator == "R":  # f R g = g W (f & g)
            left, right = right, conjunction([left, right])
        if not is_pure(right, LEAST):
            return disjunction([binary("U", left, right), self.to_sigma2(always(left))])
        if is_pure(left, LEAST):
            return self.to_sigma2(binary("W", left, right))
        # The innermost, because its weak form must not bring an F U M below a G R W again.
        least = next(f for f in subformulas(left) if f.operator in LEAST)
        goal, weak = least.operands[-1], TRUE
        if least.operator == "U":
            weak = binary("W", *least.operands)
        elif least.operator == "M":
            goal, weak = conjunction(least.operands), binary("R", *least.operands)
        often = self.limit_often(goal)
        without = always(replace_all(left, least, FALSE))
        weaker = binary("W", replace_all(left, least, weak), right)
        return _choice(
            [often, self.to_sigma2(weaker)],
            self.to_sigma2(binary("U", left, disjunction([right, without]))),
        )


# --- The combination -------------------------------------------------------------------------


@dataclass(frozen=True)
class LimitPart:
    """A leaf of a combination; its kind is `"sigma2"`, `"pi2"` or `"limit"`, joined `G F` or `F G`."""

    kind: str
    formula: Formula


Combination = LimitPart | tuple[Any, ...]  # ("&" | "|", combination, ...)


def limit_parts(formula: Formula) -> tuple[Formula, ...]:
    """The limits that a limit part joins."""
    return (formula,) if is_limit(formula) else formula.operands


def combination(
    formula: Formula, grouped: bool = True, dual: bool = False, steps: int = 1_000_000
) -> Combination:
    """A positive combination of Sigma-2 and Pi-2 formulas and limits."""
    parts = _combine(formula, grouped, dual, Rewriter(steps))
    if len(leaves(parts)) > MAX_PARTS:
        raise ValueError(
            f"to_automaton: the formula falls into more than {MAX_PARTS} parts. Split it into "
            "formulas that are tracked side by side."
        )
    return parts


def leaves(parts: Combination) -> list[LimitPart]:
    """The parts of a combination."""
    return (
        [parts] if isinstance(parts, LimitPart) else [x for part in parts[1:] for x in leaves(part)]
    )


def extent(parts: Combination) -> int:
    """The number of subformulas that a combination tracks, counted for each part."""
    return sum(len(subformulas(formula)) for formula in {part.formula for part in leaves(parts)})


def _combine(formula: Formula, grouped: bool, dual: bool, rewriter: Rewriter) -> Combination:
    if is_limit(formula):
        normal = rewriter.map_limits(formula)
        if is_limit(normal):
            return LimitPart("limit", normal)
        return _combine(normal, grouped, dual, rewriter)
    if formula.operator in ("&", "|"):
        return _join(formula, grouped, dual, rewriter)
    kind = _kind(formula)
    if kind:
        return LimitPart(kind, formula)
    if formula.operator == "X" and formula.operands[0].operator in ("&", "|"):
        below = formula.operands[0]
        distributed = Formula(below.operator, tuple(next_step(f) for f in below.operands))
        return _combine(distributed, grouped, dual, rewriter)
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
            whole = rebuild(formula.operator, formulas)
            one = LimitPart(kind, whole) if _kind(whole) else None
            parts.append(one or _combine(whole, grouped, dual, rewriter))
    flat = [p for part in parts for p in _same(formula.operator, part)]
    parts = _joined_limits(formula.operator, flat, grouped)
    return parts[0] if len(parts) == 1 else (formula.operator, *parts)


def _same(operator: str, parts: Combination) -> tuple[Combination, ...]:
    return parts[1:] if not isinstance(parts, LimitPart) and parts[0] == operator else (parts,)


def _joined_limits(operator: str, parts: list[Combination], grouped: bool) -> list[Combination]:
    """The parts, with limits joined that one tracker can follow.

    `G F f | G F g = G F (f | g)` and its dual for propositional formulas; others round-robin.
    """
    outer, turning = ("F", "G") if operator == "&" else ("G", "F")
    inner = "G" if outer == "F" else "F"
    limits = [p.formula for p in parts if isinstance(p, LimitPart) and p.kind == "limit"]
    single = [f for f in limits if is_limit(f)]
    plain = [f for f in single if f.operator == outer and _is_propositional_limit(f)]
    moving = [f for f in single if f.operator == turning]
    joined: list[Formula] = []
    if len(plain) > 1:
        below = rebuild(operator, [f.operands[0].operands[0] for f in plain])
        joined.append(Formula(outer, (Formula(inner, (below,)),)))
        limits = [f for f in limits if f not in plain]
    if grouped and len(moving) > 1 and not all(map(_is_propositional_limit, moving)):
        joined.append(rebuild(operator, moving))
        limits = [f for f in limits if f not in moving]
    others = [p for p in parts if not (isinstance(p, LimitPart) and p.kind == "limit")]
    constant = (TRUE, FALSE)
    return others + [LimitPart("sigma2" if f in constant else "limit", f) for f in limits + joined]


def _is_propositional_limit(formula: Formula) -> bool:
    return is_pure(formula.operands[0].operands[0], TEMPORAL)
