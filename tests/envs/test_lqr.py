"""The regulator against a plain simulation, and its best controls in two ways."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from jaxltl.core.environments.episodes import run_episode
from jaxltl.core.values.evaluation.evaluation import episode_evaluator
from jaxltl.envs.lqr import as_environment, evaluator, lqr, optimum, simulate
from jaxltl.envs.networks import apply, make_network, network_agent
from tests.support import counted_traces

RNG = np.random.default_rng(1)
BEST = 3.751060412278  # published digits of the problem's optimum
NETWORKS = ["2-2-1", "2-10-1", "2-10-10-1", "2-50-1"]


def other_world():
    """Three states and two controls, with bounds of their own."""
    return lqr(
        [[1, 0.5, 0], [0, 0.9, 0.2], [0.1, 0, 1]],
        [[0, 1], [1, 0], [0.3, 0.4]],
        state_cost=[[2, 0.5, 0], [0.5, 1, 0], [0, 0, 0.5]],
        control_cost=[[0.4, 0.1], [0.1, 0.3]],
        low=[-0.3, -0.1],
        high=[0.2, 0.5],
        initial=[1, -2, 0.5],
        horizon=7,
    )


def plainly(world, control_of):
    """J, the largest violation and the controls, by the definition."""
    x, total, violation, controls = np.array(world.initial), 0.0, 0.0, []
    for t in range(world.horizon):
        u = np.asarray(control_of(t, x), float)
        x = world.dynamics @ x + world.control @ u
        total += x @ world.state_cost @ x + u @ world.control_cost @ u
        violation = max(violation, *(world.low - u), *(u - world.high))
        controls.append(u)
    return total, violation, np.array(controls)


def clipped_linear(gain, offset):
    """``clip(gain x + offset, -.2, .2)`` as the parameters of a 2-2-1 network with biases."""
    a, b = gain
    return jnp.array([a, a, b, b, offset + 0.2, offset - 0.2, 1.0, -1.0, -0.2])


@pytest.mark.slow
@pytest.mark.parametrize("spec", [*NETWORKS, "3-4-2"])
def test_runs_against_a_plain_simulation(spec):
    world = other_world() if spec == "3-4-2" else lqr()
    network = make_network(spec, biases=spec != "2-10-1")
    parameters = jnp.asarray(0.3 * RNG.normal(size=network.num_parameters))
    run = simulate(world, network, parameters)
    total, violation, controls = plainly(
        world, lambda _, x: apply(network, parameters, jnp.asarray(x))
    )
    np.testing.assert_allclose(run.control, controls, rtol=1e-9)
    np.testing.assert_allclose((run.total, run.violation), (total, violation), rtol=1e-9)
    objective, cost = evaluator(world, network)(parameters, None)
    np.testing.assert_allclose((-objective * world.scale, cost), (total, violation), rtol=1e-9)
    assert run.state.shape == (world.horizon + 1, len(world.initial))
    np.testing.assert_array_equal(run.state[0], world.initial)


def test_doing_nothing_is_the_scale():
    for world, spec in ((lqr(), "2-2-1"), (other_world(), "3-4-2")):
        network = make_network(spec)
        objective, cost = evaluator(world, network)(jnp.zeros(network.num_parameters), None)
        np.testing.assert_allclose((objective, cost), (-1, 0), rtol=1e-12)
    at_rest = lqr(initial=[0, 0])
    assert at_rest.scale == 1
    assert lqr(scale=3.0).scale == 3


@pytest.mark.parametrize("spec", ["2-2-1", pytest.param("2-10-10-1", marks=pytest.mark.exhaustive)])
def test_batches_are_single_evaluations(spec):
    evaluate = evaluator(lqr(), spec)
    parameters = jnp.asarray(0.4 * RNG.normal(size=(3, 2, 4, make_network(spec).num_parameters)))
    keys = jax.random.split(jax.random.key(0), (3, 2, 4))
    found = jax.jit(jax.vmap(jax.vmap(jax.vmap(evaluate))))(parameters, keys)
    for place in np.ndindex(3, 2, 4):
        alone = evaluate(parameters[place], keys[place])
        np.testing.assert_allclose([x[place] for x in found], alone, rtol=1e-8, atol=1e-12)
    across = jax.jit(jax.vmap(evaluate, (1, None)))(parameters[0, 0].T, keys[0, 0, 0])
    np.testing.assert_allclose(across, [x[0, 0] for x in found], rtol=1e-8, atol=1e-12)


def test_the_lanes_of_a_simulation():
    parameters = jnp.asarray(0.4 * RNG.normal(size=(9, 2, 3)))
    many, one = (simulate(lqr(), "2-2-1", p) for p in (parameters, parameters[:, 1, 2]))
    assert many.control.shape == (20, 1, 2, 3)
    for x, y in zip(many, one, strict=True):
        np.testing.assert_allclose(x[..., 1, 2], y, rtol=1e-10, atol=1e-12)


def test_batches_of_worlds():
    worlds = [lqr(initial=[1, -1]), lqr(initial=[0.5, 0.2], high=0.1)]
    both = jax.tree.map(lambda *x: jnp.stack(x), *worlds)
    parameters = jnp.asarray(0.4 * RNG.normal(size=(4, 9)))

    def population(world, parameters):
        return jax.jit(jax.vmap(evaluator(world, "2-2-1"), (0, None)))(parameters, None)

    found = jax.jit(jax.vmap(population, (0, None)))(both, parameters)
    paired = jax.jit(jax.vmap(lambda w, p: evaluator(w, "2-2-1")(p, None)))(both, parameters[:2])
    for i, world in enumerate(worlds):
        np.testing.assert_allclose(
            [x[i] for x in found], population(world, parameters), rtol=1e-9, atol=1e-12
        )
        np.testing.assert_allclose([x[i] for x in paired], [x[i, i] for x in found], rtol=1e-9)


def test_new_worlds_and_parameters_do_not_retrace():
    def population(evaluate, parameters):
        return jax.jit(jax.vmap(evaluate, (0, None)))(parameters, None)

    jitted = jax.jit(population)
    one = jitted(evaluator(lqr(), "2-2-1"), jnp.ones((3, 9)))
    with counted_traces() as traced:
        two = jitted(evaluator(lqr(initial=[2, -1]), make_network("2-2-1")), jnp.zeros((3, 9)))
    assert not traced
    assert (one[0] != two[0]).all()


def test_runs_that_overflow_are_worst():
    wild = jnp.full((1, 9), 50.0, jnp.float32)
    parameters = jnp.concatenate([wild, jnp.zeros((1, 9), jnp.float32)])
    objective, cost = jax.jit(jax.vmap(evaluator(lqr(), "2-2-1"), (0, None)))(parameters, None)
    assert objective.dtype == cost.dtype == jnp.float32
    assert objective.tolist() == [-np.inf, -1] and cost.tolist() == [np.inf, 0]


# --- the best controls ------------------------------------------------------------------------


def test_the_published_optimum():
    best = optimum(lqr())
    assert abs(best.total - BEST) < 1e-11
    assert best.residual < 1e-12
    expected = [0.2] * 7 + [
        -0.09154264,
        -0.2,
        -0.10532896,
        -0.01603342,
        0.00645174,
        0.00514323,
        0.00155198,
    ]
    np.testing.assert_allclose(best.control[:14, 0], expected, atol=5e-9)


@pytest.mark.parametrize("world", [lqr(), other_world()], ids=["published", "other"])
def test_the_optimum_by_its_states_and_controls(world):
    """A second method, on (4.17) as it is written: the dynamics are constraints."""
    best = optimum(world)
    total, violation, _ = plainly(world, lambda t, _: best.control[t])
    assert abs(total - best.total) < 1e-12 and violation < 1e-12
    n, m = world.control.shape
    horizon = world.horizon

    def split(z):
        return z[: horizon * n].reshape(horizon, n), z[horizon * n :].reshape(horizon, m)

    def cost(z):
        x, u = split(z)
        gradient = np.concatenate(
            [2 * (x @ world.state_cost).ravel(), 2 * (u @ world.control_cost).ravel()]
        )
        return gradient @ z / 2, gradient

    def defect(z):
        x, u = split(z)
        before = np.concatenate([world.initial[None], x[:-1]])
        return (x - before @ world.dynamics.T - u @ world.control.T).ravel()

    zero = np.zeros(horizon * (n + m))
    jacobian = np.stack([defect(e) - defect(zero) for e in np.eye(len(zero))], axis=1)
    bounds = [(None, None)] * (horizon * n) + list(
        zip(np.tile(world.low, horizon), np.tile(world.high, horizon), strict=True)
    )
    found = minimize(
        cost,
        zero,
        jac=True,
        method="SLSQP",
        bounds=bounds,
        constraints={"type": "eq", "fun": defect, "jac": lambda z: jacobian},
        options={"ftol": 1e-15, "maxiter": 500},
    )
    np.testing.assert_allclose(found.fun, best.total, rtol=1e-9)
    np.testing.assert_allclose(split(found.x)[1], best.control, atol=1e-5)
    np.testing.assert_allclose(split(found.x)[0], best.state[1:], atol=1e-5)


def test_the_optimum_meets_its_conditions_and_is_the_least():
    """The slope, here by differentiating the simulation, points out of the bounds or is 0."""
    world = other_world()
    best = optimum(world)

    def total(controls):
        def step(x, u):
            x = world.dynamics @ x + world.control @ u
            return x, x @ world.state_cost @ x + u @ world.control_cost @ u

        return jax.lax.scan(step, jnp.asarray(world.initial), controls)[1].sum()

    total = jax.jit(total)
    slope = np.asarray(jax.grad(total)(jnp.asarray(best.control)))
    at_low, at_high = best.control <= world.low, best.control >= world.high
    assert (at_low | at_high).any() and not (at_low | at_high).all(), "both cases occur"
    assert (np.abs(slope)[~(at_low | at_high)] < 1e-9).all()
    assert (slope[at_low] >= -1e-9).all() and (slope[at_high] <= 1e-9).all()
    for _ in range(50):
        other = np.clip(
            best.control + 0.1 * RNG.normal(size=best.control.shape), world.low, world.high
        )
        assert total(jnp.asarray(other)) > best.total


def test_pinned_controls_and_wide_bounds():
    pinned = optimum(lqr(low=0.1, high=0.1, horizon=3))
    np.testing.assert_array_equal(pinned.control, np.full((3, 1), 0.1))
    free = optimum(lqr(low=-np.inf, high=np.inf, horizon=1))
    # x = (u, u - 1): the sum u^2 + .3 u^2 is least at 0.
    np.testing.assert_allclose(free.control, [[0.0]], atol=1e-12)


def test_a_small_network_with_biases_comes_within_a_millionth():
    parameters = clipped_linear((-0.6423877701634852, -0.871080993055552), -6.164693307938371e-05)
    run = simulate(lqr(), "2-2-1", parameters)
    assert 0 < run.total - BEST < 5.3e-7
    assert run.violation < 1e-15
    objective, cost = evaluator(lqr(), "2-2-1")(parameters, None)
    assert abs(-2470 * objective - run.total) < 1e-12 and cost < 1e-15


# --- bad input --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"initial": [1, 2, 3]}, r"initial has shape \(3,\); expected \(2,\)"),
        ({"state_cost": [[1.0]]}, r"state_cost has shape \(1, 1\); expected \(2, 2\)"),
        ({"state_cost": [[1, 0], [0, -1]]}, "state_cost must be symmetric and positive semi"),
        ({"state_cost": [[1, 1], [0, 1]]}, "state_cost must be symmetric"),
        ({"control_cost": [[0]]}, "control_cost must be symmetric and positive definite"),
        ({"low": 1, "high": 0}, "low=1, high=0; low must be at most high"),
        ({"horizon": 0}, "horizon=0; it must be at least 1"),
        ({"scale": 0.0}, "scale=0.0; it must be above 0"),
    ],
)
def test_bad_worlds_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        lqr(**arguments)


def test_networks_that_do_not_fit_are_refused():
    for make in (evaluator, lambda w, n: simulate(w, n, jnp.zeros(3))):
        with pytest.raises(ValueError, match=r"has 2 states, its inputs, and 1 controls"):
            make(lqr(), "3-2-1")
    with pytest.raises(ValueError, match="has 9 parameters"):
        evaluator(lqr(), "2-2-1")(jnp.zeros(8), None)


@pytest.mark.slow
@pytest.mark.parametrize("world", [lqr(), other_world()])
def test_the_environment_is_the_run(world):
    """Episodes of a network add up to what the evaluation of its run says."""
    n, m = world.control.shape
    network = make_network((n, 3, m))
    environment = as_environment(world)
    parameters = jnp.asarray(RNG.normal(size=(4, network.num_parameters)))
    agent = network_agent(network, environment)
    evaluate = episode_evaluator(environment, agent, costs="cost", num_episodes=1)
    reward, cost = jax.vmap(evaluate, (0, None))(parameters, jax.random.key(0))
    objective, violation = jax.vmap(evaluator(world, network), (0, None))(parameters, None)
    np.testing.assert_allclose(reward / world.scale, objective, rtol=1e-9)
    np.testing.assert_allclose(cost, violation, rtol=1e-9)
    episode = run_episode(
        jax.random.key(0), environment, agent(parameters[0]), num_steps=world.horizon + 2
    )
    run = simulate(world, network, parameters[0])
    assert episode.valid.sum() == world.horizon and episode.terminated
    np.testing.assert_allclose(episode.world.state[: world.horizon + 1], run.state, rtol=1e-9)
    np.testing.assert_allclose(episode.action[: world.horizon], run.control, rtol=1e-9)
