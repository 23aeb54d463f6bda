"""Summaries of models, environments and trajectories for their ``repr``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxltl.core.pretty_print import (
    array_text,
    enum_counts,
    count,
    truncate,
    nested_repr,
    batch_text,
    names_text,
    number,
    propositions_text,
    readable,
    value_range,
    describe,
)

_INNER = 92  # characters of a model inside of another


def padded(model: Any) -> Iterator[str]:
    """Summary of a padded or dense model."""
    yield batch_text(model.available.shape[:-2])
    yield count(model.num_states, "state")
    yield count(model.num_actions, "action")
    dense = hasattr(model, "transition")
    weights = model.transition if dense else model.probability
    weight, available = readable(weights), readable(model.available)
    if weight is None or available is None:
        yield array_text(weights)
    else:
        yield count(np.count_nonzero((weight > 0) & available[..., None]), "transition")
    yield propositions_text(model.propositions)
    yield _begins(model.initial)
    if weight is not None:
        yield str(weights.dtype)


def sparse(model: Any) -> Iterator[str]:
    """Summary of a sparse model."""
    yield batch_text(model.row_start.shape[:-1])
    yield count(model.num_states, "state")
    yield "a chain" if model.is_chain else count(model.num_rows, "choice")
    yield count(model.num_transitions, "transition")
    yield propositions_text(model.propositions)
    yield from _more(model)
    yield _begins(model.initial)
    yield str(model.probability.dtype)


def _more(model: Any) -> Iterator[str]:
    if model.rewards:
        yield f"rewards {names_text(model.rewards)}"
    if getattr(model, "action_names", ()):
        yield f"actions {names_text(model.action_names)}"
    if getattr(model, "valuation", {}):
        yield f"variables {names_text(model.valuation)}"


def _begins(initial: object) -> str:
    """The initial states, unless all are."""
    read = readable(initial)
    if read is None or read.ndim != 1:
        return ""
    starts = np.flatnonzero(read > 0)
    if len(starts) == len(read):
        return ""
    return f"starts in {starts[0]}" if len(starts) == 1 else f"{len(starts):,} starts"


def interval(model: Any) -> Iterator[str]:
    """Summary of an interval model."""
    yield from sparse(model.nominal)
    low, high = readable(model.lower), readable(model.upper)
    if low is not None and high is not None and low.size:
        yield f"intervals at most {number(float((high - low).max()))} wide"
    if model.radius is not None:
        yield f"radius {value_range(model.radius)}"


def parametric(model: Any) -> Iterator[str]:
    """Summary of a parametric model."""
    ends = zip(model.parameters, np.asarray(model.low), np.asarray(model.high), strict=True)
    yield f"{names_text((f'{name} in [{low:.6g}, {high:.6g}]' for name, low, high in ends), 90)}"
    yield nested_repr(model.model, _INNER)


def sharded(model: Any) -> Iterator[str]:
    """Summary of a model over a mesh."""
    yield count(model.num_given, "state")
    yield count(model.num_actions, "action")
    rows = " and ".join(f"{t.successor.shape[0]:,} of {t.successor.shape[1]}" for t in model.tables)
    yield f"rows {truncate(rows)}"
    yield propositions_text(model.propositions)
    yield from _more(model)
    yield f"on {count(model.mesh.shape[model.axis], 'device')} along {model.axis!r}"
    yield str(model.dtype)


def part(value: Any) -> Iterator[str]:
    """Summary of a part of a model."""
    rows = len(value.entry_start) - 1
    yield count(rows if value.row_start is None else len(value.row_start) - 1, "state")
    yield count(rows, "choice")
    yield count(len(value.successor), "transition")
    yield from _more(value)


def product(model: Any) -> Iterator[str]:
    """Summary of a product."""
    yield batch_text(model.automaton.delta.shape[:-2])
    memories = count(model.num_memory, "memory", "memories")
    yield f"{count(model.num_states, 'state')} with {memories}"
    yield nested_repr(model.mdp, _INNER)
    yield f"beside {nested_repr(model.automaton, _INNER)}"
    yield f"labels read on {model.label_on}"
    if model.allowed is not None:
        yield f"allowed: {describe(model.allowed)}"


def game(value: Any) -> Iterator[str]:
    """Summary of a game."""
    read = readable(value.system)
    if read is None:
        yield f"system: {array_text(value.system)}"
    else:
        yield f"the system moves in {np.count_nonzero(read):,} of {count(read.size, 'state')}"
    yield nested_repr(value.mdp, _INNER)


def counts(value: Any) -> Iterator[str]:
    """Summary of counts of transitions."""
    samples = readable(value.count)
    yield count(samples.sum(), "sample") if samples is not None else ""
    yield f"of {count(len(value.count), 'transition')}"
    yield f"{count(len(value.states), 'state')}: {names_text(value.states)}"
    yield f"{count(len(value.actions), 'action')}: {names_text(value.actions)}"


def trajectories(value: Any) -> Iterator[str]:
    """Summary of trajectories."""
    *more, number_of, longest = value.state.shape
    yield batch_text(more)
    yield f"{number_of:,} of at most {count(longest, 'step')}"
    yield f"lengths {value_range(value.length)}"
    if value.state_shape is not None:
        yield f"states {value.state_shape}"


def table(value: Any) -> Iterator[str]:
    """Summary of a tabulated environment."""
    yield nested_repr(value.model, _INNER)
    yield count(value.start.shape[-1], "beginning")
    for name in ("terminated", "truncated"):
        yield f"{name} {value_range(getattr(value, name))}"
    if value.num_steps is not None:
        yield f"at most {count(value.num_steps, 'step')}"
    yield f"evidence {value.evidence!r}"


def monitor(value: Any, codes: Any) -> Iterator[str]:
    """Summary of the monitor of a formula."""
    *more, states, letters = value.delta.shape
    yield batch_text(more)
    yield count(states, "state")
    yield count(letters, "letter")
    yield enum_counts(value.verdict, codes)


def space(value: Any) -> Iterator[str]:
    """Summary of a space of observations or actions."""
    yield f"{value.dtype}[{', '.join(str(n) for n in value.shape)}]"
    low, high = (value_range(x) for x in (value.low, value.high))
    yield f"from {low} to {high}" if max(len(low), len(high)) < 40 else ""


def environment(value: Any) -> Iterator[str]:
    """Summary of an environment."""
    finite = hasattr(value.actions, "num")
    yield count(value.actions.num, "action") if finite else f"actions {nested_repr(value.actions)}"
    yield f"observations {_spaces(value.observations)}"
    yield propositions_text(value.propositions)
    if value.horizon is not None:
        yield f"at most {count(value.horizon, 'step')}"
    if value.allowed is not None:
        yield "actions are masked"
    if value.outcomes is not None:
        yield "chances are told"


def _spaces(tree: Any) -> str:
    if hasattr(tree, "low"):
        return nested_repr(tree)
    inner = (
        tree.items()
        if isinstance(tree, dict)
        else zip(getattr(tree, "_fields", map(str, range(len(tree)))), tree, strict=True)
    )
    return f"({', '.join(f'{name}: {_spaces(x)}' for name, x in inner)})"


def episode(value: Any) -> Iterator[str]:
    """Summary of episodes."""
    *more, steps = value.valid.shape
    yield batch_text(more)
    yield f"at most {count(steps, 'step')}"
    read = readable(value.valid)
    if read is None:
        yield f"reward {array_text(value.reward)}"
        return
    yield f"made {value_range(read.sum(-1))}"
    for name in ("reward", "cost"):
        numbers = readable(getattr(value, name))
        if numbers is not None and (name == "reward" or numbers.any()):
            yield f"{name} {value_range(numbers.sum(-1))}"
    for name in ("terminated", "truncated"):
        yield f"{name} {value_range(getattr(value, name))}"
