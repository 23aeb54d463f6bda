"""Solvers of the host inside ``jit`` and ``vmap``, by a callback.

Of a product with 60 states, the first call of a compiled solver takes about 8 s of CPU time and a later
one 1.4 ms; a callback takes 0.06 s and 8 ms, which is less for up to about a thousand solves. It also
answers questions that have no compiled solver. The callback runs
NumPy and SciPy only: a JAX operation inside it would wait for the program that waits for it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero

from jaxltl.core.array_types import Floats, PyTree
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP, make_interval
from jaxltl.core.models.ops.array_namespace import host_callback, is_traced
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model, base_model
from jaxltl.core.models.sparse import SparseMDP, check_entries
from jaxltl.core.types import Solution, Status, row_tolerance
from jaxltl.core.values.engine.host_solution import default_tolerance, status_between

Derivative = Callable[[Solution], jax.Array]


def solution_layout(
    model: Model | IntervalMDP, *, policy: Array | None = None, nature: Array | None = None
) -> Solution:
    """Shapes and dtypes of a solution of a model, as a :class:`Solution` of ShapeDtypeStructs.

    `policy` and `nature` are arrays with the shape and the dtype of those of the solution; default:
    a deterministic policy ``int32[S]``, and no nature.
    """
    world = base_model(model)
    host = np.float64 if isinstance(world, SparseMDP | IntervalMDP) else world.dtype
    dtype = jax.dtypes.canonicalize_dtype(host)
    value = jax.ShapeDtypeStruct(model.state_shape, dtype)
    number, scalar = jax.ShapeDtypeStruct((), jnp.int32), jax.ShapeDtypeStruct((), dtype)
    chosen = jax.ShapeDtypeStruct(model.state_shape, jnp.int32)
    return Solution(
        value=cast(jax.Array, value),
        policy=cast(jax.Array, chosen if policy is None else _like(policy)),
        lower=cast(jax.Array, value),
        upper=cast(jax.Array, value),
        residual=cast(jax.Array, scalar),
        num_steps=cast(jax.Array, number),
        status=cast(jax.Array, number),
        nature=None if nature is None else cast(jax.Array, _like(nature)),
    )


def on_host_inside_jit(
    solve: Callable[..., Solution],
    layout: Solution,
    *arguments: PyTree,
    relative: bool = False,
    tolerance: Array | float | None = None,
    derivative: Derivative | None = None,
) -> Solution:
    """``solve(*arguments)`` of the host, inside ``jit``; sequential under ``vmap``.

    Values of double precision are rounded to the dtype of the layout, and bounds outwards; where
    they are then wider than the tolerance, the status is PRECISION instead of CONVERGED.

    Args:
      solve: a solver of concrete arguments. In the callback it is given NumPy arrays, also for the
        arrays of models. A ValueError at trace time is to be raised by the caller; one in the
        callback gives the status INVALID.
      layout: shapes and dtypes of the solution, see :func:`solution_layout`.
      arguments: trees of arrays; those that are concrete are not passed at run time.
      relative, tolerance: the width that counts as converged, ``float[]``; default: 1e-6 in double
        precision, 1e-3 in single precision.
      derivative: the value, with its derivatives, of the solution, which has none; for instance by
        evaluation of its policy. Default: differentiation raises TypeError.

    Returns:
      :class:`Solution`.
    """
    if tolerance is None:
        tolerance = default_tolerance(layout.value)
    primal = arguments
    # Concrete models were validated when they were made.
    traced = [is_traced(x) for x in arguments]
    arguments, tolerance = lax.stop_gradient((arguments, tolerance))

    def on_host(arguments: tuple[PyTree, ...], tolerance: Array) -> Solution:
        try:
            models = zip(arguments, traced, strict=True)
            solution = solve(*(_validated(x) if new else x for x, new in models))
        except ValueError:  # found in the values of arrays, which cannot be raised inside a program
            return invalid_solution(layout)
        return fitted(solution, layout, float(tolerance), relative=relative)

    solution: Solution = host_callback(on_host, layout, arguments, tolerance)
    if derivative is None:
        return replace(solution, value=_undifferentiable(solution.value, primal))
    return replace(solution, value=derivative(solution))


def _undifferentiable(value: jax.Array, arguments: PyTree) -> jax.Array:
    """A value of which derivatives in the arguments raise TypeError."""

    @jax.custom_jvp
    def identity(value: jax.Array, traced: list[jax.Array]) -> jax.Array:
        return value

    def rule(
        primals: tuple[jax.Array, PyTree], tangents: tuple[PyTree, PyTree]
    ) -> tuple[jax.Array, PyTree]:
        changes = jax.tree.leaves(tangents, is_leaf=lambda x: isinstance(x, SymbolicZero))
        if any(not isinstance(x, SymbolicZero) for x in changes):
            raise TypeError(
                "values that the host computes inside jit have no derivatives for this kind of model "
                "and question; apply jax.lax.stop_gradient to the arguments, or evaluate the policy "
                "of the solution on an MDP or DenseMDP, which is differentiable."
            )
        return identity(*primals), tangents[0]

    identity.defjvp(rule, symbolic_zeros=True)
    leaves = [x for x in jax.tree.leaves(arguments) if isinstance(x, jax.core.Tracer)]
    result: jax.Array = identity(value, leaves)
    return result


def _like(array: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(np.shape(array), jax.dtypes.canonicalize_dtype(array.dtype))


def _validated(argument: PyTree) -> PyTree:
    """An argument; a sparse or interval model with normalised rows, ValueError if it is invalid."""
    # Models of other kinds are validated by `to_sparse`.
    if isinstance(argument, Product | Game):
        return replace(argument, mdp=_validated(argument.mdp))
    if isinstance(argument, IntervalMDP):
        ends = argument.lower, argument.upper
        ball = {"center": argument.center, "radius": argument.radius}
        model = make_interval(argument.nominal, *ends, **ball)
        if model.lower.shape != argument.lower.shape:
            raise ValueError("an entry of a row has the upper bound 0.")
        return model
    if not isinstance(argument, SparseMDP):
        return argument
    stored = np.asarray(argument.probability)
    probability = stored.astype(np.float64)
    starts = np.asarray(argument.row_start), np.asarray(argument.entry_start)
    check_entries(*starts, np.asarray(argument.successor), probability)
    total = np.add.reduceat(probability, starts[1][:-1])
    if (probability == 0).any() or (np.abs(total - 1) > row_tolerance(stored.dtype)).any():
        raise ValueError("a probability is 0, or a row does not sum to 1.")
    return replace(argument, probability=probability / np.repeat(total, np.diff(starts[1])))


def invalid_solution(layout: Solution) -> Solution:
    """The solution without value and bounds, with the status INVALID, as NumPy arrays."""

    def full(x: jax.Array, number: float) -> jax.Array:
        return cast(jax.Array, np.full(x.shape, number, x.dtype))

    return replace(
        layout,
        value=full(layout.value, math.nan),
        policy=full(layout.policy, 0),
        lower=full(layout.lower, -math.inf),
        upper=full(layout.upper, math.inf),
        residual=full(layout.residual, math.nan),
        num_steps=full(layout.num_steps, 0),
        status=full(layout.status, int(Status.INVALID)),
        nature=None if layout.nature is None else full(layout.nature, math.nan),
    )


def fitted(solution: Solution, layout: Solution, tolerance: float, *, relative: bool) -> Solution:
    """A solution of the host in the shapes and dtypes of a layout, with bounds rounded outwards."""
    dtype = np.dtype(layout.value.dtype)
    value: Array = np.asarray(solution.value)
    low: Array = np.asarray(solution.lower)
    high: Array = np.asarray(solution.upper)
    status = int(solution.status)
    if value.dtype.itemsize > dtype.itemsize:
        low, high = rounded_outwards(low, dtype, -1), rounded_outwards(high, dtype, 1)
        with np.errstate(over="ignore"):
            value = np.clip(value.astype(dtype), low, high)
        if status == Status.CONVERGED:
            low64, high64 = low.astype(np.float64), high.astype(np.float64)
            status = int(status_between(low64, high64, tolerance, relative=relative))
    solution = replace(
        solution, value=value, lower=low, upper=high, status=cast(jax.Array, status), method=""
    )
    parts: PyTree = {
        name: np.asarray(getattr(solution, name)).astype(like.dtype).reshape(like.shape)
        for name, like in vars(layout).items()
        if isinstance(like, jax.ShapeDtypeStruct)
    }
    return replace(layout, **parts)


def rounded_outwards(bound: Floats, dtype: np.dtype, end: int) -> Floats:
    """A bound of double precision in another dtype, not below it for `end` 1, not above it for -1."""
    # XLA flushes subnormal numbers to zero, so that there is none between 0 and the least normal one.
    tiny = float(np.finfo(dtype).tiny)
    with np.errstate(over="ignore", invalid="ignore"):
        nearest = bound.astype(dtype)
        wrong = end * nearest.astype(np.float64) < end * bound
        rounded = np.where(wrong, np.nextafter(nearest, dtype.type(end * np.inf)), nearest)
    small = (np.abs(bound) < tiny) & (bound != 0)
    outer = np.where(bound * end > 0, end * tiny, 0.0)
    result: Floats = np.where(small, outer, rounded).astype(dtype)
    return result
