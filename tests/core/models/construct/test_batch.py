"""Several worlds as one batch, and the memory of one automaton beside the task of another."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.automata.automaton import accepts_lasso, run
from jaxltl.core.automata.language import synchronize
from jaxltl.core.models.construct.batch import (
    as_stacked,
    demonstration_counts,
    is_stacked,
    lift_memory_policy,
    num_worlds,
    pad_states,
    split_trajectories,
    stack_models,
    stack_products,
    unstack_product,
)
from jaxltl.core.models.mdp import make_mdp, to_dense
from jaxltl.core.models.ops.operators import expectation

TASK = "!b U (g & (!b U h))"


def small_world():
    return jl.gridworld("g . b\n. . h")


def large_world():
    """More cells, more successors, and its propositions in another order."""
    world = jl.gridworld("h b . .\n. . . g", slip=0.2)
    order = [world.propositions.index(p) for p in ("h", "b", "g")]
    return make_mdp(
        world.successor,
        world.probability,
        initial=world.initial,
        label=np.asarray(world.label)[:, order],
        propositions=("h", "b", "g"),
    )


@pytest.mark.parametrize("label_on", ["exit", "entry"])
def test_a_stacked_world_is_its_own_product(label_on):
    worlds = [small_world(), large_world()]
    stacked = stack_products(worlds, TASK, label_on=label_on)
    assert num_worlds(stacked) == 2
    value = np.random.default_rng(0).normal(size=(8, stacked.num_memory))
    found = jax.jit(jax.vmap(lambda m: expectation(m, jnp.asarray(value))))(stacked)
    automaton = jl.to_automaton(TASK, letters=[set(), {"b"}, {"g"}, {"h"}])
    for i, one in enumerate(worlds):
        alone = jl.product(one, automaton, label_on=label_on)
        size = one.num_states
        np.testing.assert_allclose(
            found[i][:size], jax.jit(expectation)(alone, jnp.asarray(value[:size])), rtol=1e-12
        )
        lane = unstack_product(stacked, i)
        np.testing.assert_array_equal(lane.initial[:size], alone.initial)
        assert float(lane.initial[size:].sum()) == 0
        assert lane.mdp.propositions == worlds[0].propositions


def test_padding_is_out_of_reach():
    world = small_world()
    padded = pad_states(world, 9)
    assert padded.num_states == 9
    assert np.asarray(padded.successor)[:6].max() < 6
    reward = jnp.arange(36.0).reshape(9, 4)
    alone = jl.optimal_value(world, reward[:6], 0.9).value
    np.testing.assert_allclose(jl.optimal_value(padded, reward, 0.9).value[:6], alone, rtol=1e-9)
    np.testing.assert_array_equal(padded.successor[7, :, 0], 7)
    jax.tree.map(np.testing.assert_array_equal, pad_states(world, 6), world)
    with pytest.raises(ValueError, match="has 6 states, more than 5"):
        pad_states(world, 5)


def test_a_task_over_nothing_is_the_memoryless_one():
    stacked = stack_products([small_world(), large_world()], "true")
    assert stacked.automaton.delta.tolist() == [[[0]], [[0]]]


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ([jl.gridworld("g . b\n. . .")], "world 1 does not have the propositions.*lacks h"),
        ([jl.gridworld("g h b\n. . x")], "world 1 does not have the propositions.*has x besides"),
        (
            [small_world(), make_mdp(np.zeros((1, 1, 1), int), np.ones((1, 1, 1)))],
            "world 2 has 1 actions and world 0 has 4",
        ),
        ([to_dense(small_world())], "world 1 is a DenseMDP"),
    ],
)
def test_worlds_that_differ_are_named(others, message):
    with pytest.raises(ValueError, match=message):
        stack_products([small_world(), *others], TASK)


def test_worlds_that_the_task_does_not_fit_are_named():
    with pytest.raises(ValueError, match="no worlds"):
        stack_products([], TASK)
    automaton = jl.to_automaton("F g", letters=[{"g"}])
    with pytest.raises(ValueError, match=r"world 0: world state 1 shows the letter \{\}"):
        stack_products([small_world()], automaton)
    with pytest.raises(ValueError, match="mentions the proposition 'k'"):
        stack_products([small_world()], "F k")


def test_products_of_one_kind_stack():
    one, two = (jl.product(jl.gridworld(m), "!b U g") for m in ("g . b\n. . .", ". b .\n. . g"))
    stacked = stack_models([one, two])
    assert is_stacked(stacked) and not is_stacked(one)
    np.testing.assert_array_equal(unstack_product(stacked, 1).letter, two.letter)
    assert stack_models(stacked) is stacked
    assert num_worlds(stack_models(one)) == 1
    assert num_worlds(one) == 1
    with pytest.raises(ValueError, match="world 1 has another automaton"):
        stack_models([one, jl.product(jl.gridworld("g . b\n. . ."), "!g U b")])
    with pytest.raises(ValueError, match="world 1 does not have the shapes"):
        stack_models([one, jl.product(jl.gridworld("g b"), one.automaton)])
    with pytest.raises(ValueError, match="give a product"):
        stack_models([])


# --- two automata side by side ---------------------------------------------------------------


def random_words(rng, propositions, count):
    def word(length):
        return [{p for p in propositions if rng.random() < 0.4} for _ in range(length)]

    return [(word(rng.integers(4)), word(rng.integers(1, 4))) for _ in range(count)]


@pytest.mark.parametrize(
    ("memory", "task"),
    [
        ("F a", "!b U a"),
        ("!b U a", "G !c"),
        ("true", "G F a"),
        ("F (a & F b)", "F G a | G F c"),
        ("G a", "F b"),
    ],
)
def test_both_run_and_the_second_decides(memory, task):
    first, second = jl.to_automaton(memory), jl.to_automaton(task)
    both = synchronize(memory, task)
    assert both.acceptance == second.acceptance
    assert len(both.delta) == len(first.delta) * len(second.delta)
    rng = np.random.default_rng(0)
    verdicts = set()
    for prefix, cycle in random_words(rng, "abc", 60):
        verdict = accepts_lasso(both, prefix, cycle)
        verdicts.add(verdict)
        assert verdict == accepts_lasso(second, prefix, cycle)
        states = run(both, [*prefix, *cycle])
        np.testing.assert_array_equal(states // len(second.delta), run(first, [*prefix, *cycle]))
        np.testing.assert_array_equal(states % len(second.delta), run(second, [*prefix, *cycle]))
    assert verdicts == {True, False}


def test_automata_without_a_common_letter_are_refused():
    with pytest.raises(ValueError, match="no letter of one automaton agrees"):
        synchronize(
            jl.to_automaton("F a", letters=[{"a"}]), jl.to_automaton("F a", letters=[set()])
        )


def probability(model, policy):
    """Of the task, by the sparse engine, which compiles nothing."""
    return jl.satisfaction_probability(model, policy, tolerance=1e-12).value


@pytest.mark.parametrize("label_on", ["exit", "entry"])
def test_a_lifted_policy_is_judged_by_the_other_task(label_on):
    """With the task's own memory the judgement is the direct one; with less, a simulation's."""
    world = small_world()
    direct = jl.product(world, TASK, label_on=label_on)
    rng = np.random.default_rng(1)
    policy = jnp.asarray(rng.dirichlet(np.ones(4), size=direct.state_shape))
    both = jl.product(world, synchronize(direct.automaton, direct.automaton), label_on=label_on)
    lifted = lift_memory_policy(policy, direct.automaton)
    one, other = probability(direct, policy), probability(both, lifted)
    start, pair = (m.initial_memory for m in (direct, both))
    s = jnp.arange(world.num_states)
    np.testing.assert_allclose(other[s, pair], one[s, start], atol=1e-12)
    actions = jnp.asarray(rng.integers(4, size=direct.state_shape))
    np.testing.assert_array_equal(
        lift_memory_policy(actions, 3)[:, 3 * 2 : 3 * 3], np.repeat(actions[:, 2:3], 3, axis=1)
    )
    memoryless = jl.product(world, synchronize("true", direct.automaton), label_on=label_on)
    flat = jnp.asarray(rng.dirichlet(np.ones(4), size=(world.num_states, 1)))
    np.testing.assert_allclose(
        probability(memoryless, lift_memory_policy(flat, direct.automaton)),
        probability(direct, jl.lift_policy(direct, flat[:, 0])),
        atol=1e-12,
    )


# --- demonstrations -----------------------------------------------------------------------------


def demonstrations(*runs):
    return jl.make_trajectories(small_world(), [list(run) for run in runs])


def test_pairs_are_counted_in_each_world():
    models = stack_products([small_world(), small_world()], TASK)
    first = demonstrations([(0, 1), (3, 3), (4, 3), (5, 0)], [(0, 1)])
    empty = first.replace(length=first.length.at[1].set(0))
    counts = demonstration_counts(models, [first, empty])
    assert counts.sum((1, 2, 3)).tolist() == [5, 4]
    memory = np.asarray(models.automaton.delta[0])
    letter = np.asarray(models.letter[0])
    start = int(models.automaton.initial[0])
    after = memory[start, letter[0]]
    assert counts[0, 0, start, 1] == 2 and counts[1, 0, start, 1] == 1
    assert counts[0, 3, after, 3] == counts[0, 4, after, 3] == counts[0, 5, after, 0] == 1
    with pytest.raises(ValueError, match="demonstrations in 1 worlds; expected 2"):
        demonstration_counts(models, first)
    wrong = first.replace(state=first.state.at[0, 1].set(5))
    with pytest.raises(ValueError, match="demonstrations in world 1: trajectory 0, step 0"):
        demonstration_counts(models, [first, wrong])


@pytest.mark.parametrize("label_on", ["exit", "entry"])
def test_pairs_are_those_of_lifted_trajectories(label_on):
    model = jl.product(small_world(), TASK, label_on=label_on)
    runs = jl.rollout(
        small_world(), jnp.full((6, 4), 0.25), jax.random.key(0), num_trajectories=20, num_steps=15
    )
    lifted = jl.models.lift_trajectories(model, runs)
    expected = np.zeros((15, model.num_states, 4))
    np.add.at(expected, (np.arange(15), np.asarray(lifted.state), np.asarray(lifted.action)), 1)
    found = demonstration_counts(as_stacked(model), runs, horizon=15)
    np.testing.assert_array_equal(found[0].reshape(expected.shape), expected)
    found = demonstration_counts(as_stacked(model), runs)
    np.testing.assert_array_equal(found[0].reshape(expected.shape[1:]), expected.sum(0))


def test_the_last_trajectories_are_held_out():
    runs = demonstrations(*[[(s, 0)] for s in range(5)])
    (train,), (test,) = split_trajectories(runs, 0.4)
    assert train.state[:, 0].tolist() == [0, 1, 2] and test.state[:, 0].tolist() == [3, 4]
    with pytest.raises(ValueError, match=r"held_out=1\.0"):
        split_trajectories([runs], 1.0)
