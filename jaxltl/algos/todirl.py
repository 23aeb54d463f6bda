"""Task-oriented deep inverse RL (dissertation, chapter 3).

From demonstrations, learn a reward network that sees what is near, the memory of the
task's automaton and the action, such that the soft (maximum-entropy) policy of the product
makes the demonstrations likely (3.3). What was learned is local, so it plans in worlds that
were never seen: :func:`plan`.

Example: a reward of what is seen, here of which state it is, that plans in another world.

  >>> import jax, jax.numpy as jnp
  >>> import jaxltl as jl
  >>> from jaxltl.algos import todirl
  >>> from jaxltl.algos.common import learner
  >>> world = jl.make_mdp(  # a start, from where one gets to a goal or into a trap
  ...     [[[1, 2], [0, 1]], [[1, 0], [0, 0]], [[2, 0], [0, 0]]],
  ...     [[[0.8, 0.2], [0.5, 0.5]], [[1, 0], [0, 0]], [[1, 0], [0, 0]]],
  ...     available=[[True, True], [True, False], [True, False]], initial=[1, 0, 0],
  ...     label=[[0, 0], [1, 0], [0, 1]], propositions=["g", "r"])
  >>> shown = jl.make_trajectories(world, [[(0, 1), (0, 0), (1, 0)], [(0, 0), (1, 0)]])
  >>> model = jl.product(world, "!r U g", label_on="exit")
  >>> problem = todirl.make_problem(  # the second demonstration tells when to stop
  ...     model, jnp.eye(3), shown, network=todirl.RewardNetwork((3,)), held_out=0.5)
  >>> hparams = todirl.Hparams(discount=0.9, patience=3, optimizer="sgd")
  >>> state, metrics = todirl.train(jax.random.key(0), problem, hparams, num_steps=2)
  >>> metrics.held_out.shape
  (2,)
  >>> jax.eval_shape(todirl.policy, state, problem, hparams).shape  # [W, S, Q, A]
  (1, 3, 3, 2)
  >>> parameters = state.best.parameters
  >>> shape = jax.eval_shape(  # in any world that is seen the same way
  ...     lambda other: todirl.plan(problem.network, parameters, other, jnp.eye(3), hparams), model)
  >>> shape.policy.shape
  (3, 3, 2)

A run is made of steps, goes on from a state, and may end early:

  >>> state = todirl.init(jax.random.key(0), problem, hparams)  # train is init and run
  >>> state, metrics = todirl.run(state, problem, hparams, num_steps=2)  # step after step
  >>> until = learner.has_stopped  # for run_until and train_until
  >>> state.step.item()
  2
  >>> solution = jax.eval_shape(todirl.solve, state.parameters, problem, hparams)
  >>> solution.value.shape  # todirl.objective judges its policy
  (1, 3, 3)

Many seeds are ``jax.vmap(lambda key: train(key, problem, hparams, num_steps=...))(keys)``; so are
many settings, by ``vmap`` over the numbers of ``Hparams``. Stop
when patience has run out by ``train_until(..., until=learner.has_stopped)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn
from flax import struct
from jax import lax

from jaxltl.algos.common import learner
from jaxltl.algos.common.early_stopping import Best, stop_early
from jaxltl.core.models.construct.batch import (
    restrict_stacked_actions,
    stack_models,
    stack_observations,
    training_counts,
)
from jaxltl.core.models.construct.batch import unstack_product as lane
from jaxltl.core.models.construct.restrict import with_allowed
from jaxltl.core.models.ops.successor_tables import PredecessorTable, predecessor_table
from jaxltl.core.models.product import Product
from jaxltl.core.models.trajectories import Trajectories
from jaxltl.core.pretty_print import brief, history
from jaxltl.core.types import Solution, Status, status_code
from jaxltl.core.values.discounted.soft import policy_logits, soft_policy_adjoint, soft_value
from jaxltl.core.values.undiscounted.satisfaction import satisfaction_probability

# --- reward networks ---------------------------------------------------------------------------


class RewardNetwork(nn.Module):
    """A multilayer perceptron on (observation, memory, action), ReLU between its layers.

    The first layer is a dense layer on the three inputs side by side, computed as the sum
    of its three parts: each part sees its own input only once, not once per combination.

    Attributes:
      hidden: widths of the hidden layers; section 3.5 has two of 80. Empty: a linear reward.

    Called with ``float[..., O]``, ``float[..., Q]`` and ``float[..., A]``, which broadcast, it
    returns ``float[...]``.
    """

    hidden: Sequence[int] = (80, 80)

    @nn.compact
    def __call__(self, observation: jax.Array, memory: jax.Array, action: jax.Array) -> jax.Array:
        widths = (*self.hidden, 1)
        inputs = (observation, memory, action)
        sizes = [x.shape[-1] for x in inputs]
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (sum(sizes), widths[0]))
        bias = self.param("bias", nn.initializers.zeros_init(), (widths[0],))
        parts = jnp.split(kernel, np.cumsum(sizes)[:-1])
        terms = [x @ part for x, part in zip(inputs, parts, strict=True)]
        x = terms[0] + (terms[1] + terms[2] + bias)
        rows = x.shape[:-1]
        x = x.reshape(-1, widths[0])  # as a matrix the products are a little faster
        for width in widths[1:]:
            x = nn.Dense(width)(nn.relu(x))
        return x.reshape(rows)


class Concatenated(nn.Module):
    """A network that reads one vector, ``[..., O + Q + A] -> [...]`` or ``[..., 1]``, as a reward.

    Attributes:
      network: the flax module, of vectors ``float[N, O + Q + A]``, or of any leading axes.

    Example:
      >>> import jax
      >>> network = Concatenated(nn.Dense(1))
      >>> read = jnp.zeros((5, 3)), jnp.zeros((5, 2)), jnp.zeros((5, 4))
      >>> shape, _ = jax.eval_shape(network.init_with_output, jax.random.key(0), *read)
      >>> shape.shape
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


# --- the learner's data --------------------------------------------------------------------------


@brief
@struct.dataclass
class Problem:
    """What is given: worlds beside the task, what is seen in them, and demonstrations.

    Attributes:
      model: products stacked along a first axis of W worlds.
      observation: ``float[W, S, O]``, what is seen in each world state.
      counts: ``float[W, S, Q, A]``, how often each pair was demonstrated; with a horizon
        ``float[W, T, S, Q, A]``.
      held_out: counts of the demonstrations by which learning is stopped; may be zero.
      weight: ``float[W]``, factors of the worlds' likelihoods.
      predecessors: of the product states, with a first axis of W, or None; they make the
        gradient faster.
      network: called as ``network(observation [S, 1, 1, O], memory [1, Q, 1, Q],
        action [1, 1, A, A]) -> float[S, Q, A]``, memory and action one-hot; static.
    """

    model: Product
    observation: jax.Array
    counts: jax.Array
    held_out: jax.Array
    weight: jax.Array
    predecessors: PredecessorTable | None = None
    network: nn.Module = struct.field(pytree_node=False, default=RewardNetwork())

    @property
    def horizon(self) -> int | None:
        """Steps that the counts tell apart, or None."""
        return self.counts.shape[1] if self.counts.ndim == 5 else None


@brief
@struct.dataclass
class Hparams:
    """How to learn. Numbers are traced, so new values do not recompile.

    Attributes:
      discount: in [0, 1); with a horizon 1 is allowed.
      l2: precision of the Gaussian prior on the parameters; default 1e-3.
      learning_rate: for every optimiser but ``lbfgs``; default 3e-3.
      patience: steps without a better held-out likelihood after which learning stops; with `mu`,
        without a better sum of it and of the weighed probability of an average pair; default 50.
      mu: weight of the probability of the task (2.6) from the worlds' starts; None leaves it out;
        default None.
      tolerance: certified error asked of the soft values; None: what the dtype allows;
        default None.
      optimizer: ``"adam"``, ``"sgd"``, ``"rmsprop"`` or ``"lbfgs"``, all optax's; static;
        default ``"adam"``.
      method: of the soft solver, see :func:`~jaxltl.core.values.discounted.soft.soft_value`; static;
        default ``"value_iteration"``.
      horizon: None, or the number of steps of a run, for a policy of the time left; static;
        default None.
    """

    discount: jax.Array | float
    l2: jax.Array | float = 1e-3
    learning_rate: jax.Array | float = 3e-3
    patience: jax.Array | int = 50
    mu: jax.Array | float | None = None
    tolerance: jax.Array | float | None = None
    optimizer: str = struct.field(pytree_node=False, default="adam")
    method: str = struct.field(pytree_node=False, default="value_iteration")
    horizon: int | None = struct.field(pytree_node=False, default=None)


@brief
@struct.dataclass
class State:
    """Parameters on their way; once `stopped`, only the step counter goes on.

    Attributes:
      key, step: the root key and the number of steps made, ``int32[]``.
      parameters: of the network, a pytree.
      value: ``float[W, S, Q]``, the soft value that the next solve starts from.
      optimizer: optax's state.
      best: what was learned, :class:`~jaxltl.algos.common.early_stopping.Best`:
        ``state.best.parameters``.
      stopped: ``bool[]``, whether patience has run out.
    """

    key: jax.Array
    step: jax.Array
    parameters: Any
    value: jax.Array
    optimizer: Any
    best: Best
    stopped: jax.Array


@brief(facts=partial(history, codes={"status": Status}))
@struct.dataclass
class Metrics:
    """Figures of the parameters before a step; scalars, of a run ``[T]``.

    Attributes:
      loss: the negative log-likelihood and minus the logarithm of the prior.
      neg_log_likelihood: minus (3.3), in nats, over all pairs, weighted by world.
      per_pair: the same for the average pair.
      held_out: negative log-likelihood of the average held-out pair; NaN without any.
      satisfaction: mean probability of the task over the worlds and their starts; NaN without mu.
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


def make_problem(
    worlds: Product | Sequence[Product],
    observation: Any,
    demonstrations: Trajectories | Sequence[Trajectories],
    *,
    held_out: float | Trajectories | Sequence[Trajectories] | None = 0.2,
    network: nn.Module | None = None,
    weight: Any = None,
    horizon: int | None = None,
    allowed: Any = None,
) -> Problem:
    """A checked :class:`Problem`, on the host.

    Args:
      worlds: a product, several, or products stacked along a first axis of W worlds.
      observation: ``float[S, O]``, or one for each world.
      demonstrations: in the world (not in the product), or one for each world; empty
        trajectories are left out.
      held_out: the share of each world's trajectories, its last ones, by which learning is
        stopped early; or such trajectories; None or 0: no early stopping.
      network: the reward; default :class:`RewardNetwork`.
      weight: ``float[W]``, factors of the worlds' likelihoods; default 1.
      horizon: count pairs by time, for ``Hparams.horizon``.
      allowed: ``bool[S, Q, A]``, or one for each world: the actions that policies choose from, such
        as those that lose nothing of the task
        (:func:`~jaxltl.core.values.undiscounted.optimal_actions.optimal_actions`); default all. Demonstrated
        steps that take others are left out.

    Returns:
      :class:`Problem`, its arrays stacked over W worlds.

    Raises:
      ValueError: worlds of different shapes or propositions, observations, weights or
        rewards of the wrong shape, masks that do not fit, demonstrations that do not fit their
        world or exceed the horizon, or no pair left to learn from.
    """
    model = stack_models(worlds)
    if allowed is not None:
        model = restrict_stacked_actions(model, allowed)
    num_worlds, dtype = model.letter.shape[0], model.dtype
    observation = stack_observations(model, observation)
    counts, other = training_counts(model, demonstrations, held_out, horizon=horizon)
    weight = jnp.ones(num_worlds, dtype) if weight is None else jnp.asarray(weight, dtype)
    if weight.shape != (num_worlds,):
        raise ValueError(f"weight has shape {weight.shape}; expected {(num_worlds,)}.")
    network = RewardNetwork() if network is None else network
    _require_reward(network, model, observation)
    return Problem(
        model=model,
        observation=observation,
        counts=counts,
        held_out=other,
        weight=weight,
        predecessors=predecessor_table([lane(model, w) for w in range(num_worlds)]),
        network=network,
    )


def _require_reward(network: nn.Module, model: Product, observation: jax.Array) -> None:
    inputs = _inputs(model, observation[0])
    found = jax.eval_shape(lambda *x: network.init_with_output(jax.random.key(0), *x)[0], *inputs)
    expected = (*observation.shape[1:2], *(x.shape[-1] for x in inputs[1:]))
    if getattr(found, "shape", None) != expected:
        what = getattr(found, "shape", type(found).__name__)
        raise ValueError(
            f"the network's reward has shape {what}; expected {expected}, one number for each "
            "state, memory and action. A module on one vector is wrapped as Concatenated(module)."
        )


def _inputs(model: Product, observation: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The network's inputs: observation, memory and action on their own axes."""
    num_memory, num_actions = model.num_memory, model.mdp.available.shape[-1]
    memory = jnp.eye(num_memory, dtype=observation.dtype)[None, :, None]
    action = jnp.eye(num_actions, dtype=observation.dtype)[None, None]
    return observation[:, None, None], memory, action


# --- planning -------------------------------------------------------------------------------------


def reward(
    network: nn.Module, parameters: Any, model: Product, observation: jax.Array
) -> jax.Array:
    """The network's reward in a product.

    Args:
      network, parameters: what was learned.
      model: the product, of S states, Q memories and A actions.
      observation: ``float[S, O]``.

    Returns:
      ``float[S, Q, A]``; differentiable in the parameters and the observation.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0, 1.0]], [[0, 1.0]]], label=[[0], [1]], propositions=["g"])
      >>> model = product(world, "F g")
      >>> class Late(nn.Module):  # one for what is done with the task done
      ...     def __call__(self, observation, memory, action):
      ...         return 0 * observation[..., 0] + memory[..., 1] + 0 * action[..., 0]
      >>> jax.eval_shape(lambda seen: reward(Late(), {}, model, seen), jnp.eye(2)).shape
      (2, 2, 1)
    """
    found: Any = network.apply(parameters, *_inputs(model, observation))
    return found


def plan(
    network: nn.Module,
    parameters: Any,
    model: Product,
    observation: jax.Array,
    hparams: Hparams,
    *,
    initial: jax.Array | None = None,
    allowed: jax.Array | None = None,
) -> Solution:
    """Soft value and policy (3.4), (3.5) of a learned reward in any world.

    Args:
      network, parameters: what was learned.
      model: the product; its automaton has as many states as the one learned with.
      observation: ``float[S, O]``.
      hparams: discount, tolerance, method and horizon are read.
      initial: ``float[S, Q]``, a value to start from.
      allowed: ``bool[S, Q, A]``, the actions to choose from in this world; default all. Inside
        those that lose nothing of its task the plan does it as well as it can be done, and what
        was learned decides how.

    Returns:
      :class:`~jaxltl.core.types.Solution`, differentiable in the parameters; with a
      horizon, value and policy have a first axis of time. Batches of worlds by ``vmap``.

    Raises:
      ValueError: unknown method, or a mask that does not fit.
    """
    model = model if allowed is None else with_allowed(model, allowed)
    return _plan(reward(network, parameters, model, observation), model, hparams, initial)


def _plan(
    rewards: jax.Array, model: Product, hparams: Hparams, initial: jax.Array | None
) -> Solution:
    if hparams.horizon is not None:
        return _backward_induction(rewards, model, hparams)
    return soft_value(
        model,
        rewards,
        hparams.discount,
        initial=initial,
        method=hparams.method,
        tolerance=hparams.tolerance,
    )


def _backward_induction(rewards: jax.Array, model: Product, hparams: Hparams) -> Solution:
    """Soft values with 0, ..., T - 1 steps behind, ``V_T = 0``; exact but for rounding."""
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


def solve(
    parameters: Any, problem: Problem, hparams: Hparams, initial: jax.Array | None = None
) -> Solution:
    """Soft values and policies of a reward in the problem's worlds, with a first axis of W.

    Args:
      parameters: of the network.
      problem, hparams: what and how.
      initial: ``float[W, S, Q]``, values to start from.

    Returns:
      :class:`~jaxltl.core.types.Solution`, `value` ``float[W, S, Q]`` and `policy`
      ``float[W, S, Q, A]``, with a horizon ``[W, T, ...]``; differentiable in the parameters.
    """

    def world(model, observation, initial):
        return plan(problem.network, parameters, model, observation, hparams, initial=initial)

    return _each_world(world, problem.model, problem.observation, _initial(problem, initial))


def _each_world(function, *arguments):
    """``vmap`` over worlds; one world is not batched, which would keep seeds from being so."""
    if jax.tree.leaves(arguments)[0].shape[0] == 1:
        one = function(*(jax.tree.map(lambda x: x[0], y) for y in arguments))
        return jax.tree.map(lambda x: x[None], one)
    return jax.vmap(function)(*arguments)


def _initial(problem: Problem, initial: jax.Array | None) -> jax.Array:
    if initial is not None:
        return initial
    return jnp.zeros((*problem.model.letter.shape, problem.model.num_memory), problem.model.dtype)


# --- learning -------------------------------------------------------------------------------------


@brief(codes={"status": Status})
@struct.dataclass
class Objective:
    """What the loss was made of, and the soft values with their evidence.

    Attributes:
      neg_log_likelihood, per_pair, held_out, satisfaction, error, status: as of :class:`Metrics`.
      score: ``float[]``, by which learning is stopped early, the less the better.
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
    parameters: Any, problem: Problem, hparams: Hparams, initial: jax.Array | None = None
) -> tuple[jax.Array, Objective]:
    """``-sum log pi(a | s, q) + l2 / 2 |theta|^2``: minus (3.2), over all pairs of all worlds.

    With ``hparams.mu`` less mu times the probability of the task in each world, as in (2.6).
    Its gradient costs one linear solve with the transposed transition matrix of the policy
    (implicit function theorem), instead of one system (3.6) for each parameter.

    Args:
      parameters, problem, hparams, initial: as in :func:`solve`.

    Returns:
      The loss ``float[]``, in nats, and :class:`Objective`; differentiable in the parameters.

    Raises:
      ValueError: the problem does not count pairs by time up to ``hparams.horizon``, or there is
        a weight ``mu`` with a horizon.
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

    def world(model, observation, counts, held_out, initial, before):
        rewards = jnp.asarray(reward(problem.network, parameters, model, observation), model.dtype)
        find = _by_time if hparams.horizon is not None else partial(_stationary, before=before)
        return find(rewards, model, hparams, counts, held_out, initial)

    seen, other, done, value, error, status = _each_world(
        world,
        problem.model,
        problem.observation,
        counts,
        held_out,
        _initial(problem, initial),
        problem.predecessors,
    )
    weight = problem.weight
    pairs, other_pairs = (weight @ jnp.sum(x, axis=(1, 2, 3)) for x in _flat(counts, held_out))
    neg = -weight @ seen
    squares = sum(jnp.sum(x * x) for x in jax.tree.leaves(parameters))
    loss = neg + hparams.l2 / 2 * squares
    score = lax.stop_gradient(-(weight @ other) / other_pairs)
    found = Objective(
        neg_log_likelihood=neg,
        per_pair=neg / pairs,
        held_out=score,
        score=score,
        satisfaction=jnp.mean(done),
        value=value,
        error=jnp.max(error),
        status=jnp.max(status),
    )
    if hparams.mu is None:
        return loss, found
    # Its derivative is in that of the likelihood, since one linear system serves both.
    gain = lax.stop_gradient(hparams.mu * (weight @ done))
    return loss - gain, replace(found, score=score - gain / pairs)


def _stationary(rewards, model, hparams, counts, held_out, initial, *, before):
    """Log-likelihoods of the stationary soft policy, with the gradient of the first."""
    constant = lax.stop_gradient(rewards)
    solution = lax.stop_gradient(_plan(constant, model, hparams, initial))
    log_policy = _log_policy(model, constant, hparams.discount, solution.value)
    policy = jnp.where(model.available, jnp.exp(log_policy), 0)
    done, cotangent = jnp.full((), jnp.nan, model.dtype), counts
    if hparams.mu is not None:
        done, gain = jax.value_and_grad(partial(_satisfaction, model))(policy)
        cotangent = counts + hparams.mu * policy * gain
    slope = lax.stop_gradient(
        soft_policy_adjoint(model, policy, hparams.discount, cotangent, predecessors=before)
    )
    # The likelihood, and as its derivative the adjoint's, which differentiating the solver's
    # own equations would find by scatters, slow on a CPU.
    seen = jnp.sum(counts * log_policy) + jnp.sum(slope * (rewards - constant))
    error = jnp.max(solution.upper - solution.lower) / 2
    other = jnp.sum(held_out * log_policy)
    return seen, other, lax.stop_gradient(done), solution.value, error, solution.status


def _satisfaction(model, policy) -> jax.Array:
    """The mean probability of the task over the starts."""
    return jnp.sum(model.initial * satisfaction_probability(model, policy).value)


def _by_time(rewards, model, hparams, counts, held_out, initial):
    """Log-likelihoods of the policy of the time left, differentiable as they stand."""
    solution = _backward_induction(rewards, model, hparams)
    after = jnp.concatenate([solution.value[1:], jnp.zeros_like(solution.value[:1])])
    log_policy = jax.vmap(lambda v: _log_policy(model, rewards, hparams.discount, v))(after)
    seen, other = (jnp.sum(x * log_policy) for x in (counts, held_out))
    error = lax.stop_gradient(jnp.max(solution.upper - solution.lower) / 2)
    return seen, other, jnp.full((), jnp.nan, model.dtype), initial, error, solution.status


def _log_policy(model, rewards, discount, value) -> jax.Array:
    """Zero at unavailable actions, which have no counts."""
    logits = policy_logits(model, rewards, discount, value)
    return jnp.where(model.available, jax.nn.log_softmax(logits, axis=-1), 0)


def _flat(*counts: jax.Array) -> list[jax.Array]:
    return [x.reshape(x.shape[0], -1, *x.shape[-2:]) for x in counts]


def init(key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
    """A state at the network's own random start; the key is kept.

    Args:
      key: a PRNG key, which the state keeps; ``vmap`` over keys for many seeds.
      problem: of :func:`make_problem`.
      hparams: :class:`Hparams`.

    Returns:
      :class:`State`, no step made.
    """
    dtype = problem.model.dtype
    inputs = _inputs(problem.model, problem.observation[0])
    drawn = _draw(problem.network, learner.init_key(key), inputs)
    parameters = jax.tree.map(lambda x: jnp.asarray(x, dtype), drawn)
    return State(
        key=key,
        step=jnp.int32(0),
        parameters=parameters,
        value=_initial(problem, None),
        # optax starts from weakly typed zeros, which a second run would compile anew for.
        optimizer=jax.tree.map(
            lambda x: jnp.asarray(x, jnp.result_type(x)), _optimizer(hparams).init(parameters)
        ),
        best=Best(parameters, jnp.asarray(jnp.inf, dtype), jnp.int32(0)),
        stopped=jnp.bool_(False),
    )


@partial(jax.jit, static_argnums=0)
def _draw(network: nn.Module, key: chex.PRNGKey, inputs: tuple[jax.Array, ...]) -> Any:
    return network.init(key, *inputs)


def step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """One full-batch step of the optimiser on :func:`objective`; deterministic given the state.

    Args:
      state: of :func:`init` or of an earlier step; unchanged.
      problem, hparams: as of :func:`init`.

    Returns:
      The next :class:`State`, and :class:`Metrics`, figures of the parameters before it.
    """

    def loss_of(parameters: Any) -> jax.Array:
        return objective(parameters, problem, hparams, state.value)[0]

    (loss, parts), gradient = jax.value_and_grad(objective, has_aux=True)(
        state.parameters, problem, hparams, state.value
    )
    updates, optimizer = _optimizer(hparams).update(
        gradient, state.optimizer, state.parameters, value=loss, grad=gradient, value_fn=loss_of
    )
    metrics = Metrics(
        loss=loss,
        neg_log_likelihood=parts.neg_log_likelihood,
        per_pair=parts.per_pair,
        held_out=parts.held_out,
        satisfaction=parts.satisfaction,
        gradient_norm=optax.tree.norm(gradient),
        error=parts.error,
        status=parts.status,
    )
    parameters = optax.apply_updates(state.parameters, updates)
    best, stopped = stop_early(
        state, parameters, parts.score, jnp.any(problem.held_out > 0), hparams.patience
    )
    # A solve that failed would poison the next one's start.
    value = jnp.where(parts.status != Status.NONFINITE, parts.value, 0)
    after = replace(
        state, parameters=parameters, value=value, optimizer=optimizer, best=best, stopped=stopped
    )
    after = learner.choose(stopped, replace(state, best=best, stopped=stopped), after)
    return replace(after, step=state.step + 1), metrics


def _optimizer(hparams: Hparams) -> optax.GradientTransformationExtraArgs:
    return learner.optimizer(hparams.optimizer, hparams.learning_rate)


run, train, run_until, train_until = learner.bind(init, step)


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The soft policy of the best reward so far: ``float[W, S, Q, A]``.

    With a horizon ``[W, T, S, Q, A]``; :func:`plan` finds it in other worlds.

    Args:
      state: of one run; ``vmap`` over several.
      problem, hparams: of the run.

    Returns:
      ``float[W, S, Q, A]``, or with a horizon ``[W, T, S, Q, A]``.
    """
    return solve(state.best.parameters, problem, hparams).policy
