"""Certified values of interval MDPs with adversarial or cooperative nature."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jax.typing import ArrayLike

from jaxltl.core.array_types import Integers
from jaxltl.core.models.refusals import on_host
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP, make_interval
from jaxltl.core.models.ops.operators import is_deterministic, row_weights
from jaxltl.core.models.sparse import Reward, SparseMDP, reward_structure
from jaxltl.core.sparse.interval.discounted import DiscountedModel, discounted_value
from jaxltl.core.sparse.interval.game_encoding import EncodedChoices, choices_as_nature
from jaxltl.core.sparse.interval.reachability import reachability
from jaxltl.core.sparse.interval.robust_values import Query, RobustValues
from jaxltl.core.sparse.interval.total_reward import total_reward
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.types import Solution, require_shape
from jaxltl.core import validation
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.values.engine.host_solution import status_between
from jaxltl.core.values.engine.state_quantities import (
    clipped,
    discounted_span,
    nonnegative_reward,
    state_mask,
    transition_reward,
)

TOLERANCE = 1e-6


def require_objective(objective: str) -> str:
    """The objective; ValueError unless it is ``"max"`` or ``"min"``."""
    return validation.choice("objective", objective, ("max", "min"))


def nature_direction(nature: str | None, objective: str) -> str:
    """``"max"`` or ``"min"``, the direction in which nature optimises."""
    require_objective(objective)
    nature = "adversarial" if nature is None else nature
    validation.choice("nature", nature, ("adversarial", "cooperative"))
    return objective if nature == "cooperative" else {"max": "min", "min": "max"}[objective]


def requested_width(tolerance: jax.Array | float | None) -> float:
    """The width of the enclosure: `tolerance`, or the default."""
    if tolerance is None:
        return TOLERANCE
    validation.require_in_range("tolerance", tolerance)
    return float(tolerance)


def refuse_nature(nature: str | None) -> None:
    """Raises ValueError if `nature` is given for a model without uncertainty sets."""
    if nature is not None:
        raise ValueError(
            f"nature={nature!r} is for models with intervals (make_interval); the "
            "probabilities of this one are given. Leave it out."
        )


@validated(games=True, host=True)
def robust_reachability(
    model: Model,
    target: Array | str,
    *,
    policy: Array | None = None,
    objective: str = "max",
    nature: str | None = None,
    stay: Array | None = None,
    tolerance: jax.Array | float | None = None,
) -> Solution:
    """Robust reachability probability of an interval MDP.

    The least solution of ``x(s) = opt_a opt_p sum_t p_t x(t)`` outside of the target, p among the
    distributions of row a (Nilim and El Ghaoui 2005, Iyengar 2005).

    Args:
      model: the model, or a :class:`~jaxltl.core.models.game.Game` on one (or on a sparse model), in
        which the environment has the opposite objective.
      target: ``bool[S]``, or the name of a label.
      policy: ``int32[S]``, rows, or ``float[R]``, their weights, to be evaluated; default:
        optimise. Of a game, the system's; the environment still optimises.
      objective: ``"max"`` or ``"min"``, the direction of the policy (of the system).
      nature: ``"adversarial"`` (default), against the objective, or ``"cooperative"``.
      stay: ``bool[S]``, the states that may be passed; default all.
      tolerance: width of the enclosure; default 1e-6.

    Returns:
      :class:`Solution`, with `nature`. Concrete arrays only; :func:`robust_sensitivity` has the
      derivatives in the ends.

    Raises:
      ValueError: a wrong shape or direction.

    Example:
      >>> from jaxltl import make_interval, make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> model = make_interval(coin, [0.4, 0.3, 1, 1], [0.7, 0.6, 1, 1])
      >>> robust_reachability(model, [False, True, False]).value.tolist()
      [0.4, 1.0, 0.0]
    """
    requested = requested_width(tolerance)
    world, sides = sides_of(model, policy, objective, nature)
    target = sides.states(state_mask(world.nominal, target, "target"))
    if stay is not None:
        stay = sides.states(state_mask(world.nominal, stay, "stay")) | sides.added
    values = reachability(sides.host, target, sides.query(requested), stay=stay)
    return robust_solution(world, sides, values, requested, relative=False)


@validated(games=True, host=True)
def robust_total_reward(
    model: Model,
    reward: Reward,
    target: Array | str,
    *,
    policy: Array | None = None,
    objective: str = "max",
    nature: str | None = None,
    tolerance: jax.Array | float | None = None,
) -> Solution:
    """Robust expected total reward of an interval MDP until a target is reached.

    ``x(s) = opt_a opt_p (r(s, a) + sum_t p_t x(t))`` outside of the target, infinite where the
    target is not reached almost surely.

    Args:
      model, target, policy, objective, nature: as of :func:`robust_reachability`.
      reward: as of :func:`~jaxltl.core.models.sparse.choice_reward`; at least 0. Rewards of
        transitions must not differ within a row unless the interval is a point.
      tolerance: width of the enclosure, relative to the value; default 1e-6.

    Returns:
      :class:`Solution`, with `nature`. Concrete arrays only; :func:`robust_sensitivity` has the
      derivatives in the ends.

    Raises:
      ValueError: a wrong shape or direction, or a reward that is negative or depends on nature.

    Example:
      >>> from jaxltl.core.models import interval_rows
      >>> coin = interval_rows(None, [0, 2, 3], [0, 1, 1], [0.25, 0.5, 1], [0.5, 0.75, 1])
      >>> found = robust_total_reward(coin, [1.0, 0.0], [False, True], objective="min")
      >>> found.value.round(6).tolist(), found.nature.tolist()  # tosses, if nature is against it
      ([2.0, 0.0], [0.5, 0.5, 1.0])
    """
    requested = requested_width(tolerance)
    world, sides = sides_of(model, policy, objective, nature)
    target = sides.states(state_mask(world.nominal, target, "target"))
    earned = np.where(sides.choosing, 0, interval_reward(world, reward)[sides.encoded.row])
    values = total_reward(sides.host, earned, target, sides.query(requested))
    return robust_solution(world, sides, values, requested, relative=True)


@validated(games=True, host=True)
def robust_discounted_value(
    model: Model,
    reward: Reward,
    discount: float,
    *,
    policy: Array | None = None,
    objective: str = "max",
    nature: str | None = None,
    tolerance: jax.Array | float | None = None,
) -> Solution:
    """Robust discounted value of an interval MDP.

    ``V(s) = opt_a opt_p sum_t p_t (r(s, a, t) + discount V(t))`` (Iyengar 2005), by policy
    iteration; the bounds are ``V +- |Phi V - V| / (1 - discount)``, with rounding.

    Args:
      model, policy, objective, nature: as of :func:`robust_reachability`.
      reward: of any sign, as of :func:`~jaxltl.core.models.sparse.choice_reward`.
      discount: in ``[0, 1)``.
      tolerance: width of the enclosure; default 1e-8 of the largest possible value.

    Returns:
      :class:`Solution`, with `nature`. Concrete arrays only; not differentiable.

    Raises:
      ValueError: a wrong shape, direction or discount, or a reward that is not finite.

    Example:
      >>> from jaxltl.core.models import interval_rows
      >>> coin = interval_rows(None, [0, 2, 3], [0, 1, 1], [0.25, 0.5, 1], [0.5, 0.75, 1])
      >>> found = robust_discounted_value(coin, [1.0, 0.0], 0.5)
      >>> found.value.round(6).tolist(), found.nature.tolist()
      ([1.142857, 0.0], [0.25, 0.75, 1.0])
    """
    world, sides = sides_of(model, policy, objective, nature)
    entry, structure = sides.encoded.entry, reward_structure(world.nominal, reward)
    earned = np.where(entry < 0, 0, transition_reward(world.nominal, structure)[entry])
    largest = float(np.abs(earned).max(initial=0)) / (1 - float(discount))
    requested = 1e-8 * max(largest, 1e-300) if tolerance is None else requested_width(tolerance)
    discounts = np.where(sides.choosing, 1.0, float(discount))
    values = discounted_value(
        DiscountedModel(sides.host, earned, discounts), sides.query(requested)
    )
    solution = robust_solution(world, sides, values, requested, relative=False)
    return clipped(solution, discounted_span(structure, float(discount)))


@on_host
def robust_expectation(
    model: IntervalMDP, value: ArrayLike, *, objective: str = "max", nature: str | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Robust expectation of the next state's value, for each choice.

    ``min_p sum_t p_t value(t)``, or the maximum, over the distributions of each row.

    Args:
      model: the model.
      value: ``float[S]``, finite.
      objective, nature: as of :func:`robust_reachability`; the default is the least expectation.

    Returns:
      ``float64[R]``, and nature's distributions, ``float64[T]``. Concrete arrays only; not
      differentiable.

    Raises:
      ValueError: a wrong direction or shape, a model without intervals, or a value of a successor
        that is not finite.

    Example:
      >>> from jaxltl.core.models import interval_rows
      >>> model = interval_rows(None, [0, 2, 3], [0, 1, 1], [.25, .5, 1], [.5, .75, 1])
      >>> robust_expectation(model, [0.0, 4.0])[0].tolist()
      [2.0, 4.0]
    """
    maximize = nature_direction(nature, objective) == "max"
    model, _ = world_of(model)
    require_shape("value", value, model.state_shape)
    ahead = validation.float_array("value", value)[model.host.mdp.successor]
    if not np.isfinite(ahead).all():
        raise ValueError("value is not finite in some successor; give numbers.")
    p = model.host.extreme_distributions(ahead, maximize=maximize)
    return model.host.sum_rows(p * ahead), p


def interval_reward(model: IntervalMDP, reward: Reward) -> np.ndarray:
    """Non-negative reward of each choice, ``float64[R]``, if it is independent of nature."""
    earned = nonnegative_reward(model.nominal, reward, "total rewards")
    of = reward_structure(model.nominal, reward).transition
    if of is not None:
        each = np.asarray(of)
        start = model.nominal.host.entry_start[:-1]
        differs = np.maximum.reduceat(each, start) != np.minimum.reduceat(each, start)
        loose = np.logical_or.reduceat(model.host.lower < model.host.upper, start)
        if (differs & loose).any():
            row = int(np.flatnonzero(differs & loose)[0])
            raise ValueError(
                f"the reward of row {row} differs between its successors, whose probabilities are "
                "intervals; put it on states that are entered, or on choices."
            )
    return earned


def robust_solution(
    world: IntervalMDP, sides: Sides, values: RobustValues, tolerance: float, *, relative: bool
) -> Solution:
    """The :class:`Solution` of certified values."""
    size, encoded = world.num_states, sides.encoded
    policy = sides.policy
    if policy is None:
        policy = encoded.policy(values.row, values.probability).astype(np.int32)
    otherwise = np.asarray(world.nominal.probability)
    values = replace(values, probability=encoded.nature(values.probability, otherwise))
    states = np.arange(size)
    return solution_at(values, states, (size,), np.asarray(policy), tolerance, relative=relative)


def solution_at(
    values: RobustValues,
    states: Integers,
    shape: tuple[int, ...],
    policy: Array,
    tolerance: float,
    *,
    relative: bool = False,
) -> Solution:
    """The :class:`Solution` at some states, in a shape."""
    value, low, high = (
        x[states].reshape(shape) for x in (values.value, values.lower, values.upper)
    )
    parts: dict[str, Array] = {
        "value": value,
        "policy": policy,
        "nature": values.probability,
        "lower": low,
        "upper": high,
        "residual": np.float64(values.residual),
        "num_steps": np.int32(values.rounds),
        "status": np.int32(status_between(low, high, tolerance, relative=relative)),
    }
    return Solution(**parts, method=values.method)


class Sides(NamedTuple):
    """An uncertain MDP with the directions of policy and nature."""

    maximize: bool  # whether the policy maximises
    helpful: bool  # whether nature maximises
    encoded: EncodedChoices  # the model in which a policy and nature choose, and its origin
    policy: Array | None = None  # a given one

    @property
    def host(self) -> UncertainMDP:
        return self.encoded.model

    def query(self, tolerance: float) -> Query:
        return Query(self.maximize, self.helpful, tolerance)

    @property
    def choosing(self) -> np.ndarray:
        """Rows ``bool[R']`` by which nature chooses among rows, without a step."""
        return self.encoded.row < 0

    @property
    def added(self) -> np.ndarray:
        """Auxiliary states, ``bool[S']``."""
        result: np.ndarray = self.encoded.source != np.arange(self.encoded.source.size)
        return result

    def states(self, quantity: np.ndarray) -> np.ndarray:
        """A set of states ``bool[S']``, without auxiliary ones."""
        result: np.ndarray = quantity[self.encoded.source] & ~self.added
        return result


def sides_of(
    model: Model, policy: Array | None, objective: str, nature: str | None
) -> tuple[IntervalMDP, Sides]:
    """The interval model, and directions of policy and nature, games and given policies encoded."""
    world, system = world_of(model)
    if policy is None:
        return world, host_sides(world.host, system, objective, nature)
    helpful = nature_direction(nature, objective) == "max"
    encoded = _under(world, np.asarray(policy), True if system is None else system)
    # The remaining choices are those of the environment, against the policy.
    against = helpful if system is None else objective == "min"
    return world, Sides(against, helpful, encoded, policy)


def world_of(model: Model) -> tuple[IntervalMDP, np.ndarray | None]:
    """The interval model, and in a game the states of the system."""
    world = model.mdp if isinstance(model, Game) else model
    if isinstance(world, SparseMDP) and isinstance(model, Game):
        world = make_interval(world, world.probability, world.probability)
    if not isinstance(world, IntervalMDP):
        raise ValueError(
            f"model is a {'Game on a ' * isinstance(model, Game)}{type(world).__name__}; give an "
            "IntervalMDP, or a game on one or on a SparseMDP, such as "
            "make_game(to_sparse(game.mdp), game.system.ravel())."
        )
    return world, np.asarray(model.system, bool) if isinstance(model, Game) else None


def host_sides(
    host: UncertainMDP, system: np.ndarray | None, objective: str, nature: str | None
) -> Sides:
    """:func:`sides_of` on the host, without a policy."""
    helpful = nature_direction(nature, objective) == "max"
    maximize = objective == "max"
    if system is None:
        return Sides(maximize, helpful, _rows_of(host, np.arange(host.mdp.num_rows)))
    # The player with nature's objective becomes nature, and the other one is the policy.
    rows = np.ones(host.mdp.num_rows)
    encoded = choices_as_nature(host, system if maximize == helpful else ~system, 0 * rows, rows)
    return Sides(not helpful, helpful, encoded)


def _rows_of(host: UncertainMDP, row: Integers) -> EncodedChoices:
    """The model, or a chain of one row for each state, without choices of nature."""
    model: UncertainMDP = host
    entry: Integers = np.arange(host.mdp.num_transitions)
    if row.size < host.mdp.num_rows:
        model, entry = host.under_policy(row)
    return EncodedChoices(model, np.arange(host.mdp.num_states), row, entry, 0 * entry - 1)


def _under(model: IntervalMDP, policy: np.ndarray, where: Array) -> EncodedChoices:
    """The model under a policy, in all states or in those of one player."""
    host = model.host
    if is_deterministic(policy) and np.all(where):
        row_weights(model.nominal, policy)  # checks it
        return _rows_of(host, policy.astype(np.int64))
    weight = row_weights(model.nominal, policy, where)
    total = host.mdp.over_choices(np.add, weight)
    weight = weight / np.where(total > 0, total, 1)[host.mdp.state]
    return choices_as_nature(host, np.broadcast_to(where, (model.num_states,)), weight, weight)
