"""Text representations of results."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from jaxltl.core.pretty_print import (
    bounds_text,
    array_text,
    enum_counts,
    count,
    truncate,
    nested_repr,
    number,
    readable,
    value_range,
    describe,
)
from jaxltl.core.types import Status

_INNER = 92


def guarantee(value: Any) -> Iterator[str]:
    """Of a DataGuarantee."""
    yield (
        f"at least {value.bound:.6g}"
        if value.bound <= value.optimistic
        else (f"at most {value.bound:.6g}")
    )
    yield f"no policy beyond {value.optimistic:.6g}"
    yield f"confidence {value.confidence:g}"
    samples = readable(value.sets.num_samples)
    yield count(samples.sum(), "sample") if samples is not None else ""
    yield nested_repr(value.model, _INNER)
    yield nested_repr(value.satisfaction.automaton, _INNER)


def gap(value: Any) -> Iterator[str]:
    """Of an OptimalityGap."""
    yield count(len(value.start), "beginning")
    for name, ends in (
        ("gap", value.mean),
        ("value", value.mean_value),
        ("optimum", value.mean_optimum),
    ):
        yield f"mean {name} in [{ends[0]:.6g}, {ends[1]:.6g}]"
    most = readable(value.upper)
    yield f"gap at most {number(most.max(initial=0.0))}" if most is not None else ""
    yield f"evidence {value.evidence!r}"


def optimal_actions(value: Any) -> Iterator[str]:
    """Of OptimalActions."""
    yield enum_counts(value.status, Status)
    yield f"allowed {describe(value.allowed)}"
    yield f"loses at most {value_range(value.loss)}"
    yield f"best {describe(value.best.value)}"


def answer(value: Any) -> Iterator[str]:
    """Of an Answer."""
    yield value.status.name
    yield count(len(value.states), "state")
    yield f"value {value_range(value.value)}"
    yield bounds_text(value.lower, value.upper)
    if value.holds is not None:
        yield f"holds {truncate(str(value.holds))}"
    yield f"by {value.method}"


def satisfaction(value: Any) -> Iterator[str]:
    """Facts of an optimal finite-memory policy and its product."""
    yield nested_repr(value.solution, _INNER)
    yield nested_repr(value.automaton, _INNER)
    yield f"{count(len(value.product.base_state), 'state')} of the product"


def objective(value: Any) -> Iterator[str]:
    """Facts of an Objective."""
    for name in ("formula", "target", "stay", "avoid", "reward", "threshold"):
        given = getattr(value, name)
        if given is not None:
            yield f"{name}={describe(given)}"
    yield f"direction={value.direction!r}"


def prepared(value: Any) -> Iterator[str]:
    """Of a question that was put in order."""
    yield value.question
    yield value.objective
    yield f"nature {value.nature}" if hasattr(value, "nature") else ""
    yield count(value.num_states, "state")
    yield count(value.num_rows, "choice")
    yield count(value.entry_row.shape[-1], "transition")
    if hasattr(value, "levels"):
        yield "circles" if value.cyclic else "no circles"
        yield count(value.levels, "level")
    numbers = value.probability if hasattr(value, "probability") else value.lower
    yield array_text(numbers)
