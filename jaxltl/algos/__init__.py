"""Learners, a module each and all of the same shape, and what they share.

A learner has ``Problem``, ``Hparams``, ``State`` and ``Metrics``; ``make_problem``, then
``train(key, problem, hparams, num_steps=...)``, or ``init``, ``step`` and ``run``; and
``policy(state, problem, hparams)``, what was learned. Modules are imported when they are first
used, ``jaxltl.algos.ppo`` as well as ``from jaxltl.algos import ppo``. Steps and runs are for
``jit`` and ``vmap``, not to be differentiated through; what has derivatives says in what.

From demonstrations: ``mlirl``, ``todirl``, ``behavioral_cloning``. By trying, in a model:
``maximin_q``, ``rmax``, ``interval_learning``. By trying, in a simulated world: ``ppo``,
``many_tasks``, ``cce``, ``trust_region``. Parameters of a model: ``feasible``, ``regions``. For
all of them: ``learner`` (loops, stopping), ``chunks`` (progress, resuming), ``checkpoint`` (files),
``early_stopping``, ``schedules``; for some: ``actor_critic`` (networks), ``exponential_family`` (of
``cce``), ``pac`` (constants and bounds of ``rmax``).
"""

import importlib
from typing import TYPE_CHECKING, Any

__all__ = [
    "actor_critic",
    "behavioral_cloning",
    "cce",
    "checkpoint",
    "chunks",
    "early_stopping",
    "exponential_family",
    "feasible",
    "interval_learning",
    "learner",
    "many_tasks",
    "maximin_q",
    "mlirl",
    "pac",
    "ppo",
    "regions",
    "rmax",
    "schedules",
    "todirl",
    "trust_region",
]

if TYPE_CHECKING:
    from jaxltl.algos import actor_critic as actor_critic
    from jaxltl.algos import behavioral_cloning as behavioral_cloning
    from jaxltl.algos import cce as cce
    from jaxltl.algos import checkpoint as checkpoint
    from jaxltl.algos import chunks as chunks
    from jaxltl.algos import early_stopping as early_stopping
    from jaxltl.algos import exponential_family as exponential_family
    from jaxltl.algos import feasible as feasible
    from jaxltl.algos import interval_learning as interval_learning
    from jaxltl.algos import learner as learner
    from jaxltl.algos import many_tasks as many_tasks
    from jaxltl.algos import maximin_q as maximin_q
    from jaxltl.algos import mlirl as mlirl
    from jaxltl.algos import pac as pac
    from jaxltl.algos import ppo as ppo
    from jaxltl.algos import regions as regions
    from jaxltl.algos import rmax as rmax
    from jaxltl.algos import schedules as schedules
    from jaxltl.algos import todirl as todirl
    from jaxltl.algos import trust_region as trust_region
else:

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return importlib.import_module(f"{__name__}.{name}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
