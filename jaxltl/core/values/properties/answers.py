"""Answers to properties, their strategies and filters, and definitions of nested properties."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans
from jaxltl.core.deferred import deferred_field
from jaxltl.core.logic.comparisons import Comparison
from jaxltl.core.logic.properties import Property
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.multiplayer import MultiplayerGame
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.exact.model import double_bounds
from jaxltl.core.sparse.solvers.shortest_path_problem import RelativeTolerance
from jaxltl.core.types import Status
from jaxltl.core.models.product_policy import ProductPolicy


@brief
class PropertyStrategy(NamedTuple):
    """An optimal strategy of a property.

    Attributes:
      row: chosen rows ``int32[S]`` of the model; with a memory, ``int32[N]`` of the product.
      by: ``"steps"`` or ``"reward"`` if the strategy also depends on the remaining steps or
        reward, and `row` is its first choice; else empty.
      memory: the product and its automaton, or None.
      nature: of an interval model, nature's distributions ``float64[T]`` of the model or product.

    Example:
      >>> import jaxltl as jl
      >>> safe_or_not = jl.make_sparse([0, 2, 3, 4], [0, 1, 3, 4, 5], [1, 1, 2, 1, 2],
      ...                           [1, 0.5, 0.5, 1, 1], initial=[1, 0, 0], label={"a": [1]})
      >>> jl.solve_property(safe_or_not, 'Pmin=? [ F "a" ]').strategy.row.tolist()  # in each state
      [1, 2, 3]
    """

    row: np.ndarray
    by: str = ""
    memory: ProductPolicy | None = None
    nature: Array | None = None


PropertyStrategy.row = deferred_field(0, "Chosen rows.")  # type: ignore[assignment]


@brief
class Answer(NamedTuple):
    """The result of a property.

    Attributes:
      states: ``int[I]``; ``[-1]`` for a filter of no single state, such as a sum, and ``[-1, -1]`` for
        a range, whose values are the least and the largest one.
      value, lower, upper: ``float64[I]``, with certified bounds.
      holds: truth of a threshold in each state; None where the bounds do not decide it.
      status: CONVERGED if all bounds are within the tolerance, or decide the threshold.
      method: the algorithm and the proof.
      strategy: an optimal strategy; None in chains.
      exact: the values as fractions or infinite doubles, in exact arithmetic; else None.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                    initial=[1, 0, 0], label={"a": [1]})
      >>> found = jl.solve_property(coin, 'P>=0.4 [ F "a" ]')
      >>> found.states.tolist(), found.value.tolist(), found.holds, found.status.name
      ([0], [0.5], [True], 'CONVERGED')
    """

    states: np.ndarray
    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    holds: list[bool | None] | None
    status: Status
    method: str
    strategy: PropertyStrategy | None
    exact: tuple[Fraction | float, ...] | None = None


Model = SparseMDP | IntervalMDP | Game | MultiplayerGame


def with_definitions(
    model: Model, prop: Property, solve: Callable[[Model, Property], Answer]
) -> Model:
    """The model with a label for each comparison and nested property.

    Raises:
      ValueError: a nested property is not decided in some state, or an unknown variable.
    """
    inner = model.mdp if isinstance(model, Game | MultiplayerGame) else model
    world = inner.nominal if isinstance(inner, IntervalMDP) else inner
    columns: dict[str, Booleans] = {}
    for name, meaning in prop.definitions:
        if name in world.propositions:
            raise ValueError(f"{prop.text}: the model has a label {name!r}; rename it.")
        if name in columns:
            continue
        if isinstance(meaning, Comparison) and meaning.needs_results:
            meaning = Property(meaning.text, "value", expression=meaning)
        if isinstance(meaning, Comparison):
            columns[name] = np.broadcast_to(meaning.holds(world.valuation), (world.num_states,))
            continue
        holds = solve(model, meaning).holds
        if holds is None:
            raise ValueError(f"{meaning.text} is a number; compare it, as in {meaning.text} > 0.")
        if None in holds:
            raise ValueError(
                f"{prop.text}: {meaning.text} is not decided in state {holds.index(None)}, where "
                "the bounds lie on both sides of the threshold; change it a little."
            )
        columns[name] = np.broadcast_to(np.array(holds, bool), (world.num_states,))
    if not columns:
        return model
    label = np.column_stack([np.asarray(world.label), *columns.values()])
    more = replace(world, label=label, propositions=(*world.propositions, *columns))
    changed = replace(inner, nominal=more) if isinstance(inner, IntervalMDP) else more
    return replace(model, mdp=changed) if isinstance(model, Game | MultiplayerGame) else changed


def filtered(prop: Property, answer: Answer, tolerance: float) -> Answer:
    """The aggregate of an answer over its states; ``states`` are -1 if it is of no single one."""
    kind, count = prop.aggregate, answer.states.size
    lower, upper, value = answer.lower, answer.upper, answer.value
    if kind in ("print", "printall"):
        return answer
    if kind == "state" and count != 1:
        raise ValueError(f"{prop.text}: {count} states satisfy the condition; one must.")
    if kind in ("state", "first"):
        return _at(answer, 0)
    if kind in ("argmin", "argmax"):
        bar = upper.min() if kind == "argmin" else lower.max()
        best_states = np.flatnonzero(lower <= bar if kind == "argmin" else upper >= bar)
        parts = {name: getattr(answer, name)[best_states] for name in ("states", "lower", "upper")}
        sure = bool((parts["lower"] == parts["upper"]).all() or best_states.size == 1)
        status = answer.status if sure else max(answer.status, Status.PRECISION)
        exact = answer.exact and tuple(answer.exact[i] for i in best_states.tolist())
        value = value[best_states]
        return answer._replace(**parts, value=value, status=status, exact=exact, strategy=None)
    if kind in ("min", "max"):
        best, optimum = (np.min, min) if kind == "min" else (np.max, max)
        place = int(np.flatnonzero(value == best(value))[0])
        if answer.exact is not None:
            place = answer.exact.index(optimum(answer.exact))
        numbers = best(lower), best(value), best(upper)
        return _number(prop, _at(answer, place), numbers, tolerance)
    whole = answer._replace(states=np.array([-1]), strategy=None, exact=None)
    if answer.holds is not None:
        return _truth(whole, kind, answer.holds)
    if kind == "range":  # the interval of the values, as in PRISM
        ends = [
            _number(prop, whole, (end(lower), end(value), end(upper)), tolerance)
            for end in (np.min, np.max)
        ]
        return whole._replace(
            states=np.array([-1, -1]),
            value=np.concatenate([x.value for x in ends]),
            lower=np.concatenate([x.lower for x in ends]),
            upper=np.concatenate([x.upper for x in ends]),
            status=max(x.status for x in ends),
            exact=answer.exact and (min(answer.exact), max(answer.exact)),
        )
    divisor = count if kind == "avg" else 1
    # The sum of fsum is the nearest double.
    low, high = (
        math.nextafter(math.nextafter(math.fsum(x.tolist()), end) / divisor, end)
        for x, end in ((lower, -math.inf), (upper, math.inf))
    )
    if answer.exact is not None:
        total = sum(answer.exact, Fraction(0)) / divisor
        low, high = double_bounds(total)
        return whole._replace(
            value=np.array([float(total)]),
            lower=np.array([low]),
            upper=np.array([high]),
            exact=(total,),
        )
    return _number(prop, whole, (low, math.fsum(value.tolist()) / divisor, high), tolerance)


def _at(answer: Answer, place: int) -> Answer:
    """The answer at one of its states."""
    one = slice(place, place + 1)
    return answer._replace(
        states=answer.states[one],
        value=answer.value[one],
        lower=answer.lower[one],
        upper=answer.upper[one],
        holds=None if answer.holds is None else answer.holds[one],
        exact=answer.exact and answer.exact[one],
        strategy=None,
    )


def _truth(answer: Answer, kind: str | None, holds: list[bool | None]) -> Answer:
    """A filter of truth values: a count, or whether all or some are true."""
    sure, open_ = holds.count(True), holds.count(None)
    if kind == "count":
        low, high = np.array([float(sure)]), np.array([float(sure + open_)])
        status = Status.PRECISION if open_ else Status.CONVERGED
        exact = None if open_ else (Fraction(sure),)
        return answer._replace(
            value=low, lower=low, upper=high, holds=None, status=status, exact=exact
        )
    decided = sure > 0 if kind == "exists" else sure + open_ < len(holds)
    # A true one decides "exists", a false one "forall".
    verdict = (kind == "exists") if decided else None if open_ else (kind == "forall")
    bounds = (np.array([float(x)]) for x in (verdict is True, verdict is not False))
    lower, upper = bounds
    status = Status.PRECISION if verdict is None else Status.CONVERGED
    return answer._replace(value=lower, lower=lower, upper=upper, holds=[verdict], status=status)


def _number(
    prop: Property, answer: Answer, numbers: tuple[float, float, float], tolerance: float
) -> Answer:
    """An answer of one number with its bounds."""
    lower, value, upper = (np.array([float(x)]) for x in numbers)
    with np.errstate(invalid="ignore"):
        width = np.where(lower == upper, 0.0, upper - lower)[0]
    relative = prop.operator in ("R", "T") or isinstance(tolerance, RelativeTolerance)
    scale = max(abs(numbers[0]), abs(numbers[2])) if relative else 1.0
    # Rounding of the aggregate itself is not counted, unless the width is a share of the value.
    limit = float(tolerance) * scale + 1e-14 * abs(numbers[1])
    if isinstance(tolerance, RelativeTolerance):
        limit = float(tolerance) * min(abs(numbers[0]), abs(numbers[2]))
    narrow = width <= limit
    status = answer.status if narrow else max(answer.status, Status.PRECISION)
    return answer._replace(value=value, lower=lower, upper=upper, status=status)
