"""Bounds of programs over boxes: intervals, and linear bounds forward and backward (CROWN).

The box is `x = m + r e` with every `|e_j| <= 1`. Forward, each variable y gets an affine
form `A e + a`, a bound of its error, and from them and interval arithmetic an interval. Backward, from an output
to the box, the coefficients of the output's bounds pass through each operation, with the linear
bounds of elementwise functions over the forward intervals (Zhang et al. 2018); cancellation between
paths is seen there.

Rounding: a coefficient that is computed as a sum of n products errs by at most `(n + 1) eps` times
the sum of their magnitudes; it multiplies a variable of bounded magnitude (1 for e), so that the
error is added to the offset.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Array
from jaxltl.core.enclosures import elementwise
from jaxltl.core.enclosures.elementwise import Relaxation
from jaxltl.core.enclosures.interval import (
    Interval,
    eps,
    intersect,
    may_be_nan,
    module_of,
    outward,
    point,
    size_of,
    times,
    tiny,
    undefined,
    without_nan,
)
from jaxltl.core.enclosures.matrix_product import nonnegative, product
from jaxltl.core.enclosures.program import (
    Elementwise,
    MatrixProduct,
    StraightLineProgram,
    Select,
    make_program,
)
from jaxltl.core.models.ops.array_namespace import namespace
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.pretty_print import brief


@brief
@dataclass(frozen=True)
class LinearForm:
    """`lower_slope e + lower <= y <= upper_slope e + upper` for every e in [-1, 1]^J.

    A leading 1 in place of C holds for all boxes.

    Attributes:
      lower_slope, upper_slope: ``float[C, J, n]`` for C boxes, J input entries and n entries of y.
      lower, upper: ``float[C, n]``, the values at the boxes' middles.

    Example:
      >>> slope, middle = np.array([[[2.0]]]), np.array([[1.0]])
      >>> LinearForm(slope, middle, slope, middle).interval().high.round(6).tolist()
      [[3.0]]
    """

    lower_slope: Array
    lower: Array
    upper_slope: Array
    upper: Array

    def interval(self) -> Interval:
        """Bounds over the box."""
        low_terms, high_terms = size_of(self.lower_slope).sum(1), size_of(self.upper_slope).sum(1)
        factor = 2 * (self.lower_slope.shape[1] + 2) * eps(self.lower)
        low, high = self.lower - low_terms, self.upper + high_terms
        return without_nan(outward(low - low_terms * factor, high + high_terms * factor, 2))


@dataclass(frozen=True)
class EnclosedProgram:
    """A program with enclosures of its variables over C boxes."""

    program: StraightLineProgram
    intervals: Mapping[int, Interval]  # arrays [C, n]; [1, n] for known variables
    radius: Array  # float[C, J], of the box, with the entries of all inputs in order
    middle: Array
    forms: Mapping[int, AffineForm]  # of outputs, if linear bounds are computed

    @np.errstate(all="ignore")
    def outputs(self, linear: bool) -> list[Interval]:
        """Bounds of the outputs, with `linear` by backward bounds too: arrays [C, n]."""
        outputs = []
        for y in self.program.outputs:
            bounds = self.intervals[y]
            if linear and y not in self.program.known and y not in self.program.inputs:
                bounds = intersect(bounds, backward(self, y).interval())
            outputs.append(without_nan(bounds))
        return outputs


@np.errstate(all="ignore")  # infinite bounds make NaN, which is no bound
def propagate(
    program: StraightLineProgram, boxes: list[Interval], linear: bool = True
) -> EnclosedProgram:
    """Enclosures of all variables over boxes with arrays [C, n], from the first operation on."""
    intervals: dict[int, Interval] = {}
    xp = module_of(boxes[0].low) if boxes else np
    for x, value in program.known.items():
        intervals[x] = point(xp.asarray(value)[None])
    intervals |= dict(zip(program.inputs, boxes, strict=True))
    boxes = [undefined(may_be_nan(x), x) for x in boxes]
    middle = xp.concatenate([x.middle for x in boxes], -1)
    radius = xp.concatenate([x.radius for x in boxes], -1)
    forms: dict[int, AffineForm] = {}
    if linear:
        forms |= zip(program.inputs, _input_forms(boxes, radius), strict=True)
    last_use = {x: i for i, each in enumerate(program.operations) for x in each.inputs}
    for position, operation in enumerate(program.operations):
        y = operation.output
        if (
            isinstance(operation, MatrixProduct)
            and operation.is_finite
            and _is_bounded(forms.get(operation.inputs[0]))
        ):
            # Interval arithmetic is rarely narrower here, and costs as much as the form.
            forms[y] = _forward_product(operation.matrix, forms[operation.inputs[0]])
            intervals[y] = nonnegative(
                operation, intervals[operation.inputs[0]], forms[y].interval()
            )
        else:
            values = [intervals[x] for x in operation.inputs]
            match operation:
                case MatrixProduct():
                    bounds = product(operation, *values)
                case Select():
                    bounds = _select(operation, values)
                case Elementwise():
                    bounds = elementwise.bounds(operation, values)
            real = jnp.issubdtype(bounds.low.dtype, jnp.floating)
            if real and any(x in forms for x in operation.inputs):
                forms[y] = _forward(operation, values, bounds, forms)
                bounds = intersect(bounds, forms[y].interval())
            intervals[y] = bounds
        for x in operation.inputs:
            if last_use[x] == position and x not in program.outputs:
                forms.pop(x, None)
    return EnclosedProgram(program, intervals, radius, middle, forms)


def _is_bounded(form: AffineForm | None) -> bool:
    """True for a form of NumPy arrays without infinite bounds."""
    return form is not None and module_of(form.error) is np and bool(np.isfinite(form.error).all())


def _input_forms(boxes: list[Interval], radius: Array) -> list[AffineForm]:
    """`x = m + r e`, entry by entry."""
    xp, forms, start = module_of(radius), [], 0
    for box in boxes:
        n = box.low.shape[-1]
        unit = np.eye(start + n, dtype=radius.dtype)[:, start:]
        slope = xp.asarray(unit)[None] * radius[:, None, start : start + n]
        error = box.middle * 0
        finite = xp.isfinite(radius[:, start : start + n]) & xp.isfinite(error)
        if xp is jnp or not finite.all():
            error = xp.where(finite, error, xp.inf)
            slope = xp.where(finite[:, None], slope, 0)
        forms.append(AffineForm(slope, box.middle, error))
        start += n
    return forms


def _select(operation: Select, inputs: list[Interval]) -> Interval:
    low = _joined([x.low for x in inputs])[..., operation.index]
    if all(x.low is x.high for x in inputs):
        return point(low)
    return Interval(low, _joined([x.high for x in inputs])[..., operation.index])


def _joined(arrays: list[Array]) -> Array:
    """Concatenation along the last axis, with boxes repeated."""
    if len(arrays) == 1:
        return arrays[0]
    xp = module_of(arrays[0])
    lead = np.broadcast_shapes(*(a.shape[:-1] for a in arrays))
    result: Array = xp.concatenate([xp.broadcast_to(a, (*lead, a.shape[-1])) for a in arrays], -1)
    return result


# --- forward --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class AffineForm:
    """`|y - slope e - middle| <= error` for every e in [-1, 1]^J: one slope for both bounds.

    The slopes are those of the first J' entries of the box; later entries have slope 0. A leading 1
    in place of C holds for all boxes.
    """

    slope: Array  # float[C, J', n]
    middle: Array  # float[C, n]
    error: Array  # float[C, n], infinite where no bound is known

    def interval(self) -> Interval:
        """Bounds over the box."""
        terms = self.slope_size() + self.error
        terms = terms * (1 + 2 * (self.slope.shape[1] + 2) * eps(self.middle))
        return without_nan(outward(self.middle - terms, self.middle + terms, 2))

    def slope_size(self) -> Array:
        """Sum of the slopes' magnitudes."""
        return size_of(self.slope).sum(1)


def _padded(slope: Array, count: int) -> Array:
    """Slopes with zeros up to `count` entries."""
    xp, missing = module_of(slope), count - slope.shape[1]
    if not missing:
        return slope
    zeros = xp.zeros((slope.shape[0], missing, slope.shape[2]), slope.dtype)
    result: Array = xp.concatenate([slope, zeros], 1)
    return result


def _forward(
    operation: Select | MatrixProduct | Elementwise,
    values: list[Interval],
    bounds: Interval,
    forms: Mapping[int, AffineForm],
) -> AffineForm:
    """The affine form of an operation's output from those of its inputs."""
    inputs = [
        forms.get(x) or _constant(value, bounds.low.dtype)
        for x, value in zip(operation.inputs, values, strict=True)
    ]
    if isinstance(operation, MatrixProduct):
        return _forward_product(operation.matrix, inputs[0])
    if isinstance(operation, Select):
        count = max(x.slope.shape[1] for x in inputs)
        slopes = [_padded(x.slope, count) for x in inputs]
        parts = (slopes, [x.middle for x in inputs], [x.error for x in inputs])
        return AffineForm(*(_joined(part)[..., operation.index] for part in parts))
    if operation.name in ("add", "sub"):
        return _forward_sum(inputs[0], inputs[1], 1 if operation.name == "add" else -1)
    return _forward_elementwise(elementwise.relax(operation, values, bounds, parallel=True), inputs)


def _constant(x: Interval, dtype: np.dtype) -> AffineForm:
    """A form without slopes; of a Boolean variable, which has slope 0 everywhere, zeros."""
    xp = module_of(x.low)
    slope = xp.zeros((x.low.shape[0], 0, x.low.shape[-1]), dtype)
    if not jnp.issubdtype(x.low.dtype, jnp.floating):
        zeros = xp.zeros(x.low.shape, dtype)
        return AffineForm(slope, zeros, zeros)
    if x.low.dtype != dtype:  # parameters in single precision over boxes in double precision
        x = outward(x.low.astype(dtype), x.high.astype(dtype))
    finite = xp.isfinite(x.low)
    if x.low is x.high:
        return AffineForm(slope, xp.where(finite, x.low, 0), xp.where(finite, x.low * 0, xp.inf))
    finite = xp.isfinite(x.low) & xp.isfinite(x.high)
    return AffineForm(slope, xp.where(finite, x.middle, 0), xp.where(finite, x.radius, xp.inf))


def _forward_product(matrix: Array, x: AffineForm) -> AffineForm:
    matrix = module_of(x.middle).asarray(matrix)
    rounding = 2 * (matrix.shape[1] + 2) * eps(x.middle)
    error = x.error * (1 + rounding) + (x.slope_size() + size_of(x.middle)) * rounding
    error = error @ size_of(matrix).T + tiny(x.middle) * matrix.shape[1]
    return AffineForm(x.slope @ matrix.T, x.middle @ matrix.T, error)


def _forward_sum(x: AffineForm, y: AffineForm, sign: int) -> AffineForm:
    """`x + sign y`."""
    xp = module_of(x.middle)
    add = xp.add if sign > 0 else xp.subtract
    count = max(x.slope.shape[1], y.slope.shape[1])
    slope = x.slope
    if y.slope.shape[1]:
        slope = add(_padded(x.slope, count), _padded(y.slope, count))
    error = x.error + y.error
    middle = add(x.middle, y.middle)
    size = size_of(slope).sum(1) + size_of(middle)
    rounding = 4 * eps(middle)
    return AffineForm(slope, middle, error * (1 + rounding) + size * rounding + tiny(middle))


def _forward_elementwise(bounds: Relaxation, inputs: list[AffineForm]) -> AffineForm:
    xp = module_of(bounds.lower)
    finite = xp.isfinite(bounds.lower) & xp.isfinite(bounds.upper)
    low, high = (xp.where(finite, side, 0) for side in (bounds.lower, bounds.upper))
    middle, error = (low + high) / 2, xp.where(finite, (high - low) / 2, xp.inf)
    size = size_of(low) + size_of(high)
    slopes: list[Array] = []
    count = max(x.slope.shape[1] for x in inputs)
    for x, a in zip(inputs, bounds.lower_slope, strict=True):
        magnitude = size_of(a)
        middle = middle + a * x.middle
        error = error + times(magnitude, x.error)
        size = size + magnitude * (x.slope_size() + size_of(x.middle))
        if x.slope.shape[1]:
            slopes.append(_padded(a[:, None] * x.slope, count))
    slope = reduce(xp.add, slopes)
    rounding = 4 * (len(inputs) + 2) * eps(middle)
    error = error * (1 + rounding) + size * rounding + tiny(middle)
    return AffineForm(slope, middle, error)


# --- backward -------------------------------------------------------------------------------------


class _Coefficients:
    """Coefficients of one variable's bounds by the variables still to be resolved."""

    def __init__(self, known: EnclosedProgram, target: int) -> None:
        self.known = known
        self.xp = xp = module_of(known.radius)
        size = known.intervals[target].low.shape[-1]
        unit = xp.eye(size, dtype=known.radius.dtype)[None]
        self.slopes: dict[int, tuple[Array, Array]] = {target: (unit, unit)}  # float[C, M, n]
        self.lower = self.upper = self.error = xp.zeros((1, size), known.radius.dtype)  # [C, M]
        self.eps = eps(known.radius)

    def add(self, x: int, lower: Array, upper: Array) -> None:
        """Adds slopes of a variable, which may have slopes already."""
        if x in self.known.program.known:
            self.constant(self.known.intervals[x], lower, upper)
            return
        if x in self.slopes:
            before = self.slopes[x]
            lower, upper = lower + before[0], upper + before[1]
            self.rounded(lower, upper, self.known.intervals[x].magnitude, 1)
        self.slopes[x] = (lower, upper)

    def rounded(self, lower: Array, upper: Array, size: Array, terms: int) -> None:
        """Counts the errors of slopes that multiply variables of magnitudes at most `size`."""
        total = _contract(size_of(lower) + size_of(upper), size)
        self.error = self.error + total * (2 * (terms + 2) * self.eps)

    def constant(self, value: Interval, lower: Array, upper: Array) -> None:
        """Adds slopes times bounds to the offsets."""
        xp = self.xp
        low, high = value.low[:, None], value.high[:, None]
        if value.low is value.high:
            self.lower = self.lower + times(lower, low).sum(-1)
            self.upper = self.upper + times(upper, low).sum(-1)
        else:
            self.lower = self.lower + times(lower, xp.where(lower > 0, low, high)).sum(-1)
            self.upper = self.upper + times(upper, xp.where(upper > 0, high, low)).sum(-1)
        self.rounded(lower, upper, value.magnitude, value.low.shape[-1])
        self.error = self.error + (size_of(self.lower) + size_of(self.upper)) * (4 * self.eps)


@np.errstate(all="ignore")
def backward(known: EnclosedProgram, target: int) -> LinearForm:
    """Linear bounds of a variable over the boxes, by backward propagation."""
    state, intervals = _Coefficients(known, target), known.intervals
    xp = state.xp
    for operation in reversed(known.program.operations):
        if operation.output not in state.slopes:
            continue
        lower, upper = state.slopes.pop(operation.output)
        match operation:
            case Select():
                _back_select(state, operation, lower, upper)
            case MatrixProduct():
                matrix, (x,) = xp.asarray(operation.matrix), operation.inputs
                size = intervals[x].magnitude @ size_of(matrix).T
                state.rounded(lower, upper, size, matrix.shape[0])
                state.add(x, lower @ matrix, upper @ matrix)
            case Elementwise():
                _back_elementwise(state, operation, lower, upper)
    return _resolved(state, target)


def _back_select(state: _Coefficients, operation: Select, lower: Array, upper: Array) -> None:
    sizes = [state.known.intervals[x].low.shape[-1] for x in operation.inputs]
    total, index = sum(sizes), operation.index
    slopes = [_scatter(a, index, total) for a in (lower, upper)]
    start = 0
    for x, n in zip(operation.inputs, sizes, strict=True):
        part = slice(start, start + n)
        start += n
        if not jnp.issubdtype(state.known.intervals[x].low.dtype, jnp.floating):
            continue
        if len(index) > total:  # entries that are repeated are summed
            magnitude = state.known.intervals[x].magnitude
            state.rounded(slopes[0][..., part], slopes[1][..., part], magnitude, len(index))
        state.add(x, slopes[0][..., part], slopes[1][..., part])


def _scatter(slope: Array, index: np.ndarray, total: int) -> Array:
    """Sums of the slopes of equal entries."""
    if len(index) == total and (index == np.arange(total)).all():
        return slope
    xp = module_of(slope)
    zeros: Array = xp.zeros((*slope.shape[:-1], total), slope.dtype)
    if isinstance(zeros, jnp.ndarray):
        return zeros.at[..., index].add(slope)
    order = np.argsort(index, kind="stable")
    entries, starts = np.unique(index[order], return_index=True)
    zeros[..., entries] = np.add.reduceat(slope[..., order], starts, axis=-1)
    return zeros


def _back_elementwise(
    state: _Coefficients, operation: Elementwise, lower: Array, upper: Array
) -> None:
    xp, intervals = state.xp, state.known.intervals
    values, output = [intervals[x] for x in operation.inputs], intervals[operation.output]
    bounds = elementwise.relax(operation, values, output)
    state.constant(Interval(bounds.lower, bounds.upper), lower, upper)
    up, down = xp.maximum(lower, 0), xp.minimum(lower, 0)
    above, below = xp.maximum(upper, 0), xp.minimum(upper, 0)
    for x, value, a, b in zip(
        operation.inputs, values, bounds.lower_slope, bounds.upper_slope, strict=True
    ):
        if not jnp.issubdtype(value.low.dtype, jnp.floating):
            continue
        a, b = (xp.where(xp.isfinite(s), s, 0)[:, None] for s in (a, b))  # offsets are infinite
        new = (up * a + down * b, above * b + below * a)
        state.rounded(*new, value.magnitude, 2)
        state.add(x, *new)


def _resolved(state: _Coefficients, target: int) -> LinearForm:
    """The slopes of the inputs, as a form in e."""
    known, xp = state.known, state.xp
    size = known.intervals[target].low.shape[-1]
    boxes = [known.intervals[x] for x in known.program.inputs]
    parts = []
    for x, box in zip(known.program.inputs, boxes, strict=True):
        zeros = xp.zeros((1, size, box.low.shape[-1]), known.radius.dtype)
        parts.append(state.slopes.get(x, (zeros, zeros)))
    lower, upper = (_joined([p[side] for p in parts]) for side in (0, 1))
    state.constant(point(known.middle), lower, upper)
    slopes = [xp.swapaxes(times(a, known.radius[:, None]), 1, 2) for a in (lower, upper)]
    state.rounded(lower, upper, known.radius, 1)
    error = state.error * (1 + 1024 * state.eps)
    offsets = outward(state.lower - error, state.upper + error, 4)
    offsets = without_nan(undefined(may_be_nan(known.intervals[target]), offsets))
    return LinearForm(slopes[0], offsets.low, slopes[1], offsets.high)


def _contract(slope: Array, size: Array) -> Array:
    """Sums over the entries of slopes times magnitudes: [C, M, n] and [C, n] to [C, M]."""
    xp = module_of(slope)
    return times(slope, xp.broadcast_to(size[:, None], (size.shape[0], 1, size.shape[1]))).sum(-1)


METHODS = ("linear", "interval")


def enclose(
    function: Callable[[PyTree], PyTree], method: str = "linear", batched: bool = False
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
      batched: if the arrays of ``low`` and ``high`` have one leading axis more than those of the
        argument, for a batch of boxes; the results have it too.

    Returns:
      Function of two pytrees ``low`` and ``high`` with the structure and the shapes of the argument.
      NumPy arrays are answered by NumPy, without compilation; JAX arrays inside ``jit``, ``vmap`` and
      ``grad`` by JAX, differentiable in both. Infinite where no bound is known, as for a quotient by
      a number that may be 0, and on both sides where a value may be NaN, as for the logarithm of a
      number that may be negative.

    Raises:
      ValueError: on the call, if a primitive has no enclosure (named with its source line), a loop's
        length depends on values, ``low`` and ``high`` differ in shape, or a lower bound exceeds its
        upper one.

    Example:
      >>> low, high = enclose(lambda x: x - x * x)(np.float32(0), np.float32(0.5))
      >>> bool(low <= 0), bool(0.25 <= high < 0.4)
      (True, True)
    """
    validation.choice("method", method, METHODS)
    validation.function("function", function)

    def enclosed(low: PyTree, high: PyTree) -> tuple[PyTree, PyTree]:
        if batched and len({np.shape(x)[:1] for x in jax.tree.leaves(low)} - {()}) > 1:
            shapes = ", ".join(str(list(np.shape(x))) for x in jax.tree.leaves(low))
            raise ValueError(f"low has arrays of shapes {shapes}; give one leading axis of boxes.")
        known = over_boxes(function, low, high, method == "linear")
        program = known.program
        sides: list[list[Array]] = [[], []]
        for y, bounds in zip(program.outputs, known.outputs(method == "linear"), strict=True):
            for side, x in zip(sides, (bounds.low, bounds.high), strict=True):
                rows = module_of(x).broadcast_to(x, (len(known.radius), *x.shape[1:]))
                side.append(rows.reshape((*rows.shape[:1], *program.shapes[y].shape)))
        tree = program.output_tree
        return tree.unflatten(sides[0]), tree.unflatten(sides[1])

    def shaped(low: PyTree, high: PyTree) -> tuple[PyTree, PyTree]:
        batched = enclosed(*(jax.tree.map(lambda x: x[None], tree) for tree in (low, high)))
        result: tuple[PyTree, PyTree] = jax.tree.map(lambda x: x[0], batched)
        return result

    return enclosed if batched else shaped


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
) -> EnclosedProgram:
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
        if not a.ndim:
            raise ValueError("low is a number; give arrays with a leading axis of boxes.")
        if module_of(a) is np and (a > b).any():
            place = np.argwhere(a > b)[0]
            raise ValueError(
                f"low={a[tuple(place)]:g} exceeds high={b[tuple(place)]:g} in box {place[0]} at "
                f"{place[1:].tolist()}; give low <= high."
            )
        boxes.append(Interval(a.reshape(len(a), -1), b.reshape(len(b), -1)))
        specs.append(jax.ShapeDtypeStruct(a.shape[1:], a.dtype))
    program = make_program(function, structure.unflatten(specs))
    return propagate(program, boxes, linear)
