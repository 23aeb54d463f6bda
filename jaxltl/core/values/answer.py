"""Answers to properties of sparse models: each goes to the solver that it is a question for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import TRUE, Formula
from jaxltl.core.logic.properties import (
    MAX_UNFOLDED_STEPS,
    Bounded,
    Earned,
    Property,
    parse_property,
    unfolded,
)
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.models.state_formulas import states_satisfying
from jaxltl.core.types import Solution, Status
from jaxltl.core.values import bounded
from jaxltl.core.values.average_reward import average_reward
from jaxltl.core.values.opposite import opposite_event
from jaxltl.core.values.reachability import reachability_probability
from jaxltl.core.values.sparse_satisfaction import (
    Satisfaction,
    at_states,
    sparse_satisfaction,
)
from jaxltl.core.values.total_reward import total_reward

TOLERANCE = 1e-6
FINER = (1.0, 1e-3, 1e-6)  # parts of the tolerance by which a threshold is tried
TINY = 1e-12  # width of an interval of rewards that is narrow enough whatever they are
_OTHER = {"max": "min", "min": "max"}


class Strategy(NamedTuple):
    """What attains an answer.

    Attributes:
      row: the row of the model that is taken: ``int32[S]``; with a memory ``int32[N]``, for each
        state of the product.
      by: how many steps (``"steps"``) or how much reward (``"reward"``) is left, if the row is the
        first choice of a strategy that depends on that; else empty.
      memory: the automaton and the product that a memory is from, or None.
    """

    row: np.ndarray
    by: str = ""
    memory: Satisfaction | None = None


class Answer(NamedTuple):
    """What a property asked for.

    Attributes:
      states: ``int[I]``, the states that were asked for.
      value, lower, upper: ``float64[I]``; the bounds are certified.
      holds: of a threshold, whether it is met in each state; None where the bounds do not tell.
      status: CONVERGED where all bounds are narrow, or decide the threshold.
      method: how it was found and proven, in a few words.
      strategy: what attains the value; None where nothing is chosen.
    """

    states: np.ndarray
    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    holds: list[bool | None] | None
    status: Status
    method: str
    strategy: Strategy | None


class _Found(NamedTuple):
    """The bounds of one solve at the states that were asked for."""

    solution: Solution
    method: str
    strategy: Strategy | None


def answer(
    model: SparseMDP, prop: Property | str, *, states: Any = None, tolerance: float = TOLERANCE
) -> Answer:
    """The value of a property, or whether its threshold is met, with certified bounds.

    Args:
      model: the model.
      prop: a property or its text, see :func:`~jaxltl.core.logic.properties.parse_properties`.
      states: ``int[I]``; default the initial states.
      tolerance: the width of the bounds, absolute for probabilities and relative for the rest.

    Returns:
      :class:`Answer`. A threshold that the bounds do not decide is tried with narrower ones; where
      those do not tell either, `holds` is None and the status is not CONVERGED.

    Raises:
      ValueError: an unknown label or reward; no objective though the model has choices; a question
        that the solvers do not take, with the reason.

    Example:
      >>> from jaxltl.core.models.sparse import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                    initial=[1, 0, 0], label=[[0], [1], [0]], propositions=["a"])
      >>> answer(coin, 'P=? [ F "a" ]').value.tolist()
      [0.5]
      >>> answer(coin, 'P>0.4 [ X "a" ]').holds
      [True]
    """
    prop = parse_property(prop) if isinstance(prop, str) else prop
    if prop.operator == "multi":
        raise ValueError("multi(...) has several values; solve it with achievable or pareto.")
    if states is None:
        states = np.flatnonzero(np.asarray(model.initial) > 0)
    states = np.asarray(states, np.int64)
    objective = _objective(model, prop)
    solve = _solver(model, prop, objective, states)
    found = solve(tolerance)
    if prop.relation is None:
        return _answer(prop, states, found, None, tolerance)
    verdicts = _verdicts(prop, found)
    for part in FINER[1:]:
        if None not in verdicts or _is_exact(found):
            break
        found = solve(tolerance * part)
        verdicts = _verdicts(prop, found)
    return _answer(prop, states, found, verdicts, tolerance)


def _answer(
    prop: Property, states: np.ndarray, found: _Found, holds: list[bool | None] | None,
    tolerance: float,
) -> Answer:
    value, lower, upper = (np.asarray(x, np.float64) for x in (
        found.solution.value, found.solution.lower, found.solution.upper))
    if holds is None:
        status = _status(prop, found, tolerance)
    else:
        status = Status.PRECISION if None in holds else Status.CONVERGED
    return Answer(states, value, lower, upper, holds, status, found.method, found.strategy)


def _status(prop: Property, found: _Found, tolerance: float) -> Status:
    """CONVERGED if the bounds of the states that were asked for are narrow."""
    lower, upper = found.solution.lower, found.solution.upper
    told = Status(int(np.max(found.solution.status)))
    if np.isnan(lower).any() or np.isnan(upper).any() or told == Status.INVALID:
        return max(told, Status.NONFINITE)
    with np.errstate(invalid="ignore"):
        width = np.where(lower == upper, 0, upper - lower)
        most: Any = tolerance
        if prop.operator in ("R", "T"):
            most = np.maximum(tolerance * np.maximum(np.abs(lower), np.abs(upper)), TINY)
        narrow = (width == 0) | ((width <= most) & np.isfinite(width))
    # An average near zero is narrow as a share of the rewards that cancel out in it.
    told_narrow = prop.path == Earned("average") and told == Status.CONVERGED
    if narrow.all() or told_narrow:
        return Status.CONVERGED
    return max(told, Status.PRECISION)


def _is_exact(found: _Found) -> bool:
    return bool((found.solution.lower == found.solution.upper).all())


def _verdicts(prop: Property, found: _Found) -> list[bool | None]:
    assert prop.relation is not None and prop.threshold is not None
    lower, upper = np.asarray(found.solution.lower), np.asarray(found.solution.upper)
    return [meets(prop.relation, prop.threshold, low, high)
            for low, high in zip(lower.tolist(), upper.tolist(), strict=True)]


def meets(relation: str, threshold: Fraction, lower: float, upper: float) -> bool | None:
    """Whether all numbers between two bounds meet a threshold, or none does; else None.

    >>> meets(">=", Fraction(1, 2), 0.5, 0.75), meets("<", Fraction(1, 2), 0.25, 0.5)
    (True, None)
    """
    if lower != lower or upper != upper:
        return None
    if relation in ("<", "<="):
        opposite = meets({"<": ">=", "<=": ">"}[relation], threshold, lower, upper)
        return None if opposite is None else not opposite
    # Floats and fractions are compared exactly.
    if relation == ">=":
        return True if lower >= threshold else False if upper < threshold else None
    return True if lower > threshold else False if upper <= threshold else None


def _objective(model: SparseMDP, prop: Property) -> str:
    if prop.direction is not None:
        return prop.direction
    if not model.is_chain:
        sign = prop.operator + (f'{{"{prop.reward}"}}' if prop.reward else "")
        raise ValueError(
            f"{prop.text}: the model has states with several choices, so the value depends on a "
            f"strategy; ask for {sign}max=? or {sign}min=?.")
    return "max"


# --- which solver -----------------------------------------------------------------------------


def _solver(
    model: SparseMDP, prop: Property, objective: str, states: np.ndarray
) -> Callable[[float], _Found]:
    """What solves a property at a tolerance."""
    if prop.operator == "P":
        assert not isinstance(prop.path, Earned)
        return _Probability(model, states, prop.text).of(prop.path, objective)
    if prop.operator == "LRA":
        assert isinstance(prop.path, Formula)
        share = states_satisfying(model, prop.path, prop.text).astype(np.float64)
        return lambda tolerance: _plain(states, average_reward(
            model, share, objective=objective, tolerance=tolerance))
    reward: Any = np.ones(model.num_rows) if prop.operator == "T" else prop.reward
    return _reward_solver(model, prop, reward, objective, states)


def _reward_solver(
    model: SparseMDP, prop: Property, reward: Any, objective: str, states: np.ndarray
) -> Callable[[float], _Found]:
    path = prop.path
    if isinstance(path, Formula):
        target = states_satisfying(model, path.operands[0], prop.text)
        return lambda tolerance: _plain(states, total_reward(
            model, reward, target, objective=objective, tolerance=tolerance))
    assert isinstance(path, Earned)
    if path.kind == "average":
        return lambda tolerance: _plain(states, average_reward(
            model, reward, objective=objective, tolerance=tolerance))
    if path.kind == "total":
        return lambda tolerance: _plain(states, total_reward(
            model, reward, objective=objective, tolerance=tolerance))
    steps: Any = path.steps
    solve = (bounded.cumulative_reward if path.kind == "cumulative"
             else bounded.instantaneous_reward)
    return lambda tolerance: _plain(
        states, solve(model, reward, steps, objective=objective), by="steps")


def _plain(states: np.ndarray, solution: Solution, by: str = "") -> _Found:
    method = str(solution.method) or {
        "steps": "step by step", "reward": "level by level of the reward"}.get(by, "")
    return _Found(
        at_states(solution, states), method, Strategy(np.asarray(solution.policy), by))


class _Probability(NamedTuple):
    """Probabilities of paths of one model, at some states."""

    model: SparseMDP
    states: np.ndarray
    text: str

    def of(self, path: Formula | Bounded, objective: str) -> Callable[[float], _Found]:
        """What solves a path at a tolerance; simple ones without an automaton."""
        if isinstance(path, Bounded):
            return self.within(path, objective)
        if path.operator == "!" and not is_boolean(path):
            return self.opposite(path.operands[0], objective)
        if is_boolean(path):
            return lambda tolerance: self.at_once(path)
        if not all(is_boolean(f) for f in path.operands):
            return self.automaton(path, objective)
        left, right = path.operands[0], path.operands[-1]
        match path.operator:
            case "X":
                target = self.where(right)
                return lambda tolerance: _plain(self.states, bounded.next_probability(
                    self.model, target, objective=objective))
            case "F":
                return self.until(TRUE, right, objective)
            case "U":
                return self.until(left, right, objective)
            case "G":
                return self.opposite(Formula("F", (~right,)), objective)
            case "W":
                return self.opposite(Formula("U", (~right, ~left & ~right)), objective)
            case "R":
                return self.opposite(Formula("U", (~left, ~right)), objective)
        raise AssertionError(path.operator)

    def where(self, condition: Formula) -> np.ndarray:
        return states_satisfying(self.model, condition, self.text)

    def at_once(self, path: Formula) -> _Found:
        holds: Any = self.where(path).astype(np.float64)[self.states]
        zero: Any = np.int32(0)
        nobody: Any = np.zeros(0, np.int32)
        return _Found(Solution(
            value=holds, policy=nobody, lower=holds, upper=holds, residual=zero, num_steps=zero,
            status=zero), "the label", None)

    def opposite(self, path: Formula | Bounded, objective: str) -> Callable[[float], _Found]:
        solve = self.of(path, _OTHER[objective])

        def found(tolerance: float) -> _Found:
            result = solve(tolerance)
            return result._replace(solution=opposite_event(result.solution))

        return found

    def until(self, left: Formula, right: Formula, objective: str) -> Callable[[float], _Found]:
        target: Any = self.where(right)
        stay: Any = None if left == TRUE else self.where(left)
        return lambda tolerance: _plain(self.states, reachability_probability(
            self.model, target, stay=stay, objective=objective, tolerance=tolerance))

    def automaton(self, path: Formula, objective: str) -> Callable[[float], _Found]:
        def found(tolerance: float) -> _Found:
            result = sparse_satisfaction(
                self.model, path, objective=objective, states=self.states, tolerance=tolerance)
            method = str(result.solution.method)
            size = f"product of {result.product.host.num_states} states"
            return _Found(result.solution, f"{size}, {method}" if method else size,
                          Strategy(result.row, memory=result))

        return found

    def within(self, path: Bounded, objective: str) -> Callable[[float], _Found]:
        if path.operator == "R":
            negated = TRUE if path.left.operator == "false" else ~path.left
            return self.opposite(
                replace(path, operator="U", left=negated, right=~path.right), objective)
        if path.reward is not None:
            return self.within_reward(path, objective)
        if path.lower or path.upper is None:
            if max(path.lower, path.upper or 0) > MAX_UNFOLDED_STEPS:
                raise ValueError(
                    f"{self.text}: a lower bound on steps is solved for up to "
                    f"{MAX_UNFOLDED_STEPS} steps; drop it or make it smaller.")
            return self.of(unfolded(path), objective)
        target, stay = self.where(path.right), self.where(path.left)
        steps = path.upper
        return lambda tolerance: _plain(self.states, bounded.bounded_reachability(
            self.model, target, steps, stay=stay, objective=objective), by="steps")

    def within_reward(self, path: Bounded, objective: str) -> Callable[[float], _Found]:
        assert path.limit is not None
        target, stay = self.where(path.right), self.where(path.left)
        # Rewards are counted in units of more than 1e-9, so this is just below the limit.
        limit = path.limit - Fraction(1, 10**9) * path.strict
        reward = path.reward or None
        return lambda tolerance: _plain(self.states, bounded.reward_bounded_reachability(
            self.model, target, reward, float(limit), stay=stay, objective=objective), by="reward")
