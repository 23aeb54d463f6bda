"""Finite-state controllers from a task file: the job of maps that a robot sees in part."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from jaxltl.algos import finite_state_controllers as fsc
from jaxltl.algos.common.chunks import ChunkOptions
from jaxltl.algos.common.seeds import Training, make_hparams
from jaxltl.app.files.schema import read_map
from jaxltl.app.files.task_rl import ControllerFile
from jaxltl.app.files.worlds import grid_options
from jaxltl.app.wording import Record, Result, about, bounds_of, counted, plain
from jaxltl.io.certificate.results import Certifiable, formula_question
from jaxltl.plot.drawing import Picture, automaton_picture, drawing
from jaxltl.plot.explorer import LONGEST_RUN, Explorer, MapLayer, ReportTrajectory
from jaxltl.app.reports import page
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models import POMDP, belief_filter, rollout
from jaxltl.core.models.pomdp import policy_of_states
from jaxltl.core.policies.policy_file import save_policy
from jaxltl.core.types import Solution, Status
from jaxltl.core.validation import errors_in
from jaxltl.core.values import controlled_chain, mealy_machine, optimal_satisfaction
from jaxltl.core.values.partial_observability.reduction import MealyTransition
from jaxltl.core.values.partial_observability.solve import task_pomdp
from jaxltl.envs.gridworld import ACTIONS, partial_gridworld
from jaxltl.envs.text_map import parse_map

DOUBLE, FILE = True, ControllerFile
LIVE = "controller"
_RUNS = 3
_FIGURES = ("value", "gradient_norm")
_CURVES = (
    "Objective of the softmax controller, a satisfaction probability with discounted steps, and gradient "
    "before each step"
)


@dataclass(frozen=True)
class ControllerSetup:
    """A task, ready for learning."""

    task: ControllerFile
    cells: np.ndarray  # str[rows, columns]
    pomdp: POMDP
    automaton: Automaton
    hparams: fsc.Hparams


@dataclass
class ControllerOutcome:
    """A controller with its evidence."""

    setup: ControllerSetup
    learned: fsc.CertifiedController
    chain: Solution  # satisfaction probabilities from each state of the controlled chain
    place: np.ndarray  # int[N, 2], state and memory state of each state of the chain
    transitions: list[MealyTransition]
    seed: int


def prepare(task: ControllerFile, seed: int) -> ControllerSetup:
    """The world of a task; ValueError for one that does not fit."""
    del seed
    text, world = read_map(task.path, task.world.map), task.world
    options = {"hidden": world.hidden or (), **grid_options(world)}
    with errors_in(f"{task.path}: [world] "):
        pomdp = partial_gridworld(text, world.observations, **options)
    with errors_in(f"{task.path}: [task] "):
        _, _, automaton = task_pomdp(pomdp, task.formula)
    hparams = make_hparams(fsc.Hparams, task.controller.specified())
    return ControllerSetup(task, parse_map(text), pomdp, automaton, hparams)


def describe(setup: ControllerSetup) -> str:
    """Sizes of the problem in one line."""
    pomdp = setup.pomdp
    return (
        f"{pomdp.num_states} states, {counted(pomdp.num_observations, 'observation')}, "
        f"{len(setup.automaton.delta)} automaton states, "
        f"{counted(setup.hparams.num_memory, 'memory state')}"
    )


def learn(setup: ControllerSetup, training: Training) -> ControllerOutcome:
    """Learns from all starts, keeps the best certified controller, and explores beliefs for bounds."""
    task, pomdp, report = setup.task, setup.pomdp, training.report
    learned = fsc.learn_formula(
        jax.random.fold_in(jax.random.key(training.seed), 1),
        pomdp,
        task.formula,
        setup.hparams,
        num_starts=task.learner.starts * training.num_seeds,
        num_steps=task.learner.steps,
        discount=task.learner.discount,
        tolerance=task.bounds.tolerance,
        max_beliefs=task.bounds.beliefs,
        max_seconds=task.bounds.seconds,
        options=ChunkOptions(
            report=report and (lambda step, metrics: report(step, vars(metrics))),
            checkpoint=training.checkpoint,
        ),
    )
    training.stage("checking")
    learned = dataclasses.replace(learned, policy=learned.policy.replace(actions=ACTIONS))
    chain = controlled_chain(pomdp, learned.policy)
    share = np.full(chain.num_states, 1 / chain.num_states)
    everywhere = dataclasses.replace(chain, initial=share)
    place = np.stack([chain.valuation["state"], chain.valuation["memory"]], 1)
    joint, _, _ = task_pomdp(pomdp, task.formula)
    over = np.tile(verdicts(setup.automaton) != Verdict.UNDECIDED, pomdp.num_states)
    return ControllerOutcome(
        setup,
        learned,
        optimal_satisfaction(everywhere, task.formula),
        place,
        mealy_machine(joint, learned.policy, decided=over),
        training.seed,
    )


def summary(outcome: ControllerOutcome) -> Record:
    """The results for ``result.json``."""
    setup, learned = outcome.setup, outcome.learned
    task, history, explored = setup.task, outcome.learned.history, outcome.learned.explored
    return plain(
        {
            **about(task.name, task.formula, task.learner.method),
            "num_states": setup.pomdp.num_states,
            "num_observations": setup.pomdp.num_observations,
            "observations": task.world.observations,
            "num_memory": learned.policy.next_memory.shape[1],
            "max_memory": setup.hparams.num_memory,
            "start": learned.start,
            "satisfaction": bounds_of(learned.satisfaction),
            "bounds": {
                **bounds_of(explored),
                "num_memory": learned.reduced.next_memory.shape[1],
                "status": Status(int(explored.status)).name,
                "method": explored.method,
            },
            "fully_observable": bounds_of(learned.fully_observable),
            "starts": {
                "number": history["value"].shape[1],
                "value": history["value"][-1],
                "steps": int(history["step"][-1]),
            },
            "tolerance": task.bounds.tolerance,
        }
    )


def certifiable(outcome: ControllerOutcome) -> list[Certifiable] | str:
    """The satisfaction probability of the controller, and the bound of all controllers."""
    task, pomdp, policy = outcome.setup.task, outcome.setup.pomdp, outcome.learned.policy
    size = pomdp.num_states * policy.next_memory.shape[1] * len(outcome.setup.automaton.delta)
    options = {"max_beliefs": task.bounds.beliefs}
    return [Certifiable(pomdp, policy, formula_question(task.formula), options, size)]


def save(out: Path, outcome: ControllerOutcome) -> None:
    """Writes the controller, which reads numbers of observations, to ``policy.npz``.

    Further arrays: ``observation [S]`` of each cell, ``value``, ``lower`` and ``upper``.
    """
    learned, seen = outcome.learned, {"observation": outcome.setup.pomdp.observation}
    save_policy(out / "policy.npz", learned.policy, seen | bounds_of(learned.satisfaction))


# --- the report ---------------------------------------------------------------------------


def task_pictures(setup: ControllerSetup) -> list[Picture]:
    """The automaton of the formula, and the windows of the robot."""
    world, pictures = setup.task.world, [automaton_picture(setup.automaton, "")]
    if isinstance(world.observations, int):
        drawn = drawing(
            "windows",
            setup.cells,
            np.asarray(setup.pomdp.observation),
            world.observations,
            hidden=world.hidden or (),
            wall=world.wall or "#",
        )
        caption = "What the robot sees, with the number of the observation; it is in the frame."
        pictures.append(Picture("observations.svg", "Observations", drawn, caption))
    return pictures


def sections(outcome: ControllerOutcome) -> list[page.Section]:
    """The controller as a machine and on the map, trajectories with beliefs, and learning curves."""
    setup, history = outcome.setup, outcome.learned.history
    world, rows = setup.task.world, [(s, t, o, x.tolist()) for s, t, o, x in outcome.transitions]
    drawn = drawing("controller", rows, actions=ACTIONS)
    machine = (
        "States are memory. An arrow has a line for each action, with the numbers of the observations "
        "after which it is taken."
    )
    caption = (
        "Lengths of arrows are the probabilities of actions, colours are satisfaction probabilities. "
        "Cells that are unreachable with a memory state are blank. In a trajectory, the frame is what "
        "the robot sees, and the shading what it believes about its place."
    )
    return [
        Picture("controller.svg", "Controller", drawn, machine, LIVE),
        Explorer(
            name=LIVE,
            title="Controller",
            caption=caption,
            size=setup.pomdp.num_states,
            automaton=None,
            layers=_layers(outcome),
            runs=_trajectories(outcome),
            place=setup.cells,
            actions=ACTIONS,
            label="satisfaction probability",
            wall=world.wall or "#",
            machine=rows,
            window=world.observations if isinstance(world.observations, int) else 1,
        ),
        *page.learning_curves(history, _FIGURES, _CURVES, history["value"].shape[1]),
    ]


def _layers(outcome: ControllerOutcome) -> dict[str, MapLayer]:
    """A layer for each memory state, of the cells that are reachable with it."""
    pomdp, policy = outcome.setup.pomdp, outcome.learned.policy
    action = np.asarray(policy_of_states(pomdp, policy).action)
    value = np.full(action.shape[:2], np.nan)
    value[tuple(outcome.place.T)] = np.asarray(outcome.chain.value)
    arrows = np.where(np.isnan(value)[..., None], np.nan, action)
    return {
        str(q): MapLayer(f"memory state {q}", value[:, q], arrows[:, q])
        for q in range(policy.next_memory.shape[1])
    }


def _trajectories(outcome: ControllerOutcome) -> list[ReportTrajectory]:
    """Simulated trajectories of the controller until the formula is decided, with beliefs."""
    pomdp, policy, automaton = outcome.setup.pomdp, outcome.learned.policy, outcome.setup.automaton
    key = jax.random.fold_in(jax.random.key(outcome.seed), 2)
    drawn = rollout(pomdp, policy, key, num_trajectories=_RUNS, num_steps=LONGEST_RUN)
    seen, decided = np.asarray(pomdp.observation), verdicts(automaton) != Verdict.UNDECIDED
    column = [pomdp.propositions.index(p) for p in automaton.propositions]
    letters = np.asarray(automaton.letters)
    label = np.asarray(pomdp.label)[:, column]
    letter = (label[:, None] == letters).all(-1).argmax(1)
    trajectories = []
    for n in range(_RUNS):
        states, did = np.asarray(drawn.state)[n], np.asarray(drawn.action)[n]
        at, q, steps = policy.start(int(seen[states[0]])), int(automaton.initial), []
        for t, state in enumerate(states.tolist()):
            at = at if t == 0 else policy.update(at, int(seen[state]))
            q = int(automaton.delta[q, letter[state]])
            over = bool(decided[q]) or t == LONGEST_RUN - 1
            steps.append((state, int(at.memory), None if over else int(did[t])))
            if over:
                break
        observed = seen[states[: len(steps)]]
        beliefs = belief_filter(pomdp, observed, did)
        one = ReportTrajectory(f"trajectory {n + 1}", steps, observed.tolist(), beliefs)
        trajectories.append(one)
    return trajectories


def _values(result: Result) -> Record:
    bounds = result["bounds"]
    own, best = (counted(x["num_memory"], "memory state") for x in (result, bounds))
    lower, upper = page.probability(bounds["lower"]), page.probability(bounds["upper"])
    mine = result["satisfaction"]
    rows = [
        (f"controller, {own}", page.probability(mine["lower"]), page.certified(mine)),
        (f"best explored controller, {best}", lower, "lower bound of the optimum"),
        ("all controllers", upper, "upper bound of the optimum"),
        ("optimum with full observation", *page.cells(result["fully_observable"])),
    ]
    return {"header": ("policy", "probability", "certified"), "rows": rows, "aligned": page.aligned}


report = page.Report("controller", _values)
