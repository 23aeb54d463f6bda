"""Benchmark worlds of verification and synthesis in continuous spaces.

Verification of neural policies, with triangular noise: :func:`linear`, :func:`pendulum`,
:func:`collision` and :func:`triple_integrator` (Zikelic et al. 2023; Badings et al. 2025, logRASM).
Synthesis by abstraction, with Gaussian noise: :func:`robot`, :func:`vehicle`, :func:`building` and
:func:`building_safety` (IMPaCT, Wooding and Lavaei 2024).

Example:
  >>> worlds = [linear("hard"), pendulum(), collision(), triple_integrator()]
  >>> [world.dynamics.num_states for world in worlds], worlds[0].formula
  ([2, 2, 2, 3], '!unsafe U target')
  >>> [w.cell_width[0] for w in (robot(), vehicle(), building(), building_safety())]
  [0.5, 0.5, 0.5, 0.05]
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxltl.core import validation
from jaxltl.core.continuous.dynamics import Dynamics, Step, make_dynamics
from jaxltl.core.continuous.noise import gaussian, triangular
from jaxltl.core.pretty_print import brief

REACH_AVOID, SAFETY = "!unsafe U target", "G !outside"
LAYOUTS = ("easy", "hard")

_BUILDING_7D = np.array([
    [0.9678, 0, 0.0036, 0, 0.0036, 0, 0.0036],
    [0, 0.9682, 0, 0.0034, 0, 0.0034, 0.0034],
    [0.0106, 0, 0.9494, 0, 0, 0, 0],
    [0, 0.0097, 0, 0.9523, 0, 0, 0],
    [0.0106, 0, 0, 0, 0.9494, 0, 0],
    [0, 0.0097, 0, 0, 0, 0.9523, 0],
    [0.0106, 0.0097, 0, 0, 0, 0, 0.9794],
])  # fmt: skip


@brief
@dataclass(frozen=True)
class BenchmarkWorld:
    """The `dynamics` with the `formula` of their task, and of synthesis worlds the published
    `cell_width`, n floats. The number of steps of the task is `num_steps`, or None.
    """

    dynamics: Dynamics
    formula: str
    cell_width: tuple[float, ...] = ()
    num_steps: int | None = None


def _grid(*axes: tuple[float, float, float]) -> NDArray[np.float64]:
    """``float64[A, m]``: products of values from low to high in steps, rounded to 12 digits."""
    values = [low + step * np.arange(round((high - low) / step) + 1) for low, high, step in axes]
    return np.stack(np.meshgrid(*values, indexing="ij"), -1).reshape(-1, len(axes)).round(12)


def _matrices(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    w: NDArray[np.float64],
    offset: NDArray[np.float64] | float = 0.0,
) -> Step:
    """The step ``A x + B u + W w + c`` with u as it is given."""

    def step(state: jax.Array, action: jax.Array, noise: jax.Array) -> jax.Array:
        matrices = (jnp.asarray(x, state.dtype) for x in (a, b, w, offset))
        drift, control, gain, constant = matrices
        return drift @ state + control @ action + gain * noise + constant

    return step


def _clipped(step: Step) -> Step:
    """A step with actions clipped to [-1, 1]."""
    return lambda state, action, noise: step(state, jnp.clip(action, -1, 1), noise)


def _box(num: int) -> tuple[list[float], list[float]]:
    return [-1.0] * num, [1.0] * num


def linear(layout: str = "easy") -> BenchmarkWorld:
    """The linear system with one control; the `layout` ``"hard"`` has obstacles on the way."""
    hard = validation.choice("layout", layout, LAYOUTS) == "hard"
    unsafe = ([[-1.5, -1.5], [1.4, 0]], [[-1.4, 0], [1.5, 1.5]])
    initial = ([[-0.25, -0.1], [0.2, -0.1]], [[-0.2, 0.1], [0.25, 0.1]])
    if hard:
        unsafe = ([[-0.9, -0.2], [0.7, -0.2]], [[-0.7, 0.2], [0.9, 0.2]])
        initial = ([[-1.4, -0.1], [1.3, -0.1]], [[-1.3, 0.1], [1.4, 0.1]])
    step = _matrices(
        np.array([[1, 0.045], [0, 0.9]]), np.array([[0.45], [0.5]]), np.array([0.01, 0.005])
    )
    dynamics = make_dynamics(
        _clipped(step),
        domain=([-1.5, -1.5], [1.5, 1.5]),
        labels={"target": ([-0.2, -0.2], [0.2, 0.2]), "unsafe": unsafe},
        noise=[triangular()] * 2,
        actions=_box(1),
        initial=initial,
    )
    return BenchmarkWorld(dynamics, REACH_AVOID)


def _pendulum_step(state: jax.Array, action: jax.Array, noise: jax.Array) -> jax.Array:
    angle, speed = state[0], state[1]
    torque = 2 * jnp.clip(action[0], -1, 1)
    gravity = -15 * jnp.sin(angle + np.pi)
    speed = jnp.clip(0.9 * speed + 0.05 * (gravity + 80 * torque) + 0.02 * noise[0], -5, 5)
    return jnp.stack([angle + 0.05 * speed + 0.01 * noise[1], speed])


def pendulum() -> BenchmarkWorld:
    """The inverted pendulum, ``x = (angle, speed)``, clipped to its domain."""
    dynamics = make_dynamics(
        _pendulum_step,
        domain=([-0.7, -0.7], [0.7, 0.7]),
        labels={
            "target": ([-0.2, -0.2], [0.2, 0.2]),
            "unsafe": ([[-0.7, -0.7], [0.6, 0]], [[-0.6, 0], [0.7, 0.7]]),
        },
        noise=[triangular()] * 2,
        actions=_box(1),
        initial=([-0.3, -0.3], [0.3, 0.3]),
        outside="clip",
    )
    return BenchmarkWorld(dynamics, REACH_AVOID)


def _collision_step(state: jax.Array, action: jax.Array, noise: jax.Array) -> jax.Array:
    control = 2 * jnp.clip(action, -1, 1)
    up = jnp.asarray([0.0, 1.0], state.dtype)

    def distance(place: jax.Array) -> jax.Array:
        return jnp.clip(jnp.linalg.norm(place - state) / 0.3, 0, 1)

    above, below = distance(up), distance(-up)
    pushed = below * (above * control + (1 - above) * up) - (1 - below) * up
    return state + 0.2 * pushed + 0.05 * noise


def collision() -> BenchmarkWorld:
    """The planar vehicle between two obstacles that push it, clipped to its domain."""
    dynamics = make_dynamics(
        _collision_step,
        domain=([-1.0, -1.0], [1.0, 1.0]),
        labels={
            "target": ([-0.2, -0.2], [0.2, 0.2]),
            "unsafe": ([[-0.3, 0.7], [-0.3, -1]], [[0.3, 1], [0.3, -0.7]]),
        },
        noise=[triangular()] * 2,
        actions=_box(2),
        initial=([[-1, -0.6], [0.9, -0.6]], [[-0.9, 0.6], [1, 0.6]]),
        outside="clip",
    )
    return BenchmarkWorld(dynamics, REACH_AVOID)


def triple_integrator() -> BenchmarkWorld:
    """The linear system of three states with one control."""
    step = _matrices(
        np.array([[1, 0.045, 0], [0, 1, 0.045], [0, 0, 0.9]]),
        np.array([[0.35], [0.45], [0.5]]),
        np.array([0.01, 0.01, 0.005]),
    )
    dynamics = make_dynamics(
        _clipped(step),
        domain=([-1.0] * 3, [1.0] * 3),
        labels={
            "target": ([-0.2] * 3, [0.2] * 3),
            "unsafe": ([[-1.0, -1.0, -1.0], [0.9, 0.9, 0.0]], [[-0.9, -0.9, 0.0], [1.0, 1.0, 1.0]]),
        },
        noise=[triangular()] * 3,
        actions=_box(1),
        initial=([[-0.25, -0.25, -0.1], [0.2, 0.2, -0.1]], [[-0.2, -0.2, 0.1], [0.25, 0.25, 0.1]]),
    )
    return BenchmarkWorld(dynamics, REACH_AVOID)


def _robot_step(state: jax.Array, action: jax.Array, noise: jax.Array) -> jax.Array:
    speed, angle = action[0], action[1]
    return state + 2 * speed * jnp.stack([jnp.cos(angle), jnp.sin(angle)]) + noise


def robot() -> BenchmarkWorld:
    """The planar robot with 441 actions, a speed and a heading; its domain is the published cells."""
    dynamics = make_dynamics(
        _robot_step,
        domain=([-10.25] * 2, [10.25] * 2),
        labels={"target": ([5.0, 5.0], [8.0, 8.0]), "unsafe": ([-1.5, -1.5], [1.5, 1.5])},
        noise=[gaussian(np.sqrt(1 / 1.3333))] * 2,
        actions=_grid((-1, 1, 0.1), (-1, 1, 0.1)),
    )
    return BenchmarkWorld(dynamics, REACH_AVOID, (0.5, 0.5))


def _vehicle_step(state: jax.Array, action: jax.Array, noise: jax.Array) -> jax.Array:
    speed, steering = action[0], action[1]
    slip = jnp.arctan(jnp.tan(steering) / 2)
    heading = slip + state[2]
    rate = 0.1 * speed / jnp.cos(slip)
    turn = 0.1 * speed * jnp.tan(steering)
    return state + jnp.stack([rate * jnp.cos(heading), rate * jnp.sin(heading), turn]) + noise


def vehicle() -> BenchmarkWorld:
    """The kinematic vehicle with 30 actions, a speed and a steering angle."""
    dynamics = make_dynamics(
        _vehicle_step,
        domain=([-5.25, -5.25, -3.6], [5.25, 5.25, 3.6]),
        labels={
            "target": ([-5.75, -0.25, -3.45], [0.25, 5.75, 3.45]),
            "unsafe": ([-5.75, -0.75, -3.45], [0.25, -0.25, 3.45]),
        },
        noise=[gaussian(np.sqrt(1 / 1.5))] * 3,
        actions=_grid((-1, 4, 1), (-0.4, 0.4, 0.2)),
    )
    return BenchmarkWorld(dynamics, REACH_AVOID, (0.5, 0.5, 0.4))


def building() -> BenchmarkWorld:
    """The temperatures of two zones and two heaters of a building: safety over ten steps."""
    a = np.array([
        [0.6682, 0, 0.02632, 0],
        [0, 0.683, 0, 0.02096],
        [1.0005, 0, -0.000499, 0],
        [0, 0.8004, 0, 0.1996],
    ])  # fmt: skip
    b = np.array([[0.132], [0.1402], [0], [0]])
    offset = np.array([3.4378, 2.9272, 13.0207, 10.4166])
    dynamics = make_dynamics(
        _matrices(a, b, np.ones(4), offset),
        domain=([18.75, 18.75, 29.5, 29.5], [21.25, 21.25, 36.5, 36.5]),
        labels={},
        noise=[gaussian(np.sqrt(x)) for x in (0.0774, 0.0774, 0.3872, 0.3098)],
        actions=_grid((17, 20, 1)),
        outside="outside",
    )
    return BenchmarkWorld(dynamics, SAFETY, (0.5, 0.5, 1.0, 1.0), 10)


def building_safety() -> BenchmarkWorld:
    """The deviations of seven temperatures of a building, without control: safety."""
    widths = (0.05, 0.05, 0.5, 0.5, 0.5, 0.5, 0.5)
    half = 0.5 + 0.5 * np.array(widths)
    variances = 1 / np.array([51.2821, 50, 21.7865, 23.5294, 25.1889, 26.5252, 91.7431])
    dynamics = make_dynamics(
        _matrices(_BUILDING_7D, np.zeros((7, 0)), np.ones(7)),
        domain=(-half, half),
        labels={},
        noise=[gaussian(float(x)) for x in np.sqrt(variances)],
        outside="outside",
    )
    return BenchmarkWorld(dynamics, SAFETY, widths)
