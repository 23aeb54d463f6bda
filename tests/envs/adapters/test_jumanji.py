"""Jumanji's environments, against jumanji."""

import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.app.environment_setup import load_environment
from jaxltl.core.environments.environment import Finite
from jaxltl.envs import from_jumanji
from tests.envs.adapters.harness import (  # noqa: F401
    both_ends,
    load,
    same_as_own,
    single_precision,
)


@pytest.fixture(scope="module")
def jumanji():
    return load("jumanji")


def at_target(state):
    return (state.agent_position == state.target_position)[None]


def test_a_thousand_steps_are_jumanjis_own(jumanji):
    """But that its limit of steps is a truncation, which it calls a termination."""
    generator = load("jumanji.environments.routing.maze.generator").RandomGenerator(4, 4)
    own = jumanji.environments.Maze(generator, time_limit=9)
    env = from_jumanji(own, labels=at_target, propositions=["target"])
    assert env.actions == Finite(4) and env.horizon == 9

    def reset(key):
        state, start = own.reset(key)
        return state, start.observation

    def step(state, action, key):
        after, found = own.step(state, action)
        reached = at_target(after)[0]
        cut = found.last() & ~reached
        return after, found.observation, found.reward, found.last() & reached, cut

    found = same_as_own(env, reset, step)
    both_ends(found)
    seen, action, reward, terminated, truncated, last = found
    assert seen.action_mask[np.arange(1000), action].all()
    assert (last.step_count[truncated] == 9).all() and (reward[terminated] == 1).all()


@pytest.mark.parametrize(("name", "apart"), [("Minesweeper-v0", False), ("Cleaner-v0", True)])
def test_actions_of_several_parts_are_numbered(jumanji, name, apart):
    own = jumanji.make(name)
    env = from_jumanji(own)
    world = jax.jit(env.reset)(jax.random.key(0))
    mask = np.asarray(world.observation.action_mask)
    counts = own.action_spec.num_values.tolist()
    actions = list(itertools.product(*map(range, counts)))
    allowed = [all(mask[i, a] for i, a in enumerate(x)) if apart else mask[x] for x in actions]
    assert env.actions == Finite(len(actions))
    assert env.allowed(world).tolist() == allowed
    number = np.flatnonzero(allowed)[-1]
    found = jax.jit(env.step)(world, jnp.int32(number), jax.random.key(1))
    _, theirs = jax.jit(own.step)(world.state, jnp.array(actions[number]))
    for x, y in zip(
        jax.tree.leaves(found.world.observation), jax.tree.leaves(theirs.observation), strict=True
    ):
        np.testing.assert_array_equal(x, y)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Minesweeper-v0", "JobShop-v0", "MultiCVRP-v0"])
def test_parts_in_turn_are_one_step(jumanji, name):
    """A mask of all combinations, of ten parts each for itself, and whole numbers in bounds."""
    own = jumanji.make(name)
    if own.reward_spec.shape:
        own = load("jumanji.wrappers").MultiToSingleWrapper(own)
    env = from_jumanji(own, in_turn=True)
    reset, step, theirs = jax.jit(env.reset), jax.jit(env.step), jax.jit(own.step)
    allowed, observe = jax.jit(env.allowed), jax.jit(env.observe)
    now, rng, parts = reset(jax.random.key(0)), np.random.default_rng(0), own.action_spec.shape[0]
    assert env.horizon is None or env.horizon == parts * own.time_limit
    for _ in range(3):
        before, mask = now.world, np.asarray(now.world.observation.action_mask)
        chosen = []
        for part in range(parts):
            seen, may = observe(now), np.asarray(allowed(now))
            assert seen.turn.argmax() == part and seen.parts.sum() == part
            left = (
                mask[part]
                if len(mask) == parts and name != "Minesweeper-v0"
                else (mask[tuple(chosen)] if part else mask.any(1))
            )
            np.testing.assert_array_equal(np.flatnonzero(may), np.flatnonzero(left))
            chosen.append(int(rng.choice(np.flatnonzero(may))))
            found = step(now, jnp.int32(chosen[-1]), jax.random.key(1))
            now = found.world
            if part < parts - 1:
                assert found.reward == 0 and not found.terminated and not found.truncated
        _, told = theirs(before.state, jnp.array(chosen, own.action_spec.dtype))
        np.testing.assert_allclose(found.reward, told.reward, rtol=1e-6)
        assert (found.terminated | found.truncated) == told.last() and now.turn == 0
        for x, y in zip(
            jax.tree.leaves(now.world.observation), jax.tree.leaves(told.observation), strict=True
        ):
            np.testing.assert_allclose(x, y, rtol=1e-6)
        if told.last():
            now = reset(jax.random.key(2))


def test_a_task_file_chooses_parts_in_turn(jumanji, tmp_path):
    task = SimpleNamespace(
        path=tmp_path / "task.toml",
        world={"environment": "jumanji:JobShop-v0", "arguments": {"in_turn": True}},
    )
    assert load_environment(task).actions == Finite(21)
    del task.world["arguments"]
    with pytest.raises(ValueError, match=r"'jumanji:JobShop-v0': from_jumanji: parts of .*in_turn"):
        load_environment(task)


def test_what_is_not_jumanjis_is_named(jumanji):
    wrappers = load("jumanji.wrappers")
    snake = jumanji.make("Snake-v1")
    for wrapper in (wrappers.AutoResetWrapper, wrappers.VmapWrapper, wrappers.VmapAutoResetWrapper):
        with pytest.raises(ValueError, match=f"wrapped in {wrapper.__name__}; give what is in it"):
            from_jumanji(wrapper(snake))
    with pytest.raises(ValueError, match=r"from_jumanji: env is a .*no environment of jumanji"):
        from_jumanji(jnp)
    with pytest.raises(ValueError, match=r"make 16679880978201 actions; at most .*in_turn=True"):
        from_jumanji(jumanji.make("JobShop-v0"))
    with pytest.raises(ValueError, match="an action of Snake has no parts"):
        from_jumanji(snake, in_turn=True)
    with pytest.raises(ValueError, match=r"one for each agent; wrap it in .*MultiToSingleWrapper"):
        from_jumanji(jumanji.make("Connector-v3"))
