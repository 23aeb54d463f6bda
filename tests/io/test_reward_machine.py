"""Reward machines: what their texts say, against a slow reader of the text and of traces."""

import itertools
import re

import jax
import numpy as np
import pytest

from jaxltl.core.automata.automaton import letter_index
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.mdp import make_mdp
from jaxltl.core.models.product import product
from jaxltl.core.models.sparse import Rewards, choice_reward
from jaxltl.core.values.discounted.discounted import optimal_value
from jaxltl.io.reward_machine import machine_reward, read_reward_machine

OFFICE = """0 # initial state
[2]   # terminal state
(0,0,'!f&!n',ConstantRewardFunction(0))
(0,2,'n',ConstantRewardFunction(-0.5))
(0,1,'f&!n',ConstantRewardFunction(0.25))
(1,1,'!g|False',ConstantRewardFunction(0))
(1,2,'g & f',ConstantRewardFunction(1))
(2,0,'True',ConstantRewardFunction(9))
"""


def interpret(text, trace):
    """The rewards of a trace, read from the text as a program would, and whether it has ended."""
    lines = [line.split("#")[0].strip() for line in text.splitlines()]
    lines = [line for line in lines if line]
    state, terminal = int(lines[0]), eval(lines[1])
    steps = [eval(line, {"ConstantRewardFunction": float}) for line in lines[2:]]
    rewards, done = [], state in terminal
    for letter in trace:
        pays = 0.0
        if not done:
            for source, target, guard, reward in steps:
                python = guard.replace("&", " and ").replace("|", " or ").replace("!", " not ")
                values = {name: name in letter for name in re.findall(r"[a-z]\w*", guard)}
                if source == state and eval(python, {}, values):
                    state, pays = target, reward
                    done = target in terminal
                    break
            else:
                done = True
        rewards.append(pays)
    return rewards, done


def run(machine, trace):
    q, rewards = int(machine.automaton.initial), []
    for letter in trace:
        index = letter_index(machine.automaton, letter)
        rewards.append(float(machine.reward[q, index]))
        q = int(machine.automaton.delta[q, index])
    return rewards, bool(machine.automaton.final[q])


def random_text(rng):
    names = ["a", "b", "goal_1"]
    lines = [str(rng.integers(4)), str(rng.choice(4, rng.integers(3), replace=False).tolist())]
    for _ in range(rng.integers(1, 9)):
        terms = [
            "&".join(
                ("!" if rng.random() < 0.5 else "") + names[i]
                for i in rng.choice(3, rng.integers(1, 4), replace=False)
            )
            for _ in range(rng.integers(1, 3))
        ]
        guard = "True" if rng.random() < 0.1 else "|".join(terms)
        pays = round(float(rng.normal()), 2)
        lines.append(
            f"({rng.integers(4)}, {rng.integers(4)}, '{guard}', ConstantRewardFunction({pays}))"
        )
    return "\n".join(lines) + "\n"


def test_random_machines_pay_what_their_text_says():
    rng = np.random.default_rng(0)
    names, some, ended = ("a", "b", "goal_1"), 0, 0
    for i in range(150):
        text = OFFICE if i == 0 else random_text(rng)
        used = ("f", "g", "n") if i == 0 else names
        machine = read_reward_machine(text)
        for _ in range(10):
            trace = [{n for n in used if rng.random() < 0.5} for _ in range(8)]
            expected = interpret(text, trace)
            assert run(machine, trace) == expected, (text, trace)
            some += any(expected[0])
            ended += expected[1]
    assert 300 < some < 1490
    assert 300 < ended < 1490


def test_the_states_of_a_machine(tmp_path):
    (tmp_path / "rm.txt").write_text(OFFICE)
    machine = read_reward_machine(tmp_path / "rm.txt")
    assert machine.automaton.propositions == ("f", "g", "n")
    assert machine.automaton.state_names == ("0", "1", "2", "ended")
    assert machine.automaton.acceptance == "cosafe"
    assert machine.automaton.final.tolist() == [False, False, True, True]
    assert not machine.reward[2:].any()
    fewer = read_reward_machine(OFFICE, letters=[{"f"}, {"n", "other"}])
    assert fewer.automaton.letters.astype(int).tolist() == [[1, 0, 0], [0, 0, 1]]
    assert fewer.reward.tolist() == [[0.25, -0.5], [0, 0], [0, 0]]


def test_names_that_are_operators_elsewhere():
    machine = read_reward_machine("0\n[]\n(0,0,'G & !X | true1', ConstantRewardFunction(1e-1))\n")
    assert machine.automaton.propositions == ("G", "X", "true1")
    assert machine.reward[0, letter_index(machine.automaton, {"G"})] == 0.1
    assert machine.reward[0, letter_index(machine.automaton, {"G", "X"})] == 0


def test_what_strip_takes_away_is_no_part_of_a_number():
    machine = read_reward_machine("0\n[]\n(0,1,'a',ConstantRewardFunction(-2.\x1e))\n")
    assert np.asarray(machine.reward).min() == -2


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("\n", 2, "expected the number of the initial state"),
        ("x\n[1]\n", 1, "found 'x'; expected the number of the initial state"),
        ("0\n", 2, "expected the list of terminal states"),
        ("0\n\n1\n", 3, "found '1'; expected the list of terminal states"),
        ("0\n[1,,]\n", 2, "expected the list of terminal states"),
        ("0\n[]\n(0,1,'a')\n", 3, "expected a transition such as"),
        ("0\n[]\n(0,1,'a',ConstantRewardFunction(1)) x\n", 3, "expected a transition"),
        ("0\n[]\n\n(0,1,'a',RewardForward())\n", 4, "the reward is RewardForward(...)"),
        ("0\n[]\n(0,1,'a',ConstantRewardFunction(one))\n", 3, "expected a finite number"),
        ("0\n[]\n(0,1,'a',ConstantRewardFunction(1e999))\n", 3, "expected a finite number"),
        ("0\n[]\n(0,1,'a&',ConstantRewardFunction(1))\n", 3, "the guard is 'a&'; expected prop"),
        ("0\n[]\n(0,1,'a U b',ConstantRewardFunction(1))\n", 3, "the guard is 'a U b'"),
        ("0\n[]\n(0,1,'[] a',ConstantRewardFunction(1))\n", 3, "the guard is '[] a'"),
        ("0\n[]\n(0,1,'',ConstantRewardFunction(1))\n", 3, "the guard is ''"),
        ("0\n[]\n(12345678901,1,'a',ConstantRewardFunction(1))\n", 3, "expected a transition"),
    ],
)
def test_malformed_texts_are_refused(tmp_path, text, line, message):
    path = tmp_path / "rm.txt"
    path.write_text(text)
    for source, place in ((text, "read_reward_machine"), (path, str(path))):
        with pytest.raises(ValueError, match=re.escape(message)) as error:
            read_reward_machine(source)
        assert str(error.value).startswith(f"{place}, line {line}: ")


def test_other_faults(tmp_path):
    guard = "&".join(f"p{i}" for i in range(13))
    text = f"0\n[]\n(0,0,'{guard}',ConstantRewardFunction(1))\n"
    with pytest.raises(ValueError, match=r"13 propositions.*Pass letters="):
        read_reward_machine(text)
    assert read_reward_machine(text, letters=[{}]).reward.tolist() == [[0], [0]]
    with pytest.raises(ValueError, match="nowhere"):
        read_reward_machine(str(tmp_path / "nowhere"))
    (tmp_path / "rm").write_bytes(b"0\n\xff")
    with pytest.raises(ValueError, match="rm, line 2: byte 0xff is not UTF-8 text; a reward mach"):
        read_reward_machine(tmp_path / "rm")
    deep = f"0\n[]\n(0,0,'{'(' * 3000}a{')' * 3000}',ConstantRewardFunction(1))\n"
    assert read_reward_machine(deep).automaton.propositions == ("a",)


def random_world(rng, states=5, actions=2):
    probability = rng.dirichlet(np.ones(2), (states, actions))
    successor = np.array(
        [[rng.choice(states, 2, replace=False) for _ in range(actions)] for _ in range(states)]
    )
    available = rng.random((states, actions)) < 0.8
    available[:, 0] |= ~available.any(1)
    label = rng.random((states, 3)) < 0.5
    return make_mdp(successor, probability, available=available, label=label,
                    propositions=["f", "g", "n"])  # fmt: skip


@pytest.mark.few(1)
@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_the_reward_of_a_product(label_on):
    rng = np.random.default_rng(1)
    machine = read_reward_machine(OFFICE)
    letter, delta = None, machine.automaton.delta
    for i in range(5):
        world = random_world(rng)
        prod = product(world, machine.automaton, label_on=label_on)
        letter = [letter_index(machine.automaton, {n for n, x in zip("fgn", row, strict=True) if x})
                  for row in np.asarray(world.label)]  # fmt: skip
        available, to = np.asarray(world.available), np.asarray(world.successor)
        weight = np.asarray(world.probability, float)
        expected = np.zeros((5, 4, 2))
        for s, q, a in itertools.product(range(5), range(4), range(2)):
            for t, p in zip(to[s, a], weight[s, a], strict=True):
                read = letter[t if label_on == "entry" else s]
                expected[s, q, a] += available[s, a] * p * machine.reward[q, read]
        found = machine_reward(prod, machine.reward)
        np.testing.assert_allclose(found, expected, atol=1e-6)
        # On a sparse world, a number for each choice of the product written out.
        sparse = product(to_sparse(world), machine.automaton, label_on=label_on)
        rows = machine_reward(sparse, machine.reward)
        np.testing.assert_allclose(rows, expected[available[:, None].repeat(4, 1)], atol=1e-6)
        out = to_sparse(sparse)
        assert choice_reward(out, Rewards(choice=rows)).tolist() == rows.tolist()
        if i == 0:
            value = np.zeros((5, 4))
            for _ in range(300):
                q_value = np.full((5, 4, 2), -np.inf)
                for s, q, a in itertools.product(range(5), range(4), range(2)):
                    if available[s, a]:
                        q_value[s, q, a] = expected[s, q, a] + 0.9 * sum(
                            p * value[t, delta[q, letter[t if label_on == "entry" else s]]]
                            for t, p in zip(to[s, a], weight[s, a], strict=True))  # fmt: skip
                value = q_value.max(-1)
            best = optimal_value(prod, found, 0.9)
            np.testing.assert_allclose(best.value, value, atol=1e-5)
            slope = jax.grad(lambda r, prod=prod: machine_reward(prod, r)[0, 0].sum())(
                np.float32(machine.reward))  # fmt: skip
            np.testing.assert_allclose(np.asarray(slope)[0].sum(), available[0].sum(), atol=1e-6)


def test_shapes_are_checked():
    world = random_world(np.random.default_rng(2))
    machine = read_reward_machine(OFFICE)
    prod = product(world, machine.automaton)
    with pytest.raises(ValueError, match=r"reward has shape \(3, 8\); expected \(4, 8\)"):
        machine_reward(prod, machine.reward[:3])
    with pytest.raises(ValueError, match="MDP is no product"):
        machine_reward(world, machine.reward)
