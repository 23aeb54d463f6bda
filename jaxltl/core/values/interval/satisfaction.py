"""Robust satisfaction probability of LTL formulas in interval MDPs."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.runs import live_states, universal_states
from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.models.action_numbers import row_actions
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.sparse.interval.l1_ball import Ball
from jaxltl.core.sparse.interval.parity import parity_against_nature
from jaxltl.core.sparse.interval.qualitative import joint_accepting_region
from jaxltl.core.sparse.interval.reachability import reachability
from jaxltl.core.sparse.interval.robust_values import Query, RobustValues
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.models.product_policy import ProductPolicy
from jaxltl.core.sparse.product import SparseProduct, sparse_product
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import Accuracy, Question
from jaxltl.core.values.engine.host_solution import status_between, with_given_policy
from jaxltl.core.values.engine.row_form import row_form
from jaxltl.core.values.interval.sides import (
    TOLERANCE,
    PlayerAims,
    Sides,
    directions,
    pure_rows,
    requested_width,
    sides_of,
)
from jaxltl.core.values.undiscounted.sparse_satisfaction import (
    automaton_and_letters,
    weights_of_starts,
)


class _Verdicts(NamedTuple):
    """Accepting and rejecting states of a product, and priorities of the others."""

    accepting: Booleans
    rejecting: Booleans
    priority: Integers | None = None  # of Buchi and parity acceptance
    safety: bool = False

    def of(self, state: Integers) -> _Verdicts:
        priority = None if self.priority is None else self.priority[state]
        return _Verdicts(self.accepting[state], self.rejecting[state], priority, self.safety)


def robust_satisfaction(
    model: Model,
    formula: FormulaLike,
    *,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    states: ArrayLike | None = None,
    tolerance: jax.Array | float | None = None,
) -> Solution:
    """Satisfaction probability of a formula in an interval MDP or a game; labels are read on exit."""
    form, aims = row_form(model), directions(objective, nature, environment)
    world, requested = form.uncertain, requested_width(tolerance)
    automaton, letter = automaton_and_letters(world.nominal, formula)
    first, initial = weights_of_starts(world, states)
    start = first, np.broadcast_to(automaton.initial, first.shape)
    product, host, verdicts = _product(
        world, automaton, letter, start, on_entry=False, is_absorbing=True
    )
    system = None if form.system is None else form.system[product.base_state]
    values = _solved(host, system, aims, verdicts, requested)
    row: Array = product.base_row[values.row].astype(np.int32)
    solution = _solution_at(values, product.start, product.start.shape, requested)
    actions: Array = row_actions(world.nominal)[row].astype(np.int32)
    on_product = ProductPolicy(automaton, letter, product, row, values.value, "exit")
    return replace(solution, policy=actions, product_policy=on_product, initial=initial)


def accept_with_nature(model: Model, question: Question, accuracy: Accuracy) -> Solution:
    """Probability of acceptance from all states of a product of an interval model, or of a game."""
    form, policy = row_form(model), question.policy
    lazy = form.lazy
    assert isinstance(lazy, Product)
    if lazy.allowed is not None:
        raise ValueError(
            "a product of a game or an interval model takes no mask of actions; restrict the "
            "world by with_allowed(world, rows)."
        )
    requested, shape = accuracy.width(TOLERANCE), form.shape
    world = row_form(form.world).uncertain
    state, memory = (x.ravel() for x in np.indices(shape))
    product, host, verdicts = _product(
        world,
        lazy.automaton,
        np.asarray(lazy.letter),
        (state, memory),
        on_entry=lazy.label_on == "entry",
        is_absorbing=False,
    )
    aims = directions(question.objective, question.nature, question.environment)
    weights, system = None if policy is None else form.weights(policy), form.system
    # The states that read priorities on entry have one choice.
    if system is not None:
        system = np.append(system, np.ones(host.mdp.num_states - system.size, bool))
    if weights is not None:
        weights = np.append(weights, np.ones(host.mdp.num_rows - weights.size))
    values = _solved(host, system, aims, verdicts, requested, weights)
    solution = _solution_at(values, product.start, shape, requested)
    parts: dict[str, Array] = {"nature": None}
    if policy is None:
        row = product.base_row[values.row[product.start]]
        parts["policy"] = row_actions(world.nominal)[row].astype(np.int32).reshape(shape)
        if form.interval is not None:
            parts["nature"] = values.probability[: product.host.num_transitions]
    return with_given_policy(replace(solution, **parts), policy)


def _product(
    world: IntervalMDP,
    automaton: Automaton,
    letter: Integers,
    start: tuple[Integers, Integers],
    *,
    on_entry: bool,
    is_absorbing: bool,
) -> tuple[SparseProduct, UncertainMDP, _Verdicts]:
    """The product, its uncertain MDP, and the verdicts of its states, which may be absorbing."""
    yes, no = universal_states(automaton), ~live_states(automaton)
    still = yes | no if is_absorbing else None
    delta, priority = np.asarray(automaton.delta), np.asarray(automaton.priority)
    numbered = sparse_product(
        _numbered(world), delta, letter, start, on_entry=on_entry, still=still
    )
    product, host = _uncertain(world, numbered)
    pair: Integers = np.arange(product.memory.size)
    level: Integers | None = None
    if not automaton.has_final_states:
        level = priority[product.memory, letter[product.base_state]]
        if on_entry:
            mdp = host.mdp
            memory = product.memory[mdp.state[mdp.row]]
            read = priority[memory, letter[product.base_state[mdp.successor]]]
            host, level, pair = _reading(host, read)
    q = product.memory[pair]
    return product, host, _Verdicts(yes[q], no[q], level, automaton.is_safety)


def _reading(host: UncertainMDP, priority: Integers) -> tuple[UncertainMDP, Integers, Integers]:
    """The model in which auxiliary states with one choice carry the priorities of entries."""
    mdp, highest = host.mdp, int(priority.max()) + 1
    place, number = np.unique(
        mdp.successor.astype(np.int64) * highest + priority, return_inverse=True
    )
    target, read = np.divmod(place, highest)
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
    level = np.append(np.full(mdp.num_states, highest - 1), read)
    return (
        UncertainMDP(inner, np.append(host.lower, one), np.append(host.upper, one), ball),
        level,
        np.append(np.arange(mdp.num_states), target),
    )


def _numbered(model: IntervalMDP) -> HostMDP:
    """The model with the numbers of entries, from 1, in place of probabilities."""
    mdp = model.nominal.host
    number = np.arange(1.0, mdp.num_transitions + 1)
    return HostMDP(mdp.row_start, mdp.entry_start, mdp.successor, number)


def _uncertain(model: IntervalMDP, product: SparseProduct) -> tuple[SparseProduct, UncertainMDP]:
    """The product of a numbered model, with its probabilities and its intervals."""
    mdp = model.nominal.host
    # The loop of an absorbing state has the number 1, too.
    entry = product.host.probability.astype(np.int64) - 1
    loop = product.still[product.host.state[product.host.row]]
    chance, lower, upper = (
        np.where(loop, 1.0, x[entry]) for x in (mdp.probability, model.host.lower, model.host.upper)
    )
    ball = model.host.ball
    if ball is not None:
        ball = ball.select(entry, product.base_row)
        ball = replace(ball, center=np.where(loop, 1.0, ball.center))
    host = HostMDP(product.host.row_start, product.host.entry_start, product.host.successor, chance)
    return product._replace(host=host), UncertainMDP(host, lower, upper, ball)


def _solution_at(
    values: RobustValues, states: Integers, shape: tuple[int, ...], tolerance: float
) -> Solution:
    """The :class:`Solution` at some states, in a shape, without a policy."""
    value, low, high = (
        x[states].reshape(shape) for x in (values.value, values.lower, values.upper)
    )
    status = status_between(low, high, float(tolerance), relative=False)
    parts: dict[str, Array] = {
        "value": value,
        "policy": np.zeros(shape, np.int32),
        "nature": values.probability,
        "lower": low,
        "upper": high,
        "residual": np.float64(values.residual),
        "num_steps": np.int32(values.rounds),
        "status": np.int32(status),
    }
    return Solution(**parts, method=values.method)


def _solved(
    host: UncertainMDP,
    system: Booleans | None,
    aims: PlayerAims,
    verdicts: _Verdicts,
    tolerance: float,
    weights: Floats | None = None,
) -> RobustValues:
    """Robust satisfaction probability from all states of the product."""

    def solve(sides: Sides) -> RobustValues:
        return _of_sides(sides.host, verdicts.of(sides.encoded.source), sides.query(tolerance))

    sides = sides_of(host, system, aims, weights)
    size, encoded, values = host.mdp.num_states, sides.encoded, solve(sides)
    probability = encoded.nature(values.probability, host.mdp.probability)
    row = encoded.policy(values.row, values.probability)
    cooperates = system is not None and weights is None and aims.system == aims.nature
    if cooperates and sides.is_mixed(values.probability):
        assert system is not None
        row = pure_rows(host, system, aims, probability, solve)
    return replace(
        values,
        value=values.value[:size],
        lower=values.lower[:size],
        upper=values.upper[:size],
        row=row,
        probability=probability,
    )


def _of_sides(host: UncertainMDP, verdicts: _Verdicts, query: Query) -> RobustValues:
    """Robust satisfaction probability for one policy and nature."""
    yes, no, priority, safety = verdicts
    if priority is None:
        if safety:
            return reachability(host, no, query.opposite).complement()
        return reachability(host, yes, query)
    if not query.maximize:
        # The least probability is one minus the largest of the opposite.
        priority = np.where(no, 0, np.where(yes, 1, priority + 1))
        return _largest(host, priority, query.opposite).complement()
    priority = np.where(yes, 0, np.where(no, 1, priority))
    return _largest(host, priority, query)


def _largest(host: UncertainMDP, priority: Integers, query: Query) -> RobustValues:
    """Maximal parity probability, for both readings of sums within rounding of one."""
    values = _as_read(host, priority, query)
    wide = host.enlarged
    return values if wide is None else values.hull(_as_read(wide, priority, query))


def _as_read(host: UncertainMDP, priority: Integers, query: Query) -> RobustValues:
    if not query.nature_maximizes:
        return parity_against_nature(host, priority, tolerance=query.tolerance)
    mdp = host.mdp
    good = joint_accepting_region(host, priority[mdp.state[mdp.row]])
    values = reachability(host, good.region, query)
    inside: Floats = np.where(good.region[mdp.state[mdp.row]], good.probability, values.probability)
    return replace(values, row=np.where(good.region, good.row, values.row), probability=inside)
