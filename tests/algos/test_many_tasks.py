"""One agent for many formulas: the network, the plans, and the agent that follows them."""

from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.algos import many_tasks, ppo
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.environment import Timestep, make_box, make_environment
from jaxltl.core.environments.episodes import run_episode
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.environments.sequence_task import Sequence, SequenceObservation, make_events
from jaxltl.core.environments.tabulate import tabulate
from jaxltl.core.environments.task_environment import stack_tasks, task_environment
from jaxltl.core.values.evaluation.optimality_gap import optimality_gap, tabulate_policy
from jaxltl.envs.flat_world import flat_world
from jaxltl.envs.letter_world import events_seen, letter_world

MAX_PROGRAMS = 450  # that the default tests compile at most

NAMES = ("a", "b", "c")
EVENTS = make_events(NAMES)
WORLD = letter_world(size=4, letters=NAMES, num_copies=1, horizon=30)
DEPTH = 3
TASKS = ("F(a & F b)", "!a U b", "F(a & F c) & F b", "(!c U (b & F c)) & F a")


def way(grid, wanted, avoided):
    """Steps to a wanted cell across cells that are not avoided, from each cell of a torus."""

    def nearer(_, far):
        near = jnp.minimum(
            jnp.minimum(jnp.roll(far, 1, 0), jnp.roll(far, -1, 0)),
            jnp.minimum(jnp.roll(far, 1, 1), jnp.roll(far, -1, 1)),
        )
        return jnp.where(wanted, 0.0, jnp.where(avoided, 99.0, jnp.minimum(far, near + 1)))

    return jax.lax.fori_loop(0, 16, nearer, jnp.where(wanted, 0.0, 99.0))


def knowing(observation):
    """What a network would say that had learned everything: shortest ways, step after step."""
    seen, (reach, avoid, _) = observation
    cells = events_seen(seen)
    middle = (cells.shape[0] // 2,) * 2
    told = [(cells @ row.astype(float)) > 0.5 for row in (reach[0], avoid[0])]
    far = way(cells, *told)
    move = [(-1, 0), (1, 0), (0, -1), (0, 1)]
    # A first step must be made, also where one stands on what is wanted.
    ahead = jnp.stack([far[middle[0] + i, middle[1] + j] for i, j in move])
    where = jnp.stack([told[1][middle[0] + i, middle[1] + j] for i, j in move])
    ahead = jnp.where(where, 99.0, ahead)
    return -10.0 * ahead, -jnp.min(ahead) - 4.0 * reach[1:].any(-1).sum()


def episodes(environment, agent, keys):
    def one(key):
        return run_episode(key, environment, agent, num_steps=30)

    return jax.vmap(one)(keys)


@pytest.fixture(scope="module")
def plans():
    return [
        many_tasks.make_plan(task, EVENTS, NAMES, depth=DEPTH, max_sequences=6) for task in TASKS
    ]


@pytest.fixture(scope="module")
def verdicts(plans):
    """Of all tasks in one program: ``int[N, M]``."""
    worlds = stack_tasks([task_environment(WORLD, task) for task in TASKS])
    keys = jax.random.split(jax.random.key(0), 64)

    def run(environment, plan):
        agent = many_tasks.sequence_agent(knowing, plan, sampled=False)
        return episodes(environment, agent, keys).world.verdict[:, -1]

    return np.asarray(jax.jit(jax.vmap(run))(worlds, many_tasks.stack_plans(plans)))


@pytest.mark.slow
def test_who_follows_what_is_asked_for_does_formulas_that_nobody_trained(verdicts):
    assert (verdicts == Verdict.SATISFIED).mean(1).min() > 0.95
    assert not (verdicts == Verdict.VIOLATED).any()


@pytest.mark.slow
def test_a_lane_of_stacked_plans_is_the_plan(plans, verdicts):
    agent = many_tasks.sequence_agent(knowing, plans[1], sampled=False)
    alone = jax.jit(lambda keys: episodes(task_environment(WORLD, TASKS[1]), agent, keys))(
        jax.random.split(jax.random.key(0), 64)
    )
    assert (np.asarray(alone.world.verdict[:, -1]) == verdicts[1]).all()


def test_the_certified_gap_of_an_agent_that_knows_is_small(plans):
    fixed = letter_world(layout="a...\n....\n..b.\n...c", letters=NAMES, horizon=30)
    table, automaton = tabulate(fixed), to_automaton(TASKS[0])
    policy = jax.tree_util.Partial(many_tasks.sequence_policy, knowing_network(), plans[0])
    acts = tabulate_policy(policy, fixed, table, len(automaton.delta))
    found = optimality_gap(table, automaton, acts)
    assert found.mean_optimum == (1.0, 1.0)
    assert found.mean[1] < 1e-3


def knowing_network():
    return jax.tree_util.Partial(knowing)


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", ["finite", "box"])
def test_names_of_events_have_gone_where_the_network_sees_them(kind):
    size = {"num_actions": 4} if kind == "finite" else {"shape": (2,)}
    network = many_tasks.SequenceNetwork(events_seen=events_seen, hidden=(8,), detailed=2, **size)
    rng = np.random.default_rng(0)
    letters = np.eye(5)[rng.integers(0, 5, (4, 4))][..., :3]
    seen = np.concatenate([letters, np.zeros((4, 4, 1))], -1)
    rows = rng.random((2, DEPTH, 4)) < 0.4
    order = np.array([2, 0, 1])
    swapped = np.concatenate([letters[..., order], seen[..., 3:]], -1)

    def told(seen, rows):
        return SequenceObservation(jnp.asarray(seen), Sequence(*jnp.asarray(rows), jnp.int32(3)))

    parameters = network.init(jax.random.key(0), told(seen, rows))["params"]
    one = many_tasks.trained(network, parameters)(told(seen, rows))
    other = many_tasks.trained(network, parameters)(
        told(swapped, rows[..., np.concatenate([[0], 1 + order])])
    )
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=1e-6), one, other)
    third = many_tasks.trained(network, parameters)(told(swapped, rows))
    assert abs(np.asarray(third[1]) - np.asarray(one[1])) > 1e-6


def test_without_it_the_events_are_embedded():
    network = many_tasks.SequenceNetwork(num_actions=3, hidden=(8,), embedding=5)
    rows = jnp.ones((2, DEPTH, 4), bool)
    seen = SequenceObservation(jnp.ones(2), Sequence(*rows, jnp.int32(2)))
    parameters = network.init(jax.random.key(0), seen)["params"]
    assert parameters["events"]["kernel"].shape == (8, 5)
    assert parameters["hidden_0"]["kernel"].shape[0] == 2 + DEPTH * 5 + DEPTH
    scores, value = many_tasks.trained(network, parameters)(seen)
    assert scores.shape == (3,) and value.shape == ()


def test_both_are_told_where_asked_for():
    network = many_tasks.SequenceNetwork(
        num_actions=3, hidden=(8,), embedding=5, detailed=2, by_name=True, events_seen=four_places
    )
    rows = jnp.ones((2, DEPTH, 4), bool)
    seen = SequenceObservation(jnp.ones(2), Sequence(*rows, jnp.int32(2)))
    parameters = network.init(jax.random.key(0), seen)["params"]
    width = 2 + DEPTH * 5 + 4 * 2 * 2 + 2 * DEPTH + DEPTH
    assert parameters["hidden_0"]["kernel"].shape[0] == width


def four_places(observation):
    return jnp.ones((4, 4)) * observation[0]


def test_an_agent_keeps_to_what_it_has_taken_up():
    plan = many_tasks.make_plan("F a & F b", EVENTS, NAMES, depth=DEPTH)
    worth = jnp.array([0.0, 1.0])

    def fickle(observation):
        first_is_a = observation.sequence.reach[0, 1]
        value = jnp.where(first_is_a, observation.world[0], 1 - observation.world[0])
        return jnp.where(first_is_a, jnp.array([5.0, 0.0]), jnp.array([0.0, 5.0])), value

    agent = many_tasks.sequence_agent(fickle, plan, sampled=False)
    initial = to_automaton("F a & F b").initial
    memory, taken = agent.memory, []
    for value in worth:
        seen = SimpleNamespace(world=value[None], memory=jnp.eye(len(plan.length))[initial])
        action, memory = agent.act(memory, seen, None, jax.random.key(0))
        taken.append(int(action))
    assert taken == [1, 1]


def test_what_is_worth_more_than_the_choice_has_been_is_taken_up():
    """Not at once where the choice becomes worth less, but soon."""
    plan = many_tasks.make_plan("F a & F b", EVENTS, NAMES, depth=DEPTH)

    def said(observation):
        first_is_a = observation.sequence.reach[0, 1]
        return (
            jnp.where(first_is_a, jnp.array([5.0, 0.0]), jnp.array([0.0, 5.0])),
            jnp.where(first_is_a, *observation.world),
        )

    agent = many_tasks.sequence_agent(said, plan, sampled=False)
    initial = to_automaton("F a & F b").initial
    memory, taken = agent.memory, []
    for values in [(0.5, 0.4), (0.9, 0.1), (0.2, 0.45), (0.3, 0.6), *3 * [(0.55, 0.1)]]:
        seen = SimpleNamespace(world=jnp.array(values), memory=jnp.eye(len(plan.length))[initial])
        action, memory = agent.act(memory, seen, None, jax.random.key(0))
        taken.append(int(action))
    assert taken == [0, 0, 0, 1, 1, 1, 0]


def one_state_plan():
    """Of an automaton with one state and one sequence."""
    reach = np.array([[[[False, True]]]])
    return many_tasks.SequencePlan(reach, ~reach, np.array([[1]], np.int32))


def test_masks_are_kept():
    scores, allowed = jnp.array([9.0, 0.0, -99.0]), jnp.array([False, True, True])
    seen = SimpleNamespace(world=jnp.zeros(1), memory=jnp.ones(1))
    for sampled in (False, True):
        agent = many_tasks.sequence_agent(
            lambda observation: (scores, 0.0), one_state_plan(), sampled=sampled
        )
        assert int(agent.act(agent.memory, seen, allowed, jax.random.key(0))[0]) == 1


def test_boxes_and_finite_actions_do_the_same():
    """One mind in the flat world, which says which of nine velocities it takes, or the velocity."""
    scene = (("a", -0.3, 0.0, 0.2), ("b", 0.5, 0.1, 0.2), ("c", 0.0, -0.8, 0.1))
    velocities = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)], np.float32)

    def mind(observation):
        place, (reach, _, _) = observation
        apart = jnp.linalg.norm(jnp.array([x[1:3] for x in scene]) - place, axis=-1)
        wanted = jnp.where(reach[0, 1:], apart, 9.0).argmin()
        after = place + 0.08 * velocities - jnp.array([x[1:3] for x in scene])[wanted]
        return jnp.linalg.norm(after, axis=-1).argmin(), -apart[wanted]

    def finite(observation):
        move, value = mind(observation)
        return jnp.where(jnp.arange(9) == move, 0.0, -99.0), value

    def boxed(observation):
        move, value = mind(observation)
        return (jnp.asarray(velocities)[move] * 5, jnp.zeros(2)), value  # clipped to the box

    told = []
    for network, discrete in ((finite, True), (boxed, False)):
        world = flat_world(discs=scene, initial=(-0.8, 0.6), discrete=discrete)
        plan = many_tasks.make_plan("F a & F b", EVENTS, NAMES, depth=DEPTH)
        task = task_environment(world, "F a & F b")
        agent = many_tasks.sequence_agent(network, plan, actions=world.actions, sampled=False)

        def go(carry, key, task=task, agent=agent):
            now, memory = carry
            action, memory = agent.act(memory, task.observe(now), None, key)
            found = task.step(now, action, key)
            return (found.world, memory), (found.world.world[0].place, memory, found.world.verdict)

        told.append(
            jax.jit(
                lambda keys, go=go, task=task, agent=agent: jax.lax.scan(
                    go, (task.reset(keys[0]), agent.memory), keys
                )[1]
            )(jax.random.split(jax.random.key(1), 28))
        )
    for one, other in zip(*map(jax.tree.leaves, told), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)
    assert told[0][2][-1] == Verdict.SATISFIED and len(set(told[0][1].state.tolist())) >= 2


@pytest.mark.slow
@pytest.mark.parametrize("squash", ["clip", "tanh"])
def test_a_network_of_ppo_does_the_same_with_boxes(squash):
    """Scaled to its box, clipped or squashed, by normalised observations, as it was trained."""
    space = make_box(jnp.array([0.0, -3.0]), jnp.array([10.0, 5.0]))
    told = one_state_plan()
    sequence = Sequence(told.reach[0, 0], told.avoid[0, 0], jnp.int32(1))
    world = make_environment(
        lambda key: jax.random.uniform(key, (3,)),
        lambda place, action, key: Timestep(place + action.sum(), action.sum(), False),
        lambda place: SequenceObservation(place, jax.tree.map(jnp.asarray, sequence)),
        actions=space,
    )
    problem = ppo.make_problem(world)
    hparams = ppo.Hparams(
        discount=0.9,
        num_envs=2,
        num_steps=4,
        num_minibatches=1,
        squash=squash,
        normalize_observation=True,
    )
    state, _ = ppo.train(jax.random.key(1), problem, hparams, num_steps=2)
    network = many_tasks.trained(problem.network, state.parameters, state.moments)
    here = jnp.array([0.3, 40.0, -2.0])
    seen = SimpleNamespace(world=here, memory=jnp.ones(1))
    ends = []
    for sampled, of in ((True, ppo.policy), (False, ppo.greedy)):
        own = of(state, problem, hparams)
        other = many_tasks.sequence_agent(
            network, told, actions=space, squash=squash, sampled=sampled
        )
        act = jax.jit(
            jax.vmap(
                lambda key, own=own: own.act(
                    own.memory, SequenceObservation(here, sequence), None, key
                )[0]
            )
        )
        same = jax.jit(
            jax.vmap(lambda key, other=other: other.act(other.memory, seen, None, key)[0])
        )
        keys = jax.random.split(jax.random.key(2), 64)
        np.testing.assert_allclose(same(keys), act(keys), rtol=1e-6)
        ends.append(np.asarray(same(keys)))
    assert (ends[0] >= [0, -3]).all() and (ends[0] <= [10, 5]).all() and ends[0].std(0).min() > 0.5
    with pytest.raises(ValueError, match="actions=None, but the network returns a Gaussian"):
        agent = many_tasks.sequence_agent(network, told)
        agent.act(agent.memory, seen, None, jax.random.key(0))


class Figures(NamedTuple):
    """Metrics of a stub of a learner."""

    episode_return: np.ndarray
    episodes: np.ndarray


def test_stages_follow_when_one_is_mastered():
    seen = []

    def run(state, problem, hparams, *, num_steps):
        seen.append(problem)
        mean = [0.5, 0.95, 0.2, 0.85, 0.99][state]
        return state + 1, Figures(np.array([mean, np.nan]), np.array([3, 0]))

    found = many_tasks.train_in_stages(
        jax.random.key(0),
        "xyz",
        None,
        init=lambda *given: 0,
        run=run,
        num_chunks=5,
        enough=[0.9, 0.8],
    )
    assert seen == ["x", "x", "y", "y", "z"] == ["xyz"[i] for i in found.stages]
    assert found.state == 5 and len(found.metrics) == 5 and (np.diff(found.seconds) >= 0).all()


def test_bad_input_is_named(plans):
    with pytest.raises(ValueError, match="one threshold fewer"):
        many_tasks.train_in_stages(
            jax.random.key(0), "xy", None, init=len, run=len, num_chunks=1, enough=[1, 2]
        )
    with pytest.raises(ValueError, match="all of one depth"):
        many_tasks.stack_plans([])
    deeper = many_tasks.make_plan(TASKS[0], EVENTS, NAMES, depth=DEPTH + 1)
    with pytest.raises(ValueError, match="all of one depth"):
        many_tasks.stack_plans([plans[0], deeper])
    with pytest.raises(ValueError, match="mentions the proposition 'x'"):
        many_tasks.make_plan("F x", EVENTS, NAMES, depth=DEPTH)
