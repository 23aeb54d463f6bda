"""Solutions of the sparse engine: enclosures as `Solution`, induced chains, discounted values."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, cast

import jax
import numpy as np
from jax import lax

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.compiled import is_sparse as is_sparse
from jaxltl.core.models.ops.array_namespace import is_traced, namespace, to_jax
from jaxltl.core.models.ops.operators import is_deterministic, require_weights, row_weights
from jaxltl.core.models.protocols import ActionModel, Array, Model
from jaxltl.core.models.sparse import SparseMDP, reward_structure
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers.discounted import discounted_value
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure
from jaxltl.core.types import Solution, Status, row_tolerance
from jaxltl.core.values.engine.state_quantities import clipped, discounted_span, finite_reward


def status_between(
    low: np.ndarray, high: np.ndarray, tolerance: float, *, relative: bool
) -> Status:
    """CONVERGED if bounds are as narrow as the tolerance, or both infinite; else PRECISION.

    A relative tolerance is a share of the lower bound, and so at most the same of the value.
    """
    finite = np.isfinite(high)
    width = np.where(finite, high, 0) - np.where(finite, low, 0)
    scale = np.where(finite, low, 1) if relative else 1
    narrow = (width <= tolerance * scale) & (finite | (low == high))
    return Status.CONVERGED if narrow.all() else Status.PRECISION


def solution_from_enclosure(
    model: Model,
    sparse: SparseMDP | None,
    enclosure: Enclosure,
    tolerance: float,
    *,
    relative: bool,
) -> Solution:
    """A solution in the shapes and precision of a model, with bounds rounded outwards."""
    value, low, high, policy = enclosure.value, enclosure.lower, enclosure.upper, enclosure.row
    status = status_between(low, high, tolerance, relative=relative)
    dtype = np.dtype(np.float64)
    if not is_sparse(model):
        policy = policy if sparse is None else np.asarray(sparse.action)[policy]
        dtype, exact = np.dtype(model.dtype), low == high
        low, high = (
            np.where(exact, x, np.nextafter(x.astype(dtype), end)).astype(dtype)
            for x, end in ((low, dtype.type(-np.inf)), (high, dtype.type(np.inf)))
        )
        # XLA flushes subnormal numbers to zero.
        tiny = np.finfo(dtype).tiny
        low = np.where(low < tiny, 0, low).astype(dtype)
        high = np.where(high > 0, np.maximum(high, tiny), high).astype(dtype)
        high = high if relative else np.minimum(high, 1)
        value = np.clip(value.astype(dtype), low, high)
    parts: list[Array] = [
        *(x.reshape(model.state_shape) for x in (value, policy.astype(np.int32), low, high)),
        np.asarray(enclosure.residual, dtype)[()],
        np.int32(enclosure.rounds),
        np.int32(status),
    ]
    solution = Solution(*(parts if is_sparse(model) else to_jax(parts)))
    return replace(solution, method=enclosure.method)


def complement_event(solution: Solution) -> Solution:
    """The solution of the complementary event, with bounds rounded outwards."""
    value, lower, upper = complement(solution.value, solution.lower, solution.upper)
    return replace(solution, value=value, lower=lower, upper=upper)


def complement(
    value: jax.Array, lower: jax.Array, upper: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A probability and its bounds, for the complementary event."""
    # Bounds that are 0 or 1 stay exact, and NumPy arrays stay NumPy arrays. Differentiable in the
    # value.
    parts = value, upper, lower
    if is_traced(parts):
        parts = parts[0], *lax.stop_gradient(parts[1:])
    xp, value, high, low = namespace(*parts)
    one = xp.ones((), value.dtype)

    def outwards(bound: Array, end: int) -> Array:
        rounded = one - bound
        beyond = xp.clip(xp.nextafter(rounded, end * one), 0, 1)
        # By Sterbenz's lemma, 1 - rounded has no rounding error, so that this test is exact.
        return xp.where(one - rounded == bound, rounded, beyond)

    event: tuple[Array, ...] = one - value, outwards(high, -1), outwards(low, 2)
    if any(isinstance(x, jax.Array) for x in parts):
        event = to_jax(event)
    else:
        event = tuple(np.asarray(x) for x in event)
    return event[0], event[1], event[2]


@brief
class PolicyChain(NamedTuple):
    """Markov chain of a policy."""

    mdp: HostMDP  # the chain
    weight: np.ndarray  # ``float64[R]``, the weight of each row; those of a state sum to one
    depth: int  # the number of roundings behind each probability

    def mean(self, quantity: np.ndarray, row_start: np.ndarray) -> np.ndarray:
        """The mean of a quantity on rows in each state, ``float64[S]``."""
        taken = np.where(self.weight > 0, self.weight * quantity, 0)
        return np.add.reduceat(taken, row_start[:-1])


def induced_chain(model: Model, sparse: SparseMDP, policy: Array) -> PolicyChain:
    """Markov chain induced by a policy."""
    host = sparse.host
    weight = policy_weights(model, sparse, policy, by_rows=is_sparse(model))
    total = host.over_choices(np.add, weight)
    from scipy.sparse import csr_array

    taken = np.flatnonzero(weight > 0)
    count = np.bincount(host.state[taken], minlength=host.num_states)
    starts = np.concatenate([[0], count.cumsum()])
    weight = weight / total[host.state]
    mix = csr_array((weight[taken], taken, starts), shape=(host.num_states, host.num_rows))
    chain = (mix @ host.matrix).tocsr()
    chain.sort_indices()
    num_terms = int(count.max())
    depth = (
        2 * num_terms + 4 if num_terms > 1 else 0
    )  # two sums of that many terms, one to divide by
    states = np.arange(host.num_states + 1)
    return PolicyChain(HostMDP(states, chain.indptr, chain.indices, chain.data), weight, depth)


def policy_weights(
    model: Model, sparse: SparseMDP, policy: Array, *, by_rows: bool, where: Array = True
) -> np.ndarray:
    """A policy of some states as checked weights of rows, ``float64[R]``."""
    policy = np.asarray(policy)
    if by_rows:
        flat = policy.ravel() if policy.shape == model.state_shape else policy
        return row_weights(sparse, flat, where)
    num_actions = cast(ActionModel, model).num_actions
    actions = (*model.state_shape, num_actions)
    if is_deterministic(policy) and policy.shape == actions[:-1]:
        policy = np.eye(num_actions)[policy]
    if policy.shape != actions:
        raise ValueError(
            f"policy has shape {policy.shape}; expected {actions[:-1]} of actions "
            f"or {actions} of their probabilities."
        )
    flat = policy.reshape(sparse.num_states, -1).astype(np.float64)
    weight: np.ndarray = flat[sparse.host.state, np.asarray(sparse.action)]
    require_weights(sparse.host, weight, row_tolerance(np.float64), where)
    return weight


def with_given_policy(solution: Solution, policy: Array) -> Solution:
    """A solution with the policy that was evaluated, if one was given."""
    if policy is None:
        return solution
    table = np.asarray(policy)
    weight: Array = table.astype(np.int32) if is_deterministic(table) else table.copy()
    return replace(solution, policy=weight)


def discounted(
    model: Model,
    reward: Array | str,
    discount: Array,
    *,
    policy: Array | None = None,
    tolerance: Array | None = None,
) -> Solution:
    """Discounted values of a sparse model; arguments as of the functions for padded ones."""
    sparse = to_sparse(model)
    earned, magnitude = finite_reward(sparse, reward)
    host, depth = sparse.host, 0
    largest = float(np.abs(earned).max()) / (1 - float(discount))
    requested = 1e-8 * max(largest, 1e-300) if tolerance is None else float(tolerance)
    if policy is not None:
        chain = induced_chain(model, sparse, policy)
        earned, magnitude = (chain.mean(x, host.row_start) for x in (earned, magnitude))
        host, depth = chain.mdp, chain.depth
    enclosure = discounted_value(
        host, earned, magnitude, float(discount), tolerance=requested, depth=depth
    )
    solution = solution_from_enclosure(model, sparse, enclosure, requested, relative=False)
    span = discounted_span(reward_structure(sparse, reward), float(discount))
    solution = clipped(solution, span) if is_sparse(model) else solution
    return with_given_policy(solution, policy)


def default_tolerance(model: Model | jax.Array) -> float:
    """The default width of an enclosure, by the dtype."""
    return 1e-6 if np.dtype(model.dtype) == np.float64 else 1e-3
