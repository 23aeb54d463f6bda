"""Enclosures of JAX functions over boxes of their inputs."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np  # noqa: F401 - of the examples

from jaxltl.core.array_types import Array
from jaxltl.core.enclosures.interval import Interval
from jaxltl.core.enclosures.linear_bounds import Enclosed, backward, propagate
from jaxltl.core.enclosures.program import make_program
from jaxltl.core.models.ops.array_namespace import namespace
from jaxltl.core.models.protocols import PyTree

METHODS = ("linear", "interval")


def enclose(
    function: Callable[[PyTree], PyTree], method: str = "linear"
) -> Callable[[PyTree, PyTree], tuple[PyTree, PyTree]]:
    """Bounds of a function's values over boxes of its argument.

    The result `g` satisfies `low <= f(x) <= high` for `(low, high) = g(a, b)` and every x with
    `a <= x <= b`, where f is the real function of which `function` is the floating-point program:
    rounding errors are part of the bounds. By interval arithmetic with outward rounding (Moore
    1966) and, with ``method="linear"``, intersected with linear bounds that are propagated forward
    to all variables and backward from the outputs (CROWN, Zhang et al. 2018).

    Args:
      function: JAX function of one array or pytree of floating-point arrays.
      method: ``"linear"`` or ``"interval"``, which is looser and cheaper.

    Returns:
      Function of two pytrees ``low`` and ``high`` with the structure of the argument, either of its
      shapes or with one leading axis more for a batch of boxes. NumPy arrays are answered by NumPy,
      without compilation; JAX arrays inside ``jit``, ``vmap`` and ``grad`` by JAX, differentiable in
      both. Infinite where no bound is known, as for a quotient by a number that may be 0.

    Raises:
      ValueError: on the call, if a primitive has no enclosure (named with its source line), a loop's
        length depends on values, or ``low`` and ``high`` differ in shape.

    Example:
      >>> low, high = enclose(lambda x: x - x * x)(np.float32(0), np.float32(0.5))
      >>> bool(low <= 0), bool(0.25 <= high < 0.4)
      (True, True)
    """
    if method not in METHODS:
        raise ValueError(f"method={method!r}; it must be one of {', '.join(METHODS)}.")

    def enclosed(low: PyTree, high: PyTree) -> tuple[PyTree, PyTree]:
        known = over_boxes(function, low, high, method == "linear")
        program = known.program
        sides: list[list[Array]] = [[], []]
        for y, bounds in zip(program.outputs, known.outputs(method == "linear"), strict=True):
            for side, x in zip(sides, (bounds.low, bounds.high), strict=True):
                side.append(x.reshape((*x.shape[:1], *program.shapes[y].shape)))
        tree = program.output_tree
        return tree.unflatten(sides[0]), tree.unflatten(sides[1])

    def shaped(low: PyTree, high: PyTree) -> tuple[PyTree, PyTree]:
        batched = enclosed(*(jax.tree.map(lambda x: x[None], tree) for tree in (low, high)))
        result: tuple[PyTree, PyTree] = jax.tree.map(lambda x: x[0], batched)
        return result

    return shaped


def linear_bounds(function: Callable[[PyTree], PyTree]) -> Callable[[PyTree, PyTree], PyTree]:
    """Linear lower and upper bounds of a function's values over boxes of its argument.

    By backward propagation (CROWN, Zhang et al. 2018). With the box's middle m and radius r, in the
    order of the argument's leaves, and `x = m + r e`, each bound is linear in e.

    Args:
      function: JAX function, as for :func:`enclose`.

    Returns:
      Function of ``low`` and ``high`` with one leading axis C, which gives a :class:`LinearForm` in
      place of each output.

    Raises:
      ValueError: as for :func:`enclose`.

    Example:
      >>> low, high = np.zeros((1, 1)), np.full((1, 1), 2.0)
      >>> form = linear_bounds(lambda x: 3 * x + 1)(low, high)
      >>> form.lower_slope[0, 0].round(6).tolist(), form.lower[0].round(6).tolist()
      ([3.0], [4.0])
    """

    def bounds(low: PyTree, high: PyTree) -> PyTree:
        known = over_boxes(function, low, high)
        forms = [backward(known, y) for y in known.program.outputs]
        return known.program.output_tree.unflatten(forms)

    return bounds


def over_boxes(
    function: Callable[[PyTree], PyTree], low: PyTree, high: PyTree, linear: bool = True
) -> Enclosed:
    """The function's variables over a batch of boxes, with a leading axis C of all arrays."""
    structure: PyTree = jax.tree.structure(low)
    if structure != jax.tree.structure(high):
        raise ValueError("low and high differ in structure; both have that of the argument.")
    _, low, high = namespace(low, high)
    boxes, specs = [], []
    for a, b in zip(jax.tree.leaves(low), jax.tree.leaves(high), strict=True):
        if a.shape != b.shape:
            raise ValueError(f"low has shape {a.shape} and high {b.shape}; give equal shapes.")
        if not jnp.issubdtype(a.dtype, jnp.floating) or a.dtype != b.dtype:
            raise ValueError(f"low is {a.dtype} and high is {b.dtype}; give floats of one dtype.")
        boxes.append(Interval(a.reshape(len(a), -1), b.reshape(len(b), -1)))
        specs.append(jax.ShapeDtypeStruct(a.shape[1:], a.dtype))
    program = make_program(function, structure.unflatten(specs))
    return propagate(program, boxes, linear)
