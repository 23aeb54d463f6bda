"""The robot, its sensor and the four tasks against plain readings, one number at a time."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.envs import navigation as nav
from jaxltl.envs.navigation import State, evaluator, navigation, policy_network, simulate
from jaxltl.envs.networks import apply, make_network
from tests.support import counted_traces

RNG = np.random.default_rng(2)
WORLD = navigation()
NETWORK = policy_network(WORLD)

observe, labels, obstacle_distance, reward, move = map(
    jax.jit, (nav.observe, nav.labels, nav.obstacle_distance, nav.reward, nav.move)
)
scores = jax.jit(nav.scores, static_argnums=2)
act = jax.jit(
    lambda world, network, parameters, state: apply(network, parameters, nav.observe(world, state))
)


def crowded():
    """Another map, on which random policies meet everything; a short horizon."""
    return navigation(
        goal=[(-1, -1), (1, 0.5)],
        obstacle=[(-2.5, 0.7), (2, 1.5)],
        bounds=[(-3, -2), (3, 2)],
        initial=[(-2, -1.5), (2, 1.8)],
        speed=1.5,
        turn=0.9,
        time_step=0.4,
        radii=(0.4, 1.1),
        num_directions=5,
        strip=(-1.8, -1.0),
        weight=7.0,
        horizon=8,
    )


def is_in(box, x, y):
    return bool(box[0][0] <= x <= box[1][0] and box[0][1] <= y <= box[1][1])


def sense(world, x, y, heading, radii, num_directions):
    """Every point by its angle from ahead."""
    seen = []
    for r in radii:
        for k in range(num_directions):
            angle = heading + 2 * math.pi * k / num_directions
            px, py = x + r * math.cos(angle), y + r * math.sin(angle)
            seen.append(is_in(world.goal, px, py) - is_in(world.obstacle, px, py))
    centre = np.mean(world.goal, axis=0)
    bearing = math.atan2(centre[1] - y, centre[0] - x) - heading
    return [*seen, math.cos(bearing), math.sin(bearing)]


def follow(world, first, actions, absorbing):
    """The states that actions lead to from the first."""
    x, y, heading = first
    states = []
    for speed, turn in actions:
        states.append((x, y, heading))
        if absorbing and is_in(world.goal, x, y):
            continue
        way = float(world.speed * world.time_step) * speed
        x = min(max(x + way * math.cos(heading), world.bounds[0, 0]), world.bounds[1, 0])
        y = min(max(y + way * math.sin(heading), world.bounds[0, 1]), world.bounds[1, 1])
        heading = heading + float(world.turn) * turn
        heading = (heading + math.pi) % (2 * math.pi) - math.pi
    return states


def distance(box, x, y):
    """From the obstacle, by its nearest point or its nearest edge."""
    if is_in(box, x, y):
        return -min(x - box[0][0], box[1][0] - x, y - box[0][1], box[1][1] - y)
    return math.dist((x, y), np.clip((x, y), box[0], box[1]))


def judge(world, states, task):
    """Table 4 for one trajectory."""
    goal = [is_in(world.goal, x, y) for x, y, _ in states]
    crash = [is_in(world.obstacle, x, y) for x, y, _ in states]
    strip = [world.strip[0] <= y <= world.strip[1] for _, y, _ in states]
    earned = [
        1 if g else 2 * abs(s[1]) if inside else 0
        for g, s, inside in zip(goal, states, strip, strict=True)
    ]
    nearest = world.weight * min(distance(world.obstacle, x, y) for x, y, _ in states)
    objective = sum(earned) if task in (1, 4) else nearest
    cost = {1: -any(goal), 2: -any(goal), 3: -sum(goal), 4: -(any(goal) and not any(crash))}
    return objective, cost[task]


def random_states(world, count):
    low, high = world.bounds
    x, y = (RNG.uniform(low[i], high[i], count) for i in range(2))
    return State(*map(jnp.asarray, (x, y, RNG.uniform(-math.pi, math.pi, count))))


def random_policy(network, size=()):
    return jnp.asarray(0.6 * RNG.normal(size=(*size, network.num_parameters)))


@pytest.mark.parametrize(
    ("world", "radii", "count"),
    [(WORLD, (0.5, 1, 1.5, 2, 2.5), 12), (crowded(), (0.4, 1.1), 5)],
    ids=["default", "crowded"],
)
def test_the_sensor_against_every_point(world, radii, count):
    states = random_states(world, 300)
    seen = np.asarray(observe(world, states))
    assert seen.shape == (300, world.num_observations) == (300, count * len(radii) + 2)
    for row, state in zip(seen, zip(*states, strict=True), strict=True):
        np.testing.assert_allclose(row, sense(world, *map(float, state), radii, count), atol=1e-9)
    assert set(np.unique(seen[:, :-2])) == {-1, 0, 1}


def test_the_sensor_at_the_goals_centre():
    middle = State(*jnp.array([[2.0], [1.5], [0.3]]))
    assert observe(WORLD, middle)[0, -2:].tolist() == [0, 0]
    slope = jax.jit(jax.jacobian(lambda s: nav.observe(WORLD, s)))(middle)
    assert np.isfinite(np.stack(slope)).all()


def test_distances_labels_and_rewards_of_states():
    world = crowded()
    states = random_states(world, 400)
    holds = np.asarray(labels(world, states))
    far = np.asarray(obstacle_distance(world, states))
    earned = np.asarray(reward(world, states))
    for i, (x, y, _) in enumerate(zip(*map(np.asarray, states), strict=True)):
        assert holds[i].tolist() == [is_in(world.goal, x, y), is_in(world.obstacle, x, y)]
        assert abs(far[i] - distance(world.obstacle, x, y)) < 1e-12
        assert abs(earned[i] - judge(world, [(x, y, 0)], 4)[0]) < 1e-12
    slope = jax.jit(jax.grad(lambda s: nav.obstacle_distance(world, s).sum()))(states)
    np.testing.assert_allclose(np.hypot(slope.x, slope.y), 1, rtol=1e-9)
    assert holds.any(0).all() and (far < 0).any() and (earned > 1).any()


def test_moves_stop_at_the_bounds_and_shares_are_limited():
    corner = State(*jnp.array([3.9, 3.9, math.pi / 4]))
    assert [float(v) for v in move(WORLD, corner, jnp.array([1.0, 0.0]))[:2]] == [4, 4]
    middle = State(*jnp.array([0.0, 0.0, 0.0]))
    fast, most = (move(WORLD, middle, jnp.array(a)) for a in ([-9.0, 7.0], [-1.0, 1.0]))
    assert fast == most
    np.testing.assert_allclose([*most], [-0.5, 0, math.pi / 6])


@pytest.mark.few(2)
@pytest.mark.parametrize("absorbing", [False, True])
@pytest.mark.parametrize("world", [WORLD, crowded()], ids=["default", "crowded"])
def test_runs_against_a_plain_simulation(world, absorbing):
    network = policy_network(world, (6, 5)) if world is not WORLD else NETWORK
    stayed = turned = 0
    for seed in range(5):
        parameters = random_policy(network)
        run = simulate(
            jax.random.key(seed),
            world,
            network,
            parameters,
            num_trajectories=6,
            absorbing=absorbing,
        )
        assert run.state.x.shape == (6, world.horizon)
        np.testing.assert_allclose(
            run.action, act(world, network, parameters, run.state), atol=1e-9
        )
        found = np.stack(run.state, axis=-1)
        for states, actions in zip(found, np.asarray(run.action), strict=True):
            expected = follow(world, states[0], actions, absorbing)
            np.testing.assert_allclose(states[:, :2], np.array(expected)[:, :2], atol=1e-9)
            angle = states[:, 2] - np.array(expected)[:, 2]
            np.testing.assert_allclose(np.cos(angle), 1, atol=1e-12)
            stayed += (states[-1] == states[-2]).all()
            turned += np.abs(np.diff(states[:, 2])).max() > math.pi
        assert (found[..., 2] >= -math.pi).all() and (found[..., 2] < math.pi).all()
        inside = [is_in(world.initial, x, y) for x, y, _ in found[:, 0]]
        assert all(inside)
    if world is not WORLD:
        assert (stayed > 0) == absorbing
    assert turned, "headings went around"


def test_starts_are_uniform():
    states = nav.initial_states(jax.random.key(0), WORLD, (20_000,))
    box = [*zip(*WORLD.initial, strict=True), (-math.pi, math.pi)]
    for values, (low, high) in zip(states, box, strict=True):
        share = np.histogram(values, bins=10, range=(low, high))[0] / 20_000
        np.testing.assert_allclose(share, 0.1, atol=0.012)
    correlation = np.corrcoef(np.stack(states))
    assert np.abs(correlation - np.eye(3)).max() < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("task", nav.TASKS)
def test_tasks_against_table_4(task):
    world = crowded()
    network = policy_network(world, (6,))
    evaluate = evaluator(world, task, network, num_trajectories=7)
    costs, objectives = set(), set()
    for seed in range(12):
        parameters, key = random_policy(network), jax.random.key(seed)
        run = simulate(key, world, network, parameters, num_trajectories=7, absorbing=task == 1)
        found = np.stack(run.state, axis=-1)
        expected = [judge(world, states, task) for states in found]
        each = scores(world, run.state, task)
        np.testing.assert_allclose(np.stack(each, -1), expected, rtol=1e-10, atol=1e-10)
        means = evaluate(parameters, key)
        np.testing.assert_allclose(means, np.mean(expected, axis=0), rtol=1e-10, atol=1e-10)
        costs |= {c for _, c in expected}
        objectives |= {o for o, _ in expected}
    assert {0, -1} <= costs and len(objectives) > 20
    assert (min(costs) < -1) == (task == 3)


def test_the_limits_are_those_of_table_4():
    assert nav.LIMITS == {1: -0.5, 2: -0.5, 3: -5, 4: -0.5}


def test_staying_in_the_goal_is_worth_the_horizon():
    world = navigation(initial=[(1.6, 1.1), (2.4, 1.9)])
    network = policy_network(world)
    parameters = random_policy(network)
    objective, cost = evaluator(world, 1, network)(parameters, jax.random.key(0))
    assert (objective, cost) == (30, -1)
    assert evaluator(world, 3, network, absorbing=True)(parameters, jax.random.key(0))[1] == -30


@pytest.mark.slow
def test_batches_are_single_evaluations():
    evaluate = evaluator(WORLD, 2, num_trajectories=3)
    parameters = random_policy(NETWORK, (2, 3))
    keys = jax.random.split(jax.random.key(5), (2, 3))
    found = jax.jit(jax.vmap(jax.vmap(evaluate)))(parameters, keys)
    for place in np.ndindex(2, 3):
        alone = evaluate(parameters[place], keys[place])
        np.testing.assert_allclose([x[place] for x in found], alone, rtol=1e-9)
    assert len(np.unique(found[0])) == 6


def test_the_key_decides():
    world = crowded()
    network = policy_network(world, (6, 5))
    parameters = random_policy(network)
    one, again, other = (
        simulate(jax.random.key(s), world, network, parameters, num_trajectories=6)
        for s in (0, 0, 1)
    )
    np.testing.assert_array_equal(np.stack(one.state), np.stack(again.state))
    assert (np.stack(one.state) != np.stack(other.state)).any(0).all()


def test_new_worlds_do_not_retrace_and_precision_follows_the_parameters():
    parameters = random_policy(NETWORK, (2,)).astype(jnp.float32)
    keys = jax.random.split(jax.random.key(0), 2)
    population = jax.jit(lambda e, p, k: jax.vmap(e)(p, k))
    one = population(evaluator(WORLD, 2), parameters, keys)
    moved = navigation(obstacle=[(-1, 0), (1, 1)], speed=0.9)
    with counted_traces() as traced:
        two = population(evaluator(moved, 2), parameters, keys)
    assert not traced
    assert (one[0] != two[0]).all()
    assert {x.dtype for x in one} == {jnp.dtype("float32")}


def test_a_users_task_with_several_constraints():
    @jax.jit
    def rate(level, world, run):
        far = nav.obstacle_distance(world, run.state)
        return far.mean(-1), jnp.stack([(far < level).any(-1), run.action[..., 0].max(-1)], -1)

    near = jax.tree_util.Partial(rate, jnp.array(0.5))
    parameters, key = random_policy(NETWORK), jax.random.key(3)
    objective, cost = evaluator(WORLD, near, num_trajectories=4)(parameters, key)
    run = simulate(key, WORLD, NETWORK, parameters, num_trajectories=4)
    each, both = rate(0.5, WORLD, run)
    assert cost.shape == (2,)
    np.testing.assert_allclose(objective, each.mean(), rtol=1e-9)
    np.testing.assert_allclose(cost, both.mean(0), rtol=1e-9)


@pytest.mark.slow
def test_evaluations_are_differentiable_in_the_parameters():
    world = crowded()  # where some first states are in the obstacle
    network = policy_network(world, (4,))
    parameters, way = (0.1 * random_policy(network) for _ in range(2))

    evaluate = evaluator(world, 2, network, num_trajectories=3)
    objective = jax.jit(jax.value_and_grad(lambda p: evaluate(p, jax.random.key(0))[0]))

    step = 1e-6
    (more, _), (less, _), (_, slope) = (objective(parameters + t * way) for t in (step, -step, 0.0))
    np.testing.assert_allclose(slope @ way, (more - less) / (2 * step), rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"goal": [(1, 1), (0, 2)]}, "goal=.*the lower left one first"),
        ({"initial": [0, 1]}, "initial=.*give the corners"),
        ({"speed": 0.0}, "speed is 0.0; it must be positive"),
        ({"radii": ()}, "the least of radii is 0"),
        ({"radii": (1, -1)}, "the least of radii is -1"),
        ({"num_directions": 0}, "num_directions is 0"),
        ({"horizon": 0}, "horizon is 0"),
        ({"strip": (1, 0)}, "strip=.*the least and the largest y"),
    ],
)
def test_bad_worlds_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        navigation(**arguments)


def test_bad_evaluations_are_refused():
    with pytest.raises(ValueError, match="task=5; choose 1, 2, 3 or 4, or give a function"):
        evaluator(WORLD, 5)
    with pytest.raises(ValueError, match="task='reach'; choose"):
        nav.scores(WORLD, random_states(WORLD, 3), "reach")
    with pytest.raises(ValueError, match="has 62 observations"):
        evaluator(WORLD, 1, make_network("60-2"))
    with pytest.raises(ValueError, match="num_trajectories=0; it must be at least 1"):
        evaluator(WORLD, num_trajectories=0)
    with pytest.raises(ValueError, match="62-30-30-2 with biases has 2882 parameters"):
        evaluator(WORLD)(jnp.zeros(2880), jax.random.key(0))
