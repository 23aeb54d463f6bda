"""Discounted visitation measures of a policy, and expectations under them."""

from __future__ import annotations


import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.ops.array_namespace import jit
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.models.compiled import compiled_form, compiled_policy
from jaxltl.core.models.mdp import MDP, DenseMDP
from jaxltl.core.models.ops.choices import choices
from jaxltl.core.models.ops.operators import pushforward, require_policy, valid_policy
from jaxltl.core.models.ops.successor_tables import sweep_operator
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model, PyTree
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.types import Solution, require_shape, status_code
from jaxltl.core.values.engine.certificates import backup_error, most_choices, refuse
from jaxltl.core.values.engine.implicit_diff import implicit
from jaxltl.core.values.engine.iterate import sequential_vmap
from jaxltl.core.values.engine.linear import System, Transposed, solver


@validated()
def occupancy_measure(
    model: Model,
    policy: jax.Array,
    discount: jax.Array | float,
    *,
    initial: jax.Array | None = None,
    tolerance: jax.Array | float | None = None,
) -> Solution:
    """Expected discounted visits, ``x(s, a) = sum_t discount^t P(s_t = s, a_t = a)``.

    The solution of ``x(t, .) = pi(. | t) (initial(t) + discount * (P' x)(t))`` (Puterman
    1994, section 6.9). Its sum is ``1 / (1 - discount)``.

    Args:
      model, policy, discount, tolerance: as in
        :func:`~jaxltl.core.values.discounted.discounted.policy_value`.
      initial: ``float[S]``, initial mass; default the model's initial distribution.

    Returns:
      :class:`Solution`; `value`, `lower` and `upper` are ``float[S, A]``, of a sparse model
      ``float[R]``. Differentiable in the policy, the discount, `initial` and the probabilities.

    Raises:
      ValueError: the policy has the wrong shape or is invalid (inside ``jit``: a status).

    Example:
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[0, 1.0]], [[0, 1.0]]], initial=[1, 0])
      >>> x = occupancy_measure(mdp, jnp.array([0, 0]), 0.5).value
      >>> [round(v, 4) for v in x[:, 0].tolist()]
      [1.0, 1.0]
    """
    (form, _), policy = compiled_form(model), compiled_policy(model, policy)
    if not isinstance(form, SparseMDP):  # its policy is checked above
        require_policy(form, policy)
    if initial is not None:
        require_shape("initial", initial, model.state_shape)
    start = model.initial if initial is None else initial
    return _occupancy(form, policy, discount, start, tolerance)


@jit()
def _occupancy(
    model: PyTree, policy: Array, discount: Array, start: Array, tolerance: Array | None
) -> Solution:
    checked, over = valid_policy(model, policy), choices(model)
    policy = checked.distribution
    discount = jnp.asarray(discount, model.dtype)
    start = jnp.asarray(start, model.dtype)
    shape = model.state_shape
    start = jnp.broadcast_to(start, shape) if start.ndim < 2 else start.reshape(shape)

    def flow(d: jax.Array) -> jax.Array:
        result: jax.Array = start + discount * pushforward(model, over.broadcast(d) * policy)
        return result

    system = System(sweep_operator(model), over.columns(policy), discount)
    linear = solver(system)
    visits, n = sequential_vmap(_visits, model, policy, discount, start, linear)
    residual = jnp.sum(jnp.abs(flow(visits) - visits))
    gap = jnp.where(discount < 1, 1 - discount, jnp.nan)
    # The operator is a contraction in the sum norm, and a state's inflow sums what all pairs that
    # lead there contribute.
    epsilon = float(jnp.finfo(model.dtype).eps)
    terms = lax.stop_gradient(_inflow_terms(model)) + most_choices(model) + 4
    rounding = jnp.sum(backup_error(epsilon * terms, jnp.abs(visits))) / gap
    # So does the sum over the states.
    rounding, residual = (x * (1 + model.num_states * epsilon) for x in (rounding, residual))
    bound = residual / gap + rounding
    finite = jnp.isfinite(bound)
    bound = jnp.where(finite, bound, jnp.inf)
    goal = 4 * rounding if tolerance is None else tolerance / 2 - rounding / 4
    visits = implicit(flow, visits, Transposed(linear))
    value = over.broadcast(visits) * policy
    frozen = lax.stop_gradient(value)
    solution = Solution(
        value=value,
        policy=policy,
        lower=lax.stop_gradient(jnp.maximum(frozen - bound, 0)),
        upper=lax.stop_gradient(frozen + bound),
        residual=lax.stop_gradient(residual),
        num_steps=n,
        status=status_code(
            lax.stop_gradient(bound <= goal), lax.stop_gradient(finite), bound <= 8 * rounding
        ),
    )
    return refuse(solution, checked)


def _inflow_terms(model: Model) -> jax.Array:
    """Number of terms of each state's inflow, ``[S]`` or more."""
    if isinstance(model, Product):
        return _inflow_terms(model.mdp)[:, None] + model.num_memory
    if isinstance(model, MDP):
        used = model.successor_probability > 0
        return jnp.zeros(model.num_states, jnp.int32).at[model.successor].add(used)
    if isinstance(model, DenseMDP):
        return jnp.sum(model.successor_probability > 0, axis=(0, 1))
    if isinstance(model, SparseMDP):
        return jnp.bincount(jnp.asarray(model.successor), length=model.num_states)
    return jnp.full(model.state_shape, model.num_states * most_choices(model))


def _visits(
    model: PyTree, policy: Array, discount: Array, start: Array, linear: PyTree
) -> tuple[jax.Array, jax.Array]:
    visits, n = linear.counted(start, transposed=True)
    flow = start + discount * pushforward(model, choices(model).broadcast(visits) * policy)
    # One step of iterative refinement.
    more, m = linear.counted(flow - visits, transposed=True)
    return visits + more, n + m + 1


def feature_expectation(occupancy: jax.Array, features: jax.Array) -> jax.Array:
    """Expected discounted features, ``sum_{s, a} x(s, a) f(s, a)``: ``float[F]``.

    Args:
      occupancy: ``float[S, A]``, the value of :func:`occupancy_measure`; of a product
        ``float[S, Q, A]``, of a sparse model ``float[R]``.
      features: one axis more, ``float[S, A, F]``.

    Returns:
      ``float[F]``; linear in both, and differentiable in them.

    Raises:
      TypeError: the shapes do not match.

    Example:
      >>> visits = jnp.array([[1.0, 0.5], [0.0, 2.5]])
      >>> kind = jnp.array([[[1.0, 0], [1, 0]], [[0, 1], [0, 1]]])  # which state
      >>> feature_expectation(visits, kind).tolist()
      [1.5, 2.5]
    """
    return jnp.tensordot(occupancy, features, axes=occupancy.ndim)
