"""Proofs of learned policies in reports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from jaxltl.app.reports.drawing import Picture
from jaxltl.app.wording import Record, Result
from jaxltl.core.array_types import Floats
from jaxltl.core.continuous.certificate import HOW, Certificate
from jaxltl.core.continuous.dynamics import Dynamics
from jaxltl.core.environments.episodes import Episode
from jaxltl.core.pretty_print import rounded_outward
from jaxltl.io.templates import render

_DIGITS = 7


@dataclass(frozen=True)
class Proof:
    """The certificate of a policy and, if it is refuted, a violating run ``float[T + 1, n]``."""

    certificate: Certificate
    violation: Floats | None = None


def entry(result: Proof | str) -> Record:
    """A proof, or the reason for which there is none, as a JSON object."""
    if isinstance(result, str):
        return {"reason": result}
    proof = result.certificate
    lower, upper = proof.initial_bounds
    how = proof.how[proof.initial]
    return {
        "formula": proof.formula,
        "lower": lower,
        "upper": upper,
        "status": proof.status.name,
        "cells": proof.grid.num_cells,
        "initial_cells": int(proof.initial.sum()),
        "how": {text: int((how == key).sum()) for key, text in HOW.items()},
        "counterexample": None if result.violation is None else result.violation.tolist(),
        "seconds": {name: round(x, 3) for name, x in proof.seconds.items()},
    }


def sentence(proof: Result) -> str:
    """The certified bounds of an entry, in lines, or the reason for which there is no proof."""
    if "reason" in proof:
        return f"no proof: {proof['reason']}"
    text = render("jaxltl.app.reports", "proof.txt", proof=proof, bounds=bounds(proof))
    return text.rstrip("\n")


def bounds(proof: Result) -> list[str]:
    """The certified bounds of an entry, rounded outward, if it has bounds."""
    ends = (("lower", False), ("upper", True))
    return [rounded_outward(proof[name], up, _DIGITS) for name, up in ends if name in proof]


def picture(proof: Proof, dynamics: Dynamics, episodes: Sequence[Episode]) -> Picture:
    """The map of lower bounds, with episodes or with the violating run."""
    # Deferred: matplotlib.
    from jaxltl.plot.certificates import certificate
    from jaxltl.plot.style import to_bytes

    if proof.violation is not None:
        runs = [proof.violation]
    else:  # the world of a time limit is (state, time)
        states = [np.asarray(jax.tree.leaves(one.world.world)[0]) for one in episodes]
        runs = [x[: int(np.sum(one.valid)) + 1] for x, one in zip(states, episodes, strict=True)]
    return Picture(
        "certificate.svg",
        "Certified lower bounds",
        to_bytes(certificate(proof.certificate, dynamics, runs=runs)),
        "Lower bounds of the satisfaction probability by initial state, for the policy without random "
        f"actions, with {'sampled runs' if proof.violation is None else 'a run that violates it'}. "
        "States that no initial state reaches may have the trivial bound 0.",
    )
