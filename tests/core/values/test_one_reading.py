"""A float32 model means its normalised rows: for every question, kind of model and engine.

A row in float32 sums to 1 only up to about 6e-8, and runs that take 10^6 steps multiply that.
"""

from __future__ import annotations

from functools import cache, partial
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.models.mesh.shard import from_mesh, shard, to_mesh
from tests.core.models.mesh.test_sharded import mesh_of

S, A, K = 8, 2, 3
DISCOUNT = 0.99


def random_model(rng, stay):
    """A float32 MDP whose states are left with probability ``1 - stay``; 6 is "a", 7 is a sink."""
    # Distinct ones, for to_dense adds probabilities in single precision.
    successor = rng.permuted(np.tile(np.arange(6), (S, A, 1)), axis=-1)[..., :K]
    successor = np.where(successor == np.arange(S)[:, None, None], 6 + np.arange(K) % 2, successor)
    successor[..., 0] = np.arange(S)[:, None]
    weight = rng.dirichlet(np.ones(K), (S, A)) * (1 - stay)
    weight[..., 0] += stay
    successor[:3, :, 1], successor[3:6, :, 1] = 6, 7
    successor[6:], weight[6:] = np.arange(6, S)[:, None, None], [1, 0, 0]
    label = np.zeros((S, 2), bool)
    label[6, 0] = True
    label[rng.permutation(6)[:4], 1] = True
    return jl.make_mdp(successor, weight, label=label, propositions=["a", "b"])


def walk(size):
    """A symmetric random walk between two ends, with self-loops: some 10^5 steps."""
    states = np.arange(size)
    successor = np.stack([states, (states - 1).clip(0), (states + 1).clip(0, size - 1)], -1)
    weight = np.tile([1 / 3, 1 / 3, 1 / 3], (size, 1))
    weight[0], weight[-1] = [1, 0, 0], [1, 0, 0]
    label = np.zeros((size, 2), bool)
    label[-1, 0], label[1:-1, 1] = True, True
    return jl.make_mdp(successor[:, None], weight[:, None], label=label, propositions=["a", "b"])


class Kinds:
    """One float32 model as every kind of model, and its answers in the order of the states."""

    def __init__(self, mdp, inside):
        self.mdp, self.inside = mdp, inside
        self.sparse = jl.to_sparse(mdp)
        self.sharded = shard(mdp, mesh_of(2))
        self.product = jl.product(mdp, "F a")
        self.dense = jl.models.to_dense(mdp)

    def padded(self):
        return {"mdp": self.mdp, "dense": self.dense}

    def back(self, found):
        """The bounds of an answer over the mesh."""
        return from_mesh(self.sharded, found.lower), from_mesh(self.sharded, found.upper)

    def on_rows(self, x):
        host = self.sparse.host
        return np.asarray(x)[host.state, np.asarray(self.sparse.action)]


def everywhere(kinds, ask, arrays, on_rows):
    """The answers of all kinds of models to ``ask(model, *arrays)``, also inside ``jit`` if asked."""
    found = {}
    for name, model in kinds.padded().items():
        found[name] = ask(model, *arrays)
        if kinds.inside:
            found[f"{name}, jit"] = jitted(ask)(model, *arrays)
    found["sparse"] = ask(kinds.sparse, *on_rows)
    if not kinds.inside:
        return found
    spread = [None if x is None else to_mesh(kinds.sharded, x) for x in arrays]
    found["sharded"] = kinds.back(jitted(ask)(kinds.sharded, *spread))
    return found


@cache
def jitted(ask):
    """The same function for each model, so that it is traced once."""
    return jax.jit(ask)


@cache
def asker(question, objective):
    """``ask(model, ...)`` with arrays alone."""
    given = {"objective": objective, "tolerance": 1e-3}
    return {
        "reachability": lambda m, target, policy: jl.reachability_probability(
            m, target, policy=policy, **given
        ),
        "reward": lambda m, reward, target, policy: jl.total_reward(
            m, reward, target, policy=policy, **given
        ),
        "discounted": lambda m, reward, policy: (
            jl.optimal_value(m, reward, DISCOUNT)
            if policy is None
            else jl.policy_value(m, policy, reward, DISCOUNT)
        ),
        "product": lambda m, policy: (
            jl.optimal_satisfaction(m, **given)
            if policy is None
            else jl.satisfaction_probability(m, policy, tolerance=1e-3)
        ),
    }[question]


def reachability(kinds, objective, policy):
    """The probability of ``F a`` by every way to ask for it."""
    target = np.asarray(kinds.mdp.label)[:, 0]
    place = np.arange(target.size), np.asarray(kinds.product.initial_memory)
    weight = None if policy is None else kinds.on_rows(policy)
    ask = asker("reachability", objective)
    found = everywhere(kinds, ask, (target, policy), (target, weight))
    for name, model in kinds.padded().items():
        found[f"{name}, stay"] = jl.reachability_probability(
            model, target, policy=policy, stay=np.ones(target.size, bool), objective=objective
        )
    if policy is None:
        text = f'P{objective}=? [ F "a" ]'
        found["property"] = jl.solve_property(kinds.sparse, text, tolerance=1e-3)
    else:
        policy = np.repeat(policy[:, None], kinds.product.num_memory, 1)
    ask = asker("product", objective)
    solvers = {"product": ask} | ({"product, jit": jitted(ask)} if kinds.inside else {})
    for name, solve in solvers.items():
        answer = solve(kinds.product, policy)
        found[name] = tuple(np.asarray(x)[place] for x in (answer.lower, answer.upper))
    return found


def total_reward(kinds, objective, policy):
    """Expected steps until ``a`` or a sink."""
    mdp = kinds.mdp
    loop = np.asarray(mdp.successor) == np.arange(mdp.num_states)[:, None, None]
    target = (~np.asarray(mdp.probability > 0) | loop).all((1, 2))
    reward = np.ones((mdp.num_states, mdp.num_actions), np.float32)
    weight = None if policy is None else kinds.on_rows(policy)
    rows = np.ones(kinds.sparse.num_rows), target, weight
    return everywhere(kinds, asker("reward", objective), (reward, target, policy), rows)


def discounted(kinds, objective, policy):
    """Discounted value of a reward of 1 a step before the last two states."""
    reward = np.where(np.arange(kinds.mdp.num_states)[:, None] < 6, 1, 0)
    reward = np.broadcast_to(reward, (kinds.mdp.num_states, kinds.mdp.num_actions))
    reward = np.asarray(reward, np.float32)
    weight = None if policy is None else kinds.on_rows(policy)
    rows = kinds.on_rows(reward).astype(float), weight
    return everywhere(kinds, asker("discounted", "max"), (reward, policy), rows)


def bounded(kinds, objective, policy):
    """Step-bounded reachability, by every kind of model that it takes."""
    target = np.asarray(kinds.mdp.label)[:, 0]
    every = np.ones(target.size, bool)
    ask = partial(jl.values.bounded_reachability, objective=objective)
    found = {"sparse": ask(kinds.sparse, target, 1000)}
    for name, model in kinds.padded().items():
        found[name] = ask(model, target, 1000)
        found[f"{name}, stay"] = ask(model, target, 1000, stay=every)
    return found


QUESTIONS = {
    "reachability": reachability,
    "total reward": total_reward,
    "discounted": discounted,
    "bounded": bounded,
}


def assert_they_intersect(found):
    ends = {name: (x.lower, x.upper) if hasattr(x, "lower") else x for name, x in found.items()}
    ends = {name: [np.asarray(x, np.float64).ravel() for x in pair] for name, pair in ends.items()}
    for (one, (low, high)), (other, (low_, high_)) in combinations(ends.items(), 2):
        apart = np.maximum(low - high_, low_ - high)
        s = int(apart.argmax())
        assert apart[s] <= 0, (
            f"state {s}: {one} [{low[s]}, {high[s]}] and {other} [{low_[s]}, {high_[s]}]"
        )


ALSO = [
    ("sticky", 0, 0.5),
    ("sticky", 1, 0.9995),
    *(("sticky", seed, 0.998) for seed in range(10, 22)),
    ("walk", 60, 0),
]


@pytest.mark.few(12, 4)
@pytest.mark.parametrize("question", QUESTIONS)
@pytest.mark.parametrize(
    ("case", "seed", "stay"),
    [
        ("sticky", 2, 0.998),
        *(pytest.param(*case, marks=pytest.mark.exhaustive) for case in ALSO),
    ],
)
@pytest.mark.parametrize("kind", ["max", "min", "policy"])
@pytest.mark.parametrize("inside", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_enclosures_of_one_float32_model_intersect(question, case, seed, stay, kind, inside):
    if question in ("discounted", "bounded") and kind == ("min", "policy")[question == "bounded"]:
        pytest.skip("asked for by no function")
    rng = np.random.default_rng(seed)
    with jax.enable_x64(False):
        mdp = random_model(rng, stay) if case == "sticky" else walk(seed)
        assert mdp.dtype == jnp.float32
        policy = None
        if kind == "policy":
            policy = rng.dirichlet(np.ones(mdp.num_actions), mdp.num_states).astype(np.float32)
        objective = "min" if kind == "min" else "max"
        assert_they_intersect(QUESTIONS[question](Kinds(mdp, inside), objective, policy))


def test_mass_that_rounding_loses_is_not_a_probability():
    """The example of a float32 row that lacks 6e-8, in a loop left as rarely."""
    rare = 2.0**-24
    successor = [[[0, 1, 2]], [[1, 1, 1]], [[2, 2, 2]]]
    weight = [[[1 - 4 * rare, 3 * rare, rare]], [[1, 0, 0]], [[1, 0, 0]]]
    target = np.array([False, True, False])
    with jax.enable_x64(False):
        mdp = jl.make_mdp(successor, weight)
        found = {
            "mdp": jl.reachability_probability(mdp, target),
            "stay": jl.reachability_probability(mdp, target, stay=np.ones(3, bool)),
            "jit": jax.jit(jl.reachability_probability)(mdp, target),
        }
        assert_they_intersect(found)
