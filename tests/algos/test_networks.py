"""Networks that a function of a key makes: modules of flax.nnx, and callable pytrees."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from jax.tree_util import Partial

import jaxltl as jl
from jaxltl.algos import behavioral_cloning, grounding, many_tasks, ppo, todirl, training
from jaxltl.algos.common.networks import as_network
from jaxltl.core import struct
from tests.algos.cases import world
from tests.algos.test_ppo import WALK

KEY = jax.random.key(0)
SEEN = jnp.linspace(-1, 1, 5)


class Net(nnx.Module):
    """A hidden layer, and for PPO the actor and the critic on it."""

    def __init__(self, rngs):
        self.hidden = nnx.Linear(5, 3, rngs=rngs)
        self.heads = nnx.List([nnx.Linear(3, width, rngs=rngs) for width in (2, 1)])

    def __call__(self, x):
        x = nnx.tanh(self.hidden(x))
        return self.heads[0](x), self.heads[1](x)[0]


def nnx_network(key):
    return Net(nnx.Rngs(key))


def plain(parameters, x):
    """The same function of the same numbers."""
    x = jnp.tanh(x @ parameters["hidden"][0] + parameters["hidden"][1])
    actor, critic = (x @ w + b for w, b in parameters["heads"])
    return actor, critic[0]


def plain_network(key):
    net = nnx_network(key)
    layers = [(x.kernel[...], x.bias[...]) for x in (net.hidden, *net.heads)]
    return Partial(plain, {"hidden": layers[0], "heads": layers[1:]})


@struct.dataclass
class Recurrent:
    """A callable pytree with memory, a static field, and one that is no array."""

    weight: jax.Array
    activation: object
    width: int = struct.field(pytree_node=False)

    def initial_memory(self):
        return jnp.zeros(self.width)

    def __call__(self, memory, x):
        memory = self.activation(memory + x @ self.weight)
        return memory, (memory[:2], memory.sum())


def recurrent_network(key):
    return Recurrent(jax.random.normal(key, (5, 4)), jnp.tanh, 4)


def test_a_module_of_nnx_and_a_pytree_are_what_they_compute():
    network = as_network(nnx_network)
    variables = network.init(KEY, SEEN)
    assert sorted(variables["params"]) == [
        f"{layer}/{x}" for layer in ("heads/0", "heads/1", "hidden") for x in ("bias", "kernel")
    ]
    expected = nnx_network(KEY)(SEEN)
    for made in (network, as_network(plain_network)):
        output, drawn = made.init_with_output(KEY, SEEN)
        assert all(map(np.array_equal, output, expected))
        other = made.init(jax.random.key(1), SEEN)["params"]
        pairs = zip(jax.tree.leaves(other), jax.tree.leaves(drawn["params"]), strict=True)
        assert not all(np.array_equal(x, y) for x, y in pairs)

        def total(parameters, x, made=made):
            return made.apply({"params": parameters}, x)[1]

        slope = jax.jit(jax.vmap(jax.grad(total), (None, 0)))(drawn["params"], jnp.ones((2, 5)))
        assert sum(x.any() for x in slope.values()) == 4  # all but the actor's
    with pytest.raises(ValueError, match="the parameters are not those of this network"):
        network.apply(as_network(plain_network).init(KEY), SEEN)


def test_a_network_with_memory_is_read_as_a_learner_does():
    problem = ppo.make_problem(WALK, network=recurrent_network)
    assert problem.memory.shape == (4,)
    assert ppo.make_problem(WALK, network=recurrent_network, memory=np.ones(4)).memory[0] == 1
    hparams = ppo.Hparams(discount=0.9, num_envs=4, num_steps=2)
    state = jax.eval_shape(lambda key: ppo.init(key, problem, hparams), KEY)
    assert state.parameters["weight"].shape == (5, 4)
    after, _ = jax.eval_shape(lambda state: ppo.step(state, problem, hparams), state)
    assert after.parameters["weight"].shape == (5, 4)


def test_a_policy_with_such_a_network_is_saved_and_deployed(tmp_path):
    problem = ppo.make_problem(WALK, network=nnx_network)
    hparams = ppo.Hparams(discount=0.9, num_envs=1, num_steps=4)
    state = ppo.init(KEY, problem, hparams)
    agent = ppo.greedy(state, problem, hparams)
    jl.io.save_network(tmp_path / "policy.npz", agent, WALK)
    robot = jl.io.load_policy(tmp_path / "policy.npz").controller()
    seen = WALK.observe(WALK.reset(KEY))
    robot.start(seen)
    output = many_tasks.trained(nnx_network, state.parameters)(seen)
    assert robot.act() == int(jnp.argmax(output[0]))
    labels = jax.tree_util.Partial(lambda world: jnp.zeros(1, bool))
    task = jl.task_environment(WALK, "F goal", labels=labels, propositions=["goal"])
    with pytest.raises(ValueError, match=r"automaton=jl.to_automaton\(formula\)"):
        jl.io.save_network(tmp_path / "policy.npz", agent, task)


def scores(parameters, *read):
    """One number for each action of all combinations of what is read."""
    return sum(x @ jnp.ones((x.shape[-1], 1)) for x in read) @ parameters


def test_other_learners_take_them_too():
    mdp, shown = world()
    model = jl.product(mdp, "!r U g")
    cases = [
        (behavioral_cloning, model, (), {"held_out": None}, 2),
        (todirl, model, (), {"held_out": None}, None),
        (grounding, mdp, ("!r U g",), {}, 2),
    ]
    for module, first, more, options, width in cases:

        def make(key, width=width):
            shape = (1, width) if width else (1,)
            return Partial(scores, jax.random.normal(key, shape))

        problem = module.make_problem(first, np.eye(3), shown, *more, network=make, **options)
        hparams = module.Hparams(**({"discount": 0.9} if module is todirl else {}))

        def two_steps(key, module=module, problem=problem, hparams=hparams):
            state = module.init(key, problem, hparams)
            return module.step(state, problem, hparams)[0].parameters

        drawn = jax.tree.leaves(jax.eval_shape(two_steps, KEY))
        assert any(x.shape == ((1, width) if width else (1,)) for x in drawn)


@pytest.mark.slow
def test_ppo_learns_the_same_with_the_same_network_of_either_kind(tmp_path):
    hparams = ppo.Hparams(discount=0.9, num_envs=4, num_steps=8, learning_rate=1e-2)
    states = []
    for make in (nnx_network, plain_network):
        problem = ppo.make_problem(WALK, network=make)
        run = {"num_steps": 6, "every": 2, "checkpoint": tmp_path / f"{make.__name__}.npz"}
        stop = lambda state, metrics: next(iter(()))  # noqa: E731 (StopIteration)
        training.train(ppo, KEY, problem, hparams, callback=stop, **run)
        state, metrics = training.train(ppo, KEY, problem, hparams, **run)
        whole, rows = ppo.train(KEY, problem, hparams, num_steps=6)
        for x, y in zip(jax.tree.leaves(metrics), jax.tree.leaves(rows), strict=True):
            np.testing.assert_array_equal(x, y)
        assert state.step == 6
        states.append(sorted(jax.tree.leaves(whole.parameters), key=lambda x: x.shape))
    for one, other in zip(*states, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


def test_a_deployed_network_obeys_the_mask_or_asks_for_it(tmp_path):
    path = tmp_path / "policy.npz"
    agent = jl.environments.make_agent(lambda seen, key: 0)
    world = jl.environments.model_environment(jl.gridworld("a .", initial="a"))
    jl.io.save_network(path, agent, world)  # all actions are available
    robot = jl.io.load_policy(path).controller()
    robot.start(world.observe(world.reset(KEY)))
    assert robot.act() == 0
    with pytest.raises(ValueError, match="allowed is given"):
        robot.act(allowed=np.array([False, True, True, True]))
    masked = dataclasses.replace(world, allowed=Partial(lambda world: jnp.arange(4) > 1))
    jl.io.save_network(path, agent, masked)
    policy = jl.io.load_policy(path)
    robot = policy.controller()
    robot.start(world.observe(world.reset(KEY)))
    assert policy.reads_mask and robot.act(allowed=np.array([False, True, True, True])) == 1
    with pytest.raises(ValueError, match=r"allowed is None.*bool\[4\]"):
        robot.act()
    # A function of a table without a False may restrict actions all the same.
    flags = Partial(lambda flags, world: flags & (jnp.arange(4) > 1), jnp.ones(4, bool))
    jl.io.save_network(path, agent, dataclasses.replace(world, allowed=flags))
    assert jl.io.load_policy(path).reads_mask
    table = jl.FiniteMemoryPolicy(np.array([[0]]), np.array([0]), np.array([[0]])).controller()
    table.start(0)
    with pytest.raises(ValueError, match="the policy is a table"):
        table.act(allowed=np.array([True]))


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (3, "network is 3; give a module of flax.linen"),
        (Net, "network is .*Net'>; give a module"),
        (lambda: 3, "network cannot be called with a key"),
        (lambda key: 3, "returns int, which is not callable"),
        (lambda key: nnx.BatchNorm(3, rngs=nnx.Rngs(key)), r"keeps \['BatchStat'\] besides"),
        (lambda key: Partial(plain, jnp.arange(3)), "keeps 0/0, int.* besides its parameters"),
        (lambda key: Partial(plain), "without parameters"),
        (Partial(plain, jnp.ones(3)), "unhashable|cannot be called with a key"),
    ],
)
def test_what_is_no_network_is_refused(network, message):
    with pytest.raises(ValueError, match=message):
        as_network(network)


def test_an_instance_of_nnx_is_refused_with_the_function_to_give():
    with pytest.raises(ValueError, match=r"lambda key: Net\(rngs=nnx.Rngs\(key\)\)"):
        ppo.make_problem(WALK, network=nnx_network(KEY))
