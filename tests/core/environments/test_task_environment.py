"""A world with a task: what the automaton reads, when episodes end, and many tasks at once."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from jaxltl.core.automata.automaton import accepts_lasso, make_automaton, run
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.environment import Timestep, make_box, make_environment
from jaxltl.core.environments.episodes import make_agent, run_episode, with_time_limit
from jaxltl.core.environments.model_environment import model_environment
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.environments.task_environment import (
    TaskObservation,
    TaskWorld,
    make_task_tables,
    residual_formula,
    stack_tables,
    stack_tasks,
    task_environment,
    task_tables,
    with_task_tables,
)
from tests import reference
from tests.support import as_mdp, lane, random_action

MAX_PROGRAMS = 450  # that the default tests compile at most

NAMES = ("a", "b", "c")
FORMULAS = (
    "!b U (a & X c)",
    "G (a -> X !b)",
    "G F a & G !(b & c)",
    "F G a | c",
    "G F a -> G F b",
    "true",
    "c",
)


def ends(share, state, action, key):
    """A walk on eight labels, where an episode ends now and then, or is cut off."""
    where, end = jax.random.split(key)
    after = jax.random.randint(where, (), 0, 8, jnp.int32)
    chance = jax.random.uniform(end)
    return Timestep(
        after,
        reward=7.0,
        terminated=chance < share,
        truncated=chance > 1 - share,
        cost=after / 8,
        discount=jnp.where(after == 3, 0.5, 1.0),
    )


def bits(state):
    return (state >> jnp.arange(3) & 1).astype(bool)


@cache
def walk(share=0.05):
    return make_environment(
        lambda key: jax.random.randint(key, (), 0, 8, jnp.int32),
        Partial(ends, jnp.float64(share)),
        lambda state: {"state": state[None] / 8},
        actions=2,
        labels=bits,
        propositions=NAMES,
        allowed=lambda state: jnp.array([True, True]) & (state != 3),
    )


def random_agent():
    return make_agent(lambda seen, key: random_action(key, walk().actions))


@partial(jax.jit, static_argnames="num_steps")
def episodes(keys, environments, num_steps=12):
    """``[E, N]``: N episodes of each of a stack of environments."""
    one = jax.vmap(
        lambda key, e: run_episode(key, e, random_agent(), num_steps=num_steps), (0, None)
    )
    return jax.vmap(one, (None, 0))(keys, environments)


def word_of(label):
    return [{n for n, holds in zip(NAMES, row, strict=True) if holds} for row in label]


@pytest.mark.parametrize("ending", ["repeat", "violated", "undecided", "rejected"])
def test_world_and_automaton_step_together(ending):
    tasks = [task_environment(walk(), to_automaton(f), ending=ending) for f in FORMULAS]
    keys = jax.random.split(jax.random.key(0), 40)
    found = jax.tree.map(np.asarray, episodes(keys, stack_tasks(tasks)))
    seen = set()
    for e, formula in enumerate(FORMULAS):
        automaton = to_automaton(formula)
        told = verdicts(automaton)
        final = automaton.final if automaton.acceptance in ("cosafe", "safety") else None
        for n in range(len(keys)):
            one = jax.tree.map(lambda x, at=(e, n): x[at], found)
            length = int(one.valid.sum())
            word = word_of(one.label[: length + 1])
            states = run(automaton, word)
            world = one.world
            assert world.memory[: length + 1].tolist() == states[1:].tolist()
            assert world.memory[0] == run(automaton, word[:1])[-1]
            reads = [
                automaton.letters.tolist().index(
                    [name in letter for name in automaton.propositions]
                )
                for letter in word
            ]
            accepted = (
                [bool(final[q]) for q in states[1:]]
                if final is not None
                else [
                    bool(automaton.accepting[q, x]) for q, x in zip(states[:-1], reads, strict=True)
                ]
            )
            assert world.accepted[: length + 1].tolist() == accepted
            assert world.visits[: length + 1].tolist() == np.cumsum(accepted).tolist()
            early = [told[q] for q in states[1:]]
            assert world.verdict[:length].tolist() == early[:-1]
            assert not any(early[1:-1]), "an episode goes on although it is decided"
            last, over = int(world.verdict[length]), bool(one.terminated)
            if early[-1] != Verdict.UNDECIDED:
                # An episode may end in the world at the same step, which "rejected" puts first.
                assert over and last in (early[-1], *([2] if ending == "rejected" else []))
            elif over:  # the world itself ended
                accepts = accepts_lasso(automaton, word, word[-1:])
                repeats = 1 if accepts else 2
                expected = {"repeat": repeats, "violated": 2, "undecided": 0, "rejected": 2}
                assert last == expected[ending]
            else:
                assert last == 0 and (bool(one.truncated) or length == 12)
            seen.add((over, bool(early[-1]), last))
    assert len(seen) == {"repeat": 5, "violated": 4, "undecided": 4, "rejected": 4}[ending]


def test_the_last_letter_repeats_for_ever():
    rng = np.random.default_rng(6)
    letters = [[False], [True]]
    for _ in range(20):
        delta, priority = rng.integers(7, size=(7, 2)), rng.integers(4, size=(7, 2))
        automaton = make_automaton(delta, 0, letters, ["a"], priority=priority)
        found = make_task_tables(automaton, NAMES, discount=0.5).repeated
        for state, letter in np.ndindex(7, 2):
            start = make_automaton(delta, state, letters, ["a"], priority=priority)
            accepts = accepts_lasso(start, [], [{"a"} if letter else {}])
            assert found[state, letter] == (Verdict.SATISFIED if accepts else Verdict.VIOLATED)


def test_resets_are_joint():
    task = task_environment(walk(), "F (a & X b)")
    keys = jax.random.split(jax.random.key(1), 30)
    inner, joint = jax.vmap(walk().reset)(keys), jax.vmap(task.reset)(keys)
    assert isinstance(joint, TaskWorld)
    np.testing.assert_array_equal(joint.world, inner)
    np.testing.assert_array_equal(joint.memory, np.asarray(inner) & 1)
    np.testing.assert_array_equal(jax.vmap(task.labels)(joint), jax.vmap(bits)(inner))


def test_what_the_inner_world_says_is_kept():
    task = task_environment(walk(0.3), "G F a", reward="two-discount", discount=0.9, ratio=0.5)
    world, cut = task.reset(jax.random.key(2)), 0
    both = jax.jit(
        lambda world, key: (walk(0.3).step(world.world, 0, key), task.step(world, 0, key))
    )
    for key in jax.random.split(jax.random.key(3), 40):
        inner, found = both(world, key)
        accepting = bool(bits(inner.world)[0])
        assert found.world.world == inner.world and found.cost == inner.cost
        assert found.truncated == inner.truncated
        assert found.terminated == inner.terminated
        assert float(found.discount) == pytest.approx(
            float(inner.discount) * (0.9 if accepting else 0.95)
        )
        if not found.terminated:
            assert float(found.reward) == pytest.approx(0.1 if accepting else 0)
        assert task.allowed(found.world).tolist() == walk(0.3).allowed(inner.world).tolist()
        cut += int(found.truncated)
        world = found.world
    assert cut
    assert task.propositions == NAMES and task.actions == walk().actions


def test_what_is_seen():
    task = task_environment(walk(), "F (a & X b)")
    world = task.reset(jax.random.key(0))._replace(memory=jnp.int32(1))
    seen = task.observe(world)
    assert isinstance(seen, TaskObservation) and seen.memory.tolist() == [0, 1, 0]
    assert seen.world["state"].tolist() == [int(world.world) / 8]
    assert task.observations.memory.shape == (3,) and "state" in task.observations.world
    shown = np.arange(6.0).reshape(3, 2)
    embedded = task_environment(walk(), "F (a & X b)", embedding=shown)
    assert embedded.observe(world).memory.tolist() == [2, 3]
    assert embedded.observations.memory.shape == (2,)


def test_what_the_first_label_decides_ends_with_the_first_step():
    labels = {"labels": lambda state: (state >= 0)[None], "propositions": ["yes"]}
    for formula, reward in (("yes", 1), ("X X yes | yes", 1), ("G !yes", -1)):
        task = task_environment(walk(0), formula, **labels)
        found = task.step(task.reset(jax.random.key(0)), 0, jax.random.key(1))
        assert bool(found.terminated) and float(found.reward) == reward


def test_a_time_limit_decides_nothing():
    for task in (
        task_environment(with_time_limit(walk(0), 3), to_automaton("F (a & !a)")),
        with_time_limit(task_environment(walk(0), "G F a"), 3),
    ):
        episode = run_episode(jax.random.key(0), task, random_agent(), num_steps=5)
        assert int(episode.valid.sum()) in (1, 3) and task.horizon == 3
    assert bool(episode.truncated) and not bool(episode.terminated)
    assert int(episode.world[0].verdict[-1]) == Verdict.UNDECIDED


# --- many tasks -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_each_of_a_stack_is_as_by_itself():
    tasks = [task_environment(walk(), to_automaton(f)) for f in FORMULAS]
    stacked = stack_tasks(tasks)
    keys = jax.random.split(jax.random.key(4), 5)
    found = episodes(keys, stacked)
    sizes = [task_tables(task).delta.shape[0] for task in tasks]
    assert stacked.observations.memory.shape == (max(sizes),)
    i = 3
    assert sizes[i] < max(sizes)
    alone = lane(episodes(keys, stack_tasks(tasks[i : i + 1])), 0)
    mine = jax.tree.map(np.asarray, lane(found, i))
    memory = mine.observation.memory
    assert not memory[..., sizes[i] :].any()
    mine = mine._replace(observation=mine.observation._replace(memory=memory[..., : sizes[i]]))
    jax.tree.map(np.testing.assert_array_equal, mine, alone)


def test_tables_are_exchanged_within_one_program():
    count = 0
    tables = stack_tables([make_task_tables(f, NAMES, ending="violated") for f in FORMULAS])

    @jax.jit
    def memory(tables, key):
        nonlocal count
        count += 1
        return with_task_tables(task_environment(walk(), "F a"), tables).reset(key).memory

    for i, formula in enumerate(FORMULAS):
        key = jax.random.key(i)
        task = task_environment(walk(), to_automaton(formula), ending="violated")
        assert memory(lane(tables, i), key) == task.reset(key).memory
    assert count == 1


def test_tables_that_are_made_are_taken():
    tables = make_task_tables("F a", NAMES, discount=0.5)
    task = task_environment(walk(), tables)
    assert task_tables(task) is tables
    assert float(task.step(task.reset(jax.random.key(0)), 0, jax.random.key(0)).discount) == 0.5


# --- texts ----------------------------------------------------------------------------------------


def test_what_is_left_of_a_formula():
    automaton = to_automaton("F (a & X b)")
    task = task_environment(walk(), "F (a & X b)")
    for place in (task, task_tables(task), automaton):
        assert residual_formula(place, jnp.int32(0)) == "F (a & X b)"
        assert residual_formula(place, 2) == "true"
        with pytest.raises(ValueError, match=r"memory=3; the automaton has the states 0\.\.2"):
            residual_formula(place, 3)
    nameless = make_automaton([[1], [0]], 0, np.zeros((1, 0), bool), [], accepting=[True, False])
    assert residual_formula(nameless, 1) == "state 1 of 2"
    with pytest.raises(ValueError, match="has no task"):
        residual_formula(walk(), 0)


def test_programs_and_stacks_show_no_text_of_another_formula():
    tasks = [task_environment(walk(), f"F {name}") for name in "ab"]
    returned = jax.jit(lambda task: task)
    for task in tasks:
        assert residual_formula(returned(task), 0) == "state 0 of 2"
    assert returned._cache_size() == 1
    assert residual_formula(jax.tree.map(np.asarray, tasks[1]), 0) == "F b"
    assert task_tables(stack_tasks(tasks)).state_names == ()


# --- what is drawn --------------------------------------------------------------------------------


def test_outcomes_are_those_of_the_steps():
    rng = np.random.default_rng(3)
    model = reference.random_model(rng, 5, 2, 3, certainty=0)
    label = rng.random((5, 3)) < 0.5
    inner = model_environment(as_mdp(model, label=label, propositions=NAMES))
    task = task_environment(inner, "G F a & F (b & X c)", reward="two-discount")
    worlds, probability = task.starts()
    np.testing.assert_allclose(probability, model.initial)
    again = jax.vmap(task.reset)(jax.random.split(jax.random.key(0), 30))
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x, y[again.world]), again, worlds)
    keys = jax.random.split(jax.random.key(1), 12)
    state, action = np.argwhere(model.available).T
    before = jax.tree.map(lambda x: x[state], worlds)
    told, chance = jax.jit(jax.vmap(task.outcomes))(before, action)
    drawn = jax.jit(jax.vmap(jax.vmap(task.step, (None, None, 0)), (0, 0, None)))(
        before, action, keys
    )
    np.testing.assert_allclose(chance.sum(1), 1)
    told, drawn, chance = jax.tree.map(np.asarray, (told, drawn, chance))
    for row, i in np.ndindex(len(state), len(keys)):
        found = jax.tree.map(lambda x, at=(row, i): x[at], drawn)
        same = np.flatnonzero((told.world.world[row] == found.world.world) & (chance[row] > 0))
        assert same.size
        other = jax.tree.map(lambda x, at=(row, same[0]): x[at], told)
        assert all(map(np.array_equal, jax.tree.leaves(found), jax.tree.leaves(other)))


# --- bad input ------------------------------------------------------------------------------------


def draws_by_itself(state, action, key):
    return Timestep(state + int(np.random.default_rng().integers(1 << 30)), 0.0, False)


def impure():
    return walk().replace(step=Partial(draws_by_itself))


@pytest.mark.parametrize(
    ("arguments", "options", "text"),
    [
        ((walk, "F goal"), {}, "the formula 'F goal' mentions the proposition 'goal'"),
        ((walk, to_automaton("F goal")), {}, "the automaton mentions the proposition 'goal'"),
        ((walk, to_automaton("F a & F b", [{"a"}, {}])), {}, "does not read the letter"),
        (
            (walk, " & ".join(f"F c{i}" for i in range(13))),
            {},
            "13 propositions, and the limit is 12",
        ),
        ((walk, "F a"), {"labels": lambda state: bits(state)[:2]}, r"labels returns bool\[2\]"),
        (
            (walk, "F a"),
            {"labels": lambda state: state[None] * 1.0, "propositions": ["a"]},
            "labels",
        ),
        ((walk, "F a"), {"propositions": ["a"]}, r"return bool\[1\]"),
        ((impure, "F a"), {}, "step is not pure"),
        ((walk, "F a"), {"ending": "never"}, "choose one of repeat, violated, undecided"),
        ((walk, "F a"), {"embedding": np.zeros((3, 2))}, r"numbers \[2, ...\]"),
        ((walk, "F a"), {"embedding": np.zeros(2)}, "a row for each state"),
        ((walk, "F a"), {"discount": 2}, "discount=2"),
        ((walk, "G a"), {"reward": "reach"}, "safety"),
        ((walk, make_task_tables("F a", ["a"])), {}, "of 1 propositions, and the world has 3"),
    ],
)
def test_bad_input_is_named(arguments, options, text):
    environment, formula = arguments
    with pytest.raises(ValueError, match=text):
        task_environment(environment(), formula, **options)


def test_what_cannot_be_stacked_is_named():
    for stack in (stack_tables, stack_tasks):
        with pytest.raises(ValueError, match="at least one"):
            stack([])
    first, other = make_task_tables("F a", NAMES), make_task_tables("F a", ["a"])
    with pytest.raises(ValueError, match="over 3 and 1 propositions"):
        stack_tables([first, other])
    wide = make_task_tables("F a", NAMES, embedding=np.zeros((2, 4)))
    with pytest.raises(ValueError, match="embeddings of shapes"):
        stack_tables([first, wide])
    with pytest.raises(ValueError, match="different structure"):
        stack_tasks(
            [task_environment(walk(), "F a"), task_environment(with_time_limit(walk(), 9), "F a")]
        )


def test_boxes_of_actions_do_as_well():
    world = make_environment(
        lambda key: jnp.zeros(2),
        lambda at, by, key: Timestep(at + by, 0.0, False),
        lambda at: at,
        actions=make_box(-1, 1, [2]),
        labels=lambda at: at[:1] > 1,
        propositions=["far"],
    )
    task = task_environment(world, "F far")
    found = task.step(task.reset(jax.random.key(0)), jnp.array([2.0, 0]), jax.random.key(0))
    assert bool(found.terminated) and float(found.reward) == 1 and task.allowed is None


@pytest.mark.parametrize(
    "formula, kind", [("true", "valid"), ("F a | !F a", "valid"), ("G a & F !a", "unsatisfiable")]
)
def test_trivial_formulas_are_named(formula, kind):
    with pytest.raises(ValueError, match=f"is {kind}: .* its automaton"):
        task_environment(walk(), formula)
    kept = task_environment(walk(), to_automaton(formula))
    assert kept.reset(jax.random.key(0)).verdict != 0
