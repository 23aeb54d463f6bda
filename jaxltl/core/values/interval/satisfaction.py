"""Robust satisfaction probability of LTL formulas in interval MDPs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.values.engine.validated import validated
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.runs import live_states, universal_states
from jaxltl.core.automata.translate import Task
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.ops.operators import is_deterministic, require_weights
from jaxltl.core.models.product import Product
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.interval.game_encoding import let_nature_choose
from jaxltl.core.sparse.interval.l1_ball import Ball
from jaxltl.core.sparse.interval.parity import parity_against_nature
from jaxltl.core.sparse.interval.qualitative import joint_accepting_region
from jaxltl.core.sparse.interval.reachability import reachability
from jaxltl.core.sparse.interval.robust_values import Query, RobustValues
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.product import SparseProduct, sparse_product
from jaxltl.core.types import Solution, Status, require_shape, row_tolerance
from jaxltl.core.values import facts
from jaxltl.core.values.interval.robust import Sides, host_sides, width_asked, world_of
from jaxltl.core.values.undiscounted.sparse_satisfaction import (
    automaton_and_letters,
    starting_states,
)


@brief(facts=facts.satisfaction)
class RobustSatisfaction(NamedTuple):
    """Robust satisfaction probability, with a finite-memory policy and nature's choices.

    Attributes:
      solution: value, lower and upper are ``float64[I]``, one for each state that was asked for;
        `policy` is ``int32[N]``, the world's row in each state of the product, and `nature`
        ``float64[T']``, its distributions.
      automaton: the task, over the letters that occur; letters are read as a state is left.
      letter: ``int[S]``, the letter that each state shows.
      product: what is reached of the model beside the automaton, N states.
      value: ``float64[N]``, in each of them.

    Example:
      >>> from jaxltl.core.models import interval_rows
      >>> model = interval_rows(None, [0, 2, 3, 4], [1, 2, 1, 2], [.4, .3, 1, 1], [.7, .6, 1, 1],
      ...                       initial=[1, 0, 0], label=[[0], [1], [0]], propositions=["a"])
      >>> found = robust_satisfaction(model, "F a")
      >>> found.solution.value.round(6).tolist(), found.product.base_state.tolist()
      ([0.4], [0, 1, 1, 2])
    """

    solution: Solution
    automaton: Automaton
    letter: np.ndarray
    product: SparseProduct
    value: np.ndarray


@validated()
def robust_satisfaction(
    model: Any,
    task: Task,
    *,
    objective: str = "max",
    nature: str | None = None,
    states: Any = None,
    tolerance: float | None = None,
) -> RobustSatisfaction:
    """Robust satisfaction probability of an LTL formula in an interval MDP.

    In the product with the formula's automaton: where policy and nature want the same, they reach
    the end components that both can keep to (Baier and Katoen 2008, section 10.6.4, with nature's
    choices as actions). Where they want the opposite it is a stochastic parity game; with lower
    ends of 0 nature may cut edges, so that neither the graph nor its end components are fixed.

    Args:
      model: an IntervalMDP, or a game on one (or on a sparse model).
      task: a formula, its text, or an automaton over the letters that occur in the model.
      objective: ``"max"`` or ``"min"``, what the policy (the system) makes of the probability.
      nature: ``"adversarial"`` (default), against the objective, or ``"cooperative"``.
      states: ``int[I]``, where runs start; default the initial states.
      tolerance: the width of the enclosure asked for, 1e-6.

    Returns:
      :class:`RobustSatisfaction`.

    Raises:
      ValueError: an unknown label, state or direction, or a product beyond 2^31 states.

    Concrete arrays only, on the host; not differentiable.

    Example:
      >>> from jaxltl.core.models import interval_rows
      >>> model = interval_rows(None, [0, 2, 3, 4], [1, 2, 1, 2], [.4, .3, 1, 1], [.7, .6, 1, 1],
      ...                       initial=[1, 0, 0], label=[[0], [1], [0]], propositions=["a"])
      >>> robust_satisfaction(model, "F G a").solution.value.tolist()
      [0.4]
    """
    model, system = world_of(model)
    asked = width_asked(tolerance)
    automaton, letter = automaton_and_letters(model.nominal, task)
    states = starting_states(model, states)
    yes, no = universal_states(automaton), ~live_states(automaton)
    initial = np.broadcast_to(automaton.initial, states.shape)
    product, host = _pairs(
        model, np.asarray(automaton.delta), letter, states, initial, yes | no, False
    )
    priority = None
    if automaton.acceptance in ("buchi", "parity"):
        source = product.memory, letter[product.base_state]
        priority = np.asarray(automaton.priority)[source]
    moves = None if system is None else system[product.base_state]
    found = _solved(
        host_sides(host, moves, objective, nature),
        host,
        yes[product.memory],
        no[product.memory],
        priority,
        automaton.acceptance == "safety",
        asked,
    )
    solution = _solution(
        found,
        asked,
        product.start.shape,
        product.start,
        policy=product.base_row[found.row].astype(np.int32),
    )
    return RobustSatisfaction(solution, automaton, letter, product, found.value)


def _solution(
    found: RobustValues, tolerance: float, shape: tuple[int, ...], states: Integers, policy: Any
) -> Solution:
    """The :class:`Solution` at some states of the product."""
    low, high = (x[states].reshape(shape) for x in (found.lower, found.upper))
    status = Status.CONVERGED if (high - low <= tolerance).all() else Status.PRECISION
    parts: dict[str, Any] = {
        "value": found.value[states].reshape(shape),
        "policy": policy,
        "lower": low,
        "upper": high,
        "nature": found.probability,
        "residual": np.float64(found.residual),
        "num_steps": np.int32(found.rounds),
        "status": np.int32(status),
    }
    return Solution(**parts, method=found.method)


@validated()
def robust_product_satisfaction(
    model: Product,
    *,
    policy: Any = None,
    objective: str = "max",
    nature: str | None = None,
    tolerance: Any = None,
) -> Solution:
    """Robust satisfaction probability from all states of a product of an interval MDP.

    Raises:
      ValueError: the product's actions are restricted, or a policy is none.

    Concrete arrays only, on the host; not differentiable.
    """
    if not isinstance(model, Product) or not isinstance(model.mdp, IntervalMDP):
        raise ValueError(
            f"{type(model).__name__} is no product of an interval model; give "
            "product(model, formula)."
        )
    if model.allowed is not None:
        raise ValueError(
            "a product of an interval model takes no mask of actions; restrict the "
            "world by with_allowed(world, rows)."
        )
    asked = width_asked(tolerance)
    world: Any = model.mdp
    task, letter, shape = model.automaton, np.asarray(model.letter), model.state_shape
    delta, priority = np.asarray(task.delta), np.asarray(task.priority)
    yes, no = universal_states(task), ~live_states(task)
    state, memory = (x.ravel() for x in np.indices(shape))
    on_entry = model.label_on == "entry"
    product, host = _pairs(world, delta, letter, state, memory, yes & False, on_entry)
    pair: Integers = np.arange(product.memory.size)
    level = None
    if task.acceptance in ("buchi", "parity"):
        level = priority[product.memory, letter[product.base_state]]
        if on_entry:
            mdp = host.mdp
            read = priority[
                product.memory[mdp.state[mdp.row]], letter[product.base_state[mdp.successor]]
            ]
            host, level, pair = _reading(host, read)
    sides = host_sides(host, None, objective, nature)
    if policy is not None:
        sides = _fixed(model, product, host, np.asarray(policy), sides.helpful)
    q = product.memory[pair]
    found = _solved(sides, host, yes[q], no[q], level, task.acceptance == "safety", asked)
    if policy is not None:
        solution = _solution(found, asked, shape, product.start, np.asarray(policy))
        return solution.replace(nature=None)  # type: ignore[attr-defined]
    policy = product.base_row[found.row[product.start]].astype(np.int32).reshape(shape)
    found = replace(found, probability=found.probability[: product.host.num_transitions])
    return _solution(found, asked, shape, product.start, policy)


def _reading(host: UncertainMDP, priority: Integers) -> tuple[UncertainMDP, Integers, Integers]:
    """The model in which auxiliary states with one choice carry the priorities of entries."""
    mdp, most = host.mdp, int(priority.max()) + 1
    place, number = np.unique(mdp.successor.astype(np.int64) * most + priority, return_inverse=True)
    target, read = np.divmod(place, most)
    one, more = np.ones(place.size), np.arange(1, place.size + 1)
    inner = HostMDP(
        np.append(mdp.row_start, mdp.num_rows + more),
        np.append(mdp.entry_start, mdp.num_transitions + more),
        np.append(mdp.num_states + number, target).astype(np.int32),
        np.append(mdp.probability, one),
    )
    ball = host.ball
    if ball is not None:
        ball = Ball(np.append(ball.center, one), np.append(ball.gain, one))
    level = np.append(np.full(mdp.num_states, most - 1), read)
    return (
        UncertainMDP(inner, np.append(host.lower, one), np.append(host.upper, one), ball),
        level,
        np.append(np.arange(mdp.num_states), target),
    )


def _pairs(
    model: IntervalMDP,
    delta: np.ndarray,
    letter: np.ndarray,
    state: Integers,
    memory: Integers,
    still: Booleans,
    on_entry: bool,
) -> tuple[SparseProduct, UncertainMDP]:
    """The reachable product, with its intervals."""
    mdp = model.nominal.host
    # Entries travel by number, from 1; a loop of what stands still has 1 too.
    numbered = HostMDP(
        mdp.row_start, mdp.entry_start, mdp.successor, np.arange(1.0, mdp.num_transitions + 1)
    )
    found = sparse_product(numbered, delta, letter, state, memory, on_entry=on_entry, still=still)
    entry = found.host.probability.astype(np.int64) - 1
    loop = found.still[found.host.state[found.host.row]]
    chance, lower, upper = (
        np.where(loop, 1.0, x[entry]) for x in (mdp.probability, model.host.lower, model.host.upper)
    )
    ball = model.host.ball
    if ball is not None:
        ball = ball.select(entry, found.base_row)
        ball = replace(ball, center=np.where(loop, 1.0, ball.center))
    host = HostMDP(found.host.row_start, found.host.entry_start, found.host.successor, chance)
    return found._replace(host=host), UncertainMDP(host, lower, upper, ball)


def _fixed(
    model: Product, product: SparseProduct, host: UncertainMDP, policy: np.ndarray, helpful: bool
) -> Sides:
    """The product under a finite-memory policy."""
    world: Any = model.mdp
    mine = product.host.state
    memory = product.memory[mine]
    if is_deterministic(policy):
        require_shape("policy", policy, model.state_shape)
        taken = policy[product.base_state[mine], memory] == product.base_row
        weight = taken.astype(np.float64)
    else:
        require_shape("policy", policy, (world.num_rows, model.num_memory))
        weight = policy[product.base_row, memory].astype(np.float64)
    weight = np.append(weight, np.ones(host.mdp.num_rows - weight.size))  # where nobody chooses
    dtype = policy.dtype if policy.dtype.kind == "f" else np.float64
    require_weights(host.mdp, weight, row_tolerance(dtype))
    weight = weight / host.mdp.over_choices(np.add, weight)[host.mdp.state]
    parted = let_nature_choose(host, np.ones(host.mdp.num_states, bool), weight, weight)
    return Sides(None, parted.model, helpful, helpful, parted, policy)


def _solved(
    sides: Sides,
    host: UncertainMDP,
    yes: Booleans,
    no: Booleans,
    priority: Integers | None,
    safety: bool,
    tolerance: float,
) -> RobustValues:
    """Robust satisfaction probability from all states of the product."""
    maximize, helpful = sides.maximize, sides.helpful
    if sides.spread is None:
        return _of_sides(host, yes, no, priority, maximize, helpful, safety, tolerance)
    source = sides.spread.source
    found = _of_sides(
        sides.host,
        yes[source],
        no[source],
        None if priority is None else priority[source],
        maximize,
        helpful,
        safety,
        tolerance,
    )
    size = host.mdp.num_states
    return replace(
        found,
        value=found.value[:size],
        lower=found.lower[:size],
        upper=found.upper[:size],
        row=sides.spread.policy(found.row, found.probability),
        probability=sides.spread.nature(found.probability, host.mdp.probability),
    )


def _of_sides(
    host: UncertainMDP,
    yes: Booleans,
    no: Booleans,
    priority: Integers | None,
    maximize: bool,
    helpful: bool,
    safety: bool,
    tolerance: float,
) -> RobustValues:
    """Robust satisfaction probability for one policy and nature."""
    if priority is None:
        goal = no if safety else yes
        if safety:
            return reachability(
                host, goal, Query(not maximize, not helpful, tolerance)
            ).complement()
        return reachability(host, goal, Query(maximize, helpful, tolerance))
    if not maximize:
        # The least probability is one minus the largest of the opposite.
        priority = np.where(no, 0, np.where(yes, 1, priority + 1))
        return _largest(host, priority, not helpful, tolerance).complement()
    priority = np.where(yes, 0, np.where(no, 1, priority))
    return _largest(host, priority, helpful, tolerance)


def _largest(
    host: UncertainMDP, priority: Integers, helpful: bool, tolerance: float
) -> RobustValues:
    """Maximal parity probability, for both readings of sums within rounding of one."""
    found = _as_read(host, priority, helpful, tolerance)
    wide = host.enlarged
    if wide is None:
        return found
    return found.hull(_as_read(wide, priority, helpful, tolerance))


def _as_read(
    host: UncertainMDP, priority: Integers, helpful: bool, tolerance: float
) -> RobustValues:
    if not helpful:
        return parity_against_nature(host, priority, tolerance=tolerance)
    mdp = host.mdp
    good = joint_accepting_region(host, priority[mdp.state[mdp.row]])
    found = reachability(host, good.region, Query(True, True, tolerance))
    inside: Floats = np.where(good.region[mdp.state[mdp.row]], good.probability, found.probability)
    return replace(found, row=np.where(good.region, good.row, found.row), probability=inside)
