"""The primitives through which every algorithm sees a model.

A model is an :class:`~jaxltl.core.models.mdp.MDP`, a :class:`~jaxltl.core.models.mdp.DenseMDP`, a
:class:`~jaxltl.core.models.sparse.SparseMDP` or a
:class:`~jaxltl.core.models.product.Product`. Values have the shape of the model's states,
``[S]`` or ``[S, Q]``, and quantities on actions have one more axis, A; of a sparse model they are
``[R]``, and an action is a row. Reductions over a state's choices are those of
:func:`~jaxltl.core.models.ops.choices.choices`. The functions are open (``functools.singledispatch``):
a representation of one's own needs ``expectation``, ``exists_successor``, ``forall_successor`` and
``sample_successor``, and ``least_successor`` where ranks are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import singledispatch
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.models.mdp import MDP, DenseMDP
from jaxltl.core.models.ops import kernels
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.ops.choices import action_argmax as action_argmax
from jaxltl.core.models.ops.choices import action_max as action_max
from jaxltl.core.models.ops.choices import action_mean as action_mean
from jaxltl.core.models.ops.choices import choice_shape, choices
from jaxltl.core.models.ops.choices import first_action as first_action
from jaxltl.core.models.ops.choices import is_deterministic as is_deterministic
from jaxltl.core.models.ops.entries import row_entries
from jaxltl.core.models.ops.kernels import where_positive
from jaxltl.core.models.protocols import Model
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.types import describe_row, row_tolerance
from jaxltl.core import validation


@singledispatch
def expectation(model: Model, value: jax.Array) -> jax.Array:
    """Expected value of the next state, ``(P v)(s, a) = sum_t P(t | s, a) v(t)``.

    Args:
      model: the model.
      value: ``float[S]``.

    Returns:
      ``float[S, A]``, zero at unavailable actions. Linear in `value` and in the
      transition probabilities, and differentiable in both.

    Raises:
      TypeError: the model is none.

    Example:
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[0.5, 0.5]], [[0.0, 1.0]]])
      >>> expectation(mdp, jnp.array([0.0, 4.0])).tolist()
      [[2.0], [4.0]]
    """
    raise TypeError(_unknown(model))


@singledispatch
def exists_successor(model: Model, region: jax.Array) -> jax.Array:
    """Whether some successor lies in a region: ``bool[S, A]`` from ``bool[S]``.

    Decided on the support of the transition function. False at unavailable actions.

    Args:
      model: the model.
      region: ``bool[S]``.

    Returns:
      ``bool[S, A]``, of a sparse model ``bool[R]``. Boolean: there is no derivative.

    Raises:
      TypeError: the model is none.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.make_sparse([0, 2, 3, 4], [0, 2, 3, 4, 5], [1, 2, 0, 1, 2], [0.5, 0.5, 1, 1, 1])
      >>> exists_successor(fork, np.array([False, True, False])).tolist()  # one for each choice
      [True, False, True, False]
    """
    raise TypeError(_unknown(model))


@singledispatch
def forall_successor(model: Model, region: jax.Array) -> jax.Array:
    """Whether all successors lie in a region: ``bool[S, A]`` from ``bool[S]``.

    Decided on the support; padding counts as true, so unavailable actions are True.

    Args:
      model: the model.
      region: ``bool[S]``.

    Returns:
      ``bool[S, A]``, of a sparse model ``bool[R]``. Boolean: there is no derivative.

    Raises:
      TypeError: the model is none.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.make_sparse([0, 2, 3, 4], [0, 2, 3, 4, 5], [1, 2, 0, 1, 2], [0.5, 0.5, 1, 1, 1])
      >>> forall_successor(fork, np.array([False, True, True])).tolist()  # one for each choice
      [True, False, True, True]
    """
    raise TypeError(_unknown(model))


@singledispatch
def least_successor(model: Model, value: jax.Array) -> jax.Array:
    """Smallest value among the successors: ``[S, A]`` from ``[S]``.

    Decided on the support; the largest value of the dtype at unavailable actions.
    """
    raise TypeError(_unknown(model))


@singledispatch
def sample_successor(
    model: Model, key: chex.PRNGKey, state: jax.Array, action: jax.Array
) -> jax.Array:
    """One draw from ``P(. | state, action)``; the key is consumed.

    A product's states are numbered ``s * Q + q``, the order of a flattened value.

    Args:
      model: the model.
      key: a PRNG key.
      state, action: ``int32[]``.

    Returns:
      ``int32[]``, the successor. Drawn: there is no derivative.

    Raises:
      TypeError: the model is none.

    Example:
      >>> import jaxltl as jl
      >>> cycle = jl.make_mdp([[[1]], [[0]]], [[[1.0]], [[1.0]]])
      >>> int(jax.jit(sample_successor)(cycle, jax.random.key(0), 0, 0))
      1
    """
    raise TypeError(_unknown(model))


@singledispatch
def induced_chain(model: Model, policy: jax.Array) -> MDP | DenseMDP:
    """The Markov chain of a deterministic policy, as a model with one action.

    Args:
      model: the model.
      policy: ``int32[S]``.

    Returns:
      A model without labels. Of a product it has ``S * Q`` states, numbered
      ``s * Q + q``. Differentiable in the transition probabilities.
    """
    raise TypeError(_unknown(model))


@singledispatch
def transition_matrix(model: Model, policy: jax.Array) -> jax.Array:
    """``P_pi(s, t) = sum_a pi(s, a) P(t | s, a)`` as a full matrix, for small models.

    Args:
      model: the model.
      policy: ``float[S, A]``.

    Returns:
      ``float[S, S]``; of a product, over states numbered ``s * Q + q``.
    """
    raise TypeError(_unknown(model))


@singledispatch
def policy_operator(model: Model, policy: jax.Array) -> Callable[[jax.Array], jax.Array]:
    """``v -> P_pi v`` of a deterministic policy, ``float[N]`` from ``float[N]``, for sweeps."""
    return chain_operator(induced_chain(model, policy))


def chain_operator(chain: Model) -> Callable[[jax.Array], jax.Array]:
    """``v -> P v`` of a model with one action."""
    return lambda value: expectation(chain, value)[:, 0]


def pushforward(model: Model, mass: jax.Array) -> jax.Array:
    """Mass that flows into each state, ``(P' x)(t) = sum_{s, a} P(t | s, a) x(s, a)``.

    The transpose of :func:`expectation`, for every representation.

    Args:
      model: the model.
      mass: ``float[S, A]``.

    Returns:
      ``float[S]``. Linear in `mass` and in the transition probabilities, and differentiable
      in both.

    Raises:
      TypeError: the model is none.

    Example:
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[0.5, 0.5]], [[0.0, 1.0]]])
      >>> pushforward(mdp, jnp.array([[1.0], [2.0]])).tolist()
      [0.5, 2.5]
    """
    value = jax.ShapeDtypeStruct(model.state_shape, mass.dtype)
    (result,) = jax.linear_transpose(lambda v: expectation(model, v), value)(mass)
    return result


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
    """Terms of a weight and the value there, combined over the successors of each choice.

    What :func:`expectation`, :func:`exists_successor` and :func:`least_successor` are made of where
    a model is written down as successors.

    Args:
      model: the model.
      value: ``[S, ...]``.
      term, combine: as of :func:`~jaxltl.core.models.ops.kernels.fold`.

    Returns:
      ``[S, ..., A]``.
    """
    raise TypeError(_unknown(model))


@singledispatch
def unpadded_states(model: Model) -> jax.Array | bool:
    """The states that are the model's own: all, but of one on a mesh ``bool[N]``."""
    return True


@singledispatch
def greatest_predecessor(model: Model, quantity: jax.Array) -> jax.Array:
    """Largest quantity among the choices that may lead to a state: ``[S, ...]``, ``[S, ..., A]``.

    Decided on the support; 0 where no choice leads.

    Args:
      model: the model.
      quantity: integers, at least 0; of a product ``[S, Q, A]``.
    """
    raise TypeError(_unknown(model))


@expectation.register
def _(model: MDP, value: jax.Array) -> jax.Array:
    return combined(model, value, jnp.multiply, jnp.add)


@exists_successor.register
def _(model: MDP, region: jax.Array) -> jax.Array:
    return combined(model, jnp.asarray(region), kernels.positive_hits, jnp.logical_or)


@forall_successor.register
def _(model: MDP, region: jax.Array) -> jax.Array:
    return ~exists_successor(model, ~jnp.asarray(region))


@least_successor.register
def _(model: MDP, value: jax.Array) -> jax.Array:
    return combined(model, value, where_positive, jnp.minimum)


@combined.register
def _(model: MDP, value: jax.Array, term: Any, combine: Any) -> jax.Array:
    weight = model.successor_probability
    return kernels.stacked(kernels.by_action(model.successor, weight, value, term, combine))


@greatest_predecessor.register
def _(model: MDP, quantity: jax.Array) -> jax.Array:
    wide = quantity.shape[1:-1]
    used = (model.successor_probability > 0).reshape(*model.successor.shape, *(1,) * len(wide))
    sent = jnp.where(used, jnp.moveaxis(quantity, -1, 1)[:, :, None], 0)  # [S, A, K, ...]
    return jnp.zeros(quantity.shape[:-1], quantity.dtype).at[model.successor].max(sent)


@sample_successor.register
def _(model: MDP, key: chex.PRNGKey, state: jax.Array, action: jax.Array) -> jax.Array:
    k = _sample(key, model.successor_probability[state, action])
    return model.successor[state, action, k]


@induced_chain.register
def _(model: MDP, policy: jax.Array) -> MDP:
    pick = policy[:, None, None]
    return make_chain(
        jnp.take_along_axis(model.successor, pick, axis=1)[:, 0],
        jnp.take_along_axis(model.successor_probability, pick, axis=1)[:, 0],
        model.initial,
    )


@transition_matrix.register
def _(model: MDP, policy: jax.Array) -> jax.Array:
    return scatter_matrix(model.successor, policy[:, :, None] * model.successor_probability)


def scatter_matrix(successor: jax.Array, weight: jax.Array) -> jax.Array:
    """``float[S, S]`` that adds weights ``[S, A, K]`` at (s, successor)."""
    num_states = successor.shape[0]
    row = jnp.arange(num_states)[:, None, None]
    return jnp.zeros((num_states, num_states), weight.dtype).at[row, successor].add(weight)


def make_chain(successor: jax.Array, probability: jax.Array, initial: jax.Array) -> MDP:
    """An MDP with one action from ``int32[S, K]`` successors and their probabilities."""
    num_states = successor.shape[0]
    return MDP(
        successor=successor[:, None, :],
        probability=probability[:, None, :],
        available=jnp.ones((num_states, 1), bool),
        initial=initial,
        label=jnp.zeros((num_states, 0), bool),
    )


@expectation.register
def _(model: DenseMDP, value: jax.Array) -> jax.Array:
    return jnp.einsum("sat,t->sa", model.successor_probability, value)


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
    return jnp.einsum("sa,sat->st", policy, model.successor_probability)


@exists_successor.register
def _(model: DenseMDP, region: jax.Array) -> jax.Array:
    return jnp.any((model.successor_probability > 0) & region, axis=-1)


@forall_successor.register
def _(model: DenseMDP, region: jax.Array) -> jax.Array:
    return jnp.all((model.successor_probability <= 0) | region, axis=-1)


@least_successor.register
def _(model: DenseMDP, value: jax.Array) -> jax.Array:
    return where_positive(model.successor_probability, value).min(-1)


@sample_successor.register
def _(model: DenseMDP, key: chex.PRNGKey, state: jax.Array, action: jax.Array) -> jax.Array:
    return _sample(key, model.successor_probability[state, action]).astype(jnp.int32)


def _sample(key: chex.PRNGKey, probability: jax.Array) -> jax.Array:
    return jax.random.categorical(key, jnp.log(probability))


@expectation.register
def _(model: SparseMDP, value: jax.Array) -> jax.Array:
    return row_entries(model).expectation(value)


@exists_successor.register
def _(model: SparseMDP, region: jax.Array) -> jax.Array:
    of = row_entries(model)
    inside = kernels.positive_hits(of.probability, kernels.gather(region, of.successor))
    return of.over_entries(jax.ops.segment_max, inside.astype(jnp.int32)) > 0


@forall_successor.register
def _(model: SparseMDP, region: jax.Array) -> jax.Array:
    return ~exists_successor(model, ~jnp.asarray(region))


@least_successor.register
def _(model: SparseMDP, value: jax.Array) -> jax.Array:
    of = row_entries(model)
    reached = where_positive(of.probability, kernels.gather(value, of.successor))
    return of.over_entries(jax.ops.segment_min, reached)


@sample_successor.register
def _(model: SparseMDP, key: chex.PRNGKey, state: jax.Array, action: jax.Array) -> jax.Array:
    del state  # a row is one state's
    probability, start = jnp.asarray(model.probability), jnp.asarray(model.entry_start)
    end = start[action + 1]

    def step(carry: Any) -> Any:
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


def policy_distribution(model: Model, policy: Any) -> jax.Array:
    """Any policy as ``float[S, A]``, of a sparse model ``float[R]``, its shape checked.

    Raises:
      ValueError: the policy has neither the shape of states nor of state-action pairs.
    """
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
    return policy


class Policy(NamedTuple):
    """A policy as a solver uses it.

    Attributes:
      distribution: ``float[S, A]``; the policy, made uniform where its row is none.
      given: the same with the rows as they were, NaN at unavailable actions that they take.
      valid: ``bool[]``, whether every row was a distribution over available actions.
    """

    distribution: jax.Array
    given: jax.Array
    valid: jax.Array


def valid_policy(model: Model, policy: jax.Array, where: jax.Array | bool = True) -> Policy:
    """A policy and whether it is one: rows at least 0, summing to 1, on available actions.

    Args:
      model: the model.
      policy: ``float[S, A]`` or ``int32[S]``; differentiable in the former.
      where: ``bool[S]``, the states whose rows count.
    """
    policy, over = policy_distribution(model, policy), choices(model)
    available = over.available
    given = jnp.where(available | (policy == 0), policy, jnp.nan)
    total = over.sum(given)
    row = (jnp.abs(total - 1) <= row_tolerance(policy.dtype)) & over.all(given >= 0)
    row |= ~jnp.asarray(where & unpadded_states(model))
    uniform = available / over.spread(jnp.maximum(over.sum(available), 1))
    used = jnp.where(
        over.spread(row), jnp.where(available, policy, 0), uniform.astype(policy.dtype)
    )
    return Policy(used, lax.stop_gradient(given), jnp.all(row))


def require_policy(model: Model, policy: Any, where: Any = True) -> None:
    """Raises on the host unless a policy is one; passes over traced arrays.

    Raises:
      ValueError: a row is no distribution over available actions, with its state; or a shape.
    """
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
        if bad.any():
            state = np.argwhere(bad)[0]
            name = state[0] if len(state) == 1 else tuple(state.tolist())
            actions = np.flatnonzero(available[tuple(state)]).tolist()
            raise ValueError(
                f"the policy takes action {table[tuple(state)]} in state {name}, "
                f"which is not available; choose one of {actions}."
            )
        return
    if table.shape != shape:
        policy_distribution(model, table)
    given = np.where(available | (table == 0), table, np.nan)
    good = (np.abs(given.sum(-1) - 1) <= row_tolerance(table.dtype)) & (given >= 0).all(-1)
    if not (good | ~np.asarray(where)).all():
        state = np.argwhere(~good & where)[0]
        raise ValueError(f"{describe_row(given[tuple(state)], tuple(state))}.")


def row_weights(model: SparseMDP, policy: Any, where: Any = True) -> np.ndarray:
    """A policy of a sparse model as weights of its rows, ``float64[R]``, on the host.

    Args:
      model: a concrete sparse model.
      policy: rows ``int32[S]``, or their weights ``float[R]``.
      where: ``bool[S]``, the states whose rows count.

    Raises:
      ValueError: a shape is wrong, or a state's row is not one of its own, or its weights are no
        distribution.
    """
    host, policy = model.host, np.asarray(policy)
    if is_deterministic(policy):
        if policy.shape != (host.num_states,):
            raise ValueError(
                f"policy has shape {policy.shape}; expected ({host.num_states},), a "
                f"row for each state, or ({host.num_rows},) weights of rows."
            )
        wrong = ((policy < host.row_start[:-1]) | (policy >= host.row_start[1:])) & where
        if wrong.any():
            s = int(np.flatnonzero(wrong)[0])
            raise ValueError(
                f"the policy takes row {policy[s]} in state {s}, whose rows are "
                f"{host.row_start[s]} to {host.row_start[s + 1] - 1}."
            )
        weight = np.zeros(host.num_rows)
        weight[policy[np.broadcast_to(where, policy.shape)]] = 1
        return weight
    if policy.shape != (host.num_rows,):
        raise ValueError(
            f"policy has shape {policy.shape}; expected ({host.num_rows},), a weight "
            "for each choice."
        )
    weight = policy.astype(np.float64)
    require_weights(host, weight, row_tolerance(policy.dtype), where)
    return weight


def require_weights(host: Any, weight: np.ndarray, tolerance: float, where: Any = True) -> None:
    """Raises a ValueError unless weights ``float[R]`` are a distribution in each state."""
    total = host.over_choices(np.add, weight)
    off = ~((np.abs(total - 1) <= tolerance) & (host.over_choices(np.minimum, weight) >= 0))
    off &= where
    if off.any():
        s = int(np.flatnonzero(off)[0])
        row = weight[host.row_start[s] : host.row_start[s + 1]]
        raise ValueError(f"{describe_row(row, (s,))}.")
