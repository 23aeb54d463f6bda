"""Lanes over the devices of a mesh are those of ``vmap``; and what is split within a lane."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.sharding import AxisType, NamedSharding, PartitionSpec

import jaxltl as jl
from jaxltl.core.models.mesh import lanes
from tests.support import counted_traces

P = PartitionSpec


def mesh_of(*sizes, explicit=False):
    kind = AxisType.Explicit if explicit else AxisType.Auto
    return jax.make_mesh(
        sizes,
        ("lanes", "more")[: len(sizes)],
        axis_types=(kind,) * len(sizes),
        devices=jax.devices()[: np.prod(sizes)],
    )


def wander(key, state, shared, *, more=1):
    """A loop as long as the lane's number says; draws, shared numbers, a key that comes out."""

    def body(carry):
        step, place = carry
        place = place * shared["keep"] + jax.random.normal(jax.random.fold_in(key, step), (2,))
        return step + 1, place

    begin = (jnp.int32(0), state["place"])
    step, place = lax.while_loop(lambda carry: carry[0] < state["most"] + more, body, begin)
    return key, {"place": place, "most": step % 3}


def some(number):
    keys = jax.random.split(jax.random.key(1), number)
    state = {
        "place": np.arange(2.0 * number).reshape(number, 2),
        "most": np.arange(number, dtype=np.int32),
    }
    return keys, state, {"keep": 0.5}


AXES = (0, 0, None)


def alone(number, **options):
    return jax.vmap(partial(wander, **options), AXES)(*some(number))


def assert_same(found, expected):
    for x, y in zip(
        jax.tree.leaves(jl.models.on_host(found)),
        jax.tree.leaves(jl.models.on_host(expected)),
        strict=True,
    ):
        x, y = (
            jax.random.key_data(z) if jnp.issubdtype(z.dtype, jax.dtypes.prng_key) else z
            for z in (x, y)
        )
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("sizes", "axis", "number", "spec"),
    [
        ((1,), None, 8, P()),
        ((2,), "lanes", 8, P("lanes")),
        ((4,), None, 8, P("lanes")),
        ((4,), None, 6, P()),
        ((4,), None, 1, P()),
        ((2, 2), "more", 6, P("more")),
        ((2, 2), None, 8, P(("lanes", "more"))),
        ((2, 2), ("more", "lanes"), 4, P(("more", "lanes"))),
    ],
)
def test_lanes_are_those_of_vmap(sizes, axis, number, spec):
    """Bit for bit; whether their number divides or not; and where they lie."""
    mesh = mesh_of(*sizes)
    found = jl.vmap_over_mesh(wander, mesh, axis, in_axes=AXES)(*some(number))
    assert_same(found, alone(number))
    for x in jax.tree.leaves(found):
        assert x.sharding.is_equivalent_to(NamedSharding(mesh, spec), x.ndim)


@pytest.mark.few(4)
@pytest.mark.parametrize("explicit", [False, True])
@pytest.mark.parametrize("around", ["nothing", "jit", "mesh", "both"])
def test_whatever_is_around(explicit, around):
    """Meshes of both types of axes, and what is called under ``jit`` or with a mesh set."""
    mesh = mesh_of(4, explicit=explicit)
    over = jl.vmap_over_mesh(wander, mesh, in_axes=AXES)
    over = jax.jit(over) if around in ("jit", "both") else over
    keys, state, shared = some(8)
    far = jax.device_put(keys, jax.devices()[3]) if around == "nothing" else keys
    if around in ("mesh", "both"):
        with jax.set_mesh(mesh):
            found = over(far, state, shared)
    else:
        found = over(far, state, shared)
    assert_same(found, alone(8))
    if around == "nothing" and explicit:  # what comes out is indexed as any array is
        assert_same(found[1]["place"][3], alone(8)[1]["place"][3])


def test_what_comes_out_goes_in_again():
    mesh = mesh_of(4)
    over = jl.vmap_over_mesh(wander, mesh, in_axes=AXES)
    keys, state, shared = some(8)
    once = over(keys, state, shared)
    twice = over(*once, shared)
    expected = jax.vmap(wander, AXES)(*alone(8), shared)
    assert_same(twice, expected)


def test_nothing_goes_from_device_to_device():
    over = jax.jit(jl.vmap_over_mesh(wander, mesh_of(4), in_axes=AXES))
    text = over.lower(*some(8)).compile().as_text()
    assert "while" in text
    assert not any(word in text for word in ("all-reduce", "all-gather", "all-to-all", "permute"))


def test_one_program_for_a_function():
    keys, state, shared = some(8)
    jl.vmap_over_mesh(wander, mesh_of(2), in_axes=AXES)(keys, state, shared)
    with counted_traces() as traced:
        again = jl.vmap_over_mesh(wander, mesh_of(2), in_axes=AXES)
        found = again(keys, state, {"keep": 0.25})
    assert not traced
    expected = jax.vmap(wander, AXES)(keys, state, {"keep": 0.25})
    assert_same(found, expected)
    assert_same(again(keys, state, shared, more=3), alone(8, more=3))


def test_parts_of_an_argument_have_lanes():
    def line(given, x):
        return given["slope"] * x + given["base"] + given["free"]

    given = {"slope": np.arange(4.0), "base": np.arange(2.0), "free": 0.5}
    axes = ({"slope": 0, "base": None, "free": None}, None)
    found = jl.vmap_over_mesh(line, mesh_of(2), in_axes=axes)(given, np.arange(2.0))
    assert_same(found, jax.vmap(line, axes)(given, np.arange(2.0)))


def test_a_lane_is_differentiated():
    def loss(weight, x):
        over = jl.vmap_over_mesh(lambda x, w: jnp.sin(w * x).sum(), mesh_of(2), in_axes=(0, None))
        return over(x, weight).mean()

    x = np.arange(8.0).reshape(4, 2)
    np.testing.assert_allclose(
        jax.grad(loss)(0.3, x), np.mean(np.sum(x * np.cos(0.3 * x), 1)), rtol=1e-12
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: jl.vmap_over_mesh(wander, "cpu"), "mesh is .*str; give a jax.sharding.Mesh"),
        (
            lambda: jl.vmap_over_mesh(wander, mesh_of(2), "seeds"),
            "axis='seeds'; the mesh has the axes",
        ),
        (lambda: jl.vmap_over_mesh(wander, mesh_of(2), ("lanes", "lanes")), "each once"),
        (
            lambda: jl.vmap_over_mesh(wander, mesh_of(2), in_axes=(0, 0))(*some(4)),
            r"in_axes=\(0, 0\) has 2 entries for 3 arguments",
        ),
        (
            lambda: jl.vmap_over_mesh(wander, mesh_of(2), in_axes=(0, 1, None))(*some(4)),
            "in_axes has an entry 1; lanes lie along the first",
        ),
        (
            lambda: jl.vmap_over_mesh(wander, mesh_of(2), in_axes=AXES)(some(4)[0], *some(5)[1:]),
            r"first axes \[\[4\], \[5\]\]; give one",
        ),
        (lambda: jl.vmap_over_mesh(wander, mesh_of(2))(*some(4)), r"first axes \[\[\], \[4\]\]"),
        (lambda: jl.vmap_over_mesh(jnp.sin, mesh_of(2))(np.zeros((0, 2))), "at least 1"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# --- within a lane --------------------------------------------------------------------------------


def over(number, *rest):
    return NamedSharding(mesh_of(number, *rest), P("lanes"))


@pytest.mark.parametrize("number", [2, 4])
def test_running_sums_are_those_of_all_devices(number):
    counted = np.random.default_rng(0).random((3, 8)) < 0.5

    def sums(sharding):
        one = lanes.shard_function(
            partial(lanes.running_sum, sharding=sharding), sharding, (0, 0), (0, None)
        )
        return jax.jit(jax.vmap(one, (0, None)))(counted, lanes.device_ranks(sharding))

    sharded, last = sums(over(number))
    np.testing.assert_array_equal(sharded, np.cumsum(counted, 1))
    np.testing.assert_array_equal(last, counted.sum(1))
    assert_same((sharded, last), sums(None))


def test_what_is_split_within_lanes_that_are():
    """Seeds along one mesh axis, and each seed's array along the other."""
    mesh = mesh_of(2, 2)
    inner = NamedSharding(mesh, P("more"))

    def one(key, sharding=None):
        # Whole numbers: sums do not depend on the order of compiled additions.
        drawn = jax.random.randint(key, (4, 3), -9, 9).astype(float)
        x = lanes.split_axis(drawn, sharding)
        sums = lanes.shard_function(
            partial(lanes.running_sum, sharding=sharding), sharding, (0, 0), (0, None)
        )
        number, last = sums(x[:, 0] > 0, lanes.device_ranks(sharding))
        return lanes.replicate(x.sum(1), sharding), number, last

    keys = jax.random.split(jax.random.key(0), 6)
    found = jl.vmap_over_mesh(one, mesh, "lanes")(keys, sharding=inner)
    assert_same(found, jax.vmap(one)(keys))
    assert found[0].sharding.spec == P("lanes")


@pytest.mark.parametrize(
    ("sharding", "message"),
    [
        ("cpu", "sharding is .*str; give a jax.sharding.NamedSharding"),
        (lambda: NamedSharding(mesh_of(2), P()), "splits nothing; name a mesh axis"),
        (
            lambda: over(4),
            "sharding splits over 4 devices, but num_envs is 6; choose a multiple, such as 8",
        ),
    ],
)
def test_what_does_not_split_is_named(sharding, message):
    with pytest.raises(ValueError, match=message):
        lanes.require_split("sharding", sharding() if callable(sharding) else sharding, num_envs=6)


def test_no_sharding_changes_nothing():
    tree = {"x": np.arange(3)}
    assert lanes.split_axis(tree, None) is tree and lanes.replicate(tree, None) is tree
    assert lanes.shard_function(wander, None, (), ()) is wander
    lanes.require_split("sharding", None, num_envs=3)
