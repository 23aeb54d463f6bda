"""Model checking: dispatches a property to its solver."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from functools import partial
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.deferred import Deferred
from jaxltl.core.logic.bounded import Bounded, Conditional, Earned, unfolded
from jaxltl.core.logic.comparisons import Definitions
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import Formula, TRUE
from jaxltl.core.logic.properties import Property, parse_property
from jaxltl.core.logic.property import MAX_UNFOLDED_STEPS
from jaxltl.core.models.action_numbers import rows_of_policy
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.game import Game
from jaxltl.core.models.multiplayer import MultiplayerGame
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Reward, SparseMDP
from jaxltl.core.sparse.exact.model import double_bounds
from jaxltl.core.sparse.solvers.shortest_path_problem import RelativeTolerance
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.average.average_reward import average_reward
from jaxltl.core.values.engine.host_solution import complement_event
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.values.interval.sides import requested_width
from jaxltl.core.values.multi_objective.multi_objective import (
    Achievable,
    ConstrainedOptimum,
    Pareto,
)
from jaxltl.core.values.properties.aims import (
    CheckableModel,
    PropertyAim,
    SourceModel,
    aim_of,
    checkable,
    graph_of_model,
    maximizers,
    of_coalition,
)
from jaxltl.core.values.properties.answers import (
    Answer as Answer,
    PropertyStrategy as PropertyStrategy,
    filtered,
    with_definitions,
)
from jaxltl.core.values.properties.several_objectives import solve_multi_objective
from jaxltl.core.values.properties.exact_thresholds import exact_values, reward_limit
from jaxltl.core.values.undiscounted import step_bounded as bounded
from jaxltl.core.values.undiscounted.step_engine import bounded_avoidance
from jaxltl.core.values.undiscounted.fastest import QUICK_LIMIT, certified_fastest_rows
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.reaching import avoidance_probability
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from jaxltl.core.values.undiscounted.sparse_satisfaction import at_states, starting_states
from jaxltl.core.values.undiscounted.total_reward import total_reward


TOLERANCE = 1e-6
TOLERANCE_SHARES = (
    1.0,
    1e-3,
    1e-6,
)  # shares of the tolerance with which an open threshold is tried
_EXACT = 1e-10  # tolerances up to which tiny models are solved in rational arithmetic
_FEW = 32  # rows of a tiny model that leave their state
_MARGIN = 1e-6  # relative difference of values of doubles and of the rationals behind them
_RATIONAL = "rational arithmetic"
TINY = 1e-12  # absolute width of bounds on rewards that is always accepted
_AVERAGE = "averages of end components"


class _Result(NamedTuple):
    """The solution at the requested states."""

    solution: Solution
    strategy: PropertyStrategy | None


@validated(games=True, host=True)
def solve_property(
    model: Model | MultiplayerGame | POMDP,
    prop: Property | str,
    *,
    states: ArrayLike | None = None,
    tolerance: float = TOLERANCE,
    relative: bool = False,
) -> Answer | Achievable | ConstrainedOptimum | Pareto:
    """Model checking: the value of a property, or its truth, with certified bounds.

    Args:
      model: any concrete model. An interval model needs the directions of the policy and of nature, as
        in ``Pmaxmin=?``; an interval chain that of nature; a game a coalition of its players, system
        and environment, as in ``<<system>> Pmax=?``. In a multi-player game a coalition has names or
        numbers of players, ``<<p1, 3>>``, or all, ``<<*>>``; without one all players are one. States
        of a product are numbered ``s * Q + q``.
      prop: a property or its text, see :func:`~jaxltl.core.logic.properties.parse_properties`.
      states: ``int[I]``; default the initial states. Not with ``multi(...)``.
      tolerance: width of the bounds, absolute for probabilities and relative otherwise.
      relative: True for a width relative to the value for probabilities too. Not for those of
        interval models, ``multi(...)`` and long-run averages.

    Returns:
      :class:`Answer`. If narrower bounds do not decide a threshold either, `holds` is None and the
      status is not CONVERGED. For ``multi(...)``, the result of
      :func:`~jaxltl.core.values.multi_objective.multi_objective.multi_objective`. Concrete arrays
      only; not differentiable.

    Raises:
      ValueError: an unknown label or reward; a missing direction; a property that is not
        supported, with the reason.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                    initial=[1, 0, 0], label=[[0], [1], [0]], propositions=["a"])
      >>> solve_property(coin, 'P=? [ F "a" ]').value.tolist()
      [0.5]
    """
    source = checkable(model)
    if isinstance(prop, str):
        prop = parse_property(prop, Definitions(variables=tuple(graph_of_model(source).valuation)))
    if not isinstance(prop, Property):
        raise ValueError(f"prop is {validation.shorten(prop)}; give a property or its text.")
    again = partial(solve_property, tolerance=tolerance, relative=relative)
    if prop.definitions:
        source = with_definitions(
            source,
            prop,
            lambda world, part: cast(Answer, again(world, part, states=range(world.num_states))),
        )
    width = RelativeTolerance if relative else float
    if prop.aggregate is not None:
        return _filter(source, prop, states, width(tolerance))
    chosen, prop = of_coalition(source, prop)
    if relative and (
        prop.operator in ("multi", "LRA")
        or prop.path == Earned("average")
        or (not isinstance(chosen, SparseMDP) and prop.operator == "P")
    ):
        raise ValueError(
            f"{prop.text}: relative=True is for probabilities of path formulas, without intervals or a "
            "second player, and for total rewards."
        )
    if prop.operator == "multi":
        if states is not None or not isinstance(chosen, SparseMDP):
            restriction = (
                "from other than the initial states"
                if states is not None
                else "with intervals or a second player"
            )
            raise ValueError(
                f"{prop.text}: multi(...) is not supported {restriction}; ask for one objective at a time."
            )
        return solve_multi_objective(chosen, prop, tolerance)
    if states is None:
        states = np.flatnonzero(np.asarray(chosen.initial) > 0)
    states = starting_states(chosen, states)
    tolerance = requested_width(tolerance)
    aim = aim_of(chosen, prop)
    solve = partial(_solved, _ModelQuery(chosen, states, prop.text), prop, aim)
    result = solve(width(tolerance))

    def exact() -> list[Fraction | float] | None:
        strategy = result.strategy
        rows = strategy.row if strategy is not None and strategy.memory is None else None
        return exact_values(chosen, prop, states, maximizers(chosen, aim), rows)

    if prop.relation is None:
        if tolerance <= _EXACT and not _is_exact(result) and _is_tiny(chosen):
            result = _with_values(result, exact())
        return _answer(prop, states, result, None, width(tolerance))
    verdicts = _verdicts(prop, result)
    for share in TOLERANCE_SHARES[1:]:
        if None not in verdicts or _is_exact(result):
            break
        result = solve(width(tolerance * share))
        verdicts = _verdicts(prop, result)
    if None in verdicts or _is_close(chosen, prop, result):
        values = exact()
        if values is not None:
            assert prop.threshold is not None
            verdicts = [meets(prop.relation, prop.threshold, x, x) for x in values]
            result = _with_values(result, values)
    return _answer(prop, states, result, verdicts, tolerance)


def _filter(model: SourceModel, prop: Property, states: object, tolerance: float) -> Answer:
    """The aggregate of a property over the states of a filter."""
    if states is not None:
        raise ValueError(f"{prop.text}: a filter is over its own states; leave states out.")
    among = np.flatnonzero(states_satisfying(graph_of_model(model), prop.among, prop.text))
    if not among.size:
        raise ValueError(f"{prop.text}: no state satisfies {prop.among}, the states of the filter.")
    # So that sums of bounds are as narrow as the tolerance.
    shares = {"sum": len(among)}
    part = replace(prop, aggregate=None, definitions=())
    fine = tolerance / shares.get(str(prop.aggregate), 1)
    relative = isinstance(tolerance, RelativeTolerance)
    answer = cast(
        Answer, solve_property(model, part, states=among, tolerance=fine, relative=relative)
    )
    return filtered(prop, answer, tolerance)


def as_answer(
    prop: Property, states: np.ndarray, solution: Solution, tolerance: float, method: str
) -> Answer:
    """The answer of a solution at the requested states, without a strategy."""
    result = _Result(replace(solution, method=method), None)
    holds = None if prop.relation is None else _verdicts(prop, result)
    return _answer(prop, states, result, holds, tolerance)


def _answer(
    prop: Property,
    states: np.ndarray,
    result: _Result,
    holds: list[bool | None] | None,
    tolerance: float,
) -> Answer:
    value, lower, upper = (
        np.asarray(x, np.float64)
        for x in (result.solution.value, result.solution.lower, result.solution.upper)
    )
    if holds is None:
        status = _status(prop, result, tolerance)
    else:
        status = Status.PRECISION if None in holds else Status.CONVERGED
    method = result.solution.method
    return Answer(states, value, lower, upper, holds, status, method, result.strategy)


def _status(prop: Property, result: _Result, tolerance: float) -> Status:
    """CONVERGED if the bounds at the requested states are within the tolerance."""
    lower, upper = result.solution.lower, result.solution.upper
    status = Status(int(np.max(result.solution.status)))
    if np.isnan(lower).any() or np.isnan(upper).any() or status == Status.INVALID:
        return max(status, Status.NONFINITE)
    with np.errstate(invalid="ignore"):
        width = np.where(lower == upper, 0, upper - lower)
        limit: Array = float(tolerance)
        relative = isinstance(tolerance, RelativeTolerance)
        if prop.operator in ("R", "T") or relative:
            if relative:
                limit = limit * np.minimum(np.abs(lower), np.abs(upper))
            else:
                limit = np.maximum(limit * np.maximum(np.abs(lower), np.abs(upper)), TINY)
        narrow = (width == 0) | ((width <= limit) & np.isfinite(width))
    # An average near zero is narrow as a share of the rewards that cancel out in it.
    proven_narrow = prop.path == Earned("average") and status == Status.CONVERGED
    if narrow.all() or proven_narrow:
        return Status.CONVERGED
    return max(status, Status.PRECISION)


def _is_exact(result: _Result) -> bool:
    return bool((result.solution.lower == result.solution.upper).all())


def _is_tiny(model: CheckableModel) -> bool:
    """True if few choices leave their state."""
    return int(np.count_nonzero(~graph_of_model(model).host.is_self_loop)) <= _FEW


def _with_values(result: _Result, exact: list[Fraction | float] | None) -> _Result:
    """The result with bounds by rational arithmetic; unchanged for None."""
    if exact is None:
        return result
    lower, upper = np.array([double_bounds(x) for x in exact]).T
    zero: Array = np.float64(0)
    converged: Array = np.int32(Status.CONVERGED)
    solution = replace(
        result.solution,
        value=lower,
        lower=lower,
        upper=upper,
        residual=zero,
        status=converged,
        method=_RATIONAL,
    )
    return result._replace(solution=solution)


def _is_close(model: CheckableModel, prop: Property, result: _Result) -> bool:
    """True if the doubles of a model and the numbers of its source may differ in the verdict."""
    inner = model.mdp if isinstance(model, Game) else model
    if not isinstance(inner, SparseMDP) or inner.numbers.read is None:
        return False
    assert prop.threshold is not None
    threshold = float(prop.threshold)
    margin = _MARGIN * max(abs(threshold), _MARGIN)
    ends = np.asarray(result.solution.lower), np.asarray(result.solution.upper)
    return bool(any((np.abs(x - threshold) <= margin).any() for x in ends))


def _verdicts(prop: Property, result: _Result) -> list[bool | None]:
    assert prop.relation is not None and prop.threshold is not None
    lower, upper = np.asarray(result.solution.lower), np.asarray(result.solution.upper)
    return [
        meets(prop.relation, prop.threshold, low, high)
        for low, high in zip(lower.tolist(), upper.tolist(), strict=True)
    ]


def meets(
    relation: str, threshold: Fraction, lower: float | Fraction, upper: float | Fraction
) -> bool | None:
    """Truth of a threshold for all numbers between two bounds; None if it differs."""
    if lower != lower or upper != upper:
        return None
    if relation in ("<", "<="):
        opposite = meets({"<": ">=", "<=": ">"}[relation], threshold, lower, upper)
        return None if opposite is None else not opposite
    # Floats and fractions are compared exactly.
    if relation == ">=":
        return True if lower >= threshold else False if upper < threshold else None
    return True if lower > threshold else False if upper <= threshold else None


# --- which solver -----------------------------------------------------------------------------


def _solved(query: _ModelQuery, prop: Property, aim: PropertyAim, tolerance: float) -> _Result:
    """The solution of a property at some states."""
    model, path = query.model, prop.path
    if prop.operator == "P":
        assert not isinstance(path, Earned)
        return query.probability(path, aim, tolerance)
    if prop.operator == "LRA" or path == Earned("average"):
        reward: Reward = prop.reward
        if prop.operator == "LRA":
            assert isinstance(path, Formula)
            reward = query.where(path).astype(np.float64)
        elif prop.operator == "T":
            reward = np.ones(graph_of_model(model).num_rows)
        average = average_reward(model, reward, tolerance=tolerance, **aim.directions)
        return query.result(replace(average, method=_AVERAGE))
    reward = np.ones(graph_of_model(model).num_rows) if prop.operator == "T" else prop.reward
    target = None
    if isinstance(path, Formula):
        target = query.where(path.operands[0])
    elif isinstance(path, Earned) and path.steps is not None:
        cumulative = path.kind == "cumulative"
        solve = bounded.cumulative_reward if cumulative else bounded.instantaneous_reward
        return query.result(solve(model, reward, path.steps, **aim.directions), by="steps")
    elif not isinstance(model, SparseMDP):
        raise ValueError(
            f"{prop.text}: rewards for ever (C) are not solved for where probabilities are intervals or two "
            "players choose; ask for those until a state is reached (F), of so many steps (C<=k) or "
            "after them (I=k), or for the average (S)."
        )
    return query.result(total_reward(model, reward, target, tolerance=tolerance, **aim.directions))


class _ModelQuery(NamedTuple):
    """A model and the states at which a property is asked for."""

    model: CheckableModel
    states: np.ndarray
    text: str

    def where(self, condition: Formula) -> np.ndarray:
        return states_satisfying(graph_of_model(self.model), condition, self.text)

    def result(self, solution: Solution, by: str = "") -> _Result:
        """A solution at all states, at those that are asked for."""
        nature = None if solution.nature is None else np.asarray(solution.nature)
        graph = graph_of_model(self.model)
        rows: Array = np.arange(graph.num_states)
        if not graph.is_chain:
            rows = rows_of_policy(graph, solution.policy)
        strategy = PropertyStrategy(rows, by, nature=nature)
        return _Result(at_states(solution, self.states), strategy)

    def probability(
        self, path: Formula | Bounded | Conditional, aim: PropertyAim, tolerance: float
    ) -> _Result:
        """The probability of a path formula; simple ones need no automaton."""
        if isinstance(path, Bounded):
            return self.within(path, aim, tolerance)
        if isinstance(path, Conditional):
            return self.conditional(path, aim, tolerance)
        if is_boolean(path):
            return self.state_formula(path)
        if path.operator == "!":
            return self.negation(path.operands[0], aim, tolerance)
        if not all(is_boolean(f) for f in path.operands):
            return self.automaton(path, aim, tolerance)
        first, right = path.operands[0], path.operands[-1]
        match path.operator:
            case "X":
                target = self.where(right)
                solution = bounded.next_probability(self.model, target, **aim.directions)
                return self.result(solution, by="one step")
            case "F":
                return self.until(TRUE, right, aim, tolerance)
            case "U":
                return self.until(first, right, aim, tolerance)
            case "G":
                return self.until(TRUE, ~right, aim, tolerance, complement=True)
            case "W":
                return self.until(~right, ~first & ~right, aim, tolerance, complement=True)
            case "R":
                return self.until(~first, ~right, aim, tolerance, complement=True)
        raise AssertionError(path.operator)

    def conditional(self, path: Conditional, aim: PropertyAim, tolerance: float) -> _Result:
        """``P(A and B) / P(B)`` of a chain, with both probabilities relatively exact."""
        if not isinstance(self.model, SparseMDP) or not self.model.is_chain:
            raise ValueError(
                f"{self.text}: conditional probabilities, ||, are solved for in Markov chains; here the "
                "condition may depend on a strategy. For at least one of two paths write (PATH) | (PATH)."
            )
        width = RelativeTolerance(float(tolerance) / 4)
        both = self.probability(path.event & path.condition, aim, width).solution
        alone = self.probability(path.condition, aim, width).solution
        low, high = np.asarray(alone.lower), np.asarray(alone.upper)
        for state in self.states[high == 0][:1].tolist():
            raise ValueError(
                f"{self.text}: the condition {path.condition} has probability 0 in state {state}, so that "
                "no probability under it is defined; ask for other states."
            )
        lower = np.nextafter(np.asarray(both.lower) / high, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            upper = np.where(low > 0, np.nextafter(np.asarray(both.upper) / low, 2), 1)
        upper = np.minimum(upper, 1)
        value = np.clip(np.asarray(both.value) / np.maximum(alone.value, high / 2), lower, upper)
        parts: dict[str, Array] = {"value": value, "lower": lower, "upper": upper}
        parts["status"] = np.maximum(both.status, alone.status)
        method = f"quotient of two probabilities, {alone.method}"
        return _Result(replace(both, **parts, method=method), None)

    def state_formula(self, path: Formula) -> _Result:
        holds: Array = self.where(path).astype(np.float64)[self.states]
        zero: Array = np.int32(0)
        no_policy: Array = np.zeros(0, np.int32)
        return _Result(
            Solution(holds, no_policy, holds, holds, zero, zero, zero, method="the label"), None
        )

    def negation(self, path: Formula, aim: PropertyAim, tolerance: float) -> _Result:
        """The probability that a formula with temporal operators is false."""
        first, right = path.operands[0], path.operands[-1]
        if path.operator == "!":
            return self.probability(first, aim, tolerance)
        if not all(is_boolean(f) for f in path.operands):
            return self.automaton(~path, aim, tolerance)
        match path.operator:
            case "X":
                return self.probability(Formula("X", (~right,)), aim, tolerance)
            case "F":
                return self.until(TRUE, right, aim, tolerance, complement=True)
            case "U":
                return self.until(first, right, aim, tolerance, complement=True)
            case "G":
                return self.until(TRUE, ~right, aim, tolerance)
            case "W":
                return self.until(~right, ~first & ~right, aim, tolerance)
            case "R":
                return self.until(~first, ~right, aim, tolerance)
        raise AssertionError(path.operator)

    def until(
        self,
        first: Formula,
        right: Formula,
        aim: PropertyAim,
        tolerance: float,
        *,
        complement: bool = False,
    ) -> _Result:
        """The probability of until, or of its complement."""
        relative = isinstance(tolerance, RelativeTolerance)
        if complement and not relative:
            return _opposite(self.until(first, right, aim.opposite, tolerance))
        target: Array = self.where(right)
        stay: Array = None if first == TRUE else self.where(first)
        # One minus a probability near one has no relative accuracy.
        if complement and isinstance(self.model, SparseMDP):
            solution = avoidance_probability(
                self.model, target, stay=stay, objective=aim.policy, tolerance=tolerance
            )
        else:
            solution = reachability_probability(
                self.model, target, stay=stay, tolerance=tolerance, **aim.directions
            )
        result = self.result(solution)
        if complement or not isinstance(self.model, SparseMDP) or self.model.is_chain:
            return result
        if self.model.num_states > QUICK_LIMIT:
            return result
        assert result.strategy is not None
        host, chosen = self.model.host, result.strategy.row
        row = Deferred(lambda: certified_fastest_rows(host, target, stay, aim.policy, chosen))
        return result._replace(strategy=PropertyStrategy(row))  # type: ignore[arg-type]

    def automaton(self, path: Formula, aim: PropertyAim, tolerance: float) -> _Result:
        result = optimal_satisfaction(
            self.model, path, states=self.states, tolerance=tolerance, **aim.directions
        )
        policy = result.product_policy
        assert policy is not None
        size = f"product of {policy.product.host.num_states} states"
        method = ", ".join(filter(None, (size, result.method)))
        # The row may be deferred.
        strategy = PropertyStrategy(policy[3], memory=policy, nature=result.nature)
        return _Result(replace(result, method=method), strategy)

    def within(self, path: Bounded, aim: PropertyAim, tolerance: float) -> _Result:
        complement, asked = path.operator == "R", aim
        if complement:
            negated = TRUE if path.left.operator == "false" else ~path.left
            path, aim = replace(path, operator="U", left=negated, right=~path.right), aim.opposite
        target, stay = self.where(path.right), self.where(path.left)
        if path.reward is not None:
            limit = reward_limit(path)
            solution = bounded.reward_bounded_reachability(
                self.model, target, path.reward or None, limit, stay=stay, **aim.directions
            )
            result = self.result(solution, by="reward")
            return _opposite(result) if complement else result
        if path.lower or path.upper is None:
            if max(path.lower, path.upper or 0) > MAX_UNFOLDED_STEPS:
                raise ValueError(
                    f"{self.text}: a lower bound on steps is solved for up to "
                    f"{MAX_UNFOLDED_STEPS} steps; drop it or make it smaller."
                )
            return self.probability(
                ~unfolded(path) if complement else unfolded(path), asked, tolerance
            )
        if complement and isinstance(tolerance, RelativeTolerance):
            avoided = bounded_avoidance(
                self.model, target, path.upper, stay=stay, **asked.directions
            )
            if avoided is not None:
                return self.result(avoided, by="steps")
        solution = bounded.bounded_reachability(
            self.model, target, path.upper, stay=stay, **aim.directions
        )
        result = self.result(solution, by="steps")
        return _opposite(result) if complement else result


def _opposite(result: _Result) -> _Result:
    """The result of the complementary event."""
    return result._replace(solution=complement_event(result.solution))
