"""Shared parts of learners: loops, checkpoints, schedules, networks and distributions of actions."""

import importlib
import pkgutil
from types import ModuleType

__all__ = [
    "actor_critic",
    "checkpoint",
    "chunks",
    "early_stopping",
    "learner",
    "pac",
    "schedules",
]


def __getattr__(name: str) -> ModuleType:
    if name.startswith("_") or name not in __dir__():
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"{__name__}.{name}")


def __dir__() -> list[str]:
    return sorted(x.name for x in pkgutil.iter_modules(__path__) if not x.name.startswith("_"))
