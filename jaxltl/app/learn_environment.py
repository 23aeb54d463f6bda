"""Reinforcement learning in a simulated environment: the jobs of ppo, cce and cpo.

The kept seed is selected by separate episodes, so that its intervals, which are from fresh
episodes, have no selection bias.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.common.guarantees import check_formula
from jaxltl.algos.common.seeds import Training, run_seeds
from jaxltl.core.validation import errors_in
from jaxltl.core.files import atomic_write
from jaxltl.plot.drawing import Picture, automaton_picture
from jaxltl.app.environment_setup import LearnerSetup, load_environment, load_world, make_method
from jaxltl.app.reports.learn_environment import Proof, proof_entry, proof_picture, report as report
from jaxltl.app.reports.page import Section, learning_curves
from jaxltl.app.files.task_rl import EnvironmentFile
from jaxltl.app.wording import Record, about, counted, plain
from jaxltl.core.types import Status
from jaxltl.core.automata import Automaton, to_automaton
from jaxltl.core.continuous import Dynamics, certify_policy, counterexample, state_policy
from jaxltl.core.environments.environment import Environment, Finite
from jaxltl.core.environments.episodes import Agent, Episode, run_episode
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.environments.task_reward import is_discounted, make_task_reward
from jaxltl.core.logic.labels import require_known
from jaxltl.core.values.evaluation.evaluation import (
    ESTIMATES,
    Estimate,
    Evaluation,
    checked_steps,
)
from jaxltl.core.values.evaluation.selection import select_agent
from jaxltl.core.policies.policy_file import read_policy_file
from jaxltl.io.network_policy import save_network
from jaxltl.core.models.protocols import PyTree

FILE = EnvironmentFile
DOUBLE = False  # environments are written for single precision
_DRAWN = 4  # trajectories

Report = Callable[[str], None]


@dataclass(frozen=True)
class EnvironmentSetup:
    """A task, ready for learning."""

    task: EnvironmentFile  # the file
    automaton: Automaton  # of the formula
    environment: Environment  # the world with the task
    method: LearnerSetup  # the learner
    num_steps: int  # limit of an episode in the evaluation
    trivial: str | None  # remark on a formula that is always true
    dynamics: Dynamics | None = None  # of a continuous world, in which the policy is proven

    @property
    def acts(self) -> str:
        """Actions of the evaluated policy; in dynamics by default those of the proof."""
        default = "drawn" if self.dynamics is None else "likeliest"
        return self.task.evaluation.policy or default


@dataclass
class EnvironmentOutcome:
    """Learned policies of all seeds and their evaluations."""

    setup: EnvironmentSetup  # the task
    states: PyTree  # of the learner, with a first axis of N seeds
    history: Mapping[str, np.ndarray]  # metrics [T, N] and step [T]
    chosen: int  # index of the kept seed
    evaluations: list[Evaluation]  # of every seed, from fresh episodes
    episodes: list[Episode]  # some of the kept policy, for pictures
    seed: int  # the first seed
    proof: Proof | str | None = None  # or the reason for which there is none

    @cached_property
    def picture(self) -> Picture | None:
        """Some episodes, if the world has positions; drawn here, since its code is the user's."""
        # Deferred: matplotlib.
        from jaxltl.plot.episodes import draw_episodes
        from jaxltl.plot.style import to_bytes

        ends = [(int(np.sum(one.valid)), np.asarray(one.world.verdict)) for one in self.episodes]
        titles = [f"{Verdict(int(v[t])).name.lower()} after {counted(t, 'step')}" for t, v in ends]
        try:
            figure = draw_episodes(self.setup.environment, self.episodes, titles=titles)
        except ValueError:
            return None
        return Picture(
            "episodes.svg",
            "A few episodes",
            to_bytes(figure),
            "The first episodes of the kept policy, without selection; episode.html plays the first.",
        )


def prepare(
    task: EnvironmentFile, seed: int, world: Environment | Dynamics | None = None
) -> EnvironmentSetup:
    """The environment with its task and the learner; ValueError for a task that does not fit."""
    del seed
    loaded = load_world(task) if world is None else world
    dynamics = loaded if isinstance(loaded, Dynamics) else None
    if dynamics is not None and task.task.ending is not None:
        raise ValueError(
            f"{task.path}: [task] ending = {task.task.ending!r}: dynamics define by outside= what leaving the "
            "domain means, for episodes and the proof alike; remove ending."
        )
    world = load_environment(task, loaded)
    with errors_in(f"{task.path}: [task] formula: "):
        automaton = to_automaton(task.formula)
    with errors_in(f"{task.path}: [task] "):
        trivial = check_formula(automaton)
    if automaton.propositions and not world.propositions:
        raise ValueError(
            f"{task.path}: [world] environment {task.world.function!r} has no labels, and "
            f"the formula mentions {', '.join(automaton.propositions)}: give labels = "
            '"file.py:function" and propositions = [...].'
        )
    with errors_in(f"{task.path}: [task] formula: "):
        require_known(automaton.propositions, world.propositions, f"{task.formula!r}")
    with errors_in(f"{task.path}: [task] "):
        environment = task_environment(world, automaton, **_reward(task, automaton))
    steps = task.evaluation.steps
    if steps is None and world.horizon is None:
        raise ValueError(
            f"{task.path}: [world] the environment has no horizon: give horizon = N, after which "
            "episodes are truncated, or steps = N in [evaluation]."
        )
    num_steps = checked_steps(environment, steps)
    with errors_in(f"{task.path}: [{task.learner.method}] "):
        method = make_method(task, environment, num_steps)
    return EnvironmentSetup(task, automaton, environment, method, num_steps, trivial, dynamics)


def _reward(task: EnvironmentFile, automaton: Automaton) -> Record:
    """The options of the reward, shaped by default where that changes no optimal policy."""
    reward_options = task.task.specified()
    del reward_options["formula"]
    shaping = reward_options.pop("shaping", "auto")
    own = getattr(task.settings, "discount", 1.0) or 1.0  # the learner's, which shaping regards
    if shaping == "auto":
        shaping = "none"
        options = {key: value for key, value in reward_options.items() if key != "ending"}
        plain = make_task_reward(automaton, verdicts(automaton), **options)
        # Others compare rewards of whole episodes, which keep the potential where they are cut off.
        if task.learner.method == "ppo" and is_discounted(plain.discount, verdicts(automaton), own):
            shaping = "distance"
            if plain.name in ("reach", "keep"):  # with shaping the default would be less than 1
                reward_options.setdefault("discount", 1.0)
    if shaping == "none":
        return reward_options
    return {**reward_options, "shaping": shaping, "learner_discount": own}


def describe(setup: EnvironmentSetup) -> str:
    """Sizes of the environment, of learning and of the evaluation, as text."""
    task, environment = setup.task, setup.environment
    actions = environment.actions
    key, world = jax.random.key(0), environment
    shapes = jax.eval_shape(lambda key: world.observe(world.reset(key)), key)
    seen = sum(x.size for x in jax.tree.leaves(shapes))
    does = (
        f"{actions.num} actions"
        if isinstance(actions, Finite)
        else f"actions in a box {list(actions.shape)}"
    )
    steps, most = task.learner.steps, setup.method.transitions
    return (
        f"{task.world.function}: {does}, {counted(seen, 'number')} observed, "
        f"{counted(len(environment.propositions), 'label')}; {counted(len(setup.automaton.delta), 'automaton state')} "
        f"({setup.automaton.acceptance}); {task.learner.method} with "
        f"{setup.method.description}: {counted(steps, 'step')} of at most {most:,} simulated steps, "
        f"{steps * most:,} in total per seed; evaluated by {task.evaluation.episodes:,} fresh "
        f"episodes of at most {counted(setup.num_steps, 'step')}"
    )


def learn(setup: EnvironmentSetup, training: Training) -> EnvironmentOutcome:
    """Learns with N seeds, selects the best by separate episodes, and evaluates all of them."""
    method, seed, num_seeds = setup.method, training.seed, training.num_seeds
    parts = method.algorithm, method.problem, method.hparams
    chunks, history = run_seeds(*parts, training, num_steps=setup.task.learner.steps)
    # A single cost of a search is a curve like others.
    history = {k: v[..., 0] if v.shape[2:] == (1,) else v for k, v in history.items()}
    key = jax.random.fold_in(jax.random.key(seed), 2)  # distinct from all keys of the learner
    states = [jax.tree.map(lambda x, i=i: x[i], chunks.state) for i in range(num_seeds)]
    agents = [_acting(setup, state) for state in states]
    table = setup.task.evaluation
    chosen, each = select_agent(
        key,
        agents,
        setup.environment,
        setup.automaton,
        num_episodes=table.episodes,
        num_steps=setup.num_steps,
        confidence=table.confidence,
        threshold=table.threshold,
        discount=table.discount,
        report=training.stage,
    )
    training.stage("drawing")
    drawing = jax.random.split(key, 3)[2]
    run = partial(jax.jit(run_episode, static_argnames="num_steps"), num_steps=setup.num_steps)
    episodes = [
        jax.device_get(run(jax.random.fold_in(drawing, i), setup.environment, agents[chosen]))
        for i in range(_DRAWN)
    ]
    proof: Proof | str | None = None
    if setup.dynamics is not None:
        agent = setup.method.agent(states[chosen], True)  # without random actions
        try:
            proof = prove(setup, agent, setup.task.formula, training.stage)
        except ValueError as reason:  # such as an operation that has no enclosure
            proof = str(reason)
    return EnvironmentOutcome(setup, chunks.state, history, chosen, each, episodes, seed, proof)


def prove(setup: EnvironmentSetup, agent: Agent, formula: str, say: Report) -> Proof:
    """The certificate of an agent that was learned in dynamics, and a run if it is refuted."""
    assert setup.dynamics is not None
    table = setup.task.proof
    policy = state_policy(agent, setup.environment)
    certificate = certify_policy(setup.dynamics, policy, formula, report=say, **table.specified())
    if certificate.initial_bounds[1] >= (table.threshold or 1 - (table.tolerance or 1e-3)):
        return Proof(certificate)
    say("searching a run that violates the formula")
    key, steps = jax.random.key(0), setup.num_steps
    run = counterexample(key, setup.dynamics, policy, formula, certificate, steps)
    return Proof(certificate, run)


def _acting(setup: EnvironmentSetup, state: PyTree) -> Agent:
    return setup.method.agent(state, setup.acts == "likeliest")


# --- results ----------------------------------------------------------------------------------


def summary(outcome: EnvironmentOutcome) -> Record:
    """The result as a JSON object."""
    setup, history = outcome.setup, outcome.history
    task, environment = setup.task, setup.environment
    last = {name: history[name][-1, outcome.chosen] for name in _drawn(outcome)}
    status = history["status"][:, outcome.chosen]
    # Simulated steps of a seed: the learner's count, or an upper bound.
    made, upper = history.get("transitions"), task.learner.steps * setup.method.transitions
    return plain(
        {
            **about(task.name, task.formula, task.learner.method),
            "environment": {
                "name": task.world.function,
                "arguments": task.world.arguments,
                "propositions": list(environment.propositions),
                "horizon": environment.horizon,
                "actions": environment.actions.num
                if isinstance(environment.actions, Finite)
                else list(environment.actions.shape),
            },
            "num_memory": len(setup.automaton.delta),
            "acceptance": setup.automaton.acceptance,
            "trivial": setup.trivial,
            "policy": {"made_of": setup.method.description, "acts": setup.acts},
            "evaluation": _as_numbers(outcome.evaluations[outcome.chosen]),
            "training": {
                "steps": task.learner.steps,
                "transitions": upper if made is None else int(made[-1, 0]),
                "troubled_rows": int((status > Status.COMPLETED).sum()),
                "last": last,
                "hyperparameters": task.settings.specified(),
            },
            "seeds": {
                "first": outcome.seed,
                "number": len(outcome.evaluations),
                "kept": outcome.chosen,
                "evaluations": [_as_numbers(x) for x in outcome.evaluations],
            },
            "drawn": outcome.picture is not None,
            "proof": None if outcome.proof is None else proof_entry(outcome.proof),
        }
    )


def _as_numbers(evaluation: Evaluation) -> Record:
    return {
        **{k: vars(x) if isinstance(x, Estimate) else x for k, x in vars(evaluation).items()},
        "status": evaluation.status.name,
        "estimates": [n for n in ESTIMATES if getattr(evaluation, n) is not None],
    }


def _drawn(outcome: EnvironmentOutcome) -> list[str]:
    """Names of the scalar metrics with finite values."""
    metrics = ((name, outcome.history[name]) for name in outcome.setup.method.drawn)
    return [name for name, x in metrics if x.ndim == 2 and np.isfinite(x).any()]


def task_pictures(setup: EnvironmentSetup) -> list[Picture]:
    """Picture of the formula's automaton."""
    return [automaton_picture(setup.automaton, "")]


def sections(outcome: EnvironmentOutcome) -> list[Section]:
    """The proof, episodes and learning curves."""
    dynamics, proof, drawn = outcome.setup.dynamics, outcome.proof, outcome.picture
    parts: list[Section] = []
    if dynamics is not None and isinstance(proof, Proof):
        parts.append(proof_picture(proof, dynamics, outcome.episodes))
    parts += [] if drawn is None else [drawn]
    caption, count = "Metrics of each step of the learner", len(outcome.evaluations)
    return parts + learning_curves(outcome.history, _drawn(outcome), caption, count)


def save(out: Path, outcome: EnvironmentOutcome) -> None:
    """Writes ``policy.npz`` and, if the world has positions, ``episode.html`` into a directory."""
    from jaxltl.plot.episodes import play_episode

    one = jax.tree.map(lambda x: x[outcome.chosen], outcome.states)
    task = outcome.setup.task
    save_network(
        out / "policy.npz",
        _acting(outcome.setup, one),
        outcome.setup.environment,
        automaton=outcome.setup.automaton,
        more={
            **dict(_parts(outcome.setup.method, one)),
            "task": task.raw.decode(),
            "task_file": str(task.path.absolute()),
        },
    )
    try:
        page = play_episode(outcome.setup.environment, outcome.episodes[0])
    except ValueError:
        return
    with atomic_write(out / "episode.html") as file:
        file.write(page.encode())


def _parts(method: LearnerSetup, state: PyTree) -> list[tuple[str, PyTree]]:
    """Names and arrays of a state that determine a policy."""
    fields = {name: getattr(state, name) for name in method.policy_fields}
    leaves, _ = jax.tree_util.tree_flatten_with_path(fields)
    return [(jax.tree_util.keystr(path, simple=True, separator="."), x) for path, x in leaves]


def load_agent(
    policy_file: str | Path,
    *,
    environment: Environment | Dynamics | None = None,
    task_file: str | Path | None = None,
) -> tuple[Environment, Agent]:
    """Agent that ``jaxltl learn`` wrote for an environment, and the environment with the formula.

    :func:`jaxltl.io.load_policy` reads the same file without the environment.

    The file has the text of its task file, but no code: the function that makes the environment is
    imported, from a package or from the directory of the task file or of the policy. Load only
    policies that you trust, or give `environment`: then nothing is imported.

    Raises:
      ValueError: a missing file, or one that is no policy of this task; an invalid task, or
        missing functions.

    Example: ``environment, agent = load_agent("out/policy.npz")``.
    """
    setup, agent = load_policy(Path(policy_file), environment, task_file)
    return setup.environment, agent


def load_policy(
    policy_file: Path,
    environment: Environment | Dynamics | None = None,
    task_file: str | Path | None = None,
) -> tuple[EnvironmentSetup, Agent]:
    """The task of a policy file, and its agent; see :func:`load_agent`."""
    arrays = read_policy_file(policy_file)
    task = EnvironmentFile.read(task_file) if task_file else _kept_task(policy_file, arrays)
    setup = prepare(task, 0, environment)
    method = setup.method
    state = method.state_shapes()
    for name, x in _parts(method, state):
        array = arrays.get(name)
        if array is None or array.shape != x.shape:
            is_ = "missing" if array is None else f"of shape {list(array.shape)}"
            raise ValueError(
                f"{policy_file}: {name} is {is_}, and the policy of {task.path} has one of "
                f"{list(x.shape)}; give the file that was learned from this task, in this "
                "environment."
            )
    fields = {name: getattr(state, name) for name in method.policy_fields}
    leaves = [jnp.asarray(arrays[name], x.dtype) for name, x in _parts(method, state)]
    state = replace(state, **jax.tree.unflatten(jax.tree.structure(fields), leaves))
    return setup, _acting(setup, state)


def _kept_task(policy_file: Path, arrays: Mapping[str, np.ndarray]) -> EnvironmentFile:
    """The task of a policy file, in the directory that has the files that it names."""
    if not all(name in arrays and arrays[name].dtype.kind == "U" for name in ("task", "task_file")):
        raise ValueError(
            f"{policy_file}: no task is kept with it, as jaxltl learn does for environments; give "
            "the policy.npz of such a job, or task_file=."
        )
    path, raw = Path(str(arrays["task_file"])), str(arrays["task"]).encode()
    beside = policy_file.absolute().parent
    named = EnvironmentFile.read(path, raw).named_files()
    complete = (x for x in (path.parent, beside) if all((x / name).is_file() for name in named))
    return EnvironmentFile.read(next(complete, path.parent) / path.name, raw)


def certify_policy_file(policy: Path, formula: str | None, say: Report) -> Proof:
    """Proves a policy that ``jaxltl learn`` wrote in dynamics; by default for its task's formula."""
    setup, agent = load_policy(policy)
    if setup.dynamics is None:
        raise ValueError(
            f"{policy}: its world {setup.task.world.function!r} is a simulator; proofs need dynamics of "
            "make_dynamics."
        )
    return prove(setup, agent, formula or setup.task.formula, say)
