"""The pictures of a job of todirl: its automata, curves, and worlds with what is done there."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxltl.app._todirl_parts import Judged, Outcome, Setup, Worlds, counted_worlds, part_of
from jaxltl.app.drawing import Picture, drawing
from jaxltl.app.explorer import (
    LONGEST_RUN,
    START,
    Curves,
    Explorer,
    Layer,
    Run,
    TooLarge,
    curves,
    demonstrated_runs,
    explorer,
    learned_runs,
)
from jaxltl.app.job import automaton_picture, over_seeds, short_name
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models.construct.batch import lift_memory_policy
from jaxltl.core.models.trajectories import Trajectories, make_trajectories
from jaxltl.envs.gridworld import ACTIONS

_PICTURES = 3  # worlds that are drawn, of each kind


_END = {
    "cosafe": "is done or has failed",
    **dict.fromkeys(("safety", "buchi", "parity"), f"has failed, or for {LONGEST_RUN} steps"),
}
_FIGURES = ("per_pair", "held_out", "gradient_norm")


def task_pictures(setup: Setup) -> list[Picture]:
    """The report's pictures that nothing has to be learned for."""
    same = setup.memory is setup.judge
    found = [automaton_picture(setup.judge, "training-1" if same else "")]
    if not same:
        found.append(
            Picture(
                "memory.svg",
                "What the learner remembers",
                drawing("automaton", setup.memory),
                "The automaton whose state is the learner's memory; the task above judges it.",
                "training-1",
            )
        )
    return found


def pictures(outcome: Outcome) -> list[Picture]:
    """The report's pictures of what was learned."""
    history = outcome.learned.history
    found = [
        Picture(
            "learning.svg",
            "Learning",
            drawing("curves", {k: history[k].T for k in _FIGURES}, steps=history["step"]),
            _caption_of_curves(outcome),
            "learning",
        )
    ]
    for one in _drawn_worlds(outcome):
        found += _draw(outcome, one)
    return found


def live(outcome: Outcome) -> list[Explorer | TooLarge | Curves]:
    """The parts of the report that move."""
    found: list[Explorer | TooLarge | Curves] = [
        _look_into(outcome, one) for one in _drawn_worlds(outcome)
    ]
    history = outcome.learned.history
    return [*found, curves("learning", "Learning", _caption_of_curves(outcome), history, _FIGURES)]


def _caption_of_curves(outcome: Outcome) -> str:
    return (
        "Negative log-likelihood of the average demonstrated pair, of the average held-out pair "
        "where there are any, and the gradient's length, before each step"
        + (
            ""
            if np.isnan(outcome.learned.held_out).any()
            else ". What is kept has the least held-out figure"
        )
        + over_seeds(len(outcome.learned.held_out))
    )


class _Drawn(NamedTuple):
    """A world that is drawn: its number among others, its policy, and its title."""

    worlds: Worlds
    judged: Judged
    w: int
    stem: str
    title: str
    arrows: bool
    demonstrations: Trajectories | None

    @property
    def live(self) -> str:
        return self.stem.replace("_", "-")

    @property
    def policy(self) -> np.ndarray:
        """``[S, Q, A]``, or with a horizon ``[T, S, Q, A]``."""
        return self.judged.policy[self.w][..., : self.worlds.scenes[self.w].mdp.num_states, :, :]

    @property
    def value(self) -> np.ndarray:
        """``[S]``: the probability of doing the task from a start there."""
        size = self.worlds.scenes[self.w].mdp.num_states
        return np.asarray(self.judged.performance["learned"].value[self.w])[:size]


def _drawn_worlds(outcome: Outcome) -> Iterator[_Drawn]:
    setup, training, test = outcome.setup, outcome.setup.training, outcome.setup.test

    def drawn(
        worlds: Worlds,
        judged: Judged,
        w: int,
        stem: str,
        title: str,
        arrows: bool,
        shown: Trajectories | None = None,
    ) -> _Drawn:
        mean = float(judged.performance["learned"].mean[w])
        title = f"{title}: {worlds.scenes[w].name} ({mean:.4f})"
        return _Drawn(worlds, judged, w, stem, title, arrows, shown)

    for w, shown in enumerate(setup.demonstrations[:_PICTURES]):
        yield drawn(
            training, outcome.training, w, f"training_{w + 1}", "Training world", True, shown
        )
    if test is not None and outcome.test is not None:
        for n, (rank, w) in enumerate(_chosen_worlds(setup, outcome.test)):
            yield drawn(test, outcome.test, w, f"test_{n + 1}", f"Test world, {rank}", n == 0)


_CAPTION = (
    "One map for each state of the learner's memory; an arrow is as long as its action is "
    "likely{}. In the title, the mean probability of doing the task."
)


def _look_into(outcome: Outcome, one: _Drawn) -> Explorer | TooLarge:
    setup, scene, policy = outcome.setup, one.worlds.scenes[one.w], one.policy
    stationary = policy.ndim == 3
    moving = policy if stationary else policy[0]
    names = setup.memory.state_names or ("",) * len(setup.memory.delta)
    layers = {
        str(q): Layer(f"memory {q}: {names[q]}", None, moving[:, q]) for q in _memory_shown(setup)
    }
    starts = np.asarray(scene.mdp.initial) > 0
    layers[START] = Layer("where a run starts", np.where(starts, one.value, np.nan), None)
    model = part_of(one.worlds.model, one.w)
    shown = [] if one.demonstrations is None else demonstrated_runs(model, one.demonstrations)
    place: Any = scene.cells if scene.colored is None else part_of(scene.colored, ...)
    return explorer(
        one.live,
        one.title,
        _CAPTION.format("" if stationary else " at the first step"),
        setup.memory,
        layers,
        [*shown, *_runs(outcome, one)],
        size=scene.mdp.num_states,
        place=place,
        actions=ACTIONS,
        label="probability of doing the task",
        wall=setup.task.world.get("wall", "#"),
        goal="the task" if setup.memory is setup.judge else "what it remembers",
    )


def _chosen_worlds(setup: Setup, judged: Judged) -> list[tuple[str, int]]:
    """The test worlds where the learned policy does worst, middling and best."""
    counted = np.flatnonzero(counted_worlds(setup))
    mean = np.asarray(judged.performance["learned"].mean)
    order = counted[np.argsort(mean[counted], kind="stable")]
    ranks = {"worst": order[0], "median": order[len(order) // 2], "best": order[-1]}
    found: dict[int, str] = {}
    for rank, w in ranks.items():
        found.setdefault(int(w), rank)
    return [(rank, w) for w, rank in found.items()]


def _draw(outcome: Outcome, one: _Drawn) -> list[Picture]:
    """A world with runs of its policy and, if asked for, the policy itself."""
    setup, scene, policy = outcome.setup, one.worlds.scenes[one.w], one.policy
    moving = policy if policy.ndim == 3 else policy[0]
    shown = _memory_shown(setup)
    names = setup.memory.state_names or ("",) * len(setup.memory.delta)
    # About as many characters as a panel is wide.
    width = int(np.clip(5 * scene.shape[1], 9, 50))
    titles = [short_name(f"memory {q}: {names[q]}", width) for q in shown]
    caption = _CAPTION.format("" if policy.ndim == 3 else " at the first step")
    if scene.colored is None:
        assert scene.cells is not None
        drawn = drawing(
            "grid",
            scene.cells,
            np.broadcast_to(one.value, (len(shown), one.value.size)),
            moving.transpose(1, 0, 2)[shown],
            titles=titles,
            label="probability from a start there",
            wall=setup.task.world.get("wall", "#"),
        )
        caption += " Colours: the probability of doing the task if a run starts there."
        return [Picture(f"{one.stem}.svg", one.title, drawn, caption, one.live)]
    found: list[Picture] = []
    if one.arrows:
        drawn = drawing(
            "temporal_gridworld", part_of(scene.colored, ...), moving, memory=shown, title=titles
        )
        found.append(Picture(f"{one.stem}.svg", one.title, drawn, caption, one.live))
    pairs = [[(s, a) for s, _, a in run.steps if a is not None] for run in _runs(outcome, one)]
    if policy.ndim == 3 and any(pairs):
        walks = make_trajectories(scene.mdp, [each for each in pairs if each])
        found.append(
            Picture(
                f"{one.stem}_runs.svg",
                f"Runs in {scene.name}" if one.arrows else one.title,
                drawing("temporal_gridworld", part_of(scene.colored, ...), trajectories=walks),
                f"{len(walks.length)} runs of the learned policy from random starts, each until the "
                f"task {_END[setup.judge.acceptance]}.",
                one.live,
            )
        )
    return found


def _memory_shown(setup: Setup) -> list[int]:
    """Memory states in which there is something left to do."""
    open_ = np.flatnonzero(verdicts(setup.memory) == Verdict.UNDECIDED)
    return [int(q) for q in open_] or [0]


def _runs(outcome: Outcome, one: _Drawn) -> list[Run]:
    """Runs of the learned policy with the learner's memory, until the task is decided."""
    setup, policy, count = outcome.setup, one.policy, 1
    if setup.memory is not setup.judge:
        # The task's state varies fastest.
        policy, count = (
            np.asarray(lift_memory_policy(jnp.asarray(policy), setup.judge)),
            len(setup.judge.delta),
        )
    found = learned_runs(part_of(one.worlds.judged, one.w), policy, outcome.seed)
    return [Run(run.name, [(s, q // count, a) for s, q, a in run.steps]) for run in found]
