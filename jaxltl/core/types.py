"""Solutions of solvers, their statuses, and the check that they converged."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple, TypeVar, cast

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct

from jaxltl.core.pretty_print import brief, describe
from jaxltl.core.status import Status as Status
from jaxltl.core.validation import RANGES, shorten

SolutionT = TypeVar("SolutionT", bound="Solution")


_REMEDY = {
    Status.UNCERTIFIED: "nothing bounds the error here; check(..., certified=False) accepts a "
    "small residual in place of a bound",
    Status.PRECISION: "rounding alone exceeds the tolerance; loosen it, or use float64",
    Status.MAX_STEPS: "raise max_steps, loosen tolerance, or use float64",
    Status.NONFINITE: "look for NaN or infinity in the reward, the policy or the model",
}
_INVALID = {
    Status.INVALID: "an argument is invalid: probabilities, bounds or hyperparameters are out of "
    "range; call the function outside jit for the details",
    Status.INVALID_POLICY: "the policy is not a distribution over available actions",
    Status.INVALID_DISCOUNT: f"the discount is out of range; it must be {RANGES['discount']}",
    Status.INVALID_OPTION: "an option is out of range: "
    + ", ".join(f"{x} must be {RANGES[x]}" for x in ("tolerance", "max_steps")),
}


class NotConverged(RuntimeError):
    """A solver did not converge; raised by :func:`check`.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                       label={"heads": [1]})
      >>> stopped = jl.reachability_probability(coin, coin.states_with_label("heads")).replace(
      ...     status=np.int32(Status.MAX_STEPS))
      >>> try:
      ...     check(stopped)
      ... except NotConverged as error:
      ...     print(str(error).split(",")[0])
      the solver ended with MAX_STEPS
    """


class AtInitial(NamedTuple):
    """The mean of a quantity over the initial distribution, with certified bounds."""

    value: jax.Array
    lower: jax.Array
    upper: jax.Array


@brief(drawn=True)
@struct.dataclass
class Solution:
    """The solution of a solver, with its evidence.

    Shapes are those of the model's states: ``[S]``, or ``[S, Q]`` for a product.

    Attributes:
      value: the quantity that the solver is named for.
      policy: ``int32[S]`` if deterministic, ``float[S, A]`` if stochastic.
      lower, upper: certified bounds on the true value; infinite without a certificate.
      residual: violation of the value's equation (sup norm).
      num_steps: number of operator applications.
      status: :class:`Status` codes.
      method: the algorithm, if there are several; static.
      nature: of interval models, ``float[T]``: the distribution that nature chooses for each row.
        No policy exceeds the value against an adversarial nature that uses it; policy and a
        cooperative nature attain the value together.
      initial: the initial distribution of the model, in the shape of the value; None where the
        solver does not know it.
      product_policy: of a model and a formula, its
        :class:`~jaxltl.core.models.product_policy.ProductPolicy`, else None; static.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                       label={"heads": [1]})
      >>> found = jl.reachability_probability(coin, coin.states_with_label("heads"))
      >>> found.value.tolist(), Status(int(found.status)).name
      ([0.5, 1.0, 0.0], 'CONVERGED')
      >>> bool((found.lower <= found.value).all() and (found.value <= found.upper).all())
      True
      >>> float(found.at_initial.value)  # the states are equally likely at first
      0.5
    """

    value: jax.Array
    policy: jax.Array
    lower: jax.Array
    upper: jax.Array
    residual: jax.Array
    num_steps: jax.Array
    status: jax.Array
    method: str = struct.field(pytree_node=False, default="")
    nature: jax.Array | None = None
    initial: jax.Array | None = struct.field(default=None, repr=False)
    product_policy: Any = struct.field(pytree_node=False, default=None, repr=False)

    @property
    def at_initial(self) -> AtInitial:
        """Value, lower and upper from the initial distribution; ValueError without one.

        ``sum_s initial(s) value(s)``, of bounds rounded outwards. Of a batch, one for each lane.
        Differentiable as the value is.
        """
        if self.initial is None:
            raise ValueError(
                "this solution has no initial distribution; weigh its value by that of the model."
            )
        axes = tuple(range(jnp.ndim(self.num_steps), jnp.ndim(self.value)))
        xp = jnp if isinstance(self.value, jax.Array) else np
        share = xp.asarray(self.initial, self.value.dtype)
        share = share / share.sum(axes, keepdims=True)

        counts = share > 0
        total = xp.where(counts, share * xp.where(counts, self.value, 0), 0).sum(axes)
        stop: Callable[[Any], Any] = jax.lax.stop_gradient if xp is jnp else np.asarray

        def bound(x: jax.Array, end: int) -> jax.Array:
            x = xp.where(counts, x, 0)
            mean = xp.where(counts, share * x, 0).sum(axes)
            size = xp.where(counts & xp.isfinite(x), share * xp.abs(x), 0).sum(axes)
            slack = (x.size + 4) * xp.finfo(x.dtype).eps * size
            # One state, or equal bounds, need no rounding.
            least = xp.where(counts, x, xp.inf).min(axes)
            same = least == xp.where(counts, x, -xp.inf).max(axes)
            return cast(jax.Array, xp.where(same, least, mean + end * slack))

        low, high = bound(stop(self.lower), -1), bound(stop(self.upper), 1)
        inside = stop(xp.clip(total, low, high))
        if xp is np:
            return AtInitial(inside, low, high)
        return AtInitial(xp.where(inside == total, total, total - stop(total) + inside), low, high)


def check(solution: SolutionT, *, certified: bool = True) -> SolutionT:
    """Returns `solution` if every lane converged; on the host, not inside ``jit``.

    Args:
      solution: one solution or a batch; or the result of a learner's run.
      certified: True to insist on bounds; if False, ``UNCERTIFIED`` is accepted too.

    Returns:
      The solution itself; it is differentiable where the solver's own call is traced, not here.

    Raises:
      NotConverged: some lane did not converge. The message names the status, the first such lane,
        the residual and the remedy.
      ValueError: an argument of the solver was invalid, or `solution` is traced.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                       label={"heads": [1]})
      >>> check(jl.reachability_probability(coin, coin.states_with_label("heads"))).value.tolist()
      [0.5, 1.0, 0.0]
    """
    if not hasattr(solution, "status"):
        raise ValueError(
            f"check is given {describe(solution)}, which has no status; give what the "
            "solver returned, and take the array from it: check(solution).value."
        )
    if isinstance(solution.status, jax.core.Tracer):
        raise ValueError(
            "check(solution) reads values, so it works on the host only: "
            "call it outside jit and vmap, or read solution.status inside."
        )
    status = np.asarray(solution.status)
    failed = np.flatnonzero(
        status.ravel() > (Status.COMPLETED if certified else Status.UNCERTIFIED)
    )
    if failed.size:
        lane = int(failed[0])
        code = Status(int(status.ravel()[lane]))
        where = f" in lane {lane} ({failed.size} of {status.size} lanes)" if status.ndim else ""
        if code >= Status.INVALID:
            policy = getattr(solution, "policy", None)
            reason = _INVALID[code]
            if code == Status.INVALID_POLICY and policy is not None:
                reason = _invalid_policy(np.asarray(policy), status.shape, lane)
            raise ValueError(f"{reason}{where}.")
        residual = np.asarray(solution.residual).ravel()[lane]
        raise NotConverged(
            f"the solver ended with {code.name}{where}, residual {residual:.3g}, after "
            f"{int(np.asarray(solution.num_steps).ravel()[lane])} steps: {_REMEDY[code]}."
        )
    return solution


def status_code(
    converged: chex.Array,
    finite: chex.Array,
    exhausted: chex.Array | bool = False,
    *,
    certified: chex.Array | bool = True,
    valid: chex.Array | bool = True,
) -> jax.Array:
    """The :class:`Status` code of a solver that has ended, as ``int32``."""
    code = jnp.where(exhausted, Status.PRECISION, Status.MAX_STEPS)
    code = jnp.where(converged, jnp.where(certified, Status.CONVERGED, Status.UNCERTIFIED), code)
    code = jnp.where(finite, code, Status.NONFINITE)
    return jnp.where(valid, code, Status.INVALID).astype(jnp.int32)


def worst(*statuses: chex.Array, axis: int | None = None) -> jax.Array:
    """The most severe of several statuses; of one batch, along an axis or of all of it."""
    if len(statuses) == 1:
        return jnp.max(statuses[0], axis=axis)
    return cast(jax.Array, reduce(jnp.maximum, statuses))


def row_tolerance(dtype: object) -> float:
    """Largest admitted deviation from one of the sum of a policy's row."""
    return max(1e-6, 128 * float(jnp.finfo(dtype).eps))


def _invalid_policy(policy: np.ndarray, batch: tuple[int, ...], lane: int) -> str:
    """Describes the first invalid row of one lane's policy; NaN marks unavailable actions."""
    policy = policy.reshape(-1, *policy.shape[len(batch) :])[lane]
    if policy.ndim == 1:
        return _invalid_weights(policy)
    rows = policy.reshape(-1, policy.shape[-1])
    bad = ~(np.abs(rows.sum(-1) - 1) <= row_tolerance(rows.dtype)) | ~(rows >= 0).all(-1)
    if not bad.any():  # inside jit, weights or probabilities may be subnormal
        return f"the policy has a subnormal weight, or {_INVALID[Status.INVALID]}"
    state = int(np.argmax(bad))
    return describe_row(rows[state], np.unravel_index(state, policy.shape[:-1]))


def _invalid_weights(policy: np.ndarray) -> str:
    """Error message for invalid weights ``[R]`` of a sparse model's rows."""
    if (bad := ~(policy >= 0)).any():
        row = int(np.argmax(bad))
        return (
            f"the policy's weight of choice {row} is {policy[row]:.4g}; give each state a "
            "distribution over its choices"
        )
    return "the policy's weights of some state's choices do not sum to 1; give it a distribution"


def describe_row(row: np.ndarray, state: tuple[Any, ...]) -> str:
    """Error message for an invalid row of a policy."""
    where = int(state[0]) if len(state) == 1 else tuple(int(i) for i in state)
    weights = "[" + ", ".join(f"{x:.4g}" for x in row) + "]"
    if np.isnan(row).any():
        problem = (
            f"takes action {int(np.argmax(np.isnan(row)))}, which is not available (or is NaN)"
        )
    elif (row < 0).any():
        problem = f"has the negative probability {row.min():.4g}"
    else:
        problem = f"sums to {row.sum():.6g}, not 1"
    return (
        f"the policy's row {weights} of state {where} {problem}; give each state a distribution "
        "over its available actions"
    )


def require_shape(name: str, array: Any, shape: tuple[int, ...]) -> None:
    """Raises a ValueError that names the argument unless `array` has `shape`."""
    if np.shape(array) != tuple(shape):
        raise ValueError(f"{name} has shape {np.shape(array)}; expected {tuple(shape)}.")


def require_states(name: str, states: Any, shape: tuple[int, ...]) -> None:
    """Raises ValueError unless `states` is one bool for each state; the hint is for state numbers."""
    wanted = f"give bool[{', '.join(map(str, shape))}], one for each state"
    if isinstance(states, str):
        raise ValueError(
            f"{name}={states!r}; {wanted}, such as that label's column of model.label."
        )
    listed = sorted(states) if isinstance(states, set | frozenset) else states
    array: Any = listed if hasattr(listed, "dtype") else np.asarray(listed)
    if listed is states and array.shape == tuple(shape):
        if (
            isinstance(array, jax.core.Tracer)
            or array.dtype == bool
            or np.isin(array, (0, 1)).all()
        ):
            return
        wanted = f"{name} is {shorten(states)}; {wanted}"
    else:
        wanted = f"{name} has shape {array.shape}; expected {tuple(shape)}: {wanted}"
    known = array.dtype.kind in "iu" and not isinstance(array, jax.core.Tracer)
    if known and array.ndim == len(shape) == 1 and np.unique(array).size == array.size:
        wanted += f"; of state numbers, np.isin(np.arange({shape[0]}), {shorten(listed)})"
    raise ValueError(f"{wanted}.")
