"""From a simulated world and a formula to a network with its evidence, for `jaxltl learn`.

Seeds learn side by side. With several, one is kept by episodes that nothing else is told of, so
that the intervals of the kept one, which are from fresh episodes, are what they say.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxltl.algos.common.checkpoint import atomic_write, read_arrays
from jaxltl.app._environment_learners import Method, make_method
from jaxltl.app.drawing import Picture, drawing
from jaxltl.app.environment_source import load_environment
from jaxltl.app.explorer import Curves, curves
from jaxltl.app.files.tables import errors_in, read_bytes
from jaxltl.app.files.task import many
from jaxltl.app.files.task_environment import EnvironmentTask, named_files
from jaxltl.app.files.task_environment import read_task as read_task
from jaxltl.app.guarantee import check_formula
from jaxltl.app.job import (
    Report,
    about,
    automaton_picture,
    over_seeds,
    plain,
    run_seeds,
    save_arrays,
    took,
)
from jaxltl.app.job import fingerprint as fingerprint
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.environment import Environment, Finite, require_environment
from jaxltl.core.environments.episodes import Agent, Episode, run_episode
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.logic.labels import require_known
from jaxltl.core.values.evaluation.evaluation import (
    ESTIMATES,
    Estimate,
    Evaluation,
    checked_steps,
    evaluate,
)

DOUBLE = False  # the precision of its figures
STEPS = 1  # never used: a file says how many
EPISODES = 1000  # of the evaluation, unless the file says otherwise
_DRAWN = 4  # trajectories


@dataclass(frozen=True)
class Setup:
    """A task file's contents as the library's objects; see :func:`prepare`.

    Attributes:
      task: the file.
      automaton: of the formula.
      environment: the world with the task.
      method: the learner.
      num_steps: after which an episode of the evaluation is cut off.
      trivial: what is to be said of a formula that is always true.
    """

    task: EnvironmentTask
    automaton: Automaton
    environment: Environment
    method: Method
    num_steps: int
    trivial: str | None


@dataclass(frozen=True)
class Outcome:
    """A finished job: what was asked, learned and found out about it.

    Attributes:
      setup: what was asked.
      states: of the learner, with a first axis of N seeds.
      history: metrics ``[T, N]`` and ``step [T]``.
      chosen: the seed's position that is kept.
      evaluations: of every seed, from fresh episodes.
      episodes: a few of the kept policy.
      seed: the first of the seeds.
      seconds: spent.
    """

    setup: Setup
    states: Any
    history: Mapping[str, np.ndarray]
    chosen: int
    evaluations: list[Evaluation]
    episodes: list[Episode]
    seed: int
    seconds: float


def prepare(task: EnvironmentTask, seed: int, world: Environment | None = None) -> Setup:
    """The world with its task, and the learner; all that the file names checked.

    Args:
      task: the file.
      seed: nothing is drawn here.
      world: in place of the one that the file names.

    Raises:
      ValueError: something in the file, or in what it names, is wrong.
    """
    del seed
    world = load_environment(task, world)
    with errors_in(f"{task.path}: [task] formula: "):
        automaton = to_automaton(task.formula)
    with errors_in(f"{task.path}: [task] "):
        trivial = check_formula(automaton)
    if automaton.propositions and not world.propositions:
        raise ValueError(
            f"{task.path}: [world] environment {task.world['environment']!r} has no labels, and "
            f"the formula mentions {', '.join(automaton.propositions)}: give labels = "
            '"file.py:function" and propositions = [...].'
        )
    with errors_in(f"{task.path}: [task] formula: "):
        require_known(automaton.propositions, world.propositions, f"{task.formula!r}")
    with errors_in(f"{task.path}: [task] "):
        environment = task_environment(world, automaton, **task.reward)
    steps = task.evaluation.get("steps")
    if steps is None and world.horizon is None:
        raise ValueError(
            f"{task.path}: [world] the environment's episodes never end, as far as it says: give "
            "horizon = N, after which they are truncated, or steps = N in [evaluation]."
        )
    num_steps = checked_steps(environment, steps)
    with errors_in(f"{task.path}: [{task.method}] "):
        method = make_method(task, environment, num_steps)
    return Setup(task, automaton, environment, method, num_steps, trivial)


def describe(setup: Setup) -> str:
    """What a task comes to, in one line."""
    task, made = setup.task, setup.environment
    actions = made.actions
    seen = sum(x.size for x in jax.tree.leaves(_shapes(setup)))
    does = (
        f"{actions.num} actions"
        if isinstance(actions, Finite)
        else f"actions in a box {list(actions.shape)}"
    )
    steps = task.learner["steps"]
    return (
        f"{task.world['environment']}: {does}, {many(seen, 'number')} observed, "
        f"{many(len(made.propositions), 'label')}; {many(len(setup.automaton.delta), 'state')} of "
        f"the task's memory ({setup.automaton.acceptance}); {task.method} with "
        f"{setup.method.told}: {many(steps, 'step')} of at most "
        f"{setup.method.transitions:,} simulated steps, {steps * setup.method.transitions:,} in "
        f"all, a seed; judged by {_num_episodes(task):,} fresh episodes of at most "
        f"{many(setup.num_steps, 'step')}"
    )


def _shapes(setup: Setup) -> Any:
    made = setup.environment
    return jax.eval_shape(lambda key: made.observe(made.reset(key)), jax.random.key(0))


def _num_episodes(task: EnvironmentTask) -> int:
    return int(task.evaluation.get("episodes", EPISODES))


def postfix(figures: Mapping[str, np.ndarray]) -> dict[str, str]:
    """What the progress bar tells of the newest figures."""
    names = ("episode_return", "objective", "reward", "cost")
    known = [n for n in names if n in figures and np.isfinite(figures[n]).any()]
    return {n: f"{np.nanmedian(figures[n]):.3g}" for n in known[:2]}


def learn(
    setup: Setup,
    seed: int,
    num_seeds: int,
    *,
    report: Report | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[str], None] = lambda stage: None,
    mesh: Mesh | None = None,
) -> tuple[Any, Mapping[str, np.ndarray], int, list[Evaluation], list[Episode]]:
    """Learns with N seeds, keeps the best, and evaluates all of them; see :class:`Outcome`.

    What it is at is told to `report`, steps and figures, and to `progress`, the stage's name.
    """
    task, method = setup.task, setup.method
    found, history = run_seeds(
        method.algorithm,
        (seed, num_seeds),
        method.problem,
        method.hparams,
        report,
        num_steps=task.learner["steps"],
        checkpoint=checkpoint,
        mesh=mesh,
    )
    # One cost of a search is a number like the others.
    history = {k: v[..., 0] if v.shape[2:] == (1,) else v for k, v in history.items()}
    # No key of the learner's is one of these.
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), 2), 3)
    agents = [_agent(setup, found.state, i) for i in range(num_seeds)]
    chosen = 0
    if num_seeds > 1:
        progress("choosing")
        chosen = max(
            range(num_seeds),
            key=lambda i: _merit(setup, _evaluated(keys[0], agents[i], setup, threshold=False)),
        )
    progress("evaluating")
    each = [
        _evaluated(keys[1], agent, setup, threshold=i == chosen) for i, agent in enumerate(agents)
    ]
    progress("drawing")
    run = jax.jit(run_episode, static_argnames="num_steps")
    shown = [
        jax.device_get(
            run(
                jax.random.fold_in(keys[2], i),
                setup.environment,
                agents[chosen],
                num_steps=setup.num_steps,
            )
        )
        for i in range(_DRAWN)
    ]
    return found.state, history, chosen, each, shown


def _agent(setup: Setup, states: Any, i: int) -> Agent:
    """What a seed learned."""
    return _acting(setup, jax.tree.map(lambda x: x[i], states))


def _acting(setup: Setup, state: Any) -> Agent:
    likeliest = setup.task.evaluation.get("policy") == "likeliest"
    return setup.method.agent(state, likeliest)


def _evaluated(key: jax.Array, agent: Agent, setup: Setup, *, threshold: bool) -> Evaluation:
    asked = setup.task.evaluation
    return evaluate(
        key,
        agent,
        setup.environment,
        num_episodes=_num_episodes(setup.task),
        num_steps=setup.num_steps,
        confidence=asked.get("confidence", 0.95),
        discount=asked.get("discount"),
        threshold=asked.get("threshold") if threshold else None,
    )


def _merit(setup: Setup, found: Evaluation) -> tuple[float, float, float]:
    """By which seeds are compared: what is decided first, then how often it accepts."""
    success, violation, visits = found.success, found.violation, found.visits
    assert success is not None and violation is not None and visits is not None
    if setup.automaton.acceptance == "safety":  # which a run that goes on does not violate
        return -violation.mean, success.mean, 0.0
    if setup.automaton.acceptance == "cosafe":
        return success.mean, -violation.mean, -found.length.mean
    return success.mean - violation.mean, visits.mean, 0.0


# --- what is told -----------------------------------------------------------------------------


def summary(outcome: Outcome) -> dict[str, Any]:
    """The outcome as numbers, lists and texts, for ``result.json``; NaN becomes None."""
    setup, history = outcome.setup, outcome.history
    task, made, kept = setup.task, setup.environment, outcome.evaluations[outcome.chosen]
    last = {name: history[name][-1, outcome.chosen] for name in _drawn(outcome)}
    status = history["status"][:, outcome.chosen]
    return plain(
        {
            **about(task),  # type: ignore[arg-type]
            "environment": {
                "name": task.world["environment"],
                "arguments": task.world.get("arguments", {}),
                "propositions": list(made.propositions),
                "horizon": made.horizon,
                "actions": made.actions.num
                if isinstance(made.actions, Finite)
                else list(made.actions.shape),
            },
            "num_memory": len(setup.automaton.delta),
            "acceptance": setup.automaton.acceptance,
            "trivial": setup.trivial,
            "policy": {
                "made_of": setup.method.told,
                "acts": task.evaluation.get("policy", "drawn"),
            },
            "evaluation": _as_numbers(kept),
            "training": {
                "steps": int(task.learner["steps"]),
                "transitions": _transitions(outcome),
                "troubled_rows": int((status != 0).sum()),
                "last": last,
                "hyperparameters": dict(task.settings),
            },
            "seeds": {
                "first": outcome.seed,
                "number": len(outcome.evaluations),
                "kept": outcome.chosen,
                "evaluations": [_as_numbers(x) for x in outcome.evaluations],
            },
            "drawn": _pictured(outcome) is not None,
            **took(outcome.seconds),
        }
    )


def _transitions(outcome: Outcome) -> int:
    """Simulated steps of a seed: counted by the learner, or at most."""
    counted = outcome.history.get("transitions")
    most = outcome.setup.task.learner["steps"] * outcome.setup.method.transitions
    return int(counted[-1, 0]) if counted is not None else most


def _as_numbers(found: Evaluation) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    for name, value in vars(found).items():
        numbers[name] = vars(value) if isinstance(value, Estimate) else value
    return {
        **numbers,
        "status": found.status.name,
        "estimates": [n for n in ESTIMATES if getattr(found, n) is not None],
    }


def _drawn(outcome: Outcome) -> list[str]:
    """The names of the learning curves: those that are numbers, one for each seed."""
    history = outcome.history
    return [
        n
        for n in outcome.setup.method.figures
        if history[n].ndim == 2 and np.isfinite(history[n]).any()
    ]


def task_pictures(setup: Setup) -> list[Picture]:
    """The report's pictures that nothing has to be learned for."""
    return [automaton_picture(setup.automaton, "")]


def pictures(outcome: Outcome) -> list[Picture]:
    """The report's pictures of what was learned."""
    history, names = outcome.history, _drawn(outcome)
    found = [
        Picture(
            "learning.svg",
            "Learning",
            drawing("curves", {k: history[k].T for k in names}, steps=history["step"], show=names),
            "Figures of each step of the learner" + over_seeds(len(outcome.evaluations)),
            "learning",
        )
    ]
    drawn = _pictured(outcome)
    return found if drawn is None else [drawn, *found]


def live(outcome: Outcome) -> list[Curves]:
    """The parts of the report that are drawn by the page."""
    caption = "Figures of each step of the learner" + over_seeds(len(outcome.evaluations))
    return [curves("learning", "Learning", caption, outcome.history, _drawn(outcome))]


_SAYS = {Verdict.SATISFIED: "done", Verdict.VIOLATED: "failed", Verdict.UNDECIDED: "undecided"}


def _pictured(outcome: Outcome) -> Picture | None:
    """A few trajectories, where the world has places; drawn here, since it may be anybody's."""
    # Deferred: matplotlib.
    from jaxltl.plot.episodes import draw_episodes
    from jaxltl.plot.style import to_bytes

    titles = []
    for one in outcome.episodes:
        verdict = Verdict(int(np.asarray(one.world.verdict)[int(one.valid.sum())]))
        titles.append(f"{_SAYS[verdict]} after {many(int(one.valid.sum()), 'step')}")
    try:
        figure = draw_episodes(outcome.setup.environment, outcome.episodes, titles=titles)
    except ValueError:
        return None
    return Picture(
        "episodes.svg",
        "A few episodes",
        to_bytes(figure),
        "The first episodes of the policy that is kept, chosen by nothing; episode.html plays "
        "the first.",
    )


def save(out: Path, outcome: Outcome) -> None:
    """Writes ``policy.npz`` and, where the world has places, ``episode.html`` into a directory.

    Arrays of ``policy.npz`` are those of the learner's state that the kept policy is made of, by
    their place in it; with them goes the task file, and where it lay. :func:`load_policy` reads
    them.

    Raises:
      ValueError: the place cannot be written to.
    """
    from jaxltl.plot.episodes import play_episode

    one = jax.tree.map(lambda x: x[outcome.chosen], outcome.states)
    task = outcome.setup.task
    save_arrays(
        out / "policy.npz",
        {
            **dict(_parts(outcome.setup.method, one)),
            "task": task.text,
            "task_file": str(task.path.absolute()),
        },
    )
    try:
        page = play_episode(outcome.setup.environment, outcome.episodes[0])
    except ValueError:
        return
    with atomic_write(out / "episode.html") as file:
        file.write(page.encode())


def _parts(method: Method, state: Any) -> list[tuple[str, Any]]:
    """The arrays of a state that a policy is made of, with their names."""
    kept = {name: getattr(state, name) for name in method.kept}
    leaves, _ = jax.tree_util.tree_flatten_with_path(kept)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), x) for path, x in leaves]


def load_policy(
    policy_file: str | Path,
    *,
    environment: Environment | None = None,
    task_file: str | Path | None = None,
) -> tuple[Environment, Agent]:
    """A policy that ``jaxltl learn`` wrote, and the environment with the task that it is for.

    The file has the text of its task file, but no code: the function that makes the environment is
    imported and called as the task names it. A file of functions is looked for where the task file
    lay, and beside the policy. Do so with policies of those alone whom you trust; of others, give
    `environment`, and nothing is imported.

    Args:
      policy_file: ``policy.npz``.
      environment: in place of what the task names, without its task, but with its labels.
      task_file: in place of what was kept of it.

    Returns:
      What :func:`~jaxltl.core.values.evaluation.evaluation.evaluate` and
      :func:`~jaxltl.core.environments.episodes.run_episode` take.

    Raises:
      ValueError: no such file, or none of a policy; a mistake in the task, or functions that are
        not there; arrays that are not of its policy.

    Of a run into `out`, ``environment, agent = load_policy("out/policy.npz")``, and
    ``evaluate(key, agent, environment)`` gives the evidence anew.
    """
    policy_file = Path(policy_file)
    with errors_in(f"{policy_file}: "):
        arrays = read_arrays(io.BytesIO(read_bytes(policy_file, "the policy")))
    task = read_task(task_file) if task_file else _kept_task(policy_file, arrays)
    setup = prepare(task, 0, None if environment is None else require_environment(environment))
    method = setup.method
    state = jax.eval_shape(
        lambda key: method.algorithm.init(key, method.problem, method.hparams), jax.random.key(0)
    )
    for name, x in _parts(method, state):
        found = arrays.get(name)
        if found is None or found.shape != x.shape:
            is_ = "missing" if found is None else f"of shape {list(found.shape)}"
            raise ValueError(
                f"{policy_file}: {name} is {is_}, and the policy of {task.path} has one of "
                f"{list(x.shape)}; give the file that was learned from this task, in this "
                "environment."
            )
    kept = {name: getattr(state, name) for name in method.kept}
    leaves = [jnp.asarray(arrays[name], x.dtype) for name, x in _parts(method, state)]
    state = replace(state, **jax.tree.unflatten(jax.tree.structure(kept), leaves))
    return setup.environment, _acting(setup, state)


def _kept_task(policy_file: Path, arrays: Mapping[str, np.ndarray]) -> EnvironmentTask:
    """The task in a policy's file, in the folder that has the files that it names."""
    if not all(name in arrays and arrays[name].dtype.kind == "U" for name in ("task", "task_file")):
        raise ValueError(
            f"{policy_file}: no task is kept with it, as jaxltl learn does for environments; give "
            "the policy.npz of such a job, or task_file=."
        )
    path, raw = Path(str(arrays["task_file"])), str(arrays["task"]).encode()
    beside = policy_file.absolute().parent
    named = named_files(read_task(path, raw).world)
    there = [
        folder
        for folder in (path.parent, beside)
        if all((folder / name).is_file() for name in named)
    ]
    return read_task((there or [path.parent])[0] / path.name, raw)
