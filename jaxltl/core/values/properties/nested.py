"""Nested properties, comparisons of variables, and filters over states."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
import numpy as np

from jaxltl.core.array_types import Booleans
from jaxltl.core.logic.comparisons import Comparison
from jaxltl.core.logic.properties import Property
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.sparse.solvers.shortest_path_problem import RelativeTolerance
from jaxltl.core.types import Status
from jaxltl.core.values.properties.answers import Answer

Model = SparseMDP | IntervalMDP


def with_definitions(
    model: Model, prop: Property, solve: Callable[[Model, Property], Answer]
) -> Model:
    """The model with a label for each comparison and nested property.

    Raises:
      ValueError: a nested property is not decided in some state, or an unknown variable.
    """
    world = model.nominal if isinstance(model, IntervalMDP) else model
    columns: dict[str, Booleans] = {}
    for name, meaning in prop.definitions:
        if name in world.propositions:
            raise ValueError(f"{prop.text}: the model has a label {name!r}; rename it.")
        if name in columns:
            continue
        if isinstance(meaning, Comparison):
            columns[name] = np.broadcast_to(meaning.holds(world.valuation), (world.num_states,))
            continue
        holds = solve(model, meaning).holds
        assert holds is not None
        if None in holds:
            raise ValueError(
                f"{prop.text}: {meaning.text} is not decided in state {holds.index(None)}, where "
                "the bounds lie on both sides of the threshold; change it a little."
            )
        columns[name] = np.array(holds, bool)
    if not columns:
        return model
    label = np.column_stack([np.asarray(world.label), *columns.values()])
    more = replace(world, label=label, propositions=(*world.propositions, *columns))
    return replace(model, nominal=more) if isinstance(model, IntervalMDP) else more


def filtered(prop: Property, answer: Answer, tolerance: float) -> Answer:
    """The aggregate of an answer over its states; ``states`` is ``[-1]`` if it is of no single one."""
    kind, count = prop.aggregate, answer.states.size
    lower, upper, value = answer.lower, answer.upper, answer.value
    if kind == "print":
        return answer
    if kind == "state" and count != 1:
        raise ValueError(f"{prop.text}: {count} states satisfy the condition; one must.")
    if kind in ("state", "first"):
        return _at(answer, 0)
    if kind in ("min", "max"):
        place, best = (np.argmin, np.min) if kind == "min" else (np.argmax, np.max)
        numbers = best(lower), best(value), best(upper)
        return _number(prop, _at(answer, int(place(value))), numbers, tolerance)
    whole = answer._replace(states=np.array([-1]), strategy=None)
    if answer.holds is not None:
        return _truth(whole, kind, answer.holds)
    if kind == "range":
        low, high = np.max(lower) - np.min(upper), np.max(upper) - np.min(lower)
        ends = max(0.0, math.nextafter(low, -math.inf)), math.nextafter(high, math.inf)
        return _number(prop, whole, (ends[0], np.ptp(value), ends[1]), tolerance)
    divisor = count if kind == "avg" else 1
    # The sum of fsum is the nearest double.
    low, high = (
        math.nextafter(math.nextafter(math.fsum(x.tolist()), end) / divisor, end)
        for x, end in ((lower, -math.inf), (upper, math.inf))
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
        strategy=None,
    )


def _truth(answer: Answer, kind: str | None, holds: list[bool | None]) -> Answer:
    """A filter of truth values: a count, or whether all or some are true."""
    sure, open_ = holds.count(True), holds.count(None)
    if kind == "count":
        low, high = np.array([float(sure)]), np.array([float(sure + open_)])
        status = Status.PRECISION if open_ else Status.CONVERGED
        return answer._replace(value=low, lower=low, upper=high, holds=None, status=status)
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
    # Rounding of the aggregate itself is not counted.
    narrow = width <= tolerance * scale + 1e-14 * abs(numbers[1])
    status = answer.status if narrow else max(answer.status, Status.PRECISION)
    return answer._replace(value=value, lower=lower, upper=upper, status=status)
