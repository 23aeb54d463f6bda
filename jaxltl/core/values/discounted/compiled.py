"""Discounted values of policies, and optimal discounted values.

Solvers return certified enclosures and are differentiable by the implicit function theorem. A
``model`` is an MDP, a DenseMDP, a SparseMDP or a Product; shapes are written for an MDP, and a
product's values have ``[S, Q]`` for ``[S]``. Of a sparse model quantities on actions are ``[R]``,
and actions of policies are rows.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.models.compiled import compiled_form, compiled_policy, reshape_solution
from jaxltl.core.models.ops.array_namespace import jit, is_traced
from jaxltl.core.models.ops.choices import Layout, Quantity, choices
from jaxltl.core.models.mdp import MDP, DenseMDP
from jaxltl.core.models.mesh.sharded import ShardedMDP
from jaxltl.core.models.ops import double_word as dw, kernels
from jaxltl.core.models.ops.operators import (
    expectation,
    policy_operator,
    require_policy,
    valid_policy,
)
from jaxltl.core.models.ops.successor_tables import action_columns, sweep_operator
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import ActionModel, Array, Model, PyTree, SuccessorModel
from jaxltl.core.models.sparse import SparseMDP, choice_reward
from jaxltl.core.types import Solution, Status, status_code
from jaxltl.core.values.engine import newton
from jaxltl.core.values.engine.certificates import (
    RelativeEnclosure,
    backup_error,
    enclose,
    refuse,
    rounding_unit,
)
from jaxltl.core.values.door.question import Accuracy, DiscountedReward, Question
from jaxltl.core.values.engine.host_solution import negated
from jaxltl.core.values.engine.implicit_diff import implicit
from jaxltl.core.values.engine.iterate import sequential_vmap, iterate
from jaxltl.core.values.engine.linear import DENSE_LIMIT, System, solver

MAX_STEPS = 100_000
_SWEEPS = 24  # under a fixed policy, in modified policy iteration
_STEPS = 6  # of Newton's method, in double words
_MAX_PRODUCTS = 2000  # in the linear system of one


def action_value(
    model: Model, reward: jax.Array, discount: jax.Array | float, value: jax.Array
) -> jax.Array:
    """``Q(s, a) = R(s, a) + discount * sum_t P(t | s, a) V(t)``; zero at unavailable actions."""
    q = reward + discount * expectation(model, value)
    return jnp.where(choices(model).available, q, 0)


def expected_reward(model: Model, reward: jax.Array) -> jax.Array:
    """A reward on pairs ``[S, A]`` or transitions ``[S, A, K]`` as its expectation ``[S, A]``."""
    world = getattr(model, "mdp", model)
    if isinstance(world, SparseMDP):
        return jnp.asarray(choice_reward(world, reward), model.dtype)
    model = cast(SuccessorModel, model)
    actions = (*model.state_shape, model.num_actions)
    transitions = (*actions, model.num_successors)
    reward = jnp.asarray(reward, model.dtype)
    if reward.shape == actions:
        return jnp.where(model.available, reward, 0)
    if reward.shape == transitions:
        weight = model.successor_probability
        # A reward at probability 0 does not count, but the derivative in the probability does.
        counts = (weight > 0) | jnp.isfinite(reward)
        return jnp.sum(weight * jnp.where(counts, reward, 0), axis=-1)
    raise ValueError(
        f"reward has shape {reward.shape}; expected {model.state_shape}, {actions} or {transitions}."
    )


def reward_size(model: Model, reward: PyTree) -> jax.Array:
    """Largest expected magnitude of a reward: rounding of rewards that cancel does not cancel."""
    return jnp.max(expected_reward(model, jax.tree.map(jnp.abs, reward)))


Words = tuple[Array, Array, Array]


class Parameters(NamedTuple):
    """Numbers of a discounted problem, for :mod:`jaxltl.core.values.engine.newton`."""

    discount: jax.Array  # a scalar
    size: jax.Array  # the largest reward, see reward_size
    unit: jax.Array  # relative rounding of a backup
    tolerance: jax.Array | None  # width of the enclosure, or None
    policy: Quantity = None  # a policy's weights, in columns, or None
    low: jax.Array | float = 0  # the discount's low word
    error: jax.Array | float = 0  # of the double word


def judge(value: jax.Array, image: jax.Array, problem: Parameters) -> tuple[jax.Array, jax.Array]:
    """Stopping criterion by MacQueen's bounds, and half their width."""
    enclosure = _enclosed(value, image, problem)
    return enclosure.ended, enclosure.half


def _enclosed(value: jax.Array, image: jax.Array, problem: Parameters) -> RelativeEnclosure:
    rounding = backup_error(problem.unit, problem.size, jnp.max(jnp.abs(image), axis=0))
    return enclose(value, image, problem.discount, rounding, problem.tolerance)


def parameters(
    model: Model,
    reward: jax.Array,
    discount: jax.Array | float | Words,
    tolerance: jax.Array | float | None,
) -> Parameters:
    """Parameters of a problem; the discount is a number or of :func:`discount_words`."""
    high, *rest = discount if isinstance(discount, tuple) else (discount,)
    goal = None if tolerance is None else jnp.asarray(tolerance, model.dtype)
    return Parameters(
        jnp.asarray(high, model.dtype),
        reward_size(model, reward),
        jnp.asarray(rounding_unit(model), model.dtype),
        goal,
        None,
        *rest,
    )


def discount_words(discount: jax.Array | float, dtype: jnp.dtype) -> Words:
    """A discount as a high and a low word, and the error of their sum."""
    number = jnp.asarray(discount) if is_traced(discount) else np.float64(discount)
    high = number.astype(dtype)
    low = lax.stop_gradient(number - high.astype(number.dtype)).astype(dtype)
    # A number of Python that is the argument of a jitted function was rounded to its dtype there.
    rounded = getattr(number, "weak_type", False) and number.dtype.itemsize < 8
    return high, low, np.asarray(float(jnp.finfo(dtype).eps) / 2 if rounded else 0, dtype)


def gains(model: Model, reward: jax.Array) -> Quantity:
    """The reward's columns, minus infinity at unavailable actions."""
    over = choices(model)
    return over.columns(over.logits(reward))


def solution_of(
    model: Model,
    problem: Parameters,
    value: jax.Array,
    image: jax.Array,
    policy: jax.Array,
    num_steps: jax.Array,
) -> Solution:
    """The solution certified by a value and its image, without derivatives."""
    enclosure = _enclosed(value, image, problem)
    middle = (image + enclosure.shift).reshape(model.state_shape)
    # With a certificate the whole image is finite.
    solution = Solution(
        value=middle,
        policy=policy,
        lower=middle - enclosure.half,
        upper=middle + enclosure.half,
        residual=jnp.max(jnp.abs(image - value)),
        num_steps=num_steps,
        status=status_code(enclosure.converged, enclosure.finite, enclosure.exhausted),
    )
    result: Solution = jax.tree.map(lax.stop_gradient, solution)
    return result


def discounted_reward(
    model: Model,
    question: Question,
    accuracy: Accuracy,
    *,
    method: str = "auto",
    max_steps: jax.Array | int | None = None,
    evaluation_sweeps: jax.Array | int | None = None,
) -> Solution:
    """Discounted rewards by compiled programs; a minimum is that of the negated reward."""
    path, tolerance = question.path, accuracy.tolerance
    assert isinstance(path, DiscountedReward)
    form, reward = compiled_form(model, path.reward)
    factor = discount_words(path.discount, form.dtype)
    steps = MAX_STEPS if max_steps is None else max_steps
    if question.policy is not None:
        policy = compiled_policy(model, question.policy)
        if not isinstance(form, SparseMDP):  # its policy is checked above
            require_policy(form, policy)
        return reshape_solution(
            model, _policy_value(form, policy, reward, factor, tolerance, steps)
        )
    minimize = question.objective == "min"
    if minimize:
        reward = jax.tree.map(jnp.negative, reward)
    sweeps = _SWEEPS if evaluation_sweeps is None else evaluation_sweeps
    limits = steps, sweeps
    solution = _optimal_value(
        form, reward, factor, method=method, tolerance=tolerance, limits=limits
    )
    return reshape_solution(model, negated(solution) if minimize else solution)


@jit()
def _policy_value(
    model: PyTree, policy: Array, reward: Array, discount: Words, tolerance: Array, max_steps: Array
) -> Solution:
    problem, raw = parameters(model, reward, discount, tolerance), reward
    reward = expected_reward(model, reward)
    checked = valid_policy(model, policy)
    over, rows = choices(model), sweep_operator(model)
    weight = over.columns(checked.distribution)
    problem = problem._replace(policy=weight)

    def combine(over: Layout, q: Quantity, problem: PyTree) -> tuple[jax.Array, Quantity]:
        return over.mean(problem.policy, q), problem.policy

    value, image, n, _ = newton.solve(
        rows,
        newton.Method(combine, judge),
        newton.Backup(
            over.columns(reward), problem.discount, jnp.zeros_like(problem.discount), problem
        ),
        jnp.zeros(model.num_states, model.dtype),
        max_steps=max_steps,
    )

    def backup(v: jax.Array) -> jax.Array:
        return over.mean(checked.distribution, action_value(model, reward, problem.discount, v))

    solution = solution_of(model, problem, value, image, checked.distribution, n)
    solution = _refined(model, raw, problem, solution, checked.distribution)
    value = implicit(backup, solution.value, System(rows, weight, problem.discount))
    return refuse(replace(solution, value=value, policy=checked.distribution), checked)


@jit("method")
def _optimal_value(
    model: ActionModel,
    reward: jax.Array,
    discount: Words,
    *,
    method: str,
    tolerance: jax.Array | float | None,
    limits: tuple[jax.Array | int, jax.Array | int],
) -> Solution:
    max_steps, evaluation_sweeps = limits
    if method == "auto":
        few = math.prod(model.state_shape) <= DENSE_LIMIT
        method = "policy_iteration" if few else "modified_policy_iteration"
    problem, raw = parameters(model, reward, discount, tolerance), reward
    reward, over = expected_reward(model, reward), choices(model)
    zero = jnp.zeros(model.num_states, model.dtype)
    if method == "modified_policy_iteration":
        value, image, n = _modified_policy_iteration(
            *lax.stop_gradient((model, reward, problem)), max_steps, evaluation_sweeps
        )
    else:
        value, image, n, _ = newton.solve(
            sweep_operator(model),
            newton.Method(best_action, judge, newton=method == "policy_iteration"),
            newton.Backup(
                gains(model, reward), problem.discount, jnp.zeros_like(problem.discount), problem
            ),
            zero,
            max_steps=max_steps,
        )
    q = reward + problem.discount * expectation(model, value.reshape(model.state_shape))
    _, policy = over.argmax(q)
    solution = solution_of(model, problem, value, image, policy, n)
    solution = _refined(model, raw, problem, solution, None)

    def backup(v: jax.Array) -> jax.Array:
        return over.max(reward + problem.discount * expectation(model, v))

    chosen = over.columns(over.one_hot(solution.policy, model.dtype))
    system = System(sweep_operator(model), chosen, problem.discount)
    return replace(solution, value=implicit(backup, solution.value, system))


def _refined(
    model: ActionModel,
    reward: jax.Array,
    problem: Parameters,
    solution: Solution,
    policy: jax.Array | None,
) -> Solution:
    """A solution in single precision with narrower bounds: Newton's steps in double words."""
    # Rounding of a backup, times ``1 / (1 - discount)``, is what keeps bounds wide.
    world = model.mdp if isinstance(model, Product) else model
    if not isinstance(world, MDP | DenseMDP | ShardedMDP) or model.dtype.itemsize > 4:
        return solution
    refined: Solution
    reward = jnp.asarray(reward, model.dtype)
    refined, action = sequential_vmap(_newton_steps, model, reward, problem, solution, policy)
    refined = replace(refined, policy=action if policy is None else solution.policy)
    ended = (solution.status <= Status.PRECISION) & jnp.isfinite(refined.lower).all()
    result: Solution = jax.tree.map(partial(jnp.where, ended), refined, solution)
    return result


# The last value with its image, greedy actions and residual; those of the least residual; steps.
_Progress = tuple[tuple[jax.Array, ...], tuple[jax.Array, ...], jax.Array]


def _newton_steps(
    model: ActionModel,
    reward: jax.Array,
    problem: Parameters,
    solution: Solution,
    policy: jax.Array | None,
) -> tuple[Solution, jax.Array]:
    rows, eps = dw.normalised_rows(model, policy), float(jnp.finfo(model.dtype).eps)
    factor = dw.double_word(problem.discount, problem.low)
    if reward.shape == rows.scale.shape:
        gain = dw.double_word(jnp.where(model.available, reward, 0))
    else:
        weight = cast(SuccessorModel, model).successor_probability
        earned = dw.times(weight, dw.double_word(jnp.where(weight > 0, reward, 0)))
        gain = dw.product(rows.scale, kernels.reduced(dw.plus, earned, -1))

    def backup(value: jax.Array) -> tuple[jax.Array, ...]:
        """The value, its image, the greedy actions, and the image less the value, rounded once."""
        ahead = dw.plus(gain, dw.product(factor, rows.expectation(value)))
        if policy is None:
            image, action = dw.best(ahead, model.available)
        else:
            image, action = rows.mean(ahead), jnp.zeros(value.shape, jnp.int32)
        return value, image, action, dw.minus(image, value)

    def bounds(image: jax.Array, change: jax.Array) -> RelativeEnclosure:
        size = problem.size + 2 * jnp.max(jnp.abs(dw.words(image)[0]))
        # A bound is computed from the change with some roundings.
        rounding = rows.unit * size + rows.underflow(size) + 16 * eps * jnp.max(jnp.abs(change))
        rounding += problem.error * problem.discount * size
        ends = jnp.zeros(change.size, change.dtype), change.ravel()
        goal = 2 * eps * size + 4 * rounding / (1 - problem.discount)
        return enclose(*ends, problem.discount, rounding, goal, problem.low)

    def newton_step(carry: _Progress) -> _Progress:
        (value, _, action, change), best, n = carry
        weight = jax.nn.one_hot(action, model.num_actions, dtype=model.dtype)
        columns = action_columns(model.num_actions, weight if policy is None else policy)
        system = System(sweep_operator(model), columns, problem.discount)
        linear = solver(system, max_steps=_MAX_PRODUCTS)
        step = lax.cond(n < 0, jnp.zeros_like, linear.solve, change)
        new = backup(dw.plus(value, dw.double_word(step)))
        size = jnp.max(jnp.abs(new[3]))
        better = (n < 0) | (size < jnp.max(jnp.abs(best[3])))  # false for NaN
        best = jax.tree.map(partial(jnp.where, better), new, best)
        # A greedy policy that changes may raise the residual for some steps.
        useful = better if policy is not None else jnp.isfinite(size)
        return new, best, jnp.where(useful, n + 1, _STEPS)

    def goes_on(carry: _Progress) -> jax.Array:
        _, (_, image, _, change), n = carry
        return (n < 0) | (n < _STEPS) & ~bounds(image, change).converged

    # The first step is zero, so that the program has one backup.
    value, none = dw.double_word(solution.value), jnp.zeros_like(solution.value)
    start = value, value, none.astype(jnp.int32), none
    begin: _Progress = start, start, jnp.int32(-1)
    _, (_, image, action, change), _ = lax.while_loop(goes_on, newton_step, begin)
    enclosure = bounds(image, change)
    lower, upper = (
        dw.outwards(dw.plus(image, dw.double_word(enclosure.shift + x * enclosure.half)), x)
        for x in (-1, 1)
    )
    narrow = solution.status == Status.CONVERGED
    if problem.tolerance is not None:
        narrow = jnp.max(upper - lower) <= problem.tolerance
    value = jnp.clip(dw.words(image)[0] + enclosure.shift, lower, upper)
    status, residual = status_code(narrow, enclosure.finite, True), jnp.max(jnp.abs(change))
    parts = solution.policy, lower, upper, residual, solution.num_steps, status
    return Solution(value, *parts), action


def best_action(over: Layout, q: Quantity, parameters: PyTree) -> tuple[jax.Array, Quantity]:
    """The largest action value, and weight one on the first action that attains it."""
    return over.best(q)


def _modified_policy_iteration(
    model: ActionModel, reward: Array, problem: Parameters, max_steps: Array, sweeps: Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    over = choices(model)

    def greedy(v: jax.Array) -> tuple[jax.Array, jax.Array]:
        q = reward + problem.discount * expectation(model, v.reshape(model.state_shape))
        image, policy = over.argmax(q)
        return image.ravel(), policy

    def step(_: None, carry: PyTree, __: None) -> PyTree:
        _, image, policy = carry
        onward = policy_operator(model, policy)
        gain = over.mean(policy, reward).ravel()
        value = lax.fori_loop(0, sweeps, lambda _, v: gain + problem.discount * onward(v), image)
        return value, *greedy(value)

    def finished(carry: PyTree, _: None) -> jax.Array:
        return judge(carry[0], carry[1], problem)[0]

    zero = jnp.zeros(model.num_states, model.dtype)
    start = lax.stop_gradient((zero, *greedy(zero)))
    (value, image, _), n = lax.stop_gradient(
        iterate(step, finished, (None, start, None), max_steps=max_steps, lanes="mapped")
    )
    return value, image, n
