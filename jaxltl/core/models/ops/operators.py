"""Operators of a model: expectation, predecessors, sampling and induced chains.

Values have the shape of the model's states, ``[S]`` or ``[S, Q]``; quantities on choices have one
more axis, A, and for a sparse model the shape ``[R]``. A new representation registers ``combined``,
or ``expectation`` and ``exists_successor``; ``least_successor`` for ranks; and ``sample_successor``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import singledispatch
from typing import NamedTuple, cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.models.mdp import MDP, DenseMDP
from jaxltl.core.models.ops import kernels
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.ops.choices import (
    action_argmax as action_argmax,
    action_max as action_max,
    action_mean as action_mean,
    choice_shape,
    choices,
    first_action as first_action,
    is_deterministic as is_deterministic,
    row_entries,
    state_mask,
)
from jaxltl.core.models.ops.kernels import where_positive
from jaxltl.core.models.protocols import Array, Model, PyTree, base_model
from jaxltl.core.models.action_numbers import row_actions, rows_of_policy, weights_of_policy
from jaxltl.core.models.ops.underflow import is_positive, is_subnormal, underflow_text, underflows
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.types import describe_row, row_tolerance
from jaxltl.core import validation
from jaxltl.core.validation import first_true


@singledispatch
def expectation(model: Model, value: jax.Array) -> jax.Array:
    """Expected value of the next state, ``(P v)(s, a) = sum_t P(t | s, a) v(t)``.

    Args:
      model, value: the model, and ``float[S]``.

    Returns:
      ``float[S, A]``, zero at unavailable actions; differentiable in `value` and the probabilities.

    Raises:
      TypeError: `model` is not a model.

    Example:
      >>> from jaxltl import from_dense
      >>> expectation(from_dense([[[0.5, 0.5]], [[0.0, 1.0]]]), jnp.array([0.0, 4.0])).tolist()
      [[2.0], [4.0]]
    """
    return combined(model, value, jnp.multiply, jnp.add)


def _region(model: Model, region: Array) -> jax.Array:
    if not hasattr(model, "state_shape"):
        raise TypeError(_unknown(model))
    return jnp.asarray(state_mask(model, "region", region))


@singledispatch
def exists_successor(model: Model, region: jax.Array) -> jax.Array:
    """Existential predecessors: choices with a possible successor in a region.

    Args:
      model, region: the model, and ``bool[S]``.

    Returns:
      ``bool[S, A]``, of a sparse model ``bool[R]``; False at unavailable actions; no derivative.

    Raises:
      TypeError: `model` is not a model.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.make_sparse([0, 2, 3, 4], [0, 2, 3, 4, 5], [1, 2, 0, 1, 2], [0.5, 0.5, 1, 1, 1])
      >>> exists_successor(fork, np.array([False, True, False])).tolist()  # one for each choice
      [True, False, True, False]
    """
    region = _region(model, region)
    return combined(model, region, kernels.positive_hits, jnp.logical_or)


@singledispatch
def forall_successor(model: Model, region: jax.Array) -> jax.Array:
    """Universal predecessors: choices with all possible successors in a region.

    Args:
      model, region: the model, and ``bool[S]``.

    Returns:
      ``bool[S, A]``, of a sparse model ``bool[R]``; True at unavailable actions; no derivative.

    Raises:
      TypeError: `model` is not a model.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.make_sparse([0, 2, 3, 4], [0, 2, 3, 4, 5], [1, 2, 0, 1, 2], [0.5, 0.5, 1, 1, 1])
      >>> forall_successor(fork, np.array([False, True, True])).tolist()  # one for each choice
      [True, False, True, True]
    """
    region = _region(model, region)
    return ~exists_successor(model, jnp.logical_not(region))


@singledispatch
def least_successor(model: Model, value: jax.Array) -> jax.Array:
    """Least value among the successors, ``[S, A]`` from ``[S]``; the dtype's largest at unavailable actions."""
    return combined(model, value, where_positive, jnp.minimum)


@singledispatch
def sample_successor(
    model: Model, key: chex.PRNGKey, state: jax.Array, action: jax.Array
) -> jax.Array:
    """Random successor, drawn from ``P(. | state, action)``.

    Args:
      model, key: the model and the random key; states of a product are numbered ``s * Q + q``.
      state, action: ``int32[]``.

    Returns:
      ``int32[]``. There is no derivative.

    Raises:
      TypeError: `model` is not a model.

    Example:
      >>> import jaxltl as jl
      >>> cycle = jl.make_mdp([[[1]], [[0]]], [[[1.0]], [[1.0]]])
      >>> int(jax.jit(sample_successor)(cycle, jax.random.key(0), 0, 0))
      1
    """
    raise TypeError(_unknown(model))


@singledispatch
def flat_transitions(model: Model) -> tuple[jax.Array, jax.Array]:
    """Successors ``int32[N, A, K]`` of a padded model's numbered states, and their probabilities."""
    raise TypeError(_unknown(model))


@singledispatch
def induced_chain(model: Model, policy: jax.Array) -> MDP | DenseMDP:
    """The Markov chain of a deterministic policy ``int32[S]``, as a model with one action and no labels."""
    pick = policy.reshape(-1, 1, 1)
    successor, probability = (jnp.take_along_axis(x, pick, axis=1) for x in flat_transitions(model))
    return MDP(
        successor=successor,
        probability=probability,
        available=jnp.ones((len(successor), 1), bool),
        initial=model.initial.ravel(),
        label=jnp.zeros((len(successor), 0), bool),
    )


@singledispatch
def transition_matrix(model: Model, policy: jax.Array) -> jax.Array:
    """``P_pi(s, t) = sum_a pi(s, a) P(t | s, a)`` as a dense matrix ``float[S, S]``, for small models."""
    size = model.num_states
    if isinstance(base_model(model), MDP | DenseMDP):
        successor, probability = flat_transitions(model)
        weight, row = policy.reshape(size, -1, 1) * probability, jnp.arange(size)[:, None, None]
        return jnp.zeros((size, size), weight.dtype).at[row, successor].add(weight)

    def column(value: jax.Array) -> jax.Array:
        ahead = expectation(model, value.reshape(model.state_shape))
        return action_mean(policy, ahead).ravel()

    return jax.vmap(column, out_axes=-1)(jnp.eye(size, dtype=model.dtype))


@singledispatch
def policy_operator(model: Model, policy: jax.Array) -> Callable[[jax.Array], jax.Array]:
    """The operator ``v -> P_pi v`` of a deterministic policy on flat values ``float[N]``."""
    if isinstance(base_model(model), MDP | DenseMDP):
        chain = induced_chain(model, policy)
        return lambda value: expectation(chain, value)[:, 0]
    return lambda value: action_mean(
        policy, expectation(model, value.reshape(model.state_shape))
    ).ravel()


def pushforward(model: Model, mass: jax.Array) -> jax.Array:
    """Mass flow into each state, ``(P' x)(t) = sum_{s, a} P(t | s, a) x(s, a)``: the transposed expectation.

    Args:
      model, mass: the model, and ``float[S, A]``.

    Returns:
      ``float[S]``; differentiable in `mass` and the probabilities.

    Raises:
      TypeError: `model` is not a model.

    Example:
      >>> from jaxltl import from_dense
      >>> pushforward(from_dense([[[0.5, 0.5]], [[0.0, 1.0]]]), jnp.array([[1.0], [2.0]])).tolist()
      [0.5, 2.5]
    """
    value = jax.ShapeDtypeStruct(model.state_shape, mass.dtype)
    return cast(jax.Array, jax.linear_transpose(lambda v: expectation(model, v), value)(mass)[0])


def _unknown(model: Model) -> str:
    if hasattr(model, "nominal"):
        return validation.unsupported_model(model)
    return (
        f"{type(model).__name__} is not a model: pass an MDP, a DenseMDP, a SparseMDP, a "
        "Product or a Game."
    )


@singledispatch
def combined(
    model: Model, value: jax.Array, term: kernels.Term, combine: kernels.Term
) -> jax.Array:
    """A reduction :func:`~jaxltl.core.models.ops.kernels.fold` over the successors of each choice."""
    raise TypeError(_unknown(model))


@singledispatch
def unpadded_states(model: Model) -> jax.Array | bool:
    """The states of the original model: True for all, or ``bool[N]`` for a model on a mesh."""
    return True


def is_representable(model: Model) -> jax.Array:
    """``bool[]``: no transition probability is subnormal, and none of a sparse row is zero."""
    return jnp.all(_representable(base_model(model)))


@singledispatch
def _representable(model: Model) -> jax.Array:
    return cast(jax.Array, jnp.bool_(True))


@_representable.register(MDP)
@_representable.register(DenseMDP)
def _(model: MDP | DenseMDP) -> jax.Array:
    return ~is_subnormal(lax.stop_gradient(model.successor_probability))


@_representable.register
def _(model: SparseMDP) -> jax.Array:
    probability = jnp.asarray(lax.stop_gradient(model.probability))
    return probability >= jnp.finfo(probability.dtype).tiny


@singledispatch
def greatest_predecessor(model: Model, quantity: jax.Array) -> jax.Array:
    """Largest natural number on the choices that lead to a state, ``[S, ...]``; 0 without any."""
    raise TypeError(_unknown(model))


@combined.register
def _(model: MDP, value: jax.Array, term: kernels.Term, combine: kernels.Term) -> jax.Array:
    weight = model.successor_probability
    return kernels.by_action(model.successor, weight, value, term, combine)


@greatest_predecessor.register
def _(model: MDP, quantity: jax.Array) -> jax.Array:
    wide = quantity.shape[1:-1]
    used = is_positive(model.successor_probability).reshape(
        *model.successor.shape, *(1,) * len(wide)
    )
    sent = jnp.where(used, jnp.moveaxis(quantity, -1, 1)[:, :, None], 0)  # [S, A, K, ...]
    return jnp.zeros(quantity.shape[:-1], quantity.dtype).at[model.successor].max(sent)


@sample_successor.register
def _(model: MDP, key: chex.PRNGKey, state: jax.Array, action: jax.Array) -> jax.Array:
    k = _sample(key, model.successor_probability[state, action])
    return model.successor[state, action, k]


@flat_transitions.register
def _(model: MDP) -> tuple[jax.Array, jax.Array]:
    return model.successor, model.successor_probability


@flat_transitions.register
def _(model: DenseMDP) -> tuple[jax.Array, jax.Array]:
    successor = jnp.arange(model.num_states, dtype=jnp.int32)
    return jnp.broadcast_to(successor, model.transition.shape), model.successor_probability


@combined.register
def _(model: DenseMDP, value: jax.Array, term: kernels.Term, combine: kernels.Term) -> jax.Array:
    weight = model.successor_probability
    if term is jnp.multiply and combine is jnp.add:
        return jnp.einsum("sat,t...->s...a", weight, value, precision="highest")
    if value.ndim > 1:
        return jax.vmap(lambda v: combined(model, v, term, combine), 1, 1)(value)
    return kernels.reduced(combine, term(weight, value), -1)


@induced_chain.register
def _(model: DenseMDP, policy: jax.Array) -> DenseMDP:
    rows = jnp.take_along_axis(model.successor_probability, policy[:, None, None], axis=1)
    return replace(
        model,
        transition=rows,
        available=jnp.ones((model.num_states, 1), bool),
        label=jnp.zeros((model.num_states, 0), bool),
        propositions=(),
    )


@transition_matrix.register
def _(model: DenseMDP, policy: jax.Array) -> jax.Array:
    return jnp.einsum("sa,sat->st", policy, model.successor_probability, precision="highest")


@sample_successor.register
def _(model: DenseMDP, key: chex.PRNGKey, state: jax.Array, action: jax.Array) -> jax.Array:
    return _sample(key, model.successor_probability[state, action]).astype(jnp.int32)


def _sample(key: chex.PRNGKey, probability: jax.Array) -> jax.Array:
    return jax.random.categorical(key, jnp.log(probability))


@combined.register
def _(model: SparseMDP, value: jax.Array, term: kernels.Term, combine: kernels.Term) -> jax.Array:
    return row_entries(model).combined(value, term, combine)


@sample_successor.register
def _(model: SparseMDP, key: chex.PRNGKey, state: jax.Array, action: jax.Array) -> jax.Array:
    del state  # a row is one state's
    probability, start = jnp.asarray(model.probability), jnp.asarray(model.entry_start)
    end = start[action + 1]

    def step(carry: PyTree) -> PyTree:
        entry, last, rest = carry
        real = probability[entry] > 0
        return entry + 1, jnp.where(real, entry, last), rest - probability[entry]

    draw = jax.random.uniform(key, dtype=probability.dtype)
    first = start[action]
    # The first entry up to which there is more than was drawn; the last one but for rounding.
    _, entry, _ = lax.while_loop(
        lambda carry: (carry[0] < end) & (carry[2] >= 0), step, (first, first, draw)
    )
    return jnp.asarray(model.successor)[entry]


@transition_matrix.register
def _(model: SparseMDP, policy: jax.Array) -> jax.Array:
    return row_entries(model).matrix(policy)


@policy_operator.register
def _(model: SparseMDP, policy: jax.Array) -> Callable[[jax.Array], jax.Array]:
    of = row_entries(model)
    return lambda value: kernels.gather(of.expectation(value), policy)


# --- policies ------------------------------------------------------------------------------


def policy_distribution(model: Model, policy: Array) -> jax.Array:
    """A policy as a distribution ``float[S, A]`` or ``float[R]``; ValueError for a wrong shape."""
    states, pairs = model.state_shape, choice_shape(model)
    if is_deterministic(policy):
        if jnp.shape(policy) != states:
            raise ValueError(
                f"policy has shape {jnp.shape(policy)}; a deterministic policy "
                f"(integers) for this model has shape {states}."
            )
        if isinstance(getattr(model, "mdp", model), SparseMDP):
            return choices(model).one_hot(policy, model.dtype)
        return jax.nn.one_hot(policy, pairs[-1], dtype=model.dtype)
    if jnp.shape(policy) != pairs:
        raise ValueError(
            f"policy has shape {jnp.shape(policy)}; a stochastic policy for this "
            f"model has shape {pairs}."
        )
    return cast(jax.Array, policy)


class CheckedPolicy(NamedTuple):
    """A validated policy."""

    distribution: jax.Array  # float[S, A], uniform in invalid rows
    masked: jax.Array  # the given weights, NaN where an unavailable action has weight
    valid: jax.Array  # bool[]: all rows are distributions, without subnormal weights
    representable: jax.Array  # bool[], of the model, see is_representable


def valid_policy(model: Model, policy: jax.Array, where: jax.Array | bool = True) -> CheckedPolicy:
    """A policy with its validity in the states `where`; differentiable in a stochastic policy."""
    policy, over = policy_distribution(model, policy), choices(model)
    available = over.available
    masked = jnp.where(available | (policy == 0), policy, jnp.nan)
    total = over.sum(masked)
    row = (jnp.abs(total - 1) <= row_tolerance(policy.dtype)) & over.all(masked >= 0)
    row |= ~jnp.asarray(where & unpadded_states(model))
    uniform = available / over.broadcast(jnp.maximum(over.sum(available), 1))
    used = jnp.where(
        over.broadcast(row), jnp.where(available, policy, 0), uniform.astype(policy.dtype)
    )
    valid = jnp.all(row) & ~jnp.any(is_subnormal(policy))
    return CheckedPolicy(used, lax.stop_gradient(masked), valid, is_representable(model))


def require_policy(model: Model, policy: Array, where: Array = True) -> None:
    """Raises ValueError, naming the state, for a concrete policy that is not valid."""
    if is_traced((model, policy, where)) or unpadded_states(model) is not True:
        return
    world = getattr(model, "mdp", model)
    if isinstance(world, SparseMDP):
        row_weights(world, policy, where)
        return
    shape = choice_shape(model)
    table, available = np.asarray(policy), np.asarray(choices(model).available)
    if is_deterministic(table):
        policy_distribution(model, table)  # its shape
        known = (table >= 0) & (table < shape[-1])
        place = np.where(known, table, 0)[..., None]
        bad = ~(known & np.take_along_axis(available, place, -1)[..., 0]) & where
        for state in map(tuple, np.argwhere(bad)[:1].tolist()):
            name = state[0] if len(state) == 1 else state
            actions = np.flatnonzero(available[state]).tolist()
            raise ValueError(
                f"the policy takes action {table[state]} in state {name}, "
                f"which is not available; choose one of {actions}."
            )
        return
    if table.shape != shape:
        policy_distribution(model, table)
    masked = np.where(available | (table == 0), table, np.nan)
    good = (np.abs(masked.sum(-1) - 1) <= row_tolerance(table.dtype)) & (masked >= 0).all(-1)
    for state in map(tuple, np.argwhere(~good & where)[:1].tolist()):
        raise ValueError(f"{describe_row(masked[state], state)}.")
    if (small := underflows(table, model.dtype)) is not None:
        *state, action = np.argwhere(small)[0].tolist()
        raise ValueError(
            f"the policy's weight of action {action} in state {', '.join(map(str, state))} "
            f"{underflow_text(table[(*state, action)], model.dtype)}."
        )


def row_weights(
    model: SparseMDP, policy: Array, where: Array = True, shape: tuple[int, ...] | None = None
) -> np.ndarray:
    """A concrete policy of a sparse model as checked row weights ``float64[R]``; `where` as in :func:`valid_policy`.

    Errors name states in `shape`. A policy gives actions ``int[S]``, or weights of actions
    ``float[S, A]`` or of rows ``float[R]``.
    """
    host, policy = model.host, np.asarray(policy)
    if is_deterministic(policy):
        row = rows_of_policy(model, policy, where, shape)
        weight = np.zeros(host.num_rows)
        weight[row[np.broadcast_to(where, row.shape)]] = 1
        return weight
    taken = weights_of_policy(model, policy, shape)
    weight = taken.astype(np.float64)
    require_weights(host, weight, row_tolerance(policy.dtype), where, shape)
    if (small := underflows(taken, policy.dtype)) is not None:
        first = int(np.argmax(small))
        text = underflow_text(taken[first], policy.dtype)
        place = row_actions(model)[first], host.state[first]
        raise ValueError(f"the policy's weight of action {place[0]} in state {place[1]} {text}.")
    return cast(np.ndarray, weight)


def require_weights(
    host: HostMDP,
    weight: np.ndarray,
    tolerance: float,
    where: Array = True,
    shape: tuple[int, ...] | None = None,
) -> None:
    """Raises ValueError unless row weights are a distribution in each state."""
    total = host.over_choices(np.add, weight)
    off = ~((np.abs(total - 1) <= tolerance) & (host.over_choices(np.minimum, weight) >= 0))
    off &= where
    for s in first_true(off):
        row = weight[host.row_start[s] : host.row_start[s + 1]]
        place = (s,) if shape is None else np.unravel_index(s, shape)
        raise ValueError(f"{describe_row(row, place)}.")
