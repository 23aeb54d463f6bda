"""The table of engines: which question of which kind of model is answered, and by what."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from jaxltl.core import validation
from jaxltl.core.models.protocols import Model, PyTree
from jaxltl.core.types import Solution, check
from jaxltl.core.values.average import engine as average
from jaxltl.core.values.discounted import compiled as compiled_discounted, minimax
from jaxltl.core.values.door import row_engines
from jaxltl.core.values.door.called import called
from jaxltl.core.values.door.kinds import ModelKind, kind_of
from jaxltl.core.values.door.question import (
    Acceptance,
    Accuracy,
    AverageReward,
    DiscountedReward,
    NextStep,
    Path,
    Question,
    Reach,
    ReachAtCost,
    ReachWithin,
    RewardAfterSteps,
    RewardOfSteps,
    TotalReward,
    Until,
)
from jaxltl.core.values.interval import satisfaction as interval_satisfaction
from jaxltl.core.values.interval.sides import refuse_environment, refuse_nature
from jaxltl.core.values.partial_observability import belief_engines
from jaxltl.core.values.undiscounted import (
    acceptance,
    compiled_engines,
    reaching,
    sparse_satisfaction,
    step_engine,
)


class Engine(NamedTuple):
    """A solver of one question for one kind of model, with the options that it takes."""

    solve: Callable[..., Solution]  # of a model, a question, an accuracy and options
    options: tuple[str, ...] = ()  # of the call that it takes
    relative: bool = False  # whether the width may be asked relative to the value
    # options that select an engine of another column instead
    instead: tuple[str, ...] = ()
    column: str = ""


_LIMITED = ("max_steps", "start")
_SWEPT = ("method", "max_steps", "evaluation_sweeps")
_HOST_REACH = Engine(reaching.reach, ("method",))
_ROW_REACH = Engine(reaching.reach, ("method",), relative=True)
_EXACT_REACH = _HOST_REACH._replace(instead=("iterative", *_LIMITED), column="traced padded")
_COMPILED_REACH = Engine(compiled_engines.reach, ("method", *_LIMITED))
_ROBUST_REACH = Engine(row_engines.reach_with_nature)
_ROBUST_EARN = Engine(row_engines.earn_with_nature)
_ROBUST_DISCOUNT = Engine(row_engines.discount_with_nature)
_EARN, _COMPILED_EARN = Engine(row_engines.earn), Engine(compiled_engines.earn)
_COMPILED_DISCOUNT = Engine(compiled_discounted.discounted_reward, _SWEPT)
_DISCOUNT = Engine(row_engines.discount, instead=_SWEPT, column="traced rows")
_DISCOUNTED_GAME = Engine(minimax.discounted_game)
_AVERAGE = Engine(average.average, ("max_steps",))
_ACCEPT = Engine(interval_satisfaction.accept_with_nature)
_PARTIAL_REACH = Engine(belief_engines.reach)
_COMPILED_ACCEPT = Engine(acceptance.accept_padded, ("method", *_LIMITED))

CONCRETE = ("padded", "rows", "intervals", "padded game", "rows game", "intervals game")

# For each question the engine of each kind of model, by its `column`.
ENGINES: dict[type[Path], dict[str, Engine]] = {
    Reach: {
        "padded": _EXACT_REACH,
        "rows": _ROW_REACH,
        "intervals": _ROBUST_REACH,
        "padded game": _ROBUST_REACH,
        "rows game": _ROBUST_REACH,
        "rows pomdp": _PARTIAL_REACH,
        "intervals game": _ROBUST_REACH,
        "other": _COMPILED_REACH,
        "traced padded": _COMPILED_REACH,
        "traced other": _COMPILED_REACH,
        "mesh padded": _COMPILED_REACH,
    },
    Until: {
        "padded": _HOST_REACH,
        "rows": _ROW_REACH,
        "intervals": _ROBUST_REACH,
        "padded game": _ROBUST_REACH,
        "rows game": _ROBUST_REACH,
        "rows pomdp": _PARTIAL_REACH,
        "intervals game": _ROBUST_REACH,
    },
    TotalReward: {
        "padded": _EARN,
        "rows": _EARN,
        "intervals": _ROBUST_EARN,
        "padded game": _ROBUST_EARN,
        "rows game": _ROBUST_EARN,
        "rows pomdp": Engine(belief_engines.earn),
        "intervals game": _ROBUST_EARN,
        "traced padded": _COMPILED_EARN,
        "mesh padded": _COMPILED_EARN,
    },
    DiscountedReward: {
        "padded": _COMPILED_DISCOUNT,
        "rows": _DISCOUNT,
        "intervals": _ROBUST_DISCOUNT,
        "padded game": _ROBUST_DISCOUNT,
        "rows game": _ROBUST_DISCOUNT,
        "intervals game": _ROBUST_DISCOUNT,
        "other": _COMPILED_DISCOUNT,
        "traced padded": _COMPILED_DISCOUNT,
        "traced rows": _COMPILED_DISCOUNT,
        "traced other": _COMPILED_DISCOUNT,
        "mesh padded": _COMPILED_DISCOUNT,
        "traced padded game": _DISCOUNTED_GAME,
        "traced rows game": _DISCOUNTED_GAME,
    },
    AverageReward: dict.fromkeys(CONCRETE, _AVERAGE),
    NextStep: dict.fromkeys(CONCRETE, Engine(step_engine.reach_next)),
    ReachWithin: dict.fromkeys(CONCRETE, Engine(step_engine.reach_within, ("by_step",))),
    RewardOfSteps: dict.fromkeys(CONCRETE, Engine(step_engine.reward_of_steps, ("by_step",))),
    RewardAfterSteps: dict.fromkeys(CONCRETE, Engine(step_engine.reward_after_steps, ("by_step",))),
    ReachAtCost: dict.fromkeys(CONCRETE, Engine(step_engine.reach_at_cost, ("by_level",))),
    Acceptance: {
        "padded": _COMPILED_ACCEPT,
        "rows": Engine(sparse_satisfaction.accept_rows, relative=True),
        "intervals": _ACCEPT,
        "padded game": _ACCEPT,
        "rows game": _ACCEPT,
        "intervals game": _ACCEPT,
        "other": _COMPILED_ACCEPT,
        "traced padded": _COMPILED_ACCEPT,
        "traced other": _COMPILED_ACCEPT,
        "mesh padded": _COMPILED_ACCEPT,
    },
}

# Where no compiled engine answers inside jit, a program calls the host.
for _path, _row in ENGINES.items():
    for _column in CONCRETE:
        if _column in _row:
            _share = _path in (TotalReward, AverageReward)
            _row.setdefault(
                f"traced {_column}", Engine(called(_row[_column].solve, relative=_share))
            )

NAMES: dict[type[Path], str] = {
    Reach: "reachability_probability",
    Until: "reachability_probability",
    TotalReward: "total_reward",
    DiscountedReward: "optimal_value and policy_value",
    AverageReward: "average_reward",
    NextStep: "next_probability",
    ReachWithin: "bounded_reachability",
    RewardOfSteps: "cumulative_reward",
    RewardAfterSteps: "instantaneous_reward",
    ReachAtCost: "reward_bounded_reachability",
    Acceptance: "optimal_satisfaction and satisfaction_probability",
}


def solve(
    model: Model,
    question: Question,
    accuracy: Accuracy,
    *,
    throw: bool = False,
    **options: PyTree,
) -> Solution:
    """The answer to a question, by the engine for this kind of model.

    Raises:
      ValueError: no engine answers this question of this kind of model, a direction is stated where nobody
        has it, or an option that the engine does not take.
      NotConverged: with `throw`, unless the solution converged.
    """
    kind = kind_of(model, (question.path, question.policy, accuracy.tolerance, options))
    selected = {name: x for name, x in options.items() if x is not None}
    engine = engine_for(kind, question, selected)
    if kind.container != "intervals":
        refuse_nature(question.nature)
    if not kind.is_game:
        refuse_environment(question.environment)
    validation.choice("objective", question.objective, ("max", "min"))
    for name in selected:
        if name not in engine.options:
            host = ENGINES[type(question.path)].get(kind._replace(arrays="concrete").column)
            if host is not None and name in host.options and kind.arrays == "traced":
                raise ValueError(
                    f"{kind} is solved without {name}; leave it out, or call it outside jit and vmap, on "
                    "concrete arrays."
                )
            raise ValueError(
                f"{name} is an option of iterations on padded and dense models; {kind} is solved "
                "without it. Leave it out."
            )
    if accuracy.relative and not engine.relative:
        raise ValueError(f"relative=True is for a SparseMDP, not for {kind} (see to_sparse).")
    solution = engine.solve(model, question, accuracy, **selected)
    if not kind.is_partial:  # whose values are those of the initial belief
        solution = replace(solution, initial=getattr(model, "initial", None))
    return check(solution) if throw else solution


def engine_for(kind: ModelKind, question: Question, selected: dict[str, PyTree]) -> Engine:
    """The engine of a kind of model; ValueError, with what can be asked of it, if there is none."""
    path = type(question.path)
    row = ENGINES[path]
    if kind.column not in row:
        known = ", ".join(NAMES[other] for other, x in ENGINES.items() if kind.column in x)
        host = kind._replace(arrays="concrete").column in row and kind.arrays != "concrete"
        remedy = (
            "call it outside jit and vmap, on concrete arrays"
            if host and kind.arrays == "traced"
            else f"it answers {known or 'none of these questions'}"
        )
        if kind.is_partial:
            remedy += (
                "; or ask of its fully observable model, pomdp.fully_observable, whose maximum is an upper "
                "bound and whose minimum a lower bound"
            )
        raise ValueError(f"{NAMES[path]} has no answer for {kind}; {remedy}.")
    engine = row[kind.column]
    word = selected.get("method")
    chosen = {word if isinstance(word, str) else "", *selected}
    if "iterative" in chosen and question.policy is None:
        chosen.discard("iterative")
    return row[engine.column] if chosen & set(engine.instead) else engine
