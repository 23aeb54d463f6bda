"""The linear-quadratic regulator with bounded controls (Wen 2019, section 4.5.1).

``x_(t+1) = A x_t + B u_t``; the cost ``J = sum_t x_(t+1)' Q x_(t+1) + u_t' R u_t`` is minimised
subject to ``low <= u_t <= high``. The policy is a network that reads the state.

Two readings: the dissertation maximises a positive number G, here ``G = exp(-J / scale)``, of which
the logarithm is returned; and the constraint, there ``1 - max_t max(low - u_t, u_t - high, 0) >=
1``, is here that the largest violation is at most 0.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import ArrayLike, DTypeLike

from jaxltl.core import struct, validation
from jaxltl.core.environments.environment import Environment, Timestep, make_box, make_environment
from jaxltl.core.models.protocols import Array, PyTree
from jaxltl.core.pretty_print import brief
from jaxltl.core.types import require_shape
from jaxltl.envs.networks import Network, apply_lanes, make_network, weighted


@struct.dataclass
class LQR:
    """A regulator problem, see :func:`lqr`.

    Attributes:
      dynamics, control: A ``float[n, n]`` and B ``float[n, m]``.
      state_cost, control_cost: Q ``float[n, n]`` and R ``float[m, m]``.
      low, high: ``float[m]``, bounds of the controls.
      initial: ``float[n]``.
      scale: the unit of J in the objective.
      horizon: N, the number of controls; static.
    """

    dynamics: Array
    control: Array
    state_cost: Array
    control_cost: Array
    low: Array
    high: Array
    initial: Array
    scale: Array
    horizon: int = struct.field(pytree_node=False)


@brief
class LqrRun(NamedTuple):
    """A trajectory of a policy; axes of lanes of parameters are last.

    `state` is ``float[N + 1, n]``, `control` ``float[N, m]``, `total` J, and `violation` the maximum
    of ``low - u_t``, ``u_t - high`` and 0.
    """

    state: jax.Array
    control: jax.Array
    total: jax.Array
    violation: jax.Array


@brief
class Optimum(NamedTuple):
    """Optimal controls in float64 NumPy arrays.

    `total` is J, `control` ``float[N, m]``, `state` ``float[N + 1, n]``, and `residual` the largest
    violation of the Karush-Kuhn-Tucker conditions.
    """

    total: float
    control: np.ndarray
    state: np.ndarray
    residual: float


def lqr(
    dynamics: ArrayLike = ((1, 1), (0, 1)),
    control: ArrayLike = ((1,), (1,)),
    *,
    state_cost: ArrayLike = ((1, 0), (0, 0)),
    control_cost: ArrayLike = ((0.3,),),
    initial: ArrayLike = (1, -1),
    horizon: int = 20,
    low: ArrayLike = -0.2,
    high: ArrayLike = 0.2,
    scale: float | None = None,
) -> LQR:
    """A regulator problem, equation (4.17); the defaults are the dissertation's.

    Args:
      dynamics, control, initial, horizon: A, B, the initial state and N.
      state_cost, control_cost: Q, positive semidefinite, and R, positive definite.
      low, high: ``[m]``, or one bound for all controls.
      scale: the unit of J in the objective; default: J of zero controls if positive, else 1.

    Raises:
      ValueError: incompatible shapes, costs that are not definite, or low above high.

    >>> world = lqr()
    >>> world.horizon, round(float(world.scale))
    (20, 2470)
    """
    a, b, q, r = (np.asarray(x, float) for x in (dynamics, control, state_cost, control_cost))
    x = np.asarray(initial, float)
    n, m = len(a), b.shape[-1]
    for name, matrix, shape in (
        ("dynamics", a, (n, n)),
        ("control", b, (n, m)),
        ("state_cost", q, (n, n)),
        ("control_cost", r, (m, m)),
        ("initial", x, (n,)),
    ):
        require_shape(name, matrix, shape)
    _check_definite(q, r)
    bounds = np.broadcast_to(np.asarray(low, float), m), np.broadcast_to(np.asarray(high, float), m)
    if not (bounds[0] <= bounds[1]).all():
        raise ValueError(f"low={low!r}, high={high!r}; low must be at most high.")
    horizon = validation.integer("horizon", horizon, least=1)
    if scale is None:
        _, offset = _least_squares(a, b, q, r, x, horizon)
        scale = float(offset @ offset) or 1.0
    validation.require_in_range("scale", scale, validation.Range(0, open_below=True))
    # NumPy's, so that the optimum is that of these numbers and not of their nearest in float32.
    return LQR(a, b, q, r, *bounds, x, np.asarray(scale), horizon=horizon)


def _check_definite(q: np.ndarray, r: np.ndarray) -> None:
    for name, matrix, strict in (("state_cost", q, False), ("control_cost", r, True)):
        least = np.linalg.eigvalsh(matrix).min()
        if not np.array_equal(matrix, matrix.T) or least < 0 or (strict and least == 0):
            kind = "definite" if strict else "semidefinite"
            raise ValueError(
                f"{name} must be symmetric and positive {kind}; its least eigenvalue is {least:g}."
            )


def evaluator(world: LQR, network: Network | str = "2-2-1") -> jax.tree_util.Partial:
    """The function ``evaluate(parameters, key) -> (objective, cost)`` of policies of a `network`.

    The objective is ``log G = -J / scale``, the cost the largest violation of the bounds; ``-inf`` and
    ``inf`` after an overflow. The key is not used. All ``vmap`` over parameters ``float[D]`` become one
    last axis of every array.

    Raises:
      ValueError: a network with inputs or outputs other than those of `world`.

    >>> evaluate = evaluator(lqr(), "2-2-1")
    >>> [float(x) for x in evaluate(jnp.zeros(9), None)]
    [-1.0, 0.0]
    """
    return jax.tree_util.Partial(_evaluate, _fitting(world, network), world)


def _fitting(world: LQR, network: Network | str) -> Network:
    network = make_network(network) if isinstance(network, str) else network
    n, m = world.control.shape[-2:]
    if (network.sizes[0], network.sizes[-1]) != (n, m):
        raise ValueError(
            f"the network has the sizes {network.sizes}; the world has {n} states, its inputs, "
            f"and {m} controls, its outputs."
        )
    return network


@jax.jit  # so that calls outside of jit share one compilation
def _evaluate(
    network: Network, world: LQR, parameters: jax.Array, key: object
) -> tuple[jax.Array, jax.Array]:
    total, violation = _scores(network, world, parameters)
    return -total / jnp.asarray(world.scale, total.dtype), violation


def simulate(world: LQR, network: Network | str, parameters: jax.Array) -> LqrRun:
    """The trajectories of one or many policies.

    Args:
      world, network: the problem and the network, or the sizes of one with biases.
      parameters: ``float[D]``, or ``float[D, lanes]`` with any number of axes of lanes.

    >>> run = simulate(lqr(), "2-2-1", jnp.zeros(9))
    >>> run.state[:3].tolist(), float(run.total)
    ([[1.0, -1.0], [0.0, -1.0], [-1.0, -1.0]], 2470.0)
    """
    return _simulate(_fitting(world, network), world, jnp.asarray(parameters))


@jax.jit
def _simulate(network: Network, world: LQR, parameters: jax.Array) -> LqrRun:
    world = _as(world, parameters)
    start = _start(world, parameters)

    def step(carry: PyTree, _: None) -> PyTree:
        carry, control = _step(network, world, parameters, carry)
        return carry, (carry[0], control)

    (_, total, violation), (states, controls) = lax.scan(step, start, None, length=world.horizon)
    return LqrRun(jnp.concatenate([start[0][None], states]), controls, *_finished(total, violation))


def _plain(network: Network, world: LQR, parameters: jax.Array) -> tuple[jax.Array, jax.Array]:
    """J and the violation. Unrolled loops were up to a hundred times slower (steps are recomputed)."""
    world = _as(world, parameters)
    _, total, violation = lax.fori_loop(
        0,
        world.horizon,
        lambda _, carry: _step(network, world, parameters, carry)[0],
        _start(world, parameters),
    )
    return _finished(total, violation)


def _as(world: LQR, parameters: jax.Array) -> LQR:
    dtype = jnp.promote_types(parameters.dtype, jnp.float32)
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), world)


def _start(world: LQR, parameters: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    lanes = parameters.shape[1:]
    state = world.initial.reshape(-1, *(1,) * len(lanes))
    zero = jnp.zeros(lanes, state.dtype)
    return jnp.broadcast_to(state, (len(state), *lanes)), zero, zero


def _step(
    network: Network, world: LQR, parameters: jax.Array, carry: tuple[jax.Array, ...]
) -> tuple[tuple[jax.Array, ...], jax.Array]:
    state, total, violation = carry
    control = apply_lanes(network, parameters, state)
    return _after(world, state, control, total, violation), control


def _after(
    world: LQR, state: jax.Array, control: jax.Array, total: jax.Array, violation: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The next state, accumulated J and largest violation."""
    beside = (1,) * (control.ndim - 1)
    state = _times(world.dynamics, state) + _times(world.control, control)
    total = total + _square(world.state_cost, state) + _square(world.control_cost, control)
    low, high = world.low.reshape(-1, *beside), world.high.reshape(-1, *beside)
    over = jnp.maximum(low - control, control - high).max(axis=0)
    return state, total, jnp.maximum(violation, over)


def _times(matrix: jax.Array, x: jax.Array) -> jax.Array:
    """``matrix @ x`` for ``x [n, lanes]``."""
    return weighted(matrix.T.reshape(*matrix.T.shape, *(1,) * (x.ndim - 1)), x)


def _square(matrix: jax.Array, x: jax.Array) -> jax.Array:
    return jnp.sum(x * _times(matrix, x), axis=0)


def _finished(total: jax.Array, violation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Replaces NaN after an overflow by infinity."""
    lost = ~jnp.isfinite(total) | ~jnp.isfinite(violation)
    return jnp.where(lost, jnp.inf, total), jnp.where(lost, jnp.inf, violation)


_scores = jax.custom_batching.custom_vmap(_plain)


@_scores.def_vmap
def _lanes_last(
    size: int, batched: PyTree, network: Network, world: LQR, parameters: jax.Array
) -> PyTree:
    _, varied, many = batched
    if any(jax.tree.leaves(varied)):
        axes = (None, jax.tree.map(lambda b: 0 if b else None, varied), 0 if many else None)
        return jax.vmap(_plain, axes)(network, world, parameters), (True, True)
    # Earlier lanes are already last; all are merged into one axis.
    lanes = parameters.shape[2:]
    parameters = jnp.moveaxis(parameters, 0, -1).reshape(parameters.shape[1], -1)
    scores = _scores(network, world, parameters)
    return tuple(jnp.moveaxis(x.reshape(*lanes, size), -1, 0) for x in scores), (True, True)


# --- by steps ---------------------------------------------------------------------------------


@brief
class Plant(NamedTuple):
    """State of the regulator as an environment.

    `state` is ``float[n]``, `violation` the largest so far, and `time` the number of steps.

    >>> Plant(state=[1.0, -1.0], violation=0.0, time=0).time
    0
    """

    state: jax.Array
    violation: jax.Array
    time: jax.Array


def as_environment(world: LQR, dtype: DTypeLike | None = None) -> Environment:
    """The regulator `world` as an environment with numbers of a `dtype`, terminated after N controls.

    Rewards add up to -J, and costs, the increments of the largest violation, to the violation. States
    are observed; controls are unbounded.

    >>> plant = as_environment(lqr())
    >>> found = plant.step(plant.reset(None), jnp.array([-0.5]), None)
    >>> found.world.state.tolist(), round(float(found.reward), 4), round(float(found.cost), 4)
    ([-0.5, -1.5], -0.325, 0.3)
    """
    dtype = jnp.dtype(dtype or jnp.result_type(float))
    world = jax.tree.map(lambda x: np.asarray(x, dtype), world)
    return make_environment(
        jax.tree_util.Partial(_first_state, world),
        jax.tree_util.Partial(_controlled, world),
        _observed,
        actions=make_box(-np.inf, np.inf, world.control.shape[-1:], dtype),
        horizon=world.horizon,
    )


def _first_state(world: LQR, key: object) -> Plant:
    start = jnp.asarray(world.initial)
    return Plant(start, jnp.zeros((), start.dtype), jnp.int32(0))


def _observed(plant: Plant) -> jax.Array:
    return plant.state


def _controlled(world: LQR, plant: Plant, control: jax.Array, key: object) -> Timestep:
    world = jax.tree.map(jnp.asarray, world)
    none = jnp.zeros_like(plant.violation)
    state, total, violation = _after(world, plant.state, control, none, plant.violation)
    after = Plant(state, violation, plant.time + 1)
    return Timestep(after, -total, after.time >= world.horizon, cost=violation - plant.violation)


# --- the best controls, on the host -----------------------------------------------------------


def optimum(world: LQR) -> Optimum:
    """The optimal control sequence of a `world` over all policies, and its cost, in float64.

    In terms of the controls, J is a sum of squares ``|M u + c|^2`` under bounds: a strictly convex
    problem, solved by an active-set method (Stark and Parker 1995).

    Raises:
      ValueError: the method did not finish.

    >>> f"{optimum(lqr()).total:.10f}"
    '3.7510604123'
    """
    from scipy.optimize import lsq_linear

    names = ("dynamics", "control", "state_cost", "control_cost", "low", "high", "initial")
    a, b, q, r, low, high, start = (np.asarray(getattr(world, x), float) for x in names)
    matrix, offset = _least_squares(a, b, q, r, start, world.horizon)
    bounds = np.tile(low, world.horizon), np.tile(high, world.horizon)
    pinned = bounds[0] == bounds[1]  # constants are eliminated
    u = bounds[0].copy()
    if not pinned.all():
        free = ~pinned
        solution = lsq_linear(
            matrix[:, free],
            -offset - matrix[:, pinned] @ u[pinned],
            (bounds[0][free], bounds[1][free]),
            method="bvls",
            tol=1e-15,
            max_iter=100 * len(u),
        )
        if not solution.success:
            raise ValueError(f"the best controls were not found: {solution.message}")
        u[free] = solution.x
    # At an optimum a step down the gradient is undone by the bounds.
    residual = np.abs(u - np.clip(u - (2 * matrix.T @ (matrix @ u + offset)), *bounds)).max()
    controls = u.reshape(world.horizon, -1)
    states = [start]
    for control in controls:
        states.append(a @ states[-1] + b @ control)
    total = float(np.sum((matrix @ u + offset) ** 2))
    return Optimum(total, controls, np.array(states), float(residual))


def _least_squares(
    a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray, start: np.ndarray, horizon: int
) -> tuple[np.ndarray, np.ndarray]:
    """M and c with ``J = |M u + c|^2`` for all controls in one vector u."""
    n, m = b.shape
    root_q, root_r = _root(q), _root(r)
    effect, state = np.zeros((n, horizon * m)), start
    rows, offsets = [], []
    for t in range(horizon):
        now = slice(t * m, (t + 1) * m)
        effect, state, own = a @ effect, a @ state, np.zeros((m, horizon * m))
        effect[:, now] += b
        own[:, now] = root_r
        rows += [root_q @ effect, own]
        offsets += [root_q @ state, np.zeros(m)]
    return np.concatenate(rows), np.concatenate(offsets)


def _root(matrix: np.ndarray) -> np.ndarray:
    """A matrix X with ``X' X = matrix``."""
    values, vectors = np.linalg.eigh(matrix)
    return np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
