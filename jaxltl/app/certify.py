"""Certified policies from logs of transitions: ``jaxltl certify``, and worlds of task files."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from jaxltl.io.padded_models import padded
from jaxltl.app.command_options import CertifyOptions, write_proofs
from jaxltl.app.files.task_irl import ModelTable
from jaxltl.app.wording import Record
from jaxltl.core import validation
from jaxltl.core import models
from jaxltl.core.models.construct.counts import listed
from jaxltl.core.pretty_print import rounded_outward
from jaxltl.core.statistics.confidence_sets import Graph, LeastProbability, check_confidence
from jaxltl.core.types import Status
from jaxltl.core.validation import Range
from jaxltl.core import values
from jaxltl.core.values.engine.state_quantities import safe_mean
from jaxltl.core.values.undiscounted.mixture import from_starts
from jaxltl.io.templates import render

NUM_RECOMMENDED = 5  # choices for which more samples are recommended
POINTS = 13  # of a curve
PICTURES = (".svg", ".png", ".pdf")


@dataclass(frozen=True)
class CountEvidence:
    """A model and its transition counts."""

    model: models.SparseMDP  # its probabilities are frequencies, or those of a given model
    counts: np.ndarray  # int64[T], of the model's entries
    states: tuple[str, ...]  # S names, and the action of each choice
    actions: tuple[str, ...]
    graph: Graph  # assumption on transitions that the log does not contain

    @property
    def num_samples(self) -> int:
        return int(self.counts.sum())


def read_evidence(
    log: Path,
    option: str = "--{} ",
    *,
    labels: Path | None = None,
    model: Path | None = None,
    initial: Sequence[str] = (),
    terminal: Sequence[str] = (),
    graph: Graph | None = None,
) -> CountEvidence:
    """Transition counts of a log, with its table of labels, or of a model file with its graph.

    `graph` is by default "complete"; see :func:`~jaxltl.core.models.construct.counts.model_from_counts`.
    `option` formats names of options in errors.
    """
    from jaxltl.io.log import read_labels, read_log

    if model is not None:
        from jaxltl.app.solve import load

        source_model = load(model)
        if not isinstance(source_model, models.SparseMDP):
            raise ValueError(f"{str(model)!r} has intervals already; solve it by `jaxltl solve`.")
        if labels is not None or terminal or initial:
            raise ValueError(
                "a model has its labels and initial states; leave --labels, --initial "
                "and --terminal out."
            )
        if graph is not None:
            raise ValueError("a model has its graph; leave --graph and --least-probability out.")
        aligned = models.align_counts(source_model, read_log(log, source_model))
        return _named(source_model, aligned, "given")
    counts = read_log(log)
    if not initial:
        raise ValueError(
            f"{str(log)!r} does not name the states in which episodes begin; add "
            f"{option.format('initial')}STATE; there are {listed(counts.states)}."
        )
    assumed: Record = {"labels": None if labels is None else read_labels(labels, counts.states)}
    assumed |= {"initial": list(initial), "terminal": terminal, "graph": graph or "complete"}
    return _named(*models.model_from_counts(counts, **assumed), assumed["graph"])


def graph_of_options(
    graph: str | None, least_probability: float | None, confidence: float
) -> Graph | None:
    """Graph assumption by options; a least probability takes a tenth of the failures."""
    if least_probability is None:
        return graph  # type: ignore[return-value]
    if graph is not None:
        raise ValueError("graph and least probability are two assumptions; give one of them.")
    above_zero = Range(0, 1, open_below=True)
    validation.require_in_range("least probability", least_probability, above_zero)
    return LeastProbability(least_probability, failure=(1 - confidence) / 10)


def _named(model: models.SparseMDP, counts: np.ndarray, graph: Graph) -> CountEvidence:
    states = model.valuation.get("state")
    names = range(model.num_states) if states is None else states
    rank = np.arange(model.num_rows) - model.host.row_start[model.host.state]
    number = rank if model.action is None else np.asarray(model.action)
    actions = [model.action_names[a] if model.action_names else str(a) for a in number]
    return CountEvidence(model, counts, tuple(map(str, names)), tuple(actions), graph)


def certify(evidence: CountEvidence, query: Record) -> values.DataGuarantee:
    """Guarantee of a log; the query has further arguments of :func:`jaxltl.learn_guarantee`."""
    return values.learn_guarantee(evidence.model, evidence.counts, graph=evidence.graph, **query)


def entry(
    evidence: CountEvidence, query: Record, guarantee: values.DataGuarantee, seconds: float
) -> Record:
    """Guarantee from a log, as a JSON object."""
    return {
        "formula": query["formula"],
        "objective": query["objective"],
        "bound": guarantee.bound,
        "optimistic": guarantee.optimistic,
        "confidence": guarantee.confidence,
        "assumption": guarantee.assumption,
        "method": query["method"],
        "status": Status(int(guarantee.satisfaction.status)).name,
        "samples": evidence.num_samples,
        "claims": guarantee.sets.num_claims,
        "states": evidence.model.num_states,
        "choices": evidence.model.num_rows,
        "sample_next": sample_next(evidence, guarantee),
        "seconds": seconds,
    }


def sample_next(evidence: CountEvidence, guarantee: values.DataGuarantee) -> list[Record]:
    """Choices of which more samples improve the guarantee most, in decreasing order."""
    return [
        {
            "state": evidence.states[int(evidence.model.host.state[r])],
            "action": evidence.actions[r],
            "gain": float(guarantee.gain[r]),
            "samples": int(guarantee.sets.num_samples[r]),
        }
        for r in np.argsort(-guarantee.gain, kind="stable")[:NUM_RECOMMENDED].tolist()
        if guarantee.gain[r] > 1e-12
    ]


def curve(evidence: CountEvidence, query: Record) -> tuple[list[int], list[float]]:
    """The guarantee by number of samples, for one random order of the log."""
    total = evidence.num_samples
    sizes = np.unique(np.geomspace(max(total / 10**3, 1), max(total, 1), POINTS).astype(int))
    options: Record = {"sizes": sizes.tolist(), "graph": evidence.graph, **query}
    bound = values.guarantee_curve(evidence.model, evidence.counts, **options)
    return sizes.tolist(), bound.tolist()


# --- worlds of task files --------------------------------------------------------------------


@dataclass(frozen=True)
class Logged(CountEvidence):
    """The log from which a world was estimated."""

    column: np.ndarray  # int[R], the action of each choice in the padded world
    query: Record  # confidence and method of the confidence sets


def load_logged(folder: Path, table: ModelTable) -> tuple[models.MDP, tuple[str, ...], Logged]:
    """The world of a log, with frequencies as probabilities, the names of its actions, and the log."""
    initial, confidence = table.initial or [], table.confidence
    assert table.transitions is not None and confidence is not None
    evidence = read_evidence(
        folder / table.transitions,
        "{} = ",
        labels=None if table.labels is None else folder / table.labels,
        initial=[initial] if isinstance(initial, str) else initial,
        terminal=table.terminal or (),
        graph=graph_of_options(table.graph, table.least_probability, confidence),
    )
    mdp, actions, column = padded(evidence.model)
    query = {"confidence": confidence, "method": table.method or "anytime"}
    return mdp, actions, Logged(**vars(evidence), column=column, query=query)


def guaranteed(logged: Logged, model: models.Product, formula: str, policy: Any) -> Record:
    """Guaranteed satisfaction probability of a policy, from the log alone.

    The policy may depend on the log: with the given confidence all sets hold the true distributions
    at once, so that the worst case over them bounds every policy. In the result, ``guaranteed`` is
    a lower bound for the policy, ``best_guaranteed`` the greatest one of any policy, and
    ``optimistic`` an upper bound for all policies.
    """
    best = certify(logged, {"formula": formula, **logged.query})
    against = models.product(best.model, model.automaton, label_on=model.label_on)
    weights: Any = np.asarray(policy)[logged.model.host.state, :, logged.column]
    worst = values.satisfaction_probability(against, weights, nature="adversarial")
    share = np.asarray(logged.model.initial)
    lower = from_starts(against, worst.lower)[share > 0]
    codes = int(worst.status), int(best.satisfaction.status)
    status = next((c for c in codes if c != Status.CONVERGED), int(Status.CONVERGED))
    return {
        "confidence": logged.query["confidence"],
        "guaranteed": safe_mean(share[share > 0], lower, up=False),
        "best_guaranteed": best.bound,
        "optimistic": best.optimistic,
        "assumption": best.assumption,
        "samples": logged.num_samples,
        "method": logged.query["method"],
        "status": Status(status).name,
        "sample_next": sample_next(logged, best),
    }


# --- the command -----------------------------------------------------------------------------


def certify_and_write(log: Path, formula: str, options: CertifyOptions) -> Record:
    """Runs the command, output files opened first, and returns the result."""
    from jaxltl.io.certificate import results
    from jaxltl.core.files import atomic_write
    from jaxltl.core.policies.policy_file import save_policy

    assert options.confidence is not None
    directions = ("min", "max") if options.smallest else ("max", "min")
    query: Record = {"formula": formula, "objective": directions[0]}
    query |= {"confidence": options.confidence, "method": options.method}
    names = ("labels", "model", "initial", "terminal")
    source: Record = {name: getattr(options, name) for name in names}
    source["graph"] = graph_of_options(options.graph, options.least_probability, options.confidence)
    check_confidence(options.confidence)
    picture, proof = options.curve, options.certificate
    if picture is not None and picture.suffix not in PICTURES:
        raise ValueError(f"--curve {picture}: the name must end in {', '.join(PICTURES)}.")
    with contextlib.ExitStack() as held:
        file, drawing = (
            None if path is None else held.enter_context(atomic_write(path))
            for path in (options.policy, picture)
        )
        evidence = read_evidence(log, **source)
        begin = time.perf_counter()
        guarantee = certify(evidence, query)
        result = entry(evidence, query, guarantee, time.perf_counter() - begin)
        complete, rounded = evidence.graph == "complete", rounded_outward
        context: Record = {"result": result, "complete": complete, "rounded": rounded}
        lines = render("jaxltl.app.reports", "certify.txt", formula=repr(formula), **context)
        click.echo(lines.rstrip("\n"))
        if proof is not None:
            question = results.formula_question(formula, *directions)
            one = results.Certifiable(guarantee.model, guarantee, question)
            result["certificates"] = write_proofs(proof, [one])
        if file is not None:
            about = json.dumps({**result, "seconds": None}, allow_nan=False)
            model, best = evidence.model, guarantee.satisfaction
            learned = models.project_policy(model, best, states=evidence.states)
            save_policy(file, learned, {"result": about})
        if picture is not None and drawing is not None:
            from jaxltl import plot

            sizes, bound = curve(evidence, query)
            result["curve"] = {"samples": sizes, "bound": bound}
            figure = plot.guarantees(sizes, {"guaranteed": bound}, reference=guarantee.optimistic)
            drawing.write(plot.to_bytes(figure, picture.suffix[1:]))
    return result
