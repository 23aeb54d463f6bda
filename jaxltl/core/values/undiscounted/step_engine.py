"""Engine of step-bounded and reward-bounded questions: any concrete model as a game on rows."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import reward_structure
from jaxltl.core.sparse.bounded.backup import StepReward
from jaxltl.core.sparse.bounded.reward_bounded import BudgetLevel, in_units, until_at_cost
from jaxltl.core.sparse.bounded.row_game import RowGame
from jaxltl.core.sparse.bounded.step_bounded import (
    StepBoundedValues,
    avoidance,
    next_step,
    total,
    until,
)
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import (
    Accuracy,
    NextStep,
    Question,
    ReachAtCost,
    ReachWithin,
    RewardAfterSteps,
    RewardOfSteps,
)
from jaxltl.core.values.engine.host_solution import with_given_policy
from jaxltl.core.values.engine.row_form import RowForm, row_form
from jaxltl.core.values.engine.state_quantities import (
    PROBABILITY,
    Span,
    finite_reward,
    reward_span,
    solution_from_error,
    state_reward,
    transition_reward,
)
from jaxltl.core.values.interval.sides import directions


def reach_next(model: Model, question: Question, _: Accuracy) -> Solution:
    """Probability that the next state is in a set."""
    path, problem = question.path, _problem(model, question)
    assert isinstance(path, NextStep)
    values = next_step(problem.game, problem.form.states("target", path.target))
    return problem.solution(values, PROBABILITY)


def reach_within(
    model: Model, question: Question, _: Accuracy, *, by_step: bool = False
) -> Solution:
    """Probability of reaching a set within a number of steps."""
    path = question.path
    assert isinstance(path, ReachWithin)
    steps, problem = validation.integer("num_steps", path.num_steps), _problem(model, question)
    goal, free = problem.form.states("target", path.target), problem.passable(path.stay)
    return problem.solution(until(problem.game, goal, free, steps, by_step), PROBABILITY)


def reward_of_steps(
    model: Model, question: Question, _: Accuracy, *, by_step: bool = False
) -> Solution:
    """Expected reward of a number of steps."""
    path = question.path
    assert isinstance(path, RewardOfSteps)
    steps, problem = validation.integer("num_steps", path.num_steps), _problem(model, question)
    rewards, sparse = problem.form.reward(path.reward), problem.form.sparse
    earned, magnitude = finite_reward(sparse, rewards)
    entry = None
    if problem.game.sets is not None:
        entry = transition_reward(sparse, rewards)
        magnitude = np.maximum.reduceat(np.abs(entry), sparse.host.entry_start[:-1])
        entry = entry[problem.entry]
    paid = StepReward(earned[problem.row], magnitude[problem.row], entry)
    start = np.zeros(problem.game.mdp.num_states)
    values = total(problem.game, paid, start, steps, by_step)
    return problem.solution(values, reward_span(rewards, steps))


def reward_after_steps(
    model: Model, question: Question, _: Accuracy, *, by_step: bool = False
) -> Solution:
    """Expected reward of the state after a number of steps."""
    path = question.path
    assert isinstance(path, RewardAfterSteps)
    steps, problem = validation.integer("num_steps", path.num_steps), _problem(model, question)
    final = state_reward(problem.form.sparse, problem.form.reward(path.reward))
    zero = np.zeros(problem.game.mdp.num_rows)
    values = total(problem.game, StepReward(zero, zero), final, steps, by_step)
    return problem.solution(values, (float(final.min()), float(final.max())))


def reach_at_cost(
    model: Model, question: Question, _: Accuracy, *, by_level: bool = False
) -> Solution:
    """Probability of reaching a set before more than a bound of reward is earned."""
    path, problem = question.path, _problem(model, question)
    assert isinstance(path, ReachAtCost)
    goal, free = problem.form.states("target", path.target), problem.passable(path.stay)
    limits = validation.Range(0, math.inf, open_above=True)
    validation.require_in_range("bound", path.bound, limits)
    sparse, host, reward = problem.form.sparse, problem.form.host, path.reward
    # Rewards of transitions are not their expectation here.
    if np.ndim(cast(Array, reward)) < len(problem.form.shape) + 2:
        reward = problem.form.reward(reward)
    cost = transition_reward(sparse, reward_structure(sparse, reward))
    if (cost < 0).any():
        e = int(np.flatnonzero(cost < 0)[0])
        raise ValueError(
            f"the reward is {cost[e]:.9g} from state {host.state[host.row[e]]} to "
            f"{host.successor[e]}; a bound on rewards needs rewards of at least 0."
        )
    counted = np.where((free & ~goal)[host.state[host.row]], cost, 0)
    units, limit = in_units(counted, path.bound)
    values = until_at_cost(problem.game, goal, free, (units[problem.entry], limit), by_level)
    return problem.solution(values, PROBABILITY, limit + 1)


def bounded_avoidance(
    model: Model,
    target: Array,
    num_steps: int,
    *,
    stay: Array,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
) -> Solution | None:
    """Complement of step-bounded reachability, relatively exact; None for many steps."""
    problem = _problem(model, Question(NextStep(target), objective, nature, environment))
    values = avoidance(problem.game, target, stay, num_steps)
    return None if values is None else problem.solution(values, PROBABILITY)


# --- any model as a game on rows ---------------------------------------------------------------


class _Problem(NamedTuple):
    """A model as a game on rows, under the given policy."""

    form: RowForm
    game: RowGame
    row: Integers  # int[R'], int[T'], the model's rows and entries
    entry: Integers
    policy: Array | None

    def passable(self, stay: Array | str | None) -> Booleans:
        everywhere = np.ones(self.form.sparse.num_states, bool)
        return everywhere if stay is None else self.form.states("stay", stay)

    def solution(
        self, values: StepBoundedValues | BudgetLevel, span: Span, num_levels: int | None = None
    ) -> Solution:
        """The :class:`Solution` of values of the rows."""
        steps = values.num_steps if isinstance(values, StepBoundedValues) else num_levels
        row = self.row[values.row]
        solution = solution_from_error(values.value, values.error, row, steps or 0, span=span)
        shape, form = self.form.shape, self.form
        parts: dict[str, Array] = {
            name: getattr(solution, name).reshape(shape) for name in ("value", "lower", "upper")
        }
        parts["policy"] = form.number[row].astype(np.int32).reshape(*row.shape[:-1], *shape)
        parts["nature"] = None if self.policy is not None else values.probability
        method = "step by step" if num_levels is None else "level by level of the reward"
        return with_given_policy(replace(solution, **parts, method=method), self.policy)


def _problem(model: Model, question: Question) -> _Problem:
    form, policy = row_form(model), question.policy
    aims = directions(question.objective, question.nature, question.environment)
    host, sets = form.host, None if form.interval is None else form.interval.host
    own = np.ones(host.num_states, bool) if form.system is None else form.system
    maximizes = np.where(own, aims.system, aims.environment)
    game = RowGame(host, maximizes, sets, aims.nature)
    if policy is None:
        return _Problem(form, game, np.arange(host.num_rows), np.arange(host.num_transitions), None)
    return _Problem(form, *game.under(form.weights(policy), own), policy)
