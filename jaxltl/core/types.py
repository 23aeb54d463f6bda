"""What every solver returns, and how a caller insists that it converged."""

from __future__ import annotations

import enum
from typing import Any, TypeVar

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

SolutionT = TypeVar("SolutionT", bound="Solution")


class Status(enum.IntEnum):
    """How a solver ended. One code per lane under ``vmap``."""

    CONVERGED = 0
    MAX_STEPS = 1
    NONFINITE = 2
    PRECISION = 3


_REMEDY = {
    Status.MAX_STEPS: "raise max_steps, loosen tolerance, or use float64",
    Status.NONFINITE: "look for NaN or infinity in the reward, the policy or the discount",
    Status.PRECISION: "rounding alone exceeds the tolerance; loosen it, or use float64",
}


class NotConverged(RuntimeError):
    """A solver's answer was asked for and its status says that there is none."""


@struct.dataclass
class Solution:
    """A solver's answer with its evidence.

    Shapes are those of the model's states: ``[S]``, or ``[S, Q]`` for a product.

    Attributes:
      value: the quantity that the solver is named for.
      policy: the policy that belongs to the value: ``int32[S]`` where it is
        deterministic, ``float[S, A]`` where it is stochastic.
      lower, upper: a certified enclosure of the true value, or infinite.
      residual: how far the value is from satisfying its equation (sup norm).
      num_steps: sweeps of the operator that were spent.
      status: an array of :class:`Status` codes.
    """

    value: jax.Array
    policy: jax.Array
    lower: jax.Array
    upper: jax.Array
    residual: jax.Array
    num_steps: jax.Array
    status: jax.Array


def check(solution: SolutionT) -> SolutionT:
    """Returns `solution` if every lane converged; a host-side gate, not for use inside ``jit``.

    Raises:
      NotConverged: some lane did not converge. The message names the status, the
        first such lane, the residual and what to do.
      ValueError: called on traced values.
    """
    if isinstance(solution.status, jax.core.Tracer):
        raise ValueError(
            "check(solution) reads values, so it works on the host only: "
            "call it outside jit and vmap, or read solution.status inside."
        )
    status = np.asarray(solution.status)
    failed = np.flatnonzero(status.ravel() != Status.CONVERGED)
    if failed.size:
        lane = int(failed[0])
        code = Status(int(status.ravel()[lane]))
        residual = np.asarray(solution.residual).ravel()[lane]
        where = f" in lane {lane} ({failed.size} of {status.size} lanes)" if status.ndim else ""
        raise NotConverged(
            f"the solver ended with {code.name}{where}, residual {residual:.3g}, after "
            f"{int(np.asarray(solution.num_steps).ravel()[lane])} steps: {_REMEDY[code]}."
        )
    return solution


def status_code(
    converged: chex.Array, finite: chex.Array, exhausted: chex.Array | bool = False
) -> jax.Array:
    """The :class:`Status` of a loop that has ended, as ``int32``.

    `exhausted`: whether the bounds are as narrow as rounding lets them be.
    """
    code = jnp.where(exhausted, Status.PRECISION, Status.MAX_STEPS)
    code = jnp.where(converged, Status.CONVERGED, code)
    return jnp.where(finite, code, Status.NONFINITE).astype(jnp.int32)


def require_shape(name: str, array: Any, shape: tuple[int, ...]) -> None:
    """Raises a ValueError that names the argument unless `array` has `shape`."""
    if np.shape(array) != tuple(shape):
        raise ValueError(f"{name} has shape {np.shape(array)}; expected {tuple(shape)}.")
