"""PPO against slow references: advantages, the loss and its slope, masks, memories, learning."""

from __future__ import annotations

from functools import cache, partial
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from jax.tree_util import Partial

from jaxltl.algos import ppo
from jaxltl.algos.common import action_distributions as actions_of
from jaxltl.algos.common import learner
from jaxltl.algos.common.actor_critic import orthogonal
from jaxltl.algos.common.moments import scale_of, updated_moments
from jaxltl.algos.common.schedules import Linear
from jaxltl.algos.ppo import collection as collecting
from jaxltl.algos.ppo import learner as updating
from jaxltl.core.environments.environment import Finite, Timestep, make_box, make_environment
from jaxltl.core.environments.episodes import run_episode
from jaxltl.core.types import Status
from tests.algos.cases import LearnerCase, choice_observe, choice_reset, choice_step

MAX_PROGRAMS = 450  # that the default tests compile at most


class Table(nn.Module):
    """Logits and a value, linear in the observation."""

    num_actions: int

    @nn.compact
    def __call__(self, observation):
        start = nn.initializers.normal(0.5)
        size = observation.shape[0]
        scores = self.param("scores", start, (size, self.num_actions), observation.dtype)
        worth = self.param("worth", start, (size,), observation.dtype)
        return observation @ scores, observation @ worth


# --- a world whose episodes end in both ways ------------------------------------------------------

LIMIT = 5


def walk_reset(key):
    return {"place": jnp.int32(1), "time": jnp.int32(0)}


def walk_step(world, action, key):
    """Place 0 ends the episode, time 5 cuts it off; some steps count less."""
    place = world["place"] + 2 * action.astype(jnp.int32) - 1
    after = {"place": jnp.minimum(place, 3), "time": world["time"] + 1}
    return Timestep(
        after,
        reward=place * 0.5 + action,
        terminated=place == 0,
        truncated=after["time"] == LIMIT,
        discount=jnp.where(place == 2, 0.7, 1.0),
    )


def walk_observe(world):
    return jnp.concatenate([jax.nn.one_hot(world["place"], 4), world["time"][None] / LIMIT])


WALK = make_environment(walk_reset, walk_step, walk_observe, actions=2)
SIZES = {"num_envs": 4, "num_steps": 16, "num_minibatches": 2, "num_epochs": 1}


def slow_advantages(reward, value, following, discount, ended, decay):
    """Sums written out, one for each step."""
    found = np.zeros_like(reward)
    for n in range(reward.shape[1]):
        for t in range(len(reward)):
            weight = 1.0
            for k in range(t, len(reward)):
                error = reward[k, n] + discount[k, n] * following[k, n] - value[k, n]
                found[t, n] += weight * error
                weight *= discount[k, n] * decay
                if ended[k, n]:
                    break
    return found


def collected(problem, hparams, seed=0):
    state = ppo.init(jax.random.key(seed), problem, hparams)
    key = jax.random.key(seed + 1)
    return state, jax.jit(collecting.collected)(key, state, problem, hparams)


@pytest.mark.few(1)
@pytest.mark.parametrize("resets", [None, 0])
def test_advantages_bootstrap_where_an_episode_is_cut_off_and_not_where_it_is_over(resets):
    """From the actions alone, the walk is made again and its advantages summed up."""
    problem = ppo.make_problem(WALK, network=Table(2))
    hparams = ppo.Hparams(discount=0.9, gae_lambda=0.8, num_resets=resets, **SIZES)
    state, (after, _, rows, told) = collected(problem, hparams)
    weights = np.asarray(state.parameters["worth"])
    shape = rows.raw.shape
    reward, value, following, discount = (np.zeros(shape) for _ in range(4))
    ended = np.zeros(shape, bool)
    sums, lengths = [], []
    for n in range(shape[1]):
        world, total, length = walk_reset(None), 0.0, 0
        for t in range(shape[0]):
            value[t, n] = np.asarray(walk_observe(world)) @ weights
            found = walk_step(world, rows.raw[t, n], None)
            reward[t, n], discount[t, n] = found.reward, 0.9 * found.discount
            last = np.asarray(walk_observe(found.world)) @ weights
            following[t, n] = 0 if found.terminated else last
            ended[t, n] = found.terminated | found.truncated
            total, length = total + float(found.reward), length + 1
            world = walk_reset(None) if ended[t, n] else found.world
            if ended[t, n]:
                sums, lengths = [*sums, total], [*lengths, length]
                total, length = 0.0, 0
        assert after.walkers.world["place"][n] == world["place"]
    assert ended.any() and (lengths.count(LIMIT) > 1) and min(lengths) < LIMIT
    np.testing.assert_allclose(rows.value, value, rtol=1e-9)
    expected = slow_advantages(reward, value, following, discount, ended, 0.8)
    np.testing.assert_allclose(rows.advantage, expected, rtol=1e-9)
    assert told["episodes"] == len(sums)
    np.testing.assert_allclose(
        [told["episode_return"], told["episode_length"], told["reward"]],
        [np.mean(sums), np.mean(lengths), reward.mean()],
        rtol=1e-9,
    )


@pytest.mark.slow
def test_many_episodes_cut_off_at_once_are_all_bootstrapped():
    """Every step is the last of its episode: more than are evaluated at a time."""
    once = make_environment(
        lambda key: jax.random.uniform(key, (3,)),
        lambda world, action, key: Timestep(
            world + 1, reward=0.0, terminated=False, truncated=True
        ),
        lambda world: world,
        actions=2,
    )
    problem = ppo.make_problem(once, network=Table(2))
    hparams = ppo.Hparams(discount=0.5, **{**SIZES, "num_steps": 64})
    state, (_, _, rows, told) = collected(problem, hparams)
    assert told["episodes"] == 256
    worth = np.asarray(state.parameters["worth"])
    seen = np.asarray(rows.observation)
    np.testing.assert_allclose(rows.advantage, 0.5 * (seen + 1) @ worth - seen @ worth, rtol=1e-9)


def numbered_step(world, action, key):
    """Episodes of one step and of three."""
    after = world._replace(time=world.time + 1)
    return Timestep(after, reward=0.0, terminated=after.time == after.length)


class Numbered(NamedTuple):
    start: jax.Array
    length: jax.Array
    time: jax.Array
    key: jax.Array


NUMBERED = make_environment(
    lambda key: Numbered(
        jax.random.uniform(key), 1 + 2 * jax.random.randint(key, (), 0, 2), jnp.int32(0), key
    ),
    numbered_step,
    lambda world: world.start[None],
    actions=2,
)


@pytest.mark.few(1)
@pytest.mark.parametrize(("resets", "most"), [(None, None), (0, None), (5, 5)])
def test_episodes_begin_in_worlds_drawn_for_them(resets, most):
    problem = ppo.make_problem(NUMBERED, network=Table(2))
    hparams = ppo.Hparams(discount=0.9, num_resets=resets, **SIZES)
    _, (after, _, rows, told) = collected(problem, hparams)
    place, start = np.asarray(rows.observation)[..., 0], np.asarray(rows.start)
    assert start[0].all() and (place[1:] == place[:-1])[~start[1:]].all()
    begun = place[1:][start[1:]]
    assert told["episodes"] == len(begun) + (np.asarray(after.walkers.episode_length) == 0).sum()
    if most is None:
        assert np.unique(begun).size == begun.size > 10
    else:  # handed out in turn, in the order of time and then of environments
        drawn = begun[:most]
        assert np.unique(drawn).size == most
        np.testing.assert_array_equal(begun, np.resize(drawn, len(begun)))
    same = jax.vmap(lambda world: jax.random.uniform(world.key) == world.start)
    assert same(after.walkers.world).all(), "keys in worlds stay theirs"


# --- actions --------------------------------------------------------------------------------------


class Wild(nn.Module):
    """The most for what is forbidden, and infinitely little for some of what is not."""

    @nn.compact
    def __call__(self, observation):
        self.param("unused", nn.initializers.zeros, (1,))
        return observation, jnp.zeros(())


def wild_observe(world):
    allowed = wild_allowed(world)
    return jnp.where(allowed, jnp.where(world % 3 == 0, -jnp.inf, -50.0), 1e9)


def wild_allowed(world):
    return (world // 2 ** jnp.arange(4)) % 2 == 1


def wild_step(world, action, key):
    return Timestep(
        jax.random.randint(key, (), 1, 16),
        reward=1.0 * wild_allowed(world)[action],
        terminated=world == 7,
    )


def test_what_is_forbidden_is_never_done():
    wild = make_environment(
        lambda key: jax.random.randint(key, (), 1, 16),
        wild_step,
        wild_observe,
        actions=4,
        allowed=wild_allowed,
    )
    problem = ppo.make_problem(wild, network=Wild())
    hparams = ppo.Hparams(discount=0.9, **{**SIZES, "num_steps": 250})
    state, (_, _, rows, told) = collected(problem, hparams)
    assert told["reward"] == 1.0 and np.unique(rows.raw).size == 4
    assert np.isfinite(rows.log_density).all()
    for agent in (ppo.policy, ppo.greedy):
        episode = run_episode(jax.random.key(3), wild, agent(state, problem, hparams), num_steps=60)
        assert (episode.reward == episode.valid).all() and episode.valid.sum() > 1


@pytest.mark.slow
def test_where_nothing_is_allowed_nothing_is_learned_and_it_is_said():
    stuck = make_environment(
        walk_reset,
        walk_step,
        walk_observe,
        actions=2,
        allowed=lambda world: jnp.full(2, world["place"] != 3),
    )
    problem = ppo.make_problem(stuck, network=Table(2))
    hparams = ppo.Hparams(discount=0.9, **SIZES)
    state = ppo.init(jax.random.key(0), problem, hparams)
    after, metrics = jax.jit(ppo.step)(state, problem, hparams)
    assert metrics.status == Status.INVALID
    jax.tree.map(np.testing.assert_array_equal, after.parameters, state.parameters)


def test_densities_and_entropies_are_those_of_distributions():
    logits, allowed = jnp.array([0.3, -1.0, 2.0, 0.1]), jnp.array([True, False, True, True])
    weight = np.exp(np.asarray(logits)) * np.asarray(allowed)
    mass = weight / weight.sum()
    space = Finite(4)
    found = [float(actions_of.log_density(space, logits, allowed, i)) for i in (0, 2, 3)]
    np.testing.assert_allclose(found, np.log(mass[[0, 2, 3]]), rtol=1e-9)
    entropy = partial(actions_of.entropy, space, allowed=allowed, squash="clip")
    np.testing.assert_allclose(
        entropy(logits), -sum(x * np.log(x) for x in mass[mass > 0]), rtol=1e-9
    )
    slope = jax.grad(entropy)(logits)
    assert slope[1] == 0 and np.isfinite(slope).all() and (slope != 0).sum() == 3
    # Of a box: integrals on a fine grid; the second axis has no upper bound.
    space = make_box([-1.0, 0.0], [3.0, np.inf])
    mean, spread = jnp.array([0.4, 1.0]), jnp.log(jnp.array([0.6, 0.5]))
    grid = np.linspace(-12, 12, 200001)
    normal = np.exp(-(((grid - 0.4) / 0.6) ** 2) / 2) / (0.6 * np.sqrt(2 * np.pi))
    squashed = -np.sum(normal * np.log(np.maximum(normal, 1e-300) / (1 - np.tanh(grid) ** 2))) * (
        grid[1] - grid[0]
    )
    plain = np.log(0.5) + (1 + np.log(2 * np.pi)) / 2
    parameters = mean, spread
    np.testing.assert_allclose(
        actions_of.entropy(space, parameters, None, "tanh"), squashed + plain, atol=2e-3
    )
    np.testing.assert_allclose(
        actions_of.entropy(space, parameters, None, "clip"), 2 * plain + np.log(1.2), rtol=1e-9
    )
    raw = jnp.array([0.1, 1.3])
    expected = sum(
        -(((x - m) / s) ** 2) / 2 - np.log(s * np.sqrt(2 * np.pi))
        for x, m, s in zip([0.1, 1.3], [0.4, 1.0], [0.6, 0.5], strict=True)
    )
    np.testing.assert_allclose(
        actions_of.log_density(space, parameters, None, raw), expected, rtol=1e-9
    )
    for squash, first in (("clip", [0.1, 1.0, -1.0]), ("tanh", np.tanh([0.1, 5.0, -5.0]))):
        raws = jnp.array([[0.1, 1.3], [5.0, -4.0], [-5.0, 0.0]])
        acted = jax.vmap(lambda x, s=squash: actions_of.as_action(space, x, s))(raws)
        np.testing.assert_allclose(acted[:, 0], 1 + 2 * np.asarray(first), rtol=1e-9)
        assert acted[:, 1].tolist() == [1.3, 0.0, 0.0]


# --- the loss -------------------------------------------------------------------------------------


def slow_loss(weights, worth, rows, hparams):
    """One row after the other."""
    advantage = rows["advantage"]
    scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    total = 0.0
    for i, seen in enumerate(rows["observation"]):
        score = np.where(rows["allowed"][i], np.exp(seen @ weights), 0)
        mass = score / score.sum()
        ratio = mass[rows["raw"][i]] / np.exp(rows["log_density"][i])
        clipped = min(max(ratio, 0.8), 1.2)
        total -= min(ratio * scaled[i], clipped * scaled[i])
        value, old = seen @ worth, rows["value"][i]
        target = old + advantage[i]
        near = old + min(max(value - old, -0.1), 0.1)
        total += hparams.value_weight * max((value - target) ** 2, (near - target) ** 2) / 2
        total -= hparams.entropy_weight * -sum(x * np.log(x) for x in mass[mass > 0])
    return total / len(advantage)


def test_the_slope_of_the_loss_is_that_of_a_slow_one():
    rng = np.random.default_rng(0)
    size, num = 24, 3
    allowed = rng.random((size, num)) < 0.7
    raw = np.array([rng.choice(num, p=(a | ~a.any()) / (a | ~a.any()).sum()) for a in allowed])
    allowed[np.arange(size), raw] = True
    rows = {
        "observation": rng.normal(size=(size, 5)),
        "start": np.zeros(size, bool),
        "allowed": allowed,
        "raw": raw,
        "log_density": np.log(rng.uniform(0.2, 0.8, size)),
        "value": rng.normal(size=size),
        "advantage": rng.normal(size=size),
    }
    weights, worth = rng.normal(size=(5, num)), rng.normal(size=5)
    problem = ppo.Problem(WALK.replace(actions=Finite(num)), (), Table(num))
    hparams = ppo.Hparams(discount=0.9, value_weight=0.7, entropy_weight=0.05, value_clip=0.1)
    given = collecting.TransitionRows(**{k: jnp.asarray(v) for k, v in rows.items()})
    found, slope = jax.value_and_grad(lambda p: updating.loss(p, given, (), problem, hparams)[0])(
        {"scores": jnp.asarray(weights), "worth": jnp.asarray(worth)}
    )
    np.testing.assert_allclose(found, slow_loss(weights, worth, rows, hparams), rtol=1e-9)
    flat = np.concatenate([weights.ravel(), worth])

    def at(x):
        return slow_loss(x[:15].reshape(5, num), x[15:], rows, hparams)

    expected = [(at(flat + d) - at(flat - d)) / 2e-6 for d in 1e-6 * np.eye(len(flat))]
    np.testing.assert_allclose(
        np.concatenate([np.ravel(slope["scores"]), slope["worth"]]), expected, atol=1e-7
    )


# --- worlds of a box, memories, scales ------------------------------------------------------------


def drift_reset(key):
    return jax.random.uniform(key, (2,), minval=-1)


def drift_step(world, action, key):
    after = world + 0.2 * action + 0.01 * jax.random.normal(key, (2,))
    return Timestep(
        after,
        reward=3 - jnp.sum(after**2),
        terminated=jnp.abs(after).max() > 1.5,
        truncated=jax.random.bernoulli(key, 0.1),
    )


def drift_observe(world):
    return {"place": 100 + 7 * world, "side": world[0] > 0}


DRIFT = make_environment(drift_reset, drift_step, drift_observe, actions=make_box(-1.0, 1.0, (2,)))
DRIFTERS = {
    "perceptron": ppo.ActorCritic(shape=(2,), hidden=(4,)),
    "memory": ppo.RecurrentActorCritic(shape=(2,), hidden=(4,), memory=3),
}


@cache
def two_steps(name):
    """Without learning, with all scales."""
    problem = ppo.make_problem(DRIFT, network=DRIFTERS[name])
    hparams = ppo.Hparams(
        discount=0.9,
        learning_rate=0.0,
        normalize_observation=True,
        normalize_reward=True,
        squash="tanh",
        **SIZES,
    )
    state = ppo.init(jax.random.key(0), problem, hparams)
    return problem, hparams, state, ppo.run(state, problem, hparams, num_steps=2)


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIFTERS)
def test_a_policy_that_does_not_change_has_ratios_of_one(name):
    """Scales and memories are in the update what they were when actions were drawn."""
    *_, (state, metrics) = two_steps(name)
    np.testing.assert_allclose(metrics.kl, 0, atol=1e-12)
    assert (metrics.clip_fraction == 0).all() and (metrics.updates == 2).all()
    assert (metrics.gradient_norm > 0).all() and (metrics.status == Status.COMPLETED).all()
    assert (metrics.episodes > 0).all(), "memories were reset on the way"
    assert metrics.transitions.tolist() == [64, 128]
    assert state.moments["place"].count == 128


@pytest.mark.slow
def test_scales_are_those_of_all_that_was_seen():
    problem, hparams, state, (last, _) = two_steps("perceptron")
    seen, sums = [], []
    running = np.zeros(4)
    for i in range(2):
        given = state.replace(step=jnp.int32(i))
        key, _ = jax.random.split(learner.step_key(given))
        walkers, path = collecting._walked(key, given, problem, hparams)
        state = state.replace(walkers=walkers)
        seen.append(np.asarray(path.of.observation["place"]).reshape(-1, 2))
        over = np.asarray(path.of.terminated | path.of.truncated)
        for reward, ended in zip(np.asarray(path.of.reward), over, strict=True):
            running = running + reward
            sums.append(running)
            running = np.where(ended, 0, 0.9 * running)
        if i == 0:  # the second step's policy reads scaled observations, so it differs
            first = jax.tree.map(
                lambda x, m: updated_moments(m, x), path.of.observation, state.moments
            )
            returns = updated_moments(state.return_moments, jnp.asarray(np.stack(sums)))
            state = state.replace(moments=first, return_moments=returns)
    seen = np.concatenate(seen)
    np.testing.assert_allclose(last.moments["place"].mean, seen.mean(0), rtol=1e-9)
    np.testing.assert_allclose(scale_of(last.moments["place"]), seen.std(0), rtol=1e-9)
    np.testing.assert_allclose(scale_of(last.return_moments), np.stack(sums).std(), rtol=1e-9)


@pytest.mark.parametrize("shape", [(6, 3), (3, 6), (4, 4), (1, 5)])
def test_networks_start_orthogonal(shape):
    """And uniformly so: the first entry's square has the mean that its row's length gives."""
    keys = jax.random.split(jax.random.key(0), 400)
    drawn = np.asarray(jax.vmap(lambda key: orthogonal(2.0)(key, shape, float))(keys))
    some = drawn if shape[0] <= shape[1] else np.swapaxes(drawn, 1, 2)
    np.testing.assert_allclose(
        some @ np.swapaxes(some, 1, 2),
        np.broadcast_to(4 * np.eye(min(shape)), (400, min(shape), min(shape))),
        atol=1e-12,
    )
    length = max(shape)
    error = 4 * np.sqrt(2 * (length - 1) / (length**2 * (length + 2)) / 400)
    assert abs((drawn[:, 0, 0] ** 2).mean() / 4 - 1 / length) < error
    assert abs(np.sign(drawn[:, 0, -1]).mean()) < 0.2


def recall_step(world, action, key):
    """The sign is shown at first and asked for in the third step."""
    sign, time = world
    return Timestep(
        (sign, time + 1),
        reward=jnp.where(time == 2, 1.0 * (action == sign), 0.0),
        terminated=time == 2,
    )


def recall_observe(world):
    sign, time = world
    return jnp.array([jnp.where(time == 0, 2 * sign - 1, 0), time])


RECALL = make_environment(
    lambda key: (jax.random.bernoulli(key).astype(jnp.int32), jnp.int32(0)),
    recall_step,
    recall_observe,
    actions=2,
)


@pytest.mark.slow
def test_a_memory_remembers():
    """By chance a half."""
    problem = ppo.make_problem(
        RECALL, network=ppo.RecurrentActorCritic(num_actions=2, hidden=(), memory=8)
    )
    hparams = ppo.Hparams(
        discount=1.0, learning_rate=0.02, num_envs=16, num_steps=12, num_minibatches=2
    )
    state, metrics = ppo.train(jax.random.key(0), problem, hparams, num_steps=40)
    assert metrics.episode_return[-5:].mean() > 0.95
    agent = ppo.greedy(state, problem, hparams)
    episodes = jax.jit(jax.vmap(lambda key: run_episode(key, RECALL, agent, num_steps=3)))(
        jax.random.split(jax.random.key(1), 50)
    )
    assert episodes.reward.sum(1).mean() == 1.0


@pytest.mark.slow
def test_a_short_walk_is_learned():
    """To the right is worth most: 1.5 + 2 + 2.5 ... against 0 to the left at once."""
    problem = ppo.make_problem(WALK, network=ppo.ActorCritic(2, hidden=(8,)))
    hparams = ppo.Hparams(
        discount=0.9,
        learning_rate=Linear(0.02, 0.0, 30),
        num_envs=8,
        num_steps=20,
        num_minibatches=4,
        value_clip=10.0,
    )
    _, metrics = ppo.train(jax.random.key(0), problem, hparams, num_steps=30)
    assert metrics.episode_return[0] < 8 < 11.5 < metrics.episode_return[-1]
    assert metrics.explained_variance[-1] > 0.5
    np.testing.assert_allclose(metrics.learning_rate, 0.02 * (1 - np.arange(30) / 30), rtol=1e-9)
    assert metrics.entropy[-1] < 0.5 * metrics.entropy[0]
    halves = Partial(optax.exponential_decay(0.1, 1, 0.5))
    begun = ppo.init(jax.random.key(0), problem, hparams)
    _, metrics = jax.jit(ppo.step)(
        begun, problem, hparams.replace(target_kl=1e-9, learning_rate=halves)
    )
    np.testing.assert_allclose(metrics.learning_rate, 0.05, rtol=1e-6)
    assert metrics.updates == 1, "the first minibatch is of the policy that acted"


@pytest.mark.slow
def test_what_is_not_finite_is_not_learned_from():
    def step(world, action, key):
        found = walk_step(world, action, key)
        return found._replace(reward=jnp.where(found.world["place"] == 3, jnp.nan, found.reward))

    problem = ppo.make_problem(
        make_environment(walk_reset, step, walk_observe, actions=2), network=Table(2)
    )
    hparams = ppo.Hparams(discount=0.9, normalize_observation=True, normalize_reward=True, **SIZES)
    state = ppo.init(jax.random.key(0), problem, hparams)
    after, metrics = jax.jit(ppo.step)(state, problem, hparams)
    assert metrics.status == Status.NONFINITE and metrics.nonfinite == 2 and metrics.updates == 0
    jax.tree.map(
        np.testing.assert_array_equal,
        (after.parameters, after.optimizer, after.return_moments),
        (state.parameters, state.optimizer, state.return_moments),
    )
    assert np.isfinite(after.moments.mean).all() and after.step == 1


# --- bad input ------------------------------------------------------------------------------------


class Counting(nn.Module):
    @nn.compact
    def __call__(self, observation):
        self.variable("seen", "count", lambda: jnp.zeros(()))
        return Table(2)(observation)


class WithAxis(nn.Module):
    @nn.compact
    def __call__(self, observation):
        return nn.Dense(2)(observation), nn.Dense(1)(observation)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: ppo.make_problem(walk_step),
            "environment is function; give one of make_environment",
        ),
        (lambda: ppo.make_problem(WALK, network=walk_step), "network cannot be called with"),
        (lambda: ppo.make_problem(WALK, network=Table(3)), r"\(\(3,\), \(\)\).* expected \(\(2,\)"),
        (lambda: ppo.make_problem(WALK, network=WithAxis()), r"\(\(2,\), \(1,\)\) for one obs"),
        (lambda: ppo.make_problem(WALK, network=Counting()), r"keeps \['seen'\] besides its param"),
        (
            lambda: ppo.make_problem(WALK.replace(actions=make_box(0, 5, (2,), int))),
            "box of int64; enumerate",
        ),
    ],
)
def test_problems_that_cannot_be_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"num_envs": 0}, "num_envs=0; it must be an integer of at least 1"),
        ({"num_minibatches": 7}, "num_minibatches=7 does not divide 1024, the number of num_envs"),
        ({"discount": 1.5}, r"discount=1.5; it must be at least 0 and at most 1"),
        ({"clip": float("nan")}, "clip=nan; it must be at least 0"),
        ({"squash": "cut"}, "squash='cut'; choose one of clip, tanh"),
    ],
)
def test_settings_that_cannot_be_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        ppo.init(
            jax.random.key(0), ppo.make_problem(WALK), ppo.Hparams(**{"discount": 0.9, **options})
        )


def test_minibatches_of_a_network_with_memory_are_whole_environments():
    problem = ppo.make_problem(WALK, network=ppo.RecurrentActorCritic(2, memory=2))
    with pytest.raises(ValueError, match="does not divide 6, the number of environments"):
        ppo.init(
            jax.random.key(0), problem, ppo.Hparams(discount=0.9, num_envs=6, num_minibatches=4)
        )


# --- the laws of all learners ------------------------------------------------------------------


def corridor_reset(width, key):
    return jnp.int32(0)


def corridor_step(width, place, action, key):
    """To the end and back, now and then cut off; there and back earns most."""
    place = place + jnp.array([1, -1, 0], jnp.int32)[action]
    return Timestep(
        place, reward=place / width, terminated=place < 0, truncated=jax.random.bernoulli(key, 0.1)
    )


def corridor_observe(width, place):
    return {"place": place / width, "end": place == 3}


def corridor_allowed(width, place):
    return jnp.array([place < 3, True, True])


def proximal(squash="clip", **options):
    width = np.array(3.0)
    if squash == "tanh":
        world = make_environment(
            choice_reset, choice_step, choice_observe, actions=make_box(-1, 1, (2,))
        )
        network = ppo.RecurrentActorCritic(shape=(2,), hidden=(), memory=2)
        problem = ppo.make_problem(world, network=network, memory=np.array([0.1, 0.2]))
    else:
        world = make_environment(
            *(Partial(f, width) for f in (corridor_reset, corridor_step, corridor_observe)),
            actions=3,
            allowed=Partial(corridor_allowed, width),
        )
        problem = ppo.make_problem(world, network=ppo.ActorCritic(3, hidden=()))
    setting = partial(
        ppo.Hparams,
        num_envs=4,
        num_steps=6,
        num_epochs=1,
        num_minibatches=2,
        squash=squash,
        **options,
    )
    return LearnerCase(
        ppo,
        problem,
        setting(discount=0.9, learning_rate=0.01),
        setting(discount=0.8, learning_rate=0.02, clip=0.1, gae_lambda=0.5),
    )


CASES = {
    "ppo": partial(proximal, normalize_observation=True, normalize_reward=True),
    "ppo-memory": partial(proximal, "tanh", num_resets=3),
}
