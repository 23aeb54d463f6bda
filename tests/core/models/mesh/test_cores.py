"""Batches over the cores of the processor: lanes are as if alone, and are computed at once."""

import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.interpreters import mlir
from jax.sharding import PartitionSpec
from jaxlib import xla_client

from jaxltl.core.models.mesh import cores
from jaxltl.core.models.mesh.cores import over_cores
from tests.support import counted_traces, lane

MAX_PROGRAMS = 450  # that the default tests compile at most

TIMEOUT = 60.0  # seconds, for threads that never meet


@pytest.fixture(autouse=True)
def two_cores(monkeypatch):
    monkeypatch.setenv("NPROC", "2")


def walk(state, limit):
    """A walk until it is far from zero: numbers of all kinds, a key, an empty array."""

    def on(carry):
        key, x, n, flag, small = carry
        key, own = jax.random.split(key)
        return key, x + jax.random.normal(own, x.shape), n + 1, ~flag, small + jnp.float16(0.5)

    end = lax.while_loop(lambda c: jnp.abs(c[1]).sum() < limit, on, state)
    return {"key": end[0], "numbers": end[1:], "fixed": (jnp.uint8(3), jnp.zeros((0,)), limit)}


def states(number):
    return (
        jax.random.split(jax.random.key(0), number),
        jnp.zeros((number, 3)),
        jnp.zeros(number, jnp.result_type(int)),
        jnp.zeros(number, bool),
        jnp.zeros(number, jnp.float16),
    )


def assert_equal(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert x.dtype == y.dtype
        numbers = [
            jax.random.key_data(z) if jnp.issubdtype(z.dtype, jax.dtypes.prng_key) else z
            for z in (x, y)
        ]
        np.testing.assert_array_equal(*map(np.asarray, numbers))


@pytest.mark.few(1)
@pytest.mark.parametrize("double", [True, False])
@pytest.mark.parametrize("number", [1, 2, 5])
def test_lanes_are_as_if_alone(number, double):
    with jax.enable_x64(double):
        batch = jax.vmap(partial(over_cores, walk), (0, None))
        alone = jax.jit(walk)
        expected = [alone(lane(states(number), i), 4.0) for i in range(number)]
        found = batch(states(number), 4.0)
        assert_equal(found, jax.tree.map(lambda *x: jnp.stack(x), *expected))
        assert_equal(jax.jit(batch)(states(number), 4.0), found)


@pytest.mark.skipif(
    jax.__version_info__ < (0, 10), reason="older JAX makes callbacks of parts one after another"
)
def test_the_parts_are_computed_at_once():
    meeting = threading.Barrier(2, timeout=TIMEOUT)

    def meet(x):
        meeting.wait()
        return x

    def function(x):
        return jax.pure_callback(meet, x, x, vmap_method="sequential")

    found = jax.jit(jax.vmap(partial(over_cores, function)))(jnp.arange(2.0))
    assert found.tolist() == [0.0, 1.0]
    assert not meeting.broken


def test_many_large_batches_at_once_end():
    """No part waits for a thread of JAX, all of which these programs occupy."""
    batch = jax.jit(jax.vmap(partial(over_cores, lambda x: jnp.cumsum(x) / x.size)))
    first = jax.jit(lambda i: jnp.sin(jnp.full((4, 30_000), i) + jnp.arange(30_000)).cumsum(1))
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda i: batch(first(jnp.float32(i))), range(16)))
    for i, x in enumerate(found):
        expected = jax.vmap(lambda x: jnp.cumsum(x) / x.size)(first(jnp.float32(i)))
        np.testing.assert_allclose(x, expected, rtol=1e-4, atol=1e-6)


def test_new_numbers_do_not_retrace():
    batch = jax.vmap(partial(over_cores, walk), (0, None))
    jax.block_until_ready(batch(states(4), 4.0))
    other = jax.tree.map(lambda x: x[::-1], states(4))
    jax.block_until_ready(other)
    run = jax.jit(batch)
    run(states(4), 4.0)
    with counted_traces() as traced:
        run(other, 5.0)
    assert not traced


def grow(rate, steps):
    return lax.fori_loop(0, steps, lambda _, x: x + rate * jnp.sin(x), jnp.float32(1))


def test_it_nests_and_is_differentiable():
    function = partial(over_cores, grow)
    rates, steps = jnp.linspace(0, 1, 6, dtype=jnp.float32).reshape(2, 3), jnp.array([3, 4, 5])
    nested = jax.jit(jax.vmap(jax.vmap(function), (0, None)))(rates, steps)
    expected = jnp.array([[grow(r, n) for r, n in zip(row, steps, strict=True)] for row in rates])
    np.testing.assert_allclose(nested, expected, rtol=1e-6)
    slope = jax.jit(jax.vmap(jax.jacfwd(function)))(rates[0], steps)
    other = jax.jacfwd(lambda x: jax.vmap(function)(x, steps))(rates[0])
    expected = [jax.jacfwd(grow)(r, n) for r, n in zip(rates[0], steps, strict=True)]
    np.testing.assert_allclose(slope, jnp.array(expected), rtol=1e-5)
    np.testing.assert_allclose(jnp.diag(other), jnp.array(expected), rtol=1e-5)


def test_arrays_on_several_devices_stay_there():
    mesh = jax.make_mesh((2,), ("lanes",), devices=jax.devices()[:2])
    own = jax.sharding.NamedSharding(mesh, PartitionSpec("lanes"))
    x = jax.device_put(np.arange(4.0), own)
    found = jax.jit(jax.vmap(partial(over_cores, lambda x: x + 1)))(x)
    assert found.tolist() == [1, 2, 3, 4]
    assert found.sharding.is_equivalent_to(own, 1)


def test_an_error_in_a_part_is_an_error():
    def fail(x):
        raise ValueError("no such number")

    def function(x):
        return jax.pure_callback(fail, x, x, vmap_method="sequential")

    with pytest.raises(Exception, match="no such number"):
        jax.block_until_ready(jax.jit(jax.vmap(partial(over_cores, function)))(jnp.arange(2.0)))


@pytest.mark.parametrize("internal", ["make_cpu_client", "emit_python_callback"])
@pytest.mark.parametrize("missing", [True, False])
def test_without_internals_of_jax_it_is_the_vmap(internal, missing, monkeypatch):
    def refuse(*_, **__):
        raise RuntimeError("changed")

    def name(x):
        return x + threading.current_thread().name.startswith("ThreadPool")

    def function(x):  # a function of its own, so that nothing is cached
        return jax.pure_callback(name, x, x, vmap_method="sequential")

    owner = mlir if internal == "emit_python_callback" else xla_client
    if missing:
        monkeypatch.delattr(owner, internal)
    else:
        monkeypatch.setattr(owner, internal, refuse)
    cores._device.cache_clear()
    try:
        found = jax.jit(jax.vmap(partial(over_cores, function)))(jnp.arange(3))
        assert found.tolist() == [0, 1, 2]
    finally:
        monkeypatch.undo()
        cores._device.cache_clear()
