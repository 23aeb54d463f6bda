"""Step-bounded and reward-bounded probabilities and rewards, of concrete models.

Solved in double precision; bounds include all rounding.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple, cast

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Reward, reward_structure
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
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.values.interval.sides import directions, refuse_environment, refuse_nature


@validated(games=True, host=True)
def next_probability(
    model: Model,
    target: Array | str,
    *,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    policy: Array | None = None,
) -> Solution:
    """Probability that the next state is in a set: ``opt_a P(target | s, a)``.

    Args:
      model, target, objective, nature, environment, policy: as for :func:`bounded_reachability`.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`. Concrete arrays only; not
      differentiable.

    Raises:
      ValueError: the shape of the target, the objective, the policy, or `nature` of a model without
        intervals.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse([0, 2, 3], [0, 2, 3, 4], [0, 1, 0, 1], [0.75, 0.25, 1, 1])
      >>> found = next_probability(model, [False, True])
      >>> found.value.tolist(), found.policy.tolist()
      ([0.25, 1.0], [0, 0])
    """
    problem = _problem(model, objective, nature, environment, policy)
    values = next_step(problem.game, problem.form.states("target", target))
    return problem.solution(values, PROBABILITY)


@validated(games=True, host=True)
def bounded_reachability(
    model: Model,
    target: Array | str,
    num_steps: int,
    *,
    stay: Array | str | None = None,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    policy: Array | None = None,
    by_step: bool = False,
) -> Solution:
    """Step-bounded reachability probability, within n steps through the states of `stay`.

    ``x_0 = [s in target]``, and ``x_{k+1}(s) = 1`` in the target, ``opt_a (P x_k)(s, a)`` in
    `stay`, else 0 (Baier and Katoen 2008, section 10.1.1); in models with intervals nature picks P
    anew in each step (Givan, Leach and Dean 2000). For large n the iteration ends once the effect of
    further steps is bounded.

    Args:
      model: any concrete model. In a game the environment has the opposite objective.
      target: ``bool[S]``, a label's name, or a Boolean formula of labels.
      num_steps: n.
      stay: in the same forms, what must hold before the target is reached; default everywhere.
      objective: ``"max"`` or ``"min"``, of the system; irrelevant for chains.
      nature: of models with intervals: ``"adversarial"`` (default), against the objective, or
        ``"cooperative"``.
      environment: of games, in the same words.
      policy: evaluate this policy, of a game the system's: actions ``int32[S]`` or ``float[S, A]``, of
        sparse models also weights of rows ``float[R]``. Default: optimise.
      by_step: return the choices of all steps.

    Returns:
      :class:`Solution`; `value` is ``float64`` in the shape of the states, exactly 0 or 1 where the
      graph decides. `policy` is the first action of each state;
      with `by_step` the choices of all steps in order, with an axis ``[n]`` in front. `num_steps` is
      the number of computed steps, `nature` has the distributions of the first step. Concrete arrays
      only; not differentiable.

    Raises:
      ValueError: a shape, the objective, a negative number of steps, the policy, or `nature` of a
        model without intervals.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> bounded_reachability(model, [False, True], 3).value.tolist()
      [0.875, 1.0]
    """
    steps = validation.integer("num_steps", num_steps)
    problem = _problem(model, objective, nature, environment, policy)
    goal, free = problem.form.states("target", target), problem.passable(stay)
    return problem.solution(until(problem.game, goal, free, steps, by_step), PROBABILITY)


def bounded_avoidance(
    model: Model,
    target: Array,
    num_steps: int,
    *,
    stay: Array,
    objective: str = "max",
    nature: str | None = None,
) -> Solution | None:
    """Complement of :func:`bounded_reachability`, relatively exact; None for many steps."""
    problem = _problem(model, objective, nature, None, None)
    values = avoidance(problem.game, target, stay, num_steps)
    return None if values is None else problem.solution(values, PROBABILITY)


@validated(games=True, host=True)
def cumulative_reward(
    model: Model,
    reward: Reward,
    num_steps: int,
    *,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    policy: Array | None = None,
    by_step: bool = False,
) -> Solution:
    """Expected reward of the next n steps.

    ``x_{k+1}(s) = opt_a r(s, a) + (P x_k)(s, a)`` from ``x_0 = 0`` (Puterman 1994, section 4.3).

    Args:
      model, num_steps, objective, nature, environment, policy, by_step: as for :func:`bounded_reachability`.
      reward: as for :func:`~jaxltl.core.models.sparse.choice_reward`; finite, of any sign.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`. Concrete arrays only; not
      differentiable.

    Raises:
      ValueError: the reward, or as for :func:`bounded_reachability`.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> cumulative_reward(model, [1.0, 0.0], 3).value.tolist()
      [1.75, 0.0]
    """
    steps = validation.integer("num_steps", num_steps)
    problem = _problem(model, objective, nature, environment, policy)
    rewards = problem.form.reward(reward)
    earned, magnitude = finite_reward(problem.form.sparse, rewards)
    entry = None
    if problem.game.sets is not None:
        entry = transition_reward(problem.form.sparse, rewards)
        magnitude = np.maximum.reduceat(np.abs(entry), problem.form.sparse.host.entry_start[:-1])
        entry = entry[problem.entry]
    paid = StepReward(earned[problem.row], magnitude[problem.row], entry)
    start = np.zeros(problem.game.mdp.num_states)
    values = total(problem.game, paid, start, steps, by_step)
    return problem.solution(values, reward_span(rewards, steps))


@validated(games=True, host=True)
def instantaneous_reward(
    model: Model,
    reward: Reward,
    num_step: int,
    *,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    policy: Array | None = None,
    by_step: bool = False,
) -> Solution:
    """Expected reward of the state after n steps.

    ``x_{k+1}(s) = opt_a (P x_k)(s, a)`` from the rewards of states ``x_0 = r``.

    Args:
      model, objective, nature, environment, policy, by_step: as for :func:`bounded_reachability`.
      reward: the name of a reward, a structure, of which only the rewards of states count, or an
        array ``[S]``. None is the only reward of the model.
      num_step: n.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`. Concrete arrays only; not
      differentiable.

    Raises:
      ValueError: the reward has no part on states, or as for :func:`bounded_reachability`.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> instantaneous_reward(model, [1.0, 0.0], 3).value.tolist()
      [0.125, 0.0]
    """
    steps = validation.integer("num_steps", num_step)
    problem = _problem(model, objective, nature, environment, policy)
    final = state_reward(problem.form.sparse, problem.form.reward(reward))
    zero = np.zeros(problem.game.mdp.num_rows)
    values = total(problem.game, StepReward(zero, zero), final, steps, by_step)
    return problem.solution(values, (float(final.min()), float(final.max())))


@validated(games=True, host=True)
def reward_bounded_reachability(
    model: Model,
    target: Array | str,
    reward: Reward,
    bound: float,
    *,
    stay: Array | str | None = None,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    policy: Array | None = None,
    by_level: bool = False,
) -> Solution:
    """Probability of reaching a set before more than a bound of reward is earned.

    With l units left, ``x_l(s) = 1`` in the target, and the least solution of
    ``x_l(s) = opt_a sum_t P(t | s, a) x_{l - c(s, a, t)}(t)`` elsewhere, zero below level 0
    (Andova, Hermanns and Katoen 2003). Rewards in the target do not count.

    Args:
      model, target, stay, objective, nature, environment, policy: as for :func:`bounded_reachability`.
      reward: as for :func:`~jaxltl.core.models.sparse.choice_reward`, not negative, multiples of one
        unit; numbers are read as the simplest fractions that round to them.
      bound: the largest reward.
      by_level: return the choices for all amounts left.

    Returns:
      :class:`Solution`, as of :func:`bounded_reachability`; with `by_level`, row l of the policy has
      the choices with l units left, ``[L + 1]`` in front. `num_steps` is the number of levels, L + 1.
      Games and models with intervals are unfolded over the levels. Concrete arrays only; not
      differentiable.

    Raises:
      ValueError: a negative reward, rewards without a common unit of which the bound has at most
        10^7, a game or a model with intervals that is too large on all levels, or as for
        :func:`bounded_reachability`.

    Example:
      >>> from jaxltl import make_sparse
      >>> model = make_sparse(None, [0, 2, 3], [0, 1, 1], [0.5, 0.5, 1.0])
      >>> reward_bounded_reachability(model, [False, True], [0.1, 0], 0.3).value.tolist()
      [0.875, 1.0]
    """
    problem = _problem(model, objective, nature, environment, policy)
    goal, free = problem.form.states("target", target), problem.passable(stay)
    validation.require_in_range("bound", bound, validation.Range(0, math.inf, open_above=True))
    sparse, host = problem.form.sparse, problem.form.sparse.host
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
    units, limit = in_units(counted, bound)
    values = until_at_cost(problem.game, goal, free, (units[problem.entry], limit), by_level)
    return problem.solution(values, PROBABILITY, limit + 1)


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


def _problem(
    model: Model, objective: str, nature: str | None, environment: str | None, policy: Array | None
) -> _Problem:
    form = row_form(model)
    aims = directions(objective, nature, environment)
    if form.interval is None:
        refuse_nature(nature)
    if form.system is None:
        refuse_environment(environment)
    host, sets = form.host, None if form.interval is None else form.interval.host
    own = np.ones(host.num_states, bool) if form.system is None else form.system
    maximizes = np.where(own, aims.system, aims.environment)
    game = RowGame(host, maximizes, sets, aims.nature)
    if policy is None:
        return _Problem(form, game, np.arange(host.num_rows), np.arange(host.num_transitions), None)
    return _Problem(form, *game.under(form.weights(policy), own), policy)
