"""Task-oriented deep inverse reinforcement learning: the job of ``method = "todirl"``.

A reward network is learned in training worlds (dissertation, chapter 3). Its soft-optimal policies
are compared there and in test worlds with an expert for the formula and the uniform policy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.algos import todirl
from jaxltl.algos.common import learner
from jaxltl.algos.common.chunks import ChunkOptions
from jaxltl.app.files.demonstrations import require_cosafe, synthetic_demonstrations
from jaxltl.app.files.scenes import (
    cell_kinds,
    load_automata,
    load_demonstrations,
    load_scenes,
    ObservedScene,
)
from jaxltl.app.files.task_todirl import TodirlFile
from jaxltl.app.guarantee import (
    Attempt,
    check_formula,
    is_weighable,
    mistakes,
    used_steps,
    neg_log_likelihood,
    step_bound,
    StepBound,
)
from jaxltl.app.job import one_seed, postfix as postfix, run_seeds, settings
from jaxltl.app.protocols import Training
from jaxltl.app.reports.learn_todirl import (
    live as live,
    pictures as pictures,
    report as report,
    task_pictures as task_pictures,
)
from jaxltl.app.todirl_results import (
    WorldEvaluation,
    LearnedRewards,
    LENGTH,
    TodirlOutcome,
    part_of,
    TodirlSetup,
    summary as summary,
    Worlds,
)
from jaxltl.core.automata import Automaton, synchronize
from jaxltl.core.models import (
    lift_memory_policy,
    stack_products,
    project_policy,
    with_allowed,
    Product,
    product,
    Trajectories,
)
from jaxltl.core.models.construct.batch import restrict_stacked_actions
from jaxltl.core.models.construct.lifting import allowed_steps
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.policies.policy_file import save_policy
from jaxltl.core.types import Solution
from jaxltl.core.validation import errors_in
from jaxltl.core.values import (
    soft_value,
    Mixture,
    optimal_actions,
    Performance,
    task_performances,
    optimal_satisfaction,
)
from jaxltl.core.values.undiscounted.mixture import attained, reaching, require_attainable, WINDOW
from jaxltl.core.values.undiscounted.performance import step_bounded_performances
from jaxltl.core.values.undiscounted.satisfaction_steps import StepAnalysis
from jaxltl.envs import temporal_gridworld
from jaxltl.envs.cell_kinds import COLORS
from jaxltl.envs.gridworld import ACTIONS
from jaxltl.io.learned_reward import LearnedReward, save_reward

DOUBLE, FILE = True, TodirlFile

_BATCH = 64  # worlds in a batch of planning
_EXPERT_DISCOUNT = 0.99  # largest default


def prepare(task: TodirlFile, seed: int) -> TodirlSetup:
    """Worlds, automata and demonstrations of a task; ValueError for one that does not fit."""
    automaton, memory = load_automata(task)
    table = task.demonstrations
    require_cosafe(task.path, table, automaton)
    with errors_in(f"{task.path}: [task] "):
        trivial = check_formula(automaton)
    scenes, others = load_scenes(task, automaton)
    demonstrations = load_demonstrations(task, scenes) if table.files is not None else []
    worlds = _stack(task, [*scenes, *others], automaton, memory)
    soft = automaton.is_cosafe and (table.discount is not None or bool(demonstrations))
    expert, bests = _experts(task, worlds.scenes, automaton, soft=soft)
    dropped = 0
    if not demonstrations:
        key = jax.random.fold_in(jax.random.key(seed), 0)
        for w, scene in enumerate(scenes):
            # Without padding and the learner's memory: tasks that differ only in these have the
            # same demonstrations.
            model = product(scene.mdp, automaton, label_on=task.label_on)
            own = jax.random.fold_in(key, w)
            if soft:
                demonstrations.append(
                    temporal_gridworld.demonstrations(
                        own,
                        model,
                        expert[w, : scene.mdp.num_states],
                        table.synthetic or 0,
                        table.length or LENGTH,
                    )
                )
            else:
                runs, lost = synthetic_demonstrations(own, task.path, table, model, bests[w])
                demonstrations, dropped = [*demonstrations, runs], dropped + lost
    if memory is not automaton:
        expert = np.tile(
            expert, (1, 1, len(memory.delta), 1)
        )  # the formula's automaton state varies fastest
    setup = TodirlSetup(
        task,
        automaton,
        memory,
        worlds,
        len(scenes),
        jnp.asarray(expert),
        soft,
        demonstrations,
        dropped,
        requested="best" if task.guarantee == 1 else task.guarantee,
        trivial=trivial,
    )
    if setup.requested == "none":
        return _until_mistakes(setup)
    lanes = [part_of(worlds.model, w) for w in range(len(worlds.scenes))]
    setup = replace(setup, optimal=[optimal_actions(lane) for lane in lanes])
    if setup.is_probability:
        check_attainable(setup)
    setup = _until_mistakes(replace(setup, bounds=step_bounds(setup)))
    if setup.is_probability:
        return setup
    return _narrowed(setup)


def _until_mistakes(setup: TodirlSetup) -> TodirlSetup:
    """Demonstrations until the formula is lost or, for "best", a mistake has left the best probability."""
    shortened, unused = list[Trajectories](), 0
    for w, each in enumerate(setup.demonstrations):
        mdp = setup.worlds.scenes[w].mdp
        model = product(mdp, setup.automaton, label_on=setup.task.label_on)
        mistake = np.zeros(each.state.shape, bool)
        if setup.requested == "best" and setup.optimal is not None:
            mistake = mistakes(model, np.asarray(setup.optimal[w].allowed)[: mdp.num_states], each)
        used = used_steps(model, optimal_satisfaction(model), mistake, each)
        unused += int(np.sum(each.length)) - int(used.sum())
        shortened.append(replace(each, length=to_jax(used.astype(np.int32))))
    return replace(setup, demonstrations=shortened, unused=unused)


def _narrowed(setup: TodirlSetup) -> TodirlSetup:
    """Restricts a setup to optimal actions, and counts the demonstrated steps that are not."""
    task, worlds, count = setup.task, setup.worlds, 0
    allowed = [np.asarray(one.allowed) for one in setup.optimal or ()]
    for w, trajectories in enumerate(setup.demonstrations):
        with errors_in(f"{task.path}: demonstrations in {worlds.scenes[w].name}: "):
            size = worlds.scenes[w].mdp.num_states
            model = product(worlds.scenes[w].mdp, setup.automaton, label_on=task.label_on)
            allowed_mask = allowed_steps(with_allowed(model, allowed[w][:size]), trajectories)
        count += int(np.asarray(trajectories.mask).sum() - allowed_mask.sum())
    worlds = replace(worlds, model=restrict_stacked_actions(worlds.model, allowed))
    return replace(setup, worlds=worlds, left_out=count)


def _experts(
    task: TodirlFile, scenes: list[ObservedScene], automaton: Automaton, *, soft: bool
) -> tuple[np.ndarray, list[Solution]]:
    """Policies ``[W, S, Q, A]`` of the expert, and optimal solutions unless it is soft-optimal."""
    if soft:
        table = task.demonstrations
        discount = table.discount
        if discount is None:
            discount = min(task.learner.discount, _EXPERT_DISCOUNT)
        models = stack_products([s.mdp for s in scenes], automaton, label_on=task.label_on)
        return np.asarray(_expert(models, discount, table.rewards())), []
    bests = [
        optimal_satisfaction(product(s.mdp, automaton, label_on=task.label_on)) for s in scenes
    ]
    size = max(scene.mdp.num_states for scene in scenes)
    # Actions in padding states never matter.
    chosen = [np.pad(np.asarray(x.policy), ((0, size - len(x.policy)), (0, 0))) for x in bests]
    return np.eye(len(ACTIONS))[np.stack(chosen)], bests


def _stack(
    task: TodirlFile, scenes: list[ObservedScene], automaton: Automaton, memory: Automaton
) -> Worlds:
    """Stacks all worlds, so that one program serves them."""
    mdps = [scene.mdp for scene in scenes]
    both = automaton if memory is automaton else synchronize(memory, automaton)
    with errors_in(f"{task.path}: "):
        model = stack_products(mdps, memory, label_on=task.label_on)
        task_model = stack_products(mdps, both, label_on=task.label_on)
    return Worlds(scenes, model, task_model, _observations(scenes, model))


def _observations(scenes: list[ObservedScene], model: Product) -> jax.Array:
    size = model.mdp.num_states
    return jnp.asarray(
        np.stack(
            [
                np.pad(np.asarray(s.observation), ((0, size - len(s.observation)), (0, 0)))
                for s in scenes
            ]
        )
    )


def describe(setup: TodirlSetup) -> str:
    """Numbers of worlds, memory states and demonstrations, as text."""
    pairs = sum(int(np.sum(trajectories.length)) for trajectories in setup.demonstrations)
    number = sum(len(trajectories.length) for trajectories in setup.demonstrations)
    tests = len(setup.worlds.scenes) - setup.num_training
    return (
        f"{setup.num_training} training and {tests} test worlds, "
        f"{setup.worlds.model.num_memory} memory states, {number} demonstrations of {pairs} pairs"
    )


def learn(setup: TodirlSetup, training: Training) -> TodirlOutcome:
    """Learns with N seeds, keeps one without looking at test worlds, and evaluates it."""
    table = setup.task.learner
    network = todirl.RewardNetwork(tuple(table.hidden))
    scenes = setup.worlds.scenes[: setup.num_training]
    # Stacked again, without the padding of larger test worlds.
    model = stack_products(
        [scene.mdp for scene in scenes], setup.memory, label_on=setup.task.label_on
    )
    masks = setup.worlds.model.allowed
    problem = todirl.make_problem(
        model,
        _observations(scenes, model),
        setup.demonstrations,
        held_out=table.held_out,
        network=network,
        horizon=table.horizon,
        allowed=masks if masks is None else masks[: len(scenes), : model.mdp.num_states],
    )
    hparams = settings(todirl.Hparams, table.specified())
    if setup.is_probability and any(
        is_weighable(part_of(setup.worlds.model, w)) for w in range(setup.num_training)
    ):
        hparams = replace(hparams, mu=0.0)  # not None, so that one program serves all weights
    learned = _train(setup, problem, hparams, training)
    chosen = _least_loss(learned)
    if setup.is_probability:
        seed = training.seed
        parameters = part_of(learned.parameters, slice(chosen, chosen + 1))
        lane = replace(one_seed(learned, chosen), parameters=parameters)
        learned, chosen = _weighed(setup, problem, hparams, lane, seed), 0
    training.stage("checking")
    evaluation = _evaluate(setup, learned, network, hparams, chosen)
    return TodirlOutcome(setup, learned, chosen, evaluation, training.seed)


def _train(
    setup: TodirlSetup, problem: todirl.Problem, hparams: todirl.Hparams, training: Training
) -> LearnedRewards:
    """Reward networks of N seeds."""
    chunks, history = run_seeds(
        todirl,
        problem,
        hparams,
        training,
        num_steps=setup.task.learner.steps,
        options=ChunkOptions(until=learner.has_stopped),
    )
    states, best = chunks.state, chunks.state.best
    score = np.asarray(best.neg_log_likelihood)
    best_step = np.minimum(np.asarray(best.step), len(history["held_out"]) - 1)
    return LearnedRewards(
        parameters=best.parameters,
        held_out=score
        if hparams.mu is None
        else np.where(
            np.isfinite(score), history["held_out"][best_step, np.arange(len(best_step))], score
        ),
        best_step=np.asarray(best.step),
        stopped=np.asarray(states.stopped),
        num_steps=int(np.max(states.step)),
        history=history,
    )


def _least_loss(learned: LearnedRewards) -> int:
    """The seed of greatest held-out likelihood, or of least loss."""
    score = np.where(np.isfinite(learned.held_out), learned.held_out, np.inf)
    loss = np.where(np.isfinite(learned.history["loss"][-1]), learned.history["loss"][-1], np.inf)
    return int(np.argmin(score if np.isfinite(score).any() else loss))


def _weighed(
    setup: TodirlSetup,
    problem: todirl.Problem,
    hparams: todirl.Hparams,
    free: LearnedRewards,
    seed: int,
) -> LearnedRewards:
    """The network of one seed with the best weight of the satisfaction probability."""

    def train(mu: float) -> LearnedRewards:
        return _train(setup, problem, replace(hparams, mu=mu), Training(seed, 1))

    def plans(learned: LearnedRewards) -> tuple[np.ndarray, np.ndarray]:
        parameters = part_of(learned.parameters, 0)
        count = setup.num_training
        return _plans(setup, problem.network, parameters, replace(hparams, mu=None), count)[:2]

    counts = np.asarray(problem.counts + problem.held_out)
    attempt = likeliest(setup, counts, free, None if hparams.mu is None else train, plans)
    return replace(attempt.learned, weight=attempt.weight)


def _evaluate(
    setup: TodirlSetup,
    learned: LearnedRewards,
    network: todirl.RewardNetwork,
    hparams: todirl.Hparams,
    chosen: int,
) -> WorldEvaluation:
    worlds, automaton = setup.worlds, setup.automaton
    performances, policies, codes = [], [], []
    details = dict[str, np.ndarray]()  # of the chosen seed
    for i in range(len(learned.held_out)):
        parameters = part_of(learned.parameters, i)
        if setup.is_probability:
            free, inside, status = _plans(
                setup, network, parameters, replace(hparams, mu=None), len(worlds.scenes)
            )
            held = hold(setup, free, inside)
            policy = jnp.asarray(np.stack([one.policy for one in held]))
            if i == chosen:
                details |= {
                    k: np.array([getattr(x, k) for x in held]) for k in ("share", "attained")
                }
        else:
            policy, status = _plan(network, parameters, worlds.model, worlds.observation, hparams)
        if setup.bounds is not None:
            steps = within_steps(setup, setup.bounds, np.asarray(policy))
            policy = jnp.asarray(np.stack([one.policy for one in steps]))
            if i == chosen:
                times = [one.steps[:3] for one in steps if one.steps is not None]
                shares = [one.share for one in steps]
                details |= {"steps": np.array(times), "quick_share": np.array(shares)}
        lifted = policy if setup.memory is automaton else lift_memory_policy(policy, automaton)
        performances.append(_probability(worlds.task_model, lifted, hparams.horizon))
        policies.append(policy if i == chosen else None)
        codes.append(status)
    model, expert = worlds.task_model, setup.expert
    available = model.mdp.available[:, :, None]
    blind = available / jnp.sum(available, axis=-1, keepdims=True)
    blind = jnp.broadcast_to(blind, (*expert.shape[:-1], blind.shape[-1]))
    return WorldEvaluation(
        **details,
        policy=np.asarray(policies[chosen]),
        status=np.asarray(codes[chosen]),
        performance={
            "learned": performances[chosen],
            "expert": _probability(model, expert, hparams.horizon),
            "random": _probability(model, blind.astype(expert.dtype), hparams.horizon),
        },
        seeds=np.stack([np.asarray(performance.mean) for performance in performances]),
    )


def _plans(
    setup: TodirlSetup, network: object, parameters: PyTree, hparams: todirl.Hparams, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Plans of all and of optimal actions in the first worlds, one at a time, and statuses."""
    worlds, masks = setup.worlds, np.stack([x.allowed for x in setup.optimal or ()])
    plans, codes = [], np.zeros(count, np.int32)
    for mask in (np.asarray(jax.vmap(lambda model: model.available)(worlds.model)), masks):
        each = []
        for w in range(count):
            only = slice(w, w + 1)
            model, seen, allowed = part_of((worlds.model, worlds.observation, mask), only)
            policy, status = _plan(
                network, parameters, replace(model, allowed=allowed), seen, hparams
            )
            each.append(np.asarray(policy)[0])
            codes[w] = max(codes[w], int(status[0]))
        plans.append(np.stack(each))
    return plans[0], plans[1], codes


@partial(jax.jit, static_argnames=("network",))
def _plan(
    network: todirl.RewardNetwork,
    parameters: PyTree,
    model: Product,
    observation: jax.Array,
    hparams: todirl.Hparams,
) -> tuple[jax.Array, jax.Array]:
    """Policies ``float[W, S, Q, A]``, with a horizon ``[W, T, S, Q, A]``, and statuses."""

    def one(world: tuple[Product, jax.Array]) -> tuple[jax.Array, jax.Array]:
        solution = todirl.plan(network, parameters, *world, hparams)
        return solution.policy, solution.status

    return lax.map(one, (model, observation), batch_size=_BATCH)


@jax.jit
def _expert(models: Product, discount: float, rewards: Mapping[str, float]) -> jax.Array:
    def one(model: Product) -> jax.Array:
        reward = temporal_gridworld.expert_reward(model, **rewards)
        return soft_value(model, reward, discount, method="value_iteration").policy

    return lax.map(one, models, batch_size=_BATCH)


def _probability(model: Product, policy: jax.Array, horizon: int | None) -> Performance:
    if horizon is None:
        return task_performances(model, policy)
    if policy.ndim == 4:
        shape = (policy.shape[0], horizon, *policy.shape[1:])
        policy = jnp.broadcast_to(policy[:, None], shape)
    return step_bounded_performances(model, policy)


def save(out: Path, outcome: TodirlOutcome) -> None:
    """Writes ``network.npz`` and, for each training world, ``policy_1.npz`` and so on.

    :func:`jaxltl.io.load_reward` reads the network, and :func:`jaxltl.io.load_policy` a policy, whose
    file also has the satisfaction probabilities ``satisfaction [S]``.
    """
    for pattern in ("policy_*.npz", "training_*.svg", "test_*.svg"):
        for stale in out.glob(pattern):
            stale.unlink()
    save_reward(out / "network.npz", learned_reward(outcome))
    worlds, evaluation = outcome.setup.worlds, outcome.evaluation
    for w, scene in enumerate(worlds.scenes[: outcome.setup.num_training]):
        size = scene.mdp.num_states
        model = replace(part_of(worlds.model, w), mdp=scene.mdp)
        model = replace(model, letter=model.letter[:size])
        policy = evaluation.policy[w][..., :size, :, :]
        value = evaluation.performance["learned"].value[w, :size]
        save_policy(
            out / f"policy_{w + 1}.npz",
            project_policy(model, policy, actions=ACTIONS),
            {"satisfaction": value},
        )


def learned_reward(outcome: TodirlOutcome) -> LearnedReward:
    """The kept seed's reward with the parameters of planning."""
    task, i = outcome.setup.task, outcome.chosen
    kinds = COLORS if task.is_colored else (*cell_kinds(task.world), "off the map")
    return LearnedReward(
        parameters=part_of(outcome.learned.parameters, i),
        hidden=tuple(task.learner.hidden),
        memory=outcome.setup.memory,
        label_on=task.label_on,
        discount=task.learner.discount,
        horizon=task.learner.horizon,
        radius=task.learner.radius,
        formula=task.formula,
        kinds=tuple(kinds),
        guarantee=outcome.setup.requested,
        over=task.over,
        steps_factor=task.steps_factor,
    )


# --- a satisfaction probability in every world --------------------------------------------


_AIM = WINDOW / 4  # margin of the certified probability over the asked one
_WEIGHTS = 10.0 ** np.arange(-1, 5.5, 0.5)  # of the satisfaction probability, in this order
_HALVINGS = 5  # few bisections of the weight, since the mixture closes the gap


def check_attainable(setup: TodirlSetup) -> None:
    """Raises ValueError for a probability that no policy attains in a world that counts."""
    task, scenes = setup.task, setup.worlds.scenes
    for w, (scene, optimal) in enumerate(zip(scenes, setup.optimal or (), strict=True)):
        if w >= setup.num_training and scene.name in task.left_out:
            continue
        try:
            require_attainable(
                part_of(setup.worlds.model, w),
                optimal.best,
                float(setup.requested),
                task.over,
                scene.position_text,
            )
        except ValueError as error:
            kind = "training" if w < setup.num_training else "test"
            fix = "" if kind == "training" else " Or name it in [test] leave_out."
            raise ValueError(
                f"{task.path}: [task] in the {kind} world {scene.name}: {error}{fix}"
            ) from None


def hold(setup: TodirlSetup, policy: np.ndarray, inside: np.ndarray) -> list[Mixture]:
    """Mixes plans ``[W, S, Q, A]`` of all actions and of optimal ones, in the first W worlds."""
    requested, over = float(setup.requested), setup.task.over
    return [
        reaching(
            part_of(setup.worlds.model, w), policy[w], inside[w], optimal.best, requested, over=over
        )
        for w, optimal in enumerate((setup.optimal or [])[: len(policy)])
    ]


def step_bounds(setup: TodirlSetup) -> list[StepBound] | None:
    """The bounds on the expected steps in all worlds; None for safety formulas."""
    task, bounds = setup.task, []
    for w, (scene, best) in enumerate(zip(setup.worlds.scenes, setup.optimal or (), strict=True)):
        with errors_in(f"{task.path}: [task] in the world {scene.name}: "):
            model = part_of(setup.worlds.model, w)
            bound = step_bound(
                model, best, setup.requested, task.over, task.steps, task.steps_factor
            )
        if bound is None:
            return None
        bounds.append(bound)
    return bounds


def within_steps(setup: TodirlSetup, bounds: list[StepBound], policy: np.ndarray) -> list[Mixture]:
    """The policies ``[W, S, Q, A]`` of all worlds with their expected steps within the bounds."""
    mixtures = []
    for w, bound in enumerate(bounds):
        model = part_of(setup.worlds.model, w)
        mixture = bound.keep(model, policy[w])
        mixtures.append(
            mixture._replace(steps=mixture.steps or StepAnalysis(model).steps(mixture.policy))
        )
    return mixtures


def likeliest(
    setup: TodirlSetup,
    counts: np.ndarray,
    free: LearnedRewards,
    train: Callable[[float], LearnedRewards] | None,
    plans: Callable[[LearnedRewards], tuple[np.ndarray, np.ndarray]],
) -> Attempt:
    """The network of greatest likelihood over some weights."""
    models = [part_of(setup.worlds.model, w) for w in range(setup.num_training)]

    def attempt(learned: LearnedRewards, weight: float) -> Attempt:
        policy, inside = plans(learned)
        held = np.stack([one.policy for one in hold(setup, policy, inside)])
        loss = neg_log_likelihood(held[:, : counts.shape[1]], counts)
        each = [attained(m, p, setup.task.over) for m, p in zip(models, policy, strict=True)]
        # The least certified probability over the training worlds, before mixing.
        return Attempt(held, loss, min(each), weight, 0.0, learned)

    attempts = [attempt(free, 0.0)]
    if attempts[0].attained < float(setup.requested) and train is not None:
        attempts += _bracket(lambda mu: attempt(train(mu), mu), float(setup.requested))
    return min(attempts, key=lambda one: np.nan_to_num(one.neg_log_likelihood, nan=np.inf))


def _bracket(tried: Callable[[float], Attempt], requested: float) -> Iterator[Attempt]:
    """Yields attempts with increasing weights until one suffices, then by bisection."""
    # The likelihood has several maxima, and those found from too large a weight are lower.
    low = 0.0
    for high in map(float, _WEIGHTS):
        last = tried(high)
        yield last
        if last.attained >= requested:
            break
        low = high
    else:
        return
    low = low or high * 1e-3
    for _ in range(_HALVINGS):
        if requested <= last.attained <= requested + _AIM:
            return
        middle = float(np.sqrt(low * high))
        last = tried(middle)
        yield last
        low, high = (low, middle) if last.attained >= requested else (middle, high)
