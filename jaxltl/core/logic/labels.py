"""Satisfaction of Boolean formulas over propositions in arrays of labels."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.logic.ltl import Formula, as_formula, proposition_text, subformulas, truth_on_lasso

_BOOLEAN = frozenset(("true", "false", "ap", "!", "&", "|", "->", "<->", "xor"))


def is_boolean(formula: Formula) -> bool:
    """True if a formula is without temporal operators, so that a single state decides it."""
    return all(f.operator in _BOOLEAN for f in subformulas(formula))


def require_known(needed: Collection[str], known: Sequence[str], place: str) -> None:
    """Raises a ValueError that names the first proposition that is not known."""
    for name in needed:
        if name not in known:
            raise ValueError(
                f"{place} mentions the proposition {name!r}, which the world does not have; "
                f"its propositions are {', '.join(known) or '(none)'}.{_hint(name, known)}"
            )


def _hint(name: str, known: Sequence[str]) -> str:
    """A name that may be meant: one like it, or one whose first letters were read as operators."""
    by_case = {one.lower(): one for one in reversed(known)}
    for prefix in ("F", "G", "X"):
        written = prefix + name
        if (meant := by_case.get(written.lower())) is not None:
            return (
                f" If {written} was written, it is read as the operator {prefix} and {name}, as in "
                f"Spot: write {proposition_text(meant)}."
            )
    guess = difflib.get_close_matches(name, known, n=1)
    return f" Did you mean {guess[0]!r}?" if guess else ""


def satisfying(
    label: NDArray[np.bool_], propositions: Sequence[str], condition: Formula | str, place: str
) -> NDArray[np.bool_]:
    """The rows of labels that satisfy a Boolean formula."""
    condition = as_formula(condition)
    temporal = [f for f in subformulas(condition) if f.operator not in _BOOLEAN]
    if temporal:
        raise ValueError(
            f"{place}: {str(condition)!r} is not Boolean: {str(temporal[0])!r} is temporal. "
            "Write a condition on single states with ! & | -> <-> xor."
        )
    require_known(condition.propositions, propositions, f"{place}: {str(condition)!r}")
    column = [list(propositions).index(p) for p in condition.propositions]
    rows, number = distinct_rows(np.asarray(label, bool)[:, column])
    names = np.array(condition.propositions, dtype=object)
    # At each letter of any word a formula without temporal operators has its truth in that letter.
    truth = truth_on_lasso(condition, [], [set(names[row]) for row in rows]) if len(rows) else []
    return np.array(truth, bool)[number]


_COUNTED = 16  # columns up to which every combination has a counter


def distinct_rows(rows: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """The different rows of a Boolean array, and the number of each row among them."""
    width = rows.shape[1]
    if width > _COUNTED:
        distinct, number = np.unique(rows, axis=0, return_inverse=True)
        return distinct, number.ravel()
    code = np.zeros(len(rows), np.int32)
    for i in range(width):
        code = code << 1 | rows[:, i]
    present = np.flatnonzero(np.bincount(code, minlength=1 << width))
    number = np.zeros(1 << width, np.int64)
    number[present] = np.arange(present.size)
    bits = np.arange(width - 1, -1, -1)
    return (present[:, None] >> bits & 1).astype(bool), number[code]
