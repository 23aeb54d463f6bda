"""Maximum-likelihood inverse RL with temporal-logic side information (Wen 2019, chapter 2).

Given demonstrations, find a reward with a softmax policy that maximises their likelihood (2.4), in the
world or in its product with a task, plus ``mu`` times the probability that the policy satisfies the
task (2.6). The model with side information is a product, ``jl.product(world, "!r U g")``; its
features have shape ``[S, Q, A, F]``, such as those of :func:`task_features`.

Example: two demonstrations that reach the goal, and two features.
  >>> import jax, numpy as np
  >>> import jaxltl as jl
  >>> from jaxltl.algos import mlirl
  >>> world = jl.make_mdp(  # an initial state, a goal and a trap
  ...     [[[1, 2], [0, 1]], [[1, 0], [0, 0]], [[2, 0], [0, 0]]],
  ...     [[[0.8, 0.2], [0.5, 0.5]], [[1, 0], [0, 0]], [[1, 0], [0, 0]]],
  ...     available=[[True, True], [True, False], [True, False]], initial=[1, 0, 0],
  ...     label=[[0, 0], [1, 0], [0, 1]], propositions=["g", "r"])
  >>> shown = jl.make_trajectories(world, [[(0, 1), (0, 0), (1, 0)], [(0, 0), (1, 0)]])
  >>> features = np.stack([np.eye(3, 2), np.ones((3, 2))], axis=-1)  # [S, A, F]
  >>> problem = mlirl.make_problem(world, features, shown)
  >>> hparams = mlirl.Hparams(discount=0.5, optimizer="adam")
  >>> state, metrics = mlirl.train(jax.random.key(0), problem, hparams, num_steps=2)
  >>> metrics.loss.shape, bool(metrics.loss[1] < metrics.loss[0])
  ((2,), True)
  >>> mlirl.policy(state, problem, hparams).shape  # [S, A]
  (3, 2)
  >>> jax.eval_shape(mlirl.solve, state.parameters, problem, hparams).value.shape
  (3,)
  >>> loss, parts = mlirl.objective(state.parameters, problem, hparams)
  >>> parts.neg_log_likelihood.shape
  ()
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree

from jaxltl.algos.common import learner, optimizers
from jaxltl.algos.common.settings import Number, RunState, finite_features, static, traced
from jaxltl.algos.mlirl.features import (
    Features as Features,
    pair_counts,
    progress_states as progress_states,
    task_features as task_features,
    world_features as world_features,
)
from jaxltl.core import struct
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.models import MDP, DenseMDP, Product, Trajectories, with_allowed
from jaxltl.core.models.construct.lifting import allowed_steps, lift_trajectories
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.types import Solution, Status, require_shape, worst
from jaxltl.core.validation import Range
from jaxltl.core.values import boltzmann_value, satisfaction_probability
from jaxltl.core.values.discounted.soft import policy_logits, soft_value
from jaxltl.core.values.engine.iterate import sequential_vmap

__all__ = [
    "Features",
    "Hparams",
    "Metrics",
    "MlirlObjective",
    "Problem",
    "Reward",
    "State",
    "init",
    "linear_reward",
    "make_problem",
    "objective",
    "policy",
    "progress_states",
    "run",
    "run_until",
    "solve",
    "step",
    "task_features",
    "train",
    "train_until",
    "world_features",
]

Reward = Callable[[PyTree, jax.Array], jax.Array]


def linear_reward(weights: jax.Array, features: jax.Array) -> jax.Array:
    """``R(s, a) = sum_f theta_f F_f(s, a)`` (section 2.2) for `weights` theta and `features` F.

    >>> linear_reward(jnp.array([1.0, 2.0]), jnp.array([[[3.0, 4.0]]])).tolist()
    [[11.0]]
    """
    return features @ weights


@struct.dataclass
class Problem:
    """A model, features, demonstrations, and a class of rewards.

    Attributes:
      model: the world, or its product with the task.
      features: ``float[S, A, F]`` (``[S, Q, A, F]``).
      counts: ``float[S, A]`` (``[S, Q, A]``), demonstrated state-action counts.
      guess: center of the initial parameters, any pytree; ``float[F]`` if linear.
      satisfaction_weight: ``float[S]``, weights of the states in g of (2.6).
      reward: ``(parameters, features) -> float[S, A]``; static.
    """

    model: MDP | DenseMDP | Product
    features: jax.Array
    counts: jax.Array
    guess: PyTree
    satisfaction_weight: jax.Array
    reward: Reward = struct.field(pytree_node=False, default=linear_reward)


@struct.dataclass
class Hparams:
    """Settings; numbers are traced.

    Attributes:
      discount: in [0, 1).
      mu: weight of the satisfaction term (2.6), or None (cases 1 and 2); default None.
      l2: at least 0; precision of the Gaussian prior on the parameters; default 1e-3.
      learning_rate: of ``adam``, ``rmsprop`` and ``sgd``; default 0.1.
      guess_scale: standard deviation of the noise added to ``Problem.guess``; default 1.0.
      policy: ``"boltzmann"`` (2.3) or ``"soft"`` (maximum entropy); static; default ``"boltzmann"``.
      adjoint: ``"exact"``, or ``"approximate"`` as in (2.7); static; default ``"exact"``.
      optimizer: ``"lbfgs"``, or the name of one of optax, such as ``"adamw"``; static; default
        ``"lbfgs"``.
    """

    discount: Number = traced("discount")
    mu: Number | None = traced("mu", default=None)
    l2: Number = traced(Range(0, open_above=True), default=1e-3)
    learning_rate: Number = traced(Range(0, open_above=True), default=0.1)
    guess_scale: Number = traced(Range(0, open_above=True), default=1.0)
    policy: str = static(("boltzmann", "soft"), default="boltzmann")
    adjoint: str = static(("exact", "approximate"), default="exact")
    optimizer: str = static(("lbfgs", *optimizers.NAMES), default="lbfgs")


@struct.dataclass
class State(RunState):
    """Parameters, and the initial value of the next solve.

    Attributes:
      parameters: of the reward, as ``Problem.guess``; ``float[F]`` if linear.
      value: ``float[S]`` (``[S, Q]``), the value at the last evaluated parameters.
      optimizer: optax's state, or that of the line search.
    """

    parameters: PyTree
    value: jax.Array
    optimizer: PyTree


@struct.dataclass
class Metrics:
    """Figures of the parameters before a step; scalars, of a run ``[T]``.

    Attributes:
      loss: the objective, with prior and satisfaction term.
      neg_log_likelihood: (2.4), in nats, over all demonstrated pairs.
      satisfaction: weighted mean of the satisfaction probability; NaN without the term.
      gradient_norm: Euclidean.
      status: of the solvers of value and satisfaction; see :class:`~jaxltl.core.types.Status`.
    """

    loss: jax.Array
    neg_log_likelihood: jax.Array
    satisfaction: jax.Array
    gradient_norm: jax.Array
    status: jax.Array


@struct.dataclass
class MlirlObjective:
    """Terms of the loss.

    Attributes:
      neg_log_likelihood: ``float[]``, (2.4), in nats, over all demonstrated pairs.
      satisfaction: ``float[]``, g of (2.6); NaN without the term.
      value: ``float[S]`` (``[S, Q]``), from which the next solve may start.
      status: ``int32[]``, of the solvers.
    """

    neg_log_likelihood: jax.Array
    satisfaction: jax.Array
    value: jax.Array
    status: jax.Array


def make_problem(
    model: MDP | DenseMDP | Product,
    features: jax.Array,
    demonstrations: Trajectories,
    *,
    guess: PyTree | None = None,
    reward: Reward = linear_reward,
    satisfaction_over: str | jax.Array = "initial",
    allowed: jax.Array | None = None,
) -> Problem:
    """A checked :class:`Problem`.

    Args:
      model: the world (case 1) or a product (cases 2 and 3).
      features: ``float[S, A, F]`` or ``float[S, Q, A, F]``.
      demonstrations: in the world; lifted here if the model is a product.
      guess: center of the initial parameters; default zero weights, one per feature.
      reward: any differentiable reward of parameters and features, default :func:`linear_reward`.
      satisfaction_over: the states of g in (2.6): ``"initial"`` (the dissertation's prose),
        ``"all"`` (its formula), or weights ``float[S]``.
      allowed: ``bool[S, A]`` (``[S, Q, A]``), action mask of the policies; default all. Demonstrated
        steps outside of it (:func:`~jaxltl.core.models.construct.lifting.allowed_steps`) do not count.

    Raises:
      ValueError: features, weights, mask or reward of a wrong shape, features that are not finite,
        an unknown `satisfaction_over`, demonstrations that do not fit the world, or no allowed step.
    """
    model = model if allowed is None else with_allowed(model, allowed)
    actions = (*model.state_shape, model.num_actions)
    features = finite_features("features", features, actions, model.dtype)
    counted = allowed_steps(model, demonstrations)
    if isinstance(model, Product):
        demonstrations = lift_trajectories(model, demonstrations)
    weight: PyTree = satisfaction_over
    if isinstance(weight, str):
        if weight not in ("initial", "all"):
            raise ValueError(f'satisfaction_over={weight!r}; choose "initial", "all" or weights.')
        starts = np.asarray(model.initial) > 0
        weight = np.ones(model.state_shape) if weight == "all" else starts
        weight = to_jax(weight.astype(model.dtype))
    weight = jnp.asarray(weight, model.dtype)
    require_shape("satisfaction_over", weight, model.state_shape)
    guess = np.zeros(features.shape[-1]) if guess is None else guess
    guess = jax.tree.map(lambda x: jnp.asarray(x, model.dtype), guess)
    require_shape("the reward", jax.eval_shape(reward, guess, features), actions)
    return Problem(
        model=model,
        features=features,
        counts=pair_counts(model, demonstrations, counted),
        guess=guess,
        satisfaction_weight=weight,
        reward=reward,
    )


def solve(
    parameters: PyTree, problem: Problem, hparams: Hparams, guess: jax.Array | None = None
) -> Solution:
    """The softmax value and policy (2.3) at `parameters` of the reward of a `problem`.

    By ``policy`` and ``adjoint`` of `hparams`; the Boltzmann iteration starts from `guess`,
    ``float[S]`` (``[S, Q]``). Differentiable in the parameters.
    """
    return _solve(problem.reward(parameters, problem.features), problem, hparams, guess)


def _solve(
    reward: jax.Array, problem: Problem, hparams: Hparams, guess: jax.Array | None
) -> Solution:
    if hparams.policy == "soft":
        if hparams.adjoint != "exact":
            raise ValueError('adjoint="approximate" (2.7) belongs to the Boltzmann policy.')
        return soft_value(problem.model, reward, hparams.discount)
    return boltzmann_value(
        problem.model, reward, hparams.discount, guess=guess, adjoint=hparams.adjoint
    )


def objective(
    parameters: PyTree, problem: Problem, hparams: Hparams, guess: jax.Array | None = None
) -> tuple[jax.Array, MlirlObjective]:
    """``J = -sum log pi(s, a) - mu g(y) + l2 / 2 |theta|^2``: (2.4), (2.6) and the prior.

    The loss ``float[]`` and :class:`MlirlObjective`, for `parameters`, `problem`, `hparams` and `guess` as in
    :func:`solve`. Differentiable in the parameters: exactly, or as in (2.7) with the policy held
    constant in the Bellman equation.

    Raises:
      ValueError: unknown kind of policy or adjoint, or a satisfaction term without a task.
    """
    # Evaluated once, so that the backward pass runs through it once.
    reward = problem.reward(parameters, problem.features)
    solution = _solve(reward, problem, hparams, guess)
    logits = policy_logits(problem.model, reward, hparams.discount, solution.value)
    log_policy = jax.nn.log_softmax(logits, axis=-1)
    log_likelihood = jnp.sum(problem.counts * jnp.where(problem.counts > 0, log_policy, 0))
    flat, _ = ravel_pytree(parameters)
    loss = -log_likelihood + hparams.l2 / 2 * jnp.sum(flat * flat)
    satisfaction, status = jnp.full((), jnp.nan, loss.dtype), solution.status
    if hparams.mu is not None:
        if not isinstance(problem.model, Product):
            raise ValueError("mu weighs the satisfaction of a task: make the problem in a product.")
        attained = satisfaction_probability(problem.model, jax.nn.softmax(logits, axis=-1))
        total = jnp.sum(problem.satisfaction_weight * attained.value)
        loss -= hparams.mu * total
        satisfaction = total / jnp.sum(problem.satisfaction_weight)
        # A policy that hardly ever leaves some states may have no certificate; for learning it is
        # enough that its equation is solved.
        solved = attained.residual <= jnp.sqrt(jnp.finfo(loss.dtype).eps)
        status = worst(status, jnp.where(solved, Status.CONVERGED, attained.status))
    parts = MlirlObjective(
        neg_log_likelihood=-log_likelihood,
        satisfaction=satisfaction,
        value=solution.value,
        status=status,
    )
    return loss, parts


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """Parameters at ``problem.guess`` plus noise of ``hparams.guess_scale``; the key is kept."""
    flat, unravel = ravel_pytree(problem.guess)
    noise = jax.random.normal(learner.init_key(key), flat.shape, flat.dtype)
    parameters = unravel(flat + hparams.guess_scale * noise)
    value = jnp.zeros(problem.model.state_shape, problem.model.dtype)
    if hparams.optimizer == "lbfgs":
        # A placeholder, of which only the shapes are read.
        zero = jnp.zeros((), value.dtype)
        parts = MlirlObjective(
            neg_log_likelihood=zero, satisfaction=zero, value=value, status=jnp.int32(0)
        )
        optimizer = optimizers.start_search(
            parameters, optimizers.Point(parameters, zero + jnp.inf, parameters, parts)
        )
    else:
        optimizer = optimizers.start(hparams, parameters)
    return State(key, jnp.int32(0), parameters, value, optimizer)


@jax.jit  # traced once for all its uses
def _evaluate(
    parameters: PyTree, problem: Problem, hparams: Hparams, guess: jax.Array
) -> optimizers.Point:
    (loss, parts), gradient = jax.value_and_grad(objective, has_aux=True)(
        parameters, problem, hparams, guess
    )
    return optimizers.Point(parameters, loss, gradient, parts)


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """One step of the optimiser on :func:`objective`; deterministic given the state."""
    return sequential_vmap(_update, state, problem, hparams)


@jax.jit
def _update(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    if hparams.optimizer == "lbfgs":

        def evaluate(parameters: PyTree, before: optimizers.Point) -> optimizers.Point:
            return _evaluate(parameters, problem, hparams, _usable(before.parts))

        optimizer, before = optimizers.search_step(evaluate, state.optimizer)
        loss, parts, norm = before.loss, before.parts, optax.tree.norm(before.gradient)
        parameters, value = optimizer.point.parameters, _usable(optimizer.point.parts)
    else:
        loss_of = partial(objective, problem=problem, hparams=hparams, guess=state.value)
        loss, parts, norm, parameters, optimizer = optimizers.descend(loss_of, state, hparams)
        value = _usable(parts)
    metrics = Metrics(
        loss=loss,
        neg_log_likelihood=parts.neg_log_likelihood,
        satisfaction=parts.satisfaction,
        gradient_norm=norm,
        status=parts.status,
    )
    return State(state.key, state.step + 1, parameters, value, optimizer), metrics


def _usable(parts: MlirlObjective) -> jax.Array:
    """The value, or zero if its solve failed, as the initial value of the next solve."""
    return jnp.where(parts.status < Status.NONFINITE, parts.value, 0)


# Metrics, and so their gradient, describe the state before a step.
init, step, run, train, run_until, train_until = learner.bind(_init, _step, keep="before")


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The softmax policy of the reward: ``float[S, A]``, in a product ``[S, Q, A]``.

    Zero at unavailable actions; :func:`solve` gives certified bounds of its value.
    """
    return solve(state.parameters, problem, hparams, state.value).policy
