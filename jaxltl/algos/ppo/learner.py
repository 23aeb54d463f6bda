"""Proximal policy optimisation (PPO) in any environment.

A step collects T transitions of each of N environments with the current policy, estimates
generalised advantages, and makes some epochs of Adam on minibatches of the clipped surrogate
(Schulman et al. 2017). The value after a truncation is that of the value network at the truncated
observation; after a termination it is 0. Actions outside of an environment's mask are never taken,
and the entropy is that over allowed actions. The implementation details of Huang et al. (2022) and
Andrychowicz et al. (2021) are options of :class:`Hparams`.

Example: a corridor left at its beginning; to go to the end and back earns most. (A step compiles
for seconds, so only shapes are shown.)

  >>> import jax, jax.numpy as jnp, numpy as np
  >>> from jax.tree_util import Partial
  >>> import jaxltl as jl
  >>> from jaxltl.algos import ppo
  >>> def reset(width, key):
  ...     return jnp.int32(0)
  >>> def step(width, place, action, key):  # ahead, back, or stay
  ...     place = place + jnp.array([1, -1, 0], jnp.int32)[action]
  ...     return jl.environments.Timestep(place, reward=place / width, terminated=place < 0,
  ...                        truncated=jax.random.bernoulli(key, 0.1))
  >>> def observe(width, place):
  ...     return {"place": place / width, "end": place == 3}
  >>> def allowed(width, place):
  ...     return jnp.array([place < 3, True, True])
  >>> width = np.array(3.0)  # an argument, so that another value does not recompile
  >>> corridor = jl.make_environment(*(Partial(f, width) for f in (reset, step, observe)),
  ...                                actions=3, allowed=Partial(allowed, width))
  >>> problem = ppo.make_problem(corridor, network=ppo.ActorCritic(3, hidden=()))
  >>> hparams = ppo.Hparams(
  ...     discount=0.9, learning_rate=0.01, num_envs=4, num_steps=6, num_epochs=1,
  ...     num_minibatches=2, normalize_observation=True, normalize_reward=True)
  >>> state = ppo.init(jax.random.key(0), problem, hparams)
  >>> after, metrics = jax.eval_shape(lambda state: ppo.step(state, problem, hparams), state)
  >>> state.transitions.item(), metrics.episode_return.shape
  (0, ())
  >>> agent = ppo.greedy(state, problem, hparams)  # or ppo.policy, which samples
  >>> episode = jax.eval_shape(
  ...     lambda key: jl.run_episode(key, corridor, agent, num_steps=5), jax.random.key(1))
  >>> episode.reward.shape
  (5,)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos.common import action_distributions as actions_of, learner, trees
from jaxltl.algos.common.actor_critic import (
    ActorCritic as ActorCritic,
    Output,
    RecurrentActorCritic as RecurrentActorCritic,
    default_network,
    evaluated,
    fresh_parameters,
    has_memory,
    initial_memory,
    require_network,
)
from jaxltl.algos.common.collection import acting, minibatch_epochs
from jaxltl.algos.common.moments import no_moments
from jaxltl.algos.common.networks import NetworkLike, as_network
from jaxltl.algos.common.schedules import at
from jaxltl.algos.common.settings import require_own
from jaxltl.algos.ppo.collection import (
    Hparams,
    Metrics,
    Problem,
    TransitionRows,
    State,
    Walkers,
    collected,
    evaluate,
)
from jaxltl.core import validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import (
    Box,
    Environment,
    Finite,
    require_environment,
    require_key,
)
from jaxltl.core.environments.episodes import Agent
from jaxltl.core.models.mesh import lanes
from jaxltl.core.types import Status

__all__ = [
    "ActorCritic",
    "Hparams",
    "Metrics",
    "Problem",
    "RecurrentActorCritic",
    "State",
    "greedy",
    "init",
    "make_problem",
    "policy",
    "run",
    "run_until",
    "step",
    "train",
    "train_until",
]


def make_problem(
    environment: Environment,
    *,
    network: NetworkLike | Callable[[Key], Callable[..., PyTree]] | None = None,
    memory: PyTree = None,
) -> Problem:
    """A checked :class:`Problem` of an `environment` with finitely many actions, or a box of floats.

    The `network` is a module of ``flax.linen``, or a function of a random key that makes a module of
    ``flax.nnx`` or another callable with parameters, :func:`~jaxltl.algos.common.networks.as_network`.
    It reads one observation, ``network(observation) -> (action parameters, value)``; with memory
    ``network(memory, observation) -> (memory, (action parameters, value))``. Action parameters are
    logits ``float[A]``, or for a box ``(mean, log_deviation)`` of an action's shape; the value is a
    scalar. Default :class:`ActorCritic`. The initial `memory` of a recurrent network is by default
    its ``initial_memory()``.

    Raises:
      ValueError: a network that returns other shapes or keeps more than parameters; a memory that
        does not fit; a box of integers; not an environment.
    """
    environment = require_environment(environment)
    actions = environment.actions
    if isinstance(actions, Box) and not jnp.issubdtype(jnp.dtype(actions.dtype), jnp.floating):
        raise ValueError(
            f"environment.actions is a box of {actions.dtype}; enumerate its elements as Finite(n)."
        )
    network = default_network(actions) if network is None else as_network(network)
    memory = trees.strong(initial_memory(network, memory))
    seen = jax.eval_shape(
        lambda key: environment.observe(environment.reset(key)), jax.random.key(0)
    )
    space = (
        jax.ShapeDtypeStruct((actions.num,), jnp.result_type(float))
        if isinstance(actions, Finite)
        else jax.ShapeDtypeStruct(actions.shape, jnp.dtype(actions.dtype))
    )
    require_network(network, memory, seen, space, isinstance(actions, Finite))
    return Problem(environment=environment, memory=memory, network=network)


def _check(problem: Problem, hparams: Hparams) -> None:
    require_own((problem, Problem), (hparams, Hparams))
    validation.integer(
        "num_envs times num_steps", hparams.num_envs * hparams.num_steps, limit=2**31 - 1
    )
    recurrent = has_memory(problem)
    size = hparams.num_envs * (1 if recurrent else hparams.num_steps)
    if size % hparams.num_minibatches:
        unit = "environments" if recurrent else "num_envs times num_steps"
        raise ValueError(
            f"num_minibatches={hparams.num_minibatches} does not divide {size}, the number of "
            f"{unit}; choose a divisor."
        )
    lanes.require_split(
        "sharding",
        hparams.sharding,
        num_envs=hparams.num_envs,
        **{"the number of rows of a minibatch": size // hparams.num_minibatches},
    )


# --- learned policies -----------------------------------------------------------------------------


def policy(state: State, problem: Problem, hparams: Hparams) -> Agent:
    """The learned policy as an agent that samples its actions, for ``run_episode``."""
    return _agent(state, problem, hparams, True)


def greedy(state: State, problem: Problem, hparams: Hparams) -> Agent:
    """The learned policy of a run's `state`, `problem` and `hparams`, taking its most likely action.

    A Gaussian's is the mean.
    """
    return _agent(state, problem, hparams, False)


def _agent(state: State, problem: Problem, hparams: Hparams, sampled: bool) -> Agent:
    require_own((state, State), (problem, Problem), (hparams, Hparams))
    run = Partial(evaluate, (problem, state.parameters, state.moments))
    return acting(run, problem.environment.actions, (sampled, hparams.squash), problem.memory)


# --- learning -------------------------------------------------------------------------------------


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """Random parameters, and N environments at initial states."""
    _check(problem, hparams)
    return _begun(require_key(key), problem, hparams)


@jax.jit
def _begun(key: Key, problem: Problem, hparams: Hparams) -> State:
    network_key, world_key = jax.random.split(learner.init_key(key))
    size = hparams.num_envs
    worlds = jax.vmap(problem.environment.reset)(jax.random.split(world_key, size))
    first = jax.tree.map(lambda x: x[0], jax.vmap(problem.environment.observe)(worlds))
    parameters = fresh_parameters(network_key, problem.network, problem.memory, first)
    said = jax.eval_shape(partial(evaluated, problem), parameters, problem.memory, first)
    zeros = jnp.zeros(size, said.value.dtype)
    reward = jnp.zeros(size, jnp.result_type(float))
    walkers = Walkers(
        world=worlds,
        memory=jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape)), problem.memory),
        episode_return=reward,
        episode_length=jnp.zeros(size, jnp.int32),
        discounted=zeros,
    )
    moments = None
    if hparams.normalize_observation:
        moments = jax.tree.map(lambda x: no_moments(x.shape), first)
    return trees.strong(
        State(
            key=key,
            step=jnp.int32(0),
            parameters=parameters,
            optimizer=descent(hparams).init(parameters),
            walkers=lanes.split_axis(walkers, hparams.sharding),
            moments=moments,
            return_moments=no_moments(()) if hparams.normalize_reward else None,
            transitions=jnp.int32(0),
        )
    )


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """T transitions of N environments, and some epochs of minibatches of them."""
    _check(problem, hparams)
    require_own((state, State))
    schedules = {name: getattr(hparams, name) for name in ("learning_rate", "clip", "value_clip")}
    hparams = replace(hparams, **{name: at(x, state.step) for name, x in schedules.items()})
    collect_key, update_key = jax.random.split(learner.step_key(state))
    after, begun, rows, figures = collected(collect_key, state, problem, hparams)
    permitted, finite = figures.pop("permitted"), figures.pop("finite")
    parameters, optimizer, losses = improved(update_key, state, rows, begun, problem, hparams)
    parameters, optimizer = trees.choose(
        permitted, (parameters, optimizer), (state.parameters, state.optimizer)
    )
    status = jnp.where((losses["nonfinite"] > 0) | ~finite, Status.NONFINITE, Status.COMPLETED)
    transitions = learner.saturating_add(state.transitions, hparams.num_envs * hparams.num_steps)
    new = replace(
        after,
        step=state.step + 1,
        parameters=parameters,
        optimizer=optimizer,
        transitions=transitions,
    )
    return new, Metrics(
        **figures,
        **losses,
        transitions=transitions,
        learning_rate=jnp.asarray(hparams.learning_rate, losses["kl"].dtype),
        status=jnp.where(permitted, status, Status.INVALID).astype(jnp.int32),
    )


init, step, run, train, run_until, train_until = learner.bind(_init, _step)


# --- the update -----------------------------------------------------------------------------------

Figures = dict[str, jax.Array]  # of Metrics: of a minibatch before its update, or means


def descent(hparams: Hparams) -> optax.GradientTransformation:
    """Adam without its learning rate, which a schedule supplies."""
    return optax.scale_by_adam(eps=hparams.adam_epsilon)


def loss(
    parameters: PyTree,
    rows: TransitionRows,
    begun: PyTree,
    problem: Problem,
    hparams: Hparams,
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
    clipped = jnp.clip(ratio, 1 - hparams.clip, 1 + hparams.clip)
    gain = jnp.minimum(ratio * advantage, clipped * advantage).mean()
    value = said.value.astype(rows.value.dtype)
    error = (value - target) ** 2
    if hparams.value_clip is not None:
        shift = jnp.clip(value - rows.value, -hparams.value_clip, hparams.value_clip)
        error = jnp.maximum(error, (rows.value + shift - target) ** 2)
    error = error.mean() / 2
    total = -gain + hparams.value_weight * error - hparams.entropy_weight * entropy
    return total, {
        "policy_loss": -gain,
        "value_loss": error,
        "entropy": entropy,
        "kl": jnp.mean(ratio - 1 - change),
        "clip_fraction": jnp.mean(jnp.abs(ratio - 1) > hparams.clip, dtype=ratio.dtype),
    }


def _said(parameters: PyTree, rows: TransitionRows, begun: PyTree, problem: Problem) -> Output:
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
    key: Key, state: State, rows: TransitionRows, begun: PyTree, problem: Problem, hparams: Hparams
) -> tuple[PyTree, PyTree, Figures]:
    """Parameters and optimiser state after the epochs, up to `target_kl`, and mean figures."""
    recurrent, over = has_memory(problem), hparams.sharding
    rows, begun = lanes.replicate((rows, begun), over)  # a minibatch may contain any of them
    if not recurrent:
        rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)

    def update(carry: PyTree, chosen: jax.Array) -> tuple[PyTree, PyTree]:
        *before, stopped = carry
        some = jax.tree.map(lambda x: jnp.take(x, chosen, axis=int(recurrent)), rows)
        memory = jax.tree.map(lambda x: x[chosen], begun) if recurrent else ()
        some, memory = lanes.split_axis(some, over, int(recurrent)), lanes.split_axis(memory, over)
        (_, statistics), slope = jax.value_and_grad(loss, has_aux=True)(
            before[0], some, memory, problem, hparams
        )
        slope, statistics = lanes.replicate((slope, statistics), over)
        norm = jnp.sqrt(sum(jnp.sum(x**2) for x in jax.tree.leaves(slope)))
        statistics = statistics | {"gradient_norm": norm}
        if hparams.target_kl is not None:
            stopped |= statistics["kl"] > hparams.target_kl
        finite = jnp.isfinite(norm)
        if hparams.max_gradient_norm is not None:
            shorter = jnp.minimum(1, hparams.max_gradient_norm / jnp.maximum(norm, 1e-38))
            slope = jax.tree.map(lambda x: x * shorter.astype(x.dtype), slope)
        change, optimizer = descent(hparams).update(slope, before[1])
        parameters = jax.tree.map(
            lambda x, u: x - (hparams.learning_rate * u).astype(x.dtype), before[0], change
        )
        applied = finite & ~stopped
        new = trees.choose(applied, (parameters, optimizer), tuple(before))
        return (*new, stopped), (statistics, applied, ~finite & ~stopped)

    (parameters, optimizer, _), (statistics, applied, lost) = minibatch_epochs(
        key,
        update,
        (state.parameters, state.optimizer, jnp.bool_(False)),
        hparams.num_envs if recurrent else len(rows.value),
        num_epochs=hparams.num_epochs,
        num_minibatches=hparams.num_minibatches,
    )
    number = applied.sum()
    figures = {
        name: jnp.sum(jnp.where(applied, x, 0)) / jnp.where(number > 0, number, jnp.nan)
        for name, x in statistics.items()
    }
    figures |= {"updates": number.astype(jnp.int32), "nonfinite": lost.sum().astype(jnp.int32)}
    return parameters, optimizer, figures
