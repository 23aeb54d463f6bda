"""Task-oriented deep inverse RL: gradients, early stopping, transfer, and bad input."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from flax import linen as nn
from jax.flatten_util import ravel_pytree

import jaxltl as jl
from jaxltl.algos import todirl
from jaxltl.algos.todirl import learner
from jaxltl.core.models.ops.operators import expectation, pushforward
from jaxltl.core.models.ops.successor_tables import predecessor_table, successor_table
from tests import reference
from tests.algos.cases import LearnerCase, world
from tests.algos.test_guaranteed import evaluate as probability
from tests.support import random_representation, stack

TASK = jl.to_automaton(jl.parse_ltl("!r U (c & (!r U g))"), letters=[set(), {"c"}, {"g"}, {"r"}])
NUM_MEMORY = TASK.delta.shape[0]
UP, DOWN, LEFT, RIGHT = range(4)
# Compiling is what costs here, so what is run a few times is hardly optimised.
quick = partial(
    jax.jit,
    compiler_options={
        "xla_backend_optimization_level": 0,
        "xla_llvm_disable_expensive_passes": True,
    },
)
slope = quick(jax.value_and_grad(todirl.objective, has_aux=True))
plan = quick(todirl.plan, static_argnums=0)
MAPS = ("b c r\n. . g", "g . .\nr c b")
RUNS = (
    [[(0, RIGHT), (1, DOWN), (4, RIGHT)], [(0, DOWN), (3, RIGHT), (4, UP), (1, DOWN), (4, RIGHT)]],
    [[(5, LEFT), (4, UP), (1, LEFT)], [(2, LEFT), (1, DOWN), (4, UP), (1, LEFT)]],
)


@cache
def lazy(i=0, slip=0.2, label_on="exit"):
    return jl.product(jl.gridworld(MAPS[i], slip=slip), TASK, label_on=label_on)


def seen(model):
    """One-hot labels of the cell and of what is below and to the right."""
    kind = np.eye(4)[np.asarray(model.letter)].reshape(2, 3, 4)
    wide = np.pad(kind, ((0, 1), (0, 1), (0, 0)))
    return np.concatenate([kind, wide[1:, :-1], wide[:-1, 1:]], -1).reshape(6, 12)


def demonstrated(i=0, slip=0.2):
    return jl.make_trajectories(lazy(i, slip).mdp, RUNS[i])


def small(worlds=(0,), *, network=None, label_on="exit", slip=0.2, **options):
    network = todirl.RewardNetwork((3, 3)) if network is None else network
    models = [lazy(i, slip, label_on) for i in worlds]
    return todirl.make_problem(
        models,
        [seen(m) for m in models],
        [demonstrated(i, slip) for i in worlds],
        network=network,
        **{"held_out": None, **options},
    )


def evaluate(*arguments):
    """The objective's parts."""
    return slope(*arguments)[0][1]


def gradient(*arguments):
    return slope(*arguments)[1]


def parameters(problem, seed=0):
    """Random in every entry, so that no ReLU sits at its kink."""
    start = todirl.init(jax.random.key(seed), problem, todirl.Hparams(discount=0.5)).parameters
    flat, unravel = ravel_pytree(start)
    return unravel(jnp.asarray(np.random.default_rng(seed).normal(size=flat.shape)))


# --- the gradient ------------------------------------------------------------------------------


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "setting",
    [
        pytest.param({}, id="exit"),
        pytest.param(
            {"worlds": (0, 1), "weight": [1.0, 0.5]}, id="two-worlds", marks=pytest.mark.exhaustive
        ),
        pytest.param({"slip": 0.0, "label_on": "entry"}, id="entry", marks=pytest.mark.exhaustive),
        pytest.param({"horizon": 6}, id="horizon"),
        pytest.param({"mu": 3.0, "slip": 0.3}, id="mu"),
        pytest.param(
            {"mu": 3.0, "worlds": (0, 1), "weight": [1.0, 0.5], "label_on": "entry"},
            id="mu-two-worlds",
            marks=pytest.mark.exhaustive,
        ),
    ],
)
def test_the_gradient_is_that_of_central_differences(setting):
    mu = setting.get("mu")
    problem = small(**{k: v for k, v in setting.items() if k != "mu"})
    hparams = todirl.Hparams(
        discount=0.9, l2=0.1, tolerance=1e-12, horizon=setting.get("horizon"), mu=mu
    )
    flat, unravel = ravel_pytree(parameters(problem))

    def losses(rows):
        return np.array([slope(unravel(x), problem, hparams)[0][0] for x in rows])

    found, _ = ravel_pytree(gradient(unravel(flat), problem, hparams))
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(4, flat.size)) / np.sqrt(flat.size)
    steps = np.array([-2e-4, -1e-4, 1e-4, 2e-4])[:, None, None]
    low2, low, high, high2 = losses((flat + steps * directions).reshape(-1, flat.size)).reshape(
        4, -1
    )
    central = (low2 - 8 * low + 8 * high - high2) / (12 * 1e-4)  # of fourth order
    np.testing.assert_allclose(directions @ found, central, rtol=1e-8, atol=1e-8)


def check_weighed(worlds, weight):
    """Less mu times the probability of the task of the policy: the loss, what is told, the score."""
    problem = small(worlds, slip=0.3, weight=weight, held_out=0.5)
    start = parameters(problem)
    plain = todirl.Hparams(discount=0.9, tolerance=1e-12)
    weighed = plain.replace(mu=2.5)
    (loss, parts), (less, found) = (slope(start, problem, x)[0] for x in (plain, weighed))
    policy = np.asarray(todirl.solve(start, problem, plain).policy)
    done = []
    for i in worlds:
        value, _ = probability(lazy(i, 0.3), policy[worlds.index(i)])
        done.append(float(np.sum(np.asarray(lazy(i, 0.3).initial) * value)))
    assert 0.01 < min(done) <= max(done) < 0.99
    assert float(found.satisfaction) == pytest.approx(np.mean(done), rel=1e-9)
    assert np.isnan(parts.satisfaction) and parts.score == parts.held_out == found.held_out
    gain = 2.5 * np.dot([1.0] * len(worlds) if weight is None else weight, done)
    assert float(loss - less) == pytest.approx(gain, rel=1e-9)
    pairs = found.neg_log_likelihood / found.per_pair
    assert float(found.score) == pytest.approx(float(found.held_out) - gain / float(pairs))


@pytest.mark.slow
def test_a_weight_is_of_the_probability_of_the_task():
    check_weighed((0,), None)
    with pytest.raises(ValueError, match="leave horizon out"):
        todirl.objective(None, None, todirl.Hparams(discount=0.9, mu=1.0, horizon=5))


def test_the_gradient_is_that_of_the_dense_sensitivity():
    """(3.6) and (3.7), one linear system for each parameter, on the copied-out product."""
    problem = small()
    hparams = todirl.Hparams(discount=0.9, l2=0.0, tolerance=1e-12)
    flat, unravel = ravel_pytree(parameters(problem))
    found, _ = ravel_pytree(gradient(unravel(flat), problem, hparams))
    model = lazy()
    observation = problem.observation[0]

    def rewards(x):
        return todirl.reward(problem.network, unravel(x), model, observation)

    policy = np.asarray(plan(problem.network, unravel(flat), model, observation, hparams).policy)
    uniform = np.full(model.state_shape, 1 / model.num_states)
    whole = jl.restrict(model, uniform).model
    expected = reference.likelihood_gradient(
        np.asarray(jl.models.to_dense(whole).transition),
        policy.reshape(-1, 4),
        np.asarray(jax.jit(jax.jacobian(rewards))(flat)).reshape(-1, 4, flat.size),
        np.asarray(problem.counts[0]).reshape(-1, 4),
        0.9,
    )
    np.testing.assert_allclose(-np.asarray(found), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", ["sparse", "product"])
def test_numbered_states_lead_where_the_model_does(kind):
    rng = np.random.default_rng(0)
    for label_on in ("entry", "exit") if kind == "product" else (None,):
        options = {} if label_on is None else {"label_on": label_on}
        model, _ = random_representation(rng, kind, **options)
        value = jnp.asarray(rng.normal(size=model.state_shape))
        mass = rng.normal(size=(*model.state_shape, model.num_actions))
        mass = np.where(model.available, mass, 0)
        after = jnp.stack(successor_table(model).expectation(jnp.ravel(value)), -1)
        np.testing.assert_allclose(after.reshape(mass.shape), expectation(model, value), atol=1e-14)
        lists = predecessor_table([model])
        flow = jax.tree.map(lambda x: x[0], lists).pushforward(
            jnp.asarray(mass.reshape(-1, model.num_actions).T.ravel())
        )
        np.testing.assert_allclose(
            flow.reshape(model.state_shape), pushforward(model, jnp.asarray(mass)), atol=1e-14
        )


def test_without_predecessor_lists_the_gradient_is_the_same():
    problem = small()
    hparams = todirl.Hparams(discount=0.9, tolerance=1e-12)
    one = gradient(parameters(problem), problem, hparams)
    other = gradient(parameters(problem), problem.replace(predecessors=None), hparams)
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-9)


# --- networks ----------------------------------------------------------------------------------


class Plain(nn.Module):
    @nn.compact
    def __call__(self, x):
        for width in (3, 3):
            x = nn.relu(nn.Dense(width)(x))
        return nn.Dense(1)(x)


def test_the_split_first_layer_is_a_dense_layer_on_everything():
    problem = small()
    inputs = learner._network_inputs(lazy(), problem.observation[0])
    found = parameters(problem)
    mine = found["params"]
    names = ("Dense_0", "Dense_1", "Dense_2")
    first = {"kernel": mine["kernel"], "bias": mine["bias"]}
    plain = {"network": dict(zip(names, (first, mine["Dense_0"], mine["Dense_1"]), strict=True))}
    expected = todirl.Concatenated(Plain()).apply({"params": plain}, *inputs)
    assert expected.shape == (6, NUM_MEMORY, 4)
    np.testing.assert_allclose(problem.network.apply(found, *inputs), expected, atol=1e-12)


def test_a_network_of_the_wrong_shape_is_refused():
    class Wrong(nn.Module):
        @nn.compact
        def __call__(self, observation, memory, action):
            return nn.Dense(2)(observation)

    message = r"has shape \(6, 1, 1, 2\); expected \(6, \d, 4\).*wrapped as Concatenated"
    with pytest.raises(ValueError, match=message):
        small(network=Wrong())


# --- learning ----------------------------------------------------------------------------------


class Table(nn.Module):
    """A number for each kind of cell and memory."""

    @nn.compact
    def __call__(self, observation, memory, action):
        shape = (observation.shape[-1], memory.shape[-1])
        table = self.param("table", nn.initializers.zeros_init(), shape)
        result = jnp.einsum("so,qr,or->sq", observation[:, 0, 0], memory[0, :, 0], table)
        return jnp.repeat(result[..., None], action.shape[-1], axis=-1)


@pytest.mark.slow
def test_the_expert_is_recovered_with_the_features_of_its_reward():
    """Wilks: twice the gap of log-likelihoods is chi-squared with as many parameters at most."""
    model = lazy()
    observation = np.eye(4)[np.asarray(model.letter)]
    table = jnp.asarray(np.random.default_rng(0).normal(size=(4, model.num_memory)))
    hparams = todirl.Hparams(discount=0.9, l2=1e-6, tolerance=1e-11)
    true = {"params": {"table": table}}
    expert = plan(Table(), true, model, observation, hparams)
    runs = jl.rollout(model, expert.policy, jax.random.key(0), num_trajectories=200, num_steps=20)
    runs = jl.models.project_trajectories(model, runs)
    problem = todirl.make_problem(model, observation, runs, network=Table(), held_out=None)
    flat, unravel = ravel_pytree(true)

    def likelihood(x):
        (loss, parts), gradient = slope(unravel(jnp.asarray(x)), problem, hparams)
        assert parts.status == jl.Status.CONVERGED
        return float(loss), np.asarray(ravel_pytree(gradient)[0])

    found = scipy.optimize.minimize(likelihood, 0 * flat, jac=True, method="L-BFGS-B")
    gap = float(evaluate(true, problem, hparams).neg_log_likelihood) - found.fun
    assert 0 < gap < 20  # chi-squared of 16 degrees of freedom is below 40 with .999
    learned = plan(Table(), unravel(jnp.asarray(found.x)), model, observation, hparams)
    often = problem.counts[0].sum(-1) > 100
    np.testing.assert_allclose(learned.policy[often], expert.policy[often], atol=0.08)


@pytest.mark.slow
def test_learning_stops_at_the_best_held_out_likelihood():
    problem = small(held_out=0.5)
    hparams = todirl.Hparams(discount=0.9, l2=0.0, learning_rate=0.1, patience=5, tolerance=1e-12)
    state, metrics = todirl.train(jax.random.key(0), problem, hparams, num_steps=60)
    at = int(state.best.step)
    assert state.stopped and state.step == 60 and at + 5 < 60
    assert metrics.held_out[at] == state.best.neg_log_likelihood == metrics.held_out[: at + 5].min()
    assert (metrics.loss[at + 6 :] == metrics.loss[at + 6]).all(), "it stays as it is"
    held = evaluate(state.best.parameters, problem, hparams).held_out
    np.testing.assert_allclose(held, state.best.neg_log_likelihood, rtol=1e-9)
    # Without held-out data the newest is the best.
    problem = problem.replace(held_out=0 * problem.held_out)
    state, metrics = todirl.train(jax.random.key(0), problem, hparams, num_steps=60)
    assert not state.stopped and np.isnan(metrics.held_out).all()
    assert state.best.step == 60 and metrics.loss[-1] < metrics.loss[0] - 1
    for x, y in zip(
        jax.tree.leaves(state.parameters), jax.tree.leaves(state.best.parameters), strict=True
    ):
        np.testing.assert_array_equal(x, y)


def test_counts_follow_the_memory_and_the_time():
    problem = small(horizon=5)
    timed = np.zeros((5, 6, NUM_MEMORY, 4))
    q0 = int(TASK.initial)
    q1 = int(lazy().next_memory[1, q0])  # after leaving c, cell 1
    for t, s, q, a in (
        (0, 0, q0, RIGHT),
        (1, 1, q0, DOWN),
        (2, 4, q1, RIGHT),
        (0, 0, q0, DOWN),
        (1, 3, q0, RIGHT),
        (2, 4, q0, UP),
        (3, 1, q0, DOWN),
        (4, 4, q1, RIGHT),
    ):
        timed[t, s, q, a] += 1
    np.testing.assert_array_equal(problem.counts[0], timed)
    np.testing.assert_array_equal(small().counts[0], timed.sum(0))


def test_a_long_horizon_begins_with_the_stationary_policy():
    problem = small()
    found = parameters(problem)
    place = (problem.network, found, lazy(), problem.observation[0])
    stationary = plan(*place, todirl.Hparams(discount=0.5))
    timed = plan(*place, todirl.Hparams(discount=0.5, horizon=60))
    assert timed.policy.shape == (60, *stationary.policy.shape)
    np.testing.assert_allclose(timed.policy[0], stationary.policy, atol=1e-12)
    last = jax.nn.softmax(todirl.reward(*place), axis=-1)
    np.testing.assert_allclose(timed.policy[-1], last, atol=1e-12)


# --- bad input ---------------------------------------------------------------------------------


def test_bad_problems_are_refused():
    model, observation, runs = lazy(), seen(lazy()), demonstrated()

    def refused(message, *given, **options):
        with pytest.raises(ValueError, match=message):
            todirl.make_problem(*given, **options)

    refused(r"observation has shape \(1, 5, 12\)", model, observation[:5], runs)
    refused(
        "observation in state 2 is not finite",
        model,
        np.where(np.arange(6)[:, None] == 2, np.nan, observation),
        runs,
    )
    jump = runs.replace(state=runs.state.at[0, 1].set(5))
    refused(
        "demonstrations in world 0: trajectory 0, step 0: .*does not fit the model",
        model,
        observation,
        jump,
        held_out=0,
    )
    refused("demonstrations in 1 worlds; expected 2", [model, lazy(1)], [observation] * 2, runs)
    refused("held_out=1", model, observation, runs, held_out=1.0)
    refused("no pair is left", model, observation, runs, held_out=0.9)
    refused("weight has shape", model, observation, runs, weight=[1.0, 2.0])
    refused("has 5 steps; horizon=4 is shorter", model, observation, runs, horizon=4, held_out=0)
    other = jl.product(jl.gridworld("b c y\n. . g"), "F c", label_on="exit")
    refused(
        "world 1 does not have the propositions of world 0: it lacks r",
        [model, other],
        [observation] * 2,
        [runs] * 2,
    )
    refused(
        "world 1 does not have the shapes", [model, lazy(0, 0.0)], [observation] * 2, [runs] * 2
    )
    refused("give a product", [model.mdp], observation, runs)


def test_bad_settings_are_refused():
    problem = small()
    with pytest.raises(ValueError, match=r"horizon=3, but the problem has horizon=None; make_pro"):
        todirl.objective(parameters(problem), problem, todirl.Hparams(discount=0.9, horizon=3))
    with pytest.raises(ValueError, match="optimizer='best'; choose one of"):
        todirl.init(jax.random.key(0), problem, todirl.Hparams(discount=0.9, optimizer="best"))


def test_stacked_products_are_taken_as_they_are():
    models = stack([lazy(0), lazy(1)])
    observation = np.stack([seen(lazy(i)) for i in (0, 1)])
    one = todirl.make_problem(
        models,
        observation,
        [demonstrated(0), demonstrated(1)],
        held_out=None,
        network=todirl.RewardNetwork((3, 3)),
    )
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(small((0, 1))), strict=True):
        np.testing.assert_array_equal(x, y)


# --- fewer actions -----------------------------------------------------------------------------


@pytest.mark.slow
def test_inside_a_mask_the_plan_and_the_gradient_are_those_of_worlds_without_the_rest():
    models = [lazy(0), lazy(1)]
    masks = [np.asarray(jl.optimal_actions(m).allowed) for m in models]
    assert not all(m.all() for m in masks)
    problem = small((0, 1), allowed=masks)
    hparams = todirl.Hparams(discount=0.9, l2=0.0, tolerance=1e-12)
    point = parameters(problem)
    policy = todirl.solve(point, problem, hparams).policy
    assert ((policy > 0) == np.stack(masks)).all()
    for i, (model, mask) in enumerate(zip(models, masks, strict=True)):
        new = todirl.plan(
            problem.network, point, model, jnp.asarray(seen(model)), hparams, allowed=mask
        )
        np.testing.assert_allclose(new.policy, policy[i], atol=1e-9)
        anywhere = np.full(model.state_shape, 1 / model.num_states)
        flat = jl.restrict(model, anywhere, allowed=mask).model
        reward = todirl.reward(problem.network, point, model, jnp.asarray(seen(model)))
        expected = jl.soft_value(flat, reward.reshape(flat.available.shape), 0.9).policy
        np.testing.assert_allclose(policy[i].reshape(expected.shape), expected, atol=1e-9)
    flat, unravel = ravel_pytree(point)
    direction = np.random.default_rng(1).normal(size=flat.shape)
    found = ravel_pytree(gradient(point, problem, hparams))[0] @ direction
    ahead, behind = (
        slope(unravel(flat + h * direction), problem, hparams)[0][0] for h in (1e-5, -1e-5)
    )
    np.testing.assert_allclose(found, (ahead - behind) / 2e-5, rtol=1e-6)


@pytest.mark.parametrize(
    ("masks", "message"),
    [
        (lambda m: [m], "there are 1 masks for 2 worlds"),
        (lambda m: [m, m & False], "world 1: allowed: no action is left in state 0 with memory 0"),
    ],
)
def test_masks_that_fit_no_world_are_refused(masks, message):
    mask = np.ones((*lazy().state_shape, 4), bool)
    with pytest.raises(ValueError, match=message):
        small((0, 1), allowed=masks(mask))


def test_trajectories_of_the_product_are_refused():
    lifted = jl.models.lift_trajectories(lazy(), demonstrated())
    with pytest.raises(ValueError, match="demonstrations in world 0: the trajectories belong to a"):
        todirl.make_problem(lazy(), seen(lazy()), lifted)


# --- the laws of all learners ------------------------------------------------------------------


def task_oriented():
    # Plain descent: a constant reward changes nothing, and Adam would make a step of the rounding.
    mdp, demonstrations = world()
    setting = partial(todirl.Hparams, optimizer="sgd")
    problem = todirl.make_problem(
        jl.product(mdp, "!r U g", label_on="exit"),
        np.eye(3),
        demonstrations,
        network=todirl.RewardNetwork((3,)),
        held_out=0.5,
    )
    return LearnerCase(
        todirl,
        problem,
        setting(discount=0.9, patience=3),
        setting(discount=0.8, l2=0.1, learning_rate=0.05, patience=4),
    )


CASES = {
    "todirl": task_oriented,
}
