"""The loss of proximal policy optimisation, and epochs of minibatch updates."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax

from jaxltl.algos.common import action_distributions as actions_of, trees
from jaxltl.algos.common.actor_critic import Output, evaluated, has_memory
from jaxltl.algos.common.collection import minibatch_epochs
from jaxltl.algos.common.schedules import at
from jaxltl.algos.ppo._collect import Rows
from jaxltl.algos.ppo.state import Hparams, Problem, State
from jaxltl.core.array_types import Key, Numeric, PyTree
from jaxltl.core.models.mesh import lanes

Figures = dict[str, jax.Array]  # of Metrics: of a minibatch before its update, or means


class Limits(NamedTuple):
    """Values of schedules in this step."""

    clip: Numeric
    value_clip: Numeric | None


def descent(hparams: Hparams) -> optax.GradientTransformation:
    """Adam without its learning rate, which a schedule supplies."""
    return optax.scale_by_adam(eps=hparams.adam_epsilon)


def loss(
    parameters: PyTree,
    rows: Rows,
    begun: PyTree,
    problem: Problem,
    hparams: Hparams,
    limits: Limits,
) -> tuple[jax.Array, Figures]:
    """The loss (Schulman et al. 2017, equation 9) and its parts, of rows ``[N', ...]``::

        mean of -min(r A, clip(r, 1 - c, 1 + c) A)
              + value_weight (V - target)^2 / 2 - entropy_weight H,

    with r the ratio of the new to the old probability of the action, and A the advantage. For a
    network with memory, rows are ``[T, N', ...]`` of whole environments and `begun` their memories.
    """
    actions = problem.environment.actions
    said = _said(parameters, rows, begun, problem)
    batched = jax.vmap if rows.value.ndim == 1 else lambda f: jax.vmap(jax.vmap(f))
    density = batched(partial(actions_of.log_density, actions))(said.action, rows.allowed, rows.raw)
    entropy = batched(partial(actions_of.entropy, actions, squash=hparams.squash))(
        said.action, rows.allowed
    ).mean()
    change = density - rows.log_density
    ratio, advantage = jnp.exp(change), rows.advantage
    target = advantage + rows.value
    if hparams.normalize_advantage:
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    near = jnp.clip(ratio, 1 - limits.clip, 1 + limits.clip)
    gain = jnp.minimum(ratio * advantage, near * advantage).mean()
    value = said.value.astype(rows.value.dtype)
    error = (value - target) ** 2
    if limits.value_clip is not None:
        shift = jnp.clip(value - rows.value, -limits.value_clip, limits.value_clip)
        error = jnp.maximum(error, (rows.value + shift - target) ** 2)
    error = error.mean() / 2
    total = -gain + hparams.value_weight * error - hparams.entropy_weight * entropy
    return total, {
        "policy_loss": -gain,
        "value_loss": error,
        "entropy": entropy,
        "kl": jnp.mean(ratio - 1 - change),
        "clip_fraction": jnp.mean(jnp.abs(ratio - 1) > limits.clip, dtype=ratio.dtype),
    }


def _said(parameters: PyTree, rows: Rows, begun: PyTree, problem: Problem) -> Output:
    say = jax.vmap(partial(evaluated, problem, parameters))
    if not has_memory(problem):
        return say((), rows.observation)

    def on(memory: PyTree, row: PyTree) -> tuple[PyTree, Output]:
        start, observation = row
        memory = jax.vmap(lambda s, m: trees.choose(s, problem.memory, m))(start, memory)
        said = say(memory, observation)
        return said.memory, said._replace(memory=())

    return lax.scan(on, begun, (rows.start, rows.observation))[1]


def improved(
    key: Key, state: State, rows: Rows, begun: PyTree, problem: Problem, hparams: Hparams
) -> tuple[PyTree, PyTree, Figures]:
    """Parameters and optimiser state after the epochs, up to `target_kl`, and mean figures."""
    limits = Limits(at(hparams.clip, state.step), at(hparams.value_clip, state.step))
    rate = at(hparams.learning_rate, state.step)
    recurrent, over = has_memory(problem), hparams.sharding
    rows, begun = lanes.replicate((rows, begun), over)  # a minibatch may contain any of them
    if not recurrent:
        rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)

    def update(carry: PyTree, chosen: jax.Array) -> tuple[PyTree, PyTree]:
        *before, stopped = carry
        some = jax.tree.map(lambda x: jnp.take(x, chosen, axis=int(recurrent)), rows)
        memory = jax.tree.map(lambda x: x[chosen], begun) if recurrent else ()
        some, memory = lanes.split_axis(some, over, int(recurrent)), lanes.split_axis(memory, over)
        (_, told), slope = jax.value_and_grad(loss, has_aux=True)(
            before[0], some, memory, problem, hparams, limits
        )
        slope, told = lanes.replicate((slope, told), over)
        norm = jnp.sqrt(sum(jnp.sum(x**2) for x in jax.tree.leaves(slope)))
        told = told | {"gradient_norm": norm}
        if hparams.target_kl is not None:
            stopped |= told["kl"] > hparams.target_kl
        finite = jnp.isfinite(norm)
        if hparams.max_gradient_norm is not None:
            shorter = jnp.minimum(1, hparams.max_gradient_norm / jnp.maximum(norm, 1e-38))
            slope = jax.tree.map(lambda x: x * shorter.astype(x.dtype), slope)
        change, optimizer = descent(hparams).update(slope, before[1])
        parameters = jax.tree.map(lambda x, u: x - (rate * u).astype(x.dtype), before[0], change)
        made = finite & ~stopped
        new = trees.choose(made, (parameters, optimizer), tuple(before))
        return (*new, stopped), (told, made, ~finite & ~stopped)

    (parameters, optimizer, _), (told, made, lost) = minibatch_epochs(
        key,
        update,
        (state.parameters, state.optimizer, jnp.bool_(False)),
        hparams.num_envs if recurrent else len(rows.value),
        num_epochs=hparams.num_epochs,
        num_minibatches=hparams.num_minibatches,
    )
    number = made.sum()
    figures = {
        name: jnp.sum(jnp.where(made, x, 0)) / jnp.where(number > 0, number, jnp.nan)
        for name, x in told.items()
    }
    figures |= {"updates": number.astype(jnp.int32), "nonfinite": lost.sum().astype(jnp.int32)}
    return parameters, optimizer, figures
