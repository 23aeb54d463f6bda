"""From a task to a policy with its evidence: what `jaxltl learn` computes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxltl.algos import mlirl
from jaxltl.algos.common import learner
from jaxltl.app._learn_pictures import live as live
from jaxltl.app._learn_pictures import pictures as pictures
from jaxltl.app._learn_pictures import task_pictures as task_pictures
from jaxltl.app.files.tables import errors_in
from jaxltl.app.files.task import (
    Task,
    World,
    load_demonstrations,
    load_world,
    many,
    synthetic_demonstrations,
)
from jaxltl.app.files.task import read_task as read_task
from jaxltl.app.guarantee import (
    Attempt,
    Guarantee,
    ask,
    at_least,
    check_formula,
    kept,
)
from jaxltl.app.job import (
    Report,
    about,
    compile_beside,
    hyperparameters,
    memory_arrays,
    one_seed,
    plain,
    run_seeds,
    save_arrays,
    settings,
    took,
)
from jaxltl.app.job import fingerprint as fingerprint
from jaxltl.app.job import postfix as postfix
from jaxltl.core.models.construct.lifting import lift_policy
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.product import Product, product
from jaxltl.core.models.trajectories import Trajectories
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.discounted.soft import softmax_policy
from jaxltl.core.values.undiscounted.hitting_time import hitting_time
from jaxltl.core.values.undiscounted.mixture import at_starts, from_starts
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)

DOUBLE = True  # the precision of its figures
STEPS = 500  # at most, unless the task says otherwise
_TOLERANCE = 1e-6  # of the gradient's norm


# --- the learners ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Learned:
    """What a method learned, with N seeds side by side.

    Attributes:
      policy: ``float[N, S, Q, A]``, policies of the product.
      weights: ``float[N, F]``, and the features' names.
      loss, neg_log_likelihood, gradient_norm: ``float[N]``.
      status: ``int32[N]``, of the solver that yielded the policies.
      num_steps: ``int[N]``, until the gradient vanished, or all.
      converged: ``bool[N]``: the gradient vanished and the policy's solver converged.
      history: metrics ``[T, N]`` and ``step [T]``.
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


def _features(setup: Setup) -> mlirl.Features:
    """What inverse RL learns by, in the world or in the product (chapter 2)."""
    spec, model, shown = setup.task.learner, setup.model, setup.demonstrations
    avoid, progress = spec.get("avoid", ()), spec.get("progress")
    if spec.get("in", "product") == "world":
        return mlirl.world_features(
            model.mdp, shown, goal=spec["goal"], progress=progress or (), avoid=avoid
        )
    # The dissertation's learners, without a guarantee, have Table 1's alone.
    best = None if setup.guarantee.asked == "none" else setup.guarantee.best
    return mlirl.task_features(model, shown, avoid=avoid, progress=progress, best=best)


def _problem(setup: Setup, allowed: np.ndarray | None) -> tuple[tuple[str, ...], mlirl.Problem]:
    """What inverse RL learns from, with the names of its features."""
    spec, model, features = setup.task.learner, setup.model, setup.features
    in_world = spec.get("in", "product") == "world"
    start = spec.get("start")
    if start is not None and len(start) != len(features.names):
        raise ValueError(
            f"start has {len(start)} numbers; there are {len(features.names)} "
            f"features: {', '.join(features.names)}."
        )
    problem = mlirl.make_problem(
        model.mdp if in_world else model,
        features.values,
        setup.demonstrations,
        start=start,
        satisfaction_over=spec.get("satisfaction_over", "initial"),
        allowed=None if allowed is None else to_jax(allowed),
    )
    return features.names, problem


def _trained(
    setup: Setup,
    names: tuple[str, ...],
    problem: mlirl.Problem,
    hparams: mlirl.Hparams,
    seeds: tuple[int, int],
    report: Report | None,
    checkpoint: Path | None,
    mesh: Mesh | None = None,
) -> Learned:
    """What N seeds learn of a problem."""
    spec, model = setup.task.learner, setup.model
    wait = _compile_policy(problem, hparams)
    found, history = run_seeds(
        mlirl,
        seeds,
        problem,
        hparams,
        report,
        num_steps=spec.get("steps", STEPS),
        keep="before",
        until=learner.gradient_vanishes(spec.get("tolerance", _TOLERANCE)),
        checkpoint=checkpoint,
        mesh=mesh,
    )
    wait()
    states = jax.device_get(dataclasses.replace(found.state, key=None))
    weights = states.parameters
    lanes = [jax.tree.map(lambda x, i=i: x[i], states) for i in range(len(weights))]
    each = [jax.device_get(_policy_and_likelihood(one, problem, hparams)) for one in lanes]
    policy, nll, codes = (np.stack(column) for column in zip(*each, strict=True))
    if spec.get("in", "product") == "world":
        policy = jax.jit(jax.vmap(lift_policy, (None, 0)))(model, policy)
    gradient_norm, status = history["gradient_norm"][-1], np.asarray(codes)
    return Learned(
        policy=np.asarray(policy),
        weights=weights,
        names=names,
        loss=history["loss"][-1],
        neg_log_likelihood=np.asarray(nll),
        gradient_norm=gradient_norm,
        status=status,
        num_steps=np.asarray(states.step),
        # Beyond contraction no value of a softmax policy has a certificate.
        converged=found.done & (status <= Status.UNCERTIFIED),
        history=history,
    )


def _with_guarantee(
    setup: Setup,
    seeds: tuple[int, int],
    report: Report | None,
    checkpoint: Path | None,
    mesh: Mesh | None,
) -> tuple[Learned, int, Attempt | None]:
    """What is learned under the guarantee, which seed is kept, and how a probability was reached."""
    guarantee = setup.guarantee
    names, problem = setup.learning
    hparams = settings(mlirl.Hparams, setup.task.learner)
    if isinstance(guarantee.asked, str):
        learned = _trained(setup, names, problem, hparams, seeds, report, checkpoint, mesh)
        return learned, _least_loss(learned), None
    # With a weight of zero it is one program for all weights.
    hparams = dataclasses.replace(hparams, mu=0.0 if hparams.mu is None else hparams.mu)
    learned = _trained(setup, names, problem, hparams, seeds, report, checkpoint, mesh)
    free = one_seed(learned, _least_loss(learned))

    def train(mu: float, before: Learned, problem: mlirl.Problem = problem) -> Learned:
        start = jnp.asarray(before.weights[0], problem.features.dtype)
        there = dataclasses.replace(hparams, mu=mu)
        # The likelihood has several maxima: on from the last weights, and from the first ones.
        found = [
            _trained(setup, names, one, scaled, (seeds[0], 1), None, None)
            for one, scaled in (
                (
                    dataclasses.replace(problem, start=start),
                    dataclasses.replace(there, start_scale=0.0),
                ),
                (problem, there),
            )
        ]
        return found[int(np.argmin([np.nan_to_num(one.loss[0], nan=np.inf) for one in found]))]

    def inside() -> tuple[np.ndarray, Learned]:
        actions = guarantee.actions
        if actions is None or not guarantee.usable:
            return np.asarray(actions.policy if actions else free.policy[0]), free
        one = train(0.0, free, _problem(setup, np.asarray(actions.allowed))[1])
        return one.policy[0], one

    found = at_least(
        setup.model,
        guarantee,
        np.asarray(problem.counts),
        free,
        inside,
        train,
        lambda one: one.policy[0],
    )
    kept = dataclasses.replace(
        found.learned,
        policy=found.policy[None],
        neg_log_likelihood=np.array([found.neg_log_likelihood]),
    )
    return kept, 0, found


def _least_loss(learned: Learned) -> int:
    """The seed that is kept: of those that converged, if any did, the one of least loss."""
    loss = np.where(np.isfinite(learned.loss), learned.loss, np.inf)
    return int(np.argmin(np.where(learned.converged, loss, loss + 1e12)))


def _policy_and_likelihood(
    state: mlirl.State, problem: mlirl.Problem, hparams: mlirl.Hparams
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of one seed's weights: the policy, its negative log-likelihood, and its solver's status."""
    if hparams.optimizer == "lbfgs" and state.optimizer.known:
        # The last evaluation was at these weights, so that there is nothing left to solve.
        parts = state.optimizer.point.parts
        policy = _softmax_policy(state.parameters, parts.value, problem, hparams)
        return policy, parts.neg_log_likelihood, parts.status
    return _solved(state.parameters, problem, hparams)


def _compile_policy(problem: mlirl.Problem, hparams: mlirl.Hparams) -> Callable[[], None]:
    """Begins to compile what :func:`_policy_and_likelihood` will want; returns what waits."""
    if hparams.optimizer != "lbfgs":
        return lambda: None
    value = jax.ShapeDtypeStruct(problem.model.state_shape, problem.model.dtype)
    return compile_beside(_softmax_policy, problem.start, value, problem, hparams)


@jax.jit
def _softmax_policy(
    parameters: Any, value: jax.Array, problem: mlirl.Problem, hparams: mlirl.Hparams
) -> jax.Array:
    reward = problem.reward(parameters, problem.features)
    return softmax_policy(problem.model, reward, hparams.discount, value)


@jax.jit
def _solved(
    parameters: Any, problem: mlirl.Problem, hparams: mlirl.Hparams
) -> tuple[jax.Array, jax.Array, jax.Array]:
    solution = mlirl.solve(parameters, problem, hparams)
    seen = problem.counts > 0
    log_policy = jnp.log(jnp.where(seen, solution.policy, 1))
    return solution.policy, -jnp.sum(problem.counts * log_policy), solution.status


# --- the whole job --------------------------------------------------------------------------


@dataclass(frozen=True)
class Setup:
    """A task file's contents as the library's objects; see :func:`prepare`."""

    task: Task
    world: World
    model: Product
    demonstrations: Trajectories
    dropped: int
    guarantee: Guarantee
    trivial: str | None = None  # what is to be said of a formula that is always true

    @functools.cached_property
    def features(self) -> mlirl.Features:
        """Of the learned reward."""
        return _features(self)

    @functools.cached_property
    def learning(self) -> tuple[tuple[str, ...], mlirl.Problem]:
        """The features' names, and what is learned from under the guarantee."""
        return _problem(self, self.guarantee.allowed)


@dataclass(frozen=True)
class Outcome:
    """A finished job: what was asked, learned and found out about it.

    Attributes:
      setup, learned: the parts.
      chosen: the seed's position whose loss is least; the policy that is kept.
      solution: the kept policy's probability of doing the task, with bounds.
      attempt: how a probability that was asked for was reached, if one was.
      expected_steps: by who acts, from the initial states; None if a task does not end.
      satisfaction: ``float[N, S]``, of every seed's policy from every start.
      data: what a log guarantees of the kept policy, where the world is known from one.
      seed: the first of the seeds.
      seconds: spent.
    """

    setup: Setup
    learned: Learned
    chosen: int
    solution: Solution
    attempt: Attempt | None
    expected_steps: dict[str, Any] | None
    satisfaction: np.ndarray
    data: dict[str, Any] | None
    seed: int
    seconds: float


def prepare(task: Task, seed: int) -> Setup:
    """The world, product and demonstrations of a task; all of its files checked.

    Raises:
      ValueError: something in the task or its files is wrong.
    """
    world = load_world(task)
    with errors_in(f"{task.path}: [task] "):
        model = product(world.mdp, task.formula, label_on=task.label_on)
        trivial = check_formula(model.automaton)
    best = optimal_satisfaction(model)
    if "file" in task.demonstrations:
        shown, dropped = load_demonstrations(task, world), 0
    else:
        key = jax.random.fold_in(jax.random.key(seed), 0)
        shown, dropped = synthetic_demonstrations(task, model, key, best)
    with errors_in(f"{task.path}: [task] "):
        asked = ask(model, world, shown, best, task.guarantee, task.over)
    setup = Setup(task, world, model, shown, dropped, asked, trivial)
    with errors_in(f"{task.path}: [learner] "):
        _ = setup.learning  # so that its mistakes are found before the work
    return setup


def describe(setup: Setup) -> str:
    """What a task comes to, in one line."""
    lengths = np.asarray(setup.demonstrations.length)
    logged = setup.world.logged
    return (
        f"{setup.world.mdp.num_states} states, {setup.model.num_memory} memory states, "
        f"{many(len(lengths), 'demonstration')} of {many(int(lengths.sum()), 'pair')}"
        + ("" if logged is None else f", {many(logged.num_samples, 'logged transition')}")
    )


def learn(
    setup: Setup,
    seed: int,
    num_seeds: int,
    *,
    report: Report | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[str], None] = lambda stage: None,
    mesh: Mesh | None = None,
) -> tuple[
    Learned, int, Solution, Attempt | None, dict[str, Any] | None, np.ndarray, dict[str, Any] | None
]:
    """Learns with N seeds, keeps the best, and evaluates it; see :class:`Outcome`.

    What it is at is told to `report`, steps and figures, and to `progress`, the stage's name.

    Raises:
      ValueError: the learner cannot work on this task.
    """
    model = setup.model
    learned, chosen, attempt = _with_guarantee(setup, (seed, num_seeds), report, checkpoint, mesh)
    progress("checking")
    solution = satisfaction_probability(model, learned.policy[chosen])
    at_start = functools.partial(from_starts, model)
    each = [
        solution if i == chosen else satisfaction_probability(model, learned.policy[i])
        for i in range(len(learned.policy))
    ]
    expected_steps = _expected_steps(setup, learned.policy[chosen])
    values = np.stack([at_start(s.value) for s in each])
    data = None
    if setup.world.logged is not None:
        # Deferred: only worlds that are known from a log have intervals.
        from jaxltl.app.logged import guaranteed

        progress("certifying")
        data = guaranteed(setup.world.logged, model, setup.task.formula, learned.policy[chosen])
    return learned, chosen, solution, attempt, expected_steps, values, data


def summary(outcome: Outcome) -> dict[str, Any]:
    """The outcome as numbers, lists and texts, for ``result.json``; NaN becomes None."""
    setup, learned, i = outcome.setup, outcome.learned, outcome.chosen
    task, world, model = setup.task, setup.world, setup.model
    starts = np.flatnonzero(np.asarray(model.mdp.initial) > 0)
    best = setup.guarantee.best
    impossible = starts[from_starts(model, best.upper)[starts] <= 0].tolist()
    mean = outcome.satisfaction @ np.asarray(model.mdp.initial)
    least = outcome.satisfaction[:, starts].min(axis=1)
    pairs = int(np.sum(np.asarray(setup.demonstrations.length)))
    result = {
        **about(task),
        "in": task.learner.get("in", "product"),
        "num_states": world.mdp.num_states,
        "num_memory": model.num_memory,
        "demonstrations": {
            "number": len(np.asarray(setup.demonstrations.length)),
            "pairs": pairs,
            "synthetic": "synthetic" in task.demonstrations,
            "dropped": setup.dropped,
        },
        "guarantee": kept(
            setup.guarantee, outcome.attempt, model, world, setup.demonstrations, outcome.solution
        ),
        "trivial": setup.trivial,
        "remark": setup.features.remark,
        "expected_steps": outcome.expected_steps,
        "satisfaction": _evidence(outcome.solution, model, world, starts),
        "best_achievable": _evidence(best, model, world, starts),
        "impossible_starts": [world.where(s) for s in impossible],
        "neg_log_likelihood": learned.neg_log_likelihood[i],
        "weights": dict(zip(learned.names, learned.weights[i].tolist(), strict=True)),
        "training": {
            "loss": learned.loss[i],
            "gradient_norm": learned.gradient_norm[i],
            "steps": int(learned.num_steps[i]),
            "converged": bool(learned.converged[i]),
            "solver": Status(int(learned.status[i])).name,
            "hyperparameters": hyperparameters(task),
        },
        "seeds": {
            "first": outcome.seed,
            "number": len(learned.loss),
            "kept": i,
            "converged": int(learned.converged.sum()),
            "mean": mean,
            "minimum": least,
            "loss": learned.loss,
            "neg_log_likelihood": learned.neg_log_likelihood,
        },
        **({} if outcome.data is None else {"data": outcome.data}),
        **took(outcome.seconds),
    }
    return plain(result)


def _expected_steps(setup: Setup, learned: np.ndarray) -> dict[str, Any] | None:
    """Of a co-safe task, until it is done or lost: of what was learned and of the quickest best."""
    model, best = setup.model, setup.guarantee.best
    if model.automaton.acceptance != "cosafe":
        return None
    ended = np.asarray(model.final) | (np.asarray(best.upper) <= 0)
    policies = {"learned": learned, "quickest": best.policy}
    weight = np.asarray(model.mdp.initial, float)
    starts = weight > 0
    with np.errstate(invalid="ignore"):
        return {
            name: from_starts(model, hitting_time(model, policy, ended))[starts] @ weight[starts]
            for name, policy in policies.items()
        }


def _evidence(
    solution: Solution, model: Product, world: World, starts: np.ndarray
) -> dict[str, Any]:
    value, lower, upper = (
        from_starts(model, x) for x in (solution.value, solution.lower, solution.upper)
    )
    worst = int(starts[np.argmin(value[starts])])
    names = ("value", "lower", "upper")
    return {
        "mean": {name: at_starts(model, getattr(solution, name), "mean")[0] for name in names},
        "minimum": {
            "value": value[worst],
            "lower": lower[starts].min(),
            "upper": upper[worst],
            **world.where(worst),
        },
        "num_starts": len(starts),
        "status": Status(int(solution.status)).name,
        "residual": solution.residual,
    }


def save(out: Path, outcome: Outcome) -> None:
    """Writes ``policy.npz``, the kept policy with all that it takes to run it, into a directory.

    Its arrays: ``policy [S, Q, A]``; ``initial_memory [S]`` and ``next_memory [S, Q]``, the memory
    at the start in s and after reading the label of s; ``label_on``; ``actions [A]``; ``weights
    [F]`` and ``features [F]``; ``satisfaction``, ``lower`` and ``upper`` ``[S, Q]``; of a log,
    ``states [S]``, its names.

    Raises:
      ValueError: the place cannot be written to.
    """
    model, learned, i = outcome.setup.model, outcome.learned, outcome.chosen
    logged = outcome.setup.world.logged
    save_arrays(
        out / "policy.npz",
        {
            "policy": learned.policy[i],
            **memory_arrays(model),
            "actions": outcome.setup.world.actions,
            "weights": learned.weights[i],
            "features": learned.names,
            "all_weights": learned.weights,
            "satisfaction": outcome.solution.value,
            "lower": outcome.solution.lower,
            "upper": outcome.solution.upper,
            **({} if logged is None else {"states": logged.states}),
        },
    )
