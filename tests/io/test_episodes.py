"""Episodes of imitation and Minari as demonstrations."""

from types import SimpleNamespace

import numpy as np
import pytest

import jaxltl as jl

WORLD = jl.gridworld("s . t\n. . g", absorbing=["g"], initial="s")
STATES, ACTIONS = [0, 3, 4, 5], [1, 3, 3]  # down, right, right


def of_imitation(states, actions):
    return SimpleNamespace(obs=np.array(states), acts=np.array(actions), infos=None, terminal=True)


def of_minari(states, actions):
    row, column = np.divmod(np.array(states), 3)
    seen = {"row": row, "column": column.astype(np.int64)}
    return SimpleNamespace(id=0, observations=seen, actions=np.array(actions, np.float32))


def test_both_packages_give_the_same_demonstrations():
    expected = jl.make_trajectories(WORLD, [list(zip(STATES, ACTIONS, strict=False))])
    first = jl.io.from_episodes(WORLD, iter([of_imitation(STATES, ACTIONS)]))
    second = jl.io.from_episodes(
        WORLD,
        [of_minari(STATES, ACTIONS)],
        state=lambda seen: 3 * seen["row"] + seen["column"],
        action=int,
    )
    for found in (first, second):
        assert found.state.tolist() == expected.state.tolist() == [[0, 3, 4]]
        assert found.action.tolist() == expected.action.tolist()
        assert found.length.tolist() == [3]


class Wrapped(SimpleNamespace):
    """As the DictObs of imitation."""

    def unwrap(self):
        return self.columns


@pytest.mark.parametrize("kind", ["tuple", "wrapped"])
def test_observations_in_columns(kind):
    row, column = np.divmod(np.array(STATES), 3)
    seen, number = (row, column), lambda x: 3 * x[0] + x[1]
    if kind == "wrapped":
        seen = Wrapped(columns={"row": row, "column": column})
        number = lambda x: 3 * x["row"] + x["column"]  # noqa: E731
    episode = SimpleNamespace(obs=seen, acts=np.array(ACTIONS), terminal=True)
    assert jl.io.from_episodes(WORLD, [episode], state=number).state.tolist() == [[0, 3, 4]]


def test_the_last_state_of_a_terminated_episode_may_be_a_copy():
    table = {
        0: {0: [(0.5, 0, 0.0, False), (0.5, 1, 1.0, True)]},
        1: {0: [(0.5, 1, 0.0, True), (0.5, 2, 0.0, False)]},
        2: {0: [(1.0, 2, 0.0, True)]},
    }
    corridor = SimpleNamespace(P=table)
    labels = {"goal": [1], "pit": [2]}
    model = jl.to_padded(jl.envs.from_gymnasium(corridor, labels=labels, initial=[1, 0, 0]))

    def episode(*states, ended):
        acted = np.zeros(len(states) - 1, int)
        ends = np.arange(len(acted)) == len(acted) - 1 if ended else np.zeros(len(acted), bool)
        return SimpleNamespace(observations=np.array(states), actions=acted, terminations=ends)

    found = jl.io.from_episodes(model, [episode(0, 0, 1, ended=True), episode(0, 0, ended=False)])
    assert found.state.tolist() == [[0, 0], [0, 0]] and found.length.tolist() == [2, 1]
    for states, ended in (((0, 1), False), ((0, 2), True)):
        with pytest.raises(ValueError, match="state 0 cannot lead to state"):
            jl.io.from_episodes(model, [episode(*states, ended=ended)])


@pytest.mark.parametrize(
    "episode, message",
    [
        (of_imitation(STATES[:-1], ACTIONS), "episode 0 has 3 observations and 3 actions"),
        (of_imitation([0], []), "episode 0 has 1 observations and 0 actions"),
        (of_imitation([0, 3, 4, 2], ACTIONS), "action 3 in state 4 cannot lead to state 2"),
        (of_imitation([0, 3, 4, 9], ACTIONS), "episode 0 ends in state 9; states are 0 to 5"),
        (of_imitation([[0.0, 1.0]] * 4, ACTIONS), "observation 0 is .*; give state=, a function"),
        (of_imitation(STATES, [0.5, 0.5, 0.5]), "action 0 is .*; give action=, a function"),
        ([(0, 1)], "give objects with obs and acts"),
    ],
)
def test_misfits_are_named(episode, message):
    with pytest.raises(ValueError, match=message):
        jl.io.from_episodes(WORLD, [episode])
