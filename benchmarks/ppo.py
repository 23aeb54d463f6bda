"""(m) PPO beside the scheme of a published single-file implementation, on tasks of gymnax.

The peer is rebuilt from purejaxrl's published description (Lu et al. 2022): one function of a key
whose whole training is a scan; the environments' own autoreset, a value beside each action, an
episode that is cut off treated as over, one shuffle of everything an epoch. Both get the same
environments, networks, settings and numbers of steps. Returns are compared over seeds, speed by
steps of environments a second of processor time, compilation apart, for one seed and for eight
under ``vmap``.

    python -m benchmarks.ppo [cartpole] [breakout] [--seeds 10] [--steps N]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax

from jaxltl.algos import ppo
from jaxltl.algos.common.actor_critic import orthogonal
from jaxltl.algos.common.schedules import Linear
from jaxltl.envs.adapters.gymnax import from_gymnax


class Task(NamedTuple):
    """An environment of gymnax and the settings published for it."""

    name: str
    total: int
    num_envs: int
    num_steps: int
    learning_rate: float
    num_epochs: int = 4
    num_minibatches: int = 4
    activation: str = "tanh"

    @property
    def num_updates(self) -> int:
        return self.total // (self.num_envs * self.num_steps)


TASKS = {
    "cartpole": Task("CartPole-v1", 500_000, 4, 128, 2.5e-4),
    "breakout": Task("Breakout-MinAtar", 10_000_000, 64, 128, 5e-3, 4, 8, "relu"),
}
_DISCOUNT, _LAMBDA, _CLIP, _ENTROPY, _VALUE, _NORM = 0.99, 0.95, 0.2, 0.01, 0.5, 0.5


# --- the peer -------------------------------------------------------------------------------------


class _Pair(nn.Module):
    """Two networks of two layers, orthogonal at the start."""

    num_actions: int
    activation: str

    @nn.compact
    def __call__(self, x: jax.Array) -> tuple[jax.Array, jax.Array]:
        def layers(width: int, scale: float) -> jax.Array:
            y = x
            for _ in range(2):
                y = nn.Dense(64, kernel_init=orthogonal(np.sqrt(2)))(y)
                y = getattr(nn, self.activation)(y)
            return nn.Dense(width, kernel_init=orthogonal(scale))(y)

        return layers(self.num_actions, 0.01), layers(1, 1.0)[..., 0]


def peer(task: Task) -> Callable[[jax.Array], Any]:
    """Training as a function of a key: mean returns of the episodes that ended in each update."""
    import gymnax

    environment, settings = gymnax.make(task.name)
    network = _Pair(environment.action_space(settings).n, task.activation)
    batch = task.num_envs * task.num_steps
    optimizer = optax.chain(
        optax.clip_by_global_norm(_NORM),
        optax.adam(
            lambda n: (
                task.learning_rate
                * (1 - (n // (task.num_minibatches * task.num_epochs)) / task.num_updates)
            ),
            eps=1e-5,
        ),
    )

    def density(logits: jax.Array, action: jax.Array) -> jax.Array:
        return jnp.take_along_axis(jax.nn.log_softmax(logits), action[..., None], -1)[..., 0]

    def flat(x: jax.Array) -> jax.Array:
        return x.reshape(task.num_envs, -1).astype(jnp.float32)

    def move(carry: Any, _: Any) -> Any:
        parameters, world, seen, total, key = carry
        key, act_key, step_key = jax.random.split(key, 3)
        logits, value = network.apply(parameters, seen)
        action = jax.random.categorical(act_key, logits)
        after, world, reward, terminated, truncated, _ = jax.vmap(
            environment.step, (0, 0, 0, None)
        )(jax.random.split(step_key, task.num_envs), world, action, settings)
        done, total = terminated | truncated, total + reward
        row = seen, action, density(logits, action), value, reward, done, total
        return (parameters, world, flat(after), jnp.where(done, 0, total), key), row

    def loss(parameters: Any, rows: Any) -> jax.Array:
        seen, action, old, value, advantage = rows
        logits, new = network.apply(parameters, seen)
        target = advantage + value
        near = value + jnp.clip(new - value, -_CLIP, _CLIP)
        error = jnp.maximum((new - target) ** 2, (near - target) ** 2).mean() / 2
        ratio = jnp.exp(density(logits, action) - old)
        gain = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        gain = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - _CLIP, 1 + _CLIP) * gain).mean()
        entropy = -jnp.sum(jax.nn.softmax(logits) * jax.nn.log_softmax(logits), -1).mean()
        return -gain + _VALUE * error - _ENTROPY * entropy

    def descend(carry: Any, rows: Any) -> Any:
        parameters, memory = carry
        change, memory = optimizer.update(jax.grad(loss)(parameters, rows), memory)
        return (optax.apply_updates(parameters, change), memory), None

    def update(carry: Any, _: Any) -> Any:
        parameters, memory, world, seen, total, key = carry
        (_, world, seen, total, key), path = lax.scan(
            move, (parameters, world, seen, total, key), None, task.num_steps
        )
        observed, action, old, value, reward, done, ended = path
        last = network.apply(parameters, seen)[1]

        def back(carry: Any, row: Any) -> Any:
            advantage, following = carry
            value, reward, done = row
            advantage = (
                reward
                + _DISCOUNT * following * (1 - done)
                - value
                + _DISCOUNT * _LAMBDA * (1 - done) * advantage
            )
            return (advantage, value), advantage

        _, advantage = lax.scan(
            back, (jnp.zeros_like(last), last), (value, reward, done), reverse=True, unroll=16
        )
        rows = jax.tree.map(
            lambda x: x.reshape(batch, *x.shape[2:]), (observed, action, old, value, advantage)
        )

        def epoch(carry: Any, _: Any) -> Any:
            *going, key = carry
            key, order_key = jax.random.split(key)
            order = jax.random.permutation(order_key, batch)
            parts = jax.tree.map(
                lambda x: jnp.take(x, order, axis=0).reshape(
                    task.num_minibatches, -1, *x.shape[1:]
                ),
                rows,
            )
            going, _ = lax.scan(descend, tuple(going), parts)
            return (*going, key), None

        (parameters, memory, key), _ = lax.scan(
            epoch, (parameters, memory, key), None, task.num_epochs
        )
        mean = jnp.sum(ended * done) / jnp.where(done.sum() > 0, done.sum(), jnp.nan)
        return (parameters, memory, world, seen, total, key), mean

    def train(key: jax.Array) -> jax.Array:
        key, net_key, reset_key = jax.random.split(key, 3)
        seen, world = jax.vmap(environment.reset, (0, None))(
            jax.random.split(reset_key, task.num_envs), settings
        )
        seen = flat(seen)
        parameters = network.init(net_key, seen[0])
        begin = (parameters, optimizer.init(parameters), world, seen, jnp.zeros(task.num_envs), key)
        return lax.scan(update, begin, None, task.num_updates)[1]

    return train


# --- ours -----------------------------------------------------------------------------------------


def ours(task: Task) -> Callable[[jax.Array], Any]:
    """The same training by this library."""
    import gymnax

    environment = from_gymnax(*gymnax.make(task.name))
    network = ppo.ActorCritic(environment.actions.num, activation=task.activation)
    problem = ppo.make_problem(environment, network=network)
    hparams = ppo.Hparams(
        discount=_DISCOUNT,
        gae_lambda=_LAMBDA,
        learning_rate=Linear(task.learning_rate, 0.0, task.num_updates),
        clip=_CLIP,
        value_clip=_CLIP,
        value_weight=_VALUE,
        entropy_weight=_ENTROPY,
        max_gradient_norm=_NORM,
        num_envs=task.num_envs,
        num_steps=task.num_steps,
        num_epochs=task.num_epochs,
        num_minibatches=task.num_minibatches,
    )

    def train(key: jax.Array) -> jax.Array:
        _, metrics = ppo.train(
            key, problem, hparams, num_steps=task.num_updates, max_rows=task.num_updates
        )
        return metrics.episode_return

    return train


# --- both -----------------------------------------------------------------------------------------


def _last_returns(returns: np.ndarray) -> np.ndarray:
    """Each seed's mean return over the last tenth of its updates."""
    return np.nanmean(returns[:, -max(returns.shape[1] // 10, 1) :], axis=1)


def compare_returns(task: Task, seeds: int) -> dict[str, Any]:
    """Returns over seeds of both, each in one program."""
    found = {}
    for name, make, first in (("ours", ours, 0), ("peer", peer, 1000)):
        keys = jax.vmap(jax.random.key)(jnp.arange(first, first + seeds))
        last = _last_returns(np.asarray(jax.jit(jax.vmap(make(task)))(keys)))
        found[name] = {
            "mean": float(last.mean()),
            "deviation": float(last.std(ddof=1)),
            "seeds": [round(float(x), 1) for x in last],
        }
    return {"task": task.name, "steps": task.total, **found}


def compare_speed(task: Task, num_updates: int, lanes: int | None, repeats: int) -> dict[str, Any]:
    """Steps a second of processor time of both, in turn."""
    short = task._replace(total=num_updates * task.num_envs * task.num_steps)
    runs = {}
    for name, make in (("ours", ours), ("peer", peer)):
        function, key = make(short), jax.random.key(0)
        if lanes:
            function, key = jax.vmap(function), jax.random.split(key, lanes)
        begin = time.perf_counter()
        compiled = jax.jit(function).lower(key).compile()
        runs[name] = (partial(compiled, key), time.perf_counter() - begin, [], [])
        jax.block_until_ready(compiled(key))
    for _ in range(repeats):
        for run, _, used, passed in runs.values():
            begin, wall = time.process_time(), time.perf_counter()
            jax.block_until_ready(run())
            used.append(time.process_time() - begin)
            passed.append(time.perf_counter() - wall)
    steps = short.total * (lanes or 1)
    row: dict[str, Any] = {"task": task.name, "lanes": lanes or 1, "updates": num_updates}
    for name, (_, compiling, used, passed) in runs.items():
        row[name] = {
            "steps_per_cpu_second": round(steps / statistics.median(used)),
            "steps_per_second": round(steps / statistics.median(passed)),
            "compile_seconds": round(compiling, 1),
        }
    ratios = [b / a for a, b in zip(runs["ours"][2], runs["peer"][2], strict=True)]
    row["ratio"] = round(statistics.median(ratios), 3)
    walls = [b / a for a, b in zip(runs["ours"][3], runs["peer"][3], strict=True)]
    row["wall_ratio"] = round(statistics.median(walls), 3)
    return row


def main() -> None:
    """Prints a line of JSON for each measurement."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.ppo", description=__doc__)
    parser.add_argument("tasks", nargs="*", default=list(TASKS))
    parser.add_argument("--seeds", type=int, default=10, help="0: only the speed")
    parser.add_argument("--steps", type=int, help="of environments; default as published")
    parser.add_argument("--updates", type=int, help="of a timed run")
    parser.add_argument("--repeats", type=int, default=5, help="of a timed run; 0: only returns")
    chosen = parser.parse_args()
    for name in chosen.tasks:
        task = TASKS[name]
        updates = chosen.updates or (100 if name == "cartpole" else 4)
        for lanes in (None, 8) if chosen.repeats else ():
            print(json.dumps(compare_speed(task, updates, lanes, chosen.repeats)), flush=True)
        if chosen.seeds:
            if chosen.steps:
                task = task._replace(total=chosen.steps)
            print(json.dumps(compare_returns(task, chosen.seeds)), flush=True)


if __name__ == "__main__":
    main()
