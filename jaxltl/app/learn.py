"""Inverse reinforcement learning from a task file: the job of ``method = "mlirl"``."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos import mlirl
from jaxltl.algos.common.chunks import ChunkOptions
from jaxltl.algos.mlirl.constrained import ConstrainedPoint, constrained_points
from jaxltl.app.files.demonstrations import load_demonstrations, synthetic_demonstrations
from jaxltl.app.files.task_mlirl import MlirlFile
from jaxltl.app.files.worlds import MappedModel, load_world
from jaxltl.app.guarantee import (
    Attempt,
    Guarantee,
    ask,
    GuaranteeSearch,
    check_formula,
    guarantee_entry,
    require_possible,
    StepBound,
    about_steps,
    neg_log_likelihood,
    step_bound,
)
from jaxltl.app.job import about, one_seed, plain, postfix as postfix, run_seeds, settings
from jaxltl.app.protocols import Training
from jaxltl.app.reports.certificate import Certifiable, policy_certificate
from jaxltl.app.reports.learn import (
    live as live,
    pictures as pictures,
    report as report,
    task_pictures as task_pictures,
)
from jaxltl.app.wording import Record, counted, enclosure
from jaxltl.core.models import Product, Trajectories, lift_policy, product, project_policy
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.policies.policy_file import save_policy
from jaxltl.core.types import Solution, Status
from jaxltl.core.validation import errors_in
from jaxltl.core.values import optimal_actions, optimal_satisfaction, satisfaction_probability
from jaxltl.core.values.discounted.soft import softmax_policy
from jaxltl.core.values.undiscounted.mixture import at_starts, certified, from_starts
from jaxltl.core.values.undiscounted.policy_gradient import FullSupport


DOUBLE, FILE = True, MlirlFile

# Bounds of the search for a required probability, in steps so that it is deterministic: product
# states times steps that cost about as much as compilation (benchmarks/required_probability.py),
# and evaluations of likelihood and probability.
_STATE_STEPS, _EVALUATIONS = 100_000, 120
_STATIONARY = 1e-3  # relative gradient norm of the Lagrangian at which the search has converged
_GAP = 1e-6  # of probabilities that are compared


# --- the learners ---------------------------------------------------------------------------


@dataclass(frozen=True)
class LearnedPolicies:
    """Weights and policies of N seeds."""

    policy: np.ndarray  # float[N, S, Q, A], policies of the product
    weights: np.ndarray  # float[N, F], and the features' names
    names: tuple[str, ...]
    loss: np.ndarray  # loss, neg_log_likelihood, gradient_norm: float[N]
    neg_log_likelihood: np.ndarray
    gradient_norm: np.ndarray
    status: np.ndarray  # int32[N], of the policies' solver
    num_steps: np.ndarray  # int[N], until convergence, or all
    converged: np.ndarray  # bool[N]: the gradient is below the tolerance and the solver converged
    history: Mapping[str, np.ndarray]  # metrics [T, N] and step [T]


def _problem(setup: MlirlSetup, allowed: np.ndarray | None) -> mlirl.Problem:
    """The learning problem of inverse RL, with some of the actions or all."""
    table, model, features = setup.task.learner, setup.model, setup.features
    guess = table.guess
    if guess is not None and len(guess) != len(features.names):
        raise ValueError(
            f"guess has {len(guess)} numbers; there are {len(features.names)} "
            f"features: {', '.join(features.names)}."
        )
    return mlirl.make_problem(
        model.mdp if table.in_world else model,
        features.values,
        setup.used,
        guess=guess,
        satisfaction_over=table.satisfaction_over,
        allowed=None if allowed is None else to_jax(allowed),
    )


def _train(
    setup: MlirlSetup,
    problem: mlirl.Problem,
    hparams: mlirl.Hparams,
    training: Training,
    num_steps: int | None = None,
) -> LearnedPolicies:
    """Reward weights and policies of N seeds."""
    table, model = setup.task.learner, setup.model
    options = ChunkOptions(until=Partial(_ends, table.tolerance), keep="before")
    steps = num_steps or table.steps
    chunks, history = run_seeds(mlirl, problem, hparams, training, num_steps=steps, options=options)
    states = jax.device_get(dataclasses.replace(chunks.state, key=None))
    weights = states.parameters
    lanes = [jax.tree.map(lambda x, i=i: x[i], states) for i in range(len(weights))]
    each = [jax.device_get(_policy_and_likelihood(one, problem, hparams)) for one in lanes]
    policy, nll, codes = (np.stack(column) for column in zip(*each, strict=True))
    if table.in_world:
        policy = jax.jit(jax.vmap(lift_policy, (None, 0)))(model, policy)
    gradient_norm = history["gradient_norm"][-1]
    return LearnedPolicies(
        policy=np.asarray(policy),
        weights=weights,
        names=setup.features.names,
        loss=history["loss"][-1],
        neg_log_likelihood=nll,
        gradient_norm=gradient_norm,
        status=codes,
        num_steps=np.asarray(states.step),
        # Values of softmax policies have no certificate without contraction.
        converged=(gradient_norm <= table.tolerance) & (codes <= Status.UNCERTIFIED),
        history=history,
    )


def _ends(
    tolerance: float, before: mlirl.State, after: mlirl.State, metrics: mlirl.Metrics
) -> jax.Array:
    """True if the gradient vanishes, or a step changes nothing, so that no later one does."""
    # Where the loss is steep, rounding hides its decrease before the gradient is that small.
    parts = ((state.parameters, state.optimizer) for state in (before, after))
    same = jax.tree.map(lambda x, y: jnp.all((x == y) | (x != x)), *parts)  # NaN equals NaN
    return (metrics.gradient_norm <= tolerance) | jnp.all(jnp.stack(jax.tree.leaves(same)))


def _with_guarantee(
    setup: MlirlSetup, training: Training
) -> tuple[LearnedPolicies, int, Attempt | None]:
    """Learning under the guarantee: all seeds, the kept one, and how a probability is attained."""
    guarantee, problem = setup.guarantee, setup.problem
    hparams = settings(mlirl.Hparams, setup.task.learner.specified())
    if isinstance(guarantee.requested, str):
        learned = _train(setup, problem, hparams, training)
        return learned, _least_loss(learned), None
    actions, again = guarantee.actions, Training(training.seed, 1)
    inside, policy, steps = None, None, setup.task.learner.steps
    if actions is not None and guarantee.usable:
        inside = _train(setup, _problem(setup, np.asarray(actions.allowed)), hparams, again)
        policy = inside.policy[0]
        # The time without the constraint, and with it, stays in proportion to this.
        least = int(inside.num_steps[0])
        steps = min(steps, max(2 * least, _STATE_STEPS // setup.model.num_states))
    learned = _train(setup, problem, hparams, training, steps)
    free = one_seed(learned, _least_loss(learned))
    search = GuaranteeSearch(
        setup.model,
        guarantee,
        np.asarray(problem.counts),
        lambda one: one.policy[0],
        lambda: _constrained(setup, free, hparams, training.seed),
        lambda one: one if setup.bound is None else setup.bound.keep(setup.model, one).policy,
    )
    training.stage("searching")
    if policy is None:
        policy = np.asarray(actions.policy if actions else free.policy[0])
    attempt = search.at_least(free, policy, inside or free)
    learned_policy = dataclasses.replace(
        attempt.learned,
        policy=attempt.policy[None],
        neg_log_likelihood=np.array([attempt.neg_log_likelihood]),
    )
    return learned_policy, 0, attempt


def _constrained(
    setup: MlirlSetup, free: LearnedPolicies, hparams: mlirl.Hparams, seed: int
) -> list[tuple[LearnedPolicies, float]]:
    """The most likely results at and below the required probability, and their weights mu."""
    guarantee, problem = setup.guarantee, setup.problem
    required, soft = float(guarantee.requested), FullSupport(setup.model, guarantee.over)
    value = jnp.zeros(setup.model.state_shape, setup.model.dtype)

    def evaluate(parameters: np.ndarray) -> ConstrainedPoint:
        nonlocal value
        (loss, policy), pull, new = _likelihood_and_policy(
            jnp.asarray(parameters, value.dtype), problem, hparams, value
        )
        # Without a certificate: only the policies that are found get one.
        probability, slope = soft.probability(np.asarray(policy))
        each = np.asarray(_derivatives(pull, jnp.asarray(slope, value.dtype)))
        point = ConstrainedPoint(parameters, float(loss), probability, each[0], each[1], new)
        value = new if point.is_finite else value
        return point

    # The likelihood has several maxima: from the free weights, and from the initial ones.
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(seed), 1), 0)
    starts = [free.weights[0], np.asarray(mlirl.init(key, problem, hparams).parameters)]
    max_evaluations = max(_STATE_STEPS // setup.model.num_states, int(free.num_steps[0]) // 2)
    points = constrained_points(evaluate, starts, required, min(max_evaluations, _EVALUATIONS))
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
def _likelihood_and_policy(
    parameters: jax.Array, problem: mlirl.Problem, hparams: mlirl.Hparams, initial: jax.Array
) -> tuple[tuple[jax.Array, jax.Array], Callable, jax.Array]:
    """Loss and policy, the transpose of their derivative, and the value."""

    def terms(parameters: jax.Array) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
        loss, parts = mlirl.objective(parameters, problem, hparams, initial)
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


def _least_loss(learned: LearnedPolicies) -> int:
    """The seed of least loss, among those that converged if there are any."""
    loss = np.where(np.isfinite(learned.loss), learned.loss, np.inf)
    return int(np.argmin(np.where(learned.converged, loss, loss + 1e12)))


def _policy_and_likelihood(
    state: mlirl.State, problem: mlirl.Problem, hparams: mlirl.Hparams
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
    parameters: PyTree, value: jax.Array, problem: mlirl.Problem, hparams: mlirl.Hparams
) -> jax.Array:
    reward = problem.reward(parameters, problem.features)
    return softmax_policy(problem.model, reward, hparams.discount, value)


@jax.jit
def _solved(
    parameters: PyTree, problem: mlirl.Problem, hparams: mlirl.Hparams
) -> tuple[jax.Array, jax.Array, jax.Array]:
    solution = mlirl.solve(parameters, problem, hparams)
    log_policy = jnp.log(jnp.where(problem.counts > 0, solution.policy, 1))
    return solution.policy, -jnp.sum(problem.counts * log_policy), solution.status


# --- the whole job --------------------------------------------------------------------------


@dataclass(frozen=True)
class MlirlSetup:
    task: MlirlFile
    world: MappedModel
    model: Product
    demonstrations: Trajectories
    dropped: int
    guarantee: Guarantee
    bound: StepBound | None = None  # of the expected steps; None for safety formulas
    trivial: str | None = None  # remark on a formula that is always true

    @property
    def used(self) -> Trajectories:
        """The demonstrations until the formula or, by a mistake, the best probability is lost."""
        length = self.guarantee.used
        if length is None or self.task.learner.in_world:  # that learner has no formula
            return self.demonstrations
        return dataclasses.replace(self.demonstrations, length=to_jax(length.astype(np.int32)))

    @functools.cached_property
    def features(self) -> mlirl.Features:
        """The features of the reward, in the world or in the product (chapter 2)."""
        table, model, demonstrations = self.task.learner, self.model, self.used
        avoid = table.avoid or ()
        if table.in_world:
            return mlirl.world_features(
                model.mdp,
                demonstrations,
                goal=table.goal or (),
                progress=table.progress_labels,
                avoid=avoid,
            )
        # Without a guarantee, those of the dissertation's Table 1 alone.
        best = None if self.guarantee.requested == "none" else self.guarantee.best
        return mlirl.task_features(
            model, demonstrations, avoid=avoid, progress=table.progress_states, best=best
        )

    @functools.cached_property
    def problem(self) -> mlirl.Problem:
        """The learning problem under the guarantee."""
        allowed = self.guarantee.allowed
        if not isinstance(self.guarantee.requested, str):
            allowed = np.asarray(self.model.available)  # an array, so that one program serves both
        return _problem(self, allowed)


@dataclass
class MlirlOutcome:
    setup: MlirlSetup  # setup, learned: the task, and the results of learning
    learned: LearnedPolicies
    chosen: int  # index of the kept seed, that of least loss
    solution: Solution  # satisfaction probability of the kept policy, with bounds
    attempt: Attempt | None  # how an asked probability was attained, if any
    # of the learned and the quickest policy, and their trade-offs; None for safety formulas
    expected_steps: Record | None
    # float[N, S], satisfaction probability of every seed from initial states
    satisfaction: np.ndarray
    # guarantee of the kept policy from a log, if the world is estimated from one
    data: Record | None
    seed: int  # the first seed


def prepare(task: MlirlFile, seed: int) -> MlirlSetup:
    """The learning problem of a task file: product, demonstrations, guarantee and features."""
    world = load_world(task.path, task.world)
    with errors_in(f"{task.path}: [task] "):
        model = product(world.mdp, task.formula, label_on=task.label_on)
        trivial = check_formula(model.automaton)
    best = optimal_satisfaction(model)
    with errors_in(f"{task.path}: [world] "):
        require_possible(model, world, best)
    table = task.demonstrations
    if table.file is not None:
        demonstrations, dropped = load_demonstrations(task, world), 0
    else:
        key = jax.random.fold_in(jax.random.key(seed), 0)
        demonstrations, dropped = synthetic_demonstrations(key, task.path, table, model, best)
    with errors_in(f"{task.path}: [task] "):
        guarantee = ask(model, world, demonstrations, best, task.guarantee, task.over)
        actions = guarantee.actions or optimal_actions(model, best)
        bound = step_bound(
            model, actions, guarantee.requested, task.over, task.steps, task.steps_factor
        )
    setup = MlirlSetup(task, world, model, demonstrations, dropped, guarantee, bound, trivial)
    with errors_in(f"{task.path}: [learner] "):
        _ = setup.problem  # raises its errors before learning
    return setup


def describe(setup: MlirlSetup) -> str:
    """Sizes of the problem in one line."""
    lengths = np.asarray(setup.demonstrations.length)
    logged = setup.world.logged
    return (
        f"{setup.world.mdp.num_states} states, {setup.model.num_memory} memory states, "
        f"{counted(len(lengths), 'demonstration')} of {counted(int(lengths.sum()), 'pair')}"
        + ("" if logged is None else f", {counted(logged.num_samples, 'logged transition')}")
    )


def learn(setup: MlirlSetup, training: Training) -> MlirlOutcome:
    """Learns with N seeds, keeps the one of least loss, and evaluates all."""
    model = setup.model
    learned, chosen, attempt = _with_guarantee(setup, training)
    training.stage("checking")
    learned, steps = _within_steps(setup, learned, chosen)
    policy = learned.policy[chosen]
    if attempt is None:
        solution = satisfaction_probability(model, policy)
    else:  # the search certifies with a tolerance, and before mixing
        over = setup.guarantee.over
        solution = certified(model, policy, over, float(setup.guarantee.requested))
        attempt = dataclasses.replace(
            attempt,
            policy=policy,
            attained=at_starts(model, solution.lower, over)[0],
            neg_log_likelihood=float(learned.neg_log_likelihood[chosen]),
        )
    each = [
        solution if i == chosen else satisfaction_probability(model, learned.policy[i])
        for i in range(len(learned.policy))
    ]
    data = None
    if setup.world.logged is not None:
        # Import here: only worlds of logs have intervals.
        from jaxltl.app.certify import guaranteed

        training.stage("certifying")
        data = guaranteed(setup.world.logged, model, setup.task.formula, policy)
    return MlirlOutcome(
        setup=setup,
        learned=learned,
        chosen=chosen,
        solution=solution,
        attempt=attempt,
        expected_steps=steps,
        satisfaction=np.stack([from_starts(model, s.value) for s in each]),
        data=data,
        seed=training.seed,
    )


def summary(outcome: MlirlOutcome) -> Record:
    """The results for ``result.json``."""
    setup, learned, i = outcome.setup, outcome.learned, outcome.chosen
    task, world, model = setup.task, setup.world, setup.model
    initial, lengths = np.asarray(model.mdp.initial), np.asarray(setup.demonstrations.length)
    starts, best = np.flatnonzero(initial > 0), setup.guarantee.best
    impossible = starts[from_starts(model, best.upper)[starts] <= 0].tolist()
    result = {
        **about(task),
        "in": task.learner.in_,
        "num_states": world.mdp.num_states,
        "num_memory": model.num_memory,
        "demonstrations": {
            "number": len(lengths),
            "pairs": int(lengths.sum()),
            "synthetic": task.demonstrations.synthetic is not None,
            "dropped": setup.dropped,
        },
        "guarantee": guarantee_entry(
            setup.guarantee, outcome.attempt, model, world, setup.demonstrations, outcome.solution
        ),
        "trivial": setup.trivial,
        "remark": setup.features.remark,
        "expected_steps": outcome.expected_steps,
        "satisfaction": _evidence(outcome.solution, model, world, starts),
        "best_achievable": _evidence(best, model, world, starts),
        "impossible_starts": [world.position(s) for s in impossible],
        "neg_log_likelihood": learned.neg_log_likelihood[i],
        "weights": dict(zip(learned.names, learned.weights[i].tolist(), strict=True)),
        "training": {
            "loss": learned.loss[i],
            "gradient_norm": learned.gradient_norm[i],
            "steps": int(learned.num_steps[i]),
            "converged": bool(learned.converged[i]),
            "solver": Status(int(learned.status[i])).name,
            "hyperparameters": task.learner.hyperparameters(),
        },
        "seeds": {
            "first": outcome.seed,
            "number": len(learned.loss),
            "kept": i,
            "converged": int(learned.converged.sum()),
            "mean": outcome.satisfaction @ initial,
            "minimum": outcome.satisfaction[:, starts].min(axis=1),
            "loss": learned.loss,
            "neg_log_likelihood": learned.neg_log_likelihood,
        },
        **({} if outcome.data is None else {"data": outcome.data}),
    }
    return plain(result)


def _within_steps(
    setup: MlirlSetup, learned: LearnedPolicies, chosen: int
) -> tuple[LearnedPolicies, Record | None]:
    """The kept policy with its expected steps within the bound, and the report on steps."""
    model, bound, before = setup.model, setup.bound, learned.policy[chosen]
    if bound is None:
        return learned, None
    counts = np.asarray(setup.problem.counts)
    if setup.task.learner.in_world:
        counts = np.zeros_like(before)
    mixture = bound.keep(model, before)
    steps = about_steps(model, bound, before, mixture, counts)
    if mixture.share:
        policy, loss = learned.policy.copy(), learned.neg_log_likelihood.copy()
        policy[chosen], loss[chosen] = mixture.policy, neg_log_likelihood(mixture.policy, counts)
        learned = dataclasses.replace(learned, policy=policy, neg_log_likelihood=loss)
    return learned, steps


def _evidence(solution: Solution, model: Product, world: MappedModel, starts: np.ndarray) -> Record:
    parts = solution.value, solution.lower, solution.upper
    value, lower, upper = (from_starts(model, x) for x in parts)
    worst = int(starts[np.argmin(value[starts])])
    return {
        "mean": enclosure(*(at_starts(model, x, "mean")[0] for x in parts)),
        "minimum": {
            **enclosure(value[worst], lower[starts].min(), upper[worst]),
            **world.position(worst),
        },
        "num_starts": len(starts),
        "status": Status(int(solution.status)).name,
        "residual": solution.residual,
    }


def certifiable(outcome: MlirlOutcome) -> list[Certifiable] | str:
    """The kept policy's satisfaction probability."""
    setup, policy = outcome.setup, outcome.learned.policy[outcome.chosen]
    if setup.world.logged is not None:
        return "the policy is randomised and probabilities are intervals, from a log"
    return [policy_certificate(setup.model, outcome.solution, setup.task.formula, policy)]


def save(out: Path, outcome: MlirlOutcome) -> None:
    """Writes the kept policy to ``policy.npz`` in a directory.

    :func:`jaxltl.io.load_policy` reads it. Further arrays: ``weights [F]`` and ``features [F]``,
    ``all_weights [N, F]``; ``satisfaction``, ``lower`` and ``upper`` ``[S, Q]``.
    """
    model, learned, i = outcome.setup.model, outcome.learned, outcome.chosen
    logged = outcome.setup.world.logged
    policy = project_policy(
        model,
        learned.policy[i],
        actions=outcome.setup.world.actions,
        states=() if logged is None else logged.states,
    )
    save_policy(
        out / "policy.npz",
        policy,
        {
            "weights": learned.weights[i],
            "features": learned.names,
            "all_weights": learned.weights,
            "satisfaction": outcome.solution.value,
            "lower": outcome.solution.lower,
            "upper": outcome.solution.upper,
        },
    )
