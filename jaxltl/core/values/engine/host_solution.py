"""Solutions of the engine on rows, complements of events, and chains of policies."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from jax import lax

from jaxltl.core.models.ops.array_namespace import is_traced, namespace, to_jax
from jaxltl.core.models.ops.operators import is_deterministic
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.engine.row_form import RowForm, row_form


def status_between(
    low: np.ndarray, high: np.ndarray, tolerance: float, *, relative: bool
) -> Status:
    """CONVERGED if bounds are as narrow as the tolerance, or both infinite; else PRECISION.

    A relative tolerance is a share of the bound nearer to 0, and so at most the same of the value.
    """
    finite = np.isfinite(high)
    width = np.where(finite, high, 0) - np.where(finite, low, 0)
    share = np.where((low < 0) & (high > 0), 0, np.minimum(np.abs(low), np.abs(high)))
    scale = np.where(finite, share, 1) if relative else 1
    narrow = (width <= tolerance * scale) & (finite | (low == high))
    return Status.CONVERGED if narrow.all() else Status.PRECISION


def solution_from_enclosure(
    form: RowForm, enclosure: Enclosure, tolerance: float, *, relative: bool
) -> Solution:
    """A solution in the shapes and precision of a model, with bounds rounded outwards."""
    policy = form.actions(enclosure.row)
    if form.is_padded:
        highest = math.inf if relative else 1.0
        return padded_solution(form.lazy, enclosure, policy, tolerance, highest, relative=relative)
    value, low, high = (
        x.reshape(form.shape) for x in (enclosure.value, enclosure.lower, enclosure.upper)
    )
    return _solution(enclosure, (value, low, high), policy, tolerance, relative)


def padded_solution(
    model: Model,
    enclosure: Enclosure,
    policy: np.ndarray,
    tolerance: float,
    highest: float = 1.0,
    *,
    relative: bool = False,
) -> Solution:
    """A solution of at least 0 in the precision of a padded model, as JAX arrays."""
    dtype, exact = np.dtype(model.dtype), enclosure.lower == enclosure.upper
    low, high = (
        np.where(exact, x, np.nextafter(x.astype(dtype), end)).astype(dtype)
        for x, end in (
            (enclosure.lower, dtype.type(-np.inf)),
            (enclosure.upper, dtype.type(np.inf)),
        )
    )
    # XLA flushes subnormal numbers to zero.
    tiny = np.finfo(dtype).tiny
    low = np.where(low < tiny, 0, low).astype(dtype)
    high = np.where(high > 0, np.maximum(high, tiny), high).astype(dtype)
    high = np.minimum(high, dtype.type(highest))
    value = np.clip(enclosure.value.astype(dtype), low, high)
    ends = tuple(x.reshape(model.state_shape) for x in (value, low, high))
    policy = policy.reshape(model.state_shape)
    solution: Solution = to_jax(_solution(enclosure, ends, policy, tolerance, relative))
    return solution


def _solution(
    enclosure: Enclosure,
    ends: tuple[np.ndarray, ...],
    policy: np.ndarray,
    tolerance: float,
    relative: bool,
) -> Solution:
    value, low, high = ends
    status = status_between(enclosure.lower, enclosure.upper, float(tolerance), relative=relative)
    parts: dict[str, Array] = {
        "value": value,
        "policy": policy.astype(np.int32),
        "lower": low,
        "upper": high,
        "residual": np.asarray(enclosure.residual, value.dtype)[()],
        "num_steps": np.int32(enclosure.rounds),
        "status": np.int32(status),
    }
    return Solution(**parts, method=enclosure.method)


def complement_event(solution: Solution) -> Solution:
    """The solution of the complementary event, with bounds rounded outwards."""
    value, lower, upper = complement(solution.value, solution.lower, solution.upper)
    return replace(solution, value=value, lower=lower, upper=upper)


def negated(solution: Solution) -> Solution:
    """The solution of the negated quantity."""
    return replace(solution, value=-solution.value, lower=-solution.upper, upper=-solution.lower)


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


def induced_chain(model: Model, policy: Array) -> PolicyChain:
    """Markov chain induced by a policy in a concrete model, over flat states."""
    form = row_form(model)
    return policy_chain(form.host, form.weights(policy))


def policy_chain(host: HostMDP, weight: np.ndarray) -> PolicyChain:
    """Markov chain of checked weights of rows ``float64[R]``."""
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


def with_given_policy(solution: Solution, policy: Array) -> Solution:
    """A solution with the policy that was evaluated, if one was given."""
    if policy is None:
        return solution
    table = np.asarray(policy)
    weight: Array = table.astype(np.int32) if is_deterministic(table) else table.copy()
    return replace(solution, policy=weight)


def default_tolerance(model: Model | jax.Array) -> float:
    """The default width of an enclosure, by the dtype."""
    return 1e-6 if np.dtype(model.dtype) == np.float64 else 1e-3
