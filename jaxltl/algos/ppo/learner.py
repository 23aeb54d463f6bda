"""Proximal policy optimisation: a policy and a value, improved on what the policy itself did.

A step draws T steps of N environments with the policy of that moment, estimates generalised
advantages, and makes some epochs of minibatches of Adam on the clipped surrogate (Schulman et al.
2017). Environments are those of :mod:`jaxltl.core.environments.environment`; an episode that is cut off
is worth what the value network expects of the world in which it was cut off, one that is over
nothing more. Where the environment allows only some actions, no other is ever taken, and the
entropy is that over those allowed: a network learns inside what a shield leaves.

What published implementations list (Huang et al. 2022, Andrychowicz et al. 2021) is here by name
in :class:`Hparams`.

Example: a corridor of which one leaves at its beginning; to go to the end and back earns most.
(A step is compiled in some seconds, so its shapes alone are shown.)

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
  >>> width = np.array(3.0)  # an argument, so that another one compiles nothing anew
  >>> corridor = jl.make_environment(*(Partial(f, width) for f in (reset, step, observe)),
  ...                                actions=3, allowed=Partial(allowed, width))
  >>> problem = ppo.make_problem(corridor, network=ppo.ActorCritic(3, hidden=()))
  >>> hparams = ppo.Hparams(
  ...     discount=0.9, learning_rate=0.01, num_envs=4, num_steps=6, num_epochs=1,
  ...     num_minibatches=2, normalize_observation=True, normalize_reward=True)
  >>> state = ppo.init(jax.random.key(0), problem, hparams)  # ppo.train is init and run
  >>> after, metrics = jax.eval_shape(  # run is step after step; run_until, train_until end early
  ...     lambda state: ppo.step(state, problem, hparams), state)
  >>> state.transitions.item(), metrics.episode_return.shape
  (0, ())
  >>> agent = ppo.greedy(state, problem, hparams)  # or ppo.policy, which draws
  >>> episode = jax.eval_shape(
  ...     lambda key: jl.run_episode(key, corridor, agent, num_steps=5), jax.random.key(1))
  >>> episode.reward.shape
  (5,)

Many seeds are ``jax.vmap(lambda key: train(key, problem, hparams, num_steps=...))(keys)``; so are
many settings, by ``vmap`` over the numbers of ``Hparams``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jax.tree_util import Partial

from jaxltl.algos.common.settings import COUNT, MAX_INT, Number, static, traced
from jaxltl.core.validation import Range
from jaxltl.algos.common import action_distributions as actions_of

from jaxltl.algos.common import trees
from jaxltl.algos.common import learner
from jaxltl.algos.common.actor_critic import ActorCritic as ActorCritic
from jaxltl.algos.common.actor_critic import RecurrentActorCritic as RecurrentActorCritic
from jaxltl.algos.common.actor_critic import (
    default_network,
    evaluated,
    fresh_parameters,
    has_memory,
    initial_memory,
    require_network,
)
from jaxltl.algos.common.moments import Moments, no_moments, normalized
from jaxltl.algos.common.schedules import Schedule
from jaxltl.algos.common.schedules import at as _at
from jaxltl.algos.ppo._collect import Walkers, collected
from jaxltl.algos.ppo._update import descent, improved
from jaxltl.core import validation
from jaxltl.core.environments.environment import (
    Box,
    Environment,
    Finite,
    require_environment,
    require_key,
)
from jaxltl.core.environments.episodes import Agent
from jaxltl.core.models.mesh import lanes
from jaxltl.core.pretty_print import brief, history
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


@brief
@struct.dataclass
class Problem:
    """An environment and a network, made by :func:`make_problem`.

    Attributes:
      environment: where to act.
      memory: of the network before it has seen anything, a tree of arrays; ``()`` for one without.
      network: a ``flax.linen`` module; static.
    """

    environment: Environment
    memory: Any
    network: nn.Module = struct.field(pytree_node=False)


@brief
@struct.dataclass
class Hparams:
    """How to learn. Numbers are traced, so new values do not recompile; None is static.

    A *schedule* is a number, or changes from step to step: ``schedules.Linear(first, last,
    num_steps)``, ``schedules.Polynomial``, or ``Partial(function)`` of the number of the step from
    1, as optax's schedules are functions.

    Attributes:
      discount: of rewards, in [0, 1]; times what the environment says of each step.
      gae_lambda: of the generalised advantages: 1 has no bias, 0 least variance; default 0.95.
      learning_rate: of Adam; a schedule; default 2.5e-4.
      clip: how far the ratio of probabilities may move before it is worth nothing; a schedule;
        default 0.2.
      value_clip: the same of values, in their units; a schedule; None: they are not clipped;
        default None.
      value_weight: of the value's squared error, halved; default 0.5.
      entropy_weight: of the entropy of the actions; default 0.01.
      max_gradient_norm: gradients are shortened to it; None: they are not; default 0.5.
      target_kl: no further updates in a step once a minibatch's estimated divergence from the
        policy that acted exceeds it; None: all are made; default None.
      adam_epsilon: of Adam; default 1e-5.
      num_envs: N, environments side by side; static; default 8.
      num_steps: T, of each of them in a step of the learner; static; default 128.
      num_epochs: passes over what was collected; static; default 4.
      num_minibatches: of each pass; with a recurrent network, each has whole environments; static;
        default 4.
      normalize_advantage: whether advantages are centred and scaled in each minibatch; static;
        default True.
      normalize_observation: whether the network reads observations (their floats) centred and
        scaled by their moments up to the step before, clipped to ten deviations; static;
        default False.
      normalize_reward: whether rewards are divided by the standard deviation of discounted sums of
        rewards so far, and clipped to ten; static; default False.
      squash: how a Gaussian action gets into its box: ``"clip"``, or ``"tanh"`` along axes that
        have both bounds; static. Either way the network speaks in units in which such axes are
        [-1, 1]. Default ``"clip"``.
      num_resets: how many worlds in which episodes begin are drawn before the T steps of a step;
        static. None: T N, one for whatever might end, which is fast and takes memory. 0: N of them
        in each of the T steps, which is the same to the learner. Some other number: that many,
        handed out in turn, and from the first again if they do not suffice; where a reset is
        costly and episodes are long, this is fastest. Default None.
      sharding: a ``NamedSharding`` whose spec names the mesh axis over which the environments, and
        each minibatch, are split, such as ``NamedSharding(mesh, PartitionSpec("environments"))``;
        static. The run is the same up to the order of sums. What a step collected is sent to
        all devices once, for a minibatch is drawn from all of it. Default None.
    """

    discount: Number = traced(Range(0, 1))
    gae_lambda: Number = traced(Range(0, 1), default=0.95)
    learning_rate: Schedule = traced(Range(0, open_above=True), default=2.5e-4, schedule=True)
    clip: Schedule = traced(Range(0), default=0.2, schedule=True)
    value_clip: Schedule | None = traced(Range(0), default=None, schedule=True)
    value_weight: Number = traced(Range(0, open_above=True), default=0.5)
    entropy_weight: Number = traced(Range(0, open_above=True), default=0.01)
    max_gradient_norm: Number | None = traced(Range(0), default=0.5)
    target_kl: Number | None = traced(Range(0), default=None)
    adam_epsilon: Number = traced(Range(0, open_above=True), default=1e-5)
    num_envs: int = static(COUNT, default=8)
    num_steps: int = static(COUNT, default=128)
    num_epochs: int = static(COUNT, default=4)
    num_minibatches: int = static(COUNT, default=4)
    normalize_advantage: bool = static(bool, default=True)
    normalize_observation: bool = static(bool, default=False)
    normalize_reward: bool = static(bool, default=False)
    squash: str = static(actions_of.SQUASHES, default="clip")
    num_resets: int | None = static(Range(0, MAX_INT, integer=True), default=None)
    sharding: Any = struct.field(pytree_node=False, default=None)


@brief
@struct.dataclass
class State:
    """A policy on its way.

    Attributes:
      key: of the whole run.
      step: ``int32[]``, steps of the learner made.
      parameters: of the network, a pytree.
      optimizer: optax's state.
      walkers: the N environments.
      moments: of the observation, a tree as it is, of its float leaves; None: not asked for.
      return_moments: of discounted sums of rewards; None: not asked for.
      transitions: ``int32[]``, steps of environments made; at most 2^31 - 1 are counted.
    """

    key: jax.Array
    step: jax.Array
    parameters: Any
    optimizer: Any
    walkers: Walkers
    moments: Any
    return_moments: Moments | None
    transitions: jax.Array


@brief(facts=partial(history, codes={"status": Status}))
@struct.dataclass
class Metrics:
    """Figures of a step; scalars, of a run ``[T]``. Those of episodes are of the policy before it.

    Attributes:
      transitions: steps of environments made so far, this step's included.
      reward, cost: mean of a step of an environment.
      episodes: how many ended in this step.
      episode_return, episode_length: their mean sum of rewards, without discount, and mean number
        of steps; NaN if there is none.
      policy_loss, value_loss, entropy: mean parts of the loss over the updates that were made.
      kl: mean estimate of the divergence from the policy that acted, ``mean(r - 1 - log r)``.
      clip_fraction: share of ratios that were clipped.
      gradient_norm: mean, before it is shortened.
      explained_variance: share of the variance of the values' targets that they explained.
      learning_rate: of this step.
      updates: minibatches that changed the parameters.
      nonfinite: minibatches left out because a number of theirs was not finite.
      status: COMPLETED; NONFINITE if `nonfinite` is positive or an advantage was not finite;
        INVALID if somewhere no action was allowed (the first is taken there, and parameters stay).
    """

    transitions: jax.Array
    reward: jax.Array
    cost: jax.Array
    episodes: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    policy_loss: jax.Array
    value_loss: jax.Array
    entropy: jax.Array
    kl: jax.Array
    clip_fraction: jax.Array
    gradient_norm: jax.Array
    explained_variance: jax.Array
    learning_rate: jax.Array
    updates: jax.Array
    nonfinite: jax.Array
    status: jax.Array


def make_problem(
    environment: Environment, *, network: nn.Module | None = None, memory: Any = None
) -> Problem:
    """A checked :class:`Problem`.

    Args:
      environment: its actions are finitely many, or a box of floats.
      network: a ``flax.linen`` module, called with one observation, ``network(observation) ->
        (action parameters, value)``; with a memory ``network(memory, observation) -> (memory,
        (action parameters, value))``. Of finitely many actions the parameters are logits
        ``float[A]``, of a box ``(mean, log_deviation)``, both of an action's shape; the value is a
        scalar. Default :class:`ActorCritic`.
      memory: of a recurrent network before it has seen anything; default what its method
        ``initial_memory()`` returns, if it has one.

    Returns:
      :class:`Problem`.

    Raises:
      ValueError: a network that returns something else, or keeps more than parameters; a memory
        that is not the network's; a box of integers; no environment.

    Example:
      >>> from jaxltl import make_environment
      >>> from jaxltl.core.environments import Timestep
      >>> def go(place, action, key):
      ...     place = place + 2 * action - 1
      ...     return Timestep(place, reward=1.0 * (place == 3), terminated=abs(place) == 3)
      >>> corridor = make_environment(
      ...     lambda key: jnp.int32(0), go, lambda place: place[None] / 3, actions=2)
      >>> problem = make_problem(corridor)
      >>> problem.network.num_actions
      2

      Then ``state, metrics = train(key, problem, Hparams(discount=0.99), num_steps=100)``.
    """
    require_environment(environment)
    actions = environment.actions
    if isinstance(actions, Box) and not jnp.issubdtype(jnp.dtype(actions.dtype), jnp.floating):
        raise ValueError(
            f"environment.actions is a box of {actions.dtype}; number what is in it, Finite(n)."
        )
    network = default_network(actions) if network is None else network
    validation.instance("network", network, nn.Module, "a flax.linen.Module")
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


def _require_ours(problem: Problem, hparams: Hparams) -> None:
    validation.instance("problem", problem, Problem, "one of ppo.make_problem")
    validation.instance("hparams", hparams, Hparams, "ppo.Hparams")


def _check(problem: Problem, hparams: Hparams) -> None:
    _require_ours(problem, hparams)
    validation.integer(
        "num_envs times num_steps", hparams.num_envs * hparams.num_steps, most=2**31 - 1
    )
    recurrent = has_memory(problem)
    size = hparams.num_envs * (1 if recurrent else hparams.num_steps)
    if size % hparams.num_minibatches:
        what = "environments" if recurrent else "num_envs times num_steps"
        raise ValueError(
            f"num_minibatches={hparams.num_minibatches} does not divide {size}, the number of "
            f"{what}; choose a divisor."
        )
    lanes.require_split(
        "sharding",
        hparams.sharding,
        num_envs=hparams.num_envs,
        **{"the number of rows of a minibatch": size // hparams.num_minibatches},
    )


# --- what was learned -----------------------------------------------------------------------------


def policy(state: State, problem: Problem, hparams: Hparams) -> Agent:
    """What was learned, an :class:`~jaxltl.core.environments.episodes.Agent` that draws its actions.

    Never one that is not allowed. For :func:`~jaxltl.core.environments.episodes.run_episode`.

    Args:
      state: of one run, as of ``train``.
      problem, hparams: of the run.

    Returns:
      :class:`~jaxltl.core.environments.episodes.Agent`, a pytree.

    Raises:
      ValueError: the state or the problem is none of PPO's.
    """
    return _agent(state, problem, hparams, True)


def greedy(state: State, problem: Problem, hparams: Hparams) -> Agent:
    """The same, taking the most likely action each time; of a box the Gaussian's mean.

    Args:
      state: of one run, as of ``train``.
      problem, hparams: of the run.

    Returns:
      :class:`~jaxltl.core.environments.episodes.Agent`, a pytree.

    Raises:
      ValueError: the state or the problem is none of PPO's.
    """
    return _agent(state, problem, hparams, False)


def _agent(state: State, problem: Problem, hparams: Hparams, sampled: bool) -> Agent:
    validation.instance("state", state, State, "one of ppo.init or ppo.train")
    _require_ours(problem, hparams)
    act = Partial(_actor(sampled, hparams.squash), problem, state.parameters, state.moments)
    return Agent(act, problem.memory)


@cache  # the same function each time, so that what runs an agent is compiled once
def _actor(sampled: bool, squash: str) -> Callable[..., Any]:
    return partial(_act, sampled=sampled, squash=squash)


def _act(
    problem: Problem,
    parameters: Any,
    moments: Any,
    memory: Any,
    observation: Any,
    allowed: Any,
    key: chex.PRNGKey,
    *,
    sampled: bool,
    squash: str,
) -> tuple[jax.Array, Any]:
    actions = problem.environment.actions
    said = evaluated(problem, parameters, memory, normalized(moments, observation))
    action = actions_of.chosen(key, actions, said.action, allowed, sampled=sampled, squash=squash)
    return action, said.memory


# --- learning -------------------------------------------------------------------------------------


def _init(key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
    """The network at its own random start, and N environments at theirs."""
    _check(problem, hparams)
    return _begun(require_key(key), problem, hparams)


@jax.jit
def _begun(key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
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
    """T steps of N environments, and some epochs of minibatches of what they tell."""
    _check(problem, hparams)
    validation.instance("state", state, State, "one of ppo.init or ppo.train")
    collect_key, update_key = jax.random.split(learner.step_key(state))
    after, begun, rows, told = collected(collect_key, state, problem, hparams)
    parameters, optimizer, figures, updates, nonfinite = improved(
        update_key, state, rows, begun, problem, hparams
    )
    parameters, optimizer = trees.choose(
        told.permitted, (parameters, optimizer), (state.parameters, state.optimizer)
    )
    status = jnp.where((nonfinite > 0) | ~told.finite, Status.NONFINITE, Status.COMPLETED)
    status = jnp.where(told.permitted, status, Status.INVALID).astype(jnp.int32)
    new = replace(
        after,
        step=state.step + 1,
        parameters=parameters,
        optimizer=optimizer,
        transitions=learner.saturating_add(state.transitions, hparams.num_envs * hparams.num_steps),
    )
    return new, Metrics(
        transitions=new.transitions,
        reward=told.reward,
        cost=told.cost,
        episodes=told.episodes,
        episode_return=told.episode_return,
        episode_length=told.episode_length,
        policy_loss=figures.policy_loss,
        value_loss=figures.value_loss,
        entropy=figures.entropy,
        kl=figures.kl,
        clip_fraction=figures.clipped,
        gradient_norm=figures.gradient_norm,
        explained_variance=told.explained_variance,
        learning_rate=jnp.asarray(_at(hparams.learning_rate, state.step), figures.kl.dtype),
        updates=updates,
        nonfinite=nonfinite,
        status=status,
    )


init, step, run, train, run_until, train_until = learner.bind(_init, _step)
