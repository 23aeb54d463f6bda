"""Gains of the noise in a step function, and the order in which coordinates are independent.

Coordinate i of the next state is `m_i + g_i w_i`. Its interval probabilities hold for every value of
`m_i` that does not depend on `w_i`; products of them over the coordinates hold if each `m_i` depends
on noises of earlier coordinates alone, given which the next one is bounded. Bounds of the derivatives
in the noise decide both: by the mean value theorem `m_i` varies with a noise at most as much as the
derivative differs from the gain that was taken out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.array_types import Booleans, Floats
from jaxltl.core.enclosures.linear_bounds import Enclosed
from jaxltl.core.enclosures.program import Elementwise, Program, make_program
from jaxltl.core.models.protocols import PyTree

Step = Callable[[PyTree, PyTree, PyTree], PyTree]
_UNDERFLOW = 1e-200  # of products with 0 that are rounded outward
# Functions that may jump: their derivatives do not bound their variation.
_JUMPS = {"sign", "floor", "ceil", "round", "lt", "le", "gt", "ge", "eq", "ne", "atan2", "pow"}


def gain_program(step: Step, specs: Sequence[jax.ShapeDtypeStruct]) -> Program:
    """A step, and its derivatives ``[k, n]`` in the noise unless they bound no variation.

    One program for both, since the derivatives need what the step computes: of a policy, say.
    """
    program = make_program(lambda x, u, w: step(x, u, w), *specs)
    if specs[2].shape[0] == 0 or jumps(program):
        return program

    def gains(x: jax.Array, u: jax.Array, w: jax.Array) -> tuple[PyTree, jax.Array]:
        following, push = jax.linearize(lambda v: step(x, u, v), w)
        return following, jnp.stack([push(unit) for unit in jnp.eye(len(w), dtype=w.dtype)])

    try:
        return make_program(gains, *specs)
    except ValueError:  # a derivative without an enclosure
        return program


def jumps(program: Program) -> bool:
    """True if a function that may jump is applied to variables that depend on the last input."""
    noisy = {program.inputs[-1]}
    for operation in program.operations:
        if not noisy.intersection(operation.inputs):
            continue
        noisy.add(operation.output)
        if isinstance(operation, Elementwise):
            real = jnp.issubdtype(program.shapes[operation.output].dtype, jnp.floating)
            if operation.name in _JUMPS or not real:
                return True
    return False


def gain_bounds(known: Enclosed, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Bounds ``[C, k, n]`` of the derivatives over boxes; infinite where none is known."""
    if len(known.program.outputs) == 1:
        return np.full(shape, -np.inf), np.full(shape, np.inf)
    derivatives = known.intervals[known.program.outputs[1]]
    low, high = (
        np.broadcast_to(x.reshape(-1, *shape[1:]), shape)
        for x in (derivatives.low, derivatives.high)
    )
    finite = np.isfinite(low) & np.isfinite(high)
    zero = np.maximum(np.abs(low), np.abs(high)) < _UNDERFLOW
    low, high = np.where(zero, 0.0, low), np.where(zero, 0.0, high)
    return np.where(finite, low, -np.inf), np.where(finite, high, np.inf)


def conditioning_order(
    noise_of: Sequence[int], depends: Booleans, share: Floats
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """An order of the coordinates, and the noises that remain assigned to them.

    Coordinates may depend on the noises of ``depends bool[k, n]``. In a cycle of dependences the one
    with the least share loses its noise, which is then treated as chosen by an adversary.
    """
    assigned, order = list(noise_of), list[int]()
    remaining = list(range(len(assigned)))
    while remaining:
        free = [
            i for i in remaining
            if not any(depends[assigned[j], i] for j in remaining if j != i and assigned[j] >= 0)
        ]  # fmt: skip
        if free:
            order.append(free[0])
            remaining.remove(free[0])
        else:
            assigned[min((i for i in remaining if assigned[i] >= 0), key=lambda i: share[i])] = -1
    return tuple(order), tuple(assigned)
