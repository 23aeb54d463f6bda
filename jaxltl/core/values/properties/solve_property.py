"""Model checking: dispatches a property to its solver."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from fractions import Fraction
from collections.abc import Callable
from functools import partial
from typing import Literal, cast

import numpy as np
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.array_types import Integers
from jaxltl.core.logic.bounded import Earned
from jaxltl.core.logic.comparisons import Definitions
from jaxltl.core.logic.good_prefixes import is_plain_reachability
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.logic.properties import Property, parse_property
from jaxltl.core.models.construct.property_models import (
    END,
    prefix_product,
    transition_graph,
)
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.multiplayer import MultiplayerGame
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.product_policy import ProductPolicy
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Reward, SparseMDP, reward_structure
from jaxltl.core.sparse.exact.model import double_bounds
from jaxltl.core.sparse.solvers.shortest_path_problem import RelativeTolerance
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.average.average_reward import average_reward
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
from jaxltl.core.values.properties.discounting import rounding_of_discount, without_discount
from jaxltl.core.values.properties.expressions import expression_bounds
from jaxltl.core.values.properties.fairness import over_fair_strategies
from jaxltl.core.values.properties.model_query import ModelQuery, QueryResult
from jaxltl.core.values.properties.partially_observable import solve_partially_observable
from jaxltl.core.values.properties.several_objectives import solve_multi_objective
from jaxltl.core.values.properties.exact_thresholds import exact_values
from jaxltl.core.values.undiscounted import step_bounded as bounded
from jaxltl.core.values.undiscounted.sparse_satisfaction import starting_states
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
_EFFORT = 100  # of exact=True, half a minute
_EXPRESSION = "arithmetic on bounds"
_AT_END = Formula("F", (Formula("ap", proposition=END),))
TINY = 1e-12  # absolute width of bounds on rewards that is always accepted
_AVERAGE = "averages of end components"


@validated(games=True, host=True)
def solve_property(
    model: Model | MultiplayerGame | POMDP,
    prop: Property | str,
    *,
    states: ArrayLike | None = None,
    tolerance: float = TOLERANCE,
    relative: bool = False,
    exact: bool = False,
    fair: bool = False,
) -> Answer | Achievable | ConstrainedOptimum | Pareto:
    """Model checking: the value of a property, or its truth, with certified bounds.

    Args:
      model: any concrete model. An interval model needs the directions of the policy and of nature, as
        in ``Pmaxmin=?``; an interval chain that of nature; a game a coalition of its players, system
        and environment, as in ``<<system>> Pmax=?``. In a multi-player game a coalition has names or
        numbers of players, ``<<p1, 3>>``, or all, ``<<*>>``; without one all players are one. States
        of a product are numbered ``s * Q + q``. A POMDP is solved from its initial belief, to a width of
        at least 1e-3.
      prop: a property or its text, see :func:`~jaxltl.core.logic.properties.parse_properties`.
      states: ``int[I]``; default the initial states. Not with ``multi(...)``.
      tolerance: width of the bounds, absolute for probabilities and relative otherwise.
      relative: True for a width relative to the value for probabilities too. Not for those of
        interval models, ``multi(...)`` and long-run averages.
      exact: True for values in rational arithmetic, by policy iteration in fractions, of chains and MDPs of
        moderate size; probabilities and rewards of a program are those of its text, so that 0.1 is a tenth.
      fair: True for probabilities of MDPs over fair strategies alone, which take each choice of a state
        infinitely often if they visit it infinitely often, in the product with the formula's automaton;
        rewards and quantifiers have no such option.

    Returns:
      :class:`Answer`. If narrower bounds do not decide a threshold either, `holds` is None and the
      status is not CONVERGED. For ``multi(...)``, the result of
      :func:`~jaxltl.core.values.multi_objective.multi_objective.achievable`, ``constrained_optimum`` or
      ``pareto``, if no, one or all objectives have no threshold. Concrete arrays only; not differentiable.

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
    if isinstance(model, POMDP):
        if states is not None or relative or exact or fair:
            raise ValueError(
                "states, relative, exact and fair are not for a POMDP, which is solved from its initial belief."
            )
        return solve_partially_observable(model, prop, tolerance)
    source = checkable(model)
    if isinstance(prop, str):
        prop = parse_property(prop, Definitions(variables=tuple(graph_of_model(source).valuation)))
    if not isinstance(prop, Property):
        raise ValueError(f"prop is {validation.shorten(prop)}; give a property or its text.")

    def again(
        world: SourceModel,
        part: Property,
        states: ArrayLike | None = None,
        exact: bool = exact,
        tolerance: float = tolerance,
    ) -> Answer:
        options = {"relative": relative, "exact": exact, "fair": fair}
        answer = solve_property(world, part, states=states, tolerance=tolerance, **options)
        return cast(Answer, answer)

    if prop.definitions:
        source = with_definitions(
            source,
            prop,
            lambda world, part: again(
                world,
                part,
                states=None if part.aggregate else range(graph_of_model(world).num_states),
            ),
        )
    width = RelativeTolerance if relative else float
    if prop.aggregate is not None:
        return _filter(source, prop, states, width(tolerance), again)
    graph = graph_of_model(source)
    places, states = states, starting_states(graph, states)
    if prop.operator == "value":
        answer = _value(source, prop, states, tolerance, again)
        if answer.status == Status.CONVERGED:
            return answer
        with contextlib.suppress(ValueError):  # a model that is too large
            return _value(source, prop, states, tolerance, partial(again, exact=True))
        return answer
    if fair and prop.operator in ("E", "A", "multi") and not graph.is_chain:
        raise ValueError(f"{prop.text}: fair=True is for P; leave it out.")
    if prop.operator in ("E", "A"):
        objective: Literal["max", "min"] = "max" if prop.operator == "E" else "min"
        simple = replace(prop, operator="P", objective=objective, definitions=())
        return again(transition_graph(graph), simple, states=states)._replace(strategy=None)
    chosen, prop = of_coalition(source, prop)
    is_absolute = prop.operator in ("multi", "LRA") or prop.path == Earned("average")
    intervals = isinstance(chosen, IntervalMDP | Game) and prop.operator == "P"
    if relative and (is_absolute or intervals):
        raise ValueError(
            f"{prop.text}: relative=True is for probabilities of path formulas, without intervals or a "
            "second player, and for total rewards."
        )
    if prop.operator == "multi":
        return _several(chosen, prop, places is None, tolerance)
    if fair and not graph.is_chain:
        product, start, prop = over_fair_strategies(chosen, prop, states)
        answer = _of_model(product, prop, start, width(requested_width(tolerance)), exact)
        return answer._replace(states=states, strategy=None)
    path = prop.path if prop.operator in ("R", "T") else None
    if isinstance(path, Formula) and not is_plain_reachability(path):
        larger, start = prefix_product(chosen, path, states, prop.text)
        simple = replace(prop, path=_AT_END, definitions=())
        return again(larger, simple, states=start)._replace(states=states, strategy=None)
    return _of_model(chosen, prop, states, width(requested_width(tolerance)), exact)


def _of_model(
    model: CheckableModel, prop: Property, states: np.ndarray, tolerance: float, exact: bool
) -> Answer:
    """The number of one operator, or the truth of its threshold."""
    width = RelativeTolerance if isinstance(tolerance, RelativeTolerance) else float
    aim = aim_of(model, prop)
    solve = partial(_solved, ModelQuery(model, states, prop.text), prop, aim)
    result = solve(tolerance)

    def in_fractions(effort: int = 1) -> list[Fraction | float] | None:
        rows: Integers | ProductPolicy | None = None
        if isinstance(model, Game) and result.strategy is not None:
            rows = result.strategy.memory or result.strategy.row
        return exact_values(model, prop, states, maximizers(model, aim), rows, effort)

    if exact:
        values = in_fractions(_EFFORT)
        if values is None:
            raise ValueError(
                f"{prop.text}: exact=True is for models of moderate size without intervals; this one "
                f"has {model.num_states} states. Leave it out."
            )
        result, verdicts = _with_values(result, values), None
        if prop.relation is not None and prop.threshold is not None:
            verdicts = [meets(prop.relation, prop.threshold, x, x) for x in values]
        return _answer(prop, states, result, verdicts, tolerance)._replace(exact=tuple(values))
    if prop.relation is None:
        if tolerance <= _EXACT and not _is_exact(result) and _is_tiny(model):
            result = _with_values(result, in_fractions())
        return _answer(prop, states, result, None, tolerance)
    verdicts = _verdicts(prop, result)
    for share in TOLERANCE_SHARES[1:]:
        if None not in verdicts or _is_exact(result):
            break
        result = solve(width(float(tolerance) * share))
        verdicts = _verdicts(prop, result)
    if None in verdicts or _is_close(model, prop, result):
        values = in_fractions()
        if values is not None:
            assert prop.threshold is not None
            verdicts = [meets(prop.relation, prop.threshold, x, x) for x in values]
            result = _with_values(result, values)
    return _answer(prop, states, result, verdicts, float(tolerance))


def _several(
    model: CheckableModel, prop: Property, at_initial: bool, tolerance: float
) -> Achievable | ConstrainedOptimum | Pareto:
    """The answer to ``multi(...)``."""
    if not at_initial or not isinstance(model, SparseMDP):
        others = "from other than the initial states"
        restriction = "with intervals or a second player" if at_initial else others
        raise ValueError(
            f"{prop.text}: multi(...) is not supported {restriction}; ask for one objective at a time."
        )
    return solve_multi_objective(model, prop, tolerance)


def _value(
    model: SourceModel,
    prop: Property,
    states: np.ndarray,
    tolerance: float,
    again: Callable[..., Answer],
) -> Answer:
    """The values of an expression, or its truth."""
    assert prop.expression is not None

    def solve(part: Property, places: np.ndarray) -> Answer:
        return again(model, part, states=None if part.aggregate else places)

    bounds = expression_bounds(graph_of_model(model), prop.expression, states, solve)
    lower = np.array([double_bounds(x)[0] for x, _ in bounds], np.float64)
    upper = np.array([double_bounds(x)[1] for _, x in bounds], np.float64)
    holds: list[bool | None] | None = None
    if isinstance(bounds[0][0], bool):
        holds = [bool(a) if a == b else None for a, b in bounds]
    with np.errstate(invalid="ignore"):
        value = [float(a) if a == b else float((a + b) / 2) for a, b in bounds]
        width = np.where(lower == upper, 0, upper - lower)
        scale = np.maximum(1, np.minimum(np.abs(lower), np.abs(upper)))
    decided = None not in holds if holds else bool((width <= tolerance * scale).all())
    exact = tuple(Fraction(a) if math.isfinite(a) else a for a, _ in bounds)
    is_exact = holds is None and all(a == b for a, b in bounds)
    return Answer(
        states,
        np.array(value, np.float64),
        lower,
        upper,
        holds,
        Status.CONVERGED if decided else Status.PRECISION,
        _EXPRESSION,
        None,
        exact if is_exact else None,
    )


def _filter(
    model: SourceModel,
    prop: Property,
    states: object,
    tolerance: float,
    again: Callable[..., Answer],
) -> Answer:
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
    answer = again(model, part, states=among, tolerance=float(fine))
    return filtered(prop, answer, tolerance)


def as_answer(
    prop: Property, states: np.ndarray, solution: Solution, tolerance: float, method: str
) -> Answer:
    """The answer of a solution at the requested states, without a strategy."""
    result = QueryResult(replace(solution, method=method), None)
    holds = None if prop.relation is None else _verdicts(prop, result)
    return _answer(prop, states, result, holds, tolerance)


def _answer(
    prop: Property,
    states: np.ndarray,
    result: QueryResult,
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


def _status(prop: Property, result: QueryResult, tolerance: float) -> Status:
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


def _is_exact(result: QueryResult) -> bool:
    return bool((result.solution.lower == result.solution.upper).all())


def _is_tiny(model: CheckableModel) -> bool:
    """True if few choices leave their state."""
    return int(np.count_nonzero(~graph_of_model(model).host.is_self_loop)) <= _FEW


def _with_values(result: QueryResult, exact: list[Fraction | float] | None) -> QueryResult:
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


def _is_close(model: CheckableModel, prop: Property, result: QueryResult) -> bool:
    """True if the doubles of a model and the numbers of its source may differ in the verdict."""
    inner = model.mdp if isinstance(model, Game) else model
    if not isinstance(inner, SparseMDP) or inner.numbers.read is None:
        return False
    assert prop.threshold is not None
    threshold = float(prop.threshold)
    margin = _MARGIN * max(abs(threshold), _MARGIN)
    ends = np.asarray(result.solution.lower), np.asarray(result.solution.upper)
    return bool(any((np.abs(x - threshold) <= margin).any() for x in ends))


def _verdicts(prop: Property, result: QueryResult) -> list[bool | None]:
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


def _without_end(result: QueryResult, margin: float) -> QueryResult:
    """The result without the last state of the model, with bounds that are wider by a margin."""
    solution, strategy = result
    lower: Array = np.asarray(solution.lower)
    upper: Array = np.asarray(solution.upper)
    wide: Array = np.where((lower == 0) & (upper == 0), 0, margin)  # nothing can be earned
    lower = np.where(wide, np.nextafter(lower - wide, -np.inf), lower)
    upper = np.where(wide, np.nextafter(upper + wide, np.inf), upper)
    strategy = strategy and strategy._replace(row=strategy.row[:-1], nature=None)
    return QueryResult(replace(solution, lower=lower, upper=upper), strategy)


# --- which solver -----------------------------------------------------------------------------


def _solved(query: ModelQuery, prop: Property, aim: PropertyAim, tolerance: float) -> QueryResult:
    """The solution of a property at some states."""
    model, path = query.model, prop.path
    if prop.discount is not None:
        larger, simple = without_discount(model, prop)
        result = _solved(ModelQuery(larger, query.states, query.text), simple, aim, tolerance)
        return _without_end(result, rounding_of_discount(model, prop))
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
        if not cumulative and reward_structure(graph_of_model(model), reward).state is None:
            reward = np.zeros(graph_of_model(model).num_states)  # only those of states count
        solve = bounded.cumulative_reward if cumulative else bounded.instantaneous_reward
        return query.result(solve(model, reward, path.steps, **aim.directions), by="steps")
    inner = model.mdp if isinstance(model, Game) else model
    if isinstance(inner, IntervalMDP) and prop.unreached == "zero":
        raise ValueError(
            f"{prop.text}: rewards that count if a state is reached (F0) are not solved for where probabilities are "
            "intervals; ask for those until a state is reached (F, Fc), for ever (C), of so many steps (C<=k) or "
            "after them (I=k), or for the average (S)."
        )
    directed = aim.directions
    solution = total_reward(
        model, reward, target, unreached=prop.unreached, tolerance=tolerance, **directed
    )
    return query.result(solution)
