"""Problem, hyperparameters, state and metrics of proximal policy optimisation."""

from __future__ import annotations

import flax.linen as nn
import jax
from jax.sharding import NamedSharding

from jaxltl.algos.common import action_distributions as actions_of
from jaxltl.algos.common.moments import Moments
from jaxltl.algos.common.schedules import Schedule
from jaxltl.algos.common.settings import COUNT, MAX_INT, Number, RunState, static, traced
from jaxltl.core import struct
from jaxltl.core.array_types import PyTree
from jaxltl.core.environments.environment import Environment
from jaxltl.core.validation import Range


@struct.dataclass
class Problem:
    """An environment and a network; made by :func:`make_problem`.

    Attributes:
      environment: with finitely many actions, or a box of floats.
      memory: initial memory of the network, a tree of arrays; ``()`` without memory.
      network: a ``flax.linen`` module; static.
    """

    environment: Environment
    memory: PyTree
    network: nn.Module = struct.field(pytree_node=False)


@struct.dataclass
class Hparams:
    """Settings; numbers are traced, None is static.

    A *schedule* is a number, ``schedules.Linear(first, last, num_steps)``, ``schedules.Polynomial``, or
    a ``Partial(function)`` of the number of the step from 1.

    Attributes:
      discount: of rewards, in [0, 1]; multiplied by the environment's.
      gae_lambda: of the advantages: 1 has no bias, 0 least variance; default 0.95.
      learning_rate: of Adam; a schedule; default 2.5e-4.
      clip: bound on the change of the probability ratio in the surrogate; a schedule; default 0.2.
      value_clip: bound on the change of values in their loss; a schedule, or None; default None.
      value_weight: of half the squared error of values; default 0.5.
      entropy_weight: of the entropy of the actions; default 0.01.
      max_gradient_norm: gradients are clipped to this norm, or None; default 0.5.
      target_kl: updates of a step stop when a minibatch's estimated divergence from the collecting
        policy exceeds it, or None; default None.
      adam_epsilon: of Adam; default 1e-5.
      num_envs: N, parallel environments; static; default 8.
      num_steps: T, transitions of each of them in a step; static; default 128.
      num_epochs: passes over the collected transitions; static; default 4.
      num_minibatches: of each pass; with a recurrent network of whole environments; static; default 4.
      normalize_advantage: standardises advantages in each minibatch; static; default True.
      normalize_observation: standardises the floats of observations by their moments up to the last
        step, clipped to ten deviations; static; default False.
      normalize_reward: divides rewards by the standard deviation of discounted sums of rewards so far,
        and clips them to ten; static; default False.
      squash: map of a Gaussian action into its box: ``"clip"``, or ``"tanh"`` along axes with both
        bounds; static. Networks use units in which such axes are [-1, 1]. Default ``"clip"``.
      num_resets: initial states drawn before the T transitions of a step; static. None: T N, one for
        every possible end: fast, and takes memory. 0: N in each transition, with the same results.
        Another number: that many, used cyclically. Default None.
      sharding: of the environments and of each minibatch, such as
        ``NamedSharding(mesh, PartitionSpec("environments"))``; static. Runs are equal up to the order
        of sums; collected transitions are replicated once for each step. Default None.
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
    sharding: NamedSharding | None = struct.field(pytree_node=False, default=None)


@struct.dataclass
class Walkers:
    """N parallel environments: states, memories, and figures of their current episodes, ``[N, ...]``."""

    world: PyTree
    memory: PyTree
    episode_return: jax.Array
    episode_length: jax.Array
    discounted: jax.Array


@struct.dataclass
class State(RunState):
    """A policy, its optimiser, and the environments.

    Attributes:
      parameters: of the network, a pytree.
      optimizer: optax's state.
      walkers: the N environments.
      moments: of the floats of observations, a tree of the observation's structure; or None.
      return_moments: of discounted sums of rewards; or None.
      transitions: ``int32[]``, of environments so far; saturates at 2^31 - 1.
    """

    parameters: PyTree
    optimizer: PyTree
    walkers: Walkers
    moments: PyTree
    return_moments: Moments | None
    transitions: jax.Array


@struct.metrics
class Metrics:
    """Figures of a step; scalars. Those of episodes are of the policy before it.

    Attributes:
      transitions: of environments so far.
      reward, cost: mean of a transition.
      episodes, episode_return, episode_length: number of episodes that ended, and their mean
        undiscounted return and length; NaN without any.
      policy_loss, value_loss, entropy: mean parts of the loss over the updates.
      kl: mean estimate of the divergence from the collecting policy, ``mean(r - 1 - log r)``.
      clip_fraction: share of clipped ratios.
      gradient_norm, learning_rate: mean before clipping, and rate of this step.
      explained_variance: share of the variance of the values' targets that values explained.
      updates, nonfinite: minibatches that changed the parameters, and those skipped because a number
        was not finite.
      status: COMPLETED; NONFINITE if `nonfinite` is positive or an advantage was not finite; INVALID if
        no action was allowed somewhere (the first is taken there, and parameters stay unchanged).
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
