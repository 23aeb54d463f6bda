"""The pictures of a job of todirl: its automata, curves, and worlds with what is done there."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.app._todirl_parts import LENGTH, Judged, Outcome, Setup, Worlds, counted_worlds, part_of
from jaxltl.app.drawing import Picture, drawing
from jaxltl.app.learn import short_name
from jaxltl.core.models.batch import lift_memory
from jaxltl.core.models.monitor import Verdict, verdicts
from jaxltl.core.models.trajectories import Trajectories
from jaxltl.envs import temporal_gridworld

_PICTURES = 3  # worlds that are drawn, of each kind
_WALKS = 3  # trajectories drawn in a world


def task_pictures(setup: Setup) -> list[Picture]:
    """The report's pictures that nothing has to be learned for."""
    found = [Picture(
        "automaton.svg", "The task as an automaton", drawing("automaton", setup.judge),
        "States with a double circle: the task is done, whatever follows. Grey: it has failed. "
        "Each state is named by the formula that is left to satisfy.",
    )]
    if setup.memory is not setup.judge:
        found.append(Picture(
            "memory.svg", "What the learner remembers", drawing("automaton", setup.memory),
            "The automaton whose state is the learner's memory; the task above judges it.",
        ))
    return found


def pictures(outcome: Outcome) -> list[Picture]:
    """The report's pictures of what was learned."""
    setup, history = outcome.setup, outcome.learned.history
    found = [Picture(
        "learning.svg", "Learning",
        drawing("curves", {k: history[k].T for k in ("per_pair", "held_out", "gradient_norm")},
                steps=history["step"]),
        "Negative log-likelihood of the average demonstrated pair, of the average held-out pair "
        "where there are any, and the gradient's length, before each step"
        + ("" if np.isnan(outcome.learned.held_out).any()
           else ". What is kept has the least held-out figure")
        + ("; the line is the median over seeds, the band holds all of them."
           if len(outcome.learned.held_out) > 1 else "."),
    )]
    for w, scene in list(enumerate(setup.training.scenes))[:_PICTURES]:
        found += _draw(outcome, setup.training, outcome.training, w, f"training_{w + 1}",
                       f"Training world: {scene.name}", True)
    if setup.test is not None and outcome.test is not None:
        for n, (rank, w) in enumerate(_chosen_worlds(setup, outcome.test)):
            title = f"Test world, {rank}: {setup.test.scenes[w].name}"
            found += _draw(outcome, setup.test, outcome.test, w, f"test_{n + 1}", title, n == 0)
    return found


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


def _draw(
    outcome: Outcome, worlds: Worlds, judged: Judged, w: int, stem: str, title: str,
    arrows: bool,
) -> list[Picture]:
    """A world with runs of its policy and, if asked for, the policy itself."""
    setup, scene = outcome.setup, worlds.scenes[w]
    size = scene.mdp.num_states
    policy = judged.policy[w][..., :size, :, :]
    moving = policy if policy.ndim == 3 else policy[0]
    mean = float(judged.performance["learned"].mean[w])
    title = f"{title} ({mean:.4f})"
    shown = _memory_shown(setup)
    names = setup.memory.state_names or ("",) * len(setup.memory.delta)
    # About as many characters as a panel is wide.
    width = int(np.clip(5 * scene.shape[1], 9, 50))
    titles = [short_name(f"memory {q}: {names[q]}", width) for q in shown]
    when = "" if policy.ndim == 3 else " at the first step"
    caption = (
        f"One map for each state of the learner's memory; an arrow is as long as its action is "
        f"likely{when}. In the title, the mean probability of doing the task."
    )
    if scene.colored is None:
        assert scene.cells is not None
        panels = np.broadcast_to(
            np.asarray(judged.performance["learned"].value[w])[:size], (len(shown), size))
        drawn = drawing(
            "grid", scene.cells, panels, moving.transpose(1, 0, 2)[shown], titles=titles,
            label="probability from a start there",
            wall=setup.task.world.get("wall", "#"),
        )
        caption += " Colours: the probability of doing the task if a run starts there."
        return [Picture(f"{stem}.svg", title, drawn, caption)]
    found: list[Picture] = []
    if arrows:
        drawn = drawing("temporal_gridworld", part_of(scene.colored, ...), moving, memory=shown,
                        title=titles)
        found.append(Picture(f"{stem}.svg", title, drawn, caption))
    if policy.ndim == 3:
        walks = _walks(outcome, worlds, w, judged.policy[w])
        found.append(Picture(
            f"{stem}_runs.svg", title if not arrows else f"Runs in {scene.name}",
            drawing("temporal_gridworld", part_of(scene.colored, ...), trajectories=walks),
            f"{len(walks.length)} runs of the learned policy from random starts, each until the "
            "task is done or has failed.",
        ))
    return found


def _memory_shown(setup: Setup) -> list[int]:
    """Memory states in which there is something left to do."""
    open_ = np.flatnonzero(verdicts(setup.memory) == Verdict.UNDECIDED)
    return [int(q) for q in open_] or [0]


def _walks(outcome: Outcome, worlds: Worlds, w: int, policy: np.ndarray) -> Trajectories:
    setup = outcome.setup
    array = jnp.asarray(policy)
    lifted = array if setup.memory is setup.judge else lift_memory(array, setup.judge)
    key = jax.random.fold_in(jax.random.key(outcome.seed), 2)
    shown = setup.task.demonstrations
    # As many as there were demonstrations, for which the program is there already.
    walks = temporal_gridworld.demonstrations(
        key, part_of(worlds.judged, w), lifted, shown.get("synthetic", _WALKS),
        shown.get("length", LENGTH),
    )
    return part_of(walks, slice(_WALKS))
