"""The pictures of a job of mlirl: its automaton, curves, and the policy on the map.

A setup and an outcome are those of :mod:`jaxltl.app.learn`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.app.drawing import Picture, drawing
from jaxltl.app.explorer import (
    START,
    Curves,
    Explorer,
    Layer,
    TooLarge,
    curves,
    demonstrated_runs,
    explorer,
    learned_runs,
)
from jaxltl.app.guarantee import left_out
from jaxltl.app.job import automaton_picture, over_seeds, short_name
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models.construct.restrict import restrict
from jaxltl.core.models.product import Product
from jaxltl.core.values.undiscounted.mixture import from_starts

LIVE = "policy"  # the name of the page's live part


def task_pictures(setup: Any) -> list[Picture]:
    """The report's pictures that nothing has to be learned for."""
    return [automaton_picture(setup.model.automaton, LIVE)]


_FIGURES = ("loss", "neg_log_likelihood", "satisfaction", "gradient_norm")


def pictures(outcome: Any) -> list[Picture]:
    """The report's pictures of what was learned."""
    cells, history = outcome.setup.world.cells, outcome.learned.history
    return [
        *([] if cells is None else _maps(outcome, cells)),
        Picture(
            "learning.svg",
            "Learning",
            drawing(
                "curves",
                {k: v.T for k, v in history.items() if k != "step"},
                steps=history["step"],
                show=_FIGURES,
            ),
            "Figures of the weights before each step" + over_seeds(len(outcome.learned.loss)),
            "learning",
        ),
    ]


def live(outcome: Any) -> list[Explorer | TooLarge | Curves]:
    """The parts of the report that move."""
    setup, model = outcome.setup, outcome.setup.model
    policy = np.asarray(outcome.learned.policy[outcome.chosen])
    caption = "Figures of the weights before each step" + over_seeds(len(outcome.learned.loss))
    logged = setup.world.logged
    return [
        explorer(
            LIVE,
            "What it does",
            _TABLE if setup.world.cells is None else _MAP,
            model.automaton,
            _layers(outcome),
            [
                *demonstrated_runs(model, setup.demonstrations),
                *learned_runs(model, policy, outcome.seed),
            ],
            size=setup.world.mdp.num_states,
            place=setup.world.cells,
            actions=setup.world.actions,
            places=None if logged is None else dict(enumerate(logged.states)),
            label=_LABEL,
            wall=setup.task.world.get("wall", "#"),
            marked=left_out(model, setup.guarantee, setup.demonstrations),
            marks="Demonstrated steps that lower the best probability and were left out",
        ),
        curves("learning", "Learning", caption, outcome.learned.history, _FIGURES),
    ]


_LABEL = "probability of doing the task"
_MAP = (
    "An arrow is as long as its action is likely; colours are the probability of doing the task "
    "from there. Cells that cannot be met with a memory are blank."
)
_TABLE = (
    "How likely each action is, and the probability of doing the task from there, stand in the "
    "table below, for each memory."
)


def _layers(outcome: Any) -> dict[str, Layer]:
    """By memory where the policy still matters: not done, not failed, and met on some way."""
    model = outcome.setup.model
    policy = np.asarray(outcome.learned.policy[outcome.chosen])
    value = np.array(outcome.solution.value)
    starts = np.asarray(model.mdp.initial) > 0
    open_ = verdicts(model.automaton) == Verdict.UNDECIDED
    met = _reached(model)
    shown = np.flatnonzero(open_ & met.any(axis=0)).tolist()
    names = model.automaton.state_names or ("",) * model.num_memory
    found = {
        str(q): Layer(
            f"memory {q}: {names[q]}",
            np.where(met[:, q], value[:, q], np.nan),
            np.where(met[:, q, None], policy[:, q], np.nan),
        )
        for q in shown
    }
    at_start = np.where(starts, from_starts(model, value), np.nan)
    return {**found, START: Layer("where a run starts", at_start, None)}


def _maps(outcome: Any, cells: np.ndarray) -> list[Picture]:
    layers = _layers(outcome)
    start = layers.pop(START)
    maps = [
        Picture(
            "values.svg",
            "From where it works",
            drawing("grid", cells, start.value, label=_LABEL),
            "Probability that the learned policy does the task, from each initial state.",
            LIVE,
        )
    ]
    if layers:
        drawn = drawing(
            "grid",
            cells,
            [x.value for x in layers.values()],
            [x.policy for x in layers.values()],
            titles=[short_name(x.name) for x in layers.values()],
            label=_LABEL,
            actions=outcome.setup.world.actions,
        )
        maps.append(
            Picture(
                "policy.svg",
                "What it does",
                drawn,
                "One map for each state of the automaton, which is the policy's memory. An arrow is as "
                "long as its action is likely; colours are the probability of doing the task from "
                "there. Cells that cannot be met with that memory are blank.",
                LIVE,
            )
        )
    return maps


def _reached(model: Product) -> np.ndarray:
    """``bool[S, Q]``: product states that some policy can reach from an initial one."""
    found = restrict(model)
    met = np.zeros(model.state_shape, bool)
    met[np.asarray(found.base_state), np.asarray(found.memory)] = True
    return met
