"""Pictures of inverse reinforcement learning: automaton, learning curves, policy on the map."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.app.reports import steps
from jaxltl.app.reports.drawing import Picture, drawing
from jaxltl.app.reports.explorer import (
    START,
    Curves,
    Explorer,
    Layer,
    TooLarge,
    View,
    curves,
    demonstrated_runs,
    explorer,
    learned_runs,
)
from jaxltl.app.guarantee import left_out
from jaxltl.app.job import automaton_picture, over_seeds, plain, short_name
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models import Product, restrict
from jaxltl.core.values.undiscounted.mixture import from_starts

_CURVES = "Loss, satisfaction probability and gradient before each step"
LIVE = "policy"  # name of the interactive part


def task_pictures(setup: Any) -> list[Picture]:
    """Picture of the formula's automaton."""
    return [automaton_picture(setup.model.automaton, LIVE)]


_FIGURES = ("loss", "neg_log_likelihood", "satisfaction", "gradient_norm")


def pictures(outcome: Any) -> list[Picture]:
    """Pictures of the policy on the map, of learning curves and of the automaton."""
    cells, history = outcome.setup.world.cells, outcome.learned.history
    return [
        *([] if cells is None else _maps(outcome, cells)),
        *steps.pictures(plain(outcome.expected_steps)),
        Picture(
            "learning.svg",
            "Learning",
            drawing(
                "curves",
                {k: v.T for k, v in history.items() if k != "step"},
                steps=history["step"],
                show=_FIGURES,
            ),
            _CURVES + over_seeds(len(outcome.learned.loss)),
            "learning",
        ),
    ]


def live(outcome: Any) -> list[Explorer | TooLarge | Curves]:
    """Interactive policy on the map, and learning curves."""
    setup, model = outcome.setup, outcome.setup.model
    policy = np.asarray(outcome.learned.policy[outcome.chosen])
    caption = _CURVES + over_seeds(len(outcome.learned.loss))
    logged = setup.world.logged
    return [
        explorer(
            View(
                name=LIVE,
                title="Learned policy",
                caption=_TABLE if setup.world.cells is None else _MAP,
                size=setup.world.mdp.num_states,
                place=setup.world.cells,
                actions=setup.world.actions,
                places={} if logged is None else dict(enumerate(logged.states)),
                label=_LABEL,
                wall=setup.task.world.wall or "#",
                marked=left_out(model, setup.guarantee, setup.demonstrations),
                marks="Demonstrated steps that lower the maximal satisfaction probability",
            ),
            model.automaton,
            _layers(outcome),
            [
                *demonstrated_runs(model, setup.demonstrations),
                *learned_runs(model, policy, outcome.seed),
            ],
        ),
        curves("learning", "Learning", caption, outcome.learned.history, _FIGURES),
    ]


_LABEL = "satisfaction probability"
_MAP = (
    "Lengths of arrows are the probabilities of actions, colours are satisfaction probabilities. "
    "Cells that are unreachable with a memory state are blank."
)
_TABLE = (
    "The table below has the probabilities of actions and the satisfaction probability for each "
    "memory state."
)


def _layers(outcome: Any) -> dict[str, Layer]:
    """A layer for each memory state that is undecided and reachable, and one of initial states."""
    model = outcome.setup.model
    policy = np.asarray(outcome.learned.policy[outcome.chosen])
    value = np.array(outcome.solution.value)
    starts = np.asarray(model.mdp.initial) > 0
    undecided = verdicts(model.automaton) == Verdict.UNDECIDED
    met = _reached(model)
    shown = np.flatnonzero(undecided & met.any(axis=0)).tolist()
    names = model.automaton.state_names or ("",) * model.num_memory
    found = {
        str(q): Layer(
            f"memory state {q}: {names[q]}",
            np.where(met[:, q], value[:, q], np.nan),
            np.where(met[:, q, None], policy[:, q], np.nan),
        )
        for q in shown
    }
    at_start = np.where(starts, from_starts(model, value), np.nan)
    return {**found, START: Layer("initial states", at_start, None)}


def _maps(outcome: Any, cells: np.ndarray) -> list[Picture]:
    layers = _layers(outcome)
    maps = [
        Picture(
            "values.svg",
            "Satisfaction probability",
            drawing("grid", cells, layers.pop(START).value, label=_LABEL),
            "Satisfaction probability of the learned policy from each initial state.",
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
                "Learned policy",
                drawn,
                "One map for each state of the automaton, which is the policy's memory. " + _MAP,
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
