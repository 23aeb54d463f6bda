"""Models from Gymnasium's tables: what they hold, against the tables themselves."""

import re

import numpy as np
import pytest

from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.sparse import choice_reward
from jaxltl.core.values.discounted.discounted import optimal_value
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.envs.gymnasium_tables import from_gymnasium


class Table:
    """An environment that is nothing but a table."""

    initial_state_distrib = np.array([0.25, 0.75, 0])
    P = {  # noqa: RUF012
        0: {
            0: [(0.5, 1, 1.0, False), (0.25, 1, 4.0, False), (0.25, 1, 8.0, True)],
            2: [(1.0, 0, -1.0, False), (0.0, 2, 9.0, True)],
        },
        1: {1: [(0.5, 2, 2.0, True), (0.5, 0, 3.0, False)]},
        2: {0: [(1.0, 2, 7.0, False)]},  # goes on, though an episode ends here
    }


def test_a_table_by_hand():
    model = from_gymnasium(Table(), labels={"goal": [2], "home": [0]})
    assert model.propositions == ("goal", "home", "terminated")
    assert model.num_states == 5  # 3, and an end in 1 and in 2
    assert model.valuation["state"].tolist() == [0, 1, 2, 1, 2]
    assert model.label.astype(int).tolist() == [
        [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, 0, 1], [1, 0, 1]]  # fmt: skip
    assert model.action.tolist() == [0, 2, 1, 0, 0, 0]
    assert model.row_start.tolist() == [0, 2, 3, 4, 5, 6]
    assert model.successor.tolist() == [1, 3, 0, 0, 4, 2, 3, 4]
    assert model.probability.tolist() == [0.75, 0.25, 1, 0.5, 0.5, 1, 1, 1]
    assert model.rewards["reward"].transition.tolist() == [2, 8, -1, 3, 2, 7, 0, 0]
    assert model.initial.tolist() == [0.25, 0.75, 0, 0, 0]
    assert choice_reward(model).tolist() == [3.5, -1, 2.5, 7, 0, 0]
    padded = to_padded(model)
    assert np.asarray(padded.available).sum(1).tolist() == [2, 1, 1, 1, 1]


def test_a_table_without_ends():
    class Loop:
        P = {0: {0: [(1.0, 1, 1.0, False)]}, 1: {0: [(1.0, 0, 0.0, False)]}}  # noqa: RUF012

    model = from_gymnasium(Loop())
    assert model.num_states == 2
    assert model.propositions == ("terminated",)
    assert not model.label.any()
    assert model.initial.tolist() == [0.5, 0.5]
    assert from_gymnasium(Loop(), initial=[0, 1]).initial.tolist() == [0, 1]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        (None, "expected a table P[state][action] for states 0, 1, ...; it has none"),
        ({1: {}}, "it has a dict that is not such a table"),
        ({0: [1]}, "P[0] is [1]; expected a table of actions"),
        ({0: {0: [(1.0, 0)]}}, "P[0][0] has the branch (1.0, 0); expected (probability"),
        ({0: {0: [(1.0, 1, 0.0, False)]}}, "P[0][0] leads to state 1; states are 0 to 0"),
        ({0: {0: [(0.5, 0, 0.0, False)]}}, "state 0, choice 0: the probabilities sum to 0.5"),
        ({0: {}, 1: {0: [(1.0, 0, 0.0, False)]}}, "P[0] is {}; expected a table"),
        ({0: {0: []}}, "P[0][0] is []; expected a list"),
        ({0: {"left": []}}, "P[0] is {'left': []}; expected a table of actions by number"),
    ],
)
def test_malformed_tables_are_refused(table, message):
    env = type("Env", (), {"P": table})()
    with pytest.raises(ValueError, match=re.escape(message)):
        from_gymnasium(env)


def test_other_faults():
    with pytest.raises(ValueError, match="'goal' holds in state 3; states are 0 to 2"):
        from_gymnasium(Table(), labels={"goal": [3]})
    with pytest.raises(ValueError, match="choose another name"):
        from_gymnasium(Table(), labels={"terminated": [0]})
    with pytest.raises(ValueError, match=r"initial has shape \(2,\)"):
        from_gymnasium(Table(), initial=[0, 1])


def latest(gymnasium, name):
    return max(
        (spec for spec in gymnasium.registry if re.fullmatch(rf"{name}-v\d+", spec)),
        key=lambda spec: int(spec.rpartition("v")[2]),
    )


@pytest.mark.parametrize("name", ["FrozenLake", "CliffWalking", "Taxi"])
def test_the_environments_own_tables(name):
    gymnasium = pytest.importorskip("gymnasium")
    env = gymnasium.make(latest(gymnasium, name))
    model = from_gymnasium(env)
    table = env.unwrapped.P
    count, terminated = len(table), model.states_with_label("terminated")
    assert terminated.tolist() == [False] * count + [True] * (model.num_states - count)
    assert model.initial[:count].tolist() == env.unwrapped.initial_state_distrib.tolist()
    matrix = model.host.matrix.toarray()
    mean = choice_reward(model)
    for row, (s, a) in enumerate((x, y) for x in table for y in table[x]):
        assert (model.host.state[row], model.action[row]) == (s, a)
        expected, earned = np.zeros(model.num_states), 0.0
        for probability, successor, reward, ends in table[s][a]:
            at = successor
            if ends:
                at = count + model.valuation["state"][count:].tolist().index(successor)
            expected[at] += probability
            earned += probability * reward
        np.testing.assert_allclose(matrix[row], expected, atol=1e-15)
        np.testing.assert_allclose(mean[row], earned, atol=1e-12)
    rows = model.host.num_rows - (model.num_states - count)
    assert (model.successor[model.entry_start[rows] :] == np.arange(count, model.num_states)).all()


def test_the_values_of_frozen_lake():
    pytest.importorskip("gymnasium")
    model = from_gymnasium("FrozenLake-v1", labels={"goal": [15]})
    # Value iteration with nothing of the library's but the numbers.
    matrix, reward, value = model.host.matrix.toarray(), choice_reward(model), np.zeros(18)
    assert model.num_states == 16 + 5  # four holes and the goal
    value = np.zeros(21)
    for _ in range(20_000):
        q = reward + matrix @ value
        value = np.maximum.reduceat(q, model.row_start[:-1])
    np.testing.assert_allclose(value[0], 14 / 17, atol=1e-9)
    padded = to_padded(model)
    goal = np.asarray(model.states_with_label("goal"))
    found = reachability_probability(padded, goal)
    assert found.lower[0] - 1e-6 <= 14 / 17 <= found.upper[0] + 1e-6
    # And discounted, against the environment's own table.
    import gymnasium

    table = gymnasium.make("FrozenLake-v1").unwrapped.P
    other = np.zeros(16)
    for _ in range(2000):
        other = np.array([
            max(sum(p * (r + 0.9 * other[t] * (not end)) for p, t, r, end in table[s][a])
                for a in range(4)) for s in range(16)])  # fmt: skip
    sa = np.zeros(padded.available.shape)
    sa[model.host.state, model.action] = reward
    np.testing.assert_allclose(optimal_value(padded, sa, 0.9).value[:16], other, atol=1e-5)


def test_an_unknown_id():
    pytest.importorskip("gymnasium")
    with pytest.raises(ValueError, match="gymnasium does not make 'NoSuchLake-v0'"):
        from_gymnasium("NoSuchLake-v0")
    with pytest.raises(ValueError, match=r"it has none\. Only environments of toy text"):
        from_gymnasium("Blackjack-v1")
