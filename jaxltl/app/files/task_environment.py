"""Task files of simulated worlds: which environment, which task, learned by what, judged how.

Tables ``[world]``, with ``[world.arguments]``, ``[task]``, ``[learner]``, one of the method's name
for its hyperparameters, and ``[evaluation]``; ``examples/flat_world.toml`` shows them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxltl.app.files import tables
from jaxltl.app.files.tables import COUNT, NUMBER, TEXT, TRUTH, Rule, choice, is_list, number_in
from jaxltl.core.environments.task_environment import ENDINGS
from jaxltl.core.environments.task_reward import REWARDS
from jaxltl.core.values.evaluation.episode_scores import OF_TASKS, SUMS

METHODS = ("ppo", "cce", "cpo")


@dataclass(frozen=True)
class EnvironmentTask:
    """A checked task file of a simulated world.

    Attributes:
      path: the file; `name` is its stem, unless the file gives one.
      world: what ``[world]`` says: environment, arguments, labels, propositions, horizon.
      formula: the task.
      reward: the other keys of ``[task]``, as ``task_environment`` takes them.
      learner: ``[learner]``: method and steps.
      settings: the table of the method's name.
      evaluation: ``[evaluation]``.
      digest: a fingerprint of the file and of every file beside it that it names.
      text: what it held when it was read.
    """

    path: Path
    name: str
    world: Mapping[str, Any]
    formula: str
    reward: Mapping[str, Any]
    learner: Mapping[str, Any]
    settings: Mapping[str, Any]
    evaluation: Mapping[str, Any]
    digest: str
    text: str

    @property
    def method(self) -> str:
        """By which it is learned."""
        return str(self.learner["method"])


# --- the keys of each table -----------------------------------------------------------------


_UNIT = number_in(0, 1)
_ABOVE = number_in(0)
_OPEN = Rule(lambda v: tables.is_number(v) and 0 < v < 1, "a number between 0 and 1, such as 0.95")
_SCHEDULE = Rule(
    lambda v: (
        _ABOVE.holds(v) or (isinstance(v, list) and len(v) == 2 and all(map(_ABOVE.holds, v)))
    ),
    "a number of at least 0, or [first, last], which goes in a straight line over all steps",
)
_WIDTHS = Rule(
    lambda v: isinstance(v, list) and all(map(COUNT.holds, v)),
    "a list of the widths of hidden layers, such as [64, 64]",
)
_SCORES = (*SUMS, *OF_TASKS)

_PPO: dict[str, Rule] = {
    "discount": _UNIT,
    "gae_lambda": _UNIT,
    "learning_rate": _SCHEDULE,
    "clip": _SCHEDULE,
    "value_clip": _SCHEDULE,
    "value_weight": _ABOVE,
    "entropy_weight": _ABOVE,
    "max_gradient_norm": _ABOVE,
    "target_kl": _ABOVE,
    "adam_epsilon": _ABOVE,
    "num_envs": COUNT,
    "num_steps": COUNT,
    "num_epochs": COUNT,
    "num_minibatches": COUNT,
    "normalize_advantage": TRUTH,
    "normalize_observation": TRUTH,
    "normalize_reward": TRUTH,
    "squash": choice("clip", "tanh"),
    "num_resets": Rule(lambda v: v == 0 or COUNT.holds(v), "a whole number of at least 0"),
    "hidden": _WIDTHS,
    "activation": choice("tanh", "relu", "gelu", "silu"),
    "initial_deviation": _ABOVE,
}
_CCE: dict[str, Rule] = {
    "rate": _SCHEDULE,
    "temperature": _ABOVE,
    "margin": NUMBER,
    "population": COUNT,
    "rho": _OPEN,
    "weighting": choice("until_feasible", "literal", "uniform"),
    "elite_reuse": TRUTH,
    "antithetic": TRUTH,
    "variance_floor": _ABOVE,
    "noise": _SCHEDULE,
    "restart_below": _ABOVE,
    "hidden": _WIDTHS,
    "activation": choice("tanh", "relu"),
    "deviation": _ABOVE,
    "objective": choice(*_SCORES),
    "cost": choice(*_SCORES),
    "limit": NUMBER,
    "episodes": COUNT,
}
_CPO: dict[str, Rule] = {
    "discount": _UNIT,
    "cost_discount": _UNIT,
    "gae_lambda": _UNIT,
    "cost_gae_lambda": _UNIT,
    "delta": _ABOVE,
    "damping": _ABOVE,
    "initial_deviation": _ABOVE,
    "backtrack": _UNIT,
    "value_rate": _ABOVE,
    "num_trajectories": COUNT,
    "hidden": _WIDTHS,
    "value_hidden": _WIDTHS,
    "normalize": TRUTH,
    "cg_steps": COUNT,
    "search_steps": COUNT,
    "fisher_stride": COUNT,
    "value_epochs": COUNT,
    "value_batches": COUNT,
    "limit": NUMBER,
    "cost": choice("world", "violation"),
}
_KEYS: dict[str, Mapping[str, Rule]] = {
    "world": {
        "environment": TEXT,
        "arguments": tables.TABLE,
        "labels": TEXT,
        "propositions": Rule(lambda v: is_list(v, str), 'a list of names, such as ["goal"]'),
        "horizon": COUNT,
    },
    "task": {
        "formula": TEXT,
        "reward": choice(*REWARDS),
        "discount": _UNIT,
        "ratio": _UNIT,
        "shaping": choice("distance"),
        "ending": choice(*ENDINGS),
    },
    "learner": {"method": choice(*METHODS), "steps": COUNT},
    "ppo": _PPO,
    "cce": _CCE,
    "cpo": _CPO,
    "evaluation": {
        "episodes": COUNT,
        "steps": COUNT,
        "confidence": _OPEN,
        "threshold": _OPEN,
        "discount": _OPEN,
        "policy": choice("drawn", "likeliest"),
    },
}
_REQUIRED = {
    "": ("world", "task", "learner"),
    "world": ("environment",),
    "task": ("formula",),
    "learner": ("method", "steps"),
    "cpo": ("limit",),
}


def is_environment_task(path: str | Path) -> bool:
    """Whether a task file is of a simulated world, by its world or by its method.

    Raises:
      ValueError: the file cannot be read or is no TOML.
    """
    data = tables.read_toml(Path(path), "the task file")[0]
    world, learner = (data.get(name) for name in ("world", "learner"))
    simulated = isinstance(world, dict) and "environment" in world
    return simulated or (isinstance(learner, dict) and learner.get("method") in METHODS)


def read_task(path: str | Path, raw: bytes | None = None) -> EnvironmentTask:
    """Reads a task file of a simulated world.

    Args:
      path: the file.
      raw: its bytes, where they were kept elsewhere: then no file is read, and there is no digest.

    Raises:
      ValueError: the file, or one that it names, is missing or malformed, or a key is unknown,
        missing or wrong. The message names the file, the table, the key and the fix.
    """
    path = Path(path)
    data, found = tables.read_tables(path, "the task file", _KEYS, _REQUIRED, raw)
    world, task, method = data["world"], dict(data["task"]), data["learner"]["method"]
    _check_method(path, data, method)
    return EnvironmentTask(
        path=path,
        name=data.get("name", path.stem),
        world=world,
        formula=task.pop("formula"),
        reward=task,
        learner=data["learner"],
        settings=data.get(method, {}),
        evaluation=data.get("evaluation", {}),
        digest=tables.digest(path, found, named_files(world)) if raw is None else "",
        text=found.decode(),
    )


def named_files(world: Mapping[str, Any]) -> list[str]:
    """The files beside a task file that its table ``[world]`` names, each once."""
    named = [world[key].rpartition(":")[0] for key in ("environment", "labels") if key in world]
    return [name for name in dict.fromkeys(named) if name.endswith(".py")]


def _check_method(path: Path, data: Mapping[str, Any], method: str) -> None:
    settings, world = data.get(method, {}), data["world"]
    for other in METHODS:
        tables.reject(
            path,
            other,
            [
                (
                    other != method and other in data,
                    f'is for method = "{other}", and [learner] says "{method}": leave one of them out',
                )
            ],
        )
    tables.reject(
        path,
        "cpo",
        [
            (
                method == "cpo" and "limit" not in settings,
                "lacks limit, which the expected cost of an episode is to keep to",
            )
        ],
    )
    tables.reject(
        path,
        "cce",
        [
            (
                method == "cce" and "limit" in settings and "cost" not in settings,
                'limit is that of a cost: give cost = "failure", "violation" or another score',
            ),
            (
                method == "cce" and "cost" in settings and "limit" not in settings,
                "cost needs a limit, which it is to keep to",
            ),
        ],
    )
    tables.reject(
        path,
        "world",
        [
            (
                ("labels" in world) != ("propositions" in world),
                "labels and propositions belong together: a function and the names of what it returns",
            )
        ],
    )
    judged = data.get("evaluation", {})
    tables.reject(
        path,
        "evaluation",
        [
            (
                method == "cce" and "policy" in judged,
                'policy is for methods whose policies draw their actions; that of "cce" draws none',
            )
        ],
    )
