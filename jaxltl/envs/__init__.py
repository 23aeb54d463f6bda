"""Worlds to learn in, a module each, imported when they are first used.

Those that are made by one call are at the top level (``jaxltl.gridworld``,
``jaxltl.letter_world``, ...); here are their modules, with what else they have. Models:
``gridworld``, ``temporal_gridworld``. Games: ``robots``, ``post_offices``. Simulated worlds:
``letter_world``, ``flat_world``, ``zone_world``, ``navigation``, ``lqr``, with
``navigation_steps`` as an environment, and ``networks``, small policies for searches among
parameters.
"""

import importlib
from typing import TYPE_CHECKING, Any

__all__ = [
    "flat_world",
    "gridworld",
    "letter_world",
    "lqr",
    "navigation",
    "navigation_steps",
    "networks",
    "post_offices",
    "robots",
    "temporal_gridworld",
    "zone_world",
]

if TYPE_CHECKING:
    from jaxltl.envs import flat_world as flat_world
    from jaxltl.envs import gridworld as gridworld
    from jaxltl.envs import letter_world as letter_world
    from jaxltl.envs import lqr as lqr
    from jaxltl.envs import navigation as navigation
    from jaxltl.envs import navigation_steps as navigation_steps
    from jaxltl.envs import networks as networks
    from jaxltl.envs import post_offices as post_offices
    from jaxltl.envs import robots as robots
    from jaxltl.envs import temporal_gridworld as temporal_gridworld
    from jaxltl.envs import zone_world as zone_world
else:

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return importlib.import_module(f"{__name__}.{name}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})
