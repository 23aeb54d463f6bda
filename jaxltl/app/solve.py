"""Model checking of a model file: the command ``jaxltl solve``, without compilation."""

from __future__ import annotations

import json
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxltl.core.array_types import Booleans, Floats
from jaxltl.io.certificate.results import Certifiable
from jaxltl.app.wording import Record
from jaxltl.core.language.syntax import Program
from jaxltl.core.logic import Property
from jaxltl.core.models import POMDP, Game, IntervalMDP, MultiplayerGame
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.types import NotConverged, Status
from jaxltl.core.values import (
    Achievable,
    ConstrainedOptimum,
    Pareto,
    Answer,
    solve_property,
)
from jaxltl.core.values.properties.aims import SourceModel, graph_of_model
from jaxltl.io.prism.properties import PropertyQuery, read_queries as read_queries
from jaxltl.io.strategies import strategy_entry
from jaxltl.io.templates import render

AnyAnswer = Answer | Achievable | ConstrainedOptimum | Pareto

_PROGRESS_SECONDS = 5.0

SOLVED, NOT_CONVERGED, INVALID = 0, 1, 2  # exit statuses


@dataclass(frozen=True)
class PropertyResult:
    """The answer to a property."""

    query: PropertyQuery  # the property
    answer: AnyAnswer | None  # its answer, or None
    seconds: float  # wall time
    error: str | None = None  # why there is no answer, or None
    fault: int = SOLVED  # NOT_CONVERGED for the solver, INVALID for the property

    @property
    def status(self) -> str:
        """The name of the status of the answer or of its lack."""
        if self.answer is not None:
            return Status(self.answer.status).name
        return "MAX_STEPS" if self.fault == NOT_CONVERGED else "INVALID"

    @property
    def exit_status(self) -> int:
        if self.answer is None:
            return self.fault
        return SOLVED if self.status == "CONVERGED" else NOT_CONVERGED


def load(
    path: Path, program: Program | None = None, max_states: int | None = None
) -> SourceModel | POMDP:
    """A chain, decision process, interval model, POMDP or game, from a model file or a program."""
    from jaxltl.io.model_files import read_model

    if program is None:
        model = read_model(path, max_states=max_states)
    else:
        from jaxltl.core.programs.build import MAX_STATES, build_model

        limit = max_states or MAX_STATES
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model = build_model(program, max_states=limit, progress=_ProgressPrinter())
        for warning in caught:
            print(f"warning: {warning.message}", file=sys.stderr, flush=True)
    return model


class _ProgressPrinter:
    """Prints the states of a long exploration, and the bounds so far, every few seconds."""

    def __init__(self) -> None:
        self.last = time.monotonic()

    def __call__(self, states: int, expanded: int, answer: Answer | None = None) -> None:
        if time.monotonic() - self.last > _PROGRESS_SECONDS:
            self.last = time.monotonic()
            ends = answer and f": {answer.lower.min():.6g} to {answer.upper.max():.6g}"
            text = f"{states} states found, {expanded} expanded{ends or ''}"
            print(text, file=sys.stderr, flush=True)


def solve(
    model: SourceModel | POMDP | Program,
    queries: Sequence[PropertyQuery],
    tolerance: float,
    max_states: int | None = None,
    **how: bool,
) -> Iterator[PropertyResult]:
    """Yields the result of each property; of a program, some states are explored for each.

    `how` has the options relative, exact and fair of :func:`~jaxltl.solve_property`.
    """
    from scipy.sparse import csgraph, linalg  # noqa: F401 - not in the first property's time

    if not isinstance(model, Program):
        return answers(queries, lambda x: solve_property(model, x, tolerance=tolerance, **how))
    from jaxltl.core.programs.build import MAX_STATES
    from jaxltl.core.programs.partial import solve_program

    def answer(prop: Property) -> AnyAnswer:
        options: Record = {"tolerance": tolerance, "max_states": max_states or MAX_STATES}
        report = _ProgressPrinter()
        return solve_program(model, prop, method="partial", report=report, **options)

    return answers(queries, answer)


def answers(
    queries: Sequence[PropertyQuery],
    answer: Callable[[Property], AnyAnswer],
    is_fatal: Callable[[Exception], bool] = lambda error: False,
) -> Iterator[PropertyResult]:
    """Yields the result of each property in order; errors of one do not end the others."""
    for one in queries:
        begin = time.perf_counter()
        result: AnyAnswer | None = None
        error, fault = one.error, INVALID
        if one.parsed is not None:
            try:
                result = answer(one.parsed)
            except Exception as failure:
                if is_fatal(failure):
                    raise
                error = str(failure)
                fault = INVALID if isinstance(failure, ValueError) else NOT_CONVERGED
                if not isinstance(failure, ValueError | NotConverged):
                    traceback.print_exc()  # a bug must not lose the other answers
                    error = f"{type(failure).__name__}: {error}"
        yield PropertyResult(one, result, time.perf_counter() - begin, error, fault)


# --- output -----------------------------------------------------------------------------------


def model_entry(model: SourceModel | POMDP, seconds: float) -> Record:
    """The model as its JSON object."""
    kinds = ("idtmc", "imdp") if isinstance(model, IntervalMDP) else ("chain", "mdp")
    if isinstance(model, POMDP):
        model, kinds = model.fully_observable, ("pomdp", "pomdp")
    elif isinstance(model, Game | MultiplayerGame):
        kinds = "smg", "smg"
    graph = graph_of_model(model)
    return {
        "kind": kinds[not graph.is_chain],
        "states": graph.num_states,
        "choices": graph.num_rows,
        "transitions": graph.num_transitions,
        "seconds": seconds,
    }


def result_entry(result: PropertyResult) -> Record:
    """Answer to a property, as a JSON object."""
    answer = result.answer
    none = dict.fromkeys(("value", "lower", "upper"))
    entry: Record = {"property": result.query.text, **none, "status": result.status}
    if result.query.parsed is not None and result.query.parsed.name is not None:
        entry["name"] = result.query.parsed.name
    if isinstance(answer, Answer):
        known = np.where(is_vacuous(answer.lower, answer.upper), np.nan, answer.value)
        entry |= {
            "value": _over_states(known.tolist() if answer.holds is None else answer.holds),
            **{key: _over_states(getattr(answer, key).tolist()) for key in ("lower", "upper")},
            "method": answer.method,
        }
        if answer.exact is not None:
            entry["exact"] = _over_states([str(x) for x in answer.exact])
        if answer.states.size > 1:
            entry["states"] = answer.states.tolist()
    elif answer is not None:
        entry |= _several_entry(answer)
    if result.error is not None:
        entry["error"] = result.error
    return entry | {"seconds": result.seconds}


def _several_entry(answer: Achievable | ConstrainedOptimum | Pareto) -> Record:
    """A multi-objective answer: achievability, optimum, or points of the Pareto curve."""
    if isinstance(answer, Pareto):
        return {"value": answer.points.tolist(), "gap": _number(float(answer.gap))}
    entry: Record = {}
    if answer.nearest is not None:
        bounds = {key: getattr(answer.nearest, key).tolist() for key in ("lower", "upper", "gap")}
        entry["nearest"] = {key: _over_states(values) for key, values in bounds.items()}
    if isinstance(answer, Achievable):
        return entry | {"value": answer.holds}
    numbers = {key: _number(getattr(answer, key)) for key in ("value", "lower", "upper")}
    return entry | numbers | {"achievable": answer.holds}


def _over_states(values: list[Any]) -> Any:
    """The value of a single initial state, or the list of several."""
    plain = [_number(x) for x in values]
    return plain[0] if len(plain) == 1 else plain


def _number(x: object) -> Any:
    if isinstance(x, float) and not np.isfinite(x):
        return None if np.isnan(x) else "inf" if x > 0 else "-inf"
    return x + 0.0 if isinstance(x, float) else x  # no negative zero; JSON has no infinity


def is_vacuous(lower: Floats, upper: Floats) -> Booleans:
    """Marks bounds that exclude no probability, or no reward on one side.

    >>> is_vacuous(np.array([0, 0, 2, np.inf]), np.array([1, 0.5, np.inf, np.inf])).tolist()
    [True, False, True, False]
    """
    low, high = np.asarray(lower, float), np.asarray(upper, float)
    infinite = np.isinf(low) | np.isinf(high)
    marked: Booleans = (
        ((low <= 0) & (high == 1)) | (infinite & (low != high)) | np.isnan(low) | np.isnan(high)
    )
    return marked


def text(result: PropertyResult) -> str:
    """Answer to a property, as text."""
    values = {"result": result, "answer": result.answer, "vacuous": is_vacuous}
    lines = render("jaxltl.app.reports", "solve.txt", **values)
    return lines.rstrip("\n")


def certifiable(model: SourceModel | POMDP, result: PropertyResult) -> Certifiable:
    """The arguments of the certificate of a property's answer."""
    text = result.query.text if result.query.parsed is None else result.query.parsed.text
    answer = result.answer
    reason = "" if isinstance(answer, Answer) else f"{text} has no answer of one number"
    controller = answer.strategy if isinstance(answer, Answer) else None
    if not isinstance(model, POMDP) or not isinstance(controller, FiniteMemoryPolicy):
        return Certifiable(model, None, text, reason=reason)
    nodes = model.num_states * (controller.next_memory.shape[1] + 1)
    return Certifiable(model, controller, text, num_nodes=nodes)


def summary(results: Sequence[PropertyResult]) -> str:
    """One line for each property: its name or text, and its value."""
    lines = []
    for result in results:
        prop, entry = result.query.parsed, result_entry(result)
        name = f'"{prop.name}": ' if prop is not None and prop.name else ""
        value = entry["value"]
        value = value if isinstance(value, bool) else entry.get("exact", value)
        value_text = "refused" if result.answer is None else json.dumps(value).replace('"', "")
        status = "" if result.status in ("CONVERGED", "INVALID") else f" ({result.status})"
        lines.append(f"{name}{' '.join(result.query.text.split())}: {value_text}{status}")
    return "\n".join(lines)


# --- strategies -------------------------------------------------------------------------------


def strategies(
    model: SourceModel | POMDP, results: Sequence[PropertyResult], source: Path
) -> bytes:
    """The optimal strategies as JSON; see docs/solve.md."""
    if isinstance(model, POMDP):
        raise ValueError(
            "--strategy is for models whose states are seen; save the policy of solve_property's answer."
        )
    entries = [
        {"property": r.query.text, **strategy_entry(model, r.answer.strategy)}
        for r in results
        if isinstance(r.answer, Answer)
        and r.answer.strategy is not None
        and (isinstance(model, IntervalMDP) or not graph_of_model(model).is_chain)
    ]
    table = {"model": source.name, "states": model.num_states, "strategies": entries}
    return (json.dumps(table, allow_nan=False) + "\n").encode()
