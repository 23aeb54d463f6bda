"""Undiscounted values inside ``jit`` and over a mesh: reachability of policies and optima.

Where a probability is exactly 0 or 1 is decided on the graph. In between, a policy's value is a
linear system, certified by its residual. With end components collapsed, the optimum of a small model
is the total reward of entering the target, by policy iteration; that of a large one, or of one over
a mesh, is enclosed by interval iteration.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.graphs.attractor import attract
from jaxltl.core.graphs.end_components import EndComponents, components_within
from jaxltl.core.graphs.graph import TracedGraph, graph_of, take
from jaxltl.core.graphs.attractor import Sets, max_sets, min_sets, policy_sets
from jaxltl.core.models.mesh.sharded import is_sharded
from jaxltl.core.models.ops.array_namespace import jit, is_traced, to_jax
from jaxltl.core.models.ops.double_word import double_word, normalised_rows
from jaxltl.core.models.ops.operators import (
    combined,
    action_argmax,
    expectation,
    is_representable,
    policy_operator,
    valid_policy,
)
from jaxltl.core.models.ops.successor_tables import action_columns, sweep_operator
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import ActionModel, Array, PyTree
from jaxltl.core.types import Solution, status_code
from jaxltl.core.values.engine.certificates import m_matrix_error, refuse, rounding_unit, underflow
from jaxltl.core.values.engine.implicit_diff import ChainSystem, with_derivative
from jaxltl.core.values.engine.iterate import sequential_vmap, iterate
from jaxltl.core.values.engine.linear import System, is_small, most_products, solver
from jaxltl.core.values.undiscounted.traced_total_reward import TotalRewardProblem, solve_problem

_POLICY_SWEEPS = 8  # sweeps under the greedy policy for one of the optimality operator
_FINER = 8  # factor by which a guess is narrower than the bounds, once these meet the goal
_SWEEPS = 1_000_000  # of interval iteration
_GUESS_SWEEPS = 6  # sweeps of a guess, or of interval iteration after one that failed


# --- a policy: a linear system with a certificate -------------------------------------------------


@jit("method")
def policy_reachability(
    model: ActionModel,
    policy: jax.Array,
    target: jax.Array,
    tolerance: jax.Array | float | None,
    max_steps: jax.Array | int,
    *,
    method: str,
) -> Solution:
    """The solution of ``y = P_pi y`` on the undecided states, enclosed by an M-matrix bound."""
    target = jnp.asarray(target, bool)
    checked = valid_policy(model, policy)
    policy = checked.distribution
    constant = lax.stop_gradient((model, policy))
    sets = policy_sets(TracedGraph(constant[0]), target, constant[1])
    undecided = ~(sets.one | sets.zero)
    one = sets.one.astype(model.dtype)
    weight = action_columns(model.num_actions, constant[1])
    scale = undecided.ravel().astype(model.dtype)
    system = System(sweep_operator(constant[0]), weight, scale)
    eliminable = method == "auto" and not is_sharded(model)
    if eliminable:  # Krylov steps stagnate in chains that take very long; then elimination follows
        max_steps = jnp.minimum(max_steps, most_products(model.num_states))
    linear = solver(system, method, max_steps=max_steps)

    chain = ChainSystem(*constant, undecided)
    goal, rows = 2 * _half_width(model, tolerance), normalised_rows(*constant)

    def eliminated() -> tuple[jax.Array, ...]:
        return m_matrix_error(rows, chain.solve, chain.solve(one), one, undecided)

    start, n = linear.counted(one)
    enclosure = m_matrix_error(rows, linear.solve, start, one, undecided)
    if eliminable and linear.inverse is None:
        # Without a proof the width is 1, which a loose tolerance admits.
        narrow = jnp.max(enclosure[2] - enclosure[1]) <= jnp.minimum(goal, 0.5)
        enclosure = lax.cond(narrow, lambda: enclosure, eliminated)
    value, lower, upper, residual = lax.stop_gradient(enclosure)
    solution = Solution(
        value=value,
        policy=constant[1],
        lower=lower,
        upper=upper,
        residual=residual,
        num_steps=n,
        # The error of elimination is rounding, so more steps would not help.
        status=status_code(
            jnp.max(upper - lower) <= goal, jnp.isfinite(residual), linear.inverse is not None
        ),
    )
    inverse = None if linear.inverse is None else linear
    chain = ChainSystem(model, policy, undecided)
    value = with_derivative(value, chain, target=target, one=one, inverse=inverse)
    solution = replace(lax.stop_gradient(solution), value=value, policy=policy)
    return refuse(solution, checked)


def _half_width(model: ActionModel, tolerance: jax.Array | float | None) -> jax.Array:
    if tolerance is None:
        return jnp.sqrt(jnp.finfo(model.dtype).eps).astype(model.dtype)
    return jnp.asarray(tolerance, model.dtype) / 2


# --- optima: interval iteration -------------------------------------------------------------------


def optimal_reachability(
    model: ActionModel,
    target: jax.Array,
    tolerance: jax.Array | float | None,
    max_steps: jax.Array | int | None,
    start: tuple[jax.Array, jax.Array] | None,
    *,
    objective: str,
) -> Solution:
    """An enclosed optimum; the graph of a concrete model stays on the host."""
    # `max_steps` and `start` are options of interval iteration, which they select.
    if is_traced((model, target, tolerance, max_steps, start)):
        return _inside_jit(model, target, tolerance, max_steps, start, objective=objective)
    sets, components = _qualitative(model, target, objective=objective)
    if components is not None and not components.inside.any():
        components = None
    sets, components = to_jax((sets, components))
    options = tolerance, max_steps, start
    return _optimize(model, target, sets, components, options, objective=objective)


@jit("objective")
def _inside_jit(
    model: ActionModel, target: jax.Array, *options: PyTree, objective: str
) -> Solution:
    sets, components = sequential_vmap(partial(_qualitative, objective=objective), model, target)
    return _optimize(model, target, sets, components, options, objective=objective)


def _qualitative(
    model: ActionModel, target: jax.Array, *, objective: str
) -> tuple[Sets, EndComponents | None]:
    """Prob0 and prob1 states, and for a maximum the end components among the others."""
    graph = graph_of(model, target)
    target = take(graph, target)
    if objective == "min":
        return min_sets(graph, target), None
    sets = max_sets(graph, target)
    return sets, components_within(graph, ~(sets.one | sets.zero))


class _ReachabilitySearch(NamedTuple):
    """An optimal reachability problem, as the maximum of ``y = sign * probability``."""

    # A policy attains the lower bound of y. Both bounds are rounded outwards: sums of terms of one
    # sign err by a share `slack` of them, and by `underflow` where products underflow.

    model: ActionModel
    undecided: jax.Array
    decided: jax.Array  # y elsewhere
    components: EndComponents | None
    goal: jax.Array  # half of the width
    sign: jax.Array | int

    @property
    def slack(self) -> jax.Array | float:
        return rounding_unit(self.model)

    def choose(self, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The largest value of actions that leave the state's end component, and the action."""
        allowed = self.model.available
        if self.components is not None:
            allowed &= ~self.components.inside
        return action_argmax(expectation(self.model, y), allowed)

    def image(self, y: jax.Array) -> jax.Array:
        return self.outside(_collapse(self.components, self.choose(y)[0]))

    def outside(self, y: jax.Array) -> jax.Array:
        return jnp.where(self.undecided, y, self.decided)

    def rounded(self, image: jax.Array, end: int) -> jax.Array:
        """An image rounded upwards, for `end` 1, or downwards, for -1."""
        error = self.slack * jnp.abs(image) + underflow(self.model)
        return self.outside(self.clipped(image + end * error))

    def clipped(self, y: jax.Array) -> jax.Array:
        return jnp.clip(y, jnp.minimum(self.sign, 0), jnp.maximum(self.sign, 0))


class _ReachabilityBounds(NamedTuple):
    lower: jax.Array
    upper: jax.Array
    failed: jax.Array  # whether the last guess was no bound
    ended: jax.Array

    @property
    def half(self) -> jax.Array:
        return jnp.max(self.upper - self.lower) / 2


def _tighter(
    finest: bool, table: None, bounds: _ReachabilityBounds, search: _ReachabilitySearch
) -> _ReachabilityBounds:
    """One round: a sweep, and some under the greedy policy, for `lower`; some for `upper`."""
    # A value that the operator does not carry away from the optimum is a bound, because the fixed
    # point is unique where end components are collapsed; so `upper` is guessed, and where the guess
    # fails, plain interval iteration continues. Where the bounds are to be the finest, this continues
    # beyond the goal: a guess is then a bound of the same shape that is `_FINER` times as near.
    lower, upper, failed, _ = bounds
    value, action = search.choose(lower)
    image = search.outside(_collapse(search.components, value))
    close = jnp.bool_(finest) & (bounds.half <= search.goal)
    aim = jnp.where(close, bounds.half / _FINER, search.goal)
    settled = jnp.max(jnp.abs(image - lower)) <= aim / 32
    raised = jnp.maximum(lower, search.rounded(image, -1))
    if search.components is None and not isinstance(search.model, Product):
        # Sweeps under a policy gather single states; those of a product gather rows.
        raised = _followed(search, raised, action)

    def lowered() -> tuple[jax.Array, jax.Array]:
        # The guess is `raised` moved by almost the tolerance; some sweeps give it its shape.
        guesses = settled & ~failed
        beyond = jnp.where(close, (upper - raised) / _FINER, 1.8 * search.goal)
        start = jnp.where(guesses, search.outside(search.clipped(raised + beyond)), upper)

        def sweep(_: int, pair: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            image = search.rounded(search.image(pair[1]), 1)
            return pair[1], jnp.where(guesses, image, jnp.minimum(image, pair[1]))

        before, after = lax.fori_loop(0, _GUESS_SWEEPS, sweep, (start, start))
        proven = jnp.all(after <= before)
        return jnp.where(proven, jnp.minimum(upper, after), upper), ~proven

    gain = jnp.max(raised - lower)
    rests = close & (gain <= search.slack / 8)
    new, failed = lax.cond(settled | rests, lowered, lambda: (upper, failed))
    drop = jnp.max(upper - new)
    rests &= ~failed & (drop <= search.slack / 8)
    moved = (gain > 0) | (drop > 0) | failed
    bounds_after = _ReachabilityBounds(raised, new, failed, ~moved)
    return bounds_after._replace(
        ended=~moved | (rests if finest else bounds_after.half <= search.goal)
    )


def _followed(search: _ReachabilitySearch, lower: jax.Array, action: jax.Array) -> jax.Array:
    onward = policy_operator(search.model, action)

    def sweep(_: int, y: jax.Array) -> jax.Array:
        image = search.outside(onward(y.ravel()).reshape(y.shape))
        return jnp.maximum(y, search.rounded(image, -1))

    result: jax.Array = lax.fori_loop(0, _POLICY_SWEEPS, sweep, lower)
    return result


@jit("objective")
def _optimize(
    model: PyTree,
    target: jax.Array,
    sets: Sets,
    components: EndComponents | None,
    options: PyTree,
    *,
    objective: str,
) -> Solution:
    constant, options = lax.stop_gradient((model, options))
    tolerance, max_steps, start = options
    undecided = ~(sets.one | sets.zero)
    one = sets.one.astype(model.dtype)
    small = is_small(sweep_operator(constant), one.size) and max_steps is None and start is None
    # A user's model may lack the reduction that double words need.
    small = small and combined.dispatch(type(model)) is not combined.dispatch(object)
    if small:
        run = partial(_by_policy_iteration, objective=objective)
        requested = 2 * _half_width(model, tolerance)
        solution = sequential_vmap(run, constant, sets, components, requested)
    else:
        solution = _by_intervals(constant, sets, components, options, objective=objective)
    code = status_code(True, True, valid=is_representable(constant))
    solution = replace(solution, status=jnp.maximum(solution.status, code))
    solution = jax.tree.map(lax.stop_gradient, solution)
    chain = ChainSystem(model, solution.policy, undecided)
    value = with_derivative(solution.value, chain, target=jnp.asarray(target, bool), one=one)
    result: Solution = replace(solution, value=value)
    return result


def _by_policy_iteration(
    model: ActionModel,
    sets: Sets,
    components: EndComponents | None,
    requested: Array,
    *,
    objective: str,
) -> Solution:
    """An optimum as the total reward of entering the target."""
    rows, one = normalised_rows(model), sets.one.astype(model.dtype)
    leaving = model.available if components is None else model.available & ~components.inside
    sign, gain = 1 if objective == "max" else -1, rows.expectation(double_word(one))
    open_, finite = ~(sets.one | sets.zero), sets.one | True
    problem = TotalRewardProblem(
        rows, sign, gain, None, open_, finite, leaving, None, sets.action, components, highest=1
    )
    finest = max(4 * float(jnp.finfo(model.dtype).eps), 1e-12)
    solution = solve_problem(problem, jnp.minimum(requested, finest), requested)
    value, lower, upper = (
        jnp.where(open_, x, one) for x in (solution.value, solution.lower, solution.upper)
    )
    return replace(solution, value=value, lower=lower, upper=upper)


def _by_intervals(
    model: PyTree, sets: Sets, components: EndComponents | None, options: PyTree, *, objective: str
) -> Solution:
    """Encloses an optimum between a bound that a policy attains and one that is proven."""
    # Sweeps under its own greedy policy move the attained bound soundly and cheaply.
    (tolerance, max_steps, start), sign = options, 1 if objective == "max" else -1
    undecided, one = ~(sets.one | sets.zero), sets.one.astype(model.dtype)
    goal = _half_width(model, tolerance)
    search = _ReachabilitySearch(model, undecided, sign * one, components, goal, sign)
    ends = (0, 1) if start is None else (jnp.clip(x, 0, 1) for x in start)
    low, high = (jnp.where(undecided, x, one) for x in ends)
    lower, upper = (low, high) if sign > 0 else (-high, -low)
    no = jnp.bool_(False)
    bounds, n = iterate(
        partial(_tighter, tolerance is None),
        lambda bounds, _: bounds.ended,
        (None, _ReachabilityBounds(lower, upper, no, no), search),
        max_steps=_SWEEPS if max_steps is None else max_steps,
    )
    lower, upper = bounds.lower, bounds.upper
    still = lax.stop_gradient(search)
    own, action = still.choose(lower)
    if components is not None:
        exits = undecided & (own >= _collapse(components, own))
        towards = attract(TracedGraph(model), exits, components.inside).action
        action = jnp.where(exits, action, towards)
    value = (lower + upper) / 2
    residual = jnp.max(jnp.abs(still.image(value) - value))
    low, high = (lower, upper) if sign > 0 else (-upper, -lower)
    policy = jnp.where(undecided, action, sets.action)
    status = status_code(bounds.half <= goal, jnp.isfinite(residual))
    return Solution(sign * value, policy, low, high, residual, n, status)


def _collapse(components: EndComponents | None, value: jax.Array) -> jax.Array:
    """The largest value in each state's end component."""
    if components is None:
        return value
    label = components.component.ravel()
    best = jax.ops.segment_max(value.ravel(), label, num_segments=label.size)
    return best[label].reshape(value.shape)
