"""Finite-state controllers by policy gradient: values, derivatives, starts in a batch, and policies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos import finite_state_controllers as fsc
from jaxltl.core.values.partial_observability.long_run import controller_satisfaction
from tests.algos.cases import LearnerCase

FORMULA = "(G F right & G !wrong) | G F wrong"


def coin():
    """A hidden coin: guess heads, guess tails, or look at it."""
    table = np.zeros((6, 3, 6))
    table[0, :, [3, 2, 4]] = table[1, :, [2, 3, 5]] = np.eye(3)
    table[4, :, [3, 2, 0]] = table[5, :, [2, 3, 1]] = np.eye(3)
    table[[2, 3], :, [2, 3]] = 1
    world = jl.from_dense(table, initial=[0.5, 0.5, 0, 0, 0, 0], label={"right": [2], "wrong": [3]})
    return jl.models.make_pomdp(world, [0, 0, 1, 1, 2, 3])


def corridor():
    """Five cells that look alike but for the ends; the goal is in the middle, and moves slip."""
    table = np.zeros((5, 2, 5))
    for s in range(5):
        for a, way in enumerate((-1, 1)):
            table[s, a, int(np.clip(s + way, 0, 4))] += 0.75
            table[s, a, s] += 0.25
    world = jl.from_dense(table, initial=[0.5, 0, 0, 0, 0.5], label={"middle": [2]})
    return jl.models.make_pomdp(world, [0, 1, 1, 1, 2])


@pytest.fixture(scope="module")
def learned():
    problem, hparams = fsc.make_problem(coin(), "right"), fsc.Hparams(learning_rate=0.5)
    train = jax.vmap(lambda key: fsc.train(key, problem, hparams, num_steps=40))
    return problem, hparams, train(jax.random.split(jax.random.key(0), 4))


def test_starts_in_a_batch_learn_to_look(learned):
    problem, hparams, (state, metrics) = learned
    assert (metrics.status == jl.Status.COMPLETED).all()
    assert (metrics.value[:, -1] > 0.8).all() and (metrics.value[:, 0] < 0.8).all()
    best = jax.tree.map(lambda x: x[0], state)
    policy = fsc.policy(best, problem, hparams)
    value = jl.reachability_probability(coin(), "right", policy=policy)
    assert abs(float(value.value) - float(metrics.value[0, -1])) < 0.05
    again = fsc.logits_of(policy, problem, least=1e-6)
    np.testing.assert_allclose(
        again.action[0, 0],
        best.parameters.action[0, 0] - np.log(np.exp(best.parameters.action[0, 0]).sum()),
        atol=1e-3,
    )


def test_a_lane_is_its_own_run(learned):
    problem, hparams, (_, metrics) = learned
    key = jax.random.split(jax.random.key(0), 4)[2]
    _, alone = fsc.train(key, problem, hparams, num_steps=40)
    np.testing.assert_allclose(alone.value[:5], metrics.value[2][:5], rtol=1e-4)


@pytest.mark.parametrize(
    "kind",
    [
        "reach",
        *(
            pytest.param(k, marks=pytest.mark.slow)
            for k in ("reward", "discounted", "formula", "exact")
        ),
    ],
)
def test_values_are_those_of_the_chain_and_derivatives_those_of_differences(kind):
    with jax.enable_x64(True):
        pomdp = corridor()
        cost = np.ones(pomdp.fully_observable.num_rows)
        problem = {
            "reach": lambda: fsc.make_problem(coin(), "right"),
            "formula": lambda: fsc.make_problem(coin(), formula=FORMULA),
            "exact": lambda: fsc.make_problem(coin(), formula=FORMULA, leak=None),
            "reward": lambda: fsc.make_problem(pomdp, "middle", reward=cost, objective="min"),
            "discounted": lambda: fsc.make_problem(
                pomdp, "middle", reward=cost, discount=0.9, objective="min"
            ),
        }[kind]()
        hparams = fsc.Hparams(num_memory=2)
        parameters = fsc.init(jax.random.key(1), problem, hparams).parameters
        evaluate = jax.jit(jax.value_and_grad(fsc.controller_value, argnums=1))
        slope = evaluate(problem, parameters)[1]
        flat, restore = jax.flatten_util.ravel_pytree(parameters)
        way = jax.random.normal(jax.random.key(2), flat.shape)
        up, down = (evaluate(problem, restore(flat + s * 1e-5 * way))[0] for s in (1, -1))
        along = jax.flatten_util.ravel_pytree(slope)[0] @ way
        assert abs(float(along) - float(up - down) / 2e-5) < 1e-6 * max(1, abs(float(along)))
        # A controller whose memory updates are certain is a policy.
        sharp = parameters._replace(
            update=jnp.round(parameters.update) * 1000 + jnp.eye(2)[0] * 100
        )
        policy = fsc.policy(
            fsc.start_at(jax.random.key(0), sharp, problem, hparams), problem, hparams
        )
        value = float(evaluate(problem, sharp)[0])
        if kind == "formula":
            low, high = controller_satisfaction(coin(), policy, FORMULA)
            assert low - 0.1 < value < high  # the smooth objective is below
            return
        if kind == "exact":
            low, high = controller_satisfaction(coin(), policy, FORMULA)
            assert low - 1e-6 < value < high + 1e-6
            return
        if kind == "reach":
            known = jl.reachability_probability(coin(), "right", policy=policy)
        elif kind == "reward":
            known = jl.total_reward(pomdp, cost, "middle", policy=policy)
        else:
            chain = jl.values.controlled_chain(pomdp, policy)
            paid = 1.0 - np.asarray(chain.label[:, 0])
            known = jl.policy_value(chain, np.zeros(chain.num_states, int), paid, 0.9).at_initial
            # The target is left again in the chain: only a bound.
            assert value <= float(known.value) + 1e-9
            return
        assert abs(float(known.value) - value) < 1e-6 * max(1, value)


@pytest.mark.slow
def test_controllers_learn_formulas_without_rare_actions():
    problem = fsc.make_problem(coin(), formula="G F right & G !wrong")
    hparams = fsc.Hparams(learning_rate=0.5)
    train = jax.jit(jax.vmap(lambda key: fsc.train(key, problem, hparams, num_steps=60)))
    state, metrics = train(jax.random.split(jax.random.key(0), 4))
    best = jax.tree.map(lambda x: x[int(metrics.value[:, -1].argmax())], state)
    rare = fsc.policy(best, problem, hparams)
    learned = jl.values.without_rare_actions(rare, 0.1)
    low, high = controller_satisfaction(coin(), learned, "G F right & G !wrong")
    assert low == high == 1
    assert ((rare.action > 0).sum(-1) >= (learned.action > 0).sum(-1)).all()


def test_wrong_problems():
    pomdp = coin()
    reward = np.ones(pomdp.fully_observable.num_rows)
    for options in ({}, {"reward": reward}, {"target": "right", "discount": 0.9}):
        with pytest.raises(ValueError, match="make_problem"):
            fsc.make_problem(pomdp, **options)
    with pytest.raises(ValueError, match="formula is given"):
        fsc.make_problem(pomdp, "right", formula="F right")
    with pytest.raises(ValueError, match="leak=0"):
        fsc.make_problem(pomdp, formula="G F right", leak=0)
    with pytest.raises(ValueError, match="cannot reach"):
        fsc.make_problem(pomdp, "right", reward=reward)


# --- the laws of all learners ------------------------------------------------------------------


def controllers():
    problem = fsc.make_problem(coin(), "right")
    return LearnerCase(
        fsc, problem, fsc.Hparams(learning_rate=0.5), fsc.Hparams(learning_rate=0.25)
    )


CASES = {
    "controllers": controllers,
}
