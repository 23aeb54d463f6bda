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
