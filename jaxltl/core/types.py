"""What every solver returns, and how a caller insists that it converged."""

from __future__ import annotations

import enum
from collections.abc import Iterator
from typing import Any, TypeVar

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxltl.core.pretty_print import apart, array, brief, coded, is_array, lanes, span, told

SolutionT = TypeVar("SolutionT", bound="Solution")


class Status(enum.IntEnum):
    """How a solver ended, the more severe the greater. One code per lane under ``vmap``.

    - ``CONVERGED``: the certified bounds are as narrow as asked.
    - ``UNCERTIFIED``: the residual is as small as asked, but no bound on the error is known.
    - ``PRECISION``: rounding alone keeps the bounds wider than asked.
    - ``MAX_STEPS``: it was stopped, or cannot get nearer.
    - ``NONFINITE``: NaN or infinity where a number should be.
    - ``INVALID``: a policy that is no distribution over available actions.

    Example:
      >>> [status.name for status in Status if status > Status.MAX_STEPS]
      ['NONFINITE', 'INVALID']
    """

    CONVERGED = 0
    UNCERTIFIED = 1
    PRECISION = 2
    MAX_STEPS = 3
    NONFINITE = 4
    INVALID = 5


_REMEDY = {
    Status.UNCERTIFIED: "nothing bounds the error here; check(..., certified=False) accepts a "
    "small residual in place of a bound",
    Status.PRECISION: "rounding alone exceeds the tolerance; loosen it, or use float64",
    Status.MAX_STEPS: "raise max_steps, loosen tolerance, or use float64",
    Status.NONFINITE: "look for NaN or infinity in the reward, the policy or the discount",
}


class NotConverged(RuntimeError):
    """A solver's answer was asked for and its status says that there is none; by :func:`check`.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                       label={"heads": [1]})
      >>> stopped = jl.reachability_probability(coin, coin.states_where("heads")).replace(
      ...     status=np.int32(Status.MAX_STEPS))
      >>> try:
      ...     check(stopped)
      ... except NotConverged as error:
      ...     print(str(error).split(",")[0])
      the solver ended with MAX_STEPS
    """


class Method:
    """How an answer was found, in words. All are equal, so that solutions are of one kind.

    >>> str(Method("the graph")), Method("levels") == Method("")
    ('the graph', True)
    """

    def __init__(self, text: str = "") -> None:
        self.text = text

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return repr(self.text)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Method)

    def __hash__(self) -> int:
        return 0


def _facts(solution: Any) -> Iterator[str]:
    more = solution.status.shape
    yield (
        f"{lanes(more)}: {coded(solution.status, Status)}"
        if more
        else (coded(solution.status, Status))
    )
    yield f"value {told(solution.value)}"
    yield apart(solution.lower, solution.upper)
    steps = span(solution.num_steps)
    yield "1 step" if steps == "1" else f"{steps} steps"
    yield f"residual {span(solution.residual)}"
    yield f"by {solution.method}" if str(solution.method) else ""
    yield f"policy {array(solution.policy)}" if is_array(solution.policy) else ""
    yield f"nature {array(solution.nature)}" if is_array(solution.nature) else ""


@brief(facts=_facts, drawn=True)
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
      num_steps: applications of the operator that were spent.
      status: an array of :class:`Status` codes.
      method: how it was found, where there were several ways; static.
      nature: of interval models, ``float[T]``: the distribution that nature picks for each choice,
        so that someone else can check. Where it is against the policy, no policy does better than
        the value if nature keeps to it; where it is for it, both attain the value together.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                       label={"heads": [1]})
      >>> found = jl.reachability_probability(coin, coin.states_where("heads"))
      >>> found.value.tolist(), Status(int(found.status)).name
      ([0.5, 1.0, 0.0], 'CONVERGED')
      >>> bool((found.lower <= found.value).all() and (found.value <= found.upper).all())
      True
    """

    value: jax.Array
    policy: jax.Array
    lower: jax.Array
    upper: jax.Array
    residual: jax.Array
    num_steps: jax.Array
    status: jax.Array
    method: Method = struct.field(pytree_node=False, default=Method())
    nature: jax.Array | None = None


def check(solution: SolutionT, *, certified: bool = True) -> SolutionT:
    """Returns `solution` if every lane converged; a host-side gate, not for use inside ``jit``.

    Args:
      solution: one, or a batch.
      certified: insist on bounds; False accepts ``UNCERTIFIED``, a small residual, too.

    Returns:
      The solution that was given. Values are read, so that derivatives are taken of the solver's
      own call.

    Raises:
      NotConverged: some lane did not converge. The message names the status, the
        first such lane, the residual and what to do.
      ValueError: a policy was none, with the state and its row; or called on traced values.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1],
      ...                       label={"heads": [1]})
      >>> check(jl.reachability_probability(coin, coin.states_where("heads"))).value.tolist()
      [0.5, 1.0, 0.0]
    """
    if isinstance(solution.status, jax.core.Tracer):
        raise ValueError(
            "check(solution) reads values, so it works on the host only: "
            "call it outside jit and vmap, or read solution.status inside."
        )
    status = np.asarray(solution.status)
    failed = np.flatnonzero(status.ravel() > (Status.CONVERGED if certified else 1))
    if failed.size:
        lane = int(failed[0])
        code = Status(int(status.ravel()[lane]))
        where = f" in lane {lane} ({failed.size} of {status.size} lanes)" if status.ndim else ""
        if code == Status.INVALID:
            lanes = np.asarray(solution.policy).reshape(status.size, -1)
            shape = np.shape(solution.policy)[status.ndim :]
            policy = lanes[lane].reshape(shape)
            what = _invalid_weights(policy) if policy.ndim == 1 else _invalid_row(policy)
            raise ValueError(f"{what}{where}.")
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
    """The :class:`Status` of a solver that has ended, as ``int32``.

    Args:
      converged: whether it reached what was asked.
      finite: whether there are numbers where numbers should be.
      exhausted: whether the bounds are as narrow as rounding lets them be.
      certified: whether what converged is a bound, not just a residual.
      valid: whether what it was given is allowed.
    """
    code = jnp.where(exhausted, Status.PRECISION, Status.MAX_STEPS)
    code = jnp.where(converged, jnp.where(certified, Status.CONVERGED, Status.UNCERTIFIED), code)
    code = jnp.where(finite, code, Status.NONFINITE)
    return jnp.where(valid, code, Status.INVALID).astype(jnp.int32)


def worst(*statuses: chex.Array, axis: int | None = None) -> jax.Array:
    """The most severe of several statuses; of one batch, along an axis or of all of it."""
    if len(statuses) == 1:
        return jnp.max(statuses[0], axis=axis)
    found = statuses[0]
    for status in statuses[1:]:
        found = jnp.maximum(found, status)
    return found


# --- policies that are none -----------------------------------------------------------------


def row_tolerance(dtype: Any) -> float:
    """How far from one the sum of a policy's row may be."""
    return max(1e-6, 128 * float(jnp.finfo(dtype).eps))


def _invalid_row(policy: np.ndarray) -> str:
    """What is wrong with the first row that is no distribution; NaN marks what is unavailable."""
    rows = policy.reshape(-1, policy.shape[-1])
    bad = ~(np.abs(rows.sum(-1) - 1) <= row_tolerance(rows.dtype)) | ~(rows >= 0).all(-1)
    state = int(np.argmax(bad))
    return describe_row(rows[state], np.unravel_index(state, policy.shape[:-1]))


def _invalid_weights(policy: np.ndarray) -> str:
    """What is wrong with weights ``[R]`` of a sparse model's choices; the states are not known."""
    if (bad := ~(policy >= 0)).any():
        row = int(np.argmax(bad))
        return (
            f"the policy's weight of choice {row} is {policy[row]:.4g}; give each state a "
            "distribution over its choices"
        )
    return "the policy's weights of some state's choices do not sum to 1; give it a distribution"


def describe_row(row: np.ndarray, state: tuple[Any, ...]) -> str:
    """What is wrong with the row of a policy, in words."""
    where = int(state[0]) if len(state) == 1 else tuple(int(i) for i in state)
    shown = "[" + ", ".join(f"{x:.4g}" for x in row) + "]"
    if np.isnan(row).any():
        what = f"takes action {int(np.argmax(np.isnan(row)))}, which is not available (or is NaN)"
    elif (row < 0).any():
        what = f"has the negative probability {row.min():.4g}"
    else:
        what = f"sums to {row.sum():.6g}, not 1"
    return (
        f"the policy's row {shown} of state {where} {what}; give each state a distribution "
        "over its available actions"
    )


def require_shape(name: str, array: Any, shape: tuple[int, ...]) -> None:
    """Raises a ValueError that names the argument unless `array` has `shape`."""
    if np.shape(array) != tuple(shape):
        raise ValueError(f"{name} has shape {np.shape(array)}; expected {tuple(shape)}.")
