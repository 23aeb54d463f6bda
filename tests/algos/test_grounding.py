"""Symbol grounding: laws of its likelihood against enumeration, differences and mlirl."""

import itertools
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from jax.flatten_util import ravel_pytree

import jaxltl as jl
from jaxltl.algos import grounding, mlirl
from jaxltl.algos.grounding.hypotheses import letters_of, step_log_likelihood
from jaxltl.algos.grounding.problem import (
    event_reward,
    forward,
    letter_log_probability,
    mean_event_reward,
    memory_log_moves,
)
from jaxltl.core.models.construct.lifting import lift_trajectories
from jaxltl.envs.gridworld import gridworld
from tests.algos.cases import LearnerCase, world

MAX_PROGRAMS = 450  # that the default tests compile at most

TASK = "!c U (a & F b)"
MAP = "a . b\n. c .\nd . ."


@cache
def world_of(text=MAP):
    """A gridworld, and one-hot observations of its kinds of cells a to d."""
    world = gridworld(text, slip=0.1)
    cells = np.array([list(row.replace(" ", "")) for row in text.split("\n")]).ravel()
    return world, np.stack([cells == kind for kind in "abcd"], axis=1).astype(float)


soft_policy = jax.jit(grounding.demonstrator_policy)


def rollouts(model, policy, count, length, seed=0):
    """Demonstrations ``(state, action)`` of a policy ``[S, Q, A]`` in a product, in its base model."""
    rng, found = np.random.default_rng(seed), []
    delta, letter = np.asarray(model.automaton.delta), np.asarray(model.letter)
    policy = np.asarray(policy, float)
    for _ in range(count):
        s = rng.choice(model.mdp.num_states, p=np.asarray(model.mdp.initial, float))
        q, pairs = delta[int(model.automaton.initial), letter[s]], []
        for _ in range(length):
            a = rng.choice(policy.shape[-1], p=policy[s, q] / policy[s, q].sum())
            pairs.append((int(s), int(a)))
            s = rng.choice(
                np.asarray(model.mdp.successor)[s, a], p=np.asarray(model.mdp.probability)[s, a]
            )
            q = delta[q, letter[s]]
        found.append(pairs)
    return jl.make_trajectories(model.mdp, found)


def demonstrator(world, task=TASK):
    model = jl.product(world, task)
    return model, soft_policy(model, 40.0, 0.95)


objective = jax.jit(grounding.objective)


def small_problem(count=3, length=5, task=TASK, **options):
    world, seen = world_of()
    model, policy = demonstrator(world)
    return grounding.make_problem(
        world, seen, rollouts(model, policy, count, length), task, **options
    )


def test_forward_is_the_sum_over_memory_paths():
    rng = np.random.default_rng(0)
    start, emit, move = (np.log(rng.random(shape)) for shape in ((3,), (4, 3), (3, 3, 3)))
    for length in (1, 3, 4):
        total = -np.inf
        for path in itertools.product(range(3), repeat=length):
            one = start[path[0]] + sum(emit[t, q] for t, q in enumerate(path))
            one += sum(move[t, path[t], path[t + 1]] for t in range(length - 1))
            total = np.logaddexp(total, one)
        np.testing.assert_allclose(forward(start, emit, move, length), total, rtol=1e-12)


def test_likelihood_is_the_sum_over_letters_and_memory_paths():
    """Against a literal enumeration of the letters read along a demonstration."""
    problem, hparams = small_problem(count=2, length=3), grounding.Hparams(scale=5.0)
    state = grounding.init(jax.random.key(1), problem, hparams)
    _, parts = objective(state.parameters, problem, hparams)
    automaton = jax.tree.map(lambda x: x[0], problem.model.automaton)
    logs = np.asarray(
        letter_log_probability(
            problem.network,
            state.parameters["grounding"],
            problem.observation[0],
            automaton.letters,
        )
    )
    np.testing.assert_allclose(np.exp(logs).sum(1), 1)
    delta, policy = np.asarray(automaton.delta), np.asarray(parts.policy[0])
    for n in range(2):
        states, actions = np.asarray(problem.state[n]), np.asarray(problem.action[n])
        total = 0.0
        for word in itertools.product(range(delta.shape[1]), repeat=3):
            q, chance = int(automaton.initial), 1.0
            for s, a, letter in zip(states, actions, word, strict=True):
                q = delta[q, letter]
                chance *= np.exp(logs[s, letter]) * policy[s, q, a]
            total += chance
        np.testing.assert_allclose(parts.log_likelihood[n], np.log(total), rtol=1e-10)


def test_gradient_is_that_of_differences():
    features = np.random.default_rng(0).normal(size=(1, 9, 4, 4, 2))
    problem = small_problem(features=features)
    hparams = grounding.Hparams(scale=5.0, entropy_weight=0.3)
    start = grounding.init(jax.random.key(0), problem, hparams).parameters
    flat, unravel = ravel_pytree(start)

    @jax.jit
    def loss(x):
        return grounding.objective(unravel(x), problem, hparams)[0]

    gradient, h = jax.jit(jax.grad(loss))(flat), 1e-5
    for i in range(flat.size):
        step = jnp.zeros_like(flat).at[i].set(h)
        slope = (loss(flat + step) - loss(flat - step)) / (2 * h)
        np.testing.assert_allclose(gradient[i], slope, rtol=2e-4, atol=1e-6)


def certain_parameters(kinds, scale):
    """Logits of plus or minus 1000: symbol p holds where kind ``kinds[p]`` is seen."""
    kernel = np.zeros((4, len(kinds)))
    kernel[list(kinds), np.arange(len(kinds))] = 2000.0
    dense = {"kernel": jnp.asarray(kernel), "bias": jnp.full(len(kinds), -1000.0)}
    return {
        "grounding": {"Dense_0": dense},
        "log_scale": jnp.log(scale),
        "weights": jnp.zeros(0),
    }


def mlirl_log_likelihood(problem, kinds, scale, demonstrations):
    """The likelihood by mlirl in the product with the labels of a grounding."""
    world, seen = world_of()
    labelled = world.replace(
        label=jnp.asarray(seen[:, list(kinds)] > 0), propositions=problem.symbols
    )
    model = jl.product(labelled, TASK)
    reward = mean_event_reward(
        labelled,
        jax.nn.one_hot(model.letter, model.automaton.delta.shape[1]),
        jnp.asarray(event_reward(model.automaton)),
    )
    same = mlirl.make_problem(model, reward[..., None], demonstrations)
    hparams = mlirl.Hparams(discount=0.95, policy="soft", l2=0.0)
    found = jax.jit(mlirl.objective)(jnp.array([scale]), same, hparams)
    return -found[1].neg_log_likelihood


@pytest.mark.parametrize("kinds", [(0, 1, 2), (2, 3, 0)])
def test_a_certain_grounding_has_the_likelihood_of_mlirl(kinds):
    world, seen = world_of()
    shown = rollouts(*demonstrator(world), 3, 6)
    problem, hparams = grounding.make_problem(world, seen, shown, TASK), grounding.Hparams()
    expected = mlirl_log_likelihood(problem, kinds, 7.0, shown)
    _, parts = objective(certain_parameters(kinds, 7.0), problem, hparams)
    np.testing.assert_allclose(parts.log_likelihood.sum(), expected, rtol=1e-9)
    automaton = jax.tree.map(lambda x: np.asarray(x)[0], problem.model.automaton)
    letter = letters_of(automaton, seen[None][..., list(kinds)] > 0)
    steps = jax.jit(step_log_likelihood)(problem, 0.95, jnp.asarray(letter), jnp.asarray(7.0))
    np.testing.assert_allclose(steps.sum(), expected, rtol=1e-3)


def test_permuted_symbols_permute_the_answer():
    world, seen = world_of()
    shown = rollouts(*demonstrator(world), 6, 8)
    hparams = grounding.Hparams()
    one = grounding.posterior(grounding.make_problem(world, seen, shown, TASK), hparams)
    renamed = "!a U (b & F c)"  # a -> b, b -> c, c -> a
    other = grounding.posterior(grounding.make_problem(world, seen, shown, renamed), hparams)
    new = {"a": "b", "b": "c", "c": "a"}
    found = {frozenset(one.meaning_of(i).items()): w for i, w in enumerate(one.weight)}
    for i, w in enumerate(other.weight[:20]):
        back = {x: other.meaning_of(i)[new[x]] for x in "abc"}
        np.testing.assert_allclose(found[frozenset(back.items())], w, rtol=1e-6, atol=1e-12)


def test_the_grounding_is_found():
    world, seen = world_of("a . . b\n. c . .\n. . d .\n. c . .")
    shown = rollouts(*demonstrator(world), 15, 12)
    problem = grounding.make_problem(world, seen, shown, TASK)
    found = grounding.posterior(problem, grounding.Hparams(), names=list("abcd"))
    assert found.meaning_of(0) == {"a": "a", "b": "b", "c": "c"}
    np.testing.assert_allclose(found.weight.sum(), 1)
    assert (np.diff(found.weight) <= 0).all() and found.assignment.shape == (64, 3)
    chosen = grounding.credible_set(found, 0.9)
    assert found.weight[chosen].sum() >= 0.9 > found.weight[chosen[:-1]].sum()


def test_some_demonstrations_have_the_posterior_of_their_own_problem():
    world, seen = world_of()
    shown = rollouts(*demonstrator(world), 6, 8)
    hparams = grounding.Hparams()
    whole = grounding.posterior(grounding.make_problem(world, seen, shown, TASK), hparams)
    some = jax.tree.map(lambda x: x[3:], shown)
    alone = grounding.posterior(grounding.make_problem(world, seen, some, TASK), hparams)
    found = grounding.select_demonstrations(whole, [3, 4, 5])
    assert (found.assignment[:5] == alone.assignment[:5]).all()
    np.testing.assert_allclose(found.weight, alone.weight, rtol=1e-6, atol=1e-12)


def test_symmetric_symbols_are_counted_once():
    world, seen = world_of()
    shown = rollouts(*demonstrator(world, "F (a | b)"), 6, 8)
    found = grounding.posterior(
        grounding.make_problem(world, seen, shown, "F (a | b)"), grounding.Hparams()
    )
    rows = {tuple(row) for row in found.assignment.tolist()}
    assert len(rows) == 10 and all(a <= b for a, b in rows)


def test_beam_search_finds_what_enumeration_finds(monkeypatch):
    problem, hparams = small_problem(count=6, length=8), grounding.Hparams()
    whole = grounding.posterior(problem, hparams)
    monkeypatch.setattr("jaxltl.algos.grounding.hypotheses._LIMIT", 10)
    found = grounding.posterior(problem, hparams)
    assert whole.complete and not found.complete
    assert found.assignment[0].tolist() == whole.assignment[0].tolist()


@pytest.mark.slow
def test_gradients_from_many_starts_find_the_grounding():
    world, seen = world_of("a . . b\n. c . .\n. . d .\n. c . .")
    shown = rollouts(*demonstrator(world), 15, 12)
    problem = grounding.make_problem(world, seen, shown, TASK)
    hparams = grounding.Hparams(scale=20.0, entropy_weight=0.01)
    train = jax.vmap(lambda key: grounding.train(key, problem, hparams, num_steps=60))
    state, metrics = train(jax.random.split(jax.random.key(0), 8))
    best = int(metrics.neg_log_likelihood[:, -1].argmin())
    dense = jax.tree.map(lambda x: x[best], state.parameters["grounding"]["Dense_0"])
    assert (dense["kernel"] + dense["bias"]).argmax(0).tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("task", "observation", "message"),
    [
        ("F a & G !a", np.eye(9), "is unsatisfiable"),
        ("F a | G !a", np.eye(9), "is satisfied by every word"),
        ("F G a & (G F b)", np.eye(9), "needs parity acceptance"),
        ("true", np.eye(9), "no symbols"),
        ("F a", np.eye(8), r"world 0: observation has shape \(8, 8\); expected \(9, 8\)"),
        ("F a", np.ones(9), "observation"),
        ("F a", np.full((9, 1), np.nan), "world 0: the observation in state 0 is not finite"),
    ],
)
def test_bad_input_is_refused(task, observation, message):
    world, _ = world_of()
    shown = jl.make_trajectories(world, [[(0, 0)]])
    with pytest.raises(ValueError, match=message) as caught:
        grounding.make_problem(world, observation, shown, task)
    assert "\n" not in str(caught.value)


def test_a_demonstration_that_no_grounding_explains_is_named():
    world = gridworld("a . . . . . . .", slip=0.0)
    seen = np.stack([np.arange(8) == 0, np.arange(8) == 7], axis=1).astype(float)
    left, right = [(s, 2) for s in (7, 6, 5, 4, 3, 2, 1)], [(s, 3) for s in range(7)]
    into_wall = [(4, 0)] * 40
    shown = jl.make_trajectories(world, [left, right[3:], into_wall])
    problem = grounding.make_problem(world, seen, shown, "F a")
    with pytest.raises(ValueError, match=r"demonstration 2 is explained by no grounding.*step"):
        grounding.posterior(problem, grounding.Hparams(), scales=(50.0, 100.0))


def test_network_of_other_shape_is_refused():
    with pytest.raises(ValueError, match=r"logits have shape \(1, 9, 5\); expected \(1, 9, 3\)"):
        small_problem(network=grounding.LinearGrounding(5))


def test_lifted_demonstrations_agree_with_memory_paths():
    """The memory that the hypothesis test reads is that of the product."""
    world, _ = world_of()
    model, policy = demonstrator(world)
    shown = rollouts(model, policy, 3, 6)
    lifted = lift_trajectories(model, shown).state % model.num_memory
    moves = memory_log_moves(
        jnp.log(jax.nn.one_hot(model.letter, model.automaton.delta.shape[1]) + 1e-300),
        model.automaton.delta,
    )
    for n in range(3):
        path = [int(jnp.argmax(moves[shown.state[n, 0], int(model.automaton.initial)]))]
        for s in np.asarray(shown.state[n, 1:]):
            path.append(int(jnp.argmax(moves[s, path[-1]])))
        assert path == lifted[n].tolist()


# --- answers --------------------------------------------------------------------------------------


def labels_of(kinds, text=MAP):
    _, seen = world_of(text)
    return seen[:, list(kinds)] > 0


def test_a_robust_policy_holds_under_every_grounding():
    """Bounds against an evaluation of the policy alone, and the maximin against both optima."""
    world, _ = world_of()
    world = world.replace(initial=jnp.asarray([0, 0.75, 0, 0, 0, 0.25, 0, 0, 0]))
    members = [labels_of(kinds) for kinds in ((0, 1, 2), (0, 3, 2))]
    robust = grounding.robust_policy(world, members, "abc", TASK)
    assert robust.worst <= robust.upper and robust.upper - robust.worst <= 2e-4
    for i, labels in enumerate(members):
        alone = grounding.probability_under(robust, labels, "abc", TASK)
        np.testing.assert_allclose(alone, robust.lower[i], atol=1e-5)
        model = jl.product(grounding.with_labels(world, labels, "abc"), TASK)
        optimum = float((jl.optimal_satisfaction(model).value * model.initial).sum())
        assert robust.lower[i] <= optimum + 1e-9


def test_groundings_that_exclude_each_other_share_the_probability():
    """Two absorbing cells; only a mixture satisfies either grounding with probability a half."""
    world = jl.from_dense(np.eye(3)[[[1, 2], [1, 1], [2, 2]]], initial=[1, 0, 0])
    labels = [np.arange(3)[:, None] == 1, np.arange(3)[:, None] == 2]
    robust = grounding.robust_policy(world, labels, ["g"], "F g")
    np.testing.assert_allclose(robust.lower, 0.5, atol=1e-4)
    np.testing.assert_allclose(robust.upper, 0.5, atol=1e-4)
    nowhere = grounding.probability_under(robust, np.zeros((3, 1), bool), ["g"], "F g")
    assert nowhere == 0
    with pytest.raises(ValueError, match="there are 9 groundings; a robust policy takes 1 to 8"):
        grounding.robust_policy(world, (labels * 5)[:9], ["g"], "F g")


def test_the_query_has_the_largest_mutual_information():
    found = grounding.posterior(
        small_problem(count=6, length=8), grounding.Hparams(), names=list("abcd")
    )
    labels = np.stack([found.labels(i)[0] for i in range(len(found.weight))])  # [C, S, P]
    information = []
    for s in range(labels.shape[1]):
        joint = {}
        for row, w in zip(labels[:, s], found.weight, strict=True):
            joint[tuple(row)] = joint.get(tuple(row), 0) + w
        prior = -(found.weight * np.log(np.maximum(found.weight, 1e-300))).sum()
        after = 0.0
        for seen, mass in joint.items():
            inside = found.weight[[tuple(row) == seen for row in labels[:, s]]] / mass
            after -= mass * (inside * np.log(np.maximum(inside, 1e-300))).sum()
        information.append(prior - after)
    query = grounding.best_query(found)
    np.testing.assert_allclose(query.information, max(information), atol=1e-6)
    np.testing.assert_allclose(information[query.state], max(information), atol=1e-6)
    np.testing.assert_allclose(sum(w for _, w in query.labels), 1)


def test_the_table_has_marginal_weights_and_decisive_steps():
    problem, hparams = small_problem(count=6, length=8), grounding.Hparams()
    found = grounding.posterior(problem, hparams, names=list("abcd"))
    rows = grounding.grounding_table(problem, hparams, found)
    assert [row.symbol for row in rows] == ["a", "b", "c"]
    for p, row in enumerate(rows):
        np.testing.assert_allclose(row.weight + sum(w for _, w in row.alternatives), 1)
        chosen = found.assignment[:, p] == "abcd".index(row.meaning)
        np.testing.assert_allclose(row.weight, found.weight[chosen].sum())
        assert all(0 <= n < 6 and 0 <= t < 8 and gain > 0 for n, t, gain in row.steps)


# --- noisy observations -----------------------------------------------------------------------------


class Small(nn.Module):
    """A network of one hidden layer for three symbols."""

    @nn.compact
    def __call__(self, observation):
        return nn.Dense(3)(nn.relu(nn.Dense(8)(observation)))


@pytest.mark.slow
def test_noisy_observations_are_grounded_by_a_network():
    """Gaussian clusters in ten dimensions; fresh noise is labelled right, and training continues."""
    text, rng = "a . . b\n. c . .\n. . d .\n. c . .", np.random.default_rng(0)
    world, seen = world_of(text)
    kind = np.where(seen.any(1), seen.argmax(1), 4)
    centers = rng.normal(size=(5, 10)) * 3
    noisy = centers[kind] + rng.normal(size=(16, 10)) * 0.5
    shown = rollouts(*demonstrator(world), 15, 12)
    problem = grounding.make_problem(world, noisy, shown, TASK, network=Small())
    hparams = grounding.Hparams()
    meaning = grounding.cluster_meanings(problem, 5)
    found = grounding.posterior(problem, hparams, meanings=meaning)
    assert (found.labels(0)[0] == (seen[:, :3] > 0)).all()
    state = grounding.init(jax.random.key(0), problem, hparams)
    fitted = grounding.fit_labels(state, problem, found.labels(0))
    fresh = jnp.asarray(centers[kind] + rng.normal(size=(16, 10)) * 0.5)
    assert (grounding.network_labels(fitted, problem, fresh) == (seen[:, :3] > 0)).all()
    before, _ = objective(state.parameters, problem, hparams)
    after, _ = objective(fitted.parameters, problem, hparams)
    assert after < before


def test_clusters_and_labels_of_another_size_are_refused():
    problem = small_problem()
    with pytest.raises(ValueError, match=r"num_clusters=6; it must be at least 2 and at most 5"):
        grounding.cluster_meanings(problem, 6)
    state = grounding.init(jax.random.key(0), problem, grounding.Hparams())
    with pytest.raises(ValueError, match=r"labels has shape \(9, 3\); expected \(1, 9, 3\)"):
        grounding.fit_labels(state, problem, np.zeros((9, 3), bool))


def test_padding_of_smaller_worlds_is_no_cluster():
    worlds = [world_of(text) for text in (MAP, "a . . b\n. c . .\n. . d .\n. c . .")]
    shown = [jl.make_trajectories(world, [[(0, 0)]]) for world, _ in worlds]
    problem = grounding.make_problem(
        [x for x, _ in worlds], [y + 1 for _, y in worlds], shown, TASK
    )
    with pytest.raises(ValueError, match=r"it must be at least 2 and at most 5"):
        grounding.cluster_meanings(problem, 6)
    assert grounding.cluster_meanings(problem, 5)[:, 0, :9].sum(0).tolist() == [1] * 9


# --- automata -------------------------------------------------------------------------------------


@cache
def learned_delivery():
    world = gridworld("a . . . b", slip=0.1)
    model = jl.product(world, "F (a & F b)")
    shown = jl.models.rollout(
        model,
        soft_policy(model, 40.0, 0.9),
        jax.random.key(0),
        num_trajectories=20,
        num_steps=12,
        stop=model.final,
    )
    shown = jl.models.project_trajectories(model, shown)
    return model, shown, grounding.learn_automaton(world, shown, 3, discount=0.9, num_starts=1)


@pytest.mark.slow
def test_an_ordered_delivery_is_learned():
    _, _, found = learned_delivery()
    assert jl.automata.is_equivalent(found.automaton, "F (a & F b)")
    again = jl.io.read_hoa(jl.io.write_hoa(found.automaton))
    assert jl.automata.is_equivalent(again, found.automaton)


@pytest.mark.slow
def test_the_likelihood_of_a_learned_automaton_is_that_of_its_policy():
    _, shown, found = learned_delivery()
    model = jl.product(gridworld("a . . . b", slip=0.1), found.automaton)
    policy = np.asarray(soft_policy(model, found.scale, 0.9))
    lifted = lift_trajectories(model, shown)
    place = np.asarray(lifted.state), np.asarray(lifted.action)
    chance = policy.reshape(-1, policy.shape[-1])[place]
    expected = np.log(chance[np.asarray(lifted.mask)]).sum()
    np.testing.assert_allclose(found.log_likelihood, expected, rtol=1e-2)


def test_an_automaton_has_two_states_at_least():
    with pytest.raises(ValueError, match=r"num_memory=1; an automaton that is learned has"):
        world, _ = world_of()
        grounding.learn_automaton(world, jl.make_trajectories(world, [[(0, 0)]]), 1)


def test_a_discount_out_of_range_is_refused():
    world, seen = world_of()
    shown = jl.make_trajectories(world, [[(0, 0)]])
    with pytest.raises(ValueError, match=r"discount=1\.5; it must be at least 0 and below 1"):
        grounding.learn_automaton(world, shown, 2, discount=1.5)
    problem = grounding.make_problem(world, seen, shown, TASK)
    with pytest.raises(ValueError, match=r"discount=1\.5; it must be at least 0 and below 1"):
        grounding.posterior(problem, grounding.Hparams(discount=1.5))


# --- the laws of all learners ------------------------------------------------------------------


def symbols():
    """A goal without a label, and a trap."""
    mdp, demonstrations = world()
    problem = grounding.make_problem(mdp, np.eye(3), demonstrations, "!r U g")
    setting = partial(grounding.Hparams, discount=0.5)
    return LearnerCase(
        grounding, problem, setting(), setting(l2=0.1, entropy_weight=0.1, learning_rate=0.01)
    )


CASES = {
    "grounding": symbols,
}
