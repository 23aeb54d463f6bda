"""Report of inverse reinforcement learning: probabilities, weights, remarks, and pictures."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.app.wording import plain
from jaxltl.plot.drawing import automaton_picture, learning_picture, over_seeds, short_name
from jaxltl.app.reports import steps
from jaxltl.plot.drawing import Picture, drawing
from jaxltl.plot.explorer import (
    START,
    Curves,
    Explorer,
    MapLayer,
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
from jaxltl.app.wording import Record, Result, counted
from jaxltl.io.demonstrations import position_text
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models import Product, restrict
from jaxltl.core.models.construct.lifting import memory_along
from jaxltl.core.values.undiscounted.mixture import from_starts

_OPTIMAL = 1e-6  # certified loss up to which a policy is reported as optimal
_NEGLIGIBLE = 0.05  # weight without a reported meaning


def _evidence(result: Result) -> list[tuple[str, ...]]:
    """Policy, mean or minimum, probability, certificate, initial state, status of the solver."""
    return [
        (
            title,
            kind,
            probability(result[key][kind]["value"]),
            certified(result[key][kind]),
            position_text(result[key][kind]) if kind == "minimum" else "",
            result[key]["status"].lower(),
        )
        for title, key in (("learned policy", "satisfaction"), ("optimum", "best_achievable"))
        for kind in ("mean", "minimum")
        if kind == "mean" or not _all_equal(result[key])
    ]


def _all_equal(evidence: Result) -> bool:
    """True if all initial states have the same probability, to four places."""
    return probability(evidence["mean"]["value"]) == probability(evidence["minimum"]["value"])


_MEANINGS = {
    "demonstrated": ("takes demonstrated actions", "avoids demonstrated actions"),
    "goal": ("moves to goal states", "avoids goal states"),
    "progress": ("moves on in the automaton", "avoids progress in the automaton"),
    "accepting": ("moves to accepting transitions", "avoids accepting transitions"),
    "avoid": ("avoids these states", "moves to these states"),
    "time": ("prefers short episodes", "prefers long episodes"),
    "nearer": ("takes short paths", "takes long paths"),
}


def _weights(result: Result) -> list[tuple[str, str, str]]:
    """Feature, weight, and the effect of its sign on the policy unless it is negligible."""
    return [
        (
            name,
            number(x),
            "negligible" if x is None or abs(x) < _NEGLIGIBLE else _MEANINGS[name][x < 0],
        )
        for name, x in result["weights"].items()
    ]


def _values(result: Result) -> Record:
    evidence, data, from_log = _evidence(result), result.get("data"), ""
    if data is not None:
        from_log = (
            f"with confidence {data['confidence']:g}, from "
            f"{counted(data['samples'], 'logged transition')}, assuming that {data['assumption']}"
        )
    # The likelihood is 0 if a demonstrated step has probability 0.
    never = result["guarantee"].get("never")
    return {
        "evidence": evidence,
        "evidence_rows": [(f"{policy}, {kind}", *rest) for policy, kind, *rest in evidence],
        "weights": _weights(result),
        "likelihood": "infinite" if never else number(result["neg_log_likelihood"]),
        "from_log": from_log,
        "optimal": _OPTIMAL,
        "steps": steps,
    }


report = Report("mlirl", _values)


# --- pictures --------------------------------------------------------------------------------


_CURVES = "Loss, satisfaction probability and gradient before each step"
LIVE = "policy"  # name of the interactive part


def task_pictures(setup: Any) -> list[Picture]:
    """Picture of the formula's automaton."""
    return [automaton_picture(setup.model.automaton, LIVE)]


_FIGURES = ("loss", "neg_log_likelihood", "satisfaction", "gradient_norm")


def pictures(outcome: Any) -> list[Picture]:
    """Pictures of the policy on the map, of learning curves and of the automaton."""
    cells, history = outcome.setup.world.cells, outcome.kept.learned.history
    return [
        *([] if cells is None else _maps(outcome, cells)),
        *steps.pictures(plain(outcome.expected_steps)),
        learning_picture(history, _CURVES + over_seeds(len(outcome.kept.learned.loss)), _FIGURES),
    ]


def live(outcome: Any) -> list[Explorer | Curves]:
    """Interactive policy on the map, and learning curves."""
    setup, model = outcome.setup, outcome.setup.model
    policy = np.asarray(outcome.kept.policy)
    caption = _CURVES + over_seeds(len(outcome.kept.learned.loss))
    logged = setup.world.logged
    return [
        Explorer(
            name=LIVE,
            title="Learned policy",
            caption=_TABLE if setup.world.cells is None else _MAP,
            size=setup.world.mdp.num_states,
            automaton=model.automaton,
            layers=_layers(outcome),
            runs=[
                *demonstrated_runs(model, setup.demonstrations),
                *learned_runs(model, policy, outcome.seed),
            ],
            place=setup.world.cells,
            actions=setup.world.actions,
            places={} if logged is None else dict(enumerate(logged.states)),
            label=_LABEL,
            wall=setup.task.world.wall or "#",
            marked=_left_out(setup),
            marks="Demonstrated steps that lower the maximal satisfaction probability",
        ),
        curves("learning", "Learning", caption, outcome.kept.learned.history, _FIGURES),
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


def _layers(outcome: Any) -> dict[str, MapLayer]:
    """A layer for each memory state that is undecided and reachable, and one of initial states."""
    model = outcome.setup.model
    policy = np.asarray(outcome.kept.policy)
    value = np.array(outcome.kept.solution.value)
    starts = np.asarray(model.mdp.initial) > 0
    undecided = verdicts(model.automaton) == Verdict.UNDECIDED
    met = _reached(model)
    memories = np.flatnonzero(undecided & met.any(axis=0)).tolist()
    names = model.automaton.state_names or ("",) * model.num_memory
    layers = {
        str(q): MapLayer(
            f"memory state {q}: {names[q]}",
            np.where(met[:, q], value[:, q], np.nan),
            np.where(met[:, q, None], policy[:, q], np.nan),
        )
        for q in memories
    }
    at_start = np.where(starts, from_starts(model, value), np.nan)
    return {**layers, START: MapLayer("initial states", at_start, None)}


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
    restricted = restrict(model)
    met = np.zeros(model.state_shape, bool)
    met[np.asarray(restricted.base_state), np.asarray(restricted.memory)] = True
    return met


def _left_out(setup: Any) -> list[tuple[int, int, int]]:
    """World state, memory state and action of the steps that are left out, each once."""
    model, guarantee, demonstrations = setup.model, setup.guarantee, setup.demonstrations
    state, action = np.asarray(demonstrations.state), np.asarray(demonstrations.action)
    marked = guarantee.forbidden | guarantee.unused(demonstrations)
    if not marked.any():
        return []
    steps = np.stack([state, memory_along(model, state), action], -1)[marked]
    return [(s, q, a) for s, q, a in np.unique(steps, axis=0).tolist()]
