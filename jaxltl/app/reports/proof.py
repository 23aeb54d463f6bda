"""Proofs of learned policies in reports."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np

from jaxltl.app.reports.drawing import Picture
from jaxltl.app.wording import Record, Result
from jaxltl.core.continuous.certificate import HOW, Certificate
from jaxltl.core.continuous.dynamics import Dynamics
from jaxltl.core.environments.episodes import Episode
from jaxltl.core.pretty_print import rounded_outward

_DIGITS = 7


def entry(proof: Certificate | str) -> Record:
    """A proof, or the reason for which there is none, as a JSON object."""
    if isinstance(proof, str):
        return {"reason": proof}
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
        "seconds": {name: round(x, 3) for name, x in proof.seconds.items()},
    }


def sentence(proof: Result) -> str:
    """The certified bounds of an entry, in two lines, or the reason for which there is no proof."""
    if "reason" in proof:
        return f"no proof: {proof['reason']}"
    shares = ", ".join(f"{count:,} {text}" for text, count in proof["how"].items() if count)
    stages = ", ".join(f"{name} {x:.2g} s" for name, x in proof["seconds"].items())
    lower, upper = _bounds(proof)
    return (
        f"proven: probability at least {lower} from every initial state; the least upper bound is "
        f"{upper} ({proof['status']}, deterministic policy)\n"
        f"  {proof['initial_cells']:,} of {proof['cells']:,} cells are initial: "
        f"{shares or 'no lower bound'}; {stages}"
    )


def tiles(proof: Result) -> list[tuple[str, str]]:
    """The bounds of an entry with their meaning, if it has bounds."""
    if "lower" not in proof:
        return []
    lower, upper = _bounds(proof)
    return [(f"[{lower}, {upper}]", "certified bounds of the worst initial state")]


def _bounds(proof: Result) -> tuple[str, str]:
    return (
        rounded_outward(proof["lower"], False, _DIGITS),
        rounded_outward(proof["upper"], True, _DIGITS),
    )


def picture(proof: Certificate, dynamics: Dynamics, episodes: Sequence[Episode]) -> Picture:
    """The map of lower bounds, with episodes."""
    # Deferred: matplotlib.
    from jaxltl.plot.certificates import certificate
    from jaxltl.plot.style import to_bytes

    runs = []
    for one in episodes:
        states = np.asarray(jax.tree.leaves(one.world.world)[0])  # of a time limit: (state, time)
        runs.append(states[: int(np.asarray(one.valid).sum()) + 1])
    return Picture(
        "certificate.svg",
        "Certified lower bounds",
        to_bytes(certificate(proof, dynamics, runs=runs)),
        "Lower bounds of the satisfaction probability by initial state, for the deterministic policy, "
        "with sampled runs. Bounds hold for real arithmetic.",
    )
