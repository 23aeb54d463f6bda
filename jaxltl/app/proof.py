"""Proofs of learned policies in continuous worlds, of task files and of ``jaxltl certify``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np

from jaxltl.app.reports.drawing import Picture
from jaxltl.app.wording import Record
from jaxltl.core.continuous.certificate import (
    HOW,
    Certificate,
    ProofOptions,
    certify_policy,
)
from jaxltl.core.continuous.dynamics import Dynamics
from jaxltl.core.continuous.learned_policy import state_policy
from jaxltl.core.environments.environment import Environment
from jaxltl.core.environments.episodes import Agent, Episode
from jaxltl.core.types import Status


def prove(
    dynamics: Dynamics,
    agent: Agent,
    environment: Environment,
    formula: str,
    options: ProofOptions,
) -> Certificate:
    """The certificate of an agent that was learned in a task environment of dynamics."""
    return certify_policy(dynamics, state_policy(agent, environment), formula, **options)


def entry(proof: Certificate | str | None) -> Record | None:
    """A proof, or the reason for which there is none, as a JSON object."""
    if proof is None or isinstance(proof, str):
        return None if proof is None else {"reason": proof}
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


def certify_policy_file(
    policy: Path, formula: str | None, say: Callable[[str], None]
) -> tuple[Record, Status]:
    """Proves a policy that ``jaxltl learn`` wrote; returns the entry and the status."""
    from jaxltl.app.learn_environment import load_policy

    setup, agent = load_policy(policy)
    if setup.dynamics is None:
        raise ValueError(
            f"{policy}: its world {setup.task.world.environment!r} is a simulator without bounds; "
            "proofs need a world of make_dynamics."
        )
    options: ProofOptions = {**setup.task.proof.given(), "report": say}  # type: ignore[typeddict-item]
    formula = formula or setup.task.formula
    found = prove(setup.dynamics, agent, setup.environment, formula, options)
    result = entry(found)
    assert result is not None
    return result, found.status
