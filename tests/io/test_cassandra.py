"""Cassandra's POMDP format: the law of observations and rewards, round trips, malformed text."""

import itertools

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models import Rewards, choice_reward, make_pomdp, make_sparse
from jaxltl.core.values import controlled_chain
from jaxltl.io import read_cassandra, write_cassandra
from tests.io.same import random_pomdp

TIGER = """\
# a tiger behind one of two doors
discount: 0.95
values: reward
states: tiger-left tiger-right
actions: listen open-left open-right
observations: hear-left hear-right
T: listen
identity
T: open-left
uniform
T:open-right : * reset
O: listen
0.85 0.15
0.15 0.85
O: open-left uniform
O: open-right : * : * 0
O: open-right : * : hear-left .5
O: open-right : tiger-left : 1 0.5
O: 2 : 1 0.5 0.5
R: listen : * : * : * -1
R: open-left : tiger-left : * : * -100
R: open-left : tiger-right : * : * 10
R: open-right : tiger-left : * : * 10
R: open-right : * : tiger-right
7 8
R: open-right : tiger-right
-100 -100
-100 -99
"""


def read(tmp_path, text):
    path = tmp_path / "m.pomdp"
    path.write_text(text)
    return read_cassandra(path)


def random_arrays(rng, states=3, actions=2, seen=2, zeros=0.3):
    """Random T[a, s, t], O[a, t, o] and R[a, s, t, o]."""

    def rows(*shape):
        table = rng.random(shape) * (rng.random(shape) > zeros)
        table[..., 0] += 0.1
        return table / table.sum(-1, keepdims=True)

    reward = rng.normal(size=(actions, states, states, seen))
    return rows(actions, states, states), rows(actions, states, seen), reward


def text_of(transition, sensor, reward, start):
    """Single entries, rows or matrices, by the number of the action."""
    actions, states, seen = sensor.shape
    lines = [f"discount: 0.9\nvalues: cost\nstates: {states}\nactions: {actions}"]
    lines.append(f"observations: {seen}\nstart: {' '.join(map(repr, start.tolist()))}")
    lines.append("T: * uniform\nO: * uniform\nR: * : * : * : * 5")
    for a in range(actions):
        if a % 2:
            lines += [f"T: {a}", *(" ".join(map(repr, x)) for x in transition[a].tolist())]
            lines += [f"O: {a}", *(" ".join(map(repr, x)) for x in sensor[a].tolist())]
        for s in range(states):
            if not a % 2:
                for t in range(states):
                    lines.append(f"T: {a} : {s} : {t} {float(transition[a, s, t])!r}")
                lines.append(f"O: {a} : {s} {' '.join(map(repr, sensor[a, s].tolist()))}")
            lines += [f"R : {a} : {s}", *(" ".join(map(repr, x)) for x in reward[a, s].tolist())]
    return "\n".join(lines)


def law(pomdp, actions):
    """Probabilities of observations and expected rewards after some actions, by belief updates."""
    world, seen = pomdp.fully_observable, np.asarray(pomdp.observation)
    earned = choice_reward(world, next(iter(world.rewards)))
    measures = {(): np.asarray(world.initial, float)}
    total = 0.0
    for a in actions:
        following = {}
        for history, measure in measures.items():
            row = pomdp.row_of_action[:, a]
            total += measure @ earned[row]
            after = measure @ world.host.matrix[row]
            for o in np.unique(seen):
                following[(*history, int(o))] = np.where(seen == o, after, 0)
        measures = following
    return {h: x.sum() for h, x in measures.items() if x.sum() > 0}, total


@pytest.mark.parametrize("seed", range(4))
def test_observations_and_rewards_have_the_law_of_the_file(tmp_path, seed):
    rng = np.random.default_rng(seed)
    transition, sensor, reward = random_arrays(rng)
    start = rng.random(3)
    start /= start.sum()
    pomdp, discount = read(tmp_path, text_of(transition, sensor, reward, start))
    assert discount == 0.9 and list(pomdp.rewards) == ["cost"]
    joint = np.einsum("ast,ato->asto", transition, sensor)
    for actions in itertools.product(range(2), repeat=2):
        found, total = law(pomdp, actions)
        first = np.einsum("s,sto->to", start, joint[actions[0]])
        expected = np.einsum("to,tuv->ov", first, joint[actions[1]])
        for history, chance in found.items():
            np.testing.assert_allclose(chance, expected[history], rtol=1e-12)
        np.testing.assert_allclose(sum(found.values()), 1, rtol=1e-12)
        mean = np.einsum("s,sto,sto->", start, joint[actions[0]], reward[actions[0]])
        mean += np.einsum("t,tuv,tuv->", first.sum(1), joint[actions[1]], reward[actions[1]])
        np.testing.assert_allclose(total, mean, rtol=1e-12)


def test_forms_of_statements(tmp_path):
    pomdp, discount = read(tmp_path, TIGER)
    world = pomdp.fully_observable
    assert discount == 0.95 and world.action_names == ("listen", "open-left", "open-right")
    assert world.propositions == ("tiger-left", "tiger-right")
    # Pairs of a state and an observation, and the initial states, which have no observation yet.
    assert world.valuation["state"].tolist() == [0, 0, 1, 1, 0, 1]
    assert pomdp.observables["observation"].tolist() == ["hear-left", "hear-right", ""]
    assert pomdp.initial.tolist() == [0, 0, 0, 0, 0.5, 0.5]
    matrix = world.host.matrix.toarray()
    row = pomdp.row_of_action[4]
    np.testing.assert_allclose(matrix[row[0], :4], [0.85, 0.15, 0, 0])
    np.testing.assert_allclose(matrix[row[1:], :4], np.full((2, 4), 0.25))
    # The last rule counts: a row of observations, then a matrix.
    reward = np.asarray(world.rewards["reward"].transition)
    entries = slice(*world.entry_start[pomdp.row_of_action[4, 2] + np.arange(2)])
    assert reward[entries].tolist() == [10, 10, 7, 8]
    entries = slice(*world.entry_start[pomdp.row_of_action[5, 2] + np.arange(2)])
    assert reward[entries].tolist() == [-100, -100, -100, -99]


@pytest.mark.parametrize(
    ("start", "belief"),
    [
        ("start: uniform", [0.25] * 4),
        ("", [0.25] * 4),
        ("start: 0.5 0.25 0 0.25", [0.5, 0.25, 0, 0.25]),
        ("start: 2", [0, 0, 1, 0]),
        ("start include: 1 3", [0, 0.5, 0, 0.5]),
        ("start exclude: 0 2 3", [0, 1, 0, 0]),
    ],
)
def test_initial_beliefs(tmp_path, start, belief):
    text = f"discount: 1\nvalues: reward\nstates: 4\nactions: 1\nobservations: 1\n{start}\n"
    pomdp, _ = read(tmp_path, text + "T: 0 identity\nO: 0 : * : 0 1.0")
    assert pomdp.num_states == 4 and pomdp.initial.tolist() == belief


@pytest.mark.parametrize("seed", range(4))
def test_what_is_written_is_read(tmp_path, seed):
    rng = np.random.default_rng(seed)
    pomdp = random_pomdp(rng, all_actions=True, begins=1)
    world = pomdp.fully_observable
    some = {"cost": world.rewards["cost"]} if seed % 2 else {"steps": world.rewards["steps"]}
    pomdp = make_pomdp(world.replace(rewards=some), pomdp.observation)
    path = tmp_path / "m.pomdp.gz"
    write_cassandra(path, pomdp, discount=0.75)
    found, discount = read_cassandra(path)
    assert discount == 0.75 and found.observation.tolist() == pomdp.observation.tolist()
    assert found.row_of_action.tolist() == pomdp.row_of_action.tolist()
    for name in ("entry_start", "successor", "probability", "initial"):
        a, b = getattr(found.fully_observable, name), getattr(world, name)
        assert a.tobytes() == b.tobytes(), name
    (name,) = found.rewards
    assert name == ("cost" if seed % 2 else "reward")
    np.testing.assert_array_equal(
        choice_reward(found.fully_observable, name), choice_reward(world, next(iter(some)))
    )


def test_what_the_format_cannot_hold(tmp_path):
    rng = np.random.default_rng(0)
    path = tmp_path / "m.pomdp"
    pomdp = random_pomdp(rng, all_actions=True, begins=1)
    with pytest.raises(ValueError, match=r"rewards 'cost', 'steps', and the format has one; write"):
        write_cassandra(path, pomdp)
    world = make_sparse([0, 2, 3], [0, 1, 2, 3], [0, 1, 1], [1.0, 1, 1], initial=[1, 0])
    with pytest.raises(ValueError, match=r"some actions are unavailable in some obs"):
        write_cassandra(path, make_pomdp(world, [0, 1]))
    chain = make_sparse(None, [0, 1, 2], [1, 1], [1.0, 1], initial=[0.5, 0.5])
    with pytest.raises(ValueError, match="the initial states have 2 observations"):
        write_cassandra(path, make_pomdp(chain, [0, 1]))
    with pytest.raises(ValueError, match="discount"):
        write_cassandra(path, make_pomdp(chain, [0, 0]), discount=1.5)
    with pytest.raises(ValueError, match=r"holds no fully observable models; write UMB"):
        jl.write_model(path, chain)
    assert not path.exists()


WRONG = [
    (TIGER, "# nothing", "line 1: ''; expected one of discount, values, states"),
    ("discount: 0.95", "", "line 26: the line 'discount: ...' is missing"),
    ("discount: 0.95", "discount: 1.5", "line 2: the discount is 1.5; expected a number from 0"),
    ("discount: 0.95", "discount: x", "line 2: 'x' stands where a number is expected"),
    ("values: reward", "values: gain", "line 3: values are 'gain'; expected reward or cost"),
    ("# a tiger behind one of two doors", "gain 3", "line 1: 'gain'; expected one of discount"),
    ("states: tiger-left tiger-right", "states: 0", "line 4: 0 states; expected 1 to"),
    ("states: tiger-left tiger-right", "states: a a", "line 4: states need a number, or distinct"),
    ("states: tiger-left tiger-right", "", "line 7: the line 'states: ...' is missing"),
    ("values: reward", "states: 2", "line 4: states are given twice"),
    ("T: listen\n", "T: hear\n", "line 7: 'hear' is none of the 3 actions"),
    ("identity", "identity 1", "line 7: T has 2 numbers; expected 2 rows of 2"),
    ("identity", "0.5 0.5 1 -1", "line 7: a probability is -1; expected"),
    ("identity", "0.5 0.4 0 1", "line 7: T of action 'listen' and state 'tiger-left' sums to 0.9"),
    ("T: listen\nidentity\n", "", "T of action 'listen' and state 'tiger-left' sums to 0; expect"),
    ("T: open-left\n", "T: open-left :\n", "line 9: 'uniform' is none of the 2 states"),
    ("open-right : * reset", "open-right : * : * : * 1", "line 11: T has 4 names; expected 1 to 3"),
    ("open-right : * reset", "open-right : reset : 1", "line 11: 'reset' is none of the 2 states"),
    (": 1 0.5\n", ": 1 2\n", "line 19: O of .*|line 18: O of action 'open-right' .* sums to 2.5"),
    (": 1 0.5\n", ": 2 0.5\n", "line 18: '2' is none of the 2 observations"),
    (": 1 0.5\n", ": 1 nan\n", "line 18: 'nan' stands where a number is expected"),
    (": 1 0.5\n", ": 1 -1\n", "line 18: the probability is -1; expected"),
    ("R: listen : * : * : * -1", "R: listen -1", "line 20: R has 1 names; expected 2 to 4"),
    ("7 8", "7", "line 24: R has 1 numbers; expected 1 rows of 2"),
    ("7 8", "7 : 8", "line 25: ':' stands where the data of R are expected"),
    ("T: listen\n", "start: 0.5 0.4\nT: listen\n", "line 7: the initial belief sums to 0.9"),
    ("T: listen\n", "start exclude: 0 1\nT: listen\n", "line 7: start exclude leaves no state"),
    ("T: listen\n", "start include: *\nT: listen\n", "line 7: '\\*' stands where a state"),
    ("T: listen\n", "start: 7\nT: listen\n", "line 7: '7' is none of the 2 states"),
    (
        "R: open-right : tiger-right\n-100 -100\n-100 -99",
        "R:",
        "line 26: R: ends after ':'; expected a name",
    ),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG)
def test_malformed_text_is_refused_with_its_line(tmp_path, old, new, message):
    assert old in TIGER
    with pytest.raises(ValueError, match=message) as caught:
        read(tmp_path, TIGER.replace(old, new, 1))
    assert "m.pomdp'" in str(caught.value) and "\n" not in str(caught.value)


def test_discounted_value_of_a_controller_that_listens_for_ever(tmp_path):
    pomdp, discount = read(tmp_path, TIGER)
    listen = jl.FiniteMemoryPolicy(np.zeros((3, 1), int), np.zeros(3, int), np.zeros((3, 1), int))
    chain = controlled_chain(pomdp, listen)
    value = jl.optimal_value(chain, choice_reward(chain, "reward"), discount=discount)
    np.testing.assert_allclose(value.at_initial.value, -1 / 0.05, rtol=1e-4)


def test_rewards_of_choices_stay_rewards_of_choices(tmp_path):
    pomdp, _ = read(tmp_path, TIGER.split("R: open-right : *")[0])
    assert isinstance(pomdp.rewards["reward"], Rewards)
    assert pomdp.rewards["reward"].transition is None
