"""Shared parts of learning jobs: fingerprints, result entries, files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxltl
from jaxltl.app.files.task import FormulaFile
from jaxltl.app.reports.drawing import Picture, drawing
from jaxltl.core.automata.automaton import Automaton
from jaxltl.app.wording import Record


def postfix(metrics: Mapping[str, np.ndarray]) -> dict[str, str]:
    """Least loss and greatest gradient norm over seeds, for the progress bar."""
    return {
        "loss": f"{metrics['loss'].min():.4f}",
        "gradient": f"{metrics['gradient_norm'].max():.1e}",
    }


def fingerprint(digest: str, seed: int, num_seeds: int) -> str:
    """Fingerprint of a run of a task, which a checkpoint must have to be resumed."""
    parts = [
        digest,
        seed,
        num_seeds,
        jaxltl.__version__,
        jax.__version__,
        str(jnp.result_type(float)),
    ]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]


def about(task: FormulaFile) -> Record:
    """The first entries of a result."""
    return {"task": task.name, "formula": task.formula, "method": task.learner.method}


def took(seconds: float) -> Record:
    """The last entries of a result."""
    versions = {"jaxltl": jaxltl.__version__, "jax": jax.__version__}
    return {"seconds": round(seconds, 2), "versions": versions}


def plain(value: object) -> Any:
    """A value of JSON: arrays become lists, NaN and infinity become None."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(np.asarray(value).tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def automaton_picture(automaton: Automaton, live: str) -> Picture:
    """The picture of the formula's automaton."""
    return Picture(
        "automaton.svg",
        "Automaton of the formula",
        drawing("automaton", automaton),
        "Double circle: any continuation satisfies the formula. Grey: it is violated. States are "
        "named by the remaining formula.",
        live,
    )


def learning_picture(
    history: Mapping[str, np.ndarray], caption: str, show: Sequence[str]
) -> Picture:
    """The picture of some learning curves."""
    series = {k: history[k].T for k in show if k in history}
    drawn = drawing("curves", series, steps=history["step"])
    return Picture("learning.svg", "Learning", drawn, caption, "learning")


def over_seeds(count: int) -> str:
    """The end of a caption of learning curves."""
    band = "; the line is the median over seeds, the band their range"
    return f"{band if count > 1 else ''}."


def short_name(text: str, width: int = 44) -> str:
    """A name truncated to `width` characters."""
    return text if len(text) <= width else text[: width - 1] + "…"
