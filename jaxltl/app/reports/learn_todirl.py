"""Report of a transferable reward: satisfaction probabilities in worlds, and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from jaxltl.algos.todirl.worlds import part_of
from jaxltl.app.files.scenes import ObservedScene
from jaxltl.plot.drawing import automaton_picture, learning_picture, over_seeds, short_name
from jaxltl.app.reports import steps
from jaxltl.plot.drawing import Picture, drawing
from jaxltl.plot.explorer import (
    LONGEST_RUN,
    START,
    Curves,
    Explorer,
    MapLayer,
    ReportTrajectory,
    curves,
    demonstrated_runs,
    learned_runs,
)
from jaxltl.app.reports.page import (
    Report,
    certified,
    number,
    probability,
)
from jaxltl.app.todirl_results import TodirlOutcome, TodirlSetup, summary
from jaxltl.app.wording import Record, Result
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models import Trajectories, lift_memory_policy, make_trajectories
from jaxltl.envs.gridworld import ACTIONS

_POLICIES = {
    "learned": "learned reward",
    "expert": "expert, who knows the formula",
    "random": "random actions",
}
_EXPERT = {
    "soft": "The expert knows the formula and is soft-optimal for a reward of it.",
    "quickest": "The expert knows the formula: its policy is the quickest of those with maximal "
    "satisfaction probability.",
}


def _groups(result: Result) -> list[tuple[str, Result]]:
    """The training worlds and, if there are any, the test worlds."""
    return [(kind, result[kind]) for kind in ("training", "test") if result[kind]]


def _evidence(result: Result) -> list[tuple[str, ...]]:
    return [
        (
            f"{kind}, {policy}",
            probability(one["mean"]["value"]),
            certified(one["mean"]),
            number(one["std"]) if about["num_counted"] > 1 else "",
            f"{probability(one['worst_world']['value'])}, {one['worst_world']['name']}",
            probability(one["worst_start"]),
        )
        for kind, about in reversed(_groups(result))
        for policy in _POLICIES
        for one in [about[policy]]
    ]


def _values(result: Result) -> Record:
    groups = _groups(result)

    def mean_value(world: Result) -> float:
        value: float | None = world["mean"]["value"]
        return -1.0 if value is None else value

    return {
        "evidence": _evidence(result),
        "steps": steps,
        "expert": _EXPERT[result["expert"]],
        "groups": groups,
        "policies": _POLICIES,
        "world_tables": [
            (f"{kind.capitalize()} worlds", about, sorted(about["worlds"], key=mean_value))
            for kind, about in reversed(groups)
        ],
        "counted_worlds": [
            x for _, about in groups for x in about["worlds"] if x["name"] not in about["left_out"]
        ],
    }


report = Report("todirl", _values)


# --- pictures --------------------------------------------------------------------------------


_PICTURES = 3  # worlds that are drawn, of each kind

_FIGURES = ("per_pair", "held_out", "gradient_norm")


def task_pictures(setup: TodirlSetup) -> list[Picture]:
    """Pictures of the automata of the formula and of the memory."""
    same = setup.worlds.memory is setup.worlds.automaton
    drawings = [automaton_picture(setup.worlds.automaton, "training-1" if same else "")]
    if not same:
        drawings.append(
            Picture(
                "memory.svg",
                "Memory of the learner",
                drawing("automaton", setup.worlds.memory),
                "The automaton whose state is the learner's memory; the formula's automaton evaluates it.",
                "training-1",
            )
        )
    return drawings


def pictures(outcome: TodirlOutcome) -> list[Picture]:
    """Pictures of learning curves and of policies in worlds."""
    drawings = [
        learning_picture(outcome.kept.learned.history, _caption_of_curves(outcome), _FIGURES)
    ]
    if time := summary(outcome)["training"].get("expected_steps"):
        drawings += steps.pictures({**time, "likelihood": []})
    for one in _drawn_worlds(outcome):
        drawings += _draw(outcome, one)
    return drawings


def live(outcome: TodirlOutcome) -> list[Explorer | Curves]:
    """Interactive policies in worlds, and learning curves."""
    caption, history = _caption_of_curves(outcome), outcome.kept.learned.history
    return [
        *(_look_into(outcome, one) for one in _drawn_worlds(outcome)),
        curves("learning", "Learning", caption, history, _FIGURES),
    ]


def _caption_of_curves(outcome: TodirlOutcome) -> str:
    scores = outcome.kept.learned.held_out
    choice = ". The parameters with the least held-out figure are kept"
    return (
        "Negative log-likelihood of the average demonstrated pair, of the average held-out pair "
        "if there are any, and the norm of the gradient, before each step"
        f"{'' if np.isnan(scores).any() else choice}{over_seeds(len(scores))}"
    )


@dataclass(frozen=True)
class _DrawnWorld:
    """A world that is drawn: its index, file stem, title, and demonstrations."""

    outcome: TodirlOutcome
    w: int
    stem: str
    title: str
    arrows: bool
    demonstrations: Trajectories | None

    @property
    def scene(self) -> ObservedScene:
        return self.outcome.setup.scenes[self.w]

    @property
    def live(self) -> str:
        return self.stem.replace("_", "-")

    @property
    def caption(self) -> str:
        return (
            "One map for each memory state; lengths of arrows are the probabilities of actions"
            f"{'' if self.policy.ndim == 3 else ' at the first step'}. The title has the mean "
            "satisfaction probability."
        )

    @property
    def moving(self) -> np.ndarray:
        """``[S, Q, A]``, the policy at the first step."""
        return self.policy if self.policy.ndim == 3 else self.policy[0]

    @property
    def policy(self) -> np.ndarray:
        """``[S, Q, A]``, or with a horizon ``[T, S, Q, A]``."""
        return self.outcome.kept.policy[self.w][..., : self.scene.mdp.num_states, :, :]

    @property
    def value(self) -> np.ndarray:
        """``[S]``: the satisfaction probability from an initial state."""
        value = self.outcome.kept.performance["learned"].value[self.w]
        return np.asarray(value)[: self.scene.mdp.num_states]


def _drawn_worlds(outcome: TodirlOutcome) -> Iterator[_DrawnWorld]:
    setup, mean = outcome.setup, np.asarray(outcome.kept.performance["learned"].mean)

    def drawn(
        w: int, kind: str, stem: str, arrows: bool, demonstrations: Trajectories | None
    ) -> _DrawnWorld:
        title = f"{kind}: {setup.worlds.names[w]} ({mean[w]:.4f})"
        return _DrawnWorld(outcome, w, stem, title, arrows, demonstrations)

    for w, demonstrations in enumerate(setup.demands.demonstrations[:_PICTURES]):
        yield drawn(w, "Training world", f"training_{w + 1}", True, demonstrations)
    # The test worlds of least, median and greatest satisfaction probability, each once.
    counted = setup.counted
    if order := counted[np.argsort(mean[counted], kind="stable")].tolist():
        ranks = {"best": order[-1], "median": order[len(order) // 2], "worst": order[0]}
        named = {w: rank for rank, w in ranks.items()}
        for n, (w, rank) in enumerate(reversed(named.items())):
            yield drawn(w, f"Test world, {rank}", f"test_{n + 1}", n == 0, None)


def _look_into(outcome: TodirlOutcome, one: _DrawnWorld) -> Explorer:
    setup, scene = outcome.setup, one.scene
    names = _memory_names(setup)
    layers = {str(q): MapLayer(name, None, one.moving[:, q]) for q, name in names.items()}
    starts = np.asarray(scene.mdp.initial) > 0
    layers[START] = MapLayer("initial states", np.where(starts, one.value, np.nan), None)
    model = part_of(setup.worlds.model, one.w)
    demonstrated = (
        [] if one.demonstrations is None else demonstrated_runs(model, one.demonstrations)
    )
    place = scene.cells if scene.colored is None else part_of(scene.colored, ...)
    return Explorer(
        name=one.live,
        title=one.title,
        caption=one.caption,
        size=scene.mdp.num_states,
        automaton=setup.worlds.memory,
        layers=layers,
        runs=[*demonstrated, *_runs(outcome, one)],
        place=place,
        actions=ACTIONS,
        label="satisfaction probability",
        wall=setup.task.world.wall or "#",
        goal="the formula"
        if setup.worlds.memory is setup.worlds.automaton
        else "the memory's formula",
    )


def _draw(outcome: TodirlOutcome, one: _DrawnWorld) -> list[Picture]:
    """Pictures of a world: its policy, and trajectories."""
    setup, scene, caption = outcome.setup, one.scene, one.caption
    names, moving = _memory_names(setup), one.moving
    # About as many characters as a panel is wide.
    width = int(np.clip(5 * scene.shape[1], 9, 50))
    memories, titles = list(names), [short_name(name, width) for name in names.values()]
    if scene.colored is None:
        assert scene.cells is not None
        drawn = drawing(
            "grid",
            scene.cells,
            np.broadcast_to(one.value, (len(memories), one.value.size)),
            moving.transpose(1, 0, 2)[memories],
            titles=titles,
            label="satisfaction probability",
            wall=setup.task.world.wall or "#",
        )
        caption += " Colours: the satisfaction probability from there as an initial state."
        return [Picture(f"{one.stem}.svg", one.title, drawn, caption, one.live)]
    drawings: list[Picture] = []
    if one.arrows:
        drawn = drawing(
            "temporal_gridworld", part_of(scene.colored, ...), moving, memory=memories, title=titles
        )
        drawings.append(Picture(f"{one.stem}.svg", one.title, drawn, caption, one.live))
    pairs = [[(s, a) for s, _, a in run.steps if a is not None] for run in _runs(outcome, one)]
    if one.policy.ndim == 3 and any(pairs):
        walks = make_trajectories(scene.mdp, [each for each in pairs if each])
        satisfied = setup.worlds.automaton.is_cosafe  # by a finite prefix
        end = "satisfied or violated" if satisfied else f"violated, or for {LONGEST_RUN} steps"
        drawings.append(
            Picture(
                f"{one.stem}_runs.svg",
                f"Trajectories in {scene.name}" if one.arrows else one.title,
                drawing("temporal_gridworld", part_of(scene.colored, ...), trajectories=walks),
                f"{len(walks.length)} trajectories of the learned policy from random initial states, "
                f"each until the formula is {end}.",
                one.live,
            )
        )
    return drawings


def _memory_names(setup: TodirlSetup) -> dict[int, str]:
    """The undecided memory states, with their names."""
    memory = setup.worlds.memory
    names = memory.state_names or ("",) * len(memory.delta)
    undecided = np.flatnonzero(verdicts(memory) == Verdict.UNDECIDED).tolist()
    return {q: f"memory state {q}: {names[q]}" for q in undecided or [0]}


def _runs(outcome: TodirlOutcome, one: _DrawnWorld) -> list[ReportTrajectory]:
    """Rollouts of the learned policy with the learner's memory, until the formula is decided."""
    worlds, policy, count = outcome.setup.worlds, one.policy, 1
    if worlds.memory is not worlds.automaton:
        policy = np.asarray(lift_memory_policy(jnp.asarray(policy), worlds.automaton))
        count = len(worlds.automaton.delta)  # the formula's automaton state varies fastest
    rollouts = learned_runs(part_of(worlds.task_model, one.w), policy, outcome.seed)
    return [
        ReportTrajectory(run.name, [(s, q // count, a) for s, q, a in run.steps])
        for run in rollouts
    ]
