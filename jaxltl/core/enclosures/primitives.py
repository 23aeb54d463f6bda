"""Primitives of JAX: the entries that they select, their matrices, and what is not supported."""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core
from numpy.typing import DTypeLike

from jaxltl.core.array_types import Array
from jaxltl.core.enclosures.interval import module_of


def narrows(new: DTypeLike, old: DTypeLike) -> bool:
    """True if a conversion to a dtype of floats loses digits."""
    new, old = jnp.dtype(new), jnp.dtype(old)
    if not jnp.issubdtype(new, jnp.floating):
        return False
    if jnp.issubdtype(old, jnp.integer):
        return jnp.iinfo(old).bits > jnp.finfo(new).nmant
    return jnp.issubdtype(old, jnp.floating) and jnp.finfo(new).bits < jnp.finfo(old).bits


def selection(
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
            place, (data, at, new) = (
                p["dimension_numbers"],
                map(jnp.asarray, (x, *indices, numbers[1])),
            )
            return [jax.lax.scatter(data, at, new, place, **options)]
        if name == "gather" and p["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP:
            # Evaluated by itself, since its lowering evaluates further primitives.
            p = p | {"mode": jax.lax.GatherScatterMode.CLIP, "fill_value": None}
            chosen = np.asarray(
                equation.primitive.bind(jnp.asarray(x), *map(jnp.asarray, indices), **p)
            )
            return [
                np.where(
                    _in_range(equation, x.shape, np.asarray(indices[0]), chosen.shape), chosen, -1
                )
            ]
        entries = equation.primitive.bind(*map(jnp.asarray, [*numbers, *indices]), **p)
    return list(entries) if equation.primitive.multiple_results else [entries]


def _in_range(
    equation: core.JaxprEqn, shape: tuple[int, ...], indices: np.ndarray, output: tuple[int, ...]
) -> np.ndarray:
    """Entries of a gather's output that come from indices in range."""
    p, numbers = equation.params, equation.params["dimension_numbers"]
    last = np.array([shape[d] - p["slice_sizes"][d] for d in numbers.start_index_map])
    valid = ((indices >= 0) & (indices <= last)).all(-1)
    lengths = [1 if d in numbers.offset_dims else n for d, n in enumerate(output)]
    return np.broadcast_to(valid.reshape(lengths), output)


def matrix_of(equation: core.JaxprEqn, known: list[Array | None], index: int) -> Array:
    """Matrix of a primitive that is linear in one input: its values at unit vectors."""
    shape, output = shape_of(equation, index), spec_of(equation.outvars[0])
    units = np.eye(math.prod(shape), dtype=output.dtype).reshape(-1, *shape)
    columns: Array
    if str(equation.primitive) == "reduce_sum":
        columns = units.sum(tuple(a + 1 for a in equation.params["axes"]))
    elif str(equation.primitive) == "cumsum":
        axis, step = equation.params["axis"] + 1, -1 if equation.params["reverse"] else 1
        ordered = np.moveaxis(units, axis, 0)[::step]
        columns = np.moveaxis(np.cumsum(ordered, 0)[::step], 0, axis)
    else:
        *letters, out, _ = letters_of(equation)
        other = known[1 - index]
        assert other is not None
        other = other.reshape(shape_of(equation, 1 - index)).astype(output.dtype)
        subscripts = f"Z{letters[index]},{letters[1 - index]}->Z{out}"
        columns = module_of(other).einsum(subscripts, units, other)
    return columns.reshape(len(units), -1).T


def spec_of(atom: core.Var | core.Literal) -> jax.ShapeDtypeStruct:
    """Shape and dtype of a variable or literal."""
    aval: Any = atom.aval
    return jax.ShapeDtypeStruct(aval.shape, aval.dtype)


def shape_of(equation: core.JaxprEqn, index: int) -> tuple[int, ...]:
    """Shape of an input."""
    return tuple(spec_of(equation.invars[index]).shape)


def letters_of(equation: core.JaxprEqn) -> tuple[str, str, str, str]:
    """Subscripts of a dot product: left, right, output, and the contracted ones."""
    (left_sum, right_sum), (left_batch, right_batch) = equation.params["dimension_numbers"]
    names = iter("abcdefghijklmnopqrstuvwxyz")
    left = [next(names) for _ in shape_of(equation, 0)]
    right = [next(names) for _ in shape_of(equation, 1)]
    for a, b in zip((*left_sum, *left_batch), (*right_sum, *right_batch), strict=True):
        right[b] = left[a]
    batch = [left[a] for a in left_batch]
    summed = [left[a] for a in left_sum]
    free = [c for c in left + right if c not in batch + summed]
    return "".join(left), "".join(right), "".join(batch + free), "".join(summed)


def refusal(name: str) -> str:
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
