"""Maximum likelihood under a guarantee: the most likely policy with a required satisfaction probability.

With ``"best"`` the policy is learned inside the optimal actions. A required probability is attained by
the likelihood subject to it (:mod:`~jaxltl.algos.mlirl.constrained`) where a reward attains it, else by
the mixture of a learned policy with the least share of one of optimal actions.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos.common.chunks import ChunkOptions
from jaxltl.algos.common.guarantees import Guarantee, StepBound, is_weighable, neg_log_likelihood
from jaxltl.algos.common.seeds import ONE_SEED, Training, one_seed, run_seeds
from jaxltl.algos.mlirl import learner
from jaxltl.algos.mlirl.constrained import ConstrainedPoint, constrained_points
from jaxltl.algos.mlirl.features import Features
from jaxltl.algos.mlirl.learner import Hparams, Metrics, Problem, State
from jaxltl.core.array_types import PyTree
from jaxltl.core.models import Product, Trajectories, lift_policy
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.types import Solution, Status
from jaxltl.core.values import satisfaction_probability
from jaxltl.core.values.discounted.soft import softmax_policy
from jaxltl.core.values.undiscounted.mixture import (
    Mixture,
    at_starts,
    attained_if_near,
    certified,
    probable_mixture,
)
from jaxltl.core.values.undiscounted.policy_gradient import FullSupport

# Bounds of the search for a required probability, in steps so that it is deterministic: product
# states times steps that cost about as much as compilation (benchmarks/required_probability.py),
# and evaluations of likelihood and probability.
_STATE_STEPS, _EVALUATIONS = 100_000, 120
_STATIONARY = 1e-3  # relative gradient norm of the Lagrangian at which the search has converged
_GAP = 1e-6  # of probabilities that are compared
_COMPARED = 3  # policies that are compared after mixing for the expected steps


@dataclass(frozen=True)
class LearnedPolicies:
    """Weights and policies of N seeds.

    Attributes:
      policy: ``float[N, S, Q, A]``, policies of the product.
      weights: ``float[N, F]``.
      names: of the features.
      loss, neg_log_likelihood, gradient_norm: ``float[N]``.
      status: ``int32[N]``, of the policies' solver.
      num_steps: ``int[N]``, until convergence, or all.
      converged: ``bool[N]``, True if the gradient is below the tolerance and the solver converged.
      history: metrics ``[T, N]`` and step ``[T]``.
    """

    policy: np.ndarray
    weights: np.ndarray
    names: tuple[str, ...]
    loss: np.ndarray
    neg_log_likelihood: np.ndarray
    gradient_norm: np.ndarray
    status: np.ndarray
    num_steps: np.ndarray
    converged: np.ndarray
    history: Mapping[str, np.ndarray]

    @property
    def least_loss(self) -> int:
        """The seed of least loss, among those that converged if there are any."""
        loss = np.where(np.isfinite(self.loss), self.loss, np.inf)
        return int(np.argmin(np.where(self.converged, loss, loss + 1e12)))


class Attempt(NamedTuple):
    """A policy that was learned or mixed.

    Attributes:
      policy: ``float[S, Q, A]``.
      neg_log_likelihood: of the demonstrations.
      attained: certified probability, of the mean or the worst initial state.
      weight: mu, if it was learned with one.
      share: of optimal actions, if they were mixed in.
      learned: the underlying result of learning.
    """

    policy: np.ndarray
    neg_log_likelihood: float
    attained: float
    weight: float | None
    share: float
    learned: LearnedPolicies


@dataclass(frozen=True)
class Demands:
    """Demonstrations and required guarantees of a policy of a product.

    Attributes:
      model: the product of the world with the task.
      demonstrations: in the world.
      features: of the reward, with those of :func:`~jaxltl.algos.mlirl.task_features` in the product.
      guarantee: of :func:`~jaxltl.algos.common.guarantees.make_guarantee`.
      bound: of the expected steps, or None.
      in_world: True for a reward of world states, which does not see the task.
      guess: ``float[F]``, initial weights, or None for zeros.
      satisfaction_over: as for :func:`~jaxltl.algos.mlirl.make_problem`.
    """

    model: Product
    demonstrations: Trajectories
    features: Features
    guarantee: Guarantee
    bound: StepBound | None = None
    in_world: bool = False
    guess: Sequence[float] | None = None
    satisfaction_over: str = "initial"

    @functools.cached_property
    def problem(self) -> Problem:
        """The learning problem under the guarantee."""
        allowed = self.guarantee.allowed
        if not isinstance(self.guarantee.requested, str):
            allowed = np.asarray(self.model.available)  # an array, so that one program serves both
        return self.restricted(allowed)

    def restricted(self, allowed: np.ndarray | None) -> Problem:
        """The learning problem with the actions of a mask ``bool[S, Q, A]``, or all."""
        guess, names = self.guess, self.features.names
        if guess is not None and len(guess) != len(names):
            raise ValueError(
                f"guess has {len(guess)} numbers; there are {len(names)} features: "
                f"{', '.join(names)}."
            )
        used = self.guarantee.until_lost(self.demonstrations)
        return learner.make_problem(
            self.model.mdp if self.in_world else self.model,
            self.features.values,
            self.demonstrations if self.in_world else used,  # that learner has no formula
            guess=guess,
            satisfaction_over=self.satisfaction_over,
            allowed=None if allowed is None else to_jax(allowed),
        )

    @property
    def counts(self) -> np.ndarray:
        """``float[S, Q, A]``, demonstrated pairs; zero for a learner that does not see the task."""
        if self.in_world:
            return np.zeros((*self.model.state_shape, self.model.num_actions))
        return np.asarray(self.problem.counts)


@dataclass(frozen=True)
class GuaranteedPolicy:
    """The kept policy with its certified satisfaction probability, and those of all seeds.

    Attributes:
      learned: of all seeds; for a required probability of the kept one.
      chosen: index of the kept seed, that of least loss.
      solution: certified satisfaction probability of the kept policy.
      attempt: how a required probability was attained, or None.
      mixture: the kept policy with its expected steps within the bound, or None.
      before: ``float[S, Q, A]``, the policy before that mixture.
    """

    learned: LearnedPolicies
    chosen: int
    solution: Solution
    attempt: Attempt | None
    mixture: Mixture | None
    before: np.ndarray

    @property
    def policy(self) -> np.ndarray:
        """``float[S, Q, A]``, the kept policy."""
        kept: np.ndarray = self.learned.policy[self.chosen]
        return kept


def train_guaranteed(
    demands: Demands,
    hparams: Hparams,
    training: Training = ONE_SEED,
    *,
    num_steps: int = 500,
    tolerance: float = 1e-6,
) -> GuaranteedPolicy:
    """The most likely policy under a guarantee, with its certified satisfaction probability.

    Learns with N seeds and keeps the one of least loss. With a required probability p, the policy
    maximises (2.4) subject to ``P(satisfied) >= p``, or is the mixture of most likelihood.

    Args:
      demands: model, demonstrations, features and guarantee.
      hparams: of the learner; its ``mu`` is not used with a required probability.
      training: seeds, reports and checkpoint; default one seed.
      num_steps: largest number of steps.
      tolerance: gradient norm at which learning has converged.

    Returns:
      :class:`GuaranteedPolicy`; not differentiable.

    Raises:
      ValueError: a problem that does not fit the model.

    Example:
      >>> import jaxltl as jl
      >>> from jaxltl.algos import mlirl
      >>> from jaxltl.algos.common.guarantees import make_guarantee
      >>> world = jl.gridworld("s . g\\n. t .", slip=0.1, initial="s", absorbing=["t"])
      >>> model = jl.product(world, "!t U g")
      >>> shown = jl.make_trajectories(world, [[(0, 3), (1, 3)]])
      >>> demands = mlirl.Demands(
      ...     model, shown, mlirl.task_features(model, shown), make_guarantee(model, shown, "best"))
      >>> kept = mlirl.train_guaranteed(demands, mlirl.Hparams(discount=0.9), num_steps=20)
      >>> round(float(kept.solution.at_initial.lower), 3)
      1.0
    """
    model, guarantee, bound = demands.model, demands.guarantee, demands.bound
    settings = _Settings(demands, hparams, num_steps, tolerance)
    if isinstance(guarantee.requested, str):
        learned, attempt = settings.train(demands.problem, training), None
        chosen = learned.least_loss
    else:
        attempt = _at_least(settings, training)
        learned, chosen = _kept(attempt.learned, 0, attempt.policy, attempt.neg_log_likelihood), 0
    training.stage("checking")
    before, mixture = learned.policy[chosen], None
    if bound is not None:
        mixture = bound.keep(model, before)
        if mixture.share:
            loss = neg_log_likelihood(mixture.policy, demands.counts)
            learned = _kept(learned, chosen, mixture.policy, loss)
    policy = learned.policy[chosen]
    if attempt is None:
        solution = satisfaction_probability(model, policy)
    else:  # the search certifies with a tolerance, and before mixing
        solution = certified(model, policy, guarantee.over, float(guarantee.requested))
        attempt = attempt._replace(
            policy=policy,
            attained=at_starts(model, solution.lower, guarantee.over)[0],
            neg_log_likelihood=float(learned.neg_log_likelihood[chosen]),
        )
    return GuaranteedPolicy(learned, chosen, solution, attempt, mixture, before)


def _kept(
    learned: LearnedPolicies, chosen: int, policy: np.ndarray, loss: float
) -> LearnedPolicies:
    """With another policy of a seed."""
    policies, losses = learned.policy.copy(), learned.neg_log_likelihood.copy()
    policies[chosen], losses[chosen] = policy, loss
    return replace(learned, policy=policies, neg_log_likelihood=losses)


class _Settings(NamedTuple):
    """The arguments of a training."""

    demands: Demands
    hparams: Hparams
    num_steps: int
    tolerance: float

    def train(
        self, problem: Problem, training: Training, num_steps: int | None = None
    ) -> LearnedPolicies:
        """Reward weights and policies of N seeds."""
        hparams, demands = self.hparams, self.demands
        options = ChunkOptions(until=Partial(_ends, self.tolerance), keep="before")
        steps = num_steps or self.num_steps
        chunks, history = run_seeds(
            learner, problem, hparams, training, num_steps=steps, options=options
        )
        states = jax.device_get(replace(chunks.state, key=None))
        weights = states.parameters
        lanes = [jax.tree.map(lambda x, i=i: x[i], states) for i in range(len(weights))]
        each = [jax.device_get(policy_and_likelihood(one, problem, hparams)) for one in lanes]
        policy, nll, codes = (np.stack(column) for column in zip(*each, strict=True))
        if demands.in_world:
            policy = jax.jit(jax.vmap(lift_policy, (None, 0)))(demands.model, policy)
        gradient_norm = history["gradient_norm"][-1]
        return LearnedPolicies(
            policy=np.asarray(policy),
            weights=weights,
            names=demands.features.names,
            loss=history["loss"][-1],
            neg_log_likelihood=nll,
            gradient_norm=gradient_norm,
            status=codes,
            num_steps=np.asarray(states.step),
            # Values of softmax policies have no certificate without contraction.
            converged=(gradient_norm <= self.tolerance) & (codes <= Status.UNCERTIFIED),
            history=history,
        )


def _ends(tolerance: float, before: State, after: State, metrics: Metrics) -> jax.Array:
    """True if the gradient vanishes, or a step changes nothing, so that no later one does."""
    # Where the loss is steep, rounding hides its decrease before the gradient is that small.
    parts = ((state.parameters, state.optimizer) for state in (before, after))
    same = jax.tree.map(lambda x, y: jnp.all((x == y) | (x != x)), *parts)  # NaN equals NaN
    return (metrics.gradient_norm <= tolerance) | jnp.all(jnp.stack(jax.tree.leaves(same)))


# --- a required probability -----------------------------------------------------------------------


def _at_least(settings: _Settings, training: Training) -> Attempt:
    """The most likely policy with a required probability: learned under the constraint, or mixed."""
    demands, hparams, num_steps, _ = settings
    guarantee, model, again = demands.guarantee, demands.model, Training(training.seed)
    actions, inside, sure, steps = guarantee.actions, None, None, num_steps
    if actions is not None and guarantee.usable:
        inside = settings.train(demands.restricted(np.asarray(actions.allowed)), again)
        sure = inside.policy[0]
        # The time without the constraint, and with it, stays in proportion to this.
        least = int(inside.num_steps[0])
        steps = min(steps, max(2 * least, _STATE_STEPS // model.num_states))
    learned = settings.train(demands.problem, training, steps)
    free: LearnedPolicies = one_seed(learned, learned.least_loss)
    training.stage("searching")
    if sure is None:
        sure = np.asarray(actions.policy if actions else free.policy[0])
    constrained = functools.partial(_constrained, demands, free, hparams, training)
    return most_likely(demands, free, sure, inside or free, constrained)


def most_likely(
    demands: Demands,
    free: LearnedPolicies,
    sure: np.ndarray,
    inside: LearnedPolicies,
    constrained: Callable[[], list[tuple[LearnedPolicies, float]]],
) -> Attempt:
    """The most likely of learned policies and mixtures that have the required probability.

    Where no reward attains the probability, a policy is mixed with the likeliest or with the quickest
    one of optimal actions.

    Args:
      demands: with the required probability.
      free: learned without the constraint.
      sure: ``float[S, Q, A]``, a policy of optimal actions.
      inside: the result of learning that it belongs to.
      constrained: likely results at and below the probability with their weights mu (2.6); called if
        rewards matter and `free` does not have the probability.
    """
    model, counts, over = demands.model, demands.counts, demands.guarantee.over
    required = float(demands.guarantee.requested)

    def learned(result: LearnedPolicies, weight: float) -> Attempt:
        policy = result.policy[0]
        reached = attained_if_near(model, policy, over, required)
        loss = neg_log_likelihood(policy, counts)
        return Attempt(policy, loss, reached, weight, 0.0, result)

    def mixed(below: Attempt, sure: np.ndarray) -> Attempt:
        """The mixture with the least share of a policy of optimal actions."""
        policy, share, reached, _ = probable_mixture(model, below.policy, sure, required, over)
        return Attempt(policy, neg_log_likelihood(policy, counts), reached, None, share, inside)

    def quick_loss(attempt: Attempt) -> float:
        """The loss after mixing for the expected steps."""
        bound = demands.bound
        policy = attempt.policy if bound is None else bound.keep(model, attempt.policy).policy
        return neg_log_likelihood(policy, counts)

    first = learned(free, 0.0)
    if first.attained >= required:
        return first
    more = constrained() if is_weighable(model) else []
    tried = [first, *(learned(*each) for each in more)]
    candidates = [one for one in tried if one.attained >= required]
    quickest = np.asarray(demands.guarantee.best.policy)[..., None] == np.arange(sure.shape[-1])
    # A learned policy that delays satisfaction leaves no share for other actions.
    for policy in (sure, quickest.astype(float)):
        candidates += [mixed(one, policy) for one in tried if one.attained < required]
    likeliest = sorted(candidates, key=lambda one: one.neg_log_likelihood)[:_COMPARED]
    return min(likeliest, key=quick_loss)


def _constrained(
    demands: Demands, free: LearnedPolicies, hparams: Hparams, training: Training
) -> list[tuple[LearnedPolicies, float]]:
    """The most likely results at and below the required probability, and their weights mu."""
    guarantee, problem, model = demands.guarantee, demands.problem, demands.model
    required, soft = float(guarantee.requested), FullSupport(model, guarantee.over)
    value = jnp.zeros(model.state_shape, model.dtype)

    def evaluate(parameters: np.ndarray) -> ConstrainedPoint:
        nonlocal value
        (loss, policy), pull, new = likelihood_and_policy(
            jnp.asarray(parameters, value.dtype), problem, hparams, value
        )
        # Without a certificate: only the policies that are found get one.
        probability, slope = soft.probability(np.asarray(policy))
        each = np.asarray(_derivatives(pull, jnp.asarray(slope, value.dtype)))
        point = ConstrainedPoint(parameters, float(loss), probability, each[0], each[1], new)
        value = new if point.is_finite else value
        return point

    # The likelihood has several maxima: from the free weights, and from the initial ones.
    start = learner.init(training.key(1), problem, hparams).parameters
    max_evaluations = max(_STATE_STEPS // model.num_states, int(free.num_steps[0]) // 2)
    points = constrained_points(
        evaluate,
        [free.weights[0], np.asarray(start)],
        required,
        min(max_evaluations, _EVALUATIONS),
    )
    enough = [point for point in points if point.probability > required]
    # Mixed with optimal actions, each step that is not optimal keeps a share of its probability.
    allowed = np.asarray(guarantee.actions.allowed) if guarantee.actions else False
    lost = float(np.asarray(problem.counts)[~allowed].sum())
    top = max(required, max((point.probability for point in points), default=0))

    def mixed_loss(point: ConstrainedPoint) -> float:
        share = max(top + _GAP - point.probability, _GAP)
        return point.loss if enough else point.loss + lost * np.log(share)

    if not points:
        return []
    point = min(enough or points, key=mixed_loss)
    parameters = jnp.asarray(point.parameters, point.value.dtype)
    policy = np.asarray(_softmax_policy(parameters, point.value, problem, hparams))
    ends = point.stationarity <= _STATIONARY * (1 + np.linalg.norm(point.gradient))
    learned = dataclasses.replace(
        free,
        policy=policy[None],
        weights=point.parameters[None],
        loss=np.array([point.loss]),
        gradient_norm=np.array([point.stationarity]),
        converged=np.array([ends]),
    )
    return [(learned, point.multiplier)]


@jax.jit
def likelihood_and_policy(
    parameters: jax.Array, problem: Problem, hparams: Hparams, initial: jax.Array
) -> tuple[tuple[jax.Array, jax.Array], Callable, jax.Array]:
    """Loss and policy, the transpose of their derivative, and the value."""

    def terms(parameters: jax.Array) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        loss, parts = learner.objective(parameters, problem, hparams, initial)
        reward = problem.reward(parameters, problem.features)
        policy = softmax_policy(problem.model, reward, hparams.discount, parts.value)
        return (loss, policy), parts.value

    return jax.vjp(terms, parameters, has_aux=True)


@jax.jit
def _derivatives(pull: Callable, slope: jax.Array) -> jax.Array:
    """Derivatives ``[2, F]`` of the loss, and of a function of the policy from its derivative."""
    each = jnp.eye(2, dtype=slope.dtype)[:, 0], jnp.stack([jnp.zeros_like(slope), slope])
    # One after the other, so that the linear systems are compiled once.
    return lax.map(lambda x: pull(x)[0], each)


def policy_and_likelihood(
    state: State, problem: Problem, hparams: Hparams
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Policy, negative log-likelihood and solver's status of one seed."""
    if hparams.optimizer == "lbfgs" and state.optimizer.known:
        # The line search has solved for these weights.
        parts = state.optimizer.point.parts
        policy = _softmax_policy(state.parameters, parts.value, problem, hparams)
        return policy, parts.neg_log_likelihood, parts.status
    return _solved(state.parameters, problem, hparams)


@jax.jit
def _softmax_policy(
    parameters: PyTree, value: jax.Array, problem: Problem, hparams: Hparams
) -> jax.Array:
    reward = problem.reward(parameters, problem.features)
    return softmax_policy(problem.model, reward, hparams.discount, value)


@jax.jit
def _solved(
    parameters: PyTree, problem: Problem, hparams: Hparams
) -> tuple[jax.Array, jax.Array, jax.Array]:
    solution = learner.solve(parameters, problem, hparams)
    log_policy = jnp.log(jnp.where(problem.counts > 0, solution.policy, 1))
    return solution.policy, -jnp.sum(problem.counts * log_policy), solution.status
