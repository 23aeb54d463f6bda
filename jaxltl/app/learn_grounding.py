"""Symbol grounding from a task file: the job of files with a table ``[grounding]``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos import grounding
from jaxltl.algos.common.seeds import Training
from jaxltl.algos.grounding.problem import require_task
from jaxltl.app.files.schema import read_bytes
from jaxltl.app.files.task_irl import GroundingFile, read_entry
from jaxltl.app.files.worlds import MappedModel, grid_options, read_all
from jaxltl.io.certificate.results import Certifiable, policy_certificate
from jaxltl.plot.drawing import Picture, automaton_picture, drawing
from jaxltl.app.reports import page
from jaxltl.app.wording import Record, Result, about, bounds_of, counted, plain
from jaxltl.core import models
from jaxltl.core.policies.policy_file import save_policy
from jaxltl.core.types import Solution, Status
from jaxltl.core.validation import errors_in
from jaxltl.core.values import optimal_actions, satisfaction_probability
from jaxltl.core.values.undiscounted.mixture import at_starts
from jaxltl.envs.gridworld import ACTIONS, gridworld
from jaxltl.envs.text_map import parse_map

DOUBLE, FILE = True, GroundingFile
_LIMIT = 8  # groundings of a robust policy


@dataclass(frozen=True)
class GroundingSetup:
    """A task, ready for learning."""

    task: GroundingFile
    worlds: list[MappedModel]  # W maps with demonstrations, then those of [test]
    meaning: np.ndarray  # bool[M, W', S], candidate meanings in all of them
    names: tuple[str, ...]  # of the meanings
    problem: grounding.Problem
    hparams: grounding.Hparams


@dataclass(frozen=True)
class GroundingAnswer:
    """Policies in a world under the most likely grounding, and the robust one."""

    model: models.Product
    policy: jax.Array  # float[S, Q, A], the demonstrator's, restricted to optimal actions
    attained: Solution  # its satisfaction probability
    best: Solution
    robust: grounding.RobustPolicy | None  # None for a single grounding


@dataclass
class GroundingOutcome:
    """The posterior and its answers."""

    setup: GroundingSetup
    posterior: grounding.Posterior
    members: np.ndarray  # rows of the credible set
    table: list[grounding.Row]
    query: grounding.LabelQuery
    answers: list[GroundingAnswer]


def prepare(task: GroundingFile, seed: int) -> GroundingSetup:
    """Worlds, observations and demonstrations of a task; ValueError for one that does not fit."""
    path = task.path
    texts = [read_entry(path, entry) for entry in task.maps]
    options = grid_options(task.world)
    wall = task.world.wall or "#"
    with errors_in(f"{path}: [world] "):
        cells = [parse_map(text) for text in texts]
        kinds = sorted({str(kind) for x in cells for kind in np.unique(x)} - {wall})
        options.setdefault("legend", {kind: [] if kind == "." else [kind] for kind in kinds})
        mdps = [gridworld(text, **options) for text in texts]
        worlds = [MappedModel(x, y, ACTIONS) for x, y in zip(mdps, cells, strict=True)]
    names, seen = _observations(task, worlds)
    count, hparams = len(task.world.maps), grounding.Hparams(discount=task.demonstrations.discount)
    demonstrations = _demonstrations(task, worlds[:count], seed)
    with errors_in(f"{path}: "):
        problem = grounding.make_problem(mdps[:count], seen[:count], demonstrations, task.formula)
        size = max(world.num_states for world in mdps)
        wide = np.stack([np.pad(x, ((0, size - len(x)), (0, 0)), "edge") for x in seen])
        if task.grounding.clusters is None:
            meaning = np.moveaxis(wide, -1, 0) > 0
            if not ((wide == 0) | (wide == 1)).all():
                raise ValueError(
                    "[grounding] observations are not all 0 or 1; give clusters = N, the number of "
                    "kinds of states."
                )
        else:
            every = replace(problem, observation=jnp.asarray(wide))
            meaning = grounding.cluster_meanings(every, task.grounding.clusters)
            names = tuple(f"cluster {m + 1}" for m in range(len(meaning)))
    return GroundingSetup(task, worlds, meaning, names, problem, hparams)


def _observations(
    task: GroundingFile, worlds: list[MappedModel]
) -> tuple[tuple[str, ...], list[np.ndarray]]:
    """Names of the columns, and observations ``float[S, O]`` of each world."""
    files = task.grounding.observations
    if files == "cells":
        return worlds[0].mdp.propositions, [np.asarray(x.mdp.label, float) for x in worlds]
    names: tuple[str, ...] = ()
    seen = []
    for name, world in zip(files, worlds, strict=True):
        path = task.path.parent / name
        head, *lines = read_bytes(path, "the observations").decode().splitlines()
        with errors_in(f"{path}: "):
            table = np.loadtxt(lines, delimiter=",", ndmin=2)
            names = tuple(x.strip() for x in head.split(","))
            if table.shape != (world.mdp.num_states, len(names)) or not np.isfinite(table).all():
                raise ValueError(
                    f"the table has shape {table.shape}; expected ({world.mdp.num_states}, "
                    f"{len(names)}), a line of finite numbers for each cell."
                )
        seen.append(table)
    return names, seen


def _demonstrations(
    task: GroundingFile, worlds: list[MappedModel], seed: int
) -> list[models.Trajectories]:
    """Demonstrations in each world, read or simulated with the hidden meanings."""
    table, trajectories = task.demonstrations, []
    if table.files is not None:
        return read_all(task.path, table.files, worlds)
    with errors_in(f"{task.path}: "):
        automaton, meaning = require_task(task.formula), table.meaning or {}
        for symbol in automaton.propositions:
            if meaning.get(symbol) not in (known := worlds[0].mdp.propositions):
                raise ValueError(
                    f"[demonstrations] meaning of {symbol} is {meaning.get(symbol)!r}; it must be "
                    f"one of {', '.join(known)}."
                )
    for w, world in enumerate(worlds):
        columns = [world.mdp.propositions.index(meaning[p]) for p in automaton.propositions]
        labels = np.asarray(world.mdp.label)[:, columns]
        mdp = grounding.with_labels(world.mdp, labels, automaton.propositions)
        model = models.product(mdp, automaton)
        policy = grounding.demonstrator_policy(model, table.scale, table.discount)
        runs = models.rollout(
            model,
            policy,
            jax.random.fold_in(jax.random.key(seed), w),
            num_trajectories=table.synthetic or 0,
            num_steps=table.length or 200,
            stop=model.final if automaton.is_cosafe else None,
        )
        trajectories.append(models.project_trajectories(model, runs))
    return trajectories


def describe(setup: GroundingSetup) -> str:
    """Numbers of worlds, meanings and demonstrations, as text."""
    problem, tests = setup.problem, len(setup.worlds) - len(setup.problem.observation)
    return (
        f"{counted(len(problem.observation), 'map')}, {tests} further, "
        f"{counted(len(problem.symbols), 'symbol')} of {counted(len(setup.names), 'possible meaning')}, "
        f"{counted(len(problem.length), 'demonstration')} of {int(jnp.sum(problem.length))} steps"
    )


def learn(setup: GroundingSetup, training: Training) -> GroundingOutcome:
    """Weighs the groundings, and certifies policies in all worlds."""
    task, problem, hparams = setup.task, setup.problem, setup.hparams
    count, size = problem.observation.shape[:2]
    with errors_in(f"{task.path}: "):
        posterior = grounding.posterior(
            problem, hparams, meanings=setup.meaning[:, :count, :size], names=setup.names
        )
    training.stage("certifying")
    members = grounding.credible_set(posterior, task.grounding.level)
    return GroundingOutcome(
        setup,
        posterior,
        members,
        grounding.grounding_table(problem, hparams, posterior),
        grounding.best_query(posterior),
        [_answer(setup, posterior, members[:_LIMIT], w) for w in range(len(setup.worlds))],
    )


def labels_of(
    setup: GroundingSetup, posterior: grounding.Posterior, row: int, w: int
) -> np.ndarray:
    """``bool[S, P]``, the labels of a world by a row of the posterior."""
    return setup.meaning[posterior.assignment[row], w, : setup.worlds[w].mdp.num_states].T


def _answer(
    setup: GroundingSetup, posterior: grounding.Posterior, members: np.ndarray, w: int
) -> GroundingAnswer:
    mdp, automaton = setup.worlds[w].mdp, setup.task.formula
    labels = [labels_of(setup, posterior, i, w) for i in members]
    model = models.product(grounding.with_labels(mdp, labels[0], posterior.symbols), automaton)
    inside = optimal_actions(model)
    policy = grounding.demonstrator_policy(
        models.with_allowed(model, inside.allowed), posterior.scale[0], setup.hparams.discount
    )
    robust = None
    if len(labels) > 1:
        robust = grounding.robust_policy(mdp, labels, posterior.symbols, automaton)
    attained = satisfaction_probability(model, policy)
    return GroundingAnswer(model, policy, attained, inside.best, robust)


def _mean(answer: GroundingAnswer, solution: Solution) -> Record:
    """A probability from the initial distribution, with its bounds."""
    mean = {k: at_starts(answer.model, x, "mean")[0] for k, x in bounds_of(solution).items()}
    return {**mean, "status": Status(int(solution.status)).name}


def _steps(setup: GroundingSetup, row: grounding.Row) -> list[Record]:
    """The decisive steps of a symbol, with the numbers of maps and demonstrations from 1."""
    records, problem = [], setup.problem
    for n, t, gain in row.steps:
        w = int(problem.world[n])
        index = n - int(np.argmax(np.asarray(problem.world) == w)) + 1
        where = setup.worlds[w].position(int(problem.state[n, t]))
        place = {"map": w + 1, "demonstration": index, "step": t + 1, **where}
        records.append({**place, "action": ACTIONS[int(problem.action[n, t])], "gain": gain})
    return records


def summary(outcome: GroundingOutcome) -> Record:
    """The results for ``result.json``."""
    setup, posterior, query = outcome.setup, outcome.posterior, outcome.query
    task, problem, members = setup.task, setup.problem, outcome.members
    level, first = task.grounding.level, members[:_LIMIT].tolist()
    result = {
        **about(task.name, task.formula, task.learner.method),
        "demonstrations": task.demonstrations.entry(len(problem.length), jnp.sum(problem.length)),
        "num_demonstrated": len(problem.observation),
        "meanings": setup.names,
        "grounding": [{**x._asdict(), "steps": _steps(setup, x)} for x in outcome.table],
        "groundings": [
            {"weight": posterior.weight[i], "meaning": posterior.meaning_of(i)} for i in first
        ],
        "credible_set": {
            "level": level,
            "number": len(members),
            "robust_weight": posterior.weight[first].sum(),
        },
        "ambiguous": grounding.ambiguous_symbols(posterior, level),
        "complete": posterior.complete,
        "query": {
            "map": query.world + 1,
            **setup.worlds[query.world].position(query.state),
            "information": query.information,
            "labels": [{"symbols": sorted(x), "weight": weight} for x, weight in query.labels],
        },
        "worlds": [
            {
                "attained": _mean(x, x.attained),
                "best_achievable": _mean(x, x.best),
                "robust": x.robust
                and {k: getattr(x.robust, k) for k in ("worst", "lower", "upper")},
            }
            for x in outcome.answers
        ],
    }
    return plain(result)


def certifiable(outcome: GroundingOutcome) -> list[Certifiable] | str:
    """The satisfaction probability of the policy in each world."""
    formula = outcome.setup.task.formula
    return [
        policy_certificate(x.model, x.attained, formula, np.asarray(x.policy))
        for x in outcome.answers
    ]


def save(out: Path, outcome: GroundingOutcome) -> None:
    """Writes ``policy_1.npz`` and so on, the policy in each world."""
    for path in [*out.glob("policy_*.npz"), *out.glob("map_*.svg")]:
        path.unlink()
    for w, answer in enumerate(outcome.answers):
        policy = models.project_policy(answer.model, answer.policy, actions=ACTIONS)
        bounds = {name: getattr(answer.attained, name) for name in ("lower", "upper")}
        save_policy(out / f"policy_{w + 1}.npz", policy, bounds)


def task_pictures(setup: GroundingSetup) -> list[Picture]:
    """Picture of the formula's automaton."""
    automaton = jax.tree.map(lambda x: np.asarray(x)[0], setup.problem.model.automaton)
    return [automaton_picture(automaton, "")]


def sections(outcome: GroundingOutcome) -> list[page.Section]:
    """The grounding on each map: for each symbol the posterior probability of its label."""
    setup, posterior = outcome.setup, outcome.posterior
    heavy = np.flatnonzero(posterior.weight > 1e-9).tolist()
    titles, drawn = [f"{row.symbol}: {row.meaning}" for row in outcome.table], list[page.Section]()
    text = "For each symbol the posterior probability that it holds in a cell."
    for w, world in enumerate(setup.worlds):
        weight = sum(posterior.weight[i] * labels_of(setup, posterior, i, w) for i in heavy)
        maps = drawing("grid", world.cells, np.asarray(weight).T, titles=titles, label="weight")
        drawn.append(Picture(f"map_{w + 1}.svg", f"Grounding on map {w + 1}", maps, text))
    return drawn


# --- the report ---------------------------------------------------------------------------


_HEADER = ("symbol", "meaning", "weight", "alternatives", "decisive steps")
_WORLDS = ("map", "probability", "certified", "maximum", "robust policy, at least")


def _values(result: Result) -> Record:
    rows = [
        (
            row["symbol"],
            row["meaning"],
            page.probability(row["weight"]),
            ", ".join(f"{x} {page.probability(w)}" for x, w in row["alternatives"][:2]) or "none",
            "; ".join(
                f"map {x['map']} demonstration {x['demonstration']} step {x['step']} (+{page.number(x['gain'])})"
                for x in row["steps"]
            )
            or "none",
        )
        for row in result["grounding"]
    ]
    worlds = [
        (
            str(w),
            *page.cells(world["attained"]),
            page.probability(world["best_achievable"]["value"]),
            "the same" if world["robust"] is None else page.rounded_down(world["robust"]["worst"]),
        )
        for w, world in enumerate(result["worlds"], start=1)
    ]
    return {
        "tables": (
            ("Grounding", _HEADER, rows),
            ("Satisfaction probability", _WORLDS, worlds),
        ),
        "aligned": page.aligned,
    }


report = page.Report("grounding", _values)
