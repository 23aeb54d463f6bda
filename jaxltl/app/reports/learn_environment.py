"""Report of learning in an environment: estimates from fresh episodes, with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from jaxltl.plot.drawing import Picture
from jaxltl.app.reports.page import number, probability, Report
from jaxltl.app.wording import Record, Result
from jaxltl.core.array_types import Floats
from jaxltl.core.continuous.certificate import Certificate, HOW
from jaxltl.core.continuous.dynamics import Dynamics
from jaxltl.core.environments.episodes import Episode
from jaxltl.core.pretty_print import rounded_outward
from jaxltl.io.templates import render

_PROBABILITIES = ("success", "violation", "undecided")


def _values(result: Result) -> Record:
    """The proof in words, and rows of estimates."""
    # Visits are the estimate of interest where no finite episode decides the formula.
    visits = () if result["acceptance"] in ("cosafe", "safety") else ("visits",)
    names = (*_PROBABILITIES, *visits)
    evaluation, seeds = result["evaluation"], result["seeds"]
    return {
        "tiles": [(name, *_numbers(name, evaluation)) for name in (*names, "length")],
        "bounds": proof_bounds(result.get("proof") or {}),
        "proof": proof_sentence(result["proof"]) if result.get("proof") else "",
        "estimates": [
            (name.replace("_", " "), *_numbers(name, evaluation), evaluation[name]["method"])
            for name in evaluation["estimates"]
            if visits or "visits" not in name
        ],
        "seed_header": ("seed", *names),
        "seed_rows": [
            (
                f"{i}{' (kept)' if i == seeds['kept'] else ''}",
                *(" ".join(_numbers(name, one)) for name in names),
            )
            for i, one in enumerate(seeds["evaluations"])
        ],
    }


def _numbers(name: str, evaluation: Result) -> tuple[str, str]:
    """An estimate and its interval."""
    value, *ends = (evaluation[name][key] for key in ("mean", "lower", "upper"))
    if name in _PROBABILITIES:
        return probability(value), "[{:.4f}, {:.4f}]".format(*ends)
    return number(value), "[{}, {}]".format(*map(number, ends))


report = Report("environment", _values)


# --- proofs -------------------------------------------------------------------------------


_DIGITS = 7


@dataclass(frozen=True)
class Proof:
    """The certificate of a policy and, if it is refuted, a violating run ``float[T + 1, n]``."""

    certificate: Certificate
    violation: Floats | None = None


def proof_entry(result: Proof | str) -> Record:
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


def proof_sentence(proof: Result) -> str:
    """The certified bounds of an entry, in lines, or the reason for which there is no proof."""
    if "reason" in proof:
        return f"no proof: {proof['reason']}"
    text = render("jaxltl.app.reports", "proof.txt", proof=proof, bounds=proof_bounds(proof))
    return text.rstrip("\n")


def proof_bounds(proof: Result) -> list[str]:
    """The certified bounds of an entry, rounded outward, if it has bounds."""
    ends = (("lower", False), ("upper", True))
    return [rounded_outward(proof[name], up, _DIGITS) for name, up in ends if name in proof]


def proof_picture(proof: Proof, dynamics: Dynamics, episodes: Sequence[Episode]) -> Picture:
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
