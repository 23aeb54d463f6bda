"""(u) Runs from the host: a callback against none, and a sweep against a loop, compilation included.

``python -m benchmarks.runs [callback] [sweep] [LEARNER ...]``. The callback appends the newest
metrics to a list after each fortieth of a run. The sweep has 32 seeds and 5 values of a
hyperparameter, and its peer is a loop over ``jit(train)``; both begin without compiled programs.
If other programs share the cores, the processor's seconds divided by the threads that are ready to
run are the seconds of an idle machine: *idle ratio*.
"""

from __future__ import annotations

import argparse
import json
import statistics
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.learner_cases import CASES, Case
from benchmarks.timing import Spent, spent
from jaxltl.algos import training

# Steps of a run, and a hyperparameter with five values.
SWEEPS: dict[str, tuple[int, str, list[float]]] = {
    "ppo": (40, "learning_rate", [1e-4, 3e-4, 1e-3, 3e-3, 1e-2]),
    "mlirl": (40, "discount", [0.8, 0.82, 0.85, 0.87, 0.9]),
    "cce": (3000, "rate", [0.02, 0.05, 0.1, 0.2, 0.4]),
    "behavioral_cloning": (2500, "l2", [0.0, 1e-4, 1e-3, 1e-2, 1e-1]),
}


def _cold(function: Any) -> Spent:
    """A call without compiled programs."""
    jax.clear_caches()
    return spent(function)


def sweep(name: str, num_seeds: int = 32) -> dict[str, Any]:
    """160 runs by :func:`training.sweep` and in a loop; how far ``vmap`` of the same runs differs."""
    case: Case = CASES[name]()
    num_steps, field, values = SWEEPS[name]
    keys = jax.random.split(jax.random.key(0), num_seeds)

    def loop() -> Any:
        one = jax.jit(partial(case.module.train, num_steps=num_steps))
        settings = [case.hparams.replace(**{field: x}) for x in values]
        return [jax.block_until_ready(one(key, case.problem, x)) for x in settings for key in keys]

    def ours() -> Any:
        over = {field: values}
        return training.sweep(
            case.module, keys, case.problem, case.hparams, over, num_steps=num_steps
        ).metrics

    peer, mine, warm = _cold(loop), _cold(ours), spent(ours)
    idle = [x.processor_seconds / max(x.threads, 1) for x in (mine, peer)]
    return {
        "learner": name,
        "runs": num_seeds * len(values),
        "sweep": mine._asdict(),
        "loop": peer._asdict(),
        "warm sweep": warm._asdict(),
        "ratio": round(mine.seconds / peer.seconds, 2),
        "idle ratio": round(idle[0] / idle[1], 2),
    }


def lanes(num_steps: int = 40) -> dict[str, Any]:
    """How far the returns and losses of PPO's lanes of a ``vmap`` are from the runs by themselves."""
    rows = {}
    for double in (False, True):
        with jax.enable_x64(double):
            case = CASES["ppo"]()
            keys = jax.random.split(jax.random.key(0), 8)
            hparams = case.hparams.replace(learning_rate=1e-2)
            train = partial(case.module.train, num_steps=num_steps)
            _, together = jax.jit(jax.vmap(train, (0, None, None)))(keys, case.problem, hparams)
            alone = training.sweep(case.module, keys, case.problem, hparams, num_steps=num_steps)
            for name in ("policy_loss", "episode_return"):
                gap = jnp.abs(getattr(together, name) - getattr(alone.metrics, name)[0])
                gap = jnp.nanmax(gap, axis=0)
                rows[f"{name}, {'float64' if double else 'float32'}"] = {
                    step: f"{gap[step - 1]:.1e}" for step in (1, 10, 20, num_steps)
                }
    return rows


def callback(name: str, num_steps: int, repeats: int) -> dict[str, Any]:
    """Processor's and wall seconds with a callback over those without, compiled, in turn."""
    case: Case = CASES[name]()
    seen: list[Any] = []

    def run(follow: bool) -> Any:
        key = jax.random.key(0)
        if not follow:
            return case.module.train(key, case.problem, case.hparams, num_steps=num_steps)
        told = partial(training.train, case.module, key, case.problem, case.hparams)
        return told(num_steps=num_steps, callback=lambda state, metrics: seen.append(metrics))

    for follow in (False, True):
        run(follow)
    pairs = [(spent(partial(run, True)), spent(partial(run, False))) for _ in range(repeats)]
    return {
        "learner": name,
        "steps": num_steps,
        "calls": len(seen) // (repeats + 1),
        "seconds": round(statistics.median(x.processor_seconds for _, x in pairs), 2),
        "ratio": round(
            statistics.median(x.processor_seconds / y.processor_seconds for x, y in pairs), 4
        ),
        "wall ratio": round(statistics.median(x.seconds / y.seconds for x, y in pairs), 4),
    }


def main() -> None:
    """Prints a line of JSON for each measurement."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.runs", description=__doc__)
    parser.add_argument("parts", nargs="*", default=["callback", "lanes", *SWEEPS])
    parser.add_argument("--seeds", type=int, default=32)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--steps", type=int, default=1000, help="of PPO with a callback")
    asked = parser.parse_args()
    for part in asked.parts:
        if part == "callback":
            row = callback("ppo", asked.steps, asked.repeats)
        else:
            row = lanes() if part == "lanes" else sweep(part, asked.seeds)
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
