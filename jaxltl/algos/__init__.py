"""Learners: one module or package each, all with the same interface, and their shared parts.

A learner has ``Problem``, ``Hparams``, ``State`` and ``Metrics``; ``make_problem``, then
``train(key, problem, hparams, num_steps=...)``, or ``init``, ``step`` and ``run``; and
``policy(state, problem, hparams)``. A module is imported at its first use, as
``jaxltl.algos.ppo`` or by ``from jaxltl.algos import ppo``. Steps and runs support ``jit`` and
``vmap``; they are not differentiable unless their documentation says so.

From demonstrations: ``mlirl``, ``todirl``, ``behavioral_cloning``. From interaction with a model:
``maximin_q``, ``rmax``, ``interval_learning``. From interaction with a simulator: ``ppo``,
``many_tasks``, ``cce``, ``trust_region``. Parameters of a parametric model: ``feasible``,
``regions``. Shared parts are in ``common``: ``learner`` (training loops), ``chunks`` (progress
reports and resumption), ``checkpoint`` (files), ``early_stopping``, ``schedules``,
``actor_critic`` (networks) and ``pac`` (constants and bounds of ``rmax``).
"""

import importlib
from typing import TYPE_CHECKING, Any

__all__ = [
    "behavioral_cloning",
    "cce",
    "common",
    "feasible",
    "interval_learning",
    "many_tasks",
    "maximin_q",
    "mlirl",
    "ppo",
    "regions",
    "rmax",
    "todirl",
    "trust_region",
]

if TYPE_CHECKING:
    from jaxltl.algos import behavioral_cloning as behavioral_cloning
    from jaxltl.algos import cce as cce
    from jaxltl.algos import common as common
    from jaxltl.algos import feasible as feasible
    from jaxltl.algos import interval_learning as interval_learning
    from jaxltl.algos import many_tasks as many_tasks
    from jaxltl.algos import maximin_q as maximin_q
    from jaxltl.algos import mlirl as mlirl
    from jaxltl.algos import ppo as ppo
    from jaxltl.algos import regions as regions
    from jaxltl.algos import rmax as rmax
    from jaxltl.algos import todirl as todirl
    from jaxltl.algos import trust_region as trust_region
else:

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return importlib.import_module(f"{__name__}.{name}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
