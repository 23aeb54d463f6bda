"""Certified values of controllers, and shields on supports, against simulation that uses neither."""

import numpy as np
import pytest

from jaxltl.core.values.partial_observability.solve import belief_bounds
from jaxltl.core.values.partial_observability.supports import support_shield

from .reference import random_pomdp

STEPS = 300  # of an episode


def next_states(rng, cumulative, state, action):
    return (rng.random(state.size)[:, None] >= cumulative[state, action]).sum(1)


def frequencies(pomdp, table, policy, target, episodes, seed=0):
    """Shares of episodes that reach the target, and that neither reach it nor the sink."""
    rng = np.random.default_rng(seed)
    table = table.copy()
    cumulative = table.cumsum(-1)[..., :-1]
    seen = np.asarray(pomdp.observation)
    initial, update = np.asarray(policy.initial_memory), np.asarray(policy.next_memory)
    weight = np.asarray(policy.action)
    if weight.ndim == 2:
        weight = np.eye(table.shape[1])[weight]
    state = rng.choice(len(table), size=episodes, p=np.asarray(pomdp.initial, float))
    memory = initial[seen[state]]
    reached = np.zeros(episodes, bool)
    done = np.zeros(episodes, bool)
    for _ in range(STEPS):
        share = weight[seen[state], memory].cumsum(-1)[:, :-1]
        action = (rng.random(episodes)[:, None] >= share).sum(1)
        state = next_states(rng, cumulative, state, action)
        memory = update[seen[state], memory]
        reached |= state == target
        done = reached | (state == len(table) - 1)
        if done.all():
            break
        state = np.where(done, len(table) - 1, state)
    return reached.mean(), (~done).mean()


def check_frequency(seed, objective, episodes):
    sizes = {"num_states": 4 + seed % 3, "num_observations": 1 + seed // 3 % 3}
    pomdp, table = random_pomdp(seed, **sizes)
    target = len(table) - 2
    answer = belief_bounds(pomdp, "goal", objective=objective, max_beliefs=100)
    share, rest = frequencies(pomdp, table, answer.policy, target, episodes)
    width = np.sqrt(np.log(2e6) / (2 * episodes))  # Hoeffding's, of confidence 1 - 1e-6
    assert share - width <= float(answer.value) <= share + rest + width, (seed, objective)


@pytest.mark.parametrize("objective", ["max", "min"])
def test_values_of_controllers_agree_with_episodes(objective):
    for seed in (4,):
        check_frequency(seed, objective, 20_000)


@pytest.mark.exhaustive
@pytest.mark.parametrize("objective", ["max", "min"])
def test_values_of_many_controllers_agree_with_episodes(objective):
    for seed in range(10):
        check_frequency(seed, objective, 100_000)


def shielded_violations(pomdp, table, shield, robots, steps):
    """Steps into the sink of robots that follow supports and take allowed actions at random."""
    seen, number = np.asarray(pomdp.observation), {s: i for i, s in enumerate(shield.supports)}
    goal = len(table) - 2
    after = {}
    for i, support in enumerate(shield.supports):
        for a in np.flatnonzero(shield.allowed[i]):
            reached = np.flatnonzero(table[list(support), a].any(0))
            for o in np.unique(seen[reached]):
                states = tuple(s for s in reached.tolist() if seen[s] == o and s != goal)
                after[i, int(a), int(o)] = number.get(states, -1)
    moves = np.full((len(number), table.shape[1], seen.max() + 1), -1)
    for key, value in after.items():
        moves[key] = value
    rng, cumulative = np.random.default_rng(0), table.cumsum(-1)[..., :-1]
    start = np.asarray(pomdp.initial, float)
    begins = rng.choice(len(table), size=robots, p=start)
    first = {int(seen[shield.supports[i][0]]): int(i) for i in shield.initial}
    state, support = begins, np.array([first[o] for o in seen[begins].tolist()])
    violations = taken = 0
    for _ in range(steps):
        choice = rng.random((robots, table.shape[1])) * shield.allowed[support]
        action = choice.argmax(1)
        assert (choice.max(1) > 0).all()
        state = next_states(rng, cumulative, state, action)
        taken += robots
        violations += int((state == len(table) - 1).sum())
        support = moves[support, action, seen[state]]
        over = state == goal  # episodes end at the target, and begin again
        fresh = rng.choice(len(table), size=int(over.sum()), p=start)
        state[over] = fresh
        support[over] = [first[o] for o in seen[fresh].tolist()]
        assert (support >= 0).all()
    return violations, taken


def check_shield(robots, steps, seeds):
    taken = 0
    for seed in seeds:
        pomdp, table = random_pomdp(seed)
        shield = support_shield(pomdp, "goal", safe="!sink")
        if shield.is_winning:
            violations, number = shielded_violations(pomdp, table, shield, robots, steps)
            assert violations == 0
            taken += number
    return taken


def test_no_violation_inside_the_shield():
    assert check_shield(100, 50, range(30)) >= 10**4


@pytest.mark.exhaustive
def test_no_violation_in_a_million_steps():
    assert check_shield(1000, 500, range(12)) >= 10**6
