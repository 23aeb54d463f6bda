"""JAX functions as straight-line programs of three kinds of operations on flat vectors.

Every variable is a vector; what remains of a function's primitives is selection of entries by
constant indices (reshapes, slices, broadcasts, indexing), products with matrices (dot products with
known arrays, sums), and elementwise functions. Calls are inlined and loops of fixed length are
unrolled.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from numpy.typing import DTypeLike

from jaxltl.core.array_types import Array
from jaxltl.core.enclosures.interval import module_of
from jaxltl.core.models.protocols import PyTree

MAX_OPERATIONS = 20_000  # after loops are unrolled
MAX_MATRIX = 2**26  # entries of the matrix of one product
_OWN = (str(Path(jax.__file__).parent), str(Path(__file__).parent))

ELEMENTWISE = {
    "add", "sub", "mul", "div", "max", "min", "neg", "abs", "sign", "floor", "ceil", "round",
    "exp", "exp2", "expm1", "log", "log2", "log1p", "logistic", "tanh", "sqrt", "rsqrt", "cbrt",
    "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "asinh", "erf",
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
class Program:
    """A straight-line program on flat vectors."""

    operations: tuple[Operation, ...]
    inputs: tuple[int, ...]
    known: Mapping[int, Array]  # vectors that are known: literals, constants, results of integers
    outputs: tuple[int, ...]
    shapes: Mapping[int, jax.ShapeDtypeStruct]  # of the arrays before they were made flat
    output_tree: jax.tree_util.PyTreeDef


def make_program(function: Callable[..., PyTree], *args: PyTree) -> Program:
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
    inputs = [builder.new(_spec(v)) for v in closed.jaxpr.invars]
    outputs = builder.inline(closed.jaxpr, closed.consts, inputs)
    return Program(
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

    def new(self, aval: jax.ShapeDtypeStruct) -> int:
        """A new variable of a shape and dtype."""
        index = len(self.shapes)
        self.shapes[index] = jax.ShapeDtypeStruct(aval.shape, aval.dtype)
        return index

    def constant(self, value: Array) -> int:
        """A variable with a known value."""
        if not isinstance(value, jax.core.Tracer):
            value = np.asarray(value)
        index = self.new(jax.ShapeDtypeStruct(value.shape, value.dtype))
        self.known[index] = value.reshape(-1)
        return index

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
            return self.constant(np.asarray(atom.val, _spec(atom).dtype))

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
        output = _spec(equation.outvars[0])
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
        if name in ELEMENTWISE:
            return [self._elementwise(name, equation, inputs, output)]
        raise ValueError(f"{self._place(equation)}: {_refusal(name)}")

    def _is_exact(self, name: str, equation: core.JaxprEqn, inputs: list[int]) -> bool:
        """True for an operation on known numbers that is evaluated without rounding."""
        if not all(x in self.known for x in inputs):
            return False
        exact = not any(jnp.issubdtype(_spec(v).dtype, jnp.floating) for v in equation.outvars)
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
        entries = _selection(name, equation, numbers, known)
        selected = list(zip(map(np.asarray, entries), map(_spec, equation.outvars), strict=True))
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
        y = self.new(output)
        self.operations.append(Select(tuple(inputs), y, np.asarray(index).reshape(-1)))
        return y

    def _elementwise(
        self, name: str, equation: core.JaxprEqn, inputs: list[int], output: jax.ShapeDtypeStruct
    ) -> int:
        inputs = [self._broadcast(x, output.shape) for x in inputs]
        index = self.new(output)
        self.operations.append(
            Elementwise(name, equation.params, tuple(inputs), index, self._place(equation))
        )
        return index

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
        axes, output = equation.params["axes"], _spec(equation.outvars[0])
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
        shape, output = self.shapes[inputs[index]].shape, _spec(equation.outvars[0])
        rows, columns = math.prod(output.shape), math.prod(shape)
        if not columns:  # such as of a world without actions
            return self.constant(np.zeros(output.shape, output.dtype))
        if rows * columns > MAX_MATRIX:
            raise ValueError(
                f"{self._place(equation)}: a product with a matrix of {rows} by {columns} entries, "
                f"{8 * rows * columns:.1e} bytes; split the array."
            )
        matrix = _matrix(equation, [self.known.get(x) for x in inputs], index)
        y = self.new(output)
        self.operations.append(MatrixProduct((inputs[index],), y, matrix))
        return y

    def _dot(self, equation: core.JaxprEqn, inputs: list[int]) -> int:
        """A dot product: with a known array a matrix; else products of entries, and their sums."""
        for index in (0, 1):
            if inputs[1 - index] in self.known:
                return self._linear(equation, inputs, index)
        left, right, out, summed = _letters(equation)
        sizes = dict(zip(left + right, _shape(equation, 0) + _shape(equation, 1), strict=True))
        output, order = _spec(equation.outvars[0]), out + summed
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
        y = self.new(output)
        self.operations.append(MatrixProduct((products,), y, matrix))
        return y

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
                raise ValueError(f"{self._place(equation)}: {_refusal('while')}")
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
            equal, spec = len(set(cases)) == 1, _spec(variable)
            choice = [index, *cases]
            outputs.append(
                cases[0] if equal else self._elementwise("select_n", equation, choice, spec)
            )
        return outputs

    def _apply(self, function: Callable[..., jax.Array], inputs: list[int]) -> int:
        """Appends the operations of a function of variables."""
        closed = jax.make_jaxpr(function)(*(self.shapes[i] for i in inputs))
        return self.inline(closed.jaxpr, closed.consts, inputs)[0]


def _equal_ranks(outside: Sequence[core.Var], inside: Sequence[core.Var]) -> int:
    """The number of variables with as many axes inside a loop as outside."""
    pairs = zip(outside, inside, strict=True)
    return sum(len(_spec(x).shape) == len(_spec(y).shape) for x, y in pairs)


def _needed(jaxpr: core.Jaxpr) -> list[core.JaxprEqn]:
    """The equations that the outputs depend on; others, as of unused random keys, are left out."""
    needed = {v for v in jaxpr.outvars if isinstance(v, core.Var)}
    equations = []
    for equation in reversed(jaxpr.eqns):
        if not needed.isdisjoint(equation.outvars):
            equations.append(equation)
            needed |= {v for v in equation.invars if isinstance(v, core.Var)}
    return equations[::-1]


def narrows(new: DTypeLike, old: DTypeLike) -> bool:
    """True if a conversion to a dtype of floats loses digits."""
    new, old = jnp.dtype(new), jnp.dtype(old)
    if not jnp.issubdtype(new, jnp.floating):
        return False
    if jnp.issubdtype(old, jnp.integer):
        return jnp.iinfo(old).bits > jnp.finfo(new).nmant
    return jnp.issubdtype(old, jnp.floating) and jnp.finfo(new).bits < jnp.finfo(old).bits


def _selection(
    name: str, equation: core.JaxprEqn, numbers: list[np.ndarray], indices: list[Array]
) -> list[Array]:
    """The numbers that the primitive selects; without compilation for the common ones."""
    p, x = equation.params, numbers[0]
    if name == "reshape":
        return list(numbers)
    if name == "transpose":
        return [x.transpose(p["permutation"])]
    if name == "slice":
        strides = p["strides"] or (1,) * x.ndim
        cut = zip(p["start_indices"], p["limit_indices"], strides, strict=True)
        return [x[tuple(slice(*c) for c in cut)]]
    if name == "rev":
        return [np.flip(x, p["dimensions"])]
    if name == "concatenate":
        return [np.concatenate(numbers, p["dimension"])]
    if name == "stack":
        return [np.stack(numbers, p["axis"])]
    if name == "unstack":
        return list(np.moveaxis(x, p["axis"], 0))
    if name == "broadcast_in_dim":
        place = [1] * len(p["shape"])
        for axis, size in zip(p["broadcast_dimensions"], x.shape, strict=True):
            place[axis] = size
        return [np.broadcast_to(x.reshape(place), p["shape"])]
    with jax.ensure_compile_time_eval():
        if name == "scatter":
            options = {x: p[x] for x in ("indices_are_sorted", "unique_indices", "mode")}
            place, arrays = p["dimension_numbers"], [x, *indices, numbers[1]]
            return [jax.lax.scatter(*map(jnp.asarray, arrays), place, **options)]
        if name == "gather":
            p = p | {"fill_value": -1}  # marks entries out of range
        entries = equation.primitive.bind(*map(jnp.asarray, [*numbers, *indices]), **p)
    return list(entries) if equation.primitive.multiple_results else [entries]


def _matrix(equation: core.JaxprEqn, known: list[Array | None], index: int) -> Array:
    """Matrix of a primitive that is linear in one input: its values at unit vectors."""
    shape, output = _shape(equation, index), _spec(equation.outvars[0])
    units = np.eye(math.prod(shape), dtype=output.dtype).reshape(-1, *shape)
    columns: Array
    if str(equation.primitive) == "reduce_sum":
        columns = units.sum(tuple(a + 1 for a in equation.params["axes"]))
    elif str(equation.primitive) == "cumsum":
        axis, step = equation.params["axis"] + 1, -1 if equation.params["reverse"] else 1
        ordered = np.moveaxis(units, axis, 0)[::step]
        columns = np.moveaxis(np.cumsum(ordered, 0)[::step], 0, axis)
    else:
        *letters, out, _ = _letters(equation)
        other = known[1 - index]
        assert other is not None
        other = other.reshape(_shape(equation, 1 - index)).astype(output.dtype)
        subscripts = f"Z{letters[index]},{letters[1 - index]}->Z{out}"
        columns = module_of(other).einsum(subscripts, units, other)
    return columns.reshape(len(units), -1).T


def _spec(atom: core.Var | core.Literal) -> jax.ShapeDtypeStruct:
    """Shape and dtype of a variable or literal."""
    aval: Any = atom.aval
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype)


def _shape(equation: core.JaxprEqn, index: int) -> tuple[int, ...]:
    """Shape of an input."""
    return tuple(_spec(equation.invars[index]).shape)


def _letters(equation: core.JaxprEqn) -> tuple[str, str, str, str]:
    """Subscripts of a dot product: left, right, output, and the contracted ones."""
    (left_sum, right_sum), (left_batch, right_batch) = equation.params["dimension_numbers"]
    names = iter("abcdefghijklmnopqrstuvwxyz")
    left = [next(names) for _ in _shape(equation, 0)]
    right = [next(names) for _ in _shape(equation, 1)]
    for a, b in zip((*left_sum, *left_batch), (*right_sum, *right_batch), strict=True):
        right[b] = left[a]
    batch = [left[a] for a in left_batch]
    summed = [left[a] for a in left_sum]
    free = [c for c in left + right if c not in batch + summed]
    return "".join(left), "".join(right), "".join(batch + free), "".join(summed)


def _refusal(name: str) -> str:
    """Remedy for an unsupported primitive."""
    if name == "while":
        return (
            f"`{name}` depends on values that are not known. Use a loop of fixed length (lax.scan, or "
            "lax.fori_loop with constant bounds) and jnp.where."
        )
    return (
        f"the primitive `{name}` has no enclosure. Supported are arithmetic, dot products, elementary "
        "functions, min, max, clip, where, indexing by constants, reshapes and loops of fixed length."
    )
