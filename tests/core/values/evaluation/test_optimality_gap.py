"""Certified gaps against a recursion over the steps, a search by a queue, and simulation."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from jaxltl.algos import ppo
from jaxltl.core.automata.automaton import accepts_lasso, letter_index
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.environment import Timestep, make_environment
from jaxltl.core.environments.episodes import Agent, run_episode, with_time_limit
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.environments.tabulate import tabulate
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.values.evaluation.optimality_gap import optimality_gap, tabulate_policy
from jaxltl.envs.letter_world import letter_world

S, A, K = 7, 2, 3
TASKS = ("F (one & F zero)", "!one U zero", "F zero & (G !one | F (one & X zero))", "G !one")


def process(seed, over):
    """A random world of a few states, and its arrays; it ends where `over` says."""
    random = np.random.default_rng(seed)
    probability = random.dirichlet(np.ones(K), (S, A))
    successor = random.integers(S, size=(S, A, K))
    initial = np.array([0.5, 0.3, 0.2, 0, 0, 0, 0])
    over = np.asarray(over)

    def at(state, action):
        found = jnp.asarray(successor)[state, action]
        kind = jnp.asarray(over)[found]
        return Timestep(found, jnp.zeros(K), kind == 1, kind == 2), (
            jnp.asarray(probability)[state, action]
        )

    def step(state, action, key):
        found, chance = at(state, action)
        k = jax.random.categorical(key, jnp.log(chance))
        return Timestep(*(x[k] for x in found[:4]))

    world = make_environment(
        lambda key: jax.random.choice(key, S, p=jnp.asarray(initial)),
        step,
        lambda x: x / S,
        actions=A,
        labels=lambda x: x % 3 == jnp.arange(2),
        propositions=["zero", "one"],
        starts=lambda: (jnp.arange(S), jnp.asarray(initial)),
        outcomes=at,
    )
    return world, successor, probability, over


def reference(arrays, task, num_steps, policy):
    """``float[S]``, by recursion over (state, memory, steps left); no policy: the best."""
    successor, probability, over = arrays
    automaton = to_automaton(task)
    decided = verdicts(automaton)

    def shown(state):
        held = {name for i, name in enumerate(("zero", "one")) if state % 3 == i}
        return held & set(automaton.propositions)

    def read(memory, state):
        return int(automaton.delta[memory, letter_index(automaton, shown(state))])

    def lasts(memory, state):
        lasso = replace(automaton, initial=memory)
        return accepts_lasso(lasso, [], [shown(state)])

    @cache
    def value(state, memory, left, kind):
        if decided[memory] == Verdict.SATISFIED:
            return 1.0
        if kind == 1:
            return float(lasts(memory, state))
        if left == 0 or kind == 2:
            return 0.0
        each = [
            sum(
                p * value(int(t), read(memory, int(t)), left - 1, int(over[t]))
                for t, p in zip(successor[state, a], probability[state, a], strict=True)
            )
            for a in range(A)
        ]
        return max(each) if policy is None else float(policy[state, memory] @ each)

    starts = [(s, read(int(automaton.initial), s)) for s in range(3)]
    for left in range(0, num_steps, 20):  # so that the recursion is never deep
        for start in starts:
            value(*start, left, 0)
    return [value(*start, num_steps, 0) for start in starts]


def on_table(table, policy):
    """A policy on states, on the table's."""
    return policy[np.asarray(table.world)]


@pytest.mark.few(2)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["stochastic", "deterministic"])
def test_bounds_enclose_the_recursion(seed, kind):
    world, *arrays = process(
        seed, np.array([0, 0, 0, 0, 0, 1, 2])[np.random.default_rng(seed + 9).permutation(S)]
    )
    table = tabulate(world)
    task = TASKS[seed]
    num_memory = len(to_automaton(task).delta)
    random = np.random.default_rng(seed)
    policy = random.dirichlet(np.ones(A), (S, num_memory))
    given = policy
    if kind == "deterministic":
        given = random.integers(A, size=(S, num_memory))
        policy = np.eye(A)[given]
    for steps in (0, 1, 4, 30):
        found = optimality_gap(table, task, on_table(table, given), num_steps=steps)
        order = np.argsort(np.asarray(table.world)[found.start])
        for solution, by in ((found.value, policy), (found.optimum, None)):
            expected = np.array(reference(arrays, task, steps, by))
            low, high = np.asarray(solution.lower)[order], np.asarray(solution.upper)[order]
            assert (low - 1e-14 <= expected).all() and (expected <= high + 1e-14).all()
            assert (high - low <= 1e-9).all()
        best, own = (np.array(reference(arrays, task, steps, x)) for x in (None, policy))
        assert (found.lower[order] - 1e-14 <= best - own).all()
        assert (best - own <= found.upper[order] + 1e-14).all()
        mean = found.weight[order] @ (best - own)
        assert found.mean[0] - 1e-14 <= mean <= found.mean[1] + 1e-14
        assert found.weight[order].tolist() == pytest.approx([0.5, 0.3, 0.2])


def test_what_is_cut_off_goes_on_no_more_and_what_has_ended_stays():
    task = "F (zero & X zero)"
    policy = np.full((S, len(to_automaton(task).delta), A), 0.5)
    values = []
    for kind in (1, 2):
        over = np.where(np.arange(S) % 3 == 0, kind, 0)
        world, *arrays = process(2, over)
        table = tabulate(world)
        found = optimality_gap(table, task, on_table(table, policy), num_steps=20)
        expected = np.array(reference(arrays, task, 20, policy))
        order = np.argsort(np.asarray(table.world)[found.start])
        assert np.abs(np.asarray(found.value.value)[order] - expected).max() < 1e-9
        values.append(found.mean_value[1])
    assert values[0] > values[1] + 0.2


def test_the_best_of_letters_is_a_shortest_way():
    world = letter_world(size=4, letters=3, num_copies=2, connected=False)
    drawn = jax.vmap(world.reset)(jax.random.split(jax.random.key(0), 20))
    table = tabulate(world, worlds=drawn)
    task = "F (a & F (b & F c)) & (!c U a)"
    automaton = to_automaton(task)
    decided = verdicts(automaton)
    policy = np.zeros((table.model.num_states, len(decided)), int)
    by_steps = [optimality_gap(table, task, policy, num_steps=n).optimum for n in range(16)]
    first = np.sum([np.asarray(x.value) == 0 for x in by_steps], axis=0)
    assert all(((x.lower == x.upper) & np.isin(x.value, (0, 1))).all() for x in by_steps)
    for n, (letter, place) in enumerate(zip(*drawn[0], strict=True)):
        assert first[n] == shortest(np.asarray(letter), int(place), automaton, decided)


def shortest(letter, place, automaton, decided):
    """Steps until the task is done, by a queue; 16 for more or never."""

    def read(memory, cell):
        shown = {"abc"[letter[cell]]} if letter[cell] < 3 else set()
        return int(automaton.delta[memory, letter_index(automaton, shown)])

    layer = {(place, read(int(automaton.initial), place))}
    seen = set(layer)
    for steps in range(16):
        if any(decided[q] == Verdict.SATISFIED for _, q in layer):
            return steps
        follow = set()
        for cell, q in layer:
            row, column = divmod(cell, 4)
            for i, j in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                after = (row + i) % 4 * 4 + (column + j) % 4
                follow.add((after, read(q, after)))
        layer = follow - seen
        seen |= layer
    return 16


@pytest.mark.slow
def test_a_network_is_what_it_does_in_its_tasks_environment():
    world = letter_world(layout="a . .\n. b .\n. . a", letters=2, horizon=8)
    task = "!a U b"
    count = len(to_automaton(task).delta)
    weight = jax.random.normal(jax.random.key(3), (27, 4))

    def network(weight, observation, memory):
        return jax.nn.softmax(2 * observation.ravel() @ weight + memory * weight[0])

    table = tabulate(world)
    policy = tabulate_policy(Partial(network, weight), world, table, count)
    assert policy.shape == (9, count, 4)
    found = optimality_gap(table, task, policy)
    joint = task_environment(world, task)

    def act(memory, observation, allowed, key):
        at = jnp.argmax(observation.memory)
        return jax.random.categorical(key, jnp.log(network(weight, observation.world, at))), memory

    def success(key):
        episode = run_episode(key, joint, Agent(act), num_steps=8)
        return episode.world.verdict[-1] == Verdict.SATISFIED

    share = jax.vmap(success)(jax.random.split(jax.random.key(2), 10_000)).mean()
    assert abs(share - found.mean_value[0]) < 4.5 * 0.5 / 100
    assert 0.2 < found.mean_value[0] < 0.9 and found.mean_optimum == (1, 1)
    assert found.evidence == table.evidence == "declared"


@pytest.mark.slow
def test_without_a_limit():
    world, *arrays = process(1, np.zeros(S, int))
    table = tabulate(world)
    policy = np.random.default_rng(0).dirichlet(np.ones(A), (S, 3))
    found = optimality_gap(table, TASKS[0], on_table(table, policy)[:, :3])
    for solution, by in ((found.value, policy), (found.optimum, None)):
        expected = np.array(reference(arrays, TASKS[0], 400, by))
        order = np.argsort(np.asarray(table.world)[found.start])
        assert np.abs(np.asarray(solution.value)[order] - expected).max() < 1e-6
        assert (np.asarray(solution.upper)[order] >= expected - 1e-14).all()
    always = optimality_gap(table, "G F zero", np.full((S, 1, A), 0.5))
    assert always.mean[1] <= 1 and (always.lower >= 0).all()


def test_what_does_not_fit_is_named():
    world, *_ = process(1, [0, 0, 0, 0, 0, 0, 2])
    table = tabulate(world)
    count = table.model.num_states
    with pytest.raises(ValueError, match=r"expected actions int\["):
        optimality_gap(table, TASKS[1], np.zeros((count, 9), int), num_steps=3)
    with pytest.raises(ValueError, match=r"in state . with memory . .* probability 0.8"):
        optimality_gap(table, TASKS[1], np.full((count, 3, A), 0.4), num_steps=3)
    with pytest.raises(ValueError, match="probability nan in sum"):
        optimality_gap(table, TASKS[1], np.full((count, 3, A), np.nan), num_steps=3)
    with pytest.raises(ValueError, match="cuts episodes off"):
        optimality_gap(table, TASKS[1], np.full((count, 3, A), 0.5))


@pytest.mark.few(1)
@pytest.mark.parametrize("sampled", [True, False])
def test_a_learned_agent_is_tabulated_as_it_acts(sampled):
    """Of a PPO agent in the environment of its task: its probabilities, or its likeliest actions."""
    corridor = make_environment(
        lambda key: jnp.int32(2),
        lambda at, action, key: Timestep(jnp.clip(at + 2 * action - 1, 0, 4), 0.0, False),
        lambda at: at[None] / 4,
        actions=2,
        labels=lambda at: at == jnp.array([0, 4]),
        propositions=["a", "b"],
    )
    task, table = task_environment(with_time_limit(corridor, 9), "F (a & F b)"), tabulate(corridor)
    count = len(to_automaton("F (a & F b)").delta)
    problem = ppo.make_problem(task)
    hparams = ppo.Hparams(discount=0.9, num_envs=2, num_steps=2, num_minibatches=1)
    state = ppo.init(jax.random.key(0), problem, hparams)
    agent = (ppo.policy if sampled else ppo.greedy)(state, problem, hparams)
    found = tabulate_policy(agent, task, table, count)
    assert found.shape == (5, count, 2)
    np.testing.assert_allclose(found.sum(-1), 1, rtol=1e-5)
    keys = jax.random.split(jax.random.key(2), 4000)
    world = task.reset(jax.random.key(1))
    for place in range(5):
        seen = task.observe(world._replace(world=(jnp.int32(place), jnp.int32(0))))
        acts = jax.vmap(lambda key, seen=seen: agent.act((), seen, None, key)[0])(keys)
        row = found[np.asarray(table.world).tolist().index(place), int(world.memory)]
        np.testing.assert_allclose(float(acts.mean()), row[1], atol=0.04)
    assert optimality_gap(table, "F (a & F b)", found).mean[1] >= 0
    with pytest.raises(ValueError, match="no task; if the agent was trained in task_environment"):
        tabulate_policy(agent, corridor, table, count)


def test_an_agent_with_memory_is_refused():
    world = letter_world(layout="a .\n. b", letters=2, horizon=8)
    agent = Agent(lambda memory, *rest: (0, memory), memory=jnp.zeros(3))
    with pytest.raises(ValueError, match="policy is an Agent with a memory"):
        tabulate_policy(agent, world, tabulate(world), 2)
