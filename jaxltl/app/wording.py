"""Result types of jobs: JSON records of bounds, and their text."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jaxltl

if TYPE_CHECKING:
    import numpy as np

Result = Mapping[str, Any]  # contents of result.json
Record = dict[str, Any]  # values by name: JSON objects, keyword arguments


def enclosure(*numbers: object) -> Record:
    """A number with its lower and upper bound."""
    return dict(zip(("value", "lower", "upper"), numbers, strict=True))


def bounds_of(quantity: Any) -> Record:
    """The value of a solution or of another certified quantity, with its bounds."""
    return enclosure(quantity.value, quantity.lower, quantity.upper)


def counted(number: int, noun: str) -> str:
    """Number with its noun, in the plural unless the number is 1."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


# --- entries of result.json -----------------------------------------------------------------------


def about(task: str, formula: str, method: str) -> Record:
    """The first entries of a result."""
    return {"task": task, "formula": formula, "method": method}


def took(seconds: float) -> Record:
    """The last entries of a result."""
    import jax

    versions = {"jaxltl": jaxltl.__version__, "jax": jax.__version__}
    return {"seconds": round(seconds, 2), "versions": versions}


def plain(value: object) -> Any:
    """A value of JSON: arrays become lists, NaN and infinity become None."""
    import jax  # here, since mistakes in files are reported before it is imported
    import numpy as np

    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(np.asarray(value).tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def fingerprint(digest: str, seed: int, num_seeds: int) -> str:
    """Fingerprint of a run of a task, which a checkpoint must have to be resumed."""
    import jax
    import jax.numpy as jnp

    versions = jaxltl.__version__, jax.__version__, str(jnp.result_type(float))
    parts = [digest, seed, num_seeds, *versions]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]


# Reduction over seeds, and format, of metrics of a step.
_PROGRESS = {
    "episode_return": ("nanmedian", ".3g"),
    "objective": ("nanmedian", ".3g"),
    "reward": ("nanmedian", ".3g"),
    "cost": ("nanmedian", ".3g"),
    "loss": ("min", ".4f"),
    "value": ("max", ".4f"),
    "gradient_norm": ("max", ".1e"),
}


def postfix(metrics: Mapping[str, np.ndarray]) -> dict[str, str]:
    """Two metrics of the newest step, for the progress bar."""
    import numpy as np

    known = [n for n in _PROGRESS if n in metrics and np.isfinite(metrics[n]).any()]
    figures = ((n.removesuffix("_norm"), metrics[n], *_PROGRESS[n]) for n in known[:2])
    return {n: f"{getattr(np, reduction)(x):{form}}" for n, x, reduction, form in figures}
