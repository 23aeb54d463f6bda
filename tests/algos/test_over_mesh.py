"""What every learner keeps over the devices of a mesh: lanes are those of one device.

As a program, ``-m tests.algos.test_over_mesh NAMES COORDINATOR PROCESS PROCESSES``: the same where
several processes have two of the devices each.
"""

import sys
from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import numpy as np
import pytest
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jax.tree_util import Partial

import jaxltl as jl
from jaxltl.algos import ppo
from tests.algos.test_learner import CASES, assert_bitwise, case, leaves, reaches
from tests.algos.test_ppo import (
    corridor_allowed,
    corridor_observe,
    corridor_reset,
    corridor_step,
    proximal,
)
from tests.support import stack

LANES = 8
# Products of matrices, and systems, are summed in another order for another number of lanes, as
# they are under ``vmap``; all else is lane by lane, bit for bit.
ROUNDED = {"mlirl-product", "trpo", "cpo", "ppo", "ppo-memory", "cloning"}
QUICK = ("toy", "q-maximin")


def assert_near(one, other, tolerance=1e-8):
    """As near as lanes of a batch and the same alone are held to be."""
    for x, y in zip(leaves(one), leaves(other), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


def assert_as_on_one(name, found, expected):
    if name in ROUNDED:
        assert_near(found, expected)
    else:
        assert_bitwise(found, expected)


def mesh_of(*sizes):
    return jax.make_mesh(
        sizes,
        ("lanes", "environments")[: len(sizes)],
        devices=jax.devices()[: np.prod(sizes)],
        axis_types=(AxisType.Auto,) * len(sizes),
    )


@cache
def given(name: str):
    """Keys and settings of eight lanes, of two kinds."""
    _, problem, hparams, other, _ = case(name)
    return (
        jax.random.split(jax.random.key(0), LANES),
        problem,
        stack([hparams, other] * (LANES // 2)),
    )


def four_steps(name: str, mesh: Mesh | None) -> Any:
    """Of all lanes, stopped after two and gone on with; a mesh's, or those of ``vmap``."""
    module = case(name).module
    keys, problem, hparams = given(name)
    axes = (0, None, 0)
    if mesh is None:
        init = jax.jit(jax.vmap(module.init, axes))
        run: Any = jax.jit(jax.vmap(partial(module.run, num_steps=2, max_rows=2), axes))
    else:
        init = jl.vmap_over_mesh(module.init, mesh, in_axes=axes)
        run = partial(jl.vmap_over_mesh(module.run, mesh, in_axes=axes), num_steps=2, max_rows=2)
    state, first = run(init(keys, problem, hparams), problem, hparams)
    state, second = run(state, problem, hparams)
    return state, first, second


@cache
def on_one(name: str) -> Any:
    return jl.models.on_host(four_steps(name, None))


def cases():
    for name in CASES:
        for number in (1, 2, 4):
            quick = name in QUICK and number == 2
            yield pytest.param(name, number, marks=() if quick else pytest.mark.exhaustive)


@pytest.mark.few(1)
@pytest.mark.parametrize(("name", "number"), list(cases()))
def test_eight_lanes_on_several_devices_are_those_on_one(name, number):
    mesh = mesh_of(number)
    found = four_steps(name, mesh)
    own = NamedSharding(mesh, PartitionSpec("lanes"))
    assert all(x.sharding.is_equivalent_to(own, x.ndim) for x in jax.tree.leaves(found))
    found = jl.models.on_host(found)
    if number == 1:
        assert_bitwise(found, on_one(name))
    else:
        assert_as_on_one(name, found, on_one(name))


def test_lanes_end_each_for_itself_on_each_device():
    module, problem, *_ = case("toy")
    most = np.array([3, 50, 7, 1, 2, 30, 9])

    def until(key, rate, most):
        return module.train_until(key, problem, rate, until=Partial(reaches, most), num_steps=20)

    keys, rates = jax.random.split(jax.random.key(1), 7), np.linspace(0.1, 0.4, 7)
    found = jl.vmap_over_mesh(until, mesh_of(2))(keys, rates, most)
    assert found.num_steps.tolist() == [4, 20, 8, 2, 3, 20, 10]
    assert_bitwise(jl.models.on_host(found), jl.models.on_host(jax.vmap(until)(keys, rates, most)))


# --- environments of one seed ---------------------------------------------------------------------


def plain():
    """The smallest of PPO's problems, of which a step takes little to compile."""
    width = np.array(3.0)
    world = jl.make_environment(
        *(Partial(f, width) for f in (corridor_reset, corridor_step, corridor_observe)),
        actions=3,
        allowed=Partial(corridor_allowed, width),
    )
    problem = ppo.make_problem(world, network=ppo.ActorCritic(3, hidden=()))
    return problem, ppo.Hparams(
        discount=0.9, num_envs=4, num_steps=3, num_epochs=1, num_minibatches=1, learning_rate=0.01
    )


def normalized():
    found = proximal(normalize_observation=True, normalize_reward=True)
    return found.problem, replace(found.hparams, num_envs=8)


def with_memory():
    found = proximal("tanh", num_resets=3)
    return found.problem, replace(found.hparams, num_envs=8)


def stopping():
    found = proximal(num_resets=5, target_kl=0.01, value_clip=0.2)
    return found.problem, replace(found.hparams, num_envs=8)


SPLIT = {"plain": plain, "normalized": normalized, "memory": with_memory, "stopping": stopping}


def over(mesh):
    return NamedSharding(mesh, PartitionSpec("environments"))


def split_cases():
    for name in SPLIT:
        for number in (2, 4):
            quick = (name, number) == ("plain", 2)
            yield pytest.param(name, number, marks=() if quick else pytest.mark.exhaustive)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "number"), list(split_cases()))
def test_environments_over_devices_are_the_environments(name, number):
    problem, hparams = SPLIT[name]()
    mesh = jax.make_mesh((number,), ("environments",), devices=jax.devices()[:number])
    run = partial(ppo.train, jax.random.key(0), problem, num_steps=6, max_rows=3)
    found = run(replace(hparams, sharding=over(mesh)))
    assert_near(jl.models.on_host(found), run(hparams), 1e-10)
    state = found[0]
    lie = [x.sharding.spec for x in jax.tree.leaves(state.walkers)]
    assert set(lie) == {PartitionSpec("environments")}
    assert all(x.sharding.is_fully_replicated for x in jax.tree.leaves(state.parameters))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sharding": "cpu"}, "sharding is .*str; give a jax.sharding.NamedSharding"),
        (
            {"num_envs": 3},
            "sharding splits over 2 devices, but num_envs is 3; choose a multiple, such as 4",
        ),
        ({"num_minibatches": 4}, "but the number of rows of a minibatch is 3"),
    ],
)
def test_what_cannot_be_split_is_named(change, message):
    problem, hparams = plain()
    hparams = replace(hparams, **{"sharding": over(mesh_of(1, 2)), **change})
    with pytest.raises(ValueError, match=message):
        ppo.init(jax.random.key(0), problem, hparams)


# --- several processes ----------------------------------------------------------------------------


def main(names: str, coordinator: str, process: int, processes: int) -> None:
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", 2)
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(
        coordinator_address=coordinator, num_processes=processes, process_id=process
    )
    assert len(jax.devices()) == 2 * processes
    for name in (asked := names.split(",")):
        if name == "environments":
            problem, hparams = plain()
            mesh = jax.make_mesh((4,), ("environments",))
            run = partial(ppo.train, jax.random.key(0), problem, num_steps=3)
            found = run(replace(hparams, sharding=over(mesh)))
            assert_near(jl.models.on_host(found), run(hparams), 1e-10)
        elif name == "episodes":
            problem, _ = plain()
            agent = jl.environments.make_agent(lambda seen, key: jax.random.randint(key, (), 0, 2))
            run = partial(
                jl.evaluate,
                jax.random.key(0),
                agent,
                problem.environment,
                num_episodes=30,
                num_steps=9,
            )
            assert run(sharding=over(jax.make_mesh((4,), ("environments",)))) == run()
        else:
            found = jl.models.on_host(four_steps(name, mesh_of(4)))
            assert_as_on_one(name, found, on_one(name))
    print(f"as on one: {len(asked)}", flush=True)
    jax.distributed.shutdown()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]))
