"""Batches of independent computations over the devices of a mesh, without communication."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import AbstractMesh, AxisType, Mesh, NamedSharding, PartitionSpec

from jaxltl.core.models.ops.array_namespace import jit
from jaxltl.core import validation
from jaxltl.core.array_types import PyTree


def vmap_over_mesh(
    function: Callable[..., PyTree],
    mesh: Mesh,
    axis: str | Sequence[str] | None = None,
    *,
    in_axes: PyTree = 0,
) -> Callable[..., PyTree]:
    """``jax.vmap(function, in_axes)`` with the batch distributed over the devices of a mesh.

    Device d of D runs the d-th N / D elements (``PartitionSpec(axis)``), and the results stay there.
    Works under ``jit``, and over several processes (``jax.distributed``) that make the same call. If D
    does not divide N, elements are repeated up to the next multiple, and the results are replicated.
    Rounding is that of ``vmap`` of N / D elements.

    Args:
      function: of one element, such as a learner's ``train``; compiled once for each function, mesh
        and shapes.
      mesh: devices, such as ``jax.make_mesh((jax.device_count(),), ("lanes",))``.
      axis: the mesh axis or axes of the batch; devices along others do the same, or share the work of
        an element if `function` does so. Default: all.
      in_axes: as of ``vmap``, 0 or None for each argument or part.

    Returns:
      A function of batched arguments; keywords are static and passed to `function`.

    Raises:
      ValueError: an unknown axis, other `in_axes`, or batches of different size.

    >>> mesh = jax.make_mesh((jax.device_count(),), ("seeds",))
    >>> def draw(key, scale):
    ...     return scale * jax.random.normal(key)
    >>> vmap_over_mesh(draw, mesh, in_axes=(0, None))(jax.random.split(jax.random.key(0), 6), 0.1).shape
    (6,)
    """
    validation.instance("mesh", mesh, Mesh, "a jax.sharding.Mesh, such as jax.make_mesh makes")
    names = axes_of(mesh, axis)

    def over(*arguments: PyTree, **options: object) -> PyTree:
        lanes = tuple(_spread(in_axes, arguments))
        number = _number(lanes, arguments)
        if not any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(arguments)):
            arguments = _placed(arguments, lanes, number, mesh, names)
        return _mapped(function, mesh, names, lanes, tuple(sorted(options.items())), arguments)

    return over


def on_host(tree: PyTree) -> PyTree:
    """NumPy copies of a tree's arrays, in every process; random keys stay keys.

    Args:
      tree: arrays and numbers; all processes call it for distributed ones.

    Returns:
      The tree of NumPy arrays.

    >>> on_host({"a": jnp.arange(3), "b": 2.5})["a"].tolist()
    [0, 1, 2]
    """

    def one(x: PyTree) -> PyTree:
        if not isinstance(x, jax.Array):
            return np.asarray(x)
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            words = one(jax.random.key_data(x))
            return jax.random.wrap_key_data(words, impl=jax.random.key_impl(x))
        sharding: Any = x.sharding
        if not x.is_fully_addressable and not x.is_fully_replicated:
            x = _copied(x, sharding.mesh)
        return np.asarray(x)

    return jax.tree.map(one, tree)


def axes_of(mesh: Mesh, axis: str | Sequence[str] | None) -> tuple[str, ...]:
    """Names of mesh axes: one, several, or all for None; ValueError for an unknown or repeated name."""
    names = mesh.axis_names if axis is None else (axis,) if isinstance(axis, str) else tuple(axis)
    if not names or len(set(names)) < len(names) or not set(names) <= set(mesh.axis_names):
        raise ValueError(
            f"axis={axis!r}; the mesh has the axes {', '.join(map(repr, mesh.axis_names))}: name "
            "one of them, or several, each once."
        )
    return names


def automatic(mesh: Mesh) -> Mesh:
    """The mesh with automatic axes: JAX partitions the arrays."""
    return Mesh(mesh.devices, mesh.axis_names, axis_types=(AxisType.Auto,) * len(mesh.axis_names))


def _first_axes(sharding: NamedSharding) -> tuple[str, ...]:
    """The mesh axes over which a sharding splits the first axis."""
    first = (*sharding.spec, None)[0]
    return () if first is None else (first,) if isinstance(first, str) else tuple(first)


def _here(mesh: Any) -> PyTree:
    """The ambient mesh of a trace, else the given one."""
    ambient = jax.sharding.get_abstract_mesh()
    return automatic(mesh) if ambient.empty else ambient


def _count(mesh: Mesh | AbstractMesh, axes: Sequence[str]) -> int:
    return math.prod(mesh.shape[name] for name in axes)


# --- within a lane --------------------------------------------------------------------------------


def require_split(name: str, sharding: NamedSharding | None, **sizes: int) -> None:
    """Raises ValueError if a sharding does not split axes of the given sizes evenly; None is valid."""
    if sharding is None:
        return
    validation.instance(name, sharding, NamedSharding, "a jax.sharding.NamedSharding")
    axes = _first_axes(sharding)
    if not axes:
        raise ValueError(
            f"{name} has the spec {sharding.spec}, which splits nothing; name a mesh axis, "
            f"PartitionSpec({sharding.mesh.axis_names[0]!r})."
        )
    devices = _count(sharding.mesh, axes)
    for subject, size in sizes.items():
        if size % devices:
            raise ValueError(
                f"{name} splits over {devices} devices, but {subject} is {size}; choose a multiple, "
                f"such as {size - size % devices + devices}."
            )


def split_axis(tree: PyTree, sharding: NamedSharding | None, axis: int | None = 0) -> PyTree:
    """A tree with one axis of its arrays split over the devices of a sharding, under ``jit``.

    Replicated for the axis None; unchanged for no sharding.
    """
    if sharding is None:
        return tree
    mesh, spec = _here(sharding.mesh), _split(sharding, axis)
    return jax.tree.map(lambda x: _constrained(x, mesh, spec), tree)


replicate = partial(split_axis, axis=None)


def _split(sharding: NamedSharding, axis: int | None) -> PartitionSpec:
    """The spec that splits an axis as a sharding splits its first one."""
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, _first_axes(sharding))


def shard_function(
    function: Callable[..., PyTree],
    sharding: NamedSharding | None,
    axes: Sequence[int | None],
    out_axes: PyTree,
) -> Callable[..., PyTree]:
    """A function on each device's share of the arguments, split along `axes`, under ``jit``; None: unchanged."""
    if sharding is None:
        return function
    spec = partial(_split, sharding)
    return jax.shard_map(
        function,
        mesh=_here(sharding.mesh),
        in_specs=tuple(map(spec, axes)),
        out_specs=jax.tree.map(spec, out_axes, is_leaf=lambda x: x is None),
        axis_names=set(_first_axes(sharding)),
        check_vma=False,
    )


def vmap_split(
    function: Callable[..., PyTree], sharding: NamedSharding | None, in_axes: PyTree
) -> PyTree:
    """:func:`vmap_over_mesh` over the devices of a sharding; ``vmap`` for None."""
    if sharding is None:
        return jax.vmap(function, in_axes)
    mesh: Any = sharding.mesh
    return vmap_over_mesh(function, mesh, _first_axes(sharding), in_axes=in_axes)


def device_ranks(sharding: NamedSharding | None) -> jax.Array:
    """``int32[D]``, device numbers, one for each call by :func:`shard_function`."""
    devices = 1 if sharding is None else _count(sharding.mesh, _first_axes(sharding))
    return jnp.arange(devices, dtype=jnp.int32)


def running_sum(
    counted: jax.Array, rank: jax.Array, sharding: NamedSharding | None
) -> tuple[jax.Array, jax.Array]:
    """Cumulative counts over all devices, ``int32[N]`` from a device's ``bool[N]``, and the total."""
    number = jnp.cumsum(counted, dtype=jnp.int32)
    if sharding is None:
        return number, number[-1]
    every = lax.all_gather(number[-1], _first_axes(sharding))
    before = jnp.where(jnp.arange(len(every)) < rank, every, 0)
    return number + before.sum(dtype=jnp.int32), every.sum(dtype=jnp.int32)


# --- arguments ------------------------------------------------------------------------------------


def _spread(in_axes: PyTree, arguments: tuple[PyTree, ...]) -> list[bool]:
    """``bool`` for each array of the arguments: True if it is batched."""

    def is_none(x: PyTree) -> bool:
        return x is None

    axes = list(in_axes) if isinstance(in_axes, list | tuple) else [in_axes] * len(arguments)
    if len(axes) != len(arguments):
        raise ValueError(
            f"in_axes={in_axes} has {len(axes)} entries for {len(arguments)} arguments; give one "
            "for each."
        )
    lanes: list[bool] = []
    for entry, argument in zip(axes, arguments, strict=True):
        for axis in jax.tree.leaves(entry, is_leaf=is_none):
            if axis is not None and (isinstance(axis, bool) or axis != 0):
                raise ValueError(
                    f"in_axes has an entry {axis!r}; lanes lie along the first axis of an "
                    "argument, 0, or it has none, None."
                )
        jax.tree.map(
            lambda axis, part: lanes.extend([axis == 0] * len(jax.tree.leaves(part))),
            entry,
            argument,
            is_leaf=is_none,
        )
    return lanes


def _number(lanes: tuple[bool, ...], arguments: PyTree) -> int:
    shapes = [np.shape(x) for x, has in zip(jax.tree.leaves(arguments), lanes, strict=True) if has]
    numbers = sorted({shape[:1] for shape in shapes})
    if len(numbers) != 1 or not numbers[0] or numbers[0][0] < 1:
        raise ValueError(
            f"arguments with lanes have the first axes {[list(x) for x in numbers]}; give one "
            "number of lanes, at least 1, along the first axis of each, and in_axes of None for "
            "what all lanes share."
        )
    return int(numbers[0][0])


def _placed(
    arguments: PyTree, lanes: tuple[bool, ...], number: int, mesh: Mesh, axes: tuple[str, ...]
) -> PyTree:
    mesh = automatic(mesh) if jax.sharding.get_abstract_mesh().empty else mesh
    even = number % _count(mesh, axes) == 0
    own, all_ = (NamedSharding(mesh, PartitionSpec(*x)) for x in ((axes,), ()))

    def one(x: PyTree, sharding: NamedSharding) -> PyTree:
        if not isinstance(x, jax.Array | np.ndarray):
            return x  # a weakly typed number
        if not isinstance(x, jax.Array) or x.is_fully_addressable:
            if not sharding.is_fully_addressable:
                return _from_each(x, sharding)
        elif x.sharding.is_equivalent_to(sharding, x.ndim):
            return x
        return jax.device_put(x, sharding)

    leaves, tree = jax.tree.flatten(arguments)
    return jax.tree.unflatten(
        tree, [one(x, own if has and even else all_) for x, has in zip(leaves, lanes, strict=True)]
    )


def _from_each(x: PyTree, sharding: NamedSharding) -> jax.Array:
    """An array over the devices of several processes, from each process's part."""
    if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
        return cast(
            jax.Array,
            jax.random.wrap_key_data(
                _from_each(jax.random.key_data(x), sharding), impl=jax.random.key_impl(x)
            ),
        )
    numbers = np.asarray(x)
    return jax.make_array_from_callback(numbers.shape, sharding, lambda part: numbers[part])


@partial(jax.jit, static_argnames="mesh")
def _copied(x: jax.Array, mesh: Mesh) -> jax.Array:
    return _constrained(x, mesh, PartitionSpec())


def _constrained(x: jax.Array, mesh: Mesh | AbstractMesh, spec: PartitionSpec) -> jax.Array:
    sharding = NamedSharding(mesh, spec)
    if AxisType.Explicit in mesh.axis_types:
        result: jax.Array = jax.sharding.reshard(x, sharding)
    else:
        result = lax.with_sharding_constraint(x, sharding)
    return result


# --- lanes ----------------------------------------------------------------------------------------


@jit("function", "mesh", "axes", "lanes", "options")
def _mapped(
    function: Callable[..., PyTree],
    mesh: Mesh,
    axes: tuple[str, ...],
    lanes: tuple[bool, ...],
    options: tuple[tuple[str, object], ...],
    arguments: PyTree,
) -> PyTree:
    here = _here(mesh)
    leaves, tree = jax.tree.flatten(arguments)
    number = _number(lanes, arguments)
    devices = _count(mesh, axes)
    specs = [PartitionSpec(axes) if has else PartitionSpec() for has in lanes]
    uneven = number % devices
    if uneven:
        repeated = np.arange(number + devices - uneven) % number
        leaves = [x[repeated] if has else x for x, has in zip(leaves, lanes, strict=True)]
    if AxisType.Explicit in here.axis_types:
        leaves = [
            jax.sharding.reshard(x, NamedSharding(here, spec))
            for x, spec in zip(leaves, specs, strict=True)
        ]
    side_by_side = jax.vmap(
        partial(function, **dict(options)),
        jax.tree.unflatten(tree, [0 if has else None for has in lanes]),
    )
    # Loops begin with constants, which are not marked as different on each device: no check.
    results = jax.shard_map(
        side_by_side,
        mesh=here,
        in_specs=jax.tree.unflatten(tree, specs),
        out_specs=PartitionSpec(axes),
        axis_names=set(axes),
        check_vma=False,
    )(*jax.tree.unflatten(tree, leaves))
    if uneven:
        results = jax.tree.map(lambda x: _constrained(x, here, PartitionSpec())[:number], results)
    return results
