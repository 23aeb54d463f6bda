"""Hidden modes and tables of histories: against enumeration of mode paths, literal counts, known modes."""

import itertools
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import jaxltl as jl
from benchmarks.hidden_modes import entry_features, simulated, trajectories
from jaxltl.algos import grounding
from jaxltl.algos.grounding import hidden_modes
from jaxltl.envs import gridworld
from tests.algos.cases import LearnerCase, numbers, world

HPARAMS = hidden_modes.Hparams(discount=0.7, l2=0.3)


@cache
def small_problem():
    """Three states, an unavailable action, demonstrations of 1 to 4 steps, random parameters."""
    world = jl.make_mdp(
        [[[1, 2], [0, 1]], [[1, 0], [0, 0]], [[2, 0], [0, 0]]],
        [[[0.8, 0.2], [0.5, 0.5]], [[0.9, 0.1], [0, 0]], [[1, 0], [1, 0]]],
        available=[[True, True], [True, False], [True, True]],
    )
    runs = [[(0, 0), (2, 1), (0, 1), (1, 0)], [(1, 0)], [(0, 1), (1, 0), (1, 0)]]
    rng = np.random.default_rng(0)
    problem = hidden_modes.make_problem(
        world,
        jl.make_trajectories(world, runs),
        3,
        features=rng.normal(size=(3, 2, 2)),
        evidence=rng.normal(size=(3, 4, 2, 2)),
    )
    start = hidden_modes.init(jax.random.key(0), problem, HPARAMS).parameters
    flat, unravel = ravel_pytree(start)
    return problem, unravel(jnp.asarray(rng.normal(size=flat.shape)))


objective = jax.jit(hidden_modes.objective)


def soft_action_values(world, reward, discount):
    """By plain value iteration: ``float[S, A]``."""
    transition = np.asarray(jl.models.to_dense(world).transition)
    value = np.zeros(len(reward))
    for _ in range(300):
        q = np.where(np.asarray(world.available), reward + discount * transition @ value, -np.inf)
        value = np.log(np.exp(q).sum(-1))
    return q


def test_likelihood_and_posterior_are_sums_over_mode_paths():
    problem, parameters = small_problem()
    loss, (found, status) = objective(parameters, problem, HPARAMS)
    state = hidden_modes.init(jax.random.key(0), problem, HPARAMS).replace(parameters=parameters)
    posterior = hidden_modes.mode_probabilities(state, problem, HPARAMS)
    p = jax.tree.map(np.asarray, parameters)
    q = [
        soft_action_values(problem.world, problem.features @ w, HPARAMS.discount)
        for w in p["reward"]
    ]
    weight = np.exp(3.0 * np.eye(3) + p["move"] + p["move_in"])
    move, start = weight / weight.sum(-1, keepdims=True), np.exp(p["start"])
    for n, length in enumerate(problem.length.tolist()):
        total, expected = 0.0, np.zeros((length, 3))
        for path in itertools.product(range(3), repeat=length):
            chance = start[path[0]] / start.sum()
            for t, z in enumerate(path):
                s, a = int(problem.state[n, t]), int(problem.action[n, t])
                logits = q[z][s] + problem.evidence[n, t] @ p["evidence"][z]
                chance *= np.exp(logits[a]) / np.exp(logits).sum()
                if t + 1 < length:
                    chance *= move[s, z, path[t + 1]]
            total += chance
            expected[range(length), path] += chance
        np.testing.assert_allclose(found[n], np.log(total), rtol=1e-8)
        np.testing.assert_allclose(posterior[n, :length], expected / total, rtol=1e-7)
        assert not posterior[n, length:].any()
    squares = sum((x**2).sum() for x in p.values())
    np.testing.assert_allclose(loss, 0.15 * squares - found.sum())
    assert status == jl.Status.CONVERGED
    np.testing.assert_allclose(
        hidden_modes.log_likelihood(state, problem, HPARAMS), found, rtol=1e-12
    )


def test_gradient_equals_differences():
    problem, parameters = small_problem()
    flat, unravel = ravel_pytree(parameters)

    @jax.jit
    def loss(x):
        return hidden_modes.objective(unravel(x), problem, HPARAMS)[0]

    gradient = jax.grad(loss)(flat)
    for i in range(0, flat.size, 3):
        step = jnp.zeros_like(flat).at[i].set(1e-5)
        difference = (loss(flat + step) - loss(flat - step)) / 2e-5
        np.testing.assert_allclose(gradient[i], difference, rtol=1e-5, atol=1e-6)


def literal_tables(runs, kinds, orders, num_actions, strengths):
    """``p[n][t][e]`` of histories, each demonstration scored by the counts of all others."""
    found = []
    for n, run in enumerate(runs):
        rows = []
        for t in range(len(run)):
            levels = []
            for chain, order in enumerate(orders):
                p = np.full(num_actions, 1 / num_actions)
                for k in range(order + 1):
                    counts = np.zeros(num_actions)
                    for m, other in enumerate(runs):
                        for u in range(len(other)):
                            one = context(other, u, chain, k, kinds)
                            if m != n and one == context(run, t, chain, k, kinds):
                                counts[other[u][1]] += 1
                    p = (counts + strengths[chain][k] * p) / (counts.sum() + strengths[chain][k])
                    levels.append(p)
            rows.append(levels)
        found.append(rows)
    return found


def context(run, t, chain, k, kinds):
    """The last symbols of a chain, None before the first step."""
    if chain == 0:
        return tuple(run[t - j][0] if j <= t else None for j in range(k + 1))
    return (kinds[run[t][0]], *(run[t - j][1] if j <= t else None for j in range(1, k + 1)))


@cache
def counted():
    """A corridor of three cells, and random runs of different lengths in it."""
    world = jl.make_mdp([[[0], [1]], [[0], [2]], [[1], [2]]], np.ones((3, 2, 1)))
    rng, runs = np.random.default_rng(1), []
    for n in range(8):
        run, s = [], 1
        for t in range(3 + n % 3):
            a = int(rng.random() < (0.8 if t and run[-1][1] else 0.3))
            run.append((s, a))
            s = int(world.successor[s, a, 0])
        runs.append(run)
    shown = jl.make_trajectories(world, runs)
    return world, runs, shown, grounding.fit_history(world, shown, past_states=1, past_actions=2)


def test_tables_are_smoothed_counts_of_the_other_demonstrations():
    world, runs, _, tables = counted()
    strengths = [[level.strengths[0] for level in chain] for chain in tables.chains]
    expected = literal_tables(runs, ["left", "none", "right"], (1, 2), 2, strengths)
    assert tables.left_out.shape == (8, 5, 2, 5)
    for n, run in enumerate(runs):
        for t in range(len(run)):
            np.testing.assert_allclose(np.exp(tables.left_out[n, t].T), expected[n][t], rtol=1e-9)
    # Of a new demonstration: the counts of all that were fitted.
    expected = literal_tables([*runs, runs[0]], ["left", "none", "right"], (1, 2), 2, strengths)
    evidence = tables.evidence(jl.make_trajectories(world, [runs[0]]))[0]
    np.testing.assert_allclose(np.exp(evidence[0].T), expected[-1][0], rtol=1e-9)


def test_strengths_are_the_likeliest_of_the_grid():
    _, runs, _, tables = counted()

    def score(strength):
        level = literal_tables(runs, "lnr", (0,), 2, [[strength]])
        return sum(
            np.log(level[n][t][0][a]) for n, run in enumerate(runs) for t, (_, a) in enumerate(run)
        )

    best = max(2.0 ** np.arange(-1, 9), key=score)
    assert tables.chains[0][0].strengths == (best,)


def test_evidence_does_not_read_the_future():
    world, _, _, tables = counted()
    one, other = [(1, 0), (0, 1), (1, 1), (2, 1)], [(1, 0), (0, 1), (1, 0), (0, 0)]
    found = [tables.evidence(jl.make_trajectories(world, [run]))[0] for run in (one, other)]
    np.testing.assert_array_equal(found[0][:3], found[1][:3])
    assert (found[0][3] != found[1][3]).any()


@pytest.mark.slow
def test_known_modes_are_recovered_up_to_their_order():
    """Nearly as well as with the parameters of the simulation, which are the best possible."""
    world = gridworld("\n".join([". . . . ."] * 5))
    features = entry_features(world)
    problem = hidden_modes.make_problem(
        world, jl.make_trajectories(world, [[(0, 0)]]), 2, features=features
    )
    hparams = hidden_modes.Hparams(discount=0.8, learning_rate=0.1)
    truth = hidden_modes.init(jax.random.key(0), problem, hparams)
    reward = np.zeros((2, features.shape[-1]))
    reward[0, 25], reward[1, 25 + 23] = 4.0, 4.0  # on entering opposite cells
    move_in = np.zeros((25, 2, 2))
    move_in[0, 0, 1], move_in[23, 1, 0] = 4.0, 4.0  # and then the mode changes
    known = {"reward": reward, "move": 3.0 * np.eye(2), "move_in": move_in}
    truth = truth.replace(parameters={**truth.parameters, **known})
    moves = np.asarray(hidden_modes.mode_moves(truth))
    policy = np.asarray(hidden_modes.policy(truth, problem, hparams))
    state, action, mode = np.moveaxis(simulated(world, policy, moves, (40, 150)), -1, 0)
    problem = hidden_modes.make_problem(
        world, trajectories(world, state, action), 2, features=features
    )
    learned = jl.check(
        hidden_modes.fit(jax.random.key(1), problem, hparams, num_starts=3, num_steps=200)
    )

    def agreement(parameters):
        posterior = hidden_modes.mode_probabilities(parameters, problem, hparams)
        share = (np.asarray(posterior).argmax(-1) == mode).mean()
        return max(share, 1 - share)

    assert agreement(learned.state) > max(0.9, agreement(truth) - 0.02)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_modes": 0}, "num_modes=0"),
        ({"features": None}, "neither features nor evidence"),
        ({"features": np.zeros((3, 3, 1))}, r"features has shape \(3, 3, 1\); expected \(3, 2, "),
        ({"evidence": np.zeros((1, 2, 2))}, r"evidence has shape .*expected \(1, 2, 2, any\)"),
        ({"features": np.full((3, 2, 1), np.nan)}, r"features at \(0, 0, 0\) is not finite"),
    ],
)
def test_invalid_problems_are_named(change, message):
    world = counted()[0]
    options = {"num_modes": 2, "features": np.zeros((3, 2, 1)), **change}
    with pytest.raises(ValueError, match=message):
        hidden_modes.make_problem(world, jl.make_trajectories(world, [[(0, 1), (1, 0)]]), **options)


def test_invalid_histories_and_starts_are_named():
    world, _, shown, _ = counted()
    with pytest.raises(ValueError, match="1 demonstrations; give at least 2"):
        grounding.fit_history(world, jl.make_trajectories(world, [[(0, 1)]]))
    with pytest.raises(ValueError, match="past_states=-1"):
        grounding.fit_history(world, shown, past_states=-1)
    problem, _ = small_problem()
    with pytest.raises(ValueError, match="num_starts=0"):
        hidden_modes.fit(jax.random.key(0), problem, HPARAMS, num_starts=0)


def test_the_best_start_has_a_status():
    problem, _ = small_problem()
    runs = jax.jit(partial(hidden_modes.fit, num_starts=3, num_steps=2))
    learned = runs(jax.random.key(0), problem, HPARAMS)
    assert (learned.status, learned.num_steps) == (jl.Status.COMPLETED, 2)
    every = [
        hidden_modes.train(key, problem, HPARAMS, num_steps=2)[1].loss[-1]
        for key in jax.random.split(jax.random.key(0), 3)
    ]
    np.testing.assert_allclose(learned.metrics.loss, min(every), rtol=1e-9)
    lost = problem.replace(evidence=jnp.full_like(problem.evidence, jnp.nan))
    assert runs(jax.random.key(0), lost, HPARAMS).status == jl.Status.NONFINITE


# --- the laws of all learners ------------------------------------------------------------------


def modes():
    """Two hidden modes, with a reward and evidence each."""
    mdp, demonstrations = world()
    features, evidence = numbers(3, 2, 2), numbers(2, 3, 2, 1)
    problem = hidden_modes.make_problem(
        mdp, demonstrations, 2, features=features, evidence=evidence
    )
    setting = partial(hidden_modes.Hparams, discount=0.5)
    return LearnerCase(hidden_modes, problem, setting(), setting(l2=0.1, learning_rate=0.01))


CASES = {
    "modes": modes,
}
