"""Probabilities of path formulas at the requested states of a model."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.deferred import Deferred
from jaxltl.core.logic.bounded import Bounded, Conditional, Recognized, unfolded
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import TRUE, Formula
from jaxltl.core.logic.property import MAX_UNFOLDED_STEPS
from jaxltl.core.models.action_numbers import rows_of_policy
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.sparse.solvers.shortest_path_problem import RelativeTolerance
from jaxltl.core.types import Solution
from jaxltl.core.values.engine.host_solution import complement_event
from jaxltl.core.values.properties.aims import CheckableModel, PropertyAim, graph_of_model
from jaxltl.core.values.properties.answers import PropertyStrategy
from jaxltl.core.values.properties.exact_thresholds import acceptor, reward_limit
from jaxltl.core.values.undiscounted import step_bounded as bounded
from jaxltl.core.values.undiscounted.fastest import QUICK_LIMIT, certified_fastest_rows
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.reaching import avoidance_probability
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from jaxltl.core.values.undiscounted.sparse_satisfaction import at_states
from jaxltl.core.values.undiscounted.step_engine import bounded_avoidance


class QueryResult(NamedTuple):
    """The solution at the requested states."""

    solution: Solution
    strategy: PropertyStrategy | None


class ModelQuery(NamedTuple):
    """A model and the states at which a property is asked for."""

    model: CheckableModel
    states: np.ndarray
    text: str

    def where(self, condition: Formula) -> np.ndarray:
        return states_satisfying(graph_of_model(self.model), condition, self.text)

    def result(self, solution: Solution, by: str = "") -> QueryResult:
        """A solution at all states, at those that are asked for."""
        nature = None if solution.nature is None else np.asarray(solution.nature)
        graph = graph_of_model(self.model)
        rows: Array = np.arange(graph.num_states)
        if not graph.is_chain:
            rows = rows_of_policy(graph, solution.policy)
        strategy = PropertyStrategy(rows, by, nature=nature)
        return QueryResult(at_states(solution, self.states), strategy)

    def probability(
        self, path: Formula | Bounded | Conditional | Recognized, aim: PropertyAim, tolerance: float
    ) -> QueryResult:
        """The probability of a path formula; simple ones need no automaton."""
        if isinstance(path, Recognized):
            return self.automaton(acceptor(path), aim, tolerance)
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

    def conditional(self, path: Conditional, aim: PropertyAim, tolerance: float) -> QueryResult:
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
        return QueryResult(replace(both, **parts, method=method), None)

    def state_formula(self, path: Formula) -> QueryResult:
        holds: Array = self.where(path).astype(np.float64)[self.states]
        zero: Array = np.int32(0)
        no_policy: Array = np.zeros(0, np.int32)
        return QueryResult(
            Solution(holds, no_policy, holds, holds, zero, zero, zero, method="the label"), None
        )

    def negation(self, path: Formula, aim: PropertyAim, tolerance: float) -> QueryResult:
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
    ) -> QueryResult:
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

    def automaton(self, path: FormulaLike, aim: PropertyAim, tolerance: float) -> QueryResult:
        result = optimal_satisfaction(
            self.model, path, states=self.states, tolerance=tolerance, **aim.directions
        )
        policy = result.product_policy
        assert policy is not None
        size = f"product of {policy.product.host.num_states} states"
        method = ", ".join(filter(None, (size, result.method)))
        # The row may be deferred.
        strategy = PropertyStrategy(policy[3], memory=policy, nature=result.nature)
        return QueryResult(replace(result, method=method), strategy)

    def within(self, path: Bounded, aim: PropertyAim, tolerance: float) -> QueryResult:
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


def _opposite(result: QueryResult) -> QueryResult:
    """The result of the complementary event."""
    return result._replace(solution=complement_event(result.solution))
