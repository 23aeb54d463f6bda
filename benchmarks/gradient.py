"""(c) One exact gradient of the likelihood in a product against the unrolled iteration."""

from __future__ import annotations

from functools import partial
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp

from benchmarks.timing import compare, once
from jaxltl.algos import mlirl
from jaxltl.core.models.ops.operators import action_mean
from jaxltl.core.models.product import product
from jaxltl.core.values.discounted.discounted import action_value
from jaxltl.core.values.discounted.soft import policy_logits
from jaxltl.reproduce.mlirl import two_goals

_TASK = "(!r & !y) -> ((!r U y) & (!y U g1) & (!y U g2) & F y)"


def problem() -> mlirl.Problem:
    """The grid world of section 2.5 beside its task: 100 cells, six states after the start."""
    world, demonstrations = two_goals()
    model = product(world, _TASK)
    features = mlirl.task_features(model, demonstrations, avoid=["r"])
    return mlirl.make_problem(model, features.values, demonstrations)


@partial(jax.jit, static_argnames=("num_steps", "damping"))
def unrolled_gradient(weights, given: mlirl.Problem, hparams, *, num_steps: int, damping: float):
    """Reverse mode through a fixed number of (damped) Boltzmann backups."""
    model, discount = given.model, hparams.discount

    def loss(weights):
        reward = given.reward(weights, given.features)

        def backup(v, _):
            policy = jax.nn.softmax(policy_logits(model, reward, discount, v))
            image = action_mean(policy, action_value(model, reward, discount, v))
            return damping * v + (1 - damping) * image, None

        v, _ = jax.lax.scan(backup, jnp.zeros(model.state_shape), None, length=num_steps)
        log_policy = jax.nn.log_softmax(policy_logits(model, reward, discount, v))
        likelihood = jnp.sum(given.counts * jnp.where(given.counts > 0, log_policy, 0))
        return hparams.l2 / 2 * jnp.sum(weights * weights) - likelihood

    return jax.grad(loss)(weights)


@jax.jit
def exact_gradient(parameters, given: mlirl.Problem, hparams, initial=None):
    """The gradient as the learner takes it."""
    return jax.grad(lambda p: mlirl.objective(p, given, hparams, initial)[0])(parameters)


def _temporary_bytes(function, *arguments, **static) -> int:
    compiled = function.lower(*arguments, **static).compile()
    return int(compiled.memory_analysis().temp_size_in_bytes)


class _Network(nn.Module):
    """About 10^4 weights on the five features."""

    @nn.compact
    def __call__(self, x):
        x = nn.relu(nn.Dense(96)(x))
        return nn.Dense(1)(nn.relu(nn.Dense(96)(x)))[..., 0]


def run() -> list[dict[str, Any]]:
    """float64; the unrolled peer takes the fewest steps that reach our accuracy."""
    rows = []
    with jax.enable_x64(True):
        given = problem()
        weights = jnp.array([9.5, 3.5, 0.7, 2.0, 3.5])
        for discount in (0.5, 0.9):
            hparams = mlirl.Hparams(discount=discount)
            damping = 0.0 if discount < 0.7 else 0.5
            exact = exact_gradient(weights, given, hparams)
            scale = jnp.max(jnp.abs(exact))
            for num_steps in (25, 50, 75, 100, 150, 200, 300, 400, 600, 800, 1200):
                peer = partial(
                    unrolled_gradient, weights, given, hparams, num_steps=num_steps, damping=damping
                )
                error = float(jnp.max(jnp.abs(peer() - exact)) / scale)
                if error < 1e-9:
                    break
            nearby = mlirl.solve(weights * 1.01, given, hparams).value
            for start, initial in (("cold", None), ("as in training", nearby)):
                ours = partial(exact_gradient, weights, given, hparams, initial)
                rows.append(
                    {
                        "name": f"likelihood gradient, discount {discount}, {start}",
                        "states": given.model.num_states,
                        "peer": f"unrolled, {num_steps} steps",
                        "error": error,
                        "target": 1 / 5,
                        **compare(ours, peer, repeats=21),
                        "temporary_bytes": _temporary_bytes(
                            exact_gradient, weights, given, hparams, initial
                        ),
                        "peer_temporary_bytes": _temporary_bytes(
                            unrolled_gradient,
                            weights,
                            given,
                            hparams,
                            num_steps=num_steps,
                            damping=damping,
                        ),
                    }
                )
        rows.append(_network_row(given, weights))
    return rows


def _network_row(given: mlirl.Problem, weights) -> dict[str, Any]:
    hparams = mlirl.Hparams(discount=0.5)
    network = _Network()
    start = network.init(jax.random.key(0), given.features)
    count = sum(x.size for x in jax.tree.leaves(start))
    # The same rewards from both, so that the solves are the same.
    reward = lambda p, f: mlirl.linear_reward(weights, f) + 1e-3 * network.apply(p, f)  # noqa: E731
    learned = given.replace(reward=reward, guess=start)
    ours = partial(exact_gradient, start, learned, hparams)
    peer = partial(exact_gradient, weights, given, hparams)
    forward = jax.jit(jax.grad(lambda p: jnp.sum(reward(p, given.features))))
    once(lambda: forward(start))
    return {
        "name": f"likelihood gradient, network of {count} weights",
        "states": given.model.num_states,
        "peer": "five features",
        "target": 1.5,
        "network_alone_seconds": min(once(lambda: forward(start))[0] for _ in range(11)),
        **compare(ours, peer, repeats=21),
    }
