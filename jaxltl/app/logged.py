"""Worlds estimated from logs: the model of frequencies, and guarantees of policies."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxltl.app.certify import (
    Evidence,
    Query,
    Source,
    certify,
    graph_of_options,
    read_evidence,
    sample_next,
)
from jaxltl.app.files.models import padded
from jaxltl.app.files.task_mlirl import WorldTable
from jaxltl.core.models import MDP, Product, product
from jaxltl.core.types import Status
from jaxltl.core.values.engine.state_quantities import safe_mean
from jaxltl.core.values.undiscounted.mixture import from_starts
from jaxltl.core.values.undiscounted.satisfaction import satisfaction_probability
from jaxltl.app.wording import Record


@dataclass(frozen=True)
class Logged:
    """The log from which a world was estimated."""

    evidence: Evidence  # the world with its frequencies, and the counts
    column: np.ndarray  # int[R], the action of each choice in the padded world
    confidence: float  # confidence, method: of the confidence sets
    method: Literal["anytime", "clopper-pearson", "hoeffding", "weissman"]

    @property
    def states(self) -> tuple[str, ...]:
        return self.evidence.states

    @property
    def num_samples(self) -> int:
        return int(self.evidence.counts.sum())


def load_logged(folder: Path, table: WorldTable) -> tuple[MDP, tuple[str, ...], Logged]:
    """The world of a log, with frequencies as probabilities, the names of its actions, and the log."""
    initial, confidence = table.initial or [], table.confidence
    assert table.transitions is not None and confidence is not None
    evidence = read_evidence(
        folder / table.transitions,
        Source(
            labels=None if table.labels is None else folder / table.labels,
            initial=[initial] if isinstance(initial, str) else initial,
            terminal=table.terminal or (),
            graph=graph_of_options(table.graph, table.least_probability, confidence),
        ),
        option="{} = ",
    )
    mdp, actions, column = padded(evidence.model)
    return (mdp, actions, Logged(evidence, column, confidence, table.method or "anytime"))


def guaranteed(logged: Logged, model: Product, formula: str, policy: Any) -> Record:
    """Guaranteed satisfaction probability of a policy, from the log alone.

    The policy may depend on the log: with the given confidence all sets hold the true distributions
    at once, so that the worst case over them bounds every policy. In the result, ``guaranteed`` is
    a lower bound for the policy, ``best_guaranteed`` the greatest one of any policy, and
    ``optimistic`` an upper bound for all policies.
    """
    evidence = logged.evidence
    best = certify(evidence, Query(formula, logged.confidence, logged.method, "max"))
    against = product(best.model, model.automaton, label_on=model.label_on)
    weights: Any = np.asarray(policy)[evidence.model.host.state, :, logged.column]
    found = satisfaction_probability(against, weights, nature="adversarial")
    share = np.asarray(evidence.model.initial)
    lower = from_starts(against, found.lower)[share > 0]
    codes = int(found.status), int(best.satisfaction.solution.status)
    status = next((c for c in codes if c != Status.CONVERGED), int(Status.CONVERGED))
    return {
        "confidence": logged.confidence,
        "guaranteed": safe_mean(share[share > 0], lower, up=False),
        "best_guaranteed": best.bound,
        "optimistic": best.optimistic,
        "assumption": best.assumption,
        "samples": logged.num_samples,
        "method": logged.method,
        "status": Status(status).name,
        "sample_next": sample_next(evidence, best),
    }
