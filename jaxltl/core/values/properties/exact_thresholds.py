"""Values of properties of small models in rational arithmetic, which decide every threshold."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from functools import partial
from typing import cast

import numpy as np

from jaxltl.core.automata.automaton import Automaton, complement
from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.logic.bounded import Bounded, Conditional, Earned, Recognized, unfolded
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import FALSE, TRUE, Formula
from jaxltl.core.logic.properties import Property
from jaxltl.core.array_types import Booleans
from jaxltl.core.models.construct.property_models import model_of_product
from jaxltl.core.models.construct.restrict import with_allowed
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.exact_numbers import exact_numbers, exact_reward, exact_state_reward
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.number_source import NumberSource, RationalNumbers
from jaxltl.core.models.product_policy import ProductPolicy
from jaxltl.core.models.sparse import SparseMDP, default_reward, reward_structure
from jaxltl.core.sparse.exact import bounded
from jaxltl.core.sparse.exact.average import average
from jaxltl.core.sparse.exact.games import game_if_reached
from jaxltl.core.sparse.exact.model import (
    MAX_WORK,
    ONE,
    ZERO,
    ExactMDP,
    TooLarge,
    Values,
    Work,
    flags,
)
from jaxltl.core.sparse.exact.total import least_total, reachability, until_end
from jaxltl.core.sparse.bounded.reward_bounded import in_units
from jaxltl.core.sparse.solvers.reward_if_reached import level_ends
from jaxltl.core.sparse.product import SparseProduct
from jaxltl.core.values.engine.state_quantities import transition_reward
from jaxltl.core.values.properties.aims import graph_of_model
from jaxltl.core.values.properties.discounting import without_discount
from jaxltl.core.values.undiscounted.sparse_satisfaction import (
    reachability_problem,
    sparse_satisfaction,
)

MAX_TRANSITIONS = 10_000  # and states, of which each counts for ten
_LEVELS = 16  # of collected reward that are told apart
_WIDTH = 0.01  # of the bounds of the product, of which only the graph is used


def exact_values(
    model: SparseMDP | IntervalMDP | Game,
    prop: Property,
    states: np.ndarray,
    maximize: bool | Booleans,
    rows: np.ndarray | ProductPolicy | None = None,
    effort: int = 1,
) -> list[Fraction | float] | None:
    """Values at some states, fractions or infinite; None if it is large or has intervals.

    Args:
      maximize: the direction; in a game ``bool[S]``, True in the states of the maximiser.
      rows: of a game, optimal strategies of both players: rows ``int[S]``, or those of a product.
      effort: the multiple of the limits on states, transitions and work.
    """
    if prop.discount is not None:
        model, prop = without_discount(model, prop)
        maximize = np.append(maximize, True) if np.ndim(maximize) else maximize
        if isinstance(rows, np.ndarray):
            rows = np.append(rows, graph_of_model(model).num_rows - 1)
    inner = model.mdp if isinstance(model, Game) else model
    if not isinstance(inner, SparseMDP):
        return None
    if max(inner.num_states * 10, inner.num_transitions) > MAX_TRANSITIONS * effort:
        return None
    if isinstance(rows, ProductPolicy):
        product = rows.product
        if max(product.still.size * 10, product.host.num_transitions) > MAX_TRANSITIONS * effort:
            return None
        place = np.where(product.still, 0, rows.row - inner.host.row_start[product.base_state])
        rows = product.host.row_start[:-1] + place
        inner, states = model_of_product(inner, product), product.start
        maximize = np.broadcast_to(maximize, graph_of_model(model).num_states)[product.base_state]
    levels = prop.unreached == "zero"
    if isinstance(model, Game) and not levels and not _is_of_few_steps(prop):
        return _between_answers(inner, prop, states, maximize, rows, effort)
    try:
        # Backward induction takes the directions of all states.
        values = _values(_ExactQuery(inner, states, prop.text, effort), prop, cast(bool, maximize))
    except (TooLarge, OverflowError):  # a reward may be infinite
        return None
    return list(values)


def _is_of_few_steps(prop: Property) -> bool:
    """True if backward induction over some steps gives the values."""
    path = prop.path
    if isinstance(path, Bounded):
        return path.reward is None and not path.lower and path.upper is not None
    if isinstance(path, Formula):
        return prop.operator == "P" and path.operator == "X" and is_boolean(path.operands[0])
    return isinstance(path, Earned) and path.steps is not None


def _if_reached(query: _ExactQuery, prop: Property, maximize: bool | Booleans) -> Values:
    """Rewards that count if a target is reached; TooLarge if levels of reward do not decide them."""
    model, path = query.model, prop.path
    assert isinstance(path, Formula)
    cost = np.ones(model.num_transitions)
    if prop.operator == "R":
        cost = transition_reward(model, reward_structure(model, prop.reward))
    largest = float(cost.max(initial=0))
    units, most = in_units(cost, largest)
    target = query.where(path.operands[0])
    up = np.broadcast_to(np.asarray(maximize), model.num_states)
    ends = level_ends(model.host, units, target, up, max(_LEVELS, 2 * most))
    if ends is None or not most:
        raise TooLarge
    low, high = game_if_reached(query.mdp, units, target, ends, up, query.work)
    if query.at(low) != query.at(high):
        raise TooLarge
    unit = Fraction(largest).limit_denominator(10**9) / most
    return [x * unit if isinstance(x, Fraction) else x for x in query.at(low)]


def _between_answers(
    model: SparseMDP,
    prop: Property,
    states: np.ndarray,
    maximize: bool | Booleans,
    rows: np.ndarray | None,
    effort: int,
) -> list[Fraction | float] | None:
    """Values of a game between the optimal answers to memoryless strategies of the players.

    The minimiser's optimal answer to a strategy bounds the value from below and the maximiser's from
    above; None unless they agree.
    """
    if rows is None or rows.size != model.num_states:
        return None
    numbers, bounds = exact_numbers(model), []
    for up in (False, True):
        kept = np.broadcast_to(np.equal(maximize, up), model.num_states)[model.host.state]
        kept[rows] = True
        source = NumberSource(partial(_constant, numbers.select(kept)))
        part = replace(with_allowed(model, kept), numbers=source)
        bounds.append(exact_values(part, prop, states, up, effort=effort))
    return bounds[0] if bounds[0] == bounds[1] else None


def _constant(numbers: RationalNumbers, model: SparseMDP) -> RationalNumbers:
    return numbers


def _values(query: _ExactQuery, prop: Property, maximize: bool) -> Values:
    mdp, work, path = query.mdp, query.work, prop.path
    if prop.operator == "P":
        assert not isinstance(path, Earned)
        return query.probability(path, maximize)
    if isinstance(path, Earned) and path.kind == "instantaneous":
        assert path.steps is not None
        structure = reward_structure(query.model, prop.reward)
        final = exact_state_reward(query.numbers, structure, query.reward_name(prop.reward))
        free = [ZERO] * len(mdp.rows)
        return query.at(bounded.earned_within(mdp, free, final, path.steps, maximize, work))
    if prop.unreached == "zero":
        return _if_reached(query, prop, maximize)
    reward = query.reward(prop)
    if prop.operator == "LRA" or path == Earned("average"):
        return query.at(average(mdp, reward, maximize, work))
    if isinstance(path, Formula):
        final_states = dict.fromkeys(flags(query.where(path.operands[0])), ZERO)
        if prop.unreached == "sum":
            return query.at(least_total(mdp, reward, final_states, maximize, work))
        return query.at(until_end(mdp, reward, final_states, maximize, work))
    assert isinstance(path, Earned)
    if path.steps is not None:
        zero = [ZERO] * mdp.num_states
        return query.at(bounded.earned_within(mdp, reward, zero, path.steps, maximize, work))
    return query.at(least_total(mdp, reward, {}, maximize, work))


class _ExactQuery:
    """Values of path formulas at the requested states."""

    def __init__(self, model: SparseMDP, states: np.ndarray, text: str, effort: int = 1) -> None:
        self.model, self.states, self.text = model, states, text
        self.numbers, self.work = exact_numbers(model), Work(MAX_WORK * effort)
        self.effort = effort

    @property
    def mdp(self) -> ExactMDP:
        return self.numbers.mdp

    def at(self, values: Values) -> Values:
        """The values at the requested states."""
        return [values[s] for s in self.states.tolist()]

    def where(self, condition: Formula) -> np.ndarray:
        return states_satisfying(self.model, condition, self.text)

    def reward_name(self, name: str | None) -> str | None:
        return default_reward(self.model.rewards) if name is None else name

    def reward(self, prop: Property) -> list[Fraction]:
        """The expected reward of each choice."""
        if prop.operator == "T":
            return [ONE] * self.model.num_rows
        if prop.operator == "LRA":
            assert isinstance(prop.path, Formula)
            holds = self.where(prop.path)[self.model.host.state]
            return [Fraction(int(x)) for x in holds]
        structure = reward_structure(self.model, prop.reward)
        return exact_reward(self.model, self.numbers, structure, self.reward_name(prop.reward))

    def probability(
        self, path: Formula | Bounded | Conditional | Recognized, maximize: bool
    ) -> Values:
        """The probability of a path formula."""
        if isinstance(path, Recognized):
            return self.automaton(acceptor(path), maximize)
        if isinstance(path, Conditional):
            both = self.probability(path.event & path.condition, maximize)
            alone = self.probability(path.condition, maximize)
            return [x / y for x, y in zip(both, alone, strict=True)]
        if isinstance(path, Bounded):
            return self.within(path, maximize)
        if is_boolean(path):
            return self.at([Fraction(int(x)) for x in self.where(path)])
        if path.operator == "!":
            return self.complement(path.operands[0], maximize)
        if not all(is_boolean(f) for f in path.operands):
            return self.automaton(path, maximize)
        first, right = path.operands[0], path.operands[-1]
        match path.operator:
            case "X":
                final = [Fraction(int(x)) for x in self.where(right)]
                free = [ZERO] * len(self.mdp.rows)
                return self.at(self.mdp.backup(free, final, maximize, self.work))
            case "F" | "U":
                stay = None if path.operator == "F" else self.where(first)
                target = self.where(right)
                return self.at(reachability(self.mdp, target, stay, maximize, self.work))
            case "G":
                return self.complement(Formula("F", (~right,)), maximize)
            case "W":
                return self.complement(Formula("U", (~right, ~first & ~right)), maximize)
            case "R":
                return self.complement(Formula("U", (~first, ~right)), maximize)
        raise AssertionError(path.operator)

    def complement(self, path: Formula | Bounded, maximize: bool) -> Values:
        """One minus the probability of the complementary event."""
        opposite = cast(bool, np.logical_not(maximize))
        return [1 - x for x in self.probability(path, opposite)]

    def within(self, path: Bounded, maximize: bool) -> Values:
        """The probability of a bounded formula."""
        if path.operator == "R":
            negated = TRUE if path.left == FALSE else ~path.left
            until = replace(path, operator="U", left=negated, right=~path.right)
            return self.complement(until, maximize)
        if path.reward is not None:
            return self.at(self.cost(path, maximize))
        if path.lower or path.upper is None:
            return self.probability(unfolded(path), maximize)
        target, stay = self.where(path.right), self.where(path.left)
        steps = bounded.until_within(self.mdp, target, stay, path.upper, maximize, self.work)
        return self.at(steps)

    def cost(self, path: Bounded, maximize: bool) -> Values:
        """The probability of reaching a target before too much reward is earned."""
        host, target, stay = self.model.host, self.where(path.right), self.where(path.left)
        costs = transition_reward(self.model, reward_structure(self.model, path.reward or None))
        counted = np.where((stay & ~target)[host.state[host.row]], costs, 0)
        units, limit = in_units(counted, reward_limit(path))
        rows: list[dict[int, int]] = [{} for _ in self.mdp.rows]
        for r, t, c in zip(host.row.tolist(), host.successor.tolist(), units.tolist(), strict=True):
            rows[r][t] = c
        return bounded.until_at_cost(self.mdp, target, stay, (rows, limit), maximize, self.work)

    def automaton(self, path: FormulaLike, maximize: bool) -> Values:
        """The probability of an LTL formula, on the product with an automaton."""
        objective = "max" if maximize else "min"
        result = sparse_satisfaction(
            self.model, path, states=self.states, objective=objective, tolerance=_WIDTH
        )
        policy = result.product_policy
        assert policy is not None
        if policy.product.host.num_transitions > MAX_TRANSITIONS * self.effort:
            raise TooLarge
        problem = reachability_problem(policy, objective)
        mdp = _product(policy.product, self.mdp)
        value = reachability(mdp, problem.goal, None, problem.maximize, self.work)
        at_start = [value[s] for s in policy.product.start.tolist()]
        return [1 - x for x in at_start] if problem.complement else at_start


def acceptor(path: Recognized) -> Automaton:
    """The automaton that accepts the paths of a property."""
    automaton: Automaton = path.automaton
    return complement(automaton) if path.negated else automaton


def reward_limit(path: Bounded) -> float:
    """The largest reward that a bound allows; rewards are counted in units of more than 1e-9."""
    assert path.limit is not None
    return float(path.limit - Fraction(1, 10**9) * path.strict)


def _product(product: SparseProduct, mdp: ExactMDP) -> ExactMDP:
    """The product with the rational probabilities of the model."""
    host, state = product.host, product.base_state.tolist()
    rows: list[dict[int, Fraction]] = []
    entry, successor = host.entry_start.tolist(), host.successor.tolist()
    still = product.still.tolist()
    for r, (base, s) in enumerate(zip(product.base_row.tolist(), host.state.tolist(), strict=True)):
        after = successor[entry[r] : entry[r + 1]]
        rows.append({s: ONE} if still[s] else {t: mdp.rows[base][state[t]] for t in after})
    return ExactMDP(host.row_start.tolist(), rows)
