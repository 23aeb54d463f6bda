"""Batches of independent computations over the cores of a processor.

XLA executes the loops of one program one after another, on one core. Here the ``vmap`` of a function
splits the batch into parts, which threads of the host compute by calls of one compiled program. That
program belongs to a client of XLA apart from JAX's, so that no part waits for a thread that its
caller occupies. On other devices and within meshes the batch is that of ``vmap``.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, cached_property
from typing import TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import mlir
from jax.sharding import SingleDeviceSharding

from jaxltl.core.array_types import PyTree
from jaxltl.core.models.ops.array_namespace import enable_x64

Result = TypeVar("Result")

_SMALL = 65_536  # bytes of an array that is passed to a part sooner than it is placed for all


def over_cores(function: Callable[..., Result], *arguments: PyTree) -> Result:
    """``function(*arguments)``, batched under ``vmap`` over the cores of the processor.

    The function is pure and closes over no traced array. Rounding is that of ``vmap`` of the lanes
    of one core.
    """
    return cast(Result, _call(function, None, jax.tree.map(jnp.asarray, arguments)))


def num_cores() -> int:
    """Number of cores that this process uses: ``NPROC``, as in XLA, or all that it may use."""
    setting = os.environ.get("NPROC", "")
    if setting.isdecimal():
        return max(int(setting), 1)
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def _call(function: Callable[..., PyTree], lanes: PyTree, arguments: PyTree) -> PyTree:
    """``function(*arguments)``; with bools `lanes` of the arguments, its batch in parts."""

    @jax.custom_batching.custom_vmap
    def call(arguments: PyTree) -> PyTree:
        return function(*arguments) if lanes is None else _in_parts(function, lanes, arguments)

    @call.def_vmap
    def _(size: int, batched: list[PyTree], arguments: PyTree) -> tuple[PyTree, PyTree]:
        several = function if lanes is None else _vmap(function, lanes)
        has_lanes = any(jax.tree.leaves(batched))  # else only tangents have
        if size > 1 and has_lanes and _is_available():
            results = _call(several, batched[0], arguments)
        else:
            results = (_vmap(several, batched[0]) if has_lanes else several)(*arguments)
        return results, jax.tree.map(lambda _: has_lanes, results)

    return call(arguments)


def _vmap(function: Callable[..., PyTree], lanes: PyTree) -> Callable[..., PyTree]:
    return jax.vmap(function, jax.tree.map(lambda x: 0 if x else None, lanes))


def _is_available() -> bool:
    own = jax.sharding.get_abstract_mesh().empty and jax.default_backend() == "cpu"
    return own and num_cores() > 1 and _device() is not None


@cache
def _device() -> PyTree:
    """The processor, as a device that runs programs in the calling thread; None without support."""
    try:
        from jaxlib.xla_client import make_cpu_client

        client: PyTree = make_cpu_client(asynchronous=False, num_devices=1)
        return client.devices()[0]
    except Exception:  # an internal of jaxlib, which another version may lack or change
        return None


def _in_parts(function: Callable[..., PyTree], lanes: PyTree, arguments: PyTree) -> PyTree:
    several = _vmap(function, lanes)

    @jax.custom_jvp
    def call(arguments: PyTree) -> PyTree:
        parts = _Parts(function, lanes, arguments)
        if not parts.is_plain:
            return several(*arguments)
        return parts.decode(_parts.bind(*map(_data, jax.tree.leaves(arguments)), parts=parts))

    @call.defjvp
    def _(primals: PyTree, tangents: PyTree) -> PyTree:
        return jax.jvp(lambda x: several(*x), primals, tangents)

    return call(arguments)


class _Parts:
    """A batch of a function in parts of equal width, and the program of one part."""

    def __init__(self, function: Callable[..., PyTree], lanes: PyTree, arguments: PyTree) -> None:
        leaves, tree = jax.tree.flatten(arguments)
        self.lanes = jax.tree.leaves(lanes)
        self.size = next(x.shape[0] for x, has in zip(leaves, self.lanes, strict=True) if has)
        self.width = -(-self.size // num_cores())
        self.x64 = jnp.result_type(float) == np.float64
        keys = [_implementation(x) for x in leaves]

        def program(several: bool, data: tuple[jax.Array, ...]) -> list[jax.Array]:
            inputs = jax.tree.unflatten(tree, map(_undata, data, keys))
            results = (_vmap(function, lanes) if several else function)(*inputs)
            leaves, self.tree = jax.tree.flatten(results)
            self.keys = [_implementation(x) for x in leaves]
            return [_data(x) for x in leaves]

        self.whole = lambda *data: [_bits(x) for x in program(True, data)]
        place = SingleDeviceSharding(_device())
        shapes = [self._shape(_data(x), has) for x, has in zip(leaves, self.lanes, strict=True)]
        self.traced = jax.jit(
            lambda *data: program(self.width > 1, data), in_shardings=place, out_shardings=place
        ).trace(*shapes)
        self.results = list(self.traced.out_info)
        kinds = {np.dtype(x.dtype).kind for x in (*shapes, *self.results)}
        self.is_plain = kinds <= set("biuf") and not self.traced.jaxpr.effects

    def _shape(self, x: jax.Array, has: bool) -> jax.ShapeDtypeStruct:
        lanes = () if self.width == 1 else (self.width,)
        shape = (*lanes, *x.shape[1:]) if has else x.shape
        return jax.ShapeDtypeStruct(shape, x.dtype, weak_type=x.weak_type)

    @property
    def outputs(self) -> list[jax.core.ShapedArray]:
        """Results of all lanes, numbers of 64 bits as two of 32."""
        skip = self.width > 1
        pairs = [(2,) if x.dtype.itemsize == 8 else () for x in self.results]
        return [
            jax.core.ShapedArray(
                (self.size, *x.shape[skip:], *pair), np.uint32 if pair else x.dtype
            )
            for x, pair in zip(self.results, pairs, strict=True)
        ]

    def decode(self, results: list[jax.Array]) -> PyTree:
        """The tree of results."""
        leaves = [
            x if x.dtype == shape.dtype else lax.bitcast_convert_type(x, shape.dtype)
            for x, shape in zip(results, self.results, strict=True)
        ]
        return jax.tree.unflatten(self.tree, map(_undata, leaves, self.keys))

    @cached_property
    def compiled(self) -> list[PyTree]:
        """The program of a part, for each thread."""
        with enable_x64(self.x64):
            program = self.traced.lower().compile()
        # While the first call of a handle runs, other threads wait at that handle.
        return [copy.copy(program) for _ in range(0, self.size, self.width)]

    def __call__(self, *data: np.ndarray) -> list[np.ndarray]:
        """Results of all lanes, from views of the arguments."""
        skip = self.width > 1
        results = [np.empty((self.size, *x.shape[skip:]), x.dtype) for x in self.results]

        def part(start: int) -> None:
            stop = min(start + self.width, self.size)
            rows: PyTree = start
            if skip:  # the last part repeats its last lane
                rows = np.minimum(np.arange(start, start + self.width), self.size - 1)
            inputs = [x[rows] if has else x for x, has in zip(shared, self.lanes, strict=True)]
            with enable_x64(self.x64):  # local to a thread
                for x, y in zip(results, self.compiled[start // self.width](*inputs), strict=True):
                    x[start:stop] = np.asarray(y)[: stop - start] if skip else np.asarray(y)

        with enable_x64(self.x64):  # one copy of large arrays for all parts
            shared = [
                x if has or x.nbytes < _SMALL else jax.device_put(x, _device())
                for x, has in zip(data, self.lanes, strict=True)
            ]
        starts = range(0, self.size, self.width)
        with ThreadPoolExecutor(min(num_cores(), len(starts))) as pool:
            list(pool.map(part, starts))
        # The caller's thread may be set to numbers of 32 bits.
        return [_bits(x) for x in results]


def _implementation(x: jax.Array) -> PyTree:
    """The implementation of random keys; None for numbers."""
    return jax.random.key_impl(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else None


def _data(x: jax.Array) -> jax.Array:
    return x if _implementation(x) is None else jax.random.key_data(x)


def _undata(x: jax.Array, implementation: PyTree) -> jax.Array:
    return x if implementation is None else jax.random.wrap_key_data(x, impl=implementation)


def _bits(x: PyTree) -> PyTree:
    """An array with numbers of 64 bits as two of 32, along a last axis."""
    if x.dtype.itemsize < 8:
        return x
    if isinstance(x, np.ndarray):
        return x.view(np.uint32).reshape(*x.shape, 2)
    return lax.bitcast_convert_type(x, jnp.uint32)


_parts = Primitive("over_cores")
_parts.multiple_results = True
_parts.def_abstract_eval(lambda *data, parts: parts.outputs)
_parts.def_impl(lambda *data, parts: [jnp.asarray(x) for x in parts(*map(np.asarray, data))])


def _lower(context: PyTree, *data: PyTree, parts: _Parts) -> PyTree:
    """A call of the host in a program of one processor, else the ``vmap``."""
    module = context.module_context
    whole = mlir.lower_fun(parts.whole, multiple_results=True)
    single = getattr(module.axis_context, "num_devices", None) == 1
    if not single or tuple(module.platforms) != ("cpu",):
        return whole(context, *data)
    with ThreadPoolExecutor(1) as pool:  # apart from the caller's program, which is incomplete
        pool.submit(lambda: parts.compiled).result()
    try:
        return mlir.emit_python_callback(
            context,
            parts,
            None,
            list(data),
            context.avals_in,
            context.avals_out,
            has_side_effect=False,
            returns_token=False,
        )[0]
    except Exception:  # an internal of JAX, which another version may lack or change
        return whole(context, *data)


mlir.register_lowering(_parts, _lower)
