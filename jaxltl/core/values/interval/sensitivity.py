"""Derivatives of robust values in the ends of the intervals."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jax.typing import ArrayLike

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.models.interval import IntervalMDP, refuse_ball, require_interval
from jaxltl.core.models.refusals import on_host
from jaxltl.core.models.ops.operators import is_deterministic
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.graph.qualitative import backward_reachable
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.types import Solution
from jaxltl.core import validation
from jaxltl.core.models.protocols import Array
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.values.interval.sides import nature_direction
from jaxltl.core.models.action_numbers import rows_of_policy
from jaxltl.core.values.engine.row_form import row_form


@brief
class Sensitivity(NamedTuple):
    """Derivatives of a value in the ends of intervals, see :func:`robust_sensitivity`.

    Attributes:
      lower, upper: ``float64[T]``, in units of the value for one of probability.

    Example:
      >>> change = Sensitivity(lower=np.zeros(2), upper=np.array([0.0, -1.0]))
      >>> (change.upper @ np.array([0.0, -0.1])).item()  # first-order change of the value
      0.1
    """

    lower: Floats
    upper: Floats


@on_host
def robust_sensitivity(
    model: IntervalMDP,
    solution: Solution,
    target: Array | str,
    *,
    objective: str = "max",
    nature: str | None = None,
    stay: Array | str | None = None,
    initial: ArrayLike | None = None,
) -> Sensitivity:
    """Derivatives of a robust value in the ends of all intervals.

    ``dV = sum_s y(s) (v(t) - v(t*)) d end(s, t)`` with the expected visits ``y = initial + P' y``
    under the policy and nature, a binding end, and t* the successor that gets the remaining mass
    (implicit function theorem). Policy and order of successors are held fixed; with ties, this is
    one of several one-sided derivatives.

    Args:
      model: the model.
      solution: of :func:`reachability_probability` or :func:`total_reward`.
      target, objective, nature, stay: the arguments of that solution.
      initial: ``float[S]``, weights of the states; default the initial distribution.

    Returns:
      :class:`Sensitivity`; ``upper * (model.upper - p) + lower * (model.lower - p)`` estimates the
      effect of narrowing the intervals. Concrete arrays only; not differentiable.

    Raises:
      ValueError: a wrong shape or direction, a policy of weights, a model with a radius, or an
        infinite value from the initial states.

    Example:
      >>> from jaxltl import make_interval, make_sparse
      >>> from jaxltl import reachability_probability
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> model = make_interval(coin, [0.4, 0.3, 1, 1], [0.7, 0.6, 1, 1])
      >>> goal = [False, True, False]
      >>> found = reachability_probability(model, goal, nature="adversarial")
      >>> change = robust_sensitivity(model, found, goal, nature="adversarial", initial=[1, 0, 0])
      >>> change.lower.tolist(), change.upper.tolist()
      ([0.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0])
    """
    maximize = nature_direction(nature, objective) == "max"
    refuse_ball(require_interval(model), "robust_sensitivity is about ends")
    if not isinstance(solution, Solution) or solution.nature is None:
        raise ValueError(
            f"solution is {validation.shorten(solution)}; give what a solver of interval models "
            "returned, reachability_probability, say."
        )
    form = row_form(model)
    goal = form.states("target", target)
    passed = np.ones(goal.size, bool) if stay is None else form.states("stay", stay)
    weight = validation.float_array("initial", model.initial if initial is None else initial)
    value, policy = np.asarray(solution.value, np.float64), np.asarray(solution.policy)
    if weight.shape != goal.shape or value.shape != goal.shape:
        raise ValueError(
            f"initial has shape {weight.shape} and the solution's value "
            f"{value.shape}; expected {goal.shape}, one for each state."
        )
    if policy.shape != goal.shape or not is_deterministic(policy):
        raise ValueError(
            "the solution's policy is no action for each state; weights have no single "
            "order of successors."
        )
    policy = rows_of_policy(model.nominal, policy)
    if not np.isfinite(value[weight > 0]).all():
        raise ValueError(
            "the value from an initial state is infinite, which no end changes a little."
        )
    host = model.host
    value = np.where(np.isfinite(value), value, 0)
    ahead = value[host.mdp.successor]
    chain, entry = host.under_policy(policy)
    chance = np.asarray(solution.nature, np.float64)[entry]
    visits = _visits(chain.resolve(chance), goal, passed, weight)
    change, binds_above = _against_the_rest(host, ahead, maximize)
    taken = np.zeros(host.mdp.num_rows)
    taken[policy] = visits
    change = np.where(taken[host.mdp.row] > 0, change * taken[host.mdp.row], 0)
    return Sensitivity(np.where(binds_above, 0, change), np.where(binds_above, change, 0))


def _visits(chain: HostMDP, goal: Booleans, stay: Booleans, weight: Floats) -> Floats:
    """Expected visits of each state before a goal is reached or lost, ``float64[S]``."""
    from scipy.sparse import csc_array, eye_array
    from scipy.sparse.linalg import splu

    open_ = backward_reachable(chain, goal, stay[chain.state]) & stay & ~goal
    states: Integers = np.flatnonzero(open_)
    visits = np.zeros(goal.size)
    if not (weight[states] != 0).any():
        return visits
    number = np.cumsum(open_) - 1
    kept = open_[chain.state[chain.row]] & open_[chain.successor]
    place = number[chain.successor[kept]], number[chain.state[chain.row[kept]]]
    shape = (states.size, states.size)
    back = csc_array((chain.probability[kept], place), shape=shape)
    visits[states] = splu((eye_array(states.size, format="csc") - back).tocsc()).solve(
        weight[states]
    )
    return visits


def _against_the_rest(host: UncertainMDP, ahead: Floats, maximize: bool) -> tuple[Floats, Booleans]:
    """Gain of each entry over the entry that receives the remaining mass of its row."""
    mdp = host.mdp
    start = mdp.entry_start[:-1]
    key = -ahead if maximize else ahead
    p = host.extreme_distributions(ahead, maximize=maximize)
    free = host.upper > host.lower
    short = free & (p < host.upper)  # those that are not given all that they may take
    rest = np.minimum.reduceat(np.where(short, key, np.inf), start)
    # Where all are, the last of them is the one that would get more.
    last = np.maximum.reduceat(np.where(free, key, -np.inf), start)
    rest = np.where(np.isfinite(rest), rest, np.where(np.isfinite(last), last, key[start]))
    change = key - rest[mdp.row]
    return (-change if maximize else change), change < 0
