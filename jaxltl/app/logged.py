"""Worlds that are known from a log: as they are learned in, and what is guaranteed there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxltl.app.certify import Asked, Evidence, certify, read_evidence, sample_next
from jaxltl.app.files.models import padded
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.product import Product, product
from jaxltl.core.types import Status
from jaxltl.core.values.undiscounted.mixture import from_starts, safe_mean
from jaxltl.core.values.undiscounted.satisfaction import satisfaction_probability


@dataclass(frozen=True)
class Logged:
    """The log that a world was counted from.

    Attributes:
      evidence: the world with its frequencies, choice by choice, and the counts.
      column: ``int[R]``, the action that each choice is where the world is padded.
      confidence, method: of the sets of distributions.
    """

    evidence: Evidence
    column: np.ndarray
    confidence: float
    method: str

    @property
    def states(self) -> tuple[str, ...]:
        """S names."""
        return self.evidence.states

    @property
    def num_samples(self) -> int:
        """How many transitions were logged."""
        return int(self.evidence.counts.sum())


def load_logged(beside: Path, spec: Mapping[str, Any]) -> tuple[MDP, tuple[str, ...], Logged]:
    """The world of a log, with frequencies as probabilities, and the names of its actions.

    Args:
      beside: the folder of the files that are named.
      spec: ``[world]`` of a task file.

    Raises:
      ValueError: naming the file and the line, or the key.
    """
    initial = spec["initial"]
    evidence = read_evidence(
        beside / spec["transitions"],
        labels=beside / spec["labels"] if "labels" in spec else None,
        initial=[initial] if isinstance(initial, str) else initial,
        terminal=spec.get("terminal", ()),
        graph=spec.get("graph", "seen"),
        option="{} = ",
    )
    mdp, actions, column = padded(evidence.model)
    return (
        mdp,
        actions,
        Logged(evidence, column, float(spec["confidence"]), spec.get("method", "anytime")),
    )


def guaranteed(logged: Logged, model: Product, formula: str, policy: Any) -> dict[str, Any]:
    """What the log guarantees of a policy of the world's product with a formula.

    The policy may have been chosen by the same log: the sets hold the true distributions all at
    once, so that what holds against nature holds for any policy.

    Args:
      logged: the log.
      model: the product of the padded world.
      formula: its task.
      policy: ``float[S, Q, A]``.

    Returns:
      For ``result.json``: ``guaranteed``, which the task's probability under the policy is at
      least, ``best_guaranteed``, that of the best policy against nature, and ``optimistic``, which
      no policy exceeds; all with one ``confidence``.
    """
    evidence = logged.evidence
    best = certify(evidence, Asked(formula, logged.confidence, logged.method, "max"))
    against = product(best.model, model.automaton, label_on=model.label_on)
    weights: Any = np.asarray(policy)[evidence.model.host.state, :, logged.column]
    found = satisfaction_probability(against, weights, nature="min")
    share = np.asarray(evidence.model.initial)
    lower = from_starts(against, found.lower)[share > 0]
    codes = int(found.status), int(best.satisfaction.solution.status)
    status = next((c for c in codes if c != Status.CONVERGED), int(Status.CONVERGED))
    return {
        "confidence": logged.confidence,
        "guaranteed": safe_mean(share[share > 0], lower, up=False),
        "best_guaranteed": best.bound,
        "optimistic": best.optimistic,
        "samples": logged.num_samples,
        "method": logged.method,
        "status": Status(status).name,
        "sample_next": sample_next(evidence, best),
    }
