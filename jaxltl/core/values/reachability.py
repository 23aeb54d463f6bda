"""Probabilities of reaching a set and of satisfying a formula, with certified bounds.

Where a probability is exactly 0 or exactly 1 is decided on the graph. In between, a fixed
policy is a linear system, certified by its residual, and an optimum is enclosed by
interval iteration with end components collapsed. No bound rests on a small change.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.graphs.attractor import almost_surely_reaching, attractor, avoidable
from jaxltl.core.graphs.end_components import EndComponents, end_components
from jaxltl.core.models.concrete import is_traced
from jaxltl.core.models.operators import (
    action_argmax,
    action_mean,
    expectation,
    first_action,
    forall_successor,
    induced_chain,
    require_policy,
    valid_policy,
)
from jaxltl.core.models.product import Product
from jaxltl.core.models.tables import action_columns, table
from jaxltl.core.types import Solution, Status, require_shape, status_code
from jaxltl.core.values.evidence import m_matrix_error, refuse
from jaxltl.core.values.fixed_point import implicit
from jaxltl.core.values.linear import Inverse, System, solver
from jaxltl.core.values.stiff import reachability_bounds

_POLICY_SWEEPS = 8  # sweeps under the greedy policy for one of the optimality operator


_FAR_SWEEPS = 6  # sweeps of a guess, or of interval iteration after one that failed


_DENSE_LIMIT = 1024  # states up to which a linear system is solved by elimination


_PATIENCE = 20_000  # sweeps after which the optimum of a small model is, too


class Sets(NamedTuple):
    """What the graph decides: probability one, probability zero, and witnessing actions."""

    one: jax.Array
    zero: jax.Array
    action: jax.Array


def reachability_probability(
    model: Any,
    target: jax.Array,
    *,
    policy: jax.Array | None = None,
    objective: str = "max",
    method: str = "auto",
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 1_000_000,
) -> Solution:
    """Probability of ever reaching a set of states.

    The least solution of ``y = 1`` on the target, ``y = sum_a pi(s, a) (P y)(s, a)``
    elsewhere (2.5); for optima with a maximum or minimum over available actions
    (Baier and Katoen 2008, section 10.6). Optima: interval iteration (Haddad and
    Monmege 2018) with maximal end components collapsed and each bound rounded outwards;
    where that makes hardly any progress on a small model, policy iteration, proven.

    Args:
      model: the model.
      target: ``bool[S]``.
      policy: ``float[S, A]`` or ``int32[S]``: evaluate this policy. Default: optimise.
      objective: ``"max"`` or ``"min"``; ignored when a policy is given.
      method: for a given policy: ``"direct"`` (elimination, however slowly the policy
        makes progress), ``"iterative"`` (Krylov), or ``"auto"``, direct up to 1024 states.
      tolerance: half the width of the enclosure asked for; default the square root of
        the dtype's precision.
      max_steps: sweeps at most.

    Returns:
      :class:`Solution`; `value` is ``float[S]``, exactly 0 or 1 where the graph says so. An
      optimum's `policy` is ``int32[S]`` and attains its bound on the safe side
      (`lower` for a maximum, `upper` for a minimum).

    Raises:
      ValueError: a shape is wrong, or the objective or method is unknown.

    Differentiable in the policy and in the probabilities, with the support held fixed.

    Example:
      >>> from jaxltl.core.models.mdp import from_dense
      >>> mdp = from_dense([[[0.5, 0.25, 0.25]], [[0, 1.0, 0]], [[0, 0, 1.0]]])
      >>> round(reachability_probability(mdp, jnp.array([False, True, False])).value[0].item(), 3)
      0.5
    """
    if method not in ("auto", "direct", "iterative"):
        raise ValueError(f"method={method!r}; choose auto, direct or iterative.")
    target = jnp.asarray(target, bool)
    require_shape("target", target, model.state_shape)
    if policy is not None:
        require_policy(model, policy)
        return _evaluate(model, target, policy, tolerance, method=method)
    if objective not in ("max", "min"):
        raise ValueError(f'objective={objective!r}; it must be "max" or "min".')
    sets = _max_sets(model, target) if objective == "max" else _min_sets(model, target)
    components = None
    if objective == "max":
        components = end_components(model, ~(sets.one | sets.zero))
        if not is_traced(components) and not bool(components.inside.any()):
            components = None
    solve = partial(_optimize, model, sets, components, tolerance, objective=objective)
    small = math.prod(model.state_shape) <= _DENSE_LIMIT
    if is_traced((model, sets, tolerance, max_steps)) or not small:
        return solve(max_steps)
    solution = solve(jnp.minimum(max_steps, _PATIENCE))
    if int(solution.status) != Status.CONVERGED and int(max_steps) > _PATIENCE:
        undecided = ~(sets.one | sets.zero)
        bounds = reachability_bounds(model, sets.one, undecided, components, objective)
        solution = solve(max_steps, bounds or (solution.lower, solution.upper))
    return solution


def complement(reach: Solution) -> Solution:
    return replace(
        reach, value=1 - reach.value, lower=1 - reach.upper, upper=1 - reach.lower
    )


# --- what the graph decides ----------------------------------------------------------------


def policy_sets(model: Any, target: jax.Array, policy: jax.Array) -> Sets:
    allowed = model.available & (policy > 0)
    zero = ~attractor(model, target, allowed).region
    doomed = attractor(model, zero, allowed, among=~target).region
    return Sets(~doomed, zero, jnp.zeros(target.shape, jnp.int32))


def _max_sets(model: Any, target: jax.Array) -> Sets:
    some = attractor(model, target)
    sure = almost_surely_reaching(model, target, reaching=some)
    return Sets(sure.region, ~some.region, jnp.where(sure.region, sure.action, some.action))


def _min_sets(model: Any, target: jax.Array) -> Sets:
    zero = avoidable(model, target)
    doomed = attractor(model, zero, among=~target).region
    stay = model.available & forall_successor(model, zero)
    stays, action = first_action(stay)
    return Sets(~doomed, zero, jnp.where(stays, action, first_action(model.available)[1]))


# --- a fixed policy: a linear system with a certificate -----------------------------------


@partial(jax.jit, static_argnames=("method",))
def _evaluate(model: Any, target: jax.Array, policy: jax.Array, tolerance, *, method) -> Solution:
    """Solves ``y = 1_one + (P_pi y) on the undecided states`` and encloses the answer."""
    checked = valid_policy(model, policy)
    policy = checked.distribution
    sets = policy_sets(model, target, policy)
    undecided = ~(sets.one | sets.zero)
    one = sets.one.astype(model.dtype)
    weight = action_columns(model.num_actions, policy)
    system = lax.stop_gradient(
        System(table(model), weight, undecided.ravel().astype(model.dtype)))
    linear = solver(system, method)

    def onward(y: jax.Array) -> jax.Array:
        return jnp.where(undecided, action_mean(policy, expectation(model, y)), 0)

    still = lax.stop_gradient(policy)
    value = jnp.where(undecided, lax.stop_gradient(linear.solve(one)), one)
    # Elimination can break down where rounding closes what leaves a set hardly ever.
    value = jnp.clip(jnp.where(jnp.isfinite(value), value, 0), 0, 1)
    error, residual, _ = lax.stop_gradient(
        m_matrix_error(model, linear.solve, onward, value, undecided))
    goal = jnp.sqrt(jnp.finfo(model.dtype).eps) if tolerance is None else tolerance
    solution = Solution(
        value=value, policy=still, lower=jnp.maximum(value - error, 0),
        upper=jnp.minimum(value + error, 1), residual=residual, num_steps=jnp.int32(2),
        # What elimination leaves is rounding.
        status=status_code(
            jnp.max(error) <= goal, jnp.isfinite(residual), isinstance(linear, Inverse)),
    )
    found = implicit(
        lambda y: one + onward(y), lax.stop_gradient(value), solve=linear.solve,
        transpose_solve=linear.transpose_solve)
    solution = replace(lax.stop_gradient(solution), value=found, policy=policy)
    return refuse(solution, checked.given, checked.valid)


# --- optima: interval iteration -------------------------------------------------------------


@partial(jax.jit, static_argnames=("objective",))
def _optimize(
    model, sets: Sets, components, tolerance, max_steps, bounds=None, *, objective
) -> Solution:
    """Encloses an optimum between a bound that a policy attains and one that is proven.

    The attained bound ("near") is the lower one of a maximum and the upper one of a
    minimum. Sweeps under its own greedy policy move it soundly and cheaply. The other
    ("far") is found by guessing: a value that the operator does not carry away from
    the optimum is a bound, because the fixed point is unique where end components
    are collapsed. Where the guess fails, plain interval iteration goes on.
    """
    sign = 1 if objective == "max" else -1
    undecided = ~(sets.one | sets.zero)
    one = sets.one.astype(model.dtype)
    eps = jnp.finfo(model.dtype).eps
    slack = (model.num_successors + model.num_actions + 4) * eps
    goal = jnp.sqrt(eps) if tolerance is None else jnp.asarray(tolerance, model.dtype)
    leaving = model.available if components is None else model.available & ~components.inside
    # A product gathers whole rows, which its chain over single states cannot.
    cheap_chain = components is None and not isinstance(model, Product)

    def best(y: jax.Array) -> tuple[jax.Array, jax.Array]:
        value, action = action_argmax(sign * expectation(model, y), leaving)
        return jnp.where(undecided, _collapse(components, sign * value), one), action

    # Sums of nonnegative terms err by a relative amount, so rounded outwards these stay bounds.
    def near_step(near: jax.Array, image: jax.Array) -> jax.Array:
        return sign * jnp.maximum(sign * near, sign * image * (1 - sign * slack))

    def far_step(far: jax.Array, image: jax.Array) -> jax.Array:
        return sign * jnp.minimum(sign * far, sign * image * (1 + sign * slack))

    def follow_greedy(near: jax.Array, action: jax.Array) -> jax.Array:
        chain = induced_chain(model, action)

        def sweep(_, y: jax.Array) -> jax.Array:
            image = expectation(chain, y.ravel())[:, 0].reshape(y.shape)
            return near_step(y, jnp.where(undecided, image, one))

        return lax.fori_loop(0, _POLICY_SWEEPS, sweep, near)

    def guess(near: jax.Array, far: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Offers `near` moved by almost the tolerance; some sweeps give it its shape."""
        guessed = jnp.where(undecided, jnp.clip(near + sign * 1.8 * goal, 0, 1), one)

        def sweep(_, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            return carry[1], best(carry[1])[0] * (1 + sign * slack)

        before, after = lax.fori_loop(0, _FAR_SWEEPS, sweep, (guessed, guessed))
        proven = jnp.all(sign * after <= sign * before)
        return jnp.where(proven, far_step(far, after), far), ~proven

    def iterate(_: jax.Array, far: jax.Array) -> tuple[jax.Array, jax.Array]:
        step = lax.fori_loop(0, _FAR_SWEEPS, lambda _, y: far_step(y, best(y)[0]), far)
        return step, jnp.bool_(False)

    def body(carry):
        near, far, failed, n, _ = carry
        image, action = best(near)
        settled = jnp.max(jnp.abs(image - near)) <= goal / 32
        new_near = near_step(near, image)
        if cheap_chain:
            new_near = follow_greedy(new_near, action)
        new_far, failed = lax.cond(
            settled,
            lambda: lax.cond(failed, iterate, guess, new_near, far),
            lambda: (far, failed),
        )
        moved = jnp.any((new_near != near) | (new_far != far)) | failed
        return new_near, new_far, failed, n + 1, moved

    def unfinished(carry):
        near, far, _, n, moved = carry
        return (jnp.max(jnp.abs(far - near)) > 2 * goal) & (n < max_steps) & moved

    top = jnp.where(undecided, 1, one)
    lower, upper = (one, top) if bounds is None else bounds
    near, far = (lower, upper) if objective == "max" else (upper, lower)
    start = (near, far, jnp.bool_(False), jnp.int32(0), jnp.bool_(True))
    near, far, _, n, _ = lax.stop_gradient(lax.while_loop(unfinished, body, start))
    action = best(near)[1]
    if components is not None:
        own = action_argmax(expectation(model, near), leaving)[0]
        exits = undecided & (own >= _collapse(components, own))
        towards = attractor(model, exits, components.inside).action
        action = jnp.where(exits, action, towards)
    lower, upper = (near, far) if objective == "max" else (far, near)
    value = (lower + upper) / 2
    residual = jnp.max(jnp.abs(best(value)[0] - value))
    policy = jnp.where(undecided, action, sets.action)
    solution = Solution(
        value=value, policy=policy, lower=lower, upper=upper, residual=residual, num_steps=n,
        status=status_code(jnp.max(upper - lower) <= 2 * goal, jnp.isfinite(residual)),
    )
    solution = jax.tree.map(lax.stop_gradient, solution)

    def follow(y: jax.Array) -> jax.Array:
        return jnp.where(undecided, action_mean(policy, expectation(model, y)), one)

    # The optimum's derivative is that of the policy that attains it (Danskin).
    return replace(solution, value=implicit(follow, solution.value))


def _collapse(components: EndComponents | None, value: jax.Array) -> jax.Array:
    """The largest value in each state's end component."""
    if components is None:
        return value
    label = components.component.ravel()
    best = jax.ops.segment_max(value.ravel(), label, num_segments=label.size)
    return best[label].reshape(value.shape)
