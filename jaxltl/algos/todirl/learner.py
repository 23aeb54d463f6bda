"""Task-oriented deep inverse RL (Wen 2019, chapter 3).

Maximum-entropy inverse RL with a reward network that reads a local observation, the state of the
task's automaton, and the action: find parameters for which the soft policy of the product makes
the demonstrations likely (3.3). Such a reward is local, so :func:`plan` computes policies in unseen
worlds.

Example: a reward of the state, and the policy that it gives in another world.
  >>> import jax, jax.numpy as jnp
  >>> import jaxltl as jl
  >>> from jaxltl.algos import todirl
  >>> world = jl.make_mdp(  # an initial state, a goal and a trap
  ...     [[[1, 2], [0, 1]], [[1, 0], [0, 0]], [[2, 0], [0, 0]]],
  ...     [[[0.8, 0.2], [0.5, 0.5]], [[1, 0], [0, 0]], [[1, 0], [0, 0]]],
  ...     available=[[True, True], [True, False], [True, False]], initial=[1, 0, 0],
  ...     label=[[0, 0], [1, 0], [0, 1]], propositions=["g", "r"])
  >>> shown = jl.make_trajectories(world, [[(0, 1), (0, 0), (1, 0)], [(0, 0), (1, 0)]])
  >>> model = jl.product(world, "!r U g", label_on="exit")
  >>> problem = todirl.make_problem(  # the second demonstration is held out
  ...     model, jnp.eye(3), shown, network=todirl.RewardNetwork((3,)), held_out=0.5)
  >>> hparams = todirl.Hparams(discount=0.9, patience=3, optimizer="sgd")
  >>> state, metrics = todirl.train(jax.random.key(0), problem, hparams, num_steps=2)
  >>> metrics.held_out.shape
  (2,)
  >>> jax.eval_shape(todirl.policy, state, problem, hparams).shape  # [W, S, Q, A]
  (1, 3, 3, 2)
  >>> parameters = state.best.parameters
  >>> jax.eval_shape(lambda other: todirl.plan(
  ...     problem.network, parameters, other, jnp.eye(3), hparams).policy, model).shape
  (3, 3, 2)
  >>> loss, parts = jax.eval_shape(todirl.objective, parameters, problem, hparams)
  >>> parts.value.shape, jax.eval_shape(todirl.solve, parameters, problem, hparams).value.shape
  ((1, 3, 3), (1, 3, 3))
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import lax

from jaxltl.algos.common import learner, optimizers, trees
from jaxltl.algos.common.actor_critic import summed_layers
from jaxltl.algos.common.learner import Best, stop_early
from jaxltl.algos.common.networks import NetworkLike, as_network
from jaxltl.algos.common.settings import COUNT, Number, RunState, require_output, static, traced
from jaxltl.core import struct
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.models import Product, Trajectories, with_allowed
from jaxltl.core.models.construct.batch import (
    restrict_stacked_actions,
    stack_models,
    stack_observations,
    training_counts,
    unstack_product as lane,
)
from jaxltl.core.models.ops.successor_tables import PredecessorTable, predecessor_table
from jaxltl.core.types import Solution, Status, require_shape, status_code
from jaxltl.core.validation import Range
from jaxltl.core.values.discounted.soft import policy_logits, soft_policy_adjoint, soft_value
from jaxltl.core.values.undiscounted.satisfaction import satisfaction_probability


class RewardNetwork(nn.Module):
    """A multilayer perceptron with ReLU on (observation, memory, action).

    Maps ``float[..., O]``, ``float[..., Q]`` and ``float[..., A]``, which broadcast, to
    ``float[...]``.

    Attributes:
      hidden: widths of the hidden layers; section 3.5 has two of 80. Empty: a linear reward.
    """

    hidden: Sequence[int] = (80, 80)

    @nn.compact
    def __call__(self, observation: jax.Array, memory: jax.Array, action: jax.Array) -> jax.Array:
        return summed_layers(self, (observation, memory, action), (*self.hidden, 1))[..., 0]


class Concatenated(nn.Module):
    """A reward network from one of concatenated inputs, ``[..., O + Q + A] -> [...]`` or ``[..., 1]``.

    Attributes:
      network: the flax module, of vectors ``float[N, O + Q + A]``, or of any leading axes.

    >>> import jax
    >>> read = jnp.zeros((5, 3)), jnp.zeros((5, 2)), jnp.zeros((5, 4))
    >>> jax.eval_shape(Concatenated(nn.Dense(1)).init_with_output, jax.random.key(0), *read)[0].shape
    (5,)
    """

    network: nn.Module

    @nn.compact
    def __call__(self, observation: jax.Array, memory: jax.Array, action: jax.Array) -> jax.Array:
        inputs = (observation, memory, action)
        rows = jnp.broadcast_shapes(*(x.shape[:-1] for x in inputs))
        wide = [jnp.broadcast_to(x, (*rows, x.shape[-1])) for x in inputs]
        result = self.network(jnp.concatenate(wide, axis=-1))
        return result[..., 0] if result.shape == (*rows, 1) else result


@struct.dataclass
class Problem:
    """Products of worlds with the task, observations, and demonstrations.

    Attributes:
      model: products stacked along a first axis of W worlds.
      observation: ``float[W, S, O]``, of each world state.
      counts: ``float[W, S, Q, A]``, demonstrated state-action counts; with a horizon
        ``float[W, T, S, Q, A]``.
      held_out: counts of the held-out demonstrations for early stopping; may be zero.
      weight: ``float[W]``, factors of the worlds' likelihoods.
      predecessors: of the product states, with a first axis of W, for a faster gradient; or None.
      network: called as ``network(observation [S, 1, 1, O], memory [1, Q, 1, Q],
        action [1, 1, A, A]) -> float[S, Q, A]``, memory and action one-hot; static.
    """

    model: Product
    observation: jax.Array
    counts: jax.Array
    held_out: jax.Array
    weight: jax.Array
    predecessors: PredecessorTable | None = None
    network: NetworkLike = struct.field(pytree_node=False, default=RewardNetwork())

    @property
    def horizon(self) -> int | None:
        """The number T of time steps of the counts, or None."""
        return self.counts.shape[1] if self.counts.ndim == 5 else None


@struct.dataclass
class Hparams:
    """Settings; numbers are traced.

    Attributes:
      discount: in [0, 1); with a horizon also 1.
      l2: at least 0; precision of the Gaussian prior on the parameters; default 1e-3.
      learning_rate: of all optimizers but ``lbfgs``; default 3e-3.
      patience: steps without a better held-out likelihood (with `mu`, plus the weighted satisfaction
        probability) after which learning stops; default 50.
      mu: weight of the satisfaction probability (2.6) from the initial states, or None; default None.
      tolerance: certified error of the soft values; None: the precision of the dtype; default None.
      optimizer: ``"lbfgs"``, or the name of one of optax, such as ``"adamw"``; static; default
        ``"adam"``.
      method: of :func:`~jaxltl.core.values.discounted.soft.soft_value`; static;
        default ``"value_iteration"``.
      horizon: number of steps, for a time-dependent policy, or None; static; default None.
    """

    discount: Number = traced("closed_discount")
    l2: Number = traced(Range(0, open_above=True), default=1e-3)
    learning_rate: Number = traced(Range(0, open_above=True), default=3e-3)
    patience: Number = traced(Range(1), default=50)
    mu: Number | None = traced("mu", default=None)
    tolerance: Number | None = traced("tolerance", default=None)
    optimizer: str = static(("lbfgs", *optimizers.NAMES), default="adam")
    method: str = static(("newton", "value_iteration"), default="value_iteration")
    horizon: int | None = static(COUNT, default=None)


def make_problem(
    worlds: Product | Sequence[Product],
    observation: PyTree,
    demonstrations: Trajectories | Sequence[Trajectories],
    *,
    held_out: float | Trajectories | Sequence[Trajectories] | None = 0.2,
    network: NetworkLike | Callable[..., PyTree] | None = None,
    weight: PyTree = None,
    horizon: int | None = None,
    allowed: PyTree = None,
) -> Problem:
    """A checked :class:`Problem` with arrays stacked over W worlds, on the host.

    Args:
      worlds: a product, several, or products stacked along a first axis of W worlds.
      observation: ``float[S, O]``, or one for each world.
      demonstrations: in the world (not in the product), or one for each world.
      held_out: share of each world's trajectories, the last ones, or other trajectories, for early
        stopping; None or 0: no early stopping.
      network: the reward, of :func:`~jaxltl.algos.common.networks.as_network`; default
        :class:`RewardNetwork`.
      weight: ``float[W]``, factors of the worlds' likelihoods; default 1.
      horizon: count pairs by time, for ``Hparams.horizon``.
      allowed: ``bool[S, Q, A]``, or one for each world: action mask of the policies; default all.
        Demonstrated steps outside of it do not count.

    Raises:
      ValueError: arguments of different or wrong shapes, demonstrations that do not fit their world or
        exceed the horizon, or no counted pair.
    """
    model = stack_models(worlds)
    if allowed is not None:
        model = restrict_stacked_actions(model, allowed)
    num_worlds, dtype = model.letter.shape[0], model.dtype
    observation = stack_observations(model, observation)
    counts, other = training_counts(model, demonstrations, held_out, horizon=horizon)
    weight = jnp.ones(num_worlds, dtype) if weight is None else jnp.asarray(weight, dtype)
    require_shape("weight", weight, (num_worlds,))
    network = RewardNetwork() if network is None else as_network(network)
    inputs = _network_inputs(model, observation[0])
    require_output(
        "the network's reward has",
        network,
        inputs,
        (*observation.shape[1:2], *(x.shape[-1] for x in inputs[1:])),
        "one number for each state, memory and action. A module on one vector is wrapped as "
        "Concatenated(module).",
    )
    return Problem(
        model=model,
        observation=observation,
        counts=counts,
        held_out=other,
        weight=weight,
        predecessors=predecessor_table([lane(model, w) for w in range(num_worlds)]),
        network=network,
    )


def _network_inputs(
    model: Product, observation: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The network's inputs: observation, memory and action on their own axes."""
    num_memory, num_actions = model.num_memory, model.mdp.available.shape[-1]
    memory = jnp.eye(num_memory, dtype=observation.dtype)[None, :, None]
    action = jnp.eye(num_actions, dtype=observation.dtype)[None, None]
    return observation[:, None, None], memory, action


@struct.dataclass
class State(RunState):
    """Parameters; once `stopped`, only the step counter changes.

    Attributes:
      parameters: of the network, a pytree.
      value: ``float[W, S, Q]``, the soft value that the next solve starts from.
      optimizer: optax's state.
      best: the best held-out parameters, :class:`~jaxltl.algos.common.learner.Best`.
      stopped: ``bool[]``, whether patience is exhausted.
    """

    parameters: PyTree
    value: jax.Array
    optimizer: PyTree
    best: Best
    stopped: jax.Array


@struct.dataclass
class Metrics:
    """Figures of the parameters before a step; scalars, of a run ``[T]``.

    Attributes:
      loss: the negative log-likelihood and minus the logarithm of the prior.
      neg_log_likelihood: minus (3.3), in nats, over all pairs, weighted by world.
      per_pair: the same for the average pair.
      held_out: negative log-likelihood of the average held-out pair; NaN without any.
      satisfaction: mean satisfaction probability over worlds and initial states; NaN without mu.
      gradient_norm: Euclidean.
      error: certified error of the soft values, in units of the reward, largest over the worlds.
      status: of the soft solver, the worst over the worlds.
    """

    loss: jax.Array
    neg_log_likelihood: jax.Array
    per_pair: jax.Array
    held_out: jax.Array
    satisfaction: jax.Array
    gradient_norm: jax.Array
    error: jax.Array
    status: jax.Array


def solve(
    parameters: PyTree, problem: Problem, hparams: Hparams, guess: jax.Array | None = None
) -> Solution:
    """The soft values and policies of `parameters` in all worlds of a `problem`.

    ``float[W, S, Q]`` and ``float[W, S, Q, A]``, with a horizon ``[W, T, ...]``, by `hparams`, with
    the iteration starting from `guess`; differentiable in the parameters.
    """

    def world(model: Product, observation: jax.Array, guess: jax.Array) -> Solution:
        rewards = reward(problem.network, parameters, model, observation)
        return _soft_plan(rewards, model, hparams, guess)

    return trees.each_world(world, problem.model, problem.observation, _guess(problem, guess))


def _guess(problem: Problem, guess: jax.Array | None) -> jax.Array:
    if guess is not None:
        return guess
    return jnp.zeros((*problem.model.letter.shape, problem.model.num_memory), problem.model.dtype)


@struct.dataclass
class TodirlObjective:
    """Terms of the loss, and the soft values.

    Attributes:
      neg_log_likelihood, per_pair, held_out, satisfaction, error, status: of :class:`Metrics`.
      score: ``float[]``, criterion of early stopping, to be minimised.
      value: ``float[W, S, Q]``, from which the next solve may start.
    """

    neg_log_likelihood: jax.Array
    per_pair: jax.Array
    held_out: jax.Array
    score: jax.Array
    satisfaction: jax.Array
    value: jax.Array
    error: jax.Array
    status: jax.Array


def objective(
    parameters: PyTree, problem: Problem, hparams: Hparams, guess: jax.Array | None = None
) -> tuple[jax.Array, TodirlObjective]:
    """``-sum log pi(a | s, q) + l2 / 2 |theta|^2``: minus (3.2), over all pairs of all worlds.

    The loss ``float[]``, in nats, and :class:`TodirlObjective`, for `parameters`, `problem`, `hparams` and
    `guess` as in :func:`solve`; with ``hparams.mu`` minus mu times the satisfaction probability in
    each world, as in (2.6). Differentiable in the parameters by one transposed linear solve (implicit
    function theorem), instead of one system (3.6) for each parameter.

    Raises:
      ValueError: the problem does not count pairs by time up to ``hparams.horizon``, or `mu` is
        combined with a horizon.
    """
    if hparams.horizon is not None and hparams.mu is not None:
        raise ValueError("mu weighs the probability of a task at any time; leave horizon out.")
    if hparams.horizon is not None and hparams.horizon != problem.horizon:
        raise ValueError(
            f"hparams.horizon={hparams.horizon}, but the problem has horizon={problem.horizon}; "
            f"make_problem(..., horizon={hparams.horizon}) counts pairs by time."
        )
    counts, held_out = problem.counts, problem.held_out
    if hparams.horizon is None and problem.horizon is not None:
        counts, held_out = counts.sum(axis=1), held_out.sum(axis=1)

    rewards = trees.each_world(
        lambda model, seen: jnp.asarray(
            reward(problem.network, parameters, model, seen), model.dtype
        ),
        problem.model,
        problem.observation,
    )
    likelihoods = trees.each_world(
        partial(_likelihoods, hparams),
        problem.model,
        rewards,
        (counts, held_out),
        _guess(problem, guess),
        problem.predecessors,
    )
    demonstrated, other, satisfaction, value, error, status = likelihoods
    weight = problem.weight
    pairs, other_pairs = (weight @ x.reshape(len(weight), -1).sum(1) for x in (counts, held_out))
    neg = -weight @ demonstrated
    loss = neg + hparams.l2 / 2 * sum(jnp.sum(x * x) for x in jax.tree.leaves(parameters))
    score = lax.stop_gradient(-(weight @ other) / other_pairs)
    parts = TodirlObjective(
        neg_log_likelihood=neg,
        per_pair=neg / pairs,
        held_out=score,
        score=score,
        satisfaction=jnp.mean(satisfaction),
        value=value,
        error=jnp.max(error),
        status=jnp.max(status),
    )
    if hparams.mu is None:
        return loss, parts
    # Its derivative is part of the likelihood's, since one linear system serves both.
    gain = lax.stop_gradient(hparams.mu * (weight @ satisfaction))
    return loss - gain, replace(parts, score=score - gain / pairs)


def _likelihoods(
    hparams: Hparams,
    model: Product,
    rewards: jax.Array,
    counts: tuple[jax.Array, jax.Array],
    guess: jax.Array,
    predecessors: PredecessorTable | None,
) -> tuple[jax.Array, ...]:
    """Log-likelihoods of demonstrated and held-out pairs in a world, and the solver's results.

    That of the demonstrated ones is differentiable.
    """
    satisfaction, value = jnp.full((), jnp.nan, model.dtype), guess
    if hparams.horizon is not None:
        solution = _backward_induction(rewards, model, hparams)
        after = jnp.concatenate([solution.value[1:], jnp.zeros_like(solution.value[:1])])
        log_policy = jax.vmap(lambda v: _log_policy(model, rewards, hparams.discount, v))(after)
        demonstrated = jnp.sum(counts[0] * log_policy)
    else:
        constant = lax.stop_gradient(rewards)
        solution = lax.stop_gradient(_soft_plan(constant, model, hparams, guess))
        value = solution.value
        log_policy = _log_policy(model, constant, hparams.discount, value)
        policy = jnp.where(model.available, jnp.exp(log_policy), 0)
        cotangent = counts[0]
        if hparams.mu is not None:
            satisfaction, gain = jax.value_and_grad(
                lambda policy: jnp.sum(
                    model.initial * satisfaction_probability(model, policy).value
                )
            )(policy)
            cotangent = cotangent + hparams.mu * policy * gain
        slope = soft_policy_adjoint(
            model, policy, hparams.discount, cotangent, predecessors=predecessors
        )
        # The adjoint is the derivative of the likelihood; differentiating the solver's equations
        # gives the same by scatters, which are slow on CPUs.
        demonstrated = jnp.sum(counts[0] * log_policy)
        demonstrated += jnp.sum(lax.stop_gradient(slope) * (rewards - constant))
    error = jnp.max(solution.upper - solution.lower) / 2
    rest = (jnp.sum(counts[1] * log_policy), satisfaction, value, error, solution.status)
    return demonstrated, *lax.stop_gradient(rest)


def _log_policy(
    model: Product, rewards: jax.Array, discount: jax.Array | float, value: jax.Array
) -> jax.Array:
    """The logarithm of the soft policy; zero at unavailable actions, which have no counts."""
    logits = policy_logits(model, rewards, discount, value)
    return jnp.where(model.available, jax.nn.log_softmax(logits, axis=-1), 0)


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """A state at the network's own random start; the key is kept."""
    dtype = problem.model.dtype
    inputs = _network_inputs(problem.model, problem.observation[0])
    drawn = _draw(problem.network, learner.init_key(key), inputs)
    parameters = jax.tree.map(lambda x: jnp.asarray(x, dtype), drawn)
    return State(
        key=key,
        step=jnp.int32(0),
        parameters=parameters,
        value=_guess(problem, None),
        optimizer=optimizers.start(hparams, parameters),
        best=Best(parameters, jnp.asarray(jnp.inf, dtype), jnp.int32(0)),
        stopped=jnp.bool_(False),
    )


@partial(jax.jit, static_argnums=0)
def _draw(network: NetworkLike, key: Key, inputs: tuple[jax.Array, ...]) -> PyTree:
    return network.init(key, *inputs)


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """One full-batch step of the optimiser on :func:`objective`; deterministic given the state."""

    def loss_of(parameters: PyTree) -> tuple[jax.Array, TodirlObjective]:
        return objective(parameters, problem, hparams, state.value)

    loss, parts, norm, parameters, optimizer = optimizers.descend(loss_of, state, hparams)
    metrics = Metrics(
        loss=loss,
        neg_log_likelihood=parts.neg_log_likelihood,
        per_pair=parts.per_pair,
        held_out=parts.held_out,
        satisfaction=parts.satisfaction,
        gradient_norm=norm,
        error=parts.error,
        status=parts.status,
    )
    best, stopped = stop_early(
        state, parameters, parts.score, jnp.any(problem.held_out > 0), hparams.patience
    )
    # The value of a failed solve is no initial value.
    value = jnp.where(parts.status != Status.NONFINITE, parts.value, 0)
    after = replace(
        state, parameters=parameters, value=value, optimizer=optimizer, best=best, stopped=stopped
    )
    after = trees.choose(stopped, replace(state, best=best, stopped=stopped), after)
    return replace(after, step=state.step + 1), metrics


init, step, run, train, run_until, train_until = learner.bind(_init, _step)


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The soft policy of the best reward so far: ``float[W, S, Q, A]``, with a horizon ``[W, T, ...]``.

    :func:`plan` computes it in other worlds.
    """
    return solve(state.best.parameters, problem, hparams).policy


def reward(
    network: NetworkLike, parameters: PyTree, model: Product, observation: jax.Array
) -> jax.Array:
    """The reward ``float[S, Q, A]`` of a `network` with `parameters` in a `model`, a product.

    By the `observation` ``float[S, O]``; differentiable in it and in the parameters.

    >>> from jaxltl import from_dense, product
    >>> world = from_dense([[[0, 1.0]], [[0, 1.0]]], label=[[0], [1]], propositions=["g"])
    >>> class Late(nn.Module):  # a reward of 1 in the final automaton state
    ...     def __call__(self, observation, memory, action):
    ...         return 0 * observation[..., 0] + memory[..., 1] + 0 * action[..., 0]
    >>> reward(Late(), {}, product(world, "F g"), jnp.eye(2)).shape
    (2, 2, 1)
    """
    inputs = _network_inputs(model, observation)
    return jnp.asarray(as_network(network).apply(parameters, *inputs))


def plan(
    network: NetworkLike,
    parameters: PyTree,
    model: Product,
    observation: jax.Array,
    hparams: Hparams,
    *,
    allowed: jax.Array | None = None,
) -> Solution:
    """The soft value and policy (3.4), (3.5) of a learned reward in any world.

    Args:
      network, parameters: the reward.
      model: the product; its automaton has as many states as that of the training worlds.
      observation: ``float[S, O]``.
      hparams: discount, tolerance, method and horizon are read.
      allowed: ``bool[S, Q, A]``, action mask in this world; default all. Inside the optimal actions
        of its task the policy attains the optimal satisfaction probability.

    Returns:
      :class:`~jaxltl.core.types.Solution`, differentiable in the parameters; with a
      horizon, value and policy have a first axis of time. Batches of worlds by ``vmap``.

    Raises:
      ValueError: unknown method, or a mask that does not fit.
    """
    model = model if allowed is None else with_allowed(model, allowed)
    return _soft_plan(reward(network, parameters, model, observation), model, hparams)


def _soft_plan(
    rewards: jax.Array, model: Product, hparams: Hparams, guess: jax.Array | None = None
) -> Solution:
    """The soft value and policy of `rewards` in a `model`, by `hparams`, started at `guess`."""
    if hparams.horizon is not None:
        return _backward_induction(rewards, model, hparams)
    return soft_value(
        model,
        rewards,
        hparams.discount,
        guess=guess,
        method=hparams.method,
        tolerance=hparams.tolerance,
    )


def _backward_induction(rewards: jax.Array, model: Product, hparams: Hparams) -> Solution:
    """Soft values of a finite horizon, ``V_T = 0``, by backward induction; exact up to rounding."""
    rewards = jnp.asarray(rewards, model.dtype)
    discount = jnp.asarray(hparams.discount, model.dtype)

    def backup(value: jax.Array, _: None) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        logits = policy_logits(model, rewards, discount, value)
        value = jax.nn.logsumexp(logits, axis=-1)
        return value, (value, jax.nn.softmax(logits, axis=-1))

    horizon = int(hparams.horizon or 0)
    last = jnp.zeros(model.state_shape, model.dtype)
    _, (value, policy) = lax.scan(backup, last, None, length=horizon, reverse=True)
    exact = lax.stop_gradient(value)
    terms = model.num_successors + model.num_actions + 4
    size = jnp.max(jnp.abs(rewards)) + jnp.max(jnp.abs(exact))
    half = lax.stop_gradient(horizon * terms * jnp.finfo(model.dtype).eps * size)
    finite = jnp.all(jnp.isfinite(exact))
    return Solution(
        value=value,
        policy=policy,
        lower=exact - half,
        upper=exact + half,
        residual=jnp.zeros((), model.dtype),
        num_steps=jnp.int32(horizon),
        status=status_code(finite, finite),
    )
