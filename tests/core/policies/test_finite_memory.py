"""Finite-memory policies: with NumPy alone, under JAX, in files and as C code."""

import shutil
import subprocess
import sys
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy, Progress
from jaxltl.core.policies.policy_file import load_table, save_policy
from jaxltl.io.policies import write_c_policy

WORLD = jl.make_mdp(  # three rooms in a row; action 1 goes right by chance, action 0 left
    [[[0, 0], [1, 0]], [[0, 1], [2, 1]], [[1, 2], [2, 2]]],
    [[[1.0, 0.0], [0.75, 0.25]], [[0.5, 0.5], [0.75, 0.25]], [[1.0, 0.0], [1.0, 0.0]]],
    label={"left": [0], "right": [2]},
    initial=[0, 1, 0],
)
TASK = "F (right & F left)"


def random_policy(model, seed=0):
    weight = np.random.default_rng(seed).dirichlet(np.ones(model.num_actions), model.state_shape)
    return weight.astype(np.float32)


@pytest.fixture(params=["entry", "exit"])
def model(request):
    return jl.product(WORLD, TASK, label_on=request.param)


def memory_by_hand(model, states):
    """Memory states along a word of states, by the automaton alone."""
    automaton, letter = model.automaton, np.asarray(model.letter)
    read = letter[states] if model.label_on == "entry" else letter[states[:-1]]
    memory = [int(automaton.initial)]
    for one in read:
        memory.append(int(automaton.delta[memory[-1], one]))
    return memory[1:] if model.label_on == "entry" else memory


def test_memory_follows_the_automaton(model):
    policy = jl.project_policy(model, random_policy(model))
    states = [1, 2, 2, 1, 0, 1]
    at = policy.start(states[0])
    found = [int(at.memory)]
    for state in states[1:]:
        at = policy.update(at, state)
        found.append(int(at.memory))
    assert found == memory_by_hand(model, np.array(states))
    assert int(at.step) == 5 and int(at.state) == 1


def test_labels_from_sensors_replace_those_of_the_map(model):
    policy = jl.project_policy(model, random_policy(model))
    states, labels = [1, 1, 1, 1], [set(), {"right"}, {"left", "other"}, set()]
    at = policy.start(states[0], labels[0])
    for t in range(1, 4):
        read = labels[t] if model.label_on == "entry" else labels[t - 1]
        at = policy.update(at, states[t], read)
    assert model.automaton.final[int(at.memory)]
    at = policy.start(1)
    for _ in range(3):
        at = policy.update(at, 1)
    assert not model.automaton.final[int(at.memory)]


def test_numpy_and_jax_agree_with_the_distribution(model):
    table = random_policy(model)
    policy, host = jl.project_policy(model, table), jl.project_policy(model, table)
    host = jax.tree.map(np.asarray, host)
    at = host.start(1)
    many = Progress(*(np.full(20_000, x) for x in at))
    drawn = host.act(np.random.default_rng(0), many)
    assert drawn.dtype == np.int32
    under_jax = jax.jit(lambda p, key: p.act(key, Progress(*map(jnp.asarray, many))))
    for actions in (drawn, np.asarray(under_jax(policy, jax.random.key(0)))):
        share = np.bincount(actions, minlength=2) / 20_000
        assert np.abs(share - table[1, int(at.memory)]).max() < 0.015


def test_the_pure_functions_run_under_jit_and_vmap_also_with_numpy_tables(model):
    policy = jl.project_policy(model, random_policy(model).argmax(-1).astype(np.int32))
    host = jax.tree.map(np.asarray, policy)

    @jax.jit
    @jax.vmap
    def end(states):
        at = host.start(states[0])
        for state in states[1:]:
            at = host.update(at, state)
        return at.memory, host.act(None, at)

    words = np.array([[1, 2, 1, 0], [0, 1, 2, 2]])
    memory, action = end(words)
    for word, q, a in zip(words, memory, action, strict=True):
        assert int(q) == memory_by_hand(model, word)[-1]
        assert int(a) == int(policy.action[word[-1], int(q)])


def test_actions_of_probability_zero_are_never_drawn():
    weight = np.array([[[0.0, 0.5, 0.0, 0.5, 0.0]]], np.float32)
    policy = FiniteMemoryPolicy(weight, np.zeros(1, int), np.zeros((1, 1), int))

    class Ends(np.random.Generator):
        def random(self, shape):
            return np.broadcast_to(self.point, shape)

    generator = Ends(np.random.PCG64(0))
    for point, expected in ((0.0, 1), (0.49, 1), (0.5, 3), (1.0, 3), (np.nextafter(1, 0), 3)):
        generator.point = np.float64(point)
        assert int(policy.act(generator, policy.start(0))) == expected


def test_policies_of_all_containers_are_the_same():
    padded = jl.product(WORLD, TASK)
    best = jl.optimal_satisfaction(padded)
    expected = np.asarray(jl.project_policy(padded, best.policy).action)
    reached = np.asarray(best.value) > 0
    dense = jl.product(jl.models.to_dense(WORLD), TASK)
    found = {"dense": jl.project_policy(dense, jl.optimal_satisfaction(dense).policy)}
    sparse = jl.to_sparse(WORLD)
    lazy = jl.product(sparse, TASK)
    actions = np.asarray(jl.optimal_satisfaction(lazy).policy)
    found["sparse"] = jl.project_policy(lazy, actions)
    weight = (actions[sparse.host.state] == np.asarray(sparse.action)[:, None]).astype(float)
    mixed = jl.project_policy(lazy, weight)
    assert mixed.action.shape == (3, lazy.num_memory, 2)
    found["weights"] = mixed.replace(action=np.asarray(mixed.action).argmax(-1))
    for name, policy in found.items():
        value = jl.satisfaction_probability(padded, np.asarray(policy.action)).value
        assert np.abs(np.asarray(value) - np.asarray(best.value)).max() < 1e-6, name
        assert np.array_equal(policy.next_memory, padded.next_memory), name
    assert expected.shape == reached.shape
    for label_on in ("entry", "exit"):
        reachable = jl.optimal_satisfaction(sparse, TASK, label_on=label_on)
        policy = jl.project_policy(sparse, reachable)
        assert policy.label_on == label_on
        model = jl.product(WORLD, policy.automaton, label_on=label_on)
        value = jl.satisfaction_probability(model, np.asarray(policy.action)).value
        start = value[1, int(policy.initial_memory[1])]
        assert abs(float(start) - float(reachable.value[0])) < 1e-6


def test_action_numbers_of_sparse_rows_are_those_of_the_model():
    sparse = jl.make_sparse(
        [0, 1, 3], [0, 1, 2, 3], [1, 0, 1], [1.0, 1.0, 1.0], action=[2, 0, 3], label={"a": [1]}
    )
    policy = jl.project_policy(sparse, np.array([2, 3]))
    assert np.asarray(policy.action).tolist() == [[2], [3]]
    with pytest.raises(ValueError, match=r"policy\[1\] = 2 is no action of its state; .*\[0, 3\]"):
        jl.project_policy(sparse, np.array([2, 2]))


def test_policies_with_a_horizon_follow_time():
    model = jl.product(WORLD, TASK)
    action = np.zeros((3, *model.state_shape), np.int32)
    action[1] = 1
    policy = jl.project_policy(model, action)
    at, found = policy.start(0), []
    for _ in range(4):
        found.append(int(policy.act(None, at)))
        at = policy.update(at, 0)
    assert policy.has_horizon and found == [0, 1, 0, 0]


@pytest.mark.few(1)
def test_rollouts_of_the_world_are_those_of_the_product(model):
    table, key = random_policy(model), jax.random.key(4)
    policy = jl.project_policy(model, table)
    given = {"num_trajectories": 40, "num_steps": 15}
    inside, outside = (
        jl.rollout(model, table, key, **given),
        jl.rollout(WORLD, policy, key, **given),
    )
    projected = jl.models.project_trajectories(model, inside)
    assert np.array_equal(projected.state, outside.state)
    assert np.array_equal(inside.action, outside.action)
    with pytest.raises(ValueError, match="of a model of 3 states"):
        jl.rollout(jl.from_dense([[[1.0]]]), policy, key, **given)


def test_controllers_act_from_start_to_end():
    model = jl.product(WORLD, TASK)
    names = {"actions": ["west", "east"], "states": ["a", "b", "c"]}
    policy = jl.project_policy(model, jl.optimal_satisfaction(model).policy, **names)
    robot = policy.controller(seed=3)
    with pytest.raises(ValueError, match="call start"):
        robot.act()
    robot.start("b")
    assert policy.actions[robot.act()] == "east"
    robot.update("c")
    assert policy.actions[robot.act()] == "west"
    for wrong in ("d", 3, -1):
        with pytest.raises(ValueError, match="state"):
            robot.update(wrong)
    mixed = jl.project_policy(model, random_policy(model))
    draws = []
    for _ in range(2):
        robot = mixed.controller(seed=3)
        robot.start(1)
        draws.append([robot.act() for _ in range(30)])
    assert draws[0] == draws[1] and len(set(draws[0])) == 2
    with pytest.raises(ValueError, match="stochastic"):
        mixed.act(None, mixed.start(1))


# --- files ----------------------------------------------------------------------------------------

RUN_ALONE = """
import sys
absent = "jax jaxlib flax optax chex lark matplotlib tqdm click attr attrs jinja2 flatbuffers"
sys.modules |= dict.fromkeys(absent.split())
import jaxltl as jl
policy = jl.io.load_policy(sys.argv[1])
robot = policy.controller(seed=0)
robot.start(1)
print(policy, robot.act(), [robot.update(s) or robot.act() for s in (2, 1, 0)])
"""


def same(one, other):
    for name in ("action", "initial_memory", "next_memory", "letter"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name
    assert (one.label_on, one.actions, one.states) == (other.label_on, other.actions, other.states)
    assert np.array_equal(one.automaton.delta, other.automaton.delta)
    assert one.automaton.state_names == other.automaton.state_names


def test_files_hold_all_of_a_policy(tmp_path, model):
    policy = jl.project_policy(
        model, random_policy(model), actions=["west", "east"], states=["a", "b", "c"]
    )
    path = tmp_path / "policy.npz"
    save_policy(path, policy, {"lower": np.ones(3)})
    same(policy, jl.io.load_policy(path))
    with np.load(path) as file:
        assert file["lower"].tolist() == [1, 1, 1] and str(file["format"]) == "jaxltl policy"
    memoryless = jl.project_policy(WORLD, np.array([1, 0, 1]))
    save_policy(path, memoryless)
    again = load_table(path)
    assert again.automaton is None and again.action.tolist() == [[1], [0], [1]]
    with pytest.raises(ValueError, match="no automaton"):
        again.start(0, {"left"})
    with pytest.raises(ValueError, match="more has 'policy'"):
        save_policy(path, memoryless, {"policy": 1})


def test_a_process_without_jax_runs_a_saved_policy(tmp_path):
    model = jl.product(WORLD, TASK)
    save_policy(tmp_path / "p.npz", jl.project_policy(model, jl.optimal_satisfaction(model).policy))
    done = subprocess.run(
        [sys.executable, "-c", RUN_ALONE, tmp_path / "p.npz"],
        capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "action=int32[3, 3] from 0 to 1" in done.stdout
    assert "1 [0, 0, 0]" in done.stdout  # to the right, then to the left


DAMAGES = {
    "next_memory": (np.full((3, 3), 7), "next_memory has 7; expected 0 to 2"),
    "initial_memory": (np.zeros(2, int), "initial_memory is int64"),
    "policy": (np.full((3, 3, 2), 0.7), r"policy\[0, 0\] sums to 1.4"),
    "letter": (np.full(3, 9), "letter has 9"),
    "label_on": ("somewhere", "label_on is 'somewhere'"),
    "automaton": ("{}", "automaton is not one"),
    "actions": (["a", "b", "c"], "actions has 3 names; expected 2"),
    "version": (2, "jaxltl policy, version 2"),
    "format": ("other", "other, version 1"),
    "kind": ("network", "a network, not a table"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_files_are_refused(tmp_path, name):
    model, path = jl.product(WORLD, TASK), tmp_path / "policy.npz"
    save_policy(path, jl.project_policy(model, random_policy(model)))
    with np.load(path) as file:
        arrays = dict(file)
    value, message = DAMAGES[name]
    np.savez(path, **arrays | {name: np.asarray(value)})
    with pytest.raises(ValueError, match=message):
        load_table(path)
    if name in ("policy", "next_memory"):
        del arrays[name]
        np.savez(path, **arrays)
        with pytest.raises(ValueError, match=f"the array {name} is missing"):
            load_table(path)


def test_missing_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match="cannot be read"):
        jl.io.load_policy(tmp_path / "none.npz")
    (tmp_path / "text").write_text("no archive")
    with pytest.raises(ValueError, match="text"):
        jl.io.load_policy(tmp_path / "text")


# --- C --------------------------------------------------------------------------------------------

MAIN = """
#include <stdio.h>
#include "policy.h"
int main(void) {
  int s, q, n; long long r;
  while (scanf("%d %lld %d", &n, &r, &s) == 3) {
    static int before, memory;
    if (n) memory = policy_update(memory, before, s); else memory = policy_start(s);
    before = s;
    q = memory;
    printf("%d %d\\n", q, policy_act(s, q, (uint32_t)r));
  }
  return 0;
}
"""


def run_c(folder, policy, words, numbers):
    write_c_policy(folder / "policy.h", policy)
    (folder / "main.c").write_text(MAIN)
    flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O1"]
    subprocess.run(["gcc", *flags, "-o", folder / "a", folder / "main.c"], check=True, timeout=60)
    read = "\n".join(
        f"{n} {r} {s}" for word in words for (n, s), r in zip(enumerate(word), numbers, strict=True)
    )
    out = subprocess.run([folder / "a"], input=read, capture_output=True, text=True, check=True)
    return np.array([list(map(int, line.split())) for line in out.stdout.splitlines()])


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
def test_c_code_is_the_policy(tmp_path, model):
    words = np.random.default_rng(0).integers(0, 3, (20, 6))
    table = random_policy(model).argmax(-1).astype(np.int32)
    policy = jl.project_policy(model, table)
    found = run_c(tmp_path, policy, words, [0] * 6).reshape(20, 6, 2)
    for word, rows in zip(words, found, strict=True):
        memory = memory_by_hand(model, word)
        assert rows[:, 0].tolist() == memory
        assert rows[:, 1].tolist() == [table[s, q] for s, q in zip(word, memory, strict=True)]
    # A controller over observations, whose memory starts and changes with what is seen.
    rng = np.random.default_rng(1)
    action, start, step = (rng.integers(0, n, x) for n, x in ((5, (3, 4)), (4, 3), (4, (3, 4))))
    controller = FiniteMemoryPolicy(action, start, step)
    found = run_c(tmp_path, controller, words, [0] * 6).reshape(20, 6, 2)
    for word, rows in zip(words.tolist(), found, strict=True):
        robot = controller.controller()
        robot.start(word[0])
        for i, row in enumerate(rows.tolist()):
            if i:
                robot.update(word[i])
            assert row == [int(robot.at.memory), robot.act()]
    weight = np.array([0.0, 0.25, 0.0, 0.75, 0.0])
    policy = FiniteMemoryPolicy(weight[None, None], np.zeros(1, int), np.zeros((1, 1), int))
    numbers = [0, 2**30 - 1, 2**30, 2**32 - 2, 2**32 - 1, *range(0, 2**32, 2**20)]
    found = run_c(tmp_path, policy, [[0] * len(numbers)], numbers)[:, 1]
    assert found[:5].tolist() == [1, 1, 3, 3, 3]
    assert Counter(found[5:].tolist()) == {1: 1024, 3: 3072}


def test_c_code_refuses_what_it_cannot_express(tmp_path):
    policy = FiniteMemoryPolicy(np.zeros((2, 1, 1), int), np.zeros(1, int), np.zeros((1, 1), int))
    with pytest.raises(ValueError, match="horizon of 2 steps"):
        write_c_policy(tmp_path / "p.h", policy)
    with pytest.raises(ValueError, match="identifier"):
        write_c_policy(tmp_path / "p.h", policy, name="a-b")
