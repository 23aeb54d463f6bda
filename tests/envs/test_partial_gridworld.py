"""Gridworlds of which a robot sees its neighbourhood, beliefs about them, and small controllers."""

import jax
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.envs import partial_gridworld
from jaxltl.envs.text_map import parse_map

TWO_ROOMS = """
# # # # # # # # # # # # #
# g . . . x # x . . . g #
# # # . # # # # # . # # #
# # o . o # # # o . o # #
# # # . # # # # # . # # #
# . . . a # # # . . . b #
# # # # # # # # # # # # #
"""
FORMULA = "!(x | o) U g"


@pytest.fixture(scope="module")
def rooms():
    return partial_gridworld(
        TWO_ROOMS, hidden=["g", "x"], slip=0.1, absorbing=["x", "o"], initial="!x & !o & !g"
    )


@pytest.fixture(scope="module")
def answer(rooms):
    return jl.optimal_satisfaction(rooms, FORMULA)


def _window(text, state, hidden=""):
    cells = np.pad(parse_map(text), 1, constant_values="#")
    row, column = np.divmod(state, cells.shape[1] - 2)
    return "".join(cells[row : row + 3, column : column + 3].ravel()).translate(
        str.maketrans(hidden, "." * len(hidden))
    )


def test_states_are_alike_exactly_if_their_windows_are(rooms):
    floor = np.flatnonzero(parse_map(TWO_ROOMS).ravel() != "#")
    seen = {s: _window(TWO_ROOMS, s, "gx") for s in floor.tolist()}
    observation = np.asarray(rooms.observation)
    for s in seen:
        for t in seen:
            assert (observation[s] == observation[t]) == (seen[s] == seen[t])
    walls = np.delete(observation, floor)
    assert np.unique(walls).size == 1 and walls[0] not in observation[floor]


def test_what_is_sensed_is_named_in_observables():
    world = partial_gridworld("# # # #\n. . . b\n# . # .", ["b", "wall"])
    names = ["b", "wall up", "wall down", "wall left", "wall right"]
    assert list(world.observables) == names
    table = np.stack([world.observables[name] for name in names], 1)
    row = table[np.asarray(world.observation)[4:8]].tolist()
    assert row == [[0, 1, 1, 1, 0], [0, 1, 0, 0, 0], [0, 1, 1, 0, 0], [1, 1, 0, 0, 1]]


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ({"observations": 2}, "observations"),
        ({"observations": 0}, "observations"),
        ({"observations": ["walls"]}, "walls"),
        ({"observations": []}, "observations"),
        ({"hidden": ["q"]}, "hidden"),
        ({"observations": ["wall"], "hidden": ["a"]}, "hidden"),
    ],
)
def test_observations_that_do_not_exist_are_refused(options, name):
    with pytest.raises(ValueError, match=name):
        partial_gridworld("a . b", **options)


def test_a_wall_of_a_long_name_is_the_border():
    world = partial_gridworld("w . . w", wall="wall")
    assert world.num_observations == 4 and world.propositions == ("w",)


def test_rollouts_read_observations_and_beliefs_follow_them(rooms, answer):
    run = jl.rollout(rooms, answer.policy, jax.random.key(3), num_trajectories=4, num_steps=12)
    observation = np.asarray(rooms.observation)
    transition = np.asarray(rooms.fully_observable.host.matrix.todense())
    for n in range(4):
        state, action = np.asarray(run.state)[n], np.asarray(run.action)[n]
        belief = jl.models.belief_filter(rooms, observation[state], action)
        assert (belief[np.arange(12), state] > 0).all()
        for t in range(12):  # the filter against its definition
            if t == 0:
                expected = np.asarray(rooms.initial, float)
            else:
                expected = belief[t - 1] @ transition[rooms.row_of_action[:, action[t - 1]]]
            expected = expected * (observation == observation[state[t]])
            np.testing.assert_allclose(belief[t], expected / expected.sum(), atol=1e-12)
        at = answer.policy.start(int(observation[state[0]]))
        for t in range(12):
            assert answer.policy.action[observation[state[t]], at.memory][action[t]] > 0
            if t < 11:
                at = answer.policy.update(at, int(observation[state[t + 1]]))


def test_impossible_steps_have_no_belief(rooms):
    first = int(np.asarray(rooms.observation)[14 + 13 * 4])
    with pytest.raises(ValueError, match=r"observation\[1\]"):
        jl.models.belief_filter(rooms, [first, 0], [0])
    with pytest.raises(ValueError, match=r"action\[0\] is 7"):
        jl.models.belief_filter(rooms, [first, first], [7])
    with pytest.raises(ValueError, match="action has 0"):
        jl.models.belief_filter(rooms, [first, first], [])


def _value(pomdp, policy):
    chain = jl.values.controlled_chain(pomdp, policy)
    return jl.optimal_satisfaction(chain, FORMULA).at_initial


def test_a_reduced_controller_has_the_same_value_and_fewer_states(rooms, answer):
    small = jl.values.reduced_controller(rooms, answer.policy)
    assert small.next_memory.shape[1] <= 4 < answer.policy.next_memory.shape[1]
    whole, reduced = _value(rooms, answer.policy), _value(rooms, small)
    assert float(reduced.lower) == pytest.approx(float(whole.lower), abs=1e-9)
    over = np.asarray(rooms.label)[:, [rooms.propositions.index(p) for p in "gxo"]].any(1)
    smaller = jl.values.reduced_controller(rooms, answer.policy, decided=over)
    assert smaller.next_memory.shape[1] == 3  # before a landmark, after a, after b
    assert float(_value(rooms, smaller).lower) == pytest.approx(float(whole.lower), abs=1e-9)


def test_reduction_keeps_the_values_of_random_controllers():
    """Merging may only use what the chain leaves open; every probability stays as it is."""
    generator = np.random.default_rng(0)
    for _ in range(30):
        table = generator.dirichlet(np.ones(5), (5, 2)) * (generator.random((5, 2, 5)) < 0.5)
        table[..., 0] += 1e-3
        table[4] = np.eye(5)[4]
        table /= table.sum(-1, keepdims=True)
        world = jl.from_dense(table, label={"t": [4]}, initial=[0.5, 0.5, 0, 0, 0])
        pomdp = jl.models.make_pomdp(world, generator.permutation([0, 0, 1, 1, 2]))
        policy = jl.FiniteMemoryPolicy(
            generator.integers(0, 2, (3, 4)),
            generator.integers(0, 4, 3),
            generator.integers(0, 4, (3, 4)),
        )
        small = jl.values.reduced_controller(pomdp, policy)
        assert small.next_memory.shape[1] <= 5  # one more for the start
        assert (small.initial_memory == small.next_memory[:, 0]).all()
        whole, reduced = (
            jl.reachability_probability(pomdp, "t", policy=x) for x in (policy, small)
        )
        assert float(reduced.value) == pytest.approx(float(whole.value), abs=1e-6)
        np.testing.assert_allclose(_distributions(pomdp, policy), _distributions(pomdp, small))


def _distributions(pomdp, policy):
    """Distributions ``[6, S]`` of the states after each of five steps."""
    chain = jl.values.controlled_chain(pomdp, policy)
    at, rows = np.asarray(chain.initial, float), []
    for _ in range(6):
        rows.append(np.bincount(chain.valuation["state"], at, pomdp.num_states))
        at = at @ chain.host.matrix
    return np.array(rows)


def test_policies_that_update_on_exit_are_refused(rooms, answer):
    with pytest.raises(ValueError, match="label_on"):
        jl.values.mealy_machine(rooms, answer.policy.replace(label_on="exit"))


def test_the_controller_succeeds_in_gymnasium_as_often_as_certified(rooms, answer):
    """In an environment that knows the map alone; the seed is fixed."""
    gymnasium = pytest.importorskip("gymnasium")
    kind, start = parse_map(TWO_ROOMS).ravel(), np.flatnonzero(rooms.initial)
    seen, step = np.asarray(rooms.observation), (-13, 13, -1, 1)

    class Rooms(gymnasium.Env):
        observation_space = gymnasium.spaces.Discrete(rooms.num_observations)
        action_space = gymnasium.spaces.Discrete(4)

        def reset(self, *, seed=None, options=None):
            super().reset(seed=seed)
            self.cell = int(self.np_random.choice(start))
            return seen[self.cell], {"verdict": 0}

        def step(self, action):
            if self.np_random.random() < 0.1:
                action = self.np_random.choice([2, 3] if action < 2 else [0, 1])
            ahead = self.cell + step[action]
            self.cell = ahead if kind[ahead] != "#" else self.cell
            verdict = {"g": 1, "x": 2, "o": 2}.get(kind[self.cell], 0)
            return seen[self.cell], 0.0, verdict > 0, False, {"verdict": verdict}

    env = gymnasium.wrappers.TimeLimit(Rooms(), 2000)
    found = jl.envs.run_policy(env, answer.policy, num_episodes=400, confidence=1 - 1e-4)
    assert found.success.lower < float(answer.lower) < found.success.upper
    assert found.success.upper < 0.94  # what a robot that sees its place attains
