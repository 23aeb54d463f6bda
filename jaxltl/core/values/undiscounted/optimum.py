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
from jaxltl.core.values.engine.chain_systems import ChainSystem, with_derivative
from jaxltl.core.values.engine.iterate import sequential_vmap, iterate
from jaxltl.core.values.engine.linear import MOST_PRODUCTS, Inverse, System, is_small, solver
from jaxltl.core.values.undiscounted.traced_total_reward import Problem, solve_problem

_POLICY_SWEEPS = 8  # sweeps under the greedy policy for one of the optimality operator
_FINER = 8  # factor by which a guess is narrower than the bounds, once these meet the goal
_SWEEPS = 1_000_000  # of interval iteration
_FAR_SWEEPS = 6  # sweeps of a guess, or of interval iteration after one that failed


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
    sets = policy_sets(TracedGraph(model), target, policy)
    undecided = ~(sets.one | sets.zero)
    one = sets.one.astype(model.dtype)
    weight = action_columns(model.num_actions, policy)
    system = lax.stop_gradient(
        System(sweep_operator(model), weight, undecided.ravel().astype(model.dtype))
    )
    eliminable = method == "auto" and not is_sharded(model)
    if eliminable:  # Krylov steps stagnate in chains that take very long; then elimination follows
        max_steps = jnp.minimum(max_steps, min(MOST_PRODUCTS, 8 * model.num_states + 64))
    linear = solver(system, method, max_steps=max_steps)

    constant = lax.stop_gradient((model, policy))
    chain = ChainSystem(*constant, undecided)
    goal, rows = 2 * _half_width(model, tolerance), normalised_rows(*constant)

    def eliminated() -> tuple[jax.Array, ...]:
        solve = partial(chain.solve, lambda x: x - chain.image(x))
        return m_matrix_error(rows, solve, solve(one), one, undecided)

    start, n = linear.counted(one)
    found = m_matrix_error(rows, linear.solve, start, one, undecided)
    if eliminable and not isinstance(linear, Inverse):
        # Without a proof the width is 1, which a loose tolerance admits.
        narrow = jnp.max(found[2] - found[1]) <= jnp.minimum(goal, 0.5)
        found = lax.cond(narrow, lambda: found, eliminated)
    value, lower, upper, residual = lax.stop_gradient(found)
    solution = Solution(
        value=value,
        policy=constant[1],
        lower=lower,
        upper=upper,
        residual=residual,
        num_steps=n,
        # The error of elimination is rounding, so more steps would not help.
        status=status_code(
            jnp.max(upper - lower) <= goal, jnp.isfinite(residual), isinstance(linear, Inverse)
        ),
    )
    inverse = linear if isinstance(linear, Inverse) else None
    given = ChainSystem(model, policy, undecided)
    value = with_derivative(value, given, outside=one, inverse=inverse)
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
    return _optimize(model, sets, components, (tolerance, max_steps, start), objective=objective)


@jit("objective")
def _inside_jit(
    model: ActionModel, target: jax.Array, *options: PyTree, objective: str
) -> Solution:
    sets, components = sequential_vmap(partial(_qualitative, objective=objective), model, target)
    return _optimize(model, sets, components, options, objective=objective)


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


class _Search(NamedTuple):
    """An optimal reachability problem; `sign` times probabilities are maximised."""

    # `near` is the bound that a policy attains, the lower one of a maximum, and `far` the other.
    # Both are rounded outwards: sums of nonnegative terms err by a share `slack` of them, and by
    # `least` where products underflow.

    model: ActionModel
    undecided: jax.Array
    one: jax.Array
    components: EndComponents | None
    goal: jax.Array  # half of the width

    @property
    def cheap(self) -> bool:
        """True if sweeps under a fixed policy gather single states; a product gathers rows."""
        return self.components is None and not isinstance(self.model, Product)

    @property
    def slack(self) -> jax.Array | float:
        return rounding_unit(self.model)

    @property
    def least(self) -> jax.Array | float:
        return underflow(self.model)

    @property
    def leaving(self) -> jax.Array:
        available = self.model.available
        result: jax.Array = (
            available if self.components is None else available & ~self.components.inside
        )
        return result

    def best(self, sign: int, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        value, action = action_argmax(sign * expectation(self.model, y), self.leaving)
        return jnp.where(self.undecided, _collapse(self.components, sign * value), self.one), action

    def beyond(self, sign: int, image: jax.Array) -> jax.Array:
        """An image rounded upwards for sign 1, else downwards."""
        rounded = image * (1 + sign * self.slack) + sign * self.least
        return jnp.where(self.undecided, jnp.clip(rounded, 0, 1), self.one)

    def nearer(self, sign: int, near: jax.Array, image: jax.Array) -> jax.Array:
        return sign * jnp.maximum(sign * near, sign * self.beyond(-sign, image))

    def closer(self, sign: int, far: jax.Array, image: jax.Array) -> jax.Array:
        return sign * jnp.minimum(sign * far, sign * self.beyond(sign, image))


class _Bounds(NamedTuple):
    near: jax.Array
    far: jax.Array
    failed: jax.Array  # whether the last guess was no bound
    moved: jax.Array
    rests: jax.Array  # whether a round gained less than rounding takes

    @property
    def half(self) -> jax.Array:
        return jnp.max(jnp.abs(self.far - self.near)) / 2


def _tighter(sign: int, finest: bool, table: None, carry: _Bounds, search: _Search) -> _Bounds:
    """One round: a sweep and some under the greedy policy for `near`, a guess or sweeps for `far`."""
    # A value that the operator does not carry away from the optimum is a bound, because the fixed
    # point is unique where end components are collapsed; so `far` is guessed, and where the guess
    # fails, plain interval iteration continues. Where the bounds are to be the finest, this continues
    # beyond the goal: a guess is then a bound of the same shape that is `_FINER` times as near.
    near, far, failed, *_ = carry
    image, action = search.best(sign, near)
    close = jnp.bool_(finest) & (carry.half <= search.goal)
    aim = jnp.where(close, carry.half / _FINER, search.goal)
    settled = jnp.max(jnp.abs(image - near)) <= aim / 32
    new_near = search.nearer(sign, near, image)
    if search.cheap:
        new_near = _followed(sign, search, new_near, action)

    def guess() -> tuple[jax.Array, jax.Array]:
        # `near` moved by almost the tolerance; some sweeps give it its shape.
        beyond = jnp.where(close, (far - new_near) / _FINER, sign * 1.8 * search.goal)
        offered = jnp.clip(new_near + beyond, 0, 1)
        offered = jnp.where(search.undecided, offered, search.one)

        def sweep(_: int, pair: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            return pair[1], search.beyond(sign, search.best(sign, pair[1])[0])

        before, after = lax.fori_loop(0, _FAR_SWEEPS, sweep, (offered, offered))
        proven = jnp.all(sign * after <= sign * before)
        return jnp.where(proven, search.closer(sign, far, after), far), ~proven

    def sweeps() -> tuple[jax.Array, jax.Array]:
        step = lax.fori_loop(
            0, _FAR_SWEEPS, lambda _, y: search.closer(sign, y, search.best(sign, y)[0]), far
        )
        return step, jnp.bool_(False)

    gain = jnp.max(jnp.abs(new_near - near))
    rests = close & (gain <= search.slack / 8)
    new_far, failed = lax.cond(
        settled | rests, lambda: lax.cond(failed | ~settled, sweeps, guess), lambda: (far, failed)
    )
    far_gain = jnp.max(jnp.abs(new_far - far))
    rests &= ~failed & (far_gain <= search.slack / 8)
    return _Bounds(new_near, new_far, failed, (gain > 0) | (far_gain > 0) | failed, rests)


def _followed(sign: int, search: _Search, near: jax.Array, action: jax.Array) -> jax.Array:
    onward = policy_operator(search.model, action)

    def sweep(_: int, y: jax.Array) -> jax.Array:
        image = onward(y.ravel()).reshape(y.shape)
        return search.nearer(sign, y, jnp.where(search.undecided, image, search.one))

    result: jax.Array = lax.fori_loop(0, _POLICY_SWEEPS, sweep, near)
    return result


def _ended(finest: bool, carry: _Bounds, search: _Search) -> jax.Array:
    return (carry.rests if finest else carry.half <= search.goal) | ~carry.moved


@jit("objective")
def _optimize(
    model: PyTree, sets: Sets, components: EndComponents | None, options: PyTree, *, objective: str
) -> Solution:
    tolerance, max_steps, start = options
    undecided = ~(sets.one | sets.zero)
    one = sets.one.astype(model.dtype)
    small = is_small(sweep_operator(model), one.size) and max_steps is None and start is None
    # A user's model may lack the reduction that double words need.
    small = small and combined.dispatch(type(model)) is not combined.dispatch(object)
    if small:
        run = partial(_by_policy_iteration, objective=objective)
        asked = 2 * _half_width(model, tolerance)
        solution, row_of = sequential_vmap(run, model, sets, components, asked)
    else:
        row_of = None
        solution = _by_intervals(model, sets, components, options, objective=objective)
    code = status_code(True, True, valid=is_representable(model))
    solution = replace(solution, status=jnp.maximum(solution.status, code))
    solution = jax.tree.map(lax.stop_gradient, solution)
    chain = ChainSystem(model, solution.policy, undecided, row_of)
    result: Solution = replace(solution, value=with_derivative(solution.value, chain, outside=one))
    return result


def _by_policy_iteration(
    model: ActionModel,
    sets: Sets,
    components: EndComponents | None,
    asked: Array,
    *,
    objective: str,
) -> tuple[Solution, jax.Array]:
    """An optimum as the total reward of entering the target, and the states whose rows count."""
    rows, one = normalised_rows(model), sets.one.astype(model.dtype)
    leaving = model.available if components is None else model.available & ~components.inside
    sign, gain = 1 if objective == "max" else -1, rows.expectation(double_word(one))
    open_, finite = ~(sets.one | sets.zero), sets.one | True
    problem = Problem(
        rows, sign, gain, None, open_, finite, leaving, None, sets.action, components, highest=1
    )
    finest = max(4 * float(jnp.finfo(model.dtype).eps), 1e-12)
    found = solve_problem(problem, jnp.minimum(asked, finest), asked)
    value, lower, upper = (
        jnp.where(open_, x, one) for x in (found.value, found.lower, found.upper)
    )
    rest = found.residual, found.num_steps, found.status
    return Solution(value, found.policy, lower, upper, *rest), found.leaves


def _by_intervals(
    model: PyTree, sets: Sets, components: EndComponents | None, options: PyTree, *, objective: str
) -> Solution:
    """Encloses an optimum between a bound that a policy attains and one that is proven."""
    # The attained bound ("near") is the lower one of a maximum and the upper one of a minimum.
    # Sweeps under its own greedy policy move it soundly and cheaply.
    (tolerance, max_steps, start), sign = options, 1 if objective == "max" else -1
    undecided = ~(sets.one | sets.zero)
    one = sets.one.astype(model.dtype)
    goal = _half_width(model, tolerance)
    search = _Search(model, undecided, one, components, goal)
    top = jnp.where(undecided, 1, one)
    low, high = one, top
    if start is not None:
        low, high = (jnp.where(undecided, jnp.clip(x, 0, 1), one) for x in start)
    near, far = (low, high) if objective == "max" else (high, low)
    finest, no = tolerance is None, jnp.bool_(False)
    bounds, n = iterate(
        partial(_tighter, sign, finest),
        partial(_ended, finest),
        (None, _Bounds(near, far, no, ~no, no), search),
        max_steps=_SWEEPS if max_steps is None else max_steps,
    )
    near, far = bounds.near, bounds.far
    still = lax.stop_gradient(search)
    action = still.best(sign, near)[1]
    if components is not None:
        own = action_argmax(expectation(still.model, near), still.leaving)[0]
        exits = undecided & (own >= _collapse(components, own))
        towards = attract(TracedGraph(model), exits, components.inside).action
        action = jnp.where(exits, action, towards)
    lower, upper = (near, far) if objective == "max" else (far, near)
    value = (lower + upper) / 2
    residual = jnp.max(jnp.abs(still.best(sign, value)[0] - value))
    policy = jnp.where(undecided, action, sets.action)
    status = status_code(bounds.half <= goal, jnp.isfinite(residual))
    return Solution(value, policy, lower, upper, residual, n, status)


def _collapse(components: EndComponents | None, value: jax.Array) -> jax.Array:
    """The largest value in each state's end component."""
    if components is None:
        return value
    label = components.component.ravel()
    best = jax.ops.segment_max(value.ravel(), label, num_segments=label.size)
    return best[label].reshape(value.shape)
