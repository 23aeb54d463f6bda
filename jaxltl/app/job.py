"""What all jobs of learning share: seeds side by side, results, files and pictures."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import json
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

import jaxltl
from jaxltl.algos.common.checkpoint import atomic_write
from jaxltl.algos.common.chunks import Chunks, run_in_chunks, trace_lanes
from jaxltl.app.drawing import Picture, drawing
from jaxltl.app.files.task import Task
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.models.mesh.lanes import on_host, vmap_over_mesh
from jaxltl.core.models.product import Product

Report = Callable[[int, Mapping[str, np.ndarray]], None]


def settings(kind: Any, spec: Mapping[str, Any]) -> Any:
    """A learner's Hparams of the keys of ``[learner]`` that it has; the method is another's."""
    names = [field.name for field in dataclasses.fields(kind) if field.name != "method"]
    return kind(**{name: spec[name] for name in names if name in spec})


def run_seeds(
    algorithm: Any,
    seeds: tuple[int, int],
    problem: Any,
    hparams: Any,
    report: Report | None,
    mesh: Mesh | None = None,
    **options: Any,
) -> tuple[Chunks, dict[str, np.ndarray]]:
    """Runs of a learner from N seeds side by side, and their figures ``[T, N]`` by name.

    Args:
      algorithm: the learner's module.
      seeds: the first, and how many.
      mesh: devices that several seeds are learned on; the same in every process.
      options: for :func:`~jaxltl.algos.common.chunks.run_in_chunks`.
    """
    if seeds[1] == 1:
        mesh = None
    given = (algorithm.init, *seeds, problem, hparams)
    if mesh is None:
        wait = compile_beside(_first_states, *given)
        trace_lanes(algorithm.step, jax.eval_shape(_first_states, *given), problem, hparams)
        wait()
        states = _first_states(*given)
    else:
        first = vmap_over_mesh(_first_of(algorithm.init), mesh, in_axes=(0, None, None, None))
        states = first(np.arange(seeds[1]), np.int32(seeds[0]), problem, hparams)
    by_name = report and (lambda step, metrics: report(step, vars(metrics)))
    found = run_in_chunks(
        algorithm.step, states, problem, hparams, lanes=True, report=by_name, mesh=mesh, **options
    )
    if mesh is not None:  # what comes then is each process's own
        found = found._replace(state=jax.tree.map(jnp.asarray, on_host(found.state)))
    return found, {"step": found.step, **vars(found.metrics)}


@functools.partial(jax.jit, static_argnames=("init", "num_seeds"))
def _first_states(
    init: Callable[..., Any], seed: int, num_seeds: int, problem: Any, hparams: Any
) -> Any:
    """A learner's N first states, each from a key of its own; one program."""

    def first(n: Any) -> Any:
        return _first_of(init)(n, seed, problem, hparams)

    if num_seeds == 1:  # without vmap, a smaller program
        return jax.tree.map(lambda x: x[None], first(0))
    return jax.vmap(first)(jnp.arange(num_seeds))


@functools.cache  # compiled once for each learner, so it must stay the same function
def _first_of(init: Callable[..., Any]) -> Callable[..., Any]:
    """The first state of lane n."""

    def first(n: Any, seed: Any, problem: Any, hparams: Any) -> Any:
        root = jax.random.fold_in(jax.random.key(seed), 1)
        return init(jax.random.fold_in(root, n), problem, hparams)

    return first


def one_seed(learned: Any, i: int) -> Any:
    """One of N seeds alone, of a frozen dataclass of arrays ``[N, ...]`` with a history ``[T, N]``."""
    one = {k: v[i : i + 1] for k, v in vars(learned).items() if isinstance(v, np.ndarray)}
    history = {k: v if v.ndim == 1 else v[:, i : i + 1] for k, v in learned.history.items()}
    return dataclasses.replace(learned, **one, history=history)


def postfix(figures: Mapping[str, np.ndarray]) -> dict[str, str]:
    """What the progress bar tells of the newest figures of a gradient's descent."""
    return {
        "loss": f"{figures['loss'].min():.4f}",
        "gradient": f"{figures['gradient_norm'].max():.1e}",
    }


def compile_beside(function: Any, *given: Any) -> Callable[[], None]:
    """Begins to compile a jitted function in another thread; returns what waits for that.

    A call of the function with as much then finds its program.
    """
    lowered = function.lower(*given)

    def work() -> None:
        with contextlib.suppress(Exception):  # which the call itself will raise
            lowered.compile()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread.join


def fingerprint(task: Any, seed: int, num_seeds: int) -> str:
    """What a checkpoint must agree on to be gone on from."""
    parts = [
        task.digest,
        seed,
        num_seeds,
        jaxltl.__version__,
        jax.__version__,
        str(jnp.result_type(float)),
    ]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]


def about(task: Task) -> dict[str, Any]:
    """What a result begins with."""
    return {"task": task.name, "formula": task.formula, "method": task.learner["method"]}


def hyperparameters(task: Task) -> dict[str, Any]:
    """What a task file says of the learner."""
    return {k: v for k, v in task.learner.items() if k != "method"}


def took(seconds: float) -> dict[str, Any]:
    """What a result ends with."""
    versions = {"jaxltl": jaxltl.__version__, "jax": jax.__version__}
    return {"seconds": round(seconds, 2), "versions": versions}


def plain(value: Any) -> Any:
    """Arrays and NumPy numbers as lists and numbers that JSON has; NaN and infinity as None."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(np.asarray(value).tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def memory_arrays(model: Product, size: int | None = None) -> dict[str, Any]:
    """How the memory of a policy goes on, in the first states of a product."""
    return {
        "initial_memory": model.initial_memory[:size],
        "next_memory": model.next_memory[:size],
        "label_on": model.label_on,
    }


def save_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Writes arrays as an ``.npz``, atomically.

    Raises:
      ValueError: the place cannot be written to.
    """
    with atomic_write(path) as file:
        np.savez(file, allow_pickle=False, **{k: np.asarray(v) for k, v in arrays.items()})


def automaton_picture(automaton: Automaton, live: str) -> Picture:
    """The task's automaton."""
    return Picture(
        "automaton.svg",
        "The task as an automaton",
        drawing("automaton", automaton),
        "States with a double circle: the task is done, whatever follows. Grey: it has failed. "
        "Each state is named by the formula that is left to satisfy.",
        live,
    )


def over_seeds(count: int) -> str:
    """How the caption of learning curves ends."""
    band = "; the line is the median over seeds, the band holds all of them"
    return f"{band if count > 1 else ''}."


def short_name(text: str, width: int = 44) -> str:
    """The text, or its beginning where it is longer than that."""
    return text if len(text) <= width else text[: width - 1] + "…"
