"""Satisfaction probabilities of policies over sets of worlds, with certified bounds.

The probability from each initial state (3.8), its mean (3.9) and its minimum. Under ``vmap`` over
stacked worlds and policies this is one program: the linear system has one block for each memory
state, which is inverted once, and a second solve certifies the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from functools import partial
from operator import itemgetter
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct, validation
from jax import lax

from jaxltl.core.graphs.graph import TracedGraph, graph_of, take
from jaxltl.core.graphs.attractor import max_sets, min_sets, policy_sets
from jaxltl.core.models.construct.batch import is_stacked, num_worlds
from jaxltl.core.models.refusals import of_one_player
from jaxltl.core.models.ops.array_namespace import jax_array, jit, namespace, to_jax
from jaxltl.core.models.ops.double_word import normalised_rows
from jaxltl.core.models.ops.operators import (
    action_mean,
    expectation,
    require_policy,
    transition_matrix,
    valid_policy,
)
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, PyTree
from jaxltl.core.pretty_print import brief
from jaxltl.core.types import Status, require_shape, status_code
from jaxltl.core.values.engine.certificates import m_matrix_error
from jaxltl.core.values.engine.host_solution import complement
from jaxltl.core.values.engine.implicit_diff import ChainSystem, with_derivative
from jaxltl.core.values.engine.linear import inverse
from jaxltl.core.values.undiscounted.acceptance import as_product, as_reachability
from jaxltl.core.values.undiscounted.satisfaction import satisfaction_probability

_BLOCK_LIMIT = 1024  # world states up to which a block is inverted
_MAX_SWEEPS = 1000  # of automata with cycles; one without needs at most Q


@brief
@struct.dataclass
class Performance:
    """Satisfaction probabilities of a policy; fields have a leading axis under ``vmap``.

    Attributes:
      mean: L_phi (3.9), the mean over the initial states of the satisfaction probability.
      lower, upper: a certified enclosure of the mean.
      worst: the minimum over the initial states.
      worst_lower, worst_upper: a certified enclosure of the minimum.
      worst_state: ``int32[]``, the initial state of the minimum.
      value: ``float[S]``, the probability from each world state with the initial memory.
      status: CONVERGED if the enclosures at all initial states are within the tolerance.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0, 0.5, 0.5]], [[0, 1.0, 0]], [[0, 0, 1.0]]], initial=[0.5, 0.5, 0],
      ...                    label=[[0], [1], [0]], propositions=["a"])
      >>> found = task_performance(product(world, "F a", label_on="exit"), jnp.ones((3, 2, 1)))
      >>> round(found.mean.item(), 6), round(found.worst.item(), 6), found.worst_state.item()
      (0.75, 0.5, 0)
    """

    mean: jax.Array
    lower: jax.Array
    upper: jax.Array
    worst: jax.Array
    worst_lower: jax.Array
    worst_upper: jax.Array
    worst_state: jax.Array
    value: jax.Array
    status: jax.Array


@of_one_player
def task_performance(
    model: Product,
    policy: jax.Array,
    *,
    method: str = "auto",
    tolerance: jax.Array | float | None = None,
) -> Performance:
    """Satisfaction probability of a policy: mean and minimum over the initial states (3.9).

    Args:
      model: one product; ``vmap`` over stacked ones, or :func:`task_performances`.
      policy: ``float[S, Q, A]`` or ``int32[S, Q]``.
      method: ``"blocks"`` (one inverse for each memory state; co-safe and safety tasks),
        ``"general"`` (:func:`satisfaction_probability`), or ``"auto"``, blocks up to 1024 states.
      tolerance: width of the enclosures; default twice the square root of the dtype's precision.

    Returns:
      :class:`Performance`. If a policy hardly ever leaves a set, rounding may prevent a
      certificate: bounds 0 and 1, status PRECISION; use :func:`task_performances`. Differentiable
      in the policy and in the world's probabilities.

    Raises:
      ValueError: the policy has the wrong shape or a row that is not a distribution over available
        actions (INVALID_POLICY under ``jit``), the method is unknown, or it is ``"blocks"`` for
        a Buchi or parity task.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0.5, 0.25, 0.25]], [[0, 1.0, 0]], [[0, 0, 1.0]]],
      ...                    label=[[0], [1], [0]], propositions=["a"], initial=[1, 0, 0])
      >>> model = product(world, "F a", label_on="exit")
      >>> found = task_performance(model, jnp.ones((3, 2, 1)))
      >>> round(found.mean.item(), 3), found.worst_state.item()
      (0.5, 0)
    """
    validation.choice("method", method, ("auto", "blocks", "general"))
    require_policy(as_product(model), policy)
    return _task_performance(model, policy, tolerance, method=method)


@jit("method")
def _task_performance(
    model: Product, policy: jax.Array, tolerance: Array, *, method: str
) -> Performance:
    policy, _, valid, representable = valid_policy(model, policy)
    valid &= representable
    simple = model.automaton.has_final_states
    if method == "blocks" and not simple:
        raise ValueError(
            f'method="blocks" is for co-safe and safety tasks, not {model.automaton.acceptance}; '
            'choose "general".'
        )
    few = model.mdp.num_states <= _BLOCK_LIMIT
    if method == "blocks" or (method == "auto" and simple and few):
        safety = model.automaton.is_safety
        target = ~model.final if safety else model.final
        value, lower, upper = _reach(model, target, policy)
        if safety:
            value, lower, upper = complement(value, lower, upper)
    else:
        solution = satisfaction_probability(
            model,
            policy,
            tolerance=tolerance,
            method="iterative" if math.prod(model.state_shape) > _BLOCK_LIMIT else "auto",
        )
        value, lower, upper = solution.value, solution.lower, solution.upper
    performance = _summarize(model, value, lower, upper, tolerance)
    nan, worst_state = jnp.nan, performance.worst_state
    unknown: list[PyTree] = [nan, 0, 1, nan, 0, 1, worst_state, nan, Status.INVALID]
    result: Performance = jax.tree.map(
        lambda x, bad: jnp.where(valid, x, jnp.asarray(bad, x.dtype)),
        performance,
        Performance(*unknown),
    )
    return result


def _summarize(
    model: Product, value: Array, lower: Array, upper: Array, tolerance: Array
) -> Performance:
    start = model.initial_memory[:, None]
    value, lower, upper = (
        jnp.take_along_axis(x, start, axis=1)[:, 0] for x in (value, lower, upper)
    )
    weight = model.mdp.initial
    starts = weight > 0
    eps = jnp.finfo(model.dtype).eps
    slack = 4 * eps * jnp.sqrt(1.0 * weight.size)  # rounding of a sum of at most one
    goal = 2 * jnp.sqrt(eps) if tolerance is None else tolerance
    worst_state = jnp.argmin(jnp.where(starts, value, jnp.inf)).astype(jnp.int32)
    narrow = jnp.max(jnp.where(starts, upper - lower, 0)) <= goal
    finite = jnp.all(jnp.isfinite(value))

    def mean(x: jax.Array, slack: jax.Array) -> jax.Array:
        # Rounding must not move the mean out of the range.
        least, greatest = (
            f(jnp.where(starts, x, out)) for f, out in ((jnp.min, jnp.inf), (jnp.max, -jnp.inf))
        )
        total = jnp.sum(weight * x) + slack
        return total + lax.stop_gradient(jnp.clip(total, least, greatest) - total)

    return Performance(
        mean=mean(value, 0 * slack),
        lower=mean(lower, -slack),
        upper=mean(upper, slack),
        worst=value[worst_state],
        worst_lower=jnp.min(jnp.where(starts, lower, jnp.inf)),
        worst_upper=jnp.min(jnp.where(starts, upper, jnp.inf)),
        worst_state=worst_state,
        value=value,
        status=status_code(narrow, finite, exhausted=True),
    )


def _reach(
    model: Product, target: jax.Array, policy: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Reachability probabilities ``float[S, Q]``, and certified bounds."""
    # ``(I - P) y = b`` on the undecided states is solved by block Jacobi over memory states,
    # exactly if the automaton's only cycles are self-loops.
    fixed = lax.stop_gradient((model, policy))
    sets = policy_sets(TracedGraph(fixed[0]), target, fixed[1])
    undecided = ~(sets.one | sets.zero)
    one = sets.one.astype(model.dtype)
    blocks = _blocks(*fixed, undecided)
    value, lower, upper, _ = m_matrix_error(
        normalised_rows(*fixed), blocks.solve, blocks.solve(one), one, undecided
    )
    chain = ChainSystem(model, policy, undecided)
    value = with_derivative(value, chain, target=target, one=one, inverse=blocks)
    return value, lower, upper


class _UndecidedSystem(NamedTuple):
    """The system ``x - P x`` on the undecided states, x elsewhere, for ``[S, Q]``."""

    # Block Jacobi with a block for each memory state. If the automaton's only cycles are
    # self-loops, it ends after as many sweeps as its longest path has states.

    model: Product
    policy: jax.Array
    undecided: jax.Array
    inverses: jax.Array  # ``float[Q, S, S]``

    def _outside(self, x: jax.Array) -> jax.Array:
        """The part of ``P x`` that changes the memory."""
        model, stays = self.model, _stays(self.model)
        if model.label_on == "exit":
            ahead = jnp.where(stays, 0, action_mean(self.policy, expectation(model, x)))
        else:
            read = jnp.where(stays, 0, jnp.take_along_axis(x, model.next_memory, axis=1))
            ahead = jax.vmap(partial(expectation, model.mdp), in_axes=1, out_axes=1)(read)
            ahead = action_mean(self.policy, ahead)
        return jnp.where(self.undecided, ahead, 0)

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution for a right-hand side."""
        return _swept(b, self._outside, partial(_einsum, "qst,tq->sq", self.inverses))

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        back = jax.linear_transpose(self._outside, b)
        inside = partial(_einsum, "qst,sq->tq", self.inverses)
        return _swept(b, lambda y: back(y)[0], inside)


_einsum = partial(jnp.einsum, precision="highest")


def _swept(
    b: jax.Array,
    outside: Callable[[jax.Array], jax.Array],
    inside: Callable[[jax.Array], jax.Array],
) -> jax.Array:
    """``x = inside(b + outside(x))``, by sweeps from 0."""

    def sweep(carry: PyTree) -> PyTree:
        x, _, n = carry
        new = inside(b + outside(x))
        return new, jnp.any(jnp.abs(new - x) > 0), n + 1  # false for NaN

    def unfinished(carry: PyTree) -> jax.Array:
        _, moved, n = carry
        result: jax.Array = moved & (n < _MAX_SWEEPS)
        return result

    start = (jnp.zeros_like(b), jnp.bool_(True), jnp.int32(0))
    return lax.while_loop(unfinished, sweep, start)[0]


def _stays(model: Product) -> jax.Array:
    """``bool[S, Q]``, where the memory does not change."""
    return model.next_memory == jnp.arange(model.num_memory)


def _blocks(model: Product, policy: jax.Array, undecided: jax.Array) -> _UndecidedSystem:
    inside = jnp.where(undecided.T[:, :, None], _within(model, policy, _stays(model)), 0)
    inverses = jax.vmap(inverse)(jnp.eye(inside.shape[-1], dtype=inside.dtype) - inside)
    return _UndecidedSystem(model, policy, undecided, inverses)


def _within(model: Product, policy: jax.Array, stays: jax.Array) -> jax.Array:
    """``float[Q, S, S]``, the policy's transitions that do not change the memory."""
    steps = jax.vmap(partial(transition_matrix, model.mdp), in_axes=1)(policy)
    inside = stays.T[:, :, None] if model.label_on == "exit" else stays.T[:, None, :]
    return jnp.where(inside, steps, 0)


# --- many worlds ------------------------------------------------------------------------------


@of_one_player
def task_performances(
    models: Product,
    policies: jax.Array,
    *,
    tolerance: jax.Array | float | None = None,
    batch: int = 128,
) -> Performance:
    """:func:`task_performance` in each of several worlds, on the host.

    Co-safe and safety tasks are evaluated by one compiled program, other tasks one world after the
    other. Worlds without a certificate in the models' precision are evaluated again by the sparse
    engine, which bounds the relative error for every chain (O'Cinneide 1993).

    Args:
      models: stacked products, see :func:`~jaxltl.core.models.construct.batch.stack_products`.
      policies: ``float[W, S, Q, A]`` or ``int32[W, S, Q]``; without W the same in every world.
      tolerance: as in :func:`task_performance`.
      batch: number of worlds in memory at once.

    Returns:
      :class:`Performance` with a leading axis W. Not differentiable; :func:`task_performance` is.

    Raises:
      ValueError: the models are not stacked or the policies have the wrong shape.

    Example:
      >>> from jaxltl import from_dense, stack_products
      >>> def world(p):
      ...     return from_dense([[[0, p, 1 - p]], [[0, 1.0, 0]], [[0, 0, 1.0]]], initial=[1, 0, 0],
      ...                       label=[[0], [1], [0]], propositions=["a"])
      >>> both = stack_products([world(0.25), world(0.75)], "G F a", label_on="exit")
      >>> found = task_performances(both, jnp.ones((3, 1, 1)))  # one policy in both worlds
      >>> found.mean.round(6).tolist(), found.value.shape
      ([0.25, 0.75], (2, 3))
    """
    if not is_stacked(models):
        raise ValueError("models is a single product; use task_performance, or as_stacked(model).")
    policies = jnp.asarray(policies)
    states = (num_worlds(models), models.mdp.num_states, models.num_memory)
    deterministic = jnp.issubdtype(policies.dtype, jnp.integer)
    shape = states if deterministic else (*states, models.num_actions)
    if policies.shape == shape[1:]:
        policies = jnp.broadcast_to(policies, shape)
    require_shape("policies", policies, shape)
    parts: list[PyTree] = [None] * num_worlds(models)
    if models.automaton.has_final_states:
        performances = _batched(models, policies, tolerance, batch=batch)
        parts = [jax.tree.map(itemgetter(w), performances) for w in range(len(parts))]
    for w, part in enumerate(parts):
        if part is not None and part.status == Status.INVALID:
            require_policy(*jax.tree.map(lambda x, w=w: np.asarray(x)[w], (models, policies)))
        elif part is None or part.status != Status.CONVERGED:
            # by the sparse engine
            model, policy = jax.tree.map(lambda x, w=w: np.asarray(x)[w], (models, policies))
            solution = satisfaction_probability(model, policy, tolerance=tolerance)
            enclosure = solution.value, solution.lower, solution.upper
            parts[w] = _summarized(model, *enclosure, tolerance)
    result: Performance = to_jax(jax.tree.map(lambda *x: np.stack(x), *parts))
    return result


def _batched(models: Product, policies: jax.Array, tolerance: Array, *, batch: int) -> Performance:
    """Evaluation in batches, so that memory does not grow with the number of worlds."""
    count = len(policies)
    size = min(batch, count)
    parts = []
    for first in range(0, count, size):
        # The last batch overlaps with the one before, so that all have one shape.
        begin = min(first, count - size)
        some, chosen = jax.tree.map(lambda x, i=begin: x[i : i + size], (models, policies))
        performances = jax.block_until_ready(_together(some, chosen, tolerance))
        parts.append(jax.tree.map(lambda x, i=first - begin: np.asarray(x)[i:], performances))
    result: Performance = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return result


_summarized = jax.jit(_summarize)


@jit()
def _together(models: Product, policies: jax.Array, tolerance: Array) -> Performance:
    return jax.vmap(partial(task_performance, tolerance=tolerance))(models, policies)


_WORLDS = 64  # in a batch of backward inductions


@jit()
def step_bounded_performances(models: Product, policies: jax.Array) -> Performance:
    """:func:`task_performance` within T steps in each of several worlds, for time-varying policies.

    The probability that T steps satisfy a co-safe formula, or do not violate a safety formula, by
    backward induction ``x_t = opt(x_T, sum_a pi_t(a) P_a x_{t+1})``, where ``opt`` is the maximum or
    the minimum.

    Args:
      models: stacked products, see :func:`~jaxltl.core.models.construct.batch.stack_products`.
      policies: ``float[W, T, S, Q, A]``.

    Returns:
      :class:`Performance` with a leading axis W; its status is of the default tolerance.
    """
    result: Performance = lax.map(
        lambda world: _step_bounded(*world), (models, policies), batch_size=_WORLDS
    )
    return result


def _step_bounded(model: Product, policy: jax.Array) -> Performance:
    decided = model.final.astype(model.dtype)
    optimum = jnp.minimum if model.automaton.is_safety else jnp.maximum

    def backup(value: jax.Array, policy: jax.Array) -> tuple[jax.Array, None]:
        return optimum(decided, action_mean(policy, expectation(model, value))), None

    value, _ = lax.scan(backup, decided, policy, reverse=True)
    # Rounding of T steps of sums of K + A products of numbers in [0, 1], to first order.
    num_roundings = len(policy) * (model.num_successors + model.num_actions + 4)
    error = num_roundings * jnp.finfo(model.dtype).eps
    return _summarize(
        model, value, jnp.maximum(value - error, 0), jnp.minimum(value + error, 1), None
    )


# --- summaries over worlds ------------------------------------------------------------------------


def infeasible_starts(model: Product) -> jax.Array:
    """Initial states ``bool[S]`` with maximal satisfaction probability 0, decided on the graph."""
    problem = as_reachability(model, "max")
    graph = graph_of(problem.model)
    target = take(graph, problem.target)
    if problem.objective == "max":
        never = max_sets(graph, target).zero
    else:
        never = min_sets(graph, target).one
    xp, never, memory, initial = namespace(never, model.initial_memory, model.mdp.initial)
    here = xp.take_along_axis(never, memory[:, None], axis=1)[:, 0]
    return jax_array((initial > 0) & here)


@brief
class Summary(NamedTuple):
    """Performance over worlds."""

    mean: float  # mean, std: of L_phi over the worlds (sample standard deviation; 0 for one world)
    std: float
    lower: float  # lower, upper: certified bounds on the mean
    upper: float
    # worst_world, worst: the name of the world with the least L_phi, and its value
    worst_world: str
    worst: float
    worst_start: float  # the least probability from any initial state of any world
    num_worlds: int  # number of worlds in these figures
    # names of the worlds with initial states from which no policy satisfies the task; they count in
    # the figures unless they are excluded
    infeasible: tuple[str, ...]
    left_out: tuple[str, ...]  # names of the excluded worlds
    uncertain: tuple[str, ...]  # names of the worlds with enclosures wider than the tolerance


def summarize(
    models: Product,
    performance: Performance,
    *,
    names: Sequence[str] | None = None,
    leave_out: Collection[str] = (),
) -> Summary:
    """Mean, standard deviation and worst case over worlds, on the host."""
    count = num_worlds(models)
    names = [f"world {w}" for w in range(count)] if names is None else list(names)
    if len(names) != count or len(set(names)) != count:
        raise ValueError(f"names has {len(names)} entries; give {count} different ones.")
    for name in leave_out:
        if name not in names:
            raise ValueError(f"leave_out: there is no world {name!r}; there are {names[:5]}, ...")
    included = np.array([name not in leave_out for name in names])
    if not included.any():
        raise ValueError("leave_out names every world; leave at least one in.")
    infeasible = np.array(
        [
            np.asarray(
                infeasible_starts(jax.tree.map(lambda x, w=w: np.asarray(x)[w], models))
            ).any()
            for w in range(count)
        ]
    )
    mean = np.asarray(performance.mean, np.float64)
    worst = int(np.argmin(np.where(included, mean, np.inf)))

    def named(chosen: np.ndarray) -> tuple[str, ...]:
        return tuple(name for name, is_in in zip(names, chosen, strict=True) if is_in)

    return Summary(
        mean=float(mean[included].mean()),
        std=float(mean[included].std(ddof=1)) if included.sum() > 1 else 0.0,
        lower=float(np.asarray(performance.lower, np.float64)[included].mean()),
        upper=float(np.asarray(performance.upper, np.float64)[included].mean()),
        worst_world=names[worst],
        worst=float(mean[worst]),
        worst_start=float(np.asarray(performance.worst)[included].min()),
        num_worlds=int(included.sum()),
        infeasible=named(infeasible),
        left_out=named(~included),
        uncertain=named(np.asarray(performance.status) != Status.CONVERGED),
    )
