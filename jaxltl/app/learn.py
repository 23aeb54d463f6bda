"""Inverse reinforcement learning from a task file: the job of ``method = "mlirl"``."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from jaxltl.algos import mlirl
from jaxltl.algos.common import guarantees
from jaxltl.algos.common.seeds import Training, make_hparams
from jaxltl.app.files.task_irl import MlirlFile
from jaxltl.app.files import worlds
from jaxltl.app.reports import steps
from jaxltl.app.reports import page
from jaxltl.app.wording import Record, Result, about, bounds_of, counted, enclosure, plain
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models import Product, Trajectories, product, project_policy, restrict
from jaxltl.core.models.construct.lifting import memory_along
from jaxltl.core.policies.policy_file import save_policy
from jaxltl.core.types import Solution, Status
from jaxltl.core.validation import errors_in
from jaxltl.core.values import optimal_actions, optimal_satisfaction, satisfaction_probability
from jaxltl.core.values.undiscounted.mixture import at_starts, from_starts
from jaxltl.io.certificate.results import Certifiable, policy_certificate
from jaxltl.io.demonstrations import position_text
from jaxltl.plot.drawing import Picture, automaton_picture, drawing, short_name
from jaxltl.plot.explorer import START, Explorer, MapLayer, demonstrated_runs, learned_runs

DOUBLE, FILE = True, MlirlFile


@dataclass(frozen=True)
class MlirlSetup:
    task: MlirlFile
    world: worlds.MappedModel
    model: Product
    demonstrations: Trajectories
    dropped: int
    guarantee: guarantees.Guarantee
    bound: guarantees.StepBound | None = None  # of the expected steps; None for safety formulas
    trivial: str | None = None  # remark on a formula that is always true

    @functools.cached_property
    def demands(self) -> mlirl.Demands:
        """Demonstrations and required guarantees of the policy."""
        table, model, demonstrations = self.task.learner, self.model, self.demonstrations
        avoid, used = table.avoid or (), self.guarantee.until_lost(demonstrations)
        # Without a guarantee, those of the dissertation's Table 1 alone.
        best = None if self.guarantee.requested == "none" else self.guarantee.best
        options: Record = {"avoid": avoid, "progress": table.progress, "best": best}
        if table.in_world:
            options = {"avoid": avoid, "progress": table.progress or (), "goal": table.goal}
        return mlirl.Demands(
            model,
            demonstrations,
            mlirl.world_features(model.mdp, demonstrations, **options)
            if table.in_world
            else mlirl.task_features(model, used, **options),
            self.guarantee,
            self.bound,
            in_world=table.in_world,
            guess=table.guess,
            satisfaction_over=table.satisfaction_over,
        )


@dataclass
class MlirlOutcome:
    setup: MlirlSetup
    kept: mlirl.GuaranteedPolicy
    # float[N, S], satisfaction probability of every seed from initial states
    satisfaction: np.ndarray
    # guarantee of the kept policy from a log, if the world is estimated from one
    data: Record | None
    seed: int  # the first seed

    @functools.cached_property
    def expected_steps(self) -> Record | None:
        """Of the learned and the quickest policy, and their trade-offs; None for safety formulas."""
        setup, kept = self.setup, self.kept
        if setup.bound is None or kept.mixture is None:
            return None
        counts = setup.demands.counts
        return steps.entry(setup.model, setup.bound, kept.before, kept.mixture, counts)


def prepare(task: MlirlFile, seed: int) -> MlirlSetup:
    """The learning problem of a task file: product, demonstrations, guarantee and features."""
    world = worlds.load_world(task.path, task.world)
    with errors_in(f"{task.path}: [task] "):
        model = product(world.mdp, task.formula, label_on=task.label_on)
        trivial = guarantees.check_formula(model.automaton)
    best = optimal_satisfaction(model)
    with errors_in(f"{task.path}: [world] "):
        guarantees.require_possible(model, best, world.position_text)
    table = task.demonstrations
    if table.file is not None:
        demonstrations, dropped = worlds.load_demonstrations(task, world), 0
    else:
        simulated = jax.random.fold_in(jax.random.key(seed), 0), task.path, table, model, best
        demonstrations, dropped = worlds.synthetic_demonstrations(*simulated)
    with errors_in(f"{task.path}: [task] "):
        place = world.position_text
        guarantee = guarantees.make_guarantee(
            model, demonstrations, task.guarantee, over=task.over, best=best, place=place
        )
        actions = guarantee.actions or optimal_actions(model, best)
        bound = guarantees.step_bound(
            model,
            actions,
            guarantee.requested,
            over=task.over,
            steps=task.steps,
            factor=task.steps_factor,
        )
    setup = MlirlSetup(task, world, model, demonstrations, dropped, guarantee, bound, trivial)
    with errors_in(f"{task.path}: [learner] "):
        _ = setup.demands.problem  # raises its errors before learning
    return setup


def describe(setup: MlirlSetup) -> str:
    """Sizes of the problem in one line."""
    lengths = np.asarray(setup.demonstrations.length)
    logged = setup.world.logged
    return (
        f"{setup.world.mdp.num_states} states, {setup.model.num_memory} memory states, "
        f"{counted(len(lengths), 'demonstration')} of {counted(int(lengths.sum()), 'pair')}"
        + ("" if logged is None else f", {counted(logged.num_samples, 'logged transition')}")
    )


def learn(setup: MlirlSetup, training: Training) -> MlirlOutcome:
    """Learns with N seeds, keeps the one of least loss, and evaluates all."""
    model, table = setup.model, setup.task.learner
    kept = mlirl.train_guaranteed(
        setup.demands,
        make_hparams(mlirl.Hparams, table.specified()),
        training,
        num_steps=table.steps,
        tolerance=table.tolerance,
    )
    policies = kept.learned.policy
    each = [
        kept.solution if i == kept.chosen else satisfaction_probability(model, policies[i])
        for i in range(len(policies))
    ]
    data = None
    if setup.world.logged is not None:
        # Import here: only worlds of logs have intervals.
        from jaxltl.app.certify import guaranteed

        training.stage("certifying")
        data = guaranteed(setup.world.logged, model, setup.task.formula, kept.policy)
    satisfaction = np.stack([from_starts(model, s.value) for s in each])
    return MlirlOutcome(setup, kept, satisfaction, data, training.seed)


def summary(outcome: MlirlOutcome) -> Record:
    """The results for ``result.json``."""
    setup, kept = outcome.setup, outcome.kept
    learned, i = kept.learned, kept.chosen
    task, world, model = setup.task, setup.world, setup.model
    initial, lengths = np.asarray(model.mdp.initial), np.asarray(setup.demonstrations.length)
    starts, best = np.flatnonzero(initial > 0), setup.guarantee.best
    impossible = starts[from_starts(model, best.upper)[starts] <= 0].tolist()
    result = {
        **about(task.name, task.formula, task.learner.method),
        "in": task.learner.in_,
        "num_states": world.mdp.num_states,
        "num_memory": model.num_memory,
        "demonstrations": {
            **task.demonstrations.entry(len(lengths), lengths.sum()),
            "dropped": setup.dropped,
        },
        "guarantee": _guarantee_entry(setup, kept),
        "trivial": setup.trivial,
        "remark": setup.demands.features.remark,
        "expected_steps": outcome.expected_steps,
        "satisfaction": _evidence(kept.solution, model, world, starts),
        "best_achievable": _evidence(best, model, world, starts),
        "impossible_starts": [world.position(s) for s in impossible],
        "neg_log_likelihood": learned.neg_log_likelihood[i],
        "weights": dict(zip(learned.names, learned.weights[i].tolist(), strict=True)),
        "training": {
            "loss": learned.loss[i],
            "gradient_norm": learned.gradient_norm[i],
            "steps": int(learned.num_steps[i]),
            "converged": bool(learned.converged[i]),
            "solver": Status(int(learned.status[i])).name,
            "hyperparameters": task.learner.hyperparameters(),
        },
        "seeds": {
            "first": outcome.seed,
            "number": len(learned.loss),
            "kept": i,
            "converged": int(learned.converged.sum()),
            "mean": outcome.satisfaction @ initial,
            "minimum": outcome.satisfaction[:, starts].min(axis=1),
            "loss": learned.loss,
            "neg_log_likelihood": learned.neg_log_likelihood,
        },
        **({} if outcome.data is None else {"data": outcome.data}),
    }
    return plain(result)


def _guarantee_entry(setup: MlirlSetup, kept: mlirl.GuaranteedPolicy) -> Record:
    """The guarantee and how it was attained, for ``result.json``."""
    guarantee, model, demonstrations = setup.guarantee, setup.model, setup.demonstrations
    unused, total = guarantee.unused(demonstrations), int(np.sum(demonstrations.length))
    attempt = kept.attempt
    record: Record = {"asked": guarantee.requested, "over": guarantee.over}
    if guarantee.requested == "best" and guarantee.actions is not None:
        record["loss"] = guarantee.actions.loss
    if attempt is not None:
        record |= {"attained": attempt.attained, "weight": attempt.weight, "share": attempt.share}
        state, action = np.asarray(demonstrations.state), np.asarray(demonstrations.action)
        taken = attempt.policy[state, memory_along(model, state), action] > 0
        record["never"] = int((np.asarray(demonstrations.mask) & ~unused & ~taken).sum())
    if unused.any():
        record["unused"] = {"steps": int(unused.sum()), "of": total}
    excluded = guarantee.forbidden & ~unused
    if excluded.any():
        n, t = np.argwhere(excluded)[0]
        before, after = guarantee.cost or (None, None)
        record["left_out"] = {
            "steps": int(excluded.sum()),
            "of": total,
            "demonstration": int(n) + 1,
            "step": int(t) + 1,
            "from": before,
            "to": after,
            **setup.world.position(int(np.asarray(demonstrations.state)[n, t])),
        }
    if guarantee.requested == "none":
        missing = np.subtract(guarantee.best.value, kept.solution.value)
        if at_starts(model, missing, "mean")[0] > 1e-3:  # the guarantee of the remedy
            sure = optimal_actions(model, guarantee.best).attained
            record["remedy"] = at_starts(model, sure.lower, "mean")[0]
    return record


def _evidence(
    solution: Solution, model: Product, world: worlds.MappedModel, starts: np.ndarray
) -> Record:
    parts = bounds_of(solution)
    value, lower, upper = (from_starts(model, x) for x in parts.values())
    worst = int(starts[np.argmin(value[starts])])
    return {
        "mean": {k: at_starts(model, x, "mean")[0] for k, x in parts.items()},
        "minimum": {
            **enclosure(value[worst], lower[starts].min(), upper[worst]),
            **world.position(worst),
        },
        "num_starts": len(starts),
        "status": Status(int(solution.status)).name,
        "residual": solution.residual,
    }


def certifiable(outcome: MlirlOutcome) -> list[Certifiable] | str:
    """The kept policy's satisfaction probability."""
    setup, kept = outcome.setup, outcome.kept
    if setup.world.logged is not None:
        return "the policy is randomised and probabilities are intervals, from a log"
    return [policy_certificate(setup.model, kept.solution, setup.task.formula, kept.policy)]


def save(out: Path, outcome: MlirlOutcome) -> None:
    """Writes the kept policy to ``policy.npz`` in a directory.

    :func:`jaxltl.io.load_policy` reads it. Further arrays: ``weights [F]`` and ``features [F]``,
    ``all_weights [N, F]``; ``satisfaction``, ``lower`` and ``upper`` ``[S, Q]``.
    """
    model, kept = outcome.setup.model, outcome.kept
    learned, i = kept.learned, kept.chosen
    world, weights = outcome.setup.world, learned.weights
    states = world.states or ()
    policy = project_policy(model, kept.policy, actions=world.actions, states=states)
    bounds = bounds_of(kept.solution)
    more = {"weights": weights[i], "features": learned.names, "all_weights": weights}
    more |= {"satisfaction": bounds.pop("value"), **bounds}
    save_policy(out / "policy.npz", policy, more)


# --- the report ---------------------------------------------------------------------------


_OPTIMAL = 1e-6  # certified loss up to which a policy is reported as optimal
_NEGLIGIBLE = 0.05  # weight without a reported meaning


_MEANINGS = {
    "demonstrated": ("takes demonstrated actions", "avoids demonstrated actions"),
    "goal": ("moves to goal states", "avoids goal states"),
    "progress": ("moves on in the automaton", "avoids progress in the automaton"),
    "accepting": ("moves to accepting transitions", "avoids accepting transitions"),
    "avoid": ("avoids these states", "moves to these states"),
    "time": ("prefers short episodes", "prefers long episodes"),
    "nearer": ("takes short paths", "takes long paths"),
}


def _values(result: Result) -> Record:
    """Rows of certified probabilities and of the effects of weights."""
    evidence, weights, data, from_log = [], [], result.get("data"), ""
    for title, key in (("learned policy", "satisfaction"), ("optimum", "best_achievable")):
        values = {k: page.probability(result[key][k]["value"]) for k in ("mean", "minimum")}
        for kind, value in values.items():
            one, least = result[key][kind], kind == "minimum"
            if not least or values["mean"] != value:  # else all initial states have the same one
                where, status = position_text(one) if least else "", result[key]["status"].lower()
                evidence.append((title, kind, value, page.certified(one), where, status))
    for name, x in result["weights"].items():
        tiny = x is None or abs(x) < _NEGLIGIBLE
        weights.append((name, page.number(x), "negligible" if tiny else _MEANINGS[name][x < 0]))
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
        "weights": weights,
        "likelihood": "infinite" if never else page.number(result["neg_log_likelihood"]),
        "from_log": from_log,
        "optimal": _OPTIMAL,
        "steps": steps,
    }


report = page.Report("mlirl", _values)


_CURVES = "Loss, satisfaction probability and gradient before each step"
LIVE = "policy"  # name of the interactive part


def task_pictures(setup: MlirlSetup) -> list[Picture]:
    """Picture of the formula's automaton."""
    return [automaton_picture(setup.model.automaton, LIVE)]


_FIGURES = ("loss", "neg_log_likelihood", "satisfaction", "gradient_norm")


def sections(outcome: MlirlOutcome) -> list[page.Section]:
    """The policy on the map, expected steps, and learning curves."""
    setup, model, learned = outcome.setup, outcome.setup.model, outcome.kept.learned
    world, policy = setup.world, np.asarray(outcome.kept.policy)
    return [
        *([] if world.cells is None else _maps(outcome, world.cells)),
        *steps.pictures(plain(outcome.expected_steps)),
        Explorer(
            name=LIVE,
            title="Learned policy",
            caption=_TABLE if world.cells is None else _MAP,
            size=world.mdp.num_states,
            automaton=model.automaton,
            layers=_layers(outcome),
            runs=[
                *demonstrated_runs(model, setup.demonstrations),
                *learned_runs(model, policy, outcome.seed),
            ],
            place=world.cells,
            actions=world.actions,
            places=dict(enumerate(world.states or ())),
            label=_LABEL,
            wall=setup.task.world.wall or "#",
            marked=_left_out(setup),
            marks="Demonstrated steps that lower the maximal satisfaction probability",
        ),
        *page.learning_curves(learned.history, _FIGURES, _CURVES, len(learned.loss)),
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


def _layers(outcome: MlirlOutcome) -> dict[str, MapLayer]:
    """A layer for each memory state that is undecided and reachable, and one of initial states."""
    model = outcome.setup.model
    policy = np.asarray(outcome.kept.policy)
    value = np.array(outcome.kept.solution.value)
    starts = np.asarray(model.mdp.initial) > 0
    undecided = verdicts(model.automaton) == Verdict.UNDECIDED
    restricted, met = restrict(model), np.zeros(model.state_shape, bool)  # reachable states
    met[np.asarray(restricted.base_state), np.asarray(restricted.memory)] = True
    memories = np.flatnonzero(undecided & met.any(axis=0)).tolist()
    names = model.automaton.state_names or ("",) * model.num_memory
    value_met, policy_met = np.where(met, value, np.nan), np.where(met[..., None], policy, np.nan)
    layers = {
        str(q): MapLayer(f"memory state {q}: {names[q]}", value_met[:, q], policy_met[:, q])
        for q in memories
    }
    at_start = np.where(starts, from_starts(model, value), np.nan)
    return {**layers, START: MapLayer("initial states", at_start, None)}


def _maps(outcome: MlirlOutcome, cells: np.ndarray) -> list[Picture]:
    layers = _layers(outcome)
    drawn = drawing("grid", cells, layers.pop(START).value, label=_LABEL)
    text = "Satisfaction probability of the learned policy from each initial state."
    maps = [Picture("values.svg", "Satisfaction probability", drawn, text, LIVE)]
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
        text = f"One map for each state of the automaton, which is the policy's memory. {_MAP}"
        maps.append(Picture("policy.svg", "Learned policy", drawn, text, LIVE))
    return maps


def _left_out(setup: MlirlSetup) -> list[tuple[int, int, int]]:
    """World state, memory state and action of the steps that are left out, each once."""
    model, guarantee, demonstrations = setup.model, setup.guarantee, setup.demonstrations
    state, action = np.asarray(demonstrations.state), np.asarray(demonstrations.action)
    marked = guarantee.forbidden | guarantee.unused(demonstrations)
    steps = np.stack([state, memory_along(model, state), action], -1)[marked]
    return [(s, q, a) for s, q, a in np.unique(steps, axis=0).tolist()]
