"""One trajectory after another, by an adapter and by the package's own functions."""

import warnings

import jax
import numpy as np
import pytest
from jax import lax

from jaxltl.core.environments.environment import allowed_in
from jaxltl.core.environments.episodes import auto_reset_step
from tests.support import random_action


def load(name):
    """A module of a package, or the test is skipped; what its import warns of is its own."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pytest.importorskip(name)


@pytest.fixture(scope="module", autouse=True)
def single_precision():
    """The packages are written for it, also what they compute when they are imported."""
    with jax.enable_x64(False):
        yield


def keys_of(key, num_steps):
    first, rest = jax.random.split(key)
    return first, jax.random.split(rest, num_steps)


def walk(env, key, num_steps):
    """Before each step what is seen, then what it leads to, with what is seen at an end."""

    def go(world, key):
        choose, step = jax.random.split(key)
        action = random_action(choose, env.actions, allowed_in(env, world))
        after, found = auto_reset_step(step, env, world, action)
        return after, (
            env.observe(world),
            action,
            found.reward,
            found.terminated,
            found.truncated,
            env.observe(found.world),
        )

    first, rest = keys_of(key, num_steps)
    return lax.scan(go, env.reset(first), rest)[1]


def own_walk(reset, step, key, actions):
    """The same with ``reset(key) -> (state, seen)`` of a package, and with its
    ``step(state, action, key) -> (state, seen, reward, terminated, truncated)``.
    """

    def go(carry, given):
        (state, seen), (key, action) = carry, given
        at, fresh = jax.random.split(jax.random.split(key)[1])
        state, last, reward, terminated, truncated = step(state, action, at)
        carry = lax.cond(terminated | truncated, lambda: reset(fresh), lambda: (state, last))
        return carry, (seen, action, reward, terminated, truncated, last)

    first, rest = keys_of(key, len(actions))
    return lax.scan(go, reset(first), (rest, actions))[1]


def same_as_own(env, reset, step, num_walks=4, num_steps=250):
    """Compares 1,000 steps in one vmapped program with the package's own, walk by walk.

    Returns:
      What the adapter's walks hold, with the two leading axes as one.
    """
    keys = jax.random.split(jax.random.key(7), num_walks)
    found = jax.jit(jax.vmap(lambda key: walk(env, key, num_steps)))(keys)
    own = jax.jit(lambda key, actions: own_walk(reset, step, key, actions))
    for row, key in enumerate(keys):
        mine = jax.tree.map(lambda x, row=row: x[row], found)
        theirs = own(key, mine[1])
        for x, y in zip(jax.tree.leaves(mine), jax.tree.leaves(theirs), strict=True):
            assert x.shape == y.shape
            if np.asarray(y).dtype.kind == "f":  # two programs may round differently
                np.testing.assert_allclose(x, y, rtol=2e-5, atol=2e-6)
            else:
                np.testing.assert_array_equal(x, y)
    return jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), found)


def both_ends(found):
    """How many episodes were terminated, and how many cut off alone; neither may be none."""
    terminated, truncated = found[3], found[4]
    counts = terminated.sum(), (truncated & ~terminated).sum()
    assert min(counts) > 0, counts
    return counts
