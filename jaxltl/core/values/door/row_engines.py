"""Engines on rows: concrete models of every kind, by exact rows or by policy, nature and two players."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import Reward
from jaxltl.core.sparse.bounded.reward_bounded import in_units
from jaxltl.core.sparse.interval import discounted as interval_discounted
from jaxltl.core.sparse.interval.reachability import reachability, without_absorbing
from jaxltl.core.sparse.interval.reward_forever import reward_forever
from jaxltl.core.sparse.interval.robust_values import RobustValues
from jaxltl.core.sparse.interval.total_reward import total_reward
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers import discounted, reachability as exact
from jaxltl.core.sparse.solvers.game_reward import game_reward_forever
from jaxltl.core.sparse.solvers.reward_if_reached import reward_if_reached
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import (
    Accuracy,
    DiscountedReward,
    Question,
    Reach,
    TotalReward,
    Until,
    require_infinite,
)
from jaxltl.core.values.engine.host_solution import (
    default_tolerance,
    policy_chain,
    solution_from_enclosure,
    status_between,
    with_given_policy,
)
from jaxltl.core.values.engine.row_form import RowForm, row_form
from jaxltl.core.values.engine.state_quantities import (
    Span,
    clipped,
    discounted_span,
    finite_reward,
    nonnegative_reward,
    transition_reward,
)
from jaxltl.core.values.interval.sides import (
    TOLERANCE,
    Sides,
    directions,
    pure_rows,
    sides_of,
)

# --- one player, known probabilities --------------------------------------------------------------


def earn(model: Model, question: Question, accuracy: Accuracy) -> Solution:
    """Total rewards of exact rows."""
    path, form = question.path, row_form(model)
    assert isinstance(path, TotalReward)
    earned = nonnegative_reward(form.sparse, form.reward(path.reward), "total rewards")
    requested = accuracy.width(default_tolerance(model))
    host, depth, maximize = form.host, 0, question.objective == "max"
    if question.policy is not None:
        chain = policy_chain(host, form.weights(question.policy))
        earned = chain.mean(earned, host.row_start)
        host, depth = chain.mdp, chain.depth
    if path.target is not None and path.unreached == "zero":
        if question.policy is not None:
            raise ValueError(
                'policy: unreached="zero" is solved for optimal policies; leave it out.'
            )
        maximizing = np.full(host.num_states, maximize)
        enclosure = _if_reached(form, path, maximizing, requested)
    elif path.target is None or path.unreached == "sum":
        ended, earned, row = _ended(form, host, earned, path)
        enclosure = exact.reward_forever(
            ended, earned, maximize=maximize, tolerance=requested, depth=depth
        )
        enclosure = replace(enclosure, row=row[enclosure.row])
    else:
        target = form.states("target", path.target)
        enclosure = exact.total_reward(
            host, earned, target, maximize=maximize, tolerance=requested, depth=depth
        )
    solution = solution_from_enclosure(form, enclosure, requested, relative=True)
    return with_given_policy(solution, question.policy)


def discount(model: Model, question: Question, accuracy: Accuracy) -> Solution:
    """Discounted rewards of exact rows; a minimum is that of the negated reward."""
    path, form = question.path, row_form(model)
    assert isinstance(path, DiscountedReward)
    structure, factor = form.reward(path.reward), float(path.discount)
    sign = 1 if question.objective == "max" or question.policy is not None else -1
    earned, magnitude = finite_reward(form.sparse, structure)
    largest = float(np.abs(earned).max()) / (1 - factor)
    requested = accuracy.width(1e-8 * max(largest, 1e-300))
    host, depth = form.host, 0
    if question.policy is not None:
        chain = policy_chain(host, form.weights(question.policy))
        earned, magnitude = (chain.mean(x, host.row_start) for x in (earned, magnitude))
        host, depth = chain.mdp, chain.depth
    enclosure = discounted.discounted_value(
        host, sign * earned, magnitude, factor, tolerance=requested, depth=depth
    )
    if sign < 0:
        low, high = -enclosure.upper, -enclosure.lower
        enclosure = replace(enclosure, value=-enclosure.value, lower=low, upper=high)
    solution = solution_from_enclosure(form, enclosure, requested, relative=False)
    solution = _within(solution, discounted_span(structure, factor), requested)
    return with_given_policy(solution, question.policy)


# --- policy and nature, and games -----------------------------------------------------------------


def reach_with_nature(model: Model, question: Question, accuracy: Accuracy) -> Solution:
    """Probabilities of reaching a set under intervals, and of games.

    The least solution of ``x(s) = opt_a opt_p sum_t p_t x(t)`` outside of the target, p among the
    distributions of row a (Nilim and El Ghaoui 2005, Iyengar 2005).
    """
    path, form = question.path, row_form(model)
    assert isinstance(path, Reach | Until)
    requested, target = accuracy.width(TOLERANCE), form.states("target", path.target)
    inside = form.states("stay", path.stay) if isinstance(path, Until) else None

    def reach(sides: Sides) -> RobustValues:
        stay = None if inside is None else sides.states(inside) | sides.added
        return reachability(sides.host, sides.states(target), sides.query(requested), stay=stay)

    return robust_solution(form, question, reach, requested)


def earn_with_nature(model: Model, question: Question, accuracy: Accuracy) -> Solution:
    """Total rewards under intervals, and of games: ``x(s) = opt_a opt_p (r(s, a) + sum_t p_t x(t))``."""
    path, form = question.path, row_form(model)
    assert isinstance(path, TotalReward)
    if form.interval is None and (path.target is None or path.unreached != "infinite"):
        return _earn_in_game(form, question, accuracy.width(TOLERANCE))
    forever = path.target is None or path.unreached == "sum"
    if forever and form.system is None:
        return _earn_forever(form, question, accuracy.width(TOLERANCE))
    require_infinite(path)
    requested, target = accuracy.width(TOLERANCE), form.states("target", path.target)
    reward = certain_reward(form, path.reward)

    def earn(sides: Sides) -> RobustValues:
        earned = np.where(sides.choosing, 0, reward[sides.encoded.row])
        return total_reward(sides.host, earned, sides.states(target), sides.query(requested))

    return robust_solution(form, question, earn, requested, relative=True)


def _earn_forever(form: RowForm, question: Question, requested: float) -> Solution:
    """Total rewards under intervals for ever, or until a set of states that runs may avoid."""
    path = question.path
    assert isinstance(path, TotalReward)
    reward = certain_reward(form, path.reward)
    target = None if path.target is None else form.states("target", path.target)

    def earn(sides: Sides) -> RobustValues:
        earned, query = reward[sides.encoded.row], sides.query(requested)
        if target is None:
            return reward_forever(sides.host, earned, query)
        ends = sides.states(target)
        ended, row = sides.host.with_absorbing(ends)
        earned = np.where(ends[ended.mdp.state], 0, earned[row])
        values = reward_forever(ended, earned, query)
        return without_absorbing(sides.host, ended, row, ends, values)

    return robust_solution(form, question, earn, requested, relative=True)


def _earn_in_game(form: RowForm, question: Question, requested: float) -> Solution:
    """Total rewards of a game for ever, or until a set of states that runs may avoid."""
    path = question.path
    assert isinstance(path, TotalReward) and form.system is not None
    if question.policy is not None:
        raise ValueError(
            "policy: rewards of a game whose runs need not reach a target are solved for optimal "
            "strategies; leave policy out, or restrict the model by with_allowed."
        )
    earned = nonnegative_reward(form.sparse, form.reward(path.reward), "total rewards")
    aims = directions(question.objective, None, question.environment)
    maximizing = np.where(form.system, aims.system, aims.environment)
    if path.target is not None and path.unreached == "zero":
        enclosure = _if_reached(form, path, maximizing, requested)
    else:
        ended, earned, row = _ended(form, form.host, earned, path)
        enclosure = game_reward_forever(ended, earned, maximizing, tolerance=requested)
        enclosure = replace(enclosure, row=row[enclosure.row])
    return solution_from_enclosure(form, enclosure, requested, relative=True)


def _if_reached(
    form: RowForm, path: TotalReward, maximizing: Booleans, requested: float
) -> Enclosure:
    """Rewards that count only if the target is reached, of chains, decision processes and games."""
    assert path.target is not None
    cost = transition_reward(form.sparse, form.reward(path.reward))
    largest = float(cost.max(initial=0))
    units, most = in_units(cost, largest)
    target = form.states("target", path.target)
    values = reward_if_reached(form.host, units, target, maximizing, tolerance=requested)
    unit, error = largest / max(most, 1), 4 * float(np.finfo(np.float64).eps)
    low, high = values.lower * unit * (1 - error), values.upper * unit * (1 + error)
    return replace(values, value=np.clip(values.value * unit, low, high), lower=low, upper=high)


def _ended(
    form: RowForm, host: HostMDP, earned: Floats, path: TotalReward
) -> tuple[HostMDP, Floats, Integers]:
    """The rows in which nothing is earned from the target on, their rewards and original rows."""
    if path.target is None:
        return host, earned, np.arange(host.num_rows)
    target = form.states("target", path.target)
    ended, row = UncertainMDP(host, host.probability, host.probability).with_absorbing(target)
    return ended.mdp, np.where(target[ended.mdp.state], 0, earned[row]), row


def discount_with_nature(model: Model, question: Question, accuracy: Accuracy) -> Solution:
    """Discounted rewards under intervals, and of games (Iyengar 2005; Shapley 1953).

    ``V(s) = opt_a opt_p sum_t p_t (r(s, a, t) + discount V(t))``, by policy iteration; the bounds are
    ``V +- |Phi V - V| / (1 - discount)``, with rounding.
    """
    path, form = question.path, row_form(model)
    assert isinstance(path, DiscountedReward)
    structure, factor = form.reward(path.reward), float(path.discount)
    reward = transition_reward(form.sparse, structure)
    largest = float(np.abs(reward).max(initial=0)) / (1 - factor)
    requested = accuracy.width(1e-8 * max(largest, 1e-300))

    def discounted_by(sides: Sides) -> RobustValues:
        entry = sides.encoded.entry
        earned = np.where(entry < 0, 0, reward[entry])
        factors = np.where(sides.choosing, 1.0, factor)
        part = interval_discounted.DiscountedModel(sides.host, earned, factors)
        return interval_discounted.discounted_value(part, sides.query(requested))

    solution = robust_solution(form, question, discounted_by, requested)
    return _within(solution, discounted_span(structure, factor), requested)


def _within(solution: Solution, span: Span, requested: float) -> Solution:
    """A solution within the span of its quantity, which may make it narrow enough."""
    solution = clipped(solution, span)
    ends = np.asarray(solution.lower), np.asarray(solution.upper)
    status = status_between(*ends, float(requested), relative=False)
    return replace(solution, status=np.int32(status))  # type: ignore[arg-type]


def certain_reward(form: RowForm, reward: Reward) -> Floats:
    """Non-negative reward of each row, ``float64[R]``, if it is independent of nature."""
    structure = form.reward(reward)
    earned: Floats = nonnegative_reward(form.sparse, structure, "total rewards")
    of = structure.transition
    if of is not None and form.interval is not None:
        each, sets = np.asarray(of), form.uncertain.host
        start = form.host.entry_start[:-1]
        differs = np.maximum.reduceat(each, start) != np.minimum.reduceat(each, start)
        loose = np.logical_or.reduceat(sets.lower < sets.upper, start)
        if (differs & loose).any():
            row = int(np.flatnonzero(differs & loose)[0])
            raise ValueError(
                f"the reward of row {row} differs between its successors, whose probabilities are "
                "intervals; put it on states that are entered, or on choices."
            )
    return earned


def robust_solution(
    form: RowForm,
    question: Question,
    solve: Callable[[Sides], RobustValues],
    tolerance: float,
    *,
    relative: bool = False,
) -> Solution:
    """The solution of certified values of policy and nature, of the sides of a question."""
    weights = None if question.policy is None else form.weights(question.policy)
    aims = directions(question.objective, question.nature, question.environment)
    host, system = form.uncertain.host, form.system
    sides = sides_of(host, system, aims, weights)
    values, encoded, size = solve(sides), sides.encoded, form.sparse.num_states
    probability = encoded.nature(values.probability, form.host.probability)
    ends = [x[:size] for x in (values.value, values.lower, values.upper)]
    parts: dict[str, Array] = dict(
        zip(("value", "lower", "upper"), (x.reshape(form.shape) for x in ends), strict=True)
    )
    if question.policy is None:
        row = encoded.policy(values.row, values.probability)
        if system is not None and aims.system == aims.nature and sides.is_mixed(values.probability):
            row = pure_rows(host, system, aims, probability, solve)
        parts["policy"] = form.actions(row)
    else:
        parts["policy"] = np.asarray(question.policy)
    if form.interval is not None:
        parts["nature"] = probability
    status = status_between(ends[1], ends[2], float(tolerance), relative=relative)
    parts["residual"] = np.float64(values.residual)
    parts |= {"num_steps": np.int32(values.rounds), "status": np.int32(status)}
    return Solution(**parts, method=values.method)
