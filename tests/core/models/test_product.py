"""Products: both readings against the product copied out, and what crosses between the two."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.automata.automaton import make_automaton
from tests import reference
from tests.support import as_mdp, bit_labels, random_product, stack

MAX_PROGRAMS = 350  # that the default tests compile at most

READINGS = ("entry", "exit")


def explicit_transition(lazy):
    """The product's transition matrix, read off the primitive one unit value at a time."""
    size = lazy.num_states
    units = jnp.eye(size).reshape(size, *lazy.state_shape)
    columns = jax.jit(jax.vmap(lambda v: jl.models.expectation(lazy, v)))(units)
    return np.moveaxis(np.asarray(columns).reshape(size, size, -1), 0, -1)


@pytest.mark.parametrize("label_on", READINGS)
@pytest.mark.parametrize("acceptance", ["cosafe", "safety"])
def test_the_lazy_product_is_the_explicit_one(label_on, acceptance):
    rng = np.random.default_rng(0)
    for _ in range(10):
        lazy, explicit = random_product(rng, label_on=label_on, acceptance=acceptance)
        np.testing.assert_array_equal(explicit_transition(lazy), explicit.transition)
        np.testing.assert_array_equal(lazy.initial.ravel(), explicit.initial)
        np.testing.assert_array_equal(
            lazy.available.reshape(explicit.available.shape), explicit.available
        )
        np.testing.assert_array_equal(
            np.asarray(lazy.final).ravel(), np.tile(lazy.automaton.final, lazy.mdp.num_states)
        )


def test_the_two_readings_by_hand():
    world = jl.make_mdp(
        [[[1]], [[2]], [[2]]],
        np.ones((3, 1, 1)),
        initial=[1, 0, 0],
        label=[[False], [True], [False]],
        propositions=("g",),
    )
    wait = make_automaton(
        [[0, 1], [1, 1]], 0, [[False], [True]], ["g"], final=[False, True], acceptance="cosafe"
    )
    value = jnp.array([[0.0, 1.0]] * 3)
    entry, leave = jl.product(world, wait), jl.product(world, wait, label_on="exit")
    # On entry g counts on the way from 0 to 1; on exit, on the way from 1 to 2.
    assert jl.models.expectation(entry, value)[:, 0, 0].tolist() == [1, 0, 0]
    assert jl.models.expectation(leave, value)[:, 0, 0].tolist() == [0, 1, 0]
    assert entry.initial_memory.tolist() == [0, 1, 0]
    assert leave.initial_memory.tolist() == [0, 0, 0]


@pytest.mark.parametrize("label_on", READINGS)
def test_restriction_is_the_reachable_part(label_on):
    rng = np.random.default_rng(1)
    for _ in range(20):
        lazy, explicit = random_product(rng, num_states=4, label_on=label_on)
        found = jl.restrict(lazy)
        step = (explicit.transition > 0).any(axis=1)
        reachable = (reference.closure(step) & (explicit.initial > 0)[:, None]).any(axis=0)
        number = np.asarray(found.base_state) * lazy.num_memory + np.asarray(found.memory)
        np.testing.assert_array_equal(number, np.flatnonzero(reachable))
        np.testing.assert_array_equal(
            jl.models.to_dense(found.model).transition,
            explicit.transition[reachable][:, :, reachable],
        )
        np.testing.assert_array_equal(found.model.initial, explicit.initial[reachable])
        np.testing.assert_array_equal(found.model.label, lazy.mdp.label[found.base_state])
        assert found.model.propositions == lazy.mdp.propositions


def test_restriction_to_another_start():
    lazy, explicit = random_product(np.random.default_rng(2))
    start = np.zeros(lazy.state_shape)
    start[1, 2] = 1
    found = jl.restrict(lazy, start)
    number = np.asarray(found.base_state) * lazy.num_memory + np.asarray(found.memory)
    step = (explicit.transition > 0).any(axis=1)
    np.testing.assert_array_equal(number, np.flatnonzero(reference.closure(step)[1 * 3 + 2]))
    assert found.model.initial.sum() == 1


def test_restriction_needs_successor_lists():
    lazy, _ = random_product(np.random.default_rng(3))
    with pytest.raises(ValueError, match="restrict needs successor lists"):
        jl.restrict(lazy.replace(mdp=jl.models.to_dense(lazy.mdp)))


# --- trajectories and policies that cross ------------------------------------------------------


@pytest.mark.parametrize("label_on", READINGS)
def test_lifted_trajectories_are_runs_of_the_automaton(label_on):
    rng = np.random.default_rng(4)
    lazy, explicit = random_product(rng, num_states=4, label_on=label_on)
    policy = jnp.asarray(reference.random_policy(rng, reference_world(lazy)))
    runs = jl.rollout(lazy.mdp, policy, jax.random.key(0), num_trajectories=20, num_steps=9)
    runs = runs.replace(length=jnp.arange(20) % 10)
    lifted = jl.models.lift_trajectories(lazy, runs)
    delta, letter = np.asarray(lazy.automaton.delta), np.asarray(lazy.letter)
    for n in range(20):
        q = int(lazy.automaton.initial)
        for t in range(int(runs.length[n])):
            s = int(runs.state[n, t])
            q = delta[q, letter[s]] if label_on == "entry" else q
            assert lifted.state[n, t] == s * lazy.num_memory + q
            q = q if label_on == "entry" else delta[q, letter[s]]
    np.testing.assert_array_equal(lifted.action, runs.action)
    np.testing.assert_array_equal(lifted.length, runs.length)
    assert not np.asarray(lifted.state)[~np.asarray(lifted.mask)].any(), "padding is zero"
    # Each lifted step is one of the product.
    inside = np.asarray(lifted.mask)[:, 1:]
    s, a, t = lifted.state[:, :-1], lifted.action[:, :-1], lifted.state[:, 1:]
    assert (explicit.transition[s, a, t] > 0)[inside].all()


def reference_world(lazy):
    world = lazy.mdp
    return reference.Model(
        *(
            np.asarray(x)
            for x in (world.successor, world.probability, world.available, world.initial)
        )
    )


@pytest.mark.parametrize("label_on", READINGS)
def test_a_projected_policy_visits_what_the_product_does(label_on):
    """Runs the finite-memory policy on the world alone, as exact distributions over time."""
    rng = np.random.default_rng(5)
    discount, steps = 0.5, 60
    for _ in range(5):
        lazy, explicit = random_product(rng, label_on=label_on)
        shape = (*lazy.state_shape, lazy.num_actions)
        policy = reference.random_policy(rng, explicit).reshape(shape)
        runner = jl.project_policy(lazy, jnp.asarray(policy))
        world = reference_world(lazy)
        follow = [
            [
                np.asarray(runner.next_memory[t if label_on == "entry" else s])
                for t in range(world.num_states)
            ]
            for s in range(world.num_states)
        ]
        now = np.zeros(lazy.state_shape)
        now[np.arange(world.num_states), np.asarray(runner.initial_memory)] = world.initial
        visits = np.zeros(shape)
        for time in range(steps):
            visits += discount**time * now[:, :, None] * policy
            after = np.zeros_like(now)
            for s, q, a, t in np.ndindex(*shape, world.num_states):
                after[t, follow[s][t][q]] += now[s, q] * policy[s, q, a] * world.transition[s, a, t]
            now = after
        found = jl.check(jl.occupancy_measure(lazy, jnp.asarray(policy), discount)).value
        np.testing.assert_allclose(found, visits, atol=1e-12)


def test_a_projected_policy_by_sampling():
    """The share of simulated runs on the world that do the task, against its probability."""
    rng = np.random.default_rng(6)
    lazy, _ = random_product(rng, num_states=4, num_actions=3)
    best = jl.check(jl.optimal_satisfaction(lazy))
    runner = jl.project_policy(lazy, best.policy)

    def run(key):
        start_key, key = jax.random.split(key)
        state = jax.random.categorical(start_key, jnp.log(lazy.mdp.initial)).astype(jnp.int32)
        at = runner.start(state)

        def step(carry, key):
            successor = jl.models.sample_successor(
                lazy.mdp, key, carry.state, runner.act(None, carry)
            )
            return runner.update(carry, successor), None

        at, _ = jax.lax.scan(step, at, jax.random.split(key, 200))
        return jnp.asarray(lazy.automaton.final)[at.memory]

    share = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(0), 4000)).mean()
    expected = float(jnp.sum(lazy.initial * best.value))
    assert abs(share - expected) < 5 * np.sqrt(0.25 / 4000)


def test_lifted_world_policies_forget_the_memory():
    lazy, _ = random_product(np.random.default_rng(7))
    policy = jnp.arange(6.0).reshape(3, 2)
    lifted = jl.lift_policy(lazy, policy)
    assert lifted.shape == (3, 3, 2)
    assert (lifted == policy[:, None]).all()
    assert jl.lift_policy(lazy, jnp.arange(3)).shape == (3, 3)


def test_projected_policies_must_fit():
    lazy, _ = random_product(np.random.default_rng(8))
    with pytest.raises(ValueError, match=r"policy has shape \(3, 2\)"):
        jl.project_policy(lazy, jnp.zeros((3, 2)))


# --- building one, and what is refused ---------------------------------------------------------


def labelled_world():
    return jl.make_mdp(
        [[[1]], [[2]], [[0]]],
        np.ones((3, 1, 1)),
        label=[[True, False], [False, True], [False, False]],
        propositions=("goal", "danger"),
    )


def test_formulas_texts_and_automata_are_the_same_task():
    world, text = labelled_world(), "!danger U goal"
    automaton = jl.to_automaton(text, letters=jl.models.occurring_letters(world))
    for task in (text, jl.parse_ltl(text), automaton):
        lazy = jl.product(world, task)
        np.testing.assert_array_equal(lazy.automaton.delta, automaton.delta)
        np.testing.assert_array_equal(lazy.automaton.final, automaton.final)
        np.testing.assert_array_equal(lazy.letter, jl.product(world, automaton).letter)


def test_letters_of_a_world():
    world = labelled_world()
    assert set(jl.models.occurring_letters(world)) == {
        frozenset(),
        frozenset({"goal"}),
        frozenset({"danger"}),
    }
    assert set(jl.models.occurring_letters(world, ["goal"])) == {frozenset(), frozenset({"goal"})}


def test_unknown_propositions_name_themselves_and_the_closest():
    message = "the proposition 'gaol', .* goal, danger. Did you mean 'goal'?"
    with pytest.raises(ValueError, match=message):
        jl.product(labelled_world(), "F gaol")
    with pytest.raises(ValueError, match=message):
        jl.product(labelled_world(), jl.to_automaton("F gaol"))


def test_letters_that_the_automaton_was_not_built_for():
    automaton = jl.to_automaton("F goal & F danger", letters=[{"goal"}, set()])
    with pytest.raises(ValueError, match=r"world state 1 shows the letter \{danger\}, which"):
        jl.product(labelled_world(), automaton)


def test_unknown_reading():
    with pytest.raises(ValueError, match="label_on='leave'"):
        jl.product(labelled_world(), "F goal", label_on="leave")


def test_products_are_batched_like_any_tree():
    rng = np.random.default_rng(9)
    pairs = [random_product(rng) for _ in range(5)]
    batch = stack([lazy for lazy, _ in pairs])
    value = jnp.asarray(rng.normal(size=(5, 3, 3)))
    found = jax.jit(jax.vmap(jl.models.expectation))(batch, value)
    for i, (_, explicit) in enumerate(pairs):
        expected = reference.expectation(explicit, np.asarray(value[i]).ravel())
        np.testing.assert_allclose(found[i].reshape(expected.shape), expected, atol=1e-14)


def test_only_used_propositions_make_letters():
    rng = np.random.default_rng(10)
    world = reference.random_model(rng, 64, 1, 1)
    names = tuple(f"p{i}" for i in range(6))
    mdp = as_mdp(world, label=bit_labels(np.arange(64), 6), propositions=names)
    lazy = jl.product(mdp, "F p3")
    assert lazy.automaton.delta.shape == (2, 2)
    np.testing.assert_array_equal(
        np.asarray(lazy.automaton.letters)[np.asarray(lazy.letter), 0], np.arange(64) >> 3 & 1
    )


def test_two_formulas_of_one_shape_share_a_program():
    world = jl.gridworld("a . b\n. . .", slip=0.1)
    models = [jl.product(world, task) for task in ("F a", "F b")]

    @jax.jit
    def weigh(model):
        return jnp.sum(model.final * model.next_memory)

    for model in models:
        weigh(model)
    assert weigh._cache_size() == 1
    assert [m.automaton.propositions for m in models] == [("a",), ("b",)]
    again = jax.tree.map(lambda x: x, models[1])
    assert again.automaton.state_names == models[1].automaton.state_names


def test_programs_return_no_text_of_another_formula():
    world = jl.gridworld("a . b\n. . .", slip=0.1)
    first, second = (jl.product(world, task) for task in ("F a", "F b"))
    returned = jax.jit(lambda model: model)
    for model in (first, second):
        found = returned(model).automaton
        assert found.propositions == () and found.state_names == ()
        assert "propositions=()" in repr(found)
    assert returned._cache_size() == 1
    shape = jax.eval_shape(lambda model: model, second)
    assert shape.automaton.propositions == ()
    assert jax.tree.map(np.asarray, second).automaton.propositions == ("b",)


@pytest.mark.parametrize("kind", [lambda x: x, jl.to_sparse])
def test_a_product_has_one_task(kind):
    once = jl.product(kind(jl.gridworld("a . b")), "F a")
    with pytest.raises(ValueError, match=r"world is a product.*product\(world.mdp, "):
        jl.product(once, "G !b")


def test_a_name_split_into_operators_is_explained():
    world = jl.gridworld("a . Goal")
    with pytest.raises(ValueError, match=r'If Goal was written.*operator G and oal.*write "Goal"'):
        jl.product(world, "F Goal")
    assert jl.product(world, 'F "Goal"').automaton.propositions == ("Goal",)
    with pytest.raises(ValueError, match="Did you mean 'a'"):
        jl.product(world, "F aa")


NEEDS_NAMES = {
    "is_equivalent": lambda one, _: jl.automata.is_equivalent(one, "F a"),
    "is_equivalent to itself": lambda one, _: jl.automata.is_equivalent(one, one),
    "is_included": lambda one, _: jl.automata.is_included("F a", one),
    "find_difference": lambda one, _: jl.automata.find_difference(one, "F a"),
    "synchronize": lambda one, _: jl.automata.synchronize(one, "F a"),
    "accepts_lasso": lambda one, _: jl.automata.accepts_lasso(one, [], [{"a"}]),
    "write_hoa": lambda one, _: jl.io.write_hoa(one),
    "product": lambda one, world: jl.product(world, one),
    "optimal_satisfaction": lambda one, world: jl.optimal_satisfaction(jl.to_sparse(world), one),
}


@pytest.mark.parametrize("name", NEEDS_NAMES)
def test_an_automaton_without_names_is_refused_where_they_count(name):
    """A compiled program returns the arrays of an automaton alone."""
    world = jl.from_dense([[[0.5, 0.5]], [[0, 1]]], label={"a": [1]})
    arrays = jax.jit(lambda x: x)(jl.product(world, "F a")).automaton
    with pytest.raises(ValueError, match="0 names for 1 propositions"):
        NEEDS_NAMES[name](arrays, world)
