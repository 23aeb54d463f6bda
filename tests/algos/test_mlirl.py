"""Inverse RL: features by hand, gradients of the objective, and the optimum of a small problem."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from flax import linen as nn
from jax.flatten_util import ravel_pytree

import jaxltl as jl
from jaxltl.algos import mlirl
from jaxltl.algos.mlirl import features as irl_features
from jaxltl.core.models.construct.lifting import allowed_steps
from tests.algos.cases import LearnerCase, numbers, world
from tests.support import assert_gradients

MAX_PROGRAMS = 450  # that the default tests compile at most

UP, DOWN, LEFT, RIGHT = range(4)
TASK = "F (c & F g)"


def grid(slip=0.0):
    """Cells 0 to 5: b c r over . . g; the demonstrations pass c on the way to g."""
    world = jl.gridworld("b c r\n. . g", slip=slip, absorbing=["g"])
    runs = [[(0, RIGHT), (1, DOWN), (4, RIGHT)], [(0, DOWN), (3, RIGHT), (4, UP), (1, DOWN)]]
    return world, jl.make_trajectories(world, runs)


def test_pair_counts_by_hand():
    world, demonstrations = grid()
    expected = np.zeros((6, 4))
    for s, a, count in (
        (0, RIGHT, 1),
        (1, DOWN, 2),
        (4, RIGHT, 1),
        (0, DOWN, 1),
        (3, RIGHT, 1),
        (4, UP, 1),
    ):
        expected[s, a] = count
    np.testing.assert_array_equal(irl_features.pair_counts(world, demonstrations), expected)


def test_pair_counts_in_a_product_follow_the_memory():
    world, demonstrations = grid()
    lazy = jl.product(world, TASK)
    assert lazy.num_memory == 3
    lifted = jl.models.lift_trajectories(lazy, demonstrations)
    traced = jax.jit(jl.models.lift_trajectories)(lazy, demonstrations)
    jax.tree.map(np.testing.assert_array_equal, lifted, traced)  # the host finds the same
    counts = irl_features.pair_counts(lazy, lifted)
    np.testing.assert_array_equal(counts, jax.jit(irl_features.pair_counts)(lazy, traced))
    start = int(lazy.initial_memory[0])
    middle = int(lazy.initial_memory[1])
    expected = np.zeros((6, 3, 4))
    for s, q, a, count in (
        (0, start, RIGHT, 1),
        (1, middle, DOWN, 2),
        (4, middle, RIGHT, 1),
        (0, start, DOWN, 1),
        (3, start, RIGHT, 1),
        (4, start, UP, 1),
    ):
        expected[s, q, a] = count
    np.testing.assert_array_equal(counts, expected)


def test_world_features_by_hand():
    world, demonstrations = grid()
    found = mlirl.world_features(world, demonstrations, goal=["g"], progress=["c"], avoid=["r"])
    assert found.names == ("demonstrated", "goal", "progress", "avoid", "time")
    expected = np.zeros((6, 4, 5))
    for s, a in ((0, RIGHT), (1, DOWN), (4, RIGHT), (0, DOWN), (3, RIGHT), (4, UP)):
        expected[s, a, 0] = 1
    expected[2, DOWN, 1] = expected[4, RIGHT, 1] = 1
    # The cell c is entered from its neighbours, and again by pushing against the wall above.
    expected[0, RIGHT, 2] = expected[2, LEFT, 2] = expected[4, UP, 2] = expected[1, UP, 2] = 1
    expected[1, RIGHT, 3] = expected[2, UP, 3] = expected[2, RIGHT, 3] = -1
    expected[:5, :, 4] = -1  # the goal's cell has no features
    np.testing.assert_array_equal(found.values, expected)


def test_task_features_by_hand():
    world, demonstrations = grid()
    lazy = jl.product(world, TASK)
    found = mlirl.task_features(lazy, demonstrations, avoid=["r"])
    assert found.names == ("demonstrated", "goal", "progress", "avoid", "time")
    start, middle = (int(lazy.initial_memory[s]) for s in (0, 1))
    (done,) = np.flatnonzero(lazy.automaton.final)
    assert mlirl.progress_states(lazy) == (middle,)
    expected = np.zeros((6, 3, 4, 5))
    expected[..., 4] = -1
    for s, q, a in (
        (0, start, RIGHT),
        (1, middle, DOWN),
        (4, middle, RIGHT),
        (0, start, DOWN),
        (3, start, RIGHT),
        (4, start, UP),
    ):
        expected[s, q, a, 0] = 1
    # The goal counts after c only; in the goal's cell itself the memory is done at once.
    for s, a in ((2, DOWN), (4, RIGHT), *((5, a) for a in range(4))):
        expected[s, middle, a, 1] = 1
    for s, a in ((0, RIGHT), (2, LEFT), (4, UP), (1, UP)):
        expected[s, start, a, 2] = 1
    for s, a in ((1, RIGHT), (2, UP), (2, RIGHT)):
        expected[s, :, a, 3] = -1
    expected[:, done] = 0
    np.testing.assert_array_equal(found.values, expected)


def test_features_weigh_by_probability():
    world, demonstrations = grid(slip=0.2)
    found = mlirl.world_features(world, demonstrations, goal=["g"]).values
    assert found.shape[-1] == 4, "without a thing to avoid the feature is left out"
    # From the cell above the goal: down succeeds with .8, and left slips there with .1.
    np.testing.assert_allclose(found[2, :, 1], [0, 0.8, 0.1, 0.1], atol=1e-15)


# --- gradients of the objective ----------------------------------------------------------------


class Network(nn.Module):
    @nn.compact
    def __call__(self, features):
        hidden = nn.tanh(nn.Dense(3, param_dtype=float)(features))
        return nn.Dense(1, param_dtype=float)(hidden)[..., 0]


def problem_in(place, reward="linear"):
    world, demonstrations = grid(slip=0.2)
    if place == "world":
        model = world
        features = mlirl.world_features(world, demonstrations, goal=["g"], avoid=["r"]).values
    else:
        model = jl.product(world, TASK)
        features = mlirl.task_features(model, demonstrations, avoid=["r"]).values
    if reward == "linear":
        return mlirl.make_problem(model, features, demonstrations)
    network = Network()
    start = network.init(jax.random.key(0), features)
    return mlirl.make_problem(model, features, demonstrations, guess=start, reward=network.apply)


@pytest.mark.parametrize(
    ("place", "reward", "options"),
    [
        ("world", "network", {}),
        pytest.param("world", "linear", {}, marks=pytest.mark.slow),
        pytest.param("world", "linear", {"policy": "soft"}, marks=pytest.mark.slow),
        ("product", "linear", {"mu": 2.0}),
        pytest.param(
            "product", "linear", {"mu": 2.0, "policy": "soft"}, marks=pytest.mark.exhaustive
        ),
        pytest.param("product", "network", {"mu": 2.0}, marks=pytest.mark.exhaustive),
        pytest.param("product", "network", {}, marks=pytest.mark.exhaustive),
    ],
)
def test_gradients_of_the_objective(place, reward, options):
    problem = problem_in(place, reward)
    hparams = mlirl.Hparams(discount=0.7, **options)
    flat, unravel = ravel_pytree(problem.guess)
    rng = np.random.default_rng(0)

    def loss(x):
        return mlirl.objective(unravel(x["parameters"]), problem, hparams)[0]

    assert_gradients(
        loss,
        {"parameters": flat + rng.normal(size=flat.size)},
        {"parameters": rng.normal(size=flat.size)},
    )


def test_the_approximate_gradient_is_another_except_at_zero():
    problem = problem_in("world")
    gradient = {
        adjoint: jax.jit(
            jax.grad(
                lambda p, a=adjoint: mlirl.objective(
                    p, problem, mlirl.Hparams(discount=0.7, adjoint=a)
                )[0]
            )
        )
        for adjoint in ("exact", "approximate")
    }
    zero, one = jnp.zeros(5), jnp.array([1.0, 2.0, -1.0, 0.5, 0.3])
    np.testing.assert_allclose(gradient["exact"](zero), gradient["approximate"](zero), atol=1e-9)
    relative = jnp.linalg.norm(gradient["exact"](one) - gradient["approximate"](one))
    assert relative > 1e-3 * jnp.linalg.norm(gradient["exact"](one))


def test_the_objective_by_hand():
    """The terms (2.4), (2.6) and the prior, from the policy's own numbers."""
    problem = problem_in("product")
    hparams = mlirl.Hparams(discount=0.5, mu=3.0, l2=0.1)
    weights = jnp.array([1.0, 2.0, 0.5, 1.0, 0.2])
    loss, parts = mlirl.objective(weights, problem, hparams)
    policy = np.asarray(mlirl.solve(weights, problem, hparams).policy)
    counts = np.asarray(problem.counts)
    log_likelihood = (counts[counts > 0] * np.log(policy[counts > 0])).sum()
    y = np.asarray(jl.satisfaction_probability(problem.model, jnp.asarray(policy)).value)
    counted = np.asarray(problem.model.initial) > 0
    np.testing.assert_allclose(parts.neg_log_likelihood, -log_likelihood, rtol=1e-10)
    np.testing.assert_allclose(parts.satisfaction, y[counted].mean(), rtol=1e-7)
    expected = -log_likelihood - 3.0 * y[counted].sum() + 0.05 * float(weights @ weights)
    np.testing.assert_allclose(loss, expected, rtol=1e-8)


@pytest.mark.slow
def test_learning_reaches_the_optimum():
    problem = problem_in("world")
    hparams = mlirl.Hparams(discount=0.5, l2=1e-2)
    state, metrics = mlirl.train(jax.random.key(0), problem, hparams, num_steps=60)
    likelihood = -np.asarray(metrics.neg_log_likelihood)
    assert likelihood[-1] > likelihood[0] + 1
    assert (metrics.status == jl.Status.CONVERGED).all()
    assert np.isnan(metrics.satisfaction).all(), "there is no task"
    evaluate = jax.jit(jax.value_and_grad(lambda p: mlirl.objective(p, problem, hparams)[0]))
    best = min(
        scipy.optimize.minimize(
            lambda p: tuple(np.asarray(x) for x in evaluate(p)),
            np.full(5, start),
            jac=True,
            method="BFGS",
            options={"gtol": 1e-9},
        ).fun
        for start in (0.0, 1.0, 3.0)
    )
    np.testing.assert_allclose(evaluate(state.parameters)[0], best, rtol=1e-8)
    np.testing.assert_allclose(metrics.loss[-1], best, rtol=1e-8)
    assert metrics.gradient_norm[-1] < 1e-4


# --- settings and errors -----------------------------------------------------------------------


def test_states_whose_satisfaction_counts():
    world, demonstrations = grid()
    lazy = jl.product(world, TASK)
    features = jnp.zeros((*lazy.state_shape, 4, 1))
    problem = partial(mlirl.make_problem, lazy, features, demonstrations)
    np.testing.assert_array_equal(problem().satisfaction_weight, lazy.initial > 0)
    every = problem(satisfaction_over="all").satisfaction_weight
    assert every.shape == (6, 3)
    assert every.all()
    weights = np.arange(18.0).reshape(6, 3)
    np.testing.assert_array_equal(problem(satisfaction_over=weights).satisfaction_weight, weights)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"features": np.zeros((6, 3, 2))}, r"shape \(6, 3, 2\); expected \(6, 4, any\)"),
        ({"features": np.full((6, 4, 1), np.nan)}, r"features at \(0, 0, 0\) is not finite"),
        ({"satisfaction_over": "some"}, "satisfaction_over='some'; choose"),
        ({"satisfaction_over": np.zeros(5)}, r"_over has shape \(5,\); expected \(6,\)"),
        ({"reward": lambda p, f: f}, r"the reward has shape \(6, 4, 2\); expected \(6, 4\)"),
    ],
)
def test_bad_problems_are_refused(arguments, message):
    world, demonstrations = grid()
    arguments = {"features": np.zeros((6, 4, 2)), **arguments}
    with pytest.raises(ValueError, match=message):
        mlirl.make_problem(world, demonstrations=demonstrations, **arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"policy": "greedy"}, "policy='greedy'; choose one of boltzmann, soft"),
        ({"policy": "soft", "adjoint": "approximate"}, "belongs to the Boltzmann policy"),
        ({"adjoint": "none"}, "adjoint='none'; choose one of exact, approximate"),
        ({"mu": 1.0}, "make the problem in a product"),
        ({"optimizer": "newton"}, "optimizer='newton'; choose one of lbfgs, adabelief, "),
    ],
)
def test_bad_settings_are_refused(options, message):
    problem = problem_in("world")
    hparams = mlirl.Hparams(discount=0.5, **options)
    with pytest.raises(ValueError, match=message):
        mlirl.train(jax.random.key(0), problem, hparams, num_steps=1)


def test_features_refuse_what_does_not_exist():
    world, demonstrations = grid()
    for argument in ("goal", "progress", "avoid"):
        names = {"goal": ["g"], argument: ["z"]}
        with pytest.raises(ValueError, match=f"{argument}: 'z' is not a proposition of the world"):
            mlirl.world_features(world, demonstrations, **names)
    lazy = jl.product(world, TASK)
    with pytest.raises(ValueError, match="progress: automaton state 3 does not exist; there are 3"):
        mlirl.task_features(lazy, demonstrations, progress=[3])
    with pytest.raises(ValueError, match="avoid: 'z' is not a proposition"):
        mlirl.task_features(lazy, demonstrations, avoid=["z"])
    with pytest.raises(ValueError, match="progress belongs to co-safe tasks"):
        mlirl.task_features(jl.product(world, "G !r"), demonstrations, progress=[0])


# --- features of any task ----------------------------------------------------------------------


def test_features_of_a_task_without_end_by_hand():
    """Patrol c and g for ever: visits, and the way to where both can be had again and again."""
    world, _ = grid()
    world = world.replace(successor=jl.gridworld("b c r\n. . g").successor)
    runs = jl.make_trajectories(world, [[(0, RIGHT), (1, DOWN), (4, RIGHT)]])
    lazy = jl.product(world, "G F c & G F g & G !r")
    best = jl.optimal_satisfaction(lazy)
    found = mlirl.task_features(lazy, runs, avoid=["r"], best=best)
    assert found.names == ("demonstrated", "accepting", "avoid", "nearer")
    reads = np.zeros((*lazy.state_shape, 4))
    red = np.zeros_like(reads)
    automaton, letter = lazy.automaton, np.asarray(lazy.letter)
    for s in range(6):
        for a in range(4):
            t = int(world.successor[s, a, 0])
            red[s, :, a] = -float(t == 2)
            reads[s, :, a] = np.asarray(automaton.priority)[:, letter[t]] == 0
    np.testing.assert_allclose(found.values[..., 1], reads, atol=1e-12)
    np.testing.assert_allclose(found.values[..., 2], red, atol=1e-12)
    shown = np.asarray(jl.models.lift_trajectories(lazy, runs).state[0])
    expected = np.zeros_like(reads)
    expected.reshape(-1, 4)[shown, [RIGHT, DOWN, RIGHT]] = 1
    np.testing.assert_array_equal(found.values[..., 0], expected)
    # Along the best policy every step brings the next visit, or the component, nearer by one.
    alive = np.argwhere(np.asarray(best.value) == 1)
    chosen = np.asarray(best.policy)[tuple(alive.T)]
    np.testing.assert_allclose(found.values[..., 3][(*alive.T, chosen)], 1, atol=1e-9)
    others = np.asarray(found.values[..., 3])[tuple(alive.T)]
    assert (others <= 1 + 1e-9).all() and (others < 0).any()


def test_nearer_is_the_step_that_the_quickest_way_is_shorter_by():
    world, demonstrations = grid()
    lazy = jl.product(world, TASK)
    found = mlirl.task_features(lazy, demonstrations, best=jl.optimal_satisfaction(lazy))
    assert found.names == ("demonstrated", "goal", "progress", "time", "nearer")
    q = int(lazy.initial_memory[0])
    np.testing.assert_allclose(found.values[0, q, :, -1], [0, -1, 0, 1], atol=1e-9)


@pytest.mark.parametrize("task", ["F g", "G F g"])
def test_what_takes_longer_than_can_be_told_is_said_to_be_left_out(task):
    """By a chance of 1e-20 in each step, which is surely taken some time."""
    world = jl.from_dense([[[1.0, 1e-20]], [[0, 1.0]]], label=[[0], [1]], propositions=["g"])
    lazy = jl.product(world, task)
    runs = jl.make_trajectories(world, [[(0, 0)]])
    best = jl.optimal_satisfaction(lazy)
    assert float(best.lower[0, int(lazy.initial_memory[0])]) == 1
    found = mlirl.task_features(lazy, runs, best=best)
    assert "nearer" not in found.names and found.values.shape[-1] == len(found.names)
    assert found.remark.startswith("The feature nearer is left out: the best policy's expected")
    plain = mlirl.task_features(lazy, runs)
    assert (plain.names, plain.remark) == (found.names, None)


# --- fewer actions -----------------------------------------------------------------------------


def masked(reward=mlirl.linear_reward, **options):
    """The product of the little map in which no move may enter r."""
    world, demonstrations = grid(slip=0.2)
    lazy = jl.product(world, f"{TASK} & (!r U g)")
    allowed = jl.optimal_actions(lazy).allowed
    features = mlirl.task_features(lazy, demonstrations).values
    return (
        lazy,
        allowed,
        demonstrations,
        mlirl.make_problem(lazy, features, demonstrations, allowed=allowed, **options),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "mu"),
    [
        ("boltzmann", None),
        ("soft", 0.5),
        pytest.param("boltzmann", 0.5, marks=pytest.mark.exhaustive),
        pytest.param("soft", None, marks=pytest.mark.exhaustive),
    ],
)
def test_inside_a_mask_the_policy_and_the_gradient_are_those_of_a_model_without_the_rest(kind, mu):
    lazy, allowed, _, problem = masked()
    flat = jl.restrict(lazy, np.full(lazy.state_shape, 1 / lazy.num_states), allowed=allowed).model
    hparams = mlirl.Hparams(discount=0.6, policy=kind, mu=mu)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=problem.features.shape[-1]))
    policy = mlirl.solve(weights, problem, hparams).policy
    assert ((policy > 0) == allowed).all()
    reward = (problem.features @ weights).reshape(flat.available.shape)
    value = jl.soft_value if kind == "soft" else jl.values.boltzmann_value
    np.testing.assert_allclose(
        policy.reshape(reward.shape), value(flat, reward, 0.6).policy, atol=1e-9
    )
    direction = np.random.default_rng(1).normal(size=weights.shape)
    assert_gradients(
        lambda x: mlirl.objective(x["weights"], problem, hparams)[0],
        {"weights": weights},
        {"weights": direction},
    )


def test_steps_outside_the_mask_are_left_out_by_name():
    lazy, allowed, demonstrations, problem = masked()
    kept = allowed_steps(jl.with_allowed(lazy, allowed), demonstrations)
    assert 0 < (~kept & np.asarray(demonstrations.mask)).sum() < demonstrations.length.sum()
    assert problem.counts.sum() == kept.sum()
    assert (problem.counts[~np.asarray(allowed)] == 0).all()
    with pytest.raises(ValueError, match="trajectory 1: none of its 1 steps takes an allowed act"):
        shown = jl.make_trajectories(lazy.mdp, [[(0, DOWN), (3, RIGHT)], [(1, RIGHT)]])
        mlirl.make_problem(lazy, problem.features, shown, allowed=allowed)


def test_trajectories_of_another_model_are_refused():
    world, demonstrations = grid()
    lazy = jl.product(world, TASK)
    lifted = jl.models.lift_trajectories(lazy, demonstrations)
    features = np.zeros((*lazy.state_shape, 4, 1))
    with pytest.raises(ValueError, match=r"belong to a model of shape \(6, 3\).*project_traj"):
        mlirl.make_problem(lazy, features, lifted)
    with pytest.raises(ValueError, match=r"belong to a model of shape \(6,\).*lift_traj"):
        jl.models.project_trajectories(lazy, demonstrations)
    with pytest.raises(ValueError, match="trajectory 0, step 1: state 6 does not exist"):
        outside = jl.models.Trajectories(np.array([[0, 6]]), np.array([[0, 0]]), np.array([2]))
        mlirl.make_problem(world, np.zeros((6, 4, 1)), outside)
    back = jl.models.project_trajectories(lazy, lifted)
    np.testing.assert_array_equal(back.state, demonstrations.state)
    assert back.state_shape == world.state_shape


@pytest.mark.few(1)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_by_construction_whatever_was_learned(dtype):
    """Weights that make exponentials underflow leave the best probability what it is."""
    with jax.enable_x64(dtype == jnp.float64):
        lazy, allowed, _, problem = masked()
        for sign in (-1, 1):
            weights = sign * 1e4 * jnp.arange(1.0, problem.features.shape[-1] + 1, dtype=dtype)
            for kind in ("boltzmann", "soft"):
                hparams = mlirl.Hparams(discount=0.5, policy=kind)
                policy = mlirl.solve(weights, problem, hparams).policy
                assert ((policy > 0) == allowed).all()
                done = jl.satisfaction_probability(lazy, policy)
                assert (done.lower[jl.optimal_satisfaction(lazy).lower == 1] == 1).all()


# --- the laws of all learners ------------------------------------------------------------------


def mlirl_world():
    mdp, demonstrations = world()
    setting = partial(mlirl.Hparams, optimizer="adam")
    return LearnerCase(
        mlirl,
        mlirl.make_problem(mdp, numbers(3, 2, 2), demonstrations),
        setting(discount=0.5),
        setting(discount=0.4, l2=1e-2, learning_rate=0.01),
        reward="features",
    )


def mlirl_product():
    mdp, demonstrations = world()
    lazy = jl.product(mdp, "!r U g")
    features = numbers(*lazy.state_shape, 2, 2)
    return LearnerCase(
        mlirl,
        mlirl.make_problem(lazy, features, demonstrations),
        mlirl.Hparams(discount=0.5, mu=0.1),
        mlirl.Hparams(discount=0.6, mu=1.0, l2=1e-2),
        reward="features",
    )


CASES = {
    "mlirl-world": mlirl_world,
    "mlirl-product": mlirl_product,
}
