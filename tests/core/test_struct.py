"""Pytrees of distinct classes are distinct, whatever their fields; jitted functions see which is given."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl
from jaxltl.core import struct


@struct.dataclass
class Celsius:
    degrees: jax.Array
    name: str = struct.field(pytree_node=False, default="")


@struct.dataclass
class Kelvin:
    degrees: jax.Array
    name: str = struct.field(pytree_node=False, default="")


def test_structures_of_equal_fields_differ_by_class():
    assert jax.tree.structure(Celsius(1.0)) != jax.tree.structure(Kelvin(1.0))
    assert jax.tree.structure(Celsius(1.0)) == jax.tree.structure(Celsius(2.0))
    assert jax.tree.structure(Celsius(1.0, "a")) != jax.tree.structure(Celsius(1.0, "b"))


def test_jitted_functions_never_run_the_program_of_another_class():
    @jax.jit
    def kelvin(x):
        return x.degrees + (273.15 if isinstance(x, Celsius) else 0)

    for n in range(1, 12):
        zeros = jnp.zeros(n)
        np.testing.assert_allclose(kelvin(Celsius(zeros)), 273.15, rtol=1e-6)
        np.testing.assert_array_equal(kelvin(Kelvin(zeros)), 0)


def test_dataclasses_go_through_trees():
    x = Celsius(jnp.arange(3.0), "oven")
    twice = jax.tree.map(lambda leaf: 2 * leaf, x)
    assert (twice.name, twice.degrees.tolist()) == ("oven", [0, 2, 4])
    ((path, _),), _ = jax.tree_util.tree_flatten_with_path(x)
    assert jax.tree_util.keystr(path) == ".degrees"
    assert x.replace(name="kettle").name == "kettle"
    with pytest.raises(AttributeError):
        x.name = "kettle"
    assert jax.vmap(lambda c: c.degrees + 1)(x).tolist() == [1, 2, 3]


def test_every_pytree_of_the_package_is_registered_by_type():
    pattern = re.compile(r"^(from flax import .*\bstruct\b|.*\bregister_dataclass\()", re.MULTILINE)
    package = Path(jaxltl.__file__).parent
    found = [p for p in package.rglob("*.py") if pattern.search(p.read_text())]
    assert not found
