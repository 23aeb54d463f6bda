"""JAX functions as straight-line programs of three kinds of operations on flat vectors.

Every variable is a vector; what remains of a function's primitives is selection of entries by
constant indices (reshapes, slices, broadcasts, indexing), products with matrices (dot products with
known arrays, sums), and elementwise functions. Calls are inlined and loops of fixed length are
unrolled.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core

from jaxltl.core.array_types import Array
from jaxltl.core.enclosures.interval import module_of
from jaxltl.core.enclosures.primitives import (
    letters_of,
    matrix_of,
    narrows,
    refusal,
    selection,
    shape_of,
    spec_of,
)
from jaxltl.core.models.protocols import PyTree

MAX_OPERATIONS = 20_000  # after loops are unrolled
MAX_MATRIX = 2**26  # entries of the matrix of one product
MAX_SHARES = 2**16  # entries of the matrix of a softmax
_SMALL = 64  # entries of constants that are compared
_OWN = (str(Path(jax.__file__).parent), str(Path(__file__).parent))

ELEMENTWISE = {
    "add", "sub", "mul", "div", "max", "min", "neg", "abs", "sign", "floor", "ceil", "round",
    "exp", "exp2", "expm1", "log", "log2", "log1p", "logistic", "tanh", "sqrt", "rsqrt", "cbrt",
    "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "asinh", "acosh", "atanh",
    "erf", "is_finite",
    "square", "one_minus_square", "integer_pow", "pow", "convert_element_type", "select_n",
    "lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not",
}  # fmt: skip
_RENAMED = {"add_any": "add", "copy": "reshape", "copy_p": "reshape", "stop_gradient": "reshape",
            "squeeze": "reshape", "expand_dims": "reshape", "optimization_barrier": "reshape",
            "device_put": "reshape"}  # fmt: skip
_SELECTIONS = {"reshape", "broadcast_in_dim", "transpose", "slice", "rev", "concatenate", "stack",
               "unstack", "split", "gather", "dynamic_slice", "tile", "dynamic_update_slice", "pad",
               "scatter"}  # fmt: skip
_REDUCTIONS = {"reduce_max": "max", "reduce_min": "min", "reduce_prod": "mul",
               "reduce_and": "and", "reduce_or": "or"}  # fmt: skip
_CALLS = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr",
          "custom_jvp_call": "call_jaxpr", "custom_vjp_call": "call_jaxpr",
          "custom_vjp_call_jaxpr": "fun_jaxpr", "remat2": "jaxpr", "checkpoint": "jaxpr"}  # fmt: skip


@dataclass(frozen=True)
class Select:
    """Entries `index` of the concatenated inputs."""

    inputs: tuple[int, ...]
    output: int
    index: np.ndarray  # int[n]


@dataclass(frozen=True)
class MatrixProduct:
    """`matrix x`."""

    inputs: tuple[int]
    output: int
    matrix: Array  # float[n, m]
    zeros_count: bool = False  # entries 0 multiply numbers: `0 * inf` is NaN
    is_finite: bool = True  # entries are seen to be finite
    nonnegative: bool = False  # entries are seen to be at least 0


@dataclass(frozen=True)
class Elementwise:
    """A function of vectors of equal length, entry by entry."""

    name: str
    params: Mapping[str, Any]
    inputs: tuple[int, ...]
    output: int
    place: str  # source line, for error messages


Operation = Select | MatrixProduct | Elementwise


@dataclass(frozen=True)
class StraightLineProgram:
    """A straight-line program on flat vectors."""

    operations: tuple[Operation, ...]
    inputs: tuple[int, ...]
    known: Mapping[int, Array]  # vectors that are known: literals, constants, results of integers
    outputs: tuple[int, ...]
    shapes: Mapping[int, jax.ShapeDtypeStruct]  # of the arrays before they were made flat
    output_tree: jax.tree_util.PyTreeDef


def make_program(function: Callable[..., PyTree], *args: PyTree) -> StraightLineProgram:
    """The program of a JAX function at arguments of given shapes and dtypes.

    Raises:
      ValueError: the function cannot be traced, has a loop whose length depends on values, or a
        primitive that is not supported; names it and its place in the source.
    """
    try:
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
    except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
        reason = str(error).split("\n", 1)[0]
        raise ValueError(
            f"the function cannot be traced: it reads the value of an argument in Python ({reason}) "
            "Use jnp.where and jnp functions in place of `if`, float() and NumPy."
        ) from None
    builder = _Builder()
    inputs = [builder.new(spec_of(v)) for v in closed.jaxpr.invars]
    outputs = builder.inline(closed.jaxpr, closed.consts, inputs)
    return StraightLineProgram(
        tuple(builder.operations),
        tuple(inputs),
        builder.known,
        tuple(outputs),
        builder.shapes,
        jax.tree.structure(shapes),
    )


class _Builder:
    """The operations so far."""

    def __init__(self) -> None:
        self.operations: list[Operation] = []
        self.known: dict[int, Array] = {}
        self.shapes: dict[int, jax.ShapeDtypeStruct] = {}
        self.place = "the function"  # of the innermost call that is inlined
        self.made: dict[int, Operation] = {}  # by output
        # Variables by what computes them: equal ones are one, so that x[0] * x[0] is a square.
        self.equal: dict[Hashable, int] = {}

    def add(self, key: Hashable, operation: Operation, output: jax.ShapeDtypeStruct) -> int:
        """The variable of an operation: its output, or that of an equal operation."""
        key = (key, operation.inputs, output.shape, output.dtype)
        if key in self.equal:
            return self.equal[key]
        y = self.equal[key] = self.new(output)
        self.made[y] = replace(operation, output=y)
        self.operations.append(self.made[y])
        return y

    def new(self, aval: jax.ShapeDtypeStruct) -> int:
        """A new variable of a shape and dtype."""
        index = len(self.shapes)
        self.shapes[index] = jax.ShapeDtypeStruct(aval.shape, aval.dtype)
        return index

    def constant(self, value: Array) -> int:
        """A variable with a known value."""
        key: Hashable = len(self.shapes)  # of no other variable
        if not isinstance(value, jax.core.Tracer):
            value = np.asarray(value)
            if value.size < _SMALL:
                key = value.shape, value.dtype, value.tobytes()
        if key not in self.equal:
            self.equal[key] = self.new(jax.ShapeDtypeStruct(value.shape, value.dtype))
            self.known[self.equal[key]] = value.reshape(-1)
        return self.equal[key]

    def _place(self, equation: core.JaxprEqn) -> str:
        """Source line of an equation: the innermost frame outside JAX and this package.

        The body of a call that JAX traced before may have no such frame: then that of the call.
        """
        traceback: Any = equation.source_info.traceback
        for frame in traceback.frames if traceback is not None else ():
            if not frame.file_name.startswith(_OWN):
                return f"{frame.file_name}:{frame.line_num}"
        return self.place

    def inline(
        self, jaxpr: core.Jaxpr, constants: Sequence[Array], inputs: Sequence[int]
    ) -> list[int]:
        """Appends the operations of a jaxpr; returns its outputs."""
        variables: dict[core.Var, int] = dict(zip(jaxpr.invars, inputs, strict=True))
        for variable, value in zip(jaxpr.constvars, constants, strict=True):
            variables[variable] = self.constant(value)

        def read(atom: core.Var | core.Literal) -> int:
            if isinstance(atom, core.Var):
                return variables[atom]
            return self.constant(np.asarray(atom.val, spec_of(atom).dtype))

        for equation in _needed(jaxpr):
            outputs = self._append(equation, [read(x) for x in equation.invars])
            variables |= dict(zip(equation.outvars, outputs, strict=True))
        return [read(x) for x in jaxpr.outvars]

    def _append(self, equation: core.JaxprEqn, inputs: list[int]) -> list[int]:
        name = str(equation.primitive)
        name = _RENAMED.get(name, name)
        if name in _CALLS:
            inner, outside = equation.params[_CALLS[name]], self.place
            self.place = self._place(equation)
            outputs = self.inline(
                getattr(inner, "jaxpr", inner), getattr(inner, "consts", ()), inputs
            )
            self.place = outside
            return outputs
        if name in ("scan", "while", "cond"):
            unrolled = {"scan": self._unroll, "while": self._repeat, "cond": self._branches}[name]
            return unrolled(equation, inputs)
        if len(self.operations) >= MAX_OPERATIONS:
            raise ValueError(
                f"{self._place(equation)}: the function has more than {MAX_OPERATIONS} operations after its "
                "loops are unrolled; shorten the loops."
            )
        if self._is_exact(name, equation, inputs):
            return self._evaluate(equation, inputs)
        if name in _SELECTIONS:
            return self._select(name, equation, inputs)
        output = spec_of(equation.outvars[0])
        if name in _REDUCTIONS:
            return [self._reduce(_REDUCTIONS[name], equation, inputs[0])]
        if name in ("reduce_sum", "cumsum"):
            return [self._linear(equation, inputs, 0)]
        if name == "dot_general":
            return [self._dot(equation, inputs)]
        if name == "pow" and (exponent := self._integer(inputs[1])) is not None:
            power = equation.replace(params={"y": exponent})
            return [self._elementwise("integer_pow", power, inputs[:1], output)]
        if name == "polynomial":  # by Horner's rule
            argument, *others, result = inputs
            for coefficient in reversed(others):
                product = self._elementwise("mul", equation, [result, argument], output)
                result = self._elementwise("add", equation, [product, coefficient], output)
            return [result]
        if name == "clamp":
            low = self._elementwise("max", equation, [inputs[1], inputs[0]], output)
            return [self._elementwise("min", equation, [low, inputs[2]], output)]
        same = len(inputs) == 2 and self.shapes[inputs[0]].shape == output.shape
        if name == "div" and same and (parts := self._share(*inputs)) is not None:
            return [self._elementwise("share", equation, parts, output)]
        if name in ELEMENTWISE:
            result = self._elementwise(name, equation, inputs, output)
            if name == "sub" and same and self._is_log_share(*inputs):
                zero = self.constant(np.zeros((), output.dtype))
                result = self._elementwise("min", equation, [result, zero], output)
            return [result]
        raise ValueError(f"{self._place(equation)}: {refusal(name)}")

    def _is_exact(self, name: str, equation: core.JaxprEqn, inputs: list[int]) -> bool:
        """True for an operation on known numbers that is evaluated without rounding."""
        if not all(x in self.known for x in inputs):
            return False
        exact = not any(jnp.issubdtype(spec_of(v).dtype, jnp.floating) for v in equation.outvars)
        # A comparison with what is not a number is unknown, and so is its integer.
        exact = exact and not any(self._may_be_nan(x) for x in inputs)
        widens = name == "convert_element_type" and self._converts(equation, inputs[0])
        return exact or widens or name in _SELECTIONS or name in ("max", "min", "iota", "select_n")

    def _may_be_nan(self, x: int) -> bool:
        """True unless a known array is seen to have numbers alone."""
        value = self.known[x]
        if not jnp.issubdtype(value.dtype, jnp.floating):
            return False
        return not isinstance(value, np.ndarray) or bool(np.isnan(value).any())

    def _integer(self, x: int) -> int | None:
        """The integer, of moderate size, that all entries of a known array are; else None."""
        value = self.known.get(x)
        if not isinstance(value, np.ndarray) or not value.size or (value != value[0]).any():
            return None
        exponent = float(value[0])
        return int(exponent) if exponent.is_integer() and abs(exponent) <= 64 else None

    def _converts(self, equation: core.JaxprEqn, x: int) -> bool:
        """True if the conversion of a known array loses nothing."""
        new, value = equation.params["new_dtype"], self.known[x]
        if not narrows(new, value.dtype):
            return True
        return isinstance(value, np.ndarray) and bool((value.astype(new) == value).all())

    def _evaluate(self, equation: core.JaxprEqn, inputs: list[int]) -> list[int]:
        """A primitive of known numbers."""
        if any(jnp.issubdtype(spec_of(v).dtype, jax.dtypes.extended) for v in equation.outvars):
            raise ValueError(
                f"{self._place(equation)}: `{equation.primitive}` makes random keys; draw random numbers "
                "outside of the function."
            )
        with jax.ensure_compile_time_eval():
            arrays = [jnp.asarray(self.known[x]).reshape(self.shapes[x].shape) for x in inputs]
            values = equation.primitive.bind(*arrays, **equation.params)
        values = values if equation.primitive.multiple_results else [values]
        return [self.constant(x) for x in values]

    def _select(self, name: str, equation: core.JaxprEqn, inputs: list[int]) -> list[int]:
        """Selection of entries: the primitive's own result on the entries' numbers."""
        count = {"gather": 1, "dynamic_slice": 1, "dynamic_update_slice": 2}.get(name, len(inputs))
        data, indices = inputs[:count], inputs[count:]
        if name == "scatter":
            data, indices = inputs[::2], inputs[1:2]
        if any(isinstance(self.known.get(x), jax.core.Tracer | None) for x in indices):
            raise ValueError(
                f"{self._place(equation)}: an index depends on the argument; index by constants, or use "
                "jnp.where."
            )
        numbers, start = [], 0
        for x in data:
            numbers.append(self._numbers(x) + start)
            start += numbers[-1].size
        known = [self.known[x].reshape(self.shapes[x].shape) for x in indices]
        entries = selection(name, equation, numbers, known)
        selected = list(zip(map(np.asarray, entries), map(spec_of, equation.outvars), strict=True))
        if name == "gather" and any((index < 0).any() for index, _ in selected):
            # Entries out of range have a value of their own, by default NaN.
            fill = equation.params["fill_value"]
            value = np.array([np.nan if fill is None else fill], selected[0][1].dtype)
            data = [*data, self.constant(value)]
            selected = [(np.where(index < 0, start, index), spec) for index, spec in selected]
        return [self._selected(data, index, spec) for index, spec in selected]

    def _numbers(self, x: int) -> np.ndarray:
        """The numbers of the entries of a variable, in its shape."""
        shape = self.shapes[x].shape
        return np.arange(math.prod(shape), dtype=np.int32).reshape(shape)

    def _selected(self, inputs: Sequence[int], index: Array, output: jax.ShapeDtypeStruct) -> int:
        """A new variable of some entries of the inputs."""
        index = np.asarray(index).reshape(-1)
        return self.add(index.tobytes(), Select(tuple(inputs), -1, index), output)

    def _elementwise(
        self, name: str, equation: core.JaxprEqn, inputs: list[int], output: jax.ShapeDtypeStruct
    ) -> int:
        inputs = [self._broadcast(x, output.shape) for x in inputs]
        params, place = equation.params, self._place(equation)
        key = name, params.get("y"), params.get("rounding_method")
        return self.add(key, Elementwise(name, params, tuple(inputs), -1, place), output)

    def _broadcast(self, x: int, shape: tuple[int, ...]) -> int:
        """An input of an elementwise function in the shape of its output."""
        spec = self.shapes[x]
        if spec.shape == shape:
            return x
        if x in self.known:
            known = self.known[x].reshape(spec.shape)
            return self.constant(module_of(known).broadcast_to(known, shape))
        index = np.broadcast_to(self._numbers(x), shape)
        return self._selected([x], index, jax.ShapeDtypeStruct(shape, spec.dtype))

    def _reduce(self, name: str, equation: core.JaxprEqn, x: int) -> int:
        """A reduction as a chain of elementwise operations."""
        axes, output = equation.params["axes"], spec_of(equation.outvars[0])
        here = jax.ShapeDtypeStruct(output.shape, self.shapes[x].dtype)
        parts = np.moveaxis(self._numbers(x), axes, range(len(axes)))
        first, *others = parts.reshape(-1, math.prod(output.shape))
        reduced = self._selected([x], first, here)
        for part in others:
            inputs = [reduced, self._selected([x], part, here)]
            reduced = self._elementwise(name, equation, inputs, output)
        return reduced

    def _linear(self, equation: core.JaxprEqn, inputs: list[int], index: int) -> int:
        """A primitive that is linear in one input and knows the others, by its matrix."""
        shape, output = self.shapes[inputs[index]].shape, spec_of(equation.outvars[0])
        rows, columns = math.prod(output.shape), math.prod(shape)
        if not columns:  # such as of a world without actions
            return self.constant(np.zeros(output.shape, output.dtype))
        if rows * columns > MAX_MATRIX:
            raise ValueError(
                f"{self._place(equation)}: a product with a matrix of {rows} by {columns} entries, "
                f"{8 * rows * columns:.1e} bytes; split the array."
            )
        matrix = matrix_of(equation, [self.known.get(x) for x in inputs], index)
        zeros_count, is_finite = False, True
        if len(inputs) > 1:
            other = self.known[inputs[1 - index]]
            numpy = isinstance(other, np.ndarray)
            zeros_count = not numpy or bool((other == 0).any())
            is_finite = numpy and bool(np.isfinite(other).all())
        nonnegative = isinstance(matrix, np.ndarray) and bool((matrix >= 0).all())
        product = MatrixProduct((inputs[index],), -1, matrix, zeros_count, is_finite, nonnegative)
        return self.add(len(self.shapes), product, output)

    def _dot(self, equation: core.JaxprEqn, inputs: list[int]) -> int:
        """A dot product: with a known array a matrix; else products of entries, and their sums."""
        for index in (0, 1):
            if inputs[1 - index] in self.known:
                return self._linear(equation, inputs, index)
        left, right, out, summed = letters_of(equation)
        sizes = dict(zip(left + right, shape_of(equation, 0) + shape_of(equation, 1), strict=True))
        output, order = spec_of(equation.outvars[0]), out + summed
        full = jax.ShapeDtypeStruct(tuple(sizes[c] for c in order), output.dtype)
        factors = []
        for x, letters in zip(inputs, (left, right), strict=True):
            # Axes in the order of the full product, of length 1 where the factor has none.
            present = "".join(c for c in order if c in letters)
            index = np.einsum(f"{letters}->{present}", self._numbers(x))
            index = index.reshape([sizes[c] if c in letters else 1 for c in order])
            factors.append(self._selected([x], np.broadcast_to(index, full.shape), full))
        products = self._elementwise("mul", equation, factors, full)
        rows = math.prod(output.shape)
        matrix = np.repeat(np.eye(rows, dtype=full.dtype), math.prod(full.shape) // rows, axis=1)
        product = MatrixProduct((products,), -1, matrix, nonnegative=True)
        return self.add(len(self.shapes), product, output)

    def _source(self, x: int) -> tuple[int, np.ndarray]:
        """The variable of which a variable has entries, and their numbers."""
        index = self._numbers(x).reshape(-1)
        while isinstance(made := self.made.get(x), Select) and len(made.inputs) == 1:
            (x,), index = made.inputs, made.index[index]
        return x, index

    def _sum_of_exponentials(self, x: int, total: int, entries: np.ndarray) -> np.ndarray | None:
        """Weights ``float[n, n]`` of sums of the exponentials x, one for each entry of x; or None."""
        total, rows = self._source(total)
        rows = rows[entries]
        product, exponential = self.made.get(total), self.made.get(x)
        if not isinstance(product, MatrixProduct) or not isinstance(exponential, Elementwise):
            return None
        source, columns = self._source(product.inputs[0])
        if exponential.name != "exp" or source != x or not product.nonnegative:
            return None
        if len(rows) * len(rows) > MAX_SHARES or len(columns) != len(rows):
            return None
        weights = np.zeros((len(rows), len(rows)), product.matrix.dtype)
        weights[:, columns] = product.matrix[rows]
        return weights if (np.diag(weights) == 1).all() else None

    def _share(self, x: int, total: int) -> list[int] | None:
        """Exponential, sum of all others, and argument of a quotient `e_i / sum_j e_j`; or None."""
        total = self._broadcast(total, self.shapes[x].shape)
        weights = self._sum_of_exponentials(x, total, self._numbers(total).reshape(-1))
        if weights is None:
            return None
        np.fill_diagonal(weights, 0)
        spec = self.shapes[x]
        others = MatrixProduct((x,), -1, weights, nonnegative=True)
        return [x, self.add(weights.tobytes(), others, spec), *self.made[x].inputs]

    def _is_log_share(self, x: int, total: int) -> bool:
        """True for `x_i - log sum_j exp(x_j)`, which is not positive."""
        source, rows = self._source(self._broadcast(total, self.shapes[x].shape))
        logarithm = self.made.get(source)
        if not isinstance(logarithm, Elementwise) or logarithm.name != "log":
            return False
        key = ("exp", None, None), (x,), self.shapes[x].shape, self.shapes[x].dtype
        exponential, product = self.equal.get(key), logarithm.inputs[0]
        return (
            exponential is not None
            and self._sum_of_exponentials(exponential, product, rows) is not None
        )

    def _unroll(self, equation: core.JaxprEqn, inputs: list[int]) -> list[int]:
        """The operations of each step of a scan, with slices of its arrays."""
        p = equation.params
        # Carries have equal shapes outside and inside, and arrays have an axis more outside: counts
        # that do not depend on the names of parameters, which differ between versions of JAX.
        carries = _equal_ranks(equation.outvars, p["jaxpr"].jaxpr.outvars)
        constants = _equal_ranks(equation.invars, p["jaxpr"].jaxpr.invars) - carries
        fixed, carry = inputs[:constants], list(inputs[constants : constants + carries])
        arrays, body = inputs[constants + carries :], p["jaxpr"]
        stacked: list[list[int]] = []
        steps = range(p["length"])
        for t in reversed(steps) if p["reverse"] else steps:
            here = [self._apply(lambda x, t=t: x[t], [array]) for array in arrays]
            out = self.inline(body.jaxpr, body.consts, [*fixed, *carry, *here])
            carry = out[:carries]
            stacked.append(out[carries:])
        if p["reverse"]:
            stacked.reverse()
        columns = [
            self._apply(lambda *xs: jnp.stack(xs), list(c)) for c in zip(*stacked, strict=True)
        ]
        return [*carry, *columns]

    def _repeat(self, equation: core.JaxprEqn, inputs: list[int]) -> list[int]:
        """The operations of a loop while its condition is known."""
        p = equation.params
        test, body = p["cond_jaxpr"], p["body_jaxpr"]
        first = p["cond_nconsts"]
        last = first + p["body_nconsts"]
        carry = inputs[last:]
        for _ in range(MAX_OPERATIONS):
            (condition,) = self.inline(test.jaxpr, test.consts, [*inputs[:first], *carry])
            value = self.known.get(condition)
            if not isinstance(value, np.ndarray):
                raise ValueError(f"{self._place(equation)}: {refusal('while')}")
            if not value.all():
                return carry
            carry = self.inline(body.jaxpr, body.consts, [*inputs[first:last], *carry])
        raise ValueError(f"{self._place(equation)}: the loop has more than {MAX_OPERATIONS} steps.")

    def _branches(self, equation: core.JaxprEqn, inputs: list[int]) -> list[int]:
        """The branch of a known index, or all branches and a choice between their results."""
        (index, *operands), branches = inputs, equation.params["branches"]
        value = self.known.get(index)
        if isinstance(value, np.ndarray):
            branches = [branches[int(np.clip(value[0], 0, len(branches) - 1))]]
        results = [self.inline(branch.jaxpr, branch.consts, operands) for branch in branches]
        outputs = []
        for variable, cases in zip(equation.outvars, zip(*results, strict=True), strict=True):
            equal, spec = len(set(cases)) == 1, spec_of(variable)
            choice = [index, *cases]
            outputs.append(
                cases[0] if equal else self._elementwise("select_n", equation, choice, spec)
            )
        return outputs

    def _apply(self, function: Callable[..., jax.Array], inputs: list[int]) -> int:
        """Appends the operations of a function of variables."""
        closed = jax.make_jaxpr(function)(*(self.shapes[i] for i in inputs))
        return self.inline(closed.jaxpr, closed.consts, inputs)[0]


def _equal_ranks(
    outside: Sequence[core.Var | core.Literal], inside: Sequence[core.Var | core.Literal]
) -> int:
    """The number of variables with as many axes inside a loop as outside."""
    pairs = zip(outside, inside, strict=True)
    return sum(len(spec_of(x).shape) == len(spec_of(y).shape) for x, y in pairs)


def _needed(jaxpr: core.Jaxpr) -> list[core.JaxprEqn]:
    """The equations that the outputs depend on; others, as of unused random keys, are left out."""
    needed = {v for v in jaxpr.outvars if isinstance(v, core.Var)}
    equations = []
    for equation in reversed(jaxpr.eqns):
        if not needed.isdisjoint(equation.outvars):
            equations.append(equation)
            needed |= {v for v in equation.invars if isinstance(v, core.Var)}
    return equations[::-1]
